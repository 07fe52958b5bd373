"""Figures of the live cell: poses per second, the worst of many, the time from a pattern to its frame, and of a shot.

python benches/live_cell.py [POSES]     (10,000 by default)
python benches/live_cell.py shots       (only the time of a shot)

Every pose is compared with what the simulated controller holds before it is counted, every shot is whole.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from weldscan import DeviceError, KukaPose
from weldscan.devices import backend
from weldscan.devices.projectors.patterns import fringe_patterns
from weldscan.devices.robots import Robot, distance
from weldscan.records.shot import left_out, read_manifest
from weldscan.simulated import DEFAULT, session_document
from weldscan.simulated.controllers import Arm
from weldscan.simulated.controllers.kvp import KvpController
from weldscan.station.cell import CellConfig
from weldscan.station.scan import scan

FLANGE = KukaPose(610.825, -148.476, 481.652, -29.008, 23.236, 74.641)
TOOL = KukaPose(12.5, -3.25, 180.0, 15.0, -40.0, 5.0)


def poses(name: str, robot: Robot, count: int) -> None:
    """Read poses as fast as it goes."""
    times = []
    for _ in range(count):
        start = time.perf_counter()
        pose = robot.pose()
        times.append(time.perf_counter() - start)
        mm, deg = distance(pose.flange, FLANGE)
        if mm > 1e-5 or deg > 1e-5:
            raise SystemExit(f"{name}: wrong pose, {mm} mm, {deg} degrees")
    median, worst = statistics.median(times) * 1000, max(times) * 1000
    print(f"{name:16} {count / sum(times):7.0f} poses/s   median {median:6.2f} ms   worst of {count} {worst:7.2f} ms")


def links(count: int) -> None:
    """Every link against its simulated controller."""
    for link, dialect in (("kvp", "kukavarproxy"), ("kvp", "c3"), ("eki", None), ("serial", None)):
        arm = Arm(FLANGE, tool=TOOL)
        with backend("controller", link)(arm) as controller:
            kind = backend("robot", link)
            options = {"port": controller.port} | ({"dialect": dialect} if dialect else {})
            with kind(kind.Settings(**options)) as robot:
                poses(f"{link} {dialect or ''}", robot, count)
    kind = backend("robot", "rsi")
    with (
        kind(kind.Settings(port=0, tool=TOOL.values())) as robot,
        backend("controller", "rsi")(Arm(FLANGE, tool=TOOL), port=robot.port, cycle_s=0.004) as controller,
    ):
        poses("rsi 4 ms", robot, count)
        print(f"{'':16} of {controller.cycles} cycles {controller.late} answers late, {controller.wrong} wrong")


@contextmanager
def fake_gige() -> Iterator[str | None]:
    """Aravis's fake camera, by its name; None where it is not installed."""
    try:
        backend("camera", "aravis").available()
    except DeviceError as error:
        print(error)
        yield None
        return
    if shutil.which("arv-fake-gv-camera-0.8") is None:
        print("arv-fake-gv-camera-0.8 is not installed")
        yield None
        return
    fake = subprocess.Popen(["arv-fake-gv-camera-0.8", "-i", "127.0.0.1", "-s", "WELD01"], stderr=subprocess.DEVNULL)
    try:
        time.sleep(1.0)
        yield next(name for name in backend("camera", "aravis").available() if "WELD01" in name)
    finally:
        fake.kill()
        fake.wait()


def frames(count: int = 200) -> None:
    """Aravis's fake camera: from the pattern that was shown to its frame, without the projector's latency."""
    with fake_gige() as name:
        if name is None:
            return
        camera, projector = backend("camera", "aravis"), backend("projector", "simulated")
        settings = camera.Settings(device=name, width=1280, height=960, exposure_s=0.005, timeout_s=5.0)
        patterns = list(fringe_patterns([("x", 64, 4)], 1280, 800))
        times = []
        with camera(settings) as eye, projector(projector.Settings(width=1280, height=800)) as light:
            for number in range(count):
                start = time.perf_counter()
                light.show(patterns[number % 4])
                if eye.capture().image.shape != (960, 1280):
                    raise SystemExit("wrong frame")
                times.append(time.perf_counter() - start)
        print(
            f"{'pattern to frame':16} median {statistics.median(times) * 1000:6.2f} ms   worst of {count} "
            f"{max(times) * 1000:7.2f} ms, 5 ms of it exposure"
        )


def shots() -> None:
    """A shot of 12 patterns and white, 1280x960, exposed for one refresh of 60 Hz: where its time goes."""
    os.environ["PYLON_CAMEMU"] = "1"
    common = {"width": 1280, "height": 960, "exposure_s": 1 / 60, "timeout_s": 20.0}
    with fake_gige() as name:
        aravis = {"backend": "aravis", "device": name, "packet_size": 32_000}
        for camera in ({"backend": "simulated"}, aravis if name else {}, {"backend": "pylon"}):
            try:
                if camera:
                    a_shot(common | camera)
            except DeviceError as error:
                print(f"{camera['backend']:16} {error}")


def a_shot(camera: dict[str, Any]) -> None:
    """The plan of the demo, through one camera."""
    plan = session_document(DEFAULT)
    arm = Arm(KukaPose(*plan["shots"][0]["flange_pose"].values()))
    arm.speed_mm_s, arm.turn_speed_deg_s = 5000.0, 1000.0
    with KvpController(arm) as controller, TemporaryDirectory(dir=".") as folder:
        (Path(folder) / "plan.json").write_text(json.dumps(plan))
        link = {"link": "kvp", "port": controller.port}
        cell = CellConfig(
            robot=link | {"allow_motion": True, "largest_move_mm": 10_000.0},
            camera=camera | ({"controller": link} if camera["backend"] == "simulated" else {}),
            projector={"backend": "simulated", "width": 1280, "height": 800, "refresh_hz": 60.0},
            # What the other two see is no scene of ours.
            scan={"plan": str(Path(folder) / "plan.json"), "least_usable": 0.0, "most_saturated": 1.0},
        )
        result = scan(cell, Path(folder) / "out")
        if result.whole != len(plan["shots"]) or left_out(result.folder):
            raise SystemExit(f"{camera['backend']}: {result}")
        each = [read_manifest(path.parent).record["seconds"] for path in result.folder.rglob("shot.json")]
        images = [sum(shot[what] for what in ("projector", "camera", "judging")) for shot in each]
        mean = {what: seconds / result.whole for what, seconds in result.seconds.items()}
        parts = ", ".join(f"{what} {seconds:.2f}" for what, seconds in mean.items())
        print(
            f"{camera['backend']:10} images of a shot {statistics.mean(images):.2f} s, the longest {max(images):.2f}, "
            f"with motion and standing {max(sum(shot.values()) for shot in each):.2f}; on average {parts}"
        )


if __name__ == "__main__":
    if sys.argv[1:] != ["shots"]:
        links(int(sys.argv[1]) if len(sys.argv) > 1 else 10_000)
        frames()
    shots()
