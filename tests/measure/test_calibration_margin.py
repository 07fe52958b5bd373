"""What a scanner's calibration takes of the step: propagated right, nominal where unstated, a bar where it matters."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from weldscan import Lens, Scanner
from weldscan._weldcore import triangulate
from weldscan.calibration.bundle import K3, PARAMETERS
from weldscan.geometry import rotation_of
from weldscan.measure.calibration_margin import (
    NOISE_PX,
    CalibrationMargin,
    Unevenness,
    calibration_above,
    calibration_margin,
    nominal_covariance,
    step_jacobians,
    working_distance_mm,
)
from weldscan.measure.part_views import PartView
from weldscan.records.scanner import CovarianceSpec
from weldscan.result import Label, Severity
from weldscan.simulated.scenes import scanner_for

SCANNER = scanner_for(211.0)
DISTANCE_MM, RADIUS_MM, WALL_MM = 430.0, 315.0, 6.0
# Hardly correlated: the fit is plain least squares, which a test can do by itself.
PLAIN = Unevenness(0.005, 1e-3, 1e-3)
UNSTATED = SimpleNamespace(covariance=None)


def view_of(distance_mm: float = DISTANCE_MM, stride: int = 6) -> PartView:
    """A pipe along the image's rows, its crest at a distance: what every sixth pixel sees of it."""
    u, v = np.meshgrid(np.arange(0, 480, stride), np.arange(0, 360, stride))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)
    ray = np.column_stack([SCANNER.camera.undistort(pixels), np.ones(len(pixels))])
    axis, zero = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])
    origin = np.array([0.0, 0.0, distance_mm + RADIUS_MM])
    # |(0, y t, t - z0)| = R: the nearer crossing.
    a, b, c = ray[:, 1] ** 2 + 1, -2 * origin[2], origin[2] ** 2 - RADIUS_MM**2
    points = ray * ((-b - np.sqrt(b * b - 4 * a * c)) / (2 * a))[:, None]
    along = points[:, 0]
    from_axis = points - origin
    square = np.cross(axis, zero)
    labels = np.where(np.abs(along) < 8, Label.BEAD, np.where(along < 0, Label.REFERENCE_WALL, Label.OTHER_WALL))
    shot = SimpleNamespace(
        labels=labels.astype(np.uint8),
        angle_rad=np.arctan2(from_axis @ square, from_axis @ zero),
        axial_mm=along,
        axis=axis,
        zero=zero,
        radius_mm=RADIUS_MM,
        noise_mm=0.03,
        points_mm=lambda at: points.reshape(-1, 3)[at],
    )
    return PartView("part-1", 0, np.zeros(u.shape, np.uint8), np.eye(4), np.eye(4), shot)


ANGLES = np.array([-8.0, 0.0, 8.0])


def moved(scanner: Scanner, by: np.ndarray) -> Scanner:
    def lens(given: Lens, d: np.ndarray) -> Lens:
        k = given.K + np.array([[d[0], 0, d[2]], [0, d[1], d[3]], [0, 0, 0]])
        return Lens(given.width, given.height, k, np.array([*given.dist, 0.0][:5]) + d[4:])

    relation = scanner.camera_from_projector.copy()
    relation[:3, :3] = rotation_of(by[18:21]) @ relation[:3, :3]
    relation[:3, 3] += by[21:24]
    return Scanner(lens(scanner.camera, by[:9]), lens(scanner.projector, by[9:18]), relation)


def test_the_step_moves_as_a_wrong_scanner_moves_it():
    # Every pixel of the camera, triangulated with another scanner, and the walls fitted from the points.
    view = view_of(stride=1)
    points = view.shot.points_mm(np.arange(view.reason.size))
    column = SCANNER.project_to_projector(points)[:, 0].reshape(view.reason.shape)
    covariance = nominal_covariance(SCANNER, DISTANCE_MM)
    values, vectors = np.linalg.eigh(covariance)
    by = vectors @ (np.sqrt(np.maximum(values, 0)) * np.random.default_rng(3).normal(size=24))
    shift = triangulate(column, moved(SCANNER, by)).points_mm - points.reshape(*view.reason.shape, 3)
    shot = view.shot
    walls = np.flatnonzero((shot.labels != Label.BEAD) & np.isfinite(shift[..., 0].ravel()))[::7]
    angle, z = shot.angle_rad[walls], shot.axial_mm[walls] / 100
    normal = np.outer(np.cos(angle), shot.zero) + np.outer(np.sin(angle), np.cross(shot.axis, shot.zero))
    deviation = np.einsum("ni,ni->n", normal, shift.reshape(-1, 3)[walls])

    def cylinder(angle: np.ndarray, z: np.ndarray) -> np.ndarray:
        return np.stack([z**0, np.cos(angle), np.sin(angle), z * np.cos(angle), z * np.sin(angle)], axis=1)

    other = (shot.labels[walls] == Label.OTHER_WALL)[:, None]
    x = np.concatenate([cylinder(angle, z), other * cylinder(angle, z)], axis=1)
    found = np.linalg.lstsq(x, deviation, rcond=None)[0][5:]
    seam = np.radians(ANGLES)
    step = cylinder(seam, 0 * seam) @ found
    predicted = step_jacobians(SCANNER, [view], ANGLES, WALL_MM, PLAIN)[0] @ by
    assert np.abs(step).max() > 1e-3
    np.testing.assert_allclose(predicted, step, atol=0.15 * np.abs(step).max())


