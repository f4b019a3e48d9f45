"""Requests to a run: served between two looks; laser off is served at every exchange with the device.

Requests wait in a short queue between a page's thread and the engine's. The page never waits for the engine, and the
engine reads the queue between two looks; only a paused run waits for the next request.

Each request goes to the device first: it is acknowledged once the device has answered and the journal holds an `asked`
event. Pause, stop and laser off switch the laser off, whatever its state. Laser off is also served during a look: the
look is aborted, the run pauses, and the look is repeated after resume. Only resume, stop or Ctrl-C end a pause: if the
page is gone, the laser stays off until a person resumes, and nothing moves after the present step. Seconds where a name
says `_s`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from tvsbayes.acquisition.journal_events import Asked, AskedDevice
from tvsbayes.acquisition.operator import StopKey
from tvsbayes.positioner.interface import HomeReport, Positioner
from tvsbayes.positioner.protocol import DeviceState

PAUSE, RESUME, STOP, LASER_OFF = "pause", "resume", "stop", "laser off"
REQUESTS = (PAUSE, RESUME, STOP, LASER_OFF)
CONTROL_PASSED = "control passed on"
"""An entry for the journal rather than a request: another browser controls."""
KEPT_MAX = 20
"""Largest number of settled requests listed."""
REQUESTED, ACKNOWLEDGED, FAILED = "requested", "acknowledged", "failed"
PAUSE_POLL_S = 0.2
"""Interval at which a paused run checks for Ctrl-C."""


@dataclass(frozen=True)
class Request:
    """A request and its outcome.

    Attributes:
        number: from 1, in the order in which they came.
        what: one of `REQUESTS`, or `CONTROL_PASSED`.
        asked_s: its time on this computer's monotonic clock.
        state: requested, acknowledged (the device has answered and the journal holds it), or failed.
        waited_s: from the request to the answer, None while it waits.
        answer: the device's answer, or the reason why there is none.
    """

    number: int
    what: str
    asked_s: float
    state: str = REQUESTED
    waited_s: float | None = None
    answer: str = ""


class Requests:
    """The requests of one run, at most one of each kind waiting; thread-safe. Only `wait` blocks."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._all: tuple[Request, ...] = ()
        self._count = 0
        self._closed = False

    def ask(self, what: str) -> Request | None:
        """Make a request, or return the waiting one of the same kind; None once the run has ended.

        A request to stop the run or switch its laser off withdraws a waiting resume: the later request counts, and
        laser off precedes all others.

        Raises:
            ValueError: neither one of `REQUESTS` nor `CONTROL_PASSED`.
        """
        if what not in (*REQUESTS, CONTROL_PASSED):
            raise ValueError(what)
        with self._changed:
            if what not in (RESUME, CONTROL_PASSED):
                for request in self._waiting():
                    if request.what == RESUME:
                        self.settle(request, FAILED, f"withdrawn: {what} was requested after it")
            waiting = self._waiting()
            for request in waiting:
                if request.what == what:
                    return request
            if self._closed:
                return None
            self._count += 1
            new = Request(self._count, what, time.monotonic())
            settled = [request for request in self._all if request.state != REQUESTED]
            self._all = (*settled[-KEPT_MAX:], *waiting, new)
            self._changed.notify_all()
            return new

    def _waiting(self) -> tuple[Request, ...]:
        return tuple(request for request in self._all if request.state == REQUESTED)

    def next(self, what: str | None = None) -> Request | None:
        """The oldest waiting request, of kind `what` where given; laser off precedes all others."""
        waiting = [request for request in self._waiting() if what in (None, request.what)]
        return min(waiting, key=lambda request: (request.what != LASER_OFF, request.number), default=None)

    def settle(self, request: Request, state: str, answer: str) -> Request:
        """Record the outcome of a request."""
        settled = replace(request, state=state, waited_s=time.monotonic() - request.asked_s, answer=answer)
        with self._changed:
            self._all = tuple(settled if entry.number == request.number else entry for entry in self._all)
        return settled

    def close(self, answer: str) -> None:
        """End the run's requests: waiting requests fail, and no new ones are accepted."""
        with self._changed:
            self._closed = True
            for request in self._waiting():
                self.settle(request, FAILED, answer)

    def recent(self) -> tuple[Request, ...]:
        """The last requests, oldest first."""
        return self._all

    def wait(self, longest_s: float) -> None:
        """Block until there is a request, or for `longest_s`."""
        with self._changed:
            if not self._waiting():
                self._changed.wait(longest_s)


