"""Moves and readings of a foreign table of an axis: one row is a move, a reading, or both; unit of the folder.

Successive rows at the same command are readings of one stop; rows without a value are moves without a reading. A column
of directions gives the side of approach of a stop; where the previous rows lead to another side, the missing move is
inserted. Assumptions about what the table does not state are listed in words.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median

import numpy as np

from tvsbayes.errors import escaped, refusal
from tvsbayes.files.foreign_table import ForeignTable
from tvsbayes.instrument.column_names import (
    READING_UNITS,
    ColumnMapping,
    field_by_word,
    map_columns,
    unit_of_name,
    words_of,
)
from tvsbayes.instrument.foreign_cells import (
    FieldCells,
    PlainColumn,
    homings_of,
    left_out,
    plain_column,
    seconds_of,
    status_of,
    temperatures_of,
    word_of,
)
from tvsbayes.single_axis.axis_campaign import AXIS_MOVES, READINGS, TURNS, Approach, AxisMove, Reading
from tvsbayes.single_axis.axis_rows import turn_jumps
from tvsbayes.single_axis.foreign_columns import scale_between

TURN_TOLERANCE = 0.1
"""Largest deviation of a jump from whole turns by play and errors of gears, turns."""
JUMP_SDS = 6.0
"""Largest deviation of a jump from a power of two, in typical deviations of steps from the line, plus two counts."""
BITS = range(8, 33)
"""Exponents of encoders that count modulo a power of two."""
OVERSHOOT_SHARE = 0.05
"""Assumed overshoot of an inserted move beyond a stop, as a share of the range of commands: more than any play."""
CONTRARY_MIN = 4
"""Least number of rows with a direction opposite to their commands', in all such rows, at which the sign is refused."""
FORWARD = {
    *("forward", "forwards", "fwd", "f", "+", "+1", "1", "up", "rising", "increasing", "positive", "pos", "below"),
    *("from below", "vorwarts", "vor", "hin", "aufwarts", "adelante", "subida", "avant", "aller", "\u2191", "\u2192"),
}
"""Words of the direction of rising commands, without accents."""
BACKWARD = {
    *("backward", "backwards", "back", "bwd", "b", "rev", "reverse", "-", "-1", "down", "falling", "decreasing"),
    *("negative", "neg", "above", "from above", "ruckwarts", "zuruck", "ruck", "abwarts", "atras", "bajada"),
    *("arriere", "retour", "\u2193", "\u2190", "\u2212"),
}
_REPEAT_WORDS = {"repeat", "repetition", "cycle", "zyklus", "wiederholung", "ciclo", "repeticion", "cycles", "rep"}
"""Words of columns that count approaches to one stop."""

_COLUMNS = {c.name: c for kind in (READINGS, AXIS_MOVES) for c in kind.columns.values() if c.names}
AXIS_FIELDS = tuple(dict.fromkeys(("command", "value", *_COLUMNS)))
"""All fields of a table of an axis."""
_READING_WORDS = {"position", "pos", "posicion", "counts", "zahler", "contador"}
"""Words of commands that mean readings where another column is clearly the command."""
_PERCENT = {"percent", "prozent", "pct"}
_COVERAGE = re.compile(r"\bk\s*=?\s*([0-9]+(?:\.[0-9]+)?)\b")
"""Coverage factor in the name of a column of expanded uncertainties (GUM, 6.2)."""
COVERAGE_USUAL = 2.0
_TEMPERATURE = {"temp", "temperature", "temperatur", "temperatura", "humidity"}
"""Words of quantities whose degrees are not angles."""


def axis_field_of(name: str) -> str | None:
    """The field of an axis by the first known word of a column's name; percentages have none."""
    if "%" in name or _PERCENT.intersection(words_of(name)):
        return None
    return field_by_word(words_of(name), _COLUMNS.values())


def map_axis_columns(columns: Iterable[str], stated: Mapping[str, str] | None = None) -> ColumnMapping:
    """Assign columns of an axis to fields, as `map_columns`; some names depend on the other columns.

    With a column "microsteps" a "position [um]" is a reading; without any other reading, so is "mm" alone, or the only
    other column with a unit of readings, as "dial gauge mm".

    Args:
        columns: their names.
        stated: column by field of `AXIS_FIELDS`, as the user states it; "" where the table has no such column.

    Raises:
        InputError: a field or column that does not exist.
    """
    names, given = list(columns), dict(stated or {})
    known = map_columns(names, given, AXIS_FIELDS, axis_field_of)
    if "value" in known.columns or "value" in known.ambiguous or "value" in given:
        return known
    ambiguous = known.ambiguous.get("command", ())
    readings = [name for name in ambiguous if _READING_WORDS.intersection(words_of(name))]
    rest = [name for name in ambiguous if name not in readings]
    units = [
        name
        for name in known.unused
        if (words := words_of(name)) and all(unit_of_name(word, READING_UNITS) for word in words)
    ]
    if len(rest) == len(readings) == 1 and not units and (unit_of_name(readings[0], READING_UNITS) or not known.unused):
        return map_columns(names, {**given, "command": rest[0], "value": readings[0]}, AXIS_FIELDS, axis_field_of)
    units = units or [
        name
        for name in known.unused
        if unit_of_name(name, READING_UNITS) and not _TEMPERATURE.intersection(words_of(name))
    ]
    if len(units) == 1 and not ambiguous:
        return map_columns(names, {**given, "value": units[0]}, AXIS_FIELDS, axis_field_of)
    return known


