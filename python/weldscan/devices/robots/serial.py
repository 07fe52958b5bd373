r"""A serial line through pyserial: a device, `socket://host:port` or `loop://`; a KRL program of ours with CREAD and
CWRITE.

One request, one reply, each a line `<id>,<number>,...*<checksum>\r\n` in ASCII, without a blank, at which a controller
may end what it reads. The checksum is Fletcher's with 16 bits, in decimal digits, over everything before the star: KRL
can add and divide integers, and so can compute it; unlike an XOR it sees two bytes that changed places. Program:
`krl/weldscan_serial.src`.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from typing import Annotated, Literal
from urllib.parse import urlsplit

import serial
from pydantic import Field

from weldscan.devices.robots import RobotSettings
from weldscan.devices.robots.program import LAST_NUMBER, REPLY_NUMBERS, Command, ProgramRobot
from weldscan.devices.robots.wire import ConnectionLost, TcpTransport, Transport
from weldscan.errors import DeviceError, DeviceTimeout, InputError
from weldscan.pose import KukaPose, parse_number, parse_whole

LONGEST_LINE = 1024


class SerialSettings(RobotSettings):
    """`[robot]` with `link = "serial"`."""

    link: Literal["serial"] = "serial"
    port: str
    """Such as /dev/ttyUSB0, COM3 or socket://127.0.0.1:4001."""
    baud: Annotated[int, Field(ge=300, le=4_000_000)] = 115_200


# --- the wire ---------------------------------------------------------------------------------------------------------


def checksum(data: bytes) -> int:
    """Return Fletcher's checksum: two running sums modulo 255, the first in the low byte.

    Source: J. G. Fletcher, An arithmetic checksum for serial transmissions, IEEE Trans. Comm. 30 (1982) 247.

    >>> checksum(b"abcde") == 0xC8F0
    True
    """
    low = high = 0
    for byte in data:
        low = (low + byte) % 255
        high = (high + low) % 255
    return high * 256 + low


def encode_line(number: int, values: Sequence[float]) -> bytes:
    r"""Return one line; whole numbers are written as such, others with six decimals.

    >>> encode_line(7, [1, 0.5])
    b'7,1,0.500000*52293\r\n'
    """
    text = ",".join(str(value) if isinstance(value, int) else f"{value:.6f}" for value in (number, *values)).encode()
    return text + b"*%d\r\n" % checksum(text)


def decode_line(line: bytes) -> tuple[int, list[str]]:
    """Return the id and the numbers, as text, of a line whose checksum is right."""
    text, star, digits = line.rstrip(b"\r\n").rpartition(b"*")
    if not star or not digits.isdigit() or len(digits) > 5 or int(digits) != checksum(text):
        raise DeviceError(f"a line with a wrong checksum: {line[:40]!r}")
    number, *values = text.decode("ascii", "replace").split(",")
    try:
        return parse_whole(number), values
    except InputError:
        raise DeviceError(f"a line without a number: {line[:40]!r}") from None


def cut_line(buffer: bytearray) -> bytes | None:
    """Cut one line."""
    end = buffer.find(b"\n")
    if end < 0 or end > LONGEST_LINE:
        if len(buffer) > LONGEST_LINE:
            raise DeviceError(f"a line of more than {LONGEST_LINE} bytes")
        return None
    line = bytes(buffer[: end + 1])
    del buffer[: end + 1]
    return line


class SerialTransport:
    """A byte stream over pyserial."""

    def __init__(self, port: str, baud: int) -> None:
        try:
            self._port = serial.serial_for_url(port, baudrate=baud, timeout=0.0, exclusive=None)
            self._port.reset_input_buffer()
        except (OSError, ValueError) as error:
            reason = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else error
            raise ConnectionLost(f"cannot open: {reason}") from error

    def send(self, data: bytes, deadline_s: float) -> None:
        """Send all of it."""
        try:
            self._port.write_timeout = max(deadline_s - time.monotonic(), 0.001)
            self._port.write(data)
        except serial.SerialTimeoutException as error:
            raise DeviceTimeout("does not take what is sent") from error
        except OSError as error:
            raise ConnectionLost(f"lost: {error}") from error

    def receive(self, deadline_s: float) -> bytes:
        """Wait for at least one byte."""
        try:
            self._port.timeout = max(deadline_s - time.monotonic(), 0.0)
            data: bytes = self._port.read(1)
            if data:
                self._port.timeout = 0.0
                data += self._port.read(LONGEST_LINE)
        except (OSError, TypeError) as error:  # pyserial: TypeError when the port vanishes in mid-read
            raise ConnectionLost(f"lost: {error}") from error
        if not data:
            raise DeviceTimeout("no whole answer in time")
        return data

    def close(self) -> None:
        """Close it."""
        self._port.close()


def connect(port: str, baud: int, deadline_s: float) -> Transport:
    """Open a port. `socket://host:port` is TCP and nothing else; pyserial would wait 5 s for it, whatever it may."""
    if not port.lower().startswith("socket://"):
        return SerialTransport(port, baud)
    try:
        host, number = urlsplit(port).hostname, urlsplit(port).port
    except ValueError as error:
        raise ConnectionLost(f"cannot open: {error}") from error
    if not host or number is None:
        raise ConnectionLost("cannot open: should be socket://host:port")
    try:
        return TcpTransport.connect(host, number, deadline_s)
    except ConnectionLost as error:
        raise ConnectionLost(f"cannot open: {error}") from error


# --- the client -------------------------------------------------------------------------------------------------------


class SerialRobot(ProgramRobot):
    """A robot at the end of a serial line, with our program running."""

    Settings = SerialSettings
    settings: SerialSettings

    def __init__(self, settings: SerialSettings) -> None:
        super().__init__(
            settings,
            f"serial {settings.port}",
            lambda deadline_s: connect(settings.port, settings.baud, deadline_s),
            cut_line,
            LAST_NUMBER,
        )

    def _request(self, number: int, command: Command, target: KukaPose) -> bytes:
        return encode_line(number, [int(command), *target.values()])

    def _reply(self, message: bytes) -> tuple[int, Sequence[float]]:
        number, texts = decode_line(message)
        if len(texts) != REPLY_NUMBERS:
            raise DeviceError(f"{len(texts)} numbers for {REPLY_NUMBERS}")
        return number, [*map(parse_whole, texts[:3]), *map(parse_number, texts[3:])]
