"""The measured points of the part, and what they belong to."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Label(IntEnum):
    """What a point of the part belongs to."""

    NONE = 0
    REFERENCE_WALL = 1
    OTHER_WALL = 2
    BEAD = 3
    TRANSITION = 4


@dataclass(frozen=True, eq=False)
class PartCloud:
    """The measured points of the part, in base (in the scanner's frame where there is no robot): all of them, or one of
    every cell of the unrolled part.
    """

    points_mm: Floats
    """(n, 3)"""
    label: NDArray[np.uint8]
    """`Label` per point."""
    deviation_mm: NDArray[np.float32]
    """Signed radial distance from the reference wall's surface."""
    angle_deg: NDArray[np.float32]
    """About the axis, right-handed, from the zero mark, in [0, 360)."""
    axial_mm: NDArray[np.float32]
    """Along the axis from the seam's centreline; the reference wall is negative."""
    shot: NDArray[np.uint16]
    """Index of the part shot."""
    counts: tuple[int, ...] = ()
    """Of all points, whether they are here or not, how many have each `Label`; empty: those that are here."""