def test_an_error_of_scale_leaves_a_step_of_zero():
    # A longer baseline is a larger space, and a larger pipe has no step either.
    for gain in step_jacobians(SCANNER, [view_of()], ANGLES, WALL_MM, PLAIN):
        assert np.abs(gain[:, 21:24] @ (1e-3 * SCANNER.camera_from_projector[:3, 3])).max() < 1e-3


def margin_at(distance_mm: float) -> float:
    found = calibration_margin(UNSTATED, SCANNER, [view_of(distance_mm)], ANGLES, WALL_MM, PLAIN)
    assert found is not None and not found.stated
    return found.u_mm


def test_it_grows_where_no_board_stood():
    # The axes meet at the working distance whatever the part does.
    assert working_distance_mm(SCANNER, 600.0) == pytest.approx(DISTANCE_MM, abs=15)
    middle, far = margin_at(DISTANCE_MM), margin_at(640.0)
    # 15 poses, 0.1 px: hundredths of a millimetre.
    assert 0.003 < middle < 0.15
    assert far > 1.5 * middle


def test_nearly_parallel_axes_meet_at_no_working_distance():
    lens = Lens(640, 480, [[1000.0, 0, 319.5], [0, 1000.0, 239.5], [0, 0, 1]], [0.0] * 5)
    for turn_rad in (0.0, -0.01):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation_of(np.array([0.0, turn_rad, 0.0])), (150.0, 0, 0)
        assert working_distance_mm(Scanner(lens, lens, pose), 400.0) == 400.0


def test_the_nominal_covariance_is_one():
    covariance = nominal_covariance(SCANNER, DISTANCE_MM)
    sigma = np.sqrt(np.diag(covariance))
    known = dict(zip(PARAMETERS, sigma.tolist(), strict=True))
    assert np.linalg.eigvalsh(covariance).min() > -1e-12 and not sigma[list(K3)].any()
    # A thousandth of the focal length and better, a pixel of principal point: what such calibrations state.
    assert 0.02 < known["camera.fx"] < 1.0 and NOISE_PX / 5 < known["camera.cx"] < 5.0
    # Where the devices share no field nobody could calibrate, and nothing is known.
    lamp = Scanner(SCANNER.camera, SCANNER.projector, np.diag([-1.0, 1, -1, 1]) + np.eye(4, k=3) * 150)
    assert np.sqrt(nominal_covariance(lamp, DISTANCE_MM)[21, 21]) > 100


def stated(names: list[str], sigma: float) -> SimpleNamespace:
    matrix = nominal_covariance(SCANNER, DISTANCE_MM)
    places = [PARAMETERS.index(name) for name in names]
    matrix = sigma**2 * matrix[np.ix_(places, places)]
    return SimpleNamespace(
        covariance=CovarianceSpec(parameters=tuple(names), matrix=tuple(map(tuple, matrix.tolist())))
    )


def test_the_scanners_own_covariance_speaks_where_it_names_all():
    every = [name for k, name in enumerate(PARAMETERS) if k not in K3][::-1]

    def found(spec: SimpleNamespace) -> CalibrationMargin:
        margin = calibration_margin(spec, SCANNER, [view_of()], ANGLES, WALL_MM, PLAIN)
        assert margin is not None
        return margin

    nominal, own = margin_at(DISTANCE_MM), found(stated(every, 3.0))
    assert own.stated and own.u_mm == pytest.approx(3 * nominal, rel=0.05)
    # What a file does not name is not exact.
    part = found(stated(every[:6], 3.0))
    assert not part.stated and part.u_mm == pytest.approx(nominal)


def test_without_walls_nothing_is_told():
    view = view_of()
    view.shot.labels[view.shot.labels == Label.OTHER_WALL] = Label.NONE
    assert calibration_margin(UNSTATED, SCANNER, [view], ANGLES, WALL_MM, PLAIN) is None
    assert calibration_margin(UNSTATED, SCANNER, [view_of()], np.empty(0), WALL_MM, PLAIN) is None


@pytest.mark.parametrize(
    ("upper_mm", "barred"), [(0.43, False), (1.0 - 1e-6, False), (1.0 + 1e-6, True), (1.1, True), (1.2, False)]
)
def test_the_margin_decides(upper_mm, barred):
    said = calibration_above(CalibrationMargin(0.1, 12.0, stated=False), 1.1, upper_mm)
    assert (said is not None) == barred
    if said is not None:
        assert said.severity is Severity.BAR and said.code == "calibration"
        assert (
            "0.100 mm of the step" in said.text
            and "weldscan calibrate scanner" in said.text
            and "15 poses" in said.text
        )


def test_what_is_not_known_bars_and_a_stated_calibration_has_another_remedy():
    assert calibration_above(None, 1.1, 0.4) is not None
    assert calibration_above(CalibrationMargin(0.1, 12.0, stated=False), 1.1, math.nan) is None
    said = calibration_above(CalibrationMargin(0.1, 12.0, stated=True), 1.1, 1.05)
    assert said is not None and "covariance" in said.text and "scanner.json" not in said.text
