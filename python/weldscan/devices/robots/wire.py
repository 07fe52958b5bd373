"""Whole messages out of a byte stream, one question at a time, and what happens when the other side misbehaves.

The three stream links (KVP, EthernetKRL, serial) differ in how a message is cut from the bytes and what it means; how
the bytes are collected, timed and given up is the same and stands here. A stream that has once been out of step is
never read further: the connection is dropped, and the next question opens a new one.
"""

from __future__ import annotations

import contextlib
import ipaddress
import os
import queue
import re
import select
import socket
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Generic, Protocol, TypeVar
from xml.etree import ElementTree

from pydantic import AfterValidator

from weldscan.errors import DeviceError, DeviceTimeout, InputError

T = TypeVar("T")
Cut = Callable[[bytearray], bytes | None]
"""Takes one whole message off the front of the buffer; None while it is incomplete; `DeviceError` on nonsense."""

LARGEST_MESSAGE = 65_536
"""Bytes: the largest message of any link here has about 1,000."""
CLOSE_S = 0.5
BEAT_S = 0.5
"""Whoever waits for a motion says so this often."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.05, 1.0
"""Back-off between attempts to reconnect: doubled from the first to the longest."""


def checked_host(host: str) -> str:
    """A name or number that can be looked up; the system's own look-up raises UnicodeError or ValueError for others."""
    try:
        host.encode("idna")
    except UnicodeError:
        host = ""
    if not host or "\0" in host:
        raise ValueError("should be a host's name or address")
    return host


def checked_address(address: str) -> str:
    """An IPv4 address as packets carry it: a name would never be equal to one."""
    try:
        return str(ipaddress.IPv4Address(address))
    except ValueError:
        raise ValueError("should be an address such as 192.168.1.10, not a name") from None


Host = Annotated[str, AfterValidator(checked_host)]
Address = Annotated[str, AfterValidator(checked_address)]


class Deadline:
    """When one question of the user has to be answered, however many the link makes of it.

    `timeout_s` from its beginning; where a connection was lost meanwhile, `reconnect_s` from its beginning.
    """

    def __init__(self, timeout_s: float, reconnect_s: float = 0.0) -> None:
        self.timeout_s, self.start_s = timeout_s, time.monotonic()
        self.end_s = self.start_s + timeout_s
        self._end_after_loss_s = self.start_s + max(timeout_s, reconnect_s)

    def lose(self) -> None:
        """Grant the time for a lost connection."""
        self.end_s = self._end_after_loss_s


@dataclass(frozen=True)
class Answer(Generic[T]):
    """What a reply said, when the question was sent, and when the reply was there; monotonic clock."""

    value: T
    asked_s: float
    told_s: float


class ConnectionLost(DeviceError):
    """The other side refused, closed or reset the connection; a question without side effects may be asked again."""


class Transport(Protocol):
    """A byte stream. Times are `time.monotonic()` deadlines; errors name no one, for a `Link` does."""

    def send(self, data: bytes, deadline_s: float) -> None:
        """Send all of it."""

    def receive(self, deadline_s: float) -> bytes:
        """Wait for at least one byte."""

    def close(self) -> None:
        """Close it."""


class TcpTransport:
    """A TCP connection."""

    def __init__(self, peer: socket.socket) -> None:
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket = peer

    @classmethod
    def connect(cls, host: str, port: int, deadline_s: float) -> TcpTransport:
        """Open a connection."""
        error: OSError | None = None
        for family, kind, protocol, _, address in addresses(host, port, deadline_s):
            peer = socket.socket(family, kind, protocol)
            try:
                peer.settimeout(max(_remaining(deadline_s), 1e-3))
                peer.connect(address)
                return cls(peer)
            except OSError as failed:
                peer.close()
                error = failed
        if isinstance(error, TimeoutError | BlockingIOError):
            raise DeviceTimeout("no answer to the connection request") from error
        raise ConnectionLost(f"cannot connect: {(error and error.strerror) or error}") from error

    def send(self, data: bytes, deadline_s: float) -> None:
        """Send all of it."""
        try:
            self._socket.settimeout(_remaining(deadline_s))
            self._socket.sendall(data)
        except (TimeoutError, BlockingIOError) as error:
            raise DeviceTimeout("does not take what is sent") from error
        except OSError as error:
            raise ConnectionLost(f"connection lost: {error.strerror or error}") from error

    def receive(self, deadline_s: float) -> bytes:
        """Wait for at least one byte."""
        try:
            self._socket.settimeout(_remaining(deadline_s))
            data = self._socket.recv(LARGEST_MESSAGE)
        except (TimeoutError, BlockingIOError) as error:
            raise DeviceTimeout("no whole answer in time") from error
        except OSError as error:
            raise ConnectionLost(f"connection lost: {error.strerror or error}") from error
        if not data:
            raise ConnectionLost("the other side closed the connection")
        return data

    def close(self) -> None:
        """Close it."""
        with contextlib.suppress(OSError):  # wakes a thread that waits in receive()
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def reset(self) -> None:
        """Close it with a reset (RST), as a machine does that lost its memory of the connection."""
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._socket.close()


