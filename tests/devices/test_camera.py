"""One suite for every camera: simulated, a folder, Aravis and pylon against their own simulators, OpenCV on a stand-
in."""

import json
import shutil
import subprocess
import threading
import time

import cv2
import numpy as np
import pytest

from weldscan import DeviceError, DeviceTimeout
from weldscan.devices import BACKENDS, backend
from weldscan.devices.cameras import Camera, CameraSettings, TornFrame

WIDTH, HEIGHT = 640, 480
LATE_S = 1.0
"""How far beyond its time-out an error may come: a machine that others load too."""
FAKE = "arv-fake-gv-camera-0.8"
SMALL_PACKETS = 140
"""For the small images of the scan's tests: 17 packets each, of which all arrive for 7 images of 10."""
LARGE_PACKETS = 32_000
"""Aravis's fake camera resends nothing; of its 1,400 byte packets 2 % lost leave no whole image. Loopback takes
large ones."""


def images(count=4):
    random = np.random.default_rng(7)
    return [random.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8) for _ in range(count)]


@pytest.fixture
def scene(tmp_path):
    for number, image in enumerate(images()):
        cv2.imwrite(str(tmp_path / f"{number:03d}.png"), image)
    return tmp_path


class V4l2:
    """What cv2.VideoCapture does with a UVC camera: a stream with a queue, settings that are taken or not."""

    period_s = 0.01

    def __init__(self, device, api):
        self.values = {cv2.CAP_PROP_AUTO_EXPOSURE: 3.0, cv2.CAP_PROP_FRAME_WIDTH: 0.0}
        self.opened, self.unplugged, self.refuses = device == 0, False, ()
        self.seen, self.start_s = 0, time.monotonic()
        self.size = (HEIGHT, WIDTH)

    def isOpened(self):
        return self.opened

    def set(self, key, value):
        if key not in self.refuses:
            self.values[key] = float(value)
        return True

    def get(self, key):
        return self.values.get(key, 0.0)

    def grab(self):
        """The next frame of the queue of 4, or the one after it when that was read."""
        newest = int((time.monotonic() - self.start_s) / self.period_s)
        if self.seen >= newest:
            time.sleep(self.period_s * (self.seen + 1 - newest))
            newest = self.seen + 1
        self.seen = max(self.seen + 1, newest - 3)
        return not self.unplugged

    def retrieve(self):
        return True, np.full((*self.size, 3), self.seen % 256, np.uint8)

    def release(self):
        self.opened = False


@pytest.fixture
def fake_gige():
    """A factory of Aravis's fake cameras, each in its own process."""
    if shutil.which(FAKE) is None:
        pytest.skip(f"{FAKE} (Debian: aravis-tools) is not installed")
    pytest.importorskip("gi", reason="PyGObject is not installed")
    running = []

    def start(*options):
        running.append(subprocess.Popen([FAKE, "-i", "127.0.0.1", "-s", "WELD01", *options], stderr=subprocess.DEVNULL))
        camera = backend("camera", "aravis")
        for _ in range(100):
            found = [name for name in camera.available() if "WELD01" in name]
            if found:
                return found[0], running[-1]
            time.sleep(0.1)
        pytest.skip("the fake camera does not answer on 127.0.0.1")

    yield start
    for process in running:
        process.kill()
        process.wait()


def open_camera(name, scene, request, monkeypatch, **settings):
    common = {"exposure_s": 0.01, "timeout_s": 3.0, "width": WIDTH, "height": HEIGHT, **settings}
    if name == "folder":
        common |= {"folder": scene, "repeat": True}
    elif name == "aravis":
        common |= {"device": request.getfixturevalue("fake_gige")()[0]}
    elif name == "pylon":
        pytest.importorskip("pypylon", reason="pypylon is not installed")
        monkeypatch.setenv("PYLON_CAMEMU", "1")
        common |= {"features": {"ImageFilename": str(scene), "ImageFileMode": "On", "TestImageSelector": "Off"}}
    elif name == "opencv":
        monkeypatch.setattr(cv2, "VideoCapture", V4l2)
    elif name == "simulated":
        common |= {"width": 1280, "height": 960}
    camera = backend("camera", name)
    return camera(camera.Settings(**common))


every_camera = pytest.mark.parametrize("name", sorted(BACKENDS["camera"]))


