"""What a scan leaves beside its images: a manifest per shot, with the SHA-256 of every file, and the plan it followed.

`shots/NAME/shot.json` (`weldscan-shot/1`) is written last into a folder that then gets its name: a shot that has its
name is whole. `plan.json` is the session that was to be scanned. A session from elsewhere has neither, and nothing is
held against it.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from weldscan.errors import InputError
from weldscan.session import Session, ShotSpec, explain, parse_session, read_text

SHOT, PLAN = "shot.json", "plan.json"
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
    path = folder / SHOT
    try:
        manifest = ShotManifest.model_validate_json(read_text(path))
    except ValidationError as error:
        raise InputError(f"{path}: {explain(error)}") from None
    for name, expected in manifest.files.items():
        try:
            found = hashlib.sha256((folder / name).read_bytes()).hexdigest()
        except OSError as error:
            raise InputError(f"{folder / name}: {error.strerror or error}") from None
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


def read_plan(path: Path) -> Session:
    """Read a plan: a session document whose poses are where the flange shall go."""
    return parse_session(path)


def planned(folder: Path) -> Session | None:
    """Return the plan that a session folder was scanned by; None where no scan wrote it."""
    path = folder / PLAN
    return read_plan(path) if path.is_file() else None


# --- writing that survives a power cut --------------------------------------------------------------------------------


def write_durably(path: Path, data: bytes) -> None:
    """Write a file and wait until the disk has it."""
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Wait until the disk has a folder's entries; systems that cannot sync folders do without."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def replace_durably(path: Path, data: bytes) -> None:
    """Give a file new contents: a reader sees the old ones or the new ones, whole."""
    fresh = path.with_name(f".{path.name}.new")
    write_durably(fresh, data)
    fresh.replace(path)
    sync_folder(path.parent)


def to_bytes(document: Mapping[str, Any]) -> bytes:
    """Return a JSON document as the bytes of its file."""
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()
