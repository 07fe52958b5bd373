"""A simulated controller at the other end of a serial line, with `krl/weldscan_serial.src` running on it."""

from __future__ import annotations

import contextlib
import os
import time

from weldscan.devices.robots.serial import cut_line, decode_line, encode_line
from weldscan.devices.robots.wire import FileTransport, Messages
from weldscan.errors import DeviceError, DeviceTimeout
from weldscan.pose import KukaPose, parse_number, parse_whole
from weldscan.simulated.controllers import Arm, LinkFault, StreamController
from weldscan.simulated.controllers.interpreter import Interpreter, Program
from weldscan.simulated.controllers.program import Driver, Request, Requests, codes, reading


class SerialController(StreamController):
    """A simulated controller at the other end of a pseudo-terminal; `port` is what the client opens.

    What was sent lies in the line until the program reads it. `running` is the start key.
    """

    def __init__(self, arm: Arm | None = None) -> None:
        import pty  # noqa: PLC0415 - not there on Windows, where the client runs all the same
        import tty  # noqa: PLC0415

        super().__init__(arm)
        self.running = True
        self._near, self._far = pty.openpty()
        tty.setraw(self._far)  # and keep it open: the terminal lives on when a client closes its own
        self.port = os.ttyname(self._far)
        self._line = _Kept(self._near)
        self._messages = Messages(self._line, self.cut)
        self.interpreter = Interpreter(self.arm, self._program, lambda: self.running)
        self._driver = Driver(self.arm, self.interpreter)
        self._requests = Requests(self._driver, self._receive, self._reply)
        self.interpreter.start()

    def close(self) -> None:
        """Stop, and let the terminal vanish."""
        super().close()
        self.interpreter.close()
        os.close(self._far)
        os.close(self._near)

    def cut(self, buffer: bytearray) -> bytes | None:
        """Cut one line."""
        return cut_line(buffer)

    def answer(self, request: bytes, fault: LinkFault | None) -> bytes:
        """Nothing is answered without the program."""
        return b""

    # --- WELDSCAN_SERIAL ----------------------------------------------------------------------------------------------

    def _program(self) -> Program:
        self._messages = Messages(self._line, self.cut)
        while self._messages.unasked():  # what came before this start is nobody's wish any more
            yield
        self._requests.forget()
        while True:
            yield from self._requests.serve()
            yield

    def _receive(self) -> Request | None:
        try:
            number, texts = decode_line(self._messages.next(time.monotonic()))
            command, *target = texts
            return Request(number, parse_whole(command), KukaPose(*map(parse_number, target)))
        except DeviceTimeout:
            pass
        except (DeviceError, ValueError, TypeError):
            self._messages = Messages(self._line, self.cut)
        return None

    def _reply(self, number: int) -> None:
        fault = self._next_fault()
        with contextlib.suppress(DeviceError, OSError):
            for piece in self._spoilt(self._composed(number, fault), fault):
                self._line.send(piece, time.monotonic() + 2.0)

    def _composed(self, number: int, fault: LinkFault | None) -> bytes:
        values: list[float] = [int(self._driver.status), *codes(self.arm)]
        values += [*reading(self.arm, fault), *self._requests.target.values()]
        match fault:
            case LinkFault.NAN:
                values[3] = float("nan")
            case LinkFault.EMPTY:
                values = []
            case LinkFault.WRONG_ID:
                number += 1
        line = encode_line(number, values)
        return line.replace(b".", b"", 1) if fault is LinkFault.WRONG_LENGTH else line


class _Kept(FileTransport):
    """The near end of the terminal, which a broken conversation does not close."""

    def close(self) -> None:
        """Keep it."""
