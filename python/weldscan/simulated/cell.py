"""The simulated cell: scanner, robot, three-sphere plate and a welded pipe.

`DEFAULT` is the demo; `dataclasses.replace(DEFAULT, ...)` makes another one: each number of it is a parameter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from weldscan._weldcore import Scanner
from weldscan.devices.projectors.patterns import board_fringes
from weldscan.simulated.placing import Floats, Matrix, look_at, make_scanner, moved, placed, tilted_views
from weldscan.simulated.shapes import (
    ANODISED,
    CERAMIC,
    PAPER,
    PLATE,
    REFERENCE_WALL,
    SPHERE,
    STEEL,
    STEM,
    Block,
    Body,
    Photometry,
    Sphere,
    Stem,
    Surface,
    Weld,
    pipe,
)

_HAND_EYE: Matrix = tuple(map(tuple, placed((58.0, -24.0, 112.0), (0.35, -0.22, 1.9)).tolist()))


_PLATE: Matrix = tuple(map(tuple, placed((540.0, -300.0, 45.0), (0.01, -0.02, 0.4)).tolist()))


_WELD: Matrix = ((0.0, 0.0, 1.0, 900.0), (1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 300.0), (0.0, 0.0, 0.0, 1.0))


@dataclass(frozen=True)
class Cell:
    """A cell and a measuring plan. Poses are in the robot's base frame, `base_from_...`, mm."""

    name: str = "simulated-cell"
    seed: int = 1
    scanner: Scanner = field(default_factory=make_scanner)
    photometry: Photometry = field(default_factory=Photometry)
    fringes: tuple[tuple[str, float, int] | tuple[str, float, int, int, float], ...] = (
        ("x", 1, 4),
        ("x", 8, 4),
        ("x", 64, 4),
    )
    """Sets of (axis, periods, steps)."""
    distance_mm: float = 420.0

    # The part.
    weld: Weld = field(default_factory=pipe)
    thickness_mm: float = 6.0
    stated_diameter_mm: float | None = None
    """Outside diameter in session.json where it is not the reference wall's."""
    part_surface: Surface = STEEL
    base_from_weld: Matrix | Floats = _WELD
    part_at_deg: tuple[float, ...] = (166.0, 190.0)
    """A shot looks at each of these angles about the axis (plates: places along the seam, mm)."""
    part_aside_mm: float = 0.0
    """Where the shots look, from the seam towards the other wall: 150 mm leaves one wall in view."""
    part_exposures: tuple[float, ...] = (1.0,)

    # The artefact: spheres on stems on a plate.
    sphere_diameter_mm: float = 20.0
    spheres_mm: tuple[tuple[float, float, float], ...] = ((-27.0, -24.0, 25.0), (25.0, -24.0, 27.0), (17.4, 19.3, 24.0))
    """Centres on the plate, whose middle is the origin: 52, 44 and 62 mm apart."""
    plate_mm: tuple[float, float, float] = (80.0, 80.0, 8.0)
    spheres_there: tuple[bool, bool, bool] = (True, True, True)
    """Which spheres are on the plate: one that is missing was still touched."""
    mirrored: bool = False
    """The plate is the mirror image of the one that was touched."""
    base_from_plate: Matrix | Floats = _PLATE
    artefact_shots: int = 6

    # The flat standard: its shots belong to a verification of the scanner.
    flat_mm: tuple[float, float, float] = (150.0, 110.0, 12.0)
    base_from_flat: Matrix | Floats = _PLATE
    plane_shots: int = 0

    # The robot. A cell without one has one part shot and no artefact.
    robot: str | None = "KUKA KR10 R1100"
    flange_from_scanner: Matrix | Floats = _HAND_EYE
    pose_noise_mm: float = 0.03
    """Standard deviation of the reported pose along each axis."""
    pose_noise_deg: float = 0.005
    """And about each axis."""
    touch_noise_mm: float = 0.01
    probe_noise_mm: float = 0.015
    """Of the points touched on the part (`touch.csv`)."""
    touched_points: int = 60

    # --- where things are

    def sphere_centres(self) -> Floats:
        """Return the (3, 3) true sphere centres in base, as they were touched."""
        return self._on_plate(np.asarray(self.spheres_mm))

    def _on_plate(self, points: Floats) -> Floats:
        return moved(np.asarray(self.base_from_plate), points)

    def artefact_bodies(self) -> list[Body]:
        """Return plate, stems and spheres."""
        plate = np.asarray(self.base_from_plate)
        bodies = [Body(Block(self.plate_mm), plate, ANODISED, PLATE)]
        flip = np.array([-1.0 if self.mirrored else 1.0, 1.0, 1.0])
        for i, centre in enumerate(np.asarray(self.spheres_mm) * flip):
            if self.spheres_there[i]:
                foot, top = self.plate_mm[2] / 2, float(centre[2])
                stem = Stem(self.sphere_diameter_mm / 5, top - foot)
                bodies.append(Body(stem, plate @ placed((centre[0], centre[1], foot)), ANODISED, STEM))
                bodies.append(Body(Sphere(self.sphere_diameter_mm / 2), plate @ placed(centre), CERAMIC, SPHERE + i))
        return bodies

    def plane_bodies(self) -> list[Body]:
        """Return the flat standard."""
        return [Body(Block(self.flat_mm), np.asarray(self.base_from_flat), CERAMIC, PLATE)]

    def part_bodies(self) -> list[Body]:
        """Return the weld."""
        return [Body(self.weld, np.asarray(self.base_from_weld), self.part_surface, REFERENCE_WALL)]

    def artefact_views(self) -> list[Floats]:
        """Return base_from_scanner per artefact shot: tilted by 30 to 45 degrees to all sides, rolled, near and far."""
        target = placed(np.mean(self.spheres_mm, axis=0))
        return tilted_views(
            np.asarray(self.base_from_plate) @ target, self.artefact_shots, distance_mm=self.distance_mm
        )

    def plane_views(self) -> list[Floats]:
        """Return base_from_scanner per shot of the flat standard, placed as those of the artefact."""
        top = placed((0.0, 0.0, self.flat_mm[2] / 2))
        return tilted_views(np.asarray(self.base_from_flat) @ top, self.plane_shots, distance_mm=self.distance_mm)

    def part_views(self) -> list[Floats]:
        """Return base_from_scanner per part shot: nearly square to the surface, the image's x along the axis."""
        weld = np.asarray(self.base_from_weld)
        views = []
        for i, at in enumerate(self.part_at_deg):
            flat = math.isinf(self.weld.reference.radius_mm)
            angle = 0.0 if flat else math.radians(at)
            outward = np.array([math.cos(angle), math.sin(angle), 0.0])
            around = np.array([-math.sin(angle), math.cos(angle), 0.0])
            surface = around * at if flat else outward * self.weld.reference.radius_mm
            target = surface + np.array([0.0, 0.0, self.part_aside_mm])
            lean = math.radians((4.0, -3.0)[i % 2])
            direction = outward * math.cos(lean) + around * math.sin(lean)
            pose = look_at(target, target + direction * self.distance_mm, around)
            views.append(weld @ pose @ placed((0, 0, 0), (0.0, 0.0, math.radians((0.6, -0.4)[i % 2]))))
        return views


