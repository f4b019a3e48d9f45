"""True axes, what was read of them and in which order, and units as people write them."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

LENGTH = {
    **{"nm": 1e-6, "um": 1e-3, "1/1000 mm": 1e-3, "1/100 mm": 0.01, "thou": 0.0254, "mm": 1.0, "cm": 10.0},
    "inch": 25.4,
}
"""In mm."""
ANGLE = {
    **{"urad": math.degrees(1e-6), "arcsec": 1 / 3600, "mrad": math.degrees(1e-3), "arcmin": 1 / 60, "gon": 0.9},
    **{"deg": 1.0, "rad": math.degrees(1.0), "turn": 360.0},
}
"""In degrees."""
SCALE = {**LENGTH, **ANGLE, "count": 1.0, "step": 1.0}
DOMAIN = {**dict.fromkeys(LENGTH, "mm"), **dict.fromkeys(ANGLE, "deg"), "count": "count", "step": "step"}
WRITTEN: dict[str, tuple[str, ...]] = {
    "nm": ("nm",),
    "um": ("\u00b5m", "\u03bcm", "um", "micron", "microns"),
    "1/1000 mm": ("1/1000 mm", "0.001 mm", "1/1000mm"),
    "1/100 mm": ("1/100 mm", "0.01 mm", "1/100mm", "0,01 mm"),
    "thou": ("thou", "mil", "mils", "0.001 in", "1/1000 in", '0.001"'),
    "mm": ("mm", "mm", "mm", "millimeter"),
    "cm": ("cm",),
    "inch": ("in", "inch", "inches"),
    "urad": ("\u00b5rad", "urad"),
    "arcsec": ("arcsec", "\u2033", "arc-sec", "arcseconds"),
    "mrad": ("mrad",),
    "arcmin": ("arcmin", "\u2032"),
    "gon": ("gon",),
    "deg": ("deg", "\u00b0", "degrees"),
    "rad": ("rad",),
    "turn": ("rev", "turns", "revs", "turn"),
    "count": ("counts", "cts"),
    "step": ("steps",),
}
"""In English, and in symbols that all use."""
LOCAL: dict[str, dict[str, tuple[str, ...]]] = {
    "de": {
        **{"deg": ("Grad", "°"), "inch": ("Zoll",), "1/100 mm": ("1/100 mm", "0,01 mm", "Hundertstel mm")},
        **{"turn": ("Umdrehungen", "Umdr.", "U"), "arcsec": ("Bogensekunden", "Winkelsekunden")},
        **{"count": ("Inkremente", "Inkr."), "step": ("Schritte",)},
    },
    "es": {"deg": ("grados", "°"), "inch": ("pulgadas", "pulg"), "turn": ("vueltas", "rev"), "step": ("pasos",)},
    "fr": {"deg": ("degrés", "°"), "inch": ("pouces",), "turn": ("tours", "tr"), "step": ("pas",)},
}
ASCII = {
    **{
        name: name for name in ("nm", "um", "mm", "cm", "inch", "urad", "arcsec", "mrad", "arcmin", "gon", "deg", "rad")
    },
    **{"turn": "rev", "count": "counts", "thou": "thou", "step": "steps"},
}
"""What follows an underscore."""
UNKNOWN_UNITS = ("div", "Skt", "Teilstriche", "parts", "divisions", "Strich", "Skalenteile", "graduations", "puntos")
DIGITS = {
    **{"nm": 0, "um": 1, "1/1000 mm": 1, "1/100 mm": 1, "thou": 2, "mm": 4, "cm": 5, "inch": 5, "urad": 1},
    **{"arcsec": 1, "mrad": 3, "arcmin": 3, "gon": 4, "deg": 4, "rad": 6, "turn": 6, "count": 0, "step": 0},
}
"""Decimals that suit a reading of some micrometres, or of some arc seconds."""


WORDS = tomllib.loads(Path(__file__).with_name("words.toml").read_text(encoding="utf-8"))
LANGUAGES = ("en", "de", "es", "fr")


class Stranger(NamedTuple):
    """Who wrote a table: chances, and a language."""

    rng: np.random.Generator
    language: str

    def pick[Item](self, items: Sequence[Item]) -> Item:
        return items[int(self.rng.integers(len(items)))]

    def chance(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def words(self, name: str) -> Any:
        """A list of `words.toml` in this language."""
        return WORDS[name][self.language]

    def word(self, name: str) -> Any:
        """One of a list."""
        return self.pick(self.words(name))

    def unit(self, unit: str) -> str:
        """A unit as somebody of this language writes it."""
        local = LOCAL.get(self.language, {}).get(unit, ())
        return self.pick(local) if local and self.chance(0.5) else self.pick(WRITTEN[unit])

    def with_unit(self, name: str, unit: str) -> str:
        """The head of a column with its unit."""
        style = int(self.rng.integers(10))
        if style >= 8 and unit in ASCII and name.isascii():
            return f"{name.replace(' ', '_').replace('.', '')}_{ASCII[unit]}"
        text = self.unit(unit)
        if style == 7 and text.isalpha() and len(text) > 1:
            return f"{name} {text}" if self.chance(0.5) else f"{name}, {text}"
        forms = ("{} ({})", "{} [{}]", "{} / {}", "{} ({})", "{} in {}")
        return forms[style % 4 if self.language in ("es", "fr") else style % 5].format(name, text)

    def headed(self, name: str, unit: str) -> str:
        """With its unit; counters mostly without."""
        return name if unit == "step" and self.chance(0.8) else self.with_unit(name, unit)

    def names(self, axis: Axis) -> tuple[str, str]:
        """Names of command and reading, without units."""
        steps, angles = axis.command_unit == "step", DOMAIN[axis.unit] == "deg"
        if axis.geared:
            return self.word("MOTOR"), self.word("OUTPUT")
        turned = steps or axis.command_unit == "turn"
        if not turned and self.chance(0.3):
            return self.word("PAIRS")
        if turned:
            command = self.word("STEPS" if steps else "MOTOR")
        else:
            command = self.word("ANGLE_COMMAND" if angles and self.chance(0.7) else "COMMAND")
        return command, self.word("ANGLE_READING" if angles else "LENGTH_READING")

    def sides_column(self, words: Sequence[Any], sides: Sequence[int]) -> dict[str, list[Any]]:
        """A column of directions by its name."""
        return {self.word("DIRECTION"): [words[side < 0] for side in sides]}


class Reading(NamedTuple):
    """One reading at rest, in the unit of the table."""

    command: float
    value: float
    side: int = 0
    """+1 where the command rose to it, -1 where it fell, 0 where the table does not tell."""
    u: float = 0.0
    segment: int = 0
    time_s: float | None = None
    pair: tuple[int, int, float] | None = None
    """Of a head: counters of pan and tilt, and the elevation; `value` is the azimuth, deg."""


Answer = Literal["right", "either", "ask"]
"""What a careful importer does without an option: reads it, may do either, must ask."""


@dataclass(frozen=True)
class Truth:
    """What the folder must hold.

    Attributes:
        readings: in the order of time.
        unit: of the values; None where the table states none that a reader could know.
        meant: unit of values whose unit is None, if there is one.
        command_unit: of the commands; None where it states none.
        digit: the last digit of a value.
        answer: what is right without an option.
        stops: values of one stop may differ by more than a digit (spread, same unit): telemetry at rest.
        kept: how many of the readings must be there; the others may be left out.
        clock: seconds by which its times may be off; 0 where the table states none.
        segments: "exact", or "any" where a column of cycles may be taken for homings.
        ratio: of the axis, unit per command.
        play: of the axis, in the unit.
        also: other truths that are as good.
    """

    readings: tuple[Reading, ...]
    unit: str | None
    command_unit: str | None
    digit: float
    answer: Answer = "right"
    spread: float = 0.0
    kept: int | None = None
    meant: str | None = None
    clock: float = 0.0
    segments: str = "exact"
    ratio: float = 1.0
    play: float = 0.0
    also: tuple[Truth, ...] = ()


@dataclass(frozen=True)
class Axis:
    """A geared axis, and how it is driven and read. Lengths in mm, angles in degrees."""

    command_unit: str
    unit: str
    per_command: float
    play: float
    zero: float
    scatter: float
    commands: tuple[Decimal, ...]
    """Of one sweep, rising."""
    geared: bool = False
    """The command is a motor's, before gears that change it by far."""

    def value(self, command: Decimal, side: int, by: Stranger) -> Decimal:
        """A reading as it is written down."""
        true = self.per_command * float(command) + self.zero - 0.5 * side * self.play
        return decimal(true + by.rng.normal(0.0, self.scatter), self.digits)

    @property
    def digits(self) -> int:
        """Decimals of a reading."""
        return DIGITS[self.unit]

    @property
    def digit(self) -> float:
        """Its last digit."""
        return 10.0**-self.digits


