"""Whole commands on sessions that are wrong in one way each: one clear line, the right exit code, nothing half-done."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from small_cell import small_scanner
from weldscan.faces.cli.app import main
from weldscan.simulated import DEFAULT, simulate_session

CELL = replace(DEFAULT, scanner=small_scanner(2), artefact_shots=2)
WIDTH, HEIGHT = CELL.scanner.camera.width, CELL.scanner.camera.height


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A session that is right: the demo's cell with a quarter of the pixels."""
    folder = tmp_path_factory.mktemp("cell") / "session"
    return folder, simulate_session(folder, CELL)


@pytest.fixture
def session(recorded, tmp_path):
    """A copy of it to spoil, its images linked."""
    whole, copy = recorded[0], tmp_path / "session"
    for path in whole.rglob("*.*"):
        target = copy / path.relative_to(whole)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to(path)
    return copy


@pytest.fixture
def run(monkeypatch, capfd, tmp_path):
    """Runs a command; gives its exit code, stdout and stderr without progress."""

    def run(*arguments):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["weldscan", *map(str, arguments)])
        try:
            main()
            code = 0
        except SystemExit as exit_:
            code = exit_.code or 0
        said = capfd.readouterr()
        return code, said.out, [line for line in said.err.splitlines() if not line.startswith("{")]

    return run


def result(tmp_path):
    return json.loads((tmp_path / "session-report" / "result.json").read_text())


def respell(session, change):
    """Rewrites session.json, changed."""
    path = session / "session.json"
    document = json.loads(path.read_text())
    change(document)
    path.unlink()
    path.write_text(json.dumps(document))


def test_the_session_itself_is_right(recorded, session, run, tmp_path):
    code, out, complaints = run("inspect", session)
    assert (code, complaints) == (0, []) and out.startswith("PASS")
    found, truth = result(tmp_path)["step_mm"], recorded[1]["step_mm"]
    # The statement itself is under test here, not the method: what is said must cover the truth.
    assert abs(found["max_abs"] - abs(truth["max_abs"])) <= found["expanded_uncertainty"]


def png(image):
    return cv2.imencode(".png", image)[1].tobytes()


GREY = np.full((HEIGHT, WIDTH), 90, np.uint8)


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("part-1/003.png", None, "no such image"),
        ("part-1/003.png", png(GREY)[:-60], "is truncated"),
        ("artefact-2/000.png", b"", "is empty"),
        ("artefact-2/011.png", b"BM123", "is not a PNG image"),
        ("part-2/007.png", png(GREY[:, :-1]), f"is {WIDTH - 1}x{HEIGHT} pixels, but the camera has {WIDTH}x{HEIGHT}"),
        ("part-2/007.png", png(np.dstack([GREY] * 3)), "is colour, but should be grey (one channel)"),
        ("part-2/007.png", png(GREY.astype(np.uint16)), "is of 16 bits, while the shot's first image is of 8"),
    ],
)
def test_a_wrong_image(session, run, tmp_path, name, data, says):
    path = session / "shots" / name
    path.unlink()
    if data is not None:
        path.write_bytes(data)
    code, out, complaints = run("inspect", session)
    assert (code, out, len(complaints)) == (2, "", 1)
    assert complaints[0].startswith(f"weldscan: {path}: {says}")
    assert [path.name for path in tmp_path.iterdir()] == ["session"]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda d: d.pop("scanner"), "scanner: missing"),
        (lambda d: d.update(operator="me"), "operator: unknown field"),
        (lambda d: d["shots"][3]["flange_pose"].update(B=float("nan")), "shots.3.flange_pose.B: NaN is not a number"),
        (lambda d: d["fringes"][1].update(steps=2), "fringes.1.steps: should be greater than or equal to 3, not 2"),
        (lambda d: d["fringes"][2].update(periods=8), "fringes.2.periods: 8 is there twice on axis x"),
        (
            lambda d: d["fringes"][0].update(periods=2),
            "fringes: fringe periods: must be a list that counts",
        ),
        (lambda d: d["part"].update(wall_thickness=400.0), "part: wall_thickness: 400 mm is not less than"),
    ],
)
def test_a_wrong_field(session, run, tmp_path, change, says):
    respell(session, change)
    code, out, complaints = run("inspect", session)
    assert (code, out, len(complaints)) == (2, "", 1)
    assert complaints[0].startswith(f"weldscan: {session / 'session.json'}: {says}")
    assert [path.name for path in tmp_path.iterdir()] == ["session"]


def test_another_plate_than_the_one_touched(session, run, tmp_path):
    def stretch(document):
        document["artefact"]["centres_base"][0][0] += 3.0

    respell(session, stretch)
    code, out, complaints = run("inspect", session)
    assert (code, out, len(complaints)) == (2, "", 1)
    assert "session.json: artefact.centres_base: " in complaints[0] and " mm" in complaints[0]
    assert [path.name for path in tmp_path.iterdir()] == ["session"]


