"""The session folder, `weldscan-session/1`: its models, reading it and writing it. `docs/formats.md` describes it.

Everything that comes from outside is checked here, once; what follows may trust it. A complaint is one line that names
the file and the field: `open-630/session.json: shots.3.flange_pose.B: NaN is not a number`.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeAlias, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)

from weldscan._weldcore import Lens, Scanner, decode_png, refuse_masked
from weldscan.errors import InputError
from weldscan.result import HandEye, ScannerCalibration

Image: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]
Frames: TypeAlias = Sequence[Sequence[Image]]
"""Exposures x frames of one shot, each (height, width) uint8 or uint16, all alike."""

SCHEMA = "weldscan-session/1"
HAND_EYE_SCHEMA = "weldscan-hand-eye/1"
SCANNER_SCHEMA = "weldscan-scanner/1"

# How far a matrix of a file may be from a rotation: what six printed decimals leave, and no more.
ROTATION_TOLERANCE = 1e-5
# Below this sine of the angle between axis and zero mark (0.06 degrees) no angle about the axis is defined.
PARALLEL_SINE = 1e-3
# More pixels than any camera has: a typing error, or an attempt to exhaust the memory.
MAX_SIDE_PX = 65_535
MAX_JSON_BYTES = 16 * 1024 * 1024
# How far a calibrated distance may be from the touched one, beyond half a per cent: far more than a probe reads wrong.
CALIBRATION_MISFIT_MM = 0.2


# --- what the fields are made of --------------------------------------------------------------------------------------

# A billion of anything (1000 km, for a length) is a typing error, and squares of it still fit into a number.
Real = Annotated[float, Field(ge=-1e9, le=1e9)]
Positive = Annotated[float, Field(gt=0, le=1e9)]
Vector = tuple[Real, Real, Real]
Matrix = tuple[tuple[Real, ...], ...]
Pixels = Annotated[int, Field(ge=1, le=MAX_SIDE_PX)]


def _square(size: int) -> Callable[[Matrix], Matrix]:
    def check(matrix: Matrix) -> Matrix:
        if len(matrix) != size or any(len(row) != size for row in matrix):
            raise ValueError(f"should be {size} rows of {size} numbers")
        return matrix

    return check


def _rigid(matrix: Matrix) -> Matrix:
    """A 4x4 rigid transform: orthonormal, right-handed, last row 0 0 0 1."""
    array = np.asarray(_square(4)(matrix))
    rotation = array[:3, :3]
    if not np.array_equal(array[3], [0, 0, 0, 1]):
        raise ValueError("the last row should be 0 0 0 1")
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if not off <= ROTATION_TOLERANCE:
        raise ValueError(
            f"the rotation is not orthonormal: off by {off:.2g}, at most {ROTATION_TOLERANCE:g} is accepted"
        )
    if np.linalg.det(rotation) < 0:
        raise ValueError("the rotation is mirrored (its determinant is -1)")
    return matrix


def _camera_matrix(matrix: Matrix) -> Matrix:
    (fx, skew, _), (zero, fy, _), last = _square(3)(matrix)
    if not (fx > 0 and fy > 0):
        raise ValueError("the focal lengths K[0][0] and K[1][1] should be positive")
    if skew != 0 or zero != 0 or last != (0, 0, 1):
        raise ValueError("should read [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; skew is not supported")
    return matrix


def _non_zero(vector: Vector) -> Vector:
    if not math.hypot(*vector) > 1e-9:
        raise ValueError("is a zero vector")
    return vector


def _day(text: str) -> str:
    """A date as YYYY-MM-DD."""
    try:
        return date.fromisoformat(text).isoformat()
    except ValueError:
        raise ValueError(f"{text!r} is not a day as YYYY-MM-DD") from None


def _plain_name(name: str) -> str:
    """A name that is also a folder's: it can neither leave the session's folder nor hide in it."""
    if not re.fullmatch(r"[^\W_][\w .+-]{0,99}", name) or name[-1] in ". ":
        raise ValueError(f"{name!r} cannot name a folder: letters, digits, '_', '-', '+', '.' and spaces only")
    return name


def _covariance(matrix: Matrix, size: int = 6) -> Matrix:
    array = np.asarray(_square(size)(matrix))
    # Parameters of different kinds differ by many orders: they are compared as correlations.
    units = np.sqrt(np.maximum(np.diag(array), 0))
    array = array / np.outer(units, units) if (units > 0).all() else array
    scale = float(np.abs(array).max())
    if not np.allclose(array, array.T, atol=1e-9 * scale) or np.linalg.eigvalsh(array).min() < -1e-9 * scale:
        raise ValueError("is not a covariance: it should be symmetric and without negative eigenvalues")
    return matrix


Rigid = Annotated[Matrix, AfterValidator(_rigid)]
PlainName = Annotated[str, AfterValidator(_plain_name)]
Direction = Annotated[Vector, AfterValidator(_non_zero)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True, strict=True, populate_by_name=True)


# --- the models, from the leaves up -----------------------------------------------------------------------------------


class LensSpec(_Model):
    """A camera's or a projector's pinhole with OpenCV's distortion k1 k2 p1 p2 [k3]; pixel centres at integers."""

    width: Pixels
    height: Pixels
    K: Annotated[Matrix, AfterValidator(_camera_matrix)]
    dist: Annotated[tuple[Real, ...], Field(min_length=4, max_length=5)]


