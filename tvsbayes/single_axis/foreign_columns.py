"""What the columns of somebody's table of an axis hold, beyond their names: runs side by side, deviations.

A table with a column for each run becomes one with a row for each reading; a column that is actual less commanded
position is no uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tvsbayes.errors import InputError, escaped, refusal
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.files.foreign_table import ForeignTable, table_of
from tvsbayes.instrument.column_names import DEGREES, READING_UNITS, SPREAD, unit_of_name, words_of

DIRECTIONS = {
    1: {"forward", "forwards", "fwd", "up", "vorwarts", "hin", "adelante", "ida", "avant", "aller"},
    -1: {"backward", "backwards", "back", "bwd", "rev", "reverse", "down", "ruckwarts", "zuruck", "ruck", "atras"}
    | {"vuelta", "arriere", "retour"},
}
"""Words of columns that hold the readings of one direction, without accents."""
DEVIATION = {"deviation", "dev", "abweichung", "desviacion", "diff", "difference", "delta", "differenz", "ecart"}
"""Words of columns that may be actual less commanded position, beside those of uncertainties."""
LENGTHS_MM = {"mm": 1.0, "um": 1e-3, "nm": 1e-6, "thou": 0.0254, "inch": 25.4}
SMALL_SHARE, LOOSE_SHARE = 0.05, 0.02
"""Readings in the unit of the commands that span less than the first share of them, and scatter by more than the second
share of their own span about a line, are no positions."""
_ARROWS = str.maketrans({"\u2191": " forward ", "\u2193": " backward ", "\u2192": " forward ", "\u2190": " backward "})


def run_columns(columns: Mapping[str, Sequence[str]]) -> dict[str, tuple[int, int]]:
    """Columns that hold a run each, by name: its number and its direction; empty where the table has none."""
    runs: dict[str, tuple[int, int]] = {}
    for name, cells in columns.items():
        words = words_of(name.translate(_ARROWS))
        sides = [side for side, spellings in DIRECTIONS.items() if spellings.intersection(words)]
        numbers = [int(word) for word in words if word.isdigit()]
        first = next((cell for cell in cells if cell), "")
        if len(sides) == 1 and len(numbers) < 2 and NUMBER.fullmatch(first):
            runs[name] = (numbers[0] if numbers else 1, sides[0])
    both = {side for _, side in runs.values()} == {-1, 1}
    return runs if (both or len(runs) > 1) and len(set(runs.values())) == len(runs) else {}


@dataclass(frozen=True)
class OneReadingARow:
    """A table with a row for each reading, its columns by field where they are known, and remarks in words."""

    table: ForeignTable
    stated: Mapping[str, str]
    remarks: list[str]


def one_reading_a_row(table: ForeignTable, stated: Mapping[str, str]) -> OneReadingARow:
    """A table with a column for each run as one with a row for each reading; any other as it is.

    Forward runs rise, backward runs fall, in the order of their numbers.

    Args:
        table: as it was read.
        stated: column by field, where somebody has said it; with `value` or `approach` stated, the table stays.

    Raises:
        InputError: no column, or several, of the positions; runs in several units.
    """
    runs = run_columns(table.columns)
    if not runs or stated.get("value") or stated.get("approach"):
        return OneReadingARow(table, stated, [])
    others = [name for name in table.columns if name not in runs]
    numeric = [name for name in others if table.columns[name] and all(map(NUMBER.fullmatch, table.columns[name]))]
    position = stated.get("command") or (numeric[0] if len(numeric) == 1 else None)
    named = ", ".join(map(escaped, runs))
    if position is None or position not in others or not all(map(NUMBER.fullmatch, table.columns[position])):
        found, allowed = f"runs ({named}) and no column that is surely their position", "one column of numbers"
        remedy = "say which: --column command=NAME"
        raise refusal(
            "missing-column", file=table.file, line=table.first_line, found=found, allowed=allowed, remedy=remedy
        )
    units = {unit_of_name(name, READING_UNITS) for name in runs}
    if len(units) > 1:
        found, remedy = f"runs in {', '.join(sorted(map(str, units)))} ({named})", "give all runs in one unit"
        raise refusal("csv", file=table.file, line=table.first_line, found=found, allowed="one unit", remedy=remedy)
    at = [float(cell) for cell in table.columns[position]]
    rising = sorted(range(len(at)), key=at.__getitem__)
    rows = [
        (row, name, side)
        for name, (_, side) in sorted(runs.items(), key=lambda item: (item[1][0], -item[1][1]))
        for row in (rising if side > 0 else rising[::-1])
    ]
    unit = next(iter(units))
    columns: dict[str, Sequence[object]] = {
        position: [table.columns[position][row] for row, _, _ in rows],
        "direction": ["forward" if side > 0 else "backward" for _, _, side in rows],
        "reading" + f" ({unit})" * (unit is not None): [table.columns[name][row] for row, name, _ in rows],
        "cycle": [str(runs[name][0]) for _, name, _ in rows],
    }
    sentence = f"runs: {len(runs)} columns ({named}), read one after the other; forward runs rise, backward runs fall"
    by_rows = table_of(table.file, table.kind, columns, [table.lines[row] for row, _, _ in rows])
    return OneReadingARow(by_rows, {**stated, "command": position}, [sentence])


def deviation_columns(table: ForeignTable, columns: Mapping[str, str]) -> dict[str, str]:
    """Columns that are actual less commanded position in every row, by name, and which way in words.

    Args:
        table: as it was read.
        columns: its columns by field, `command` and `value` among them.
    """
    command, value = (_numbers(table.columns[columns[field]]) for field in ("command", "value"))
    names = (columns["value"], columns["command"])
    ways = {}
    for name, cells in table.columns.items():
        words = set(words_of(name))
        if name in names or not words & (SPREAD | DEVIATION | {"fehler"}):
            continue
        scale = _scale(name, columns["value"])
        numbers = _numbers(cells)
        rows = [k for k, cell in enumerate(numbers) if cell is not None and None not in (command[k], value[k])]
        for sign, text in ((1.0, f"{names[0]} - {names[1]}"), (-1.0, f"{names[1]} - {names[0]}"), (0.0, "")):
            off = [
                abs(_signed(value[k] - command[k], sign) * scale - numbers[k]) <= _half_digit(cells[k])  # type: ignore
                for k in rows
            ]
            if len(rows) > 2 and all(off) and any(numbers[k] for k in rows):
                ways[name] = escaped(text or f"|{names[0]} - {names[1]}|", 120)
                break
    return ways


def _signed(deviation: float, sign: float) -> float:
    return sign * deviation if sign else abs(deviation)


def _numbers(cells: Sequence[str]) -> list[float | None]:
    return [float(cell) if NUMBER.fullmatch(cell) else None for cell in cells]


def _half_digit(cell: str) -> float:
    """Half of the last digit of a number as it is written, and rounding of double numbers."""
    decimals = len(cell.lower().partition("e")[0].partition(".")[2])
    return 0.5000001 * 10.0**-decimals + 1e-12


def _scale(name: str, beside: str) -> float:
    """Units of one column in one of another, by their names; 1 where they do not say."""
    unit, other = unit_of_name(name, READING_UNITS), unit_of_name(beside, READING_UNITS)
    for units in (LENGTHS_MM, DEGREES):
        if unit in units and other in units:
            return units[other] / units[unit]
    return 1.0


def refuse_small(table: ForeignTable, columns: Mapping[str, str]) -> None:
    """Refuse readings in the unit of the commands that are too small and too loose to be positions.

    Raises:
        InputError: they look like deviations, and nobody said that they are none.
    """
    names = columns["command"], columns["value"]
    units = [unit_of_name(name, READING_UNITS) for name in names]
    same = any(units[0] in known and units[1] in known for known in (LENGTHS_MM, DEGREES))
    pairs = zip(*(_numbers(table.columns[name]) for name in names), strict=True)
    known = [(c, v * _scale(names[0], names[1])) for c, v in pairs if c is not None and v is not None]
    if not same or len(known) < 4:
        return
    commands, values = zip(*known, strict=True)
    span = max(values) - min(values)
    if not 0 < span < SMALL_SHARE * (max(commands) - min(commands)):
        return
    middle, level = sum(commands) / len(known), sum(values) / len(known)
    slope = sum((c - middle) * (v - level) for c, v in known) / (sum((c - middle) ** 2 for c in commands) or 1.0)
    scatter = math.sqrt(sum((v - level - slope * (c - middle)) ** 2 for c, v in known) / len(known))
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


def positions_of_deviations(
    columns: Mapping[str, str], commands: Sequence[float], deviations: Sequence[float | None]
) -> tuple[list[float | None], float]:
    """Positions in the unit of the commands, and by which factor deviations were turned into it."""
    factor = _scale(columns["command"], columns["value"])
    return [None if d is None else c + factor * d for c, d in zip(commands, deviations, strict=True)], factor