@every_camera
def test_a_camera(name, scene, request, monkeypatch):
    with open_camera(name, scene, request, monkeypatch) as camera:
        assert camera.exposure_s == pytest.approx(0.01, rel=0.02)
        assert camera.set_exposure(0.02) == pytest.approx(0.02, rel=0.02)
        before = time.monotonic()
        frames = [camera.capture() for _ in range(3)]
        assert all(frame.image.shape == ((960, 1280) if name == "simulated" else (HEIGHT, WIDTH)) for frame in frames)
        assert all(frame.image.dtype == np.uint8 for frame in frames)
        times = [before, *(frame.time_s for frame in frames), time.monotonic()]
        assert times == sorted(times)
        frames[0].image[:] = 0  # a frame is the caller's own: later ones do not see this
        assert camera.capture().image.shape == frames[1].image.shape


@every_camera
def test_frame_of_the_wrong_size(name, scene, request, monkeypatch):
    if name in ("aravis", "pylon"):
        pytest.skip("the size is set on the camera itself")
    camera = open_camera(name, scene, request, monkeypatch)
    with camera, pytest.raises(DeviceError, match="320x200"):  # opened with what it has: then the plan wants another
        object.__setattr__(camera.settings, "width", 320)
        object.__setattr__(camera.settings, "height", 200)
        camera.capture()


@pytest.mark.parametrize("name", ["folder", "pylon"])
def test_pixel_exact(name, scene, request, monkeypatch):
    with open_camera(name, scene, request, monkeypatch) as camera:
        for image in [*images(), *images()]:
            np.testing.assert_array_equal(camera.capture().image, image)


# --- Aravis against its fake GigE Vision camera -----------------------------------------------------------------------


def is_whole(image):
    """The fake camera draws a diagonal ramp: every row is the one above, moved by one pixel."""
    return bool((image[1:, :-1] == image[:-1, 1:]).all()) and image.min() < image.max()


def test_aravis_200_frames(fake_gige, soak):
    camera = backend("camera", "aravis")
    name, _ = fake_gige()
    with camera(camera.Settings(device=name, width=1280, height=960, exposure_s=0.005, timeout_s=5.0)) as device:
        count = 200 if soak else 10
        frames = [device.capture() for _ in range(count)]
        assert {frame.image.shape for frame in frames} == {(960, 1280)}
        assert all(is_whole(frame.image) for frame in frames)
        for exposure_s in (0.003, 0.0125, 0.004):
            assert device.set_exposure(exposure_s) == pytest.approx(exposure_s, rel=1e-3)


def test_aravis_lost_packets_become_retries(fake_gige, soak):
    camera = backend("camera", "aravis")
    name, _ = fake_gige("-r", "20")
    settings = camera.Settings(
        device=name, width=1280, height=960, exposure_s=0.005, timeout_s=30.0, retries=100, packet_size=LARGE_PACKETS
    )
    with camera(settings) as device:
        frames = [device.capture() for _ in range(200 if soak else 10)]
        assert sum(frame.retries for frame in frames) > 0  # 40 packets a frame: 0.45 of the frames are whole at once
        assert all(is_whole(frame.image) for frame in frames)


def test_no_torn_image_in_a_shot(fake_gige, tmp_path):
    """A scan through a camera whose packets get lost: every image that was kept is whole."""
    from test_scan import HEIGHT, WIDTH, Cell

    name, _ = fake_gige("-r", "20")
    scanning = Cell(tmp_path)
    plan = json.loads((tmp_path / "plan.json").read_text())
    plan["shots"] = [plan["shots"][0] | {"exposures": None}, plan["shots"][2] | {"exposures": None}]
    (tmp_path / "plan.json").write_text(json.dumps(plan))
    text = scanning.path.read_text()
    section = (
        f'[camera]\nbackend = "aravis"\ndevice = "{name}"\nwidth = {WIDTH}\nheight = {HEIGHT}\nexposure_s = 0.01\n'
        f"timeout_s = 30.0\nretries = 100\npacket_size = {SMALL_PACKETS}\n"
    )
    text = text[: text.index("[camera]")] + section + text[text.index("[projector]") :]
    scanning.path.write_text(text + "least_usable = 0.0\nmost_saturated = 1.0\n")  # it draws a ramp, not our fringes
    with scanning.controller:
        assert scanning.scan().whole == 2
    assert "torn frames" in (scanning.out / "scan.log").read_text()
    images = sorted((scanning.out / "shots").glob("*/*.png"))
    assert len(images) == 2 * 9
    assert all(is_whole(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)) for path in images)


