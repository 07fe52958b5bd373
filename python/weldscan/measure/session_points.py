"""One recorded shot to points: read, decode, triangulate."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import Cloud, PhaseMap, Scanner, decode, outside_calibration, triangulate
from weldscan.errors import InputError
from weldscan.measure.journal import Journal, SetPhaseError, ShotReading, took
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
MASKS = ("ok", "dark", "saturated", "order_in_doubt", "no_fit", "outside_calibration")
OUTSIDE_CALIBRATION = MASKS.index("outside_calibration")


@dataclass(frozen=True, eq=False)
class Scan:
    """One shot's pixels as points."""

    points_mm: NDArray[np.float64]
    """(H, W, 3), scanner frame, NaN where there is none."""
    sigma_mm: NDArray[np.float32] | None
    """(H, W): noise of each point along its ray, one sigma."""
    reason: NDArray[np.uint8]
    """(H, W): why a pixel has no point, as `PhaseMap.reason` says it, or OUTSIDE_CALIBRATION."""
    reading: ShotReading
    noticed: Journal
    """Of it, its reading among the rest."""
    outside_mm: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3), scanner frame: points that are masked because the scanner is not calibrated there."""


class PointReader:
    """Gives the points of a session's shots, one after the other.

    Attributes:
        scanner: of the session.
        axis: by which it triangulates.
        fringes: the sets along that axis.
        frames: which images of a shot's stack are theirs.
    """

    def __init__(self, session: Session, progress: Progress | None = None, compensate: Compensate = "auto") -> None:
        self.session, self.progress, self.compensate = session, progress, compensate
        self.scanner: Scanner = session.scanner.build()
        self.axis, self.fringes, self.frames = fringe_axis(session.fringes, self.scanner)

    def __call__(self, shot: ShotSpec, done: int = 0) -> Scan:
        """The shot's points, scanner frame, on the camera's pixel grid, with what was noticed.

        Args:
            shot: of the session.
            done: how many were read before it, for the progress.
        """
        if self.progress is not None:
            self.progress(done, len(self.session.shots), shot.name)
        t = time.perf_counter()
        exposures = [[stack[i] for i in self.frames] for stack in read_frames(self.session, shot)]
        noticed, t = took("read", t), time.perf_counter()
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
        noticed, t = noticed + took("decode", t), time.perf_counter()
        cloud = triangulate(phase.column_px, self.scanner, phase.sigma_px, self.axis)
        reason, outside = self._masked(cloud, phase)
        noticed += took("triangulate", t)
        reading = self._reading(shot, phase, digest(exposures), len(outside))
        noticed += Journal(tuple(self._findings(shot, phase)), shots=(reading,))
        return Scan(cloud.points_mm, cloud.sigma_mm, reason, reading, noticed, outside)

    def _masked(self, cloud: Cloud, phase: PhaseMap) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
        """The reasons, and the points that lie outside the hull of the scanner's calibration: they are taken out of the
        cloud.
        """
        hull = self.session.scanner.hull
        if hull is None:
            return phase.reason, np.zeros((0, 3))
        corners = np.array(hull.camera_px), np.array(hull.projector_px)
        outside = outside_calibration(cloud.points_mm, self.scanner, *corners)
        points = cloud.points_mm[outside]
        cloud.points_mm[outside] = np.nan
        if cloud.sigma_mm is not None:
            cloud.sigma_mm[outside] = np.nan
        return np.where(outside, np.uint8(OUTSIDE_CALIBRATION), phase.reason), points

    def _findings(self, shot: ShotSpec, phase: PhaseMap) -> Iterator[Finding]:
        for each in phase.disagreements:
            yield bar("frames-disagree", each.text, shot.name)
        if phase.clipped_below_full_scale:
            text = f"the camera clips at {phase.saturation:g}, below its full scale; clipped pixels were left out"
            yield warning("clipped", f"{shot.name}: {text}", shot.name)
        worst = max((h for h in phase.harmonics if h is not None), default=0.0)
        if worst > HARMONIC_WARNING and phase.counts[0] > 0 and self.compensate == "off":
            yield warning(
                "response",
                f"{shot.name}: the fringes are not sinusoidal (harmonics {100 * worst:.0f} % of their amplitude) "
                "and nothing was done about it: the projector's response should be corrected",
                shot.name,
            )

    def _reading(self, shot: ShotSpec, phase: PhaseMap, digest: str, outside: int) -> ShotReading:
        ok, *others = map(int, phase.counts)
        return ShotReading(
            shot.name,
            dict(zip(MASKS, (ok - outside, *others, outside), strict=True)),
            digest,
            tuple(
                SetPhaseError(
                    fringe.periods,
                    fringe.steps,
                    error.source,
                    error.largest_rad,
                    tuple(error.sin_rad),
                    tuple(error.standard_rad),
                    harmonics,
                )
                for fringe, error, harmonics in zip(self.fringes, phase.phase_error, phase.harmonics, strict=True)
            ),
        )


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
