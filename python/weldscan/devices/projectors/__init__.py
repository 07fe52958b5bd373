"""One face for every projector. It is a display: nothing tells when a frame is on the wall, so that is measured once.

`latency_s` is from `show` to the light, as `weldscan devices check` measures it; `guard_frames` refreshes are waited on
top of it.
"""

from __future__ import annotations

import abc
from pathlib import Path
from types import TracebackType
from typing import Annotated, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from weldscan.errors import DeviceError, InputError
from weldscan.records.response import read_response

Pattern = NDArray[np.uint8]


class ProjectorSettings(BaseModel):
    """What every projector's section of a cell's configuration has."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    width: Annotated[int, Field(ge=1, le=16384)] = 1280
    height: Annotated[int, Field(ge=1, le=16384)] = 800
    refresh_hz: Annotated[float, Field(gt=0, le=2000)] = 60.0
    latency_s: Annotated[float, Field(ge=0, le=10)] = 0.1
    guard_frames: Annotated[int, Field(ge=0, le=100)] = 2
    response: Path | None = None
    """A response table of `weldscan devices check`; patterns are then corrected for it."""


class Projector(abc.ABC):
    """A projector that shows one image until the next."""

    Settings: ClassVar[type[ProjectorSettings]] = ProjectorSettings
    settings: ProjectorSettings
    name: str
    _correction: Pattern | None = None

    @abc.abstractmethod
    def _show(self, image: Pattern) -> float:
        """Show it, and return when that was asked for, on the monotonic clock."""

    @abc.abstractmethod
    def close(self) -> None:
        """Let go of the display."""

    @property
    def settle_s(self) -> float:
        """Seconds from `show` until the pattern is surely on the wall."""
        return self.settings.latency_s + self.settings.guard_frames / self.settings.refresh_hz

    def show(self, image: Pattern) -> float:
        """Show a (height, width) uint8 image of the projector's own size, pixel by pixel, linearised where a table
        is set.
        """
        size = self.settings.height, self.settings.width
        if image.shape != size or image.dtype != np.uint8:
            raise InputError(f"{self.name}: a pattern of {image.shape} {image.dtype}, not {size} uint8")
        if self.settings.response is not None:
            if self._correction is None:
                self._correction = correction(read_response(self.settings.response).table())
            image = self._correction[image]
        return self._show(np.ascontiguousarray(image))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def whole_refreshes(exposure_s: float, refresh_hz: float) -> float:
    """Return the exposure, rounded to a whole number of refreshes and at least one: else the image beats with the
    light.

    >>> round(whole_refreshes(0.03, 60.0), 6)
    0.033333
    """
    return max(round(exposure_s * refresh_hz), 1) / refresh_hz


def correction(response: NDArray[np.float64]) -> Pattern:
    """Return the level to show for each of the wanted 256: the nearest one of the inverse response."""
    wanted = np.arange(256) / 255
    right = np.clip(np.searchsorted(response, wanted), 1, 255)
    left_is_nearer = wanted - response[right - 1] <= response[right] - wanted
    return np.where(left_is_nearer, right - 1, right).astype(np.uint8)


class DisplayGone(DeviceError):
    """The projector's window or its display does not exist any more."""
