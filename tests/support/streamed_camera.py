"""A stereo camera in software: serves what is rendered as an MJPEG stream over HTTP on this computer.

A simulated instrument is seen by it through the camera code of the bench. Seconds where a name says `_s`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np
import pytest

from tvsbayes.cameras.capture import StereoImage

VIEWER_TIMEOUT_S = 10.0
"""A viewer that takes nothing for so long has gone."""
JPEG_QUALITY = 97


@contextmanager
def streamed(render: Callable[[], StereoImage], frames_per_s: float = 30.0) -> Iterator[str]:
    """The address of a stream, for `[cameras] source`, while it is served.

    Each frame, both pictures side by side, is rendered when it is due, as a sensor would expose it.

    Args:
        render: called from the serving thread, one call at a time; what it raises ends the stream, and is raised again
            in the end.
        frames_per_s: rate of exposures.
    """
    stop, one_call, failures = threading.Event(), threading.Lock(), []

    def frame() -> bytes:
        with one_call:
            pair = render()
        picture = np.hstack((pair.left, pair.right))
        data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
        return b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(data) + data + b"\r\n"

    class Handler(BaseHTTPRequestHandler):
        # Of the connection: a viewer that neither reads nor closes would be waited for in the end.
        timeout = VIEWER_TIMEOUT_S

        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            period_s, due_s = 1 / frames_per_s, time.monotonic()
            try:
                while not stop.wait(max(due_s - time.monotonic(), 0.0)):
                    self.wfile.write(frame())
                    # A late frame shifts the following ones: a sensor does not expose twice at once.
                    due_s = max(due_s + period_s, time.monotonic() + period_s / 2)
            except OSError:
                # The viewer has gone.
                return
            except Exception as error:
                failures.append(error)

        def log_message(self, format: str, *arguments: object) -> None:
            """Requests are no news."""

    # Leaving it waits for the streams, which end at the next frame.
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server, pytest.MonkeyPatch.context() as patch:
        server.daemon_threads = False
        # FFmpeg, which OpenCV opens the address with, uses the proxy of the environment even for this computer.
        patch.setenv("no_proxy", "127.0.0.1")
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/stereo.mjpg"
        finally:
            stop.set()
            server.shutdown()
            thread.join()
    if failures:
        raise failures[0]
