"""Files of looks to locate: a CSV of counters, approaches and aperture readings, read whole or block by block.

steps, deg. Semicolons, decimal commas and workbooks are read too, with the same column names.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tvsbayes.coordinates.location import Settings, settings_of
from tvsbayes.errors import InputError, escaped
from tvsbayes.files.csv_kind import Column, CsvKind, Values
from tvsbayes.files.csv_table import CSV_BYTES_MAX, Table, csv_bytes, parse_table, table_blocks
from tvsbayes.files.disk import opened, read_bytes
from tvsbayes.importing.reader import read_foreign
from tvsbayes.importing.text import is_foreign
from tvsbayes.instrument.axes import PanApproach, TiltApproach
from tvsbayes.instrument.campaign import APERTURE_MAX_DEG
from tvsbayes.instrument.counter_limits import COUNTER_MAX
from tvsbayes.progress import Advance, unshown

HEAD_BYTES = 4096
"""Bytes that determine the kind of a file."""
BLOCK_ROWS = 8192
"""Lines read at a time: 10 MB with all derived arrays."""


def _direction(table: Table, column: Column, values: Values) -> None:
    """Refuse cells other than the words of a column."""
    for row, word in enumerate(values[column.name]):
        if word not in column.words:
            remedy = "name the direction of the last move of the axis"
            raise table.refuse(row, column.name, "approach", ", ".join(column.words), remedy)


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """A row of a file of looks: absolute counters, steps, the directions of the last moves, the reading."""

    pan_steps: Annotated[float, Column("absolute counters, decimals allowed", -COUNTER_MAX, COUNTER_MAX)]
    tilt_steps: Annotated[float, Column("", -COUNTER_MAX, COUNTER_MAX)]
    pan_approach: Annotated[
        PanApproach, Column("direction of the last move: `left`, `right` or `unknown`", rule=_direction)
    ]
    tilt_approach: Annotated[TiltApproach, Column("likewise `up`, `down`, `unknown`", rule=_direction)]
    aperture_deg: Annotated[float, Column("the scanner's own reading, deg", -APERTURE_MAX_DEG, APERTURE_MAX_DEG)]


LOOKS = CsvKind(Look, "FILE.csv")


def _rows(table: Table) -> Settings:
    """Check the cells of a table and return its rows."""
    pan, tilt, pan_approach, tilt_approach, reading = LOOKS.values(table).values()
    return settings_of(pan, tilt, reading, list(zip(pan_approach, tilt_approach, strict=True)), table.lines)


def _no_points(path: Path) -> InputError:
    file = escaped(path.name)
    return InputError("empty", f"{file}: no points", file=file, remedy="add rows")


def _foreign(path: Path) -> Table | None:
    """Read a table in the notation of a spreadsheet, its numbers with points; None for our own format."""
    with opened(path, "a readable file") as stream:
        if not is_foreign(stream.read(HEAD_BYTES)):
            return None
    table = read_foreign(path)
    # The same columns are required, with the same messages.
    parse_table(csv_bytes(list(table.columns), ()), table.file, LOOKS.required)
    return Table(table.file, list(table.lines), dict(table.columns))


def _part(table: Table, begin: int) -> Table:
    """Return `BLOCK_ROWS` of a table's rows."""
    end = begin + BLOCK_ROWS
    return Table(table.file, table.lines[begin:end], {name: cells[begin:end] for name, cells in table.columns.items()})


def read_looks(path: Path) -> Settings:
    """Read all looks of a file.

    Raises:
        InputError: the file cannot be read, columns are missing, a cell is invalid, or there is no row.
    """
    table = _foreign(path)
    if table is None:
        table = parse_table(read_bytes(path, CSV_BYTES_MAX), escaped(path.name), LOOKS.required)
    if not len(table):
        raise _no_points(path)
    return _rows(table)


def look_blocks(path: Path, advance: Advance = unshown) -> Iterator[Settings]:
    """Read the looks of a file of any length, block by block.

    Args:
        path: the file.
        advance: called with the share of the file that has been read.

    Raises:
        InputError: as in `read_looks`, at the block concerned.
    """
    empty, whole = True, _foreign(path)
    if whole is None:
        blocks = table_blocks(path, LOOKS.required, BLOCK_ROWS, advance)
    else:
        blocks = (_part(whole, begin) for begin in range(0, len(whole), BLOCK_ROWS))
    for table in blocks:
        if len(table):
            empty = False
            yield _rows(table)
    if empty:
        raise _no_points(path)
