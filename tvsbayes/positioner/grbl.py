r"""A positioner on a GRBL board: pan is X, tilt is Y, spindle or coolant output switches the laser (`driver = "grbl"`).

Counters are motor steps: machine position times `$100` (`$101`). The board's homing defines zero. GRBL 1.1 has no
checksum, no sequence numbers and no boot id, so it promises less than this package's firmware. Lost steps are not found
at the next homing; a computer that crashes leaves the laser on, because no watchdog of the board switches it off. The
driver uses all that GRBL reports. Every order waits for its `ok`, arrival is read back, and `$G` reads back the laser's
mode; a greeting in mid-run is a reset that has lost the counters, and an alarm ends the run.

Lines end in CR LF; an order is answered by `ok` or `error:N`, `?` by `<State|MPos:x,y,z|...>`, and `ALARM:N` or a
greeting is sent without a request. Positions are millimetres of machine coordinates with three decimals, or the unit
that the user's settings call a millimetre; settings are `$n=value`.
Source: https://github.com/gnea/grbl/wiki (Grbl v1.1 Interface, Configuration, Commands).

Counters in motor steps; seconds where a name says `_s`. Time from a `Clock`, bytes from a `Link`.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from tvsbayes.errors import DeviceFault, InputError, entry_refusal, escaped
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.counter_limits import CounterLimits
from tvsbayes.instrument.rig import driver_options
from tvsbayes.positioner.interface import Clock, HomeReport, Link, PositionLost, fault, opened, reason
from tvsbayes.positioner.protocol import DeviceState
from tvsbayes.positioner.protocol import Status as DeviceStatus
from tvsbayes.positioner.silence import HEARD_BYTES_MAX, explained

GREETING_S, GREETING_ATTEMPTS = 1.5, 4
"""An Arduino stays in its boot loader for about a second after its port is opened, and reads nothing."""
REPLY_S = 2.0
"""Longest wait for the answer to an order without motion."""
POLL_S = 0.1
"""Time between two status reports; GRBL's manual asks for 5 Hz to 10 Hz."""
HOME_S = 300.0
LINE_CHARS_MAX = 256
NO_WATCHDOG = "a GRBL board has no watchdog: when this computer fails the laser stays on, unless something else cuts it"
COUNTERS_MAX = 2_000_000
"""GRBL computes in single precision: beyond this the error of a position exceeds an eighth of a step."""
STEPS_PER_MM_MAX = 500.0
"""Positions are reported to 0.0005 mm: beyond this limit that is a quarter of a step and more."""
OPTIONS = ("laser", "laser_power", "unwatched_laser")
FOREIGN_KEYS = ("pan_home_steps", "tilt_home_steps", "acceleration_steps_per_s2", "laser_watchdog_s")
"""Entries of `[positioner]` that are settings of the board here ($23, $27, $120), or do not exist on it."""
UNLIMITED = CounterLimits({axis: (None, None) for axis in AXES})
RESET, HOLD, ASK = b"\x18", b"!", b"?"
"""Reset is acted on as soon as it arrives: motion ends, spindle and coolant off. At rest the position is kept."""
LASER_ORDERS = {"M3": "M5", "M4": "M5", "M7": "M9", "M8": "M9"}
"""Orders that switch a laser on, with those that switch it off: spindle or coolant."""
_MOVING = ("Run", "Home", "Jog", "Hold")
_STATUS = re.compile(r"<([A-Za-z]+)(?::\d+)?\|(.*)>")
_SETTING = re.compile(r"\$(\d{1,3})=(-?\d+(?:\.\d+)?)")
_MODES = re.compile(r"\[GC:(.*)\]")
_GREETING = re.compile(r"(Grbl|GrblHAL) (\S+) .*", re.IGNORECASE)
ALARMS = {
    1: "a hard limit was reached, the position is lost",
    2: "the target lies outside the board's soft limits",
    3: "reset in motion, the position is lost",
    6: "homing was reset",
    7: "the safety door opened while homing",
    8: "homing could not clear the limit switch",
    9: "homing did not find the limit switch",
}
ERRORS = {
    5: "homing is not enabled ($22)",
    8: "not while it moves",
    9: "locked in alarm: home first",
    10: "soft limits need homing",
    15: "the target lies outside the board's travel",
    20: "an order that this board does not know",
    22: "no feed rate",
}
_refused = partial(entry_refusal, "positioner", "positioner")


