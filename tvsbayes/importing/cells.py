"""Cells of a foreign table by field: numbers in any notation, homings, temperatures, words of a status.

Numbers may be degrees, minutes and seconds, have fractions or include a unit. Assumptions about what the table does not
state are listed in words.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from tvsbayes.errors import InputError, Question, escaped, plural
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.table import ForeignTable
from tvsbayes.importing.words import HOUR_ANGLE, Unit, means, name_of, parse_unit, place_of, unit_named, words_of

WORDS_SHOWN = 5
"""Largest number of status words in a message about excluded rows."""
FLAGS = {"": False, "0": False, "false": False, "no": False, "1": True, "true": True, "yes": True}
"""Cells of a column that marks homings, in lower case."""
SD_PX = 0.1
"""Standard uncertainty of a centroid where a table states none; the fit estimates its scale."""
_SEXAGESIMAL = re.compile(
    r"(?P<sign>[+-]?)\s*(?P<d>\d+)\s*(?:\u00b0|deg|d|:|\s)\s*(?P<m>\d{1,2}(?:\.\d+)?)\s*(?:['\u2032m:]|\s|$)\s*"
    r"(?:(?P<s>\d{1,2}(?:\.\d+)?)\s*(?:\"|''|\u2033|s)?)?"
)
_FRACTION = re.compile(r"(?P<sign>[+-]?)(?:(?P<whole>\d+)[ -])?(?P<above>\d+)/(?P<below>\d+)")
_WITH_UNIT = re.compile(r"(?P<number>[+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?)\s*(?P<unit>[^\d\s.,;+-].*)")


@dataclass(frozen=True)
class PlainColumn:
    """A column of numbers.

    Attributes:
        cells: plain decimal numbers; cells without a number are unchanged.
        unit: the unit stated in the cells.
        remark: the notation of the cells, "" where they were plain.
    """

    cells: tuple[str, ...]
    unit: Unit | None
    remark: str


def plain_column(name: str, cells: Sequence[str]) -> PlainColumn:
    """A column whose cells may be in degrees, minutes and seconds, have fractions or include one unit."""
    if all(NUMBER.fullmatch(cell) or not cell or means(cell, "empty") for cell in cells):
        return PlainColumn(tuple(cells), None, "")
    filled = [cell for cell in cells if cell and not means(cell, "empty")]
    matches = [_WITH_UNIT.fullmatch(cell) for cell in cells if cell]
    units = {match["unit"].strip() if match else "" for match in matches}
    unit = parse_unit(units.pop()) if len(units) == 1 else None
    if unit is not None and unit.name == "K" and place_of(words_of(name), "temperature") is None:
        parts = [_WITH_UNIT.fullmatch(cell) for cell in cells]
        thousands = tuple(
            "" if part is None else repr(1000.0 * float(part["number"].replace(",", "."))) for part in parts
        )
        return PlainColumn(thousands, None, f"column {escaped(name)}: k, thousands")
    if unit is not None and unit.kind != "other":
        found = (_WITH_UNIT.fullmatch(cell) for cell in cells)
        plain = tuple("" if match is None else match["number"].replace(",", ".") for match in found)
        return PlainColumn(plain, unit, f"column {escaped(name)}: every cell is in {unit.name}")
    for value_of, of, words in (
        (_degrees, *_of_sexagesimals(name, filled)),
        (_fraction, None, "fractions"),
    ):
        values = [value_of(cell) if cell else None for cell in cells]
        if all(value is not None or not cell for value, cell in zip(values, cells, strict=True)):
            plain = tuple("" if value is None else repr(value) for value in values)
            return PlainColumn(plain, of, f"column {escaped(name)}: {words}, read as decimal numbers")
    return PlainColumn(tuple(cells), None, "")


def _of_sexagesimals(name: str, cells: Sequence[str]) -> tuple[Unit, str]:
    """The unit of 10:20:30 and what it is called."""
    of_hours = place_of(words_of(name), "hour-angle") is not None or re.search(r"\bh\W*m\W*s\b", name.lower())
    if of_hours and not any({*cell} & {*"\u00b0d"} for cell in cells):
        return HOUR_ANGLE, "hours, minutes and seconds"
    return unit_named("deg"), "degrees, minutes and seconds"


def _degrees(cell: str) -> float | None:
    """Decimal degrees; the sign applies to the sum, also for -0 deg 12 min."""
    match = _SEXAGESIMAL.fullmatch(cell)
    if match is None or NUMBER.fullmatch(cell):
        return None
    minutes, seconds = float(match["m"]), float(match["s"] or 0.0)
    if minutes >= 60 or seconds >= 60:
        return None
    return math.copysign(float(match["d"]) + minutes / 60.0 + seconds / 3600.0, -1.0 if match["sign"] == "-" else 1.0)


def _fraction(cell: str) -> float | None:
    """A number with a common fraction, used for inches: 1 3/8; plain numbers in the same column are allowed."""
    text = cell.removesuffix('"').removesuffix("in").strip()
    if NUMBER.fullmatch(text):
        return float(text)
    match = _FRACTION.fullmatch(text)
    if match is None or not int(match["below"]):
        return None
    sign = -1.0 if match["sign"] == "-" else 1.0
    return sign * (float(match["whole"] or 0) + float(match["above"]) / float(match["below"]))


@dataclass(frozen=True)
class Wishes:
    """What the user states about a table.

    Attributes:
        columns: column by field, "" for none.
        units: of an axis, unit by field, as text.
        angle_unit: of sightings and apertures, unit of angles whose columns state none.
        relative: whether commands or counters are the lengths of moves.
        approach: of two axes, the side from which pan and tilt came to the first row; "unknown" where nobody wrote it.
        deviations: whether readings are actual less commanded position.
        deviation_sign: -1 where deviations are commanded less actual position.
        counts_per_turn: counts after which readings restart; 0: nowhere.
        order: order of runs beside each other, one of `runs.ORDERS`.
        coverage: coverage factor of the column of uncertainties.
        status_ok: number of a status that means a good row.
        no_reading: number that stands for no reading.
        command_turn: whole turn of commands that go on through it; 0: nowhere.
        u_deg: standard uncertainty of a sighting where no column states it.
        pixels_from: coordinate of the centre of the first pixel: 0, or 1 as in MATLAB.
        sd_px: standard uncertainty of a centroid where no column states it.
        pictures: whether the files that a lab book names are at hand.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    angle_unit: str | None = None
    relative: bool = False
    approach: tuple[str, str] = ("unknown", "unknown")
    deviations: bool | None = None
    deviation_sign: float | None = None
    counts_per_turn: float | None = None
    order: str | None = None
    coverage: float | None = None
    status_ok: float | None = None
    no_reading: float | None = None
    command_turn: float | None = None
    u_deg: float | None = None
    pixels_from: int = 0
    sd_px: float = SD_PX
    pictures: bool = False

    def named_in(self, table: ForeignTable) -> Wishes:
        """The same, with the names that a table has for its columns."""
        return replace(self, columns=table.named(self.columns))


