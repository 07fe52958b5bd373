"""Camera, projector and every board pose in one robust least-squares adjustment, with its covariance.

Unknown are the two lenses (fx fy cx cy k1 k2 p1 p2 [k3] each), camera_from_projector and one pose per view. A feature
at X on the board is seen by the camera at x = pi_c(X_c) and has the projector's coordinates w = pi_p(X_p). The
projector does not look: its coordinate is the phase field at the place where the camera saw the feature, so an error of
that place is in both. With G = dw/dx, the slope of the phase field, the two independent residuals are

    r_c = pi_c(X_c) - x          r_p = pi_p(X_p) - w - G r_c

(the phase at the modelled place of the feature). Where features were given without a slope, G = 0. Minimised is

    sum rho(|r_c| / s_c) + sum rho(|r_p| / s_p),     Tukey's rho with c = 5.12, started with Huber's,

by Levenberg-Marquardt with analytic Jacobians; the poses are eliminated block by block (Schur complement). The scales
s_c and s_p come from the median residual. The covariance is that of the M-estimate (P. Huber, Robust Statistics (1981),
7.6) with each device's variance from its own redundancy (K.-R. Koch, Parameter Estimation (1999), 3.6).

Every parameter has a prior so wide that it counts only where the views say nothing at all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from weldscan.errors import GeometryError

Floats = NDArray[np.float64]

LENS_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
RELATION_NAMES = ("rx", "ry", "rz", "tx", "ty", "tz")
PARAMETERS = (
    *(f"camera.{name}" for name in LENS_NAMES),
    *(f"projector.{name}" for name in LENS_NAMES),
    *(f"camera_from_projector.{name}" for name in RELATION_NAMES),
)
"""Rotations are small turns about the camera's axes (rad), R_true = exp(w) R; translations are in mm."""
CAMERA, PROJECTOR, RELATION = slice(0, 9), slice(9, 18), slice(18, 24)
K3 = (8, 17)

# Tukey's and Huber's constants for residuals of two coordinates: 95 % efficiency with normal noise.
TUKEY, HUBER = 5.12, 1.5
# The median length of a two-dimensional normal residual, in sigmas.
MEDIAN_OF_RAYLEIGH = math.sqrt(2 * math.log(2))
MAX_ITERATIONS = 60
# A step is over when no lens parameter moves by more than this part of its own uncertainty.
STEP_TOLERANCE = 1e-6
# The scale cannot fall below this: residuals of made-up, noiseless features are zero.
LEAST_SCALE_PX = 1e-6


@dataclass(frozen=True, eq=False)
class Features:
    """What all views saw, flat: N features."""

    view: NDArray[np.intp]
    """(N,) index of the view, ascending."""
    board_mm: Floats
    """(N, 3)"""
    camera_px: Floats
    """(N, 2)"""
    projector_px: Floats
    """(N, 2), NaN where there is no phase."""
    slope: Floats
    """(N, 2, 2), d projector / d camera; zeros: errors of the two are independent."""
    relative_sigma: Floats
    """(N,) of the projector's coordinates, 1 for a typical one."""

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which have a projector coordinate."""
        return np.asarray(np.isfinite(self.projector_px).all(axis=1))

    def of(self, views: Sequence[int]) -> Features:
        """Those of some views, renumbered."""
        number = {view: i for i, view in enumerate(views)}
        kept = np.isin(self.view, list(views))
        index = np.array([number[v] for v in self.view[kept]], dtype=np.intp)
        arrays = (self.board_mm, self.camera_px, self.projector_px, self.slope, self.relative_sigma)
        return Features(index, *(array[kept] for array in arrays))


@dataclass(frozen=True, eq=False)
class Model:
    """The unknowns."""

    camera: Floats
    """(9,) as LENS_NAMES."""
    projector: Floats
    turn: Floats
    """(3, 3), of camera_from_projector."""
    shift: Floats
    """(3,), mm."""
    turns: Floats
    """(views, 3, 3), camera_from_board."""
    shifts: Floats
    """(views, 3), mm."""

    def moved(self, step: Floats, pose_steps: Floats) -> Model:
        """The model after a step of PARAMETERS and of the poses, (views, 6)."""
        return Model(
            self.camera + step[CAMERA],
            self.projector + step[PROJECTOR],
            rotation(step[18:21]) @ self.turn,
            self.shift + step[21:24],
            np.array([rotation(d[:3]) @ r for d, r in zip(pose_steps, self.turns, strict=True)]),
            self.shifts + pose_steps[:, 3:],
        )

    def of(self, views: Sequence[int]) -> Model:
        """The same with some of the poses."""
        return replace(self, turns=self.turns[list(views)], shifts=self.shifts[list(views)])

    @property
    def camera_from_projector(self) -> Floats:
        """4x4."""
        return rigid(self.turn, self.shift)


@dataclass(frozen=True, eq=False)
class Solution:
    """The adjusted model and how well it is known."""

    model: Model
    covariance: Floats
    """(24, 24) of PARAMETERS; rows of what was held are zero."""
    camera_residual_px: Floats
    """(N, 2), modelled minus seen."""
    projector_residual_px: Floats
    """(N, 2), the same; NaN where there is no phase. With the corner's own error in it."""
    used: NDArray[np.bool_]
    """(N, 2): not rejected as an outlier, camera and projector."""
    sigma_px: tuple[float, float]
    """Noise of a coordinate: the camera's features, the phase at them."""
    free: NDArray[np.intp]
    """Which of PARAMETERS were solved for."""
    prior_sigma: Floats
    """(24,), the width of the priors."""
    information: Floats
    """(24, 24) with the poses eliminated, priors included."""
    without: Floats
    """(views, 24): how PARAMETERS move when one view is left out, to first order."""


