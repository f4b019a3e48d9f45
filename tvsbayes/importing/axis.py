"""Moves and readings of an axis from a foreign table: one row is a move, a reading, or both.

Successive rows at the same command are readings of one stop; rows without a value are moves without a reading. A column
of directions gives the side of approach of a stop; where the rows before lead to another side, the missing move is
inserted and marked. Assumptions about what the table does not state are listed in words. Everything ends in plain rows
by the names of `moves.csv`, `readings.csv` and `campaign.toml`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import fmean, median
from typing import Any

import numpy as np

from tvsbayes.errors import escaped, plural
from tvsbayes.importing.asking import asked, refused
from tvsbayes.importing.axis_columns import FIELDS, axis_columns
from tvsbayes.importing.axis_units import (
    NUMBER_MAX,
    in_one_unit,
    is_expanded,
    rounded,
    shown_units,
    stated_unit,
    units_of,
)
from tvsbayes.importing.cells import FieldCells, Wishes, homings_of, say_left_out, status_of, temperatures_of
from tvsbayes.importing.clock import seconds_of, stamp_of
from tvsbayes.importing.columns import (
    Understood,
    asked_of_dial,
    restarts,
    table_document,
    table_lines,
)
from tvsbayes.importing.counters import are_moves, summed_up
from tvsbayes.importing.runs import long_table
from tvsbayes.importing.table import ForeignTable
from tvsbayes.importing.usable_rows import good_rows, resting_rows, without_fills, without_strays
from tvsbayes.importing.words import Unit, means, name_of, parse_unit, place_of, plain, words_of
from tvsbayes.statistics.wrapped import turn_jumps

TURN_TOLERANCE = 0.1
"""Largest deviation of a jump from whole turns by play and errors of gears, turns."""
JUMP_SDS = 6.0
"""Largest deviation of a jump from a power of two, in typical deviations of steps from the line, plus two counts."""
TURNS_USUAL = (360.0, 400.0, 1000.0, 1024.0, 2000.0, 2048.0, 2500.0, 3600.0, 4000.0, 4096.0, 8192.0, 10000.0)
"""Counts of a turn of usual encoders."""
BITS = range(8, 33)
"""Exponents of encoders that count modulo a power of two."""
OVERSHOOT_SHARE = 0.05
"""Assumed overshoot of an inserted move beyond a stop, as a share of the range of commands: more than any play."""
LOG_RATIO = 10.0
"""Least logarithm of a likelihood ratio by which readings say that the axis stood still."""
GAPS_MIN = 3
"""Least number of commands, but those where the axis turns, at which both sides were read."""
CONTRARY_MIN = 4
"""Least number of rows with a direction opposite to their commands', in all such rows, at which the sign is refused."""
SCALES = ("length", "angle")
"""Kinds of units in which commands are target positions."""
STATED_SHARE = 0.6
"""Least mean sign of the steps at which a single word stands for their direction."""
EXPANDED_IS_COMMON = (
    "u: an expanded uncertainty is one error that all readings share, as a certificate's is, not noise of each; "
    "campaign.toml says otherwise without u_is"
)
STALE_MIN = 4
"""Least number of moves of an export of two series, whose rows repeat the last reading."""
SEAM_GAPS = 3.0
"""Least size of the part of a circle that commands leave out, in median distances of commands."""


@dataclass(frozen=True)
class AxisRows:
    """An axis folder as plain rows.

    Attributes:
        moves: rows of `moves.csv` by column.
        readings: rows of `readings.csv` by column.
        unit: unit of the readings, where the file states one or it follows.
        assumed: assumptions in words, with the option that overrides them, if any.
        notes: remarks on rows used and left out.
        header: entries of `campaign.toml` outside `[axis]`.
        axis: entries of `[axis]`.
        reference: entries of `[reference]`.
        lines: the columns as understood, for people.
        document: the same for programs.
    """

    moves: list[dict[str, Any]]
    readings: list[dict[str, Any]]
    unit: str | None
    assumed: tuple[str, ...]
    notes: tuple[str, ...] = ()
    header: Mapping[str, Any] = field(default_factory=dict)
    axis: Mapping[str, Any] = field(default_factory=dict)
    reference: Mapping[str, Any] = field(default_factory=dict)
    lines: tuple[str, ...] = ()
    document: Mapping[str, Any] = field(default_factory=dict)


