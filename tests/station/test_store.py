"""What is on disk: nothing that was acknowledged is lost, nothing that cannot be read is called damaged."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from test_scan import POSES, Cell

from weldscan import InputError
from weldscan.errors import Unreadable
from weldscan.records import files
from weldscan.records.files import remove_unfinished, whole_folder, write_file
from weldscan.records.shot import NotUnderstood, faults
from weldscan.station import scan as scan_module
from weldscan.station import store
from weldscan.station.cell import CellConfig, read_cell
from weldscan.station.scan import scan


@pytest.fixture(scope="module")
def scanned(tmp_path_factory):
    """A whole scan, to be copied and spoiled."""
    cell = Cell(tmp_path_factory.mktemp("scanned"))
    with cell.controller:
        cell.scan()
        yield cell


@pytest.fixture
def cell(scanned, tmp_path):
    """Its own folder; the same devices."""
    again = object.__new__(Cell)
    again.__dict__ |= scanned.__dict__ | {"out": tmp_path / "out", "said": []}
    shutil.copytree(scanned.out, again.out)
    return again


def inodes(folder: Path) -> dict[str, int]:
    """Every file by its name; a file that was written anew has another number."""
    return {str(path.relative_to(folder)): path.stat().st_ino for path in folder.rglob("*") if path.is_file()}


def spoil(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[:-20] + bytes([data[-20] ^ 1]) + data[-19:])


def fail(monkeypatch: pytest.MonkeyPatch, path: Path, call: str, number: int = errno.EIO) -> None:
    """From here on the system gives that file no more."""
    real, there = getattr(os, call), path.stat()

    def failing(first, *rest):
        meant = os.fstat(first) if isinstance(first, int) else path.stat() if Path(first) == path else None
        if meant is not None and os.path.samestat(meant, there):
            raise OSError(number, os.strerror(number))
        return real(first, *rest)

    monkeypatch.setattr(files.os, call, failing)


# --- whole, different, unreadable -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("call", "number"), [("open", errno.EIO), ("read", errno.EIO), ("open", errno.EACCES)])
def test_what_cannot_be_read_stops_a_scan_that_goes_on_and_touches_nothing(cell, monkeypatch, call, number):
    before = inodes(cell.out)
    for name in before:
        if name in (".scan.lock", "scan.log", "session.json"):
            continue
        with monkeypatch.context() as moment:
            fail(moment, cell.out / name, call, number)
            with pytest.raises(Unreadable, match=os.strerror(number)) as caught:
                cell.scan(resume=True)
            assert Path(name).name in str(caught.value)
        assert inodes(cell.out) == before, name
    assert cell.scan(resume=True).set_aside == ()
    assert {name: i for name, i in inodes(cell.out).items() if "shots/" in name} == {
        name: i for name, i in before.items() if "shots/" in name
    }


def test_a_folder_that_cannot_be_listed_is_not_empty(cell, monkeypatch):
    before, real = inodes(cell.out), Path.iterdir

    def failing(folder):
        if folder == cell.out / "shots":
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return real(folder)

    with monkeypatch.context() as moment:
        moment.setattr(Path, "iterdir", failing)
        with pytest.raises(Unreadable, match="shots"):
            cell.scan(resume=True)
        with pytest.raises(Unreadable, match="shots"):
            faults(cell.out)
    assert inodes(cell.out) == before


def test_an_inspection_does_not_take_what_cannot_be_read_for_altered(cell, monkeypatch):
    fail(monkeypatch, cell.out / "shots/artefact-2/003.png", "read")
    with pytest.raises(Unreadable, match=r"003\.png"):
        faults(cell.out)


def test_a_manifest_of_another_version_is_no_damage(cell):
    path = cell.out / "shots/artefact-2/shot.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"later": 1}))
    before = inodes(cell.out)
    for retake in (False, True):
        with pytest.raises(NotUnderstood, match="later"):
            scan(read_cell(cell.path), cell.out, True, retake=retake)
    assert inodes(cell.out) == before


def test_what_is_damaged_is_set_aside_for_good_and_named(cell):
    path, kept = cell.out / "shots/artefact-2/003.png", []
    for number in (1, 2):
        spoil(path)
        kept.append(path.read_bytes())
        (found,) = cell.scan(resume=True).set_aside
        assert (found.shot, found.folder) == ("artefact-2", cell.out / "set-aside" / f"artefact-2-{number}")
        assert "003.png" in found.reason and any(str(found.folder) in what for what in cell.said)
        cell.assert_whole()
    assert cell.scan(resume=True).set_aside == ()
    for number, data in enumerate(kept, 1):
        assert (cell.out / f"set-aside/artefact-2-{number}/003.png").read_bytes() == data
    assert str(found.folder) in (cell.out / "scan.log").read_text()


def test_more_than_one_at_once_needs_retake(cell):
    spoil(cell.out / "shots/artefact-1/003.png")
    (cell.out / "shots/part-1/shot.json").unlink()
    before = inodes(cell.out)
    with pytest.raises(InputError, match=r"2 shots .*003\.png.*shot\.json.*--retake"):
        cell.scan(resume=True)
    assert inodes(cell.out) == before
    result = scan(read_cell(cell.path), cell.out, True, retake=True)
    assert [each.shot for each in result.set_aside] == ["artefact-1", "part-1"] and result.whole == 3
    cell.assert_whole()


def test_a_manifest_that_leaves_images_out_is_damaged(cell):
    path = cell.out / "shots/artefact-2/shot.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"files": {}}))
    assert [each.shot for each in cell.scan(resume=True).set_aside] == ["artefact-2"]
    cell.assert_whole()


def test_shots_that_went_with_their_disk(cell):
    (cell.out / "shots").rename(cell.out / "away")
    with pytest.raises(InputError, match="right disk"):
        cell.scan(resume=True)
    assert not (cell.out / "shots").exists() and (cell.out / "session.json").exists()


def test_what_is_no_shot_of_the_plan_is_left_alone(cell):
    (cell.out / "shots/mine").mkdir()
    (cell.out / "shots/.artefact-2.damaged").mkdir()
    (cell.out / "shots/mine/note.txt").write_text("x")
    assert cell.scan(resume=True).set_aside == ()
    assert (cell.out / "shots/mine/note.txt").exists() and (cell.out / "shots/.artefact-2.damaged").exists()


# --- fixed names and what killed processes leave ----------------------------------------------------------------------


@pytest.mark.parametrize("name", [".scan.lock", "scan.log"])
def test_a_planted_link_is_not_followed(cell, tmp_path, name):
    mine = tmp_path / "mine"
    mine.write_text("precious")
    (cell.out / name).unlink()
    (cell.out / name).symlink_to(mine)
    with pytest.raises(InputError, match="no regular file"):
        cell.scan(resume=True)
    assert mine.read_text() == "precious"


HOLDS = """
import sys, time
from pathlib import Path
from weldscan.records.files import whole_folder
with whole_folder(Path(sys.argv[1])) as partial:
    (partial / "half").write_text("x")
    print("holding", flush=True)
    time.sleep(60)
