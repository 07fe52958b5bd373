"""`weldscan scan`: whole sessions, and what happens when robot, camera, projector, disk or power fail in the middle."""

import errno
import hashlib
import json
import os
import random
import re
import signal
import socket
import subprocess
import sys
import threading
import time

import cv2
import numpy as np
import pytest

from weldscan import DeviceError, DeviceTimeout, InputError, KukaPose
from weldscan.devices import backend
from weldscan.devices.cameras import Camera, CameraSettings
from weldscan.devices.projectors import DisplayGone, Projector, ProjectorSettings
from weldscan.devices.projectors.patterns import flat_pattern, fringe_patterns
from weldscan.devices.robots import distance
from weldscan.records.frames import read_frames
from weldscan.records.session import read_session
from weldscan.records.shot import left_out
from weldscan.simulated.controllers import Arm, LinkFault
from weldscan.simulated.controllers.kvp import KvpController
from weldscan.station import check, store
from weldscan.station import scan as scan_module
from weldscan.station.capture import judge
from weldscan.station.cell import CellConfig, read_cell
from weldscan.station.scan import scan

WIDTH, HEIGHT = 48, 32
FRINGES = [("x", 1, 4), ("x", 4, 4)]
IMAGES = 9
MAIN = (  # a test that runs in the background has Ctrl-C switched off, and its children with it
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from weldscan.faces.cli.app import main; main()"
)
POSES = {
    "artefact-1": (600.0, -150.0, 480.0, -29.0, 23.0, 74.0),
    "artefact-2": (610.0, -140.0, 470.0, -20.0, 25.0, 70.0),
    "part-1": (650.0, -100.0, 450.0, -10.0, 15.0, 60.0),
}


