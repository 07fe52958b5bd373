"""KUKAVARPROXY and C3 Bridge: variables of a KUKA controller by name, over TCP (port 7000). The default link.

A request is `u16 id, u16 length, u8 function, u16 n, name[, u16 m, value]`, a reply `u16 id, u16 length, u8 function,
u16 n, value, u16 error, u8 ok`, big-endian, the length counting what follows it. Functions 0 and 1 read and write in
ASCII; C3 Bridge alone knows 4 to 7, with text in UTF-16LE and several variables at once. Motion goes through
`krl/weldscan_kvp.src`.
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Sequence
from functools import partial
from typing import Annotated, Literal

from pydantic import Field

from weldscan.devices.robots import POLL_S, Reading, RobotSettings, StreamRobot, distance
from weldscan.devices.robots.wire import Host, TcpTransport
from weldscan.errors import DeviceError, DeviceTimeout, InputError
from weldscan.pose import KukaPose, format_frame, parse_e6axis, parse_e6pos, parse_frame

READ, WRITE, READ_UNICODE, WRITE_UNICODE, READ_MANY, WRITE_MANY = 0, 1, 4, 5, 6, 7
LAST_NUMBER = 65_535
"""Ids have 16 bits."""
HEARTBEAT_S = 20.0
"""The controller hangs up on a client that is silent for 30 s."""
DONE, REFUSED = b"\x00\x01\x01", b"\x00\x00\x00"
"""How a reply ends: a 16-bit field that the published samples fill with 1 and 0, and the byte that tells success."""
PROGRAM = "WELDSCAN_KVP"
SINGLE_MM, SINGLE_DEG = 0.002, 1e-3
"""A controller keeps REAL in single precision: 0.0005 mm at 10 m, and less than 1e-4 degrees."""
FRAME_NAMES = ("$TOOL", "$BASE", "$IPO_MODE", "$MODE_OP")


class KvpSettings(RobotSettings):
    """`[robot]` with `link = "kvp"`."""

    link: Literal["kvp"] = "kvp"
    host: Host = "127.0.0.1"
    port: Annotated[int, Field(ge=1, le=65535)] = 7000
    dialect: Literal["kukavarproxy", "c3"] = "kukavarproxy"
    """C3 Bridge reads several variables with one request."""


# --- the wire ---------------------------------------------------------------------------------------------------------


def cut_frame(buffer: bytearray) -> bytes | None:
    """Cut one request or reply: four bytes of head, then as many as the head says."""
    if len(buffer) < 4:
        return None
    end = 4 + int.from_bytes(buffer[2:4], "big")
    if len(buffer) < end:
        return None
    frame = bytes(buffer[:end])
    del buffer[:end]
    return frame


def encode_request(number: int, function: int, texts: Sequence[str]) -> bytes:
    """Return a request. `texts`: the name; name and value; names; or names and values in turn."""
    many = function in (READ_MANY, WRITE_MANY)
    body = bytes([function])
    if many:
        body += bytes([len(texts) // (2 if function == WRITE_MANY else 1)])
    return framed(number, body + b"".join(_text(text, function) for text in texts))


def decode_request(frame: bytes) -> tuple[int, int, list[str]]:
    """Return id, function and texts of a request."""
    number, function, rest = _body(frame)
    if function in (READ_MANY, WRITE_MANY):
        rest = rest[1:]
    texts = []
    while rest:
        text, rest = _take_text(rest, function)
        texts.append(text)
    return number, function, texts


def encode_reply(number: int, function: int, values: Sequence[str | None], ok: bool = True) -> bytes:
    """Return a reply; None stands for a variable that could not be read."""
    body = bytes([function])
    if function in (READ_MANY, WRITE_MANY):
        body += bytes([len(values)])
        body += b"".join(bytes([value is not None]) + _text(value or "", function) for value in values)
    else:
        body += _text(values[0] or "", function)
    return framed(number, body + (DONE if ok else REFUSED))


def decode_reply(frame: bytes, number: int, function: int, count: int = 1) -> list[str]:
    """Return the values in the reply to a request, or raise: wrong id, wrong length, an error, an empty value."""
    replied, replied_function, rest = _body(frame)
    if replied != number or replied_function != function:
        raise DeviceError(f"reply {replied} of function {replied_function} to request {number} of function {function}")
    many = function in (READ_MANY, WRITE_MANY)
    if many:
        if rest[:1] != bytes([count]):
            raise DeviceError(f"{rest[0] if rest else 'no'} values for {count}")
        rest = rest[1:]
    values = []
    for _ in range(count):
        if many:
            if rest[:1] != b"\x01":
                raise DeviceError("a variable could not be read")
            rest = rest[1:]
        value, rest = _take_text(rest, function)
        values.append(value)
    if len(rest) != 3:
        raise DeviceError(f"the reply's length does not fit its content: {frame[:40]!r}")
    error, ok = struct.unpack(">HB", rest)
    if ok != 1:
        raise DeviceError(f"the controller refused the request (error {error})")
    if not all(values):
        raise DeviceError("an empty value: the controller does not know the variable")
    return values


def framed(number: int, body: bytes) -> bytes:
    return struct.pack(">HH", number, len(body)) + body


def _body(frame: bytes) -> tuple[int, int, bytes]:
    if len(frame) < 5 or int.from_bytes(frame[2:4], "big") != len(frame) - 4:
        raise DeviceError(f"not a frame: {frame[:40]!r}")
    return int.from_bytes(frame[:2], "big"), frame[4], frame[5:]


def _text(text: str, function: int) -> bytes:
    if function >= READ_UNICODE:
        return struct.pack(">H", len(text)) + text.encode("utf-16-le")
    return struct.pack(">H", len(text)) + text.encode("ascii")


def _take_text(data: bytes, function: int) -> tuple[str, bytes]:
    wide = function >= READ_UNICODE
    end = 2 + int.from_bytes(data[:2], "big") * (2 if wide else 1)
    if len(data) < end or len(data) < 2:
        raise DeviceError(f"the text's length does not fit: {data[:40]!r}")
    try:
        return data[2:end].decode("utf-16-le" if wide else "ascii"), data[end:]
    except UnicodeDecodeError as error:
        raise DeviceError(f"not text: {data[2:end][:40]!r}") from error


# --- the client -------------------------------------------------------------------------------------------------------


class KvpRobot(StreamRobot):
    """A robot behind KUKAVARPROXY or C3 Bridge."""

    Settings = KvpSettings
    settings: KvpSettings

    def __init__(self, settings: KvpSettings) -> None:
        host, port = settings.host, settings.port
        super().__init__(
            settings, f"KVP {host}:{port}", partial(TcpTransport.connect, host, port), cut_frame, LAST_NUMBER
        )
        self._closed = threading.Event()
        threading.Thread(target=self._heartbeat, daemon=True).start()

    def get(self, *names: str) -> list[str]:
        """Return the values of variables, as the controller prints them."""
        if self.settings.dialect == "c3":
            return self._ask(READ_MANY, names, len(names))
        return [self._ask(READ, [name], 1)[0] for name in names]

    def set(self, name: str, value: str) -> None:
        """Write a variable. Never repeated: a write may have happened although its reply was lost."""
        self._ask(WRITE, [name, value], 1, repeat=False)

    def read(self) -> Reading:
        """Read $POS_ACT between two readings of the frames: a change between them cannot make a wrong pose."""
        for _ in range(3):
            before = self.get(*FRAME_NAMES)
            asked_s = time.monotonic()
            (position,) = self.get("$POS_ACT")
            told_s = time.monotonic()
            if self.get(*FRAME_NAMES) == before:
                break
        else:
            raise DeviceError(f"{self.name}: tool, base or mode keep changing")
        tool, base, interpolation, mode = before
        try:
            return Reading(
                position=parse_e6pos(position),
                tool=parse_frame(tool),
                base=parse_frame(base),
                interpolation=interpolation,
                mode=mode,
                time_s=(asked_s + told_s) / 2,
            )
        except InputError as error:
            raise DeviceError(f"{self.name}: {error}") from error

    def joints(self) -> tuple[float, ...]:
        """Return A1 to A6, degrees."""
        try:
            return parse_e6axis(self.get("$AXIS_ACT")[0])
        except InputError as error:
            raise DeviceError(f"{self.name}: {error}") from error

    def close(self) -> None:
        """Hang up."""
        self._closed.set()
        super().close()

    def _move(self, target: KukaPose, give_up_s: float) -> None:
        """Target first, trigger last; then wait until the program has done it."""
        self._check_program()
        self._wait_until_idle(give_up_s)  # it may still be at what a scan wanted that was killed
        self.set("COM_TARGET", format_frame(target))
        (text,) = self.get("COM_TARGET")
        try:
            off_mm, off_deg = distance(parse_frame(text), target)
        except InputError as error:
            raise DeviceError(f"{self.name}: COM_TARGET: {error}") from error
        if off_mm > SINGLE_MM or off_deg > SINGLE_DEG:
            raise DeviceError(f"{self.name}: the controller took another target: {text}")
        self.set("COM_ACTION", "1")
        self._wait_until_idle(give_up_s)

    def _wait_until_idle(self, give_up_s: float) -> None:
        while self.get("COM_ACTION")[0].strip() != "0":
            self._check_program()
            if time.monotonic() > give_up_s:
                self.set("COM_ACTION", "0")  # what has not begun shall not begin when nobody expects it
                raise DeviceTimeout(f"{self.name}: the program did not finish the motion")
            time.sleep(POLL_S)

    def _check_program(self) -> None:
        """COM_ACTION means something only while our program runs, in T1."""
        program, state, mode = (
            value.strip('" ').upper() for value in self.get("$PRO_NAME1[]", "$PRO_STATE1", "$MODE_OP")
        )
        if program != PROGRAM or state != "#P_ACTIVE":
            raise DeviceError(f"{self.name}: {PROGRAM} must be running; {program} is {state}")
        if mode != "#T1":
            raise DeviceError(f"{self.name}: motion only in T1, the controller says {mode}")

    def _ask(self, function: int, texts: Sequence[str], count: int, repeat: bool = True) -> list[str]:
        number = self._next_number()
        request = encode_request(number, function, texts)
        return self._link.ask(request, lambda frame: decode_reply(frame, number, function, count), repeat)

    def _heartbeat(self) -> None:
        while not self._closed.wait(HEARTBEAT_S / 4):
            if time.monotonic() - self._link.last_used_s > HEARTBEAT_S:
                try:
                    self.get("$MODE_OP")
                except DeviceError:
                    continue  # the next question says so to someone who can act on it
