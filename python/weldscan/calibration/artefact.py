"""The three-sphere plate in one shot: which sphere is which, and whether it is the plate that the session describes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import find_spheres
from weldscan.errors import GeometryError, InputError

Floats = NDArray[np.float64]

PAIRS = ((0, 1), (1, 2), (2, 0))
# How much longer or shorter a distance may come out than it was touched: half a percent of it is far more than any
# calibrated scanner's scale error, and far less than two spheres of a plate must differ to be told apart.
SCALE_TOLERANCE = 0.005
# The distance that a single wrong sphere has no part in fits: it is off by less than this part of the others.
UNEXPLAINED = 0.25
# Standard uncertainty of one coordinate of a touched centre, mm: contact probing with the robot.
TOUCH_SIGMA_MM = 0.02


class PlateMismatch(InputError):
    """The spheres in view are not those that the session describes."""


@dataclass(frozen=True, eq=False)
class PlateView:
    """The three spheres of one artefact shot in the order of the touched centres, scanner frame."""

    shot: str
    centres_mm: Floats
    """(3, 3): sphere by coordinate."""
    covariances_mm2: Floats
    """(3, 3, 3): sphere by coordinate by coordinate."""
    rms_mm: tuple[float, ...]
    points: tuple[int, ...]


def distances(centres_mm: Floats) -> Floats:
    """Between the spheres 1-2, 2-3, 3-1, mm."""
    return np.array([np.linalg.norm(centres_mm[i] - centres_mm[j]) for i, j in PAIRS])


def find_plate(
    shot: str, points_mm: Floats, sphere_diameter_mm: float, touched_mm: Floats | None, base_from_flange: Floats
) -> PlateView:
    """Finds the plate's spheres in one shot and names them by their distances.

    Args:
        shot: its name, for messages.
        points_mm: (H, W, 3) float64, scanner frame, NaN where there is no point.
        sphere_diameter_mm: the calibrated diameter.
        touched_mm: (3, 3), the touched centres in base; None: any three spheres, in any order.
        base_from_flange: (4, 4), where the flange stood: the scanner on it sees the plate from the same side.

    Raises:
        GeometryError: fewer than three spheres of that size are in view.
        PlateMismatch: three are, but their distances are not the touched ones (the message says by how much), they run
            the other way round (a mirrored plate), or two distances are too alike to tell the spheres apart.
    """
    found = find_spheres(points_mm, sphere_diameter_mm / 2)
    if len(found) < 3:
        raise GeometryError(f"{len(found)} of 3 spheres of {sphere_diameter_mm:g} mm found")
    centres = np.array([sphere.center_mm for sphere in found])
    covariances = np.array([sphere.covariance for sphere in found])
    if touched_mm is None:
        if len(found) > 3:
            raise GeometryError(f"{len(found)} spheres of {sphere_diameter_mm:g} mm found, and none was touched")
        touched_mm, base_from_flange = centres, np.eye(4)
    wanted = distances(touched_mm)

    def misfit(order: tuple[int, ...]) -> Floats:
        return distances(centres[list(order)]) - wanted

    def doubt(order: tuple[int, ...]) -> Floats:
        sigma = np.sqrt([np.trace(covariances[order[i]] + covariances[order[j]]) / 3 for i, j in PAIRS])
        return np.asarray(5 * np.hypot(sigma, np.sqrt(2) * TOUCH_SIGMA_MM))

    orders = sorted(permutations(range(len(found)), 3), key=lambda order: float(np.square(misfit(order)).sum()))
    fitting = [order for order in orders if np.all(np.abs(misfit(order)) <= SCALE_TOLERANCE * wanted + doubt(order))]
    if not fitting:
        off = misfit(orders[0])
        raise PlateMismatch(
            "artefact.centres_base: this is not the plate in view: the distances touched are "
            + ", ".join(f"{d:.3f}" for d in wanted)
            + " mm, those scanned "
            + ", ".join(f"{d:+.3f}" for d in off)
            + " mm off"
            + _cause(off, wanted, SCALE_TOLERANCE * wanted + doubt(orders[0]))
        )
    seen = [order for order in fitting if same_side(centres[list(order)], touched_mm, base_from_flange)]
    if not seen:
        raise PlateMismatch(
            "artefact.centres_base: the plate is mirrored: its spheres run the other way round than those in view, "
            "though all distances fit"
        )
    if len(seen) > 1 and np.all(np.abs(misfit(seen[1]) - misfit(seen[0])) <= doubt(seen[1])):
        raise PlateMismatch(
            "artefact.centres_base: the distances between the spheres ("
            + ", ".join(f"{d:.3f}" for d in wanted)
            + " mm) are too alike to tell which sphere is which"
        )
    chosen = list(seen[0])
    return PlateView(
        shot=shot,
        centres_mm=centres[chosen],
        covariances_mm2=covariances[chosen],
        rms_mm=tuple(float(found[i].rms_mm) for i in chosen),
        points=tuple(len(found[i].inliers) for i in chosen),
    )


def order_complaint(view: PlateView, reference_mm: Floats, touched: bool) -> str | None:
    """What is wrong with the order of a view's spheres: permuted, or another plate; None where their distances fit.

    Args:
        view: the centres as they were named.
        reference_mm: (3, 3), the centres that they should be, in any frame.
        touched: whether these were touched, or are another shot's.
    """
    centres, wanted = view.centres_mm, distances(reference_mm)
    spread = np.trace(view.covariances_mm2, axis1=1, axis2=2) / 3
    sigma = np.sqrt([spread[i] + spread[j] for i, j in PAIRS])
    doubt = SCALE_TOLERANCE * wanted + 5 * np.hypot(sigma, np.sqrt(2) * TOUCH_SIGMA_MM)

    def misfit(order: tuple[int, ...]) -> Floats:
        return distances(centres[list(order)]) - wanted

    orders = sorted(permutations(range(3)), key=lambda order: float(np.square(misfit(order)).sum()))
    if np.all(np.abs(misfit((0, 1, 2))) <= doubt):
        return None
    best, said = orders[0], "those touched" if touched else "those of the first shot"
    if np.all(np.abs(misfit(best)) <= doubt):
        order = ", ".join(str(i + 1) for i in best)
        worst = float(np.abs(misfit((0, 1, 2))).max())
        return f"its spheres are permuted: a distance is {worst:.3f} mm off; in the order {order} they fit {said}"
    return (
        f"this is not the plate in view: its distances are {', '.join(f'{d:+.3f}' for d in misfit(best))} mm off {said}"
        + _cause(misfit(best), wanted, doubt)
    )


def _cause(misfit: Floats, wanted: Floats, doubt: Floats) -> str:
    """What would put the distances off like this: one sphere, whose two are off while the third fits; or the scale."""
    pair, *others = np.argsort(np.abs(misfit))
    if abs(misfit[pair]) < UNEXPLAINED * np.abs(misfit[others]).min():
        sphere = next(j for j in range(3) if j not in PAIRS[pair])
        return f": sphere {sphere + 1} alone explains it: touch it again"
    scale = float(misfit @ wanted / (wanted @ wanted))
    if np.all(np.abs(misfit - scale * wanted) <= doubt):
        return f": all are {1 + scale:.4g} times as long: is the unit, the probe or the scanner's calibration wrong?"
    return ""


def same_side(centres_mm: Floats, touched_mm: Floats, base_from_flange: Floats) -> bool:
    """Whether the scanner and the flange that carries it look at the same side of the plate."""

    def side(centres: Floats, eye: Floats) -> float:
        normal = np.cross(centres[1] - centres[0], centres[2] - centres[0])
        return float(np.dot(normal, eye - centres.mean(axis=0)))

    return side(centres_mm, np.zeros(3)) * side(touched_mm, base_from_flange[:3, 3]) > 0
