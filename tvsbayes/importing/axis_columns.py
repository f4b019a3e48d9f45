"""Which column of an axis' table is the command, the reading, its uncertainty, the clock.

Words in the names propose; the numbers decide whether there is a question: a column that is left over and follows the
commands as well as the one taken, a reading that is only a deviation, two clocks that differ.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tvsbayes.errors import Candidate, escaped
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.asking import listed
from tvsbayes.importing.cells import (
    Column,
    Understood,
    ask_column,
    check_stated,
    choice,
    columns_of,
    date_time,
    factor_between,
    is_clock,
    is_segment,
    missing_column,
    time_of_day,
)
from tvsbayes.importing.runs import counts_rows
from tvsbayes.importing.table import ForeignTable
from tvsbayes.importing.words import means

FIELDS = ("command", "value", "u", "status", "segment", "time_s", "approach", "temperature_degC", "moving")
"""All fields of a table of an axis."""
COPY_SHARE = 1e-9
"""Largest deviation from a line, as a share of the span, of a column that repeats another."""
FOLLOWS_R2 = 0.98
"""Least squared correlation with the commands of a column that follows them."""
STEADY_SHARE, STEP_TOLERANCE = 0.7, 0.2
"""Share of steps in proportion to those of the commands, to this tolerance, in a column that wraps or jumps."""
SMALL_SHARE, LOOSE_SHARE = 0.05, 0.02
"""Readings in the unit of the commands are not positions if they span less than the first share of the commands' range
and scatter by more than the second share of their own span about a line."""
ROOM_DEGC = (10.0, 40.0)
"""Temperatures of a room."""
DEVIATIONS, POSITIONS = "--deviations", "--positions"
"""Options that say what the readings are."""


def axis_columns(table: ForeignTable, stated: Mapping[str, str], deviations: bool | None = None) -> Understood:
    """The columns of an axis' table by field.

    Args:
        table: a table with a row for each reading or move.
        stated: column by field, as the user states it; "" where the table has no such column.
        deviations: whether the readings are actual less commanded position; None where nobody says it.

    Raises:
        Question: two columns could be one field.
        InputError: a field or column that does not exist, or no column for a command or a reading.
    """
    known = columns_of(table)
    check_stated(list(known), stated, FIELDS)
    taken = {field: name for field, name in stated.items() if name}
    taken |= {f: f for f in known if f in FIELDS and f not in stated and f not in taken.values()}
    free = {text: column for text, column in known.items() if text not in taken.values()}
    of_role: dict[str, list[str]] = {}
    for text, column in free.items():
        of_role.setdefault(_role(column), []).append(text)
    numbers = [name for role in ("command", "value", "position", "") for name in of_role.get(role, ())]
    volts = [n for n in of_role.get("aside", ()) if (u := known[n].name.unit) and u.kind == "voltage"]
    if len(numbers) == 1 and len(volts) == 1 and not {"command", "value"} & taken.keys():
        ways = {"value": (volts[0], numbers[0]), "command": (numbers[0], volts[0])}
        ways = {role: pair for role, pair in ways.items() if numbers[0] in of_role.get(role, ())} or ways
        if len(ways) > 1:
            candidates = [choice(dict(zip(("command", "value"), pair, strict=True)), known) for pair in ways.values()]
            raise ask_column(table, f"positions and volts ({listed([*numbers, *volts])})", candidates)
        taken |= dict(zip(("command", "value"), *ways.values(), strict=True))
    if len(numbers) < 2:
        # A column that counts the rows is no number of theirs, unless little else is there.
        of_role.setdefault("", []).extend(of_role.get("index", ()))
    remarks: list[str] = []
    _take_command(table, known, of_role, taken, remarks)
    of_role = {role: _of_device(known, names, taken["command"]) for role, names in of_role.items()}
    _take_value(table, known, of_role, taken, stated, remarks, deviations)
    _take_sides(table, known, of_role, taken, stated, remarks)
    unused = tuple(text for text in known if text not in taken.values())
    return Understood(taken, unused, tuple(remarks))


def _role(column: Column) -> str:
    """What a column may hold, by its name and the form of its cells; "" where the name says nothing."""
    name, unit = column.name, column.name.unit
    kind = unit.kind if unit else ""
    if name.has("temperature") or kind == "temperature":
        return "temperature_degC" if _varied_number(column) else "aside"
    if name.has("aside") or kind in ("other", "voltage"):
        return "aside"
    if kind == "time" or (name.has("time") and not kind):
        return "time_s"
    if name.has("u", "expanded"):
        return "u"
    if name.has("deviation"):
        return "deviation"
    for role in ("moving", "resting", "status", "approach"):
        if name.has(role) and not kind and not (name.has("command", "value") and column.numeric):
            return role
    if name.has("segment") and not kind and is_segment(column.cells):
        return "segment"
    if name.has("repeat", "index") and not kind and column.whole and not name.has("command", "value"):
        return "aside"
    if _states_sides(column):
        return "approach"
    command, value = name.place("command"), name.place("value")
    if (column.numeric or column.has_digits) and (command is not None or value is not None):
        is_number = value is not None and name.place("number") == value
        return "command" if value is None or (command is not None and (command < value or is_number)) else "value"
    if not name.has("command", "value", "position") and not kind and counts_rows(column.cells):
        return "index"
    if not column.numeric and not (column.has_digits and name.has("command", "value", "position")):
        return "aside"
    if name.has("statistic") and not name.has("position"):
        return "aside"
    return "position" if name.has("position") or (unit is not None and not name.words) else ""


def _states_sides(column: Column) -> bool:
    """Whether the cells of a column are words of direction, whatever its name."""
    words = {cell for cell in column.cells if cell}
    sides = ("forward", "backward", "clockwise", "counterclockwise")
    return (
        bool(words)
        and len(words) <= 3
        and all(any(means(word, side) for side in sides) and not NUMBER.fullmatch(word) for word in words)
    )


def _of_device(known: Mapping[str, Column], names: list[str], command: str) -> list[str]:
    """Of several columns of one role the one with the number of the command's, as "pos (5)" beside "target (5)"."""
    numbers = known[command].name.numbers
    same = [name for name in names if numbers and known[name].name.numbers == numbers]
    return same if len(same) == 1 and all(known[name].name.numbers for name in names) else names


