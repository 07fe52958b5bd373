"""Every link against its simulated controller: poses, motion, and one fault after the other."""

import contextlib
import math
import os
import re
import socket
import threading
import time

import numpy as np
import pytest

from weldscan import DeviceError, DeviceTimeout, KukaPose
from weldscan.devices.robots import distance, wait_until_still
from weldscan.devices.robots.eki import EkiRobot, EkiSettings
from weldscan.devices.robots.kinematics import ArmGeometry
from weldscan.devices.robots.kvp import READ, KvpRobot, KvpSettings, encode_request
from weldscan.devices.robots.rsi import RsiRobot, RsiSettings
from weldscan.devices.robots.serial import SerialRobot, SerialSettings, cut_line
from weldscan.devices.robots.wire import ConnectionLost, FileTransport, Link
from weldscan.pose import format_frame
from weldscan.simulated.controllers import Arm, LinkFault, TcpController
from weldscan.simulated.controllers.eki import EkiController
from weldscan.simulated.controllers.kvp import KvpController
from weldscan.simulated.controllers.rsi import RsiController
from weldscan.simulated.controllers.serial import SerialController

TIMEOUT_S = 0.6
LATE_S = 0.7
"""How far beyond its time-out an error may come: a machine that others load too."""
WIRE_MM, WIRE_DEG = 1e-5, 1e-5
"""Serial and RSI print six decimals."""

FLANGE = KukaPose(610.825, -148.476, 481.652, -29.008, 23.236, 74.641)
TOOL = KukaPose(12.5, -3.25, 180.0, 15.0, -40.0, 5.0)
BASE = KukaPose(900.0, 250.0, -120.0, 35.0, 4.0, -7.0)
NEAR = KukaPose(612.825, -147.476, 483.652, -28.008, 23.736, 74.141)
READS = 9
"""Questions per pose of the KVP link at most."""

STREAMS = ("kvp", "c3", "eki", "serial")
DISTINCT = ("kvp", "eki", "serial")
"""C3 Bridge moves and breaks as KUKAVARPROXY does."""
LINKS = (*STREAMS, "rsi")


def connect(link, arm, **settings):
    """A simulated controller and a robot that talks to it."""
    settings = {"timeout_s": TIMEOUT_S, "reconnect_s": 4.0, **settings}
    if link == "rsi":
        robot = RsiRobot(RsiSettings(port=0, tool=TOOL.values(), base=BASE.values(), **settings))
        return RsiController(arm, port=robot.port, cycle_s=0.004), robot
    if link == "eki":
        controller = EkiController(arm)
        return controller, EkiRobot(EkiSettings(port=controller.port, **settings))
    if link == "serial":
        controller = SerialController(arm)
        return controller, SerialRobot(SerialSettings(port=controller.port, **settings))
    controller = KvpController(arm, c3=link == "c3")
    dialect = "c3" if link == "c3" else "kukavarproxy"
    return controller, KvpRobot(KvpSettings(port=controller.port, dialect=dialect, **settings))


@pytest.fixture
def arm():
    return Arm(FLANGE, TOOL, BASE)


@pytest.fixture
def cell(request, arm):
    link, settings = request.param if isinstance(request.param, tuple) else (request.param, {})
    controller, robot = connect(link, arm, **settings)
    with controller, robot:
        yield controller, robot


every_link = pytest.mark.parametrize("cell", LINKS, indirect=True)
every_stream = pytest.mark.parametrize("cell", STREAMS, indirect=True)
moving_cells = pytest.mark.parametrize(
    "cell",
    [(link, {"allow_motion": True, "move_timeout_s": 0.8}) for link in DISTINCT],
    ids=DISTINCT,
    indirect=True,
)


def close_to(a, b):
    mm, deg = distance(a, b)
    return mm < WIRE_MM and deg < WIRE_DEG


@every_link
def test_flange_whichever_tool_and_base(cell, arm):
    _, robot = cell
    for base in (BASE, KukaPose(0, 0, 0, 0, 0, 0)) if not isinstance(robot, RsiRobot) else (BASE,):
        arm.base = base
        before = time.monotonic()
        pose = robot.pose()
        assert close_to(pose.flange, FLANGE)
        assert before <= pose.time_s <= time.monotonic()
    assert robot.joints() == pytest.approx(arm.joints_deg, abs=1e-5)


