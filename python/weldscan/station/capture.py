"""One stack of images: a pattern, the time it takes to reach the wall, a frame; and whether the stack is good
enough.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from weldscan._weldcore import capture_quality
from weldscan.devices.cameras import Camera, Image
from weldscan.devices.projectors import Pattern, Projector, whole_refreshes

log = logging.getLogger("weldscan.scan")
Sets = Sequence[tuple[str, float, int]]


@dataclass(frozen=True)
class Quality:
    """What share of the image can be measured, and what spoils the rest."""

    usable: float
    """Unsaturated and modulated in at least one exposure."""
    saturated: float
    """Saturated in every exposure."""
    dark: float
    """Neither: too little modulation."""
    median_modulation: float
    """Of the usable pixels, in parts of full scale."""

    def __str__(self) -> str:
        return f"{self.usable:.1%} can be measured, {self.saturated:.1%} saturated, {self.dark:.1%} too dark"


class Stopwatch:
    """Where the time goes: seconds by what they went into."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, what: str) -> Iterator[None]:
        """Add the time within to what it went into."""
        start_s = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[what] = self.seconds.get(what, 0.0) + time.perf_counter() - start_s

    def __str__(self) -> str:
        return ", ".join(f"{what} {seconds:.2f}" for what, seconds in self.seconds.items())


def set_exposure(camera: Camera, projector: Projector, exposure_s: float) -> float:
    """Set an exposure of a whole number of refreshes."""
    return camera.set_exposure(whole_refreshes(exposure_s, projector.settings.refresh_hz))


def capture_stack(
    camera: Camera, projector: Projector, patterns: Iterable[Pattern], took: Stopwatch | None = None
) -> list[Image]:
    """Show each pattern, wait until it is surely on the wall, take one frame of it; `took` adds up the time."""
    images: list[Image] = []
    took = took or Stopwatch()
    for pattern in patterns:
        with took("projector"):
            on_the_wall_s = projector.show(pattern) + projector.settle_s
            time.sleep(max(on_the_wall_s - time.monotonic(), 0.0))
        with took("camera"):
            frame = camera.capture()
        if frame.retries:
            log.info("image %d: %d torn frames before it", len(images), frame.retries)
        images.append(frame.image)
    return images


def judge(
    stacks: Sequence[Sequence[Image]], fringes: Sets, least_modulation: float, full_scale: int | None = None
) -> Quality:
    """Return the quality of a shot's exposures, from the finest set of fringes; nothing is decoded.

    Args:
        stacks: exposures x frames, in the order of the fringes.
        fringes: (axis, periods, steps) of each set.
        least_modulation: in parts of full scale: below it a pixel counts as dark.
        full_scale: of the camera (`Camera.full_scale`); by default the narrowest that holds the images.
    """
    finest = max(range(len(fringes)), key=lambda k: fringes[k][1])
    first, steps = sum(n for _, _, n in fringes[:finest]), fringes[finest][2]
    return Quality(*capture_quality(stacks, first, steps, least_modulation, full_scale))
