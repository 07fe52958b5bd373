"""The scanned surface held against points of a contact probe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldscan.result.step import BudgetLine

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Validation:
    """The scanned surface held against points that a contact probe read on the part."""

    session: str
    touch: str
    """The file of the probed points."""
    points_mm: Floats
    """(n, 3), base: the probed points."""
    distance_mm: Floats
    """(n,) from the scanned surface to the probed point, positive away from the axis; NaN where nothing was scanned."""
    u_mm: Floats
    """(n,) expanded uncertainty of each distance, k = 2; NaN where there is none."""
    angle_deg: Floats
    """(n,) about the axis, from the zero mark."""
    axial_mm: Floats
    """(n,) along the axis from the seam's centreline."""
    mean_mm: float
    rms_mm: float
    max_abs_mm: float
    mean_u_mm: float
    """Expanded, k = 2, of the mean: what the points share does not average out."""
    budget: tuple[BudgetLine, ...]
    """Of a typical point."""
    software: dict[str, str]

    @property
    def compared(self) -> int:
        """How many of the probed points lie on scanned surface."""
        return int(np.isfinite(self.distance_mm).sum())
