"""`weldscan verify`: whether a scanner keeps its limits."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from weldscan.faces.cli import terminal
from weldscan.faces.cli.progress import shown_progress
from weldscan.faces.cli.verdicts import COLOURS, EXIT_CODES, EXITS, NO_COLOUR, SessionFolder, coloured

if TYPE_CHECKING:
    from weldscan.result import Verification


def register(app: typer.Typer) -> None:
    """Add `verify`."""
    app.command(
        epilog="Example: weldscan verify plate-and-plane --limits cell.toml --history verification.jsonl    "
        "limits.toml: pf_mm = 0.15, ps_mm = 0.05, sd_mm = 0.08, f_mm = 0.20, one a line; docs/formats.md has the rest."
        f"    {EXITS}"
    )(verify)


def verify(
    session: SessionFolder,
    limits: Annotated[
        Path | None,
        typer.Option(
            help="Maximum permissible errors in mm: limits.toml, or cell.toml with a section [verification]. Without "
            "any, everything is measured, nothing judged and nothing kept."
        ),
    ] = None,
    history: Annotated[
        Path | None,
        typer.Option(help="The file that the result is added to. Default: `history` of the limits; else none is kept."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Where verification.json and verification.html go. Default: SESSION's name + '-verification'."
        ),
    ] = None,
    date: Annotated[
        str | None, typer.Option(help="When the session was recorded, ISO 8601. Default: what its shots say, else now.")
    ] = None,
) -> None:
    """Accept or reverify a scanner: probing error, sphere spacing and flatness (VDI/VDE 2634-2, ISO 10360-13).

    SESSION has shots of the three-sphere plate, of a flat standard ("of": "plane"), or both, at many places of the
    volume. Each place gives PF, PS and SD, or F; the worst of each is judged against its limit.
    """
    from weldscan.records.files import whole_folder
    from weldscan.records.history import append_history, check_history
    from weldscan.records.verification import is_verification
    from weldscan.report.verification import write_verification
    from weldscan.result import Verdict
    from weldscan.verification import read_limits
    from weldscan.verification import verify as accept
    from weldscan.verification.history import with_drift

    permitted = None if limits is None else read_limits(limits)
    if history is None and permitted is not None and permitted.history is not None:
        history = Path(permitted.history)
    out = out if out is not None else Path(f"{session.resolve().name}-verification")
    whole_folder.check(out, is_verification)
    before = None if history is None else check_history(history)
    with shown_progress() as progress:
        found = accept(session, permitted, date=date, progress=progress)
        if before is not None:
            found = with_drift(found, before)
        write_verification(found, out)
    if history is not None and found.verdict is not Verdict.NOT_ASSESSABLE:
        append_history(history, found)
    with terminal.answer(EXIT_CODES[found.verdict]):
        _told(found, out, history)


def _told(found: Verification, out: Path, history: Path | None) -> None:
    """The verdict, a line per characteristic, what was lost, the drift, and where it all went."""
    from weldscan.result import Verdict

    word = coloured(found.verdict, COLOURS.get(found.verdict, NO_COLOUR))
    print(f"{word}   scanner {found.scanner}, {found.date}, valid until {found.valid_until}")
    for each in found.characteristics:
        value = "-" if each.value_mm is None else f"{each.value_mm:+.4f} mm at {each.where}"
        print(f"       {each.name:2}  {each.verdict:14} {value}, {each.positions} positions: {each.reason}")
    for shot, reason in found.lost:
        print(f"       lost {shot}: {reason}")
    for drift in found.drift:
        print(f"       drift of {drift.name}: {drift.text}")
    for note in (*found.assumed, *found.notes, *found.warnings):
        print(f"       note: {note}")
    if history is None:
        print("       history: none is kept; --history FILE adds this verification to one")
    else:
        judged = found.verdict is not Verdict.NOT_ASSESSABLE
        print(f"       history: {history}" if judged else f"       nothing was judged, so {history} was left as it is")
    print(f"       report: {out / 'verification.html'}")
