"""Moves and looks of somebody's table: counters, pixels, times and angles turned into those of our files.

One row is one look, one move, or both; rows that follow each other at the same counters are looks after one move. What
a table does not say is assumed and listed in words. Px with the integer at the centre of a pixel, (0, 0) the first.
"""

from __future__ import annotations

import datetime
import math
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

from tvsbayes.errors import InputError, escaped, refusal
from tvsbayes.files.csv_kind import ID_MAX, Column
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.files.foreign_table import DAY_S, ForeignTable
from tvsbayes.instrument.axes import AXES, SENSES, Axis
from tvsbayes.instrument.campaign import (
    APERTURE_MAX_DEG,
    MOVES,
    PIXEL_SD_MAX,
    PIXEL_SD_MIN,
    PIXEL_SDS,
    PIXELS,
    SPOTS,
    Move,
    Spot,
    next_move,
)
from tvsbayes.instrument.column_names import COUNTERS, DEGREES, SECONDS, unit_of_name, words_of

SD_PX = 0.1
"""Standard uncertainty of a centroid where a table states none; the fit scales it by what the spots show."""
GOOD = {
    *("ok", "1", "true", "yes", "good", "valid", "ja", "gut", "gultig", "si", "bien", "bueno", "buena", "valido"),
    *("oui", "bon", "bonne", "valide"),
}
BAD = {
    *("0", "false", "no", "bad", "invalid", "nein", "schlecht", "ungultig", "mal", "malo", "mala", "invalido"),
    *("non", "mauvais", "mauvaise", "invalide"),
}
"""Words of a status, in small letters without accents."""
FOUR_POINT = ("experiment", "point")
"""Fields of the four-point method: both or neither."""
WORDS_TOLD = 5
"""Of those that leave rows out."""
NO_NUMBER = {"nan", "n/a", "#n/a", "null"}
"""What programs write into a cell that has no number, in small letters."""
EPOCH_SCALES = {1e17: 1e-9, 1e14: 1e-6, 1e11: 1e-3}
"""Seconds of a unit by the least number that counts it since 1970; smaller ones are seconds."""
_FLAGS = {"": False, "0": False, "false": False, "1": True, "true": True}
"""Cells of a column that marks homings, in small letters."""
_CLOCK = re.compile(r"[0-9]{1,2}:[0-9]{2}:[0-9]{2}(?:\.[0-9]{1,6})?")
_DOTTED_DATE = re.compile(r"([0-9]{1,2})\.([0-9]{1,2})\.([0-9]{4})[ ,T]+")
"""Day, month and year: with dots in no other order."""


@dataclass(frozen=True)
class Notation:
    """How a table's numbers are meant.

    Attributes:
        pixels_from: coordinate of the centre of the first pixel: 0, or 1 as in MATLAB.
        angle_unit: "deg" or "rad" of aperture readings; None: as the name of the column says, else degrees.
        sd_px: standard uncertainty of a centroid where no column states it.
        relative: counters are the steps of each move instead of where it ended.
        approach: side from which pan and tilt came to the first row; "unknown" where nobody recorded it.
    """

    pixels_from: int = 0
    angle_unit: str | None = None
    sd_px: float = SD_PX
    relative: bool = False
    approach: tuple[str, str] = ("unknown", "unknown")


@dataclass(frozen=True)
class ForeignLooks:
    """What a table gives.

    Attributes:
        moves: rows of `moves.csv`; None where the table has no counters.
        spots: rows of `spots.csv`; None where it has no pixels.
        assumed: what it does not say, in words.
    """

    moves: tuple[Move, ...] | None
    spots: tuple[Spot, ...] | None
    assumed: tuple[str, ...]


