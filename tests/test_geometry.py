"""Rotations and transforms against the exponential series, and against each other."""

from __future__ import annotations

import numpy as np
import pytest

from weldscan.geometry import inverse, rigid, rotation_angle, rotation_of, rotation_vector_of, skew

# Products of numbers near 1, and the angle of the least turn, whose sine comes from their differences.
ROUNDING = 1e-13
VECTORS = [[0.0, 0.0, 0.0], [1e-13, -2e-13, 0.0], [1e-6, 2e-6, -1e-6], [0.3, -0.4, 1.2], [3.1, 0.2, -0.1]]


def exponential(w: np.ndarray) -> np.ndarray:
    """The rotation as the power series of its generator."""
    generator = np.array([np.cross(w, e) for e in np.eye(3)]).T
    total, term = np.eye(3), np.eye(3)
    for k in range(1, 60):
        term = term @ generator / k
        total += term
    return total


@pytest.mark.parametrize("w", VECTORS)
def test_a_rotation_is_the_exponential_of_its_vector(w):
    turn = rotation_of(w)
    np.testing.assert_allclose(turn, exponential(np.array(w)), atol=ROUNDING)
    assert abs(rotation_angle(turn) - np.linalg.norm(w)) < 10 * ROUNDING
    if np.linalg.norm(w) > 1e-8:
        np.testing.assert_allclose(rotation_vector_of(turn), w, atol=30 * ROUNDING)


def test_the_same_axis_and_half_a_turn():
    half = rotation_of([0.0, np.pi, 0.0])
    assert abs(rotation_angle(half) - np.pi) < ROUNDING and not rotation_vector_of(half).any()


def test_many_cross_products_at_once():
    random = np.random.default_rng(2)
    v, u = random.normal(size=(2, 4, 5, 3))
    np.testing.assert_allclose((skew(v) @ u[..., None])[..., 0], np.cross(v, u), atol=ROUNDING)


def test_the_inverse_leads_back():
    pose = rigid(rotation_of([0.3, -0.4, 1.2]), [100.0, -20.0, 3.0])
    np.testing.assert_allclose(inverse(pose), np.linalg.inv(pose), atol=100 * ROUNDING)
    assert np.abs(inverse(pose) - pose).max() > 1