class CovarianceSpec(_Model):
    """Of a scanner's parameters: their names, and the matrix in that order."""

    parameters: Annotated[tuple[str, ...], Field(min_length=1, max_length=24)]
    matrix: Matrix

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        _covariance(self.matrix, len(self.parameters))
        return self


class ScannerSpec(_Model):
    """A calibrated camera-projector pair; the scanner's frame is the camera's.

    The first three fields are all that a session needs. The others come with `weldscan-scanner/1`, the file that
    `weldscan calibrate scanner` writes.
    """

    camera: LensSpec
    projector: LensSpec
    camera_from_projector: Rigid
    schema_: Annotated[Literal["weldscan-scanner/1"] | None, Field(alias="schema")] = None
    id: Annotated[str, Field(min_length=1, max_length=200)] | None = None
    date: Annotated[str, Field(max_length=100)] | None = None
    valid_until: Annotated[str, AfterValidator(_day)] | None = None
    board: Annotated[str, Field(max_length=200)] | None = None
    board_sigma_mm: tuple[float, float] | None = None
    temperature_c: Annotated[float, Field(ge=-100, le=200)] | None = None
    covariance: CovarianceSpec | None = None
    rms_px: dict[str, float] | None = None
    volume: tuple[dict[str, Any], ...] | None = None
    """Uncertainty of points, for the record."""
    poses: tuple[dict[str, Any], ...] | None = None
    """For the record; nothing reads it."""
    undetermined: tuple[str, ...] | None = None
    warnings: tuple[str, ...] | None = None

    def build(self) -> Scanner:
        """The core's scanner of these numbers."""
        camera, projector = (Lens(lens.width, lens.height, lens.K, lens.dist) for lens in (self.camera, self.projector))
        return Scanner(camera, projector, self.camera_from_projector)

    @model_validator(mode="after")
    def _has_a_baseline(self) -> Self:
        if not math.hypot(*(row[3] for row in self.camera_from_projector[:3])) > 1e-6:
            raise ValueError(
                "camera_from_projector: camera and projector stand in one place, so nothing is triangulated"
            )
        return self


class FringeSet(_Model):
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


class ArtefactSpec(_Model):
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


class PlaneSpec(_Model):
    """The flat standard that the `plane` shots show, for `weldscan verify`."""

    size: tuple[Positive, Positive] | None = None
    """Its sides, the longer one first or last."""
    flatness: Annotated[float, Field(ge=0, le=1)] | None = None
    """Its departure from a plane, as the certificate has it."""