@dataclass(frozen=True)
class Status:
    """A status report.

    Attributes:
        state: name of the state on the board: "Idle", "Run", "Alarm".
        position_mm: machine position (x, y).
        pins: letters of active inputs; "XY" are the limit switches of both axes.
    """

    state: str
    position_mm: tuple[float, float]
    pins: str = ""


def parse_status(line: str) -> Status | None:
    """A status report; None for any other line, also one without machine position."""
    match = _STATUS.fullmatch(line)
    if match is None:
        return None
    fields = dict(field.partition(":")[::2] for field in match[2].split("|"))
    try:
        x, y = map(float, fields["MPos"].split(",")[:2])
    except (KeyError, ValueError):
        return None
    return Status(match[1], (x, y), fields.get("Pn", ""))


def parse_setting(line: str) -> tuple[int, float] | None:
    """Number and value of a line of `$$`; None for any other."""
    match = _SETTING.match(line)
    return None if match is None else (int(match[1]), float(match[2]))


def parse_modes(line: str) -> frozenset[str] | None:
    """The modes in force, such as "G90" or "M5", from the answer to `$G`; None for any other line."""
    match = _MODES.fullmatch(line)
    return None if match is None else frozenset(match[1].split())


def parse_greeting(line: str) -> str | None:
    """Name and version of a board that has just started; None for any other line."""
    match = _GREETING.fullmatch(line)
    return None if match is None else f"{match[1]} {match[2]}"


def number_of(line: str, kind: str) -> int | None:
    """The number of `error:N` or `ALARM:N`; None for any other line."""
    head, _, number = line.partition(":")
    return int(number) if head == kind and number.isascii() and number.isdigit() and len(number) < 4 else None


@dataclass(frozen=True)
class BoardSettings:
    """The settings of `$$` on which this package depends.

    Attributes:
        steps_per_mm: steps per mm of pan (X) and tilt (Y).
        rate_mm_per_min: top speeds of both axes.
        power_max: `S` of full spindle power.
        ramps_s: time of the slower axis to reach full speed and to stop again.
    """

    steps_per_mm: tuple[float, float]
    rate_mm_per_min: tuple[float, float]
    power_max: float
    ramps_s: float

    @classmethod
    def of(cls, values: Mapping[int, float], laser: str) -> BoardSettings:
        """Build from settings by number, checked against the requirements of positioning and of the laser's order.

        Raises:
            InputError: an unsuitable setting, with the required value.
        """

        def hold(number: int, valid: bool, allowed: str) -> None:
            if not valid:
                found = "nothing" if values.get(number) is None else f"{values[number]:g}"
                remedy = f"set it with any GRBL sender (${number}=...), then connect again"
                message = f"GRBL setting ${number}: found {found}; allowed: {allowed}; {remedy}"
                place = f"${number}"
                raise InputError("grbl-setting", message, column=place, found=found, allowed=allowed, remedy=remedy)

        hold(1, values.get(1) == 255, "255: motors hold their place at rest")
        hold(13, values.get(13) == 0, "0: reports in millimetres")
        # grblHAL has more switches in the bits of $22; bit 0 enables homing.
        hold(22, bool(int(values.get(22, 0)) & 1), "1: homing, without which counters mean nothing")
        if laser in ("M3", "M4"):
            hold(32, values.get(32) == 0, "0: no laser mode, in which light depends on the motion")
        hold(10, bool(int(values.get(10, 0)) & 1), "an odd number, such as 1: machine positions in the status")
        for number in (100, 101, 110, 111, 120, 121):
            high = STEPS_PER_MM_MAX if number < 110 else 1e9
            hold(number, 0 < values.get(number, 0) <= high, f"more than 0, at most {high:g}")
        ramps_s = max(2 * values[110 + axis] / 60 / values[120 + axis] for axis in (0, 1))
        return cls((values[100], values[101]), (values[110], values[111]), values.get(30, 1000.0), ramps_s)

    def counters(self, position_mm: tuple[float, float]) -> tuple[int, int]:
        """Motor steps of (pan, tilt) at a machine position."""
        pan, tilt = (round(p * k) for p, k in zip(position_mm, self.steps_per_mm, strict=True))
        return pan, tilt


