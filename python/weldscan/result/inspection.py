"""All that one inspection found."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from weldscan.result.cloud import PartCloud
from weldscan.result.findings import Finding, Severity
from weldscan.result.hand_eye import HandEye
from weldscan.result.seam import WHOLE_TURN_DEG, Coverage, SeamBin
from weldscan.result.standing import Standing
from weldscan.result.step import StepResult
from weldscan.result.verdict import Judgement, Verdict


@dataclass(frozen=True)
class ShotAgreement:
    """Two part shots where both saw a wall, placed in base."""

    shots: tuple[str, str]
    cells: int
    """How many cells of 4 mm both saw."""
    difference_mm: float
    """The second shot's wall above the first one's, radially, median."""
    rms_mm: float
    """Of the cells' differences."""
    expanded_uncertainty_mm: float
    """Of `difference_mm`, k = 2: hand-eye and two flange poses."""


@dataclass(frozen=True)
class ScannerRecord:
    """The scanner's calibration that an inspection relied on, as its file says."""

    id: str
    date: str
    valid_until: str | None
    expired: bool
    """On the day of the inspection."""
    board: str | None
    temperature_c: float | None
    undetermined: tuple[str, ...]
    """Parameters that its poses did not determine."""


@dataclass(frozen=True, eq=False)
class Inspection:
    """All of it. `step` is None where nothing could be measured; then `verdicts` say why."""

    session: str
    part: dict[str, Any]
    method: str
    """Which number is judged: surface or paper."""
    frame: str
    """base or scanner: the frame of `cloud`."""
    step: StepResult | None
    hand_eye: HandEye | None
    cloud: PartCloud | None
    verdicts: tuple[Judgement, ...]
    left_out: tuple[tuple[str, str], ...]
    """Shots that could not be used, with the reason."""
    findings: tuple[Finding, ...]
    """Notes, warnings and bars."""
    masks: dict[str, dict[str, int]]
    """Per shot: how many pixels were ok, dark, saturated, in doubt of their fringe order, without a fit."""
    timing_s: dict[str, float]
    software: dict[str, str]
    seam: tuple[SeamBin, ...] = ()
    """Every bin of the seam that was required or seen."""
    coverage: Coverage | None = None
    calibration: str = "not stated"
    """`stated` where U holds the scanner's calibration, else `not stated`."""
    verification: Standing | None = None
    """What is on record about the scanner."""
    agreement: tuple[ShotAgreement, ...] = ()
    """Part shots that saw a wall together, held against each other."""
    scanner: ScannerRecord | None = None
    """Which calibration of the scanner was used; None where the session does not say."""
    response: dict[str, Any] = field(default_factory=dict)
    """What was done about the projector's response: `mode` (auto, off, table), `compensated` shots, `largest_rad`, and
    per shot and fringe set the series that was taken off the phase."""

    @property
    def bars(self) -> tuple[Finding, ...]:
        """What bars PASS."""
        return tuple(finding for finding in self.findings if finding.severity is Severity.BAR)

    @property
    def warnings(self) -> tuple[str, ...]:
        """The text of the findings that do not bar."""
        return tuple(finding.text for finding in self.findings if finding.severity is not Severity.BAR)

    @property
    def judged_mm(self) -> float | None:
        """The number that the verdict is about."""
        if self.step is None:
            return None
        if self.method == "paper":
            return None if self.step.histogram is None else self.step.histogram.step_mm
        return self.step.max_abs_mm

    @property
    def verdict(self) -> Verdict:
        """The one answer where several norms were asked: the worst of theirs; what is not known is worse than close."""
        order = (Verdict.FAIL, Verdict.NOT_MEASURED, Verdict.NOT_ASSESSABLE, Verdict.INCONCLUSIVE, Verdict.PASS)
        given = {judgement.verdict for judgement in self.verdicts}
        return next((verdict for verdict in order if verdict in given), Verdict.NOT_MEASURED)

    @property
    def headline(self) -> Judgement | None:
        """The judgement that the verdict is: of those with the worst verdict, the one of least margin."""
        worst = [judgement for judgement in self.verdicts if judgement.verdict == self.verdict]
        # What has no margin has no number: it comes before what has one.
        return min(worst, key=lambda j: -math.inf if j.margin is None else j.margin, default=None)

    @property
    def seen_deg(self) -> float:
        """How much of the seam's turn was seen."""
        if self.coverage is not None:
            return self.coverage.seen_deg
        return 0.0 if self.step is None else self.step.coverage_deg

    @property
    def whole(self) -> bool:
        """Whether the whole turn was seen."""
        return self.seen_deg >= WHOLE_TURN_DEG - 1e-6

    def words(self, verdict: Verdict | None = None) -> str:
        """A verdict as it is said: `PASS over 54° of 360°` where not the whole seam was seen; by default the one."""
        verdict = self.verdict if verdict is None else verdict
        if verdict is not Verdict.PASS or self.whole:
            return verdict.value
        # Rounded down: no more is claimed than was seen.
        return f"{verdict.value} over {math.floor(self.seen_deg + 1e-6)}° of 360°"
