"""The error boundary: interrupts at any moment, errors of the system, and disks that take nothing."""

from __future__ import annotations

import errno
import json
import os
import resource
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from weldscan import DeviceError, GeometryError, InputError, NotMeasured
from weldscan.faces.cli import boundary
from weldscan.simulated import DEFAULT, simulate_session

START = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # in the background it is switched off
{before}
from weldscan.__main__ import main
print("ready", flush=True)
main()
"""


@pytest.fixture(scope="module")
def session(tmp_path_factory) -> Path:
    """One touched plate, one view of the part."""
    folder = tmp_path_factory.mktemp("boundary") / "session"
    simulate_session(folder, replace(DEFAULT, artefact_shots=1, part_at_deg=(166.0,)))
    return folder


def started(*arguments: object, before: str = "", **options) -> subprocess.Popen[str]:
    """The program, from the moment on that its first line runs."""
    command = [sys.executable, "-c", START.format(before=before), *map(str, arguments)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)
    assert process.stdout.readline() == "ready\n"
    return process


def complaints(said: str) -> list[str]:
    return [line for line in said.splitlines() if not line.startswith("{")]


# --- interrupts -------------------------------------------------------------------------------------------------------


def test_the_program_imports_next_to_nothing_before_the_boundary_stands():
    script = "import sys; before = set(sys.modules); import weldscan.__main__; print(*set(sys.modules) - before)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) == {"weldscan", "weldscan.__main__"}


@pytest.mark.parametrize(("command", "runs", "longest_s"), [("help", 8, 0.5), ("inspect", 12, 2.5), ("demo", 8, 3.0)])
def test_an_interrupt_at_any_moment_is_130_in_one_line(session, tmp_path, command, runs, longest_s):
    out = tmp_path / "out"
    arguments = {
        "help": ["--help"],
        "inspect": ["inspect", session, "--out", out],
        "demo": ["demo", "--out", out],
    }[command]
    begin = time.monotonic()
    whole = started(*arguments)
    whole.communicate()
    own, took_s = whole.returncode, min(time.monotonic() - begin, longest_s)
    interrupted = 0
    for run in range(runs):
        subprocess.run(["rm", "-rf", str(out)], check=True)
        process = started(*arguments)
        time.sleep(took_s * run / runs)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
        assert "Traceback" not in said and "ignored" not in said and process.returncode in (130, own), said
        if process.returncode == 130:
            interrupted += 1
            assert complaints(said) == ["weldscan: interrupted"]
        # Whole or not there; and nothing hidden beside it.
        assert {entry.name for entry in tmp_path.iterdir()} <= {"out"}
        if out.exists() and command == "inspect":
            json.loads((out / "result.json").read_text())
    assert interrupted >= runs // 3


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_command_that_waits_ends_by_it(tmp_path, number):
    process = started("robot", "simulate", "--port", "0", stdin=subprocess.PIPE)
    assert json.loads(process.stdout.readline())["link"] == "kvp"
    process.send_signal(number)
    assert process.communicate(timeout=20)[1] == "" and process.returncode == 0


SWALLOWS = """
import os, signal, time
try:
    os.kill(os.getpid(), signal.{number})
    time.sleep(0.1)
except BaseException:
    os._exit(99)
