"""Plane, sphere and cylinder against certified fits, SciPy, and their own statistics."""

from __future__ import annotations

import csv
import math
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

import weldscan
from conftest import shared

# The certified values are correct to all digits given; ours to the rounding of coordinates below 1000 mm, amplified by
# the hardest arcs.
POSITION_TOLERANCE_MM = 1e-10
DIRECTION_TOLERANCE_RAD = 1e-11
# References of the scanned spheres: 30 digits, of coordinates of 7 m.
SCANNED_TOLERANCE_MM = 1e-9
# SciPy stops at about the square root of the rounding of the cost.
SCIPY_TOLERANCE = 1e-6

Array = np.ndarray[Any, Any]


def angle(a: Array, b: Array) -> float:
    """Between two lines, without the loss of digits that an arc cosine has."""
    return float(np.linalg.norm(np.cross(a / np.linalg.norm(a), b / np.linalg.norm(b))))


def off_axis(d: Array, axis: Array) -> float:
    return float(np.linalg.norm(d - axis * (d @ axis)))


def frame(axis: Array) -> tuple[Array, Array]:
    u = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    u /= np.linalg.norm(u)
    return u, np.cross(axis, u)


def direction(rng: np.random.Generator) -> Array:
    d = rng.normal(size=3)
    return d / np.linalg.norm(d)


def cap(rng: np.random.Generator, n: int, radius: float, half_angle: float) -> Array:
    """Directions times the radius within a cap about z."""
    z = rng.uniform(math.cos(half_angle), 1, n)
    phi, r = rng.uniform(0, 2 * math.pi, n), np.sqrt(1 - z * z)
    return radius * np.c_[r * np.cos(phi), r * np.sin(phi), z]


def arc(rng: np.random.Generator, n: int, radius: float, opening: float, length: float) -> Array:
    """Points of a cylinder along z."""
    t = rng.uniform(0, opening, n)
    return np.c_[radius * np.cos(t), radius * np.sin(t), rng.uniform(-length / 2, length / 2, n)]


def nist(kind: str) -> list[tuple[str, Array, Array]]:
    folder = shared("real/nist_fits") / kind
    pairs = []
    for data in sorted(folder.glob("*.ds")):
        certified = np.array(data.with_suffix(".fit").read_text().split(), dtype=float)
        pairs.append((data.stem, np.loadtxt(data, skiprows=1), certified))
    assert pairs
    return pairs


def test_nist_spheres() -> None:
    for name, points, truth in nist("Sphere"):
        fit = weldscan.fit_sphere(points)
        assert np.abs(fit.center_mm - truth[:3]).max() < POSITION_TOLERANCE_MM, name
        assert abs(fit.radius_mm - truth[3] / 2) < POSITION_TOLERANCE_MM, name


def test_nist_planes() -> None:
    for name, points, truth in nist("Plane"):
        fit = weldscan.fit_plane(points)
        assert np.abs(fit.point_mm - truth[:3]).max() < POSITION_TOLERANCE_MM, name
        assert angle(fit.normal, truth[3:]) < DIRECTION_TOLERANCE_RAD, name


def test_nist_cylinders() -> None:
    for name, points, truth in nist("Cylinder"):
        fit = weldscan.fit_cylinder(points)
        assert off_axis(truth[:3] - fit.point_mm, fit.axis) < POSITION_TOLERANCE_MM, name
        assert angle(fit.axis, truth[3:6]) < DIRECTION_TOLERANCE_RAD, name
        assert abs(fit.radius_mm - truth[6] / 2) < POSITION_TOLERANCE_MM, name


