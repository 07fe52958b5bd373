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

A printed board is neither flat nor as drawn. Where the residuals of a feature repeat from view to view (`repeats`), the
board's own shape is solved for as well: three coordinates per feature with a normal prior about the drawing, whose
widths in and out of the plane come from the data (variance components, the same source).

Every parameter has a prior so wide that it counts only where the views say nothing at all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from weldscan.errors import GeometryError
from weldscan.geometry import rigid, rotation_of, skew

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
# Leaving one out of fewer views leaves nothing to compare with.
LEAST_VIEWS = 3
# A step is over when no lens parameter moves by more than this part of its own uncertainty.
STEP_TOLERANCE = 1e-4
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
    number: NDArray[np.intp]
    """(N,) which of the board's P features."""

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which have a projector coordinate."""
        return np.asarray(np.isfinite(self.projector_px).all(axis=1))

    def of(self, views: Sequence[int]) -> Features:
        """Those of some views, renumbered."""
        number = {view: i for i, view in enumerate(views)}
        kept = np.isin(self.view, list(views))
        return Features(
            np.array([number[v] for v in self.view[kept]], dtype=np.intp),
            self.board_mm[kept],
            self.camera_px[kept],
            self.projector_px[kept],
            self.slope[kept],
            self.relative_sigma[kept],
            self.number[kept],
        )


@dataclass(frozen=True, eq=False)
class BundleModel:
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
    shape: Floats
    """(P, 3), mm: by how much the board's features are off the drawing."""

    def moved(self, step: Floats, pose_steps: Floats) -> BundleModel:
        """The model after a step of PARAMETERS and of the poses, (views, 6)."""
        return BundleModel(
            self.camera + step[CAMERA],
            self.projector + step[PROJECTOR],
            rotation_of(step[18:21]) @ self.turn,
            self.shift + step[21:24],
            np.array([rotation_of(d[:3]) @ r for d, r in zip(pose_steps, self.turns, strict=True)]),
            self.shifts + pose_steps[:, 3:],
            self.shape,
        )

    def of(self, views: Sequence[int]) -> BundleModel:
        """The same with some of the poses."""
        return replace(self, turns=self.turns[list(views)], shifts=self.shifts[list(views)])

    @property
    def camera_from_projector(self) -> Floats:
        """4x4."""
        return rigid(self.turn, self.shift)


@dataclass(frozen=True, eq=False)
class Solution:
    """The adjusted model and how well it is known."""

    model: BundleModel
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
    board_sigma_mm: tuple[float, float] | None = None
    """How far the board's features are off the drawing, one coordinate in its plane and out of it; None: not asked."""


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


@dataclass(frozen=True, eq=False)
class _Rows:
    """Residuals and derivatives of both devices, (N, 2 devices, 2 coordinates, ...)."""

    residuals: Floats
    raw_projector: Floats
    by_lenses: Floats
    """... by the 24 PARAMETERS."""
    by_pose: Floats
    """... by the 6 of the view's pose."""
    by_point: Floats
    """... by the 3 of the feature's place on the board."""

    def of(self, kept: NDArray[np.bool_]) -> _Rows:
        """Those of some features."""
        return _Rows(
            self.residuals[kept],
            self.raw_projector[kept],
            self.by_lenses[kept],
            self.by_pose[kept],
            self.by_point[kept],
        )


def rows_of(model: BundleModel, f: Features) -> _Rows | None:
    """All residuals, in pixels, with r_p freed of the corner's error; None where a point is behind a device."""
    turns = model.turns[f.view]
    turned = np.einsum("nab,nb->na", turns, f.board_mm + model.shape[f.number])
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
    by_lenses, by_pose, by_point = np.zeros((n, 2, 2, 24)), np.zeros((n, 2, 2, 6)), np.empty((n, 2, 2, 3))
    by_lenses[:, 0, :, CAMERA] = lens_c
    by_pose[:, 0, :, :3] = -point_c @ skew(turned)
    by_pose[:, 0, :, 3:] = point_c
    # X_p = R^T (X_c - t); a turn exp(w) of R moves it by R^T [X_c - t]x w.
    by_camera_point = point_p @ model.turn.T
    by_lenses[:, 1, :, PROJECTOR] = lens_p
    by_lenses[:, 1, :, 18:21] = by_camera_point @ skew(from_projector)
    by_lenses[:, 1, :, 21:24] = -by_camera_point
    by_pose[:, 1, :, :3] = -by_camera_point @ skew(turned)
    by_pose[:, 1, :, 3:] = by_camera_point
    by_point[:, 0], by_point[:, 1] = point_c @ turns, by_camera_point @ turns
    for derivative in (by_lenses, by_pose, by_point):
        derivative[:, 1] -= f.slope @ derivative[:, 0]
    return _Rows(residuals, raw, by_lenses, by_pose, by_point)


