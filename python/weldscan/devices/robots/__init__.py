"""One face for every robot: where the flange is, when that was read, and - only where allowed - where it shall go.

Nothing here is safety-rated. Stopping a robot is the task of the controller's safety circuit, the enabling switch and
the emergency stop; software that reads poses over a network can promise none of it.
"""

from __future__ import annotations

import abc
import contextlib
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from weldscan.devices.robots.kinematics import ArmGeometry
from weldscan.devices.robots.plausible import (
    HALF_TURN_DEG,
    TURN_DEG,
    Told,
    beyond_a_turn,
    contradicted,
    jumped,
    out_of_reach,
)
from weldscan.devices.robots.plausible import distance as distance
from weldscan.devices.robots.wire import Cut, Deadline, Link, Transport
from weldscan.errors import DeviceError, DeviceTimeout
from weldscan.pose import KukaPose

POLL_S = 0.02
AT_REST_MM, AT_REST_DEG = 0.01, 0.002
"""Two readings in a row that differ by less: the arm stands. A tenth of the repeatability of a small KUKA (0.03 mm)."""

RESPITE_S = 2.0
"""How long the programs on the controller wait for the word to go, and how long a motion outlives its asker."""
CALL_BACK_S = 2.0
"""How long a motion that went wrong is called back and looked at, before the error is told."""
SINGLE_MM, SINGLE_DEG = 0.002, 1e-3
"""A controller keeps REAL in single precision: 0.0005 mm at 10 m, and less than 1e-4 degrees."""

Six = tuple[float, float, float, float, float, float]
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
    largest_turn_deg: Annotated[float, Field(gt=0)] = 150.0
    """The same for how far the flange would turn."""
    at_target_mm: Annotated[float, Field(gt=0)] = 0.1
    at_target_deg: Annotated[float, Field(gt=0)] = 0.02
    arm: Six | None = None
    """Lengths of the arm, mm: foot, shoulder, upper arm, elbow, forearm, wrist; with them the joints show where the
    flange is, and not only how it is turned."""
    root: Six = (0.0,) * 6
    """$ROBROOT, X Y Z A B C: where the foot stands."""
    joints_within_mm: Annotated[float, Field(gt=0)] = 10.0
    """How far pose and joints may contradict each other: absolutely accurate robots are bent by some mm."""
    joints_within_deg: Annotated[float, Field(gt=0)] = 0.5


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


