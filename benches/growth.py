"""How each algorithm grows with its input, from 1e4 to 1e7 points: writes docs/growth.svg and the table in
docs/benchmarks.md, between its markers.

    python benches/growth.py [--largest 1e7] [--seconds 180] [--dry]

Each size runs three times, or once where a run is long; the least time counts. What would not end within the seconds
that are left is left out and said so. Memory is what the process's resident set grows by (`/proc/self/statm`) while the
largest tree is built and kept, beyond the points themselves. Nothing but weldscan and NumPy is needed.
"""

from __future__ import annotations

import argparse
import math
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import weldscan as ws

ROOT = Path(__file__).resolve().parents[1]
PAGE, PLOT = ROOT / "docs" / "benchmarks.md", ROOT / "docs" / "growth.svg"
SIZES = [10**4, 10**5, 10**6, 10**7]
REPEATS = 3
LONG_S = 0.5
"""A run of this length is not repeated."""

Run = Callable[[], Any]


def surface(n: int, seed: int = 1) -> np.ndarray:
    """Points of a relief at one density, whatever their number."""
    x, y = np.random.default_rng(seed).random((2, n)) * 0.2 * math.sqrt(n)
    return np.c_[x, y, 6 * np.sin(x / 19) + 5 * np.cos(y / 27)]


def slopes(points: np.ndarray) -> np.ndarray:
    """The unit normals of `surface`."""
    n = np.c_[-6 / 19 * np.cos(points[:, 0] / 19), 5 / 27 * np.sin(points[:, 1] / 27), np.ones(len(points))]
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def on_a_ball(n: int) -> np.ndarray:
    d = np.random.default_rng(2).normal(size=(n, 3))
    return 15 * d / np.linalg.norm(d, axis=1, keepdims=True) + np.random.default_rng(3).normal(size=(n, 3)) * 0.02


def on_a_pipe(n: int) -> np.ndarray:
    rng = np.random.default_rng(4)
    angle, radius = rng.random(n) * 2, 315 + rng.normal(size=n) * 0.02
    return np.c_[radius * np.cos(angle), radius * np.sin(angle), rng.random(n) * 150]


def image_of(n: int) -> tuple[int, int]:
    """A 4:3 image of some n pixels."""
    height = round(math.sqrt(n * 3 / 4))
    return height, round(n / height)


def fringe_images(n: int) -> tuple[list[np.ndarray], list[tuple[int, int]], int]:
    height, width = image_of(n)
    column = np.arange(width) + 0.02 * np.arange(height)[:, None]
    rng = np.random.default_rng(5)
    fringes = [(1, 4), (8, 4), (64, 4)]
    images = []
    for periods, steps in fringes:
        for i in range(steps):
            wave = 120 + 90 * np.cos(2 * np.pi * (periods * (column + 0.5) / width - i / steps))
            images.append((wave + rng.normal(size=column.shape)).clip(0, 255).astype(np.uint8))
    return images, fringes, width


def scanner_of(n: int) -> ws.Scanner:
    height, width = image_of(n)
    f = 2.0 * width
    k = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(0.3), 0, np.sin(0.3)], [0, 1, 0], [-np.sin(0.3), 0, np.cos(0.3)]]
    pose[:3, 3] = [-130, 0, 20]
    lens = ws.Lens(width, height, k, [-0.1, 0.05, 1e-4, -1e-4])
    return ws.Scanner(lens, lens, pose)


def grid_of(n: int) -> np.ndarray:
    height, width = image_of(n)
    x, y = np.meshgrid(np.arange(width) * 0.2, np.arange(height) * 0.2)
    return np.stack([x, y, 400 + 6 * np.sin(x / 19)], -1)


def wrapped_of(n: int) -> np.ndarray:
    height, width = image_of(n)
    y, x = np.mgrid[:height, :width] / 100
    return np.angle(np.exp(1j * (3 * x**2 + 2 * y**2) / max(1, width / 1000)))


def decode(n: int) -> Run:
    images, fringes, width = fringe_images(n)
    return lambda: ws.decode([images], fringes, width)


def triangulate(n: int) -> Run:
    scanner, (height, width) = scanner_of(n), image_of(n)
    column = np.linspace(0.2 * width, 0.8 * width, width) + np.zeros((height, 1))
    # The rays of the camera are computed once per scanner, as in a scan.
    ws.triangulate(column, scanner)
    return lambda: ws.triangulate(column, scanner)


def unwrap(n: int) -> Run:
    phase = wrapped_of(n)
    return lambda: ws.unwrap_spatial(phase)


def tree(n: int) -> Run:
    points = surface(n)
    return lambda: ws.KdTree(points)


def nearest(n: int) -> Run:
    tree, queries = ws.KdTree(surface(n)), surface(n, 7) + np.array([0, 0, 0.1])
    return lambda: tree.nearest(queries)


def knn(n: int) -> Run:
    tree, queries = ws.KdTree(surface(n)), surface(n, 7)
    return lambda: tree.knn(queries, 8)


