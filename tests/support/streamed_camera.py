"""A stereo camera in software: serves what is rendered as an MJPEG stream over HTTP on this computer.

A simulated instrument is seen by it through the camera code of the bench. Seconds where a name says `_s`.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np

from tvsbayes.cameras.capture import StereoImage

VIEWER_TIMEOUT_S = 10.0
"""A viewer that takes nothing for so long has gone."""
JPEG_QUALITY = 97


@dataclass
class StreamedCamera:
    """A camera in software: serves what `render` returns as an MJPEG stream over HTTP on this computer.

    Each frame is rendered when it is due, as a sensor would expose it. Use it as a context manager.

    Attributes:
        render: returns a StereoImage; called from the serving thread, one call at a time.
        frames_per_s: rate of exposures.
    """

    render: Callable[[], StereoImage]
    frames_per_s: float = 30.0
    failure: Exception | None = field(default=None, init=False)
    """What `render` raised; it ends the stream, and is raised again when the camera is left."""
    _server: ThreadingHTTPServer | None = field(default=None, init=False, repr=False)
    _thread: threading.Thread | None = field(default=None, init=False, repr=False)
    _stop: threading.Event = field(default_factory=threading.Event, init=False, repr=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False, repr=False)
    _no_proxy: str | None = field(default=None, init=False, repr=False)

    @property
    def address(self) -> str:
        """Where the stream is served, for `[cameras] source`."""
        if self._server is None:
            raise RuntimeError("the streamed camera is not running")
        return f"http://127.0.0.1:{self._server.server_address[1]}/stereo.mjpg"

    def jpeg(self) -> bytes:
        """The next frame: both pictures side by side."""
        import cv2

        with self._lock:
            pair = self.render()
        both = np.hstack((pair.left, pair.right))
        return cv2.imencode(".jpg", both, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()

    def __enter__(self) -> StreamedCamera:
        camera = self

        class Handler(BaseHTTPRequestHandler):
            # Of the connection: without it a viewer that neither reads nor closes would hold `__exit__` for ever.
            timeout = VIEWER_TIMEOUT_S

            def do_GET(self) -> None:
                camera._serve(self)

            def log_message(self, format: str, *arguments: object) -> None:
                """Requests are no news."""

        self._stop.clear()
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = False
        # Behind the bind, which may fail: then it would stay changed.
        # FFmpeg, which OpenCV opens the address with, uses the proxy of the environment even for this computer.
        self._no_proxy = os.environ.get("no_proxy")
        os.environ["no_proxy"] = ",".join(filter(None, (self._no_proxy, "127.0.0.1")))
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        assert self._server is not None and self._thread is not None
        self._server.shutdown()
        self._thread.join()
        # Waits for the streams, which end at the next frame.
        self._server.server_close()
        self._server = None
        if self._no_proxy is None:
            os.environ.pop("no_proxy", None)
        else:
            os.environ["no_proxy"] = self._no_proxy
        if self.failure is not None:
            raise self.failure

    def _serve(self, request: BaseHTTPRequestHandler) -> None:
        if not request.path.endswith(".mjpg"):
            request.send_error(404)
            return
        request.send_response(200)
        request.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        request.end_headers()
        period_s = 1 / self.frames_per_s
        due_s = time.monotonic()
        try:
            while not self._stop.wait(max(due_s - time.monotonic(), 0.0)):
                try:
                    data = self.jpeg()
                except Exception as error:
                    self.failure = error
                    return
                head = b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(data)
                request.wfile.write(head + data + b"\r\n")
                # A late frame shifts the following ones: a sensor does not expose twice at once.
                due_s = max(due_s + period_s, time.monotonic() + period_s / 2)
        except OSError:
            # The viewer has gone.
            return
