"""The simulated cell as devices: a camera that sees what the simulated projector shows, from where the robot stands.

Camera and projector are two halves of one scanner, so they share what is on the wall (`_WALL`). Where the scanner is,
the camera asks the simulated controller, as it would be known to the light: `controller` is a robot link of its own.

Time is as in a real cell: a pattern stands from the projector's next refresh on, a frame takes its exposure, and one
that began too early shows the pattern before, or something of both. What a pose shows is computed once, for all
patterns.
"""

from __future__ import annotations

import math
import time
import zlib
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from weldscan.devices import BACKENDS, backend
from weldscan.devices.cameras import Camera, CameraSettings
from weldscan.devices.projectors import Projector, ProjectorSettings
from weldscan.devices.projectors.patterns import fringe_patterns
from weldscan.errors import DeviceError, InputError
from weldscan.records.fields import explain
from weldscan.simulated import DEFAULT, BoardCell, Cell, render

_WALL: list[tuple[float, NDArray[np.uint8]]] = []
"""The last images of the one simulated projector of this process, and since when each stands (monotonic clock)."""
_REMEMBERED = 4


class VirtualProjectorSettings(ProjectorSettings):
    """`[projector]` with `backend = "simulated"`."""

    backend: Literal["simulated"] = "simulated"
    latency_s: Annotated[float, Field(ge=0, le=10)] = 0.0
    guard_frames: Annotated[int, Field(ge=0, le=100)] = 1
    """The next refresh is never further away."""


class VirtualProjector(Projector):
    """Light in the simulated cell."""

    Settings = VirtualProjectorSettings
    settings: VirtualProjectorSettings

    def __init__(self, settings: VirtualProjectorSettings) -> None:
        self.settings = settings
        self.name = "simulated projector"

    def close(self) -> None:
        """Switch it off."""
        _WALL.clear()

    def _show(self, image: NDArray[np.uint8]) -> float:
        asked_s, hz = time.monotonic(), self.settings.refresh_hz
        _WALL[:] = [*_WALL[1 - _REMEMBERED :], ((math.floor(asked_s * hz) + 1) / hz, image)]
        return asked_s


def _lit(began_s: float, ended_s: float) -> list[tuple[NDArray[np.uint8] | None, float]]:
    """Each image that stood during an exposure, None being darkness, and its share of it."""
    stood = [(-math.inf, None), *_WALL]
    until = [*(since_s for since_s, _ in _WALL), math.inf]
    shares = [
        (image, (min(ended_s, to_s) - max(began_s, since_s)) / (ended_s - began_s))
        for (since_s, image), to_s in zip(stood, until, strict=True)
    ]
    return [(image, share) for image, share in shares if share > 0]


class VirtualCameraSettings(CameraSettings):
    """`[camera]` with `backend = "simulated"`."""

    backend: Literal["simulated"] = "simulated"
    timeout_s: Annotated[float, Field(gt=0, le=600)] = 120.0
    """Rendering takes seconds where others compute as well."""
    controller: dict[str, Any] = Field(default_factory=dict)
    """A robot section: the simulated controller that carries this camera; empty: it stands at the first part pose."""
    nominal_exposure_s: Annotated[float, Field(gt=0)] = 1 / 30
    """The exposure that the simulated cell is lit for."""
    board: Annotated[str | None, Field(pattern=r"^\d+x\d+:\d+(\.\d+)?mm$")] = None
    """A chessboard lies in the cell, `9x13:10mm`: inner corners and square. Without a controller somebody moves it on
    after every whole stack of fringes."""
    cell: Any = None
    """A `weldscan.simulated.Cell`, where a program makes the configuration; absent: the demo's."""


