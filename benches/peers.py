"""Speed beside what a user would pick instead: asserts that the results agree, then prints one table of ratios.

    pip install "weldscan[peers]"        # nothing is installed from here
    python benches/peers.py [--only WORD] [--pairs N] [--write]

Both sides run in one process, one after the other, in pairs; the ratio is the median of the pairs' ratios. Peers use
all threads. A peer that is not installed is named and skipped.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module, metadata
from typing import Any

import growth
import numpy as np

import weldscan as ws

THREADS = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
HEIGHT, WIDTH = 960, 1280
# Pairs stop after this many seconds: one pair of a slow peer is enough to tell 21 s from 0.5 s.
PATIENCE_S = 6.0


@dataclass(frozen=True)
class Job:
    name: str
    peer: str
    target: float
    ours: Callable[[], Any]
    theirs: Callable[[], Any]
    agree: Callable[[Any, Any], None]


def cloud_on_a_pipe(n: int, radius_mm: float, seed: int) -> np.ndarray:
    """Points on a part of a pipe, 0.2 mm apart for a million."""
    rng = np.random.default_rng(seed)
    angle, z = rng.random(n), rng.random(n) * 150
    return np.c_[radius_mm * np.cos(angle), radius_mm * np.sin(angle), z]


def relief(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A surface without a symmetry, and its normals."""
    x, y = np.random.default_rng(seed).random((2, n)) * 200
    points = np.c_[x, y, 6 * np.sin(x / 19) + 5 * np.cos(y / 27)]
    slope = np.c_[-6 / 19 * np.cos(x / 19), 5 / 27 * np.sin(y / 27), np.ones(n)]
    return points, slope / np.linalg.norm(slope, axis=1, keepdims=True)


def same(tolerance: float, pick: Callable[[Any], Any] = lambda r: r) -> Callable[[Any, Any], None]:
    def check(ours: Any, theirs: Any) -> None:
        a, b = np.asarray(pick(ours)), np.asarray(theirs)
        worst = np.nanmax(np.abs(a - b))
        assert a.shape == b.shape, f"{a.shape} and {b.shape}"
        assert worst <= tolerance, f"results differ by {worst}"

    return check


def decoding() -> Iterator[Job]:
    fringes = [(1, 4), (8, 4), (64, 4)]
    rng = np.random.default_rng(1)
    column = 100 + 0.8 * np.arange(WIDTH) + 20 * np.sin(np.arange(HEIGHT) / 90)[:, None]
    images = [
        np.clip(
            120 + 90 * np.cos(2 * np.pi * (p * (column + 0.5) / WIDTH - i / n)) + rng.normal(size=column.shape), 0, 255
        ).astype(np.uint8)
        for p, n in fringes
        for i in range(n)
    ]

    def numpy_decode() -> tuple[np.ndarray, ...]:
        stack = np.stack(images).astype(np.float32)
        absolute = None
        for k, (periods, n) in enumerate(fringes):
            frames = stack[k * n : (k + 1) * n]
            angle = 2 * np.pi * np.arange(n, dtype=np.float32) / n
            c, s = np.tensordot(np.cos(angle), frames, 1), np.tensordot(np.sin(angle), frames, 1)
            wrapped = np.arctan2(s, c) % (2 * np.pi)
            if absolute is None:
                absolute = wrapped
            else:
                expected = absolute * (periods / fringes[k - 1][0])
                absolute = wrapped + 2 * np.pi * np.round((expected - wrapped) / (2 * np.pi))
        modulation = 2 / n * np.hypot(c, s)
        sigma = np.sqrt(2 / n) / modulation
        mask = (modulation > 10) & (stack.max(0) < 250)
        return np.where(mask, absolute / (2 * np.pi) * WIDTH / periods - 0.5, np.nan), modulation, mask, sigma

    def agree(ours: Any, theirs: tuple[np.ndarray, ...]) -> None:
        # Both are within the noise of the truth: 1 grey value in 90, over 64 fringes.
        for found in (ours.column_px, theirs[0]):
            assert np.nanmedian(np.abs(found - column)) < 0.05

    yield Job(
        "decode 12 images 1280x960", "numpy", 15, lambda: ws.decode([images], fringes, WIDTH), numpy_decode, agree
    )

    yield Job(
        "the same beside copying the bytes (at least 0.2)",
        "numpy",
        0.2,
        lambda: ws.decode([images], fringes, WIDTH),
        lambda: [i.copy() for i in images],
        lambda _ours, _theirs: None,
    )
    restoration = import_module("skimage.restoration")
    y, x = np.mgrid[:HEIGHT, :WIDTH] / 100
    wrapped = np.angle(np.exp(1j * (3 * x**2 + 2 * y**2 + np.sin(5 * x) + rng.normal(size=x.shape) * 0.1)))

    def one_constant_apart(ours: np.ndarray, theirs: np.ndarray) -> None:
        apart = (ours - theirs) / (2 * np.pi)
        assert np.abs(apart - np.round(np.median(apart))).max() < 1e-6

    yield Job(
        "spatial unwrap 1280x960",
        "scikit-image",
        5,
        lambda: ws.unwrap_spatial(wrapped),
        lambda: restoration.unwrap_phase(wrapped),
        one_constant_apart,
    )


