"""`result.json`: an inspection as plain data, `weldscan-result/2` (docs/formats.md), and reading it back."""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from weldscan._weldcore import __version__
from weldscan.errors import InputError
from weldscan.records.files import is_earlier, plain, read_json
from weldscan.records.part import course_of
from weldscan.result import (
    FATES,
    Coverage,
    Inspection,
    Judgement,
    Label,
    PartCloud,
    Standing,
    StepResult,
    Verdict,
)

SCHEMA = "weldscan-result/2"
READABLE = ("weldscan-result/1", SCHEMA)
FILES = ("result.json", "report.html", "profile.csv", "cloud.ply")
CLASSES = {
    "reference_wall": Label.REFERENCE_WALL,
    "other_wall": Label.OTHER_WALL,
    "bead": Label.BEAD,
    "transition": Label.TRANSITION,
}
NO_VERIFICATION = Standing("none", "no verification on record")


def report_id(inspection: Inspection, created: datetime) -> str:
    """A number that no other report has: the day, and a hash of the session and the moment."""
    text = f"{inspection.session}|{inspection.software.get('session_sha256', '')}|{created.isoformat()}"
    return f"{created:%Y%m%d}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def is_result(folder: Path) -> bool:
    """Whether a folder is an earlier result and holds nothing else, so that it may be replaced."""
    return is_earlier(folder, FILES, FILES[0], "weldscan-result/")


# --- writing ----------------------------------------------------------------------------------------------------------


def result_document(inspection: Inspection, created: datetime) -> dict[str, Any]:
    """`weldscan-result/2` as plain data; what has no value is null or absent, never NaN."""
    step = inspection.step
    document = {
        "schema": SCHEMA,
        "report": report_id(inspection, created),
        "created": created.isoformat(timespec="seconds"),
        "session": inspection.session,
        "part": inspection.part,
        "frame": inspection.frame,
        "method": inspection.method,
        "verdict": inspection.verdict,
        "headline": _headline(inspection),
        "judged_mm": inspection.judged_mm,
        "step_mm": _step(step),
        "profile": profile(step, inspection.part),
        "seam": [vars(each) | {"fate": {name: each.fate.get(name, 0) for name in FATES}} for each in inspection.seam],
        "coverage": _coverage(inspection.coverage, inspection.seen_deg),
        "uncertainty_budget": step.budget if step else (),
        "hand_eye": None if inspection.hand_eye is None else _but(inspection.hand_eye, "centres_base_mm"),
        "counts": counts(inspection.cloud),
        "verdicts": [_but(judgement, "barred_by") for judgement in inspection.verdicts],
        "judgements": [_judgement(judgement) for judgement in inspection.verdicts],
        "bars": [_but(finding, "severity") for finding in inspection.bars],
        "findings": inspection.findings,
        "verification": _standing(inspection.verification or NO_VERIFICATION),
        "left_out": [{"shot": shot, "reason": reason} for shot, reason in inspection.left_out],
        "warnings": inspection.warnings,
        "software": {"version": __version__, **inspection.software},
    }
    # Whatever else was found is written under its own name.
    result: dict[str, Any] = plain(document | _but(inspection, "step", "cloud", *document))
    return result


def _but(found: Any, *names: str) -> dict[str, Any]:
    """The fields of a frozen value, without some."""
    return {name: value for name, value in vars(found).items() if name not in names}


def headline_text(inspection: Inspection) -> str:
    """The verdict in one line: how much was seen, by which clause, how sure its limit, why."""
    judgement = inspection.headline
    if judgement is None:
        return f"{inspection.words()}: no norm was asked"
    return f"{inspection.words()} by {judgement_text(judgement)}"


def judgement_text(judgement: Judgement) -> str:
    """By which clause, how sure its limit is, and why."""
    clause = f", {judgement.clause}" if judgement.clause else ""
    doubt = f" [{judgement.doubt}]" if judgement.doubt else ""
    return f"{judgement.norm}{clause}{doubt}: {judgement.reason}"


