"""Writes what an inspection found: `result.json`, `report.html`, `profile.csv`, `cloud.ply`. Computes nothing of it."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from weldscan._weldcore import SeamCourse, __version__
from weldscan.records.files import to_json, whole_folder, write_synced
from weldscan.records.part import course_of
from weldscan.records.result import (
    CLASSES,
    FILES,
    SCHEMA,
    counts,
    headline_text,
    is_result,
    judgement_text,
    profile_csv,
    read_result,
    report_id,
    result_document,
)
from weldscan.report import charts, page, pictures
from weldscan.result import (
    Finding,
    HandEye,
    Inspection,
    Judgement,
    PartCloud,
    Severity,
    StepResult,
    Verdict,
)

__all__ = [
    "CLASSES",
    "FILES",
    "ICONS",
    "SCHEMA",
    "counts",
    "headline_text",
    "html",
    "is_result",
    "judgement_text",
    "part_line",
    "profile_csv",
    "read_result",
    "report_id",
    "result_document",
    "write_ply",
    "write_report",
]
ICONS = {
    Verdict.PASS: "M16 28 L24 36 L39 19",
    Verdict.FAIL: "M18 18 L36 36 M36 18 L18 36",
    Verdict.INCONCLUSIVE: "M20 21 Q20 14 27 14 Q34 14 34 21 Q34 26 27 29 L27 32 M27 40 L27 40.2",
    Verdict.NOT_MEASURED: "M17 27 L37 27",
    Verdict.NOT_ASSESSABLE: "M17 27 L37 27",
}
ORDER = (Severity.BAR, Severity.WARNING, Severity.NOTE)
# How many angles a line names before it is cut short.
SHOWN_PLACES = 8
# PASS of a part of the seam: a smaller tick on a piece of the ring.
PART_ICON = "M19 28 L25 34 L36 22 M27 9 A18 18 0 0 1 45 27"
FATE_NAMES = {
    "wall": "wall",
    "transition": "between wall and cap",
    "cap": "cap",
    "gated": "too far from any wall",
    "off_line": "camera and projector disagree",
    "dark": "dark",
    "saturated": "saturated",
    "order_in_doubt": "fringe order in doubt",
    "two_paths": "light on two paths",
    "outside_calibration": "outside the calibrated volume",
    "hidden": "hidden",
    "other": "neither wall nor cap",
}


def write_report(inspection: Inspection, out_dir: str | os.PathLike[str]) -> Path:
    """Writes the four files of a result as a whole folder and returns its path.

    Args:
        inspection: what `weldscan.inspect` returned.
        out_dir: must not exist yet, be empty, or be an earlier result, which is replaced once the new one is complete.

    Returns:
        The folder, with `result.json` (schema `weldscan-result/2`), `report.html` (self-contained), `profile.csv` and
        `cloud.ply`. The last two are there even where nothing was measured, then without rows.

    Raises:
        InputError: something else is in the way, or the folder cannot be written.
    """
    created = datetime.now(UTC)
    out = Path(out_dir)
    inspection = replace(inspection, cloud=_finite(inspection.cloud))
    with whole_folder(out, is_result) as folder, ThreadPoolExecutor(1) as beside:
        # Most of it is copying, which the interpreter can do while the pictures are drawn.
        cloud = beside.submit(write_ply, folder / "cloud.ply", inspection.cloud)
        write_synced(folder / "profile.csv", profile_csv(inspection.step, inspection.part))
        write_synced(folder / "result.json", to_json(result_document(inspection, created)))
        write_synced(folder / "report.html", html(inspection, created))
        cloud.result()
    return out


def _finite(cloud: PartCloud | None) -> PartCloud | None:
    """The cloud without points that have no place; there should be none."""
    # A sum is finite only if every term is.
    if cloud is None or math.isfinite(float(cloud.points_mm.sum()) + float(cloud.deviation_mm.sum())):
        return cloud
    good = np.isfinite(cloud.points_mm).all(axis=1) & np.isfinite(cloud.deviation_mm)
    arrays = [field.name for field in fields(PartCloud) if field.name != "counts"]
    return replace(cloud, counts=(), **{name: getattr(cloud, name)[good] for name in arrays})


# --- the files --------------------------------------------------------------------------------------------------------


def write_ply(path: Path, cloud: PartCloud | None) -> None:
    """Binary PLY, little-endian: x y z (float32, mm), label (uchar, `Label`), deviation (float32, mm). Never NaN."""
    vertex = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("label", "u1"), ("deviation", "<f4")])
    rows = np.empty(0 if cloud is None else len(cloud.label), vertex)
    if cloud is not None:
        for axis, name in enumerate("xyz"):
            rows[name] = cloud.points_mm[:, axis]
        rows["label"] = cloud.label
        rows["deviation"] = cloud.deviation_mm
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"comment weldscan {__version__}; mm; label 0 none, 1 reference wall, 2 other wall, 3 bead\n"
        f"element vertex {len(rows)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        "property uchar label\nproperty float deviation\nend_header\n"
    )
    write_synced(path, header, rows.view(np.uint8).data)


# --- the page ---------------------------------------------------------------------------------------------------------


def html(inspection: Inspection, created: datetime) -> str:
    """The report: one file without any reference to another."""
    with ThreadPoolExecutor(2) as beside:
        # The pictures are drawn while the template is loaded and compiled.
        view = beside.submit(_view, inspection.cloud)
        unrolled = beside.submit(_map, inspection.cloud, inspection.step, _course(inspection))
        return _page(inspection, created, view, unrolled)


def _page(inspection: Inspection, created: datetime, view: Future[str | None], unrolled: Future[str | None]) -> str:
    from markupsafe import Markup

    step, cloud, hand_eye = inspection.step, inspection.cloud, inspection.hand_eye
    headline = inspection.headline
    judged_u = headline.expanded_uncertainty_mm if headline else None
    if judged_u is None and step is not None:
        judged_u = step.expanded_uncertainty_mm
    guard = judged_u if judged_u is not None and math.isfinite(judged_u) else 0.0
    bars = _grouped(inspection.bars)
    marks = [charts.Mark(at, number) for number, group in enumerate(bars, 1) for at in group.places_deg]
    course = _course(inspection)
    drawings: dict[str, Any] = dict.fromkeys(("step_chart", "clock", "map_chart", "histogram_chart"))
    if inspection.seam or (step is not None and step.measured.any()):
        limits = _limits(inspection.verdicts, guard)
        drawings["step_chart"] = charts.seam_chart(
            step, limits, guard, inspection.seam, inspection.coverage, marks, course
        )
        drawings["clock"] = charts.clock(step, inspection.seen_deg, inspection.seam, inspection.coverage, marks)
    if step is not None and step.histogram is not None:
        drawings["histogram_chart"] = charts.histogram_chart(step.histogram)
    drawings["map_chart"] = unrolled.result()
    budget = [(line, line.standard_mm**2) for line in (step.budget if step else ())]
    total = sum(square for _, square in budget)
    return page.fill(
        "template.html",
        created,
        r=inspection,
        s=step,
        h=hand_eye,
        report_id=report_id(inspection, created),
        words=inspection.words(),
        tone=_tone(inspection, inspection.verdict),
        icon=PART_ICON if _tone(inspection, inspection.verdict) == "PART" else ICONS[inspection.verdict],
        headline=headline,
        tags=[
            (judgement, inspection.words(judgement.verdict), _tone(inspection, judgement.verdict))
            for judgement in inspection.verdicts
        ],
        bars=bars,
        findings=sorted(inspection.findings, key=lambda finding: ORDER.index(finding.severity)),
        seen_deg=math.floor(inspection.seen_deg + 1e-6),
        over=_over,
        warnings=[finding for finding in inspection.findings if finding.severity is Severity.WARNING],
        notes=[finding for finding in inspection.findings if finding.severity is Severity.NOTE],
        fates=[
            (name, text) for name, text in FATE_NAMES.items() if any(each.fate.get(name) for each in inspection.seam)
        ],
        judged_u=judged_u,
        judged_where=_where(inspection),
        part_line=part_line(inspection.part),
        view=view.result(),
        classes=_classes(cloud),
        harmonics=_harmonics(step),
        budget=[(line, square / total if total else 0.0) for line, square in budget],
        combined=math.sqrt(total),
        matrix=_matrix(hand_eye),
        mask_names=MASKS,
        masks=_masks(inspection.masks),
        response_names=_response_names(inspection.response),
        response_rows=_response_rows(inspection.response),
        record=_record(inspection),
        mm=lambda value: "–" if value is None or not math.isfinite(value) else f"{value:.3f}".replace("-", "−"),
        signed=lambda value: f"{value:+.3f}".replace("-", "−"),
        **{name: None if text is None else Markup(text) for name, text in drawings.items()},
    )


@dataclass(frozen=True)
class BarGroup:
    """Bars of one code in one shot, told as one."""

    code: str
    shot: str | None
    texts: tuple[str, ...]
    places_deg: tuple[float, ...]

    @property
    def places(self) -> str:
        """Shot and angles in words."""
        angles = [f"{at:.0f}°" for at in self.places_deg]
        shown = (
            ", ".join(angles)
            if len(angles) <= SHOWN_PLACES
            else f"{', '.join(angles[: SHOWN_PLACES - 1])} … {angles[-1]}"
        )
        return ", ".join(([self.shot] if self.shot else []) + ([f"at {shown}"] if shown else []))


def _grouped(bars: Sequence[Finding]) -> list[BarGroup]:
    groups: dict[tuple[str, str | None], list[Finding]] = {}
    for each in bars:
        groups.setdefault((each.code, each.shot), []).append(each)
    return [
        BarGroup(
            code,
            shot,
            tuple(dict.fromkeys(each.text for each in found)),
            tuple(sorted({each.at_deg for each in found if each.at_deg is not None})),
        )
        for (code, shot), found in groups.items()
    ]


def _tone(inspection: Inspection, verdict: Verdict) -> str:
    """The colour's name: PASS of the whole seam is green, of a part of it something else."""
    if verdict is Verdict.PASS and not inspection.whole:
        return "PART"
    return verdict.value.split()[0]


