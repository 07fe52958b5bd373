"""`weldscan calibrate scanner --live`: captures a board under fringes along both axes, pose by pose, into a folder.

Poses are those of `[calibration]`, gone to by the robot or by the operator; without them the operator moves the board.
What is captured is `weldscan-calibration/1`, like any other capture.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from weldscan.devices.cameras import Camera, Image
from weldscan.devices.projectors import Projector
from weldscan.devices.projectors.patterns import board_fringes, fringe_patterns
from weldscan.devices.robots import Robot, wait_until_still
from weldscan.errors import DeviceError, InputError
from weldscan.pose import KukaPose
from weldscan.records.files import to_json, whole_folder, write_synced
from weldscan.records.images import encode_png
from weldscan.station.capture import Quality, capture_stack, judge, set_exposure
from weldscan.station.cell import CellConfig, check

Tell = Callable[[int, int, str], None]
Operator = Callable[[str], None]


class BoardSettings(BaseModel):
    """`[calibration]`."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    count: Annotated[int, Field(ge=3, le=100)] = 12
    """Poses of the board, where the operator moves it."""
    poses: tuple[tuple[float, float, float, float, float, float], ...] = ()
    """Or poses of the flange, X Y Z A B C, with the board lying still."""
    fringes: tuple[tuple[str, Annotated[float, Field(gt=0)], Annotated[int, Field(ge=3, le=100)]], ...] = ()
    """[axis, periods, steps] of each set; absent: periods of 20 projector pixels along both axes, four steps."""
    temperature_c: float | None = None
    still_window_s: Annotated[float, Field(gt=0, le=60)] = 0.3
    still_mm: Annotated[float, Field(gt=0)] = 0.02
    still_deg: Annotated[float, Field(gt=0)] = 0.003
    still_timeout_s: Annotated[float, Field(gt=0, le=3600)] = 30.0
    most_saturated: Annotated[float, Field(ge=0, le=1)] = 0.05
    least_usable: Annotated[float, Field(ge=0, le=1)] = 0.1
    least_modulation: Annotated[float, Field(ge=0, le=1)] = 0.02


def capture_board(cell: CellConfig, folder: Path, board: str | None, tell: Tell, operator: Operator) -> None:
    """Capture a board at several poses.

    Args:
        cell: which devices; its `[calibration]` says which poses and fringes.
        folder: must not exist yet, or be empty. It appears when all poses are there.
        board: for calibration.json.
        tell: called with (poses done, poses in all, what is being done).
        operator: called with what is to be done before a pose that no robot goes to; returns when it is done.

    Raises:
        InputError: configuration or folder. DeviceError: a device failed, or the images are of no use; nothing is kept.
    """
    settings = check(cell.calibration, BoardSettings, f"{cell.path}: calibration")
    for kind in ("projector", "camera", *(["robot"] if settings.poses else [])):
        cell.settings(kind)
    with whole_folder(folder) as partial, ExitStack() as devices:
        projector: Projector = devices.enter_context(cell.open("projector"))
        camera: Camera = devices.enter_context(cell.open("camera"))
        robot: Robot | None = devices.enter_context(cell.open_robot()) if settings.poses else None
        size = projector.settings.width, projector.settings.height
        sets = settings.fringes or board_fringes(*size)
        if {axis for axis, _, _ in sets} != {"x", "y"}:
            raise InputError(f"{cell.path}: calibration.fringes: both axes are needed, x and y")
        patterns = list(fringe_patterns(sets, *size))
        document: dict[str, Any] = {
            "schema": "weldscan-calibration/1",
            "projector": {"width": size[0], "height": size[1]},
            "fringes": [{"axis": axis, "periods": periods, "steps": steps} for axis, periods, steps in sets],
        }
        document |= {} if board is None else {"board": board}
        document |= {} if settings.temperature_c is None else {"temperature_c": settings.temperature_c}
        write_synced(partial / "calibration.json", to_json(document))
        set_exposure(camera, projector, camera.settings.exposure_s)
        count = len(settings.poses) or settings.count
        for number in range(count):
            name = f"pose-{number + 1:02d}"
            tell(number, count, f"going to {name}")
            _go(settings, robot, number, operator)
            tell(number, count, f"taking {name}")
            images = capture_stack(camera, projector, patterns)
            _refuse(name, judge([images], sets, settings.least_modulation, camera.full_scale), settings)
            _keep(partial / "shots" / name, images)
        tell(count, count, "captured")


def _go(settings: BoardSettings, robot: Robot | None, number: int, operator: Operator) -> None:
    """To the next pose: by the robot where it may, else by the operator."""
    if robot is None:
        operator(f"Move the board to pose {number + 1}: tilted 30 to 45 degrees to another side, turned, near, far")
        return
    pose = KukaPose(*settings.poses[number])
    if robot.settings.allow_motion:
        robot.move_to(pose)
    else:
        operator(f"Move the flange to pose {number + 1} ({pose})")
    wait_until_still(robot, settings.still_window_s, settings.still_mm, settings.still_deg, settings.still_timeout_s)


def _refuse(name: str, quality: Quality, settings: BoardSettings) -> None:
    if quality.saturated > settings.most_saturated:
        raise DeviceError(f"{name}: {quality.saturated:.1%} of the image is saturated: lower camera.exposure_s")
    if quality.usable < settings.least_usable:
        raise DeviceError(f"{name}: only {quality.usable:.1%} of the image can be measured: raise camera.exposure_s")


def _keep(folder: Path, images: list[Image]) -> None:
    folder.mkdir(parents=True)
    for index, image in enumerate(images):
        try:
            write_synced(folder / f"{index:03d}.png", encode_png(image))
        except InputError as error:
            raise DeviceError(f"{folder.name}: {error}") from None
