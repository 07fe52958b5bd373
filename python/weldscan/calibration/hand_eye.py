"""Where the scanner sits on the flange: `flange_from_scanner` from shots of the three-sphere plate.

Least squares over all shots, in which the error of a pose is common to the three spheres of its shot and the bias of
the probe to all touched centres (`hand_eye_model`). What was stated of robot, probe and spheres is corrected by what
the shots show; shots that contradict the others are named and not used. One shot suffices where the centres were
touched (the paper's case, its Eqs. 8-11), with the covariance that the stated noise gives; unknown centres need five.

Source: shared design METHOD ("Hand-eye from three spheres").
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import refuse_masked, register_rigid
from weldscan.calibration.artefact import (
    TOUCH_SIGMA_MM,
    PlateMismatch,
    PlateView,
    distances,
    order_complaint,
    same_side,
)
from weldscan.calibration.hand_eye_model import (
    DIRECTION,
    FACTORS,
    PLACE,
    SPHERE,
    UNKNOWNS,
    Linear,
    Noise,
    Posterior,
    chi2_quantile,
    f_exceeded,
)
from weldscan.errors import GeometryError, InputError
from weldscan.geometry import inverse, rotation_of, rotation_vector_of, skew
from weldscan.result import ArtefactShot, ArtefactSphere, HandEye

Floats = NDArray[np.float64]

# The robot's pose, k = 1, where the session does not state it. A repeatability of 0.03 mm (the paper's Table 3) is
# three sigma by ISO 9283; what counts here is how far poses that look at the plate from all sides are off against each
# other, an arm's accuracy over a few decimetres: taken as three times that sigma. The angle is the same over the
# 300 mm of the last links. Both are believed to within a factor of two, so that one shot alone carries 1.6 times as
# much; where there are more shots, these say how good the robot is (docs/decisions/0007).
POSE_SIGMA_MM = 0.03
POSE_SIGMA_RAD = POSE_SIGMA_MM / 300
# What is placed elsewhere in the robot's volume is placed no better than a data sheet's repeatability (0.03 mm, three
# sigma, over the 150 mm of the wrist), however well a few shots of the plate agree.
REPEATABILITY_MM = 0.01
REPEATABILITY_RAD = REPEATABILITY_MM / 150
# Bias that all touches share (probe length, ball radius), mm, k = 1.
TOUCH_BIAS_SIGMA_MM = 0.01
# No industrial arm stands wrong by this much: a larger residual means wrong poses or another plate.
LARGEST_RESIDUAL_MM = 1.0
# A shot further off than the radius of a usual sphere has nothing to do with its pose: not an outlier, a mistake.
GROSS_MM = 10.0
# Without touched centres the shots must find nine numbers more: four shots leave 21 equations for them and the noise,
# and one outlier could not be told any more.
SHOTS_WITHOUT_TOUCH = 5
# A shot is named where shots as the others are would be as far off once in a hundred calibrations.
OUTLIER_PROBABILITY = 0.01
# Poses should be tilted by 30 to 45 degrees to all sides; below a third of that the touches' bias is not separated.
LEAST_TILT_RAD = math.radians(10)
MAX_ITERATIONS = 30
# A cause that leaves more than this part of the squares is none: honest touches leave a tenth of what calls for a word.
UNEXPLAINED = 0.25


@dataclass(frozen=True, eq=False)
class _HandEyeProblem:
    """The checked input."""

    names: tuple[str, ...]
    flange_from_base: Floats
    seen: Floats
    seen_cov: Floats
    touched: Floats | None
    noise: Noise

    def about(self, x: Floats, centres: Floats) -> Linear:
        return Linear(x, centres, self.flange_from_base, self.seen, self.seen_cov, self.touched, self.noise)


@dataclass(frozen=True, eq=False)
class _Found:
    x: Floats
    centres: Floats
    posterior: Posterior
    linear: Linear
    keep: Floats
    """(n,) ones and zeros."""
    chi2: Floats
    """(n,) of each shot against all others, nine degrees of freedom."""
    chance: Floats
    """(n,) the probability of such a chi2."""
    left_out_mm: Floats
    """(n,) rms distance of the shot's centres under the solution of the others."""


