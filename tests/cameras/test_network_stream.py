"""Network streams: read continuously, opened again when they end."""

from __future__ import annotations

import itertools
import threading

import numpy as np
import pytest
from support import streamed_camera
from support.streamed_camera import streamed

from tvsbayes.cameras.capture import StereoImage, open_cameras, open_capture
from tvsbayes.cameras.network_stream import NetworkStream
from tvsbayes.errors import DeviceFault

WAIT_S = 20.0
"""Bound on what takes milliseconds."""


class Stream:
    """Frames 0, 1, 2, ... without delay; it ends after `length` and waits while `gate` is closed."""

    def __init__(self, length: int = 10**9):
        self.length, self.frames, self.released = length, 0, False
        self.many, self.gate = threading.Event(), threading.Event()
        self.gate.set()

    def grab(self) -> bool:
        self.gate.wait(WAIT_S)
        self.frames += 1
        if self.frames > 100:
            self.many.set()
        return self.frames <= self.length

    def retrieve(self):
        return True, self.frames

    def get(self, prop: int) -> float:
        return 7.0 + prop

    def set(self, prop: int, value: float) -> bool:
        return value > 0

    def getBackendName(self) -> str:
        return "FFMPEG"

    def release(self) -> None:
        self.released = True


def test_frames_are_read_continuously_and_the_newest_is_returned():
    inner = Stream()
    stream = NetworkStream(lambda: inner)
    assert inner.many.wait(WAIT_S), "a hundred frames are read although nobody wants one"
    inner.gate.clear()
    before = inner.frames
    inner.gate.set()
    assert stream.grab() and stream.retrieve()[1] >= before
    first = stream.retrieve()[1]
    assert stream.grab() and stream.retrieve()[1] > first
    assert (stream.get(2), stream.set(1, 5.0), stream.set(1, -5.0)) == (9.0, True, False)
    assert stream.getBackendName() == "FFMPEG"
    stream.release()
    assert inner.released


def _gone():
    raise DeviceFault("camera", "gone", remedy="plug it in")


@pytest.mark.parametrize("again", [lambda: Stream(0), _gone], ids=["no frame", "not opened"])
def test_a_stream_that_cannot_be_reopened_gives_no_frame(again):
    first = Stream(3)
    attempts = iter([lambda: first, again])
    stream = NetworkStream(lambda: next(attempts)())
    for _ in range(5):
        if not stream.grab():
            break
    else:
        pytest.fail("a stream that has ended delivers frames")
    assert not stream.grab() and stream.get(1) == 0.0 and not stream.set(1, 1.0)
    stream.release()


@pytest.mark.thorough
def test_a_server_that_drops_idle_viewers_is_read_continuously(monkeypatch):
    """As during a homing: no grab until the server has sent more than all buffers hold."""
    monkeypatch.setattr(streamed_camera, "VIEWER_TIMEOUT_S", 0.3)
    rng = np.random.default_rng(0)
    # Noise does not compress: 120 kB a frame, of which sockets hold a hundred at most.
    pair = StereoImage(*(rng.integers(0, 255, (240, 320, 3), dtype=np.uint8) for _ in range(2)))
    sent, much = [0], threading.Event()

    def render() -> StereoImage:
        sent[0] += 1
        if sent[0] > 300:
            much.set()
        return pair

    with streamed(render, frames_per_s=200.0) as address:
        camera = open_cameras({"source": address}, 320, 240)
        assert much.wait(WAIT_S), "the server sends as long as we read"
        assert camera.grab().left.shape == (240, 320, 3)
        camera.close()


def test_a_stream_over_http_from_rendering_to_pictures(monkeypatch):
    """Every frame has its number as grey level on both sides; a grab never returns one rendered before it."""
    monkeypatch.setenv("http_proxy", "http://proxy.invalid:3128")
    numbers, rendered = itertools.count(1), []

    def render() -> StereoImage:
        rendered.append(next(numbers))
        return StereoImage(*(np.full((48, 64, 3), 3 * (rendered[-1] % 80) + offset, np.uint8) for offset in (0, 10)))

    with streamed(render, frames_per_s=40) as address:
        camera = open_cameras({"source": address}, 64, 48)
        for _ in range(3):
            before = rendered[-1]
            image = camera.grab()
            left, right = image.left.mean(), image.right.mean()
            # Grey levels survive a JPEG of quality 97 within one.
            assert right - left == pytest.approx(10, abs=1)
            assert 1 <= (round(left / 3) - before) % 80 < 40
            assert image.left.std() < 1
        camera.close()
    with pytest.raises(DeviceFault):
        open_capture("http://127.0.0.1:9/stereo.mjpg")
