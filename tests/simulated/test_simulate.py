"""The simulator against closed forms: OpenCV's projection, formulas in NumPy, the statistics of its noise."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from small_cell import small_scanner
from weldscan import GeometryError, InputError, Lens, Scanner, SimulatedShot, set_threads, simulate_shot, simulated_step
from weldscan.pose import matrix_from_kuka
from weldscan.records.frames import read_frames
from weldscan.records.session import read_session
from weldscan.simulated import (
    BEAD,
    DEFAULT,
    NO_BEAD,
    OTHER_WALL,
    REFERENCE_WALL,
    SPHERE,
    Bead,
    Block,
    Body,
    Cell,
    Photometry,
    Sphere,
    Stem,
    Surface,
    Wall,
    Weld,
    look_at,
    make_scanner,
    pipe,
    placed,
    plates,
    render,
    simulate_session,
)

# Surfaces are met within 1e-8 mm and lenses within 1e-12: what is left is rounding.
POINT_MM = 1e-6
PIXEL = 1e-6
# A frame's light is computed in single precision and kept in 16 bits.
LIGHT = 3e-5
QUIET = Photometry(full_well_e=1e12, read_noise_e=0.0, bits=16, ambient=0.0, black=0.0)
"""No noise, no room light: images are the light itself."""
FULL = 65535.0
EYE = np.eye(4)


SMALL = replace(DEFAULT, scanner=small_scanner())


def shoot(bodies: list[Body], fringes: Any = (), photometry: Photometry = QUIET, **options: Any) -> SimulatedShot:
    return simulate_shot(SMALL.scanner, EYE, bodies, fringes, photometry, **options)


def project(lens: Lens, device_from_points: np.ndarray, points: np.ndarray) -> np.ndarray:
    rotation = cv2.Rodrigues(np.ascontiguousarray(device_from_points[:3, :3]))[0]
    return cv2.projectPoints(points, rotation, device_from_points[:3, 3], lens.K, np.array(lens.dist))[0][:, 0]


def moved(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ pose[:3, :3].T + pose[:3, 3]


def inside(field: np.ndarray) -> np.ndarray:
    """Pixels none of whose neighbours differ: no edge runs through them."""
    kernel = np.ones((3, 3), np.uint8)
    return cv2.erode(field.astype(np.uint8), kernel, borderValue=0).astype(bool)


TILTED = pipe(273.0, offset_mm=0.6, offset_at_deg=185.0, tilt_deg=0.2, ovality_mm=0.1, waviness_mm=0.0)


@pytest.fixture(scope="module")
def part() -> tuple[Cell, np.ndarray, SimulatedShot]:
    cell = replace(SMALL, weld=TILTED)
    view = cell.part_views()[0]
    return cell, view, render(cell, "part", view)


# --- where things are seen


def test_points_project_onto_their_pixels_and_light_onto_its_columns(part):
    cell, _, shot = part
    seen = shot.labels > 0
    v, u = np.nonzero(seen)
    pixels = project(cell.scanner.camera, EYE, shot.points_mm[seen])
    assert np.abs(pixels - np.column_stack([u, v])).max() < PIXEL
    lit = np.isfinite(shot.column_px)
    assert 0.8 < lit.mean() < 1.0
    light = project(cell.scanner.projector, np.linalg.inv(cell.scanner.camera_from_projector), shot.points_mm[lit])
    assert np.abs(light - np.column_stack([shot.column_px[lit], shot.row_px[lit]])).max() < PIXEL


def test_points_of_the_walls_lie_on_tilted_oval_cylinders(part):
    cell, view, shot = part
    weld_from_scanner = np.linalg.inv(np.asarray(cell.base_from_weld)) @ view
    points = moved(weld_from_scanner, shot.points_mm)
    wall, radius = TILTED.other, TILTED.reference.radius_mm
    on_reference = points[shot.labels == REFERENCE_WALL]
    assert np.abs(np.hypot(on_reference[:, 0], on_reference[:, 1]) - radius).max() < POINT_MM
    assert on_reference[:, 2].max() < 0
    axis = np.array([math.tan(wall.tilt_rad[0]), math.tan(wall.tilt_rad[1]), 1.0])
    axis /= np.linalg.norm(axis)
    x = np.array([1.0, 0.0, 0.0]) - axis * axis[0]
    x /= np.linalg.norm(x)
    from_axis = points[shot.labels == OTHER_WALL] - [*wall.offset_mm, 0.0]
    across, along = (
        np.linalg.norm(np.cross(from_axis, axis), axis=1),
        np.arctan2(from_axis @ np.cross(axis, x), from_axis @ x),
    )
    oval = wall.ovality_mm * np.cos(2 * (along - wall.ovality_at_rad))
    assert np.abs(across - wall.radius_mm - oval).max() < POINT_MM
    bead = points[shot.labels == BEAD]
    height = np.hypot(bead[:, 0], bead[:, 1]) - radius
    most = TILTED.bead.height_mm + TILTED.bead.ripple_mm + 0.8
    assert len(bead) > 1000 and height.min() > -1e-3 and TILTED.bead.height_mm < height.max() < most
    assert np.abs(bead[:, 2]).max() <= TILTED.bead.width_mm / 2 + TILTED.bead.wander_mm


def test_the_truth_of_the_step_is_the_distance_from_the_reference_cylinder(part):
    cell, view, shot = part
    points = moved(np.linalg.inv(np.asarray(cell.base_from_weld)) @ view, shot.points_mm)
    lit = np.isfinite(shot.column_px) & (shot.labels == OTHER_WALL)
    radial = np.hypot(points[..., 0], points[..., 1]) - TILTED.reference.radius_mm
    assert (np.isfinite(shot.deviation_mm) == lit).all()
    assert np.abs(shot.deviation_mm - radial)[lit].max() < POINT_MM
    assert np.ptp(radial[lit]) > 0.1


def test_waviness_bends_the_walls_and_stays_out_of_the_truth():
    wavy = replace(SMALL, weld=pipe(273.0, waviness_mm=0.02))
    even = replace(SMALL, weld=pipe(273.0, waviness_mm=0.0))
    view = wavy.part_views()[0]
    a, b = render(wavy, "part", view), render(even, "part", view)
    on = (a.labels == OTHER_WALL) & (b.labels == OTHER_WALL)
    apart = np.linalg.norm(a.points_mm - b.points_mm, axis=-1)[on]
    assert 0.003 < np.median(apart) < 0.02
    both = np.isfinite(a.deviation_mm) & np.isfinite(b.deviation_mm)
    # The pixel sees the wavy wall up to 0.02 mm/cos further along it, where the step differs by a thousandth of that.
    assert np.abs(a.deviation_mm - b.deviation_mm)[both].max() < 1e-4


def test_balls_blocks_and_stems_are_hit_where_formulas_say():
    ball, block, stem = (
        placed((-30.0, 5.0, 430.0)),
        placed((35.0, 0.0, 420.0), (0.5, 0.3, 0.1)),
        placed((0.0, -20.0, 440.0), (1.2, 0.2, 0.0)),
    )
    shot = shoot(
        [
            Body(Sphere(12.0), ball, label=1),
            Body(Block((20.0, 24.0, 6.0)), block, label=2),
            Body(Stem(4.0, 30.0), stem, label=3),
        ]
    )
    seen = {label: shot.points_mm[shot.labels == label] for label in (1, 2, 3)}
    assert all(len(points) > 200 for points in seen.values())
    assert np.abs(np.linalg.norm(seen[1] - ball[:3, 3], axis=1) - 12.0).max() < POINT_MM
    faces = np.abs(moved(np.linalg.inv(block), seen[2])) - [10.0, 12.0, 3.0]
    assert np.abs(faces.max(axis=1)).max() < POINT_MM
    local = moved(np.linalg.inv(stem), seen[3])
    assert np.abs(np.hypot(local[:, 0], local[:, 1]) - 4.0).max() < POINT_MM
    assert local[:, 2].min() >= 0 and local[:, 2].max() <= 30.0
    # Which pixels see the ball: their ray passes its centre within its radius.
    rays = np.dstack([grid_rays(SMALL.scanner.camera), np.ones(shot.labels.shape)])
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    miss = np.linalg.norm(np.cross(rays, ball[:3, 3]), axis=-1)
    assert ((miss < 12.0) == (shot.labels == 1)).all()


def grid_rays(lens: Lens) -> np.ndarray:
    u, v = np.meshgrid(np.arange(float(lens.width)), np.arange(float(lens.height)))
    pixels = np.dstack([u, v]).reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-13)
    rays = cv2.undistortPointsIter(pixels, lens.K, np.array(lens.dist), None, None, stop)
    return rays.reshape(lens.height, lens.width, 2)


def test_a_shadow_is_where_the_ball_stands_before_the_lamp():
    centre = np.array([5.0, 3.0, 390.0])
    shot = shoot(
        [Body(Block((300.0, 300.0, 2.0)), placed((0, 0, 431.0)), label=1), Body(Sphere(14.0), placed(centre), label=2)]
    )
    wall = shot.points_mm[shot.labels == 1]
    lamp = SMALL.scanner.camera_from_projector[:3, 3]
    to_lamp = lamp - wall
    along = np.clip(((centre - wall) * to_lamp).sum(1) / (to_lamp**2).sum(1), 0, 1)
    miss = np.linalg.norm(wall + along[:, None] * to_lamp - centre, axis=1)
    pixel = project(SMALL.scanner.projector, np.linalg.inv(SMALL.scanner.camera_from_projector), wall)
    width, height = SMALL.scanner.projector.width, SMALL.scanner.projector.height
    shown = (pixel > -0.5).all(1) & (pixel[:, 0] < width - 0.5) & (pixel[:, 1] < height - 0.5)
    lit = np.isfinite(shot.column_px[shot.labels == 1])
    sure = np.abs(miss - 14.0) > 1e-3
    assert ((miss > 14.0) & shown == lit)[sure].all()
    assert 0.01 < (miss < 14.0).mean() < 0.3
    # And the side of the ball that is turned away from the lamp.
    ball = shot.points_mm[shot.labels == 2]
    facing = ((ball - centre) * (lamp - ball)).sum(1) > 0
    assert (facing == np.isfinite(shot.column_px[shot.labels == 2])).all()


# --- how bright they are

PLANE = [Body(Block((400.0, 400.0, 2.0)), placed((0.0, 0.0, 421.0), (0.3, -0.2, 0.0)), Surface(albedo=0.6))]


def test_a_matt_surface_is_as_bright_as_lambert_and_the_distance_say():
    shot = shoot(PLANE, exposures=[1.0, 0.5])
    lit = inside(np.isfinite(shot.column_px))
    points = shot.points_mm[lit]
    to_lamp = SMALL.scanner.camera_from_projector[:3, 3] - points
    distance = np.linalg.norm(to_lamp, axis=1)
    normal = -np.asarray(PLANE[0].scene_from_body)[:3, 2]
    expected = 0.6 * (to_lamp @ normal) / distance * (420.0 / distance) ** 2
    assert np.ptp(expected) > 0.1
    assert np.abs(shot.white[0][lit] / FULL - expected).max() < LIGHT
    assert np.abs(shot.white[1][lit] / FULL - 0.5 * expected).max() < LIGHT
    assert shot.white[0][~np.isfinite(shot.column_px) & (shot.labels == 0)].max(initial=0) == 0


def test_gloss_is_added_along_the_halfway_vector():
    glossy = [replace(PLANE[0], surface=Surface(albedo=0.0, specular=0.5, shininess=40.0))]
    shot = shoot(glossy)
    lit = inside(np.isfinite(shot.column_px))
    points = shot.points_mm[lit]
    to_lamp = SMALL.scanner.camera_from_projector[:3, 3] - points
    distance = np.linalg.norm(to_lamp, axis=1, keepdims=True)
    halfway = to_lamp / distance - points / np.linalg.norm(points, axis=1, keepdims=True)
    halfway /= np.linalg.norm(halfway, axis=1, keepdims=True)
    normal = -np.asarray(PLANE[0].scene_from_body)[:3, 2]
    expected = 0.5 * (halfway @ normal) ** 40 * (420.0 / distance[:, 0]) ** 2
    assert np.abs(shot.white[0][lit] / FULL - expected).max() < LIGHT


@pytest.mark.parametrize(("gamma", "blur"), [(1.0, 0.6), (1.35, 0.4), (2.2, 1.0)])
@pytest.mark.parametrize("axis", ["x", "y"])
def test_fringes_are_the_shown_pattern_softened_by_pixel_and_blur(gamma, blur, axis):
    sets = [(axis, 3, 3), (axis, 80, 5)]
    shot = shoot(PLANE, sets, replace(QUIET, gamma=gamma, blur_px=blur))
    lit = inside(np.isfinite(shot.column_px))
    place, side = (shot.column_px, 1280) if axis == "x" else (shot.row_px, 800)
    # Box and Gaussian on one fine grid: a plain sum over where the light may come from.
    box = (np.arange(40) + 0.5) / 40 - 0.5
    offsets = np.arange(-6, 6, 0.025)
    weight = np.exp(-0.5 * ((offsets[:, None] - box) / blur) ** 2).sum(1)
    weight /= weight.sum()
    frames = iter(shot.frames[0])
    pick = np.flatnonzero(lit)[::97]
    for _, periods, steps in sets:
        for i in range(steps):
            u = place.flat[pick][:, None] + offsets
            pattern = (0.5 + 0.5 * np.cos(2 * np.pi * (periods * (u + 0.5) / side - i / steps))) ** gamma
            # 2e-4: the sum over a grid, and the harmonics that are left out.
            assert np.abs(next(frames).flat[pick] / shot.white[0].flat[pick] - pattern @ weight).max() < 2e-4
    assert next(frames, None) is None


def test_any_picture_can_be_shown():
    shot = shoot(PLANE, [("x", 16, 4)], replace(QUIET, blur_px=0.5))
    u = np.arange(1280)
    columns = np.round(255 * (0.5 + 0.5 * np.cos(2 * np.pi * (16 * (u + 0.5) / 1280 - 1 / 4)))).astype(np.uint8)
    shown = shot.capture(np.tile(columns, (800, 1)))
    lit = inside(np.isfinite(shot.column_px))
    # The picture has 8 bits; the interpolation between pixels is not quite their box.
    assert np.abs(shown[lit] / FULL - shot.frames[0][1][lit] / FULL).max() < 2e-3
    white = shot.capture(np.full((800, 1280), 255, np.uint8)).astype(int)
    assert np.abs(white - shot.white[0])[lit].max() <= 1
    assert shot.capture(np.zeros((800, 1280), np.uint8)).max() == 0
    split = np.zeros((800, 1280), np.uint8)
    split[:, 640:] = 255
    bright = shot.capture(split)[lit] > 0.5 * shot.white[0][lit]
    assert ((shot.column_px[lit] > 639.5) == bright).all()
    with pytest.raises(InputError, match="picture"):
        shot.capture(np.zeros((80, 80), np.uint8))
    with pytest.raises(InputError, match="exposure"):
        shot.capture(split, exposure=0.0)


def test_a_chessboard_has_its_corners_where_it_should():
    board = placed((0.0, 0.0, 430.0), (0.2, 2.9, 0.1))
    scanner = make_scanner()
    body = Body(Block((140.0, 120.0, 4.0), squares=(12, 10), square_mm=10.0), board, Surface(albedo=0.9))
    shot = simulate_shot(scanner, EYE, [body], [], Photometry())
    found, corners = cv2.findChessboardCornersSB(shot.white[0], (11, 9), flags=cv2.CALIB_CB_ACCURACY)
    assert found
    x, y = np.meshgrid(10.0 * np.arange(-5, 6), 10.0 * np.arange(-4, 5))
    places = np.dstack([x, y, np.full(x.shape, 2.0)]).reshape(-1, 3)
    expected = project(scanner.camera, board, places)
    apart = np.linalg.norm(corners.reshape(-1, 1, 2) - expected, axis=2).min(axis=1)
    # OpenCV's corner finder under noise.
    assert np.sqrt((apart**2).mean()) < 0.1


# --- how noisy they are


def test_noise_has_the_variance_of_electrons_and_a_normal_histogram():
    noisy = Photometry(full_well_e=8000.0, read_noise_e=30.0, bits=16, black=0.05, ambient=0.0, blur_px=0.0)
    shots = [shoot(PLANE, [("x", 2, 8)], noisy, seed=s) for s in range(6)]
    clean = shoot(PLANE, [("x", 2, 8)], replace(noisy, full_well_e=1e12, read_noise_e=0.0))
    lit = inside(np.isfinite(clean.column_px))
    signal = np.stack([f[lit] for f in clean.frames[0]]) / FULL - 0.05
    normal = []
    for shot in shots:
        sigma = np.sqrt(signal / 8000.0 + (30.0 / 8000.0) ** 2)
        normal.append((np.stack([f[lit] for f in shot.frames[0]]) / FULL - 0.05 - signal) / sigma)
    z = np.stack(normal)
    draws = z.size
    # Five standard errors each.
    assert abs(z.mean()) < 5 / math.sqrt(draws)
    assert abs(z.std() - 1) < 5 / math.sqrt(2 * draws)
    assert abs((z**3).mean()) < 5 * math.sqrt(15 / draws)
    assert abs((z**4).mean() - 3) < 0.01 + 5 * math.sqrt(96 / draws)
    for bins in np.array_split(np.argsort(signal.ravel()), 5):
        assert abs(z.reshape(6, -1)[:, bins].std() - 1) < 5 / math.sqrt(2 * 6 * len(bins))
    limit = 5 / math.sqrt(z[0, 0].size)
    assert abs((z[0, 0] * z[1, 0]).mean()) < limit and abs((z[0, 0] * z[0, 1]).mean()) < limit
    assert abs((z[0, 0][1:] * z[0, 0][:-1]).mean()) < limit


def test_light_beyond_full_scale_is_clipped_and_the_black_level_stays():
    shot = shoot(PLANE, photometry=Photometry(lamp=1.0, black=0.1, ambient=0.0), exposures=[1.0, 1000.0])
    lit = inside(np.isfinite(shot.column_px))
    assert shot.white[0].dtype == np.uint8
    assert shot.white[1][lit].min() == 255
    dark = shot.labels == 0
    assert abs(float(shot.white[1][dark].mean()) - 25.5) < 0.1 if dark.any() else True


def test_the_same_seed_gives_the_same_bits_on_any_number_of_threads():
    cell = SMALL
    view = cell.artefact_views()[0]
    shots = []
    try:
        for threads in (1, 2, 5):
            set_threads(threads)
            shots.append(render(cell, "artefact", view, seed=3))
    finally:
        set_threads(None)
    for shot in shots[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(shot.frames[0], shots[0].frames[0], strict=True))
        assert np.array_equal(shot.points_mm, shots[0].points_mm, equal_nan=True)
    other = render(cell, "artefact", view, seed=4)
    assert (other.frames[0][0] != shots[0].frames[0][0]).mean() > 0.1
    assert np.array_equal(other.points_mm, shots[0].points_mm, equal_nan=True)


def test_pixels_on_an_edge_are_between_the_two_sides():
    far = Body(Block((400.0, 400.0, 2.0)), placed((0.0, 0.0, 451.0)), Surface(albedo=0.1))
    near = Body(Block((60.0, 60.0, 2.0)), placed((0.0, 0.0, 401.0), (0.0, 0.0, 0.3)), Surface(albedo=0.9), 2)
    shot = shoot([far, near])
    level = shot.white[0] / FULL
    between = (level > 0.25) & (level < 0.65)
    edge = (shot.labels == 2) & ~inside(shot.labels == 2)
    assert 0.2 < between.sum() / edge.sum() < 2.0
    assert not between[inside(shot.labels == 2)].any()


# --- the step


@pytest.mark.parametrize("diameter", [108.0, 630.0])
def test_the_step_at_the_seam_is_offset_diameter_and_ovality(diameter):
    weld = pipe(diameter, offset_mm=0.4, offset_at_deg=30.0, diameter_difference_mm=0.5, ovality_mm=0.1)
    along = np.radians(np.arange(0, 360, 5.0))
    turn = along - math.radians(30.0)
    across = 0.4 * np.sin(turn)
    expected = 0.4 * np.cos(turn) + np.sqrt((diameter / 2 + 0.25) ** 2 - across**2) - diameter / 2
    expected += 0.1 * np.cos(2 * along)
    # The oval is read at the angle about its own axis, up to offset/radius away.
    assert np.abs(simulated_step(weld, along) - expected).max() < 0.1 * 2 * 0.4 / (diameter / 2) + 1e-9


def test_the_step_of_plates_is_their_offset_and_tilt_does_not_change_it():
    seam = np.array([-50.0, 0.0, 50.0])
    assert np.allclose(simulated_step(plates(0.5, angle_deg=2.0), seam), 0.5, atol=1e-12)
    cell = replace(SMALL, weld=plates(0.5), part_at_deg=(0.0,))
    shot = render(cell, "part", cell.part_views()[0])
    on = np.isfinite(shot.deviation_mm)
    assert on.any() and np.abs(shot.deviation_mm[on] - 0.5).max() < POINT_MM
    assert {REFERENCE_WALL, OTHER_WALL, BEAD} <= set(np.unique(shot.labels).tolist())


def test_a_session_of_plates_is_refused_in_one_line(tmp_path):
    with pytest.raises(InputError, match="a plate cannot be measured yet") as refused:
        simulate_session(tmp_path / "plates", replace(SMALL, weld=plates(0.5)))
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "plates").exists()


def test_a_pipe_without_a_weld_shows_none():
    cell = replace(SMALL, weld=pipe(offset_mm=0.0, bead=NO_BEAD, waviness_mm=0.0))
    shot = render(cell, "part", cell.part_views()[0])
    assert set(np.unique(shot.labels).tolist()) <= {0, REFERENCE_WALL, OTHER_WALL}
    points = moved(np.linalg.inv(np.asarray(cell.base_from_weld)) @ cell.part_views()[0], shot.points_mm)
    assert np.abs(np.hypot(points[..., 0], points[..., 1]) - 315.0)[shot.labels > 0].max() < POINT_MM


# --- sessions


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], list[tuple[int, int, str]]]:
    folder = tmp_path_factory.mktemp("cell") / "session"
    calls: list[tuple[int, int, str]] = []
    cell = replace(DEFAULT, scanner=small_scanner(2), artefact_shots=2, part_exposures=(0.6, 1.8))
    return folder, simulate_session(folder, cell, lambda *call: calls.append(call)), calls


def test_a_session_is_whole_and_says_what_was_done(recorded):
    folder, truth, calls = recorded
    session = read_session(folder)
    assert [shot.name for shot in session.shots] == ["artefact-1", "artefact-2", "part-1", "part-2"]
    assert json.loads((folder / "truth.json").read_text()) == json.loads(json.dumps(truth))
    assert [done for done, _, _ in calls] == [0, 1, 2, 3, 4] and {total for _, total, _ in calls} == {4}
    frames = read_frames(session, session.part_shots[0])
    assert [len(stack) for stack in frames] == [12, 12]
    assert len((folder / "touch.csv").read_text().splitlines()) == 61
    assert (folder / "shots/part-1/e1_white.png").exists() and (folder / "shots/artefact-1/white.png").exists()


def test_reported_poses_are_the_true_ones_within_their_noise(recorded):
    folder, truth, _ = recorded
    session = read_session(folder)
    flange_from_scanner = np.array(truth["hand_eye_T_flange_camera"])
    for shot in session.shots:
        pose = shot.flange_pose
        assert pose is not None
        reported = matrix_from_kuka(pose.X, pose.Y, pose.Z, pose.A, pose.B, pose.C)
        true = np.array(truth["shots"][shot.name]["T_base_camera"]) @ np.linalg.inv(flange_from_scanner)
        apart = np.linalg.inv(true) @ reported
        # Six sigma of 0.03 mm and 0.005 degrees; and noise there is.
        assert 1e-4 < np.abs(apart[:3, 3]).max() < 6 * 0.03
        angle = math.acos(min(1.0, (np.trace(apart[:3, :3]) - 1) / 2))
        assert 0.0 < math.degrees(angle) < 6 * 0.005
    assert session.artefact is not None
    touched = np.array(session.artefact.centres_base) - truth["sphere_centres_base"]
    assert 1e-4 < np.abs(touched).max() < 0.06


def test_the_demo_step_is_047_at_its_largest(recorded):
    _, truth, _ = recorded
    step = truth["step_mm"]
    assert step["max_abs"] == pytest.approx(0.47, abs=1e-6) and step["max_abs_at_deg"] == 170
    for entry in (truth["shots"]["part-1"]["step"], truth["shots"]["part-2"]["step"]):
        for degrees, value in entry["at_seam_by_deg"].items():
            turn = math.radians(int(degrees) - 170)
            second_order = (0.47 * math.sin(turn)) ** 2 / (2 * 315.0)
            assert value == pytest.approx(0.47 * math.cos(turn) - second_order, abs=1e-6)
    assert 0.42 < step["mean"] < 0.47 and 0.42 < step["median"] < 0.47


def test_bins_go_through_zero_and_the_same_cell_gives_the_same_session(tmp_path):
    cell = replace(SMALL, part_at_deg=(2.0,), artefact_shots=1, weld=pipe(273.0, offset_at_deg=0.0))
    first, second = (simulate_session(tmp_path / name, cell) for name in ("a", "b"))
    assert first == second
    for file in ("session.json", "touch.csv", "shots/part-1/003.png"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    bins = [int(c) for c in first["step_mm"]["at_seam_by_deg"]]
    assert {0, 2, 358} <= set(bins) and all(c % 2 == 0 and 0 <= c < 360 for c in bins) and 180 not in bins
    assert first["step_mm"]["max_abs_at_deg"] == 0


def test_sphere_distances_tell_the_spheres_apart():
    centres = DEFAULT.sphere_centres()
    sides = sorted(float(np.linalg.norm(centres[i] - centres[j])) for i, j in ((0, 1), (1, 2), (2, 0)))
    assert min(np.diff(sides)) > 5.0


def test_every_artefact_view_shows_all_three_spheres_and_every_part_view_the_seam():
    for view in DEFAULT.artefact_views():
        shot = render(replace(SMALL, fringes=()), "artefact", view)
        lit = np.isfinite(shot.column_px)
        # A ball of 20 mm is 31 px wide here: half of its disc, at least, is lit and in view.
        assert all((lit & (shot.labels == SPHERE + i)).sum() > 350 for i in range(3))
    for view in DEFAULT.part_views():
        shot = render(replace(SMALL, fringes=()), "part", view)
        share = [(shot.labels == label).mean() for label in (REFERENCE_WALL, OTHER_WALL, BEAD)]
        assert share[0] > 0.3 and share[1] > 0.3 and share[2] > 0.02


def test_cells_for_bad_input(tmp_path):
    only_white = replace(SMALL, fringes=())
    two = render(replace(only_white, spheres_there=(True, False, True)), "artefact", DEFAULT.artefact_views()[0])
    assert SPHERE + 1 not in two.labels and SPHERE in two.labels and SPHERE + 2 in two.labels
    mirrored = replace(only_white, mirrored=True)
    centres = [np.asarray(b.scene_from_body)[:3, 3] for b in mirrored.artefact_bodies() if isinstance(b.shape, Sphere)]
    base_from_plate = np.asarray(DEFAULT.base_from_plate)
    flat = moved(np.linalg.inv(base_from_plate), np.array(centres)) * [-1, 1, 1]
    assert np.allclose(moved(base_from_plate, flat), DEFAULT.sphere_centres())
    one = replace(only_white, part_aside_mm=150.0)
    assert set(np.unique(render(one, "part", one.part_views()[0]).labels).tolist()) <= {0, OTHER_WALL}
    alone = replace(SMALL, robot=None, artefact_shots=0, part_at_deg=(170.0,))
    simulate_session(tmp_path / "alone", alone)
    assert not read_session(tmp_path / "alone").has_robot
    with pytest.raises(InputError, match="robot"):
        simulate_session(tmp_path / "none", replace(alone, artefact_shots=1))


# --- what is refused


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"photometry": Photometry(gamma=0.0)}, "gamma"),
        ({"photometry": Photometry(bits=12)}, "bits"),  # type: ignore[arg-type]
        ({"photometry": Photometry(full_well_e=0.0)}, "full_well_e"),
        ({"photometry": Photometry(lamp=math.nan)}, "lamp"),
        ({"fringes": (("z", 8, 4),)}, "axis"),
        ({"fringes": (("x", math.inf, 4),)}, "periods"),
        ({"fringes": (("x", 8, 0),)}, "steps"),
        ({"weld": pipe(-1.0)}, "radius_mm"),
        ({"weld": Weld(Wall(math.inf), Wall(100.0))}, "plate"),
        ({"weld": Weld(Wall(100.0, offset_mm=(0.1, 0.0)), Wall(100.0))}, "offset_mm"),
        ({"weld": pipe(bead=Bead(width_mm=math.nan))}, "width_mm"),
        ({"weld": pipe(ovality_mm=100.0)}, "ovality_mm"),
        ({"weld": pipe(waviness_mm=-1.0)}, "waviness_mm"),
        ({"part_surface": Surface(albedo=1.5)}, "albedo"),
        ({"part_surface": Surface(shininess=0.0)}, "shininess"),
    ],
)
def test_wrong_numbers_are_refused_by_name(change, named):
    cell = replace(SMALL, **change)
    with pytest.raises(InputError, match=named):
        render(cell, "part", DEFAULT.part_views()[0])


def test_wrong_poses_and_bodies_are_refused():
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    calls: list[Callable[[], object]] = [
        lambda: simulate_shot(SMALL.scanner, mirror, PLANE, [], QUIET),
        lambda: shoot([Body(Sphere(1.0), mirror)]),
        lambda: shoot([Body(Sphere(math.nan), EYE)]),
        lambda: shoot([Body(Block((1.0, 0.0, 1.0)), EYE)]),
        lambda: shoot([Body(Stem(1.0, -1.0), EYE)]),
        lambda: shoot([Body("ball", EYE)]),  # type: ignore[arg-type]
        lambda: shoot([object()]),  # type: ignore[list-item]
        lambda: shoot(PLANE, exposures=[0.0]),
        lambda: shoot(PLANE, exposures=[]),
        lambda: shoot(PLANE, [("x", 8, 1000)], exposures=[1.0, 2.0, 3.0]),
        lambda: simulated_step(TILTED, [math.nan]),
        lambda: simulated_step("weld", [0.0]),
    ]
    for call in calls:
        with pytest.raises((InputError, GeometryError)):
            call()


# Scenes of any proportions, one number of which may be anything: rendered or refused, and nothing else happens.
LIMITS = {
    "radius": (1.0, 2e3),
    "x": (-50, 50),
    "y": (-50, 50),
    "tilt_x": (-0.49, 0.49),
    "tilt_y": (-0.49, 0.49),
    "ovality": (-20, 20),
    "at": (-9, 9),
    "waviness": (0, 1),
    "width": (0, 100),
    "height": (0, 30),
    "ripple": (0, 5),
    "pitch": (0.1, 50),
    "wander": (0, 20),
    "depth": (0, 2e3),
    "periods": (0.1, 300),
    "gamma": (0.2, 5),
}


@settings(max_examples=150, deadline=None)
@given(
    scene=st.fixed_dictionaries({name: st.floats(*limits) for name, limits in LIMITS.items()}),
    broken=st.one_of(st.none(), st.tuples(st.sampled_from(sorted(LIMITS)), st.floats())),
)
def test_no_scene_makes_it_fail_in_another_way(scene, broken):
    s = scene | ({broken[0]: broken[1]} if broken else {})
    other = Wall(s["radius"], (s["x"], s["y"]), (s["tilt_x"], s["tilt_y"]), s["ovality"], s["at"], s["waviness"])
    weld = Weld(Wall(s["radius"]), other, Bead(s["width"], s["height"], s["ripple"], s["pitch"], s["wander"]))
    pose = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, s["depth"]], [0, 0, 0, 1]])
    bodies = [Body(weld, pose), Body(Sphere(10.0), placed((0.0, 0.0, 400.0)), label=9)]
    photometry = Photometry(gamma=s["gamma"], blur_px=0.3)
    try:
        shot = simulate_shot(small_scanner(40), EYE, bodies, [("x", s["periods"], 3)], photometry)
    except InputError:
        # An oval of more than a tenth of the radius is refused too.
        assert broken or abs(s["ovality"]) > 0.1 * s["radius"]
        return
    assert shot.frames[0][0].shape == (24, 32)
    lit = np.isfinite(shot.column_px)
    assert (shot.labels[lit] > 0).all() and np.isfinite(shot.points_mm[lit]).all()


# --- end to end: a decoder in NumPy and OpenCV that shares nothing with the simulator


def decode(frames: list[np.ndarray], fringes: Any, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Projector column and modulation, hierarchically unwrapped."""
    absolute, k = None, 0
    for _, periods, steps in fringes:
        images = np.stack(frames[k : k + steps]).astype(float)
        k += steps
        turns = np.exp(2j * np.pi * np.arange(steps) / steps)
        total = np.tensordot(turns, images, 1)
        wrapped = np.angle(total) / (2 * np.pi) % 1
        modulation = 2 / steps * np.abs(total)
        if absolute is None:
            absolute = wrapped / periods
        else:
            absolute = (np.round(absolute * periods - wrapped) + wrapped) / periods
    return absolute * width - 0.5, modulation


