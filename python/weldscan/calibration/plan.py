"""Which flange poses to take for a hand-eye calibration, and how good it will be.

Candidates look at the plate from all sides: tilted by 30 to 45 degrees, rolled, near and far. Those where flange, view
or volume do not allow a shot are dropped. From the rest the set is chosen whose predicted covariance of points all over
the working volume has the least trace (A-optimal), greedily and then by exchange: one shot after the other is swapped
for whatever serves better, until none does. Poses alike share the robot's error, which the covariance does not know:
chosen ones are turned against each other by 20 degrees or more, and spread over all sides of the plate. The prediction
is that of the solve itself with the noise that was stated.

Source: V. V. Fedorov, Theory of Optimal Experiments (1972), 3.3, for the exchange.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import Scanner
from weldscan.calibration.artefact import TOUCH_SIGMA_MM
from weldscan.calibration.hand_eye import (
    POSE_SIGMA_MM,
    POSE_SIGMA_RAD,
    TOUCH_BIAS_SIGMA_MM,
    tilts_rad,
)
from weldscan.calibration.hand_eye_model import FACTORS, UNKNOWNS, Linear, Noise
from weldscan.errors import InputError
from weldscan.geometry import inverse, rotation_angle, skew
from weldscan.pose import KukaPose, matrix_from_kuka
from weldscan.records.plan import NAME, PlanSource
from weldscan.records.session import FlangePose, Session, ShotSpec

Floats = NDArray[np.float64]

TILTS_DEG = (30.0, 37.5, 45.0)
AROUND, ROLLS = 12, 8
# Sphere centres as fits of a usual scanner have them (the demo's: 0.006), mm, k = 1.
SPHERE_SIGMA_MM = 0.01
# Pixels that a sphere's outline stays away from the borders of either image, as a share of the image's width.
BORDER = 0.02
# A ray to a sphere's centre passes others by this many radii: then no sphere covers or shades more than a rim.
CLEAR_RADII = 1.5
# Poses turned by less are alike: an arm stands in nearly the same joints and errs nearly the same.
ALIKE_RAD = math.radians(20)
# Sides of the plate from which about as many shots are taken.
SIDES = 6
LEAST_SHOTS, MOST_SHOTS = 5, 40
EXCHANGES = 5


@dataclass(frozen=True)
class Limits:
    """Where the robot and the scanner can be."""

    distance_mm: float = 420.0
    """Working distance: from the camera to the middle of the spheres."""
    depth_mm: float = 40.0
    """The working volume's half depth: every sphere is within it about the working distance."""
    reach_mm: tuple[float, float] = (250.0, 1100.0)
    """Of the flange from base's origin, least and most."""
    lowest_mm: float = 0.0
    """Least height of the flange in base."""
    cone_deg: float = 180.0
    """How far the flange's z axis may be turned from straight down."""


@dataclass(frozen=True, eq=False)
class PlannedShot:
    """One flange pose of the plan."""

    base_from_flange: Floats
    base_from_scanner: Floats
    tilt_deg: float
    """Between the plate's normal and the direction from which it is seen."""
    around_deg: float
    """Of that direction in the plate's plane, from base's x."""
    roll_deg: float
    """Of the image about its axis."""
    distance_mm: float

    @property
    def pose(self) -> KukaPose:
        """As the controller has it."""
        return KukaPose(*(round(value, 3) for value in KukaPose.from_matrix(self.base_from_flange).values()))


@dataclass(frozen=True, eq=False)
class Plan:
    """Flange poses for a hand-eye calibration, in an order of short ways, and what they will give."""

    shots: tuple[PlannedShot, ...]
    candidates: int
    """Poses that were tried."""
    possible: int
    """And that robot and scanner allow."""
    dropped: dict[str, int]
    """Why the others were not."""
    u_mm: tuple[float, ...]
    """Predicted standard uncertainty of a point at the working distance, worst axis, after 1, 2, ... shots; infinite
    where they do not determine it."""
    u_untouched_mm: float
    """And with all shots, if nothing were known of the spheres' centres."""
    tilts_deg: tuple[float, float]
    centres_base_mm: Floats
    noise: Noise
    limits: Limits


def noise_of(source: PlanSource) -> Noise:
    """The noise that a session states, or the defaults of the solve."""
    robot, plate = source.robot, source.artefact
    degrees = robot.pose_sigma_deg if robot is not None else None
    return Noise(
        (robot.pose_sigma_mm if robot is not None else None) or POSE_SIGMA_MM,
        POSE_SIGMA_RAD if degrees is None else math.radians(degrees),
        plate.touch_sigma_mm or TOUCH_SIGMA_MM,
        plate.touch_bias_sigma_mm or TOUCH_BIAS_SIGMA_MM,
    )


