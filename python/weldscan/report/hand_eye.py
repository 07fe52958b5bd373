"""The page of a hand-eye calibration: residuals by shot and sphere, each shot against the others, what was found."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np

from weldscan.report.charts import LEFT, RIGHT, WIDTH, Svg, nice_ticks
from weldscan.report.page import write_page
from weldscan.result import HandEye


def write_hand_eye_page(found: HandEye, path: str | os.PathLike[str], session: str = "") -> Path:
    """Writes the page as one self-contained file; an earlier page of a calibration is replaced.

    Raises:
        InputError: the file cannot be written, or is there already and is something else.
    """
    return write_page(
        Path(path),
        "hand_eye.html",
        h=found,
        session=session,
        residuals=residuals(found),
        matrix=matrix(found),
        degrees=math.degrees,
    )


def matrix(found: HandEye) -> str:
    """flange_from_scanner as text."""
    rows = found.flange_from_scanner.tolist()
    return "\n".join(" ".join(f"{v:12.8f}" for v in row[:3]) + f" {row[3]:12.4f}" for row in rows)


def residuals(found: HandEye) -> Svg:
    """Per shot the residuals of its three spheres, and its error under the hand-eye of the other shots."""
    top, bottom = 16, 256
    svg = Svg(WIDTH, 318, "Residual of every sphere of every shot, and each shot's error without it")
    sizes = [[s.residual_mm or 0.0 for s in shot.spheres] for shot in found.per_shot]
    without = [shot.left_out_error_mm or 0.0 for shot in found.per_shot]
    high = 1.12 * max(float(np.max(sizes, initial=0.0)), max(without, default=0.0), 1e-3)

    def y(value: float) -> float:
        return bottom - value / high * (bottom - top)

    svg.value_axis(top, bottom, nice_ticks(0.0, high, 6), y)
    step = (WIDTH - LEFT - RIGHT) / max(len(found.per_shot), 1)
    for i, shot in enumerate(found.per_shot):
        middle = LEFT + (i + 0.5) * step
        half = min(0.36 * step, 34.0)
        if shot.left_out_error_mm is not None:
            at = y(shot.left_out_error_mm)
            class_ = "dropped" if shot.outlier is None else "guard"
            svg.add("rect", x=middle - half, y=at, width=2 * half, height=bottom - at, class_=class_)
            svg.line(middle - half, at, middle + half, at, "zero" if shot.outlier is None else "limit")
        for j, size in enumerate(sizes[i]):
            x = middle + (j - 1) * 0.55 * half
            svg.add("circle", cx=x, cy=y(size), r=4.0, class_="dot")
            svg.text(x, y(size) - 8, str(j + 1), "tick")
        name = shot.shot.removeprefix("artefact-") if len(found.per_shot) > 8 else shot.shot
        svg.text(middle, bottom + 18, name, "tick" if shot.outlier is None else "limit-label")
        if shot.chi2 is not None:
            svg.text(middle, bottom + 35, f"χ² {shot.chi2:.0f}", "tick" if shot.outlier is None else "limit-label")
    svg.upright(16, (top + bottom) / 2, "mm")
    svg.text((LEFT + WIDTH - RIGHT) / 2, bottom + 57, "artefact shots; χ² has 9 degrees of freedom", "axis")
    return svg
