"""What programs write by themselves: telemetry, LabVIEW, names in remarks, serial monitors, EPICS, sightings."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import replace
from decimal import Decimal

import numpy as np

from experiments.inputs.strangers_tables import sheets
from experiments.inputs.strangers_tables.kinds import START, Drawn, driven, truth_of
from experiments.inputs.strangers_tables.measured import (
    ANGLE,
    ASCII,
    WORDS,
    Answer,
    Axis,
    Reading,
    Stranger,
    Sweep,
    Truth,
    decimal,
    draw_axis,
    sweeps,
)
from experiments.inputs.strangers_tables.sheets import Cell, Columns, File


def telemetry(by: Stranger) -> Drawn:
    """Rows ten times a second, also while the axis moves: those at rest are its readings."""
    unit = by.pick(("deg", "mm", "count", "count"))
    named = unit != "count" or by.chance(0.3)
    digits, per_command = (0, 1.0) if unit == "count" else (2, 1 + by.rng.normal(0, 0.002))
    step, play = (200, 12.0) if unit == "count" else (10, 0.4)
    commands = tuple(Decimal(1000 * (unit == "count") + step * k) for k in range(int(by.rng.integers(5, 9))))
    sweep = sweeps(by, commands, False)
    rows: list[tuple[Decimal, Decimal, int]] = []
    readings, at = [], per_command * float(commands[0]) - 3 * play
    for k, stop in enumerate(sweep.stops):
        final = round(
            per_command * float(stop.command) - 0.5 * stop.side * play + by.rng.normal(0, 0.05 * play), digits
        )
        speed = 0.15 * step
        for _ in range(int(abs(final - at) / speed)):
            at += speed if final > at else -speed
            rows.append((stop.command, decimal(at, digits), 1))
        rest = int(by.rng.integers(6, 20))
        jitter = by.rng.integers(-1, 2, rest) * (0.1**digits) * by.chance(0.3)
        rows += [(stop.command, decimal(final + d, digits), 0) for d in jitter]
        at = final
        readings.append(Reading(float(stop.command), final, sweep.told_side(k)))
    count = len(rows)
    moments = [START + datetime.timedelta(seconds=0.1 * k) for k in range(count)]
    tail = by.pick(("", " (5)", "_1")) if unit == "count" else ""
    columns: Columns = {
        "timestamp": [m.isoformat(timespec="milliseconds") + "Z" for m in moments]
        if by.chance(0.6)
        else [decimal(0.1 * k, 1) for k in range(count)],
        f"target pos{tail}" if not named else f"target_{ASCII[unit]}": [c for c, _, _ in rows],
        f"pos{tail}" if not named else f"position_{ASCII[unit]}": [v for _, v, _ in rows],
        f"load{tail}": [Decimal(int(x)) for x in by.rng.integers(0, 90, count)],
        f"current{tail}": [Decimal(int(x)) for x in by.rng.integers(0, 4, count)],
    }
    if by.chance(0.6):
        columns[f"temp{tail}"] = [Decimal(37)] * count
    if by.chance(0.6):
        columns[f"status{tail}"] = [Decimal(0)] * count
    if by.chance(0.6):
        columns[f"moving{tail}"] = [Decimal(m) for _, _, m in rows]
    truth = Truth(tuple(readings), unit if named else None, None, 10.0**-digits, spread=1.5 * 10.0**-digits)
    truth = replace(truth, answer="right" if named else "either", ratio=per_command, play=play)
    file = sheets.columns_file(by._replace(language="en"), columns, markdowns=False)
    return Drawn("telemetry, also in motion", file, truth)


def stage(by: Stranger, stated: bool = False) -> tuple[Axis, Sweep, list[Decimal], list[Reading]]:
    """An axis in mm or degrees, driven in the same unit, and its readings."""
    rotary = by.chance(0.3)
    unit = "deg" if rotary else "mm"
    axis = draw_axis(by, rotary, unit, unit)
    return axis, *driven(by, axis, stated)


def labview(by: Stranger) -> Drawn:
    """The rows of an .lvm file, X_Value being the clock; sometimes with both headers above."""
    axis, sweep, values, readings = stage(by)
    times = np.round(np.cumsum(by.rng.uniform(1.9, 2.1, len(values))), 3)
    readings = [r._replace(time_s=float(t - times[0])) for r, t in zip(readings, times, strict=True)]
    names = list(by.names(axis))
    whole, comma = by.chance(0.3), by.language != "en" and by.chance(0.7)
    named = whole or by.chance(0.7)
    if named and not whole:
        names = [f"{name} ({by.unit(axis.unit)})" for name in names]
    point = "," if comma else "."
    lines = ["\t".join(["X_Value", *names, "Comment"])]
    lines += [
        "\t".join(f"{t:.6f}\t{stop.command:.6f}\t{value:.6f}\t".replace(".", point).split("\t"))
        for t, stop, value in zip(times, sweep.stops, values, strict=True)
    ]
    if whole:
        lines = lvm_headers(point, axis.unit, len(values)) + lines
    truth = truth_of(axis, readings, clock=1.1)
    if not named:
        truth = replace(truth, unit=None, command_unit=None, answer="either")
    data = sheets.encoded(by, "\n".join(lines) + "\n")
    return Drawn("LabVIEW", File("run.lvm" if whole else "run.txt", data), truth)


def lvm_headers(point: str, unit: str, count: int) -> list[str]:
    """The headers of a file with one clock and two channels."""
    clock = f"09:05:10{point}1234567"
    return [
        *("LabVIEW Measurement\t", "Writer_Version\t2", "Reader_Version\t2", "Separator\tTab"),
        *(f"Decimal_Separator\t{point}", "Multi_Headings\tNo", "X_Columns\tOne", "Time_Pref\tRelative"),
        *("Operator\tlab", "Date\t2026/03/12", f"Time\t{clock}", "***End_of_Header***\t", "\t"),
        *("Channels\t2\t\t", f"Samples\t{count}\t{count}\t", "Date\t2026/03/12\t2026/03/12\t"),
        *(f"Time\t{clock}\t{clock}\t", f"Y_Unit_Label\t{unit}\t{unit}\t", "X_Dimension\tTime\tTime\t"),
        *(f"X0\t0{point}0E+0\t0{point}0E+0\t", f"Delta_X\t1{point}0\t1{point}0\t", "***End_of_Header***\t\t\t"),
    ]


def remark_names(by: Stranger) -> Drawn:
    """Names in the last line of remarks: numpy.savetxt, SPEC, rostopic, CS-Studio, gnuplot."""
    axis, sweep, values, readings = stage(by)
    unit = ASCII[axis.unit]
    style = by.pick(("savetxt", "savetxt", "spec", "rostopic", "databrowser", "gnuplot"))
    pairs = list(zip(sweep.stops, values, strict=True))
    truth, name = truth_of(axis, readings), "data.txt"
    if style == "savetxt":
        form = by.pick(("{:.18e}", "{:.6f}", "{:.4f}"))
        between = by.pick((" ", " ", ",", "\t"))
        names = by.pick((("commanded", "measured"), ("target", "actual"), ("cmd", "meas"), ("setpoint", "encoder")))
        lines = [f"# {between.join(f'{n}_{unit}' for n in names)}"]
        lines += [form.format(float(s.command)) + between + form.format(float(v)) for s, v in pairs]
    elif style == "spec":
        lines = ["#F scan.dat", "#D Thu Mar 12 09:05:10 2026", "", "#S 1 loopscan", "#N 3"]
        lines += [f"#L Target_{unit}  Encoder_{unit}  Seconds"]
        lines += [f"{s.command} {v} {1}" for s, v in pairs]
        name = "scan.dat"
    elif style == "rostopic":
        lines = ["%time,field.header.seq,field.set_point,field.process_value,field.error"]
        lines += [
            f"{1773303074000000000 + 2000000000 * k},{k},{s.command},{v},{decimal(float(s.command) - float(v), 4)}"
            for k, (s, v) in enumerate(pairs)
        ]
        truth = replace(truth, unit=None, command_unit=None, answer="either", clock=1.1)
        readings = [r._replace(time_s=2.0 * k) for k, r in enumerate(readings)]
        truth, name = replace(truth, readings=tuple(readings)), "echo.csv"
    elif style == "databrowser":
        lines = ["# Created by CS-Studio Databrowser", "#", "# Start Time : 2026-03-12 09:00:00", "#"]
        lines += ["# Time\tm1.VAL [mm]\tm1.RBV [mm]".replace("mm", axis.unit)]
        lines += [
            f"{(START + datetime.timedelta(seconds=10 * k)).isoformat(' ')}.000000000\t{s.command}\t{v}"
            for k, (s, v) in enumerate(pairs)
        ]
        readings = [r._replace(time_s=10.0 * k) for k, r in enumerate(readings)]
        truth = replace(truth, readings=tuple(readings), clock=1.1)
    else:
        text = by.unit(axis.unit)
        heads = [f"{by.names(axis)[0]} ({text})", f"{by.names(axis)[1]} ({text})"]
        lines = ["# measured with the new dial", "# " + "\t".join(heads), *(f"{s.command}\t{v}" for s, v in pairs)]
    return Drawn("names in a remark", File(name, sheets.encoded(by, "\n".join(lines) + "\n")), truth)


SERIAL_NAMES = (("Target", "Position"), ("target", "pos"), ("cmd", "enc"), ("Set", "Actual"), ("Step", "Angle"))


def serial(by: Stranger) -> Drawn:
    """Lines of a serial monitor: command and reading on one line or on two, with lines lost, repeated or cut."""
    axis, sweep, values, readings = stage(by)
    command, value = by.pick(SERIAL_NAMES)
    sign = by.pick((": ", "=", ": "))
    unit = by.pick((" {}", "_", "")).format(axis.unit)
    if unit == "_":
        value, unit = f"{value}_{ASCII[axis.unit]}", ""
    named = bool(unit) or "_" in value
    two = by.chance(0.6)
    lines: list[str] = []
    for stop, v in zip(sweep.stops, values, strict=True):
        cells = [f"{command}{sign}{stop.command}", f"{value}{sign}{v}{unit}"]
        lines += cells if two else [by.pick((", ", " ", "; ")).join(cells) if not lines else _as(lines[0], cells)]
    damaged = two and by.chance(0.5)
    truth = truth_of(axis, readings, command_unit=None)
    if damaged:
        lines = damage(by, lines, sweep)
        truth = replace(truth, kept=len(readings) - 4)
    if by.chance(0.3):
        lines = [
            f"{(START + datetime.timedelta(seconds=k)).strftime('%H:%M:%S')}.000 -> {x}" for k, x in enumerate(lines)
        ]
    if by.chance(0.4):
        lines = ["ready", *lines] if by.chance(0.7) else [*lines, "done"]
    if not named:
        truth = replace(truth, unit=None, answer="either")
    kind = "serial monitor, lines lost, repeated or cut" if damaged else "serial monitor"
    return Drawn(kind, File("monitor.txt", sheets.encoded(by, "\n".join(lines) + "\n")), truth)


def _as(first: str, cells: Sequence[str]) -> str:
    """Two cells with what stands between those of the first line."""
    return next(between for between in (", ", "; ", " ") if between in first.replace(": ", ":")).join(cells)


def damage(by: Stranger, lines: list[str], sweep: Sweep) -> list[str]:
    """One or two lines lost, repeated or cut short: none where the motion turns, which no reader could know."""
    commands = [stop.command for stop in sweep.stops]
    straight = [
        k for k in range(2, len(commands) - 2) if (commands[k] - commands[k - 1]) * (commands[k + 1] - commands[k]) > 0
    ]
    for place in sorted(by.rng.choice(straight, int(by.rng.integers(1, 3)), replace=False).tolist(), reverse=True):
        number = 2 * place + int(by.rng.integers(2))
        what = by.pick(("lost", "lost", "repeated", "cut"))
        if what == "lost":
            del lines[number]
        elif what == "repeated":
            lines.insert(number, lines[number])
        elif number % 2 and by.chance(0.5) and "." in lines[number][-5:]:
            # Decimals are missing.
            lines[number] = lines[number][:-2]
        else:
            lines[number] = lines[number][: int(by.rng.integers(2, max(3, len(lines[number]) // 2)))]
    return lines


def camonitor(by: Stranger) -> Drawn:
    """Series of EPICS, a command and a reading after each; in some the clock steps back by an hour or some seconds."""
    axis, sweep, values, readings = stage(by)
    record = by.pick(("M:axis", "BL7:m1", "T:Stage1"))
    names = by.pick(((".VAL", ".RBV"), (".VAL", ".RBV"), ("-PosSet", "-PosAct"), (":Setpoint", ":Readback")))
    step_back = by.pick((0.0, 0.0, 3600.0, 1.5))
    every = float(by.pick((10, 20, 21)))
    begin = datetime.datetime(2026, 10, 25, 2, 50)
    change = every * len(values) * by.rng.uniform(0.3, 0.7)
    lines = []
    for k, (stop, value) in enumerate(zip(sweep.stops, values, strict=True)):
        for name, late, cell in ((names[0], 0.0, stop.command), (names[1], 0.5 * every, value)):
            second = every * k + late
            moment = begin + datetime.timedelta(seconds=second - step_back * (second > change))
            lines.append(f"{record + name:<30} {moment.isoformat(' ', timespec='microseconds')} {cell}  ")
    # The time of a folder goes on; where a clock steps, nobody knows by how much to the second.
    readings = [r._replace(time_s=every * k) for k, r in enumerate(readings)]
    tolerance_s = (0.1 * len(readings) + 1) * every
    truth = truth_of(
        axis, readings, unit=None, command_unit=None, clock=tolerance_s, answer="either", kept=len(readings) - 2
    )
    kind = "EPICS, the clock steps back" if step_back else "EPICS"
    return Drawn(kind, File("camonitor.txt", sheets.encoded(by, "\n".join(lines) + "\n")), truth)


def sightings(by: Stranger) -> Drawn:
    """Counters of a head, and where it was found to point; sometimes without a unit."""
    unit = by.pick(("deg",) * 4 + ("rad", "arcmin", "gon", "mrad"))
    # Nobody leaves out that angles are gon.
    named = unit == "gon" or by.chance(0.75)
    count, ratio = int(by.rng.integers(8, 30)), by.pick((0.02, 0.05, 0.03))
    pan, tilt = by.rng.integers(-60, 60, count) * 50, by.rng.integers(0, 30, count) * 50
    azimuth = 40 * by.chance(0.5) + ratio * pan + by.rng.normal(0, 0.01, count)
    azimuth = azimuth % 360 if by.chance(0.5) else (azimuth + 180) % 360 - 180
    elevation = 5 + ratio * tilt + by.rng.normal(0, 0.01, count)
    digits = {"deg": 4, "rad": 7, "arcmin": 2, "gon": 4, "mrad": 3}[unit]
    cells = [[decimal(a / ANGLE[unit], digits) for a in angles] for angles in (azimuth, elevation)]
    degrees = [[float(c) * ANGLE[unit] for c in column] for column in cells]
    written: list[Sequence[Cell]] = list(cells)
    if unit == "deg" and not named and by.chance(0.3):
        # Minutes and seconds tell the unit.
        named, degrees = True, [[round(3600 * d) / 3600 for d in column] for column in degrees]
        written, digits = [[sexagesimal(d) for d in column] for column in degrees], 3
        heads = list(by.word("AZIMUTH"))
    else:
        heads = sighting_heads(by, unit if named else "")
    counters: Sequence[str] = by.word("PAN")
    steps = [[Decimal(int(n)) for n in axis] for axis in (pan, tilt)]
    if encoders := named and by.chance(0.12):
        # Angles of encoders in place of counters, which become counters of 1e-5 deg.
        small = by.pick(("deg", "rad", "deg"))
        counters = [f"{name} ({by.unit(small)})" for name in by.pick(WORDS["ENCODERS"])]
        steps = [[decimal(0.05 * float(n) / ANGLE[small], 6) for n in axis] for axis in (pan, tilt)]
        pan, tilt = ([round(float(n) * ANGLE[small] * 1e5) for n in axis] for axis in steps)
    columns: Columns = {}
    if by.chance(0.4):
        columns[by.word("SECONDS")] = [decimal(12.0 * k, 1) for k in range(count)]
    columns |= dict(zip(counters, steps, strict=True))
    columns |= dict(zip(heads, written, strict=True))
    more, u, wrong = beside_sightings(by, count)
    columns |= more
    if by.chance(0.15):
        columns = {name: columns[name] for name in by.rng.permutation(np.array(list(columns), object))}
    readings = tuple(
        Reading(0.0, a, u=u, pair=(int(p), int(t), e))
        for k, (p, t, a, e) in enumerate(zip(pan, tilt, *degrees, strict=True))
        if k not in wrong
    )
    # Degrees are what all take an angle for; radians are not told from them by a reader that does not ask.
    answer: Answer = "either" if encoders else "right" if named else "either" if unit == "deg" else "ask"
    truth = Truth(readings, "deg", None, 10.0**-digits * ANGLE[unit], answer, ratio=ratio)
    kind = (
        "sightings beside encoders"
        if encoders
        else "sightings"
        if named
        else f"sightings without a unit, {'degrees' if unit == 'deg' else 'others'}"
    )
    return Drawn(kind, sheets.columns_file(by, columns), truth, ("--sightings",))


def beside_sightings(by: Stranger, count: int) -> tuple[Columns, float, set[int]]:
    """Further columns, the standard uncertainty that they state, and the rows that do not count."""
    columns: Columns = {}
    u, wrong = 0.0, set()
    if by.chance(0.2):
        small, name, factor = by.pick(("arcsec", "deg")), *by.pick((("u", 1), ("U95", 2), ("U (k=2)", 2)))
        u_cell = Decimal("18") if small == "arcsec" else Decimal("0.005")
        columns[f"{name} ({by._replace(language='en').unit(small)})"] = [u_cell] * count
        u = float(u_cell) * ANGLE[small] / factor
    if by.chance(0.2):
        columns[by.word("TEMPERATURE")] = [decimal(t, 1) for t in by.rng.normal(12, 0.2, count)]
    if by.chance(0.15):
        status, good, bad = by.word("STATUS")
        wrong = set(by.rng.choice(count, int(by.rng.integers(0, 3)), replace=False).tolist())
        columns[status] = [bad if k in wrong else good for k in range(count)]
    return columns, u, wrong


def sighting_heads(by: Stranger, unit: str) -> list[str]:
    """Names of azimuth and elevation, with their unit if any."""
    names = by.word("AZIMUTH")
    if not unit:
        return list(names)
    text, form = by.unit(unit), by.pick(("{} ({})", "{} [{}]", "{} / {}"))
    if all(name.isascii() for name in names) and by.chance(0.25):
        form, text = "{}_{}", ASCII[unit]
    return [form.format(name, text) for name in names]


def sexagesimal(degrees: float) -> str:
    """Degrees, minutes and seconds."""
    seconds = round(abs(degrees) * 3600)
    sign = "-" if degrees < 0 else ""
    return f"{sign}{seconds // 3600}\u00b0{seconds // 60 % 60:02d}'{seconds % 60:02d}\""
