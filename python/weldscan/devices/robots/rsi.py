"""RSI: the controller sends its pose as XML over UDP every 4 or 12 ms, and stops when it gets no answer in time.

Used here to read poses only: every answer carries zero corrections and echoes IPOC, digit by digit. A process of its
own (`rsi_answer.py`) answers before anyone looks, and says which packets are in order. With ONLYSEND = TRUE in the
configuration the controller wants no answer, which is the better choice for a measuring cell: `krl/WeldscanRsi.xml`.
"""

from __future__ import annotations

import logging
import socket
import subprocess
import sys
import threading
import time
from typing import Annotated, Literal
from xml.etree import ElementTree

from pydantic import Field

from weldscan.devices.robots import Reading, Robot, RobotSettings, Six, rsi_answer
from weldscan.devices.robots.rsi_answer import LARGEST_PACKET, REPORT
from weldscan.devices.robots.wire import Address, Deadline, Host, only, parse_xml
from weldscan.errors import DeviceError, DeviceTimeout, InputError
from weldscan.pose import KukaPose, parse_number

CARTESIAN = ("X", "Y", "Z", "A", "B", "C")
JOINTS = ("A1", "A2", "A3", "A4", "A5", "A6")
START_S = 10.0
"""For the process that answers to start, on a machine that has other things to do."""
log = logging.getLogger(__name__)


class RsiSettings(RobotSettings):
    """`[robot]` with `link = "rsi"`. `port` and `sen_type` as in the controller's RSI configuration."""

    link: Literal["rsi"] = "rsi"
    host: Host = "127.0.0.1"
    """The address of this computer that the controller sends to."""
    port: Annotated[int, Field(ge=0, le=65535)] = 64000
    controller: Address = "127.0.0.1"
    """Packets from any other address are ignored."""
    sen_type: Annotated[str, Field(pattern=r"^\w{1,32}$")] = "ImFree"
    only_send: bool = False
    """ONLYSEND = TRUE in the controller's configuration: nothing is answered."""
    tool: Six = (0.0,) * 6
    """$TOOL while RSI runs, X Y Z A B C: the stream does not tell it. Our KRL program sets $NULLFRAME."""
    base: Six = (0.0,) * 6
    """$BASE while RSI runs."""


class RsiRobot(Robot):
    """The pose stream of a robot that runs RSI. The link cannot move the robot."""

    Settings = RsiSettings
    moves = False
    settings: RsiSettings

    def __init__(self, settings: RsiSettings) -> None:
        self.settings = settings
        self.name = f"RSI {settings.host}:{settings.port}"
        self.packets = self.answered = self.unusable = self.stale = self.strangers = self.restarts = self.held = 0
        """What came, was answered, was no packet, was out of order, was of others; how often the stream began anew;
        what had lain in the socket."""
        self._lock = threading.Lock()
        self._reports = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._reports.bind(("127.0.0.1", 0))
        words = [settings.host, settings.port, settings.controller, settings.sen_type, int(settings.only_send)]
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", rsi_answer.__file__, *map(str, words), str(self._reports.getsockname()[1])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            process_group=0,  # Ctrl-C is for the scan, also while this one starts
            text=True,
        )
        hangs = threading.Timer(START_S, self._process.kill)
        hangs.start()
        said = self._process.stdout.readline().split(maxsplit=2)  # type: ignore[union-attr]
        hangs.cancel()
        if said[:1] != ["ok"]:
            self.close()
            raise DeviceError(f"{self.name}: cannot listen: {' '.join(said)}")
        self.port = int(said[1])
        self._reporter = ("127.0.0.1", int(said[2]))

    def read(self, deadline: Deadline | None = None) -> Reading:
        """Wait for the next packet of the stream: what came before the question is not an answer to it."""
        deadline = deadline or Deadline(self.settings.timeout_s)
        with self._lock:
            while True:
                time_s, packet = self._report(deadline)
                if time_s > deadline.start_s:
                    break
        try:
            return self._reading(packet, time_s)
        except (DeviceError, InputError) as error:
            raise DeviceError(f"{self.name}: {error}") from error

    def close(self) -> None:
        """Stop listening. The controller then stops the robot's RSI program, unless it only sends."""
        self._process.stdin.close()  # type: ignore[union-attr]
        try:
            self._process.wait(2.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()  # type: ignore[union-attr]
        self._reports.close()

    def _report(self, deadline: Deadline) -> tuple[float, bytes]:
        """Return the next packet that is in order, and when it came."""
        while True:
            self._reports.settimeout(max(deadline.end_s - time.monotonic(), 1e-4))
            try:
                report, peer = self._reports.recvfrom(LARGEST_PACKET)
            except TimeoutError:
                raise DeviceTimeout(
                    f"{self.name}: no new pose within {deadline.timeout_s:g} s ({self.packets} packets so far, "
                    f"{self.unusable} unusable, {self.stale} out of order, {self.strangers} of other senders)"
                ) from None
            if peer != self._reporter or len(report) < REPORT.size:
                continue
            restarts = self.restarts
            time_s, self.packets, self.answered, self.unusable, *order = REPORT.unpack_from(report)
            self.stale, self.strangers, self.restarts, self.held = order
            if self.restarts > restarts:
                log.warning("%s: the controller's stream was silent and began anew", self.name)
            packet = report[REPORT.size :]
            if packet:
                return time_s, packet

    def _reading(self, packet: bytes, time_s: float) -> Reading:
        root = parse_xml(packet, "Rob")
        kind = root.get("Type", root.get("TYPE"))
        if kind != "KUKA":
            raise DeviceError(f"a packet of type {kind}, expected KUKA")
        joints = only(root, "AIPos")
        return Reading(
            position=KukaPose(*_numbers(only(root, "RIst"), "RIst", CARTESIAN)),
            tool=KukaPose(*self.settings.tool),
            base=KukaPose(*self.settings.base),
            interpolation="#BASE",
            mode="",
            time_s=time_s,
            joints_deg=() if joints is None else tuple(_numbers(joints, "AIPos", JOINTS)),
        )


def _numbers(element: ElementTree.Element | None, name: str, keys: tuple[str, ...]) -> list[float]:
    if element is None:
        raise DeviceError(f"the packet has no {name}: add DEF_{name} to the RSI configuration")
    try:
        return [parse_number(element.get(key, "missing")) for key in keys]
    except InputError as error:
        raise DeviceError(f"{name}: {error}") from None
