"""What the history of a scanner's verifications says: its drift, and whether an inspection may rely on the scanner."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np

from weldscan.errors import InputError
from weldscan.records.fields import moment
from weldscan.records.history import FILE, History, Record, read_history
from weldscan.records.session import Session
from weldscan.result import Drift, Standing, Verdict, Verification
from weldscan.verification import CLOCK_SKEW, fringes_of, scanner_id

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


def standing_of(
    session: Session,
    history: str | os.PathLike[str] | None = None,
    accept: str | None = None,
    now: datetime | None = None,
) -> Standing:
    """What is on record about a session's scanner: whether an inspection may rely on it.

    Looked for are `history`, the session's `verification`, then `verification.jsonl` in the session's folder and beside
    it. Where there is none, nothing is asked for. The last verification of this very calibration decides: it must have
    passed, still be valid and not lie in the future.

    Args:
        session: as `read_session` gave it.
        history: the file to go by.
        accept: the reason for which the scanner is relied on whatever the history says.
        now: by default this moment.

    Raises:
        InputError: the file that was named is not there or is something else, or `accept` is empty.
    """
    if accept is not None and not accept.strip():
        raise InputError("--accept-verification: give the reason; the report states it")
    now = datetime.now(UTC) if now is None else now
    path = _where(session, history)
    if path is None:
        return Standing("none", "no verification on record", accepted=accept)
    found = read_history(path)
    records = found.of(scanner_id(session.scanner))
    last = records[-1] if records else None
    why = found.broken
    state: Literal["verified", "failed", "expired"] = "failed"
    if why is not None:
        why = f"the history cannot be relied upon: {why}"
    elif last is None:
        others = len({record.scanner for record in found.records})
        held = f"; it holds {others} other scanner(s) or calibrations" if others else ""
        why = f"the history holds no verification of this scanner ({scanner_id(session.scanner)}){held}"
    elif last.when > now + CLOCK_SKEW:
        why = f"the verification of {last.date} lies in the future: a clock is wrong"
    elif last.verdict is not Verdict.PASS:
        why = f"the last verification, of {last.date}, ended in {last.verdict}"
    elif moment(last.valid_until, "valid_until") < now:
        state, why = "expired", f"the verification of {last.date} expired on {last.valid_until}"
    else:
        state = "verified"
    notes = list(found.notes)
    if last is not None and last.fringes != fringes_of(session):
        notes.append(
            f"the scanner was verified with fringes {last.fringes or 'unknown'}, this session has {fringes_of(session)}"
        )
    text = why or ""
    if last is not None and why is None:
        judged = ", ".join(name for name, each in last.characteristics.items() if each.verdict is Verdict.PASS)
        text = f"verified on {last.date} ({judged}), valid until {last.valid_until}"
    return Standing(
        state=state,
        text=text,
        history=str(path),
        id=last.id if last else None,
        date=last.date if last else None,
        valid_until=last.valid_until if last else None,
        accepted=accept,
        notes=tuple(notes),
    )


def _where(session: Session, history: str | os.PathLike[str] | None) -> Path | None:
    if history is not None:
        return Path(history)
    folder = session.folder
    if session.verification is not None:
        return folder / session.verification
    return next((path for path in (folder / FILE, folder.resolve().parent / FILE) if path.is_file()), None)
