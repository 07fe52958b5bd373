"""How far a command is, on stderr: a bar on a terminal, JSON lines otherwise."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from weldscan.faces.cli import terminal

Progress = Callable[[int, int, str], None]
"""Called with (done, total, what)."""


@contextmanager
def shown_progress() -> Iterator[Progress]:
    """Shows how far it is: a bar on a terminal, JSON lines otherwise; on stderr in both cases."""
    if not terminal.is_terminal(sys.stderr):

        def tell(done: int, total: int, what: str) -> None:
            terminal.complain(json.dumps({"done": done, "of": total, "what": what}))

        yield tell
        return

    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description:34}"), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    with Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True), transient=True) as bars:
        bar = bars.add_task("", total=None)

        def show(done: int, total: int, what: str) -> None:
            bars.update(bar, completed=done, total=total, description=what)

        yield show
