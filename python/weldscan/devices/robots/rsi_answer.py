"""Answers a controller that runs RSI: a program of its own, on the standard library alone, so that it starts at once.

Python's threads hold each other up: computing in one makes another late by 5 ms and more, where a controller waits 4. A
process is held up by nobody. It answers every packet first, and then reports it to the process that wants poses.
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

LARGEST_PACKET, LARGEST_USABLE = 65_535, 8192
REPORT = struct.Struct(">dQQQ")
"""When the packet came; how many came, were answered, were of no use. The packet follows, where it is of use."""
REAL_TIME_PRIORITY = 10
"""Above every ordinary process; it waits for packets nearly all the time."""
IPOC = re.compile(rb"<IPOC>\s*(\d{1,20})\s*</IPOC>")


def answer(packet: bytes, sen_type: str) -> bytes | None:
    """Return the answer to a packet: no correction, and its IPOC as it came. None when it has no IPOC.

    >>> answer(b'<Rob Type="KUKA"><IPOC>0042</IPOC></Rob>', "ImFree")[-23:]
    b'<IPOC>0042</IPOC></Sen>'
    """
    ipoc = IPOC.search(packet)
    if ipoc is None:
        return None
    return b'<Sen Type="%s"><RKorr X="0.0" Y="0.0" Z="0.0" A="0.0" B="0.0" C="0.0"/><IPOC>%s</IPOC></Sen>' % (
        sen_type.encode(),
        ipoc[1],
    )


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
    packets = answered = unusable = 0
    while True:
        try:
            packet, peer = stream.recvfrom(LARGEST_PACKET)
        except OSError:
            continue  # an ICMP message about an earlier answer: the controller went away, and may come back
        now_s = time.monotonic()
        if peer[0] != controller:
            continue
        packets += 1
        reply = answer(packet, sen_type)
        if reply is not None and not only_send:
            with contextlib.suppress(OSError):
                stream.sendto(reply, peer)
                answered += 1
        if reply is None or len(packet) > LARGEST_USABLE:
            unusable += 1
            packet = b""
        with contextlib.suppress(OSError):  # nobody reads at the moment: the next one is fresher anyway
            reports.send(REPORT.pack(now_s, packets, answered, unusable) + packet)


def _exit_with_parent() -> None:
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    serve(sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4], sys.argv[5] == "1", int(sys.argv[6]))
