"""`weldscan calibrate ...`: the calibrations that are kept and used again. `register` adds them to the command line.

As in `weldscan.cli`, heavy imports happen inside the commands.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Annotated

import typer

Tell = Callable[[int, int, str], None]
Progress = Callable[[], AbstractContextManager[Tell]]

calibrate = typer.Typer(
    help="Calibrations that are kept and used again.", no_args_is_help=True, rich_markup_mode=None, add_completion=False
)


@contextmanager
def _silent() -> Iterator[Tell]:
    yield lambda done, of, what: None


_progress: Progress = _silent


def register(app: typer.Typer, progress: Progress = _silent) -> None:
    """Add `calibrate`; `progress` gives what shows how far a calibration is."""
    global _progress  # noqa: PLW0603 - set once, when the command line is put together
    _progress = progress
    app.add_typer(calibrate, name="calibrate")


@calibrate.command("hand-eye", epilog="Example: weldscan calibrate hand-eye plate-shots --out hand-eye.json")
def hand_eye(
    session: Annotated[
        Path, typer.Argument(metavar="SESSION", help="A folder with session.json and shots/ (weldscan-session/1).")
    ],
    out: Annotated[Path, typer.Option(help="The file to write; an earlier hand-eye calibration is replaced.")] = Path(
        "hand-eye.json"
    ),
) -> None:
    """Find where the scanner sits on the robot's flange, from shots of the three-sphere plate, and keep it."""
    from weldscan.calibration.hand_eye import calibrate as solve
    from weldscan.session import write_hand_eye

    with _progress() as progress:
        found = solve(session, progress)
    write_hand_eye(out, found)
    print(
        f"hand-eye {found.id} from {len(found.per_shot)} shots: residual {found.residual_rms_mm:.3f} mm rms, "
        f"u of a point at the working distance {found.working_point_u_mm:.3f} mm"
    )
    print(f'         kept in {out}; a session carries it as "hand_eye": "{out.name}"')
