"""Camera, projector and every board pose in one robust least-squares adjustment, with its covariance.

Unknown are the two lenses (fx fy cx cy k1 k2 p1 p2 [k3] each), camera_from_projector and one pose per view. A feature
at X on the board is seen by the camera at x = pi_c(X_c) and has the projector's coordinates w = pi_p(X_p). The
projector does not look: its coordinate is the phase field at the place where the camera saw the feature, so an error of
that place is in both. With G = dw/dx, the slope of the phase field, the two independent residuals are

    r_c = pi_c(X_c) - x          r_p = pi_p(X_p) - w - G r_c

(the phase at the modelled place of the feature). Where features were given without a slope, G = 0. Minimised is

    sum rho(|r_c| / s_c) + sum rho(|r_p| / s_p),     Tukey's rho with c = 5.12, started with Huber's,

by Levenberg-Marquardt with analytic Jacobians. A feature in a view touches the lenses, that view's pose and its own
place on the board, so the normal equations are summed view by view and feature by feature, and the poses (with the
board's shape: the features) are eliminated block by block (Schur complement). The scales s_c and s_p come from the
median residual. The covariance is that of the M-estimate (P. Huber, Robust Statistics (1981), 7.6) with each device's
variance from its own redundancy (K.-R. Koch, Parameter Estimation (1999), 3.6).

A printed board is neither flat nor as drawn. Where the residuals show it (`repeats`), the board's own shape is solved
for as well: a bow, a stretch and a shear of the whole board with wide priors, for lenses and poses take up most of them
and a narrow prior would leave the rest to them; and three coordinates per feature with a normal prior about that, whose
widths in and out of the plane come from the data (variance components, the same source).

Every parameter has a prior so wide that it counts only where the views say nothing at all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import Lens, Scanner
from weldscan.errors import GeometryError
from weldscan.geometry import rigid, rotation_of

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
# Of the whole board: three bows out of its plane, a stretch and a shear within it; and how large they may be, mm at the
# rim. The overall scale is not among them: nothing tells it but the drawing.
BOWS, BENDS = 3, 5
BEND_MM = 1.0

# Tukey's and Huber's constants for residuals of two coordinates: 95 % efficiency with normal noise.
TUKEY, HUBER = 5.12, 1.5
# The median length of a two-dimensional normal residual, in sigmas.
MEDIAN_OF_RAYLEIGH = math.sqrt(2 * math.log(2))
MAX_ITERATIONS = 60
# Leaving one out of fewer views leaves nothing to compare with.
LEAST_VIEWS = 3
# A step is over when no lens parameter moves by more than this part of its own uncertainty.
STEP_TOLERANCE = 1e-4
# The scales have settled when they change by no more than this part.
SETTLED_SCALE = 1e-3
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

    @cached_property
    def bends(self) -> tuple[Floats, Floats]:
        """What BENDS move a feature by, (N, 3) out of the plane and (N, 2, 2) within it, mm for one mm at the rim."""
        low, high = self.board_mm.min(axis=0), self.board_mm.max(axis=0)
        x, y = ((self.board_mm - (low + high) / 2) / (math.dist(low, high) / 2))[:, :2].T
        return np.stack([x * x, x * y, y * y], axis=1), np.stack([np.stack([x, -y]), np.stack([y, x])]).transpose(
            2, 0, 1
        )

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which have a projector coordinate."""
        return np.asarray(np.isfinite(self.projector_px).all(axis=1))


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
    """(P, 3), mm: by how much each of the board's features is off the drawing, besides the bends."""
    bends: Floats = field(default_factory=lambda: np.zeros(BENDS))
    """(5,), mm at the rim: bow along x, across, along y; stretch along x and as much less along y; shear."""

    def moved(self, step: Floats, pose_steps: Floats) -> BundleModel:
        """The model after a step of PARAMETERS and of the poses, (views, 6)."""
        return BundleModel(
            self.camera + step[CAMERA],
            self.projector + step[PROJECTOR],
            rotation_of(step[18:21]) @ self.turn,
            self.shift + step[21:24],
            np.array([rotation_of(d[:3]) @ r for d, r in zip(pose_steps, self.turns, strict=True)]).reshape(-1, 3, 3),
            self.shifts + pose_steps[:, 3:],
            self.shape,
            self.bends,
        )

    @classmethod
    def of(cls, scanner: Scanner, turns: Floats | None = None, shifts: Floats | None = None, features: int = 0) -> Self:
        """A scanner's numbers, with the poses of a flat board of so many features."""

        def numbers(lens: Lens) -> Floats:
            k, dist = lens.K, [*lens.dist, 0.0][:5]
            return np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *dist])

        relation = scanner.camera_from_projector
        return cls(
            numbers(scanner.camera),
            numbers(scanner.projector),
            relation[:3, :3],
            relation[:3, 3],
            np.empty((0, 3, 3)) if turns is None else turns,
            np.empty((0, 3)) if shifts is None else shifts,
            np.zeros((features, 3)),
        )

    def scanner(self, camera_size: tuple[int, int], projector_size: tuple[int, int]) -> Scanner:
        """The core's scanner of these numbers; sizes are width, height."""
        camera, projector = (
            Lens(*size, [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dist)
            for size, (fx, fy, cx, cy, *dist) in ((camera_size, self.camera), (projector_size, self.projector))
        )
        return Scanner(camera, projector, self.camera_from_projector)

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

    def scaled(self, ratio: float) -> Solution:
        """With every uncertainty so many times as large."""
        sigma = self.sigma_px[0] * ratio, self.sigma_px[1] * ratio
        return replace(
            self, covariance=self.covariance * ratio**2, information=self.information / ratio**2, sigma_px=sigma
        )


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


# Where the columns of `_Rows.design` stand: lenses and relation, the pose, the residual; with the board's shape the
# bends and the place on the board.
LENSES, POSE, RESIDUAL, BEND, PLACE = slice(0, 24), slice(24, 30), 30, slice(31, 31 + BENDS), slice(36, 39)


@dataclass(frozen=True, eq=False)
class _Rows:
    """Residuals and derivatives of both devices, (N, 2 devices, 2 coordinates, ...)."""

    residuals: Floats
    """NaN where there is no phase."""
    raw_projector: Floats
    design: Floats
    """... by what LENSES, POSE, BEND and PLACE say, and the residual again; 0 where there is no phase."""

    @property
    def by_lenses(self) -> Floats:
        """... by the 24 PARAMETERS."""
        return self.design[..., LENSES]

    @property
    def by_pose(self) -> Floats:
        """... by the 6 of the view's pose."""
        return self.design[..., POSE]

    @property
    def by_point(self) -> Floats:
        """... by the 3 of the feature's place on the board."""
        return self.design[..., PLACE]


def rows_of(model: BundleModel, f: Features, *, shape: bool = True) -> _Rows | None:
    """All residuals, in pixels, with r_p freed of the corner's error; None where a point is behind a device."""
    turns = model.turns[f.view]
    out_of_plane, in_plane = f.bends
    places = f.board_mm + model.shape[f.number]
    places[:, :2] += np.einsum("nmc,m->nc", in_plane, model.bends[BOWS:])
    places[:, 2] += out_of_plane @ model.bends[:BOWS]
    turned = np.einsum("nab,nb->na", turns, places)
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
    # X_p = R^T (X_c - t); a turn exp(w) of R moves it by R^T [X_c - t]x w.
    by_camera_point = (point_p.reshape(-1, 3) @ model.turn.T).reshape(n, 2, 3)
    design = np.zeros((n, 2, 2, PLACE.stop if shape else BEND.start))
    design[:, 0, :, CAMERA] = lens_c
    design[:, 1, :, PROJECTOR] = lens_p
    design[:, 1, :, 18:21] = _cross(by_camera_point, from_projector)
    design[:, 1, :, 21:24] = -by_camera_point
    for device, by_place in enumerate((point_c, by_camera_point)):
        design[:, device, :, 24:27] = -_cross(by_place, turned)
        design[:, device, :, 27:30] = by_place
        if shape:
            by_point = np.einsum("nia,nab->nib", by_place, turns)
            design[:, device, :, BEND.start : BEND.start + BOWS] = by_point[..., 2:] * out_of_plane[:, None]
            within = np.einsum("nic,nmc->nim", by_point[..., :2], in_plane)
            design[:, device, :, BEND.start + BOWS : BEND.stop] = within
            design[:, device, :, PLACE] = by_point
    if f.slope.any():
        design[:, 1] -= f.slope @ design[:, 0]
    design[..., RESIDUAL] = np.nan_to_num(residuals)
    return _Rows(residuals, raw, design)


def _cross(rows: Floats, v: Floats) -> Floats:
    """All rows [v]x of (n, 2, 3) and (n, 3): every row's cross product with v."""
    (a, b, c), (x, y, z) = np.moveaxis(rows, 2, 0), v.T[..., None]
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=2)


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
    picked = [_some(np.flatnonzero(good & (f.view == i))) for i in views]
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


