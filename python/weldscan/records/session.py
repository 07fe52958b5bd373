"""The session, `weldscan-session/1`: its models, reading it and writing it. `docs/formats.md` describes it.

Everything that comes from outside is checked here, once; what follows may trust it.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, SerializerFunctionWrapHandler, model_serializer, model_validator

from weldscan._weldcore import refuse_masked
from weldscan.errors import InputError
from weldscan.records.fields import PARALLEL_SINE, Model, PlainName, Positive, Real, Vector, plain_name, read_model
from weldscan.records.files import read_bytes, to_json, whole_folder, write_synced
from weldscan.records.hand_eye import HandEyeSpec, named_hand_eye
from weldscan.records.images import Frames, Image, encode_png
from weldscan.records.part import PartSpec
from weldscan.records.scanner import ScannerSpec, with_scanner

SCHEMA = "weldscan-session/1"
# How far a calibrated distance may be from the touched one, beyond half a per cent: far more than a probe reads wrong.
CALIBRATION_MISFIT_MM = 0.2


# --- the models, from the leaves up -----------------------------------------------------------------------------------


class FringeSet(Model):
    """`steps` images of one frequency.

    Column u of step i: 0.5 + 0.5 cos(2 pi (periods (u + 0.5)/width - direction i/steps) + origin_rad).
    """

    axis: Literal["x", "y"]
    periods: Positive
    steps: Annotated[int, Field(ge=3, le=1000)]
    direction: Literal[1, -1] = 1
    """-1 where the fringes move the other way from step to step."""
    origin_rad: Annotated[float, Field(ge=-2 * math.pi, le=2 * math.pi)] = 0.0
    """The pattern's phase at the projector's border in step 0."""

    @property
    def pattern(self) -> tuple[str, float, int, int, float]:
        """As `fringe_patterns` takes it."""
        return self.axis, self.periods, self.steps, self.direction, self.origin_rad

    @property
    def code(self) -> tuple[float, int, int, float]:
        """As `decode` takes it."""
        return self.periods, self.steps, self.direction, self.origin_rad

    @model_serializer(mode="wrap")
    def _without_the_usual(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Files say a convention only where it is not the usual one."""
        usual = {"direction": 1, "origin_rad": 0.0}
        return {name: value for name, value in handler(self).items() if name not in usual or value != usual[name]}


class ArtefactSpec(Model):
    """The plate with three calibrated spheres; `centres_base` were touched with the robot's probe, where they were."""

    kind: Literal["three-sphere plate"] = "three-sphere plate"
    sphere_diameter: Positive
    centres_base: tuple[Vector, Vector, Vector] | None = None
    touch_sigma_mm: Positive | None = None
    """Standard uncertainty of a touched centre, each coordinate, its own (k = 1)."""
    touch_bias_sigma_mm: Positive | None = None
    """And common to all three."""
    sphere_diameter_u: Annotated[float, Field(ge=0, le=1)] | None = None
    """Expanded uncertainty (k = 2) of the diameter, as the certificate has it."""
    sphere_form: Annotated[float, Field(ge=0, le=1)] | None = None
    """Largest departure of the spheres from their form, as the certificate has it."""
    distances: tuple[Positive, Positive, Positive] | None = None
    """Calibrated distances of the centres 1-2, 2-3, 3-1; without them those between the touched centres count."""
    distances_u: Annotated[float, Field(ge=0, le=1)] | None = None
    """Expanded uncertainty (k = 2) of a calibrated distance."""

    @model_validator(mode="after")
    def _is_a_triangle(self) -> Self:
        if self.distances_u is not None and self.distances is None:
            raise ValueError("distances_u: given without distances")
        if self.distances is not None and 2 * max(self.distances) >= sum(self.distances):
            raise ValueError("distances: no three centres are so far apart")
        if self.centres_base is None:
            return self
        centres = np.asarray(self.centres_base)
        for i, j in ((0, 1), (1, 2), (2, 0)):
            distance = float(np.linalg.norm(centres[i] - centres[j]))
            if distance < self.sphere_diameter:
                raise ValueError(
                    f"centres_base: spheres {i + 1} and {j + 1} are {distance:.4g} mm apart, "
                    f"less than their diameter of {self.sphere_diameter:g} mm"
                )
        sides = centres[1] - centres[0], centres[2] - centres[0]
        if np.linalg.norm(np.cross(*sides)) < PARALLEL_SINE * np.linalg.norm(sides[0]) * np.linalg.norm(sides[1]):
            raise ValueError("centres_base: the three centres lie on one line, which fixes no rotation about it")
        for index, ((i, j), stated) in enumerate(zip(((0, 1), (1, 2), (2, 0)), self.distances or (), strict=False)):
            touched = float(np.linalg.norm(centres[i] - centres[j]))
            if abs(stated - touched) > CALIBRATION_MISFIT_MM + 0.005 * stated:
                raise ValueError(
                    f"distances.{index}: {stated:g} mm between spheres {i + 1} and {j + 1}, "
                    f"but centres_base are {touched:.3f} mm apart"
                )
        return self


