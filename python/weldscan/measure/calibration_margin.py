"""What a scanner's calibration leaves unknown of the step, where U does not hold it.

A small error of the scanner's parameters c bends the space that it measures: a point p moves by dp/dc, the radial
deviation of a wall's point by D = n . dp/dc. What both walls share cancels in the step; what bends them apart does not.
With X the walls' model of `weld/step/` (a correction of each shot's reference cylinder, h, the walls' shrinkage), V the
covariance of their unevenness, and x the row of h at the seam, the step's error is to first order

    g dc,    g = x (X^T V^-1 X)^-1 X^T V^-1 D,    u^2 = g C g^T.

C is the scanner's covariance where its file has one, and else that of a *usual good calibration* of such a scanner
(`nominal_covariance`): inverse of the information that its poses of a board hold, the poses eliminated. The calibration
that was really made may be worse; of one that nobody stated no better is supposed. The surfaces' step holds a stated
one in its U (`calibration_unknowns`); the paper's histogram does not.

Sources: GUM (JCGM 100:2008) 5.1 and its supplement 2 (JCGM 102:2011) 6.2 for the propagation; K.-R. Koch, Parameter
Estimation (1999), 3.4 for the information of an adjustment.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import Scanner, whitened
from weldscan.calibration.bundle import K3, PARAMETERS, BundleModel, Features, prior_sigmas, rows_of
from weldscan.calibration.volume import point_jacobian
from weldscan.geometry import rotation_of
from weldscan.measure.part_views import PartView, wall_sample
from weldscan.records.scanner import ScannerSpec
from weldscan.result import Finding, Label, bar

Floats = NDArray[np.float64]

# A usual good calibration: what docs/calibration.md asks for, boards that fill the field, near and far and tilted to
# all sides; corners found to a tenth of a pixel, in the camera and, through the phase, in the projector.
TILTS_DEG = ((0.0, 0.0), (30.0, 0.0), (-30.0, 0.0), (0.0, 30.0), (0.0, -30.0))
"""About the image's x and y."""
DEPTHS = (0.9, 1.0, 1.1)
"""In working distances."""
CORNERS = (13, 9)
"""Of the board, along the longer and the shorter side of the field."""
NOISE_PX = 0.1
NOMINAL = (
    f"{len(TILTS_DEG) * len(DEPTHS)} poses of a board that fills the field at the working distance, tilted by up to "
    f"30°, near and far, with {NOISE_PX} px of noise"
)
# Axes that meet nearer or further than this many of the part's distances are nearly parallel: where they meet is then
# no place that anybody works at.
MEETING = 2.0
DEPTH_STRIDE = 8
# A wall of fewer is none.
LEAST_POINTS = 30
# Of the unevenness's variance: keeps its covariance positive definite in floating point.
LEAST_NUGGET = 1e-6
# Of an information matrix with ones on its diagonal.
LEAST_EIGENVALUE = 1e-13
# A board of which less is seen is not found.
LEAST_CORNERS = 12


# Amplitude of a weld's shrinkage, one sigma: the core's prior of it.
SHRINKAGE_MM = 0.25


@dataclass(frozen=True)
class Unevenness:
    """What the walls' fit left, as `measure_step` found it: it sets how the fit weighs near and far points."""

    rms_mm: float
    around_mm: float
    """Where its correlation ends, around and along the axis."""
    along_mm: float

    def correlation(self, noise_mm2: float) -> tuple[tuple[float, float], float]:
        """Supports around and along, mm, and the nugget that noise of this variance adds, in units of the variance."""
        support = max(self.around_mm, 1e-9), max(self.along_mm, 1e-9)
        return support, noise_mm2 / max(self.rms_mm, 1e-9) ** 2 + LEAST_NUGGET


@dataclass(frozen=True, eq=False)
class CalibrationMargin:
    """What the calibration leaves unknown of the step."""

    u_mm: float
    """Expanded, k = 2: the largest over the seam's angles."""
    at_deg: float
    """Where."""
    stated: bool
    """From the scanner's own covariance; else from a nominal calibration."""


