"""The report's drawings as inline SVG. Colours are the page's own, so that they follow light, dark and print."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from html import escape

import numpy as np

from weldscan.report.pictures import Extent, diverging
from weldscan.result import Histogram, StepResult

WIDTH = 960
LEFT, RIGHT = 64, 24
GAP = 26  # between two arcs of the seam


def _short(value: object) -> str:
    return f"{value:.2f}" if isinstance(value, float) else escape(str(value))


class Svg:
    """A drawing, element by element."""

    def __init__(self, width: float, height: float, title: str) -> None:
        self.parts = [
            f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{escape(title)}"'
            ' xmlns="http://www.w3.org/2000/svg">'
        ]

    def add(self, tag: str, content: str | None = None, **attributes: object) -> None:
        """One element; `class_` is written `class`, underscores become hyphens, numbers are kept short."""
        text = "".join(f' {name.rstrip("_").replace("_", "-")}="{_short(value)}"' for name, value in attributes.items())
        self.parts.append(f"<{tag}{text}/>" if content is None else f"<{tag}{text}>{escape(content)}</{tag}>")

    def line(self, x1: float, y1: float, x2: float, y2: float, class_: str) -> None:
        """A straight line."""
        self.add("line", x1=float(x1), y1=float(y1), x2=float(x2), y2=float(y2), class_=class_)

    def text(self, x: float, y: float, content: str, class_: str = "", anchor: str = "middle") -> None:
        """A label."""
        self.add("text", content, x=float(x), y=float(y), class_=class_, text_anchor=anchor)

    def path(self, points: Iterable[tuple[float, float]], class_: str, close: bool = False) -> None:
        """A polygon or a run of lines."""
        d = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points) + ("Z" if close else "")
        self.add("path", d=d, class_=class_)

    def upright(self, x: float, y: float, content: str) -> None:
        """The title of a vertical axis."""
        self.add(
            "text", content, transform=f"translate({x:.0f} {y:.0f}) rotate(-90)", class_="axis", text_anchor="middle"
        )

    def value_axis(self, top: float, bottom: float, ticks: Iterable[float], y: Callable[[float], float]) -> None:
        """The panel of a chart as wide as the page, with its ticks."""
        self.add("rect", x=LEFT, y=top, width=WIDTH - LEFT - RIGHT, height=bottom - top, class_="panel")
        self.value_ticks(ticks, y)

    def value_ticks(self, ticks: Iterable[float], y: Callable[[float], float]) -> None:
        """A line across the chart and a number at each tick."""
        for tick in ticks:
            self.line(LEFT, y(tick), WIDTH - RIGHT, y(tick), "zero" if tick == 0 else "grid")
            self.text(LEFT - 9, y(tick) + 4, number(tick), "tick", "end")

    def colour_bar(self, y: float, scale_mm: float, below: str, above: str) -> None:
        """The diverging scale from -`scale_mm` to `scale_mm`."""
        x0, x1 = WIDTH * 0.28, WIDTH * 0.72
        self.parts.append('<defs><linearGradient id="deviation">')
        for i, (red, green, blue) in enumerate(diverging(np.linspace(-1, 1, 17)).tolist()):
            self.parts.append(f'<stop offset="{i / 16:.4f}" stop-color="#{red:02x}{green:02x}{blue:02x}"/>')
        self.parts.append("</linearGradient></defs>")
        self.add("rect", x=x0, y=float(y), width=x1 - x0, height=12.0, fill="url(#deviation)", class_="frame-filled")
        for tick in nice_ticks(-scale_mm, scale_mm, 6):
            at = x0 + (tick + scale_mm) / (2 * scale_mm) * (x1 - x0)
            self.line(at, y + 12, at, y + 16, "zero")
            self.text(at, y + 29, number(tick), "tick")
        self.text(x0 - 10, y + 11, below, "tick", "end")
        self.text(x1 + 10, y + 11, above, "tick", "start")

    def __str__(self) -> str:
        return "".join(self.parts) + "</svg>"

    # What is written into a page as it is: all text in it has been escaped.
    __html__ = __str__


def nice_ticks(low: float, high: float, about: int) -> list[float]:
    """Round numbers in [low, high], some `about` of them."""
    rough = (high - low) / max(about, 1)
    if not rough > 0:
        return [low]
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(step * power for step in (1, 2, 2.5, 5, 10) if step * power >= rough * 0.999)
    return [round(i * step, 10) for i in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def number(value: float) -> str:
    """A tick's label, with a true minus sign."""
    return f"{value:g}".replace("-", "−")


