"""Bytes on the wire, against published samples and against configurations that nobody here wrote."""

import contextlib
import socket
import time
from pathlib import Path
from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from conftest import shared
from weldscan import DeviceError, InputError, KukaPose
from weldscan.devices.robots import kvp
from weldscan.devices.robots.eki import OURS, EkiConfig, compose, dissect
from weldscan.devices.robots.rsi import RsiRobot, RsiSettings
from weldscan.devices.robots.rsi_answer import answer
from weldscan.devices.robots.serial import checksum, cut_line, decode_line, encode_line
from weldscan.devices.robots.wire import cut_xml, parse_xml
from weldscan.simulated.controllers import Arm, LinkFault
from weldscan.simulated.controllers.eki import EkiController, EkiUdpController
from weldscan.simulated.controllers.kvp import KvpController
from weldscan.simulated.controllers.rsi import RsiController

POSE = KukaPose(610.825, -148.476, 481.652, -29.008, 23.236, 74.641)
KRL = Path(__file__).resolve().parents[2] / "krl"


# --- KUKAVARPROXY and C3 Bridge ---------------------------------------------------------------------------------------


def test_kvp_bytes_of_the_description():
    read = kvp.encode_request(1, kvp.READ, ["$POS_ACT"])
    assert read == bytes.fromhex("00 01 00 0b 00 00 08 24 50 4f 53 5f 41 43 54")
    write = kvp.encode_request(2, kvp.WRITE, ["COM_ACTION", "1"])
    assert write == bytes.fromhex("00 02 00 10 01 00 0a 43 4f 4d 5f 41 43 54 49 4f 4e 00 01 31")
    value = "{E6POS: X 1.0" + " " * 138 + "}"
    reply = kvp.encode_reply(1, kvp.READ, [value])
    assert reply[:7] == bytes.fromhex("00 01 00 9e 00 00 98")
    assert reply[-3:] == bytes.fromhex("00 01 01")
    # The field before the last byte is 1 in the samples, 0 elsewhere: the last byte alone tells success.
    for end in ("00 01 01", "00 00 01"):
        assert kvp.decode_reply(reply[:-3] + bytes.fromhex(end), 1, kvp.READ) == [value]
    for end in ("00 00 00", "00 01 00"):
        with pytest.raises(DeviceError, match="refused"):
            kvp.decode_reply(reply[:-3] + bytes.fromhex(end), 1, kvp.READ)


def test_unknown_variable_as_either_program_says_it():
    empty = bytes.fromhex("00 01 00 06 00 00 00")
    with pytest.raises(DeviceError, match="empty"):
        kvp.decode_reply(empty + bytes.fromhex("00 01 01"), 1, kvp.READ)
    with pytest.raises(DeviceError, match="refused"):
        kvp.decode_reply(empty + bytes.fromhex("00 00 00"), 1, kvp.READ)


def test_kvp_no_byte_of_a_reply_may_be_another():
    """Whatever stands around the value decides whether it is the answer; only the 16-bit error field says nothing."""
    reply = kvp.encode_reply(7, kvp.READ, ["{FRAME: X 1.0}"])
    ignored = {len(reply) - 3, len(reply) - 2}
    for place in [*range(7), *range(len(reply) - 3, len(reply))]:
        for byte in range(256):
            changed = reply[:place] + bytes([byte]) + reply[place + 1 :]
            if changed == reply or place in ignored:
                assert kvp.decode_reply(changed, 7, kvp.READ) == ["{FRAME: X 1.0}"]
                continue
            with pytest.raises(DeviceError):
                kvp.decode_reply(changed, 7, kvp.READ)
    for end in range(len(reply)):
        with pytest.raises(DeviceError):
            kvp.decode_reply(reply[:end], 7, kvp.READ)


