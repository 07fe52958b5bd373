"""Acceptance of a scanner: closed forms of PF, PS, SD and F, the verdicts, the history, and whole sessions."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import shared
from small_cell import small_scanner
from synthetic import made_up
from weldscan import GeometryError, InputError, Verdict, inspect
from weldscan._weldcore import sphere_caps
from weldscan.measure.scanner_standing import scanner_id, standing_of
from weldscan.records.history import append_history, check_history, read_history
from weldscan.records.session import read_session
from weldscan.simulated import DEFAULT, simulate_session
from weldscan.verification import (
    VerificationLimits,
    flatness_error,
    judge_characteristic,
    noise_range,
    places,
    probing_error,
    read_limits,
    verify,
)
from weldscan.verification.history import slope, with_drift

# Sums of some thousand coordinates of 500 mm in double precision.
ROUNDING_MM = 1e-9
CENTRE = np.array([12.0, -7.0, 430.0])


# --- closed forms -----------------------------------------------------------------------------------------------------


def directions(n: int) -> np.ndarray:
    """n pairs of opposite directions."""
    d = np.random.default_rng(5).normal(size=(n, 3))
    d /= np.linalg.norm(d, axis=1)[:, None]
    return np.concatenate([d, -d])


@pytest.mark.parametrize("ripple", [0.0, 0.001, 0.05])
def test_ripples_on_a_sphere_are_its_form_error(ripple):
    # The ripple is the same at opposite points and cancels over the sphere: no other sphere fits better.
    d = directions(2000)
    sign = np.where(np.arange(2000) % 2 == 0, 1.0, -1.0)
    radius = 10.0 + ripple * np.concatenate([sign, sign])
    found = probing_error(CENTRE + radius[:, None] * d, 20.0)
    assert found.form_mm == pytest.approx(2 * ripple, abs=ROUNDING_MM)
    assert found.size_mm == pytest.approx(0.0, abs=ROUNDING_MM)
    assert found.rms_mm == pytest.approx(ripple, abs=ROUNDING_MM) and found.points == 4000 and found.wild == 0


@pytest.mark.parametrize("off", [-0.3, 0.02, 1.0])
def test_a_sphere_of_another_diameter_is_its_size_error(off):
    cap = directions(4000)
    cap = cap[cap @ -CENTRE / np.linalg.norm(CENTRE) > 0.5]
    found = probing_error(CENTRE + (20.0 + off) / 2 * cap, 20.0)
    assert found.size_mm == pytest.approx(off, abs=1e-8) and found.form_mm < 1e-8


def test_points_far_off_count_in_the_range_and_do_not_pull_the_sphere():
    cap = directions(4000)
    cap = cap[cap @ -CENTRE / np.linalg.norm(CENTRE) > 0.5]
    points = CENTRE + 10.0 * cap
    points[17] += 160.0 * cap[17]
    found = probing_error(points, 20.0)
    assert found.wild == 1 and found.form_mm == pytest.approx(160.0) and abs(found.size_mm) < 1e-8
    without = probing_error(points, 20.0, share=0.997)
    assert without.form_mm < 1e-8 and without.form_all_mm == pytest.approx(160.0)
    assert without.points == len(points) - math.floor(0.003 * len(points))


@pytest.mark.parametrize("wave", [0.0, 0.004, 0.3])
def test_waves_on_a_plane_are_its_flatness_error(wave):
    x, y = (g.ravel() for g in np.meshgrid(np.arange(-60.0, 61.0), np.arange(-40.0, 41.0)))
    z = wave * np.cos(np.pi * x)
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    found = flatness_error(np.stack([x, y, z], axis=1) @ turn.T + CENTRE)
    assert found.form_mm == pytest.approx(2 * wave, abs=ROUNDING_MM) and found.size_mm is None


@pytest.mark.parametrize("n", [100, 1000, 10_000])
def test_the_range_of_noise_grows_with_the_number_of_points(n):
    """Monte Carlo: Blom's formula says how wide normal noise is over n points, over 99.7 % and 95 % of them too."""
    random = np.random.default_rng(n)
    noise = random.normal(size=(400, n))
    assert np.ptp(noise, axis=1).mean() == pytest.approx(noise_range(n), rel=0.015)
    for share in (0.997, 0.95):
        kept = np.sort(np.abs(noise), axis=1)[:, : n - math.floor((1 - share) * n)]
        if n * (1 - share) > 3:
            assert 2 * kept[:, -1].mean() == pytest.approx(noise_range(n, share), rel=0.05)


