"""A simulated controller at the other end of a serial line."""

from __future__ import annotations

import os
import threading

from weldscan.devices.robots.program import Status
from weldscan.devices.robots.serial import cut_line, decode_line, encode_line
from weldscan.devices.robots.wire import FileTransport
from weldscan.pose import KukaPose
from weldscan.simulated.controllers import LOOK_S, Arm, LinkFault, StreamController
from weldscan.simulated.controllers.program import carry_out, codes, numbers


class SerialController(StreamController):
    """A simulated controller at the other end of a pseudo-terminal; `port` is what the client opens."""

    def __init__(self, arm: Arm | None = None) -> None:
        import pty  # noqa: PLC0415 - not there on Windows, where the client runs all the same
        import tty  # noqa: PLC0415

        super().__init__(arm)
        self._near, self._far = pty.openpty()
        tty.setraw(self._far)  # and keep it open: the terminal lives on when a client closes its own
        self.port = os.ttyname(self._far)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop, and let the terminal vanish."""
        super().close()
        self._thread.join(10 * LOOK_S)
        os.close(self._far)
        os.close(self._near)

    def cut(self, buffer: bytearray) -> bytes | None:
        """Cut one line."""
        return cut_line(buffer)

    def answer(self, request: bytes, fault: LinkFault | None) -> bytes:
        """Do what the line says."""
        number, (command, *words) = decode_line(request)
        status = Status.DONE if command == "POSE" else Status.UNKNOWN_COMMAND
        if command == "MOVE" and len(words) == 6:
            status = carry_out(self.arm, KukaPose(*(float(word) for word in words)), self._stop)
        words = [str(int(code)) for code in (status, *codes(self.arm))]
        words += [f"{value:.6f}" for value in numbers(self.arm, fault)]
        match fault:
            case LinkFault.NAN:
                words[3] = "NaN"
            case LinkFault.EMPTY:
                words = []
            case LinkFault.WRONG_ID:
                number += 1
        line = encode_line(number, " ".join(words))
        return line.replace(b".", b"", 1) if fault is LinkFault.WRONG_LENGTH else line

    def _run(self) -> None:
        while not self._stop.is_set():  # a fault ends one round of serving, not the terminal
            self.serve(_Kept(self._near))


class _Kept(FileTransport):
    """The near end of the terminal, which a broken conversation does not close."""

    def close(self) -> None:
        """Keep it."""
