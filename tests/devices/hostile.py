"""What other sides of the links may do: RSI streams out of order or out of their mind, and replies spoilt on their way.

Every attack knows the truth, so that what a link made of it is either that, an error, or wrong.
"""

from __future__ import annotations

import contextlib
import math
import random
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from weldscan import DeviceError, KukaPose
from weldscan.devices import backend
from weldscan.devices.robots import RESPITE_S, Robot
from weldscan.devices.robots.plausible import distance
from weldscan.simulated.controllers import Arm

TRUE = KukaPose(1610.825, -148.476, 981.652, -29.008, 23.236, 74.641)
FALSE = KukaPose(1612.325, -148.476, 981.652, -29.008, 23.236, 74.641)
"""So near that no speed forbids it."""
WRONG_MM, WRONG_DEG = 0.01, 0.001
CYCLE_S = 0.004

# --- RSI --------------------------------------------------------------------------------------------------------------

Packet = tuple[float, int, bytes]
"""Seconds to wait before it is sent, which sender sends it, its bytes."""


def rsi_packet(flange: KukaPose, ipoc: object, joints_of: KukaPose | None = None) -> bytes:
    """What a controller sends whose arm holds the flange, with the joints that hold that or another pose."""
    joints = " ".join(f'A{i}="{a:.6f}"' for i, a in enumerate(Arm(joints_of or flange).joints_deg, 1))
    pose = " ".join(f'{name}="{value:.6f}"' for name, value in zip("XYZABC", flange.values(), strict=True))
    return f'<Rob Type="KUKA"><RIst {pose}/><AIPos {joints}/><Delay D="0"/><IPOC>{ipoc}</IPOC></Rob>'.encode()


def honest(flange: KukaPose, first: int, count: int, sender: int = 0) -> list[Packet]:
    """A stream as it should be."""
    packet = rsi_packet(flange, "IPOC")
    return [(CYCLE_S, sender, packet.replace(b"IPOC</", b"%d</" % (first + 4 * i))) for i in range(count)]


def interleaved(a: list[Packet], b: list[Packet]) -> list[Packet]:
    """Both at once."""
    return [packet for first, second in zip(a, b, strict=True) for packet in (first, (0.0, *second[1:]))]


def again(packets: list[Packet], times: int, pause_s: float = 0.0) -> list[Packet]:
    """The same packets round and round."""
    first, *rest = packets
    return [(first[0] + pause_s, *first[1:]), *rest] * times


def now(change: Callable[[bytes], bytes]) -> list[Packet]:
    """The stream goes on in order, with another content."""
    return [(wait, sender, change(packet)) for wait, sender, packet in honest(FALSE, 2000, 120)]


def with_x(text: str) -> list[Packet]:
    return now(lambda packet: re.sub(rb'X="[^"]*"', b'X="%s"' % text.encode(), packet))


