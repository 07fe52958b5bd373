"""`weldscan devices check`: what cannot be looked up is measured - latency, response, and where the image is of no
use.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from weldscan.calibration.response import response_of_ramp
from weldscan.devices.cameras import Camera, Frame, Image
from weldscan.devices.projectors import Projector
from weldscan.devices.projectors.patterns import flat_pattern
from weldscan.errors import DeviceError, DeviceTimeout
from weldscan.records.files import write_file
from weldscan.records.images import encode_png
from weldscan.records.response import Response
from weldscan.station.capture import set_exposure

LONGEST_LATENCY_S = 2.0
REST_S = 0.3
"""Before each ramp, on top of the configured latency, which may be wrong."""
ARRIVED = 0.95
"""Of the way from black to white: a frame that began before the switch has less."""
LEAST_CONTRAST = 0.05
"""Of full scale: below it the camera does not see the projector."""


@dataclass(frozen=True)
class Pixels:
    """Shares of the camera's image."""

    saturated: float
    """At full scale in white."""
    dark: float
    """Hardly brighter in white than in black."""


def latency_s(camera: Camera, projector: Projector, repeats: int = 5) -> tuple[float, ...]:
    """Return, per repeat, seconds from `show` until a frame had begun for certain that shows nothing of the pattern
    before: its exposure was over when the frame was there. Never too short, however late the machine is.
    """
    black, white = _flats(camera, projector)
    low, high = float(black.mean()), float(white.mean())
    if high - low < LEAST_CONTRAST * camera.full_scale:
        raise DeviceError(f"{camera.name} does not see {projector.name}: black {low:.1f}, white {high:.1f}")
    found = []
    for _ in range(repeats):
        _show(projector, 0, REST_S)
        shown_s = projector.show(_flat(projector, 255))
        while True:
            if time.monotonic() - shown_s > LONGEST_LATENCY_S:
                raise DeviceTimeout(f"{projector.name}: no white within {LONGEST_LATENCY_S:g} s")
            frame = camera.capture()
            if frame.image.mean() >= low + ARRIVED * (high - low):
                found.append(max(frame.time_s - camera.exposure_s - shown_s, 0.0))
                break
    return tuple(found)


def transfer_s(camera: Camera, projector: Projector, repeats: int = 5) -> tuple[float, ...]:
    """Return, per repeat, seconds from `show` until the first frame of a camera that streams shows anything of the new
    pattern: such a frame was under way for no longer than that. The projector's latency is in it, so never too short.
    """
    black, white = _flats(camera, projector)
    seen = float(black.mean()) + (1 - ARRIVED) * (float(white.mean()) - float(black.mean()))
    found = []
    for _ in range(repeats):
        _show(projector, 0, REST_S)
        camera.capture()  # nothing from before is in the queue
        shown_s = projector.show(_flat(projector, 255))
        while (frame := camera.next_frame()).image.mean() < seen:
            if frame.time_s - shown_s > LONGEST_LATENCY_S:
                raise DeviceTimeout(f"{projector.name}: no white within {LONGEST_LATENCY_S:g} s")
        found.append(frame.time_s - shown_s)
    return tuple(found)


def response(
    camera: Camera, projector: Projector, levels: int = 18, frames: int = 3, keep: Path | None = None
) -> Response:
    """Return the response: the light that the camera sees at levels from 0 to 255.

    An image of each level is left in the folder `keep`, for `weldscan calibrate response`.
    """
    black, white = _flats(camera, projector)
    top = camera.full_scale
    lit = (white < top) & (white.astype(np.int64) - black > LEAST_CONTRAST * top)
    if not lit.any():
        raise DeviceError(f"{camera.name}: no pixel is lit and unsaturated; change the exposure")
    shown = np.unique(np.rint(np.linspace(0, 255, levels)).astype(int))
    light = []
    for level in shown:
        _show(projector, int(level))
        images = [camera.capture().image for _ in range(frames)]
        light.append(float(np.mean([image[lit].mean() for image in images])))
        if keep is not None:
            write_file(keep / f"ramp_{level:03d}.png", encode_png(images[0]))
    return response_of_ramp(shown, light)


def gamma(response: Response) -> float:
    """Return the exponent of the power law that fits a response best: 1 is linear."""
    return response.gamma


def pixels(camera: Camera, projector: Projector) -> Pixels:
    """Return which share of the image is saturated or dark."""
    black, white = _flats(camera, projector)
    top = camera.full_scale
    return Pixels(
        saturated=float((white >= top).mean()),
        dark=float((white.astype(np.int64) - black <= LEAST_CONTRAST * top).mean()),
    )


def overlay(frame: Frame, least: float = LEAST_CONTRAST) -> NDArray[np.uint8]:
    """Return a BGR picture for the operator: saturated pixels red, dark ones blue."""
    image, top = frame.image, frame.full_scale
    grey = np.asarray(image / (top / 255), dtype=np.uint8)
    picture = np.repeat(grey[:, :, None], 3, axis=2)
    picture[image >= top] = (0, 0, 255)
    picture[image <= least * top] = (160, 0, 0)
    return picture


def prepare(camera: Camera, projector: Projector) -> float:
    """Set the camera's exposure to a whole number of refreshes and return it."""
    return set_exposure(camera, projector, camera.settings.exposure_s)


def _flat(projector: Projector, level: int) -> NDArray[np.uint8]:
    return flat_pattern(level, projector.settings.width, projector.settings.height)


def _show(projector: Projector, level: int, rest_s: float = 0.0) -> None:
    projector.show(_flat(projector, level))
    time.sleep(projector.settle_s + rest_s)


def _flats(camera: Camera, projector: Projector) -> tuple[Image, Image]:
    images = []
    for level in (0, 255):
        _show(projector, level, REST_S)
        images.append(camera.capture().image)
    return images[0], images[1]
