"""What a comparison with probed points found, `weldscan-validation/1`: `validation.json`."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from weldscan._weldcore import __version__
from weldscan.records.files import is_earlier
from weldscan.result import Validation

SCHEMA = "weldscan-validation/1"
FILES = ("validation.json", "validation.html")


def is_validation(folder: Path) -> bool:
    """Whether a folder is an earlier comparison and holds nothing else."""
    return is_earlier(folder, FILES, FILES[0], SCHEMA)


def validation_document(found: Validation, created: datetime) -> dict[str, Any]:
    """`weldscan-validation/1`."""
    return {
        "schema": SCHEMA,
        "created": created.isoformat(timespec="seconds"),
        "session": found.session,
        "touch": found.touch,
        "points": len(found.points_mm),
        "compared": found.compared,
        "mean_mm": found.mean_mm,
        "mean_u_mm": found.mean_u_mm,
        "rms_mm": found.rms_mm,
        "max_abs_mm": found.max_abs_mm,
        "per_point": [
            {"point_mm": row[:3], "angle_deg": row[3], "axial_mm": row[4], "distance_mm": row[5], "u_mm": row[6]}
            for row in validation_rows(found)
        ],
        "uncertainty_budget": found.budget,
        "software": {"version": __version__, **found.software},
    }


def validation_rows(found: Validation) -> list[list[float]]:
    """Per probed point x, y, z, its angle, its place along the axis, its distance and that one's uncertainty."""
    rows: list[list[float]] = np.column_stack(
        [found.points_mm, found.angle_deg, found.axial_mm, found.distance_mm, found.u_mm]
    ).tolist()
    return rows
