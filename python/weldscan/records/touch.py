"""Points that a contact probe read on the part: `touch.csv`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from weldscan.errors import InputError
from weldscan.records.files import read_text

HEADER = "x_mm,y_mm,z_mm"


def read_touch(path: Path) -> NDArray[np.float64]:
    """The probed points of a `touch.csv`, (n, 3), mm, base.

    Raises:
        InputError: names file and line.
    """
    lines = read_text(path).splitlines()
    if not lines or lines[0].replace(" ", "") != HEADER:
        raise InputError(f"{path}: line 1: should read {HEADER}")
    points = []
    for number, line in enumerate(lines[1:], 2):
        if not line.strip():
            continue
        try:
            point = [float(cell) for cell in line.split(",")]
        except ValueError:
            raise InputError(f"{path}: line {number}: {line[:60]!r} is not three numbers") from None
        if len(point) != 3 or not all(abs(value) <= 1e9 for value in point):
            raise InputError(f"{path}: line {number}: {line[:60]!r} is not three numbers")
        points.append(point)
    if not points:
        raise InputError(f"{path}: holds no points")
    return np.array(points)