@dataclass(frozen=True)
class GrblSettings:
    """Settings of a GRBL board in the rig file.

    Attributes:
        laser: the order that switches it on.
        laser_power: `S` of a spindle order, None for the board's full power.
        unwatched: whether the user accepts that the laser may stay on when the computer crashes.
        limits: soft limits, enforced by this driver.
        speed_steps_per_s: speed of the faster axis, None for the board's own.
    """

    laser: str = "M3"
    laser_power: float | None = None
    unwatched: bool = False
    limits: CounterLimits = UNLIMITED
    speed_steps_per_s: float | None = None

    @classmethod
    def of(cls, table: Mapping[str, str | int | float]) -> GrblSettings:
        """The settings in `[positioner]`.

        Raises:
            InputError: an entry or option that does not belong to a GRBL board.
        """
        for key in FOREIGN_KEYS:
            if key in table:
                remedy = "remove it: ramps and home position are settings of the board, a watchdog it does not have"
                raise _refused(key, str(table[key]), "no entry with a GRBL board", remedy)
        options = driver_options(table, "positioner", OPTIONS)
        laser, power = str(options.get("laser", "M3")), options.get("laser_power")
        speed, unwatched = table.get("speed_steps_per_s"), options.get("unwatched_laser", 0)
        if laser not in LASER_ORDERS:
            remedy = "name what switches the laser: M3 the spindle, M7 mist, M8 flood coolant"
            raise _refused("options.laser", escaped(laser), ", ".join(LASER_ORDERS), remedy)
        # Any text is true in Python, also "false" and "no": it would enable the laser without consent.
        if unwatched not in (0, 1):
            remedy = (
                "write true, without quotes, once something else cuts the light when the computer fails; else false"
            )
            raise _refused("options.unwatched_laser", escaped(str(unwatched)), "true or false (1 or 0)", remedy)
        if power is not None and (isinstance(power, str) or not 0 <= power < math.inf):
            remedy = "write a number without quotes, up to the board's $30, or leave it out for full power"
            raise _refused("options.laser_power", escaped(str(power)), "a number of 0 or more", remedy)
        return cls(
            laser,
            None if power is None else float(power),
            bool(unwatched),
            CounterLimits.of(table),
            None if speed is None else float(speed),
        )


