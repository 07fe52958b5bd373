"""One stack of images: a pattern, the time it takes to reach the wall, a frame; and whether the stack is good
enough.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from weldscan._weldcore import capture_quality, saturation_level
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


def set_exposure(camera: Camera, projector: Projector, exposure_s: float) -> float:
    """Set an exposure of a whole number of refreshes."""
    return camera.set_exposure(whole_refreshes(exposure_s, projector.settings.refresh_hz))


def capture_stack(
    camera: Camera, projector: Projector, patterns: Iterable[Pattern], each: Callable[[], None] = lambda: None
) -> list[Image]:
    """Show each pattern, wait until it is surely on the wall, take one frame of it."""
    images: list[Image] = []
    for pattern in patterns:
        projector.show(pattern)
        time.sleep(projector.settle_s)
        frame = camera.capture()
        if frame.retries:
            log.info("image %d: %d torn frames before it", len(images), frame.retries)
        images.append(frame.image)
        each()
    return images


def full_scale(images: Sequence[Image]) -> int:
    """Return the largest value that the camera can give, by its images: cameras of 10 and 12 bits fill words of 16.

    That is the full scale of the narrowest of 8, 10, 12, 14 and 16 bits that holds the largest value of any image. A
    dark image says too little, so judge it together with a bright one.
    """
    return int(saturation_level(images)[1])


def judge(stacks: Sequence[Sequence[Image]], fringes: Sets, least_modulation: float) -> Quality:
    """Return the quality of a shot's exposures, from the finest set of fringes; nothing is decoded.

    Args:
        stacks: exposures x frames, in the order of the fringes.
        fringes: (axis, periods, steps) of each set.
        least_modulation: in parts of full scale: below it a pixel counts as dark.
    """
    finest = max(range(len(fringes)), key=lambda k: fringes[k][1])
    first, steps = sum(n for _, _, n in fringes[:finest]), fringes[finest][2]
    return Quality(*capture_quality(stacks, first, steps, least_modulation))
