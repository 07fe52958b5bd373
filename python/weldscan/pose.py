"""KUKA poses: X Y Z in mm and A B C in degrees, as rigid transforms and as the strings that controllers print.

R = Rz(A) Ry(B) Rx(C), intrinsic Z-Y'-X''. This is the one file in which angles are degrees. Two sets of angles may be
the same rotation (at B = ±90 always): compare matrices, never angles.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from weldscan._weldcore import refuse_masked
from weldscan.errors import InputError

Floats = NDArray[np.float64]

LOCK_COS_B = 1e-6
"""Below this cos B the controller reports A = 0 and puts the heading into C (seen at cos B = 9.3e-7)."""
ROTATION_TOLERANCE = 1e-5
"""How far R R^T may stand from the identity: matrices kept in single precision are off by 1e-6."""

_NUMBER = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_WHOLE = r"[+-]?[0-9]{1,18}"
_STRUCT = re.compile(r"\{\s*(?:([A-Za-z]\w*)\s*:)?([^{}:]*)\}", re.ASCII)
_FIELD = re.compile(r"([A-Za-z]\w*)\s+(\S+)", re.ASCII)
_POSE = ("X", "Y", "Z", "A", "B", "C")
_AXES = ("A1", "A2", "A3", "A4", "A5", "A6")
_EXTERNAL = ("E1", "E2", "E3", "E4", "E5", "E6")
_LONGEST = 1000
"""Characters: the longest structure that a controller prints has about 200."""


def parse_number(text: str) -> float:
    """Return the number that a whole text is, as controllers and people write it: ASCII digits, a point, an exponent.

    Raises `InputError` for what Python would take besides (`5_0_0`, other scripts' digits, blanks, `nan`, `inf`) and
    for what does not fit into a double.

    >>> from weldscan.pose import parse_number
    >>> parse_number("-12.5e1")
    -125.0
    """
    number = float(text) if re.fullmatch(_NUMBER, text) else math.nan
    if not math.isfinite(number):
        raise InputError(f"{text[:40]!r} is not a number")
    return number


def parse_whole(text: str) -> int:
    """Return the whole number that a whole text is, in ASCII digits; raises `InputError` for anything else.

    >>> from weldscan.pose import parse_whole
    >>> parse_whole("0042")
    42
    """
    if not re.fullmatch(_WHOLE, text):
        raise InputError(f"{text[:40]!r} is not a whole number")
    return int(text)


def matrix_from_kuka(x_mm: float, y_mm: float, z_mm: float, a_deg: float, b_deg: float, c_deg: float) -> Floats:
    """Return the 4x4 transform `base_from_flange` of a KUKA pose (mm, degrees).

    Raises `InputError` for a number that is not finite. Source: KUKA System Software, R = Rz(A) Ry(B) Rx(C).

    >>> from weldscan import matrix_from_kuka
    >>> matrix_from_kuka(0, 0, 0, 90, 0, 0).round(6)[0, 1]
    np.float64(-1.0)
    """
    values = (x_mm, y_mm, z_mm, a_deg, b_deg, c_deg)
    for name, value in zip(_POSE, values, strict=True):
        if not math.isfinite(value):
            raise InputError(f"pose: {name} is {value}, must be a finite number")
    (ca, sa), (cb, sb), (cc, sc) = (_cos_sin(angle) for angle in values[3:])
    return np.array(
        [
            [ca * cb, ca * sb * sc - sa * cc, ca * sb * cc + sa * sc, x_mm],
            [sa * cb, sa * sb * sc + ca * cc, sa * sb * cc - ca * sc, y_mm],
            [-sb, cb * sc, cb * cc, z_mm],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def kuka_from_matrix(matrix: ArrayLike) -> tuple[float, float, float, float, float, float]:
    """Return (x, y, z, a, b, c), mm and degrees, of a 4x4 rigid transform.

    A and C are in (-180, 180], B in [-90, 90]. In gimbal lock (cos B below `LOCK_COS_B`) A = 0 and C holds the heading,
    as the controller does it; the rotation is then within 1e-6 rad of the matrix. Raises `InputError` for what is not a
    rigid transform.

    >>> from weldscan import kuka_from_matrix, matrix_from_kuka
    >>> kuka_from_matrix(matrix_from_kuka(1, 2, 3, 40, 90, 30))[3:]
    (0.0, 90.0, -10.0)
    """
    refuse_masked("pose", matrix)
    m = np.asarray(matrix, dtype=np.float64)
    if m.shape != (4, 4) or not np.isfinite(m).all():
        raise InputError(f"pose: a 4x4 matrix of finite numbers is needed, not one of shape {m.shape}")
    r = m[:3, :3]
    if np.abs(r @ r.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(r) < 0 or (m[3] != (0, 0, 0, 1)).any():
        raise InputError("pose: the matrix is not a rigid transform (rotation with determinant +1, last row 0 0 0 1)")
    cos_b = math.hypot(r[0, 0], r[1, 0])
    b = math.atan2(-r[2, 0], cos_b)
    a = 0.0 if cos_b < LOCK_COS_B else math.atan2(r[1, 0], r[0, 0])
    ca, sa = math.cos(a), math.sin(a)
    c = math.atan2(sa * r[0, 2] - ca * r[1, 2], ca * r[1, 1] - sa * r[0, 1])
    a_deg, b_deg, c_deg = (_rounded_noise(math.degrees(angle)) for angle in (a, b, c))
    return float(m[0, 3]), float(m[1, 3]), float(m[2, 3]), a_deg, b_deg, c_deg


@dataclass(frozen=True)
class KukaPose:
    """A pose as the controller gives it: mm and degrees.

    >>> from weldscan import KukaPose
    >>> KukaPose(1, 2, 3, 0, 0, 0).matrix()[:3, 3]
    array([1., 2., 3.])
    """

    x_mm: float
    y_mm: float
    z_mm: float
    a_deg: float
    b_deg: float
    c_deg: float

    def __post_init__(self) -> None:
        for name, value in zip(_POSE, self.values(), strict=True):
            if not math.isfinite(value):
                raise InputError(f"pose: {name} is {value}, must be a finite number")

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> KukaPose:
        """Return the pose of a 4x4 rigid transform."""
        return cls(*kuka_from_matrix(matrix))

    def matrix(self) -> Floats:
        """Return the 4x4 rigid transform."""
        return matrix_from_kuka(*self.values())

    def values(self) -> tuple[float, float, float, float, float, float]:
        """Return X, Y, Z, A, B, C."""
        return self.x_mm, self.y_mm, self.z_mm, self.a_deg, self.b_deg, self.c_deg


def parse_e6pos(text: str) -> KukaPose:
    """Return the pose in an E6POS, E3POS or POS string of a controller; S, T and external axes at zero are allowed.

    Raises `InputError` for anything else, and for external axes away from zero, which this project does not know.

    >>> from weldscan import parse_e6pos
    >>> parse_e6pos("{E6POS: X 1.0, Y 2.0, Z 3.0, A 4.0, B 5.0, C 6.0, S 2, T 3, E1 0.0}").c_deg
    6.0
    """
    return KukaPose(*_numbers(text, ("E6POS", "E3POS", "POS"), _POSE, ("S", "T", *_EXTERNAL)))


def parse_frame(text: str) -> KukaPose:
    """Return the pose in a FRAME string, such as the value of $TOOL or $BASE.

    >>> from weldscan import parse_frame
    >>> parse_frame("{FRAME: X 0.0, Y 0.0, Z 120.5, A 0.0, B 0.0, C 0.0}").z_mm
    120.5
    """
    return KukaPose(*_numbers(text, ("FRAME",), _POSE, ()))


def parse_e6axis(text: str) -> tuple[float, float, float, float, float, float]:
    """Return A1 to A6, degrees, of an E6AXIS, E3AXIS or AXIS string.

    >>> from weldscan import parse_e6axis
    >>> parse_e6axis("{E6AXIS: A1 0.0, A2 -90.0, A3 90.0, A4 0.0, A5 15.0, A6 0.0, E1 0.0}")[4]
    15.0
    """
    a1, a2, a3, a4, a5, a6 = _numbers(text, ("E6AXIS", "E3AXIS", "AXIS"), _AXES, _EXTERNAL)
    return a1, a2, a3, a4, a5, a6


def format_e6pos(pose: KukaPose) -> str:
    """Return the pose as an E6POS string with external axes at zero, for a controller to read.

    >>> from weldscan import KukaPose, format_e6pos
    >>> format_e6pos(KukaPose(1, 2, 3, 4, 5, 6))[:38]
    '{E6POS: X 1.0, Y 2.0, Z 3.0, A 4.0, B '
    """
    return "{E6POS: " + _fields(_POSE, pose.values()) + ", " + _fields(_EXTERNAL, [0.0] * 6) + "}"


def format_frame(pose: KukaPose) -> str:
    """Return the pose as a FRAME string.

    >>> from weldscan import KukaPose, format_frame
    >>> format_frame(KukaPose(0, 0, 0, 0, 0, 0))
    '{FRAME: X 0.0, Y 0.0, Z 0.0, A 0.0, B 0.0, C 0.0}'
    """
    return "{FRAME: " + _fields(_POSE, pose.values()) + "}"


def format_e6axis(joints_deg: Iterable[float]) -> str:
    """Return six joint angles, degrees, as an E6AXIS string.

    >>> from weldscan import format_e6axis
    >>> format_e6axis([0, -90, 90, 0, 0, 0])[:27]
    '{E6AXIS: A1 0.0, A2 -90.0, '
    """
    return "{E6AXIS: " + _fields(_AXES, joints_deg) + ", " + _fields(_EXTERNAL, [0.0] * 6) + "}"


def _numbers(text: str, types: tuple[str, ...], needed: tuple[str, ...], allowed: tuple[str, ...]) -> list[float]:
    """Parse `{TYPE: NAME number, ...}`, the type optional; give the needed fields in order, or say what is wrong."""
    shown = repr(text if len(text) <= 60 else text[:57] + "...")
    match = _STRUCT.fullmatch(text.strip()) if len(text) <= _LONGEST else None
    if match is None:
        raise InputError(f"pose: {shown} is not a structure of the form {{{types[0]}: {needed[0]} 1.0, ...}}")
    if match[1] is not None and match[1].upper() not in types:
        raise InputError(f"pose: {shown} is of type {match[1]}, must be {' or '.join(types)}")
    fields: dict[str, float] = {}
    for item in match[2].split(","):
        field = _FIELD.fullmatch(item.strip())
        if field is None:
            raise InputError(f"pose: {item.strip()!r} in {shown} is not a name and a number")
        name = field[1].upper()
        try:
            value = parse_number(field[2])
        except InputError as error:
            raise InputError(f"pose: {name} in {shown}: {error}") from None
        if name in fields or name not in needed + allowed:
            raise InputError(f"pose: field {name} in {shown} is {'given twice' if name in fields else 'unknown'}")
        if name in _EXTERNAL and value != 0:
            raise InputError(f"pose: external axis {name} is at {value}; external axes are not supported")
        fields[name] = value
    missing = [name for name in needed if name not in fields]
    if missing:
        raise InputError(f"pose: {shown} lacks {', '.join(missing)}")
    return [fields[name] for name in needed]


def _fields(names: Iterable[str], values: Iterable[float]) -> str:
    return ", ".join(f"{name} {float(value)!r}" for name, value in zip(names, values, strict=True))


def _cos_sin(angle_deg: float) -> tuple[float, float]:
    """Cosine and sine, exact at multiples of 90 degrees."""
    turn = math.fmod(angle_deg, 360.0)
    if turn % 90.0 == 0.0:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(turn // 90.0) % 4]
    return math.cos(math.radians(turn)), math.sin(math.radians(turn))


def _rounded_noise(angle_deg: float) -> float:
    """Without the last bits of a double, so that 90 stays 90; never -180."""
    angle = round(angle_deg, 12) + 0.0
    return 180.0 if angle == -180.0 else angle