class PartSpec(_Model):
    """The welded part, as the drawing has it. Directions are in base, or in the scanner's frame without a robot."""

    kind: Literal["pipe"]
    outside_diameter: Positive
    wall_thickness: Positive
    joint: Annotated[str, Field(min_length=1, max_length=100)]
    axis_base: Direction | None = None
    """From the reference wall to the other wall."""
    zero_base: Direction | None = None
    """The 0 degree mark; angles are right-handed about the axis."""
    other_wall_thickness: Positive | None = None
    """Rated thickness of the other wall, where it differs."""
    machined_after_welding: bool = False
    side: Literal["welding", "opposite"] = "welding"
    """Which side of the joint was scanned."""
    required_coverage_deg: Annotated[float, Field(gt=0, le=360)] | None = None
    """How much of the seam must be seen for a PASS; 360: all of it."""

    @model_validator(mode="after")
    def _is_a_pipe(self) -> Self:
        for name in ("wall_thickness", "other_wall_thickness"):
            wall = getattr(self, name)
            if wall is not None and wall >= self.outside_diameter / 2:
                raise ValueError(
                    f"{name}: {wall:g} mm is not less than the outside radius of {self.outside_diameter / 2:g} mm"
                )
        if self.axis_base is not None and self.zero_base is not None:
            axis, zero = np.asarray(self.axis_base), np.asarray(self.zero_base)
            if np.linalg.norm(np.cross(axis, zero)) < PARALLEL_SINE * np.linalg.norm(axis) * np.linalg.norm(zero):
                raise ValueError("zero_base: is parallel to axis_base, so no angle about the axis is defined")
        elif (self.axis_base is None) != (self.zero_base is None):
            absent = "axis_base" if self.axis_base is None else "zero_base"
            raise ValueError(f"{absent}: missing, while the other of axis_base and zero_base is given")
        return self


class RobotSpec(_Model):
    """Which robot carried the scanner, and how well its poses are known (k = 1)."""

    model: Annotated[str, Field(max_length=200)]
    pose_sigma_mm: Positive | None = None
    """Standard uncertainty of the flange's place over the poses of a calibration, each axis."""
    pose_sigma_deg: Positive | None = None
    """And of its direction, about each axis."""


class FlangePose(_Model):
    """A KUKA pose of the flange in base: mm, and degrees as R = Rz(A) Ry(B) Rx(C)."""

    X: Real
    Y: Real
    Z: Real
    A: Real
    B: Real
    C: Real


class ShotSpec(_Model):
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


class HandEyeSpec(_Model):
    """`weldscan-hand-eye/1`: where the scanner sits on the flange, as `weldscan calibrate hand-eye` writes it."""

    schema_: Literal["weldscan-hand-eye/1"] = Field(alias="schema")
    id: Annotated[str, Field(min_length=1, max_length=200)]
    date: Annotated[str, Field(max_length=100)]
    flange_from_scanner: Rigid
    covariance: Annotated[Matrix, AfterValidator(_covariance)]
    """6x6, of a small rotation about the scanner's axes (rad) and a translation along the flange's axes (mm)."""
    residual_rms_mm: Annotated[float, Field(ge=0)]
    reduced_chi2: Annotated[float, Field(ge=0)] | None = None
    working_point_u_mm: Annotated[float, Field(ge=0)] | None = None
    touched_distances_mm: tuple[float, ...] | None = None
    pose_sigma_mm: Annotated[float, Field(ge=0)] | None = None
    """Of a flange pose, each axis, as the shots had it; what is placed through the robot carries it."""
    pose_sigma_rad: Annotated[float, Field(ge=0)] | None = None
    sphere_sigma_ratio: Annotated[float, Field(ge=0)] | None = None
    centres_base_mm: Matrix | None = None
    probe_bias_mm: Vector | None = None
    probe_bias_u_mm: Vector | None = None
    tilts_deg: tuple[float, float] | None = None
    warnings: tuple[str, ...] = ()
    per_shot: tuple[dict[str, Any], ...] = ()
    """For the record; nothing reads it."""


