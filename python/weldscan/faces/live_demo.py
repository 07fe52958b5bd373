"""The whole cell without any hardware: a simulated controller on a real socket, simulated camera and projector, a
real scan; in one go, or as a configuration to try every command on.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from weldscan.errors import InputError, NotMeasured
from weldscan.pose import KukaPose
from weldscan.records.files import write_files
from weldscan.simulated import DEFAULT, Cell, session_document
from weldscan.simulated.controllers import Arm
from weldscan.simulated.controllers.kvp import KvpController
from weldscan.station.cell import CellConfig
from weldscan.station.scan import scan

EXAMPLE = """\
# A complete cell, all of it simulated. First its robot, in another terminal:
#     weldscan robot simulate --link kvp --pose "{pose}"
# Then, here:
#     weldscan robot pose --config {cell}
#     weldscan devices check --config {cell}
#     weldscan scan --config {cell} --out pipe-1
#     weldscan inspect pipe-1
# For a cell of your own, take one section after the other from docs/devices.md. File names are relative to this file.
name = "example"

[robot]
link = "kvp"               # KUKAVARPROXY or C3 Bridge; or "eki", "rsi", "serial"
host = "127.0.0.1"         # the controller
port = 7000
allow_motion = true        # here nothing can be hit. In a real cell false, until motion is wanted, in T1
largest_move_mm = 1000.0   # a target further away is refused
largest_turn_deg = 180.0   # and one that is turned by more

[camera]
backend = "simulated"      # or "opencv", "aravis", "pylon", "folder"
exposure_s = 0.03333       # two refreshes of the projector

[camera.controller]        # the simulated camera hangs on the simulated robot, and asks it where that is
link = "kvp"
port = 7000

[projector]
backend = "simulated"      # or "window", "files"
width = {width}
height = {height}
refresh_hz = 60.0
# response = "response.json"   # as `weldscan devices check` measured it

[scan]
plan = "plan.json"         # what is to be scanned, with the poses where the flange shall go
"""

SPEED_MM_S, TURN_SPEED_DEG_S = 5000.0, 1000.0
"""Twenty times T1: nobody stands in this cell."""


def record_live(
    folder: Path, cell: Cell = DEFAULT, tell: Callable[[int, int, str], None] = lambda done, of, what: None
) -> None:
    """Scan the simulated cell's own plan into a session folder, over KUKAVARPROXY on 127.0.0.1.

    Args:
        folder: the session folder; must not exist yet, or be empty.
        cell: what stands where.
        tell: called with (whole shots, planned shots, what is being done).
    """
    plan = session_document(cell)
    arm = Arm(KukaPose(*plan["shots"][0]["flange_pose"].values()))
    arm.speed_mm_s, arm.turn_speed_deg_s = SPEED_MM_S, TURN_SPEED_DEG_S
    # Beside the session, so that what a killed demo leaves is in its own folder.
    folder.parent.mkdir(parents=True, exist_ok=True)
    with KvpController(arm) as controller, TemporaryDirectory(prefix=".plan-", dir=folder.parent) as scratch:
        path = Path(scratch) / "plan.json"
        path.write_text(json.dumps(plan), encoding="utf-8")
        link = {"link": "kvp", "port": controller.port}
        projector = cell.scanner.projector
        config = CellConfig(
            name=cell.name,
            robot=link | {"allow_motion": True, "largest_move_mm": 10_000.0, "largest_turn_deg": 180.0},
            camera={"backend": "simulated", "controller": link, "cell": cell},
            projector={"backend": "simulated", "width": projector.width, "height": projector.height},
            scan={"plan": str(path), "still_window_s": 0.05},
        )
        result = scan(config, folder, tell=tell)
    if result.whole < result.planned:
        raise NotMeasured("; ".join(f"{name}: {reason}" for name, reason in result.rejected))


def write_example(folder: Path, cell: Cell = DEFAULT) -> str:
    """Write `cell.toml` and `plan.json` of a simulated cell into a folder, and return what to do with them.

    Args:
        folder: made if need be; files of these names that are there already are not touched but refused.
        cell: what stands where.
    """
    plan = session_document(cell)
    pose = next(shot for shot in plan["shots"] if shot["of"] == "part")["flange_pose"]
    projector, path = cell.scanner.projector, folder / "cell.toml"
    text = EXAMPLE.format(
        pose=" ".join(f"{value:g}" for value in pose.values()),
        cell=path,
        width=projector.width,
        height=projector.height,
    )
    files = {folder / "cell.toml": text, folder / "plan.json": json.dumps(plan, indent=1) + "\n"}
    for file in files:
        if file.exists() or file.is_symlink():
            raise InputError(f"{file}: exists already; name another folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror or error}") from None
    write_files(files)
    return "\n".join(line.removeprefix("# ") for line in text.splitlines()[:7])
