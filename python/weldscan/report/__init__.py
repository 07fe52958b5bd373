"""Writes what an inspection found: `result.json`, `report.html`, `profile.csv`, `cloud.ply`. Computes nothing of it."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from weldscan._weldcore import __version__
from weldscan.report import charts, page, pictures
from weldscan.result import ArtefactShot, HandEye, Inspection, Judgement, Label, PartCloud, StepResult, Verdict
from weldscan.session import plain, to_json, whole_folder

SCHEMA = "weldscan-result/1"
FILES = ("result.json", "report.html", "profile.csv", "cloud.ply")
CLASSES = {
    "reference_wall": Label.REFERENCE_WALL,
    "other_wall": Label.OTHER_WALL,
    "bead": Label.BEAD,
}
ICONS = {
    Verdict.PASS: "M16 28 L24 36 L39 19",
    Verdict.FAIL: "M18 18 L36 36 M36 18 L18 36",
    Verdict.INCONCLUSIVE: "M20 21 Q20 14 27 14 Q34 14 34 21 Q34 26 27 29 L27 32 M27 40 L27 40.2",
    Verdict.NOT_MEASURED: "M17 27 L37 27",
    Verdict.NOT_ASSESSABLE: "M17 27 L37 27",
}


def write_report(inspection: Inspection, out_dir: str | os.PathLike[str]) -> Path:
    """Writes the four files of a result as a whole folder and returns its path.

    Args:
        inspection: what `weldscan.inspect` returned.
        out_dir: must not exist yet, be empty, or be an earlier result, which is replaced once the new one is complete.

    Returns:
        The folder, with `result.json` (schema `weldscan-result/1`), `report.html` (self-contained), `profile.csv` and
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
        (folder / "profile.csv").write_text(profile_csv(inspection.step), encoding="utf-8")
        (folder / "result.json").write_text(to_json(result_document(inspection, created)), encoding="utf-8")
        (folder / "report.html").write_text(html(inspection, created), encoding="utf-8")
        cloud.result()
    return out


def _finite(cloud: PartCloud | None) -> PartCloud | None:
    """The cloud without points that have no place; there should be none."""
    # A sum is finite only if every term is.
    if cloud is None or math.isfinite(float(cloud.points_mm.sum()) + float(cloud.deviation_mm.sum())):
        return cloud
    good = np.isfinite(cloud.points_mm).all(axis=1) & np.isfinite(cloud.deviation_mm)
    return PartCloud(**{field.name: getattr(cloud, field.name)[good] for field in fields(PartCloud)})


def is_result(folder: Path) -> bool:
    """Whether a folder is an earlier result and holds nothing else, so that it may be replaced."""
    names = {entry.name for entry in folder.iterdir()}
    try:
        schema = json.loads((folder / "result.json").read_text(encoding="utf-8"))["schema"]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return names <= set(FILES) and str(schema).startswith("weldscan-result/")


def report_id(inspection: Inspection, created: datetime) -> str:
    """A number that no other report has: the day, and a hash of the session and the moment."""
    text = f"{inspection.session}|{inspection.software.get('session_sha256', '')}|{created.isoformat()}"
    return f"{created:%Y%m%d}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


# --- the files --------------------------------------------------------------------------------------------------------


def result_document(inspection: Inspection, created: datetime) -> dict[str, Any]:
    """`weldscan-result/1` as plain data; what has no value is null, never NaN."""
    step, hand_eye = inspection.step, inspection.hand_eye
    document = {
        "schema": SCHEMA,
        "report": report_id(inspection, created),
        "created": created.isoformat(timespec="seconds"),
        "session": inspection.session,
        "part": inspection.part,
        "frame": inspection.frame,
        "method": inspection.method,
        "verdict": inspection.verdict,
        "judged_mm": inspection.judged_mm,
        "step_mm": _step(step),
        "profile": _profile(step),
        "uncertainty_budget": [
            {"name": line.name, "standard_mm": line.standard_mm, "derived_from": line.derived_from}
            for line in (step.budget if step else ())
        ],
        "scanner": None if inspection.scanner is None else vars(inspection.scanner),
        "hand_eye": _hand_eye(hand_eye),
        "agreement": [vars(pair) for pair in inspection.agreement],
        "counts": counts(inspection.cloud),
        "verdicts": [_judgement(judgement) for judgement in inspection.verdicts],
        "verification": None if inspection.verification is None else vars(inspection.verification),
        "left_out": [{"shot": shot, "reason": reason} for shot, reason in inspection.left_out],
        "warnings": list(inspection.warnings),
        "masks": inspection.masks,
        "response": inspection.response,
        "timing_s": inspection.timing_s,
        "software": {"version": __version__, **inspection.software},
    }
    result: dict[str, Any] = plain(document)
    return result


