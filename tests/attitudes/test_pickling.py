"""Every public object can be pickled, copied and sent to another process, and is then the same to the last bit. A new
class is covered by itself: of the core by introspection, of the package by its fields."""

from __future__ import annotations

import copy
import dataclasses
import enum
import importlib
import multiprocessing
import pickle
import pkgutil
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pydantic
import pytest

import weldscan as ws
from catalogue import JOBS, bits, fringes_on_a_wall, sphere_mesh
from weldscan import _weldcore
from weldscan.simulated import Body, Photometry, Sphere
from weldscan.simulated.scenes import SceneWeld

SCALE = 0.02
"""A fiftieth of the catalogue's points and pixels."""
WAYS = {
    "pickle": lambda thing: pickle.loads(pickle.dumps(thing)),
    "oldest pickle": lambda thing: pickle.loads(pickle.dumps(thing, 2)),
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
}

CLASSES = [thing for thing in vars(_weldcore).values() if isinstance(thing, type)]


def found_in(value: Any) -> Iterator[Any]:
    """The objects of the core in a result, down to the last attribute."""
    if isinstance(value, list | tuple):
        for item in value:
            yield from found_in(item)
    elif type(value) in CLASSES:
        yield value
        for name in dir(value):
            if not name.startswith("_") and not callable(getattr(value, name)):
                yield from found_in(getattr(value, name))


@cache
def examples() -> dict[type, Any]:
    """One of every class of the core, as the functions that make them do."""
    tree = ws.KdTree(np.random.default_rng(0).random((700, 3)))
    lens = ws.Lens(64, 48, [[80, 0, 31.5], [0, 80, 23.5], [0, 0, 1]], [0.1, -0.2, 0.01, 0.02, 0.3])
    pose = np.eye(4)
    pose[:3, 3] = 0.1, 0.2, 0.3
    things: list[Any] = [
        *(tree, ws.Follower(tree), lens, ws.Scanner(lens, lens, pose), ws.Mesh(*sphere_mesh(6))),
        *(ws.Plane([1, 2, 3], [1, 2, 3]), ws.Sphere([1, 2, 3], 4), ws.Cylinder([1, 2, 3], [1, 2, 2.5], 4)),
        _weldcore.WeldSurface(SceneWeld(315.0, 6.0)),
    ]
    made = []
    for name, prepare in JOBS.items():
        if not isinstance(getattr(ws, name.split(".")[0]), type):
            made.append(prepare(0.3 if name in NEED_MORE else SCALE)())
    ball = np.eye(4)
    ball[2, 3] = 90.0
    things.append(ws.simulate_shot(things[3], np.eye(4), [Body(Sphere(20.0), ball)], [("x", 4, 3)], Photometry()))
    # Two sets whose frames are exchanged.
    images, sets, width = fringes_on_a_wall(0.3)
    images[5], images[6] = images[6], images[5]
    things.append(ws.decode([images], sets, width))
    return {type(one): one for thing in [made, things] for one in found_in(thing)}


NEED_MORE = {"segment_weld", "measure_step", "place_shots", "estimate_phase_error", "decode"}
"""What finds nothing in so few points."""


def probed(thing: Any) -> Any:
    """What an object answers, beyond its attributes."""
    queries = np.random.default_rng(1).random((50, 3)) + 0.2
    if isinstance(thing, ws.KdTree):
        return thing.knn(queries, 5)
    if isinstance(thing, ws.Follower):
        return thing.nearest(queries)
    if isinstance(thing, ws.Mesh | ws.Plane | ws.Sphere | ws.Cylinder):
        return ws.distance(queries * 30, thing)
    if isinstance(thing, ws.Lens):
        return thing.project(queries)
    if isinstance(thing, ws.Scanner):
        return thing.project_to_projector(queries + 1)
    if isinstance(thing, ws.WeldShot):
        return ws.measure_step([thing])
    if isinstance(thing, ws.SimulatedShot):
        return thing.capture(np.arange(48 * 64, dtype=np.uint32).reshape(48, 64).astype(np.uint8), number=3)
    if isinstance(thing, _weldcore.WeldSurface):
        return thing.height(queries[:, 0], queries[:, 1])
    return None


def whole(thing: Any) -> list[Any]:
    return [type(thing).__qualname__, repr(thing), *bits(thing), *bits(probed(thing))]


def test_there_is_an_example_of_every_class_of_the_core():
    assert set(examples()) == set(CLASSES)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("kind", CLASSES, ids=lambda c: c.__name__)
def test_an_object_of_the_core_comes_back_whole(kind, way):
    thing = examples()[kind]
    back = WAYS[way](thing)
    assert back is not thing
    assert whole(back) == whole(thing)


def test_a_pickle_of_another_version_or_a_damaged_one_is_refused_in_one_line():
    function, (name, version, state) = _weldcore._take_apart(ws.Plane([0, 0, 0], [0, 0, 1]))
    with pytest.raises(ws.InputError, match=r"Plane: pickled by weldscan 0\.0\.0"):
        function(name, "0.0.0", state)
    with pytest.raises(ws.InputError, match="damaged"):
        function(name, version, state[:-1])
    with pytest.raises(ws.InputError, match="damaged"):
        function(name, version, state + b"x")


def nearest(tree: ws.KdTree, queries: np.ndarray) -> list[int]:
    """What a worker does."""
    return [int(i) for i in tree.nearest(queries)[1]]


def test_objects_go_to_a_spawned_process_and_results_come_back():
    points = np.random.default_rng(2).random((3000, 3))
    tree, queries = ws.KdTree(points), np.split(points[:400], 4)
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        found = pool.starmap(nearest, [(tree, q) for q in queries])
        [fit] = pool.map(ws.fit_plane, [points])
    assert [i for part in found for i in part] == list(range(400))
    assert whole(fit) == whole(ws.fit_plane(points))


# --- the package's own


def package_classes() -> list[type]:
    """The dataclasses and documents of every module, the exceptions and enums, whoever exports them."""
    kinds = []
    for module in pkgutil.walk_packages(ws.__path__, "weldscan."):
        if module.name.startswith("weldscan.devices") or module.name.endswith("__main__"):
            continue
        for thing in vars(importlib.import_module(module.name)).values():
            if not isinstance(thing, type) or thing.__module__ != module.name or thing.__name__.startswith("_"):
                continue
            if dataclasses.is_dataclass(thing) or issubclass(thing, enum.Enum | Exception | pydantic.BaseModel):
                kinds.append(thing)
    return kinds


@pytest.mark.parametrize("kind", package_classes(), ids=lambda c: f"{c.__module__}.{c.__name__}")
def test_an_object_of_the_package_comes_back_whole(kind):
    if issubclass(kind, enum.Enum):
        things: list[Any] = list(kind)
    elif issubclass(kind, Exception):
        things = [kind("what went wrong")]
    elif dataclasses.is_dataclass(kind):
        # The class is under test, not its fields: these are of the core, of numpy or of the package, each tested alone.
        thing = object.__new__(kind)
        for i, field in enumerate(dataclasses.fields(kind)):
            object.__setattr__(thing, field.name, np.arange(i, i + 3.0))
        things = [thing]
    else:
        things = [kind.model_construct(**{name: i for i, name in enumerate(kind.model_fields)})]
    for thing in things:
        for way in WAYS.values():
            back = way(thing)
            assert type(back) is kind
            if isinstance(thing, Exception):
                assert str(back) == str(thing)
            elif dataclasses.is_dataclass(kind):
                for field in dataclasses.fields(kind):
                    assert getattr(back, field.name).tolist() == getattr(thing, field.name).tolist()
            else:
                assert back == thing
