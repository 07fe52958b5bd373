"""The paper's chain on clouds made by closed form, and against itself in NumPy; its 20 % rule is in the core."""

from __future__ import annotations

import numpy as np
import pytest

from weldscan import KdTree, paper_step, register_icp, set_threads
from weldscan.errors import GeometryError, InputError

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


# --- the same in NumPy: plainer, slower ---

# The paper's rule: bins with fewer counts than this part of the highest are not "reliable".
KEPT_PART = 0.20
# A wall's points lie within this many robust sigma of its median centroid distance; weld metal does not.
WALL_SIGMAS = 3.0
# Points that take part: every k-th of the combined cloud (the paper's had 150,066), and of them those that ICP needs.
POINTS = 100_000
ICP_POINTS = 10_000
# Spacing of the modelled pipe's points. Distances are counted along the model's normals: it does not enter them.
MODEL_SPACING_MM = 1.0
# At most so many of them, a whole girth of 1220 mm a metre long: shots placed further apart are not of one part.
MODEL_POINTS = 4_000_000


def chain(points_mm: np.ndarray, axis_point_mm: np.ndarray, axis: np.ndarray, radius_mm: float):
    """Edges, counts, kept bins, step."""
    points_mm = points_mm[:: max(1, len(points_mm) // POINTS)]
    axial = (points_mm - axis_point_mm) @ axis
    excess = centroid_excess(points_mm, axial, axis_point_mm, axis, radius_mm)
    seam = seam_place(axial, excess)
    parts = []
    for side in (axial < seam, axial > seam):
        part = np.flatnonzero(side)
        for _ in range(2):
            if part.size < 100:
                raise GeometryError("hardly a point is left of one wall when the weld is dropped")
            middle = np.median(excess[part])
            spread = 1.4826 * np.median(np.abs(excess[part] - middle))
            part = part[np.abs(excess[part] - middle) <= WALL_SIGMAS * spread]
        parts.append(points_mm[part])
    reference, other = parts
    model, normals = modelled_pipe(points_mm, axis_point_mm, axis, radius_mm)
    source = reference[:: max(1, len(reference) // ICP_POINTS)]
    fit = register_icp(source, model, metric="plane", normals=normals)
    placed = other @ fit.target_from_source[:3, :3].T + fit.target_from_source[:3, 3]
    _, nearest = KdTree(model).nearest(placed)
    distances = np.abs(np.einsum("na,na->n", placed - model[nearest], normals[nearest]))
    return histogram_step(distances)


def centroid_excess(
    points_mm: np.ndarray, axial: np.ndarray, axis_point_mm: np.ndarray, axis: np.ndarray, radius_mm: float
) -> np.ndarray:
    """Steps 1, 2: how much further from the centroid each point is than the modelled pipe at its place, mm.

    The bare distance from the centroid grows along and across a curved wall by centimetres, in which a weld 2 mm high
    does not show; less what the model's own form has at the same place it does.
    """
    centroid = points_mm.mean(axis=0)
    on_axis = axis_point_mm + axial[:, None] * axis
    outward = points_mm - on_axis
    modelled = on_axis + outward * (radius_mm / np.linalg.norm(outward, axis=1))[:, None]
    excess = np.linalg.norm(points_mm - centroid, axis=1) - np.linalg.norm(modelled - centroid, axis=1)
    return np.asarray(excess)


def seam_place(axial: np.ndarray, excess: np.ndarray) -> float:
    """Where along the axis the weld is: the ring whose median excess departs most from the two walls' own."""
    low, high = np.quantile(axial, [0.001, 0.999])
    rings = np.clip(((axial - low) / (high - low) * 200).astype(np.intp), 0, 199)
    order = np.argsort(rings, kind="stable")
    groups = np.split(excess[order], np.searchsorted(rings[order], np.arange(1, 200)))
    medians = np.array([np.median(group) if group.size else np.nan for group in groups])
    ring = int(np.nanargmax(np.abs(medians - np.nanmedian(medians))))
    return float(low + (ring + 0.5) / 200 * (high - low))


def modelled_pipe(
    points_mm: np.ndarray, axis_point_mm: np.ndarray, axis: np.ndarray, radius_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Step 3: the pipe's surface as a cloud with outward normals, over the arcs and the length that were scanned.

    Raises:
        GeometryError: that is more than any scan of one part shows.
    """
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    square = np.cross(axis, across)
    v = points_mm - axis_point_mm
    axial, angle = v @ axis, np.arctan2(v @ square, v @ across)
    step = MODEL_SPACING_MM / radius_mm
    # A margin on either side, so that no point finds its nearest neighbour at the model's edge.
    turns = np.unique(np.floor(angle / step).astype(np.int64))
    turns = np.unique(turns[:, None] + np.arange(-4, 5)) * step
    length = float(np.ptp(axial)) / MODEL_SPACING_MM + 8
    if not length * len(turns) <= MODEL_POINTS:
        raise GeometryError(f"the points reach over {np.ptp(axial):.4g} mm of the pipe: no modelled pipe is so long")
    rows = np.arange(axial.min() - 4 * MODEL_SPACING_MM, axial.max() + 4 * MODEL_SPACING_MM, MODEL_SPACING_MM)
    outward = np.cos(turns)[:, None] * across + np.sin(turns)[:, None] * square
    model = axis_point_mm + rows[:, None, None] * axis + radius_mm * outward
    return model.reshape(-1, 3), np.broadcast_to(outward, model.shape).reshape(-1, 3).copy()


def histogram_step(distances_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Step 6: the histogram (bin width by Freedman and Diaconis), the 20 % rule and the weighted mean."""
    low, high = np.quantile(distances_mm, [0.25, 0.75])
    width = 2 * (high - low) / np.cbrt(len(distances_mm))
    # Far outliers would ask for millions of bins; they end in none that is kept.
    limit = high + 20 * (high - low)
    bins = int(np.clip(np.ceil(limit / max(width, 1e-12)), 1, 2000))
    counts, edges = np.histogram(distances_mm, bins=bins, range=(0.0, max(limit, 1e-12)))
    kept = counts >= KEPT_PART * counts.max()
    centres = (edges[:-1] + edges[1:]) / 2
    step = float(np.average(centres[kept], weights=counts[kept]))
    last = int(np.flatnonzero(counts).max()) + 1
    return edges[: last + 1], counts[:last], kept[:last], step


# Sums in another order, carried through ICP, which ends at 1e-7 mm.
SAME_MM = 1e-10


@pytest.mark.parametrize(("step_mm", "off_mm"), [(0.47, 0.0), (-1.5, 0.0), (0.2, 0.3)])
def test_the_core_computes_what_numpy_does(step_mm, off_mm):
    cloud, start = weld(step_mm, points=130_000), np.add(POINT, [off_mm, -off_mm, 0.0])
    edges, counts, kept, step = chain(cloud, start, AXIS, RADIUS_MM)
    for threads in (1, 2, 8):
        set_threads(threads)
        try:
            found = paper_step(cloud, start, AXIS, RADIUS_MM)
        finally:
            set_threads(None)
        np.testing.assert_allclose(found.edges_mm, edges, atol=SAME_MM)
        np.testing.assert_array_equal(found.counts, counts)
        np.testing.assert_array_equal(found.kept, kept)
        assert abs(found.step_mm - step) < SAME_MM


def test_what_is_no_part_is_refused():
    with pytest.raises(InputError, match="points_mm: not finite"):
        paper_step(np.full((200, 3), np.nan), POINT, AXIS, RADIUS_MM)
    with pytest.raises(InputError, match="radius_mm"):
        paper_step(weld(0.47), POINT, AXIS, 0.0)
    with pytest.raises(InputError, match="masked"):
        paper_step(np.ma.masked_less(weld(0.47, points=1000), 900.0), POINT, AXIS, RADIUS_MM)
    far = np.concatenate([weld(0.47), weld(0.47) + 1e7 * AXIS])
    with pytest.raises(GeometryError, match=r"hardly a point|no modelled pipe is so long"):
        paper_step(far, POINT, AXIS, RADIUS_MM)
