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

from weldscan.errors import InputError, Unreadable
from weldscan.records.fields import parse_model
from weldscan.records.files import listed, parse_json, read_bytes, read_text
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


class NotUnderstood(InputError):
    """A shot's manifest is JSON, but not as this weldscan knows it: that says nothing about the shot's images."""


def read_manifest(folder: Path) -> ShotManifest:
    """Read a shot's manifest and hold every file against it.

    A shot on disk is in one of three states: whole, provably different from what was taken, or nobody knows. The first
    is returned, and each of the others has errors of its own.

    Raises:
        InputError: a file is missing, is no regular file, is no JSON, or its SHA-256 is another: it is different.
        Unreadable: the system does not give a file: nobody knows.
        NotUnderstood: a field of the manifest is unknown or wrong: nobody knows either.
    """
    path = folder / SHOT
    text = read_text(path)
    parse_json(text, path)
    try:
        manifest = parse_model(text, ShotManifest, path)
    except InputError as error:
        raise NotUnderstood(str(error)) from None
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
        Unreadable: nor a file of a shot.
    """
    folder = Path(folder)
    found: dict[str, Fault] = {}
    shots = folder / "shots"
    there = {entry.name: entry for entry in listed(shots) if not entry.name.startswith(".")}
    for name, shot in there.items():
        if not (shot / SHOT).is_file():
            continue
        try:
            read_manifest(shot)
        except Unreadable:
            raise
        except InputError as error:
            found[name] = Fault(name, "shot-altered", str(error))
    plan = planned(folder)
    for name in () if plan is None else (shot.name for shot in plan.shots):
        if name not in there or not there[name].is_dir():
            reason = "planned, but not scanned: weldscan scan --resume goes on"
            found.setdefault(name, Fault(name, "shot-missing", reason))
        elif not (there[name] / SHOT).is_file():
            reason = f"its {SHOT} is missing, so nobody knows whether it is whole"
            found.setdefault(name, Fault(name, "shot-altered", reason))
    return tuple(found.values())


def left_out(folder: str | os.PathLike[str]) -> tuple[tuple[str, str], ...]:
    """Return the shots of a session folder that an inspection cannot use, each with the reason: see `faults`."""
    return tuple((fault.shot, fault.reason) for fault in faults(folder))
