"""A positioner in software: the firmware's state machine, and the mechanics behind its counters.

`DeviceModel` answers the same bytes at the same microseconds as the C++ core in firmware/tvs_positioner; a
differential test drives both. `Mechanics` is what the firmware cannot see: where the motors truly stand. It can lose
steps, and tells a listener every stretch of motion in one sense, from which the twin's gears follow.

Times are microseconds since start, positions motor steps (pan, tilt). Nothing here sleeps or reads a clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from tvsbayes.positioner.protocol import (
    FIRMWARE_VERSION,
    REQUEST_CHARS_MAX,
    SETTINGS,
    VERSION,
    DeviceState,
    FrameError,
    Status,
    frame,
    signed,
    state_text,
    unframe,
    unsigned,
)

START_SPEED = 200
"""Speed at which the motors start and stop without a ramp, and that of homing, steps/s."""
HOME_SLOW_SPEED = 50
"""Speed of the last approach to a home switch, steps/s."""
HOME_CLEAR_STEPS = 20
"""Steps beyond the release of a home switch."""
HOME_TRAVEL_MAX_STEPS = 20_000
"""The most that one axis may travel while homing."""
_NEVER = 2**63


@dataclass
class Mechanics:
    """Motors, switches and laser of a simulated positioner.

    Attributes:
        home_steps: true position (pan, tilt) at and below which the home switch is pressed.
        limit_steps: distance from 0 beyond which a limit switch opens.
        true_steps: where the motors stand; starts at 0, wherever the counters are.
        missing_steps: next steps that the motors will not do.
        laser_on: whether light comes out.
        moved: called with axis and signed steps after every stretch of motion in one sense.
        found_home: called with the axis when homing has found its switch, at `home_steps`.
    """

    home_steps: tuple[int, int] = (-1_200, -700)
    limit_steps: int = 30_000
    true_steps: list[int] = field(default_factory=lambda: [0, 0])
    missing_steps: list[int] = field(default_factory=lambda: [0, 0])
    laser_on: bool = False
    moved: Callable[[int, int], None] | None = None
    found_home: Callable[[int], None] | None = None
    _stretch: list[int] = field(default_factory=lambda: [0, 0])

    def step(self, axis: int, sense: int) -> None:
        """One pulse to a motor; `sense` is +1 or -1."""
        if self.missing_steps[axis] > 0:
            self.missing_steps[axis] -= 1
            return
        self.true_steps[axis] += sense
        if self._stretch[axis] * sense < 0:
            self.flush(axis)
        self._stretch[axis] += sense

    def flush(self, axis: int) -> None:
        """Tell the listener the stretch of motion so far."""
        stretch, self._stretch[axis] = self._stretch[axis], 0
        if stretch and self.moved is not None:
            self.moved(axis, stretch)

    def home_switch(self, axis: int) -> bool:
        """Whether the home switch is pressed."""
        return self.true_steps[axis] <= self.home_steps[axis]

    def limit_switch(self, axis: int) -> bool:
        """Whether a limit switch is open."""
        return abs(self.true_steps[axis]) > self.limit_steps


@dataclass
class _Axis:
    position: int = 0
    target: int = 0
    home_deviation: int = 0
    level: int = 0
    direction: int = 0
    due_us: int = 0


class DeviceModel:
    """The firmware's core in Python.

    Args:
        mechanics: the motors and switches it drives.
        boot: boot id of this start.
        now_us: time of this start.
        write: called with every line the device sends.
        protocol: protocol version it claims, for tests of a wrong one.
    """

    def __init__(
        self,
        mechanics: Mechanics,
        boot: int,
        now_us: int,
        write: Callable[[bytes], None],
        protocol: int = VERSION,
    ):
        self.mechanics = mechanics
        self._boot, self._write, self._protocol = boot, write, protocol
        self._axes = (_Axis(), _Axis())
        self._settings = {name: start for name, (_, _, start) in SETTINGS.items()}
        self._status: Status = "unhomed"
        self._error = "none"
        self._last_sequence = self._motion_sequence = self._done_sequence = 0
        self._last_request, self._last_reply = b"", b""
        self._stopping = self._homing = self._homed_before = False
        self._home_axis = self._home_clear = self._home_travel = 0
        self._home_limit, self._home_phase = False, "away"
        self._home_due_us, self._heard_us = _NEVER, now_us
        self._line = bytearray()
        self._overlong = False
        self._set_laser(False)
        self._write(frame(f"!boot b={boot} fw={FIRMWARE_VERSION}"))

    @property
    def state(self) -> DeviceState:
        """What every reply carries."""
        pan, tilt = self._axes
        return DeviceState(
            self._boot,
            self._status,
            pan.position,
            tilt.position,
            pan.target,
            tilt.target,
            self._done_sequence,
            self.mechanics.laser_on,
            pan.home_deviation,
            tilt.home_deviation,
            self._error,
        )

    def receive(self, data: bytes, now_us: int) -> None:
        """Takes bytes from the host, all at one time; `advance` to that time first."""
        for byte in data:
            if byte == 0x0A:
                self._take_line(bytes(self._line), now_us)
                self._line.clear()
                self._overlong = False
            elif len(self._line) < REQUEST_CHARS_MAX + 1:
                self._line.append(byte)
            else:
                self._overlong = True

    def advance(self, now_us: int) -> None:
        """Does every step, and switches off the laser, that is due by now, in order of time."""
        while True:
            due_us, index = _NEVER, -1
            if self._homing:
                due_us = self._home_due_us
            else:
                for i, axis in enumerate(self._axes):
                    if axis.direction and axis.due_us < due_us:
                        due_us, index = axis.due_us, i
            off_us = self._heard_us + self._settings["wd"] * 1000 if self.mechanics.laser_on else _NEVER
            if off_us <= due_us:
                if off_us > now_us:
                    return
                self._set_laser(False)
                self._error = "watchdog"
            elif due_us > now_us:
                return
            elif self._homing:
                self._home_step()
            else:
                self._step_axis(index)

    def _take_line(self, line: bytes, now_us: int) -> None:
        if not self._overlong and line.endswith(b"\r"):
            line = line[:-1]
        if self._overlong or len(line) > REQUEST_CHARS_MAX:
            return self._nak("long")
        if not line:
            return None
        if not line.startswith(b">"):
            return self._nak("frame")
        try:
            words = unframe(line)[1:].split(" ")
        except FrameError as error:
            return self._nak(error.kind)
        self._heard_us = now_us
        sequence = unsigned(words[0])
        if sequence is None or len(words) < 2:
            return self._nak("parse")
        if sequence == 0:
            refused, extra = self._command(0, words[1:], now_us) if words[1:] == ["ID"] else ("seq", "")
            return self._write(self._reply(0, refused, extra))
        if sequence == self._last_sequence and line == self._last_request:
            return self._write(self._last_reply)
        if sequence <= self._last_sequence:
            return self._write(self._reply(sequence, "seq", ""))
        self._last_sequence, self._last_request = sequence, line
        refused, extra = self._command(sequence, words[1:], now_us)
        self._last_reply = self._reply(sequence, refused, extra)
        return self._write(self._last_reply)

    def _nak(self, kind: str) -> None:
        self._write(frame(f"!nak {kind}"))

    def _reply(self, sequence: int, error: str | None, extra: str) -> bytes:
        return frame(f"<{sequence} {'ok' if error is None else 'err ' + error} {state_text(self.state)}{extra}")

    def _command(self, sequence: int, words: list[str], now_us: int) -> tuple[str | None, str]:
        """Executes one command: the reason of refusal or None, and fields beside the state."""
        name, arguments = words[0], words[1:]
        counts = {"ID": 0, "?": 0, "MA": 2, "HOME": 0, "STOP": 0, "ABORT": 0, "L": 1, "GET": 1, "SET": 2}
        if name not in counts:
            return "command", ""
        if len(arguments) != counts[name]:
            return "argument", ""
        if name == "ID":
            return None, f" fw={FIRMWARE_VERSION} proto={self._protocol} q={self._last_sequence}"
        if name == "MA":
            return self._move(sequence, arguments, now_us), ""
        if name == "HOME":
            return self._home(sequence, now_us), ""
        if name == "STOP":
            self._stop()
        elif name == "ABORT":
            self._halt("unhomed" if self._status == "unhomed" or self._homing else "alarm", "abort")
        elif name == "L":
            return self._laser(arguments[0]), ""
        elif name in ("GET", "SET"):
            return self._setting(arguments)
        return None, ""

    def _move(self, sequence: int, arguments: list[str], now_us: int) -> str | None:
        targets = [signed(text) for text in arguments]
        pan, tilt = targets
        if pan is None or tilt is None:
            return "argument"
        if self._status == "alarm":
            return "alarm"
        if self._status == "unhomed" or self._homing:
            return "unhomed"
        if self._status == "moving":
            return "busy"
        limits = self._settings
        if not (limits["pmin"] <= pan <= limits["pmax"] and limits["tmin"] <= tilt <= limits["tmax"]):
            return "limit"
        self._error, self._motion_sequence, self._stopping, self._status = "none", sequence, False, "moving"
        for axis, target in zip(self._axes, (pan, tilt), strict=True):
            axis.target, axis.level = target, 0
            axis.direction = (target > axis.position) - (target < axis.position)
            axis.due_us = now_us + self._delay_us(0)
        self._finish_if_at_rest()
        return None

    def _laser(self, argument: str) -> str | None:
        if argument not in ("0", "1"):
            return "argument"
        if argument == "1" and self._status == "alarm":
            return "alarm"
        if argument == "1" and (self._status == "unhomed" or self._homing):
            return "unhomed"
        if argument == "1":
            self._error = "none"
        self._set_laser(argument == "1")
        return None

    def _setting(self, arguments: list[str]) -> tuple[str | None, str]:
        name = arguments[0]
        if name not in SETTINGS:
            return "argument", ""
        if len(arguments) == 2:
            value, (low, high, _) = signed(arguments[1]), SETTINGS[name]
            if value is None or not low <= value <= high:
                return "argument", ""
            if self._status == "moving":
                return "busy", ""
            self._settings[name] = value
        return None, f" v={self._settings[name]}"

    def _set_laser(self, on: bool) -> None:
        self.mechanics.laser_on = on

    def _delay_us(self, level: int) -> int:
        speed = math.isqrt(START_SPEED**2 + 2 * self._settings["amax"] * level)
        return 1_000_000 // min(speed, self._settings["vmax"])

    def _top_level(self) -> int:
        top = self._settings["vmax"]
        return 0 if top <= START_SPEED else (top * top - START_SPEED**2) // (2 * self._settings["amax"])

    def _step_axis(self, index: int) -> None:
        axis = self._axes[index]
        self.mechanics.step(index, axis.direction)
        axis.position += axis.direction
        if self.mechanics.limit_switch(index):
            return self._halt("alarm", "limit")
        remaining = (axis.target - axis.position) * axis.direction
        if remaining == 0:
            axis.direction = 0
            return self._finish_if_at_rest()
        # Slow down so that the last step is done at the starting speed.
        axis.level = min(axis.level + 1, self._top_level(), remaining - 1)
        axis.due_us += self._delay_us(axis.level)
        return None

    def _finish_if_at_rest(self) -> None:
        if any(axis.direction for axis in self._axes):
            return
        self._status = "idle"
        self._flush()
        if self._stopping:
            self._error = "stop"
        else:
            self._done_sequence = self._motion_sequence

    def _flush(self) -> None:
        for index in (0, 1):
            self.mechanics.flush(index)

    def _stop(self) -> None:
        if self._homing:
            self._halt("unhomed", "stop")
        elif self._status == "moving":
            self._stopping = True
            for axis in self._axes:
                if axis.direction:
                    axis.target = axis.position + axis.direction * (axis.level + 1)

    def _halt(self, status: Status, error: str) -> None:
        for axis in self._axes:
            axis.direction = 0
        self._homing = False
        self._status, self._error = status, error
        self._set_laser(False)
        self._flush()

    def _home(self, sequence: int, now_us: int) -> str | None:
        if self._status == "moving":
            return "busy"
        self._homed_before = self._status == "idle"
        self._status, self._homing, self._stopping = "moving", True, False
        self._error, self._motion_sequence = "none", sequence
        self._set_laser(False)
        self._home_one(0, now_us)
        return None

    def _home_one(self, axis: int, now_us: int) -> None:
        self._home_axis, self._home_travel = axis, 0
        self._home_limit = self.mechanics.limit_switch(axis)
        self._enter_phase("away" if self.mechanics.home_switch(axis) else "fast", now_us)

    def _enter_phase(self, phase: str, now_us: int) -> None:
        self._home_phase, self._home_clear = phase, HOME_CLEAR_STEPS
        self._home_due_us = now_us + self._home_delay_us()

    def _home_delay_us(self) -> int:
        return 1_000_000 // (HOME_SLOW_SPEED if self._home_phase == "slow" else START_SPEED)

    def _home_step(self) -> None:
        now_us, positive = self._home_due_us, self._home_phase in ("away", "back")
        axis = self._axes[self._home_axis]
        self.mechanics.step(self._home_axis, 1 if positive else -1)
        axis.position += 1 if positive else -1
        axis.target = axis.position
        # Homing also leads back from an open limit; one that opens on the way means that no home switch will come.
        limit = self.mechanics.limit_switch(self._home_axis)
        if limit and not self._home_limit:
            return self._halt("alarm", "limit")
        self._home_limit = limit
        self._home_travel += 1
        if self._home_travel > HOME_TRAVEL_MAX_STEPS:
            return self._halt("alarm", "home")
        pressed = self.mechanics.home_switch(self._home_axis)
        if positive and not pressed:
            self._home_clear -= 1
            if self._home_clear == 0:
                return self._enter_phase("fast" if self._home_phase == "away" else "slow", now_us)
        if not positive and pressed:
            return self._enter_phase("back", now_us) if self._home_phase == "fast" else self._home_found(now_us)
        self._home_due_us += self._home_delay_us()
        return None

    def _home_found(self, now_us: int) -> None:
        axis = self._axes[self._home_axis]
        home = self._settings["ht" if self._home_axis else "hp"]
        axis.home_deviation = axis.position - home if self._homed_before else 0
        axis.position = axis.target = home
        self.mechanics.flush(self._home_axis)
        if self.mechanics.found_home is not None:
            self.mechanics.found_home(self._home_axis)
        if self._home_axis == 0:
            return self._home_one(1, now_us)
        self._homing = False
        self._status = "idle"
        self._flush()
        self._done_sequence = self._motion_sequence
        return None
