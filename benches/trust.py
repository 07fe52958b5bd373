"""Does a PASS hold? Scenes of every kind of `weldscan.simulated.scenes`, inspected; the verdicts by kind as a table.

    python benches/trust.py --runs 30 --markdown docs/trust.md      # all kinds, 30 seeds each
    python benches/trust.py --kinds plain,taper --runs 10 --first 1000 --list

A wrong PASS is a PASS of a seam whose true step is above the limit; a lost verdict is an honest seam (true step at most
0.8 of the limit) without a PASS. Clouds go in where images would, with the scene's noise; `--images` records sessions.
"""

from __future__ import annotations

import argparse
import collections
import json
import multiprocessing
import sys
import tempfile
import time
from datetime import date
from pathlib import Path

import numpy as np


def _one(job: tuple[str, int, bool]) -> dict:
    import weldscan
    from weldscan.errors import WeldscanError
    from weldscan.measure.inspection import inspect
    from weldscan.measure.journal import Journal, ShotReading
    from weldscan.measure.session_points import MASKS, PointReader, Scan
    from weldscan.simulated import scenes

    weldscan.set_threads(1)
    kind, seed, images = job
    row = {"kind": kind, "seed": seed}
    try:
        scene = scenes.draw(kind, seed)
        truth = scenes.truth(scene)
    except WeldscanError as error:
        return row | {"verdict": "NOT DRAWN", "why": str(error)}

    class FromScene(PointReader):
        """Gives the scene's clouds."""

        def __call__(self, shot, done=0):
            if not hasattr(self, "clouds"):
                self.clouds = {each.name: each for each in scenes.views(scene)}
            seen = self.clouds[shot.name]
            counts = np.bincount(seen.reason.ravel(), minlength=len(MASKS))
            reading = ShotReading(shot.name, dict(zip(MASKS, counts.tolist(), strict=True)), shot.name)
            return Scan(seen.points_mm, None, seen.reason, reading, Journal(shots=(reading,)))

    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        if images:
            scenes.record(scene, Path(folder) / "s")
            found = inspect(Path(folder) / "s")
        else:
            (Path(folder) / "session.json").write_text(json.dumps(scenes.session_document(scene)))
            found = inspect(folder, reader=FromScene)
    weld = scene.welds[0]
    step = found.step
    return row | {
        "verdict": str(found.verdict),
        "over": truth["largest"] > truth["limit_mm"],
        "true": truth["largest"],
        "limit": truth["limit_mm"],
        "value": None if step is None else step.max_abs_mm,
        "u": None if step is None else step.expanded_uncertainty_mm,
        "judged": "" if step is None else step.judged,
        "bars": [(bar.code, bar.text) for bar in found.bars],
        "left_out": found.left_out,
        "size": f"{2 * weld.radius_mm:.0f}x{weld.thickness_mm:g}, {len(scene.views)} shots, noise {scene.noise_mm:.3f}",
        "seconds": time.perf_counter() - began,
    }


def _guarded(job: tuple[str, int, bool]) -> dict:
    try:
        return _one(job)
    except Exception as error:
        return {"kind": job[0], "seed": job[1], "verdict": "ERROR", "why": f"{type(error).__name__}: {error}"}


def main() -> int:
    """Run the campaign; exit code 1 where anything passed that must not, or ended in an error."""
    from weldscan.simulated import scenes

    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--runs", type=int, default=10, help="seeds per kind")
    options.add_argument("--first", type=int, default=0, help="first seed")
    options.add_argument("--kinds", help="comma-separated; default: all")
    options.add_argument("--images", action="store_true", help="through fringe images instead of clouds")
    options.add_argument("--list", action="store_true", help="a line per run")
    options.add_argument("--markdown", type=Path, help="write the table as a page")
    options.add_argument("--jobs", type=int, default=multiprocessing.cpu_count())
    asked = options.parse_args()
    kinds = asked.kinds.split(",") if asked.kinds else list(scenes.KINDS)
    if unknown := [kind for kind in kinds if kind not in scenes.KINDS]:
        options.error(f"no such kind: {', '.join(unknown)}; there are {', '.join(scenes.KINDS)}")
    jobs = [(kind, asked.first + k, asked.images) for k in range(asked.runs) for kind in kinds]
    rows = []
    with multiprocessing.get_context("spawn").Pool(asked.jobs, maxtasksperchild=50) as pool:
        for row in pool.imap_unordered(_guarded, jobs):
            rows.append(row)
            if asked.list:
                print(_line(row), flush=True)
    table = _table(rows, kinds)
    print(table)
    wrong = [row for row in rows if row["verdict"] == "PASS" and row.get("over")]
    errors = [row for row in rows if row["verdict"] == "ERROR"]
    for row in [*wrong, *errors]:
        print(_line(row))
    if asked.markdown:
        asked.markdown.write_text(_page(table, rows, asked))
    return int(bool(wrong or errors))


