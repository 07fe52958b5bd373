"""Where the scanner sits on the flange: `flange_from_scanner` from shots of the three-sphere plate.

Unknown are X = flange_from_scanner and the three centres c_j in base. Shot i with flange pose F_i sees centre j at
m_ij:

    r_ij = X m_ij - F_i^-1 c_j

The error of a pose is common to the spheres of its shot, so the residuals of shot i (9 numbers) are whitened with

    Cov_i = blockdiag(X Cov(m_ij) X^T) + J_i diag(sigma_t^2, sigma_r^2) J_i^T,

J_i moving all three by a small motion of the flange. The touched centres enter as a prior with an error of their own
each and a probe bias common to all. Gauss-Newton from the closed form of all shots stacked; one shot suffices (the
paper's case, its Eqs. 8-11), with the larger covariance that it has. If the shots disagree by more than a robot of the
assumed repeatability allows, the poses' share of the covariance is scaled up until they fit (variance component).

Source: shared design METHOD ("Hand-eye from three spheres"); K.-R. Koch, Parameter Estimation (1999), 3.6 for the
variance component.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import register_rigid
from weldscan.calibration.artefact import TOUCH_SIGMA_MM, PlateMismatch, PlateView, distances, find_plate
from weldscan.errors import GeometryError, InputError, NotMeasured
from weldscan.points import PointReader, Progress
from weldscan.pose import matrix_from_kuka
from weldscan.result import ArtefactShot, HandEye, SphereFit
from weldscan.session import HandEyeSpec, Session, ShotSpec, read_session, write_hand_eye

__all__ = ["calibrate", "hand_eye_of", "point_uncertainty_mm", "solve_hand_eye", "write_hand_eye"]

Floats = NDArray[np.float64]

# The robot's pose, k = 1. A repeatability of 0.03 mm (the paper's Table 3) is three sigma by ISO 9283; over the 150 mm
# from the wrist to the flange it turns the flange by the angle. Both are scaled up where the shots show more.
POSE_SIGMA_MM = 0.01
POSE_SIGMA_RAD = POSE_SIGMA_MM / 150
# Bias that all touches share (probe length, ball radius), mm, k = 1.
TOUCH_BIAS_SIGMA_MM = 0.01
# No industrial arm stands wrong by this much: a larger residual means wrong poses or another plate.
LARGEST_RESIDUAL_MM = 1.0
MAX_ITERATIONS = 30


@dataclass(frozen=True, eq=False)
class _Solution:
    x: Floats
    centres: Floats
    covariance: Floats
    residuals: Floats
    """(shots, 3, 3), mm, flange axes: r_ij."""
    chi2: float
    dof: int


def _skew(v: Floats) -> Floats:
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return out - np.swapaxes(out, -1, -2)


def _rotation(w: Floats) -> Floats:
    """Rodrigues."""
    angle = float(np.linalg.norm(w))
    if angle < 1e-12:
        return np.eye(3) + _skew(w)
    k = _skew(w / angle)
    return np.asarray(np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k)


def _inverse(t: Floats) -> Floats:
    out = np.eye(4)
    out[:3, :3] = t[:3, :3].T
    out[:3, 3] = -t[:3, :3].T @ t[:3, 3]
    return out


def _solve(flange_from_base: Floats, seen: Floats, seen_cov: Floats, touched: Floats, pose_factor: float) -> _Solution:
    """Gauss-Newton; `flange_from_base` (n, 4, 4), `seen` (n, 3, 3), `seen_cov` (n, 3, 3, 3), `touched` (3, 3)."""
    n = len(seen)
    turn, shift = flange_from_base[:, :3, :3], flange_from_base[:, :3, 3]

    def in_flange(centres: Floats) -> Floats:
        return np.asarray(np.einsum("nab,jb->nja", turn, centres) + shift[:, None])

    x = register_rigid(seen.reshape(-1, 3), in_flange(touched).reshape(-1, 3)).target_from_source.copy()
    centres = touched.copy()
    pose = np.diag([POSE_SIGMA_MM**2] * 3 + [POSE_SIGMA_RAD**2] * 3) * pose_factor**2
    prior = np.kron(np.eye(3), np.eye(3)) * TOUCH_SIGMA_MM**2
    prior += np.kron(np.ones((3, 3)), np.eye(3)) * TOUCH_BIAS_SIGMA_MM**2
    prior_white = np.linalg.inv(np.linalg.cholesky(prior))
    residuals: Floats = np.zeros((n, 3, 3))
    normal: Floats = np.eye(15)
    chi2 = 0.0
    for _ in range(MAX_ITERATIONS):
        rotation = x[:3, :3]
        expected = in_flange(centres)
        residuals = np.asarray(seen @ rotation.T + x[:3, 3] - expected, dtype=np.float64)
        jacobian = np.zeros((n, 3, 3, 15))
        jacobian[..., :3] = -rotation @ _skew(seen)
        jacobian[..., 3:6] = np.eye(3)
        moved = np.zeros((n, 3, 3, 6))
        moved[..., :3] = np.eye(3)
        moved[..., 3:] = _skew(expected)
        covariance = np.zeros((n, 9, 9))
        for j in range(3):
            jacobian[:, j, :, 6 + 3 * j : 9 + 3 * j] = -turn
            covariance[:, 3 * j : 3 * j + 3, 3 * j : 3 * j + 3] = rotation @ seen_cov[:, j] @ rotation.T
        moves = moved.reshape(n, 9, 6)
        covariance += moves @ pose @ np.swapaxes(moves, 1, 2)
        white: Floats = np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), dtype=np.float64)
        rows = (white @ jacobian.reshape(n, 9, 15)).reshape(-1, 15)
        values = (white @ residuals.reshape(n, 9, 1)).reshape(-1)
        off_prior = np.zeros((9, 15))
        off_prior[:, 6:] = prior_white
        rows = np.vstack([rows, off_prior])
        values = np.concatenate([values, prior_white @ (centres - touched).reshape(-1)])
        normal = np.asarray(rows.T @ rows, dtype=np.float64)
        chi2 = float(values @ values)
        step = np.asarray(-np.linalg.solve(normal, rows.T @ values), dtype=np.float64)
        x[:3, :3] = rotation @ _rotation(step[:3])
        x[:3, 3] += step[3:6]
        centres = centres + step[6:].reshape(3, 3)
        if np.abs(step).max() < 1e-12:
            break
    covariance = np.asarray(np.linalg.inv(normal)[:6, :6], dtype=np.float64)
    return _Solution(x, centres, covariance, residuals, chi2, 9 * n + 9 - 15)


def _fitted(flange_from_base: Floats, seen: Floats, seen_cov: Floats, touched: Floats) -> tuple[_Solution, float]:
    """The solution with the poses' uncertainty raised until chi2 agrees with the degrees of freedom."""
    factor = 1.0
    solution = _solve(flange_from_base, seen, seen_cov, touched, factor)
    for _ in range(8):
        excess = solution.chi2 / solution.dof
        if excess <= 1.0 or len(seen) == 1:
            break
        factor *= float(np.sqrt(excess))
        solution = _solve(flange_from_base, seen, seen_cov, touched, factor)
        if abs(solution.chi2 / solution.dof - 1.0) < 0.02:
            break
    return solution, factor


