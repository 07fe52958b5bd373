"""What can stand in the simulated cell: surfaces, plain shapes, and welds of two pipes or plates."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from weldscan.simulated.placing import Floats, Matrix

# Labels of the truth. A weld's parts follow on its label: reference wall, other wall, bead.
REFERENCE_WALL, OTHER_WALL, BEAD, PLATE, STEM, SPHERE = 1, 2, 3, 4, 5, 6


@dataclass(frozen=True)
class Surface:
    """Lambert albedo, height and exponent of the specular lobe, relative depth of brush marks."""

    albedo: float = 0.5
    specular: float = 0.0
    shininess: float = 30.0
    brushed: float = 0.0


CERAMIC = Surface(albedo=0.78, specular=0.05, shininess=60.0)


STEEL = Surface(albedo=0.42, specular=0.28, shininess=22.0, brushed=0.12)


PAPER = Surface(albedo=0.8)


ANODISED = Surface(albedo=0.4, specular=0.03, shininess=15.0)


@dataclass(frozen=True)
class Sphere:
    """A ball about its origin."""

    radius_mm: float


@dataclass(frozen=True)
class Block:
    """A box about its origin, with a chessboard on its +z face where `squares` says so (inner corners plus one)."""

    size_mm: tuple[float, float, float]
    squares: tuple[int, int] = (0, 0)
    square_mm: float = 10.0


@dataclass(frozen=True)
class Stem:
    """The side of a cylinder about z, from z = 0 to its length."""

    radius_mm: float
    length_mm: float


@dataclass(frozen=True)
class Wall:
    """A pipe's outside, or a plate where the radius is infinite. Offset and tilt are those of its axis."""

    radius_mm: float
    offset_mm: tuple[float, float] = (0.0, 0.0)
    tilt_rad: tuple[float, float] = (0.0, 0.0)
    ovality_mm: float = 0.0
    """Amplitude of the second harmonic of its radius: the diameters differ by four times as much."""
    ovality_at_rad: float = 0.0
    waviness_mm: float = 0.0


@dataclass(frozen=True)
class Bead:
    """A parabolic cap between its toes, with ripples; a width of 0 leaves the walls bare."""

    width_mm: float = 11.0
    height_mm: float = 1.8
    ripple_mm: float = 0.15
    pitch_mm: float = 3.6
    wander_mm: float = 0.25


@dataclass(frozen=True)
class Weld:
    """Two walls and the bead. z runs along the pipe from the reference wall to the other one; the seam is at z = 0."""

    reference: Wall
    other: Wall
    bead: Bead = field(default_factory=Bead)
    length_mm: float = 600.0


@dataclass(frozen=True)
class Body:
    """A shape at its place in the scene."""

    shape: Sphere | Block | Stem | Weld
    scene_from_body: Matrix | Floats
    surface: Surface = field(default_factory=Surface)
    label: int = 1


@dataclass(frozen=True)
class Photometry:
    """Lamp, room, projector and sensor; light in parts of the sensor's full scale at exposure 1."""

    lamp: float = 1.0
    """What a white surface returns that is lit squarely from `distance_mm`."""
    distance_mm: float = 420.0
    ambient: float = 0.02
    black: float = 0.01
    gamma: float = 1.0
    blur_px: float = 0.6
    full_well_e: float = 10_500.0
    read_noise_e: float = 20.0
    bits: Literal[8, 16] = 8


def pipe(
    diameter_mm: float = 630.0,
    *,
    offset_mm: float = 0.47,
    offset_at_deg: float = 170.0,
    tilt_deg: float = 0.0,
    tilt_at_deg: float = 0.0,
    diameter_difference_mm: float = 0.0,
    ovality_mm: float = 0.0,
    ovality_at_deg: float = 0.0,
    waviness_mm: float = 0.005,
    bead: Bead | None = None,
    length_mm: float = 600.0,
) -> Weld:
    """Return two pipes welded end to end, the other one's axis moved, tilted, wider and out of round as given.

    >>> pipe(273.0, offset_mm=0.3, offset_at_deg=180.0).other.offset_mm[0]
    -0.3
    """
    at, lean = math.radians(offset_at_deg), math.radians(tilt_at_deg)
    other = Wall(
        radius_mm=(diameter_mm + diameter_difference_mm) / 2,
        offset_mm=(offset_mm * math.cos(at), offset_mm * math.sin(at)),
        tilt_rad=(math.radians(tilt_deg) * math.cos(lean), math.radians(tilt_deg) * math.sin(lean)),
        ovality_mm=ovality_mm,
        ovality_at_rad=math.radians(ovality_at_deg),
        waviness_mm=waviness_mm,
    )
    return Weld(Wall(diameter_mm / 2, waviness_mm=waviness_mm), other, Bead() if bead is None else bead, length_mm)


def plates(step_mm: float = 0.5, *, angle_deg: float = 0.0, bead: Bead | None = None, length_mm: float = 600.0) -> Weld:
    """Return two plates butt-welded, the other one `step_mm` higher and tilted: a pipe of infinite radius."""
    other = Wall(math.inf, offset_mm=(step_mm, 0.0), tilt_rad=(math.radians(angle_deg), 0.0))
    return Weld(Wall(math.inf), other, Bead() if bead is None else bead, length_mm)


NO_BEAD = Bead(width_mm=0.0, height_mm=0.0, ripple_mm=0.0, wander_mm=0.0)