def axis_rows(table: ForeignTable, wishes: Wishes, folder_unit: str | None = None) -> AxisRows:
    """Derive an axis folder from a table.

    Args:
        table: the foreign table.
        wishes: what the user states about it.
        folder_unit: unit of readings that the folder states already.

    Raises:
        Question: the table can be read in several ways.
        InputError: a cell is not a value of its field, or the table has no row or lacks a column.
    """
    table.require_rows()
    wishes = wishes.named_in(table)
    runs = long_table(table, wishes.columns, wishes.order)
    settled = wishes.deviations is not None or wishes.relative or wishes.counts_per_turn is not None
    known = axis_columns(runs.table, runs.stated, wishes.deviations, settled=settled)
    cells = FieldCells(runs.table, known.columns, wishes, [*runs.remarks, *known.remarks])
    for step in (_summed, good_rows, without_fills, resting_rows, without_strays):
        cells = step(cells)
    as_written = cells.table
    cells, written = cells.with_plain("command", "value", "u")
    units = units_of(cells, written)
    commands, read, homings = _checked_numbers(cells, units["command"])
    values, stated_u, unit = in_one_unit(cells, commands, read, units)
    times_s = seconds_of(cells, stated_unit(cells, "time_s"))
    homings_of(cells)
    moves, move_of_row, said = _moves_of(cells, commands, values, times_s, homings)
    readings = _readings_of(cells, values, stated_u, move_of_row)
    cells.assumed.extend(said)
    unread = sum(v is None and means(s, "good") for v, s in zip(values, cells.text("status"), strict=True))
    if unread:
        cells.assumed.append(f"status: {plural(unread, 'row')} called good without a reading: moves alone")
    if "u" not in cells:
        cells.assumed.append("u: none, so that the scatter of stops covers the readings' own")
    readings, wrapped = unwrapped(moves, readings, folder_unit or unit, wishes.counts_per_turn)
    cells.assumed.extend([*wrapped, *([EXPANDED_IS_COMMON] if is_expanded(cells) else [])])
    shown = Understood(dict(cells.columns), tuple(dict.fromkeys((*known.unused, *runs.unused))))
    of_commands, created = units["command"], stamp_of(cells.text("time_s")[0])
    return AxisRows(
        moves,
        readings,
        unit,
        tuple(cells.assumed),
        header={} if created is None else {"created": created},
        axis={"command_unit": of_commands.text} if of_commands is not None and of_commands.kind in SCALES else {},
        reference={"u_is": "common"} if is_expanded(cells) else {},
        lines=tuple(table_lines(as_written, shown, FIELDS, shown_units(units, unit, cells))),
        document=table_document(as_written, shown),
    )


def _summed(cells: FieldCells) -> FieldCells:
    """The cells with positions in place of moves, from 0 at every homing, where the user says so."""
    if not cells.wishes.relative:
        return cells
    plain, written = cells.with_plain("command", silent=True)
    moves = [move or 0.0 for move in plain.numbers("command", -NUMBER_MAX, NUMBER_MAX)]
    unit = written["command"]
    cells.assumed.append("command: summed up, because --relative says that each is the length of its move")
    positions = map(repr, summed_up(moves, homings_of(cells, silent=True)))
    return cells.with_texts("command", [f"{at} {unit.name}" if unit else at for at in positions])