def _headline(inspection: Inspection) -> dict[str, Any]:
    judgement = inspection.headline
    return {
        "verdict": inspection.verdict,
        "words": inspection.words(),
        "norm": judgement.norm if judgement else None,
        "clause": judgement.clause if judgement else None,
        "rule": judgement.rule if judgement else None,
        "margin": judgement.margin if judgement else None,
        "evidence": judgement.evidence if judgement else None,
        "text": headline_text(inspection),
    }


def _step(step: StepResult | None) -> dict[str, Any]:
    if step is None:
        names = ("mean", "median", "max_abs", "max_abs_at_deg", "expanded_uncertainty", "histogram")
        return {**dict.fromkeys(names), "coverage_deg": 0.0, "harmonics": {}, "not_observable": []}
    histogram = step.histogram
    document = {
        "mean": step.mean_mm,
        "median": step.median_mm,
        "seam_mean": step.seam_mean_mm,
        "seam_mean_u": step.seam_mean_u_mm,
        "max_abs": step.max_abs_mm,
        "max_abs_at_deg": step.max_abs_at_deg,
        "expanded_uncertainty": step.expanded_uncertainty_mm,
        "q05": step.q05_mm,
        "q95": step.q95_mm,
        "judged": step.judged,
        "histogram": histogram.step_mm if histogram else None,
        "histogram_u": histogram.expanded_uncertainty_mm if histogram else None,
        "coverage_deg": step.coverage_deg,
        "harmonics": step.harmonics_mm,
        "not_observable": step.not_observable,
    }
    if step.quantiles_mm is not None:
        document["quantiles"] = step.quantiles_mm.tolist()
    if step.angle_between_walls_deg is not None:
        document["angle_between_walls_deg"] = step.angle_between_walls_deg
        document["angle_between_walls_u_deg"] = step.angle_between_walls_u_deg
    return document


BOTH_STEPS = ("wall_step_mm", "wall_u_mm", "edge_step_mm", "edge_u_mm")


def profile(step: StepResult | None, part: Mapping[str, Any]) -> list[dict[str, float]]:
    """The measured bins: those that hold a number with its uncertainty; `step_mm` is the judged one of both steps."""
    if step is None:
        return []
    columns: dict[str, Any] = {"angle_deg": step.angle_deg, "step_mm": step.step_mm, "u_mm": step.u_mm}
    columns |= {name: column for name in ("band_mm", *BOTH_STEPS) if (column := getattr(step, name)) is not None}
    rows = zip(*(column[step.measured].tolist() for column in columns.values()), strict=True)
    named = [dict(zip(columns, row, strict=True)) for row in rows]
    return [_along(row["angle_deg"], part) | row for row in named]


def _along(angle_deg: float, part: Mapping[str, Any]) -> dict[str, float]:
    course = course_of(part)
    return {} if course is None else {"along_mm": course.along_mm(course.at(course.told(angle_deg)))}


def profile_csv(step: StepResult | None, part: Mapping[str, Any]) -> str:
    """The profile as rows of text."""
    text = io.StringIO()
    both = () if step is None else tuple(name for name in BOTH_STEPS if getattr(step, name) is not None)
    names = ("angle_deg", "step_mm", "u_mm", "along_mm", *both)
    text.write(",".join(names) + "\n")
    for row in profile(step, part):
        cells = (f"{row[name]:.5f}" if name in row else "" for name in names[1:])
        text.write(",".join([f"{row['angle_deg']:g}", *cells]) + "\n")
    return text.getvalue()


def _coverage(coverage: Coverage | None, seen_deg: float) -> dict[str, Any]:
    if coverage is None:
        return {"seen_deg": seen_deg, "required_deg": None, "required_by": None, "gaps": []}
    return vars(coverage)


def _standing(standing: Standing) -> dict[str, Any]:
    return {**vars(standing), "good": standing.good}