class Session(_Model):
    """All that an inspector knows of one inspection: `session.json`. `folder` says where its images are."""

    schema_: Literal["weldscan-session/1"] = Field(alias="schema")
    name: Annotated[str, Field(min_length=1, max_length=200)]
    scanner: ScannerSpec
    """In the file also the name of a `weldscan-scanner/1` document in the session's folder."""
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
        return hashlib.sha256((self.folder / "session.json").read_bytes()).hexdigest()

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
    if isinstance(session.hand_eye, str):
        name = session.hand_eye
        inside = (folder / name).resolve()
        if Path(name).is_absolute() or folder.resolve() not in inside.parents:
            raise InputError(f"{path}: hand_eye: {name!r} is not a file inside the session's folder")
        session = session.model_copy(update={"hand_eye": read_hand_eye(folder / name)})
    try:
        session.scanner.build()
    except InputError as error:
        raise InputError(f"{path}: scanner: {error}") from None
    session._folder = folder
    return session


def parse_session(path: Path) -> Session:
    """A session's document, checked, without its hand-eye file and without its folder: a plan is one too."""
    return _parse(path, Session, path.parent)


def read_scanner(path: str | os.PathLike[str]) -> ScannerSpec:
    """The scanner's calibration that `weldscan calibrate scanner` wrote, checked.

    Raises:
        InputError: missing, not JSON, or a field is wrong; one line that names file and field.
    """
    path = Path(path)
    spec = _parse(path, ScannerSpec)
    try:
        spec.build()
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return spec


def write_scanner(path: str | os.PathLike[str], found: ScannerCalibration) -> ScannerSpec:
    """Keeps a scanner's calibration as `weldscan-scanner/1`; the file appears complete or not at all.

    Returns:
        The document as read back.

    Raises:
        InputError: the file cannot be written, or is there already and is no scanner's calibration.
    """
    path = Path(path)
    if path.exists():
        try:
            read_scanner(path)
        except InputError as error:
            raise InputError(
                f"{path}: exists and is no scanner's calibration: remove it or name another ({error})"
            ) from None
    lenses = {}
    for device, (width, height) in (("camera", found.camera_size), ("projector", found.projector_size)):
        k, dist = found.lens(device)
        lenses[device] = {"width": width, "height": height, "K": k, "dist": dist if dist[4] else dist[:4]}
    poses = [
        {
            "name": pose.name,
            "camera_from_board": pose.camera_from_board,
            "features": len(pose.camera_px),
            "rms_px": {"camera": pose.rms_px[0], "projector": pose.rms_px[1]},
            "left_out_mm": pose.left_out_mm,
        }
        for pose in found.poses
    ]
    document = {
        "schema": SCANNER_SCHEMA,
        "id": found.id,
        "date": found.date,
        "valid_until": found.valid_until,
        "board": found.board,
        "board_sigma_mm": found.board_sigma_mm,
        "temperature_c": found.temperature_c,
        **lenses,
        "camera_from_projector": found.camera_from_projector,
        "covariance": {"parameters": found.parameters, "matrix": found.covariance},
        "rms_px": dict(zip(("camera", "projector", "both"), found.rms_px, strict=True)),
        "volume": [
            {"name": p.name, "point_mm": p.point_mm, "u_mm": p.u_mm, "shape_u_mm": p.shape_u_mm} for p in found.volume
        ],
        "poses": poses,
        "undetermined": found.undetermined,
        "warnings": found.warnings,
    }
    write_whole(path, to_json(plain(document)))
    return read_scanner(path)


