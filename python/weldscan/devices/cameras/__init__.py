"""One face for every camera: an exposure that began after the question, whole and of the right size, or a typed
error.
"""

from __future__ import annotations

import abc
import contextlib
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from types import TracebackType
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from weldscan.errors import DeviceError, DeviceTimeout

Image = NDArray[np.uint8] | NDArray[np.uint16]
T = TypeVar("T")
GRACE_S = 0.25
"""Beyond the deadline, so that a driver's own complaint is heard first."""
CLOSE_S = 2.0
BITS = (8, 10, 12, 14, 16)
"""That a camera's numbers may have. Beyond 8 they come in words of 16."""
EXPOSURE_TOLERANCE = 0.02
"""How far the exposure that was read back may be from the wanted one; cameras count lines or microseconds."""


class TornFrame(DeviceError):
    """Parts of a frame were lost on their way; another exposure may be better."""


class CameraSettings(BaseModel):
    """What every camera's section of a cell's configuration has."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    exposure_s: Annotated[float, Field(gt=0, le=60)] = 1 / 30
    timeout_s: Annotated[float, Field(gt=0, le=600)] = 2.0
    """For one frame, on top of its exposure, retries included."""
    retries: Annotated[int, Field(ge=0, le=100)] = 10
    """Further exposures after a torn frame."""
    trigger: Literal["software", "hardware"] = "software"
    """hardware: the camera exposes on its trigger input, which the projector drives with every refresh."""
    trigger_line: str = "Line1"
    """The camera's name of that input."""
    transfer_s: Annotated[float, Field(ge=0, le=10)] = 0.1
    """Of a camera that exposes without being asked (V4L2, hardware trigger): from the end of an exposure until its
    frame is here, at most; `weldscan devices check` measures it."""
    bits: Literal[8, 10, 12, 14, 16] | None = None
    """Of the camera's numbers; absent: as its pixel format says."""
    width: Annotated[int, Field(ge=1)] | None = None
    height: Annotated[int, Field(ge=1)] | None = None
    """The size that every frame must have; absent: that of the first frame."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One exposure."""

    image: Image
    """(height, width), grey."""
    time_s: float
    """When it was there, on this computer's monotonic clock."""
    retries: int
    """Torn frames before it."""
    full_scale: int
    """The largest number that the camera can give: 4095 for 12 bits, though they come in words of 16."""


