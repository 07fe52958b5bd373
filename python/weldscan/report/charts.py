"""The report's drawings as inline SVG. Colours are the page's own, so that they follow light, dark and print."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from weldscan._weldcore import SeamCourse
from weldscan.report.pictures import Extent, diverging
from weldscan.result import FATES, Coverage, Histogram, SeamBin, StepResult

WIDTH = 960
LEFT, RIGHT = 64, 24
GAP = 26  # between two arcs of the seam
GIRTH = SeamCourse(1.0)  # what readings of a pipe's seam are, whatever its size


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


def arcs_of(readings: Sequence[float], bridge: float = 8.0, course: SeamCourse = GIRTH) -> list[tuple[float, float]]:
    """The stretches that occupied bins make, (start, end) with an end perhaps beyond a whole turn."""
    # Gaps up to `bridge` do not part a stretch.
    width = course.bin_width
    at = np.asarray(readings, float)
    bins = np.unique(np.rint((at if course.turn is None else np.mod(at, course.turn)) / width).astype(int))
    if course.turn is not None:
        bins = np.unique(bins % course.bins)
    if bins.size == 0:
        return []
    if course.turn is not None:
        gaps = np.diff(np.append(bins, bins[0] + course.bins))
        if gaps.max() * width <= bridge:
            return [(0.0, course.turn)]
        # Begin after the widest gap, so that a stretch across the zero mark stays in one piece.
        first = int(np.argmax(gaps)) + 1
        bins = np.concatenate([bins[first:], bins[:first] + course.bins])
    cuts = np.flatnonzero(np.diff(bins) * width > bridge)
    starts, ends = np.append(0, cuts + 1), np.append(cuts, bins.size - 1)
    found = [(float(bins[s]) * width, float(bins[e]) * width) for s, e in zip(starts, ends, strict=True)]
    if course.turn is not None:
        found = [(s - course.turn, e - course.turn) if s >= course.turn else (s, e) for s, e in found]
    return sorted((s - width / 2, e + width / 2) for s, e in found)


class AlongAxis:
    """Stretches of the seam side by side, at one scale: from a reading to a place on the page."""

    def __init__(self, arcs: Sequence[tuple[float, float]], course: SeamCourse = GIRTH) -> None:
        self.arcs, self.course = list(arcs), course
        total = sum(end - start for start, end in arcs)
        self.scale = (WIDTH - LEFT - RIGHT - GAP * (len(self.arcs) - 1)) / total
        self.places: list[tuple[float, float]] = []
        x = float(LEFT)
        for start, end in self.arcs:
            self.places.append((x, (end - start) * self.scale))
            x += (end - start) * self.scale + GAP

    def __call__(self, reading: float) -> tuple[int, float] | None:
        """Which stretch a reading lies in, and its x; None where it was not seen."""
        for index, (start, end) in enumerate(self.arcs):
            along = self.course.told(reading - start)
            if 0 <= along <= end - start + 1e-6:
                return index, self.places[index][0] + along * self.scale
        return None

    def spans(self, first: float, last: float) -> Iterator[tuple[float, float]]:
        """Where a stretch, in the direction in which readings grow, lies on the page: (x, width) of each piece."""
        told, turn = self.course.told, self.course.turn
        length, first = told(last - first) or (turn or 0.0), told(first)
        for (start, end), (x, _) in zip(self.arcs, self.places, strict=True):
            for off in (0.0,) if turn is None else (-turn, 0.0, turn):
                low = max(start, first + off)
                high = min(end, first + length + off)
                if high > low + 1e-6:
                    yield x + (low - start) * self.scale, (high - low) * self.scale

    def draw(self, svg: Svg, top: float, bottom: float, readings: bool = True) -> None:
        """Frames, grid lines and readings below."""
        course = self.course
        span = sum(end - start for start, end in self.arcs)
        steps = (2, 5, 10, 15, 30, 45, 60) if course.turn is not None else (2, 5, 10, 20, 50, 100, 200, 500, 1000)
        step = next(step for step in steps if span / step <= 16 or step == steps[-1])
        for (start, end), (x, width) in zip(self.arcs, self.places, strict=True):
            svg.add("rect", x=x, y=float(top), width=width, height=float(bottom - top), class_="panel")
            for tick in range(math.ceil(start / step) * step, math.floor(end) + 1, step):
                at = x + (tick - start) * self.scale
                svg.line(at, top, at, bottom, "grid")
                if readings:
                    told = tick if tick == course.turn else course.told(tick)
                    svg.text(at, bottom + 17, f"{told:.0f}{course.unit}", "tick")
        if readings:
            svg.text((LEFT + WIDTH - RIGHT) / 2, bottom + 37, course.label, "axis")


@dataclass(frozen=True)
class Limit:
    """One line to draw: a limit and whose it is."""

    value_mm: float
    label: str


@dataclass(frozen=True)
class Mark:
    """Where something bars the verdict, and under which number the page lists it."""

    at_deg: float
    number: int


def seam_chart(
    step: StepResult | None,
    limits: Sequence[Limit] = (),
    guard_mm: float = 0.0,
    seam: Sequence[SeamBin] = (),
    coverage: Coverage | None = None,
    marks: Sequence[Mark] = (),
    course: SeamCourse = GIRTH,
) -> str:
    """Step along the seam with its uncertainty and every limit; below it, to the same scale, what became of the pixels.

    What was required and not seen is hatched, and no line runs across it; what bars the verdict is a red column.
    """
    known = [] if step is None else step.angle_deg[step.measured].tolist()
    along = AlongAxis(arcs_of([*known, *(each.angle_deg for each in seam)], course=course), course)
    width_of_bin = course.bin_width
    top, bottom = 26, 330 if known else 26
    strip = (bottom + (12 if known else 0), bottom + (64 if known else 60)) if seam else None
    end = strip[1] if strip else bottom
    svg = Svg(WIDTH, end + 48, "Step around the seam, with limits, and what became of the pixels")
    svg.parts.append(
        '<defs><pattern id="unseen" width="7" height="7" patternUnits="userSpaceOnUse" patternTransform="rotate(45)">'
        '<rect width="7" height="7" class="hatch-back"/><line x1="0" y1="0" x2="0" y2="7" class="hatch"/>'
        "</pattern></defs>"
    )
    panels = [(top, bottom)] if known else []
    if known:
        along.draw(svg, top, bottom, readings=strip is None)
    if strip:
        along.draw(svg, *strip)
        _draw_fates(svg, along, seam, *strip)
        panels.append(strip)
    for arc in unseen_arcs(seam, coverage, course) if known else ():
        for x, width in along.spans(*arc):
            svg.add("rect", x=x, y=float(top), width=width, height=float(bottom - top), fill="url(#unseen)")
            if width > 60:
                svg.text(x + width / 2, (top + bottom) / 2, "not seen", "unseen-label")
    for upper, lower in panels:
        for mark in marks:
            for x, width in along.spans(mark.at_deg - width_of_bin / 2, mark.at_deg + width_of_bin / 2):
                wide = max(width, 5.0)
                svg.add(
                    "rect",
                    x=x + width / 2 - wide / 2,
                    y=float(upper),
                    width=wide,
                    height=float(lower - upper),
                    class_="bar-column",
                )
    if step is not None and known:
        _draw_step(svg, along, step, limits, guard_mm, top, bottom)
    _draw_numbers(svg, along, marks, top - 6)
    return str(svg)


def _draw_step(
    svg: Svg, along: AlongAxis, step: StepResult, limits: Sequence[Limit], guard_mm: float, top: float, bottom: float
) -> None:
    some = step.measured
    reading, value, u = step.angle_deg[some], step.step_mm[some], step.u_mm[some]
    highest, lowest = max(float((value + u).max()), 0.0), min(float((value - u).min()), 0.0)
    if limits:
        # The side towards which the step leans shows every limit; the other one where the step comes near it.
        furthest, nearest = (pick(limit.value_mm for limit in limits) for pick in (max, min))
        up, down = highest >= -lowest, -lowest > highest
        if up or highest > 0.5 * nearest:
            highest = max(highest, furthest + guard_mm)
        if down or -lowest > 0.5 * nearest:
            lowest = min(lowest, -furthest - guard_mm)
    margin = 0.06 * (highest - lowest + 1e-9)
    low, high = lowest - margin, highest + margin

    def y(at: float) -> float:
        return bottom - (at - low) / (high - low) * (bottom - top)

    svg.value_ticks(nice_ticks(low, high, 7), y)
    svg.upright(16, (top + bottom) / 2, "step, mm")
    shown = [(sign * each.value_mm, each) for each in limits for sign in (1, -1) if low <= sign * each.value_mm <= high]
    for at, _ in shown:
        band = (y(min(at + guard_mm, high)), y(max(at - guard_mm, low)))
        svg.add("rect", x=LEFT, y=band[0], width=WIDTH - LEFT - RIGHT, height=band[1] - band[0], class_="guard")
    taken: list[tuple[float, bool]] = []
    for at, each in sorted(shown, key=lambda pair: pair[0]):
        svg.line(LEFT, y(at), WIDTH - RIGHT, y(at), "limit")
        # Two labels that would lie on each other go to either side.
        right = any(abs(y(at) - other) < 15 and not aside for other, aside in taken)
        taken.append((y(at), right))
        side, anchor = (WIDTH - RIGHT - 8, "end") if right else (LEFT + 8, "start")
        svg.text(side, y(at) - 5, each.label, "limit-label", anchor)

    if step.band_mm is not None:
        for run in _runs(along, reading.tolist(), value.tolist(), step.band_mm[some].tolist()):
            if len(run) > 1:
                for side in (1, -1):
                    edge = [(x, y(min(max(v + side * half, low), high))) for x, v, half in run]
                    svg.path(edge, "band-of-all")
    for run in _runs(along, reading.tolist(), value.tolist(), u.tolist()):
        if len(run) == 1:
            x, v, half = run[0]
            svg.line(x, y(v + half), x, y(v - half), "whisker")
        else:
            upper, lower = [(x, y(v + half)) for x, v, half in run], [(x, y(v - half)) for x, v, half in run]
            svg.path(upper + lower[::-1], "band", close=True)
            svg.path([(x, y(v)) for x, v, _ in run], "curve")
        for x, v, _ in run:
            svg.add("circle", cx=x, cy=y(v), r=2.4, class_="dot")
    place = along(step.max_abs_at_deg)
    if place is not None:
        index = int(np.argmin(np.abs(along.course.apart(reading, step.max_abs_at_deg))))
        x, middle = place[1], y(float(value[index]))
        anchor, aside = ("end", -9) if x > WIDTH * 0.75 else ("start", 9)
        svg.add("circle", cx=x, cy=middle, r=5.5, class_="mark")
        said = f"largest {step.max_abs_mm:.3f} mm at {step.max_abs_at_deg:.0f}{along.course.unit}"
        svg.text(x + aside, middle - 10, said, "mark-label", anchor)


def _runs(
    along: AlongAxis, readings: Sequence[float], value: Sequence[float], u: Sequence[float]
) -> Iterator[list[tuple[float, float, float]]]:
    """The bins that stand side by side, as (x, value, U): a line through them crosses nothing that was not measured."""
    places = sorted(
        (place, v, half) for at, v, half in zip(readings, value, u, strict=True) if (place := along(at)) is not None
    )
    run: list[tuple[float, float, float]] = []
    arc = -1
    for (index, x), v, half in places:
        if run and (index != arc or x - run[-1][0] > 1.5 * along.course.bin_width * along.scale):
            yield run
            run = []
        arc = index
        run.append((x, v, half))
    if run:
        yield run


def unseen_arcs(
    seam: Sequence[SeamBin], coverage: Coverage | None, course: SeamCourse = GIRTH
) -> list[tuple[float, float]]:
    """What was required and not measured: the gaps, and the bins of the seam without a number.

    Returns:
        Stretches apart from each other, (start, end) with an end perhaps beyond a whole turn.
    """
    told, turn, width = course.told, course.turn, course.bin_width
    arcs = [(each.angle_deg - width / 2, width) for each in seam if not each.measured]
    arcs += [(start, told(end - start) or (turn or 0.0)) for start, end in (coverage.gaps if coverage else ())]
    apart: list[tuple[float, float]] = []
    for start, length in sorted((told(start), length) for start, length in arcs):
        if apart and start <= apart[-1][1] + 1e-6:
            apart[-1] = (apart[-1][0], max(apart[-1][1], start + length))
        else:
            apart.append((start, start + length))
    if turn is None:
        return apart
    # The last may reach across the zero mark into the first ones.
    while len(apart) > 1 and apart[-1][1] >= apart[0][0] + turn - 1e-6:
        first = apart.pop(0)
        apart[-1] = (apart[-1][0], max(apart[-1][1], first[1] + turn))
    if len(apart) == 1 and apart[0][1] - apart[0][0] >= turn - 1e-6:
        return [(0.0, turn)]
    return apart


def _draw_fates(svg: Svg, along: AlongAxis, seam: Sequence[SeamBin], top: float, bottom: float) -> None:
    """Per bin a column of the shares of its pixels, the walls at the bottom."""
    columns: dict[str, list[str]] = {}
    for each in seam:
        total = sum(each.fate.values())
        half = along.course.bin_width / 2
        for x, width in along.spans(each.angle_deg - half, each.angle_deg + half):
            level = bottom
            if total == 0:
                svg.add("rect", x=x, y=float(top), width=width, height=float(bottom - top), fill="url(#unseen)")
            for name in FATES:
                height = each.fate.get(name, 0) / max(total, 1) * (bottom - top)
                if height > 0:
                    level -= height
                    columns.setdefault(name, []).append(f"M{x:.1f} {level:.2f}h{width:.2f}v{height:.2f}h{-width:.2f}z")
    for name in FATES:
        if name in columns:
            svg.add("path", d="".join(columns[name]), class_=f"fate-{name}")
    svg.text(LEFT - 9, top + 9, "100 %", "tick", "end")
    svg.text(LEFT - 9, bottom, "0", "tick", "end")
    svg.upright(16, (top + bottom) / 2, "pixels")


def _draw_numbers(svg: Svg, along: AlongAxis, marks: Sequence[Mark], y: float) -> None:
    """The bars' numbers above their columns; neighbours share a label."""
    places = sorted((place[1], mark.number) for mark in marks if (place := along(mark.at_deg)) is not None)
    groups: list[tuple[list[float], list[int]]] = []
    for x, number_ in places:
        if groups and x - groups[-1][0][-1] < 22:
            groups[-1][0].append(x)
            groups[-1][1].append(number_)
        else:
            groups.append(([x], [number_]))
    for xs, numbers in groups:
        x = (xs[0] + xs[-1]) / 2
        svg.path([(x - 5, y - 4), (x + 5, y - 4), (x, y + 4)], "bar-mark", close=True)
        svg.text(x, y - 7, ", ".join(map(str, sorted(set(numbers)))), "bar-number")


