"""Wrapped and absolute phase: plain oracles, and real captures of others."""

import xml.etree.ElementTree as ET

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import shared
from weldscan import (
    GeometryError,
    InputError,
    Lens,
    Scanner,
    calibrate_reference_plane,
    decode,
    decode_gray,
    decode_phase,
    height_from_reference,
    set_threads,
    triangulate,
    unwrap_spatial,
    unwrap_temporal,
)

DOUBLE_ROUNDING_RAD = 1e-12
CPSD_RAD = 1e-6  # what the authors' own decoder agrees to with an independent one


def wrap(phase):
    return np.angle(np.exp(1j * np.asarray(phase)))


def images_of(phase, steps, background=120.0, modulation=80.0):
    return np.array([background + modulation * np.cos(phase - 2 * np.pi * k / steps) for k in range(steps)])


@pytest.mark.parametrize("steps", [3, 4, 5, 7, 12])
def test_decode_phase_is_numpys(steps):
    rng = np.random.default_rng(1)
    images = rng.integers(0, 256, (steps, 40, 33), np.uint8)
    delta = 2 * np.pi * np.arange(steps) / steps
    c, s = (np.tensordot(f(delta), images.astype(float), 1) for f in (np.cos, np.sin))
    found = decode_phase(images, steps)
    clear = np.hypot(c, s) > 1e-6
    assert np.abs(wrap(found.phase_rad - np.arctan2(s, c)))[clear].max() < DOUBLE_ROUNDING_RAD
    assert np.allclose(found.modulation, 2 / steps * np.hypot(c, s), rtol=1e-6, atol=1e-5)
    assert np.allclose(found.background, images.mean(0), rtol=1e-6)
    assert found.phase_rad.shape == (40, 33)
    assert np.array_equal(np.asarray(found), found.phase_rad)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64, np.int32])
def test_decode_phase_takes_sets_and_types(dtype):
    phase = np.linspace(-3, 3, 200).reshape(10, 20)
    images = np.rint(np.concatenate([images_of(phase, 3), images_of(2 * phase, 4)])).astype(dtype)
    found = decode_phase(list(images), [3, 4])
    assert found.phase_rad.shape == (2, 10, 20)
    assert np.abs(wrap(found.phase_rad[0] - phase)).max() < 0.02
    assert np.abs(wrap(found.phase_rad[1] - 2 * phase)).max() < 0.02
    assert "2, 10, 20" in repr(found)


def test_cpsd_phase_is_the_authors():
    folder = shared("real/cpsd_gamma")
    scipy_io = pytest.importorskip("scipy.io")
    expected = scipy_io.loadmat(folder / "Phases/phase_before_17.mat")["phase_unwrapped"]
    images = [
        cv2.imread(str(folder / f"PSPImg/17_{f}_{s}.png"), cv2.IMREAD_GRAYSCALE)
        for f in (1, 2, 3, 4)
        for s in range(1, 13)
    ]
    found = decode_phase(images, [12] * 4)
    # The authors' phi is pi - ours: theirs falls where ours rises.
    wrapped = np.pi - found.phase_rad
    absolute = unwrap_temporal(wrapped, [1, 4, 16, 64])
    clear = (found.modulation > 10).all(0)
    assert clear.mean() > 0.3
    assert np.abs(wrap(absolute - expected))[clear].max() < CPSD_RAD
    assert (np.abs(absolute - expected)[clear] < CPSD_RAD).mean() > 0.999
    # The projector's gamma is uncorrected: the residual of the finest set shows its second harmonic, 0.21 of the first.
    harmonic = np.sqrt(2 * 9 / 12) * found.residual[3] / found.modulation[3]
    assert abs(np.median(harmonic[clear]) - 0.21) < 0.04


def skull_scanner(folder):
    root = ET.parse(folder / "calibration/calibration.xml").getroot()

    def matrix(name):
        node = root.find(name)
        rows, cols = int(node.find("rows").text), int(node.find("cols").text)
        return np.array(node.find("data").text.split(), float).reshape(rows, cols)

    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = matrix("Rp"), matrix("Tp").ravel()
    camera = Lens(1688, 1352, matrix("Kc"), matrix("kc").ravel())
    projector = Lens(1824, 1140, matrix("Kp"), matrix("kp").ravel())
    return Scanner(camera, projector, np.linalg.inv(pose))


