"""Cells and columns of a foreign table by field: numbers in any notation, times, homings, words of a status; questions.

Numbers may be degrees, minutes and seconds, have fractions or include a unit. Assumptions about what the table does not
state are listed in words.
"""

from __future__ import annotations

import datetime
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice, pairwise
from typing import Any

import numpy as np

from tvsbayes.errors import Candidate, InputError, Question, closest, escaped
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.asking import listed, refused
from tvsbayes.importing.table import ForeignTable
from tvsbayes.importing.words import Name, Unit, means, name_of, parse_unit, unit_named

DAY_S = 86400.0
SUMMER_TIME_S = 3600.0
WORDS_SHOWN = 5
"""Largest number of status words in a message about excluded rows."""
SEGMENT_MAX, SEGMENT_SHARE = 1000, 0.5
"""A segment is a whole number up to the first, that changes in at most this share of the rows."""
EPOCH_SCALES = {1e17: 1e-9, 1e14: 1e-6, 1e11: 1e-3}
"""Seconds per unit by the least number that counts this unit since 1970; smaller numbers are seconds."""
_FLAGS = {"": False, "0": False, "false": False, "no": False, "1": True, "true": True, "yes": True}
"""Cells of a column that marks homings, in lower case."""
_CLOCK = re.compile(r"[0-9]{1,2}:[0-9]{2}:[0-9]{2}(?:\.[0-9]{1,9})?(?: ?[AaPp][Mm])?|[0-9]{1,2}:[0-9]{2}")
_DOTTED_DATE = re.compile(r"([0-9]{1,2})\.([0-9]{1,2})\.([0-9]{4})(?:[ ,T]+|$)")
"""Day, month and year: the only order written with dots."""
_SLASHED_DATE = re.compile(r"([0-9]{4})/([0-9]{1,2})/([0-9]{1,2})(?:[ ,T]+|$)")
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
    filled = [cell for cell in cells if cell and not means(cell, "empty")]
    if all(NUMBER.fullmatch(cell) for cell in filled):
        return PlainColumn(tuple(cells), None, "")
    notations: tuple[tuple[Callable[[str], float | None], str, str], ...] = (
        (_degrees, "deg", "degrees, minutes and seconds"),
        (_fraction, "", "fractions"),
    )
    if (column := _one_unit(name, cells)) is not None:
        return column
    for value_of, unit, words in notations:
        values = [value_of(cell) if cell else None for cell in cells]
        if all(value is not None or not cell for value, cell in zip(values, cells, strict=True)):
            plain = tuple("" if value is None else repr(value) for value in values)
            remark = f"column {escaped(name)}: {words}, read as decimal numbers"
            return PlainColumn(plain, unit_named(unit) if unit else None, remark)
    return PlainColumn(tuple(cells), None, "")


def _one_unit(name: str, cells: Sequence[str]) -> PlainColumn | None:
    """A column whose cells all include the same unit."""
    matches = [_WITH_UNIT.fullmatch(cell) if cell else None for cell in cells]
    units = {match["unit"].strip() for match in matches if match}
    if len(units) != 1 or any(match is None and cell for match, cell in zip(matches, cells, strict=True)):
        return None
    unit = parse_unit(units.pop())
    if unit is None or unit.kind == "other":
        return None
    plain = tuple("" if match is None else match["number"].replace(",", ".") for match in matches)
    return PlainColumn(plain, unit, f"column {escaped(name)}: every cell is in {unit.name}")


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
    sign = -1.0 if match["sign"] == "-" else 1.0
    return sign * (int(match["whole"] or 0) + int(match["above"]) / int(match["below"]))


