"""The documents: files of earlier versions are read on; whatever else stands in a file's place ends in one line."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import shutil
import socket
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import weldscan as ws
from synthetic import hand_eye
from weldscan.faces.cli.app import main

DATA = Path(__file__).parents[1] / "data" / "documents-281640f"
MOVED = Path(__file__).parents[2] / "docs" / "moved.csv"
BOARD = "chessboard:9x6:10mm"
MOUNT = "58 -24 112 109 -20 -8"
LIMITS = "pf_mm = 0.5\nsd_mm = 0.15\n"
CELL = """
[robot]
link = "kvp"
host = "127.0.0.1"
port = 9

[camera]
backend = "folder"
folder = "images"

[projector]
backend = "files"
folder = "shown"
width = 8
height = 6
refresh_hz = 60.0

[scan]
plan = "plan.json"
"""
CAPTURES = {
    "schema": "weldscan-calibration/1",
    "projector": {"width": 64, "height": 64},
    "fringes": [{"axis": axis, "periods": 1.0, "steps": 3} for axis in ("x", "y")],
    "board": BOARD,
}


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """One folder with a good file of every kind, which is the working folder."""
    shutil.copytree(DATA, tmp_path, dirs_exist_ok=True)
    shutil.copytree(DATA / "session", tmp_path / "named")
    document = json.loads((DATA / "session" / "session.json").read_text())
    del document["artefact"]
    document |= {"scanner": "scanner.json", "hand_eye": "hand-eye.json", "shots": document["shots"][1:]}
    (tmp_path / "named" / "session.json").write_text(json.dumps(document))
    shutil.copy(DATA / "hand-eye.json", tmp_path / "named")
    scanner = json.loads((DATA / "session" / "session.json").read_text())["scanner"]
    (tmp_path / "named" / "scanner.json").write_text(json.dumps(scanner))
    (tmp_path / "limits.toml").write_text(LIMITS)
    (tmp_path / "cell.toml").write_text(CELL)
    shutil.copy(DATA / "session" / "session.json", tmp_path / "plan.json")
    (tmp_path / "touch.csv").write_text("x_mm,y_mm,z_mm\n1,2,3\n")
    for folder, names in (
        ("captures/shots/p1", [f"{i:03d}" for i in range(6)]),
        ("calseq/calseq0", [f"frameSeq_{i:02d}" for i in range(12)]),
        ("ramp", [f"ramp_{level:03d}" for level in range(0, 256, 15)]),
        ("images", ["000"]),
    ):
        (tmp_path / folder).mkdir(parents=True)
        for name in names:
            shutil.copy(DATA / "session/shots/artefact-1/000.png", tmp_path / folder / f"{name}.png")
    (tmp_path / "captures" / "calibration.json").write_text(json.dumps(CAPTURES))
    (tmp_path / "calseq" / "calibration.xml").write_text("<screenResX>64</screenResX><screenResY>64</screenResY>")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, list[str]]:
    """The exit code of a command and the lines that it complains in."""
    capsys.readouterr()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["weldscan", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("{")]
    return int(ended.value.code or 0), lines


def told(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    """The exit code of a command and the one line that it complains in."""
    code, lines = run(capsys, *arguments)
    assert len(lines) == 1, lines
    return code, lines[0]


SCAN = ("scan", "--config", "cell.toml", "--out", "scanned")
# What a command reads: the file, and the command that comes upon it first.
JSON = {
    "a session": ("session/session.json", ("inspect", "session")),
    "a session to verify by": ("session/session.json", ("verify", "session")),
    "a session to validate": ("session/session.json", ("validate", "session", "--touch", "touch.csv")),
    "a session for the hand-eye": ("session/session.json", ("calibrate", "hand-eye", "session")),
    "a session for the response": ("session/session.json", ("calibrate", "response", "session")),
    "a session to plan by": ("session/session.json", ("calibrate", "plan", "session", "--mount", MOUNT)),
    "a session's scanner": ("named/scanner.json", ("inspect", "named")),
    "a plan's scanner": ("named/scanner.json", ("calibrate", "plan", "named", "--mount", MOUNT)),
    "a session's hand-eye": ("named/hand-eye.json", ("inspect", "named")),
    "a hand-eye to plan by": ("hand-eye.json", ("calibrate", "plan", "session", "--hand-eye", "hand-eye.json")),
    "a response": ("response.json", ("inspect", "session", "--response", "response.json")),
    "captures": ("captures/calibration.json", ("calibrate", "scanner", "captures")),
    "a plan to scan by": ("plan.json", SCAN),
}
TOML = {
    "limits": ("limits.toml", ("verify", "session", "--limits", "limits.toml")),
    "a cell to scan with": ("cell.toml", SCAN),
    "a cell to ask": ("cell.toml", ("robot", "pose", "--config", "cell.toml")),
    "a cell to project with": ("cell.toml", ("project", "--config", "cell.toml")),
    "a cell to check": ("cell.toml", ("devices", "check", "--config", "cell.toml")),
    "a cell to look with": ("cell.toml", ("camera", "preview", "--config", "cell.toml", "--out", "p.png")),
    "a cell to calibrate with": ("cell.toml", ("calibrate", "scanner", "new", "--live", "--config", "cell.toml")),
}
OTHERS = {
    "a history": ("verification.jsonl", ("inspect", "session", "--history", "verification.jsonl")),
    "a history to add to": (
        "verification.jsonl",
        ("verify", "session", "--limits", "limits.toml", "--history", "verification.jsonl"),
    ),
    "probed points": ("touch.csv", ("validate", "session", "--touch", "touch.csv")),
    "an image": ("session/shots/artefact-1/003.png", ("inspect", "session")),
    "an image to verify by": ("session/shots/artefact-1/003.png", ("verify", "session")),
    "an image of a board": ("captures/shots/p1/003.png", ("calibrate", "scanner", "captures")),
    "an image of a ramp": ("ramp/ramp_030.png", ("calibrate", "response", "ramp")),
    "an image of SLStudio": ("calseq/calseq0/frameSeq_03.png", ("calibrate", "scanner", "calseq", "--board", BOARD)),
    "SLStudio's size": ("calseq/calibration.xml", ("calibrate", "scanner", "calseq")),
    "a plan in the way": ("plan.json", ("calibrate", "plan", "session", "--mount", MOUNT, "--out", "plan.json")),
    "a page in the way": (
        "page.html",
        ("calibrate", "plan", "session", "--mount", MOUNT, "--out", "new.json", "--page", "page.html"),
    ),
    "a scanner in the way": ("sc.json", ("calibrate", "scanner", "captures", "--out", "sc.json")),
}
ONE_OF_A_KIND = ("a session", "a session's scanner", "a response", "captures", "limits", "a history", "an image")


def a_pipe(path: Path) -> None:
    os.mkfifo(path)


def a_link_to_zero(path: Path) -> None:
    path.symlink_to("/dev/zero")


def a_folder(path: Path) -> None:
    path.mkdir()


def a_socket(path: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)  # a socket's path is short
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(path.name)
    os.chdir(here)


def a_gigabyte(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 30)


def a_circle(path: Path) -> None:
    path.symlink_to(path.name)


@pytest.mark.timeout(60)
@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names here")
@pytest.mark.parametrize(
    ("name", "what"),
    [
        *((name, what) for name in [*JSON, *TOML, *OTHERS] for what in (a_pipe, a_link_to_zero)),
        *((name, what) for name in ONE_OF_A_KIND for what in (a_folder, a_socket, a_gigabyte, a_circle)),
    ],
)
def test_what_is_no_file_of_such_a_size_is_refused_at_once(place, capsys, name, what):
    file, command = (JSON | TOML | OTHERS)[name]
    path = place / file
    path.unlink(missing_ok=True)
    what(path)
    code, line = told(capsys, *command)
    assert code == 2 and Path(file).name in line, line


def nested(text: str) -> str:
    return text[:-1] + ', "x": ' + "[" * 100_000 + "]" * 100_000 + "}"


def nested_enough(text: str) -> str:
    """Not too deep for any parser, but for those who walk through what they were given."""
    return text[:-1] + ', "x": ' + '{"x":' * 300 + "0" + "}" * 300 + "}"


def doubled(text: str) -> str:
    return '{"name": 1, "name": 2, ' + text[1:]


def doubled_within(text: str) -> str:
    return text[:-1] + ', "x": {"y": {"z": 1, "z": 1}}}'


def cut(text: str) -> str:
    return text[: len(text) // 2]


def latin(text: str) -> bytes:
    return text[:-1].encode() + b', "x": "\xe9"}'


def long_number(text: str) -> str:
    return text[:-1] + ', "x": ' + "9" * 5000 + "}"


def lone_half(text: str) -> str:
    return text[:-1] + r', "x": "\ud800"}'


JSON_FAULTS = [nested, nested_enough, doubled, doubled_within, cut, latin, long_number, lone_half]


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        *((name, fault) for name in JSON for fault in JSON_FAULTS),
        *((name, text) for name in ONE_OF_A_KIND if name in JSON for text in ("", "null", "[]", "3", '"name"')),
    ],
)
def test_what_is_no_document_is_one_line(place, capsys, name, fault):
    file, command = JSON[name]
    path = place / file
    text = path.read_text().strip()
    spoiled = fault if isinstance(fault, str) else fault(text)
    path.write_bytes(spoiled if isinstance(spoiled, bytes) else spoiled.encode())
    code, line = told(capsys, *command)
    if fault is lone_half and name.endswith("to plan by") and "session" in file:
        assert code in (0, 2), line  # all else in the file is not looked at
        return
    assert code == 2 and file in line, line
    if fault in (nested, nested_enough):
        assert line.endswith("is nested too deeply")
    if fault in (doubled, doubled_within):
        assert line.endswith("the field is there twice")


TOML_FAULTS = {
    "lists": "x = " + "[" * 20_000 + "]" * 20_000,
    "some lists": "x = " + "[" * 200 + "]" * 200,
    "tables": "x = " + "{x=" * 15_000 + "1" + "}" * 15_000,
    "a name of many dots": ".".join("x" * 20_000) + " = 1",
    "a heading of many dots": "[" + ".".join("x" * 20_000) + "]",
    "too much": "# " + "x" * 300_000,
    "a long number": "x = " + "9" * 5000,
    "bytes": b"x = '\xe9'",
    "a NUL": "x = '\0'",
}


@pytest.mark.timeout(60)
@pytest.mark.parametrize("fault", TOML_FAULTS)
@pytest.mark.parametrize("name", TOML)
def test_what_is_no_configuration_is_one_line(place, capsys, name, fault):
    file, command = TOML[name]
    text = TOML_FAULTS[fault]
    before = text + b"\n" if isinstance(text, bytes) else text.encode() + b"\n"
    (place / file).write_bytes(before + (place / file).read_bytes())
    code, line = told(capsys, *command)
    assert code == 2 and file in line, line


@pytest.mark.parametrize("host", ["a..b", "ä..b", "", ".", "x" * 64, "a\\u0000b"])
@pytest.mark.parametrize("link", ["kvp", "eki"])
def test_a_host_that_cannot_be_looked_up_is_named(place, capsys, link, host):
    (place / "cell.toml").write_text(CELL.replace("127.0.0.1", host).replace('"kvp"', f'"{link}"'))
    code, line = told(capsys, "robot", "pose", "--config", "cell.toml")
    assert code == 2 and "cell.toml: robot: host: should be a host's name or address" in line
    if "\\" not in host:
        code, line = told(capsys, "robot", "simulate", "--link", link, "--host", host or "..", "--port", "0")
        assert code == 2 and "--host: should be" in line


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("centres_base_mm", [[1.0, 2.0, 3.0], [4.0, 5.0], [6.0]]),
        ("centres_base_mm", []),
        ("centres_base_mm", [[1.0, 2.0, 3.0, 4.0]] * 3),
        ("covariance", [[1.0] * 6] * 5 + [[1.0]]),
        ("flange_from_scanner", [[1.0, 0.0], [0.0]]),
        ("probe_bias_mm", [1.0]),
        ("tilts_deg", [1.0]),
    ],
)
def test_a_ragged_field_of_the_hand_eye_is_named(place, capsys, field, value):
    path = place / "named" / "hand-eye.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {field: value}))
    code, line = told(capsys, "inspect", "named")
    assert code == 2 and f"hand-eye.json: {field}" in line


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("artefact.centres_base", [[1.0, 2.0, 3.0], [4.0, 5.0], [6.0]]),
        ("scanner.camera.K", [[1.0], [2.0, 3.0], []]),
        ("scanner.camera_from_projector", [[1.0, 0.0], [0.0]]),
        ("scanner.covariance", {"parameters": ["x", "y"], "matrix": [[1.0], [1.0, 2.0]]}),
    ],
)
@pytest.mark.parametrize("command", [("inspect", "session"), ("calibrate", "plan", "session", "--mount", MOUNT)])
def test_a_ragged_field_of_the_session_is_named(place, capsys, field, value, command):
    path = place / "session" / "session.json"
    document = json.loads(path.read_text())
    holder = document
    *parents, last = field.split(".")
    for parent in parents:
        holder = holder[parent]
    holder[last] = value
    path.write_text(json.dumps(document))
    code, line = told(capsys, *command)
    assert code == 2 and f"session.json: {field}" in line


@pytest.mark.parametrize("name", ["a\0b", "x" * 5000, "circle", "../hand-eye.json", "/etc/hostname", "\ud800"])
@pytest.mark.parametrize("field", ["scanner", "hand_eye"])
@pytest.mark.parametrize("command", [("inspect", "named"), ("calibrate", "plan", "named")])
def test_a_name_that_no_file_has_is_one_line(place, capsys, field, name, command):
    (place / "named" / "circle").symlink_to("circle")
    path = place / "named" / "session.json"
    document = json.loads(path.read_text()) | {field: name}
    document["artefact"] = json.loads((DATA / "session" / "session.json").read_text())["artefact"]
    path.write_text(json.dumps(document))
    code, line = told(capsys, *command)
    assert code == 2 and "named/" in line


@pytest.mark.timeout(60)
@pytest.mark.parametrize("what", [a_pipe, a_link_to_zero, a_folder])
@pytest.mark.parametrize("file", ["shots/artefact-1/shot.json", "shots/artefact-1/003.png", "plan.json"])
def test_a_recorded_shot_that_is_no_file_is_no_fault_of_weldscan(place, capsys, file, what):
    path = place / "scan" / file
    path.unlink()
    what(path)
    code, lines = run(capsys, "inspect", "scan")
    assert code in (2, 4, 5) and len(lines) <= 1, lines


@pytest.mark.timeout(60)
@pytest.mark.parametrize("what", [a_pipe, a_link_to_zero])
@pytest.mark.parametrize("file", [".scan.lock", "scan.log", "plan.json"])
def test_a_folder_to_scan_into_may_hold_no_pipe(place, capsys, file, what):
    (place / "scanned").mkdir()
    what(place / "scanned" / file)
    code, line = told(capsys, *SCAN)
    assert code == 2 and "scanned" in line


@pytest.mark.timeout(60)
@pytest.mark.parametrize("what", [a_pipe, a_link_to_zero, a_folder])
def test_an_earlier_result_that_is_no_file_is_not_replaced(place, capsys, what):
    (place / "out").mkdir()
    what(place / "out" / "result.json")
    code, line = told(capsys, "inspect", "session", "--out", "out")
    assert code == 2 and "holds something else" in line


@pytest.mark.timeout(60)
@pytest.mark.parametrize("what", [a_pipe, a_link_to_zero, a_folder, a_gigabyte])
def test_a_result_that_is_no_file_is_refused(tmp_path, what):
    what(tmp_path / "result.json")
    with pytest.raises(ws.InputError, match=r"result\.json"):
        ws.read_result(tmp_path)


@pytest.mark.timeout(60)
@pytest.mark.parametrize("what", [a_pipe, a_link_to_zero, a_folder, a_gigabyte])
def test_a_hand_eye_does_not_go_where_no_hand_eye_is(tmp_path, what):
    from weldscan.records.hand_eye import write_hand_eye

    what(tmp_path / "hand-eye.json")
    with pytest.raises(ws.InputError, match=r"hand-eye\.json: exists and is no hand-eye calibration"):
        write_hand_eye(tmp_path / "hand-eye.json", hand_eye())


def test_a_result_with_a_doubled_field_is_refused(tmp_path):
    (tmp_path / "result.json").write_text(doubled((DATA / "result.json").read_text().strip()))
    with pytest.raises(ws.InputError, match="the field is there twice"):
        ws.read_result(tmp_path)


def test_a_line_of_a_history_with_a_doubled_field_does_not_count(tmp_path):
    lines = (DATA / "verification.jsonl").read_text().splitlines()
    spoiled = lines[-1][:-1] + ', "verdict": ' + json.dumps(json.loads(lines[-1])["verdict"]) + "}"
    (tmp_path / "history").write_text("\n".join([*lines[:-1], spoiled, ""]))
    found = ws.read_history(tmp_path / "history")
    assert len(found.records) == len(lines) - 1 and found.broken is not None


# --- one way out ------------------------------------------------------------------------------------------------------


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path, monkeypatch):
    from weldscan.records.files import write_file

    path = tmp_path / "a.json"
    write_file(path, "old")
    write_file(path, b"new")
    assert path.read_bytes() == b"new" and list(tmp_path.iterdir()) == [path]
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(ws.InputError, match=r"a\.json: cannot be written: No space left"):
        write_file(path, "half")
    assert path.read_bytes() == b"new" and list(tmp_path.iterdir()) == [path]


def test_what_is_written_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    from weldscan.records import files

    synced: list[int] = []
    original = os.fsync

    def fsync(descriptor: int) -> None:
        synced.append(os.fstat(descriptor).st_ino)
        original(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    with files.whole_folder(tmp_path / "out") as partial:
        (partial / "below").mkdir()
        files.write_synced(partial / "below" / "a", "1", b"2")
        assert not (tmp_path / "out").exists()
        inside = {path.stat().st_ino for path in (partial, partial / "below", partial / "below" / "a")}
    assert (tmp_path / "out" / "below" / "a").read_text() == "12"
    assert inside < set(synced) and tmp_path.stat().st_ino == synced[-1]


# --- files of 281640f -------------------------------------------------------------------------------------------------


def test_a_session_of_281640f_is_read():
    session = ws.read_session(DATA / "session")
    assert [shot.name for shot in session.shots] == ["artefact-1", "part-1"]
    assert [len(row) for row in ws.read_frames(session, session.shots[1])] == [7, 7]
    scan = ws.read_session(DATA / "scan")
    assert [shot.name for shot in scan.shots] == ["artefact-1", "artefact-2", "part-1"]


def test_shots_of_281640f_are_whole():
    from weldscan.records.plan import planned
    from weldscan.records.shot import faults, read_manifest

    assert faults(DATA / "scan") == ()
    plan = planned(DATA / "scan")
    assert plan is not None and [shot.name for shot in plan.shots] == ["artefact-1", "artefact-2", "part-1"]
    assert set(read_manifest(DATA / "scan" / "shots" / "part-1").record) >= {"started"}


def test_a_scanner_of_281640f_is_read():
    scanner = ws.read_scanner(DATA / "scanner.json")
    assert scanner.covariance is not None and len(scanner.covariance.parameters) == 22
    lens = scanner.build().camera
    assert abs(lens.K[0, 0] - json.loads((DATA / "scanner.json").read_text())["camera"]["K"][0][0]) == 0


def test_a_hand_eye_of_281640f_is_read():
    from weldscan.records.hand_eye import read_hand_eye

    found = read_hand_eye(DATA / "hand-eye.json")
    held = json.loads((DATA / "hand-eye.json").read_text())
    assert np.array_equal(found.flange_from_scanner, held["flange_from_scanner"])
    assert np.array_equal(found.centres_base_mm, held["centres_base_mm"]) and len(found.per_shot) == 5


def test_a_history_of_281640f_is_read():
    found = ws.read_history(DATA / "verification.jsonl")
    assert found.broken is None and found.notes == () and len(found.records) == 2
    assert set(found.records[0].characteristics) == {"PF", "PS", "SD", "F"}


def test_a_result_of_281640f_is_read():
    found = ws.read_result(DATA / "result.json")
    held = json.loads((DATA / "result.json").read_text())
    assert found["schema"] == "weldscan-result/1" and found["verdict"] == held["verdict"] == "PASS"
    assert found["step_mm"]["max_abs"] == held["step_mm"]["max_abs"]
    assert found["verification"]["state"] == "none" and found["bars"] == []


def test_a_response_of_281640f_is_read():
    response = ws.read_response(DATA / "response.json")
    assert response.light == (10.0, 20.0, 60.0, 120.0, 210.0)
    assert response.document()["id"] == json.loads((DATA / "response.json").read_text())["id"]


def test_a_plan_of_281640f_is_read_and_may_be_replaced():
    from weldscan.records.plan import check_plan, read_plan, read_source

    path = DATA / "hand-eye-plan.json"
    assert len(read_plan(path).shots) == len(read_source(path).shots) == 5
    check_plan(path)


def test_a_verification_of_281640f_may_be_replaced(tmp_path):
    from weldscan.records.verification import is_verification

    shutil.copy(DATA / "verification.json", tmp_path)
    assert is_verification(tmp_path)
    (tmp_path / "mine").touch()
    assert not is_verification(tmp_path)


# --- what moved -------------------------------------------------------------------------------------------------------


def rows() -> list[dict[str, str]]:
    with MOVED.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def found(dotted: str) -> object:
    """What a dotted name leads to. Raises ImportError."""
    module, _, name = dotted.rpartition(".")
    try:
        return getattr(import_module(module), name)
    except AttributeError as error:
        raise ImportError(f"no {dotted}") from error


def test_what_moved_is_where_the_table_says():
    table = rows()
    assert len(table) > 60 and len({row["old"] for row in table}) == len(table)
    for row in table:
        moved = found(row["new"])
        with contextlib.suppress(ImportError):  # where it stood it may be used on, but no other may stand there
            assert found(row["old"]) is moved, row
