"""`weldscan robot ...`: a simulated controller in its own process, and commands that talk to it."""

import json
import signal
import subprocess
import sys

import pytest
import typer
from typer.testing import CliRunner

from weldscan import DeviceError, InputError
from weldscan.faces.cli.station import _controller, register
from weldscan.simulated.controllers import Arm
from weldscan.station.cell import read_cell

MAIN = (  # a test that runs in the background has Ctrl-C switched off, and its children with it
    "import signal, typer; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from weldscan.faces.cli.station import register; app = typer.Typer(); register(app); app()"
)
POSE = "610.825 -148.476 481.652 -29.008 23.236 74.641"


@pytest.fixture
def app():
    app = typer.Typer()
    register(app)
    return app


@pytest.fixture(params=["kvp", "eki", "rsi", "serial"])
def cell(request, tmp_path):
    """A controller in another process, and the configuration for it."""
    link = request.param
    process = subprocess.Popen(
        [sys.executable, "-c", MAIN, "robot", "simulate", "--link", link, "--pose", POSE]
        + (["--port", "64123"] if link == "rsi" else []),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        said = json.loads(process.stdout.readline())
        assert said["link"] == link
        port = f'"{said["port"]}"' if link == "serial" else said["port"]
        config = tmp_path / "cell.toml"
        config.write_text(f'[robot]\nlink = "{link}"\nport = {port}\nallow_motion = true\ntimeout_s = 3.0\n')
        yield link, config, process
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(10) == 0
        process.stdin.close()
        process.stdout.close()


def test_pose_watch_move(cell, app):
    link, config, process = cell
    run = CliRunner().invoke
    result = run(app, ["robot", "pose", "--config", str(config)], catch_exceptions=False)
    assert result.exit_code == 0
    told = json.loads(result.stdout)
    assert [told[name] for name in "XYZABC"] == pytest.approx([float(word) for word in POSE.split()], abs=1e-5)
    result = run(
        app, ["robot", "watch", "--config", str(config), "--count", "3", "--every", "0.01"], catch_exceptions=False
    )
    assert len(result.stdout.splitlines()) == 3
    target = ["611.825", "-148.476", "481.652", "-29.008", "23.236", "74.641"]
    move = ["robot", "move", "--config", str(config), *target]
    if link == "rsi":
        assert isinstance(run(app, move).exception, DeviceError)
        return
    told = json.loads(run(app, move, catch_exceptions=False).stdout)
    assert told["X"] == pytest.approx(611.825, abs=0.1)
    process.stdin.write("nan 100\n")
    process.stdin.flush()
    for _ in range(50):
        result = run(app, ["robot", "pose", "--config", str(config)])
        if result.exception:
            break
    assert isinstance(result.exception, DeviceError)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "robot: missing"),
        ("[robot]\nlink = 'kuka'", "robot.link"),
        ("[robot]\nlink = ['kvp']", "robot.link"),
        ("[robot]\nlink = 'serial'", "robot: port: missing"),
        ("robot = 'kvp'", "robot: should be an object"),
        ("[robot]\nlink = 'kvp'\nprot = 7000", "prot"),
        ("[robot]\nlink = 'kvp'\ntimeout_s = nan", "timeout_s"),
        ("[robot]\nlink = 'kvp'\nport = 70000", "port"),
        ("[robo]\n", "robo"),
        ("not toml", "not TOML"),
    ],
)
def test_wrong_configuration(tmp_path, text, complaint):
    path = tmp_path / "cell.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=complaint) as caught:
        read_cell(path).open_robot()
    assert "cell.toml" in str(caught.value)


def test_ports_of_simulated_controllers():
    with _controller("eki", Arm(), "127.0.0.1", None) as first, _controller("eki", Arm(), "127.0.0.1", None) as second:
        assert first.port != second.port  # the usual one is taken, so it takes another
        with pytest.raises(DeviceError, match=f"{first.port}: cannot listen"):
            _controller("eki", Arm(), "127.0.0.1", first.port)


@pytest.mark.parametrize(
    "words", [["--link", "kuka"], ["--mode", "T3"], ["--pose", "1 2"], ["--fault", "flood"], ["--fault", "bytes:x"]]
)
def test_wrong_words_to_the_simulator(app, words):
    assert isinstance(CliRunner().invoke(app, ["robot", "simulate", "--port", "0", *words]).exception, InputError)


def test_no_configuration(tmp_path):
    with pytest.raises(InputError, match=r"cell\.toml: no such file; weldscan scan --example-config"):
        read_cell(tmp_path / "cell.toml")


@pytest.mark.parametrize("target", [["1", "2"], ["a", "b", "c", "d", "e", "f"], ["nan", "0", "0", "0", "0", "0"]])
def test_wrong_target(app, target):
    assert isinstance(CliRunner().invoke(app, ["robot", "move", *target]).exception, InputError)
