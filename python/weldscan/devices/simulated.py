"""The simulated cell: scanner, robot, three-sphere plate and a welded pipe, rendered into a session folder.

`DEFAULT` is the demo; `dataclasses.replace(DEFAULT, ...)` makes another one: each number of it is a parameter. The
truth is returned and written beside the session as `truth.json`.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import Lens, Scanner, SimulatedShot, simulate_shot, simulated_step
from weldscan.errors import InputError
from weldscan.fringes import board_fringes
from weldscan.pose import KukaPose
from weldscan.records.images import Frames
from weldscan.records.session import Session, write_session

Floats: TypeAlias = NDArray[np.float64]
Matrix: TypeAlias = tuple[tuple[float, ...], ...]
Progress: TypeAlias = Callable[[int, int, str], None]
"""Called with shots done, shots in all, and what is being done."""

# Labels of the truth. A weld's parts follow on its label: reference wall, other wall, bead.
REFERENCE_WALL, OTHER_WALL, BEAD, PLATE, STEM, SPHERE = 1, 2, 3, 4, 5, 6
Target: TypeAlias = Literal["artefact", "part", "plane"]
"""What a shot is of."""
# Profile bins as in `weldscan-result/2`: 2 degrees, centred on even degrees.
BIN_DEG = 2
BIN_MM = 0.005
"""Bins of the histogram whose highest one is the mode."""


# --- the scene --------------------------------------------------------------------------------------------------------


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


# --- frames -----------------------------------------------------------------------------------------------------------


def look_at(
    target: Sequence[float] | Floats, position: Sequence[float] | Floats, up: Sequence[float] | Floats
) -> Floats:
    """Return the 4x4 pose of a camera at `position` that looks at `target`; its image's y runs against `up`."""
    z = np.asarray(target, dtype=float) - position
    z /= np.linalg.norm(z)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    pose[:3, 3] = position
    return pose