@dataclass(frozen=True)
class FieldCells:
    """Cells of a table by field."""

    table: ForeignTable
    columns: Mapping[str, str]

    def __contains__(self, field: str) -> bool:
        return field in self.columns

    def text(self, field: str) -> list[str]:
        """Cells of a field; empty ones where no column gives it."""
        return list(self.table.columns[self.columns[field]]) if field in self else [""] * len(self.table)

    def read(self, column: Column, low: float | None = None, high: float | None = None, empty: bool = False) -> list:
        """Values of a column of our files, its default in empty cells, None where it has none and `empty` allows it.

        Args:
            column: its limits hold where no others are given; "200.0" is a whole number.
            low: another limit.
            high: another limit.
            empty: whether a cell may be empty although the column has no default.
        """
        field, empty = column.name, empty or column.may_be_empty
        default = column.default if column.may_be_empty else None
        least, greatest = column.low if low is None else low, column.high if high is None else high
        values: list[Any] = []
        for row, text in enumerate(self.text(field)):
            cell = "" if text.lower() in NO_NUMBER else text
            value = float(cell) if NUMBER.fullmatch(cell) else math.nan
            if not cell and empty:
                values.append(default)
            elif not least <= value <= greatest:
                remedy = "correct the cell, or name another column"
                raise self.refuse(row, field, f"a number from {least:g} to {greatest:g} for {field}", remedy)
            elif column.kind is int and not value.is_integer():
                remedy = "give the counters of the motors; angles are what the fit finds" if field in COUNTERS else ""
                raise self.refuse(row, field, f"a whole number for {field}", remedy or "correct the cell")
            else:
                values.append(column.kind(value))
        return values

    def refuse(self, row: int, field: str, allowed: str, remedy: str) -> InputError:
        """The error of one cell."""
        return self.table.refuse(row, self.columns[field], allowed, remedy)


def looks_of(
    table: ForeignTable, columns: Mapping[str, str], notation: Notation, listed: Sequence[Move] | None = None
) -> ForeignLooks:
    """Moves and looks of a table.

    Args:
        table: as it was read.
        columns: its columns by field; see `column_names`.
        notation: how its numbers are meant.
        listed: moves that are there already, for a table of looks alone.

    Raises:
        InputError: a cell that is no value of its field; looks whose moves nobody knows.
    """
    cells = FieldCells(table, columns)
    table.require_rows()
    assumed: list[str] = []
    moves: tuple[Move, ...] | None = None
    if all(field in cells for field in COUNTERS):
        listing = moves_of_rows(cells, notation, assumed)
        moves, of_row = listing.moves, listing.of_row
        assumed += _renumbered(cells, of_row)
    else:
        of_row = tuple(_listed_moves(cells, listed or ()))
    spots = _spots(cells, of_row, notation, assumed) if any(field in cells for field in PIXELS) else None
    return ForeignLooks(moves, spots, tuple(assumed))


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


def _listed_moves(cells: FieldCells, listed: Sequence[Move]) -> list[int]:
    """The move of every row of a table without counters."""
    table, count = cells.table, len(cells.table)
    if "move" not in cells:
        if len(listed) != count:
            found = f"{count} looks for {len(listed)} moves, and no column that tells which"
            allowed, remedy = "a column of move numbers, or a look for every move", "add --column move=NAME"
            raise refusal("missing-column", file=table.file, found=found, allowed=allowed, remedy=remedy)
        return list(range(count))
    numbers = cells.read(MOVES["move"], low=-ID_MAX)
    for row, number in enumerate(numbers):
        if not 0 <= number < len(listed):
            allowed = f"the number of a move, 0 to {len(listed) - 1}"
            raise cells.refuse(row, "move", allowed, "moves count from 0; list them first")
    return numbers


@dataclass(frozen=True)
class RowMoves:
    """Moves of a table, and the number of the move of every row."""

    moves: tuple[Move, ...]
    of_row: tuple[int, ...]