def triangulate(scanner: Scanner, column: np.ndarray) -> np.ndarray:
    """Points where camera rays reach the column, by the secant method on OpenCV's projection."""
    rays = np.dstack([grid_rays(scanner.camera), np.ones(column.shape)]).reshape(-1, 3)
    inverse = np.linalg.inv(scanner.camera_from_projector)

    def miss(depth: np.ndarray) -> np.ndarray:
        return project(scanner.projector, inverse, rays * depth[:, None])[:, 0] - column.ravel()

    near, far = np.full(len(rays), 400.0), np.full(len(rays), 440.0)
    at_near, at_far = miss(near), miss(far)
    for _ in range(7):
        slope = (at_far - at_near) / np.where(far == near, 1.0, far - near)
        near, at_near = far, at_far
        far = np.clip(far - at_far / np.where(slope == 0, np.inf, slope), 100, 2000)
        at_far = miss(far)
    return (rays * far[:, None]).reshape(*column.shape, 3)


@pytest.mark.parametrize("diameter", [108.0, 630.0])
def test_an_independent_decoder_recovers_the_pipe_and_its_step(diameter):
    scanner = small_scanner(2)
    cell = replace(DEFAULT, scanner=scanner, weld=pipe(diameter, offset_mm=0.5, offset_at_deg=170.0, waviness_mm=0.0))
    view = cell.part_views()[0]
    shot = render(cell, "part", view, seed=5)
    column, modulation = decode(shot.frames[0], cell.fringes, scanner.projector.width)
    points = triangulate(scanner, column)
    good = (modulation > 15) & inside(np.isfinite(shot.column_px) & (shot.labels != BEAD))
    # 0.03 mm of noise is what the method has at this brightness.
    error = np.linalg.norm(points - shot.points_mm, axis=-1)[good]
    assert np.median(error) < 0.05 and np.sqrt((error**2).mean()) < 0.1
    local = moved(np.linalg.inv(np.asarray(cell.base_from_weld)) @ view, points)
    height = np.hypot(local[..., 0], local[..., 1]) - diameter / 2
    on_reference, on_other = (good & (shot.labels == label) for label in (REFERENCE_WALL, OTHER_WALL))
    # Means over 60,000 pixels and more; 2 micrometres are left for pixels that are not a point.
    assert abs(height[on_reference].mean()) < 0.002
    assert abs((height - shot.deviation_mm)[on_other].mean()) < 0.002
    assert abs(height[on_other].mean()) > 0.2


