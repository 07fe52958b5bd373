"""Part shots held against each other, before their walls are pooled: they are of one pipe, and it stood still.

- `copies`: no two shots hold the same images.
- `shots_agree`: each shot alone tells the pipe's axis, the place of the seam along it and the step by angle. Exchanged
  images, a wrong flange pose, a hand-eye of another cell show in the first two whether or not the shots saw the same
  arc; two pipes, or a wall misread in one of them, in the third.
- `agreement`: what two shots saw of the same wall must be in the same place in base. The step does not depend on
  small disagreements of that kind, for each shot has its own reference wall. What is placed through the robot does:
  cloud, angles, the paper's number, a comparison with probed points.

What a real pipe does is no disagreement. One that is out of round moves a locally fitted axis sideways by millimetres,
and only there; where the seam is along the pipe, and to where the pipe runs, it leaves alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import SeamCourse, SeamFrame, WeldStep, wall_differences, wall_seen
from weldscan.calibration.hand_eye import LARGEST_RESIDUAL_MM, pose_sigma
from weldscan.errors import GeometryError
from weldscan.geometry import skew
from weldscan.measure.part_views import PartView
from weldscan.measure.seam_coverage import EdgeProfile, edge_profile
from weldscan.result import Finding, HandEye, Label, Severity, ShotAgreement, bar, warning

Floats = NDArray[np.float64]

# Points of a shot's walls that are compared: tens in every cell of 4 mm.
WALL_POINTS = 30_000
# Neighbouring cells share the scanner's errors: about so many count as one.
CORRELATED_CELLS = 4
# Two shots, each placed as wrong as no industrial arm stands.
LARGEST_DIFFERENCE_MM = 2 * LARGEST_RESIDUAL_MM

# --- where the pipe is, as one shot alone tells it
# A wall's own direction, 1 sigma: the weld draws both walls in by 0.2 mm over some 2.5 sqrt(R t), a decimetre (half a
# millimetre is the most), and a pipe is straight to 0.2 % of its length.
WALL_LEAN_RAD = math.radians(0.1)
# Waves of a wall that a fitted cylinder follows: at least what any pipe has, else twice what is left over, for the fit
# has flattened them.
UNEVENNESS_MM, FLATTENED = 0.01, 2.0
# How far a pipe's cut end may be from square (a sixteenth of an inch is the usual tolerance), and how far the middle
# between two toes may be from it in parts of the cap's width: a cap is as much wider on one side. A toe misread in one
# shot moves the middle by half of what the widths differ; a cap so wide has a bar of its own.
SQUARENESS_MM = 1.6
CAP_PART = 0.2
# An out-of-roundness of 2 % of the diameter moves the centre of a local circle by up to 1.5 % of it, to either side.
OVAL_PART = 0.03
# Over this angle between two views the form of the pipe is another one.
OVAL_TURN_RAD = math.radians(45)
SIGMAS = 3.0

# --- the step, as one shot alone tells it
# What two places of the scanner's field read differently: calibrations of one scanner differ by 0.15 mm (rms) in the
# step. A real disagreement of two pipes, or of a wall misread, matters from there on.
STEP_SLACK_MM = 0.2
# But no more than half of what PNAE G-7-010 allows a thin wall, 0.2 t.
SLACK_THICKNESSES = 0.1
# Below that, from here on, it is worth a warning: waves of the walls.
STEP_WARNING_MM = 0.1
# A bin may be so many bins off: an oval pipe moves the centre about which a shot counts its places.
STEP_SHIFT_BINS = 1
LEAST_BINS = 2
# So many disagreements are listed; more only repeat them.
MOST_SAID = 6


@dataclass(frozen=True, eq=False)
class PlacedShot:
    """Where a part shot was taken from."""

    name: str
    base_from_flange: Floats


def agreement(views: Sequence[PartView], hand_eye: HandEye, seam: SeamFrame) -> tuple[ShotAgreement, ...]:
    """The difference in height between every two shots where both saw a wall, with its uncertainty.

    Args:
        views: the segmented part shots.
        hand_eye: through which they were placed.
        seam: of one of them, in base.

    Returns:
        One per pair that saw a wall together in 20 cells of 4 mm or more.
    """
    sampled = [_walls_of(view) for view in views]
    points_mm, labels = (np.concatenate(columns) for columns in zip(*sampled, strict=True))
    numbers = np.repeat(np.arange(len(views), dtype=np.uint16), [len(label) for _, label in sampled])
    shots = [PlacedShot(view.name, view.base_from_flange) for view in views]
    found = []
    pairs = wall_differences(points_mm, labels, numbers, range(len(views)), seam.origin_mm, seam.across)
    for i, j, cells, difference_mm, scatter_mm, rms_mm, middle in pairs:
        normal = seam.outward(seam.place(middle[None])[0])[0]
        placing = _placing_mm([shots[i], shots[j]], hand_eye, middle, normal)
        found.append(
            ShotAgreement(
                shots=(shots[i].name, shots[j].name),
                cells=cells,
                difference_mm=difference_mm,
                rms_mm=rms_mm,
                expanded_uncertainty_mm=2 * math.hypot(placing, scatter_mm / math.sqrt(cells / CORRELATED_CELLS)),
            )
        )
    return tuple(found)


def _walls_of(view: PartView) -> tuple[Floats, NDArray[np.uint8]]:
    """Points of a view's walls in base, and their labels: so many of them that more would change nothing."""
    labels = view.shot.labels.ravel()
    walls = np.flatnonzero((labels == Label.REFERENCE_WALL) | (labels == Label.OTHER_WALL))
    some = walls[:: max(1, len(walls) // WALL_POINTS)]
    turn, place = view.base_from_scanner[:3, :3], view.base_from_scanner[:3, 3]
    return view.shot.points_mm(some) @ turn.T + place, labels[some]


def complaint(pair: ShotAgreement) -> Finding | None:
    """What to say of two shots that disagree by more than their uncertainty: a warning, or a bar where it is large."""
    off, u = abs(pair.difference_mm), pair.expanded_uncertainty_mm
    if off <= u:
        return None
    one, other = pair.shots
    text = f"{one} and {other} disagree by {off:.3f} mm where both saw the wall, more than U = {u:.3f} mm: "
    if off > LARGEST_DIFFERENCE_MM + u:
        return bar(
            "shots-disagree",
            f"{text}no robot stands so wrong: was the part moved, were images exchanged, is a flange pose wrong?",
            other,
        )
    return warning(
        "agreement",
        f"{text}was the part moved, or is a flange pose wrong? Cloud, angles and the paper's number are placed through "
        "them; the step is not",
    )


# --- copies -----------------------------------------------------------------------------------------------------------


def copies(digests: Mapping[str, str]) -> list[Finding]:
    """A bar for every shot whose images are another's.

    Args:
        digests: per shot, of whatever kind, the hash of its images.

    >>> [finding.text for finding in copies({"part-1": "a", "part-2": "b", "part-3": "a"})]
    ['part-3 holds the same images as part-1: no two captures are alike; scan the one that is not there again']
    """
    first: dict[str, str] = {}
    return [
        bar(
            "shot-copied",
            f"{name} holds the same images as {twin}: no two captures are alike; scan the one that is not there again",
            name,
        )
        for name, digest in digests.items()
        if (twin := first.setdefault(digest, name)) != name
    ]


# --- the pipe and the step, shot by shot ------------------------------------------------------------------------------


def shots_agree(
    views: Sequence[PartView], step: WeldStep, hand_eye: HandEye, thickness_mm: float = math.inf
) -> list[Finding]:
    """Whether the shots are of one pipe that stood still.

    Args:
        views: the segmented part shots.
        step: as all of them tell it together.
        hand_eye: through which they were placed.
        thickness_mm: of the wall: what two shots may read differently is little beside what it is allowed.

    Returns:
        Bars `shots-disagree`, each naming two shots (or the one that contradicts all others) with their numbers;
        `hand-eye` where every shot contradicts every other; warnings `agreement`.
    """
    seen = [_Seen.of(view) for view in views]
    misplaced = {
        (i, j): complaints
        for i, j in combinations(range(len(seen)), 2)
        if (complaints := list(_misplaced(seen[i], seen[j], hand_eye)))
    }
    return [*_about_places(views, misplaced), *_stepped_alike(views, step, hand_eye, set(misplaced), thickness_mm)]


@dataclass(frozen=True, eq=False)
class _Seen:
    """The pipe as one shot has it, base."""

    view: PartView
    axis: Floats
    seam_mm: Floats
    """(3,) on the surface, at the seam, in the middle of the arc."""
    outward: Floats
    """There, unit, square to the axis."""
    direction_cov: Floats
    """(3, 3), rad^2, of the axis' direction, without the robot's."""
    centre_sigma_mm: float
    """How far the wall's waves may move the centre of the fitted circle: 1 / (1 - cos) of half the arc times."""

    @classmethod
    def of(cls, view: PartView) -> _Seen:
        shot, seam = view.shot, view.seam_in_base
        axis = seam.across
        seen = wall_seen(shot)
        if seen is None:
            raise GeometryError(f"{view.name}: no point of it lies on the reference wall")
        middle, half, twist, left = seen
        outward = seam.outward([middle])[0]
        along = np.cross(axis, outward)
        # The axis leans towards the view, or turns across it: then the wall is twisted by across * sin(angle) only.
        waves = max(UNEVENNESS_MM, FLATTENED * left)
        sideways = math.hypot(WALL_LEAN_RAD, waves / max(twist, 1e-3))
        covariance = WALL_LEAN_RAD**2 * np.outer(outward, outward) + sideways**2 * np.outer(along, along)
        centre = waves / max(1 - math.cos(half), 1e-4)
        return cls(view, axis, seam.points([middle], [0.0])[0], outward, covariance, centre)


def _about_places(views: Sequence[PartView], misplaced: Mapping[tuple[int, int], Sequence[str]]) -> list[Finding]:
    """What to say of pairs that put the pipe in different places: whose fault fits."""
    names = [view.name for view in views]
    worst = next(iter(misplaced), (0, 0))
    # One shot that contradicts all the others is named alone, where there are others that agree.
    for k, name in enumerate(names):
        with_it = [pair for pair in misplaced if k in pair]
        if len(views) > 2 and len(with_it) == len(views) - 1 == len(misplaced):
            other = next(i for i in with_it[0] if i != k)
            text = (
                f"{name} contradicts all other shots, which agree: against {names[other]} "
                f"{'; '.join(misplaced[with_it[0]])}: is its flange pose wrong, are its images another shot's, was the "
                "part moved?"
            )
            return [bar("shots-disagree", text, name)]
    if len(views) > 2 and len(misplaced) == len(views) * (len(views) - 1) // 2:
        text = (
            f"all {len(views)} shots contradict each other; {names[worst[0]]} and {names[worst[1]]}: "
            f"{'; '.join(misplaced[worst])}: is the hand-eye of this cell, are A, B and C in degrees?"
        )
        return [bar("hand-eye", text)]
    return [
        bar(
            "shots-disagree",
            f"{names[i]} and {names[j]} contradict each other: {'; '.join(complaints)}: were their images exchanged, "
            "is a flange pose wrong, was the part moved, is the hand-eye of another cell?",
            names[j],
        )
        for (i, j), complaints in misplaced.items()
    ][:MOST_SAID]


def _misplaced(one: _Seen, other: _Seen, hand_eye: HandEye) -> Iterator[str]:
    """What two shots say differently of where the pipe is, beyond what a real pipe and a real robot do."""
    axis = one.axis + other.axis
    axis /= np.linalg.norm(axis)
    shots = [PlacedShot(s.view.name, s.view.base_from_flange) for s in (one, other)]
    middle = (one.seam_mm + other.seam_mm) / 2
    turned = np.eye(3) * _turning_rad(hand_eye) ** 2
    # To where it runs.
    apart = other.axis - one.axis
    covariance = one.direction_cov + other.direction_cov + turned
    if float(apart @ np.linalg.solve(covariance, apart)) > SIGMAS**2:
        allowed = SIGMAS * math.degrees(math.sqrt(float(apart @ covariance @ apart) / float(apart @ apart)))
        yield f"its axis differs by {math.degrees(np.linalg.norm(apart)):.2f} degrees ({allowed:.2f} at most)"
    # Where the seam is along it. Over the distance across, what is not known of the direction counts as well.
    between = other.seam_mm - one.seam_mm
    across = between - axis * (axis @ between)
    along = float(axis @ between)
    direction = float(across @ (one.direction_cov + other.direction_cov + turned) @ across) / 4
    sigma = math.sqrt(_placing_mm(shots, hand_eye, middle, axis) ** 2 + direction)
    widths = [s.view.shot.bead_width_mm for s in (one, other)]
    allowed = SQUARENESS_MM + CAP_PART * min(widths) + abs(widths[0] - widths[1]) / 2 + SIGMAS * sigma
    if abs(along) > allowed:
        yield f"the seam is {abs(along):.1f} mm apart along the pipe ({allowed:.1f} at most)"
    # Where the axis is. The radii of two views of one place are one pipe's; of two places they need not be.
    off = across - (other.view.shot.radius_mm * other.outward - one.view.shot.radius_mm * one.outward)
    off -= axis * (axis @ off)
    turn = math.acos(max(-1.0, min(1.0, float(one.outward @ other.outward))))
    radius = (one.view.shot.radius_mm + other.view.shot.radius_mm) / 2
    oval = OVAL_PART * 2 * radius * min(1.0, turn / OVAL_TURN_RAD)
    size = float(np.linalg.norm(off))
    placing = _placing_mm(shots, hand_eye, middle, off / size) if size > 0 else 0.0
    allowed = LARGEST_DIFFERENCE_MM + oval + SIGMAS * math.hypot(placing, one.centre_sigma_mm, other.centre_sigma_mm)
    if size > allowed:
        yield f"its axis is {size:.1f} mm aside ({allowed:.1f} at most)"


def _turning_rad(hand_eye: HandEye) -> float:
    """How far two placed directions may be turned against each other, each axis: two poses, and the hand-eye twice."""
    common = float(np.linalg.eigvalsh(hand_eye.covariance[:3, :3]).max())
    return math.sqrt(2 * pose_sigma(hand_eye)[1] ** 2 + 4 * max(common, 0.0))


def _stepped_alike(
    views: Sequence[PartView], step: WeldStep, hand_eye: HandEye, not_these: set[tuple[int, int]], thickness_mm: float
) -> list[Finding]:
    """The step of each shot alone, bin by bin, where two of them saw the seam; but for pairs whose places are wrong."""
    seen = [_bins_seen(view) for view in views]
    pairs = [
        (i, j)
        for i, j in combinations(range(len(views)), 2)
        if len(seen[i] & seen[j]) >= LEAST_BINS and (i, j) not in not_these
    ]
    alone: dict[int, dict[int, tuple[float, float]]] = {}
    edges: dict[int, EdgeProfile] = {}
    for k in sorted({k for pair in pairs for k in pair}):
        try:
            readings, steps, standards = step.alone(views[k].shot, _turning_rad(hand_eye))
        except GeometryError:
            continue
        bins = np.rint(readings / views[k].shot.seam.course.bin_width).astype(int).tolist()
        told = zip(steps.tolist(), standards.tolist(), strict=True)
        alone[k], edges[k] = dict(zip(bins, told, strict=True)), edge_profile([views[k]])
    found = []
    for i, j in pairs:
        if i in alone and j in alone:
            bounds, course = _apart(edges[i], edges[j]), views[i].shot.seam.course
            found += list(_unlike(views[i].name, views[j].name, course, alone[i], alone[j], *bounds, thickness_mm))
    return sorted(found, key=lambda finding: finding.severity is not Severity.BAR)[:MOST_SAID]


def _bins_seen(view: PartView) -> set[int]:
    walls = (view.shot.labels == Label.REFERENCE_WALL) | (view.shot.labels == Label.OTHER_WALL)
    return set(view.shot.seam.course.bins_of(view.shot.angle_rad[walls][::50].astype(np.float64)).tolist())


def _apart(one: EdgeProfile, other: EdgeProfile) -> tuple[Floats, Floats]:
    """How far two shots' readings of the surfaces beside the weld are apart, by bin, and their joint U; NaN: unread."""
    return np.abs(one.step_mm - other.step_mm), np.hypot(one.u_mm, other.u_mm)


def _unlike(
    one: str,
    other: str,
    course: SeamCourse,
    a: Mapping[int, tuple[float, float]],
    b: Mapping[int, tuple[float, float]],
    apart_mm: Floats | None = None,
    open_mm: Floats | None = None,
    thickness_mm: float = math.inf,
) -> Iterator[Finding]:
    """Where two profiles of the walls differ by more than their uncertainty in bins beside each other.

    A bar; but a warning where the surfaces right beside the weld, which are judged as well, are alike there: then one
    shot misread a wall, at the end of its arc say. Profiles by bin of `course`; edges of all bins, NaN where unread.
    """
    unread: Floats = np.full(course.bins, np.nan)
    apart_mm, open_mm = unread if apart_mm is None else apart_mm, unread if open_mm is None else open_mm
    slack_mm = min(STEP_SLACK_MM, SLACK_THICKNESSES * thickness_mm)
    excess = {}
    for k, (step, sigma) in a.items():
        shifted = (course.beyond(k, shift) for shift in range(-STEP_SHIFT_BINS, STEP_SHIFT_BINS + 1))
        near = [b[j] for j in shifted if j is not None and j in b]
        if k in b:
            low, high = min(h for h, _ in near), max(h for h, _ in near)
            off = max(0.0, low - step, step - high)
            beyond_mm = off - SIGMAS * math.hypot(sigma, b[k][1])
            alike = apart_mm[k] <= open_mm[k] + STEP_WARNING_MM and apart_mm[k] + open_mm[k] < beyond_mm
            excess[k] = min(beyond_mm, slack_mm) if alike else beyond_mm
    for slack, severe in ((slack_mm, True), (min(STEP_WARNING_MM, slack_mm), False)):
        beyond = {k for k, off in excess.items() if off > slack}
        lasting = [k for k in sorted(beyond) if course.beyond(k, 1) in beyond or course.beyond(k, -1) in beyond]
        worst = max(lasting, default=None, key=lambda k: excess[k])
        if worst is None:
            continue
        (h, u), (g, v), at = a[worst], b[worst], course.bin_width * worst
        text = (
            f"{one} and {other} contradict each other on the step where both saw the seam: at {at:.0f} "
            f"degrees {h:.3f} ± {2 * u:.3f} mm in {one}, {g:.3f} ± {2 * v:.3f} mm in {other}, in "
            f"{len(beyond)} bins"
        )
        if severe:
            yield bar("shots-disagree", f"{text}: are they of one weld, was a wall misread in one?", other, at)
        else:
            yield warning("agreement", text, other, at)
        return


def _placing_mm(shots: Sequence[PlacedShot], hand_eye: HandEye, point: Floats, normal: Floats) -> float:
    """Standard uncertainty of the difference of two shots' places of a point, along the normal.

    The hand-eye is common to both: what moves both alike does not count. Each has a flange pose of its own.
    """
    x, (pose_mm, pose_rad) = hand_eye.flange_from_scanner, pose_sigma(hand_eye)
    common, variance = np.zeros(6), 0.0
    for sign, shot in zip((-1.0, 1.0), shots, strict=True):
        turn, place = shot.base_from_flange[:3, :3], shot.base_from_flange[:3, 3]
        in_flange = turn.T @ (point - place)
        in_scanner = x[:3, :3].T @ (in_flange - x[:3, 3])
        common += sign * (normal @ turn @ np.hstack([-x[:3, :3] @ skew(in_scanner), np.eye(3)]))
        variance += pose_mm**2 + pose_rad**2 * float(np.square(np.cross(point - place, normal)).sum())
    return math.sqrt(variance + float(common @ hand_eye.covariance @ common))
