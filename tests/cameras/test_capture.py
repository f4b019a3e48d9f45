"""Cameras: no frame older than the request, settings read back."""

from __future__ import annotations

import os

import cv2
import numpy as np
import pytest

from tvsbayes.acquisition.simulated_instrument import VirtualClock
from tvsbayes.cameras.capture import OpenCVCamera, open_cameras, open_capture
from tvsbayes.errors import DeviceFault, InputError

WIDTH, HEIGHT = 64, 48


class FakeCapture:
    """A camera of 30 frames/s with a buffer and a transfer delay; every picture stores the time of its exposure.

    Pixel (0, 0) holds the exposure's start in ms, modulo 65536, in its first two channels.
    """

    decode_s, backend = 0.001, "V4L2"

    def __init__(self, clock, buffered=4, transfer_s=0.02, period_s=1 / 30, width=2 * WIDTH, obeys=True):
        self.clock, self.buffered, self.transfer_s, self.period_s = clock, buffered, transfer_s, period_s
        self.width, self.obeys, self.properties, self.next = width, obeys, {}, 0
        self.released = False

    def grab(self):
        newest = int((self.clock.monotonic() - self.transfer_s) / self.period_s) - 1
        self.next = max(self.next, newest - self.buffered + 1)
        ready_s = (self.next + 1) * self.period_s + self.transfer_s
        self.clock.sleep(max(ready_s - self.clock.monotonic(), 0.0) + self.decode_s)
        self.current = self.next
        self.next += 1
        return True

    def retrieve(self):
        picture = np.zeros((HEIGHT, self.width, 3), np.uint8)
        exposed_ms = round(self.current * self.period_s * 1000)
        picture[0, 0, :2] = exposed_ms % 256, exposed_ms // 256
        return True, picture

    def get(self, prop):
        return self.properties.get(prop, 0.0)

    def set(self, prop, value):
        if self.obeys:
            self.properties[prop] = value
        return self.obeys

    def getBackendName(self):
        return self.backend

    def release(self):
        self.released = True


def exposed_s(picture) -> float:
    return (int(picture[0, 0, 0]) + 256 * int(picture[0, 0, 1])) / 1000


@pytest.mark.parametrize("buffered", [1, 2, 4, 16, 60])
@pytest.mark.parametrize("transfer_s", [0.0, 0.02, 0.03])
@pytest.mark.parametrize("decode_s", [0.001, 0.015])
def test_no_frame_is_older_than_the_request(buffered, transfer_s, decode_s):
    clock = VirtualClock()
    capture = FakeCapture(clock, buffered, transfer_s)
    capture.decode_s = decode_s
    camera = OpenCVCamera([capture], WIDTH, HEIGHT, clock=clock)
    for pause_s in (0.0, 0.004, 0.011, 0.3, 5.0, 0.029, 0.033, 0.001):
        clock.sleep(pause_s)
        asked_s = clock.monotonic()
        image = camera.grab()
        assert exposed_s(image.left) >= asked_s - 0.001, (buffered, transfer_s, pause_s)
        assert clock.monotonic() - asked_s < (2 * buffered + 5) / 30
    camera.close()
    assert capture.released


def test_without_flushing_the_frames_would_be_old():
    """Control of the test above: the next frame without flushing is older than its request."""
    clock = VirtualClock()
    capture = FakeCapture(clock)
    clock.sleep(1.0)
    capture.grab()
    assert exposed_s(capture.retrieve()[1]) < 0.9


def test_camera_that_returns_without_waiting_is_refused():
    clock = VirtualClock()
    camera = OpenCVCamera([FakeCapture(clock, period_s=1e-6)], WIDTH, HEIGHT, clock=clock)
    with pytest.raises(DeviceFault) as caught:
        camera.grab()
    assert caught.value.code == "stale"


def test_both_of_two_devices_are_flushed():
    clock = VirtualClock()
    pair = [FakeCapture(clock, 3, width=WIDTH), FakeCapture(clock, 40, 0.03, width=WIDTH)]
    camera = OpenCVCamera(pair, WIDTH, HEIGHT, clock=clock)
    clock.sleep(2.0)
    asked_s = clock.monotonic()
    image = camera.grab()
    assert min(exposed_s(image.left), exposed_s(image.right)) >= asked_s - 0.001
    assert image.left.shape == image.right.shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("shape", ((HEIGHT, 2 * WIDTH), (HEIGHT, 2 * WIDTH, 1), (HEIGHT, 2 * WIDTH, 3)))
def test_deep_and_monochrome_pictures_are_kept(shape):
    """16 bits stay 16 bits; one channel becomes three alike."""
    deep = np.random.default_rng(2).integers(0, 65535, shape).astype(np.uint16)
    capture = FakeCapture(VirtualClock())
    capture.retrieve = lambda: (True, deep)
    pair = OpenCVCamera([capture], WIDTH, HEIGHT, clock=capture.clock).grab()
    both = np.hstack([pair.left, pair.right])
    assert both.dtype == np.uint16 and both.shape == (HEIGHT, 2 * WIDTH, 3)
    np.testing.assert_array_equal(both, np.broadcast_to(deep.reshape(HEIGHT, 2 * WIDTH, -1), both.shape))


