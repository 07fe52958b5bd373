"""What our programs on the controllers have in common, line by line as `krl/` has it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from weldscan.devices.robots import RESPITE_S
from weldscan.devices.robots.kinematics import Joints
from weldscan.devices.robots.program import INTERPOLATIONS, MODES, Command, Status
from weldscan.pose import KukaPose
from weldscan.simulated.controllers.arm import NULL_FRAME, Arm, LinkFault
from weldscan.simulated.controllers.interpreter import Interpreter, Program, Resume, Timer


@dataclass(frozen=True)
class Request:
    """What a client wants; without a command where not everything of it came."""

    number: int
    command: int | None
    target: KukaPose = NULL_FRAME


class Driver:
    """WELDSCAN_LOOK and WELDSCAN_DRIVE: the one way in which any of the programs moves the arm."""

    def __init__(self, arm: Arm, interpreter: Interpreter) -> None:
        self.arm, self.interpreter = arm, interpreter
        self.status = Status.DONE
        self._joints: Joints | None = None

    def look(self, target: KukaPose) -> bool:
        """Say whether the arm may and can go to a flange pose, and by `status` why not."""
        self._joints = None
        if self.arm.mode != "#T1":
            self.status = Status.NOT_IN_T1
            return False
        self.arm.tool = self.arm.base = NULL_FRAME
        self._joints = self.arm.inverse(target)
        self.status = Status.OUT_OF_REACH if self._joints is None else Status.TAKEN
        return self._joints is not None

    def drive(self, lost: Callable[[], bool]) -> Program:
        """Go to the joints that INVERSE gave, unless and until nobody wants it any more: then brake."""
        assert self._joints is not None
        self.status = Status.STOPPED
        self.interpreter.interrupt, self.arm.driven = lost, True
        try:
            if not lost() and self.arm.mode == "#T1":
                yield from self.interpreter.ptp(self._joints)
                self.status = Status.DONE
        except Resume:
            pass
        self.interpreter.interrupt, self.arm.driven = None, False


class Requests:
    """What the programs do that answer requests, over EthernetKRL and over a serial line: one target waits at most."""

    def __init__(
        self,
        driver: Driver,
        receive: Callable[[], Request | None],
        reply: Callable[[int], None],
        connected: Callable[[], bool] = lambda: True,
    ) -> None:
        self._driver, self._receive, self._reply, self._connected = driver, receive, reply, connected
        self._timer = Timer()
        self.forget()

    def forget(self) -> None:
        """Drop what waits, for its GO or for its turn."""
        self._pending, self.target = 0, NULL_FRAME
        self._held: Request | None = None
        """What came while the arm moved, and made it brake."""
        self.left = False
        """Did whoever asked hang up while the arm moved? Somebody else may be there by now."""

    @property
    def waits(self) -> bool:
        """Would a GO set the arm off now?"""
        return self._pending != 0 and not self._timer.flag

    def serve(self) -> Program:
        """One request, if there is one."""
        request, self._held = self._held or self._receive(), None
        if request is None or request.command == Command.BEAT:
            return
        driver, pending, self._pending = self._driver, self._pending, 0
        if request.command != Command.GO:
            self.forget()
        match request.command:
            case None:
                driver.status = Status.GARBLED
            case Command.POSE:
                driver.status = Status.DONE
            case Command.MOVE:
                if driver.look(request.target):
                    self._pending, self.target = request.number, request.target
                    self._timer.set(-1000 * RESPITE_S)
            case Command.GO if pending == request.number != 0 and not self._timer.flag:
                self._timer.set(-1000 * RESPITE_S)
                yield from driver.drive(lambda: self._lost(request.number))
            case Command.GO:
                driver.status = Status.LAPSED
            case _:
                driver.status = Status.UNKNOWN_COMMAND
        if self._held is None and not self.left:
            self._reply(request.number)

    def _lost(self, number: int) -> bool:
        """While the arm moves: is it wanted no longer? A BEAT with its number says for two seconds that it is."""
        self.left = not self._connected()
        if self.left or self._timer.flag:  # before a BEAT that has lain in the line for long is taken for a new one
            return True
        request = self._receive()
        if request is not None and (request.command, request.number) != (Command.BEAT, number):
            self._held = request
            return True
        if request is not None:
            self._timer.set(-1000 * RESPITE_S)
        return False


def codes(arm: Arm) -> tuple[int, int]:
    """Return the codes of $MODE_OP and $IPO_MODE; 0 for what the programs do not know."""
    mode = next((code for code, name in MODES.items() if name == arm.mode), 0)
    return mode, next((code for code, name in INTERPOLATIONS.items() if name == arm.interpolation), 0)


def reading(arm: Arm, fault: LinkFault | None) -> list[float]:
    """Return $POS_ACT, $TOOL, $BASE and the joints."""
    position, joints_deg = arm.told(fault)
    return [*position.values(), *arm.tool.values(), *arm.base.values(), *joints_deg]
