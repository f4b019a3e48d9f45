"""Who writes a table, and what was measured: words and units, true axes and their readings, sheets as files."""

from __future__ import annotations

import csv
import io
import math
import re
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

WORDS = tomllib.loads(Path(__file__).with_name("words.toml").read_text(encoding="utf-8"))
LANGUAGES = ("en", "de", "es", "fr")
UNITS: dict[str, tuple[str, float, int]] = {
    **{"nm": ("mm", 1e-6, 0), "um": ("mm", 1e-3, 1), "1/1000 mm": ("mm", 1e-3, 1), "1/100 mm": ("mm", 0.01, 1)},
    **{"thou": ("mm", 0.0254, 2), "mm": ("mm", 1.0, 4), "cm": ("mm", 10.0, 5), "inch": ("mm", 25.4, 5)},
    **{"urad": ("deg", math.degrees(1e-6), 1), "arcsec": ("deg", 1 / 3600, 1), "mrad": ("deg", math.degrees(1e-3), 3)},
    **{"arcmin": ("deg", 1 / 60, 3), "gon": ("deg", 0.9, 4), "deg": ("deg", 1.0, 4), "turn": ("deg", 360.0, 6)},
    **{"rad": ("deg", math.degrees(1.0), 6), "count": ("count", 1.0, 0), "step": ("step", 1.0, 0)},
}
"""Domain, size in it, and the decimals of a reading that suit some micrometres or arc seconds."""
DOMAIN, SCALE, DIGITS = ({unit: of[k] for unit, of in UNITS.items()} for k in range(3))
Cell = Decimal | str
Columns = dict[str, Sequence[Cell]]
"""By their names."""