def _line(row: dict) -> str:
    if "true" not in row:
        return f"{row['kind']:22} {row['seed']:5} {row['verdict']}: {row.get('why')}"
    wrong = " <<< WRONG" if row["verdict"] == "PASS" and row["over"] else ""
    value = "-" if row["value"] is None else f"{row['value']:.3f}+-{row['u']:.3f} {row['judged']}"
    why = "; ".join(f"{code}: {text[:110]}" for code, text in row["bars"][:3])
    if row["value"] is None:
        why = "; ".join(f"{shot}: {reason[:90]}" for shot, reason in row["left_out"][:2])
    return (
        f"{row['kind']:22} {row['seed']:5} {row['verdict']:12} true {row['true']:.3f} of {row['limit']:.2f} "
        f"got {value} [{row['size']}] {row['seconds']:.1f}s {why}{wrong}"
    )


def _table(rows: list[dict], kinds: list[str]) -> str:
    from weldscan.simulated import scenes

    out = ["| kind | group | runs | true above limit | wrong PASS | FAIL | INCONCLUSIVE | NOT MEASURED | honest kept |"]
    out.append("|---|---|---|---|---|---|---|---|---|")
    totals = collections.defaultdict(lambda: [0, 0])
    for kind in kinds:
        mine = [row for row in rows if row["kind"] == kind]
        said = collections.Counter(row["verdict"] for row in mine)
        over = [row for row in mine if row.get("over")]
        honest = [row for row in mine if "over" in row and not row["over"]]
        kept = sum(row["verdict"] == "PASS" for row in honest)
        wrong = sum(row["verdict"] == "PASS" for row in over)
        group = scenes.KINDS[kind].group
        totals[group][0] += len(honest) - kept
        totals[group][1] += len(honest)
        share = f"{kept} of {len(honest)}" if honest else ""
        cells = [said[v] for v in ("FAIL", "INCONCLUSIVE", "NOT MEASURED")]
        out.append(
            f"| {kind} | {group} | {len(mine)} | {len(over)} | {wrong} | {' | '.join(map(str, cells))} | {share} |"
        )
    for group, (lost, of) in totals.items():
        if of:
            out.append(
                f"\nHonest scenes of the {group} kinds without a PASS: {lost} of {of} ({100 * lost / of:.1f} %)."
            )
    over = [row for row in rows if row.get("over")]
    out.append(
        f"\nTrue step above the limit: {len(over)} runs, wrong PASS {sum(r['verdict'] == 'PASS' for r in over)}."
    )
    return "\n".join(out)


def _page(table: str, rows: list[dict], asked: argparse.Namespace) -> str:
    from weldscan import __version__

    how = "fringe images" if asked.images else "clouds"
    return (
        "# Does a PASS hold?\n\n"
        f"`python benches/trust.py --runs {asked.runs} --first {asked.first}`: {len(rows)} scenes as {how}, weldscan "
        f"{__version__}, {date.today()}. What a kind is: [the simulated cell](simulator.md). A wrong PASS is one of a "
        "seam whose true step, between the surfaces at the toes, is above the limit of PNAE G-7-010-89; honest seams "
        "have at most 0.8 of it.\n\n"
        f"{table}\n"
    )


if __name__ == "__main__":
    sys.exit(main())