def write_whole(path: Path, text: str) -> None:
    """A file that appears complete or not at all."""
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    try:
        partial.write_text(text, encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        partial.unlink(missing_ok=True)


def read_hand_eye(path: str | os.PathLike[str]) -> HandEyeSpec:
    """The hand-eye document that `weldscan calibrate hand-eye` wrote, checked.

    Raises:
        InputError: missing, not JSON, or a field is wrong; one line that names file and field.
    """
    return _parse(Path(path), HandEyeSpec)


def write_hand_eye(path: str | os.PathLike[str], hand_eye: HandEye) -> HandEyeSpec:
    """Keeps a hand-eye calibration as `weldscan-hand-eye/1`; the file appears complete or not at all.

    Returns:
        The document as read back.

    Raises:
        InputError: the file cannot be written, or is there already and is no hand-eye calibration.
    """
    path = Path(path)
    if path.exists():
        try:
            read_hand_eye(path)
        except InputError as error:
            raise InputError(
                f"{path}: exists and is no hand-eye calibration: remove it or name another ({error})"
            ) from None
    shots = [
        {
            "shot": shot.shot,
            "residual_rms_mm": shot.residual_rms_mm,
            "left_out_error_mm": shot.left_out_error_mm,
            "chi2": shot.chi2,
            "outlier": shot.outlier,
            "residual_mm": [sphere.residual_mm for sphere in shot.spheres],
            "distances_mm": shot.distances_mm,
            "rms_mm": [sphere.rms_mm for sphere in shot.spheres],
            "points": [sphere.points for sphere in shot.spheres],
        }
        for shot in hand_eye.per_shot
    ]
    document = {
        "schema": HAND_EYE_SCHEMA,
        **{field.name: getattr(hand_eye, field.name) for field in fields(hand_eye) if field.name != "per_shot"},
        "per_shot": shots,
    }
    write_whole(path, to_json(plain(document)))
    return read_hand_eye(path)


_M = TypeVar("_M", bound=_Model)


def _parse(path: Path, model: type[_M], folder: Path | None = None) -> _M:
    """A document, checked; in a session's `folder` the scanner may be the name of a file."""
    text = read_text(path)
    try:
        document = json.loads(text, object_pairs_hook=_no_duplicates)
    except RecursionError:
        raise InputError(f"{path}: is nested too deeply") from None
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: is not JSON: {error.msg} in line {error.lineno}, column {error.colno}") from None
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    if folder is not None and isinstance(document, dict) and isinstance(document.get("scanner"), str):
        text = json.dumps(document | {"scanner": named_scanner(path, document["scanner"])})
    try:
        return model.model_validate_json(text)
    except ValidationError as error:
        raise InputError(f"{path}: {explain(error)}") from None


def named_scanner(path: Path, name: str) -> dict[str, Any]:
    """The scanner's document that a session names: a file in the session's own folder."""
    inside = (path.parent / name).resolve()
    if Path(name).is_absolute() or path.parent.resolve() not in inside.parents:
        raise InputError(f"{path}: scanner: {name!r} is not a file inside the session's folder")
    return read_scanner(path.parent / name).model_dump(mode="json", by_alias=True, exclude_none=True)


def read_bytes(path: Path, most: int = MAX_JSON_BYTES, what: str = "file") -> bytes:
    """A file of at most so many bytes; whatever is wrong with it is an `InputError` that names it."""
    try:
        with path.open("rb") as file:
            data = file.read(most + 1)
    except FileNotFoundError:
        raise InputError(f"{path}: no such {what}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    if len(data) > most:
        raise InputError(f"{path}: is larger than {most >> 20} MB")
    return data


def read_text(path: Path) -> str:
    """A small text file in UTF-8; whatever is wrong with it is an `InputError` that names it."""
    data = read_bytes(path)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8: byte {error.start} is 0x{data[error.start]:02x}") from None


def _no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    document = dict(pairs)
    if len(document) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{next(name for name in names if names.count(name) > 1)}: the field is there twice")
    return document


def explain(error: ValidationError) -> str:
    """The first complaint of pydantic in one line, as `field.path: what is wrong`, and how many more there are."""
    complaints = error.errors(include_url=False)
    first = complaints[0]
    value = _short(first.get("input"))
    match first["type"]:
        case "missing":
            message = "missing"
        case "extra_forbidden":
            message = "unknown field"
        case "finite_number":
            message = f"{value} is not a number"
        case "value_error":
            message = str(first["ctx"]["error"])
        case "tuple_type" | "list_type":
            message = f"should be a list, not {value}"
        case "model_type" | "model_attributes_type" | "dict_type":
            message = f"should be an object, not {value}"
        case _:
            message = first["msg"].removeprefix("Input ").removeprefix("should be a valid ")
            message = f"should be a valid {message}" if "valid" in first["msg"] else message
            message = f"{message}, not {value}" if message.startswith("should be") else message
    # A union's branch is not part of the field's name.
    where = ".".join(str(step) for step in first["loc"] if str(step) not in ("HandEyeSpec", "constrained-str", "str"))
    more = f" (and {len(complaints) - 1} more)" if len(complaints) > 1 else ""
    return f"{where}: {message}{more}" if where else f"{message}{more}"


def _short(value: Any) -> str:
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "infinity"
    text = json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."


# --- images -----------------------------------------------------------------------------------------------------------

# Camera noise has no repetitions to look for: a Huffman code of the differences is smaller and three times as fast.
PNG_PARAMETERS = [
    *(cv2.IMWRITE_PNG_COMPRESSION, 1),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY),
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP),
]


