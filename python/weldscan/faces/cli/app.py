"""The command line, put together: every command in its own module.

Heavy imports happen inside the commands, so that `--help` and a typing error answer at once. What went well goes to
stdout; progress (a bar on a terminal, JSON lines otherwise) and complaints, each in one line, go to stderr. A verdict's
exit code is fixed before anything is printed: a console that lacks a character or a reader that left change nothing.
"""

from __future__ import annotations

from typing import Annotated

import typer

from weldscan._weldcore import __version__, set_threads
from weldscan.faces.cli import boundary, calibrate, inspect, station, validate, verify

app = typer.Typer(
    name="weldscan",
    help="Measures the edge displacement (hi-lo) of butt welds from structured-light scans, with U and a verdict.",
    epilog="Try it without any hardware: weldscan demo",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"weldscan {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Measures the edge displacement (hi-lo) of butt welds from structured-light scans, with U and a verdict."""
    # A number of threads that is none is said before anything is read.
    set_threads()


for commands in (inspect, validate, verify, calibrate, station):
    commands.register(app)


def main() -> None:
    """The commands behind the error boundary; `weldscan.__main__`, the program, imports them inside it, too."""
    boundary.run(app)
