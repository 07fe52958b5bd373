"""Every public function of the core at work: what the tests of threads, of the interpreter's lock and of bad input run.

A job is prepared outside the clock and called inside; `scale` multiplies its points or pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import cv2
import numpy as np

import weldscan as ws
from weldscan import _weldcore
from weldscan.simulated import DEFAULT, Body, Photometry, Sphere, make_scanner, pipe, render

Job = Callable[[], Any]
JOBS: dict[str, Callable[[float], Job]] = {}
"""By name ("fit_plane", "KdTree.nearest"; a class is its constructor): from a scale to the job."""

INSTANT = {
    "Cylinder": "three numbers and a normalisation",
    "Follower": "keeps a reference",
    "Lens": "keeps numbers",
    "Plane": "keeps numbers",
    "Scanner": "keeps numbers",
    "Sphere": "keeps numbers",
    "WeldStep.column": "one of eight numbers of each bin",
    "WeldStep.keys": "24 names",
    "harmonics_of_gamma": "47 products",
    "phase_error_of_harmonics": "512 points of a curve",
    "set_threads": "sets a number",
    "sphere_through_points": "four points",
}
"""Public names that compute nothing that could take long, and why."""


def public() -> set[str]:
    """The functions, constructors and methods of the core that the package exports."""
    names = set()
    for name in ws.__all__:
        thing = getattr(_weldcore, name, None)
        if isinstance(thing, type):
            try:
                thing()
            except TypeError as error:
                # Results are made by functions alone.
                if "No constructor" not in str(error) and "cannot create" not in str(error):
                    names.add(name)
            names |= {f"{name}.{m}" for m, v in vars(thing).items() if not m.startswith("_") and callable(v)}
        elif callable(thing):
            names.add(name)
    return names


def job(name: str) -> Callable[[Callable[[float], Job]], Callable[[float], Job]]:
    def keep(prepare: Callable[[float], Job]) -> Callable[[float], Job]:
        JOBS[name] = prepare
        return prepare

    return keep


def bits(result: Any) -> Iterator[Any]:
    """A result's values as they lie in memory, down to the last attribute."""
    if isinstance(result, np.ndarray):
        yield (result.dtype.str, result.shape, result.tobytes())
    elif isinstance(result, float):
        yield result.hex()
    elif isinstance(result, dict):
        for key, value in result.items():
            yield key
            yield from bits(value)
    elif isinstance(result, list | tuple):
        yield len(result)
        for value in result:
            yield from bits(value)
    elif type(result).__module__.startswith("weldscan"):
        for name in dir(result):
            if not name.startswith("_") and not callable(getattr(result, name)):
                yield name
                yield from bits(getattr(result, name))
    else:
        assert result is None or isinstance(result, int | str), type(result)
        yield result


