"""Frames that are under way when the question is asked: none of them is its answer, however late it comes."""

import time
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import test_camera
from test_camera import HEIGHT, WIDTH, open_camera

from weldscan import DeviceError
from weldscan.devices import backend
from weldscan.devices.cameras import aravis, pylon

PERIOD_S, EXPOSURE_S = 0.02, 0.015
fake_gige = test_camera.fake_gige


@pytest.fixture
def numbered(tmp_path):
    for number in range(100):
        cv2.imwrite(str(tmp_path / f"{number:03d}.png"), np.full((HEIGHT, WIDTH), number, np.uint8))
    return tmp_path


def test_pylon_frame_of_a_question_that_was_given_up(numbered, request, monkeypatch):
    with open_camera("pylon", numbered, request, monkeypatch) as camera:
        first = int(camera.capture().image[0, 0])
        camera._camera.ExecuteSoftwareTrigger()
        time.sleep(0.3)  # its frame is there by now, and nobody waits for it
        assert int(camera.capture().image[0, 0]) == first + 2


def test_pylon_goes_on_after_a_frame_that_did_not_come(numbered, request, monkeypatch):
    with open_camera("pylon", numbered, request, monkeypatch) as camera:
        first = int(camera.capture().image[0, 0])

        def late(deadline_s):
            monkeypatch.undo()
            raise camera._genicam.TimeoutException("late", __file__, 1)

        monkeypatch.setattr(camera, "_retrieve", late)
        with pytest.raises(DeviceError, match="in time"):
            camera.capture()
        assert int(camera.capture().image[0, 0]) != first + 1  # the emulation counts anew where it begins anew


class Late:
    """Aravis's stream, on which one frame comes after it was given up, and after the next look at what is there."""

    def __init__(self, stream):
        self.stream, self.asked = stream, 0

    def push_buffer(self, buffer):
        self.stream.push_buffer(buffer)

    def try_pop_buffer(self):
        return None

    def timeout_pop_buffer(self, wait_us):
        self.asked += 1
        return None if self.asked == 1 else self.stream.timeout_pop_buffer(wait_us)


def test_aravis_frame_that_is_late(fake_gige):
    camera = backend("camera", "aravis")
    name, _ = fake_gige()
    with camera(camera.Settings(device=name, exposure_s=0.005, timeout_s=2.0, retries=0)) as device:
        device.capture()
        device._stream = late = Late(device._stream)
        with pytest.raises(DeviceError, match="torn"):
            device.capture()
        device.capture()
        assert late.asked == 1  # the answer came by another way than the late frame


# --- hardware trigger: several frames are under way at once -----------------------------------------------------------


class Flow:
    """A camera that a projector triggers: each frame is its number, and arrives a while after it was exposed."""

    def __init__(self, transfer_s):
        self.transfer_s, self.start_s, self.given = transfer_s, time.monotonic(), 0

    def begun_s(self, number):
        return self.start_s + number * PERIOD_S

    def take(self, wait_s):
        """The next frame of the queue, None where there is none in time."""
        arrives_s = self.begun_s(self.given) + EXPOSURE_S + self.transfer_s
        if arrives_s > time.monotonic() + wait_s:
            time.sleep(wait_s)
            return None
        time.sleep(max(arrives_s - time.monotonic(), 0.0))
        self.given += 1
        return np.full((2, 2), self.given - 1, np.uint16)


class AravisBuffer:
    def __init__(self, image):
        self.image = image

    get_status = get_image_width = get_image_height = lambda self: 2

    def get_data(self):
        return self.image.tobytes()


def aravis_on(flow, monkeypatch, settings):
    def taken(wait_us):
        image = flow.take(wait_us * 1e-6)
        return None if image is None else AravisBuffer(image)

    stream = SimpleNamespace(push_buffer=lambda _: None, try_pop_buffer=lambda: taken(0), timeout_pop_buffer=taken)

    class Device:
        exposure_us = 0.0

        def __getattr__(self, name):
            return lambda *_: None

        def is_gv_device(self):
            return False

        def create_stream(self, *_):
            return stream

        def get_payload(self):
            return 8

        def set_exposure_time(self, us):
            self.exposure_us = us

        def get_exposure_time(self):
            return self.exposure_us

    library = SimpleNamespace(
        Camera=SimpleNamespace(new=lambda _: Device()),
        AcquisitionMode=SimpleNamespace(CONTINUOUS=1),
        Buffer=SimpleNamespace(new_allocate=lambda _: None),
        BufferStatus=SimpleNamespace(SUCCESS=2),
    )
    monkeypatch.setattr(aravis, "_library", lambda: (library, SimpleNamespace(Error=OSError)))
    return aravis.AravisCamera(aravis.AravisSettings(pixel_format="Mono16", **settings))


def pylon_on(flow, monkeypatch, settings):
    class Result:
        def __init__(self, image):
            self.image = image

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def IsValid(self):
            return self.image is not None

        GrabSucceeded = IsValid

        def Release(self):
            pass

        def GetArray(self):
            return self.image

    values = {}

    def node(name):
        return SimpleNamespace(SetValue=lambda value: values.update({name: value}), GetValue=lambda: values[name])

    class Device:
        def __getattr__(self, name):
            return lambda *_: None

        def GetNodeMap(self):
            return SimpleNamespace(GetNode=node)

        def RetrieveResult(self, wait_ms, handling):
            return Result(flow.take(wait_ms * 1e-3))

    library = SimpleNamespace(
        TlFactory=SimpleNamespace(GetInstance=lambda: SimpleNamespace(CreateFirstDevice=lambda: None)),
        InstantCamera=lambda _: Device(),
        GrabStrategy_OneByOne=0,
        TimeoutHandling_Return=0,
        TimeoutHandling_ThrowException=1,
    )
    errors = SimpleNamespace(GenericException=OSError, TimeoutException=TimeoutError)
    monkeypatch.setattr(pylon, "_library", lambda: (library, errors))
    return pylon.PylonCamera(pylon.PylonSettings(pixel_format="Mono16", **settings))


@pytest.mark.parametrize("opened", [aravis_on, pylon_on])
@pytest.mark.parametrize("transfer_s", [0.0, 0.03, 0.09])
def test_hardware_trigger_gives_what_began_after_the_question(opened, transfer_s, monkeypatch):
    flow = Flow(transfer_s)
    settings = {"trigger": "hardware", "exposure_s": EXPOSURE_S}
    with opened(flow, monkeypatch, settings) as camera:
        for pause_s in (0.0, 0.013, 0.1, 0.047):
            time.sleep(pause_s)
            asked_s = time.monotonic()
            number = int(camera.capture().image[0, 0])
            assert flow.begun_s(number) >= asked_s
        assert camera.streams
        following = int(camera.next_frame().image[0, 0])
        assert following == number + 1  # as it comes: `devices check` measures `transfer_s` with it
