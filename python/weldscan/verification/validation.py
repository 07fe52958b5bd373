"""Holds the scanned surface against points that a contact probe read on the part (the paper's 115 um)."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import KdTree, quadric_distances
from weldscan.calibration.artefact import TOUCH_SIGMA_MM
from weldscan.calibration.hand_eye import point_uncertainty_mm, pose_sigma
from weldscan.errors import InputError, NotMeasured
from weldscan.measure.inspection import inspect
from weldscan.records.session import read_session
from weldscan.records.touch import read_touch
from weldscan.result import BudgetLine, PartCloud, Validation

Floats = NDArray[np.float64]

# The patch of surface around a probed point: wide enough to average a scanner's noise over hundreds of points, small
# against a pipe's radius and a bead's width, so that a quadric describes it.
PATCH_MM = 1.5


def validate(
    session_folder: str | os.PathLike[str],
    touch_csv: str | os.PathLike[str],
    progress: Callable[[int, int, str], None] | None = None,
) -> Validation:
    """The signed distance of each probed point from the scanned surface around it, with its uncertainty.

    Around each probed point the scanned points within 1.5 mm are described by a quadric (least squares, once more
    without those beyond three sigma); the distance is taken along its normal, positive away from the pipe's axis.

    Args:
        session_folder: a `weldscan-session/1` folder with a robot.
        touch_csv: a file with the header `x_mm,y_mm,z_mm` and a point in base per line.
        progress: called with (done, total, what).

    Returns:
        Validation; points where nothing was scanned have NaN.

    Raises:
        InputError: the session or the file is wrong, or the session has no robot, so that nothing is in base.
        NotMeasured: none of the probed points lies on scanned surface.
    """
    touched = read_touch(Path(touch_csv))
    session = read_session(session_folder)
    if not session.has_robot:
        raise InputError(f"{session.folder / 'session.json'}: robot: without one, nothing says where base is")
    found = inspect(session_folder, progress=progress)
    cloud = found.cloud
    if cloud is None:
        raise NotMeasured("; ".join(judgement.reason for judgement in found.verdicts) or "nothing was scanned")
    flanges = [(s.flange_pose.X, s.flange_pose.Y, s.flange_pose.Z) for s in session.part_shots if s.flange_pose]
    lever = float(np.mean([np.linalg.norm(touched - np.array(flange), axis=1).min() for flange in flanges]))
    pose_mm, pose_rad = pose_sigma(found.hand_eye)
    pose = math.hypot(pose_mm, pose_rad * lever)
    hand_eye = point_uncertainty_mm(found.hand_eye, np.array([0.0, 0.0, lever])) if found.hand_eye else 0.0
    shared = (
        BudgetLine("hand-eye", hand_eye, "covariance of the calibration, at the working distance"),
        BudgetLine("robot pose", pose, f"{pose_mm:.3f} mm and {pose_rad:.1e} rad at {lever:.0f} mm"),
    )
    return hold_against(touched, cloud, shared, session=found.session, touch=str(touch_csv), software=found.software)


def hold_against(
    touched_mm: Floats,
    cloud: PartCloud,
    shared: tuple[BudgetLine, ...] = (),
    *,
    session: str = "",
    touch: str = "",
    software: dict[str, str] | None = None,
) -> Validation:
    """`validate` for a cloud that is there already; `shared` are the uncertainties that all points have in common."""
    _, near = KdTree(cloud.points_mm).radius(touched_mm, PATCH_MM)
    distance, noise, normal = quadric_distances(cloud.points_mm, touched_mm, near, PATCH_MM)
    angle, axial = (np.full(len(touched_mm), np.nan) for _ in range(2))
    outwards = _outwards(cloud)
    for i, patch in enumerate(near):
        if len(patch):
            turn = np.exp(1j * np.radians(cloud.angle_deg[patch].astype(float))).mean()
            angle[i], axial[i] = np.degrees(np.angle(turn)) % 360, cloud.axial_mm[patch].mean()
            distance[i] *= 1.0 if normal[i] @ outwards(angle[i]) > 0 else -1.0
    good = np.isfinite(distance)
    if not good.any():
        raise NotMeasured(f"none of the {len(touched_mm)} probed points lies on scanned surface")
    common = math.hypot(*(line.standard_mm for line in shared), 0.0)
    own = np.hypot(TOUCH_SIGMA_MM, noise)
    values = distance[good]
    return Validation(
        session=session,
        touch=touch,
        points_mm=touched_mm,
        distance_mm=distance,
        u_mm=2 * np.hypot(common, own),
        angle_deg=angle,
        axial_mm=axial,
        mean_mm=float(values.mean()),
        rms_mm=float(np.sqrt(np.square(values).mean())),
        max_abs_mm=float(np.abs(values).max()),
        mean_u_mm=2 * math.hypot(common, float(np.sqrt(np.square(own[good]).mean() / good.sum()))),
        budget=(
            *shared,
            BudgetLine("probe", TOUCH_SIGMA_MM, "contact probing with the robot"),
            BudgetLine("scanned surface", float(np.median(noise[good])), f"quadric over a patch of {PATCH_MM:g} mm"),
        ),
        software=software or {},
    )


def _outwards(cloud: PartCloud) -> Callable[[float], Floats]:
    """The direction away from the axis, by angle; its cos and sin are linear in the position but for the deviation."""
    few = slice(None, None, max(1, len(cloud.label) // 4000))
    angle = np.radians(cloud.angle_deg[few].astype(float))
    terms = np.stack([np.ones_like(angle), cloud.axial_mm[few], np.cos(angle), np.sin(angle)], axis=1)
    _, _, zero, quarter = np.linalg.lstsq(terms, cloud.points_mm[few], rcond=None)[0]
    return lambda deg: math.cos(math.radians(deg)) * zero + math.sin(math.radians(deg)) * quarter
