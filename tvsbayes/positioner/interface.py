"""The interface of a positioner: its orders, their promises, and the faults in which they end.

Drivers of other hardware keep these promises too (data/docs/instrument.md, "Your own hardware"). `move_to` and `home`
return only after the device has reported the end of this motion at the ordered counters. All else ends in a
`DeviceFault` within a bounded time. The laser is off in motion and after `home` and `close`, in every case.

Counters are absolute motor steps (pan, tilt); seconds where a name says `_s`. Time comes from a `Clock`, bytes from a
`Link`: tests drive both without hardware and without waiting.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from tvsbayes.errors import DeviceFault, escaped
from tvsbayes.positioner.protocol import DeviceState

DEFAULT_DRIVER = "serial"
"""Driver of a rig file that names none: the firmware shipped with this package."""
SEE_DOCTOR = "; see `tvsbayes doctor`"
"""End of a remedy; remedies of `doctor` omit it."""
_PORT_REMEDY = "check [positioner] port in the rig file, the cable and your rights on the port" + SEE_DOCTOR
_HELD_REMEDY = (
    "close the other program (a serial monitor, another run); `fuser -v PORT` names it on Linux and macOS" + SEE_DOCTOR
)
_HELD = (errno.EWOULDBLOCK, errno.EBUSY)
"""Errors of a port that another program has opened exclusively (flock(2), TIOCEXCL)."""


class PositionLost(DeviceFault):
    """The device was reset or moved by others: counters are invalid until it is homed again."""


class Clock(Protocol):
    """Source of time for the driver."""

    def monotonic(self) -> float:
        """Seconds, never decreasing."""

    def sleep(self, seconds: float) -> None:
        """Let time pass."""


class Link(Protocol):
    """A byte stream to the device; any call raises OSError once the device is gone."""

    def write(self, data: bytes) -> None:
        """Send all of `data`, or raise."""

    def read(self, timeout_s: float) -> bytes:
        """Return the bytes that have arrived; wait up to `timeout_s` for the first byte; may be empty."""

    def close(self) -> None:
        """Close the port; never raises."""


@dataclass(frozen=True, slots=True)
class HomeReport:
    """A finished homing.

    Attributes:
        state: the device afterwards: idle, counters at the home switches.
        deviation_steps: (pan, tilt) counter at which each switch was found minus its expected counter, since the
            homing before; not zero after lost steps. (0, 0) for the first homing of a device.
        known: whether this connection homed before; the deviation then refers to that homing.
        compared: whether the device was homed when this homing began; if not (unhomed, in alarm) it reports (0, 0) in
            every case.
        ends_negative: whether both axes arrived in the negative sense, over more steps than any play.
    """

    state: DeviceState
    deviation_steps: tuple[int, int]
    known: bool
    compared: bool
    ends_negative: bool = False


class Positioner(Protocol):
    """A two-axis positioner with a laser, with any driver."""

    @property
    def identity(self) -> Mapping[str, str]:
        """The device's report about itself for the journal; "fw" is the version of its firmware."""

    @property
    def repeats(self) -> int:
        """Number of requests sent again so far: a measure of the line's quality."""

    def home(self) -> HomeReport:
        """Find the home switches; the laser is off afterwards."""

    def move_to(self, pan_steps: int, tilt_steps: int) -> DeviceState:
        """Move to absolute counters with the laser off; returns when the device has reported arrival."""

    def laser(self, on: bool) -> DeviceState:
        """Switch the laser; returns when the device has confirmed it."""

    def state(self) -> DeviceState:
        """The device's state; the request also feeds its laser watchdog."""

    def close(self) -> None:
        """Switch the laser off and stop the motors as far as possible, then close the line; never raises."""


@runtime_checkable
class Triggering(Protocol):
    """A positioner with a line that triggers cameras."""

    def trigger(self) -> None:
        """Send one pulse; returns when the device has begun it."""


def opened(open_link: Callable[[], Link]) -> Link:
    """Open the line to a device.

    Raises:
        DeviceFault: "port-busy" where another program has it, else "port".
    """
    try:
        return open_link()
    except OSError as error:
        # Windows reports a busy port only as access denied.
        busy = error.errno in _HELD or "PermissionError(13" in str(error)
        problem = "is held by another program" if busy else "cannot be opened"
        code, remedy = ("port-busy", _HELD_REMEDY) if busy else ("port", _PORT_REMEDY)
        raise fault(code, f"the port {problem}: {reason(error)}", remedy) from error


def reason(error: OSError) -> str:
    """The system's reason of refusal, printable."""
    return escaped(error.strerror or str(error), 200)


def fault(code: str, found: str, remedy: str) -> DeviceFault:
    """A fault of the positioner."""
    return DeviceFault(code, f"positioner: {found}; {remedy}", found=found, remedy=remedy)
