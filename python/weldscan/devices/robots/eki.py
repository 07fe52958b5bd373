"""EthernetKRL: XML over TCP; the robot is the server, on ports 54600 to 54615, and a KRL program of ours answers.

There is no length and no terminator: a message ends with the closing tag of its root. On the controller every element
has its own FIFO, so both sides always send every element. Configuration and program: `krl/WeldscanEki.xml`,
`krl/weldscan_eki.src`.

There is no checksum either, so the program tells every number of the reading a second time with the other sign: a digit
that got lost, got in or got changed on its way is in one of the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal
from xml.etree import ElementTree

from pydantic import Field

from weldscan.devices.robots import RobotSettings
from weldscan.devices.robots.program import LAST_NUMBER, Command, ProgramRobot
from weldscan.devices.robots.wire import LARGEST_MESSAGE, Host, TcpTransport, cut_xml, only, parse_xml, xml_text
from weldscan.errors import DeviceError, InputError
from weldscan.pose import KukaPose, parse_number, parse_whole
from weldscan.records.files import read_bytes

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
        try:
            document = xml_text(text)
        except DeviceError as error:
            raise InputError(f"{path}: {error}") from error
        if "<!DOCTYPE" in document or "<!ENTITY" in document:
            raise InputError(f"{path}: XML with a DTD is refused")
        try:
            root = ElementTree.fromstring(document)
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
        *(Element.parse(f"Robot/Reply/@{name}") for name in ("Id", "Status", "Mode", "Interpolation")),
        *(Element.parse(f"Robot/{frame}/@{name}") for frame in ("Position", "Tool", "Base") for name in CARTESIAN),
        *(Element.parse(f"Robot/Axis/@{name}") for name in JOINTS),
        *(Element.parse(f"Robot/Target/@{name}") for name in CARTESIAN),
        *(Element.parse(f"Robot/Minus{frame}/@{name}") for frame in ("Position", "Tool", "Base") for name in CARTESIAN),
        *(Element.parse(f"Robot/MinusAxis/@{name}") for name in JOINTS),
    ),
)
TOLD_TWICE = 4 * 6
"""The last numbers of a reply, which tell $POS_ACT, $TOOL, $BASE and the joints once more."""


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
        node = root if len(element.path) == 1 else only(root, "/".join(element.path[1:]))
        text = None if node is None else node.text if element.attribute is None else node.get(element.attribute)
        where = "/".join((*element.path, *([f"@{element.attribute}"] if element.attribute else [])))
        if text is None or not text.strip():
            raise DeviceError(f"{where} is {'missing' if text is None else 'empty'}")
        if element.type in ("REAL", "INT"):
            try:
                (parse_number if element.type == "REAL" else parse_whole)(text.strip())
            except InputError as error:
                raise DeviceError(f"{where}: {error}") from None
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

    def _request(self, number: int, command: Command, target: KukaPose) -> bytes:
        values = [number, int(command), *target.values()]
        return compose(OURS.receive, dict(zip(OURS.receive, map(str, values), strict=True)))

    def _reply(self, message: bytes) -> tuple[int, Sequence[float]]:
        texts = dissect(OURS.send, message)
        number, *codes = (parse_whole(texts[element]) for element in OURS.send[:4])
        values = [parse_number(texts[element]) for element in OURS.send[4:]]
        if any(a != -b for a, b in zip(values[:TOLD_TWICE], values[-TOLD_TWICE:], strict=True)):
            raise DeviceError("the reading is not what it is when told a second time")
        return number, [*codes, *values[:-TOLD_TWICE]]
