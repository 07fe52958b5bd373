import threading

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

import weldscan
from weldscan import Follower, GeometryError, InputError, KdTree


def brute_force(points, queries):
    """(m, n) distances, added up in the documented order."""
    d = queries[:, None] - points
    return np.sqrt((d[..., 0] ** 2 + d[..., 1] ** 2) + d[..., 2] ** 2)


def clouds():
    rng = np.random.default_rng(1)
    lattice = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), -1).reshape(-1, 3)
    return {
        "random": rng.normal(size=(500, 3)) * 30,
        "lattice": lattice,
        "duplicates": np.repeat(rng.normal(size=(20, 3)), 33, axis=0),
        "collinear": np.outer(np.arange(300.0), [1, 2, 3]),
        "far": rng.normal(size=(500, 3)) + 1e6,
        "one": np.array([[1.0, 2, 3]]),
        "all equal": np.ones((77, 3)),
    }


@pytest.mark.parametrize("name", clouds())
def test_all_queries_are_those_of_brute_force(name):
    points = clouds()[name]
    rng = np.random.default_rng(2)
    queries = np.concatenate([points[:50], points[:50] + 0.5, points.mean(0) + rng.normal(size=(50, 3)) * 10])
    expected = brute_force(points, queries)
    order = np.argsort(expected, axis=1, kind="stable")
    tree = KdTree(points)
    distance, index = tree.nearest(queries)
    assert np.array_equal(distance, expected.min(1))
    assert np.array_equal(index, order[:, 0])
    k = min(9, len(points))
    distance, index = tree.knn(queries, k)
    assert np.array_equal(index, order[:, :k])
    assert np.array_equal(distance, np.take_along_axis(expected, order[:, :k], 1))
    distance, index = tree.radius(queries, 2.0)
    for d, i, row, by_distance in zip(distance, index, expected, order, strict=True):
        within = by_distance[row[by_distance] <= 2.0]
        assert np.array_equal(i, within)
        assert np.array_equal(d, row[within])


def test_a_million_points_as_scipy():
    rng = np.random.default_rng(3)
    points = rng.random((1_000_000, 3)) * [300, 300, 1]
    queries = rng.random((20_000, 3)) * [300, 300, 1]
    distance, index = KdTree(points).nearest(queries)
    expected, _ = cKDTree(points).query(queries)
    assert np.allclose(distance, expected, rtol=1e-14, atol=0)  # scipy adds the squares in another order
    d = points[index] - queries
    assert np.array_equal(distance, np.sqrt((d[:, 0] ** 2 + d[:, 1] ** 2) + d[:, 2] ** 2))


@pytest.mark.parametrize("name", ["lattice", "duplicates", "collinear", "far"])
def test_a_million_points_as_brute_force(name):
    n, rng = 1_000_000, np.random.default_rng(4)
    points = {
        "lattice": lambda: np.stack(np.meshgrid(*[np.arange(100.0)] * 3), -1).reshape(-1, 3),
        "duplicates": lambda: rng.normal(size=(1000, 3))[rng.integers(0, 1000, n)],
        "collinear": lambda: np.outer(np.arange(float(n)), [1, 2, 3]),
        "far": lambda: rng.normal(size=(n, 3)) + 1e6,
    }[name]()
    queries = points[rng.integers(0, n, 12)] + [[0], [0.5], [0.25]] * 4
    distance, index = KdTree(points).nearest(queries)
    for query, d, i in zip(queries, distance, index, strict=True):
        expected = brute_force(points, query[None])[0]
        assert (d, i) == (expected.min(), expected.argmin())


def test_a_follower_answers_as_a_search():
    rng = np.random.default_rng(7)
    points = rng.normal(size=(20_000, 3)) * [30, 30, 1]
    queries = rng.normal(size=(20_000, 3)) * [30, 30, 1]
    tree = KdTree(points)
    follower = Follower(tree)
    for step in (1, 0.1, 0.01, 0.001, 0):
        for mine, expected in zip(follower.nearest(queries), tree.nearest(queries), strict=True):
            assert np.array_equal(mine, expected)
        queries = queries + rng.normal(size=queries.shape) * step
    assert np.array_equal(follower.nearest(queries[:9])[1], tree.nearest(queries[:9])[1])
    with pytest.raises(InputError, match="queries"):
        follower.nearest([[0, 0, np.nan]])


coarse = st.lists(st.tuples(*[st.integers(-3, 3)] * 3), min_size=1, max_size=60)


# On a loaded machine making the lists takes its time.
@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(coarse, coarse, st.integers(1, 5))
def test_ties_go_to_the_lowest_index(points, queries, k):
    points, queries = np.array(points, float), np.array(queries, float)
    order = np.argsort(brute_force(points, queries), axis=1, kind="stable")
    k = min(k, len(points))
    assert np.array_equal(KdTree(points).knn(queries, k)[1], order[:, :k])


def test_what_numpy_users_pass():
    points = np.random.default_rng(4).random((40, 3))
    expected = KdTree(points).nearest(points[::-1])[1]
    assert np.array_equal(expected, np.arange(40)[::-1])
    fixed = points.copy()
    fixed.flags.writeable = False
    wide = np.zeros((40, 6))
    wide[:, ::2] = points
    for given_points in (fixed, points.tolist(), wide[:, ::2], np.asfortranarray(points), points.astype(np.float32)):
        assert np.array_equal(KdTree(given_points).nearest(points[::-1])[1], expected)
    assert len(KdTree(points)) == 40
    assert repr(KdTree(points)) == "KdTree(40 points)"
    distance, index = KdTree(points).nearest(np.empty((0, 3)))
    assert distance.shape == index.shape == (0,)


@pytest.mark.parametrize(
    "points",
    [[[0, 0, np.nan]], [[0, np.inf, 0]], [0, 0, 0], np.zeros((3, 2)), "abc", None, [[1j, 0, 0]], [[0, 0, 1e200]]],
)
def test_bad_points_are_refused(points):
    with pytest.raises(InputError, match="points"):
        KdTree(points)
    with pytest.raises(InputError, match="queries"):
        KdTree([[0, 0, 0]]).nearest(points)


def test_bad_parameters_are_refused():
    with pytest.raises(GeometryError):
        KdTree(np.empty((0, 3)))
    tree = KdTree([[0, 0, 0]])
    for k in (0, -1, 2, 2**62):
        with pytest.raises(InputError, match="k"):
            tree.knn([[0, 0, 0]], k)
    for r in (-1, np.nan):
        with pytest.raises(InputError, match="r: must be"):
            tree.radius([[0, 0, 0]], r)


def test_same_bits_on_any_number_of_threads():
    rng = np.random.default_rng(5)
    points, queries = rng.random((60_000, 3)).round(2), rng.random((5_000, 3)).round(2)
    answers = []
    for threads in (1, 2, 8):
        weldscan.set_threads(threads)
        tree = KdTree(points)
        answers.append([*tree.nearest(queries), *tree.knn(queries, 4)])
    weldscan.set_threads(None)
    for answer in answers[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(answer, answers[0], strict=True))


def test_the_lock_is_released():
    points = np.random.default_rng(6).random((400_000, 3))
    ticks, done = 0, threading.Event()

    def work():
        for _ in range(3):
            KdTree(points)
        done.set()

    worker = threading.Thread(target=work)
    worker.start()
    while not done.is_set():
        ticks += 1
        done.wait(0.0005)
    worker.join()
    assert ticks > 10
