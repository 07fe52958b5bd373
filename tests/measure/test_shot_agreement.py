"""Part shots held against each other before they are pooled."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conftest import shared
from small_cell import CELL, Change, copied, of, pose_of
from weldscan._weldcore import SeamCourse
from weldscan.measure.inspection import inspect
from weldscan.measure.session_hand_eye import calibrate
from weldscan.measure.shot_agreement import _unlike, copies
from weldscan.records.hand_eye import write_hand_eye
from weldscan.result import Severity
from weldscan.simulated import Wall, Weld, pipe, placed, simulate_session

AROUND = (100.0, 145.0, 190.0)
# Both walls 1 % of the diameter out of round, one after the other, not quite alike, and out of line.
OVAL = Weld(
    Wall(136.5, ovality_mm=0.68, ovality_at_rad=0.4, waviness_mm=0.005),
    Wall(136.6, (0.3, 0.1), (0.003, 0.002), ovality_mm=0.6, ovality_at_rad=0.6, waviness_mm=0.005),
)
ROUND = replace(CELL, weld=pipe(273.0, offset_mm=0.05), thickness_mm=10.0, part_at_deg=AROUND)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three shots of a round pipe."""
    folder = tmp_path_factory.mktemp("cell") / "session"
    simulate_session(folder, ROUND)
    return folder


def exchange(session: Path, one: str, other: str) -> None:
    """Two shots' images change places."""
    shots = session / "shots"
    (shots / one).rename(shots / "between")
    (shots / other).rename(shots / one)
    (shots / "between").rename(shots / other)


def disagreeing(session: Path) -> list[str | None]:
    return [finding.shot for finding in inspect(session).bars if finding.code == "shots-disagree"]


def test_shots_of_one_pipe_agree(recorded: Path) -> None:
    assert all(finding.severity is Severity.NOTE for finding in inspect(recorded).findings)


def test_a_pipe_out_of_round_and_out_of_line_is_one_pipe(tmp_path: Path) -> None:
    simulate_session(tmp_path / "session", replace(ROUND, weld=OVAL, pose_noise_mm=0.05, pose_noise_deg=0.01))
    assert inspect(tmp_path / "session").bars == ()


@pytest.mark.parametrize("name", ["open-630", "open-273", "hard-oval-girth"])
def test_outside_sessions_agree(name: str) -> None:
    assert of(inspect(shared(f"sessions/{name}")), "shots-disagree") == []


@pytest.mark.parametrize("name", ["open-630", "open-273"])
def test_exchanged_images_of_shots_without_a_common_arc(tmp_path: Path, name: str) -> None:
    session = copied(shared(f"sessions/{name}"), tmp_path / "session")
    exchange(session, "part-1", "part-2")
    (said,) = inspect(session).bars
    assert said.code == "shots-disagree" and said.text.startswith("part-1 and part-2 contradict each other: its axis ")
    assert "were their images exchanged" in said.text


def test_exchanged_images_of_neighbours(recorded: Path, tmp_path: Path) -> None:
    session = copied(recorded, tmp_path / "session")
    exchange(session, "part-2", "part-3")
    assert disagreeing(session)


def test_a_copied_shot_is_named_with_the_one_it_was_copied_from(recorded: Path, tmp_path: Path) -> None:
    session = copied(recorded, tmp_path / "session")
    for copy, of_ in (("part-3", "part-1"), ("artefact-2", "artefact-1")):
        shutil.rmtree(session / "shots" / copy)
        shutil.copytree(session / "shots" / of_, session / "shots" / copy)
    said = of(inspect(session), "shot-copied")
    assert [(finding.severity, finding.shot) for finding in said] == [
        (Severity.BAR, "artefact-2"),
        (Severity.BAR, "part-3"),
    ]
    assert "the same images as part-1" in said[1].text


def test_no_copies_among_different_images() -> None:
    assert copies({"a": "1", "b": "2", "c": "3"}) == []


@pytest.mark.parametrize(
    ("axis", "by", "says"),
    [("X", 20.0, " mm apart along the pipe"), ("A", 2.0, "its axis differs by "), ("Y", 60.0, "mm aside")],
)
def test_one_wrong_pose_of_three_is_named(recorded: Path, tmp_path: Path, axis: str, by: float, says: str) -> None:
    def edit(document: dict[str, Any]) -> None:
        pose_of(document, "part-2")[axis] += by

    (said,) = [f for f in inspect(copied(recorded, tmp_path / "session", edit)).bars if "all other" in f.text]
    assert said.shot == "part-2" and says in said.text