def test_the_skull_stands_where_its_gray_code_has_it():
    folder = shared("real/slstudio_skull")
    scipy_io = pytest.importorskip("scipy.io")
    scanner = skull_scanner(folder)
    images = [cv2.imread(str(folder / f"skull_2x3/frameSeq_{i:02d}.png"), cv2.IMREAD_GRAYSCALE) for i in range(6)]
    found = decode([images], [(16, 3), (1, 3)], 1824)
    # SLStudio's phase is zero at u = 0, ours at the left border of that column.
    cloud = triangulate(found.column_px + 0.5, scanner, found.sigma_px)
    expected = scipy_io.loadmat(folder / "skull_gray/pointCloud.mat")["xyz"]
    # SLStudio takes the lens off the image first and triangulates in that: its pixel (u, v) is the ray of a pinhole, up
    # to a pixel to the right, where it found the edge of a stripe. So it is not our pixel (u, v), but up to two beside
    # it: ours are read where its points are seen through the lens.
    v, u = np.nonzero(np.isfinite(expected[..., 2]))
    theirs = expected[v, u]
    pinhole = theirs @ scanner.camera.K.T
    pinhole = pinhole[:, :2] / pinhole[:, 2:]
    assert np.abs(pinhole[:, 1] - v).max() < 1e-9
    assert (pinhole[:, 0] - u).min() > -1e-9 and (pinhole[:, 0] - u).max() < 1 + 1e-9
    at = scanner.camera.project(theirs)
    x, y = np.floor(at).astype(int).T
    fx, fy = (at - np.floor(at)).T
    z = cloud.points_mm[..., 2]
    ours = (1 - fy) * ((1 - fx) * z[y, x] + fx * z[y, x + 1]) + fy * ((1 - fx) * z[y + 1, x] + fx * z[y + 1, x + 1])
    dz = (ours - theirs[:, 2])[np.isfinite(ours)]
    assert dz.size > 75_000
    assert abs(np.median(dz)) <= 0.005
    assert 1.4826 * np.median(np.abs(dz)) < 0.35  # their cells are two columns wide, 0.43 mm each
    # Pixel by pixel, as if the grids were one: what slopes make of the displacement comes in, 0.07 mm over all pixels,
    # and least where the light falls squarely.
    naive = z - expected[..., 2]
    clear = np.isfinite(naive) & (found.modulation > 30)
    assert clear.sum() > 55_000 and abs(np.median(naive[clear])) <= 0.05

    # The same through the Gray code itself: ten bits of eleven, cells of two columns from the image's centre outwards.
    gray = [cv2.imread(str(folder / f"skull_gray/frameSeq_{i:02d}.png"), cv2.IMREAD_GRAYSCALE) for i in range(12)]
    code = decode_gray(gray[2:], white=gray[0], black=gray[1])
    seen = (code >= 0) & np.isfinite(z)
    assert seen.sum() > 200_000
    offset = 2 * code[seen] + 0.5 - found.column_px[seen] - 0.5
    assert 1.4826 * np.median(np.abs(offset - np.median(offset))) < 1.0


def test_temporal_unwrapping_in_any_order_and_shape():
    x = np.linspace(0.001, 0.999, 300).reshape(3, 4, 25)
    for periods in ([1, 8, 64], [64, 8, 1], [59, 64, 70], [15, 16], [1]):
        finest = max(periods)
        wrapped = np.array([wrap(2 * np.pi * p * x) for p in periods])
        found = unwrap_temporal(wrapped, periods)
        assert found.shape == x.shape
        assert np.abs(found - 2 * np.pi * finest * x).max() < 1e-9
    wrapped[0, 0, 0, 0] = np.nan
    assert np.isnan(unwrap_temporal(wrapped, periods)[0, 0, 0])


def herraez(wrapped):
    """Kruskal's algorithm in plain Python on scikit-image's reliability, interior pixels."""
    h, w = wrapped.shape
    padded = np.pad(wrapped, 1, constant_values=np.nan)
    shift = lambda dy, dx: padded[1 + dy : 1 + dy + h, 1 + dx : 1 + dx + w]  # noqa: E731
    cost = np.zeros((h, w))
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        second = wrap(shift(-dy, -dx) - wrapped) - wrap(wrapped - shift(dy, dx))
        cost += np.nan_to_num(second**2, nan=4 * np.pi**2)
    index = np.arange(h * w).reshape(h, w)
    flat = cost.ravel()
    joints = [(flat[a] + flat[b], a, b) for a, b in zip(index[:, :-1].ravel(), index[:, 1:].ravel(), strict=True)]
    joints += [(flat[a] + flat[b], a, b) for a, b in zip(index[:-1].ravel(), index[1:].ravel(), strict=True)]
    group = {i: [i] for i in range(h * w)}
    name = list(range(h * w))
    out = wrapped.ravel().copy()
    for _, a, b in sorted(joints):
        if name[a] != name[b]:
            small, large = (a, b) if len(group[name[a]]) < len(group[name[b]]) else (b, a)
            members = group.pop(name[small])
            out[members] += 2 * np.pi * np.round((out[large] - out[small]) / (2 * np.pi))
            for m in members:
                name[m] = name[large]
            group[name[large]] += members
    out = out.reshape(h, w)
    return out - out[0, 0] + wrapped[0, 0]


