"""KUKAVARPROXY and C3 Bridge: variables of a KUKA controller by name, over TCP (port 7000). The default link.

A request is `u16 id, u16 length, u8 function, u16 n, name[, u16 m, value]`, a reply `u16 id, u16 length, u8 function,
u16 n, value, u16 error, u8 ok`, big-endian, the length counting what follows it. Functions 0 and 1 read and write in
ASCII; C3 Bridge alone knows 4 to 7, with text in UTF-16LE and several variables at once.

Motion goes through `krl/weldscan_kvp.src`, in two steps, for a variable keeps its value whoever wrote it and died.
COM_TARGET, then COM_ACTION = a number: the program copies the target to COM_GOAL, looks whether the arm can go there,
and says COM_TAKEN = the number. COM_GO = the number sets off, as long as $TIMER[16] is below zero: that is the lease,
two seconds by the controller's own clock, which the client renews while it lives. COM_DONE = the number and COM_STATUS
tell the end. When the lease ends the program brakes and drops the request; a program that starts drops what it finds.
"""

from __future__ import annotations

import contextlib
import secrets
import struct
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, Literal

from pydantic import Field

from weldscan.devices.robots import POLL_S, RESPITE_S, SINGLE_DEG, SINGLE_MM, Reading, RobotSettings, StreamRobot
from weldscan.devices.robots.plausible import distance
from weldscan.devices.robots.program import Status
from weldscan.devices.robots.wire import Deadline, Host, TcpTransport
from weldscan.errors import DeviceError, DeviceTimeout, InputError
from weldscan.pose import KukaPose, format_frame, parse_e6axis, parse_e6pos, parse_frame, parse_whole