class GrblPositioner:
    """See `interface.Positioner`.

    Args:
        open_link: opens the line; raises OSError while there is none.
        stated: settings from the rig file.
        clock: source of time.

    Raises:
        DeviceFault: nothing answers, or another device does.
        InputError: a setting of the board that does not fit, or more laser power than it has.
    """

    def __init__(self, open_link: Callable[[], Link], stated: GrblSettings | None = None, clock: Clock = time):
        self._settings, self._clock = stated or GrblSettings(), clock
        self._buffer, self._received = bytearray(), bytearray()
        self._pending, self._homed, self._greeted, self._lit, self._done = False, False, False, False, 0
        self._target: tuple[int, int] = (0, 0)
        self._status: Status | None = None
        self.repeats = 0
        """Number of status reports requested again."""
        self.warnings = (NO_WATCHDOG,)
        """Warnings about this kind of board."""
        self._link = opened(open_link)
        try:
            self.identity: dict[str, str] = {"fw": self._greeting(), "driver": "grbl"}
            values = dict(filter(None, map(parse_setting, self._order("$$", REPLY_S))))
            self._board = BoardSettings.of(values, self._settings.laser)
            if (power := self._settings.laser_power or 0.0) > self._board.power_max:
                # The board would apply full power.
                found, allowed = f"{power:g}", f"at most {self._board.power_max:g}, the board's $30"
                raise _refused("options.laser_power", found, allowed, "lower it, or leave it out for full power")
            self.identity |= {f"${number}": f"{values[number]:g}" for number in (100, 101, 110, 111)}
        except BaseException:
            self.close()
            raise

    def home(self) -> HomeReport:
        """See `Positioner.home`; the board reports neither lost steps nor the sense in which homing ends ($23)."""
        self._homed = False
        # A reset ends an alarm and switches the laser off.
        self._greeting()
        self._order("$H", HOME_S)
        self._order("G21 G90 G94", REPLY_S)
        self._homed = True
        state = self.state()
        if state.status != "idle":
            raise fault("stopped", f"homing ended in {state.status}", "home again")
        self._target = (state.pan_steps, state.tilt_steps)
        return HomeReport(self._require_dark(state), (0, 0), known=False, compared=False)

    def move_to(self, pan_steps: int, tilt_steps: int) -> DeviceState:
        """See `Positioner.move_to`."""
        target = (int(pan_steps), int(tilt_steps))
        self._require_homed("a motion")
        for axis, counter in zip(AXES, target, strict=True):
            if not self._settings.limits.allow(axis, counter) or abs(counter) > COUNTERS_MAX:
                found = f"{axis} {counter}, allowed is {self._settings.limits.words(axis)}"
                raise fault("refused-limit", found, "correct the plan or the limits in [positioner]")
        if self._lit:
            self.laser(False)
        start = self._board.counters(self._status_report().position_mm)
        self._target = target
        order, motion_s = self._motion_order(start, target)
        self._order(order, REPLY_S)
        # The board sends its `ok` after completing all earlier orders.
        self._order("G4 P0.01", 5.0 + 2.0 * (motion_s + self._board.ramps_s))
        status = self._status_report()
        if status.state != "Idle":
            raise fault("stopped", f"the motion ended in {status.state}", "home again")
        reached = self._board.counters(status.position_mm)
        if reached != target:
            found = f"the board is at {reached}, ordered was {target}"
            raise fault("position", found, "home again; look for soft limits ($20) and feed hold")
        self._done += 1
        return self._require_dark(self._state(status))

    def laser(self, on: bool) -> DeviceState:
        """See `Positioner.laser`."""
        settings = self._settings
        if on:
            self._require_homed("light")
            if not settings.unwatched:
                raise fault(
                    "laser",
                    "a GRBL board leaves the laser on when this computer fails",
                    "have something else cut it, then write unwatched_laser = true into [positioner.options]",
                )
        order = settings.laser if on else LASER_ORDERS[settings.laser]
        if on and settings.laser in ("M3", "M4"):
            power = self._board.power_max if settings.laser_power is None else settings.laser_power
            order = f"{settings.laser} S{power:g}"
        # Set before the order: after an interruption it is unknown whether the order arrived.
        self._lit = self._lit or on
        try:
            self._order(order, REPLY_S)
            state = self.state()
        except DeviceFault:
            if not on:
                # A reset switches the laser off; at rest the board keeps the position.
                self._write(RESET)
            raise
        if state.laser_on != on:
            self._write(RESET)
            found = f"the laser's mode stayed {'off' if on else 'on'}"
            raise fault("laser", found, "cut the laser's supply and check its wiring")
        self._lit = on
        return state

    def state(self) -> DeviceState:
        """See `Positioner.state`."""
        return self._state(self._status_report())

    def close(self) -> None:
        """See `Positioner.close`; a soft reset ends motion and light at once."""
        try:
            self._link.write(RESET)
            self._link.read(POLL_S)
        except OSError:
            # The board is unplugged: no order reaches it.
            pass
        finally:
            self._link.close()

    def _greeting(self) -> str:
        """Reset the board, which ends motion and light, and read its name."""
        self._greeted = self._pending = False
        self._received.clear()
        for attempt in range(GREETING_ATTEMPTS):
            # The empty line makes other firmware answer as well.
            self._write(RESET + b"\n" if attempt else RESET)
            deadline = self._clock.monotonic() + GREETING_S
            while (line := self._next_line(deadline)) is not None:
                if (name := parse_greeting(line)) is not None:
                    deadline = self._clock.monotonic() + POLL_S
                    while self._next_line(deadline) is not None:
                        # Lines after a greeting, such as the reminder to unlock.
                        pass
                    self._greeted, self._lit = True, False
                    return name
        report = explained(bytes(self._received))
        found, remedy = f"no GRBL board answers: {report.found}", report.remedy
        if any(mark in self._received for mark in (b"!boot", b"!nak", b"<0 ")):
            found, remedy = f"our own firmware answers: {report.found}", 'write driver = "serial" into [positioner]'
        raise fault("no-answer", found, remedy)

    def _motion_order(self, start: tuple[int, int], end: tuple[int, int]) -> tuple[str, float]:
        """The order of a motion in machine coordinates, and its longest duration without ramps, s."""
        board, speed = self._board, self._settings.speed_steps_per_s
        x, y = (n / k for n, k in zip(end, board.steps_per_mm, strict=True))
        steps = [abs(b - a) for a, b in zip(start, end, strict=True)]
        rates = [r * k / 60 for r, k in zip(board.rate_mm_per_min, board.steps_per_mm, strict=True)]
        slowest = [rate if speed is None else min(rate, speed) for rate in rates]
        motion_s = max(n / rate for n, rate in zip(steps, slowest, strict=True))
        if speed is None or not motion_s:
            return f"G53 G0 X{x:.5f} Y{y:.5f}", motion_s
        distance_mm = sum((n / k) ** 2 for n, k in zip(steps, board.steps_per_mm, strict=True)) ** 0.5
        return f"G53 G1 X{x:.5f} Y{y:.5f} F{60 * distance_mm / motion_s:.4f}", motion_s

    def _require_dark(self, state: DeviceState) -> DeviceState:
        """The state after a motion; a laser that is on is a fault."""
        if state.laser_on:
            # At rest the board keeps its position over a reset.
            self._write(RESET)
            raise fault("laser", "the laser is on after a motion", "cut the laser's supply and check the board")
        return state

    def _require_homed(self, action: str) -> None:
        if not self._homed:
            raise fault("refused-unhomed", f"{action} was ordered before homing", "home first")

    def _state(self, status: Status) -> DeviceState:
        modes = [report for line in self._order("$G", REPLY_S) if (report := parse_modes(line))]
        if not modes:
            raise fault("no-answer", "$G was answered without modes", "check the board's firmware: GRBL 1.1 is known")
        # Both coolants may be on at once; M5 and M9 mean off.
        laser_on = self._settings.laser in modes[-1]
        pan, tilt = self._board.counters(status.position_mm)
        word: DeviceStatus = "moving" if status.state in _MOVING else "alarm"
        if status.state == "Idle":
            word = "idle" if self._homed else "unhomed"
        error = "none" if word != "alarm" else escaped(status.state).lower()
        # GRBL homes onto its limit switches: a pressed switch cannot be distinguished from a broken wire.
        pressed = int("X" in status.pins), int("Y" in status.pins)
        return DeviceState(0, word, pan, tilt, *self._target, self._done, laser_on, 0, 0, error, *pressed)

    def _status_report(self) -> Status:
        """Request a status report."""
        self._status = None
        for attempt in range(3):
            self.repeats += attempt > 0
            self._write(ASK)
            deadline = self._clock.monotonic() + REPLY_S
            while self._status is None and (line := self._next_line(deadline)) is not None:
                self._handle_line(line)
            if self._status is not None:
                return self._status
        raise self._no_answer("?")

    def _order(self, order: str, timeout_s: float) -> list[str]:
        """Send one line and wait for its `ok`; returns the lines in between."""
        self._resynchronise()
        self._write(order.encode("ascii") + b"\n")
        self._pending, lines = True, list[str]()
        deadline = self._clock.monotonic() + timeout_s
        while self._pending:
            now = self._clock.monotonic()
            line = self._next_line(min(deadline, now + POLL_S) if timeout_s > REPLY_S else deadline)
            if line is None:
                if self._clock.monotonic() >= deadline:
                    self._give_up(order, timeout_s)
                self._write(ASK)
            elif self._is_answer(line):
                if (error := number_of(line, "error")) is not None:
                    found = f"{order} was refused: error {error}, {ERRORS.get(error, 'see the GRBL manual')}"
                    raise fault(f"refused-{error}", found, "home first" if error == 9 else "see the GRBL manual")
            else:
                self._handle_line(line)
                lines.append(line)
        return lines

    def _is_answer(self, line: str) -> bool:
        """Whether a line ends the wait for an answer, as `ok` and errors do."""
        answers = line == "ok" or number_of(line, "error") is not None
        self._pending = self._pending and not answers
        return answers

    def _resynchronise(self) -> None:
        """Wait for the answer to an interrupted order."""
        deadline = self._clock.monotonic() + REPLY_S
        while self._pending and (line := self._next_line(deadline)) is not None:
            self._is_answer(line)
        if self._pending:
            self._write(RESET)
            raise self._no_answer("an order that was interrupted")

    def _give_up(self, order: str, timeout_s: float) -> None:
        if self._status is not None and self._status.state in _MOVING:
            self._write(HOLD)
            self._write(RESET)
            found = f"{order} is not done after {timeout_s:.0f} s"
            raise fault("stall", found, "look for a blocked axis or a missing home switch; then home again")
        raise self._no_answer(order)

    def _no_answer(self, order: str) -> DeviceFault:
        report = explained(bytes(self._received))
        cause = "nothing was heard" if report.cause == "silence" else report.found
        return self._unreachable(
            "no-answer", f"no answer to {order}: {cause}", "check cable and supply, then go on with --resume"
        )

    def _unreachable(self, code: str, found: str, remedy: str) -> DeviceFault:
        """A fault of a board that cannot be reached: it has no watchdog that switches the laser off."""
        return fault(code, found, f"cut the laser's supply, it may be on; {remedy}" if self._lit else remedy)

    def _handle_line(self, line: str) -> None:
        """Store a status report; raise for an alarm and for a greeting, which means a reset."""
        status, alarm = parse_status(line), number_of(line, "ALARM")
        if status is not None:
            self._status = status
        if alarm is not None:
            self._homed = False
            found = f"the board is in alarm {alarm}: {ALARMS.get(alarm, 'see the GRBL manual')}"
            raise fault(f"alarm-{alarm}", found, "clear the way, check the switches, then home again")
        if parse_greeting(line) is not None and self._greeted:
            self._homed = False
            raise PositionLost(
                "reset",
                "positioner: the board was reset, its counters are lost",
                remedy="check its supply and cable, then go on with --resume: it homes again",
            )

    def _write(self, data: bytes) -> None:
        self._on_line(lambda: self._link.write(data))

    def _on_line[T](self, call: Callable[[], T]) -> T:
        try:
            return call()
        except OSError as error:
            remedy = "plug it in, then go on with --resume: it homes again"
            raise self._unreachable("unplugged", f"the board is gone: {reason(error)}", remedy) from error

    def _next_line(self, deadline_s: float) -> str | None:
        """The next line that is not empty, without its end; None if none is complete by the deadline."""
        while True:
            while (end := self._buffer.find(b"\n")) >= 0:
                line = self._buffer[:end].strip().decode("ascii", "replace")
                del self._buffer[: end + 1]
                if line:
                    return line
            if len(self._buffer) > LINE_CHARS_MAX:
                self._buffer.clear()
            left_s = deadline_s - self._clock.monotonic()
            if left_s <= 0:
                return None
            data = self._on_line(partial(self._link.read, left_s))
            self._buffer += data
            if not self._greeted:
                self._received += data[: max(HEARD_BYTES_MAX - len(self._received), 0)]