@every_link
def test_joints_hold_the_flange(cell, arm):
    _, robot = cell
    before = robot.joints()
    arm.place(NEAR)
    time.sleep(0.02)
    joints = robot.joints()
    assert len(joints) == 6
    assert joints != before
    # Six decimals of an angle, at the end of an arm of 3 m.
    assert np.abs(ArmGeometry().flange(joints)[:3, 3] - NEAR.values()[:3]).max() < 1e-3


@every_link
def test_follows_the_arm(cell, arm):
    _, robot = cell
    robot.pose()
    time.sleep(0.05)
    arm.place(NEAR)
    time.sleep(0.02)
    assert close_to(robot.pose().flange, NEAR)
    arm.move(FLANGE)
    seen = robot.pose().flange
    assert not close_to(seen, NEAR) or not arm.moving


@every_stream
def test_tool_fixed_in_the_room_is_refused(cell, arm):
    arm.interpolation = "#TCP"
    with pytest.raises(DeviceError, match="IPO_MODE"):
        cell[1].pose()


@every_link
def test_out_of_this_world(cell, arm):
    arm.place(KukaPose(50_000, 0, 0, 0, 0, 0))
    time.sleep(0.02)
    with pytest.raises(DeviceError, match="cannot be"):
        cell[1].pose()


def test_tool_that_keeps_changing(arm):
    controller, robot = connect("kvp", arm)
    with controller, robot:
        stop = threading.Event()

        def switch():
            while not stop.wait(0.0003):
                arm.tool = KukaPose(np.random.default_rng().uniform(0, 9), 0, 0, 0, 0, 0)

        thread = threading.Thread(target=switch)
        thread.start()
        try:
            for _ in range(5):
                try:
                    assert math.isfinite(robot.pose().flange.x_mm)
                except DeviceError as error:
                    assert "keep changing" in str(error) or "jumped" in str(error)
        finally:
            stop.set()
            thread.join()


# --- motion -----------------------------------------------------------------------------------------------------------


@every_link
def test_motion_is_off_by_default(cell, arm):
    with pytest.raises(DeviceError, match=r"motion is off|only reads"):
        cell[1].move_to(NEAR)
    assert close_to(arm.flange(), FLANGE)


@moving_cells
def test_moves_and_arrives(cell, arm):
    arm.speed_mm_s, arm.turn_speed_deg_s = 50.0, 20.0
    pose = cell[1].move_to(NEAR)
    assert distance(pose.flange, NEAR)[0] < 0.1
    assert close_to(arm.flange(), NEAR)


@moving_cells
@pytest.mark.parametrize("mode", ["#T2", "#AUT", "#EX"])
def test_motion_only_in_t1(cell, arm, mode):
    arm.mode = mode
    with pytest.raises(DeviceError, match="only in T1"):
        cell[1].move_to(NEAR)
    assert close_to(arm.flange(), FLANGE)


@moving_cells
def test_far_targets_are_refused(cell, arm):
    with pytest.raises(DeviceError, match="largest_move_mm"):
        cell[1].move_to(KukaPose(1610.825, *FLANGE.values()[1:]))
    assert close_to(arm.flange(), FLANGE)


@pytest.mark.parametrize("link", DISTINCT)
def test_targets_out_of_reach(link, arm):
    controller, robot = connect(link, arm, allow_motion=True, largest_move_mm=1e5)
    with controller, robot:
        with pytest.raises(DeviceError, match="out of reach"):
            robot.move_to(KukaPose(6000.0, *FLANGE.values()[1:]))
        assert close_to(robot.pose().flange, FLANGE)


@moving_cells
def test_word_of_arrival_is_not_believed(cell, arm, monkeypatch):
    monkeypatch.setattr(cell[0].interpreter, "ptp", lambda joints: iter(()))  # says done, and stays where it is
    with pytest.raises(DeviceTimeout, match="from the target"):
        cell[1].move_to(NEAR)


@moving_cells
def test_stale_pose_is_no_arrival(cell, arm):
    controller, robot = cell
    controller.inject(LinkFault.STALE, 100_000)
    with pytest.raises(DeviceTimeout):
        robot.move_to(NEAR)


def test_rsi_never_moves(arm):
    controller, robot = connect("rsi", arm, allow_motion=True)
    with controller, robot, pytest.raises(DeviceError, match="only reads"):
        robot.move_to(NEAR)


@pytest.mark.parametrize("state", [("$PRO_STATE1", "#P_STOP"), ("$PRO_NAME1[]", '"OTHER"')])
def test_kvp_needs_our_program_running(arm, state):
    controller, robot = connect("kvp", arm, allow_motion=True)
    with controller, robot:
        controller.variables[state[0]] = state[1]
        with pytest.raises(DeviceError, match="must be running"):
            robot.move_to(NEAR)
        assert close_to(arm.flange(), FLANGE)


