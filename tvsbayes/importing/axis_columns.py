"""Which column of an axis' table is the command, the reading, its uncertainty, the clock.

Words in the names propose; the numbers decide whether there is a question: a column that is left over and follows the
commands as well as the one taken, a reading that is only a deviation, two clocks that differ.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from tvsbayes.errors import Candidate, escaped
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.asking import listed, refused
from tvsbayes.importing.cells import FieldCells, homings_of
from tvsbayes.importing.clock import equal_clocks, relative_times
from tvsbayes.importing.columns import (
    Chooser,
    Column,
    Understood,
    ask_of_t,
    asked_of_dial,
    factor_between,
    fill_values,
    line_through,
    restarts,
)
from tvsbayes.importing.counters import are_moves
from tvsbayes.importing.runs import FOLLOWS_R2, counts_rows
from tvsbayes.importing.table import ForeignTable
from tvsbayes.importing.words import means, place_of, words_of

FIELDS = ("command", "value", "u", "status", "segment", "time_s", "approach", "temperature_degC", "moving")
"""All fields of a table of an axis."""
COPY_SLOPE = 1e-6
"""Largest deviation of the slope from that of the units of a column that repeats another."""
COPY_SHARE = 1e-9
"""Largest deviation from a line, as a share of the span, of a column that repeats another."""
STEADY_SHARE, STEP_TOLERANCE = 0.7, 0.2
"""Share of steps in proportion to those of the commands, to this tolerance, in a column that wraps or jumps."""
SMALL_SHARE, LOOSE_SHARE = 0.05, 0.02
"""Readings in the unit of the commands are not positions if they span less than the first share of the commands' range
and scatter by more than the second share of their own span about a line."""
TURN_SHARE = 0.05
"""Largest difference of angles from their commands but for whole turns, turns."""
ROUND_RATIO = 1.3
"""Least ratio of the numbers of different commands and readings at which they may be exchanged."""
STOPPED_SHARE = 0.2
"""Least share of rows of either kind in a column of speeds that says where the axis moves."""
MACHINES_MAX, MACHINE_ROWS = 8, 3
"""Largest number of axes or readers in a table, and fewest rows of each."""
SIDE_ROWS = 3
"""Fewest rows of either direction that show what its word means."""
STRAY_ROWS, STRAY_R2 = 6, 0.5
"""Least number of readings, and largest squared correlation with the commands, of readings that go their own way."""
DEVIATIONS, POSITIONS = "--deviations", "--positions"
"""Options that say what the readings are."""
_MEANING = {DEVIATIONS: "actual less commanded position", POSITIONS: "positions"}
ORDERED = {"repeats": "readings of each stop", "forward": "runs, all rising", "alternate": "runs, rising and falling"}
"""Columns alike but for a number, by values of --runs."""
NO_READING = "; or is a column actual less commanded position: --column value=NAME --deviations"


def axis_columns(
    table: ForeignTable, stated: Mapping[str, str], deviations: bool | None = None, *, settled: bool = False
) -> Understood:
    """The columns of an axis' table by field.

    Args:
        table: a table with a row for each reading or move.
        stated: column by field, as the user states it; "" where the table has no such column.
        deviations: whether the readings are actual less commanded position; None where nobody says it.
        settled: whether the user says how readings follow the commands.

    Raises:
        Question: two columns could be one field.
        InputError: a field or column that does not exist, or no column for a command or a reading.
    """
    chooser = Chooser.of(table, stated, FIELDS, _role)
    if "command" not in stated and chooser.roles.get("command") and "command" in chooser.known:
        # Beside a set point an output of the controller that never changes is none.
        if not chooser.known["command"].numeric:
            del chooser.taken["command"]
    numbers = chooser.of_role("command", "value", "position", "")
    _take_volts(chooser, numbers)
    if len(numbers) < 2:
        # A column that counts the rows is no number of theirs, unless little else is there.
        chooser.roles.setdefault("", []).extend(chooser.of_role("index"))
    _take_command(chooser)
    chooser.roles = {role: _of_device(chooser, names) for role, names in chooser.roles.items()}
    _take_value(chooser, deviations)
    _ask_which_is_round(chooser)
    _take_others(chooser)
    if not settled and not {"command", "value"} & stated.keys():
        _ask_whether_it_follows(chooser)
    _refuse_several(chooser)
    return chooser.understood()


def _take_volts(chooser: Chooser, numbers: Sequence[str]) -> None:
    """Take command and reading where the only numbers are positions and volts: a sensor's, or a drive's."""
    known, roles = chooser.known, chooser.roles
    volts = [n for n in chooser.of_role("aside") if (u := known[n].name.unit) and u.kind == "voltage"]
    if len(numbers) != 1 or len(volts) != 1 or {"command", "value"} & chooser.taken.keys():
        return
    ways = {"value": (volts[0], numbers[0]), "command": (numbers[0], volts[0])}
    ways = {role: pair for role, pair in ways.items() if numbers[0] in roles.get(role, ())} or ways
    columns = [dict(zip(("command", "value"), pair, strict=True)) for pair in ways.values()]
    if len(columns) > 1:
        raise chooser.ask(f"positions and volts ({listed([*numbers, *volts])})", list(map(chooser.answer, columns)))
    chooser.taken |= columns[0]


def _role(column: Column) -> str:
    """What a column may hold, by its name and the form of its cells; "" where the name says nothing."""
    name, unit = column.name, column.name.unit
    kind = unit.kind if unit else ""
    if name.has("temperature") or kind == "temperature":
        return "temperature_degC" if bool(np.isfinite(column.values).any()) else "aside"
    if name.has("speed") and column.numeric and STOPPED_SHARE <= np.mean(column.values == 0) <= 1 - STOPPED_SHARE:
        return "speed"
    if name.has("status", "excluded") and not kind and not column.numeric and not name.has("command", "value"):
        return "status"
    is_current = name.place("aside") is not None and name.place("aside") == name.place("value")
    if (name.has("aside") and not is_current) or kind in ("other", "voltage"):
        return "aside"
    if kind == "time" or (name.is_time and not kind):
        return "time_s"
    if name.is_u:
        return "u"
    if name.has("deviation"):
        return "deviation"
    if name.has("excluded") and not kind:
        return "aside"
    for role in ("moving", "resting", "status", "approach"):
        measured = column.numeric and (name.has("command", "value") or not column.whole)
        if name.has(role) and not kind and not measured:
            return role
    if name.has("segment") and not kind and column.counts_homings:
        return "segment"
    if name.has("repeat", "index") and not kind and column.whole and not name.has("command", "value"):
        return "aside"
    if _states_sides(column):
        return "approach"
    command, value = name.place("command"), name.place("value")
    if command is not None and value is not None and _is_difference(name.text):
        return "deviation"
    if (column.numeric or column.has_digits) and (command is not None or value is not None):
        is_number = value is not None and name.place("number") == value
        return "command" if value is None or (command is not None and (command < value or is_number)) else "value"
    if not name.has("command", "value", "position") and not kind and counts_rows(column.cells):
        return "index"
    if name.has("increment") and column.numeric and not name.has("statistic"):
        return "command"
    if not column.numeric and not (column.has_digits and name.has("command", "value", "position")):
        return "aside"
    if name.has("statistic") and not name.has("position"):
        return "mean" if place_of(name.words, "mean") is not None else "aside"
    return "position" if name.has("position") or (unit is not None and not name.words) else ""


def _is_difference(text: str) -> bool:
    """Whether a name is a command less a reading, or a reading less a command: "Soll-Ist", "cmd-meas"."""
    left, sign, right = re.sub("[\u2212\u2013]", "-", text).partition("-")
    sides = [{c for c in ("command", "value") if place_of(words_of(part), c) is not None} for part in (left, right)]
    return bool(sign) and sides in ([{"command"}, {"value"}], [{"value"}, {"command"}])


def _states_sides(column: Column) -> bool:
    """Whether the cells of a column are words of direction, whatever its name."""
    words = {cell for cell in column.cells if cell} - {"in"}
    sides = ("forward", "backward", "clockwise", "counterclockwise")
    return (
        bool(words)
        and len(words) <= 3
        and all(any(means(word, side) for side in sides) and not NUMBER.fullmatch(word) for word in words)
    )


def _of_device(chooser: Chooser, names: list[str], command: str = "") -> list[str]:
    """Of several columns of one role the one with the number of the command's, as "pos (5)" beside "target (5)"."""
    numbers = chooser.known[command or chooser.taken["command"]].name.numbers
    of_each = [chooser.known[name].name.numbers for name in names]
    same = [name for name, own in zip(names, of_each, strict=True) if numbers and own == numbers]
    return same if len(same) == 1 and all(of_each) else names


