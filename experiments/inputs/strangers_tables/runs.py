"""Runs side by side: a row for each position, a column for each run; positions, averages or deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from decimal import Decimal
from typing import Any, NamedTuple

from experiments.inputs.strangers_tables import sheets
from experiments.inputs.strangers_tables.kinds import Drawn, truth_of
from experiments.inputs.strangers_tables.measured import (
    DIGITS,
    SCALE,
    WORDS,
    Axis,
    Reading,
    Stranger,
    Truth,
    decimal,
    draw_axis,
)
from experiments.inputs.strangers_tables.sheets import Cell, Columns, Sheet


class Runs(NamedTuple):
    """Runs over the same positions, in the order in which they were made."""

    axis: Axis
    sides: tuple[int, ...]
    values: tuple[tuple[Decimal, ...], ...]
    """Of each run, in the order of `axis.commands`."""

    def readings(self, told: bool = True) -> list[Reading]:
        """In the order of time: a rising run begins below, a falling one above."""
        readings = []
        for side, values in zip(self.sides, self.values, strict=True):
            run = [Reading(float(c), float(v), side * told) for c, v in zip(self.axis.commands, values, strict=True)]
            readings += run[::side]
        return readings


def draw_runs(by: Stranger, axis: Axis, sides: Sequence[int]) -> Runs:
    """Every run is approached from beyond its first position."""
    return Runs(axis, tuple(sides), tuple(tuple(axis.value(c, side, by) for c in axis.commands) for side in sides))


def side_by_side(by: Stranger, runs: Runs, names: Sequence[str], unit_once: bool | None = None) -> Sheet:
    """A row for each position, a column for each run; the unit at every head, or at the positions' alone."""
    axis = runs.axis
    position = by.headed(by.names(axis)[0], axis.command_unit)
    same = axis.unit == axis.command_unit and (by.chance(0.25) if unit_once is None else unit_once)
    text = by.unit(axis.unit)
    form = by.pick(("{} ({})", "{} [{}]", "{} / {}"))
    heads = [position, *(name if same else form.format(name, text) for name in names)]
    rows: list[list[Cell]] = [list(row) for row in zip(axis.commands, *runs.values, strict=True)]
    if by.chance(0.1):
        rows.reverse()
    if by.chance(0.2):
        heads = [by.word("NUMBER"), *heads]
        rows = [[Decimal(k + 1), *row] for k, row in enumerate(rows)]
    return Sheet([heads], rows)


def runs_with_words(by: Stranger) -> Drawn:
    """Forward 1, Backward 1, Forward 2 ...: in pairs, all that rise first, or one way alone."""
    axis = draw_axis(by, variety=True)
    pair = by.pick(WORDS["RUN_SIDES"]["all"] if by.chance(0.15) else by.words("RUN_SIDES"))
    pairs, style = int(by.rng.integers(1, 4)), by.rng.random()
    sides = (1, -1) * pairs if style < 0.85 or pairs == 1 else (1,) * (pairs + 1)
    order = [1 + sides[:k].count(side) for k, side in enumerate(sides)]
    form = by.pick(("{} {}", "{} {}", "{}{}", "{} #{}", "{}_{}"))
    if len(pair[0]) == 1:
        form = by.pick((by.word("RUN") + " {1} {0}", "{1} {0}", "{1}{0}"))
    alone = len(sides) == 2 and by.chance(0.5)
    names = [pair[side < 0] if alone else form.format(pair[side < 0], k) for side, k in zip(sides, order, strict=True)]
    runs = draw_runs(by, axis, sides)
    sheet, truth = side_by_side(by, runs, names), truth_of(axis, runs.readings())
    if len(sides) > 2 and -1 in sides and by.chance(0.2):
        # All that rise first: by the numbers, or as they stand, is one.
        first = len(sheet.heads[0]) - len(sides)
        places = [*range(first), *(first + k for side in (1, -1) for k, s in enumerate(sides) if s == side)]
        sheet.heads = [[head[k] for k in places] for head in sheet.heads]
        sheet.rows = [[row[k] for k in places] for row in sheet.rows]
        standing = Runs(axis, sides[::2] + sides[1::2], runs.values[::2] + runs.values[1::2])
        truth = replace(truth, also=(truth_of(axis, standing.readings()),))
    return Drawn("runs side by side, with words of direction", sheets.any_file(by, sheet), truth)


