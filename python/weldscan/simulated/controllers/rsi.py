"""A simulated controller that runs RSI."""

from __future__ import annotations

import contextlib
import secrets
import socket
import threading
import time

from weldscan.devices.robots.rsi import CARTESIAN, JOINTS
from weldscan.devices.robots.rsi_answer import IPOC, LARGEST_PACKET
from weldscan.simulated.controllers import HUGE_BYTES, Arm, Controller, LinkFault


class RsiController(Controller):
    """A simulated controller that runs RSI: sends a packet every cycle, counts wrong and late answers."""

    def __init__(
        self,
        arm: Arm | None = None,
        host: str = "127.0.0.1",
        port: int = 64000,
        cycle_s: float = 0.012,
        sen_type: str = "ImFree",
        only_send: bool = False,
    ) -> None:
        super().__init__(arm)
        self.cycle_s, self.sen_type, self.only_send = cycle_s, sen_type, only_send
        self.wrong = self.late = self.cycles = 0
        self.ipoc = 1_343_092
        self.port, self._peer = port, (host, port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((host, 0))
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop."""
        super().close()
        self._thread.join(5.0)
        self._socket.close()

    def packet(self, fault: LinkFault | None = None) -> bytes:
        """Return what one cycle sends."""
        position, joints_deg = self.arm.told(fault)
        pose = dict(zip(CARTESIAN, position.values(), strict=True))
        joints = dict(zip(JOINTS, joints_deg, strict=True))
        text = (
            f'<Rob Type="KUKA"><RIst {_attributes(pose)}/><RSol {_attributes(pose)}/><AIPos {_attributes(joints)}/>'
            f'<Delay D="{self.late}"/><IPOC>{self.ipoc}</IPOC></Rob>'
        ).encode()
        match fault:
            case LinkFault.GARBAGE:
                return b"\xff\x00 not XML at all"
            case LinkFault.EMPTY:
                return b'<Rob Type="KUKA"><IPOC>%d</IPOC></Rob>' % self.ipoc
            case LinkFault.NAN:
                return text.replace(b'X="', b'X="nan" Q="', 1)
            case LinkFault.HUGE:
                return text.replace(b"<Delay", b"<EStr>" + b"A" * min(HUGE_BYTES, 60_000) + b"</EStr><Delay")
            case LinkFault.DTD:
                return b'<!DOCTYPE Rob SYSTEM "http://127.0.0.1/rob.dtd">' + text
            case LinkFault.ENTITY:
                return b'<!DOCTYPE Rob [<!ENTITY x "1">]>' + text.replace(b'X="', b'X="&x;', 1)
            case _:
                return text

    def _run(self) -> None:
        next_s = time.monotonic()
        while not self._stop.is_set():
            fault = self._next_fault()
            if fault is LinkFault.RESTART:
                self.ipoc = 1000 + secrets.randbelow(1000)  # no start takes as long as another
                if self._stop.wait(1.0):
                    break
                next_s = time.monotonic()
            if fault is not LinkFault.SILENCE:
                with contextlib.suppress(OSError):
                    self._socket.sendto(self.packet(fault), self._peer)
            self._judge(next_s + self.cycle_s)
            self.cycles += 1
            if fault is not LinkFault.STALE:
                self.ipoc += round(self.cycle_s * 1000)
            next_s += self.cycle_s
            if self._stop.wait(max(next_s - time.monotonic(), 0.0)):
                break

    def _judge(self, deadline_s: float) -> None:
        """Wait for the answer of this cycle."""
        if self.only_send:
            return
        want = b'<Sen Type="%s">' % self.sen_type.encode()
        while True:
            self._socket.settimeout(max(deadline_s - time.monotonic(), 0.0005))
            try:
                reply = self._socket.recv(LARGEST_PACKET)
            except TimeoutError:
                self.late += 1
                return
            except OSError:
                continue
            ipoc = IPOC.search(reply)
            if ipoc is not None and int(ipoc[1]) == self.ipoc and reply.startswith(want):
                return
            if ipoc is None or int(ipoc[1]) > self.ipoc or not reply.startswith(want):
                self.wrong += 1


def _attributes(values: dict[str, float]) -> str:
    return " ".join(f'{name}="{value:.6f}"' for name, value in values.items())