def triangulating() -> Iterator[Job]:
    k = np.array([[2600.0, 0, 640], [0, 2600, 480], [0, 0, 1]])
    camera, projector = ws.Lens(WIDTH, HEIGHT, k, [-0.1, 0.05, 1e-4, -1e-4]), ws.Lens(1280, 800, k, [-0.08, 0.03, 0, 0])
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(0.3), 0, np.sin(0.3)], [0, 1, 0], [-np.sin(0.3), 0, np.cos(0.3)]]
    pose[:3, 3] = [-130, 0, 20]
    scanner = ws.Scanner(camera, projector, pose)
    pixels = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1).reshape(-1, 2).astype(float)
    rays = np.c_[camera.undistort(pixels), np.ones(len(pixels))]
    truth = rays * (420 + 10 * np.sin(pixels[:, :1] / 150))
    column = scanner.project_to_projector(truth)[:, 0].reshape(HEIGHT, WIDTH)
    to_projector = np.linalg.inv(pose)
    k1, k2, p1, p2, k3 = projector.dist
    d, t = rays @ to_projector[:3, :3].T, to_projector[:3, 3]

    def numpy_triangulate() -> np.ndarray:
        wanted = (column.ravel() - k[0, 2]) / k[0, 0]
        x = wanted
        for _ in range(4):
            depth = (x * t[2] - t[0]) / (d[:, 0] - x * d[:, 2])
            z = d[:, 2] * depth + t[2]
            u, v = (d[:, 0] * depth + t[0]) / z, (d[:, 1] * depth + t[1]) / z
            r2 = u * u + v * v
            bent = u * (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
            x = x + wanted - bent
        return (rays * ((x * t[2] - t[0]) / (d[:, 0] - x * d[:, 2]))[:, None]).reshape(HEIGHT, WIDTH, 3)

    def agree(ours: Any, theirs: np.ndarray) -> None:
        for found in (ours.points_mm, theirs):
            assert np.nanmax(np.abs(found.reshape(-1, 3) - truth)) < 1e-6
        assert np.isfinite(ours.points_mm).mean() > 0.5

    yield Job(
        "triangulate 1.23 million pixels, both lenses",
        "numpy",
        20,
        lambda: ws.triangulate(column, scanner),
        numpy_triangulate,
        agree,
    )


def trees() -> Iterator[Job]:
    points, queries = cloud_on_a_pipe(1_000_000, 315, 1), cloud_on_a_pipe(500_000, 316, 2)
    tree = ws.KdTree(points)
    pykdtree = import_module("pykdtree.kdtree")
    theirs = pykdtree.KDTree(points)
    built, asked = "k-d tree of 1 million points", "500,000 nearest neighbours, 1 mm apart"

    def nearest(find: Callable[[], Any]) -> Callable[[Any, Any], None]:
        return lambda _ours, _theirs: same(1e-9, lambda r: r[0])(tree.nearest(queries), find())

    def pykdtree_nearest() -> np.ndarray:
        return theirs.query(queries)[0]

    yield Job(built, "pykdtree", 1.5, lambda: ws.KdTree(points), lambda: pykdtree.KDTree(points), lambda _a, _b: None)
    yield Job(asked, "pykdtree", 1.5, lambda: tree.nearest(queries), pykdtree_nearest, nearest(pykdtree_nearest))
    gicp = import_module("small_gicp")
    other = gicp.KdTree(points, num_threads=THREADS)

    def gicp_nearest() -> np.ndarray:
        return np.sqrt(other.batch_nearest_neighbor_search(queries, num_threads=THREADS)[1])

    yield Job(
        built,
        "small_gicp",
        1.5,
        lambda: ws.KdTree(points),
        lambda: gicp.KdTree(points, num_threads=THREADS),
        lambda _ours, _theirs: None,
    )
    yield Job(asked, "small_gicp", 1.5, lambda: tree.nearest(queries), gicp_nearest, nearest(gicp_nearest))


def following() -> Iterator[Job]:
    points, queries = cloud_on_a_pipe(1_000_000, 315, 1), cloud_on_a_pipe(500_000, 315.02, 2)
    tree = ws.KdTree(points)
    follower = ws.Follower(tree)
    follower.nearest(queries)
    moves = iter(range(10**9))

    def iterate() -> Any:
        # As the rounds of a registration move its points: by microns, to and fro.
        moved = queries + np.array([0, 0, 1e-3 * (next(moves) % 2)])
        return follower.nearest(moved)

    def agree(_ours: Any, _theirs: Any) -> None:
        for mine, expected in zip(follower.nearest(queries), tree.nearest(queries), strict=True):
            assert np.array_equal(mine, expected)

    def first_pass() -> Any:
        return ws.Follower(tree).nearest(queries)

    yield Job("the same while iterating, 1 um a round", "numpy", 4, iterate, first_pass, agree)


def registration() -> Iterator[Job]:
    target, normals = relief(1_000_000, 3)
    truth = np.eye(4)
    a = 0.01
    truth[:3, :3] = [[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]
    truth[:3, 3] = [0.4, -0.3, 0.5]
    source = (relief(500_000, 4)[0] - truth[:3, 3]) @ truth[:3, :3]
    reach_mm, name = 3.0, "plane ICP, 500,000 -> 1 million points"

    def ours() -> Any:
        return ws.register_icp(source, target, "plane", normals=normals, max_distance_mm=reach_mm)

    # The same minimum, to a micrometre over the part (200 mm).
    def agree(found: Any, pose: np.ndarray) -> None:
        far = np.array([[0, 0, 0, 1], [200, 200, 0, 1]]).T
        apart = np.abs(found.target_from_source @ far - pose @ far).max()
        assert apart < 1e-3, f"the peer ends {apart:.3f} mm away"

    gicp = import_module("small_gicp")
    # Its normals are its own; finding them is not timed.
    other = gicp.PointCloud(target)
    other_tree = gicp.KdTree(other, num_threads=THREADS)
    gicp.estimate_normals(other, other_tree, num_neighbors=20, num_threads=THREADS)

    def small_gicp() -> np.ndarray:
        tree = gicp.KdTree(other, num_threads=THREADS)
        return gicp.align(
            other,
            gicp.PointCloud(source),
            tree,
            registration_type="PLANE_ICP",
            max_correspondence_distance=reach_mm,
            num_threads=THREADS,
            max_iterations=100,
            rotation_epsilon=1e-9,
            translation_epsilon=1e-7,
        ).T_target_source

    yield Job(name, "small_gicp", 8, ours, small_gicp, agree)
    o3d = import_module("open3d")
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in (source, target)]
    clouds[1].normals = o3d.utility.Vector3dVector(normals)

    def open3d() -> np.ndarray:
        registration = o3d.pipelines.registration
        return registration.registration_icp(
            *clouds,
            reach_mm,
            np.eye(4),
            registration.TransformationEstimationPointToPlane(),
            registration.ICPConvergenceCriteria(1e-12, 1e-12, 100),
        ).transformation

    yield Job(name, "open3d", 8, ours, open3d, agree)


def normals_of_clouds() -> Iterator[Job]:
    gicp = import_module("small_gicp")
    angle, z = np.meshgrid(np.linspace(0, 1, 1250), np.linspace(0, 150, 800))
    grid = np.stack([315 * np.cos(angle), 315 * np.sin(angle), z], -1)
    points = cloud_on_a_pipe(1_000_000, 315, 1)

    def theirs(of: np.ndarray) -> Callable[[], np.ndarray]:
        def run() -> np.ndarray:
            cloud = gicp.PointCloud(of)
            gicp.estimate_normals(cloud, num_neighbors=20, num_threads=THREADS)
            return cloud.normals()[:, :3]

        return run

    def agree(ours: np.ndarray, other: np.ndarray) -> None:
        cosine = np.abs(np.einsum("ij,ij->i", ours.reshape(-1, 3), other))
        assert np.quantile(cosine, 0.01) > 0.999

    flat = np.ascontiguousarray(grid.reshape(-1, 3))
    yield Job(
        "normals of 1 million points, grid", "small_gicp", 50, lambda: ws.estimate_normals(grid), theirs(flat), agree
    )
    yield Job("the same, bare cloud", "small_gicp", 2, lambda: ws.estimate_normals(points), theirs(points), agree)


def distances() -> Iterator[Job]:
    o3d = import_module("open3d")
    ball = o3d.geometry.TriangleMesh.create_sphere(100.0, 190)
    vertices, triangles = np.asarray(ball.vertices), np.asarray(ball.triangles)
    rng = np.random.default_rng(5)
    direction = rng.normal(size=(500_000, 3))
    points = direction / np.linalg.norm(direction, axis=1, keepdims=True) * (100 + rng.uniform(-1, 1, (500_000, 1)))
    mesh = ws.Mesh(vertices, triangles)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(triangles.astype(np.uint32)))
    single = o3d.core.Tensor(points.astype(np.float32))

    def open3d() -> np.ndarray:
        return scene.compute_signed_distance(single).numpy()

    name = f"signed distance, 500,000 points to {len(triangles):,} triangles"
    # Theirs is in single precision: 1e-5 mm at 100 mm, some roundings.
    yield Job(name, "open3d", 1, lambda: ws.distance(points, mesh), open3d, same(2e-4))
    pipe = ws.Cylinder([0, 0, 0], [0, 0, 1], 100)
    exact = np.hypot(points[:, 0], points[:, 1]) - 100
    yield Job(
        "the same to the analytic cylinder",
        "open3d",
        50,
        lambda: ws.distance(points, pipe),
        open3d,
        lambda ours, _theirs: same(1e-10)(ours, exact),
    )