class Robot(abc.ABC):
    """A robot that tells where its flange is. Every method returns the truth or raises `DeviceError`, never a
    default.
    """

    Settings: ClassVar[type[RobotSettings]] = RobotSettings
    moves: ClassVar[bool] = True
    """Can this link ask for motion at all?"""
    settings: RobotSettings
    name: str
    _last: Told | None = None
    """The last reading that was believed."""

    @abc.abstractmethod
    def read(self, deadline: Deadline | None = None) -> Reading:
        """Ask the controller once; within `timeout_s`, or within the deadline of a question that this is a part of."""

    @abc.abstractmethod
    def close(self) -> None:
        """Let go of the controller."""

    def pose(self, deadline: Deadline | None = None) -> StampedPose:
        """Return the flange in base. Raises `DeviceError` for a pose out of this world, a jump, or joints that say
        otherwise, `DeviceTimeout` for none.
        """
        return self._believed(self.read(deadline))

    def _believed(self, reading: Reading) -> StampedPose:
        told, s = Told(reading.flange(), reading.time_s, reading.joints_deg), self.settings
        arm = None if s.arm is None else ArmGeometry(*s.arm)
        wrong = (
            beyond_a_turn(reading.position, HALF_TURN_DEG)
            or beyond_a_turn(reading.tool, TURN_DEG)
            or beyond_a_turn(reading.base, TURN_DEG)
            or out_of_reach(told.flange)
            or (self._last and jumped(self._last, told))
            or contradicted(told, KukaPose(*s.root).matrix(), arm, s.joints_within_mm, s.joints_within_deg)
        )
        if wrong:
            raise DeviceError(f"{self.name}: {wrong}")
        self._last = told
        return StampedPose(told.flange, told.time_s)

    def joints(self) -> tuple[float, ...]:
        """Return A1 to A6, degrees, of a pose that is believed."""
        reading = self.read()
        if not reading.joints_deg:
            raise DeviceError(f"{self.name}: this link does not tell the joints")
        self._believed(reading)
        return reading.joints_deg

    def move_to(self, target: KukaPose) -> StampedPose:
        """Move the flange to a pose in base, point to point, and return where it then stands.

        Refused unless the configuration allows motion, the controller says T1, and the target is near. Returns only
        when the MEASURED pose is at the target and at rest. Otherwise, and whatever ends it - an error, Ctrl-C,
        SIGTERM - the motion is called back first, and what is raised says in which state the robot is then.
        """
        if not self.moves:
            raise DeviceError(f"{self.name}: this link only reads")
        if not self.settings.allow_motion:
            raise DeviceError(f"{self.name}: motion is off; allow_motion = true in the configuration allows it")
        if (wrong := out_of_reach(target) or beyond_a_turn(target, TURN_DEG)) is not None:
            raise DeviceError(f"{self.name}: the target: {wrong}")
        try:
            reading = self.read()
        except KeyboardInterrupt:
            raise KeyboardInterrupt("stopped before anything was asked of the robot") from None
        if reading.mode.upper() != "#T1":
            raise DeviceError(f"{self.name}: motion only in T1, the controller says {reading.mode or 'nothing'}")
        away_mm, away_deg = distance(self._believed(reading).flange, target)
        if away_mm > self.settings.largest_move_mm:
            raise DeviceError(
                f"{self.name}: the target is {away_mm:.0f} mm away, largest_move_mm = {self.settings.largest_move_mm:g}"
            )
        if away_deg > self.settings.largest_turn_deg:
            raise DeviceError(
                f"{self.name}: the target is turned by {away_deg:.0f} degrees, "
                f"largest_turn_deg = {self.settings.largest_turn_deg:g}"
            )
        give_up_s = time.monotonic() + self.settings.move_timeout_s
        try:
            self._move(target, give_up_s)
            return self._arrive(target, give_up_s)
        except BaseException as error:
            state = _undisturbed(self._call_back)
            if isinstance(error, DeviceError):
                raise type(error)(f"{error}; {state}") from error
            if isinstance(error, KeyboardInterrupt):
                raise KeyboardInterrupt(f"stopped: {state}") from None
            raise

    def _move(self, target: KukaPose, give_up_s: float) -> None:
        """Ask for the motion, as the link does it, and wait for the controller's word that it is over."""
        raise NotImplementedError

    def _withdraw(self, deadline: Deadline) -> str:
        """Take back what was asked for, as the link can, and say what that comes to."""
        raise NotImplementedError

    def _call_back(self) -> str:
        """Withdraw the motion; say that, and where the flange is then."""
        deadline = Deadline(CALL_BACK_S)
        try:
            said = self._withdraw(deadline)
        except DeviceError as error:
            return (
                f"the motion could not be called back ({error}); the program drops it within {RESPITE_S:g} s. "
                "Look at the robot"
            )
        try:
            with contextlib.suppress(DeviceError):  # on a line without connections an old reply may still be on its way
                self.pose(deadline)
            while True:
                before = self.pose(deadline)
                time.sleep(POLL_S)
                now = self.pose(deadline)
                place = " ".join(f"{value:.3f}" for value in now.flange.values())
                if _at_rest(before, now):
                    return f"{said}; the flange stands at {place}"
                if time.monotonic() > deadline.end_s - POLL_S:
                    return f"{said}; the flange STILL MOVES, last seen at {place}"
        except DeviceError as error:
            return f"{said}; where the flange is cannot be read ({error}). Look at the robot"

    def _arrive(self, target: KukaPose, give_up_s: float) -> StampedPose:
        """Wait until the measured pose is at the target and at rest: the controller's word alone proves nothing."""
        before = self.pose()
        while True:
            time.sleep(POLL_S)
            now = self.pose()
            off_mm, off_deg = distance(now.flange, target)
            at_rest = _at_rest(before, now)
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
        # No two clients begin alike: what one of them left behind is no answer to the next.
        self._number, self._last_number = secrets.randbelow(last_number), last_number
        self._link = Link(name, connect, cut, settings.timeout_s, settings.reconnect_s)
        self._link.open()

    def _next_number(self) -> int:
        self._number = self._number % self._last_number + 1
        return self._number

    def close(self) -> None:
        """Hang up."""
        self._link.close()


def _at_rest(before: StampedPose, now: StampedPose) -> bool:
    moved_mm, moved_deg = distance(before.flange, now.flange)
    return moved_mm < AT_REST_MM and moved_deg < AT_REST_DEG


def _undisturbed(work: Callable[[], str]) -> str:
    """Do something in a thread of its own, which no signal interrupts, however often Ctrl-C is pressed meanwhile."""
    said = ["what became of the motion is unknown. Look at the robot"]
    thread = threading.Thread(target=lambda: said.__setitem__(0, work()), daemon=True)
    thread.start()
    give_up_s = time.monotonic() + 2 * CALL_BACK_S
    while thread.is_alive() and time.monotonic() < give_up_s:
        with contextlib.suppress(KeyboardInterrupt):
            thread.join(0.1)
    return said[0]


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
