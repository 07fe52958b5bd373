"""What the views of a scene saw, as clouds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weldscan.simulated.scenes.scene import Scene
from weldscan.simulated.scenes.welds import Floats, surface_of

OK, DARK, SATURATED, ORDER, NO_FIT = range(5)
"""Why a pixel has no point, as `decode` has it."""


@dataclass(frozen=True, eq=False)
class Shot:
    """One view's cloud."""

    name: str
    points_mm: Floats
    """(H, W, 3), scanner's frame; NaN where there is none."""
    reason: NDArray[np.uint8]
    """(H, W): 0 a point, else why not, as `decode` has it."""
    base_from_flange: Floats
    """As the robot stated it; the scanner's frame is the flange's."""
    seen: Mapping[str, NDArray[Any]]
    """What every pixel sees in truth: `WeldSurface.cast`."""


def views(scene: Scene) -> Iterator[Shot]:
    """Yield the clouds of a scene's views, with noise along the camera's rays.

    >>> shot = next(views(draw("plain", 0)))
    >>> shot.points_mm.shape, shot.reason.shape
    ((360, 480, 3), (360, 480))
    """
    for number, view in enumerate(scene.views):
        random = np.random.default_rng([scene.seed, number, 1])
        seen = surface_of(scene.welds[view.weld]).cast(scene.scanner, view.weld_from_scanner)
        reason = reason_of(scene, seen, random)
        points = seen["points_mm"]
        ray = points / np.linalg.norm(points, axis=2, keepdims=True)
        points = points + ray * random.normal(0.0, scene.noise_mm, (*reason.shape, 1))
        points[reason != OK] = np.nan
        yield Shot(view.name, points, reason, np.asarray(view.base_from_flange), seen)


def brightness(seen: Mapping[str, NDArray[Any]]) -> Floats:
    """Return how bright each pixel is under even light: Lambert and the lobe of brushed steel; 0 for nothing."""
    bright: Floats = 0.6 * np.maximum(seen["light"], 0.0) + 0.5 * np.maximum(seen["gloss"], 0.0) ** 22
    return np.where(seen["status"] == 0, bright, 0.0)


def reason_of(scene: Scene, seen: Mapping[str, NDArray[Any]], random: np.random.Generator) -> NDArray[np.uint8]:
    lit = seen["status"] == 0
    reason = np.where(lit, OK, DARK).astype(np.uint8)
    angle = np.degrees(np.nan_to_num(seen["angle_rad"]))
    for start, end in scene.dark_deg:
        reason[(angle - start) % 360.0 < end - start] = DARK
    if scene.holes > 0.0:
        # Patches: noise smoothed over a few pixels, of which the largest values are lost. Up to some 4 mm: larger ones
        # hide a stretch of the seam, and that is another kind.
        patch = random.normal(size=lit.shape)
        patch = cv2.GaussianBlur(patch, (0, 0), random.uniform(1.0, 4.0))
        lost = patch > np.quantile(patch, 1.0 - scene.holes)
        reason[lost & (reason == OK)] = random.choice([DARK, ORDER, NO_FIT])
    if scene.saturated > 0.0 and lit.any():
        bright = brightness(seen)
        reason[(bright > np.quantile(bright[lit], 1.0 - scene.saturated)) & (reason == OK)] = SATURATED
    return reason