def calibration_above(margin: CalibrationMargin | None, limit_mm: float, upper_mm: float) -> Finding | None:
    """A bar where a step keeps a limit with its U, but not with what the calibration can take as well.

    Args:
        margin: what the calibration can take; None: it could not be told.
        limit_mm: of the norm.
        upper_mm: |step| + U.

    >>> from weldscan.measure.calibration_margin import CalibrationMargin, calibration_above
    >>> margin = CalibrationMargin(u_mm=0.06, at_deg=210.0, stated=False)
    >>> calibration_above(margin, 1.1, 0.43) is None
    True
    >>> str(calibration_above(margin, 0.5, 0.46).severity)
    'bar'
    """
    left = limit_mm - upper_mm
    # Above the limit there is no PASS to bar.
    if not left >= 0 or (margin is not None and left >= margin.u_mm):
        return None
    if margin is None:
        return bar(
            "calibration", "U leaves the scanner's calibration out, and what that takes of the step is not known"
        )
    if margin.stated:
        why = "so its covariance says; calibrate it with more poses of a board that fills the field, near and far"
    else:
        why = (
            f"nothing is stated of it, and a usual good one takes as much ({NOMINAL}); give the scanner.json of "
            "`weldscan calibrate scanner`, which states it"
        )
    text = (
        f"{left:.3f} mm are left to the limit of {limit_mm:.3f} mm, and the scanner's calibration, which U leaves out, "
        f"can take {margin.u_mm:.3f} mm of the step (k = 2): {why}"
    )
    return bar("calibration", text)


def calibration_margin(
    spec: ScannerSpec,
    scanner: Scanner,
    views: Sequence[PartView],
    angle_deg: Floats,
    wall_mm: float,
    unevenness: Unevenness,
    axis: str = "x",
) -> CalibrationMargin | None:
    """The expanded uncertainty of the step that comes from the scanner's calibration.

    Args:
        spec: the session's scanner; its covariance is used where it has one.
        scanner: the same, built.
        views: the segmented part shots.
        angle_deg: (n,) where on the seam the step was measured.
        wall_mm: rated thickness.
        unevenness: what the walls' fit left.
        axis: x or y, of the projector's coordinate that was decoded.

    Returns:
        CalibrationMargin; None where the views hold no walls to propagate to, or the seam no angle.
    """
    stated = stated_covariance(spec)
    covariance = stated
    if covariance is None:
        covariance = nominal_covariance(scanner, working_distance_mm(scanner, part_distance_mm(views)))
    # A weld's shrinkage is in the core's model only where the walls show it, which a bent space looks like: the model
    # that the calibration counts more in speaks.
    gains = step_jacobians(scanner, views, angle_deg, wall_mm, unevenness, axis)
    sigma = np.max([_propagated(gain, covariance) for gain in gains], axis=0) if gains else np.empty(0)
    if not sigma.size or not np.isfinite(sigma).all():
        return None
    worst = int(np.argmax(sigma))
    return CalibrationMargin(2 * float(sigma[worst]), float(angle_deg[worst]), stated is not None)


def _propagated(gain: Floats, covariance: Floats) -> Floats:
    return np.asarray(np.sqrt(np.maximum(np.einsum("ai,ij,aj->a", gain, covariance, gain), 0.0)))


def stated_covariance(spec: ScannerSpec) -> Floats | None:
    """The scanner file's covariance in the order of PARAMETERS, (24, 24); None where it states none of all of them.

    The third radial terms alone may be absent: they are rarely solved for. Anything else that is not named would count
    as exact.
    """
    if spec.covariance is None:
        return None
    names = spec.covariance.parameters
    if any(name not in names for k, name in enumerate(PARAMETERS) if k not in K3):
        return None
    known = [k for k, name in enumerate(names) if name in PARAMETERS]
    places = [PARAMETERS.index(names[k]) for k in known]
    out = np.zeros((len(PARAMETERS), len(PARAMETERS)))
    out[np.ix_(places, places)] = np.array(spec.covariance.matrix)[np.ix_(known, known)]
    return out


def part_distance_mm(views: Sequence[PartView]) -> float:
    """How far the part is from the camera: median over the views' points, every so many of them."""
    some = (np.arange(0, view.reason.size, DEPTH_STRIDE**2) for view in views)
    depths = np.concatenate([view.shot.points_mm(at)[:, 2] for view, at in zip(views, some, strict=True)])
    known = depths[np.isfinite(depths)]
    return float(np.median(known)) if len(known) else math.nan


