"""Captures of a board to calibrate a scanner by, `weldscan-calibration/1`: `calibration.json`, or SLStudio's layout."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from weldscan.errors import InputError
from weldscan.records.fields import Model, Pixels, PlainName, Positive, read_model
from weldscan.records.files import inside, read_text
from weldscan.records.session import FringeSet

MANIFEST = "calibration.json"
SCHEMA = "weldscan-calibration/1"


class Size(Model):
    """Of an image, pixels."""

    width: Pixels
    height: Pixels


class PoseSpec(Model):
    """One pose of the board: a folder of images."""

    name: PlainName
    folder: Annotated[str, Field(min_length=1, max_length=500)] | None = None
    """Relative to the calibration's; absent: shots/NAME."""
    exposures: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=100)] | None = None


class CaptureSpec(Model):
    """`calibration.json`: what the images of a calibration are."""

    schema_: Literal["weldscan-calibration/1"] = Field(alias="schema")
    projector: Size
    fringes: Annotated[tuple[FringeSet, ...], Field(min_length=2, max_length=100)]
    board: str | None = None
    temperature_c: Annotated[float, Field(ge=-100, le=200)] | None = None
    frames: tuple[str, ...] | None = None
    """Names of a pose's images in the order of fringes, then of steps; absent: 000.png, 001.png ..."""
    poses: Annotated[tuple[PoseSpec, ...], Field(min_length=1, max_length=1000)] | None = None
    """Absent: every folder in shots/, by name."""


@dataclass(frozen=True)
class Captures:
    """A calibration's folder, checked."""

    folder: Path
    spec: CaptureSpec
    poses: tuple[PoseSpec, ...]

    def files(self, pose: PoseSpec) -> list[list[Path]]:
        """A pose's images: exposures x frames."""
        count = sum(fringe.steps for fringe in self.spec.fringes)
        names = self.spec.frames or tuple(f"{i:03d}.png" for i in range(count))
        exposures = len(pose.exposures or (1.0,))
        folder = self.folder / (pose.folder or f"shots/{pose.name}")
        prefixes = [""] if exposures == 1 else [f"e{i}_" for i in range(exposures)]
        return [[folder / f"{prefix}{name}" for name in names] for prefix in prefixes]


def read_captures(folder: str | os.PathLike[str]) -> Captures:
    """The checked description of a calibration's folder; its images stay on disk.

    Raises:
        InputError: there is none, or a field of it is wrong; one line that names file and field.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: {'is not a folder' if folder.exists() else 'no such folder'}")
    path = folder / MANIFEST
    if not path.is_file():
        found = _slstudio(folder)
        if found is None:
            raise InputError(f"{path}: no such file; docs/formats.md says what it holds")
        return found
    spec = read_model(path, CaptureSpec)
    _check(path, spec)
    poses = spec.poses
    if poses is None:
        shots = folder / "shots"
        names = sorted(p.name for p in shots.iterdir() if p.is_dir() and p.name[0] != ".") if shots.is_dir() else []
        if not names:
            raise InputError(f"{shots}: has no folder of images in it")
        poses = tuple(PoseSpec(name=name) for name in names)
    for pose in poses:
        inside(folder, pose.folder or f"shots/{pose.name}", f"{path}: poses", "folder", "calibration's")
    return Captures(folder, spec, poses)


def _check(path: Path, spec: CaptureSpec) -> None:
    axes = {fringe.axis for fringe in spec.fringes}
    if len(axes) < 2:
        missing = "y" if "x" in axes else "x"
        raise InputError(f"{path}: fringes: none along {missing}; a projector needs both axes to be calibrated")
    seen: set[tuple[str, float]] = set()
    for index, fringe in enumerate(spec.fringes):
        side = spec.projector.width if fringe.axis == "x" else spec.projector.height
        if (fringe.axis, fringe.periods) in seen:
            raise InputError(f"{path}: fringes.{index}.periods: {fringe.periods:g} is there twice on {fringe.axis}")
        if 2 * fringe.periods > side:
            raise InputError(
                f"{path}: fringes.{index}.periods: {side} projector pixels cannot show {fringe.periods:g} fringes"
            )
        seen.add((fringe.axis, fringe.periods))
    count = sum(fringe.steps for fringe in spec.fringes)
    if spec.frames is not None and len(spec.frames) != count:
        raise InputError(f"{path}: frames: {len(spec.frames)} names, but the fringes have {count} images")
    for name in spec.frames or ():
        if not re.fullmatch(r"[\w+-][\w .+-]*", name):
            raise InputError(f"{path}: frames: {name!r} is not the name of a file")
    names = [pose.name.casefold() for pose in spec.poses or ()]
    if len(set(names)) < len(names):
        raise InputError(f"{path}: poses: a name is there twice")


def _slstudio(folder: Path) -> Captures | None:
    """SLStudio's layout: calseqN/frameSeq_00.png ... 11.png, its 2x3 code along x, then y; its file says the size."""
    names = sorted((p.name for p in folder.glob("calseq*") if p.is_dir()), key=lambda n: (len(n), n))
    if not names:
        return None
    path = folder / "calibration.xml"
    text = read_text(path)
    width, height = (re.search(rf"<{tag}>\s*(\d{{1,5}})\s*</{tag}>", text) for tag in ("screenResX", "screenResY"))
    if width is None or height is None:
        raise InputError(f"{path}: does not say the projector's size (screenResX, screenResY); a {MANIFEST} can")
    sets = [{"axis": axis, "periods": periods, "steps": 3} for axis in ("x", "y") for periods in (16.0, 1.0)]
    spec = CaptureSpec(
        schema="weldscan-calibration/1",
        projector=Size(width=int(width[1]), height=int(height[1])),
        fringes=tuple(FringeSet.model_validate(s) for s in sets),
        frames=tuple(f"frameSeq_{i:02d}.png" for i in range(12)),
        poses=tuple(PoseSpec(name=name, folder=name) for name in names),
    )
    return Captures(folder, spec, spec.poses or ())