# --- projection with its derivatives ----------------------------------------------------------------------------------


def project(lens: Floats, points: Floats) -> tuple[Floats, Floats, Floats]:
    """Pixels (n, 2) of points before a lens, their derivatives by the lens (n, 2, 9) and by the point (n, 2, 3)."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = lens
    inverse = 1 / points[:, 2]
    x, y = points[:, 0] * inverse, points[:, 1] * inverse
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + r2 * 3 * k3)
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    n = len(points)
    by_lens = np.zeros((n, 2, 9))
    by_lens[:, 0, 0], by_lens[:, 1, 1] = xd, yd
    by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1
    for column, power in ((4, r2), (5, r2 * r2), (8, r2**3)):
        by_lens[:, 0, column], by_lens[:, 1, column] = fx * x * power, fy * y * power
    by_lens[:, 0, 6], by_lens[:, 1, 6] = fx * 2 * x * y, fy * (r2 + 2 * y * y)
    by_lens[:, 0, 7], by_lens[:, 1, 7] = fx * (r2 + 2 * x * x), fy * 2 * x * y
    across = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    xx = fx * (radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x)
    yy = fy * (radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x)
    xy, yx = fx * across, fy * across
    by_point = np.empty((n, 2, 3))
    by_point[:, 0, 0], by_point[:, 0, 1] = xx * inverse, xy * inverse
    by_point[:, 1, 0], by_point[:, 1, 1] = yx * inverse, yy * inverse
    by_point[:, 0, 2] = -(xx * x + xy * y) * inverse
    by_point[:, 1, 2] = -(yx * x + yy * y) * inverse
    return np.stack([fx * xd + cx, fy * yd + cy], axis=1), by_lens, by_point


def skew(v: Floats) -> Floats:
    """(n, 3, 3), of v x."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return np.asarray(out - np.swapaxes(out, -1, -2))


def rotation(w: Floats) -> Floats:
    """Rodrigues."""
    matrix: Floats = np.asarray(cv2.Rodrigues(np.asarray(w, dtype=np.float64).reshape(3, 1))[0], dtype=np.float64)
    return matrix