def plan_document():
    lens = {"width": WIDTH, "height": HEIGHT, "K": [[100, 0, 24], [0, 100, 16], [0, 0, 1]], "dist": [0, 0, 0, 0]}
    shots = [
        {"name": name, "of": name.split("-")[0], "flange_pose": dict(zip("XYZABC", pose, strict=True))}
        for name, pose in POSES.items()
    ]
    shots[2]["exposures"] = [1.0, 3.0]
    return {
        "schema": "weldscan-session/1",
        "name": "small",
        "scanner": {
            "camera": lens,
            "projector": lens,
            "camera_from_projector": [[1, 0, 0, -100], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        },
        "fringes": [{"axis": axis, "periods": periods, "steps": steps} for axis, periods, steps in FRINGES],
        "artefact": {"sphere_diameter": 20.0, "centres_base": [[0, 0, 0], [50, 0, 0], [0, 40, 0]]},
        "part": {
            "kind": "pipe",
            "outside_diameter": 630.0,
            "wall_thickness": 6.0,
            "joint": "circumferential butt",
            "axis_base": [1, 0, 0],
            "zero_base": [0, 1, 0],
        },
        "shots": shots,
    }


def scene():
    """What the camera sees of each pattern: half the light, on some background."""
    patterns = [*fringe_patterns(FRINGES, WIDTH, HEIGHT), flat_pattern(255, WIDTH, HEIGHT)]
    return [(20 + pattern // 2).astype(np.uint8) for pattern in patterns]


class Cell:
    """A simulated controller, a folder of images, a projector; everything in one place."""

    def __init__(self, folder, **robot):
        self.folder, self.out = folder, folder / "out"
        (folder / "images").mkdir()
        for number, image in enumerate(scene()):
            cv2.imwrite(str(folder / "images" / f"{number:03d}.png"), image)
        (folder / "plan.json").write_text(json.dumps(plan_document()))
        self.arm = Arm(KukaPose(*POSES["artefact-1"]))
        self.arm.speed_mm_s, self.arm.turn_speed_deg_s = 5000.0, 1000.0
        self.controller = KvpController(self.arm)
        self.controller.restart_s = 0.3
        options = {"port": self.controller.port, "allow_motion": True, "timeout_s": 2.0, "move_timeout_s": 3.0} | robot
        lines = "\n".join(f"{key} = {json.dumps(value)}" for key, value in options.items())
        self.path = folder / "cell.toml"
        self.path.write_text(
            f'[robot]\nlink = "kvp"\n{lines}\n'
            f'[camera]\nbackend = "folder"\nfolder = {json.dumps(str(folder / "images"))}\nrepeat = true\n'
            f'[projector]\nbackend = "simulated"\nwidth = {WIDTH}\nheight = {HEIGHT}\n'
            '[scan]\nplan = "plan.json"\nstill_window_s = 0.02\nstill_timeout_s = 2.0\n'
        )
        self.said = []

    def scan(self, resume=False, tell=None, operator=None):
        def note(done, of, what):
            self.said.append(what)
            if tell is not None:
                tell(what)

        return scan(read_cell(self.path), self.out, resume, note, operator)

    def kept(self):
        return [what.removeprefix("kept ") for what in self.said if what.startswith("kept ")]

    def assert_whole(self, names=tuple(POSES)):
        """The session holds exactly these shots, and every one of them is what the camera and the robot said."""
        session = read_session(self.out)
        assert [shot.name for shot in session.shots] == [name for name in POSES if name in names]
        for shot in session.shots:
            for stack in read_frames(session, shot):
                for image, expected in zip(stack, scene()[:-1], strict=True):
                    np.testing.assert_array_equal(image, expected)
            pose = KukaPose(*shot.flange_pose.model_dump().values())
            moved_mm, moved_deg = distance(pose, KukaPose(*POSES[shot.name]))
            assert moved_mm < 0.1
            assert moved_deg < 0.02
        assert {name for name, _ in left_out(self.out)} == set(POSES) - set(names)
        assert not [entry for entry in (self.out / "shots").iterdir() if ".partial" in entry.name]


@pytest.fixture
def cell(tmp_path):
    cell = Cell(tmp_path)
    yield cell
    cell.controller.close()


def test_a_whole_scan(cell):
    result = cell.scan()
    assert (result.whole, result.planned, result.rejected) == (3, 3, ())
    cell.assert_whole()
    assert cell.kept() == list(POSES)
    session = read_session(cell.out)
    assert session.shots[2].exposures == (1.0, 3.0)
    assert (cell.out / "shots/part-1/e1_white.png").is_file()
    manifest = json.loads((cell.out / "shots/part-1/shot.json").read_text())
    assert len(manifest["files"]) == 2 * IMAGES
    for name, digest in manifest["files"].items():
        assert hashlib.sha256((cell.out / "shots/part-1" / name).read_bytes()).hexdigest() == digest
    assert "kept part-1" in (cell.out / "scan.log").read_text()


def test_folders_that_are_in_the_way(cell):
    cell.scan()
    with pytest.raises(InputError, match="--resume"):
        cell.scan()
    assert cell.scan(resume=True).whole == 3
    plan = plan_document() | {"name": "another"}
    (cell.folder / "plan.json").write_text(json.dumps(plan))
    with pytest.raises(InputError, match="another plan"):
        cell.scan(resume=True)
    cell.out = cell.folder / "images"
    with pytest.raises(InputError, match="something else"):
        cell.scan()
    cell.out = cell.folder / "cell.toml"
    with pytest.raises(InputError, match="not a folder"):
        cell.scan()


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('link = "kvp"', 'link = "kvq"', "robot.link: 'kvq'"),
        ('link = "kvp"', 'link = "kvp"\nprot = 7000', "robot: prot: unknown"),
        ('backend = "folder"', 'backend = ["folder"]', "camera.backend"),
        ("repeat = true", 'repeat = "perhaps"', "camera: repeat"),
        ('backend = "simulated"', "", "projector.backend: missing"),
        ("[projector]", "[projectors]", "projectors: unknown"),
        ("still_window_s", "still_windows_s", "scan: still_windows_s: unknown"),
    ],
)
def test_a_wrong_configuration_is_told_before_anything_is_written(cell, old, new, complaint):
    text = cell.path.read_text()
    assert old in text
    cell.path.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=complaint) as caught:
        cell.scan()
    assert "cell.toml" in str(caught.value)
    assert not cell.out.exists()


def test_a_robot_section_without_a_link_is_kvp_and_names_are_relative_to_the_file(cell, tmp_path, monkeypatch):
    text = cell.path.read_text().replace('link = "kvp"\n', "").replace(str(cell.folder / "images"), "images")
    cell.path.write_text(text)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert cell.scan().whole == 3


