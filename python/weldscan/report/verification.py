"""Writes what a verification found: `verification.json` and `verification.html`."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from weldscan.records.files import plain, to_json, whole_folder, write_synced
from weldscan.records.verification import is_verification, verification_document
from weldscan.report import ICONS
from weldscan.report.charts import LEFT, RIGHT, WIDTH, Svg, nice_ticks, number
from weldscan.report.page import fill
from weldscan.report.pictures import data_uri, diverging
from weldscan.result import Characteristic, Drift, Verification

Floats = NDArray[np.float64]

SCALES = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)


def write_verification(found: Verification, out_dir: str | os.PathLike[str]) -> Path:
    """Writes both files as a whole folder and returns its path; the rules are those of `write_report`.

    Args:
        found: what `weldscan.verify` returned.
        out_dir: must not exist yet, be empty, or be an earlier verification, which is replaced.

    Raises:
        InputError: something else is in the way, or the folder cannot be written.
    """
    created = datetime.now(UTC)
    out = Path(out_dir)
    with whole_folder(out, is_verification) as folder:
        write_synced(folder / "verification.json", to_json(plain(verification_document(found, created))))
        write_synced(folder / "verification.html", html(found, created))
    return out


# --- the page ---------------------------------------------------------------------------------------------------------


def html(found: Verification, created: datetime) -> str:
    """The page: one file without any reference to another."""

    def shown(value: float | None, digits: int = 4) -> str:
        if value is None or not math.isfinite(value):
            return "–"
        return f"{value:.{digits}f}".replace("-", "−")

    ball_scale, plane_scale = (scale_of(each.residual_mm for each in some) for some in (found.balls, found.planes))
    return fill(
        "verification.html",
        created,
        v=found,
        icon=ICONS[found.verdict],
        why=why(found),
        volumes=[(each, volume(found, each)) for each in found.characteristics if each.value_mm is not None],
        ball_scale=ball_scale,
        plane_scale=plane_scale,
        ball_maps=[(ball, residual_map(ball.residual_mm, ball_scale)) for ball in found.balls],
        plane_maps=[(plane, residual_map(plane.residual_mm, plane_scale)) for plane in found.planes],
        drifts=[(each, drift_chart(each, found[each.name])) for each in found.drift if len(each.dates) > 1],
        mm=shown,
    )


def why(found: Verification) -> str:
    """The verdict in a sentence."""
    judged = [each for each in found.characteristics if each.limit_mm is not None]
    if not judged:
        return "no limit was given: measured, not judged"
    deciding = [each for each in judged if each.verdict is found.verdict]
    if all(each.verdict is found.verdict for each in judged):
        return f"{', '.join(each.name for each in deciding)}"
    return "; ".join(f"{each.name}: {each.reason}" for each in deciding)


def scale_of(maps: Iterable[Floats]) -> float:
    """A round number that 99 % of the cells stay below."""
    cells = np.concatenate([np.abs(each[np.isfinite(each)]) for each in maps] or [np.zeros(0)])
    most = float(np.percentile(cells, 99)) if cells.size else 0.0
    return next((scale for scale in SCALES if scale >= most), most)


def residual_map(residual_mm: Floats, scale_mm: float) -> str:
    """Mean residuals as a picture: white is on the surface, full colour `scale_mm` off; transparent where unseen."""
    seen = np.isfinite(residual_mm)
    colour = diverging(np.where(seen, residual_mm, 0.0) / scale_mm)
    image = np.dstack([colour, np.where(seen, 255, 0).astype(np.uint8)])
    return data_uri(cv2.resize(image, None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST).astype(np.uint8))


def _hex(value: float) -> str:
    red, green, blue = diverging(np.array([value]))[0]
    return f"#{red:02x}{green:02x}{blue:02x}"


def _marks(found: Verification, name: str) -> list[tuple[Floats, float, str]]:
    """Points (k, 3) in the scanner's frame, value and label of every position of a characteristic."""
    if name in ("PF", "PS"):
        return [
            (b.centre_mm[None], b.form_mm if name == "PF" else b.size_mm, f"{b.shot}, sphere {b.sphere}")
            for b in found.balls
        ]
    if name == "SD":
        return [(s.centres_mm, s.error_mm, f"{s.shot}, {s.spheres[0]}-{s.spheres[1]}") for s in found.spacings]
    return [(p.corners_mm, p.flatness_mm, p.shot) for p in found.planes]


