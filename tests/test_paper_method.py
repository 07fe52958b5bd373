"""The paper's chain on clouds made by closed form, and its 20 % rule by hand."""

from __future__ import annotations

import numpy as np
import pytest

from weldscan import SeamCourse, SeamFrame
from weldscan.errors import GeometryError
from weldscan.measure.paper_method import KEPT_PART, MODEL_SPACING_MM, histogram_step, modelled_part, paper_step

RADIUS_MM = 315.0
POINT = np.array([900.0, 40.0, 300.0])
AXIS = np.array([0.6, 0.0, 0.8])
NOISE_MM = 0.01
# The walls' step varies by 1 % of itself over the arc seen; the histogram's bins are a few hundredths wide.
TOLERANCE_MM = 0.01


def weld(step_mm: float, *, noise_mm: float = NOISE_MM, bead_mm: float = 1.8, points: int = 60_000) -> np.ndarray:
    """Points of two walls about AXIS with a parabolic bead of 12 mm: the other wall's radius is `step_mm` larger."""
    random = np.random.default_rng(3)
    axial = random.uniform(-50.0, 50.0, points)
    angle = random.uniform(-0.22, 0.22, points)
    height = np.where(axial > 0, step_mm, 0.0) + bead_mm * np.maximum(1 - (axial / 6.0) ** 2, 0.0)
    radius = RADIUS_MM + height + random.normal(0.0, noise_mm, points)
    across = np.array([0.8, 0.0, -0.6])
    outward = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(AXIS, across)
    return np.asarray(POINT + axial[:, None] * AXIS + radius[:, None] * outward)


@pytest.mark.parametrize("step_mm", [0.2, 0.47, 1.5, -0.47])
def test_the_step_of_two_walls(step_mm):
    found = paper_step(weld(step_mm), POINT, AXIS, RADIUS_MM)
    assert abs(found.step_mm - abs(step_mm)) < TOLERANCE_MM
    assert len(found.edges_mm) == len(found.counts) + 1 == len(found.kept) + 1


def test_a_start_that_is_off_is_put_right_by_icp():
    found = paper_step(weld(0.47), np.add(POINT, [0.2, -0.3, 0.1]), AXIS, RADIUS_MM)
    assert abs(found.step_mm - 0.47) < TOLERANCE_MM


def test_a_few_points_give_no_answer():
    with pytest.raises(GeometryError, match="hardly a point is left of one wall"):
        paper_step(weld(0.47, points=150), POINT, AXIS, RADIUS_MM)


def test_the_20_percent_rule_by_hand():
    # Four even lumps of distances. The far one is a tenth as dense as the highest and must not be averaged in.
    lumps = [(0.3, 0.4, 300), (0.4, 0.6, 2000), (0.6, 0.7, 300), (0.9, 1.0, 100)]
    distances = np.concatenate([np.linspace(low, high, n, endpoint=False) for low, high, n in lumps])
    found = histogram_step(distances)
    assert found.counts.sum() == len(distances)
    np.testing.assert_array_equal(found.kept, found.counts >= KEPT_PART * found.counts.max())
    width = found.edges_mm[1] - found.edges_mm[0]
    centres = (found.edges_mm[:-1] + found.edges_mm[1:]) / 2
    assert not found.kept[centres > 0.7 + width].any() and found.kept[(centres > 0.4) & (centres < 0.6)].all()
    # Symmetric about 0.5 without the far lump; with it the mean would be 0.517.
    assert abs(found.step_mm - 0.5) < 0.003


def test_a_histogram_of_one_value():
    assert histogram_step(np.full(1000, 0.3)).step_mm == pytest.approx(0.3, rel=0.5)


def test_the_modelled_pipe_covers_the_scan():
    cloud = weld(0.47)
    seam = SeamFrame(POINT, AXIS, [0.8, 0.0, -0.6], SeamCourse(RADIUS_MM))
    model, normals = modelled_part(*seam.place(cloud)[:2], seam)
    from_axis = (model - POINT) - ((model - POINT) @ AXIS)[:, None] * AXIS
    np.testing.assert_allclose(np.linalg.norm(from_axis, axis=1), RADIUS_MM, rtol=1e-12)
    np.testing.assert_allclose(normals, from_axis / RADIUS_MM, atol=1e-12)
    sample = cloud[::500]
    nearest = np.linalg.norm(model[None] - sample[:, None], axis=-1).min(axis=1)
    # Half a cell's diagonal, and the bead on its wall.
    assert nearest.max() < np.hypot(MODEL_SPACING_MM / np.sqrt(2), 0.47 + 1.8 + 5 * NOISE_MM)
    axial = (model - POINT) @ AXIS
    assert axial.min() < -50 - 2 * MODEL_SPACING_MM and axial.max() > 50 + 2 * MODEL_SPACING_MM
