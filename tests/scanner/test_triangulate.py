"""Triangulation against points projected with OpenCV."""

import cv2
import numpy as np
import pytest

from weldscan import InputError, Lens, Scanner, set_threads, triangulate

POINT_ROUNDING_MM = 1e-7  # 1e-11 in normalised coordinates at 420 mm, doubled by the slope of the ray
CAMERA = (640, 480, [[1552, 0, 315], [0, 1553, 244], [0, 0, 1]], [-0.21, 0.35, -0.0007, 0.0005, 0.02])
PROJECTOR = (912, 1140, [[1640, 0, 455.5], [0, 3280, 610.0], [0, 0, 1]], [-0.05, 0.04, 6e-4, -2e-4])


def scanner(baseline=(165.0, -12, 8)):
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.03, -0.36, 0.02]))[0]
    if abs(baseline[1]) > abs(baseline[0]):
        pose[:3, :3] = cv2.Rodrigues(np.array([-0.36, 0.03, 0.02]))[0]
    pose[:3, 3] = baseline
    return Scanner(Lens(*CAMERA), Lens(*PROJECTOR), pose)


def scene(s):
    """A wavy surface as the camera sees it, and the projector pixel of each point, with OpenCV's lens on both sides."""
    v, u = np.mgrid[:480, :640].astype(float)
    pixels = np.stack([u, v], -1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-15)
    rays = cv2.undistortPointsIter(
        pixels, np.array(CAMERA[2]), np.array(CAMERA[3]), np.eye(3), np.eye(3), criteria
    ).reshape(480, 640, 2)
    depth = 420 + 10 * np.sin(u / 40) + 0.05 * v
    points = np.dstack([rays, np.ones((480, 640))]) * depth[..., None]
    pose = np.linalg.inv(s.camera_from_projector)
    inside = points.reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
    projected = cv2.projectPoints(inside, np.zeros(3), np.zeros(3), np.array(PROJECTOR[2]), np.array(PROJECTOR[3]))
    return points, projected[0].reshape(480, 640, 2)


@pytest.mark.parametrize(("axis", "baseline"), [("x", (165.0, -12, 8)), ("y", (10.0, -150, 8))])
def test_points_come_back(axis, baseline):
    s = scanner(baseline)
    points, projected = scene(s)
    lit = (projected >= -0.5).all(-1) & (projected <= np.array(PROJECTOR[:2]) - 0.5).all(-1)
    cloud = triangulate(projected[..., "xy".index(axis)], s, axis=axis)
    assert lit.sum() > 100_000
    assert np.array_equal(np.isfinite(cloud.points_mm[..., 2]), lit)
    assert np.abs(cloud.points_mm - points)[lit].max() < POINT_ROUNDING_MM
    assert cloud.sigma_mm is None
    assert str(lit.sum()) in repr(cloud)


def test_sigma_covers_the_scatter():
    s = scanner()
    points, projected = scene(s)
    rng = np.random.default_rng(1)
    sigma = np.full((480, 640), 0.05, np.float32)
    noisy = projected[..., 0] + 0.05 * rng.standard_normal((480, 640))
    cloud = triangulate(noisy, s, sigma)
    assert cloud.sigma_mm is not None
    error = np.linalg.norm(cloud.points_mm - points, axis=-1) / cloud.sigma_mm
    assert abs(np.sqrt(np.nanmean(error**2)) - 1) < 0.01


def test_bad_input_is_named():
    s = scanner()
    good = np.full((480, 640), np.nan)
    for column, sigma, axis in (
        (good[:-1], None, "x"),
        (good[0], None, "x"),
        (good, good[:, :-1], "x"),
        (good, "sigma", "x"),
        (good, None, "z"),
        ("column", None, "x"),
        (good.astype(complex), None, "x"),
    ):
        with pytest.raises(InputError):
            triangulate(column, s, sigma, axis)


def test_lists_and_single_precision_and_strided_arrays_are_taken():
    s = scanner()
    _, projected = scene(s)
    expected = triangulate(np.ascontiguousarray(projected[..., 0]), s).points_mm
    assert np.array_equal(triangulate(projected[..., 0], s).points_mm, expected, equal_nan=True)
    assert np.array_equal(triangulate(projected[..., 0].tolist(), s).points_mm, expected, equal_nan=True)
    assert triangulate(projected[..., 0].astype(np.float32), s).points_mm.dtype == np.float64


def test_the_same_bits_on_any_number_of_threads():
    s = scanner()
    _, projected = scene(s)
    try:
        runs = []
        for threads in (1, 2, 8):
            set_threads(threads)
            runs.append(triangulate(projected[..., 0], s).points_mm.tobytes())
        assert runs[0] == runs[1] == runs[2]
    finally:
        set_threads(None)