class LightRefused(Exception):
    """Laser off was requested: the present look is aborted."""


class Control:
    """Carries requests out.

    Args:
        requests: requests to the run.
        positioner: the device itself.
        stop: the stop key, which a request to stop presses.
        write: appends the event to the journal, with its time.
        changed: called when a pause begins or ends, and after every exchange with the device.

    Attributes:
        paused: whether the run is paused.
        device: its last known state, None before the first exchange.
    """

    def __init__(
        self,
        requests: Requests,
        positioner: Positioner,
        stop: StopKey,
        write: Callable[[Asked], None],
        changed: Callable[[], None] = lambda: None,
    ):
        self.paused = False
        self.device: DeviceState | None = None
        self._requests, self._positioner, self._stop = requests, positioner, stop
        self._write, self._changed = write, changed

    def heed(self) -> None:
        """Carries out requests between two steps; returns once the run may continue, or the stop key is pressed.

        Raises:
            DeviceFault: the device does not answer, or the disk refuses.
        """
        self._carry_out_all()
        while self.paused and not self._stop.requested:
            self._requests.wait(PAUSE_POLL_S)
            self._carry_out_all()

    def meanwhile(self) -> bool:
        """Carries out requests while the run waits for a computation; returns whether the run continues afterwards.

        Raises:
            DeviceFault: as `heed`.
        """
        self._carry_out_all()
        return not self._stop.requested

    def darken(self) -> bool:
        """Carries out a request for laser off within a step; returns whether the laser must stay off."""
        request = self._requests.next(LASER_OFF)
        if request is not None:
            self._carry_out(request)
        return self.paused

    def noticed(self, state: DeviceState) -> DeviceState:
        """Keeps and publishes a new state of the device."""
        self.device = state
        self._changed()
        return state

    def _carry_out_all(self) -> None:
        while (request := self._requests.next()) is not None:
            self._carry_out(request)

    def _carry_out(self, request: Request) -> None:
        try:
            only_asks = request.what in (RESUME, CONTROL_PASSED)
            state = self._positioner.state() if only_asks else self._positioner.laser(False)
            if request.what != CONTROL_PASSED:
                self.paused = request.what != RESUME
            if request.what == STOP:
                self._stop.requested = True
            device = AskedDevice(state.status, state.laser_on, state.boot, state.pan_steps, state.tilt_steps)
            self._write(Asked(number=request.number, what=request.what, device=device))
        except BaseException as error:
            self._requests.settle(request, FAILED, str(error) or type(error).__name__)
            raise
        self._requests.settle(request, ACKNOWLEDGED, device_text(state))
        self.noticed(state)


def device_text(state: DeviceState) -> str:
    """A device's state in words."""
    light = "on" if state.laser_on else "off"
    return f"device {state.status} at pan {state.pan_steps}, tilt {state.tilt_steps}, laser {light}"


class HeedingPositioner:
    """A positioner that serves a request for laser off before every exchange; see `Positioner` for the rest.

    Args:
        inner: the device.
        control: control of the run.
    """

    def __init__(self, inner: Positioner, control: Control):
        self._inner, self._control = inner, control

    @property
    def identity(self) -> Mapping[str, str]:
        """See `Positioner.identity`."""
        return self._inner.identity

    @property
    def repeats(self) -> int:
        """See `Positioner.repeats`."""
        return self._inner.repeats

    def home(self) -> HomeReport:
        """See `Positioner.home`."""
        self._control.darken()
        report = self._inner.home()
        self._control.noticed(report.state)
        return report

    def move_to(self, pan_steps: int, tilt_steps: int) -> DeviceState:
        """See `Positioner.move_to`."""
        self._control.darken()
        return self._control.noticed(self._inner.move_to(pan_steps, tilt_steps))

    def laser(self, on: bool) -> DeviceState:
        """See `Positioner.laser`.

        Raises:
            LightRefused: the laser should be switched on, but laser off was requested.
        """
        if self._control.darken() and on:
            raise LightRefused
        return self._control.noticed(self._inner.laser(on))

    def state(self) -> DeviceState:
        """See `Positioner.state`.

        Raises:
            LightRefused: laser off was requested.
        """
        if self._control.darken():
            raise LightRefused
        return self._control.noticed(self._inner.state())

    def close(self) -> None:
        """See `Positioner.close`."""
        self._inner.close()