def test_scanned_spheres() -> None:
    folder = shared("real/nist_spheres_scanned")
    with (folder / "reference_fits.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert rows
    for row in rows:
        points = 1e3 * np.loadtxt(folder / "truncated" / f"tSPH{row['set']}.xyz", delimiter=",")
        free = weldscan.fit_sphere(points)
        fixed = weldscan.fit_sphere(points, 50.0)
        for fit, name in ((free, "freeR"), (fixed, "fixedR50mm")):
            centre = 1e3 * np.array([float(row[f"{name}_c{k}_m"]) for k in "xyz"])
            assert np.abs(fit.center_mm - centre).max() < SCANNED_TOLERANCE_MM
        assert abs(free.radius_mm - 1e3 * float(row["freeR_R_m"])) < SCANNED_TOLERANCE_MM
        assert math.sqrt(free.covariance[3, 3]) == pytest.approx(1e3 * float(row["freeR_u_R_m"]), rel=0.01)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(4, 300),
    half_angle=st.floats(0.2, math.pi),
    size=st.floats(-2, 4),
    offset=st.floats(0, 3),
    known=st.booleans(),
)
def test_spheres_reach_the_minimum_that_scipy_reaches_from_the_truth(
    seed: int, n: int, half_angle: float, size: float, offset: float, known: bool
) -> None:
    rng = np.random.default_rng(seed)
    radius = 10**size
    noise = 1e-4 * radius * min(1.0, half_angle / 2) ** 4
    centre = radius * 10**offset * direction(rng)
    points = centre + cap(rng, n, radius, half_angle) + rng.normal(0, noise, (n, 3))
    fit = weldscan.fit_sphere(points, radius if known else None)

    def residuals(x: Array) -> Array:
        return np.linalg.norm((points - centre) / radius - x[:3], axis=1) - (1 if known else x[3])

    start = np.array([0, 0, 0, 1.0])[: 3 if known else 4]
    plain = least_squares(residuals, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert n * (fit.rms_mm / radius) ** 2 <= 2 * plain.cost * (1 + SCIPY_TOLERANCE) + (1e-13 * 10**offset) ** 2 * n


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(6, 300),
    opening=st.floats(0.7, 2 * math.pi),
    size=st.floats(-2, 4),
    slender=st.floats(-1.5, 2),
    offset=st.floats(0, 3),
)
def test_cylinders_reach_the_minimum_that_scipy_reaches_from_the_truth(
    seed: int, n: int, opening: float, size: float, slender: float, offset: float
) -> None:
    rng = np.random.default_rng(seed)
    radius, length = 10**size, 10 ** (size + slender)
    axis = direction(rng)
    u, v = frame(axis)
    noise = 1e-4 * radius * min(1.0, opening / 3) ** 4 * min(1.0, length / radius)
    centre = radius * 10**offset * direction(rng)
    points = centre + arc(rng, n, radius, opening, length) @ np.array([u, v, axis]) + rng.normal(0, noise, (n, 3))
    fit = weldscan.fit_cylinder(points)

    def residuals(x: Array) -> Array:
        w = axis + x[2] * u + x[3] * v
        w /= np.linalg.norm(w)
        q = (points - centre) / radius - x[0] * u - x[1] * v
        return np.linalg.norm(q - np.outer(q @ w, w), axis=1) - x[4]

    plain = least_squares(residuals, [0, 0, 0, 0, 1.0], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert n * (fit.rms_mm / radius) ** 2 <= 2 * plain.cost * (1 + SCIPY_TOLERANCE) + (1e-13 * 10**offset) ** 2 * n


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(4, 200), offset=st.floats(0, 6))
def test_planes_agree_with_the_singular_value_decomposition(seed: int, n: int, offset: float) -> None:
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    flat = rng.normal(size=(n, 3)) * [30, 10, 0.01]
    points = flat @ turn + 10**offset * direction(rng)
    weights = rng.uniform(0.5, 2, n)
    fit = weldscan.fit_plane(points, weights=weights)
    mean = np.average(points, axis=0, weights=weights)
    normal = np.linalg.svd(np.sqrt(weights)[:, None] * (points - mean))[2][2]
    # Both lose the digits that the offset takes.
    assert angle(fit.normal, normal) < 1e-14 * 10**offset + 1e-11
    assert abs((mean - fit.point_mm) @ fit.normal) < 1e-14 * 10**offset + 1e-12
    assert fit.normal[np.argmax(np.abs(fit.normal))] > 0


def surfaces(rng: np.random.Generator, noise: float) -> list[tuple[str, Callable[..., Any], Array, Array]]:
    """Name, fit, noise-free points, true parameters in the order of the covariance."""
    del noise
    n = 400
    ball = cap(rng, n, 10, 1.0) + np.array([1, 2, 300])
    pipe = arc(rng, n, 50, 1.5, 60) + np.array([5, -3, 200])
    plate = np.c_[rng.uniform(-20, 20, (n, 2)), np.full(n, 400.0)]
    return [
        ("ball", weldscan.fit_sphere, ball, np.array([1, 2, 300, 10.0])),
        ("known ball", lambda p, **k: weldscan.fit_sphere(p, 10.0, **k), ball, np.array([1, 2, 300.0])),
        ("pipe", weldscan.fit_cylinder, pipe, np.array([5, -3, np.nan, 0, 0, 1, 50.0])),
        ("known pipe", lambda p, **k: weldscan.fit_cylinder(p, 50.0, **k), pipe, np.array([5, -3, np.nan, 0, 0, 1.0])),
        ("plate", weldscan.fit_plane, plate, np.array([np.nan, np.nan, 400, 0, 0, 1.0])),
    ]


