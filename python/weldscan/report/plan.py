"""The page of a plan for a hand-eye calibration: from where the plate is seen, where the flange goes, what it gives."""

from __future__ import annotations

import math
import os
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from weldscan.report.charts import LEFT, RIGHT, WIDTH, Svg, nice_ticks, number
from weldscan.report.page import write_page

if TYPE_CHECKING:
    from weldscan.calibration.plan import Plan


def write_plan_page(found: Plan, path: str | os.PathLike[str], name: str = "") -> Path:
    """Writes the page as one self-contained file; an earlier page of a calibration is replaced."""
    return write_page(
        Path(path),
        "plan.html",
        p=found,
        name=name,
        views=views(found),
        gain=gain(found),
        degrees=math.degrees,
    )


def views(found: Plan) -> Svg:
    """Left: the sides from which the plate is seen. Right: the flange from above, with plate, base and reach."""
    height = 430
    svg = Svg(WIDTH, height, "Directions of view, and flange positions from above")
    middle_x, middle_y, radius = 225.0, 215.0, 165.0
    for tilt in (15, 30, 45):
        svg.add("circle", cx=middle_x, cy=middle_y, r=radius * tilt / 45, class_="frame", fill="none")
        svg.text(middle_x + 4, middle_y - radius * tilt / 45 - 4, f"{tilt}°", "tick", "start")
    svg.text(middle_x, height - 4, "tilt and side from which the plate is seen, with the image's x direction", "axis")
    for i, shot in enumerate(found.shots):
        out = radius * shot.tilt_deg / 45
        # Shots from one side are drawn side by side.
        twins = sum(s.tilt_deg == shot.tilt_deg and s.around_deg == shot.around_deg for s in found.shots[:i])
        around = math.radians(shot.around_deg + 9 * ((twins + 1) // 2) * (-1) ** twins)
        x, y = middle_x + out * math.cos(around), middle_y - out * math.sin(around)
        across = shot.base_from_scanner[:3, 0]
        svg.line(x, y, x + 24 * float(across[0]), y - 24 * float(across[1]), "curve")
        svg.add("circle", cx=x, cy=y, r=10.0, class_="mark")
        svg.text(x, y + 4, str(i + 1), "tick")
    flanges = np.array([shot.base_from_flange[:3, 3] for shot in found.shots])
    plate = found.centres_base_mm.mean(axis=0)
    every = np.vstack([flanges[:, :2], plate[None, :2], np.zeros((1, 2))])
    low, high = every.min(axis=0) - 60, every.max(axis=0) + 60
    left, right, top, bottom = 500.0, WIDTH - RIGHT, 16.0, 370.0
    scale = min((right - left) / (high[0] - low[0]), (bottom - top) / (high[1] - low[1]))

    def at(point: np.ndarray) -> tuple[float, float]:
        return left + (float(point[0]) - low[0]) * scale, bottom - (float(point[1]) - low[1]) * scale

    svg.add("rect", x=left, y=top, width=right - left, height=bottom - top, class_="panel")
    for tick in nice_ticks(low[0], low[0] + (right - left) / scale, 5):
        x, _ = at(np.array([tick, low[1]]))
        svg.line(x, bottom, x, bottom + 5, "zero")
        svg.text(x, bottom + 18, number(tick), "tick")
    for tick in nice_ticks(low[1], low[1] + (bottom - top) / scale, 5):
        _, y = at(np.array([low[0], tick]))
        svg.line(left - 5, y, left, y, "zero")
        svg.text(left - 9, y + 4, number(tick), "tick", "end")
    x, y = at(np.zeros(2))
    svg.add("circle", cx=x, cy=y, r=7.0, class_="dropped")
    svg.text(x, y + 22, "base", "tick")
    way = [at(flange) for flange in flanges]
    for (x1, y1), (x2, y2) in pairwise(way):
        svg.line(x1, y1, x2, y2, "whisker")
    px, py = at(plate)
    for i, flange in enumerate(flanges):
        x, y = at(flange)
        svg.line(x, y, px, py, "grid")
        svg.add("circle", cx=x, cy=y, r=10.0, class_="mark")
        svg.text(x, y + 4, str(i + 1), "tick")
    svg.path([at(centre) for centre in found.centres_base_mm], "kept", close=True)
    svg.text(px, py - 10, "plate", "mark-label")
    svg.text((left + right) / 2, height - 4, "the flange from above in the order of the plan, mm in base", "axis")
    return svg


def gain(found: Plan) -> Svg:
    """Predicted uncertainty over the number of shots."""
    top, bottom = 16, 196
    svg = Svg(WIDTH, 240, "Predicted uncertainty of a point at the working distance by the number of shots")
    values = [v if math.isfinite(v) else math.nan for v in found.u_mm]
    high = 1.1 * max((v for v in values if not math.isnan(v)), default=1.0)

    def x(shots: float) -> float:
        return LEFT + shots / (len(values) + 0.5) * (WIDTH - LEFT - RIGHT)

    def y(value: float) -> float:
        return bottom - value / high * (bottom - top)

    svg.value_axis(top, bottom, nice_ticks(0.0, high, 5), y)
    points = [(x(i + 1), y(v)) for i, v in enumerate(values) if not math.isnan(v)]
    svg.path(points, "curve")
    for px, py in points:
        svg.add("circle", cx=px, cy=py, r=3.4, class_="dot")
    for i in range(len(values)):
        svg.text(x(i + 1), bottom + 17, str(i + 1), "tick")
    svg.upright(16, (top + bottom) / 2, "u, mm (k = 1)")
    svg.text((LEFT + WIDTH - RIGHT) / 2, bottom + 37, "shots", "axis")
    return svg
