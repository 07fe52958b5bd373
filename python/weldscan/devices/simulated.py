"""The simulated cell, under the name that scripts know: `weldscan.simulated`."""

from importlib import import_module
from typing import Any


def __getattr__(name: str) -> Any:
    return getattr(import_module("weldscan.simulated"), name)
