"""Basler cameras through pypylon (extra `[pylon]`); with PYLON_CAMEMU=1 its emulated camera, too."""

from __future__ import annotations

import time
import warnings
from typing import Any, Literal

from numpy.typing import NDArray
from pydantic import Field

from weldscan.devices.cameras import Camera, CameraSettings, TornFrame
from weldscan.errors import DeviceError, DeviceTimeout


class PylonSettings(CameraSettings):
    """`[camera]` with `backend = "pylon"`."""

    backend: Literal["pylon"] = "pylon"
    serial_number: str | None = None
    """Absent: the first camera."""
    pixel_format: Literal["Mono8", "Mono10", "Mono12", "Mono14", "Mono16"] = "Mono8"
    features: dict[str, bool | int | float | str] = Field(default_factory=dict)
    """Further GenICam features to set, in this order, each read back."""


def _library() -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of SWIG's; turned into errors they crash the interpreter
            from pypylon import genicam, pylon  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise DeviceError(f"camera: pypylon is not installed (weldscan[pylon]): {error}") from error
    return pylon, genicam


class PylonCamera(Camera):
    """A Basler camera that exposes when it is told to."""

    Settings = PylonSettings
    settings: PylonSettings

    def __init__(self, settings: PylonSettings) -> None:
        self.settings, self.streams = settings, settings.trigger == "hardware"
        self.name = f"camera {settings.serial_number or 'pylon'}"
        self._bits = int(settings.pixel_format.removeprefix("Mono"))
        self._pylon, self._genicam = _library()
        pylon = self._pylon
        try:
            factory = pylon.TlFactory.GetInstance()
            if settings.serial_number is None:
                device = factory.CreateFirstDevice()
            else:
                wanted = pylon.DeviceInfo()
                wanted.SetSerialNumber(settings.serial_number)
                device = factory.CreateDevice(wanted)
            self._camera = pylon.InstantCamera(device)
            self._camera.Open()
            for name, value in {"PixelFormat": settings.pixel_format, **settings.features}.items():
                self._feature(name, value)
            if settings.width and settings.height:
                self._feature("Width", settings.width)
                self._feature("Height", settings.height)
            self._feature("TriggerSelector", "FrameStart")
            self._feature("TriggerSource", "Software" if settings.trigger == "software" else settings.trigger_line)
            self._feature("TriggerMode", "On")
            self.set_exposure(settings.exposure_s)
            self._camera.StartGrabbing(pylon.GrabStrategy_OneByOne)
        except self._genicam.GenericException as error:
            raise DeviceError(f"{self.name}: {_first_line(error)}") from error

    @classmethod
    def available(cls) -> list[str]:
        """Return the serial numbers of the cameras that pylon sees."""
        pylon, _ = _library()
        return [info.GetSerialNumber() for info in pylon.TlFactory.GetInstance().EnumerateDevices()]

    def _close(self) -> None:
        try:
            self._camera.StopGrabbing()
            self._camera.Close()
        except self._genicam.GenericException:
            pass  # it is gone already

    def _feature(self, name: str, value: bool | int | float | str) -> None:
        node = self._camera.GetNodeMap().GetNode(name)
        if node is None:
            raise DeviceError(f"{self.name}: no feature {name}")
        node.SetValue(value)
        if node.GetValue() != value:
            raise DeviceError(f"{self.name}: {name} is {node.GetValue()}, not {value}")

    def _set_exposure(self, exposure_s: float) -> float:
        nodes = self._camera.GetNodeMap()
        node = nodes.GetNode("ExposureTime") or nodes.GetNode("ExposureTimeAbs")
        try:
            node.SetValue(exposure_s * 1e6)
            return float(node.GetValue()) * 1e-6
        except self._genicam.GenericException as error:
            raise DeviceError(f"{self.name}: exposure: {_first_line(error)}") from error

    def _retrieve(self, deadline_s: float) -> Any:
        wait_ms = int(max(deadline_s - time.monotonic(), 0.001) * 1000)
        return self._camera.RetrieveResult(wait_ms, self._pylon.TimeoutHandling_ThrowException)

    def _grab(self, deadline_s: float) -> NDArray[Any]:
        pylon = self._pylon
        if self.streams:
            time.sleep(self.exposure_s + self.settings.transfer_s)  # what began before the question is here then
        try:
            while (old := self._camera.RetrieveResult(0, pylon.TimeoutHandling_Return)).IsValid():
                old.Release()  # nobody asked for these
            if not self.streams:
                wait_ms = int(max(deadline_s - time.monotonic(), 0.001) * 1000)
                self._camera.WaitForFrameTriggerReady(wait_ms, pylon.TimeoutHandling_ThrowException)
                self._camera.ExecuteSoftwareTrigger()
        except self._genicam.GenericException as error:
            raise DeviceError(f"{self.name}: {_first_line(error)}") from error
        return self._next(deadline_s)

    def _next(self, deadline_s: float) -> NDArray[Any]:
        try:
            with self._retrieve(deadline_s) as result:
                if not result.GrabSucceeded():
                    raise TornFrame(f"{self.name}: {result.GetErrorDescription()}")
                image: NDArray[Any] = result.GetArray()
                return image.copy()
        except self._genicam.TimeoutException as error:
            self._camera.StopGrabbing()  # a frame that comes late must not be the answer to the next question
            self._camera.StartGrabbing(self._pylon.GrabStrategy_OneByOne)
            raise DeviceTimeout(f"{self.name}: no frame in time") from error
        except self._genicam.GenericException as error:
            raise DeviceError(f"{self.name}: {_first_line(error)}") from error


def _first_line(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__