@dataclass(frozen=True)
class FieldCells:
    """Cells of a table by field, and the options by which a question about them is answered."""

    table: ForeignTable
    columns: Mapping[str, str]

    def __contains__(self, field: str) -> bool:
        return field in self.columns

    def text(self, field: str) -> list[str]:
        """Cells of a field; empty where the table has no column for it."""
        return list(self.table.columns[self.columns[field]]) if field in self else [""] * len(self.table)

    def with_plain(self, *fields: str) -> tuple[FieldCells, dict[str, PlainColumn]]:
        """The cells with plain numbers in these fields, and what their notation was."""
        plain = {f: plain_column(self.columns[f], self.text(f)) for f in fields if f in self}
        columns = {**self.table.columns, **{self.columns[f]: column.cells for f, column in plain.items()}}
        return replace(self, table=replace(self.table, columns=columns)), plain

    def numbers(
        self,
        field: str,
        low: float,
        high: float,
        *,
        optional: bool = False,
        default: float | None = None,
        what: str = "",
    ) -> list[float | None]:
        """Numbers of a field; an empty cell is the default where it may be empty.

        Raises:
            InputError: a cell is no number from `low` to `high`.
        """
        values: list[float | None] = []
        for row, text in enumerate(self.text(field)):
            cell = "" if means(text, "empty") else text
            value = float(cell) if NUMBER.fullmatch(cell) else math.nan
            if not cell and (optional or default is not None):
                values.append(default)
            elif not low <= value <= high:
                allowed = what or f"a number from {low:g} to {high:g} for {field}"
                raise self.refuse(row, field, allowed, "correct the cell, or name another column")
            else:
                values.append(value)
        return values

    def whole(
        self, field: str, low: int, high: int, *, optional: bool = False, remedy: str = "correct the cell"
    ) -> list[int | None]:
        """Whole numbers of a field; "200.0" is one."""
        values = self.numbers(field, low, high, optional=optional)
        for row, value in enumerate(values):
            if value is not None and not value.is_integer():
                raise self.refuse(row, field, f"a whole number for {field}", remedy)
        return [None if value is None else int(value) for value in values]

    def ask(self, what: str, row: int, field: str, **values: Any) -> Question:
        """A question about one cell."""
        column = self.columns[field]
        said = {"line": self.table.lines[row], "at": column, "cell": self.table.columns[column][row]}
        return self.table.ask(what, **said, **values)

    def refuse(self, row: int, field: str, allowed: str, remedy: str) -> InputError:
        """The error of one cell."""
        return self.table.refuse(row, self.columns[field], allowed, remedy)


def temperatures_of(cells: FieldCells, assumed: list[str]) -> list[float | None]:
    """Temperature of every row, deg C, from degrees Fahrenheit or kelvins where the column's name says so."""
    if "temperature_degC" not in cells:
        return [None] * len(cells.table)
    temperatures = cells.numbers("temperature_degC", -1000.0, 1000.0, optional=True)
    unit = name_of(cells.columns["temperature_degC"]).unit
    if unit is not None and unit.name in ("degF", "K"):
        zero = 32.0 if unit.name == "degF" else 273.15
        temperatures = [None if value is None else unit.scale * (value - zero) for value in temperatures]
        words = {"degF": "degrees of Fahrenheit", "K": "kelvins"}[unit.name]
        assumed.append(f"temperature: {words}, as the column's name says, turned into deg C")
    return temperatures


def is_segment(cells: Sequence[str]) -> bool:
    """Whether cells can count homings or mark them: few small whole numbers or marks that seldom change."""
    words = [word.lower() for word in cells]
    if not all(word in _FLAGS or (word.isdigit() and int(word) <= SEGMENT_MAX) for word in words):
        return all(not NUMBER.fullmatch(word) for word in words) and _changes(words) <= SEGMENT_SHARE * len(words)
    return _changes(words) <= SEGMENT_SHARE * max(len(words), 4)


def _changes(words: Sequence[str]) -> int:
    return sum(a != b for a, b in pairwise(words))


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


