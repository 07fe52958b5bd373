"""Welds as real pipes have them, seen by a scanner, with their truth: what a verdict is tried on.

`draw(kind, seed)` gives a `Scene` of a named kind, `views(scene)` its clouds, `record(scene, folder)` a whole session
with fringe images, `truth(scene)` the step between the two walls' surfaces at the toes. Nothing here is taken from what
the measuring side assumes of a weld: the surface is a height field made of parts that pipes have (docs/simulator.md).
"""

from __future__ import annotations

import json
import math
import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import Lens, Scanner, WeldSurface
from weldscan.errors import InputError
from weldscan.norms import limit_mm
from weldscan.pose import KukaPose
from weldscan.records.images import Frames
from weldscan.records.session import Session, write_session

Floats: TypeAlias = NDArray[np.float64]
Matrix: TypeAlias = tuple[tuple[float, ...], ...]

NORM = ("pnae-g-7-010-89", "Table 1, column 2")
"""Whose limit a scene's step is drawn against."""
BIN_DEG = 2
"""Bins of the truth, centred on even degrees as those of a result's profile."""
HONEST, OVER = 0.8, (1.05, 3.0)
"""Largest true step in parts of the limit: of an honest scene at most, of a defective one from and to."""
GRAZING = math.cos(math.radians(75.0))
"""Cosine of light or view below which a surface shows no fringes; the core's rays have the same."""
FRINGES = (("x", 1, 4), ("x", 8, 4), ("x", 64, 4))
OK, DARK, SATURATED, ORDER, NO_FIT = range(5)
"""Why a pixel has no point, as `decode` has it."""


# --- the weld ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Harmonic:
    """`amplitude cos(n (angle - at))` on a wall's radius."""

    n: int
    amplitude_mm: float
    at_rad: float = 0.0


@dataclass(frozen=True)
class Unevenness:
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
class Wall:
    """One pipe's outside: how it departs from the nominal cylinder."""

    radius_difference_mm: float = 0.0
    offset_mm: tuple[float, float] = (0.0, 0.0)
    tilt_rad: tuple[float, float] = (0.0, 0.0)
    ovality: tuple[Harmonic, ...] = ()
    unevenness: tuple[Unevenness, ...] = ()
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
class Weld:
    """Two walls, a cap, and what is on them. z runs from the reference wall to the other one, the seam is near z = 0.

    >>> weld = Weld(315.0, 6.0, other=Wall(taper=Taper(1.6, 0.1)))
    >>> edges = WeldSurface(weld).edges([0.0])[0]
    >>> float(round(edges[3] - edges[2], 6))
    -1.6
    """

    radius_mm: float
    thickness_mm: float
    half_length_mm: float = 180.0
    reference: Wall = Wall()
    other: Wall = Wall()
    cap: Cap = Cap()
    seam_mm: float = 0.0
    seam_wander: Wander = Wander()
    second: SecondSeam | None = None
    spatter: tuple[Spatter, ...] = ()
    seed: int = 0


@lru_cache(maxsize=4)
def surface_of(weld: Weld) -> WeldSurface:
    """Return the weld's surface, its random parts drawn; the last few are kept."""
    return WeldSurface(weld)


# --- the scene --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class View:
    """One shot: where the scanner stood in the weld's frame, and what the robot said of it."""

    name: str
    weld_from_scanner: Matrix
    base_from_flange: Matrix
    """As stated: with the robot's error. The scanner's frame is the flange's."""
    weld: int = 0
    """Which of the scene's welds it is of."""


@dataclass(frozen=True)
class Scene:
    """A weld (two, where the shots are of two pipes), who looked at it from where, and what the pixels lost."""

    kind: str
    seed: int
    welds: tuple[Weld, ...]
    views: tuple[View, ...]
    field_mm: float
    """What the camera sees along the pipe: it sets the scanner."""
    base_from_weld: Matrix
    noise_mm: float = 0.03
    """Of a point, along the camera's ray."""
    holes: float = 0.0
    """Share of the pixels without a point, in patches."""
    dark_deg: tuple[tuple[float, float], ...] = ()
    """Arcs without light, from and to; the second may pass 360."""
    saturated: float = 0.0
    """Share of the lit pixels, the brightest ones, that are saturated."""

    @property
    def scanner(self) -> Scanner:
        """The scanner."""
        return scanner_for(self.field_mm)

    @property
    def limit_mm(self) -> float:
        """The norm's limit for this wall thickness."""
        return limit_for(self.welds[0].thickness_mm)


def limit_for(thickness_mm: float) -> float:
    """Return the largest step that PNAE G-7-010-89 allows, column 2, mm.

    >>> limit_for(6.0)
    1.1
    """
    found = limit_mm(*NORM, thickness_mm)
    if found is None:
        raise InputError(f"thickness_mm: {thickness_mm} has no limit in {NORM[0]}")
    return found[0]


# The scanner that the sessions of an independent renderer have: camera 480x360, projector 1280x800, 20 degrees.
_FOCAL_PX, _PROJECTOR_PX = 979.0, 2080.0
_FAR_MM, _FIELD_MM = 430.0, 480 / 979.0 * 430.0
_CONVERGENCE = math.radians(20.0)
_NEAREST_MM = 200.0


def distance_for(field_mm: float) -> float:
    """Return the working distance for a field of view: 430 mm for 211 mm, not below 200 mm."""
    return max(_NEAREST_MM, _FAR_MM * min(1.0, field_mm / _FIELD_MM))


@lru_cache(maxsize=16)
def scanner_for(field_mm: float) -> Scanner:
    """Return a scanner whose camera sees `field_mm` along its rows from `distance_for(field_mm)`.

    >>> round(scanner_for(211.0).baseline_mm)
    148
    """
    distance = distance_for(field_mm)
    # A smaller field at the shortest distance is seen through longer lenses.
    zoom = distance / _FAR_MM * _FIELD_MM / field_mm
    near = distance / _FAR_MM
    s, c = math.sin(_CONVERGENCE), math.cos(_CONVERGENCE)
    turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    pose = np.eye(4)
    pose[:3, :3] = turn
    # Both axes meet at the working distance.
    pose[:3, 3] = np.array([0.0, 4.0 * near, distance]) - turn @ np.array([0.0, 0.0, distance * 0.99])
    focal, lamp = _FOCAL_PX * zoom, _PROJECTOR_PX * zoom
    return Scanner(
        Lens(480, 360, [[focal, 0.0, 239.7], [0.0, focal, 180.4], [0.0, 0.0, 1.0]], [0.0] * 4),
        Lens(1280, 800, [[lamp, 0.0, 641.0], [0.0, lamp, 402.5], [0.0, 0.0, 1.0]], [0.0] * 4),
        pose,
    )


