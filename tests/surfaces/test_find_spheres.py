"""Spheres found in raw clouds: simulated ones, and real scans that were segmented by NIST."""

from __future__ import annotations

import numpy as np
import pytest

import weldscan
from conftest import shared

RADIUS = 10.0
NOISE_MM = 0.03
# About six standard deviations of a centre from some thousand points, and a two-hundredth of a pixel.
CENTRE_TOLERANCE_MM = 0.012


def view(balls: list[tuple[list[float], float]], seed: int = 0, shape: tuple[int, int] = (480, 640)) -> np.ndarray:
    """What a pinhole camera sees of balls before a tilted plate; the left edge has no points."""
    height, width = shape
    v, u = np.mgrid[:height, :width]
    focal = 4.0 * width
    ray = np.stack([(u - width / 2) / focal, (v - height / 2) / focal, np.ones(shape)], -1)
    depth = 430 / (1 + 0.3 * ray[..., 0])
    for centre, radius in balls:
        a, b = (ray**2).sum(-1), ray @ centre
        root = b**2 - a * (np.dot(centre, centre) - radius**2)
        depth = np.where(root > 0, np.minimum(depth, (b - np.sqrt(np.abs(root))) / a), depth)
    depth += np.random.default_rng(seed).normal(0, NOISE_MM, shape)
    depth[:, :20] = np.nan
    return ray * depth[..., None]


BALLS = [([-20.0, -15.0, 412.0], RADIUS), ([25.0, -12.0, 405.0], RADIUS), ([2.0, 20.0, 410.0], RADIUS)]


def test_the_centres_are_right_and_the_covariance_is_honest() -> None:
    squared = []
    for seed in range(8):
        points = view(BALLS, seed)
        found = weldscan.find_spheres(points, RADIUS, 3)
        for centre, _ in BALLS:
            near = min(found, key=lambda f: np.linalg.norm(f.center_mm - centre))
            miss = near.center_mm - centre
            assert np.abs(miss).max() < CENTRE_TOLERANCE_MM
            # Noise along the ray reaches the surface's normal with the cosine of the incidence, up to 60°.
            assert 0.6 * NOISE_MM < near.rms_mm < NOISE_MM
            assert abs(near.free_radius_mm - RADIUS) < 5 * near.free_radius_sigma_mm
            squared.append(miss @ np.linalg.solve(near.covariance, miss))
            on = points.reshape(-1, 3)[near.inliers]
            assert np.abs(np.linalg.norm(on - near.center_mm, axis=1) - RADIUS).max() < 5 * NOISE_MM
    # 72 degrees of freedom; the covariance includes a two-hundredth of a pixel that this simulation does not have.
    assert 0.1 < np.mean(squared) / 3 < 1.5


def test_the_answer_does_not_depend_on_the_frame_of_a_grid() -> None:
    points = view(BALLS)
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    shift = np.array([5000.0, -300.0, 80.0])
    here = weldscan.find_spheres(points, RADIUS, 3)
    there = weldscan.find_spheres(points @ turn.T + shift, RADIUS, 3)
    for a, b in zip(here, there, strict=True):
        np.testing.assert_allclose(b.center_mm, turn @ a.center_mm + shift, atol=1e-3 * NOISE_MM)
        assert len(np.intersect1d(a.inliers, b.inliers)) > 0.999 * len(a.inliers)


@pytest.mark.parametrize("wrong", [9.5, 10.5, 11.0, 15.0])
def test_a_sphere_of_another_size_is_refused(wrong: float) -> None:
    points = view([*BALLS[:2], (BALLS[2][0], wrong)])
    assert len(weldscan.find_spheres(points, RADIUS)) == 2
    with pytest.raises(weldscan.GeometryError, match="2 of 3 spheres"):
        weldscan.find_spheres(points, RADIUS, count=3)


def test_planes_pipes_boxes_and_pins_are_refused() -> None:
    v, u = np.mgrid[:300, :400] * 0.15
    noise = np.random.default_rng(1).normal(0, NOISE_MM, u.shape)
    heights = {
        "plane": 0.2 * u,
        "pipe 630": np.sqrt(315.0**2 - (u - 30) ** 2),
        "pipe of the same radius": np.sqrt(np.maximum(RADIUS**2 - (u - 30) ** 2, 0)),
        "box": np.where(np.abs(u - 30) + np.abs(v - 20) < 15, 10.0, 0.0),
        "ridge": -np.abs(u - 30) - 0.2 * v,
        "corner": -np.abs(u - 30) - np.abs(v - 20),
    }
    for name, z in heights.items():
        grid = np.stack([u, v, 500 - z - noise], -1)
        assert weldscan.find_spheres(grid, RADIUS) == [], name
        assert weldscan.find_spheres(grid.reshape(-1, 3), RADIUS) == [], name


