"""The seam as a whole: what became of every pixel, how much was seen, what a gauge would read, and what bars a PASS."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from weldscan._weldcore import Scanner, SeamCourse, seam_fates
from weldscan.measure.part_views import PartView
from weldscan.result import FATES, Coverage, Finding, SeamBin, bar

Floats = NDArray[np.float64]

# Beyond this angle between a surface and the rays of camera or projector nobody is surprised to see no fringes.
STEEPEST_DEG = 50.0
# Of the ends of all views, from the gentlest: some may end early for the very reason that a gap is looked for. And what
# one end may be short of another: stations are millimetres long.
USUAL_END, END_MARGIN_DEG = 0.4, 5.0
# So much of either wall beside its toe must be in view for a bin to be expected: what the edge is read from.
BESIDE_MM = 6.0
# A pixel's width of the image's border is not relied on.
BORDER_PX = 4.0
# Of a bin's points: holes have edges, and dust lies on any part. More is a surface that nobody recognised.
UNEXPLAINED_PART = 0.10
# Of the pixels at the weld of a bin: fewer measured ones are no sample of its surface any more.
SATURATED_PART, LOST_PART = 0.50, 0.75
# What drawn walls wave at most, 2.5 times 0.05 mm: what departs further is another surface.
WAVES_MM = 0.12
# Stations of two shots read the same place where they share so much of it, in stations.
SAME_PLACE = 0.6
# If the surfaces beside its toes are off by this part of what a station reads off its neighbours, so are the walls.
LOCAL_PART = 0.5
# So many stations without a reading are a gap: one may be a drop of spatter or a small hole.
GAP_STATIONS = 1.75
# Three sigma of what is stated with k = 2.
CONTRADICTION = 1.5
# Nothing is measured where fewer of the pixels at the weld have a point: some of its neighbours' noise.
DARK_PART = 0.05
# A bin with points that lies so near a station that was read: a hole at the toe is no gap of the seam.
REACH_STATIONS = 1.25
# A bin with fewer pixels is the sliver of a view.
LEAST_PIXELS = 50
INDEX = {name: k for k, name in enumerate(FATES)}
UNEXPLAINED = [INDEX[name] for name in ("gated", "off_line", "other")]
POINTS = [INDEX[name] for name in ("wall", "transition", "cap", "gated", "off_line", "other")]


@dataclass(frozen=True, eq=False)
class EdgeProfile:
    """The edge step by bin: how far the surfaces right beside the toes are apart."""

    course: SeamCourse
    """Whose bins these are."""
    step_mm: Floats
    """(bins,), NaN where it was not read."""
    u_mm: Floats
    """(bins,), expanded, k = 2, with what the choice of the toes may hide in full."""
    confirmed_mm: float
    """The largest |step| - U that two neighbouring stations share: a single one may be a drop of spatter."""
    departure_mm: Floats
    """(bins,), how far the surface beside the weld departs from the undisturbed walls; 0 where these reach the toes."""

    @property
    def worst(self) -> int | None:
        """The bin with the largest upper bound."""
        upper = np.abs(self.step_mm) + self.u_mm
        return None if np.isnan(upper).all() else int(np.nanargmax(upper))

    @property
    def judged(self) -> tuple[float, float] | None:
        """The largest step and its U: from what two neighbouring stations share to the largest upper bound."""
        if self.worst is None:
            return None
        value, u = abs(float(self.step_mm[self.worst])), float(self.u_mm[self.worst])
        # Another bin may tell more surely that the step is large than the one that tells how large it may be.
        low, high = max(0.0, min(self.confirmed_mm, value)), value + u
        return (high + low) / 2, (high - low) / 2

    @property
    def disturbed(self) -> bool:
        """Whether it is no undisturbed wall that ends at the weld where the edges may stand furthest apart."""
        return self.worst is not None and bool(self.departure_mm[self.worst] > WAVES_MM)

    def contradict(self, bins: NDArray[np.intp], wall_mm: Floats, wall_u_mm: Floats) -> bool:
        """Whether the edges tell another step than the walls: beyond what both leave open (k = 3 of their joint
        uncertainty, the hull once) in two bins beside each other.
        """
        off = np.abs(self.step_mm[bins] - wall_mm) - (CONTRADICTION * np.hypot(self.u_mm[bins], wall_u_mm))
        beyond = set(bins[off > 0].tolist())
        return any(self.course.beyond(k, 1) in beyond for k in beyond)


def edge_profile(views: Sequence[PartView]) -> EdgeProfile:
    """The edge step of all shots: at each place by the shot that tells the bin best, else by one that has read it; in
    each bin the reading furthest from zero.

    Args:
        views: the segmented part shots, one at least.
    """
    course = views[0].shot.seam.course
    shots = [_EdgesOfShot.of(view) for view in views]
    step, u, departure = np.full(course.bins, np.nan), np.full(course.bins, np.nan), np.zeros(course.bins)
    for k in sorted({k for shot in shots for k in shot.by_bin}):
        read, expanded, off = (np.concatenate(columns) for columns in zip(*_read_of_bin(shots, k), strict=True))
        worst = int(np.argmax(np.abs(read) + expanded))
        # The worst of several is further off than any single one's uncertainty says.
        chosen = abs(float(read[worst] - np.median(read)))
        step[k], u[k], departure[k] = read[worst], expanded[worst] + chosen, float(np.median(off))
    return EdgeProfile(course, step, u, max((shot.confirmed_mm for shot in shots), default=0.0), departure)


@dataclass(frozen=True, eq=False)
class _EdgesOfShot:
    """What the stations of one shot read, as far as neighbours share it."""

    course: SeamCourse
    along: Floats
    """(n,), readings."""
    reach: float
    """Part of a station, as a difference of readings: nearer than that, two shots read the same place."""
    step_mm: Floats
    u_mm: Floats
    departure_mm: Floats
    by_bin: Mapping[int, NDArray[np.intp]]
    confirmed_mm: float

    @classmethod
    def of(cls, view: PartView) -> Self:
        """From a view's sections."""
        shot, sections = view.shot, view.shot.sections
        expanded = 2 * sections["edge_standard_mm"] + sections["edge_hull_mm"]
        read, expanded = _shared(sections["edge_step_mm"], expanded, sections["local_step_mm"])
        lower = np.abs(read) - expanded
        # The same sign: two that stand off in opposite directions confirm nothing.
        pairs = np.where(np.sign(read[1:]) == np.sign(read[:-1]), np.fmin(lower[1:], lower[:-1]), np.nan)
        known = np.isfinite(read) & np.isfinite(expanded)
        return cls(
            shot.seam.course,
            sections["along"],
            SAME_PLACE * shot.seam.course.reading_of_mm(shot.station_mm),
            read,
            expanded,
            sections["departure_mm"].max(axis=1),
            {k: found for k, near in _stations_by_bin(view).items() if len(found := near[known[near]])},
            0.0 if not len(pairs) or np.isnan(pairs).all() else max(0.0, float(np.nanmax(pairs))),
        )


