"""Error of a working point by hand-eye method, number of shots and noise, against the Cramer-Rao limit.

    python benches/hand_eye.py --draws 300 --into docs/hand-eye.md

draws calibrations with known truth, solves each with weldscan, with the closed form of all shots stacked (Kabsch, Horn)
and with every method of cv2.calibrateHandEye, and prints the table, or puts it between the marks of a page. All methods
get the same numbers. Where OpenCV wants the pose of a board, it gets that of the three centres.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from weldscan import register_rigid, solve_hand_eye
from weldscan.calibration.artefact import PlateView
from weldscan.calibration.hand_eye import point_covariance
from weldscan.calibration.hand_eye_model import FACTORS, Linear, Noise
from weldscan.geometry import skew
from weldscan.simulated import DEFAULT, placed, tilted_views

TRUE = np.asarray(DEFAULT.flange_from_scanner)
CENTRES = DEFAULT.sphere_centres()
WORKING_POINT_MM = np.array([0.0, 0.0, 420.0])
OPENCV = {name: getattr(cv2, f"CALIB_HAND_EYE_{name}") for name in ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")}
METHODS = ("weldscan", "Kabsch", *OPENCV)
BEGIN, END = "<!-- benches/hand_eye.py -->", "<!-- end -->"


@dataclass(frozen=True)
class Level:
    """What errors are like, k = 1."""

    name: str
    sphere_mm: float
    noise: Noise
    stated: bool = False
    """Whether weldscan is told of the probe; nothing else is ever told but the spheres' covariances."""


LEVELS = (
    Level("good", 0.003, Noise(0.01, math.radians(0.003), 0.01, 0.005)),
    Level("usual", 0.006, Noise(0.03, math.radians(0.005), 0.02, 0.01)),
    Level("poor", 0.015, Noise(0.05, math.radians(0.01), 0.03, 0.02)),
    Level("bad probe, stated", 0.006, Noise(0.03, math.radians(0.005), 0.05, 0.15), stated=True),
    Level("bad probe, not stated", 0.006, Noise(0.03, math.radians(0.005), 0.05, 0.15)),
)
SHOTS = (3, 5, 10, 15)


@dataclass(frozen=True, eq=False)
class Draw:
    """One simulated calibration."""

    views: list[PlateView]
    base_from_flange: list[np.ndarray]
    touched_mm: np.ndarray


def exact(shots: int, sphere_mm: float) -> Draw:
    """Shots without errors: tilted by 30 to 45 degrees to all sides, rolled, near and far."""
    target = np.asarray(DEFAULT.base_from_plate) @ placed(np.mean(DEFAULT.spheres_mm, axis=0))
    views, poses = [], []
    for i, base_from_scanner in enumerate(tilted_views(target, shots)):
        into = np.linalg.inv(base_from_scanner)
        centres = CENTRES @ into[:3, :3].T + into[:3, 3]
        covariances = np.tile(np.eye(3) * sphere_mm**2, (3, 1, 1))
        views.append(PlateView(f"artefact-{i + 1}", centres, covariances, (sphere_mm,) * 3, (9000,) * 3))
        poses.append(base_from_scanner @ np.linalg.inv(TRUE))
    return Draw(views, poses, CENTRES)


def drawn(shots: int, level: Level, random: np.random.Generator) -> Draw:
    """Shots with errors."""
    clean, noise = exact(shots, level.sphere_mm), level.noise
    return Draw(
        [replace(v, centres_mm=v.centres_mm + random.normal(0, level.sphere_mm, (3, 3))) for v in clean.views],
        [
            pose @ placed(random.normal(0, noise.pose_mm, 3), random.normal(0, noise.pose_rad, 3))
            for pose in clean.base_from_flange
        ],
        CENTRES + random.normal(0, noise.touch_mm, (3, 3)) + random.normal(0, noise.touch_bias_mm, 3),
    )


def kabsch(draw: Draw) -> np.ndarray:
    """flange_from_scanner from all centres stacked, each as good as any other."""
    seen = np.concatenate([view.centres_mm for view in draw.views])
    flange_from_base = [np.linalg.inv(pose) for pose in draw.base_from_flange]
    expected = np.concatenate([draw.touched_mm @ f[:3, :3].T + f[:3, 3] for f in flange_from_base])
    return np.asarray(register_rigid(seen, expected).target_from_source)


