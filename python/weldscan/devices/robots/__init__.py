"""One face for every robot: where the flange is, when that was read, and - only where allowed - where it shall go.

Nothing here is safety-rated. Stopping a robot is the task of the controller's safety circuit, the enabling switch and
the emergency stop; software that reads poses over a network can promise none of it.
"""

from __future__ import annotations

import abc
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from weldscan.devices.robots.wire import Cut, Link, Transport
from weldscan.errors import DeviceError, DeviceTimeout
from weldscan.geometry import rotation_angle
from weldscan.pose import KukaPose

FARTHEST_MM = 10_000.0
"""No KUKA on its own foot reaches further from its base; a number beyond is a fault of the wire, not a pose."""
FASTEST_MM_S = 12_000.0
"""No KUKA arm moves its flange faster (KR AGILUS: 11 m/s); two readings that say so are a jump."""
JUMP_SLACK_MM = 2.0
"""Allowed on top of speed times time: readings are interpolated by the controller in cycles of up to 12 ms."""
POLL_S = 0.02
AT_REST_MM, AT_REST_DEG = 0.01, 0.002
"""Two readings in a row that differ by less: the arm stands. A tenth of the repeatability of a small KUKA (0.03 mm)."""

Seconds = Annotated[float, Field(gt=0, le=3600)]


class RobotSettings(BaseModel):
    """What every link's section of a cell's configuration has."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    timeout_s: Seconds = 1.0
    """For one question and its whole answer."""
    reconnect_s: Seconds = 5.0
    """How long a lost connection is tried again, with growing pauses, before a question fails."""
    allow_motion: bool = False
    """Motion is off unless this is true AND the controller says T1."""
    move_timeout_s: Seconds = 60.0
    largest_move_mm: Annotated[float, Field(gt=0)] = 500.0
    """A target further away than this is refused: it is more likely a typing error than a scan pose."""
    at_target_mm: Annotated[float, Field(gt=0)] = 0.1
    at_target_deg: Annotated[float, Field(gt=0)] = 0.02


@dataclass(frozen=True)
class StampedPose:
    """The flange in base, and when that was so on this computer's monotonic clock."""

    flange: KukaPose
    time_s: float


@dataclass(frozen=True)
class Reading:
    """What a controller tells in one go. `position` is $POS_ACT: the tool in the base that are active, not the
    flange.
    """

    position: KukaPose
    tool: KukaPose
    base: KukaPose
    interpolation: str
    """$IPO_MODE: #BASE, or #TCP when the tool stands still and the workpiece moves."""
    mode: str
    """$MODE_OP: #T1, #T2, #AUT, #EX."""
    time_s: float
    joints_deg: tuple[float, ...] = ()

    def flange(self) -> KukaPose:
        """Return the flange in the robot's own base, whichever tool and base are active."""
        if self.interpolation.upper() != "#BASE":
            raise DeviceError(
                f"$IPO_MODE is {self.interpolation or 'empty'}: with the tool fixed in the room the flange is unknown; "
                "set $IPO_MODE = #BASE"
            )
        return KukaPose.from_matrix(self.base.matrix() @ self.position.matrix() @ np.linalg.inv(self.tool.matrix()))


def distance(a: KukaPose, b: KukaPose) -> tuple[float, float]:
    """Return how far two poses are apart: mm, and degrees of the one rotation between them."""
    turn = a.matrix()[:3, :3].T @ b.matrix()[:3, :3]
    return math.dist(a.values()[:3], b.values()[:3]), math.degrees(rotation_angle(turn))


