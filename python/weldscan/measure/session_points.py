"""One recorded shot to points: read, decode, triangulate."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import Disagreement, PhaseMap, Scanner, decode, triangulate
from weldscan.errors import InputError
from weldscan.records.frames import read_frames
from weldscan.records.images import Image
from weldscan.records.session import FringeSet, Session, ShotSpec
from weldscan.result import Finding, bar, warning

Progress = Callable[[int, int, str], None]

PhaseErrorOf = Callable[[FringeSet], Sequence[float]]
"""The known error of a set's phase: coefficients of sin(m steps phase), rad."""
Compensate = Literal["auto", "off"] | PhaseErrorOf

# A harmonic of a tenth of the fringes' own amplitude shifts a four-step phase by 0.01 rad or more: worth a word.
HARMONIC_WARNING = 0.1
MASKS = ("ok", "dark", "saturated", "order_in_doubt", "no_fit")


@dataclass(frozen=True, eq=False)
class Scan:
    """One shot's pixels as points."""

    points_mm: NDArray[np.float64]
    """(H, W, 3), scanner frame, NaN where there is none."""
    sigma_mm: NDArray[np.float32] | None
    """(H, W): noise of each point along its ray, one sigma."""
    reason: NDArray[np.uint8]
    """(H, W): why a pixel has no point, as `PhaseMap.reason` says it."""
    digest: str = ""
    """Of the images' pixels: two shots with the same one are copies."""


class PointReader:
    """Gives the points of a session's shots, one after the other, and keeps what is worth knowing of each.

    Attributes:
        timing: seconds spent per step.
        masks: per shot, how many pixels were measured, and how many not for which reason.
        findings: what a reader of the result should know.
        phase_errors: per shot, what was taken off the phase of each fringe set for the projector's response.
        digests: per shot, the hash of its images.
        disagreements: per shot, where its frames contradict each other, with the likely cause; empty where they agree.
            Their `frames` count in the stack of `axis`; `frames` of this reader maps them to the shot's images.
        clipped: per shot the level at which the camera clips below the full scale of its numbers, where it does.
    """

    def __init__(self, session: Session, progress: Progress | None = None, compensate: Compensate = "auto") -> None:
        self.session, self.progress, self.compensate = session, progress, compensate
        self.scanner: Scanner = session.scanner.build()
        self.axis, self.fringes, self.frames = fringe_axis(session.fringes, self.scanner)
        self.timing: dict[str, float] = {}
        self.masks: dict[str, dict[str, int]] = {}
        self.findings: list[Finding] = []
        self.phase_errors: dict[str, list[dict[str, Any]]] = {}
        self.digests: dict[str, str] = {}
        self.disagreements: dict[str, list[Disagreement]] = {}
        self.clipped: dict[str, float] = {}

    def __call__(self, shot: ShotSpec) -> Scan:
        """The shot's points, scanner frame, on the camera's pixel grid."""
        if self.progress is not None:
            self.progress(len(self.masks), len(self.session.shots), shot.name)
        t = time.perf_counter()
        exposures = [[stack[i] for i in self.frames] for stack in read_frames(self.session, shot)]
        t = self.clock("read", t)
        projector = self.scanner.projector
        size = projector.width if self.axis == "x" else projector.height
        wanted: Literal["auto"] | list[Sequence[float]] | None = None
        if self.compensate == "auto":
            wanted = "auto"
        elif callable(self.compensate):
            wanted = [self.compensate(f) for f in self.fringes]
        try:
            phase = decode(exposures, [f.code for f in self.fringes], size, phase_error=wanted)
        except InputError as error:
            # The images were checked when they were read: what is left are the fringe sets.
            raise InputError(f"{self.session.folder / 'session.json'}: fringes: {error}") from None
        t = self.clock("decode", t)
        cloud = triangulate(phase.column_px, self.scanner, phase.sigma_px, self.axis)
        self.clock("triangulate", t)
        self._note(shot, phase)
        self.digests[shot.name] = digest(exposures)
        return Scan(cloud.points_mm, cloud.sigma_mm, phase.reason, self.digests[shot.name])

    def clock(self, what: str, since: float) -> float:
        """Adds the time since then to a step; returns now."""
        now = time.perf_counter()
        self.timing[what] = self.timing.get(what, 0.0) + now - since
        return now

    def _note(self, shot: ShotSpec, phase: PhaseMap) -> None:
        self.masks[shot.name] = dict(zip(MASKS, map(int, phase.counts), strict=True))
        self.disagreements[shot.name] = list(phase.disagreements)
        self.findings += [bar("frames-disagree", each.text, shot.name) for each in phase.disagreements]
        if phase.clipped_below_full_scale:
            self.clipped[shot.name] = phase.saturation
            text = f"the camera clips at {phase.saturation:g}, below its full scale; clipped pixels were left out"
            self.findings.append(warning("clipped", f"{shot.name}: {text}", shot.name))
        worst = max((h for h in phase.harmonics if h is not None), default=0.0)
        if worst > HARMONIC_WARNING and phase.counts[0] > 0 and self.compensate == "off":
            self.findings.append(
                warning(
                    "response",
                    f"{shot.name}: the fringes are not sinusoidal (harmonics {100 * worst:.0f} % of their amplitude) "
                    "and nothing was done about it: the projector's response should be corrected",
                    shot.name,
                )
            )
        self.phase_errors[shot.name] = [
            {
                "periods": fringe.periods,
                "steps": fringe.steps,
                "from": error.source,
                "largest_rad": error.largest_rad,
                "sin_rad": list(error.sin_rad),
                "standard_rad": list(error.standard_rad),
                "harmonics": harmonics,
            }
            for fringe, error, harmonics in zip(self.fringes, phase.phase_error, phase.harmonics, strict=True)
        ]

    def why_dark(self, shot: ShotSpec) -> str | None:
        """Why hardly a pixel of a shot was measured, where that is so: a better reason than geometry has."""
        counts = self.masks[shot.name]
        total = sum(counts.values())
        if counts["ok"] * 20 >= total:
            return None
        reasons = sorted(((n, name) for name, n in counts.items() if name != "ok" and n), reverse=True)
        shares = ", ".join(f"{100 * n / total:.0f} % {name.replace('_', ' ')}" for n, name in reasons)
        return f"hardly any fringes in view: {counts['ok']} of {total} pixels were measured ({shares})"


# Every so many rows of an image: no two captures have the same noise in any of them.
DIGEST_ROWS = 16


def digest(exposures: Sequence[Sequence[Image]]) -> str:
    """A hash of a shot's pixels, whatever their files were called or how they were packed."""
    found = hashlib.sha256()
    for stack in exposures:
        for image in stack:
            found.update(np.ascontiguousarray(image[::DIGEST_ROWS]).tobytes())
    return found.hexdigest()


def fringe_axis(fringes: Sequence[FringeSet], scanner: Scanner) -> tuple[str, list[FringeSet], list[int]]:
    """The axis to triangulate by, its fringe sets, and which of a stack's images are theirs.

    Where both axes were projected, it is the one whose fringes cross the baseline more squarely.
    """
    axes = {f.axis for f in fringes}
    axis: str = next(iter(axes))
    if len(axes) == 2:
        camera_seen = np.linalg.inv(scanner.camera_from_projector)[:3, 3]
        axis = "x" if abs(camera_seen[0]) >= abs(camera_seen[1]) else "y"
    sets: list[FringeSet] = []
    frames: list[int] = []
    at = 0
    for f in fringes:
        if f.axis == axis:
            sets.append(f)
            frames.extend(range(at, at + f.steps))
        at += f.steps
    return axis, sets, frames
