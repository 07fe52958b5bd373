"""What an inspection found: frozen values that the report only shows. Lengths in mm; degrees where the name says so."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import Lens, Scanner

Floats = NDArray[np.float64]
WHOLE_TURN_DEG = 360.0


class Verdict(StrEnum):
    """The answer to the inspector."""

    PASS = "PASS"
    FAIL = "FAIL"
    INCONCLUSIVE = "INCONCLUSIVE"
    NOT_MEASURED = "NOT MEASURED"
    NOT_ASSESSABLE = "NOT ASSESSABLE"


class Label(IntEnum):
    """What a point of the part belongs to."""

    NONE = 0
    REFERENCE_WALL = 1
    OTHER_WALL = 2
    BEAD = 3


class Severity(StrEnum):
    """How much a finding weighs."""

    NOTE = "note"
    """Worth knowing; changes nothing."""
    WARNING = "warning"
    """Something is not as it should be; the verdict stands."""
    BAR = "bar"
    """The verdict cannot be relied on as a PASS: PASS becomes INCONCLUSIVE, every other verdict stays."""


CODES = {
    "agreement": "shots placed in base disagree by less than what bars, more than their uncertainty",
    "calibration": "the scanner's calibration: not stated, out of date, not determined, or larger than the margin",
    "cap": "what lies between the walls is not one cap of a weld: too wide, two-humped, toes that jump, two seams",
    "clipped": "the camera clips below its full scale",
    "coverage": "less of the seam was seen than is required",
    "description": "the scan contradicts what the session says of the part",
    "edges": "the surfaces right beside the toes contradict the walls' step, or could not be read",
    "frames-disagree": "the frames of one shot contradict each other: copied, exchanged, out of order, moved",
    "hand-eye": "the hand-eye calibration contradicts where the part is found, or is poor",
    "paper": "the paper's method gave no answer",
    "points-without-wall": "points beside the seam that neither wall nor cap explains",
    "pose": "a flange pose is out of the robot's reach, or contradicts the others",
    "response": "the projector's response",
    "saturation": "too much of the seam's surroundings is saturated",
    "shot-altered": "files of a shot differ from what was recorded, or its description does",
    "shot-copied": "two shots hold the same images",
    "shot-left-out": "a shot of the part could not be used",
    "shot-missing": "a planned shot is not there",
    "shots-disagree": "two shots contradict each other",
    "transition": "between wall and cap lies more than weld shrinkage explains",
    "verification": "what is on record about the scanner's verification",
    "walls": "the walls are not what a pipe's are, or only partly seen",
}
"""Every code that a finding may have, and what it is about."""


@dataclass(frozen=True)
class Finding:
    """What there is to say of an inspection, in one line."""

    severity: Severity
    code: str
    """One of `CODES`."""
    text: str
    shot: str | None = None
    """The shot that it is about."""
    at_deg: float | None = None
    """Where on the seam."""

    def __post_init__(self) -> None:
        if self.code not in CODES:
            raise ValueError(f"{self.code!r} is no code of a finding")

    @property
    def where(self) -> str:
        """The place in words: `part-2, at 113°`; empty where it is about the whole."""
        return ", ".join(
            ([self.shot] if self.shot else []) + ([] if self.at_deg is None else [f"at {self.at_deg:.0f}°"])
        )

    def __str__(self) -> str:
        return f"{self.code}{f' ({self.where})' if self.where else ''}: {self.text}"


def bar(code: str, text: str, shot: str | None = None, at_deg: float | None = None) -> Finding:
    """A finding that bars PASS."""
    return Finding(Severity.BAR, code, text, shot, at_deg)


def warning(code: str, text: str, shot: str | None = None, at_deg: float | None = None) -> Finding:
    """A finding that the verdict stands in spite of."""
    return Finding(Severity.WARNING, code, text, shot, at_deg)


def note(code: str, text: str, shot: str | None = None, at_deg: float | None = None) -> Finding:
    """A finding that is only worth knowing."""
    return Finding(Severity.NOTE, code, text, shot, at_deg)


FATES = (
    *("wall", "transition", "cap", "gated", "off_line", "dark", "saturated", "order_in_doubt", "two_paths"),
    *("outside_calibration", "hidden", "other"),
)
"""What became of a pixel of a part shot, by contract."""


@dataclass(frozen=True)
class SeamBin:
    """One bin of the seam that was required or seen, and what became of every pixel in it."""

    angle_deg: float
    along_mm: float
    """From the zero mark along the seam."""
    measured: bool
    fate: dict[str, int]
    """Pixels by `FATES`, over all part shots."""
    cap_width_mm: float | None = None
    toes_mm: tuple[float, float] | None = None
    """Both toes, along the axis from the seam's centreline: reference side, other side."""


