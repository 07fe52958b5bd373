"""What a scan determines of the two pipes beyond the step, and what it does not.

A short arc of two pipes says little about their axes and diameters: the fit still gives numbers, tens of millimetres
off. A number is shown only with its uncertainty, and only where that is at most half of what pipes differ by anyway
(their prior): the scan has then said something. Else the term is not observable, and is named as such.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

# Standard deviations of what pipes are, before any scan.
DIAMETER_PRIOR = 0.01
"""Of the difference of two diameters, as a share of them: the usual delivery tolerance, 1 % (EN 10216)."""
OFFSET_PRIOR = 1.0
"""Of the axes' offset, in wall thicknesses: beyond it the walls no longer meet."""
ANGLE_PRIOR_DEG = math.degrees(1.5 / 200)
"""Of the angle between the axes: 1.5 mm over 200 mm of pipe, what a fitted joint may be bent by."""


@dataclass(frozen=True)
class SeamTerms:
    """The terms that a scan determines, and the names of those that it does not."""

    harmonics_mm: dict[str, float]
    """`name`, `name_u` (expanded, k = 2), `name_at_deg`."""
    angle_deg: float | None
    angle_u_deg: float | None
    not_observable: tuple[str, ...]


def seam_terms(step: Mapping[str, Any], outside_diameter_mm: float, wall_mm: float) -> SeamTerms:
    """Diameter difference, axis offset and angle between the walls, each with its U or not at all.

    Args:
        step: what `measure_step` returned: `radius_difference_mm` (value, standard uncertainty), `axis_offset_mm`,
            `tilt_rad` and, where the core states them, `axis_offset_standard_mm` and `tilt_standard_rad`, the standard
            uncertainties of offset and tilt along their own direction.
        outside_diameter_mm: rated.
        wall_mm: rated thickness of the wall.

    Example:
        >>> from weldscan.measure.observable_terms import seam_terms
        >>> step = {"radius_difference_mm": (-29.4, 34.2), "axis_offset_mm": (29.0, 6.0), "tilt_rad": 0.001}
        >>> seam_terms(step, 630.0, 6.0).not_observable
        ('diameter_difference', 'axis_offset', 'angle_between_walls')
    """
    half, half_standard = step["radius_difference_mm"]
    east, north = step["axis_offset_mm"]
    harmonics: dict[str, float] = {}
    missing = []
    u = _expanded(2 * half_standard)
    if _determined(u, DIAMETER_PRIOR * outside_diameter_mm):
        harmonics |= {"diameter_difference": 2 * half, "diameter_difference_u": u}
    else:
        missing.append("diameter_difference")
    u = _expanded(step.get("axis_offset_standard_mm"))
    if _determined(u, OFFSET_PRIOR * wall_mm):
        at = math.degrees(math.atan2(north, east)) % 360
        harmonics |= {"axis_offset": math.hypot(east, north), "axis_offset_u": u, "axis_offset_at_deg": at}
    else:
        missing.append("axis_offset")
    u = math.degrees(_expanded(step.get("tilt_standard_rad")))
    if _determined(u, ANGLE_PRIOR_DEG):
        return SeamTerms(harmonics, math.degrees(step["tilt_rad"]), u, tuple(missing))
    return SeamTerms(harmonics, None, None, (*missing, "angle_between_walls"))


def _expanded(standard: float | None) -> float:
    """With k = 2; infinite where it is not stated."""
    return math.inf if standard is None or not math.isfinite(standard) else 2 * float(standard)


def _determined(expanded: float, prior: float) -> bool:
    return expanded <= prior / 2
