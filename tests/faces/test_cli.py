"""The command line: exit codes, one line per complaint, and nothing half-done left behind."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import types
from dataclasses import replace
from pathlib import Path

import pytest

from synthetic import barred, inspection, nothing_measured
from weldscan import GeometryError, InputError, NotMeasured
from weldscan.faces.cli.app import main
from weldscan.faces.cli.terminal import plain_ascii


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Runs a command with what `inspect` calls replaced; gives exit code, stdout, stderr without progress."""

    def run(*arguments: str, finds=None):
        def inspect(session_folder, *, method, norms, progress, response="auto", **asked):
            progress(1, 2, "measuring")
            run.asked = asked
            if isinstance(finds, BaseException):
                raise finds
            return replace(finds, method=method)

        fake = types.ModuleType("weldscan.measure.inspection")
        fake.inspect = inspect
        monkeypatch.setitem(sys.modules, "weldscan.measure.inspection", fake)
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
    words = f"{verdict} over 100° of 360°" if verdict == "PASS" else verdict
    assert again[1].startswith(f"{words}   pnae-g-7-010-89, Table 1, column 2: ") and again[2] == []
    assert again[1].rstrip().endswith(str(Path("elsewhere", "report.html")))
    assert json.loads((tmp_path / "elsewhere" / "result.json").read_text())["method"] == "paper"


@pytest.mark.parametrize(
    ("error", "code", "says"),
    [
        (InputError("a/session.json: name: missing"), 2, "weldscan: a/session.json: name: missing"),
        (GeometryError("three\nlines of\ntext"), 2, "weldscan: three lines of text"),
        (NotMeasured("no weld in view"), 5, "weldscan: no weld in view"),
        (KeyboardInterrupt(), 130, "weldscan: interrupted"),
        (
            ZeroDivisionError("oh"),
            1,
            "weldscan: an error of weldscan itself: ZeroDivisionError: oh (WELDSCAN_TRACEBACK=1 shows where)",
        ),
    ],
)
def test_an_error_is_one_line_and_leaves_nothing(run, tmp_path, error, code, says):
    assert run("inspect", "pipe-17", finds=error) == (code, "", [says])
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
        (["inspect", "a", "--require-coverage", "0"], "neither 'whole' nor degrees"),
        (["inspect", "a", "--require-coverage", "361"], "neither 'whole' nor degrees"),
        (["inspect", "a", "--require-coverage", "nan"], "neither 'whole' nor degrees"),
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
            [sys.executable, "-c", "from weldscan.faces.cli.app import main; main()", *arguments],
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
from weldscan.faces.cli.app import main
sys.argv = ["weldscan", "--help"]
try:
    main()
except SystemExit:
    sys.exit(", ".join({"cv2", "pydantic", "jinja2", "rich"} & set(sys.modules)) or 0)
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


def test_what_bars_stands_on_the_terminal(run):
    code, out, _ = run("inspect", "pipe-17", finds=barred(500))
    lines = out.splitlines()
    assert code == 4 and lines[0].startswith("INCONCLUSIVE   pnae-g-7-010-89, Table 1, column 2: would be PASS but for")
    assert lines[1].split()[:2] == ["bars", "PASS:"] and "coverage (at 142°): 113° to 171°" in lines[1]
    assert sum("bars PASS" in line for line in lines) == 6
    assert any("seam: 100° seen, 158° required (views); not seen: 113° to 171°" in line for line in lines)
    assert any("by iso-5817:B, 5072 [limit second-hand]: " in line for line in lines)
    assert any("by nb-4232, NB-4232, circumferential [limit from memory]: " in line for line in lines)
    assert any("scanner's calibration: not stated" in line for line in lines)


@pytest.mark.parametrize(("asked", "degrees"), [("whole", 360.0), ("120", 120.0), ("359.5", 359.5)])
def test_a_least_coverage_can_be_asked_for(run, asked, degrees):
    run("inspect", "pipe-17", "--require-coverage", asked, finds=inspection(500))
    assert run.asked == {"required_coverage_deg": degrees}
    run("inspect", "pipe-17", finds=inspection(500))
    assert run.asked == {}


def test_json_is_the_document_and_nothing_else(run, tmp_path):
    code, out, _ = run("inspect", "pipe-17", "--out", "out", "--json", finds=barred(500))
    assert code == 4 and json.loads(out) == json.loads((tmp_path / "out" / "result.json").read_text())
    assert out.isascii()


