"""Writes what a comparison with probed points found: `validation.json` and `validation.html`."""

from __future__ import annotations

import math
import os
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from weldscan.records.files import plain, to_json, whole_folder, write_synced
from weldscan.records.validation import is_validation, validation_document, validation_rows
from weldscan.report.charts import LEFT, RIGHT, WIDTH, AlongAxis, Svg, arcs_of, nice_ticks
from weldscan.report.page import fill
from weldscan.report.pictures import diverging
from weldscan.result import Validation

PAPER_MM = 0.115


def write_validation(found: Validation, out_dir: str | os.PathLike[str]) -> Path:
    """Writes both files as a whole folder and returns its path; the rules are those of `write_report`."""
    created = datetime.now(UTC)
    out = Path(out_dir)
    with whole_folder(out, is_validation) as folder:
        write_synced(folder / "validation.json", to_json(plain(validation_document(found, created))))
        write_synced(folder / "validation.html", html(found, created))
    return out


def html(found: Validation, created: datetime) -> str:
    """The page."""

    def shown(value: float, digits: int = 3) -> str:
        return f"{value:.{digits}f}".replace("-", "−") if math.isfinite(value) else "–"

    return fill(
        "validation.html",
        created,
        v=found,
        typical_u=float(np.nanmedian(found.u_mm)),
        where=where(found),
        distances=distances(found),
        rows=validation_rows(found),
        mm=shown,
        number=shown,
    )


def where(found: Validation) -> Svg:
    """The probed points on the unrolled part, coloured by their distance."""
    top, bottom = 14, 250
    svg = Svg(WIDTH, 356, "Probed points on the unrolled part, coloured by their distance from the scanned surface")
    placed = np.isfinite(found.angle_deg)
    angles = AlongAxis(arcs_of(found.angle_deg[placed].tolist(), bridge=20))
    angles.draw(svg, top, bottom)
    low, high = float(found.axial_mm[placed].min()), float(found.axial_mm[placed].max())
    margin = 0.06 * (high - low) + 1.0
    low, high = low - margin, high + margin

    def y(value: float) -> float:
        return top + (high - value) / (high - low) * (bottom - top)

    svg.value_ticks(nice_ticks(low, high, 5), y)
    svg.upright(16, (top + bottom) / 2, "along the axis, mm")
    scale = next((s for s in (0.05, 0.1, 0.2, 0.5, 1.0, 2.0) if s >= found.max_abs_mm), found.max_abs_mm)
    for angle, axial, distance in zip(found.angle_deg, found.axial_mm, found.distance_mm, strict=True):
        place = angles(float(angle)) if math.isfinite(angle) else None
        if place is None:
            continue
        x = place[1]
        if not math.isfinite(distance):
            svg.path([(x - 4, y(axial) - 4), (x + 4, y(axial) + 4)], "limit")
            svg.path([(x - 4, y(axial) + 4), (x + 4, y(axial) - 4)], "limit")
            continue
        red, green, blue = diverging(np.array([distance / scale]))[0]
        svg.add("circle", cx=x, cy=y(axial), r=6.5, fill=f"#{red:02x}{green:02x}{blue:02x}", class_="probed")
    svg.colour_bar(bottom + 58, scale, "inside the scan", "outside, mm")
    return svg


def distances(found: Validation) -> Svg:
    """The distances in order of the angle, each with its U."""
    top, bottom = 16, 236
    svg = Svg(WIDTH, 270, "Signed distance of each probed point with its uncertainty")
    good = np.flatnonzero(np.isfinite(found.distance_mm))
    order = good[np.argsort(found.angle_deg[good], kind="stable")]
    reach = max(1.1 * PAPER_MM, 1.08 * float(np.max(np.abs(found.distance_mm[good]) + found.u_mm[good])))

    def y(value: float) -> float:
        return (top + bottom) / 2 - value / reach * (bottom - top) / 2

    svg.value_axis(top, bottom, nice_ticks(-reach, reach, 7), y)
    for limit in (PAPER_MM, -PAPER_MM):
        svg.line(LEFT, y(limit), WIDTH - RIGHT, y(limit), "limit")
    for place, i in enumerate(order):
        x = LEFT + (place + 0.5) / len(order) * (WIDTH - LEFT - RIGHT)
        value, u = float(found.distance_mm[i]), float(found.u_mm[i])
        svg.line(x, y(value - u), x, y(value + u), "whisker")
        svg.add("circle", cx=x, cy=y(value), r=3.2, class_="dot")
    svg.upright(16, (top + bottom) / 2, "distance, mm")
    svg.text((LEFT + WIDTH - RIGHT) / 2, bottom + 22, "probed points, by angle", "axis")
    return svg