def test_settings_are_fixed_and_read_back():
    clock = VirtualClock()
    capture = FakeCapture(clock)
    camera = OpenCVCamera([capture], WIDTH, HEIGHT, exposure=-6.0, clock=clock)
    values = camera.settings().values
    assert values["stereo.exposure"] == -6.0 and values["stereo.auto_exposure"] == 1.0
    assert capture.properties[cv2.CAP_PROP_AUTO_WB] == 0 == capture.properties[cv2.CAP_PROP_AUTOFOCUS]
    assert capture.properties[cv2.CAP_PROP_FRAME_WIDTH] == 2 * WIDTH and camera.settings().warnings == ()


@pytest.mark.parametrize(("backend", "manual"), [("V4L2", 1), ("DSHOW", 0), ("MSMF", 0)])
def test_automatic_exposure_is_off_on_every_backend(backend, manual):
    """DirectShow takes 1 for automatic, Video4Linux for manual; there 0 is automatic."""
    clock = VirtualClock()
    capture = FakeCapture(clock)
    capture.backend = backend
    OpenCVCamera([capture], WIDTH, HEIGHT, clock=clock)
    assert capture.properties[cv2.CAP_PROP_AUTO_EXPOSURE] == manual


def test_settings_that_cannot_be_fixed_are_reported():
    clock = VirtualClock()
    camera = OpenCVCamera([FakeCapture(clock, obeys=False)], WIDTH, HEIGHT, clock=clock)
    assert "automatic exposure, white balance, focus" in camera.settings().warnings[0]
    with pytest.raises(DeviceFault) as caught:
        OpenCVCamera([capture := FakeCapture(clock, obeys=False)], WIDTH, HEIGHT, exposure=10.0, clock=clock)
    assert caught.value.code == "exposure" and capture.released


def test_wrong_size_and_no_frame_are_named():
    clock = VirtualClock()
    camera = OpenCVCamera([FakeCapture(clock, width=WIDTH)], WIDTH, HEIGHT, clock=clock)
    with pytest.raises(DeviceFault, match="64 x 48 px; 128 x 48 px were calibrated"):
        camera.grab()
    silent = FakeCapture(clock)
    silent.grab = lambda: False  # from the first frame on
    with pytest.raises(DeviceFault) as caught:
        OpenCVCamera([silent], WIDTH, HEIGHT, clock=clock).grab()
    assert caught.value.code == "no-frame"


def test_cameras_of_a_rig_file():
    clock, opened = VirtualClock(), []

    def opener(source):
        opened.append(source)
        return FakeCapture(clock, width=WIDTH)

    open_cameras({"left": 0, "right": "/dev/video2"}, WIDTH, HEIGHT, opener, clock)
    assert opened == [0, "/dev/video2"]
    for table in ({}, {"left": 0}, {"source": 0, "left": 0, "right": 1}):
        with pytest.raises(InputError):
            open_cameras(table, WIDTH, HEIGHT, opener, clock)
    with pytest.raises(InputError):
        open_capture("file:///etc/passwd")
    for source in ("99999999999", "\u00b2"):
        with pytest.raises(DeviceFault, match="cannot be opened"):
            open_capture(source)


@pytest.mark.parametrize("wanted", (None, "7"))
def test_opencv_is_silent_only_while_cameras_are_opened(monkeypatch, wanted):
    """Not where its messages are requested; FFmpeg's variable is restored afterwards."""
    logging, levels = cv2.utils.logging, []
    names = ("OPENCV_LOG_LEVEL", "OPENCV_FFMPEG_LOGLEVEL")
    for name in names:
        monkeypatch.delenv(name, raising=False)
        if wanted is not None:
            monkeypatch.setenv(name, wanted)
    before = logging.getLogLevel()
    assert before != logging.LOG_LEVEL_SILENT

    def absent(source):
        levels.append((logging.getLogLevel(), os.environ.get(names[1])))
        raise DeviceFault("camera", "gone", remedy="plug it in")

    with pytest.raises(DeviceFault):
        open_cameras({"source": 0}, WIDTH, HEIGHT, absent)
    assert levels == [(logging.LOG_LEVEL_SILENT, "-8") if wanted is None else (before, wanted)]
    assert logging.getLogLevel() == before and [os.environ.get(name) for name in names] == [wanted] * 2


@pytest.mark.parametrize("address", ["ftp://eye:secret@10.0.0.2/1", "http://eye:secret@127.0.0.1:9/x.mjpg"])
def test_no_message_contains_a_password(address):
    with pytest.raises((InputError, DeviceFault), match="camera") as caught:
        open_capture(address)
    assert "secret" not in str(caught.value) and address.partition("@")[2] in str(caught.value)