def working_distance_mm(scanner: Scanner, part_mm: float) -> float:
    """Where the axes of camera and projector meet; where they are nearly parallel, where the part is.

    Args:
        scanner: the scanner.
        part_mm: how far the part is from the camera.
    """
    rays = []
    for lens in (scanner.camera, scanner.projector):
        middle = lens.undistort(np.array([[(lens.width - 1) / 2, (lens.height - 1) / 2]]))[0]
        rays.append(np.array([*middle, 1.0]))
    relation = scanner.camera_from_projector
    one, other, between = rays[0], relation[:3, :3] @ rays[1], relation[:3, 3]
    # The point of the camera's axis that the projector's passes nearest.
    square = np.array([[one @ one, -one @ other], [-one @ other, other @ other]])
    if np.linalg.det(square) < 1e-9 * square[0, 0] * square[1, 1]:
        return part_mm
    along, lamp = np.linalg.solve(square, np.array([one @ between, -other @ between]))
    met = float(along * one[2])
    return met if lamp > 0 and part_mm / MEETING < met < part_mm * MEETING else part_mm


def nominal_covariance(scanner: Scanner, distance_mm: float, fills: float = 1.0) -> Floats:
    """Covariance of the parameters that a usual good calibration of this scanner leaves.

    Free are both focal lengths, principal points, k1 k2 p1 p2 of both devices and camera_from_projector.

    Args:
        scanner: the scanner.
        distance_mm: where the boards stood, from the camera.
        fills: share of the field that the board fills, each way.

    Returns:
        (24, 24), of `bundle.PARAMETERS`.
    """
    middle, half = _field(scanner, distance_mm)
    long, short = (0, 1) if half[0] >= half[1] else (1, 0)
    corners = np.zeros((CORNERS[0] * CORNERS[1], 3))
    grid = np.meshgrid(*(np.linspace(-1, 1, n) * (1 - 1 / n) for n in CORNERS), indexing="ij")
    corners[:, long], corners[:, short] = (
        fills * g.ravel() * half[k] for g, k in zip(grid, (long, short), strict=True)
    )
    tilts = [(near, tilt) for near in DEPTHS for tilt in TILTS_DEG]
    turns = np.array([rotation_of(np.radians([*tilt, 0.0])) for _, tilt in tilts])
    # Nearer boards are moved along the ray to the field's middle.
    shifts = np.array([near * np.array([*middle, distance_mm]) for near, _ in tilts])
    model, count = BundleModel.of(scanner, turns, shifts, len(corners)), len(corners)
    none = np.zeros((len(tilts) * count, 2))
    features = Features(
        view=np.repeat(np.arange(len(tilts)), count),
        board_mm=np.tile(corners, (len(tilts), 1)),
        camera_px=none,
        projector_px=none,
        slope=np.zeros((len(none), 2, 2)),
        relative_sigma=np.ones(len(none)),
        number=np.tile(np.arange(count), len(tilts)),
    )
    size_c, size_p = ((lens.width, lens.height) for lens in (scanner.camera, scanner.projector))
    information = np.diag(prior_sigmas(model, size_c, size_p) ** -2.0)
    rows = rows_of(model, features, shape=False)
    if rows is not None:
        # Nothing was "seen": the residuals are the projections themselves.
        pixels = rows.residuals
        seen = np.all((pixels >= 0) & (pixels <= np.array([size_c, size_p]) - 1), axis=(1, 2))
        for view in range(len(tilts)):
            kept = seen & (features.view == view)
            if kept.sum() >= LEAST_CORNERS:
                by_lenses = rows.by_lenses[kept].reshape(-1, len(PARAMETERS)) / NOISE_PX
                # What the pose takes up says nothing of the lenses.
                pose, _ = np.linalg.qr(rows.by_pose[kept].reshape(-1, 6))
                left = by_lenses - pose @ (pose.T @ by_lenses)
                information += left.T @ left
    free = np.array([k for k in range(len(PARAMETERS)) if k not in K3])
    scale = np.sqrt(np.diag(information)[free])
    values, vectors = np.linalg.eigh(information[np.ix_(free, free)] / np.outer(scale, scale))
    # Rounding must not make something known.
    root = vectors / np.sqrt(np.maximum(values, LEAST_EIGENVALUE)) / scale[:, None]
    out = np.zeros_like(information)
    out[np.ix_(free, free)] = root @ root.T
    return out