def _checked_numbers(cells: FieldCells, unit: Unit | None) -> tuple[list[float], list[float | None], list[bool]]:
    """Commands, readings, and whether the axis homed before each row; asks where commands may be no positions."""
    wishes, table = cells.wishes, cells.table
    commands = [command or 0.0 for command in cells.numbers("command", -NUMBER_MAX, NUMBER_MAX)]
    read = cells.numbers("value", -NUMBER_MAX, NUMBER_MAX, optional=True)
    homings = homings_of(cells, silent=True)
    command, value = (name_of(cells.columns[name]) for name in ("command", "value"))
    if "value" not in wishes.columns and value.has("increment"):
        raise refused("moved-readings", table.file, line=table.first_line, name=value.text)
    stale = _stale(commands, read)
    if stale.any():
        read = [None if old else number for number, old in zip(read, stale, strict=True)]
        how = "as an export of two series does: moves alone"
        cells.assumed.append(f"value: {stale.sum()} rows repeat the reading before a move, {how}")
    commands = _through_the_seam(cells, commands, unit)
    if not wishes.relative and "command" not in wishes.columns:
        if command.has("increment") or are_moves(commands, read, homings):
            raise table.ask("moves-or-positions", column=command.text, field="command")
    return commands, read, homings


def _readings_of(
    cells: FieldCells, values: Sequence[float | None], stated_u: Sequence[float], move_of_row: Sequence[int]
) -> list[dict[str, Any]]:
    """Rows of `readings.csv`: of all rows with a value or a bad status."""
    readings, statuses = list[dict[str, Any]](), cells.text("status")
    for row, value in enumerate(values):
        if value is not None or (statuses[row] and not means(statuses[row], "good")):
            status = status_of(cells, row, {"value": value}, "reading")
            reading = {"reading": len(readings), "move": move_of_row[row], "value": value}
            readings.append({**reading, "u": stated_u[row], "status": status})
    say_left_out(cells, statuses, "reading")
    return readings


def _stale(commands: Sequence[float], read: Sequence[float | None]) -> np.ndarray:
    """Rows that repeat the reading before, where all rows of a new command do: two series joined row by row."""
    command = np.array(commands)
    value = np.array([np.nan if v is None else v for v in read])
    moved, same = np.diff(command) != 0, value[1:] == value[:-1]
    stale = np.r_[False, moved & same]
    staircase = moved.sum() >= STALE_MIN and np.all((same | np.isnan(value[:-1]))[moved]) and not same[~moved].all()
    return stale if staircase else np.zeros(len(command), bool)


def _through_the_seam(cells: FieldCells, commands: list[float], unit: Unit | None) -> list[float]:
    """Commands of an angle that go on through a whole turn, where the user says so.

    Raises:
        Question: they jump across the seam, and the part of the circle that they leave out lies elsewhere.
    """
    turn = cells.wishes.command_turn
    left = [parse_unit(text) for text in cells.table.columns if text not in cells.columns.values()]
    counted = any(of is not None and of.name == "turn" for of in left)
    if turn is None and (unit.kind == "angle" if unit else counted):
        period = 360.0 / (unit.scale * unit.per_number) if unit else 360.0
        places = np.unique(np.mod(commands, period))
        gaps = np.diff(np.r_[places, places[0] + period])
        jumps = np.flatnonzero(np.abs(np.diff(commands)) > 0.5 * period)
        # Across the largest gap the commands never go, so a jump that is not across it goes the short way.
        low, high = np.sort([commands[jumps[0]], commands[jumps[0] + 1]]) if len(jumps) else (0.0, 0.0)
        middle, gap = places[np.argmax(gaps)] + 0.5 * gaps.max(), gaps.max()
        inside = low < middle < high or low < middle - period < high
        seam = len(places) > 3 and gap > SEAM_GAPS * np.median(gaps) and inside
        if len(jumps) and (seam or counted):
            said = {"before": commands[jumps[0]], "after": commands[jumps[0] + 1], "period": period}
            raise cells.table.ask("seam", unit=unit.name if unit else "deg", **said)
    if not turn:
        return commands
    cells.assumed.append(f"command: whole turns of {turn:g} added, because --assume command_turn says so")
    return [rounded(c) for c in np.unwrap(commands, period=turn)]