def test_two_scans_into_one_folder(cell):
    def again(what):
        if what == "taking artefact-2":
            with pytest.raises(InputError, match="another scan"):
                scan(read_cell(cell.path), cell.out, True)

    assert cell.scan(tell=again).whole == 3


def test_bad_plans(cell):
    for text, complaint in (("{", "plan.json"), ("{}", "plan.json"), (None, "no such file")):
        path = cell.folder / "plan.json"
        path.write_text(text) if text is not None else path.unlink()
        with pytest.raises(InputError, match=complaint):
            cell.scan()
    assert not cell.out.exists()


def test_projector_of_another_size(cell):
    cell.path.write_text(cell.path.read_text().replace(f"width = {WIDTH}", "width = 64"))
    with pytest.raises(InputError, match="64x32"):
        cell.scan()


# --- robot ------------------------------------------------------------------------------------------------------------


def test_an_operator_moves_the_robot(tmp_path):
    cell = Cell(tmp_path, allow_motion=False)
    with cell.controller:
        asked = []

        def operator(shot):
            asked.append(shot.name)
            cell.arm.place(KukaPose(*POSES[shot.name]))
            time.sleep(0.05)

        assert cell.scan(operator=operator).whole == 3
        assert asked == list(POSES)
        cell.assert_whole()


def free_udp_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.mark.parametrize("link", ["eki", "serial", "rsi"])
def test_a_scan_over_the_other_links(tmp_path, link):
    """As over KVP; RSI moves nothing, so there an operator does."""
    cell = Cell(tmp_path, allow_motion=link != "rsi")
    cell.controller.close()
    options = {"port": free_udp_port(), "cycle_s": 0.004} if link == "rsi" else {}
    with backend("controller", link)(cell.arm, **options) as controller:
        text = cell.path.read_text().replace('link = "kvp"', f'link = "{link}"')
        cell.path.write_text(re.sub(r"(?m)^port = .*$", f"port = {json.dumps(controller.port)}", text))

        def operator(shot):
            cell.arm.place(KukaPose(*POSES[shot.name]))
            time.sleep(0.05)

        assert cell.scan(operator=operator).whole == 3
        cell.assert_whole()


def test_a_robot_that_nobody_moved_or_whose_pose_is_stale(tmp_path):
    cell = Cell(tmp_path, allow_motion=False)
    with cell.controller:

        def operator(shot):
            cell.arm.place(KukaPose(*POSES[shot.name]))
            time.sleep(0.05)
            if shot.name == "artefact-2":
                cell.arm.place(KukaPose(*POSES["artefact-1"]))  # what the controller goes on telling
                time.sleep(0.05)

        result = cell.scan(operator=operator)
        assert [name for name, _ in result.rejected] == ["artefact-2"]
        assert "stale" in result.rejected[0][1]
        cell.assert_whole(("artefact-1", "part-1"))


def test_a_robot_that_moved_is_scanned_again(cell, monkeypatch):
    original, pushes = scan_module.capture_stack, iter([False, True])

    def pushing(*arguments):
        images = original(*arguments)
        if next(pushes, False):
            x, *rest = POSES["artefact-2"]
            cell.arm.place(KukaPose(x + 1.0, *rest))
        return images

    monkeypatch.setattr(scan_module, "capture_stack", pushing)
    assert cell.scan().whole == 3
    assert cell.said.count("taking artefact-2") == 2
    cell.assert_whole()
    assert "moved by" in (cell.out / "scan.log").read_text()


def test_a_robot_that_keeps_moving_rejects_the_shot(cell, monkeypatch):
    original, moves = scan_module.capture_stack, iter(range(100))

    def pushing(*arguments):
        x, *rest = POSES["artefact-2"]
        if distance(cell.arm.flange(), KukaPose(x, *rest))[0] < 5:
            cell.arm.place(KukaPose(x + 0.05 * (1 + next(moves) % 2), *rest))
        return original(*arguments)

    monkeypatch.setattr(scan_module, "capture_stack", pushing)
    monkeypatch.setattr(scan_module._Scan, "_standing", lambda self: self.robot.pose())
    result = cell.scan()
    assert [name for name, _ in result.rejected] == ["artefact-2"]
    assert "moved by" in result.rejected[0][1]
    monkeypatch.undo()
    assert cell.scan(resume=True).whole == 3
    cell.assert_whole()


