"""The whole method, top to bottom: fringe images in, step and verdict out.

Every line of `inspect` is one arrow of the flow; what stands below it only fits the pieces together.
"""

from __future__ import annotations

import math
import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import WeldShot, WeldStep, __version__, measure_step, place_shots, segment_weld
from weldscan.calibration.hand_eye import point_uncertainty_mm, pose_sigma
from weldscan.errors import GeometryError, InputError
from weldscan.measure.calibrated_part import about_region, held_against_calibration, mostly_outside
from weldscan.measure.calibration_margin import (
    CalibrationMargin,
    Unevenness,
    calibration_above,
    calibration_margin,
    stated_covariance,
)
from weldscan.measure.calibration_unknowns import calibration_unknowns
from weldscan.measure.journal import Journal, SetPhaseError, ShotReading, took
from weldscan.measure.observable_terms import seam_terms
from weldscan.measure.paper_method import paper_step
from weldscan.measure.part_views import PartView
from weldscan.measure.scanner_standing import standing_of
from weldscan.measure.seam_coverage import EdgeProfile, Seam, edge_profile, seam_of
from weldscan.measure.session_hand_eye import base_from_flange, hand_eye_of
from weldscan.measure.session_points import Compensate, PointReader, Progress
from weldscan.measure.shot_agreement import agreement, complaint, copies, shots_agree
from weldscan.measure.stated_and_found import (
    held_against_itself,
    held_against_record,
    held_against_scan,
    not_used,
    other_part,
)
from weldscan.norms import judge, load_norm
from weldscan.records.part import PartSpec
from weldscan.records.response import Response, read_response
from weldscan.records.session import Session, ShotSpec, read_session
from weldscan.records.shot import faults as faults_of
from weldscan.result import (
    WHOLE_TURN_DEG,
    BudgetLine,
    Finding,
    HandEye,
    Histogram,
    Inspection,
    PartCloud,
    ScannerRecord,
    ShotAgreement,
    Standing,
    StepResult,
    bar,
    note,
    warning,
)

Floats = NDArray[np.float64]
DEFAULT_NORMS = ("pnae-g-7-010-89",)
METHODS = ("surface", "paper")
CLOUDS = ("cells", "all")
# By contract: beyond so many placed points the cloud holds one of every cell of this size.
MOST_POINTS, CELL_MM = 4_000_000, 0.15
ReaderOf = Callable[[Session, Progress | None, Compensate], PointReader]


def inspect(
    folder: str | os.PathLike[str],
    *,
    method: str = "surface",
    norms: Sequence[str] = DEFAULT_NORMS,
    history: str | os.PathLike[str] | None = None,
    accept_verification: str | None = None,
    response: str | os.PathLike[str] | Response = "auto",
    required_coverage_deg: float | None = None,
    cloud: str = "cells",
    progress: Progress | None = None,
    reader: ReaderOf = PointReader,
) -> Inspection:
    """The step of a weld with its uncertainty and verdicts, from a session folder.

    Args:
        folder: a `weldscan-session/1` folder (docs/formats.md).
        method: which number is judged: `surface` (the largest step around the seam) or `paper` (the paper's histogram).
        norms: ids as `weldscan.norms.norm_ids()` lists them.
        history: of the scanner's verifications; by default the one that the session names or has beside it. Where
            there is one, the last verification of this scanner must have passed and be valid, else nothing is judged.
        accept_verification: the reason for which the scanner is relied on whatever its history says.
        response: of the projector. `auto`: what the fringes themselves show above the noise is taken off their phase;
            `off`: nothing; or a response, or the file of one (`weldscan calibrate response`), for patterns that were
            not corrected.
        required_coverage_deg: how much of the seam must be seen for a PASS, 360 for all of it; by default what the
            session's `part.required_coverage_deg` says.
        cloud: `all`: every point that was measured is in `Inspection.cloud`; `cells`: of more than 4 million one of
            every cell of 0.15 mm of the unrolled part, that of the first shot that saw it.
        progress: called with (done, total, what) while it works.
        reader: makes what turns a shot into points, from the session, `progress` and what to do about the response: by
            default from the shot's images.

    Returns:
        Inspection. What could not be measured has `step` None and verdicts NOT MEASURED with the reason.

    Raises:
        InputError: a file, a field or an argument is wrong, or the plate is not the one described.

    Example:
        >>> import tempfile
        >>> from weldscan import inspect
        >>> from weldscan.simulated import simulate_session
        >>> folder = tempfile.mkdtemp() + "/session"
        >>> truth = simulate_session(folder)
        >>> result = inspect(folder)
        >>> abs(result.step.max_abs_mm - abs(truth["step_mm"]["max_abs"])) < result.step.expanded_uncertainty_mm
        True
    """
    run = _Run(
        folder, method, norms, response, progress, history, accept_verification, required_coverage_deg, cloud, reader
    )
    noticed = run.noticed
    # 1-4  the three-sphere plate in every artefact shot: where the scanner sits on the flange
    hand_eye, more = hand_eye_of(run.read, run.unusable)
    noticed += more
    # 5-6  every part shot: its points, its place in base, reference wall, other wall and bead
    views, more = run.part_views(hand_eye, len(noticed.shots))
    noticed += more
    # 7    the step: all shots in one model, each against its own reference wall; the surfaces beside the toes; what
    #      became of every pixel; and the paper's chain
    measured, more = run.measure(views, hand_eye)
    noticed += more
    # 8    the verdict
    return run.judged(measured, hand_eye, noticed)