class Robot(abc.ABC):
    """A robot that tells where its flange is. Every method returns the truth or raises `DeviceError`, never a
    default.
    """

    Settings: ClassVar[type[RobotSettings]] = RobotSettings
    moves: ClassVar[bool] = True
    """Can this link ask for motion at all?"""
    settings: RobotSettings
    name: str
    _last: StampedPose | None = None

    @abc.abstractmethod
    def read(self) -> Reading:
        """Ask the controller once."""

    @abc.abstractmethod
    def close(self) -> None:
        """Let go of the controller."""

    def pose(self) -> StampedPose:
        """Return the flange in base. Raises `DeviceError` for a pose out of this world or a jump, `DeviceTimeout`
        for none.
        """
        reading = self.read()
        pose = StampedPose(reading.flange(), reading.time_s)
        last, self._last = self._last, pose
        if (far := math.hypot(*pose.flange.values()[:3])) > FARTHEST_MM:
            raise DeviceError(f"{self.name}: the flange cannot be {far:.0f} mm from the base")
        if last is not None:
            moved_mm, _ = distance(last.flange, pose.flange)
            seconds = pose.time_s - last.time_s
            if moved_mm > FASTEST_MM_S * seconds + JUMP_SLACK_MM:
                raise DeviceError(f"{self.name}: the pose jumped by {moved_mm:.1f} mm in {seconds * 1000:.1f} ms")
        return pose

    def joints(self) -> tuple[float, ...]:
        """Return A1 to A6, degrees."""
        joints = self.read().joints_deg
        if not joints:
            raise DeviceError(f"{self.name}: this link does not tell the joints")
        return joints

    def move_to(self, target: KukaPose) -> StampedPose:
        """Move the flange to a pose in base, point to point, and return where it then stands.

        Refused unless the configuration allows motion, the controller says T1, and the target is near. Returns only
        when the MEASURED pose is at the target and at rest; otherwise raises.
        """
        if not self.moves:
            raise DeviceError(f"{self.name}: this link only reads")
        if not self.settings.allow_motion:
            raise DeviceError(f"{self.name}: motion is off; allow_motion = true in the configuration allows it")
        reading = self.read()
        if reading.mode.upper() != "#T1":
            raise DeviceError(f"{self.name}: motion only in T1, the controller says {reading.mode or 'nothing'}")
        away_mm, _ = distance(reading.flange(), target)
        if away_mm > self.settings.largest_move_mm:
            raise DeviceError(
                f"{self.name}: the target is {away_mm:.0f} mm away, largest_move_mm = {self.settings.largest_move_mm:g}"
            )
        give_up_s = time.monotonic() + self.settings.move_timeout_s
        self._move(target, give_up_s)
        return self._arrive(target, give_up_s)

    def _move(self, target: KukaPose, give_up_s: float) -> None:
        """Ask for the motion, as the link does it, and wait for the controller's word that it is over."""
        raise NotImplementedError

    def _arrive(self, target: KukaPose, give_up_s: float) -> StampedPose:
        """Wait until the measured pose is at the target and at rest: the controller's word alone proves nothing."""
        before = self.pose()
        while True:
            time.sleep(POLL_S)
            now = self.pose()
            off_mm, off_deg = distance(now.flange, target)
            moved_mm, moved_deg = distance(before.flange, now.flange)
            at_rest = moved_mm < AT_REST_MM and moved_deg < AT_REST_DEG
            if at_rest and off_mm < self.settings.at_target_mm and off_deg < self.settings.at_target_deg:
                return now
            if time.monotonic() > give_up_s:
                raise DeviceTimeout(
                    f"{self.name}: {off_mm:.2f} mm and {off_deg:.3f} degrees from the target after "
                    f"{self.settings.move_timeout_s:g} s{'' if at_rest else ', still moving'}"
                )
            before = now

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class StreamRobot(Robot):
    """A robot behind a byte stream: numbered questions, one at a time, each with its one reply."""

    def __init__(
        self, settings: RobotSettings, name: str, connect: Callable[[float], Transport], cut: Cut, last_number: int
    ) -> None:
        self.settings, self.name = settings, name
        self._number, self._last_number = 0, last_number
        self._link = Link(name, connect, cut, settings.timeout_s, settings.reconnect_s)
        self._link.open()

    def _next_number(self) -> int:
        self._number = self._number % self._last_number + 1
        return self._number

    def close(self) -> None:
        """Hang up."""
        self._link.close()


def wait_until_still(
    robot: Robot, window_s: float, tolerance_mm: float, tolerance_deg: float, timeout_s: float
) -> None:
    """Return when no reading of a whole window differs from the window's first by more than the tolerance."""
    give_up_s = time.monotonic() + timeout_s
    first = robot.pose()
    while True:
        time.sleep(POLL_S)
        now = robot.pose()
        moved_mm, moved_deg = distance(first.flange, now.flange)
        if moved_mm > tolerance_mm or moved_deg > tolerance_deg:
            if time.monotonic() > give_up_s:
                raise DeviceTimeout(
                    f"{robot.name}: does not stand still: {moved_mm:.3f} mm, {moved_deg:.4f} degrees "
                    f"within {now.time_s - first.time_s:.2f} s"
                )
            first = now
        elif now.time_s - first.time_s >= window_s:
            return