# --- times -----------------------------------------------------------------------------------------------------------
def date_time(text: str) -> datetime.datetime | None:
    """A date with or without a time; None for other texts. Without a zone it is UTC, not this computer's."""
    text = _SLASHED_DATE.sub(r"\1-\2-\3T", _DOTTED_DATE.sub(_iso_date, text.strip(), count=1), count=1).rstrip("T")
    try:
        at = datetime.datetime.fromisoformat(text)
    except ValueError:
        for form in ("%Y-%m-%dT%I:%M:%S %p", "%d-%b-%Y %H:%M:%S", "%b %d, %Y %H:%M:%S"):
            try:
                at = datetime.datetime.strptime(text, form)
                break
            except ValueError:
                continue
        else:
            return None
    return at if at.tzinfo else at.replace(tzinfo=datetime.UTC)


def _iso_date(dotted: re.Match[str]) -> str:
    day, month, year = dotted.groups()
    return f"{year}-{month:0>2}-{day:0>2}T"


def time_of_day(text: str) -> float | None:
    """Seconds since midnight of "9:05:12.25", "9:05" or "9:05:12 PM"; None for other texts."""
    if not _CLOCK.fullmatch(text):
        return None
    hours, minutes, *rest = text.rstrip("AaPpMm ").split(":")
    hour, half = int(hours), text[-2:].lower()
    if half in ("am", "pm"):
        hour = hour % 12 + 12 * (half == "pm")
    seconds = float(rest[0]) if rest else 0.0
    return hour * 3600.0 + int(minutes) * 60.0 + seconds if hour < 24 and int(minutes) < 60 and seconds < 61 else None


def is_clock(cells: Sequence[str]) -> bool:
    """Whether all filled cells are dates or times of day."""
    filled = [cell for cell in cells if cell]
    return bool(filled) and all(time_of_day(cell) is not None or date_time(cell) is not None for cell in filled)


def seconds_of(cells: FieldCells, assumed: list[str], unit: Unit | None = None) -> list[float] | None:
    """Seconds of every row: numbers in the unit of the column's name or the given one, dates with times, times of day.

    Raises:
        Question: the times step back.
        InputError: a cell is no time.
    """
    if "time_s" not in cells:
        return None
    texts = cells.text("time_s")
    if all(NUMBER.fullmatch(cell) for cell in texts):
        unit = unit or name_of(cells.columns["time_s"]).unit
        scale = unit.scale if unit is not None and unit.kind == "time" else 1.0
        # Epochs in ns need more digits than a float has.
        start = int(texts[0]) if texts and texts[0].isdigit() else float(texts[0] or 0.0)
        epoch_scale = next((s for least, s in EPOCH_SCALES.items() if start >= least), None)
        if unit is None and epoch_scale is not None:
            seconds = [epoch_scale * ((int(cell) if cell.isdigit() else float(cell)) - start) for cell in texts]
            assumed.append(f"time_s: counted in {epoch_scale:g} s since 1970, so seconds since the first row")
        else:
            seconds = [scale * float(cell) for cell in texts]
        is_local = False
    else:
        seconds, is_local = _written_times(cells, texts)
        assumed.append("time_s: seconds since the first row")
    return _in_order(cells, seconds, is_local, assumed)


def first_date(cells: FieldCells) -> datetime.datetime | None:
    """When the first row was written, where its time has a date; with a zone where the cell has one."""
    first = cells.text("time_s")[0] if "time_s" in cells else ""
    at = None if NUMBER.fullmatch(first) or time_of_day(first) is not None else date_time(first)
    has_zone = re.search(r"(?:Z|[+-]\d\d:?\d\d)$", first.strip()) is not None
    return at if at is None or has_zone else at.replace(tzinfo=None)


