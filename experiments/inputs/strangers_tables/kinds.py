"""Tables of one axis by kind: a row for each reading, or a row for each position and a column for each run."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Sequence
from dataclasses import replace
from decimal import Decimal
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from experiments.inputs.strangers_tables.measured import (
    DIGITS,
    DOMAIN,
    SCALE,
    WORDS,
    Axis,
    Cell,
    Columns,
    File,
    Reading,
    Sheet,
    Stop,
    Stranger,
    Truth,
    any_file,
    decimal,
    draw_axis,
    preamble,
    readings_of,
    sweep,
)

START = datetime.datetime(2026, 3, 12, 9, 5, 10)


class Drawn(NamedTuple):
    """A table of a kind, and what it says."""

    kind: str
    file: File
    truth: Truth


def directions(by: Stranger, stops: Sequence[Stop]) -> Columns:
    """A column of directions."""
    pair = [Decimal(word) if word in ("1", "-1") else word for word in by.word("SIDES")]
    return {by.word("DIRECTION"): [pair[stop.side < 0] for stop in stops]}


def plain(
    by: Stranger, axis: Axis, *, named: str | None = "", bare: bool = False, stated: bool | None = None
) -> tuple[Columns, Truth]:
    """Command, mostly a direction, reading: the columns, and what they say.

    `named` is the unit of the readings as it is written at their head: None where there is none, "" their own. Of
    `bare` columns neither has a unit. Whether directions are `stated` is drawn if it is None.
    """
    stated = by.chance(0.5) if stated is None else stated
    stops = sweep(by, axis.commands, stated)
    values, (command, reading) = axis.read(stops, by), by.names(axis)
    first = command if bare else by.with_unit(command, axis.command_unit)
    columns: Columns = {first: [stop.command for stop in stops]} | (directions(by, stops) if stated else {})
    head = reading if bare or named is None else f"{reading} ({named})" if named else by.with_unit(reading, axis.unit)
    return columns | {head: values}, axis.truth(readings_of(stops, values, stated))


def clock(by: Stranger, count: int) -> tuple[Columns, list[float]]:
    """A column of times or two, and seconds since the first."""
    every = float(by.pick((5, 10, 20, 30, 60)))
    seconds = np.round(np.cumsum(by.rng.uniform(0.7 * every, 1.3 * every, count)), 1)
    seconds -= seconds[0]
    if by.chance(0.35):
        return {by.word("SECONDS"): [decimal(s, 1) for s in seconds]}, seconds.tolist()
    whole = seconds.round().tolist()
    moments, style = [START + datetime.timedelta(seconds=s) for s in whole], by.rng.random()
    date, time, day = WORDS["DATE_TIME"][by.language]
    if style < 0.2:
        return {date: [m.strftime(day) for m in moments], time: [f"{m:%H:%M:%S}" for m in moments]}, whole
    forms = {"de": "%d.%m.%Y %H:%M:%S", "en": "%I:%M:%S %p"}
    form = forms[by.language] if by.language in forms and style > 0.7 else f"{'%Y-%m-%d ' * (style < 0.5)}%H:%M:%S"
    return {by.word("CLOCK"): [moment.strftime(form) for moment in moments]}, whole


def u_column(by: Stranger, axis: Axis, count: int) -> tuple[Columns, list[float]]:
    """Uncertainties, standard or expanded, mostly in a unit of their own; and as standard ones in that of the axis."""
    expanded = by.chance(0.55)
    small = [unit for unit in ("um", "thou", "mm", "arcsec", "mrad", "deg") if DOMAIN[unit] == DOMAIN[axis.unit]]
    unit = axis.unit if by.chance(0.4) else by.pick(small)
    standard = axis.scatter * by.rng.uniform(0.5, 1.5) * SCALE[axis.unit] / SCALE[unit]
    cell = decimal((1 + expanded) * standard, max(0, 1 - int(np.floor(np.log10(standard)))))
    name = by.word("EXPANDED_U" if expanded else "STANDARD_U")
    # "U (k=2)_um" is nobody's.
    head = f"{name} ({by.unit(unit)})" if "(" in name or name[0].isdigit() else by.with_unit(name, unit)
    # Each of its own, in multiples of the least.
    times = by.rng.integers(1, 4, count) if by.chance(0.4) else np.ones(count, int)
    factor = SCALE[unit] / SCALE[axis.unit] / (1 + expanded)
    return {head: [cell * int(n) for n in times]}, [float(cell) * int(n) * factor for n in times]


def deviations_of(axis: Axis, commands: Sequence[Decimal], values: Sequence[Decimal], unit: str) -> list[Decimal]:
    """Actual less commanded position in a unit."""
    scale = SCALE[axis.command_unit] / SCALE[axis.unit]
    off = [float(v) - scale * float(c) for c, v in zip(commands, values, strict=True)]
    return [decimal(error * SCALE[axis.unit] / SCALE[unit], max(DIGITS[unit], 1)) for error in off]


def long_table(by: Stranger) -> Drawn:
    """A row for each reading, with further columns; nothing in them follows the commands."""
    axis, stated = draw_axis(by, variety=True), by.chance(0.5)
    stops = sweep(by, axis.commands, stated)
    values, count, (command, reading) = axis.read(stops, by), len(stops), by.names(axis)
    readings, more, truth = readings_of(stops, values, stated), {}, axis.truth(())
    if by.chance(0.25):
        more[by.word("NUMBER")] = [Decimal(k + 1) for k in range(count)]
    if by.chance(0.3):
        timed, seconds = clock(by, count)
        more |= timed
        readings = [r._replace(time_s=s) for r, s in zip(readings, seconds, strict=True)]
        # A stop that was read twice has one time.
        truth = replace(truth, clock=80.0 if any(a == b for a, b in pairwise(stops)) else 1.1)
    cycles = [stop.run // 2 for stop in stops]
    if by.chance(0.12):
        more[by.word("CYCLE")] = [Decimal(n + 1) for n in cycles]
        truth = replace(truth, cycles=True)
    elif stated and by.chance(0.1):
        more[by.word("HOMING")] = [Decimal(n + 1) for n in cycles]
        readings = [r._replace(segment=n) for r, n in zip(readings, cycles, strict=True)]
    columns: Columns = {by.with_unit(command, axis.command_unit): [stop.command for stop in stops]}
    columns |= directions(by, stops) if stated else {}
    # One that was not read.
    cells: list[Cell] = list(values)
    gone = {int(by.rng.integers(1, count - 1))} if by.chance(0.08) else set()
    nothing = by.pick(("", "", "", "n/a", "NaN", "-", "--", "#N/A"))
    for k in gone:
        cells[k] = nothing
    columns[by.with_unit(reading, axis.unit)] = cells
    if by.chance(0.25):
        stated_u, us = u_column(by, axis, count)
        columns |= stated_u
        readings = [r._replace(u=u) for r, u in zip(readings, us, strict=True)]
    if by.chance(0.2) and DOMAIN[axis.command_unit] == DOMAIN[axis.unit]:
        unit = axis.unit if by.chance(0.5) else "um" if DOMAIN[axis.unit] == "mm" else "arcsec"
        errors = deviations_of(axis, [stop.command for stop in stops], values, unit)
        sign = by.pick((1, 1, 1, 1, -1))
        columns[by.with_unit(by.word("DEVIATION"), unit)] = [sign * error for error in errors]
    if by.chance(0.25):
        columns[by.word("TEMPERATURE")] = [decimal(20.3 + d, 2) for d in np.cumsum(by.rng.normal(0, 0.02, count))]
    if by.chance(0.25):
        middle = by.rng.uniform(5, 60)
        columns[by.word("OTHER")] = [decimal(middle + d, 1) for d in by.rng.normal(0, 0.4, count)]
    if by.chance(0.15):
        columns[by.word("COMMENT")] = [by.word("REMARKS") for _ in range(count)]
    if by.chance(0.15):
        (name, good, bad), wrong = by.word("STATUS"), by.rng.choice(count, int(by.rng.integers(0, 3)), replace=False)
        columns[name] = [bad if k in wrong else good for k in range(count)]
        gone |= set(wrong.tolist())
    items = list((more | columns).items())
    if by.chance(0.15):
        # The order of columns tells nothing.
        items = [items[k] for k in by.rng.permutation(len(items))]
    left = tuple(r for k, r in enumerate(readings) if k not in gone)
    return Drawn("a row for each reading", any_file(by, Sheet.of(dict(items))), replace(truth, readings=left))


def unit_row(by: Stranger) -> Drawn:
    """Names, and units in a row of their own below."""
    axis = draw_axis(by)
    columns, truth = plain(by, axis, bare=True)
    form, sheet = by.pick(("{}", "({})", "[{}]")), Sheet.of(columns)
    first = "" if axis.command_unit == "step" else form.format(by.unit(axis.command_unit))
    sheet.heads.append([first, *[""] * (len(columns) - 2), form.format(by.unit(axis.unit))])
    return Drawn("units in a row of their own", any_file(by, sheet), truth)


def two_sensors(by: Stranger) -> Drawn:
    """Two columns follow the commands: a laser and an encoder. The first was meant."""
    axis = draw_axis(by)
    columns, truth = plain(by, axis)
    ratio = axis.per_command * (1 + by.rng.normal(0, 1e-3))
    other = replace(axis, per_command=ratio, play=axis.play * by.rng.uniform(0, 2))
    stops = [Stop(Decimal(repr(r.command)), r.side, 0) for r in truth.readings]
    columns[by.with_unit(by.word("SECOND_SENSOR"), axis.unit)] = other.read(stops, by)
    kind = "two columns follow the commands"
    return Drawn(kind, any_file(by, Sheet.of(columns)), replace(truth, answer="ask"))


def unknown_unit(by: Stranger) -> Drawn:
    """A unit in brackets that nobody knows, of somebody's dial. Any answer leaves the numbers as they are."""
    axis = draw_axis(by, rotary=False, unit="1/100 mm")
    columns, truth = plain(by, axis, named=by.pick(WORDS["UNKNOWN_UNITS"]), stated=False)
    truth = replace(truth, answer="ask", unit=None, meant=axis.unit)
    return Drawn("a unit that nobody knows", any_file(by, Sheet.of(columns)), truth)