def _step(step: StepResult | None) -> dict[str, Any]:
    histogram = step.histogram if step else None
    return {
        "mean": step.mean_mm if step else None,
        "median": step.median_mm if step else None,
        "max_abs": step.max_abs_mm if step else None,
        "max_abs_at_deg": step.max_abs_at_deg if step else None,
        "expanded_uncertainty": step.expanded_uncertainty_mm if step else None,
        "histogram": histogram.step_mm if histogram else None,
        "coverage_deg": step.coverage_deg if step else 0.0,
        "angle_between_walls_deg": step.angle_between_walls_deg if step else None,
        "harmonics": step.harmonics_mm if step else {},
    }


def _profile(step: StepResult | None) -> list[dict[str, Any]]:
    if step is None:
        return []
    rows = zip(step.angle_deg.tolist(), step.step_mm.tolist(), step.u_mm.tolist(), strict=True)
    return [{"angle_deg": angle, "step_mm": value, "u_mm": u} for angle, value, u in rows]


def _hand_eye(hand_eye: HandEye | None) -> dict[str, Any] | None:
    if hand_eye is None:
        return None
    return {
        "id": hand_eye.id,
        "date": hand_eye.date,
        "flange_from_scanner": hand_eye.flange_from_scanner,
        "covariance": hand_eye.covariance,
        "residual_rms_mm": hand_eye.residual_rms_mm,
        "reduced_chi2": hand_eye.reduced_chi2,
        "working_point_u_mm": hand_eye.working_point_u_mm,
        "pose_sigma_mm": hand_eye.pose_sigma_mm,
        "pose_sigma_rad": hand_eye.pose_sigma_rad,
        "sphere_sigma_ratio": hand_eye.sphere_sigma_ratio,
        "probe_bias_mm": hand_eye.probe_bias_mm,
        "probe_bias_u_mm": hand_eye.probe_bias_u_mm,
        "tilts_deg": hand_eye.tilts_deg,
        "warnings": hand_eye.warnings,
        "touched_distances_mm": hand_eye.touched_distances_mm,
        "per_shot": [artefact_shot(shot) for shot in hand_eye.per_shot],
    }


def artefact_shot(shot: ArtefactShot) -> dict[str, Any]:
    """One row of `hand_eye.per_shot`."""
    return {
        "shot": shot.shot,
        "residual_rms_mm": shot.residual_rms_mm,
        "left_out_error_mm": shot.left_out_error_mm,
        "chi2": shot.chi2,
        "outlier": shot.outlier,
        "distances_mm": shot.distances_mm,
        "spheres": [
            {
                "centre_mm": sphere.centre_mm,
                "covariance_mm2": sphere.covariance_mm2,
                "rms_mm": sphere.rms_mm,
                "points": sphere.points,
                "residual_mm": sphere.residual_mm,
            }
            for sphere in shot.spheres
        ],
    }


def _judgement(judgement: Judgement) -> dict[str, Any]:
    return {
        "norm": judgement.norm,
        "clause": judgement.clause,
        "limit_mm": judgement.limit_mm,
        "value_mm": judgement.value_mm,
        "expanded_uncertainty_mm": judgement.expanded_uncertainty_mm,
        "verdict": judgement.verdict,
        "reason": judgement.reason,
        "details": judgement.details,
    }


def counts(cloud: PartCloud | None) -> dict[str, int]:
    """How many points there are, in all and per class."""
    label = np.zeros(0, np.uint8) if cloud is None else cloud.label
    per_label = np.bincount(label, minlength=len(Label))
    return {"points": int(label.size)} | {name: int(per_label[value]) for name, value in CLASSES.items()}


def profile_csv(step: StepResult | None) -> str:
    """The profile as rows of text."""
    text = io.StringIO()
    text.write("angle_deg,step_mm,u_mm\n")
    for row in _profile(step):
        text.write(f"{row['angle_deg']:g},{row['step_mm']:.5f},{row['u_mm']:.5f}\n")
    return text.getvalue()


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
    with path.open("wb") as file:
        file.write(header.encode("ascii"))
        file.write(rows.view(np.uint8).data)


# --- the page ---------------------------------------------------------------------------------------------------------


def html(inspection: Inspection, created: datetime) -> str:
    """The report: one file without any reference to another."""
    with ThreadPoolExecutor(2) as beside:
        # The pictures are drawn while the template is loaded and compiled.
        view = beside.submit(_view, inspection.cloud)
        unrolled = beside.submit(_map, inspection.cloud, inspection.step)
        return _page(inspection, created, view, unrolled)