def _varied_number(column: Column) -> bool:
    return bool(np.isfinite(column.values).any())


def _take_sides(
    table: ForeignTable,
    known: Mapping[str, Column],
    of_role: Mapping[str, list[str]],
    taken: dict[str, str],
    stated: Mapping[str, str],
    remarks: list[str],
) -> None:
    """Take time, u, status, motion, segment, approach and temperature."""

    def open_(field: str) -> bool:
        return field not in stated and field not in taken

    for field in ("segment", "approach", "status"):
        names = of_role.get(field, [])
        if open_(field) and len(names) > 1:
            found = f"{len(names)} columns that could be {field} ({listed(names)})"
            candidates = [choice({field: name}, known) for name in (*names, "")]
            raise ask_column(table, found, candidates)
        if open_(field) and names:
            taken[field] = names[0]
    temperatures = of_role.get("temperature_degC", [])
    if open_("temperature_degC") and len(temperatures) == 1:
        taken["temperature_degC"] = temperatures[0]
    elif open_("temperature_degC") and temperatures:
        remarks.append(f"temperature: none of {listed(temperatures)}; --column temperature_degC=NAME takes one")
    moving = [*of_role.get("moving", ()), *of_role.get("resting", ())]
    if open_("moving") and len(moving) == 1:
        taken["moving"] = moving[0]
    spreads = [name for name in of_role.get("u", ()) if known[name].numeric or _varied_number(known[name])]
    standard = [name for name in spreads if known[name].name.coverage is None]
    spreads = standard if len(standard) == 1 else spreads
    if open_("u") and len(spreads) > 1:
        found = f"{len(spreads)} columns of uncertainties ({listed(spreads)})"
        raise ask_column(table, found, [choice({"u": name}, known) for name in (*spreads, "")])
    if open_("u") and spreads:
        if np.nanmin(known[spreads[0]].values) < 0:
            remarks.append(f"column {escaped(spreads[0])} has negative numbers, so it is no uncertainty; set aside")
        else:
            taken["u"] = spreads[0]
    if open_("time_s") and (names := of_role.get("time_s", [])):
        taken["time_s"] = _clock(table, names, known)


