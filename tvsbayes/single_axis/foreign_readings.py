"""Moves and readings of somebody's table of an axis: one row is a move, a reading, or both; unit of the folder.

Rows that follow each other at the same command are readings of one stop; rows without a value are moves that nobody
read. What a table does not say is assumed and listed in words.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from tvsbayes.errors import refusal
from tvsbayes.files.foreign_table import ForeignTable
from tvsbayes.instrument.column_names import (
    READING_UNITS,
    Understood,
    field_by_word,
    understand,
    unit_of_name,
    words_of,
)
from tvsbayes.instrument.foreign_looks import (
    GOOD,
    FieldCells,
    homings_of,
    left_out,
    refused_status,
    seconds_of,
    word_of,
)
from tvsbayes.single_axis.axis_campaign import APPROACHES, AXIS_MOVES, READINGS, TURNS, Approach, AxisMove, Reading
from tvsbayes.single_axis.axis_rows import turn_jumps

WHOLE = 0.1
"""Of a turn, by which play and errors of gears may make a jump differ from whole turns."""

_COLUMNS = {c.name: c for kind in (READINGS, AXIS_MOVES) for c in kind.columns.values() if c.names}
AXIS_FIELDS = tuple(dict.fromkeys(("command", "value", *_COLUMNS)))
"""All that a table of an axis can give."""
_FOUND_BY_ENCODERS = {"position", "pos", "posicion", "counts", "zahler", "contador"}
"""Words of commands that name what was read where another column is the command for certain."""
_TEMPERATURE = {"temp", "temperature", "temperatur", "temperatura", "humidity"}
"""Degrees of these are no angle."""


def axis_field_of(name: str) -> str | None:
    """The field of an axis that a column's name tells of: by its first word that is known."""
    return field_by_word(words_of(name), _COLUMNS.values())


def understand_axis(columns: Iterable[str], stated: Mapping[str, str] | None = None) -> Understood:
    """Guess what columns of an axis are, as `understand`; some names are clear only beside others.

    Beside "microsteps" a "position [um]" is what was read; where nothing else is, "mm" alone, or the one other column
    that names a unit of readings, as "dial gauge mm".

    Args:
        columns: their names.
        stated: column by field of `AXIS_FIELDS`, where somebody has said it; an empty column: the table has none.

    Raises:
        InputError: a field or column that does not exist.
    """
    names, said = list(columns), dict(stated or {})
    known = understand(names, said, AXIS_FIELDS, axis_field_of)
    if "value" in known.columns or "value" in known.claimed or "value" in said:
        return known
    claims = known.claimed.get("command", ())
    found = [name for name in claims if _FOUND_BY_ENCODERS.intersection(words_of(name))]
    sure = [name for name in claims if name not in found]
    units = [
        name
        for name in known.unused
        if (words := words_of(name)) and all(unit_of_name(word, READING_UNITS) for word in words)
    ]
    if len(sure) == len(found) == 1 and not units and (unit_of_name(found[0], READING_UNITS) or not known.unused):
        return understand(names, {**said, "command": sure[0], "value": found[0]}, AXIS_FIELDS, axis_field_of)
    units = units or [
        name
        for name in known.unused
        if unit_of_name(name, READING_UNITS) and not _TEMPERATURE.intersection(words_of(name))
    ]
    if len(units) == 1 and not claims:
        return understand(names, {**said, "value": units[0]}, AXIS_FIELDS, axis_field_of)
    return known


@dataclass(frozen=True)
class ForeignReadings:
    """Rows of `moves.csv` and `readings.csv`, and what the table does not say."""

    moves: tuple[AxisMove, ...]
    readings: tuple[Reading, ...]
    assumed: tuple[str, ...]


def readings_of(table: ForeignTable, columns: Mapping[str, str]) -> ForeignReadings:
    """Moves and readings of a table.

    Args:
        table: as it was read.
        columns: its columns by field, of `AXIS_FIELDS`; "command" and "value" among them.

    Raises:
        InputError: a cell that is no value of its field, or no row.
    """
    cells = FieldCells(table, columns)
    if not len(table):
        found, remedy = "no rows below the names of the columns", "name the sheet or file with the data"
        raise refusal("empty", file=table.file, found=found, allowed="at least one row", remedy=remedy)
    assumed: list[str] = []
    commands, values, stated_u = (cells.read(_COLUMNS[name]) for name in ("command", "value", "u"))
    times, homings, statuses = seconds_of(cells, assumed), homings_of(cells, assumed), cells.text("status")
    if times is None:
        assumed.append("time_s: no column, so 0, 1, 2 ...; drift of the zero is then per move")
    moves: list[AxisMove] = []
    readings: list[Reading] = []
    for row, (command, value) in enumerate(zip(commands, values, strict=True)):
        homed = homings[row]
        if not moves or homed or command != moves[-1].command:
            segment = 0 if not moves else moves[-1].segment + homed
            side = _approach(cells, row) if not moves or homed else ""
            at_s = float(len(moves)) if times is None else times[row]
            moves.append(AxisMove(len(moves), segment, at_s, command, side))
        if value is not None or statuses[row]:
            readings.append(Reading(len(readings), moves[-1].move, value, stated_u[row], _status(cells, row, value)))
    assumed += left_out(cells, statuses, "reading")
    if again := len(table) - len(moves):
        assumed.append(f"{again} row{'s' * (again > 1)} at the command before: read at that stop again, without a move")
    if "approach" not in cells:
        assumed.append("approach: unknown at the beginning of each segment")
    if "u" not in cells:
        assumed.append("u: none, so that the scatter of stops covers the readings' own")
    return ForeignReadings(tuple(moves), tuple(readings), tuple(assumed))


def unwrapped(found: ForeignReadings, unit: str) -> ForeignReadings:
    """The same with the whole turns added that an encoder or autocollimator which begins anew leaves out.

    Args:
        found: moves and readings.
        unit: of the readings; those of no angle stay as they are.
    """
    turn = TURNS.get(unit)
    rows = [k for k, reading in enumerate(found.readings) if reading.status == "ok" and reading.value is not None]
    command = np.array([found.moves[found.readings[k].move].command for k in rows])
    value = np.array([found.readings[k].value for k in rows], dtype=float)
    jumps = turn_jumps(command, value, turn) if turn is not None else {}
    # A wild reading jumps too, and back: by no whole turns.
    if turn is None or not jumps or any(abs(far - round(far)) > WHOLE for far in jumps.values()):
        return found
    readings, turns = list(found.readings), 0
    for row, k in enumerate(rows):
        turns -= round(jumps.get(row, 0.0))
        readings[k] = replace(readings[k], value=float(value[row]) + turn * turns)
    times = "once" if len(jumps) == 1 else f"{len(jumps)} times"
    told = f"value: jumps by whole turns {times}, which are added: {turn:g} {unit} each"
    return replace(found, readings=tuple(readings), assumed=(*found.assumed, told))


def _approach(cells: FieldCells, row: int) -> Approach:
    """How the axis came to the first stop of a segment."""
    word = cells.text("approach")[row].lower() or "unknown"
    for known in APPROACHES:
        if word == known:
            return known
    raise cells.refuse(row, "approach", ", ".join(APPROACHES), "forward is the direction of rising commands")


def _status(cells: FieldCells, row: int, value: float | None) -> str:
    """The word "ok", or why a reading is of no use."""
    text = cells.text("status")[row]
    word = word_of(text)
    if word and word not in GOOD:
        return refused_status(text)
    if value is None:
        raise cells.refuse(row, "value", "a number where the reading is ok", "complete the cell, or its status")
    return "ok"