def samples():
    """Pairs of request and reply."""
    lines = shared("robot/c3_frames.txt").read_text().splitlines()
    frames = [
        (line.split(" ", 1)[0], bytes.fromhex(line.split(" ", 1)[1])) for line in lines if not line.startswith("#")
    ]
    assert [kind for kind, _ in frames] == ["request", "response"] * (len(frames) // 2)
    return [(frames[i][1], frames[i + 1][1]) for i in range(0, len(frames), 2)]


def test_published_frames():
    known = 0
    for request, reply in samples():
        for frame in (request, reply):
            buffer = bytearray(frame + b"\x07")
            assert kvp.cut_frame(buffer) == frame
            assert buffer == b"\x07"
        function = request[4]
        if function > kvp.WRITE_MANY:
            continue  # commands of C3 Bridge that start programs and move: not ours to send
        known += 1
        number, decoded, texts = kvp.decode_request(request)
        assert decoded == function
        assert kvp.encode_request(number, function, texts) == request
        count = 2 if function in (kvp.READ_MANY, kvp.WRITE_MANY) else 1
        values = kvp.decode_reply(reply, number, function, count)
        assert kvp.encode_reply(number, function, values) == reply
    assert known == 6


@pytest.mark.parametrize(
    ("name", "value"),
    [("$ACCU_STATE", "#CHARGE_OK"), ("$OV_PRO", "35"), ("$ACT_BASE", "1")],
)
def test_published_values(name, value):
    found = [
        kvp.decode_reply(reply, *kvp.decode_request(request)[:2])
        for request, reply in samples()
        if request[4] < kvp.READ_MANY and kvp.decode_request(request)[2][0] == name
    ]
    assert [value] in found


@given(st.integers(0, 65535), st.sampled_from([0, 4]), st.text(st.characters(codec="ascii"), min_size=1, max_size=200))
def test_kvp_round_trip(number, function, text):
    assert kvp.decode_request(kvp.encode_request(number, function, [text])) == (number, function, [text])
    assert kvp.decode_reply(kvp.encode_reply(number, function, [text]), number, function) == [text]


@given(st.binary(max_size=60))
def test_kvp_any_bytes_end_in_a_device_error(data):
    for function in (kvp.READ, kvp.READ_UNICODE, kvp.READ_MANY):
        frame = b"\x00\x01" + (len(data) + 1).to_bytes(2, "big") + bytes([function]) + data
        try:
            values = kvp.decode_reply(frame, 1, function)
        except DeviceError:
            continue
        assert len(values) == 1
        assert values[0]


def test_unknown_variable_is_an_error_with_either_dialect():
    for c3 in (False, True):
        dialect = "c3" if c3 else "kukavarproxy"
        with (
            KvpController(c3=c3) as controller,
            kvp.KvpRobot(kvp.KvpSettings(port=controller.port, dialect=dialect)) as robot,
            pytest.raises(DeviceError),
        ):
            robot.get("$NO_SUCH_VARIABLE")


# --- XML --------------------------------------------------------------------------------------------------------------


@given(st.lists(st.integers(1, 40), max_size=12))
def test_xml_framing_whatever_the_split(cuts):
    first = b'<?xml version="1.0"?><Robot><Robots X="1"/><A>x</A></Robot>'
    stream = first + b" \n" + b'<Robot X="1"/>' + b"<Robot></Robot >"
    buffer, messages, position = bytearray(), [], 0
    for size in [*cuts, len(stream)]:
        buffer += stream[position : position + size]
        position += size
        while (message := cut_xml(buffer)) is not None:
            messages.append(message)
    assert messages == [first, b'<Robot X="1"/>', b"<Robot></Robot >"]
    assert not buffer


@pytest.mark.parametrize(
    "data",
    [
        b'<!DOCTYPE Robot SYSTEM "http://127.0.0.1/x.dtd"><Robot/>',
        b'<!DOCTYPE Robot [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><Robot>&b;</Robot>',
        b"<Robot><![CDATA[x]]></Robot>",
        b"not XML at all",
        b"\x00\xff\xfe",
    ],
)
def test_xml_refused(data):
    with pytest.raises(DeviceError):
        cut_xml(bytearray(data))
    with pytest.raises(DeviceError):
        parse_xml(data, "Robot")


@pytest.mark.parametrize(
    "data",
    [b"<Robot>&undefined;</Robot>", b"<Robot>", b"<Other/>", b"", b'<?xml version="1.0" encoding="no"?><Robot/>'],
)
def test_xml_not_parsed(data):
    with pytest.raises(DeviceError):
        parse_xml(data, "Robot")


@given(st.binary(max_size=200))
def test_xml_any_bytes(data):
    try:
        cut_xml(bytearray(data))
        parse_xml(data, "Robot")
    except DeviceError:
        pass


# --- EthernetKRL ------------------------------------------------------------------------------------------------------


def receive_xml(peer):
    buffer = bytearray()
    while (message := cut_xml(buffer)) is None:
        buffer += peer.recv(4096)
    return message


def test_our_configuration_file_says_what_the_code_does():
    assert EkiConfig.read(KRL / "WeldscanEki.xml") == OURS


def test_eki_state_stream():
    config = EkiConfig.read(shared("robot/eki/ros_eki_state.xml"))
    assert (config.port, config.protocol, len(config.send), config.receive) == (54601, "TCP", 14, ())
    with (
        EkiController(Arm(POSE), config=config) as controller,
        socket.create_connection(("127.0.0.1", controller.port), 2.0) as peer,
    ):
        root = ElementTree.fromstring(receive_xml(peer))
    assert root.tag == "RobotState"
    position = root.find("Pos")
    assert [float(position.get(name)) for name in "XYZABC"] == pytest.approx(POSE.values())
    assert set(root.find("Axis").attrib) == {"A1", "A2", "A3", "A4", "A5", "A6"}


def test_eki_motion_commands():
    config = EkiConfig.read(shared("robot/eki/ros_eki_motion.xml"))
    assert len(config.receive) == 14
    arm = Arm(POSE)
    arm.speed_mm_s = 1e6
    target = (600.0, -150.0, 480.0, -29.0, 23.0, 74.0)
    pose = " ".join(f'{name}="{value}"' for name, value in zip("XYZABC", target, strict=True))
    axis = " ".join(f'A{i}="0.0"' for i in range(1, 7))
    command = f"<RobotCommand><Type>3</Type><Axis {axis}/><Cart {pose}/><Velocity>0.1</Velocity></RobotCommand>"
    with (
        EkiController(arm, config=config) as controller,
        socket.create_connection(("127.0.0.1", controller.port), 2.0) as peer,
    ):
        peer.sendall(command.encode())
        wait_for(lambda: arm.flange().values() == pytest.approx(target))


def test_eki_over_udp():
    config = EkiConfig.read(shared("robot/eki/EkiHwInterface.xml"))
    assert (config.protocol, len(config.receive), len(config.send)) == ("UDP", 6, 19)
    arm = Arm()
    arm.speed_mm_s = arm.turn_speed_deg_s = 1e4
    with EkiUdpController(config, arm) as controller, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.settimeout(2.0)
        joints = " ".join(f'A{i}="{i}.5"' for i in range(1, 7))
        peer.sendto(f"<RobotCommand><Pos {joints}/></RobotCommand>".encode(), ("127.0.0.1", controller.port))
        wanted = pytest.approx([i + 0.5 for i in range(1, 7)])

        def there():
            root = ElementTree.fromstring(peer.recv(4096))
            assert root.tag == "RobotState"
            assert root.find("RobotCommand").get("Size") == "0"
            return [float(root.find("Pos").get(f"A{i}")) for i in range(1, 7)] == wanted

        wait_for(there)


def test_eki_messages_hold_every_element():
    values = {element: str(number) for number, element in enumerate(OURS.send)}
    assert dissect(OURS.send, compose(OURS.send, values)) == values
    whole = compose(OURS.send, values)
    for bad in (
        whole.replace(b'Id="0"', b""),
        whole.replace(b'Id="0"', b'Id=""'),
        whole.replace(b'Id="0"', b'Id="inf"'),
    ):
        with pytest.raises(DeviceError, match="Id"):
            dissect(OURS.send, bad)


def test_eki_configuration_from_outside(tmp_path):
    for text in ("<!DOCTYPE x><ETHERNETKRL/>", "garbage", "<E><RECEIVE><XML><ELEMENT/></XML></RECEIVE></E>"):
        (tmp_path / "config.xml").write_text(text)
        with pytest.raises(InputError):
            EkiConfig.read(tmp_path / "config.xml")


# --- RSI --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["Type", "TYPE"])
def test_rsi_answer(kind):
    packet = b'<Rob %s="KUKA"><RIst X="1.0"/><Delay D="0"/><IPOC>0001343092</IPOC></Rob>' % kind.encode()
    reply = answer(packet, "ImFree")
    root = ElementTree.fromstring(reply)
    assert (root.tag, root.get("Type"), root.findtext("IPOC")) == ("Sen", "ImFree", "0001343092")
    assert set(root.find("RKorr").attrib.values()) == {"0.0"}
    assert answer(b"<Rob/>", "ImFree") is None


@pytest.mark.parametrize("name", ["fzi_ros_rsi_ethernet.xml", "rosi_ros_rsi_ethernet.xml"])
def test_rsi_configurations(name):
    config = ElementTree.parse(shared("robot/rsi") / name).find("CONFIG")
    kind, only_send = config.findtext("SENTYPE"), config.findtext("ONLYSEND") == "TRUE"
    robot = RsiRobot(RsiSettings(port=0, sen_type=kind, only_send=only_send))
    with (
        robot,
        RsiController(Arm(POSE), port=robot.port, cycle_s=0.012, sen_type=kind, only_send=only_send) as controller,
    ):
        assert robot.pose().flange.values() == pytest.approx(POSE.values(), abs=1e-5)
        wait_for(lambda: controller.cycles >= 20)
    assert controller.wrong == 0
    assert controller.late <= 1 + controller.cycles // 10  # the first cycle may come before the client


def test_rsi_only_send_is_not_answered():
    robot = RsiRobot(RsiSettings(port=0, only_send=True))
    with robot, RsiController(Arm(POSE), port=robot.port, cycle_s=0.004, only_send=True):
        assert robot.pose().flange.values() == pytest.approx(POSE.values(), abs=1e-5)
        assert robot.answered == 0


def test_rsi_type_in_capitals():
    robot = RsiRobot(RsiSettings(port=0))
    with robot, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        reading = RsiController.packet.__get__(_Packet(), _Packet)().replace(b"Type=", b"TYPE=")
        stop = time.monotonic() + 1.0
        import threading

        def send():
            number = 0
            while time.monotonic() < stop:
                number += 4
                peer.sendto(reading.replace(b"1343092", b"%d" % number), ("127.0.0.1", robot.port))
                time.sleep(0.004)

        thread = threading.Thread(target=send)
        thread.start()
        assert robot.pose().flange.values() == pytest.approx(POSE.values(), abs=1e-5)
        thread.join()


class _Packet:
    """As much of a controller as composing a packet needs."""

    arm, late, ipoc = Arm(POSE), 0, 1343092


# --- serial -----------------------------------------------------------------------------------------------------------


def fletcher_oracle(data):
    """Both sums written out."""
    low = sum(data) % 255
    high = sum((len(data) - i) * byte for i, byte in enumerate(data)) % 255
    return 256 * high + low


@given(st.binary(max_size=300))
def test_checksum(data):
    assert checksum(data) == fletcher_oracle(data)


def test_lines():
    line = encode_line(7, [1, 2.5])
    assert line == b"7,1,2.500000*%d\r\n" % fletcher_oracle(b"7,1,2.500000")
    assert b" " not in line  # at which a controller may end what it reads
    assert decode_line(line) == (7, ["1", "2.500000"])
    buffer = bytearray(line + b"8 ")
    assert cut_line(buffer) == line
    assert buffer == b"8 "
    for bad in (
        line.replace(b"2.5", b"5.2"),
        line.replace(b"7", b"8"),
        b"7,1\r\n",
        b"*\r\n",
        b"x*%d\r\n" % checksum(b"x"),
        b"1_0,1*%d\r\n" % checksum(b"1_0,1"),
    ):
        with pytest.raises(DeviceError):
            decode_line(bad)


@given(st.binary(max_size=80))
def test_serial_any_bytes(data):
    with contextlib.suppress(DeviceError):
        decode_line(data)


def wait_for(condition, seconds=5.0):
    stop = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < stop
        time.sleep(0.01)


def test_every_fault_has_a_name():
    assert {fault.value for fault in LinkFault} == {fault.name.lower().replace("_", "-") for fault in LinkFault}
