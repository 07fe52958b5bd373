"""Patterns, and the projectors that show them; the window against a framebuffer that is read back."""

import json
import os
import shutil
import signal
import subprocess
import time

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from weldscan import DeviceError, DeviceTimeout, InputError
from weldscan.devices import backend
from weldscan.devices.projectors import DisplayGone, correction, whole_refreshes, window
from weldscan.devices.projectors.patterns import flat_pattern, fringe_patterns
from weldscan.records.response import measured, read_response

SETS = [("x", 1, 4), ("x", 8, 4), ("y", 5, 3)]
SCREEN = 3200, 1080
X, WIDTH, HEIGHT = 1920, 1280, 800


def test_patterns_are_the_formula():
    patterns = list(fringe_patterns(SETS, 64, 40))
    assert len(patterns) == 11
    expected = []
    for axis, periods, steps in SETS:
        for step in range(steps):
            image = np.empty((40, 64))
            for v in range(40):
                for u in range(64):
                    at = (u + 0.5) / 64 if axis == "x" else (v + 0.5) / 40
                    image[v, u] = 255 * (0.5 + 0.5 * np.cos(2 * np.pi * (periods * at - step / steps)))
            expected.append(image)
    for pattern, image in zip(patterns, expected, strict=True):
        assert pattern.dtype == np.uint8
        assert np.abs(pattern - image).max() <= 0.5 + 1e-9


@pytest.mark.parametrize("bad", [("z", 1, 4), ("x", 0, 4), ("x", 1, 2), ("x", float("nan"), 4)])
def test_bad_fringes(bad):
    with pytest.raises(InputError):
        list(fringe_patterns([bad], 64, 40))


@given(st.floats(1e-4, 10), st.sampled_from([50.0, 59.94, 60.0, 120.0]))
def test_whole_refreshes(exposure_s, refresh_hz):
    count = whole_refreshes(exposure_s, refresh_hz) * refresh_hz
    assert count == pytest.approx(round(count))
    assert count >= 1
    assert abs(count - exposure_s * refresh_hz) <= 0.5 + 1e-6 or count == 1


# --- files ------------------------------------------------------------------------------------------------------------


def test_files(tmp_path):
    projector = backend("projector", "files")
    patterns = list(fringe_patterns(SETS, 64, 40))
    with projector(projector.Settings(folder=tmp_path / "patterns", width=64, height=40)) as device:
        for pattern in patterns:
            device.show(pattern)
        with pytest.raises(InputError, match="not"):
            device.show(flat_pattern(255, 40, 64))
        with pytest.raises(InputError, match="not"):
            device.show(np.zeros((40, 64), np.float32))
    for number, pattern in enumerate(patterns):
        path = tmp_path / "patterns" / f"{number:03d}.png"
        np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), pattern)


def test_files_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    projector = backend("projector", "files")
    with pytest.raises(DeviceError):
        projector(projector.Settings(folder=tmp_path / "file" / "x"))


# --- a response that is measured, and corrected -----------------------------------------------------------------------


def table(path, level, light, schema="weldscan-response/1"):
    path.write_text(json.dumps({"schema": schema, "level": list(level), "light": list(light)}))
    return path


@pytest.mark.parametrize("gamma", [1.0, 1.35, 2.2, 0.6])
def test_correction_makes_the_light_linear(tmp_path, gamma):
    level = np.arange(256)
    path = table(tmp_path / "response.json", level.tolist(), (10 + 180 * (level / 255) ** gamma).tolist())
    projector = backend("projector", "files")
    settings = projector.Settings(folder=tmp_path / "out", width=256, height=1, response=path)
    ramp = np.arange(256, dtype=np.uint8)[None, :]
    with projector(settings) as device:
        device.show(ramp)
    shown = cv2.imread(str(tmp_path / "out" / "000.png"), cv2.IMREAD_UNCHANGED)
    light = (shown[0] / 255.0) ** gamma
    step = np.diff((level / 255.0) ** gamma).max()
    assert np.abs(light - ramp[0] / 255.0).max() <= step / 2 + 1e-9  # no level is nearer
    if gamma == 1.0:
        np.testing.assert_array_equal(shown, ramp)


