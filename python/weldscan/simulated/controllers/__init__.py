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
from enum import StrEnum
from types import TracebackType
from typing import Self

import numpy as np

from weldscan.devices.robots import distance
from weldscan.devices.robots.wire import Cut, Messages, TcpTransport, Transport
from weldscan.errors import DeviceError, DeviceTimeout
from weldscan.geometry import rigid, rotation_of, rotation_vector_of
from weldscan.pose import KukaPose
from weldscan.simulated.controllers.kinematics import ArmGeometry, Joints

HOME_JOINTS: Joints = (0.0, -90.0, 90.0, 0.0, 30.0, 0.0)
HOME = KukaPose.from_matrix(ArmGeometry().flange(HOME_JOINTS))
NULL_FRAME = KukaPose(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
T1_SPEED_MM_S = 250.0
TURN_SPEED_DEG_S = 90.0
HUGE_BYTES = 10_000_000
LOOK_S = 0.05
"""How often a serving thread looks whether it shall stop."""


class LinkFault(StrEnum):
    """What a simulated controller does wrong with one reply. Not every link can commit every fault."""

    SILENCE = "silence"
    BYTES = "bytes"
    """The reply comes in single bytes, each in its own packet."""
    TWICE = "twice"
    """The reply comes twice, in one packet."""
    WRONG_ID = "wrong-id"
    WRONG_LENGTH = "wrong-length"
    EMPTY = "empty"
    GARBAGE = "garbage"
    HUGE = "huge"
    """10 MB where a few hundred bytes should be."""
    DTD = "dtd"
    ENTITY = "entity"
    RESET = "reset"
    """The connection is reset in the middle of the reply."""
    RESTART = "restart"
    """The controller goes away and comes back a second later."""
    NAN = "nan"
    JUMP = "jump"
    """One pose is 400 mm off."""
    STALE = "stale"
    """The pose stands at what it was, or the stream repeats itself, although the arm moves."""


class OutOfReach(DeviceError):
    """No way of holding its joints brings the arm there."""


class Arm:
    """A simulated robot: its flange moves straight at a constant speed and the joints follow; it tells $POS_ACT in its
    tool and base.
    """

    def __init__(
        self, flange: KukaPose = HOME, tool: KukaPose = NULL_FRAME, base: KukaPose = NULL_FRAME, mode: str = "#T1"
    ) -> None:
        self.tool, self.base, self.mode, self.interpolation = tool, base, mode, "#BASE"
        self._geometry, self._joints = ArmGeometry(), HOME_JOINTS
        self._held: KukaPose | None = None
        """The flange that these joints hold."""
        self._aim: Joints | None = None
        """The joints that a motion was to end in, if they were what it was given by."""
        self.speed_mm_s, self.turn_speed_deg_s = T1_SPEED_MM_S, TURN_SPEED_DEG_S
        self._start_s, self._seconds = time.monotonic(), 0.0
        self._frozen: KukaPose | None = None
        self.place(flange)

    def flange(self) -> KukaPose:
        """Return where the flange is now."""
        done = 1.0 if self._seconds == 0 else min((time.monotonic() - self._start_s) / self._seconds, 1.0)
        if done == 1.0:
            return self._target
        a, b = self._start.matrix(), self._target.matrix()
        turn = a[:3, :3] @ rotation_of(done * rotation_vector_of(a[:3, :3].T @ b[:3, :3]))
        return KukaPose.from_matrix(rigid(turn, (1 - done) * a[:3, 3] + done * b[:3, 3]))

    @property
    def moving(self) -> bool:
        """Is the arm on its way?"""
        return time.monotonic() < self._start_s + self._seconds

    @property
    def joints_deg(self) -> Joints:
        """A1 to A6 now: of the ways to hold the flange the one nearest to where the joints were.

        Where a motion was given by its joints it ends in those.
        """
        flange = self.flange()
        if self._aim is not None and not self.moving:
            self._joints, self._held = self._aim, flange
        if flange != self._held:
            self._joints = self._geometry.joints(flange.matrix(), self._joints) or self._joints
            self._held = flange
        return self._joints

    def move(self, target: KukaPose) -> None:
        """Set off for a flange pose. Raises `OutOfReach`, and stays."""
        if self._geometry.joints(target.matrix(), self._joints) is None:
            raise OutOfReach(f"{target} is out of the arm's reach")
        self._start = self.flange()
        far_mm, far_deg = distance(self._start, target)
        self._start_s = time.monotonic()
        self._seconds = max(far_mm / self.speed_mm_s, far_deg / self.turn_speed_deg_s)
        self._target, self._aim = target, None

    def move_joints(self, joints_deg: Joints) -> None:
        """Set off for a pose that is given by its joints."""
        self.move(KukaPose.from_matrix(self._geometry.flange(joints_deg)))
        self._aim = joints_deg

    def place(self, target: KukaPose) -> None:
        """Be at a pose at once, as when an operator has jogged the arm there; for a far one the arm is a larger one."""
        while self._geometry.joints(target.matrix(), self._joints) is None:
            self._geometry = self._geometry.larger(2.0)
        self._start = self._target = target
        self._seconds, self._aim = 0.0, None

    def position(self, fault: LinkFault | None = None) -> KukaPose:
        """Return $POS_ACT: the tool in base."""
        flange = self.flange()
        self._frozen = (self._frozen or flange) if fault is LinkFault.STALE else None
        flange = self._frozen or flange
        if fault is LinkFault.JUMP:
            flange = KukaPose(flange.x_mm + 400.0, *flange.values()[1:])
        return KukaPose.from_matrix(np.linalg.inv(self.base.matrix()) @ flange.matrix() @ self.tool.matrix())


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
                    time.sleep(0.0002)
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