def along_seam_mm(angle_deg: float, part: Mapping[str, Any]) -> float | None:
    """Length along the seam of a pipe from its zero mark, on the rated outside; None where no diameter is known.

    >>> round(along_seam_mm(90.0, {"outside_diameter": 400.0}), 3)
    314.159
    """
    diameter = part.get("outside_diameter")
    return None if not diameter else math.radians(angle_deg % 360) * diameter / 2


@dataclass(frozen=True)
class Coverage:
    """How much of the seam was seen, and how much had to be."""

    seen_deg: float
    required_deg: float
    required_by: str
    """session, option, or views: what these views should have seen."""
    gaps: tuple[tuple[float, float], ...]
    """Arcs that were required and not seen, from, to, degrees, in the direction of growing angle."""

    @property
    def enough(self) -> bool:
        """Whether all that is required was seen."""
        return not self.gaps and self.seen_deg >= self.required_deg


@dataclass(frozen=True)
class Judgement:
    """One verdict under one clause of one norm."""

    norm: str
    clause: str
    limit_mm: float | None
    value_mm: float | None
    expanded_uncertainty_mm: float | None
    verdict: Verdict
    reason: str
    details: dict[str, Any] = field(default_factory=dict)
    """Whatever else the norm's file says: edition, evidence, both limits where the table is ambiguous ..."""
    barred_by: tuple[Finding, ...] = ()
    """What keeps the number from being a PASS; empty where nothing does, or where it would be none anyway."""

    @property
    def rule(self) -> str:
        """Which reading or quality level of the clause's table gives the limit."""
        return str(self.details.get("reading", ""))

    @property
    def quantity(self) -> str:
        """What the norm limits."""
        return str(self.details.get("quantity", ""))

    @property
    def evidence(self) -> str:
        """How the limit was come by: read in a source, second-hand, from memory."""
        return str(self.details.get("evidence", ""))

    @property
    def doubt(self) -> str:
        """What to say beside the verdict where the limit was not read in the norm itself or a copy; else empty."""
        if "memory" in self.evidence:
            return "limit from memory"
        return "limit second-hand" if "second-hand" in self.evidence else ""

    @property
    def interval_mm(self) -> tuple[float, float] | None:
        """Lower and upper bound of the magnitude, |h| - U (not below zero) and |h| + U; None where one is unknown."""
        value, u = self.value_mm, self.expanded_uncertainty_mm
        if value is None or u is None or not (math.isfinite(value) and math.isfinite(u) and u >= 0):
            return None
        return max(abs(value) - u, 0.0), abs(value) + u

    @property
    def margin(self) -> float | None:
        """How far the upper bound stays below the limit, as a share of it; negative above it."""
        if self.interval_mm is None or not self.limit_mm:
            return None
        return (self.limit_mm - self.interval_mm[1]) / self.limit_mm

    @property
    def probability_over_limit(self) -> float | None:
        """Of |h| > L for a normal distribution about the value with u = U/2 (JCGM 106), both sides."""
        if self.interval_mm is None or self.limit_mm is None:
            return None
        value, u = abs(self.value_mm or 0.0), (self.expanded_uncertainty_mm or 0.0) / 2
        if u == 0:
            return float(value > self.limit_mm)
        above, below = ((side * value + self.limit_mm) / (u * math.sqrt(2)) for side in (-1, 1))
        return 0.5 * math.erfc(above) + 0.5 * math.erfc(below)


