"""Which bins of the seam lie in the views' field: the seam that a verdict speaks about."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import Scanner
from weldscan.simulated.scenes.scene import Scene, View
from weldscan.simulated.scenes.welds import Floats, SceneWeld

BIN_DEG = 2
"""Bins of the truth, centred on even degrees as those of a result's profile."""


GRAZING = math.cos(math.radians(75.0))
"""Cosine of light or view below which a surface shows no fringes; the core's rays have the same."""


def seen_arc(scene: Scene) -> list[int]:
    """Return the 2 degree bins (their middles, whole degrees) of the seam that lie wholly in some view's field.

    The field is geometry alone: inside the images of camera and projector and facing both by less than 75 degrees on
    the nominal pipe. What is dark, hidden or saturated there counts: it is seam that a verdict speaks about.
    """
    return bins_of(scene.views, scene.welds[0], scene.scanner)


def bins_of(views: Sequence[View], weld: SceneWeld, scanner: Scanner) -> list[int]:
    quarter = np.radians(np.arange(0.0, 360.0, 0.25))
    inside = np.zeros(len(quarter), dtype=bool)
    for view in views:
        inside |= _in_field(np.asarray(view.weld_from_scanner), weld, scanner, quarter)
    whole = inside & np.roll(inside, -1)
    per_bin = int(BIN_DEG / 0.25)
    starts = [(c * 4 - per_bin // 2) % len(quarter) for c in range(0, 360, BIN_DEG)]
    return [
        c
        for c, s in zip(range(0, 360, BIN_DEG), starts, strict=True)
        if np.take(whole, range(s, s + per_bin), mode="wrap").all()
    ]


def _in_field(pose: Floats, weld: SceneWeld, scanner: Scanner, angle: Floats) -> NDArray[np.bool_]:
    outward = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    points = weld.radius_mm * outward + np.array([0.0, 0.0, weld.seam_mm])
    inverse = np.linalg.inv(pose)
    in_camera = points @ inverse[:3, :3].T + inverse[:3, 3]
    lamp = pose[:3, :3] @ scanner.camera_from_projector[:3, 3] + pose[:3, 3]
    inside = np.ones(len(angle), dtype=bool)
    for eye, pixel, lens in (
        (pose[:3, 3], scanner.camera.project(in_camera), scanner.camera),
        (lamp, scanner.project_to_projector(in_camera), scanner.projector),
    ):
        away = eye - points
        cosine = (outward * away).sum(axis=1) / np.linalg.norm(away, axis=1)
        with np.errstate(invalid="ignore"):
            shown = (pixel >= -0.5).all(axis=1) & (pixel <= np.array([lens.width, lens.height]) - 0.5).all(axis=1)
        inside &= (cosine > GRAZING) & shown
    return inside


def angles_of(bins: Sequence[int], radius_mm: float) -> Floats:
    """Return angles (bins, n), rad, in each bin half a millimetre apart or closer, the middle among them."""
    half = min(20, max(2, math.ceil(math.radians(BIN_DEG / 2) * radius_mm / 0.5)))
    inside = np.linspace(-BIN_DEG / 2, BIN_DEG / 2, 2 * half + 1)
    return np.radians(np.asarray(bins, dtype=float)[:, None] + inside)