def parameters(fit: Any) -> Array:
    if isinstance(fit, weldscan.SphereFit):
        return np.r_[fit.center_mm, fit.radius_mm]
    if isinstance(fit, weldscan.PlaneFit):
        return np.r_[fit.point_mm, fit.normal]
    # The axis where it crosses z = 200, the plane in which the truth is given.
    along = (200 - fit.point_mm[2]) / fit.axis[2]
    return np.r_[fit.point_mm + along * fit.axis, fit.axis, fit.radius_mm]


def test_the_covariance_is_that_of_many_repetitions() -> None:
    noise, repetitions = 0.02, 300
    for name, fit, clean, truth in surfaces(np.random.default_rng(5), noise):
        rng = np.random.default_rng(7)
        misses, sizes, given_sizes = [], [], []
        for _ in range(repetitions):
            points = clean + rng.normal(0, noise, clean.shape)
            found = fit(points)
            misses.append(parameters(found)[: len(truth)] - truth)
            sizes.append(np.diag(found.covariance))
            given_sizes.append(np.diag(fit(points, sigma_mm=noise).covariance))
        spread = np.sqrt(np.mean(np.square(misses), axis=0))
        stated = np.sqrt(np.mean(sizes, axis=0))
        use = np.isfinite(truth) & (stated > 1e-9)
        assert use.sum() >= 3, name
        # A standard deviation from 300 repetitions is known to 4 %; five times that.
        np.testing.assert_allclose(spread[use], stated[use], rtol=0.2, err_msg=name)
        np.testing.assert_allclose(np.sqrt(np.mean(given_sizes, axis=0))[use], stated[use], rtol=0.05, err_msg=name)


def test_the_fit_moves_with_the_points() -> None:
    rng = np.random.default_rng(11)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    shift = np.array([700.0, -300.0, 90.0])
    for name, fit, clean, _ in surfaces(rng, 0.02):
        points = clean + rng.normal(0, 0.02, clean.shape)
        here, there = fit(points), fit(points @ turn.T + shift)
        assert there.rms_mm == pytest.approx(here.rms_mm, rel=1e-9), name
        point = here.center_mm if isinstance(here, weldscan.SphereFit) else here.point_mm
        moved = there.center_mm if isinstance(there, weldscan.SphereFit) else there.point_mm
        np.testing.assert_allclose(moved, turn @ point + shift, atol=1e-9, err_msg=name)
        block = here.covariance[:3, :3]
        np.testing.assert_allclose(there.covariance[:3, :3], turn @ block @ turn.T, atol=1e-6 * np.abs(block).max())


def test_weights_count_as_repetitions_and_nothing_counts_for_nothing() -> None:
    rng = np.random.default_rng(3)
    for name, fit, clean, truth in surfaces(rng, 0.02):
        points = clean + rng.normal(0, 0.02, clean.shape)
        weights = rng.integers(0, 4, len(points))
        weighted = fit(points, weights=weights)
        repeated = fit(np.repeat(points, weights, axis=0))
        np.testing.assert_allclose(
            parameters(weighted)[: len(truth)], parameters(repeated)[: len(truth)], atol=1e-9, err_msg=name
        )


def test_a_given_radius_is_kept_and_matters() -> None:
    rng = np.random.default_rng(2)
    points = cap(rng, 500, 10, 0.6) + rng.normal(0, 0.05, (500, 3))
    free, fixed = weldscan.fit_sphere(points), weldscan.fit_sphere(points, 10)
    assert fixed.radius_mm == 10.0
    assert fixed.covariance.shape == (3, 3)
    assert free.covariance.shape == (4, 4)
    # A cap of 34° half-angle says much more about the centre when its radius is known.
    assert fixed.covariance[2, 2] < 0.05 * free.covariance[2, 2]
    pipe = arc(rng, 500, 315, 0.5, 100) + rng.normal(0, 0.05, (500, 3))
    assert weldscan.fit_cylinder(pipe, 315).radius_mm == 315.0
    assert weldscan.fit_cylinder(pipe, 315).covariance.shape == (6, 6)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.4, 0.55])
