"""Cells of a foreign table by field: numbers in any notation, times, homings, words of a status.

Numbers may be degrees, minutes and seconds, have fractions or include a unit. Assumptions about what the table does not
state are listed in words.
"""

from __future__ import annotations

import datetime
import math
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from tvsbayes.errors import InputError, escaped
from tvsbayes.files.csv_kind import Column
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.files.foreign_table import DAY_S, ForeignTable
from tvsbayes.instrument.campaign import MOVES
from tvsbayes.instrument.column_names import COUNTERS, READING_UNITS, SECONDS, unit_of_name, words_of

GOOD = {
    *("ok", "1", "true", "yes", "good", "valid", "ja", "gut", "gultig", "si", "bien", "bueno", "buena", "valido"),
    *("oui", "bon", "bonne", "valide"),
}
BAD = {
    *("0", "false", "no", "bad", "invalid", "nein", "schlecht", "ungultig", "mal", "malo", "mala", "invalido"),
    *("non", "mauvais", "mauvaise", "invalide"),
}
"""Words of a status, in lower case without accents."""
WORDS_SHOWN = 5
"""Largest number of status words in a message about excluded rows."""
NO_NUMBER = {"nan", "n/a", "#n/a", "null"}
"""Entries of programs in a cell without a number, in lower case."""
EPOCH_SCALES = {1e17: 1e-9, 1e14: 1e-6, 1e11: 1e-3}
"""Seconds per unit by the least number that counts this unit since 1970; smaller numbers are seconds."""
_FLAGS = {"": False, "0": False, "false": False, "1": True, "true": True}
"""Cells of a column that marks homings, in lower case."""
_CLOCK = re.compile(r"[0-9]{1,2}:[0-9]{2}:[0-9]{2}(?:\.[0-9]{1,6})?")
_DOTTED_DATE = re.compile(r"([0-9]{1,2})\.([0-9]{1,2})\.([0-9]{4})[ ,T]+")
"""Day, month and year: the only order written with dots."""
_SEXAGESIMAL = re.compile(
    r"(?P<sign>[+-]?)\s*(?P<d>\d+)\s*(?:\u00b0|deg|d|:|\s)\s*(?P<m>\d{1,2}(?:\.\d+)?)\s*(?:['\u2032m:]|\s|$)\s*"
    r"(?:(?P<s>\d{1,2}(?:\.\d+)?)\s*(?:\"|''|\u2033|s)?)?"
)
_FRACTION = re.compile(r"(?P<sign>[+-]?)(?:(?P<whole>\d+)[ -])?(?P<above>\d+)/(?P<below>\d+)")
_WITH_UNIT = re.compile(r"(?P<number>[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(?P<unit>[^\d\s.,;+-].*)")


@dataclass(frozen=True)
class PlainColumn:
    """A column of numbers.

    Attributes:
        cells: plain decimal numbers; cells without a number are unchanged.
        unit: the unit stated in the cells.
        remark: the notation of the cells, "" where they were plain.
    """

    cells: tuple[str, ...]
    unit: str | None
    remark: str


def plain_column(name: str, cells: Sequence[str]) -> PlainColumn:
    """A column whose cells may be in degrees, minutes and seconds, have fractions or include one unit."""
    filled = [cell for cell in cells if cell]
    if all(NUMBER.fullmatch(cell) for cell in filled):
        return PlainColumn(tuple(cells), None, "")
    for read in (_in(_degrees, "deg", "degrees, minutes and seconds"), _one_unit, _in(_fraction, None, "fractions")):
        if (column := read(name, cells)) is not None:
            return column
    return PlainColumn(tuple(cells), None, "")


def _in(
    value_of: Callable[[str], float | None], unit: str | None, words: str
) -> Callable[[str, Sequence[str]], PlainColumn | None]:
    """A reader of columns in one notation."""

    def read(name: str, cells: Sequence[str]) -> PlainColumn | None:
        values = [value_of(cell) if cell else None for cell in cells]
        if any(value is None and cell for value, cell in zip(values, cells, strict=True)):
            return None
        plain = tuple("" if value is None else repr(value) for value in values)
        return PlainColumn(plain, unit, f"column {escaped(name)}: {words}, read as decimal numbers")

    return read


def _one_unit(name: str, cells: Sequence[str]) -> PlainColumn | None:
    """A column whose cells all include the same unit."""
    matches = [_WITH_UNIT.fullmatch(cell) if cell else None for cell in cells]
    units = {match["unit"].strip() for match in matches if match}
    if len(units) != 1 or any(match is None and cell for match, cell in zip(matches, cells, strict=True)):
        return None
    text = units.pop()
    unit = "inch" if text == '"' else unit_of_name(text, READING_UNITS)
    if unit is None:
        return None
    plain = tuple("" if match is None else match["number"] for match in matches)
    return PlainColumn(plain, unit, f"column {escaped(name)}: every cell is in {unit}")