def test_kvp_waits_for_a_motion_that_a_killed_client_began(arm):
    arm.speed_mm_s = 5.0
    controller, robot = connect("kvp", arm, allow_motion=True)
    with controller, robot:
        robot.set("COM_TARGET", format_frame(KukaPose(613.825, *FLANGE.values()[1:])))
        robot.set("COM_ACTION", "1")
        while robot.get("COM_TAKEN") != ["1"]:
            time.sleep(0.01)
        robot.set("COM_GO", "1")
        while not arm.moving:
            time.sleep(0.01)
        assert distance(robot.move_to(NEAR).flange, NEAR)[0] < 0.1


def single(text):
    """Every number in single precision, as a controller's REAL."""
    return re.sub(r"-?\d+\.\d+", lambda number: f"{np.float32(number[0]):.6f}", text)


@pytest.mark.parametrize(
    ("taken", "moves"),
    [
        (single, True),
        (lambda text: text.replace("X 612", "X 622"), False),
        (lambda text: "{}", False),
    ],
)
def test_kvp_target_as_the_controller_took_it(arm, monkeypatch, taken, moves):
    controller, robot = connect("kvp", arm, allow_motion=True)
    original = controller._set
    monkeypatch.setattr(
        controller, "_set", lambda name, value: original(name, taken(value) if name == "COM_TARGET" else value)
    )
    with controller, robot:
        if moves:
            assert distance(robot.move_to(NEAR).flange, NEAR)[0] < 0.1
        else:
            with pytest.raises(DeviceError):
                robot.move_to(NEAR)
            assert close_to(arm.flange(), FLANGE)


def test_still(arm):
    controller, robot = connect("eki", arm)
    with controller, robot:
        wait_until_still(robot, 0.1, 0.02, 0.01, 1.0)
        arm.speed_mm_s = 5.0
        arm.move(KukaPose(660.825, *FLANGE.values()[1:]))
        with pytest.raises(DeviceTimeout, match="stand still"):
            wait_until_still(robot, 0.1, 0.02, 0.01, 0.5)


# --- faults: every one ends in a typed error or a recovered pose, in time, and never in a wrong pose ------------------

RECOVERED = (LinkFault.BYTES, LinkFault.TWICE, LinkFault.RESET, LinkFault.RESTART)
TIMED_OUT = (LinkFault.SILENCE,)
REFUSED = (
    LinkFault.WRONG_ID,
    LinkFault.WRONG_LENGTH,
    LinkFault.EMPTY,
    LinkFault.GARBAGE,
    LinkFault.HUGE,
    LinkFault.NAN,
    LinkFault.JUMP,
)
XML_ONLY = (LinkFault.DTD, LinkFault.ENTITY)


def reads_within(robot, seconds):
    start = time.monotonic()
    try:
        return robot.pose().flange
    finally:
        assert time.monotonic() - start < seconds + LATE_S


def looks_unfinished(controller, fault):
    """Is more to be waited for, so that a time-out is the right answer?"""
    return (isinstance(controller, KvpController) and fault is LinkFault.GARBAGE) or (
        isinstance(controller, EkiController) and fault is LinkFault.WRONG_LENGTH
    )


def wait_for_quiet_line(robot):
    """10 MB take their time on a serial line: until they are through, every question ends in a typed error."""
    give_up_s = time.monotonic() + 30.0
    while time.monotonic() < give_up_s:
        try:
            robot.pose()
            return
        except DeviceError:
            time.sleep(0.05)


@pytest.mark.parametrize("cell", DISTINCT, indirect=True)
@pytest.mark.parametrize("fault", RECOVERED)
def test_recovers(cell, fault):
    controller, robot = cell
    controller.restart_s = 0.5
    controller.inject(fault)
    if isinstance(controller, SerialController) and fault in (LinkFault.RESET, LinkFault.RESTART):
        with pytest.raises(DeviceTimeout):  # a serial line knows no reset: half a reply is silence
            robot.pose()
    for _ in range(3):
        assert close_to(reads_within(robot, 4.0), FLANGE)


