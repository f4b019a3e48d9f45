"""Sheets of reports: means beside runs, tolerances, blocks one below the other, positions across, several axes."""

from __future__ import annotations

import json
from dataclasses import replace
from decimal import Decimal

import numpy as np

from experiments.inputs.strangers_tables import sheets
from experiments.inputs.strangers_tables.kinds import Drawn, driven, truth_of
from experiments.inputs.strangers_tables.logs import stage
from experiments.inputs.strangers_tables.measured import (
    ASCII,
    Axis,
    Reading,
    Stranger,
    Sweep,
    decimal,
    draw_axis,
    sweeps,
)
from experiments.inputs.strangers_tables.runs import draw_runs, same_domain_axis
from experiments.inputs.strangers_tables.sheets import Cell, Columns, File, Sheet


def sheet_with_means(by: Stranger) -> Drawn:
    """A sheet as of ISO 230-2: runs with their directions, then the means and scatters of each side."""
    axis = draw_axis(by)
    pair, pairs = by.word("RUN_SIDES"), int(by.rng.integers(2, 6))
    runs = draw_runs(by, axis, (1, -1) * pairs)
    text = by.unit(axis.unit)
    form = by.pick(("{} ({})", "{} [{}]"))
    rising, falling, mean, scatter = by.words("MEANS")
    heads = [by.headed(by.names(axis)[0], axis.command_unit)]
    heads += [form.format(f"{word} {k + 1}", text) for k in range(pairs) for word in pair]
    heads += [form.format(name, text) for name in (rising, falling, mean, scatter)]
    rows: list[list[Cell]] = []
    for command, *cells in zip(axis.commands, *runs.values, strict=True):
        up, down = (float(np.mean([float(cell) for cell in cells[k::2]])) for k in (0, 1))
        sd = float(np.std([float(cell) for cell in cells[::2]], ddof=1))
        rows.append([command, *cells, *(decimal(x, axis.digits + 1) for x in (up, down, (up + down) / 2, sd))])
    truth = truth_of(axis, runs.readings(), answer="either")
    return Drawn("runs side by side, with means", sheets.any_file(by, Sheet([heads], rows)), truth)


def tolerances(by: Stranger) -> Drawn:
    """As of a measuring machine: nominal, actual, deviation and two tolerances, a row for each reading."""
    axis, _ = same_domain_axis(by)
    stated = by.chance(0.6)
    sweep, values, readings = driven(by, axis, stated)
    text = by.unit(axis.unit)
    nominal, actual, deviation = {
        "en": ("Nominal", "Actual", "Deviation"),
        "de": ("Nominal", "Ist", "Abweichung"),
        "es": ("Nominal", "Real", "Desviación"),
        "fr": ("Nominal", "Réel", "Écart"),
    }[by.language]
    tolerance = decimal(4 * axis.play, axis.digits)
    columns: Columns = {f"{nominal} ({text})": [stop.command for stop in sweep.stops]}
    if stated:
        sides = by.word("SIDES")
        columns |= by.sides_column(sides, [stop.side for stop in sweep.stops])
    columns[f"{actual} ({text})"] = values
    columns[f"{deviation} ({text})"] = [v - stop.command for v, stop in zip(values, sweep.stops, strict=True)]
    plus, minus = by.pick((("+Tol", "-Tol"), ("Tol +", "Tol -"), ("USL", "LSL"), ("OT", "UT")))
    columns[f"{plus} ({text})"], columns[f"{minus} ({text})"] = [tolerance] * len(values), [-tolerance] * len(values)
    sheet = sheets.columns_sheet(columns)
    return Drawn("nominal, actual, tolerances", sheets.any_file(by, sheet), truth_of(axis, readings))


