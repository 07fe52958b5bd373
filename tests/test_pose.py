"""KUKA angles, matrices and strings, against rotations composed one axis at a time and strings of real controllers."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from conftest import shared
from weldscan import InputError
from weldscan.pose import (
    KukaPose,
    format_e6axis,
    format_e6pos,
    format_frame,
    kuka_from_matrix,
    matrix_from_kuka,
    parse_e6axis,
    parse_e6pos,
    parse_frame,
)

ROUND_TRIP = 1e-12
"""Relative to 1: three products of doubles, and angles rounded to 1e-12 degrees."""
IN_LOCK = 1.1e-6
"""Radians: A is set to 0 below cos B = 1e-6, which turns the frame by at most that."""

angles = st.floats(-720, 720)
lengths = st.floats(-5000, 5000)


def composed(a_deg, b_deg, c_deg):
    """Rotate about z, then about the new y, then about the new x: SciPy's intrinsic ZYX."""
    return Rotation.from_euler("ZYX", [a_deg, b_deg, c_deg], degrees=True).as_matrix()


@given(lengths, lengths, lengths, angles, angles, angles)
def test_matrix_is_intrinsic_zyx(x, y, z, a, b, c):
    m = matrix_from_kuka(x, y, z, a, b, c)
    np.testing.assert_allclose(m[:3, :3], composed(a, b, c), atol=ROUND_TRIP)
    np.testing.assert_array_equal(m[:, 3], [x, y, z, 1])
    np.testing.assert_array_equal(m[3], [0, 0, 0, 1])


@given(lengths, lengths, lengths, angles, angles, angles)
def test_angles_return_the_same_rotation(x, y, z, a, b, c):
    m = matrix_from_kuka(x, y, z, a, b, c)
    x1, y1, z1, a1, b1, c1 = kuka_from_matrix(m)
    assert (x1, y1, z1) == (x, y, z)
    assert -180 < a1 <= 180 and -90 <= b1 <= 90 and -180 < c1 <= 180
    lock = math.hypot(m[0, 0], m[1, 0]) < 1e-6
    np.testing.assert_allclose(composed(a1, b1, c1), m[:3, :3], atol=IN_LOCK if lock else 1e-9)


@pytest.mark.parametrize("heading", [-170.0, -30.0, 0.0, 12.5, 179.0])
@pytest.mark.parametrize("b", [90.0, -90.0, 90 - 3e-5, -90 + 3e-5])
def test_gimbal_lock_as_the_controller(heading, b):
    m = matrix_from_kuka(1, 2, 3, heading, b, 20.0)
    *_, a1, b1, c1 = kuka_from_matrix(m)
    assert a1 == 0
    assert b1 == pytest.approx(b, abs=1e-7)
    np.testing.assert_allclose(composed(a1, b1, c1), m[:3, :3], atol=IN_LOCK)


def test_right_angles_are_exact():
    assert kuka_from_matrix(matrix_from_kuka(0, 0, 0, 90, 0, -90)) == (0, 0, 0, 90, 0, -90)
    assert set(np.abs(matrix_from_kuka(0, 0, 0, 90, 90, 180)[:3, :3]).ravel()) == {0.0, 1.0}
    assert kuka_from_matrix(matrix_from_kuka(0, 0, 0, -180, 0, 0))[3] == 180


def test_strings_of_controllers():
    lines = shared("robot/strings.txt").read_text().splitlines()
    assert len(lines) == 5
    for line in lines:
        pose = parse_e6pos(line)
        again = KukaPose.from_matrix(pose.matrix())
        np.testing.assert_allclose(again.matrix(), pose.matrix(), atol=IN_LOCK)
        assert parse_e6pos(format_e6pos(pose)) == pose
        assert parse_frame(format_frame(pose)) == pose
    locked = parse_e6pos(lines[1])
    assert KukaPose.from_matrix(locked.matrix()).values() == pytest.approx(locked.values(), abs=1e-7)
    assert KukaPose.from_matrix(parse_e6pos(lines[0]).matrix()).values() == pytest.approx(
        parse_e6pos(lines[0]).values(), abs=1e-9
    )


def test_joints():
    joints = (0.0, -90.0, 90.5, 1e-5, 15.0, -179.25)
    assert parse_e6axis(format_e6axis(joints)) == joints
    assert parse_e6axis("{E6AXIS: A1 1, A2 2, A3 3, A4 4, A5 5, A6 6, E1 0.0, E2 0, E3 0, E4 0, E5 0, E6 0}")[0] == 1


@pytest.mark.parametrize(
    "text",
    [
        "",
        "garbage",
        "{E6POS: X 1.0}",
        "{E6POS: X 1.0, Y 2.0, Z 3.0, A 4.0, B 5.0}",
        "{E6POS: X NaN, Y 2.0, Z 3.0, A 4.0, B 5.0, C 6.0}",
        "{E6POS: X 1e999, Y 2.0, Z 3.0, A 4.0, B 5.0, C 6.0}",
        "{E6POS: X 1.0, X 1.0, Y 2.0, Z 3.0, A 4.0, B 5.0, C 6.0}",
        "{E6POS: X 1.0, Y 2.0, Z 3.0, A 4.0, B 5.0, C 6.0, Q 7.0}",
        "{E6POS: X 1.0, Y 2.0, Z 3.0, A 4.0, B 5.0, C 6.0",
        "{E6POS: X 1.0, Y 2.0, Z 3.0, A 4.0, B 5.0, C 6.0} trailing",
        "{E6AXIS: A1 1.0, A2 2.0, A3 3.0, A4 4.0, A5 5.0, A6 6.0}",
        "{E6POS: X 1.0, Y 2.0, Z 3.0, A 4.0, B 5.0, C 6.0, E1 7.5}",
        "{E6POS: X 1,0, Y 2,0, Z 3,0, A 4,0, B 5,0, C 6,0}",
        "{E6POS: X 1.0, Y 2.0, Z 3.0, A 4.0, B 5.0, C 6.0" + " " * 10_000_000 + "}",
    ],
)
def test_garbage_is_refused(text):
    with pytest.raises(InputError):
        parse_e6pos(text)


@given(st.text(max_size=80))
def test_any_text_is_a_pose_or_an_input_error(text):
    for parse in (parse_e6pos, parse_frame, parse_e6axis):
        with pytest.raises(InputError):
            parse(text)


def test_bad_numbers_and_matrices():
    with pytest.raises(InputError, match="Y is nan"):
        KukaPose(0, math.nan, 0, 0, 0, 0)
    with pytest.raises(InputError):
        matrix_from_kuka(0, 0, 0, math.inf, 0, 0)
    mirror = np.diag([1.0, 1.0, -1.0, 1.0])
    for bad in (np.eye(3), np.full((4, 4), np.nan), mirror, 2 * np.eye(4), np.ones((4, 4))):
        with pytest.raises(InputError):
            kuka_from_matrix(bad)