def addresses(host: str, port: int, deadline_s: float) -> list[Any]:
    """Return what `socket.getaddrinfo` says of a TCP server, but in time: a name server may be silent for long."""
    found: queue.SimpleQueue[list[Any] | OSError] = queue.SimpleQueue()

    def look_up() -> None:
        try:
            found.put(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM))
        except OSError as error:
            found.put(error)

    threading.Thread(target=look_up, daemon=True).start()
    try:
        answer = found.get(timeout=max(_remaining(deadline_s), 0.05))
    except queue.Empty:
        raise DeviceTimeout(f"no name server tells the address of {host}") from None
    if isinstance(answer, OSError):
        raise ConnectionLost(f"cannot connect: {answer.strerror or answer}") from answer
    return answer


class FileTransport:
    """A file descriptor that is read and written, such as one end of a pseudo-terminal."""

    def __init__(self, descriptor: int) -> None:
        self._fd = descriptor

    def send(self, data: bytes, deadline_s: float) -> None:
        """Send all of it."""
        while data:
            left_s = _remaining(deadline_s)
            if left_s == 0.0 or not select.select([], [self._fd], [], left_s)[1]:
                raise DeviceTimeout("does not take what is sent")
            data = data[os.write(self._fd, data[:1024]) :]

    def receive(self, deadline_s: float) -> bytes:
        """Wait for at least one byte."""
        try:
            if not select.select([self._fd], [], [], _remaining(deadline_s))[0]:
                raise DeviceTimeout("no whole answer in time")
            data = os.read(self._fd, LARGEST_MESSAGE)
        except (OSError, ValueError) as error:
            if isinstance(error, DeviceTimeout):
                raise
            raise ConnectionLost(str(error)) from error
        if not data:
            raise ConnectionLost("closed")
        return data

    def close(self) -> None:
        """Close it."""
        os.close(self._fd)


class Messages:
    """Whole messages from a transport, however the bytes were split or joined on their way."""

    def __init__(self, transport: Transport, cut: Cut) -> None:
        self.transport, self._cut, self._buffer = transport, cut, bytearray()

    def next(self, deadline_s: float) -> bytes:
        """Wait for one whole message."""
        while (message := self._cut(self._buffer)) is None:
            if len(self._buffer) > LARGEST_MESSAGE:
                raise DeviceError(f"a message of more than {LARGEST_MESSAGE} bytes without an end")
            self._buffer += self.transport.receive(deadline_s)
        return message

    def unasked(self) -> bool:
        """Is there anything that nobody asked for, a line end apart?"""
        if self._buffer:
            return True
        try:
            return bool(self.transport.receive(time.monotonic()).strip())
        except DeviceTimeout:
            return False


class Link:
    """Asks one question at a time, within a time-out, over a connection that is opened when it is needed.

    A question that may be repeated (reading has no side effects) survives a lost connection: it is asked again after a
    growing pause until `reconnect_s` have passed. Silence and nonsense are never repeated but raised.
    """

    def __init__(
        self, name: str, connect: Callable[[float], Transport], cut: Cut, timeout_s: float, reconnect_s: float
    ) -> None:
        self.name, self.timeout_s, self.reconnect_s = name, timeout_s, reconnect_s
        self._connect, self._cut = connect, cut
        self._messages: Messages | None = None
        self._lock = threading.Lock()
        self.last_used_s = time.monotonic()

    def open(self) -> None:
        """Connect now, so that a wrong address is told at once."""
        with self._lock:
            try:
                self._stream(time.monotonic() + self.timeout_s)
            except DeviceError as error:
                raise type(error)(f"{self.name}: {error}") from error

    def deadline(self) -> Deadline:
        """Begin a question of the user."""
        return Deadline(self.timeout_s, self.reconnect_s)

    def ask(
        self,
        request: bytes,
        read: Callable[[bytes], T],
        repeat: bool = True,
        deadline: Deadline | None = None,
        beat: bytes | None = None,
    ) -> Answer[T]:
        """Send the request and give what `read` makes of the one reply.

        `read` raises `DeviceError` or `InputError` on a reply that is not the answer. `deadline` is of the question of
        the user that this one is a part of; without one it is a question of its own. `beat` is said every half second
        until the reply comes.
        """
        deadline = deadline or self.deadline()
        if not self._lock.acquire(timeout=max(_remaining(deadline.end_s), 1e-3)):
            raise DeviceTimeout(f"{self.name}: busy with another question")
        try:
            pause_s = FIRST_PAUSE_S
            while True:
                end_s = min(deadline.end_s, time.monotonic() + deadline.timeout_s)
                try:
                    messages = self._stream(end_s)
                    asked_s = time.monotonic()
                    messages.transport.send(request, end_s)
                    value = read(messages.next(end_s) if beat is None else _awaited(messages, beat, end_s))
                    self.last_used_s = time.monotonic()
                    return Answer(value, asked_s, self.last_used_s)
                except ConnectionLost as error:
                    self._drop()
                    if repeat:
                        deadline.lose()
                    if not repeat or time.monotonic() + pause_s > deadline.end_s:
                        raise type(error)(f"{self.name}: {error}") from error
                except (DeviceError, InputError) as error:
                    self._drop()
                    kind = type(error) if isinstance(error, DeviceError) else DeviceError
                    raise kind(f"{self.name}: {error}") from error
                except BaseException:
                    self._drop()
                    raise
                time.sleep(pause_s)
                pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
        finally:
            self._lock.release()

    def renew(self) -> None:
        """Hang up and begin anew, after an interrupt that may have struck anywhere, the lock included."""
        self._lock = threading.Lock()
        self._drop()

    def close(self) -> None:
        """Close the connection; whoever asks through it at the moment is not waited for."""
        held = self._lock.acquire(timeout=CLOSE_S)
        self._drop()
        if held:
            self._lock.release()

    def _stream(self, deadline_s: float) -> Messages:
        if self._messages is not None:
            with contextlib.suppress(ConnectionLost):
                if not self._messages.unasked():
                    return self._messages
            self._drop()  # the other side closed it or talks out of turn
        self._messages = Messages(self._connect(deadline_s), self._cut)
        return self._messages

    def _drop(self) -> None:
        if self._messages is not None:
            with contextlib.suppress(OSError):
                self._messages.transport.close()
            self._messages = None