# --- moves -----------------------------------------------------------------------------------------------------------
def _moves_of(
    cells: FieldCells,
    commands: Sequence[float],
    values: Sequence[float | None],
    times: Sequence[float] | None,
    homings: Sequence[bool],
) -> tuple[list[dict[str, Any]], list[int], list[str]]:
    """Moves, also those implied by a column of directions, the move of each row, and what is to be said of them.

    Times are those of the table, else the number of the move.
    """
    if times is None:
        cells.assumed.append("time_s: no column, so 0, 1, 2 ...; drift of the zero is then per move")
    sides, temperatures = _sides(cells, commands, homings), temperatures_of(cells)
    _refuse_contrary(cells, commands, sides, homings)
    counts = [n for n in cells.table.columns if name_of(n).has("repeat") and n not in cells.columns.values()]
    repeat = cells.table.columns[counts[0]] if counts else [""] * len(commands)
    reach = OVERSHOOT_SHARE * (max(commands) - min(commands)) or 1.0
    overshoots = _went_past(commands, sides, values)
    moves, move_of_row, inserted, again = list[dict[str, Any]](), list[int](), 0, 0

    def add(command: float, at_s: float | None, homed: bool, side: int = 0, **more: Any) -> None:
        number = len(moves)
        segment, time_s = (moves[-1]["segment"] + homed if moves else 0), float(number) if at_s is None else at_s
        approach = {1: "forward", -1: "backward", 0: "unknown"}[side] if homed else ""
        more = {"temperature_degC": None, **more} if "temperature_degC" in cells else more
        moves.append(
            {"move": number, "segment": segment, "time_s": time_s, "command": command, "approach": approach, **more}
        )

    for row, (command, side, homed) in enumerate(zip(commands, sides, homings, strict=True)):
        homed, at_s = homed or not moves, None if times is None else times[row]
        step = 0.0 if homed else command - moves[-1]["command"]
        # A stop at the command before was approached again: from the other side, or as a repetition.
        before = sides[row - 1] if row else 0
        turned = overshoots if before and side != before else bool(before) and repeat[row] != repeat[row - 1]
        if not homed and side and side * step <= 0 and (step or turned):
            ends = (command, moves[-1]["command"])
            via = max(ends) + reach if side < 0 else min(ends) - reach
            add(via, None if at_s is None else 0.5 * (moves[-1]["time_s"] + at_s), False, assumed=1)
            inserted, step = inserted + 1, command - via
        if homed or step:
            more = {"temperature_degC": temperatures[row]} if "temperature_degC" in cells else {}
            add(command, at_s, homed, side, **more)
        else:
            again += 1
        move_of_row.append(len(moves) - 1)
    said = []
    if again:
        rows = f"{plural(again, 'row')}"
        said.append(f"{rows} at the command before: read at that stop again, without a move")
    if inserted:
        added, name = f"{plural(inserted, 'move')} added", cells.shown("approach")
        where = f"where column {name} states another side than the row before gives"
        said.append(f"{added}, {reach:.6g} past the stop, {where}; --column approach= takes sides from the order only")
    if "approach" not in cells:
        said.append("approach: unknown at the beginning of each segment")
    return moves, move_of_row, said


