"""Whether an inspection may rely on its scanner: what the history of the scanner's verifications says."""

from __future__ import annotations

import hashlib
import json
import os
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Literal

from weldscan.errors import InputError
from weldscan.records.fields import moment
from weldscan.records.history import FILE, read_history
from weldscan.records.scanner import ScannerSpec
from weldscan.records.session import Session
from weldscan.result import Standing, Verdict

CLOCK_SKEW = timedelta(minutes=10)


def scanner_id(scanner: ScannerSpec) -> str:
    """Identifies a calibrated scanner: a hash of its numbers, so that a new calibration is another scanner."""
    numbers = {
        name: [lens.width, lens.height, lens.K, [*lens.dist, 0.0][:5]]
        for name, lens in (("camera", scanner.camera), ("projector", scanner.projector))
    }
    text = json.dumps({**numbers, "pose": scanner.camera_from_projector}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def fringes_of(session: Session) -> str:
    """The fringe sets in a line: axis, periods and steps of each."""
    return ", ".join(f"{fringe.axis} {fringe.periods:g} x {fringe.steps}" for fringe in session.fringes)


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
