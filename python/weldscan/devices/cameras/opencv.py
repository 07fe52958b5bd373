"""Cameras behind OpenCV: V4L2 and UVC.

Such a camera streams whether asked or not, keeps frames in a queue, and takes its time to bring them over USB. What
began before the question is over and here after its exposure and its way (`transfer_s`); of that the queue holds some,
and the first frame behind those counts. Automatic exposure, gain and white balance are switched off and read back.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
from numpy.typing import NDArray
from pydantic import Field

from weldscan.devices.cameras import Camera, CameraSettings
from weldscan.errors import DeviceError, DeviceTimeout

cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # what is wrong is told by us, in one line
V4L2_UNIT_S = 1e-4
"""V4L2 counts exposure in 100 microseconds."""
AUTO_EXPOSURE_ON, AUTO_EXPOSURE_OFF = 3.0, 1.0
"""V4L2_EXPOSURE_APERTURE_PRIORITY and V4L2_EXPOSURE_MANUAL: some drivers take the second only after the first."""


class OpenCvSettings(CameraSettings):
    """`[camera]` with `backend = "opencv"`."""

    backend: Literal["opencv"] = "opencv"
    device: int | str = 0
    gain: float | None = None
    queue: Annotated[int, Field(ge=0, le=64)] = 4
    """Frames that the driver may hold; V4L2 takes 4 buffers unless told otherwise."""


class OpenCvCamera(Camera):
    """A V4L2 or UVC camera."""

    Settings = OpenCvSettings
    settings: OpenCvSettings
    streams = True

    def __init__(self, settings: OpenCvSettings) -> None:
        self.settings = settings
        self.name = f"camera {settings.device}"
        if settings.trigger == "hardware":
            raise DeviceError(f"{self.name}: V4L2 knows no hardware trigger")
        self._capture = cv2.VideoCapture(settings.device, cv2.CAP_V4L2)
        if not self._capture.isOpened():
            raise DeviceError(f"{self.name}: cannot be opened")
        try:
            if settings.width and settings.height:
                self._set("width", cv2.CAP_PROP_FRAME_WIDTH, settings.width)
                self._set("height", cv2.CAP_PROP_FRAME_HEIGHT, settings.height)
            self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # a wish; `queue` counts on nothing
            self._capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, AUTO_EXPOSURE_ON)
            self._set("auto exposure", cv2.CAP_PROP_AUTO_EXPOSURE, AUTO_EXPOSURE_OFF)
            self._capture.set(cv2.CAP_PROP_AUTO_WB, 0)  # grey cameras have none
            if settings.gain is not None:
                self._set("gain", cv2.CAP_PROP_GAIN, settings.gain)
            self.set_exposure(settings.exposure_s)
        except DeviceError:
            self.close()
            raise

    @classmethod
    def available(cls) -> list[str]:
        """Return the video devices of Linux."""
        return sorted(str(path) for path in Path("/dev").glob("video*"))

    def _close(self) -> None:
        self._capture.release()

    def _set(self, name: str, key: int, value: float) -> None:
        self._capture.set(key, value)
        actual = self._capture.get(key)
        if actual != value:
            raise DeviceError(f"{self.name}: {name} is {actual:g}, not {value:g}")

    def _set_exposure(self, exposure_s: float) -> float:
        self._capture.set(cv2.CAP_PROP_EXPOSURE, round(exposure_s / V4L2_UNIT_S))
        return float(self._capture.get(cv2.CAP_PROP_EXPOSURE)) * V4L2_UNIT_S

    def _grab(self, deadline_s: float) -> NDArray[Any]:
        time.sleep(self.exposure_s + self.settings.transfer_s)
        for _ in range(self.settings.queue):
            self._advance()
            if time.monotonic() > deadline_s:
                raise DeviceTimeout(f"{self.name}: no frame in time")
        return self._next(deadline_s)

    def _advance(self) -> None:
        if not self._capture.grab():  # which waits for 10 s, whatever the deadline: see `Camera._in_time`
            raise DeviceError(f"{self.name}: no frame: is it unplugged?")

    def _next(self, deadline_s: float) -> NDArray[Any]:
        self._advance()
        whole, image = self._capture.retrieve()
        if not whole or image is None:
            raise DeviceError(f"{self.name}: a frame that cannot be decoded")
        return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
