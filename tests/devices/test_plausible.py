"""What is believed of a robot's words, link by link: reach, no jump, joints and pose of one mind, and numbers."""

import re
import time

import pytest

from weldscan import DeviceError, InputError, KukaPose
from weldscan.devices.robots.eki import EkiRobot, EkiSettings
from weldscan.devices.robots.kinematics import ArmGeometry
from weldscan.devices.robots.kvp import KvpRobot, KvpSettings
from weldscan.devices.robots.plausible import Told, contradicted, distance, jumped, out_of_reach
from weldscan.devices.robots.rsi import RsiRobot, RsiSettings
from weldscan.devices.robots.serial import SerialRobot, SerialSettings, checksum, decode_line, encode_line
from weldscan.pose import parse_e6axis, parse_number, parse_whole
from weldscan.simulated.controllers import Arm
from weldscan.simulated.controllers.eki import EkiController
from weldscan.simulated.controllers.kvp import KvpController
from weldscan.simulated.controllers.rsi import RsiController
from weldscan.simulated.controllers.serial import SerialController

FLANGE = KukaPose(1610.825, -148.476, 981.652, -29.008, 23.236, 74.641)
X, *REST = FLANGE.values()
LENGTHS = (675.0, 350.0, 1150.0, -41.0, 1200.0, 215.0)
NO_NUMBERS = ["5_0_0", "٥٠٠", "nan", "inf", "1e999", "", " 1", "1 ", "0x10", "1,5", "--1", "१", "1.2.3", "+", "1e"]


@pytest.mark.parametrize("text", NO_NUMBERS)
def test_one_strict_parser(text):
    with pytest.raises(InputError):
        parse_number(text)
    with pytest.raises(InputError):
        parse_whole(text)
    with pytest.raises(InputError):
        parse_e6axis(f"{{E6AXIS: A1 {text.replace(' ', '?')}, A2 -90.0, A3 90.0, A4 0.0, A5 15.0, A6 0.0}}")


@pytest.mark.parametrize(("text", "number"), [("-12.5", -12.5), ("+.5e1", 5.0), ("7.", 7.0), ("007", 7.0)])
def test_numbers(text, number):
    assert parse_number(text) == number
    assert parse_whole("-0042") == -42


@pytest.mark.parametrize(
    ("flange", "believed"),
    [
        (FLANGE, True),
        (KukaPose(0, 0, 0, 0, 0, 0), False),
        (KukaPose(*(value / 1000 for value in FLANGE.values()[:3]), *REST[2:]), False),
        (KukaPose(9.0, 4.0, 2.0, 0, 0, 0), False),
        (KukaPose(99_000, 0, 0, 0, 0, 0), False),
    ],
)
def test_reach(flange, believed):
    assert (out_of_reach(flange) is None) == believed


def test_jumps():
    joints = Arm(FLANGE).joints_deg
    here = Told(FLANGE, 10.0, joints)
    far = KukaPose(X + 2000.0, *REST)
    assert "jumped by 2000.0 mm" in jumped(here, Told(far, 10.1))
    assert jumped(here, Told(far, 11.0)) is None  # without joints: there was time for it
    assert "the joints turned by 0.000" in jumped(here, Told(far, 3600.0, joints))
    turned = KukaPose(X, *REST[:2], REST[2] + 90.0, *REST[3:])
    assert "90.0 degrees" in jumped(here, Told(turned, 10.01))
    near = KukaPose(X + 20.0, *REST)
    assert jumped(here, Told(near, 10.1, Arm(near).joints_deg)) is None


@pytest.mark.parametrize("axis", range(6))
def test_joints_and_pose(axis):
    joints = Arm(FLANGE).joints_deg
    wrong = tuple(angle + 10.0 * (index == axis) for index, angle in enumerate(joints))
    root, arm = KukaPose(0, 0, 0, 0, 0, 0).matrix(), ArmGeometry(*LENGTHS)
    assert contradicted(Told(FLANGE, 0.0, joints), root, None, 10.0, 0.5) is None
    assert contradicted(Told(FLANGE, 0.0, joints), root, arm, 0.01, 0.01) is None
    assert "degrees" in contradicted(Told(FLANGE, 0.0, wrong), root, None, 10.0, 0.5)
    moved = KukaPose(X + 11.0, *REST)
    assert contradicted(Told(moved, 0.0, joints), root, None, 10.0, 0.5) is None  # lengths unknown: cannot be seen
    assert "11.0 mm" in contradicted(Told(moved, 0.0, joints), root, arm, 10.0, 0.5)
    # A robot on a wall: what the joints say is of its foot.
    wall = KukaPose(100.0, 200.0, 300.0, 0.0, 90.0, 0.0)
    flange = KukaPose.from_matrix(wall.matrix() @ FLANGE.matrix())
    assert contradicted(Told(flange, 0.0, joints), root, None, 10.0, 0.5) is not None
    assert contradicted(Told(flange, 0.0, joints), wall.matrix(), arm, 0.01, 0.01) is None


def connected(link, arm, **settings):
    settings = {"timeout_s": 0.6, "reconnect_s": 2.0, **settings}
    match link:
        case "rsi":
            robot = RsiRobot(RsiSettings(port=0, **settings))
            return RsiController(arm, port=robot.port, cycle_s=0.004), robot
        case "eki":
            controller = EkiController(arm)
            return controller, EkiRobot(EkiSettings(port=controller.port, **settings))
        case "serial":
            controller = SerialController(arm)
            return controller, SerialRobot(SerialSettings(port=controller.port, **settings))
    controller = KvpController(arm)
    return controller, KvpRobot(KvpSettings(port=controller.port, **settings))


