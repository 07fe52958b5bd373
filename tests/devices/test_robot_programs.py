"""Our programs on the simulated controllers: stale FIFOs, missing elements, targets told back, and the word to go."""

import contextlib
import re
import socket
import time

import pytest

from weldscan import DeviceError, DeviceTimeout, KukaPose
from weldscan.devices.robots import RESPITE_S, wire
from weldscan.devices.robots.eki import OURS, EkiConfig, EkiRobot, EkiSettings, compose, dissect
from weldscan.devices.robots.kvp import KvpRobot, KvpSettings
from weldscan.devices.robots.plausible import distance
from weldscan.devices.robots.program import Command, Status
from weldscan.devices.robots.serial import SerialRobot, SerialSettings
from weldscan.devices.robots.wire import Deadline, TcpTransport, cut_xml, parse_xml, xml_text
from weldscan.errors import InputError
from weldscan.pose import format_frame
from weldscan.simulated.controllers import Arm
from weldscan.simulated.controllers.eki import EkiController
from weldscan.simulated.controllers.kvp import KvpController
from weldscan.simulated.controllers.serial import SerialController

FLANGE = KukaPose(1610.825, -148.476, 981.652, -29.008, 23.236, 74.641)
NEAR = KukaPose(1612.825, *FLANGE.values()[1:])
TIMEOUT_S = 0.6
LATE_S = 0.7
ZERO = (0.0,) * 6


@pytest.fixture
def arm():
    return Arm(FLANGE)


def eki_request(number, command, target=ZERO):
    values = [number, int(command), *target]
    return compose(OURS.receive, dict(zip(OURS.receive, map(str, values), strict=True)))


class EkiPeer:
    """A client by hand."""

    def __init__(self, controller):
        self.socket = socket.create_connection(("127.0.0.1", controller.port), 2.0)
        self.socket.settimeout(2.0)
        self._buffer = bytearray()

    def say(self, message):
        self.socket.sendall(message)

    def hear(self):
        """Number and status of the next reply."""
        while (message := cut_xml(self._buffer)) is None:
            data = self.socket.recv(65536)
            if not data:
                raise ConnectionResetError
            self._buffer += data
        texts = list(dissect(OURS.send, message).values())
        return int(texts[0]), Status(int(texts[1]))


@pytest.fixture
def eki(arm):
    with EkiController(arm) as controller:
        peer = EkiPeer(controller)
        yield controller, peer
        peer.socket.close()


def wait_for(condition, seconds=3.0):
    stop = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < stop
        time.sleep(0.005)


# --- a motion takes two requests --------------------------------------------------------------------------------------


def test_target_alone_moves_nothing(eki, arm):
    controller, peer = eki
    peer.say(eki_request(5, Command.MOVE, NEAR.values()))
    assert peer.hear() == (5, Status.TAKEN)
    peer.say(eki_request(6, Command.GO))
    assert peer.hear() == (6, Status.LAPSED)  # of another number
    peer.say(eki_request(5, Command.GO))
    assert peer.hear() == (5, Status.LAPSED)  # and by that the target was dropped
    assert arm.begun_s == []
    peer.say(eki_request(7, Command.MOVE, NEAR.values()))
    assert peer.hear() == (7, Status.TAKEN)
    peer.say(eki_request(7, Command.GO))
    assert peer.hear() == (7, Status.DONE)
    assert len(arm.begun_s) == 1
    assert distance(arm.flange(), NEAR)[0] < 1e-6
    assert not controller._requests.waits


def test_go_for_nothing(eki, arm):
    _, peer = eki
    peer.say(eki_request(5, Command.MOVE, NEAR.values()))
    peer.say(eki_request(6, Command.POSE))
    peer.say(eki_request(0, Command.GO))
    assert [peer.hear() for _ in range(3)] == [(5, Status.TAKEN), (6, Status.DONE), (0, Status.LAPSED)]
    assert arm.begun_s == []


def test_go_comes_in_time_or_not_at_all(eki, arm):
    _, peer = eki
    peer.say(eki_request(5, Command.MOVE, NEAR.values()))
    assert peer.hear() == (5, Status.TAKEN)
    time.sleep(RESPITE_S + 0.1)
    peer.say(eki_request(5, Command.GO))
    assert peer.hear() == (5, Status.LAPSED)
    assert arm.begun_s == []