def test_the_form_error_of_a_noisy_cap_is_that_of_its_noise():
    sigma, values = 0.02, []
    for seed in range(20):
        random = np.random.default_rng(seed)
        cap = random.normal(size=(40_000, 3))
        cap /= np.linalg.norm(cap, axis=1)[:, None]
        cap = cap[cap[:, 2] < -0.5][:5000]
        found = probing_error(CENTRE + (10 + random.normal(0, sigma, len(cap)))[:, None] * cap, 20.0)
        values.append(found.form_mm)
        assert found.form_mm > found.form_997_mm > found.form_95_mm
        # u(R) of a cap of a quarter of the sphere, five sigma (METHOD, "Spheres").
        assert abs(found.size_mm) < 5 * 2 * sigma / math.sqrt(len(cap)) * math.sqrt(1 + 3 * 3**2)
    assert np.mean(values) == pytest.approx(sigma * noise_range(5000), rel=0.05)


@pytest.mark.parametrize(
    ("points", "share", "says"),
    [
        (np.zeros((3, 3)), 1.0, "n >= 5"),
        (np.full((9, 3), np.nan), 1.0, "NaN"),
        (np.random.default_rng(1).normal(size=(50, 3)), 0.5, "share"),
        (np.zeros((50, 2)), 1.0, "shape"),
    ],
)
def test_points_that_cannot_be_evaluated(points, share, says):
    for evaluate in (lambda: probing_error(points, 20.0, share), lambda: flatness_error(points, share)):
        with pytest.raises(InputError, match=says):
            evaluate()


def test_points_that_are_no_surface():
    with pytest.raises(GeometryError):
        probing_error(np.tile([1.0, 2.0, 3.0], (20, 1)), 20.0)
    with pytest.raises(InputError, match="diameter_mm"):
        probing_error(directions(20), math.nan)


def test_the_same_place_counts_once():
    at = [np.array([[0.0, 0, 400]]), np.array([[9.0, 0, 400]]), np.array([[11.0, 0, 400]]), np.array([[0.0, 0, 400]])]
    assert places(at, 10.0) == 2 and places([], 10.0) == 0


def test_the_pixels_that_see_a_cap():
    lens = small_scanner(2).camera
    middle = np.array([0.0, 0.0, 400.0])
    # Behind the first one, and half of it beyond the left edge of the image.
    behind = np.array([10.0, 0.0, 460.0])
    edge = np.array([(-0.5 - lens.K[0, 2]) / lens.K[0, 0] * 400, 0.0, 400.0])
    (whole, hidden, cut) = sphere_caps(lens, np.array([middle, behind, edge]), 10.0)
    pixels, outward, all_of_it = whole
    assert len(pixels) == all_of_it and np.all(np.diff(pixels) > 0)
    # Orthographic area of the cap: pi (R sin 60)^2, in pixels of z/f; seen in perspective a little more.
    assert all_of_it == pytest.approx(math.pi * (8.66 * lens.K[0, 0] / 400) ** 2, rel=0.05)
    assert np.linalg.norm(outward, axis=1) == pytest.approx(1.0) and outward[:, 2].max() <= -0.5 + 1e-9
    assert 0.3 < len(hidden[0]) / hidden[2] < 0.7 and not set(hidden[0]) & set(pixels)
    assert 0.4 < len(cut[0]) / cut[2] < 0.6


# --- the verdict ------------------------------------------------------------------------------------------------------

LIMITS = VerificationLimits(pf_mm=0.1, ps_mm=0.1, sd_mm=0.1, f_mm=0.1)


@given(
    values=st.lists(st.floats(-1, 1) | st.just(math.nan) | st.just(math.inf), max_size=20),
    positions=st.integers(0, 20),
    u=st.floats(0, 0.2) | st.just(math.nan),
    lost=st.lists(st.just("shot: gone"), max_size=1),
    decision=st.sampled_from(["guarded", "simple"]),
    limit=st.none() | st.floats(0.001, 1),
)
def test_nothing_passes_that_was_not_measured(values, positions, u, lost, decision, limit):
    limits = VerificationLimits(sd_mm=limit, decision=decision)
    found = judge_characteristic("SD", values, ["here"] * len(values), limits, u_mm=u, positions=positions, lost=lost)
    if found.verdict is Verdict.PASS:
        assert limit is not None and values and all(math.isfinite(v) for v in values)
        assert not lost and positions >= 7
        guard = u if decision == "guarded" else 0.0
        assert max(map(abs, values)) + guard <= limit * (1 + 1e-12)
    if found.verdict is Verdict.FAIL:
        assert limit is not None and any(abs(v) > limit for v in values)