def _take_others(chooser: Chooser) -> None:
    """Take segment, approach, status, temperature, motion, u and time."""
    known, remarks = chooser.known, chooser.remarks
    for name in ("segment", "approach", "status"):
        chooser.take(name)
    chooser.take("approach", _by_steps(chooser))
    temperatures = chooser.roles.get("temperature_degC", [])
    if len(temperatures) > 1 and chooser.is_open("temperature_degC"):
        remarks.append(f"temperature: none of {listed(temperatures)}; --column temperature_degC=NAME takes one")
    for name, roles in (
        ("temperature_degC", ("temperature_degC",)),
        ("moving", ("moving", "resting")),
        ("moving", ("speed",)),
    ):
        if len(names := chooser.of_role(*roles)) == 1:
            chooser.take(name, names)
    spreads = [name for name in chooser.of_role("u") if np.isfinite(known[name].values).any()]
    standard = [name for name in spreads if known[name].name.coverage is None]
    spreads = standard if len(standard) == 1 else spreads
    if len(spreads) == 1 and chooser.is_open("u") and np.nanmin(known[spreads[0]].values) < 0:
        remarks.append(f"column {escaped(spreads[0])} has negative numbers, so it is no uncertainty; set aside")
    else:
        chooser.take("u", spreads, what="of uncertainties")
    clocks = chooser.roles.get("time_s", [])
    if len(clocks) > 1 and chooser.is_open("time_s"):
        # Of several clocks that agree the first.
        times = {n: relative_times(known[n].cells, known[n].values, known[n].name.unit) for n in clocks}
        usable = {name: time for name, time in times.items() if time is not None}
        first = next(iter(usable.values()), np.zeros(1))
        if len(usable) == 1 or (usable and all(equal_clocks(first, time) for time in usable.values())):
            clocks = list(usable)[:1]
    else:
        ask_of_t(chooser)
    chooser.take("time_s", clocks, what="that could be the clock")