def test_stopped_program_forgets_by_the_clock(eki, arm):
    """The start key let go between the target and GO: timers run on."""
    controller, peer = eki
    peer.say(eki_request(5, Command.MOVE, NEAR.values()))
    assert peer.hear() == (5, Status.TAKEN)
    controller.running = False
    time.sleep(0.02)
    peer.say(eki_request(5, Command.GO))
    time.sleep(RESPITE_S + 0.1)
    controller.running = True
    assert peer.hear() == (5, Status.LAPSED)
    assert arm.begun_s == []


def test_arm_brakes_when_nobody_says_that_it_is_wanted(eki, arm):
    arm.speed_mm_s = 10.0
    _, peer = eki
    far = KukaPose(FLANGE.x_mm + 100.0, *FLANGE.values()[1:])
    peer.say(eki_request(5, Command.MOVE, far.values()))
    assert peer.hear() == (5, Status.TAKEN)
    peer.say(eki_request(5, Command.GO))
    time.sleep(1.0)
    peer.say(eki_request(5, Command.BEAT))
    start_s = time.monotonic()
    peer.socket.settimeout(5.0)
    assert peer.hear() == (5, Status.STOPPED)
    assert RESPITE_S - 0.1 < time.monotonic() - start_s < RESPITE_S + LATE_S
    assert not arm.moving
    assert 20.0 < distance(arm.flange(), FLANGE)[0] < 40.0


# --- FIFOs and flags outlive a client ---------------------------------------------------------------------------------


def test_a_client_that_vanished_moves_nothing(arm):
    """Its MOVE lies in the FIFOs of a program that stands; the next client is there when it goes on."""
    seen = []
    with EkiController(arm) as controller:
        controller.running = False
        gone = EkiPeer(controller)
        gone.say(eki_request(5, Command.MOVE, NEAR.values()))
        wait_for(lambda: all(len(fifo) == 1 for fifo in controller.fifos.values()))
        gone.socket.close()
        wait_for(lambda: not controller.flag1)
        settings = EkiSettings(port=controller.port, timeout_s=TIMEOUT_S, reconnect_s=3.0)
        with EkiRobot(settings) as robot:
            wait_for(lambda: controller.flag1)
            controller.running = True
            with pytest.raises(DeviceError, match="reply 5 to request"):
                robot.pose()  # what the program says to the vanished one
            give_up_s = time.monotonic() + 20.0
            while not seen and time.monotonic() < give_up_s:  # and what it may say to the connections dropped over that
                with contextlib.suppress(DeviceError):
                    seen.append(robot.pose().flange)
        assert seen
        assert all(distance(pose, FLANGE)[0] < 1e-6 for pose in seen)
        assert arm.begun_s == []


@pytest.mark.parametrize("lacking", [b"Id", b"Command", b"X", b"C"])
def test_what_lacks_in_a_request_is_not_taken_from_the_one_before(eki, arm, lacking):
    _, peer = eki
    peer.say(eki_request(5, Command.MOVE, NEAR.values()))
    assert peer.hear() == (5, Status.TAKEN)
    whole = eki_request(6, Command.MOVE, NEAR.values())
    peer.say(re.sub(b' %s="[^"]*"' % lacking, b"", whole, count=1))
    assert peer.hear()[1] is Status.GARBLED
    peer.say(eki_request(5, Command.GO))
    assert peer.hear() == (5, Status.LAPSED)
    peer.say(eki_request(8, Command.POSE))
    assert peer.hear() == (8, Status.DONE)  # and nothing is left over from it
    assert arm.begun_s == []


def test_whole_requests_are_served_one_by_one(eki):
    _, peer = eki
    peer.say(eki_request(5, Command.POSE) + eki_request(6, Command.BEAT) + eki_request(7, Command.POSE))
    assert [peer.hear(), peer.hear()] == [(5, Status.DONE), (7, Status.DONE)]


def test_lines_from_before_the_start_are_dropped(arm):
    with SerialController(arm) as controller:
        controller.running = False
        time.sleep(0.02)
        with SerialRobot(SerialSettings(port=controller.port, timeout_s=0.3)) as robot:
            with pytest.raises(DeviceTimeout):
                robot.pose()
            controller.interpreter.reset()
            controller.running = True
            time.sleep(0.05)
            assert distance(robot.pose().flange, FLANGE)[0] < 1e-5


