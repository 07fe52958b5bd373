"""Hostile inputs to every public function of the core: none may panic, abort, hang or raise what is not a typed error.

    python tests/fuzz.py --inputs 1000000 [--seed 0] [--jobs 2] [--only KdTree.knn] [--first N]

An input is a number: with the seed it decides the function, its arguments and what is wrong with them. Workers run in
processes of their own, so that an abort or a hang is a finding like any other; each finding is printed with the number
that repeats it (`--first N --inputs 1`). Ends with 1 if there was any.
"""

from __future__ import annotations

import argparse
import json
import mmap
import os
import resource
import struct
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import catalogue
import weldscan as ws
from catalogue import sphere_mesh
from weldscan.simulated import Bead, Block, Body, Photometry, Sphere, Stem, Wall, Weld, pipe

HANG_S = 60.0
"""No input here is large: on a loaded machine, too, a second is plenty."""
MEMORY_BYTES = 8 << 30
"""Address space of a worker: what asks for more was not checked."""
TYPED = (ws.WeldscanError, TypeError)
"""What a wrong input may end in. TypeError: an argument of another kind, too many of them."""

Random = np.random.Generator
Arguments = dict[str, Any]


# --- sane arguments: small, of every kind that is taken


def few(rng: Random, most: int = 40) -> int:
    return int(rng.integers(0, most))


def points(rng: Random, n: int | None = None) -> np.ndarray:
    n = few(rng) if n is None else n
    kind, noise = rng.integers(6), rng.normal(size=(n, 3)) * 10.0 ** rng.integers(-9, 0)
    d = rng.normal(size=(n, 3))
    if kind == 0:
        return d * 10.0 ** rng.integers(-3, 4)
    if kind == 1:
        return np.round(d * 2)
    if kind == 2:
        return d * [1, 1, 0] + noise
    if kind == 3:
        return 10 * d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-9) + noise
    if kind == 4:
        return np.c_[5 * np.cos(d[:, 0]), 5 * np.sin(d[:, 0]), d[:, 1] * 20] + noise
    return d[:, :1] * [1.0, 2.0, 3.0] + noise


def grid(rng: Random) -> np.ndarray:
    h, w = few(rng, 24), few(rng, 24)
    y, x = np.mgrid[:h, :w] * 0.5
    z = 300 + [0 * x, 0.2 * x, -np.sqrt(np.maximum(16 - (x - 4) ** 2 - (y - 4) ** 2, 0))][rng.integers(3)]
    out = np.stack([x, y, z + rng.normal(size=x.shape) * 0.01], -1)
    out[rng.random((h, w)) < 0.1] = np.nan
    return out


def image(rng: Random, shape: tuple[int, int] | None = None) -> np.ndarray:
    shape = (few(rng, 20), few(rng, 20)) if shape is None else shape
    return rng.integers(0, 256, shape).astype([np.uint8, np.uint16, np.float64][rng.integers(3)])


def stack(rng: Random, n: int, kinds: tuple[Any, ...] = (np.uint8, np.uint16)) -> list[np.ndarray]:
    """Fringes of some depth on images of one size."""
    h, w, kind = 1 + few(rng, 16), 1 + few(rng, 24), kinds[rng.integers(len(kinds))]
    phase = rng.random((h, w)) * 6 + np.linspace(0, few(rng), w)
    depth = rng.random() * 120
    return [(120 + depth * np.cos(phase - i * 2 * np.pi / max(n, 1))).astype(kind) for i in range(n)]


def pose(rng: Random) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = q * np.linalg.det(q), rng.normal(size=3) * 10
    return out


def lens(rng: Random) -> ws.Lens:
    f = 10.0 ** rng.uniform(0.5, 3)
    k = [[f, 0, 8], [0, f * rng.uniform(0.5, 2), 6], [0, 0, 1]]
    return ws.Lens(16, 12, k, rng.normal(size=rng.integers(4, 6)) * 10.0 ** rng.integers(-3, 1))


def scanner(rng: Random) -> ws.Scanner:
    return ws.Scanner(lens(rng), lens(rng), pose(rng))