def _moved(x: Floats, centres: Floats, step: Floats) -> tuple[Floats, Floats]:
    out = x.copy()
    out[:3, :3] = x[:3, :3] @ rotation_of(step[:3])
    # Products of rotations lose a bit of their last digits each time.
    u, _, v = np.linalg.svd(out[:3, :3])
    out[:3, :3] = u @ v
    out[:3, 3] += step[3:6]
    return out, centres + step[6:].reshape(3, 3)


def _start(problem: _HandEyeProblem, keep: Floats) -> tuple[Floats, Floats]:
    """Closed forms: Horn's over all shots stacked; without touched centres linear in rotation, place and centres."""
    use = keep > 0
    poses, seen = problem.flange_from_base[use], problem.seen[use]
    turn, shift = poses[:, :3, :3], poses[:, :3, 3]
    if problem.touched is not None:
        expected = np.einsum("nab,jb->nja", turn, problem.touched) + shift[:, None]
        found = register_rigid(seen.reshape(-1, 3), expected.reshape(-1, 3))
        return found.target_from_source.copy(), problem.touched.copy()
    # R m + t - T c = s: 21 unknowns, of which R is then made a rotation. Lengths are counted in the poses' spread.
    scale = float(np.abs(seen).max())
    n = len(seen)
    rows = np.zeros((n, 3, 3, 21))
    for a in range(3):
        rows[:, :, a, 3 * a : 3 * a + 3] = seen / scale
        rows[:, :, a, 9 + a] = 1.0
    for j in range(3):
        rows[:, j, :, 12 + 3 * j : 15 + 3 * j] = -turn
    right = np.repeat(shift[:, None] / scale, 3, axis=1)
    solved = np.linalg.lstsq(rows.reshape(-1, 21), right.reshape(-1), rcond=None)[0]
    u, _, v = np.linalg.svd(solved[:9].reshape(3, 3))
    x = np.eye(4)
    x[:3, :3] = u @ np.diag([1.0, 1.0, float(np.linalg.det(u @ v))]) @ v
    x[:3, 3] = solved[9:12] * scale
    return x, np.asarray(solved[12:].reshape(3, 3) * scale, dtype=np.float64)


def _least_squares(problem: _HandEyeProblem, keep: Floats) -> tuple[Floats, Floats, Linear]:
    """Gauss-Newton with the stated noise."""
    x, centres = _start(problem, keep)
    stated = np.ones((1, FACTORS))
    linear = problem.about(x, centres)
    for _ in range(MAX_ITERATIONS):
        step = linear.solve(stated, keep)[0][0]
        if not np.isfinite(step).all():
            break
        x, centres = _moved(x, centres, step)
        linear = problem.about(x, centres)
        if np.abs(step).max() < 1e-10:
            break
    return x, centres, linear


def _against_the_others(
    linear: Linear, factors: Floats, keep: Floats, weights: Floats | None = None
) -> tuple[Floats, Floats]:
    """Per shot: chi square of its nine residuals under the solution of the others, and their rms distance, mm."""
    grams, _ = linear.grams(factors[None], weights)
    prior, _ = linear.prior(factors[None])
    whole = prior[0] + np.einsum("nab,n->ab", grams[0], keep)
    rest = whole - grams[0] * keep[:, None, None]
    rows, normal = linear.rows[..., :UNKNOWNS], rest[:, :UNKNOWNS, :UNKNOWNS]
    step = -np.linalg.solve(normal, rest[:, :UNKNOWNS, UNKNOWNS:])
    off = rows @ step + linear.rows[..., UNKNOWNS:]
    covariance = linear.covariance(factors) + rows @ np.linalg.solve(normal, np.swapaxes(rows, 1, 2))
    chi2 = np.swapaxes(off, 1, 2) @ np.linalg.solve(covariance, off)
    distance = np.square(off[..., 0].reshape(-1, 3, 3)).sum(axis=2).mean(axis=1)
    return chi2[:, 0, 0], np.sqrt(distance)