@pytest.mark.parametrize(
    ("value", "verdict"),
    [
        (0.08, "PASS"),
        (-0.08, "PASS"),
        (0.095, "INCONCLUSIVE"),
        (-0.105, "INCONCLUSIVE"),
        (0.12, "FAIL"),
        (-0.2, "FAIL"),
    ],
)
def test_the_guard_band(value, verdict):
    found = judge_characteristic("PS", [0.0, value], ["a", "b"], LIMITS, u_mm=0.01, positions=10)
    assert found.verdict == verdict and found.where == "b" and found.value_mm == value


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("pf_um = 100", "pf_um: unknown; limits are in mm"),
        ("PF_mm = 0.1", "PF_mm: unknown; limits are in mm"),
        ("pf_mm = 100", "pf_mm: 100 mm is no scanner's limit: are these micrometres?"),
        ("pf_mm = -0.1", "pf_mm: should be greater than 0"),
        ("pf_mm = 0", "pf_mm: should be greater than 0"),
        ("pf_mm = nan", "pf_mm: "),
        ("pf_mm = inf", "pf_mm: "),
        ('pf_mm = "0.1 mm"', "pf_mm: "),
        ("pf_mm = true", "pf_mm: "),
        ("verification = 3", "verification: should be an object"),
        ("share = 0.5", "share: should be greater than or equal to 0.95"),
        ("validity_days = -3", "validity_days: should be greater than 0"),
        ("[positions]\nsd = 0", "positions.sd: should be greater than or equal to 1"),
        ('[robot]\nlink = "kvp"', "verification: missing"),
        ("[verification]\npf = 1", "verification: pf: unknown"),
        ("pf_mm = ", "not TOML"),
    ],
)
def test_wrong_limits_are_named(tmp_path, text, says):
    path = tmp_path / "limits.toml"
    path.write_text(text)
    with pytest.raises(InputError) as wrong:
        read_limits(path)
    assert says in str(wrong.value) and str(path) in str(wrong.value) and "\n" not in str(wrong.value)


def test_limits_of_a_cell(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text('name = "cell 3"\n[robot]\nlink = "kvp"\n[verification]\npf_mm = 0.2\nhistory = "v.jsonl"\n')
    limits = read_limits(path)
    assert limits.pf_mm == 0.2 and limits.history == str(tmp_path / "v.jsonl") and limits.sd_mm is None
    from weldscan.station.cell import read_cell

    assert read_cell(path).verification == {"pf_mm": 0.2, "history": "v.jsonl"}
    with pytest.raises(InputError, match="no such file"):
        read_limits(tmp_path / "none.toml")


# --- the history ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def three_lines(tmp_path_factory):
    path = tmp_path_factory.mktemp("history") / "verification.jsonl"
    for day in (-200, -100, -10):
        append_history(path, made_up(day=day))
    return path.read_bytes()


def written(folder: Path, data: bytes) -> Path:
    path = folder / "verification.jsonl"
    path.write_bytes(data)
    return path


def test_a_history_is_read_as_it_was_written(tmp_path, three_lines):
    history = read_history(written(tmp_path, three_lines))
    assert [record.session for record in history.records] == ["day -200", "day -100", "day -10"]
    assert history.broken is None and history.notes == () and history.records[0].prev is None
    assert history.records[2].prev == history.records[1].id and len({record.id for record in history.records}) == 3


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_a_torn_last_line_costs_that_line_alone(tmp_path_factory, three_lines, data):
    cut = data.draw(st.integers(0, len(three_lines)))
    path = written(tmp_path_factory.mktemp("torn"), three_lines[:cut])
    history = read_history(path)
    ends = np.cumsum([len(line) for line in three_lines.splitlines(keepends=True)])
    # A line without its line break is whole.
    whole = int(np.sum(cut >= ends - 1))
    assert len(history.records) == whole and history.broken is None
    assert bool(history.notes) == (cut not in {0, *ends, *(ends - 1)})
    append_history(path, made_up(day=-1))
    again = read_history(path)
    assert len(again.records) == whole + 1 and again.broken is None and again.records[-1].session == "day -1"
    assert path.read_bytes().startswith(three_lines[:cut])


@settings(max_examples=150, deadline=None)
@given(at=st.integers(0), byte=st.integers(0, 255))
def test_a_changed_byte_shows(tmp_path_factory, three_lines, at, byte):
    data = bytearray(three_lines)
    at %= len(data)
    if data[at] == byte:
        return
    data[at] = byte
    path = written(tmp_path_factory.mktemp("changed"), bytes(data))
    try:
        history = read_history(path)
    except InputError:
        return
    # Never are three lines read as if nothing had happened; white space alone is no part of what was found.
    same = [r.model_dump() for r in history.records] == [
        r.model_dump() for r in read_history(written(tmp_path_factory.mktemp("same"), three_lines)).records
    ]
    assert history.broken is not None or history.notes or same


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        ([0, 2], "line 2 does not follow"),
        ([1, 2], "line 1 does not follow"),
        ([1, 0, 2], "does not follow"),
        ([0, 1, 1, 2], "line 3 does not follow"),
    ],
)
def test_missing_and_moved_lines_show(tmp_path, three_lines, lines, says):
    all_lines = three_lines.splitlines(keepends=True)
    history = read_history(written(tmp_path, b"".join(all_lines[i] for i in lines)))
    assert history.broken is not None and says in history.broken