@dataclass(frozen=True, eq=False)
class _Measured:
    """What all part shots together gave."""

    step: StepResult | None = None
    cloud: PartCloud | None = None
    seam: Seam | None = None
    calibration: CalibrationMargin | None = None
    agreement: tuple[ShotAgreement, ...] = ()


class _Run:
    """One inspection: what was asked, the session, and what that says before anything is measured."""

    def __init__(
        self,
        folder: str | os.PathLike[str],
        method: str,
        norms: Sequence[str],
        response: str | os.PathLike[str] | Response,
        progress: Progress | None,
        history: str | os.PathLike[str] | None,
        accept_verification: str | None,
        required_coverage_deg: float | None,
        cloud: str,
        reader: ReaderOf,
    ) -> None:
        if cloud not in CLOUDS:
            raise InputError(f"cloud: must be one of {', '.join(CLOUDS)}, got {cloud!r}")
        self.cloud = cloud
        if method not in METHODS:
            raise InputError(f"method: must be one of {', '.join(METHODS)}, got {method!r}")
        if required_coverage_deg is not None and not 0 < required_coverage_deg <= WHOLE_TURN_DEG:
            raise InputError(f"required_coverage_deg: must be above 0 and at most 360, got {required_coverage_deg!r}")
        self.required_coverage_deg = required_coverage_deg
        for norm in norms:
            load_norm(norm)
        self.session = read_session(folder)
        if self.session.part is None or not self.session.part_shots:
            raise InputError(f"{self.session.folder / 'session.json'}: shots: none is of the part")
        self.part: PartSpec = self.session.part
        self.method, self.norms = method, tuple(norms)
        self.standing = standing_of(self.session, history, accept_verification)
        self.response = response
        self.read = reader(self.session, progress, _compensation(response))
        faults = faults_of(self.session.folder)
        self.unusable = {fault.shot for fault in faults}
        self.noticed = Journal(
            (*held_against_itself(self.session), *held_against_record(self.session, faults)),
            tuple((fault.shot, fault.reason) for fault in faults),
        )

    def part_views(self, hand_eye: HandEye | None, done: int) -> tuple[list[PartView], Journal]:
        """Steps 5 and 6: every usable part shot, placed and segmented; `done` shots were read before."""
        views: list[PartView] = []
        noticed = Journal()
        for shot in self.session.part_shots:
            if shot.name not in self.unusable:
                view, more = self.part_view(shot, hand_eye, done + len(noticed.shots))
                noticed += more
                if view is not None:
                    views.append(view)
        return views, noticed

    def part_view(self, shot: ShotSpec, hand_eye: HandEye | None, done: int) -> tuple[PartView | None, Journal]:
        """One of them; None with the reason in the journal."""
        base_from_scanner = np.eye(4)
        if self.session.has_robot:
            if hand_eye is None:
                why = "no artefact shot could be used, so its place in base is unknown"
                return None, Journal(left_out=((shot.name, why),))
            base_from_scanner = base_from_flange(shot) @ hand_eye.flange_from_scanner
        scan = self.read(shot, done)
        t = time.perf_counter()
        part, turn = self.part, base_from_scanner[:3, :3].T
        axis, zero = (None if v is None else (turn @ np.array(v)).tolist() for v in (part.axis_base, part.zero_base))
        segmented: WeldShot | None = None
        refused: str | None = None
        try:
            segmented = segment_weld(scan.points_mm, part.course.radius_mm, part.wall_thickness, axis, zero)
        except GeometryError as error:
            refused = scan.reading.why_dark or other_part(scan.points_mm, part, axis) or str(error)
        noticed = scan.noticed + took("segment", t)
        if segmented is not None:
            refused = other_part(scan.points_mm, part, axis, segmented)
        if segmented is None or refused is not None:
            why = f"{refused}{mostly_outside(scan.points_mm, scan.outside_mm)}"
            return None, noticed + Journal(left_out=((shot.name, why),))
        said = held_against_calibration(
            shot.name, self.session.scanner, segmented, scan.points_mm, scan.outside_mm, part.wall_thickness
        )
        noticed += Journal(said)
        view = PartView(
            shot.name,
            self.session.part_shots.index(shot),
            scan.reason,
            base_from_flange(shot) if self.session.has_robot else np.eye(4),
            base_from_scanner,
            segmented,
            None if self.session.scanner.hull is None else self.session.scanner.hull.build(),
        )
        return view, noticed

    def measure(self, views: Sequence[PartView], hand_eye: HandEye | None) -> tuple[_Measured, Journal]:
        """Step 7, both methods."""
        if not views:
            return _Measured(), Journal()
        noticed = Journal(tuple(held_against_scan(self.session, views, hand_eye)))
        t = time.perf_counter()
        angle_sigma = 0.0
        if hand_eye is not None:
            turn = float(np.linalg.eigvalsh(hand_eye.covariance[:3, :3]).max())
            angle_sigma = float(np.sqrt(max(turn, 0.0) + pose_sigma(hand_eye)[1] ** 2))
        try:
            poses = [view.base_from_scanner for view in views] if self.session.has_robot else None
            modes = calibration_unknowns(self.stated, self.read.scanner, views, self.read.axis)
            step = measure_step([view.shot for view in views], angle_sigma, poses, modes)
        except GeometryError as error:
            return _Measured(), noticed + Journal(left_out=tuple((view.name, str(error)) for view in views))
        edges = edge_profile(views)
        found = _step_result(step, edges, self.part)
        noticed, t = noticed + took("measure", t), time.perf_counter()
        measured = np.rint(found.angle_deg / edges.course.bin_width).astype(int).tolist()
        by = "session" if self.required_coverage_deg is None else "option"
        required = self.required_deg
        seam = seam_of(
            views,
            self.read.scanner,
            measured,
            self.part.course,
            required,
            "views" if required is None else by,
        )
        margin: CalibrationMargin | None = None
        if self.leaves_calibration_out(found):
            margin = calibration_margin(
                self.session.scanner,
                self.read.scanner,
                views,
                found.angle_deg,
                self.part.wall_thickness,
                Unevenness(step.residual_rms_mm, *step.correlation_mm),
                self.read.axis,
            )
        noticed, t = noticed + Journal(seam.findings) + took("seam", t), time.perf_counter()
        agreements: tuple[ShotAgreement, ...] = ()
        if hand_eye is not None and len(views) > 1:
            agreements, said = self.hold_together(views, step, hand_eye)
            noticed, t = noticed + Journal(said) + took("agreement", t), time.perf_counter()
        cloud = self.placed(views, step)
        noticed, t = noticed + took("place", t), time.perf_counter()
        histogram, said = self.paper(cloud, views[0])
        noticed += Journal(said) + took("paper", t)
        if not found.angle_deg.size:
            why = "no angle at which both walls and both edges were seen"
            return (
                _Measured(None, cloud, seam, margin, agreements),
                noticed + Journal(left_out=tuple((view.name, why) for view in views)),
            )
        return _Measured(replace(found, histogram=histogram), cloud, seam, margin, agreements), noticed

    @property
    def stated(self) -> Floats | None:
        """The covariance of the scanner's parameters, where its file states it."""
        return stated_covariance(self.session.scanner)

    def leaves_calibration_out(self, step: StepResult | None) -> bool:
        """Does U hold nothing of the scanner's calibration?"""
        return self.stated is None or self.method == "paper" or step is None or step.judged == "edge"

    @property
    def required_deg(self) -> float | None:
        """The least coverage that option or session ask for."""
        asked = self.required_coverage_deg
        return self.part.required_coverage_deg if asked is None else asked

    def placed(self, views: Sequence[PartView], step: WeldStep) -> PartCloud:
        """All shots in base, in one cloud."""
        shots = [(view.shot, view.base_from_scanner, view.index) for view in views]
        many = sum(int(np.count_nonzero(np.isfinite(view.shot.deviation_mm))) for view in views) > MOST_POINTS
        points, label, deviation, along, across, shot, counts = place_shots(
            step, shots, CELL_MM if many and self.cloud == "cells" else None
        )
        return PartCloud(points, label, deviation, along, across, shot, tuple(counts))

    def hold_together(
        self, views: Sequence[PartView], step: WeldStep, hand_eye: HandEye
    ) -> tuple[tuple[ShotAgreement, ...], tuple[Finding, ...]]:
        """Shots that saw the same wall, held against each other in base."""
        pairs = agreement(views, hand_eye, views[0].seam_in_base)
        said = [said for pair in pairs if (said := complaint(pair)) is not None]
        return pairs, (*said, *shots_agree(views, step, hand_eye, self.part.wall_thickness))

    def paper(self, cloud: PartCloud, view: PartView) -> tuple[Histogram | None, tuple[Finding, ...]]:
        """The paper's chain; None with a note where it finds no answer."""
        seam = view.seam_in_base
        try:
            return paper_step(cloud.points_mm, seam.origin_mm, seam.across, seam.course.radius_mm), ()
        except GeometryError as error:
            return None, (note("paper", f"method paper gave no answer: {error}"),)

    def judged(self, measured: _Measured, hand_eye: HandEye | None, noticed: Journal) -> Inspection:
        """Step 8, and everything together."""
        step, cloud, seam = measured.step, measured.cloud, measured.seam
        findings = [*noticed.findings, *copies({shot.name: shot.digest for shot in noticed.shots})]
        findings += not_used(self.session, noticed.left_out, findings)
        value, expanded, coverage, quantiles = None, None, None, None
        if step is not None:
            if step.histogram is not None:
                u_mm = self.paper_uncertainty_mm(step, cloud, hand_eye)
                step = replace(step, histogram=replace(step.histogram, expanded_uncertainty_mm=u_mm))
            value, expanded, coverage = step.max_abs_mm, step.expanded_uncertainty_mm, step.coverage_deg
            quantiles = None if step.quantiles_mm is None else step.quantiles_mm.tolist()
            if self.method == "paper":
                value = None if step.histogram is None else step.histogram.step_mm
                expanded = None if step.histogram is None else step.histogram.expanded_uncertainty_mm
                quantiles = None
        part = self.part.model_dump()
        reason = "; ".join(f"{name}: {why}" for name, why in noticed.left_out) or "method paper gave no answer"
        if not self.standing.relied_on:
            value, expanded, quantiles = None, None, None
            reason = f"the scanner is not verified: {self.standing.text}"
        # Whatever finds something stands before the verdict: a bar found later would not count.
        scanner, said = self.scanner_record()
        findings += said
        compensated = response_record(self.response, noticed.shots)
        if compensated["note"]:
            findings.append(note("response", compensated["note"]))
        if (about := about_verification(self.standing)) is not None:
            findings.append(about)
        common = list(findings)
        doubts = {norm: self.doubts_of(norm, measured, value, expanded) for norm in self.norms}
        findings += dict.fromkeys(said for found in doubts.values() for said in found)
        verdicts = [
            verdict
            for norm in self.norms
            for verdict in judge(
                norm,
                value,
                expanded,
                part,
                why_not_measured=reason,
                coverage_deg=coverage,
                required_coverage_deg=self.required_deg,
                bars=[*common, *doubts[norm]],
                quantiles_mm=quantiles,
            )
        ]
        timing = dict(noticed.timing_s)
        timing["compute"] = sum(seconds for what, seconds in timing.items() if what != "read")
        return Inspection(
            session=self.session.name,
            part=part,
            method=self.method,
            frame="base" if self.session.has_robot else "scanner",
            step=step,
            hand_eye=hand_eye,
            cloud=cloud,
            verdicts=tuple(verdicts),
            left_out=noticed.left_out,
            findings=tuple(findings),
            masks={shot.name: dict(shot.masks) for shot in noticed.shots},
            response=compensated,
            timing_s=timing,
            software={
                "name": "weldscan",
                "version": __version__,
                "python": platform.python_version(),
                "numpy": np.__version__,
                "session_sha256": self.session.sha256,
            },
            verification=self.standing,
            calibration="not stated" if self.leaves_calibration_out(step) else "stated",
            agreement=measured.agreement,
            scanner=scanner,
            seam=seam.bins if seam else (),
            coverage=seam.coverage if seam else None,
        )

    def doubts_of(
        self, norm: str, measured: _Measured, value_mm: float | None, expanded_mm: float | None
    ) -> list[Finding]:
        """What bars PASS under one norm alone: whether it does depends on the limit."""
        limits = [each.limit_mm for each in judge(norm, 0.0, 0.0, self.part.model_dump()) if each.limit_mm is not None]
        step = measured.step
        if step is None or not limits:
            return []
        limit_mm = min(limits)
        found = [self.edges_above(limit_mm, step)]
        if self.leaves_calibration_out(step) and value_mm is not None and expanded_mm is not None:
            found.append(calibration_above(measured.calibration, limit_mm, abs(value_mm) + expanded_mm))
        return [said for said in found if said is not None]

    def edges_above(self, limit_mm: float, step: StepResult) -> Finding | None:
        """A bar where the walls keep a limit and the surfaces beside the toes may not."""
        if step.edge_upper_mm is None or step.judged == "edge" or self.method == "paper":
            return None
        if step.edge_upper_mm <= limit_mm:
            return None
        text = (
            f"the surfaces right beside the weld stand up to {step.edge_upper_mm:.3f} mm apart, as far as they can be "
            f"read, where the limit is {limit_mm:.3f} mm; the undisturbed walls, extrapolated, keep it"
        )
        return bar("edges", text)

    def scanner_record(self) -> tuple[ScannerRecord | None, tuple[Finding, ...]]:
        """Which calibration of the scanner this is, where the session says; with a warning where it is out of date."""
        spec = self.session.scanner
        said = [] if (unknown := about_region(spec)) is None else [unknown]
        if spec.id is None:
            return None, tuple(said)
        expired = spec.valid_until is not None and date.fromisoformat(spec.valid_until) < datetime.now(UTC).date()
        if expired:
            text = (
                f"the scanner's calibration {spec.id} of {(spec.date or 'an unknown day')[:10]} was valid until "
                f"{spec.valid_until}: it is out of date"
            )
            said.append(warning("calibration", text))
        if spec.undetermined:
            text = f"the scanner's calibration {spec.id} did not determine {', '.join(spec.undetermined)}"
            said.append(warning("calibration", text))
        record = ScannerRecord(
            spec.id,
            spec.date or "",
            spec.valid_until,
            expired,
            spec.board,
            spec.temperature_c,
            spec.undetermined or (),
        )
        return record, tuple(said)

    def paper_uncertainty_mm(self, step: StepResult, cloud: PartCloud | None, hand_eye: HandEye | None) -> float | None:
        """Expanded, k = 2: the surface's, the robot through which the paper's chain joins shots, and its bias.

        The bias (nominal radius, magnitudes of noisy distances, the 20 % rule) shows as the difference from the mean
        magnitude of the profile. It is not corrected, so it adds linearly (GUM F.2.4.5).
        """
        if step.histogram is None:
            return None
        expanded = step.expanded_uncertainty_mm
        if hand_eye is not None and cloud is not None and len(self.session.part_shots) > 1:
            centre = cloud.points_mm.mean(axis=0)
            poses = [base_from_flange(shot)[:3, 3] for shot in self.session.part_shots]
            distance = float(np.mean([np.linalg.norm(centre - pose) for pose in poses]))
            pose_mm, pose_rad = pose_sigma(hand_eye)
            placing = math.hypot(
                point_uncertainty_mm(hand_eye, np.array([0.0, 0.0, distance])), pose_mm, pose_rad * distance
            )
            expanded = math.hypot(expanded, 2 * placing)
        return expanded + abs(step.histogram.step_mm - float(np.abs(step.step_mm).mean()))