def rigid(turn: Floats, shift: Floats) -> Floats:
    """4x4."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = turn, shift
    return out


@dataclass(frozen=True, eq=False)
class _Rows:
    """Residuals and derivatives of both devices, (N, 2 devices, 2 coordinates, ...)."""

    residuals: Floats
    raw_projector: Floats
    by_globals: Floats
    by_pose: Floats

    def of(self, kept: NDArray[np.bool_]) -> _Rows:
        """Those of some features."""
        return _Rows(self.residuals[kept], self.raw_projector[kept], self.by_globals[kept], self.by_pose[kept])


def rows_of(model: Model, f: Features, derivatives: bool = True) -> _Rows | None:
    """All residuals, in pixels, with r_p freed of the corner's error; None where a point is behind a device."""
    turned = np.einsum("nab,nb->na", model.turns[f.view], f.board_mm)
    in_camera = turned + model.shifts[f.view]
    from_projector = in_camera - model.shift
    in_projector = from_projector @ model.turn
    if not (in_camera[:, 2].min() > 0 and in_projector[:, 2].min() > 0):
        return None
    seen_c, lens_c, point_c = project(model.camera, in_camera)
    seen_p, lens_p, point_p = project(model.projector, in_projector)
    n = len(in_camera)
    residuals = np.empty((n, 2, 2))
    residuals[:, 0] = seen_c - f.camera_px
    raw = seen_p - f.projector_px
    residuals[:, 1] = raw - np.einsum("nab,nb->na", f.slope, residuals[:, 0])
    if not np.isfinite(residuals[:, 0]).all():
        return None
    if not derivatives:
        return _Rows(residuals, raw, np.empty(0), np.empty(0))
    by_globals = np.zeros((n, 2, 2, 24))
    by_pose = np.zeros((n, 2, 2, 6))
    by_globals[:, 0, :, CAMERA] = lens_c
    by_pose[:, 0, :, :3] = -point_c @ skew(turned)
    by_pose[:, 0, :, 3:] = point_c
    # X_p = R^T (X_c - t); a turn exp(w) of R moves it by R^T [X_c - t]x w.
    by_camera_point = point_p @ model.turn.T
    by_globals[:, 1, :, PROJECTOR] = lens_p
    by_globals[:, 1, :, 18:21] = by_camera_point @ skew(from_projector)
    by_globals[:, 1, :, 21:24] = -by_camera_point
    by_pose[:, 1, :, :3] = -by_camera_point @ skew(turned)
    by_pose[:, 1, :, 3:] = by_camera_point
    by_globals[:, 1] -= f.slope @ by_globals[:, 0]
    by_pose[:, 1] -= f.slope @ by_pose[:, 0]
    return _Rows(residuals, raw, by_globals, by_pose)


# --- the start --------------------------------------------------------------------------------------------------------


def start(f: Features, camera_size: tuple[int, int], projector_size: tuple[int, int]) -> Model:
    """From OpenCV: each device by itself with one radial term, then the median of their relations.

    Raises:
        GeometryError: no view has features in both devices.
    """
    views = int(f.view.max()) + 1
    both = [i for i in range(views) if (f.seen & (f.view == i)).sum() >= 4]
    if not both:
        raise GeometryError("no view has four features with a phase: nothing ties the projector to the camera")
    camera, turns, shifts = _device(f, f.camera_px, list(range(views)), camera_size)
    projector, turns_p, shifts_p = _device(f, f.projector_px, both, projector_size)
    relations = [turns[i] @ turns_p[k].T for k, i in enumerate(both)]
    u, _, vt = np.linalg.svd(np.sum(relations, axis=0))
    turn = np.asarray(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt)
    shift = np.median([shifts[i] - turn @ shifts_p[k] for k, i in enumerate(both)], axis=0)
    return Model(camera, projector, turn, np.asarray(shift), turns, shifts)


def _device(f: Features, pixels: Floats, views: Sequence[int], size: tuple[int, int]) -> tuple[Floats, Floats, Floats]:
    """A device's own calibration: lens (9,), turns and shifts of its views."""
    good = np.isfinite(pixels).all(axis=1)
    picked = [good & (f.view == i) for i in views]
    objects = [f.board_mm[k].astype(np.float32) for k in picked]
    images = [pixels[k].astype(np.float32) for k in picked]
    width, height = size
    k1_alone = cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-9)
    middle = np.array([[2.0 * width, 0, (width - 1) / 2], [0, 2.0 * width, (height - 1) / 2], [0, 0, 1]])
    guess, fixed = cv2.CALIB_USE_INTRINSIC_GUESS, cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO
    everything = fixed | cv2.CALIB_FIX_FOCAL_LENGTH | cv2.CALIB_FIX_K1
    for flags in (k1_alone, k1_alone | guess, k1_alone | guess | fixed, k1_alone | guess | everything):
        try:
            _, k, d, turn, shift = cv2.calibrateCamera(
                objects, images, (width, height), middle.copy(), np.zeros(5), flags=flags, criteria=stop
            )
        except cv2.error:
            continue
        # A lens of less than 4 or more than 170 degrees, or one that looks away from its image, is no start.
        focal_fits = all(0.05 * width < value < 15 * width for value in (k[0, 0], k[1, 1]))
        if focal_fits and abs(k[0, 2] - width / 2) < 2 * width and abs(k[1, 2] - height / 2) < 2 * height:
            if abs(d.ravel()[0]) > 3:
                continue
            break
    else:
        raise GeometryError("OpenCV found no start: the views contradict each other")
    lens = np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], d.ravel()[0], 0, 0, 0, 0], dtype=np.float64)
    turns = np.array([cv2.Rodrigues(r)[0] for r in turn], dtype=np.float64)
    return lens, turns, np.array([s.ravel() for s in shift], dtype=np.float64)


