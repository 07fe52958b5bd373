"""Norms as data, and the one evaluator that judges by them.

A norm is a TOML file in this folder: where it applies, which clause a joint falls under, and per clause a table of
thickness, in one or more readings where its text is ambiguous or has quality levels. Numbers are kept as written and
computed with as fractions, so that a limit is exactly what a pencil gives, at the edges of the intervals too.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache
from importlib import resources
from typing import Any

from weldscan.errors import InputError
from weldscan.result import WHOLE_TURN_DEG, Finding, Judgement, Severity, Verdict, bar

EVIDENCE = {
    "V": "read in a source",
    "S": "second-hand transcription",
    "M": "unverified: from memory",
}
MM = {"mm": Fraction(1), "in": Fraction(254, 10)}
# How many bars a verdict's reason names; the result lists them all.
NAMED_BARS = 2
# Of a distribution: 0, 1, ... 100 %.
QUANTILES = 101


@dataclass(frozen=True)
class Row:
    """Above the thickness `over` (from it, where `closed`): limit = factor x thickness + plus, at most `at_most`."""

    over: Fraction
    closed: bool
    factor: Fraction
    plus: Fraction
    at_most: Fraction | None

    def limit(self, thickness: Fraction) -> Fraction:
        """In the norm's own unit."""
        limit = self.factor * thickness + self.plus
        return limit if self.at_most is None else min(limit, self.at_most)

    def __str__(self) -> str:
        terms = [f"{float(self.factor):g} S"] if self.factor else []
        terms += [f"{float(self.plus):g}"] if self.plus or not terms else []
        return " + ".join(terms) + (f", at most {float(self.at_most):g}" if self.at_most is not None else "")


@dataclass(frozen=True)
class Clause:
    """One table of limits, in one or more readings."""

    id: str
    title: str
    evidence: str
    readings: Mapping[str, tuple[Row, ...]]
    note: str = ""


@dataclass(frozen=True)
class Norm:
    """A norm's file."""

    id: str
    title: str
    short: str
    edition: str
    unit: str
    quantity: str
    note: str
    levels: tuple[str, ...]
    joints: Mapping[str, str]
    clauses: Mapping[str, Clause]
    scope: Mapping[str, Any] = field(default_factory=dict)


def norm_ids() -> tuple[str, ...]:
    """The ids that `judge` knows, each quality level on its own.

    Example:
        >>> from weldscan.norms import norm_ids
        >>> {"iso-5817:B", "iso-5817:C", "iso-5817:D", "nb-4232", "pnae-g-7-010-89"} <= set(norm_ids())
        True
    """
    return tuple(
        f"{norm.id}:{level}" if level else norm.id for norm in _norms().values() for level in norm.levels or ("",)
    )


def load_norm(norm_id: str) -> tuple[Norm, str | None]:
    """A norm and, where it has quality levels, the one asked for.

    Args:
        norm_id: `pnae-g-7-010-89`, `iso-5817:B` ...; upper and lower case are the same.

    Raises:
        InputError: no such norm or level; the message lists those that there are.
    """
    name, _, level = norm_id.strip().partition(":")
    norm, level = _norms().get(name.casefold()), level.upper()
    if norm is None or (level not in norm.levels if norm.levels else level):
        raise InputError(f"norm: there is no {norm_id!r}; there are {', '.join(norm_ids())}")
    return norm, level or None


@cache
def _norms() -> dict[str, Norm]:
    files = sorted(
        (file for file in resources.files(__name__).joinpath("data").iterdir() if file.name.endswith(".toml")),
        key=lambda file: file.name,
    )
    return {norm.id: norm for norm in (_read(file.read_text(encoding="utf-8")) for file in files)}


def _read(text: str) -> Norm:
    data = tomllib.loads(text, parse_float=Fraction)

    def row(cells: Mapping[str, Any]) -> Row:
        at_most = cells.get("at_most")
        return Row(
            over=Fraction(cells.get("over", cells.get("from", 0))),
            closed="from" in cells,
            factor=Fraction(cells.get("factor", 0)),
            plus=Fraction(cells.get("plus", 0)),
            at_most=None if at_most is None else Fraction(at_most),
        )

    clauses = [
        Clause(
            id=clause["id"],
            title=clause["title"],
            evidence=clause["evidence"],
            note=clause.get("note", ""),
            readings={name: tuple(map(row, rows)) for name, rows in clause["readings"].items()},
        )
        for clause in data["clause"]
    ]
    return Norm(
        **{name: data[name] for name in ("id", "title", "short", "edition", "unit", "quantity", "note", "joints")},
        levels=tuple(data.get("levels", ())),
        clauses={clause.id: clause for clause in clauses},
        scope=data.get("scope", {}),
    )