def _read_of_bin(shots: Sequence[_EdgesOfShot], k: int) -> list[tuple[Floats, Floats, Floats]]:
    """Steps, their U and departures of the stations that reach into a bin. A shot that tells the bin better overrules
    another where it has read the same place, and nowhere else: it may have seen no more than the bin's end.
    """
    seen = [shot for shot in shots if k in shot.by_bin]
    taken: list[float] = []
    found = [(np.zeros(0), np.zeros(0), np.zeros(0))]
    for shot in sorted(seen, key=lambda shot: float(np.median(shot.u_mm[shot.by_bin[k]]))):
        stations = shot.by_bin[k]
        if taken:
            apart = [np.abs(shot.course.apart(shot.along[stations], other)) for other in taken]
            stations = stations[np.min(apart, axis=0) > shot.reach]
        taken += shot.along[stations].tolist()
        found.append((shot.step_mm[stations], shot.u_mm[stations], shot.departure_mm[stations]))
    return found


def _shared(read: Floats, expanded: Floats, local: Floats) -> tuple[Floats, Floats]:
    """The readings of one shot's stations; where one is beyond both its neighbours, the worse of these: it is a drop of
    spatter, or a ripple taken for the toe. Not where the surfaces beside the weld are off as well: `local` is how far.
    """
    upper = np.abs(read) + expanded
    shared, uncertain = read.copy(), expanded.copy()
    for k in range(1, len(read) - 1):
        worse = k - 1 if upper[k - 1] > upper[k + 1] else k + 1
        # Nothing is beyond an unknown one.
        if upper[k] > upper[worse] and upper[k] > upper[2 * k - worse]:
            off = read[k] - read[worse]
            if not local[k] * off > LOCAL_PART * off**2:
                shared[k], uncertain[k] = read[worse], expanded[worse]
    return shared, uncertain