# A whole process whose `inspect` and `verify` find what was made up: what its reader does changes nothing of its code.
SCRIPT = """
import sys, types
sys.path.insert(0, {tests!r})
from synthetic import inspection
fake = types.ModuleType("weldscan.measure.inspection")
fake.inspect = lambda *_, progress, **__: (progress(1, 2, "measuring"), inspection(500, scale={scale}))[1]
sys.modules["weldscan.measure.inspection"] = fake
if "verify" in sys.argv:
    import weldscan.report.verification, weldscan.verification
    from synthetic import made_up
    weldscan.verification.verify = lambda *_, progress, **__: (progress(1, 2, "measuring"), made_up())[1]
    weldscan.report.verification.write_verification = lambda found, out: (out.mkdir(), (out / "v.json").touch())
from weldscan.faces.cli.app import main
main()
"""


def script(scale=1.0):
    return [sys.executable, "-c", SCRIPT.format(tests=str(Path(__file__).parents[1]), scale=scale)]


@pytest.mark.parametrize("code_page", ["utf-8", "cp866", "koi8-r", "ascii"])
def test_every_console_shows_the_verdict(tmp_path, code_page):
    environment = os.environ | {"PYTHONIOENCODING": code_page}
    name = "труба ±"
    done = subprocess.run(
        [*script(), "inspect", name, "--out", tmp_path / name], capture_output=True, env=environment, check=False
    )
    said = done.stdout.decode(code_page)
    assert done.returncode == 0, done.stderr
    degree, plus_minus = (
        each if each.encode(code_page, "ignore") else plain for each, plain in (("°", " deg"), ("±", "+-"))
    )
    assert said.startswith(f"PASS over 100{degree} of 360{degree}   pnae") and f"0.412 {plus_minus} 0.031 mm" in said
    assert "?" not in said and (tmp_path / name / "result.json").exists()


@pytest.mark.parametrize("fate", ["closed pipe", "full device", "no stream"])
@pytest.mark.parametrize(
    ("command", "scale", "code", "lost"),
    [
        ("inspect", 1.0, 0, ["stdout"]),
        ("inspect", 5.0, 3, ["stdout", "stderr"]),
        ("verify", 1.0, 0, ["stdout", "stderr"]),
    ],
)
def test_a_verdict_without_a_reader_is_the_same(tmp_path, command, scale, code, lost, fate):
    arguments = [*script(scale), command, "pipe-17", "--out", str(tmp_path / "out")]
    streams = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    if fate == "no stream":
        closing = "; ".join(f"os.close({('stdin', 'stdout', 'stderr').index(name)})" for name in lost)
        arguments = [
            sys.executable,
            "-c",
            f"import os, sys; {closing}; os.execv(sys.argv[1], sys.argv[1:])",
            *arguments,
        ]
    elif fate == "full device":
        full = Path("/dev/full")
        if not full.exists():
            pytest.skip("no /dev/full here")
        streams |= dict.fromkeys(lost, os.open(full, os.O_WRONLY))
    else:
        reader, writer = os.pipe()
        os.close(reader)
        streams |= dict.fromkeys(lost, writer)
    assert subprocess.run(arguments, **streams, check=False).returncode == code
    assert list((tmp_path / "out").glob("*.json"))
    for descriptor in {each for each in streams.values() if each >= 0}:
        os.close(descriptor)


def test_a_complaint_without_a_reader_keeps_its_code(tmp_path):
    reader, writer = os.pipe()
    os.close(reader)
    arguments = [
        sys.executable,
        "-c",
        "from weldscan.faces.cli.app import main; main()",
        "inspect",
        str(tmp_path / "none"),
    ]
    assert subprocess.run(arguments, stdout=writer, stderr=writer, check=False).returncode == 2
    os.close(writer)


@pytest.mark.parametrize("text", ["54° ± 0.1 → “x” − 3 × 10⁻² µm ≤ Ø", "Привет é ﬁ \ud800 \U0001f600"])
def test_plain_text_is_ascii_and_never_a_question_mark(text):
    plain = plain_ascii(text)
    assert plain.isascii() and "?" not in plain and len(plain) >= len(text) - 1
