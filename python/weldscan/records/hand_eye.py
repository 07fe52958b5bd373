"""Where the scanner sits on the flange, `weldscan-hand-eye/1`, as `weldscan calibrate hand-eye` writes it."""

from __future__ import annotations

import math
import os
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field

from weldscan.errors import InputError, Unreadable
from weldscan.records.fields import Matrix, Model, Rigid, Vector, check_covariance, read_model
from weldscan.records.files import inside, plain, to_json, write_file
from weldscan.result import HandEye

SCHEMA = "weldscan-hand-eye/1"


class HandEyeSpec(Model):
    """`weldscan-hand-eye/1`: where the scanner sits on the flange, as `weldscan calibrate hand-eye` writes it."""

    schema_: Literal["weldscan-hand-eye/1"] = Field(alias="schema")
    id: Annotated[str, Field(min_length=1, max_length=200)]
    date: Annotated[str, Field(max_length=100)]
    flange_from_scanner: Rigid
    covariance: Annotated[Matrix, AfterValidator(check_covariance)]
    """6x6, of a small rotation about the scanner's axes (rad) and a translation along the flange's axes (mm)."""
    residual_rms_mm: Annotated[float, Field(ge=0)]
    reduced_chi2: Annotated[float, Field(ge=0)] | None = None
    working_point_u_mm: Annotated[float, Field(ge=0)] | None = None
    touched_distances_mm: tuple[float, ...] | None = None
    pose_sigma_mm: Annotated[float, Field(ge=0)] | None = None
    """Of a flange pose, each axis, as the shots had it; what is placed through the robot carries it."""
    pose_sigma_rad: Annotated[float, Field(ge=0)] | None = None
    sphere_sigma_ratio: Annotated[float, Field(ge=0)] | None = None
    centres_base_mm: tuple[Vector, Vector, Vector] | None = None
    probe_bias_mm: Vector | None = None
    probe_bias_u_mm: Vector | None = None
    tilts_deg: tuple[float, float] | None = None
    warnings: tuple[str, ...] = ()
    per_shot: tuple[dict[str, Any], ...] = ()
    """For the record; nothing reads it."""

    def build(self) -> HandEye:
        """The calibration that it describes; its shots are not kept."""
        return HandEye(
            flange_from_scanner=np.array(self.flange_from_scanner),
            covariance=np.array(self.covariance),
            residual_rms_mm=self.residual_rms_mm,
            per_shot=(),
            touched_distances_mm=np.array(self.touched_distances_mm or ()),
            reduced_chi2=self.reduced_chi2,
            working_point_u_mm=math.nan if self.working_point_u_mm is None else self.working_point_u_mm,
            id=self.id,
            date=self.date,
            pose_sigma_mm=self.pose_sigma_mm,
            pose_sigma_rad=self.pose_sigma_rad,
            sphere_sigma_ratio=self.sphere_sigma_ratio,
            centres_base_mm=None if self.centres_base_mm is None else np.array(self.centres_base_mm),
            probe_bias_mm=None if self.probe_bias_mm is None else np.array(self.probe_bias_mm),
            probe_bias_u_mm=None if self.probe_bias_u_mm is None else np.array(self.probe_bias_u_mm),
            tilts_deg=self.tilts_deg or (0.0, 0.0),
            warnings=self.warnings,
        )


def read_hand_eye(path: str | os.PathLike[str]) -> HandEyeSpec:
    """The hand-eye document that `weldscan calibrate hand-eye` wrote, checked.

    Raises:
        InputError: missing, not JSON, or a field is wrong; one line that names file and field.
    """
    return read_model(Path(path), HandEyeSpec)


def named_hand_eye(path: Path, hand_eye: HandEyeSpec | str) -> HandEyeSpec:
    """The hand-eye of a session whose document is at `path`: itself, or that of the file in its folder."""
    if isinstance(hand_eye, HandEyeSpec):
        return hand_eye
    return read_hand_eye(inside(path.parent, hand_eye, f"{path}: hand_eye"))


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
        except Unreadable:
            raise
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
        "schema": SCHEMA,
        **{field.name: getattr(hand_eye, field.name) for field in fields(hand_eye) if field.name != "per_shot"},
        "per_shot": shots,
    }
    write_file(path, to_json(plain(document)))
    return read_hand_eye(path)
