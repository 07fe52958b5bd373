"""Which patterns a projector shows, in which order: the fringe sets of a session, one image per step."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from weldscan.errors import InputError

Pattern = NDArray[np.uint8]


def fringe_patterns(
    fringes: Iterable[tuple[str, float, int] | tuple[str, float, int, int, float]], width: int, height: int
) -> Iterator[Pattern]:
    """Yield the projector images of fringe sets, in the order of the sets and then of the steps.

    Step i of column u shows 0.5 + 0.5 cos(2 pi (periods (u + 0.5) / width - direction i / steps) + origin_rad), in 8
    bits; along y the same with rows and the height.

    Args:
        fringes: (axis "x" or "y", periods over the whole width or height, steps) per set; or these and (direction 1 or
            -1, origin_rad), which are 1 and 0 otherwise.
        width: of the projector, pixels.
        height: of the projector, pixels.

    Returns:
        (height, width) uint8 images, read-only.

    Raises:
        InputError: an axis or a direction that is neither, fewer than 3 steps, periods or a size that are not positive.

    >>> [int(v) for v in next(fringe_patterns([("x", 1, 4)], 4, 1))[0]]
    [218, 37, 37, 218]
    """
    if width < 1 or height < 1:
        raise InputError(f"projector: {width}x{height} pixels")
    for axis, periods, steps, *convention in fringes:
        direction, origin_rad = convention or (1, 0.0)
        if axis not in ("x", "y") or steps < 3 or not (math.isfinite(periods) and periods > 0):
            raise InputError(f"fringes: axis {axis!r}, {periods} periods, {steps} steps")
        if direction not in (1, -1) or not math.isfinite(origin_rad):
            raise InputError(f"fringes: direction {direction}, origin_rad {origin_rad}")
        size = width if axis == "x" else height
        turns = periods * (np.arange(size) + 0.5) / size
        for step in range(steps):
            level = np.rint(
                255 * (0.5 + 0.5 * np.cos(2 * np.pi * (turns - direction * step / steps) + origin_rad))
            ).astype(np.uint8)
            yield np.broadcast_to(level if axis == "x" else level[:, None], (height, width))


def board_fringes(width: int, height: int) -> tuple[tuple[str, float, int], ...]:
    """Return fringe sets along both axes for a scanner's calibration: periods of 20 px, what unwraps them, four steps.

    >>> board_fringes(1280, 800)
    (('x', 1, 4), ('x', 8, 4), ('x', 64, 4), ('y', 1, 4), ('y', 6, 4), ('y', 40, 4))
    """
    sets = []
    for axis, size in (("x", width), ("y", height)):
        finest = max(round(size / 20), 4)
        sets += [(axis, periods, 4) for periods in (1, round(math.sqrt(finest)), finest)]
    return tuple(sets)


def flat_pattern(level: int, width: int, height: int) -> Pattern:
    """Return an even image, (height, width) uint8, read-only: 255 is white."""
    return np.broadcast_to(np.uint8(level), (height, width))
