"""The digital twin driven by the real firmware on an emulated processor, in real time.

The firmware's motor and laser signals drive the twin's gears and light, so that a rehearsal runs the driver, protocol
and firmware of the bench. Only the mechanics and the pictures are simulated.
"""

from __future__ import annotations

import time

from support.emulated_board import EmulatedBoard

from tvsbayes.acquisition.simulated_instrument import Instrument, VirtualClock
from tvsbayes.instrument.rig import Rig
from tvsbayes.positioner.driver import SerialPositioner
from tvsbayes.positioner.interface import HomeReport, Link
from tvsbayes.positioner.protocol import DeviceState, device_settings
from tvsbayes.positioner.serial_port import BAUD, serial_opener


class BoardClock(VirtualClock):
    """This computer's clock, which the board follows; `now_us` is its last reading."""

    def __init__(self) -> None:
        super().__init__()
        self._start_s = time.monotonic()

    def monotonic(self) -> float:
        """Seconds since the clock was made."""
        self.now_us = round((time.monotonic() - self._start_s) * 1e6)
        return self.now_us / 1e6

    def sleep(self, seconds: float) -> None:
        """Waits."""
        time.sleep(seconds)
        self.monotonic()


class EmulatedInstrument(Instrument):
    """A true rig behind an emulated board.

    Args:
        rig, seed, start: as in `Instrument`.
        board: runs the firmware.
    """

    def __init__(self, rig: Rig, seed: int, start: int, board: EmulatedBoard):
        super().__init__(rig, seed, start)
        self.clock, self.board = BoardClock(), board
        board.on_step, board.on_laser = self.mechanics.step, self.mechanics.switch_laser

    def positioner(self) -> SerialPositioner:
        """The driver on the board's serial port, with the limits and the speed of the rig file."""
        return _BoardPositioner(self)

    def at_rest(self, homed: bool = False) -> None:
        """Record that both axes stand; `homed`: each at its home switch, with the counters set."""
        self.board.drain()
        for axis in (0, 1):
            self.mechanics.flush(axis)
            if homed:
                self._found_home(axis)


class _BoardLink:
    """A serial link that brings the twin up to date with the board at every answer."""

    def __init__(self, link: Link, board: EmulatedBoard):
        self._link, self._board = link, board
        self.write, self.close = link.write, link.close

    def read(self, timeout_s: float) -> bytes:
        """See `interface.Link`."""
        data = self._link.read(timeout_s)
        self._board.drain()
        return data


class _BoardPositioner(SerialPositioner):
    """The shipped driver, which reports the end of its motions to the twin."""

    def __init__(self, instrument: EmulatedInstrument):
        self._instrument, board = instrument, instrument.board
        opener = serial_opener(board.port, BAUD)
        super().__init__(
            lambda: _BoardLink(opener(), board), device_settings(instrument.rig.positioner), instrument.clock
        )

    def home(self) -> HomeReport:
        report = super().home()
        self._instrument.at_rest(homed=True)
        return report

    def move_to(self, pan_steps: int, tilt_steps: int) -> DeviceState:
        state = super().move_to(pan_steps, tilt_steps)
        self._instrument.at_rest()
        return state
