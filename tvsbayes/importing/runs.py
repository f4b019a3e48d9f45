"""Tables of an axis with a column for each run, turned into tables with a row for each reading."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import fmean, stdev

import numpy as np

from tvsbayes.errors import escaped
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.asking import listed, refused
from tvsbayes.importing.cells import plain_column
from tvsbayes.importing.columns import columns_of
from tvsbayes.importing.table import ForeignTable, table_of
from tvsbayes.importing.words import Name, Unit, means, name_of, place_of, words_of

FORWARD, ALTERNATE, REPEATS = "forward", "alternate", "repeats"
ORDERS = (FORWARD, ALTERNATE, REPEATS)
"""Values of --runs: all runs rise; every second run falls; readings of one stop."""
FOLLOWS_R2 = 0.98
"""Least squared correlation with the commands of a column that follows them."""
AGREEMENT_ERRORS = 3.0
"""Standard errors of the mean difference of two groups of runs within which they agree."""
POSITIONS_MIN = 3
NUMERIC_SHARE = 0.6
"""Least share of numbers among the cells of a run."""
_ARROWS = str.maketrans({"\u2191": " forward ", "\u2193": " backward ", "\u2192": " forward ", "\u2190": " backward "})
_SIGN = re.compile(r"^\s*([+-])\s*\d*\s*(?:[(\[/,]|$)|^\s*\d+\s*([+-])\s*(?:[(\[/,]|$)|\s\(?([+-])\)?\s*(?:[(\[/,]|$)")
"""A sign in place of a direction: "+1", "1 - (mm)", "Run 1 (+)"."""
_NEVER = (
    *("aside", "statistic", "temperature", "time", "index", "several", "moving", "resting", "status", "excluded"),
    "approach",
)


@dataclass(frozen=True)
class Run:
    """A column of readings: its number, and its side, 1 forward, -1 backward, 0 unnamed."""

    name: Name
    number: int
    side: int


@dataclass(frozen=True)
class LongTable:
    """A table with a row for each reading, its columns as stated or known by field, and remarks in words."""

    table: ForeignTable
    stated: Mapping[str, str]
    remarks: list[str]
    unused: tuple[str, ...] = ()


def long_table(table: ForeignTable, stated: Mapping[str, str], order: str | None = None) -> LongTable:
    """A table with a column for each run as one with a row for each reading; other tables are unchanged.

    Forward runs have rising, backward runs falling commands, in the order of their numbers.

    Args:
        table: the foreign table.
        stated: column by field, as the user states it; with `value` or `approach` stated, the table is not converted.
        order: one of `ORDERS`, for runs without words of direction.

    Raises:
        Question: the order of runs that differ, or which column has the commands.
    """
    written, plain = table, {text: plain_column(text, cells) for text, cells in table.columns.items()}
    between = {text: _words_between(table, text, column.cells) for text, column in plain.items()}
    cells_of = {t: tuple("" if k in between[t] else c for k, c in enumerate(p.cells)) for t, p in plain.items()}
    table = replace(table, columns=cells_of)
    runs = _runs(table, {text: column.unit for text, column in plain.items()}, stated=order is not None)
    if not runs and order is not None and not stated.get("value"):
        runs = _in_columns(table, stated)
    if not runs or stated.get("value") or stated.get("approach"):
        return LongTable(written, stated, [])
    command = stated.get("command") or _command(table, runs)
    remarks: list[str] = []
    runs = _turned(table, runs, remarks)
    sides = [run.side for run in runs]
    names = [run.name.text for run in runs]
    positions = [float(cell) for cell in table.columns[command]]
    rising = sorted(range(len(positions)), key=positions.__getitem__)
    side_of_row = [] if any(sides) else _row_sides(table)
    if not any(sides):
        # Beside commands that rise and fall, or come again, columns are readings of one stop.
        turns = positions not in (sorted(positions), sorted(positions, reverse=True))
        again = len({*zip(positions, side_of_row, strict=True)}) < len(positions) if side_of_row else turns
        order = order or (
            REPEATS if again else FORWARD if side_of_row and not _are_readings(runs) else _order(table, runs)
        )
        sides = [1 if order != ALTERNATE or k % 2 == 0 else -1 for k in range(len(runs))]
    if order == REPEATS:
        rows = [(row, k) for row in range(len(positions)) for k in range(len(runs))]
        remarks.append(f"columns {listed(names)}: readings of one stop each; --runs says another")
    elif side_of_row:
        ways = ((side, row) for side in (1, -1) for row in rising[::side] if side_of_row[row] == side)
        in_order = [row for _, row in ways]
        rows = [(row, k) for k in range(len(runs)) for row in in_order]
        remarks.append(f"runs: {len(runs)} columns ({listed(names)}), each forward and then backward as its rows say")
    else:
        rows = [(row, k) for k in range(len(runs)) for row in rising[:: sides[k]]]
        if any(run.side for run in runs):
            words = "forward runs rise, backward runs fall"
        else:
            words = f"all {'rise' if min(sides) > 0 else 'rise and fall in turn'}; --runs says another"
        remarks.append(f"runs: {len(runs)} columns ({listed(names)}), read one after the other; {words}")
    lost = [f'"{escaped(word, 20)}" (line {table.lines[row]})' for text in names for row, word in between[text].items()]
    if lost:
        remarks.append(f"cells of runs that are no numbers, left out: {listed(lost)}")
    unit = next((run.name.unit for run in runs if run.name.unit), None)
    factors = [run.name.unit.in_units_of(unit) if run.name.unit and unit else 1.0 for run in runs]
    if None in factors or (unit and any(run.name.unit is None for run in runs)):
        raise refused("run-units", table.file, line=table.first_line, runs=names)
    above = [place_of(words_of(line), "deviation") for line in table.above]
    kind = "deviation" if any(run.name.has("deviation") for run in runs) or above != [None] * len(above) else "reading"
    bracket = (
        f" ({unit.name})" if unit and unit.per_number == 1.0 else f" ({unit.per_number:g} {unit.name})" if unit else ""
    )
    unknown = next((run.name.unknown for run in runs if run.name.unknown), "")
    reading = f"{kind}{bracket or (f' ({unknown})' if unknown else '')}"
    columns: dict[str, Sequence[object]] = {command: [written.columns[command][row] for row, _ in rows]}
    if order != REPEATS or side_of_row:
        columns["direction"] = [
            "forward" if (side_of_row[row] if side_of_row else sides[k]) > 0 else "backward" for row, k in rows
        ]
    if order != REPEATS:
        columns["cycle"] = [str(runs[k].number) for _, k in rows]
    columns[reading] = [_scaled(table.columns[names[k]][row], factors[k]) for row, k in rows]
    rest = [name for name in table.columns if name not in (*names, command)]
    spread = [name for name in rest if name_of(name).is_u]
    if len(runs) > len(set(sides)):
        # Beside several runs of one side a standard deviation is theirs, not that of a reading.
        spread = [name for name in spread if place_of(name_of(name).words, "scatter") is None]
    if len(spread) == 1:
        columns[spread[0]] = [table.columns[spread[0]][row] for row, _ in rows]
    by_rows = table_of(table.file, table.kind, columns, [table.lines[row] for row, _ in rows])
    by_rows = replace(by_rows, first_line=table.first_line, above=table.above)
    unused = tuple(name for name in rest if spread != [name])
    return LongTable(by_rows, {**stated, "command": command}, remarks, unused)


def _turned(table: ForeignTable, runs: list[Run], remarks: list[str]) -> list[Run]:
    """Runs to the right and left with the side that lags as the forward one: play holds the reading back."""
    if not any(run.side and run.name.has("clockwise", "counterclockwise") for run in runs):
        return runs
    means = {
        side: fmean(float(cell) for run in runs if run.side == side for cell in table.columns[run.name.text] if cell)
        for side in {run.side for run in runs}
    }
    rises = len(means) < 2 or means[1] <= means[-1]
    first = next(run.name.text for run in runs if (run.side > 0) == rises)
    remarks.append(f"runs: those as {escaped(first)} rise, since their readings lag behind the others")
    turned = runs if rises else [replace(run, side=-run.side) for run in runs]
    return sorted(turned, key=lambda run: (run.number, -run.side))


def _row_sides(table: ForeignTable) -> list[int]:
    """The side of each row where a column of words states one for all, else []."""
    for text, cells in table.columns.items():
        if name_of(text).has("approach") and all(means(cell, "forward") or means(cell, "backward") for cell in cells):
            return [1 if means(cell, "forward") else -1 for cell in cells]
    return []


def _scaled(cell: str, factor: float | None) -> str:
    return cell if factor == 1.0 or not NUMBER.fullmatch(cell) else repr((factor or 1.0) * float(cell))


def _words_between(table: ForeignTable, text: str, cells: Sequence[str]) -> dict[int, str]:
    """Words in a column of numbers, as "lost" or "19.99*", by row; empty for other columns."""
    filled = [cell for cell in cells if cell]
    found = {row: table.columns[text][row] for row, cell in enumerate(cells) if cell and not NUMBER.fullmatch(cell)}
    return found if len(found) <= (1 - NUMERIC_SHARE) * len(filled) else {}


def _numeric(cells: Sequence[str]) -> bool:
    filled = [cell for cell in cells if cell]
    return bool(filled) and all(map(NUMBER.fullmatch, filled))


def _runs(table: ForeignTable, units: Mapping[str, Unit | None], *, stated: bool = False) -> list[Run]:
    """Columns with one run each, in order: those with words of direction, else those alike but for a number."""
    sided: list[Run] = []
    alike: defaultdict[tuple[str, ...], list[Run]] = defaultdict(list)
    for text, cells in table.columns.items():
        name = name_of(text.translate(_ARROWS))
        name = replace(name, text=text, unit=units[text] or name.unit)
        if not _numeric(cells) or (name.has(*_NEVER) and not name.has("run")) or name.is_u:
            continue
        signed = _SIGN.search(text)
        rising, falling = name.has("forward", "clockwise"), name.has("backward", "counterclockwise")
        side = (1 if "+" in signed.groups() else -1) if signed else rising - falling
        both = rising and falling
        turning = name.has("clockwise", "counterclockwise") and not name.has("forward", "backward")
        if name.has("several") and (not side or (turning and not name.has("run"))):
            continue
        if side and not both and len(name.numbers) < 2 and not name.has("command"):
            sided.append(Run(name, name.numbers[0] if name.numbers else 1, side))
        elif not side and name.numbers:
            skeleton = tuple(word for word in name.words if not word.isdigit())
            alike[skeleton].append(Run(name, name.numbers[-1], 0))
    if any(run.name.numbers for run in sided):
        # "B" beside "Down 1" is a figure.
        sided = [run for run in sided if run.name.numbers]
    if len(sided) > 1 and len({(run.number, run.side) for run in sided}) == len(sided):
        others = [of for of in alike.values() if {r.number for r in of} & {r.number for r in sided}]
        if len({run.side for run in sided}) == 1 and len(others) == 1 and not others[0][0].name.has("command"):
            texts = [[run.name.text for run in group] for group in (sided, others[0])]
            places = [[*table.columns].index(text) for text in texts[0]]
            if stated:
                return []
            if min(b - a for a, b in pairwise(sorted(places))) > 1:
                raise table.ask("one-way-runs-in-turn", runs=texts[0], others=texts[1])
            raise refused("one-way-runs", table.file, line=table.first_line, runs=texts[0], others=texts[1])
        return sorted(sided, key=lambda run: (run.number, -run.side))
    groups = [runs for runs in alike.values() if len(runs) > 1 and len({run.number for run in runs}) == len(runs)]
    groups = [runs for runs in groups if _are_runs(runs, table) or (stated and not runs[0].name.has("command"))]
    return sorted(groups[0], key=lambda run: run.number) if len(groups) == 1 else []


def _in_columns(table: ForeignTable, stated: Mapping[str, str]) -> list[Run]:
    """All columns that follow the commands, as runs in the order of the columns, where the user says that they are."""
    known = {text: column for text, column in columns_of(table).items() if _numeric(column.cells)}
    never = ("aside", "statistic", "temperature", "time", "index")
    known = {text: column for text, column in known.items() if not column.name.has(*never) and not column.name.is_u}
    commands = [text for text, column in known.items() if column.name.has("command")] or list(known)
    command = known.get(stated.get("command") or next(iter(commands), ""))
    runs = list[Run]()
    for text, column in known.items():
        if command is None or column is command or not np.isfinite(column.values).all():
            continue
        if not np.ptp(column.values) or np.corrcoef(command.values, column.values)[0, 1] ** 2 < FOLLOWS_R2:
            continue
        runs.append(Run(replace(column.name, text=text, unit=column.unit), len(runs) + 1, 0))
    return runs


def _are_runs(runs: Sequence[Run], table: ForeignTable) -> bool:
    """Whether columns alike but for a number are runs: by a word, by no word at all, or as readings counted from 1."""
    name = runs[0].name
    words = [word for word in name.words if not word.isdigit()]
    counted = sorted(run.number for run in runs) in ([*range(1, len(runs) + 1)], [*range(len(runs))])
    rest = [text for text in table.columns if text not in {run.name.text for run in runs}]
    read = [text for text in rest if name_of(text).has("value") and not name_of(text).has("command")]
    others = any(_numeric(table.columns[text]) for text in read)
    numbers = {run.number for run in runs}
    # "J1 target" beside "J1 actual": another axis.
    paired = any(name_of(text).has("command") and numbers & {*name_of(text).numbers} for text in rest)
    if name.has("command") or not counted or paired:
        return False
    return name.has("run") or not words or (not others and name.has("value", "position", "deviation"))


def _command(table: ForeignTable, runs: Sequence[Run]) -> str:
    """The column of the commands beside the runs."""
    names = {run.name.text for run in runs}
    rest = [name_of(text) for text, cells in table.columns.items() if text not in names and _numeric(cells)]
    rest = [name for name in rest if all(table.columns[name.text])]
    rest = [name for name in rest if name.has("command") or not counts_rows(table.columns[name.text])] or rest
    for kind in ("command", "position", ""):
        fit = [
            name
            for name in rest
            if (name.has(kind) if kind else not name.has("aside", "temperature", "time", "index", "u", "statistic"))
        ]
        fit = [name for name in fit if not (kind and name.has("aside", "u", "temperature", "time"))]
        if len(fit) == 1:
            return fit[0].text
        if fit:
            rest = fit
            break
    texts = [run.name.text for run in runs]
    if not rest:
        raise refused("no-runs-command", table.file, line=table.first_line, runs=texts)
    first = {name.text: table.columns[name.text][:3] for name in rest}
    raise table.ask("runs-command", each=first, first=first, runs=texts)


def _are_readings(runs: Sequence[Run]) -> bool:
    """Whether columns are called readings, not runs, so that they may be of one stop."""
    name = runs[0].name
    return name.has("value") and not name.has("run") and any(not word.isdigit() for word in name.words)


def counts_rows(cells: Sequence[str]) -> bool:
    """Whether cells are 0, 1, 2 ... or 1, 2, 3 ..."""
    return list(cells) in ([str(k) for k in range(len(cells))], [str(k) for k in range(1, len(cells) + 1)])


def _order(table: ForeignTable, runs: Sequence[Run]) -> str:
    """`FORWARD` where odd and even, first and second runs agree within scatter."""
    names = [run.name.text for run in runs]
    values = [[float(cell) if cell else math.nan for cell in table.columns[name]] for name in names]
    is_reading = _are_readings(runs)
    half = len(runs) // 2
    if not is_reading and _agree(values[::2], values[1::2]) and _agree(values[:half], values[half:]):
        return FORWARD
    differ = "" if is_reading else ", whose readings differ by more than their scatter"
    raise table.ask("runs", runs=names, differ=differ)


def _agree(some: Sequence[Sequence[float]], others: Sequence[Sequence[float]]) -> bool:
    """Whether the means of two groups of runs agree over the positions, within the scatter of one reading."""
    places = [k for k in range(len(some[0])) if not any(math.isnan(run[k]) for run in (*some, *others))]
    gaps = [fmean(run[k] for run in some) - fmean(run[k] for run in others) for k in places]
    if len(gaps) < POSITIONS_MIN:
        return False
    within = [run[k] - fmean(r[k] for r in group) for group in (some, others) for run in group for k in places]
    freedom = len(places) * (len(some) + len(others) - 2)
    scatter = math.sqrt(sum(e * e for e in within) / freedom) if freedom else stdev(gaps) / math.sqrt(2.0)
    error = scatter * math.sqrt((1 / len(some) + 1 / len(others)) / len(places))
    return abs(fmean(gaps)) <= max(scatter, AGREEMENT_ERRORS * error)