def _awaited(messages: Messages, beat: bytes, deadline_s: float) -> bytes:
    while True:
        try:
            return messages.next(min(time.monotonic() + BEAT_S, deadline_s))
        except DeviceTimeout:
            if time.monotonic() >= deadline_s:
                raise
            messages.transport.send(beat, deadline_s)


_ROOT = re.compile(rb"\s*(?:<\?xml[^<>]*\?>\s*)?<([A-Za-z_][\w.-]*)")
_DECLARED = re.compile(rb"""\s*<\?xml[^<>]*?\sencoding\s*=\s*["']([^"'<>]*)["']""")
ENCODINGS = ("utf-8", "us-ascii", "ascii")


def cut_xml(buffer: bytearray) -> bytes | None:
    """Cut one XML document, which ends with the closing tag of its root; no DTD, no comment, no CDATA."""
    if b"<!" in buffer:
        raise DeviceError("XML with a DTD, entity, comment or CDATA section is refused")
    if b"\0" in buffer:  # of UTF-16 and its like, in which every other search here would be blind
        raise DeviceError("XML in another encoding than UTF-8 is refused")
    root = _ROOT.match(buffer)
    if root is None:
        if buffer.strip() and (not buffer.lstrip().startswith(b"<") or len(buffer) > 256):
            raise DeviceError(f"not XML: {bytes(buffer[:40])!r}")
        return None
    name = re.escape(root[1])
    end = re.compile(rb"(?:[^<>]*/>|[\s>].*?</" + name + rb"\s*>)", re.DOTALL).match(buffer, root.end())
    if end is None:
        return None
    message = bytes(buffer[: end.end()]).lstrip()
    del buffer[: end.end()]
    del buffer[: len(buffer) - len(buffer.lstrip())]
    return message


def xml_text(data: bytes) -> str:
    """Return the text of an XML document. Before anything else looks at it: in UTF-16, or in UTF-7, a DTD hides from
    every search for `<!`. Raises `DeviceError` for any encoding but UTF-8 and ASCII.
    """
    declared = _DECLARED.match(data)
    if declared is not None and declared[1].decode("latin-1").lower() not in ENCODINGS:
        raise DeviceError(f"XML in the encoding {declared[1][:20].decode('latin-1')!r} is refused: UTF-8 or ASCII")
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DeviceError(f"XML in another encoding than UTF-8 is refused: {data[:40]!r}") from error
    if "\0" in text:
        raise DeviceError("XML in another encoding than UTF-8 is refused")
    return text


def parse_xml(data: bytes, root: str) -> ElementTree.Element:
    """Parse a document that an outsider sent: small, in UTF-8, without DTD and entities, and with the expected root."""
    if len(data) > LARGEST_MESSAGE:
        raise DeviceError(f"XML of {len(data)} bytes is refused")
    text = xml_text(data)
    if "<!" in text:
        raise DeviceError("XML with a DTD, entity, comment or CDATA section is refused")
    try:
        element = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise DeviceError(f"not XML: {error}: {data[:40]!r}") from error
    if element.tag != root:
        raise DeviceError(f"XML with the root <{element.tag}>, expected <{root}>")
    return element


def only(root: ElementTree.Element, path: str) -> ElementTree.Element | None:
    """Return the one element at a path, None where there is none; raises `DeviceError` where there are several."""
    found = root.findall(path)
    if len(found) > 1:
        raise DeviceError(f"{len(found)} elements <{path}>: which of them holds?")
    return found[0] if found else None


def _remaining(deadline_s: float) -> float:
    """Seconds left. Zero means to a socket: what is there already, without waiting."""
    return max(deadline_s - time.monotonic(), 0.0)