def grouped_runs(by: Stranger) -> Drawn:
    """Two lines of names: the run above, its directions below; and sometimes a third one with the units."""
    axis = draw_axis(by)
    pair, pairs = by.word("RUN_SIDES"), int(by.rng.integers(2, 4))
    runs = draw_runs(by, axis, (1, -1) * pairs)
    word = by.word("RUN")
    below = side_by_side(by, runs, list(pair) * pairs, unit_once=False)
    first = len(below.heads[0]) - 2 * pairs
    above = [""] * first
    for k in range(pairs):
        above += [f"{word} {k + 1}", f"{word} {k + 1}" if by.chance(0.2) else ""]
    sheet = Sheet([above, below.heads[0]], below.rows)
    return Drawn("two lines of names", sheets.any_file(by, sheet), truth_of(axis, runs.readings()))


def turning_runs(by: Stranger) -> Drawn:
    """CW 1, CCW 1 ...: which of them rises follows from the order of the columns alone, the first rising."""
    axis = draw_axis(by, rotary=True)
    pair, pairs = by.pick(WORDS["TURNS"]), int(by.rng.integers(1, 3))
    names = [f"{word} {k + 1}" for k in range(pairs) for word in pair]
    runs = draw_runs(by, axis, (1, -1) * pairs)
    sheet = side_by_side(by, runs, names)
    truth = truth_of(axis, runs.readings(), answer="either")
    return Drawn("runs side by side, clockwise and not", sheets.any_file(by, sheet), truth)


def run_names(by: Stranger, count: int) -> list[str]:
    """Run 1, Run 2 ..., or numbers alone."""
    if by.chance(0.1):
        return [f"ref_pos(i,{k + 1})" for k in range(count)]
    if by.chance(0.12):
        return [str(k + 1) for k in range(count)]
    form = by.pick(("{} {}", "{} {}", "{}{}", "{} #{}", "{}_{}"))
    word = by.word("RUN")
    return [form.format(word, k + 1) for k in range(count)]


def runs_without_words(by: Stranger) -> Drawn:
    """Run 1, Run 2 ...: all rising; that they agree within their scatter tells it, and a careful reader may ask."""
    axis = draw_axis(by)
    runs = draw_runs(by, axis, (1,) * int(by.rng.integers(2, 6)))
    sheet = side_by_side(by, runs, run_names(by, len(runs.sides)))
    truth = truth_of(axis, runs.readings(), answer="either")
    return Drawn("runs side by side, unnamed, all rising", sheets.any_file(by, sheet), truth)


def runs_to_and_fro(by: Stranger) -> Drawn:
    """Run 1, Run 2 ...: every second one falls, which no name says."""
    axis = draw_axis(by)
    runs = draw_runs(by, axis, (1, -1) * int(by.rng.integers(1, 4)))
    sheet = side_by_side(by, runs, run_names(by, len(runs.sides)))
    truth = truth_of(axis, runs.readings(), answer="ask")
    return Drawn("runs side by side, unnamed, to and fro", sheets.any_file(by, sheet), truth)


def deviations_of(runs: Runs, unit: str) -> list[list[Decimal]]:
    """Actual less commanded position of every run, in a unit."""
    axis = runs.axis
    scale = SCALE[axis.command_unit] / SCALE[axis.unit]
    digits = max(DIGITS[unit], 1)
    return [
        [
            decimal((float(v) - scale * float(c)) * SCALE[axis.unit] / SCALE[unit], digits)
            for c, v in zip(axis.commands, values, strict=True)
        ]
        for values in runs.values
    ]