def _page(inspection: Inspection, created: datetime, view: Future[str | None], unrolled: Future[str | None]) -> str:
    from markupsafe import Markup

    step, cloud, hand_eye = inspection.step, inspection.cloud, inspection.hand_eye
    worst = next((j for j in inspection.verdicts if j.verdict == inspection.verdict), None)
    limits = [j.limit_mm for j in inspection.verdicts if j.limit_mm is not None]
    limit = worst.limit_mm if worst else min(limits, default=None)
    judged_u = worst.expanded_uncertainty_mm if worst else None
    if judged_u is None and step is not None:
        judged_u = step.expanded_uncertainty_mm
    drawings: dict[str, Any] = dict.fromkeys(("step_chart", "clock", "map_chart", "histogram_chart"))
    if step is not None and step.angle_deg.size:
        judged = None if inspection.judged_mm is None or judged_u is None else (inspection.judged_mm, judged_u)
        drawings["step_chart"] = charts.step_chart(step, limit, judged)
        drawings["clock"] = charts.clock(step)
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
        verdict=inspection.verdict.value,
        icon=ICONS[inspection.verdict],
        why=worst.reason if worst else "no norm was asked",
        limit=limit,
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


def part_line(part: Mapping[str, Any]) -> str:
    """The part in a few words: pipe 630 x 6 mm, circumferential butt."""
    diameter, wall = part.get("outside_diameter"), part.get("wall_thickness")
    size = f" {diameter:g} × {wall:g} mm" if diameter and wall else ""
    return f"{part.get('kind', 'part')}{size}, {part.get('joint', 'joint not named')}"


def _where(inspection: Inspection) -> str:
    if inspection.method == "paper" or inspection.step is None:
        return "by the paper's histogram"
    return f"at {inspection.step.max_abs_at_deg:.0f}°"


def _view(cloud: PartCloud | None) -> str | None:
    return None if cloud is None else pictures.cloud_view(cloud)


def _map(cloud: PartCloud | None, step: StepResult | None) -> str | None:
    if cloud is None or step is None or not cloud.label.size:
        return None
    angles = np.flatnonzero(np.bincount((cloud.angle_deg * np.float32(0.5) + np.float32(0.5)).astype(np.intp))) * 2.0
    arcs = charts.arcs_of(angles.tolist())
    few = cloud.axial_mm[:: max(1, cloud.axial_mm.size // 20_000)]
    low, high = (float(value) for value in np.percentile(few, (0.2, 99.8)))
    # Up to the largest step, so that full colour is never less than what the verdict is about.
    scale = next(value for value in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, math.inf) if value >= 1.05 * step.max_abs_mm)
    scale = scale if math.isfinite(scale) else step.max_abs_mm
    extent = pictures.Extent(tuple(arcs), low, max(high, low + 1e-3))
    return charts.map_chart(pictures.deviation_map(cloud, extent, scale), extent, scale)


def _classes(cloud: PartCloud | None) -> list[tuple[str, str, int]]:
    found = counts(cloud)
    return [(name.replace("_", " "), pictures.COLOURS[label], found[name]) for name, label in CLASSES.items()]


def _harmonics(step: StepResult | None) -> list[tuple[str, str]]:
    """`name`, with `name_u` as its expanded uncertainty and `name_at_deg` as its direction, where they are given."""
    terms = step.harmonics_mm if step else {}
    shown = []
    for name, value in terms.items():
        if name.endswith(("_u", "_at_deg")):
            continue
        u, at = terms.get(f"{name}_u"), terms.get(f"{name}_at_deg")
        text = (
            f"{value:.3f}"
            + (f" ± {u:.3f}" if u is not None else "")
            + " mm"
            + (f" at {at:.0f}°" if at is not None else "")
        )
        shown.append((name.replace("_", " "), text.replace("-", "−")))
    return shown


def _matrix(hand_eye: HandEye | None) -> str:
    if hand_eye is None:
        return ""
    return "\n".join(
        " ".join(f"{value:12.8f}" for value in row[:3]) + f" {row[3]:12.4f}"
        for row in hand_eye.flange_from_scanner.tolist()
    )


MASKS = ("ok", "dark", "saturated", "order in doubt", "no fit")
BARS = ("ok", "dark", "saturated", "doubt", "nofit")


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


def _record(inspection: Inspection) -> list[tuple[str, str]]:
    part = [(f"part: {name}", str(value)) for name, value in inspection.part.items() if value is not None]
    timing = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in inspection.timing_s.items())
    return [
        ("method judged", inspection.method),
        ("frame of the cloud", inspection.frame),
        ("verification of the scanner", _standing(inspection)),
        *part,
        ("projector's response", _response_line(inspection.response)),
        ("time", timing),
        *((name.replace("_", " "), value) for name, value in inspection.software.items()),
    ]