def test_an_independent_decoder_recovers_the_spheres():
    scanner = small_scanner(2)
    cell = replace(DEFAULT, scanner=scanner)
    view = cell.artefact_views()[1]
    shot = render(cell, "artefact", view, seed=6)
    column, modulation = decode(shot.frames[0], cell.fringes, scanner.projector.width)
    points = moved(view, triangulate(scanner, column))
    for i, centre in enumerate(cell.sphere_centres()):
        on = points[(shot.labels == SPHERE + i) & (modulation > 15)]
        on = on[np.abs(np.linalg.norm(on - centre, axis=1) - 10.0) < 0.3]
        fitted = centre.copy()
        for _ in range(20):
            away = on - fitted
            distance = np.linalg.norm(away, axis=1)
            fitted += np.linalg.lstsq(away / distance[:, None], distance - 10.0, rcond=None)[0]
        assert len(on) > 1500 and np.abs(fitted - centre).max() < 0.005


def test_look_at_looks():
    pose = look_at((0, 0, 0), (100.0, 20.0, 300.0), (0, 1.0, 0))
    assert np.allclose(moved(np.linalg.inv(pose), np.zeros((1, 3)))[0, :2], 0) and np.linalg.det(pose) == pytest.approx(
        1
    )
    assert (np.linalg.inv(pose)[:3, :3] @ [0, 1.0, 0])[1] < 0
