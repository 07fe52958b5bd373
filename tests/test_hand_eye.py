"""Where the scanner sits on the flange, from synthetic sphere centres with known truth."""

from __future__ import annotations

import re

import numpy as np
import pytest

from weldscan.calibration.artefact import TOUCH_SIGMA_MM, PlateMismatch, PlateView, find_plate
from weldscan.calibration.hand_eye import (
    POSE_SIGMA_MM,
    POSE_SIGMA_RAD,
    TOUCH_BIAS_SIGMA_MM,
    point_uncertainty_mm,
    solve_hand_eye,
)
from weldscan.devices.simulated import DEFAULT, placed, tilted_views
from weldscan.errors import GeometryError
from weldscan.result import HandEye

TRUE = np.asarray(DEFAULT.flange_from_scanner)
TOUCHED = DEFAULT.sphere_centres()
CENTRE_SIGMA_MM = 0.006
WORKING_POINT_MM = np.array([0.0, 0.0, 420.0])
SHOTS = 6
DRAWS = 200
DOUBLES_MM = 1e-9


def views_and_poses(
    shots: int = SHOTS, random: np.random.Generator | None = None
) -> tuple[list[PlateView], list[np.ndarray], np.ndarray]:
    """Plate views, reported flange poses and touched centres: exact, or with the errors that the solver assumes."""
    views, poses = [], []
    target = np.asarray(DEFAULT.base_from_plate) @ placed(np.mean(DEFAULT.spheres_mm, axis=0))
    for i, base_from_scanner in enumerate(tilted_views(target, shots)):
        scanner_from_base = np.linalg.inv(base_from_scanner)
        centres = TOUCHED @ scanner_from_base[:3, :3].T + scanner_from_base[:3, 3]
        pose = base_from_scanner @ np.linalg.inv(TRUE)
        if random is not None:
            centres = centres + random.normal(0.0, CENTRE_SIGMA_MM, (3, 3))
            pose = pose @ placed(random.normal(0.0, POSE_SIGMA_MM, 3), random.normal(0.0, POSE_SIGMA_RAD, 3))
        covariances = np.tile(np.eye(3) * CENTRE_SIGMA_MM**2, (3, 1, 1))
        views.append(PlateView(f"artefact-{i + 1}", centres, covariances, (0.01,) * 3, (5000,) * 3))
        poses.append(pose)
    touched = TOUCHED.copy()
    if random is not None:
        touched += random.normal(0.0, TOUCH_SIGMA_MM, (3, 3)) + random.normal(0.0, TOUCH_BIAS_SIGMA_MM, 3)
    return views, poses, touched


def error_of(found: HandEye) -> np.ndarray:
    """Small rotation about the scanner's axes and translation by which it is off, as its covariance counts them."""
    turn = TRUE[:3, :3].T @ found.flange_from_scanner[:3, :3]
    rotation = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    return np.concatenate([rotation, found.flange_from_scanner[:3, 3] - TRUE[:3, 3]])


@pytest.mark.parametrize("shots", [1, 2, SHOTS])
def test_exact_centres_give_the_exact_transform(shots):
    views, poses, touched = views_and_poses(shots)
    found = solve_hand_eye(views, poses, touched)
    np.testing.assert_allclose(found.flange_from_scanner, TRUE, atol=DOUBLES_MM)
    assert found.residual_rms_mm < DOUBLES_MM and len(found.per_shot) == shots
    left_out = [shot.left_out_error_mm for shot in found.per_shot]
    assert left_out == [None] if shots == 1 else max(left_out) < DOUBLES_MM


def test_the_covariance_is_honest():
    random = np.random.default_rng(7)
    squares, points = [], []
    for _ in range(DRAWS):
        found = solve_hand_eye(*views_and_poses(3, random))
        error = error_of(found)
        squares.append(error @ np.linalg.solve(found.covariance, error))
        off = (found.flange_from_scanner - TRUE) @ [*WORKING_POINT_MM, 1.0]
        points.append(np.abs(off).max() / point_uncertainty_mm(found, WORKING_POINT_MM))
    # Chi-square of 6 degrees of freedom: mean 6, whose standard error over the draws is 0.25; four of these.
    assert abs(np.mean(squares) - 6.0) < 1.0
    assert np.mean(np.array(points) < 2.0) > 0.93


def test_more_shots_tell_more():
    stated = [solve_hand_eye(*views_and_poses(n, np.random.default_rng(2))).working_point_u_mm for n in (1, 2, 6)]
    assert stated[0] > stated[1] > stated[2]