@pytest.mark.parametrize(
    ("cell", "fault"),
    [(link, fault) for link in DISTINCT for fault in REFUSED + TIMED_OUT] + [("eki", fault) for fault in XML_ONLY],
    indirect=["cell"],
)
def test_refused_and_then_right_again(cell, fault):
    controller, robot = cell
    robot.pose()
    controller.inject(fault, READS)
    kind = DeviceTimeout if fault in TIMED_OUT else DeviceError
    with pytest.raises(kind) as caught:
        reads_within(robot, TIMEOUT_S)
    if fault in REFUSED and not looks_unfinished(controller, fault):
        assert not isinstance(caught.value, DeviceTimeout), caught.value
    assert robot.name in str(caught.value)
    controller._faults.clear()
    if fault is LinkFault.HUGE and isinstance(controller, SerialController):
        wait_for_quiet_line(robot)
    assert close_to(reads_within(robot, TIMEOUT_S), FLANGE)


@pytest.mark.parametrize(
    "fault", [LinkFault.GARBAGE, LinkFault.EMPTY, LinkFault.NAN, LinkFault.HUGE, LinkFault.DTD, LinkFault.ENTITY]
)
def test_rsi_bad_packets(arm, fault):
    controller, robot = connect("rsi", arm)
    with controller, robot:
        robot.pose()
        controller.inject(fault, 10_000)
        time.sleep(0.02)
        with pytest.raises(DeviceError):
            reads_within(robot, TIMEOUT_S)
        controller._faults.clear()
        time.sleep(0.02)
        assert close_to(reads_within(robot, TIMEOUT_S), FLANGE)


@pytest.mark.parametrize("fault", [LinkFault.SILENCE, LinkFault.STALE])
def test_rsi_silence_and_a_stream_that_repeats_itself(arm, fault):
    controller, robot = connect("rsi", arm)
    with controller, robot:
        robot.pose()
        controller.inject(fault, 10_000)
        time.sleep(0.02)
        with pytest.raises(DeviceTimeout):
            reads_within(robot, TIMEOUT_S)


def test_rsi_jump_and_restart(arm):
    controller, robot = connect("rsi", arm, timeout_s=2.0)
    with controller, robot:
        robot.pose()
        controller.inject(LinkFault.RESTART)
        time.sleep(0.02)
        assert close_to(reads_within(robot, 2.0), FLANGE)
        controller.inject(LinkFault.JUMP, 50)
        with pytest.raises(DeviceError, match="jumped"):
            for _ in range(20):
                robot.pose()


def test_rsi_listens_to_its_controller_alone(arm):
    robot = RsiRobot(RsiSettings(port=0, timeout_s=0.3, controller="127.0.0.9"))
    with robot, RsiController(arm, port=robot.port), pytest.raises(DeviceTimeout):
        robot.pose()


def test_reset_is_a_reset():
    """Not an orderly end: what the client's socket says is ECONNRESET."""
    with KvpController(Arm(FLANGE)) as controller:
        controller.inject(LinkFault.RESET)
        with socket.create_connection(("127.0.0.1", controller.port), 2.0) as peer:
            peer.sendall(encode_request(1, READ, ["$POS_ACT"]))
            with pytest.raises(ConnectionResetError):
                while peer.recv(4096):
                    pass


@pytest.mark.parametrize(
    ("length", "content"),
    [
        ("longer than what comes", b"\x00\x01\xff\xff\x00\x00\x03#T1\x00\x01\x01"),
        ("shorter than what comes", b"\x00\x01\x00\x05\x00\x00\x03#T1\x00\x01\x01"),
        ("of nothing", b"\x00\x01\x00\x00"),
        ("of half a head", b"\x00\x01\x00"),
        ("right, the value's too long", b"\x00\x01\x00\x09\x00\x00\xff#T1\x00\x01\x01"),
        ("right, the value's too short", b"\x00\x01\x00\x09\x00\x00\x02#T1\x00\x01\x01"),
    ],
)
def test_lengths_that_lie(length, content):
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve():
            peer, _ = server.accept()
            with peer:
                peer.recv(100)
                peer.sendall(content)
                peer.recv(100)  # until the client hangs up

        thread = threading.Thread(target=serve)
        thread.start()
        robot = KvpRobot(KvpSettings(port=server.getsockname()[1], timeout_s=0.3))
        start = time.monotonic()
        with robot, pytest.raises(DeviceError):
            robot.get("$MODE_OP")
        assert time.monotonic() - start < 0.3 + LATE_S, length
        thread.join(5.0)
        assert not thread.is_alive()