class Camera(abc.ABC):
    """A camera whose exposure, gain and offset stay what they were set to."""

    Settings: ClassVar[type[CameraSettings]] = CameraSettings
    settings: CameraSettings
    name: str
    exposure_s: float = 0.0
    streams: bool = False
    """Whether it exposes without being asked: see `next_frame`."""
    _bits: int | None = None
    """As the pixel format says."""
    _used: int = 0
    """The bits that were set in any frame so far."""
    _size: tuple[int, int] | None = None
    _thread: ThreadPoolExecutor | None = None

    @classmethod
    def available(cls) -> list[str]:
        """Return the names of the cameras that this backend sees."""
        return []

    @abc.abstractmethod
    def _set_exposure(self, exposure_s: float) -> float:
        """Set it, and return what the camera then says it is."""

    @abc.abstractmethod
    def _grab(self, deadline_s: float) -> NDArray[Any]:
        """Return one exposure that began after the call; `TornFrame` where parts of it are missing."""

    def _next(self, deadline_s: float) -> NDArray[Any]:
        """Return the next exposure as it comes, whenever it began; only where the camera streams."""
        raise NotImplementedError

    @abc.abstractmethod
    def _close(self) -> None:
        """Let go of the camera."""

    def close(self) -> None:
        """Let go of the camera; one that does not answer is not waited for."""
        closing = self._own_thread().submit(self._close)
        self._own_thread().shutdown(wait=False)
        self._thread = None
        with contextlib.suppress(TimeoutError):
            closing.result(CLOSE_S)

    def set_exposure(self, exposure_s: float) -> float:
        """Set the exposure time and return what was read back. Raises `DeviceError` where the camera does otherwise."""
        actual = self._in_time(time.monotonic() + self.settings.timeout_s, lambda: self._set_exposure(exposure_s))
        if not abs(actual - exposure_s) <= EXPOSURE_TOLERANCE * exposure_s:
            raise DeviceError(f"{self.name}: exposure is {actual * 1000:g} ms, not {exposure_s * 1000:g} ms")
        self.exposure_s = actual
        return actual

    def prepare(self) -> None:  # noqa: B027 - most cameras have nothing to prepare
        """Told when the robot has come to where the next frames are taken: what takes time may begin."""

    def capture(self) -> Frame:
        """Return one whole frame whose exposure began after the call."""
        give_up_s = time.monotonic() + self.settings.timeout_s + self.exposure_s
        for attempt in range(self.settings.retries + 1):
            try:
                image = self._checked(self._in_time(give_up_s, lambda: self._grab(give_up_s)))
                return Frame(image, time.monotonic(), attempt, self.full_scale)
            except TornFrame as error:
                if time.monotonic() > give_up_s:
                    raise DeviceTimeout(f"{self.name}: only torn frames, {attempt + 1} of them") from error
        raise DeviceError(f"{self.name}: {self.settings.retries + 1} torn frames in a row")

    def next_frame(self) -> Frame:
        """Return the next frame of a camera that streams: it may have begun long before the call."""
        give_up_s = time.monotonic() + self.settings.timeout_s + self.exposure_s
        image = self._checked(self._in_time(give_up_s, lambda: self._next(give_up_s)))
        return Frame(image, time.monotonic(), 0, self.full_scale)

    @property
    def full_scale(self) -> int:
        """The largest number that the camera can give.

        Where neither the configuration nor the pixel format says it: the narrowest of 8, 10, 12, 14 and 16 bits that
        holds every number so far, after a shift by the low bits that are always zero.
        """
        if bits := self.settings.bits or self._bits:
            return int(2**bits) - 1
        shift = (self._used & -self._used).bit_length() - 1 if self._used else 0
        used = self._used.bit_length() - shift
        full = int(2 ** next(bits for bits in BITS if used <= bits)) - 1
        return min(full << shift, int(2 ** BITS[-1]) - 1)

    def _in_time(self, deadline_s: float, call: Callable[[], T]) -> T:
        """Let a thread of the camera's own do it: a driver that is deaf to everything does not hold us up."""
        doing = self._own_thread().submit(call)
        try:
            return doing.result(max(deadline_s - time.monotonic(), 0.0) + GRACE_S)
        except DeviceError:
            raise  # a `DeviceTimeout` is a `TimeoutError` too
        except TimeoutError:
            doing.cancel()  # where an earlier one is still under way
            raise DeviceTimeout(f"{self.name}: does not answer: is it unplugged?") from None

    def _own_thread(self) -> ThreadPoolExecutor:
        if self._thread is None:
            self._thread = ThreadPoolExecutor(1, "camera")
        return self._thread

    def _checked(self, image: NDArray[Any]) -> Image:
        if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16) or 0 in image.shape:
            raise DeviceError(f"{self.name}: a frame {image.shape} {image.dtype} is no grey image")
        size = image.shape[1], image.shape[0]
        wanted = self._size or (self.settings.width or size[0], self.settings.height or size[1])
        if size != wanted:
            raise DeviceError(f"{self.name}: a frame of {size[0]}x{size[1]}, not {wanted[0]}x{wanted[1]} pixels")
        self._size = size
        if image.dtype == np.uint8:
            self._bits = BITS[0]
        else:
            self._used |= int(np.bitwise_or.reduce(image, axis=None))
        if image.max() > self.full_scale:
            raise DeviceError(
                f"{self.name}: a frame holds {image.max()}, beyond the full scale of {self.full_scale}: correct "
                "camera.bits or camera.pixel_format"
            )
        return image

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