def moves_of_rows(cells: FieldCells, notation: Notation, assumed: list[str]) -> RowMoves:
    """The moves of a table with counters; adds to `assumed` what the table does not say.

    Raises:
        InputError: a cell that is no value of its field.
    """
    count = len(cells.table)
    pairs = list(zip(*(cells.read(MOVES[field]) for field in COUNTERS), strict=True))
    numbers = cells.text("move") if "move" in cells else None
    homings = homings_of(cells, assumed)
    times_s = seconds_of(cells, assumed)
    warm = temperatures_of(cells, assumed)
    approaches = [_approaches(cells, axis, notation.approach[k]) for k, axis in enumerate(AXES)]
    moves: list[Move] = []
    of_row: list[int] = []
    at, segment = (0, 0), 0
    for row in range(count):
        step = pairs[row]
        homed = homings[row]
        segment += homed
        again = row > 0 and (numbers[row] == numbers[row - 1] if numbers else True) and not homed
        same = again and (numbers is not None or step == ((0, 0) if notation.relative else at))
        if not same:
            at = (at[0] + step[0], at[1] + step[1]) if notation.relative and row and not homed else step
            first = row == 0 or homed
            pan_side, tilt_side = (sides[row] if first else "" for sides in approaches)
            time_s = float(len(moves)) if times_s is None else times_s[row]
            move = next_move(moves, segment, time_s, at, (pan_side, tilt_side))  # type: ignore[arg-type]
            moves.append(replace(move, temperature_degC=warm[row]))
        elif not notation.relative and step != at:
            remedy = "a new move begins a new number; or leave the column out with --column move="
            raise cells.refuse(
                row, COUNTERS[step[1] != at[1]], f"the counters of its move, {at[0]} and {at[1]}", remedy
            )
        of_row.append(len(moves) - 1)
    if times_s is None:
        assumed.append("time_s: no column, so 0, 1, 2 ...; drift of the zero is then per move")
    if "pan_approach" not in cells and "unknown" in notation.approach:
        assumed.append("approach: unknown; say how the axes came to the first row, --pan-approach left or right ...")
    if any(field in cells for field in PIXELS):
        assumed.append(
            "moves: those of the table; rows without pixels are moves without a look, which play remembers too"
        )
    if notation.relative:
        assumed.append("counters: summed up, because --relative says that each is the steps of its move")
    return RowMoves(tuple(moves), tuple(of_row))


def _renumbered(cells: FieldCells, of_row: Sequence[int]) -> list[str]:
    """Where a table without pixels numbers its moves otherwise than `moves.csv`, by which pictures are then paired."""
    field = "move" if "move" in cells else "spot"
    if field not in cells or any(name in cells for name in PIXELS):
        return []
    numbers = [float(cell) if NUMBER.fullmatch(cell) else None for cell in cells.text(field)]
    apart = [row for row, number in enumerate(numbers) if number is not None and number != of_row[row]]
    if not apart:
        return []
    name, row = escaped(cells.columns[field]), apart[0]
    count = f"{len(apart)} of {len(numbers)} rows"
    other = f"{name} {escaped(cells.text(field)[row])} is move {of_row[row]}"
    paired = f"pictures are paired by the move, not by {name}"
    return [f"move: counted from 0, not as {name} does in {count}: {other}; {paired}"]


def _approaches(cells: FieldCells, axis: Axis, default: str) -> list[str]:
    """The side from which an axis came, of every row."""
    field, allowed = f"{axis}_approach", (*SENSES[axis], "unknown")
    words = [word.lower() or default for word in cells.text(field)]
    for row, word in enumerate(words):
        if word not in allowed:
            raise cells.refuse(row, field, ", ".join(allowed), "name the direction of the last move of the axis")
    return words