@pytest.mark.parametrize("link", ["eki", "serial"])
def test_target_that_was_taken_otherwise(link, arm, monkeypatch):
    """A digit that got into the request on its way: it is told back, and never driven."""
    controller = EkiController(arm) if link == "eki" else SerialController(arm)
    kind = (EkiRobot, EkiSettings) if link == "eki" else (SerialRobot, SerialSettings)
    with controller, kind[0](kind[1](port=controller.port, timeout_s=TIMEOUT_S, allow_motion=True)) as robot:
        serve = controller._requests._receive

        def otherwise():
            request = serve()
            if request is None or request.command != Command.MOVE:
                return request
            return type(request)(request.number, request.command, KukaPose(1613.825, *request.target.values()[1:]))

        monkeypatch.setattr(controller._requests, "_receive", otherwise)
        with pytest.raises(DeviceError, match="took another target"):
            robot.move_to(NEAR)
        assert arm.begun_s == []


# --- KUKAVARPROXY: variables outlive everybody ------------------------------------------------------------------------


def test_variables_from_before_the_start_are_dropped(arm):
    with KvpController(arm) as controller:
        controller.variables["$PRO_STATE1"] = "#P_STOP"
        time.sleep(0.02)
        controller.variables |= {"COM_TARGET": format_frame(NEAR), "COM_ACTION": "7", "COM_GO": "7"}
        controller.interpreter.reset()
        controller.variables["$PRO_STATE1"] = "#P_ACTIVE"
        wait_for(lambda: controller.variables["COM_ACTION"] == "0")
        assert arm.begun_s == []


def test_request_without_anybody_lapses(arm):
    with KvpController(arm) as controller:
        controller.variables |= {"COM_TARGET": format_frame(NEAR), "COM_GO": "7", "COM_ACTION": "7"}
        wait_for(lambda: controller.variables["COM_ACTION"] == "0")
        assert controller.variables["COM_DONE"] == "7"
        assert controller.variables["COM_STATUS"] == str(int(Status.LAPSED))
        assert arm.begun_s == []


def test_every_error_of_a_motion_says_where_the_robot_is(arm, monkeypatch):
    settings = KvpSettings(port=1, allow_motion=True, timeout_s=TIMEOUT_S, move_timeout_s=0.5)
    arm.speed_mm_s = 5.0
    far = KukaPose(FLANGE.x_mm + 50.0, *FLANGE.values()[1:])
    with KvpController(arm) as controller, KvpRobot(settings.model_copy(update={"port": controller.port})) as robot:
        with pytest.raises(DeviceTimeout, match=r"did not finish.*the motion is withdrawn; the flange stands at 161"):
            robot.move_to(far)
        assert not arm.moving
        assert controller.variables["COM_ACTION"] == "0"

        def interrupted():
            raise KeyboardInterrupt

        monkeypatch.setattr(robot, "_lease", interrupted)
        with pytest.raises(KeyboardInterrupt, match="stopped: the motion is withdrawn; the flange stands at 161"):
            robot.move_to(far)
        assert controller.variables["COM_ACTION"] == "0"


# --- one deadline per question of the user ----------------------------------------------------------------------------


class SlowController(KvpController):
    """Takes nearly as long for every variable as a whole question may."""

    def answer(self, request, fault):
        time.sleep(0.4)
        return super().answer(request, fault)


def took_s(work):
    start_s = time.monotonic()
    with pytest.raises(DeviceError):
        work()
    return time.monotonic() - start_s


def silent():
    """A server that is there and takes no connection: its queue is full."""
    listener = socket.socket()
    listener.bind(("127.0.0.1", 0))
    listener.listen(0)
    full = []
    for _ in range(3):
        peer = socket.socket()
        peer.setblocking(False)
        peer.connect_ex(listener.getsockname())
        full.append(peer)
    return listener, full


def test_slow_answers_do_not_add_up(arm):
    with SlowController(arm) as controller, KvpRobot(KvpSettings(port=controller.port, timeout_s=0.5)) as robot:
        assert took_s(robot.pose) < 0.5 + LATE_S / 2