def test_back_off():
    """A controller that is away is asked again with growing pauses, and given up when the time is over."""
    tried_s = []

    def connect(_deadline_s):
        tried_s.append(time.monotonic())
        raise ConnectionLost("nobody there")

    link = Link("link", connect, cut_line, 0.1, 2.0)
    start = time.monotonic()
    with pytest.raises(ConnectionLost, match="link: nobody there"):
        link.ask(b"?", lambda message: message)
    assert time.monotonic() - start < 2.0 + LATE_S
    pauses = np.diff(tried_s)
    assert pauses[:4] == pytest.approx([0.05, 0.1, 0.2, 0.4], abs=0.1)
    assert (np.diff(pauses[:4]) > 0).all()
    tried_s.clear()
    with pytest.raises(ConnectionLost):
        link.ask(b"move!", lambda message: message, repeat=False)
    assert len(tried_s) == 1  # what may have had an effect is not said twice


@pytest.mark.parametrize("link", ["kvp", "eki"])
def test_connection_refused(link):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    start = time.monotonic()
    with pytest.raises(DeviceError, match=str(port)):
        KvpRobot(KvpSettings(port=port)) if link == "kvp" else EkiRobot(EkiSettings(port=port))
    assert time.monotonic() - start < 1.0 + LATE_S


def test_serial_over_a_terminal_server(arm):
    """`socket://`, as a serial port on the network has it: bytes of a line over TCP."""

    class Server(TcpController):
        cut = answer = None  # it does not look at what it carries

        def serve(self, transport):
            line = FileTransport(os.open(controller.port, os.O_RDWR | os.O_NOCTTY))
            gone = threading.Event()

            def forward(source, drain):
                with contextlib.suppress(DeviceError, OSError):
                    while not (self._stop.is_set() or gone.is_set()):
                        with contextlib.suppress(DeviceTimeout):
                            drain.send(source.receive(time.monotonic() + 0.05), time.monotonic() + 1.0)
                gone.set()

            back = threading.Thread(target=forward, args=(line, transport))
            back.start()
            forward(transport, line)
            back.join()
            line.close()

    with SerialController(arm) as controller, Server(arm) as server:
        url = f"socket://127.0.0.1:{server.port}"
        with SerialRobot(SerialSettings(port=url, timeout_s=TIMEOUT_S, reconnect_s=2.0)) as robot:
            assert close_to(robot.pose().flange, FLANGE)
            server._hang_up()
            time.sleep(0.2)  # what still reads the line for the lost connection would take the answer
            assert close_to(reads_within(robot, 2.0), FLANGE)
        server.close()
        with pytest.raises(DeviceError, match="cannot open"):
            SerialRobot(SerialSettings(port=url, timeout_s=TIMEOUT_S))


def test_serial_port_missing():
    with pytest.raises(DeviceError, match="cannot open"):
        SerialRobot(SerialSettings(port="/dev/nothing-here"))


@pytest.mark.parametrize("link", ["kvp", "eki", "serial"])
def test_controller_gone_for_good(link, arm):
    controller, robot = connect(link, arm, reconnect_s=1.0)
    with robot:
        robot.pose()
        controller.close()
        with pytest.raises(DeviceError):
            reads_within(robot, 1.0 + TIMEOUT_S)


def test_rsi_port_taken():
    with RsiRobot(RsiSettings(port=0)) as first, pytest.raises(DeviceError, match="cannot listen"):
        RsiRobot(RsiSettings(port=first.port))


@every_link
def test_clock_going_back(cell, monkeypatch):
    monkeypatch.setattr(time, "time", lambda: 0.0)
    monkeypatch.setattr(time, "time_ns", lambda: 0)
    assert close_to(cell[1].pose().flange, FLANGE)


@every_stream
def test_many_threads_one_robot(cell):
    _, robot = cell
    results = []
    threads = [threading.Thread(target=lambda: results.append(robot.read().flange())) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 8
    assert all(close_to(flange, FLANGE) for flange in results)


def test_heartbeat(arm, monkeypatch):
    monkeypatch.setattr("weldscan.devices.robots.kvp.HEARTBEAT_S", 0.1)
    controller, robot = connect("kvp", arm)
    with controller, robot:
        robot.pose()
        before = robot._number
        time.sleep(0.5)
        assert robot._number > before


def test_rsi_answering_process_dies_and_never_outlives_the_robot(arm):
    controller, robot = connect("rsi", arm)
    with controller, robot:
        robot.pose()
        robot._process.kill()
        robot._process.wait()
        with pytest.raises(DeviceTimeout):
            for _ in range(100):
                robot.pose()
    robot = RsiRobot(RsiSettings(port=0))
    robot.close()
    assert robot._process.poll() is not None
