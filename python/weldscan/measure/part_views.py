"""What one shot saw of the part, placed and segmented: what every check of an inspection looks at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import SeamFrame, WeldShot
from weldscan.result import CalibratedHull

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PartView:
    """One segmented part shot."""

    name: str
    index: int
    """Among the session's part shots."""
    points_mm: Floats
    """(H, W, 3), scanner frame, NaN where there is none."""
    reason: NDArray[np.uint8]
    """(H, W): why a pixel has no point, as `PhaseMap.reason` says it."""
    base_from_flange: Floats
    """(4, 4); the identity without a robot."""
    base_from_scanner: Floats
    """(4, 4); the identity without a robot."""
    shot: WeldShot
    hull: CalibratedHull | None = None
    """Where the scanner is calibrated: what lies outside was masked; None: not known."""

    @property
    def seam_in_base(self) -> SeamFrame:
        """The seam's frame, in base."""
        return self.shot.seam.moved(self.base_from_scanner)
