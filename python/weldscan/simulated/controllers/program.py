"""Our programs on the controller itself, as the simulated controllers run them."""

from __future__ import annotations

import threading

from weldscan.devices.robots.program import INTERPOLATIONS, MODES, POLL_S, Status
from weldscan.pose import KukaPose
from weldscan.simulated.controllers import Arm, LinkFault, OutOfReach


def carry_out(arm: Arm, target: KukaPose, stop: threading.Event) -> Status:
    """Move, wait until the arm has arrived, and say how it went."""
    if arm.mode != "#T1":
        return Status.NOT_IN_T1
    try:
        arm.move(target)
    except OutOfReach:
        return Status.OUT_OF_REACH
    while arm.moving and not stop.wait(POLL_S):
        pass
    return Status.DONE


def codes(arm: Arm) -> tuple[int, int]:
    """Return the codes of $MODE_OP and $IPO_MODE; 0 for what the programs do not know."""
    mode = next((code for code, name in MODES.items() if name == arm.mode), 0)
    return mode, next((code for code, name in INTERPOLATIONS.items() if name == arm.interpolation), 0)


def numbers(arm: Arm, fault: LinkFault | None) -> list[float]:
    """Return $POS_ACT, $TOOL, $BASE and the joints."""
    position = arm.position(fault)
    return [*position.values(), *arm.tool.values(), *arm.base.values(), *arm.joints_deg]