def _robust(linear: Linear) -> tuple[Floats, Floats]:
    """Factors and weights of the poses as if their errors followed Student's t with four degrees of freedom (EM).

    Source: K. L. Lange, R. J. A. Little, J. M. G. Taylor, J. Am. Statist. Assoc. 84 (1989) 881.
    """
    weights, logs = np.ones(linear.shots), np.zeros(FACTORS)
    for _ in range(6):
        logs, _ = linear.mode(logs, weights=weights, steps=2)
        step = np.append(linear.solve(np.exp(logs)[None], weights=weights)[0][0], 1.0)
        grams, _ = linear.grams(np.exp(logs)[None])
        weights = (4 + 9) / (4 + np.einsum("a,nab,b->n", step, grams[0], step))
    return np.exp(logs), weights


def _chance(chi2: Floats, others: int) -> Floats:
    """How probable such a chi square of nine degrees is, the noise being known from so many other shots."""
    dof = 6 * max(others - 1, 0) + 1
    return np.array([f_exceeded(value / 9, 9.0, float(dof)) for value in chi2])


def _agreeing(linear: Linear) -> Floats:
    """Which shots agree with each other, (n,) ones and zeros. More than half do, or all are kept."""
    n = linear.shots
    everyone = np.ones(n)
    if n < 3:
        return everyone
    weights: Floats | None
    factors, weights = _robust(linear)
    keep = everyone
    for _ in range(5):
        chi2, _ = _against_the_others(linear, factors, keep, weights)
        fit = _chance(chi2, int(keep.sum())) >= OUTLIER_PROBABILITY / n
        if 2 * fit.sum() <= n or fit.sum() < 2:
            return everyone
        if np.array_equal(fit, keep > 0) and weights is None:
            break
        keep, weights = fit.astype(float), None
        factors = np.exp(linear.mode(keep=keep)[0])
    return keep


def _fitted(problem: _HandEyeProblem) -> _Found:
    """All of it: start, outliers, the posterior of the rest, each shot against the others."""
    everyone = np.ones(len(problem.seen))
    x, centres, linear = _least_squares(problem, everyone)
    keep = _agreeing(linear)
    if keep.sum() < len(keep):
        # An outlier far off has spoilt the point that all is linear about.
        x, centres, linear = _least_squares(problem, keep)
        keep = _agreeing(linear)
        x, centres, linear = _least_squares(problem, keep)
    posterior = linear.posterior(keep)
    x, centres = _moved(x, centres, posterior.step)
    linear = problem.about(x, centres)
    alone = np.zeros(1), np.zeros(1)
    chi2, left_out = _against_the_others(linear, posterior.mode, keep) if len(keep) > 1 else alone
    return _Found(x, centres, posterior, linear, keep, chi2, _chance(chi2, int(keep.sum())), left_out)