def limit_mm(norm_id: str, clause_id: str, thickness_mm: float) -> tuple[float, str, dict[str, float]] | None:
    """The limit of a clause for one thickness: the lowest of its readings.

    Args:
        norm_id: as for `judge`.
        clause_id: one of the norm's clauses.
        thickness_mm: rated thickness, mm.

    Returns:
        The limit in mm, the reading that gives it, and the limits of all readings that were considered (the asked
        level's alone, where the norm has levels); None where the table has no row for this thickness.

    Example:
        >>> from weldscan.norms import limit_mm
        >>> limit_mm("pnae-g-7-010-89", "Table 1, column 2", 6)
        (1.1, 'as_printed', {'as_printed': 1.1})
    """
    norm, level = load_norm(norm_id)
    to_mm = MM[norm.unit]
    thickness = _exact(thickness_mm) / to_mm
    readings = norm.clauses[clause_id].readings
    limits: dict[str, float] = {}
    for name, rows in readings.items():
        fitting = [row for row in rows if thickness > row.over or (row.closed and thickness == row.over)]
        if fitting and (level is None or name == level):
            limits[name] = float(fitting[-1].limit(thickness) * to_mm)
    if not limits:
        return None
    lowest = min(limits, key=lambda name: limits[name])
    return limits[lowest], lowest, limits


def judge(
    norm_id: str,
    value_mm: float | None,
    expanded_uncertainty_mm: float | None,
    part: Mapping[str, Any],
    *,
    why_not_measured: str = "",
    coverage_deg: float | None = None,
    required_coverage_deg: float | None = None,
    guard_factor: float = 1.0,
    bars: Iterable[Finding] = (),
    quantiles_mm: Sequence[float] | None = None,
) -> tuple[Judgement, ...]:
    """The verdict of one norm on a measured step, by the decision rule of ISO 14253-1.

    With the guard band g = `guard_factor` x U: PASS where |h| <= L - g, FAIL where |h| > L + g, INCONCLUSIVE between.
    With the distribution of |h| (`quantiles_mm`): PASS where q95 <= L, FAIL where q05 > L (JCGM 106).
    What lies outside the norm's scope is NOT ASSESSABLE; what has no value is NOT MEASURED; a value without an
    uncertainty never passes. Too little of the seam, or a finding that bars, turns PASS into INCONCLUSIVE and leaves
    every other verdict as it is.

    Args:
        norm_id: one of `norm_ids()`.
        value_mm: the step h, mm, signed or not; None or NaN where it was not measured.
        expanded_uncertainty_mm: U of it, k = 2, mm.
        part: `kind`, `joint`, `wall_thickness` and, where they are known, `other_wall_thickness`,
            `machined_after_welding`, `side`: the session's `part`.
        why_not_measured: the reason to show with NOT MEASURED.
        coverage_deg: how much of the seam's turn was seen; shown with the verdict.
        required_coverage_deg: a seam of which less was seen does not pass (it can still fail).
        guard_factor: 1 is the rule's default.
        bars: findings of the inspection; those of severity `bar` count, the others change nothing.
        quantiles_mm: (101,) of |h|, 0, 1, ... 100 %, where its distribution is known; it decides then, and value and
            uncertainty are shown.

    Returns:
        One judgement; its `barred_by` says what kept the number from being a PASS.

    Raises:
        InputError: no such norm.

    Example:
        >>> from weldscan.norms import judge
        >>> part = {"kind": "pipe", "joint": "circumferential butt", "wall_thickness": 6.0}
        >>> for verdict in judge("pnae-g-7-010-89", 0.405, 0.03, part):
        ...     print(verdict.verdict, verdict.limit_mm)
        PASS 1.1
    """
    norm, level = load_norm(norm_id)
    value = _finite(value_mm)
    quantiles = () if quantiles_mm is None or value is None else tuple(float(q) for q in quantiles_mm)
    if quantiles and (len(quantiles) != QUANTILES or not all(map(math.isfinite, quantiles))):
        raise InputError(f"quantiles_mm: {QUANTILES} finite numbers are needed, 0, 1, ... 100 %")
    uncertainty = _finite(expanded_uncertainty_mm)
    clause_id = norm.joints.get(str(part.get("joint", "")))
    clause = norm.clauses[clause_id] if clause_id is not None else None
    details: dict[str, Any] = {
        "title": norm.title,
        "edition": norm.edition,
        "unit": norm.unit,
        "quantity": norm.quantity,
        "note": " ".join(note for note in (norm.note, clause.note if clause else "") if note),
        "decision_rule": (
            "JCGM 106, the 5 % and 95 % quantiles of the largest step"
            if quantiles
            else f"ISO 14253-1, guard band {guard_factor:g} U, U with k = 2"
        ),
    }
    if level is not None:
        details["level"] = level
    if clause is not None:
        details |= {"clause_title": clause.title, "evidence": EVIDENCE[clause.evidence]}
        details["unverified"] = clause.evidence == "M"
    if coverage_deg is not None:
        details["coverage_deg"] = coverage_deg

    limit = None

    def verdict(verdict: Verdict, reason: str, barred_by: tuple[Finding, ...] = ()) -> tuple[Judgement, ...]:
        return (
            Judgement(
                norm=norm_id,
                clause=clause.id if clause else "",
                limit_mm=limit,
                value_mm=value,
                expanded_uncertainty_mm=uncertainty,
                verdict=verdict,
                reason=reason,
                details=details,
                barred_by=barred_by,
                quantiles_mm=quantiles,
            ),
        )

    if clause is None:
        return verdict(
            Verdict.NOT_ASSESSABLE,
            f"{norm.short} has no clause for the joint {part.get('joint', '')!r}, only for: {', '.join(norm.joints)}",
        )
    thicknesses = _thicknesses(part)
    if not thicknesses:
        return verdict(Verdict.NOT_ASSESSABLE, "the rated wall thickness is not known")
    outside = _outside_scope(norm, part, thicknesses)
    if outside:
        return verdict(Verdict.NOT_ASSESSABLE, outside)
    found = limit_mm(norm_id, clause.id, min(thicknesses))
    if found is None:
        return verdict(Verdict.NOT_ASSESSABLE, f"{norm.short} gives no limit for a wall of {min(thicknesses):g} mm")
    limit, reading, readings = found
    details |= {"thickness_mm": min(thicknesses), "reading": reading, "readings_mm": readings}
    if len(readings) > 1:
        both = ", ".join(f"{name.replace('_', ' ')} {value:.3f} mm" for name, value in readings.items())
        details["reading_note"] = f"ambiguous table ({both}): judged by the lower, {reading.replace('_', ' ')}"

    if value is None:
        return verdict(Verdict.NOT_MEASURED, why_not_measured or "the step was not measured")
    if uncertainty is None or uncertainty < 0:
        return verdict(Verdict.INCONCLUSIVE, "the uncertainty of the step is not known, so nothing can be decided")

    seen = (
        ""
        if coverage_deg is None or coverage_deg >= 360
        else f", in the {coverage_deg:.0f}° of the seam that were seen"
    )
    guard, step = _exact(guard_factor) * _exact(uncertainty), abs(_exact(value))
    below_by, above_by = (_exact(quantiles[5]), _exact(quantiles[95])) if quantiles else (step - guard, step + guard)
    how = "95 %" if quantiles else "k = 2"
    about = f"{abs(value):.3f} mm ± {uncertainty:.3f} mm ({how}) against {limit:.3f} mm"
    if below_by > _exact(limit):
        return verdict(Verdict.FAIL, f"{about}: above the limit by more than the guard band{seen}")
    if above_by > _exact(limit):
        return verdict(Verdict.INCONCLUSIVE, f"{about}: nearer to the limit than the guard band{seen}")
    below = f"{about}: below the limit by at least the guard band{seen}"
    barred = _barred(bars, coverage_deg, required_coverage_deg)
    if not barred:
        return verdict(Verdict.PASS, below)
    named = "; ".join(str(each) for each in barred[:NAMED_BARS])
    more = f"; and {len(barred) - NAMED_BARS} more" if len(barred) > NAMED_BARS else ""
    return verdict(Verdict.INCONCLUSIVE, f"would be PASS but for {named}{more} ({below})", barred)