@dataclass(frozen=True)
class FieldCells:
    """Cells of a table by field, what the user states about them, and what is assumed of them, in words."""

    table: ForeignTable
    columns: Mapping[str, str]
    wishes: Wishes = field(default_factory=Wishes)
    assumed: list[str] = field(default_factory=list)

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def text(self, name: str) -> list[str]:
        """Cells of a field; empty where the table has no column for it."""
        return list(self.table.columns[self.columns[name]]) if name in self else [""] * len(self.table)

    def shown(self, name: str) -> str:
        """The column of a field, safe to print."""
        return escaped(self.columns[name])

    def values(self, name: str) -> np.ndarray:
        """Numbers of a field in any notation, nan for other cells."""
        cells = plain_column(self.columns[name], self.text(name)).cells
        return np.array([float(cell) if NUMBER.fullmatch(cell) else np.nan for cell in cells])

    def with_texts(self, name: str, texts: Sequence[str]) -> FieldCells:
        """The same with other cells of a field."""
        columns = {**self.table.columns, self.columns[name]: tuple(texts)}
        return replace(self, table=replace(self.table, columns=columns))

    def with_plain(self, *names: str, silent: bool = False) -> tuple[FieldCells, dict[str, Unit | None]]:
        """The cells with plain numbers in these fields, and the units that stood in them; notations are said."""
        plain = {n: plain_column(self.columns[n], self.text(n)) for n in names if n in self}
        self.assumed.extend(column.remark for column in plain.values() if column.remark and not silent)
        cells = self
        for name, column in plain.items():
            cells = cells.with_texts(name, column.cells)
        return cells, {name: column.unit for name, column in plain.items()}

    def numbers(self, name: str, low: float, high: float, *, optional: bool = False) -> list[float | None]:
        """Numbers of a field; None for an empty cell, where it may be empty.

        Raises:
            InputError: a cell is no number from `low` to `high`.
        """
        values: list[float | None] = []
        for row, text in enumerate(self.text(name)):
            is_number = NUMBER.fullmatch(text) is not None
            cell = text if is_number or not means(text, "empty") else ""
            value = float(cell) if is_number else math.nan
            if not (low <= value <= high or (optional and not cell)):
                allowed = f"a number from {low:g} to {high:g} for {name}"
                raise self.refuse(row, name, allowed, "correct the cell, or name another column")
            values.append(value if cell else None)
        return values

    def scaled(self, name: str, unit: Unit, low: float, high: float) -> list[float | None]:
        """Numbers of a field, from `low` to `high` in the base unit of the one in which they are written."""
        scale = unit.scale * unit.per_number
        return [None if v is None else scale * v for v in self.numbers(name, low / scale, high / scale, optional=True)]

    def whole(
        self, name: str, low: int, high: int, *, optional: bool = False, remedy: str = "correct the cell"
    ) -> list[int | None]:
        """Whole numbers of a field; "200.0" is one."""
        values = self.numbers(name, low, high, optional=optional)
        for row, value in enumerate(values):
            if value is not None and not value.is_integer():
                raise self.refuse(row, name, f"a whole number for {name}", remedy)
        return [None if value is None else int(value) for value in values]

    def ask(self, what: str, row: int, name: str, **values: Any) -> Question:
        """A question about one cell."""
        column = self.columns[name]
        said = {"line": self.table.lines[row], "at": column, "cell": self.table.columns[column][row]}
        return self.table.ask(what, **said, **values)

    def refuse(self, row: int, name: str, allowed: str, remedy: str) -> InputError:
        """The error of one cell."""
        return self.table.refuse(row, self.columns[name], allowed, remedy)


