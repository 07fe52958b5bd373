"""What the programs of ours say that answer on the controller itself, over EthernetKRL and over a serial line.

A request is a number, a command and a target; the reply repeats the number and says 33 more: status, $MODE_OP and
$IPO_MODE as codes, then $POS_ACT, $TOOL, $BASE, the joints, and the target as the program took it. The links differ in
how that is written.

A motion takes two requests. MOVE lays a target down: the program looks whether the arm can go there, tells the target
as it took it, and moves nothing. GO with the same number, within two seconds by the controller's own clock, sets off;
while the arm moves, a BEAT with it every half second says that the motion is still wanted. So a request that lay
somewhere - in a FIFO, behind a stopped program, in a line's buffer - never moves anything: whoever asked has to be
there, and to have read the very target back. Two seconds after he is gone, or with any other request, the arm brakes.
"""

from __future__ import annotations

import abc
import time
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from weldscan.devices.robots import SINGLE_DEG, SINGLE_MM, Reading, StreamRobot
from weldscan.devices.robots.plausible import distance
from weldscan.devices.robots.wire import Deadline
from weldscan.errors import DeviceError
from weldscan.pose import KukaPose

MODES = {1: "#T1", 2: "#T2", 3: "#AUT", 4: "#EX"}
INTERPOLATIONS = {1: "#BASE", 2: "#TCP"}
REPLY_NUMBERS = 3 + 5 * 6
LAST_NUMBER = 999_999
"""A REAL of the controller still holds it exactly."""
NOWHERE = KukaPose(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Command(IntEnum):
    """What a request wants."""

    POSE = 1
    MOVE = 2
    GO = 3
    BEAT = 4
    """Never answered."""


class Status(IntEnum):
    """What became of a request."""

    DONE = 0
    UNKNOWN_COMMAND = 1
    NOT_IN_T1 = 2
    OUT_OF_REACH = 3
    TAKEN = 4
    """The target was taken; GO is waited for."""
    LAPSED = 5
    """GO came too late, or for no target."""
    GARBLED = 6
    """Something was missing in the request, or more than one lay there."""
    STOPPED = 7
    """The motion was broken off, because whoever asked for it went away."""


@dataclass(frozen=True)
class Reply:
    """One reply of our program."""

    status: int
    reading: Reading
    target: KukaPose


class ProgramRobot(StreamRobot):
    """A robot on which a program of ours answers."""

    @abc.abstractmethod
    def _request(self, number: int, command: Command, target: KukaPose) -> bytes:
        """Compose a request."""

    @abc.abstractmethod
    def _reply(self, message: bytes) -> tuple[int, Sequence[float]]:
        """Return the number and the 33 others of a reply, the first three of them whole."""

    def read(self, deadline: Deadline | None = None) -> Reading:
        """Ask the program for its reading."""
        reply = self._ask(self._next_number(), Command.POSE, NOWHERE, deadline)
        if reply.status != Status.DONE:
            raise DeviceError(f"{self.name}: {_meaning(reply.status)}")
        return reply.reading

    def _move(self, target: KukaPose, give_up_s: float) -> None:
        """Lay the target down, look how the program took it, and say go."""
        number = self._next_number()
        taken = self._ask(number, Command.MOVE, target)
        if taken.status != Status.TAKEN:
            raise DeviceError(f"{self.name}: not moved: {_meaning(taken.status)}")
        off_mm, off_deg = distance(taken.target, target)
        if off_mm > SINGLE_MM or off_deg > SINGLE_DEG:
            raise DeviceError(f"{self.name}: the controller took another target: {taken.target}")
        end = Deadline(max(give_up_s - time.monotonic(), 1e-3))
        gone = self._ask(number, Command.GO, NOWHERE, end, beat=self._request(number, Command.BEAT, NOWHERE))
        if gone.status != Status.DONE:
            raise DeviceError(f"{self.name}: not moved: {_meaning(gone.status)}")

    def _withdraw(self, deadline: Deadline) -> str:
        """Hang up, and let the next question be another: the program brakes, and forgets what it was asked for."""
        self._link.renew()
        return "the motion is called back"

    def _ask(
        self,
        number: int,
        command: Command,
        target: KukaPose,
        deadline: Deadline | None = None,
        beat: bytes | None = None,
    ) -> Reply:
        def read(message: bytes) -> tuple[int, Sequence[float]]:
            replied, values = self._reply(message)
            if replied != number:
                raise DeviceError(f"reply {replied} to request {number}")
            return replied, values

        request = self._request(number, command, target)
        answer = self._link.ask(request, read, command is Command.POSE, deadline, beat)
        _, values = answer.value
        status, mode, interpolation = (int(value) for value in values[:3])
        reading = Reading(
            position=KukaPose(*values[3:9]),
            tool=KukaPose(*values[9:15]),
            base=KukaPose(*values[15:21]),
            interpolation=INTERPOLATIONS.get(interpolation, str(interpolation)),
            mode=MODES.get(mode, str(mode)),
            time_s=(answer.asked_s + answer.told_s) / 2,
            joints_deg=tuple(values[21:27]),
        )
        return Reply(status, reading, KukaPose(*values[27:33]))


def _meaning(status: int) -> str:
    return Status(status).name.lower().replace("_", " ") if status in list(Status) else f"status {status}"