@dataclass(frozen=True)
class BudgetLine:
    """One contribution to the standard uncertainty of the judged step (GUM, k = 1)."""

    name: str
    standard_mm: float
    derived_from: str


@dataclass(frozen=True, eq=False)
class Histogram:
    """The paper's histogram of nearest-neighbour distances, and its 20 % rule."""

    edges_mm: Floats
    counts: NDArray[np.int64]
    kept: NDArray[np.bool_]
    step_mm: float
    expanded_uncertainty_mm: float | None = None
    """Of `step_mm`, k = 2; None: not stated."""


@dataclass(frozen=True, eq=False)
class StepResult:
    """The step of the other wall over the reference wall; positive where the other wall is further from the axis."""

    mean_mm: float
    median_mm: float
    max_abs_mm: float
    max_abs_at_deg: float
    expanded_uncertainty_mm: float
    """Of `max_abs_mm`, k = 2."""
    histogram: Histogram | None
    angle_deg: Floats
    """Centres of the profile's bins: even degrees about the axis from the zero mark, those that were seen."""
    step_mm: Floats
    u_mm: Floats
    """Expanded, k = 2, of each bin."""
    budget: tuple[BudgetLine, ...]
    harmonics_mm: dict[str, float]
    """Fourier terms around the seam where the arc allows them: `name`, `name_u` (expanded, k = 2), `name_at_deg`."""
    angle_between_walls_deg: float | None
    """None where the scan does not determine it."""
    coverage_deg: float
    """How much of the seam's turn was seen."""
    angle_between_walls_u_deg: float | None = None
    """Expanded, k = 2."""
    not_observable: tuple[str, ...] = ()
    """Names of what this scan does not determine: less than a pipe's tolerances do."""
    judged: Literal["wall", "edge"] = "wall"
    """Which of the two steps `step_mm` is, and the verdict is about: the walls', unless the edges contradict them and
    have the larger upper bound. Where both tell the same, the walls tell it better."""
    edge_upper_mm: float | None = None
    """Upper bound of the largest edge step, whichever is judged."""
    wall_step_mm: Floats | None = None
    """The undisturbed walls, extrapolated to the weld's centreline."""
    wall_u_mm: Floats | None = None
    edge_step_mm: Floats | None = None
    """The surfaces right beside both toes, as a gauge reads them."""
    edge_u_mm: Floats | None = None

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Which bins of the profile hold a number with its uncertainty; the others are no measurement."""
        return np.isfinite(self.step_mm) & np.isfinite(self.u_mm)

    @property
    def seam_mean_mm(self) -> float | None:
        """Mean step at the seam over the bins measured; None where there are none."""
        return float(self.step_mm[self.measured].mean()) if self.measured.any() else None

    @property
    def seam_mean_u_mm(self) -> float | None:
        """Its expanded uncertainty, k = 2: the mean of the bins' own, as if they shared all of it; it is not more."""
        return float(self.u_mm[self.measured].mean()) if self.measured.any() else None


@dataclass(frozen=True, eq=False)
class SphereFit:
    """One sphere of one artefact shot, scanner frame."""

    centre_mm: Floats
    covariance_mm2: Floats
    rms_mm: float
    points: int
    residual_mm: float | None
    """Distance between the placed centre and the touched one, after the hand-eye solve."""