def temperatures_of(cells: FieldCells) -> list[float | None]:
    """Temperature of every row, deg C, from degrees Fahrenheit or kelvins where the column's name says so."""
    if "temperature_degC" not in cells:
        return [None] * len(cells.table)
    temperatures = cells.numbers("temperature_degC", -1000.0, 1000.0, optional=True)
    unit = name_of(cells.columns["temperature_degC"]).unit
    if unit is not None and unit.name in ("degF", "K"):
        zero = 32.0 if unit.name == "degF" else 273.15
        temperatures = [None if value is None else unit.scale * (value - zero) for value in temperatures]
        words = {"degF": "degrees of Fahrenheit", "K": "kelvins"}[unit.name]
        cells.assumed.append(f"temperature: {words}, as the column's name says, turned into deg C")
    return temperatures


def mark_of(cell: str) -> str:
    """A cell of a column that marks or numbers homings, without its sign."""
    return cell.lower().removeprefix("+")


def homings_of(cells: FieldCells, *, silent: bool = False) -> list[bool]:
    """Whether the axes homed before each row but the first, which always begins a segment.

    Numbers of segments change at a homing. Where all cells are 0 or 1 and a 0 follows a 1, they are marks instead: each
    1 is a homing, a 0 is none.
    """
    if "segment" not in cells:
        return [False] * len(cells.table)
    words = list(map(mark_of, cells.text("segment")))
    flags = [FLAGS.get(word) for word in words]
    are_marks = None not in flags and any(previous and not current for previous, current in pairwise(flags))
    changes = map(bool, flags[1:]) if are_marks else (previous != current for previous, current in pairwise(words))
    homings = [False, *changes]
    if not silent:
        count, how = sum(homings), "at each 1" if are_marks else "where it changes"
        said = f"segment: {plural(count, 'homing')} after the first row"
        cells.assumed.append(f"{said}, by column {cells.shown('segment')} {how}")
    return homings


# --- status ----------------------------------------------------------------------------------------------------------
def say_left_out(cells: FieldCells, statuses: Sequence[str], noun: str) -> None:
    """Say which rows a column of statuses excludes: an unknown word may mean that the row is good."""
    counts = Counter(escaped(text, 24) for text in statuses if text.strip() and not means(text, "good"))
    words = ", ".join(f"{text} {count}" for text, count in counts.most_common(WORDS_SHOWN))
    if count := counts.total():
        rows, more = plural(count, noun), " ..." * (len(counts) > WORDS_SHOWN)
        cells.assumed.append(f"status: {rows} left out by column {cells.shown('status')}: {words}{more}")


def without_status(cells: FieldCells, noun: str) -> FieldCells:
    """The cells without a column of statuses in which no word is known: it would leave out every row."""
    cells.assumed.append(f"status: column {cells.shown('status')} would leave out every {noun}, so it is none")
    return replace(cells, columns={name: text for name, text in cells.columns.items() if name != "status"})


def status_of(cells: FieldCells, row: int, values: Mapping[str, float | None], noun: str) -> str:
    """The status "ok", or the reason why a row cannot be used, as this package's tables allow it.

    Args:
        cells: cells of the table.
        row: number of the row.
        values: by field; a row that is ok has all of them.
        noun: word for a row.
    """
    text = cells.table.columns[cells.columns["status"]][row] if "status" in cells else ""
    if means(text, "good") or not text.strip():
        for name, value in values.items():
            if value is None:
                allowed = f"a number where the {noun} is ok"
                raise cells.refuse(row, name, allowed, "complete the cell, or its status")
        return "ok"
    return readable(f"refused: {text}" if means(text, "bad") else text, "refused:", 200) or "refused"


def readable(text: str, prefix: str, chars_max: int) -> str:
    """A cell's text as this package's tables allow it: printable, on one line, not a spreadsheet formula.

    Args:
        text: text of the cell.
        prefix: put before a text that begins with = + - or @; removing the signs would make "-50" and "50" equal.
        chars_max: longer texts are cut.
    """
    printable = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return (f"{prefix} {printable}" if printable.startswith(("=", "+", "-", "@")) else printable)[:chars_max]