def _went_past(commands: Sequence[float], sides: Sequence[int], values: Sequence[float | None]) -> bool:
    """Whether the axis overshot and returned where the side changes at one command, as a column of sides says.

    The alternative is a second reading at standstill, under the direction of the run that begins there. Only the
    readings can show that, by a likelihood ratio: they stay, while those of the two sides differ by more than they
    scatter. Where a row goes on against its side, as in a sheet sorted by position, no run begins.
    """
    by_side: dict[float, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for command, side, value in zip(commands, sides, values, strict=True):
        if side and value is not None:
            by_side[command][side].append(value)
    pairs = zip(pairwise(commands), pairwise(sides), strict=True)
    turns = {a for (a, b), (before, side) in pairs if a == b and before * side < 0}
    elsewhere = [read for command, read in by_side.items() if len(read) == 2 and command not in turns]
    gaps = [median(read[-1]) - median(read[1]) for read in elsewhere]
    if len(gaps) < GAPS_MIN:
        return True
    gap = median(gaps)
    groups = [group for read in by_side.values() for group in read.values()]
    within = sum((value - fmean(group)) ** 2 for group in groups for value in group)
    freedom = max(sum(map(len, groups)) - len(groups), 1)
    # Of the difference of two readings.
    scatter = sum((other - fmean(gaps)) ** 2 for other in gaps) / (len(gaps) - 1)
    variance = max(2.0 * within / freedom, scatter)
    onward, stays = [0.0] * len(commands), 0.0
    for row in reversed(range(len(commands) - 1)):
        onward[row] = commands[row + 1] - commands[row] or onward[row + 1]
    for row in range(1, len(commands)):
        side, value, before = sides[row], values[row], values[row - 1]
        if commands[row] != commands[row - 1] or side * sides[row - 1] >= 0:
            continue
        if side * onward[row] < 0:
            return True
        if value is not None and before is not None:
            stays += (value - before + side * gap) ** 2 - (value - before) ** 2
    return stays <= 2.0 * LOG_RATIO * variance


def _refuse_contrary(
    cells: FieldCells, commands: Sequence[float], sides: Sequence[int], homings: Sequence[bool]
) -> None:
    """Refuse directions that are all opposite to the commands."""
    ways = [sides[row] * (commands[row] - commands[row - 1]) * (not homings[row]) for row in range(1, len(commands))]
    moved = [row for row, way in enumerate(ways, start=1) if way]
    if len(moved) >= CONTRARY_MIN and max(ways) <= 0 and {sides[row] for row in moved} == {-1, 1}:
        raise cells.ask("contrary", moved[0], "approach")


def _coming_from(text: str) -> str:
    """The direction of a side: "-" and "unten" are where a rising axis came from."""
    known = any(means(f"von {text}", side) for side in ("forward", "backward"))
    return {"+": "-", "-": "+", "+1": "-1", "-1": "+1"}.get(text, f"von {text}" if known else text)


def _sides(cells: FieldCells, commands: Sequence[float], homings: Sequence[bool]) -> list[int]:
    """Direction of each row: 1 forward, -1 backward, 0 unstated.

    The order of the commands decides the meaning of one or two unknown words.
    """
    texts = cells.text("approach")
    if "approach" in cells and place_of(words_of(cells.columns["approach"]), "from") is not None:
        texts = [_coming_from(text) for text in texts]
    words = [plain(text).strip() or text.strip() for text in texts]
    sides = {
        word: 1 if means(text, "forward") else -1 if means(text, "backward") else 0
        for word, text in zip(words, texts, strict=True)
    }
    if "0" in sides:
        # Beside 0 a 1 may be either.
        sides |= dict.fromkeys(sides.keys() & {"0", "1"}, 0)
    unknown = sorted(word for word, side in sides.items() if not side and word not in ("", "unknown"))
    if 0 < len(unknown) < 3 and set(unknown) == set(words) - {"", "unknown"}:
        steps = np.diff(commands) * ~np.array(homings[1:], bool)
        # Of a single word the moves back to the beginning are not stated.
        least = 1.0 if len(unknown) == 2 else STATED_SHARE
        signs_of = {word: np.sign(steps[(np.array(words[1:]) == word) & (steps != 0)]) for word in unknown}
        known = {word: int(np.sign(s.sum())) for word, s in signs_of.items() if len(s) and abs(s.mean()) >= least}
        if len(known) == len(unknown) == len({*known.values()}):
            sides |= known
            named = sorted(((escaped(word, 24), side) for word, side in known.items()), key=lambda item: -item[1])
            said = " and ".join(f"{word} {'forward' if side > 0 else 'backward'}" for word, side in named)
            cells.assumed.append(f"approach: {said.replace(' ', ' is ', 1)}, as the commands rise and fall")
            unknown = []
    for row, word in enumerate(words):
        if word in unknown:
            raise cells.ask("side", row, "approach")
    return [sides[word] for word in words]


# --- whole turns -----------------------------------------------------------------------------------------------------
def unwrapped(
    moves: Sequence[Mapping[str, Any]],
    readings: list[dict[str, Any]],
    stated: str | None,
    counts_per_turn: float | None = None,
) -> tuple[list[dict[str, Any]], list[str]]:
    """The readings with whole turns added where an encoder or autocollimator wraps, and a sentence on it.

    Args:
        moves: rows of moves.
        readings: rows of readings.
        stated: unit of the readings, degrees where none is stated; lengths are unchanged unless the readings count to a
            power of two.
        counts_per_turn: period of the wrapping, in the readings' unit; 0: no wrapping.

    Raises:
        InputError: readings jump repeatedly by a number that is not stated as their period.
    """
    if counts_per_turn == 0:
        return readings, []
    usable = [k for k, reading in enumerate(readings) if reading["status"] == "ok" and reading["value"] is not None]
    command = np.array([moves[readings[k]["move"]]["command"] for k in usable])
    value = np.array([readings[k]["value"] for k in usable], dtype=float)
    unit = stated or "deg"
    of_angle = parse_unit(unit)
    turn = (
        counts_per_turn
        or (360.0 / of_angle.scale if of_angle and of_angle.kind == "angle" else None)
        or _counts_of(command, value)
    )
    if turn is None and of_angle is not None and of_angle.kind == "length":
        if len(size := restarts(command, value)):
            raise asked_of_dial(size, of_angle)
    jumps = turn_jumps(command, value, turn) if turn is not None else {}
    # An outlier also jumps, and back, but not by whole turns.
    if turn is None or not jumps or any(abs(jump - round(jump)) > TURN_TOLERANCE for jump in jumps.values()):
        return readings, []
    if stated is None and counts_per_turn is None:
        way = np.sign(np.diff(command))
        went = [next((w for w in reversed(way[: row - 1]) if w), 0.0) for row in jumps]
        goes = [next((w for w in way[row - 1 :] if w), 0.0) for row in jumps]
        if all(a * b < 0 for a, b in zip(went, goes, strict=True)):
            # Where the commands turn back, and nowhere else, readings of an unknown unit jump by their play.
            return readings, []
    rows, turns = list(readings), 0
    for row, k in enumerate(usable):
        turns -= round(jumps.get(row, 0.0))
        rows[k] = {**rows[k], "value": float(value[row]) + turn * turns}
    times = "once" if len(jumps) == 1 else f"{len(jumps)} times"
    sentence = f"value: jumps by whole turns {times}, which are added: {turn:g} {unit} each; "
    return rows, [sentence + "--counts-per-turn says another"]


def _counts_of(command: np.ndarray, value: np.ndarray) -> float | None:
    """Period of wrapped whole numbers: the power of two that bounds them all, if they jump by it."""
    if len(value) < 3 or np.any(value != np.round(value)):
        return None
    span = float(np.ptp(value)) + 1.0
    turn = next((2.0**bits for bits in BITS if 2.0**bits >= span), None)
    jumps = turn_jumps(command, value, span)
    if turn is None or not jumps:
        return None
    typical = span * float(np.median(np.abs(list(jumps.values()))))
    if any(abs(abs(jump) * span / typical - 1.0) > TURN_TOLERANCE for jump in jumps.values()):
        return None
    rise, step = np.diff(value), np.diff(command)
    residuals = np.delete(rise - np.median(rise[step != 0] / step[step != 0]) * step, [row - 1 for row in jumps])
    if abs(typical - turn) <= JUMP_SDS * float(np.median(np.abs(residuals))) + 2.0:
        return turn
    usual = [n for n in TURNS_USUAL if abs(n / typical - 1.0) <= TURN_TOLERANCE]
    turns = dict.fromkeys((*usual, turn, round(typical)))
    raise asked("wrapped", "value", each=turns, jump=typical, times=len(jumps))
