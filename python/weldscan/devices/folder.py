"""Files in place of devices: a camera that plays a folder of images, a projector that writes what it is shown."""

from __future__ import annotations

import time
from itertools import cycle
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from weldscan.devices.cameras import Camera, CameraSettings
from weldscan.devices.projectors import Projector, ProjectorSettings
from weldscan.errors import DeviceError, DeviceTimeout, InputError
from weldscan.records.files import read_bytes, write_file
from weldscan.records.images import MAX_IMAGE_BYTES, encode_png


class FolderCameraSettings(CameraSettings):
    """`[camera]` with `backend = "folder"`."""

    backend: Literal["folder"] = "folder"
    folder: Path
    repeat: bool = False
    """Begin again after the last image."""


class FolderCamera(Camera):
    """Gives the PNG images of a folder, sorted by name, one after the other."""

    Settings = FolderCameraSettings
    settings: FolderCameraSettings

    def __init__(self, settings: FolderCameraSettings) -> None:
        self.settings = settings
        self.name = f"camera {settings.folder}"
        files = sorted(settings.folder.glob("*.png"))
        if not files:
            raise DeviceError(f"{self.name}: no PNG images there")
        self._files = cycle(files) if settings.repeat else iter(files)
        self.set_exposure(settings.exposure_s)

    def _close(self) -> None:
        """Nothing is open."""

    def _set_exposure(self, exposure_s: float) -> float:
        return exposure_s

    def _grab(self, deadline_s: float) -> NDArray[Any]:
        path = next(self._files, None)
        if path is None:
            raise DeviceTimeout(f"{self.name}: no image left")
        try:
            image = cv2.imdecode(np.frombuffer(read_bytes(path, MAX_IMAGE_BYTES), np.uint8), cv2.IMREAD_UNCHANGED)
        except InputError as error:
            raise DeviceError(str(error)) from error
        except cv2.error as error:
            raise DeviceError(f"{path}: cannot be read: {error}") from error
        if image is None:
            raise DeviceError(f"{path}: not an image")
        return image


class FolderProjectorSettings(ProjectorSettings):
    """`[projector]` with `backend = "files"`."""

    backend: Literal["files"] = "files"
    folder: Path


class FolderProjector(Projector):
    """Writes every pattern as `000.png`, `001.png` ..., for a projector that plays stored images."""

    Settings = FolderProjectorSettings
    settings: FolderProjectorSettings

    def __init__(self, settings: FolderProjectorSettings) -> None:
        self.settings = settings
        self.name = f"projector {settings.folder}"
        self._count = 0
        try:
            settings.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DeviceError(f"{self.name}: {error.strerror or error}") from error

    def close(self) -> None:
        """Nothing is open."""

    def _show(self, image: NDArray[np.uint8]) -> float:
        path = self.settings.folder / f"{self._count:03d}.png"
        try:
            write_file(path, encode_png(image))
        except InputError as error:
            raise DeviceError(str(error)) from error
        self._count += 1
        return time.monotonic()