def frame_names(session: Session, shot: ShotSpec) -> list[list[str]]:
    """The file names of a shot's fringe images: exposures x frames, in the order of fringes, then of steps."""
    frames = range(sum(fringe.steps for fringe in session.fringes))
    return [[f"{prefix}{frame:03d}.png" for frame in frames] for prefix in _prefixes(shot)]


def _prefixes(shot: ShotSpec) -> list[str]:
    exposures = len(shot.exposures or (1.0,))
    return [""] if exposures == 1 else [f"e{index}_" for index in range(exposures)]


def read_frames(session: Session, shot: ShotSpec) -> list[list[Image]]:
    """The fringe images of one shot: exposures x frames, in the session's order, without the white ones.

    Args:
        session: as `read_session` gave it.
        shot: one of `session.shots`.

    Returns:
        A list per exposure of (height, width) arrays, uint8 or uint16, all of the same depth.

    Raises:
        InputError: an image is missing, damaged, in colour, of another size than the camera, or of another depth than
            the rest; the line names the file, what it is and what it should be.
    """
    return _read_shots(session, [shot])[0]


def iter_frames(session: Session, shots: Iterable[ShotSpec]) -> Iterator[tuple[ShotSpec, list[list[Image]]]]:
    """`read_frames` of one shot after the other; the next shot is read while the caller works on this one."""
    with ThreadPoolExecutor(1) as reader:
        waiting: list[tuple[ShotSpec, Future[list[list[Image]]]]] = []
        for shot in shots:
            waiting.append((shot, reader.submit(read_frames, session, shot)))
            if len(waiting) == 2:
                first, future = waiting.pop(0)
                yield first, future.result()
        for last, future in waiting:
            yield last, future.result()


def _read_shots(session: Session, shots: Sequence[ShotSpec]) -> list[list[list[Image]]]:
    size = session.scanner.camera.width, session.scanner.camera.height
    names = [
        session.folder / "shots" / shot.name / name
        for shot in shots
        for row in frame_names(session, shot)
        for name in row
    ]
    # Inflating takes nearly all the time, and lets go of the interpreter meanwhile.
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        images = iter(list(pool.map(lambda path: read_image(path, size), names)))
    stacks = [[[next(images) for _ in row] for row in frame_names(session, shot)] for shot in shots]
    for shot, exposures in zip(shots, stacks, strict=True):
        depth = exposures[0][0].dtype
        for row, files in zip(exposures, frame_names(session, shot), strict=True):
            for image, name in zip(row, files, strict=True):
                if image.dtype != depth:
                    raise InputError(
                        f"{session.folder / 'shots' / shot.name / name}: is of {image.dtype.itemsize * 8} bits, "
                        f"while the shot's first image is of {depth.itemsize * 8}"
                    )
    return stacks


