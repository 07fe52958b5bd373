"""The history of a scanner's verifications, `weldscan-verification-history/1`: an append-only file of JSON lines.

Every line holds one verification, the `id` of the line before it as `prev`, and its own `id`, the SHA-256 of all of the
rest: a line that was changed, taken out or put between others shows. A line is appended by one write, synced, under a
lock. What a power cut may leave, a last line without its end, is passed over and said; the next line goes below it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from weldscan.errors import InputError
from weldscan.manifest import sync_folder
from weldscan.result import Drift, Standing, Verdict, Verification
from weldscan.session import Session, plain, read_bytes
from weldscan.verification import CLOCK_SKEW, fringes_of, moment, scanner_id

try:
    import fcntl
except ImportError:  # Windows: two verifications at the same moment are then not kept apart
    fcntl = None  # type: ignore[assignment]

SCHEMA = "weldscan-verification-history/1"
BEGINNING = f'{{"schema": "{SCHEMA}"'.encode()
FILE = "verification.jsonl"
"""Looked for in a session's folder and beside it."""
MAX_BYTES = 64 * 1024 * 1024
YEAR_S = 365.25 * 86_400
# Two verifications make a line, three say how well it is known.
LEAST_FOR_DRIFT = 3
# Student's t, two-sided 95 %, by degrees of freedom; beyond them the next lower one's, which is on the safe side.
STUDENT_T = {
    **{1: 12.706, 2: 4.303, 3: 3.182, 4: 2.776, 5: 2.571, 6: 2.447, 7: 2.365, 8: 2.306, 9: 2.262, 10: 2.228},
    **{12: 2.179, 15: 2.131, 20: 2.086, 30: 2.042, 60: 2.000, 120: 1.980},
}
Number = Annotated[float, Field(allow_inf_nan=False)]


class KeptCharacteristic(BaseModel):
    """One characteristic in a line of the history."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    value_mm: Number | None
    mean_mm: Number | None
    std_mm: Number | None
    positions: Annotated[int, Field(ge=0)]
    points: int | None
    limit_mm: Number | None
    u_mm: Number
    verdict: Verdict


class Record(BaseModel):
    """One line of the history."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)

    schema_: Literal["weldscan-verification-history/1"] = Field(alias="schema")
    scanner: Annotated[str, Field(min_length=1, max_length=200)]
    date: str
    valid_until: str
    kept: str
    """When the line was written."""
    verdict: Verdict
    session: str
    session_sha256: str
    software: str
    fringes: str
    limits: dict[str, Any]
    characteristics: dict[str, KeptCharacteristic]
    prev: str | None
    """`id` of the line before it."""
    id: str

    @property
    def when(self) -> datetime:
        """Of the verification."""
        return moment(self.date, "date")


@dataclass(frozen=True)
class History:
    """What a history file holds."""

    path: Path
    records: tuple[Record, ...] = ()
    notes: tuple[str, ...] = ()
    """What a reader should know of it and does no harm."""
    broken: str | None = None
    """Why the file cannot be relied upon: a line was changed, or one is gone."""

    def of(self, scanner: str) -> tuple[Record, ...]:
        """Those of one scanner, the oldest first."""
        return tuple(sorted((r for r in self.records if r.scanner == scanner), key=lambda r: r.when))


def content_id(document: dict[str, Any]) -> str:
    """SHA-256 of a line but for its own `id`."""
    content = {name: value for name, value in document.items() if name != "id"}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def read_history(path: str | os.PathLike[str]) -> History:
    """The verifications that a file holds, each held against its hash and its predecessor's.

    Args:
        path: of the file, `weldscan-verification-history/1`.

    Returns:
        History. An unfinished last line is passed over with a note; a changed or missing line is named in `broken`.

    Raises:
        InputError: no such file, it cannot be read, or it holds something else.
    """
    path = Path(path)
    return _parse(path, read_bytes(path, MAX_BYTES, "history"))