# --- what the views saw -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Shot:
    """One view's cloud."""

    name: str
    points_mm: Floats
    """(H, W, 3), scanner's frame; NaN where there is none."""
    reason: NDArray[np.uint8]
    """(H, W): 0 a point, else why not, as `decode` has it."""
    base_from_flange: Floats
    """As the robot stated it; the scanner's frame is the flange's."""
    seen: Mapping[str, NDArray[Any]]
    """What every pixel sees in truth: `WeldSurface.cast`."""


def views(scene: Scene) -> Iterator[Shot]:
    """Yield the clouds of a scene's views, with noise along the camera's rays.

    >>> shot = next(views(draw("plain", 0)))
    >>> shot.points_mm.shape, shot.reason.shape
    ((360, 480, 3), (360, 480))
    """
    for number, view in enumerate(scene.views):
        random = np.random.default_rng([scene.seed, number, 1])
        seen = surface_of(scene.welds[view.weld]).cast(scene.scanner, view.weld_from_scanner)
        reason = _reason(scene, seen, random)
        points = seen["points_mm"]
        ray = points / np.linalg.norm(points, axis=2, keepdims=True)
        points = points + ray * random.normal(0.0, scene.noise_mm, (*reason.shape, 1))
        points[reason != OK] = np.nan
        yield Shot(view.name, points, reason, np.asarray(view.base_from_flange), seen)


def _brightness(seen: Mapping[str, NDArray[Any]]) -> Floats:
    """Return how bright each pixel is under even light: Lambert and the lobe of brushed steel; 0 for nothing."""
    bright: Floats = 0.6 * np.maximum(seen["light"], 0.0) + 0.5 * np.maximum(seen["gloss"], 0.0) ** 22
    return np.where(seen["status"] == 0, bright, 0.0)


def _reason(scene: Scene, seen: Mapping[str, NDArray[Any]], random: np.random.Generator) -> NDArray[np.uint8]:
    lit = seen["status"] == 0
    reason = np.where(lit, OK, DARK).astype(np.uint8)
    angle = np.degrees(np.nan_to_num(seen["angle_rad"]))
    for start, end in scene.dark_deg:
        reason[(angle - start) % 360.0 < end - start] = DARK
    if scene.holes > 0.0:
        # Patches: noise smoothed over a few pixels, of which the largest values are lost.
        patch = random.normal(size=lit.shape)
        patch = cv2.GaussianBlur(patch, (0, 0), random.uniform(2.0, 9.0))
        lost = patch > np.quantile(patch, 1.0 - scene.holes)
        reason[lost & (reason == OK)] = random.choice([DARK, ORDER, NO_FIT])
    if scene.saturated > 0.0 and lit.any():
        bright = _brightness(seen)
        reason[(bright > np.quantile(bright[lit], 1.0 - scene.saturated)) & (reason == OK)] = SATURATED
    return reason


# --- the truth --------------------------------------------------------------------------------------------------------


def seen_arc(scene: Scene) -> list[int]:
    """Return the 2 degree bins (their middles, whole degrees) of the seam that lie wholly in some view's field.

    The field is geometry alone: inside the images of camera and projector and facing both by less than 75 degrees on
    the nominal pipe. What is dark, hidden or saturated there counts: it is seam that a verdict speaks about.
    """
    return _bins(scene.views, scene.welds[0], scene.scanner)


