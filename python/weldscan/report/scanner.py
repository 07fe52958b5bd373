"""The page of a scanner's calibration: residuals over both images, uncertainty of points, coverage, the next pose."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from weldscan.report.charts import Svg
from weldscan.report.page import write_page
from weldscan.result import BoardPose, ScannerCalibration

Floats = NDArray[np.float64]

PANEL = 460
# A typical residual is drawn this long, so that its direction can be seen.
TYPICAL_LENGTH = 12.0


def write_scanner_page(found: ScannerCalibration, path: str | os.PathLike[str]) -> Path:
    """Writes the page as one self-contained file; an earlier page of a calibration is replaced.

    Raises:
        InputError: the file cannot be written, or is there already and is something else.
    """
    scales = [_magnification(found, device) for device in (0, 1)]
    return write_page(
        Path(path),
        "scanner.html",
        c=found,
        everything=[vectors(found, found.poses, device, scales[device]) for device in (0, 1)],
        each=[(pose, [vectors(found, (pose,), device, scales[device]) for device in (0, 1)]) for pose in found.poses],
        scales=scales,
        tilts=tilts(found),
        rows=[
            (name, value, u, name.split(".")[1] if "." in name else name)
            for name, value, u in zip(
                found.parameters, found.values.tolist(), found.standard_uncertainty.values(), strict=True
            )
        ],
        length=lambda v: float(np.sqrt(np.square(v).sum())),
    )


def _residuals(pose: BoardPose, device: int) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    if device == 0:
        return pose.camera_px, pose.camera_residual_px, pose.used[:, 0]
    return pose.projector_px, pose.projector_residual_px, pose.used[:, 1]


def _magnification(found: ScannerCalibration, device: int) -> float:
    """How much longer than they are residuals are drawn: a round number."""
    size = (found.camera_size, found.projector_size)[device]
    rms = found.rms_px[device]
    if not (math.isfinite(rms) and rms > 0):
        return 1.0
    wanted = TYPICAL_LENGTH / (rms * PANEL / size[0])
    power = 10 ** math.floor(math.log10(wanted))
    return float(max(step for step in (1, 2, 5) if step * power <= wanted) * power)


def vectors(found: ScannerCalibration, poses: tuple[BoardPose, ...], device: int, scale: float) -> Svg:
    """Features in the device's image, each with its residual, `scale` times as long; rejected ones in red."""
    width, height = (found.camera_size, found.projector_size)[device]
    shrink = PANEL / width
    svg = Svg(PANEL, height * shrink, f"Residuals in the {('camera', 'projector')[device]}'s image")
    svg.add("rect", x=0.5, y=0.5, width=PANEL - 1.0, height=height * shrink - 1.0, class_="panel")
    corners = (found.hull.camera_px, found.hull.projector_px)[device] * shrink
    for (x, y), (p, q) in zip(corners.tolist(), np.roll(corners, -1, axis=0).tolist(), strict=True):
        svg.line(x, y, p, q, "grid")
    for pose in poses:
        pixels, residuals, used = _residuals(pose, device)
        for (x, y), (dx, dy), good in zip(pixels * shrink, residuals * shrink * scale, used, strict=True):
            if not math.isfinite(x + dx + y + dy):
                continue
            class_ = "whisker" if good else "limit"
            svg.line(float(x), float(y), float(x + dx), float(y + dy), class_)
            svg.add("circle", cx=float(x), cy=float(y), r=1.3, class_="dot")
    return svg


def tilts(found: ScannerCalibration) -> Svg:
    """The boards' normals as a map: how far they lean, and which way in the image; a ring where to add one."""
    size, reach = 320.0, 60.0
    middle, radius = size / 2, size / 2 - 26
    svg = Svg(size, size, "Tilts of the board")
    for angle in (15, 30, 45, 60):
        r = angle / reach * radius
        svg.add("circle", cx=middle, cy=middle, r=r, fill="none", class_="grid")
        svg.text(middle + 3, middle - r - 3, f"{angle}°", "tick", "start")

    def at(x: float, y: float, tilt_deg: float) -> tuple[float, float]:
        r = min(tilt_deg, reach) / reach * radius
        along = math.hypot(x, y) or 1.0
        return middle + x / along * r, middle + y / along * r

    for pose in found.poses:
        normal = pose.camera_from_board[:3, 2]
        normal = normal if normal[2] > 0 else -normal
        x, y = at(float(normal[0]), float(normal[1]), pose.tilt_deg)
        svg.add("circle", cx=x, cy=y, r=4.0, class_="dot")
        svg.text(x + 6, y + 4, pose.name, "tick", "start")
    add = found.next_pose
    if add is not None:
        around = math.radians(add.around_deg)
        x, y = at(math.cos(around), math.sin(around), add.tilt_deg)
        svg.add("circle", cx=x, cy=y, r=7.0, class_="mark")
        svg.text(x, y - 10, "add", "mark-label")
    return svg
