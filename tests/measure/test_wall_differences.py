"""Walls of placed shots held against each other: the core against the same in NumPy, on clouds made by closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest

from catalogue import weld_shot
from weldscan import segment_weld, set_threads
from weldscan._weldcore import wall_differences, wall_seen
from weldscan.errors import GeometryError, InputError
from weldscan.result import Label

# Sums in another order, of numbers of some hundred mm.
SAME_MM = 1e-10
CELL_MM, LEAST_POINTS, LEAST_CELLS, POINTS = 4.0, 5, 20, 150_000


def placed_shots() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Three shots of one pipe, side by side around it: points, labels, shots, origin and axis; the third stands off."""
    random = np.random.default_rng(5)
    axis = np.array([0.48, 0.6, -0.64])
    zero = np.cross(axis, [0.0, 0.0, 1.0])
    zero /= np.linalg.norm(zero)
    origin = np.array([900.0, 20.0, -300.0])
    points, labels, shots = [], [], []
    for shot, (off_mm, n) in enumerate([(0.0, 170_000), (0.05, 320_000), (-0.4, 60_000)]):
        angle, along = random.uniform(0.3 * shot - 3.4, 0.3 * shot - 2.6, n), random.uniform(-60, 60, n)
        radius = 160 + 0.5 * np.cos(2 * angle) + off_mm + random.normal(0, 0.02, n)
        outward = np.cos(angle)[:, None] * zero + np.sin(angle)[:, None] * np.cross(axis, zero)
        points.append(origin + along[:, None] * axis + radius[:, None] * outward)
        wall = np.where(along < 0, Label.REFERENCE_WALL, Label.OTHER_WALL)
        labels.append(np.where(np.abs(along) < 6, Label.BEAD, wall).astype(np.uint8))
        shots.append(np.full(n, 2 * shot, np.uint16))
    return np.concatenate(points), np.concatenate(labels), np.concatenate(shots), origin, axis


def cells(points, labels, shots, shot, origin, axis):
    """One shot's cells in NumPy: number, mean distance from the axis, middle."""
    zero = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    zero /= np.linalg.norm(zero)
    few = points[:: max(1, len(points) // 1000)] - origin
    radius = float(np.median(np.linalg.norm(few - np.outer(few @ axis, axis), axis=1)))
    around = max(8, round(2 * math.pi * radius / CELL_MM))
    walls = (labels == Label.REFERENCE_WALL) | (labels == Label.OTHER_WALL)
    chosen = np.flatnonzero(walls & (shots == shot))
    v = points[chosen[:: max(1, len(chosen) // POINTS)]] - origin
    x, y, along = v @ zero, v @ np.cross(axis, zero), v @ axis
    turn = np.floor((np.arctan2(y, x) / (2 * math.pi) % 1.0) * around).astype(np.int64)
    key = turn * 1_000_003 + np.floor(along / CELL_MM).astype(np.int64)
    numbers, place, count = np.unique(key, return_inverse=True, return_counts=True)
    mean = np.bincount(place, np.hypot(x, y)) / count
    middle = np.stack([np.bincount(place, v[:, k]) / count for k in range(3)], axis=1) + origin
    good = count >= LEAST_POINTS
    return numbers[good], mean[good], middle[good]


def in_numpy(points, labels, shots, numbers, origin, axis):
    seen = [cells(points, labels, shots, number, origin, axis) for number in numbers]
    found = []
    for j in range(len(numbers)):
        for i in range(j):
            common, a, b = np.intersect1d(seen[i][0], seen[j][0], return_indices=True)
            if len(common) < LEAST_CELLS:
                continue
            off = seen[j][1][b] - seen[i][1][a]
            difference = float(np.median(off))
            scatter = 1.4826 * float(np.median(np.abs(off - difference)))
            rms = float(np.sqrt(np.square(off).mean()))
            found.append((i, j, len(common), difference, scatter, rms, seen[i][2][a].mean(axis=0)))
    return found


def test_the_core_finds_what_numpy_does_on_any_number_of_threads():
    points, labels, shots, origin, axis = placed_shots()
    numbers = [0, 2, 4, 7]
    expected = in_numpy(points, labels, shots, numbers, origin, axis)
    assert [pair[:2] for pair in expected] == [(0, 1), (0, 2), (1, 2)]
    assert abs(expected[0][3] - 0.05) < 0.01 and abs(expected[2][3] + 0.45) < 0.01
    seen = []
    for threads in (1, 2, 8):
        set_threads(threads)
        try:
            seen.append(wall_differences(points, labels, shots, numbers, origin, 3 * axis))
        finally:
            set_threads(None)
    for pair, (i, j, count, difference, scatter, rms, middle) in zip(seen[0], expected, strict=True):
        assert pair[:3] == (i, j, count)
        np.testing.assert_allclose(pair[3:6], (difference, scatter, rms), atol=SAME_MM)
        np.testing.assert_allclose(pair[6], middle, atol=SAME_MM)
    for other in seen[1:]:
        assert [p[:6] for p in other] == [p[:6] for p in seen[0]]


def test_what_does_not_belong_together_is_refused():
    points, labels, shots, origin, axis = (each[:100] for each in placed_shots())
    with pytest.raises(InputError, match="labels and shots"):
        wall_differences(points, labels[1:], shots, [0], origin, axis)
    with pytest.raises(GeometryError, match="axis"):
        wall_differences(points, labels, shots, [0], origin, 0 * axis)
    with pytest.raises(InputError, match="not finite"):
        wall_differences(points * np.nan, labels, shots, [0], origin, axis)
    assert wall_differences(points, labels, shots, [], origin, axis) == []


def form_in_numpy(angle, along, deviation, grid=10):
    """Middle and half arc, twist and waves of a wall."""
    middle = math.atan2(float(np.sin(angle).mean()), float(np.cos(angle).mean()))
    off = np.angle(np.exp(1j * (angle - middle)))
    twist = float(np.std((along - along.mean()) * np.sin(off)))
    edges = [np.quantile(values, np.linspace(0, 1, grid + 1)[1:-1]) for values in (off, along)]
    cell = np.searchsorted(edges[0], off) * grid + np.searchsorted(edges[1], along)
    count = np.bincount(cell, minlength=grid**2)
    heights = np.full(grid**2, np.nan)
    good = count >= LEAST_POINTS
    heights[good] = np.bincount(cell, deviation, grid**2)[good] / count[good]
    heights = heights.reshape(grid, grid)
    heights = heights - np.nanmean(heights, axis=0)
    heights = heights - np.nanmean(heights, axis=1, keepdims=True)
    return middle, float(np.quantile(np.abs(off), 0.98)), twist, float(np.sqrt(np.nanmean(np.square(heights))))


def test_a_walls_form_is_what_numpy_finds():
    points = weld_shot(2.0)
    rows = np.arange(points.shape[0])[:, None] + np.zeros(points.shape[1])
    points[..., 2] += 0.02 * np.sin(rows / 9.0) * np.cos(np.arange(points.shape[1]) / 11.0)
    shot = segment_weld(points, 315.0, 6.0)
    wall = np.flatnonzero(shot.labels == Label.REFERENCE_WALL)
    wall = wall[:: max(1, len(wall) // 20_000)]
    columns = (each[wall].astype(np.float64) for each in (shot.angle_rad, shot.axial_mm, shot.deviation_mm))
    found, expected = wall_seen(shot), form_in_numpy(*columns)
    np.testing.assert_allclose(found, expected, atol=SAME_MM)
    assert expected[3] > 1e-3 and expected[1] > 0.05