def in_positions(runs: Runs, errors: Sequence[Sequence[Decimal]], unit: str, **more: Any) -> Truth:
    """The truth of deviations: command plus deviation, in the unit of the commands."""
    axis = runs.axis
    shift = SCALE[unit] / SCALE[axis.command_unit]
    readings = []
    for side, values in zip(runs.sides, errors, strict=True):
        run = [Reading(float(c), float(c) + shift * float(v), side) for c, v in zip(axis.commands, values, strict=True)]
        readings += run[::side]
    digit = 10.0 ** -max(DIGITS[unit], 1) * shift
    play = axis.play * SCALE[axis.unit] / SCALE[axis.command_unit]
    return Truth(tuple(readings), axis.command_unit, axis.command_unit, digit, ratio=1.0, play=play, **more)


def same_domain_axis(by: Stranger) -> tuple[Axis, str]:
    """An axis driven in the unit of its positions, and a small unit of its deviations."""
    rotary = by.chance(0.3)
    unit = "deg" if rotary else by.pick(("mm", "mm", "inch"))
    axis = draw_axis(by, rotary, unit, unit)
    small = ("arcsec", "arcsec", "mrad", "arcmin") if rotary else ("um", "um", "1/100 mm", "mm")
    return axis, by.pick(("thou",) if axis.unit == "inch" else small)


def deviations(by: Stranger) -> Drawn:
    """A target, a direction and a deviation, or deviations of runs side by side: positions are nowhere."""
    axis, unit = same_domain_axis(by)
    pair, pairs = by.word("RUN_SIDES"), int(by.rng.integers(1, 4))
    runs = draw_runs(by, axis, (1, -1) * pairs)
    errors = deviations_of(runs, unit)
    truth = in_positions(runs, errors, unit, answer="ask")
    name, plain = by.word("DEVIATION"), unit not in ("mm", "deg") and by.chance(0.3)
    if plain:
        # That they are deviations follows from their size alone.
        name = by.names(axis)[1]
    if by.chance(0.5):
        names = [f"{'' if plain else name + ' '}{word} {k + 1}" for k in range(pairs) for word in pair]
        form, text = by.pick(("{} ({})", "{} [{}]")), by.unit(unit)
        position = by.headed(by.names(axis)[0], axis.command_unit)
        rows: list[list[Cell]] = [list(row) for row in zip(axis.commands, *errors, strict=True)]
        sheet = Sheet([[position, *(form.format(n, text) for n in names)]], rows)
        kind = "deviations of runs side by side" + plain * ", not called so"
        return Drawn(kind, sheets.any_file(by, sheet), truth)
    order = [list(zip(axis.commands, run, strict=True))[::side] for side, run in zip(runs.sides, errors, strict=True)]
    words_of = by.word("SIDES")
    columns: Columns = {
        by.headed(by.names(axis)[0], axis.command_unit): [c for run in order for c, _ in run],
        by.word("DIRECTION"): [words_of[s < 0] for s, run in zip(runs.sides, order, strict=True) for _ in run],
        by.with_unit(name, unit): [v for run in order for _, v in run],
    }
    return Drawn(
        "deviations alone" + plain * ", not called so",
        sheets.columns_file(by, columns),
        truth,
    )