def test_noise_in_a_table_does_not_turn_it_round(tmp_path):
    random = np.random.default_rng(1)
    level = np.unique(np.rint(np.linspace(0, 255, 18)).astype(int))
    light = 200 * (level / 255) ** 2.2 + random.normal(0, 0.2, level.size)
    found = correction(measured(level, light).table())
    assert (np.diff(found.astype(int)) >= 0).all()
    assert found[0] == 0 or found[0] < 30
    assert found[255] == 255


@pytest.mark.parametrize(
    ("level", "light"),
    [([0, 255], [0, 1]), ([0, 128, 255], [5, 5, 5]), ([0, 128, 200], [0, 1, 2]), ([0, 128, 255], [0, float("nan"), 2])],
)
def test_bad_tables(tmp_path, level, light):
    with pytest.raises(InputError, match=r"r\.json"):
        read_response(table(tmp_path / "r.json", level, light))


def test_bad_table_files(tmp_path):
    for text in ("", "{}", "[]", '{"schema": "other", "level": [0,1,255], "light": [0,1,2]}'):
        (tmp_path / "r.json").write_text(text)
        with pytest.raises(InputError, match=r"r\.json"):
            read_response(tmp_path / "r.json")
    with pytest.raises(InputError, match="no such file"):
        read_response(tmp_path / "missing.json")


# --- the window -------------------------------------------------------------------------------------------------------


def start_screen(folder):
    """An X server with a framebuffer in a file, two displays side by side, and its name."""
    reader, writer = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(writer), "-screen", "0", f"{SCREEN[0]}x{SCREEN[1]}x24", "-fbdir", str(folder)],
        pass_fds=(writer,),
        stderr=subprocess.DEVNULL,
    )
    os.close(writer)
    with os.fdopen(reader) as said:
        number = said.readline().strip()
    if not number:
        pytest.skip("Xvfb does not start here")
    return server, f":{number}"


@pytest.fixture
def screen(tmp_path, monkeypatch):
    """Two displays, the second one the projector's."""
    if shutil.which("Xvfb") is None:
        pytest.skip("Xvfb (Debian: xvfb) is not installed")
    pytest.importorskip("pygame", reason="pygame-ce is not installed")
    server, name = start_screen(tmp_path)
    monkeypatch.setenv("DISPLAY", name)
    monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
    yield server, tmp_path / "Xvfb_screen0"
    server.kill()
    server.wait()


def framebuffer(path):
    """The red, green and blue of every pixel, from the XWD file that Xvfb keeps."""
    raw = path.read_bytes()
    head = np.frombuffer(raw[:100], ">u4")
    stride, colours = int(head[12]), int(head[19])
    pixels = np.frombuffer(raw, np.uint8, offset=int(head[0]) + 12 * colours)[: stride * SCREEN[1]]
    return pixels.reshape(SCREEN[1], stride // 4, 4)[:, : SCREEN[0], :3]


def test_every_pattern_bit_exact_at_the_second_display(screen):
    _, path = screen
    projector = backend("projector", "window")
    patterns = [*fringe_patterns([("x", 1, 4), ("x", 8, 4), ("x", 64, 4), ("y", 7, 3)], WIDTH, HEIGHT)]
    patterns += [flat_pattern(level, WIDTH, HEIGHT) for level in (255, 0, 1)]
    patterns.append(np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8))
    with projector(projector.Settings(x=X, width=WIDTH, height=HEIGHT)) as device:
        for pattern in patterns:
            device.show(pattern)
            seen = framebuffer(path)
            assert (seen[:HEIGHT, X:] == pattern[:, :, None]).all()
        assert seen[:, :X].max() == 0
        assert seen[HEIGHT:].max() == 0


