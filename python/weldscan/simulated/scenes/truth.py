"""What is true of a scene: the step between the two walls' surfaces at the toes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from weldscan.simulated.scenes.kinds import KINDS
from weldscan.simulated.scenes.scene import Scene
from weldscan.simulated.scenes.seen_arc import angles_of, seen_arc
from weldscan.simulated.scenes.welds import Floats, SceneWeld, surface_of

HONEST, OVER = 0.8, (1.05, 3.0)
"""Largest true step in parts of the limit: of an honest scene at most, of a defective one from and to."""


def _edge_step(weld: SceneWeld, edges: Floats, angles: Floats) -> Floats:
    """Return the step between the surfaces at both toes, along the bisector of the walls' directions there."""
    slopes = [
        wall.tilt_rad[0] * np.cos(angles) + wall.tilt_rad[1] * np.sin(angles) for wall in (weld.reference, weld.other)
    ]
    step: Floats = edges[:, 3] - edges[:, 2] - 0.5 * (slopes[0] + slopes[1]) * (edges[:, 1] - edges[:, 0])
    return step


def _steps(weld: SceneWeld, angles: Floats) -> Floats:
    """Return the step at the angles; with a second weld in view, the one of the two that is larger."""
    edges = surface_of(weld).edges(angles.ravel())
    first, second = _edge_step(weld, edges, angles.ravel()), edges[:, 5]
    larger: Floats = np.where(np.abs(second) > np.abs(first), second, first)
    return larger.reshape(angles.shape)


def truth(scene: Scene) -> dict[str, Any]:
    """Return what is true of a scene.

    Returns:
        `edge_step_by_deg`: other wall minus reference wall, along the bisector of the two walls' directions, each
        surface as it is at its toe (waves, shrinkage, dents, machining included; spatter left out), mm, in the middle
        of each bin of `seen_arc`; where two pipes or two welds were shot, the larger one. `range_by_deg`: the least and
        the largest in each bin.
        `largest` in magnitude anywhere in those bins and `largest_at_deg`; `limit_mm`; `honest`: the largest is not
        above 0.8 of the limit; `kind`, `what`.

    >>> truth(draw("taper 1:10", 1))["honest"]
    False
    """
    bins = seen_arc(scene)
    used = sorted({view.weld for view in scene.views})
    angles = angles_of(bins, scene.welds[0].radius_mm)
    steps = np.array([_steps(scene.welds[i], angles) for i in used])
    middle = angles.shape[1] // 2
    largest_of = np.abs(steps[:, :, middle]).argmax(axis=0)
    by_deg = steps[largest_of, np.arange(len(bins)), middle]
    low, high = steps.min(axis=(0, 2)), steps.max(axis=(0, 2))
    worst = np.maximum(np.abs(low), np.abs(high))
    at = int(worst.argmax())
    limit = scene.limit_mm
    return {
        "kind": scene.kind,
        "what": KINDS[scene.kind].what if scene.kind in KINDS else scene.kind,
        "edge_step_by_deg": {str(c): round(float(s), 5) for c, s in zip(bins, by_deg, strict=True)},
        "range_by_deg": {
            str(c): [round(float(a), 5), round(float(b), 5)] for c, a, b in zip(bins, low, high, strict=True)
        },
        "largest": round(float(worst[at]), 5),
        "largest_at_deg": bins[at],
        "limit_mm": limit,
        "honest": bool(worst[at] <= HONEST * limit * (1 + 1e-6)),
    }


def toes(scene: Scene, angle_deg: Sequence[float] | Floats, weld: int = 0) -> dict[str, Floats]:
    """Return per angle the true toes (z, mm), the step between the surfaces there, width and height of the cap, mm."""
    angles = np.radians(np.asarray(angle_deg, np.float64))
    edges = surface_of(scene.welds[weld]).edges(angles)
    return {
        "reference_mm": edges[:, 0],
        "other_mm": edges[:, 1],
        "step_mm": _edge_step(scene.welds[weld], edges, angles),
        "width_mm": edges[:, 1] - edges[:, 0],
        "height_mm": edges[:, 4],
    }