def decimal(number: float, digits: int) -> Decimal:
    """A number as it is written with these decimals."""
    return Decimal(f"{number:.{digits}f}") + 0


def draw_axis(
    by: Stranger,
    rotary: bool | None = None,
    unit: str | None = None,
    command_unit: str | None = None,
    variety: bool = False,
) -> Axis:
    """An axis with play of ten or more scatters, read over five to fourteen positions."""
    rotary = by.chance(0.35) if rotary is None else rotary
    count = int(by.rng.integers(5, 15))
    if rotary:
        unit = unit or by.pick(("deg", "deg", "deg", "arcmin", "gon", "mrad", "rad", "turn", "arcsec"))
        others: tuple[str, ...] = ("step", "step", "deg", "deg", "deg", "gon", "mrad")
        # Below a turn, so that nothing wraps.
        travel_deg = by.pick((20.0, 30.0, 60.0, 90.0, 180.0)) * (0.02 if unit == "arcsec" else 1.0)
        play_deg, scatter_deg = by.rng.uniform(0.03, 0.15), by.rng.uniform(0.001, 0.004)
        travel, play, scatter = (x / ANGLE[unit] for x in (travel_deg, play_deg, scatter_deg))
    else:
        unit = unit or by.pick(("mm", "mm", "mm", "mm", "um", "1/100 mm", "inch", "thou", "cm"))
        others = ("step", "step", "mm", "mm", "mm", "mm", "inch", "turn")
        travel_mm = by.pick((5.0, 10.0, 50.0, 100.0, 200.0, 300.0)) * (0.1 if unit in ("um", "1/100 mm") else 1.0)
        play_mm, scatter_mm = by.rng.uniform(0.02, 0.08), by.rng.uniform(0.001, 0.002)
        travel, play, scatter = (x / LENGTH[unit] for x in (travel_mm, play_mm, scatter_mm))
    command_unit = command_unit or by.pick(others)
    commands, per_command = _commands(by, command_unit, unit, travel, count)
    zero, geared = by.rng.uniform(-0.4, 0.4) * play, False
    if variety:
        if command_unit in ("step", "turn"):
            # Readings that fall, or begin anywhere.
            per_command *= 1 if by.chance(0.8) else -1
            zero += travel * by.rng.uniform(-2, 2) * by.chance(0.3)
        elif command_unit == unit == "mm" and by.chance(0.12):
            # The dial stands elsewhere, or on the other side.
            per_command *= 1 if by.chance(0.7) else -1
            zero += by.pick((100.0, 25.0, -10.0))
        elif command_unit == unit == "deg" and by.chance(0.15):
            geared = True
            ratio = by.pick((2, 5, 10, 36, 50, 100))
            per_command, commands = per_command / ratio, tuple(command * ratio for command in commands)
    axis = Axis(command_unit, unit, per_command, play, zero, scatter, commands, geared)
    # Dials and encoders resolve the play.
    return axis if axis.digit < 0.2 * play else replace(axis, play=5 * axis.digit, scatter=0.5 * axis.digit)