def test_a_robot_that_does_not_stand_still(cell):
    def shake(what):
        if what == "going to artefact-2":
            cell.arm.move = lambda target: None

    with pytest.raises(DeviceError):
        cell.scan(tell=shake)
    del cell.arm.move
    assert cell.kept() == ["artefact-1"]
    assert cell.scan(resume=True).whole == 3
    cell.assert_whole()


@pytest.mark.parametrize("fault", [LinkFault.RESTART, LinkFault.RESET, LinkFault.BYTES, LinkFault.TWICE])
def test_faults_that_a_scan_survives(cell, fault):
    assert cell.scan(tell=lambda what: cell.controller.inject(fault) if what.startswith("taking") else None).whole == 3
    cell.assert_whole()


@pytest.mark.parametrize(
    "fault", [LinkFault.SILENCE, LinkFault.GARBAGE, LinkFault.WRONG_ID, LinkFault.NAN, LinkFault.JUMP, LinkFault.EMPTY]
)
def test_faults_that_stop_a_scan_which_then_goes_on(tmp_path, fault):
    cell = Cell(tmp_path, timeout_s=0.5)
    with cell.controller:

        def inject(what):
            if what == "taking artefact-2":
                cell.controller.inject(fault, 30)

        with pytest.raises(DeviceError):
            cell.scan(tell=inject)
        assert cell.kept() == ["artefact-1"]
        cell.controller._faults.clear()
        assert cell.scan(resume=True).whole == 3
        cell.assert_whole()


def test_clock_going_back(cell, monkeypatch):
    now = iter(range(10**9, 0, -1000))
    monkeypatch.setattr(time, "time", lambda: float(next(now)))
    assert cell.scan().whole == 3
    cell.assert_whole()


# --- camera, projector, quality ---------------------------------------------------------------------------------------


class Wall(Projector):
    """A projector with a latency and a gamma; fails when told to."""

    name = "wall"

    def __init__(self, latency_s=0.0, gamma=1.0, **settings):
        self.settings = ProjectorSettings(
            width=WIDTH, height=HEIGHT, **{"latency_s": latency_s, "guard_frames": 0, "refresh_hz": 1000.0, **settings}
        )
        self.latency_s, self.gamma = latency_s, gamma
        self.light = [(float("-inf"), np.zeros((HEIGHT, WIDTH)))]
        self.gone_after = None

    def _show(self, image):
        if self.gone_after is not None:
            self.gone_after -= 1
            if self.gone_after < 0:
                raise DisplayGone("wall: the display is gone")
        now_s = time.monotonic()
        self.light.append((now_s + self.latency_s, (image / 255.0) ** self.gamma))
        return now_s

    def seen(self, at_s):
        return next(light for on_s, light in reversed(self.light) if on_s <= at_s)

    def close(self):
        pass


class Eye(Camera):
    """A camera that sees the wall; its light grows with the exposure."""

    name = "eye"

    def __init__(self, wall, gain=1.0, **settings):
        self.settings = CameraSettings(**{"exposure_s": 0.01, **settings})
        self.wall, self.gain, self.unplugged_after, self.exposures = wall, gain, None, []
        self.set_exposure(self.settings.exposure_s)

    def _set_exposure(self, exposure_s):
        self.exposures.append(exposure_s)
        return exposure_s

    def _grab(self, deadline_s):
        if self.unplugged_after is not None:
            self.unplugged_after -= 1
            if self.unplugged_after < 0:
                raise DeviceError("eye: unplugged")
        light = self.wall.seen(time.monotonic())
        time.sleep(self.exposure_s)
        level = self.gain * self.exposure_s / 0.01 * (20 + 100 * light)
        return np.clip(np.rint(level), 0, 255).astype(np.uint8)

    def _close(self):
        pass


@pytest.fixture
def eye_and_wall(monkeypatch):
    """Cells whose camera and projector are these two."""
    wall = Wall()
    eye = Eye(wall)
    original = CellConfig.open

    def opened(self, kind, **extra):
        return {"camera": eye, "projector": wall}.get(kind) or original(self, kind, **extra)

    monkeypatch.setattr(CellConfig, "open", opened)
    return eye, wall