# --- the start --------------------------------------------------------------------------------------------------------


def start(f: Features, camera_size: tuple[int, int], projector_size: tuple[int, int]) -> BundleModel:
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
    return BundleModel(
        camera, projector, turn, np.asarray(shift), turns, shifts, np.zeros((int(f.number.max()) + 1, 3))
    )


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


def prior_sigmas(model: BundleModel, camera_size: tuple[int, int], projector_size: tuple[int, int]) -> Floats:
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


@dataclass(frozen=True, eq=False)
class _Problem:
    """What stays the same while it is solved.

    The unknowns are a core, solved densely, and blocks that are eliminated from it: the poses from the lenses; with the
    board's shape the features' places from lenses and poses.
    """

    f: Features
    centre: BundleModel
    prior: Floats
    """(24,) sigmas of PARAMETERS."""
    free: NDArray[np.intp]
    """Which of PARAMETERS are solved for."""
    board_sigma: Floats | None
    """(3,) the prior of a feature's place on the board, where that is solved for."""
    inverse_sigma: Floats
    """(N, 2)"""

    @property
    def views(self) -> int:
        return len(self.centre.turns)

    @property
    def core(self) -> NDArray[np.intp]:
        """The free ones of the core's unknowns."""
        if self.board_sigma is None:
            return self.free
        return np.concatenate([self.free, np.arange(24, 24 + 6 * self.views)])

    def of(self, views: Sequence[int]) -> _Problem:
        """The same with some of the views."""
        kept = np.isin(self.f.view, list(views))
        return replace(self, f=self.f.of(views), centre=self.centre.of(views), inverse_sigma=self.inverse_sigma[kept])

    def off(self, model: BundleModel) -> tuple[Floats, Floats]:
        """What the priors pull at: PARAMETERS but for turns, and places on the board."""
        out = np.zeros(24)
        out[CAMERA], out[PROJECTOR] = model.camera - self.centre.camera, model.projector - self.centre.projector
        out[21:24] = model.shift - self.centre.shift
        return out, model.shape - self.centre.shape

    def prior_cost(self, model: BundleModel) -> float:
        lenses, board = self.off(model)
        cost = float(np.square(lenses / self.prior).sum()) / 2
        return cost if self.board_sigma is None else cost + float(np.square(board / self.board_sigma).sum()) / 2

    def moved(self, model: BundleModel, core: Floats, blocks: Floats) -> BundleModel:
        """The model after a step."""
        if self.board_sigma is None:
            return model.moved(core, blocks)
        return replace(model.moved(core[:24], core[24:].reshape(-1, 6)), shape=model.shape + blocks)


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal equations: of the core, of each block, and what joins them; priors included."""

    a: Floats
    b: Floats
    c: Floats
    gradient: Floats
    block_gradient: Floats

    def reduced(self) -> Floats:
        """Information on the core with the blocks eliminated."""
        across: Floats = np.asarray(np.linalg.solve(self.c, np.swapaxes(self.b, 1, 2)))
        return np.asarray(self.a - _summed(self.b, across))


def _summed(b: Floats, y: Floats) -> Floats:
    """Sum over blocks of B Y, as one product."""
    count, size, own = b.shape
    return np.asarray(np.moveaxis(b, 0, 1).reshape(size, count * own) @ y.reshape(count * own, -1))


def _normal(p: _Problem, model: BundleModel, rows: _Rows, weight: Floats, priors: bool = True) -> _Normal:
    """Weighted normal equations of the free unknowns."""
    root = np.sqrt(weight)[..., None]
    residuals = np.nan_to_num(rows.residuals) * root
    n = len(p.f.view)
    if p.board_sigma is None:
        core, block, group, count = rows.by_lenses, rows.by_pose, p.f.view, p.views
    else:
        poses = np.zeros((n, 2, 2, p.views, 6))
        poses[np.arange(n), :, :, p.f.view] = rows.by_pose
        core = np.concatenate([rows.by_lenses, poses.reshape(n, 2, 2, -1)], axis=3)
        block, group, count = rows.by_point, p.f.number, len(model.shape)
    core, block = core[..., p.core] * root[..., None], block * root[..., None]
    size, own = core.shape[-1], block.shape[-1]
    order = np.argsort(group, kind="stable")
    edges = np.searchsorted(group[order], np.arange(count + 1))
    core, block, residuals = core[order], block[order], residuals[order]
    flat, right = core.reshape(-1, size), residuals.reshape(-1)
    a, gradient = flat.T @ flat, flat.T @ right
    b, c, block_gradient = np.zeros((count, size, own)), np.zeros((count, own, own)), np.zeros((count, own))
    for k, (low, high) in enumerate(pairwise(edges)):
        g, h, r = core[low:high].reshape(-1, size), block[low:high].reshape(-1, own), residuals[low:high].reshape(-1)
        b[k], c[k], block_gradient[k] = g.T @ h, h.T @ h, h.T @ r
    if priors:
        lenses, board = p.off(model)
        few = len(p.free)
        a[np.arange(few), np.arange(few)] += p.prior[p.free] ** -2.0
        gradient[:few] += lenses[p.free] * p.prior[p.free] ** -2.0
        if p.board_sigma is not None:
            c += np.diag(p.board_sigma**-2.0)
            block_gradient += board * p.board_sigma**-2.0
    return _Normal(a, b, c, gradient, block_gradient)


def _step(p: _Problem, n: _Normal, damping: float) -> tuple[Floats, Floats, float]:
    """One damped step of core and blocks, scaled by the diagonal (Marquardt); and how large it is, in sigmas."""
    c = n.c + damping * np.einsum("vii->vi", n.c)[:, :, None] * np.eye(n.c.shape[1])
    across = np.linalg.solve(c, np.concatenate([np.swapaxes(n.b, 1, 2), -n.block_gradient[..., None]], axis=2))
    reduced = n.a + damping * np.diag(np.diag(n.a)) - _summed(n.b, across[..., :-1])
    right = -n.gradient - _summed(n.b, across[..., -1:])[:, 0]
    scale = np.sqrt(np.maximum(np.abs(np.diag(reduced)), 1e-300))
    found = np.linalg.solve(reduced / np.outer(scale, scale), right / scale) / scale
    size = 24 if p.board_sigma is None else 24 + 6 * p.views
    core = np.zeros(size)
    core[p.core] = found
    return core, across[..., -1] - across[..., :-1] @ found, float(np.abs(found * scale).max())


def solve(
    f: Features,
    first: BundleModel,
    prior_sigma: Floats,
    *,
    k3: bool = False,
    board_sigma_mm: tuple[float, float] | None = None,
) -> Solution:
    """The joint adjustment.

    Args:
        f: the features of all views.
        first: where to start.
        prior_sigma: see `prior_sigmas`.
        k3: solve for both lenses' third radial term.
        board_sigma_mm: solve for the board's shape too, with this prior in its plane and out of it.

    Raises:
        GeometryError: it does not converge.
    """
    board = None if board_sigma_mm is None else np.array([board_sigma_mm[0], board_sigma_mm[0], board_sigma_mm[1]])
    p = _Problem(
        f,
        replace(first, shape=np.zeros_like(first.shape)),
        prior_sigma,
        np.array([i for i in range(24) if k3 or i not in K3]),
        board,
        1 / np.stack([np.ones(len(f.view)), f.relative_sigma], axis=1),
    )
    model, rows = first, rows_of(first, f)
    if rows is None:
        raise GeometryError("the start puts a board behind the scanner")
    scales = _scales(p, rows)
    # Rounds about the board's shape start where the last one ended.
    for robust in (_huber, _tukey, _tukey, _tukey) if board is None else (_tukey, _tukey):
        before = scales
        model, rows = _minimise(p, model, rows, np.array(scales), robust)
        scales = _scales(p, rows)
        if robust is _tukey and all(abs(a / b - 1) < 1e-3 for a, b in zip(scales, before, strict=True)):
            break
    return _finish(p, model, rows, np.array(scales))


def _scales(p: _Problem, rows: _Rows) -> tuple[float, float]:
    lengths, seen = np.linalg.norm(rows.residuals, axis=2) * p.inverse_sigma, p.f.seen
    medians = np.median(lengths[:, 0]), np.median(lengths[seen, 1]) if seen.any() else 1.0
    camera, projector = (max(float(value) / MEDIAN_OF_RAYLEIGH, LEAST_SCALE_PX) for value in medians)
    return camera, projector


def _huber(s: Floats) -> tuple[Floats, Floats]:
    """Weight and cost."""
    far = s > HUBER
    bounded = np.maximum(s, HUBER)
    return np.where(far, HUBER / bounded, 1.0), np.where(far, HUBER * (s - HUBER / 2), s * s / 2)


def _tukey(s: Floats) -> tuple[Floats, Floats]:
    inside = np.maximum(1 - np.square(s / TUKEY), 0)
    return inside**2, TUKEY**2 / 6 * (1 - inside**3)


def _minimise(
    p: _Problem, model: BundleModel, rows: _Rows, scales: Floats, robust: Callable[[Floats], tuple[Floats, Floats]]
) -> tuple[BundleModel, _Rows]:
    """Levenberg-Marquardt at fixed scales."""
    inverse_scale, seen = p.inverse_sigma / scales, p.f.seen

    def weigh(rows: _Rows) -> tuple[Floats, float]:
        weight, cost = robust(np.linalg.norm(np.nan_to_num(rows.residuals), axis=2) * inverse_scale)
        weight = weight * inverse_scale**2
        weight[~seen, 1] = 0
        return weight, float(cost[:, 0].sum() + cost[seen, 1].sum())

    damping = 1e-6
    weight, cost = weigh(rows)
    cost += p.prior_cost(model)
    for _ in range(MAX_ITERATIONS):
        normal = _normal(p, model, rows, weight)
        while True:
            core, blocks, size = _step(p, normal, damping)
            finite = bool(np.isfinite(core).all() and np.isfinite(blocks).all())
            trial = p.moved(model, core, blocks) if finite else model
            trial_rows = rows_of(trial, p.f) if finite else None
            if trial_rows is not None:
                trial_weight, trial_cost = weigh(trial_rows)
                trial_cost += p.prior_cost(trial)
                if trial_cost <= cost * (1 + 1e-12) + 1e-12:
                    break
            damping = max(damping, 1e-9) * 10
            if damping > 1e9:
                return model, rows
        gained = cost - trial_cost
        model, rows, weight, cost = trial, trial_rows, trial_weight, trial_cost
        damping = max(damping / 10, 1e-12)
        if size < STEP_TOLERANCE or gained <= 1e-8 * cost:
            break
    return model, rows


def _finish(p: _Problem, model: BundleModel, rows: _Rows, scales: Floats) -> Solution:
    """Covariance: the variance of each device from its residuals, its redundancy, and Tukey's loss of efficiency."""
    seen = p.f.seen
    s = np.linalg.norm(np.nan_to_num(rows.residuals), axis=2) * p.inverse_sigma / scales
    root = np.where(s < TUKEY, 1 - np.square(s / TUKEY), 0)
    root[~seen, 1] = 0
    weight, kept = root**2, root > 0
    effective, sigmas = scales.copy(), scales.copy()
    for _ in range(3):
        used = p.inverse_sigma**2 / effective**2 * kept
        normal = _normal(p, model, rows, used)
        inverse = _inverse(normal.reduced())
        for device in (0, 1):
            own = used.copy()
            own[:, 1 - device] = 0
            count = 2.0 * kept[:, device].sum()
            taken = _trace(_normal(p, model, rows, own, priors=False), normal, inverse)
            redundancy = max(count - taken, 0.1 * count, 1.0)
            # psi = w s; its mean square over the square of its mean slope is what the estimate loses (Huber 7.6).
            w, t = weight[kept[:, device], device], s[kept[:, device], device]
            if not len(t):
                continue
            slope = max(float(np.mean(w - 2 * np.sqrt(w) * np.square(t / TUKEY))), 0.1)
            lost = float(np.square(w * t).sum()) / slope**2
            effective[device] = max(scales[device] * math.sqrt(lost / redundancy), LEAST_SCALE_PX)
            sigmas[device] = scales[device] * math.sqrt(float(np.square(t).sum()) / redundancy)
    count = len(p.free)
    own = inverse[:count, :count]
    covariance, whole = np.zeros((24, 24)), np.zeros((24, 24))
    covariance[np.ix_(p.free, p.free)] = own
    whole[np.ix_(p.free, p.free)] = _inverse(own)
    board = None
    if p.board_sigma is not None:
        # Of the board's coordinates so many are told by the views, the rest by the prior.
        y = np.linalg.solve(normal.c, np.swapaxes(normal.b, 1, 2))
        spread = np.einsum("vii->vi", np.linalg.inv(normal.c) + y @ inverse @ np.swapaxes(y, 1, 2))
        told = np.maximum((1 - spread / p.board_sigma**2).sum(axis=0), 1e-6)
        squares = np.square(model.shape).sum(axis=0)
        board = math.sqrt(squares[:2].sum() / told[:2].sum()), math.sqrt(squares[2] / told[2])
    weighted = p.inverse_sigma**2 / effective**2 * weight
    return Solution(
        model,
        covariance,
        rows.residuals[:, 0],
        np.where(seen[:, None], rows.raw_projector, np.nan),
        kept,
        (float(sigmas[0]), float(sigmas[1])),
        p.free,
        p.prior,
        whole,
        _without(p, model, rows, weighted),
        board,
    )