def no_unit(by: Stranger) -> Drawn:
    """Steps and a reading without any unit."""
    axis = draw_axis(by, command_unit="step", variety=True)
    columns, truth = plain(by, axis, bare=True, stated=False)
    truth = replace(truth, answer="either", unit=None, command_unit=None)
    return Drawn("no unit at all", any_file(by, Sheet.of(columns)), truth)


def reading_without_unit(by: Stranger) -> Drawn:
    """The unit of the commands alone is named; the reading's is the same, or 1/100 mm or um, as its size says."""
    unit = by.pick(("mm", "mm", "um", "1/100 mm"))
    columns, truth = plain(by, draw_axis(by, rotary=False, unit=unit, command_unit="mm"), named=None)
    kind = f"a reading without unit beside mm, {'the same' if unit == 'mm' else 'another'}"
    return Drawn(kind, any_file(by, Sheet.of(columns)), replace(truth, answer="either" if unit == "mm" else "ask"))


def unit_above(by: Stranger) -> Drawn:
    """The unit stands in a line above the names alone."""
    unit = by.pick(("mm", "inch"))
    axis = draw_axis(by, rotary=False, unit=unit, command_unit=by.pick((unit, "step")))
    columns, truth = plain(by, axis, bare=True, stated=False)
    sheet = Sheet.of(columns)
    sheet.above = [*preamble(by), f"{WORDS['ALL_IN'][by.language]} {by.unit(axis.unit)}", ""]
    return Drawn("the unit above the names alone", any_file(by, sheet), replace(truth, answer="either"))


