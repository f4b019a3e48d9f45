"""Which looks are one four-point experiment, and the direction of its move: its key is (direction, number).

A lab book may number the experiments of each direction from 1. Looks with one number are then one experiment while no
look of another number comes between them in time. Where no point of a number returns after another number, numbers are
those of the whole campaign, and each is one experiment in whatever order its points were seen.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby

from tvsbayes.errors import shown
from tvsbayes.files.csv_kind import Values
from tvsbayes.files.csv_table import Table
from tvsbayes.instrument.axes import DIRECTIONS, direction_of

Key = tuple[str | None, int]
"""Direction, None where the move from point 2 to 3 has none, and number of an experiment."""
Counters = tuple[int, int]
"""Pan and tilt, steps."""


def experiments_of(
    numbers: Sequence[int | None], points: Sequence[int | None], counters: Sequence[Counters], order: Iterable[int]
) -> list[tuple[Key, list[int]]]:
    """Key and rows of every experiment, by number, then by direction.

    Args:
        numbers: experiment of every look, None for a look of none.
        points: point of every look, 1 to 4.
        counters: counters at every look.
        order: rows of the looks in time order.
    """
    rows = [row for row in order if numbers[row] is not None]
    runs = [list(run) for _, run in groupby(rows, key=numbers.__getitem__)]
    seen = [{(numbers[row], points[row]) for row in run} for run in runs]
    if sum(map(len, seen)) == len(set().union(*seen)):
        rows.sort(key=lambda row: numbers[row] or 0)
        runs = [list(run) for _, run in groupby(rows, key=numbers.__getitem__)]
    found = [((_direction(run, points, counters), numbers[run[0]] or 0), run) for run in runs]
    return sorted(found, key=lambda experiment: rank(experiment[0]))


def rank(key: Key) -> tuple[int, int]:
    """The place of an experiment in lists: by number, then by direction."""
    direction, number = key
    return number, len(DIRECTIONS) if direction is None else DIRECTIONS.index(direction)


def name_of(direction: str | None, number: int) -> str:
    """An experiment in words: 3 (left)."""
    return f"{number}" if direction is None else f"{number} ({direction})"


def _direction(rows: Iterable[int], points: Sequence[int | None], counters: Sequence[Counters]) -> str | None:
    at = {points[row]: counters[row] for row in rows}
    if 2 not in at or 3 not in at:
        return None
    pan, tilt = (after - before for before, after in zip(at[2], at[3], strict=True))
    return None if pan and tilt else direction_of("pan", pan) or direction_of("tilt", tilt) or None


def check_experiments(
    table: Table, values: Values, counters: Sequence[Counters], order: Iterable[int], usable: Sequence[bool]
) -> None:
    """Refuse experiment without point or the reverse, a point that usable looks of an experiment repeat, a key twice.

    Args:
        table: with the columns `experiment` and `point`.
        values: its cells.
        counters: counters at every row.
        order: rows in time order.
        usable: whether a row may be used: a look without a spot may be repeated.
    """
    numbers, points = values["experiment"], values["point"]
    for row, (number, point) in enumerate(zip(numbers, points, strict=True)):
        if (number is None) != (point is None):
            column = "experiment" if number is None else "point"
            allowed = "experiment and point both given or both empty"
            raise table.refuse(row, column, "missing", allowed, "complete the pair or empty it")
    first_of_key: dict[Key, int] = {}
    for key, rows in experiments_of(numbers, points, counters, order):
        first_of_point: dict[int, int] = {}
        for row in sorted(row for row in rows if usable[row]):
            first = first_of_point.setdefault(points[row], row)
            if first != row:
                remedy = "renumber one of them; of two experiments with one number, one after the other, too"
                raise _twice(table, row, first, "point", "every point of an experiment once", remedy)
        first = first_of_key.setdefault(key, min(rows))
        if key[0] is not None and first != min(rows):
            allowed = f"every number once among the experiments that move {key[0]}"
            again = max(first, min(rows))
            raise _twice(table, again, min(first, min(rows)), "experiment", allowed, "renumber one of them")


def _twice(table: Table, row: int, first: int, column: str, allowed: str, remedy: str) -> Exception:
    found = f"{shown(table.columns[column][row])} again (first on line {table.lines[first]})"
    return table.refuse(row, column, "duplicate", allowed, remedy, found)