def _inverse(information: Floats) -> Floats:
    """Of a positive definite matrix whose units differ."""
    scale = np.sqrt(np.maximum(np.abs(np.diag(information)), 1e-300))
    out = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.asarray((out + out.T) / 2)


def _trace(own: _Normal, whole: _Normal, inverse: Floats) -> float:
    """How many parameters one device's rows determine: tr(N_own N^-1)."""
    # N^-1 in blocks: C^-1 + Y S^-1 Y^T for the eliminated ones, -Y S^-1 across, with Y = C^-1 B^T.
    y = np.linalg.solve(whole.c, np.swapaxes(whole.b, 1, 2))
    ys = y @ inverse
    total = float(np.sum(own.a * inverse))
    total += float(np.sum(own.c * (np.linalg.inv(whole.c) + ys @ np.swapaxes(y, 1, 2))))
    return total - 2 * float(np.sum(np.swapaxes(own.b, 1, 2) * ys))


def _without(p: _Problem, model: BundleModel, rows: _Rows, weight: Floats) -> Floats:
    """One Newton step from the solution of all views to that of all but one, for each."""
    out = np.zeros((p.views, 24))
    for view in range(p.views) if p.views > LEAST_VIEWS else ():
        rest = [v for v in range(p.views) if v != view]
        kept = p.f.view != view
        fewer = p.of(rest)
        normal = _normal(fewer, model.of(rest), rows.of(kept), weight[kept])
        out[view] = _step(fewer, normal, 0.0)[0][:24]
    return out


