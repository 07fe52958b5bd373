"""A hand-eye calibration, and what each shot of the plate gave to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ArtefactSphere:
    """One sphere of one artefact shot, scanner frame."""

    centre_mm: Floats
    covariance_mm2: Floats
    rms_mm: float
    points: int
    residual_mm: float | None
    """Distance between the placed centre and the touched one, after the hand-eye solve."""


@dataclass(frozen=True, eq=False)
class ArtefactShot:
    """What one artefact shot gave to the hand-eye solve."""

    shot: str
    spheres: tuple[ArtefactSphere, ...]
    distances_mm: Floats
    """Between spheres 1-2, 2-3, 3-1, as scanned."""
    residual_rms_mm: float
    left_out_error_mm: float | None
    """Error of this shot's centres placed with the hand-eye solved without it."""
    chi2: float | None = None
    """Of the nine coordinates of its centres under the solution without it: nine where it is as good as the others."""
    outlier: str | None = None
    """Why it is not part of the solution, where it contradicts the others."""


@dataclass(frozen=True, eq=False)
class HandEye:
    """flange_from_scanner with its covariance."""

    flange_from_scanner: Floats
    covariance: Floats
    """6x6, of a small rotation about the scanner's axes (rad) and a translation along the flange's axes (mm)."""
    residual_rms_mm: float
    per_shot: tuple[ArtefactShot, ...]
    touched_distances_mm: Floats
    reduced_chi2: float | None
    working_point_u_mm: float
    """Standard uncertainty of a point at the working distance, placed in flange, worst axis; NaN: not stated."""
    id: str
    date: str
    pose_sigma_mm: float | None = None
    """How far a flange pose is off, each axis, k = 1, as the shots have it; None: not stated."""
    pose_sigma_rad: float | None = None
    """And in direction, about each axis."""
    sphere_sigma_ratio: float | None = None
    """How much more the spheres scatter than their fits say."""
    centres_base_mm: Floats | None = None
    """(3, 3): the sphere centres in base, as touches and shots together have them."""
    probe_bias_mm: Floats | None = None
    """(3,), base: what all touched centres are off by together; None where they were not touched."""
    probe_bias_u_mm: Floats | None = None
    """(3,): its standard uncertainty."""
    tilts_deg: tuple[float, float] = (0.0, 0.0)
    """How far the poses are turned against each other, rms, about the axis with most and with second most."""
    warnings: tuple[str, ...] = ()
    """What whoever calibrates should know: outliers, a robot or probe worse than stated, poses too alike."""
