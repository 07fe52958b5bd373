import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import weldscan
from weldscan import Cylinder, GeometryError, InputError, KdTree, Plane, Sphere, register_icp

RADIUS = 110.0
ROUNDING = 1e-9  # mm: some rounds on coordinates of some 100 mm


def pose(rotation_deg, translation):
    t = np.eye(4)
    t[:3, :3], t[:3, 3] = Rotation.from_rotvec(rotation_deg, degrees=True).as_matrix(), translation
    return t


def moved(points, transform):
    return points @ transform[:3, :3].T + transform[:3, 3]


def pipe(n=80, radius=RADIUS):
    angle, z = np.meshgrid(np.linspace(0, 1.6, n), np.linspace(0, 200, n))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1).reshape(-1, 3)


def relief(n=100):
    """A surface without a symmetry, and its normals."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, 60, n), np.linspace(0, 60, n)))
    points = np.stack([x, y, 6 * np.sin(x / 9) + 5 * np.cos(y / 7)], -1)
    slope = np.stack([-6 / 9 * np.cos(x / 9), 5 / 7 * np.sin(y / 7), np.ones_like(x)], -1)
    return points, slope / np.linalg.norm(slope, axis=1, keepdims=True)


def test_cylinder_from_five_degrees_and_five_millimetres_off():
    rng = np.random.default_rng(1)
    source = pipe() + rng.normal(size=(6400, 3)) * 0.02
    start = pose([3, -4, 0], [3, -4, 0])
    found = register_icp(moved(source, start), Cylinder([0, 0, 0], [0, 0, 1], RADIUS), "plane")
    assert found.converged
    aligned = moved(moved(source, start), found.target_from_source)
    radial = np.hypot(aligned[:, 0], aligned[:, 1]) - RADIUS
    assert found.rms_mm == pytest.approx(np.sqrt(np.mean(radial**2)), rel=1e-9)
    assert found.rms_mm == pytest.approx(0.02, rel=0.03)
    assert [w.kind for w in found.unobserved] == ["translation", "rotation"]
    along, around = found.unobserved
    assert np.abs(along.vector / np.sign(along.axis[2]) - [0, 0, 0, 0, 0, 1]).max() < ROUNDING
    assert np.abs(around.vector / np.sign(around.axis[2]) - [0, 0, 1, 0, 0, 0]).max() < ROUNDING
    assert along.point_mm is None
    assert np.hypot(*around.point_mm[:2]) < 1e-6
    # The other four directions are those of the analytic solve: here the residual is flat.
    normals = aligned * [1, 1, 0] / np.hypot(aligned[:, 0], aligned[:, 1])[:, None]
    gradient = np.concatenate([np.cross(aligned, normals), normals], 1).T @ radial / len(radial)
    assert np.abs(gradient).max() < ROUNDING
    # No drift: started there, it stays there.
    again = register_icp(
        moved(source, start),
        Cylinder([0, 0, 0], [0, 0, 1], RADIUS),
        "plane",
        start=found.target_from_source,
        tolerance_mm=0,
        max_iterations=500,
    )
    assert np.abs(again.target_from_source - found.target_from_source).max() < ROUNDING


def test_step_between_two_walls_after_registering_one():
    """The point of it all: the other wall's radial distance is the step, whatever the start."""
    step = 0.47
    walls = pipe(), pipe(radius=RADIUS + step)
    for start in (pose([3, -4, 0], [3, -4, 0]), pose([-2, 4, 2], [-1, 4, 3])):
        found = register_icp(moved(walls[0], start), Cylinder([0, 0, 0], [0, 0, 1], RADIUS), "plane")
        other = moved(moved(walls[1], start), found.target_from_source)
        assert np.hypot(other[:, 0], other[:, 1]).mean() - RADIUS == pytest.approx(step, abs=1e-8)


@pytest.mark.parametrize("metric", ["point", "plane"])
def test_a_known_motion_is_found(metric):
    target, normals = relief()
    truth = pose([0.6, -1.1, 0.8], [0.3, -0.2, 0.2])
    source = moved(target, np.linalg.inv(truth))
    found = register_icp(source, target, metric, normals=normals)
    assert found.converged
    assert np.abs(found.target_from_source - truth).max() < 1e-6
    assert np.linalg.det(found.target_from_source[:3, :3]) == pytest.approx(1, abs=1e-14)
    assert np.array_equal(found.inliers, np.arange(len(source)))
    assert found.unobserved == []
    same = register_icp(source, KdTree(target), metric, normals=normals)
    assert np.array_equal(same.target_from_source, found.target_from_source)


