"""Tables of one axis with a row for each reading."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import replace
from decimal import Decimal
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from experiments.inputs.strangers_tables import sheets
from experiments.inputs.strangers_tables.measured import (
    DIGITS,
    DOMAIN,
    LENGTH,
    SCALE,
    UNKNOWN_UNITS,
    WORDS,
    Axis,
    Reading,
    Stranger,
    Sweep,
    Truth,
    decimal,
    draw_axis,
    sweeps,
)
from experiments.inputs.strangers_tables.sheets import Cell, Columns, File, Sheet

START = datetime.datetime(2026, 3, 12, 9, 5, 10)


class Drawn(NamedTuple):
    """A table of a kind, and what it says."""

    kind: str
    file: File
    truth: Truth
    words: tuple[str, ...] = ("--axis",)


def driven(
    by: Stranger, axis: Axis, stated: bool = False, variety: bool = False
) -> tuple[Sweep, list[Decimal], list[Reading]]:
    """An axis driven through its positions: the sweep, values as written, and as they are."""
    sweep = sweeps(by, axis.commands, stated, variety)
    values = [axis.value(stop.command, stop.side, by) for stop in sweep.stops]
    pairs = enumerate(zip(sweep.stops, values, strict=True))
    return sweep, values, [Reading(float(s.command), float(v), sweep.told_side(k)) for k, (s, v) in pairs]


def truth_of(axis: Axis, readings: Sequence[Reading], **more: Any) -> Truth:
    """The truth of an axis read in its own units."""
    command_unit = axis.command_unit
    return replace(
        Truth(tuple(readings), axis.unit, command_unit, axis.digit, ratio=axis.per_command, play=axis.play), **more
    )


def clock(by: Stranger, count: int) -> tuple[Columns, list[float]]:
    """Columns of times by their names, and seconds since the first."""
    every = float(by.pick((5, 10, 20, 30, 60)))
    seconds = np.round(np.cumsum(by.rng.uniform(0.7 * every, 1.3 * every, count)), 1)
    seconds -= seconds[0]
    if by.chance(0.35):
        return {by.word("SECONDS"): [decimal(s, 1) for s in seconds]}, list(map(float, seconds))
    whole = [float(round(s)) for s in seconds]
    moments = [START + datetime.timedelta(seconds=s) for s in whole]
    name, style = by.word("CLOCK"), by.rng.random()
    if style < 0.2:
        date = {"en": "Date", "de": "Datum", "es": "Fecha", "fr": "Date"}[by.language]
        name = {"en": "Time", "de": "Uhrzeit", "es": "Hora", "fr": "Heure"}[by.language]
        form = "%Y-%m-%d" if by.language == "en" else "%d.%m.%Y" if by.language == "de" else "%d/%m/%Y"
        days: list[Cell] = [moment.strftime(form) for moment in moments]
        return {date: days, name: [moment.strftime("%H:%M:%S") for moment in moments]}, whole
    form = "%Y-%m-%d %H:%M:%S" if style < 0.6 else "%H:%M:%S"
    if by.language == "de" and by.chance(0.5):
        form = "%d.%m.%Y %H:%M:%S"
    if by.language == "en" and by.chance(0.2):
        form = "%I:%M:%S %p"
    return {name: [moment.strftime(form) for moment in moments]}, whole


def u_column(by: Stranger, axis: Axis) -> tuple[str, Decimal, float]:
    """Its name, the number that stands in it, and the standard uncertainty in the unit of the readings."""
    expanded = by.chance(0.55)
    name = by.pick((WORDS["EXPANDED_U"] if expanded else WORDS["STANDARD_U"])[by.language])
    same = [unit for unit in ("um", "thou", "mm", "arcsec", "mrad", "deg") if DOMAIN[unit] == DOMAIN[axis.unit]]
    unit = axis.unit if by.chance(0.4) or not same else by.pick(same)
    standard = axis.scatter * by.rng.uniform(0.5, 1.5) * SCALE[axis.unit] / SCALE[unit]
    cell = decimal((1 + expanded) * standard, max(0, 1 - int(np.floor(np.log10(standard)))))
    text = by.with_unit(name, unit) if name.isascii() else f"{name} ({by.unit(unit)})"
    # "U (k=2)_um" is nobody's.
    if "(" in name or name[0].isdigit():
        text = f"{name} ({by.unit(unit)})" if by.chance(0.7) else f"{name} [{by.unit(unit)}]"
    return text, cell, float(cell) / (1 + expanded) * SCALE[unit] / SCALE[axis.unit]


def long_sheet(by: Stranger, axis: Axis) -> tuple[Sheet, Truth]:
    """A row for each reading, with further columns; nothing in them follows the commands."""
    stated = by.chance(0.5)
    sweep, values, readings = driven(by, axis, stated, variety=True)
    count = len(readings)
    more: Columns = {}
    columns: Columns = {}
    truth = truth_of(axis, readings)
    if by.chance(0.25):
        more[by.word("NUMBER")] = [Decimal(k + 1) for k in range(count)]
    if by.chance(0.3):
        timed, seconds = clock(by, count)
        more |= timed
        readings = [r._replace(time_s=s) for r, s in zip(readings, seconds, strict=True)]
        # A stop that was read twice has one time.
        truth = replace(truth, clock=80.0 if any(a[:3] == b[:3] for a, b in pairwise(sweep.stops)) else 1.1)
    if by.chance(0.12):
        name = by.word("CYCLE")
        more[name] = [Decimal(stop.run // 2 + 1) for stop in sweep.stops]
        truth = replace(truth, segments="any")
    elif by.chance(0.1) and stated:
        numbers = [stop.run // 2 for stop in sweep.stops]
        marks = [Decimal(k == 0 or numbers[k] != numbers[k - 1]) for k in range(count)]
        name = by.word("HOMING")
        counted = name.endswith(".") or by.chance(0.7)
        more[name] = [Decimal(n + 1) for n in numbers] if counted else marks
        readings = [r._replace(segment=n) for r, n in zip(readings, numbers, strict=True)]
    command, reading = by.names(axis)
    columns[by.headed(command, axis.command_unit)] = [stop.command for stop in sweep.stops]
    if stated:
        pair = by.pick(WORDS["SIDES"]["all"] if by.chance(0.35) else by.words("SIDES"))
        if DOMAIN[axis.unit] == "deg" and by.chance(0.15):
            pair, truth = by.pick(WORDS["TURNS"]), replace(truth, answer="either")
        sides = [Decimal(word) if word in ("1", "-1") else word for word in pair]
        columns |= by.sides_column(sides, [stop.side for stop in sweep.stops])
    # Positions that were passed, or not read.
    cells: list[Cell] = list(values)
    empty = {k for k, stop in enumerate(sweep.stops) if not stop.read}
    empty |= {int(by.rng.integers(1, count - 1))} if by.chance(0.08) else set()
    nothing = by.pick(("", "", "", "n/a", "NaN", "-", "--", "#N/A"))
    for k in empty:
        cells[k] = nothing
    after, readings = further_columns(by, axis, sweep, values, readings, empty)
    columns[by.headed(reading, axis.unit)] = cells
    columns |= after
    items = list((more | columns).items())
    if by.chance(0.15):
        # The order of columns tells nothing.
        items = [items[k] for k in by.rng.permutation(len(items))]
    return sheets.columns_sheet(dict(items)), replace(truth, readings=tuple(readings))


def further_columns(
    by: Stranger,
    axis: Axis,
    sweep: Sweep,
    values: Sequence[Decimal],
    readings: Sequence[Reading],
    gone: set[int],
) -> tuple[Columns, list[Reading]]:
    """Columns to the right of the reading, and the readings with what these say of them."""
    count, readings = len(readings), list(readings)
    columns: Columns = {}
    if by.chance(0.25):
        name, cell, u = u_column(by, axis)
        # Each of its own, in multiples of the least.
        times = by.rng.integers(1, 4, count) if by.chance(0.4) else np.ones(count, int)
        columns[name] = [cell * int(n) for n in times]
        readings = [r._replace(u=u * int(n)) for r, n in zip(readings, times, strict=True)]
    if by.chance(0.2) and DOMAIN[axis.command_unit] == DOMAIN[axis.unit] and not axis.geared:
        columns |= error_column(by, axis, sweep, values)
    if by.chance(0.25):
        drift = np.cumsum(by.rng.normal(0, 0.02, count))
        columns[by.word("TEMPERATURE")] = [decimal(20.3 + d, 2) for d in drift]
    if by.chance(0.25):
        middle = by.rng.uniform(5, 60)
        columns[by.word("OTHER")] = [decimal(middle + d, 1) for d in by.rng.normal(0, 0.4, count)]
    if by.chance(0.15):
        columns[by.word("COMMENT")] = [by.word("REMARKS") for _ in range(count)]
    if by.chance(0.15):
        name, good, bad = by.word("STATUS")
        wrong = set(by.rng.choice(count, int(by.rng.integers(0, 3)), replace=False).tolist())
        cells = [bad if k in wrong else good for k in range(count)]
        columns[name] = [Decimal(cell) if cell.isdigit() else cell for cell in cells]
        gone = gone | wrong
    return columns, [r for k, r in enumerate(readings) if k not in gone]


def error_column(by: Stranger, axis: Axis, sweep: Sweep, values: Sequence[Decimal]) -> Columns:
    """Actual less target, or target less actual, in a unit of its own; beside the reading, so that it is no reading."""
    small = "um" if axis.unit in LENGTH else "arcsec"
    unit = axis.unit if by.chance(0.5) else small
    sign = 1 if by.chance(0.8) else -1
    scale = SCALE[axis.command_unit] / SCALE[axis.unit]
    errors = [float(v) - scale * float(stop.command) for v, stop in zip(values, sweep.stops, strict=True)]
    name = by.with_unit(by.word("DEVIATION"), unit)
    return {name: [decimal(sign * e * SCALE[axis.unit] / SCALE[unit], DIGITS[unit]) for e in errors]}


def long_table(by: Stranger) -> Drawn:
    """A row for each reading."""
    sheet, truth = long_sheet(by, draw_axis(by, variety=True))
    return Drawn("a row for each reading", sheets.any_file(by, sheet), truth)


def unit_row(by: Stranger) -> Drawn:
    """Names, and units in a row of their own below."""
    axis = draw_axis(by)
    stated = by.chance(0.5)
    sweep, values, readings = driven(by, axis, stated)
    form = by.pick(("{}", "({})", "[{}]"))
    heads = [list(by.names(axis))]
    command_unit = "" if axis.command_unit == "step" else form.format(by.unit(axis.command_unit))
    heads.append([command_unit, form.format(by.unit(axis.unit))])
    rows: list[list[Cell]] = [[stop.command, value] for stop, value in zip(sweep.stops, values, strict=True)]
    if stated:
        pair = by.word("SIDES")
        heads = [[*heads[0], by.word("DIRECTION")], [*heads[1], ""]]
        rows = [[*row, pair[stop.side < 0]] for row, stop in zip(rows, sweep.stops, strict=True)]
    return Drawn("units in a row of their own", sheets.any_file(by, Sheet(heads, rows)), truth_of(axis, readings))


def two_sensors(by: Stranger) -> Drawn:
    """Two columns follow the commands: a laser and an encoder. The first was meant."""
    axis = draw_axis(by)
    stated = by.chance(0.5)
    sweep, values, readings = driven(by, axis, stated)
    other = replace(
        axis, per_command=axis.per_command * (1 + by.rng.normal(0, 1e-3)), play=axis.play * by.rng.uniform(0, 2)
    )
    command, reading = by.names(axis)
    columns: Columns = {by.headed(command, axis.command_unit): [s.command for s in sweep.stops]}
    if stated:
        pair = by.word("SIDES")
        columns |= by.sides_column(pair, [stop.side for stop in sweep.stops])
    columns[by.headed(reading, axis.unit)] = values
    name = by.with_unit(by.word("SECOND_SENSOR"), axis.unit)
    columns[name] = [other.value(stop.command, stop.side, by) for stop in sweep.stops]
    truth = truth_of(axis, readings, answer="ask")
    return Drawn("two columns follow the commands", sheets.columns_file(by, columns), truth)


def unknown_unit(by: Stranger) -> Drawn:
    """A unit in brackets that nobody knows: a division of somebody's dial."""
    axis = draw_axis(by, rotary=False, unit="1/100 mm")
    sweep, values, readings = driven(by, axis)
    form = by.pick(("{} ({})", "{} [{}]"))
    command, reading = by.names(axis)
    columns: Columns = {
        by.headed(command, axis.command_unit): [s.command for s in sweep.stops],
        form.format(reading, by.pick(UNKNOWN_UNITS)): values,
    }
    # Any answer that leaves the numbers as they are.
    truth = truth_of(axis, readings, answer="ask", unit=None, meant=axis.unit)
    return Drawn("a unit that nobody knows", sheets.columns_file(by, columns), truth)


