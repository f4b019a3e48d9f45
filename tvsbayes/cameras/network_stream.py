"""A network camera read continuously by a separate thread, so that a caller always gets the newest frame.

An unread stream fills the buffers of both computers with old frames, and many servers drop a client that is idle for
some seconds, as during a homing. The thread reads every frame and drops it; a caller gets the next frame that arrives.
A stream that ends is opened again, but only after at least one frame.

Only the thread uses the capture: other threads send it requests. Names with `_s` are in seconds.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any, Protocol

from tvsbayes.errors import TvsError

FRAME_WAIT_S = 20.0
"""Longest wait for a frame: opening and reading each have a time limit of 5 s."""


class Capture(Protocol):
    """The part of `cv2.VideoCapture` that is used."""

    def grab(self) -> bool:
        """Take the next frame from the driver."""

    def retrieve(self) -> tuple[bool, Any]:
        """Decode the frame taken last."""

    def get(self, prop: int) -> float:
        """A property; 0 or -1 if there is none."""

    def set(self, prop: int, value: float) -> bool:
        """Set a property; returns whether the driver accepted it."""

    def getBackendName(self) -> str:
        """Name of OpenCV's backend."""

    def release(self) -> None:
        """Release the device."""


class NetworkStream:
    """A `Capture` whose frames are always the newest.

    Args:
        open_stream: opens the stream, and opens it again after it has ended.

    Raises:
        DeviceFault: it cannot be opened.
    """

    def __init__(self, open_stream: Callable[[], Capture]):
        self._open = open_stream
        self._capture = open_stream()
        self._frame_event = threading.Condition()
        self._wanted, self._stopped, self._ended = False, False, False
        self._picture: tuple[bool, Any] = (False, None)
        self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.reopened = 0
        """Number of times the stream was opened again."""
        self._thread = threading.Thread(target=self._read, name="network stream", daemon=True)
        self._thread.start()

    def grab(self) -> bool:
        """Wait for the next frame; False once the stream has finally ended."""
        with self._frame_event:
            self._wanted = not self._ended
            return self._frame_event.wait_for(lambda: not self._wanted, FRAME_WAIT_S) and not self._ended

    def retrieve(self) -> tuple[bool, Any]:
        """The frame that `grab` waited for."""
        return self._picture

    def get(self, prop: int) -> float:
        """See `Capture.get`; 0 once the stream has ended."""
        return float(self._ask(lambda: self._capture.get(prop), 0.0))

    def set(self, prop: int, value: float) -> bool:
        """See `Capture.set`; False once the stream has ended."""
        return bool(self._ask(lambda: self._capture.set(prop, value), False))

    def getBackendName(self) -> str:
        """See `Capture.getBackendName`."""
        return str(self._ask(self._capture.getBackendName, ""))

    def release(self) -> None:
        """Stop reading and close the stream."""
        self._stopped = True
        self._thread.join(FRAME_WAIT_S)

    def _ask(self, request: Callable[[], Any], default: Any) -> Any:
        """Run a request on the thread between two frames and return its answer."""
        answers: list[Any] = []
        answered = threading.Event()

        def answer() -> None:
            answers.append(request())
            answered.set()

        self._requests.put(answer)
        while not answered.wait(0.05):
            if self._ended or not self._thread.is_alive():
                return default
        return answers[0]

    def _read(self) -> None:
        """Run the thread: read all frames until the stream has finally ended."""
        reopen = False
        try:
            while not self._stopped:
                while not self._requests.empty():
                    self._requests.get()()
                if self._capture.grab():
                    reopen = True
                    self._hand_over()
                elif reopen and not self._stopped:
                    # The connection is lost: open it again, but not twice without a frame in between.
                    reopen = False
                    self._capture.release()
                    self._capture = self._open()
                    self.reopened += 1
                else:
                    break
        except TvsError:
            # The stream cannot be opened again: `grab` then returns False, as for any camera without frames.
            pass
        finally:
            self._capture.release()
            with self._frame_event:
                self._ended, self._wanted = True, False
                self._frame_event.notify_all()

    def _hand_over(self) -> None:
        with self._frame_event:
            if self._wanted:
                self._picture = self._capture.retrieve()
                self._wanted = False
                self._frame_event.notify_all()
