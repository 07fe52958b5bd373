"""Simulated controllers that speak EthernetKRL, over TCP and over UDP."""

from __future__ import annotations

import contextlib
import socket
import threading
import time

from weldscan.devices.robots.eki import (
    CARTESIAN,
    JOINTS,
    MOVE,
    OURS,
    POSE,
    STREAM_S,
    EkiConfig,
    Element,
    compose,
    dissect,
)
from weldscan.devices.robots.program import Status
from weldscan.devices.robots.wire import LARGEST_MESSAGE, Transport, cut_xml
from weldscan.errors import DeviceError
from weldscan.pose import KukaPose
from weldscan.simulated.controllers import LOOK_S, Arm, Controller, LinkFault, OutOfReach, TcpController
from weldscan.simulated.controllers.program import carry_out, codes


class EkiController(TcpController):
    """A simulated controller with EthernetKRL over TCP: our program, or a state stream as other configurations have
    it.
    """

    def __init__(
        self, arm: Arm | None = None, host: str = "127.0.0.1", port: int = 0, config: EkiConfig = OURS
    ) -> None:
        self.config = config
        super().__init__(arm, host, port)

    def cut(self, buffer: bytearray) -> bytes | None:
        """Cut one message."""
        return cut_xml(buffer)

    def serve(self, transport: Transport) -> None:
        """Answer requests; or stream states and obey commands, as far as the configuration has them."""
        if not self.config.asks and self.config.send:
            threading.Thread(target=self._stream, args=(transport,), daemon=True).start()
        super().serve(transport)

    def answer(self, request: bytes, fault: LinkFault | None) -> bytes:
        """Do what the command says."""
        values = dissect(self.config.receive, request)
        if not self.config.asks:
            obey(self.arm, values)
            return b""
        number, command, *target = (float(values[element]) for element in self.config.receive)
        status = Status.DONE if command == POSE else Status.UNKNOWN_COMMAND
        if command == MOVE:
            status = carry_out(self.arm, KukaPose(*target), self._stop)
        if fault is LinkFault.EMPTY:
            return b"<Robot></Robot>"
        shown = int(number) + (1 if fault is LinkFault.WRONG_ID else 0)
        reply = compose(self.config.send, state(self.config.send, self.arm, fault, shown, status))
        match fault:
            case LinkFault.DTD:
                return b'<!DOCTYPE Robot SYSTEM "http://127.0.0.1/robot.dtd">' + reply
            case LinkFault.ENTITY:
                return b'<!DOCTYPE Robot [<!ENTITY x "' + b"9" * 1000 + b'">]>' + reply.replace(b'X="', b'X="&x;', 1)
            case LinkFault.WRONG_LENGTH:
                return reply.replace(b"</Robot>", b"</Robat>")
            case LinkFault.NAN:
                return reply.replace(b'X="', b'X="NaN" Q="', 1)
            case _:
                return reply

    def _stream(self, transport: Transport) -> None:
        while not self._stop.wait(STREAM_S):
            try:
                transport.send(compose(self.config.send, state(self.config.send, self.arm)), time.monotonic() + 1.0)
            except (DeviceError, OSError):
                return


class EkiUdpController(Controller):
    """A simulated controller with EthernetKRL over UDP: streams its state to whoever spoke last."""

    def __init__(self, config: EkiConfig, arm: Arm | None = None, host: str = "127.0.0.1", port: int = 0) -> None:
        super().__init__(arm)
        self.config = config
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((host, port))
        self._socket.settimeout(STREAM_S)
        self.port: int = self._socket.getsockname()[1]
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop."""
        super().close()
        self._thread.join(5 * LOOK_S)
        self._socket.close()

    def _serve(self) -> None:
        peer = None
        while not self._stop.is_set():
            try:
                message, peer = self._socket.recvfrom(LARGEST_MESSAGE)
                obey(self.arm, dissect(self.config.receive, message))
            except (TimeoutError, DeviceError):
                pass
            if peer is not None:
                self._socket.sendto(compose(self.config.send, state(self.config.send, self.arm)), peer)


def state(
    elements: tuple[Element, ...], arm: Arm, fault: LinkFault | None = None, number: int = 0, status: int = 0
) -> dict[Element, str]:
    """Return what an arm has to say to every element, found by the names that configurations use; 0 for the others."""
    frames = {"Tool": arm.tool, "Base": arm.base}
    position = arm.position(fault)
    joints_deg, (mode, interpolation) = arm.joints_deg, codes(arm)
    special = {"Id": number, "Status": int(status), "Mode": mode, "Interpolation": interpolation}
    values = {}
    for element in elements:
        name, group = element.attribute or element.path[-1], element.path[-1]
        if name in JOINTS:
            value = 0.0 if group in ("Vel", "Eff") else joints_deg[JOINTS.index(name)]
        elif name in CARTESIAN:
            value = frames.get(group, position).values()[CARTESIAN.index(name)]
        else:
            value = special.get(name, 0)
        values[element] = str(value)
    return values


def obey(arm: Arm, values: dict[Element, str]) -> None:
    """Do what a command of another configuration says: Cartesian motion (types 2 and 3), or joints; what the arm
    cannot reach it does not do.
    """
    numbers = {(element.path[-1], element.attribute): float(text) for element, text in values.items()}
    kind = numbers.get(("Type", None))
    with contextlib.suppress(OutOfReach):
        if kind in (2.0, 3.0):
            arm.move(KukaPose(*(numbers[("Cart", name)] for name in CARTESIAN)))
        else:
            group = "Axis" if kind == 1.0 else "Pos"
            if (group, "A1") in numbers:
                a1, a2, a3, a4, a5, a6 = (numbers[(group, name)] for name in JOINTS)
                arm.move_joints((a1, a2, a3, a4, a5, a6))
