"""Content of the columns of a foreign table of an axis: runs in columns, deviations.

A table with a column for each run is converted to one with a row for each reading. A column of actual minus commanded
position is recognised as a deviation, not an uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from tvsbayes.errors import InputError, escaped, refusal
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.files.foreign_table import ForeignTable, table_of
from tvsbayes.instrument.column_names import DEGREES, READING_UNITS, SPREAD, unit_of_name, words_of

DIRECTIONS = {
    1: {"forward", "forwards", "fwd", "up", "vorwarts", "hin", "adelante", "ida", "avant", "aller"},
    -1: {"backward", "backwards", "back", "bwd", "rev", "reverse", "down", "ruckwarts", "zuruck", "ruck", "atras"}
    | {"vuelta", "arriere", "retour"},
}
"""Words of columns with readings of one direction, without accents."""
DEVIATION = {"deviation", "dev", "abweichung", "desviacion", "diff", "difference", "delta", "differenz", "ecart"}
"""Words of columns that may be actual minus commanded position, in addition to those of uncertainties."""
LENGTHS_MM = {"mm": 1.0, "um": 1e-3, "nm": 1e-6, "thou": 0.0254, "inch": 25.4}
SMALL_SHARE, LOOSE_SHARE = 0.05, 0.02
"""Readings in the unit of the commands are not positions if they span less than the first share of the commands' range
and scatter by more than the second share of their own span about a line."""
_ARROWS = str.maketrans({"\u2191": " forward ", "\u2193": " backward ", "\u2192": " forward ", "\u2190": " backward "})


class Run(NamedTuple):
    """A run of a table: its number, and its side, 1 forward or -1 backward."""

    number: int
    side: int


def run_columns(columns: Mapping[str, Sequence[str]]) -> dict[str, Run]:
    """Columns with one run each, by name; empty where the table has none."""
    runs: dict[str, Run] = {}
    for name, cells in columns.items():
        words = words_of(name.translate(_ARROWS))
        sides = [side for side, spellings in DIRECTIONS.items() if spellings.intersection(words)]
        numbers = [int(word) for word in words if word.isdigit()]
        first = next((cell for cell in cells if cell), "")
        if len(sides) == 1 and len(numbers) < 2 and NUMBER.fullmatch(first):
            runs[name] = Run(numbers[0] if numbers else 1, sides[0])
    has_both = {run.side for run in runs.values()} == {-1, 1}
    return runs if (has_both or len(runs) > 1) and len(set(runs.values())) == len(runs) else {}


@dataclass(frozen=True)
class LongTable:
    """A table with a row for each reading, its known columns by field, and remarks in words."""

    table: ForeignTable
    stated: Mapping[str, str]
    remarks: list[str]


def long_table(table: ForeignTable, stated: Mapping[str, str]) -> LongTable:
    """A table with a column for each run converted to one with a row for each reading; other tables are unchanged.

    Forward runs have increasing, backward runs decreasing commands, in the order of their numbers.

    Args:
        table: the foreign table.
        stated: column by field, as the user states it; with `value` or `approach` stated, the table is not converted.

    Raises:
        InputError: no or several columns of positions; runs in several units.
    """
    runs = run_columns(table.columns)
    if not runs or stated.get("value") or stated.get("approach"):
        return LongTable(table, stated, [])
    rest = [name for name in table.columns if name not in runs]
    numeric = [name for name in rest if table.columns[name] and all(map(NUMBER.fullmatch, table.columns[name]))]
    position = stated.get("command") or (numeric[0] if len(numeric) == 1 else None)
    listed = ", ".join(map(escaped, runs))
    if position is None or position not in rest or not all(map(NUMBER.fullmatch, table.columns[position])):
        found, allowed = f"runs ({listed}) and no column that is surely their position", "one column of numbers"
        remedy = "say which: --column command=NAME"
        raise refusal(
            "missing-column", file=table.file, line=table.first_line, found=found, allowed=allowed, remedy=remedy
        )
    units = {unit_of_name(name, READING_UNITS) for name in runs}
    if len(units) > 1:
        found, remedy = f"runs in {', '.join(sorted(map(str, units)))} ({listed})", "give all runs in one unit"
        raise refusal("csv", file=table.file, line=table.first_line, found=found, allowed="one unit", remedy=remedy)
    positions = [float(cell) for cell in table.columns[position]]
    rising = sorted(range(len(positions)), key=positions.__getitem__)
    rows = [
        (row, name)
        for name in sorted(runs, key=lambda name: (runs[name].number, -runs[name].side))
        for row in (rising if runs[name].side > 0 else rising[::-1])
    ]
    unit = next(iter(units))
    columns: dict[str, Sequence[object]] = {
        position: [table.columns[position][row] for row, _ in rows],
        "direction": ["forward" if runs[name].side > 0 else "backward" for _, name in rows],
        "reading" + f" ({unit})" * (unit is not None): [table.columns[name][row] for row, name in rows],
        "cycle": [str(runs[name].number) for _, name in rows],
    }
    sentence = f"runs: {len(runs)} columns ({listed}), read one after the other; forward runs rise, backward runs fall"
    by_rows = table_of(table.file, table.kind, columns, [table.lines[row] for row, _ in rows])
    return LongTable(by_rows, {**stated, "command": position}, [sentence])


def deviation_columns(table: ForeignTable, columns: Mapping[str, str]) -> dict[str, str]:
    """Columns that are actual minus commanded position in every row, by name, with their formula in words.

    Args:
        table: the foreign table.
        columns: its columns by field, `command` and `value` among them.
    """
    command, value = (_numbers(table.columns[columns[field]]) for field in ("command", "value"))
    names = (columns["value"], columns["command"])
    formulas = {}
    for name, cells in table.columns.items():
        words = set(words_of(name))
        if name in names or not words & (SPREAD | DEVIATION | {"fehler"}):
            continue
        scale = scale_between(name, columns["value"])
        numbers = _numbers(cells)
        rows = [k for k, cell in enumerate(numbers) if cell is not None and None not in (command[k], value[k])]
        for sign, text in ((1.0, f"{names[0]} - {names[1]}"), (-1.0, f"{names[1]} - {names[0]}"), (0.0, "")):
            within_rounding = [
                abs(_signed(value[k] - command[k], sign) * scale - numbers[k]) <= _half_digit(cells[k])  # type: ignore
                for k in rows
            ]
            if len(rows) > 2 and all(within_rounding) and any(numbers[k] for k in rows):
                formulas[name] = escaped(text or f"|{names[0]} - {names[1]}|", 120)
                break
    return formulas


def _signed(deviation: float, sign: float) -> float:
    return sign * deviation if sign else abs(deviation)


def _numbers(cells: Sequence[str]) -> list[float | None]:
    return [float(cell) if NUMBER.fullmatch(cell) else None for cell in cells]


def _half_digit(cell: str) -> float:
    """Half of the last digit of a written number, plus rounding in double precision."""
    decimals = len(cell.lower().partition("e")[0].partition(".")[2])
    return 0.5000001 * 10.0**-decimals + 1e-12


def scale_between(name: str, other_name: str) -> float:
    """Units of one column in a unit of another, by their names; 1 where these do not state them."""
    unit, other = unit_of_name(name, READING_UNITS), unit_of_name(other_name, READING_UNITS)
    for units in (LENGTHS_MM, DEGREES):
        if unit in units and other in units:
            return units[other] / units[unit]
    return 1.0


def refuse_small(table: ForeignTable, columns: Mapping[str, str]) -> None:
    """Refuse readings in the unit of the commands that are too small and too loose to be positions.

    Raises:
        InputError: they look like deviations, and the user has not stated otherwise.
    """
    names = columns["command"], columns["value"]
    units = [unit_of_name(name, READING_UNITS) for name in names]
    comparable = any(units[0] in points and units[1] in points for points in (LENGTHS_MM, DEGREES))
    pairs = zip(*(_numbers(table.columns[name]) for name in names), strict=True)
    points = [(c, v * scale_between(names[0], names[1])) for c, v in pairs if c is not None and v is not None]
    if not comparable or len(points) < 4:
        return
    commands, values = zip(*points, strict=True)
    span = max(values) - min(values)
    if not 0 < span < SMALL_SHARE * (max(commands) - min(commands)):
        return
    c_mean, v_mean = sum(commands) / len(points), sum(values) / len(points)
    slope = sum((c - c_mean) * (v - v_mean) for c, v in points) / (sum((c - c_mean) ** 2 for c in commands) or 1.0)
    scatter = math.sqrt(sum((v - v_mean - slope * (c - c_mean)) ** 2 for c, v in points) / len(points))
    if scatter > LOOSE_SHARE * span:
        found = f"readings that span {span:.3g} {units[0]} over {max(commands) - min(commands):.6g} of commands"
        raise InputError(
            "deviations",
            f"{table.file}, {escaped(names[1])}: found {found}; allowed: positions; are they actual less commanded "
            "position? then add --deviations; they are positions? then --column value="
            f"{escaped(names[1])}",
            file=table.file,
            column=names[1],
            found=found,
            allowed="positions",
            remedy=f"add --deviations, or --column value={escaped(names[1])}",
        )
