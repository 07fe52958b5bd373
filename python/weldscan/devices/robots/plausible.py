"""What a controller says is believed only where it can be: in reach, no jump, and the pose where the joints hold it.

No single one of these finds every fault of a wire; together they leave no room for a pose in metres, one of zeros, a
digit too many, or one that moved while the joints stood still. A refused reading changes nothing: the next one is held
against the last that was believed, not against a lie.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from weldscan.devices.robots.kinematics import ArmGeometry
from weldscan.geometry import rotation_angle
from weldscan.pose import Floats, KukaPose

FARTHEST_MM = 10_000.0
"""No KUKA on its own foot reaches further from its base; a number beyond is a fault of the wire, not a pose."""
NEAREST_MM = 100.0
"""Nearer to the base's origin stands every KUKA's own foot; it is also where 10 m written in metres lie, and zeros."""
FASTEST_MM_S, FASTEST_DEG_S = 12_000.0, 2_500.0
"""No KUKA arm moves its flange faster (KR AGILUS: 11 m/s, and 2400 degrees/s if all its axes turned about one line)."""
JUMP_SLACK_MM, JUMP_SLACK_DEG = 2.0, 1.0
"""Allowed on top of speed times time: readings are interpolated by the controller in cycles of up to 12 ms."""
HALF_TURN_DEG, TURN_DEG, SLACK_DEG = 180.0, 360.0, 0.001
LEVER_MM = 5_000.0
"""No joint of any KUKA is further from the flange: what a joint's turn can move it by, per radian."""
SKEW_MM = 10.0
"""A pose and joints that are read one after the other belong to instants up to 12 ms apart; twice in T1: 6 mm."""


@dataclass(frozen=True)
class Told:
    """A reading that was believed."""

    flange: KukaPose
    time_s: float
    joints_deg: tuple[float, ...] = ()


def distance(a: KukaPose, b: KukaPose) -> tuple[float, float]:
    """Return how far two poses are apart: mm, and degrees of the one rotation between them."""
    return _apart(a.matrix(), b.matrix())


def out_of_reach(flange: KukaPose) -> str | None:
    """Return why no flange can be there, or None."""
    far_mm = math.hypot(*flange.values()[:3])
    if far_mm > FARTHEST_MM or far_mm < NEAREST_MM:
        return f"the flange cannot be {far_mm:.4g} mm from the base"
    return None


def beyond_a_turn(pose: KukaPose, most_deg: float) -> str | None:
    """Return which angle of a pose nobody would write, or None: a digit too many is another angle within a turn.

    A controller tells A, B and C of $POS_ACT within half a turn to either side; people write up to a whole one.
    """
    for name, angle in zip("ABC", pose.values()[3:], strict=True):
        if abs(angle) > most_deg + SLACK_DEG:
            return f"{name} cannot be {angle:.6g} degrees"
    return None


def jumped(last: Told, told: Told) -> str | None:
    """Return what no arm could have done between two readings, or None."""
    moved_mm, moved_deg = distance(last.flange, told.flange)
    seconds = told.time_s - last.time_s
    if moved_mm > FASTEST_MM_S * seconds + JUMP_SLACK_MM or moved_deg > FASTEST_DEG_S * seconds + JUMP_SLACK_DEG:
        return f"the pose jumped by {moved_mm:.1f} mm and {moved_deg:.1f} degrees in {seconds * 1000:.1f} ms"
    if last.joints_deg and told.joints_deg:
        turned_rad = sum(math.radians(abs(a - b)) for a, b in zip(last.joints_deg, told.joints_deg, strict=True))
        if moved_mm > LEVER_MM * turned_rad + SKEW_MM:
            return (
                f"the pose jumped by {moved_mm:.1f} mm, but the joints turned by {math.degrees(turned_rad):.3f} degrees"
            )
    return None


def contradicted(told: Told, root: Floats, arm: ArmGeometry | None, within_mm: float, within_deg: float) -> str | None:
    """Return how joints and pose contradict each other, or None.

    How the flange is turned follows from the joints of every six-axis KUKA, whatever its lengths; where it is takes
    those. `root` is $ROBROOT, base_from_foot.
    """
    if not told.joints_deg:
        return None
    a1, a2, a3, a4, a5, a6 = told.joints_deg
    held = root @ (arm or ArmGeometry()).flange((a1, a2, a3, a4, a5, a6))
    off_mm, off_deg = _apart(held, told.flange.matrix())
    if off_deg > within_deg:
        return f"joints and pose contradict each other by {off_deg:.2f} degrees (joints_within_deg = {within_deg:g})"
    if arm is not None and off_mm > within_mm:
        return f"joints and pose contradict each other by {off_mm:.1f} mm (joints_within_mm = {within_mm:g})"
    return None


def _apart(a: Floats, b: Floats) -> tuple[float, float]:
    return math.dist(a[:3, 3], b[:3, 3]), math.degrees(rotation_angle(a[:3, :3].T @ b[:3, :3]))