def _problem(
    views: Sequence[PlateView], base_from_flange: Sequence[Floats], touched_mm: Floats | None, noise: Noise
) -> _HandEyeProblem:
    """The input, checked: shapes, finite, rigid, no shot twice, spheres in order."""
    refuse_masked("views", [[view.centres_mm, view.covariances_mm2] for view in views])
    refuse_masked("base_from_flange", list(base_from_flange))
    refuse_masked("touched_mm", touched_mm)
    names = tuple(view.shot for view in views)
    poses = [np.asarray(pose, dtype=np.float64) for pose in base_from_flange]
    if not views or len(poses) != len(views):
        raise InputError(f"base_from_flange: {len(poses)} poses for {len(views)} views; one or more of each is needed")
    for name, pose in zip(names, poses, strict=True):
        if pose.shape != (4, 4):
            raise InputError(f"base_from_flange: {name}: a 4x4 matrix is needed, not one of shape {pose.shape}")
        if not np.isfinite(pose).all():
            raise InputError(f"base_from_flange: {name}: {int((~np.isfinite(pose)).sum())} numbers are not finite")
        turn = pose[:3, :3]
        off = float(np.abs(turn @ turn.T - np.eye(3)).max())
        if off > 1e-4 or np.linalg.det(turn) < 0:
            raise InputError(f"base_from_flange: {name}: is not a rigid transform (off by {off:.2g})")
    seen = np.array([np.asarray(view.centres_mm, dtype=np.float64) for view in views])
    seen_cov = np.array([np.asarray(view.covariances_mm2, dtype=np.float64) for view in views])
    for name, centres, covariance in zip(names, seen, seen_cov, strict=True):
        if centres.shape != (3, 3) or covariance.shape != (3, 3, 3):
            raise InputError(f"views: {name}: three centres with three 3x3 covariances are needed")
        if not np.isfinite(centres).all() or not np.isfinite(covariance).all():
            raise InputError(f"views: {name}: a centre or covariance is not finite")
        if np.linalg.eigvalsh(covariance).min() <= 0:
            raise InputError(f"views: {name}: a covariance is not positive definite")
    for field in ("pose_mm", "pose_rad", "touch_mm", "touch_bias_mm"):
        value = getattr(noise, field)
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{field.replace('_', '_sigma_', 1)}: must be positive, got {value}")
    for i, name in enumerate(names):
        for j in range(i):
            if np.array_equal(seen[i], seen[j]):
                raise InputError(f"views: {name} is {names[j]} once more: a shot counts once, leave one of them out")
    touched = None
    if touched_mm is not None:
        touched = np.asarray(touched_mm, dtype=np.float64)
        if touched.shape != (3, 3) or not np.isfinite(touched).all():
            raise InputError("touched_mm: three centres of three finite numbers are needed")
    elif len(views) < SHOTS_WITHOUT_TOUCH:
        raise InputError(
            f"touched_mm: {len(views)} shots do not tell where spheres are that were not touched; "
            f"{SHOTS_WITHOUT_TOUCH} or more are needed, tilted by 30 to 45 degrees to all sides"
        )
    reference = touched if touched is not None else seen[0]
    for view in views:
        complaint = order_complaint(view, reference, touched is not None)
        if complaint is not None:
            raise PlateMismatch(f"artefact.centres_base: {view.shot}: {complaint}")
    if touched is not None and len(views) == 1 and not same_side(seen[0], touched, poses[0]):
        raise PlateMismatch(
            f"artefact.centres_base: {names[0]}: the plate is mirrored: its spheres run the other way round than those "
            "in view"
        )
    return _HandEyeProblem(names, np.array([inverse(pose) for pose in poses]), seen, seen_cov, touched, noise)


def tilts_rad(base_from_flange: Sequence[Floats]) -> tuple[float, float]:
    """How far poses are turned against each other, rms, about the axis with most and the one with second most."""
    turns = [np.asarray(pose)[:3, :3] for pose in base_from_flange]
    vectors = []
    for i, one in enumerate(turns):
        for other in turns[:i]:
            # Half a turn has no axis here; it is a large turn all the same, and others tell about which axis.
            vectors.append(rotation_vector_of(one.T @ other))
    if not vectors:
        return 0.0, 0.0
    spread = np.linalg.svd(np.array(vectors), compute_uv=False) / math.sqrt(len(vectors))
    return float(spread[0]), float(spread[1]) if len(spread) > 1 else 0.0


