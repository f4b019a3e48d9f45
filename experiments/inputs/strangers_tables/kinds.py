"""Tables of one axis with a row for each reading."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import replace
from decimal import Decimal
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from experiments.inputs.strangers_tables import sheets, words
from experiments.inputs.strangers_tables.measured import (
    DIGITS,
    DOMAIN,
    LENGTH,
    SCALE,
    UNKNOWN_UNITS,
    Axis,
    Reading,
    Sweep,
    Truth,
    chance,
    decimal,
    draw_axis,
    pick,
    sweeps,
    unit_text,
    with_unit,
)
from experiments.inputs.strangers_tables.sheets import Cell, File, Sheet

START = datetime.datetime(2026, 3, 12, 9, 5, 10)


class Drawn(NamedTuple):
    """A table of a kind, and what it says."""

    kind: str
    file: File
    truth: Truth
    words: tuple[str, ...] = ("--axis",)


def names_of(rng: np.random.Generator, axis: Axis, language: str) -> tuple[str, str]:
    """Names of command and reading, without units."""
    steps, angles = axis.command_unit == "step", DOMAIN[axis.unit] == "deg"
    if axis.geared:
        return pick(rng, words.MOTOR[language]), pick(rng, words.OUTPUT[language])
    if not steps and axis.command_unit != "turn" and chance(rng, 0.3):
        return pick(rng, words.PAIRS[language])
    if steps or axis.command_unit == "turn":
        command = pick(rng, (words.STEPS if steps else words.MOTOR)[language])
    else:
        command = pick(rng, (words.ANGLE_COMMAND if angles and chance(rng, 0.7) else words.COMMAND)[language])
    return command, pick(rng, (words.ANGLE_READING if angles else words.LENGTH_READING)[language])


def headed(rng: np.random.Generator, name: str, unit: str, language: str) -> str:
    """With its unit; counters mostly without."""
    return name if unit == "step" and chance(rng, 0.8) else with_unit(rng, name, unit, language)


def read_all(rng: np.random.Generator, axis: Axis, sweep: Sweep) -> tuple[list[Decimal], list[Reading]]:
    """Values as written, and as they are."""
    values = [axis.value(stop.command, stop.side, rng) for stop in sweep.stops]
    readings = [
        Reading(float(stop.command), float(value), sweep.told_side(k))
        for k, (stop, value) in enumerate(zip(sweep.stops, values, strict=True))
    ]
    return values, readings


def truth_of(axis: Axis, readings: Sequence[Reading], **more: Any) -> Truth:
    """The truth of an axis read in its own units."""
    command_unit = axis.command_unit
    return replace(
        Truth(tuple(readings), axis.unit, command_unit, axis.digit, ratio=axis.per_command, play=axis.play), **more
    )


def clock(rng: np.random.Generator, language: str, count: int) -> tuple[dict[str, Sequence[Cell]], list[float]]:
    """Columns of times by their names, and seconds since the first."""
    every = float(pick(rng, (5, 10, 20, 30, 60)))
    seconds = np.round(np.cumsum(rng.uniform(0.7 * every, 1.3 * every, count)), 1)
    seconds -= seconds[0]
    if chance(rng, 0.35):
        return {pick(rng, words.SECONDS[language]): [decimal(s, 1) for s in seconds]}, list(map(float, seconds))
    whole = [float(round(s)) for s in seconds]
    moments = [START + datetime.timedelta(seconds=s) for s in whole]
    name, style = pick(rng, words.CLOCK[language]), rng.random()
    if style < 0.2:
        date = {"en": "Date", "de": "Datum", "es": "Fecha", "fr": "Date"}[language]
        name = {"en": "Time", "de": "Uhrzeit", "es": "Hora", "fr": "Heure"}[language]
        form = "%Y-%m-%d" if language == "en" else "%d.%m.%Y" if language == "de" else "%d/%m/%Y"
        days: list[Cell] = [moment.strftime(form) for moment in moments]
        return {date: days, name: [moment.strftime("%H:%M:%S") for moment in moments]}, whole
    form = "%Y-%m-%d %H:%M:%S" if style < 0.6 else "%H:%M:%S"
    if language == "de" and chance(rng, 0.5):
        form = "%d.%m.%Y %H:%M:%S"
    if language == "en" and chance(rng, 0.2):
        form = "%I:%M:%S %p"
    return {name: [moment.strftime(form) for moment in moments]}, whole


def u_column(rng: np.random.Generator, axis: Axis, language: str) -> tuple[str, Decimal, float]:
    """Its name, the number that stands in it, and the standard uncertainty in the unit of the readings."""
    expanded = chance(rng, 0.55)
    name = pick(rng, (words.EXPANDED_U if expanded else words.STANDARD_U)[language])
    same = [unit for unit in ("um", "thou", "mm", "arcsec", "mrad", "deg") if DOMAIN[unit] == DOMAIN[axis.unit]]
    unit = axis.unit if chance(rng, 0.4) or not same else pick(rng, same)
    standard = axis.scatter * rng.uniform(0.5, 1.5) * SCALE[axis.unit] / SCALE[unit]
    cell = decimal((1 + expanded) * standard, max(0, 1 - int(np.floor(np.log10(standard)))))
    text = with_unit(rng, name, unit, language) if name.isascii() else f"{name} ({unit_text(rng, unit, language)})"
    # "U (k=2)_um" is nobody's.
    if "(" in name or name[0].isdigit():
        text = (
            f"{name} ({unit_text(rng, unit, language)})"
            if chance(rng, 0.7)
            else f"{name} [{unit_text(rng, unit, language)}]"
        )
    return text, cell, float(cell) / (1 + expanded) * SCALE[unit] / SCALE[axis.unit]


def long_sheet(rng: np.random.Generator, axis: Axis, language: str) -> tuple[Sheet, Truth]:
    """A row for each reading, with further columns; nothing in them follows the commands."""
    stated = chance(rng, 0.5)
    sweep = sweeps(rng, axis.commands, stated, variety=True)
    values, readings = read_all(rng, axis, sweep)
    count = len(readings)
    more: dict[str, Sequence[Cell]] = {}
    columns: dict[str, Sequence[Cell]] = {}
    truth = truth_of(axis, readings)
    if chance(rng, 0.25):
        more[pick(rng, words.NUMBER[language])] = [Decimal(k + 1) for k in range(count)]
    if chance(rng, 0.3):
        timed, seconds = clock(rng, language, count)
        more |= timed
        readings = [r._replace(time_s=s) for r, s in zip(readings, seconds, strict=True)]
        # A stop that was read twice has one time.
        truth = replace(truth, clock=80.0 if any(a[:3] == b[:3] for a, b in pairwise(sweep.stops)) else 1.1)
    if chance(rng, 0.12):
        name = pick(rng, words.CYCLE[language])
        more[name] = [Decimal(stop.run // 2 + 1) for stop in sweep.stops]
        truth = replace(truth, segments="any")
    elif chance(rng, 0.1) and stated:
        numbers = [stop.run // 2 for stop in sweep.stops]
        marks = [Decimal(k == 0 or numbers[k] != numbers[k - 1]) for k in range(count)]
        name = pick(rng, words.HOMING[language])
        counted = name.endswith(".") or chance(rng, 0.7)
        more[name] = [Decimal(n + 1) for n in numbers] if counted else marks
        readings = [r._replace(segment=n) for r, n in zip(readings, numbers, strict=True)]
    command, reading = names_of(rng, axis, language)
    columns[headed(rng, command, axis.command_unit, language)] = [stop.command for stop in sweep.stops]
    if stated:
        pair = pick(rng, words.SIDES["all"] if chance(rng, 0.35) else words.SIDES[language])
        if DOMAIN[axis.unit] == "deg" and chance(rng, 0.15):
            pair, truth = pick(rng, words.TURNS), replace(truth, answer="either")
        sides = [Decimal(word) if word in ("1", "-1") else word for word in pair]
        columns[pick(rng, words.DIRECTION[language])] = [sides[stop.side < 0] for stop in sweep.stops]
    # Positions that were passed, or not read.
    cells: list[Cell] = list(values)
    empty = {k for k, stop in enumerate(sweep.stops) if not stop.read}
    empty |= {int(rng.integers(1, count - 1))} if chance(rng, 0.08) else set()
    nothing = pick(rng, ("", "", "", "n/a", "NaN", "-", "--", "#N/A"))
    for k in empty:
        cells[k] = nothing
    after, readings = further_columns(rng, axis, language, sweep, values, readings, empty)
    columns[headed(rng, reading, axis.unit, language)] = cells
    columns |= after
    items = list((more | columns).items())
    if chance(rng, 0.15):
        # The order of columns tells nothing.
        items = [items[k] for k in rng.permutation(len(items))]
    return sheets.columns_sheet(dict(items), language), replace(truth, readings=tuple(readings))


def further_columns(
    rng: np.random.Generator,
    axis: Axis,
    language: str,
    sweep: Sweep,
    values: Sequence[Decimal],
    readings: Sequence[Reading],
    gone: set[int],
) -> tuple[dict[str, Sequence[Cell]], list[Reading]]:
    """Columns to the right of the reading, and the readings with what these say of them."""
    count, readings = len(readings), list(readings)
    columns: dict[str, Sequence[Cell]] = {}
    if chance(rng, 0.25):
        name, cell, u = u_column(rng, axis, language)
        # Each of its own, in multiples of the least.
        times = rng.integers(1, 4, count) if chance(rng, 0.4) else np.ones(count, int)
        columns[name] = [cell * int(n) for n in times]
        readings = [r._replace(u=u * int(n)) for r, n in zip(readings, times, strict=True)]
    if chance(rng, 0.2) and DOMAIN[axis.command_unit] == DOMAIN[axis.unit] and not axis.geared:
        columns |= error_column(rng, axis, language, sweep, values)
    if chance(rng, 0.25):
        drift = np.cumsum(rng.normal(0, 0.02, count))
        columns[pick(rng, words.TEMPERATURE[language])] = [decimal(20.3 + d, 2) for d in drift]
    if chance(rng, 0.25):
        middle = rng.uniform(5, 60)
        columns[pick(rng, words.OTHER[language])] = [decimal(middle + d, 1) for d in rng.normal(0, 0.4, count)]
    if chance(rng, 0.15):
        columns[pick(rng, words.COMMENT[language])] = [pick(rng, words.REMARKS[language]) for _ in range(count)]
    if chance(rng, 0.15):
        name, good, bad = pick(rng, words.STATUS[language])
        wrong = set(rng.choice(count, int(rng.integers(0, 3)), replace=False).tolist())
        cells = [bad if k in wrong else good for k in range(count)]
        columns[name] = [Decimal(cell) if cell.isdigit() else cell for cell in cells]
        gone = gone | wrong
    return columns, [r for k, r in enumerate(readings) if k not in gone]


def error_column(
    rng: np.random.Generator, axis: Axis, language: str, sweep: Sweep, values: Sequence[Decimal]
) -> dict[str, Sequence[Cell]]:
    """Actual less target, or target less actual, in a unit of its own; beside the reading, so that it is no reading."""
    small = "um" if axis.unit in LENGTH else "arcsec"
    unit = axis.unit if chance(rng, 0.5) else small
    sign = 1 if chance(rng, 0.8) else -1
    scale = SCALE[axis.command_unit] / SCALE[axis.unit]
    errors = [float(v) - scale * float(stop.command) for v, stop in zip(values, sweep.stops, strict=True)]
    name = with_unit(rng, pick(rng, words.DEVIATION[language]), unit, language)
    return {name: [decimal(sign * e * SCALE[axis.unit] / SCALE[unit], DIGITS[unit]) for e in errors]}


def long_table(rng: np.random.Generator, language: str) -> Drawn:
    """A row for each reading."""
    sheet, truth = long_sheet(rng, draw_axis(rng, variety=True), language)
    return Drawn("a row for each reading", sheets.any_file(rng, sheet), truth)


def unit_row(rng: np.random.Generator, language: str) -> Drawn:
    """Names, and units in a row of their own below."""
    axis = draw_axis(rng)
    stated = chance(rng, 0.5)
    sweep = sweeps(rng, axis.commands, stated)
    values, readings = read_all(rng, axis, sweep)
    form = pick(rng, ("{}", "({})", "[{}]"))
    heads = [list(names_of(rng, axis, language))]
    command_unit = "" if axis.command_unit == "step" else form.format(unit_text(rng, axis.command_unit, language))
    heads.append([command_unit, form.format(unit_text(rng, axis.unit, language))])
    rows: list[list[Cell]] = [[stop.command, value] for stop, value in zip(sweep.stops, values, strict=True)]
    if stated:
        pair = pick(rng, words.SIDES[language])
        heads = [[*heads[0], pick(rng, words.DIRECTION[language])], [*heads[1], ""]]
        rows = [[*row, pair[stop.side < 0]] for row, stop in zip(rows, sweep.stops, strict=True)]
    return Drawn(
        "units in a row of their own", sheets.any_file(rng, Sheet(heads, rows, language)), truth_of(axis, readings)
    )


def two_sensors(rng: np.random.Generator, language: str) -> Drawn:
    """Two columns follow the commands: a laser and an encoder. The first was meant."""
    axis = draw_axis(rng)
    stated = chance(rng, 0.5)
    sweep = sweeps(rng, axis.commands, stated)
    values, readings = read_all(rng, axis, sweep)
    other = replace(axis, per_command=axis.per_command * (1 + rng.normal(0, 1e-3)), play=axis.play * rng.uniform(0, 2))
    command, reading = names_of(rng, axis, language)
    columns: dict[str, Sequence[Cell]] = {
        headed(rng, command, axis.command_unit, language): [s.command for s in sweep.stops]
    }
    if stated:
        pair = pick(rng, words.SIDES[language])
        columns[pick(rng, words.DIRECTION[language])] = [pair[stop.side < 0] for stop in sweep.stops]
    columns[headed(rng, reading, axis.unit, language)] = values
    name = with_unit(rng, pick(rng, words.SECOND_SENSOR[language]), axis.unit, language)
    columns[name] = [other.value(stop.command, stop.side, rng) for stop in sweep.stops]
    truth = truth_of(axis, readings, answer="ask")
    return Drawn(
        "two columns follow the commands", sheets.any_file(rng, sheets.columns_sheet(columns, language)), truth
    )


def unknown_unit(rng: np.random.Generator, language: str) -> Drawn:
    """A unit in brackets that nobody knows: a division of somebody's dial."""
    axis = draw_axis(rng, rotary=False, unit="1/100 mm")
    sweep = sweeps(rng, axis.commands, False)
    values, readings = read_all(rng, axis, sweep)
    form = pick(rng, ("{} ({})", "{} [{}]"))
    command, reading = names_of(rng, axis, language)
    columns: dict[str, Sequence[Cell]] = {
        headed(rng, command, axis.command_unit, language): [s.command for s in sweep.stops],
        form.format(reading, pick(rng, UNKNOWN_UNITS)): values,
    }
    # Any answer that leaves the numbers as they are.
    truth = truth_of(axis, readings, answer="ask", unit=None, meant=axis.unit)
    return Drawn("a unit that nobody knows", sheets.any_file(rng, sheets.columns_sheet(columns, language)), truth)


