r"""A serial line through pyserial: a device, `socket://host:port` or `loop://`; a KRL program of ours with CREAD and
CWRITE.

One request, one reply, each a line `<id> <words>*<checksum>\r\n` in ASCII. The checksum is Fletcher's with 16 bits, in
decimal digits, over everything before the star: KRL can add and divide integers, and so can compute it; unlike an XOR
it sees two bytes that changed places. Program: `krl/weldscan_serial.src`.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from typing import Annotated, Literal

import serial
from pydantic import Field

from weldscan.devices.robots import RobotSettings
from weldscan.devices.robots.program import LAST_NUMBER, REPLY_NUMBERS, ProgramRobot
from weldscan.devices.robots.wire import ConnectionLost
from weldscan.errors import DeviceError, DeviceTimeout
from weldscan.pose import KukaPose

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


def encode_line(number: int, words: str) -> bytes:
    """Return one line."""
    text = f"{number} {words}".encode("ascii")
    return text + b"*%d\r\n" % checksum(text)


def decode_line(line: bytes) -> tuple[int, list[str]]:
    """Return the id and the words of a line whose checksum is right."""
    text, star, digits = line.rstrip(b"\r\n").rpartition(b"*")
    if not star or not digits.isdigit() or int(digits) != checksum(text):
        raise DeviceError(f"a line with a wrong checksum: {line[:40]!r}")
    number, *words = text.decode("ascii", "replace").split()
    if not number.isdigit():
        raise DeviceError(f"a line without a number: {line[:40]!r}")
    return int(number), words


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
        peer = getattr(self._port, "_socket", None)
        self._port.close()
        if peer is not None:  # of socket://: pyserial leaves it open where the other side has closed it
            peer.close()


# --- the client -------------------------------------------------------------------------------------------------------


class SerialRobot(ProgramRobot):
    """A robot at the end of a serial line, with our program running."""

    Settings = SerialSettings
    settings: SerialSettings

    def __init__(self, settings: SerialSettings) -> None:
        super().__init__(
            settings,
            f"serial {settings.port}",
            lambda _deadline_s: SerialTransport(settings.port, settings.baud),
            cut_line,
            LAST_NUMBER,
        )

    def _request(self, number: int, target: KukaPose | None) -> bytes:
        words = "POSE" if target is None else "MOVE " + " ".join(f"{value:.6f}" for value in target.values())
        return encode_line(number, words)

    def _reply(self, message: bytes) -> tuple[int, Sequence[float]]:
        number, texts = decode_line(message)
        if len(texts) != REPLY_NUMBERS:
            raise DeviceError(f"{len(texts)} numbers for {REPLY_NUMBERS}")
        try:
            return number, [*map(int, texts[:3]), *map(float, texts[3:])]
        except ValueError as error:
            raise DeviceError(f"not a number: {error}") from error