def _by_steps(chooser: Chooser) -> list[str]:
    """Columns of two words, one where the commands rise and one where they fall: sides in a language of nobody."""
    steps, found = np.diff(chooser.known[chooser.taken["command"]].values), list[str]()
    for text in chooser.understood().unused:
        words = {*chooser.known[text].cells}
        if len(words) == 2 and not any(map(NUMBER.fullmatch, words)):
            cells = np.array(chooser.known[text].cells[1:])
            ways = [np.sign(steps[(cells == word) & (steps != 0)]) for word in words]
            if min(map(len, ways)) >= SIDE_ROWS and sorted(map(set, ways), key=min) == [{-1.0}, {1.0}]:
                found.append(text)
    return found


def _ask_which_is_round(chooser: Chooser) -> None:
    """Ask where a column that no word calls the command scatters, and the readings come again to the last digit."""
    command, value = (chooser.known[chooser.taken[name]] for name in ("command", "value"))
    if command.name.text in chooser.roles.get("command", ()) or {"command", "value"} & chooser.stated.keys():
        return
    c, v = _in_both(command, value)
    if len(c) >= STRAY_ROWS and len(np.unique(c)) > ROUND_RATIO * len(np.unique(v)):
        ours, others = escaped(value.name.text), escaped(command.name.text)
        found = f"numbers in column {ours} that come again, and others in {others}"
        pairs = ((command.name.text, value.name.text), (value.name.text, command.name.text))
        answers = [chooser.answer({"command": a, "value": b}) for a, b in pairs]
        raise chooser.ask(f"{found} that do not", answers)


def _ask_whether_it_follows(chooser: Chooser) -> None:
    """Ask where the reading goes its own way: signs in another column, an encoder of another axis."""
    names = {name: chooser.taken[name] for name in ("command", "value")}
    command, value = (chooser.known[text] for text in names.values())
    c, v = _in_both(command, value)
    if len(c) < STRAY_ROWS or len(np.unique(c)) < 3 or np.ptp(v) == 0 or follows(command, value) or fill_values(c, v):
        return
    if all(column.unit is not None and column.unit.kind == "angle" for column in (command, value)):
        # Both may restart after a turn.
        turns = [column.values * column.unit.scale * column.unit.per_number / 360 for column in (command, value)]  # type: ignore[union-attr]
        gap = turns[1] - turns[0]
        if np.nanmax(np.abs(gap - np.round(gap))) < TURN_SHARE:
            return
    if np.corrcoef(c, v)[0, 1] ** 2 < STRAY_R2:
        found = f"readings in column {escaped(names['value'])} that do not follow column {escaped(names['command'])}"
        homed = homings_of(FieldCells(chooser.table, chooser.taken), silent=True)
        read = [None if np.isnan(v) else float(v) for v in value.values]
        if np.isfinite(command.values).all() and are_moves(command.values.tolist(), read, homed):
            raise chooser.table.ask("moves-or-positions", column=names["command"], field="command")
        if len(jumps := restarts(c, v)):
            raise asked_of_dial(jumps, value.unit)
        raise chooser.ask(found, [chooser.answer(names), chooser.answer(names, DEVIATIONS)])


