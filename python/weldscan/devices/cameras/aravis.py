"""GigE Vision and USB3 Vision cameras through Aravis (LGPL-2.1), by its GObject introspection.

`pip install weldscan[aravis]` gives PyGObject; the library itself comes from the system (Debian: gir1.2-aravis-0.8).
"""

from __future__ import annotations

import contextlib
import time
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from weldscan.devices.cameras import Camera, CameraSettings, TornFrame
from weldscan.errors import DeviceError, DeviceTimeout

BUFFERS = 4
FEATURE_WAIT_S = 0.25
"""A stream is looked at this often while a frame is awaited, so that a lost trigger is sent again."""


class AravisSettings(CameraSettings):
    """`[camera]` with `backend = "aravis"`."""

    backend: Literal["aravis"] = "aravis"
    device: str | None = None
    """Name or address as `weldscan camera list` shows it; absent: the first one."""
    pixel_format: Literal["Mono8", "Mono10", "Mono12", "Mono14", "Mono16"] = "Mono8"
    gain: float | None = None
    packet_size: int | None = None
    """Bytes; absent: as large as the network takes."""


def _library() -> Any:
    try:
        import gi  # noqa: PLC0415 - an extra

        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis, GLib  # noqa: PLC0415
    except (ImportError, ValueError) as error:
        raise DeviceError(
            f"camera: Aravis is not installed (weldscan[aravis] and gir1.2-aravis-0.8): {error}"
        ) from error
    return Aravis, GLib


class AravisCamera(Camera):
    """A GenICam camera that exposes when it is told to."""

    Settings = AravisSettings
    settings: AravisSettings

    def __init__(self, settings: AravisSettings) -> None:
        self.settings, self.streams = settings, settings.trigger == "hardware"
        self.name = f"camera {settings.device or 'aravis'}"
        self._bits = int(settings.pixel_format.removeprefix("Mono"))
        self._aravis, self._glib = _library()
        with self._errors("open"):
            self._camera = self._aravis.Camera.new(settings.device)
        with self._errors("set up"):
            camera = self._camera
            camera.stop_acquisition()
            camera.set_pixel_format_from_string(settings.pixel_format)
            if settings.width and settings.height:
                camera.set_region(0, 0, settings.width, settings.height)
            if settings.gain is not None:
                camera.set_gain(settings.gain)
            if camera.is_gv_device():
                if settings.packet_size:
                    camera.gv_set_packet_size(settings.packet_size)
                else:
                    camera.gv_auto_packet_size()
            camera.set_acquisition_mode(self._aravis.AcquisitionMode.CONTINUOUS)
            camera.set_trigger("Software" if settings.trigger == "software" else settings.trigger_line)
            self._begin()
        self.set_exposure(settings.exposure_s)

    @classmethod
    def available(cls) -> list[str]:
        """Return the names of the cameras on the network and on USB."""
        aravis, _ = _library()
        aravis.update_device_list()
        return [aravis.get_device_id(i) for i in range(aravis.get_n_devices())]

    def _begin(self) -> None:
        """Begin to acquire, into a stream of its own: what was under way to another arrives nowhere."""
        self._stream = self._camera.create_stream(None, None)
        payload = self._camera.get_payload()
        for _ in range(BUFFERS):
            self._stream.push_buffer(self._aravis.Buffer.new_allocate(payload))
        self._camera.start_acquisition()

    def _close(self) -> None:
        with contextlib.suppress(self._glib.Error):  # it may be gone already
            self._camera.stop_acquisition()
        self._stream = self._camera = None

    def _set_exposure(self, exposure_s: float) -> float:
        with self._errors("exposure"):
            self._camera.set_exposure_time(exposure_s * 1e6)
            return float(self._camera.get_exposure_time()) * 1e-6

    def _grab(self, deadline_s: float) -> NDArray[Any]:
        if self.streams:
            time.sleep(self.exposure_s + self.settings.transfer_s)  # what began before the question is here then
        while (old := self._stream.try_pop_buffer()) is not None:  # nobody asked for these
            self._stream.push_buffer(old)
        if not self.streams:
            with self._errors("trigger"):
                self._camera.software_trigger()
        return self._next(deadline_s)

    def _next(self, deadline_s: float) -> NDArray[Any]:
        buffer = self._next_buffer(deadline_s)
        try:
            status = buffer.get_status()
            if status != self._aravis.BufferStatus.SUCCESS:
                raise TornFrame(f"{self.name}: a frame with status {status.value_nick}")
            width, height = buffer.get_image_width(), buffer.get_image_height()
            kind = np.uint8 if self.settings.pixel_format == "Mono8" else np.uint16
            data = np.frombuffer(buffer.get_data(), kind)
            if data.size != width * height:
                raise TornFrame(f"{self.name}: {data.size} pixels for {width}x{height}")
            return data.reshape(height, width).copy()
        finally:
            self._stream.push_buffer(buffer)

    def _next_buffer(self, deadline_s: float) -> Any:
        wait_s = max(deadline_s - time.monotonic(), 0.001)
        if not self.streams:
            wait_s = min(wait_s, self.exposure_s + FEATURE_WAIT_S)
        buffer = self._stream.timeout_pop_buffer(int(wait_s * 1e6))
        if buffer is None:
            if not self.streams:  # a frame that comes late must not be the answer to the next question
                with self._errors("trigger anew"):
                    self._camera.stop_acquisition()
                    self._begin()
            if time.monotonic() < deadline_s:
                raise TornFrame(f"{self.name}: no frame after a trigger")
            why = "does the projector trigger it?" if self.streams else "is it unplugged?"
            raise DeviceTimeout(f"{self.name}: no frame: {why}")
        return buffer

    def _errors(self, what: str) -> _Errors:
        return _Errors(self.name, what, self._glib.Error)


class _Errors:
    """Turns GLib's errors into ours."""

    def __init__(self, name: str, what: str, kind: type[Exception]) -> None:
        self._name, self._what, self._kind = name, what, kind

    def __enter__(self) -> None:
        return

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, self._kind):
            raise DeviceError(f"{self._name}: {self._what}: {error}") from error
