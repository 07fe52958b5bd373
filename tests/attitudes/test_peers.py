"""The same answers as other people's libraries give. Skipped, with the reason, where a peer is not installed."""

from __future__ import annotations

import numpy as np
import pytest

import weldscan as ws

SAME_MINIMUM_MM = 1e-6
"""Both stop where a step is far below this; further than that a pose is not determined by rounding."""


def relief(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A surface without a symmetry, and its normals."""
    x, y = np.random.default_rng(seed).random((2, n)) * 100
    points = np.c_[x, y, 6 * np.sin(x / 19) + 5 * np.cos(y / 27)]
    slope = np.c_[-6 / 19 * np.cos(x / 19), 5 / 27 * np.sin(y / 27), np.ones(n)]
    return points, slope / np.linalg.norm(slope, axis=1, keepdims=True)


@pytest.mark.parametrize("noise_mm", [0.0, 0.05])
def test_plane_icp_ends_where_open3ds_ends(noise_mm):
    o3d = pytest.importorskip("open3d", reason="open3d is not installed (weldscan[peers])")
    target, normals = relief(20_000, 1)
    rng = np.random.default_rng(2)
    truth = np.eye(4)
    truth[:3, :3] = np.linalg.qr(np.eye(3) + 0.02 * rng.normal(size=(3, 3)))[0]
    truth[:3, :3] *= np.sign(np.diag(truth[:3, :3]))
    truth[:3, 3] = [0.4, -0.3, 0.5]
    source = (relief(10_000, 3)[0] - truth[:3, 3]) @ truth[:3, :3] + rng.normal(size=(10_000, 3)) * noise_mm
    reach_mm = 5.0
    ours = ws.register_icp(
        source, target, "plane", normals=normals, max_distance_mm=reach_mm, max_iterations=300, tolerance_mm=1e-10
    )
    assert ours.converged
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in (source, target)]
    clouds[1].normals = o3d.utility.Vector3dVector(normals)
    registration = o3d.pipelines.registration
    theirs = registration.registration_icp(
        *clouds,
        reach_mm,
        np.eye(4),
        registration.TransformationEstimationPointToPlane(),
        registration.ICPConvergenceCriteria(1e-16, 1e-16, 300),
    ).transformation
    # Where the poses take the corners of the part.
    corners = np.array([[x, y, z, 1] for x in (0, 100) for y in (0, 100) for z in (-11, 11)]).T
    assert np.abs(ours.target_from_source @ corners - theirs @ corners).max() < SAME_MINIMUM_MM
    assert np.abs(theirs - np.eye(4)).max() > 0.1


@pytest.mark.parametrize("kind", ["random", "lattice", "duplicates", "collinear", "far from the origin"])
@pytest.mark.parametrize("n", [1, 10, 1000, 100_000])
def test_nearest_neighbours_are_as_far_as_pykdtrees(kind, n):
    pykdtree = pytest.importorskip("pykdtree.kdtree", reason="pykdtree is not installed (weldscan[peers])")
    rng = np.random.default_rng(n)
    points = rng.random((n, 3)) * 100
    if kind == "lattice":
        side = int(np.ceil(n ** (1 / 3)))
        points = np.stack(np.meshgrid(*[np.arange(side)] * 3), -1).reshape(-1, 3)[:n].astype(float)
    elif kind == "duplicates":
        points = points[rng.integers(0, max(1, n // 10), n)]
    elif kind == "collinear":
        points = points[:, :1] * [1.0, 2.0, -0.5]
    elif kind == "far from the origin":
        points += 1e6
    queries = points[rng.integers(0, n, 2000)] + rng.normal(size=(2000, 3))
    ours, index = ws.KdTree(points).nearest(queries)
    theirs, _ = pykdtree.KDTree(points).query(queries, k=1)
    # Squares are added in another order there: some units in the last place of coordinates.
    assert np.allclose(ours, theirs, rtol=1e-12, atol=0)
    assert np.allclose(np.linalg.norm(points[index] - queries, axis=1), theirs, rtol=1e-12, atol=0)
