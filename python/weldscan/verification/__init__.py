"""Acceptance and reverification of a scanner: `weldscan verify`, by VDI/VDE 2634 part 2 and ISO 10360-13.

    PF = range of the radial residuals to the least-squares sphere with free radius      probing error, form
    PS = D of that sphere - D calibrated                                                 probing error, size
    SD = measured - calibrated distance of two centres (spheres of calibrated radius)    sphere-spacing error
    F  = range of the residuals to the least-squares plane                               flatness error

Each at every position that the session has; the one furthest from zero is judged against its limit (MPE) with the
guard band of ISO 14253-1. Every pixel that looks at the standard counts: what the scanner gave a point for is part of
the result, however far off. What the standard is - which pixels look at it - is decided by geometry alone.

`weldscan.records.history` keeps what was found, `history.py` says what it means.
"""

from __future__ import annotations

import math
import os
import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import __version__
from weldscan.calibration.artefact import PlateMismatch
from weldscan.errors import GeometryError, InputError, Unreadable
from weldscan.measure.journal import Journal
from weldscan.measure.scanner_standing import CLOCK_SKEW, fringes_of, scanner_id
from weldscan.measure.session_hand_eye import base_from_flange
from weldscan.measure.session_points import PointReader, Progress
from weldscan.records.fields import moment
from weldscan.records.session import Session, read_session
from weldscan.records.shot import left_out, read_manifest
from weldscan.result import BallError, Characteristic, PlaneError, SpacingError, Verdict, Verification, warning
from weldscan.verification.form import FormError, flatness_error, noise_range, probing_error
from weldscan.verification.limits import VerificationLimits, limits_from, read_limits
from weldscan.verification.standards import ball_errors, plane_error, touched_distance_u_mm

__all__ = [
    "FormError",
    "VerificationLimits",
    "flatness_error",
    "judge_characteristic",
    "noise_range",
    "probing_error",
    "read_limits",
    "verify",
]

Floats = NDArray[np.float64]

TITLES = {
    "PF": "probing error, form",
    "PS": "probing error, size",
    "SD": "sphere-spacing error",
    "F": "flatness error",
}
# Two planes are at the same place when nothing of them moved by more than this share of their size; two spheres, when
# they overlap by more than half: one radius.
SAME_PLACE = 0.1
# What an artefact without a certificate is taken for, k = 2. A ceramic ball of grade G100 by ISO 3290 is round to
# 2.5 um and its diameter varies by as much again (from memory: unverified). A lapped or ground plane of that size is
# flat to some micrometres.
BALL_FORM_MM = 0.0025
BALL_DIAMETER_U_MM = 0.005
PLANE_FLATNESS_MM = 0.005
# VDI/VDE 2634 part 2, from memory: the plane's length as a share of the volume's diagonal.
HALF_FIELD = 0.5


def places(anchors: Sequence[Floats], apart_mm: float) -> int:
    """How many of the positions are distinct: some point of each is `apart_mm` or more from its fellow in the others.

    >>> places([np.zeros((1, 3)), np.ones((1, 3)), np.full((1, 3), 9.0)], 5.0)
    2
    """
    kept: list[Floats] = []
    for each in anchors:
        if all(np.linalg.norm(each - other, axis=-1).max() >= apart_mm for other in kept):
            kept.append(each)
    return len(kept)


def _stand(plane: PlaneError) -> Floats:
    """Where a plane stands and how it leans: its middle, and the tip of a normal half as long as the plane."""
    a, b, c, _ = plane.corners_mm
    normal = np.cross(b - a, c - b)
    normal *= -np.sign(normal @ plane.centre_mm) * max(plane.size_mm) / 2 / np.linalg.norm(normal)
    return np.array([plane.centre_mm, plane.centre_mm + normal])


