"""`weldscan validate`: the scanned surface against points that a contact probe read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from weldscan.faces.cli import terminal
from weldscan.faces.cli.progress import shown_progress
from weldscan.faces.cli.verdicts import SessionFolder


def register(app: typer.Typer) -> None:
    """Add `validate`."""
    app.command(epilog="Example: weldscan validate pipe-17 --touch pipe-17/touch.csv --out pipe-17-touch")(validate)


def validate(
    session: SessionFolder,
    touch: Annotated[Path, typer.Option(help="Points that a contact probe read on the part: x_mm,y_mm,z_mm in base.")],
    out: Annotated[
        Path | None,
        typer.Option(help="Where validation.json and validation.html go. Default: SESSION's name + '-touch'."),
    ] = None,
) -> None:
    """Hold the scanned surface against points probed on the part: the signed distance of each, with its uncertainty."""
    from weldscan.records.files import whole_folder
    from weldscan.records.touch import read_touch
    from weldscan.records.validation import is_validation
    from weldscan.report.validation import write_validation
    from weldscan.verification.validation import validate as hold_against

    out = out if out is not None else Path(f"{session.resolve().name}-touch")
    whole_folder.check(out, is_validation)
    read_touch(touch)
    with shown_progress() as progress:
        found = hold_against(session, touch, progress)
        write_validation(found, out)
    with terminal.answer():
        print(
            f"{found.compared} of {len(found.points_mm)} probed points: rms {found.rms_mm:.3f} mm, "
            f"mean {found.mean_mm:+.3f} ± {found.mean_u_mm:.3f} mm (k = 2), largest {found.max_abs_mm:.3f} mm"
        )
        print(f"report: {out / 'validation.html'}")