@pytest.mark.parametrize("noise", [0.0, 0.6, 1.2, 2.0])
def test_spatial_unwrapping_is_herraezs(noise):
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:90, :110]
    truth = 25 * np.exp(-((x - 50) ** 2 + (y - 40) ** 2) / 900) + 0.2 * x + noise * rng.standard_normal(x.shape)
    found = unwrap_spatial(wrap(truth))
    assert np.abs(wrap(found - truth)).max() < 1e-9
    # Costs are single precision here: the rare near-ties may go the other way where noise leaves no right answer.
    assert (np.abs(found - herraez(wrap(truth))) < 1e-6).mean() > 0.98
    # Neighbours 0.7 rad apart on the flank: noise of 0.6 rad still leaves nearly all of them within half a turn.
    if noise <= 0.6:
        assert (np.abs(found - truth - (found - truth)[0, 0]) < 1e-6).mean() > (0.999 if noise else 0.999999)


def test_mask_nan_and_quality():
    y, x = np.mgrid[:60, :80]
    truth = 0.5 * x + 0.3 * y
    wrapped = wrap(truth)
    rng = np.random.default_rng(1)
    holes = rng.random(x.shape) < 0.2
    holes[:, 40:43] = True
    with_nan = np.where(holes, np.nan, wrapped)
    found = unwrap_spatial(with_nan)
    assert np.array_equal(found, unwrap_spatial(wrapped, mask=~holes), equal_nan=True)
    assert np.array_equal(np.isnan(found), holes)
    left = found[:, :40] - truth[:, :40]
    connected = ~np.isnan(left)
    # All but a few walled-in pixels belong to the one region.
    assert (np.abs(left[connected] - np.median(left[connected])) < 1e-9).mean() > 0.97
    noisy = wrap(truth + 3 * rng.standard_normal(x.shape) * (x > 50))
    by_quality = unwrap_spatial(noisy, quality=-np.abs(x - 10.0))
    assert np.abs((by_quality - truth)[:, :50] - (by_quality - truth)[0, 0]).max() < 1e-9


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 140), st.integers(1, 140), st.integers(0, 2**32 - 1), st.floats(0, 10))
def test_spatial_unwrapping_only_adds_whole_turns(h, w, seed, noise):
    rng = np.random.default_rng(seed)
    phase = noise * rng.standard_normal((h, w)).cumsum(1)
    phase[rng.random((h, w)) < 0.1] = np.nan
    found = unwrap_spatial(phase)
    assert np.array_equal(np.isnan(found), np.isnan(phase))
    turns = ((found - phase) / (2 * np.pi))[~np.isnan(phase)]
    assert np.abs(turns - np.rint(turns)).max(initial=0) < 1e-6


def test_the_same_bits_on_any_number_of_threads():
    rng = np.random.default_rng(1)
    phase = rng.uniform(-3, 3, (2, 300, 301))
    images = rng.integers(0, 256, (4, 300, 301), np.uint8)
    try:
        runs = []
        for threads in (1, 2, 8):
            set_threads(threads)
            out = (unwrap_spatial(phase[0]), unwrap_temporal(phase, [1, 8]), decode_phase(images, 4).phase_rad)
            runs.append([a.tobytes() for a in out])
        assert runs[0] == runs[1] == runs[2]
    finally:
        set_threads(None)


def test_complementary_gray_code_holds_where_the_edge_is_blurred():
    u = np.arange(1024.0)
    fringes, bits = 32, 6
    edge = (
        np.random.default_rng(1).uniform(-0.2, 0.2, u.size) / fringes
    )  # the code is read up to a fifth of a fringe off
    cell = ((u / 1024 + edge).clip(0, 0.9999) * 2**bits).astype(int)
    gray = cell ^ (cell >> 1)
    images = [np.uint8(40 + 160 * (gray >> b & 1))[None, :] for b in reversed(range(bits))]
    inverse = [240 - i for i in images]
    phase = 2 * np.pi * fringes * u / 1024
    found = decode_gray(images, inverse=inverse, wrapped=wrap(phase)[None, :])
    assert np.abs(found[0] - phase).max() < 1e-9
    codes = decode_gray(images, white=np.full((1, 1024), 200, np.uint8), black=np.full((1, 1024), 40, np.uint8))
    assert np.array_equal(codes[0], cell)
    assert (decode_gray(images, white=images[0], black=images[0]) == -1).all()


