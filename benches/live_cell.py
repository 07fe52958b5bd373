"""Figures of the live cell: poses per second, the worst of many, and the time from a pattern to its frame.

python benches/live_cell.py [POSES]     (10,000 by default)

Every pose is compared with what the simulated controller holds before it is counted.
"""

from __future__ import annotations

import shutil
import statistics
import subprocess
import sys
import time

from weldscan import KukaPose
from weldscan.devices import backend
from weldscan.devices.projectors.patterns import fringe_patterns
from weldscan.devices.robots import Robot, distance
from weldscan.simulated.controllers import Arm

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


def frames(count: int = 200) -> None:
    """Aravis's fake camera: from the pattern that was shown to its frame, without the projector's latency."""
    if shutil.which("arv-fake-gv-camera-0.8") is None:
        print("arv-fake-gv-camera-0.8 is not installed")
        return
    fake = subprocess.Popen(["arv-fake-gv-camera-0.8", "-i", "127.0.0.1", "-s", "WELD01"], stderr=subprocess.DEVNULL)
    try:
        time.sleep(1.0)
        camera, projector = backend("camera", "aravis"), backend("projector", "simulated")
        name = next(name for name in camera.available() if "WELD01" in name)
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
    finally:
        fake.kill()
        fake.wait()


if __name__ == "__main__":
    links(int(sys.argv[1]) if len(sys.argv) > 1 else 10_000)
    frames()
