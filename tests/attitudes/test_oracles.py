"""Random inputs against oracles plainer than the code: NumPy, a loop over everything, OpenCV. What has such a test in a
file of its own is not repeated here."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import weldscan as ws
from catalogue import weld_shot

SEEDS = st.integers(0, 2**32 - 1)
ROUNDING = 1e-12
"""Of numbers of some hundred, relative: a thousand units in the last place."""
few = settings(max_examples=40, deadline=None)


def pose(rng: np.random.Generator, turn: float = 1.0, shift: float = 50.0) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(rng.normal(size=3) * turn).as_matrix()
    out[:3, 3] = rng.normal(size=3) * shift
    return out


def moved(points: np.ndarray, transform: np.ndarray) -> np.ndarray:
    return points @ transform[:3, :3].T + transform[:3, 3]


def lens(rng: np.random.Generator) -> ws.Lens:
    k = [[rng.uniform(1500, 3000), 0, 640 + rng.normal() * 20], [0, rng.uniform(1500, 3000), 480], [0, 0, 1]]
    return ws.Lens(1280, 960, k, np.r_[rng.normal(size=2) * 0.1, rng.normal(size=2) * 1e-3, rng.normal() * 0.1])


@few
@given(SEEDS)
def test_lenses_are_opencvs_there_and_back(seed):
    rng = np.random.default_rng(seed)
    one = lens(rng)
    pixels = rng.random((50, 2)) * [1280, 960]
    rays = np.c_[one.undistort(pixels), np.ones(50)]
    real = np.isfinite(rays[:, 0])  # a strong lens may fold in a corner
    points = rays[real] * rng.uniform(10, 900, (real.sum(), 1))
    assert np.abs(one.project(points) - pixels[real]).max(initial=0) < 1e-7
    if real.any():
        theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), one.K, np.array(one.dist))
        assert np.abs(theirs[:, 0] - pixels[real]).max() < 1e-7


@few
@given(SEEDS)
def test_the_projectors_pixels_are_those_of_points_moved_by_hand(seed):
    rng = np.random.default_rng(seed)
    scanner = ws.Scanner(lens(rng), lens(rng), pose(rng, 0.2, 100.0))
    points = rng.normal(size=(40, 3)) * 30 + [0, 0, 500]
    by_hand = scanner.projector.project(moved(points, np.linalg.inv(scanner.camera_from_projector)))
    found = scanner.project_to_projector(points)
    assert np.allclose(found, by_hand, rtol=1e-9, atol=1e-6, equal_nan=True)


@few
@given(SEEDS)
def test_triangulated_points_are_seen_at_their_pixel_and_lit_by_their_column(seed):
    rng = np.random.default_rng(seed)
    k = [[400.0, 0, 20], [0, 400, 15], [0, 0, 1]]
    camera = ws.Lens(40, 30, k, rng.normal(size=4) * [0.1, 0.1, 1e-3, 1e-3])
    projector = ws.Lens(
        1280, 800, [[2000, 0, 640], [0, 2000, 400], [0, 0, 1]], rng.normal(size=4) * [0.1, 0.1, 1e-3, 1e-3]
    )
    there = pose(rng, 0.02, 0.0)
    there[:3, :3] = there[:3, :3] @ Rotation.from_euler("y", -0.35).as_matrix()
    there[:3, 3] = rng.normal(size=3) * 5 + [150, 0, 10]
    scanner = ws.Scanner(camera, projector, there)
    column = rng.uniform(0, 1279, (30, 40))
    points = ws.triangulate(column, scanner).points_mm
    v, u = np.nonzero(np.isfinite(points[..., 2]))
    assert len(u) > 100
    assert np.abs(camera.project(points[v, u]) - np.c_[u, v]).max() < 1e-7
    assert np.abs(scanner.project_to_projector(points[v, u])[:, 0] - column[v, u]).max() < 1e-6


@few
@given(SEEDS, st.floats(1, 500), st.floats(100, 900), st.floats(0.5, 50))
def test_heights_are_those_of_the_similar_triangles(seed, baseline, away, period):
    rng = np.random.default_rng(seed)
    reference = rng.random((7, 9)) * 60
    height = rng.uniform(-0.4, 0.4, (7, 9)) * away
    # CA = baseline * height / (distance - height) on the reference plane, in periods of 2 pi.
    phase = reference - 2 * np.pi / period * baseline * height / (away - height)
    found = ws.height_from_reference(phase, reference, baseline_mm=baseline, distance_mm=away, period_mm=period)
    assert np.allclose(found, height, rtol=1e-9, atol=1e-9 * away)


@few
@given(SEEDS)
def test_analytic_distances_are_numpys(seed):
    rng = np.random.default_rng(seed)
    at, direction, radius = rng.normal(size=3) * 50, rng.normal(size=3), rng.uniform(0.1, 300)
    direction /= np.linalg.norm(direction)
    points = rng.normal(size=(60, 3)) * 10.0 ** rng.uniform(-1, 3)
    off = points - at
    along = off @ direction
    expected = {
        ws.Plane(at, direction): along,
        ws.Sphere(at, radius): np.linalg.norm(off, axis=1) - radius,
        ws.Cylinder(at, direction, radius): np.linalg.norm(off - np.outer(along, direction), axis=1) - radius,
    }
    for target, truth in expected.items():
        size = np.abs(off).max() + radius
        assert np.abs(ws.distance(points, target) - truth).max() < 10 * ROUNDING * size
        assert np.array_equal(ws.distance(points, target, signed=False), np.abs(ws.distance(points, target)))


@few
@given(SEEDS)
def test_distances_to_a_cloud_are_those_of_a_loop(seed):
    rng = np.random.default_rng(seed)
    cloud, points = rng.normal(size=(rng.integers(1, 80), 3)), rng.normal(size=(30, 3))
    normals = rng.normal(size=cloud.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    apart = np.linalg.norm(points[:, None] - cloud, axis=2)
    nearest = apart.argmin(1)
    assert np.allclose(ws.distance(points, cloud, signed=False), apart.min(1), rtol=ROUNDING)
    side = np.einsum("ij,ij->i", points - cloud[nearest], normals[nearest])
    assert np.allclose(ws.distance(points, cloud, normals=normals), np.where(side < 0, -1, 1) * apart.min(1))


@few
@given(SEEDS)
def test_a_follower_gives_what_a_loop_gives_however_far_the_queries_move(seed):
    rng = np.random.default_rng(seed)
    points = np.round(rng.normal(size=(rng.integers(1, 200), 3)) * 4)  # many ties
    queries = rng.normal(size=(40, 3)) * 4
    follower = ws.Follower(ws.KdTree(points))
    for step in (0.0, 1e-6, 1e-2, 0.5, 10.0, 0.1):
        queries = queries + rng.normal(size=queries.shape) * step
        distance, index = follower.nearest(queries)
        squares = ((points - queries[:, None]) ** 2).sum(2)
        assert np.array_equal(index, squares.argmin(1))
        assert np.allclose(distance**2, squares.min(1), rtol=ROUNDING)


@few
@given(SEEDS, st.booleans())
def test_no_cylinder_nearby_fits_better(seed, known):
    rng = np.random.default_rng(seed)
    radius, n = 10.0 ** rng.uniform(0, 3), rng.integers(12, 400)
    angle, z = rng.uniform(0, rng.uniform(1.5, 6.2), n), rng.uniform(-2, 2, n) * radius
    r = radius * (1 + 1e-4 * rng.normal(size=n))
    points = moved(np.c_[r * np.cos(angle), r * np.sin(angle), z], pose(rng, 2.0, radius))

    def cost(point: np.ndarray, axis: np.ndarray, size: float) -> float:
        off = points - point
        return float(((np.linalg.norm(off - np.outer(off @ axis, axis), axis=1) - size) ** 2).sum())

    fit = ws.fit_cylinder(points, radius if known else None)
    least = cost(fit.point_mm, fit.axis, fit.radius_mm)
    assert fit.rms_mm == pytest.approx(np.sqrt(least / n), rel=1e-6)
    for _ in range(20):
        axis = fit.axis + rng.normal(size=3) * 1e-4
        size = fit.radius_mm + (0.0 if known else rng.normal() * 1e-4 * radius)
        near = cost(fit.point_mm + rng.normal(size=3) * 1e-4 * radius, axis / np.linalg.norm(axis), size)
        assert near >= least * (1 - 1e-9)


@few
@given(SEEDS, st.sampled_from(["point", "plane"]), st.sampled_from([None, "huber"]))
def test_where_a_registration_rests_a_plain_gauss_newton_step_is_nothing(seed, metric, kernel):
    rng = np.random.default_rng(seed)
    x, y = rng.random((2, 400)) * 20
    target = np.c_[x, y, 2 * np.sin(x / 3) + 2 * np.cos(y / 4)]
    slope = np.c_[-2 / 3 * np.cos(x / 3), 2 / 4 * np.sin(y / 4), np.ones(400)]
    normals = slope / np.linalg.norm(slope, axis=1, keepdims=True)
    source = moved(target[::3] + rng.normal(size=target[::3].shape) * 0.02, pose(rng, 0.01, 0.05))
    options = {"kernel": kernel, "kernel_mm": 0.02} if kernel else {}
    found = ws.register_icp(source, target, metric, normals=normals, max_iterations=500, tolerance_mm=1e-10, **options)
    assert found.converged
    points = moved(source, found.target_from_source)
    partner = np.linalg.norm(points[:, None] - target, axis=2).argmin(1)
    miss = points - target[partner]
    rows = np.concatenate([-np.cross(np.eye(3), points[:, None]), np.tile(np.eye(3), (len(points), 1, 1))], 2)
    rows = np.einsum("nij,nj->nij", np.eye(3) + 0 * rows[..., :3], np.ones((len(points), 3))) @ rows
    size = np.linalg.norm(miss, axis=1)
    if metric == "plane":
        rows = np.einsum("ni,nij->nj", normals[partner], rows)[:, None]
        miss = np.einsum("ni,ni->n", normals[partner], miss)[:, None]
        size = np.abs(miss[:, 0])
    weight = np.minimum(1, 0.02 / np.maximum(size, 1e-300)) if kernel else np.ones(len(points))
    assert found.rms_mm == pytest.approx(np.sqrt((size**2).mean()), rel=1e-6)
    matrix = np.einsum("n,nia,nib->ab", weight, rows, rows)
    step = np.linalg.solve(matrix, np.einsum("n,nia,ni->a", weight, rows, miss))
    assert np.abs(step).max() < 1e-7


@few
@given(SEEDS)
def test_four_points_on_a_sphere_give_it_back(seed):
    rng = np.random.default_rng(seed)
    center, radius = rng.normal(size=3) * 100, 10.0 ** rng.uniform(-1, 3)
    d = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = center + radius * np.vstack([d, -d[:1]])
    found, size = ws.sphere_through_points(points)
    assert np.abs(found - center).max() < 1e-9 * (radius + 100) and size == pytest.approx(radius, rel=1e-9)


@few
@given(SEEDS, st.booleans())
def test_a_ball_is_found_wherever_it_stands(seed, grid):
    rng = np.random.default_rng(seed)
    radius, center = 10.0, np.r_[rng.uniform(-15, 15, 2), 400]
    v, u = np.mgrid[:120, :160] * 0.5
    ray = np.stack([u - 40, v - 30, np.full(u.shape, 400.0)], -1) / 400
    b, a = ray @ center, (ray**2).sum(-1)
    root = b**2 - a * (center @ center - radius**2)
    depth = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, 425.0)
    points = ray * (depth + rng.normal(size=depth.shape) * 0.01)[..., None]
    (found,) = ws.find_spheres(points if grid else points.reshape(-1, 3), radius)
    assert np.abs(found.center_mm - center).max() < 0.01
    residual = np.abs(np.linalg.norm(points.reshape(-1, 3)[found.inliers] - center, axis=1) - radius)
    assert residual.max() < 0.1


@few
@given(st.integers(1, 40), st.integers(1, 40), SEEDS, st.sampled_from([np.uint8, np.uint16]))
def test_images_are_read_as_opencv_reads_them(height, width, seed, kind):
    image = np.random.default_rng(seed).integers(0, np.iinfo(kind).max, (height, width), kind, endpoint=True)
    data = cv2.imencode(".png", image)[1].tobytes()
    assert np.array_equal(ws.decode_png(data), image) and np.array_equal(
        cv2.imdecode(np.frombuffer(data, np.uint8), -1), image
    )


def test_placed_points_are_the_shots_points_moved_by_hand():
    points = weld_shot(0.5)
    shot = ws.segment_weld(points, 315.0, 6.0)
    rng = np.random.default_rng(1)
    transforms = [pose(rng), pose(rng)]
    step = ws.measure_step([shot, shot])
    placed, label, deviation, angle_deg, axial, number, counts = ws.place_shots(
        step, [(shot, t, 4 + i) for i, t in enumerate(transforms)]
    )
    kept = np.isfinite(shot.deviation_mm)
    assert 0 < kept.sum() < kept.size
    flat = points.reshape(-1, 3)[kept]
    # The shot keeps its points in single precision.
    assert np.abs(placed - np.vstack([moved(flat, t) for t in transforms])).max() < 1e-4
    assert np.abs(shot.points_mm(np.flatnonzero(kept)) - flat).max() < 1e-4
    assert counts == (2 * np.bincount(shot.labels[kept], minlength=5)).tolist()
    assert np.array_equal(label, np.tile(shot.labels[kept], 2))
    each = [step.deviation_of(shot, k) for k in range(2)]
    assert np.array_equal(deviation, np.concatenate([d[kept] for d in each]))
    assert np.array_equal(axial, np.tile(shot.axial_mm[kept], 2))
    assert np.allclose(np.cos(np.radians(angle_deg)), np.cos(np.tile(shot.angle_rad[kept], 2)), atol=1e-5)
    assert np.array_equal(number, np.repeat([4, 5], kept.sum()))