def _clock(table: ForeignTable, names: Sequence[str], known: Mapping[str, Column]) -> str:
    """The clock: the only one, or the first of several that agree.

    Raises:
        Question: they differ.
    """
    if len(names) == 1:
        if _may_be_degC(known[names[0]]):
            found = f"column {escaped(names[0])}, which could be a clock or a thermometer"
            columns = [{field: names[0]} for field in ("time_s", "temperature_degC")]
            raise ask_column(table, found, [choice(each, known) for each in (*columns, {"time_s": ""})])
        return names[0]
    times = [_relative_times(known[name]) for name in names]
    usable = [name for name, time in zip(names, times, strict=True) if time is not None]
    if len(usable) == 1:
        return usable[0]
    first = next((time for time in times if time is not None), None)
    if first is not None and all(time is None or _equal_clocks(first, time) for time in times):
        return usable[0]
    found = f"{len(names)} columns that could be the clock ({listed(names)})"
    raise ask_column(table, found, [choice({"time_s": name}, known) for name in (*names, "")])


def _may_be_degC(column: Column) -> bool:
    """Whether a column T holds temperatures of a room as well as times."""
    values, (low, high) = column.values, ROOM_DEGC
    is_room = np.isfinite(values).all() and values[0] and np.all((low <= values) & (values <= high))
    return column.name.text.strip() == "T" and bool(is_room) and float(np.ptp(values)) < 0.5 * (high - low)


def _relative_times(column: Column) -> np.ndarray | None:
    """Seconds or numbers since the first row, scaled by the unit; None for dates without times of day."""
    if np.isfinite(column.values).all():
        unit = column.name.unit
        scale = unit.scale if unit and unit.kind == "time" else 1.0
        return scale * (column.values - column.values[0])
    if not is_clock(column.cells) or all(len(cell) <= 10 and time_of_day(cell) is None for cell in column.cells):
        return None
    seconds = [
        of_day if (of_day := time_of_day(c)) is not None else (at.timestamp() if (at := date_time(c)) else np.nan)
        for c in column.cells
    ]
    return np.array(seconds) - seconds[0]


def _equal_clocks(times: np.ndarray, others: np.ndarray) -> bool:
    """Whether two clocks agree but for their unit, to a second or a hundredth."""
    span, other_span = np.ptp(times), np.ptp(others)
    scale = next(
        (s for s in (1.0, 1e3, 1e-3, 1e6, 1e-6, 1e9, 1e-9) if span and abs(other_span / s / span - 1) < 0.01), 1.0
    )
    return bool(np.all(np.abs(others / scale - times) <= 1.0 + 0.01 * span))


def _take_command(
    table: ForeignTable,
    known: Mapping[str, Column],
    of_role: Mapping[str, list[str]],
    taken: dict[str, str],
    remarks: list[str],
) -> None:
    """Take the column of the commands.

    Raises:
        Question: several could be it.
        InputError: none could be it.
    """
    if "command" in taken:
        return
    strong, weak, others = (of_role.get(role, []) for role in ("command", "position", ""))
    readings = of_role.get("value", []) or ([taken["value"]] if "value" in taken else [])
    if len(strong) == 1:
        taken["command"] = strong[0]
        return
    if len(strong) > 1:
        found = f"{len(strong)} columns that could be the command ({listed(strong)})"
        raise ask_column(table, found, [_pair(known, name, of_role, taken) for name in strong])
    pool = weak or others
    if readings and len(pool) == 1:
        taken["command"] = pool[0]
        if not weak:
            remarks.append(
                f"command: column {escaped(pool[0])}, the only other one of numbers; --column command= says another"
            )
        return
    if not readings and len(pool) == 1 and len(of_role.get("deviation", ())) == 1:
        taken["command"] = pool[0]
        return
    pool = [*weak, *others, *([] if len(readings) < 2 else readings)]
    if not pool or (not readings and len(pool) < 2):
        raise missing_column(table, taken, ["command", *(["value"] if not readings else [])], _besides(readings))
    found = f"no column that is surely the command; numbers are in {listed([*pool, *readings])}"
    raise ask_column(table, found, [_pair(known, name, of_role, taken) for name in pool])


def _besides(readings: Sequence[str]) -> str:
    return "" if readings else "; or is a column actual less commanded position: --column value=NAME --deviations"


def _pair(known: Mapping[str, Column], command: str, of_role: Mapping[str, list[str]], taken: Mapping[str, str]):
    """The answer that names a command, and the reading where one is left."""
    readings = [name for role in ("value", "position", "") for name in of_role.get(role, ()) if name != command]
    best = _of_device(known, [name for name in of_role.get("value", ()) if name != command], command) or readings
    columns = {"command": command}
    if "value" not in taken and len(best) == 1:
        columns["value"] = best[0]
    return choice(columns, known)