def prior_sigmas(model: Model, camera_size: tuple[int, int], projector_size: tuple[int, int]) -> Floats:
    """The priors' widths: all of the focal length, the image's width, a tenth of it at its corner by distortion."""
    sigmas = np.empty(24)
    for part, lens, (width, height) in ((0, model.camera, camera_size), (9, model.projector, projector_size)):
        r = math.hypot(width, height) / 2 / lens[0]
        bend = 0.1 * width / lens[0]
        sigmas[part : part + 4] = lens[0], lens[1], width, width
        sigmas[part + 4 : part + 9] = bend / r**3, bend / r**5, bend / r**2, bend / r**2, bend / r**7
    sigmas[18:21] = math.pi
    sigmas[21:24] = 10 * np.linalg.norm(model.shift) + 1000
    return sigmas


# --- the adjustment ---------------------------------------------------------------------------------------------------


def solve(
    f: Features,
    first: Model,
    prior_sigma: Floats,
    *,
    k3: bool = False,
    scale_px: tuple[float, float] | None = None,
) -> Solution:
    """The joint adjustment.

    Args:
        f: the features of all views.
        first: where to start.
        prior_sigma: see `prior_sigmas`.
        k3: solve for both lenses' third radial term.
        scale_px: noise of camera and projector where they are known already; then Tukey's weights from the start.

    Raises:
        GeometryError: it does not converge.
    """
    free = np.array([i for i in range(24) if k3 or i not in K3])
    centre = first
    model = first
    seen = f.seen
    sigma = 1 / np.stack([np.ones(len(f.view)), f.relative_sigma], axis=1)
    rows = rows_of(model, f)
    if rows is None:
        raise GeometryError("the start puts a board behind the scanner")
    scales = scale_px or _scales(rows, sigma, seen)
    for robust in (_huber, _tukey, _tukey, _tukey) if scale_px is None else (_tukey, _tukey):
        before = scales
        model, rows = _minimise(f, model, rows, sigma / np.array(scales), robust, seen, free, centre, prior_sigma)
        scales = _scales(rows, sigma, seen)
        if robust is _tukey and all(abs(a / b - 1) < 1e-3 for a, b in zip(scales, before, strict=True)):
            break
    return _finish(f, model, rows, sigma, scales, seen, free, prior_sigma)


def _scales(rows: _Rows, inverse_sigma: Floats, seen: NDArray[np.bool_]) -> tuple[float, float]:
    lengths = np.linalg.norm(rows.residuals, axis=2) * inverse_sigma
    camera, projector = np.median(lengths[:, 0]), np.median(lengths[seen, 1]) if seen.any() else 1.0
    scales = [max(float(value) / MEDIAN_OF_RAYLEIGH, LEAST_SCALE_PX) for value in (camera, projector)]
    return scales[0], scales[1]


def _huber(s: Floats) -> tuple[Floats, Floats]:
    """Weight and cost."""
    far = s > HUBER
    bounded = np.maximum(s, HUBER)
    return np.where(far, HUBER / bounded, 1.0), np.where(far, HUBER * (s - HUBER / 2), s * s / 2)


def _tukey(s: Floats) -> tuple[Floats, Floats]:
    inside = np.maximum(1 - np.square(s / TUKEY), 0)
    return inside**2, TUKEY**2 / 6 * (1 - inside**3)