def test_aravis_unplugged(fake_gige):
    """The library asks a lost camera again and again; the error is in time all the same."""
    camera = backend("camera", "aravis")
    name, process = fake_gige()
    with camera(camera.Settings(device=name, exposure_s=0.005, timeout_s=1.0)) as device:
        device.capture()
        process.kill()
        process.wait()
        for _ in range(2):
            start = time.monotonic()
            with pytest.raises(DeviceError, match=r"unplugged|trigger|torn"):
                device.capture()
            assert time.monotonic() - start < 1.0 + LATE_S
        start = time.monotonic()
    assert time.monotonic() - start < 2.0 + LATE_S  # closing a camera that is not there


def test_aravis_no_such_camera():
    pytest.importorskip("gi", reason="PyGObject is not installed")
    camera = backend("camera", "aravis")
    with pytest.raises(DeviceError, match="open"):
        camera(camera.Settings(device="No-Such-Camera"))


# --- hardware trigger -------------------------------------------------------------------------------------------------


def trigger_of(name, device):
    """What a projector does at every refresh: the simulated cameras know no other trigger input than their command."""
    return device._camera.software_trigger if name == "aravis" else device._camera.ExecuteSoftwareTrigger


@pytest.mark.parametrize("name", ["aravis", "pylon"])
def test_hardware_trigger(name, tmp_path, request, monkeypatch):
    """Frames from before the question are not given, however many the driver holds."""
    for number in range(250):
        cv2.imwrite(str(tmp_path / f"{number:03d}.png"), np.full((HEIGHT, WIDTH), number, np.uint8))
    settings = {"trigger": "hardware", "trigger_line": "Software", "exposure_s": 0.002}
    with open_camera(name, tmp_path, request, monkeypatch, **settings) as camera:
        fire, stop, fired = trigger_of(name, camera), threading.Event(), []

        def refresh():
            while not stop.wait(0.03):
                fire()
                fired.append(time.monotonic())

        projector = threading.Thread(target=refresh)
        projector.start()
        try:
            first = camera.capture()
            time.sleep(0.6)  # and the queue fills: pylon holds 10
            before = len(fired)
            frame = camera.capture()
            assert before + 1 <= len(fired)
            if name == "pylon":  # its images are numbered
                assert frame.image[0, 0] > first.image[0, 0] + 10
        finally:
            stop.set()
            projector.join()


@pytest.mark.parametrize("name", ["aravis", "pylon"])
def test_hardware_trigger_that_does_not_come(name, scene, request, monkeypatch):
    line = {"trigger_line": "Software"} if name == "aravis" else {}  # the fake camera has no input
    with open_camera(name, scene, request, monkeypatch, trigger="hardware", timeout_s=0.5, **line) as camera:
        start = time.monotonic()
        with pytest.raises(DeviceTimeout):
            camera.capture()
        assert time.monotonic() - start < 2.0


# --- OpenCV -----------------------------------------------------------------------------------------------------------


def test_opencv_gives_no_frame_from_before_the_question(scene, request, monkeypatch):
    with open_camera("opencv", scene, request, monkeypatch, exposure_s=0.01) as camera:
        for _ in range(5):
            time.sleep(0.1)  # the queue fills with frames that nobody asked for
            asked = (time.monotonic() - camera._capture.start_s) / V4l2.period_s
            assert camera.capture().image[0, 0] > int(asked) % 256 or asked > 250


class Uvc(V4l2):
    """A camera that streams whether asked or not, with a queue of 4; its frames take a while to come over USB."""

    period_s, exposure_s, transfer_s = 1 / 60, 0.002, 0.06
    wall = None
    """What it looks at: grey levels by the time from which they are there."""

    def __init__(self, device, api):
        super().__init__(device, api)
        self.queue, self.count, self.begun_s = [], 0, 0.0

    def due_s(self):
        return self.start_s + self.count * self.period_s + self.exposure_s + self.transfer_s

    def fill(self):
        while self.due_s() <= time.monotonic():
            if len(self.queue) < 4:
                self.queue.append(self.start_s + self.count * self.period_s)
            self.count += 1

    def grab(self):
        self.fill()
        while not self.queue:
            time.sleep(max(self.due_s() - time.monotonic(), 0) + 1e-4)
            self.fill()
        self.begun_s = self.queue.pop(0)
        return True

    def retrieve(self):
        middle_s = self.begun_s + self.exposure_s / 2
        level = next((level for on_s, level in reversed(self.wall or []) if on_s <= middle_s), 0)
        return True, np.full((4, 6), level, np.uint8)