def by_position(by: Stranger) -> Drawn:
    """A sheet by position and side, with several readings of each, of an axis that may have been compensated."""
    axis, _ = same_domain_axis(by)
    kind = by.pick(("by position and side", "a compensated axis"))
    if kind == "a compensated axis":
        # Readings barely differ from the targets, and forward ones from backward ones.
        scatter = max(axis.scatter, 0.7 * axis.digit)
        play = scatter * by.rng.uniform(0, 1)
        axis = replace(axis, per_command=1.0, zero=0.0, scatter=scatter, play=play)
    count = int(by.rng.integers(2, 6))
    stops = [Stop(command, side, 0) for command in axis.commands for side in (1, -1) for _ in range(count)]
    values, (command, reading) = axis.read(stops, by), by.names(axis)
    columns: Columns = {by.with_unit(command, axis.command_unit): [stop.command for stop in stops]}
    columns |= {**directions(by, stops), by.with_unit(reading, axis.unit): values}
    return Drawn(kind, any_file(by, Sheet.of(columns)), axis.truth(readings_of(stops, values, True)))


class Runs(NamedTuple):
    """Runs over the same positions in the order in which they were made; values in the order of `axis.commands`."""

    axis: Axis
    sides: tuple[int, ...]
    values: list[list[Decimal]]

    @classmethod
    def of(cls, by: Stranger, axis: Axis, sides: Sequence[int]) -> Runs:
        """Every run is approached from beyond its first position."""
        return cls(axis, tuple(sides), [axis.read([Stop(c, side, 0) for c in axis.commands], by) for side in sides])

    def readings(self, values: Sequence[Sequence[float]] | None = None) -> list[Reading]:
        """In the order of time: a rising run begins below, a falling one above; of other values if they are given."""
        told = []
        for side, of in zip(self.sides, self.values if values is None else values, strict=True):
            told += [Reading(float(c), float(v), side) for c, v in zip(self.axis.commands, of, strict=True)][::side]
        return told

    def sheet(self, by: Stranger, names: Sequence[str], values: Sequence[Sequence[Decimal]], unit: str) -> Sheet:
        """A row for each position, a column for each run; the unit at every head, or at the positions' alone."""
        once = unit == self.axis.command_unit and values is self.values and by.chance(0.25)
        form, text = by.pick(("{} ({})", "{} [{}]", "{} / {}")), by.unit(unit)
        heads = [by.with_unit(by.names(self.axis)[0], self.axis.command_unit)]
        heads += names if once else [form.format(name, text) for name in names]
        rows: list[list[Cell]] = [list(row) for row in zip(self.axis.commands, *values, strict=True)]
        if by.chance(0.1):
            rows.reverse()
        if by.chance(0.2):
            heads, rows = [by.word("NUMBER"), *heads], [[Decimal(k + 1), *row] for k, row in enumerate(rows)]
        return Sheet([heads], rows)


