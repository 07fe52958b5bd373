"""The commands of the live cell: robot, camera, project, devices, scan. `register` adds them to the command line.

As in `weldscan.faces.cli.app`, heavy imports happen inside the commands.
"""

from __future__ import annotations

import contextlib
import json
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from weldscan.devices import BACKENDS, backend
from weldscan.errors import DeviceError, InputError
from weldscan.faces.cli import terminal
from weldscan.faces.cli.boundary import NOT_MEASURED
from weldscan.faces.cli.progress import shown_progress

if TYPE_CHECKING:
    from weldscan.devices.robots import Robot, StampedPose
    from weldscan.pose import KukaPose
    from weldscan.records.session import ShotSpec
    from weldscan.simulated.controllers import Arm, Controller


def _group(about: str) -> typer.Typer:
    return typer.Typer(help=about, no_args_is_help=True, rich_markup_mode=None, add_completion=False)


robot_app = _group("Where the flange is, and - where allowed - where it shall go.")
camera_app = _group("Which cameras there are, and what they see.")
devices_app = _group("Camera and projector together.")

Config = Annotated[Path, typer.Option("--config", help="The cell's configuration.")]
CELL = Path("cell.toml")
DAY_S = 86_400.0
MOST_FAULTS = 1_000_000
MODES = ("#T1", "#T2", "#AUT", "#EX")


def register(app: typer.Typer) -> None:
    """Add the commands of the live cell."""
    app.add_typer(robot_app, name="robot")
    app.add_typer(camera_app, name="camera")
    app.add_typer(devices_app, name="devices")
    app.command()(project)
    app.command(epilog="Example: weldscan scan --config cell.toml --out pipe-17")(scan)


@robot_app.command("pose")
def robot_pose(config: Config = CELL) -> None:
    """Print the flange in base, once."""
    with _robot(config) as robot:
        _show(robot.pose(), sys.stdout.isatty())


@robot_app.command("watch")
def robot_watch(
    config: Config = CELL,
    every_s: Annotated[float, typer.Option("--every", min=0.0, max=DAY_S, help="Seconds between readings.")] = 0.2,
    count: Annotated[int, typer.Option(min=0, help="How many; 0: until Ctrl-C.")] = 0,
) -> None:
    """Print the flange in base again and again."""
    with _robot(config) as robot:
        done = 0
        try:
            while count == 0 or done < count:
                _show(robot.pose(), sys.stdout.isatty())
                done += 1
                time.sleep(every_s)
        except KeyboardInterrupt:
            pass


@robot_app.command("move", context_settings={"ignore_unknown_options": True})
def robot_move(
    target: Annotated[list[str], typer.Argument(metavar="X Y Z A B C", help="mm and degrees")],
    config: Config = CELL,
) -> None:
    """Move the flange to a pose in base. Off unless the configuration allows it and the controller says T1."""
    pose = _pose(target)
    with _robot(config) as robot:
        _show(robot.move_to(pose), sys.stdout.isatty())


@robot_app.command("simulate")
def robot_simulate(
    link: Annotated[str, typer.Option(help=f"One of {', '.join(BACKENDS['controller'])}.")] = "kvp",
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=65535,
            help="0: a free one. Default: 7000, 54600 or 64000, as the link has it; if taken, a free one.",
        ),
    ] = None,
    pose: Annotated[str, typer.Option(help="The flange: X Y Z A B C, mm and degrees.")] = "",
    speed: Annotated[float, typer.Option(min=0.1, max=12_000.0, help="mm/s")] = 250.0,
    mode: Annotated[str, typer.Option(help="Operating mode: T1, T2, AUT or EX.")] = "T1",
    fault: Annotated[list[str] | None, typer.Option(help="FAULT or FAULT:COUNT for the next replies.")] = None,
) -> None:
    """Be a controller, until Ctrl-C. A line `FAULT [COUNT]` on standard input spoils the next replies.

    It prints one JSON line that says where it listens; with rsi it sends to that port instead. Faults: silence, bytes,
    twice, wrong-id, wrong-length, empty, garbage, huge, dtd, entity, reset, restart, nan, jump, stale.
    """
    if link not in BACKENDS["controller"]:
        raise InputError(f"--link: {link!r} is none of {', '.join(BACKENDS['controller'])}")
    if f"#{mode.upper()}" not in MODES:
        raise InputError(f"--mode: {mode!r} is none of {', '.join(known.removeprefix('#') for known in MODES)}")
    from weldscan.simulated.controllers import HOME, Arm

    arm = Arm(_pose(pose.split()) if pose else HOME, mode=f"#{mode.upper()}")
    arm.speed_mm_s = speed
    with _controller(link, arm, host, port) as controller:
        for request in fault or []:
            _inject(controller, request.replace(":", " "))
        where = {} if link == "serial" else {"host": host}
        with contextlib.suppress(KeyboardInterrupt):
            print(json.dumps({"link": link, **where, "port": controller.port}), flush=True)
            threading.Thread(target=_obey_lines, args=(controller,), daemon=True).start()
            threading.Event().wait()


