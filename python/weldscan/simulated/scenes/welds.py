"""The weld: two walls, each with what departs from a cylinder, a cap, and what lies on them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import WeldSurface

Floats: TypeAlias = NDArray[np.float64]


Matrix: TypeAlias = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Harmonic:
    """`amplitude cos(n (angle - at))` on a wall's radius."""

    n: int
    amplitude_mm: float
    at_rad: float = 0.0


@dataclass(frozen=True)
class Waviness:
    """A Gaussian process over the wall, covariance `sd² exp(-½ (da/around)² - ½ (dz/along)²)`."""

    sd_mm: float
    around_mm: float
    along_mm: float


@dataclass(frozen=True)
class Wander:
    """A Gaussian process around the pipe."""

    sd_mm: float = 0.0
    length_mm: float = 20.0


@dataclass(frozen=True)
class Taper:
    """Machined off: `depth_mm` at the toe, less by `slope` per mm away from it."""

    depth_mm: float
    slope: float


@dataclass(frozen=True)
class Counterbore:
    """A floor of constant depth from the toe outward, then a shoulder of that slope."""

    depth_mm: float
    floor_mm: float
    slope: float = 0.5


@dataclass(frozen=True)
class Flare:
    """The end bent outward by `amplitude exp(-x/decay)` at the distance x from the toe."""

    amplitude_mm: float
    decay_mm: float


@dataclass(frozen=True)
class Dent:
    """`-depth shape(angle) exp(-x/decay)`; a depth below 0 is a bulge, an infinite decay the whole wall."""

    depth_mm: float
    at_rad: float
    width_rad: float
    """Full width at half depth."""
    decay_mm: float
    cosine: bool = True
    """A raised cosine, which ends, instead of a Gaussian."""


@dataclass(frozen=True)
class Strip:
    """Something laid on the wall between two distances from the toe: a coat (to infinity) or tape."""

    thickness_mm: float
    from_mm: float
    to_mm: float = math.inf
    edge_mm: float = 0.5


@dataclass(frozen=True)
class SceneWall:
    """One pipe's outside: how it departs from the nominal cylinder."""

    radius_difference_mm: float = 0.0
    offset_mm: tuple[float, float] = (0.0, 0.0)
    tilt_rad: tuple[float, float] = (0.0, 0.0)
    ovality: tuple[Harmonic, ...] = ()
    unevenness: tuple[Waviness, ...] = ()
    shrinkage_mm: float = 0.0
    """How far the weld drew it in at the seam."""
    taper: Taper | None = None
    counterbore: Counterbore | None = None
    flare: Flare | None = None
    dents: tuple[Dent, ...] = ()
    strips: tuple[Strip, ...] = ()


@dataclass(frozen=True)
class Cap:
    """`height (1 - |v|^power)^blend` over the chord between the walls' edges; a height of 0 is ground flush."""

    width_mm: float = 11.0
    height_mm: float = 1.7
    power: float = 2.0
    blend: float = 1.0
    crown: float = 0.5
    """Where the crown is, from the reference wall's toe (0) to the other's (1)."""
    valley: float = 0.0
    """Depth of a valley along the crown, in parts of the height: two humps."""
    ripple_mm: float = 0.0
    pitch_mm: float = 3.6
    toes: Wander = Wander()
    crest: Wander = Wander()
    undercut_mm: tuple[float, float] = (0.0, 0.0)
    """Inside the toes: the step is read where the undisturbed wall begins."""
    undercut_width_mm: float = 1.5


@dataclass(frozen=True)
class SecondSeam:
    """A second weld at a distance from the first (below 0: in the reference wall), and how far the ring stands out."""

    distance_mm: float
    width_mm: float
    height_mm: float
    ring_mm: float


@dataclass(frozen=True)
class Spatter:
    """A drop: a ball whose middle lies 0.3 radii below the surface."""

    at_rad: float
    z_mm: float
    radius_mm: float


@dataclass(frozen=True)
class SceneWeld:
    """Two walls, a cap, and what is on them. z runs from the reference wall to the other one, the seam is near z = 0.

    >>> weld = SceneWeld(315.0, 6.0, other=SceneWall(taper=Taper(1.6, 0.1)))
    >>> edges = WeldSurface(weld).edges([0.0])[0]
    >>> float(round(edges[3] - edges[2], 6))
    -1.6
    """

    radius_mm: float
    thickness_mm: float
    half_length_mm: float = 180.0
    reference: SceneWall = SceneWall()
    other: SceneWall = SceneWall()
    cap: Cap = Cap()
    seam_mm: float = 0.0
    seam_wander: Wander = Wander()
    second: SecondSeam | None = None
    spatter: tuple[Spatter, ...] = ()
    seed: int = 0


@lru_cache(maxsize=4)
def surface_of(weld: SceneWeld) -> WeldSurface:
    """Return the weld's surface, its random parts drawn; the last few are kept."""
    return WeldSurface(weld)