def test_a_damaged_last_line_is_not_passed_over(tmp_path, three_lines):
    lines = three_lines.splitlines(keepends=True)
    history = read_history(written(tmp_path, lines[0] + lines[1] + b"{garbled}\n"))
    assert len(history.records) == 2 and history.broken is not None and "line 3" in history.broken
    # Once something follows that knows the line before, it is only said.
    append_history(history.path, made_up(day=-1))
    assert read_history(history.path).broken is None and "line 3 is damaged" in read_history(history.path).notes[0]


@settings(max_examples=100, deadline=None)
@given(data=st.binary(max_size=400))
def test_whatever_is_in_the_file_nothing_breaks(tmp_path_factory, data):
    path = written(tmp_path_factory.mktemp("any"), data)
    try:
        history = read_history(path)
    except InputError as error:
        assert str(path) in str(error) and "\n" not in str(error)
    else:
        assert history.records == ()


def test_many_at_once_lose_no_line(tmp_path):
    path = tmp_path / "verification.jsonl"
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda day: append_history(path, made_up(day=-day)), range(40)))
    history = read_history(path)
    assert len(history.records) == 40 and history.broken is None


def test_a_history_that_cannot_be_written(tmp_path):
    for path, says in (
        (tmp_path / "no" / "where.jsonl", "is not a folder"),
        (tmp_path, "is not a file"),
        (written(tmp_path, b"x,y\n1,2\n"), "no history of verifications"),
        (Path("/dev/full"), "is not a file"),
    ):
        with pytest.raises(InputError, match=says):
            check_history(path)
    with pytest.raises(InputError, match="no such history"):
        read_history(tmp_path / "none.jsonl")
    assert check_history(tmp_path / "none.jsonl").records == () and not (tmp_path / "none.jsonl").exists()


def test_drift_is_the_slope_with_its_students_interval():
    t = np.array([0.0, 0.3, 0.7, 1.0, 1.6])
    y = np.array([0.010, 0.013, 0.012, 0.017, 0.019])
    rate, u, text = slope(t, y)
    # Textbook: SE = s / sqrt(Sxx), t(3) = 3.182.
    fit, (covariance,) = np.polyfit(t, y, 1), [np.polyfit(t, y, 1, cov=True)[1]]
    assert rate == pytest.approx(fit[0]) and u == pytest.approx(3.182 * math.sqrt(covariance[0, 0]), rel=1e-6)
    assert "a drift" in text and "no drift" not in text
    assert slope(t, [0.01, 0.02, 0.0, 0.02, 0.01])[2].endswith("no drift can be told")
    assert slope(t[:2], y[:2])[0] is None and slope([1.0, 1.0, 1.0], y[:3])[0] is None


def test_the_interval_of_a_drift_holds_what_it_says():
    random, t = np.random.default_rng(8), np.linspace(0, 2, 6)
    inside = 0
    for _ in range(2000):
        rate, u, _ = slope(t, 0.01 * t + random.normal(0, 0.003, 6))
        inside += abs(rate - 0.01) <= u
    # Five sigma of 2000 draws.
    assert abs(inside / 2000 - 0.95) < 5 * math.sqrt(0.95 * 0.05 / 2000)


def test_a_session_evaluated_again_counts_once(tmp_path):
    path = tmp_path / "verification.jsonl"
    for day in (-300, -200, -200, -200, 0):
        append_history(path, made_up(day=day))
    assert len(with_drift(made_up(), read_history(path)).drift[0].dates) == 3


def test_drift_is_of_this_scanner_alone(tmp_path):
    path = tmp_path / "verification.jsonl"
    for day, scanner in ((-300, "s1"), (-200, "s1"), (-100, "s2")):
        append_history(path, made_up(day=day, scanner=scanner, value=0.05 + day / 10_000))
    found = with_drift(made_up(), read_history(path))
    assert len(found.drift[0].dates) == 3 and "1 other scanner" in found.notes[0]
    assert found.drift[0].rate_mm_per_year == pytest.approx(365.25 / 20_000, rel=1e-3)


# --- whole sessions ---------------------------------------------------------------------------------------------------

