"""What a session says, held against the scan, against its own files and against itself."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from small_cell import CELL, Change, copied, of, pose_of
from weldscan.measure.inspection import inspect
from weldscan.measure.stated_and_found import held_against_itself
from weldscan.records.session import Session
from weldscan.records.shot import faults
from weldscan.result import Finding, Inspection, Severity, Verdict
from weldscan.simulated import pipe, session_document, simulate_session

SMALL_PIPE = replace(CELL, weld=pipe(273.0, offset_mm=0.4), thickness_mm=10.0, part_at_deg=(100.0, 160.0))


def as_scanned(folder: Path) -> None:
    """Leaves beside a session what `weldscan scan` leaves: its plan, and a manifest per shot."""
    document = json.loads((folder / "session.json").read_text())
    (folder / "plan.json").write_text(json.dumps(document))
    for shot in document["shots"]:
        images = sorted((folder / "shots" / shot["name"]).glob("*.png"))
        files = {image.name: hashlib.sha256(image.read_bytes()).hexdigest() for image in images}
        manifest = {"schema": "weldscan-shot/1", "shot": shot, "files": files}
        (folder / "shots" / shot["name"] / "shot.json").write_text(json.dumps(manifest))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Sessions that are right, as a scan leaves them."""
    folder = tmp_path_factory.mktemp("cells")
    for name, cell in (("630", CELL), ("273", SMALL_PIPE)):
        simulate_session(folder / name, cell)
        as_scanned(folder / name)
    return {name: folder / name for name in ("630", "273")}


def without_record(folder: Path) -> Path:
    """As a session that no scan wrote."""
    (folder / "plan.json").unlink()
    for manifest in folder.glob("shots/*/shot.json"):
        manifest.unlink()
    return folder


def beyond_notes(found: Inspection) -> list[Finding]:
    """What is more than worth knowing: a session without a verification on record has a note."""
    return [finding for finding in found.findings if finding.severity is not Severity.NOTE]


@pytest.mark.parametrize("name", ["630", "273"])
def test_a_session_that_is_right_has_nothing_said_of_it(recorded: dict[str, Path], name: str) -> None:
    found = inspect(recorded[name])
    assert not beyond_notes(found) and found.verdict is Verdict.PASS


# --- the scan


@pytest.mark.parametrize(
    ("stated_mm", "likely"),
    [
        (27.3, "ten times as much"),
        (136.5, "was the radius given instead of the diameter"),
        (546.0, "half as much"),
        (10.75, "inches instead of millimetres"),
        (2730.0, "a tenth"),
        (420.0, "was another pipe scanned"),
    ],
)
def test_another_diameter_is_not_measured_and_the_cause_that_fits_is_named(
    recorded: dict[str, Path], tmp_path: Path, stated_mm: float, likely: str
) -> None:
    def change(document: dict[str, Any]) -> None:
        document["part"].update(outside_diameter=stated_mm, wall_thickness=min(10.0, 0.2 * stated_mm))

    found = inspect(without_record(copied(recorded["273"], tmp_path / "session", change)))
    assert found.step is None and found.verdict is Verdict.NOT_MEASURED
    assert {finding.shot for finding in of(found, "shot-left-out")} == {"part-1", "part-2"}
    for _, why in found.left_out:
        assert why.startswith("the pipe in view measures 27") and f"is {stated_mm:g} mm" in why and likely in why


@pytest.mark.parametrize(
    ("stated_mm", "severity"),
    [(271.0, None), (282.0, Severity.WARNING), (300.0, Severity.BAR), (245.0, Severity.BAR)],
)
def test_a_diameter_somewhat_off_is_said_by_how_far(
    recorded: dict[str, Path], tmp_path: Path, stated_mm: float, severity: Severity | None
) -> None:
    def change(document: dict[str, Any]) -> None:
        document["part"].update(outside_diameter=stated_mm)

    found = inspect(without_record(copied(recorded["273"], tmp_path / "session", change)))
    assert {finding.severity for finding in beyond_notes(found)} == ({severity} if severity else set())
    assert {finding.code for finding in beyond_notes(found)} <= {"description"}


