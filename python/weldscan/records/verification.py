"""What a verification of a scanner found, `weldscan-verification/1`: `verification.json`."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any

from weldscan._weldcore import __version__
from weldscan.records.files import is_earlier
from weldscan.result import Verification

SCHEMA = "weldscan-verification/1"
FILES = ("verification.json", "verification.html")


def is_verification(folder: Path) -> bool:
    """Whether a folder is an earlier verification and holds nothing else."""
    return is_earlier(folder, FILES, FILES[0], SCHEMA)


def verification_document(found: Verification, created: datetime) -> dict[str, Any]:
    """`weldscan-verification/1`."""
    return {
        "schema": SCHEMA,
        "created": created.isoformat(timespec="seconds"),
        "session": found.session,
        "scanner": found.scanner,
        "fringes": found.fringes,
        "date": found.date,
        "date_from": found.date_from,
        "valid_until": found.valid_until,
        "verdict": found.verdict,
        "limits": found.limits,
        "span_mm": found.span_mm,
        "characteristics": {
            each.name: {name: value for name, value in vars(each).items() if name != "name"}
            for each in found.characteristics
        },
        "spheres": [_row(ball) for ball in found.balls],
        "distances": [_row(each) | {"error_mm": each.error_mm} for each in found.spacings],
        "planes": [_row(plane) for plane in found.planes],
        "lost": [{"shot": shot, "reason": reason} for shot, reason in found.lost],
        "assumed": found.assumed,
        "warnings": found.warnings,
        "drift": {each.name: vars(each) for each in found.drift},
        "notes": found.notes,
        "software": {"version": __version__, **found.software},
    }


def _row(each: Any) -> dict[str, Any]:
    return {name: value for name, value in vars(each).items() if name != "residual_mm"}