def judge_characteristic(
    name: str,
    values_mm: Sequence[float],
    where: Sequence[str],
    limits: VerificationLimits,
    *,
    u_mm: float,
    positions: int,
    points: Sequence[int] = (),
    lost: Sequence[str] = (),
    beside: str = "",
) -> Characteristic:
    """One characteristic over all positions, judged by the value furthest from zero.

    FAIL beyond the limit plus the guard band, even where positions are missing; NOT MEASURED with a value that is not
    a number, too few distinct positions, or one that was lost; PASS within the limit less the guard band; else
    INCONCLUSIVE. NOT ASSESSABLE without a limit.
    """
    limit, required = limits.limit_mm(name), int(getattr(limits.positions, name.lower()))
    values = np.asarray(values_mm, dtype=float)
    finite = bool(values.size and np.isfinite(values).all())
    known = values[np.isfinite(values)]
    worst = int(np.nanargmax(np.abs(values))) if known.size else None
    value = None if worst is None else float(values[worst])
    guard = u_mm if limits.decision == "guarded" else 0.0
    if limit is None:
        verdict, reason = Verdict.NOT_ASSESSABLE, "no limit was given"
    elif value is not None and abs(value) > limit + guard:
        verdict, reason = Verdict.FAIL, f"{abs(value):.4f} mm is more than {limit:g} + {guard:.4f} mm"
    elif lost:
        more = f" (and {len(lost) - 1} more)" if len(lost) > 1 else ""
        verdict, reason = Verdict.NOT_MEASURED, f"not measured at every position: {lost[0]}{more}"
    elif not finite:
        verdict, reason = Verdict.NOT_MEASURED, "no shot shows it" if not values.size else "a value is not a number"
    elif positions < required:
        verdict, reason = Verdict.NOT_MEASURED, f"{positions} distinct positions; {required} are needed"
    elif not math.isfinite(guard) or value is None or abs(value) > limit - guard:
        verdict, reason = Verdict.INCONCLUSIVE, f"nearer to {limit:g} mm than the test value uncertainty {guard:.4f} mm"
    else:
        verdict, reason = Verdict.PASS, f"{abs(value):.4f} mm is at most {limit:g} - {guard:.4f} mm"
    return Characteristic(
        name=name,
        title=TITLES[name],
        value_mm=value,
        where="" if worst is None else where[worst],
        mean_mm=float(known.mean()) if known.size else None,
        std_mm=float(known.std(ddof=1)) if known.size > 1 else None,
        positions=positions,
        required_positions=required,
        points=int(np.median(points)) if len(points) else None,
        limit_mm=limit,
        u_mm=u_mm,
        verdict=verdict,
        reason=reason + (f" ({beside})" if beside else ""),
    )


def _other_ranges(standards: Sequence[BallError | PlaneError], judged: float) -> str:
    """The largest ranges over the other shares of the points, and how many points are wild."""
    if not standards:
        return ""
    every = {
        1.0: [s.form_all_mm if isinstance(s, BallError) else s.flatness_all_mm for s in standards],
        0.997: [s.form_997_mm if isinstance(s, BallError) else s.flatness_997_mm for s in standards],
        0.95: [s.form_95_mm if isinstance(s, BallError) else s.flatness_95_mm for s in standards],
    }
    parts = [f"{max(values):.4f} mm over {100 * share:g} %" for share, values in every.items() if share != judged]
    wild = sum(each.wild for each in standards)
    if wild:
        parts.append(f"{wild} of {sum(each.points for each in standards)} points far off the surface")
    return f"judged over {100 * judged:g} % of the points; {', '.join(parts)}"


def _date(session: Session, date: str | None, now: datetime) -> tuple[datetime, str]:
    """When the session was recorded, and how that is known."""
    if date is not None:
        found, source = moment(date, "date"), "given"
    else:
        started = []
        for shot in (*session.artefact_shots, *session.plane_shots):
            folder = session.folder / "shots" / shot.name
            if (folder / "shot.json").is_file():
                try:
                    started.append(moment(str(read_manifest(folder).record["started"]), f"{folder}/shot.json"))
                except Unreadable:
                    raise
                except (InputError, KeyError):
                    continue
        if not started:
            return now, "day of evaluation: the session does not say when it was recorded"
        found, source = min(started), "first shot of the session"
    if found > now + CLOCK_SKEW:
        raise InputError(f"date: {found.isoformat(timespec='seconds')} lies in the future")
    return found, source