"""


def test_a_system_without_threads_is_not_our_fault():
    run = "from weldscan.faces.cli import boundary\ndef f(): raise RuntimeError(boundary.NO_THREAD)\nboundary.run(f)"
    done = subprocess.run([sys.executable, "-c", run], capture_output=True, text=True, check=False, timeout=20)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert "ulimit" in done.stderr


@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_an_interrupt_never_falls_into_an_import(tmp_path, number):
    (tmp_path / "swallows.py").write_text(SWALLOWS.format(number=number))
    run = (
        "from weldscan.faces.cli import boundary; import time; "
        "boundary.run(lambda: (__import__('swallows'), time.sleep(30)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", run], cwd=tmp_path, capture_output=True, text=True, check=False, timeout=20
    )
    assert (done.returncode, done.stderr) == (130, "weldscan: interrupted\n")


@pytest.mark.parametrize(
    "body",
    [
        # in a destructor, where nothing can be raised
        "type('D', (), {'__del__': lambda self: (os.kill(os.getpid(), signal.SIGINT), None)})(); time.sleep(30)",
        # in a library that makes an error of its own of it
        "exec('try:\\n  os.kill(os.getpid(), 2); time.sleep(30)\\nexcept BaseException: pass'); {}['its own']",
        # in pydantic, whose models are built when they are first used, and refuse everything if that was disturbed
        "exec('try:\\n  os.kill(os.getpid(), 2); time.sleep(0.1)\\nexcept BaseException: os._exit(99)', "
        "{'__name__': 'pydantic.main', 'os': os, 'time': time}); time.sleep(30)",
        # while what was interrupted is being closed
        "exec('try:\\n  os.kill(os.getpid(), 2); time.sleep(30)\\nfinally: raise weldscan.DeviceError(\"gone\")')",
    ],
)
def test_an_interrupt_is_not_lost(body):
    run = f"import os, signal, time, weldscan, weldscan.faces.cli.boundary\ndef command():\n    {body}\n"
    done = subprocess.run(
        [sys.executable, "-c", run + "weldscan.faces.cli.boundary.run(command)"],
        capture_output=True,
        text=True,
        check=False,
        timeout=20,
    )
    assert (done.returncode, done.stderr) == (130, "weldscan: interrupted\n")


def test_a_reader_that_hangs_is_not_waited_for():
    run = "from weldscan.faces.cli import boundary; boundary.run(lambda: print('ready\\n', 'x' * 2_000_000))"
    process = subprocess.Popen([sys.executable, "-c", run], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.read(5)
    for _ in range(100):  # the first ends the command, the next the flush
        process.send_signal(signal.SIGINT)
        time.sleep(0.05)
        if process.poll() is not None:
            break
    assert process.returncode == 130
    assert complaints(process.communicate()[1]) == ["weldscan: interrupted"]


def test_a_signal_that_was_switched_off_stays_so():
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    seen = []
    with pytest.raises(SystemExit):
        boundary.run(lambda: seen.append(signal.getsignal(signal.SIGINT)))
    assert seen == [signal.SIG_IGN]


# --- errors -----------------------------------------------------------------------------------------------------------


def full(name: str | None = None) -> OSError:
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), name)


class Panic(BaseException):
    """As a panic of the core is."""


@pytest.mark.parametrize(
    ("error", "code", "says"),
    [
        (InputError("a: name: missing"), 2, "a: name: missing"),
        (GeometryError("three\nlines of\ntext"), 2, "three lines of text"),
        (DeviceError("camera: silent"), 2, "camera: silent"),
        (NotMeasured("no weld in view"), 5, "no weld in view"),
        (full("a/b"), 2, "a/b: No space left on device; free space there, or name another place"),
        (full(), 2, "No space left on device; free space there, or name another place"),
        (
            PermissionError(13, "Permission denied", "a"),
            2,
            "a: Permission denied; change its permissions, or name",
        ),
        (TimeoutError("too late"), 2, "too late"),
        (MemoryError("Unable to allocate 7 GiB"), 2, "not enough memory: Unable to allocate 7 GiB; give less at once"),
        (MemoryError(), 2, "not enough memory; give less at once"),
        (RecursionError("too deep"), 2, "an input is nested too deeply: too deep"),
        (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"), 2, "a text or a name is in no readable enc"),
        (
            ZeroDivisionError("oh"),
            1,
            "an error of weldscan itself: ZeroDivisionError: oh (WELDSCAN_TRACEBACK=1",
        ),
        (Panic("at 7"), 1, "an error of weldscan itself: Panic: at 7"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (KeyboardInterrupt("stopped; go on with --resume"), 130, "stopped; go on with --resume"),
        (BrokenPipeError(errno.EPIPE, "Broken pipe"), 1, None),
        (SystemExit(4), 4, None),
        (SystemExit(), 0, None),
    ],
)
def test_every_error_is_a_line_and_a_code(capsys, error, code, says):
    def command():
        raise error

    with pytest.raises(SystemExit) as end:
        boundary.run(command)
    said = capsys.readouterr().err.splitlines()
    assert (end.value.code or 0) == code
    assert [line[: len(f"weldscan: {says}")] for line in said] == ([f"weldscan: {says}"] if says else [])


def test_a_remedy_is_told_whoever_met_the_error(capsys):
    def command():
        try:
            raise full("a/.b.partial")
        except OSError:
            raise InputError("a/b: cannot be written: No space left on device") from None

    with pytest.raises(SystemExit) as end:
        boundary.run(command)
    assert end.value.code == 2
    assert capsys.readouterr().err == (
        "weldscan: a/b: cannot be written: No space left on device; free space there, or name another place\n"
    )


def test_where_it_came_from_is_shown_on_demand(capsys, monkeypatch):
    monkeypatch.setenv("WELDSCAN_TRACEBACK", "1")
    with pytest.raises(SystemExit):
        boundary.run(lambda: {}["x"])
    assert "Traceback" in capsys.readouterr().err


def test_a_module_is_a_program():
    done = subprocess.run([sys.executable, "-m", "weldscan", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("weldscan 0.")


# --- disks that take nothing ------------------------------------------------------------------------------------------

# Each command that writes; `@` is the file or folder that it is to write.
WRITERS = {
    "inspect": "inspect SESSION --out @",
    "demo": "demo --out @",
    "validate": "validate SESSION --touch SESSION/touch.csv --out @",
    "verify": "verify SESSION --out @",
    "history": "verify SESSION --limits limits.toml --out verification --history @",
    "hand-eye": "calibrate hand-eye SESSION --out @.json",
    "page": "calibrate hand-eye SESSION --out hand-eye.json --page @.html",
    "plan": "calibrate plan SESSION --out @.json",
    "response": "calibrate response SESSION --out @.json",
    "capture": "calibrate scanner @ --live --config cell.toml --board chessboard:8x11:8mm --out scanner.json",
    "example": "scan --example-config @",
    "scan": "scan --config cell.toml --out @",
    "preview": "camera preview --config cell.toml --count 1 --out @.png",
    "project": "project --config files.toml --hold 0.01 --pattern white",
    "check": "devices check --config cell.toml --out @.json",
    "ramp": "devices check --config cell.toml --out response.json --ramp @",
}
CELL = """
[robot]
link = "kvp"
port = {port}
[camera]
backend = "simulated"
board = "8x11:8mm"
[projector]
backend = "simulated"
[calibration]
count = 5
temperature_c = 20.0
[scan]
plan = "plan.json"
"""
# A scan's folder is begun before anything is measured, and is gone on with.
BEGUN = {"scan": {".scan.lock", "scan.log"}}


def written(session: Path, folder: Path, name: str, target: str, largest: int | None) -> tuple[int, str]:
    from weldscan.simulated.controllers import HOME, Arm
    from weldscan.simulated.controllers.kvp import KvpController

    with KvpController(Arm(HOME)) as controller:
        (folder / "cell.toml").write_text(CELL.format(port=controller.port))
        (folder / "files.toml").write_text(
            f'[projector]\nbackend = "files"\nfolder = "{target}"\nwidth = 640\nheight = 400\n'
        )
        (folder / "plan.json").write_text((session / "session.json").read_text())
        (folder / "limits.toml").write_text("sd_mm = 0.5\n")
        words = WRITERS[name].replace("@", target).replace("SESSION", str(session)).split(" ")
        limit = None if largest is None else lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))
        done = subprocess.run(
            [sys.executable, "-m", "weldscan", *words],
            cwd=folder,
            capture_output=True,
            text=True,
            input="\n" * 9,
            preexec_fn=limit,
            check=False,
        )
    return done.returncode, done.stderr


@pytest.mark.parametrize("name", WRITERS)
def test_a_place_that_cannot_be_written_to_is_named(session, tmp_path, name):
    (tmp_path / "file").write_text("a file, no folder")
    code, said = written(session, tmp_path, name, "file/x", None)
    lines = [line for line in complaints(said) if "press Enter" not in line]
    assert code == 2 and len(lines) == 1 and "file/x" in lines[0], said
    assert any(remedy in lines[0] for remedy in ("not a folder", "no such folder", "name another")), lines
    assert (tmp_path / "file").read_text() == "a file, no folder"


@pytest.mark.parametrize("name", WRITERS)
def test_a_disk_that_takes_no_more_is_named_and_nothing_half_written_stays(session, tmp_path, name):
    (tmp_path / "small").mkdir()
    code, said = written(session, tmp_path, name, "small/x", 100)
    lines = [line for line in complaints(said) if "press Enter" not in line]
    assert code == 2 and len(lines) == 1 and "raise the largest size of a file" in lines[0], said
    assert any(named in lines[0] for named in ("small/x", "verification", "hand-eye.json", "response.json")), lines
    left = {path.name for path in (tmp_path / "small").rglob("*") if path.is_file()}
    assert left <= BEGUN.get(name, set())