@pytest.mark.parametrize("known", [False, True])
def test_robust_fits_see_through_outliers(share: float, known: bool) -> None:
    rng = np.random.default_rng(int(100 * share))
    n, noise = 4000, 0.05
    stray = rng.random(n) < share
    box = rng.uniform(-1, 1, (n, 3))

    ball = cap(rng, n, 25, math.pi) + rng.normal(0, noise, (n, 3)) + [100, -50, 400]
    ball[stray] = [100, -50, 400] + 40 * box[stray]
    fit = weldscan.fit_sphere(ball, 25.0 if known else None, robust=True)
    # Six standard deviations of the centre of a ball with 1800 points and this noise.
    assert np.abs(fit.center_mm - [100, -50, 400]).max() < 6 * noise * math.sqrt(3 / 1800)
    assert len(np.intersect1d(fit.inliers, np.flatnonzero(~stray))) > 0.98 * (~stray).sum()
    # What is left of the strays lies on the surface by chance: a shell of 0.3 mm in a box of 80 mm.
    assert len(np.intersect1d(fit.inliers, np.flatnonzero(stray))) < 20 + 0.02 * stray.sum()
    again = weldscan.fit_sphere(ball[fit.inliers], 25.0 if known else None)
    np.testing.assert_allclose(again.center_mm, fit.center_mm, atol=1e-9)

    pipe = arc(rng, n, 100, 1.5, 120) + rng.normal(0, noise, (n, 3))
    pipe[stray] += 30 * box[stray]
    fit = weldscan.fit_cylinder(pipe, 100.0 if known else None, robust=True)
    assert angle(fit.axis, np.array([0, 0, 1.0])) < 1e-3
    assert abs(fit.radius_mm - 100) < 0.2
    if not known:
        plate = np.c_[50 * box[:, :2], rng.normal(0, noise, n)]
        plate[stray, 2] = 50 * box[stray, 2]
        plane = weldscan.fit_plane(plate, robust=True)
        assert angle(plane.normal, np.array([0, 0, 1.0])) < 1e-3


def test_robust_fits_are_the_same_for_the_same_seed() -> None:
    rng = np.random.default_rng(1)
    points = np.r_[cap(rng, 3000, 10, 1.5) + rng.normal(0, 0.02, (3000, 3)), rng.uniform(-15, 15, (2000, 3))]
    one, same = (weldscan.fit_sphere(points, robust=True, seed=3) for _ in range(2))
    np.testing.assert_array_equal(one.center_mm, same.center_mm)
    other = weldscan.fit_sphere(points, robust=True, seed=4)
    np.testing.assert_allclose(one.center_mm, other.center_mm, atol=0.005)


def test_the_bits_do_not_depend_on_the_threads() -> None:
    rng = np.random.default_rng(0)
    n = 60_000
    ball = cap(rng, n, 10, 1.0) + rng.normal(0, 0.02, (n, 3)) + [1, 2, 300]
    pipe = arc(rng, n, 315, 1.5, 100) + rng.normal(0, 0.05, (n, 3))
    weights = rng.uniform(0.5, 2, n)
    jobs: list[Callable[[], Any]] = [
        lambda: weldscan.fit_sphere(ball, weights=weights),
        lambda: weldscan.fit_sphere(ball, 10.0, robust=True),
        lambda: weldscan.fit_cylinder(pipe),
        lambda: weldscan.fit_cylinder(pipe, 315.0, robust=True),
        lambda: weldscan.fit_plane(ball),
        lambda: weldscan.fit_plane(ball, robust=True),
    ]
    try:
        for job in jobs:
            seen = []
            for threads in (1, 2, 8):
                weldscan.set_threads(threads)
                fit = job()
                seen.append((parameters(fit).tobytes(), fit.covariance.tobytes(), fit.rms_mm, fit.iterations))
            assert seen[0] == seen[1] == seen[2]
    finally:
        weldscan.set_threads(None)


def test_the_sphere_through_four_points() -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        centre, radius = rng.uniform(-500, 500, 3), 10 ** rng.uniform(-1, 3)
        points = centre + radius * np.array([direction(rng) for _ in range(4)])
        volume = abs(np.linalg.det((points[1:] - points[0]) / radius))
        found, size = weldscan.sphere_through_points(points)
        # The closed form loses the digits that a flat tetrahedron and the offset take.
        tolerance = 1e-12 * (1 + 500 / radius) * radius / volume
        np.testing.assert_allclose(found, centre, atol=tolerance)
        assert size == pytest.approx(radius, abs=tolerance)
        fit = weldscan.fit_sphere(points)
        np.testing.assert_allclose(found, fit.center_mm, atol=tolerance)
        assert np.isnan(fit.covariance).all()
    with pytest.raises(weldscan.GeometryError, match="plane"):
        weldscan.sphere_through_points([[0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]])
    with pytest.raises(weldscan.InputError, match="4 points"):
        weldscan.sphere_through_points(np.eye(3))