def mesh(rng: Random) -> ws.Mesh:
    vertices, triangles = sphere_mesh(3)
    if rng.random() < 0.5:
        triangles = triangles[: 1 + few(rng, len(triangles) - 1)]
    if rng.random() < 0.3:
        triangles = np.r_[triangles, [[0, 0, 1], [2, 2, 2]]]
    return ws.Mesh(vertices, triangles)


def target(rng: Random) -> Any:
    kind = rng.integers(6)
    if kind < 2:
        cloud = points(rng, 1 + few(rng))
        return cloud if kind else ws.KdTree(cloud)
    if kind == 2:
        return mesh(rng)
    return [
        ws.Plane([0, 0, 1], [0, 1, 2]),
        ws.Sphere([1, 2, 3], 10.0 ** rng.integers(-6, 6)),
        ws.Cylinder([0, 0, 0], [1, 1, 0], 5),
    ][kind - 3]


def fit(rng: Random) -> Arguments:
    out: Arguments = {"points": points(rng), "robust": bool(rng.random() < 0.5), "seed": few(rng)}
    if rng.random() < 0.3:
        out["sigma_mm"] = 10.0 ** rng.integers(-6, 2)
    if not out["robust"] and rng.random() < 0.3:
        out["weights"] = rng.random(len(out["points"]))
    return out


def fit_of_radius(rng: Random) -> Arguments:
    return fit(rng) | ({"radius_mm": 10.0 ** rng.uniform(-2, 3)} if rng.random() < 0.5 else {})


def registration(rng: Random) -> Arguments:
    at = target(rng)
    out: Arguments = {"source": points(rng), "target": at, "metric": ["point", "plane"][rng.integers(2)]}
    choices = {
        "start": partial(pose, rng),
        "max_distance_mm": lambda: 10.0 ** rng.uniform(-2, 3),
        "trim": rng.random,
        "kernel": lambda: ["huber", "tukey"][rng.integers(2)],
        "kernel_mm": lambda: 10.0 ** rng.uniform(-3, 2),
        "tolerance_mm": lambda: 10.0 ** rng.uniform(-12, 0),
        "weak": rng.random,
        "max_points": lambda: few(rng),
        "normals": lambda: unit(rng, len(at) if isinstance(at, np.ndarray | ws.KdTree) else few(rng)),
    }
    return out | {"max_iterations": 20} | {k: v() for k, v in choices.items() if rng.random() < 0.2}


def unit(rng: Random, n: int) -> np.ndarray:
    d = rng.normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def fringes(rng: Random) -> list[tuple[float, int]]:
    plans: list[list[tuple[float, int]]] = [[(1, 4)], [(1, 3), (8, 4)], [(1, 4), (8, 4), (64, 4)], [(15, 3), (16, 5)]]
    return plans[rng.integers(len(plans))]