@pytest.mark.parametrize(("gain", "exposures"), [(1.0, {0.01}), (2.5, {0.01, 0.005}), (0.05, {0.01, 0.02})])
def test_one_retry_with_another_exposure(cell, eye_and_wall, gain, exposures):
    eye, _ = eye_and_wall
    eye.gain = gain
    result = cell.scan()
    assert "artefact-1" not in dict(result.rejected)
    assert exposures <= set(eye.exposures)


@pytest.mark.parametrize(("gain", "complaint"), [(50.0, "saturated"), (0.001, "can be measured")])
def test_too_bright_and_too_dark(cell, eye_and_wall, gain, complaint):
    eye_and_wall[0].gain = gain
    result = cell.scan()
    assert result.whole == 0
    assert all(complaint in reason for _, reason in result.rejected)
    assert not (cell.out / "session.json").exists()
    eye_and_wall[0].gain = 1.0
    assert cell.scan(resume=True).whole == 3


@pytest.mark.parametrize("images", [3, IMAGES + 4])
@pytest.mark.parametrize("what", ["camera", "projector"])
def test_unplugged_in_mid_stack(cell, eye_and_wall, images, what):
    eye, wall = eye_and_wall
    if what == "camera":
        eye.unplugged_after = images
    else:
        wall.gone_after = images
    with pytest.raises(DeviceError, match=r"unplugged|gone"):
        cell.scan()
    assert cell.kept() == list(POSES)[: images // IMAGES]
    eye.unplugged_after = wall.gone_after = None
    assert cell.scan(resume=True).whole == 3


def test_frame_of_the_wrong_size(cell):
    cv2.imwrite(str(cell.folder / "images" / "005.png"), np.zeros((HEIGHT, WIDTH + 1), np.uint8))
    with pytest.raises(DeviceError, match=r"49x32, not 48x32"):
        cell.scan()
    assert not (cell.out / "session.json").exists()


def test_camera_of_another_size_than_the_plan_has(cell):
    for path in (cell.folder / "images").iterdir():
        cv2.imwrite(str(path), np.pad(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), 8))
    with pytest.raises(DeviceError, match="64x48 pixels, but the plan's camera has 48x32"):
        cell.scan()
    assert not list((cell.out / "shots").iterdir())


def test_quality_of_two_exposures():
    """A left half that one exposure saturates and a right half that the other leaves dark are both usable together."""
    frames = np.stack(list(fringe_patterns(FRINGES, WIDTH, HEIGHT))).astype(float)
    gain = np.where(np.arange(WIDTH) < WIDTH / 2, 1.0, 0.01)
    short = [np.clip(0.9 * frame * gain, 0, 255).astype(np.uint8) for frame in frames]
    long = [np.clip(40 * frame * gain, 0, 255).astype(np.uint8) for frame in frames]
    alone = judge([short], FRINGES, 0.02)
    both = judge([short, long], FRINGES, 0.02)
    assert alone.usable == pytest.approx(0.5, abs=0.1)
    assert both.usable > 0.95
    assert judge([[np.full((4, 6), 255, np.uint8)] * 8], FRINGES, 0.02).saturated == 1.0
    assert judge([[np.full((4, 6), 90, np.uint8)] * 8], FRINGES, 0.02).dark == 1.0


@pytest.mark.parametrize("latency_s", [0.02, 0.08])
def test_latency_is_measured(latency_s, monkeypatch):
    monkeypatch.setattr(check, "REST_S", 0.15)  # the wall's latency is known to be less
    wall = Wall(latency_s)
    with Eye(wall) as eye:
        found = check.latency_s(eye, wall, repeats=3)
        assert min(found) >= latency_s * 0.99
        assert min(found) < latency_s + 0.05


@pytest.mark.parametrize("gamma", [1.0, 1.35, 2.2])
def test_response_is_measured(gamma, monkeypatch):
    monkeypatch.setattr(check, "REST_S", 0.0)  # and this wall has none
    wall = Wall(gamma=gamma)
    with Eye(wall) as eye:
        document = check.response(eye, wall)
        assert check.gamma(document) == pytest.approx(gamma, rel=0.03)
        assert check.pixels(eye, wall).saturated == 0
        eye.gain = 10.0
        assert check.pixels(eye, wall).saturated == 1
        eye.gain = 0.0
        with pytest.raises(DeviceError, match="does not see"):
            check.latency_s(eye, wall)