def test_a_shot_without_its_three_spheres_is_left_out_and_named(session, run, tmp_path):
    for path in (session / "shots" / "artefact-1").iterdir():
        path.unlink()
        path.write_bytes(png(GREY))
    code, out, _ = run("inspect", session)
    assert code == 0 and "left out artefact-1: " in out
    assert [entry["shot"] for entry in result(tmp_path)["left_out"]] == ["artefact-1"]
    for path in (session / "shots" / "artefact-2").iterdir():
        path.unlink()
        path.write_bytes(png(GREY))
    code, out, _ = run("inspect", session)
    assert code == 5 and out.startswith("NOT MEASURED") and "artefact-2" in out
    assert result(tmp_path)["step_mm"]["max_abs"] is None


def test_flat_images_are_not_measured(session, run, tmp_path):
    for shot in ("part-1", "part-2"):
        for path in (session / "shots" / shot).iterdir():
            path.unlink()
            path.write_bytes(png(GREY))
    code, out, complaints = run("inspect", session)
    assert (code, complaints) == (5, []) and out.startswith("NOT MEASURED") and "part-1" in out
    assert result(tmp_path)["verdict"] == "NOT MEASURED"


@pytest.mark.parametrize("aside_mm", [150.0, -150.0])
def test_a_scan_of_one_wall_alone_is_not_measured(run, tmp_path, aside_mm):
    simulate_session(
        tmp_path / "session", replace(CELL, part_aside_mm=aside_mm, artefact_shots=1, part_at_deg=(170.0,))
    )
    code, out, complaints = run("inspect", tmp_path / "session")
    assert (code, complaints) == (5, []) and out.startswith("NOT MEASURED")


def test_a_mirrored_plate_is_refused(run, tmp_path):
    simulate_session(tmp_path / "session", replace(CELL, mirrored=True, part_at_deg=(170.0,)))
    code, _, complaints = run("inspect", tmp_path / "session")
    assert code == 2 and len(complaints) == 1 and "mirrored" in complaints[0]


def test_without_a_robot_one_shot_is_measured_in_the_scanners_frame(run, tmp_path):
    truth = simulate_session(tmp_path / "session", replace(CELL, robot=None, artefact_shots=0, part_at_deg=(170.0,)))
    code, _, complaints = run("inspect", tmp_path / "session")
    assert (code, complaints) == (0, [])
    found = result(tmp_path)
    assert found["frame"] == "scanner" and found["hand_eye"] is None
    assert (
        abs(found["step_mm"]["max_abs"] - abs(truth["step_mm"]["max_abs"])) <= found["step_mm"]["expanded_uncertainty"]
    )


def test_a_kept_hand_eye_calibration_serves_another_session(session, run, tmp_path):
    assert run("calibrate", "hand-eye", session, "--out", "hand-eye.json")[0] == 0
    kept = json.loads((tmp_path / "hand-eye.json").read_text())
    assert kept["schema"] == "weldscan-hand-eye/1"

    def carry(document):
        del document["artefact"]
        document["hand_eye"] = kept
        document["shots"] = [shot for shot in document["shots"] if shot["of"] == "part"]

    code = run("inspect", session)[0]
    before = result(tmp_path)
    respell(session, carry)
    assert run("inspect", session)[0] == code == 0
    after = result(tmp_path)
    assert after["hand_eye"]["id"] == kept["id"]
    assert after["step_mm"]["max_abs"] == pytest.approx(before["step_mm"]["max_abs"], abs=1e-6)


def test_probed_points_lie_on_the_scanned_surface(session, run):
    code, out, complaints = run("validate", session, "--touch", session / "touch.csv")
    assert (code, complaints) == (0, []) and "probed points: rms 0.0" in out
    (session / "bad.csv").write_text("x_mm,y_mm,z_mm\n1,2\n")
    code, out, complaints = run("validate", session, "--touch", session / "bad.csv", "--out", "elsewhere")
    assert (code, out) == (2, "") and complaints == [
        f"weldscan: {session / 'bad.csv'}: line 2: '1,2' is not three numbers"
    ]


def test_the_demo_can_be_repeated(run, tmp_path, monkeypatch):
    monkeypatch.setattr("weldscan.simulated.DEFAULT", CELL)
    monkeypatch.setattr(simulate_session, "__defaults__", (CELL, None))
    for _ in range(2):
        code, out, complaints = run("demo", "--out", "demo")
        assert (code, complaints) == (0, []) and "truth: largest" in out
    assert sorted(path.name for path in (tmp_path / "demo").iterdir()) == ["report", "session"]
    assert [path.name for path in tmp_path.iterdir()] == ["demo"]
