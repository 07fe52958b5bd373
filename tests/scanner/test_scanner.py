import cv2
import numpy as np
import pytest

from weldscan import GeometryError, InputError, Lens, Scanner

PIXEL_ROUNDING = 1e-9  # px: f64 through Newton to 1e-12 at f = 3000
K = np.array([[3105, 0, 631.2], [0, 3106, 489.9], [0, 0, 1]])
DIST = [-0.21, 0.35, -0.0007, 0.0005, 0.1]


@pytest.fixture
def lens():
    return Lens(1280, 960, K, DIST)


def some_points():
    rng = np.random.default_rng(1)
    return rng.uniform([-80, -60, 300], [80, 60, 500], (1000, 3))


def test_project_is_opencvs(lens):
    points = some_points()
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(DIST))[0].reshape(-1, 2)
    assert np.abs(lens.project(points) - expected).max() < PIXEL_ROUNDING


def test_undistort_undoes_project(lens):
    points = some_points()
    rays = lens.undistort(lens.project(points))
    assert np.abs(rays * points[:, 2:] - points[:, :2]).max() * 3105 / 300 < PIXEL_ROUNDING


def test_attributes_come_back(lens):
    assert (lens.width, lens.height) == (1280, 960)
    assert np.array_equal(lens.K, K)
    assert lens.dist == DIST
    assert lens == Lens(1280, 960, K.tolist(), np.array(DIST))
    assert lens != Lens(1280, 960, K, DIST[:4])


def test_behind_the_device_is_nan(lens):
    assert np.isnan(lens.project([[0, 0, -1.0]])).all()


def test_the_projector_sees_what_its_pose_says(lens):
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.02, -0.3, 0.01]))[0]
    pose[:3, 3] = [150, -5, 7]
    scanner = Scanner(lens, lens, pose)
    points = some_points()
    inside = (points - pose[:3, 3]) @ pose[:3, :3]
    assert np.allclose(scanner.project_to_projector(points), lens.project(inside), atol=PIXEL_ROUNDING)
    assert np.array_equal(scanner.camera_from_projector, pose)
    assert scanner.camera == lens
    assert "Scanner(" in repr(scanner)


@pytest.mark.parametrize(
    "arguments",
    [
        (0, 5, K, DIST),
        (5, 5, K[:2], DIST),
        (5, 5, K * [[1], [-1], [1]], DIST),
        (5, 5, np.add(K, [[0, 1, 0], [0, 0, 0], [0, 0, 0]]), DIST),
        (5, 5, K, [0, 0, np.nan, 0]),
        (5, 5, K, [0, 0, 0]),
        (5, 5, K, ["a", "b", "c", "d"]),
        (5, 5, "K", DIST),
        (5, 5, None, DIST),
    ],
)
def test_impossible_lenses_are_refused(arguments):
    with pytest.raises(InputError):
        Lens(*arguments)


def test_a_mirror_and_a_scanner_without_baseline_are_refused(lens):
    with pytest.raises(InputError, match="reflection"):
        Scanner(lens, lens, np.diag([-1.0, 1, 1, 1]))
    with pytest.raises(GeometryError, match="same place"):
        Scanner(lens, lens, np.eye(4))
