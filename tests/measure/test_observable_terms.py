"""What a scan determines of two pipes: each term with its U, or named as not observable."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

from weldscan.measure.observable_terms import ANGLE_PRIOR_DEG, DIAMETER_PRIOR, OFFSET_PRIOR, seam_terms

STEP = {
    "radius_difference_mm": (0.2, 0.01),
    "axis_offset_mm": [-0.3, 0.4],
    "axis_offset_standard_mm": 0.05,
    "tilt_rad": math.radians(0.1),
    "tilt_standard_rad": math.radians(0.02),
    "waves_mm": [],
}


def test_what_is_determined_has_its_uncertainty():
    found = seam_terms(SimpleNamespace(**STEP), 630.0, 6.0)
    assert found.not_observable == ()
    assert found.harmonics_mm == pytest.approx(
        {
            "diameter_difference": 0.4,
            "diameter_difference_u": 0.04,
            "axis_offset": 0.5,
            "axis_offset_u": 0.1,
            "axis_offset_at_deg": math.degrees(math.atan2(0.4, -0.3)),
        }
    )
    assert (found.angle_deg, found.angle_u_deg) == pytest.approx((0.1, 0.04))


def test_what_once_stood_under_a_green_pass_is_not_observable():
    # -58.8 +- 136.8 mm of diameter and 29.7 mm of offset, of a short arc.
    arc = {"radius_difference_mm": (-29.4, 34.2), "axis_offset_mm": [29.7, 0.0], "tilt_rad": 0.0}
    unstated = {"axis_offset_standard_mm": math.nan, "tilt_standard_rad": math.inf, "waves_mm": []}
    found = seam_terms(SimpleNamespace(**arc, **unstated), 630.0, 6.0)
    assert found.harmonics_mm == {} and found.angle_deg is found.angle_u_deg is None
    assert found.not_observable == ("diameter_difference", "axis_offset", "angle_between_walls")


@pytest.mark.parametrize(
    ("field", "name", "at_most"),
    [
        # Standard uncertainties at which U is half the prior.
        ("radius_difference_mm", "diameter_difference", DIAMETER_PRIOR * 630.0 / 8),
        ("axis_offset_standard_mm", "axis_offset", OFFSET_PRIOR * 6.0 / 4),
        ("tilt_standard_rad", "angle_between_walls", math.radians(ANGLE_PRIOR_DEG) / 4),
    ],
)
def test_half_of_what_pipes_differ_by_is_the_bound(field, name, at_most):
    def missing(standard: float | None) -> tuple[str, ...]:
        value = (0.2, standard) if field == "radius_difference_mm" else standard
        return seam_terms(SimpleNamespace(**{**STEP, field: value}), 630.0, 6.0).not_observable

    assert missing(0.0) == missing(0.999 * at_most) == ()
    assert missing(1.001 * at_most) == missing(math.inf) == missing(math.nan) == (name,)


def test_waves_around_the_seam_are_a_cosine_and_a_sine_where_the_scan_tells_them():
    waves = [
        (2, 0.3, -0.2, 0.004, 0.004, 0.5),
        # Not told on an arc.
        (3, 0.01, 0.01, 0.2, 0.2, 0.22),
        # Told, and nothing.
        (4, 0.001, 0.0, 0.003, 0.003, 0.12),
        (7, 0.05, 0.0, 0.003, 0.003, 0.04),
        (8, 0.001, 0.0, 0.003, 0.003, 0.03),
    ]
    found = seam_terms(SimpleNamespace(**{**STEP, "waves_mm": waves}), 219.1, 8.0)
    told = {name: value for name, value in found.harmonics_mm.items() if name.startswith("n")}
    assert set(told) == {f"n{n}_{part}{u}" for n in (2, 4, 7) for part in ("cos", "sin") for u in ("", "_u")}
    assert (told["n2_cos"], told["n2_sin"], told["n2_sin_u"]) == (0.3, -0.2, 0.008)
    assert found.not_observable == ("n3",)
