"""The simulated cell rendered into a session folder. The truth is returned and written beside it as `truth.json`."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from weldscan._weldcore import Lens, SimulatedShot, simulate_shot, simulated_step
from weldscan.errors import InputError
from weldscan.geometry import rotation_of
from weldscan.pose import KukaPose
from weldscan.records.images import Frames
from weldscan.records.session import Session, write_session
from weldscan.simulated.cell import DEFAULT, Cell
from weldscan.simulated.placing import Floats, moved

Progress: TypeAlias = Callable[[int, int, str], None]
"""Called with shots done, shots in all, and what is being done."""


Target: TypeAlias = Literal["artefact", "part", "plane"]
"""What a shot is of."""


# Profile bins as in `weldscan-result/2`: 2 degrees, centred on even degrees.
BIN_DEG = 2


BIN_MM = 0.005
"""Bins of the histogram whose highest one is the mode."""


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
            turn = rotation_of(random.normal(0.0, math.radians(cell.pose_noise_deg), 3))
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
    if math.isinf(cell.weld.reference.radius_mm):
        raise InputError("weld: a plate cannot be measured yet, so no session of one is written; render() shows it")
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
                    surface.append(moved(shot.base_from_scanner, some))
            whites[shot.name] = rendered.white
            yield shot.name, rendered.frames
        deviations, alongs = ([pair[i] for pair in pooled] or [np.zeros(0)] for i in (0, 1))
        step = _step_of(cell, np.concatenate(deviations), np.concatenate(alongs))
        truth["step_mm"] = step
        if surface and cell.robot is not None and cell.touched_points:
            probed = np.concatenate(surface)[: cell.touched_points]
            probed += random.normal(0.0, cell.probe_noise_mm, probed.shape)
            extra["touch.csv"] = "x_mm,y_mm,z_mm\n" + "".join(f"{x:.4f},{y:.4f},{z:.4f}\n" for x, y, z in probed)
        extra["truth.json"] = json.dumps(truth, indent=1)

    write_session(folder, session, frames(), whites=whites, extra=extra)
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
