"""Rotations and rigid transforms in three dimensions: the one home of their formulas.

Rotations are (3, 3), transforms `a_from_b` (4, 4), rotation vectors (3,) in rad: the axis times the angle.

Source of the formulas: O. Rodrigues, J. Math. Pures Appl. 5 (1840) 380.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Below this the first order is exact in double precision.
SMALL_RAD = 1e-12
# Sine of the least turn that has an axis: that of half a turn cannot be told from what is left of rounding.
LEAST_SINE = 1e-9


def skew(v: Floats) -> Floats:
    """The matrices of the cross products with vectors, (..., 3) to (..., 3, 3).

    >>> import numpy as np
    >>> from weldscan.geometry import skew
    >>> (skew(np.array([1.0, 2.0, 3.0])) @ [4.0, 5.0, 6.0]).tolist()
    [-3.0, 6.0, -3.0]
    """
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return np.asarray(out - np.swapaxes(out, -1, -2))


def rotation_of(rotation_vector: Sequence[float] | Floats) -> Floats:
    """The rotation by a vector's length (rad) about its direction.

    >>> import numpy as np
    >>> from weldscan.geometry import rotation_of
    >>> (rotation_of([0.0, 0.0, np.pi / 2]) @ [1.0, 0.0, 0.0]).round(12).tolist()
    [0.0, 1.0, 0.0]
    """
    w = np.asarray(rotation_vector, dtype=np.float64)
    angle = float(np.linalg.norm(w))
    if angle < SMALL_RAD:
        return np.eye(3) + skew(w)
    cross = skew(w / angle)
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross)


def rotation_angle(rotation: Floats) -> float:
    """The angle of a rotation, rad, in [0, pi].

    >>> from weldscan.geometry import rotation_angle, rotation_of
    >>> round(rotation_angle(rotation_of([0.3, 0.0, -0.4])), 12)
    0.5
    """
    return math.atan2(float(np.linalg.norm(_twice_sine(rotation))) / 2, (float(np.trace(rotation)) - 1) / 2)


def rotation_vector_of(rotation: Floats) -> Floats:
    """The rotation vector of a rotation; zeros of none, and of half a turn, whose axis this does not tell.

    >>> from weldscan.geometry import rotation_of, rotation_vector_of
    >>> rotation_vector_of(rotation_of([0.3, 0.0, -0.4])).round(12).tolist()
    [0.3, 0.0, -0.4]
    """
    axis = _twice_sine(rotation)
    sine = float(np.linalg.norm(axis)) / 2
    return np.asarray(axis / (2 * sine) * rotation_angle(rotation) if sine > LEAST_SINE else np.zeros(3))


def _twice_sine(rotation: Floats) -> Floats:
    """The axis, as long as twice the sine of the angle."""
    r = rotation
    return np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])


def rigid(rotation: Floats, translation: Sequence[float] | Floats) -> Floats:
    """The transform of a rotation and a translation, mm.

    >>> from weldscan.geometry import rigid, rotation_of
    >>> rigid(rotation_of([0.0, 0.0, 0.0]), [1.0, 2.0, 3.0])[:, 3].tolist()
    [1.0, 2.0, 3.0, 1.0]
    """
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, translation
    return out


def inverse(a_from_b: Floats) -> Floats:
    """`b_from_a` of a rigid transform.

    >>> import numpy as np
    >>> from weldscan.geometry import inverse, rigid, rotation_of
    >>> moved = rigid(rotation_of([0.1, 0.2, 0.3]), [1.0, 2.0, 3.0])
    >>> bool(np.abs(inverse(moved) @ moved - np.eye(4)).max() < 1e-12)
    True
    """
    turned = a_from_b[:3, :3].T
    return rigid(turned, -turned @ a_from_b[:3, 3])