def arcs_of(angles_deg: Sequence[float], bin_deg: float = 2.0, bridge_deg: float = 8.0) -> list[tuple[float, float]]:
    """The arcs that occupied bins make, (start, end) with an end perhaps beyond 360."""
    # Gaps up to `bridge_deg` do not part an arc.
    bins = np.unique(np.rint(np.mod(np.asarray(angles_deg, float), 360) / bin_deg).astype(int) % round(360 / bin_deg))
    if bins.size == 0:
        return []
    whole = round(360 / bin_deg)
    gaps = np.diff(np.append(bins, bins[0] + whole))
    if gaps.max() * bin_deg <= bridge_deg:
        return [(0.0, 360.0)]
    # Begin after the widest gap, so that an arc across the zero mark stays in one piece.
    first = int(np.argmax(gaps)) + 1
    turned = np.concatenate([bins[first:], bins[:first] + whole])
    cuts = np.flatnonzero(np.diff(turned) * bin_deg > bridge_deg)
    starts, ends = np.append(0, cuts + 1), np.append(cuts, turned.size - 1)
    arcs = [(float(turned[s]) * bin_deg, float(turned[e]) * bin_deg) for s, e in zip(starts, ends, strict=True)]
    arcs = [(s - 360, e - 360) if s >= 360 else (s, e) for s, e in arcs]
    return sorted((s - bin_deg / 2, e + bin_deg / 2) for s, e in arcs)


class AngleAxis:
    """Arcs side by side, at one scale: from an angle to a place on the page."""

    def __init__(self, arcs: Sequence[tuple[float, float]]) -> None:
        self.arcs = list(arcs)
        total = sum(end - start for start, end in arcs)
        self.scale = (WIDTH - LEFT - RIGHT - GAP * (len(self.arcs) - 1)) / total
        self.places: list[tuple[float, float]] = []
        x = float(LEFT)
        for start, end in self.arcs:
            self.places.append((x, (end - start) * self.scale))
            x += (end - start) * self.scale + GAP

    def __call__(self, angle_deg: float) -> tuple[int, float] | None:
        """Which arc an angle lies in, and its x; None where it was not seen."""
        for index, (start, end) in enumerate(self.arcs):
            along = (angle_deg - start) % 360
            if along <= end - start + 1e-6:
                return index, self.places[index][0] + along * self.scale
        return None

    def draw(self, svg: Svg, top: float, bottom: float) -> None:
        """Frames, grid lines and degrees below."""
        span = sum(end - start for start, end in self.arcs)
        step = next(step for step in (2, 5, 10, 15, 30, 45, 60) if span / step <= 16)
        for (start, end), (x, width) in zip(self.arcs, self.places, strict=True):
            svg.add("rect", x=x, y=float(top), width=width, height=float(bottom - top), class_="panel")
            for tick in range(math.ceil(start / step) * step, math.floor(end) + 1, step):
                at = x + (tick - start) * self.scale
                svg.line(at, top, at, bottom, "grid")
                svg.text(at, bottom + 17, f"{tick % 360 if tick != 360 else 360}°", "tick")
        svg.text((LEFT + WIDTH - RIGHT) / 2, bottom + 37, "angle about the pipe's axis, from the zero mark", "axis")


