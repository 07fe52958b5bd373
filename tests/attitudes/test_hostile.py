"""Bad input, case by case: a typed error that says what is wrong, or the documented answer. `fuzz.py` does the rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import weldscan as ws
from catalogue import ball, bits, sphere_mesh, tube
from weldscan.simulated import Block, Body, Photometry

TREE = ws.KdTree(ball(50))
MESH = ws.Mesh(*sphere_mesh(6))
SCANNER_LENS = ws.Lens(16, 12, np.diag([20.0, 20.0, 1.0]), np.zeros(4))


def simulate(**block: Any) -> Any:
    body = Body(replace(Block((30.0, 30.0, 5.0)), **block), np.eye(4))
    scanner = ws.Scanner(SCANNER_LENS, SCANNER_LENS, np.eye(4) + np.eye(4, k=3))
    return ws.simulate_shot(scanner, np.eye(4), [body], [], Photometry())


# By name: the call on (n, 3) points, sane points, and the fewest points it takes (0: none are as good as any).
Call = Callable[[Any], Any]
POINTS: dict[str, tuple[Call, np.ndarray, int]] = {
    "fit_plane": (ws.fit_plane, ball(50) * [1, 1, 0.001], 3),
    "fit_plane, robust": (lambda p: ws.fit_plane(p, robust=True), ball(50) * [1, 1, 0.001], 3),
    "fit_sphere": (ws.fit_sphere, ball(50), 4),
    "fit_sphere, robust": (lambda p: ws.fit_sphere(p, robust=True), ball(50), 4),
    "fit_sphere, known radius": (lambda p: ws.fit_sphere(p, 20.0), ball(50), 3),
    "fit_cylinder": (ws.fit_cylinder, tube(60), 5),
    "fit_cylinder, robust": (lambda p: ws.fit_cylinder(p, robust=True), tube(60), 5),
    "fit_cylinder, known radius": (lambda p: ws.fit_cylinder(p, 50.0), tube(60), 4),
    "find_spheres": (lambda p: ws.find_spheres(p, 20.0), ball(2000), 0),
    "register_rigid": (lambda p: ws.register_rigid(p, p), ball(50), 3),
    "register_icp, source": (lambda p: ws.register_icp(p, TREE), ball(50), 3),
    "register_icp, target": (lambda p: ws.register_icp(ball(50), p), ball(50), 1),
    "register_icp, to a mesh": (lambda p: ws.register_icp(p, MESH, "plane"), ball(50) - [0, 0, 300], 3),
    "KdTree": (lambda p: ws.KdTree(p).nearest(ball(9)), ball(50), 1),
    "KdTree.nearest": (TREE.nearest, ball(50), 0),
    "KdTree.knn": (lambda p: TREE.knn(p, 3), ball(50), 0),
    "KdTree.radius": (lambda p: TREE.radius(p, 3.0), ball(50), 0),
    "Follower.nearest": (lambda p: ws.Follower(TREE).nearest(p), ball(50), 0),
    "distance to a cloud": (lambda p: ws.distance(p, TREE, signed=False), ball(50), 0),
    "distance from a cloud": (lambda p: ws.distance(ball(9), p, signed=False), ball(50), 1),
    "distance to a mesh": (lambda p: ws.distance(p, MESH), ball(50), 0),
    "distance to a cylinder": (lambda p: ws.distance(p, ws.Cylinder([0, 0, 0], [0, 0, 1], 5)), ball(50), 0),
    "estimate_normals": (lambda p: ws.estimate_normals(p, k=5), ball(50), 5),
    "Mesh": (lambda p: ws.distance(ball(9), ws.Mesh(p, sphere_mesh(6)[1])), sphere_mesh(6)[0], 1),
}


@pytest.mark.parametrize("name", POINTS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused_with_its_place(name, bad):
    call, points, _ = POINTS[name]
    points = points.copy()
    points[7, 1] = bad
    with pytest.raises(ws.InputError):
        call(points)


@pytest.mark.parametrize("name", POINTS)
def test_too_few_points_are_a_typed_error(name):
    call, points, fewest = POINTS[name]
    for n in range(fewest):
        with pytest.raises(ws.WeldscanError):
            call(points[:n])
    if fewest == 0:
        call(points[:0])


@pytest.mark.parametrize("name", POINTS)
@pytest.mark.parametrize(
    "wrong",
    [
        np.zeros((8, 2)),
        np.zeros((8, 4)),
        np.zeros(9),
        np.zeros((2, 3, 4, 3)),
        np.zeros((8, 3), complex),
        np.full((8, 3), "1"),
        np.zeros((8, 3), "M8[s]"),
        [[1, 2, 3], [4, 5]],
        "points",
        None,
        3.0,
        {"x": 1},
    ],
    ids=lambda w: f"{getattr(w, 'dtype', '')}{getattr(w, 'shape', type(w).__name__)}",
)
def test_wrong_shapes_and_types_are_input_errors(name, wrong):
    with pytest.raises(ws.InputError):
        POINTS[name][0](wrong)


@pytest.mark.parametrize("name", POINTS)
def test_however_the_array_lies_in_memory_the_answer_has_the_same_bits(name):
    call, points, _ = POINTS[name]
    # Values that single precision holds.
    points = points.astype(np.float32).astype(np.float64)
    expected = list(bits(call(points)))
    locked = points.copy()
    locked.flags.writeable = False
    wide = np.full((len(points), 7), np.nan)
    wide[:, ::3][:, :3] = points
    swapped = points.astype(">f8")
    for same in (
        locked,
        np.asfortranarray(points),
        points[::-1].copy()[::-1],
        np.repeat(points, 2, 0)[::2],
        wide[:, ::3][:, :3],
        swapped,
        points.astype(np.float32),
        points.tolist(),
        [tuple(p) for p in points.tolist()],
    ):
        assert list(bits(call(same))) == expected


FLAT = {
    "all equal": np.ones((30, 3)) * [5, 6, 7],
    "collinear": np.outer(np.arange(30.0), [1, 2, 3]),
    "coplanar": np.c_[np.random.default_rng(0).normal(size=(30, 2)), np.zeros(30)],
}


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("kind", FLAT)
def test_flat_clouds_fix_no_sphere_and_no_cylinder(kind, robust):
    for fit in (ws.fit_sphere, ws.fit_cylinder):
        with pytest.raises(ws.GeometryError):
            fit(FLAT[kind], robust=robust)
    if kind != "coplanar":
        with pytest.raises(ws.GeometryError):
            ws.fit_plane(FLAT[kind], robust=robust)
        with pytest.raises(ws.GeometryError):
            ws.register_rigid(FLAT[kind], FLAT[kind])
    with pytest.raises(ws.GeometryError):
        ws.sphere_through_points(FLAT[kind][:4])
    assert ws.find_spheres(FLAT[kind], 1.0) == []


@pytest.mark.parametrize("kind", FLAT)
def test_flat_clouds_have_neighbours_distances_and_a_registration(kind):
    points = FLAT[kind]
    distance, index = ws.KdTree(points).knn(points, len(points))
    assert np.all(np.sort(index, 1) == np.arange(len(points))) and np.all(np.diff(distance) >= 0)
    assert np.all(ws.distance(points, points, signed=False) == 0)
    found = ws.register_icp(points, points)
    assert found.converged and found.rms_mm == 0
    normals = ws.estimate_normals(points, k=5)
    # Where the neighbours fix no plane there is no normal.
    assert np.isnan(normals).all() == (kind != "coplanar")


@pytest.mark.parametrize(
    "call",
    [
        lambda: ws.fit_sphere(ball(50), -1.0),
        lambda: ws.fit_sphere(ball(50), 0.0),
        lambda: ws.fit_sphere(ball(50), np.inf),
        lambda: ws.fit_cylinder(tube(50), -1.0),
        lambda: ws.find_spheres(ball(50), -1.0),
        lambda: ws.find_spheres(ball(50), 20.0, -1),
        lambda: ws.find_spheres(ball(50), 20.0, 0),
        lambda: TREE.radius(ball(3), -1.0),
        lambda: TREE.radius(ball(3), np.nan),
        lambda: TREE.knn(ball(3), 0),
        lambda: TREE.knn(ball(3), -1),
        lambda: TREE.knn(ball(3), 51),
        lambda: TREE.knn(ball(3), 2**70),
        lambda: TREE.knn(ball(3), -(2**70)),
        lambda: ws.estimate_normals(ball(50), k=-3),
        lambda: ws.estimate_normals(np.zeros((5, 5, 3)), window=4),
        lambda: ws.Sphere([0, 0, 0], -1.0),
        lambda: ws.Cylinder([0, 0, 0], [0, 0, 1], -1.0),
        lambda: ws.fit_plane(ball(50), weights=-np.ones(50)),
        lambda: ws.fit_plane(ball(50), weights=np.ones(49)),
        lambda: ws.fit_plane(ball(50), sigma_mm=-1.0),
        lambda: ws.register_rigid(ball(50), ball(49)),
        lambda: ws.register_rigid(ball(50), ball(50), -np.ones(50)),
        lambda: ws.decode_phase([np.zeros((3, 3))] * 3, -3),
        lambda: ws.decode_phase([np.zeros((3, 3))] * 3, 2**70),
        lambda: ws.decode([[np.zeros((3, 3), np.uint8)] * 4], [(1, 4)], -5),
        lambda: ws.decode([[np.zeros((3, 3), np.uint8)] * 4], [(1, 4, 2)], 100),
        lambda: ws.decode_gray([np.zeros((3, 3))] * 2, inverse=[np.zeros((3, 3))] * 2, contrast=-1.0),
        lambda: ws.segment_weld(np.zeros((9, 9, 3)), 315.0, 6.0, axis=[1, 0]),
        lambda: ws.segment_weld(np.zeros((9, 9, 3)), -315.0, 6.0),
        lambda: ws.Lens(-1, 480, np.eye(3), np.zeros(4)),
        lambda: ws.Lens(640, 2**70, np.eye(3), np.zeros(4)),
        lambda: simulate(squares=(3, 3, 3)),
        lambda: simulate(size_mm=(1.0, 2.0)),
        lambda: simulate(size_mm="large"),
        lambda: ws.set_threads(-1),
        lambda: ws.set_threads(2**70),
        lambda: ws.Mesh(np.zeros((3, 3)), [[0, 1, 3]]),
        lambda: ws.Mesh(np.zeros((3, 3)), [[0, 1, -1]]),
        lambda: ws.Mesh(np.zeros((3, 3)), [[0.5, 1, 2]]),
        lambda: SCANNER_LENS.undistort(np.zeros((3, 3))),
        lambda: SCANNER_LENS.project(np.zeros((3, 2))),
    ],
)
def test_parameters_out_of_range_are_input_errors(call):
    with pytest.raises(ws.InputError):
        call()


def test_degenerate_triangles_count_as_the_lines_and_points_they_are():
    vertices, triangles = sphere_mesh(6)
    more = np.r_[triangles, [[0, 0, 1], [2, 2, 2]]]
    points = ball(40) - [0, 0, 300]
    plain = ws.distance(points, ws.Mesh(vertices, triangles), signed=False)
    # They lie on edges and corners of others.
    assert np.allclose(ws.distance(points, ws.Mesh(vertices, more), signed=False), plain, atol=1e-12)


def test_an_open_mesh_has_sides_but_not_beyond_its_rim():
    square = ws.Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    assert not square.closed
    found = ws.distance([[0.5, 0.4, 2], [0.5, 0.4, -2], [3, 0.5, 0.1]], square)
    assert found[:2].tolist() == [2.0, -2.0] and np.isnan(found[2])
    assert np.isfinite(ws.distance([[3, 0.5, 0.1]], square, signed=False)).all()
