"""What the simulated controllers share: an arm that moves at a speed, a server, and the faults it commits on
request.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator
from types import TracebackType
from typing import Self

from weldscan.devices.robots.wire import Cut, Messages, TcpTransport, Transport
from weldscan.errors import DeviceError, DeviceTimeout
from weldscan.simulated.controllers.arm import (
    HOME,
    HOME_JOINTS,
    NULL_FRAME,
    T1_SPEED_MM_S,
    TURN_SPEED_DEG_S,
    Arm,
    LinkFault,
    OutOfReach,
)

__all__ = [
    "HOME",
    "HOME_JOINTS",
    "HUGE_BYTES",
    "LOOK_S",
    "NULL_FRAME",
    "T1_SPEED_MM_S",
    "TURN_SPEED_DEG_S",
    "Arm",
    "Controller",
    "LinkFault",
    "OutOfReach",
    "StreamController",
    "TcpController",
]

HUGE_BYTES = 10_000_000
LOOK_S = 0.05
"""How often a serving thread looks whether it shall stop."""


class Controller:
    """A simulated controller: an arm, and faults that its next replies have."""

    def __init__(self, arm: Arm | None = None) -> None:
        self.arm = arm or Arm()
        self._faults: deque[LinkFault] = deque()
        self._stop = threading.Event()

    def inject(self, fault: LinkFault, replies: int = 1) -> None:
        """Let the next replies have a fault, after those that wait already."""
        self._faults.extend([fault] * replies)

    def _next_fault(self) -> LinkFault | None:
        return self._faults.popleft() if self._faults else None

    def close(self) -> None:
        """Stop serving."""
        self._stop.set()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class StreamController(Controller, ABC):
    """Answers requests over a byte stream. A link says how a request is cut, what is answered and how it can be
    spoilt.
    """

    restart_s = 1.0
    """How long a restart takes."""

    @abstractmethod
    def cut(self, buffer: bytearray) -> bytes | None:
        """Cut one request off the front."""

    @abstractmethod
    def answer(self, request: bytes, fault: LinkFault | None) -> bytes:
        """Give the reply, with the fault in its content where the fault is one of content."""

    def serve(self, transport: Transport) -> None:
        """Answer until the other side goes away."""
        cut: Cut = self.cut
        messages = Messages(transport, cut)
        with contextlib.suppress(DeviceError, OSError, ValueError):
            while not self._stop.is_set():
                try:
                    request = messages.next(time.monotonic() + LOOK_S)
                except DeviceTimeout:
                    continue
                fault = self._next_fault()
                reply = self.answer(request, fault)
                deadline_s = time.monotonic() + 2.0
                for piece in self._spoilt(reply, fault):
                    transport.send(piece, deadline_s)
                if fault is LinkFault.RESET or fault is LinkFault.RESTART:
                    self._break(transport, fault)
                    break

    def _spoilt(self, reply: bytes, fault: LinkFault | None) -> Iterator[bytes]:
        match fault:
            case LinkFault.SILENCE | LinkFault.RESTART:
                return
            case LinkFault.BYTES:
                for byte in reply:
                    yield bytes([byte])
            case LinkFault.TWICE:
                yield reply + reply
            case LinkFault.GARBAGE:
                yield os.urandom(64).replace(b"<", b"#").replace(b"\n", b"#") + b"\r\n"
            case LinkFault.HUGE:
                yield reply[:7] + b"A" * HUGE_BYTES
            case LinkFault.RESET:
                yield reply[: len(reply) // 2]
            case _:
                yield reply

    def _break(self, transport: Transport, fault: LinkFault) -> None:
        transport.close()


class TcpController(StreamController):
    """A `StreamController` that listens on TCP; port 0 takes a free one."""

    def __init__(self, arm: Arm | None = None, host: str = "127.0.0.1", port: int = 0) -> None:
        super().__init__(arm)
        self.host = host
        self._listener = self._listen(port)
        self.port: int = self._listener.getsockname()[1]
        self._open: set[socket.socket] = set()
        self._away = threading.Event()
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving and hang up on everyone."""
        super().close()
        self._thread.join(5.0)
        self._hang_up()

    def _restarted(self) -> None:
        """Begin anew what a restarted controller begins anew."""

    def _listen(self, port: int) -> socket.socket:
        listener = socket.create_server((self.host, port))
        listener.settimeout(LOOK_S)
        return listener

    def _accept(self) -> None:
        while not self._stop.is_set():
            if self._away.is_set():
                self._listener.close()
                self._hang_up()
                self._stop.wait(self.restart_s)
                self._restarted()
                self._away.clear()
                self._listener = self._listen(self.port)
            try:
                peer, _ = self._listener.accept()
            except TimeoutError:
                continue
            self._open.add(peer)
            threading.Thread(target=self._serve, args=(peer,), daemon=True).start()
        self._listener.close()

    def _serve(self, peer: socket.socket) -> None:
        try:
            self.serve(TcpTransport(peer))
        finally:
            self._open.discard(peer)
            peer.close()

    def _break(self, transport: Transport, fault: LinkFault) -> None:
        if fault is LinkFault.RESTART:
            self._away.set()
            super()._break(transport, fault)
        elif isinstance(transport, TcpTransport):
            transport.reset()

    def _hang_up(self) -> None:
        for peer in list(self._open):
            with contextlib.suppress(OSError):
                peer.shutdown(socket.SHUT_RDWR)