def turned(degrees: float) -> Change:
    """The stated axis, turned in the plane of the supports."""
    angle = math.radians(degrees)
    return lambda d: d["part"].update(axis_base=[math.cos(angle), math.sin(angle), 0.0], zero_base=[0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("degrees", "severity"), [(1.0, None), (4.0, Severity.WARNING), (10.0, Severity.BAR), (80.0, Severity.BAR)]
)
def test_an_axis_that_is_off_is_said_by_how_far(
    recorded: dict[str, Path], tmp_path: Path, degrees: float, severity: Severity | None
) -> None:
    found = inspect(without_record(copied(recorded["273"], tmp_path / "session", turned(degrees))))
    assert {finding.severity for finding in beyond_notes(found)} == ({severity} if severity else set())
    for finding in beyond_notes(found):
        assert finding.code == "description"
        assert f"axis_base is {degrees:.1f} degrees off" in finding.text and "[1.000, 0.000, 0.000]" in finding.text
        assert ("may be exchanged" in finding.text) is (degrees > 60)


def test_an_axis_along_which_no_weld_is_found_is_named(recorded: dict[str, Path], tmp_path: Path) -> None:
    found = inspect(without_record(copied(recorded["630"], tmp_path / "session", turned(80.0))))
    assert found.verdict is Verdict.NOT_MEASURED
    said = [why for _, why in found.left_out] + [bar.text for bar in found.bars]
    assert len(found.left_out) == 2 and any("axis_base is 80" in why for why in said)


def test_a_part_shot_that_gives_nothing_bars(recorded: dict[str, Path], tmp_path: Path) -> None:
    session = without_record(copied(recorded["630"], tmp_path / "session"))
    for image in (session / "shots" / "part-2").glob("*.png"):
        grey = cv2.imread(str(image), cv2.IMREAD_GRAYSCALE)
        image.unlink()
        cv2.imwrite(str(image), np.full_like(grey, 120))
    found = inspect(session)
    (said,) = found.bars
    assert (said.code, said.shot) == ("shot-left-out", "part-2") and "hardly any fringes" in said.text


# --- the session alone


def a_session(change: Change) -> Session:
    document = session_document(replace(CELL, artefact_shots=1))
    change(document)
    return Session.model_validate_json(json.dumps(document))


@pytest.mark.parametrize(
    ("change", "severity", "code", "says"),
    [
        (lambda d: None, None, "", ""),
        (lambda d: pose_of(d, "part-1").update(X=1e9), Severity.BAR, "pose", "KUKA KR10 R1100 reaches 1790 mm"),
        (lambda d: pose_of(d, "part-1").update(X=9e5), Severity.BAR, "pose", "in micrometres?"),
        (lambda d: pose_of(d, "part-2").update(Z=-2500.0), Severity.BAR, "pose", "part-2: "),
        (lambda d: (d["robot"].update(model="x"), pose_of(d, "part-2").update(Z=-2500.0)), None, "", ""),
        (lambda d: (d.pop("robot"), pose_of(d, "part-2").update(Z=8000.0)), Severity.BAR, "pose", "any industrial arm"),
        (lambda d: pose_of(d, "part-1").update(B=-9e4), Severity.BAR, "pose", "-180 to 180"),
        (lambda d: d["part"].update(wall_thickness=0.6), Severity.BAR, "description", "so thin a wall"),
        (lambda d: d["part"].update(wall_thickness=1.4), Severity.WARNING, "description", "so thin a wall"),
        (lambda d: d["part"].update(wall_thickness=300.0), Severity.BAR, "description", "so thick a wall"),
        (lambda d: d["part"].update(other_wall_thickness=8.0), None, "", ""),
        (lambda d: d["part"].update(other_wall_thickness=20.0), Severity.WARNING, "description", "times apart"),
        (lambda d: d["part"].update(other_wall_thickness=0.6), Severity.BAR, "description", "10 times apart"),
    ],
)
def test_what_a_session_contradicts_in_itself(change: Change, severity: Severity | None, code: str, says: str) -> None:
    found = held_against_itself(a_session(change))
    assert [(finding.severity, finding.code) for finding in found] == ([(severity, code)] if severity else [])
    assert all(says in finding.text for finding in found)


@pytest.mark.parametrize("x_mm", [1e9, 1e6, -1e9])
def test_a_pose_out_of_this_world_bars_and_takes_no_memory(
    recorded: dict[str, Path], tmp_path: Path, x_mm: float
) -> None:
    session = copied(recorded["630"], tmp_path / "session", lambda d: pose_of(d, "part-2").update(X=x_mm))
    # VmHWM is this process's own peak; ru_maxrss would begin at that of the process that started it.
    code = (
        "import re, sys; from pathlib import Path; from weldscan.measure.inspection import inspect; "
        "found = inspect(sys.argv[1]); "
        "peak = re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text()); "
        "print(sorted({bar.code for bar in found.bars}), peak.group(1))"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code, str(without_record(session))], capture_output=True, text=True, check=False
    )
    codes, _, kilobytes = ran.stdout.strip().rpartition(" ")
    assert ran.returncode == 0, ran.stderr
    # The furthest one determines no axis common to both: nothing is measured then.
    assert "'pose'" in codes and ("'shots-disagree'" in codes or "'shot-left-out'" in codes)
    assert int(kilobytes) < 1_000_000