def _barred(findings: Iterable[Finding], seen_deg: float | None, required_deg: float | None) -> tuple[Finding, ...]:
    """What bars PASS: the findings that do, and too little of the seam, where none of them says so already."""
    barred = tuple(each for each in findings if each.severity is Severity.BAR)
    if required_deg is None or (seen_deg is not None and seen_deg >= required_deg):
        return barred
    if any(each.code == "coverage" for each in barred):
        return barred
    required = "the whole seam is" if required_deg >= WHOLE_TURN_DEG else f"{required_deg:g}° are"
    seen = (
        "it is not known how much of the seam was seen"
        if seen_deg is None
        else f"{seen_deg:.0f}° of the seam were seen"
    )
    return (bar("coverage", f"{seen}, {required} required"), *barred)


def _thicknesses(part: Mapping[str, Any]) -> tuple[float, ...]:
    found = (_finite(part.get(name)) for name in ("wall_thickness", "other_wall_thickness"))
    return tuple(thickness for thickness in found if thickness is not None and thickness > 0)


def _outside_scope(norm: Norm, part: Mapping[str, Any], thicknesses: tuple[float, ...]) -> str:
    """Why the norm says nothing about this part; empty where it does."""
    if norm.scope.get("equal_thickness") and len(set(thicknesses)) > 1:
        walls = " and ".join(f"{thickness:g} mm" for thickness in thicknesses)
        return f"{norm.short} holds for parts of equal rated thickness, these have {walls}"
    if norm.scope.get("machined_after_welding") is False and part.get("machined_after_welding"):
        return f"{norm.short} holds for joints that were not machined after welding, this one was"
    side = part.get("side", "welding")
    if norm.scope.get("side", side) != side:
        return f"{norm.short} holds on the side of the {norm.scope['side']}, this is the {side} side"
    return ""


def _finite(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)


def _exact(value: float) -> Fraction:
    """The decimal number that people see, not the binary one nearest to it."""
    return Fraction(repr(float(value)))
