"""The step with its uncertainty: the profile, its budget, the paper's histogram."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class BudgetLine:
    """One contribution to the standard uncertainty of the judged step (GUM, k = 1)."""

    name: str
    standard_mm: float
    derived_from: str


@dataclass(frozen=True, eq=False)
class Histogram:
    """The paper's histogram of nearest-neighbour distances, and its 20 % rule."""

    edges_mm: Floats
    counts: NDArray[np.int64]
    kept: NDArray[np.bool_]
    step_mm: float
    expanded_uncertainty_mm: float | None = None
    """Of `step_mm`, k = 2; None: not stated."""


@dataclass(frozen=True, eq=False)
class StepResult:
    """The step of the other wall over the reference wall; positive where the other wall is further from the axis."""

    mean_mm: float
    median_mm: float
    max_abs_mm: float
    max_abs_at_deg: float
    expanded_uncertainty_mm: float
    """Of `max_abs_mm`: the larger half of its 95 % interval."""
    histogram: Histogram | None
    angle_deg: Floats
    """Centres of the profile's bins: even degrees about the axis from the zero mark, those that were seen."""
    step_mm: Floats
    u_mm: Floats
    """Expanded, k = 2, of each bin."""
    budget: tuple[BudgetLine, ...]
    harmonics_mm: dict[str, float]
    """Fourier terms around the seam where the arc allows them: `name`, `name_u` (expanded, k = 2), `name_at_deg`."""
    angle_between_walls_deg: float | None
    """None where the scan does not determine it."""
    coverage_deg: float
    """How much of the seam's turn was seen."""
    angle_between_walls_u_deg: float | None = None
    """Expanded, k = 2."""
    not_observable: tuple[str, ...] = ()
    """Names of what this scan does not determine: less than a pipe's tolerances do."""
    judged: Literal["wall", "edge"] = "wall"
    """Which of the two steps `step_mm` is, and the verdict is about: the walls', unless the edges have the larger upper
    bound and contradict them, or the surface beside the weld is not that of the undisturbed walls. Where both tell the
    same, the walls tell it better."""
    edge_upper_mm: float | None = None
    """Upper bound of the largest edge step, whichever is judged."""
    wall_step_mm: Floats | None = None
    """The undisturbed walls, extrapolated to the weld's centreline."""
    wall_u_mm: Floats | None = None
    edge_step_mm: Floats | None = None
    """The surfaces right beside both toes, as a gauge reads them."""
    edge_u_mm: Floats | None = None

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Which bins of the profile hold a number with its uncertainty; the others are no measurement."""
        return np.isfinite(self.step_mm) & np.isfinite(self.u_mm)

    band_mm: Floats | None = None
    """Half width of the band that holds all bins at once in 95 % of all cases."""
    quantiles_mm: Floats | None = None
    """(101,): of the largest |step|, 0, 1, ... 100 %; None where only its interval is known."""
    seam_mean: tuple[float, float] | None = None
    """Mean step at the seam over the bins seen, and its expanded uncertainty, k = 2."""

    @property
    def seam_mean_mm(self) -> float | None:
        """Mean step at the seam over the bins seen; None where it was not measured."""
        return None if self.seam_mean is None else self.seam_mean[0]

    @property
    def seam_mean_u_mm(self) -> float | None:
        """Its expanded uncertainty, k = 2."""
        return None if self.seam_mean is None else self.seam_mean[1]

    @property
    def q05_mm(self) -> float:
        """The largest |step| is above this in 95 % of all cases."""
        if self.quantiles_mm is None:
            return max(self.max_abs_mm - self.expanded_uncertainty_mm, 0.0)
        return float(self.quantiles_mm[5])

    @property
    def q95_mm(self) -> float:
        """The largest |step| is below this in 95 % of all cases."""
        if self.quantiles_mm is None:
            return self.max_abs_mm + self.expanded_uncertainty_mm
        return float(self.quantiles_mm[95])
