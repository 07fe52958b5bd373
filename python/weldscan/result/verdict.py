"""The five words of the answer, and one judgement under one clause of one norm."""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from weldscan.result.findings import Finding


class Verdict(StrEnum):
    """The answer to the inspector."""

    PASS = "PASS"
    FAIL = "FAIL"
    INCONCLUSIVE = "INCONCLUSIVE"
    NOT_MEASURED = "NOT MEASURED"
    NOT_ASSESSABLE = "NOT ASSESSABLE"


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
    quantiles_mm: tuple[float, ...] = ()
    """Of the magnitude, 0, 1, ... 100 %, where its distribution is known; else value and U stand for it."""

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
        """Lower and upper bound of the magnitude: its 5 % and 95 % quantiles, or |h| - U (not below zero) and |h| + U;
        None where one is unknown.
        """
        if self.quantiles_mm:
            return self.quantiles_mm[5], self.quantiles_mm[95]
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
        """Of |h| > L by its quantiles, or for a normal distribution about the value with u = U/2 (JCGM 106)."""
        if self.interval_mm is None or self.limit_mm is None:
            return None
        if self.quantiles_mm:
            return _share_over(self.quantiles_mm, self.limit_mm)
        value, u = abs(self.value_mm or 0.0), (self.expanded_uncertainty_mm or 0.0) / 2
        if u == 0:
            return float(value > self.limit_mm)
        above, below = ((side * value + self.limit_mm) / (u * math.sqrt(2)) for side in (-1, 1))
        return 0.5 * math.erfc(above) + 0.5 * math.erfc(below)


def _share_over(quantiles: tuple[float, ...], limit: float) -> float:
    """The share of a distribution above a limit, straight between its quantiles."""
    last = len(quantiles) - 1
    if limit < quantiles[0]:
        return 1.0
    k = bisect.bisect_right(quantiles, limit) - 1
    if k >= last:
        return 0.0
    return 1.0 - (k + (limit - quantiles[k]) / (quantiles[k + 1] - quantiles[k])) / last
