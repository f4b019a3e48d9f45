"""The positioner's serial protocol: frames, CRC-16, requests and replies.

One text line per message, so that it can be typed, logged and searched:

    request     >SEQ COMMAND ARGUMENTS*CRC          >12 MA 200 -40*BAE5
    reply       <SEQ ok|err CODE STATE EXTRA*CRC
    unasked     !boot ...*CRC, !nak frame|crc|parse|long*CRC

CRC is CRC-16/CCITT-FALSE over everything before `*`, four upper-case hexadecimal digits. SEQ is an unsigned 32 bit
number. A request with the sequence of the last one and the same bytes is answered from the cached reply and not
executed again; a lower sequence, or the same one with other content, is refused. All moves are absolute. A host may
therefore repeat an unanswered request any number of times. Four requests have sequence 0, outside the numbering, and
are accepted at any time: `>0 ID` reads the device's last number, from which a host continues counting; `>0 L 0`,
`>0 STOP` and `>0 ABORT` need no number, which a host may have lost. The laser stays on while numbered requests are
accepted; refused and unnumbered requests do not feed its watchdog.

Every reply contains the state: b boot id, st status, p counters, t targets, d sequence of the last motion that
reached its target, l laser, h home deviation, s switches (1 home pressed + 2 limit open), e last error. The end of a
motion is recognised by its sequence in d, never by time.

Counters are absolute motor steps (pan, tilt). The module has no state, input or output.
"""

from __future__ import annotations

import binascii
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, cast

from tvsbayes.instrument.counter_limits import HOME_KEYS, CounterLimits

VERSION = 2
"""Version of this protocol; a device with another version is refused."""
FIRMWARE_VERSION = "1.1.0"
"""Version of the firmware shipped with this package, which the device model reports too."""
START_SPEED = 200
"""Speed of homing, and at which that firmware's motors start and stop without a ramp, steps/s."""
REQUEST_CHARS_MAX = 96
"""Longest request line without its line feed; a longer one is dropped up to the next line feed."""
REPLY_CHARS_MAX = 192
"""Longest reply line without its line feed."""
SEQUENCE_MAX = 2**32 - 1
STEPS_MIN, STEPS_MAX = -(2**31), 2**31 - 1
Status = Literal["unhomed", "idle", "moving", "alarm"]
STATUSES = ("unhomed", "idle", "moving", "alarm")
SETTINGS: dict[str, tuple[int, int, int]] = {
    "vmax": (10, 20_000, 800),
    "amax": (10, 100_000, 4_000),
    "pmin": (-100_000_000, 100_000_000, -1_000),
    "pmax": (-100_000_000, 100_000_000, 1_000),
    "tmin": (-100_000_000, 100_000_000, -500),
    "tmax": (-100_000_000, 100_000_000, 500),
    "hp": (-100_000_000, 100_000_000, -1_200),
    "ht": (-100_000_000, 100_000_000, -700),
    "wd": (100, 10_000, 2_000),
}
"""Lowest, highest and boot value by name: top speed (steps/s), acceleration (steps/s^2), soft limits of pan and tilt
(steps), counters at the home switches (steps), laser watchdog (ms)."""
TRIGGER_US = (10, 1_000_000)
"""Shortest and longest pulse on the trigger line, microseconds."""
UNNUMBERED = frozenset({("ID",), ("L", "0"), ("STOP",), ("ABORT",)})
"""Commands, as words, that have sequence 0."""
LIMIT_SETTINGS = {"pan": ("pmin", "pmax"), "tilt": ("tmin", "tmax")}
"""Soft limits of an axis, lowest first, by their names in the protocol."""
OTHER_SETTINGS = (
    *(("hp", HOME_KEYS["pan"], 1.0), ("ht", HOME_KEYS["tilt"], 1.0)),
    *(("amax", "acceleration_steps_per_s2", 1.0), ("wd", "laser_watchdog_s", 1e-3)),
)
"""Other settings: name in the protocol, entry of `[positioner]`, the protocol's unit in the unit of the entry."""
_INTEGER = re.compile(r"0|-?[1-9][0-9]{0,9}")
_UNSIGNED = re.compile(r"0|[1-9][0-9]{0,9}")
_FRAME = re.compile(rb"([><!][ -)+-~]*)\*([0-9A-F]{4})")
_WORD = re.compile(r"[a-z]+(-[a-z]+)*")
_FIELD = re.compile(r"([a-z]+)=([ -~]+)")
_STATE_KEYS = ("b", "st", "p", "t", "d", "l", "h", "e")
_SWITCHES_KEY = "s"
_OF_STATE = frozenset((*_STATE_KEYS, _SWITCHES_KEY))


