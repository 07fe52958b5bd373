"""EthernetKRL: XML over TCP; the robot is the server, on ports 54600 to 54615, and a KRL program of ours answers.

There is no length and no terminator: a message ends with the closing tag of its root. On the controller every element
has its own FIFO, so both sides always send every element. Configuration and program: `krl/WeldscanEki.xml`,
`krl/weldscan_eki.src`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal
from xml.etree import ElementTree

from pydantic import Field

from weldscan.devices.robots import RobotSettings
from weldscan.devices.robots.program import LAST_NUMBER, ProgramRobot
from weldscan.devices.robots.wire import LARGEST_MESSAGE, Host, TcpTransport, cut_xml, parse_xml
from weldscan.errors import DeviceError, InputError
from weldscan.pose import KukaPose
from weldscan.records.files import read_bytes

POSE, MOVE = 1, 2
"""Commands of our program."""
CARTESIAN = ("X", "Y", "Z", "A", "B", "C")
JOINTS = ("A1", "A2", "A3", "A4", "A5", "A6")
STREAM_S = 0.012
"""A state stream sends once per interpolation cycle."""


class EkiSettings(RobotSettings):
    """`[robot]` with `link = "eki"`."""

    link: Literal["eki"] = "eki"
    host: Host = "127.0.0.1"
    port: Annotated[int, Field(ge=1, le=65535)] = 54600


# --- the configuration ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Element:
    """One line of an EthernetKRL configuration: `Robot/Position/@X` and its type."""

    path: tuple[str, ...]
    attribute: str | None
    type: str

    @classmethod
    def parse(cls, tag: str, kind: str = "REAL") -> Element:
        """Read a tag as the configuration writes it."""
        *path, last = tag.split("/")
        return cls(tuple(path), last[1:], kind) if last.startswith("@") else cls((*path, last), None, kind)


@dataclass(frozen=True)
class EkiConfig:
    """What a controller with a given EthernetKRL configuration sends and expects."""

    port: int
    protocol: str
    receive: tuple[Element, ...]
    send: tuple[Element, ...]

    @classmethod
    def read(cls, path: Path) -> EkiConfig:
        """Read a configuration file, which may have comments but no DTD."""
        text = read_bytes(path, LARGEST_MESSAGE)
        if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
            raise InputError(f"{path}: XML with a DTD is refused")
        try:
            root = ElementTree.fromstring(text)
            elements = {
                side: tuple(
                    Element.parse(item.attrib["Tag"], item.get("Type", "REAL"))
                    for item in root.findall(f"{side}/XML/ELEMENT")
                    if "Set_Flag" not in item.attrib  # a flag on a whole branch carries no value
                )
                for side in ("RECEIVE", "SEND")
            }
            return cls(
                port=int(root.findtext("CONFIGURATION/INTERNAL/PORT", "54600")),
                protocol=root.findtext("CONFIGURATION/INTERNAL/PROTOCOL", "TCP").strip().upper(),
                receive=elements["RECEIVE"],
                send=elements["SEND"],
            )
        except (ElementTree.ParseError, KeyError, ValueError) as error:
            raise InputError(f"{path}: not an EthernetKRL configuration: {error}") from error

    @property
    def asks(self) -> bool:
        """Is it one reply per request (ours), or a stream of states?"""
        return any(element.attribute == "Id" for element in self.receive)


OURS = EkiConfig(
    port=54600,
    protocol="TCP",
    receive=(
        Element.parse("Sensor/Request/@Id", "INT"),
        Element.parse("Sensor/Request/@Command", "INT"),
        *(Element.parse(f"Sensor/Target/@{name}") for name in CARTESIAN),
    ),
    send=(
        Element.parse("Robot/Reply/@Id"),
        Element.parse("Robot/Reply/@Status"),
        Element.parse("Robot/Reply/@Mode"),
        Element.parse("Robot/Reply/@Interpolation"),
        *(Element.parse(f"Robot/{frame}/@{name}") for frame in ("Position", "Tool", "Base") for name in CARTESIAN),
        *(Element.parse(f"Robot/Axis/@{name}") for name in JOINTS),
    ),
)


def compose(elements: tuple[Element, ...], values: dict[Element, str]) -> bytes:
    """Return one message with all elements of a configuration, in its order."""
    root = ElementTree.Element(elements[0].path[0])
    for element in elements:
        node = root
        for name in element.path[1:]:
            child = node.find(name)
            node = ElementTree.SubElement(node, name) if child is None else child
        if element.attribute is None:
            node.text = values[element]
        else:
            node.set(element.attribute, values[element])
    return ElementTree.tostring(root)


def dissect(elements: tuple[Element, ...], message: bytes) -> dict[Element, str]:
    """Return the value of every element of a configuration; numbers are checked for being numbers."""
    root = parse_xml(message, elements[0].path[0])
    values = {}
    for element in elements:
        node = root if len(element.path) == 1 else root.find("/".join(element.path[1:]))
        text = None if node is None else node.text if element.attribute is None else node.get(element.attribute)
        where = "/".join((*element.path, *([f"@{element.attribute}"] if element.attribute else [])))
        if text is None or not text.strip():
            raise DeviceError(f"{where} is {'missing' if text is None else 'empty'}")
        if element.type in ("REAL", "INT"):
            try:
                number = float(text) if element.type == "REAL" else int(text)
            except ValueError as error:
                raise DeviceError(f"{where}: {text[:40]!r} is not a number") from error
            if not math.isfinite(number):
                raise DeviceError(f"{where} is {number}")
        values[element] = text.strip()
    return values


# --- the client -------------------------------------------------------------------------------------------------------


class EkiRobot(ProgramRobot):
    """A robot behind EthernetKRL with our configuration and program."""

    Settings = EkiSettings
    settings: EkiSettings

    def __init__(self, settings: EkiSettings) -> None:
        host, port = settings.host, settings.port
        super().__init__(
            settings, f"EKI {host}:{port}", partial(TcpTransport.connect, host, port), cut_xml, LAST_NUMBER
        )

    def _request(self, number: int, target: KukaPose | None) -> bytes:
        values = [number, MOVE if target else POSE, *(target.values() if target else [0.0] * 6)]
        return compose(OURS.receive, dict(zip(OURS.receive, map(str, values), strict=True)))

    def _reply(self, message: bytes) -> tuple[int, Sequence[float]]:
        texts = dissect(OURS.send, message)
        number, *values = (float(texts[element]) for element in OURS.send)
        return int(number), values
