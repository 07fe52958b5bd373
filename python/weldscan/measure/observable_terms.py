"""What a scan determines of the two pipes beyond the step, and what it does not.

A short arc of two pipes says little about their axes and diameters: the fit still gives numbers, tens of millimetres
off. A number is shown only with its uncertainty, and only where that is at most half of what pipes differ by anyway
(their prior): the scan has then said something. Else the term is not observable, and is named as such.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

# Standard deviations of what pipes are, before any scan.
DIAMETER_PRIOR = 0.01
"""Of the difference of two diameters, as a share of them: the usual delivery tolerance, 1 % (EN 10216)."""
OFFSET_PRIOR = 1.0
"""Of the axes' offset, in wall thicknesses: beyond it the walls no longer meet."""
NAMED_WAVES = 4
"""Terms of the step around the seam that are named whether or not the scan tells them: oval, three- and four-lobed."""
TOLD = 3.0
"""Further ones are named where an amplitude is so many standard uncertainties."""
ANGLE_PRIOR_DEG = math.degrees(1.5 / 200)
"""Of the angle between the axes: 1.5 mm over 200 mm of pipe, what a fitted joint may be bent by."""


class FittedTerms(Protocol):
    """What the fit of a step says of the two pipes (`WeldStep`); standard uncertainties (k = 1)."""

    @property
    def radius_difference_mm(self) -> tuple[float, float]: ...
    @property
    def axis_offset_mm(self) -> list[float]: ...
    @property
    def axis_offset_standard_mm(self) -> float: ...
    @property
    def tilt_rad(self) -> float: ...
    @property
    def tilt_standard_rad(self) -> float: ...
    @property
    def waves_mm(self) -> list[tuple[int, float, float, float, float, float]]: ...


@dataclass(frozen=True)
class SeamTerms:
    """The terms that a scan determines, and the names of those that it does not."""

    harmonics_mm: dict[str, float]
    """`name`, `name_u` (expanded, k = 2), `name_at_deg`; of n waves around the seam `n2_cos`, `n2_sin` and so on."""
    angle_deg: float | None
    angle_u_deg: float | None
    not_observable: tuple[str, ...]


def seam_terms(step: FittedTerms, outside_diameter_mm: float, wall_mm: float) -> SeamTerms:
    """Diameter difference, axis offset and angle between the walls, each with its U or not at all.

    Args:
        step: what `measure_step` returned: radius difference with its standard uncertainty, axis offset and angle, with
            theirs along their own direction; infinite or NaN where it has none. And the step's waves around the seam,
            each as (n, cosine, sine, their standard uncertainties, their prior's).
        outside_diameter_mm: rated.
        wall_mm: rated thickness of the wall.

    Example:
        >>> from types import SimpleNamespace
        >>> from weldscan.measure.observable_terms import seam_terms
        >>> step = SimpleNamespace(
        ...     radius_difference_mm=(-29.4, 34.2), axis_offset_mm=[29.0, 6.0], axis_offset_standard_mm=14.0,
        ...     tilt_rad=0.001, tilt_standard_rad=0.02, waves_mm=[],
        ... )
        >>> seam_terms(step, 630.0, 6.0).not_observable
        ('diameter_difference', 'axis_offset', 'angle_between_walls')
    """
    half, half_standard = step.radius_difference_mm
    east, north = step.axis_offset_mm
    harmonics: dict[str, float] = {}
    missing = []
    u = _expanded(2 * half_standard)
    if _determined(u, DIAMETER_PRIOR * outside_diameter_mm):
        harmonics |= {"diameter_difference": 2 * half, "diameter_difference_u": u}
    else:
        missing.append("diameter_difference")
    u = _expanded(step.axis_offset_standard_mm)
    if _determined(u, OFFSET_PRIOR * wall_mm):
        at = math.degrees(math.atan2(north, east)) % 360
        harmonics |= {"axis_offset": math.hypot(east, north), "axis_offset_u": u, "axis_offset_at_deg": at}
    else:
        missing.append("axis_offset")
    for n, cosine, sine, *standard, prior in step.waves_mm:
        amplitudes = {"cos": (cosine, standard[0]), "sin": (sine, standard[1])}
        told = [abs(a) > TOLD * u for a, u in amplitudes.values()]
        if not all(_determined(_expanded(u), prior) for u in standard):
            missing += [f"n{n}"] if n <= NAMED_WAVES else []
        elif n <= NAMED_WAVES or any(told):
            for name, (amplitude, u) in amplitudes.items():
                harmonics |= {f"n{n}_{name}": amplitude, f"n{n}_{name}_u": _expanded(u)}
    u = math.degrees(_expanded(step.tilt_standard_rad))
    if _determined(u, ANGLE_PRIOR_DEG):
        return SeamTerms(harmonics, math.degrees(step.tilt_rad), u, tuple(missing))
    return SeamTerms(harmonics, None, None, (*missing, "angle_between_walls"))


def _expanded(standard: float) -> float:
    """With k = 2; infinite where there is none."""
    return 2 * float(standard) if math.isfinite(standard) else math.inf


def _determined(expanded: float, prior: float) -> bool:
    return expanded <= prior / 2
