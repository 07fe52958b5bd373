"""What there is to say of an inspection: notes, warnings, and bars that keep a PASS from being one."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Severity(StrEnum):
    """How much a finding weighs."""

    NOTE = "note"
    """Worth knowing; changes nothing."""
    WARNING = "warning"
    """Something is not as it should be; the verdict stands."""
    BAR = "bar"
    """The verdict cannot be relied on as a PASS: PASS becomes INCONCLUSIVE, every other verdict stays."""


CODES = {
    "agreement": "shots placed in base disagree by less than what bars, more than their uncertainty",
    "calibration": "the scanner's calibration: not stated, out of date, undetermined, elsewhere, or beyond the margin",
    "cap": "what lies between the walls is not one cap of a weld: too wide, two-humped, toes that jump, two seams",
    "clipped": "the camera clips below its full scale",
    "coverage": "less of the seam was seen than is required",
    "description": "the scan contradicts what the session says of the part",
    "edges": "the surfaces right beside the toes contradict the walls' step, or could not be read",
    "frames-disagree": "the frames of one shot contradict each other: copied, exchanged, out of order, moved",
    "hand-eye": "the hand-eye calibration contradicts where the part is found, or is poor",
    "paper": "the paper's method gave no answer",
    "points-without-wall": "points beside the seam that neither wall nor cap explains",
    "pose": "a flange pose is out of the robot's reach, or contradicts the others",
    "response": "the projector's response",
    "saturation": "too much of the seam's surroundings is saturated",
    "shot-altered": "files of a shot differ from what was recorded, or its description does",
    "shot-copied": "two shots hold the same images",
    "shot-left-out": "a shot of the part could not be used",
    "shot-missing": "a planned shot is not there",
    "shots-disagree": "two shots contradict each other",
    "transition": "between wall and cap lies more than weld shrinkage explains",
    "verification": "what is on record about the scanner's verification",
    "walls": "the walls are not what a pipe's are, or only partly seen",
}
"""Every code that a finding may have, and what it is about."""


@dataclass(frozen=True)
class Finding:
    """What there is to say of an inspection, in one line."""

    severity: Severity
    code: str
    """One of `CODES`."""
    text: str
    shot: str | None = None
    """The shot that it is about."""
    at_deg: float | None = None
    """Where on the seam."""

    def __post_init__(self) -> None:
        if self.code not in CODES:
            raise ValueError(f"{self.code!r} is no code of a finding")

    @property
    def where(self) -> str:
        """The place in words: `part-2, at 113°`; empty where it is about the whole."""
        return ", ".join(
            ([self.shot] if self.shot else []) + ([] if self.at_deg is None else [f"at {self.at_deg:.0f}°"])
        )

    def __str__(self) -> str:
        return f"{self.code}{f' ({self.where})' if self.where else ''}: {self.text}"


def bar(code: str, text: str, shot: str | None = None, at_deg: float | None = None) -> Finding:
    """A finding that bars PASS."""
    return Finding(Severity.BAR, code, text, shot, at_deg)


def warning(code: str, text: str, shot: str | None = None, at_deg: float | None = None) -> Finding:
    """A finding that the verdict stands in spite of."""
    return Finding(Severity.WARNING, code, text, shot, at_deg)


def note(code: str, text: str, shot: str | None = None, at_deg: float | None = None) -> Finding:
    """A finding that is only worth knowing."""
    return Finding(Severity.NOTE, code, text, shot, at_deg)