def step_chart(step: StepResult, limit_mm: float | None, judged: tuple[float, float] | None) -> str:
    """Step over angle with its uncertainty band, the limits and their guard bands; `judged` is (value, U)."""
    height, top, bottom = 390, 20, 330
    svg = Svg(WIDTH, height, "Step around the seam, with limit and guard band")
    angles = AngleAxis(arcs_of(step.angle_deg.tolist()))
    guard = judged[1] if judged else 0.0
    u_mm = np.nan_to_num(step.u_mm, posinf=0.0)
    highest = float(np.nanmax(step.step_mm + u_mm, initial=0.0))
    lowest = float(np.nanmin(step.step_mm - u_mm, initial=0.0))
    if limit_mm is not None:
        # The side of the limit that matters is always shown; the other one where the step comes near it.
        highest = max(highest, limit_mm + guard) if highest > 0.25 * -lowest else highest
        lowest = (
            min(lowest, -limit_mm - guard) if -lowest > 0.25 * max(highest, 0) and lowest < -0.3 * limit_mm else lowest
        )
    margin = 0.06 * (highest - lowest + 1e-9)
    low, high = lowest - margin, highest + margin

    def y(value: float) -> float:
        return bottom - (value - low) / (high - low) * (bottom - top)

    angles.draw(svg, top, bottom)
    svg.value_ticks(nice_ticks(low, high, 7), y)
    svg.upright(16, (top + bottom) / 2, "step, mm")
    for limit in () if limit_mm is None else (limit_mm, -limit_mm):
        if low <= limit <= high:
            band = (y(min(limit + guard, high)), y(max(limit - guard, low)))
            svg.add("rect", x=LEFT, y=band[0], width=WIDTH - LEFT - RIGHT, height=band[1] - band[0], class_="guard")
            svg.line(LEFT, y(limit), WIDTH - RIGHT, y(limit), "limit")
            svg.text(
                LEFT + 8,
                y(limit) - 6 - (y(limit) - band[0]),
                f"limit {number(limit)} mm, guard band ± {guard:.3f} mm",
                "limit-label",
                "start",
            )

    groups: dict[int, list[tuple[float, float, float]]] = {}
    for angle, value, u in zip(step.angle_deg, step.step_mm, u_mm, strict=True):
        place = angles(float(angle))
        if place is not None and math.isfinite(value):
            groups.setdefault(place[0], []).append((place[1], float(value), float(u)))
    for points in groups.values():
        points.sort()
        upper, lower = [(x, y(v + u)) for x, v, u in points], [(x, y(v - u)) for x, v, u in points]
        svg.path(upper + lower[::-1], "band", close=True)
        svg.path([(x, y(v)) for x, v, _ in points], "curve")
        for x, v, _ in points:
            svg.add("circle", cx=x, cy=y(v), r=2.4, class_="dot")
    place = angles(step.max_abs_at_deg)
    if place is not None:
        index = int(np.argmin(np.abs((step.angle_deg - step.max_abs_at_deg + 180) % 360 - 180)))
        x, at = place[1], y(float(step.step_mm[index]))
        anchor, aside = ("end", -9) if x > WIDTH * 0.75 else ("start", 9)
        svg.add("circle", cx=x, cy=at, r=5.5, class_="mark")
        svg.text(
            x + aside, at - 10, f"largest {step.max_abs_mm:.3f} mm at {step.max_abs_at_deg:.0f}°", "mark-label", anchor
        )
    return str(svg)


def map_chart(pictures: Sequence[str], extent: Extent, scale_mm: float) -> str:
    """The unrolled deviation map with its axes and colour bar."""
    height, top, bottom = 350, 14, 244
    svg = Svg(WIDTH, height, "Deviation from the reference wall, unrolled: angle by axis")
    angles = AngleAxis(extent.arcs)
    angles.draw(svg, top, bottom)
    for uri, (x, width) in zip(pictures, angles.places, strict=True):
        svg.add(
            "image", x=x, y=float(top), width=width, height=float(bottom - top), preserveAspectRatio="none", href=uri
        )
        svg.add("rect", x=x, y=float(top), width=width, height=float(bottom - top), class_="frame")

    def y(value: float) -> float:
        return top + (extent.high_mm - value) / (extent.high_mm - extent.low_mm) * (bottom - top)

    for tick in nice_ticks(extent.low_mm, extent.high_mm, 5):
        svg.line(LEFT - 5, y(tick), LEFT, y(tick), "zero")
        svg.text(LEFT - 9, y(tick) + 4, number(tick), "tick", "end")
    svg.upright(16, (top + bottom) / 2, "along the axis, mm")
    svg.colour_bar(bottom + 58, scale_mm, "inwards", "outwards, mm")
    return str(svg)