def _degrees(cell: str) -> float | None:
    """Decimal degrees; the sign applies to the sum, also for -0 deg 12 min."""
    match = _SEXAGESIMAL.fullmatch(cell)
    if match is None or NUMBER.fullmatch(cell):
        return None
    minutes, seconds = float(match["m"]), float(match["s"] or 0.0)
    if minutes >= 60 or seconds >= 60:
        return None
    return math.copysign(int(match["d"]) + minutes / 60.0 + seconds / 3600.0, -1.0 if match["sign"] == "-" else 1.0)


def _fraction(cell: str) -> float | None:
    """A number with a common fraction, used for inches: 1 3/8; plain numbers in the same column are allowed."""
    text = cell.removesuffix('"').removesuffix("in").strip()
    if NUMBER.fullmatch(text):
        return float(text)
    match = _FRACTION.fullmatch(text)
    if match is None or not int(match["below"]):
        return None
    return (-1.0 if match["sign"] == "-" else 1.0) * (
        int(match["whole"] or 0) + int(match["above"]) / int(match["below"])
    )


@dataclass(frozen=True)
class FieldCells:
    """Cells of a table by field."""

    table: ForeignTable
    columns: Mapping[str, str]

    def __contains__(self, field: str) -> bool:
        return field in self.columns

    def text(self, field: str) -> list[str]:
        """Cells of a field; empty where the table has no column for it."""
        return list(self.table.columns[self.columns[field]]) if field in self else [""] * len(self.table)

    def read(self, column: Column, low: float | None = None, high: float | None = None, optional: bool = False) -> list:
        """Values of a column of this package's files; an empty cell is the default, or None where `optional` allows it.

        Args:
            column: its limits apply where no others are given; "200.0" is a whole number.
            low: replaces the column's limit.
            high: replaces the column's limit.
            optional: whether a cell may be empty although the column has no default.
        """
        field, optional = column.name, optional or column.may_be_empty
        default = column.default if column.may_be_empty else None
        lowest, highest = column.low if low is None else low, column.high if high is None else high
        values: list[Any] = []
        for row, text in enumerate(self.text(field)):
            cell = "" if text.lower() in NO_NUMBER else text
            value = float(cell) if NUMBER.fullmatch(cell) else math.nan
            if not cell and optional:
                values.append(default)
            elif not lowest <= value <= highest:
                remedy = "correct the cell, or name another column"
                raise self.refuse(row, field, f"a number from {lowest:g} to {highest:g} for {field}", remedy)
            elif column.kind is int and not value.is_integer():
                remedy = "give the counters of the motors; angles are what the fit finds" if field in COUNTERS else ""
                raise self.refuse(row, field, f"a whole number for {field}", remedy or "correct the cell")
            else:
                values.append(column.kind(value))
        return values

    def refuse(self, row: int, field: str, allowed: str, remedy: str) -> InputError:
        """The error of one cell."""
        return self.table.refuse(row, self.columns[field], allowed, remedy)


def temperatures_of(cells: FieldCells, assumed: list[str]) -> list[float | None]:
    """Temperature of every row, deg C, from degrees Fahrenheit or kelvins where the column's name says so."""
    if "temperature_degC" not in cells:
        return [None] * len(cells.table)
    words = set(words_of(cells.columns["temperature_degC"]))
    unit = "Fahrenheit" if words & {"f", "fahrenheit"} else "kelvin" if words & {"k", "kelvin"} else ""
    temperatures = cells.read(MOVES["temperature_degC"])
    if unit:
        factor, zero = (1 / 1.8, 32.0) if unit == "Fahrenheit" else (1.0, 273.15)
        temperatures = [None if value is None else factor * (value - zero) for value in temperatures]
        assumed.append(f"temperature: degrees of {unit}, as the column's name says, turned into deg C")
    return temperatures


def homings_of(cells: FieldCells, assumed: list[str]) -> list[bool]:
    """Whether the axes homed before each row but the first, which always begins a segment.

    Numbers of segments change at a homing. Where all cells are 0 or 1 and a 0 follows a 1, they are marks instead: each
    1 is a homing, a 0 is none.
    """
    if "segment" not in cells:
        return [False] * len(cells.table)
    words = [word.lower() for word in cells.text("segment")]
    flags = [_FLAGS.get(word) for word in words]
    are_marks = None not in flags and any(previous and not current for previous, current in pairwise(flags))
    changes = map(bool, flags[1:]) if are_marks else (previous != current for previous, current in pairwise(words))
    homings = [False, *changes]
    count, name = sum(homings), escaped(cells.columns["segment"])
    how = "at each 1" if are_marks else "where it changes"
    assumed.append(f"segment: {count} homing{'s' * (count != 1)} after the first row, by column {name} {how}")
    return homings


