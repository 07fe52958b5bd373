"""Scenes: their truth against closed forms, their rays against the surface, their images against their points."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from weldscan import InputError, decode, measure_step, read_frames, read_session, segment_weld, set_threads, triangulate
from weldscan._weldcore import WeldSurface
from weldscan.simulated import scenes
from weldscan.simulated.scenes import (
    DARK,
    KINDS,
    OK,
    SATURATED,
    Cap,
    Counterbore,
    Dent,
    Scene,
    SceneWall,
    SceneWeld,
    Taper,
    Waviness,
    draw,
    record,
    truth,
    views,
)


def with_weld(scene: Scene, **change) -> Scene:
    return replace(scene, welds=(replace(scene.welds[0], **change),))


@pytest.fixture(scope="module")
def plain() -> Scene:
    """A 219.1 x 8 pipe in two shots, nothing uneven."""
    scene = draw("plain", 4)
    smooth = SceneWeld(scene.welds[0].radius_mm, 8.0, half_length_mm=scene.welds[0].half_length_mm)
    return replace(scene, welds=(smooth,), noise_mm=0.02)


def test_the_truth_of_plain_walls_is_that_of_two_circles(plain):
    moved = SceneWall(radius_difference_mm=0.3, offset_mm=(0.2, 0.0))
    known = truth(with_weld(plain, other=moved))
    radius = plain.welds[0].radius_mm
    for degree, step in known["edge_step_by_deg"].items():
        angle = math.radians(int(degree))
        expected = 0.2 * math.cos(angle) + math.sqrt((radius + 0.3) ** 2 - (0.2 * math.sin(angle)) ** 2) - radius
        assert step == pytest.approx(expected, abs=2e-5)
        low, high = known["range_by_deg"][degree]
        assert low - 1e-5 <= step <= high + 1e-5
    assert known["largest"] == pytest.approx(max(abs(v) for r in known["range_by_deg"].values() for v in r))
    assert known["honest"] is (known["largest"] <= 0.8 * known["limit_mm"])


def test_the_truth_holds_what_was_done_to_the_edges(plain):
    middle = int(list(truth(plain)["edge_step_by_deg"])[10])
    tapered = truth(with_weld(plain, other=SceneWall(taper=Taper(1.6, 0.1))))
    assert set(tapered["edge_step_by_deg"].values()) == {-1.6} and not tapered["honest"]
    bored = truth(with_weld(plain, reference=SceneWall(counterbore=Counterbore(0.7, 10.0))))
    assert set(bored["edge_step_by_deg"].values()) == {0.7}
    dent = Dent(1.4, math.radians(middle), math.radians(4.0), 15.0)
    dented = truth(with_weld(plain, other=SceneWall(dents=(dent,))))
    assert dented["largest"] == 1.4 and dented["largest_at_deg"] == middle
    assert dented["edge_step_by_deg"][str((middle + 2) % 360)] == pytest.approx(-0.7, abs=1e-4)


def test_waves_and_shrinkage_are_in_the_truth(plain):
    uneven = (Waviness(0.02, 15.0, 40.0),)
    scene = with_weld(
        plain, reference=SceneWall(unevenness=uneven), other=SceneWall(unevenness=uneven, shrinkage_mm=0.2)
    )
    known = truth(scene)
    steps = np.array(list(known["edge_step_by_deg"].values()))
    angle = np.radians([int(d) for d in known["edge_step_by_deg"]])
    surface = WeldSurface(scene.welds[0])
    toes = scenes.toes(scene, np.degrees(angle))
    beside = surface.height(angle, toes["other_mm"] + 1e-6) - surface.height(angle, toes["reference_mm"] - 1e-6)
    assert np.abs(steps - beside).max() < 2e-5
    # Two independent fields of 0.02 mm, and the shell term 5.5 mm from the seam.
    s = 1.285 / math.sqrt(scene.welds[0].radius_mm * 8.0) * 5.5
    assert steps.mean() == pytest.approx(-0.2 * math.exp(-s) * (math.cos(s) + math.sin(s)), abs=0.03)
    assert 0.5 < steps.std() / (0.02 * math.sqrt(2)) < 1.5


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_what_it_says(kind):
    scene = draw(kind, 17)
    known = truth(scene)
    ratio = known["largest"] / scene.limit_mm
    weld = scene.welds[0]
    assert 25.0 <= 2 * weld.radius_mm <= 1220.0 and 1.0 <= weld.thickness_mm <= min(60.0, weld.radius_mm / 2 + 0.1)
    assert 1 <= len(scene.views) <= 12 and known["edge_step_by_deg"]
    if KINDS[kind].group == "defective":
        assert ratio >= 1.05 - 1e-4 and (ratio <= 3.001 or kind == "deep dent")
        assert not known["honest"]
    else:
        assert ratio <= 0.8001 and known["honest"]
    # Another draw of the same seed is the same scene, another seed another one.
    assert draw(kind, 17) == scene != draw(kind, 18)


@pytest.mark.parametrize("kind", ["plain", "leaning", "deep dent", "spatter", "two seams"])
def test_points_lie_on_the_surface_but_for_their_noise(kind):
    scene = draw(kind, 2)
    shot = next(views(scene))
    weld = scene.welds[scene.views[0].weld]
    seen = shot.seen
    pose = np.asarray(scene.views[0].weld_from_scanner)
    true = seen["points_mm"] @ pose[:3, :3].T + pose[:3, 3]
    there = np.isfinite(true[..., 0])
    at = true[there]
    angle = np.arctan2(at[:, 1], at[:, 0])
    above = np.hypot(at[:, 0], at[:, 1]) - weld.radius_mm - WeldSurface(weld).height(angle, at[:, 2])
    assert np.abs(above).max() < 1e-6
    good = shot.reason == OK
    assert good.mean() > 0.2 and (np.isfinite(shot.points_mm[..., 0]) == good).all()
    away = ((shot.points_mm - seen["points_mm"]) * seen["points_mm"]).sum(axis=2) / np.linalg.norm(
        seen["points_mm"], axis=2
    )
    assert away[good].std() == pytest.approx(scene.noise_mm, rel=0.03)
    # The projector's pixels are those that its lens gives.
    lit = seen["status"] == 0
    pixels = scene.scanner.project_to_projector(seen["points_mm"][lit])
    assert np.abs(pixels[:, 0] - seen["column_px"][lit]).max() < 1e-6


def test_what_was_made_dark_has_no_points():
    scene = draw("dark arc", 3)
    (start, end), *_ = scene.dark_deg
    for shot in views(scene):
        inside = (np.degrees(shot.seen["angle_rad"]) - start) % 360 < end - start
        assert (shot.reason[inside] == DARK).all()
    known = truth(scene)
    assert (known["largest_at_deg"] - start) % 360 < end - start + 2
    lit = [abs(v) for d, v in known["edge_step_by_deg"].items() if not -2 < (int(d) - start) % 360 < end - start + 2]
    assert not lit or max(lit) < known["limit_mm"]


def test_saturation_takes_the_bright_pixels_and_holes_take_patches():
    scene = draw("saturated", 1)
    shot = next(views(scene))
    lit = shot.seen["status"] == 0
    assert (shot.reason[lit] == SATURATED).mean() == pytest.approx(scene.saturated, abs=0.01)
    scene = draw("holes", 1)
    shot = next(views(scene))
    lit = shot.seen["status"] == 0
    lost = (shot.reason != OK) & lit
    assert lost[lit].mean() == pytest.approx(scene.holes, abs=0.05)
    # Patches: a lost pixel's neighbour is lost more often than not.
    assert lost[:, 1:][lost[:, :-1]].mean() > 0.6


def test_two_shots_of_one_arc_are_of_two_pipes():
    scene = draw("two pipes", 5)
    assert {view.weld for view in scene.views} == {0, 1} and len(scene.welds) == 2
    own = [truth(replace(scene, views=(view,))) for view in scene.views]
    assert min(t["largest"] for t in own) < scene.limit_mm < max(t["largest"] for t in own)
    assert truth(scene)["largest"] == pytest.approx(max(t["largest"] for t in own), rel=0.2)


def test_images_give_the_points_back(tmp_path):
    scene = replace(draw("plain", 4), noise_mm=0.03)
    scene = replace(scene, views=scene.views[:1])
    known = record(scene, tmp_path / "session")
    session = read_session(tmp_path / "session")
    assert json.loads((tmp_path / "session" / "truth.json").read_text()) == known
    shot = session.part_shots[0]
    (frames,) = read_frames(session, shot)
    phase = decode([frames], [(f.periods, f.steps) for f in session.fringes], 1280)
    cloud = triangulate(phase.column_px, scene.scanner, phase.sigma_px)
    direct = next(views(scene))
    both = np.isfinite(cloud.points_mm[..., 0]) & (direct.reason == OK)
    assert both.sum() > 0.97 * (direct.reason == OK).sum()
    true = direct.seen["points_mm"]
    away = np.linalg.norm(true, axis=2) - np.linalg.norm(cloud.points_mm, axis=2)
    assert abs(np.median(away[both])) < 0.003
    assert 0.7 < 1.4826 * np.median(np.abs(away[both])) / 0.03 < 1.4


def test_a_flat_calm_weld_is_measured_right(plain):
    scene = with_weld(plain, other=SceneWall(offset_mm=(0.3, -0.2)), cap=Cap(9.0, 1.5))
    weld, base = scene.welds[0], np.asarray(scene.base_from_weld)
    shots = []
    for shot in views(scene):
        turn = shot.base_from_flange[:3, :3].T
        axis, zero = (turn @ base[:3, 2]).tolist(), (turn @ base[:3, 0]).tolist()
        shots.append(segment_weld(shot.points_mm, weld.radius_mm, weld.thickness_mm, axis, zero))
    step = measure_step(shots)
    assert abs(step.max_abs_mm - truth(scene)["largest"]) < 0.01


def test_the_same_bits_on_one_and_two_threads():
    scene = draw("ripple", 1)
    found = []
    try:
        for threads in (1, 2):
            set_threads(threads)
            scenes.surface_of.cache_clear()
            shot = next(views(scene))
            found.append((shot.points_mm.tobytes(), shot.reason.tobytes(), json.dumps(truth(scene))))
    finally:
        set_threads(None)
    assert found[0] == found[1]


def test_what_cannot_be_is_refused():
    with pytest.raises(InputError, match="kind: must be one of plain, oval"):
        draw("perfect", 0)
    with pytest.raises(InputError, match="scene radius_mm: must be finite and above 0"):
        WeldSurface(SceneWeld(-1.0, 6.0))
    with pytest.raises(InputError, match="weld: "):
        WeldSurface("weld")
    surface = WeldSurface(SceneWeld(100.0, 6.0))
    with pytest.raises(InputError, match="angle_rad: not finite at index 1"):
        surface.edges([0.0, math.nan])
    with pytest.raises(InputError, match="z_mm: expected 2 as angle_rad, got 1"):
        surface.height([0.0, 1.0], [0.0])
