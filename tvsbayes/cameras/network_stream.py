"""A camera on the network, read all the time by a thread of its own, so that only the newest frame is ever handed on.

A stream that nobody reads fills the buffers of both computers with old frames, and many servers drop a viewer who is
idle for some seconds, as during a homing. The thread takes every frame as it comes and lets it go; a caller gets
the next one that arrives. Where the stream ends it is opened again, once for every frame that came.

The capture belongs to the thread: everything else is asked of it. Seconds where a name says `_s`.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any, Protocol

from tvsbayes.errors import TvsError

FRAME_WAIT_S = 20.0
"""Longest wait for a frame: opening again and reading each end after 5 s by themselves."""


class Capture(Protocol):
    """The part of `cv2.VideoCapture` that is used."""

    def grab(self) -> bool:
        """Take the next frame from the driver."""

    def retrieve(self) -> tuple[bool, Any]:
        """Decode the frame taken last."""

    def get(self, prop: int) -> float:
        """A property; 0 or -1 where there is none."""

    def set(self, prop: int, value: float) -> bool:
        """Set a property; whether the driver took it."""

    def getBackendName(self) -> str:
        """Through which of OpenCV's backends it is open."""

    def release(self) -> None:
        """Give the device back."""


class NetworkStream:
    """A `Capture` whose frames are always the newest.

    Args:
        open_stream: opens the stream, also again after it has ended.

    Raises:
        DeviceFault: it cannot be opened.
    """

    def __init__(self, open_stream: Callable[[], Capture]):
        self._open = open_stream
        self._capture = open_stream()
        self._news = threading.Condition()
        self._wanted, self._stopped, self._over = False, False, False
        self._picture: tuple[bool, Any] = (False, None)
        self._questions: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.reopened = 0
        """How often the stream had to be opened again."""
        self._thread = threading.Thread(target=self._read, name="network stream", daemon=True)
        self._thread.start()

    def grab(self) -> bool:
        """Wait for the next frame that arrives; False once the stream has ended for good."""
        with self._news:
            self._wanted = not self._over
            return self._news.wait_for(lambda: not self._wanted, FRAME_WAIT_S) and not self._over

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

    def _ask(self, question: Callable[[], Any], otherwise: Any) -> Any:
        """What the thread answers between two frames."""
        answers: list[Any] = []
        answered = threading.Event()

        def answer() -> None:
            answers.append(question())
            answered.set()

        self._questions.put(answer)
        while not answered.wait(0.05):
            if self._over or not self._thread.is_alive():
                return otherwise
        return answers[0]

    def _read(self) -> None:
        """The thread: every frame as it comes, until the stream has ended for good."""
        fresh = False
        try:
            while not self._stopped:
                while not self._questions.empty():
                    self._questions.get()()
                if self._capture.grab():
                    fresh = True
                    self._hand_over()
                elif fresh and not self._stopped:
                    # Dropped: opened again, but not twice without a frame in between.
                    fresh = False
                    self._capture.release()
                    self._capture = self._open()
                    self.reopened += 1
                else:
                    break
        except TvsError:
            # It cannot be opened again: anyone who waits hears of it as of any camera without frames.
            pass
        finally:
            self._capture.release()
            with self._news:
                self._over, self._wanted = True, False
                self._news.notify_all()

    def _hand_over(self) -> None:
        with self._news:
            if self._wanted:
                self._picture = self._capture.retrieve()
                self._wanted = False
                self._news.notify_all()
