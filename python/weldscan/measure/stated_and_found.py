"""Everything that a session says, held against the scan, against its own files and against itself.

A session is typed by people and copied by machines. Where it is wrong the walls are still there, and a number comes out
that belongs to another part: so each stated fact is compared with what shows it, and what is found is noted, warned of
or bars, by how far off it is. Every text names the cause that fits the numbers and the remedy.

Four groups, by what is needed: `held_against_itself` needs the session alone, `held_against_record` what a scan left
beside it, `held_against_scan` the segmented shots, `other_part` the points of a shot that could not be segmented.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import WeldShot, fit_cylinder
from weldscan.errors import WeldscanError
from weldscan.measure.part_views import PartView
from weldscan.records.fields import read_model
from weldscan.records.part import PartSpec
from weldscan.records.plan import planned
from weldscan.records.session import Session, ShotSpec, frame_names
from weldscan.records.shot import SHOT, Fault, ShotManifest
from weldscan.result import Finding, HandEye, bar, warning

Floats = NDArray[np.float64]

# --- the diameter. The usual delivery tolerance is 1 %; an out-of-roundness of 2 % of the diameter (the amplitude of
# its second harmonic is 0.5 % of it) bends the wall locally by three times that: 1.5 % of the diameter, 3 % of the
# radius. Beyond both together it is more likely another pipe: most neighbouring sizes are 7 % apart and more.
DIAMETER_WARNING = 0.02
DIAMETER_BAR = 0.05
# Beyond this no wall is fitted to the nominal diameter (as in the core's segmentation): nothing of it is measured.
OTHER_PIPE = 0.2
# Points that tell how strongly the part is curved; the consensus takes as long with a tenth of them.
CURVATURE_POINTS = 2000
# A pipe's radius is told by the points where it is known to a tenth: sizes ten and two times off are looked for.
CURVATURE_DOUBT = 0.1
# Residuals of a wall are waves, not noise: about a hundred count, however many points there are.
INDEPENDENT_POINTS = 100

# --- directions. The profile's bins are 2 degrees wide: from there a place on the seam is in another bin than stated.
# A pipe on its supports, a frame taught by eye: some degrees; beyond, it is another direction that was meant.
AXIS_WARNING_DEG = 2.0
AXIS_BAR_DEG = 8.0
# So near to square the stated direction does not tell any more which of the two walls is meant.
UNDECIDED_DEG = 60.0
# The mark is made square to the axis: this far from square, an axis that is 2 degrees off turns it by a degree more.
ZERO_WARNING_DEG = 30.0
# A girth weld is square to the pipe; a mitred one is inclined by half of what the bend turns there, 45 degrees at most.
SEAM_WARNING_DEG = 5.0
SEAM_BAR_DEG = 22.5
# A line through fewer stations is a guess.
LEAST_STATIONS = 5

# --- the wall. Pipes of plant have t/D of 1/400 (large, thin) to 1/4 (small, for high pressure).
THIN_WARNING, THIN_BAR = 1 / 420, 1 / 600
THICK_WARNING, THICK_BAR = 0.3, 0.4
# Walls that are joined differ by a wall's own thickness; ten times is a slip of the decimal point.
UNEQUAL_WARNING, UNEQUAL_BAR = 2.5, 5.0

# --- the robot. The longest arm there is: FANUC M-2000iA/1700L. KUKA's names carry the reach of theirs.
LONGEST_REACH_MM = 4700.0
MODEL_REACH = re.compile(r"\bR\s?(\d{3,4})\b")
# The foot is below the shoulder by up to two fifths of the reach (KR AGILUS: 400 of 1100), the flange beyond the
# wrist's centre, which the reach counts to, by up to 250 mm.
FOOT_PART, FLANGE_MM = 0.4, 250.0
LARGEST_ANGLE_DEG = 360.0
# A scanner is held by its flange: a metre is more than any bracket, two are a wrong unit.
BRACKET_WARNING_MM, BRACKET_BAR_MM = 1000.0, 2000.0

# --- what a scan recorded. Numbers that went through a text with fewer digits, and no more.
RECORD_TOLERANCE = 1e-3

# What a factor between two lengths usually is.
FACTORS = (
    (2.0, "twice as much: was the radius given instead of the diameter?", "half as much: is it a diameter twice over?"),
    (10.0, "ten times as much: a decimal point, or centimetres?", "a tenth: a decimal point?"),
    (25.4, "25.4 times as much: inches instead of millimetres?", "1/25.4 of it: millimetres taken for inches?"),
    (1000.0, "a thousand times as much: metres?", "a thousandth: micrometres?"),
)


# --- the session alone ------------------------------------------------------------------------------------------------


def held_against_itself(session: Session) -> list[Finding]:
    """What a session contradicts in itself: poses out of reach, walls that no pipe has, a hand-eye that no bracket is.

    Args:
        session: as `read_session` gave it, with a part.

    Returns:
        Findings with the codes `pose`, `description` and `hand-eye`; none for a session that may be.
    """
    found = [*_poses(session)]
    if session.part is not None:
        found += _walls(session.part)
    return found


def _poses(session: Session) -> Iterator[Finding]:
    model = session.robot.model if session.robot is not None else ""
    named = MODEL_REACH.search(model)
    reach = float(named[1]) if named else LONGEST_REACH_MM
    farthest = (1 + FOOT_PART) * reach + FLANGE_MM
    whose = f"the {model}" if named else "any industrial arm"
    for shot in session.shots:
        pose = shot.flange_pose
        if pose is None:
            continue
        away = math.hypot(pose.X, pose.Y, pose.Z)
        if away > farthest:
            unit = " (are X, Y and Z in micrometres?)" if away / 1000 < farthest and away > 1e5 else ""
            yield bar(
                "pose",
                f"{shot.name}: its flange pose is {away:.4g} mm from the robot's base, while {whose} reaches "
                f"{farthest:.0f} mm at most{unit}: correct flange_pose",
                shot.name,
            )
        angle = max(abs(pose.A), abs(pose.B), abs(pose.C))
        if angle > LARGEST_ANGLE_DEG:
            yield bar(
                "pose",
                f"{shot.name}: an angle of its flange pose is {angle:.4g} degrees, while a controller gives -180 to "
                "180: correct flange_pose",
                shot.name,
            )


def _walls(part: PartSpec) -> Iterator[Finding]:
    ratio = part.wall_thickness / part.outside_diameter
    said = (
        f"part.wall_thickness is {part.wall_thickness:g} mm and part.outside_diameter {part.outside_diameter:g} mm: "
        f"no usual pipe has so {'thin' if ratio < 0.1 else 'thick'} a wall (t/D {ratio:.4f}, pipes have 0.0025 to "
        "0.25); the thickness sets the limit: check both, their unit and their decimal point"
    )
    if not THIN_BAR <= ratio <= THICK_BAR:
        yield bar("description", said)
    elif not THIN_WARNING <= ratio <= THICK_WARNING:
        yield warning("description", said)
    if part.other_wall_thickness is not None:
        unequal = part.other_wall_thickness / part.wall_thickness
        unequal = max(unequal, 1 / unequal)
        if unequal > UNEQUAL_WARNING:
            text = (
                f"part.other_wall_thickness is {part.other_wall_thickness:g} mm and part.wall_thickness "
                f"{part.wall_thickness:g} mm, {unequal:.3g} times apart: check the decimal points"
            )
            yield bar("description", text) if unequal > UNEQUAL_BAR else warning("description", text)


# --- what a scan left beside it ---------------------------------------------------------------------------------------


def held_against_record(session: Session, faults: Sequence[Fault]) -> list[Finding]:
    """What differs between `session.json` and the files that the scan left: each `shot.json`, `plan.json`, the images.

    Args:
        session: as `read_session` gave it.
        faults: of its folder, as `weldscan.records.shot.faults` found them.

    Returns:
        Bars `shot-missing`, `shot-altered` and `description`. None for a session that no scan wrote.

    Raises:
        InputError: the plan cannot be read.
    """
    found = [bar(fault.code, f"{fault.shot}: {fault.reason}", fault.shot) for fault in faults]
    at_fault = {fault.shot for fault in faults}
    manifests = {shot.name: session.folder / "shots" / shot.name / SHOT for shot in session.shots}
    recorded = {name for name, path in manifests.items() if path.is_file()}
    for shot in session.shots:
        if shot.name in at_fault:
            continue
        if shot.name in recorded:
            found += _against_manifest(session, shot)
        elif recorded:
            text = f"{shot.name}: its {SHOT} is missing, while other shots have theirs: nobody knows what it shows"
            found.append(bar("shot-altered", text, shot.name))
    plan = planned(session.folder)
    return found if plan is None else [*found, *_against_plan(session, plan, at_fault)]


def _against_manifest(session: Session, shot: ShotSpec) -> Iterator[Finding]:
    manifest = read_model(session.folder / "shots" / shot.name / SHOT, ShotManifest)
    told, taken = (one.model_dump(mode="json") for one in (shot, manifest.shot))
    differences = list(_differences(told, taken))
    if differences:
        text = f"{shot.name}: session.json is not what the scan recorded in {SHOT}: {_listed(differences)}"
        yield bar("shot-altered", text, shot.name)
    unknown = [name for row in frame_names(session, shot) for name in row if name not in manifest.files]
    if unknown:
        more = f" and {len(unknown) - 1} more" if len(unknown) > 1 else ""
        yield bar("shot-altered", f"{shot.name}: {SHOT} does not know of {unknown[0]}{more}", shot.name)


def _against_plan(session: Session, plan: Session, at_fault: set[str]) -> Iterator[Finding]:
    for name in ("part", "artefact", "scanner", "fringes", "robot", "hand_eye"):
        told, meant = (getattr(one, name) for one in (session, plan))
        if name == "hand_eye" and isinstance(meant, str):
            # The plan names a file, which is in the session's place by now.
            continue
        told, meant = ({name: _plain(one)} for one in (told, meant))
        differences = list(_differences(told, meant))
        if differences:
            why = "; the wall thickness sets the limit" if any("thickness" in d for d in differences) else ""
            yield bar("description", f"session.json is not what was scanned by plan.json: {_listed(differences)}{why}")
    there, meant_shots = {shot.name for shot in session.shots}, {shot.name for shot in plan.shots}
    for name in sorted(meant_shots - there - at_fault):
        yield bar("shot-missing", f"{name}: is planned, but session.json does not list it", name)
    for name in sorted(there - meant_shots):
        yield bar("shot-altered", f"{name}: is in session.json, but was not planned", name)


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value.model_dump(mode="json", by_alias=True) if hasattr(value, "model_dump") else value


def _differences(told: Any, meant: Any, path: str = "") -> Iterator[str]:
    """Where two documents differ, in words."""
    if isinstance(told, Mapping) and isinstance(meant, Mapping):
        for key in dict.fromkeys((*told, *meant)):
            yield from _differences(told.get(key), meant.get(key), f"{path}.{key}" if path else key)
    elif isinstance(told, list) and isinstance(meant, list) and len(told) == len(meant):
        for index, pair in enumerate(zip(told, meant, strict=True)):
            yield from _differences(*pair, f"{path}.{index}")
    elif isinstance(told, float | int) and isinstance(meant, float | int) and type(told) is not bool:
        if abs(told - meant) > max(RECORD_TOLERANCE * min(1.0, abs(meant)), 1e-9):
            yield f"{path} is {told:g}, recorded {meant:g}"
    elif told != meant:
        yield f"{path} is {_short(told)}, recorded {_short(meant)}"


def _short(value: Any) -> str:
    text = "absent" if value is None else str(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def _listed(differences: Sequence[str]) -> str:
    more = f" and {len(differences) - 3} more" if len(differences) > 3 else ""
    return ", ".join(differences[:3]) + more


# --- the scan ---------------------------------------------------------------------------------------------------------


def held_against_scan(session: Session, views: Sequence[PartView], hand_eye: HandEye | None) -> list[Finding]:
    """What the segmented shots contradict of the description.

    Args:
        session: with a part.
        views: its segmented part shots.
        hand_eye: through which they were placed; None without a robot.

    Returns:
        Findings with the codes `description` and `hand-eye`.
    """
    part = session.part
    if part is None:
        return []
    found = [*_bracket(hand_eye)]
    for view in views:
        found += _diameter(view, part)
    if views and part.axis_base is not None and part.zero_base is not None:
        found += _axis(views, part.axis_base, part.zero_base, session.has_robot)
    for view in views:
        found += _seam(view, part)
    return found


def _bracket(hand_eye: HandEye | None) -> Iterator[Finding]:
    if hand_eye is None:
        return
    length = float(np.linalg.norm(hand_eye.flange_from_scanner[:3, 3]))
    if length > BRACKET_WARNING_MM:
        text = (
            f"hand_eye: the scanner would sit {length:.4g} mm from the flange, further than any bracket holds it: is "
            "flange_from_scanner in millimetres, and of this cell?"
        )
        yield bar("hand-eye", text) if length > BRACKET_BAR_MM else warning("hand-eye", text)


def _diameter(view: PartView, part: PartSpec) -> Iterator[Finding]:
    """The fitted radius; where the arc does not determine it the nominal one was taken, and nothing is told."""
    if not view.shot.radius_fitted:
        return
    seen, told = 2 * view.shot.radius_mm, part.outside_diameter
    off = abs(seen / told - 1)
    if off > DIAMETER_WARNING:
        text = f"{view.name}: {_measures(seen, told)}; correct part.outside_diameter, or scan the part that is meant"
        yield (bar("description", text, view.name) if off > DIAMETER_BAR else warning("description", text, view.name))


def _measures(seen_mm: float, told_mm: float) -> str:
    factor = seen_mm / told_mm
    likely = ""
    for times, more, less in FACTORS:
        if abs(math.log(factor / times)) < math.log(1 + OTHER_PIPE / 2):
            likely = f", {more}"
        elif abs(math.log(factor * times)) < math.log(1 + OTHER_PIPE / 2):
            likely = f", {less}"
    said = likely or ": was another pipe scanned, or is it out of round?"
    return f"the pipe in view measures {seen_mm:.4g} mm across, but part.outside_diameter is {told_mm:g} mm{said}"


def _axis(views: Sequence[PartView], axis: Sequence[float], zero: Sequence[float], robot: bool) -> Iterator[Finding]:
    told, mark = (np.asarray(v, dtype=np.float64) / np.linalg.norm(v) for v in (axis, zero))
    seen = np.mean([view.seam_in_base.across for view in views], axis=0)
    seen /= np.linalg.norm(seen)
    off = _angle_deg(told, seen)
    if off > AXIS_WARNING_DEG:
        frame = "base" if robot else "the scanner's frame"
        text = f"part.axis_base is {off:.1f} degrees off the pipe in view, whose axis is {_vector(seen)} in {frame}"
        if off > UNDECIDED_DEG:
            text += "; so far off it does not tell which wall is the reference: they may be exchanged"
        if abs(float(mark @ seen)) > math.cos(math.radians(AXIS_BAR_DEG)):
            text += "; zero_base is along the pipe: were the two exchanged?"
        elif robot and off > AXIS_BAR_DEG:
            text += "; if axis_base is right, the hand-eye or the flange poses are another cell's"
        text += ": correct axis_base"
        yield bar("description", text) if off > AXIS_BAR_DEG else warning("description", text)
    lean = 90 - math.degrees(math.acos(min(1.0, abs(float(mark @ seen)))))
    if lean > ZERO_WARNING_DEG:
        yield warning(
            "description",
            f"part.zero_base is {lean:.0f} degrees from square to the pipe's axis: the 0 degree mark is where its part "
            "across the axis points, and angles are counted from there; give it square to the axis",
        )


def _seam(view: PartView, part: PartSpec) -> Iterator[Finding]:
    """How far from square to the pipe the bead runs."""
    course, sections = view.shot.seam.course, view.shot.sections
    known = np.isfinite(sections["toes_mm"]).all(axis=1)
    if known.sum() < LEAST_STATIONS:
        return
    places = np.array([course.at(float(reading)) for reading in sections["along"][known]])
    # From the bead's own middle, so that none of it jumps by a turn.
    at = course.along_mm(1.0) * course.places_apart(places, course.middle(places))
    place = sections["toes_mm"][known].mean(axis=1)
    if np.ptp(at) < view.shot.bead_width_mm:
        return
    # The median slope of all pairs (Theil and Sen): a toe misread on a stretch of the arc is no inclined seam.
    i, j = np.triu_indices(len(at), 1)
    lean = abs(math.degrees(math.atan(float(np.median((place[j] - place[i]) / (at[j] - at[i]))))))
    if lean > SEAM_WARNING_DEG:
        text = (
            f"{view.name}: the seam in view is {lean:.0f} degrees from square to the pipe, but part.joint is "
            f"{part.joint!r}: is this the joint, is axis_base right?"
        )
        yield (bar("description", text, view.name) if lean > SEAM_BAR_DEG else warning("description", text, view.name))


def other_part(
    points_mm: Floats,
    part: PartSpec,
    axis: Sequence[float] | None = None,
    segmented: WeldShot | None = None,
) -> str | None:
    """Why nothing is to be measured in a shot: its points are of another pipe than the one described, or lie otherwise.

    The cylinder of the points is found without the description. It is only looked for where the segmentation failed,
    or did not confirm the diameter.

    Args:
        points_mm: (H, W, 3), NaN where there is no point.
        part: as described.
        axis: the stated direction of the pipe, in the frame of the points; None: not stated.
        segmented: what came of the description; None where nothing did.

    Returns:
        The reason, naming the cause that fits the numbers; None where the points agree or do not tell.
    """
    if segmented is not None and segmented.radius_fitted:
        return None
    points = points_mm.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    try:
        fit = fit_cylinder(points[:: max(1, len(points) // CURVATURE_POINTS)], robust=True)
    except WeldscanError:
        return None
    count = CURVATURE_POINTS if fit.inliers is None else len(fit.inliers)
    doubt = math.sqrt(max(float(fit.covariance[-1, -1]), 0.0) * max(1.0, count / INDEPENDENT_POINTS))
    if doubt > CURVATURE_DOUBT * fit.radius_mm:
        return None
    seen, told = 2 * fit.radius_mm, part.outside_diameter
    if abs(seen / told - 1) > OTHER_PIPE:
        return f"{_measures(seen, told)}; correct part.outside_diameter, or scan the part that is meant"
    if axis is None or segmented is not None:
        return None
    off = _angle_deg(np.asarray(axis) / np.linalg.norm(axis), fit.axis)
    off = min(off, 180 - off)
    if off <= AXIS_BAR_DEG:
        return None
    return (
        f"part.axis_base is {off:.0f} degrees off the pipe in view, and no weld is found along it: correct axis_base; "
        "if it is right, the hand-eye or the flange pose is another cell's"
    )


def not_used(session: Session, left_out: Sequence[tuple[str, str]], found: Sequence[Finding]) -> list[Finding]:
    """A bar for each part shot that gave nothing: its arc of the seam is missing.

    Args:
        session: with its part shots.
        left_out: the shots that could not be used, with the reason.
        found: so far: a shot that bars already is not named twice.
    """
    barred = {finding.shot for finding in found if finding.code in ("shot-altered", "shot-missing")}
    reasons = dict(reversed(left_out))
    return [
        bar(
            "shot-left-out",
            f"{shot.name}: could not be used, and its part of the seam is missing: {reasons[shot.name]}",
            shot.name,
        )
        for shot in session.part_shots
        if shot.name in reasons and shot.name not in barred
    ]


def _angle_deg(a: Floats, b: Floats) -> float:
    return math.degrees(math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b)))


def _vector(v: Floats) -> str:
    return "[" + ", ".join(f"{value:.3f}" for value in np.round(v, 3) + 0.0) + "]"
