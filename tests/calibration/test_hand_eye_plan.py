"""Flange poses proposed for a hand-eye calibration: possible, spread, as good as predicted, and usable by a scan."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from weldscan.calibration.artefact import PlateView
from weldscan.calibration.hand_eye import (
    POSE_SIGMA_MM,
    POSE_SIGMA_RAD,
    TOUCH_BIAS_SIGMA_MM,
    TOUCH_SIGMA_MM,
    point_uncertainty_mm,
    solve_hand_eye,
)
from weldscan.calibration.plan import SPHERE_SIGMA_MM, Limits, Plan, plan_poses
from weldscan.errors import InputError
from weldscan.faces.cli.app import app
from weldscan.pose import KukaPose
from weldscan.records.plan import read_plan
from weldscan.result import HandEye
from weldscan.simulated import DEFAULT, placed, session_document, tilted_views

X = np.asarray(DEFAULT.flange_from_scanner)
CENTRES = DEFAULT.sphere_centres()
DIAMETER_MM = DEFAULT.sphere_diameter_mm
WORKING_POINT_MM = np.array([0.0, 0.0, 420.0])


def planned(**options: object) -> Plan:
    return plan_poses(DEFAULT.scanner, X, CENTRES, DIAMETER_MM, **options)


def solved(poses: list[np.ndarray], random: np.random.Generator | None = None) -> HandEye:
    """A calibration at these poses: exact, or drawn with the stated noise."""
    draw = random.normal if random is not None else (lambda _, __, size: np.zeros(size))
    views, reported = [], []
    for i, pose in enumerate(poses):
        into = np.linalg.inv(pose @ X)
        seen = CENTRES @ into[:3, :3].T + into[:3, 3] + draw(0.0, SPHERE_SIGMA_MM, (3, 3))
        covariances = np.tile(np.eye(3) * SPHERE_SIGMA_MM**2, (3, 1, 1))
        views.append(PlateView(f"artefact-{i + 1}", seen, covariances, (0.01,) * 3, (5000,) * 3))
        reported.append(pose @ placed(draw(0.0, POSE_SIGMA_MM, 3), draw(0.0, POSE_SIGMA_RAD, 3)))
    touched = CENTRES + draw(0.0, TOUCH_SIGMA_MM, (3, 3)) + draw(0.0, TOUCH_BIAS_SIGMA_MM, 3)
    return solve_hand_eye(views, reported, touched)


def test_the_poses_are_tilted_rolled_near_and_far():
    plan = planned(shots=12)
    assert len(plan.shots) == 12 and plan.possible <= plan.candidates
    assert all(30 <= shot.tilt_deg <= 45 for shot in plan.shots)
    assert len({shot.around_deg for shot in plan.shots}) >= 6 and len({shot.roll_deg for shot in plan.shots}) >= 3
    assert len({shot.distance_mm for shot in plan.shots}) >= 2
    assert min(plan.tilts_deg) > 30
    places = {tuple(shot.base_from_flange.ravel().round(6)) for shot in plan.shots}
    assert len(places) == 12
    assert all(np.diff(plan.u_mm) < 0) and plan.u_untouched_mm > plan.u_mm[-1]


def test_every_pose_is_within_reach_and_view():
    limits = Limits(reach_mm=(300.0, 850.0), lowest_mm=320.0)
    plan = planned(shots=10, limits=limits)
    scanner = DEFAULT.scanner
    for shot in plan.shots:
        flange = shot.base_from_flange
        assert 300 <= np.linalg.norm(flange[:3, 3]) <= 850 and flange[2, 3] >= 320
        into = np.linalg.inv(flange @ X)
        seen = CENTRES @ into[:3, :3].T + into[:3, 3]
        assert np.abs(np.linalg.norm(seen, axis=1) - limits.distance_mm).max() <= limits.depth_mm
        for pixels, lens in (
            (scanner.camera.project(seen), scanner.camera),
            (scanner.project_to_projector(seen), scanner.projector),
        ):
            assert (pixels > 0).all() and (pixels < [lens.width - 1, lens.height - 1]).all()


def test_what_is_predicted_is_what_comes():
    plan = planned(shots=10)
    random, squares = np.random.default_rng(1), []
    for _ in range(25):
        found = solved([shot.base_from_flange for shot in plan.shots], random)
        squares.append(np.square(((found.flange_from_scanner - X) @ [*WORKING_POINT_MM, 1.0])[:3]).sum())
    # u is that of the worst axis, the error that of all three: between one and the root of three, give or take a fifth.
    assert 0.8 * plan.u_mm[-1] < np.sqrt(np.mean(squares)) < 1.2 * np.sqrt(3) * plan.u_mm[-1]


def test_chosen_poses_beat_poses_by_rule():
    target = np.asarray(DEFAULT.base_from_plate) @ placed(np.mean(DEFAULT.spheres_mm, axis=0))
    by_rule = [view @ np.linalg.inv(X) for view in tilted_views(target, 10)]
    chosen = [shot.base_from_flange for shot in planned(shots=10).shots]
    corner = np.array([70.0, 70.0, 450.0])
    one, other = (point_uncertainty_mm(solved(poses), corner) for poses in (chosen, by_rule))
    assert one < other


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"shots": 3}, "shots: from 5 to 40, got 3"),
        ({"limits": Limits(reach_mm=(900.0, 300.0))}, "reach_mm: from less to more"),
        ({"limits": Limits(depth_mm=500.0)}, "depth_mm: 500 must be less than"),
        ({"limits": Limits(distance_mm=float("nan"))}, "distance_mm: must be positive"),
        (
            {"limits": Limits(reach_mm=(0.0, 200.0))},
            r"only 0 of 864 poses .* the flange would not be 0 to 200 mm",
        ),
        ({"limits": Limits(cone_deg=5.0)}, "turned by more than 5 degrees"),
        ({"limits": Limits(distance_mm=120.0)}, "out of the (camera|projector)'s view"),
        ({"limits": Limits(depth_mm=5.0)}, "more than 5 mm nearer or further"),
    ],
)
def test_what_is_not_possible_is_said(options, said):
    with pytest.raises(InputError, match=said):
        planned(**options)


def run(*words: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(word) for word in words])
    return result.exit_code, result.output if result.exception is None else f"{result.output}{result.exception}"


@pytest.fixture
def source(tmp_path: Path) -> Path:
    (tmp_path / "cell.json").write_text(json.dumps(session_document(DEFAULT)))
    return tmp_path / "cell.json"


MOUNT = " ".join(f"{value:.3f}" for value in KukaPose.from_matrix(X).values())


def test_the_command_writes_a_plan_that_a_scan_reads(source, tmp_path):
    out = tmp_path / "plan.json"
    code, said = run("calibrate", "plan", source, "--mount", MOUNT, "--out", out, "--shots", 11)
    assert code == 0 and "predicted u of a point at 420 mm: 0.0" in said and "artefact-11" in said
    plan = read_plan(out)
    assert [shot.of for shot in plan.shots] == ["artefact"] * 11 and plan.has_robot and plan.part is None
    assert plan.fringes == read_plan(source).fringes and plan.artefact == read_plan(source).artefact
    assert "<svg" in (tmp_path / "plan.html").read_text()
    # An earlier plan is replaced, and is a source itself.
    assert run("calibrate", "plan", out, "--mount", MOUNT, "--out", out)[0] == 0
    assert len(read_plan(out).shots) == 12 and read_plan(out).name == f"{DEFAULT.name} hand-eye"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "hand_eye: missing; say roughly where the scanner sits"),
        (("--mount", "1 2 3"), "is not six numbers"),
        (("--mount", MOUNT, "--hand-eye", "x.json"), "only one of them"),
        (("--mount", MOUNT, "--out", "{source}"), "is no plan of a hand-eye calibration"),
        (("--mount", MOUNT, "--out", "{folder}/nowhere/plan.json"), "is not a folder"),
    ],
)
def test_a_wrong_use_is_one_line(source, tmp_path, words, said):
    options = [str(word).format(source=source, folder=tmp_path) for word in words]
    if "--out" not in options:
        options += ["--out", str(tmp_path / "plan.json")]
    code, told = run("calibrate", "plan", source, *options)
    assert code != 0 and said in told and not (tmp_path / "plan.json").exists()


def test_a_plate_nobody_knows_the_place_of_is_refused(source, tmp_path):
    document = json.loads(source.read_text())
    del document["artefact"]["centres_base"]
    source.write_text(json.dumps(document))
    code, told = run("calibrate", "plan", source, "--mount", MOUNT, "--out", tmp_path / "plan.json")
    assert code != 0 and "artefact.centres_base: missing" in told
