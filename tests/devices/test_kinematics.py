"""The simulated arm: joints that hold the flange, and what it cannot reach."""

import math
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conftest import shared
from weldscan import KukaPose, parse_e6pos
from weldscan.devices.robots import distance
from weldscan.devices.robots.kinematics import ArmGeometry
from weldscan.simulated.controllers import HOME, HOME_JOINTS, Arm, OutOfReach

ARM = ArmGeometry()
MM = 1e-4
"""Joints are given to 1e-9 degrees, which is 6e-8 mm at 3 m; the rest is for arms that are nearly straight."""
angles = st.tuples(*[st.floats(-179.0, 179.0)] * 6)


def sine_cosine(degrees):
    return math.sin(math.radians(degrees)), math.cos(math.radians(degrees))


def planar_oracle(a1, a2, a3, a5):
    """Flange position and direction of an arm with A4 = A6 = 0, by plane trigonometry."""
    elevation = -a2
    s, c = sine_cosine(elevation)
    ahead, up = ARM.shoulder + ARM.upper * c, ARM.foot + ARM.upper * s
    s, c = sine_cosine(elevation - a3)
    ahead, up = ahead + ARM.fore * c - ARM.elbow * s, up + ARM.fore * s + ARM.elbow * c
    s, c = sine_cosine(elevation - a3 - a5)
    ahead, up = ahead + ARM.wrist * c, up + ARM.wrist * s
    s1, c1 = sine_cosine(-a1)
    return [ahead * c1, ahead * s1, up], [c * c1, c * s1, s]


@given(*[st.floats(-170, 170)] * 4)
def test_forward_is_plane_trigonometry(a1, a2, a3, a5):
    flange = ARM.flange((a1, a2, a3, 0.0, a5, 0.0))
    place, ahead = planar_oracle(a1, a2, a3, a5)
    assert flange[:3, 3] == pytest.approx(place, abs=1e-9)
    assert flange[:3, 2] == pytest.approx(ahead, abs=1e-12)


def test_a1_a4_and_a6_turn_against_their_axis():
    """A KUKA's A1 turns about the line down, A4 and A6 about the line from the flange back to the arm."""
    upright = (0.0, -90.0, 90.0)
    assert ARM.flange((90.0, -90.0, 90.0, 0, 0, 0))[:3, 2] == pytest.approx([0.0, -1.0, 0.0], abs=1e-12)
    assert ARM.flange((*upright, 90.0, 90.0, 0.0))[:3, 2] == pytest.approx([0.0, -1.0, 0.0], abs=1e-12)
    s, c = sine_cosine(30.0)
    assert ARM.flange((*upright, 0.0, 0.0, 30.0))[:3, 0] == pytest.approx([0.0, -s, -c], abs=1e-12)


def test_a_controllers_own_pose_in_the_home_position():
    """The fifth of the published strings, whose flange points along Y: what A1 = -90 gives, whatever the lengths."""
    told = parse_e6pos(shared("robot/strings.txt").read_text().splitlines()[4])
    held = ARM.flange((-90.0, -90.0, 90.0, 0.0, 0.0, 0.0))
    assert held[:3, :3] == pytest.approx(told.matrix()[:3, :3], abs=1e-9)
    assert held[0, 3] == pytest.approx(told.x_mm, abs=1e-9)
    assert held[1, 3] > 0 < told.y_mm


@given(angles, angles)
def test_inverse_holds_the_flange(joints, near):
    flange = ARM.flange(joints)
    found = ARM.joints(flange, near)
    assert found is not None
    assert np.abs(ARM.flange(found) - flange).max() < MM


@given(st.tuples(*[st.floats(-80, 80)] * 4, st.floats(2, 80), st.floats(-80, 80)))
def test_inverse_stays_with_the_joints(joints):
    """Near to where the joints are, the same way of holding the flange."""
    if abs(joints[2] - math.degrees(math.atan2(ARM.elbow, ARM.fore))) < 1:
        return  # the arm is straight: two ways meet
    found = ARM.joints(ARM.flange(joints), joints)
    wrist_ahead = ARM.flange(joints) @ [0, 0, -ARM.wrist, 1]
    if math.hypot(*wrist_ahead[:2]) > 10:  # above the foot A1 is anything
        assert found == pytest.approx(joints, abs=1e-5)


@pytest.mark.parametrize("a5", [0.0, 180.0])
def test_straight_wrist_keeps_a4(a5):
    joints = (10.0, -80.0, 70.0, 25.0, a5, 40.0)
    assert ARM.joints(ARM.flange(joints), (0.0, -90.0, 90.0, 25.0, a5, 0.0)) == pytest.approx(joints)


def test_out_of_reach():
    reach = ARM.shoulder + ARM.upper + math.hypot(ARM.fore, ARM.elbow) + ARM.wrist
    there = KukaPose(reach - 1.0, 0.0, ARM.foot, 0.0, 90.0, 0.0)
    beyond = KukaPose(reach + 1.0, 0.0, ARM.foot, 0.0, 90.0, 0.0)
    arm = Arm()
    arm.move(there)
    with pytest.raises(OutOfReach):
        arm.move(beyond)
    arm.place(beyond)
    assert arm.flange() == beyond
    assert len(arm.joints_deg) == 6


def test_joints_follow_the_flange():
    arm = Arm()
    assert arm.flange() == HOME
    assert arm.joints_deg == pytest.approx(HOME_JOINTS)
    arm.speed_mm_s = 500.0
    x, y, z, *turn = HOME.values()
    arm.move(KukaPose(x, y + 200.0, z - 100.0, *turn))
    seen = []
    while arm.moving:
        joints = arm.joints_deg
        seen.append(joints)
        time.sleep(0.01)
    steps = np.abs(np.diff(np.array([HOME_JOINTS, *seen, arm.joints_deg]), axis=0))
    assert len(seen) > 5
    assert 1.0 < steps[:, 0].sum() < 30.0  # turned to the side, and no joint jumped to another way of getting there
    assert steps.max() < 5.0 or len(seen) < 20
    assert distance(KukaPose.from_matrix(ARM.flange(arm.joints_deg)), arm.flange())[0] < MM


def test_motion_by_joints():
    arm = Arm()
    arm.speed_mm_s = arm.turn_speed_deg_s = 1e6
    joints = (15.0, -70.0, 60.0, 120.0, -35.0, 10.0)
    arm.move_joints(joints)
    time.sleep(0.02)
    assert arm.joints_deg == pytest.approx(joints)