def test_options_do_what_they_say():
    target, normals = relief()
    truth = pose([0.1, -0.2, 0.1], [0.05, -0.1, 0.1])
    source = moved(target, np.linalg.inv(truth))
    outliers = np.arange(0, len(source), 9)
    source[outliers, 2] += 2.0

    def error(**options):
        found = register_icp(source, target, "plane", normals=normals, **options)
        return np.abs(found.target_from_source - truth).max(), found

    assert error()[0] > 0.02
    for options in (
        {"trim": 0.15},
        {"max_distance_mm": 1.0},
        {"kernel": "tukey"},
        {"kernel": "tukey", "kernel_mm": 0.3},
    ):
        wrong, found = error(**options)
        assert wrong < 1e-5, options
        assert not np.isin(found.inliers, outliers).any()
    assert error(kernel="huber", kernel_mm=0.01)[0] < 0.01
    some = register_icp(source, target, "plane", normals=normals, max_points=500, trim=0.15)
    assert len(some.inliers) <= 500
    assert error(max_iterations=1)[1].iterations == 1
    assert not error(max_iterations=1)[1].converged


def test_plane_and_sphere_leave_their_own_motions_free():
    points, _ = relief(30)
    kinds = [w.kind for w in register_icp(points, Plane([0, 0, 0], [0, 0, 1]), "plane").unobserved]
    assert kinds == ["translation", "translation", "rotation"]
    kinds = [w.kind for w in register_icp(points, Sphere([30, 30, -90], 95), "plane").unobserved]
    assert kinds == ["rotation"] * 3


def test_covariance_covers_the_error():
    target, normals = relief()
    rng = np.random.default_rng(3)
    within = 0
    for _ in range(50):
        source = target + rng.normal(size=target.shape) * 0.01
        found = register_icp(source, target, "plane", normals=normals)
        error = np.r_[
            Rotation.from_matrix(found.target_from_source[:3, :3]).as_rotvec(), found.target_from_source[:3, 3]
        ]
        within += error @ np.linalg.solve(found.covariance, error) < 12.59  # chi2, 6 dof, 95 %
    assert within >= 43


def test_same_bits_on_any_number_of_threads():
    target, normals = relief(220)
    source = moved(target, pose([0.3, 0.2, 0.1], [0.1, 0.1, 0.1]))
    answers = []
    for threads in (1, 2, 8):
        weldscan.set_threads(threads)
        found = register_icp(source, target, "plane", normals=normals, trim=0.1, kernel="huber")
        answers.append((found.target_from_source.tobytes(), found.covariance.tobytes(), found.inliers.tobytes()))
    weldscan.set_threads(None)
    assert len(set(answers)) == 1


def test_bad_input_is_refused():
    target, normals = relief(10)
    for options in (
        {"metric": "line"},
        {"kernel": "welsch"},
        {"kernel": "tukey", "kernel_mm": -1},
        {"trim": 1},
        {"trim": -0.1},
        {"max_distance_mm": 0},
        {"max_distance_mm": np.nan},
        {"max_iterations": 0},
        {"max_points": -5},
        {"weak": 2},
        {"tolerance_mm": np.inf},
        {"start": np.eye(3)},
        {"start": np.diag([1, 1, -1, 1])},
        {"normals": normals[1:]},
    ):
        with pytest.raises(InputError):
            register_icp(target, target, **options)
    for source in ([[0, 0, np.nan]] * 3, np.zeros((4, 2)), "cloud"):
        with pytest.raises(InputError, match="source"):
            register_icp(source, target)
        with pytest.raises(InputError, match="target"):
            register_icp(target, source)
    with pytest.raises(GeometryError):
        register_icp(target[:2], target)
    with pytest.raises(GeometryError, match="pairs"):
        register_icp(target + 1e6, target, max_distance_mm=1)
    for make in (
        lambda: Plane([0, 0, 0], [0, 0, np.nan]),
        lambda: Sphere([0, 0, 0], -1),
        lambda: Cylinder([0, 0], [0, 0, 1], 1),
    ):
        with pytest.raises(InputError):
            make()
    for make in (lambda: Plane([0, 0, 0], [0, 0, 0]), lambda: Cylinder([0, 0, 0], [0, 0, 0], 1)):
        with pytest.raises(GeometryError):
            make()
