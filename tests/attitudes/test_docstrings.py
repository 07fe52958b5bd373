"""Every public name explains itself, and what its examples say is what happens."""

from __future__ import annotations

import doctest
import inspect
import io
import subprocess
import sys
from importlib import import_module

import pytest

import weldscan


def examples(name: str) -> list[doctest.DocTest]:
    """Of the object and, if it is a class, of its public methods; of built-in ones too, unlike doctest's own finder."""
    thing = getattr(weldscan, name)
    docs = {name: inspect.getdoc(thing) or ""}
    if inspect.isclass(thing):
        for member, value in vars(thing).items():
            if not member.startswith("_") and getattr(value, "__doc__", None):
                docs[f"{name}.{member}"] = inspect.cleandoc(value.__doc__)
    parser = doctest.DocTestParser()
    # In a fresh namespace: whoever copies an example has nothing but what it imports.
    return [parser.get_doctest(text, {}, title, None, 0) for title, text in docs.items()]


@pytest.mark.parametrize("name", weldscan.__all__)
def test_examples_run(name):
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    for test in examples(name):
        said = io.StringIO()
        result = runner.run(test, out=said.write)
        assert result.failed == 0, said.getvalue()


@pytest.mark.parametrize("name", weldscan.__all__)
def test_every_public_name_is_explained(name):
    thing = getattr(weldscan, name)
    if isinstance(thing, str):
        return
    first = (inspect.getdoc(thing) or "").split("\n")[0]
    assert len(first) > 10, f"{name} has no docstring"


def test_all_is_what_is_there():
    assert weldscan.__all__ == sorted(weldscan.__all__)
    assert set(weldscan.__all__) <= set(dir(weldscan)) | set(sum(weldscan._LAZY.values(), ()))
    assert not [name for name in weldscan.__all__ if not hasattr(weldscan, name)]


ROOMS = ("clouds", "fringes", "scanner", "surfaces", "weld")
OUTSIDE = {"SimulatedShot", "simulate_shot", "simulated_step", "set_threads", "__version__"}
"""What belongs to no room of the measurement."""


def test_every_algorithm_is_in_the_room_of_its_subject():
    lazy = set(sum(weldscan._LAZY.values(), ()))
    rooms = [import_module(f"weldscan.{room}") for room in ROOMS]
    assert {name for room in rooms for name in room.__all__} >= set(weldscan.__all__) - lazy - OUTSIDE
    for room in rooms:
        assert room.__all__ == sorted(room.__all__) and getattr(weldscan, room.__name__.rpartition(".")[2]) is room
        for name in room.__all__:
            assert getattr(room, name) is getattr(weldscan, name, getattr(room, name))
        with pytest.raises(AttributeError, match="no attribute 'nothing'"):
            _ = room.nothing


def test_a_room_is_entered_without_what_only_documents_need():
    script = "import sys, weldscan.fringes, weldscan.scanner, weldscan.weld; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert not {"pydantic", "cv2", "typer"} & set(done.stdout.split())
