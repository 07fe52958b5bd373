"""How words reach whoever runs a command: on any console's code page, and without a reader, too.

A verdict is an exit code first. What cannot be printed, because a console lacks a character, a pipe was closed or a
device is full, must not change it.
"""

from __future__ import annotations

import codecs
import os
import sys
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

ERRORS = "weldscan-plain"
"""The codec error handler by which a console that lacks a character gets plain ones for it."""
PLAIN = {
    "°": " deg",
    "±": "+-",
    "−": "-",
    "–": "-",
    "—": "-",
    "×": "x",
    "·": "*",
    "≤": "<=",
    "≥": ">=",
    "→": "->",
    "…": "...",
    "“": '"',
    "”": '"',
    "‘": "'",
    "’": "'",
    "µ": "u",
    "μ": "u",
    "σ": "sigma",
    "χ": "chi",
    "π": "pi",
    "Δ": "delta",
}


def plain_ascii(text: str) -> str:
    r"""What to print for characters that a console lacks: plain ones of the same meaning, else their code, never `?`.

    >>> plain_ascii("0.405 ± 0.030 mm at 54°, Σ"), plain_ascii("é²")
    ('0.405 +- 0.030 mm at 54 deg, \\u03a3', 'e2')
    """
    return "".join(_plain(character) for character in text)


def _plain(character: str) -> str:
    if character in PLAIN or character.isascii():
        return PLAIN.get(character, character)
    bare = "".join(each for each in unicodedata.normalize("NFKD", character) if not unicodedata.combining(each))
    return bare if bare and bare.isascii() else character.encode("ascii", "backslashreplace").decode("ascii")


def _instead(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return plain_ascii(error.object[error.start : error.end]), error.end


def prepare() -> None:
    """Lets stdout and stderr take any text. Called once, before anything is printed."""
    codecs.register_error(ERRORS, _instead)
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, ValueError, OSError):
            stream.reconfigure(errors=ERRORS)  # type: ignore[union-attr]


@contextmanager
def answer(code: int = 0) -> Iterator[None]:
    """What is printed within is an answer whose exit code is fixed: the command ends with it, read or not."""
    with suppress(OSError, UnicodeError):
        yield
    settle()
    sys.exit(code)


def complain(text: str) -> None:
    """A line on stderr, if anybody reads it."""
    with suppress(OSError):
        # In one piece with its line break: nothing comes between.
        print(f"{text}\n", end="", file=sys.stderr, flush=True)


def settle() -> None:
    """Flushes; what nobody takes is thrown away, else the interpreter would fail over it once more at its end."""
    for stream in (sys.stdout, sys.stderr):
        if stream is None:
            continue
        try:
            stream.flush()
        except OSError:
            _discard(stream)
        except ValueError:  # closed by somebody else
            pass


def _discard(stream: TextIO) -> None:
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def is_terminal(stream: TextIO | None) -> bool:
    """Whether somebody looks at it; a stream that is not there is none."""
    with suppress(AttributeError, ValueError, OSError):
        return bool(stream is not None and stream.isatty())
    return False