def test_nobody_takes_the_connection():
    listener, full = silent()
    port = listener.getsockname()[1]
    for robot in (
        lambda: SerialRobot(SerialSettings(port=f"socket://127.0.0.1:{port}", timeout_s=0.3)),
        lambda: EkiRobot(EkiSettings(port=port, timeout_s=0.3)),
    ):
        assert took_s(robot) < 0.3 + LATE_S
    for peer in (*full, listener):
        peer.close()


def test_silent_name_server(monkeypatch):
    monkeypatch.setattr(wire.socket, "getaddrinfo", lambda *args, **kinds: time.sleep(3.0))
    assert took_s(lambda: TcpTransport.connect("controller", 7000, time.monotonic() + 0.2)) < 0.2 + LATE_S


@pytest.mark.parametrize(
    "port", ["socket://", "socket://127.0.0.1", "socket://127.0.0.1:x", "socket://127.0.0.1:70000"]
)
def test_terminal_server_without_an_address(port):
    with pytest.raises(DeviceError, match="cannot open"):
        SerialRobot(SerialSettings(port=port))


def test_position_is_of_the_frames_of_its_own_moment(arm):
    """A connection is lost between the frames and the position, and comes back: all of it is read anew."""
    with KvpController(arm) as controller:
        settings = KvpSettings(port=controller.port, timeout_s=TIMEOUT_S, reconnect_s=5.0)
        with KvpRobot(settings) as robot:
            asked, get, lost = [], robot.get, []

            def watched(*names, deadline=None):
                asked.append((names[0], time.monotonic()))
                if names == ("$POS_ACT",) and not lost:
                    lost.append(True)
                    deadline.lose()
                    time.sleep(TIMEOUT_S + 0.1)
                return get(*names, deadline=deadline)

            robot.get = watched
            robot.pose()
            assert [name for name, _ in asked] == ["$TOOL", "$POS_ACT", "$TOOL"] * 2


def test_deadline():
    deadline = Deadline(0.5, 5.0)
    assert deadline.end_s - deadline.start_s == pytest.approx(0.5)
    deadline.lose()
    assert deadline.end_s - deadline.start_s == pytest.approx(5.0)


# --- XML --------------------------------------------------------------------------------------------------------------

DTD = '<!DOCTYPE Robot [<!ENTITY x "9">]>'
DECLARED = '<?xml version="1.0" encoding="{}"?>'


@pytest.mark.parametrize(
    "data",
    [
        *[(DECLARED.format(name) + DTD + "<Robot>&x;</Robot>").encode(name) for name in ("utf-16", "utf-32", "utf-7")],
        *[(DECLARED.format(name) + "<Robot/>").encode(name) for name in ("utf-16", "cp037", "latin-1", "utf-7")],
        (DTD + "<Robot>&x;</Robot>").encode("utf-16"),
        (DTD + "<Robot>&x;</Robot>").encode("utf-16-le"),
        "<Robot/>".encode("utf-16-be"),
        b'<Robot X="\xff"/>',
        b"<Robot>\0</Robot>",
    ],
)
def test_no_encoding_but_utf_8(data, tmp_path):
    with pytest.raises(DeviceError):
        parse_xml(data, "Robot")
    (tmp_path / "config.xml").write_bytes(data.replace(b"Robot", b"ETHERNETKRL"))
    with pytest.raises(InputError, match=r"config\.xml"):
        EkiConfig.read(tmp_path / "config.xml")
    if b"\0" in data:
        with pytest.raises(DeviceError):
            cut_xml(bytearray(data))


@pytest.mark.parametrize("encoding", ["utf-8", "UTF-8", "us-ascii", "ASCII"])
def test_utf_8_and_ascii(encoding):
    data = (DECLARED.format(encoding) + "<Robot/>").encode("ascii")
    assert parse_xml(data, "Robot").tag == "Robot"
    assert xml_text(data).endswith("<Robot/>")


def test_two_elements_where_one_should_be():
    values = dict.fromkeys(OURS.send, "1")
    whole = compose(OURS.send, values)
    with pytest.raises(DeviceError, match="2 elements <Position>"):
        dissect(OURS.send, whole.replace(b"<Position ", b'<Position X="7" /><Position ', 1))
