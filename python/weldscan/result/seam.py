"""The seam by bins: what became of every pixel, how much was seen, how much had to be."""

from __future__ import annotations

from dataclasses import dataclass

WHOLE_TURN_DEG = 360.0


FATES = (
    *("wall", "transition", "cap", "gated", "off_line", "dark", "saturated", "order_in_doubt", "two_paths"),
    *("outside_calibration", "hidden", "other"),
)
"""What became of a pixel of a part shot, by contract."""


@dataclass(frozen=True)
class SeamBin:
    """One bin of the seam that was required or seen, and what became of every pixel in it."""

    angle_deg: float
    along_mm: float
    """From the zero mark along the seam."""
    measured: bool
    fate: dict[str, int]
    """Pixels by `FATES`, over all part shots."""
    cap_width_mm: float | None = None
    toes_mm: tuple[float, float] | None = None
    """Both toes, along the axis from the seam's centreline: reference side, other side."""
    toes_u_mm: tuple[float, float] | None = None
    """Of either, expanded (k = 2)."""
    transition_mm: tuple[float | None, float | None] | None = None
    """How far from either toe the undisturbed wall begins; None where none was seen."""
    transition_depth_mm: tuple[float | None, float | None] | None = None
    """How far the surface in between departs from that wall drawn on."""


@dataclass(frozen=True)
class Coverage:
    """How much of the seam was seen, and how much had to be."""

    seen_deg: float
    required_deg: float
    required_by: str
    """session, option, or views: what these views should have seen."""
    gaps: tuple[tuple[float, float], ...]
    """Arcs that were required and not seen, from, to, degrees, in the direction of growing angle."""

    @property
    def enough(self) -> bool:
        """Whether all that is required was seen."""
        return not self.gaps and self.seen_deg >= self.required_deg