def _limits(judgements: Sequence[Judgement], guard_mm: float) -> list[charts.Limit]:
    """Every limit that was judged by, once, with whose it is."""
    whose: dict[float, list[str]] = {}
    for each in judgements:
        if each.limit_mm is not None:
            whose.setdefault(each.limit_mm, []).append(f"{each.norm}{f' ({each.doubt})' if each.doubt else ''}")
    band = f" ± {guard_mm:.3f}" if guard_mm else ""
    return [
        charts.Limit(value, f"limit {charts.number(value)}{band} mm: {', '.join(dict.fromkeys(names))}")
        for value, names in sorted(whose.items())
    ]


def part_line(part: Mapping[str, Any]) -> str:
    """The part in a few words: pipe 630 x 6 mm, circumferential butt."""
    diameter, wall = part.get("outside_diameter"), part.get("wall_thickness")
    size = f" {diameter:g} × {wall:g} mm" if diameter and wall else ""
    return f"{part.get('kind', 'part')}{size}, {part.get('joint', 'joint not named')}"


def _where(inspection: Inspection) -> str:
    if inspection.method == "paper" or inspection.step is None:
        return "by the paper's histogram"
    return f"at {inspection.step.max_abs_at_deg:.0f}{_course(inspection).unit}"


def _view(cloud: PartCloud | None) -> str | None:
    return None if cloud is None else pictures.cloud_view(cloud)