def _minimise(
    f: Features,
    model: Model,
    rows: _Rows,
    inverse_scale: Floats,
    robust: object,
    seen: NDArray[np.bool_],
    free: NDArray[np.intp],
    centre: Model,
    prior_sigma: Floats,
) -> tuple[Model, _Rows]:
    """Levenberg-Marquardt at fixed scales."""
    weigh = robust if callable(robust) else _huber

    def cost_of(model: Model, rows: _Rows) -> float:
        s = np.linalg.norm(rows.residuals, axis=2) * inverse_scale
        _, cost = weigh(s)
        off = _off(model, centre) / prior_sigma
        return float(cost[:, 0].sum() + cost[seen, 1].sum() + off @ off / 2)

    damping = 1e-6
    cost = cost_of(model, rows)
    for _ in range(MAX_ITERATIONS):
        s = np.linalg.norm(rows.residuals, axis=2) * inverse_scale
        weight, _ = weigh(s)
        weight = weight * inverse_scale**2
        weight[~seen, 1] = 0
        blocks = _blocks(f, rows, weight)
        off = _off(model, centre)
        while True:
            step, poses = _step(blocks, free, off, prior_sigma, damping)
            trial = model.moved(step, poses)
            trial_rows = rows_of(trial, f) if np.isfinite(step).all() and np.isfinite(poses).all() else None
            trial_cost = math.inf if trial_rows is None else cost_of(trial, trial_rows)
            if trial_cost <= cost * (1 + 1e-12):
                break
            damping = max(damping, 1e-9) * 10
            if damping > 1e9:
                return model, rows
        assert trial_rows is not None
        gained = cost - trial_cost
        model, rows, cost = trial, trial_rows, trial_cost
        damping = max(damping / 10, 1e-12)
        sizes = np.abs(step[free]) * np.sqrt(np.diag(blocks.reduced(free, prior_sigma)))
        if sizes.max() < STEP_TOLERANCE or gained <= 1e-12 * cost:
            break
    return model, rows


def _off(model: Model, centre: Model) -> Floats:
    """How far the lenses and the shift are from where they started; turns need no prior."""
    out = np.zeros(24)
    out[CAMERA], out[PROJECTOR] = model.camera - centre.camera, model.projector - centre.projector
    out[21:24] = model.shift - centre.shift
    return out


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Normal equations in blocks: of the 24, of each pose, and what joins them."""

    a: Floats
    b: Floats
    c: Floats
    gradient: Floats
    pose_gradient: Floats

    def reduced(self, free: NDArray[np.intp], prior_sigma: Floats) -> Floats:
        """Information on the free ones with the poses eliminated."""
        solved = np.linalg.solve(self.c, np.swapaxes(self.b, 1, 2))
        whole = self.a - np.einsum("vij,vjk->ik", self.b, solved) + np.diag(prior_sigma**-2.0)
        return np.asarray(whole[np.ix_(free, free)])


def _blocks(f: Features, rows: _Rows, weight: Floats) -> _Blocks:
    views = int(f.view.max()) + 1
    edges = np.searchsorted(f.view, np.arange(views + 1))
    a, gradient = np.zeros((24, 24)), np.zeros(24)
    b, c, pose_gradient = np.zeros((views, 24, 6)), np.zeros((views, 6, 6)), np.zeros((views, 6))
    root = np.sqrt(weight)[..., None]
    residuals = np.nan_to_num(rows.residuals) * root
    by_globals, by_pose = rows.by_globals * root[..., None], rows.by_pose * root[..., None]
    for v, (low, high) in enumerate(pairwise(edges)):
        g, p = by_globals[low:high].reshape(-1, 24), by_pose[low:high].reshape(-1, 6)
        r = residuals[low:high].reshape(-1)
        a += g.T @ g
        gradient += g.T @ r
        b[v], c[v], pose_gradient[v] = g.T @ p, p.T @ p, p.T @ r
    return _Blocks(a, b, c, gradient, pose_gradient)


def _step(
    blocks: _Blocks, free: NDArray[np.intp], off: Floats, prior_sigma: Floats, damping: float
) -> tuple[Floats, Floats]:
    """One damped step of the 24 and of the poses, scaled by the diagonal (Marquardt)."""
    a = blocks.a + np.diag(prior_sigma**-2.0)
    a = a + damping * np.diag(np.diag(a))
    diagonal = np.einsum("vii->vi", blocks.c)
    c = blocks.c + damping * diagonal[:, :, None] * np.eye(6)
    right = -(blocks.gradient + off * prior_sigma**-2.0)
    across = np.linalg.solve(c, np.swapaxes(blocks.b, 1, 2))
    pose_part = np.linalg.solve(c, -blocks.pose_gradient[..., None])[..., 0]
    reduced = a - np.einsum("vij,vjk->ik", blocks.b, across)
    right = right - np.einsum("vij,vj->i", blocks.b, pose_part)
    reduced, right = reduced[np.ix_(free, free)], right[free]
    scale = np.sqrt(np.abs(np.diag(reduced)))
    step = np.zeros(24)
    step[free] = np.linalg.solve(reduced / np.outer(scale, scale), right / scale) / scale
    return step, pose_part - np.einsum("vij,j->vi", across, step)


def _finish(
    f: Features,
    model: Model,
    rows: _Rows,
    inverse_sigma: Floats,
    scales: tuple[float, float],
    seen: NDArray[np.bool_],
    free: NDArray[np.intp],
    prior_sigma: Floats,
) -> Solution:
    """Covariance: the variance of each device from its residuals, its redundancy, and Tukey's loss of efficiency."""
    weight = np.zeros((len(f.view), 2))
    s = np.linalg.norm(rows.residuals, axis=2) * inverse_sigma / np.array(scales)
    inside = np.where(s < TUKEY, 1 - np.square(s / TUKEY), 0)
    inside[~seen, 1] = 0
    weight = inside**2
    effective = np.array(scales)
    sigmas = np.array(scales)
    for _ in range(3):
        whitened = inverse_sigma**2 / effective**2
        whitened[~seen, 1] = 0
        used = whitened * (weight > 0)
        blocks = _blocks(f, rows, used)
        information = blocks.reduced(free, prior_sigma)
        for device in (0, 1):
            own = used.copy()
            own[:, 1 - device] = 0
            taken = _trace(_blocks(f, rows, own), blocks, free, prior_sigma)
            kept = weight[:, device] > 0
            count = 2.0 * kept.sum()
            redundancy = max(count - taken, 0.1 * count)
            # psi = w s; its mean square over the square of its mean slope is what the estimate loses (Huber 7.6).
            w, t = weight[kept, device], s[kept, device]
            slope = w - 2 * np.sqrt(w) * np.square(t / TUKEY)
            mean_square = np.square(w * t).sum() / 2 / max(len(t), 1)
            ratio = mean_square / max(float(np.mean(slope)), 0.1) ** 2 if len(t) else 1.0
            effective[device] = scales[device] * math.sqrt(max(ratio, 0.0) * count / max(redundancy, 1e-9))
            effective[device] = max(effective[device], LEAST_SCALE_PX)
            spread = np.square(t).sum() / max(redundancy, 1e-9)
            sigmas[device] = scales[device] * math.sqrt(spread)
    covariance = np.zeros((24, 24))
    scale = np.sqrt(np.abs(np.diag(information)))
    inverse = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
    covariance[np.ix_(free, free)] = (inverse + inverse.T) / 2
    whole = np.zeros((24, 24))
    whole[np.ix_(free, free)] = information
    weighted = inverse_sigma**2 / effective**2 * weight
    weighted[~seen, 1] = 0
    return Solution(
        model,
        covariance,
        rows.residuals[:, 0],
        np.where(seen[:, None], rows.raw_projector, np.nan),
        weight > 0,
        (float(sigmas[0]), float(sigmas[1])),
        free,
        prior_sigma,
        whole,
        _without(f, rows, weighted, free, prior_sigma),
    )