def test_reference_plane_agrees_with_the_full_model():
    """Steps and planes under a scanner without lenses, camera and projector both looking straight down."""
    camera = Lens(120, 90, [[300, 0, 59.5], [0, 300, 44.5], [0, 0, 1]], [0] * 4)
    projector = Lens(800, 600, [[600, 0, 399.5], [0, 600, 299.5], [0, 0, 1]], [0] * 4)
    pose = np.eye(4)
    pose[0, 3] = 100.0
    scanner = Scanner(camera, projector, pose)
    rays = np.dstack([*np.meshgrid((np.arange(120) - 59.5) / 300, (np.arange(90) - 44.5) / 300), np.ones((90, 120))])

    def phase_and_column(height):
        points = (rays * (500.0 - height)[..., None]).reshape(-1, 3)
        column = scanner.project_to_projector(points)[:, 0].reshape(90, 120)
        return 2 * np.pi * 40 * (column + 0.5) / 800, column

    flat = np.zeros((90, 120))
    steps = np.where(np.arange(120) > 60, 5.0, -2.0) + flat
    phase, column = phase_and_column(steps)
    reference, _ = phase_and_column(flat)
    # A projector pixel is 500/600 mm wide on the plane, a fringe 20 of them.
    period = 20 * 500 / 600
    height = height_from_reference(phase, reference, baseline_mm=100.0, distance_mm=500.0, period_mm=period)
    assert np.abs(height - steps).max() < 1e-9
    assert np.abs(500.0 - triangulate(column, scanner).points_mm[..., 2] - height).max() < 1e-9
    planes = [10.0, 25.0, 40.0]
    plane = calibrate_reference_plane(reference, [phase_and_column(flat + h)[0] for h in planes], planes)
    assert np.abs(height_from_reference(phase, reference, calibration=plane) - steps).max() < 1e-9
    assert np.abs(plane.a - 1 / 500).max() < 1e-9
    assert plane.rms_mm.max() < 1e-9
    # Fifty micrometres of noise in the planes' heights stay that.
    rng = np.random.default_rng(1)
    noisy = [phase_and_column(flat + h + 0.05 * rng.standard_normal(flat.shape))[0] for h in planes]
    rough = calibrate_reference_plane(reference, noisy, planes)
    assert 0.01 < np.median(rough.rms_mm) < 0.06


ONE = np.zeros((4, 5))


@pytest.mark.parametrize(
    "call",
    [
        lambda: decode_phase([ONE] * 4, 3),
        lambda: decode_phase([ONE] * 2, 2),
        lambda: decode_phase([ONE, ONE, ONE[:2]], 3),
        lambda: decode_phase([], []),
        lambda: decode_phase(7, 3),
        lambda: decode_phase(["a", "b", "c"], 3),
        lambda: decode_phase([ONE.astype(complex)] * 3, 3),
        lambda: unwrap_temporal([ONE, ONE], [1]),
        lambda: unwrap_temporal([ONE], [64]),
        lambda: unwrap_temporal([ONE, ONE], [1, np.nan]),
        lambda: unwrap_temporal([], []),
        lambda: unwrap_spatial(ONE[0]),
        lambda: unwrap_spatial(ONE, mask=ONE),
        lambda: unwrap_spatial(ONE, mask=np.ones((2, 2), bool)),
        lambda: unwrap_spatial(ONE, quality=ONE * np.nan),
        lambda: unwrap_spatial(ONE, quality=ONE[:2]),
        lambda: decode_gray([ONE, ONE]),
        lambda: decode_gray([ONE, ONE], white=ONE),
        lambda: decode_gray([ONE, ONE], inverse=[ONE]),
        lambda: decode_gray([ONE, ONE], white=ONE, black=ONE[:2]),
        lambda: decode_gray([ONE], white=ONE, black=ONE, wrapped=ONE[:1]),
        lambda: decode_gray([ONE] * 40, white=ONE, black=ONE),
        lambda: height_from_reference(ONE, ONE),
        lambda: height_from_reference(ONE, ONE[:2], baseline_mm=1, distance_mm=1, period_mm=1),
        lambda: height_from_reference(ONE, ONE, baseline_mm=0, distance_mm=1, period_mm=1),
        lambda: height_from_reference(ONE, ONE, baseline_mm=1, distance_mm=-1, period_mm=1),
        lambda: calibrate_reference_plane(ONE, [ONE, ONE], [1, 0]),
        lambda: calibrate_reference_plane(ONE, [ONE, ONE[:2]], [1, 2]),
        lambda: calibrate_reference_plane(ONE, [ONE, ONE], [1]),
    ],
)
def test_bad_input_is_named(call):
    with pytest.raises(InputError):
        call()


def test_a_calibration_needs_two_heights():
    with pytest.raises(GeometryError):
        calibrate_reference_plane(ONE, [ONE], [1])
    with pytest.raises(GeometryError, match="one height"):
        calibrate_reference_plane(ONE, [ONE, ONE], [3, 3])