def map_chart(pictures: Sequence[str], extent: Extent, scale_mm: float, course: SeamCourse = GIRTH) -> str:
    """The unrolled deviation map with its axes and colour bar."""
    height, top, bottom = 350, 14, 244
    svg = Svg(WIDTH, height, "Deviation from the reference wall, unrolled: along the seam by across it")
    along = AlongAxis(extent.arcs, course)
    along.draw(svg, top, bottom)
    for uri, (x, width) in zip(pictures, along.places, strict=True):
        svg.add(
            "image", x=x, y=float(top), width=width, height=float(bottom - top), preserveAspectRatio="none", href=uri
        )
        svg.add("rect", x=x, y=float(top), width=width, height=float(bottom - top), class_="frame")

    def y(value: float) -> float:
        return top + (extent.high_mm - value) / (extent.high_mm - extent.low_mm) * (bottom - top)

    for tick in nice_ticks(extent.low_mm, extent.high_mm, 5):
        svg.line(LEFT - 5, y(tick), LEFT, y(tick), "zero")
        svg.text(LEFT - 9, y(tick) + 4, number(tick), "tick", "end")
    svg.upright(16, (top + bottom) / 2, "across the seam, mm")
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


def clock(
    step: StepResult | None,
    seen_deg: float,
    seam: Sequence[SeamBin] = (),
    coverage: Coverage | None = None,
    marks: Sequence[Mark] = (),
) -> str:
    """The seam as a clock face seen along the axis: what was seen, what is missing, what bars, where it is largest."""
    svg = Svg(230, 230, "Which arcs of the seam were seen")

    def at(angle_deg: float, radius: float) -> tuple[float, float]:
        # 0 degrees on top; seen along the axis, from the reference wall, right-handed angles run clockwise.
        turn = math.radians(angle_deg - 90)
        return 115 + radius * math.cos(turn), 115 + radius * math.sin(turn)

    def arc(start: float, end: float, class_: str) -> None:
        if end - start >= 360:
            svg.add("circle", cx=115, cy=115, r=70, class_=class_)
            return
        (x0, y0), (x1, y1) = at(start, 70), at(end, 70)
        large = int((end - start) % 360 > 180)
        svg.add("path", d=f"M{x0:.1f} {y0:.1f}A70 70 0 {large} 1 {x1:.1f} {y1:.1f}", class_=class_)

    svg.add("circle", cx=115, cy=115, r=70, class_="ring")
    measured = [] if step is None else step.angle_deg[step.measured].tolist()
    for start, end in arcs_of(measured, bridge=GIRTH.bin_width):
        arc(start, end, "ring-seen")
    for start, end in unseen_arcs(seam, coverage):
        arc(start, end, "ring-gap")
    for angle in range(0, 360, 30):
        (x0, y0), (x1, y1) = at(angle, 78), at(angle, 83)
        svg.line(x0, y0, x1, y1, "zero")
    for angle in range(0, 360, 90):
        x, y = at(angle, 98)
        svg.text(x, y + 4, f"{angle}°", "tick")
    for mark in marks:
        (x0, y0), (x1, y1) = at(mark.at_deg, 58), at(mark.at_deg, 82)
        svg.line(x0, y0, x1, y1, "ring-bar")
    if step is not None and measured:
        x, y = at(step.max_abs_at_deg, 70)
        svg.add("circle", cx=x, cy=y, r=6.0, class_="mark")
    svg.text(115, 112, f"{math.floor(seen_deg + 1e-6)}°", "clock")
    svg.text(115, 130, "of 360° seen", "tick")
    if coverage is not None and not coverage.enough:
        svg.text(115, 147, f"{coverage.required_deg:.0f}° required", "short")
    return str(svg)
