"""What the frames of one shot say of themselves: faults are named, honest stacks left alone, clipping is found."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from conftest import shared
from weldscan import InputError, decode
from weldscan._weldcore import saturation_level
from weldscan.devices.projectors.patterns import fringe_patterns
from weldscan.records.session import FringeSet
from weldscan.station.capture import judge

SIZE = 1280
LADDER = [(1, 4), (8, 4), (64, 4)]
LISTS = [
    LADDER,
    [(1, 3), (8, 3), (64, 3)],
    [(59, 4), (64, 4), (70, 4)],
    [(64, 4), (1, 3), (8, 6)],
    [(1, 12), (8, 12), (64, 12)],
    [(1, 7), (6, 12)],
]


def part(rng, shape=(200, 480), low=0.1, high=0.9):
    """Columns of a bent wall with a step, and its albedo: texture, a dark and sometimes a glaring part."""
    v, u = np.mgrid[: shape[0], : shape[1]].astype(float)
    x, y = u / shape[1], v / shape[0]
    column = low + (high - low) * x + 0.01 * rng.uniform(-1, 1) * y + 0.03 * rng.uniform(-1, 1) * (x - 0.5) ** 2
    column += 0.01 * rng.uniform(-1, 1) * (x > rng.uniform(0.3, 0.7))
    texture = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), rng.uniform(1, 6))
    albedo = 0.5 * np.exp(rng.uniform(0, 0.25) * texture / texture.std())
    albedo[:, int(shape[1] * rng.uniform(0.7, 1)) :] *= 0.03
    albedo[int(shape[0] * rng.uniform(0.7, 1.2)) :] *= 4
    return column * SIZE - 0.5, albedo


def photograph(rng, column, albedo, fringes, gamma=1.0, noise=1.0, flicker=0.0, bits=8, tremble=0.0, top=255):
    """Images of a part: fringes (periods, steps[, direction, origin_rad])."""
    images = []
    for periods, steps, *convention in fringes:
        direction, origin = convention or (1, 0.0)
        for i in range(steps):
            moved = np.float32([[1, 0, rng.uniform(-tremble, tremble)], [0, 1, rng.uniform(-tremble, tremble)]])
            seen = cv2.warpAffine(albedo, moved, albedo.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
            wave = np.cos(2 * np.pi * (periods * (column + 0.5) / SIZE - direction * i / steps) + origin)
            light = 255 * seen * (0.85 * (0.5 + 0.5 * wave) ** gamma + 0.05) * (1 + flicker * rng.uniform(-1, 1))
            light = light + noise * rng.standard_normal(light.shape)
            coarse = 2 ** (8 - bits)
            images.append((np.clip(light, 0, top) // coarse * coarse).astype(np.uint8))
    return images


def said(images, fringes=LADDER, **options):
    return [d.text for d in decode([images], fringes, SIZE, **options).disagreements]


@pytest.mark.parametrize("fringes", LISTS, ids=str)
def test_honest_stacks_are_left_alone(fringes):
    rng = np.random.default_rng(5)
    kinds = [
        {},
        {"noise": 5.0},
        {"gamma": 2.2},
        {"gamma": 0.6},
        {"bits": 6},
        {"flicker": 0.05},
        {"tremble": 3.0},
        {"gamma": 1.8, "flicker": 0.03, "tremble": 1.5, "bits": 6},
    ]
    for kind in kinds:
        for compensate in ("auto", None):
            images = photograph(rng, *part(rng), fringes, **kind)
            assert not said(images, fringes, phase_error=compensate), kind


def test_dark_saturated_and_empty_images_are_no_copies():
    for level in (0, 7, 255):
        assert not said([np.full((60, 80), level, np.uint8)] * 12)
    rng = np.random.default_rng(6)
    column, albedo = part(rng)
    albedo[:, : albedo.shape[1] // 2] = 0
    assert not said(photograph(rng, column, albedo, LADDER, noise=0.0))
    albedo[:, : albedo.shape[1] // 2] = 9
    assert not said(photograph(rng, column, albedo, LADDER, noise=0.0))


@pytest.fixture(scope="module")
def honest():
    rng = np.random.default_rng(7)
    return photograph(rng, *part(rng), LADDER)


def test_a_copied_frame_is_named(honest):
    images = list(honest)
    images[6] = images[5]
    (found,) = decode([images], LADDER, SIZE).disagreements
    assert found.text == "step 2 of the set of 8 periods is a copy of step 1"
    assert (found.exposure, found.set, found.frames) == (0, 1, [5, 6])
    images[6] = np.clip(images[5] + np.random.default_rng(1).normal(0, 1, images[5].shape), 0, 255).astype(np.uint8)
    assert said(images) == ["step 2 of the set of 8 periods shows the same as step 1"]


@pytest.mark.parametrize("pair", [(5, 6), (0, 2), (9, 11), (3, 9)])
def test_exchanged_frames_are_named(honest, pair):
    a, b = pair
    images = list(honest)
    images[a], images[b] = images[b], images[a]
    (found,) = decode([images], LADDER, SIZE).disagreements
    assert found.frames == [a, b]
    assert found.text.endswith("are exchanged")
    assert found.share > 0.5
    assert found.strength > 5


@pytest.mark.parametrize("set_", [0, 1, 2])
@pytest.mark.parametrize("by", [1, 2, 3])
def test_a_rolled_set_is_named(honest, set_, by):
    images, at = list(honest), 4 * set_
    images[at : at + 4] = images[at + by : at + 4] + images[at : at + by]
    (found,) = decode([images], LADDER, SIZE).disagreements
    assert found.set == set_
    when = {1: "1 step late", 2: "2 steps late", 3: "1 step early"}[by]
    assert f"is rolled: it begins {when}" in found.text


def test_a_rolled_stack_and_exchanged_sets_are_named(honest):
    assert said(honest[1:] + honest[:1]) == ["the whole stack is rolled: it begins 1 frame late"]
    assert said(honest[4:8] + honest[:4] + honest[8:]) == ["the set of 1 period and the set of 8 periods are exchanged"]


def test_a_jolt_is_named(honest):
    images = list(honest)
    images[6:] = [np.roll(image, -7, axis=1) for image in images[6:]]
    (text,) = said(images)
    assert text.startswith("a jolt: from step 2 of the set of 8 periods on the picture is displaced by (-7, ")


@pytest.mark.parametrize("degrees", [60, -90, 180])
@pytest.mark.parametrize("direction", [1, -1])
def test_a_foreign_convention_is_named_and_then_read(degrees, direction):
    rng = np.random.default_rng(8)
    column, albedo = part(rng)
    origin = np.radians(degrees)
    foreign = [(p, n, direction, origin) for p, n in LADDER]
    images = photograph(rng, column, albedo, foreign)
    (text,) = said(images)
    assert "origin_rad" in text
    assert ("direction = -1" in text) == (direction == -1)
    named = float(text.split("origin_rad = ")[1])
    assert abs(np.angle(np.exp(1j * (named - origin)))) < 0.02
    found = decode([images], foreign, SIZE)
    assert not found.disagreements
    assert np.nanmax(np.abs(found.column_px - column)) < 0.5
    assert found.counts[0] > 0.5 * column.size


def test_conventions_are_checked():
    images = [np.zeros((8, 8), np.uint8)] * 4
    with pytest.raises(InputError, match="direction"):
        decode([images], [(1, 4, 2, 0.0)], SIZE)
    with pytest.raises(InputError, match="origin_rad"):
        decode([images], [(1, 4, 1, float("nan"))], SIZE)
    with pytest.raises(InputError, match="direction"):
        next(fringe_patterns([("x", 1, 4, 0, 0.0)], 8, 1))


def test_patterns_and_decoding_agree_on_the_convention():
    fringes = [("x", p, 4, -1, 0.7) for p in (1, 8, 64)]
    images = list(fringe_patterns(fringes, SIZE, 8))
    found = decode([[i.copy() for i in images]], [f[1:] for f in fringes], SIZE, saturation=256)
    assert np.nanmax(np.abs(found.column_px - np.arange(SIZE))) < 0.1


def test_a_session_says_a_convention_only_where_it_is_not_the_usual_one():
    plain = FringeSet.model_validate({"axis": "x", "periods": 8, "steps": 4})
    assert plain.model_dump() == {"axis": "x", "periods": 8, "steps": 4}
    foreign = FringeSet.model_validate({"axis": "x", "periods": 8, "steps": 4, "direction": -1, "origin_rad": 3.1})
    assert FringeSet.model_validate(foreign.model_dump()) == foreign
    assert foreign.code == (8, 4, -1, 3.1)


def test_stacks_of_other_people_are_read():
    folder = shared("real/cpsd_gamma")
    sets = {1: 1, 2: 4, 3: 16, 4: 64}
    images = [
        cv2.imread(str(folder / f"PSPImg/17_{f}_{s}.png"), cv2.IMREAD_GRAYSCALE) for f in sets for s in range(1, 13)
    ]
    (text,) = [d.text for d in decode([images], [(p, 12) for p in sets.values()], SIZE).disagreements]
    assert "origin_rad" in text
    found = decode([images], [(p, 12, -1, np.pi) for p in sets.values()], SIZE)
    assert not found.disagreements
    assert found.counts[0] > 20 * found.counts[3]


# --- clipping ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [3, 4])
@pytest.mark.parametrize(("top", "full", "shift"), [(235, 255, 0), (200, 255, 0), (3900, 4095, 0), (3900, 4095, 4)])
@pytest.mark.parametrize("after", [0.0, 1.5])
def test_clipping_below_full_scale_is_found(steps, top, full, shift, after):
    rng = np.random.default_rng(9)
    column = np.tile(np.arange(SIZE, dtype=float), (30, 1))
    images = []
    for periods in (1, 8, 64):
        for i in range(steps):
            light = 0.7 + 0.56 * np.cos(2 * np.pi * (periods * (column + 0.5) / SIZE - i / steps))
            level = np.clip(np.rint((light + rng.normal(0, 0.003, light.shape)) * full), 0, top)
            level = np.clip(np.rint(level + after * rng.standard_normal(level.shape)), 0, full).astype(int) << shift
            images.append(level.astype(np.uint8 if full == 255 else np.uint16))
    found = decode([images], [(p, steps) for p in (1, 8, 64)], SIZE)
    assert found.clipped_below_full_scale
    assert found.saturation <= top << shift
    assert found.saturation > (0.97 * top * (1 << shift))
    error = np.abs(found.column_px - column)
    measured = np.isfinite(error)
    assert measured.mean() < 0.02 or np.median(error[measured] / found.sigma_px[measured]) < 3


def test_scenes_that_merely_end_below_full_scale_lose_nothing():
    rng = np.random.default_rng(10)
    for number in range(30):
        column, albedo = part(rng)
        if number % 3 == 0:
            albedo = np.ones_like(albedo)
        albedo = albedo / albedo.max() * rng.uniform(0.2, 0.98)
        fringes = LISTS[number % len(LISTS)]
        bits = 6 if number % 2 else 8
        images = photograph(rng, column, albedo, fringes, noise=rng.choice([0, 0.5, 2]), bits=bits)
        found = decode([images], fringes, SIZE)
        assert not found.clipped_below_full_scale, number
        assert found.saturation == 255


def test_a_lamp_in_view_is_no_clipping():
    rng = np.random.default_rng(12)
    column, albedo = part(rng)
    images = photograph(rng, column, 0.6 * albedo / albedo.max(), LADDER)
    for image in images:
        image[:40, :40] = 240 + rng.integers(0, 3, (40, 40))
    assert not decode([images], LADDER, SIZE).clipped_below_full_scale


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_live_checks_go_by_the_sensor(bits):
    rng = np.random.default_rng(11)
    full = 2**bits - 1
    columns = np.tile(np.linspace(100, 1200, 320), (40, 1))

    def stack(light):
        waves = [0.5 + 0.4 * np.cos(2 * np.pi * (p * columns / SIZE - i / 4)) for p in (1, 8, 64) for i in range(4)]
        levels = [np.clip(np.rint((w * light + rng.normal(0, 0.003, w.shape)) * full), 0, full) for w in waves]
        return [level.astype(np.uint8 if bits == 8 else np.uint16) for level in levels]

    sets = [("x", p, 4) for p in (1, 8, 64)]
    for known in (full, None):
        good, clipped = judge([stack(0.9)], sets, 0.02, known), judge([stack(1.6)], sets, 0.02, known)
        assert good.usable > 0.9
        assert abs(good.median_modulation - 0.36) < 0.02
        assert clipped.saturated > 0.5
    # Numbers that eight bits could hold are dark for a camera of more.
    assert judge([stack(0.9 / 2 ** (bits - 8))], sets, 0.2, full).dark > 0.9 or bits == 8


def test_images_of_other_kinds_are_refused():
    with pytest.raises(InputError, match="uint8 or uint16"):
        saturation_level([np.zeros((3, 3))])
    with pytest.raises(InputError, match="none"):
        saturation_level([])