def _iso_date(dotted: re.Match[str]) -> str:
    day, month, year = dotted.groups()
    return f"{year}-{month:0>2}-{day:0>2}T"


def seconds_of(cells: FieldCells, assumed: list[str]) -> list[float] | None:
    """Seconds of every row: numbers in the unit of the column's name, or dates with times."""
    if "time_s" not in cells:
        return None
    texts = cells.text("time_s")
    if all(NUMBER.fullmatch(cell) for cell in texts):
        unit = unit_of_name(cells.columns["time_s"], SECONDS)
        scale = SECONDS.get(unit or "", 1.0)
        seconds = [scale * float(cell) for cell in texts]
        epoch_scale = next((s for least, s in EPOCH_SCALES.items() if seconds and seconds[0] >= least), None)
        if unit is None and epoch_scale is not None:
            seconds = [epoch_scale * (value - seconds[0]) for value in seconds]
            assumed.append(f"time_s: counted in {epoch_scale:g} s since 1970, so seconds since the first row")
    else:
        seconds = []
        for row, cell in enumerate(texts):
            try:
                if _CLOCK.fullmatch(cell):
                    clock = datetime.time.fromisoformat(cell.zfill(8))
                    day_s = datetime.datetime.combine(datetime.date(1970, 1, 1), clock, datetime.UTC).timestamp()
                    next_day = seconds and day_s < seconds[-1] % DAY_S
                    seconds.append(day_s + DAY_S * ((seconds[-1] // DAY_S if seconds else 0) + bool(next_day)))
                    continue
                date_time = datetime.datetime.fromisoformat(_DOTTED_DATE.sub(_iso_date, cell, count=1))
                # A time without zone is UTC: this computer's daylight saving time is not the logger's.
                seconds.append((date_time if date_time.tzinfo else date_time.replace(tzinfo=datetime.UTC)).timestamp())
            except ValueError as error:
                allowed = "seconds, or a date and time such as 2026-01-15T10:00:00 or 15.01.2026 10:00:00"
                raise cells.refuse(row, "time_s", allowed, "correct the cell, or write --column time_s=") from error
        seconds = [value - seconds[0] for value in seconds]
        assumed.append("time_s: seconds since the first row")
    for row in range(1, len(seconds)):
        if seconds[row] < seconds[row - 1]:
            remedy = "sort the rows as they happened: play remembers the order"
            raise cells.refuse(row, "time_s", "times that do not decrease", remedy)
    return seconds


def word_of(status: str) -> str:
    """A cell of a status in lower case without accents, as in `GOOD` and `BAD`."""
    plain = unicodedata.normalize("NFKD", status.strip().lower())
    return "".join(letter for letter in plain if not unicodedata.combining(letter))


def left_out(cells: FieldCells, statuses: Iterable[str], noun: str) -> list[str]:
    """A sentence on the rows excluded by a column of statuses: an unknown word may mean that the row is good."""
    counts = Counter(escaped(text, 24) for text in statuses if text.strip() and word_of(text) not in GOOD)
    if not counts:
        return []
    listed = [f"{text} {count}" for text, count in counts.most_common(WORDS_SHOWN)]
    words = ", ".join(listed) + " ..." * (len(counts) > WORDS_SHOWN)
    count = sum(counts.values())
    return [
        f"status: {count} {noun}{'s' * (count != 1)} left out by column {escaped(cells.columns['status'])}: {words}"
    ]


def status_of(cells: FieldCells, row: int, values: Mapping[str, float | None], noun: str) -> str:
    """The status "ok", or the reason why a row cannot be used, as this package's tables allow it.

    Args:
        cells: cells of the table.
        row: number of the row.
        values: by field; a row that is ok has all of them.
        noun: word for a row.
    """
    text = cells.text("status")[row]
    if (word := word_of(text)) in GOOD or not word:
        for field, value in values.items():
            if value is None:
                allowed = f"a number where the {noun} is ok"
                raise cells.refuse(row, field, allowed, "complete the cell, or its status")
        return "ok"
    return readable(f"refused: {text}" if word_of(text) in BAD else text, "refused:", 200) or "refused"


def readable(text: str, prefix: str, chars_max: int) -> str:
    """A cell's text as this package's tables allow it: printable, on one line, not a spreadsheet formula.

    Args:
        text: text of the cell.
        prefix: put before a text that begins with = + - or @; removing the signs would make "-50" and "50" equal.
        chars_max: longer texts are cut.
    """
    printable = "".join(c if c.isprintable() else " " for c in text)
    printable = " ".join(printable.split())
    return (f"{prefix} {printable}" if printable.startswith(("=", "+", "-", "@")) else printable)[:chars_max]