class FrameError(ValueError):
    """A line that is not a valid message; `kind` is "frame", "crc" or "parse"."""

    def __init__(self, kind: Literal["frame", "crc", "parse"]):
        super().__init__(kind)
        self.kind = kind


@dataclass(frozen=True, slots=True)
class DeviceState:
    """The state of a device, as contained in every reply.

    Attributes:
        boot: number drawn at every start; a new number means that the counters are lost.
        status: "unhomed", "idle", "moving" (also while homing) or "alarm".
        pan_steps, tilt_steps: counters now.
        pan_target_steps, tilt_target_steps: target of the last motion.
        done_sequence: sequence of the last motion that reached its target, 0 for none.
        laser_on: whether the laser line is on.
        pan_home_deviation_steps, tilt_home_deviation_steps: counter at which the switch was found at the last homing
            minus its expected counter: not zero after lost steps.
        last_error: "none" or a word.
        pan_switches, tilt_switches: 1 where the home switch is pressed, plus 2 where the limit circuit is open.
    """

    boot: int
    status: Status
    pan_steps: int
    tilt_steps: int
    pan_target_steps: int
    tilt_target_steps: int
    done_sequence: int
    laser_on: bool
    pan_home_deviation_steps: int
    tilt_home_deviation_steps: int
    last_error: str
    pan_switches: int = 0
    tilt_switches: int = 0

    @property
    def home_pressed(self) -> tuple[bool, bool]:
        """Whether the home switch of (pan, tilt) is pressed."""
        return bool(self.pan_switches & 1), bool(self.tilt_switches & 1)

    @property
    def limit_open(self) -> tuple[bool, bool]:
        """Whether the limit circuit of (pan, tilt) is open: a limit reached, or a broken wire."""
        return bool(self.pan_switches & 2), bool(self.tilt_switches & 2)