class Stranger(NamedTuple):
    """Who wrote a table: chances, and a language."""

    rng: np.random.Generator
    language: str

    def pick[Item](self, items: Sequence[Item]) -> Item:
        return items[int(self.rng.integers(len(items)))]

    def chance(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def word(self, name: str) -> Any:
        """One of a list of `words.toml` in this language, or of all languages."""
        of = WORDS[name]
        own = of if isinstance(of, list) else of["all"] if "all" in of and self.chance(0.25) else of[self.language]
        return self.pick(own)

    def unit(self, unit: str) -> str:
        """A unit as somebody of this language writes it."""
        local = WORDS["UNITS"].get(self.language, {}).get(unit, ())
        return self.pick(local if local and self.chance(0.5) else WORDS["UNITS"]["en"][unit])

    def with_unit(self, name: str, unit: str) -> str:
        """The head of a column with its unit; counters mostly without."""
        if unit == "step" and self.chance(0.8):
            return name
        text, style = self.unit(unit), int(self.rng.integers(10))
        if style >= 8 and unit in WORDS["ASCII"] and name.isascii() and "(" not in name:
            return f"{name.replace(' ', '_').replace('.', '')}_{WORDS['ASCII'][unit]}"
        if style == 7 and text.isalpha() and len(text) > 1 and "(" not in name:
            return f"{name} {text}" if self.chance(0.5) else f"{name}, {text}"
        forms = ("{} ({})", "{} [{}]", "{} / {}", "{} ({})", "{} in {}")
        return forms[style % (4 if self.language in ("es", "fr") or "(" in name else 5)].format(name, text)

    def names(self, axis: Axis) -> tuple[str, str]:
        """Names of command and reading, without units."""
        angles = DOMAIN[axis.unit] == "deg"
        reading = self.word("ANGLE_READING" if angles else "LENGTH_READING")
        if axis.command_unit == "step":
            return self.word("STEPS"), reading
        if self.chance(0.3):
            return tuple(self.word("PAIRS"))
        return self.word("ANGLE_COMMAND" if angles and self.chance(0.7) else "COMMAND"), reading


class Reading(NamedTuple):
    """One reading at rest, in the unit of the table; side +1 or -1 is where the command came from, 0 if not told."""

    command: float
    value: float
    side: int = 0
    u: float = 0.0
    segment: int = 0
    time_s: float | None = None


Answer = Literal["right", "either", "ask"]
"""What a careful importer does without an option: reads it, may do either, must ask."""


@dataclass(frozen=True)
class Truth:
    """What the folder must hold.

    Attributes:
        readings: in the order of time.
        unit: of the values; None where the table states none that a reader could know.
        command_unit: of the commands; None where it states none.
        digit: the last digit of a value.
        ratio, play: of the axis, unit per command and unit.
        answer: what is right without an option.
        meant: unit of values whose unit is None, if there is one.
        clock: seconds by which its times may be off; 0 where the table states none.
        cycles: a column of cycles may be taken for homings.
    """

    readings: tuple[Reading, ...]
    unit: str | None
    command_unit: str | None
    digit: float
    ratio: float = 1.0
    play: float = 0.0
    answer: Answer = "right"
    meant: str | None = None
    clock: float = 0.0
    cycles: bool = False


class Stop(NamedTuple):
    """A command in the order of time, the side from which it was reached, and the number of its run."""

    command: Decimal
    side: int
    run: int


@dataclass(frozen=True)
class Axis:
    """A geared axis, and how it is driven and read; `commands` are those of one sweep, rising."""

    command_unit: str
    unit: str
    per_command: float
    play: float
    zero: float
    scatter: float
    commands: tuple[Decimal, ...]

    @property
    def digit(self) -> float:
        """The last one of a reading."""
        return 10.0 ** -DIGITS[self.unit]

    def read(self, stops: Sequence[Stop], by: Stranger) -> list[Decimal]:
        """Readings at stops as they are written down."""
        true = [self.per_command * float(s.command) + self.zero - 0.5 * s.side * self.play for s in stops]
        return [decimal(value + by.rng.normal(0.0, self.scatter), DIGITS[self.unit]) for value in true]

    def truth(self, readings: Sequence[Reading], **more: Any) -> Truth:
        """Of readings in its own units."""
        told = Truth(tuple(readings), self.unit, self.command_unit, self.digit, self.per_command, self.play)
        return replace(told, **more)


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
    """An axis with play of ten or more scatters, read over five to fourteen positions.

    With variety its readings may fall while commands rise, or begin anywhere.
    """
    if by.chance(0.35) if rotary is None else rotary:
        unit = unit or by.pick(("deg", "deg", "deg", "arcmin", "gon", "mrad", "rad", "turn", "arcsec"))
        command_unit = command_unit or by.pick(("step", "step", "deg", "deg", "deg", "gon", "mrad"))
        # Below a turn, so that nothing wraps.
        travel = by.pick((20.0, 30.0, 60.0, 90.0, 180.0)) * (0.02 if unit == "arcsec" else 1.0)
        play, scatter = by.rng.uniform(0.03, 0.15), by.rng.uniform(0.001, 0.004)
    else:
        unit = unit or by.pick(("mm", "mm", "mm", "mm", "um", "1/100 mm", "inch", "thou", "cm"))
        command_unit = command_unit or by.pick(("step", "step", "mm", "mm", "mm", "mm", "inch"))
        travel = by.pick((5.0, 10.0, 50.0, 100.0, 200.0, 300.0)) * (0.1 if unit in ("um", "1/100 mm") else 1.0)
        play, scatter = by.rng.uniform(0.02, 0.08), by.rng.uniform(0.001, 0.002)
    travel, play, scatter = (x / SCALE[unit] for x in (travel, play, scatter))
    commands, per_command = _commands(by, command_unit, unit, travel, int(by.rng.integers(5, 15)))
    zero = by.rng.uniform(-0.4, 0.4) * play
    if variety and command_unit == "step":
        per_command, zero = per_command * by.pick((1, 1, 1, 1, -1)), zero + travel * by.pick((0.0, 0.0, 1.7, -0.6))
    elif variety and command_unit == unit == "mm" and by.chance(0.12):
        # The dial stands elsewhere, or on the other side.
        per_command, zero = per_command * by.pick((1, 1, -1)), zero + by.pick((100.0, 25.0, -10.0))
    axis = Axis(command_unit, unit, per_command, play, zero, scatter, commands)
    # Dials and encoders resolve the play.
    return axis if axis.digit < 0.2 * play else replace(axis, play=5 * axis.digit, scatter=0.5 * axis.digit)


def _commands(by: Stranger, command_unit: str, unit: str, travel: float, count: int) -> tuple[tuple, float]:
    """Round positions over a travel, and the unit per command: near its nominal."""
    nominal = SCALE[command_unit] / SCALE[unit]
    if command_unit == "step":
        nominal = travel / by.pick((2000, 5000, 8000, 20000, 32000))
    span = travel / nominal
    digits = 0 if command_unit == "step" or span > 5 * count else 1 if span > count else 3
    step = max(decimal(span / (count - 1), digits), Decimal(1).scaleb(-digits))
    begin = Decimal(0) if by.chance(0.7) else -step * (count // 2)
    form = Decimal(1).scaleb(-int(by.rng.integers(digits, digits + 2)) if command_unit != "step" else 0)
    return tuple((begin + step * k).quantize(form) for k in range(count)), nominal * (1 + by.rng.normal(0, 0.0015))


def sweep(by: Stranger, commands: Sequence[Decimal], stated: bool) -> list[Stop]:
    """Runs up and down; where directions are stated also from one side alone, or with ends approached from beyond.

    Seldom from the top, or with two readings at a stop.
    """
    style, stops = int(by.rng.integers(3)) if stated else 0, []
    for run in range(0, 2 * int(by.rng.integers(2, 5)), 2):
        up = [Stop(command, 1, run) for command in commands]
        down = [Stop(command, -1, run + 1) for command in reversed(commands)]
        # To and fro without overrun, an end is read once; from beyond both ends; up alone.
        stops += [*up[run > 0 :], *down[1:]] if style == 0 else up + down if style == 1 else up
    if by.chance(0.08):
        stops = [Stop(commands[0] + commands[-1] - stop.command, -stop.side, stop.run) for stop in stops]
    return [stop for stop in stops for _ in range(2)] if by.chance(0.08) else stops


def readings_of(stops: Sequence[Stop], values: Sequence[Decimal], stated: bool) -> list[Reading]:
    """With the sides that are stated, or those that the commands tell."""
    readings: list[Reading] = []
    for stop, value in zip(stops, values, strict=True):
        command, side = float(stop.command), stop.side
        if not stated:
            before = readings[-1] if readings else Reading(command, 0.0)
            side = (command > before.command) - (command < before.command) or before.side
        readings.append(Reading(command, float(value), side))
    return readings


@dataclass
class Sheet:
    """Lines of names, mostly one, and rows below them; lines that stand above."""

    heads: list[list[str]]
    rows: list[list[Cell]]
    above: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, columns: Columns) -> Sheet:
        """Columns by their names."""
        return cls([list(columns)], [list(row) for row in zip(*columns.values(), strict=True)])


class File(NamedTuple):
    """A file to import."""

    name: str
    data: bytes

    def lines(self) -> list[str]:
        """For people to look at; a workbook is none."""
        encoding = "utf-16" if self.data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8"
        return self.data.decode(encoding, "replace").splitlines()


def number(cell: Cell, point: str, form: str = "plain") -> str:
    """A cell as text."""
    if isinstance(cell, str):
        return cell
    text = f"{float(cell):.9E}" if form == "exponent" and cell % 1 else f"{cell:f}"
    text = f"+{text}" if form == "plus" and cell > 0 else text.replace("-", "\u2212") if form == "minus" else text
    return text.replace(".", point)


def preamble(by: Stranger) -> list[str]:
    """Lines that stand above the names."""
    lines = by.rng.permutation(np.array(WORDS["PREAMBLE"][by.language]))[: int(by.rng.integers(1, 4))].tolist()
    return lines + [WORDS["DATE"][by.language]] * by.chance(0.6) + [""] * by.chance(0.5)


def text_file(by: Stranger, sheet: Sheet) -> File:
    """Text with separators, in an encoding of this language, with line ends of either kind."""
    point = "," if by.language != "en" and by.chance(0.75) else "."
    separator = by.pick((";", ";", "\t") if point == "," else (",", ",", ";", "\t", "|"))
    form, quoting = by.pick(("plain",) * 20 + ("plus", "minus", "exponent")), by.pick((csv.QUOTE_MINIMAL,) * 19 + (1,))
    stream = io.StringIO()
    for line in sheet.above:
        # As a spreadsheet exports it: a label and its text in two cells.
        stream.write(line.replace(": ", separator) + "\n" if separator != "," and by.chance(0.3) else line + "\n")
    writer = csv.writer(stream, delimiter=separator, lineterminator="\n", quoting=quoting)
    empty = [""] * int(by.rng.integers(1, 4)) * by.chance(0.03)
    writer.writerows([*sheet.heads, *([number(cell, point, form) for cell in row] + empty for row in sheet.rows)])
    return File(f"log.{by.pick(('csv', 'csv', 'txt', 'dat'))}", encoded(by, stream.getvalue()))


def encoded(by: Stranger, text: str) -> bytes:
    """In an encoding that has all of its letters."""
    text = text.replace("\n", "\r\n") if by.chance(0.4) else text
    try:
        return text.encode(by.pick(("utf-8", "utf-8", "utf-8", "utf-8-sig", "cp1252", "cp1252", "utf-16")))
    except UnicodeEncodeError:
        return text.encode("utf-8")


def workbook(by: Stranger, sheet: Sheet) -> File:
    """XLSX: numbers as numbers, seldom as texts; begun somewhere below and to the right, a summary beside it."""
    import openpyxl

    book = openpyxl.Workbook()
    active, stream = book.active, io.BytesIO()
    as_text, point = by.chance(0.1), "," if by.language != "en" else "."
    left: list[Any] = [None] * int(by.rng.integers(1, 3)) * by.chance(0.12)
    for line in [*([[]] * 2 if left else []), *([line] for line in sheet.above), *sheet.heads]:
        active.append([*left, *line])
    for row in sheet.rows:
        cells = [cell if isinstance(cell, str) else number(cell, point) if as_text else float(cell) for cell in row]
        active.append([*left, *(None if cell == "" else cell for cell in cells)])
    if by.chance(0.08):
        for k, cell in enumerate(("Max", 0.034, "Min", -0.021)):
            active.cell(
                len(sheet.heads) + len(sheet.above) + 3 + k // 2, len(left) + len(sheet.rows[0]) + 2 + k % 2, cell
            )
    if by.chance(0.2):
        book.create_sheet("Sheet2")
    book.save(stream)
    return File("log.xlsx", stream.getvalue())


def markdown(by: Stranger, sheet: Sheet) -> File:
    """A table of a report: names, a rule, rows; bars at the ends or between the cells alone."""
    left, right = by.pick((("| ", " |"), ("| ", " |"), ("", "|"), ("", "")))
    names = [name.replace("|", "/") for name in sheet.heads[-1]]
    rule = [by.pick(("---", "---:", ":---:", "------"))] * len(names)
    lines = [names, rule, *([number(cell, ".") for cell in row] for row in sheet.rows)]
    above = "# Measurements\n\nTable 1, first day.\n\n" * by.chance(0.4) + "".join(
        f"{line}\n\n" for line in sheet.above
    )
    return File("report.md", encoded(by, above + "".join(f"{left}{' | '.join(of)}{right}\n" for of in lines)))


def with_index(by: Stranger, sheet: Sheet) -> None:
    """A first column without a name that counts the rows, as a data frame is saved."""
    sheet.heads = [["", *head] for head in sheet.heads]
    sheet.rows = [[Decimal(k), *row] for k, row in enumerate(sheet.rows)]


def other_case(by: Stranger, sheet: Sheet) -> None:
    """Names without a space before the unit, or in capitals up to it: "mm" is never "MM", u no U."""
    for k, name in enumerate(sheet.heads[0]):
        begin = re.search(r"[(\[/_,]| in |\bmm$", name)
        word = name if begin is None else name[: begin.start()]
        capitals = word.upper() + name[len(word) :] if len(word.strip()) > 1 else name
        sheet.heads[0][k] = capitals if len(sheet.rows) % 2 else name.replace(" (", "(").replace(" [", "[")


def blank_rows(by: Stranger, sheet: Sheet) -> None:
    """Empty rows between others."""
    for place in sorted(by.rng.choice(len(sheet.rows), 2, replace=False).tolist(), reverse=True):
        sheet.rows.insert(place, [""] * len(sheet.rows[0]))


def mean_row(by: Stranger, sheet: Sheet) -> None:
    """Means below the columns."""
    columns = list(zip(*sheet.rows, strict=True))[1:]
    means = [decimal(np.mean([*map(float, c)]), 3) if all(isinstance(x, Decimal) for x in c) else "" for c in columns]
    sheet.rows.append([by.word("MEAN"), *means])


def names_again(by: Stranger, sheet: Sheet) -> None:
    """The names at the top of another page."""
    sheet.rows.insert(len(sheet.rows) // 2, list(sheet.heads[0]))


def units_in_cells(by: Stranger, sheet: Sheet) -> None:
    """10.002 mm in each cell of a column, and no unit at its head."""
    for k, name in enumerate(sheet.heads[0]):
        found = re.fullmatch(r"(.*\w)\s*[(\[](mm|\u00b5m|cm|inch|deg|\u00b0|gon|mrad|in)[)\]]", name)
        if found and all(isinstance(row[k], Decimal) for row in sheet.rows):
            sheet.heads[0][k] = found[1]
            for row in sheet.rows:
                row[k] = number(row[k], "," if by.language != "en" else ".") + " " * (found[2] != "\u00b0") + found[2]


def footer(by: Stranger, sheet: Sheet) -> None:
    """A line of text below the rows."""
    sheet.rows.append([by.word("FOOTER"), *[""] * (len(sheet.rows[0]) - 1)])


QUIRKS: tuple[Callable[[Stranger, Sheet], None], ...] = (
    *(with_index, other_case, other_case, blank_rows, mean_row, names_again, units_in_cells, footer),
)


def any_file(by: Stranger, sheet: Sheet) -> File:
    """Mostly text, a workbook, or Markdown."""
    if not sheet.above and by.chance(0.3):
        sheet.above = preamble(by)
    if len(sheet.heads) == 1 and by.chance(0.25):
        by.pick(QUIRKS)(by, sheet)
    which = by.rng.random()
    if which < 0.12:
        return workbook(by, sheet)
    return markdown(by, sheet) if which < 0.17 and len(sheet.heads) == 1 else text_file(by, sheet)