def about_verification(standing: Standing) -> Finding | None:
    """What to say of the scanner's verification; nothing where it is good, or where nothing is judged without it."""
    if standing.accepted is not None and standing.state != "verified":
        return warning("verification", f"the scanner's verification: {standing.statement}")
    return note("verification", f"the scanner: {standing.text}") if standing.state == "none" else None


def _compensation(response: str | os.PathLike[str] | Response) -> Compensate:
    if response in ("auto", "off"):
        return cast(Literal["auto", "off"], response)
    table = response if isinstance(response, Response) else read_response(response)
    return lambda fringe: table.phase_error(fringe.steps, fringe.periods)


def response_record(response: str | os.PathLike[str] | Response, shots: Sequence[ShotReading]) -> dict[str, Any]:
    """What was done about the projector's response, for the result: how, how much, in which shots; and a line."""
    errors = {shot.name: shot.phase_errors for shot in shots if shot.phase_errors is not None}
    taken = {name: [e for e in sets if e.source != "nothing"] for name, sets in errors.items()}
    taken = {name: sets for name, sets in taken.items() if sets}
    record: dict[str, Any] = {
        "mode": response if response in ("auto", "off") else "table",
        "table": None,
        "compensated": sorted(taken),
        "largest_rad": max((e.largest_rad for sets in taken.values() for e in sets), default=0.0),
        "shots": {name: [_set_record(e) for e in sets] for name, sets in errors.items()},
        "note": None,
    }
    if isinstance(response, Response):
        record["table"] = response.document()["id"]
    elif record["mode"] == "table":
        record["table"] = f"{os.fspath(response)} ({read_response(response).document()['id']})"
    if taken and record["mode"] == "auto" and 2 * len(taken) < len(errors):
        # One projector lit them all: what few shots show is of their own making.
        record["note"] = (
            f"{', '.join(sorted(taken))}: an error of the phase of up to {record['largest_rad']:.4f} rad that repeats "
            "with the fringes and was taken off; most shots show none, so that it is hardly the projector's response"
        )
    elif taken:
        by = "by the table given" if record["table"] else "as the fringes themselves show it"
        record["note"] = (
            f"the projector's light is not proportional to its level: the phase of {len(taken)} of {len(errors)} shots "
            f"was compensated, {by}, by up to {record['largest_rad']:.4f} rad"
        )
    return record


