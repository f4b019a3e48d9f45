"""A clock that jumps and a line to a device model: the positioner without hardware and without waiting.

`VirtualClock` stands still until somebody sleeps. `ModelLink` carries bytes to a `DeviceModel` and back, each with
the delay of a real line, so that the driver meets the device in the same states as it would on USB. Integer
microseconds inside, seconds outside.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable

from tvsbayes.device.model import DeviceModel, Mechanics

LATENCY_US = 300
"""One way of a request or an answer over USB; a round trip measured on a pseudo-terminal took 0.64 ms."""


class VirtualClock:
    """Time that passes only when it is slept."""

    def __init__(self) -> None:
        self.now_us = 0

    def monotonic(self) -> float:
        """Seconds since the clock was made."""
        return self.now_us / 1e6

    def sleep(self, seconds: float) -> None:
        """Let time pass at once; at least a microsecond, so that waiting always ends."""
        self.now_us += max(round(seconds * 1e6), 1)


class SimulatedDevice:
    """A device that can be power-cycled: mechanics that stay, a firmware that starts anew.

    Attributes:
        clock: its time.
        mechanics: motors, switches and laser.
        model: the running firmware.
        starts: how often it was started; the boot id counts on from `first_boot`.
    """

    def __init__(self, clock: VirtualClock, mechanics: Mechanics, first_boot: int = 1):
        self.clock, self.mechanics = clock, mechanics
        self.first_boot, self.starts = first_boot, 0
        self.listener: Callable[[bytes], None] | None = None
        self.power_on()

    def power_on(self) -> None:
        """A start, also in mid-motion: counters, homing and settings are lost, the laser goes off."""
        for axis in (0, 1):
            self.mechanics.flush(axis)
        self.starts += 1
        self.model = DeviceModel(self.mechanics, self.first_boot + self.starts - 1, self.clock.now_us, self._send)

    def _send(self, line: bytes) -> None:
        # Without a listening host the line is dropped, as the firmware does.
        if self.listener is not None:
            self.listener(line)


class ModelLink:
    """A `Link` to a simulated device; subclasses bend what passes through `to_device` and `to_host`.

    Bytes to the device arrive when their time has come, whoever moves the clock next.
    """

    def __init__(self, device: SimulatedDevice):
        self.device, self.clock = device, device.clock
        self._queue: list[tuple[int, int, bool, bytes]] = []
        self._number = 0
        self._arrived = bytearray()
        device.listener = self.to_host

    def write(self, data: bytes) -> None:
        """See `driver.Link`."""
        self.to_device(data)
        self.settle()

    def read(self, timeout_s: float) -> bytes:
        """See `driver.Link`."""
        deadline_us = self.clock.now_us + max(round(timeout_s * 1e6), 1)
        self.settle()
        while not self._arrived and self.clock.now_us < deadline_us:
            ahead_us = self._queue[0][0] if self._queue else deadline_us
            self.clock.now_us = max(min(ahead_us, deadline_us), self.clock.now_us)
            self.settle()
        data = bytes(self._arrived)
        self._arrived.clear()
        return data

    def close(self) -> None:
        """See `driver.Link`."""
        self.device.listener = None

    def to_device(self, data: bytes) -> None:
        """What the host has written."""
        self.deliver(data, True, LATENCY_US)

    def to_host(self, data: bytes) -> None:
        """What the device has written."""
        self.deliver(data, False, LATENCY_US)

    def deliver(self, data: bytes, device: bool, delay_us: int) -> None:
        """Put bytes on the way; they arrive in order of time, then in order of sending."""
        self._number += 1
        heapq.heappush(self._queue, (self.clock.now_us + delay_us, self._number, device, data))

    def settle(self) -> None:
        """Let everything happen that is due by now."""
        now_us = self.clock.now_us
        while self._queue and self._queue[0][0] <= now_us:
            due_us, _, device, data = heapq.heappop(self._queue)
            if device:
                self.device.model.advance(due_us)
                # The device answers at the time of the bytes, which may lie before the clock's.
                self.clock.now_us = due_us
                self.device.model.receive(data, due_us)
                self.clock.now_us = now_us
            else:
                self._arrived += data
        self.device.model.advance(now_us)