READ, WRITE, READ_UNICODE, WRITE_UNICODE, READ_MANY, WRITE_MANY = 0, 1, 4, 5, 6, 7
LAST_NUMBER = 65_535
"""Ids have 16 bits."""
HEARTBEAT_S = 20.0
"""The controller hangs up on a client that is silent for 30 s."""
DONE, REFUSED = b"\x00\x01\x01", b"\x00\x00\x00"
"""How a reply ends: a 16-bit field that the published samples fill with 1 and 0, and the byte that tells success."""
PROGRAM = "WELDSCAN_KVP"
LEASE = "$TIMER[16]"
"""Counts up in ms; the program drives only below zero."""
LAST_REQUEST = 2**30
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
        self._request: int | None = None
        self._closed = threading.Event()
        threading.Thread(target=self._heartbeat, daemon=True).start()

    def get(self, *names: str, deadline: Deadline | None = None) -> list[str]:
        """Return the values of variables, as the controller prints them."""
        deadline = deadline or self._link.deadline()
        if self.settings.dialect == "c3":
            return self._ask(READ_MANY, names, len(names), deadline)
        return [self._ask(READ, [name], 1, deadline)[0] for name in names]

    def set(self, name: str, value: str, deadline: Deadline | None = None) -> None:
        """Write a variable. Never repeated: a write may have happened although its reply was lost."""
        self._ask(WRITE, [name, value], 1, deadline or self._link.deadline(), repeat=False)

    def read(self, deadline: Deadline | None = None) -> Reading:
        """Read $POS_ACT between two readings of the frames: a change between them cannot make a wrong pose. All of it
        within `timeout_s`, or it is read anew: a position is of the frames of its own moment, not of those before a
        lost connection.
        """
        deadline = deadline or self._link.deadline()
        for _ in range(3):
            begun_s = time.monotonic()
            before = self.get(*FRAME_NAMES, deadline=deadline)
            asked_s = time.monotonic()
            (position,) = self.get("$POS_ACT", deadline=deadline)
            told_s = time.monotonic()
            after = self.get(*FRAME_NAMES, deadline=deadline)
            if after == before and time.monotonic() - begun_s <= self.settings.timeout_s:
                break
        else:
            raise DeviceError(f"{self.name}: tool, base or mode keep changing, or the answers are too slow")
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
        """Return A1 to A6, degrees, of a pose that is believed and that they hold."""
        deadline = self._link.deadline()
        reading = self.read(deadline)
        try:
            joints_deg = parse_e6axis(self.get("$AXIS_ACT", deadline=deadline)[0])
        except InputError as error:
            raise DeviceError(f"{self.name}: {error}") from error
        self._believed(replace(reading, joints_deg=joints_deg))
        return joints_deg

    def close(self) -> None:
        """Hang up."""
        self._closed.set()
        super().close()

    def _move(self, target: KukaPose, give_up_s: float) -> None:
        """Target first, then the request's number; look how the program took it; then the lease, and go."""
        self._check_program()
        self._wait_until(lambda: self._whole("COM_ACTION") == 0, give_up_s, "another request is not finished")
        self._request = request = secrets.randbelow(LAST_REQUEST) + 1
        self.set("COM_TARGET", format_frame(target))
        self.set("COM_ACTION", str(request))
        taken_s = min(time.monotonic() + RESPITE_S, give_up_s)
        self._wait_until(lambda: self._taken(request), taken_s, "the program did not take the target")
        (text,) = self.get("COM_GOAL")
        try:
            off_mm, off_deg = distance(parse_frame(text), target)
        except InputError as error:
            raise DeviceError(f"{self.name}: COM_GOAL: {error}") from error
        if off_mm > SINGLE_MM or off_deg > SINGLE_DEG:
            raise DeviceError(f"{self.name}: the controller took another target: {text}")
        self._lease()
        self.set("COM_GO", str(request))
        self._wait_until(
            lambda: self._whole("COM_DONE") == request, give_up_s, "the program did not finish the motion", self._lease
        )
        self._check_status()

    def _taken(self, request: int) -> bool:
        if self._whole("COM_DONE") == request:  # so soon only without having moved
            self._check_status()
        return self._whole("COM_TAKEN") == request

    def _lease(self) -> None:
        """Say that the motion is still wanted, for two seconds more."""
        self.set(LEASE, str(round(-1000 * RESPITE_S)))

    def _check_status(self) -> None:
        status = self._whole("COM_STATUS")
        if status != Status.DONE:
            said = Status(status).name.lower().replace("_", " ") if status in list(Status) else f"status {status}"
            raise DeviceError(f"{self.name}: not moved: {said}")

    def _whole(self, name: str) -> int:
        try:
            return parse_whole(self.get(name)[0].strip())
        except InputError as error:
            raise DeviceError(f"{self.name}: {name}: {error}") from error

    def _wait_until(
        self, done: Callable[[], bool], give_up_s: float, complaint: str, meanwhile: Callable[[], None] = lambda: None
    ) -> None:
        while not done():
            self._check_program()
            if time.monotonic() > give_up_s:
                raise DeviceTimeout(f"{self.name}: {complaint}")
            meanwhile()
            time.sleep(POLL_S)

    def _withdraw(self, deadline: Deadline) -> str:
        """End the lease, on which the program brakes, and take the request back; over a new connection."""
        self._link.renew()
        said = "no motion is waiting"
        for _ in range(3):  # what was on its way over the old connection may land after the first
            if self._request is not None and self.get("COM_ACTION", deadline=deadline) == [str(self._request)]:
                for name in (LEASE, "COM_GO", "COM_ACTION"):
                    self.set(name, "0", deadline)
                said = "the motion is withdrawn"
            time.sleep(POLL_S)
        return said

    def _check_program(self) -> None:
        """What the program says means something only while it runs, in T1."""
        program, state, mode = (
            value.strip('" ').upper() for value in self.get("$PRO_NAME1[]", "$PRO_STATE1", "$MODE_OP")
        )
        if program != PROGRAM or state != "#P_ACTIVE":
            raise DeviceError(f"{self.name}: {PROGRAM} must be running; {program} is {state}")
        if mode != "#T1":
            raise DeviceError(f"{self.name}: motion only in T1, the controller says {mode}")

    def _ask(
        self, function: int, texts: Sequence[str], count: int, deadline: Deadline, repeat: bool = True
    ) -> list[str]:
        number = self._next_number()
        request = encode_request(number, function, texts)
        return self._link.ask(
            request, lambda frame: decode_reply(frame, number, function, count), repeat, deadline
        ).value

    def _heartbeat(self) -> None:
        while not self._closed.wait(HEARTBEAT_S / 4):
            if time.monotonic() - self._link.last_used_s > HEARTBEAT_S:
                with contextlib.suppress(DeviceError):  # the next question says so to someone who can act on it
                    self.get("$MODE_OP")
