"""What the programs of ours say that answer on the controller itself, over EthernetKRL and over a serial line.

A request is a number and either the wish for the pose or a target; the reply repeats the number and says 27 more:
status, $MODE_OP and $IPO_MODE as codes, then $POS_ACT, $TOOL, $BASE and the joints. The links differ in how that is
written.
"""

from __future__ import annotations

import abc
import time
from collections.abc import Sequence
from enum import IntEnum

from weldscan.devices.robots import Reading, StreamRobot
from weldscan.errors import DeviceError
from weldscan.pose import KukaPose

MODES = {1: "#T1", 2: "#T2", 3: "#AUT", 4: "#EX"}
INTERPOLATIONS = {1: "#BASE", 2: "#TCP"}
REPLY_NUMBERS = 3 + 4 * 6
LAST_NUMBER = 999_999
"""A REAL of the controller still holds it exactly."""
POLL_S = 0.005


class Status(IntEnum):
    """What became of a request."""

    DONE = 0
    UNKNOWN_COMMAND = 1
    NOT_IN_T1 = 2
    OUT_OF_REACH = 3


class ProgramRobot(StreamRobot):
    """A robot on which a program of ours answers."""

    @abc.abstractmethod
    def _request(self, number: int, target: KukaPose | None) -> bytes:
        """Compose the question for the pose, or the wish to be at a target."""

    @abc.abstractmethod
    def _reply(self, message: bytes) -> tuple[int, Sequence[float]]:
        """Return the number and the 27 others of a reply."""

    def read(self) -> Reading:
        """Ask the program for its reading."""
        status, reading = self._ask(None)
        if status != Status.DONE:
            raise DeviceError(f"{self.name}: {_meaning(status)}")
        return reading

    def _move(self, target: KukaPose, give_up_s: float) -> None:
        status, _ = self._ask(target, give_up_s - time.monotonic())
        if status != Status.DONE:
            raise DeviceError(f"{self.name}: not moved: {_meaning(status)}")

    def _ask(self, target: KukaPose | None, timeout_s: float | None = None) -> tuple[int, Reading]:
        number, asked_s = self._next_number(), time.monotonic()

        def read(message: bytes) -> tuple[int, Reading]:
            replied, values = self._reply(message)
            if replied != number:
                raise DeviceError(f"reply {replied} to request {number}")
            status, mode, interpolation = (int(value) for value in values[:3])
            return status, Reading(
                position=KukaPose(*values[3:9]),
                tool=KukaPose(*values[9:15]),
                base=KukaPose(*values[15:21]),
                interpolation=INTERPOLATIONS.get(interpolation, str(interpolation)),
                mode=MODES.get(mode, str(mode)),
                time_s=(asked_s + time.monotonic()) / 2,
                joints_deg=tuple(values[21:27]),
            )

        return self._link.ask(self._request(number, target), read, target is None, timeout_s)


def _meaning(status: int) -> str:
    return Status(status).name.lower().replace("_", " ") if status in list(Status) else f"status {status}"
