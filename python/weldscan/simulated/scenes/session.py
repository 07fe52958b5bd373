"""A scene as a recorded session, with fringe images."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weldscan.pose import KukaPose
from weldscan.records.images import Frames
from weldscan.records.session import Session, write_session
from weldscan.simulated.scenes.clouds import OK, SATURATED, brightness, reason_of
from weldscan.simulated.scenes.scene import Scene
from weldscan.simulated.scenes.truth import truth
from weldscan.simulated.scenes.welds import surface_of

FRINGES = (("x", 1, 4), ("x", 8, 4), ("x", 64, 4))


def record(scene: Scene, folder: str | os.PathLike[str]) -> dict[str, Any]:
    """Write a whole `weldscan-session/1` of the scene: 8-bit fringe images, stated poses, hand-eye, and `truth.json`.

    The images' noise is what gives a point the scene's noise, as far as 8 bits allow.

    Args:
        scene: as `draw` gives it.
        folder: must not exist yet, or be empty.

    Returns:
        The truth.

    Raises:
        InputError: the folder is in the way.
    """
    known = truth(scene)
    session = Session.model_validate_json(json.dumps(session_document(scene)))
    write_session(folder, session, _frames(scene), extra={"truth.json": json.dumps(known, indent=1)})
    return known


def session_document(scene: Scene) -> dict[str, Any]:
    """Return the scene's session.json as a document."""
    weld, base = scene.welds[0], np.asarray(scene.base_from_weld)
    scanner = scene.scanner
    lens = [
        {"width": d.width, "height": d.height, "K": d.K.tolist(), "dist": list(d.dist)[:4]}
        for d in (scanner.camera, scanner.projector)
    ]
    shots = [
        {
            "name": view.name,
            "of": "part",
            "flange_pose": dict(zip("XYZABC", KukaPose.from_matrix(view.base_from_flange).values(), strict=True)),
        }
        for view in scene.views
    ]
    return {
        "schema": "weldscan-session/1",
        "name": f"{scene.kind} {scene.seed}",
        "scanner": {
            "camera": lens[0],
            "projector": lens[1],
            "camera_from_projector": scanner.camera_from_projector.tolist(),
        },
        "fringes": [{"axis": axis, "periods": periods, "steps": steps} for axis, periods, steps in FRINGES],
        "part": {
            "kind": "pipe",
            "outside_diameter": round(2 * weld.radius_mm, 6),
            "wall_thickness": weld.thickness_mm,
            "joint": "circumferential butt",
            "axis_base": base[:3, 2].tolist(),
            "zero_base": base[:3, 0].tolist(),
        },
        "shots": shots,
        "robot": {"model": "KUKA"},
        "hand_eye": {
            "schema": "weldscan-hand-eye/1",
            "id": "scene",
            "date": "2026-01-01",
            "flange_from_scanner": np.eye(4).tolist(),
            "covariance": np.diag([1e-9] * 3 + [2.5e-4] * 3).tolist(),
            "residual_rms_mm": 0.02,
        },
    }


def _frames(scene: Scene) -> Iterator[tuple[str, Frames]]:
    scanner = scene.scanner
    for number, view in enumerate(scene.views):
        random = np.random.default_rng([scene.seed, number, 1])
        seen = surface_of(scene.welds[view.weld]).cast(scanner, view.weld_from_scanner)
        reason = reason_of(scene, seen, random)
        bright = brightness(seen)
        lit = bright > 0.0
        if not lit.any():
            bright[:] = 0.0
        elif scene.saturated > 0.0:
            # Full scale is passed by the share that is said.
            bright = bright / np.quantile(bright[lit], 1.0 - scene.saturated) * 127.5
        else:
            bright = np.clip(bright / np.median(bright[lit]) * 90.0, 0.0, 120.0)
        dark = (reason != OK) & (reason != SATURATED)
        bright[dark] = 0.0
        noise = _level_noise(scene, seen, np.median(bright[lit & ~dark]) if (lit & ~dark).any() else 90.0)
        column = np.nan_to_num(seen["column_px"])
        images = []
        for _, periods, steps in FRINGES:
            phase = 2 * math.pi * periods * (column + 0.5) / scanner.projector.width
            for i in range(steps):
                level = 5.0 + bright + bright * np.cos(phase - 2 * math.pi * i / steps)
                level += random.normal(0.0, noise, level.shape)
                images.append(np.clip(np.rint(level), 0, 255).astype(np.uint8))
        yield view.name, [images]


def _level_noise(scene: Scene, seen: Mapping[str, NDArray[Any]], modulation: float) -> float:
    """Return the noise of a level that gives a point the scene's noise, 8-bit rounding already in it."""
    lit = seen["status"] == 0
    points = seen["points_mm"][lit][::37]
    if len(points) == 0:
        return 1.0
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    there = scene.scanner.project_to_projector(points + 0.1 * ray)[:, 0]
    px_per_mm = float(np.median(np.abs(there - scene.scanner.project_to_projector(points)[:, 0]))) / 0.1
    _, periods, steps = FRINGES[-1]
    phase = 2 * math.pi * periods / scene.scanner.projector.width * px_per_mm * scene.noise_mm
    wanted = phase * modulation * math.sqrt(steps / 2)
    return math.sqrt(max(wanted**2 - 1 / 12, 0.05**2))