@camera_app.command("list")
def camera_list() -> None:
    """List the cameras that each backend sees."""
    for name in BACKENDS["camera"]:
        try:
            found = backend("camera", name).available()
        except DeviceError as error:
            print(f"{name:10} {error}")
        else:
            print(f"{name:10} {', '.join(found) or '-'}")


@camera_app.command("preview")
def camera_preview(
    config: Config = CELL,
    out: Annotated[Path, typer.Option(help="The picture: saturated pixels red, dark ones blue.")] = Path("preview.png"),
    count: Annotated[int, typer.Option(min=0, help="How many frames; 0: until Ctrl-C.")] = 0,
) -> None:
    """Look through the camera: a picture that is written again and again, and the shares of useless pixels."""
    from weldscan.records.files import check_file, write_file
    from weldscan.records.images import encode_png
    from weldscan.station.cell import read_cell
    from weldscan.station.check import LEAST_CONTRAST, overlay

    done = 0
    check_file(out)
    with read_cell(config).open("camera") as camera, contextlib.suppress(KeyboardInterrupt):
        while count == 0 or done < count:
            frame = camera.capture()
            top = frame.full_scale
            write_file(out, encode_png(overlay(frame)))
            saturated, dark = (frame.image >= top).mean(), (frame.image <= LEAST_CONTRAST * top).mean()
            print(
                f"{frame.image.shape[1]}x{frame.image.shape[0]}, {camera.exposure_s * 1000:g} ms: "
                f"saturated {saturated:.2%}, dark {dark:.2%}",
                flush=True,
            )
            done += 1


def project(
    config: Config = CELL,
    pattern: Annotated[str, typer.Option(help="white, black, a grey level, or all: the plan's fringes.")] = "white",
    hold: Annotated[float, typer.Option(min=0.0, max=DAY_S, help="Seconds for each pattern; 0: until Ctrl-C.")] = 0.0,
) -> None:
    """Show a pattern on the projector. On which display: x and y of the cell's [projector]."""
    from weldscan.devices.projectors.patterns import flat_pattern, fringe_patterns
    from weldscan.station.cell import read_cell
    from weldscan.station.scan import read_settings

    cell = read_cell(config)
    with cell.open("projector") as projector, contextlib.suppress(KeyboardInterrupt):
        size = projector.settings.width, projector.settings.height
        levels = {"white": 255, "black": 0, **{str(level): level for level in range(256)}}
        if pattern == "all":
            _, plan = read_settings(cell)
            patterns = list(fringe_patterns([f.pattern for f in plan.fringes], *size))
        elif pattern in levels:
            patterns = [flat_pattern(levels[pattern], *size)]
        else:
            raise InputError(f"--pattern: {pattern!r} is not white, black, all or a level from 0 to 255")
        for image in patterns:
            projector.show(image)
            time.sleep(hold if hold > 0 else DAY_S)


@devices_app.command("check")
def devices_check(
    config: Config = CELL,
    out: Annotated[
        Path | None,
        typer.Option(help="Where the response table goes. Default: response.json beside CONFIG."),
    ] = None,
    ramp: Annotated[
        Path | None,
        typer.Option(help="A folder in which an image of each level is left, for 'weldscan calibrate response'."),
    ] = None,
) -> None:
    """Measure latency, response, saturated and dark pixels of projector and camera.

    The response is the projector's own: a table that the configuration has already is not applied.
    """
    from weldscan.records.files import check_file
    from weldscan.records.response import write_response
    from weldscan.station import check
    from weldscan.station.cell import read_cell

    cell = read_cell(config)
    out = out if out is not None else config.parent / "response.json"
    check_file(out)
    if ramp is not None:
        ramp.mkdir(parents=True, exist_ok=True)
        check_file(ramp / "ramp.png")
    with cell.open("projector", response=None) as projector, cell.open("camera") as camera:
        exposure_s = check.prepare(camera, projector)
        print(f"exposure   {exposure_s * 1000:.3f} ms, {exposure_s * projector.settings.refresh_hz:.0f} refreshes")
        seconds = check.latency_s(camera, projector)
        print(f"latency    {max(seconds) * 1000:.1f} ms at most of {len(seconds)}: latency_s = {max(seconds):.3f}")
        if camera.streams:
            under_way = max(check.transfer_s(camera, projector))
            print(f"transfer   {under_way * 1000:.1f} ms at most: [camera] transfer_s = {under_way:.3f}")
        shares = check.pixels(camera, projector)
        print(f"pixels     saturated {shares.saturated:.2%}, dark {shares.dark:.2%}")
        table = check.response(camera, projector, keep=ramp)
        write_response(out, table)
        named = out.name if out.parent == config.parent else out.resolve()
        print(f'response   gamma {check.gamma(table):.3f}, in {out}; [projector] response = "{named}" corrects it')