def solve_hand_eye(
    views: Sequence[PlateView], base_from_flange: Sequence[Floats], touched_mm: Floats, date: str | None = None
) -> HandEye:
    """flange_from_scanner from all artefact shots together, least squares whitened by their covariances.

    Args:
        views: per shot the three centres in the scanner's frame with covariances.
        base_from_flange: per shot the (4, 4) flange pose.
        touched_mm: (3, 3) centres touched with the robot, base.
        date: of the calibration; now, by default.

    Returns:
        HandEye, with the covariance of a small rotation about the scanner's axes (rad) and a translation along the
        flange's axes (mm), residuals per shot, and the error of each shot under the solution without it.

    Raises:
        PlateMismatch: shots, poses and plate contradict each other by more than any robot stands wrong.
    """
    poses = np.array([_inverse(np.asarray(pose)) for pose in base_from_flange])
    seen = np.array([view.centres_mm for view in views])
    seen_cov = np.array([view.covariances_mm2 for view in views])
    touched = np.asarray(touched_mm, dtype=float)
    solution, factor = _fitted(poses, seen, seen_cov, touched)
    rms = float(np.sqrt(np.square(solution.residuals).sum(axis=-1).mean()))
    if rms > LARGEST_RESIDUAL_MM:
        raise PlateMismatch(
            f"artefact.centres_base: plate, poses and images contradict each other by {rms:.2f} mm (rms) though the "
            "distances of the spheres fit: is the plate mirrored, was it moved, or are flange poses wrong?"
        )
    shots = []
    for i, view in enumerate(views):
        left_out = None
        if len(views) > 1:
            rest = np.arange(len(views)) != i
            without = _solve(poses[rest], seen[rest], seen_cov[rest], touched, factor)
            placed = seen[i] @ without.x[:3, :3].T + without.x[:3, 3]
            expected = without.centres @ poses[i, :3, :3].T + poses[i, :3, 3]
            left_out = float(np.sqrt(np.square(placed - expected).sum(axis=-1).mean()))
        sizes = np.linalg.norm(solution.residuals[i], axis=-1)
        spheres = tuple(
            SphereFit(
                centre_mm=view.centres_mm[j],
                covariance_mm2=view.covariances_mm2[j],
                rms_mm=view.rms_mm[j],
                points=view.points[j],
                residual_mm=float(sizes[j]),
            )
            for j in range(3)
        )
        shots.append(
            ArtefactShot(
                shot=view.shot,
                spheres=spheres,
                distances_mm=distances(view.centres_mm),
                residual_rms_mm=float(np.sqrt(np.square(sizes).mean())),
                left_out_error_mm=left_out,
            )
        )
    document = solution.x.tobytes() + solution.covariance.tobytes()
    result = HandEye(
        flange_from_scanner=solution.x,
        covariance=solution.covariance,
        residual_rms_mm=rms,
        per_shot=tuple(shots),
        touched_distances_mm=distances(touched),
        reduced_chi2=None if solution.dof <= 0 else solution.chi2 / solution.dof,
        working_point_u_mm=0.0,
        id=hashlib.sha256(document).hexdigest()[:16],
        date=date or datetime.now(UTC).isoformat(timespec="seconds"),
    )
    return replace(result, working_point_u_mm=point_uncertainty_mm(result, seen.reshape(-1, 3).mean(axis=0)))