def _field(scanner: Scanner, distance_mm: float) -> tuple[Floats, Floats]:
    """Middle and half sides, (x, y) each, of what both devices see of the plane at a distance; if they share nothing
    there, of what the camera sees.
    """
    camera, projector = scanner.camera, scanner.projector
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 33), np.linspace(0, camera.height - 1, 33))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    points = np.column_stack([camera.undistort(pixels), np.ones(len(pixels))]) * distance_mm
    lit = scanner.project_to_projector(points)
    both = np.all((lit >= 0) & (lit <= np.array([projector.width, projector.height]) - 1), axis=1)
    shared = points[both, :2] if both.any() else points[:, :2]
    low, high = shared.min(axis=0), shared.max(axis=0)
    return (low + high) / 2, (high - low) / 2


def step_jacobians(
    scanner: Scanner,
    views: Sequence[PartView],
    angle_deg: Floats,
    wall_mm: float,
    unevenness: Unevenness,
    axis: str = "x",
) -> tuple[Floats, ...]:
    """How the step at angles of the seam moves with `bundle.PARAMETERS`: generalised least squares of all views' walls.

    Args:
        scanner: the scanner.
        views: the segmented part shots.
        angle_deg: (n,)
        wall_mm: rated thickness.
        unevenness: what the walls' fit left.
        axis: x or y, of the projector's coordinate that was decoded.

    Returns:
        Two of (n, 24), mm per unit of each parameter: without and with the walls' shrinkage in the model; none where no
        view shows both walls.
    """
    model = BundleModel.of(scanner)
    rows, moves = [], []
    for view in views:
        shot = view.shot
        sample, labels = wall_sample(shot), shot.labels.ravel()
        walls = [sample[labels[sample] == wall] for wall in (Label.REFERENCE_WALL, Label.OTHER_WALL)]
        if min(map(len, walls)) < LEAST_POINTS:
            continue
        # The core's radial deviations are white once each wall is divided by its own covariance's root.
        white = []
        for at, is_other in zip(walls, (0.0, 1.0), strict=True):
            angle, along = shot.angle_rad.ravel()[at].astype(float), shot.axial_mm.ravel()[at].astype(float)
            normal = np.outer(np.cos(angle), shot.zero) + np.outer(np.sin(angle), np.cross(shot.axis, shot.zero))
            moved = np.einsum("ni,nij->nj", normal, point_jacobian(model, shot.points_mm(at), axis))
            cylinder = _cylinder(angle, along / shot.radius_mm)
            drawn = _shell(along, shot.radius_mm, wall_mm)[:, None]
            columns = [cylinder, is_other * cylinder, (1 - is_other) * drawn, is_other * drawn, moved]
            noise = shot.noise_mm**2 * len(at) / np.count_nonzero(labels == labels[at[0]])
            places = np.stack([angle * shot.radius_mm, along], axis=1)
            white.append(whitened(places, np.concatenate(columns, axis=1), *unevenness.correlation(noise)))
        both = np.concatenate(white)
        # The shot's own reference cylinder takes up what it can.
        q, _ = np.linalg.qr(both[:, :5])
        left = both[:, 5:] - q @ (q.T @ both[:, 5:])
        rows.append(left[:, :7])
        moves.append(left[:, 7:])
    if not rows:
        return ()
    # As in the core: a weld draws a wall in by some tenths of a millimetre, and by nothing as a rule.
    prior = np.zeros((2, 7))
    prior[:, 5:] = np.eye(2) / SHRINKAGE_MM
    x, y = np.concatenate([*rows, prior]), np.concatenate([*moves, np.zeros((2, moves[0].shape[1]))])
    seam = np.radians(np.asarray(angle_deg, dtype=float))
    at_seam = _cylinder(seam, np.zeros_like(seam))
    return tuple(at_seam @ np.linalg.lstsq(x[:, :terms], y, rcond=None)[0][:5] for terms in (5, 7))


def _cylinder(angle: Floats, z: Floats) -> Floats:
    """Radius, place and direction of a cylinder as its radial deviation, (n, 5)."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([np.ones_like(angle), cos, sin, z * cos, z * sin], axis=1)


def _shell(along_mm: Floats, radius_mm: float, wall_mm: float) -> Floats:
    """Bending of a shell that a ring draws in, 1 at the ring: `shell_term` of the core's walls (S. Timoshenko)."""
    x = 1.285 * np.abs(along_mm) / math.sqrt(radius_mm * wall_mm)
    return np.asarray(np.exp(-x) * (np.cos(x) + np.sin(x)))
