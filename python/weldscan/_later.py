"""Names that a module gives without importing what they stand in before somebody asks."""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import Any


def later(module: str, names: "Mapping[str, tuple[str, ...]]") -> "Callable[[str], Any]":
    """Return the `__getattr__` of a module whose names stand elsewhere.

    Args:
        module: the module's name.
        names: by the module that they stand in.
    """

    def get(name: str) -> "Any":
        from importlib import import_module

        for home, held in names.items():
            if name in held:
                return getattr(import_module(home), name)
        raise AttributeError(f"module {module!r} has no attribute {name!r}")

    return get
