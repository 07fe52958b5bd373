"""A calibrated scanner, `weldscan-scanner/2`, as `weldscan calibrate scanner` writes it and every session has it."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from weldscan._weldcore import Lens, Scanner
from weldscan.errors import InputError, Unreadable
from weldscan.records.fields import (
    CameraMatrix,
    Day,
    Matrix,
    Model,
    Pixels,
    Polygon,
    Positive,
    Real,
    Rigid,
    check_covariance,
    read_model,
)
from weldscan.records.files import inside, plain, to_json, write_file
from weldscan.result import CalibratedHull, ScannerCalibration

SCHEMA = "weldscan-scanner/2"


class LensSpec(Model):
    """A camera's or a projector's pinhole with OpenCV's distortion k1 k2 p1 p2 [k3]; pixel centres at integers."""

    width: Pixels
    height: Pixels
    K: CameraMatrix
    dist: Annotated[tuple[Real, ...], Field(min_length=4, max_length=5)]


class CovarianceSpec(Model):
    """Of a scanner's parameters: their names, and the matrix in that order."""

    parameters: Annotated[tuple[str, ...], Field(min_length=1, max_length=24)]
    matrix: Matrix

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        check_covariance(self.matrix, len(self.parameters))
        return self


class HullSpec(Model):
    """Where a scanner is calibrated: convex polygons in both images, and the depths between which the boards stood."""

    camera_px: Polygon
    projector_px: Polygon
    depth_mm: tuple[Positive, Positive]

    def build(self) -> CalibratedHull:
        """As arrays."""
        return CalibratedHull(np.array(self.camera_px), np.array(self.projector_px), self.depth_mm)


class ScannerSpec(Model):
    """A calibrated camera-projector pair; the scanner's frame is the camera's.

    The first three fields are all that a session needs. The others come with `weldscan-scanner/2`, the file that
    `weldscan calibrate scanner` writes; `weldscan-scanner/1` is the same without `hull`, `jackknife_ratio` and
    `resolution`.
    """

    camera: LensSpec
    projector: LensSpec
    camera_from_projector: Rigid
    schema_: Annotated[Literal["weldscan-scanner/1", "weldscan-scanner/2"] | None, Field(alias="schema")] = None
    id: Annotated[str, Field(min_length=1, max_length=200)] | None = None
    date: Annotated[str, Field(max_length=100)] | None = None
    valid_until: Day | None = None
    board: Annotated[str, Field(max_length=200)] | None = None
    board_sigma_mm: tuple[float, float] | None = None
    temperature_c: Annotated[float, Field(ge=-100, le=200)] | None = None
    covariance: CovarianceSpec | None = None
    """Scaled by the jackknife already, where that exceeds it."""
    jackknife_ratio: Annotated[float, Field(ge=0, le=1e9)] | None = None
    """By leaving out poses over by noise, of the uncertainty of the volume's shape."""
    hull: HullSpec | None = None
    """Absent: not known."""
    resolution: dict[str, Any] | None = None
    """How far an edge is spread; nothing reads it yet."""
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


def read_scanner(path: str | os.PathLike[str]) -> ScannerSpec:
    """The scanner's calibration that `weldscan calibrate scanner` wrote, checked.

    Raises:
        InputError: missing, not JSON, or a field is wrong; one line that names file and field.
    """
    path = Path(path)
    spec = read_model(path, ScannerSpec)
    try:
        spec.build()
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return spec


def write_scanner(path: str | os.PathLike[str], found: ScannerCalibration) -> ScannerSpec:
    """Keeps a scanner's calibration as `weldscan-scanner/2`; the file appears complete or not at all.

    Returns:
        The document as read back.

    Raises:
        InputError: the file cannot be written, or is there already and is no scanner's calibration.
    """
    path = Path(path)
    if path.exists():
        try:
            read_scanner(path)
        except Unreadable:
            raise
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
        "schema": SCHEMA,
        "id": found.id,
        "date": found.date,
        "valid_until": found.valid_until,
        "board": found.board,
        "board_sigma_mm": found.board_sigma_mm,
        "temperature_c": found.temperature_c,
        **lenses,
        "camera_from_projector": found.camera_from_projector,
        "covariance": {"parameters": found.parameters, "matrix": found.covariance},
        "jackknife_ratio": found.jackknife_ratio,
        "hull": {
            "camera_px": found.hull.camera_px,
            "projector_px": found.hull.projector_px,
            "depth_mm": found.hull.depth_mm,
        },
        "rms_px": dict(zip(("camera", "projector", "both"), found.rms_px, strict=True)),
        "volume": [
            {"name": p.name, "point_mm": p.point_mm, "u_mm": p.u_mm, "shape_u_mm": p.shape_u_mm} for p in found.volume
        ],
        "poses": poses,
        "undetermined": found.undetermined,
        "warnings": found.warnings,
    }
    write_file(path, to_json(plain(document)))
    return read_scanner(path)


def with_scanner(path: Path, document: dict[str, Any]) -> dict[str, Any]:
    """A session's document, from `path`, with the scanner in place of the name of its file, if it is a name."""
    name = document.get("scanner")
    if not isinstance(name, str):
        return document
    spec = read_scanner(inside(path.parent, name, f"{path}: scanner"))
    return document | {"scanner": spec.model_dump(mode="json", by_alias=True, exclude_none=True)}
