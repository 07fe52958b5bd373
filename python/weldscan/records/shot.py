"""What a scan leaves beside a shot's images, `weldscan-shot/1`: a manifest with the SHA-256 of every file.

`shots/NAME/shot.json` is written last into a folder that then gets its name: a shot that has its name is whole. A
session from elsewhere has none, and nothing is held against it.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from weldscan.errors import InputError
from weldscan.records.fields import read_model
from weldscan.records.files import read_bytes
from weldscan.records.images import MAX_IMAGE_BYTES
from weldscan.records.plan import planned
from weldscan.records.session import ShotSpec

SHOT = "shot.json"
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
FileName = Annotated[str, Field(pattern=r"^[\w-]{1,60}\.png$")]


class ShotManifest(BaseModel):
    """`weldscan-shot/1`: one whole shot."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True, populate_by_name=True)

    schema_: Literal["weldscan-shot/1"] = Field(alias="schema")
    shot: ShotSpec
    files: dict[FileName, Sha256]
    record: dict[str, Any] = Field(default_factory=dict)
    """How it was taken: poses before and after, exposures, quality, times. For the record; nothing reads it."""


def read_manifest(folder: Path) -> ShotManifest:
    """Read a shot's manifest and hold every file against it. Raises `InputError`, naming what is not whole."""
    manifest = read_model(folder / SHOT, ShotManifest)
    for name, expected in manifest.files.items():
        found = hashlib.sha256(read_bytes(folder / name, MAX_IMAGE_BYTES)).hexdigest()
        if found != expected:
            raise InputError(f"{folder / name}: is not what the camera gave: its SHA-256 differs from {SHOT}")
    return manifest


@dataclass(frozen=True)
class Fault:
    """A shot of a scan that is not as it was taken."""

    shot: str
    code: str
    """`shot-altered` or `shot-missing`, of `weldscan.result.CODES`."""
    reason: str


def faults(folder: str | os.PathLike[str]) -> tuple[Fault, ...]:
    """Return what is wrong with the shots of a session folder, each once, with the reason.

    Those whose files are not what their manifest says, and those that the plan has and the folder has not. Empty for a
    session that no scan wrote.

    Args:
        folder: the session's folder.

    Raises:
        InputError: the plan cannot be read.
    """
    folder = Path(folder)
    found: dict[str, Fault] = {}
    shots = folder / "shots"
    for manifest in sorted(shots.glob(f"*/{SHOT}")) if shots.is_dir() else ():
        name = manifest.parent.name
        if name.startswith("."):
            continue
        try:
            read_manifest(manifest.parent)
        except InputError as error:
            found[name] = Fault(name, "shot-altered", str(error))
    plan = planned(folder)
    for name in () if plan is None else (shot.name for shot in plan.shots):
        if not (shots / name).is_dir():
            reason = "planned, but not scanned: weldscan scan --resume goes on"
            found.setdefault(name, Fault(name, "shot-missing", reason))
        elif not (shots / name / SHOT).is_file():
            reason = f"its {SHOT} is missing, so nobody knows whether it is whole"
            found.setdefault(name, Fault(name, "shot-altered", reason))
    return tuple(found.values())


def left_out(folder: str | os.PathLike[str]) -> tuple[tuple[str, str], ...]:
    """Return the shots of a session folder that an inspection cannot use, each with the reason: see `faults`."""
    return tuple((fault.shot, fault.reason) for fault in faults(folder))