@pytest.mark.parametrize("whole", [True, False])
@pytest.mark.parametrize("noise", [0.0, 1e-3, 1e-2])
@pytest.mark.parametrize("number", [200, 1000, 20_000])
def test_bare_clouds_of_any_density_among_strays_before_a_plate(number: int, noise: float, whole: bool) -> None:
    rng = np.random.default_rng(number)
    centres = np.array([[0, 0, 40], [3.0, 0.5, 40.5], [-0.5, 3.2, 41]]) * RADIUS
    cloud = []
    for centre in centres:
        d = rng.normal(size=(number, 3))
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        d[:, 2] = d[:, 2] if whole else -np.abs(d[:, 2])
        cloud.append(centre + d * RADIUS * (1 + noise * rng.normal(size=(number, 1))))
    plate = rng.uniform(-6, 6, (3 * number, 3)) * RADIUS
    plate[:, 2] = RADIUS * (47 + noise * rng.normal(size=len(plate)))
    strays = rng.uniform(-6, 6, (number // 3, 3)) * RADIUS + [0, 0, 40 * RADIUS]
    points = rng.permutation(np.vstack([*cloud, plate, strays]))
    found = weldscan.find_spheres(points, RADIUS)
    assert len(found) == 3
    for centre in centres:
        miss = min(np.abs(f.center_mm - centre).max() for f in found)
        # Six standard deviations; half the sphere tells each coordinate at least a quarter as well as the mean of all.
        assert miss < RADIUS * (1e-9 + 6 * noise * 4 / np.sqrt(number))


def test_whatever_numpy_takes_is_taken() -> None:
    points = view(BALLS)
    first = weldscan.find_spheres(points, RADIUS, 3)
    locked = points.copy()
    locked.flags.writeable = False
    padded = np.zeros((*points.shape[:2], 4))
    padded[..., :3] = points
    for same in (locked, np.asfortranarray(points), padded[..., :3]):
        for a, b in zip(first, weldscan.find_spheres(same, RADIUS, 3), strict=True):
            np.testing.assert_array_equal(a.center_mm, b.center_mm)
    single = weldscan.find_spheres(points.astype(np.float32), RADIUS, 3)
    np.testing.assert_allclose(single[0].center_mm, first[0].center_mm, atol=1e-3)
    assert weldscan.find_spheres(np.empty((0, 3)), RADIUS) == []
    assert weldscan.find_spheres([[1, 2, 3]] * 5, RADIUS) == []


@pytest.mark.parametrize(
    ("points", "radius", "count"),
    [
        (np.zeros((5, 2)), 1.0, None),
        (np.zeros(6), 1.0, None),
        (np.zeros((2, 2, 2, 3)), 1.0, None),
        (np.full((5, 3), np.nan), 1.0, None),
        (np.full((5, 5, 3), np.inf), 1.0, None),
        (np.zeros((5, 3)), -1.0, None),
        (np.zeros((5, 3)), np.nan, None),
        (np.zeros((5, 3)), 1.0, 0),
        (["a", "b"], 1.0, None),
    ],
)
def test_bad_input_is_refused(points: object, radius: float, count: int | None) -> None:
    with pytest.raises(weldscan.InputError):
        weldscan.find_spheres(points, radius, count)  # type: ignore[arg-type]


@pytest.mark.parametrize("number", [101, 102, 103, 104])
def test_real_scans_are_segmented_as_nist_did(number: int) -> None:
    folder = shared("real/nist_spheres_scanned")
    raw = np.loadtxt(folder / "raw" / f"SPH{number}.xyz") * 1e3
    kept = np.loadtxt(folder / "truncated" / f"tSPH{number}.xyz", delimiter=",") * 1e3
    # The truncated files are rounded to four decimals of a metre: each of their points is the nearest raw one.
    theirs = np.array([np.argmin(((raw - p) ** 2).sum(1)) for p in kept])
    (sphere,) = weldscan.find_spheres(raw, 50.0, 1)
    common = len(np.intersect1d(sphere.inliers, theirs))
    assert common >= 0.97 * len(theirs)
    assert common >= 0.97 * len(sphere.inliers)
