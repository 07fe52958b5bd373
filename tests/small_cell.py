"""The simulated cell with fewer, larger camera pixels, and copies of its sessions to spoil."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from weldscan import Lens, Scanner
from weldscan.result import Finding, Inspection
from weldscan.simulated import DEFAULT, make_scanner


def small_scanner(scale: int = 4, axis: str = "x") -> Scanner:
    """The default scanner with fewer, larger camera pixels."""
    whole = make_scanner(axis=axis)  # type: ignore[arg-type]
    k = whole.camera.K / scale
    k[2, 2] = 1.0
    camera = Lens(whole.camera.width // scale, whole.camera.height // scale, k, whole.camera.dist)
    return Scanner(camera, whole.projector, whole.camera_from_projector)


CELL = replace(DEFAULT, scanner=small_scanner(2), artefact_shots=2)
Change = Callable[[dict[str, Any]], object]


def copied(folder: Path, target: Path, change: Change = lambda _: None) -> Path:
    """A copy of a session to spoil, its images linked."""
    for path in folder.rglob("*.*"):
        there = target / path.relative_to(folder)
        there.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".png":
            there.symlink_to(path)
        else:
            shutil.copyfile(path, there)
    document = json.loads((target / "session.json").read_text())
    change(document)
    (target / "session.json").write_text(json.dumps(document))
    return target


def pose_of(document: dict[str, Any], name: str) -> dict[str, float]:
    pose: dict[str, float] = next(shot for shot in document["shots"] if shot["name"] == name)["flange_pose"]
    return pose


def of(found: Inspection, code: str) -> list[Finding]:
    return [finding for finding in found.findings if finding.code == code]