def _written_times(cells: FieldCells, texts: Sequence[str]) -> tuple[list[float], bool]:
    """Seconds since the first row of dates or times of day; whether a clock with summer time may have written them."""
    seconds: list[float] = []
    is_local = True
    for row, cell in enumerate(texts):
        of_day, at = time_of_day(cell), date_time(cell)
        if of_day is not None:
            day = DAY_S * (seconds[-1] // DAY_S if seconds else 0)
            # A step back by more than half a day is midnight.
            of_day += day + DAY_S * bool(seconds and day + of_day < seconds[-1] - DAY_S / 2)
        elif at is None:
            allowed = "seconds, or a date and time such as 2026-01-15T10:00:00 or 15.01.2026 10:00:00"
            raise cells.refuse(row, "time_s", allowed, "correct the cell, or write --column time_s=")
        seconds.append(at.timestamp() if at is not None else of_day or 0.0)
        is_local = is_local and not re.search(r"(?:Z|[+-]\d\d:?\d\d)$", cell)
    return [value - seconds[0] for value in seconds], is_local


def _in_order(cells: FieldCells, seconds: list[float], is_local: bool, assumed: list[str]) -> list[float]:
    """Times that do not decrease; a clock set back from summer time is set forward again, once.

    Raises:
        Question: the times step back for another reason.
    """
    moved = 0.0
    for row in range(1, len(seconds)):
        seconds[row] += moved
        step = seconds[row] - seconds[row - 1]
        if is_local and not moved and -SUMMER_TIME_S <= step < -0.25 * SUMMER_TIME_S:
            moved, seconds[row] = SUMMER_TIME_S, seconds[row] + SUMMER_TIME_S
            line = cells.table.lines[row]
            assumed.append(
                f"time_s: the clock steps back in line {line}, as at the end of summer time: an hour added from there"
            )
        elif step < 0:
            raise cells.ask("clock-back", row, "time_s", back=-step)
    return seconds


# --- status ----------------------------------------------------------------------------------------------------------
def left_out(cells: FieldCells, statuses: Sequence[str], noun: str) -> list[str]:
    """A sentence on the rows excluded by a column of statuses: an unknown word may mean that the row is good."""
    counts = Counter(escaped(text, 24) for text in statuses if text.strip() and not means(text, "good"))
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
    if means(text, "good") or not text.strip():
        for field, value in values.items():
            if value is None:
                allowed = f"a number where the {noun} is ok"
                raise cells.refuse(row, field, allowed, "complete the cell, or its status")
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


SAMPLES = 3
"""Number of first values of a column to show."""
NUMERIC_SHARE = 0.5


@dataclass(frozen=True)
class Column:
    """A column: its name and cells."""

    name: Name
    cells: tuple[str, ...]

    @cached_property
    def values(self) -> np.ndarray:
        """Its numbers, nan for other cells."""
        cells = plain_column(self.name.text, self.cells).cells
        return np.array([float(cell) if NUMBER.fullmatch(cell) else np.nan for cell in cells])

    @cached_property
    def unit(self) -> Unit | None:
        """The unit in its cells, else in its name."""
        return plain_column(self.name.text, self.cells).unit or self.name.unit

    @cached_property
    def numeric(self) -> bool:
        """Whether it holds numbers, of which some differ."""
        finite = self.values[np.isfinite(self.values)]
        filled = sum(map(bool, self.cells))
        return len(finite) > NUMERIC_SHARE * filled and len(np.unique(finite)) > 1

    @cached_property
    def has_digits(self) -> bool:
        """Whether most of its cells, of which some differ, are written with digits, though not as times."""
        filled = [cell for cell in self.cells if cell]
        written = sum(cell[:1].isdigit() or cell[:1] in "+-.,\u2212" for cell in filled)
        return written > NUMERIC_SHARE * len(filled) and len(set(filled)) > 1 and not is_clock(filled)

    @property
    def whole(self) -> bool:
        """Whether all its numbers are whole."""
        finite = self.values[np.isfinite(self.values)]
        return bool(len(finite)) and bool(np.all(finite == np.round(finite)))

    @property
    def first(self) -> list[str]:
        """Its first values."""
        return first_values(self.cells)


@dataclass(frozen=True)
class Understood:
    """Columns of a table by the field to which they belong, those that are not used, and remarks in words."""

    columns: dict[str, str]
    unused: tuple[str, ...]
    remarks: tuple[str, ...] = ()


def columns_of(table: ForeignTable) -> dict[str, Column]:
    """The columns of a table by name."""
    return {text: Column(name_of(text), cells) for text, cells in table.columns.items()}


def check_stated(names: Sequence[str], stated: Mapping[str, str], fields: Sequence[str]) -> None:
    """Refuse a field or a column that does not exist."""
    for field, name in stated.items():
        option = f"--column {escaped(field)}={escaped(name)}"
        if field not in fields:
            allowed, remedy = ", ".join(fields), closest(field, fields)
            raise InputError("usage", f"{option}: no such field; allowed: {allowed}", allowed=allowed, remedy=remedy)
        if name and name not in names:
            allowed, remedy = ", ".join(map(escaped, names)), closest(name, names)
            raise InputError("usage", f"{option}: no such column; allowed: {allowed}", allowed=allowed, remedy=remedy)


def choice(columns: Mapping[str, str], known: Mapping[str, Column], *options: str) -> Candidate:
    """The answer that names columns by field."""
    words = ", ".join(
        f"{field} = {escaped(name)} ({', '.join(known[name].first)})" if name else f"no {field}"
        for field, name in columns.items()
    )
    named = [word for field, name in columns.items() for word in ("--column", f"{field}={name}")]
    return Candidate(words, (*named, *options), {name: known[name].first for name in columns.values() if name})


def ask_column(
    table: ForeignTable,
    found: str,
    candidates: Sequence[Candidate],
    code: str = "missing-column",
) -> Question:
    """The question which column is meant, or what it holds."""
    return table.ask("deviations" if code == "deviations" else "column", answers=candidates, found=found)


def missing_column(
    table: ForeignTable, understood: Mapping[str, str], missing: Sequence[str], hint: str = ""
) -> InputError:
    """The refusal of a table in which no column can be a field."""
    known = ", ".join(f"{field} = {escaped(name)}" for field, name in understood.items()) or "nothing"
    options = " ".join(f"--column {field}=NAME" for field in missing)
    if not understood:
        hint += "; if that line is a title, delete it, so that the first holds the names of the columns"
    values = {"fields": ", ".join(missing), "known": known, "options": options, "hint": hint}
    names = listed(table.columns, len(table.columns))
    return refused("missing-column", table.file, line=table.first_line, names=names, **values)


def first_values(cells: Iterable[str]) -> list[str]:
    """The first cells of a column that are not empty: many tables start with rows without a look."""
    return list(islice(filter(None, cells), SAMPLES))


def table_document(table: ForeignTable, mapping: Understood) -> dict[str, Any]:
    """The columns of a table by field, for programs."""
    columns = {
        field: {"column": name, "first": first_values(table.columns[name]), "empty": table.columns[name].count("")}
        for field, name in mapping.columns.items()
    }
    head = {"file": table.file, "kind": table.kind, "rows": len(table)}
    return {**head, "columns": columns, "unused": list(mapping.unused)}


def table_lines(table: ForeignTable, mapping: Understood, fields: Sequence[str], units: Mapping[str, str]) -> list[str]:
    """Fields with their columns, units and first values."""
    rows = [("field", "column", "read as", "first values")]
    for field in (field for field in fields if field in mapping.columns):
        name = mapping.columns[field]
        cells, empty = table.columns[name], table.columns[name].count("")
        first = ", ".join(escaped(cell, 12) for cell in first_values(cells)) or "none"
        first += f" ({empty} of {len(cells)} empty)" * bool(empty)
        rows.append((field, escaped(name, 24), units.get(field, ""), first))
    widths = [max(len(row[k]) for row in rows) for k in range(3)]
    lines = [f"{table.file}: {table.kind}; {len(table)} rows"]
    lines += ["  ".join([*(cell.ljust(w) for cell, w in zip(row, widths, strict=False)), row[3]]) for row in rows]
    return [*lines, *([f"not used: {listed(mapping.unused, len(mapping.unused))}"] if mapping.unused else [])]


def factor_between(unit: Unit | None, other: Unit | None) -> float | None:
    """Numbers of another unit in one of a unit: 1 where one states none; None where they are of two kinds."""
    return 1.0 if unit is None or other is None else unit.in_units_of(other)
