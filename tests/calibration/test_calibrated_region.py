"""What a calibration says beyond its parameters: where it holds, how far its poses agree, what it leaves of a step."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from test_calibrate_scanner import good_poses, in_sigmas, seen_from, sizes

from weldscan import BoardView, read_scanner, solve_scanner, triangulate, write_scanner
from weldscan.calibration.modes import covariance_root, deviation_modes, drawn_scanner
from weldscan.calibration.standard_weld import standard_weld
from weldscan.errors import InputError
from weldscan.geometry import rotation_of
from weldscan.measure.calibration_margin import nominal_covariance, stated_covariance
from weldscan.result import CalibratedHull, Severity, Verdict
from weldscan.simulated import DEFAULT, make_scanner, simulate_session


def nearly_parallel(count: int, seed: int):
    """Poses of a board tilted by less than 5 degrees."""
    random, out = np.random.default_rng(seed), []
    for _ in range(count):
        lean, tilt = random.uniform(0, 2 * np.pi), np.radians(5 * np.sqrt(random.random()))
        pose = np.eye(4)
        pose[:3, :3] = rotation_of(tilt * np.array([np.cos(lean), np.sin(lean), 0.0]))
        pose[:3, 3] = random.uniform([-25, -20, 390], [25, 20, 450])
        out.append(pose)
    return out


@pytest.fixture(scope="module")
def found():
    scanner = make_scanner()
    return solve_scanner(seen_from(scanner, good_poses(9), 4), *sizes(scanner))


# --- the poses against each other -------------------------------------------------------------------------------------


def test_poses_that_contradict_each_other_widen_the_covariance():
    """A projector that drifts between the captures: within a pose nothing is seen of it."""
    scanner, random = make_scanner(), np.random.default_rng(11)
    seen = seen_from(scanner, nearly_parallel(10, 1), 2, sigma=0.05)
    steady = solve_scanner(seen, *sizes(scanner), board_shape=False)
    for view in seen:
        view.projector_px[:] += random.normal(0, 0.4, 2)
    drifting = solve_scanner(seen, *sizes(scanner), board_shape=False)
    assert drifting.jackknife_ratio == pytest.approx(drifting.jackknife_mm / drifting.shape_u_mm)
    assert steady.jackknife_ratio < 1.7
    assert drifting.jackknife_ratio > 1.7
    # The covariance is the noise's, times the ratio's square; a point's uncertainty with it.
    unscaled = np.square(in_sigmas(drifting, scanner)).mean() * drifting.jackknife_ratio**2
    assert unscaled > 3
    assert np.square(in_sigmas(drifting, scanner)).mean() < 3
    u = [np.linalg.norm(point.shape_u_mm) for point in drifting.volume]
    assert max(u) > drifting.jackknife_ratio * drifting.shape_u_mm
    # What is not known to a per cent is said.
    assert {"camera.fx", "projector.fx"} <= set(drifting.undetermined)


def test_nearly_parallel_poses_of_a_bowed_board_err_within_what_is_stated():
    scanner = make_scanner()
    found = solve_scanner(seen_from(scanner, nearly_parallel(12, 0), 0, bowl=0.2), *sizes(scanner))
    assert np.abs(in_sigmas(found, scanner)).max() < 4


def test_three_poses_cannot_be_left_out():
    scanner = make_scanner()
    found = solve_scanner(seen_from(scanner, good_poses(3), 0), *sizes(scanner))
    assert found.jackknife_ratio is None
    assert found.jackknife_mm is None


# --- the hull ---------------------------------------------------------------------------------------------------------


def test_the_hull_holds_the_features_and_travels(found, tmp_path):
    hull = found.hull
    for pose in found.poses:
        used = pose.used.all(axis=1)
        inward = [0.999 * (pixels[used] - c.mean(axis=0)) + c.mean(axis=0) for pixels, c in (
            (pose.camera_px, hull.camera_px), (pose.projector_px, hull.projector_px))]  # fmt: skip
        assert hull.holds(*inward).all()
    assert not hull.holds(np.array([[-5.0, -5.0]]), hull.projector_px.mean(axis=0, keepdims=True)).any()
    assert not hull.holds(np.full((1, 2), np.nan), hull.projector_px.mean(axis=0, keepdims=True)).any()
    kept = write_scanner(tmp_path / "scanner.json", found)
    document = json.loads((tmp_path / "scanner.json").read_text())
    assert document["schema"] == "weldscan-scanner/2"
    assert document["jackknife_ratio"] == found.jackknife_ratio
    assert np.array(kept.hull.camera_px) == pytest.approx(hull.camera_px)
    assert kept.hull.depth_mm == hull.depth_mm
    near, far = hull.depth_mm
    assert 340 < near < 400
    assert 440 < far < 500
    document["hull"]["camera_px"] = [[0, 0], [9, 9], [9, 0], [0, 9]]
    (tmp_path / "bad.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"bad\.json: hull\.camera_px: should be the corners of a convex polygon"):
        read_scanner(tmp_path / "bad.json")


def test_a_file_of_the_first_version_is_read_on():
    from pathlib import Path

    spec = read_scanner(Path(__file__).parents[1] / "data/documents-281640f/scanner.json")
    assert spec.hull is None
    assert spec.jackknife_ratio is None
    assert stated_covariance(spec) is not None


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrated") / "session"
    simulate_session(folder, replace(DEFAULT, robot=None, artefact_shots=0, part_at_deg=(166.0,)))
    return folder


def inspected(session, tmp_path, **fields):
    """The session with more said of its scanner."""
    import shutil

    from weldscan import inspect

    folder = tmp_path / "session"
    shutil.copytree(session, folder)
    document = json.loads((folder / "session.json").read_text())
    document["scanner"] |= fields
    (folder / "session.json").write_text(json.dumps(document))
    return inspect(folder)


def rectangle(left, top, right, bottom):
    return [[left, top], [right, top], [right, bottom], [left, bottom]]


def test_points_outside_the_hull_have_that_fate(session, tmp_path):
    lens = DEFAULT.scanner.camera
    wide = {
        "camera_px": rectangle(-1, -1, lens.width, lens.height),
        "projector_px": rectangle(-1, -1, 5000, 5000),
        "depth_mm": [300, 600],
    }
    plain = inspected(session, tmp_path / "plain")
    whole = inspected(session, tmp_path / "whole", schema="weldscan-scanner/2", hull=wide)
    assert whole.step.max_abs_mm == plain.step.max_abs_mm
    assert [f for f in whole.findings if f.code == "calibration"] == [
        f for f in plain.findings if f.code == "calibration"
    ]
    narrow = wide | {"camera_px": rectangle(-1, -1, lens.width, 0.55 * lens.height)}
    cut = inspected(session, tmp_path / "cut", schema="weldscan-scanner/2", hull=narrow)
    (masks,), (before,) = cut.masks.values(), plain.masks.values()
    assert before["outside_calibration"] == 0
    assert masks["outside_calibration"] > 0.2 * before["ok"]
    assert masks["ok"] + masks["outside_calibration"] == before["ok"]
    said = [f for f in cut.findings if f.code == "calibration" and f.severity is Severity.BAR]
    assert any("of the walls' pixels lie where the scanner was calibrated" in f.text for f in said)
    assert all(verdict.verdict is not Verdict.PASS for verdict in cut.verdicts)
    assert sum(b.fate["outside_calibration"] for b in cut.seam) > 10_000
    lit = wide | {"projector_px": rectangle(-1, -1, 0.5 * DEFAULT.scanner.projector.width, 5000)}
    assert inspected(session, tmp_path / "lit", hull=lit).masks["part-1"]["outside_calibration"] > 0.2 * before["ok"]
    # One wall alone, and the reason why the other is not there.
    one = wide | {"camera_px": rectangle(-1, -1, 0.55 * lens.width, lens.height)}
    ((_, why),) = inspected(session, tmp_path / "one", hull=one).left_out
    assert "of its points lie where the scanner is not calibrated" in why


def test_a_covariance_without_a_hull_is_noted(session, tmp_path, found):
    covariance = {"parameters": list(found.parameters), "matrix": found.covariance.tolist()}
    got = inspected(session, tmp_path, schema="weldscan-scanner/1", covariance=covariance)
    assert any("does not say in which parts" in f.text and f.severity is Severity.NOTE for f in got.findings)


def test_a_part_beyond_the_boards_depth_is_warned_of(session, tmp_path):
    hull = {"camera_px": rectangle(-1, -1, 9999, 9999), "projector_px": rectangle(-1, -1, 9999, 9999)}
    got = inspected(session, tmp_path, hull=hull | {"depth_mm": [100.0, 300.0]})
    assert any("nearer than 100 or further than 300 mm" in w for w in got.warnings)


# --- what it does to points and steps ---------------------------------------------------------------------------------


def test_modes_move_a_wall_as_drawn_scanners_do(found):
    """Columns D C^(1/2) against the same pixels and projector columns, triangulated by scanners drawn from C."""
    scanner = found.scanner
    covariance = np.zeros((24, 24))
    known = [i for i in range(24) if i not in (8, 17)]
    covariance[np.ix_(known, known)] = found.covariance
    root = covariance_root(covariance)
    assert root @ root.T == pytest.approx(covariance, rel=1e-6, abs=1e-12 * np.abs(covariance).max())
    # A leaning plane, at whole pixels.
    v, u = (grid.ravel() for grid in np.mgrid[60:900:120, 80:1200:140])
    rays = np.column_stack([scanner.camera.undistort(np.column_stack([u, v]).astype(float)), np.ones(len(u))])
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    points = rays * (normal[2] * 420.0 / (rays @ normal))[:, None]
    columns = np.full((scanner.camera.height, scanner.camera.width), np.nan)
    columns[v, u] = scanner.project_to_projector(points)[:, 0]
    modes = deviation_modes(scanner, root, points, np.tile(normal, (len(points), 1)))
    assert modes.shape == (len(points), root.shape[1])
    random = np.random.default_rng(0)
    for _ in range(4):
        # Half a sigma of each; far corners are off by some per cent for the second order.
        z = 0.5 * random.normal(size=root.shape[1])
        moved = triangulate(columns, drawn_scanner(scanner, root @ z)).points_mm[v, u] - points
        seen = np.isfinite(moved[:, 2])
        assert seen.sum() > 20
        off = moved[seen] @ normal
        assert np.abs(off).max() > 0.02
        assert (modes @ z)[seen] == pytest.approx(off, abs=0.05 * np.abs(off).max())


def test_a_root_wants_the_whole_covariance():
    with pytest.raises(InputError, match=r"covariance: has the shape \(6, 6\)"):
        covariance_root(np.eye(6))


def test_the_standard_weld_counts_what_is_known_and_where(found):
    scanner = found.scanner
    covariance = nominal_covariance(scanner, 420.0)
    everywhere = CalibratedHull(np.array(rectangle(-1e4, -1e4, 1e4, 1e4), float),
                                np.array(rectangle(-1e4, -1e4, 1e4, 1e4), float), (1.0, 1e4))  # fmt: skip
    weld = standard_weld(scanner, covariance, everywhere, np.array([0.0, 0.0, 420.0]), "x")
    assert weld.inside == 1.0
    assert 0.002 < weld.u_mm < 0.1
    twice = standard_weld(scanner, 4 * covariance, everywhere, np.array([0.0, 0.0, 420.0]), "x")
    assert twice.u_mm == pytest.approx(2 * weld.u_mm)
    half = replace(everywhere, camera_px=np.array(rectangle(-1e4, -1e4, 640, 1e4), float), depth_mm=(1.0, 430.0))
    part = standard_weld(scanner, covariance, half, np.array([0.0, 0.0, 420.0]), "x")
    assert 0.4 < part.inside < 0.6
    assert 0.5 < part.deep_enough < 0.95


def test_central_poses_are_warned_of():
    """Boards in the middle of the images say nothing of where the part's walls will be."""
    scanner, central = make_scanner(), []
    for view in seen_from(scanner, good_poses(6), 3, columns=5, rows=5, pitch=6.0):
        central.append(BoardView(view.name, view.board_mm, view.camera_px, view.projector_px))
    found = solve_scanner(central, *sizes(scanner))
    good = solve_scanner(seen_from(scanner, good_poses(6), 3), *sizes(scanner))
    assert found.weld.inside < 0.8
    assert any("of the walls of a pipe of 219 mm" in w and "reach the images' borders" in w for w in found.warnings)
    assert found.weld.u_mm > 2 * good.weld.u_mm
    assert good.weld.inside > 0.8
    assert not any("pipe of 219 mm" in w for w in good.warnings)