def test_display_gone(screen):
    server, _ = screen
    projector = backend("projector", "window")
    with projector(projector.Settings(x=X, width=WIDTH, height=HEIGHT)) as device:
        device.show(flat_pattern(9, WIDTH, HEIGHT))
        server.kill()
        server.wait()
        start = time.monotonic()
        with pytest.raises(DisplayGone):
            for _ in range(20):
                device.show(flat_pattern(9, WIDTH, HEIGHT))
                time.sleep(0.05)
        assert time.monotonic() - start < 6.0


def test_display_gone_in_the_middle_of_a_scan(screen, tmp_path, monkeypatch):
    from test_scan import HEIGHT as LOW
    from test_scan import WIDTH as SMALL
    from test_scan import Cell

    (tmp_path / "cell").mkdir()
    cell = Cell(tmp_path / "cell")
    text = cell.path.read_text()
    section = f'[projector]\nbackend = "window"\nx = {X}\nwidth = {SMALL}\nheight = {LOW}\nlatency_s = 0.0\n'
    cell.path.write_text(text[: text.index("[projector]")] + section + text[text.index("[scan]") :])

    def pull_the_plug(what):
        if what == "taking artefact-2":
            screen[0].kill()
            screen[0].wait()

    with cell.controller:
        with pytest.raises(DeviceError, match=r"gone|display"):
            cell.scan(tell=pull_the_plug)
        assert cell.kept() == ["artefact-1"]
        other, name = start_screen(tmp_path)
        try:
            monkeypatch.setenv("DISPLAY", name)
            assert cell.scan(resume=True).whole == 3
        finally:
            other.kill()
            other.wait()
        cell.assert_whole()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_window_killed_or_stuck(screen, number, monkeypatch):
    """A window that hangs, as it does behind an X server that hangs, ends in a time-out, however often it is asked."""
    projector = backend("projector", "window")
    with projector(projector.Settings(x=X, width=WIDTH, height=HEIGHT)) as device:
        device.show(flat_pattern(9, WIDTH, HEIGHT))
        monkeypatch.setattr(window, "SHOW_S", 0.5)
        device._process.send_signal(number)
        start = time.monotonic()
        with pytest.raises(DisplayGone if number == signal.SIGKILL else DeviceTimeout):
            device.show(flat_pattern(9, WIDTH, HEIGHT))
        with pytest.raises(DisplayGone):
            for _ in range(3):
                device.show(flat_pattern(9, WIDTH, HEIGHT))
        assert time.monotonic() - start < 5.0


def test_ctrl_c_is_for_the_scan_and_not_for_its_window(screen):
    projector = backend("projector", "window")
    with projector(projector.Settings(x=X, width=WIDTH, height=HEIGHT)) as device:
        device._process.send_signal(signal.SIGINT)
        time.sleep(0.1)
        device.show(flat_pattern(9, WIDTH, HEIGHT))
    assert device._process.returncode == 0


def test_window_outside_of_the_desktop(screen):
    projector = backend("projector", "window")
    with pytest.raises(DisplayGone, match="outside"):
        projector(projector.Settings(x=X + 1, width=WIDTH, height=HEIGHT))


def test_no_display(monkeypatch):
    pytest.importorskip("pygame", reason="pygame-ce is not installed")
    monkeypatch.setenv("DISPLAY", ":4711")
    monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
    projector = backend("projector", "window")
    with pytest.raises(DisplayGone):
        projector(projector.Settings())


@pytest.mark.parametrize("driver", window.NO_DISPLAY)
def test_a_display_that_nobody_can_see_is_none(monkeypatch, driver):
    pytest.importorskip("pygame", reason="pygame-ce is not installed")
    monkeypatch.setenv("SDL_VIDEODRIVER", driver)
    projector = backend("projector", "window")
    with pytest.raises(DisplayGone, match="no display here"):
        projector(projector.Settings(width=64, height=40))