class PlaneSpec(Model):
    """The flat standard that the `plane` shots show, for `weldscan verify`."""

    size: tuple[Positive, Positive] | None = None
    """Its sides, the longer one first or last."""
    flatness: Annotated[float, Field(ge=0, le=1)] | None = None
    """Its departure from a plane, as the certificate has it."""


class RobotSpec(Model):
    """Which robot carried the scanner, and how well its poses are known (k = 1)."""

    model: Annotated[str, Field(max_length=200)]
    pose_sigma_mm: Positive | None = None
    """Standard uncertainty of the flange's place over the poses of a calibration, each axis."""
    pose_sigma_deg: Positive | None = None
    """And of its direction, about each axis."""


class FlangePose(Model):
    """A KUKA pose of the flange in base: mm, and degrees as R = Rz(A) Ry(B) Rx(C)."""

    X: Real
    Y: Real
    Z: Real
    A: Real
    B: Real
    C: Real


class ShotSpec(Model):
    """One stack of fringe images, in `shots/NAME`."""

    name: PlainName
    of: Literal["artefact", "part", "plane"]
    flange_pose: FlangePose | None = None
    exposures: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=100)] | None = None
    """Relative exposure of each stack; absent: one stack."""

    @model_validator(mode="after")
    def _exposures_differ(self) -> Self:
        if self.exposures is not None and len(set(self.exposures)) < len(self.exposures):
            raise ValueError("exposures: one of them is there twice")
        return self


