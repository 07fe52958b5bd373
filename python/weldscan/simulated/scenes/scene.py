"""A scene: welds, who looked at them from where, and what the pixels lost; and the scanner for a field of view."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from weldscan._weldcore import Lens, Scanner
from weldscan.errors import InputError
from weldscan.norms import limit_mm
from weldscan.simulated.scenes.welds import Matrix, SceneWeld

NORM = ("pnae-g-7-010-89", "Table 1, column 2")
"""Whose limit a scene's step is drawn against."""


@dataclass(frozen=True)
class View:
    """One shot: where the scanner stood in the weld's frame, and what the robot said of it."""

    name: str
    weld_from_scanner: Matrix
    base_from_flange: Matrix
    """As stated: with the robot's error. The scanner's frame is the flange's."""
    weld: int = 0
    """Which of the scene's welds it is of."""


@dataclass(frozen=True)
class Scene:
    """A weld (two, where the shots are of two pipes), who looked at it from where, and what the pixels lost."""

    kind: str
    seed: int
    welds: tuple[SceneWeld, ...]
    views: tuple[View, ...]
    field_mm: float
    """What the camera sees along the pipe: it sets the scanner."""
    base_from_weld: Matrix
    noise_mm: float = 0.03
    """Of a point, along the camera's ray."""
    holes: float = 0.0
    """Share of the pixels without a point, in patches."""
    dark_deg: tuple[tuple[float, float], ...] = ()
    """Arcs without light, from and to; the second may pass 360."""
    saturated: float = 0.0
    """Share of the lit pixels, the brightest ones, that are saturated."""

    @property
    def scanner(self) -> Scanner:
        """The scanner."""
        return scanner_for(self.field_mm)

    @property
    def limit_mm(self) -> float:
        """The norm's limit for this wall thickness."""
        return limit_for(self.welds[0].thickness_mm)


def limit_for(thickness_mm: float) -> float:
    """Return the largest step that PNAE G-7-010-89 allows, column 2, mm.

    >>> limit_for(6.0)
    1.1
    """
    found = limit_mm(*NORM, thickness_mm)
    if found is None:
        raise InputError(f"thickness_mm: {thickness_mm} has no limit in {NORM[0]}")
    return found[0]


# The scanner that the sessions of an independent renderer have: camera 480x360, projector 1280x800, 20 degrees.
_FOCAL_PX, _PROJECTOR_PX = 979.0, 2080.0


_FAR_MM, FIELD_MM = 430.0, 480 / 979.0 * 430.0


_CONVERGENCE = math.radians(20.0)


_NEAREST_MM = 200.0


def distance_for(field_mm: float) -> float:
    """Return the working distance for a field of view: 430 mm for 211 mm, not below 200 mm."""
    return max(_NEAREST_MM, _FAR_MM * min(1.0, field_mm / FIELD_MM))


@lru_cache(maxsize=16)
def scanner_for(field_mm: float) -> Scanner:
    """Return a scanner whose camera sees `field_mm` along its rows from `distance_for(field_mm)`.

    >>> round(scanner_for(211.0).baseline_mm)
    148
    """
    distance = distance_for(field_mm)
    # A smaller field at the shortest distance is seen through longer lenses.
    zoom = distance / _FAR_MM * FIELD_MM / field_mm
    near = distance / _FAR_MM
    s, c = math.sin(_CONVERGENCE), math.cos(_CONVERGENCE)
    turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    pose = np.eye(4)
    pose[:3, :3] = turn
    # Both axes meet at the working distance.
    pose[:3, 3] = np.array([0.0, 4.0 * near, distance]) - turn @ np.array([0.0, 0.0, distance * 0.99])
    focal, lamp = _FOCAL_PX * zoom, _PROJECTOR_PX * zoom
    return Scanner(
        Lens(480, 360, [[focal, 0.0, 239.7], [0.0, focal, 180.4], [0.0, 0.0, 1.0]], [0.0] * 4),
        Lens(1280, 800, [[lamp, 0.0, 641.0], [0.0, lamp, 402.5], [0.0, 0.0, 1.0]], [0.0] * 4),
        pose,
    )