def solve_hand_eye(
    views: Sequence[PlateView],
    base_from_flange: Sequence[Floats],
    touched_mm: Floats | None,
    date: str | None = None,
    *,
    pose_sigma_mm: float = POSE_SIGMA_MM,
    pose_sigma_rad: float = POSE_SIGMA_RAD,
    touch_sigma_mm: float = TOUCH_SIGMA_MM,
    touch_bias_sigma_mm: float = TOUCH_BIAS_SIGMA_MM,
) -> HandEye:
    """flange_from_scanner from all artefact shots together, least squares whitened by their covariances.

    The stated noise of robot, probe and spheres is where the solution starts from; the shots correct it, and what they
    leave open of it is in the covariance. Shots that contradict the others beyond chance are named and not used.

    Args:
        views: per shot the three centres in the scanner's frame with covariances, in the order of the touched ones.
        base_from_flange: per shot the (4, 4) flange pose.
        touched_mm: (3, 3) centres touched with the robot, base; None where they were not: from five shots on.
        date: of the calibration; now, by default.
        pose_sigma_mm: standard uncertainty of a pose's place, each axis, k = 1.
        pose_sigma_rad: of its direction, about each axis.
        touch_sigma_mm: of a touched centre, each coordinate, its own.
        touch_bias_sigma_mm: and common to all (length of the probe, radius of its ball).

    Returns:
        HandEye, with the covariance of a small rotation about the scanner's axes (rad) and a translation along the
        flange's axes (mm), residuals per shot, and the error of each shot under the solution without it.

    Raises:
        InputError: shapes, numbers that are not finite, a shot that is there twice, too few shots.
        GeometryError: the poses do not determine the transform: parallel ones, or turned about one axis only.
        PlateMismatch: shots, poses and plate contradict each other by more than any robot stands wrong; the spheres
            are in another order than touched, or mirrored.

    Example:
        >>> import numpy as np
        >>> from weldscan import PlateView, solve_hand_eye
        >>> plate = np.array([[-27.0, -24.0, 5.0], [25.0, -24.0, 7.0], [17.0, 19.0, 4.0]])
        >>> covariances = np.tile(np.eye(3) * 1e-4, (3, 1, 1))
        >>> view = PlateView("artefact-1", plate + [0, 0, 420], covariances, (0.01,) * 3, (9000,) * 3)
        >>> found = solve_hand_eye([view], [np.diag([1.0, -1.0, -1.0, 1.0])], plate * [1, -1, -1] + [30, 0, -500])
        >>> found.flange_from_scanner[:3, 3].round(6) + 0.0
        array([30.,  0., 80.])
    """
    noise = Noise(pose_sigma_mm, pose_sigma_rad, touch_sigma_mm, touch_bias_sigma_mm)
    problem = _problem(views, base_from_flange, touched_mm, noise)
    turned = tilts_rad(base_from_flange)
    try:
        found = _fitted(problem)
    except np.linalg.LinAlgError:
        raise _undetermined(math.inf, turned) from None
    covariance = found.posterior.covariance
    _refuse_contradictions(problem, found, base_from_flange)
    middle = problem.seen.reshape(-1, 3).mean(axis=0)
    shots = []
    sizes = np.linalg.norm(found.linear.residuals, axis=-1)
    for i, view in enumerate(views):
        spheres = tuple(
            ArtefactSphere(
                centre_mm=problem.seen[i, j],
                covariance_mm2=problem.seen_cov[i, j],
                rms_mm=view.rms_mm[j],
                points=view.points[j],
                residual_mm=float(sizes[i, j]),
            )
            for j in range(3)
        )
        shots.append(
            ArtefactShot(
                shot=view.shot,
                spheres=spheres,
                distances_mm=distances(problem.seen[i]),
                residual_rms_mm=float(np.sqrt(np.square(sizes[i]).mean())),
                left_out_error_mm=float(found.left_out_mm[i]) if len(views) > 1 else None,
                chi2=float(found.chi2[i]) if len(views) > 1 else None,
                outlier=None if found.keep[i] else _why_outlier(problem, found, i),
            )
        )
    dof = 9 * int(found.keep.sum()) - (6 if problem.touched is not None else UNKNOWNS)
    stated = float(found.linear.solve(np.ones((1, FACTORS)), found.keep)[2][0])
    factors = found.posterior.factors
    bias = bias_u = None
    if problem.touched is not None:
        mean = np.kron(np.ones((1, 3)), np.eye(3)) / 3
        bias = (found.centres - problem.touched).mean(axis=0)
        bias_u = np.sqrt(np.diag(mean @ covariance[6:, 6:] @ mean.T))
    document = found.x.tobytes() + covariance.tobytes()
    result = HandEye(
        flange_from_scanner=found.x,
        covariance=np.ascontiguousarray(covariance[:6, :6]),
        residual_rms_mm=float(np.sqrt(np.square(sizes[found.keep > 0]).mean())),
        per_shot=tuple(shots),
        touched_distances_mm=distances(found.centres if problem.touched is None else problem.touched),
        reduced_chi2=stated / dof,
        working_point_u_mm=0.0,
        id=hashlib.sha256(document).hexdigest()[:16],
        date=date or datetime.now(UTC).isoformat(timespec="seconds"),
        pose_sigma_mm=noise.pose_mm * math.sqrt(factors[PLACE]),
        pose_sigma_rad=noise.pose_rad * math.sqrt(factors[DIRECTION]),
        sphere_sigma_ratio=math.sqrt(factors[SPHERE]),
        centres_base_mm=found.centres,
        probe_bias_mm=bias,
        probe_bias_u_mm=bias_u,
        tilts_deg=(math.degrees(turned[0]), math.degrees(turned[1])),
    )
    u_mm = point_uncertainty_mm(result, middle)
    if not u_mm <= LARGEST_RESIDUAL_MM:
        raise _undetermined(u_mm, turned)
    result = replace(result, working_point_u_mm=u_mm)
    return replace(result, warnings=_warnings(problem, found, result))