"""


def test_what_a_killed_process_left_is_tidied_up_at_the_next_start_and_what_a_living_one_writes_is_not(tmp_path):
    out = tmp_path / "out"
    writer = subprocess.Popen([sys.executable, "-c", HOLDS, str(out)], stdout=subprocess.PIPE, text=True)
    assert writer.stdout.readline() == "holding\n"
    with whole_folder(out) as partial:
        (partial / "whole").write_text("y")
    (hidden,) = tmp_path.glob(".out.*")
    assert (hidden / "half").exists()
    writer.send_signal(signal.SIGKILL)
    writer.communicate()
    write_file(tmp_path / "other", "z")
    assert hidden.exists()  # of another name
    with whole_folder(tmp_path / "out", lambda _: True):
        assert not hidden.exists()
    assert {path.name for path in tmp_path.iterdir()} == {"out", "other"}


def test_an_earlier_result_that_was_just_being_replaced_comes_back(tmp_path):
    (tmp_path / ".out.0123abcd.old").mkdir()
    (tmp_path / ".out.0123abcd.old/result").write_text("earlier")
    (tmp_path / ".out.89abcdef.partial").mkdir()
    (tmp_path / ".out.89abcdef.partial2").mkdir()
    (tmp_path / ".file.0123abcd.partial").write_text("half")
    (tmp_path / ".out.01234567.partial").symlink_to(tmp_path / "out")
    remove_unfinished(tmp_path, "out")
    assert (tmp_path / "out/result").read_text() == "earlier"
    assert (tmp_path / ".file.0123abcd.partial").exists()
    remove_unfinished(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"out", ".out.89abcdef.partial2", ".out.01234567.partial"}


def test_files_that_belong_together_appear_together(tmp_path, monkeypatch):
    """An example's configuration without its plan would stand in the way of the next try."""
    from weldscan.faces.live_demo import write_example

    write, left = files.write_synced, [1]

    def full(path, *content):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(path, *content)

    with monkeypatch.context() as moment:
        moment.setattr(files, "write_synced", full)
        with pytest.raises(InputError, match=r"plan\.json: cannot be written: No space left"):
            write_example(tmp_path / "cell")
    assert list((tmp_path / "cell").iterdir()) == []
    write_example(tmp_path / "cell")