# So many features of a view are enough for a start.
START_FEATURES = 40


def _some(features: NDArray[np.intp]) -> NDArray[np.intp]:
    """Features from all over the board: any regular choice may lie on one line."""
    if len(features) <= START_FEATURES:
        return features
    return np.random.default_rng(0).permutation(features)[:START_FEATURES]


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

    @cached_property
    def common(self) -> NDArray[np.intp]:
        """The columns of what all views share: the free ones of PARAMETERS, and the bends with the board's shape."""
        bends = np.arange(BEND.start, BEND.stop if self.board_sigma is not None else BEND.start)
        return np.concatenate([self.free, bends])

    @cached_property
    def common_sigma(self) -> Floats:
        """Widths of their priors."""
        return np.concatenate([self.prior[self.free], np.full(len(self.common) - len(self.free), BEND_MM)])

    def off(self, model: BundleModel) -> tuple[Floats, Floats]:
        """What the priors pull at, in their widths: what views share, but for turns; and places on the board, mm."""
        out = np.zeros(BEND.stop)
        out[CAMERA], out[PROJECTOR] = model.camera - self.centre.camera, model.projector - self.centre.projector
        out[21:24], out[BEND] = model.shift - self.centre.shift, model.bends
        return out[self.common] / self.common_sigma, model.shape

    def prior_cost(self, model: BundleModel) -> float:
        common, board = self.off(model)
        cost = float(np.square(common).sum()) / 2
        return cost if self.board_sigma is None else cost + float(np.square(board / self.board_sigma).sum()) / 2

    def moved(self, model: BundleModel, core: Floats, blocks: Floats) -> BundleModel:
        """The model after a step of the core's unknowns and of the blocks'."""
        step, few = np.zeros(BEND.stop), len(self.common)
        step[self.common] = core[:few]
        if self.board_sigma is None:
            return model.moved(step[LENSES], blocks)
        moved = model.moved(step[LENSES], core[few:].reshape(-1, 6))
        return replace(moved, shape=model.shape + blocks, bends=model.bends + step[BEND])