def volume(found: Verification, characteristic: Characteristic) -> Svg:
    """The positions as the scanner sees them (left) and from its side (right), coloured by their error."""
    marks = _marks(found, characteristic.name)
    top, bottom, height = 18, 326, 420
    svg = Svg(WIDTH, height, f"{characteristic.title}: positions in the volume, coloured by their error")
    points = np.concatenate([mark[0] for mark in marks])
    low, high = points.min(axis=0) - 12, points.max(axis=0) + 12
    span = high - low
    room = WIDTH - 2 * LEFT - RIGHT - 30
    scale = min((bottom - top) / span[1], room / (span[0] + span[2]))
    limit = characteristic.limit_mm
    full = limit if limit is not None else next((s for s in SCALES if s >= max(abs(m[1]) for m in marks)), 1.0)

    def panel(left: float, axis: int, title: str) -> Callable[[Floats], tuple[float, float]]:
        width, tall = span[axis] * scale, span[1] * scale
        svg.add("rect", x=float(left), y=float(top), width=float(width), height=float(tall), class_="panel")
        for tick in nice_ticks(low[axis], high[axis], max(2, round(width / 70))):
            x = left + (tick - low[axis]) * scale
            svg.line(x, top, x, top + tall, "grid")
            svg.text(x, top + tall + 16, number(tick), "tick")
        for tick in nice_ticks(low[1], high[1], 6):
            y = top + (tick - low[1]) * scale
            svg.line(left, y, left + width, y, "grid")
            svg.text(left - 7, y + 4, number(tick), "tick", "end")
        svg.text(left + width / 2, top + tall + 35, title, "axis")
        return lambda p: (float(left + (p[axis] - low[axis]) * scale), float(top + (p[1] - low[1]) * scale))

    left = LEFT + 0.0
    front = panel(left, 0, "x, mm (as the camera sees it; y runs down)")
    side = panel(left + span[0] * scale + LEFT, 2, "z, mm (away from the camera)")
    for place, value, label in sorted(marks, key=lambda mark: abs(mark[1])):
        colour = _hex(value / full)
        for view in (front, side):
            at = [view(p) for p in place]
            if len(at) == 1:
                svg.add("circle", cx=at[0][0], cy=at[0][1], r=7.0, fill=colour, class_="probed")
            elif len(at) == 2:
                d = f"M{at[0][0]:.1f} {at[0][1]:.1f}L{at[1][0]:.1f} {at[1][1]:.1f}"
                svg.add("path", d=d, class_="spacing-edge")
                svg.add("path", d=d, stroke=colour, class_="spacing")
            else:
                d = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in at) + "Z"
                svg.add("path", d=d, fill=colour, fill_opacity="0.55", stroke=colour, stroke_width="2")
        if label == characteristic.where or label.replace(", ", ", spheres ", 1) == characteristic.where:
            x, y = front(place.mean(axis=0))
            svg.add("circle", cx=x, cy=y, r=10.5, class_="worst")
    below = "" if characteristic.name in ("PF", "F") else "too small"
    svg.colour_bar(height - 42, full, below, "mm" if limit is None else "the limit, mm")
    return svg


def drift_chart(drift: Drift, characteristic: Characteristic) -> Svg:
    """A characteristic over the dates: means, the worst values, the straight line and the limit."""
    height, top, bottom = 250, 16, 196
    svg = Svg(WIDTH, height, f"{characteristic.title} over the verifications")
    days = np.array([datetime.fromisoformat(date).timestamp() / 86_400 for date in drift.dates])
    means, worst = np.array(drift.mean_mm), np.array(drift.value_mm)
    limit = characteristic.limit_mm
    values = np.concatenate([means, worst, [0.0], [] if limit is None else [limit]])
    if limit is not None and worst.min() < 0:
        values = np.append(values, -limit)
    low, high = float(values.min()), float(values.max())
    margin = 0.08 * (high - low) + 1e-6
    low, high = low - margin, high + margin
    first, last = float(days.min()), float(days.max())
    pad = 0.04 * (last - first) + 0.5

    def x(day: float) -> float:
        return LEFT + (day - first + pad) / (last - first + 2 * pad) * (WIDTH - LEFT - RIGHT)

    def y(value: float) -> float:
        return bottom - (value - low) / (high - low) * (bottom - top)

    svg.value_axis(top, bottom, nice_ticks(low, high, 5), y)
    for bound in () if limit is None else (limit, -limit):
        if low <= bound <= high:
            svg.line(LEFT, y(bound), WIDTH - RIGHT, y(bound), "limit")
            svg.text(LEFT + 8, y(bound) - 6, f"limit {number(bound)} mm", "limit-label", "start")
    for day in _dates(first, last):
        svg.line(x(day), bottom, x(day), bottom + 5, "zero")
        svg.text(x(day), bottom + 19, datetime.fromtimestamp(day * 86_400, UTC).strftime("%Y-%m-%d"), "tick")
    if drift.rate_mm_per_year is not None:
        slope = drift.rate_mm_per_year / 365.25
        ends = [(day, float(means.mean()) + slope * (day - float(days.mean()))) for day in (first, last)]
        svg.path([(x(day), y(value)) for day, value in ends], "curve")
    for day, mean, value in zip(days, means, worst, strict=True):
        svg.line(x(day), y(mean), x(day), y(value), "whisker")
        svg.add("circle", cx=x(day), cy=y(value), r=3.0, class_="mark")
        svg.add("circle", cx=x(day), cy=y(mean), r=3.6, class_="dot")
    svg.upright(16, (top + bottom) / 2, f"{drift.name}, mm")
    svg.text((LEFT + WIDTH - RIGHT) / 2, bottom + 42, "date; dots: mean over the positions, rings: the worst", "axis")
    return svg


def _dates(first: float, last: float) -> Sequence[float]:
    """Some days between two, at even steps."""
    if last - first < 1:
        return [first]
    count = min(7, int(last - first) + 1)
    return [float(day) for day in np.linspace(first, last, count)]
