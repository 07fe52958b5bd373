"""What the stages of a measurement notice: each returns it beside its result and changes nothing that others hold."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

from weldscan.result import Finding


@dataclass(frozen=True)
class SetPhaseError:
    """What was taken off the phase of one fringe set for the projector's response."""

    periods: float
    steps: int
    source: str
    """fringes, given or nothing, as `PhaseError` has it."""
    largest_rad: float
    sin_rad: tuple[float, ...]
    standard_rad: tuple[float, ...]
    harmonics: float | None
    """Of the set's own fringes, in parts of their amplitude."""


@dataclass(frozen=True)
class ShotReading:
    """What is worth knowing of one shot's images."""

    name: str
    masks: Mapping[str, int]
    """How many pixels were measured, and how many not for which reason."""
    digest: str = ""
    """Of the images' pixels: two shots with the same one are copies."""
    phase_errors: tuple[SetPhaseError, ...] | None = None
    """Per fringe set; None where the points did not come from fringes."""

    @property
    def why_dark(self) -> str | None:
        """Why hardly a pixel of it was measured, where that is so: a better reason than geometry has."""
        total = sum(self.masks.values())
        if self.masks["ok"] * 20 >= total:
            return None
        reasons = sorted(((n, name) for name, n in self.masks.items() if name != "ok" and n), reverse=True)
        shares = ", ".join(f"{100 * n / total:.0f} % {name.replace('_', ' ')}" for n, name in reasons)
        return f"hardly any fringes in view: {self.masks['ok']} of {total} pixels were measured ({shares})"


@dataclass(frozen=True)
class Journal:
    """What was noticed so far; two are added in the order in which it was."""

    findings: tuple[Finding, ...] = ()
    left_out: tuple[tuple[str, str], ...] = ()
    """Shots that could not be used, with the reason."""
    shots: tuple[ShotReading, ...] = ()
    """That were read."""
    timing_s: Mapping[str, float] = field(default_factory=dict)
    """Seconds per step."""

    def __add__(self, other: Journal) -> Journal:
        timing = dict(self.timing_s)
        for what, seconds in other.timing_s.items():
            timing[what] = timing.get(what, 0.0) + seconds
        return Journal(self.findings + other.findings, self.left_out + other.left_out, self.shots + other.shots, timing)


def took(what: str, since: float) -> Journal:
    """The seconds since then (`time.perf_counter`), spent on a step."""
    return Journal(timing_s={what: time.perf_counter() - since})
