"""What the history of a scanner's verifications says of its drift."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from weldscan.records.fields import moment
from weldscan.records.history import History, Record
from weldscan.result import Drift, Verification

YEAR_S = 365.25 * 86_400
# Two verifications make a line, three say how well it is known.
LEAST_FOR_DRIFT = 3
# Student's t, two-sided 95 %, by degrees of freedom; beyond them the next lower one's, which is on the safe side.
STUDENT_T = {
    **{1: 12.706, 2: 4.303, 3: 3.182, 4: 2.776, 5: 2.571, 6: 2.447, 7: 2.365, 8: 2.306, 9: 2.262, 10: 2.228},
    **{12: 2.179, 15: 2.131, 20: 2.086, 30: 2.042, 60: 2.000, 120: 1.980},
}


def with_drift(found: Verification, history: History) -> Verification:
    """The verification with the drift of its scanner over the history and itself."""
    # A session that was evaluated again is no other state of the scanner: its last evaluation stands for it.
    by_session = {record.session_sha256: record for record in history.of(found.scanner)}
    by_session.pop(found.software.get("session_sha256", ""), None)
    records = list(by_session.values())
    notes = list(history.notes)
    if history.broken is not None:
        notes.append(f"{history.path}: cannot be relied upon: {history.broken}")
    others = {r.scanner for r in history.records} - {found.scanner}
    if others:
        notes.append(
            f"{history.path}: holds verifications of {len(others)} other scanner(s) or calibrations; they do not count"
        )
    return replace(
        found, drift=tuple(_drift(each.name, found, records) for each in found.characteristics), notes=tuple(notes)
    )


def _drift(name: str, found: Verification, records: Sequence[Record]) -> Drift:
    now = found[name]
    rows = [
        (r.when, r.characteristics[name].mean_mm, r.characteristics[name].value_mm, r.date)
        for r in records
        if name in r.characteristics
    ]
    rows.append((moment(found.date, "date"), now.mean_mm, now.value_mm, found.date))
    rows = sorted((row for row in rows if row[1] is not None and row[2] is not None), key=lambda row: row[0])
    years = np.array([row[0].timestamp() for row in rows]) / YEAR_S
    means = np.array([row[1] for row in rows], dtype=float)
    rate, expanded, text = slope(years, means)
    return Drift(
        name=name,
        dates=tuple(row[3] for row in rows),
        mean_mm=tuple(means.tolist()),
        value_mm=tuple(float(row[2]) for row in rows if row[2] is not None),
        rate_mm_per_year=rate,
        rate_u_mm_per_year=expanded,
        text=text,
    )


def slope(
    years: Sequence[float] | np.ndarray, values_mm: Sequence[float] | np.ndarray
) -> tuple[float | None, float | None, str]:
    """Rate of a straight line through values, half the width of its 95 % interval, and both in words.

    >>> rate, u, text = slope([0.0, 0.5, 1.0, 1.5], [0.010, 0.015, 0.020, 0.025])
    >>> round(rate, 9), round(u, 9)
    (0.01, 0.0)
    """
    t, y = np.asarray(years, dtype=float), np.asarray(values_mm, dtype=float)
    n = len(t)
    if n < LEAST_FOR_DRIFT:
        return None, None, f"{n} verification(s) of this scanner: drift needs {LEAST_FOR_DRIFT}"
    off = t - t.mean()
    spread = float(off @ off)
    # An hour: verifications in one go say nothing about years.
    if float(np.ptp(t)) * YEAR_S < 3600:
        return None, None, f"{n} verifications within an hour: no drift can be told"
    rate = float(off @ (y - y.mean())) / spread
    residual = y - y.mean() - rate * off
    sigma = math.sqrt(float(residual @ residual) / (n - 2) / spread)
    t95 = next(value for dof, value in sorted(STUDENT_T.items(), reverse=True) if dof <= n - 2)
    expanded = t95 * sigma
    told = "a drift" if abs(rate) > expanded else "no drift can be told"
    return rate, expanded, f"{rate:+.4f} ± {expanded:.4f} mm per year (95 %, {n} verifications): {told}"