def rsi_streams() -> dict[str, list[Packet]]:
    """24 hostile streams: after an honest beginning that ends at `TRUE` everything at another pose is false.

    The honest beginning: 60 packets at `FALSE`, when that was true, then 60 at `TRUE`: IPOC 1000 to 1476.
    """
    old = honest(FALSE, 1000, 60)
    on = honest(TRUE, 1480, 120)
    metres = KukaPose(*(v / 1000 for v in FALSE.values()[:3]), *FALSE.values()[3:])
    far = KukaPose(3610.825, *TRUE.values()[1:])
    dtd = b'<?xml version="1.0" encoding="utf-16"?><!DOCTYPE Rob [<!ENTITY x "1">]>'
    return {
        "ring of 2": again(old[:2], 100),
        "ring of 5": again(old[:5], 40),
        "ring of 30": again(old[:30], 8),
        "ring of all": again(old, 4),
        "ring with pauses of 0.3 s": again(old[:30], 6, 0.3),
        "ring with pauses of 0.8 s": again(old, 3, 0.8),
        "backwards": old[::-1] * 3,
        "backwards from the present": honest(FALSE, 1000, 120)[::-1],
        "the same IPOC, another pose": [(CYCLE_S, 0, rsi_packet(FALSE, 1476))] * 120,
        "IPOC 0": [(CYCLE_S, 0, rsi_packet(FALSE, 0))] * 120,
        "late packets between": interleaved(on[:60], old),
        "a late packet now and then": [
            p for i in range(60) for p in ([on[i]] + ([(0.0, *old[i][1:])] if i % 10 == 9 else []))
        ],
        "a second of backlog at once": [(1.0, 0, b"")] + [(0.0, 0, p) for _, _, p in honest(FALSE, 1480, 240)],
        "second sender ahead": interleaved(on[:60], honest(FALSE, 9000, 60, 1)),
        "second sender with the same IPOC": interleaved(on[:60], honest(FALSE, 1480, 60, 1)),
        "second sender behind": interleaved(on[:60], honest(FALSE, 500, 60, 1)),
        "another address": honest(FALSE, 2000, 120, 2),
        "no IPOC": now(lambda packet: re.sub(rb"<IPOC>.*</IPOC>", b"", packet)),
        "two IPOCs": now(lambda packet: packet.replace(b"<IPOC>", b"<IPOC>77</IPOC><IPOC>", 1)),
        "metres": [
            (w, s, re.sub(rb"<RIst[^>]*>", rsi_packet(metres, 0).split(b"<AIPos")[0][17:], p)) for w, s, p in on
        ],
        "all zeros": now(lambda packet: re.sub(rb'"-?\d+\.\d+"', b'"0.0"', packet)),
        "two metres away for good": [
            (0.4, 0, b""),
            *[(CYCLE_S, 0, rsi_packet(far, 2000 + 4 * i, TRUE)) for i in range(100)],
        ],
        "5_0_0 and Arabic digits": with_x("1_612.325") + with_x("١٦١٢.٣٢٥"),
        "UTF-16 with a DTD": now(lambda packet: (dtd + packet).decode().encode("utf-16")),
    }


def wrong_rsi_poses(robot: Robot, port: int, stream: list[Packet]) -> tuple[int, int]:
    """Send a stream behind its honest beginning; give how many poses were believed, and how many of them were wrong."""
    senders = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(3)]
    for sender, address in zip(senders, ("127.0.0.1", "127.0.0.1", "127.0.0.2"), strict=True):
        sender.bind((address, 0))
    hostile, over = threading.Event(), threading.Event()

    def send() -> None:
        for number, (wait_s, who, packet) in enumerate(honest(FALSE, 1000, 60) + honest(TRUE, 1240, 60) + stream):
            if number == 119:
                hostile.set()
            if wait_s:
                time.sleep(wait_s)
            if packet:
                senders[who].sendto(packet, ("127.0.0.1", port))
        over.set()

    thread = threading.Thread(target=send)
    thread.start()
    hostile.wait()
    believed = wrong = 0
    while not over.is_set():
        try:
            pose = robot.pose().flange
        except DeviceError:
            continue
        believed += 1
        mm, deg = distance(pose, TRUE)
        wrong += mm > WRONG_MM or deg > WRONG_DEG
    thread.join()
    for sender in senders:
        sender.close()
    return believed, wrong


# --- replies spoilt on their way --------------------------------------------------------------------------------------

Spoil = Callable[[random.Random, bytes, bytes], bytes | None]
"""What becomes of a reply, given the one before it; None closes the connection."""

_DIGIT = re.compile(rb"(?<=[ \"{,])-?\d+\.\d+")


def _number(chance: random.Random, reply: bytes, change: Callable[[bytes], bytes]) -> bytes:
    """One of the numbers in it written otherwise; the lengths that surround it are not put right."""
    found = list(_DIGIT.finditer(reply))
    if not found:
        return reply[:-1]
    one = chance.choice(found)
    return reply[: one.start()] + change(one[0]) + reply[one.end() :]


def _inserted(chance: random.Random, text: bytes) -> bytes:
    place = chance.randrange(text.index(b".") + 1) + (text[:1] == b"-")
    return text[:place] + b"%d" % chance.randrange(1, 10) + text[place:]