CELL = replace(
    DEFAULT,
    scanner=small_scanner(2),
    artefact_shots=5,
    plane_shots=6,
    part_at_deg=(170.0,),
    touch_noise_mm=0.0,
    photometry=replace(DEFAULT.photometry, bits=16),
)
# Wide: what is tested is the verdict. At half the camera's resolution balls show some 2,000 points.
WIDE = {"pf_mm": 0.5, "ps_mm": 0.1, "sd_mm": 0.15, "f_mm": 1.0}


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    folder = tmp_path_factory.mktemp("verification") / "session"
    simulate_session(folder, CELL)
    document = json.loads((folder / "session.json").read_text())
    centres = np.array(document["artefact"]["centres_base"])
    document["artefact"] |= {
        "distances": [float(np.linalg.norm(centres[i] - centres[j])) for i, j in ((0, 1), (1, 2), (2, 0))],
        "distances_u": 0.001,
        "sphere_diameter_u": 0.001,
        "sphere_form": 0.0005,
    }
    (folder / "session.json").write_text(json.dumps(document))
    return folder


@pytest.fixture(scope="module")
def found(session):
    return verify(session, WIDE)


def edited(session: Path, folder: Path, change) -> Path:
    """The session with another document; its images are shared."""
    folder.mkdir()
    (folder / "shots").symlink_to(session / "shots")
    document = json.loads((session / "session.json").read_text())
    change(document)
    (folder / "session.json").write_text(json.dumps(document))
    return folder


def test_a_good_scanner_passes(found):
    assert found.verdict is Verdict.PASS and found.lost == () and found.assumed == ()
    assert [c.name for c in found.characteristics] == ["PF", "PS", "SD", "F"]
    assert len(found.balls) == len(found.spacings) == 15 and len(found.planes) == 6
    assert found["PF"].positions >= 10 and found["SD"].positions >= 7 and found["F"].positions == 6
    # The simulated images are exact but for noise: no distance is off by a sixtieth of a camera pixel (0.3 mm).
    assert abs(found["SD"].value_mm) < 0.02 and abs(found["PS"].value_mm) < 0.03
    for ball in found.balls:
        assert ball.form_mm < 2.0 * ball.noise_range_mm and ball.seen > 0.8 and ball.wild == 0
    for plane in found.planes:
        assert plane.flatness_mm < 2.5 * plane.noise_range_mm and plane.size_mm[0] > 100


@pytest.mark.parametrize("scale", [0.995, 1.002, 1.02])
def test_a_scaled_scanner_shows_in_proportion(session, found, tmp_path, scale):
    def change(document):
        for row in document["scanner"]["camera_from_projector"][:3]:
            row[3] *= scale
        document["shots"] = [s for s in document["shots"] if s["of"] == "artefact"]

    scaled = verify(edited(session, tmp_path / "scaled", change), {"sd_mm": 0.05})
    for one, other in zip(found.spacings, scaled.spacings, strict=True):
        # A fixed radius that is too small by 10 (scale - 1) moves each centre along its own line of sight by about as
        # much (a cap tells depth against radius at 1.4 to 1), and two lines of sight differ by d / 400.
        aside = 1.4 * 10 * abs(scale - 1) * one.calibrated_mm / 400
        assert other.measured_mm == pytest.approx(scale * one.measured_mm, abs=aside)
        assert other.error_mm - one.error_mm == pytest.approx((scale - 1) * one.calibrated_mm, rel=0.05)
    for one, other in zip(found.balls, scaled.balls, strict=True):
        # A few pixels at the rim of the cap come or go with the scale: a tenth of u(D) of some 2,000 points.
        assert other.size_mm + 20 == pytest.approx(scale * (one.size_mm + 20), abs=5e-3)
    assert scaled.verdict is Verdict.FAIL and scaled.scanner != found.scanner


def test_balls_of_another_diameter_show_as_size(session, found, tmp_path):
    folder = edited(session, tmp_path / "balls", lambda d: d["artefact"].update(sphere_diameter=19.6))
    other = verify(folder, WIDE)
    assert other["PS"].verdict is Verdict.FAIL
    assert other["PS"].mean_mm == pytest.approx(found["PS"].mean_mm + 0.4, abs=1e-3)
    assert other["PF"].value_mm == pytest.approx(found["PF"].value_mm, abs=0.01)


def test_a_wrong_lens_shows_as_flatness(session, found, tmp_path):
    def change(document):
        document["scanner"]["camera"]["dist"][0] += 0.2
        only("plane")(document)

    bent = verify(edited(session, tmp_path / "bent", change), {"f_mm": 0.001})
    assert bent["F"].verdict is Verdict.FAIL and bent["F"].mean_mm > 2 * found["F"].mean_mm
    assert bent["PF"].verdict is Verdict.NOT_ASSESSABLE