def icp(n: int) -> Run:
    target = surface(n)
    source, normals = surface(n // 2, 8) + np.array([0.05, -0.03, 0.1]), slopes(target)
    return lambda: ws.register_icp(source, target, "plane", normals=normals, max_distance_mm=3.0)


def normals_grid(n: int) -> Run:
    grid = grid_of(n)
    return lambda: ws.estimate_normals(grid)


def normals_cloud(n: int) -> Run:
    points = surface(n)
    return lambda: ws.estimate_normals(points)


def sphere(n: int) -> Run:
    points = on_a_ball(n)
    return lambda: ws.fit_sphere(points)


def robust_sphere(n: int) -> Run:
    points = on_a_ball(n)
    points[::5] += np.random.default_rng(6).normal(size=points[::5].shape) * 20
    return lambda: ws.fit_sphere(points, robust=True)


def cylinder(n: int) -> Run:
    points = on_a_pipe(n)
    return lambda: ws.fit_cylinder(points)


def to_cylinder(n: int) -> Run:
    points, pipe = on_a_pipe(n), ws.Cylinder([0, 0, 0], [0, 0, 1], 315)
    return lambda: ws.distance(points, pipe)


def to_mesh(n: int) -> Run:
    side = 270
    x, y = np.meshgrid(np.linspace(0, 100, side), np.linspace(0, 100, side))
    vertices = np.stack([x, y, 6 * np.sin(x / 19)], -1).reshape(-1, 3)
    at = np.arange(side * side).reshape(side, side)
    a, b, c, d = (q.ravel() for q in (at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]))
    mesh = ws.Mesh(vertices, np.r_[np.c_[a, b, c], np.c_[b, d, c]])
    points = np.random.default_rng(9).random((n, 3)) * [100, 100, 2]
    return lambda: ws.distance(points, mesh, signed=False)


ALGORITHMS: list[tuple[str, str, Callable[[int], Run]]] = [
    ("decode, 12 images", "pixel", decode),
    ("triangulate, both lenses", "pixel", triangulate),
    ("spatial unwrap", "pixel", unwrap),
    ("k-d tree: build", "point", tree),
    ("k-d tree: nearest", "query", nearest),
    ("k-d tree: 8 nearest", "query", knn),
    ("plane ICP, n/2 onto n", "point", icp),
    ("normals, pixel grid", "point", normals_grid),
    ("normals, bare cloud", "point", normals_cloud),
    ("sphere fit", "point", sphere),
    ("sphere fit, robust", "point", robust_sphere),
    ("cylinder fit", "point", cylinder),
    ("distance to a cylinder", "point", to_cylinder),
    ("distance to a mesh of 145,000", "point", to_mesh),
]
"""Name, what is counted, and from a size to a run."""


def least(run: Run) -> float:
    times = []
    while len(times) < REPEATS and (not times or times[-1] < LONG_S):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)


def measure(largest: float, seconds: float) -> dict[str, dict[int, float]]:
    """Seconds by algorithm and size."""
    found: dict[str, dict[int, float]] = {name: {} for name, _, _ in ALGORITHMS}
    until = time.perf_counter() + seconds
    for size in (n for n in SIZES if n <= largest):
        for name, _, make in ALGORITHMS:
            before = found[name].get(size // 10)
            # Making the input costs about as much as the run; the size before tells what is to come.
            if before is not None and time.perf_counter() + 25 * before > until:
                print(f"{name}: no time left for {size:.0e}", file=sys.stderr)
                continue
            found[name][size] = least(make(size))
            print(f"{name:32} {size:9.0e} {found[name][size]:10.5f} s", file=sys.stderr)
    return found


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def tree_bytes_per_point(n: int) -> float:
    """What the resident set grows by when a tree is built, in a process that did nothing else."""
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import growth, weldscan as ws\n"
        f"points = growth.surface({n}); ws.KdTree(points[:100_000])\n"
        "before = growth.resident_bytes(); tree = ws.KdTree(points)\n"
        f"print((growth.resident_bytes() - before) / {n})"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(Path(__file__).parent)], check=True, capture_output=True, text=True
    )
    return float(done.stdout)


# --- the page


def rewrite(script: str, text: str) -> None:
    """Replaces what a script wrote last on the page, between its markers."""
    begin, end = f"<!-- {script} writes from here -->", f"<!-- {script} writes to here -->"
    page = PAGE.read_text()
    before, rest = page.split(begin)
    _, after = rest.split(end)
    PAGE.write_text(f"{before}{begin}\n{text}\n{end}{after}")


WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 760, 460, 64, 232, 20, 48
COLOURS = ["#4477aa", "#ee6677", "#228833", "#bb8800", "#2299bb", "#aa3377", "#888888"]
"""Tol's bright colours, the light ones darkened: they stand out from white and from black."""
STYLE = """text{font:12px system-ui,sans-serif;fill:#444}.grid{stroke:#999;stroke-opacity:.3}path{fill:none}
.run{stroke-width:1.8}.dash{stroke-dasharray:6 3}@media(prefers-color-scheme:dark){text{fill:#ccc}}"""