def _undetermined(u_mm: float, turned: tuple[float, float]) -> GeometryError:
    known = f"be known to {u_mm:.2g} mm" if math.isfinite(u_mm) else "not be known"
    return GeometryError(
        f"the poses do not determine the hand-eye transform: a point at the working distance would {known}; "
        f"they are turned against each other by {math.degrees(turned[0]):.1f} degrees about one "
        f"axis and {math.degrees(turned[1]):.1f} about a second, 30 to 45 about two are needed"
    )


def _refuse_contradictions(problem: _HandEyeProblem, found: _Found, base_from_flange: Sequence[Floats]) -> None:
    sizes = np.sqrt(np.square(found.linear.residuals).sum(axis=-1).mean(axis=-1))
    rms = float(np.sqrt(np.square(sizes[found.keep > 0]).mean()))
    touched = problem.touched
    if touched is not None:
        # Touches that nothing confirms are hardly believed, and then all of a contradiction is in them.
        rms = max(rms, float(np.sqrt(np.square(found.centres - touched).sum(axis=1).mean())))
    if not rms <= LARGEST_RESIDUAL_MM:
        sides = (
            [same_side(seen, touched, pose) for seen, pose in zip(problem.seen, base_from_flange, strict=True)]
            if touched is not None
            else [True]
        )
        if 2 * sum(sides) < len(sides):
            raise PlateMismatch(
                "artefact.centres_base: the plate is mirrored: its spheres run the other way round than those in view "
                f"(plate, poses and images contradict each other by {rms:.2f} mm rms)"
            )
        raise PlateMismatch(
            f"artefact.centres_base: plate, poses and images contradict each other by {rms:.2f} mm (rms) though the "
            "distances of the spheres fit: is the plate mirrored, was it moved, or are flange poses wrong?"
        )
    worst = int(np.argmax(sizes))
    if sizes[worst] > GROSS_MM:
        raise PlateMismatch(
            f"artefact.centres_base: pose and image of {problem.names[worst]} contradict each other by "
            f"{sizes[worst]:.2f} mm while the other shots agree to {rms:.3f} mm: its flange pose is wrong, or the "
            "plate was moved; leave that shot out"
        )


def _why_outlier(problem: _HandEyeProblem, found: _Found, i: int) -> str:
    threshold = chi2_quantile(1 - OUTLIER_PROBABILITY / len(problem.names), 9)
    return (
        f"an outlier, not used: {found.left_out_mm[i]:.3f} mm off under the hand-eye of the other "
        f"{int(found.keep.sum())} shots, chi2 {found.chi2[i]:.0f} with 9 degrees of freedom, where {threshold:.0f} is "
        "exceeded by chance in one calibration of a hundred"
    )


def _warnings(problem: _HandEyeProblem, found: _Found, result: HandEye) -> tuple[str, ...]:
    said = []
    used = int(found.keep.sum())
    if used == len(problem.names) and used > 1:
        worst = int(np.argmax(found.chi2))
        if found.chance[worst] < OUTLIER_PROBABILITY / used:
            said.append(
                f"the {used} shots contradict each other ({problem.names[worst]} most, by "
                f"{found.left_out_mm[worst]:.3f} mm), and there are too few to tell which of them is wrong"
            )
    if found.posterior.factors[PLACE] > 9 or found.posterior.factors[DIRECTION] > 9:
        said.append(
            f"the robot's poses are off by {result.pose_sigma_mm:.3f} mm and "
            f"{math.degrees(result.pose_sigma_rad or 0):.4f} degrees (k = 1), more than three times the "
            f"{problem.noise.pose_mm:g} mm or {math.degrees(problem.noise.pose_rad):.4f} degrees stated"
        )
    if found.posterior.factors[SPHERE] > 4:
        said.append(
            f"the spheres scatter {result.sphere_sigma_ratio:.1f} times more than their fits say: is the scanner's "
            "calibration still good, are the spheres clean?"
        )
    if problem.touched is not None:
        sigma = np.sqrt(np.diag(found.posterior.covariance)[6:].reshape(3, 3).max(axis=1))
        said += _about_touches(found.centres - problem.touched, sigma, result, problem.noise)
    second = result.tilts_deg[1]
    if len(problem.names) > 2 and math.radians(second) < LEAST_TILT_RAD:
        said.append(
            f"the poses are turned by {second:.1f} degrees about a second axis; 30 to 45 are needed to tell the "
            "hand-eye from the touches' common error"
        )
    return tuple(said)


