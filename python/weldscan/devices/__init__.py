"""Projector, camera and robot: backends as siblings behind one face each, imported only when they are named."""

from __future__ import annotations

from importlib import import_module
from typing import Any

BACKENDS = {
    "robot": {
        "kvp": "devices.robots.kvp:KvpRobot",
        "eki": "devices.robots.eki:EkiRobot",
        "rsi": "devices.robots.rsi:RsiRobot",
        "serial": "devices.robots.serial:SerialRobot",
    },
    "controller": {
        "kvp": "simulated.controllers.kvp:KvpController",
        "eki": "simulated.controllers.eki:EkiController",
        "rsi": "simulated.controllers.rsi:RsiController",
        "serial": "simulated.controllers.serial:SerialController",
    },
    "camera": {
        "opencv": "devices.cameras.opencv:OpenCvCamera",
        "aravis": "devices.cameras.aravis:AravisCamera",
        "pylon": "devices.cameras.pylon:PylonCamera",
        "folder": "devices.folder:FolderCamera",
        "simulated": "simulated.camera_and_projector:VirtualCamera",
    },
    "projector": {
        "window": "devices.projectors.window:WindowProjector",
        "files": "devices.folder:FolderProjector",
        "simulated": "simulated.camera_and_projector:VirtualProjector",
    },
}


def backend(kind: str, name: str) -> Any:
    """Return the class of a backend. A device takes its own `Settings`, a controller takes an arm.

    >>> backend("robot", "kvp").__name__
    'KvpRobot'
    """
    module, attribute = BACKENDS[kind][name].split(":")
    return getattr(import_module(f"weldscan.{module}"), attribute)