def _cut(chance: random.Random, reply: bytes, last: bytes) -> bytes:
    return reply[: chance.randrange(len(reply))]


def _flipped(chance: random.Random, reply: bytes, last: bytes) -> bytes:
    place = chance.randrange(min(6, len(reply)))
    return reply[:place] + bytes([reply[place] ^ (1 << chance.randrange(8))]) + reply[place + 1 :]


SPOILS: dict[str, Spoil] = {
    "cut": _cut,
    "head flipped": _flipped,
    "the reply before it": lambda chance, reply, last: last or reply,
    "both replies": lambda chance, reply, last: last + reply,
    "twice": lambda chance, reply, last: reply + reply,
    "garbage before": lambda chance, reply, last: chance.randbytes(chance.randrange(1, 20)) + reply,
    "garbage": lambda chance, reply, last: chance.randbytes(len(reply)),
    "nothing": lambda chance, reply, last: b"",
    "closed": lambda chance, reply, last: None,
    "NaN": lambda chance, reply, last: _number(chance, reply, lambda text: b"NaN"),
    "inf": lambda chance, reply, last: _number(chance, reply, lambda text: b"1e999"),
    "5_0_0": lambda chance, reply, last: _number(chance, reply, lambda text: b"_".join([text[:-1], text[-1:]])),
    "Arabic digits": lambda chance, reply, last: _number(
        chance, reply, lambda text: "".join(chr(0x660 + b - 48) if 48 <= b < 58 else chr(b) for b in text).encode()
    ),
    "a digit more": lambda chance, reply, last: _number(chance, reply, lambda text: _inserted(chance, text)),
    "a digit less": lambda chance, reply, last: _number(chance, reply, lambda text: text[:-1]),
    "a comma": lambda chance, reply, last: _number(chance, reply, lambda text: text.replace(b".", b",")),
    "no point": lambda chance, reply, last: _number(chance, reply, lambda text: text.replace(b".", b"")),
    "no sign": lambda chance, reply, last: _number(chance, reply, lambda text: text.replace(b"-", b"")),
    "other encoding": lambda chance, reply, last: reply.decode("latin-1").encode("utf-16"),
    "upper case": lambda chance, reply, last: reply.upper(),
}