def _refuse_several(chooser: Chooser) -> None:
    """Refuse rows of several axes or readers, or of one in several states: a column that names them."""
    for text, column in chooser.known.items():
        names = dict.fromkeys(filter(None, column.cells))
        few = 1 < len(names) <= MACHINES_MAX and min(map(column.cells.count, names)) >= MACHINE_ROWS
        if not few or text in (chooser.taken.get(field) for field in FIELDS if field != "status"):
            continue
        # "ok" and "lost" are no states of a machine; commands of another axis, "Joint 2 demand", name none.
        of_rows = any(means(name, concept) for name in names for concept in ("good", "bad"))
        of_numbers = column.unit is not None and column.unit.kind != "other"
        named = place_of(column.name.words, "machine") is not None
        named &= not column.name.has("command", "value", "position")
        stated = all(place_of(words_of(name), "condition") is not None for name in names)
        if stated or (named and not of_numbers and not (of_rows and text == chooser.taken.get("status"))):
            where = f"in column {escaped(text)}"
            line = chooser.table.first_line
            raise refused("several-machines", chooser.table.file, line=line, where=where, machines=list(names))


def _take_command(chooser: Chooser) -> None:
    """Take the column of the commands."""
    taken, roles = chooser.taken, chooser.roles
    if "command" in taken:
        return
    strong, weak, others = (roles.get(role, []) for role in ("command", "position", ""))
    readings = roles.get("value", []) or ([taken["value"]] if "value" in taken else [])
    counting = [name for name in strong if counts_rows(chooser.known[name].cells)]
    if len(strong) > len(counting) or (readings and weak):
        # "step" 1, 2, 3 ... beside "goto" or a position.
        strong = [name for name in strong if name not in counting]
    pool = strong or weak or others
    if len(strong) > 1:
        found = f"{len(strong)} columns that could be the command ({listed(strong)})"
        raise chooser.ask(found, [_pair(chooser, name) for name in strong])
    alone = len(weak) + len(others) == 1 == len(roles.get("deviation", ()))
    if len(pool) == 1 and (strong or readings or alone):
        taken["command"] = pool[0]
        if readings and not strong and not weak:
            only = f"column {escaped(pool[0])}, the only other one of numbers"
            chooser.remarks.append(f"command: {only}; --column command= says another")
        return
    if len(weak) == 1 and len(others) > 1 and all(follows(chooser.known[weak[0]], chooser.known[n]) for n in others):
        taken["command"] = weak[0]
        return
    pool = [*weak, *others, *([] if len(readings) < 2 else readings)]
    if not pool or (not readings and len(pool) < 2):
        raise chooser.missing(["command", *(["value"] if not readings else [])], "" if readings else NO_READING)
    found = f"no column that is surely the command; numbers are in {listed([*pool, *readings])}"
    raise chooser.ask(found, [_pair(chooser, name) for name in pool])


def _pair(chooser: Chooser, command: str) -> Candidate:
    """The answer that names a command, and the reading where one is left."""
    of_value, *others = ([n for n in chooser.roles.get(role, ()) if n != command] for role in ("value", "position", ""))
    best = _of_device(chooser, of_value, command) or [name for names in others for name in names]
    reads = {"value": best[0]} if "value" not in chooser.taken and len(best) == 1 else {}
    return chooser.answer({"command": command, **reads})


