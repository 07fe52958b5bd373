"""`weldscan inspect` and `weldscan demo`: a session measured and judged, and a simulated one."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from weldscan.faces.cli import terminal
from weldscan.faces.cli.progress import shown_progress
from weldscan.faces.cli.verdicts import COLOURS, EXIT_CODES, EXITS, NO_COLOUR, PART_COLOUR, SessionFolder, coloured

if TYPE_CHECKING:
    from weldscan.result import Inspection, StepResult, Verdict

DEFAULT_NORM = "pnae-g-7-010-89"
WHOLE_DEG = 360.0


class Method(StrEnum):
    """Which number is judged."""

    surface = "surface"
    paper = "paper"


class Cloud(StrEnum):
    """Which points are kept."""

    cells = "cells"
    all = "all"


def register(app: typer.Typer) -> None:
    """Add `inspect` and `demo`."""
    app.command(
        epilog=f"Example: weldscan inspect pipe-17 --out pipe-17-report --norm {DEFAULT_NORM} --norm iso-5817:B    "
        f"{EXITS}"
    )(inspect)
    app.command(epilog="Example: weldscan demo --out /tmp/weldscan-demo")(demo)


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
    cloud: Annotated[
        Cloud,
        typer.Option(
            help="What cloud.ply holds. cells: of more than 4 million points one of every cell of 0.15 mm; all: every "
            "point."
        ),
    ] = Cloud.cells,
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
    found = _inspect_into(
        session,
        out,
        method=method.value,
        norms=norms,
        response=response,
        history=history,
        accept_verification=accept_verification,
        required_coverage_deg=required,
        cloud=None if cloud is Cloud.cells else cloud.value,
    )
    with terminal.answer(EXIT_CODES[found.verdict]):
        if as_json:
            _document(out)
        else:
            _summary(found, out)


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
    from weldscan.records.files import whole_folder
    from weldscan.simulated import simulate_session

    with whole_folder(out, _is_demo) as partial:
        with shown_progress() as progress:
            if live:
                from weldscan.faces.live_demo import record_live

                record_live(partial / "session", tell=progress)
                truth = None
            else:
                truth = simulate_session(partial / "session", progress=progress)
        found = _inspect_into(partial / "session", partial / "report", norms=(DEFAULT_NORM,))
    with terminal.answer(EXIT_CODES[found.verdict]):
        _summary(found, out / "report")
        if truth is not None:
            true = truth["step_mm"]
            print(f"       truth: largest {true['max_abs']:.3f} mm, mean {true['mean']:.3f} mm")
        print(f"       the same again from its images: weldscan inspect {out / 'session'}")


# --- behind the commands ----------------------------------------------------------------------------------------------


def _inspect_into(session: Path, out: Path, **asked: Any) -> Inspection:
    """Measures, as `weldscan.inspect` is asked to, and writes the report."""
    from weldscan.measure.inspection import inspect as measure
    from weldscan.report import write_report

    # What was not asked for is left at its default.
    given = {name: value for name, value in asked.items() if value is not None}
    with shown_progress() as progress:
        found: Inspection = measure(session, progress=progress, **given)
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


def _document(out: Path) -> None:
    # Escapes for whatever is not ASCII: the document is the same on every console.
    print(json.dumps(json.loads((out / "result.json").read_text(encoding="utf-8")), indent=1))


def _summary(found: Inspection, out: Path) -> None:
    """A few lines: the verdict, what bars it, the value with its uncertainty, where, and the report's path."""
    from weldscan.report import judgement_text
    from weldscan.result import Severity, Verdict

    def words(verdict: Verdict) -> str:
        part = verdict is Verdict.PASS and not found.whole
        return coloured(found.words(verdict), PART_COLOUR if part else COLOURS.get(verdict, NO_COLOUR))

    step, headline = found.step, found.headline
    print(f"{words(found.verdict)}   {judgement_text(headline) if headline else 'no norm was asked'}")
    for finding in found.bars:
        print(f"       {coloured('bars PASS', COLOURS['FAIL'])}: {finding}")
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


def _is_demo(folder: Path) -> bool:
    """Whether a folder is an earlier demo and holds nothing else."""
    from weldscan.report import is_result

    names = {entry.name for entry in folder.iterdir()}
    if not names or not names <= {"session", "report"}:
        return False
    files = {entry.name for entry in (folder / "session").iterdir()} if "session" in names else {"session.json"}
    known = {"session.json", "shots", "truth.json", "touch.csv", "plan.json", "scan.log", ".scan.lock"}
    return "session.json" in files and files <= known and ("report" not in names or is_result(folder / "report"))
