"""What fresh eyes tried on the live cell: numbers out of range, links that were planted, names for addresses."""

import threading
import time

import pytest

from weldscan import DeviceError, KukaPose
from weldscan.devices import backend
from weldscan.devices.robots import Reading, Robot, RobotSettings
from weldscan.devices.robots.rsi import RsiSettings
from weldscan.devices.robots.wire import CLOSE_S, Link
from weldscan.simulated.controllers import Arm
from weldscan.simulated.controllers.kvp import KvpController

NULL = KukaPose(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
FLANGE = (610.825, -148.476, 481.652, -29.008, 23.236, 74.641)


class Told(Robot):
    """A robot that tells what it is told to."""

    name = "told"

    def __init__(self, *readings):
        self.settings, self.readings = RobotSettings(allow_motion=True, largest_turn_deg=180.0), iter(readings)

    def read(self, deadline=None):
        return next(self.readings)

    def close(self):
        pass


def reading(position, time_s, tool=NULL, base=NULL):
    return Reading(position, tool, base, "#BASE", "#T1", time_s)


@pytest.mark.parametrize(("place", "digits"), [(3, -290.008), (5, 774.641), (5, 1e300), (4, -203.236)])
def test_a_digit_too_many_in_an_angle(place, digits):
    """Where nothing but the pose is told (KUKAVARPROXY), a whole turn and more would be another angle."""
    wrong = [*FLANGE]
    wrong[place] = digits
    robot = Told(
        reading(KukaPose(*FLANGE), 1.0), reading(KukaPose(*wrong), 2.0), reading(KukaPose(*wrong), 3.0),
        reading(KukaPose(*FLANGE), 4.0, tool=KukaPose(0, 0, 100, 0, 0, 1800)),
        reading(KukaPose(*FLANGE), 4.0, tool=KukaPose(0, 0, 100, 270, 0, -180)),
    )  # fmt: skip
    robot.pose()
    for _ in range(3):
        with pytest.raises(DeviceError, match=r"[ABC] cannot be"):
            robot.pose()
    robot.pose()


def test_a_target_of_many_turns():
    robot = Told()
    with pytest.raises(DeviceError, match="C cannot be 1e"):
        robot.move_to(KukaPose(*FLANGE[:5], 1e300))


def test_half_turns_are_told_by_every_controller():
    robot = Told(reading(KukaPose(*FLANGE[:3], 180.0, -90.0, -180.0), 1.0))
    assert robot.pose().flange.x_mm == FLANGE[0]


def test_joints_over_kukavarproxy_hold_the_pose():
    arm = Arm(KukaPose(*FLANGE))
    with KvpController(arm) as controller:
        kind = backend("robot", "kvp")
        with kind(kind.Settings(port=controller.port)) as robot:
            assert len(robot.joints()) == 6
            honest = robot.get

            def spoilt(*names, deadline=None):
                values = honest(*names, deadline=deadline)
                return [value.replace("A5 ", "A5 9") if "AXIS" in value else value for value in values]

            robot.get = spoilt
            with pytest.raises(DeviceError, match="contradict"):
                robot.joints()


def test_a_controller_is_an_address():
    """A name is never equal to the address of a packet: every one would be a stranger's."""
    for name in ("localhost", "robot", "192.168.1", "192.168.1.010", "", "::1"):
        with pytest.raises(ValueError, match="should be an address"):
            RsiSettings(controller=name)
    assert RsiSettings(controller="192.168.1.10").controller == "192.168.1.10"


def test_closing_waits_for_nobody():
    """An interrupt between taking the lock and using it would leave it taken; so does a question that takes long."""
    link = Link("link", lambda deadline_s: None, lambda buffer: None, 1.0, 1.0)
    link._lock.acquire()
    closing = threading.Thread(target=link.close, daemon=True)
    start = time.monotonic()
    closing.start()
    closing.join(CLOSE_S + 5.0)
    assert not closing.is_alive()
    assert time.monotonic() - start < CLOSE_S + 5.0