# --- what a scan left beside it


def nudge(document: dict[str, Any]) -> None:
    pose_of(document, "artefact-2")["X"] += 0.1


def drop(document: dict[str, Any]) -> None:
    document["shots"] = [shot for shot in document["shots"] if shot["name"] != "part-2"]


@pytest.mark.parametrize(
    ("change", "code", "shot", "says"),
    [
        (lambda d: pose_of(d, "part-1").update(Y=-600.0), "shot-altered", "part-1", "flange_pose.Y is -600, recorded "),
        (nudge, "shot-altered", "artefact-2", "flange_pose.X is "),
        (lambda d: d["part"].update(wall_thickness=8.0), "description", None, "part.wall_thickness is 8, recorded 6"),
        (lambda d: d["part"].update(joint="lap"), "description", None, "part.joint is lap, recorded circumferential"),
        (lambda d: d["robot"].update(model="another"), "description", None, "robot.model"),
        (lambda d: d["artefact"].update(sphere_diameter=20.01), "description", None, "artefact.sphere_diameter"),
        (lambda d: d["scanner"]["camera_from_projector"][0].__setitem__(3, -99.0), "description", None, "scanner."),
        (drop, "shot-missing", "part-2", "session.json does not list it"),
    ],
)
def test_an_edited_session_is_not_the_one_that_was_scanned(
    recorded: dict[str, Path], tmp_path: Path, change: Change, code: str, shot: str | None, says: str
) -> None:
    found = inspect(copied(recorded["630"], tmp_path / "session", change))
    said = of(found, code)
    assert [(finding.severity, finding.shot) for finding in said] == [(Severity.BAR, shot)] and says in said[0].text


def touch_an_image(session: Path) -> None:
    image = session / "shots" / "part-2" / "003.png"
    data = image.read_bytes()
    image.unlink()
    image.write_bytes(data[:-20] + bytes([data[-20] ^ 1]) + data[-19:])


def forget_the_manifest(session: Path) -> None:
    (session / "shots" / "part-2" / "shot.json").unlink()


def lose_the_folder(session: Path) -> None:
    shutil.rmtree(session / "shots" / "part-2")
    document = json.loads((session / "session.json").read_text())
    drop(document)
    (session / "session.json").write_text(json.dumps(document))


@pytest.mark.parametrize(
    ("spoil", "code", "says"),
    [
        (touch_an_image, "shot-altered", "is not what the camera gave"),
        (forget_the_manifest, "shot-altered", "shot.json is missing"),
        (lose_the_folder, "shot-missing", "planned, but not scanned"),
    ],
)
def test_a_shot_that_is_not_as_it_was_taken_bars(
    recorded: dict[str, Path], tmp_path: Path, spoil: Callable[[Path], None], code: str, says: str
) -> None:
    session = copied(recorded["630"], tmp_path / "session")
    assert faults(session) == ()
    spoil(session)
    found = inspect(session)
    (said,) = found.bars
    assert (said.code, said.shot) == (code, "part-2") and says in said.text
    assert "part-2" in dict(found.left_out)


def test_a_folder_without_a_plan_still_knows_its_manifests(recorded: dict[str, Path], tmp_path: Path) -> None:
    session = copied(recorded["630"], tmp_path / "session")
    (session / "plan.json").unlink()
    forget_the_manifest(session)
    (said,) = inspect(session).bars
    assert (said.code, said.shot) == ("shot-altered", "part-2") and "nobody knows what it shows" in said.text
