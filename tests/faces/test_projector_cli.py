"""`weldscan project`, `camera` and `devices check`, on files and on the simulated cell."""

import json

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from weldscan import InputError, response_of_folder
from weldscan.devices.projectors.patterns import fringe_patterns
from weldscan.faces.cli.station import register
from weldscan.records.response import measured, read_response


@pytest.fixture
def run():
    app = typer.Typer()
    register(app)
    return lambda *words, **options: CliRunner().invoke(app, words, **{"catch_exceptions": False} | options)


def test_project_into_files(tmp_path, run):
    config = tmp_path / "cell.toml"
    config.write_text('[projector]\nbackend = "files"\nfolder = "%s"\nwidth = 64\nheight = 40\n' % (tmp_path / "out"))
    for number, (pattern, level) in enumerate([("white", 255), ("black", 0), ("17", 17)]):
        run("project", "--config", str(config), "--pattern", pattern, "--hold", "0.001")
        image = cv2.imread(str(tmp_path / "out" / "000.png"), cv2.IMREAD_UNCHANGED)
        assert (image == level).all(), number
    for pattern in ("grey", "256", "-1"):
        result = run("project", "--config", str(config), "--pattern", pattern, catch_exceptions=True)
        assert isinstance(result.exception, InputError)


def test_project_the_fringes_of_a_plan(tmp_path, run):
    from test_scan import FRINGES, HEIGHT, WIDTH, plan_document

    (tmp_path / "plan.json").write_text(json.dumps(plan_document()))
    config = tmp_path / "cell.toml"
    config.write_text(
        f'[projector]\nbackend = "files"\nfolder = "{tmp_path / "out"}"\nwidth = {WIDTH}\nheight = {HEIGHT}\n'
        '[scan]\nplan = "plan.json"\n'
    )
    run("project", "--config", str(config), "--pattern", "all", "--hold", "0.001")
    for number, pattern in enumerate(fringe_patterns(FRINGES, WIDTH, HEIGHT)):
        image = cv2.imread(str(tmp_path / "out" / f"{number:03d}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(image, pattern)


def test_camera_preview(tmp_path, run):
    image = np.full((40, 64), 100, np.uint8)
    image[:10], image[30:] = 255, 0
    cv2.imwrite(str(tmp_path / "scene.png"), image)
    config = tmp_path / "cell.toml"
    config.write_text(f'[camera]\nbackend = "folder"\nfolder = "{tmp_path}"\n')
    out = tmp_path / "preview" / "view.png"
    out.parent.mkdir()
    result = run("camera", "preview", "--config", str(config), "--out", str(out), "--count", "1")
    assert "saturated 25.00%, dark 25.00%" in result.stdout
    seen = cv2.imread(str(out))
    assert (seen[0, 0] == (0, 0, 255)).all()
    assert (seen[20, 0] == 100).all()
    assert seen[39, 0, 0] > 0
    assert seen[39, 0, 2] == 0


def test_camera_list(run):
    listed = run("camera", "list").stdout
    assert {line.split()[0] for line in listed.splitlines()} == {"opencv", "aravis", "pylon", "folder", "simulated"}


def test_devices_check_of_the_simulated_cell(tmp_path, run):
    config = tmp_path / "cell.toml"
    config.write_text('[camera]\nbackend = "simulated"\n[projector]\nbackend = "simulated"\n')
    out = tmp_path / "response.json"
    ramp = tmp_path / "ramp"
    printed = run("devices", "check", "--config", str(config), "--out", str(out), "--ramp", str(ramp)).stdout
    assert "2 refreshes" in printed
    response = read_response(out).table()
    assert np.abs(response - np.arange(256) / 255).max() < 0.02  # this cell's light is linear
    assert np.abs(response_of_folder(ramp).table() - response).max() < 0.01


def test_devices_check_measures_the_projector_itself(tmp_path, run):
    """A table that is applied already would make the next one straight."""
    config = tmp_path / "cell.toml"
    config.write_text(
        '[camera]\nbackend = "simulated"\n[projector]\nbackend = "simulated"\nresponse = "response.json"\n'
    )
    bent = measured([0, 128, 255], [0.0, 10.0, 200.0])
    (tmp_path / "response.json").write_text(json.dumps(bent.document()))
    run("devices", "check", "--config", str(config))
    assert np.abs(read_response(tmp_path / "response.json").table() - np.arange(256) / 255).max() < 0.02


@pytest.mark.parametrize("words", [("devices", "check"), ("camera", "preview")])
def test_where_nothing_can_be_written(tmp_path, run, words):
    config = tmp_path / "cell.toml"
    config.write_text('[camera]\nbackend = "simulated"\n[projector]\nbackend = "simulated"\n')
    for out in (tmp_path / "nothing" / "there", tmp_path):
        result = run(*words, "--config", str(config), "--out", str(out), catch_exceptions=True)
        assert isinstance(result.exception, InputError)


@pytest.mark.parametrize(
    "words",
    [
        ("robot", "watch", "--every", "inf"),
        ("robot", "watch", "--every", "1e300"),
        ("project", "--hold", "inf"),
        ("project", "--pattern", "²"),
        ("project", "--pattern", "٢"),
        ("project", "--pattern", "256"),
        ("project", "--pattern", "-0"),
        ("robot", "simulate", "--speed", "inf"),
        ("robot", "simulate", "--fault", "silence:9999999999999999999"),
        ("robot", "simulate", "--fault", "silence:5_0"),
        ("robot", "simulate", "--fault", "silence:0"),
    ],
)
def test_numbers_on_the_command_line(tmp_path, run, words):
    (tmp_path / "cell.toml").write_text('[robot]\nport = 1\n[projector]\nbackend = "simulated"\n')
    config = () if words[1] == "simulate" else ("--config", str(tmp_path / "cell.toml"))
    result = run(*words, *config, catch_exceptions=True)
    assert isinstance(result.exception, InputError) or result.exit_code == 2, result.exception
