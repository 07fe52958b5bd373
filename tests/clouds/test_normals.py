import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import weldscan
from weldscan import GeometryError, InputError, estimate_normals

ROUNDING = 1e-9


def ball(height=90, width=120):
    """A ball of 50 mm seen from the origin, and its normals."""
    x, y = np.meshgrid((np.arange(width) - width / 2) * 0.1, (np.arange(height) - height / 2) * 0.1)
    z = np.sqrt(2500 - x**2 - y**2)
    return np.stack([x, y, 300 - z], -1), np.stack([x, y, -z], -1) / 50


def plane_by_svd(points):
    return np.linalg.svd(points - points.mean(0))[2][2]


def test_grid_and_cloud_find_the_normals_of_a_ball():
    points, truth = ball()
    for found in (estimate_normals(points), estimate_normals(points.reshape(-1, 3)).reshape(points.shape)):
        error = np.linalg.norm(found - truth, axis=-1)
        assert error[5:-5, 5:-5].max() < 0.01 / 50  # 20 of a lattice's 21 nearest lie a little to one side
        assert error.max() < 0.4 / 50  # at the rim of the view all neighbours lie on one side


@given(st.integers(0, 2**32 - 1))
def test_cloud_as_svd_of_the_nearest(seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(60, 3)) * [10, 10, 1]
    found = estimate_normals(points, [0, 0, 1000], k=8)
    for p, n in zip(points, found, strict=True):
        near = points[np.argsort(np.linalg.norm(points - p, axis=1), kind="stable")[:8]]
        # Normals of nearly equal eigenvalues turn with rounding: the spread along them is what is least.
        spread = np.linalg.norm((near - near.mean(0)) @ n)
        assert spread <= np.linalg.norm((near - near.mean(0)) @ plane_by_svd(near)) + ROUNDING
        assert n @ ([0, 0, 1000] - p) >= 0


def test_missing_points_and_jumps():
    points, truth = ball()
    points[:, 60:, 2] += 20
    points[40:50, 40:50] = np.nan
    found = estimate_normals(points, window=3)
    assert np.array_equal(np.isnan(found), np.isnan(points))
    seen = ~np.isnan(found[..., 0])
    assert np.linalg.norm(found - truth, axis=-1)[seen].max() < 0.2 / 50
    assert np.isnan(estimate_normals(np.full((4, 5, 3), np.nan))).all()
    assert np.isnan(estimate_normals(np.ones((30, 3)))).all()
    assert np.isnan(estimate_normals(np.outer(np.arange(30), [1, 2, 3]))).all()


def test_viewpoint_turns_them():
    points, truth = ball()
    assert np.allclose(estimate_normals(points, [0, 0, 1000]), -estimate_normals(points))
    assert np.allclose(estimate_normals(points.astype(np.float32)), truth, atol=0.01)


def test_same_bits_on_any_number_of_threads():
    points, _ = ball(200, 300)
    answers = set()
    for threads in (1, 2, 8):
        weldscan.set_threads(threads)
        answers.add((estimate_normals(points).tobytes(), estimate_normals(points.reshape(-1, 3)).tobytes()))
    weldscan.set_threads(None)
    assert len(answers) == 1


def test_bad_input_is_refused():
    points, _ = ball(20, 20)
    flat = points.reshape(-1, 3)
    assert estimate_normals(np.empty((0, 7, 3))).shape == (0, 7, 3)
    assert estimate_normals(np.empty((7, 0, 3))).shape == (7, 0, 3)
    for wrong, options in (
        (flat, {"k": 2}),
        (flat, {"k": -1}),
        (points, {"window": 4}),
        (points, {"window": 1}),
        (points, {"viewpoint": [0, 0]}),
        (points, {"viewpoint": [0, 0, np.nan]}),
        (points[..., :2], {}),
        (flat[:, :2], {}),
        (np.full((30, 3), np.nan), {}),
        ("cloud", {}),
        (1.0, {}),
    ):
        with pytest.raises(InputError):
            estimate_normals(wrong, **options)
    with pytest.raises(GeometryError):
        estimate_normals(flat[:10])