class Proxy:
    """Stands between a link and its controller and spoils the replies, chance by chance of a seed."""

    def __init__(self, port: int, spoil: Spoil, seed: int) -> None:
        self.spoil, self.chance = spoil, random.Random(seed)
        self.on = False
        self._open: set[socket.socket] = set()
        self._unplugged = False
        self._there = ("127.0.0.1", port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)  # wakes whoever waits in accept()
        self._listener.close()

    def unplug(self) -> None:
        """Hang up on both sides, and let nobody through again."""
        self._unplugged = True
        self.close()
        for peer in list(self._open):
            with contextlib.suppress(OSError):
                peer.shutdown(socket.SHUT_RDWR)

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                threading.Thread(target=self._serve, args=(near,), daemon=True).start()

    def _serve(self, near: socket.socket) -> None:
        with contextlib.suppress(OSError), near, socket.create_connection(self._there, 2.0) as far:
            self._open |= {near, far}
            if self._unplugged:
                return
            threading.Thread(target=self._requests, args=(near, far), daemon=True).start()
            last = b""
            while reply := far.recv(65536):
                told: bytes | None = reply
                if self.on and self.chance.random() < 0.4:
                    told = self.spoil(self.chance, reply, last)
                last = reply
                if told is None:
                    break
                near.sendall(told)
            far.shutdown(socket.SHUT_RDWR)
            near.shutdown(socket.SHUT_RDWR)

    @staticmethod
    def _requests(near: socket.socket, far: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while request := near.recv(65536):
                far.sendall(request)
        with contextlib.suppress(OSError):
            far.shutdown(socket.SHUT_RDWR)


def tcp_cases(count: int) -> Iterator[tuple[str, int]]:
    """Names of what is done to the replies, in turn, each with its seed."""
    names = sorted(SPOILS)
    for number in range(count):
        yield names[number % len(names)], number


# --- whoever asked for a motion goes away -----------------------------------------------------------------------------

MOVER = """
import sys
from weldscan import DeviceError, KukaPose
from weldscan.devices import backend
from weldscan.faces.cli import boundary

def move():
    robot = backend("robot", sys.argv[1])
    port = sys.argv[2] if sys.argv[1] == "serial" else int(sys.argv[2])
    client = robot(robot.Settings(port=port, allow_motion=True, timeout_s=1.0, reconnect_s=1.0))
    try:
        print("ready", flush=True)
        sys.stdin.readline()
        print("arrived", client.move_to(KukaPose(*map(float, sys.argv[3:]))), flush=True)
    except (DeviceError, KeyboardInterrupt) as error:
        print("ended:", str(error) or "before anything was asked", flush=True)

boundary.run(move)
"""
"""Moves the flange, in a process of its own, when it is told to."""
FAR = KukaPose(1690.825, -148.476, 981.652, -29.008, 23.236, 74.641)
"""Four seconds away."""
SPEED_MM_S = 20.0
LONGEST_LET_GO_S = 3.5
GRACE_S = 0.5
"""A program looks every few ms, and what is on its way arrives, on a machine that others use."""


@dataclass
class Aftermath:
    """What was left of a motion whose asker went away."""

    armed: bool
    """Did anything still wait, two seconds after the program could drop it?"""
    late_s: float
    """How long after the asker's end the last motion began; minus infinity for none."""
    travelled_mm: float
    said: str
    let_go: bool
    """Was the start key let go meanwhile?"""


def interrupted(link: str, kind: str, seed: int) -> Aftermath:
    """Let a process ask for a motion, end it at a random moment, and look on for a while.

    In every second case the start key has been let go by then, and is pressed again some seconds later.
    """
    chance = random.Random(f"{link} {kind} {seed}")
    arm = Arm(TRUE)
    arm.speed_mm_s = SPEED_MM_S
    with backend("controller", link)(arm) as controller:
        proxy = Proxy(controller.port, SPOILS["twice"], seed) if link != "serial" and kind == "lost" else None
        port = controller.port if proxy is None else proxy.port
        process = subprocess.Popen(
            [sys.executable, "-c", MOVER, link, str(port), *map(str, FAR.values())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.stdin.write("\n")
        process.stdin.flush()
        until_s = chance.uniform(0.0, 0.5)
        let_go = chance.random() < 0.5
        if let_go:
            time.sleep(until_s * chance.random())
            hold(controller, False)
        time.sleep(until_s)
        before = arm.flange()
        if kind == "lost":
            if proxy is None:
                process.send_signal(signal.SIGSTOP)  # a line knows no end: nothing is said any more
            else:
                proxy.unplug()
        else:
            process.send_signal(getattr(signal, f"SIG{kind}"))
        end_s = runs_s = time.monotonic()
        if let_go:
            time.sleep(chance.uniform(0.3, LONGEST_LET_GO_S))
            hold(controller, True)
            runs_s = time.monotonic()  # a program that stands cannot drop anything
        time.sleep(RESPITE_S + GRACE_S + runs_s - time.monotonic())
        armed = is_armed(controller)
        if kind == "lost":
            process.kill()
        said, _ = process.communicate(timeout=20)
        begun_s = max(arm.begun_s, default=-math.inf)
        return Aftermath(armed, begun_s - end_s, distance(before, arm.flange())[0], said, let_go)


def hold(controller: Any, pressed: bool) -> None:
    """Press the start key, or let it go."""
    if hasattr(controller, "variables"):
        controller.variables["$PRO_STATE1"] = "#P_ACTIVE" if pressed else "#P_STOP"
    else:
        controller.running = pressed


def is_armed(controller: Any) -> bool:
    """Does anything wait that could set the arm off?"""
    if hasattr(controller, "variables"):
        return controller.variables["COM_ACTION"] != "0" or controller.variables["COM_GO"] != "0"
    return controller._requests.waits