class VirtualCamera(Camera):
    """A camera in the simulated cell."""

    Settings = VirtualCameraSettings
    settings: VirtualCameraSettings

    def __init__(self, settings: VirtualCameraSettings) -> None:
        cell: Cell = DEFAULT if settings.cell is None else settings.cell
        if settings.board is not None:
            size, square = settings.board.removesuffix("mm").split(":")
            columns, rows = map(int, size.split("x"))
            cell = BoardCell(corners=(columns, rows), square_mm=float(square))
        self._stacks = 0
        self.settings, self.cell = settings, cell
        self.name = "simulated camera"
        self._patterns = list(
            fringe_patterns(cell.fringes, cell.scanner.projector.width, cell.scanner.projector.height)
        )
        self._robot: Any = None
        if settings.controller:
            link = settings.controller.get("link", "kvp")
            if not isinstance(link, str) or link not in BACKENDS["robot"]:
                raise InputError(f"camera.controller.link: {link!r} is none of {', '.join(BACKENDS['robot'])}")
            robot = backend("robot", link)
            try:
                self._robot = robot(robot.Settings.model_validate(settings.controller))
            except ValidationError as error:
                raise InputError(f"camera.controller: {explain(error)}") from None
        self._seen: tuple[Any, ...] = ()
        self._rendered: Any = None
        self.set_exposure(settings.exposure_s)

    @classmethod
    def available(cls) -> list[str]:
        """There is always one."""
        return ["the demo's cell"]

    def _close(self) -> None:
        if self._robot is not None:
            self._robot.close()

    def _set_exposure(self, exposure_s: float) -> float:
        return exposure_s

    def prepare(self) -> None:
        """Begin to compute what is seen from here; what goes wrong with it is told by the next question."""
        self._own_thread().submit(self._render)

    def _grab(self, deadline_s: float) -> NDArray[Any]:
        began_s = time.monotonic()
        time.sleep(self.exposure_s)
        seen = [(share, self._see(image)) for image, share in _lit(began_s, began_s + self.exposure_s)]
        if len(seen) == 1:
            return seen[0][1]
        mixed: NDArray[Any] = np.rint(sum(share * image for share, image in seen)).astype(seen[0][1].dtype)
        return mixed

    def _see(self, shown: NDArray[np.uint8] | None) -> NDArray[Any]:
        """What the whole exposure shows of an image on the wall."""
        lens = self.cell.scanner.camera
        if shown is None:
            return np.zeros((lens.height, lens.width), np.uint8)
        shot = self._render()
        for index, pattern in enumerate(self._patterns):
            if shown.shape == pattern.shape and np.array_equal(shown, pattern):
                image: NDArray[Any] = shot.frames[0][index]
                self._stacks += index == len(self._patterns) - 1
                return image
        level = int(shown.flat[0])
        if not (shown == level).all():
            raise DeviceError(f"{self.name}: the simulated cell knows its own fringes and even light, nothing else")
        white = shot.white[0]
        return np.asarray(white if level == 255 else np.rint(white * (level / 255.0)), dtype=white.dtype)

    def _render(self) -> Any:
        """Render all patterns from here at this exposure at once, and keep them while nothing moves."""
        cell = self.cell
        if self._robot is None and isinstance(cell, BoardCell):
            base_from_scanner = cell.board_views(self._stacks + 1)[-1]
        elif self._robot is None:
            base_from_scanner = cell.part_views()[0]
        else:
            base_from_scanner = self._robot.pose().flange.matrix() @ np.asarray(cell.flange_from_scanner)
        seen = (base_from_scanner.round(6).tobytes(), self.exposure_s)
        if seen != self._seen:
            relative = self.exposure_s / self.settings.nominal_exposure_s
            seed = zlib.crc32(seen[0], cell.seed)
            self._rendered = render(
                cell, self._in_view(base_from_scanner), base_from_scanner, exposures=[relative], seed=seed
            )
            self._seen = seen
        return self._rendered

    def _in_view(self, base_from_scanner: NDArray[np.float64]) -> Literal["artefact", "part"]:
        """Which of the two stands nearer to where the scanner looks."""
        looked_at = (base_from_scanner @ [0.0, 0.0, self.cell.distance_mm, 1.0])[:3]
        plate = np.asarray(self.cell.base_from_plate)[:3, 3]
        weld = np.asarray(self.cell.base_from_weld)
        in_weld = np.linalg.inv(weld) @ [*looked_at, 1.0]
        radius = self.cell.weld.reference.radius_mm
        height = in_weld[0] if math.isinf(radius) else math.hypot(in_weld[0], in_weld[1]) - radius
        return "artefact" if float(np.linalg.norm(looked_at - plate)) < abs(float(height)) else "part"