def blocks(by: Stranger) -> Drawn:
    """Tables one below the other, each with its names and a title that has the direction."""
    axis = draw_axis(by)
    pair, pairs = by.word("RUN_SIDES"), int(by.rng.integers(1, 3))
    runs = draw_runs(by, axis, (1, -1) * pairs)
    command, reading = by.names(axis)
    names = [by.headed(command, axis.command_unit), by.with_unit(reading, axis.unit)]
    point = "," if by.language != "en" and by.chance(0.7) else "."
    between = by.pick((";", "\t"))
    lines: list[str] = []
    for k, (side, values) in enumerate(zip(runs.sides, runs.values, strict=True)):
        lines += [by.pick(("{} {}", "{} {}:")).format(pair[side < 0], k // 2 + 1), between.join(names)]
        rows = list(zip(axis.commands, values, strict=True))[::side]
        lines += [between.join(sheets.number(cell, point) for cell in row) for row in rows] + [""]
    truth = truth_of(axis, runs.readings(), answer="either")
    return Drawn("blocks one below the other", File("log.txt", sheets.encoded(by, "\n".join(lines))), truth)


def positions_across(by: Stranger) -> Drawn:
    """A column for each position, a row for each run."""
    axis = draw_axis(by)
    pair, pairs = by.word("RUN_SIDES"), int(by.rng.integers(1, 4))
    runs = draw_runs(by, axis, (1, -1) * pairs)
    name = by.headed(by.names(axis)[0], axis.command_unit)
    text = by.unit(axis.unit)
    rows: list[list[Cell]] = [
        [f"{pair[side < 0]} {k // 2 + 1} ({text})", *values]
        for k, (side, values) in enumerate(zip(runs.sides, runs.values, strict=True))
    ]
    sheet = Sheet([], [[name, *axis.commands], *rows])
    truth = truth_of(axis, runs.readings(), answer="either")
    return Drawn("positions across, runs below", sheets.text_file(by, sheet), truth)


def two_axes(by: Stranger) -> Drawn:
    """Two axes in one table: X and Y, or two joints. The first was meant."""
    axis, sweep, values, readings = stage(by)
    other = replace(axis, per_command=axis.per_command * 1.002, zero=0.0)
    command, reading = by.word("PAIRS")
    first, second = by.pick((("X", "Y"), ("J1", "J2"), ("A", "B"), ("Joint 1", "Joint 2")))
    text = by.unit(axis.unit)
    columns: Columns = {}
    for label, one in ((first, axis), (second, other)):
        told = values if one is axis else [one.value(stop.command, stop.side, by) for stop in sweep.stops]
        columns[f"{label} {command} ({text})"] = [stop.command for stop in sweep.stops]
        columns[f"{label} {reading} ({text})"] = told
    sheet = sheets.columns_sheet(columns)
    return Drawn("two axes in one table", sheets.any_file(by, sheet), truth_of(axis, readings, answer="ask"))


def numbered_sensors(by: Stranger) -> Drawn:
    """Sensor 1, Sensor 2 ... over the positions: no runs. The first was meant."""
    axis, sweep, values, readings = stage(by)
    word = by.pick(("Sensor", "Channel", "Encoder", "Kanal", "Probe", "Capteur", "Sonda", "Taster"))
    text = by.unit(axis.unit)
    columns: Columns = {
        by.headed(by.names(axis)[0], axis.command_unit): [s.command for s in sweep.stops],
        f"{word} 1 ({text})": values,
    }
    for k in range(int(by.rng.integers(1, 3))):
        other = replace(
            axis, per_command=axis.per_command * (1 + by.rng.normal(0, 1e-3)), zero=axis.zero + by.rng.normal()
        )
        columns[f"{word} {k + 2} ({text})"] = [other.value(stop.command, stop.side, by) for stop in sweep.stops]
    sheet = sheets.columns_sheet(columns)
    return Drawn("numbered sensors", sheets.any_file(by, sheet), truth_of(axis, readings, answer="ask"))


def repeats(by: Stranger) -> Drawn:
    """Each stop read three times at once, side by side; rows run up and down."""
    axis = draw_axis(by)
    sweep = sweeps(by, axis.commands, True)
    count = int(by.rng.integers(2, 4))
    read = [[axis.value(stop.command, stop.side, by) for _ in range(count)] for stop in sweep.stops]
    readings = [
        Reading(float(stop.command), float(value), sweep.told_side(k))
        for k, (stop, values) in enumerate(zip(sweep.stops, read, strict=True))
        for value in values
    ]
    word = {"en": "Reading", "de": "Ablesung", "es": "Lectura", "fr": "Lecture"}[by.language]
    sides, text = by.word("SIDES"), by.unit(axis.unit)
    columns: Columns = {
        by.headed(by.names(axis)[0], axis.command_unit): [s.command for s in sweep.stops],
        by.word("DIRECTION"): [sides[stop.side < 0] for stop in sweep.stops],
        **{f"{word} {k + 1} ({text})": [values[k] for values in read] for k in range(count)},
    }
    truth = truth_of(axis, readings, answer="either")
    return Drawn("a stop read several times at once", sheets.columns_file(by, columns), truth)


def steps_and_target(by: Stranger) -> Drawn:
    """Counters and the position that they stand for: either is the command."""
    axis = draw_axis(by, rotary=False, unit="mm", command_unit="mm")
    per_mm = by.pick((80, 200, 400, 1600))
    sweep, values, readings = driven(by, axis)
    steps = [int(stop.command * per_mm) for stop in sweep.stops]
    columns: Columns = {
        by.word("STEPS"): [Decimal(n) for n in steps],
        by.with_unit(by.word("COMMAND"), "mm"): [stop.command for stop in sweep.stops],
        by.with_unit(by.word("LENGTH_READING"), "mm"): values,
    }
    of_steps = [r._replace(command=float(n)) for r, n in zip(readings, steps, strict=True)]
    truth = truth_of(axis, readings, answer="either")
    truth = replace(truth, also=(replace(truth, readings=tuple(of_steps), command_unit="step"),))
    return Drawn("counters beside positions", sheets.columns_file(by, columns), truth)


def told(by: Stranger, axis: Axis, sweep: Sweep, digits: int) -> tuple[list[Decimal], list[Reading]]:
    """Values with these decimals, and readings."""
    exact = [axis.per_command * float(s.command) + axis.zero - 0.5 * s.side * axis.play for s in sweep.stops]
    values = [decimal(value + by.rng.normal(0, axis.scatter), digits) for value in exact]
    stops = enumerate(zip(sweep.stops, values, strict=True))
    return values, [Reading(float(s.command), float(v), sweep.told_side(k)) for k, (s, v) in stops]


def wrapped(by: Stranger) -> Drawn:
    """An encoder that begins anew after each turn, read over some turns."""
    counts = by.pick((0, 0, 4096, 1000, 16384))
    turn, unit, digits = (float(counts), "count", 0) if counts else (360.0, "deg", 2)
    every, turns = by.pick((100, 200, 50)), int(by.rng.integers(2, 5))
    per_command = turn / 3200 * (1 + by.rng.normal(0, 1e-3))
    commands = tuple(Decimal(every * k) for k in range(3200 * turns // every))
    axis = Axis("step", unit, per_command, 0.004 * turn, by.rng.uniform(0, turn), 2e-4 * turn, commands)
    sweep = sweeps(by, commands, False)
    sweep.stops = sweep.stops[: 2 * len(commands) - 1]
    true, readings = told(by, axis, sweep, digits)
    name = by.word("ANGLE_READING")
    columns: Columns = {
        by.word("STEPS"): [stop.command for stop in sweep.stops],
        by.with_unit(name, unit): [v % Decimal(int(turn)) for v in true],
    }
    # Whole turns may be counted from any.
    begin = float(true[0] // Decimal(int(turn))) * turn
    readings = [r._replace(value=r.value - begin) for r in readings]
    truth = truth_of(axis, readings, digit=10.0**-digits, answer="either" if counts else "right")
    return Drawn("an encoder that wraps", sheets.columns_file(by, columns, markdowns=False), truth)


def json_lines(by: Stranger) -> Drawn:
    """An object on each line, as a script logs it."""
    axis, sweep, values, readings = stage(by)
    command, reading = by.pick((("target", "measured"), ("cmd", "pos"), ("setpoint", "actual"), ("target", "encoder")))
    unit = ASCII[axis.unit]
    lines = [
        json.dumps({"t": 2.0 * k, f"{command}_{unit}": float(stop.command), f"{reading}_{unit}": float(value)})
        for k, (stop, value) in enumerate(zip(sweep.stops, values, strict=True))
    ]
    readings = [r._replace(time_s=2.0 * k) for k, r in enumerate(readings)]
    truth = truth_of(axis, readings, answer="either", clock=1.1)
    return Drawn("an object on each line", File("log.jsonl", sheets.encoded(by, "\n".join(lines) + "\n")), truth)


def piezo(by: Stranger) -> Drawn:
    """A voltage and a displacement."""
    commands = tuple(Decimal(10 * k) for k in range(11))
    axis = Axis("step", "um", by.rng.uniform(0.1, 1.0), by.rng.uniform(1, 4), 0.0, 0.01, commands)
    axis = replace(axis, play=0.1 * axis.per_command * 100)
    sweep = sweeps(by, commands, False)
    values, readings = told(by, axis, sweep, 3)
    command = {"en": "Voltage", "de": "Spannung", "es": "Tensión", "fr": "Tension"}[by.language]
    reading = {"en": "Displacement", "de": "Auslenkung", "es": "Desplazamiento", "fr": "Déplacement"}[by.language]
    columns: Columns = {
        f"{command} (V)": [stop.command for stop in sweep.stops],
        by.with_unit(reading, "um"): values,
    }
    truth = truth_of(axis, readings, command_unit=None, digit=1e-3, answer="either")
    return Drawn("volts and micrometres", sheets.columns_file(by, columns), truth)