def scan(
    out: Annotated[
        Path | None, typer.Option(help="The session folder: new, or with --resume one that was begun.")
    ] = None,
    config: Config = CELL,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a scan that was stopped.")] = False,
    retake: Annotated[
        bool, typer.Option("--retake", help="With --resume: set aside more than one damaged shot, and take them again.")
    ] = False,
    example_config: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Write a complete cell.toml and its plan, all simulated, into a folder; do no more."
        ),
    ] = None,
) -> None:
    """Scan what the cell's plan says, into a session folder that `weldscan inspect` reads.

    At each pose of the plan: move there, or wait for the operator; wait until the robot stands; take the images between
    two readings of the pose; look at their quality; keep the shot. What was kept stays, whatever happens next.
    """
    from weldscan.station.cell import read_cell
    from weldscan.station.scan import scan as run

    if example_config is not None:
        from weldscan.faces.live_demo import write_example

        print(write_example(example_config))
        return
    if out is None:
        raise InputError("--out: name the session folder")

    how = f"weldscan scan --config {config} --out {out} --resume"
    try:
        with shown_progress() as tell:
            result = run(read_cell(config), out, resume, tell, _ask_the_operator, retake)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"stopped; what was kept is whole. To go on: {how}") from None
    complete = result.whole >= result.planned
    with terminal.answer(0 if complete else NOT_MEASURED):
        print(f"{result.whole} of {result.planned} shots in {out}")
        for each in result.set_aside:
            print(f"       set aside {each.shot} as {each.folder}: {each.reason}")
        for name, reason in result.rejected:
            print(f"       rejected {name}: {reason}")
        if result.seconds:
            print(f"       seconds: {', '.join(f'{what} {each:.1f}' for what, each in result.seconds.items())}")
        print(f"       next: weldscan inspect {out}" if complete else f"       to go on: {how}")


def _ask_the_operator(shot: ShotSpec) -> None:
    target = "" if shot.flange_pose is None else f" ({shot.flange_pose})"
    print(f"Move the flange to {shot.name}{target}, then press Enter.", file=sys.stderr, flush=True)
    if not sys.stdin.readline():
        raise InputError(f"{shot.name}: nobody is there to say that the robot is at its pose")


def _robot(config: Path) -> Robot:
    from weldscan.station.cell import read_cell

    return read_cell(config).open_robot()


def _controller(link: str, arm: Arm, host: str, port: int | None) -> Any:
    """A controller on the wanted port; or on the link's usual one, or where that is taken on any."""
    from weldscan.devices.robots.wire import checked_host

    kind = backend("controller", link)
    if link == "serial":
        return kind(arm)
    try:
        checked_host(host)
    except ValueError as error:
        raise InputError(f"--host: {error}, not {host!r}") from None
    usual = backend("robot", link).Settings.model_fields["port"].default
    for attempt in (usual, 0) if port is None else (port,):
        try:
            return kind(arm, host=host, port=attempt)
        except OSError as error:
            complaint = f"{host}:{attempt}: cannot listen: {error.strerror or error}"
    raise DeviceError(complaint)


def _obey_lines(controller: Controller) -> None:
    for line in sys.stdin:
        try:
            _inject(controller, line)
        except InputError as error:
            print(error, file=sys.stderr, flush=True)


def _inject(controller: Controller, request: str) -> None:
    from weldscan.pose import parse_whole
    from weldscan.simulated.controllers import LinkFault

    words = request.split()
    try:
        count = parse_whole(words[1]) if len(words) > 1 else 1
        if not 1 <= count <= MOST_FAULTS:
            raise ValueError
        controller.inject(LinkFault(words[0]), count)
    except (IndexError, ValueError):
        known = ", ".join(fault.value for fault in LinkFault)
        raise InputError(f"fault: {request.strip()!r} is not FAULT [COUNT] with one of {known}") from None


def _pose(words: list[str]) -> KukaPose:
    from weldscan.pose import KukaPose, parse_number

    try:
        x, y, z, a, b, c = map(parse_number, words)
    except ValueError:
        raise InputError(f"pose: {' '.join(words)!r} is not six numbers") from None
    return KukaPose(x, y, z, a, b, c)


def _show(pose: StampedPose, to_a_person: bool) -> None:
    values = dict(zip("XYZABC", pose.flange.values(), strict=True))
    if to_a_person:
        print("  ".join(f"{name} {value:10.3f}" for name, value in values.items()), flush=True)
    else:
        print(json.dumps({**values, "time_s": pose.time_s}), flush=True)