def verify(
    session_folder: str | os.PathLike[str],
    limits: VerificationLimits | Mapping[str, Any] | None = None,
    *,
    date: str | None = None,
    progress: Progress | None = None,
) -> Verification:
    """PF, PS, SD and F of a scanner at every position of a session, with a verdict each.

    Every artefact shot gives three PF, PS and SD, every plane shot one F. A shot that does not show what it should
    leaves the characteristic NOT MEASURED: positions are not chosen by whether they went well.

    Args:
        session_folder: a `weldscan-session/1` folder with shots of the artefact, of a plane, or both; poses are not
            needed.
        limits: what the scanner must keep; without any, everything is measured and nothing judged.
        date: when the session was recorded, ISO 8601; by default what its shots say, else now.
        progress: called with (done, total, what).

    Returns:
        Verification.

    Raises:
        InputError: a file or field is wrong, there are no shots for it, the date lies in the future, or the plate in
            view is not the one described in any shot.

    Example:
        >>> import tempfile
        >>> from weldscan import verify
        >>> from weldscan.simulated import simulate_session
        >>> folder = tempfile.mkdtemp() + "/session"
        >>> truth = simulate_session(folder)
        >>> found = verify(folder, {"pf_mm": 0.5, "sd_mm": 0.2})
        >>> print(found.verdict, found["SD"].positions >= 7, abs(found["SD"].value_mm) < 0.1)
        PASS True True
    """
    kept = limits_from(limits)
    session = read_session(session_folder)
    where = session.folder / "session.json"
    if not session.artefact_shots and not session.plane_shots:
        raise InputError(f"{where}: shots: none is of the artefact or of a plane, so there is nothing to verify by")
    now = datetime.now(UTC)
    recorded, date_from = _date(session, date, now)
    read, noticed = PointReader(session, progress), Journal()
    lens = read.scanner.camera
    broken = dict(left_out(session.folder))
    balls: list[BallError] = []
    spacings: list[SpacingError] = []
    planes: list[PlaneError] = []
    lost: dict[str, str] = {}
    mistaken: PlateMismatch | None = None
    for shot in (*session.artefact_shots, *session.plane_shots):
        if shot.name in broken:
            lost[shot.name] = broken[shot.name]
            continue
        scan = read(shot, len(noticed.shots))
        points, noticed = scan.points_mm, noticed + scan.noticed
        try:
            if shot.of == "plane":
                planes.append(plane_error(shot.name, points, lens, session.plane, kept.share))
            else:
                assert session.artefact is not None  # the session's models see to it
                pose = None if shot.flange_pose is None else base_from_flange(shot)
                found = ball_errors(shot.name, points, lens, session.artefact, pose, kept.share)
                balls.extend(found[0])
                spacings.extend(found[1])
        except PlateMismatch as error:
            mistaken, lost[shot.name] = error, str(error)
        except GeometryError as error:
            lost[shot.name] = scan.reading.why_dark or str(error)
    if mistaken is not None and not balls:
        raise PlateMismatch(f"{where}: {mistaken}")
    lost.update({name: why for name, why in broken.items() if name not in lost})
    characteristics, assumed = _characteristics(session, kept, balls, spacings, planes, lost)
    short = min((plane.of_field for plane in planes), default=1.0)
    if short < HALF_FIELD:
        text = f"a plane spans {100 * short:.0f} % of the field's diagonal: VDI/VDE 2634-2 asks for half (unverified)"
        noticed += Journal((warning("verification", text),))
    valid_until = recorded + timedelta(days=kept.validity_days)
    return Verification(
        session=session.name,
        scanner=scanner_id(session.scanner),
        date=recorded.isoformat(timespec="seconds"),
        date_from=date_from,
        valid_until=valid_until.isoformat(timespec="seconds"),
        characteristics=characteristics,
        balls=tuple(balls),
        spacings=tuple(spacings),
        planes=tuple(planes),
        lost=tuple(lost.items()),
        assumed=assumed,
        warnings=tuple(finding.text for finding in noticed.findings),
        limits=kept.model_dump(exclude={"history"}),
        fringes=fringes_of(session),
        software={
            "name": "weldscan",
            "version": __version__,
            "python": platform.python_version(),
            "numpy": np.__version__,
            "session_sha256": session.sha256,
            **({} if session.scanner.id is None else {"scanner_calibration": session.scanner.id}),
        },
    )