def _rotation(rotation_vector: Sequence[float] | Floats) -> Floats:
    angle = float(np.linalg.norm(rotation_vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = np.asarray(rotation_vector) / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation: Floats = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return rotation


def placed(
    translation: Sequence[float] | Floats, rotation_vector: Sequence[float] | Floats = (0.0, 0.0, 0.0)
) -> Floats:
    """Return the 4x4 transform of a translation (mm) and a rotation vector (rad)."""
    pose = np.eye(4)
    pose[:3, :3] = _rotation(rotation_vector)
    pose[:3, 3] = translation
    return pose


def _moved(pose: Floats, points: Floats) -> Floats:
    moved: Floats = points @ pose[:3, :3].T + pose[:3, 3]
    return moved


def _intrinsics(fx: float, fy: float, cx: float, cy: float) -> Floats:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def make_scanner(
    camera: Lens | None = None,
    projector: Lens | None = None,
    *,
    convergence_deg: float = 20.0,
    distance_mm: float = 420.0,
    axis: Literal["x", "y"] = "x",
) -> Scanner:
    """Return a scanner like a DAVID SLS-2: the axes of camera and projector meet at the working distance.

    Args:
        camera: its lens; by default 1280x960 px with distortion.
        projector: its lens; by default 1280x800 px with distortion.
        convergence_deg: angle between the two axes.
        distance_mm: working distance.
        axis: the projector stands beside the camera ("x") or above it ("y"): the fringes' axis must agree.
    """
    if camera is None:
        camera = Lens(1280, 960, _intrinsics(2610.0, 2611.0, 644.2, 470.8), [-0.11, 0.15, 0.0003, -0.0005])
    if projector is None:
        projector = Lens(1280, 800, _intrinsics(2080.0, 2080.0, 641.0, 402.5), [0.025, -0.02, 0.0002, -0.0001])
    angle = math.radians(convergence_deg)
    aside, ahead = distance_mm * math.sin(angle), distance_mm * (1 - math.cos(angle))
    position = (-aside, 4.0, ahead) if axis == "x" else (4.0, -aside, ahead)
    return Scanner(camera, projector, look_at((0.0, 0.0, distance_mm), position, (0.0, -1.0, 0.0)))


def tilted_views(base_from_target: Matrix | Floats, count: int, *, distance_mm: float = 420.0) -> list[Floats]:
    """Return base_from_scanner per shot of a target whose z faces the scanner: a three-sphere plate, a board.

    Tilted by 30 to 45 degrees to all sides, rolled, near and far: what hand-eye and scanner calibration need.
    """
    target = np.asarray(base_from_target)
    views = []
    for i in range(count):
        # The golden section spreads any number of shots around the target.
        around = 2 * math.pi * (i * 0.381966 + 0.1)
        tilt = math.radians((31.0, 44.0, 36.0, 40.0, 33.0, 42.0)[i % 6])
        distance = distance_mm + (0.0, 22.0, -18.0, 10.0, -9.0, 16.0)[i % 6]
        roll = math.radians((15.0, 105.0, -70.0, 200.0, 60.0, -30.0)[i % 6])
        direction = np.array([math.sin(tilt) * math.cos(around), math.sin(tilt) * math.sin(around), math.cos(tilt)])
        view = look_at((0.0, 0.0, 0.0), direction * distance, (0.0, 0.0, 1.0))
        views.append(target @ view @ placed((0.0, 0.0, 0.0), (0.0, 0.0, roll)))
    return views


# --- the cell ---------------------------------------------------------------------------------------------------------

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
        return _moved(np.asarray(self.base_from_plate), points)

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


# --- a session --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Shot:
    name: str
    of: Target
    base_from_scanner: Floats
    exposures: tuple[float, ...]
    seed: int


def _plan(cell: Cell) -> list[_Shot]:
    views: list[tuple[Target, Floats]] = [("artefact", v) for v in cell.artefact_views()]
    views += [("part", v) for v in cell.part_views()]
    views += [("plane", v) for v in cell.plane_views()]
    if cell.robot is None and [of for of, _ in views] != ["part"]:
        raise InputError("cell: without a robot there is one part shot and no artefact shot")
    seeds = np.random.SeedSequence(cell.seed).generate_state(len(views), np.uint64)
    numbers = {"artefact": 0, "part": 0, "plane": 0}
    shots = []
    for (of, view), seed in zip(views, seeds, strict=True):
        numbers[of] += 1
        exposures = cell.part_exposures if of == "part" else (1.0,)
        shots.append(_Shot(f"{of}-{numbers[of]}", of, view, exposures, int(seed)))
    return shots


def render(cell: Cell, of: Target, base_from_scanner: Floats, **options: Any) -> SimulatedShot:
    """Return one shot of artefact, part or flat standard; options are those of `simulate_shot` (exposures, seed)."""
    bodies = {"part": cell.part_bodies, "artefact": cell.artefact_bodies, "plane": cell.plane_bodies}[of]()
    return simulate_shot(cell.scanner, base_from_scanner, bodies, cell.fringes, cell.photometry, **options)


def session_document(cell: Cell = DEFAULT) -> dict[str, Any]:
    """Return the session.json that the cell would record, as a document: a plan for a live scan of it."""
    return _document(cell, _plan(cell), np.random.default_rng(cell.seed))


def _document(cell: Cell, shots: Sequence[_Shot], random: np.random.Generator) -> dict[str, Any]:
    scanner_from_flange = np.linalg.inv(cell.flange_from_scanner)
    entries = []
    for shot in shots:
        entry: dict[str, Any] = {"name": shot.name, "of": shot.of}
        if cell.robot is not None:
            turn = _rotation(random.normal(0.0, math.radians(cell.pose_noise_deg), 3))
            reported = shot.base_from_scanner @ scanner_from_flange
            reported[:3, :3] = turn @ reported[:3, :3]
            reported[:3, 3] += random.normal(0.0, cell.pose_noise_mm, 3)
            values = (round(v, 5) for v in KukaPose.from_matrix(reported).values())
            entry["flange_pose"] = dict(zip("XYZABC", values, strict=True))
        if shot.exposures != (1.0,):
            entry["exposures"] = shot.exposures
        entries.append(entry)
    weld = np.asarray(cell.base_from_weld)
    in_scanner = np.eye(4) if cell.robot is not None else np.linalg.inv(shots[0].base_from_scanner)
    document: dict[str, Any] = {
        "schema": "weldscan-session/1",
        "name": cell.name,
        "scanner": {
            "camera": _lens(cell.scanner.camera),
            "projector": _lens(cell.scanner.projector),
            "camera_from_projector": cell.scanner.camera_from_projector.tolist(),
        },
        "fringes": [
            dict(zip(("axis", "periods", "steps", "direction", "origin_rad"), fringe, strict=False))
            for fringe in cell.fringes
        ],
        "part": {
            "kind": "pipe",
            "outside_diameter": cell.stated_diameter_mm or 2 * cell.weld.reference.radius_mm,
            "wall_thickness": cell.thickness_mm,
            "joint": "circumferential butt",
            "axis_base": (in_scanner @ weld)[:3, 2].tolist(),
            "zero_base": (in_scanner @ weld)[:3, 0].tolist(),
        },
        "shots": entries,
    }
    if cell.robot is not None:
        document["robot"] = {"model": cell.robot}
    if cell.artefact_shots:
        touched = cell.sphere_centres() + random.normal(0.0, cell.touch_noise_mm, (3, 3))
        document["artefact"] = {
            "kind": "three-sphere plate",
            "sphere_diameter": cell.sphere_diameter_mm,
            "centres_base": touched.round(4).tolist(),
        }
    if cell.plane_shots:
        document["plane"] = {"size": list(cell.flat_mm[:2]), "flatness": 0.0}
    return document


def _lens(lens: Lens) -> dict[str, Any]:
    dist = list(lens.dist)
    return {"width": lens.width, "height": lens.height, "K": lens.K.tolist(), "dist": dist if dist[4] else dist[:4]}


def _step_of(cell: Cell, deviation: Floats, along: Floats) -> dict[str, Any]:
    """Return the truth of the step over lit points of the other wall."""
    flat = math.isinf(cell.weld.reference.radius_mm)
    if deviation.size == 0:
        return {"points": 0}
    place = along if flat else np.degrees(along) % 360
    # A bin about an even degree counts where either half of it was seen.
    whole = set(np.floor(place).astype(int).tolist())
    before = whole if flat else whole | {degree - 360 for degree in whole}
    bins = sorted(c for c in whole if c % 2 == 0 and c - 1 in before)
    steps = simulated_step(cell.weld, np.asarray(bins, dtype=float) if flat else np.radians(bins))
    counts, edges = np.histogram(deviation, np.arange(deviation.min() - BIN_MM, deviation.max() + 2 * BIN_MM, BIN_MM))
    largest = int(np.abs(steps).argmax()) if bins else None
    return {
        "median": float(np.median(deviation)),
        "mean": float(deviation.mean()),
        "max_abs": None if largest is None else float(abs(steps[largest])),
        "max_abs_at_deg": None if largest is None else int(bins[largest]),
        "mode": float(edges[counts.argmax()] + BIN_MM / 2),
        "at_seam_by_deg": {str(int(c)): float(s) for c, s in zip(bins, steps, strict=True)},
        "points": int(deviation.size),
    }


def simulate_session(
    folder: str | os.PathLike[str], cell: Cell = DEFAULT, progress: Progress | None = None
) -> dict[str, Any]:
    """Write a `weldscan-session/1` folder as the cell would have recorded it, with its truth in `truth.json`.

    Args:
        folder: must not exist yet, or be empty.
        cell: what stands where, how it is lit, how noisy it all is.
        progress: called with (shots done, shots in all, what) before each shot and at the end.

    Returns:
        The truth: `hand_eye_T_flange_camera`, `sphere_centres_base`, `T_base_pipe`, `part`, per shot `T_base_camera`
        and `step`, and `step_mm` over all part shots (mean and median over lit points of the other wall, `max_abs`
        over 2 degree bins at the seam).

    Raises:
        InputError: a number of the cell is out of its range, or the folder is in the way.
    """
    shots = _plan(cell)
    random = np.random.default_rng(cell.seed)
    document = _document(cell, shots, random)
    session = Session.model_validate_json(json.dumps(document))
    truth: dict[str, Any] = {
        "hand_eye_T_flange_camera": np.asarray(cell.flange_from_scanner).tolist(),
        "sphere_centres_base": cell.sphere_centres().tolist(),
        "T_base_pipe": np.asarray(cell.base_from_weld).tolist(),
        "part": _part_of(cell),
        "shots": {},
    }
    whites: dict[str, Any] = {}
    extra: dict[str, str] = {}
    pooled: list[tuple[Floats, Floats]] = []
    surface: list[Floats] = []

    def frames() -> Iterator[tuple[str, Frames]]:
        for number, shot in enumerate(shots):
            if progress is not None:
                progress(number, len(shots), f"rendering {shot.name}")
            rendered = render(cell, shot.of, shot.base_from_scanner, exposures=list(shot.exposures), seed=shot.seed)
            entry = truth["shots"][shot.name] = {"T_base_camera": shot.base_from_scanner.tolist()}
            if shot.of == "part":
                deviation, along = rendered.deviation_mm, rendered.along
                on_other = np.isfinite(deviation)
                pooled.append((deviation[on_other], along[on_other]))
                entry["step"] = _step_of(cell, *pooled[-1])
                points = rendered.points_mm[np.isfinite(along)]
                if len(points):
                    some = points[random.integers(0, len(points), -(-cell.touched_points // len(cell.part_at_deg)))]
                    surface.append(_moved(shot.base_from_scanner, some))
            whites[shot.name] = rendered.white
            yield shot.name, rendered.frames
        deviations, alongs = ([pair[i] for pair in pooled] or [np.zeros(0)] for i in (0, 1))
        step = _step_of(cell, np.concatenate(deviations), np.concatenate(alongs))
        truth["step_mm"] = step
        if surface and cell.robot is not None and cell.touched_points:
            probed = np.concatenate(surface)[: cell.touched_points]
            probed += random.normal(0.0, cell.probe_noise_mm, probed.shape)
            extra["touch.csv"] = "x_mm,y_mm,z_mm\n" + "".join(f"{x:.4f},{y:.4f},{z:.4f}\n" for x, y, z in probed)

    write_session(folder, session, frames(), whites=whites)
    for name, text in (extra | {"truth.json": json.dumps(truth, indent=1)}).items():
        (Path(folder) / name).write_text(text, encoding="utf-8")
    if progress is not None:
        progress(len(shots), len(shots), "session written")
    return truth


def _part_of(cell: Cell) -> dict[str, Any]:
    """Return how the part was made; a plate's radius is null, for JSON has no infinity."""
    weld, other = cell.weld, cell.weld.other
    flat = math.isinf(weld.reference.radius_mm)
    return {
        "radius": None if flat else weld.reference.radius_mm,
        "radius_difference": 0.0 if flat else other.radius_mm - weld.reference.radius_mm,
        "wall": cell.thickness_mm,
        "offset": other.offset_mm,
        "tilt": other.tilt_rad,
        "ovality": [weld.reference.ovality_mm, other.ovality_mm],
        "waviness": [weld.reference.waviness_mm, other.waviness_mm],
        "bead_width": weld.bead.width_mm,
        "bead_height": weld.bead.height_mm,
        "length": weld.length_mm,
        "seed": cell.seed,
    }