def _set_record(error: SetPhaseError) -> dict[str, Any]:
    return {
        "periods": error.periods,
        "steps": error.steps,
        "from": error.source,
        "largest_rad": error.largest_rad,
        "sin_rad": list(error.sin_rad),
        "standard_rad": list(error.standard_rad),
        "harmonics": error.harmonics,
    }


BUDGET = (
    ("fit_mm", "noise, terms", "noise, and the terms that walls and shots share, extrapolated to the seam"),
    (
        "unevenness_mm",
        "unevenness at the seam",
        "the walls' unevenness, as far as their cells do not tell it at the seam",
    ),
    ("angle_mm", "angle", "hand-eye and robot rotation, and the axis on a short arc, times the slope of the profile"),
)


def _step_result(step: WeldStep, edges: EdgeProfile, part: PartSpec) -> StepResult:
    """The profile of the bins in which both walls and both edges were read; judged by the larger upper bound."""
    bins = np.rint(step.column("angle_deg") / edges.course.bin_width).astype(int)
    read = np.isfinite(edges.step_mm[bins])

    def column(name: str) -> Floats:
        return np.asarray(step.column(name)[read])

    bins = bins[read]
    wall, wall_u = column("step_mm"), 2 * column("standard_mm")
    edge, edge_u = edges.step_mm[bins], edges.u_mm[bins]
    budget: tuple[BudgetLine, ...] = ()
    value, u, at = math.nan, math.nan, math.nan
    quantiles: Floats | None = None
    seam_mean: tuple[float, float] | None = None
    judged: Literal["wall", "edge"] = "wall"
    band = wall_u
    if len(bins):
        value, u, quantiles, band_factor = step.largest_of(np.flatnonzero(read).tolist())
        worst = int(np.argmax(np.abs(wall)))
        at, band = float(column("angle_deg")[worst]), band_factor * column("standard_mm")
        seam_mean = (step.seam_mean_mm[0], 2 * step.seam_mean_mm[1])
        budget = _budget({key: float(column(key)[worst]) for key, _, _ in BUDGET}, u / 2, len(bins))
        # Where the walls do not run on to the weld as they run further away, they cannot tell what it hides.
        departs = bool((np.abs(np.nan_to_num(column("departure"))) > step.departure_limit).any())
        upper = max(value + u, float((np.abs(wall) + wall_u).max()))
        if (
            edges.judged is not None
            and edges.worst is not None
            and sum(edges.judged) > upper
            and (edges.confirmed_mm > upper or edges.disturbed or departs or edges.contradict(bins, wall, wall_u))
        ):
            (value, u), at, judged = edges.judged, edges.course.bin_width * edges.worst, "edge"
            quantiles, band = None, band_factor / 2 * edge_u
            derived = "reading beside both toes: noise, choice of the stretch, and what the choice of the toes may hide"
            budget = (BudgetLine("edges", u / 2, derived),)
    terms = seam_terms(step, part.outside_diameter, part.wall_thickness)
    return StepResult(
        mean_mm=step.mean_mm,
        median_mm=step.median_mm,
        max_abs_mm=value,
        max_abs_at_deg=at,
        expanded_uncertainty_mm=u,
        histogram=None,
        angle_deg=column("angle_deg"),
        step_mm=edge if judged == "edge" else wall,
        u_mm=edge_u if judged == "edge" else wall_u,
        budget=budget,
        harmonics_mm=terms.harmonics_mm,
        angle_between_walls_deg=terms.angle_deg,
        angle_between_walls_u_deg=terms.angle_u_deg,
        not_observable=terms.not_observable,
        coverage_deg=edges.course.bin_width * len(bins),
        judged=judged,
        edge_upper_mm=None if edges.judged is None else sum(edges.judged),
        wall_step_mm=wall,
        wall_u_mm=wall_u,
        edge_step_mm=edge,
        edge_u_mm=edge_u,
        band_mm=band,
        quantiles_mm=quantiles,
        seam_mean=seam_mean,
    )


def _budget(parts: dict[str, float], combined_mm: float, bins: int) -> tuple[BudgetLine, ...]:
    """The contributions at the largest step; what many bins that vie for it add comes from the draws."""
    lines = [BudgetLine(name, parts[key], derived) for key, name, derived in BUDGET]
    more = combined_mm**2 - sum(part**2 for part in parts.values())
    if more > 0:
        lines.append(BudgetLine("largest of many", math.sqrt(more), f"draws of all {bins} bins together (JCGM 101)"))
    return tuple(lines)