def _judgement(judgement: Judgement) -> dict[str, Any]:
    lower, upper = judgement.interval_mm or (None, None)
    return {
        "norm": judgement.norm,
        "clause": judgement.clause,
        "rule": judgement.rule,
        "quantity": judgement.quantity,
        "limit": judgement.limit_mm,
        "value": judgement.value_mm,
        "u": judgement.expanded_uncertainty_mm,
        "upper": upper,
        "lower": lower,
        "margin": judgement.margin,
        "verdict": judgement.verdict,
        "reason": judgement.reason,
        "evidence": judgement.evidence,
        "probability_over_limit": judgement.probability_over_limit,
        "barred_by": sorted({finding.code for finding in judgement.barred_by}),
    }


def counts(cloud: PartCloud | None) -> dict[str, int]:
    """How many points were measured, in all and per class."""
    label = np.zeros(0, np.uint8) if cloud is None else cloud.label
    told = cloud is not None and cloud.counts
    per_label = told if told else np.bincount(label, minlength=len(Label)).tolist()
    return {"points": sum(per_label)} | {name: per_label[value] for name, value in CLASSES.items()}


# --- reading ----------------------------------------------------------------------------------------------------------


def read_result(path: str | os.PathLike[str]) -> dict[str, Any]:
    """A result that was written before, as the fields of `weldscan-result/2` have it.

    A file of `weldscan-result/1` is read too: `schema` stays what it was, its own fields are untouched, and those of /2
    are added as far as they follow from it. What was not looked for then (bars, fates) is empty, not found to be good.

    Args:
        path: a result's folder, or its `result.json`.

    Returns:
        The document; lengths in mm, as `docs/formats.md` describes it.

    Raises:
        InputError: there is no such file, it is not JSON, or not a result that this version knows.

    Example:
        >>> import tempfile
        >>> from weldscan import inspect, read_result, write_report
        >>> from weldscan.simulated import simulate_session
        >>> folder = tempfile.mkdtemp()
        >>> truth = simulate_session(folder + "/session")
        >>> out = write_report(inspect(folder + "/session"), folder + "/report")
        >>> read_result(out)["verdict"]
        'PASS'
    """
    path = Path(path)
    file = path / "result.json" if path.is_dir() else path
    document = read_json(file)
    schema = document.get("schema") if isinstance(document, dict) else None
    if schema not in READABLE:
        raise InputError(f"{file}: schema: must be one of {', '.join(READABLE)}, got {schema!r}")
    try:
        return _of_version_1(document) if schema == READABLE[0] else document
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{file}: is no whole result: {type(error).__name__}: {error}") from None


def _of_version_1(document: dict[str, Any]) -> dict[str, Any]:
    """What of /2 follows from /1."""
    verdicts = tuple(
        Judgement(**{**found, "verdict": Verdict(found["verdict"])})  # its fields have kept their names
        for found in document["verdicts"]
    )
    step = document["step_mm"]
    held = document.get("verification") or {}
    standing = {**vars(NO_VERIFICATION), **held, "state": _state_of_version_1(held)}
    inspection = Inspection(
        session=document["session"],
        part=document["part"],
        method=document["method"],
        frame=document["frame"],
        step=None,
        hand_eye=None,
        cloud=None,
        verdicts=verdicts,
        left_out=(),
        findings=(),
        masks={},
        timing_s={},
        software={},
        coverage=Coverage(step["coverage_deg"], 0.0, "", ()),
    )
    return document | {
        "headline": plain(_headline(inspection)),
        "profile": [
            row | _along(row["angle_deg"], document["part"]) for row in document["profile"] if None not in row.values()
        ],
        "seam": [],
        "coverage": _coverage(None, step["coverage_deg"]),
        "calibration": "not stated",
        "judgements": plain([_judgement(judgement) for judgement in verdicts]),
        "bars": [],
        "findings": [
            {"severity": "warning", "code": None, "shot": None, "at_deg": None, "text": text}
            for text in document["warnings"]
        ],
        "step_mm": step | {"not_observable": []},
        "verification": standing | {"good": standing["state"] == "verified"},
    }


def _state_of_version_1(held: Mapping[str, Any]) -> str:
    """What became `verification.state`: /1 had `good`, true without any verification too, and words."""
    if not held or held.get("history") is None:
        return "none"
    if held["good"]:
        return "verified"
    return "expired" if " expired on " in held["text"] else "failed"
