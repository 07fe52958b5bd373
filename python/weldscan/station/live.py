"""The whole cell without any hardware: a simulated controller on a real socket, simulated camera and projector, a
real scan.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from weldscan.devices.controller import Arm
from weldscan.devices.kvp import KvpController
from weldscan.devices.simulated import DEFAULT, Cell, session_document
from weldscan.errors import NotMeasured
from weldscan.pose import KukaPose
from weldscan.station.cell import CellConfig
from weldscan.station.scan import scan

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
    with KvpController(arm) as controller, TemporaryDirectory() as scratch:
        path = Path(scratch) / "plan.json"
        path.write_text(json.dumps(plan), encoding="utf-8")
        link = {"link": "kvp", "port": controller.port}
        projector = cell.scanner.projector
        config = CellConfig(
            name=cell.name,
            robot=link | {"allow_motion": True, "largest_move_mm": 10_000.0},
            camera={"backend": "simulated", "controller": link, "cell": cell},
            projector={"backend": "simulated", "width": projector.width, "height": projector.height},
            scan={"plan": str(path), "still_window_s": 0.05},
        )
        result = scan(config, folder, tell=tell)
    if result.whole < result.planned:
        raise NotMeasured("; ".join(f"{name}: {reason}" for name, reason in result.rejected))
