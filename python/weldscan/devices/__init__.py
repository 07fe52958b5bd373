"""Projector, camera and robot: backends as siblings behind one face each, imported only when they are named."""

from __future__ import annotations

from importlib import import_module
from typing import Any

BACKENDS = {
    "robot": {
        "kvp": "kvp:KvpRobot",
        "eki": "eki:EkiRobot",
        "rsi": "rsi:RsiRobot",
        "serial": "serial:SerialRobot",
    },
    "controller": {
        "kvp": "kvp:KvpController",
        "eki": "eki:EkiController",
        "rsi": "rsi:RsiController",
        "serial": "serial:SerialController",
    },
    "camera": {
        "opencv": "opencv:OpenCvCamera",
        "aravis": "aravis:AravisCamera",
        "pylon": "pylon:PylonCamera",
        "folder": "folder:FolderCamera",
        "simulated": "virtual:VirtualCamera",
    },
    "projector": {
        "window": "window:WindowProjector",
        "files": "folder:FolderProjector",
        "simulated": "virtual:VirtualProjector",
    },
}


def backend(kind: str, name: str) -> Any:
    """Return the class of a backend. A device takes its own `Settings`, a controller takes an arm.

    >>> backend("robot", "kvp").__name__
    'KvpRobot'
    """
    module, attribute = BACKENDS[kind][name].split(":")
    return getattr(import_module(f"{__name__}.{module}"), attribute)