def plot(found: dict[str, dict[int, float]]) -> str:
    """Seconds over size, both logarithmic."""
    sizes = sorted({n for runs in found.values() for n in runs})
    times = [t for runs in found.values() for t in runs.values()]
    low, high = math.floor(math.log10(min(times))), math.ceil(math.log10(max(times)))
    span = math.log10(sizes[-1] / sizes[0]) or 1.0

    def x(n: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * math.log10(n / sizes[0]) / span

    def y(t: float) -> float:
        return TOP + (HEIGHT - TOP - BOTTOM) * (high - math.log10(t)) / (high - low)

    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img">',
        "<title>Seconds over the number of points</title>",
        f"<style>{STYLE}</style>",
    ]
    for n in sizes:
        out.append(f'<path class="grid" d="M{x(n):.1f} {TOP}V{HEIGHT - BOTTOM}"/>')
        power = round(math.log10(n))
        out.append(f'<text x="{x(n):.1f}" y="{HEIGHT - BOTTOM + 18}" text-anchor="middle">1e{power}</text>')
    for power in range(low, high + 1):
        out.append(f'<path class="grid" d="M{LEFT} {y(10.0**power):.1f}H{WIDTH - RIGHT}"/>')
        unit, factor = ("s", 1) if power >= 0 else ("ms", 1e3) if power >= -3 else ("µs", 1e6)
        label = f"{10.0**power * factor:g} {unit}"
        out.append(f'<text x="{LEFT - 8}" y="{y(10.0**power) + 4:.1f}" text-anchor="end">{label}</text>')
    middle = (LEFT + WIDTH - RIGHT) / 2
    out.append(f'<text x="{middle:.0f}" y="{HEIGHT - 10}" text-anchor="middle">points, queries or pixels</text>')
    ends = []
    for i, (name, runs) in enumerate(found.items()):
        if not runs:
            continue
        look = f'stroke="{COLOURS[i % len(COLOURS)]}"' + (' class="run dash"' if i >= len(COLOURS) else ' class="run"')
        line = "L".join(f"{x(n):.1f} {y(t):.1f}" for n, t in sorted(runs.items()))
        out.append(f'<path {look} d="M{line}"/>')
        last = max(runs)
        ends.append((y(runs[last]), x(last), name, look))
    # Names beside the ends of their lines, moved apart.
    at = TOP - 6.0
    for i, (height, end, name, look) in enumerate(sorted(ends)):
        at = max(at + 15, min(height, HEIGHT - BOTTOM - 15 * (len(ends) - 1 - i)))
        edge = WIDTH - RIGHT
        out.append(f'<path {look} stroke-opacity=".6" d="M{end:.1f} {height:.1f}L{edge + 12} {at:.1f}H{edge + 28}"/>')
        out.append(f'<text x="{edge + 34}" y="{at + 4:.1f}">{name}</text>')
    return "\n".join([*out, "</svg>"]) + "\n"


def machine() -> str:
    """What it ran on."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        name = lines[0].split(":", 1)[1].strip() if lines else name
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    load = os.getloadavg()[0]
    versions = f"weldscan {ws.__version__}, Python {platform.python_version()}, NumPy {np.__version__}"
    return f"{name}, {cores} cores, {versions}; load when it began {load:.1f}"


def table(found: dict[str, dict[int, float]]) -> Iterator[str]:
    sizes = sorted({n for runs in found.values() for n in runs})
    yield "| | " + " | ".join(f"1e{round(math.log10(n))}" for n in sizes) + " | at the largest, ns each |"
    yield "|---|" + "---:|" * (len(sizes) + 1)
    for name, unit, _ in ALGORITHMS:
        runs = found[name]
        cells = [f"{1e3 * runs[n]:.3g}" if n in runs else "-" for n in sizes]
        each = f"{1e9 * runs[max(runs)] / max(runs):.3g} a {unit}" if runs else "-"
        yield f"| {name} | " + " | ".join(cells) + f" | {each} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--largest", type=float, default=1e7)
    parser.add_argument("--seconds", type=float, default=180.0, help="in all")
    parser.add_argument("--dry", action="store_true", help="write nothing, print the table")
    options = parser.parse_args()
    on = machine()
    memory = tree_bytes_per_point(int(min(options.largest, 10**7)))
    found = measure(options.largest, options.seconds)
    text = "\n".join(
        [
            f"{on}.",
            "",
            "Milliseconds, by the number of points, queries or pixels:",
            "",
            *table(found),
            "",
            f"The k-d tree takes {memory:.1f} bytes a point, its copy of the points included: so much the resident set",
            f"grows while a tree of {min(options.largest, 1e7):.0e} points is built and kept.",
        ]
    )
    if options.dry:
        print(text)
        return
    rewrite("growth.py", text)
    PLOT.write_text(plot(found))
    print(f"wrote {PAGE.relative_to(ROOT)} and {PLOT.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