@dataclass(frozen=True, eq=False)
class ArtefactShot:
    """What one artefact shot gave to the hand-eye solve."""

    shot: str
    spheres: tuple[SphereFit, ...]
    distances_mm: Floats
    """Between spheres 1-2, 2-3, 3-1, as scanned."""
    residual_rms_mm: float
    left_out_error_mm: float | None
    """Error of this shot's centres placed with the hand-eye solved without it."""
    chi2: float | None = None
    """Of the nine coordinates of its centres under the solution without it: nine where it is as good as the others."""
    outlier: str | None = None
    """Why it is not part of the solution, where it contradicts the others."""


@dataclass(frozen=True, eq=False)
class HandEye:
    """flange_from_scanner with its covariance."""

    flange_from_scanner: Floats
    covariance: Floats
    """6x6, of a small rotation about the scanner's axes (rad) and a translation along the flange's axes (mm)."""
    residual_rms_mm: float
    per_shot: tuple[ArtefactShot, ...]
    touched_distances_mm: Floats
    reduced_chi2: float | None
    working_point_u_mm: float
    """Standard uncertainty of a point at the working distance, placed in flange, worst axis; NaN: not stated."""
    id: str
    date: str
    pose_sigma_mm: float | None = None
    """How far a flange pose is off, each axis, k = 1, as the shots have it; None: not stated."""
    pose_sigma_rad: float | None = None
    """And in direction, about each axis."""
    sphere_sigma_ratio: float | None = None
    """How much more the spheres scatter than their fits say."""
    centres_base_mm: Floats | None = None
    """(3, 3): the sphere centres in base, as touches and shots together have them."""
    probe_bias_mm: Floats | None = None
    """(3,), base: what all touched centres are off by together; None where they were not touched."""
    probe_bias_u_mm: Floats | None = None
    """(3,): its standard uncertainty."""
    tilts_deg: tuple[float, float] = (0.0, 0.0)
    """How far the poses are turned against each other, rms, about the axis with most and with second most."""
    warnings: tuple[str, ...] = ()
    """What whoever calibrates should know: outliers, a robot or probe worse than stated, poses too alike."""


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


@dataclass(frozen=True, eq=False)
class PartCloud:
    """Every measured point of the part, in base (in the scanner's frame where there is no robot)."""

    points_mm: Floats
    """(n, 3)"""
    label: NDArray[np.uint8]
    """`Label` per point."""
    deviation_mm: NDArray[np.float32]
    """Signed radial distance from the reference wall's surface."""
    angle_deg: NDArray[np.float32]
    """About the axis, right-handed, from the zero mark, in [0, 360)."""
    axial_mm: NDArray[np.float32]
    """Along the axis from the seam's centreline; the reference wall is negative."""
    shot: NDArray[np.uint16]
    """Index of the part shot."""


@dataclass(frozen=True, eq=False)
class Validation:
    """The scanned surface held against points that a contact probe read on the part."""

    session: str
    touch: str
    """The file of the probed points."""
    points_mm: Floats
    """(n, 3), base: the probed points."""
    distance_mm: Floats
    """(n,) from the scanned surface to the probed point, positive away from the axis; NaN where nothing was scanned."""
    u_mm: Floats
    """(n,) expanded uncertainty of each distance, k = 2; NaN where there is none."""
    angle_deg: Floats
    """(n,) about the axis, from the zero mark."""
    axial_mm: Floats
    """(n,) along the axis from the seam's centreline."""
    mean_mm: float
    rms_mm: float
    max_abs_mm: float
    mean_u_mm: float
    """Expanded, k = 2, of the mean: what the points share does not average out."""
    budget: tuple[BudgetLine, ...]
    """Of a typical point."""
    software: dict[str, str]

    @property
    def compared(self) -> int:
        """How many of the probed points lie on scanned surface."""
        return int(np.isfinite(self.distance_mm).sum())


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


