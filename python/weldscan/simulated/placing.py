"""Where things stand: poses, viewpoints around a target, and a scanner by its numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import Lens, Scanner
from weldscan.geometry import rigid, rotation_of

Floats: TypeAlias = NDArray[np.float64]


Matrix: TypeAlias = tuple[tuple[float, ...], ...]


def look_at(
    target: Sequence[float] | Floats, position: Sequence[float] | Floats, up: Sequence[float] | Floats
) -> Floats:
    """Return the 4x4 pose of a camera at `position` that looks at `target`; its image's y runs against `up`."""
    z = np.asarray(target, dtype=float) - position
    z /= np.linalg.norm(z)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    pose[:3, 3] = position
    return pose


def placed(
    translation: Sequence[float] | Floats, rotation_vector: Sequence[float] | Floats = (0.0, 0.0, 0.0)
) -> Floats:
    """Return the 4x4 transform of a translation (mm) and a rotation vector (rad)."""
    return rigid(rotation_of(rotation_vector), translation)


def moved(pose: Floats, points: Floats) -> Floats:
    moved: Floats = points @ pose[:3, :3].T + pose[:3, 3]
    return moved


def _intrinsics(fx: float, fy: float, cx: float, cy: float) -> Floats:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def make_scanner(
    camera: Lens | None = None,
    projector: Lens | None = None,
    *,
    convergence_deg: float = 20.0,
    distance_mm: float = 420.0,
    axis: Literal["x", "y"] = "x",
) -> Scanner:
    """Return a scanner like a DAVID SLS-2: the axes of camera and projector meet at the working distance.

    Args:
        camera: its lens; by default 1280x960 px with distortion.
        projector: its lens; by default 1280x800 px with distortion.
        convergence_deg: angle between the two axes.
        distance_mm: working distance.
        axis: the projector stands beside the camera ("x") or above it ("y"): the fringes' axis must agree.
    """
    if camera is None:
        camera = Lens(1280, 960, _intrinsics(2610.0, 2611.0, 644.2, 470.8), [-0.11, 0.15, 0.0003, -0.0005])
    if projector is None:
        projector = Lens(1280, 800, _intrinsics(2080.0, 2080.0, 641.0, 402.5), [0.025, -0.02, 0.0002, -0.0001])
    angle = math.radians(convergence_deg)
    aside, ahead = distance_mm * math.sin(angle), distance_mm * (1 - math.cos(angle))
    position = (-aside, 4.0, ahead) if axis == "x" else (4.0, -aside, ahead)
    return Scanner(camera, projector, look_at((0.0, 0.0, distance_mm), position, (0.0, -1.0, 0.0)))


def tilted_views(base_from_target: Matrix | Floats, count: int, *, distance_mm: float = 420.0) -> list[Floats]:
    """Return base_from_scanner per shot of a target whose z faces the scanner: a three-sphere plate, a board.

    Tilted by 30 to 45 degrees to all sides, rolled, near and far: what hand-eye and scanner calibration need.
    """
    target = np.asarray(base_from_target)
    views = []
    for i in range(count):
        # The golden section spreads any number of shots around the target.
        around = 2 * math.pi * (i * 0.381966 + 0.1)
        tilt = math.radians((31.0, 44.0, 36.0, 40.0, 33.0, 42.0)[i % 6])
        distance = distance_mm + (0.0, 22.0, -18.0, 10.0, -9.0, 16.0)[i % 6]
        roll = math.radians((15.0, 105.0, -70.0, 200.0, 60.0, -30.0)[i % 6])
        direction = np.array([math.sin(tilt) * math.cos(around), math.sin(tilt) * math.sin(around), math.cos(tilt)])
        view = look_at((0.0, 0.0, 0.0), direction * distance, (0.0, 0.0, 1.0))
        views.append(target @ view @ placed((0.0, 0.0, 0.0), (0.0, 0.0, roll)))
    return views
