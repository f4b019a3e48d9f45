"""Software model of a positioner: the firmware's state machine, and the motors and switches behind it.

`DeviceModel` answers with the same bytes at the same microseconds as the C++ core in firmware/tvs_positioner;
differential tests drive both. `Mechanics` is hidden from it: the true positions, which can lose steps, and broken
wires. Every stretch of motion in one sense is reported to a listener, which drives the twin's gears.

Times are microseconds since start, positions motor steps (pan, tilt). The module neither sleeps nor reads a clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from tvsbayes.positioner.protocol import (
    FIRMWARE_VERSION,
    REQUEST_CHARS_MAX,
    SETTINGS,
    START_SPEED,
    TRIGGER_US,
    UNNUMBERED,
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

HOME_SLOW_SPEED = 50
"""Speed of the last approach to a home switch, steps/s."""
HOME_CLEAR_STEPS = 20
"""Steps taken beyond the release of a home switch."""
HOME_TRAVEL_MAX_STEPS = 20_000
"""Largest travel of one axis while homing."""
HOME_OPEN_MAX_STEPS = 200
"""Largest travel with a limit switch open from the start: it leaves the switch without reaching the end stop."""
HOME_READS, HOME_READ_US = 4, 500
"""Number of further readings of a home switch that must agree with the first, and their interval; rejects spikes."""
LIMIT_OPEN_US = 5_000
"""Time for which a limit switch that opens at rest must stay open to count."""
COMMANDS = ("ID", "?", "MA", "HOME", "STOP", "ABORT", "L", "TRIG", "GET", "SET")
_NEVER = 2**63


@dataclass
class Mechanics:
    """Motors, switches and laser of a simulated positioner.

    Attributes:
        home_steps: true position (pan, tilt) at and below which the home switch is pressed.
        limit_steps: distance from 0 beyond which a limit switch opens.
        limit_cut: whether the wire of an axis' limit switches is broken.
        home_dead: whether the wire of an axis' home switch is broken: it never reads as pressed.
        wrong_reads: next readings of an axis' home switch that are wrong: bounce, or a spike.
        true_steps: positions of the motors; they start at 0, whatever the counters.
        missing_steps: number of next steps that the motors lose.
        laser_on: whether the laser emits.
        lit: how often the laser was switched on.
        trigger_on: whether the cameras' trigger line is high.
        moved: called with axis and signed steps after every stretch of motion in one sense.
        found_home: called with the axis when homing has found its switch, at `home_steps`.
    """

    home_steps: tuple[int, int] = (-1_200, -700)
    limit_steps: int = 30_000
    limit_cut: list[bool] = field(default_factory=lambda: [False, False])
    home_dead: list[bool] = field(default_factory=lambda: [False, False])
    wrong_reads: list[int] = field(default_factory=lambda: [0, 0])
    true_steps: list[int] = field(default_factory=lambda: [0, 0])
    missing_steps: list[int] = field(default_factory=lambda: [0, 0])
    laser_on: bool = False
    lit: int = 0
    trigger_on: bool = False
    moved: Callable[[int, int], None] | None = None
    found_home: Callable[[int], None] | None = None
    _stretch: list[int] = field(default_factory=lambda: [0, 0])

    def switch_laser(self, on: bool) -> None:
        """Set the laser's line high or low."""
        self.lit += on and not self.laser_on
        self.laser_on = on

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
        """Report the present stretch of motion to the listener."""
        stretch, self._stretch[axis] = self._stretch[axis], 0
        if stretch and self.moved is not None:
            self.moved(axis, stretch)

    def flush_all(self) -> None:
        """Report the present stretches of both axes."""
        for axis in (0, 1):
            self.flush(axis)

    def home_switch(self, axis: int) -> bool:
        """Whether the home switch reads as pressed."""
        pressed = not self.home_dead[axis] and self.true_steps[axis] <= self.home_steps[axis]
        if self.wrong_reads[axis] == 0:
            return pressed
        self.wrong_reads[axis] -= 1
        return not pressed

    def limit_switch(self, axis: int) -> bool:
        """Whether the limit circuit of an axis is open."""
        return self.limit_cut[axis] or abs(self.true_steps[axis]) > self.limit_steps


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
        mechanics: the motors and switches that it drives.
        boot: boot id of this start.
        now_us: time of this start.
        write: called with every line the device sends.
        protocol: protocol version that it reports, for tests of a wrong one.
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
        self._refused = self._stopping = self._homing = self._homed_before = False
        self._home_axis = self._home_clear = self._home_travel = self._home_reads = 0
        self._home_limit, self._home_phase = False, "away"
        self._home_due_us, self._heard_us = _NEVER, now_us
        self._trigger_off_us = self._limit_due_us = _NEVER
        self._line = bytearray()
        self._overlong = False
        mechanics.switch_laser(False)
        mechanics.trigger_on = False
        self._write(frame(f"!boot b={boot} fw={FIRMWARE_VERSION}"))

    @property
    def state(self) -> DeviceState:
        """The state that every reply contains."""
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
            self._switches(0),
            self._switches(1),
        )

    def receive(self, data: bytes, now_us: int) -> None:
        """Receive bytes from the host, all at one time; call `advance` to that time first."""
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
        """Advance the time for a main loop that is never late: every action occurs when it is due."""
        while (due_us := self.next_us()) <= now_us:
            self.loop(due_us)
        self.loop(now_us)

    def next_us(self) -> int:
        """Time at which `loop` is due next, if no request arrives before."""
        return min(self._step_us()[0], self._laser_off_us(), self._trigger_off_us, self._limit_due_us)

    def loop(self, now_us: int) -> None:
        """Perform the actions due by now: at most one step of an axis, laser and trigger off."""
        if self._trigger_off_us <= now_us:
            self._trigger_off_us = _NEVER
            self.mechanics.trigger_on = False
        while True:
            (due_us, index), off_us = self._step_us(), self._laser_off_us()
            if off_us <= due_us and off_us <= now_us:
                self.mechanics.switch_laser(False)
                self._error = "watchdog"
            elif due_us > now_us:
                break
            elif self._homing:
                self._home_step(now_us)
            else:
                self._step_axis(index, now_us)
        self._watch_limits(now_us)

    def darkened(self) -> None:
        """Record that the board has switched the laser off because `loop` was late."""
        if self.mechanics.laser_on:
            self.mechanics.switch_laser(False)
            self._error = "stall"

    def _laser_off_us(self) -> int:
        return self._heard_us + self._settings["wd"] * 1000 if self.mechanics.laser_on else _NEVER

    def _step_us(self) -> tuple[int, int]:
        """Time of the next step, and its axis."""
        if self._homing:
            return self._home_due_us, self._home_axis
        due_us, index = _NEVER, self._home_axis
        for i, axis in enumerate(self._axes):
            if axis.direction and axis.due_us < due_us:
                due_us, index = axis.due_us, i
        return due_us, index

    def _limit_open(self) -> bool:
        return self.mechanics.limit_switch(0) or self.mechanics.limit_switch(1)

    def _switches(self, axis: int) -> int:
        return int(self.mechanics.home_switch(axis)) + 2 * int(self.mechanics.limit_switch(axis))

    def _watch_limits(self, now_us: int) -> None:
        if self._status != "idle" or not self._limit_open():
            self._limit_due_us = _NEVER
        elif self._limit_due_us == _NEVER:
            self._limit_due_us = now_us + LIMIT_OPEN_US
        elif self._limit_due_us <= now_us:
            self._limit_due_us = _NEVER
            self._halt("alarm", "limit")

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
        sequence = unsigned(words[0])
        if sequence is None or len(words) < 2:
            return self._nak("parse")
        if sequence == 0:
            refused, extra = self._command(0, words[1:], now_us) if tuple(words[1:]) in UNNUMBERED else ("seq", "")
            return self._write(self._reply(0, refused, extra))
        if sequence == self._last_sequence and line == self._last_request:
            if not self._refused:
                self._heard_us = now_us
            return self._write(self._last_reply)
        if sequence <= self._last_sequence:
            return self._write(self._reply(sequence, "seq", ""))
        self._last_sequence, self._last_request = sequence, line
        refused, extra = self._command(sequence, words[1:], now_us)
        self._refused = refused is not None
        # Only numbered, accepted requests feed the laser watchdog.
        self._heard_us = self._heard_us if self._refused else now_us
        self._last_reply = self._reply(sequence, refused, extra)
        return self._write(self._last_reply)

    def _nak(self, kind: str) -> None:
        self._write(frame(f"!nak {kind}"))

    def _reply(self, sequence: int, error: str | None, extra: str) -> bytes:
        return frame(f"<{sequence} {'ok' if error is None else 'err ' + error} {state_text(self.state)}{extra}")

    def _command(self, sequence: int, words: list[str], now_us: int) -> tuple[str | None, str]:
        """Execute one command; return the reason of refusal or None, and further fields of the reply."""
        match words:
            case ["ID"]:
                return None, f" fw={FIRMWARE_VERSION} proto={self._protocol} q={self._last_sequence}"
            case ["MA", pan, tilt]:
                return self._move(sequence, signed(pan), signed(tilt), now_us), ""
            case ["HOME"]:
                return self._home(sequence, now_us), ""
            case ["STOP"]:
                self._stop()
            case ["ABORT"]:
                self._halt("unhomed" if self._status == "unhomed" or self._homing else "alarm", "abort")
            case ["L", argument]:
                return self._laser(argument), ""
            case ["TRIG", width]:
                return self._trigger(unsigned(width), now_us), ""
            case ["GET", name] if name in SETTINGS:
                return None, f" v={self._settings[name]}"
            case ["SET", name, text] if name in SETTINGS:
                value, (low, high, _) = signed(text), SETTINGS[name]
                if value is None or not low <= value <= high:
                    return "argument", ""
                if self._status == "moving":
                    return "busy", ""
                self._settings[name] = value
                return None, f" v={value}"
            case [name, *_] if words != ["?"]:
                return "argument" if name in COMMANDS else "command", ""
        return None, ""

    def _move(self, sequence: int, pan: int | None, tilt: int | None, now_us: int) -> str | None:
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
        if argument == "1":
            if self._status == "alarm":
                return "alarm"
            if self._status == "unhomed" or self._homing:
                return "unhomed"
            self._error = "none"
        self.mechanics.switch_laser(argument == "1")
        return None

    def _trigger(self, width_us: int | None, now_us: int) -> str | None:
        shortest, longest = TRIGGER_US
        if width_us is None or not shortest <= width_us <= longest:
            return "argument"
        self._trigger_off_us = now_us + width_us
        self.mechanics.trigger_on = True
        return None

    def _delay_us(self, level: int) -> int:
        speed = math.isqrt(START_SPEED**2 + 2 * self._settings["amax"] * level)
        return 1_000_000 // min(speed, self._settings["vmax"])

    def _top_level(self) -> int:
        top = self._settings["vmax"]
        return 0 if top <= START_SPEED else (top * top - START_SPEED**2) // (2 * self._settings["amax"])

    def _step_axis(self, index: int, now_us: int) -> None:
        axis = self._axes[index]
        self.mechanics.step(index, axis.direction)
        axis.position += axis.direction
        if self._limit_open():
            return self._halt("alarm", "limit")
        remaining = (axis.target - axis.position) * axis.direction
        if remaining == 0:
            axis.direction = 0
            return self._finish_if_at_rest()
        # A motor whose step is late has stopped: the ramp restarts.
        stalled = now_us - axis.due_us > self._delay_us(0)
        # Decelerate so that the last step is done at the starting speed.
        axis.level = min(0 if stalled else axis.level + 1, self._top_level(), remaining - 1)
        axis.due_us = now_us + self._delay_us(axis.level)
        return None

    def _finish_if_at_rest(self) -> None:
        if any(axis.direction for axis in self._axes):
            return
        self._status = "idle"
        self.mechanics.flush_all()
        if self._stopping:
            self._error = "stop"
        else:
            self._done_sequence = self._motion_sequence

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
        self.mechanics.switch_laser(False)
        self.mechanics.flush_all()

    def _home(self, sequence: int, now_us: int) -> str | None:
        if self._status == "moving":
            return "busy"
        self._homed_before = self._status == "idle"
        self._status, self._homing, self._stopping = "moving", True, False
        self._error, self._motion_sequence = "none", sequence
        self.mechanics.switch_laser(False)
        self._home_one(0, now_us)
        return None

    def _home_one(self, axis: int, now_us: int) -> None:
        self._home_axis, self._home_travel, self._home_reads = axis, 0, 0
        self._home_limit = self.mechanics.limit_switch(axis)
        self._enter_phase("away" if self.mechanics.home_switch(axis) else "fast", now_us)

    def _enter_phase(self, phase: str, now_us: int) -> None:
        self._home_phase, self._home_clear = phase, HOME_CLEAR_STEPS
        self._home_due_us = now_us + self._home_delay_us()

    def _home_delay_us(self) -> int:
        return 1_000_000 // (HOME_SLOW_SPEED if self._home_phase == "slow" else START_SPEED)

    def _home_step(self, now_us: int) -> None:
        if self._home_reads > 0:
            return self._home_read(now_us)
        positive = self._home_phase in ("away", "back")
        axis = self._axes[self._home_axis]
        self.mechanics.step(self._home_axis, 1 if positive else -1)
        axis.position += 1 if positive else -1
        axis.target = axis.position
        # Homing may begin behind an open limit switch and leave it; a limit switch that opens on the way means that
        # the home switch was missed.
        limit = self.mechanics.limit_switch(self._home_axis)
        self._home_travel += 1
        if limit and (not self._home_limit or self._home_travel > HOME_OPEN_MAX_STEPS):
            return self._halt("alarm", "limit")
        self._home_limit = limit
        if self._home_travel > HOME_TRAVEL_MAX_STEPS:
            return self._halt("alarm", "home")
        pressed = self.mechanics.home_switch(self._home_axis)
        self._home_due_us = now_us + self._home_delay_us()
        if positive:
            self._home_clear = HOME_CLEAR_STEPS if pressed else self._home_clear - 1
            if self._home_clear == 0:
                self._enter_phase("fast" if self._home_phase == "away" else "slow", now_us)
        elif pressed:
            self._home_reads = HOME_READS
            self._home_due_us = now_us + HOME_READ_US
        return None

    def _home_read(self, now_us: int) -> None:
        """Read whether the home switch is still pressed with the motor at rest."""
        if not self.mechanics.home_switch(self._home_axis):
            self._home_reads = 0
            self._home_due_us = now_us + self._home_delay_us()
            return None
        self._home_reads -= 1
        if self._home_reads > 0:
            self._home_due_us = now_us + HOME_READ_US
            return None
        return self._enter_phase("back", now_us) if self._home_phase == "fast" else self._home_found(now_us)

    def _home_found(self, now_us: int) -> None:
        # The home switch is never beyond an open limit: a wire is broken, or the wrong switch was found.
        if self._limit_open() if self._home_axis else self.mechanics.limit_switch(0):
            return self._halt("alarm", "limit")
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
        self.mechanics.flush_all()
        self._done_sequence = self._motion_sequence
        return None
