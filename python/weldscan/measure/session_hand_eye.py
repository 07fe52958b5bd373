"""The hand-eye of a session: the one that it carries, or the one that its shots of the three-sphere plate give."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from weldscan.calibration.artefact import TOUCH_SIGMA_MM, PlateMismatch, PlateView, find_plate
from weldscan.calibration.hand_eye import POSE_SIGMA_MM, POSE_SIGMA_RAD, TOUCH_BIAS_SIGMA_MM, solve_hand_eye
from weldscan.errors import GeometryError, InputError, NotMeasured
from weldscan.measure.journal import Journal, took
from weldscan.measure.session_points import PointReader, Progress
from weldscan.pose import matrix_from_kuka
from weldscan.records.hand_eye import HandEyeSpec, named_hand_eye
from weldscan.records.plan import PlanSource
from weldscan.records.session import Session, ShotSpec, read_session
from weldscan.result import HandEye, warning

Floats = NDArray[np.float64]


def base_from_flange(shot: ShotSpec) -> Floats:
    """The shot's flange pose as a matrix."""
    pose = shot.flange_pose
    if pose is None:
        raise InputError(f"shot {shot.name!r}: it has no flange_pose")
    return matrix_from_kuka(pose.X, pose.Y, pose.Z, pose.A, pose.B, pose.C)


def hand_eye_of(read: PointReader, unusable: Collection[str] = ()) -> tuple[HandEye | None, Journal]:
    """The session's hand-eye: the one that it carries, else the one that its artefact shots give.

    Args:
        read: gives the shots' points.
        unusable: names of shots that are not to be read.

    Returns:
        HandEye, None without a robot or where no artefact shot could be used; and what was noticed.

    Raises:
        PlateMismatch: the plate in view is not the one described, in no shot, or contradicts the poses.
    """
    session: Session = read.session
    noticed = Journal()
    if isinstance(session.hand_eye, HandEyeSpec):
        if not np.any(session.hand_eye.covariance):
            text = "hand_eye.covariance: is zero, so U holds nothing of the hand-eye"
            noticed += Journal((warning("hand-eye", text),))
        return session.hand_eye.build(), noticed
    if session.artefact is None or not session.artefact_shots:
        return None, noticed
    artefact, robot = session.artefact, session.robot
    touched = None if artefact.centres_base is None else np.array(artefact.centres_base)
    views: list[PlateView] = []
    poses: list[Floats] = []
    mistaken: PlateMismatch | None = None
    for shot in session.artefact_shots:
        if shot.name in unusable:
            continue
        pose, scan = base_from_flange(shot), read(shot, len(noticed.shots))
        noticed += scan.noticed
        t = time.perf_counter()
        # Spheres that were not touched are told apart as the first shot has them.
        reference = touched if touched is not None else views[0].centres_mm if views else None
        eye = pose if touched is not None else np.eye(4)
        why: str | None = None
        try:
            view = find_plate(shot.name, scan.points_mm, artefact.sphere_diameter, reference, eye)
        except PlateMismatch as error:
            mistaken, why = error, str(error)
        except GeometryError as error:
            why = scan.reading.why_dark or str(error)
        else:
            twin = next((v.shot for v in views if np.array_equal(v.centres_mm, view.centres_mm)), None)
            if twin is None:
                views.append(view)
                poses.append(pose)
            else:
                why = f"is {twin} once more: a shot counts once"
        noticed += took("spheres", t) + Journal(left_out=() if why is None else ((shot.name, why),))
    where = session.folder / "session.json"
    if not views:
        if mistaken is not None:
            raise PlateMismatch(f"{where}: {mistaken}")
        return None, noticed
    t = time.perf_counter()
    try:
        solved = solve_hand_eye(
            views,
            poses,
            touched,
            pose_sigma_mm=(robot and robot.pose_sigma_mm) or POSE_SIGMA_MM,
            pose_sigma_rad=math.radians((robot and robot.pose_sigma_deg) or 0.0) or POSE_SIGMA_RAD,
            touch_sigma_mm=artefact.touch_sigma_mm or TOUCH_SIGMA_MM,
            touch_bias_sigma_mm=artefact.touch_bias_sigma_mm or TOUCH_BIAS_SIGMA_MM,
        )
    except PlateMismatch as error:
        raise PlateMismatch(f"{where}: {error}") from None
    except (InputError, GeometryError) as error:
        raise InputError(f"{where}: shots: {error}") from None
    said = tuple(warning("hand-eye", f"hand-eye: {text}") for text in solved.warnings)
    outliers = tuple((shot.shot, shot.outlier) for shot in solved.per_shot if shot.outlier is not None)
    return solved, noticed + Journal(said, outliers) + took("hand_eye", t)


def calibrate(session_folder: Path | str, progress: Progress | None = None) -> tuple[HandEye, Journal]:
    """flange_from_scanner from the artefact shots of a session (`weldscan calibrate hand-eye`).

    Args:
        session_folder: a `weldscan-session/1` folder with artefact shots; others in it are not looked at.
        progress: called with (done, total, what).

    Returns:
        HandEye; and what was noticed, the shots that were not used among it.

    Raises:
        InputError: the session is wrong, or the plate in view is not the one that it describes.
        NotMeasured: no artefact shot could be used; the message says why, shot by shot.
    """
    session = read_session(session_folder)
    if not session.artefact_shots:
        raise InputError(f"{session.folder / 'session.json'}: shots: none is of the artefact")
    found, noticed = hand_eye_of(PointReader(session, progress))
    if found is None:
        raise NotMeasured("; ".join(f"{name}: {why}" for name, why in noticed.left_out))
    return found, noticed


def mounted(source: PlanSource, path: str | os.PathLike[str]) -> Floats:
    """flange_from_scanner as the source has it: its hand-eye, or the one that its artefact shots give."""
    path = Path(path)
    if source.hand_eye is not None:
        file = path / "session.json" if path.is_dir() else path
        return np.array(named_hand_eye(file, source.hand_eye).flange_from_scanner)
    if path.is_dir() and any(shot.of == "artefact" for shot in source.shots):
        return calibrate(path)[0].flange_from_scanner
    raise InputError(
        f"{path}: hand_eye: missing; say roughly where the scanner sits on the flange with --mount 'X Y Z A B C' "
        "(mm and degrees, the drawing's are good enough) or --hand-eye FILE"
    )
