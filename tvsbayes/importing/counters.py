"""Moves of an instrument with two axes from a foreign table, as plain rows of `moves.csv`.

Successive rows at the same counters belong to one move.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tvsbayes.importing.cells import FieldCells, homings_of, temperatures_of
from tvsbayes.importing.clock import seconds_of
from tvsbayes.importing.columns import line_through

AXES = ("pan", "tilt")
COUNTERS = ("pan_steps", "tilt_steps")
COUNTER_MAX = 10**8
SIDES = {"pan": ("left", "right", "unknown"), "tilt": ("up", "down", "unknown")}
"""Words of an approach: the direction of the last move of an axis."""
FIELDS = ("move", "segment", "time_s", *COUNTERS, "pan_approach", "tilt_approach", "temperature_degC")
"""Fields of a row of moves."""
MOVES_MIN, MOVES_SHARE = 4, 0.1
"""Least number of readings, and largest part of their spread that the sum of the moves leaves, where commands are
moves: play leaves less."""
Pair = tuple[int, int]


def moves_of_rows(cells: FieldCells, counters: Sequence[Pair]) -> tuple[list[dict[str, Any]], list[int]]:
    """Moves of a table with counters of pan and tilt, steps, and the number of the move of every row.

    Raises:
        InputError: a cell is not a value of its field.
    """
    relative, numbers = cells.wishes.relative, cells.text("move") if "move" in cells else None
    homings, times_s, temperatures = homings_of(cells), seconds_of(cells), temperatures_of(cells)
    sides = list(zip(*map(_approaches, [cells] * len(AXES), AXES, cells.wishes.approach), strict=True))
    moves, move_of_row = list[dict[str, Any]](), list[int]()
    at, segment = (0, 0), 0
    for row, (pair, homed) in enumerate(zip(counters, homings, strict=True)):
        segment += homed
        may_repeat = row > 0 and not homed and (numbers is None or numbers[row] == numbers[row - 1])
        if not may_repeat or (numbers is None and pair != ((0, 0) if relative else at)):
            begins = row == 0 or homed
            at = (at[0] + pair[0], at[1] + pair[1]) if relative and not begins else pair
            time_s = float(len(moves)) if times_s is None else times_s[row]
            side = sides[row] if begins else ("", "")
            values = (len(moves), segment, time_s, *at, *side, temperatures[row])
            moves.append(dict(zip(FIELDS, values, strict=True)))
        elif not relative and pair != at:
            remedy = "a new move begins a new number; or leave the column out with --column move="
            allowed = f"the counters of its move, {at[0]} and {at[1]}"
            raise cells.refuse(row, COUNTERS[pair[1] != at[1]], allowed, remedy)
        move_of_row.append(len(moves) - 1)
    if times_s is None:
        cells.assumed.append("time_s: no column, so 0, 1, 2 ...; drift of the zero is then per move")
    if "pan_approach" not in cells and "unknown" in cells.wishes.approach:
        how = "say how the axes came to the first row, --pan-approach left or right ..."
        cells.assumed.append(f"approach: unknown; {how}")
    if relative:
        cells.assumed.append("counters: summed up, because --relative says that each is the steps of its move")
    return moves, move_of_row


def whole_counters(cells: FieldCells) -> list[Pair]:
    """Pan and tilt of every row as whole numbers.

    Raises:
        InputError: a cell is none.
    """
    remedy = "give the counters of the motors; angles are what the fit finds"
    columns = [cells.whole(name, -COUNTER_MAX, COUNTER_MAX, remedy=remedy) for name in COUNTERS]
    return list(zip(*columns, strict=True))


def _approaches(cells: FieldCells, axis: str, default: str) -> list[str]:
    name = f"{axis}_approach"
    words = [word.lower() or default for word in cells.text(name)]
    for row, word in enumerate(words):
        if word not in SIDES[axis]:
            raise cells.refuse(row, name, ", ".join(SIDES[axis]), "name the direction of the last move of the axis")
    return words


# --- lengths of moves -------------------------------------------------------------------------------------------------
def summed_up(moves: Sequence[float], homings: Sequence[bool]) -> list[float]:
    """Positions after moves, from 0 at every homing."""
    begun = np.cumsum(homings)
    total, moved = np.cumsum(moves), np.asarray(moves, dtype=float)
    before = (total - moved)[np.searchsorted(begun, begun)]
    return [float(f"{x:.13g}") for x in total - before]


def are_moves(commands: Sequence[float], read: Sequence[float | None], homings: Sequence[bool]) -> bool:
    """Whether the readings follow the sum of the commands, and not the commands."""
    known = np.array([value is not None for value in read])
    value = np.array([np.nan if v is None else v for v in read])[known]
    if len(value) < MOVES_MIN or not np.ptp(value) > 0:
        return False

    def unexplained(x: Sequence[float]) -> float:
        of_read = np.asarray(x, dtype=float)[known]
        return float(np.std(line_through(of_read, value)[1])) if np.ptp(of_read) > 0 else np.inf

    of_sums, of_commands = map(unexplained, (summed_up(commands, homings), commands))
    return of_sums < MOVES_SHARE * min(of_commands, float(np.std(value)))
