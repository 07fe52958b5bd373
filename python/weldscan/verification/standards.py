"""The standards in one shot: which pixels look at a sphere or at the plane, and what their points say."""

from __future__ import annotations

import math
from itertools import permutations

import cv2
import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import (
    FoundSphere,
    Lens,
    PlaneFit,
    distance,
    estimate_normals,
    find_spheres,
    fit_plane,
    fit_sphere,
    sphere_caps,
)
from weldscan.calibration.artefact import PAIRS, TOUCH_SIGMA_MM, PlateMismatch, distances
from weldscan.errors import GeometryError, InputError
from weldscan.records.session import ArtefactSpec, PlaneSpec
from weldscan.result import BallError, PlaneError, SpacingError
from weldscan.verification.form import PLANE_SAMPLE, PLANE_ZONE, extent_mm, flatness_error, probing_error

Floats = NDArray[np.float64]

# Sine of the 60 degrees about the line of sight in which a sphere counts (`sphere_caps`).
CAP_SIN = math.sqrt(0.75)
# Half of a cap or plane must have given points: less is another, easier standard than the one that is there.
LEAST_SEEN = 0.5
LEAST_POINTS = 100
# A plane whose longer side is less than this share of the field's diagonal tests a corner of the field alone. VDI/VDE
# 2634 part 2 asks for half (from memory); the report says where it is less.
LEAST_OF_FIELD = 0.25
# Beyond this share a sphere or a distance is not a scanner's error but another artefact.
SEARCH = 0.05
# `find_spheres` accepts half a per cent about the radius that it is given; steps of twice that leave no gap.
SEARCH_STEP = 0.01
# Where a surface over some pixels leans by more than this against the plane, it is a chamfer or a side face.
PLANE_LEAN_COS = math.cos(math.radians(15))
PLANE_WINDOW_PX = 9
# At an outline camera and projector pixels see two surfaces at once.
PLANE_BORDER_PX = 4
MAP_CELLS = 44


def touched_distance_u_mm(artefact: ArtefactSpec) -> float:
    """Of the distance of two centres that were touched each on its own, k = 2; their common bias cancels."""
    return 2 * math.sqrt(2) * (artefact.touch_sigma_mm or TOUCH_SIGMA_MM)


def plate_spheres(
    points_mm: Floats, artefact: ArtefactSpec, base_from_flange: Floats | None = None
) -> tuple[list[FoundSphere], Floats]:
    """The plate's three spheres in the order of the session, and the reference distances 1-2, 2-3, 3-1.

    The size may be off by 5 %: how far a scanner is wrong is what is to be found out.

    Raises:
        GeometryError: fewer than three spheres.
        PlateMismatch: three, but no order of them fits the distances, or more than one does.
    """
    radius = artefact.sphere_diameter / 2
    found: list[FoundSphere] = []
    steps = round(SEARCH / SEARCH_STEP)
    for step in sorted(range(-steps, steps + 1), key=abs):
        for sphere in find_spheres(points_mm, radius * (1 + step * SEARCH_STEP)):
            if all(np.linalg.norm(sphere.center_mm - other.center_mm) > radius for other in found):
                found.append(sphere)
        if len(found) >= 3:
            break
    if len(found) < 3:
        raise GeometryError(
            f"{len(found)} of 3 spheres of {artefact.sphere_diameter:g} mm found (within {100 * SEARCH:.0f} %)"
        )
    touched = None if artefact.centres_base is None else np.asarray(artefact.centres_base)
    if artefact.distances is not None:
        wanted = np.asarray(artefact.distances)
    elif touched is not None:
        wanted = distances(touched)
    else:
        raise InputError(
            "artefact.distances: missing, and so is centres_base: nothing says how far apart the spheres are"
        )
    centres = np.array([sphere.center_mm for sphere in found])

    def ratios(order: tuple[int, ...]) -> Floats:
        return np.asarray(distances(centres[list(order)]) / wanted)

    orders = [o for o in permutations(range(len(found)), 3) if np.all(np.abs(ratios(o) - 1) <= SEARCH)]
    if base_from_flange is not None and touched is not None:
        orders = [o for o in orders if _same_side(centres[list(o)], touched, base_from_flange)]
    # A scale is a scanner's error; what tells the spheres apart is the shape of the triangle.
    orders.sort(key=lambda o: float(np.std(ratios(o))))
    if not orders:
        seen = ", ".join(f"{d:.3f}" for d in distances(centres[:3]))
        raise PlateMismatch(
            f"artefact: this is not the plate in view, or it is mirrored: the distances are "
            f"{', '.join(f'{d:.3f}' for d in wanted)} mm, those scanned {seen} mm"
        )
    if len(orders) > 1:
        doubt = 5 * touched_distance_u_mm(artefact) / float(wanted.min())
        if np.std(ratios(orders[1])) - np.std(ratios(orders[0])) <= doubt:
            raise PlateMismatch(
                "artefact: the distances between the spheres are too alike to tell which sphere is which"
            )
    return [found[k] for k in orders[0]], np.asarray(wanted, dtype=np.float64)


