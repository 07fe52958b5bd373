"""A scene of a kind, drawn: pipe, weld, views, and the amplitude that gives the step that was drawn."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np

from weldscan.errors import InputError
from weldscan.simulated.scenes.case import Case, pipe_of, usual_width
from weldscan.simulated.scenes.kinds import KINDS, Group
from weldscan.simulated.scenes.scene import FIELD_MM, Scene, View, distance_for, scanner_for
from weldscan.simulated.scenes.seen_arc import BIN_DEG, angles_of, bins_of
from weldscan.simulated.scenes.truth import HONEST, OVER
from weldscan.simulated.scenes.welds import Cap, Floats, Matrix, SceneWeld, Wander, Waviness, surface_of


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
    case = Case(random, number, diameter_mm=0.0, thickness_mm=0.0, shots=int(random.choice([1, 2, 2, 2, 3, 4, 6])))
    pipe_of(25.0, 1220.0)(case)
    case.whole = bool(random.random() < 0.12)
    # Nearer scanners are less noisy.
    case.noise_mm = case.log(0.005, 0.06) * max(0.5, case.field_mm / FIELD_MM)
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


def _cap_of(case: Case) -> None:
    width = case.width_mm or min(case.uniform(0.45, 0.95) * usual_width(case), 0.35 * case.field_mm)
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


def _waves_of(case: Case) -> None:
    """Each wall's own unevenness: 0.002 to 0.05 mm, of one scale or two."""

    def waves() -> tuple[Waviness, ...]:
        sd = min(case.log(0.002, 0.05), 0.05 * case.limit)
        first = Waviness(sd, case.log(8.0, 60.0), case.log(8.0, 150.0))
        if case.random.random() < 0.6:
            return (first,)
        return first, Waviness(0.4 * sd, case.log(5.0, 12.0), case.log(5.0, 20.0))

    case.reference = replace(case.reference, unevenness=waves())
    case.other = replace(case.other, unevenness=waves())


def _set_up(case: Case) -> Matrix:
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
        return bins_of([named(i, p) for i, p in enumerate(poses)], bare, scanner)

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


def _solved(case: Case, make: Callable[[float], SceneWeld], target_mm: float, group: Group) -> SceneWeld:
    """Return the weld of the amplitude whose largest step in the arc seen is the target (honest: not above it)."""
    angles = angles_of(case.bins, case.radius_mm).ravel()

    def both(weld: SceneWeld) -> Floats:
        edges = surface_of(weld).edges(angles)
        return np.array([edges[:, 3] - edges[:, 2], edges[:, 5]])

    def smooth(weld: SceneWeld) -> SceneWeld:
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