def decoding(rng: Random) -> Arguments:
    sets = fringes(rng)
    exposures = [stack(rng, sum(n for _, n in sets)) for _ in range(1)]
    if rng.random() < 0.3:
        exposures.append([i // 2 for i in exposures[0]])
    return {"exposures": exposures, "fringes": sets, "projector_size": few(rng) * 10} | (
        {"z": rng.random() * 9} if rng.random() < 0.3 else {}
    )


def gray(rng: Random) -> Arguments:
    images = stack(rng, 1 + few(rng, 6), (np.uint8, np.uint16, np.float64))
    shape = images[0].shape
    out: Arguments = {"images": images}
    if rng.random() < 0.5:
        out["inverse"] = [255 - i for i in images]
    else:
        out |= {"white": image(rng, shape), "black": image(rng, shape)}
    if rng.random() < 0.5:
        out["wrapped"] = rng.normal(size=shape) * 3
    return out | ({"contrast": rng.random() * 50} if rng.random() < 0.5 else {})


def reference(rng: Random) -> Arguments:
    h, w, n = 1 + few(rng, 12), 1 + few(rng, 12), few(rng, 5)
    return {
        "reference_phase": rng.random((h, w)) * 50,
        "phases": [rng.random((h, w)) * 50 for _ in range(n)],
        "heights_mm": list(rng.random(n) * 30),
    }


def height(rng: Random) -> Arguments:
    h, w = few(rng, 12), few(rng, 12)
    out: Arguments = {"phase": rng.random((h, w)) * 50, "reference_phase": rng.random((h, w)) * 50}
    if rng.random() < 0.5 and h and w:
        return out | {"calibration": ws.calibrate_reference_plane(out["phase"], [out["phase"] + 1] * 2, [5.0, 9.0])}
    return out | {"baseline_mm": rng.random() * 100, "distance_mm": rng.random() * 500, "period_mm": rng.random() * 9}


def bodies(rng: Random) -> list[Body]:
    shapes: list[Any] = [Sphere(10.0), Block((30.0, 30.0, 5.0), (3, 3), 5.0), Stem(3.0, 20.0), pipe(60.0)]
    place = pose(rng)
    place[2, 3] += 200
    return [Body(shapes[rng.integers(4)], place) for _ in range(few(rng, 3))]


def simulation(rng: Random) -> Arguments:
    sets = [
        (["x", "y"][rng.integers(2)], float(rng.integers(1, 9)), int(rng.integers(3, 6))) for _ in range(few(rng, 3))
    ]
    return {
        "scanner": scanner(rng),
        "scene_from_scanner": np.eye(4) if rng.random() < 0.8 else pose(rng),
        "bodies": bodies(rng),
        "fringes": sets,
        "photometry": replace(Photometry(), bits=[8, 16][rng.integers(2)], gamma=rng.uniform(0.5, 2.5)),
        "exposures": list(rng.random(few(rng, 3)) + 0.1),
        "seed": few(rng),
    }


@cache
def shot() -> ws.SimulatedShot:
    return ws.simulate_shot(scanner(np.random.default_rng(0)), np.eye(4), [], [], Photometry())


def weld_points() -> np.ndarray:
    """A wall, a bead and a second wall."""
    return catalogue.weld_shot(0.1)


@cache
def weld_shot() -> ws.WeldShot:
    return ws.segment_weld(weld_points(), 315.0, 6.0)


@cache
def weld_step() -> ws.WeldStep:
    return ws.measure_step([weld_shot()])


def segmentation(rng: Random) -> Arguments:
    cloud = weld_points().copy()
    cloud[rng.random(cloud.shape[:2]) < rng.random() * 0.5] = np.nan
    out: Arguments = {
        "points_mm": cloud[few(rng, 60) :, few(rng, 60) :],
        "radius_mm": [315.0, np.inf, 100.0][rng.integers(3)],
        "wall_thickness_mm": 6.0,
    }
    return out | ({"axis": [1.0, 0.0, 0.0], "zero": list(rng.normal(size=3))} if rng.random() < 0.5 else {})


def placing(rng: Random) -> Arguments:
    size = [None, 0.5, 0.0, np.nan][rng.integers(4)]
    return {"step": weld_step(), "shots": [(weld_shot(), pose(rng), few(rng))] * few(rng, 3), "cell_mm": size}


def png(rng: Random) -> Arguments:
    data = bytearray(cv2.imencode(".png", image(rng, (1 + few(rng, 9), 1 + few(rng, 9))).astype(np.uint8))[1].tobytes())
    for _ in range(few(rng, 4)):
        data[rng.integers(len(data))] = rng.integers(256)
    return {"data": bytes(data[: rng.integers(len(data) + 1)] if rng.random() < 0.3 else data)}


SANE: dict[str, Callable[[Random], Arguments]] = {
    "Cylinder": lambda r: {"point_mm": r.normal(size=3), "axis": r.normal(size=3), "radius_mm": r.random() * 50},
    "Follower": lambda r: {"tree": ws.KdTree(points(r, 5))},
    "Follower.nearest": lambda r: {"self": ws.Follower(ws.KdTree(points(r, 9))), "queries": points(r)},
    "KdTree": lambda r: {"points": points(r)},
    "KdTree.knn": lambda r: {"self": ws.KdTree(points(r, 9)), "queries": points(r), "k": few(r, 12)},
    "KdTree.nearest": lambda r: {"self": ws.KdTree(points(r, 9)), "queries": points(r)},
    "KdTree.radius": lambda r: {"self": ws.KdTree(points(r, 9)), "queries": points(r), "r": r.random() * 9},
    "Lens": lambda r: {"width": 9, "height": 8, "K": np.diag([5.0, 4.0, 1.0]), "dist": r.normal(size=5)},
    "Lens.project": lambda r: {"self": lens(r), "points": points(r)},
    "Lens.undistort": lambda r: {"self": lens(r), "pixels": r.normal(size=(few(r), 2)) * 20},
    "Mesh": lambda r: dict(zip(("vertices", "triangles"), sphere_mesh(2 + few(r, 3)), strict=True)),
    "Plane": lambda r: {"point_mm": r.normal(size=3), "normal": r.normal(size=3)},
    "Scanner": lambda r: {"camera": lens(r), "projector": lens(r), "camera_from_projector": pose(r)},
    "Scanner.project_to_projector": lambda r: {"self": scanner(r), "points": points(r)},
    "SimulatedShot.capture": lambda r: {"self": shot(), "picture": r.integers(0, 256, (12, 16), np.uint8)},
    "Sphere": lambda r: {"center_mm": r.normal(size=3), "radius_mm": r.random() * 50},
    "WeldShot.points_mm": lambda r: {"self": weld_shot(), "indices": r.integers(0, 60, few(r))},
    "WeldStep.alone": lambda r: {"self": weld_step(), "shot": weld_shot(), "angle_sigma_rad": r.random() * 0.1},
    "WeldStep.deviation_of": lambda r: {"self": weld_step(), "shot": weld_shot(), "k": few(r, 3)},
    "WeldStep.column": lambda r: {"self": weld_step(), "name": ["step_mm", "angle_deg"][r.integers(2)]},
    "WeldStep.largest_of": lambda r: {"self": weld_step(), "bins": r.integers(0, 20, few(r)).tolist()},
    "WeldStep.keys": lambda r: {"self": weld_step()},
    "calibrate_reference_plane": reference,
    "decode": decoding,
    "decode_gray": gray,
    "decode_phase": lambda r: {"images": stack(r, n := 3 + few(r, 5), (np.uint8, np.uint16, np.float64)), "steps": n},
    "decode_png": png,
    "distance": lambda r: {"points": points(r), "target": target(r), "signed": bool(r.random() < 0.5)},
    "estimate_normals": lambda r: {"points": grid(r) if r.random() < 0.5 else points(r), "k": few(r, 25)},
    "estimate_phase_error": lambda r: {
        "phase_rad": 0.3 * np.arange(400) + 0.2 * np.sin(0.9 * np.arange(400)) + r.normal(size=(60, 400)) * 0.1,
        "steps": 3 + few(r, 5),
        "rows": few(r),
    },
    "find_spheres": lambda r: {
        "points": grid(r) if r.random() < 0.5 else points(r),
        "radius_mm": 10.0 ** r.uniform(-2, 2),
    },
    "fit_cylinder": fit_of_radius,
    "fit_plane": fit,
    "fit_sphere": fit_of_radius,
    "harmonics_of_gamma": lambda r: {"gamma": r.uniform(0.1, 5)},
    "height_from_reference": height,
    "measure_step": lambda r: {"shots": [weld_shot()] * few(r, 3), "angle_sigma_rad": r.random() * 0.01},
    "phase_error_of_harmonics": lambda r: {"harmonics": list(r.normal(size=few(r)) * 0.1), "steps": 3 + few(r, 5)},
    "place_shots": placing,
    "register_icp": registration,
    "register_rigid": lambda r: (
        {"source": points(r, n := few(r)), "target": points(r, n)}
        | ({"weights": r.random(n)} if r.random() < 0.5 else {})
    ),
    "segment_weld": segmentation,
    "set_threads": lambda r: {"threads": [None, 1, 2][r.integers(3)]},
    "simulate_shot": simulation,
    "simulated_step": lambda r: {"weld": pipe(few(r) * 20.0 + 10), "along": r.normal(size=few(r))},
    "sphere_through_points": lambda r: {"points": points(r, 4)},
    "triangulate": lambda r: (
        {"column": r.random((12, 16)) * 16, "scanner": scanner(r)}
        | ({"sigma_px": r.random((12, 16)).astype(np.float32)} if r.random() < 0.5 else {})
    ),
    "unwrap_spatial": lambda r: (
        {"wrapped": r.normal(size=(h := few(r, 20), w := few(r, 20))) * 3}
        | ({"mask": r.random((h, w)) < 0.7} if r.random() < 0.5 else {})
        | ({"quality": r.random((h, w))} if r.random() < 0.5 else {})
    ),
    "unwrap_temporal": lambda r: {"wrapped": r.normal(size=(2, few(r), few(r))), "periods": [1.0, 8.0]},
}

# --- what is wrong with them

NUMBERS: tuple[Any, ...] = (
    *(np.nan, np.inf, -np.inf, 0, -0.0, 1, -1, 2, 3, 0.5, 1e308, -1e308, 5e-324, 1e-310, 1e-150, 1e155, 1e200, 1e16),
    *(2**31, 2**32 + 1, 2**63 - 1, 2**63, 2**64, -(2**31), -(2**63), -(2**70), 10**30, True, None),
    *(
        np.float32(1.5),
        np.int8(3),
        np.uint64(2**63),
        np.array(2.0),
        np.array([1.0]),
        1j,
        "x",
        "point",
        b"y",
        [],
        [1, 2, 3],
    ),
)
"""Instead of a number."""
EXTREMES = np.array(
    [np.nan, np.inf, -np.inf, 0.0, -0.0, 1e308, -1e308, 5e-324, 1e-310, 1e150, -1e150, 1e160, 1e200, 1e16]
)
"""Within an array."""
DTYPES = ("f4", "f2", "i1", "i8", "u1", "u2", "?", "c16", "O", "U5", ">f8", "g", "M8[s]", ">u2")
"""Of an array."""


class Odd:
    """Not a number, not an array, not a sequence."""

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        raise RuntimeError("no array here")


OTHERS: tuple[Callable[[], Any], ...] = (
    *(lambda: None, lambda: "abc", lambda: b"\x89PNG", lambda: 3, lambda: -2.5, lambda: [], lambda: [[]], dict, object),
    *(Odd, lambda: iter([1, 2]), lambda: range(6), lambda: [[1, 2, 3], [4, 5]], lambda: np.nan, lambda: [None] * 3),
    *(lambda: np.zeros((0, 3)), lambda: np.zeros((3, 0)), lambda: np.zeros(()), lambda: np.zeros((1, 1, 1, 1, 3))),
    *(lambda: [[1.0, 2.0, 3.0]] * 4, lambda: np.ma.masked_array(np.ones((5, 3)), True), lambda: np.matrix(np.eye(3))),
    *(lambda: memoryview(bytes(24)), lambda: np.zeros(4, [("x", "f8"), ("y", "f8")]), lambda: ws.Sphere([0, 0, 0], 1)),
)


def spoil_array(rng: Random, a: np.ndarray) -> Any:
    """Another array, or what stands for one."""
    a = np.asarray(a)
    kind = rng.integers(16)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if kind <= 3 and a.size and a.dtype.kind == "f":
            a = a.copy()
            share = [1.0 / a.size, 0.2, 1.0][rng.integers(3)]
            a[rng.random(a.shape) < share] = EXTREMES[rng.integers(len(EXTREMES))]
            return a
        if kind == 4 and a.dtype.kind == "f":
            return a * 10.0 ** rng.integers(-320, 308)
        if kind == 5 and a.dtype.kind == "f":
            return a + 10.0 ** rng.integers(-5, 300)
        if kind == 6 and a.size and a.ndim:
            return np.broadcast_to(a.reshape(-1)[:1], a.shape)
        if kind == 7 and a.ndim > 1 and len(a):
            return a[rng.integers(0, max(1, len(a) // 4), len(a))]
        if kind == 8 and a.ndim > 1 and a.size and a.dtype.kind == "f":
            return np.multiply.outer(np.arange(len(a)), a[0])
        if kind == 9 and a.ndim:
            axis = int(rng.integers(a.ndim))
            return np.take(a, np.arange(min(a.shape[axis], rng.integers(0, 5))), axis)
        if kind == 10:
            return [a.ravel(), a[None], a.T, a[..., None], np.concatenate([a, a], -1) if a.ndim else a][rng.integers(5)]
        if kind == 11:
            try:
                return a.astype(DTYPES[rng.integers(len(DTYPES))])
            except (TypeError, ValueError, RuntimeError):
                return a.astype("O")
        if kind == 12 and a.ndim:
            return [a[::-1], a[::2], np.asfortranarray(a), a[..., ::-1]][rng.integers(4)]
        if kind == 13:
            a = a.copy()
            a.flags.writeable = False
            return a
        if kind == 14:
            return a.tolist()
    return OTHERS[rng.integers(len(OTHERS))]()


def spoil(rng: Random, value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return spoil_array(rng, value)
    if isinstance(value, list | tuple) and value and rng.random() < 0.8:
        at = int(rng.integers(len(value)))
        if rng.random() < 0.2:
            return value[:at] if rng.random() < 0.5 else [*value, value[at]]
        return [spoil(rng, v) if i == at else v for i, v in enumerate(value)]
    if isinstance(value, bool | int | float) and rng.random() < 0.9:
        return NUMBERS[rng.integers(len(NUMBERS))]
    if isinstance(value, Photometry | Body | Weld | Wall | Bead | Sphere | Block | Stem) and rng.random() < 0.9:
        names = [n for n in value.__dataclass_fields__]
        name = names[rng.integers(len(names))]
        return replace(value, **{name: spoil(rng, getattr(value, name))})
    return (OTHERS[rng.integers(len(OTHERS))] if rng.random() < 0.7 else lambda: NUMBERS[rng.integers(len(NUMBERS))])()


def make(seed: int, number: int, only: str | None = None) -> tuple[str, Arguments]:
    rng = np.random.default_rng([seed, number])
    name = only or sorted(SANE)[rng.integers(len(SANE))]
    arguments = SANE[name](rng)
    for _ in range([0, 1, 1, 1, 2, 3][rng.integers(6)]):
        key = sorted(arguments)[rng.integers(len(arguments))]
        if key == "max_iterations":
            arguments[key] = int(rng.integers(-1, 50))  # so many rounds are meant
        elif key != "self":
            # What NumPy itself refuses to make stays as it was.
            with suppress(TypeError, ValueError, OverflowError, RuntimeError), np.errstate(all="ignore"):
                arguments[key] = spoil(rng, arguments[key])
    return name, arguments


# --- what must hold of an answer


def finite(*values: Any) -> None:
    assert all(np.isfinite(v).all() for v in values), f"not finite: {values}"


def is_pose(m: np.ndarray) -> None:
    assert np.abs(m[:3, :3] @ m[:3, :3].T - np.eye(3)).max() < 1e-9 and np.linalg.det(m[:3, :3]) > 0, f"no pose: {m}"
    finite(m)


def is_answer(arguments: Arguments, result: Any) -> None:
    """An answer is finite where it promises numbers, and of the promised shape."""
    if isinstance(result, ws.PlaneFit):
        finite(result.point_mm, result.normal, result.rms_mm)
        assert abs(np.linalg.norm(result.normal) - 1) < 1e-9
    elif isinstance(result, ws.SphereFit | ws.FoundSphere):
        finite(result.center_mm, result.radius_mm, result.rms_mm)
        assert result.radius_mm > 0
    elif isinstance(result, ws.CylinderFit):
        finite(result.point_mm, result.axis, result.radius_mm, result.rms_mm)
        assert abs(np.linalg.norm(result.axis) - 1) < 1e-9 and result.radius_mm > 0
    elif isinstance(result, ws.RigidFit | ws.Registration):
        is_pose(result.target_from_source)
        finite(result.rms_mm)
    elif isinstance(result, list):
        for one in result:
            is_answer(arguments, one)
    elif isinstance(result, tuple) and isinstance(arguments.get("self"), ws.KdTree | ws.Follower):
        distance, index = result
        assert len(distance) == len(index) == len(np.asarray(arguments["queries"]))
        for d, i in zip(distance, index, strict=True):
            finite(d)
            assert np.all(d >= 0) and np.all(i < 9) and np.all(np.diff(np.atleast_1d(d)) >= 0)


def one(seed: int, number: int, only: str | None) -> tuple[str, str | None, bool]:
    """The function's name, what is wrong with its behaviour, and whether it answered."""
    name, arguments = make(seed, number, only)
    of = arguments.get("self")
    call = getattr(ws, name) if of is None else getattr(of, name.split(".")[1])
    try:
        result = call(**{k: v for k, v in arguments.items() if k != "self"})
        repr(result)
        is_answer(arguments, result)
    except TYPED:
        return name, None, False
    except BaseException as error:
        return name, f"{type(error).__name__}: {error}"[:400], False
    return name, None, True


# --- workers and the watch on them


def work(seed: int, first: int, last: int, stride: int, only: str | None, place: str) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    warnings.simplefilter("ignore")
    ws.set_threads(1 + first % 2)
    seen: Counter[str] = Counter()
    with Path(place).open("r+b") as file, mmap.mmap(file.fileno(), 8) as here:
        for number in range(first, last, stride):
            here[:] = struct.pack("q", number)
            name, wrong, answered = one(seed, number, only)
            seen.update([name, f"{name} answered"] if answered else [name])
            if wrong:
                print(json.dumps({"number": number, "name": name, "wrong": wrong}), flush=True)
    print(json.dumps({"seen": seen}), flush=True)


def watch(seed: int, first: int, last: int, stride: int, only: str | None) -> Iterator[dict[str, Any]]:
    """Runs one worker after another over its inputs; the end of one is a finding, and the next goes on after it."""
    while first < last:
        with tempfile.NamedTemporaryFile() as place, tempfile.TemporaryFile("w+") as said:
            place.write(struct.pack("q", first))
            place.flush()
            arguments = [str(v) for v in (seed, first, last, stride)] + [only or "", place.name]
            worker = subprocess.Popen(
                [sys.executable, "-X", "faulthandler", __file__, "--worker", *arguments],
                stdout=said,
                stderr=subprocess.PIPE if os.environ.get("FUZZ_QUIET") else None,
            )
            at, since, wrong = first, time.monotonic(), None
            while worker.poll() is None:
                time.sleep(0.05)
                now = struct.unpack("q", Path(place.name).read_bytes())[0]
                if now != at:
                    at, since = now, time.monotonic()
                elif time.monotonic() - since > HANG_S:
                    worker.kill()
                    wrong = f"no answer within {HANG_S:.0f} s"
            at = struct.unpack("q", Path(place.name).read_bytes())[0]
            said.seek(0)
            for line in said:
                yield json.loads(line)
            if worker.returncode == 0:
                return
            name = make(seed, at, only)[0]
            yield {"number": at, "name": name, "wrong": wrong or f"the process ended with {worker.returncode}"}
            first = at + stride


def run(inputs: int, seed: int = 0, jobs: int = 2, only: str | None = None, first: int = 0) -> list[dict[str, Any]]:
    """Findings; prints them as they come, and what was seen at the end."""
    from concurrent.futures import ThreadPoolExecutor

    findings: list[dict[str, Any]] = []
    seen: Counter[str] = Counter()

    def follow(job: int) -> None:
        for said in watch(seed, first + job, first + inputs, jobs, only):
            if "seen" in said:
                seen.update(said["seen"])
            else:
                findings.append(said)
                print(f"input {said['number']} {said['name']}: {said['wrong']}", flush=True)

    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(follow, range(jobs)))
    for name in sorted(n for n in seen if " " not in n):
        print(f"{name:30} {seen[name]:8} inputs, {seen[f'{name} answered'] / seen[name]:4.0%} answered")
    return findings


def main() -> None:
    if sys.argv[1:2] == ["--worker"]:
        seed, first, last, stride, only, place = sys.argv[2:]
        work(int(seed), int(first), int(last), int(stride), only or None, place)
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", choices=sorted(SANE))
    options = parser.parse_args()
    start = time.monotonic()
    findings = run(options.inputs, options.seed, options.jobs, options.only, options.first)
    print(f"{options.inputs:,} inputs, {len(findings)} findings, {time.monotonic() - start:.0f} s")
    sys.exit(bool(findings))


if __name__ == "__main__":
    main()