def _take_value(
    table: ForeignTable,
    known: Mapping[str, Column],
    of_role: Mapping[str, list[str]],
    taken: dict[str, str],
    stated: Mapping[str, str],
    remarks: list[str],
    deviations: bool | None,
) -> None:
    """Take the column of the readings, and set columns of deviations aside that follow from it.

    Raises:
        Question: several could be it, or the only reading is a deviation.
        InputError: none could be it.
    """
    command = known[taken["command"]]
    differences = of_role.get("deviation", [])
    strong, weak, others = (
        [n for n in of_role.get(role, ()) if n not in taken.values()] for role in ("value", "position", "")
    )
    if deviations and "value" not in taken:
        pool = differences or strong or weak or others
        if len(pool) == 1:
            taken["value"] = pool[0]
            return
        if pool:
            found = f"{len(pool)} columns that could be the deviation ({listed(pool)})"
            raise ask_column(table, found, [choice({"value": name}, known, DEVIATIONS) for name in pool])
    if "value" in taken:
        if "value" not in stated:
            _set_aside(known, differences, taken, remarks)
        return
    following = [name for name in others if follows(command, known[name])]
    copies = [name for name in (*weak, *following) if _repeats(command, known[name])]
    pools = (strong, [n for n in weak if n not in copies], [n for n in following if n not in copies], weak, following)
    pool = next(filter(None, pools), [])
    if len(pool) == 1:
        taken["value"] = pool[0]
        if pool[0] in following:
            remarks.append(
                f"value: column {escaped(pool[0])}, the only other following the commands; --column value= changes it"
            )
        unexplained = _set_aside(known, differences, taken, remarks)
        if unexplained and (not strong or not follows(command, known[pool[0]])):
            found = f"column {escaped(pool[0])} beside column {escaped(unexplained[0])}, which is not their difference"
            candidates = [
                choice({"value": pool[0]}, known),
                *(choice({"value": n}, known, DEVIATIONS) for n in unexplained),
            ]
            raise ask_column(table, found, candidates)
        _ask_what_is_left(table, known, [*strong, *weak, *others], taken)
        if deviations is None:
            _ask_small(table, command, known[pool[0]], known)
        return
    if len(pool) > 1:
        candidates = [choice({"value": name}, known) for name in pool]
        raise ask_column(table, f"{len(pool)} columns that could be the reading ({listed(pool)})", candidates)
    if differences:
        if deviations is False and len(differences) == 1:
            taken["value"] = differences[0]
            return
        found = f"no reading but {listed(differences)}, by its name a deviation"
        candidates = [_meaning(known, name, option) for option in (DEVIATIONS, POSITIONS) for name in differences]
        raise ask_column(table, found, candidates, "deviations")
    rest = [name for name in (*weak, *others, *of_role.get("u", ())) if name not in taken.values()]
    if rest:
        found = f"no column that is surely the reading; numbers are in {listed(rest)}"
        candidates = [choice({"value": name}, known, *extra) for name in rest for extra in ((), (DEVIATIONS,))]
        raise ask_column(table, found, candidates)
    raise missing_column(table, taken, ["value"], _besides([]))


def _meaning(known: Mapping[str, Column], name: str, option: str) -> Candidate:
    """The answer that a column holds deviations or positions; columns of runs are known by their names again."""
    words = {DEVIATIONS: "actual less commanded position", POSITIONS: "positions"}[option]
    first = {name: known[name].first}
    return Candidate(f"{escaped(name)} ({', '.join(known[name].first)}) holds {words}", (option,), first)


def _set_aside(
    known: Mapping[str, Column], names: Sequence[str], taken: dict[str, str], remarks: list[str]
) -> list[str]:
    """Name columns that are the reading less the command; return those that are not."""
    command, value = known[taken["command"]], known[taken["value"]]
    unexplained = []
    for name in [*names, *([taken["u"]] if "u" in taken else [])]:
        formula = difference(known[name], command, value)
        if formula:
            remarks.append(f"column {escaped(name)} is {formula} in every row: a deviation, no uncertainty; set aside")
            if taken.get("u") == name:
                del taken["u"]
        elif name in names and known[name].numeric:
            unexplained.append(name)
    return unexplained