def _course(inspection: Inspection) -> SeamCourse:
    return course_of(inspection.part) or charts.GIRTH


def _map(cloud: PartCloud | None, step: StepResult | None, course: SeamCourse) -> str | None:
    if cloud is None or step is None or not cloud.label.size:
        return None
    bins = np.rint(cloud.angle_deg / np.float32(course.bin_width)).astype(np.intp)
    first = bins.min()
    arcs = charts.arcs_of(
        ((np.flatnonzero(np.bincount(bins - first)) + first) * course.bin_width).tolist(), course=course
    )
    few = cloud.axial_mm[:: max(1, cloud.axial_mm.size // 20_000)]
    low, high = (float(value) for value in np.percentile(few, (0.2, 99.8)))
    # Up to the largest step, so that full colour is never less than what the verdict is about.
    scale = next(value for value in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, math.inf) if value >= 1.05 * step.max_abs_mm)
    scale = scale if math.isfinite(scale) else step.max_abs_mm
    extent = pictures.Extent(tuple(arcs), low, max(high, low + 1e-3))
    return charts.map_chart(pictures.deviation_map(cloud, extent, scale), extent, scale, course)


def _classes(cloud: PartCloud | None) -> list[tuple[str, str, int]]:
    found = counts(cloud)
    return [(name.replace("_", " "), pictures.COLOURS[label], found[name]) for name, label in CLASSES.items()]


def _harmonics(step: StepResult | None) -> list[tuple[str, str | None]]:
    """Each term with its expanded uncertainty (`name_u`) and direction (`name_at_deg`); None: not observable."""
    terms = step.harmonics_mm if step else {}
    shown: list[tuple[str, str | None]] = []
    for name, value in terms.items():
        if name.endswith(("_u", "_at_deg")):
            continue
        u, at = terms.get(f"{name}_u"), terms.get(f"{name}_at_deg")
        # Without its uncertainty a number is no result.
        text = (
            None if u is None else f"{value:.3f} ± {u:.3f} mm{'' if at is None else f' at {at:.0f}°'}".replace("-", "−")
        )
        shown.append((name.replace("_", " "), text))
    missing = () if step is None else step.not_observable
    return shown + [(name.replace("_", " "), None) for name in missing if name != "angle_between_walls"]


def _over(probability: float) -> str:
    """The probability of a step above the limit, in words that claim no digits that a tail does not have."""
    if probability < 1e-4:
        return "P(over) < 0.01 %"
    return "P(over) > 99.99 %" if probability > 1 - 1e-4 else f"P(over) {100 * probability:.2g} %"


def _matrix(hand_eye: HandEye | None) -> str:
    if hand_eye is None:
        return ""
    return "\n".join(
        " ".join(f"{value:12.8f}" for value in row[:3]) + f" {row[3]:12.4f}"
        for row in hand_eye.flange_from_scanner.tolist()
    )


MASKS = ("ok", "dark", "saturated", "order in doubt", "no fit", "outside calibration")
BARS = ("ok", "dark", "saturated", "doubt", "nofit", "outside")


def _masks(masks: Mapping[str, Mapping[str, int]]) -> list[tuple[str, list[str], list[tuple[str, float]]]]:
    """Per shot: its cells, and the shares of its bar. The names of the reasons may be written with underscores."""
    rows = []
    for shot, found in masks.items():
        named = {name.replace("_", " "): count for name, count in found.items()}
        total = max(1, sum(named.values()))
        shares = [named.get(name, 0) / total for name in MASKS]
        rows.append((shot, [f"{100 * share:.1f} %" for share in shares], list(zip(BARS, shares, strict=True))))
    return rows


def _standing(inspection: Inspection) -> str:
    standing = inspection.verification
    if standing is None:
        return "no verification on record"
    held = "".join(f"; {what} {value}" for what, value in (("history", standing.history), ("id", standing.id)) if value)
    return standing.statement + held


def _response_names(response: Mapping[str, Any]) -> list[str]:
    first: list[dict[str, Any]] = next(iter(response.get("shots", {}).values()), [])
    return [f"{e['periods']:g} fringes, {e['steps']} steps" for e in first]


def _response_rows(response: Mapping[str, Any]) -> list[tuple[str, list[str]]]:
    """Per shot what was taken off the phase of each set; none where nothing was."""
    if not response.get("compensated"):
        return []

    def cell(error: Mapping[str, Any]) -> str:
        return "–" if error["from"] == "nothing" else f"{error['largest_rad']:.4f} ({error['from']})"

    return [(shot, [cell(error) for error in errors]) for shot, errors in response["shots"].items()]


def _response_line(response: Mapping[str, Any]) -> str:
    if not response:
        return "–"
    if response["mode"] == "off":
        return "not looked at, not compensated (off)"
    return str(response["note"] or "no error of the phase above the noise; nothing was compensated")


def _plain_mean(step: StepResult) -> tuple[str, str]:
    return (
        "mean, median over the other wall's points",
        f"{step.mean_mm:.3f} mm, {step.median_mm:.3f} mm; without uncertainty, judged by nothing",
    )


def _record(inspection: Inspection) -> list[tuple[str, str]]:
    part = [(f"part: {name}", str(value)) for name, value in inspection.part.items() if value is not None]
    timing = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in inspection.timing_s.items())
    mean = [] if inspection.step is None else [_plain_mean(inspection.step)]
    return [
        ("method judged", inspection.method),
        ("scanner's calibration in U", inspection.calibration),
        *mean,
        ("frame of the cloud", inspection.frame),
        ("verification of the scanner", _standing(inspection)),
        *part,
        ("projector's response", _response_line(inspection.response)),
        ("time", timing),
        *((name.replace("_", " "), value) for name, value in inspection.software.items()),
    ]
