"""The edges of all shots by bin: a shot overrules another only where it has read the same place, and a gap is one."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from weldscan import segment_weld
from weldscan.measure.seam_coverage import _of_gaps, edge_profile
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
