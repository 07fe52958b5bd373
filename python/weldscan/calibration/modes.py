"""What a scanner's covariance does to points: its independent modes, and a scanner drawn from it.

With C = R R^T the covariance of the parameters and J = dp/dc the derivative of a triangulated point, the errors of all
points together are J R z with z independent and of unit variance: a calibration is so many unknowns common to all that
the scanner ever saw. Along a surface's normals n its deviations are D R z, D = n . J.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import Scanner
from weldscan.calibration.bundle import BundleModel
from weldscan.calibration.volume import point_jacobian
from weldscan.errors import InputError

Floats = NDArray[np.float64]

# Of the largest variance, in units of every parameter's own: less is rounding.
LEAST_MODE = 1e-12


def covariance_root(covariance: Floats) -> Floats:
    """R of a covariance C = R R^T: one column for each mode that is not nothing, the strongest first.

    Args:
        covariance: (24, 24), of `bundle.PARAMETERS`; zero rows and columns: known exactly.

    Returns:
        (24, m), m <= 24, in the parameters' units (px, 1, rad, mm).

    Raises:
        InputError: another shape.

    >>> import numpy as np
    >>> from weldscan.calibration.modes import covariance_root
    >>> covariance = np.diag([4.0, 1.0, *[0.0] * 22])
    >>> root = covariance_root(covariance)
    >>> root.shape, bool(np.allclose(root @ root.T, covariance))
    ((24, 2), True)
    """
    if covariance.shape != (24, 24):
        raise InputError(f"covariance: has the shape {covariance.shape}, not (24, 24)")
    units = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    units[units == 0] = 1.0
    values, vectors = np.linalg.eigh(covariance / np.outer(units, units))
    kept = np.flatnonzero(values > LEAST_MODE * max(float(values[-1]), 0.0))[::-1]
    return np.asarray(units[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


def deviation_modes(scanner: Scanner, root: Floats, points_mm: Floats, normals: Floats, axis: str = "x") -> Floats:
    """How points of a surface move along its normals with each mode of the scanner's covariance.

    The columns D C^(1/2) of a border of unknowns with unit variance. With z drawn, `out @ z` is to first order how far
    along the normals the scanner `drawn_scanner(scanner, root @ z)` puts what this one saw at the points.

    Args:
        scanner: as calibrated.
        root: (24, m), see `covariance_root`.
        points_mm: (n, 3), scanner frame.
        normals: (n, 3), unit vectors.
        axis: x or y, of the projector's coordinate that was decoded.

    Returns:
        (n, m), mm.
    """
    jacobian = point_jacobian(BundleModel.of(scanner), points_mm, axis)
    return np.asarray(np.einsum("ni,nij->nj", normals, jacobian) @ root)


def drawn_scanner(scanner: Scanner, step: Floats) -> Scanner:
    """The scanner whose parameters are off by a step.

    Args:
        scanner: as calibrated.
        step: (24,), of `bundle.PARAMETERS`; `root @ z` with z drawn from a standard normal distribution.
    """
    moved = BundleModel.of(scanner).moved(step, np.zeros((0, 6)))
    camera, projector = ((lens.width, lens.height) for lens in (scanner.camera, scanner.projector))
    return moved.scanner(camera, projector)
