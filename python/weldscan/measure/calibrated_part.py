"""Whether the part lies where the scanner was calibrated: how much of its walls the calibrated pixels' hull holds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import WeldShot
from weldscan.records.scanner import ScannerSpec
from weldscan.result import Finding, Label, bar, note, warning

Floats = NDArray[np.float64]

# Of a wall's pixels: with less of it inside, what is left is no wall to extrapolate from.
LEAST_INSIDE = 0.8
# Further from the reference wall than this, in thicknesses, a point is no wall's: as where shots are segmented.
GATE = 2.0


def held_against_calibration(
    name: str, spec: ScannerSpec, shot: WeldShot, points_mm: Floats, outside_mm: Floats, wall_mm: float
) -> tuple[Finding, ...]:
    """What there is to say of a segmented part shot; nothing where the scanner's file holds no hull.

    Args:
        name: of the shot.
        spec: the session's scanner.
        shot: segmented without the points outside the hull.
        points_mm: (H, W, 3), scanner frame, NaN where there is none.
        outside_mm: (n, 3), the points outside the hull.
        wall_mm: rated thickness.
    """
    if spec.hull is None:
        return ()
    walls = np.isin(shot.labels.ravel(), (Label.REFERENCE_WALL, Label.OTHER_WALL))
    inside = int(walls.sum())
    _, across, height = shot.seam.place(np.ascontiguousarray(outside_mm))
    beside = np.abs(across) > shot.bead_width_mm / 2
    outside = int((beside & (np.abs(height) < GATE * wall_mm)).sum())
    found: list[Finding] = []
    share = inside / max(inside + outside, 1)
    if share < LEAST_INSIDE:
        text = (
            f"{share:.0%} of the walls' pixels lie where the scanner was calibrated, {LEAST_INSIDE:.0%} are needed: "
            "calibrate it with the board in the images' borders too, or scan with the weld nearer to their middle"
        )
        found.append(bar("calibration", text, name))
    elif outside:
        text = f"{1 - share:.1%} of the walls' pixels lie outside of where the scanner was calibrated and do not count"
        found.append(note("calibration", text, name))
    (near, far), depth = spec.hull.depth_mm, points_mm.reshape(-1, 3)[walls, 2]
    beyond = float(((depth < near) | (depth > far)).mean()) if inside else 0.0
    if beyond > 1 - LEAST_INSIDE:
        text = (
            f"{beyond:.0%} of the walls' points lie nearer than {near:.0f} or further than {far:.0f} mm from the "
            "camera, where no board stood when it was calibrated"
        )
        found.append(warning("calibration", text, name))
    return tuple(found)


def mostly_outside(points_mm: Floats, outside_mm: Floats) -> str:
    """What to add to the reason why a shot could not be used; empty where its points were hardly masked."""
    inside, outside = int(np.isfinite(points_mm[..., 2]).sum()), len(outside_mm)
    share = outside / max(inside + outside, 1)
    if share <= 1 - LEAST_INSIDE:
        return ""
    return f" ({share:.0%} of its points lie where the scanner is not calibrated, and do not count)"


def about_region(spec: ScannerSpec) -> Finding | None:
    """A note where a calibrated scanner's file does not say where it was calibrated."""
    if spec.covariance is None or spec.hull is not None:
        return None
    text = (
        "the scanner's file does not say in which parts of its images it was calibrated: whether the part lies there "
        "is not known (weldscan-scanner/2 says it)"
    )
    return note("calibration", text)