def histogram_chart(histogram: Histogram) -> str:
    """The paper's histogram of distances: bins of at least 20 % of the highest are kept, their mean is the result."""
    height, top, bottom = 290, 20, 232
    svg = Svg(WIDTH, height, "Histogram of the distances to the modelled pipe, with the 20 % line")
    some = np.flatnonzero(histogram.counts > 0)
    first, last = (int(some[0]), int(some[-1])) if some.size else (0, len(histogram.counts) - 1)
    edges, peak = histogram.edges_mm, max(1, int(histogram.counts.max()))
    low, high = float(edges[first]), float(edges[last + 1])

    def x(value: float) -> float:
        return LEFT + (value - low) / (high - low) * (WIDTH - LEFT - RIGHT)

    def y(count: float) -> float:
        return bottom - count / (1.08 * peak) * (bottom - top)

    svg.add("rect", x=LEFT, y=top, width=WIDTH - LEFT - RIGHT, height=bottom - top, class_="panel")
    for tick in nice_ticks(0, 1.08 * peak, 4):
        svg.line(LEFT, y(tick), WIDTH - RIGHT, y(tick), "grid")
        svg.text(LEFT - 9, y(tick) + 4, f"{tick / 1000:g}k" if tick >= 1000 else f"{tick:g}", "tick", "end")
    for i in range(first, last + 1):
        left, right = x(float(edges[i])), x(float(edges[i + 1]))
        class_ = "kept" if histogram.kept[i] else "dropped"
        at = y(float(histogram.counts[i]))
        svg.add("rect", x=left + 0.5, y=at, width=max(right - left - 1, 0.5), height=bottom - at, class_=class_)
    svg.line(LEFT, y(0.2 * peak), WIDTH - RIGHT, y(0.2 * peak), "limit")
    svg.text(WIDTH - RIGHT - 8, y(0.2 * peak) - 6, "20 % of the highest count", "limit-label", "end")
    for tick in nice_ticks(low, high, 10):
        svg.line(x(tick), bottom, x(tick), bottom + 5, "zero")
        svg.text(x(tick), bottom + 18, number(tick), "tick")
    at = x(histogram.step_mm)
    if LEFT <= at <= WIDTH - RIGHT:
        svg.line(at, top, at, bottom, "mean")
        anchor, aside = ("end", -8) if at > WIDTH * 0.7 else ("start", 8)
        svg.text(at + aside, top + 16, f"mean of the kept {histogram.step_mm:.3f} mm", "mark-label", anchor)
    svg.text((LEFT + WIDTH - RIGHT) / 2, bottom + 40, "distance of the other wall from the modelled pipe, mm", "axis")
    svg.upright(16, (top + bottom) / 2, "points")
    return str(svg)


def clock(step: StepResult) -> str:
    """The seam as a clock face seen along the axis: which arcs were seen, and where the step is largest."""
    svg = Svg(230, 230, "Which arcs of the seam were seen")

    def at(angle_deg: float, radius: float) -> tuple[float, float]:
        # 0 degrees on top; seen along the axis, from the reference wall, right-handed angles run clockwise.
        turn = math.radians(angle_deg - 90)
        return 115 + radius * math.cos(turn), 115 + radius * math.sin(turn)

    svg.add("circle", cx=115, cy=115, r=70, class_="ring")
    for start, end in arcs_of(step.angle_deg.tolist()):
        if end - start >= 360:
            svg.add("circle", cx=115, cy=115, r=70, class_="ring-seen")
            continue
        (x0, y0), (x1, y1) = at(start, 70), at(end, 70)
        svg.add(
            "path", d=f"M{x0:.1f} {y0:.1f}A70 70 0 {int(end - start > 180)} 1 {x1:.1f} {y1:.1f}", class_="ring-seen"
        )
    for angle in range(0, 360, 30):
        (x0, y0), (x1, y1) = at(angle, 78), at(angle, 83)
        svg.line(x0, y0, x1, y1, "zero")
    for angle in range(0, 360, 90):
        x, y = at(angle, 98)
        svg.text(x, y + 4, f"{angle}°", "tick")
    x, y = at(step.max_abs_at_deg, 70)
    svg.add("circle", cx=x, cy=y, r=6.0, class_="mark")
    svg.text(115, 112, f"{step.coverage_deg:.0f}°", "clock")
    svg.text(115, 130, "of 360° seen", "tick")
    return str(svg)
