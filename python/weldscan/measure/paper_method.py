"""The paper's own evaluation (its section 6) on the combined cloud in base; the core has it step by step.

The result is unsigned and has neither an angle nor an uncertainty of its own: it is kept to compare with the paper;
`surface` is the better.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import misalignment
from weldscan.result import Histogram

Floats = NDArray[np.float64]


def paper_step(points_mm: Floats, axis_point_mm: Floats, axis: Floats, radius_mm: float) -> Histogram:
    """The misalignment as the paper computes it.

    Of the points every k-th takes part, some 100,000. Weld metal is dropped by its distance from the cloud's centroid,
    the reference wall is brought onto a modelled pipe by ICP, and the other wall's distances from it make a
    histogram, whose bins with at least 20 % of the highest count are averaged.

    Args:
        points_mm: (n, 3) all points of the part, base.
        axis_point_mm: (3,) a point of the pipe's axis: where ICP starts.
        axis: (3,) unit, from the reference wall to the other wall.
        radius_mm: of the modelled pipe: the real one, where the arc shows it.

    Raises:
        InputError: a wrong shape, NaN or infinity, masked values, a radius that is not above zero.
        GeometryError: one of the parts has no points left, the points reach further than any part, or ICP found
            nothing to hold on to.

    Source: the paper's section 6; `crates/weldcore/src/weld/paper.rs`, where it says what the paper leaves open.

    Example:
        >>> import numpy as np
        >>> from weldscan import paper_step
        >>> random = np.random.default_rng(1)
        >>> angle, z = random.uniform(-0.2, 0.2, 20000), random.uniform(-50, 50, 20000)
        >>> r = 300 + 0.5 * (z > 0) + 2 * np.maximum(1 - (z / 6) ** 2, 0) + random.normal(0, 0.01, 20000)
        >>> points = np.c_[r * np.cos(angle), r * np.sin(angle), z]
        >>> round(paper_step(points, np.zeros(3), np.array([0.0, 0, 1]), 300.0).step_mm, 1)
        0.5
    """
    edges, counts, kept, step = misalignment(points_mm, axis_point_mm, axis, radius_mm)
    return Histogram(edges_mm=edges, counts=counts, kept=kept, step_mm=step)