def test_a_log_on_a_full_disk_says_nothing_of_its_own(cell, monkeypatch):
    class Full:
        """A file whose disk is full."""

        def __getattr__(self, name):
            if name in ("write", "flush", "close"):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            raise AttributeError(name)

    shutil.rmtree(cell.out / "shots/part-1")
    monkeypatch.setattr(scan_module._LogFile, "_open", lambda _: Full())
    assert cell.scan(resume=True).whole == 3


@pytest.mark.parametrize("command", ["preview", "check", "ramp", "hand-eye", "response", "plan", "scanner"])
def test_a_place_that_cannot_be_written_to_is_told_before_anything_is_measured(cell, tmp_path, monkeypatch, command):
    from typer.testing import CliRunner

    from weldscan.faces.cli.app import app

    measured, place = [], tmp_path / "place"
    place.mkdir()
    real = os.access
    monkeypatch.setattr(
        os, "access", lambda path, mode, **how: not (Path(path) == place and mode & os.W_OK) and real(path, mode, **how)
    )
    monkeypatch.setattr(CellConfig, "open", lambda *_, **__: measured.append("opened"))
    for module in ("measure.session_hand_eye.calibrate", "calibration.response.response_of_folder"):
        monkeypatch.setattr(f"weldscan.{module}", lambda *_, **__: measured.append("solved"))
    monkeypatch.setattr("weldscan.calibration.scanner.calibrate_scanner", lambda *_, **__: measured.append("solved"))
    words = {
        "preview": ["camera", "preview", "--config", cell.path, "--count", 1, "--out", place / "x.png"],
        "check": ["devices", "check", "--config", cell.path, "--out", place / "x.json"],
        "ramp": ["devices", "check", "--config", cell.path, "--out", tmp_path / "x.json", "--ramp", place],
        "hand-eye": ["calibrate", "hand-eye", cell.out, "--out", place / "x.json", "--page", tmp_path / "x.html"],
        "response": ["calibrate", "response", cell.out, "--out", place / "x.json"],
        "plan": ["calibrate", "plan", cell.out, "--out", place / "x.json", "--page", tmp_path / "x.html"],
        "scanner": ["calibrate", "scanner", cell.out, "--out", place / "x.json"],
    }[command]
    done = CliRunner().invoke(app, list(map(str, words)))
    assert isinstance(done.exception, InputError) and "not a folder that may be written to" in str(done.exception)
    assert measured == []


# --- beside the robot's motion ----------------------------------------------------------------------------------------


def test_a_shot_is_written_while_the_robot_goes_to_the_next(scanned, tmp_path, monkeypatch):
    scanned.out, scanned.said = tmp_path / "out", []
    write, move, goes, moves = store.write_synced, scanned.arm.move, threading.Event(), []

    def waiting(path, *content):
        assert goes.wait(20)
        write(path, *content)

    def moving(target):
        moves.append(target)
        if len(moves) == 2:
            goes.set()
        return move(target)

    monkeypatch.setattr(store, "write_synced", waiting)
    monkeypatch.setattr(scanned.arm, "move", moving)
    result = scanned.scan()
    assert result.whole == 3
    for each in ("motion", "standing", "projector", "camera", "judging", "writing"):
        assert result.seconds[each] > 0, each
    manifest = json.loads((scanned.out / "shots/part-1/shot.json").read_text())
    assert {"motion", "standing", "projector", "camera", "judging"} == set(manifest["record"]["seconds"])
    assert sum("can be measured" in what for what in scanned.said) == 3
    assert scanned.kept() == list(POSES)


@pytest.mark.parametrize("name", ["shots", "set-aside"])
def test_a_planted_folder_is_not_followed(cell, tmp_path_factory, name):
    """Who may write beside us does not choose where our shots go, nor where we move what is damaged."""
    theirs = tmp_path_factory.mktemp("theirs")
    (cell.out / "shots" / "part-1" / "e1_000.png").unlink()
    if name == "shots":
        (cell.out / name).rename(cell.out / "was")
    (cell.out / name).symlink_to(theirs)
    with pytest.raises(InputError, match=f"{name}: is a link"):
        cell.scan(resume=True)
    assert list(theirs.iterdir()) == []