DEFAULT = Cell()
"""The demo: a 630x6 pipe whose walls are out of line by 0.47 mm, six shots of the plate, two of the weld."""


@dataclass(frozen=True)
class BoardCell(Cell):
    """A cell for calibrating its scanner: a chessboard lies where the three-sphere plate was, fringes run both ways."""

    fringes: tuple[tuple[str, float, int] | tuple[str, float, int, int, float], ...] = board_fringes(1280, 800)
    corners: tuple[int, int] = (8, 11)
    square_mm: float = 8.0

    def artefact_bodies(self) -> list[Body]:
        """Return the board, a white rim of one square around its squares."""
        squares = self.corners[0] + 1, self.corners[1] + 1
        size = ((squares[0] + 2) * self.square_mm, (squares[1] + 2) * self.square_mm, 8.0)
        return [Body(Block(size, squares, self.square_mm), np.asarray(self.base_from_plate), PAPER, PLATE)]

    def board_views(self, count: int) -> list[Floats]:
        """Return base_from_scanner per pose: tilted to all sides, rolled, near and far, and aside."""
        top, reach = placed((0.0, 0.0, 4.0)), 1.0 * self.square_mm
        views = []
        for i, view in enumerate(tilted_views(np.asarray(self.base_from_plate) @ top, count)):
            aside = (math.cos(2.4 * i) * reach, math.sin(2.4 * i) * reach, 0.0)
            views.append(view @ placed(aside))
        return views
