"""The simulated camera and projector keep time as real ones do: a pattern has to stand before its frame begins."""

import time

import numpy as np
import pytest

from small_cell import small_scanner
from weldscan.devices import backend
from weldscan.devices.projectors.patterns import flat_pattern, fringe_patterns
from weldscan.simulated import DEFAULT
from weldscan.simulated import camera_and_projector as simulated
from weldscan.station import check
from weldscan.station.capture import capture_stack

HZ = 20.0
CELL = DEFAULT.__class__(scanner=small_scanner(16))
SIZE = CELL.scanner.projector.width, CELL.scanner.projector.height


@pytest.fixture
def devices():
    camera, projector = backend("camera", "simulated"), backend("projector", "simulated")
    settings = camera.Settings(cell=CELL, exposure_s=1 / HZ)
    with (
        camera(settings) as eye,
        projector(projector.Settings(width=SIZE[0], height=SIZE[1], refresh_hz=HZ)) as light,
    ):
        eye.capture()  # darkness
        yield eye, light


def level(camera, projector, wanted):
    projector.show(flat_pattern(wanted, *SIZE))
    time.sleep(projector.settle_s)
    return camera.capture().image


def test_a_stack_shows_each_pattern_for_its_whole_exposure(devices):
    camera, projector = devices
    patterns = [*fringe_patterns(CELL.fringes, *SIZE), flat_pattern(255, *SIZE)]
    started = time.monotonic()
    frames = capture_stack(camera, projector, patterns)
    assert time.monotonic() - started >= len(patterns) * 2 / HZ - 1e-3  # one refresh to stand, one to be exposed
    shot = camera._rendered
    for frame, expected in zip(frames, [*shot.frames[0], shot.white[0]], strict=True):
        np.testing.assert_array_equal(frame, expected)


def test_a_frame_that_did_not_wait_is_not_of_the_new_pattern_alone(devices):
    camera, projector = devices
    black, white = (level(camera, projector, wanted).astype(float) for wanted in (0, 255))
    for _ in range(5):
        level(camera, projector, 0)
        time.sleep(0.4 / HZ)
        since_s = projector.show(flat_pattern(255, *SIZE))
        seen = camera.capture()
        share = (seen.image.mean() - black.mean()) / (white.mean() - black.mean())
        assert share < 1 - 1e-3
        stood_s = simulated._WALL[-1][0]
        assert since_s < stood_s <= since_s + 1 / HZ + 1e-6
        began_s = since_s  # at the earliest
        assert share <= 1 - (stood_s - began_s) * HZ + 0.2


def test_the_latency_that_is_measured_is_the_one_that_it_has(devices):
    camera, projector = devices
    camera.set_exposure(1 / HZ)
    level(camera, projector, 255)  # what a pose shows is computed once
    found = check.latency_s(camera, projector, repeats=2)
    assert all(0 < seconds < 3 / HZ + 0.2 for seconds in found)


def test_what_is_asked_for_in_one_refresh_is_the_last(devices):
    camera, projector = devices
    for wanted in (255, 0, 128, 0, 255, 0):
        projector.show(flat_pattern(wanted, *SIZE))
    time.sleep(projector.settle_s)
    black = camera.capture().image
    np.testing.assert_array_equal(black, level(camera, projector, 0))


def test_what_is_prepared_is_what_is_seen(devices):
    """`scan` tells the camera that the robot has come: what a pose shows is computed while it comes to rest."""
    camera, projector = devices
    asked = time.monotonic()
    camera.prepare()
    assert time.monotonic() - asked < 0.1
    camera._own_thread().submit(int).result(60)
    prepared = camera._rendered
    np.testing.assert_array_equal(level(camera, projector, 255), prepared.white[0])
    assert camera._rendered is prepared