def _take_value(chooser: Chooser, deviations: bool | None) -> None:
    """Take the column of the readings, and set columns of deviations aside that follow from it."""
    known, taken = chooser.known, chooser.taken
    command, differences = known[taken["command"]], chooser.roles.get("deviation", [])
    strong, weak, others = (chooser.of_role(role) for role in ("value", "position", ""))
    if deviations and "value" not in taken and (pool := differences or strong or weak or others):
        if len(pool) > 1:
            found = f"{len(pool)} columns that could be the deviation ({listed(pool)})"
            raise chooser.ask(found, [chooser.answer({"value": name}, DEVIATIONS) for name in pool])
        taken["value"] = pool[0]
        return
    if "value" in taken:
        if "value" not in chooser.stated:
            _set_aside(chooser, differences)
        return
    following = [name for name in others if follows(command, known[name])]
    own = [name for name in (*weak, *following) if not _repeats(command, known[name])]
    means = [name for name in chooser.of_role("mean") if follows(command, known[name])]
    counted = [name for name in chooser.of_role("command") if follows(command, known[name])]
    pools = (strong, [n for n in weak if n in own], [n for n in following if n in own], weak, following, means, counted)
    pool = next(filter(None, pools), [])
    if len(pool) > 1:
        found = f"{len(pool)} columns that could be the reading ({listed(pool)})"
        skeletons = {tuple(word for word in known[name].name.words if not word.isdigit()) for name in pool}
        first = {name: known[name].first for name in pool}
        runs = [Candidate(meaning, ("--runs", order), first) for order, meaning in ORDERED.items()]
        answers = [chooser.answer({"value": n}, DEVIATIONS) for n in differences if known[n].numeric]
        answers = [*(chooser.answer({"value": name}) for name in pool), *answers]
        are_runs = len(skeletons) == 1 and all(known[name].name.numbers for name in pool)
        are_runs = are_runs or all(follows(command, known[name]) for name in pool)
        raise chooser.ask(found, [*answers[:3], *runs] if are_runs else answers)
    if pool:
        (name,) = pool
        taken["value"] = name
        if name in following:
            only = f"column {escaped(name)}, the only other following the commands"
            chooser.remarks.append(f"value: {only}; --column value= changes it")
        unexplained = _set_aside(chooser, differences)
        if unexplained and (not strong or not follows(command, known[name])):
            found = f"column {escaped(name)} beside column {escaped(unexplained[0])}, which is not their difference"
            answers = [chooser.answer({"value": n}, DEVIATIONS) for n in unexplained]
            raise chooser.ask(found, [chooser.answer({"value": name}), *answers])
        _ask_what_is_left(chooser, [*strong, *weak, *others])
        if deviations is None:
            _ask_small(chooser, command, known[name])
    elif deviations is False and len(differences) == 1:
        taken["value"] = differences[0]
    elif differences:
        found = f"no reading but {listed(differences)}, by its name a deviation"
        answers = [_meaning(known[name], option) for option in _MEANING for name in differences]
        answers += [_turned(known[name]) for name in differences]
        raise chooser.ask(found, answers, "deviations")
    elif rest := [*weak, *others, *chooser.of_role("u")]:
        found = f"no column that is surely the reading; numbers are in {listed(rest)}"
        answers = [chooser.answer({"value": name}, *extra) for name in rest for extra in ((), (DEVIATIONS,))]
        raise chooser.ask(found, answers)
    else:
        raise chooser.missing(["value"], NO_READING)


def _meaning(column: Column, option: str) -> Candidate:
    """The answer that a column holds deviations or positions; columns of runs are known by their names again."""
    name, first = column.name.text, column.first
    return Candidate(f"{escaped(name)} ({', '.join(first)}) holds {_MEANING[option]}", (option,), {name: first})


def _turned(column: Column) -> Candidate:
    """The answer that a column holds deviations of the other sign."""
    name, words = column.name.text, (DEVIATIONS, "--assume", "deviation_sign=-1")
    return Candidate(f"{escaped(name)} holds commanded less actual position", words, {name: column.first})


def _set_aside(chooser: Chooser, names: Sequence[str]) -> list[str]:
    """Name columns that are the reading less the command; return those that are not."""
    known, taken, unexplained = chooser.known, chooser.taken, list[str]()
    for name in [*names, *([taken["u"]] if "u" in taken else [])]:
        if formula := difference(known[name], known[taken["command"]], known[taken["value"]]):
            said = f"column {escaped(name)} is {formula} in every row: a deviation, no uncertainty; set aside"
            chooser.remarks.append(said)
            if taken.get("u") == name:
                del taken["u"]
        elif name in names and known[name].numeric:
            unexplained.append(name)
    return unexplained


