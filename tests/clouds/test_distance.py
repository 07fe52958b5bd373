import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import weldscan
from weldscan import Cylinder, GeometryError, InputError, KdTree, Mesh, Plane, Sphere, distance, register_icp

ROUNDING = 1e-12  # mm, on coordinates of some 10 mm


def queries(n=3000):
    return np.random.default_rng(1).uniform(-20, 20, (n, 3))


def tube(n=64, radius=10.0, height=30.0):
    """A closed tube around z from 0 to height."""
    angle = np.arange(n) / n * 2 * np.pi
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], -1)
    vertices = np.zeros((2 * n + 2, 3))
    vertices[:n, :2] = vertices[n : 2 * n, :2] = ring
    vertices[n : 2 * n, 2] = vertices[2 * n + 1, 2] = height
    a, b = np.arange(n), (np.arange(n) + 1) % n
    low, high = np.full(n, 2 * n), np.full(n, 2 * n + 1)
    triangles = [(a, b, a + n), (b, b + n, a + n), (low, b, a), (high, a + n, b + n)]
    return vertices, np.concatenate([np.stack(t, -1) for t in triangles])


def test_analytic_targets_are_exact():
    p = queries()
    axis = np.array([0, 3, 4]) / 5
    offset = p - [1, 2, 3]
    for target, expected in (
        (Plane([1, 2, 3], [0, 6, 8]), offset @ axis),
        (Sphere([1, 2, 3], 7), np.linalg.norm(offset, axis=1) - 7),
        (Cylinder([1, 2, 3], [0, 6, 8], 7), np.linalg.norm(np.cross(offset, axis), axis=1) - 7),
    ):
        assert np.abs(distance(p, target) - expected).max() < ROUNDING
        assert np.abs(distance(p, target, signed=False) - np.abs(expected)).max() < ROUNDING
        assert "mm=" in repr(target)
    plane, sphere, cylinder = Plane([1, 2, 3], [0, 6, 8]), Sphere([1, 2, 3], 7), Cylinder([1, 2, 3], [0, 6, 8], 7)
    assert np.allclose([plane.normal, cylinder.axis], axis)
    assert np.array_equal([plane.point_mm, sphere.center_mm, cylinder.point_mm], [[1, 2, 3]] * 3)
    assert sphere.radius_mm == cylinder.radius_mm == 7


def test_a_fit_is_the_surface_that_it_fitted():
    rng = np.random.default_rng(2)
    flat = rng.uniform(-9, 9, (200, 3)) * [1, 1, 0]
    unit = rng.normal(size=(200, 3))
    ball = 5 * unit / np.linalg.norm(unit, axis=1, keepdims=True) + [1, 2, 3]
    pipe = 4 * unit[:, :2] / np.linalg.norm(unit[:, :2], axis=1, keepdims=True)
    pipe = np.c_[pipe, rng.uniform(-9, 9, 200)]
    plane, sphere, cylinder = weldscan.fit_plane(flat), weldscan.fit_sphere(ball), weldscan.fit_cylinder(pipe)
    [found] = weldscan.find_spheres(np.repeat(ball, 20, 0) + rng.normal(0, 0.01, (4000, 3)), 5, 1)
    p = queries(500)
    for fit, surface in (
        (plane, Plane(plane.point_mm, plane.normal)),
        (sphere, Sphere(sphere.center_mm, sphere.radius_mm)),
        (cylinder, Cylinder(cylinder.point_mm, cylinder.axis, cylinder.radius_mm)),
        (found, Sphere(found.center_mm, found.radius_mm)),
    ):
        # A surface makes its direction a unit vector anew.
        assert np.abs(distance(p, fit) - distance(p, surface)).max() < ROUNDING
        assert np.abs(distance(p, fit)).max() > 1
    assert register_icp(ball + np.array([0.1, 0, 0]), sphere, metric="plane").rms_mm < 1e-6


def test_closed_mesh_has_an_inside():
    mesh = Mesh(*tube())
    assert mesh.closed
    assert repr(mesh) == "Mesh(130 vertices, 256 triangles, closed)"
    p = queries() + np.array([0, 0, 15])
    radial, axial = np.hypot(p[:, 0], p[:, 1]) - 10, np.abs(p[:, 2] - 15) - 15
    outside = np.hypot(np.maximum(radial, 0), np.maximum(axial, 0))
    expected = np.where(outside > 0, outside, np.maximum(radial, axial))
    sagitta = 10 * (1 - np.cos(np.pi / 64))
    found = distance(p, mesh)
    assert np.abs(found - expected).max() <= sagitta + ROUNDING
    assert np.array_equal(distance(p, mesh, signed=False), np.abs(found))


def nearest_on_triangle(p, a, b, c):
    """Quadratic programme by cases: inside the face, on an edge, at a corner."""
    best = np.inf
    m = np.stack([b - a, c - a], -1)
    uv = np.linalg.lstsq(m, p - a, rcond=None)[0]
    if (uv >= 0).all() and uv.sum() <= 1:
        best = np.linalg.norm(p - a - m @ uv)
    for s, e in ((a, b), (b, c), (c, a)):
        t = np.clip((p - s) @ (e - s) / ((e - s) @ (e - s)), 0, 1)
        best = min(best, np.linalg.norm(p - s - t * (e - s)))
    return best


