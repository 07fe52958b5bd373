"""The configuration of a cell, `cell.toml`: which robot, camera and projector there are and how they are reached."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from weldscan.devices import BACKENDS, backend
from weldscan.devices.robots import Robot
from weldscan.errors import InputError
from weldscan.records.fields import explain
from weldscan.records.files import read_toml

M = TypeVar("M", bound=BaseModel)
SELECTOR = {"robot": "link", "camera": "backend", "projector": "backend"}
"""The field of a section that names its backend."""
DEFAULT = {"robot": "kvp"}
"""What a section is about that does not say."""


class CellConfig(BaseModel):
    """The sections of `cell.toml`; each is checked by the backend that it names when that is opened."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    name: str = "cell"
    robot: dict[str, Any] | None = None
    camera: dict[str, Any] | None = None
    projector: dict[str, Any] | None = None
    scan: dict[str, Any] = {}
    calibration: dict[str, Any] = {}
    """How `weldscan calibrate scanner --live` goes about it."""
    verification: dict[str, Any] | None = None
    """The limits of `weldscan verify`, which checks them."""
    _path: Path = Path("cell.toml")

    @property
    def path(self) -> Path:
        """Where it was read from; file names in it are relative to its folder."""
        return self._path

    def settings(self, kind: str) -> tuple[Any, BaseModel]:
        """Return the backend that a section names and its settings; file names in them are relative to the cell's own
        file.
        """
        section, selector = getattr(self, kind), SELECTOR[kind]
        if section is None:
            raise InputError(f"{self.path}: {kind}: missing")
        name = section.get(selector, DEFAULT.get(kind))
        if not isinstance(name, str) or name not in BACKENDS[kind]:
            complaint = "missing; one" if name is None else f"{name!r} is none"
            raise InputError(f"{self.path}: {kind}.{selector}: {complaint} of {', '.join(BACKENDS[kind])}")
        device = backend(kind, name)
        settings = check(section, device.Settings, f"{self.path}: {kind}")
        here = {name: self.path.parent / value for name, value in settings if isinstance(value, Path)}
        return device, settings.model_copy(update=here)

    def open(self, kind: str, **changes: Any) -> Any:
        """Open the cell's robot, camera or projector, with some of its settings changed."""
        device, settings = self.settings(kind)
        return device(settings.model_copy(update=changes))

    def open_robot(self) -> Robot:
        """Open the robot."""
        robot: Robot = self.open("robot")
        return robot


def read_cell(path: Path) -> CellConfig:
    """Read `cell.toml`; a wrong field is named in an `InputError`."""
    document = read_toml(path, "file; weldscan scan --example-config FOLDER writes a complete one")
    config = check(document, CellConfig, str(path))
    config._path = path
    return config


def check(section: Mapping[str, Any], model: type[M], where: str) -> M:
    """Return the section as its model, or name what is wrong in it."""
    try:
        return model.model_validate(section)
    except ValidationError as error:
        raise InputError(f"{where}: {explain(error)}") from None
