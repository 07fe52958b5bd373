"""A scan interrupted, starved of disk and denied its files, again and again; `--soak` runs the full numbers."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
from test_scan import POSES, Cell, acknowledged
from test_store import inodes

from weldscan import InputError

MAIN = (  # a test that runs in the background has Ctrl-C switched off, and its children with it
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from weldscan.__main__ import main; print('ready', flush=True); main()"
)
SHIM = Path(__file__).with_name("eio.c")


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """One controller for all; `cell.whole` is a session that nobody disturbed."""
    cell = Cell(tmp_path_factory.mktemp("campaign"))
    with cell.controller:
        cell.out = cell.whole = cell.folder / "whole"
        cell.scan()
        yield cell


def started(cell, out, *more, **options):
    """The program, from the moment on that its first line runs."""
    words = [sys.executable, "-c", MAIN, "scan", "--config", str(cell.path), "--out", str(out), *more]
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = subprocess.Popen(words, text=True, **pipes, **options)
    assert process.stdout.readline() == "ready\n"
    return process


def session(folder):
    """What session.json says, but for what a robot's noise makes different each time."""
    document = json.loads((folder / "session.json").read_text())
    for shot in document["shots"]:
        del shot["flange_pose"]
    return document


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("doing", ["scan", "resume"])
@pytest.mark.parametrize("part", range(3))
def test_interrupted_at_random_moments(cell, soak, doing, part):
    """Ctrl-C, then to the end: nothing acknowledged is lost, nothing is taken for damaged, nothing hidden stays."""
    if part and not soak:
        pytest.skip("only with --soak")
    moments, codes = random.Random(7 + part), Counter()
    for run in range(50 if soak else 5):
        if codes[130] and not soak:
            break
        out = cell.folder / f"{doing}-{part}-{run}"
        if doing == "resume":
            shutil.copytree(cell.whole, out)
            if run % 2:
                shutil.rmtree(out / "shots" / "part-1")
        before = inodes(out) if out.exists() else {}
        scanning = started(cell, out, *(["--resume"] if doing == "resume" else []))
        time.sleep(moments.uniform(0.1, 2.0))
        scanning.send_signal(signal.SIGINT)
        printed, said = scanning.communicate(timeout=60)
        codes[scanning.returncode] += 1
        assert scanning.returncode in (0, 130) and "Traceback" not in said, said
        assert "set aside" not in printed + said
        after = inodes(out) if out.exists() else {}
        assert set(acknowledged(said)) <= {Path(name).parent.name for name in after}
        resume = ["--resume"] if (out / "plan.json").exists() else []
        scanning = started(cell, out, *resume)
        printed, said = scanning.communicate(timeout=60)
        assert scanning.returncode == 0 and "set aside" not in printed, said
        last = inodes(out)
        for there in (before, after):
            assert {n: i for n, i in there.items() if n.startswith("shots/")}.items() <= last.items()
        assert session(out) == session(cell.whole)
        assert not [path for path in out.rglob(".*") if path.name != ".scan.lock"]
        shutil.rmtree(out)
    assert codes[130] > 0


@pytest.mark.parametrize("kilobytes", [4, 24, 64])
def test_small_disks(cell, tmp_path, kilobytes, soak):
    """A disk that is full at some moment, then one that is large enough: whole, and what was kept is kept."""
    if os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("only root can mount a disk of some kB")
    for size in range(kilobytes, 320 if kilobytes == 64 else kilobytes + 20, 4 if soak else 1000):
        mounted = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={size}k", "tmpfs", tmp_path], capture_output=True, check=False
        )
        if mounted.returncode != 0:
            pytest.skip(f"no mounts here: {mounted.stderr.decode()}")
        try:
            cell.out, cell.said, there = tmp_path / "out", [], set()
            try:
                cell.scan()
            except (InputError, OSError) as error:
                assert "No space left" in str(error)
                kept, before = cell.kept(), inodes(cell.out) if cell.out.exists() else {}
                there = {name for name in POSES if (cell.out / "shots" / name).exists()}
                grown = ["mount", "-o", "remount,size=4m", tmp_path]
                subprocess.run(grown, check=True)
                assert cell.scan(resume=(cell.out / "plan.json").exists()).set_aside == ()
                after = inodes(cell.out)
                for name in kept:
                    assert (f"shots/{name}/shot.json", before[f"shots/{name}/shot.json"]) in after.items()
                assert not [path for path in cell.out.rglob(".*") if path.name != ".scan.lock"]
            cell.assert_whole()
            # One that was whole when the disk was too full to say so is not taken again.
            assert sorted({*cell.kept(), *there}) == sorted(POSES)
        finally:
            subprocess.run(["umount", "-l", tmp_path], check=True)


def test_a_clock_that_jumps(cell, tmp_path, monkeypatch):
    jumps = random.Random(3)
    monkeypatch.setattr(time, "time", lambda: 1.7e9 + jumps.uniform(-1e8, 1e8))
    monkeypatch.setattr(time, "strftime", lambda *_: f"{jumps.randint(1970, 2100)}-01-01T00:00:00+0000")
    cell.out, cell.said = tmp_path / "out", []
    assert cell.scan().whole == 3
    before = inodes(cell.out)
    assert cell.scan(resume=True).whole == 3
    assert {n: i for n, i in before.items() if n.startswith("shots/")}.items() <= inodes(cell.out).items()


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("part", range(2))
def test_every_file_refused_in_turn(cell, tmp_path, soak, part):
    """By the system itself, to the whole program. Refused: exit 2 in one line and nothing changed, or never asked."""
    if part and not soak:
        pytest.skip("only with --soak")
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler for a disk that fails")
    shim, out = tmp_path / "eio.so", tmp_path / "out"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", shim, SHIM, "-ldl"], check=True)
    shutil.copytree(cell.whole, out)
    shots = ["shots/artefact-2/shot.json", "shots/part-1/e1_003.png"]
    every = [(name, call) for name in inodes(out) for call in ("open", "read", "stat")]
    every += [(name, call) for name in ("", "shots", *(f"shots/{name}" for name in POSES)) for call in ("list", "stat")]
    refused = 0
    for name, calls in every[part::2] if soak else [(shots[0], "open"), (shots[1], "read")]:
        before = inodes(out)
        env = {**os.environ, "LD_PRELOAD": str(shim), "EIO_PATH": str(out / name).rstrip("/"), "EIO_CALLS": calls}
        scanning = started(cell, out, "--resume", env=env)
        _, said = scanning.communicate(timeout=60)
        own = {n: i for n, i in inodes(out).items() if n.startswith("shots/")}
        assert own == {n: i for n, i in before.items() if n.startswith("shots/")}, (name, calls)
        assert scanning.returncode in (0, 2), (name, calls, said)
        if scanning.returncode == 2:
            refused += 1
            assert len([line for line in said.splitlines() if not line.startswith("{")]) == 1, said
    assert refused >= 2
    assert cell_is_whole(cell, out)


def cell_is_whole(cell, out):
    """Whether a last look, with a disk that gives everything, finds nothing to do."""
    cell.out, cell.said = out, []
    result = cell.scan(resume=True)
    return result.whole == 3 and result.set_aside == () and cell.kept() == []
