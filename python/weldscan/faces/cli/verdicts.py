"""The words that the commands share: a verdict's exit code and colour, what a session is."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from weldscan.faces.cli import boundary, terminal

# By the verdict's word: what a verdict is is imported when there is one.
EXIT_CODES = {
    "PASS": 0,
    "FAIL": 3,
    "INCONCLUSIVE": 4,
    "NOT MEASURED": boundary.NOT_MEASURED,
    "NOT ASSESSABLE": boundary.NOT_MEASURED,
}
EXITS = (
    "Exit code: 0 PASS, 3 FAIL, 4 INCONCLUSIVE, 5 NOT MEASURED or NOT ASSESSABLE, 2 bad input, 1 an error of weldscan."
)
COLOURS = {"PASS": 32, "FAIL": 31, "INCONCLUSIVE": 33}
# PASS of a part of the seam, and what was not measured or cannot be assessed.
PART_COLOUR, NO_COLOUR = 36, 35

SessionFolder = Annotated[
    Path, typer.Argument(metavar="SESSION", help="A folder with session.json and shots/ (weldscan-session/1).")
]


def coloured(words: str, colour: int) -> str:
    """The words in an ANSI colour where somebody looks at a terminal."""
    return f"\x1b[1;{colour}m{words}\x1b[0m" if terminal.is_terminal(sys.stdout) else words
