"""The command line: `weldscan inspect`, `demo`, `validate`, `verify`; `calibrate` and the live cell bring theirs.

Heavy imports happen inside the commands, so that `--help` and a typing error answer at once. What went well goes to
stdout; progress (a bar on a terminal, JSON lines otherwise) and complaints, each in one line, go to stderr. A verdict's
exit code is fixed before anything is printed: a console that lacks a character or a reader that left change nothing.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from weldscan import boundary, terminal
from weldscan._weldcore import __version__, set_threads
from weldscan.calibration.cli import register as register_calibrations
from weldscan.errors import InputError
from weldscan.station.cli import register as register_cell

if TYPE_CHECKING:
    from weldscan.result import Inspection, StepResult, Verdict, Verification

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
DEFAULT_NORM = "pnae-g-7-010-89"
COLOURS = {"PASS": 32, "FAIL": 31, "INCONCLUSIVE": 33}
# PASS of a part of the seam, and what was not measured or cannot be assessed.
PART_COLOUR, NO_COLOUR = 36, 35
WHOLE_DEG = 360.0

Progress = Callable[[int, int, str], None]


class Method(StrEnum):
    """Which number is judged."""

    surface = "surface"
    paper = "paper"


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
SessionFolder = Annotated[
    Path, typer.Argument(metavar="SESSION", help="A folder with session.json and shots/ (weldscan-session/1).")
]


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


@app.command(
    epilog=f"Example: weldscan inspect pipe-17 --out pipe-17-report --norm {DEFAULT_NORM} --norm iso-5817:B    {EXITS}"
)
def inspect(
    session: SessionFolder,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Where the result goes: new, empty, or an earlier result. Default: SESSION's name + '-report'."
        ),
    ] = None,
    method: Annotated[
        Method, typer.Option(help="Which number is judged; both are reported. surface: the largest step at the seam.")
    ] = Method.surface,
    norm: Annotated[
        list[str] | None,
        typer.Option(help=f"Judge by this norm; may be given several times. Default: {DEFAULT_NORM}.", metavar="ID"),
    ] = None,
    history: Annotated[
        Path | None,
        typer.Option(
            help="Verifications of the scanner (weldscan verify): the last one must have passed and be valid. Default: "
            "the session's `verification`, or verification.jsonl in the session or beside it, if there is one."
        ),
    ] = None,
    accept_verification: Annotated[
        str | None,
        typer.Option(
            metavar="REASON",
            help="Judge although the scanner's verification failed or expired; the report states the reason.",
        ),
    ] = None,
    response: Annotated[
        str,
        typer.Option(
            help="The projector's response. auto: compensated as the fringes show it; off; or the file of "
            "'weldscan calibrate response', for patterns that were projected without it.",
            metavar="auto|off|FILE",
        ),
    ] = "auto",
    require_coverage: Annotated[
        str | None,
        typer.Option(
            metavar="DEG|whole",
            help="How much of the seam must be seen for a PASS; less is INCONCLUSIVE. Default: what the session says.",
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print result.json instead of the summary: one document on stdout.")
    ] = False,
) -> None:
    """Measure a recorded session and judge it: result.json, report.html, profile.csv, cloud.ply."""
    from weldscan.norms import load_norm
    from weldscan.records.files import whole_folder
    from weldscan.report import is_result

    norms = tuple(dict.fromkeys(norm or [DEFAULT_NORM]))
    for norm_id in norms:
        load_norm(norm_id)
    out = out if out is not None else Path(f"{session.resolve().name}-report")
    required = None if require_coverage is None else _coverage(require_coverage)
    whole_folder.check(out, is_result)
    found = _inspect_into(session, out, method, norms, response, history, accept_verification, required)
    with terminal.answer(EXIT_CODES[found.verdict]):
        if as_json:
            _document(out)
        else:
            _summary(found, out)


@app.command(epilog="Example: weldscan demo --out /tmp/weldscan-demo")
def demo(
    out: Annotated[Path, typer.Option(help="Where session and report go; an earlier demo is replaced.")] = Path(
        "weldscan-demo"
    ),
    live: Annotated[
        bool,
        typer.Option("--live", help="Scan it as a live cell: robot over a socket, camera, projector, shot by shot."),
    ] = False,
) -> None:
    """Simulate a cell (scanner, robot, three-sphere plate, welded pipe), record a session and inspect it."""
    from weldscan.devices.simulated import simulate_session
    from weldscan.records.files import whole_folder

    with whole_folder(out, _is_demo) as partial:
        with _progress() as progress:
            if live:
                from weldscan.station.live import record_live

                record_live(partial / "session", tell=progress)
                truth = None
            else:
                truth = simulate_session(partial / "session", progress=progress)
        found = _inspect_into(partial / "session", partial / "report", Method.surface, (DEFAULT_NORM,))
    with terminal.answer(EXIT_CODES[found.verdict]):
        _summary(found, out / "report")
        if truth is not None:
            true = truth["step_mm"]
            print(f"       truth: largest {true['max_abs']:.3f} mm, mean {true['mean']:.3f} mm")
        print(f"       the same again from its images: weldscan inspect {out / 'session'}")


@app.command(epilog="Example: weldscan validate pipe-17 --touch pipe-17/touch.csv --out pipe-17-touch")
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
    from weldscan.validation import validate as hold_against

    out = out if out is not None else Path(f"{session.resolve().name}-touch")
    whole_folder.check(out, is_validation)
    read_touch(touch)
    with _progress() as progress:
        found = hold_against(session, touch, progress)
        write_validation(found, out)
    with terminal.answer():
        print(
            f"{found.compared} of {len(found.points_mm)} probed points: rms {found.rms_mm:.3f} mm, "
            f"mean {found.mean_mm:+.3f} ± {found.mean_u_mm:.3f} mm (k = 2), largest {found.max_abs_mm:.3f} mm"
        )
        print(f"report: {out / 'validation.html'}")


@app.command(
    epilog="Example: weldscan verify plate-and-plane --limits cell.toml --history verification.jsonl    "
    "limits.toml: pf_mm = 0.15, ps_mm = 0.05, sd_mm = 0.08, f_mm = 0.20, one a line; docs/formats.md has the rest.    "
    f"{EXITS}"
)
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
    with _progress() as progress:
        found = accept(session, permitted, date=date, progress=progress)
        if before is not None:
            found = with_drift(found, before)
        write_verification(found, out)
    if history is not None and found.verdict is not Verdict.NOT_ASSESSABLE:
        append_history(history, found)
    with terminal.answer(EXIT_CODES[found.verdict]):
        _told(found, out, history)


# --- behind the commands ----------------------------------------------------------------------------------------------


def _inspect_into(
    session: Path,
    out: Path,
    method: Method,
    norms: tuple[str, ...],
    response: str = "auto",
    history: Path | None = None,
    accept: str | None = None,
    required_coverage_deg: float | None = None,
) -> Inspection:
    from weldscan.inspection import inspect as measure
    from weldscan.report import write_report

    with _progress() as progress:
        asked = {
            "history": history,
            "accept_verification": accept,
            "required_coverage_deg": required_coverage_deg,
        }
        given: dict[str, Any] = {name: value for name, value in asked.items() if value is not None}
        found: Inspection = measure(
            session, method=method.value, norms=norms, response=response, progress=progress, **given
        )
        progress(1, 1, "writing the report")
        write_report(found, out)
    return found


def _coverage(text: str) -> float:
    """What `--require-coverage` asks for, degrees."""
    try:
        degrees = WHOLE_DEG if text.strip().casefold() == "whole" else float(text)
    except ValueError:
        degrees = 0.0
    if not 0 < degrees <= WHOLE_DEG:
        raise typer.BadParameter(
            f"{text!r} is neither 'whole' nor degrees above 0, at most 360", param_hint="--require-coverage"
        )
    return degrees


def _coloured(words: str, colour: int) -> str:
    return f"\x1b[1;{colour}m{words}\x1b[0m" if terminal.is_terminal(sys.stdout) else words


def _document(out: Path) -> None:
    # Escapes for whatever is not ASCII: the document is the same on every console.
    print(json.dumps(json.loads((out / "result.json").read_text(encoding="utf-8")), indent=1))


def _summary(found: Inspection, out: Path) -> None:
    """A few lines: the verdict, what bars it, the value with its uncertainty, where, and the report's path."""
    from weldscan.report import judgement_text
    from weldscan.result import Severity, Verdict

    def words(verdict: Verdict) -> str:
        part = verdict is Verdict.PASS and not found.whole
        return _coloured(found.words(verdict), PART_COLOUR if part else COLOURS.get(verdict, NO_COLOUR))

    step, headline = found.step, found.headline
    print(f"{words(found.verdict)}   {judgement_text(headline) if headline else 'no norm was asked'}")
    for finding in found.bars:
        print(f"       {_coloured('bars PASS', COLOURS['FAIL'])}: {finding}")
    if step is not None:
        print(
            f"       largest step {step.max_abs_mm:.3f} ± {step.expanded_uncertainty_mm:.3f} mm (k = 2) "
            f"at {step.max_abs_at_deg:.0f}°{_others(step)}"
        )
    if found.coverage is not None:
        gaps = ", ".join(f"{start:.0f}° to {end:.0f}°" for start, end in found.coverage.gaps)
        print(
            f"       seam: {found.coverage.seen_deg:.0f}° seen, {found.coverage.required_deg:.0f}° required "
            f"({found.coverage.required_by}){f'; not seen: {gaps}' if gaps else ''}"
        )
    for judgement in found.verdicts:
        if judgement is not headline:
            print(f"       {words(judgement.verdict)} by {judgement_text(judgement)}")
    if found.calibration != "stated":
        print(f"       scanner's calibration: {found.calibration}, U leaves it out")
    if found.verification is not None:
        print(f"       scanner: {found.verification.statement}")
    for shot, reason in found.left_out:
        print(f"       left out {shot}: {reason}")
    for each in found.findings:
        if each.severity is not Severity.BAR and each.code != "verification":
            print(f"       {each.severity}: {each.text}")
    print(f"       report: {out / 'report.html'}")