def only(*kinds: str):
    def change(document):
        document["shots"] = [shot for shot in document["shots"] if shot["of"] in kinds]

    return change


def a_part_alone(document):
    only("part")(document)
    for shot in document["shots"]:
        shot.pop("flange_pose")


def test_too_few_positions_do_not_pass(session, tmp_path):
    def change(document):
        document["shots"] = [shot for shot in document["shots"] if shot["of"] == "artefact"][:2]

    other = verify(edited(session, tmp_path / "few", change), WIDE)
    assert [c.verdict for c in other.characteristics] == ["NOT MEASURED"] * 4
    assert other.verdict is Verdict.NOT_MEASURED and "are needed" in other["PF"].reason


def test_the_same_shot_again_is_no_other_position(session, tmp_path):
    def change(document):
        first = next(shot for shot in document["shots"] if shot["of"] == "artefact")
        document["shots"] = [{**first, "name": f"again-{i}"} for i in range(5)]

    folder = edited(session, tmp_path / "again", change)
    (folder / "shots").unlink()
    (folder / "shots").mkdir()
    for i in range(5):
        (folder / "shots" / f"again-{i}").symlink_to(session / "shots" / "artefact-1")
    other = verify(folder, WIDE)
    assert len(other.balls) == 15 and other["PF"].positions == 3 and other.verdict is Verdict.NOT_MEASURED


def test_a_shot_that_does_not_show_its_standard_does_not_pass(session, tmp_path):
    def change(document):
        document["shots"] = [shot for shot in document["shots"] if shot["of"] != "part"]

    folder = edited(session, tmp_path / "swapped", change)
    (folder / "shots").unlink()
    (folder / "shots").mkdir()
    for shot in (session / "shots").iterdir():
        # In the place of the second plate a plane, in the place of the first plane a pipe.
        source = {"artefact-2": "plane-3"}.get(shot.name, shot.name)
        (folder / "shots" / shot.name).symlink_to(session / "shots" / source)
    other = verify(folder, WIDE)
    assert [name for name, _ in other.lost] == ["artefact-2"] and "spheres" in other.lost[0][1]
    assert other["PF"].positions >= 10 and other["PF"].verdict is Verdict.NOT_MEASURED
    assert other["F"].verdict is Verdict.PASS and other.verdict is Verdict.NOT_MEASURED


def test_a_small_plane_does_not_test_the_volume(tmp_path):
    cell = replace(CELL, artefact_shots=1, part_at_deg=(), plane_shots=6, flat_mm=(56.0, 50.0, 10.0))
    simulate_session(tmp_path / "small", cell)
    other = verify(tmp_path / "small", {"f_mm": 1.0})
    assert other["F"].verdict is Verdict.NOT_MEASURED and "quarter of the field" in other["F"].reason
    assert len(other.lost) == 6


def test_a_session_without_a_robot_and_without_touched_centres(session, found, tmp_path):
    def change(document):
        only("artefact", "plane")(document)
        document["artefact"].pop("centres_base")
        document.pop("robot")
        for shot in document["shots"]:
            shot.pop("flange_pose")

    other = verify(edited(session, tmp_path / "tripod", change), WIDE)
    assert other.verdict is Verdict.PASS
    assert [s.error_mm for s in other.spacings] == [s.error_mm for s in found.spacings]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (a_part_alone, "nothing to verify by"),
        (lambda d: d["artefact"].update(distances=[30.0, 44.0, 62.0]), "artefact: distances.0: 30 mm between"),
        (lambda d: d["artefact"].update(distances=[10.0, 20.0, 62.0]), "no three centres are so far apart"),
        (lambda d: d["artefact"].update(distances_u=-0.1), "artefact.distances_u: "),
        (lambda d: d["plane"].update(flatness=3.0), "plane.flatness: "),
        (lambda d: d["shots"][0].update(of="plain"), "shots.0.of: "),
    ],
)
def test_sessions_that_cannot_be_verified(session, tmp_path, change, says):
    with pytest.raises(InputError) as wrong:
        verify(edited(session, tmp_path / "wrong", change), WIDE)
    assert says in str(wrong.value) and "session.json" in str(wrong.value) and "\n" not in str(wrong.value)


def test_another_plate_is_refused(session, tmp_path):
    def change(document):
        centres = np.array(document["artefact"]["centres_base"])
        document["artefact"]["centres_base"] = (centres[0] + 1.3 * (centres - centres[0])).tolist()
        document["artefact"].pop("distances")
        document["artefact"].pop("distances_u")
        only("artefact")(document)

    with pytest.raises(InputError, match="not the plate in view"):
        verify(edited(session, tmp_path / "plate", change), WIDE)


