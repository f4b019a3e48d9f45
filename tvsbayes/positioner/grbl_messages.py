r"""Messages of a GRBL board: status reports, modes, settings, errors and alarms of GRBL 1.1, as text.

Lines end in CR LF; an order is answered by `ok` or `error:N`, `?` by `<State|MPos:x,y,z|...>`, and `ALARM:N` or a
greeting is sent without a request. There is no checksum. Positions are millimetres of machine coordinates with three
decimals, or the unit that the user's settings call a millimetre; settings are `$n=value`.

Source: https://github.com/gnea/grbl/wiki (Grbl v1.1 Interface, Configuration, Commands). The module has no state, input
or output.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from tvsbayes.errors import InputError

RESET = b"\x18"
"""Ctrl-X, acted on as soon as it arrives: motion ends, spindle and coolant off. At rest the position is kept."""
HOLD = b"!"
ASK = b"?"
STEPS_PER_MM_MAX = 500.0
"""Positions are reported to 0.0005 mm: beyond this limit that is a quarter of a step and more."""
LASER_ORDERS = {"M3": "M5", "M4": "M5", "M7": "M9", "M8": "M9"}
"""Orders that switch a laser on, with those that switch it off: spindle or coolant."""
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
        """Build from settings, checked against the requirements of positioning and laser.

        Args:
            values: settings by number.
            laser: the order that switches it on.

        Raises:
            InputError: an unsuitable setting, with the required value.
        """
        required = {
            1: (255.0, "motors hold their place at rest"),
            13: (0.0, "reports in millimetres"),
            22: (1.0, "homing, without which counters mean nothing"),
            **({32: (0.0, "no laser mode, in which light depends on the motion")} if laser in ("M3", "M4") else {}),
        }
        for number, (value, reason) in required.items():
            # grblHAL has more switches in the bits of $22; bit 0 enables homing.
            setting = values.get(number)
            valid = setting is not None and (int(setting) & 1 if number == 22 else setting == value)
            if not valid:
                raise _unfit(number, setting, f"{value:g}: {reason}")
        if not int(values.get(10, 0)) & 1:
            raise _unfit(10, values.get(10), "an odd number, such as 1: machine positions in the status")
        for number in (100, 101, 110, 111, 120, 121):
            high = STEPS_PER_MM_MAX if number < 110 else 1e9
            setting = values.get(number)
            if setting is None or not 0 < setting <= high:
                raise _unfit(number, setting, f"more than 0, at most {high:g}")
        steps, rates = (values[100], values[101]), (values[110], values[111])
        pairs = zip(rates, (values[120], values[121]), strict=True)
        ramps_s = max(2 * rate / 60 / acceleration for rate, acceleration in pairs)
        return cls(steps, rates, values.get(30, 1000.0), ramps_s)

    def counters(self, position_mm: tuple[float, float]) -> tuple[int, int]:
        """Motor steps of (pan, tilt) at a machine position."""
        pan, tilt = (round(p * k) for p, k in zip(position_mm, self.steps_per_mm, strict=True))
        return pan, tilt

    def position_mm(self, counters: tuple[int, int]) -> tuple[float, float]:
        """Machine position of counters."""
        x, y = (n / k for n, k in zip(counters, self.steps_per_mm, strict=True))
        return x, y


def _unfit(number: int, setting: float | None, allowed: str) -> InputError:
    found = "nothing" if setting is None else f"{setting:g}"
    remedy = f"set it with any GRBL sender (${number}=...), then connect again"
    message = f"GRBL setting ${number}: found {found}; allowed: {allowed}; {remedy}"
    return InputError("grbl-setting", message, column=f"${number}", found=found, allowed=allowed, remedy=remedy)