def random(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def cloud(n: int, seed: int = 0) -> np.ndarray:
    """A surface without a symmetry, with noise."""
    rng = random(seed)
    x, y = rng.random((2, n)) * 200
    return np.c_[x, y, 300 + 6 * np.sin(x / 19) + 5 * np.cos(y / 27) + rng.normal(size=n) * 0.02]


def tube(n: int, radius: float = 50.0, seed: int = 0) -> np.ndarray:
    rng = random(seed)
    angle, r = rng.random(n) * 4, radius + rng.normal(size=n) * 0.02
    return np.c_[r * np.cos(angle), r * np.sin(angle), rng.random(n) * 150]


def ball(n: int, seed: int = 0) -> np.ndarray:
    rng = random(seed)
    d = rng.normal(size=(n, 3))
    return [0, 0, 300] + 20 * d / np.linalg.norm(d, axis=1, keepdims=True) + rng.normal(size=(n, 3)) * 0.02


def strays(points: np.ndarray) -> np.ndarray:
    """The points with every fifth one gone astray."""
    points = points.copy()
    points[::5] += random(9).normal(size=(len(points[::5]), 3)) * 30
    return points


def sphere_mesh(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """A closed sphere of radius 20 with 4 rings² triangles or so."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False), np.linspace(0, np.pi, rings + 1)[1:-1])
    grid = 20 * np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], -1).reshape(-1, 3)
    at = np.arange(len(grid)).reshape(rings - 1, 2 * rings)
    right = np.roll(at, -1, 1)
    quads = [
        np.stack([at[:-1], at[1:], right[:-1]], -1).reshape(-1, 3),
        np.stack([right[:-1], at[1:], right[1:]], -1).reshape(-1, 3),
    ]
    north, south = len(grid), len(grid) + 1
    caps = [
        np.stack([np.full(2 * rings, north), at[0], right[0]], -1),
        np.stack([np.full(2 * rings, south), right[-1], at[-1]], -1),
    ]
    return np.vstack([grid, [0, 0, 20], [0, 0, -20]]), np.vstack(quads + caps)


def fringes_on_a_wall(scale: float) -> tuple[list[np.ndarray], list[tuple[float, int]], int]:
    """Images of 1, 8 and 64 fringes in 4 steps each."""
    height, width = round(300 * math.sqrt(scale)), round(400 * math.sqrt(scale))
    sets = [(1.0, 4), (8.0, 4), (64.0, 4)]
    rng = random(1)
    column = 5 + (width - 10) * (np.arange(width) / width) + 0.02 * np.arange(height)[:, None]
    images = []
    for periods, steps in sets:
        for i in range(steps):
            wave = 120 + 90 * np.cos(2 * np.pi * (periods * (column + 0.5) / width - i / steps))
            images.append(np.clip(wave + rng.normal(size=column.shape), 0, 255).astype(np.uint8))
    return images, sets, width


def smaller_scanner(scale: float) -> ws.Scanner:
    """The simulated cell's scanner with 320x240 camera pixels at scale 1."""
    whole, factor = make_scanner(), math.sqrt(scale) / 4
    k = whole.camera.K * factor
    k[2, 2] = 1.0
    size = round(whole.camera.width * factor), round(whole.camera.height * factor)
    return ws.Scanner(ws.Lens(*size, k, whole.camera.dist), whole.projector, whole.camera_from_projector)


@cache
def weld_shot(scale: float) -> np.ndarray:
    """Points (H, W, 3) of a simulated weld, with noise."""
    from dataclasses import replace

    cell = replace(DEFAULT, scanner=smaller_scanner(scale), fringes=(), weld=pipe(630.0, offset_mm=0.6))
    points = render(cell, "part", cell.part_views()[0]).points_mm
    return points + random(2).normal(size=points.shape) * 0.01


# --- fits


@job("fit_plane")
def _(scale: float) -> Job:
    points = strays(cloud(round(60_000 * scale)) * [1, 1, 0.01])
    return lambda: (ws.fit_plane(points), ws.fit_plane(points, robust=True))


@job("fit_sphere")
def _(scale: float) -> Job:
    points = ball(round(60_000 * scale))
    return lambda: (ws.fit_sphere(points), ws.fit_sphere(points, 20.0), ws.fit_sphere(strays(points), robust=True))


@job("fit_cylinder")
def _(scale: float) -> Job:
    points = tube(round(60_000 * scale))
    return lambda: (
        ws.fit_cylinder(points),
        ws.fit_cylinder(points, 50.0),
        ws.fit_cylinder(strays(points), robust=True),
    )


@job("find_spheres")
def _(scale: float) -> Job:
    n = round(20_000 * scale)
    points = np.vstack([ball(n), ball(n, 1) + np.array([60, 0, 0]), cloud(n) * [1, 1, 0.01] + [-100, -100, 350]])
    return lambda: ws.find_spheres(points, 20.0)


@job("register_rigid")
def _(scale: float) -> Job:
    source = cloud(round(200_000 * scale))
    target = source[:, [1, 2, 0]] + random(3).normal(size=source.shape)
    weights = random(4).random(len(source))
    return lambda: (ws.register_rigid(source, target), ws.register_rigid(source, target, weights))


# --- neighbours, distances, registration


@job("KdTree")
def _(scale: float) -> Job:
    points, queries = cloud(round(60_000 * scale)), cloud(1000, 1)
    return lambda: ws.KdTree(points).knn(queries, 4)


@job("KdTree.nearest")
def _(scale: float) -> Job:
    tree, queries = ws.KdTree(cloud(round(60_000 * scale))), cloud(round(60_000 * scale), 1)
    return lambda: tree.nearest(queries)


@job("KdTree.knn")
def _(scale: float) -> Job:
    tree, queries = ws.KdTree(cloud(round(60_000 * scale))), cloud(round(40_000 * scale), 1)
    return lambda: tree.knn(queries, 7)


@job("KdTree.radius")
def _(scale: float) -> Job:
    # Few queries of many points each: the lists are made with the lock held.
    n = round(60_000 * scale)
    tree, queries = ws.KdTree(cloud(n)), cloud(round(400 * math.sqrt(scale)), 1)
    return lambda: tree.radius(queries, 20.0)


@job("Follower.nearest")
def _(scale: float) -> Job:
    tree, queries = ws.KdTree(cloud(round(60_000 * scale))), cloud(round(60_000 * scale), 1)

    def follow() -> Any:
        follower = ws.Follower(tree)
        return [follower.nearest(queries + np.array([0, 0, shift])) for shift in (0.0, 1e-3, 0.4)]

    return follow


OFF = np.array([0.3, -0.2, 0.1])


@job("register_icp")
def _(scale: float) -> Job:
    # More than twice the 16,384 points of the coarse rounds.
    target, source = cloud(round(60_000 * scale)), cloud(round(40_000 * scale), 1) + OFF
    tree, pipe_part = ws.KdTree(target), tube(round(20_000 * scale)) + OFF
    mesh = ws.Mesh(*sphere_mesh(20))
    return lambda: (
        ws.register_icp(source, tree, "plane", trim=0.1, max_iterations=8),
        ws.register_icp(source, tree, "point", kernel="huber", max_iterations=4),
        ws.register_icp(source[::2], tree, "plane", kernel="tukey", max_iterations=8),
        ws.register_icp(pipe_part, ws.Cylinder([0, 0, 0], [0, 0, 1], 50), "plane"),
        ws.register_icp(ball(round(3000 * scale)) - [0.1, 0.2, 300], mesh, "plane", max_iterations=5),
    )


@job("distance")
def _(scale: float) -> Job:
    target, points = cloud(round(60_000 * scale)), cloud(round(60_000 * scale), 1)
    normals, mesh = ws.estimate_normals(target), ws.Mesh(*sphere_mesh(60))
    around = ball(len(points), 2) * 1.1 - [0, 0, 330]
    surfaces = ws.Plane([0, 0, 0], [0, 1, 1]), ws.Sphere([0, 0, 0], 20), ws.Cylinder([0, 0, 0], [0, 1, 1], 20)
    return lambda: (
        ws.distance(points, target, normals=normals),
        ws.distance(around, mesh),
        [ws.distance(points, surface) for surface in surfaces],
    )


@job("Mesh")
def _(scale: float) -> Job:
    vertices, triangles = sphere_mesh(round(60 * math.sqrt(scale)))
    triangles = triangles.astype(np.int64)
    queries = ball(500) - [0, 0, 300]

    def build() -> Any:
        mesh = ws.Mesh(vertices, triangles)
        return mesh, ws.distance(queries, mesh)

    return build


@job("estimate_normals")
def _(scale: float) -> Job:
    points, side = cloud(round(60_000 * scale)), round(250 * math.sqrt(scale))
    x, y = np.meshgrid(np.arange(side) * 0.2, np.arange(side) * 0.2)
    grid = np.stack([x, y, 300 + np.sin(x) + random(5).normal(size=x.shape) * 0.01], -1)
    return lambda: (ws.estimate_normals(points), ws.estimate_normals(grid))


# --- phase


@job("decode")
def _(scale: float) -> Job:
    images, sets, width = fringes_on_a_wall(scale)
    return lambda: ws.decode([images, [i // 2 for i in images]], sets, width)


@job("decode_phase")
def _(scale: float) -> Job:
    images, _, _ = fringes_on_a_wall(scale)
    return lambda: ws.decode_phase(images, [4, 4, 4])


@job("estimate_phase_error")
def _(scale: float) -> Job:
    y, x = np.mgrid[: round(300 * scale), :400]
    phase = 0.3 * x + 1e-4 * x**2 + 0.01 * y
    phase += 0.2 * np.sin(3 * phase) + random(1).normal(size=phase.shape) * 0.01
    return lambda: np.array(ws.estimate_phase_error(phase, 3, rows=len(phase)).sin_rad)


@job("unwrap_temporal")
def _(scale: float) -> Job:
    images, sets, _ = fringes_on_a_wall(scale)
    phase = np.asarray(ws.decode_phase(images, [4, 4, 4]))
    return lambda: ws.unwrap_temporal(phase, [periods for periods, _ in sets])


@job("unwrap_spatial")
def _(scale: float) -> Job:
    side = round(300 * math.sqrt(scale))
    y, x = np.mgrid[:side, :side] / 60
    phase = np.angle(np.exp(1j * (3 * x**2 + 2 * y**2 + random(1).normal(size=x.shape) * 0.3)))
    return lambda: (ws.unwrap_spatial(phase), ws.unwrap_spatial(phase, mask=x > 1, quality=-np.abs(x - y)))


@job("decode_gray")
def _(scale: float) -> Job:
    code = np.arange(100 * round(1000 * scale)).reshape(100, -1) * 1024 // (100 * round(1000 * scale))
    gray = code ^ (code >> 1)
    images = [np.uint8(30 + 150 * (gray >> b & 1)) for b in reversed(range(10))]
    wrapped = np.angle(np.exp(1j * 2 * np.pi * 512 * np.arange(code.size).reshape(code.shape) / code.size))
    return lambda: ws.decode_gray(images, inverse=[210 - i for i in images], wrapped=wrapped)


@job("decode_png")
def _(scale: float) -> Job:
    side = round(300 * math.sqrt(scale))
    data = cv2.imencode(".png", random().integers(0, 65536, (side, side), np.uint16))[1].tobytes()
    return lambda: ws.decode_png(data)


@job("triangulate")
def _(scale: float) -> Job:
    scanner = smaller_scanner(scale)
    height, width = scanner.camera.height, scanner.camera.width
    column = np.linspace(300, 900, width) + random().normal(size=(height, width))
    sigma = np.full((height, width), 0.05, np.float32)
    return lambda: ws.triangulate(column, scanner, sigma)


@job("calibrate_reference_plane")
def _(scale: float) -> Job:
    side = round(300 * math.sqrt(scale))
    reference = np.linspace(0, 100, side)[None, :] + np.zeros((side, 1))
    heights = [5.0, 10.0, 20.0]
    phases = [reference + h / 10 + random(int(h)).normal(size=reference.shape) * 1e-3 for h in heights]
    return lambda: ws.calibrate_reference_plane(reference, phases, heights)


@job("height_from_reference")
def _(scale: float) -> Job:
    side = round(500 * math.sqrt(scale))
    reference = np.linspace(0, 100, side)[None, :] + np.zeros((side, 1))
    phase = reference + random().random(reference.shape)
    return lambda: ws.height_from_reference(phase, reference, baseline_mm=100, distance_mm=400, period_mm=10)


@job("Lens.project")
def _(scale: float) -> Job:
    lens, points = DEFAULT.scanner.camera, cloud(round(300_000 * scale)) - [100, 100, 0]
    return lambda: lens.project(points)


@job("Lens.undistort")
def _(scale: float) -> Job:
    lens, pixels = DEFAULT.scanner.camera, random().random((round(200_000 * scale), 2)) * 900
    return lambda: lens.undistort(pixels)


@job("Scanner.project_to_projector")
def _(scale: float) -> Job:
    points = cloud(round(300_000 * scale)) - [100, 100, 0]
    return lambda: DEFAULT.scanner.project_to_projector(points)


# --- weld


@job("segment_weld")
def _(scale: float) -> Job:
    points = weld_shot(4 * scale)
    return lambda: ws.segment_weld(points, 315.0, 6.0)


@job("measure_step")
def _(scale: float) -> Job:
    shots = [ws.segment_weld(weld_shot(4 * scale), 315.0, 6.0)] * 2
    return lambda: ws.measure_step(shots)


@job("WeldStep.largest_of")
def _(scale: float) -> Job:
    step = ws.measure_step([ws.segment_weld(weld_shot(4 * scale), 315.0, 6.0)])
    bins = list(range(len(step.profile)))
    return lambda: step.largest_of(bins)


@job("place_shots")
def _(scale: float) -> Job:
    shot = ws.segment_weld(weld_shot(4 * scale), 315.0, 6.0)
    step = ws.measure_step([shot] * 2)
    return lambda: ws.place_shots(step, [(shot, np.eye(4), 1)] * 2, 0.3)


@job("WeldShot.points_mm")
def _(scale: float) -> Job:
    shot = ws.segment_weld(weld_shot(4 * scale), 315.0, 6.0)
    some = np.arange(0, shot.labels.size, 7)
    return lambda: shot.points_mm(some)


@job("WeldStep.alone")
def _(scale: float) -> Job:
    shot = ws.segment_weld(weld_shot(4 * scale), 315.0, 6.0)
    step = ws.measure_step([shot])
    return lambda: step.alone(shot)


@job("WeldStep.deviation_of")
def _(scale: float) -> Job:
    shot = ws.segment_weld(weld_shot(4 * scale), 315.0, 6.0)
    step = ws.measure_step([shot])
    return lambda: step.deviation_of(shot, 0)


# --- simulation


def balls() -> list[Body]:
    place = np.eye(4)
    place[2, 3] = 420.0
    return [Body(Sphere(10.0), place)]


@job("simulate_shot")
def _(scale: float) -> Job:
    scanner, bodies = smaller_scanner(scale), balls()
    return lambda: ws.simulate_shot(scanner, np.eye(4), bodies, [("x", 8, 4)], Photometry())


@job("SimulatedShot.capture")
def _(scale: float) -> Job:
    shot = ws.simulate_shot(smaller_scanner(scale), np.eye(4), balls(), [], Photometry())
    projector = DEFAULT.scanner.projector
    picture = random().integers(0, 256, (projector.height, projector.width), np.uint8)
    return lambda: shot.capture(picture)


@job("simulated_step")
def _(scale: float) -> Job:
    weld, along = pipe(), random().random(round(300_000 * scale))
    return lambda: ws.simulated_step(weld, along)