def _others(step: StepResult) -> str:
    """The mean and the paper's number, each with its U, where they have one."""
    said = ""
    if step.seam_mean_mm is not None and step.seam_mean_u_mm is not None:
        said += f", mean {step.seam_mean_mm:.3f} ± {step.seam_mean_u_mm:.3f} mm"
    histogram = step.histogram
    if histogram is not None and histogram.expanded_uncertainty_mm is not None:
        said += f", paper's histogram {histogram.step_mm:.3f} ± {histogram.expanded_uncertainty_mm:.3f} mm"
    return said


def _told(found: Verification, out: Path, history: Path | None) -> None:
    """The verdict, a line per characteristic, what was lost, the drift, and where it all went."""
    from weldscan.result import Verdict

    word = _coloured(found.verdict, COLOURS.get(found.verdict, NO_COLOUR))
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


def _is_demo(folder: Path) -> bool:
    """Whether a folder is an earlier demo and holds nothing else."""
    from weldscan.report import is_result

    names = {entry.name for entry in folder.iterdir()}
    if not names or not names <= {"session", "report"}:
        return False
    files = {entry.name for entry in (folder / "session").iterdir()} if "session" in names else {"session.json"}
    known = {"session.json", "shots", "truth.json", "touch.csv", "plan.json", "scan.log", ".scan.lock"}
    return "session.json" in files and files <= known and ("report" not in names or is_result(folder / "report"))


@contextmanager
def _progress() -> Iterator[Progress]:
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


def _capture_board(config: Path, folder: Path, board: str | None, progress: Progress) -> None:
    """What `calibrate scanner --live` does before it calibrates."""
    from weldscan.station.board import capture_board
    from weldscan.station.cell import read_cell

    def ask(what: str) -> None:
        print(f"{what}, then press Enter.", file=sys.stderr, flush=True)
        if not sys.stdin.readline():
            raise InputError("--live: nobody is there to press Enter")

    capture_board(read_cell(config), folder, board, progress, ask)


register_calibrations(app, _progress, _capture_board)
register_cell(app, _progress)


def main() -> None:
    """The commands behind the error boundary; `weldscan.__main__`, the program, imports them inside it, too."""
    boundary.run(app)