def _commands(
    by: Stranger, command_unit: str, unit: str, travel: float, count: int
) -> tuple[tuple[Decimal, ...], float]:
    """Round positions over a travel, and the unit per command: near its nominal."""
    error = 1 + by.rng.normal(0, 0.0015)
    if DOMAIN[command_unit] == DOMAIN[unit]:
        nominal = SCALE[command_unit] / SCALE[unit]
    elif command_unit == "step":
        nominal = travel / by.pick((2000, 5000, 8000, 20000, 32000))
    else:
        # Turns of a screw's motor.
        nominal = by.pick((1.0, 2.0, 4.0, 5.0)) / LENGTH[unit]
    span = travel / nominal
    digits = 0 if command_unit == "step" or span > 5 * count else 1 if span > count else 3
    step = max(decimal(span / (count - 1), digits), Decimal(1).scaleb(-digits))
    begin = Decimal(0) if by.chance(0.7) else -step * (count // 2)
    form = Decimal(1).scaleb(-int(by.rng.integers(digits, digits + 2))) if command_unit != "step" else Decimal(1)
    return tuple((begin + step * k).quantize(form) for k in range(count)), nominal * error


class Stop(NamedTuple):
    """A command in the order of time, and the side from which it was reached."""

    command: Decimal
    side: int
    run: int
    read: bool = True


@dataclass
class Sweep:
    """How the positions follow each other."""

    stops: list[Stop] = field(default_factory=list)
    stated: bool = False
    """Sides are those of a column of directions, or of runs side by side; else of the commands alone."""

    def told_side(self, number: int) -> int:
        """The side that the table tells of a reading, 0 where none."""
        stop, before = self.stops[number], self.stops[number - 1] if number else None
        if self.stated:
            return stop.side
        if before is None:
            return 0
        rises = (stop.command > before.command) - (stop.command < before.command)
        return rises or self.told_side(number - 1)


def sweeps(by: Stranger, commands: Sequence[Decimal], stated: bool, variety: bool = False) -> Sweep:
    """Runs up and down; with directions stated also from one side alone, and ends approached from beyond.

    With variety also from the top, with several readings at a stop, or with ends that are passed without a reading.
    """
    runs, stops = int(by.rng.integers(2, 5)), []
    style = int(by.rng.integers(3)) if stated else 0
    passed = variety and not stated and by.chance(0.12)
    for run in range(runs):
        up = [Stop(command, 1, 2 * run) for command in commands]
        down = [Stop(command, -1, 2 * run + 1) for command in reversed(commands)]
        if passed:
            beyond = commands[1] - commands[0]
            up = [Stop(commands[0] - beyond, -1, 2 * run, False), *up, Stop(commands[-1] + beyond, 1, 2 * run, False)]
            stops += up + down
        elif style == 0:
            # To and fro without overrun: an end is read once.
            stops += (up if run == 0 else up[1:]) + down[1:]
        elif style == 1:
            stops += up + down
        else:
            stops += up
    if variety and not passed and by.chance(0.12):
        stops = [Stop(commands[0] + commands[-1] - stop.command, -stop.side, stop.run) for stop in stops]
    if variety and not passed and by.chance(0.1):
        stops = [stop for stop in stops for _ in range(2)]
    return Sweep(stops, stated)