def _without(f: Features, rows: _Rows, weight: Floats, free: NDArray[np.intp], prior_sigma: Floats) -> Floats:
    """One Newton step from the solution of all views to that of all but one, for each."""
    blocks = _blocks(f, rows, weight)
    whole = blocks.reduced(free, prior_sigma)
    views = len(blocks.c)
    moved = np.zeros((views, 24))
    for v in range(views):
        own = _blocks(f.of([v]), rows.of(f.view == v), weight[f.view == v])
        across = np.linalg.solve(own.c[0], np.column_stack([own.b[0].T, own.pose_gradient[0]]))
        reduced = (own.a - own.b[0] @ across[:, :24])[np.ix_(free, free)]
        gradient = (own.gradient - own.b[0] @ across[:, 24])[free]
        rest = whole - reduced
        scale = np.sqrt(np.maximum(np.diag(rest), 1e-300))
        moved[v, free] = np.linalg.lstsq(rest / np.outer(scale, scale), gradient / scale, rcond=1e-12)[0] / scale
    return moved


def _trace(own: _Blocks, whole: _Blocks, free: NDArray[np.intp], prior_sigma: Floats) -> float:
    """How many parameters one device's rows determine: tr(N_own N^-1), poses included."""
    # N^-1 in blocks: poses' part C^-1 + Y S^-1 Y^T with Y = C^-1 B^T.
    s = np.linalg.inv(whole.reduced(free, prior_sigma))
    y = np.linalg.solve(whole.c, np.swapaxes(whole.b, 1, 2))[:, :, free]
    c_inverse = np.linalg.inv(whole.c)
    total = float(np.sum(own.a[np.ix_(free, free)] * s))
    total += float(np.sum(own.c * (c_inverse + y @ s @ np.swapaxes(y, 1, 2))))
    total -= 2 * float(np.einsum("vfp,vpf->", own.b[:, free], y @ s))
    return total
