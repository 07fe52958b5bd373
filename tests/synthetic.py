"""An inspection made up from formulas: for tests of whatever shows results."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np

from weldscan.norms import judge
from weldscan.records.part import course_of
from weldscan.result import (
    ArtefactShot,
    ArtefactSphere,
    BudgetLine,
    Coverage,
    Finding,
    HandEye,
    Histogram,
    Inspection,
    Label,
    PartCloud,
    SeamBin,
    StepResult,
    Verdict,
    bar,
    note,
    warning,
)
from weldscan.result.verification import Characteristic, Verification

PART = {
    "kind": "pipe",
    "outside_diameter": 630.0,
    "wall_thickness": 6.0,
    "joint": "circumferential butt",
    "axis_base": (1.0, 0.0, 0.0),
    "zero_base": (0.0, 1.0, 0.0),
}
ARCS = ((64.0, 112.0), (172.0, 220.0))


def step_at(angle_deg: np.ndarray) -> np.ndarray:
    """The true step of the made-up weld."""
    return 0.25 + 0.16 * np.cos(np.radians(angle_deg - 205))


def cloud(points: int, seed: int = 1) -> PartCloud:
    """Two arcs of a pipe along x with a bead."""
    random = np.random.default_rng(seed)
    shot = np.repeat([0, 1], points // 2).astype(np.uint8)
    low = np.array([arc[0] for arc in ARCS])[shot]
    angle = low + random.random(shot.size) * 48
    axial = random.uniform(-55, 55, shot.size)
    label = np.where(axial < -6, Label.REFERENCE_WALL, np.where(axial > 6, Label.OTHER_WALL, Label.BEAD)).astype(
        np.uint8
    )
    ripple = 0.15 * np.cos(axial * 2 + np.radians(angle) * 40)
    bead = (1.8 + ripple) * np.cos(np.clip(axial / 6, -1, 1) * np.pi / 2)
    deviation = np.where(axial > 0, step_at(angle), 0) * (np.abs(axial) > 6) + (label == Label.BEAD) * (bead + 0.2)
    deviation = deviation + random.normal(0, 0.025, shot.size)
    radius = 315 + deviation
    theta = np.radians(angle)
    points_mm = np.stack([900 + axial, radius * np.cos(theta), 300 + radius * np.sin(theta)], axis=1)
    return PartCloud(
        points_mm=points_mm,
        label=label,
        deviation_mm=deviation.astype(np.float32),
        angle_deg=angle.astype(np.float32),
        axial_mm=axial.astype(np.float32),
        shot=shot,
    )


def hand_eye(shots: int = 6) -> HandEye:
    """A made-up calibration."""
    random = np.random.default_rng(2)

    def sphere() -> ArtefactSphere:
        return ArtefactSphere(
            centre_mm=random.normal([0, 0, 420], 30),
            covariance_mm2=np.eye(3) * 1e-5,
            rms_mm=float(random.uniform(0.02, 0.04)),
            points=int(random.integers(8000, 12000)),
            residual_mm=float(random.uniform(0.01, 0.06)),
        )

    touched = np.array([53.33, 74.26, 54.99])
    return HandEye(
        flange_from_scanner=np.eye(4),
        covariance=np.eye(6) * 1e-6,
        residual_rms_mm=0.0351,
        per_shot=tuple(
            ArtefactShot(
                shot=f"artefact-{index + 1}",
                spheres=tuple(sphere() for _ in range(3)),
                distances_mm=touched + random.normal(0, 0.01, 3),
                residual_rms_mm=float(random.uniform(0.02, 0.05)),
                left_out_error_mm=float(random.uniform(0.02, 0.07)),
            )
            for index in range(shots)
        ),
        touched_distances_mm=touched,
        reduced_chi2=1.07,
        working_point_u_mm=0.014,
        id="he-7f3a91c2",
        date="2020-01-01T00:00:00Z",
    )


def inspection(
    points: int = 20_000, *, scale: float = 1.0, norms: tuple[str, ...] = ("pnae-g-7-010-89",)
) -> Inspection:
    """A whole made-up inspection; `scale` multiplies the step."""
    angle = np.concatenate([np.arange(low, high + 1, 2) for low, high in ARCS])
    random = np.random.default_rng(3)
    step = scale * step_at(angle) + random.normal(0, 0.003, angle.size)
    edges = np.arange(-0.1, 0.8, 0.02)
    centres = (edges[1:] + edges[:-1]) / 2
    counts = np.rint(9000 * np.exp(-(((centres - 0.33) / 0.07) ** 2)) + 120 * random.random(centres.size)).astype(int)
    kept = counts >= 0.2 * counts.max()
    largest = int(np.argmax(np.abs(step)))
    result = StepResult(
        mean_mm=float(step.mean()),
        median_mm=float(np.median(step)),
        max_abs_mm=float(abs(step[largest])),
        max_abs_at_deg=float(angle[largest]),
        expanded_uncertainty_mm=0.031,
        histogram=Histogram(edges, counts, kept, float((counts * centres)[kept].sum() / counts[kept].sum())),
        angle_deg=angle,
        step_mm=step,
        u_mm=np.full(angle.size, 0.024) + 0.01 * np.abs(np.sin(angle)),
        budget=(
            BudgetLine("noise of the phase", 0.004, "residuals of the walls, 31 effective points per bin"),
            BudgetLine("extrapolation to the seam", 0.011, "covariance of the walls' lines, 6.5 mm beyond their data"),
            BudgetLine("hand-eye and robot pose", 0.0, "both walls lie in each shot: the pose does not enter"),
            BudgetLine("local bias of the scanner", 0.0102, "spread of the sphere radii, 0.010 mm"),
        ),
        harmonics_mm={
            "diameter_difference": 0.5,
            "diameter_difference_u": 0.01,
            "axis_offset": 0.16,
            "axis_offset_u": 0.02,
            "axis_offset_at_deg": 205.0,
        },
        angle_between_walls_deg=0.04,
        angle_between_walls_u_deg=0.03,
        coverage_deg=100.0,
    )
    verdicts = sum(
        (judge(norm, result.max_abs_mm, result.expanded_uncertainty_mm, PART, coverage_deg=100.0) for norm in norms), ()
    )
    pixels = 1280 * 960
    masks = {
        f"{kind}-{index + 1}": {
            "ok": (ok := int(share * pixels)),
            "dark": (dark := int(0.8 * (pixels - ok))),
            "saturated": (saturated := int(0.1 * (pixels - ok))),
            "order_in_doubt": pixels - ok - dark - saturated - 100,
            "no_fit": 100,
        }
        for kind, count, share in (("artefact", 6, 0.41), ("part", 2, 0.63))
        for index in range(count)
    }
    return Inspection(
        session="open-630",
        part=PART,
        method="surface",
        frame="base",
        step=result,
        hand_eye=hand_eye(),
        cloud=cloud(points),
        verdicts=verdicts,
        left_out=(("artefact-7", "only two spheres of 20 mm in view"),),
        findings=(warning("coverage", "the part covers only 61 % of part-2", "part-2"),),
        masks=masks,
        timing_s={"read": 0.61, "decode": 0.18, "triangulate": 0.11, "spheres": 0.09, "segment": 0.1, "step": 0.08},
        software={"weldscan": "0.1.0", "python": "3.11.7", "numpy": "2.4.6", "session_sha256": "7e" * 32},
    )


def nothing_measured() -> Inspection:
    """What is left where only one wall was in view."""
    whole = inspection(2000)
    return replace(
        whole,
        step=None,
        hand_eye=None,
        cloud=None,
        frame="scanner",
        verdicts=judge("pnae-g-7-010-89", None, None, PART, why_not_measured="only one wall is in view"),
    )


# --- with what bars it ------------------------------------------------------------------------------------------------


def with_findings(
    whole: Inspection, *findings: Finding, coverage: Coverage | None = None, required_deg: float | None = None
) -> Inspection:
    """The same inspection with these findings, judged again."""
    verdicts = sum(
        (
            judge(
                judgement.norm,
                judgement.value_mm,
                judgement.expanded_uncertainty_mm,
                PART,
                coverage_deg=whole.step.coverage_deg,
                required_coverage_deg=required_deg,
                bars=findings,
            )
            for judgement in whole.verdicts
        ),
        (),
    )
    return replace(whole, findings=findings, verdicts=verdicts, coverage=coverage)


def seam_bin(angle_deg: float, measured: bool, **fate: int) -> SeamBin:
    """One bin, with a cap where it was measured."""
    course = course_of(PART)
    along = course.along_mm(course.at(angle_deg))
    return SeamBin(angle_deg, along, measured, fate, 12.4 if measured else None, (-6.1, 6.3) if measured else None)


def seam_of(whole: Inspection, required: tuple[float, float]) -> tuple[SeamBin, ...]:
    """Every bin of the required arc: measured where the profile is; a counterbore at 84-90, a dark arc between."""
    seen = set(whole.step.angle_deg.tolist())
    bins = []
    for angle in np.arange(required[0], required[1] + 1, 2.0).tolist():
        if angle not in seen:
            bins.append(seam_bin(angle, False, dark=2600, saturated=160, hidden=300))
        elif 84 <= angle <= 90:
            bins.append(seam_bin(angle, True, wall=1800, transition=300, cap=700, gated=900, off_line=40, dark=20))
        else:
            bins.append(seam_bin(angle, True, wall=2700, transition=60, cap=740, dark=30, order_in_doubt=12))
    return tuple(bins)


def barred(points: int = 20_000, norms: tuple[str, ...] = ("pnae-g-7-010-89", "iso-5817:B", "nb-4232")) -> Inspection:
    """What would be a PASS but for a gap, points that no wall took, and two shots that disagree."""
    whole = inspection(points, norms=norms)
    findings = (
        bar("coverage", "113° to 171° of the seam were required and not seen", at_deg=142.0),
        *(
            bar(
                "points-without-wall",
                f"{900 + at:.0f} points beside the seam that neither wall nor cap explains",
                "part-1",
                at,
            )
            for at in (84.0, 86.0, 88.0, 90.0)
        ),
        bar("shots-disagree", "part-1 and part-2 differ by 0.412 mm at the seam, their joint U is 0.061 mm"),
        warning("response", "part-2: the projector is not linear", "part-2"),
        note("verification", "the scanner: no verification on record"),
    )
    coverage = Coverage(100.0, 158.0, "views", ((113.0, 171.0),))
    return replace(with_findings(whole, *findings, coverage=coverage), seam=seam_of(whole, (62.0, 222.0)))


def made_up(verdict: Verdict = Verdict.PASS, *, day: int = 0, scanner: str = "s1", value: float = 0.05) -> Verification:
    """A verification `day` days from now."""
    date = datetime.now(UTC) + timedelta(days=day)
    each = Characteristic(
        name="SD",
        title="sphere-spacing error",
        value_mm=value,
        where="artefact-1, spheres 1-2",
        mean_mm=value / 2,
        std_mm=0.01,
        positions=18,
        required_positions=7,
        points=None,
        limit_mm=0.1,
        u_mm=0.01,
        verdict=verdict,
        reason="",
    )
    return Verification(
        session=f"day {day}",
        scanner=scanner,
        date=date.isoformat(timespec="seconds"),
        date_from="given",
        valid_until=(date + timedelta(days=365)).isoformat(timespec="seconds"),
        characteristics=(each,),
        balls=(),
        spacings=(),
        planes=(),
        lost=(),
        assumed=(),
        warnings=(),
        limits={},
        software={"version": "0", "session_sha256": f"{day}"},
    )