def _same_side(centres: Floats, touched: Floats, base_from_flange: Floats) -> bool:
    """Whether the scanner and the flange that carries it look at the same side of the plate."""
    sides = []
    for place, eye in ((centres, np.zeros(3)), (touched, base_from_flange[:3, 3])):
        normal = np.cross(place[1] - place[0], place[2] - place[0])
        sides.append(float(normal @ (eye - place.mean(axis=0))))
    return sides[0] * sides[1] > 0


def plane_pixels(points_mm: Floats) -> NDArray[np.bool_]:
    """The pixels inside the outline of the largest plane in view, its border left out; (h, w), measured or not.

    Raises:
        GeometryError: no plane.
    """
    height, width = points_mm.shape[:2]
    flat = points_mm.reshape(-1, 3)
    good = np.flatnonzero(np.isfinite(flat).all(axis=1))
    if len(good) < LEAST_POINTS:
        raise GeometryError(f"no plane in view: {len(good)} points")
    fit = fit_plane(flat[good[:: max(1, len(good) // PLANE_SAMPLE)]], robust=True)
    off = distance(flat[good], fit, signed=False)
    zone = max(PLANE_ZONE * extent_mm(flat[good][off <= 3 * fit.rms_mm]), 3 * fit.rms_mm)
    normals = estimate_normals(points_mm, window=PLANE_WINDOW_PX).reshape(-1, 3)[good]
    along = np.abs(normals @ fit.normal) >= PLANE_LEAN_COS
    near = np.zeros(height * width, np.uint8)
    near[good[(off <= zone) & along]] = 1
    # Single pixels without a point do not part a plane.
    closed = cv2.morphologyEx(near.reshape(height, width), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=4)
    if count < 2:
        raise GeometryError("no plane in view")
    largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    outline, _ = cv2.findContours((labels == largest).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    mask = np.zeros((height, width), np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(np.vstack(list(outline))), 1)
    # A plane that goes on beyond the image has no border there.
    padded = np.pad(mask, PLANE_BORDER_PX, mode="edge")
    size = 2 * PLANE_BORDER_PX + 1
    eroded = cv2.erode(padded, np.ones((size, size), np.uint8), borderType=cv2.BORDER_REPLICATE)
    edge = PLANE_BORDER_PX
    return np.asarray(eroded[edge:-edge, edge:-edge] > 0)


def _map(column: Floats, row: Floats, shape: tuple[int, int], residual: Floats) -> Floats:
    """Mean residuals in cells; `column` and `row` in [0, 1)."""
    cell = np.minimum((row * shape[0]).astype(int), shape[0] - 1) * shape[1]
    cell += np.minimum((column * shape[1]).astype(int), shape[1] - 1)
    count = np.bincount(cell, minlength=shape[0] * shape[1])
    total = np.bincount(cell, residual, minlength=shape[0] * shape[1])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray((total / np.where(count > 0, count, np.nan)).reshape(shape))


def ball_errors(
    shot: str, points_mm: Floats, lens: Lens, artefact: ArtefactSpec, pose: Floats | None, share: float
) -> tuple[list[BallError], list[SpacingError]]:
    """PF and PS of the three spheres of a shot and SD of their three distances."""
    spheres, wanted = plate_spheres(points_mm, artefact, pose)
    flat = points_mm.reshape(-1, 3)
    rough = np.array([sphere.center_mm for sphere in spheres])
    balls: list[BallError] = []
    centres: list[Floats] = []
    for i, (pixels, outward, whole) in enumerate(sphere_caps(lens, rough, spheres[0].radius_mm)):
        good = np.isfinite(flat[pixels]).all(axis=1)
        points = flat[pixels][good]
        seen = len(points) / max(whole, 1)
        if seen < LEAST_SEEN or len(points) < LEAST_POINTS:
            raise GeometryError(
                f"sphere {i + 1}: {len(points)} points on {100 * seen:.0f} % of its 120° cap; "
                f"at least {LEAST_POINTS} and {100 * LEAST_SEEN:.0f} % are needed"
            )
        found = probing_error(points, artefact.sphere_diameter, share)
        assert found.size_mm is not None
        centre = fit_sphere(points, artefact.sphere_diameter / 2, near=spheres[i]).center_mm
        sight = -rough[i] / np.linalg.norm(rough[i])
        right = np.cross(sight, [0.0, -1.0, 0.0])
        right /= np.linalg.norm(right)
        across = outward[good] @ np.stack([right, np.cross(right, sight)], axis=1) / CAP_SIN
        centres.append(centre)
        balls.append(
            BallError(
                shot=shot,
                sphere=i + 1,
                centre_mm=centre,
                form_mm=found.form_mm,
                form_all_mm=found.form_all_mm,
                form_997_mm=found.form_997_mm,
                form_95_mm=found.form_95_mm,
                noise_range_mm=found.noise_range_mm,
                size_mm=found.size_mm,
                rms_mm=found.rms_mm,
                points=found.points,
                wild=found.wild,
                seen=seen,
                residual_mm=_map(
                    (across[:, 0] + 1) / 2, (across[:, 1] + 1) / 2, (MAP_CELLS, MAP_CELLS), found.residual_mm
                ),
            )
        )
    spacings = [
        SpacingError(
            shot,
            (i + 1, j + 1),
            np.array([centres[i], centres[j]]),
            float(np.linalg.norm(centres[i] - centres[j])),
            float(wanted[k]),
        )
        for k, (i, j) in enumerate(PAIRS)
    ]
    return balls, spacings


def plane_error(shot: str, points_mm: Floats, lens: Lens, spec: PlaneSpec | None, share: float) -> PlaneError:
    """F of a plane shot."""
    inside = plane_pixels(points_mm)
    row, column = np.nonzero(inside)
    points = points_mm[row, column]
    good = np.isfinite(points).all(axis=1)
    seen = float(good.mean()) if good.size else 0.0
    if seen < LEAST_SEEN or good.sum() < LEAST_POINTS:
        raise GeometryError(f"{int(good.sum())} points on {100 * seen:.0f} % of the plane in view")
    found = flatness_error(points[good], share)
    assert isinstance(found.fit, PlaneFit)
    middle, normal = found.fit.point_mm, found.fit.normal
    axes = np.linalg.eigh(np.cov(points[good].T))[1][:, :0:-1]
    flat = (points[good] - middle) @ axes
    # Single points far off would stretch the rectangle.
    low, high = np.percentile(flat, (0.1, 99.9), axis=0)
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]) @ axes.T
    corners += middle - (corners @ normal)[:, None] * normal
    size = float(high[0] - low[0]), float(high[1] - low[1])
    diagonal = math.hypot(lens.width / float(lens.K[0, 0]), lens.height / float(lens.K[1, 1])) * abs(float(middle[2]))
    if size[0] < LEAST_OF_FIELD * diagonal:
        raise GeometryError(
            f"the largest plane in view is {size[0]:.0f} mm long, less than a quarter of the field's diagonal of "
            f"{diagonal:.0f} mm"
        )
    if spec is not None and spec.size is not None:
        stated = sorted(spec.size, reverse=True)
        share_seen = size[0] * size[1] / (stated[0] * stated[1])
        if share_seen < LEAST_SEEN:
            raise GeometryError(
                f"{size[0]:.0f} x {size[1]:.0f} mm of the plane of {stated[0]:g} x {stated[1]:g} mm are seen"
            )
    top, left = row.min(), column.min()
    high_px, wide_px = int(row.max() - top + 1), int(column.max() - left + 1)
    scale = 2 * MAP_CELLS / max(high_px, wide_px)
    shape = max(1, round(high_px * scale)), max(1, round(wide_px * scale))
    return PlaneError(
        shot=shot,
        corners_mm=corners,
        flatness_mm=found.form_mm,
        flatness_all_mm=found.form_all_mm,
        flatness_997_mm=found.form_997_mm,
        flatness_95_mm=found.form_95_mm,
        noise_range_mm=found.noise_range_mm,
        rms_mm=found.rms_mm,
        points=found.points,
        wild=found.wild,
        seen=seen,
        size_mm=size,
        of_field=size[0] / diagonal,
        residual_mm=_map(
            (column[good] - left) / wide_px,
            (row[good] - top) / high_px,
            shape,
            found.residual_mm * (1 if normal[2] < 0 else -1),
        ),
    )
