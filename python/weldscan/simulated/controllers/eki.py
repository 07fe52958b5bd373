"""Simulated controllers that speak EthernetKRL, over TCP and over UDP; over TCP with `krl/weldscan_eki.src` running."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections import deque

from weldscan.devices.robots.eki import CARTESIAN, JOINTS, OURS, STREAM_S, EkiConfig, Element, compose, dissect
from weldscan.devices.robots.wire import LARGEST_MESSAGE, Messages, TcpTransport, Transport, cut_xml, parse_xml
from weldscan.errors import DeviceError, DeviceTimeout
from weldscan.pose import KukaPose, parse_number
from weldscan.simulated.controllers import LOOK_S, NULL_FRAME, Arm, Controller, LinkFault, OutOfReach, TcpController
from weldscan.simulated.controllers.interpreter import Interpreter, Program
from weldscan.simulated.controllers.program import Driver, Request, Requests, codes


class EkiController(TcpController):
    """A simulated controller with EthernetKRL over TCP: our program, or a state stream as other configurations have
    it.

    With our program it serves one client at a time. Flags and FIFOs, one per element, outlive clients and programs;
    what a message lacks stays lacking in its FIFO alone. `running` is the start key.
    """

    def __init__(
        self, arm: Arm | None = None, host: str = "127.0.0.1", port: int = 0, config: EkiConfig = OURS
    ) -> None:
        self.config = config
        self.running = True
        self.fifos: dict[Element, deque[str]] = {element: deque() for element in config.receive}
        self.flag1 = self.flag2 = False
        """$FLAG[1]: a client is there. $FLAG[2]: a request is there."""
        self._client: TcpTransport | None = None
        self._one_client, self._memory = threading.Lock(), threading.Lock()
        super().__init__(arm, host, port)
        self.interpreter = Interpreter(self.arm, self._program, lambda: self.running and not self._away.is_set())
        self._driver = Driver(self.arm, self.interpreter)
        self._requests = Requests(self._driver, self._receive, self._reply, lambda: self.flag1)
        if config.asks:
            self.interpreter.start()

    def close(self) -> None:
        """Stop serving and hang up on everyone."""
        super().close()
        self.interpreter.close()

    def cut(self, buffer: bytearray) -> bytes | None:
        """Cut one message."""
        return cut_xml(buffer)

    def answer(self, request: bytes, fault: LinkFault | None) -> bytes:
        """Obey a command of another configuration than ours."""
        obey(self.arm, dissect(self.config.receive, request))
        return b""

    def serve(self, transport: Transport) -> None:
        """Put what a client sends into the FIFOs; or stream states and obey, as another configuration has it."""
        if not self.config.asks:
            if self.config.send:
                threading.Thread(target=self._stream, args=(transport,), daemon=True).start()
            super().serve(transport)
            return
        assert isinstance(transport, TcpTransport)
        with self._one_client:
            with self._memory:
                self._client, self.flag1 = transport, True
            messages = Messages(transport, self.cut)
            with contextlib.suppress(DeviceError, OSError, ValueError):
                while not self._stop.is_set():
                    with contextlib.suppress(DeviceTimeout):
                        self._put(transport, messages.next(time.monotonic() + LOOK_S))
            with self._memory:
                if self._client is transport:
                    self._client, self.flag1 = None, False

    def _put(self, transport: TcpTransport, message: bytes) -> None:
        """What EthernetKRL does with a message: every element that is there into its FIFO, and the flag."""
        parse_xml(message, self.config.receive[0].path[0])
        with self._memory:
            if self._client is not transport:
                return
            for element, fifo in self.fifos.items():
                with contextlib.suppress(DeviceError):
                    fifo.append(dissect((element,), message)[element])
            self.flag2 = True

    # --- WELDSCAN_EKI -------------------------------------------------------------------------------------------------

    def _program(self) -> Program:
        self._open_anew()
        while True:
            while not self.flag1:
                yield
            while self.flag1 and not self._requests.left:
                yield from self._requests.serve()
                yield
            self._open_anew()

    def _open_anew(self) -> None:
        """EKI_Close, EKI_ClearBuffer, $FLAG[2]=FALSE, EKI_Open: whoever comes next finds nothing of those before.

        At once: between EKI_Close and EKI_Open nobody is connected, so that nobody's request is cleared away unheard.
        """
        with self._memory:
            if self._client is not None:
                self._client.close()
                self._client, self.flag1 = None, False
            for fifo in self.fifos.values():
                fifo.clear()
            self.flag2 = False
            self._requests.forget()

    def _receive(self) -> Request | None:
        with self._memory:
            if not self.flag2:
                return None
            values = [fifo.popleft() if fifo else None for fifo in self.fifos.values()]  # RET.Read: which were there
            left = {len(fifo) for fifo in self.fifos.values()}  # RET.Buff: as many whole messages, or something lacks
            whole = None not in values and len(left) == 1
            if not whole:
                for fifo in self.fifos.values():
                    fifo.clear()
            self.flag2 = whole and left != {0}
        number, command, *target = (0.0 if value is None else parse_number(value) for value in values)
        return Request(int(number), int(command) if whole else None, KukaPose(*target))

    def _reply(self, number: int) -> None:
        """EKI_Set... and EKI_Send, to whoever is there."""
        transport = self._client
        if transport is None:
            return
        fault = self._next_fault()
        with contextlib.suppress(DeviceError, OSError):
            for piece in self._spoilt(self._composed(number, fault), fault):
                transport.send(piece, time.monotonic() + 2.0)
            if fault is LinkFault.RESET or fault is LinkFault.RESTART:
                self._break(transport, fault)

    def _restarted(self) -> None:
        self.interpreter.reset()

    def _composed(self, number: int, fault: LinkFault | None) -> bytes:
        if fault is LinkFault.EMPTY:
            return b"<Robot></Robot>"
        shown = number + (1 if fault is LinkFault.WRONG_ID else 0)
        status, target = self._driver.status, self._requests.target
        reply = compose(self.config.send, state(self.config.send, self.arm, fault, shown, status, target))
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
    elements: tuple[Element, ...],
    arm: Arm,
    fault: LinkFault | None = None,
    number: int = 0,
    status: int = 0,
    target: KukaPose = NULL_FRAME,
) -> dict[Element, str]:
    """Return what an arm has to say to every element, found by the names that configurations use; 0 for the others."""
    position, joints_deg = arm.told(fault)
    frames = {"Tool": arm.tool, "Base": arm.base, "Target": target}
    mode, interpolation = codes(arm)
    special = {"Id": number, "Status": int(status), "Mode": mode, "Interpolation": interpolation}
    values = {}
    for element in elements:
        name, group = element.attribute or element.path[-1], element.path[-1]
        sign, group = (-1.0 if group.startswith("Minus") else 1.0), group.removeprefix("Minus")
        if name in JOINTS:
            value = 0.0 if group in ("Vel", "Eff") else sign * joints_deg[JOINTS.index(name)]
        elif name in CARTESIAN:
            value = sign * frames.get(group, position).values()[CARTESIAN.index(name)]
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