def _problem(
    f: Features,
    about: BundleModel,
    prior_sigma: Floats,
    free: NDArray[np.intp],
    board_sigma_mm: tuple[float, float] | None,
) -> _Problem:
    """With the board's drawing for the middle of its prior."""
    board = None if board_sigma_mm is None else np.array([board_sigma_mm[0], board_sigma_mm[0], board_sigma_mm[1]])
    inverse_sigma = 1 / np.stack([np.ones(len(f.view)), f.relative_sigma], axis=1)
    return _Problem(f, about, prior_sigma, free, board, inverse_sigma)


# OpenBLAS shares a product out among threads from here on, in multiplications. Waking a thread takes longer than ours.
ONE_THREAD = 250_000


def _product(left: Floats, right: Floats) -> Floats:
    """left^T right of (n, i) and (n, j), in pieces so small that BLAS does each in the thread that asks for it."""
    i, j = left.shape[1], right.shape[1]
    piece = max(1, ONE_THREAD // (i * j))
    whole = len(left) // piece * piece
    out: Floats = left[whole:].T @ right[whole:]
    if whole:
        pieces = left[:whole].reshape(-1, piece, i).swapaxes(1, 2) @ right[:whole].reshape(-1, piece, j)
        out += pieces.sum(axis=0)
    return np.asarray(out)


def _in_strips(left: Floats, right: Floats) -> Floats:
    """The product of (i, n) and (n, j), strip by strip of the left one's rows, for the same reason."""
    strip = max(1, ONE_THREAD // right.size)
    return np.concatenate([left[k : k + strip] @ right for k in range(0, len(left), strip)])


@dataclass(frozen=True, eq=False)
class _Sums:
    """Products of weighted rows, as far as they can be summed before it is known which views count."""

    of_view: Floats
    """(views, 31, 31) or (views, 36, 36), of LENSES, POSE, RESIDUAL, and BEND with the board's shape."""
    of_place: Floats
    """(features, views, 3, 39), of a feature's place with everything; none where the board is taken as drawn."""


def _sums(p: _Problem, rows: _Rows, weight: Floats) -> _Sums:
    weighted = (rows.design * np.sqrt(weight)[..., None, None]).reshape(len(weight), 4, -1)
    edges = np.searchsorted(p.f.view, np.arange(p.views + 1))
    plain = weighted[..., : BEND.start if p.board_sigma is None else BEND.stop]
    views = (plain[low:high].reshape(-1, plain.shape[2]) for low, high in pairwise(edges))
    of_view = np.array([_product(each, each) for each in views])
    of_place = np.zeros((0 if p.board_sigma is None else len(p.centre.shape), p.views, 3, PLACE.stop))
    if p.board_sigma is not None:
        at, products = (p.f.number, p.f.view), np.swapaxes(weighted[..., PLACE], 1, 2) @ weighted
        if len(np.unique(p.f.number * p.views + p.f.view)) == len(products):
            of_place[at] = products
        else:
            # A view listed a feature twice.
            np.add.at(of_place, at, products)
    return _Sums(of_view, of_place)


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal equations: of the core, of each block, and what joins them."""

    a: Floats
    b: Floats
    """(blocks, own, core)"""
    c: Floats
    gradient: Floats
    block_gradient: Floats

    def reduced(self) -> Floats:
        """Information on the core with the blocks eliminated."""
        across: Floats = np.asarray(np.linalg.solve(self.c, self.b))
        return np.asarray(self.a - _across(self.b, across))

    def plus(self, other: _Normal, share: float, other_share: float) -> _Normal:
        """The sum with another one's, each times its share."""
        return _Normal(
            share * self.a + other_share * other.a,
            share * self.b + other_share * other.b,
            share * self.c + other_share * other.c,
            share * self.gradient + other_share * other.gradient,
            share * self.block_gradient + other_share * other.block_gradient,
        )

    def with_priors(self, p: _Problem, model: BundleModel) -> _Normal:
        """With what the priors add."""
        a, gradient, few = self.a.copy(), self.gradient.copy(), np.arange(len(p.common))
        common, board = p.off(model)
        a[few, few] += p.common_sigma**-2.0
        gradient[few] += common / p.common_sigma
        if p.board_sigma is None:
            return _Normal(a, self.b, self.c, gradient, self.block_gradient)
        c = self.c + np.diag(p.board_sigma**-2.0)
        return _Normal(a, self.b, c, gradient, self.block_gradient + board * p.board_sigma**-2.0)


def _across(b: Floats, y: Floats) -> Floats:
    """Sum over blocks of B^T Y."""
    return _product(b.reshape(-1, b.shape[2]), y.reshape(-1, y.shape[2]))


def _normal(p: _Problem, sums: _Sums, without: int | None = None) -> _Normal:
    """Normal equations of the free unknowns from what the data say, of all views or of all but one."""
    views = [v for v in range(p.views) if v != without]
    of_view, common, few = sums.of_view[views], p.common, len(p.common)
    of_all = of_view.sum(axis=0)
    a, gradient = of_all[np.ix_(common, common)], of_all[common, RESIDUAL]
    with_pose = of_view[:, POSE][:, :, common]
    own, own_gradient = of_view[:, POSE, POSE], of_view[:, POSE, RESIDUAL]
    if p.board_sigma is None:
        return _Normal(a, with_pose, own, gradient, own_gradient)
    size = few + 6 * len(views)
    core = np.zeros((size, size))
    core[:few, :few] = a
    core[few:, :few] = with_pose.reshape(-1, few)
    core[:few, few:] = core[few:, :few].T
    for k, block in enumerate(own):
        at = slice(few + 6 * k, few + 6 * k + 6)
        core[at, at] = block
    of_place = sums.of_place[:, views]
    summed, with_poses = of_place.sum(axis=1), of_place[..., POSE].swapaxes(1, 2)
    b = np.concatenate([summed[..., common], with_poses.reshape(len(summed), 3, -1)], axis=2)
    gradient = np.concatenate([gradient, own_gradient.ravel()])
    return _Normal(core, b, summed[..., PLACE], gradient, summed[..., RESIDUAL])


def _step(n: _Normal, damping: float) -> tuple[Floats, Floats, float]:
    """One damped step of core and blocks, scaled by the diagonal (Marquardt); and how large it is, in sigmas."""
    c = n.c + damping * np.einsum("vii->vi", n.c)[:, :, None] * np.eye(n.c.shape[1])
    across = np.linalg.solve(c, np.concatenate([n.b, -n.block_gradient[..., None]], axis=2))
    eliminated = _across(n.b, across)
    reduced = n.a + damping * np.diag(np.diag(n.a)) - eliminated[:, :-1]
    right = -n.gradient - eliminated[:, -1]
    scale = np.sqrt(np.maximum(np.abs(np.diag(reduced)), 1e-300))
    found = np.linalg.solve(reduced / np.outer(scale, scale), right / scale) / scale
    return found, across[..., -1] - across[..., :-1] @ found, float(np.abs(found * scale).max())


def solve(f: Features, first: BundleModel, prior_sigma: Floats, *, k3: bool = False, rough: bool = False) -> Solution:
    """The joint adjustment, with the board as drawn.

    Args:
        f: the features of all views.
        first: where to start: `start`, or what a rough solution made of it.
        prior_sigma: see `prior_sigmas`.
        k3: solve for both lenses' third radial term.
        rough: from `start`, with Huber's loss; else from there on, with Tukey's. A rough solution is enough to ask
            `repeats`; it does not say what leaving out a view would change.

    Raises:
        GeometryError: the start is no start.
    """
    p = _problem(f, first, prior_sigma, np.array([i for i in range(24) if k3 or i not in K3]), None)
    model, rows = first, _rows_at(first, p)
    scales = _scales(p, rows)
    for robust in (_huber,) if rough else (_tukey, _tukey, _tukey):
        before = scales
        model, rows = _minimise(p, model, rows, scales, robust)
        scales = _scales(p, rows)
        if np.abs(scales / before - 1).max() < SETTLED_SCALE:
            break
    return _finish(p, model, rows, _precision(p, model, rows, scales), rough)


def _rows_at(first: BundleModel, p: _Problem) -> _Rows:
    rows = rows_of(first, p.f, shape=p.board_sigma is not None)
    if rows is None:
        raise GeometryError("the start puts a board behind the scanner")
    return rows


def _scales(p: _Problem, rows: _Rows) -> Floats:
    """The noise of both devices' coordinates, px, by the median residual."""
    lengths, seen = np.linalg.norm(rows.residuals, axis=2) * p.inverse_sigma, p.f.seen
    medians = [float(np.median(lengths[:, 0])), float(np.median(lengths[seen, 1])) if seen.any() else 1.0]
    return np.maximum(np.array(medians) / MEDIAN_OF_RAYLEIGH, LEAST_SCALE_PX)


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

    # Far off there are bends on the way; the scaled unknowns hang together to some parts in a million.
    damping = 1e-6 if robust is _huber else 1e-9
    weight, cost = weigh(rows)
    cost += p.prior_cost(model)
    for _ in range(MAX_ITERATIONS):
        normal = _normal(p, _sums(p, rows, weight)).with_priors(p, model)
        while True:
            try:
                core, blocks, size = _step(normal, damping)
                finite = bool(np.isfinite(core).all() and np.isfinite(blocks).all())
            except np.linalg.LinAlgError:
                finite = False
            trial = p.moved(model, core, blocks) if finite else model
            trial_rows = rows_of(trial, p.f, shape=p.board_sigma is not None) if finite else None
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


@dataclass(frozen=True, eq=False)
class _Precision:
    """How well a solution is known."""

    kept: NDArray[np.bool_]
    """(N, 2): not rejected as an outlier."""
    weight: Floats
    """(N, 2): Tukey's, over the variance of a coordinate."""
    sigma_px: Floats
    """(2,): noise of either device's coordinates."""
    data: _Normal
    """Normal equations without priors; of the variance that the loss of efficiency makes of it."""
    normal: _Normal
    """With priors."""
    inverse: Floats
    """Of the core."""


def _precision(p: _Problem, model: BundleModel, rows: _Rows, scales: Floats) -> _Precision:
    """The variance of each device from its residuals, its redundancy, and Tukey's loss of efficiency."""
    seen = p.f.seen
    s = np.linalg.norm(np.nan_to_num(rows.residuals), axis=2) * p.inverse_sigma / scales
    root = np.where(s < TUKEY, 1 - np.square(s / TUKEY), 0)
    root[~seen, 1] = 0
    weight, kept = root**2, root > 0
    # Of each device alone, with its residuals in units of its noise.
    alone = [_normal(p, _sums(p, rows, p.inverse_sigma**2 * kept * device)) for device in np.eye(2)]
    effective, sigmas = scales.copy(), scales.copy()
    for _ in range(3):
        share = effective**-2.0
        data = alone[0].plus(alone[1], *share)
        normal = data.with_priors(p, model)
        inverse = inverse_of(normal.reduced())
        eliminated = _Eliminated.of(normal, inverse)
        for device in (0, 1):
            count = 2.0 * kept[:, device].sum()
            taken = share[device] * eliminated.trace(alone[device])
            redundancy = max(count - taken, 0.1 * count, 1.0)
            # psi = w s; its mean square over the square of its mean slope is what the estimate loses (Huber 7.6).
            w, t = weight[kept[:, device], device], s[kept[:, device], device]
            if not len(t):
                continue
            slope = max(float(np.mean(w - 2 * np.sqrt(w) * np.square(t / TUKEY))), 0.1)
            lost = float(np.square(w * t).sum()) / slope**2
            effective[device] = max(scales[device] * math.sqrt(lost / redundancy), LEAST_SCALE_PX)
            sigmas[device] = scales[device] * math.sqrt(float(np.square(t).sum()) / redundancy)
    return _Precision(kept, p.inverse_sigma**2 / effective**2 * weight, sigmas, data, normal, inverse)


def _finish(p: _Problem, model: BundleModel, rows: _Rows, known: _Precision, rough: bool = False) -> Solution:
    count = len(p.free)
    own = known.inverse[:count, :count]
    covariance, whole = np.zeros((24, 24)), np.zeros((24, 24))
    covariance[np.ix_(p.free, p.free)] = own
    whole[np.ix_(p.free, p.free)] = inverse_of(own)
    return Solution(
        model,
        covariance,
        rows.residuals[:, 0],
        np.where(p.f.seen[:, None], rows.raw_projector, np.nan),
        known.kept,
        (float(known.sigma_px[0]), float(known.sigma_px[1])),
        p.free,
        p.prior,
        whole,
        np.zeros((p.views, 24)) if rough else _without(p, model, _sums(p, rows, known.weight)),
        None if p.board_sigma is None else _off_drawing(p, model),
    )


def _off_drawing(p: _Problem, model: BundleModel) -> tuple[float, float]:
    """How far the board's features are off the drawing, one coordinate, rms, in its plane and out of it."""
    assert p.board_sigma is not None
    _, first = np.unique(p.f.number, return_index=True)
    out_of_plane, in_plane = (bends[first] for bends in p.f.bends)
    plane = np.column_stack([np.ones(len(first)), p.f.board_mm[first, :2]])
    bow = out_of_plane @ model.bends[:BOWS]
    bow = bow - plane @ np.linalg.lstsq(plane, bow, rcond=None)[0]
    within = np.einsum("nmc,m->nc", in_plane, model.bends[BOWS:])
    rms = [float(np.sqrt(np.square(off).mean())) for off in (within, bow)]
    return math.hypot(p.board_sigma[0], rms[0]), math.hypot(p.board_sigma[2], rms[1])


def inverse_of(information: Floats) -> Floats:
    """Of a positive definite matrix whose units differ."""
    scale = np.sqrt(np.maximum(np.abs(np.diag(information)), 1e-300))
    out = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.asarray((out + out.T) / 2)


@dataclass(frozen=True, eq=False)
class _Eliminated:
    """The inverse of normal equations N in blocks: S^-1 of the core, -Y S^-1 across, C^-1 + Y S^-1 Y^T of the blocks
    themselves, with Y = C^-1 B.
    """

    core: Floats
    across: Floats
    """(blocks, own, core), Y S^-1."""
    blocks: Floats
    """(blocks, own, own)"""

    @classmethod
    def of(cls, n: _Normal, inverse: Floats) -> _Eliminated:
        """Of normal equations and their core's inverse."""
        y = np.linalg.solve(n.c, n.b)
        across = y @ inverse
        return cls(inverse, across, np.linalg.inv(n.c) + across @ np.swapaxes(y, 1, 2))

    def trace(self, own: _Normal) -> float:
        """How many parameters a part of the rows determines: tr(N_own N^-1)."""
        blocks = float(np.sum(own.a * self.core)) + float(np.sum(own.c * self.blocks))
        return blocks - 2 * float(np.sum(own.b * self.across))


def _without(p: _Problem, model: BundleModel, sums: _Sums) -> Floats:
    """One Newton step from the solution of all views to that of all but one, for each."""
    out = np.zeros((p.views, 24))
    for view in range(p.views) if p.views > LEAST_VIEWS else ():
        found, _, _ = _step(_normal(p, sums, view).with_priors(p, model), 0.0)
        out[view, p.free] = found[: len(p.free)]
    return out


# --- the board's own shape --------------------------------------------------------------------------------------------

# A bow bends the lenses by many sigmas before its own residuals look odd, and to solve for it hardly costs anything:
# so the bends are taken as soon as they explain what five parameters should be worth (H. Akaike, IEEE TAC 19 (1974)
# 716). Of errors of single features chance says so once in some hundred times.
BENDS_CHI2 = 2.0 * BENDS
PLACES_Z = 3.0
# Where the estimate of the board's own error starts, mm; where it ends, for none at all; and when it has settled.
FIRST_MM, LEAST_MM, SETTLED = 0.03, 1e-5, 0.01
MOST_ROUNDS, MOST_STEPS = 8, 20


def repeats(f: Features, solved: Solution) -> bool:
    """Whether the residuals repeat from view to view as those of a board do that is not as drawn.

    Asked are the bends, and the variance of the features' places within the board's plane and out of it, by the slope
    of the likelihood (score tests; C. R. Rao, Linear Statistical Inference (1973), 6e). With g the gradient of the
    log-likelihood and F its covariance, the information with lenses and poses eliminated,

        chi2 = g^T F^-1 g    of the bends,        z = (g^T g - tr F) / sqrt(2 tr F^2)    of the places.

    What lenses and poses can take up of a bow is out of g and F alike, and what is left of it all counts.
    """
    rows = rows_of(solved.model, f)
    if rows is None:
        return False
    p = _problem(f, solved.model, solved.prior_sigma, solved.free, (1.0, 1.0))
    weight = p.inverse_sigma**2 / np.square(solved.sigma_px) * solved.used
    weight[~f.seen, 1] = 0
    normal = _normal(p, _sums(p, rows, weight))
    bends = np.arange(len(p.free), len(p.common))
    core = np.delete(np.arange(len(normal.a)), bends)
    inverse = inverse_of(normal.with_priors(p, solved.model).a[np.ix_(core, core)])
    across, gradient = normal.a[np.ix_(core, bends)], normal.gradient[bends]
    # The prior keeps out bends of which nothing is left once lenses and poses have taken their part.
    information = normal.a[np.ix_(bends, bends)] - across.T @ inverse @ across + np.eye(BENDS) / BEND_MM**2
    if gradient @ inverse_of(information) @ gradient > BENDS_CHI2:
        return True
    for axes in ([0, 1], [2]):
        count, own = len(normal.c), len(axes)
        b = normal.b[:, axes][..., core].reshape(count * own, -1)
        information = -_in_strips(_in_strips(b, inverse), b.T)
        each = np.arange(count)
        information.reshape(count, own, count, own)[each, :, each, :] += normal.c[:, axes][:, :, axes]
        gradient = normal.block_gradient[:, axes].ravel()
        expected, spread = np.trace(information), math.sqrt(2 * float(np.square(information).sum()))
        if gradient @ gradient > expected + PLACES_Z * spread:
            return True
    return False


def solve_with_board(f: Features, solved: Solution) -> Solution:
    """The adjustment with the board's shape, its prior's widths as the data have them.

    Args:
        f: the features of all views.
        solved: with the board as drawn; a rough one does.
    """
    p = _problem(f, solved.model, solved.prior_sigma, solved.free, (FIRST_MM, FIRST_MM))
    model, rows = solved.model, _rows_at(solved.model, p)
    scales = _scales(p, rows)
    for _ in range(MOST_ROUNDS):
        model, rows = _minimise(p, model, rows, scales, _tukey)
        before, scales = scales, _scales(p, rows)
        known = _precision(p, model, rows, scales)
        widths = _widths(p, model, known.data)
        settled = _settled(widths, p.board_sigma) and np.abs(scales / before - 1).max() < SETTLED_SCALE
        p = replace(p, board_sigma=widths)
        if settled:
            break
    return _finish(p, model, rows, known)


def _settled(now: Floats, before: Floats | None) -> bool:
    return before is not None and bool((np.abs(now - before) < SETTLED * before + LEAST_MM).all())


def _widths(p: _Problem, model: BundleModel, data: _Normal) -> Floats:
    """How far the board's features are off the drawing: (3,) mm, twice in its plane, and out of it.

    Variance components: of n coordinates with the prior's variance v, n tau are told by the views, the rest by the
    prior, and the sum of their squares is to be n tau v. Where all are told alike, their mean square, freed of the
    prior and of the noise, is the answer at once: m / tau^2 - v (1 - tau) / tau.

    Args:
        p: the problem that was solved.
        model: its solution.
        data: its normal equations there, without priors.
    """
    assert p.board_sigma is not None
    widths, count = p.board_sigma, len(model.shape)
    for _ in range(MOST_STEPS):
        whole = data.with_priors(replace(p, board_sigma=widths), model)
        _, moved, _ = _step(whole, 0.0)
        spread = np.einsum("vii->vi", _Eliminated.of(whole, inverse_of(whole.reduced())).blocks)
        squares = np.square(model.shape + moved)
        found = np.empty(3)
        for axes in ([0, 1], [2]):
            variance = float(widths[axes[0]] ** 2)
            told = max(1 - float(spread[:, axes].mean()) / variance, 1e-9)
            mean = float(squares[:, axes].sum()) / (count * len(axes))
            found[axes] = max(mean / told**2 - variance * (1 - told) / told, variance / 100)
        before, widths = widths, np.maximum(np.sqrt(found), LEAST_MM)
        if _settled(widths, before):
            break
    return np.asarray(widths)