class Session(Model):
    """All that an inspector knows of one inspection: `session.json`. `folder` says where its images are."""

    schema_: Literal["weldscan-session/1"] = Field(alias="schema")
    name: Annotated[str, Field(min_length=1, max_length=200)]
    scanner: ScannerSpec
    """In the file also the name of a `weldscan-scanner/2` document in the session's folder."""
    fringes: Annotated[tuple[FringeSet, ...], Field(min_length=1, max_length=100)]
    artefact: ArtefactSpec | None = None
    hand_eye: HandEyeSpec | Annotated[str, Field(min_length=1, max_length=200)] | None = None
    """The document itself, or the name of its file in the session's folder (`read_session` puts the document here)."""
    plane: PlaneSpec | None = None
    """The flat standard of the `plane` shots; those may do without it."""
    part: PartSpec | None = None
    robot: RobotSpec | None = None
    verification: Annotated[str, Field(min_length=1, max_length=1000)] | None = None
    """The history file of the scanner's verifications, relative to the session's folder."""
    shots: Annotated[tuple[ShotSpec, ...], Field(min_length=1, max_length=10_000)]
    _folder: Path | None = PrivateAttr(default=None)

    @property
    def folder(self) -> Path:
        """Where the session was read from."""
        if self._folder is None:
            raise InputError("this session was made in memory: it has no folder to read images from")
        return self._folder

    @property
    def sha256(self) -> str:
        """Of `session.json`, for the record."""
        return hashlib.sha256(read_bytes(self.folder / "session.json")).hexdigest()

    @property
    def artefact_shots(self) -> tuple[ShotSpec, ...]:
        """The shots of the three-sphere plate."""
        return tuple(shot for shot in self.shots if shot.of == "artefact")

    @property
    def plane_shots(self) -> tuple[ShotSpec, ...]:
        """The shots of the flat standard."""
        return tuple(shot for shot in self.shots if shot.of == "plane")

    @property
    def part_shots(self) -> tuple[ShotSpec, ...]:
        """The shots of the welded part."""
        return tuple(shot for shot in self.shots if shot.of == "part")

    @property
    def has_robot(self) -> bool:
        """Whether the shots have poses; without them the part is measured in the scanner's own frame."""
        return self.shots[0].flange_pose is not None

    @model_validator(mode="after")
    def _agrees_with_itself(self) -> Self:
        for complaint in (*self._about_fringes(), *self._about_shots(), *self._about_placing()):
            raise ValueError(complaint)
        return self

    def _about_fringes(self) -> Iterator[str]:
        seen: set[tuple[str, float]] = set()
        for index, fringe in enumerate(self.fringes):
            side = self.scanner.projector.width if fringe.axis == "x" else self.scanner.projector.height
            if (fringe.axis, fringe.periods) in seen:
                yield f"fringes.{index}.periods: {fringe.periods:g} is there twice on axis {fringe.axis}"
            if 2 * fringe.periods > side:
                yield f"fringes.{index}.periods: {side} projector pixels cannot show {fringe.periods:g} fringes"
            seen.add((fringe.axis, fringe.periods))

    def _about_shots(self) -> Iterator[str]:
        seen: dict[str, int] = {}
        for index, shot in enumerate(self.shots):
            # Two names that differ in case alone are one folder on some file systems.
            twin = seen.setdefault(shot.name.casefold(), index)
            if twin != index:
                yield f"shots.{index}.name: {shot.name!r} is also the name of shots.{twin}"
        if self.artefact is None and self.artefact_shots:
            index = self.shots.index(self.artefact_shots[0])
            yield f"shots.{index}.of: a shot of the artefact, but the session describes no artefact"
        if self.part is None and self.part_shots:
            yield "part: missing, though there are shots of it"

    def _about_placing(self) -> Iterator[str]:
        posed = [shot.flange_pose is not None for shot in self.shots]
        if any(posed) and not all(posed):
            yield f"shots.{posed.index(False)}.flange_pose: missing, though shots.{posed.index(True)} has one"
        if any(posed):
            if self.part_shots and self.part is not None and self.part.axis_base is None:
                yield "part.axis_base: missing; only a session without a robot may leave it out"
            if self.hand_eye is not None and self.artefact_shots:
                yield "hand_eye: given together with artefact shots; leave one of them out"
            if self.hand_eye is None and self.part_shots and not self.artefact_shots:
                yield "hand_eye: missing, and there are no artefact shots to find it from"
            return
        if self.hand_eye is not None:
            yield "hand_eye: given, but the shots have no flange_pose to use it with"
        if self.part_shots and len(self.shots) > 1:
            # Artefact and plane alone need no robot: that is a verification of the scanner.
            yield (
                "shots.0.flange_pose: missing; only a session with exactly one shot, and that of the part, "
                "can do without a robot"
            )


# --- reading ----------------------------------------------------------------------------------------------------------


