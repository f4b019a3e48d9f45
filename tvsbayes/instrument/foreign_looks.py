"""Moves and looks of a foreign table: counters, pixels, times and angles converted to those of this package's files.

One row is one look, one move, or both; successive rows at the same counters are looks after one move. Assumptions about
what the table does not state are listed in words. Px with the integer at the centre of a pixel, (0, 0) the first pixel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from tvsbayes.errors import escaped, refusal
from tvsbayes.files.csv_kind import ID_MAX
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.files.foreign_table import ForeignTable
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
from tvsbayes.instrument.column_names import COUNTERS, DEGREES, unit_of_name
from tvsbayes.instrument.foreign_cells import (
    FieldCells,
    homings_of,
    left_out,
    readable,
    seconds_of,
    status_of,
    temperatures_of,
    word_of,
)

SD_PX = 0.1
"""Standard uncertainty of a centroid where a table states none; the fit estimates its scale."""
FOUR_POINT = ("experiment", "point")
"""Fields of the four-point method; a table has both or neither."""


@dataclass(frozen=True)
class Notation:
    """Conventions of a table's numbers.

    Attributes:
        pixels_from: coordinate of the centre of the first pixel: 0, or 1 as in MATLAB.
        angle_unit: "deg" or "rad" of aperture readings; None: the unit in the column's name, else degrees.
        sd_px: standard uncertainty of a centroid where no column states it.
        relative: counters are the steps of each move instead of absolute ones.
        approach: side from which pan and tilt came to the first row; "unknown" where it was not recorded.
    """

    pixels_from: int = 0
    angle_unit: str | None = None
    sd_px: float = SD_PX
    relative: bool = False
    approach: tuple[str, str] = ("unknown", "unknown")


@dataclass(frozen=True)
class ForeignLooks:
    """Moves and looks of a table.

    Attributes:
        moves: rows of `moves.csv`; None where the table has no counters.
        spots: rows of `spots.csv`; None where it has no pixels.
        assumed: assumptions about what the table does not state, in words.
    """

    moves: tuple[Move, ...] | None
    spots: tuple[Spot, ...] | None
    assumed: tuple[str, ...]


def looks_of(
    table: ForeignTable, columns: Mapping[str, str], notation: Notation, known_moves: Sequence[Move] | None = None
) -> ForeignLooks:
    """Moves and looks of a table.

    Args:
        table: the foreign table.
        columns: its columns by field; see `column_names`.
        notation: conventions of its numbers.
        known_moves: existing moves, for a table of looks alone.

    Raises:
        InputError: a cell is not a value of its field, or the moves of looks are unknown.
    """
    cells = FieldCells(table, columns)
    table.require_rows()
    assumed: list[str] = []
    moves: tuple[Move, ...] | None = None
    if all(field in cells for field in COUNTERS):
        row_moves = moves_of_rows(cells, notation, assumed)
        moves, move_of_row = row_moves.moves, row_moves.move_of_row
        assumed += _renumbered(cells, move_of_row)
    else:
        move_of_row = tuple(_listed_moves(cells, known_moves or ()))
    spots = _spots(cells, move_of_row, notation, assumed) if any(field in cells for field in PIXELS) else None
    return ForeignLooks(moves, spots, tuple(assumed))


def _listed_moves(cells: FieldCells, known_moves: Sequence[Move]) -> list[int]:
    """Number of the move of every row of a table without counters."""
    table, count = cells.table, len(cells.table)
    if "move" not in cells:
        if len(known_moves) != count:
            found = f"{count} looks for {len(known_moves)} moves, and no column of move numbers"
            allowed, remedy = "a column of move numbers, or a look for every move", "add --column move=NAME"
            raise refusal("missing-column", file=table.file, found=found, allowed=allowed, remedy=remedy)
        return list(range(count))
    numbers = cells.read(MOVES["move"], low=-ID_MAX)
    for row, number in enumerate(numbers):
        if not 0 <= number < len(known_moves):
            allowed = f"the number of a move, 0 to {len(known_moves) - 1}"
            raise cells.refuse(row, "move", allowed, "moves count from 0; list them first")
    return numbers


@dataclass(frozen=True)
class RowMoves:
    """Moves of a table, and the move number of every row."""

    moves: tuple[Move, ...]
    move_of_row: tuple[int, ...]


def moves_of_rows(cells: FieldCells, notation: Notation, assumed: list[str]) -> RowMoves:
    """Derive the moves of a table with counters; assumptions are appended to `assumed`.

    Raises:
        InputError: a cell is not a value of its field.
    """
    count = len(cells.table)
    counters = list(zip(*(cells.read(MOVES[field]) for field in COUNTERS), strict=True))
    numbers = cells.text("move") if "move" in cells else None
    homings = homings_of(cells, assumed)
    times_s = seconds_of(cells, assumed)
    temperatures = temperatures_of(cells, assumed)
    approaches = [_approaches(cells, axis, notation.approach[k]) for k, axis in enumerate(AXES)]
    moves: list[Move] = []
    move_of_row: list[int] = []
    at, segment = (0, 0), 0
    for row in range(count):
        pair = counters[row]
        homed = homings[row]
        segment += homed
        may_repeat = row > 0 and (numbers[row] == numbers[row - 1] if numbers else True) and not homed
        repeats = may_repeat and (numbers is not None or pair == ((0, 0) if notation.relative else at))
        if not repeats:
            at = (at[0] + pair[0], at[1] + pair[1]) if notation.relative and row and not homed else pair
            first = row == 0 or homed
            pan_side, tilt_side = (sides[row] if first else "" for sides in approaches)
            time_s = float(len(moves)) if times_s is None else times_s[row]
            move = next_move(moves, segment, time_s, at, (pan_side, tilt_side))  # type: ignore[arg-type]
            moves.append(replace(move, temperature_degC=temperatures[row]))
        elif not notation.relative and pair != at:
            remedy = "a new move begins a new number; or leave the column out with --column move="
            raise cells.refuse(
                row, COUNTERS[pair[1] != at[1]], f"the counters of its move, {at[0]} and {at[1]}", remedy
            )
        move_of_row.append(len(moves) - 1)
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
    return RowMoves(tuple(moves), tuple(move_of_row))


def _renumbered(cells: FieldCells, move_of_row: Sequence[int]) -> list[str]:
    """A note where a table without pixels numbers its moves differently from `moves.csv`, by which pictures pair."""
    field = "move" if "move" in cells else "spot"
    if field not in cells or any(name in cells for name in PIXELS):
        return []
    numbers = [float(cell) if NUMBER.fullmatch(cell) else None for cell in cells.text(field)]
    differing = [row for row, number in enumerate(numbers) if number is not None and number != move_of_row[row]]
    if not differing:
        return []
    name, row = escaped(cells.columns[field]), differing[0]
    count = f"{len(differing)} of {len(numbers)} rows"
    example = f"{name} {escaped(cells.text(field)[row])} is move {move_of_row[row]}"
    consequence = f"pictures are paired by the move, not by {name}"
    return [f"move: counted from 0, not as {name} does in {count}: {example}; {consequence}"]


def _approaches(cells: FieldCells, axis: Axis, default: str) -> list[str]:
    """The approach side of an axis, for every row."""
    field, allowed = f"{axis}_approach", (*SENSES[axis], "unknown")
    words = [word.lower() or default for word in cells.text(field)]
    for row, word in enumerate(words):
        if word not in allowed:
            raise cells.refuse(row, field, ", ".join(allowed), "name the direction of the last move of the axis")
    return words


def _spots(cells: FieldCells, move_of_row: Sequence[int], notation: Notation, assumed: list[str]) -> tuple[Spot, ...]:
    """The looks of a table with pixels."""
    pixels = [cells.read(SPOTS[field]) for field in PIXELS]
    sd_columns = [cells.read(SPOTS[field], low=-PIXEL_SD_MAX) if field in cells else None for field in PIXEL_SDS]
    if any(column is None for column in sd_columns):
        text = f"standard uncertainty of a centroid: {notation.sd_px:g} px; --sd-px states another"
        assumed.append(f"{text}, the fit finds the scale" if all(c is None for c in sd_columns) else text)
    numbers = cells.read(SPOTS["spot"], optional=True)
    optional: dict[str, Sequence[Any]] = {name: cells.read(SPOTS[name]) for name in SPOTS.optional}
    statuses, targets = cells.text("status"), cells.text("target")
    # The other rows are moves without a look.
    is_look = [
        bool(status) or any(value is not None for value in centre)
        for status, *centre in zip(statuses, *pixels, strict=True)
    ]
    look_numbers = [number for number, is_one in zip(numbers, is_look, strict=True) if is_one]
    unique = None not in look_numbers and len(set(look_numbers)) == len(look_numbers)
    if "spot" in cells and not unique:
        assumed.append("spot: numbers are missing or repeated, so looks are numbered by their rows")
    optional |= _four_point(cells, assumed)
    scale_deg = DEGREES[notation.angle_unit or unit_of_name(cells.columns.get("aperture_deg", ""), DEGREES) or "deg"]
    limit = APERTURE_MAX_DEG / scale_deg
    readings = cells.read(SPOTS["aperture_deg"], -limit, limit)
    spots = []
    for row, move in enumerate(move_of_row):
        if not is_look[row]:
            continue
        centre = [column[row] for column in pixels]
        no_centre = None in centre and not word_of(statuses[row])
        centre_by_field = dict(zip(PIXELS, centre, strict=True))
        status = "no centre in the table" if no_centre else status_of(cells, row, centre_by_field, "look")
        number = numbers[row] if unique else row
        reading = None if (raw := readings[row]) is None else scale_deg * raw
        values = {name: column[row] for name, column in optional.items()}
        if status == "ok":
            sds = [_sd_px(cells, row, *column, notation) for column in zip(PIXEL_SDS, sd_columns, strict=True)]
            centre = [value - notation.pixels_from for value in centre]
            values |= dict(zip((*PIXELS, *PIXEL_SDS), (*centre, *sds), strict=True))
        spots.append(
            Spot(
                spot=number,
                move=move,
                target=readable(targets[row], "sheet", 100),
                aperture_deg=reading,
                status=status,
                **values,
            )
        )
    assumed += left_out(cells, statuses, "look")
    return tuple(spots)


def _four_point(cells: FieldCells, assumed: list[str]) -> dict[str, Sequence[int | None]]:
    """The columns of the four-point method by field; none where the table has only one of them."""
    fields = [field for field in FOUR_POINT if field in cells]
    if len(fields) == 1:
        # A column "point" with 1 ... 200 counts looks.
        column = escaped(cells.columns[fields[0]])
        assumed.append(f"column {column} is left out: no column gives the other of {' and '.join(FOUR_POINT)}")
    if len(fields) < len(FOUR_POINT):
        return {}
    rows = list(zip(*(cells.read(SPOTS[field]) for field in FOUR_POINT), strict=True))
    half = sum((experiment is None) != (point is None) for experiment, point in rows)
    if half:
        assumed.append(f"experiment, point: {half} row{'s' * (half != 1)} with only one of them, which is left out")
    whole = [(None, None) if None in row else row for row in rows]
    return dict(zip(FOUR_POINT, zip(*whole, strict=True), strict=True))


def _sd_px(cells: FieldCells, row: int, field: str, column: Sequence[float | None] | None, notation: Notation) -> float:
    """The standard uncertainty of a centre; cells of rows without a centre are not checked."""
    if column is None:
        return notation.sd_px
    if (sd := column[row]) is None or sd < PIXEL_SD_MIN:
        allowed = f"a number from {PIXEL_SD_MIN:g} to {PIXEL_SD_MAX:g} where the look is ok"
        raise cells.refuse(row, field, allowed, f"complete the cell, or write --column {field}= and --sd-px")
    return sd
