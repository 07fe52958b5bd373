import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from weldscan import GeometryError, InputError, register_rigid

ROUNDING = 1e-11  # mm: coordinates of some 100 mm


def example():
    rng = np.random.default_rng(1)
    return rng.normal(size=(50, 3)) * 40 + [10, -200, 700]


def moved(points, transform):
    return points @ transform[:3, :3].T + transform[:3, 3]


@given(st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-500, 500)] * 3))
def test_a_known_motion_is_found(rotation, translation):
    truth = np.eye(4)
    truth[:3, :3], truth[:3, 3] = Rotation.from_rotvec(rotation).as_matrix(), translation
    fit = register_rigid(example(), moved(example(), truth))
    assert np.abs(moved(example(), fit.target_from_source) - moved(example(), truth)).max() < ROUNDING
    assert fit.rms_mm < ROUNDING
    assert np.linalg.det(fit.target_from_source[:3, :3]) == pytest.approx(1, abs=1e-14)


def test_noisy_weighted_pairs_as_scipy():
    rng = np.random.default_rng(2)
    weights = rng.random(50)
    source = example()
    target = moved(source, np.diag([-1.0, -1, 1, 1])) + rng.normal(size=(50, 3))
    fit = register_rigid(source, target, weights)
    centred = [p - weights @ p / weights.sum() for p in (source, target)]
    expected, _ = Rotation.align_vectors(centred[1], centred[0], weights)
    assert np.abs(fit.target_from_source[:3, :3] - expected.as_matrix()).max() < 1e-13
    residuals = moved(source, fit.target_from_source) - target
    assert fit.rms_mm == pytest.approx(np.sqrt(weights @ (residuals**2).sum(1) / weights.sum()), rel=1e-12)
    assert np.allclose(fit.target_from_source, register_rigid(source, target, weights * 1e-200).target_from_source)


def test_a_mirror_image_is_answered_with_a_rotation():
    fit = register_rigid(example(), example() * [1, 1, -1])
    assert np.linalg.det(fit.target_from_source[:3, :3]) == pytest.approx(1, abs=1e-14)
    assert fit.rms_mm > 1


def test_bad_input_is_refused():
    p = example()
    for source, target, weights in (
        (p, p[:-1], None),
        (p, p, np.ones(3)),
        (p, p, -np.ones(50)),
        (p, p, np.full(50, np.nan)),
        (p, np.full((50, 3), np.inf), None),
        (p[:, :2], p[:, :2], None),
    ):
        with pytest.raises(InputError):
            register_rigid(source, target, weights)
    for same in (p[:2], np.ones((9, 3)), np.outer(np.arange(9), [1, 2, 3]), np.empty((0, 3))):
        with pytest.raises(GeometryError):
            register_rigid(same, same)
    with pytest.raises(GeometryError):
        register_rigid(p, p, np.zeros(50))
    assert "RigidFit(rms_mm=" in repr(register_rigid(p, p))
