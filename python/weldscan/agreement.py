"""Part shots held against each other: what two of them saw of the same wall must be in the same place in base.

The step does not depend on it, for each shot has its own reference wall. What is placed through the robot does: cloud,
angles, the paper's number, a comparison with probed points. A part that was moved, or a wrong flange pose, shows here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldscan.calibration.hand_eye import pose_sigma
from weldscan.calibration.hand_eye_model import skew
from weldscan.result import HandEye, Label, PartCloud, ShotAgreement

Floats = NDArray[np.float64]

# Cells in which the walls are compared: small against any pipe's radius, and of tens of points.
CELL_MM = 4.0
LEAST_POINTS, LEAST_CELLS = 5, 20
# Points of a shot that are looked at; more would change nothing.
POINTS = 150_000
# Neighbouring cells share the scanner's errors: about so many count as one.
CORRELATED_CELLS = 4


@dataclass(frozen=True, eq=False)
class PlacedShot:
    """Where a part shot was taken from."""

    name: str
    index: int
    """In `PartCloud.shot`."""
    base_from_flange: Floats


def agreement(
    cloud: PartCloud, shots: Sequence[PlacedShot], hand_eye: HandEye, origin_mm: Floats, axis: Floats
) -> tuple[ShotAgreement, ...]:
    """The radial difference between every two shots where both saw a wall, with its uncertainty.

    Args:
        cloud: all points in base.
        shots: of the cloud.
        hand_eye: through which they were placed.
        origin_mm: (3,), a point of the pipe's axis in base.
        axis: (3,), its direction.

    Returns:
        One per pair that saw a wall together in 20 cells of 4 mm or more.
    """
    axis = axis / np.linalg.norm(axis)
    zero = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    zero /= np.linalg.norm(zero)
    across = np.cross(axis, zero)
    seen = [_cells(cloud, shot.index, origin_mm, axis, zero, across) for shot in shots]
    found = []
    for j, other in enumerate(shots):
        for i, one in enumerate(shots[:j]):
            common, a, b = np.intersect1d(seen[i][0], seen[j][0], return_indices=True)
            if len(common) < LEAST_CELLS:
                continue
            off = seen[j][1][b] - seen[i][1][a]
            middle = seen[i][2][a].mean(axis=0)
            radial = middle - origin_mm - axis * (axis @ (middle - origin_mm))
            normal = radial / np.linalg.norm(radial)
            difference = float(np.median(off))
            scatter = 1.4826 * float(np.median(np.abs(off - difference)))
            placing = _placing_mm([one, other], hand_eye, middle, normal)
            u_mm = math.hypot(placing, scatter / math.sqrt(len(common) / CORRELATED_CELLS))
            found.append(
                ShotAgreement(
                    shots=(one.name, other.name),
                    cells=len(common),
                    difference_mm=difference,
                    rms_mm=float(np.sqrt(np.square(off).mean())),
                    expanded_uncertainty_mm=2 * u_mm,
                )
            )
    return tuple(found)


def complaint(pair: ShotAgreement) -> str | None:
    """What to say of two shots that disagree by more than their uncertainty."""
    if abs(pair.difference_mm) <= pair.expanded_uncertainty_mm:
        return None
    return (
        f"{pair.shots[0]} and {pair.shots[1]} disagree by {abs(pair.difference_mm):.3f} mm where both saw the wall, "
        f"more than U = {pair.expanded_uncertainty_mm:.3f} mm: was the part moved, or is a flange pose wrong? Cloud, "
        "angles and the paper's number are placed through them; the step is not"
    )


def _cells(
    cloud: PartCloud, shot: int, origin: Floats, axis: Floats, zero: Floats, across: Floats
) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Of one shot's walls per cell of the unrolled pipe: its number, mean distance from the axis, middle in base."""
    walls = (cloud.label == Label.REFERENCE_WALL) | (cloud.label == Label.OTHER_WALL)
    chosen = np.flatnonzero(walls & (cloud.shot == shot))
    points = cloud.points_mm[chosen[:: max(1, len(chosen) // POINTS)]] - origin
    x, y, along = points @ zero, points @ across, points @ axis
    radius = np.hypot(x, y)
    if len(radius) == 0:
        return np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3))
    # A round number of cells around, the same for every shot.
    around = np.floor((np.arctan2(y, x) / (2 * math.pi) % 1.0) * _cells_around(cloud, origin, axis)).astype(np.int64)
    key = around * 1_000_003 + np.floor(along / CELL_MM).astype(np.int64)
    cells, place, count = np.unique(key, return_inverse=True, return_counts=True)
    mean = np.bincount(place, radius) / count
    middle = np.stack([np.bincount(place, points[:, k]) / count for k in range(3)], axis=1) + origin
    good = count >= LEAST_POINTS
    return cells[good], mean[good], middle[good]


def _cells_around(cloud: PartCloud, origin: Floats, axis: Floats) -> int:
    few = cloud.points_mm[:: max(1, len(cloud.points_mm) // 1000)] - origin
    radius = float(np.median(np.linalg.norm(few - np.outer(few @ axis, axis), axis=1)))
    return max(8, round(2 * math.pi * radius / CELL_MM))


def _placing_mm(shots: Sequence[PlacedShot], hand_eye: HandEye, point: Floats, normal: Floats) -> float:
    """Standard uncertainty of the difference of two shots' places of a point, along the normal.

    The hand-eye is common to both: what moves both alike does not count. Each has a flange pose of its own.
    """
    x, (pose_mm, pose_rad) = hand_eye.flange_from_scanner, pose_sigma(hand_eye)
    common, variance = np.zeros(6), 0.0
    for sign, shot in zip((-1.0, 1.0), shots, strict=True):
        turn, place = shot.base_from_flange[:3, :3], shot.base_from_flange[:3, 3]
        in_flange = turn.T @ (point - place)
        in_scanner = x[:3, :3].T @ (in_flange - x[:3, 3])
        common += sign * (normal @ turn @ np.hstack([-x[:3, :3] @ skew(in_scanner), np.eye(3)]))
        variance += pose_mm**2 + pose_rad**2 * float(np.square(np.cross(point - place, normal)).sum())
    return math.sqrt(variance + float(common @ hand_eye.covariance @ common))