def read_session(folder: str | os.PathLike[str]) -> Session:
    """The checked contents of `folder/session.json`; its images stay on disk until `read_frames` wants them.

    Args:
        folder: a session folder, `weldscan-session/1`.

    Raises:
        InputError: the file is missing, is not JSON in UTF-8, or a field of it is unknown, missing, out of range or
            contradicts another; one line that names file and field.
    """
    folder = Path(folder)
    path = folder / "session.json"
    if not folder.is_dir():
        raise InputError(f"{folder}: {'is not a folder' if folder.exists() else 'no such folder'}")
    session = parse_session(path)
    if session.hand_eye is not None:
        session = session.model_copy(update={"hand_eye": named_hand_eye(path, session.hand_eye)})
    try:
        session.scanner.build()
    except InputError as error:
        raise InputError(f"{path}: scanner: {error}") from None
    session._folder = folder
    return session


def parse_session(path: Path) -> Session:
    """A session's document, checked, without its hand-eye file and without its folder: a plan is one too."""
    return read_model(path, Session, partial(with_scanner, path))


def frame_names(session: Session, shot: ShotSpec) -> list[list[str]]:
    """The file names of a shot's fringe images: exposures x frames, in the order of fringes, then of steps."""
    frames = range(sum(fringe.steps for fringe in session.fringes))
    return [[f"{prefix}{frame:03d}.png" for frame in frames] for prefix in _prefixes(shot)]


def _prefixes(shot: ShotSpec) -> list[str]:
    exposures = len(shot.exposures or (1.0,))
    return [""] if exposures == 1 else [f"e{index}_" for index in range(exposures)]


# --- writing ----------------------------------------------------------------------------------------------------------


def write_session(
    folder: str | os.PathLike[str],
    session: Session,
    frames: Iterable[tuple[str, Frames]],
    *,
    whites: Mapping[str, Sequence[Image]] | None = None,
    extra: Mapping[str, str] | None = None,
) -> Session:
    """Writes a session as a whole: into a temporary folder beside `folder`, which then takes its name.

    Args:
        folder: must not exist yet, or be empty.
        session: what goes into `session.json`.
        frames: per shot its name and its images, as `read_frames` gives them; may be a generator, so that one shot
            after the other is made and written. `dict.items()` does as well.
        whites: per shot the evenly lit image of each exposure, where there is one.
        extra: further text files by name, `touch.csv` for one; written last, so that `frames` may still add to them.

    Returns:
        The session as read back from `folder`.

    Raises:
        InputError: the folder is in the way or cannot be written, or the images do not fit the session.
    """
    folder = Path(folder)
    with whole_folder(folder) as whole:
        document = session.model_dump(mode="json", exclude_none=True, by_alias=True)
        write_synced(whole / "session.json", to_json(document))
        shots = {shot.name: shot for shot in session.shots}
        camera = session.scanner.camera
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            for name, stacks in frames:
                shot = shots.pop(name, None)
                if shot is None:
                    raise InputError(f"frames: {name!r} is not a shot of the session, or came twice")
                exposures, files = [list(stack) for stack in stacks], frame_names(session, shot)
                white = (whites or {}).get(name)
                if white is not None:
                    exposures = [[*row, image] for row, image in zip(exposures, white, strict=True)]
                    files = [[*row, f"{p}white.png"] for row, p in zip(files, _prefixes(shot), strict=True)]
                have, need = [[len(row) for row in rows] for rows in (exposures, files)]
                if have != need:
                    raise InputError(f"frames: {name!r} has {have} images, not {need}")
                (whole / "shots" / name).mkdir(parents=True)
                targets = [whole / "shots" / name / file for row in files for file in row]
                size = camera.height, camera.width
                images = [image for row in exposures for image in row]
                list(pool.map(_write_image, targets, images, [size] * len(images)))
        if shots:
            raise InputError(f"frames: none for shot {next(iter(shots))!r}")
        for name, text in (extra or {}).items():
            write_synced(whole / plain_name(name), text)
    return read_session(folder)


def _write_image(path: Path, image: Image, size: tuple[int, int]) -> None:
    refuse_masked("frames", image)
    if image.shape != size or image.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"frames: {path.parent.name}/{path.name} is {image.shape} {image.dtype}, not {size} uint8 or uint16"
        )
    write_synced(path, encode_png(image))