def _characteristics(
    session: Session,
    limits: VerificationLimits,
    balls: Sequence[BallError],
    spacings: Sequence[SpacingError],
    planes: Sequence[PlaneError],
    lost: Mapping[str, str],
) -> tuple[tuple[Characteristic, ...], tuple[str, ...]]:
    """All four, judged; and what had to be taken for the artefact."""
    artefact, plane = session.artefact, session.plane
    assumed: list[str] = []
    kinds = {shot.name: shot.of for shot in session.shots}

    def certified(value: float | None, taken: float, what: str, used: bool) -> float:
        if value is not None:
            return value
        if used:
            assumed.append(f"{what} is not in the session: taken for {taken:.4f} mm")
        return taken

    form_u = certified(artefact.sphere_form if artefact else None, BALL_FORM_MM, "artefact.sphere_form", bool(balls))
    size_u = certified(
        artefact.sphere_diameter_u if artefact else None,
        BALL_DIAMETER_U_MM,
        "artefact.sphere_diameter_u (k = 2)",
        bool(balls),
    )
    flat_u = certified(plane.flatness if plane else None, PLANE_FLATNESS_MM, "plane.flatness", bool(planes))
    spacing_u = 0.0 if artefact is None else touched_distance_u_mm(artefact)
    if artefact is not None and artefact.distances is not None:
        spacing_u = certified(artefact.distances_u, spacing_u, "artefact.distances_u (k = 2)", bool(spacings))
    elif spacings:
        assumed.append(
            "artefact.distances are not in the session: SD is held against the distances that the probe touched, "
            f"U = {spacing_u:.3f} mm (k = 2), which are no calibration"
        )
    on_balls = [f"{n}: {why}" for n, why in lost.items() if kinds.get(n, "artefact") == "artefact"]
    on_planes = [f"{n}: {why}" for n, why in lost.items() if kinds.get(n, "plane") == "plane"]
    at_balls = [f"{b.shot}, sphere {b.sphere}" for b in balls]
    radius = artefact.sphere_diameter / 2 if artefact else 0.0
    sites = places([b.centre_mm[None] for b in balls], radius)
    pairs = places([s.centres_mm for s in spacings], radius)
    longest = max((max(p.size_mm) for p in planes), default=0.0)
    flats = places([_stand(p) for p in planes], SAME_PLACE * longest)
    forms, sizes = [b.form_mm for b in balls], [b.size_mm for b in balls]
    at_spacings = [f"{s.shot}, spheres {s.spheres[0]}-{s.spheres[1]}" for s in spacings]

    def judged(
        name: str,
        values: Sequence[float],
        where: Sequence[str],
        u_mm: float,
        positions: int,
        standards: Sequence[BallError | PlaneError] = (),
    ) -> Characteristic:
        return judge_characteristic(
            *(name, values, where, limits),
            u_mm=u_mm,
            positions=positions,
            points=[each.points for each in standards],
            lost=on_planes if name == "F" else on_balls,
            beside="" if name in ("PS", "SD") else _other_ranges(standards, limits.share),
        )

    return (
        judged("PF", forms, at_balls, form_u, sites, balls),
        judged("PS", sizes, at_balls, size_u, sites, balls),
        judged("SD", [s.error_mm for s in spacings], at_spacings, spacing_u, pairs),
        judged("F", [p.flatness_mm for p in planes], [p.shot for p in planes], flat_u, flats, planes),
    ), tuple(assumed)