def test_a_robot_worse_than_assumed_widens_the_uncertainty():
    views, poses, touched = views_and_poses(SHOTS)
    random = np.random.default_rng(5)
    steady = solve_hand_eye(views, poses, touched).working_point_u_mm
    shaken = [pose @ placed(random.normal(0.0, 0.2, 3)) for pose in poses]
    found = solve_hand_eye(views, shaken, touched)
    off = (found.flange_from_scanner - TRUE) @ [*WORKING_POINT_MM, 1.0]
    assert np.linalg.norm(off) < 3 * found.working_point_u_mm
    assert found.working_point_u_mm > 3 * steady


def test_a_shot_with_a_wrong_pose_is_seen_by_the_others():
    views, poses, touched = views_and_poses(SHOTS)
    poses[2] = placed([0.4, 0.0, 0.0]) @ poses[2]
    found = solve_hand_eye(views, poses, touched)
    left_out = [shot.left_out_error_mm for shot in found.per_shot]
    assert int(np.argmax(left_out)) == 2 and abs(left_out[2] - 0.4) < 0.05


def test_poses_that_contradict_the_plate_are_refused():
    views, poses, touched = views_and_poses(SHOTS)
    poses[0] = poses[0] @ placed([0.0, 0.0, 0.0], [0.0, 0.0, 0.1])
    with pytest.raises(PlateMismatch, match=r"contradict each other by \d+\.\d\d mm"):
        solve_hand_eye(views, poses, touched)


def caps(centres: np.ndarray, radius_mm: float = 10.0) -> np.ndarray:
    """A (H, W, 3) grid of what a camera with parallel rays 0.25 mm apart sees of spheres before a plane."""
    x, y = np.meshgrid(np.arange(-50, 50, 0.25), np.arange(-50, 50, 0.25))
    z = np.full(x.shape, 440.0)
    for cx, cy, cz in centres:
        inside = radius_mm**2 - (x - cx) ** 2 - (y - cy) ** 2
        z = np.where(inside > 0, np.minimum(z, cz - np.sqrt(np.maximum(inside, 0.0))), z)
    noise = np.random.default_rng(4).normal(0.0, 0.01, z.shape)
    return np.dstack([x, y, z + noise])


IN_VIEW = np.array([[-27.0, -24.0, 415.0], [25.0, -24.0, 413.0], [17.4, 19.3, 416.0]])
# Base and scanner are one frame here, and the flange is where the scanner is.
FLANGE = np.eye(4)


def test_the_spheres_are_named_by_their_distances():
    order = [2, 0, 1]
    view = find_plate("artefact-1", caps(IN_VIEW), 20.0, IN_VIEW[order], FLANGE)
    np.testing.assert_allclose(view.centres_mm, IN_VIEW[order], atol=0.01)


def test_another_plate_is_refused_with_its_distances():
    longer = IN_VIEW.copy()
    longer[0, 0] -= 1.5
    with pytest.raises(PlateMismatch) as error:
        find_plate("artefact-1", caps(IN_VIEW), 20.0, longer, FLANGE)
    said = [float(number) for number in re.findall(r"[+-]?\d+\.\d{3}", str(error.value))]
    between = [np.linalg.norm(longer[i] - longer[j]) for i, j in ((0, 1), (1, 2), (2, 0))]
    seen = [np.linalg.norm(IN_VIEW[i] - IN_VIEW[j]) for i, j in ((0, 1), (1, 2), (2, 0))]
    np.testing.assert_allclose(said[:3], between, atol=1e-3)
    np.testing.assert_allclose(said[3:], np.subtract(seen, between), atol=0.02)


def test_two_spheres_are_not_enough():
    with pytest.raises(GeometryError, match="2 of 3 spheres of 20 mm found"):
        find_plate("artefact-1", caps(IN_VIEW[:2]), 20.0, IN_VIEW, FLANGE)


def test_a_mirrored_plate_is_refused():
    with pytest.raises(PlateMismatch, match="the plate is mirrored"):
        find_plate("artefact-1", caps(IN_VIEW), 20.0, IN_VIEW * [-1.0, 1.0, 1.0], FLANGE)


def test_two_equal_distances_are_told_apart_by_the_side_and_three_are_not():
    isosceles = np.array([[-24.0, -20.0, 415.0], [24.0, -20.0, 415.0], [0.0, 30.0, 415.0]])
    view = find_plate("artefact-1", caps(isosceles), 20.0, isosceles, FLANGE)
    np.testing.assert_allclose(view.centres_mm, isosceles, atol=0.01)
    turns = np.radians([90, 210, 330])
    equilateral = np.stack([28 * np.cos(turns), 28 * np.sin(turns), np.full(3, 415.0)], axis=1)
    with pytest.raises(PlateMismatch, match="too alike"):
        find_plate("artefact-1", caps(equilateral), 20.0, equilateral, FLANGE)
