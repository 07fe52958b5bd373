"""The edges of all shots by bin: a shot overrules another only where it has read the same place, and a gap is one."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from weldscan import segment_weld
from weldscan.measure.seam_coverage import _of_dark, _of_gaps, edge_profile
from weldscan.simulated import scenes


@cache
def segmented():
    """A wide pipe: a bin of 2 degrees holds several stations."""
    scene = next(s for s in (scenes.draw("plain", k) for k in range(40)) if s.welds[0].radius_mm > 350)
    seen, base = next(scenes.views(scene)), np.asarray(scene.base_from_weld)
    (weld, *_), turn = scene.welds, seen.base_from_flange[:3, :3].T
    axes = list(turn @ base[:3, 2]), list(turn @ base[:3, 0])
    return segment_weld(seen.points_mm, weld.radius_mm, weld.thickness_mm, *axes)


def view(step, u):
    """A view of the pipe whose stations read this step with this U."""
    shot = segmented()
    sections = shot.sections | {
        "edge_step_mm": np.asarray(step, float),
        "edge_standard_mm": np.zeros(len(step)),
        "edge_hull_mm": np.broadcast_to(u, len(step)).astype(float),
        "departure_mm": np.zeros((len(step), 2)),
        "local_step_mm": np.zeros(len(step)),
    }
    return SimpleNamespace(shot=SimpleNamespace(seam=shot.seam, sections=sections, station_mm=shot.station_mm))


def test_a_shot_that_saw_less_of_a_bin_does_not_overrule_the_one_that_saw_the_defect():
    shot, count = segmented(), len(segmented().sections["along"])
    course, along = shot.seam.course, shot.sections["along"]
    assert course.bin_width > 2.5 * course.reading_of_mm(shot.station_mm)
    bins = course.bins_of(np.array([course.at(a) for a in along.tolist()]))
    # A bin in the middle of the view: its last two stations have the defect, the first the other shot's end.
    k = int(bins[count // 2])
    inside = np.flatnonzero(bins == k)
    defect = inside[-2:]
    whole = np.full(count, 0.2)
    whole[defect] = 1.2
    ended = np.full(count, 0.2)
    ended[defect[0] :] = np.nan
    better, other = view(ended, 0.01), view(whole, 0.1)
    for views in ([better, other], [other, better]):
        found = edge_profile(views)
        assert found.step_mm[k] == 1.2 and found.confirmed_mm == pytest.approx(1.1)
    # Where the better shot has read the same place, it is the one to believe.
    alike = edge_profile([view(np.full(count, 0.2), 0.01), other])
    assert alike.step_mm[k] == 0.2 and alike.u_mm[k] == pytest.approx(0.01)


def test_a_run_of_stations_that_nobody_read_is_a_gap():
    shot = segmented()
    along = shot.sections["along"]
    read = np.full(len(along), 0.2)
    middle = len(read) // 2
    course = shot.seam.course
    inside = {int(b) for b in course.bins_of(np.array([course.at(a) for a in along.tolist()])).tolist()}
    assert _of_gaps([view(read, 0.01)], inside - {max(inside), min(inside)}) == []
    one, three = read.copy(), read.copy()
    one[middle], three[middle - 1 : middle + 2] = np.nan, np.nan
    assert _of_gaps([view(one, 0.01)], inside - {max(inside), min(inside)}) == []
    (gap,) = _of_gaps([view(three, 0.01)], inside)
    assert gap.code == "coverage" and abs(course.apart(np.array([gap.at_deg]), along[middle])[0]) < course.bin_width
    # Another shot that read there closes it; and what no view should have seen is none.
    assert _of_gaps([view(three, 0.01), view(read, 0.01)], inside - {max(inside), min(inside)}) == []
    assert _of_gaps([view(three, 0.01)], set()) == []


def pipe(over_mm):
    """A pipe of 200 mm with a seam, seen from outside over 50 degrees, with what lies on the other wall."""
    around, across = np.meshgrid(np.radians(np.arange(-25, 25, 0.3)), np.arange(-40, 40, 0.4), indexing="ij")
    height = np.where(np.abs(across) < 4, 1.2 * (1 - (across / 4) ** 2), 0.0)
    height = height + np.where(across > 4, over_mm(100 * around, across), 0.0)
    height += np.random.default_rng(4).normal(0, 0.005, height.shape)
    radius = 100 + height
    points = np.stack([radius * np.cos(around), radius * np.sin(around), across], axis=2)
    # The scanner looks along its z, the pipe's axis is its x.
    return points @ np.array([[0, 0, -1.0], [0, 1, 0], [1, 0, 0]]) + [0, 0, 500.0]


def edges(over_mm):
    shot = segment_weld(pipe(over_mm), 100.0, 3.0, [1.0, 0, 0], [0, 0, -1.0])
    assert len(shot.sections["along"]) > 15
    found = edge_profile([SimpleNamespace(shot=shot)])
    return shot, found


def test_a_step_as_short_as_a_station_is_read_and_spatter_is_not():
    # 8 mm long, wherever the stations begin.
    for middle in np.arange(0.0, 4.0, 0.5):
        dent, found = edges(lambda s, z, at=middle: -0.5 * (np.abs(s - at) < 4) * np.exp(-(z - 4) / 15))
        assert found.worst is not None
        assert abs(float(found.step_mm[found.worst])) > 0.35, middle
        assert np.nanmin(dent.sections["local_step_mm"]) <= 0
    # Metal that lies on the wall beside the toe: 3 mm wide, as high.
    for middle in (0.0, 1.0, 2.0, 3.0):
        drop, found = edges(lambda s, z, at=middle: 0.5 * (np.hypot(s - at, z - 6.5) < 1.5))
        assert found.worst is not None
        assert abs(float(found.step_mm[found.worst])) < 0.15, middle
        assert np.nanmax(np.abs(drop.sections["local_step_mm"])) == 0


def test_a_dark_stretch_shorter_than_a_bin_is_a_gap():
    shot = segmented()
    course = shot.seam.course
    views = [view(np.full(len(shot.sections["along"]), 0.2), 0.01)]
    k = int(course.bins_of(np.array([course.at(float(np.median(shot.sections["along"])))]))[0])
    counted = {k - 1, k, k + 1}
    per_bin = round(course.along_mm(course.at(course.bin_width)) / (shot.station_mm / 2))
    assert per_bin > 4
    cells = np.full((course.bins, per_bin, 2), 100, np.uint32)
    assert _of_dark(views, [cells], counted) == []
    one, two = cells.copy(), cells.copy()
    one[k, 1, 1] = two[k, 1:3, 1] = 2
    assert _of_dark(views, [one], counted) == []
    (gap,) = _of_dark(views, [two], counted)
    assert gap.code == "coverage"
    assert gap.at_deg == pytest.approx(course.told(course.bin_width * (k - 0.5 + 2 / per_bin)))
    # Over the border of two bins; another view that saw it; a bin that does not count.
    border = cells.copy()
    border[k, -1, 1] = border[k + 1, 0, 1] = 0
    assert len(_of_dark(views, [border], counted)) == 1
    assert _of_dark(views * 2, [two, cells], counted) == []
    assert _of_dark(views, [two], {k - 1}) == []
