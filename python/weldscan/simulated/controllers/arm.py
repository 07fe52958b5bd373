"""The arm of the simulated controllers: it moves at a speed, and its joints follow."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from weldscan.devices.robots.kinematics import ArmGeometry, Joints
from weldscan.devices.robots.plausible import distance
from weldscan.errors import DeviceError
from weldscan.geometry import rigid, rotation_of, rotation_vector_of
from weldscan.pose import KukaPose

HOME_JOINTS: Joints = (0.0, -90.0, 90.0, 0.0, 30.0, 0.0)
HOME = KukaPose.from_matrix(ArmGeometry().flange(HOME_JOINTS))
NULL_FRAME = KukaPose(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
T1_SPEED_MM_S = 250.0
TURN_SPEED_DEG_S = 90.0


class LinkFault(StrEnum):
    """What a simulated controller does wrong with one reply. Not every link can commit every fault."""

    SILENCE = "silence"
    BYTES = "bytes"
    """The reply comes in single bytes, each in its own packet."""
    TWICE = "twice"
    """The reply comes twice, in one packet."""
    WRONG_ID = "wrong-id"
    WRONG_LENGTH = "wrong-length"
    EMPTY = "empty"
    GARBAGE = "garbage"
    HUGE = "huge"
    """10 MB where a few hundred bytes should be."""
    DTD = "dtd"
    ENTITY = "entity"
    RESET = "reset"
    """The connection is reset in the middle of the reply."""
    RESTART = "restart"
    """The controller goes away and comes back a second later."""
    NAN = "nan"
    JUMP = "jump"
    """One pose is 2 m off."""
    STALE = "stale"
    """The pose stands at what it was, or the stream repeats itself, although the arm moves."""


class OutOfReach(DeviceError):
    """No way of holding its joints brings the arm there."""


@dataclass(frozen=True)
class Motion:
    """From one flange pose straight to another, at a constant speed; of no time where the arm stands."""

    start: KukaPose
    target: KukaPose
    start_s: float = 0.0
    seconds: float = 0.0

    def at(self, time_s: float) -> KukaPose:
        """Return where the flange is at a time."""
        done = 1.0 if self.seconds == 0 else min((time_s - self.start_s) / self.seconds, 1.0)
        if done == 1.0:
            return self.target
        a, b = self.start.matrix(), self.target.matrix()
        turn = a[:3, :3] @ rotation_of(done * rotation_vector_of(a[:3, :3].T @ b[:3, :3]))
        return KukaPose.from_matrix(rigid(turn, (1 - done) * a[:3, 3] + done * b[:3, 3]))


class Arm:
    """A simulated robot: its flange moves straight at a constant speed and the joints follow; it tells $POS_ACT in its
    tool and base.
    """

    def __init__(
        self, flange: KukaPose = HOME, tool: KukaPose = NULL_FRAME, base: KukaPose = NULL_FRAME, mode: str = "#T1"
    ) -> None:
        self.tool, self.base, self.mode, self.interpolation = tool, base, mode, "#BASE"
        self._lock = threading.RLock()
        self._geometry, self._joints = ArmGeometry(), HOME_JOINTS
        self._held: KukaPose | None = None
        """The flange that these joints hold."""
        self._aim: Joints | None = None
        """The joints that a motion was to end in, if they were what it was given by."""
        self.speed_mm_s, self.turn_speed_deg_s = T1_SPEED_MM_S, TURN_SPEED_DEG_S
        self._motion = Motion(flange, flange)
        self._frozen: tuple[KukaPose, Joints] | None = None
        self.driven = False
        """Is it a program that moves it, so that it stands when that is stopped?"""
        self.begun_s: list[float] = []
        """When a motion began, each time; monotonic clock."""
        self.place(flange)

    def flange(self) -> KukaPose:
        """Return where the flange is now."""
        return self._motion.at(time.monotonic())

    @property
    def moving(self) -> bool:
        """Is the arm on its way?"""
        motion = self._motion
        return time.monotonic() < motion.start_s + motion.seconds

    @property
    def joints_deg(self) -> Joints:
        """A1 to A6 now: of the ways to hold the flange the one nearest to where the joints were.

        Where a motion was given by its joints it ends in those.
        """
        return self._holding(self.flange())

    def inverse(self, target: KukaPose) -> Joints | None:
        """Return the joints that hold a flange pose, nearest to where they are; None out of reach."""
        return self._geometry.joints(target.matrix(), self.joints_deg)

    def move(self, target: KukaPose) -> None:
        """Set off for a flange pose. Raises `OutOfReach`, and stays."""
        with self._lock:
            if self._geometry.joints(target.matrix(), self._joints) is None:
                raise OutOfReach(f"{target} is out of the arm's reach")
            start, now_s = self.flange(), time.monotonic()
            far_mm, far_deg = distance(start, target)
            seconds = max(far_mm / self.speed_mm_s, far_deg / self.turn_speed_deg_s)
            self._motion, self._aim = Motion(start, target, now_s, seconds), None
            if seconds > 0:
                self.begun_s.append(now_s)

    def move_joints(self, joints_deg: Joints) -> None:
        """Set off for a pose that is given by its joints."""
        with self._lock:
            self.move(KukaPose.from_matrix(self._geometry.flange(joints_deg)))
            self._aim = joints_deg

    def at(self, joints_deg: Joints) -> bool:
        """Does it stand where a motion to these joints ends?"""
        return self._aim == joints_deg and not self.moving

    def brake(self) -> None:
        """Stand where it is."""
        with self._lock:
            here = self.flange()
            self._motion, self._aim = Motion(here, here), None

    def place(self, target: KukaPose) -> None:
        """Be at a pose at once, as when an operator has jogged the arm there; for a far one the arm is a larger one."""
        with self._lock:
            while self._geometry.joints(target.matrix(), self._joints) is None:
                self._geometry = self._geometry.larger(2.0)
            self._motion, self._aim = Motion(target, target), None

    def position(self, fault: LinkFault | None = None) -> KukaPose:
        """Return $POS_ACT: the tool in base."""
        return self.told(fault)[0]

    def told(self, fault: LinkFault | None = None) -> tuple[KukaPose, Joints]:
        """Return $POS_ACT and $AXIS_ACT of one moment, with a fault where that is one of the pose."""
        with self._lock:
            flange = self.flange()
            now = flange, self._holding(flange)
            self._frozen = (self._frozen or now) if fault is LinkFault.STALE else None
            flange, joints_deg = self._frozen or now
        if fault is LinkFault.JUMP:
            flange = KukaPose(flange.x_mm + 2000.0, *flange.values()[1:])
        position = np.linalg.inv(self.base.matrix()) @ flange.matrix() @ self.tool.matrix()
        return KukaPose.from_matrix(position), joints_deg

    def _holding(self, flange: KukaPose) -> Joints:
        with self._lock:
            if self._aim is not None and not self.moving:
                self._joints, self._held = self._aim, flange
            if flange != self._held:
                self._joints = self._geometry.joints(flange.matrix(), self._joints) or self._joints
                self._held = flange
            return self._joints
