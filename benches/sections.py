"""Are toes and edge steps right, and is their U? Scenes of `weldscan.simulated.scenes`, segmented shot by shot and held
against the surfaces themselves.

    python benches/sections.py --runs 10                            # clean kinds, 10 seeds each
    python benches/sections.py --kinds "taper 1:4,undercut" --runs 5 --first 100

Per kind, over the stations that were read: rms and mean of the error of a toe; rms of the error of the edge step, its
median U, and how often the truth lies within U.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections import defaultdict

import numpy as np

COLUMNS = "| kind | stations | toe rms | toe mean | within 3 s | edge rms | edge median U | covered |"


def errors_of(job: tuple[str, int]) -> tuple[str, np.ndarray]:
    """One row a station: error of both toes over their standard uncertainty, error of the edge step and its U, mm."""
    import weldscan
    from weldscan.errors import WeldscanError
    from weldscan.simulated import scenes

    weldscan.set_threads(1)
    kind, seed = job
    scene, rows = scenes.draw(kind, seed), []
    base = np.asarray(scene.base_from_weld)
    for seen, view in zip(scenes.views(scene), scene.views, strict=True):
        weld, turn = scene.welds[view.weld], seen.base_from_flange[:3, :3].T
        axes = (turn @ base[:3, 2]).tolist(), (turn @ base[:3, 0]).tolist()
        try:
            shot = weldscan.segment_weld(seen.points_mm, weld.radius_mm, weld.thickness_mm, *axes)
        except WeldscanError:
            continue
        found = shot.sections
        read = np.flatnonzero(np.isfinite(found["edge_step_mm"]))
        at = np.array([shot.seam.course.at(float(a)) for a in found["along"][read]])
        weld_from_scanner = np.linalg.inv(base) @ seen.base_from_flange
        toes = []
        for side in (0, 1):
            points = shot.seam.points(at, np.ascontiguousarray(found["toes_mm"][read, side]))
            placed = points @ weld_from_scanner[:3, :3].T + weld_from_scanner[:3, 3]
            toes.append(placed[:, 2])
        angle = np.degrees(np.arctan2(placed[:, 1], placed[:, 0]))
        true = scenes.toes(scene, angle, view.weld)
        off = [toes[0] - true["reference_mm"], toes[1] - true["other_mm"]]
        standard = found["toes_standard_mm"][read]
        u = 2 * found["edge_standard_mm"][read] + found["edge_hull_mm"][read]
        step = found["edge_step_mm"][read] - true["step_mm"]
        rows.append(np.column_stack([*off, standard, step, u]))
    return kind, np.concatenate(rows) if rows else np.zeros((0, 6))


def main() -> None:
    from weldscan.simulated.scenes import KINDS

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5, help="seeds per kind")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    clean = [name for name, kind in KINDS.items() if kind.group == "clean"]
    parser.add_argument("--kinds", default=",".join(clean), help="comma-separated; default: the clean ones")
    parser.add_argument("--jobs", type=int, default=2)
    asked = parser.parse_args()
    jobs = [(kind, asked.first + i) for kind in asked.kinds.split(",") for i in range(asked.runs)]
    found = defaultdict(list)
    with multiprocessing.get_context("spawn").Pool(asked.jobs) as pool:
        for kind, rows in pool.imap_unordered(errors_of, jobs):
            found[kind].append(rows)
    print(COLUMNS, "|".join(["", *["---"] * 8, ""]), sep="\n")
    for kind, parts in [*found.items(), ("all", [rows for each in found.values() for rows in each])]:
        rows = np.concatenate(parts)
        if not len(rows):
            print(f"| {kind} | 0 |" + " |" * 6)
            continue
        toes, standard, step, u = rows[:, :2], rows[:, 2:4], rows[:, 4], rows[:, 5]
        rms, covered = np.sqrt((toes**2).mean()), (np.abs(toes) <= 3 * standard).mean()
        edge = f"{np.sqrt((step**2).mean()):.3f} | {np.median(u):.3f} | {(np.abs(step) <= u).mean():.3f}"
        print(f"| {kind} | {len(rows)} | {rms:.3f} | {toes.mean():+.3f} | {covered:.3f} | {edge} |")


if __name__ == "__main__":
    main()