def runs_with_words(by: Stranger) -> Drawn:
    """Forward 1, Backward 1, Forward 2 ..., or one way alone; or, in two lines of names, the run above."""
    axis, pair, pairs = draw_axis(by, variety=True), by.word("RUN_SIDES"), int(by.rng.integers(1, 4))
    sides = (1, -1) * pairs if by.chance(0.85) or pairs == 1 else (1,) * (pairs + 1)
    order = [1 + sides[:k].count(side) for k, side in enumerate(sides)]
    runs = Runs.of(by, axis, sides)
    if grouped := -1 in sides and pairs > 1 and by.chance(0.25):
        names = [pair[side < 0] for side in sides]
    else:
        form = by.pick(("{} {}", "{} {}", "{}{}", "{} #{}", "{}_{}"))
        form = by.pick((by.word("RUN") + " {1} {0}", "{1} {0}", "{1}{0}")) if len(pair[0]) == 1 else form
        alone = len(sides) == 2 and by.chance(0.5)
        names = [pair[s < 0] if alone else form.format(pair[s < 0], k) for s, k in zip(sides, order, strict=True)]
    sheet = runs.sheet(by, names, runs.values, axis.unit)
    if grouped:
        word = by.word("RUN")
        above = [f"{word} {k}" if side > 0 else "" for side, k in zip(sides, order, strict=True)]
        sheet.heads = [[""] * (len(sheet.heads[0]) - len(sides)) + above, *sheet.heads]
    kind = "two lines of names" if grouped else "runs side by side, with words of direction"
    return Drawn(kind, any_file(by, sheet), axis.truth(runs.readings()))


