"""A masked array (`numpy.ma`) goes in nowhere with its mask lost: what it hides would count. Every public function,
every argument that is an array or holds some."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

import fuzz
import weldscan as ws
from catalogue import public
from weldscan.calibration.scanner import LEAST_FEATURES


def arrays(value: Any, rebuild: Callable[[Any], Any]) -> Iterator[Callable[[Any], Any]]:
    """For every array in an argument, lists of numbers included: from another array to the argument with it instead."""
    if isinstance(value, np.ndarray) and value.size:
        yield rebuild
    elif isinstance(value, list | tuple) and value:
        if all(isinstance(v, float | int) for v in value):
            yield rebuild
        for i, item in enumerate(value):
            yield from arrays(item, lambda new, i=i: rebuild(type(value)([*value[:i], new, *value[i + 1 :]])))


def masked(like: Any) -> np.ma.MaskedArray[Any, Any]:
    out = np.ma.masked_array(np.array(like), mask=False)
    out[(0,) * out.ndim] = np.ma.masked
    return out


def at(value: Any, rebuild: Callable[[Any], Any]) -> list[tuple[Any, Callable[[Any], Any]]]:
    """The arrays themselves beside what puts another in their place."""
    found: list[Any] = []
    places = list(arrays(value, lambda new: new))
    for place in places:
        # A mark tells which array it was.
        mark = object()
        found.append((_where(value, place(mark), mark), lambda new, place=place: rebuild(place(new))))
    return found


def _where(before: Any, after: Any, mark: object) -> Any:
    if after is mark:
        return before
    return next(_where(b, a, mark) for b, a in zip(before, after, strict=True) if a is not b)


def call(name: str, arguments: dict[str, Any]) -> Any:
    rest = dict(arguments)
    owner, _, method = name.partition(".")
    if method:
        return getattr(rest.pop("self"), method)(**rest)
    return getattr(ws, owner)(**rest)


@pytest.mark.parametrize("name", sorted(public()))
def test_a_function_of_the_core_refuses_a_mask(name):
    tried = 0
    for seed in range(40):
        arguments = fuzz.SANE[name](np.random.default_rng(seed))
        for key, value in arguments.items():
            for array, put in at(value, lambda new, key=key, arguments=arguments: {**arguments, key: new}):
                if name in {"set_threads", "decode_png"}:
                    continue
                with warnings.catch_warnings(), pytest.raises(ws.InputError, match="masked") as caught:
                    warnings.simplefilter("ignore")
                    call(name, put(masked(array)))
                assert "\n" not in str(caught.value)
                tried += 1
    without = {"set_threads", "decode_png", "Follower", "harmonics_of_gamma", "measure_step"}
    without |= {"WeldStep.column", "WeldStep.keys", "WeldStep.alone", "WeldStep.deviation_of"}
    assert (tried > 0) != (name in without)


def test_a_mask_that_hides_nothing_is_no_matter():
    points = np.random.default_rng(0).random((30, 3))
    whole = np.ma.masked_array(points, mask=False)
    assert ws.fit_plane(whole).rms_mm == ws.fit_plane(points).rms_mm
    assert ws.KdTree(whole).nearest(whole)[1].tolist() == list(range(30))


VIEW = ws.PlateView("a", np.eye(3) * 40, np.array([np.eye(3)] * 3), (0.0,) * 3, (99,) * 3)
GRID = np.c_[np.indices((5, 5)).reshape(2, -1).T * 10.0, np.zeros(25)]
SPHERE = fuzz.unit(np.random.default_rng(0), 60)
LEVEL = np.linspace(0, 255, 9)
IMAGES = list(np.full((4, 8, 8), 100, np.uint8))

PYTHON: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
    "compensate_phase": (lambda p: ws.compensate_phase(p, 3), (np.zeros((30, 30)),)),
    "compensate_phase mask": (lambda m: ws.compensate_phase(np.zeros((9, 9)), 3, mask=m), (np.ones((9, 9), bool),)),
    "estimate_response": (lambda *i: ws.estimate_response(list(i), [(8, 4)]), tuple(IMAGES)),
    "flatness_error": (ws.flatness_error, (GRID,)),
    "probing_error": (lambda p: ws.probing_error(p, 2.0), (SPHERE,)),
    "kuka_from_matrix": (ws.kuka_from_matrix, (np.eye(4),)),
    "paper_step": (lambda *a: ws.paper_step(*a, 1.0), (SPHERE, np.zeros(3), np.array([0.0, 0.0, 1.0]))),
    "response_of_ramp": (ws.response_of_ramp, (LEVEL, LEVEL)),
    "solve_hand_eye": (lambda pose, touched: ws.solve_hand_eye([VIEW], [pose], touched), (np.eye(4), np.eye(3) * 40)),
    "solve_hand_eye views": (
        lambda c, u: ws.solve_hand_eye([ws.PlateView("a", c, u, (0.0,) * 3, (9,) * 3)], [np.eye(4)], None),
        (np.eye(3) * 40, np.array([np.eye(3)] * 3)),
    ),
    "solve_scanner": (
        lambda *a: ws.solve_scanner([ws.BoardView(str(i), *a) for i in range(3)], (640, 480), (640, 480)),
        (GRID, GRID[:, :2], GRID[:, :2]),
    ),
    "find_plate": (lambda p: ws.find_plate("a", p, 20.0, None, np.eye(4)), (np.zeros((9, 9, 3)),)),
}


@pytest.mark.parametrize("name", PYTHON)
def test_a_function_of_the_package_refuses_a_mask(name):
    function, arguments = PYTHON[name]
    assert len(GRID) >= LEAST_FEATURES
    for i, array in enumerate(arguments):
        with pytest.raises(ws.InputError, match="masked"):
            function(*arguments[:i], masked(array), *arguments[i + 1 :])
