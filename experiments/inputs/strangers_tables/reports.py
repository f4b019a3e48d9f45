"""Sheets of reports: means beside runs, tolerances, blocks one below the other, positions across, several axes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from decimal import Decimal

import numpy as np

from experiments.inputs.strangers_tables import sheets, words
from experiments.inputs.strangers_tables.kinds import Drawn, headed, names_of, read_all, truth_of
from experiments.inputs.strangers_tables.logs import stage
from experiments.inputs.strangers_tables.measured import (
    ASCII,
    Axis,
    Reading,
    Sweep,
    chance,
    decimal,
    draw_axis,
    pick,
    sweeps,
    unit_text,
    with_unit,
)
from experiments.inputs.strangers_tables.runs import draw_runs, same_domain_axis
from experiments.inputs.strangers_tables.sheets import Cell, File, Sheet


def sheet_with_means(rng: np.random.Generator, language: str) -> Drawn:
    """A sheet as of ISO 230-2: runs with their directions, then the means and scatters of each side."""
    axis = draw_axis(rng)
    pair, pairs = pick(rng, words.RUN_SIDES[language]), int(rng.integers(2, 6))
    runs = draw_runs(rng, axis, (1, -1) * pairs)
    text = unit_text(rng, axis.unit, language)
    form = pick(rng, ("{} ({})", "{} [{}]"))
    rising, falling, mean, scatter = words.MEANS[language]
    heads = [headed(rng, names_of(rng, axis, language)[0], axis.command_unit, language)]
    heads += [form.format(f"{word} {k + 1}", text) for k in range(pairs) for word in pair]
    heads += [form.format(name, text) for name in (rising, falling, mean, scatter)]
    rows: list[list[Cell]] = []
    for command, *cells in zip(axis.commands, *runs.values, strict=True):
        up, down = (float(np.mean([float(cell) for cell in cells[k::2]])) for k in (0, 1))
        sd = float(np.std([float(cell) for cell in cells[::2]], ddof=1))
        rows.append([command, *cells, *(decimal(x, axis.digits + 1) for x in (up, down, (up + down) / 2, sd))])
    truth = truth_of(axis, runs.readings(), answer="either")
    return Drawn("runs side by side, with means", sheets.any_file(rng, Sheet([heads], rows, language)), truth)


def tolerances(rng: np.random.Generator, language: str) -> Drawn:
    """As of a measuring machine: nominal, actual, deviation and two tolerances, a row for each reading."""
    axis, _ = same_domain_axis(rng)
    stated = chance(rng, 0.6)
    sweep = sweeps(rng, axis.commands, stated)
    values, readings = read_all(rng, axis, sweep)
    text = unit_text(rng, axis.unit, language)
    nominal, actual, deviation = {
        "en": ("Nominal", "Actual", "Deviation"),
        "de": ("Nominal", "Ist", "Abweichung"),
        "es": ("Nominal", "Real", "Desviación"),
        "fr": ("Nominal", "Réel", "Écart"),
    }[language]
    tolerance = decimal(4 * axis.play, axis.digits)
    columns: dict[str, Sequence[Cell]] = {f"{nominal} ({text})": [stop.command for stop in sweep.stops]}
    if stated:
        sides = pick(rng, words.SIDES[language])
        columns[pick(rng, words.DIRECTION[language])] = [sides[stop.side < 0] for stop in sweep.stops]
    columns[f"{actual} ({text})"] = values
    columns[f"{deviation} ({text})"] = [v - stop.command for v, stop in zip(values, sweep.stops, strict=True)]
    plus, minus = pick(rng, (("+Tol", "-Tol"), ("Tol +", "Tol -"), ("USL", "LSL"), ("OT", "UT")))
    columns[f"{plus} ({text})"], columns[f"{minus} ({text})"] = [tolerance] * len(values), [-tolerance] * len(values)
    sheet = sheets.columns_sheet(columns, language)
    return Drawn("nominal, actual, tolerances", sheets.any_file(rng, sheet), truth_of(axis, readings))


def blocks(rng: np.random.Generator, language: str) -> Drawn:
    """Tables one below the other, each with its names and a title that has the direction."""
    axis = draw_axis(rng)
    pair, pairs = pick(rng, words.RUN_SIDES[language]), int(rng.integers(1, 3))
    runs = draw_runs(rng, axis, (1, -1) * pairs)
    command, reading = names_of(rng, axis, language)
    names = [headed(rng, command, axis.command_unit, language), with_unit(rng, reading, axis.unit, language)]
    point = "," if language != "en" and chance(rng, 0.7) else "."
    between = pick(rng, (";", "\t"))
    lines: list[str] = []
    for k, (side, values) in enumerate(zip(runs.sides, runs.values, strict=True)):
        lines += [pick(rng, ("{} {}", "{} {}:")).format(pair[side < 0], k // 2 + 1), between.join(names)]
        rows = list(zip(axis.commands, values, strict=True))[::side]
        lines += [between.join(sheets.number(cell, point) for cell in row) for row in rows] + [""]
    truth = truth_of(axis, runs.readings(), answer="either")
    return Drawn("blocks one below the other", File("log.txt", sheets.encoded(rng, "\n".join(lines))), truth)


def positions_across(rng: np.random.Generator, language: str) -> Drawn:
    """A column for each position, a row for each run."""
    axis = draw_axis(rng)
    pair, pairs = pick(rng, words.RUN_SIDES[language]), int(rng.integers(1, 4))
    runs = draw_runs(rng, axis, (1, -1) * pairs)
    name = headed(rng, names_of(rng, axis, language)[0], axis.command_unit, language)
    text = unit_text(rng, axis.unit, language)
    rows: list[list[Cell]] = [
        [f"{pair[side < 0]} {k // 2 + 1} ({text})", *values]
        for k, (side, values) in enumerate(zip(runs.sides, runs.values, strict=True))
    ]
    sheet = Sheet([], [[name, *axis.commands], *rows], language)
    truth = truth_of(axis, runs.readings(), answer="either")
    return Drawn("positions across, runs below", sheets.text_file(rng, sheet), truth)


def two_axes(rng: np.random.Generator, language: str) -> Drawn:
    """Two axes in one table: X and Y, or two joints. The first was meant."""
    axis, sweep, values, readings = stage(rng)
    other = replace(axis, per_command=axis.per_command * 1.002, zero=0.0)
    command, reading = pick(rng, words.PAIRS[language])
    first, second = pick(rng, (("X", "Y"), ("J1", "J2"), ("A", "B"), ("Joint 1", "Joint 2")))
    text = unit_text(rng, axis.unit, language)
    columns: dict[str, Sequence[Cell]] = {}
    for label, one in ((first, axis), (second, other)):
        told = values if one is axis else [one.value(stop.command, stop.side, rng) for stop in sweep.stops]
        columns[f"{label} {command} ({text})"] = [stop.command for stop in sweep.stops]
        columns[f"{label} {reading} ({text})"] = told
    sheet = sheets.columns_sheet(columns, language)
    return Drawn("two axes in one table", sheets.any_file(rng, sheet), truth_of(axis, readings, answer="ask"))


def numbered_sensors(rng: np.random.Generator, language: str) -> Drawn:
    """Sensor 1, Sensor 2 ... over the positions: no runs. The first was meant."""
    axis, sweep, values, readings = stage(rng)
    word = pick(rng, ("Sensor", "Channel", "Encoder", "Kanal", "Probe", "Capteur", "Sonda", "Taster"))
    text = unit_text(rng, axis.unit, language)
    columns: dict[str, Sequence[Cell]] = {
        headed(rng, names_of(rng, axis, language)[0], axis.command_unit, language): [s.command for s in sweep.stops],
        f"{word} 1 ({text})": values,
    }
    for k in range(int(rng.integers(1, 3))):
        other = replace(axis, per_command=axis.per_command * (1 + rng.normal(0, 1e-3)), zero=axis.zero + rng.normal())
        columns[f"{word} {k + 2} ({text})"] = [other.value(stop.command, stop.side, rng) for stop in sweep.stops]
    sheet = sheets.columns_sheet(columns, language)
    return Drawn("numbered sensors", sheets.any_file(rng, sheet), truth_of(axis, readings, answer="ask"))


def repeats(rng: np.random.Generator, language: str) -> Drawn:
    """Each stop read three times at once, side by side; rows run up and down."""
    axis = draw_axis(rng)
    sweep = sweeps(rng, axis.commands, True)
    count = int(rng.integers(2, 4))
    read = [[axis.value(stop.command, stop.side, rng) for _ in range(count)] for stop in sweep.stops]
    readings = [
        Reading(float(stop.command), float(value), sweep.told_side(k))
        for k, (stop, values) in enumerate(zip(sweep.stops, read, strict=True))
        for value in values
    ]
    word = {"en": "Reading", "de": "Ablesung", "es": "Lectura", "fr": "Lecture"}[language]
    sides, text = pick(rng, words.SIDES[language]), unit_text(rng, axis.unit, language)
    columns: dict[str, Sequence[Cell]] = {
        headed(rng, names_of(rng, axis, language)[0], axis.command_unit, language): [s.command for s in sweep.stops],
        pick(rng, words.DIRECTION[language]): [sides[stop.side < 0] for stop in sweep.stops],
        **{f"{word} {k + 1} ({text})": [values[k] for values in read] for k in range(count)},
    }
    truth = truth_of(axis, readings, answer="either")
    return Drawn(
        "a stop read several times at once", sheets.any_file(rng, sheets.columns_sheet(columns, language)), truth
    )


def steps_and_target(rng: np.random.Generator, language: str) -> Drawn:
    """Counters and the position that they stand for: either is the command."""
    axis = draw_axis(rng, rotary=False, unit="mm", command_unit="mm")
    per_mm = pick(rng, (80, 200, 400, 1600))
    sweep = sweeps(rng, axis.commands, False)
    values, readings = read_all(rng, axis, sweep)
    steps = [int(stop.command * per_mm) for stop in sweep.stops]
    columns: dict[str, Sequence[Cell]] = {
        pick(rng, words.STEPS[language]): [Decimal(n) for n in steps],
        with_unit(rng, pick(rng, words.COMMAND[language]), "mm", language): [stop.command for stop in sweep.stops],
        with_unit(rng, pick(rng, words.LENGTH_READING[language]), "mm", language): values,
    }
    of_steps = [r._replace(command=float(n)) for r, n in zip(readings, steps, strict=True)]
    truth = truth_of(axis, readings, answer="either")
    truth = replace(truth, also=(replace(truth, readings=tuple(of_steps), command_unit="step"),))
    return Drawn("counters beside positions", sheets.any_file(rng, sheets.columns_sheet(columns, language)), truth)


def told(rng: np.random.Generator, axis: Axis, sweep: Sweep, digits: int) -> tuple[list[Decimal], list[Reading]]:
    """Values with these decimals, and readings."""
    exact = [axis.per_command * float(s.command) + axis.zero - 0.5 * s.side * axis.play for s in sweep.stops]
    values = [decimal(value + rng.normal(0, axis.scatter), digits) for value in exact]
    stops = enumerate(zip(sweep.stops, values, strict=True))
    return values, [Reading(float(s.command), float(v), sweep.told_side(k)) for k, (s, v) in stops]


def wrapped(rng: np.random.Generator, language: str) -> Drawn:
    """An encoder that begins anew after each turn, read over some turns."""
    counts = pick(rng, (0, 0, 4096, 1000, 16384))
    turn, unit, digits = (float(counts), "count", 0) if counts else (360.0, "deg", 2)
    every, turns = pick(rng, (100, 200, 50)), int(rng.integers(2, 5))
    per_command = turn / 3200 * (1 + rng.normal(0, 1e-3))
    commands = tuple(Decimal(every * k) for k in range(3200 * turns // every))
    axis = Axis("step", unit, per_command, 0.004 * turn, rng.uniform(0, turn), 2e-4 * turn, commands)
    sweep = sweeps(rng, commands, False)
    sweep.stops = sweep.stops[: 2 * len(commands) - 1]
    true, readings = told(rng, axis, sweep, digits)
    name = pick(rng, words.ANGLE_READING[language])
    columns: dict[str, Sequence[Cell]] = {
        pick(rng, words.STEPS[language]): [stop.command for stop in sweep.stops],
        with_unit(rng, name, unit, language): [v % Decimal(int(turn)) for v in true],
    }
    # Whole turns may be counted from any.
    begin = float(true[0] // Decimal(int(turn))) * turn
    readings = [r._replace(value=r.value - begin) for r in readings]
    truth = truth_of(axis, readings, digit=10.0**-digits, answer="either" if counts else "right")
    return Drawn("an encoder that wraps", sheets.any_file(rng, sheets.columns_sheet(columns, language), False), truth)


def json_lines(rng: np.random.Generator, language: str) -> Drawn:
    """An object on each line, as a script logs it."""
    axis, sweep, values, readings = stage(rng)
    command, reading = pick(
        rng, (("target", "measured"), ("cmd", "pos"), ("setpoint", "actual"), ("target", "encoder"))
    )
    unit = ASCII[axis.unit]
    lines = [
        json.dumps({"t": 2.0 * k, f"{command}_{unit}": float(stop.command), f"{reading}_{unit}": float(value)})
        for k, (stop, value) in enumerate(zip(sweep.stops, values, strict=True))
    ]
    readings = [r._replace(time_s=2.0 * k) for k, r in enumerate(readings)]
    truth = truth_of(axis, readings, answer="either", clock=1.1)
    return Drawn("an object on each line", File("log.jsonl", sheets.encoded(rng, "\n".join(lines) + "\n")), truth)


def piezo(rng: np.random.Generator, language: str) -> Drawn:
    """A voltage and a displacement."""
    commands = tuple(Decimal(10 * k) for k in range(11))
    axis = Axis("step", "um", rng.uniform(0.1, 1.0), rng.uniform(1, 4), 0.0, 0.01, commands)
    axis = replace(axis, play=0.1 * axis.per_command * 100)
    sweep = sweeps(rng, commands, False)
    values, readings = told(rng, axis, sweep, 3)
    command = {"en": "Voltage", "de": "Spannung", "es": "Tensión", "fr": "Tension"}[language]
    reading = {"en": "Displacement", "de": "Auslenkung", "es": "Desplazamiento", "fr": "Déplacement"}[language]
    columns: dict[str, Sequence[Cell]] = {
        f"{command} (V)": [stop.command for stop in sweep.stops],
        with_unit(rng, reading, "um", language): values,
    }
    truth = truth_of(axis, readings, command_unit=None, digit=1e-3, answer="either")
    return Drawn("volts and micrometres", sheets.any_file(rng, sheets.columns_sheet(columns, language)), truth)