def difference(column: Column, command: Column, value: Column) -> str:
    """The formula by which a column is the reading less the command in every row, to its digits; "" where it is not."""
    to_reading = factor_between(command.unit, value.unit)
    to_column = factor_between(value.unit, column.unit)
    if to_reading is None or to_column is None:
        return ""
    gap = (value.values - to_reading * command.values) * to_column
    rows = np.isfinite(gap) & np.isfinite(column.values)
    # The written digits of the difference, of the reading and of the command, in the unit of the difference.
    tolerance = _half_digit(column) + to_column * (_half_digit(value) + to_reading * _half_digit(command)) + 1e-12
    names = escaped(value.name.text), escaped(command.name.text)
    forms = (
        (gap, f"{names[0]} - {names[1]}"),
        (-gap, f"{names[1]} - {names[0]}"),
        (np.abs(gap), f"|{names[0]} - {names[1]}|"),
    )
    if rows.sum() > 2 and np.any(column.values[rows] != 0):
        for numbers, text in forms:
            if np.all(np.abs(numbers - column.values)[rows] <= tolerance):
                return text
    return ""


def _half_digit(column: Column) -> float:
    """Half of the last digit of a column's written numbers."""
    written = (cell.lower().partition("e") for cell in column.cells if NUMBER.fullmatch(cell))
    places = [len(mantissa.partition(".")[2]) - int(exponent or 0) for mantissa, _, exponent in written]
    return 0.5000001 * 10.0 ** -max(places, default=0)


def follows(command: Column, column: Column) -> bool:
    """Whether a column follows the commands: near a line over them, or by steps in proportion to theirs."""
    rows = np.isfinite(command.values) & np.isfinite(column.values)
    c, v = command.values[rows], column.values[rows]
    if len(np.unique(c)) < 3 or np.ptp(v) == 0:
        return False
    if np.corrcoef(c, v)[0, 1] ** 2 >= FOLLOWS_R2:
        return True
    dc, dv = np.diff(c), np.diff(v)
    moved = dc != 0
    slope = np.median(dv[moved] / dc[moved])
    steady = np.abs(dv - slope * dc)[moved] <= STEP_TOLERANCE * np.abs(slope * dc)[moved]
    return bool(slope != 0 and moved.sum() > 2 and steady.mean() >= STEADY_SHARE)


def _repeats(command: Column, column: Column) -> bool:
    """Whether a column is the command again, in the same or another unit."""
    rows = np.isfinite(command.values) & np.isfinite(column.values)
    c, v = command.values[rows], column.values[rows]
    if len(np.unique(c)) < 3:
        return bool(len(c)) and bool(np.all(c == v))
    slope, level = np.polyfit(c, v, 1)
    return bool(slope) and bool(np.max(np.abs(v - slope * c - level)) <= COPY_SHARE * np.ptp(v))


def _ask_what_is_left(
    table: ForeignTable, known: Mapping[str, Column], names: Sequence[str], taken: Mapping[str, str]
) -> None:
    """Ask where a column that is left over follows the commands too.

    Raises:
        Question: there is one.
    """
    command = known[taken["command"]]
    left = [
        name
        for name in names
        if name not in taken.values() and follows(command, known[name]) and not _repeats(command, known[name])
    ]
    if left:
        answers = [choice({"value": name}, known) for name in (taken["value"], *left)]
        # The column left over may be what was commanded.
        answers += [choice({"command": name, "value": taken["value"]}, known) for name in left]
        raise table.ask("reading-left", answers=answers, value=taken["value"], left=left)


def _ask_small(table: ForeignTable, command: Column, value: Column, known: Mapping[str, Column]) -> None:
    """Ask where readings in the unit of the commands are too small and too loose to be positions.

    Raises:
        Question: they are.
    """
    units = command.unit, value.unit
    factor = value.unit and command.unit and value.unit.in_units_of(command.unit)
    rows = np.isfinite(command.values) & np.isfinite(value.values)
    if not factor or units[0].kind not in ("length", "angle") or rows.sum() < 4:  # type: ignore[union-attr]
        return
    c, v = command.values[rows], factor * value.values[rows]
    span = np.ptp(v)
    if not 0 < span < SMALL_SHARE * np.ptp(c):
        return
    slope, level = np.polyfit(c, v, 1)
    if np.std(v - slope * c - level) > LOOSE_SHARE * span:
        name = value.name.text
        found = (
            f"readings in column {escaped(name)} that span {span:.3g} {units[0].name} over {np.ptp(c):.6g} of commands"  # type: ignore[union-attr]
        )
        candidates = [_meaning(known, name, option) for option in (DEVIATIONS, POSITIONS)]
        raise ask_column(table, found, candidates, "deviations")