# --- the board's own shape --------------------------------------------------------------------------------------------

# As throughout: five sigmas, so that chance says so once in two million times.
Z = 5.0
# Where the estimate of the board's own error starts, mm, and when it has settled.
FIRST_MM, SETTLED = 0.03, 0.03
MOST_ROUNDS = 10


def repeats(f: Features, solved: Solution) -> bool:
    """Whether the camera's residuals of a feature repeat from view to view: then the board is not as drawn.

    The variance of the features' mean residuals, in the board's plane, against that within features (Fisher's F).
    """
    rows = rows_of(solved.model, f)
    if rows is None:
        return False
    scale = rows.by_point[:, 0, :, :2]
    used = solved.used[:, 0] & (np.abs(np.linalg.det(scale)) > 1e-9)
    off = np.linalg.solve(scale[used], rows.residuals[used, 0][..., None])[..., 0]
    number = f.number[used]
    count = np.bincount(number, minlength=len(solved.model.shape)).astype(float)
    sums = np.column_stack([np.bincount(number, off[:, i], minlength=len(count)) for i in (0, 1)])
    means = sums / np.maximum(count, 1)[:, None]
    several = count >= 2
    between = 2.0 * several.sum()
    within = 2.0 * float((count[several] - 1).sum())
    if not (several.any() and within > 0):
        return False
    kept = several[number]
    noise = float(np.square(off[kept] - means[number[kept]]).sum()) / within
    repeated = float((count[several, None] * np.square(means[several])).sum()) / between
    return bool(repeated > noise * (1 + Z * math.sqrt(2 / between + 2 / within)))


def solve_with_board(f: Features, solved: Solution, *, k3: bool = False) -> Solution:
    """The adjustment with the board's shape, its prior's widths as the data have them."""
    widths = FIRST_MM, FIRST_MM
    for _ in range(MOST_ROUNDS):
        before = widths
        solved = solve(f, solved.model, solved.prior_sigma, k3=k3, board_sigma_mm=before)
        assert solved.board_sigma_mm is not None
        widths = max(solved.board_sigma_mm[0], 1e-5), max(solved.board_sigma_mm[1], 1e-5)
        if all(abs(new / old - 1) < SETTLED for new, old in zip(widths, before, strict=True)):
            break
    return solved