def difference(column: Column, command: Column, value: Column) -> str:
    """The formula by which a column is the reading less the command in every row, to its digits; "" where it is not."""
    to_reading, to_column = factor_between(command.unit, value.unit), factor_between(value.unit, column.unit)
    if to_reading is None or to_column is None:
        return ""
    gap = (value.values - to_reading * command.values) * to_column
    rows = np.isfinite(gap) & np.isfinite(column.values)
    if rows.sum() < 3 or not np.any(column.values[rows]):
        return ""
    # The written digits of the difference, of the reading and of the command, in the unit of the difference.
    tolerance = _half_digit(column) + to_column * (_half_digit(value) + to_reading * _half_digit(command)) + 1e-12
    if np.max(np.abs(column.values[rows])) <= tolerance:
        return ""
    a, b = escaped(value.name.text), escaped(command.name.text)
    forms = {f"{a} - {b}": gap, f"{b} - {a}": -gap, f"|{a} - {b}|": np.abs(gap)}
    fits = (text for text, numbers in forms.items() if np.all(np.abs(numbers - column.values)[rows] <= tolerance))
    return next(fits, "")


def _half_digit(column: Column) -> float:
    """Half of the last digit of a column's written numbers."""
    written = (cell.lower().partition("e") for cell in column.cells if NUMBER.fullmatch(cell))
    places = [len(mantissa.partition(".")[2]) - int(exponent or 0) for mantissa, _, exponent in written]
    return 0.5000001 * 10.0 ** -max(places, default=0)


def _in_both(command: Column, column: Column) -> tuple[np.ndarray, np.ndarray]:
    rows = np.isfinite(command.values) & np.isfinite(column.values)
    return command.values[rows], column.values[rows]


def follows(command: Column, column: Column) -> bool:
    """Whether a column follows the commands: near a line over them, or by steps in proportion to theirs."""
    c, v = _in_both(command, column)
    if len(np.unique(c)) < 3 or np.ptp(v) == 0:
        return False
    # Squares of a damaged number, 1e308, are no floats.
    c, v = (values / np.abs(values).max() for values in (c, v))
    if np.corrcoef(c, v)[0, 1] ** 2 >= FOLLOWS_R2:
        return True
    dc, dv = np.diff(c), np.diff(v)
    moved = dc != 0
    slope = np.median(dv[moved] / dc[moved])
    steady = np.abs(dv - slope * dc)[moved] <= STEP_TOLERANCE * np.abs(slope * dc)[moved]
    return bool(slope != 0 and moved.sum() > 2 and steady.mean() >= STEADY_SHARE)


def _repeats(command: Column, column: Column) -> bool:
    """Whether a column is the command again, in the same or another unit."""
    c, v = _in_both(command, column)
    if len(np.unique(c)) < 3:
        return bool(len(c)) and bool(np.all(c == v))
    slope, off = line_through(c, v)
    factor = factor_between(command.unit, column.unit) if command.unit and column.unit else None
    if factor is not None and abs(slope / factor - 1.0) > COPY_SLOPE:
        return False
    return bool(slope) and bool(np.max(np.abs(off)) <= COPY_SHARE * np.ptp(v))


def _ask_what_is_left(chooser: Chooser, names: Sequence[str]) -> None:
    """Ask where a column that is left over follows the commands too."""
    taken, known = chooser.taken, chooser.known
    command, left = known[taken["command"]], [name for name in names if name not in taken.values()]
    left = [name for name in left if follows(command, known[name]) and not _repeats(command, known[name])]
    if left:
        answers = [chooser.answer({"value": name}) for name in (taken["value"], *left)]
        # The column left over may be what was commanded.
        answers += [chooser.answer({"command": name, "value": taken["value"]}) for name in left]
        raise chooser.table.ask("reading-left", answers=answers, value=taken["value"], left=left)


def _ask_small(chooser: Chooser, command: Column, value: Column) -> None:
    """Ask where readings in the unit of the commands are too small and too loose to be positions."""
    unit, (c, v) = command.unit, _in_both(command, value)
    factor = value.unit.in_units_of(unit) if value.unit and unit and unit.kind in ("length", "angle") else None
    if not factor or unit is None or len(c) < 4:
        return
    v = factor * v
    span = np.ptp(v)
    if 0 < span < SMALL_SHARE * np.ptp(c) and np.std(line_through(c, v)[1]) > LOOSE_SHARE * span:
        found = f"readings in column {escaped(value.name.text)} that span {span:.3g} {unit.name} over {np.ptp(c):.6g}"
        answers = [_meaning(value, option) for option in _MEANING]
        raise chooser.ask(f"{found} of commands", answers, "deviations")