def point_uncertainty_mm(hand_eye: HandEye, point_mm: Floats) -> float:
    """Standard uncertainty of a point (scanner frame, mm) placed in the flange's frame, along its worst direction."""
    jacobian = np.hstack([-hand_eye.flange_from_scanner[:3, :3] @ _skew(np.asarray(point_mm)), np.eye(3)])
    return float(np.sqrt(np.linalg.eigvalsh(jacobian @ hand_eye.covariance @ jacobian.T).max()))


def base_from_flange(shot: ShotSpec) -> Floats:
    """The shot's flange pose as a matrix."""
    pose = shot.flange_pose
    if pose is None:
        raise InputError(f"shot {shot.name!r}: it has no flange_pose")
    return matrix_from_kuka(pose.X, pose.Y, pose.Z, pose.A, pose.B, pose.C)


def hand_eye_of(read: PointReader, left_out: list[tuple[str, str]]) -> HandEye | None:
    """The session's hand-eye: the one that it carries, else the one that its artefact shots give.

    Args:
        read: gives the shots' points.
        left_out: gets the artefact shots that could not be used, with the reason.

    Returns:
        HandEye; None without a robot, or where no artefact shot could be used.

    Raises:
        PlateMismatch: the plate in view is not the one described, in no shot, or contradicts the poses.
    """
    session: Session = read.session
    if isinstance(session.hand_eye, HandEyeSpec):
        return _kept(session.hand_eye)
    if session.artefact is None or not session.artefact_shots:
        return None
    touched = np.array(session.artefact.centres_base)
    views: list[PlateView] = []
    poses: list[Floats] = []
    mistaken: PlateMismatch | None = None
    unusable = {name for name, _ in left_out}
    for shot in session.artefact_shots:
        if shot.name in unusable:
            continue
        pose, cloud = base_from_flange(shot), read(shot)
        t = time.perf_counter()
        try:
            view = find_plate(shot.name, cloud.points_mm, session.artefact.sphere_diameter, touched, pose)
        except PlateMismatch as error:
            mistaken = error
            left_out.append((shot.name, str(error)))
        except GeometryError as error:
            left_out.append((shot.name, read.why_dark(shot) or str(error)))
        else:
            views.append(view)
            poses.append(pose)
        read.clock("spheres", t)
    where = session.folder / "session.json"
    if not views:
        if mistaken is not None:
            raise PlateMismatch(f"{where}: {mistaken}")
        return None
    t = time.perf_counter()
    try:
        solved = solve_hand_eye(views, poses, touched)
    except PlateMismatch as error:
        raise PlateMismatch(f"{where}: {error}") from None
    read.clock("hand_eye", t)
    return solved


def _kept(spec: HandEyeSpec) -> HandEye:
    return HandEye(
        flange_from_scanner=np.array(spec.flange_from_scanner),
        covariance=np.array(spec.covariance),
        residual_rms_mm=spec.residual_rms_mm,
        per_shot=(),
        touched_distances_mm=np.array(spec.touched_distances_mm or ()),
        reduced_chi2=spec.reduced_chi2,
        working_point_u_mm=spec.working_point_u_mm or 0.0,
        id=spec.id,
        date=spec.date,
    )


def calibrate(session_folder: Path | str, progress: Progress | None = None) -> HandEye:
    """flange_from_scanner from the artefact shots of a session (`weldscan calibrate hand-eye`).

    Raises:
        InputError: the session is wrong, or the plate in view is not the one that it describes.
        NotMeasured: no artefact shot could be used; the message says why, shot by shot.
    """
    session = read_session(session_folder)
    if not session.artefact_shots:
        raise InputError(f"{session.folder / 'session.json'}: shots: none is of the artefact")
    left_out: list[tuple[str, str]] = []
    found = hand_eye_of(PointReader(session, progress), left_out)
    if found is None:
        raise NotMeasured("; ".join(f"{name}: {why}" for name, why in left_out))
    return found
