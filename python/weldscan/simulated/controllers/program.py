"""What our programs on the controllers have in common, line by line as `krl/` has it."""

from __future__ import annotations

from weldscan.devices.robots import RESPITE_S
from weldscan.devices.robots.kinematics import Joints
from weldscan.devices.robots.program import INTERPOLATIONS, MODES, Command, Status
from weldscan.pose import KukaPose
from weldscan.simulated.controllers.arm import NULL_FRAME, Arm, LinkFault
from weldscan.simulated.controllers.interpreter import Interpreter, Program, Timer


class Driver:
    """WELDSCAN_DRIVE: the one way in which any of the programs moves the arm."""

    def __init__(self, arm: Arm, interpreter: Interpreter) -> None:
        self.arm, self.interpreter = arm, interpreter
        self.status = Status.DONE
        self.joints: Joints | None = None

    def look(self, target: KukaPose) -> None:
        """Say by `status` whether the arm may and can go to a flange pose; `joints` are then what INVERSE gave."""
        self.joints = None
        if self.arm.mode != "#T1":
            self.status = Status.NOT_IN_T1
            return
        self.arm.tool = self.arm.base = NULL_FRAME
        self.joints = self.arm.inverse(target)
        self.status = Status.OUT_OF_REACH if self.joints is None else Status.TAKEN

    def drive(self) -> Program:
        """Go to the joints that INVERSE gave."""
        assert self.joints is not None
        self.arm.driven = True
        yield from self.interpreter.ptp(self.joints)
        self.arm.driven = False
        self.status = Status.DONE


class Requests:
    """What the programs do that answer requests, over EthernetKRL and over a serial line: one pending target at most."""

    def __init__(self, driver: Driver) -> None:
        self.driver, self.timer = driver, Timer()
        self.pending = 0
        """The number whose GO is waited for."""
        self.target = NULL_FRAME

    def begin(self, command: int, number: int, target: KukaPose) -> bool:
        """Do what a request says but for the motion; True where that is to follow now."""
        driver = self.driver
        waited, self.pending = self.pending, 0
        goes = command == Command.GO and number == waited != 0 and not self.timer.flag
        if not goes:
            self.target = NULL_FRAME
        if command == Command.POSE:
            driver.status = Status.DONE
        elif command == Command.MOVE:
            driver.look(target)
            if driver.status is Status.TAKEN:
                self.pending, self.target = number, target
                self.timer.set(-1000 * RESPITE_S)
        elif command == Command.GO:
            driver.status = Status.STOPPED if goes else Status.LAPSED
        else:
            driver.status = Status.UNKNOWN_COMMAND
        if goes and driver.arm.mode != "#T1":
            driver.status = Status.NOT_IN_T1
            return False
        return goes


def codes(arm: Arm) -> tuple[int, int]:
    """Return the codes of $MODE_OP and $IPO_MODE; 0 for what the programs do not know."""
    mode = next((code for code, name in MODES.items() if name == arm.mode), 0)
    return mode, next((code for code, name in INTERPOLATIONS.items() if name == arm.interpolation), 0)


def reading(arm: Arm, fault: LinkFault | None) -> list[float]:
    """Return $POS_ACT, $TOOL, $BASE and the joints."""
    position, joints_deg = arm.told(fault)
    return [*position.values(), *arm.tool.values(), *arm.base.values(), *joints_deg]
