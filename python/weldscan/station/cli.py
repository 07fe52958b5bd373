"""The commands of the live cell: robot, camera, project, devices, scan. `register` adds them to the command line.

As in `weldscan.cli`, heavy imports happen inside the commands.
"""

from __future__ import annotations

import contextlib
import json
import math
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from weldscan.devices import BACKENDS, backend
from weldscan.errors import InputError
from weldscan.pose import KukaPose

if TYPE_CHECKING:
    from weldscan.devices.controller import Controller
    from weldscan.devices.robot import Robot, StampedPose

robot_app = typer.Typer(
    help="Where the flange is, and - where allowed - where it shall go.",
    no_args_is_help=True,
    rich_markup_mode=None,
    add_completion=False,
)

Config = Annotated[Path, typer.Option("--config", help="The cell's configuration.")]
CELL = Path("cell.toml")


def register(app: typer.Typer) -> None:
    """Add the commands of the live cell."""
    app.add_typer(robot_app, name="robot")


@robot_app.command("pose")
def robot_pose(config: Config = CELL) -> None:
    """Print the flange in base, once."""
    with _robot(config) as robot:
        _show(robot.pose(), sys.stdout.isatty())


@robot_app.command("watch")
def robot_watch(
    config: Config = CELL,
    every_s: Annotated[float, typer.Option("--every", min=0.0, help="Seconds between readings.")] = 0.2,
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
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: a free one (rsi: 64000).")] = 0,
    pose: Annotated[str, typer.Option(help="The flange: X Y Z A B C, mm and degrees.")] = "",
    speed: Annotated[float, typer.Option(min=0.1, help="mm/s")] = 250.0,
    fault: Annotated[list[str] | None, typer.Option(help="FAULT or FAULT:COUNT for the next replies.")] = None,
) -> None:
    """Be a controller, until Ctrl-C. A line `FAULT [COUNT]` on standard input spoils the next replies.

    It prints one JSON line that says where it listens. Faults: silence, bytes, twice, wrong-id, wrong-length, empty,
    garbage, huge, dtd, entity, reset, restart, nan, jump, stale.
    """
    if link not in BACKENDS["controller"]:
        raise InputError(f"--link: {link!r} is none of {', '.join(BACKENDS['controller'])}")
    from weldscan.devices.controller import HOME, Arm

    arm = Arm(_pose(pose.split()) if pose else HOME)
    arm.speed_mm_s = speed
    where: dict[str, Any] = {} if link == "serial" else {"host": host, "port": port}
    if link == "rsi":
        where["port"] = port or 64000
    controller: Controller = backend("controller", link)(arm, **where)
    with controller:
        for request in fault or []:
            _inject(controller, request.replace(":", " "))
        listening = getattr(controller, "port", where.get("port"))
        print(json.dumps({"link": link, **({} if link == "serial" else {"host": host}), "port": listening}), flush=True)
        threading.Thread(target=_obey_lines, args=(controller,), daemon=True).start()
        with contextlib.suppress(KeyboardInterrupt):
            threading.Event().wait()


def _robot(config: Path) -> Robot:
    from weldscan.station.cell import read_cell

    return read_cell(config).open_robot()


def _obey_lines(controller: Controller) -> None:
    for line in sys.stdin:
        try:
            _inject(controller, line)
        except InputError as error:
            print(error, file=sys.stderr, flush=True)


def _inject(controller: Controller, request: str) -> None:
    from weldscan.devices.controller import Fault

    words = request.split()
    try:
        controller.inject(Fault(words[0]), int(words[1]) if len(words) > 1 else 1)
    except (IndexError, ValueError):
        known = ", ".join(fault.value for fault in Fault)
        raise InputError(f"fault: {request.strip()!r} is not FAULT [COUNT] with one of {known}") from None


def _pose(words: list[str]) -> KukaPose:
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise InputError(f"pose: {' '.join(words)!r} is not six numbers") from None
    if len(values) != 6 or not all(map(math.isfinite, values)):
        raise InputError(f"pose: {' '.join(words)!r} is not six numbers")
    return KukaPose(*values)


def _show(pose: StampedPose, to_a_person: bool) -> None:
    values = dict(zip("XYZABC", pose.flange.values(), strict=True))
    if to_a_person:
        print("  ".join(f"{name} {value:10.3f}" for name, value in values.items()), flush=True)
    else:
        print(json.dumps({**values, "time_s": pose.time_s}), flush=True)