def no_unit(by: Stranger) -> Drawn:
    """Steps and a reading without any unit."""
    axis = draw_axis(by, command_unit="step", variety=True)
    sweep, values, readings = driven(by, axis)
    columns: Columns = {
        by.word("STEPS"): [stop.command for stop in sweep.stops],
        by.names(axis)[1]: values,
    }
    truth = truth_of(axis, readings, answer="either", unit=None, command_unit=None)
    return Drawn("no unit at all", sheets.columns_file(by, columns), truth)


def reading_without_unit(by: Stranger) -> Drawn:
    """The unit of the commands alone is named; the reading's is the same, or 1/100 mm or um, as its size says."""
    unit = by.pick(("mm", "mm", "um", "1/100 mm"))
    axis = draw_axis(by, rotary=False, unit=unit, command_unit="mm")
    stated = by.chance(0.4)
    sweep, values, readings = driven(by, axis, stated)
    command, reading = by.names(axis)
    columns: Columns = {by.with_unit(command, "mm"): [s.command for s in sweep.stops]}
    if stated:
        pair = by.word("SIDES")
        columns |= by.sides_column(pair, [stop.side for stop in sweep.stops])
    columns[reading] = values
    truth = truth_of(axis, readings, answer="either" if unit == "mm" else "ask")
    kind = f"a reading without unit beside mm, {'the same' if unit == 'mm' else 'another'}"
    return Drawn(kind, sheets.columns_file(by, columns), truth)


def unit_above(by: Stranger) -> Drawn:
    """The unit stands in a line above the names alone."""
    axis = draw_axis(by, rotary=False, unit=by.pick(("mm", "inch")), command_unit=None)
    axis = replace(axis, command_unit="step") if axis.command_unit != axis.unit else axis
    sweep, values, readings = driven(by, axis)
    command, reading = by.names(axis)
    sheet = sheets.columns_sheet({command: [s.command for s in sweep.stops], reading: values})
    label = {"en": "All values in", "de": "Alle Werte in", "es": "Valores en", "fr": "Valeurs en"}[by.language]
    sheet.above = [*sheets.preamble(by), f"{label} {by.unit(axis.unit)}", ""]
    truth = truth_of(axis, readings, answer="either")
    return Drawn("the unit above the names alone", sheets.any_file(by, sheet), truth)