def spheres() -> Iterator[Job]:
    ransac = import_module("pyransac3d")
    rng = np.random.default_rng(6)
    direction = rng.normal(size=(60_000, 3))
    ball = [10, -20, 300] + 15 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    ball += rng.normal(size=ball.shape) * 0.02
    points = np.r_[ball, rng.uniform([-30, -60, 260], [50, 20, 340], (40_000, 3))]

    def agree(ours: Any, theirs: tuple[Any, ...]) -> None:
        assert np.abs(ours.center_mm - [10, -20, 300]).max() < 1e-3
        assert np.abs(np.asarray(theirs[0]) - [10, -20, 300]).max() < 0.5

    yield Job(
        "robust sphere fit, 100,000 points, 40 % outliers",
        "pyransac3d",
        20,
        lambda: ws.fit_sphere(points, robust=True),
        lambda: ransac.Sphere().fit(points, thresh=0.06, maxIteration=1000),
        agree,
    )


SUITES = (decoding, triangulating, trees, following, registration, normals_of_clouds, distances, spheres)


def timed(run: Callable[[], Any]) -> tuple[float, Any]:
    # The other side's idle threads may spin for tens of milliseconds (OpenBLAS) before they sleep.
    time.sleep(0.1)
    start = time.perf_counter()
    result = run()
    return time.perf_counter() - start, result