def plan_poses(
    scanner: Scanner,
    flange_from_scanner: Floats,
    centres_base_mm: Floats,
    sphere_diameter_mm: float,
    *,
    shots: int = 12,
    limits: Limits = Limits(),
    noise: Noise | None = None,
) -> Plan:
    """The flange poses whose predicted covariance of points in the working volume has the least trace.

    Args:
        scanner: camera and projector.
        flange_from_scanner: (4, 4), where the scanner sits; roughly.
        centres_base_mm: (3, 3), where the spheres are; roughly.
        sphere_diameter_mm: theirs.
        shots: how many poses, 5 to 40; 10 to 15 are good.
        limits: of robot and scanner.
        noise: of robot and probe, k = 1.

    Raises:
        InputError: a number is out of its range, or too few poses are possible; the message says what forbids most.
    """
    if not LEAST_SHOTS <= shots <= MOST_SHOTS:
        raise InputError(f"shots: from {LEAST_SHOTS} to {MOST_SHOTS}, got {shots}")
    _check(limits)
    noise = noise or Noise(POSE_SIGMA_MM, POSE_SIGMA_RAD, TOUCH_SIGMA_MM, TOUCH_BIAS_SIGMA_MM)
    x, centres = np.asarray(flange_from_scanner, dtype=float), np.asarray(centres_base_mm, dtype=float)
    candidates = _candidates(centres, x, limits)
    reasons = [_why_not(c, scanner, x, centres, sphere_diameter_mm / 2, limits) for c in candidates]
    possible = [c for c, reason in zip(candidates, reasons, strict=True) if reason is None]
    dropped = {r: reasons.count(r) for r in sorted({r for r in reasons if r is not None})}
    if len(possible) < shots:
        most = max(dropped, key=lambda reason: dropped[reason])
        raise InputError(
            f"only {len(possible)} of {len(candidates)} poses around the plate are possible, {shots} are wanted; "
            f"{dropped[most]} were not because {most}"
        )
    chosen, grams, prior = _choose(possible, x, centres, shots, limits, noise)
    ordered = _short_way([possible[i] for i in chosen])
    order = [next(k for k, i in enumerate(chosen) if possible[i] is shot) for shot in ordered]
    information = np.cumsum(grams[[chosen[k] for k in order]], axis=0)
    middle = np.array([0.0, 0.0, limits.distance_mm])
    turned = tilts_rad([shot.base_from_flange for shot in ordered])
    return Plan(
        shots=tuple(ordered),
        candidates=len(candidates),
        possible=len(possible),
        dropped=dropped,
        u_mm=tuple(_worst_axis(prior + info, x, middle) for info in information),
        u_untouched_mm=_worst_axis(information[-1], x, middle),
        tilts_deg=(math.degrees(turned[0]), math.degrees(turned[1])),
        centres_base_mm=centres,
        noise=noise,
        limits=limits,
    )


def _check(limits: Limits) -> None:
    for name in ("distance_mm", "depth_mm", "cone_deg"):
        value = getattr(limits, name)
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{name}: must be positive, got {value}")
    low, high = limits.reach_mm
    if not 0 <= low < high:
        raise InputError(f"reach_mm: from less to more, got {low:g} to {high:g}")
    if limits.depth_mm >= limits.distance_mm:
        raise InputError(f"depth_mm: {limits.depth_mm:g} must be less than the distance of {limits.distance_mm:g} mm")


def _candidates(centres: Floats, x: Floats, limits: Limits) -> list[PlannedShot]:
    middle = centres.mean(axis=0)
    normal = np.cross(centres[1] - centres[0], centres[2] - centres[0])
    normal /= np.linalg.norm(normal)
    # Spheres look up from a lying plate, and towards the robot from a standing one.
    side = normal[2] if abs(normal[2]) > 0.5 else -(normal @ middle)
    normal = normal if side >= 0 else -normal
    first = np.array([1.0, 0.0, 0.0] if abs(normal[0]) < 0.9 else [0.0, 1.0, 0.0])
    first -= normal * (normal @ first)
    first /= np.linalg.norm(first)
    aside = first, np.cross(normal, first)
    found = []
    for tilt in np.radians(TILTS_DEG):
        for i in range(AROUND):
            around = 2 * math.pi * i / AROUND
            direction = normal * math.cos(tilt) + math.sin(tilt) * (
                aside[0] * math.cos(around) + aside[1] * math.sin(around)
            )
            for j in range(ROLLS):
                roll = 2 * math.pi * j / ROLLS
                # Half the depth is the plate's own.
                for near in (-0.5, 0.0, 0.5):
                    distance = limits.distance_mm + near * limits.depth_mm
                    view = _looking(middle, direction, distance, roll)
                    degrees = (math.degrees(tilt), 360 * i / AROUND, 360 * j / ROLLS)
                    found.append(PlannedShot(view @ inverse(x), view, *degrees, distance))
    return found