def _stations_by_bin(view: PartView) -> dict[int, NDArray[np.intp]]:
    """The stations that reach into each bin."""
    shot, course = view.shot, view.shot.seam.course
    readings = shot.sections["along"]
    half = course.bin_width / 2 + course.reading_of_mm(shot.station_mm / 2)
    off = readings[None, :] - course.bin_width * np.arange(course.bins)[:, None]
    near = np.abs(course.apart(off.ravel(), 0.0)).reshape(off.shape) < half
    return {int(k): np.flatnonzero(near[k]) for k in np.flatnonzero(near.any(axis=1))}


def expected_bins(views: Sequence[PartView], scanner: Scanner) -> set[int]:
    """The bins that these views should have seen, by poses, lenses and the part: whole, with the walls beside the weld,
    in both images, and not steeper to either ray than what these views measure elsewhere.
    """
    fields = [field for view in views if (field := _field(view, scanner)) is not None]
    # Where a view ends within both images, the light ends it: so steep can this surface be measured.
    ends = [end for view, field in zip(views, fields, strict=False) for end in _ends(view, *field)]
    steepest = max(STEEPEST_DEG, float(np.quantile(ends, USUAL_END)) - END_MARGIN_DEG) if ends else STEEPEST_DEG
    return {int(k) for inside, steep in fields for k in np.flatnonzero(inside & (steep < steepest))}


