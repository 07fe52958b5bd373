"""A stated calibration is in U, by unknowns of the step's fit."""

import json
from dataclasses import replace

import numpy as np
import pytest

from small_cell import small_scanner
from weldscan import InputError, inspect, measure_step
from weldscan.calibration.bundle import K3, PARAMETERS
from weldscan.calibration.modes import covariance_root, deviation_modes, drawn_scanner
from weldscan.measure.calibration_margin import nominal_covariance
from weldscan.simulated import DEFAULT, pipe, simulate_session
from weldscan.simulated.placing import make_scanner

CELL = replace(DEFAULT, scanner=small_scanner(2), artefact_shots=2, part_at_deg=(170.0,), weld=pipe(offset_mm=0.4))
DISTANCE_MM = 420.0


def stated(folder, covariance):
    """The session with a covariance in its scanner."""
    path = folder / "session.json"
    document = json.loads(path.read_text())
    free = [k for k in range(len(PARAMETERS)) if k not in K3]
    document["scanner"]["covariance"] = {
        "parameters": [PARAMETERS[k] for k in free],
        "matrix": covariance[np.ix_(free, free)].tolist(),
    }
    path.write_text(json.dumps(document))
    for name in folder.glob("record.json"):
        name.unlink()


def test_a_stated_covariance_is_in_u(tmp_path):
    simulate_session(tmp_path / "s", CELL)
    without = inspect(tmp_path / "s")
    assert without.calibration == "not stated"
    widths = []
    for factor in (1.0, 20.0):
        stated(tmp_path / "s", factor**2 * nominal_covariance(CELL.scanner, DISTANCE_MM))
        found = inspect(tmp_path / "s")
        assert found.calibration == "stated" and not [bar for bar in found.bars if bar.code == "calibration"]
        assert abs(found.step.max_abs_mm - 0.4) <= 1.5 * found.step.expanded_uncertainty_mm
        widths.append(found.step.expanded_uncertainty_mm)
    assert without.step.expanded_uncertainty_mm <= 1.05 * widths[0] and 1.3 * widths[0] < widths[1]


def test_modes_are_what_a_drawn_scanner_does():
    """The columns against triangulation with the other scanner, to first order."""
    scanner = make_scanner()
    root = covariance_root(nominal_covariance(scanner, DISTANCE_MM))
    random = np.random.default_rng(3)
    points = np.column_stack([random.uniform(-40, 40, 50), random.uniform(-40, 40, 50), random.uniform(400, 440, 50)])
    normals = np.tile([0.0, 0.0, -1.0], (50, 1))
    z = random.standard_normal(root.shape[1])
    drawn = drawn_scanner(scanner, root @ z)

    def features(of, at):
        return np.column_stack([of.camera.project(at), of.project_to_projector(at)[:, :1]])

    seen, found = features(scanner, points), points.copy()
    for _ in range(5):
        steps = [(features(drawn, found + h) - features(drawn, found - h)) / 0.02 for h in 0.01 * np.eye(3)]
        found -= np.linalg.solve(np.stack(steps, axis=2), (features(drawn, found) - seen)[:, :, None])[:, :, 0]
    moved = ((found - points) * normals).sum(axis=1)
    modes = deviation_modes(scanner, root, points, normals) @ z
    assert np.abs(moved - modes).max() < 0.05 * np.abs(moved).max()


@pytest.mark.parametrize(
    ("modes", "says"),
    [
        ([], "one per shot"),
        ([([0, 1], np.zeros((2, 3)))], "points with calibration modes"),
        ([(list(range(100)), np.zeros((99, 3)))], "100 points of the shot"),
        ([([10**9] * 100, np.zeros((100, 3)))], "100 points of the shot"),
        (3, "calibration_modes"),
    ],
)
def test_modes_that_are_none(weld_shot, modes, says):
    with pytest.raises((InputError, ValueError), match=says):
        measure_step([weld_shot], calibration_modes=modes)


@pytest.fixture(scope="module")
def weld_shot():
    from catalogue import weld_shot as points
    from weldscan import segment_weld

    return segment_weld(points(4), 315.0, 6.0)
