"""A real weld bead on plates, as a public scan has it: no truth, but what a bead is, and that stations repeat."""

from __future__ import annotations

import numpy as np
import pytest

from conftest import shared
from weldscan import segment_weld


def scan_lines() -> np.ndarray:
    """The scan as rows of its lines, seen from above: z away from the scanner, the seam nearly along x."""
    raw = shared("real/weld_bead/flat_seam_2_seg_1.pcd").read_bytes()
    begin = raw.index(b"\n", raw.index(b"DATA")) + 1
    fields = np.dtype([("xyz", "<f4", 3), ("_", "u1", 4)])
    points = np.frombuffer(raw[begin:], fields)["xyz"].astype(float)
    lines = np.split(points, np.flatnonzero(np.abs(np.diff(points[:, 0])) > 0.3) + 1)
    _, _, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    grid = np.full((len(lines), max(map(len, lines)), 3), np.nan)
    for row, line in zip(grid, lines, strict=True):
        row[: len(line)] = (line - points.mean(axis=0)) @ axes.T + [0, 0, 400]
    return grid


@pytest.mark.parametrize("radius_mm", [1e4, 1e5])
def test_a_real_bead_has_two_toes_and_repeats(radius_mm):
    shot = segment_weld(scan_lines(), radius_mm, 6.0, [0.13, 1, 0], [0, 0, -1])
    found = shot.sections
    seen = found["seen"] != 0
    toes = found["toes_mm"][seen]
    # Every station that shows both sides; the others are the corners of the scan.
    assert seen.sum() >= 24 and np.isfinite(toes).all() and np.isfinite(found["edge_step_mm"][seen]).all()
    width, height = np.diff(toes, axis=1)[:, 0], found["height_mm"][seen]
    assert 12 < np.median(width) < 13.5 and 1.8 <= np.median(height) <= 2.0
    for values, repeats in ((width, 0.4), (height, 0.1)):
        assert 1.4826 * np.median(np.abs(np.diff(values))) / np.sqrt(2) < repeats
    # The plates stand at an angle and are warped: what is known of the step by eye is no more than this.
    low, middle, high = np.percentile(found["edge_step_mm"][seen], [10, 50, 90])
    assert -0.3 < low < middle < high < 0.3
