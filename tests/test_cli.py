"""The command line: exit codes, one line per complaint, and nothing half-done left behind."""

from __future__ import annotations

import json
import subprocess
import sys
import types
from dataclasses import replace
from pathlib import Path

import pytest

from synthetic import inspection, nothing_measured
from weldscan import GeometryError, InputError, NotMeasured
from weldscan.cli import main


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Runs a command with `weldscan.inspection.inspect` replaced; gives exit code, stdout, stderr without progress."""

    def run(*arguments: str, finds=None):
        def inspect(session_folder, *, method, norms, progress, response="auto"):
            progress(1, 2, "measuring")
            if isinstance(finds, BaseException):
                raise finds
            return replace(finds, method=method)

        fake = types.ModuleType("weldscan.inspection")
        fake.inspect = inspect
        monkeypatch.setitem(sys.modules, "weldscan.inspection", fake)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["weldscan", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_:
            main()
        said = capsys.readouterr()
        return exit_.value.code or 0, said.out, [line for line in said.err.splitlines() if not line.startswith("{")]

    return run


@pytest.mark.parametrize(
    ("finds", "code", "verdict"),
    [
        (inspection(500), 0, "PASS"),
        (inspection(500, scale=5.0), 3, "FAIL"),
        (inspection(500, scale=2.68), 4, "INCONCLUSIVE"),
        (nothing_measured(), 5, "NOT MEASURED"),
    ],
)
def test_the_verdict_is_the_exit_code(run, tmp_path, finds, code, verdict):
    assert run("inspect", "pipe-17", finds=finds)[0] == code
    result = json.loads((tmp_path / "pipe-17-report" / "result.json").read_text())
    assert result["verdict"] == verdict
    again = run("inspect", "pipe-17", "--out", "elsewhere", "--method", "paper", finds=finds)
    assert again[1].startswith(f"{verdict}   pnae-g-7-010-89, Table 1, column 2: ") and again[2] == []
    assert again[1].rstrip().endswith(str(Path("elsewhere", "report.html")))
    assert json.loads((tmp_path / "elsewhere" / "result.json").read_text())["method"] == "paper"


@pytest.mark.parametrize(
    ("error", "code", "says"),
    [
        (InputError("a/session.json: name: missing"), 2, "weldscan: a/session.json: name: missing"),
        (GeometryError("three\nlines of\ntext"), 2, "weldscan: three lines of text"),
        (NotMeasured("no weld in view"), 5, "weldscan: no weld in view"),
        (KeyboardInterrupt(), 130, ""),
        (
            ZeroDivisionError("oh"),
            1,
            "weldscan: an error of weldscan itself: ZeroDivisionError: oh (WELDSCAN_TRACEBACK=1 shows where)",
        ),
    ],
)
def test_an_error_is_one_line_and_leaves_nothing(run, tmp_path, error, code, says):
    assert run("inspect", "pipe-17", finds=error) == (code, "", [says] if says else [])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["inspect"], "Missing argument"),
        (["inspect", "a", "--method", "guess"], "'surface', 'paper'"),
        (["inspect", "a", "--norm", "din-0"], "there is no 'din-0'; there are iso-5817:B"),
        (["measure"], "No such command"),
        (["inspect", "a", "--color"], "No such option"),
        (["validate", "a"], "Missing option '--touch'"),
    ],
)
def test_a_wrong_use_is_exit_code_2(run, tmp_path, arguments, says):
    code, out, complaint = run(*arguments, finds=inspection(500))
    assert code == 2 and out == "" and says in " ".join(complaint)
    assert list(tmp_path.iterdir()) == []


def test_what_is_in_the_way_is_not_touched(run, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    # Found before anything is computed.
    code, _, complaint = run("inspect", "a", "--out", "out", finds=ZeroDivisionError())
    assert code == 2 and complaint == [
        "weldscan: out: exists and holds something else; name another folder or remove it"
    ]
    code, _, complaint = run("inspect", "a", "--out", "out/mine.txt/x", finds=ZeroDivisionError())
    assert code == 2 and complaint[0].startswith("weldscan: out/mine.txt/x: cannot be written: ")
    assert run("demo", "--out", "out")[0] == 2
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "mine.txt"]


def test_progress_is_json_lines_where_there_is_no_terminal(monkeypatch, capsys, run):
    seen = []
    monkeypatch.setattr(sys.stderr, "write", seen.append, raising=False)
    run("inspect", "pipe-17", finds=inspection(500))
    lines = [json.loads(line) for line in "".join(seen).splitlines()]
    assert lines[0] == {"done": 1, "of": 2, "what": "measuring"}


def test_version_and_help():
    def said(*arguments):
        return subprocess.run(
            [sys.executable, "-c", "from weldscan.cli import main; main()", *arguments],
            capture_output=True,
            text=True,
            check=True,
        ).stdout

    assert said("--version").startswith("weldscan 0.")
    for command in (["inspect"], ["demo"], ["calibrate", "hand-eye"], ["validate"]):
        assert "Example: weldscan " + " ".join(command) in " ".join(said(*command, "--help").split())


def test_help_does_not_import_what_it_does_not_need():
    script = """
import sys
from weldscan.cli import main
sys.argv = ["weldscan", "--help"]
try:
    main()
except SystemExit:
    sys.exit(", ".join({"cv2", "pydantic", "jinja2", "rich"} & set(sys.modules)) or 0)
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
