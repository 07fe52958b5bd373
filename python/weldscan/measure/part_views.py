"""What one shot saw of the part, placed and segmented: what every check of an inspection looks at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import SeamFrame, WeldShot
from weldscan.result import CalibratedHull, Label

Floats = NDArray[np.float64]

POINTS_PER_WALL = 200
"""So many points of a wall of a view tell how the scanner's errors bend it: they are smooth over the image."""


@dataclass(frozen=True, eq=False)
class PartView:
    """One segmented part shot."""

    name: str
    index: int
    """Among the session's part shots."""
    reason: NDArray[np.uint8]
    """(H, W): why a pixel has no point, as `PhaseMap.reason` says it."""
    base_from_flange: Floats
    """(4, 4); the identity without a robot."""
    base_from_scanner: Floats
    """(4, 4); the identity without a robot."""
    shot: WeldShot
    """Which keeps the points, too."""
    hull: CalibratedHull | None = None
    """Where the scanner is calibrated: what lies outside was masked; None: not known."""

    @property
    def seam_in_base(self) -> SeamFrame:
        """The seam's frame, in base."""
        return self.shot.seam.moved(self.base_from_scanner)


def wall_sample(shot: WeldShot) -> NDArray[np.int64]:
    """Numbers of some points of both walls, evenly spread over each in the order of the image.

    >>> from types import SimpleNamespace
    >>> import numpy as np
    >>> from weldscan.measure.part_views import wall_sample
    >>> wall_sample(SimpleNamespace(labels=np.array([[1, 0, 2], [3, 2, 1]], dtype=np.uint8)))
    array([0, 5, 2, 4])
    """
    labels = shot.labels.ravel()
    walls = [np.flatnonzero(labels == wall) for wall in (Label.REFERENCE_WALL, Label.OTHER_WALL)]
    picked = [w[np.linspace(0, len(w) - 1, min(len(w), POINTS_PER_WALL)).astype(int)] for w in walls if len(w)]
    return np.concatenate([np.empty(0, dtype=np.int64), *picked])