def test_dates(session):
    for date, says in (("2999-01-01", "lies in the future"), ("last week", "is not a date")):
        with pytest.raises(InputError, match=says):
            verify(session, WIDE, date=date)


def test_without_limits_nothing_is_judged(session, tmp_path):
    other = verify(edited(session, tmp_path / "bare", only("plane")))
    assert other.verdict is Verdict.NOT_ASSESSABLE and other["F"].value_mm > 0 and other["PF"].value_mm is None


@pytest.mark.parametrize("name", ["open-630", "open-273"])
def test_a_scanner_of_an_independent_renderer(name):
    """Highlights and light between surfaces: a few points are far off, and most are not."""
    found = verify(shared(f"sessions/{name}"), {**WIDE, "share": 0.997})
    # Touched centres: five times their standard uncertainty of 0.028 mm. Sizes: a tenth of a camera pixel each side.
    assert found["SD"].positions == 18 and abs(found["SD"].value_mm) < 0.14
    assert abs(found["PS"].value_mm) < 0.05 and found.lost == ()
    assert 0 < sum(ball.wild for ball in found.balls) < 1e-3 * sum(ball.points for ball in found.balls)
    assert np.median([ball.form_95_mm for ball in found.balls]) < 0.3
    everything = verify(shared(f"sessions/{name}"), WIDE)
    assert everything["PF"].verdict is Verdict.FAIL and "far off the surface" in everything["PF"].reason


# --- what inspect makes of it -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("verdict", "day", "scanner", "says"),
    [
        (Verdict.PASS, -1, None, None),
        (Verdict.PASS, -366, None, "expired on"),
        (Verdict.PASS, 3, None, "lies in the future"),
        (Verdict.FAIL, -1, None, "ended in FAIL"),
        (Verdict.INCONCLUSIVE, -1, None, "ended in INCONCLUSIVE"),
        (Verdict.NOT_MEASURED, -1, None, "ended in NOT MEASURED"),
        (Verdict.PASS, -1, "another", "no verification of this scanner"),
    ],
)
def test_what_a_session_may_rely_on(session, tmp_path, verdict, day, scanner, says):
    read = read_session(session)
    path = tmp_path / "v.jsonl"
    mine = scanner_id(read.scanner)
    append_history(path, made_up(day=-400, scanner=mine))
    if scanner is not None:
        path.unlink()
    append_history(path, made_up(verdict, day=day, scanner=scanner or mine))
    standing = standing_of(read, path)
    assert standing.good == (says is None) and (says is None or says in standing.text)
    assert standing.state == ("verified" if says is None else "expired" if "expired" in says else "failed")
    assert standing.relied_on == standing.good
    # What was made up was verified with fringes that nobody knows.
    assert any("verified with fringes unknown, this session has x 1 x 4" in n for n in standing.notes) == (not scanner)
    accepted = standing_of(read, path, "checked by hand")
    assert accepted.relied_on and "checked by hand" in accepted.statement
    with pytest.raises(InputError, match="give the reason"):
        standing_of(read, path, "  ")


def test_a_history_that_was_changed_is_not_relied_upon(session, tmp_path, three_lines):
    read, path = read_session(session), tmp_path / "v.jsonl"
    append_history(path, made_up(Verdict.FAIL, day=-5, scanner=scanner_id(read.scanner)))
    append_history(path, made_up(day=-4, scanner=scanner_id(read.scanner)))
    assert standing_of(read, path).good
    path.write_bytes(path.read_bytes().split(b"\n", 1)[1])
    assert not standing_of(read, path).good and "cannot be relied upon" in standing_of(read, path).text
    # An unfinished line is said, and the one before it counts.
    path.unlink()
    append_history(path, made_up(day=-4, scanner=scanner_id(read.scanner)))
    with path.open("ab") as file:
        file.write(three_lines[:200])
    assert standing_of(read, path).good and "unfinished" in standing_of(read, path).notes[0]


def test_a_session_with_the_fringes_of_the_verification_needs_no_note(session, found, tmp_path):
    append_history(tmp_path / "v.jsonl", found)
    standing = standing_of(read_session(session), tmp_path / "v.jsonl")
    assert standing.good and standing.notes == () and "PF, PS, SD, F" in standing.text