def _parse(path: Path, data: bytes) -> History:
    records: list[Record] = []
    notes: list[str] = []
    broken: list[str] = []
    damaged = 0
    lines = data.split(b"\n")
    for number, raw in enumerate(lines, 1):
        unfinished = number == len(lines)
        if not raw.strip(b" \t\r\0"):
            continue
        document = _document(raw)
        if document is None:
            damaged = number
            what = "is unfinished: a verification was cut off while it was written" if unfinished else "is damaged"
            notes.append(f"{path}: line {number} {what}; it is passed over")
            if unfinished:
                damaged = 0
            continue
        try:
            record = Record.model_validate(document)
            record.when, moment(record.valid_until, "valid_until")
        except (ValidationError, InputError):
            broken.append(f"line {number} is not a verification as weldscan writes it")
            continue
        if content_id(document) != record.id:
            broken.append(f"line {number} was changed after it was written: its hash differs")
            continue
        if record.prev != (records[-1].id if records else None):
            broken.append(f"line {number} does not follow the one before it: lines were taken out or put in")
        damaged = 0
        records.append(record)
    if damaged:
        broken.append(f"line {damaged}, the last, is damaged, and nothing says what it held")
    # The very first line may be the unfinished one.
    begins = data[: len(BEGINNING)] == BEGINNING[: len(data)]
    if not records and not begins and data.strip(b" \t\r\n\0"):
        raise InputError(f"{path}: is no history of verifications")
    return History(path, tuple(records), tuple(notes), "; ".join(broken) or None)


def _document(raw: bytes) -> dict[str, Any] | None:
    """A line as JSON; None where it is none."""
    try:
        document = json.loads(raw.decode("utf-8"), parse_constant=_refuse)
    except (ValueError, RecursionError):
        return None
    return document if isinstance(document, dict) else None


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not JSON")


def check_history(path: str | os.PathLike[str]) -> History:
    """The history that a verification is to go into, empty where there is none; says early what would be in the way.

    Raises:
        InputError: it is something else, or cannot be written.
    """
    path = Path(path)
    if path.exists():
        if not path.is_file():
            raise InputError(f"{path}: exists and is not a file")
        if not os.access(path, os.W_OK):
            raise InputError(f"{path}: the history cannot be written: no permission")
        return read_history(path)
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK | os.X_OK):
        raise InputError(f"{path}: the history cannot be written: {path.parent} is not a folder that may be written to")
    return History(path)


def append_history(path: str | os.PathLike[str], found: Verification) -> Record:
    """Adds a verification as one line; the disk has it when this returns.

    Args:
        path: of the history; it is made where there is none.
        found: what `weldscan.verify` returned.

    Returns:
        The line that was written.

    Raises:
        InputError: the file is something else or cannot be written. Nothing was added then.
    """
    path = Path(path)
    check_history(path)
    try:
        with _locked(path) as descriptor:
            before = _read_all(descriptor)
            history = _parse(path, before)
            record = _record(found, history.records[-1].id if history.records else None)
            line = json.dumps(record.model_dump(mode="json", by_alias=True), ensure_ascii=False, allow_nan=False)
            data = (b"" if not before or before.endswith(b"\n") else b"\n") + line.encode() + b"\n"
            try:
                done = 0
                while done < len(data):
                    done += os.write(descriptor, data[done:])
                os.fsync(descriptor)
            except OSError:
                with contextlib.suppress(OSError):
                    os.ftruncate(descriptor, len(before))
                raise
    except OSError as error:
        raise InputError(f"{path}: the history cannot be written: {error.strerror or error}") from None
    sync_folder(path.parent)
    return record


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[int]:
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        if fcntl is not None:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield descriptor
    finally:
        os.close(descriptor)


def _read_all(descriptor: int) -> bytes:
    parts = []
    os.lseek(descriptor, 0, os.SEEK_SET)
    while part := os.read(descriptor, 1 << 20):
        parts.append(part)
    return b"".join(parts)


def _record(found: Verification, prev: str | None) -> Record:
    document = plain(
        {
            "schema": SCHEMA,
            "scanner": found.scanner,
            "date": found.date,
            "valid_until": found.valid_until,
            "kept": datetime.now(UTC).isoformat(timespec="seconds"),
            "verdict": found.verdict.value,
            "session": found.session,
            "session_sha256": found.software.get("session_sha256", ""),
            "software": found.software.get("version", ""),
            "fringes": found.fringes,
            "limits": found.limits,
            "characteristics": {
                each.name: {
                    "value_mm": each.value_mm,
                    "mean_mm": each.mean_mm,
                    "std_mm": each.std_mm,
                    "positions": each.positions,
                    "points": each.points,
                    "limit_mm": each.limit_mm,
                    "u_mm": each.u_mm,
                    "verdict": each.verdict.value,
                }
                for each in found.characteristics
            },
            "prev": prev,
        }
    )
    # The hash is of the line as it is read back: numbers as JSON has them.
    record = Record.model_validate({**document, "id": ""})
    dumped = record.model_dump(mode="json", by_alias=True)
    return record.model_copy(update={"id": content_id(json.loads(json.dumps(dumped)))})


# --- what the history says --------------------------------------------------------------------------------------------


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