def test_another_thread_runs_meanwhile() -> None:
    points = cap(np.random.default_rng(0), 200_000, 10, 1.0)
    ticks, done = [], threading.Event()

    def tick() -> None:
        while not done.wait(0.001):
            ticks.append(time.perf_counter())

    other = threading.Thread(target=tick)
    other.start()
    start = time.perf_counter()
    weldscan.fit_sphere(points, robust=True)
    end = time.perf_counter()
    done.set()
    other.join()
    assert sum(start < t < end for t in ticks) >= 2


FITS: list[Callable[..., Any]] = [weldscan.fit_plane, weldscan.fit_sphere, weldscan.fit_cylinder]


@pytest.mark.parametrize("fit", FITS)
@pytest.mark.parametrize("robust", [False, True])
def test_bad_input_is_refused(fit: Callable[..., Any], robust: bool) -> None:
    good = cap(np.random.default_rng(0), 50, 10, 1.0)
    for bad in (np.zeros((5, 2)), np.zeros(6), np.zeros((2, 2, 3)), "points", None, [[1, 2, "x"]] * 9):
        with pytest.raises(weldscan.InputError):
            fit(bad, robust=robust)
    for value in (np.nan, np.inf, -np.inf):
        spoilt = good.copy()
        spoilt[17, 1] = value
        with pytest.raises(weldscan.InputError, match="points"):
            fit(spoilt, robust=robust)
    line = np.outer(np.arange(20.0), [1, 2, 3]) + 5
    for few in (np.empty((0, 3)), good[:1], good[:2], np.ones((30, 3)), line):
        with pytest.raises(weldscan.GeometryError):
            fit(few, robust=robust)
    for sigma in (0, -1, np.nan):
        with pytest.raises(weldscan.InputError, match="sigma_mm"):
            fit(good, sigma_mm=sigma, robust=robust)


@pytest.mark.parametrize("fit", FITS)
def test_bad_weights_are_refused(fit: Callable[..., Any]) -> None:
    good = cap(np.random.default_rng(0), 50, 10, 1.0)
    for weights in (np.ones(49), np.ones((50, 1)), np.full(50, np.nan), -np.ones(50)):
        with pytest.raises(weldscan.InputError, match="weights"):
            fit(good, weights=weights)
    with pytest.raises(weldscan.GeometryError):
        fit(good, weights=np.zeros(50))
    with pytest.raises(weldscan.InputError, match="weights"):
        fit(good, weights=np.ones(50), robust=True)


@pytest.mark.parametrize("fit", FITS[1:])
def test_flat_points_and_bad_radii_are_refused(fit: Callable[..., Any]) -> None:
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    flat = np.c_[rng.uniform(-10, 10, (40, 2)), np.zeros(40)]
    for points in (flat, flat @ turn + [100, 200, 300], flat[:6]):
        with pytest.raises(weldscan.GeometryError):
            fit(points)
    for radius in (0, -1, np.nan, np.inf):
        with pytest.raises(weldscan.InputError, match="radius_mm"):
            fit(rng.normal(size=(50, 3)), radius)


@pytest.mark.parametrize("fit", FITS)
def test_whatever_numpy_takes_is_taken(fit: Callable[..., Any]) -> None:
    rng = np.random.default_rng(0)
    points = arc(rng, 60, 10, 2, 30) + rng.normal(0, 0.01, (60, 3))
    first = parameters(fit(points))
    locked = points.copy()
    locked.flags.writeable = False
    wide = np.zeros((120, 4))
    wide[::2, :3] = points
    for same in (locked, np.asfortranarray(points), wide[::2, :3], points.tolist()):
        np.testing.assert_array_equal(parameters(fit(same)), first)
    np.testing.assert_allclose(parameters(fit(points.astype(np.float32))), first, atol=1e-3)


@settings(max_examples=150, deadline=None)
@given(
    points=st.lists(
        st.tuples(*[st.one_of(st.floats(), st.integers(-2, 2).map(float), st.floats(-1e3, 1e3))] * 3), max_size=12
    ),
    radius=st.one_of(st.none(), st.floats()),
    robust=st.booleans(),
)
def test_any_input_has_an_answer_or_a_typed_error(
    points: list[tuple[float, float, float]], radius: float | None, robust: bool
) -> None:
    cloud = np.array(points, dtype=float).reshape(-1, 3)
    for call in (
        lambda: weldscan.fit_plane(cloud, robust=robust),
        lambda: weldscan.fit_sphere(cloud, radius, robust=robust),
        lambda: weldscan.fit_cylinder(cloud, radius, robust=robust),
        lambda: weldscan.sphere_through_points(cloud),
        lambda: weldscan.find_spheres(cloud, 1.0 if radius is None else radius),
    ):
        try:
            call()
        except (weldscan.InputError, weldscan.GeometryError) as error:
            assert str(error)