@dataclass(frozen=True)
class LoggedDrive:
    """A drive at constant rate, from a log whose readings were taken in motion.

    Attributes:
        rate: commands per second.
        header: keys of `campaign.toml` that the log states.
        period_between: range of an unknown period, s; None where the log is too short.
        priors: entries of `[axis]`, value and u.
    """

    rate: float
    header: Mapping[str, object]
    period_between: tuple[float, float] | None
    priors: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class ForeignReadings:
    """Rows of `moves.csv` and `readings.csv`, and the assumptions about the table.

    Attributes:
        moves: rows of `moves.csv`.
        readings: rows of `readings.csv`.
        assumed: assumptions in words, with the option that overrides them, if any.
        unit: unit of the readings where cells or the log state it.
        drive: the drive of a log of readings in motion.
        notes: remarks on rows used and left out.
    """

    moves: tuple[AxisMove, ...]
    readings: tuple[Reading, ...]
    assumed: tuple[str, ...]
    unit: str | None = None
    drive: LoggedDrive | None = None
    notes: tuple[str, ...] = ()


def readings_of(table: ForeignTable, columns: Mapping[str, str], deviations: bool = False) -> ForeignReadings:
    """Derive moves and readings from a table.

    Args:
        table: the foreign table.
        columns: its columns by field of `AXIS_FIELDS`, with "command" and "value".
        deviations: whether the readings are actual minus commanded position.

    Raises:
        InputError: a cell is not a value of its field, or the table has no row.
    """
    table.require_rows()
    plain = _plain_columns(table, columns)
    table = replace(table, columns={**table.columns, **{columns[f]: column.cells for f, column in plain.items()}})
    assumed, unit = [column.remark for column in plain.values() if column.remark], plain["value"].unit
    cells = FieldCells(table, columns)
    commands, values, stated_u = (cells.read(_COLUMNS[name]) for name in ("command", "value", "u"))
    if not deviations and len(set(values)) > 2 and values == commands:
        assumed.append("value: equals the command in every row: what was read, or the command again?")
    if deviations:
        factor = scale_between(columns["command"], columns["value"])
        values = [None if d is None else c + factor * d for c, d in zip(commands, values, strict=True)]
        stated_u, unit = [factor * u for u in stated_u], unit_of_name(columns["command"], READING_UNITS) or unit
        assumed.append("value: the command plus the deviation, because --deviations says so")
    if "u" in columns and (coverage := _coverage_of(columns["u"])) is not None:
        stated_u = [u / coverage for u in stated_u]
        assumed.append(f"u: column {escaped(columns['u'])} is an expanded uncertainty, over {coverage:g}")
    times, homings, statuses = seconds_of(cells, assumed), homings_of(cells, assumed), cells.text("status")
    if times is None:
        assumed.append("time_s: no column, so 0, 1, 2 ...; drift of the zero is then per move")
    stops = _Stops(cells, commands, values, homings, assumed)
    readings: list[Reading] = []
    for row, (command, value) in enumerate(zip(commands, values, strict=True)):
        stops.go(row, command, None if times is None else times[row])
        if value is not None or statuses[row]:
            move = stops.moves[-1].move
            status = status_of(cells, row, {"value": value}, "reading")
            readings.append(Reading(len(readings), move, value, stated_u[row], status))
    assumed += left_out(cells, statuses, "reading") + stops.remarks()
    if "u" not in cells:
        assumed.append("u: none, so that the scatter of stops covers the readings' own")
    return ForeignReadings(tuple(stops.moves), tuple(readings), tuple(assumed), unit)


def _coverage_of(name: str) -> float | None:
    """The coverage factor of a column of expanded uncertainties; None for standard ones."""
    if stated := _COVERAGE.search(name.lower()):
        return float(stated[1]) or None
    return COVERAGE_USUAL if {"expanded", "erweiterte", "expandida", "elargie"}.intersection(words_of(name)) else None