def turning_runs(by: Stranger) -> Drawn:
    """CW 1, CCW 1 ...: which of them rises follows from the order of the columns alone, the first rising."""
    axis, pair, pairs = draw_axis(by, rotary=True), by.word("TURNS"), int(by.rng.integers(1, 3))
    runs = Runs.of(by, axis, (1, -1) * pairs)
    sheet = runs.sheet(by, [f"{word} {k + 1}" for k in range(pairs) for word in pair], runs.values, axis.unit)
    truth = axis.truth(runs.readings(), answer="either")
    return Drawn("runs side by side, clockwise and not", any_file(by, sheet), truth)


def unnamed_runs(by: Stranger) -> Drawn:
    """Run 1, Run 2 ...: all rising, which their agreement tells; or every second one falls, which nothing says."""
    axis, rising = draw_axis(by), by.chance(0.6)
    runs = Runs.of(by, axis, (1,) * int(by.rng.integers(2, 6)) if rising else (1, -1) * int(by.rng.integers(1, 4)))
    word, form = by.word("RUN"), by.pick(("{} {}", "{} {}", "{}{}", "{} #{}", "{}_{}", "{1}", "ref_pos(i,{1})"))
    sheet = runs.sheet(by, [form.format(word, k + 1) for k in range(len(runs.sides))], runs.values, axis.unit)
    truth = axis.truth(runs.readings(), answer="either" if rising else "ask")
    return Drawn(f"runs side by side, unnamed, {'all rising' if rising else 'to and fro'}", any_file(by, sheet), truth)


def same_domain_axis(by: Stranger) -> tuple[Axis, str]:
    """An axis driven in the unit of its positions, and a small unit of its deviations."""
    unit = by.pick(("deg", "mm", "mm", "inch"))
    small = {"deg": ("arcsec", "arcsec", "mrad", "arcmin"), "mm": ("um", "um", "1/100 mm", "mm"), "inch": ("thou",)}
    return draw_axis(by, unit == "deg", unit, unit), by.pick(small[unit])


def deviations(by: Stranger) -> Drawn:
    """A target, a direction and a deviation, or deviations of runs side by side: positions are nowhere."""
    axis, unit = same_domain_axis(by)
    pair, pairs = by.word("RUN_SIDES"), int(by.rng.integers(1, 4))
    runs = Runs.of(by, axis, (1, -1) * pairs)
    errors = [deviations_of(axis, axis.commands, values, unit) for values in runs.values]
    # Command plus deviation, in the unit of the commands.
    shift = SCALE[unit] / SCALE[axis.command_unit]
    positions = [[float(c) + shift * float(e) for c, e in zip(axis.commands, of, strict=True)] for of in errors]
    truth = axis.truth(runs.readings(positions), answer="ask", ratio=1.0)
    truth = replace(truth, digit=10.0 ** -max(DIGITS[unit], 1) * shift)
    # That they are deviations may follow from their size alone.
    unsaid = unit not in ("mm", "deg") and by.chance(0.3)
    name = by.names(axis)[1] if unsaid else by.word("DEVIATION")
    if by.chance(0.5):
        names = [f"{'' if unsaid else name + ' '}{word} {k + 1}" for k in range(pairs) for word in pair]
        sheet, kind = runs.sheet(by, names, errors, unit), "deviations of runs side by side"
    else:
        stops = [Stop(c, side, 0) for side in runs.sides for c in axis.commands[::side]]
        told = [error for side, of in zip(runs.sides, errors, strict=True) for error in of[::side]]
        columns: Columns = {by.with_unit(by.names(axis)[0], axis.command_unit): [stop.command for stop in stops]}
        sheet = Sheet.of(columns | directions(by, stops) | {by.with_unit(name, unit): told})
        kind = "deviations alone"
    return Drawn(kind + ", not called so" * unsaid, any_file(by, sheet), truth)


DRAWS: dict[Callable[[Stranger], Drawn], float] = {
    **{long_table: 38, unit_row: 6, two_sensors: 4, unknown_unit: 2, no_unit: 2, by_position: 5},
    **{reading_without_unit: 1.5, unit_above: 1.5, runs_with_words: 24, turning_runs: 1.5, unnamed_runs: 5},
    deviations: 6,
}
"""Weights of the kinds."""