def homings_of(cells: FieldCells, assumed: list[str]) -> list[bool]:
    """Whether the axes homed before each row but the first, which begins a segment anyway.

    Numbers of segments change at a homing. Where all cells are 0 or 1 and a 0 follows a 1, they are no numbers of
    segments but marks: each 1 is a homing, and the 0 after it is none.
    """
    if "segment" not in cells:
        return [False] * len(cells.table)
    words = [word.lower() for word in cells.text("segment")]
    flags = [_FLAGS.get(word) for word in words]
    marked = None not in flags and any(before and not after for before, after in pairwise(flags))
    later = map(bool, flags[1:]) if marked else (before != after for before, after in pairwise(words))
    homings = [False, *later]
    count, name = sum(homings), escaped(cells.columns["segment"])
    how = "at each 1" if marked else "where it changes"
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
        since_1970 = next((each for least, each in EPOCH_SCALES.items() if seconds and seconds[0] >= least), None)
        if unit is None and since_1970 is not None:
            seconds = [since_1970 * (value - seconds[0]) for value in seconds]
            assumed.append(f"time_s: counted in {since_1970:g} s since 1970, so seconds since the first row")
    else:
        seconds = []
        for row, cell in enumerate(texts):
            try:
                if _CLOCK.fullmatch(cell):
                    clock = datetime.time.fromisoformat(cell.zfill(8))
                    day = datetime.datetime.combine(datetime.date(1970, 1, 1), clock, datetime.UTC).timestamp()
                    later = seconds and day < seconds[-1] % DAY_S
                    seconds.append(day + DAY_S * ((seconds[-1] // DAY_S if seconds else 0) + bool(later)))
                    continue
                when = datetime.datetime.fromisoformat(_DOTTED_DATE.sub(_iso_date, cell, count=1))
                # Without a zone every hour has its length: this machine's summer time is not the logger's.
                seconds.append((when if when.tzinfo else when.replace(tzinfo=datetime.UTC)).timestamp())
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


def _spots(cells: FieldCells, of_row: Sequence[int], notation: Notation, assumed: list[str]) -> tuple[Spot, ...]:
    """The looks of a table with pixels."""
    pixels = [cells.read(SPOTS[field]) for field in PIXELS]
    stated = [cells.read(SPOTS[field], low=-PIXEL_SD_MAX) if field in cells else None for field in PIXEL_SDS]
    if any(column is None for column in stated):
        text = f"standard uncertainty of a centroid: {notation.sd_px:g} px; --sd-px states another"
        assumed.append(f"{text}, the fit finds the scale" if all(c is None for c in stated) else text)
    numbers = cells.read(SPOTS["spot"], empty=True)
    others = {name: cells.read(SPOTS[name]) for name in SPOTS.optional}
    statuses, targets = cells.text("status"), cells.text("target")
    # The others are moves that nobody looked at.
    looked = [
        bool(status) or any(value is not None for value in centre)
        for status, *centre in zip(statuses, *pixels, strict=True)
    ]
    looked_numbers = [number for number, look in zip(numbers, looked, strict=True) if look]
    unique = None not in looked_numbers and len(set(looked_numbers)) == len(looked_numbers)
    if "spot" in cells and not unique:
        assumed.append("spot: numbers are missing or stand twice, so looks are numbered by their rows")
    four_point = [field for field in FOUR_POINT if field in cells]
    if len(four_point) == 1:
        # "Point 1 ... 200" counts looks.
        column = escaped(cells.columns[four_point[0]])
        assumed.append(f"column {column} is left out: no column gives the other of {' and '.join(FOUR_POINT)}")
    experiments, points = (
        cells.read(SPOTS[field]) if len(four_point) == 2 else [None] * len(of_row) for field in FOUR_POINT
    )
    half = sum((a is None) != (b is None) for a, b in zip(experiments, points, strict=True))
    if half:
        assumed.append(f"experiment, point: {half} row{'s' * (half != 1)} with one of both alone, which is left out")
    scale_deg = DEGREES[notation.angle_unit or unit_of_name(cells.columns.get("aperture_deg", ""), DEGREES) or "deg"]
    limit = APERTURE_MAX_DEG / scale_deg
    readings = cells.read(SPOTS["aperture_deg"], -limit, limit)
    spots = []
    for row, move in enumerate(of_row):
        if not looked[row]:
            continue
        centre = [column[row] for column in pixels]
        status = _status(statuses[row], centre, cells, row)
        number = numbers[row] if unique else row
        reading = None if (read := readings[row]) is None else scale_deg * read
        of_experiment = (experiments[row], points[row]) if None not in (experiments[row], points[row]) else (None, None)
        values = {name: column[row] for name, column in others.items()}
        if status == "ok":
            sds = [_sd_px(cells, row, field, column, notation) for field, column in zip(PIXEL_SDS, stated, strict=True)]
            centre = [value - notation.pixels_from for value in centre]
            values |= dict(zip((*PIXELS, *PIXEL_SDS), (*centre, *sds), strict=True))
        spots.append(
            Spot(
                spot=number,
                move=move,
                target=readable(targets[row], "sheet", 100),
                experiment=of_experiment[0],
                point=of_experiment[1],
                aperture_deg=reading,
                status=status,
                **values,
            )
        )
    assumed += left_out(cells, statuses, "look")
    return tuple(spots)


def _sd_px(cells: FieldCells, row: int, field: str, column: Sequence[float | None] | None, notation: Notation) -> float:
    """The standard uncertainty of a centre: rows without one may hold whatever they like there."""
    if column is None:
        return notation.sd_px
    if (sd := column[row]) is None or sd < PIXEL_SD_MIN:
        allowed = f"a number from {PIXEL_SD_MIN:g} to {PIXEL_SD_MAX:g} where the look is ok"
        raise cells.refuse(row, field, allowed, f"complete the cell, or write --column {field}= and --sd-px")
    return sd


def word_of(status: str) -> str:
    """A cell of a status as `GOOD` and `BAD` have it."""
    plain = unicodedata.normalize("NFKD", status.strip().lower())
    return "".join(letter for letter in plain if not unicodedata.combining(letter))


def left_out(cells: FieldCells, statuses: Iterable[str], what: str) -> list[str]:
    """What a column of statuses leaves out, as a sentence: a word that somebody meant well may be none of `GOOD`."""
    counts = Counter(escaped(text, 24) for text in statuses if text.strip() and word_of(text) not in GOOD)
    if not counts:
        return []
    common = [f"{text} {count}" for text, count in counts.most_common(WORDS_TOLD)]
    named = ", ".join(common) + " ..." * (len(counts) > WORDS_TOLD)
    count = sum(counts.values())
    return [
        f"status: {count} {what}{'s' * (count != 1)} left out by column {escaped(cells.columns['status'])}: {named}"
    ]


def _status(text: str, centre: Sequence[float | None], cells: FieldCells, row: int) -> str:
    """The word "ok", or why a look is of no use."""
    complete = None not in centre
    word = word_of(text)
    if word in GOOD or not word:
        if complete or not word:
            return "ok" if complete else "no centre in the table"
        field = PIXELS[centre.index(None)]
        raise cells.refuse(row, field, "a number where the look is ok", "complete the cell, or its status")
    return refused_status(text)


def refused_status(text: str) -> str:
    """A cell that says why a row is of no use, as the reader of our tables takes it."""
    return readable(f"refused: {text}" if word_of(text) in BAD else text, "refused:", 200) or "refused"


def readable(text: str, before: str, chars_max: int) -> str:
    """A cell's text as the reader of our tables takes it: printable, on one line, nothing that a spreadsheet runs.

    Args:
        text: of the cell.
        before: word put before a text that begins with = + - or @: without these signs "-50" and "50" were one.
        chars_max: longer ones are cut.
    """
    kept = "".join(c if c.isprintable() else " " for c in text)
    kept = " ".join(kept.split())
    return (f"{before} {kept}" if kept.startswith(("=", "+", "-", "@")) else kept)[:chars_max]
