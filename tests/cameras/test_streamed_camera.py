"""The streamed camera: its MJPEG stream over the loopback, to the pictures of a camera."""

from __future__ import annotations

import itertools
import os
import socket

import numpy as np
import pytest
from support.streamed_camera import StreamedCamera

from tvsbayes.cameras.capture import StereoImage, open_cameras, open_capture
from tvsbayes.errors import DeviceFault

WIDTH, HEIGHT = 64, 48


def test_a_silent_viewer_does_not_block_the_streamed_camera(monkeypatch):
    monkeypatch.setattr("support.streamed_camera.VIEWER_TIMEOUT_S", 0.2)
    with StreamedCamera(lambda: None) as virtual:
        host, port = virtual.address.split("/")[2].split(":")
        silent = socket.create_connection((host, int(port)))
        # Connections are accepted in order: an answer to the second means that the first is being served.
        with socket.create_connection((host, int(port))) as other:
            other.sendall(b"GET /nothing HTTP/1.0\r\n\r\n")
            assert b"404" in other.recv(100)
    silent.close()


def test_streamed_camera_without_a_port_leaves_the_environment_alone(monkeypatch):
    monkeypatch.setenv("no_proxy", "example.org")

    def no_port(*_):
        raise OSError("no port is free")

    monkeypatch.setattr("support.streamed_camera.ThreadingHTTPServer.server_bind", no_port)
    with pytest.raises(OSError, match="no port"), StreamedCamera(lambda: None):
        pass
    assert os.environ["no_proxy"] == "example.org"


def test_stream_over_http_from_rendering_to_pictures(monkeypatch):
    """Every frame has its number as grey level on both sides; a grab never returns one rendered before it.

    FFmpeg does not use a proxy of the environment for the loopback address.
    """
    monkeypatch.setenv("http_proxy", "http://proxy.invalid:3128")
    monkeypatch.delenv("no_proxy", raising=False)
    numbers, rendered = itertools.count(1), []

    def render():
        number = next(numbers)
        rendered.append(number)
        pair = [np.full((HEIGHT, WIDTH, 3), 3 * (number % 80) + offset, np.uint8) for offset in (0, 10)]
        return StereoImage(*pair)

    with StreamedCamera(render, frames_per_s=40) as virtual:
        camera = open_cameras({"source": virtual.address}, WIDTH, HEIGHT)
        for _ in range(3):
            before = rendered[-1]
            image = camera.grab()
            left, right = image.left.mean(), image.right.mean()
            # Grey levels survive a JPEG of quality 97 within one.
            assert right - left == pytest.approx(10, abs=1)
            number = round(left / 3)
            assert (number - before) % 80 >= 1 and (number - before) % 80 < 40
            assert image.left.std() < 1
        camera.close()
    assert "no_proxy" not in os.environ
    with pytest.raises(DeviceFault):
        open_capture("http://127.0.0.1:9/stereo.mjpg")
