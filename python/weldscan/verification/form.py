"""PF, PS and F from points: the ranges of residuals to the least-squares sphere and plane."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from statistics import NormalDist
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from weldscan._weldcore import PlaneFit, SphereFit, distance, fit_plane, fit_sphere, refuse_masked
from weldscan.errors import InputError

Floats = NDArray[np.float64]
Surface = TypeVar("Surface", SphereFit, PlaneFit)

# A point further from a sphere than this share of its radius does not say where the sphere is: it counts in the range
# and does not pull the fit. `find_spheres` calls the same the surroundings.
SPHERE_ZONE = 0.2
# The same of a plane, as a share of its extent.
PLANE_ZONE = 0.025
# So many points are enough to begin with.
PLANE_SAMPLE = 20_000


@dataclass(frozen=True, eq=False)
class FormError:
    """What the points of one sphere or plane give."""

    form_mm: float
    """Range of the residuals (PF, F) over the judged share of the points."""
    size_mm: float | None
    """D fitted - D calibrated (PS); None for a plane."""
    form_all_mm: float
    form_997_mm: float
    form_95_mm: float
    rms_mm: float
    noise_range_mm: float
    """Range that normal noise of this rms has over so many points."""
    points: int
    """How many the judged range is over."""
    wild: int
    """How many lie too far off to say where the surface is; the ranges have them, the fit and the rms do not."""
    residual_mm: Floats = field(repr=False)
    """(n,) of all points."""
    fit: SphereFit | PlaneFit = field(repr=False)
    """The sphere or plane."""


def probing_error(points_mm: ArrayLike, diameter_mm: float, share: float = 1.0) -> FormError:
    """PF and PS: range of the radial residuals to the least-squares sphere, and its diameter less the calibrated one.

    The sphere's radius is free. With a share below 1 the points that lie furthest off are left out, once, and the
    sphere is fitted again. Points further off than a fifth of the radius count in the range, not in the fit.

    Args:
        points_mm: (n, 3), finite, n >= 5: points on one sphere.
        diameter_mm: calibrated.
        share: of the points that count, 0.95 to 1.

    Returns:
        FormError. `form_mm` is over the share; `form_all_mm`, `form_997_mm` and `form_95_mm` are over all points, over
        99.7 % (VDI/VDE 2634 part 2) and over 95 % (ISO 10360-13). A range grows with the number of points: compare
        it with `noise_range_mm`.

    Raises:
        InputError: shape, a value that is not finite, a share out of range.
        GeometryError: the points do not determine a sphere.

    Example:
        >>> import numpy as np
        >>> from weldscan import probing_error
        >>> random = np.random.default_rng(1)
        >>> d = random.normal(size=(2000, 3)); d /= np.linalg.norm(d, axis=1)[:, None]
        >>> found = probing_error(10.005 * d, 20.0)
        >>> round(found.size_mm, 6), found.form_mm < 1e-9
        (0.01, True)
    """
    points = _points(points_mm)
    if not (math.isfinite(diameter_mm) and diameter_mm > 0):
        raise InputError(f"diameter_mm: must be positive, got {diameter_mm!r}")

    start = fit_sphere(points, robust=True)
    found = _form(points, share, start, lambda some, near: fit_sphere(some, near=near), SPHERE_ZONE * start.radius_mm)
    return FormError(**found, size_mm=2 * float(found["fit"].radius_mm) - diameter_mm)


def flatness_error(points_mm: ArrayLike, share: float = 1.0) -> FormError:
    """F: range of the residuals to the least-squares plane.

    Args:
        points_mm: (n, 3), finite, n >= 5: points on one plane.
        share: as in `probing_error`.

    Raises:
        InputError: shape, a value that is not finite, a share out of range.
        GeometryError: the points do not determine a plane.

    Example:
        >>> import numpy as np
        >>> from weldscan import flatness_error
        >>> x, y = (each.ravel() for each in np.meshgrid(np.arange(21.0), np.arange(10.0)))
        >>> wave = 0.01 * np.cos(np.pi * x)
        >>> round(flatness_error(np.stack([x, y, 500 + wave], axis=1)).form_mm, 6)
        0.02
    """
    points = _points(points_mm)
    start = fit_plane(points[:: max(1, len(points) // PLANE_SAMPLE)], robust=True)
    found = _form(points, share, start, lambda some, _: fit_plane(some), PLANE_ZONE * extent_mm(points))
    return FormError(**found, size_mm=None)


def _points(points_mm: ArrayLike) -> Floats:
    refuse_masked("points_mm", points_mm)
    points = np.ascontiguousarray(points_mm, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 5:
        raise InputError(f"points_mm: must be (n, 3) with n >= 5, got shape {points.shape}")
    if not np.isfinite(points).all():
        raise InputError("points_mm: holds NaN or infinity")
    return points


def extent_mm(points: Floats) -> float:
    """How large a patch of points is across, mm; single points far off do not count."""
    return 2 * float(np.percentile(np.linalg.norm(points - np.median(points, axis=0), axis=1), 95))


def _form(
    points: Floats, share: float, start: Surface, fitted: Callable[[Floats, Surface], Surface], zone_mm: float
) -> dict[str, Any]:
    """The fields of FormError: the surface through the points that are on it, the ranges over all of them."""
    if not 0.95 <= share <= 1:
        raise InputError(f"share: must be between 0.95 and 1, got {share!r}")
    on_it = distance(points, start, signed=False) <= zone_mm
    fit = fitted(points[on_it], start)
    residual = distance(points, fit)
    order = np.argsort(np.abs(residual), kind="stable")
    ranges: dict[float, tuple[float, Surface, int]] = {}
    for each in {1.0, 0.997, 0.95, share}:
        kept = np.sort(order[: len(points) - math.floor(round((1 - each) * len(points), 6))])
        again = fit if len(kept) == len(points) else fitted(points[kept[on_it[kept]]], fit)
        ranges[each] = float(np.ptp(distance(points[kept], again))), again, len(kept)
    rms = float(np.sqrt(np.square(residual[on_it]).mean()))
    return {
        "form_mm": ranges[share][0],
        "fit": ranges[share][1],
        "points": ranges[share][2],
        "form_all_mm": ranges[1.0][0],
        "form_997_mm": ranges[0.997][0],
        "form_95_mm": ranges[0.95][0],
        "wild": int(len(points) - on_it.sum()),
        "rms_mm": rms,
        "noise_range_mm": rms * noise_range(len(points), share),
        "residual_mm": residual,
    }


def noise_range(points: int, share: float = 1.0) -> float:
    """Range that so many normal numbers have on average, in standard deviations; over a share of them, its width.

    Source: G. Blom, Statistical Estimates and Transformed Beta-Variables (1958): the largest of n has the quantile
    (n - 3/8)/(n + 1/4), to 1 %.

    >>> [round(noise_range(n), 1) for n in (100, 1000, 10_000)]
    [5.0, 6.5, 7.7]
    """
    upper = (points - 0.375) / (points + 0.25)
    return 2 * NormalDist().inv_cdf(min(upper, (1 + share) / 2) if share < 1 else upper)