@pytest.mark.parametrize(("exposure_s", "transfer_s"), [(0.002, 0.06), (0.005, 0.03), (1 / 60, 0.033)])
def test_no_frame_of_a_usb_camera_began_before_the_question(monkeypatch, exposure_s, transfer_s):
    monkeypatch.setattr(cv2, "VideoCapture", Uvc)
    monkeypatch.setattr(Uvc, "exposure_s", exposure_s)
    monkeypatch.setattr(Uvc, "transfer_s", transfer_s)
    camera = backend("camera", "opencv")
    with camera(camera.Settings(exposure_s=exposure_s)) as device:
        for pause_s in (0.0, 0.02, 0.09, 0.1, 0.17):
            time.sleep(pause_s)
            asked_s = time.monotonic()
            device.capture()
            assert device._capture.begun_s >= asked_s


def test_how_long_frames_are_under_way_is_measured(monkeypatch):
    from weldscan.devices.projectors import Projector, ProjectorSettings
    from weldscan.station import check

    class Beam(Projector):
        name, settings = "beam", ProjectorSettings(latency_s=0.0, guard_frames=0, width=8, height=8)

        def _show(self, image):
            now_s = time.monotonic()
            Uvc.wall.append((now_s, 20 + int(image[0, 0]) // 2))
            return now_s

        def close(self):
            pass

    monkeypatch.setattr(cv2, "VideoCapture", Uvc)
    monkeypatch.setattr(Uvc, "wall", [])
    monkeypatch.setattr(check, "REST_S", 0.0)
    camera = backend("camera", "opencv")
    with camera(camera.Settings(exposure_s=0.002)) as device:
        found = check.transfer_s(device, Beam(), 3)
    assert min(found) >= Uvc.transfer_s
    assert min(found) < Uvc.transfer_s + 2 * Uvc.period_s + 0.05
    with camera(camera.Settings(exposure_s=0.002, transfer_s=max(found))) as device:
        for _ in range(5):
            asked_s = time.monotonic()
            device.capture()
            assert device._capture.begun_s >= asked_s


def test_opencv_settings_that_are_not_taken(monkeypatch):
    camera = backend("camera", "opencv")
    for key in (cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_EXPOSURE, cv2.CAP_PROP_GAIN, cv2.CAP_PROP_FRAME_WIDTH):

        class Stubborn(V4l2):
            def __init__(self, device, api, key=key):
                super().__init__(device, api)
                self.refuses = (key,)

        monkeypatch.setattr(cv2, "VideoCapture", Stubborn)
        with pytest.raises(DeviceError, match=" is "):
            camera(camera.Settings(gain=3.0, width=WIDTH, height=HEIGHT))


def test_opencv_unplugged(scene, request, monkeypatch):
    with open_camera("opencv", scene, request, monkeypatch) as camera:
        camera.capture()
        camera._capture.unplugged = True
        with pytest.raises(DeviceError, match="unplugged"):
            camera.capture()


def test_opencv_that_waits_for_ever(scene, request, monkeypatch):
    """As OpenCV does for 10 s when the frames of a camera stop coming."""
    with open_camera("opencv", scene, request, monkeypatch, timeout_s=0.3) as camera:
        camera.capture()
        monkeypatch.setattr(camera._capture, "grab", lambda: time.sleep(2.0))
        start = time.monotonic()
        with pytest.raises(DeviceTimeout, match="unplugged"):
            camera.capture()
        assert time.monotonic() - start < 1.5


def test_opencv_nothing_there(monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", V4l2)
    camera = backend("camera", "opencv")
    with pytest.raises(DeviceError, match="cannot be opened"):
        camera(camera.Settings(device=5))
    with pytest.raises(DeviceError, match="hardware trigger"):
        camera(camera.Settings(trigger="hardware"))


# --- the face ---------------------------------------------------------------------------------------------------------


class Broken(Camera):
    """Tears, or gives what is no image."""

    name = "broken"

    def __init__(self, results, **settings):
        self.settings = CameraSettings(**{"timeout_s": 0.2, "retries": 3, **settings})
        self.results = iter(results)

    def _set_exposure(self, exposure_s):
        return exposure_s * 1.5

    def _grab(self, deadline_s):
        result = next(self.results)
        if isinstance(result, Exception):
            raise result
        return result

    def _close(self):
        pass


def test_torn_frames_are_retried_and_never_given():
    good = np.zeros((4, 6), np.uint8)
    frame = Broken([TornFrame("x"), TornFrame("x"), good]).capture()
    assert frame.retries == 2
    assert frame.image is good
    with pytest.raises(DeviceError, match="4 torn frames"):
        Broken([TornFrame("x")] * 9).capture()


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_a_frame_carries_its_full_scale(bits):
    full = 2**bits - 1
    dark, bright = np.full((4, 6), 201, np.uint16), np.full((4, 6), full, np.uint16)
    told = Broken([dark, bright], bits=bits)
    assert [told.capture().full_scale for _ in range(2)] == [full, full]
    seen = Broken([dark, bright, dark])
    assert [seen.capture().full_scale for _ in range(3)] == [255, full, full]
    shifted = Broken([bright << (16 - bits)])
    assert shifted.capture().full_scale == full << (16 - bits)
    assert Broken([dark.astype(np.uint8)]).capture().full_scale == 255


def test_a_number_beyond_the_full_scale_is_no_frame():
    with pytest.raises(DeviceError, match="5000, beyond the full scale of 4095"):
        Broken([np.full((4, 6), 5000, np.uint16)], bits=12).capture()


@pytest.mark.parametrize("name", ["aravis", "pylon"])
@pytest.mark.parametrize("bits", [10, 12])
def test_the_pixel_format_says_the_full_scale(name, bits, scene, request, monkeypatch):
    if name == "aravis":
        pytest.skip("the fake camera has 8 and 16 bits")
    with open_camera(name, scene, request, monkeypatch, pixel_format=f"Mono{bits}") as camera:
        frame = camera.capture()
        assert (frame.image.dtype, frame.full_scale) == (np.uint16, 2**bits - 1)


def test_what_is_dark_for_twelve_bits_is_dark():
    from weldscan.station.check import overlay

    frame = Broken([np.array([[180, 2000, 4095]], np.uint16)], bits=12).capture()
    blue, grey, red = overlay(frame)[0].tolist()
    assert (blue, grey, red) == ([160, 0, 0], [124, 124, 124], [0, 0, 255])


@pytest.mark.parametrize(
    "image", [np.zeros((4, 6, 3), np.uint8), np.zeros((4, 6), np.float32), np.zeros((0, 6), np.uint8)]
)
def test_no_image(image):
    with pytest.raises(DeviceError, match="no grey image"):
        Broken([image]).capture()


def test_size_that_changes():
    camera = Broken([np.zeros((4, 6), np.uint8), np.zeros((4, 8), np.uint8)])
    camera.capture()
    with pytest.raises(DeviceError, match="8x4, not 6x4"):
        camera.capture()


def test_exposure_that_is_not_taken():
    with pytest.raises(DeviceError, match="15 ms, not 10 ms"):
        Broken([]).set_exposure(0.01)


def test_folder_without_images(tmp_path):
    camera = backend("camera", "folder")
    with pytest.raises(DeviceError, match="no PNG"):
        camera(camera.Settings(folder=tmp_path))


def test_folder_that_ends_and_damaged_image(scene):
    camera = backend("camera", "folder")
    (scene / "002.png").write_bytes(b"not a PNG")
    device = camera(camera.Settings(folder=scene))
    device.capture()
    device.capture()
    with pytest.raises(DeviceError, match="002"):
        device.capture()
    device.capture()
    with pytest.raises(DeviceTimeout, match="no image left"):
        device.capture()


def test_extras_that_are_missing_say_so(monkeypatch):
    import sys

    for name, module in (("aravis", "gi"), ("pylon", "pypylon")):
        monkeypatch.setitem(sys.modules, module, None)
        camera = backend("camera", name)
        with pytest.raises(DeviceError, match=rf"weldscan\[{name}\]"):
            camera(camera.Settings())