def _plain_columns(table: ForeignTable, columns: Mapping[str, str]) -> dict[str, PlainColumn]:
    """Commands, readings and their u as plain numbers, by field."""
    names = {field: columns[field] for field in ("command", "value", "u") if field in columns}
    return {field: plain_column(name, table.columns[name]) for field, name in names.items()}


class _Stops:
    """Moves of a table, row by row, including those implied by its column of directions.

    Attributes:
        moves: moves so far.
    """

    def __init__(
        self,
        cells: FieldCells,
        commands: Sequence[float],
        values: Sequence[float | None],
        homings: Sequence[bool],
        assumed: list[str],
    ) -> None:
        self._cells, self._commands, self._values, self._homings = cells, commands, values, homings
        self._sides = _sides(cells, commands, homings, assumed)
        self._temperatures = temperatures_of(cells, assumed)
        count_columns = [name for name in cells.table.columns if _REPEAT_WORDS.intersection(words_of(name))]
        self._counts = cells.table.columns[count_columns[0]] if count_columns else None
        self._reach = OVERSHOOT_SHARE * (max(commands) - min(commands)) or 1.0
        self._overshoots = self._went_past()
        self.moves: list[AxisMove] = []
        self._inserted = self._repeats = 0
        self._refuse_contrary()

    def _went_past(self) -> bool:
        """Whether the axis overshot and returned where the side changes at one command.

        The alternative is a second reading at standstill. The axis overshot if, in most such rows, the readings change
        as they differ between the two sides elsewhere.
        """
        values_at: dict[float, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
        for command, side, value in zip(self._commands, self._sides, self._values, strict=True):
            if side and value is not None:
                values_at[command][side].append(value)
        gaps = [median(by_side[-1]) - median(by_side[1]) for by_side in values_at.values() if len(by_side) == 2]
        gap = median(gaps) if gaps else 0.0
        is_overshoot = []
        for row in range(1, len(self._commands)):
            value, previous, side = self._values[row], self._values[row - 1], self._sides[row]
            reversed_here = self._commands[row] == self._commands[row - 1] and side * self._sides[row - 1] < 0
            if reversed_here and value is not None and previous is not None:
                is_overshoot.append(abs(value - previous + side * gap) <= abs(value - previous))
        return 2 * sum(is_overshoot) >= len(is_overshoot)

    def _refuse_contrary(self) -> None:
        """Refuses directions that are all opposite to the commands."""
        steps = [b - a for a, b in zip(self._commands, self._commands[1:], strict=False)]
        moved = [row for row, step in enumerate(steps, start=1) if step and self._sides[row] and not self._homings[row]]
        contrary = [row for row in moved if self._sides[row] * steps[row - 1] < 0]
        if len(contrary) >= CONTRARY_MIN and contrary == moved and {self._sides[row] for row in moved} == {-1, 1}:
            allowed = "forward where commands rise"
            remedy = "exchange the words; or --column approach= takes directions from the order of the commands"
            raise self._cells.refuse(contrary[0], "approach", allowed, remedy)

    def go(self, row: int, command: float, at_s: float | None) -> None:
        """Add the moves of a row, timed by the table or by the number of the move."""
        homed = self._homings[row] or not self.moves
        side = self._sides[row]
        step = 0.0 if homed else command - self.moves[-1].command
        if not homed and side and side * step <= 0 and (step or self._turned(row, side)):
            previous_s = self.moves[-1].time_s
            via = min(command, self.moves[-1].command) - self._reach
            if side < 0:
                via = max(command, self.moves[-1].command) + self._reach
            self._add(via, None if at_s is None else 0.5 * (previous_s + at_s), homed=False)
            self._inserted += 1
            step = command - via
        if homed or step:
            self._add(command, at_s, homed=homed, side=side, temperature_degC=self._temperatures[row])
        else:
            self._repeats += 1

    def _turned(self, row: int, side: int) -> bool:
        """Whether a stop at the previous command was approached again: from the other side, or as a repetition."""
        if side == self._sides[row - 1] or not self._sides[row - 1]:
            return (
                self._counts is not None and self._counts[row] != self._counts[row - 1] and bool(self._sides[row - 1])
            )
        return self._overshoots

    def _add(
        self,
        command: float,
        at_s: float | None,
        *,
        homed: bool,
        side: int = 0,
        temperature_degC: float | None = None,
    ) -> None:
        segment = 0 if not self.moves else self.moves[-1].segment + homed
        words: dict[int, Approach] = {1: "forward", -1: "backward", 0: "unknown"}
        time_s = float(len(self.moves)) if at_s is None else at_s
        approach = words[side] if homed else ""
        self.moves.append(AxisMove(len(self.moves), segment, time_s, command, approach, temperature_degC))

    def remarks(self) -> list[str]:
        """Assumptions about moves, in words."""
        sentences = []
        if n := self._repeats:
            sentences.append(f"{n} row{'s' * (n > 1)} at the command before: read at that stop again, without a move")
        if n := self._inserted:
            name = escaped(self._cells.columns["approach"])
            sentences.append(
                f"{n} move{'s' * (n > 1)} added, {self._reach:.6g} past the stop, where column {name} states another "
                "side than the row before gives; --column approach= takes sides from the order only"
            )
        if "approach" not in self._cells:
            sentences.append("approach: unknown at the beginning of each segment")
        return sentences


def _sides(cells: FieldCells, commands: Sequence[float], homings: Sequence[bool], assumed: list[str]) -> list[int]:
    """Direction of each row: 1 forward, -1 backward, 0 unstated.

    The order of the commands decides the meaning of two unknown words.
    """
    words = [word_of(text) for text in cells.text("approach")]
    sides = {**dict.fromkeys(("", "unknown"), 0), **dict.fromkeys(FORWARD, 1), **dict.fromkeys(BACKWARD, -1)}
    unknown_words = sorted(set(words) - {"", "unknown"})
    if not set(unknown_words) <= set(sides) and len(unknown_words) == 2:
        signs_of: dict[str, set[int]] = {word: set() for word in unknown_words}
        for row in range(1, len(words)):
            step = commands[row] - commands[row - 1]
            if step and words[row] in signs_of and not homings[row]:
                signs_of[words[row]].add(1 if step > 0 else -1)
        signs = [next(iter(signs_of[word])) if len(signs_of[word]) == 1 else 0 for word in unknown_words]
        if signs[0] * signs[1] < 0:
            sides |= dict(zip(unknown_words, signs, strict=True))
            forward, backward = (escaped(unknown_words[signs.index(side)], 24) for side in (1, -1))
            assumed.append(f"approach: {forward} is forward and {backward} backward, as the commands rise and fall")
    for row, word in enumerate(words):
        if word not in sides:
            allowed = "forward or backward, + or -, fwd or rev, up or down, unknown"
            remedy = "forward is the direction of rising commands; or leave it out with --column approach="
            raise cells.refuse(row, "approach", allowed, remedy)
    return [sides[word] for word in words]


def unwrapped(wrapped: ForeignReadings, unit: str, counts_per_turn: float | None = None) -> ForeignReadings:
    """The readings with whole turns added, where an encoder or autocollimator wraps.

    Args:
        wrapped: moves and readings.
        unit: unit of the readings; non-angles are unchanged unless the readings count to a power of two.
        counts_per_turn: period of the wrapping, in the readings' unit; 0: no wrapping.

    Raises:
        InputError: readings jump repeatedly by a number that is not stated as their period.
    """
    if counts_per_turn == 0:
        return wrapped
    usable = [k for k, reading in enumerate(wrapped.readings) if reading.status == "ok" and reading.value is not None]
    command = np.array([wrapped.moves[wrapped.readings[k].move].command for k in usable])
    value = np.array([wrapped.readings[k].value for k in usable], dtype=float)
    turn = counts_per_turn or TURNS.get(unit) or _counts_of(command, value)
    jumps = turn_jumps(command, value, turn) if turn is not None else {}
    # An outlier also jumps, and back, but not by whole turns.
    if turn is None or not jumps or any(abs(jump - round(jump)) > TURN_TOLERANCE for jump in jumps.values()):
        return wrapped
    readings, turns = list(wrapped.readings), 0
    for row, k in enumerate(usable):
        turns -= round(jumps.get(row, 0.0))
        readings[k] = replace(readings[k], value=float(value[row]) + turn * turns)
    times = "once" if len(jumps) == 1 else f"{len(jumps)} times"
    sentence = f"value: jumps by whole turns {times}, which are added: {turn:g} {unit} each; "
    sentence += "--counts-per-turn says another"
    return replace(wrapped, readings=tuple(readings), assumed=(*wrapped.assumed, sentence))


def _counts_of(command: np.ndarray, value: np.ndarray) -> float | None:
    """Period of wrapped whole numbers: the power of two that bounds them all, if they jump by it.

    Raises:
        InputError: the readings jump by another number.
    """
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
    found, allowed = f"readings that jump by about {typical:.0f} counts, {len(jumps)} times", "a continuous count"
    remedy = "state where the encoder restarts, --counts-per-turn N; or that these are motions, --counts-per-turn 0"
    raise refusal("wrapped", file="value", found=found, allowed=allowed, remedy=remedy)
