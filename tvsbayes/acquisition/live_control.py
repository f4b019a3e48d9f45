"""A run that heeds requests: between two looks, and for the laser at every exchange with the device.

Each request is put to the device first: it counts as acknowledged once the device has answered and the journal holds
an `asked` event. Pause, stop and laser off switch the laser off, whatever it was. Laser off is heeded in the middle of
a look as well: the look is broken off, the run pauses, and the look is taken again after resume. A pause ends by
resume, stop or Ctrl-C only: if the page is gone, no light comes on until a person says so, and nothing moves after the
step under way.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from tvsbayes.acquisition.journal_events import Asked, AskedDevice
from tvsbayes.acquisition.live_requests import (
    ACKNOWLEDGED,
    CONTROL_PASSED,
    FAILED,
    LASER_OFF,
    RESUME,
    STOP,
    Request,
    Requests,
)
from tvsbayes.acquisition.operator import StopKey
from tvsbayes.positioner.interface import HomeReport, Positioner
from tvsbayes.positioner.protocol import DeviceState

PAUSE_POLL_S = 0.2
"""How often a paused run looks whether Ctrl-C was pressed."""


class LightRefused(Exception):
    """The laser was asked to be off: the look under way is broken off."""


class Control:
    """Carries requests out.

    Args:
        requests: what is asked for.
        positioner: the device itself.
        stop: the stop key, which a request to stop presses.
        write: appends the event to the journal, with its time.
        changed: told when a pause begins or ends, and after every exchange with the device.

    Attributes:
        paused: whether the run stands still.
        device: what the device said last, None before it was asked.
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
        """Between two steps: does what was asked for; returns once the run may go on, or the stop key is pressed.

        Raises:
            DeviceFault: the device does not answer, or the disk refuses.
        """
        self._carry_out_all()
        while self.paused and not self._stop.requested:
            self._requests.wait(PAUSE_POLL_S)
            self._carry_out_all()

    def meanwhile(self) -> bool:
        """While the run waits for a computation: does what was asked for; whether the run is to go on afterwards.

        Raises:
            DeviceFault: as `heed`.
        """
        self._carry_out_all()
        return not self._stop.requested

    def darken(self) -> bool:
        """Within a step: carries out a request for laser off; whether light is refused now."""
        request = self._requests.next(LASER_OFF)
        if request is not None:
            self._carry_out(request)
        return self.paused

    def noticed(self, state: DeviceState) -> DeviceState:
        """What the device has just said."""
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
            self._write(asked_entries(request, state))
        except BaseException as error:
            self._requests.settle(request, FAILED, str(error) or type(error).__name__)
            raise
        self._requests.settle(request, ACKNOWLEDGED, device_text(state))
        self.noticed(state)


def asked_entries(request: Request, state: DeviceState) -> Asked:
    """The event of a request that the device has answered."""
    device = AskedDevice(state.status, state.laser_on, state.boot, state.pan_steps, state.tilt_steps)
    return Asked(number=request.number, what=request.what, device=device)


def device_text(state: DeviceState) -> str:
    """What the device says, in words."""
    light = "on" if state.laser_on else "off"
    return f"device {state.status} at pan {state.pan_steps}, tilt {state.tilt_steps}, laser {light}"


class HeedingPositioner:
    """A positioner whose every exchange heeds a request for laser off first; see `Positioner` for the rest.

    Args:
        inner: the device.
        control: of the run.
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
            LightRefused: it was to come on, and was asked to be off.
        """
        if self._control.darken() and on:
            raise LightRefused
        return self._control.noticed(self._inner.laser(on))

    def state(self) -> DeviceState:
        """See `Positioner.state`.

        Raises:
            LightRefused: the laser was asked to be off.
        """
        if self._control.darken():
            raise LightRefused
        return self._control.noticed(self._inner.state())

    def close(self) -> None:
        """See `Positioner.close`."""
        self._inner.close()
