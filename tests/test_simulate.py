"""The simulator against closed forms: OpenCV's projection, formulas in NumPy, the statistics of its noise."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from weldscan import Lens, Scanner
from weldscan.devices.simulated import (
    DEFAULT,
    Cell,
    Photometry,
    pipe,
    render,
)

# Rays are solved to 1e-8 mm and pixels pass through a lens solved to 1e-12: what is left is rounding.
POINT_MM = 1e-6
PIXEL = 1e-6
SHOW = [("x", 8, 4)]
QUIET = Photometry(full_well_e=1e12, read_noise_e=0.0, bits=16)


def small_scanner(scale: int = 4) -> Scanner:
    """The default scanner with fewer, larger camera pixels."""
    big = DEFAULT.scanner.camera
    k = big.K / scale
    k[2, 2] = 1.0
    camera = Lens(big.width // scale, big.height // scale, k, big.dist)
    return Scanner(camera, DEFAULT.scanner.projector, DEFAULT.scanner.camera_from_projector)


def small(**changes: object) -> Cell:
    return replace(DEFAULT, scanner=small_scanner(), **changes)  # type: ignore[arg-type]


def project(lens: Lens, device_from_points: np.ndarray, points: np.ndarray) -> np.ndarray:
    rvec = cv2.Rodrigues(device_from_points[:3, :3])[0]
    return cv2.projectPoints(points, rvec, device_from_points[:3, 3], lens.K, np.array(lens.dist))[0][:, 0]


@pytest.fixture(scope="module")
def part() -> tuple[Cell, np.ndarray, object]:
    cell = small(weld=pipe(273.0, offset_mm=0.6, offset_at_deg=185.0, tilt_deg=0.2, ovality_mm=0.1, waviness_mm=0.01))
    view = cell.part_views()[0]
    return cell, view, render(cell, "part", view)


def test_points_project_onto_their_pixels_and_columns(part):
    cell, _, shot = part
    seen = shot.labels > 0
    pixels = project(cell.scanner.camera, np.eye(4), shot.points_mm[seen])
    v, u = np.nonzero(seen)
    assert np.abs(pixels - np.column_stack([u, v])).max() < PIXEL
    lit = np.isfinite(shot.column_px)
    assert 0.5 < lit.mean() < 1.0
    light = project(cell.scanner.projector, np.linalg.inv(cell.scanner.camera_from_projector), shot.points_mm[lit])
    assert np.abs(light - np.column_stack([shot.column_px[lit], shot.row_px[lit]])).max() < PIXEL
