"""The one place where errors and signals become a line on stderr and an exit code.

It imports next to nothing, so that it stands before anything that takes time is imported; what it runs imports the
rest inside. The exit code is fixed first, then the line is printed and the streams are flushed.
"""

from __future__ import annotations

import errno
import os
import signal
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import FrameType, TracebackType
    from typing import Any, NoReturn

OUR_FAULT, BAD_INPUT, NOT_MEASURED, INTERRUPTED = 1, 2, 5, 130
STOPS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Ctrl-C, the end of the system, and that of a terminal or a remote session: what was begun is called back."""
NO_THREAD = "can't start new thread"
LATER_S = 0.02
"""How long an interrupt waits that came in the middle of what has to be whole, before it looks again."""

# What can be done about an error of the system, whoever met it; the message itself names the file.
REMEDIES = {
    errno.ENOSPC: "free space there, or name another place",
    errno.EDQUOT: "free space there, or name another place",
    errno.EFBIG: "raise the largest size of a file (ulimit -f), or name another place",
    errno.EROFS: "name a place that can be written to",
    errno.EACCES: "change its permissions, or name another place",
    errno.EPERM: "change its permissions, or name another place",
    errno.ENOTDIR: "a part of this path is a file; name another",
    errno.EISDIR: "this is a folder; name a file",
    errno.ENAMETOOLONG: "name a shorter path",
    errno.EMFILE: "raise the number of open files (ulimit -n)",
    errno.ENFILE: "close other programs",
    errno.EIO: "look after the disk, or name another place",
}


def run(command: Callable[[], object]) -> NoReturn:
    """Run a command and end the process with its exit code; whatever happens, at most one line of complaint.

    `command` gives 0, or what it passes to `sys.exit`. An error of the input or of the system (`WeldscanError`,
    `OSError`, `RecursionError`, `UnicodeError`, `MemoryError`) is 2, `NotMeasured` 5, SIGINT, SIGTERM and SIGHUP 130,
    anything else weldscan's own fault, 1; WELDSCAN_TRACEBACK=1 shows where that came from.
    """
    stop = _Stop()
    stop.install()
    code: int | str | None = None
    said: str | None = None
    try:
        try:
            stop.raises = True
            from weldscan.faces.cli import terminal

            terminal.prepare()
            command()
        finally:
            stop.raises = False
    except BaseException as error:
        stop.raises = False  # an interrupt may have come between
        code, said = _told(error, stop.struck)
    # The error and all that its frames held are gone here: after a MemoryError there is room again.
    from weldscan.faces.cli import terminal

    if said is not None:
        stop.said = True
        terminal.complain(f"weldscan: {' '.join(said.split())}")
    terminal.settle()
    stop.end(code)
    sys.exit(code)


class _Stop:
    """The signals of `STOPS`: each is a KeyboardInterrupt while the command runs, but not in the middle of an import,
    which libraries swallow or are left half imported by, nor of what else has to be whole: then it waits a moment.
    """

    def __init__(self) -> None:
        self.raises = self.struck = self.armed = self.said = False
        self._unraisable = sys.unraisablehook

    def install(self) -> None:
        """Take the signals over, but for one that whoever started the process has switched off."""
        for number in STOPS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self)
        sys.unraisablehook = self._lost

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.struck = True
        if not self.raises:
            # Only a line and what was printed are still on their way; nobody needs to wait for a reader that hangs.
            _leave(self.said)
        if not (_not_now(frame) and self._later()):
            raise KeyboardInterrupt

    def _later(self) -> bool:
        """Strike once more in a moment, where the system has such a timer."""
        if not hasattr(signal, "setitimer"):
            return False
        self.armed = True
        signal.signal(signal.SIGALRM, self)
        signal.setitimer(signal.ITIMER_REAL, LATER_S)
        return True

    def _lost(self, unraisable: Any) -> None:
        """An interrupt that fell into a destructor, where nothing can be raised, comes once more."""
        if not (self.raises and issubclass(unraisable.exc_type, KeyboardInterrupt) and self._later()):
            self._unraisable(unraisable)

    def end(self, code: int | str | None) -> None:
        """From here on only the interpreter closes, which no signal shall disturb."""
        if self.struck and code == INTERRUPTED:
            # Everything was given up already: work that threads still have is not waited for.
            os._exit(INTERRUPTED)
        if self.armed:
            signal.setitimer(signal.ITIMER_REAL, 0)
        for number in STOPS:
            signal.signal(number, signal.SIG_IGN)
        sys.unraisablehook = self._unraisable


def _leave(said: bool = False) -> NoReturn:
    """Ends the process at once, as interrupted."""
    try:
        if not said:
            os.write(2, b"weldscan: interrupted\n")
    finally:
        os._exit(INTERRUPTED)


def _not_now(frame: FrameType | None) -> bool:
    """Whether something is going on, above this frame, that has to be whole."""
    while frame is not None and frame.f_code is not run.__code__:
        module, code = frame.f_globals.get("__name__", ""), frame.f_code
        if (
            code.co_filename.startswith("<frozen importlib")
            # Its models are built when they are first used, and refuse everything when that was disturbed.
            or module.partition(".")[0] == "pydantic"
            # The core looks at NumPy's version when it first meets an array, and cannot go on without.
            or module == "numpy.lib._version"
            # What is half opened nobody would close, and what is half closed stays: hidden folders, sockets, locks.
            or (module.startswith("weldscan.") and code.co_name in ("__enter__", "__exit__"))
        ):
            return True
        frame = frame.f_back
    return False


def _told(error: BaseException, struck: bool) -> tuple[int | str | None, str | None]:
    """Exit code and line of what ended a command."""
    from weldscan.errors import NotMeasured, WeldscanError

    interrupt = next((each for each in _chain(error) if isinstance(each, KeyboardInterrupt)), None)
    if isinstance(error, SystemExit) and (interrupt is None or error.code != INTERRUPTED):
        return error.code, None
    if interrupt is not None:
        # Typer makes 130 of an interrupt, without a word; what was being closed may have failed over it.
        return INTERRUPTED, str(interrupt) or "interrupted"
    if isinstance(error, NotMeasured):
        return NOT_MEASURED, str(error)
    if isinstance(error, WeldscanError):
        return BAD_INPUT, str(error) + _remedy(error)
    if isinstance(error, BrokenPipeError):
        # Whoever read our output went away, and no verdict was due.
        return OUR_FAULT, None
    if os.environ.get("WELDSCAN_TRACEBACK"):
        _show(error, error.__traceback__)
    if isinstance(error, OSError):
        named = ": ".join(str(name) for name in (error.filename, error.strerror or error) if name is not None)
        return BAD_INPUT, named + _remedy(error)
    if isinstance(error, MemoryError):
        return (
            BAD_INPUT,
            f"not enough memory{': ' * bool(str(error))}{error}; give less at once, or more memory",
        )
    if isinstance(error, RuntimeError) and str(error) == NO_THREAD:
        return BAD_INPUT, "the system gives no more threads; raise its limits (ulimit -u, ulimit -v)"
    if isinstance(error, RecursionError):
        return BAD_INPUT, f"an input is nested too deeply: {error}"
    if isinstance(error, UnicodeError):
        return BAD_INPUT, f"a text or a name is in no readable encoding: {error}"
    if struck:
        return INTERRUPTED, "interrupted"  # of which a library made an error of its own
    return (
        OUR_FAULT,
        f"an error of weldscan itself: {type(error).__name__}: {error} (WELDSCAN_TRACEBACK=1 shows where)",
    )


def _remedy(error: BaseException) -> str:
    """What can be done about the system's error behind this one, if it is one of those."""
    numbers = (each.errno for each in _chain(error) if isinstance(each, OSError))
    return next((f"; {REMEDIES[number]}" for number in numbers if number in REMEDIES), "")


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """The error, and what it came from."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _show(error: BaseException, trace: TracebackType | None) -> None:
    import traceback
    from contextlib import suppress

    with suppress(OSError):
        traceback.print_exception(type(error), error, trace)