def _field(view: PartView, scanner: Scanner) -> tuple[NDArray[np.bool_], Floats] | None:
    """Per bin: whether it lies in both images, and the angle between its surface and the steeper ray, degrees."""
    shot, seam, course = view.shot, view.shot.seam, view.shot.seam.course
    toes = shot.sections["toes_mm"]
    if np.isnan(toes).all():
        return None
    low, high = np.nanmedian(toes[:, 0]) - BESIDE_MM, np.nanmedian(toes[:, 1]) + BESIDE_MM
    margin = course.bin_width / 2 + course.reading_of_mm(shot.station_mm)
    inside, steep = np.ones(course.bins, bool), np.zeros(course.bins)
    for off in (-margin, 0.0, margin):
        at = np.array([course.at(course.bin_width * k + off) for k in range(course.bins)])
        normal = seam.outward(at)
        for across in (low, 0.0, high):
            points = seam.points(at, np.full(course.bins, across))
            inside &= points[:, 2] > 0
            for pixels, lens in (
                (scanner.camera.project(points), scanner.camera),
                (scanner.project_to_projector(points), scanner.projector),
            ):
                size = np.array([lens.width, lens.height]) - 1 - BORDER_PX
                inside &= ((pixels >= BORDER_PX) & (pixels <= size)).all(axis=1)
            if view.hull is not None:
                inside &= view.hull.holds(scanner.camera.project(points), scanner.project_to_projector(points))
            for eye in (np.zeros(3), np.asarray(scanner.camera_from_projector)[:3, 3]):
                ray = eye - points
                cosine = np.einsum("ij,ij->i", ray, normal) / np.linalg.norm(ray, axis=1)
                steep = np.maximum(steep, np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return inside, steep


def _ends(view: PartView, inside: NDArray[np.bool_], steep: Floats) -> list[float]:
    """How steep the outermost bins are that a view measured, where the next one is in both images too."""
    read = np.isfinite(view.shot.sections["edge_step_mm"])
    seen = {k for k, stations in _stations_by_bin(view).items() if read[stations].any() and inside[k]}
    if not seen:
        return []
    course = view.shot.seam.course
    middle = min(seen, key=lambda k: steep[k])
    away = course.apart(course.bin_width * np.array(sorted(seen)), course.bin_width * middle)
    ends = []
    for way in (-1, 1):
        end = round(float((way * away).max()) / course.bin_width)
        last, beyond = course.beyond(middle, way * end), course.beyond(middle, way * (end + 1))
        if end > 0 and last is not None and beyond is not None and inside[beyond]:
            ends.append(float(steep[last]))
    return ends


def _beside_read(views: Sequence[PartView], near: Sequence[NDArray[np.uint32]]) -> set[int]:
    """The bins that hold points beside a station that was read, where holes at the toes kept their own from being read.

    Where nothing is seen, all may be: a dark bin is a gap however short.
    """
    found: set[int] = set()
    for view, table in zip(views, near, strict=True):
        shot, course = view.shot, view.shot.seam.course
        reach = REACH_STATIONS * course.reading_of_mm(shot.station_mm)
        read = shot.sections["along"][np.isfinite(shot.sections["edge_step_mm"])]
        sampled = _lost(table) <= LOST_PART
        for at in read.tolist():
            first, last = math.ceil((at - reach) / course.bin_width), math.floor((at + reach) / course.bin_width)
            near_it = (course.beyond(k, 0) for k in range(first, last + 1))
            found.update(k for k in near_it if k is not None and sampled[k])
    return found


def _lost(near: NDArray[Any]) -> Floats:
    """The share of the pixels at the weld that were not measured, by bin; infinite where hardly any are there."""
    total = near.sum(axis=-1)
    share = 1 - near[..., POINTS].sum(axis=-1) / np.maximum(total, 1)
    return np.where(total >= LEAST_PIXELS, share, np.inf)


def coverage_of(
    course: SeamCourse, measured: Iterable[int], expected: Iterable[int], required: float | None, by: str
) -> Coverage:
    """How much was seen of what had to be.

    Args:
        course: of the seam, whose bins these are.
        measured: bins with a step.
        expected: bins that the views should have seen.
        required: of the session or the option, as a difference of readings; None: what was expected.
        by: session, option or views.
    """
    seen, wanted = set(measured), set(expected)
    seen_length = course.bin_width * len(seen)
    if required is None:
        return Coverage(seen_length, course.bin_width * len(wanted), by, _stretches(course, wanted - seen))
    missing = wanted - seen
    if seen_length < required:
        missing = set(range(course.bins)) - seen
    return Coverage(seen_length, required, by, _stretches(course, missing))


def _stretches(course: SeamCourse, bins: set[int]) -> tuple[tuple[float, float], ...]:
    """Runs of bins as stretches of the seam: the readings of their ends, in the direction in which readings grow."""
    if course.turn is not None and len(bins) >= course.bins:
        return ((0.0, course.turn),)
    width = course.bin_width
    found = []
    for start in sorted(bins):
        if course.beyond(start, -1) in bins:
            continue
        end = start
        while (following := course.beyond(end, 1)) is not None and following in bins:
            end = following
        found.append((course.told(width * start - width / 2), course.told(width * end + width / 2)))
    return tuple(found)


@dataclass(frozen=True)
class _Section:
    """What one bin of the seam looks like across, as `SeamBin` has it."""

    toes_mm: tuple[float, float]
    toes_u_mm: tuple[float, float]
    transition_mm: tuple[float | None, float | None]
    transition_depth_mm: tuple[float | None, float | None]

    @property
    def width_mm(self) -> float:
        return self.toes_mm[1] - self.toes_mm[0]


@dataclass(frozen=True, eq=False)
class Seam:
    """Every bin of the seam, and what there is to say of them."""

    bins: tuple[SeamBin, ...]
    coverage: Coverage
    findings: tuple[Finding, ...]


def seam_of(
    views: Sequence[PartView],
    scanner: Scanner,
    measured: Iterable[int],
    nominal: SeamCourse,
    required: float | None = None,
    required_by: str = "views",
) -> Seam:
    """The fates of all pixels by bin, the coverage, and the bars that follow from them and from the cross-sections.

    Args:
        views: the segmented part shots.
        scanner: that took them.
        measured: bins with a step.
        nominal: how the seam runs, by the part's rated size: lengths along it are counted on that.
        required: least coverage, as a difference of readings, where session or option ask for one.
        required_by: session, option or views.
    """
    measured, course = set(measured), views[0].shot.seam.course
    tables = [seam_fates(view.shot, np.ascontiguousarray(view.reason), scanner) for view in views]
    every: NDArray[np.int64] = np.zeros((course.bins, len(FATES)), np.int64)
    for table, _, _ in tables:
        every += table
    at_weld = [near for _, near, _ in tables]
    expected = expected_bins(views, scanner)
    beside = _beside_read(views, at_weld) & expected
    coverage = coverage_of(course, measured | beside, expected, required, required_by)
    whole = course.turn is not None and coverage.required_deg >= course.turn
    wanted = set(range(course.bins)) if whole else expected
    sections = _sections(views)
    bins = tuple(
        SeamBin(
            angle_deg=course.bin_width * k,
            along_mm=nominal.along_mm(nominal.at(course.bin_width * k)),
            measured=k in measured,
            fate=dict(zip(FATES, every[k].tolist(), strict=True)),
            cap_width_mm=sections[k].width_mm if k in sections else None,
            toes_mm=sections[k].toes_mm if k in sections else None,
            toes_u_mm=sections[k].toes_u_mm if k in sections else None,
            transition_mm=sections[k].transition_mm if k in sections else None,
            transition_depth_mm=sections[k].transition_depth_mm if k in sections else None,
        )
        for k in range(course.bins)
        if k in wanted or k in measured or every[k][POINTS].sum() >= LEAST_PIXELS
    )
    counted = expected & (measured | beside)
    findings = [*_of_coverage(course, coverage)]
    findings += _of_gaps(views, counted) or _of_dark(views, [cells for _, _, cells in tables], counted)
    for view, (table, near, _) in zip(views, tables, strict=True):
        findings += _of_fates(view, table, near, measured | expected)
        findings += [bar(code, text, view.name, along) for code, along, text in view.shot.doubts]
    findings += _of_lost(views, at_weld, measured | expected, expected)
    return Seam(bins, coverage, tuple(findings))


def _sections(views: Sequence[PartView]) -> Mapping[int, _Section]:
    """The cross-section in each bin; where two shots saw it, that with the wider cap: it is the one to worry about."""
    found: dict[int, _Section] = {}
    for view in views:
        sections = view.shot.sections
        toes, walls = sections["toes_mm"], sections["undisturbed_mm"]
        table = np.stack(
            [toes, sections["toes_standard_mm"], (walls - toes) * (-1.0, 1.0), sections["departure_mm"]], axis=1
        )
        for k, stations in _stations_by_bin(view).items():
            known = table[stations][np.isfinite(toes[stations]).all(axis=1)]
            if len(known):
                toe, u, length, depth = np.median(known, axis=0).tolist()
                # A wall that is nowhere undisturbed has no transition: it has not ended.
                ends = [math.isfinite(one) for one in length]
                one = _Section(
                    (toe[0], toe[1]),
                    (2 * u[0], 2 * u[1]),
                    (length[0] if ends[0] else None, length[1] if ends[1] else None),
                    (depth[0] if ends[0] else None, depth[1] if ends[1] else None),
                )
                if k not in found or one.width_mm > found[k].width_mm:
                    found[k] = one
    return found


def _of_coverage(course: SeamCourse, coverage: Coverage) -> list[Finding]:
    if coverage.enough:
        return []
    unit = course.unit
    gaps = ", ".join(f"{a:.0f}{unit} to {b:.0f}{unit}" for a, b in coverage.gaps[:4]) + (
        " ..." if len(coverage.gaps) > 4 else ""
    )
    why = {"session": "the session asks for", "option": "--require-coverage asks for"}.get(
        coverage.required_by, "these views should have seen"
    )
    at = course.told(coverage.gaps[0][0] + course.bin_width / 2) if coverage.gaps else None
    text = f"{coverage.seen_deg:.0f}{unit} of the seam were seen, {why} {coverage.required_deg:.0f}{unit}"
    return [bar("coverage", f"{text}: nothing is known of {gaps}" if gaps else text, None, at)]


def _of_gaps(views: Sequence[PartView], counted: set[int]) -> list[Finding]:
    """A bar where nothing was read between places that were, over two stations or more, in bins that count as seen: a
    bin may hold several stations.
    """
    course = views[0].shot.seam.course
    read = [view.shot.sections["along"][np.isfinite(view.shot.sections["edge_step_mm"])] for view in views]
    places = np.unique(np.concatenate(read))
    station = max(view.shot.station_mm for view in views)
    ends = [*zip(places[:-1].tolist(), places[1:].tolist(), strict=True)]
    if course.turn is not None and len(places):
        ends.append((float(places[-1]), float(places[0]) + course.turn))
    longest: tuple[float, float] | None = None
    for start, end in ends:
        empty_mm = course.along_mm(course.at(end - start)) - station
        middle = course.told((start + end) / 2)
        at = int(course.bins_of(np.array([course.at(middle)]))[0])
        if empty_mm > GAP_STATIONS * station and at in counted and (longest is None or empty_mm > longest[0]):
            longest = empty_mm, middle
    if longest is None:
        return []
    text = f"over {longest[0]:.0f} mm of the seam the weld was not read, between places where it was"
    return [bar("coverage", text, None, longest[1])]


def _of_dark(views: Sequence[PartView], cells: Sequence[NDArray[np.uint32]], counted: set[int]) -> list[Finding]:
    """A bar where no view has points at the weld over a station's length, in bins that count as seen: a station takes
    what lies in half of it for the whole.
    """
    course = views[0].shot.seam.course
    per_bin = max(table.shape[1] for table in cells)
    lit = np.zeros((course.bins, per_bin))
    for table in cells:
        # Courses that differ in radius may have another number of cells.
        own = ((np.arange(per_bin) + 0.5) * table.shape[1] / per_bin).astype(int)
        lit = np.maximum(lit, (table[:, :, 1] / np.maximum(table[:, :, 0], 1))[:, own])
    dark = (np.isin(np.arange(course.bins), list(counted))[:, None] & (lit < DARK_PART)).ravel()
    cell_mm = course.along_mm(course.at(course.bin_width)) / per_bin
    run = max(2, round(min(view.shot.station_mm for view in views) / cell_mm))
    starts = np.all([np.roll(dark, -off) for off in range(run)], axis=0)
    if not starts.any():
        return []
    at = course.told(course.bin_width * ((float(np.argmax(starts)) + run / 2) / per_bin - 0.5))
    text = f"over {cell_mm * run:.0f} mm of the seam and more no point was measured at the weld"
    return [bar("coverage", text, None, at)]


def _of_fates(view: PartView, whole: NDArray[np.uint32], near: NDArray[np.uint32], judged: set[int]) -> list[Finding]:
    """Bars for one shot: points that no wall took, in the bins that are judged or should be."""
    findings, course = [], view.shot.seam.course
    # Where the points are too few for a station (a hole, the corner of a leaning view), nothing was to be recognised:
    # another view tells what is there, or it is a gap of the coverage.
    seen = view.shot.sections["seen"] != 0
    judged = judged & {k for k, stations in _stations_by_bin(view).items() if seen[stations].any()}
    of_seam = np.isin(np.arange(course.bins), list(judged))
    for table, where in ((near, "at the weld"), (whole, "of the view")):
        points, odd = table[:, POINTS].sum(axis=1), table[:, UNEXPLAINED].sum(axis=1)
        share = np.where(of_seam & (points >= LEAST_PIXELS), odd / np.maximum(points, 1), 0.0)
        if (share > UNEXPLAINED_PART).any():
            k = int(np.argmax(share))
            text = f"{odd[k]} of {points[k]} points {where} belong neither to a wall nor to the cap: what are they?"
            findings.append(bar("points-without-wall", text, view.name, course.bin_width * k))
            break
    return findings


def _of_lost(
    views: Sequence[PartView], near: Sequence[NDArray[np.uint32]], judged: set[int], expected: set[int]
) -> list[Finding]:
    """Bars where too many pixels at the weld were lost in every view, over two stations or more: saturated, for what is
    left is flanks, in bins that are judged; lost at all in those that should have been seen.
    """
    if not len(near):
        return []
    course = views[0].shot.seam.course
    of_seam, in_view = (np.isin(np.arange(course.bins), list(bins)) for bins in (judged, expected))
    stations = [view.shot.seam.course.reading_of_mm(view.shot.station_mm) for view in views]
    run = max(math.ceil(2 * station / course.bin_width) for station in stations)
    table = np.stack(near)
    total = table.sum(axis=2)
    lost = _lost(table)
    saturated = np.where(np.isfinite(lost), table[:, :, INDEX["saturated"]] / np.maximum(total, 1), np.inf)
    shares = {"saturated": saturated, "lost": lost}
    # By the view that shows a bin best; a view without pixels there says nothing.
    best = {name: share.min(axis=0) for name, share in shares.items()}
    findings = []
    flanks = "saturated: what is left is no sample of its surface; scan with a shorter exposure"
    rules = (
        ("saturated", "saturation", SATURATED_PART, of_seam, flanks),
        ("lost", "coverage", LOST_PART, in_view, "not measured"),
    )
    for name, code, part, bins, text in rules:
        share = np.where(bins & np.isfinite(best[name]), best[name], 0.0)
        ahead = ([course.beyond(k, off) for k in range(course.bins)] for off in range(run))
        lasting = np.min([[0.0 if k is None else share[k] for k in bins] for bins in ahead], axis=0)
        if lasting.max() > part:
            k = int(np.argmax(lasting))
            view = views[int(np.argmin(shares[name][:, k]))].name
            said = f"{100 * share[k]:.0f} % of the pixels at the weld were {text}"
            findings.append(bar(code, said, view, course.bin_width * k))
            break
    return findings