def compensated(by: Stranger) -> Drawn:
    """An axis after compensation: readings barely differ from the targets, and forward ones from backward ones.

    The sheet is sorted by position, or by runs, or has a column for each direction: it says the sides, readings do not.
    """
    axis, _ = same_domain_axis(by)
    scatter = max(axis.scatter, 0.7 * axis.digit)
    axis = replace(axis, per_command=1.0, zero=0.0, scatter=scatter, play=scatter * by.rng.uniform(0, 1), geared=False)
    runs = draw_runs(by, axis, (1, -1) * int(by.rng.integers(1, 4)))
    layout = by.pick(("positions", "runs", "columns"))
    if layout == "columns":
        pair, pairs = by.word("RUN_SIDES"), len(runs.sides) // 2
        names = [word if pairs == 1 else f"{word} {k + 1}" for k in range(pairs) for word in pair]
        sheet = side_by_side(by, runs, names)
        return Drawn("a compensated axis", sheets.any_file(by, sheet), truth_of(axis, runs.readings()))
    rows = [
        (command, side, values[k])
        for side, values in zip(runs.sides, runs.values, strict=True)
        for k, command in list(enumerate(axis.commands))[::side]
    ]
    rows = sorted(rows, key=lambda row: row[0]) if layout == "positions" else rows
    return _with_sides(by, axis, rows, "a compensated axis")


def sorted_by_position(by: Stranger) -> Drawn:
    """A sheet by position and side, with several readings of each."""
    axis, _ = same_domain_axis(by)
    count = int(by.rng.integers(2, 6))
    stops = [(command, side) for command in axis.commands for side in (1, -1) for _ in range(count)]
    rows = [(command, side, axis.value(command, side, by)) for command, side in stops]
    return _with_sides(by, axis, rows, "by position and side")


def _with_sides(by: Stranger, axis: Axis, rows: Sequence[tuple[Decimal, int, Decimal]], kind: str) -> Drawn:
    """A row for each reading, with its direction."""
    command, reading = by.names(axis)
    sides = by.word("SIDES")
    columns: Columns = {
        by.headed(command, axis.command_unit): [c for c, _, _ in rows],
        by.word("DIRECTION"): [sides[side < 0] for _, side, _ in rows],
        by.with_unit(reading, axis.unit): [v for _, _, v in rows],
    }
    truth = truth_of(axis, [Reading(float(c), float(v), side) for c, side, v in rows])
    return Drawn(kind, sheets.columns_file(by, columns), truth)


def averages(by: Stranger) -> Drawn:
    """The means of a laser's software: Target, Forward, Reverse, System, 2 Std Devn, Dead Zone."""
    axis, small = same_domain_axis(by)
    runs = draw_runs(by, axis, (1, -1))
    errors = deviations_of(runs, small)
    as_errors = by.chance(0.4)
    text, small_text = by._replace(language="en").unit(axis.unit), by._replace(language="en").unit(small)
    form = by.pick(("{} ({})", "{} [{}]"))
    sd = decimal(2 * axis.scatter * SCALE[axis.unit] / SCALE[small], DIGITS[small] + 1)
    dead = [decimal(float(b) - float(f), DIGITS[small] + 1) for f, b in zip(*errors, strict=True)]
    names, cells = ["Forward", "Reverse"], [list(run) for run in (errors if as_errors else runs.values)]
    if system := by.chance(0.5):
        names.append("System")
        cells.append([decimal((float(f) + float(b)) / 2, 5) for f, b in zip(*cells, strict=True)])
    units = [small_text if as_errors else text] * len(names) + [small_text] * 2
    names = [*names, "2 Std Devn", by.pick(("Dead Zone", "Dead zone", "Reversal"))]
    cells = [*cells, [sd] * len(dead), dead]
    heads = [["Target", *names], [text, *units]]
    if by.chance(0.7):
        heads = [[form.format(name, unit) for name, unit in zip(*heads, strict=True)]]
    rows = [list(row) for row in zip(axis.commands, *cells, strict=True)]
    # The sd is written in its own unit, whatever the others have.
    u = float(sd) / 2 * SCALE[small] / SCALE[axis.unit]
    truth = truth_of(axis, [r._replace(u=u) for r in runs.readings()], answer="either" if system else "right")
    if as_errors:
        truth = in_positions(runs, errors, small, answer="ask")
        truth = replace(truth, readings=tuple(r._replace(u=u) for r in truth.readings))
    file = sheets.any_file(by, Sheet(heads, rows))
    return Drawn("averages of a laser, deviations" if as_errors else "averages of a laser", file, truth)
