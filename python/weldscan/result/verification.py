"""A scanner's own acceptance: what was found at every place, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weldscan.result.verdict import Verdict

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BallError:
    """One sphere at one place of the volume: the range of its radial residuals, and how much too large it came out."""

    shot: str
    sphere: int
    """1, 2 or 3, in the order of the session's `artefact`."""
    centre_mm: Floats
    """(3,), scanner frame: the centre of the sphere with the calibrated diameter."""
    form_mm: float
    """PF, over the judged share of the points."""
    form_all_mm: float
    """PF over all points."""
    form_997_mm: float
    """PF without the 3 per mille of the points that lie furthest off."""
    form_95_mm: float
    """PF without the 5 per cent that lie furthest off."""
    noise_range_mm: float
    """Range that normal noise of this rms has over so many points."""
    size_mm: float
    """PS, over the judged share of the points."""
    rms_mm: float
    points: int
    wild: int
    """Points too far off to be the sphere's; PF over all points has them, the sphere has not."""
    seen: float
    """Share of the 120 degree cap's pixels that were measured."""
    residual_mm: Floats
    """(n, n) mean residuals as the camera sees the cap, NaN where there are none."""


@dataclass(frozen=True, eq=False)
class SpacingError:
    """The distance of two spheres at one place of the volume."""

    shot: str
    spheres: tuple[int, int]
    centres_mm: Floats
    """(2, 3), scanner frame."""
    measured_mm: float
    calibrated_mm: float

    @property
    def error_mm(self) -> float:
        """SD."""
        return self.measured_mm - self.calibrated_mm


@dataclass(frozen=True, eq=False)
class PlaneError:
    """The flat standard at one place of the volume: the range of its residuals."""

    shot: str
    corners_mm: Floats
    """(4, 3), scanner frame: of the rectangle in the plane that holds the points."""
    flatness_mm: float
    """F, over the judged share of the points."""
    flatness_all_mm: float
    flatness_997_mm: float
    flatness_95_mm: float
    noise_range_mm: float
    rms_mm: float
    points: int
    wild: int
    """Points too far off to be the plane's; F over all points has them, the plane has not."""
    seen: float
    """Share of the pixels within the plane's outline that were measured."""
    size_mm: tuple[float, float]
    """Of the rectangle that was seen."""
    of_field: float
    """Its longer side as a share of the field's diagonal at that distance."""
    residual_mm: Floats
    """(rows, columns) mean residuals in the image's orientation, NaN where there are none."""

    @property
    def centre_mm(self) -> Floats:
        """Middle of what was seen."""
        return np.asarray(self.corners_mm.mean(axis=0))


@dataclass(frozen=True)
class Characteristic:
    """One characteristic over all positions, and its verdict."""

    name: str
    """PF, PS, SD or F."""
    title: str
    value_mm: float | None
    """The value furthest from zero, with its sign: the one that is judged."""
    where: str
    """The shot and the sphere or plane that it belongs to."""
    mean_mm: float | None
    std_mm: float | None
    """Standard deviation over the positions."""
    positions: int
    """Distinct places in the volume."""
    required_positions: int
    points: int | None
    """Median number of points per position; None for distances."""
    limit_mm: float | None
    """The maximum permissible error, either side of zero."""
    u_mm: float
    """Test value uncertainty, k = 2: what the artefact's calibration leaves."""
    verdict: Verdict
    reason: str


@dataclass(frozen=True)
class Drift:
    """How a characteristic's mean changes over the verifications of one scanner."""

    name: str
    dates: tuple[str, ...]
    mean_mm: tuple[float, ...]
    value_mm: tuple[float, ...]
    rate_mm_per_year: float | None
    """Slope of a straight line through the means."""
    rate_u_mm_per_year: float | None
    """Half width of its 95 % interval (Student's t)."""
    text: str


@dataclass(frozen=True, eq=False)
class Verification:
    """Whether a scanner keeps its limits: VDI/VDE 2634 part 2 and ISO 10360-13."""

    session: str
    scanner: str
    """Identifies the calibrated scanner: a hash of its numbers."""
    date: str
    date_from: str
    """Where the date was taken from."""
    valid_until: str
    characteristics: tuple[Characteristic, ...]
    balls: tuple[BallError, ...]
    spacings: tuple[SpacingError, ...]
    planes: tuple[PlaneError, ...]
    lost: tuple[tuple[str, str], ...]
    """Shots that do not show what the session says they show, with the reason."""
    assumed: tuple[str, ...]
    """What was taken for the artefact where the session gives no certificate."""
    warnings: tuple[str, ...]
    limits: dict[str, Any]
    software: dict[str, str]
    fringes: str = ""
    """What was projected: a verification is about these."""
    drift: tuple[Drift, ...] = ()
    """Over the verifications in the history, where one is kept."""
    notes: tuple[str, ...] = ()
    """What there is to say about the history file."""

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of the characteristics that have a limit; NOT ASSESSABLE where none has."""
        order = (Verdict.FAIL, Verdict.NOT_MEASURED, Verdict.NOT_ASSESSABLE, Verdict.INCONCLUSIVE, Verdict.PASS)
        given = {each.verdict for each in self.characteristics if each.limit_mm is not None}
        return next((verdict for verdict in order if verdict in given), Verdict.NOT_ASSESSABLE)

    @property
    def span_mm(self) -> tuple[float, float, float]:
        """How far the positions reach along the scanner's x, y and z."""
        places = [*(b.centre_mm[None] for b in self.balls), *(p.corners_mm for p in self.planes)]
        if not places:
            return 0.0, 0.0, 0.0
        x, y, z = np.ptp(np.concatenate(places), axis=0).tolist()
        return x, y, z

    def __getitem__(self, name: str) -> Characteristic:
        """PF, PS, SD or F."""
        return next(each for each in self.characteristics if each.name == name)
