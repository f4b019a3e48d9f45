"""What somebody asks of a run while it goes on: a short queue between a page's thread and the engine's.

Who asks never waits for the engine, and the engine looks into the queue between two looks; only its own pauses wait
for what comes next. Seconds where a name says `_s`.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace

PAUSE, RESUME, STOP, LASER_OFF = "pause", "resume", "stop", "laser off"
REQUESTS = (PAUSE, RESUME, STOP, LASER_OFF)
CONTROL_PASSED = "control passed on"
"""No request of a page but news for the journal: another browser controls."""
KEPT_MAX = 20
"""Settled requests that are still told of."""
REQUESTED, ACKNOWLEDGED, FAILED = "requested", "acknowledged", "failed"


@dataclass(frozen=True)
class Request:
    """What was asked for, and what became of it.

    Attributes:
        number: from 1, in the order in which they came.
        what: one of `REQUESTS`, or `CONTROL_PASSED`.
        asked_s: when, by this computer's steady clock.
        state: requested, acknowledged (the device has answered and the journal holds it), or failed.
        waited_s: from asking to the answer, None while it waits.
        answer: what the device said, or why it did not.
    """

    number: int
    what: str
    asked_s: float
    state: str = REQUESTED
    waited_s: float | None = None
    answer: str = ""


class Requests:
    """Those of one run, each kind waiting once at most; safe between threads. Only `wait` waits."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._all: tuple[Request, ...] = ()
        self._count = 0
        self._closed = False

    def ask(self, what: str) -> Request | None:
        """A new request; one that waits already is not made a second time. None once the run has ended.

        Whatever stops the run or its light withdraws a resume that still waits: the last word counts, though laser off
        goes before all others.

        Raises:
            ValueError: neither one of `REQUESTS` nor `CONTROL_PASSED`.
        """
        if what not in (*REQUESTS, CONTROL_PASSED):
            raise ValueError(what)
        with self._changed:
            if what not in (RESUME, CONTROL_PASSED):
                for request in self._waiting():
                    if request.what == RESUME:
                        self.settle(request, FAILED, f"withdrawn: {what} was asked for after it")
            waiting = self._waiting()
            for request in waiting:
                if request.what == what:
                    return request
            if self._closed:
                return None
            self._count += 1
            made = Request(self._count, what, time.monotonic())
            settled = [request for request in self._all if request.state != REQUESTED]
            self._all = (*settled[-KEPT_MAX:], *waiting, made)
            self._changed.notify_all()
            return made

    def _waiting(self) -> tuple[Request, ...]:
        return tuple(request for request in self._all if request.state == REQUESTED)

    def next(self, what: str | None = None) -> Request | None:
        """The oldest that waits, of one kind where one is named; laser off goes before all others."""
        waiting = [request for request in self._waiting() if what in (None, request.what)]
        return min(waiting, key=lambda request: (request.what != LASER_OFF, request.number), default=None)

    def settle(self, request: Request, state: str, answer: str) -> Request:
        """Write down what became of a request."""
        settled = replace(request, state=state, waited_s=time.monotonic() - request.asked_s, answer=answer)
        with self._changed:
            self._all = tuple(settled if one.number == request.number else one for one in self._all)
        return settled

    def close(self, answer: str) -> None:
        """The run has ended: what still waits is not carried out, and nothing new is taken."""
        with self._changed:
            self._closed = True
            for request in self._waiting():
                self.settle(request, FAILED, answer)

    def told(self) -> tuple[Request, ...]:
        """The last ones, oldest first."""
        return self._all

    def wait(self, longest_s: float) -> None:
        """Until something new is asked for, or so long."""
        with self._changed:
            if not self._waiting():
                self._changed.wait(longest_s)