# --- disk and power ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("writes", [0, 1, 5, IMAGES, IMAGES + 2, 2 * IMAGES + 6])
def test_disk_full(cell, monkeypatch, writes):
    left, original = [writes], store.write_synced

    def full(path, data):
        left[0] -= 1
        if left[0] < 0:
            path.write_bytes((data.encode() if isinstance(data, str) else data)[: len(data) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        original(path, data)

    monkeypatch.setattr(store, "write_synced", full)
    monkeypatch.setattr("weldscan.records.files.write_synced", full)
    with pytest.raises(InputError, match="No space left"):
        cell.scan()
    kept = cell.kept()
    monkeypatch.undo()
    assert cell.scan(resume=cell.out.exists() and (cell.out / "plan.json").exists()).whole == 3
    assert cell.kept()[: len(kept)] == kept
    assert len(set(cell.kept())) == len(cell.kept())  # what was acknowledged is not taken again
    cell.assert_whole()


@pytest.mark.parametrize("damage", ["truncated", "changed", "removed", "no manifest", "torn manifest"])
def test_torn_files_are_noticed_and_taken_again(cell, damage):
    cell.scan()
    folder = cell.out / "shots" / "artefact-2"
    path = folder / ("shot.json" if "manifest" in damage else "003.png")
    data = path.read_bytes()
    match damage:
        case "truncated" | "torn manifest":
            path.write_bytes(data[: len(data) // 2])
        case "changed":
            path.write_bytes(data[:-20] + bytes([data[-20] ^ 1]) + data[-19:])
        case _:
            path.unlink()
    assert [name for name, _ in left_out(cell.out)] == ["artefact-2"]
    result = cell.scan(resume=True)
    assert result.whole == 3
    cell.assert_whole()
    assert "taken again" in (cell.out / "scan.log").read_text()


def test_sessions_from_elsewhere_are_left_alone(tmp_path):
    (tmp_path / "shots" / "part-1").mkdir(parents=True)
    assert left_out(tmp_path) == ()
    assert left_out(tmp_path / "nothing") == ()


def start(cell):
    resume = ["--resume"] if (cell.out / "plan.json").exists() else []
    return subprocess.Popen(
        [sys.executable, "-c", MAIN, "scan", "--config", str(cell.path), "--out", str(cell.out), *resume],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
        text=True,
    )


def acknowledged(stderr):
    """The shots that a killed scan had said were kept."""
    lines = [line for line in stderr.splitlines() if line.startswith("{") and line.endswith("}")]
    said = [json.loads(line)["what"] for line in lines]
    return [what.removeprefix("kept ") for what in said if what.startswith("kept ")]


def run_or_kill(scanning, after_s):
    """Let a scan run, or kill it so long after it began to tell; give what it had told."""
    lines, telling = [], threading.Event()

    def listen():
        for line in scanning.stderr:
            lines.append(line)
            telling.set()
        telling.set()

    listener = threading.Thread(target=listen)
    listener.start()
    try:
        if after_s is not None:
            telling.wait(60)
        scanning.wait(60 if after_s is None else after_s)
    except subprocess.TimeoutExpired:
        scanning.kill()
        scanning.wait()
    listener.join()
    scanning.stdout.close()
    scanning.stderr.close()
    return "".join(lines)


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("part", range(4))
def test_killed_at_random_moments(tmp_path, soak, part):
    """SIGKILL, then --resume, again and again: nothing that was acknowledged is lost, and nothing half is read."""
    if part and not soak:
        pytest.skip("only with --soak")
    moments = random.Random(5 + part)
    kills = rounds = 0
    while kills < (50 if soak else 3):
        folder = tmp_path / str(rounds)
        rounds += 1
        folder.mkdir()
        cell, known = Cell(folder), set()
        with cell.controller:
            while True:
                scanning = start(cell)
                said = run_or_kill(scanning, None if moments.random() < 0.1 else moments.uniform(0.0, 0.25))
                known |= set(acknowledged(said))
                whole = {name for name in POSES if (cell.out / "shots" / name).is_dir()}
                assert known <= whole
                for name in whole:
                    assert (cell.out / "shots" / name / "shot.json").is_file()
                if (cell.out / "session.json").exists():
                    read_session(cell.out)
                if scanning.returncode == 0:
                    break
                assert scanning.returncode == -signal.SIGKILL, said
                kills += 1
            cell.assert_whole()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_ends_cleanly_and_says_how_to_go_on(cell, number):
    cell.arm.speed_mm_s = 10.0
    scanning = start(cell)
    for line in scanning.stderr:
        if "going to artefact-2" in line:
            break
    scanning.send_signal(number)
    _, said = scanning.communicate(timeout=20)
    assert scanning.returncode == 130
    assert "--resume" in said
    assert "Traceback" not in said
    cell.arm.speed_mm_s = 5000.0
    cell.arm.place(KukaPose(*POSES["artefact-1"]))
    scanning = start(cell)
    printed, said = scanning.communicate(timeout=60)
    assert scanning.returncode == 0, said
    assert "3 of 3" in printed
    cell.assert_whole()


def test_device_timeout_is_told_in_one_line(tmp_path):
    cell = Cell(tmp_path, timeout_s=0.3, reconnect_s=0.5)
    cell.controller.close()
    scanning = start(cell)
    _, said = scanning.communicate(timeout=60)
    assert scanning.returncode == 2
    assert "cannot connect" in said.splitlines()[-1]
    assert "Traceback" not in said


def test_device_timeouts_are_device_errors():
    assert issubclass(DeviceTimeout, DeviceError)


def test_the_example_cell(tmp_path):
    """What `--example-config` writes is scanned as it stands, but for the port; two shots of its eight."""
    from weldscan.faces.live_demo import write_example

    said = write_example(tmp_path / "cell")
    path, plan = tmp_path / "cell" / "cell.toml", tmp_path / "cell" / "plan.json"
    assert f"weldscan scan --config {path}" in said
    pose = KukaPose(*map(float, said.split('--pose "')[1].split('"')[0].split()))
    with pytest.raises(InputError, match="exists already"):
        write_example(tmp_path / "cell")
    document = json.loads(plan.read_text())
    document["shots"] = [shot for shot in document["shots"] if shot["name"] in ("artefact-6", "part-1")]
    plan.write_text(json.dumps(document))
    arm = Arm(pose)
    arm.speed_mm_s, arm.turn_speed_deg_s = 5000.0, 1000.0
    with KvpController(arm) as controller:
        path.write_text(path.read_text().replace("port = 7000", f"port = {controller.port}"))
        result = scan(read_cell(path), tmp_path / "pipe")
    assert (result.whole, result.rejected) == (2, ())
    manifest = json.loads((tmp_path / "pipe" / "shots" / "part-1" / "shot.json").read_text())
    assert manifest["record"]["quality"]["usable"] > 0.9


def test_the_live_cell(tmp_path):
    """Everything over its own socket: the session is that of the same cell, rendered, but for the robot's reported
    poses."""
    from dataclasses import replace

    from weldscan import Lens
    from weldscan.faces.live_demo import record_live
    from weldscan.simulated import DEFAULT, make_scanner, render, session_document

    lens = Lens(160, 120, [[326.0, 0, 80.0], [0, 326.0, 60.0], [0, 0, 1]], [0.0, 0.0, 0.0, 0.0])
    projector = Lens(160, 100, [[260.0, 0, 80.0], [0, 260.0, 50.0], [0, 0, 1]], [0.0, 0.0, 0.0, 0.0])
    small = replace(
        DEFAULT, scanner=make_scanner(lens, projector), artefact_shots=2, fringes=(("x", 1, 4), ("x", 8, 4))
    )
    said = []
    record_live(tmp_path / "live", small, lambda done, of, what: said.append((done, of, what)))
    assert said[-1] == (4, 4, "kept part-2")
    session, plan = read_session(tmp_path / "live"), session_document(small)
    assert left_out(tmp_path / "live") == ()
    assert [shot.name for shot in session.shots] == ["artefact-1", "artefact-2", "part-1", "part-2"]
    for shot, planned in zip(session.shots, plan["shots"], strict=True):
        pose = KukaPose(*shot.flange_pose.model_dump().values())
        assert distance(pose, KukaPose(*planned["flange_pose"].values()))[0] < 0.1
        expected = render(
            small, shot.of, pose.matrix() @ np.asarray(small.flange_from_scanner), exposures=[1.0], seed=9
        )
        (stack,) = read_frames(session, shot)
        for image, other in zip(stack, expected.frames[0], strict=True):
            assert np.abs(image.astype(int) - other).mean() < 4  # the noise is another, the view is the same