@dataclass(frozen=True, slots=True)
class Reply:
    """An answer: `error` is None for ok, else the reason of refusal; `extra` has the fields besides the state."""

    sequence: int
    error: str | None
    state: DeviceState
    extra: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Unasked:
    """A line that is no answer: "boot" after a start, "nak" for a frame that could not be read."""

    kind: str
    text: str


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, initial value 0xFFFF; "123456789" gives 0x29B1."""
    return binascii.crc_hqx(data, 0xFFFF)


def frame(body: str) -> bytes:
    """A complete line: body, `*`, CRC, line feed."""
    data = body.encode("ascii")
    return data + b"*%04X\n" % crc16(data)


def unframe(line: bytes) -> str:
    """The body of a line (without its line feed), CRC checked.

    Raises:
        FrameError: "frame" for a line that is no message, "crc" for a damaged one.
    """
    match = _FRAME.fullmatch(line)
    if match is None:
        raise FrameError("frame")
    if crc16(match[1]) != int(match[2], 16):
        raise FrameError("crc")
    return match[1].decode("ascii")


def request(sequence: int, command: str, *arguments: object) -> bytes:
    """A request line.

    Raises:
        ValueError: longer than a device accepts.
    """
    line = frame(" ".join(map(str, (f">{sequence}", command, *arguments))))
    if len(line) - 1 > REQUEST_CHARS_MAX:
        raise ValueError(f"request of {len(line)} bytes")
    return line


def unsigned(text: str) -> int | None:
    """A number from 0 to 2^32 - 1 without sign or leading zeros, else None."""
    return value if _UNSIGNED.fullmatch(text) and (value := int(text)) <= SEQUENCE_MAX else None


def signed(text: str) -> int | None:
    """A number from -2^31 to 2^31 - 1 without leading zeros, else None; "-0" is not allowed."""
    return value if _INTEGER.fullmatch(text) and STEPS_MIN <= (value := int(text)) <= STEPS_MAX else None


def state_text(state: DeviceState) -> str:
    """The fields of a state as contained in every reply."""
    return (
        f"b={state.boot} st={state.status} p={state.pan_steps},{state.tilt_steps} "
        f"t={state.pan_target_steps},{state.tilt_target_steps} d={state.done_sequence} l={int(state.laser_on)} "
        f"h={state.pan_home_deviation_steps},{state.tilt_home_deviation_steps} "
        f"s={state.pan_switches},{state.tilt_switches} e={state.last_error}"
    )


def parse_answer(line: bytes) -> Reply | Unasked:
    """Parse a line (without its line feed) from a device.

    Raises:
        FrameError: no message, a damaged message, or other fields than those of this protocol.
    """
    body = unframe(line)
    if body.startswith("!"):
        kind, _, text = body[1:].partition(" ")
        return Unasked(kind, text)
    head, *words = body.split(" ")
    sequence = unsigned(head[1:])
    if not head.startswith("<") or sequence is None or not words:
        raise FrameError("parse")
    error = None
    if words[0] == "err" and len(words) > 1 and _WORD.fullmatch(words[1]):
        error, words = words[1], words[1:]
    elif words[0] != "ok":
        raise FrameError("parse")
    fields: dict[str, str] = {}
    for item in words[1:]:
        match = _FIELD.fullmatch(item)
        if match is None or match[1] in fields:
            raise FrameError("parse")
        fields[match[1]] = match[2]
    return Reply(sequence, error, _state(fields), {k: v for k, v in fields.items() if k not in _OF_STATE})


def _pair(text: str) -> tuple[int, int]:
    numbers = [signed(number) for number in text.split(",")]
    if len(numbers) != 2 or None in numbers:
        raise FrameError("parse")
    return cast("tuple[int, int]", tuple(numbers))


def _state(fields: dict[str, str]) -> DeviceState:
    if any(key not in fields for key in _STATE_KEYS):
        raise FrameError("parse")
    boot, done_sequence = unsigned(fields["b"]), unsigned(fields["d"])
    valid = fields["st"] in STATUSES and fields["l"] in ("0", "1") and _WORD.fullmatch(fields["e"])
    if boot is None or done_sequence is None or not valid:
        raise FrameError("parse")
    # Firmware of protocol 1 reports no switches; it is refused when its version is read.
    switches = _pair(fields.get(_SWITCHES_KEY, "0,0"))
    if not all(0 <= value <= 3 for value in switches):
        raise FrameError("parse")
    return DeviceState(
        boot,
        cast("Status", fields["st"]),
        *_pair(fields["p"]),
        *_pair(fields["t"]),
        done_sequence,
        fields["l"] == "1",
        *_pair(fields["h"]),
        fields["e"],
        *switches,
    )


def device_settings(positioner: Mapping[str, str | int | float]) -> dict[str, int]:
    """Device settings that `[positioner]` of a rig file states: limits, counters at home, ramp and laser watchdog."""
    limits = CounterLimits.of(positioner).steps
    settings = {
        key: limit
        for axis, keys in LIMIT_SETTINGS.items()
        for key, limit in zip(keys, limits[axis], strict=True)
        if limit is not None
    }
    if "speed_steps_per_s" in positioner:
        low, high, _ = SETTINGS["vmax"]
        settings["vmax"] = min(max(round(float(positioner["speed_steps_per_s"])), low), high)
    for key, name, unit in OTHER_SETTINGS:
        if name in positioner:
            settings[key] = round(float(positioner[name]) / unit)
    return settings