def _about_touches(off: Floats, u: Floats, result: HandEye, noise: Noise) -> list[str]:
    """What the touched centres are off by, and the cause that fits: the probe, one touch, or a plate that moved.

    Args:
        off: (3, 3), where the shots have each centre, less where it was touched.
        u: (3,) standard uncertainty of the former, worst axis.
        result: the hand-eye, with the probe's bias.
        noise: what was stated.
    """
    sizes = np.linalg.norm(off, axis=1)
    alone = sizes > np.maximum(6 * math.hypot(noise.touch_mm, noise.touch_bias_mm), 3 * u)
    together, together_u = 0.0, 0.0
    if result.probe_bias_mm is not None and result.probe_bias_u_mm is not None:
        together, together_u = float(np.linalg.norm(result.probe_bias_mm)), float(result.probe_bias_u_mm.max())
    if not (alone.any() or together > max(5 * noise.touch_bias_mm, 3 * together_u)):
        return []
    # What each cause would leave unexplained; all three move as many numbers, or twice as many for the plate.
    left = {
        "probe": float(np.square(off - off.mean(axis=0)).sum()),
        **{f"sphere {j + 1}": float(np.square(np.delete(off, j, axis=0)).sum()) for j in range(3)},
    }
    cause = min(left, key=lambda name: left[name])
    listed = ", ".join(f"{size:.3f}" for size in sizes)
    if left[cause] > UNEXPLAINED * float(np.square(off).sum()):
        return [
            f"the touched centres are off by {listed} mm, each its own way (u {u.max():.3f} mm): was the plate moved "
            "between touching and scanning, or was more than one sphere touched wrong?"
        ]
    if cause == "probe":
        return [
            f"all touched centres are off together by {together:.3f} mm (u {together_u:.3f} mm), where "
            f"{noise.touch_bias_mm:g} mm were stated: check the length of the probe"
        ]
    j = int(cause[-1]) - 1
    others = ", ".join(f"{size:.3f}" for size in np.delete(sizes, j))
    return [
        f"the touched centre of {cause} is off by {sizes[j]:.3f} mm (u {u[j]:.3f} mm), the others by {others} mm: "
        "touch that sphere again"
    ]


def point_covariance(hand_eye: HandEye, point_mm: Floats) -> Floats:
    """Covariance (3, 3), mm^2, of a point (scanner frame, mm) placed in the flange's frame."""
    jacobian = np.hstack([-hand_eye.flange_from_scanner[:3, :3] @ skew(np.asarray(point_mm)), np.eye(3)])
    return np.asarray(jacobian @ hand_eye.covariance @ jacobian.T)


def point_uncertainty_mm(hand_eye: HandEye, point_mm: Floats) -> float:
    """Standard uncertainty of a point (scanner frame, mm) placed in the flange's frame, along its worst direction."""
    return float(np.sqrt(np.linalg.eigvalsh(point_covariance(hand_eye, point_mm)).max()))


def pose_sigma(hand_eye: HandEye | None) -> tuple[float, float]:
    """Standard uncertainty of a flange pose, mm and rad: as the calibration's shots had it, else the default.

    Never less than a repeatability: the shots were taken around the plate, not where the part is.
    """
    if hand_eye is None or hand_eye.pose_sigma_mm is None or hand_eye.pose_sigma_rad is None:
        return POSE_SIGMA_MM, POSE_SIGMA_RAD
    return max(hand_eye.pose_sigma_mm, REPEATABILITY_MM), max(hand_eye.pose_sigma_rad, REPEATABILITY_RAD)
