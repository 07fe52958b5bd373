"""Every public name explains itself, and what its examples say is what happens."""

from __future__ import annotations

import doctest
import inspect
import io

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
    names = {name: getattr(weldscan, name) for name in weldscan.__all__} | {"weldscan": weldscan}
    return [parser.get_doctest(text, dict(names), title, None, 0) for title, text in docs.items()]


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
