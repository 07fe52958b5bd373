"""What a calibration leaves unknown of the step of a standard weld: a pipe in the middle of where the boards stood."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import Scanner
from weldscan.calibration.modes import covariance_root, deviation_modes
from weldscan.result import CalibratedHull, StandardWeld

Floats = NDArray[np.float64]

RADIUS_MM = 109.5
HALF_ARC_RAD = math.radians(27.0)
"""So much of a pipe is measured from one place."""
HALF_CAP_MM, WALL_MM = 8.0, 40.0
STEPS_AROUND, STEPS_ALONG = 25, 9
# The step is asked for where both walls are seen on both sides of it.
ASKED_RAD = math.radians(20.0)
# A wall of fewer points is not in view.
LEAST_POINTS = 40


@dataclass(frozen=True, eq=False)
class _Scene:
    """Points of both walls that camera and projector see."""

    points: Floats
    normals: Floats
    angle: Floats
    """About the axis, 0 towards the scanner."""
    along: Floats


def standard_weld(
    scanner: Scanner, covariance: Floats, hull: CalibratedHull, middle_mm: Floats, axis: str
) -> StandardWeld:
    """What a calibration leaves unknown of the step of a pipe of 219 mm, its weld in the middle of the boards' volume.

    The pipe lies along the image's x, then along its y; the worse counts. To the walls, 40 mm on either side of a cap
    of 16 mm over 54 degrees, a cylinder is fitted and the other wall's departure from it (radius, place, direction);
    the covariance is propagated to the step between them within 20 degrees of the middle (JCGM 102:2011, 6.2).

    Args:
        scanner: as calibrated.
        covariance: (24, 24), of `bundle.PARAMETERS`.
        hull: where it is calibrated.
        middle_mm: (3,), where the weld is, scanner frame.
        axis: x or y, of the projector's coordinate that is decoded.
    """
    root = covariance_root(covariance)
    found = [_one(scanner, root, hull, _scene(scanner, middle_mm, lies), axis) for lies in (0, 1)]
    u = max((each.u_mm for each in found), default=math.nan)
    return StandardWeld(
        u, min(each.inside for each in found), min(each.deep_enough for each in found), float(middle_mm[2])
    )


def _scene(scanner: Scanner, middle: Floats, lies: int) -> _Scene:
    axis, zero = np.eye(3)[lies], np.array([0.0, 0.0, -1.0])
    angle, along = np.meshgrid(
        np.linspace(-HALF_ARC_RAD, HALF_ARC_RAD, STEPS_AROUND),
        np.concatenate([side * np.linspace(HALF_CAP_MM, HALF_CAP_MM + WALL_MM, STEPS_ALONG) for side in (-1, 1)]),
    )
    angle, along = angle.ravel(), along.ravel()
    normals = np.outer(np.cos(angle), zero) + np.outer(np.sin(angle), np.cross(axis, zero))
    points = middle + RADIUS_MM * (normals - zero) + np.outer(along, axis)
    seen = np.ones(len(points), dtype=bool)
    for pixels, lens in (
        (scanner.camera.project(points), scanner.camera),
        (scanner.project_to_projector(points), scanner.projector),
    ):
        seen &= ((pixels >= 0) & (pixels <= np.array([lens.width, lens.height]) - 1)).all(axis=1)
    return _Scene(points[seen], normals[seen], angle[seen], along[seen])


def _one(scanner: Scanner, root: Floats, hull: CalibratedHull, scene: _Scene, axis: str) -> StandardWeld:
    other = scene.along > 0
    if min(other.sum(), (~other).sum()) < LEAST_POINTS:
        return StandardWeld(math.inf, 0.0, 0.0, math.nan)
    inside = hull.holds(scanner.camera.project(scene.points), scanner.project_to_projector(scene.points))
    near, far = hull.depth_mm
    deep_enough = (scene.points[:, 2] >= near) & (scene.points[:, 2] <= far)
    cylinder = _cylinder(scene.angle, scene.along / RADIUS_MM)
    design = np.concatenate([cylinder, other[:, None] * cylinder], axis=1)
    modes = deviation_modes(scanner, root, scene.points, scene.normals, axis)
    asked = np.linspace(-ASKED_RAD, ASKED_RAD, 9)
    step = _cylinder(asked, np.zeros_like(asked)) @ np.linalg.lstsq(design, modes, rcond=None)[0][5:]
    u = float(np.sqrt(np.square(step).sum(axis=1).max()))
    return StandardWeld(u, float(inside.mean()), float(deep_enough.mean()), math.nan)


def _cylinder(angle: Floats, z: Floats) -> Floats:
    """Radius, place and direction of a cylinder as its radial deviation, (n, 5)."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([np.ones_like(angle), cos, sin, z * cos, z * sin], axis=1)