def _bins(views: Sequence[View], weld: Weld, scanner: Scanner) -> list[int]:
    quarter = np.radians(np.arange(0.0, 360.0, 0.25))
    inside = np.zeros(len(quarter), dtype=bool)
    for view in views:
        inside |= _in_field(np.asarray(view.weld_from_scanner), weld, scanner, quarter)
    whole = inside & np.roll(inside, -1)
    per_bin = int(BIN_DEG / 0.25)
    starts = [(c * 4 - per_bin // 2) % len(quarter) for c in range(0, 360, BIN_DEG)]
    return [
        c
        for c, s in zip(range(0, 360, BIN_DEG), starts, strict=True)
        if np.take(whole, range(s, s + per_bin), mode="wrap").all()
    ]


def _in_field(pose: Floats, weld: Weld, scanner: Scanner, angle: Floats) -> NDArray[np.bool_]:
    outward = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    points = weld.radius_mm * outward + np.array([0.0, 0.0, weld.seam_mm])
    inverse = np.linalg.inv(pose)
    in_camera = points @ inverse[:3, :3].T + inverse[:3, 3]
    lamp = pose[:3, :3] @ scanner.camera_from_projector[:3, 3] + pose[:3, 3]
    inside = np.ones(len(angle), dtype=bool)
    for eye, pixel, lens in (
        (pose[:3, 3], scanner.camera.project(in_camera), scanner.camera),
        (lamp, scanner.project_to_projector(in_camera), scanner.projector),
    ):
        away = eye - points
        cosine = (outward * away).sum(axis=1) / np.linalg.norm(away, axis=1)
        with np.errstate(invalid="ignore"):
            shown = (pixel >= -0.5).all(axis=1) & (pixel <= np.array([lens.width, lens.height]) - 0.5).all(axis=1)
        inside &= (cosine > GRAZING) & shown
    return inside


def _places(bins: Sequence[int], radius_mm: float) -> Floats:
    """Return angles (bins, n), rad, in each bin half a millimetre apart or closer, the middle among them."""
    half = min(20, max(2, math.ceil(math.radians(BIN_DEG / 2) * radius_mm / 0.5)))
    inside = np.linspace(-BIN_DEG / 2, BIN_DEG / 2, 2 * half + 1)
    return np.radians(np.asarray(bins, dtype=float)[:, None] + inside)


def _steps(weld: Weld, angles: Floats) -> Floats:
    """Return the step at the angles; with a second weld in view, the one of the two that is larger."""
    edges = surface_of(weld).edges(angles.ravel())
    first, second = edges[:, 3] - edges[:, 2], edges[:, 5]
    larger: Floats = np.where(np.abs(second) > np.abs(first), second, first)
    return larger.reshape(angles.shape)


def truth(scene: Scene) -> dict[str, Any]:
    """Return what is true of a scene.

    Returns:
        `edge_step_by_deg`: other wall minus reference wall along the radius, each surface as it is at its toe (waves,
        shrinkage, dents, machining included; spatter left out), mm, in the middle of each bin of `seen_arc`; where two
        pipes or two welds were shot, the larger one. `range_by_deg`: the least and the largest in each bin.
        `largest` in magnitude anywhere in those bins and `largest_at_deg`; `limit_mm`; `honest`: the largest is not
        above 0.8 of the limit; `kind`, `what`.

    >>> truth(draw("taper 1:10", 1))["honest"]
    False
    """
    bins = seen_arc(scene)
    used = sorted({view.weld for view in scene.views})
    angles = _places(bins, scene.welds[0].radius_mm)
    steps = np.array([_steps(scene.welds[i], angles) for i in used])
    middle = angles.shape[1] // 2
    largest_of = np.abs(steps[:, :, middle]).argmax(axis=0)
    by_deg = steps[largest_of, np.arange(len(bins)), middle]
    low, high = steps.min(axis=(0, 2)), steps.max(axis=(0, 2))
    worst = np.maximum(np.abs(low), np.abs(high))
    at = int(worst.argmax())
    limit = scene.limit_mm
    return {
        "kind": scene.kind,
        "what": KINDS[scene.kind].what if scene.kind in KINDS else scene.kind,
        "edge_step_by_deg": {str(c): round(float(s), 5) for c, s in zip(bins, by_deg, strict=True)},
        "range_by_deg": {
            str(c): [round(float(a), 5), round(float(b), 5)] for c, a, b in zip(bins, low, high, strict=True)
        },
        "largest": round(float(worst[at]), 5),
        "largest_at_deg": bins[at],
        "limit_mm": limit,
        "honest": bool(worst[at] <= HONEST * limit * (1 + 1e-6)),
    }


def toes(scene: Scene, angle_deg: Sequence[float] | Floats, weld: int = 0) -> dict[str, Floats]:
    """Return per angle the true toes (z, mm), the cap's width and its height, mm."""
    edges = surface_of(scene.welds[weld]).edges(np.radians(angle_deg))
    return {
        "reference_mm": edges[:, 0],
        "other_mm": edges[:, 1],
        "width_mm": edges[:, 1] - edges[:, 0],
        "height_mm": edges[:, 4],
    }


# --- sessions ---------------------------------------------------------------------------------------------------------


def record(scene: Scene, folder: str | os.PathLike[str]) -> dict[str, Any]:
    """Write a whole `weldscan-session/1` of the scene: 8-bit fringe images, stated poses, hand-eye, and `truth.json`.

    The images' noise is what gives a point the scene's noise, as far as 8 bits allow.

    Args:
        scene: as `draw` gives it.
        folder: must not exist yet, or be empty.

    Returns:
        The truth.

    Raises:
        InputError: the folder is in the way.
    """
    known = truth(scene)
    session = Session.model_validate_json(json.dumps(session_document(scene)))
    write_session(folder, session, _frames(scene), extra={"truth.json": json.dumps(known, indent=1)})
    return known


def session_document(scene: Scene) -> dict[str, Any]:
    """Return the scene's session.json as a document."""
    weld, base = scene.welds[0], np.asarray(scene.base_from_weld)
    scanner = scene.scanner
    lens = [
        {"width": d.width, "height": d.height, "K": d.K.tolist(), "dist": list(d.dist)[:4]}
        for d in (scanner.camera, scanner.projector)
    ]
    shots = [
        {
            "name": view.name,
            "of": "part",
            "flange_pose": dict(zip("XYZABC", KukaPose.from_matrix(view.base_from_flange).values(), strict=True)),
        }
        for view in scene.views
    ]
    return {
        "schema": "weldscan-session/1",
        "name": f"{scene.kind} {scene.seed}",
        "scanner": {
            "camera": lens[0],
            "projector": lens[1],
            "camera_from_projector": scanner.camera_from_projector.tolist(),
        },
        "fringes": [{"axis": axis, "periods": periods, "steps": steps} for axis, periods, steps in FRINGES],
        "part": {
            "kind": "pipe",
            "outside_diameter": round(2 * weld.radius_mm, 6),
            "wall_thickness": weld.thickness_mm,
            "joint": "circumferential butt",
            "axis_base": base[:3, 2].tolist(),
            "zero_base": base[:3, 0].tolist(),
        },
        "shots": shots,
        "robot": {"model": "KUKA"},
        "hand_eye": {
            "schema": "weldscan-hand-eye/1",
            "id": "scene",
            "date": "2026-01-01",
            "flange_from_scanner": np.eye(4).tolist(),
            "covariance": np.diag([1e-9] * 3 + [2.5e-4] * 3).tolist(),
            "residual_rms_mm": 0.02,
        },
    }


def _frames(scene: Scene) -> Iterator[tuple[str, Frames]]:
    scanner = scene.scanner
    for number, view in enumerate(scene.views):
        random = np.random.default_rng([scene.seed, number, 1])
        seen = surface_of(scene.welds[view.weld]).cast(scanner, view.weld_from_scanner)
        reason = _reason(scene, seen, random)
        bright = _brightness(seen)
        lit = bright > 0.0
        if not lit.any():
            bright[:] = 0.0
        elif scene.saturated > 0.0:
            # Full scale is passed by the share that is said.
            bright = bright / np.quantile(bright[lit], 1.0 - scene.saturated) * 127.5
        else:
            bright = np.clip(bright / np.median(bright[lit]) * 90.0, 0.0, 120.0)
        dark = (reason != OK) & (reason != SATURATED)
        bright[dark] = 0.0
        noise = _level_noise(scene, seen, np.median(bright[lit & ~dark]) if (lit & ~dark).any() else 90.0)
        column = np.nan_to_num(seen["column_px"])
        images = []
        for _, periods, steps in FRINGES:
            phase = 2 * math.pi * periods * (column + 0.5) / scanner.projector.width
            for i in range(steps):
                level = 5.0 + bright + bright * np.cos(phase - 2 * math.pi * i / steps)
                level += random.normal(0.0, noise, level.shape)
                images.append(np.clip(np.rint(level), 0, 255).astype(np.uint8))
        yield view.name, [images]


def _level_noise(scene: Scene, seen: Mapping[str, NDArray[Any]], modulation: float) -> float:
    """Return the noise of a level that gives a point the scene's noise, 8-bit rounding already in it."""
    lit = seen["status"] == 0
    points = seen["points_mm"][lit][::37]
    if len(points) == 0:
        return 1.0
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    there = scene.scanner.project_to_projector(points + 0.1 * ray)[:, 0]
    px_per_mm = float(np.median(np.abs(there - scene.scanner.project_to_projector(points)[:, 0]))) / 0.1
    _, periods, steps = FRINGES[-1]
    phase = 2 * math.pi * periods / scene.scanner.projector.width * px_per_mm * scene.noise_mm
    wanted = phase * modulation * math.sqrt(steps / 2)
    return math.sqrt(max(wanted**2 - 1 / 12, 0.05**2))


# --- the kinds --------------------------------------------------------------------------------------------------------

Group: TypeAlias = Literal["clean", "other-honest", "defective"]


@dataclass(frozen=True)
class Kind:
    """A kind of scene: how its weld is made from an amplitude, and what is special about its case."""

    name: str
    what: str
    group: Group
    weld: Callable[[_Case], Callable[[float], Weld]]
    """From a case to the weld of an amplitude, mm: the amplitude is sought that gives the step that was drawn."""
    case: Callable[[_Case], None] = lambda case: None
    """Changes the case before its views are set up."""
    finish: Callable[[_Case, Scene], Scene] = lambda case, scene: scene
    """Changes the scene at the end: darkness, saturation, another pipe."""


@dataclass
class _Case:
    """Everything that is drawn before the weld is made."""

    random: np.random.Generator
    seed: int
    diameter_mm: float
    thickness_mm: float
    shots: int
    whole: bool = False
    lean_deg: float = 6.0
    noise_mm: float = 0.03
    sd_mm: float = 0.01
    width_mm: float = 0.0
    height_mm: float = 0.0
    target: tuple[float, float] | None = None
    """Of the largest step, in parts of the limit; by default what the group asks."""
    bins: list[int] = field(default_factory=list)
    views: tuple[View, ...] = ()
    base: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of the walls' misfit: direction, share of it that is a difference of radius, sign of that."""
    reference: Wall = Wall()
    other: Wall = Wall()
    cap: Cap = Cap()
    seam_mm: float = 0.0
    seam_wander: Wander = Wander()
    one_arc: bool = False
    """All shots look at the same place."""
    dark_rad: tuple[float, float] = (0.0, 0.0)

    @property
    def radius_mm(self) -> float:
        return self.diameter_mm / 2

    @property
    def limit(self) -> float:
        return limit_for(self.thickness_mm)

    @property
    def field_mm(self) -> float:
        """Along the pipe: 60 mm for one of 25, as much as the usual scanner sees from 150 on."""
        return float(np.clip(60.0 * (self.diameter_mm / 25.0) ** 0.7, 60.0, _FIELD_MM))

    def uniform(self, low: float, high: float) -> float:
        return float(self.random.uniform(low, high))

    def log(self, low: float, high: float) -> float:
        return float(math.exp(self.random.uniform(math.log(low), math.log(high))))

    def sign(self) -> float:
        return float(self.random.choice([-1.0, 1.0]))

    def inside(self, share: float = 0.3) -> float:
        """An angle in the seam that is seen, rad, away from the ends of an arc."""
        if len(self.bins) == 360 // BIN_DEG:
            return math.radians(self.uniform(0.0, 360.0))
        arc = self.arc()
        return math.radians(arc[len(arc) // 2] + self.uniform(-share, share) * BIN_DEG * len(arc))

    def arc(self) -> list[int]:
        """The longest run of bins, in order; its degrees may pass 360."""
        seen = set(self.bins)
        if len(seen) == 360 // BIN_DEG:
            return sorted(seen)
        best: list[int] = []
        for start in (b for b in self.bins if (b - BIN_DEG) % 360 not in seen):
            run = [start]
            while (run[-1] + BIN_DEG) % 360 in seen:
                run.append(run[-1] + BIN_DEG)
            best = max(best, run, key=len)
        return best

    def degrees(self, low: float, high: float, least_mm: float = 5.0) -> float:
        """An angle's width, rad, not shorter than some mm of girth (what can be dented is not narrower)."""
        return max(math.radians(self.uniform(low, high)), least_mm / self.radius_mm)

    def misfit(self, amplitude: float, wall: Wall | None = None) -> Wall:
        """The other wall moved and widened by an amplitude."""
        at, share, sign = self.base
        wall = self.other if wall is None else wall
        moved = amplitude * (1.0 - share)
        return replace(
            wall,
            radius_difference_mm=wall.radius_difference_mm + sign * amplitude * share,
            offset_mm=(moved * math.cos(at), moved * math.sin(at)),
        )

    def weld(self, **change: Any) -> Weld:
        made = Weld(
            self.radius_mm,
            self.thickness_mm,
            half_length_mm=round(1.1 * self.field_mm, 1),
            reference=self.reference,
            other=self.other,
            cap=self.cap,
            seam_mm=self.seam_mm,
            seam_wander=self.seam_wander,
            seed=self.seed,
        )
        return replace(made, **change)


def _aligned(case: _Case) -> Wall:
    """The other wall with a misfit of up to a third of the limit: what undisturbed walls show of a defective weld."""
    return case.misfit(case.uniform(0.0, 0.33) * case.limit)


def _misfit(case: _Case) -> Callable[[float], Weld]:
    return lambda a: case.weld(other=case.misfit(a))


def _on_either(case: _Case, change: Callable[[Wall, float], Wall]) -> Callable[[float], Weld]:
    """What is done to a wall is done to the one or the other."""
    other = _aligned(case)
    if case.random.random() < 0.5:
        return lambda a: case.weld(other=change(other, a))
    return lambda a: case.weld(other=other, reference=change(case.reference, a))


def _taper(slope: float | None) -> Callable[[_Case], Callable[[float], Weld]]:
    def weld(case: _Case) -> Callable[[float], Weld]:
        steep = case.log(0.05, 0.25) if slope is None else slope
        return _on_either(case, lambda wall, a: replace(wall, taper=Taper(a, steep)))

    return weld


def _counterbore(low_mm: float, high_mm: float) -> Callable[[_Case], Callable[[float], Weld]]:
    def weld(case: _Case) -> Callable[[float], Weld]:
        floor, slope = min(case.uniform(low_mm, high_mm), 0.25 * case.field_mm), case.log(0.25, 1.0)
        return _on_either(case, lambda wall, a: replace(wall, counterbore=Counterbore(a, floor, slope)))

    return weld


def _flare(case: _Case) -> Callable[[float], Weld]:
    decay, sign = case.uniform(3.0, 6.0), case.sign()
    return _on_either(case, lambda wall, a: replace(wall, flare=Flare(sign * a, decay)))


def _dent(
    low_deg: float, high_deg: float, decay: tuple[float, float], sign: float = 1.0
) -> Callable[[_Case], Callable[[float], Weld]]:
    def weld(case: _Case) -> Callable[[float], Weld]:
        at, width = case.inside(), case.degrees(low_deg, high_deg)
        length = math.inf if math.isinf(decay[1]) else case.uniform(*decay)
        cosine = bool(case.random.random() < 0.5)
        dent = Dent(0.0, at, width, length, cosine)
        return _on_either(case, lambda wall, a: replace(wall, dents=(replace(dent, depth_mm=sign * a),)))

    return weld


def _ring(case: _Case) -> Callable[[float], Weld]:
    between = min(case.uniform(8.0, 30.0), 0.25 * case.field_mm)
    width = case.cap.width_mm * case.uniform(0.8, 1.1)
    distance = 0.5 * (width + case.cap.width_mm) + between
    side, sign = case.sign(), case.sign()
    other = _aligned(case)
    second = SecondSeam(side * distance, width, case.cap.height_mm * case.uniform(0.8, 1.1), 0.0)
    return lambda a: case.weld(other=other, second=replace(second, ring_mm=sign * a))


def _coat(case: _Case) -> Callable[[float], Weld]:
    start = case.uniform(15.0, 30.0) - case.cap.width_mm / 2
    start = float(np.clip(start, 3.0, 0.2 * case.field_mm))
    # The coat hides the step: the other wall stands out by nearly as much.
    hidden, edge = case.uniform(0.8, 1.0), case.log(0.2, 2.0)

    def weld(a: float) -> Weld:
        other = replace(case.other, radius_difference_mm=case.other.radius_difference_mm + a)
        coat = Strip(hidden * a, start, math.inf, edge)
        return case.weld(other=other, reference=replace(case.reference, strips=(coat,)))

    return weld


def _tape(case: _Case) -> Callable[[float], Weld]:
    thickness = min(case.uniform(0.2, 1.0), 0.8 * case.limit)
    start = case.uniform(1.0, 6.0)
    tape = Strip(thickness, start, start + case.uniform(20.0, 80.0), case.log(0.1, 0.5))

    def weld(a: float) -> Weld:
        # The other wall lies deeper; the tape on it brings it up.
        other = replace(case.other, radius_difference_mm=case.other.radius_difference_mm - a, strips=(tape,))
        return case.weld(other=other)

    return weld


def _bump(case: _Case, at_rad: float, width_rad: float) -> Callable[[float], Weld]:
    """An arc of the whole wall that stands off."""
    other, sign = _aligned(case), case.sign()
    dent = Dent(0.0, at_rad, width_rad, math.inf)
    return lambda a: case.weld(other=replace(other, dents=(replace(dent, depth_mm=sign * a),)))


def _in_the_dark(case: _Case) -> Callable[[float], Weld]:
    at, width = case.inside(0.2), case.degrees(4.0, 8.0, 6.0)
    case.dark_rad = (at - width / 2, at + width / 2)
    return _bump(case, at, width / 2)


def _hardly_lit(case: _Case) -> Callable[[float], Weld]:
    arc = case.arc()
    lit = max(math.radians(float(case.random.choice([2.0, 4.0, 10.0]))), 4.0 / case.radius_mm)
    lit = min(lit, 0.4 * math.radians(BIN_DEG * len(arc)))
    start, end = math.radians(arc[0] - 1), math.radians(arc[-1] + 1)
    at = case.uniform(start + 0.1 * lit, end - 1.1 * lit)
    case.dark_rad = (at + lit, at + 2 * math.pi)
    # The step is in the longer dark part.
    before, after = at - start, end - at - lit
    middle = start + before / 2 if before > after else end - after / 2
    return _bump(case, middle, max(before, after) / 2)


def _growing(case: _Case) -> Callable[[float], Weld]:
    arc = case.arc()
    end = math.radians(arc[-1] if case.random.random() < 0.5 else arc[0])
    return _bump(case, end, math.radians(BIN_DEG * len(arc)) * case.uniform(0.4, 1.0))


def _oval(n: int, both: bool) -> Callable[[_Case], Callable[[float], Weld]]:
    def weld(case: _Case) -> Callable[[float], Weld]:
        at, turn = case.uniform(0.0, 2 * math.pi), case.uniform(0.6, 1.0) * math.pi / n
        other = _aligned(case)

        def made(a: float) -> Weld:
            reference = case.reference
            if both:
                wave = (*reference.ovality, Harmonic(n, 0.6 * a, at + turn))
                reference = replace(reference, ovality=wave)
            wave = (*other.ovality, Harmonic(n, a, at))
            return case.weld(other=replace(other, ovality=wave), reference=reference)

        return made

    return weld


def _deep_dent(case: _Case) -> Callable[[float], Weld]:
    # 8 mm over 3 degrees of a pipe of 630: no steeper than that elsewhere.
    width = max(math.radians(3.0), 16.0 / case.radius_mm)
    dent = Dent(0.0, case.inside(), width, math.inf, cosine=False)
    other = _aligned(case)
    return lambda a: case.weld(other=replace(other, dents=(replace(dent, depth_mm=a),)))


def _with_cap(
    make: Callable[[_Case], Callable[[float], Weld]], **cap: Any
) -> Callable[[_Case], Callable[[float], Weld]]:
    def weld(case: _Case) -> Callable[[float], Weld]:
        case.cap = replace(case.cap, **{k: v(case) if callable(v) else v for k, v in cap.items()})
        return make(case)

    return weld


def _spatter(case: _Case) -> Callable[[float], Weld]:
    arc, count = case.arc(), int(case.random.integers(5, 41))
    reach = 0.3 * case.field_mm
    drops = tuple(
        Spatter(math.radians(case.uniform(arc[0], arc[-1])), case.uniform(-reach, reach), case.uniform(0.3, 1.0))
        for _ in range(count)
    )
    return lambda a: case.weld(other=case.misfit(a), spatter=drops)


# What changes a case before its views are set up.


def _set(**values: Any) -> Callable[[_Case], None]:
    def change(case: _Case) -> None:
        for name, value in values.items():
            setattr(case, name, value(case) if callable(value) else value)

    return change


def _pipe_of(low_mm: float, high_mm: float, thickness: tuple[float, float] = (1.0, 60.0)) -> Callable[[_Case], None]:
    def change(case: _Case) -> None:
        case.diameter_mm = _diameter(case.log(low_mm, high_mm))
        case.thickness_mm = _thickness(case, *thickness)

    return change


def _both(*changes: Callable[[_Case], None]) -> Callable[[_Case], None]:
    def change(case: _Case) -> None:
        for one in changes:
            one(case)

    return change


def _girth(case: _Case) -> None:
    case.diameter_mm = _diameter(case.log(40.0, 300.0))
    case.thickness_mm = _thickness(case)
    case.whole = True


def _shrunk(case: _Case) -> None:
    """Both sides got the same heat: they shrank by nearly the same."""
    most = min(0.5, 0.1 * case.thickness_mm)
    first = case.uniform(min(0.1, most), most)
    case.reference = replace(case.reference, shrinkage_mm=first)
    case.other = replace(case.other, shrinkage_mm=first * case.uniform(0.8, 1.2))


def _out_of_round(case: _Case) -> None:
    """Two pipes of one lot: out of round by up to 0.3 % of the radius alike, and a little by themselves."""
    at = case.uniform(0.0, 2 * math.pi)
    common = Harmonic(2, case.uniform(0.0, 0.003) * case.radius_mm, at)
    own = [Harmonic(n, case.uniform(0.0, 0.1) * case.limit, case.uniform(0.0, 2 * math.pi)) for n in (2, 3, 4, 5)]
    case.reference = replace(case.reference, ovality=(common, own[0]))
    case.other = replace(case.other, ovality=(common, *own[1:]))


def _dark(case: _Case, scene: Scene) -> Scene:
    start, end = case.dark_rad
    return replace(scene, dark_deg=((math.degrees(start), math.degrees(end)),))


def _blinded(case: _Case, scene: Scene) -> Scene:
    return replace(scene, saturated=case.uniform(0.8, 0.93))


def _holed(case: _Case, scene: Scene) -> Scene:
    return replace(scene, holes=case.uniform(0.1, 0.5))


def _two_pipes(case: _Case, scene: Scene) -> Scene:
    good = replace(case.weld(other=case.misfit(case.uniform(0.0, 0.3) * case.limit)), seed=scene.welds[0].seed + 1)
    shown = tuple(replace(view, weld=i % 2) for i, view in enumerate(scene.views))
    return replace(scene, welds=(scene.welds[0], good), views=shown)


_THIN = _pipe_of(100.0, 1220.0, (1.5, 12.0))


def _usual_width(case: _Case) -> float:
    """The widest cap that the preparations of a butt weld give for this wall is about 8 + 1.75 t."""
    return 8.0 + 1.75 * case.thickness_mm


_TABLE = (
    # Honest, and nothing about them that should cost the verdict.
    Kind("plain", "two round pipes, moved and of other radius", "clean", _misfit),
    Kind("oval", "both pipes out of round", "clean", _misfit, _out_of_round),
    Kind("shrinkage", "both walls drawn in by the weld by 0.1 to 0.5 mm", "clean", _misfit, _shrunk),
    Kind(
        "leaning",
        "the scanner leans by 25 to 50 degrees",
        "clean",
        _misfit,
        _set(lean_deg=lambda c: c.uniform(25.0, 50.0)),
    ),
    Kind(
        "wide cap",
        "a wide cap on a thick wall",
        "clean",
        _misfit,
        _both(
            _pipe_of(150.0, 1220.0, (20.0, 60.0)),
            _set(width_mm=lambda c: min(c.uniform(0.8, 1.0) * _usual_width(c), 0.42 * c.field_mm)),
        ),
    ),
    Kind(
        "asymmetric",
        "the crown is nearer to one toe",
        "clean",
        _with_cap(_misfit, crown=lambda c: 0.5 + c.sign() * c.uniform(0.08, 0.25)),
    ),
    Kind(
        "ripple",
        "ripples of 0.1 to 0.3 mm on the cap",
        "clean",
        _with_cap(_misfit, ripple_mm=lambda c: c.uniform(0.1, 0.3), pitch_mm=lambda c: c.uniform(2.0, 6.0)),
    ),
    Kind("holes", "10 to 50 % of the pixels without a point, in patches", "clean", _misfit, finish=_holed),
    Kind(
        "misplaced seam",
        "the seam is not in the middle of the view, and wanders",
        "clean",
        _misfit,
        _set(
            seam_mm=lambda c: c.sign() * c.uniform(0.06, 0.18) * c.field_mm,
            seam_wander=lambda c: Wander(c.uniform(0.2, 1.0), c.uniform(40.0, 200.0)),
        ),
    ),
    Kind("small pipe", "25 to 60 mm across", "clean", _misfit, _pipe_of(25.0, 60.0)),
    # Honest, but with something that may cost it.
    Kind("spatter", "5 to 40 drops of 0.3 to 1 mm", "other-honest", _spatter),
    Kind(
        "flush",
        "ground flush, a uniform step",
        "other-honest",
        _with_cap(_misfit, height_mm=0.0, ripple_mm=0.0, crest=Wander(), width_mm=lambda c: c.uniform(2.0, 8.0)),
    ),
    Kind("small counterbore", "a counterbore 3 to 15 mm long", "other-honest", _counterbore(3.0, 15.0)),
    Kind("benign taper", "a wall machined by a taper of 1:20 to 1:4", "other-honest", _taper(None)),
    Kind(
        "very noisy",
        "point noise of 0.1 to 0.2 mm",
        "other-honest",
        _misfit,
        _set(noise_mm=lambda c: c.uniform(0.1, 0.2)),
    ),
    Kind(
        "undercut",
        "undercuts of 0.1 to 0.5 mm inside the toes",
        "other-honest",
        _with_cap(
            _misfit,
            undercut_mm=lambda c: tuple(min(c.uniform(0.1, 0.5), 0.1 * c.thickness_mm) for _ in range(2)),
            undercut_width_mm=lambda c: c.uniform(0.8, 2.0),
        ),
    ),
    Kind(
        "low cap",
        "a cap 0.2 to 0.6 mm high",
        "other-honest",
        _with_cap(_misfit, height_mm=lambda c: c.uniform(0.2, 0.6), crest=Wander(0.02, 15.0)),
    ),
    Kind(
        "flat cap",
        "an elliptic or flat cap",
        "other-honest",
        _with_cap(_misfit, power=lambda c: c.uniform(2.0, 6.0), blend=lambda c: c.uniform(0.5, 1.0)),
    ),
    Kind(
        "soft toes",
        "a cap that blends into the walls",
        "other-honest",
        _with_cap(_misfit, blend=lambda c: c.uniform(1.3, 2.0)),
    ),
    Kind(
        "underfilled",
        "a cap below its walls by up to a tenth of the thickness",
        "other-honest",
        _with_cap(
            _misfit, height_mm=lambda c: -c.uniform(0.2, 1.0) * min(1.0, 0.1 * c.thickness_mm), crest=Wander(0.02, 15.0)
        ),
    ),
    # A step over the limit.
    Kind("plain step", "two round pipes, moved too far", "defective", _misfit),
    Kind("taper 1:4", "a wall machined by a taper 1:4", "defective", _taper(0.25)),
    Kind("taper 1:10", "a wall machined by a taper 1:10", "defective", _taper(0.1)),
    Kind("taper 1:20", "a wall machined by a taper 1:20", "defective", _taper(0.05)),
    Kind("counterbore", "a wall machined by a counterbore 10 to 30 mm long", "defective", _counterbore(10.0, 30.0)),
    Kind(
        "flush taper",
        "a taper, the weld ground flush",
        "defective",
        _with_cap(_taper(None), height_mm=0.0, ripple_mm=0.0, crest=Wander(), width_mm=lambda c: c.uniform(2.0, 8.0)),
    ),
    Kind(
        "flush counterbore",
        "a counterbore, the weld ground flush",
        "defective",
        _with_cap(
            _counterbore(10.0, 30.0),
            height_mm=0.0,
            ripple_mm=0.0,
            crest=Wander(),
            width_mm=lambda c: c.uniform(2.0, 8.0),
        ),
    ),
    Kind("flare", "an end bent, decaying over 3 to 6 mm", "defective", _flare),
    Kind(
        "dent",
        "a dent at the seam, 2 to 10 degrees wide, decaying over 6 to 30 mm",
        "defective",
        _dent(2.0, 10.0, (6.0, 30.0)),
    ),
    Kind(
        "bulge",
        "a bulge at the seam, 2 to 10 degrees wide, decaying over 6 to 30 mm",
        "defective",
        _dent(2.0, 10.0, (6.0, 30.0), -1.0),
    ),
    Kind("long dent", "a narrow dent along the whole wall", "defective", _dent(1.5, 4.0, (math.inf, math.inf))),
    Kind(
        "deep dent",
        "a narrow dent 4 to 9 mm deep along the whole wall",
        "defective",
        _deep_dent,
        _both(
            _pipe_of(150.0, 1220.0, (1.5, 20.0)),
            _set(target=lambda c: (max(1.05, 4.0 / c.limit), max(1.1, 9.0 / c.limit))),
        ),
    ),
    Kind(
        "two seams",
        "two welds, a ring of 8 to 30 mm between them",
        "defective",
        _ring,
        _both(_THIN, _set(width_mm=lambda c: min(c.uniform(0.4, 0.7) * _usual_width(c), 0.15 * c.field_mm))),
    ),
    Kind("coat", "a coat on the reference wall up to 15 to 30 mm from the seam", "defective", _coat),
    Kind("tape", "tape on the other wall", "defective", _tape),
    Kind("dark arc", "4 to 8 degrees are dark, the step is only there", "defective", _in_the_dark, finish=_dark),
    Kind("hardly lit", "2, 4 or 10 degrees are lit, the step is elsewhere", "defective", _hardly_lit, finish=_dark),
    Kind("saturated", "80 to 93 % of the pixels are saturated", "defective", _misfit, finish=_blinded),
    Kind("two pipes", "shots of one arc of two pipes", "defective", _misfit, _set(shots=2, one_arc=True), _two_pipes),
    Kind("oval girth", "a whole girth, one wall out of round", "defective", _oval(2, both=False), _girth),
    Kind("two ovals", "both walls out of round, turned against each other", "defective", _oval(2, both=True)),
    Kind("growing", "the misfit grows along the arc", "defective", _growing),
    Kind("two humps", "a cap of two humps", "defective", _with_cap(_misfit, valley=lambda c: c.uniform(0.35, 0.8))),
    Kind(
        "too wide cap",
        "a cap wider than a weld of that wall can be",
        "defective",
        _misfit,
        _both(
            _pipe_of(150.0, 1220.0, (2.0, 20.0)),
            _set(width_mm=lambda c: min(1.25 * c.uniform(1.1, 1.5) * _usual_width(c), 0.55 * c.field_mm)),
        ),
    ),
)
KINDS: Mapping[str, Kind] = MappingProxyType({kind.name: kind for kind in _TABLE})
"""All kinds by name."""


# --- drawing one ------------------------------------------------------------------------------------------------------


def draw(kind: str, seed: int) -> Scene:
    """Return a scene of a kind: pipe, weld, views and noise drawn over the whole range of what is measured.

    The largest true step of an honest kind is below 0.8 of the limit, that of a defective one 1.05 to 3 times the limit
    (a deep dent's more). Noise and waves are such as a scanner and a pipe have whose limit it is: below a tenth of it.

    Args:
        kind: one of `KINDS`.
        seed: another seed is another scene.

    Raises:
        InputError: the kind is unknown.

    >>> scene = draw("dent", 3)
    >>> 1.05 <= truth(scene)["largest"] / scene.limit_mm <= 3.01
    True
    """
    if kind not in KINDS:
        raise InputError(f"kind: must be one of {', '.join(KINDS)}; got {kind!r}")
    made = KINDS[kind]
    random = np.random.default_rng([zlib.crc32(kind.encode()), seed])
    number = int(random.integers(0, 2**62))
    case = _Case(random, number, diameter_mm=0.0, thickness_mm=0.0, shots=int(random.choice([1, 2, 2, 2, 3, 4, 6])))
    _pipe_of(25.0, 1220.0)(case)
    case.whole = bool(random.random() < 0.12)
    # Nearer scanners are less noisy.
    case.noise_mm = case.log(0.005, 0.06) * max(0.5, case.field_mm / _FIELD_MM)
    case.noise_mm = min(case.noise_mm, 0.1 * case.limit)
    made.case(case)
    _cap_of(case)
    _waves_of(case)
    case.base = (case.uniform(0.0, 2 * math.pi), case.uniform(0.0, 1.0), case.sign())
    tilt = math.radians(case.uniform(0.0, 0.15))
    at = case.uniform(0.0, 2 * math.pi)
    case.other = replace(case.other, tilt_rad=(tilt * math.cos(at), tilt * math.sin(at)))
    base_from_weld = _set_up(case)
    weld = made.weld(case)
    low, high = case.target or ((0.05, HONEST) if made.group != "defective" else OVER)
    target = case.log(low, high) if made.group == "defective" else case.uniform(low, high)
    scene = Scene(
        kind,
        seed,
        (_solved(case, weld, target * case.limit, made.group),),
        case.views,
        case.field_mm,
        base_from_weld,
        case.noise_mm,
    )
    return made.finish(case, scene)


def _diameter(mm: float) -> float:
    return round(mm, 1)


def _thickness(case: _Case, low: float = 1.0, high: float = 60.0) -> float:
    """A wall not thinner than a 260th of the diameter (it would not stay round), nor thicker than a quarter."""
    thinnest = max(low, case.diameter_mm / 260.0)
    return round(case.log(thinnest, max(thinnest, min(high, case.diameter_mm / 4.0))), 1)


def _cap_of(case: _Case) -> None:
    width = case.width_mm or min(case.uniform(0.45, 0.95) * _usual_width(case), 0.35 * case.field_mm)
    height = case.height_mm or min(case.uniform(0.6, 1.1) * min(1.2 + 0.06 * case.thickness_mm, 4.0), 0.2 * width)
    case.cap = Cap(
        width,
        height,
        power=case.uniform(1.9, 2.6),
        ripple_mm=case.uniform(0.0, 0.05),
        pitch_mm=case.uniform(2.0, 5.0),
        toes=Wander(min(case.uniform(0.05, 0.4), 0.03 * width), case.uniform(6.0, 25.0)),
        crest=Wander(case.uniform(0.01, 0.06) * height, case.uniform(6.0, 25.0)),
    )


def _waves_of(case: _Case) -> None:
    """Each wall's own unevenness: 0.002 to 0.05 mm, of one scale or two."""

    def waves() -> tuple[Unevenness, ...]:
        sd = min(case.log(0.002, 0.05), 0.05 * case.limit)
        first = Unevenness(sd, case.log(8.0, 60.0), case.log(8.0, 150.0))
        if case.random.random() < 0.6:
            return (first,)
        return first, Unevenness(0.4 * sd, case.log(5.0, 12.0), case.log(5.0, 20.0))

    case.reference = replace(case.reference, unevenness=waves())
    case.other = replace(case.other, unevenness=waves())


def _set_up(case: _Case) -> Matrix:
    """Places the views; returns where the weld is in base."""
    scanner, distance = scanner_for(case.field_mm), distance_for(case.field_mm)
    bare, flip = case.weld(), case.sign()

    def pose(at_deg: float, aside_deg: float, along_deg: float) -> Floats:
        at, aside, along = (math.radians(a) for a in (at_deg, aside_deg, along_deg))
        outward = np.array([math.cos(at), math.sin(at), 0.0])
        around = np.array([-math.sin(at), math.cos(at), 0.0])
        axis = np.array([0.0, 0.0, 1.0])
        back = math.cos(along) * (math.cos(aside) * outward + math.sin(aside) * around) + math.sin(along) * axis
        x = flip * (axis - back * back[2])
        x /= np.linalg.norm(x)
        roll = math.radians(case.uniform(-1.5, 1.5))
        y = np.cross(-back, x)
        turned = np.eye(4)
        turned[:3, :3] = np.column_stack(
            [math.cos(roll) * x + math.sin(roll) * y, math.cos(roll) * y - math.sin(roll) * x, -back]
        )
        turned[:3, 3] = case.radius_mm * outward + back * distance * case.uniform(0.97, 1.03)
        return turned

    def lean() -> tuple[float, float]:
        if case.lean_deg < 10.0:
            return case.uniform(-1, 1) * case.lean_deg, case.uniform(-1, 1) * case.lean_deg
        way = case.uniform(0.0, 2 * math.pi)
        aside, along = case.lean_deg * math.cos(way), case.lean_deg * math.sin(way)
        # Towards the projector's side its light would graze: it stands 20 degrees further out.
        return aside, flip * min(flip * along, 35.0) if flip * along > 0 else along

    def named(index: int, there: Floats) -> View:
        return View(f"part-{index + 1}", _matrix(there), _matrix(there))

    def seen(poses: Sequence[Floats]) -> list[int]:
        return _bins([named(i, p) for i, p in enumerate(poses)], bare, scanner)

    start = case.uniform(0.0, 360.0)
    leans = lean()
    arc = BIN_DEG * len(seen([pose(start, *leans)]))
    around = math.ceil(360.0 / (0.85 * arc)) if arc else 99
    if case.whole and around <= 12:
        places = [start + 360.0 * i / around for i in range(around)]
    else:
        spacing = 0.0 if case.one_arc else arc * case.uniform(0.5, 0.85)
        count = min(case.shots, around)
        places = [start + spacing * i + case.uniform(-1, 1) * min(2.0, 0.05 * arc) for i in range(count)]
    leans = leans if case.lean_deg >= 10.0 else (0.0, 0.0)
    poses = [pose(at, *(leans if case.lean_deg >= 10.0 else lean())) for at in places]
    case.bins = seen(poses)
    if not case.bins:
        raise InputError(f"scene: no view of a pipe of {case.diameter_mm} mm sees its seam")
    # The scanner works about 900 mm before the robot and 600 mm up; the pipe lies level, any way round.
    yaw = case.uniform(0.0, 2 * math.pi)
    c, s = math.cos(yaw), math.sin(yaw)
    base = np.eye(4)
    base[:3, :3] = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ np.array(
        [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    )
    middle = np.mean([p[:3, 3] for p in poses], axis=0)
    base[:3, 3] = np.array([900.0, 0.0, 600.0]) - base[:3, :3] @ middle
    views_made = []
    for i, true in enumerate(poses):
        stated = base @ true
        turn, _ = cv2.Rodrigues(case.random.normal(0.0, math.radians(0.005), 3))
        stated[:3, :3] = stated[:3, :3] @ turn
        stated[:3, 3] += case.random.normal(0.0, 0.03, 3)
        views_made.append(replace(named(i, true), base_from_flange=_matrix(stated)))
    case.views = tuple(views_made)
    return _matrix(base)


def _matrix(pose: Floats) -> Matrix:
    return tuple(tuple(float(v) for v in row) for row in pose)


def _solved(case: _Case, make: Callable[[float], Weld], target_mm: float, group: Group) -> Weld:
    """Return the weld of the amplitude whose largest step in the arc seen is the target (honest: not above it)."""
    angles = _places(case.bins, case.radius_mm).ravel()

    def both(weld: Weld) -> Floats:
        edges = surface_of(weld).edges(angles)
        return np.array([edges[:, 3] - edges[:, 2], edges[:, 5]])

    def smooth(weld: Weld) -> Weld:
        return replace(weld, reference=replace(weld.reference, unevenness=()), other=replace(weld.other, unevenness=()))

    # The waves do not depend on the amplitude: they are drawn once.
    uneven = both(make(case.limit)) - both(smooth(make(case.limit)))

    def largest(amplitude: float) -> float:
        return float(np.abs(both(smooth(make(amplitude))) + uneven).max())

    low, high = 0.0, case.limit
    if largest(0.0) >= target_mm:
        if group == "defective" or largest(0.0) <= HONEST * case.limit:
            return make(0.0)
        raise InputError(f"scene: its waves alone make a step of {largest(0.0):.3f} mm")
    while largest(high) < target_mm:
        low, high = high, 2 * high
        if high > 100 * case.limit:
            raise InputError(f"scene: no amplitude makes a step of {target_mm:.3f} mm")
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if largest(middle) < target_mm else (low, middle)
    return make(high if group == "defective" else low)