def test_where_the_history_is_looked_for(session, tmp_path):
    folder = edited(session, tmp_path / "s", only("part", "artefact"))
    read = read_session(folder)
    none = standing_of(read)
    assert none.text == none.statement == "no verification on record" and none.state == "none"
    assert none.relied_on and not none.good
    mine = scanner_id(read.scanner)
    append_history(tmp_path / "verification.jsonl", made_up(scanner=mine))
    assert standing_of(read).history == str(tmp_path / "verification.jsonl") and standing_of(read).good
    append_history(folder / "verification.jsonl", made_up(Verdict.FAIL, scanner=mine))
    assert "ended in FAIL" in standing_of(read).text
    named = edited(session, tmp_path / "t", lambda d: d.update(verification="../none.jsonl"))
    with pytest.raises(InputError, match="no such history"):
        standing_of(read_session(named))


def test_the_latest_date_decides_not_the_last_line(session, tmp_path):
    read, path = read_session(session), tmp_path / "v.jsonl"
    mine = scanner_id(read.scanner)
    append_history(path, made_up(Verdict.FAIL, day=-5, scanner=mine))
    append_history(path, made_up(Verdict.PASS, day=-50, scanner=mine))
    assert "ended in FAIL" in standing_of(read, path).text


def test_inspect_judges_only_with_a_verified_scanner(session, tmp_path):
    path = tmp_path / "v.jsonl"
    append_history(path, made_up(Verdict.FAIL, day=-1, scanner=scanner_id(read_session(session).scanner)))
    plain = inspect(session)
    assert plain.verification.text == "no verification on record" and plain.verdict is not Verdict.NOT_MEASURED
    refused = inspect(session, history=path)
    assert refused.verdict is Verdict.NOT_MEASURED and "ended in FAIL" in refused.verdicts[0].reason
    assert refused.step.max_abs_mm == plain.step.max_abs_mm
    accepted = inspect(session, history=path, accept_verification="ball bar checked by hand")
    assert accepted.verdict is plain.verdict and accepted.verification.accepted == "ball bar checked by hand"


# --- the command ------------------------------------------------------------------------------------------------------


def weldscan(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from weldscan.faces.cli.app import main; main()", *map(str, arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_the_command(session, tmp_path):
    (tmp_path / "limits.toml").write_text('pf_mm = 0.5\nsd_mm = 0.15\nhistory = "v.jsonl"\n')
    folder = edited(session, tmp_path / "plates", only("artefact", "part"))
    done = weldscan(tmp_path, "verify", folder, "--limits", "limits.toml", "--date", "2026-01-31")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("PASS   scanner ") and "SD  PASS" in done.stdout and "F   NOT ASSESS" in done.stdout
    document = json.loads((tmp_path / "plates-verification" / "verification.json").read_text())
    assert document["schema"] == "weldscan-verification/1" and document["verdict"] == "PASS"
    assert document["characteristics"]["SD"]["positions"] == 15 and len(document["spheres"]) == 15
    page = (tmp_path / "plates-verification" / "verification.html").read_text()
    assert page.count("<svg") >= 4 and page.count("data:image/png") == 15 and "NaN" not in page
    assert len(read_history(tmp_path / "v.jsonl").records) == 1

    seen = weldscan(tmp_path, "inspect", folder, "--history", "v.jsonl")
    assert seen.returncode != 5 and "scanner: verified on 2026-01-31" in seen.stdout
    (tmp_path / "strict.toml").write_text("sd_mm = 0.001\n")
    failed = weldscan(tmp_path, "verify", folder, "--limits", "strict.toml", "--history", "v.jsonl")
    assert failed.returncode == 3 and failed.stdout.startswith("FAIL")
    shutil.rmtree(tmp_path / "plates-report")
    seen = weldscan(tmp_path, "inspect", folder, "--history", "v.jsonl")
    assert seen.returncode == 5 and "the scanner is not verified" in seen.stdout
    result = json.loads((tmp_path / "plates-report" / "result.json").read_text())
    assert result["verdict"] == "NOT MEASURED" and result["verification"]["good"] is False
    seen = weldscan(tmp_path, "inspect", folder, "--history", "v.jsonl", "--accept-verification", "known, see log 7")
    assert seen.returncode != 5 and "known, see log 7" in seen.stdout
    assert "known, see log 7" in (tmp_path / "plates-report" / "report.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--limits", "none.toml"), "none.toml: no such file"),
        (("--history", "no/where.jsonl"), "no/where.jsonl: the history cannot be written"),
        (("--date", "tomorrow"), "is not a date"),
        (("--out", "."), "exists and holds something else"),
    ],
)
def test_a_wrong_use_is_one_line(session, tmp_path, arguments, says):
    (tmp_path / "something").touch()
    done = weldscan(tmp_path, "verify", session, *arguments)
    assert done.returncode == 2 and says in done.stderr and done.stdout == ""
    assert [line for line in done.stderr.splitlines() if not line.startswith("{")] == [done.stderr.splitlines()[-1]]
