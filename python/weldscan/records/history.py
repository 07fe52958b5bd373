"""The history of a scanner's verifications, `weldscan-verification-history/1`: an append-only file of JSON lines.

Every line holds one verification, the `id` of the line before it as `prev`, and its own `id`, the SHA-256 of all of the
rest: a line that was changed, taken out or put between others shows. A line is appended by one write, synced, under a
lock. What a power cut may leave, a last line without its end, is passed over and said; the next line goes below it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from weldscan.errors import InputError
from weldscan.records.fields import moment
from weldscan.records.files import parse_json, plain, read_bytes, sync_folder
from weldscan.result import Verdict, Verification

try:
    import fcntl
except ImportError:  # Windows: two verifications at the same moment are then not kept apart
    fcntl = None  # type: ignore[assignment]

SCHEMA = "weldscan-verification-history/1"
BEGINNING = f'{{"schema": "{SCHEMA}"'.encode()
FILE = "verification.jsonl"
"""Looked for in a session's folder and beside it."""
MAX_BYTES = 64 * 1024 * 1024
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
        document = parse_json(raw.decode("utf-8"), "line", finite=True)
    except ValueError:  # bytes that are no text, and InputError
        return None
    return document if isinstance(document, dict) else None


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
