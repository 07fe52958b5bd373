"""Answers a controller that runs RSI: a program of its own, on the standard library alone, so that it starts at once.

Python's threads hold each other up: computing in one makes another late by 5 ms and more, where a controller waits 4. A
process is held up by nobody. It answers every packet first, then looks whether the packet is in order, and reports
those that are to the process that wants poses.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import struct
import sys
import threading
import time
from collections import deque

LARGEST_PACKET, LARGEST_USABLE = 65_535, 8192
REPORT = struct.Struct(">d7Q")
"""When the packet came, and the seven counts of `Counts`. The packet follows."""
REAL_TIME_PRIORITY = 10
"""Above every ordinary process; it waits for packets nearly all the time."""
IPOC = re.compile(rb"<IPOC>\s*([0-9]{1,18})\s*</IPOC>")

BEGINNING = 10
"""A stream is believed after so many packets that grew: a controller's first one may hold no pose yet (KR C2)."""
BEGINNING_ANEW = 50
"""A stream that begins anew is believed after so many: what was held up somewhere also comes after a silence, all at
once, and on a machine that has other things to do a few packets of it may seem to keep time."""
SILENCE_S = 0.5
"""A stream may begin anew, or from another port, only after none has come for so long; a controller that starts again
takes a minute."""
REMEMBERED = 20_000
"""Packets by which a replay is known: 80 s at 4 ms."""
LATE_S = 0.25
"""A packet that is later than this against the earliest of its stream, by the controller's own clock, was held up."""
DRIFT = 1e-3
"""Clocks differ by less than this share."""
PACE = 0.5
"""A stream whose IPOC runs faster or slower than milliseconds by more than this share counts something else."""
PACE_ANEW = 0.25
"""The same of one that begins anew."""


def answer(packet: bytes, sen_type: str) -> bytes | None:
    """Return the answer to a packet: no correction, and its IPOC as it came. None when it has no IPOC, or several.

    >>> answer(b'<Rob Type="KUKA"><IPOC>0042</IPOC></Rob>', "ImFree")[-23:]
    b'<IPOC>0042</IPOC></Sen>'
    """
    found = IPOC.findall(packet)
    if len(found) != 1 or packet.count(b"<IPOC") != 1:
        return None
    return b'<Sen Type="%s"><RKorr X="0.0" Y="0.0" Z="0.0" A="0.0" B="0.0" C="0.0"/><IPOC>%s</IPOC></Sen>' % (
        sen_type.encode(),
        found[0],
    )


class _Stream:
    """What one sender has sent: how far its IPOC grew, without a step back."""

    def __init__(self, ipoc: int, now_s: float) -> None:
        self.first_ipoc = self.ipoc = ipoc
        self.first_s = self.last_s = now_s
        self.grown = 1
        self.earliest_s = now_s - ipoc / 1000
        """The least that arrival was behind IPOC."""

    def grow(self, ipoc: int, now_s: float) -> None:
        self.grown += 1
        age_s = now_s - self.last_s
        self.ipoc, self.last_s = ipoc, now_s
        self.earliest_s = min(self.earliest_s + DRIFT * age_s, now_s - ipoc / 1000)

    def late_s(self) -> float:
        """How much later than the earliest the last packet came, where IPOC counts milliseconds."""
        return self.last_s - self.ipoc / 1000 - self.earliest_s

    def pace(self) -> float:
        """Seconds of arrival per second of IPOC."""
        return (self.last_s - self.first_s) / max((self.ipoc - self.first_ipoc) / 1000, 1e-3)


