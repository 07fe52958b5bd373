"""Probed points against a surface whose formula is known."""

from __future__ import annotations

import numpy as np
import pytest

from conftest import shared
from weldscan import InputError, NotMeasured
from weldscan.report.validation import write_validation
from weldscan.result import BudgetLine, Label, PartCloud
from weldscan.verification import validation

RADIUS, NOISE_MM, PROBE_MM = 136.6, 0.03, 0.015
# Quadric through some 280 points with this noise: 0.03 * 3 / sqrt(280) is 0.005 mm; the sagitta of the patch that a
# quadric leaves is below 1e-4 mm.
SURFACE_MM = 0.012


def surface(angle_deg, axial_mm, radius_mm):
    theta = np.radians(angle_deg)
    return np.stack([900 + axial_mm, radius_mm * np.cos(theta), 300 + radius_mm * np.sin(theta)], axis=-1)


@pytest.fixture(scope="module")
def cloud():
    random = np.random.default_rng(4)
    angle, axial = np.meshgrid(np.arange(355, 365, 0.06), np.arange(-12, 12, 0.15))
    angle, axial = angle.ravel() % 360, axial.ravel()
    height = np.where(np.abs(axial) < 5, 2 * np.cos(axial / 5 * np.pi / 2), 0) + random.normal(0, NOISE_MM, angle.size)
    return PartCloud(
        points_mm=surface(angle, axial, RADIUS + height),
        label=np.full(angle.size, Label.REFERENCE_WALL, np.uint8),
        deviation_mm=height.astype(np.float32),
        angle_deg=angle.astype(np.float32),
        axial_mm=axial.astype(np.float32),
        shot=np.zeros(angle.size, np.uint8),
    )


@pytest.mark.parametrize("off", [0.0, 0.25, -0.4])
def test_a_probe_off_by_a_known_distance_is_found_off_by_it(cloud, off):
    angle = np.array([357.0, 358.5, 0.0, 1.0, 3.0, 2.0])
    axial = np.array([-8.0, 8.0, -9.0, 7.5, 8.0, -0.2])
    height = np.where(np.abs(axial) < 5, 2 * np.cos(axial / 5 * np.pi / 2), 0)
    found = validation.hold_against(surface(angle, axial, RADIUS + height + off), cloud)
    assert found.compared == 6
    assert np.abs(found.distance_mm - off).max() < SURFACE_MM
    assert found.mean_mm == pytest.approx(off, abs=SURFACE_MM) and found.max_abs_mm >= found.rms_mm
    assert np.abs((found.angle_deg - angle + 180) % 360 - 180).max() < 0.2
    assert np.abs(found.axial_mm - axial).max() < 0.2


def test_the_uncertainty_covers_a_probe_with_noise(cloud):
    random = np.random.default_rng(5)
    angle, axial = random.uniform(356, 364, 300) % 360, random.uniform(6.6, 10, 300)
    probed = surface(angle, axial, RADIUS) + random.normal(0, PROBE_MM, (300, 3))
    found = validation.hold_against(probed, cloud)
    covered = np.abs(found.distance_mm) <= found.u_mm
    assert covered.mean() > 0.95 and np.nanmedian(found.u_mm) < 5 * PROBE_MM
    shared = validation.hold_against(probed, cloud, (BudgetLine("pose", 0.05, "assumed"),))
    # What all points share stays in the mean.
    assert shared.mean_u_mm > 0.1 > found.mean_u_mm


def test_what_was_not_scanned_is_not_compared(cloud):
    probed = surface(
        np.array([1.0, 40.0, 1.0, 1.0]), np.array([8.0, 8.0, 11.9, 8.0]), np.array([136.6, 136.6, 136.6, 139.0])
    )
    found = validation.hold_against(probed, cloud)
    assert np.isfinite(found.distance_mm).tolist() == [True, False, False, False]
    with pytest.raises(NotMeasured, match="none of the 1 probed points"):
        validation.hold_against(probed[1:2], cloud)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "line 1: should read x_mm,y_mm,z_mm"),
        ("x,y,z\n1,2,3\n", "line 1: should read x_mm,y_mm,z_mm"),
        ("x_mm,y_mm,z_mm\n", "holds no points"),
        ("x_mm,y_mm,z_mm\n1,2,3\n1,2\n", "line 3: '1,2' is not three numbers"),
        ("x_mm,y_mm,z_mm\n1,2,nan\n", "line 2: '1,2,nan' is not three numbers"),
        ("x_mm,y_mm,z_mm\n1,2,inf\n", "line 2: '1,2,inf' is not three numbers"),
        ("x_mm,y_mm,z_mm\na,b,c\n", "line 2: 'a,b,c' is not three numbers"),
    ],
)
def test_a_wrong_touch_file_is_named(tmp_path, text, says):
    path = tmp_path / "touch.csv"
    path.write_text(text)
    with pytest.raises(InputError) as error:
        validation.read_touch(path)
    assert str(error.value) == f"{path}: {says}"


def test_the_files_are_written_as_a_whole(cloud, tmp_path):
    probed = surface(np.array([1.0, 40.0, 358.0]), np.array([8.0, 8.0, -7.0]), RADIUS + np.array([0.1, 0, -0.2]))
    found = validation.hold_against(probed, cloud, session="a <b>", touch="touch.csv")
    write_validation(found, tmp_path / "out")
    write_validation(found, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["validation.html", "validation.json"]
    page = (tmp_path / "out" / "validation.html").read_text()
    assert "a &lt;b&gt;" in page and "2 of 3" in page


# What the project promises against the probe (the paper found 0.115 mm).
PROMISED_RMS_MM = 0.06


@pytest.mark.parametrize("name", ["open-630", "open-273"])
def test_scans_of_an_independent_renderer_agree_with_its_probe(name):
    folder = shared(f"sessions/{name}")
    found = validation.validate(folder, folder / "touch.csv")
    good = np.isfinite(found.distance_mm)
    assert found.compared >= 0.9 * len(found.points_mm) and found.rms_mm <= PROMISED_RMS_MM
    assert (np.abs(found.distance_mm[good]) <= found.u_mm[good]).mean() >= 0.9
    assert abs(found.mean_mm) <= found.mean_u_mm