def measure(job: Job, pairs: int) -> tuple[float, float, float]:
    """Median seconds of ours, of theirs, and the median of the ratios, after both were run once and agreed."""
    warm_ours, ours = timed(job.ours)
    warm_theirs, theirs = timed(job.theirs)
    job.agree(ours, theirs)
    del ours, theirs
    pairs = max(1, min(pairs, int(PATIENCE_S / (warm_ours + warm_theirs))))
    runs = [(timed(job.ours)[0], timed(job.theirs)[0]) for _ in range(pairs)]
    ratio = statistics.median(t / o for o, t in runs)
    return statistics.median(o for o, _ in runs), statistics.median(t for _, t in runs), ratio


def version(name: str) -> str:
    try:
        return f"{name} {metadata.version(name)}"
    except metadata.PackageNotFoundError:
        return name


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="jobs with this word in their name, or suites")
    parser.add_argument("--pairs", type=int, default=7, help="pairs of runs at most")
    parser.add_argument("--write", action="store_true", help="the table into docs/benchmarks.md, too")
    options = parser.parse_args()
    said = []

    def say(line: str) -> None:
        said.append(line)
        print(line, flush=True)

    say(f"{growth.machine()}; {THREADS} threads.\n")
    say("| job | peer | peer, s | ours, s | ratio | wanted |")
    say("|---|---|---:|---:|---:|---:|")
    for suite in SUITES:
        try:
            for job in suite():
                if options.only not in f"{suite.__name__} {job.name}":
                    continue
                try:
                    ours, theirs, ratio = measure(job, options.pairs)
                    row = f"{theirs:.4f} | {ours:.4f} | {ratio:.1f} | {job.target:g}"
                except AssertionError as error:
                    row = f"- | - | results differ: {error} | {job.target:g}"
                say(f"| {job.name} | {version(job.peer)} | {row} |")
        except ImportError as error:
            say(f"| {suite.__name__} | {error.name} is not installed: skipped | | | | |")
    if options.write:
        growth.rewrite("peers.py", "\n".join(said))


if __name__ == "__main__":
    main()