def _looking(target: Floats, direction: Floats, distance: float, roll: float) -> Floats:
    """base_from_scanner of a camera that looks at the target from a direction, turned about its axis."""
    z = -direction
    x = np.cross([0.0, 0.0, 1.0] if abs(z[2]) < 0.9 else [0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    pose = np.eye(4)
    pose[:3, 0] = x * math.cos(roll) + y * math.sin(roll)
    pose[:3, 1] = y * math.cos(roll) - x * math.sin(roll)
    pose[:3, 2] = z
    pose[:3, 3] = target + direction * distance
    return pose


def _why_not(
    shot: PlannedShot, scanner: Scanner, x: Floats, centres: Floats, radius: float, limits: Limits
) -> str | None:
    """What forbids a pose; None if nothing does."""
    flange = shot.base_from_flange
    reach = float(np.linalg.norm(flange[:3, 3]))
    if not limits.reach_mm[0] <= reach <= limits.reach_mm[1]:
        return f"the flange would not be {limits.reach_mm[0]:g} to {limits.reach_mm[1]:g} mm from base's origin"
    if flange[2, 3] < limits.lowest_mm:
        return f"the flange would be lower than {limits.lowest_mm:g} mm"
    if math.degrees(math.acos(float(np.clip(-flange[2, 2], -1, 1)))) > limits.cone_deg:
        return f"the flange would be turned by more than {limits.cone_deg:g} degrees from straight down"
    into = inverse(flange @ x)
    seen = centres @ into[:3, :3].T + into[:3, 3]
    off = np.abs(np.linalg.norm(seen, axis=1) - limits.distance_mm)
    if off.max() > limits.depth_mm:
        return f"a sphere would be more than {limits.depth_mm:g} mm nearer or further than {limits.distance_mm:g} mm"
    projector_from_camera = inverse(np.asarray(scanner.camera_from_projector))
    lit = seen @ projector_from_camera[:3, :3].T + projector_from_camera[:3, 3]
    for lens, points, name in ((scanner.camera, seen, "camera"), (scanner.projector, lit, "projector")):
        rim = radius * max(lens.K[0, 0], lens.K[1, 1]) / points[:, 2].min() + BORDER * lens.width
        pixels = lens.project(points)
        if pixels.min() < rim or (pixels > np.array([lens.width, lens.height]) - 1 - rim).any():
            return f"a sphere would be out of the {name}'s view"
        for i in range(3):
            ray = points[i] / np.linalg.norm(points[i])
            for j in range(3):
                along = float(points[j] @ ray)
                beside = float(np.linalg.norm(points[j] - along * ray))
                if j != i and along < np.linalg.norm(points[i]) and beside < CLEAR_RADII * radius:
                    return f"one sphere would stand before another for the {name}"
    return None


def _choose(
    possible: list[PlannedShot], x: Floats, centres: Floats, shots: int, limits: Limits, noise: Noise
) -> tuple[list[int], Floats, Floats]:
    """Indices of the best set; information of every candidate, (n, 15, 15), and of the touched centres, (15, 15)."""
    poses = np.array([inverse(shot.base_from_flange) for shot in possible])
    into = np.linalg.inv(x) @ poses
    seen = np.einsum("nab,jb->nja", into[:, :3, :3], centres) + into[:, None, :3, 3]
    covariances = np.broadcast_to(np.eye(3) * SPHERE_SIGMA_MM**2, (len(possible), 3, 3, 3))
    linear = Linear(x, centres, poses, seen, covariances, centres, noise)
    stated = np.ones((1, FACTORS))
    grams: Floats = np.asarray(linear.grams(stated)[0][0][:, :UNKNOWNS, :UNKNOWNS])
    prior: Floats = np.asarray(linear.prior(stated)[0][0][:UNKNOWNS, :UNKNOWNS])
    across = limits.distance_mm / 6
    points = [
        np.array([sx * across, sy * across, limits.distance_mm + sz * limits.depth_mm])
        for sx in (-1, 1)
        for sy in (-1, 1)
        for sz in (-1, 1)
    ]
    jacobian = np.concatenate([_jacobian(x, point) for point in points])
    weight = jacobian.T @ jacobian / len(points)

    def costs(base: Floats) -> Floats:
        return np.asarray(np.einsum("nab,ba->n", np.linalg.inv(base + grams)[:, :6, :6], weight))

    turns = np.array([shot.base_from_flange[:3, :3] for shot in possible])
    cosine = (np.einsum("nab,mab->nm", turns, turns) - 1) / 2
    alike = cosine > math.cos(ALIKE_RAD)
    side = np.array([int(shot.around_deg // (360 / SIDES)) % SIDES for shot in possible])
    quota = math.ceil(shots / len(np.unique(side)))

    def barred(others: list[int]) -> NDArray[np.bool_]:
        near, full = alike[others].any(axis=0), (np.bincount(side[others], minlength=SIDES) >= quota)[side]
        # Where robot and view leave little room, a side may give more; then poses may be alike, but none is twice.
        for out in (near | full, near):
            if not out.all():
                return np.asarray(out)
        return np.isin(np.arange(len(possible)), others)

    # A metre and a radian: what lets the first shots be compared before they determine anything.
    weak = prior + np.diag([1.0] * 3 + [1e-6] * 3 + [0.0] * 9)
    chosen: list[int] = []
    total = weak
    for _ in range(shots):
        cost = costs(total)
        cost[barred(chosen)] = np.inf
        chosen.append(int(np.argmin(cost)))
        total = total + grams[chosen[-1]]
    for _ in range(EXCHANGES):
        before = list(chosen)
        for k in range(shots):
            others = [i for j, i in enumerate(chosen) if j != k]
            cost = costs(weak + grams[others].sum(axis=0))
            cost[barred(others)] = np.inf
            best = int(np.argmin(cost))
            # Ties go to what is there: an exchange must gain something.
            if cost[best] < float(cost[chosen[k]]) * (1 - 1e-6):
                chosen[k] = best
        if chosen == before:
            break
    return chosen, grams, prior


def _jacobian(x: Floats, point: Floats) -> Floats:
    return np.hstack([-x[:3, :3] @ skew(point), np.eye(3)])


def _worst_axis(information: Floats, x: Floats, point: Floats) -> float:
    scale = np.sqrt(np.diag(information))
    if scale.min() <= 0 or np.linalg.cond(information / np.outer(scale, scale)) > 1e13:
        return math.inf
    jacobian = _jacobian(x, point)
    covariance = jacobian @ np.linalg.inv(information)[:6, :6] @ jacobian.T
    return float(np.sqrt(np.linalg.eigvalsh(covariance).max()))


def _short_way(shots: list[PlannedShot]) -> list[PlannedShot]:
    """From each pose to the nearest that is left, beginning with the least tilted; a radian counts as 300 mm."""
    left = list(shots)
    way = [left.pop(min(range(len(left)), key=lambda i: left[i].tilt_deg))]
    while left:
        here = way[-1].base_from_flange

        def far(i: int, here: Floats = here) -> float:
            there = left[i].base_from_flange
            turned = rotation_angle(here[:3, :3].T @ there[:3, :3])
            return math.hypot(float(np.linalg.norm(here[:3, 3] - there[:3, 3])), 300 * turned)

        way.append(left.pop(min(range(len(left)), key=far)))
    return way


def document(source: PlanSource, plan: Plan) -> Session:
    """The plan as a `weldscan-session/1` document for `weldscan scan`: its `[scan] plan`."""
    return Session(
        schema="weldscan-session/1",
        name=f"{source.name[:180].removesuffix(NAME)}{NAME}",
        scanner=source.scanner,
        fringes=source.fringes,
        artefact=source.artefact,
        robot=source.robot,
        shots=tuple(
            ShotSpec(
                name=f"artefact-{i + 1}",
                of="artefact",
                flange_pose=FlangePose(**dict(zip("XYZABC", shot.pose.values(), strict=True))),
            )
            for i, shot in enumerate(plan.shots)
        ),
    )


def mount_of(text: str) -> Floats:
    """flange_from_scanner of six numbers X Y Z A B C, as a controller writes a tool.

    Raises:
        InputError: it is not six numbers.
    """
    try:
        values = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        values = []
    if len(values) != 6 or not all(map(math.isfinite, values)):
        raise InputError(f"--mount: {text!r} is not six numbers X Y Z A B C, mm and degrees")
    return np.asarray(matrix_from_kuka(*values))