def test_a_part_that_was_moved_by_little_is_a_warning_and_by_much_a_bar(recorded: Path, tmp_path: Path) -> None:
    def moved(by_mm: float) -> Change:
        return lambda d: pose_of(d, "part-3").update(Y=pose_of(d, "part-3")["Y"] + by_mm)

    little = inspect(copied(recorded, tmp_path / "little", moved(0.8)))
    assert little.bars == () and any("the step is not" in text for text in little.warnings)
    assert disagreeing(copied(recorded, tmp_path / "much", moved(5.0))) == ["part-3"]


def test_the_hand_eye_of_another_cell_shows_in_all_shots(recorded: Path, tmp_path: Path) -> None:
    write_hand_eye(tmp_path / "hand-eye.json", calibrate(recorded)[0])
    kept = json.loads((tmp_path / "hand-eye.json").read_text())

    def carry(turn_rad: float) -> Change:
        x = np.array(kept["flange_from_scanner"]) @ placed((0.0, 0.0, 0.0), (0.0, turn_rad, 0.0))

        def change(document: dict[str, Any]) -> None:
            del document["artefact"]
            document["hand_eye"] = kept | {"flange_from_scanner": x.tolist()}
            document["shots"] = [shot for shot in document["shots"] if shot["of"] == "part"]

        return change

    right = inspect(copied(recorded, tmp_path / "its own", carry(0.0)))
    assert all(finding.severity is Severity.NOTE for finding in right.findings)
    (said,) = of(inspect(copied(recorded, tmp_path / "another", carry(0.06))), "hand-eye")
    assert said.severity is Severity.BAR and "all 3 shots contradict each other" in said.text


def test_two_pipes_on_one_arc(recorded: Path, tmp_path: Path) -> None:
    """The second shot is of a pipe whose step is another: pooled, they would be one of half the step."""
    simulate_session(tmp_path / "other", replace(ROUND, weld=pipe(273.0, offset_mm=0.9)))
    session = copied(recorded, tmp_path / "session")
    shutil.rmtree(session / "shots" / "part-2")
    shutil.copytree(tmp_path / "other" / "shots" / "part-2", session / "shots" / "part-2")
    said = [f for f in inspect(session).bars if f.code == "shots-disagree"]
    assert said and all("contradict each other on the step" in finding.text for finding in said)
    assert any("part-1 and part-2" in finding.text and finding.at_deg is not None for finding in said)


def test_the_two_pipes_of_the_outside_session() -> None:
    (said,) = inspect(shared("sessions/hard-two-pipes")).bars
    assert said.code == "shots-disagree"
    pairs = [(float(h), float(u)) for h, u in re.findall(r"([\d.]+) ± ([\d.]+) mm", said.text)]
    for (h_mm, u_mm), true_mm in zip(pairs, (0.05, 1.2), strict=True):
        assert abs(h_mm - true_mm) <= u_mm < 0.05


def profile(step_mm: float, sigma_mm: float = 0.01, **other: float) -> dict[int, tuple[float, float]]:
    bins = {at: (step_mm, sigma_mm) for at in range(100, 130, 2)}
    return bins | {int(at[1:]): (value, sigma_mm) for at, value in other.items()}


@pytest.mark.parametrize(
    ("one", "other", "severity"),
    [
        (profile(0.3), profile(0.33), None),
        # One bin alone may be a speck; two beside each other are a wall.
        (profile(0.3), profile(0.3, a110=0.9), None),
        (profile(0.3), profile(0.3, a110=0.9, a112=0.9, a114=0.9, a116=0.9), Severity.BAR),
        (profile(0.3), profile(0.49), Severity.WARNING),
        (profile(0.3), profile(0.6), Severity.BAR),
        # What is as uncertain as that is no contradiction.
        (profile(0.3), profile(0.6, sigma_mm=0.1), None),
        # A steep profile seen a bin aside is none either.
        (
            {at: (0.2 * (at - 100), 0.01) for at in range(100, 130, 2)},
            {at: (0.2 * (at - 102), 0.01) for at in range(100, 130, 2)},
            None,
        ),
    ],
)
def test_when_two_profiles_contradict_each_other(
    one: dict[int, tuple[float, float]], other: dict[int, tuple[float, float]], severity: Severity | None
) -> None:
    course = SeamCourse(136.5)
    bins = ({round(at / course.bin_width): value for at, value in each.items()} for each in (one, other))
    found = list(_unlike("part-1", "part-2", course, *bins))
    assert [finding.severity for finding in found] == ([severity] if severity else [])