# --- the scanner's calibration ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class BoardPose:
    """One pose of the board in a scanner's calibration."""

    name: str
    camera_from_board: Floats
    """(4, 4), mm."""
    tilt_deg: float
    """Between the board's normal and the camera's axis."""
    distance_mm: float
    camera_px: Floats
    """(n, 2) the features as the camera saw them."""
    projector_px: Floats
    """(n, 2) the projector's coordinates there; NaN where there was no phase."""
    camera_residual_px: Floats
    """(n, 2) modelled minus seen."""
    projector_residual_px: Floats
    used: NDArray[np.bool_]
    """(n, 2): camera and projector; not rejected as an outlier."""
    rms_px: tuple[float, float]
    """Of the used features, camera and projector."""
    left_out_mm: float | None
    """How much the shape of the volume changes (rms) when the calibration does without this pose."""
    edge_px: float
    """How wide an edge of the board is in the image; NaN where unknown."""

    @property
    def kept(self) -> tuple[int, int]:
        """How many features were used, camera and projector."""
        return int(self.used[:, 0].sum()), int(self.used[:, 1].sum())

    @property
    def missing(self) -> int:
        """Features without a phase."""
        return int(np.isnan(self.projector_px[:, 0]).sum())


@dataclass(frozen=True, eq=False)
class VolumePoint:
    """What the calibration leaves unknown of a point, k = 1."""

    name: str
    point_mm: Floats
    """(3,), scanner frame."""
    u_mm: Floats
    """(3,), in the scanner's frame, which is not known better than its camera's axis."""
    shape_u_mm: Floats
    """(3,), without a common motion of all points: that is the hand-eye's."""


@dataclass(frozen=True, eq=False)
class NextPose:
    """The pose of the board that would add most to a calibration."""

    point_mm: Floats
    """(3,), where the board's middle should be, scanner frame."""
    tilt_deg: float
    around_deg: float
    """Which way it leans: its normal turns to the image's right at 0, down at 90."""
    lowers: str
    """What it improves."""
    from_value: float
    to_value: float


