"""The paper's own evaluation (its section 6), step by step, on the combined cloud in base.

1. centroid of the combined cloud, distance of every point from it;
2. drop the weld by that distance, and split what is left in two;
3. the modelled pipe as a cloud;
4. ICP of the one part to the model;
5. nearest neighbour of the other part's points in the model;
6. histogram of the distances; of its bins those with at least 20 % of the highest count are kept, and their
   count-weighted mean is the misalignment.

Where the paper leaves a choice, or its letter would not work, the choice is said at the step. The result is unsigned
and has neither an angle nor an uncertainty of its own: it is kept to compare with the paper; `surface` is the better.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import KdTree, SeamCourse, SeamFrame, refuse_masked, register_icp
from weldscan.errors import GeometryError
from weldscan.result import Histogram

Floats = NDArray[np.float64]

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


def paper_step(points_mm: Floats, axis_point_mm: Floats, axis: Floats, radius_mm: float) -> Histogram:
    """The misalignment as the paper computes it.

    Args:
        points_mm: (n, 3) all points of the part, base.
        axis_point_mm: (3,) a point of the pipe's axis: where ICP starts.
        axis: (3,) unit, from the reference wall to the other wall.
        radius_mm: of the modelled pipe: the real one, where the arc shows it.

    Raises:
        GeometryError: one of the parts has no points left, or ICP found nothing to hold on to.
    """
    refuse_masked("points_mm", points_mm)
    refuse_masked("axis_point_mm", axis_point_mm)
    refuse_masked("axis", axis)
    points_mm = points_mm[:: max(1, len(points_mm) // POINTS)]
    aside = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    seam = SeamFrame(axis_point_mm, axis, aside, SeamCourse(radius_mm))
    at, across, _ = seam.place(points_mm)
    excess = centroid_excess(points_mm, seam.points(at, across))
    weld = seam_place(across, excess)
    parts = []
    for side in (across < weld, across > weld):
        part = np.flatnonzero(side)
        for _ in range(2):
            if part.size < 100:
                raise GeometryError("hardly a point is left of one wall when the weld is dropped")
            middle = np.median(excess[part])
            spread = 1.4826 * np.median(np.abs(excess[part] - middle))
            part = part[np.abs(excess[part] - middle) <= WALL_SIGMAS * spread]
        parts.append(points_mm[part])
    reference, other = parts
    model, normals = modelled_part(at, across, seam)
    source = reference[:: max(1, len(reference) // ICP_POINTS)]
    fit = register_icp(source, model, metric="plane", normals=normals)
    placed = other @ fit.target_from_source[:3, :3].T + fit.target_from_source[:3, 3]
    _, nearest = KdTree(model).nearest(placed)
    distances = np.abs(np.einsum("na,na->n", placed - model[nearest], normals[nearest]))
    return histogram_step(distances)


def centroid_excess(points_mm: Floats, modelled_mm: Floats) -> Floats:
    """Steps 1, 2: how much further from the centroid each point is than the modelled part at its place, mm.

    The bare distance from the centroid grows along and across a curved wall by centimetres, in which a weld 2 mm high
    does not show; less what the model's own form has at the same place it does.
    """
    centroid = points_mm.mean(axis=0)
    excess = np.linalg.norm(points_mm - centroid, axis=1) - np.linalg.norm(modelled_mm - centroid, axis=1)
    return np.asarray(excess)


def seam_place(across: Floats, excess: Floats) -> float:
    """Where the weld is: the strip along the seam whose median excess departs most from the two walls' own."""
    low, high = np.quantile(across, [0.001, 0.999])
    strips = np.clip(((across - low) / (high - low) * 200).astype(np.intp), 0, 199)
    order = np.argsort(strips, kind="stable")
    groups = np.split(excess[order], np.searchsorted(strips[order], np.arange(1, 200)))
    medians = np.array([np.median(group) if group.size else np.nan for group in groups])
    strip = int(np.nanargmax(np.abs(medians - np.nanmedian(medians))))
    return float(low + (strip + 0.5) / 200 * (high - low))


def modelled_part(at: Floats, across: Floats, seam: SeamFrame) -> tuple[Floats, Floats]:
    """Step 3: the part's surface as a cloud with outward normals, over what was scanned of it.

    Raises:
        GeometryError: that is more than any scan of one part shows.
    """
    step = seam.course.difference(MODEL_SPACING_MM)
    # A margin on either side, so that no point finds its nearest neighbour at the model's edge.
    cells = np.unique(np.floor(at / step).astype(np.int64))
    places = np.unique(cells[:, None] + np.arange(-4, 5)) * step
    length = float(np.ptp(across)) / MODEL_SPACING_MM + 8
    if not length * len(places) <= MODEL_POINTS:
        raise GeometryError(f"the points reach over {np.ptp(across):.4g} mm of the pipe: no modelled pipe is so long")
    rows = np.arange(across.min() - 4 * MODEL_SPACING_MM, across.max() + 4 * MODEL_SPACING_MM, MODEL_SPACING_MM)
    model = seam.points(np.tile(places, len(rows)), np.repeat(rows, len(places)))
    return model, np.tile(seam.outward(places), (len(rows), 1))


def histogram_step(distances_mm: Floats) -> Histogram:
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
    return Histogram(edges_mm=edges[: last + 1], counts=counts[:last], kept=kept[:last], step_mm=step)
