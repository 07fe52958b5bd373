"""A projector that is a display: a borderless window at a place of the desktop, never scaled, by pygame-ce.

The window lives in a process of its own (this file, run as a program): it answers the window manager while weldscan
computes, and when the display goes away it is that process that dies with it, not the scan.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import sys
import time
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from weldscan.devices.projectors import DisplayGone, Projector, ProjectorSettings
from weldscan.errors import DeviceError, DeviceTimeout

START_S, SHOW_S = 20.0, 5.0
NO_DISPLAY = ("dummy", "offscreen")
"""What SDL falls back to where nobody can see anything."""


class WindowSettings(ProjectorSettings):
    """`[projector]` with `backend = "window"`."""

    backend: Literal["window"] = "window"
    x: int = 0
    """Left edge of the projector on the desktop, pixels: the width of the first display, where it stands to its
    right."""
    y: int = 0


class WindowProjector(Projector):
    """A borderless window over the projector's whole image."""

    Settings = WindowSettings
    settings: WindowSettings

    def __init__(self, settings: WindowSettings) -> None:
        self.settings = settings
        self.name = f"projector window {settings.width}x{settings.height}+{settings.x}+{settings.y}"
        numbers = [str(n) for n in (settings.x, settings.y, settings.width, settings.height)]
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, *numbers],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            process_group=0,  # Ctrl-C is for the scan, also while this one starts
            bufsize=0,
            env={**os.environ, "PYGAME_HIDE_SUPPORT_PROMPT": "1"},
        )
        os.set_blocking(self._process.stdin.fileno(), False)  # type: ignore[union-attr]
        try:
            self._answer(time.monotonic() + START_S)
        except DeviceError:
            self.close()
            raise

    def close(self) -> None:
        """Close the window."""
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                pipe.close()  # type: ignore[union-attr]
        try:
            self._process.wait(2.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _show(self, image: NDArray[np.uint8]) -> float:
        give_up_s = time.monotonic() + SHOW_S
        try:
            self._send(b"S" + image.tobytes(), give_up_s)
            self._answer(give_up_s)
        except DeviceError:
            self._process.kill()  # what it shows from here on is anybody's guess
            raise
        return time.monotonic()

    def _send(self, data: bytes, give_up_s: float) -> None:
        stdin = self._process.stdin
        assert stdin is not None  # it is a pipe
        view = memoryview(data)
        try:
            while view:
                if not select.select([], [stdin], [], max(give_up_s - time.monotonic(), 0.0))[1]:
                    raise DeviceTimeout(f"{self.name}: the window does not take the pattern")
                view = view[os.write(stdin.fileno(), view) :]
        except (OSError, ValueError) as error:
            if isinstance(error, DeviceTimeout):
                raise
            raise DisplayGone(f"{self.name}: the window is gone") from error

    def _answer(self, give_up_s: float) -> None:
        line = b""
        stdout = self._process.stdout
        assert stdout is not None  # it is a pipe
        while not line.endswith(b"\n"):
            if not select.select([stdout], [], [], max(give_up_s - time.monotonic(), 0.0))[0]:
                raise DeviceTimeout(f"{self.name}: the window does not answer")
            piece = stdout.read(1)
            if not piece:
                raise DisplayGone(f"{self.name}: the window is gone")
            line += piece
        if line != b"ok\n":
            raise DisplayGone(f"{self.name}: {line.decode(errors='replace').strip()}")


def _serve(x: int, y: int, width: int, height: int) -> None:
    """Show what comes on standard input; say `ok`, or what is wrong, in one line each time."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the scan, which then closes our standard input
    # Descriptor 1 is the answer's alone: whatever a library prints goes to stderr.
    answers = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)
    try:
        import pygame  # noqa: PLC0415 - an extra, and only this process needs it

        pygame.display.init()
        if (driver := pygame.display.get_driver()) in NO_DISPLAY:
            raise RuntimeError(f"no display here (video driver {driver})")
        desktop = pygame.display.get_desktop_sizes()
        reach = sum(w for w, _ in desktop), max(h for _, h in desktop)
        if x < 0 or y < 0 or x + width > reach[0] or y + height > max(reach[1], sum(h for _, h in desktop)):
            raise RuntimeError(f"{width}x{height}+{x}+{y} is outside of the desktop {desktop}")
        window = pygame.Window("weldscan projector", (width, height), (x, y), borderless=True)
        pygame.mouse.set_visible(False)
        surface = window.get_surface()
        if surface.get_size() != (width, height):
            raise RuntimeError(f"the window is {surface.get_size()}, not {(width, height)}")
    except Exception as error:
        answers.write(f"no window: {' '.join(str(error).split())}\n".encode())
        return
    surface.fill((0, 0, 0))
    window.flip()
    answers.write(b"ok\n")
    stdin = os.fdopen(0, "rb", buffering=0)
    while True:
        asked = select.select([stdin], [], [], 0.05)[0]
        gone = any(event.type in (pygame.QUIT, pygame.WINDOWCLOSE) for event in pygame.event.get())
        gone = gone or pygame.display.get_desktop_sizes() != desktop
        if gone:
            answers.write(b"the display changed or the window was closed\n")
            return
        if not asked:
            continue
        if stdin.read(1) != b"S":
            return
        data = bytearray()
        while len(data) < width * height:
            piece = stdin.read(width * height - len(data))
            if not piece:
                return
            data += piece
        grey = np.frombuffer(data, np.uint8).reshape(height, width)
        pygame.surfarray.blit_array(surface, np.repeat(grey.T[:, :, None], 3, axis=2))
        window.flip()
        answers.write(b"ok\n")


if __name__ == "__main__":
    _serve(*(int(word) for word in sys.argv[1:5]))
