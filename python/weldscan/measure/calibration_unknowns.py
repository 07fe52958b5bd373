"""What a scanner's covariance leaves open of the part's points, as unknowns for the step's fit.

A small error of the scanner's parameters bends the space that it measures, for all shots alike: a point p moves by
dp/dc, its radial deviation by D = n . dp/dc. With C = R R^T the covariance, the columns D R belong to unknowns of unit
variance; the fit of the step solves for them beside the walls, which are straight: so the part itself calibrates the
scanner, and what it does not tell is in U.

Source: GUM (JCGM 100:2008) 5.1 for the propagation; K.-R. Koch, Parameter Estimation (1999), 3.6 for unknowns with a
prior.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import Scanner
from weldscan.calibration.modes import covariance_root, deviation_modes
from weldscan.measure.part_views import PartView, wall_sample

Floats = NDArray[np.float64]
Modes = list[tuple[NDArray[np.int64], Floats]]

LEAST_MM = 1e-5
"""A mode that moves the part's points by less, rms, is left out."""


def calibration_unknowns(
    covariance: Floats | None, scanner: Scanner, views: Sequence[PartView], axis: str
) -> Modes | None:
    """The modes of a scanner's covariance at some points of every view, as `measure_step` takes them.

    Args:
        covariance: (24, 24), of `bundle.PARAMETERS`; None: nothing is stated.
        scanner: as calibrated.
        views: the segmented part shots.
        axis: x or y, of the projector's coordinate that was decoded.

    Returns:
        Of every view the points' numbers (n,) and their modes (n, m), mm; None where nothing is stated or open.
    """
    if covariance is None:
        return None
    root = covariance_root(covariance)
    if not root.shape[1]:
        return None
    numbers = [wall_sample(view.shot) for view in views]
    modes = []
    for view, at in zip(views, numbers, strict=True):
        shot, angle = view.shot, view.shot.angle_rad.ravel()[at].astype(float)
        normal = np.outer(np.cos(angle), shot.zero) + np.outer(np.sin(angle), np.cross(shot.axis, shot.zero))
        modes.append(deviation_modes(scanner, root, shot.points_mm(at), normal, axis))
    # Turned so that the first ones move most: unknowns of unit variance stay such.
    together = np.concatenate(modes)
    _, strength, turn = np.linalg.svd(together, full_matrices=False)
    kept = turn[strength > LEAST_MM * np.sqrt(len(together))].T
    if not kept.shape[1]:
        return None
    return [(at, mode @ kept) for at, mode in zip(numbers, modes, strict=True)]
