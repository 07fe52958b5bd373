"""`weldscan calibrate ...`: the calibrations that are kept and used again. `register` adds them to the command line.

As in `weldscan.faces.cli.app`, heavy imports happen inside the commands.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from weldscan.errors import InputError
from weldscan.faces.cli import terminal
from weldscan.faces.cli.progress import Progress, shown_progress

if TYPE_CHECKING:
    from weldscan.calibration.plan import Plan
    from weldscan.records.response import Response
    from weldscan.result import HandEye, ScannerCalibration

calibrate = typer.Typer(
    help="Calibrations that are kept and used again.", no_args_is_help=True, rich_markup_mode=None, add_completion=False
)


def register(app: typer.Typer) -> None:
    """Add `calibrate`."""
    app.add_typer(calibrate, name="calibrate")


@calibrate.command("hand-eye", epilog="Example: weldscan calibrate hand-eye plate-shots --out hand-eye.json")
def hand_eye(
    session: Annotated[
        Path, typer.Argument(metavar="SESSION", help="A folder with session.json and shots/ (weldscan-session/1).")
    ],
    out: Annotated[Path, typer.Option(help="The file to write; an earlier hand-eye calibration is replaced.")] = Path(
        "hand-eye.json"
    ),
    page: Annotated[
        Path | None, typer.Option(help="The page with residuals by shot and sphere. Default: beside --out, .html.")
    ] = None,
) -> None:
    """Find where the scanner sits on the robot's flange, from shots of the three-sphere plate, and keep it.

    One shot suffices where the spheres' centres were touched with the robot, 10 to 15 tilted to all sides are good
    (weldscan calibrate plan proposes them); centres that nobody touched need 5. Shots that contradict the others
    are named and not used.
    """
    from weldscan.measure.session_hand_eye import calibrate as solve
    from weldscan.records.files import check_file
    from weldscan.records.hand_eye import write_hand_eye
    from weldscan.report.hand_eye import write_hand_eye_page
    from weldscan.report.page import check_page

    page = page if page is not None else out.with_suffix(".html")
    check_file(out)
    check_page(page)
    with shown_progress() as progress:
        found, noticed = solve(session, progress)
    write_hand_eye(out, found)
    write_hand_eye_page(found, page, session.resolve().name)
    with terminal.answer():
        _show_hand_eye(found, noticed.left_out)
        print(f'         kept in {out}; a session carries it as "hand_eye": "{out.name}"')
        print(f"         page: {page}")


@calibrate.command(
    "plan", epilog="Example: weldscan calibrate plan pipe-17 --mount '58 -24 112 109 -20 -8' --out hand-eye-plan.json"
)
def plan(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE",
            help="Scanner, fringes and touched plate: a session's folder, its session.json, or an earlier plan.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="The plan to write; an earlier plan is replaced.")] = Path(
        "hand-eye-plan.json"
    ),
    page: Annotated[
        Path | None, typer.Option(help="The page with table and pictures. Default: beside --out, .html.")
    ] = None,
    shots: Annotated[int, typer.Option(help="How many poses; 10 to 15 are good.")] = 12,
    mount: Annotated[
        str | None,
        typer.Option(help="Roughly where the scanner sits on the flange: X Y Z A B C, mm and degrees.", metavar="POSE"),
    ] = None,
    hand_eye: Annotated[
        Path | None, typer.Option("--hand-eye", help="Or an earlier hand-eye calibration. Default: SOURCE's.")
    ] = None,
    distance: Annotated[float, typer.Option(help="Working distance of the camera, mm.")] = 420.0,
    depth: Annotated[float, typer.Option(help="Half the depth of the working volume, mm.")] = 40.0,
    reach: Annotated[
        tuple[float, float], typer.Option(help="Least and most distance of the flange from base's origin, mm.")
    ] = (250.0, 1100.0),
    lowest: Annotated[float, typer.Option(help="Least height of the flange in base, mm.")] = 0.0,
    cone: Annotated[float, typer.Option(help="How far the flange may turn from straight down, degrees.")] = 180.0,
) -> None:
    """Propose flange poses for a hand-eye calibration, and say how good it will be.

    Poses tilted by 30 to 45 degrees to all sides of the plate, rolled, near and far: of all that robot and scanner
    allow, those after which a point at the working distance is known best. The plan is a session without images:
    [scan] plan = "..." in cell.toml, weldscan scan, weldscan calibrate hand-eye.
    """
    import numpy as np

    from weldscan.calibration import plan as planning
    from weldscan.errors import InputError
    from weldscan.measure.session_hand_eye import mounted
    from weldscan.records.hand_eye import read_hand_eye
    from weldscan.records.plan import check_plan, read_source, write_plan
    from weldscan.report.page import check_page
    from weldscan.report.plan import write_plan_page

    page = page if page is not None else out.with_suffix(".html")
    check_page(page)
    check_plan(out)
    if mount is not None and hand_eye is not None:
        raise InputError("--mount and --hand-eye: only one of them")
    given = read_source(source)
    with shown_progress() as progress:
        progress(0, 2, "where the scanner sits")
        if mount is not None:
            where = planning.mount_of(mount)
        elif hand_eye is not None:
            where = np.array(read_hand_eye(hand_eye).flange_from_scanner)
        else:
            where = mounted(given, source)
        progress(1, 2, "choosing poses")
        found = planning.plan_poses(
            given.scanner.build(),
            where,
            np.array(given.artefact.centres_base),
            given.artefact.sphere_diameter,
            shots=shots,
            limits=planning.Limits(distance, depth, reach, lowest, cone),
            noise=planning.noise_of(given),
        )
    write_plan(out, planning.document(given, found))
    write_plan_page(found, page, given.name)
    with terminal.answer():
        _show_plan(found)
        print(f'plan: {out}; [scan] plan = "{out.name}" in cell.toml, then weldscan scan, weldscan calibrate hand-eye')
        print(f"page: {page}")


def _show_plan(found: Plan) -> None:
    """The poses, and what they give."""
    import math

    print(f"{len(found.shots)} poses of {found.possible} possible ones ({found.candidates} tried)")
    print("         shot              X         Y         Z         A         B         C   tilt side  roll  mm away")
    for i, shot in enumerate(found.shots):
        numbers = "".join(f"{value:10.3f}" for value in shot.pose.values())
        print(
            f"         artefact-{i + 1:<3}{numbers} {shot.tilt_deg:6.1f}° {shot.around_deg:3.0f}° "
            f"{shot.roll_deg:4.0f}° {shot.distance_mm:6.0f}"
        )
    stated = found.noise
    print(
        f"predicted u of a point at {found.limits.distance_mm:g} mm: {found.u_mm[-1]:.3f} mm (k = 1, worst axis) with "
        f"poses good to {stated.pose_mm:g} mm and {math.degrees(stated.pose_rad):.4f}°, touches to {stated.touch_mm:g} "
        f"mm; {found.u_untouched_mm:.3f} mm from the shots alone"
    )
    print(f"turned against each other by {found.tilts_deg[0]:.0f}° and, about a second axis, {found.tilts_deg[1]:.0f}°")
    for reason, count in found.dropped.items():
        print(f"         {count} poses dropped: {reason}")


def _show_hand_eye(found: HandEye, left_out: Sequence[tuple[str, str]]) -> None:
    """The figures of a hand-eye calibration, shot by shot."""
    import math

    used = sum(shot.outlier is None for shot in found.per_shot)
    print(
        f"hand-eye {found.id} from {used} shots: residual {found.residual_rms_mm:.3f} mm rms, "
        f"u of a point at the working distance {found.working_point_u_mm:.3f} mm"
    )
    print("         shot             residuals of spheres 1 2 3, mm   without it, mm   chi2 of 9")
    for shot in found.per_shot:
        sizes = "  ".join(f"{sphere.residual_mm or 0.0:.3f}" for sphere in shot.spheres)
        alone = "-" if shot.left_out_error_mm is None else f"{shot.left_out_error_mm:.3f}"
        chi2 = "-" if shot.chi2 is None else f"{shot.chi2:.1f}"
        mark = "" if shot.outlier is None else "   not used"
        print(f"         {shot.shot:16} {sizes:>31} {alone:>16} {chi2:>11}{mark}")
    if found.pose_sigma_mm is not None and found.pose_sigma_rad is not None and found.reduced_chi2 is not None:
        print(
            f"         robot pose {found.pose_sigma_mm:.3f} mm, "
            f"{math.degrees(found.pose_sigma_rad):.4f} degrees (k = 1); "
            f"reduced chi2 under the stated noise {found.reduced_chi2:.2f}"
        )
    for name, reason in left_out:
        print(f"         left out {name}: {reason}")
    for warning in found.warnings:
        print(f"         note: {warning}")


@calibrate.command(
    "scanner",
    epilog="Example: weldscan calibrate scanner board-shots --board chessboard:9x13:10mm --out scanner.json",
)
def scanner(
    folder: Annotated[
        Path,
        typer.Argument(help="Captures of a board under fringes along both axes: calibration.json and shots/ (docs)."),
    ],
    board: Annotated[
        str | None,
        typer.Option(
            help="chessboard:COLSxROWS:SQUAREmm (inner corners), charuco:COLSxROWS:SQUAREmm:MARKERmm (squares), "
            "circles:COLSxROWS:PITCHmm:DIAMETERmm. Default: what calibration.json says."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="The file to write; an earlier calibration is replaced.")] = Path(
        "scanner.json"
    ),
    k3: Annotated[bool, typer.Option("--k3", help="Solve for the third radial term of both lenses.")] = False,
    flat: Annotated[bool, typer.Option("--flat", help="Take the board as exactly as drawn.")] = False,
    temperature: Annotated[float | None, typer.Option(help="Of the scanner, °C, for the record.")] = None,
    valid_days: Annotated[int, typer.Option(min=1, help="After how many days it is out of date.")] = 365,
    live: Annotated[
        bool, typer.Option("--live", help="Capture first, by the cell's devices; FOLDER must be new or empty.")
    ] = False,
    config: Annotated[Path, typer.Option(help="With --live: the cell's configuration.")] = Path("cell.toml"),
) -> None:
    """Calibrate camera and projector against a flat board, say how good it is, and which pose of the board to add.

    At least three poses, better ten to fifteen: tilted by 30 to 45 degrees to all sides, turned, near and far, so that
    the board fills the whole image in turn.
    """
    from weldscan.calibration.board import parse_board
    from weldscan.calibration.scanner import calibrate_scanner
    from weldscan.records.files import check_file
    from weldscan.records.scanner import read_scanner, write_scanner
    from weldscan.report.page import check_page
    from weldscan.report.scanner import write_scanner_page

    page = out.with_suffix(".html")
    check_file(out)
    if out.exists():
        read_scanner(out)
    check_page(page)
    if board is not None:
        parse_board(board)
    with shown_progress() as progress:
        if live:
            _capture_board(config, folder, board, progress)
        found = calibrate_scanner(
            folder,
            board,
            k3=k3,
            board_shape=False if flat else None,
            temperature_c=temperature,
            valid_days=valid_days,
            progress=progress,
        )
    write_scanner(out, found)
    write_scanner_page(found, page)
    with terminal.answer():
        _say(found, out, page)


def _capture_board(config: Path, folder: Path, board: str | None, progress: Progress) -> None:
    """What `calibrate scanner --live` does before it calibrates."""
    from weldscan.station.board import capture_board
    from weldscan.station.cell import read_cell

    def ask(what: str) -> None:
        print(f"{what}, then press Enter.", file=sys.stderr, flush=True)
        if not sys.stdin.readline():
            raise InputError("--live: nobody is there to press Enter")

    capture_board(read_cell(config), folder, board, progress, ask)


def _say(found: ScannerCalibration, out: Path, page: Path) -> None:
    """A few lines: how good it is, what is missing, where it was kept."""
    camera, projector, both = found.rms_px
    print(
        f"scanner {found.id} from {len(found.poses)} poses: rms {camera:.3f} px camera, {projector:.3f} projector, "
        f"{both:.3f} both; baseline {found.baseline_mm:.2f} mm"
    )
    middle = found.volume[0]
    worst = max(found.volume, key=lambda p: float(p.shape_u_mm @ p.shape_u_mm))
    size = [float((p.shape_u_mm @ p.shape_u_mm) ** 0.5) for p in (middle, worst)]
    print(
        f"        u of a point (k = 1, shape of the volume): {size[0]:.3f} mm in the middle, "
        f"{size[1]:.3f} mm {worst.name}"
    )
    weld = found.weld
    if weld.u_mm < float("inf"):
        print(
            f"        u of the step of a pipe of 219 mm at {weld.distance_mm:.0f} mm (k = 1, the calibration's part, "
            f"propagated): {weld.u_mm:.3f} mm; {weld.inside:.0%} of its walls lie where the boards were"
        )
    if found.jackknife_ratio is not None:
        print(
            f"        leaving out poses: {found.jackknife_ratio:.2f} of what noise explains"
            + ("; every uncertainty was scaled by it" if found.jackknife_ratio > 1 else "")
        )
    for name, reason in found.left_out:
        print(f"        left out {name}: {reason}")
    for warning in found.warnings:
        print(f"WARNING {warning}")
    if found.next_pose is not None:
        add = found.next_pose
        x, y, z = add.point_mm
        print(
            f"        add next: the board's middle at ({x:.0f}, {y:.0f}, {z:.0f}) mm, tilted by {add.tilt_deg:.0f}° "
            f"towards {add.around_deg:.0f}°: {add.lowers} from {add.from_value:.3g} to {add.to_value:.3g}"
        )
    print(f"        page: {page}")
    print(f'        kept in {out}; a session carries it as "scanner": "{out.name}"')


@calibrate.command(
    "response",
    epilog="Example: weldscan calibrate response fringes --fringes 1x12,8x12,64x12 --out response.json",
)
def response(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER|SESSION",
            help="A session; a folder of fringe images (with --fringes), numbered in the order of the sets and then of "
            "the steps; or a ramp: even images whose names end in the level that they show.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="The file to write; an earlier response is replaced.")] = Path(
        "response.json"
    ),
    fringes: Annotated[
        str | None,
        typer.Option(
            metavar="PxN,PxN...", help="Of the images in FOLDER: periods over the projector x steps, per set."
        ),
    ] = None,
    shot: Annotated[str | None, typer.Option(help="Of the session. Default: the best of the first three.")] = None,
) -> None:
    """Find how the projector's light follows its level (gamma), and keep it as a table.

    'project' and 'scan' show patterns corrected by it ([projector] response = "response.json" in the cell's
    configuration); 'inspect --response response.json' compensates fringes that were recorded without it. By itself,
    'inspect' compensates what the fringes show. Four or more steps, better eight or twelve, show the harmonics of the
    light; three show only what they do to the phase.
    """
    from weldscan.calibration.response import parse_fringes, response_of_folder
    from weldscan.records.files import check_file, write_file
    from weldscan.records.response import write_response
    from weldscan.report.response import response_svg

    sets = None if fringes is None else parse_fringes(fringes)
    check_file(out)
    with shown_progress() as progress:
        progress(0, 1, f"reading {folder}")
        found = response_of_folder(folder, sets, shot=shot)
    write_response(out, found)
    picture = out.with_suffix(".svg")
    write_file(picture, response_svg(found))
    with terminal.answer():
        _show_response(found, out, picture)


def _show_response(found: Response, out: Path, picture: Path) -> None:
    """How far from proportional the light is, and what that does to a phase."""
    seen = {"ramp": "even images", "harmonics": "the fringes' harmonics", "phase": "the error of the fringes' phase"}
    print(f"response {found.document()['id']} from {seen[found.method]}: like a gamma of {found.gamma:.3f}")
    for entry in found.fringes:
        if entry.harmonics:
            worst = max(abs(c) for c in found.phase_error(3, entry.periods))
            print(
                f"         {entry.periods:g} fringes, {entry.steps} steps: second harmonic "
                f"{100 * entry.harmonics[0]:+.1f} % "
                f"of the fundamental; three steps would be off by {worst:.3f} rad"
            )
        else:
            limit = f", known to {entry.standard_rad[0]:.4f} rad" if entry.standard_rad else ""
            print(f"         {entry.periods:g} fringes, {entry.steps} steps: no error above the noise{limit}")
    if not found.fringes:
        print(f"         three steps would be off by {max(abs(c) for c in found.phase_error(3)):.3f} rad")
    print(f'         kept in {out}, drawn in {picture}; [projector] response = "{out.name}" corrects patterns for it')