class Order:
    """Freshness is order: which packets of all that come are the present of the one controller.

    IPOC grows with every packet. Who has sent ten that grew, steadily, is the controller, by address and port; from
    then on nobody else is heard, nothing that does not grow, and nothing that was seen before. Only when it has been
    silent for half a second may a stream begin again, and has to be steady for longer.
    """

    def __init__(self) -> None:
        self._locked: tuple[object, _Stream] | None = None
        self._in_milliseconds = False
        self._beginning: dict[object, _Stream] = {}
        self._seen: set[int] = set()
        self._remembered: deque[int] = deque()
        self.stale = self.strangers = self.restarts = 0

    def fresh(self, sender: object, ipoc: int, packet: bytes, now_s: float) -> bool:
        """Take note of a packet, and say whether it is to be believed."""
        if self._locked is not None:
            locked, stream = self._locked
            if now_s - stream.last_s <= SILENCE_S:
                if sender != locked:
                    self.strangers += 1
                    return False
                if self._known(packet) or ipoc <= stream.ipoc:
                    self.stale += 1
                    return False
                self._beginning.clear()
                stream.grow(ipoc, now_s)
                if self._in_milliseconds and stream.late_s() > LATE_S:
                    self.stale += 1
                    return False
                return True
        return self._begun(sender, ipoc, packet, now_s)

    def _begun(self, sender: object, ipoc: int, packet: bytes, now_s: float) -> bool:
        """Is this the packet by which a stream has begun?"""
        stream = self._beginning.get(sender)
        if self._known(packet) or (stream is not None and ipoc <= stream.ipoc):
            self.stale += 1
            self._beginning.pop(sender, None)
            return False
        if stream is None or now_s - stream.last_s > SILENCE_S:
            self._beginning[sender] = _Stream(ipoc, now_s)
            return False
        stream.grow(ipoc, now_s)
        rivals = [other for other, its in self._beginning.items() if other != sender and now_s - its.last_s < SILENCE_S]
        if rivals:
            self.strangers += 1
            return False
        if stream.grown < (BEGINNING if self._locked is None else BEGINNING_ANEW):
            return False
        in_milliseconds = abs(stream.pace() - 1.0) < PACE
        if self._locked is not None:
            if self._in_milliseconds and abs(stream.pace() - 1.0) >= PACE_ANEW:
                return False  # a backlog that comes all at once, or anything else but the same clock
            self.restarts += 1
        self._in_milliseconds = in_milliseconds
        self._locked = sender, stream
        self._beginning.clear()
        return True

    def _known(self, packet: bytes) -> bool:
        mark = hash(packet)
        if mark in self._seen:
            return True
        self._seen.add(mark)
        self._remembered.append(mark)
        if len(self._remembered) > REMEMBERED:
            self._seen.discard(self._remembered.popleft())
        return False


def serve(host: str, port: int, controller: str, sen_type: str, only_send: bool, report_port: int) -> None:
    """Answer and report until standard input closes, which it does when the process that wants poses ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which then closes our standard input
    with contextlib.suppress(AttributeError, OSError):  # real-time priority where the system has it and allows it
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REAL_TIME_PRIORITY))
    stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    reports = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        stream.bind((host, port))
        reports.bind(("127.0.0.1", 0))
    except OSError as error:
        print("no", error.strerror or error, flush=True)
        return
    reports.connect(("127.0.0.1", report_port))
    reports.setblocking(False)
    print("ok", stream.getsockname()[1], reports.getsockname()[1], flush=True)
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    order = Order()
    packets = answered = unusable = held = 0
    while True:
        # What lay in the socket was there for nobody knows how long: it is answered, and counts for the order, but a
        # pose is fresh only in a packet that was waited for.
        waiting = True
        try:
            stream.setblocking(False)
            packet, peer = stream.recvfrom(LARGEST_PACKET)
            waiting = False
        except BlockingIOError:
            stream.setblocking(True)
            try:
                packet, peer = stream.recvfrom(LARGEST_PACKET)
            except OSError:
                continue  # an ICMP message about an earlier answer: the controller went away, and may come back
        except OSError:
            continue
        now_s = time.monotonic()
        if peer[0] != controller:
            continue
        packets += 1
        reply = answer(packet, sen_type)
        if reply is None or len(packet) > LARGEST_USABLE:
            unusable += 1
        strangers = order.strangers
        fresh = reply is not None and order.fresh(peer, int(IPOC.findall(packet)[0]), packet, now_s)
        if reply is not None and not only_send and order.strangers == strangers:
            with contextlib.suppress(OSError):
                stream.sendto(reply, peer)
                answered += 1
        held += fresh and not waiting
        if not (fresh and waiting) or len(packet) > LARGEST_USABLE:
            packet = b""
        counts = (packets, answered, unusable, order.stale, order.strangers, order.restarts, held)
        with contextlib.suppress(OSError):  # nobody reads at the moment: the next one is fresher anyway
            reports.send(REPORT.pack(now_s, *counts) + packet)


def _exit_with_parent() -> None:
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    serve(sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4], sys.argv[5] == "1", int(sys.argv[6]))