def opencv(draw: Draw, method: int, touched: bool) -> np.ndarray:
    """flange_from_scanner by cv2.calibrateHandEye from the plate's poses; its shape as touched, or as first seen."""
    plate = draw.touched_mm if touched else draw.views[0].centres_mm
    plate = plate - plate.mean(axis=0)
    poses = [register_rigid(plate, view.centres_mm).target_from_source for view in draw.views]
    turn, shift = cv2.calibrateHandEye(
        [pose[:3, :3] for pose in draw.base_from_flange],
        [pose[:3, 3] for pose in draw.base_from_flange],
        [pose[:3, :3] for pose in poses],
        [pose[:3, 3] for pose in poses],
        method=method,
    )
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = turn, shift.ravel()
    return found


def limit_mm(shots: int, level: Level, touched: bool) -> float:
    """Cramer-Rao: the least rms error of the working point that any unbiased method can have, the noise being known."""
    clean = exact(shots, level.sphere_mm)
    linear = Linear(
        TRUE,
        CENTRES,
        np.array([np.linalg.inv(pose) for pose in clean.base_from_flange]),
        np.array([view.centres_mm for view in clean.views]),
        np.array([view.covariances_mm2 for view in clean.views]),
        CENTRES if touched else None,
        level.noise,
    )
    covariance = linear.solve(np.ones((1, FACTORS)))[1][0][:6, :6]
    jacobian = np.hstack([-TRUE[:3, :3] @ skew(WORKING_POINT_MM), np.eye(3)])
    return math.sqrt(np.trace(jacobian @ covariance @ jacobian.T))


def errors_mm(shots: int, level: Level, touched: bool, draws: int, seed: int = 1) -> tuple[dict[str, float], float]:
    """Rms error of the working point by method, and how often it is in weldscan's 95 % interval, axis by axis."""
    random = np.random.default_rng(seed)
    squares: dict[str, list[float]] = {name: [] for name in METHODS}
    inside = []
    noise = level.noise
    probe = {"touch_sigma_mm": noise.touch_mm, "touch_bias_sigma_mm": noise.touch_bias_mm} if level.stated else {}

    def note(name: str, found: np.ndarray) -> np.ndarray:
        off = ((found - TRUE) @ [*WORKING_POINT_MM, 1.0])[:3]
        squares[name].append(float(off @ off))
        return np.asarray(off)

    for _ in range(draws):
        draw = drawn(shots, level, random)
        touched_mm = draw.touched_mm if touched else None
        found = solve_hand_eye(draw.views, draw.base_from_flange, touched_mm, **probe)
        off = note("weldscan", found.flange_from_scanner)
        inside.append(np.abs(off) < 1.96 * np.sqrt(np.diag(point_covariance(found, WORKING_POINT_MM))))
        if touched:
            note("Kabsch", kabsch(draw))
        for name, method in OPENCV.items():
            note(name, opencv(draw, method, touched))
    rms = {name: math.sqrt(float(np.mean(values))) if values else math.nan for name, values in squares.items()}
    return rms, float(np.mean(inside))


def table(draws: int, levels: Sequence[Level] = LEVELS, counts: Sequence[int] = SHOTS) -> str:
    """The table in Markdown."""
    head = ("centres", "noise", "shots", "limit", *METHODS, "in 95 %")
    rows = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for touched in (True, False):
        for level in levels:
            for shots in counts:
                if not touched and (shots < 5 or level.name.startswith("bad")):
                    continue
                rms, inside = errors_mm(shots, level, touched, draws)
                shown = {name: f"{value:.3f}" for name, value in rms.items() if math.isfinite(value)}
                best = min(shown.values())
                cells = [f"**{v}**" if v == best else v for v in (shown.get(name, "–") for name in METHODS)]
                limit = limit_mm(shots, level, touched)
                name = "touched" if touched else "unknown"
                rows.append(f"| {name} | {level.name} | {shots} | {limit:.3f} | {' | '.join(cells)} | {inside:.3f} |")
                print(rows[-1], flush=True)
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=100, help="calibrations per row")
    parser.add_argument("--level", action="append", help="only these levels of noise, by name")
    parser.add_argument("--into", type=Path, help="the page whose table is replaced")
    given = parser.parse_args()
    text = table(given.draws, [level for level in LEVELS if not given.level or level.name in given.level])
    if given.into is not None:
        page = given.into.read_text(encoding="utf-8")
        before, rest = page.split(BEGIN, 1)
        after = rest.split(END, 1)[1]
        given.into.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
