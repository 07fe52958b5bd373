"""What runs a KRL program on the simulated controllers: line by line, stopped, continued and reset as from the pendant.

A program is a generator that yields between its lines. Its variables, flags and FIFOs live in the controller and
outlive it, as they do on a real one; so does the clock of its timers, which runs on while the program stands.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Generator

from weldscan.devices.robots.kinematics import Joints
from weldscan.simulated.controllers.arm import Arm

LINE_S = 0.002
"""A controller's interpreter takes a few lines per cycle of 12 ms; here one look at what is waited for."""
Program = Generator[None, None, None]


class Resume(Exception):
    """RESUME in an interrupt's program: back to the level in which the interrupt was declared."""


class Timer:
    """$TIMER and $TIMER_FLAG: milliseconds that count up by themselves; the flag stands from zero on."""

    def __init__(self) -> None:
        self._zero_s = time.monotonic()

    def set(self, milliseconds: float) -> None:
        """Let it count from here."""
        self._zero_s = time.monotonic() - milliseconds / 1000

    @property
    def milliseconds(self) -> float:
        """Where it stands."""
        return (time.monotonic() - self._zero_s) * 1000

    @property
    def flag(self) -> bool:
        """Has it come to zero?"""
        return time.monotonic() >= self._zero_s


class Interpreter:
    """Runs one program again and again from its first line until it is closed."""

    def __init__(self, arm: Arm, program: Callable[[], Program], active: Callable[[], bool] = lambda: True) -> None:
        """`active` says whether the start key is held; while it is not, arm and program stand."""
        self._arm, self._program, self._active = arm, program, active
        self._lines: Program | None = None
        self._closed, self._begun = threading.Event(), threading.Event()
        self.interrupt: Callable[[], bool] | None = None
        """INTERRUPT ON: while it is true the arm brakes, and the program goes on after RESUME."""
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Begin with the first line, and return when the program waits for somebody."""
        self._thread.start()
        self._begun.wait(1.0)

    def close(self) -> None:
        """Deselect the program."""
        self._closed.set()
        if self._thread.is_alive():
            self._thread.join(5.0)

    def reset(self) -> None:
        """Begin again with the first line: a reset program, or a controller that was switched on."""
        self._lines = None

    def ptp(self, joints_deg: Joints) -> Program:
        """PTP and WAIT SEC 0: on until the arm is there, also when it was stopped on its way."""
        self._arm.move_joints(joints_deg)
        while not self._arm.at(joints_deg):
            if not self._arm.moving:
                self._arm.move_joints(joints_deg)
            yield

    def _run(self) -> None:
        while not self._closed.wait(LINE_S):
            if not self._active():
                if self._arm.driven:
                    self._arm.brake()
                continue
            with contextlib.suppress(StopIteration):
                self._line()
            self._begun.set()

    def _line(self) -> None:
        if self._lines is None:
            self.interrupt = None
            self._arm.driven = False
            self._lines = self._program()
        if self.interrupt is not None and self.interrupt():
            self.interrupt = None
            self._arm.brake()
            self._lines.throw(Resume())
            return
        next(self._lines)