@pytest.mark.parametrize("link", ["kvp", "eki", "serial", "rsi"])
def test_zeros_and_metres_are_no_pose(link, monkeypatch):
    controller, robot = connected(link, Arm(FLANGE))
    with controller, robot:
        robot.pose()
        joints = controller.arm.joints_deg
        for lie in (KukaPose(0, 0, 0, 0, 0, 0), KukaPose(*(v / 1000 for v in FLANGE.values()[:3]), *REST[2:])):
            monkeypatch.setattr(controller.arm, "told", lambda fault, lie=lie: (lie, joints))
            monkeypatch.setattr(controller.arm, "position", lambda fault, lie=lie: lie)
            time.sleep(0.05)
            with pytest.raises(DeviceError, match="cannot be"):
                robot.pose()


@pytest.mark.parametrize("link", ["kvp", "eki", "serial", "rsi"])
def test_a_jump_is_not_believed_the_second_time(link, monkeypatch):
    controller, robot = connected(link, Arm(FLANGE))
    with controller, robot:
        robot.pose()
        joints, far = controller.arm.joints_deg, KukaPose(X + 2000.0, *REST)
        monkeypatch.setattr(controller.arm, "told", lambda fault: (far, joints))
        monkeypatch.setattr(controller.arm, "position", lambda fault: far)
        if link != "kvp":
            time.sleep(0.5)  # long enough for any arm; but the joints stand
        for _ in range(3):
            with pytest.raises(DeviceError, match="jumped"):
                robot.pose()


@pytest.mark.parametrize("link", ["eki", "serial", "rsi"])
def test_joints_that_do_not_hold_the_pose(link, monkeypatch):
    controller, robot = connected(link, Arm(FLANGE))
    a1, *others = controller.arm.joints_deg
    with controller, robot:
        monkeypatch.setattr(controller.arm, "told", lambda fault: (FLANGE, (a1 + 1.0, *others)))
        time.sleep(0.05)
        for ask in (robot.pose, robot.joints):
            with pytest.raises(DeviceError, match="contradict"):
                ask()


@pytest.mark.parametrize("lie", ["5_0_0", "٥٠٠"])
@pytest.mark.parametrize("link", ["eki", "serial", "rsi"])
def test_no_link_takes_what_is_no_number(link, lie, monkeypatch):
    """Where the number stands that it would be: Python alone would read 500."""
    arm = Arm(KukaPose(500.0, *FLANGE.values()[1:]))
    controller, robot = connected(link, arm)
    with controller, robot:
        assert robot.pose().flange.x_mm == 500.0
        if link == "rsi":
            packet = controller.packet

            def spoilt(fault=None):
                return re.sub(rb'X="500[^"]*"', f'X="{lie}"'.encode(), packet(fault))

            monkeypatch.setattr(controller, "packet", spoilt)
        else:
            composed = controller._composed

            def spoilt(number, fault):
                if link == "eki":
                    return composed(number, fault).replace(b'"500.0"', f'"{lie}"'.encode())
                _, texts = decode_line(composed(number, fault))
                line = encode_line(number, [int(text) for text in texts[:3]])[: -len("*12345\r\n")].rstrip(b"*")
                text = line + f",{lie},".encode() + ",".join(texts[4:]).encode()
                return text + b"*%d\r\n" % checksum(text)

            monkeypatch.setattr(controller, "_composed", spoilt)
        time.sleep(0.05)
        with pytest.raises(DeviceError):
            robot.pose()


def test_every_inserted_digit_is_seen_without_a_checksum():
    """EthernetKRL: each digit place of every number of the reading."""
    arm = Arm(FLANGE, tool=KukaPose(12.5, -3.25, 180.0, 15.0, -40.0, 5.0))
    with EkiController(arm) as controller, EkiRobot(EkiSettings(port=controller.port)) as robot:
        whole = controller._composed(1, None)
        number, values = robot._reply(whole)
        assert number == 1
        spoilt = 0
        for group in re.finditer(rb"<(Position|Tool|Base|Axis) [^>]*>", whole):
            for place in re.finditer(rb"(?<=\d)(?=[\d.])", group[0]):
                at = group.start() + place.start()
                if whole[at - 2 : at] in (b'"A', b" A"):
                    continue  # the name of a joint
                try:
                    assert robot._reply(whole[:at] + b"7" + whole[at:])[1] == values  # beyond what a double holds
                except DeviceError:
                    spoilt += 1
        assert spoilt > 100


@pytest.mark.parametrize("link", ["kvp", "eki", "serial"])
def test_largest_turn(link):
    arm = Arm(FLANGE)
    controller, robot = connected(link, arm, allow_motion=True, largest_turn_deg=20.0)
    with controller, robot:
        turned = KukaPose(X, *REST[:2], REST[2] + 25.0, *REST[3:])
        with pytest.raises(DeviceError, match=r"turned by \d+ degrees, largest_turn_deg = 20"):
            robot.move_to(turned)
        with pytest.raises(DeviceError, match="the target: the flange cannot be"):
            robot.move_to(KukaPose(0, 0, 0, 0, 0, 0))
        assert distance(arm.flange(), FLANGE)[0] < 1e-6
