"""Joints of a six-axis arm with a spherical wrist, and the flange that they hold: what the joints say of the pose, and
how the simulated controllers move.

Lengths and senses of rotation are those of a KUKA KR 210 R2700: at A2 = -90, A3 = 90 the upper arm stands upright and
the forearm points ahead. The joints have no stops. Link by link, base_from_flange = Tz(foot) Rz(-A1) Tx(shoulder)
Ry(A2) Tx(upper) Ry(A3) T(fore, 0, elbow) Rx(-A4) Ry(A5) Rx(-A6) Tx(wrist) Ry(90).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from weldscan.pose import Floats

Joints = tuple[float, float, float, float, float, float]
"""A1 to A6, degrees."""
STRAIGHT_WRIST = 1e-9
"""Sine of A5 below which A4 and A6 turn about one line and only their sum is known."""


@dataclass(frozen=True)
class ArmGeometry:
    """Lengths of an arm, mm."""

    foot: float = 675.0
    shoulder: float = 350.0
    upper: float = 1150.0
    elbow: float = -41.0
    fore: float = 1200.0
    wrist: float = 215.0

    def larger(self, factor: float) -> ArmGeometry:
        """Return an arm of the same proportions."""
        lengths = (self.foot, self.shoulder, self.upper, self.elbow, self.fore, self.wrist)
        return ArmGeometry(*(length * factor for length in lengths))

    def flange(self, joints_deg: Joints) -> Floats:
        """Return base_from_flange, 4x4.

        >>> ArmGeometry().flange((0, -90, 90, 0, 0, 0))[:3, 3].round(6).tolist()
        [1765.0, 0.0, 1784.0]
        """
        a1, a2, a3, a4, a5, a6 = map(math.radians, joints_deg)
        pose: Floats = (
            _shift(0, 0, self.foot)
            @ _turn_z(-a1)
            @ _shift(self.shoulder, 0, 0)
            @ _turn_y(a2)
            @ _shift(self.upper, 0, 0)
            @ _turn_y(a3)
            @ _shift(self.fore, 0, self.elbow)
            @ _turn_x(-a4)
            @ _turn_y(a5)
            @ _turn_x(-a6)
            @ _shift(self.wrist, 0, 0)
            @ _turn_y(math.pi / 2)
        )
        return pose

    def joints(self, base_from_flange: Floats, near_deg: Joints) -> Joints | None:
        """Return the joints that hold a flange, of up to eight ways the one nearest to where they are; None out of
        reach.
        """
        ways = [
            wrist
            for shoulder_deg in self._shoulders(base_from_flange)
            for wrist in _wrists(base_from_flange, shoulder_deg, near_deg)
        ]
        return min(ways, key=lambda way: max(map(_turned, way, near_deg)), default=None)

    def _shoulders(self, flange: Floats) -> list[tuple[float, float, float]]:
        """A1 to A3 that bring the wrist's centre to its place: facing it or facing away, elbow up or down; radians."""
        x, y, z = flange[:3, 3] - self.wrist * flange[:3, 2]
        fore, dip = math.hypot(self.fore, self.elbow), math.atan2(self.elbow, self.fore)
        found = []
        for facing in (1.0, -1.0):
            a1 = math.atan2(-facing * y, facing * x)
            ahead, up = facing * math.hypot(x, y) - self.shoulder, z - self.foot
            cosine = (ahead**2 + up**2 - self.upper**2 - fore**2) / (2 * self.upper * fore)
            if abs(cosine) > 1.0:
                continue
            for bend in (math.acos(cosine), -math.acos(cosine)):
                upper = math.atan2(up, ahead) + math.atan2(fore * math.sin(bend), self.upper + fore * cosine)
                found.append((a1, -upper, dip + bend))
        return found


def _wrists(flange: Floats, shoulder: tuple[float, float, float], near_deg: Joints) -> list[Joints]:
    """A4 to A6 that bring the flange to its direction, behind given A1 to A3: the hand and the hand turned over."""
    a1, a2, a3 = shoulder
    hand = (_turn_z(-a1) @ _turn_y(a2 + a3))[:3, :3].T @ flange[:3, :3] @ _turn_y(-math.pi / 2)[:3, :3]
    sine = math.hypot(hand[1, 0], hand[2, 0])
    if sine < STRAIGHT_WRIST:
        a4 = math.radians(near_deg[3])
        # Rx(-A4) Ry(0 or 180) Rx(-A6): the sum or the difference of both.
        about = math.atan2(hand[2, 1], hand[1, 1])
        ways = [(a4, 0.0, -about - a4) if hand[0, 0] > 0 else (a4, math.pi, about + a4)]
    else:
        ways = []
        for side in (1.0, -1.0):
            a4 = math.atan2(-side * hand[1, 0], -side * hand[2, 0])
            a6 = math.atan2(-side * hand[0, 1], side * hand[0, 2])
            ways.append((a4, math.atan2(side * sine, hand[0, 0]), a6))
    return [tuple(_within_a_turn(math.degrees(a)) for a in (*shoulder, *way)) for way in ways]  # type: ignore[misc]


def _within_a_turn(angle_deg: float) -> float:
    """In (-180, 180], without the last bits of a double."""
    angle = round(180.0 - (180.0 - angle_deg) % 360.0, 9)
    return 180.0 if angle == -180.0 else angle + 0.0


def _turned(a_deg: float, b_deg: float) -> float:
    return abs((a_deg - b_deg + 180.0) % 360.0 - 180.0)


def _shift(x: float, y: float, z: float) -> Floats:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def _turn_x(angle: float) -> Floats:
    return _turn(angle, 1, 2)


def _turn_y(angle: float) -> Floats:
    return _turn(angle, 2, 0)


def _turn_z(angle: float) -> Floats:
    return _turn(angle, 0, 1)


def _turn(angle: float, i: int, j: int) -> Floats:
    """Turn by an angle from axis i towards axis j."""
    pose = np.eye(4)
    pose[i, i] = pose[j, j] = math.cos(angle)
    pose[j, i], pose[i, j] = math.sin(angle), -math.sin(angle)
    return pose