@dataclass(frozen=True, eq=False)
class ScannerCalibration:
    """A scanner as calibrated: what `weldscan-scanner/1` keeps, and what its report shows."""

    id: str
    date: str
    valid_until: str | None
    board: str
    temperature_c: float | None
    camera_size: tuple[int, int]
    projector_size: tuple[int, int]
    parameters: tuple[str, ...]
    values: Floats
    """In the order of `parameters`; the turn as a rotation vector (rad)."""
    covariance: Floats
    """Of `parameters`; rotations are small turns about the camera's axes, R_true = exp(w) R."""
    camera_from_projector: Floats
    """(4, 4)"""
    rms_px: tuple[float, float, float]
    """Camera, projector, both, over the used features: root of the mean squared length; both: over the two devices."""
    sigma_px: tuple[float, float]
    """Noise of one coordinate: the camera's features, and the phase at them."""
    poses: tuple[BoardPose, ...]
    left_out: tuple[tuple[str, str], ...]
    """Poses that could not be used, with the reason."""
    volume: tuple[VolumePoint, ...]
    """The middle and the corners."""
    coverage: tuple[float, float]
    """Share of the camera's and of the projector's image (8 x 6 fields) in which there is a feature."""
    board_sigma_mm: tuple[float, float] | None
    """How far the board's features are off its drawing, one coordinate, in its plane and out of it; None: not seen."""
    jackknife_mm: float | None
    """Standard uncertainty of the volume's shape (rms) by leaving out one pose after the other."""
    shape_u_mm: float
    """The same by the covariance."""
    undetermined: tuple[str, ...]
    """Parameters that the poses do not determine."""
    next_pose: NextPose | None
    warnings: tuple[str, ...]

    @property
    def standard_uncertainty(self) -> dict[str, float]:
        """Of every parameter, k = 1."""
        return dict(zip(self.parameters, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def baseline_mm(self) -> float:
        """Between camera and projector."""
        return float(np.linalg.norm(self.camera_from_projector[:3, 3]))

    def lens(self, device: str) -> tuple[Floats, list[float]]:
        """K and k1 k2 p1 p2 k3 of "camera" or "projector"."""
        value = dict(zip(self.parameters, self.values.tolist(), strict=True))
        fx, fy, cx, cy = (value[f"{device}.{name}"] for name in ("fx", "fy", "cx", "cy"))
        dist = [value.get(f"{device}.{name}", 0.0) for name in ("k1", "k2", "p1", "p2", "k3")]
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), dist

    @property
    def scanner(self) -> Scanner:
        """For `triangulate`."""
        camera, projector = (
            Lens(*size, *self.lens(device))
            for device, size in (("camera", self.camera_size), ("projector", self.projector_size))
        )
        return Scanner(camera, projector, self.camera_from_projector)


# --- the scanner's own acceptance -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class BallError:
    """One sphere at one place of the volume: the range of its radial residuals, and how much too large it came out."""

    shot: str
    sphere: int
    """1, 2 or 3, in the order of the session's `artefact`."""
    centre_mm: Floats
    """(3,), scanner frame: the centre of the sphere with the calibrated diameter."""
    form_mm: float
    """PF, over the judged share of the points."""
    form_all_mm: float
    """PF over all points."""
    form_997_mm: float
    """PF without the 3 per mille of the points that lie furthest off."""
    form_95_mm: float
    """PF without the 5 per cent that lie furthest off."""
    noise_range_mm: float
    """Range that normal noise of this rms has over so many points."""
    size_mm: float
    """PS, over the judged share of the points."""
    rms_mm: float
    points: int
    wild: int
    """Points too far off to be the sphere's; PF over all points has them, the sphere has not."""
    seen: float
    """Share of the 120 degree cap's pixels that were measured."""
    residual_mm: Floats
    """(n, n) mean residuals as the camera sees the cap, NaN where there are none."""


@dataclass(frozen=True, eq=False)
class SpacingError:
    """The distance of two spheres at one place of the volume."""

    shot: str
    spheres: tuple[int, int]
    centres_mm: Floats
    """(2, 3), scanner frame."""
    measured_mm: float
    calibrated_mm: float

    @property
    def error_mm(self) -> float:
        """SD."""
        return self.measured_mm - self.calibrated_mm


@dataclass(frozen=True, eq=False)
class PlaneError:
    """The flat standard at one place of the volume: the range of its residuals."""

    shot: str
    corners_mm: Floats
    """(4, 3), scanner frame: of the rectangle in the plane that holds the points."""
    flatness_mm: float
    """F, over the judged share of the points."""
    flatness_all_mm: float
    flatness_997_mm: float
    flatness_95_mm: float
    noise_range_mm: float
    rms_mm: float
    points: int
    wild: int
    """Points too far off to be the plane's; F over all points has them, the plane has not."""
    seen: float
    """Share of the pixels within the plane's outline that were measured."""
    size_mm: tuple[float, float]
    """Of the rectangle that was seen."""
    of_field: float
    """Its longer side as a share of the field's diagonal at that distance."""
    residual_mm: Floats
    """(rows, columns) mean residuals in the image's orientation, NaN where there are none."""

    @property
    def centre_mm(self) -> Floats:
        """Middle of what was seen."""
        return np.asarray(self.corners_mm.mean(axis=0))


@dataclass(frozen=True)
class Characteristic:
    """One characteristic over all positions, and its verdict."""

    name: str
    """PF, PS, SD or F."""
    title: str
    value_mm: float | None
    """The value furthest from zero, with its sign: the one that is judged."""
    where: str
    """The shot and the sphere or plane that it belongs to."""
    mean_mm: float | None
    std_mm: float | None
    """Standard deviation over the positions."""
    positions: int
    """Distinct places in the volume."""
    required_positions: int
    points: int | None
    """Median number of points per position; None for distances."""
    limit_mm: float | None
    """The maximum permissible error, either side of zero."""
    u_mm: float
    """Test value uncertainty, k = 2: what the artefact's calibration leaves."""
    verdict: Verdict
    reason: str


@dataclass(frozen=True)
class Drift:
    """How a characteristic's mean changes over the verifications of one scanner."""

    name: str
    dates: tuple[str, ...]
    mean_mm: tuple[float, ...]
    value_mm: tuple[float, ...]
    rate_mm_per_year: float | None
    """Slope of a straight line through the means."""
    rate_u_mm_per_year: float | None
    """Half width of its 95 % interval (Student's t)."""
    text: str


@dataclass(frozen=True, eq=False)
class Verification:
    """Whether a scanner keeps its limits: VDI/VDE 2634 part 2 and ISO 10360-13."""

    session: str
    scanner: str
    """Identifies the calibrated scanner: a hash of its numbers."""
    date: str
    date_from: str
    """Where the date was taken from."""
    valid_until: str
    characteristics: tuple[Characteristic, ...]
    balls: tuple[BallError, ...]
    spacings: tuple[SpacingError, ...]
    planes: tuple[PlaneError, ...]
    lost: tuple[tuple[str, str], ...]
    """Shots that do not show what the session says they show, with the reason."""
    assumed: tuple[str, ...]
    """What was taken for the artefact where the session gives no certificate."""
    warnings: tuple[str, ...]
    limits: dict[str, Any]
    software: dict[str, str]
    fringes: str = ""
    """What was projected: a verification is about these."""
    drift: tuple[Drift, ...] = ()
    """Over the verifications in the history, where one is kept."""
    notes: tuple[str, ...] = ()
    """What there is to say about the history file."""

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of the characteristics that have a limit; NOT ASSESSABLE where none has."""
        order = (Verdict.FAIL, Verdict.NOT_MEASURED, Verdict.NOT_ASSESSABLE, Verdict.INCONCLUSIVE, Verdict.PASS)
        given = {each.verdict for each in self.characteristics if each.limit_mm is not None}
        return next((verdict for verdict in order if verdict in given), Verdict.NOT_ASSESSABLE)

    @property
    def span_mm(self) -> tuple[float, float, float]:
        """How far the positions reach along the scanner's x, y and z."""
        places = [*(b.centre_mm[None] for b in self.balls), *(p.corners_mm for p in self.planes)]
        if not places:
            return 0.0, 0.0, 0.0
        x, y, z = np.ptp(np.concatenate(places), axis=0).tolist()
        return x, y, z

    def __getitem__(self, name: str) -> Characteristic:
        """PF, PS, SD or F."""
        return next(each for each in self.characteristics if each.name == name)


@dataclass(frozen=True)
class Standing:
    """Whether an inspection may rely on its scanner: what the history of verifications says."""

    state: Literal["verified", "failed", "expired", "none"]
    """`verified`: the last verification of this scanner passed and is valid; `expired`: it passed once; `none`: none is
    on record, and none was asked for; `failed`: everything else, a history that names another scanner too."""
    text: str
    history: str | None = None
    id: str | None = None
    """Of the verification that decides."""
    date: str | None = None
    valid_until: str | None = None
    accepted: str | None = None
    """Why an inspector relied on the scanner all the same."""
    notes: tuple[str, ...] = ()

    @property
    def good(self) -> bool:
        """The last verification of this scanner passed and is still valid."""
        return self.state == "verified"

    @property
    def relied_on(self) -> bool:
        """Whether results of this scanner are judged: where no verification is asked for, too."""
        return self.state in ("verified", "none") or self.accepted is not None

    @property
    def statement(self) -> str:
        """What a report says."""
        if self.accepted is None:
            return self.text if self.relied_on else f"not relied on: {self.text}"
        return f"relied on all the same ({self.accepted}); {self.text}"