def read_image(path: Path, size: tuple[int, int] | None = None) -> Image:
    """One grey PNG of 8 or 16 bits, (height, width) uint8 or uint16; strictly, unlike OpenCV (docs/decisions/0002).

    Args:
        path: the file.
        size: (width, height) that it must have, pixels.

    Raises:
        InputError: see `read_frames`.
    """
    try:
        return decode_png(path.read_bytes(), size)
    except FileNotFoundError:
        raise InputError(f"{path}: no such image") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


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
        extra: further text files by name, `touch.csv` for one.

    Returns:
        The session as read back from `folder`.

    Raises:
        InputError: the folder is in the way or cannot be written, or the images do not fit the session.
    """
    folder = Path(folder)
    with whole_folder(folder) as partial:
        document = session.model_dump(mode="json", exclude_none=True, by_alias=True)
        (partial / "session.json").write_text(to_json(document), encoding="utf-8")
        for name, text in (extra or {}).items():
            (partial / _plain_name(name)).write_text(text, encoding="utf-8")
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
                (partial / "shots" / name).mkdir(parents=True)
                targets = [partial / "shots" / name / file for row in files for file in row]
                size = camera.height, camera.width
                images = [image for row in exposures for image in row]
                list(pool.map(_write_image, targets, images, [size] * len(images)))
        if shots:
            raise InputError(f"frames: none for shot {next(iter(shots))!r}")
    return read_session(folder)


def _write_image(path: Path, image: Image, size: tuple[int, int]) -> None:
    refuse_masked("frames", image)
    if image.shape != size or image.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"frames: {path.parent.name}/{path.name} is {image.shape} {image.dtype}, not {size} uint8 or uint16"
        )
    done, data = cv2.imencode(".png", image, PNG_PARAMETERS)
    if not done:
        raise InputError(f"frames: {path.name} cannot be encoded")
    path.write_bytes(data.tobytes())


CANNOT_WRITE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EFBIG)


class whole_folder:
    """A folder that appears complete or not at all: `with whole_folder(path) as partial: ...` fills `partial`.

    Args:
        path: where the folder is to be. It must not exist, or be empty, or be one that `replaces` accepts.
        replaces: says whether an existing folder is an earlier result that the new one may replace.

    Raises:
        InputError: something else is in the way, or it cannot be written.
    """

    def __init__(self, path: Path, replaces: Callable[[Path], bool] = lambda _: False) -> None:
        self.path, self.replaces = (Path(path) if Path(path).name else Path(path).resolve()), replaces
        self.partial = self._sibling("partial")

    def _sibling(self, suffix: str) -> Path:
        return self.path.parent / f".{self.path.name}.{secrets.token_hex(4)}.{suffix}"

    def __enter__(self) -> Path:
        self.check(self.path, self.replaces)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.partial.mkdir()
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written: {error.strerror or error}") from None
        return self.partial

    @staticmethod
    def check(path: Path, replaces: Callable[[Path], bool] = lambda _: False) -> None:
        """Says early what would be in the way later."""
        if path.is_symlink() or (path.exists() and not path.is_dir()):
            raise InputError(f"{path}: exists and is not a folder")
        if path.is_dir() and any(path.iterdir()) and not replaces(path):
            raise InputError(f"{path}: exists and holds something else; name another folder or remove it")
        above = next((parent for parent in path.absolute().parents if parent.exists()), None)
        if above is None or not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
            raise InputError(f"{path}: cannot be written: {above} is not a folder that may be written to")

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        try:
            if kind is None:
                self._swap()
        except OSError as failure:
            raise InputError(f"{self.path}: cannot be written: {failure.strerror or failure}") from None
        finally:
            shutil.rmtree(self.partial, ignore_errors=True)
        if isinstance(error, OSError) and error.errno in CANNOT_WRITE:
            raise InputError(f"{self.path}: cannot be written: {error.strerror or error}") from error

    def _swap(self) -> None:
        """Moves the old folder aside, the new one in, and only then removes the old."""
        self.check(self.path, self.replaces)
        old = None
        if self.path.is_dir():
            old = self.path.rename(self._sibling("old"))
        try:
            self.partial.rename(self.path)
        except OSError:
            if old is not None:
                old.rename(self.path)
            raise
        finally:
            if old is not None:
                shutil.rmtree(old, ignore_errors=True)


def to_json(document: Any) -> str:
    """JSON for people: indented, with innermost lists on one line each; never NaN."""
    text = json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False)
    # No string holds a raw line break, so that what is joined here is white space between values.
    return re.sub(r"\[\n[^\[\]{}\"]*\]", lambda found: "[" + " ".join(found[0][1:-1].split()) + "]", text) + "\n"


def plain(value: Any) -> Any:
    """Python's own types all through, and None for NaN and infinity."""
    if isinstance(value, Mapping):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, str):
        return str(value)
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, Sequence):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