def no_unit(rng: np.random.Generator, language: str) -> Drawn:
    """Steps and a reading without any unit."""
    axis = draw_axis(rng, command_unit="step", variety=True)
    sweep = sweeps(rng, axis.commands, False)
    values, readings = read_all(rng, axis, sweep)
    columns: dict[str, Sequence[Cell]] = {
        pick(rng, words.STEPS[language]): [stop.command for stop in sweep.stops],
        names_of(rng, axis, language)[1]: values,
    }
    truth = truth_of(axis, readings, answer="either", unit=None, command_unit=None)
    return Drawn("no unit at all", sheets.any_file(rng, sheets.columns_sheet(columns, language)), truth)


def reading_without_unit(rng: np.random.Generator, language: str) -> Drawn:
    """The unit of the commands alone is named; the reading's is the same, or 1/100 mm or um, as its size says."""
    unit = pick(rng, ("mm", "mm", "um", "1/100 mm"))
    axis = draw_axis(rng, rotary=False, unit=unit, command_unit="mm")
    stated = chance(rng, 0.4)
    sweep = sweeps(rng, axis.commands, stated)
    values, readings = read_all(rng, axis, sweep)
    command, reading = names_of(rng, axis, language)
    columns: dict[str, Sequence[Cell]] = {with_unit(rng, command, "mm", language): [s.command for s in sweep.stops]}
    if stated:
        pair = pick(rng, words.SIDES[language])
        columns[pick(rng, words.DIRECTION[language])] = [pair[stop.side < 0] for stop in sweep.stops]
    columns[reading] = values
    truth = truth_of(axis, readings, answer="either" if unit == "mm" else "ask")
    kind = f"a reading without unit beside mm, {'the same' if unit == 'mm' else 'another'}"
    return Drawn(kind, sheets.any_file(rng, sheets.columns_sheet(columns, language)), truth)


def unit_above(rng: np.random.Generator, language: str) -> Drawn:
    """The unit stands in a line above the names alone."""
    axis = draw_axis(rng, rotary=False, unit=pick(rng, ("mm", "inch")), command_unit=None)
    axis = replace(axis, command_unit="step") if axis.command_unit != axis.unit else axis
    sweep = sweeps(rng, axis.commands, False)
    values, readings = read_all(rng, axis, sweep)
    command, reading = names_of(rng, axis, language)
    sheet = sheets.columns_sheet({command: [s.command for s in sweep.stops], reading: values}, language)
    label = {"en": "All values in", "de": "Alle Werte in", "es": "Valores en", "fr": "Valeurs en"}[language]
    sheet.above = [*sheets.preamble(rng, language), f"{label} {unit_text(rng, axis.unit, language)}", ""]
    truth = truth_of(axis, readings, answer="either")
    return Drawn("the unit above the names alone", sheets.any_file(rng, sheet), truth)