@given(st.integers(0, 2**32 - 1))
def test_mesh_as_trying_all_triangles(seed):
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(12, 3)) * 10
    triangles = np.array([rng.choice(12, 3, replace=False) for _ in range(15)])
    p = rng.normal(size=(10, 3)) * 15
    expected = [min(nearest_on_triangle(q, *vertices[t]) for t in triangles) for q in p]
    assert np.abs(distance(p, Mesh(vertices, triangles), signed=False) - expected).max() < 1e-9


def test_open_and_mistaken_meshes():
    triangle = Mesh([[0, 0, 0], [4, 0, 0], [0, 4, 0]], [[0, 1, 2]])
    assert not triangle.closed
    assert np.array_equal(distance([[1, 1, 2], [1, 1, -2], [-1, 1, 1]], triangle), [2, -2, np.nan], equal_nan=True)
    assert distance([[-1, 1, 0]], triangle, signed=False) == 1
    vertices, triangles = tube()
    soup = Mesh(vertices[triangles].reshape(-1, 3), np.arange(triangles.size).reshape(-1, 3))
    assert soup.closed
    triangles[7] = triangles[7, ::-1]
    with pytest.raises(GeometryError, match="no sides"):
        distance([[0, 0, 0]], Mesh(vertices, triangles))
    assert distance([[0, 0, -1]], Mesh(vertices, triangles), signed=False) == 1
    flat = Mesh(vertices, np.concatenate([tube()[1], [[0, 0, 1]]]))
    assert flat.closed
    assert flat.triangles == 256


def test_cloud_with_and_without_normals():
    angle = np.linspace(0, 2 * np.pi, 500, endpoint=False)
    ring = 10 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    p = queries() * [1, 1, 0]
    exact = np.hypot(p[:, 0], p[:, 1]) - 10
    found = distance(p, ring, normals=ring / 10)
    assert np.array_equal(np.abs(found), KdTree(ring).nearest(p)[0])
    assert np.abs(found - exact).max() < 0.07  # half the spacing of the points
    assert np.array_equal(distance(p, KdTree(ring), signed=False), np.abs(found))
    with pytest.raises(GeometryError, match="normals"):
        distance(p, ring)
    with pytest.raises(InputError, match="normals"):
        distance(p, ring, normals=ring[1:])


def test_registration_to_a_mesh():
    vertices, triangles = tube(360)
    rng = np.random.default_rng(2)
    angle, z = rng.uniform(0, 2 * np.pi, 4000), rng.uniform(5, 25, 4000)
    wall = np.stack([10 * np.cos(angle), 10 * np.sin(angle), z], -1)
    found = register_icp(wall + np.array([0.2, -0.1, 0]), Mesh(vertices, triangles), "plane", max_iterations=200)
    # To half a facet's sagitta of 0.4 um the mesh is a cylinder.
    assert np.abs(found.target_from_source[:2, 3] - [-0.2, 0.1]).max() < 1e-3
    assert found.rms_mm < 1e-3


def test_same_bits_on_any_number_of_threads():
    p, mesh, ring = queries(9000), Mesh(*tube()), tube()[0]
    answers = set()
    for threads in (1, 2, 8):
        weldscan.set_threads(threads)
        targets = (mesh, Cylinder([1, 2, 3], [0, 3, 4], 7))
        answers.add(b"".join(distance(p, t).tobytes() for t in targets) + distance(p, ring, False).tobytes())
    weldscan.set_threads(None)
    assert len(answers) == 1


def test_bad_input_is_refused():
    plane = Plane([0, 0, 0], [0, 0, 1])
    for wrong in ([[0, 0, np.nan]], [[0, np.inf, 0]], np.zeros((4, 2)), [1, 2, 3], "cloud"):
        for target in (plane, Mesh(*tube()), [[0.0, 0, 0]]):
            with pytest.raises(InputError, match="points"):
                distance(wrong, target, signed=False)
        with pytest.raises(InputError, match="target"):
            distance([[0, 0, 0]], wrong, signed=False)
    assert distance(np.empty((0, 3)), plane).shape == (0,)
    v = [[0, 0, 0], [1, 0, 0], [2, 0, 0]]
    for vertices, triangles in (
        (v, [[0, 1, 3]]),
        (v, [[0, 1, -1]]),
        (v, [[0, 1]]),
        (v, [[0.5, 1, 2]]),
        (v, "abc"),
        ([[0, 0, np.nan]] * 3, [[0, 1, 2]]),
        (np.zeros((3, 2)), [[0, 1, 2]]),
    ):
        with pytest.raises(InputError):
            Mesh(vertices, triangles)
    for triangles in ([[0, 1, 2]], [[0, 0, 1]], np.empty((0, 3))):
        with pytest.raises(GeometryError):
            Mesh(v, triangles)
