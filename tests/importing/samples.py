"""Files that `import` reads or refuses: observed layouts with invented numbers.

Files of `tests/data/foreign` are taken as they are; the others are written here.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import openpyxl

FOREIGN = Path(__file__).parents[1] / "data" / "foreign"
RATIO, PLAY = 0.0125, 0.05
"""Unit per step, and unit: of the axis in most tables below."""


class Sample(NamedTuple):
    """A file by its name, and the words of `import` after it."""

    name: str
    content: str | bytes
    words: tuple[str, ...] = ("--axis",)


def readings(runs: int = 2, stops: int = 9, every: int = 400) -> list[tuple[int, float, int]]:
    """Command, reading and side of runs up and down; no stop is read twice in a row."""
    rows = []
    for _ in range(runs):
        rows += [(every * k, RATIO * every * k, 1) for k in range(stops)]
        rows += [(every * k, RATIO * every * k + PLAY, -1) for k in range(stops - 2, -2, -1)]
    return rows


def dms(degrees: float) -> str:
    seconds = round(abs(degrees) * 3600)
    return f"{'-' if degrees < 0 else ''}{seconds // 3600}\u00b0{seconds // 60 % 60:02d}'{seconds % 60:02d}\""


def lines(form: str) -> str:
    """A line for each reading."""
    return "".join(
        form.format(
            **{"c": c, "v": v, "s": "+-"[s < 0], "word": ("up", "down")[s < 0], "d": dms(v), "k": k},
            **{"dev": 1000 * (v - RATIO * c), "m": f"{'-' * (v < 0)}{int(abs(v))}\u00b0 {60 * (abs(v) % 1):.4f}'"},
            # Past midnight.
            h=f"{(23 + (50 + k) // 60) % 24:02d}:{(50 + k) % 60:02d}:00",
        )
        for k, (c, v, s) in enumerate(readings())
    )


TABLE = "steps;reading (mm);direction\n" + lines("{c};{v:.4f};{s}\n")
CAMONITOR = lines(
    "T:Axis1-PosAct 2021-07-09 10:29:{k:02d}.000000 {c}\nT:Enc1 2021-07-09 10:29:{k:02d}.000000 {v:.4f}\n"
)
AXIS_TEXTS = {
    "preamble": "Serial no. 117\nOperator: A. B.\n\n" + TABLE,
    "words of direction": "steps,reading_mm,Richtung\n" + lines("{c},{v:.4f},{word}\n"),
    "serial monitor": "ready\n" + lines("Step: {c}, Angle: {v:.4f} deg\n"),
    "serial monitor with a clock": lines("10:00:{k:02d}.000 -> step={c} angle={v:.4f}\n"),
    "degrees, minutes, seconds": "step\tangle\tdir\n" + lines("{c}\t{d}\t{word}\n"),
    "units in cells": "step;reading;dir\n" + lines("{c};{v:.4f} mm;{word}\n"),
    "decimal commas": "Schritte;Messwert (mm);Richtung\n" + lines("{c};{v:.4f};{s}\n").replace(".", ","),
    "a row of units": "steps,reading,direction\n[counts],[mm],\n" + lines("{c},{v:.4f},{s}\n"),
    "clockwise": "steps,reading mm,direction\n"
    + lines("{c},{v:.4f},{word}\n").replace("up", "CW").replace("down", "CCW"),
    "commands alone and names of nobody": "foo,bar\n1,2\n",
    "times of day past midnight": "time,steps,mm,dir\n" + lines("{h},{c},{v:.4f},{s}\n"),
    "camonitor": CAMONITOR,
    "camonitor of two series of nobody": CAMONITOR.replace("Axis1", "A").replace("Enc1", "B"),
    "gon past a turn": "steps,angle (gon)\n0,300\n100,350\n200,0\n300,50\n400,100\n",
    "an expanded uncertainty": "steps,mm,U (k=2.5)\n0,0,0.5\n1,1,0.5\n2,2.1,0.5\n",
    "a share of 100": "target,actual,error %\n1,1.1,10\n2,2.1,5\n4,4.1,2.5\n",
    "directions the other way": TABLE.replace(";+\n", ";~\n").replace(";-\n", ";+\n").replace(";~\n", ";-\n"),
    "directions of nobody": TABLE.replace(";+", ";cw").replace(";cw", ";x", 1),
    "a word among readings": TABLE.replace("5.0000", "abc", 1),
    "two readings": "steps,mm,deg\n0,1,2\n1,2,3\n",
    "no names": "0,1\n5,2\n10,3\n",
    "counts that wrap": "steps,encoder counts\n" + "".join(f"{100 * k},{97 * k % 1000}\n" for k in range(60)),
    "times that run back": "t,steps,angle\n0,0,1\n2,1,2\n1,2,3\n",
    "names alone": "steps,mm\n",
    "a title": "Leadscrew test,,\n0,0,1\n5,1,1\n",
    "stops read again, passed, homed": (
        "t (min);home;steps;encoder;from;sd;ok\n0;1;0;0,5;forward;0,1;1\n1;1;100;1,5;;0,1;1\n2;1;100;1,6;;0,1;1\n"
        "3;1;200;;;;\n4;1;100;1,4;;;no\n5;2;100;1,7;backward;0,2;ja\n"
    ),
    "marks of homings": "home,steps,encoder\n1,0,0.1\n0,10,1.1\n0,20,2.1\n1,0,0.2\n",
    "German dates": "Zeit;Sollwert;Istwert\n04.03.2026 23:59:50;0;0,5\n5.3.2026 00:00:12,5;10;1,5\n",
    "temperatures": "command,value,Temp (\u00b0F),direction\n0,0.1,68.0,below\n10,1.1,,below\n10,1.0,70.7,above\n",
    "statuses": "steps;encoder;ok\n0;0,5;1\n100;1,5;-\n200;;+ slipped\n",
    "deviations": "Target (mm),Dir,Deviation (um)\n"
    + "".join(f"{10 * k},{s:+d},{2 * k + 50 * (s < 0)}\n" for s in (1, -1) for k in range(0, 10)[::s]),
    "blocks below each other": "".join(
        f"{title} 1:\nsteps;reading (mm)\n"
        + "".join(f"{c};{v:.4f}\n" for c, v, s in readings(runs=1) if s == side)
        + "\n"
        for title, side in (("Up", 1), ("Down", -1))
    ),
    "notes below the rows": TABLE.replace("8.0000", "", 1) + "\nChecked by: A. B.;;\n",
    "positions across": "Sollweg (mm);0;10;20\nHin 1 (mm);0,01;10,02;20,01\nZurück 1 (mm);0,05;10,06;20,05\n",
    "objects of JSON": "".join(
        json.dumps({"t": 2.0 * k, "target_mm": c, "state": {"measured_mm": v}, "ok": True}) + "\n"
        for k, (c, v, _) in enumerate(readings())
    ),
    "a table of objects of JSON": json.dumps([{"target_mm": c, "measured_mm": v} for c, v, _ in readings()], indent=1),
    "a piezo's volts": "Voltage (V);Displacement (um)\n0;0,01\n10;3,02\n20;6,01\n10;3,25\n0;0,21\n",
    "a sensor's volts": "target mm,probe (V)\n0,0.01\n1,0.51\n2,1.00\n1,0.52\n",
    "one unknown word of direction": TABLE.replace(";-\n", ";x\n").replace(";+\n", ";x\n"),
    "a good row without a reading": "steps,mm,ok\n0,0,yes\n10,,yes\n20,2,yes\n10,1.1,yes\n0,0.1,yes\n",
    "turns by U": "Nennwinkel gon,Auf 1 [U],Ab 1 [U]\n0,0,0.002\n100,0.25,0.252\n200,0.5,0.502\n",
    "small deviations with their unit in the cells": "Target;Forward [1/1000 in];Reverse [1/1000 in]\n"
    + "".join(f"{2 * k}.0 inch;{3 * k % 7}.81;{3 * k % 7 + 1}.77\n" for k in range(6)),
    "units in all cells below words": "Nominal,Ist,Notiz\n"
    + "".join(f"{2 * k} mm,{2 * k}.01 mm,{'ok' * (k % 2)}\n" for k in range(6)),
    "two joints": "J1 target (deg),J1 actual (deg),J2 target (deg),J2 actual (deg)\n"
    + lines("{c},{v:.4f},{c},{v:.3f}\n"),
    "empty remarks at the ends": "Teórica [mm];Medida [mm];Notas\n"
    + lines("{c};{v:.4f};\n").replace(".", ",").replace(";\n", ";x\n", 3),
}
"""Tables and logs of one axis, imported with --axis --yes alone."""
OBSERVED = {
    **dict.fromkeys(("counts_wrap/log.csv", "direction_signs/log.csv", "wide_forward_backward/dial.csv"), ()),
    **dict.fromkeys(("error_column_as_u/log.csv", "error_column_as_u/signed.csv", "hundredths/messuhr.csv"), ()),
    **dict.fromkeys(("x_value/lvm_rows.txt", "runs_partly_named/messuhr.csv", "runs_without_direction/runs.csv"), ()),
    **dict.fromkeys([f"u_of_another_unit/{name}.csv" for name in ("certificate", "standard_u", "u_in_mm")], ()),
    **dict.fromkeys([f"units/{name}.csv" for name in ("U95", "Ucaps", "u_um")], ()),
    **dict.fromkeys(("names_in_remark/numpy_savetxt.txt", "names_in_remark/rostopic_echo_p.csv"), ()),
    **dict.fromkeys(("lab_formats/x_axis.rtl", "lab_formats/retrieval.json", "servo_telemetry/servo.csv"), ()),
    **dict.fromkeys(("reference_column/two_sensors.csv", "reference_column/without.csv"), ()),
    **dict.fromkeys(("pe_logs/eqmod_perecorder.txt", "pe_logs/time_and_pe.csv", "ekos_log/guide_log.txt"), ()),
    **{"units/rad.csv": ("--sightings",), "names_in_remark/rts2_gpoint_altaz.txt": ("--sightings",)},
}
"""Files of `tests/data/foreign`, with what stands in place of --axis."""


def guide_log(frames: int, declination: str = "40.0 deg", pixel: str = "2.0") -> str:
    """A run of PHD2."""
    head = (
        "Guiding Begins at 2026-01-02 21:00:00\n"
        f"Pixel scale = {pixel} arc-sec/px, Binning = 1, Focal length = 500 mm\n"
        "Mount = A Mount,  connected, guiding enabled, xAngle = 1.0, xRate = 3.0, yAngle = 2.0, yRate = 3.0\n"
        "RA Guide Speed = 6.1 a-s/s, Dec Guide Speed = 7.5 a-s/s, Cal Dec = 10.0, Last Cal Issue = None\n"
        f"RA = 20.34 hr, Dec = {declination}, Hour angle = -1.70 hr, Pier side = West, Rotator pos = N/A\n"
        "Frame,Time,mount,dx,dy,RARawDistance,DECRawDistance,RAGuideDistance,DECGuideDistance,RADuration,RADirection,"
        "ErrorCode\n"
    )
    rows = "".join(
        f'{k},{3 * k},"Mount",0,0,{math.sin(k / 40):.3f},0,0,0,{50 * (k % 3)},{"EW"[k % 2]},{int(k == 7)}\n'
        for k in range(1, frames)
    )
    return head + rows + "Guiding Ends at 2026-01-02 22:00:00\n"


def serial_log(lost: tuple[int, ...] = ()) -> str:
    """Target and position on lines of their own, some of them lost."""
    rng, rows, before = np.random.default_rng(1), [], -1
    for command in [*range(20), *range(18, -1, -1)] * 2:
        side = -1 if command > before else 1
        rows += [f"target: {command}", f"pos_deg: {command * 0.5 + side * 0.05 + rng.normal(0, 0.002):.4f}"]
        before = command
    return "".join(f"{row}\n" for k, row in enumerate(rows) if k not in lost)


def clock_log(step_back: bool) -> str:
    """EPICS series in the night when summer time ends."""
    rows = []
    for k, command in enumerate([*range(30), *range(28, -1, -1)] * 3):
        for late, name, value in ((0, "VAL", command), (10, "RBV", round(0.5 * command + 0.15 * (k % 58 > 29), 3))):
            second = 21 * k + late
            hour, minute = divmod(40 + second // 60, 60)
            hour = 2 + hour - (step_back and hour > 0)
            rows.append(f"M:axis.{name} 2026-10-25 {hour:02d}:{minute:02d}:{second % 60:02d}.000000 {value}\n")
    return "".join(rows)


def klipper(data: object = ((500, 40, 0),), angles: object = ((10.0, 100), (10.005, 600), (10.01, 1100))) -> bytes:
    """A queue of steps and an angle sensor."""
    params = {"first_clock": 1000, "last_clock": 21000, "first_step_time": 10.0, "last_step_time": 10.02}
    messages = (
        {"q": "stepq:stepper_x", "params": {**params, "start_mcu_position": 0, "step_distance": 0.01, "data": data}},
        {"q": "angle:my_sensor", "params": {"data": angles, "errors": 0}},
    )
    return b"".join(json.dumps(message).encode() + b"\x03" for message in messages)


def workbook() -> bytes:
    """A dial's sheet of runs side by side."""
    book, stream = openpyxl.Workbook(), io.BytesIO()
    book.active.append(["Position (mm)", "Forward (mm)", "Backward (mm)"])
    for position in range(0, 50, 10):
        book.active.append([position, 1.001 * position, round(1.001 * position + PLAY, 4)])
    book.save(stream)
    return stream.getvalue()


def maxim_log(frames: int = 200) -> str:
    """A track log of MaxIm: a mount with a wave of 12.3 arcsec, corrected along X; Y scatters."""
    rows, corrected_px = ["Track Log Started at UT 2026-01-02 23:50:00", MAXIM_NAMES], 0.0
    for k in range(frames):
        second = 50 * 60 + 4 * k
        clock = f"{(23 + second // 3600) % 24:02d}:{second // 60 % 60:02d}:{second % 60:02d}"
        if k == 50:
            rows.append(f"{clock}, Guide Star Fade")
            continue
        offset = maxim_wave_arcsec(4.0 * k) * MAXIM_PX_PER_ARCSEC + corrected_px
        correction_s = round(-0.6 * offset / MAXIM_PX_PER_S, 2)
        rows.append(f"{clock}, {500 + offset:.2f}, 384.00, {offset:.2f}, 0.10, {correction_s:.2f}, -0.04, 2036")
        corrected_px += MAXIM_PX_PER_S * correction_s
    return "\n".join([*rows, ""])


MAXIM_NUMBERS = ("pixel_arcsec=2", "declination_deg=20", "ra_axis=1", "pulse_arcsec_per_s=3.192533")
MAXIM_NAMES = "UT Time, Star X, Star Y, OffsetX, OffsetY, Corr X, Corr Y, Bright"
MAXIM_PX_PER_ARCSEC, MAXIM_PX_PER_S = math.cos(math.radians(20)) / 2.0, 1.5
"""On the axis, at 2 arcsec/px and 20 deg of declination."""


def maxim_wave_arcsec(time_s: float) -> float:
    return 12.3 * math.sin(2 * math.pi * time_s / 478.69)


def two_sheets() -> bytes:
    """Words first, then a table; a second one with numbers makes it two."""
    book, stream = openpyxl.Workbook(), io.BytesIO()
    for name in ("first", "second"):
        sheet = book.create_sheet(name)
        for k in range(5):
            sheet.append([k, 1.1 * k])
    book.active.append(["Operator: A. B."])
    book.save(stream)
    return stream.getvalue()


def sightings(azimuth: str = "Az gemessen [deg]", scale: float = 1.0) -> str:
    steps = [(400 * k, 100 * (k * k % 7)) for k in range(12)]
    rows = [
        f"{k};{pan};{tilt};{scale * 0.045 * pan:.6f};{scale * (0.05 * tilt + 3):.6f}"
        for k, (pan, tilt) in enumerate(steps)
    ]
    return "\n".join([f"Zeit;Motor Az;Motor El;{azimuth};Hoehe gemessen [deg]", *rows, ""]).replace(".", ",")


LOOKS = "Pan Tilt XL YL XR YR {more}\n0 0 641 361 501 360 {0}\n0 0 651 361 561 360 {1}\n200 0 701 361 571 360 {2}\n"


def looks(more: str, *cells: str) -> str:
    return LOOKS.format(*cells, more=more).replace(" ", ",")


POINTING = """CAT: {k} 00:00:00.0 +00:00:00.0
RAA: {el:.4f} {az:.4f}
AA: 0 0
TAA: {el:.4f} {true:.4f}
LST: 22:{k:02d}:00.0
"""
OTHERS: dict[str, Callable[[], Sample]] = {
    "a workbook": lambda: Sample("dial.xlsx", workbook()),
    "UTF-16": lambda: Sample("dial.csv", TABLE.encode("utf-16")),
    "deviations by option": lambda: Sample(
        "dial.csv", AXIS_TEXTS["deviations"], ("--axis", "--deviations", "--column", "value=Deviation (um)")
    ),
    "a guide log": lambda: Sample("guide.txt", guide_log(300)),
    "a guide log of two runs": lambda: Sample("guide.txt", guide_log(20) + "\n" + guide_log(300)),
    "the second run": lambda: Sample(
        "guide.txt", guide_log(20) + "\n" + guide_log(300), ("--axis", "--run", "2", "--assume", "declination_deg=20")
    ),
    "a guide log without declination": lambda: Sample("guide.txt", guide_log(99, "Unknown")),
    "a guide log without pixel scale": lambda: Sample("guide.txt", guide_log(99, pixel="?")),
    "MaxIm's track log": lambda: Sample("track.log", maxim_log()),
    "MaxIm's track log with its numbers": lambda: Sample(
        "track.log",
        maxim_log(),
        ("--axis", *(w for n in MAXIM_NUMBERS for w in ("--assume", n))),
    ),
    "a sensor's volts with their scale": lambda: Sample(
        "log.txt", AXIS_TEXTS["a sensor's volts"], ("--axis", "--unit", "value=2 mm")
    ),
    "sheets with two tables": lambda: Sample("book.xlsx", two_sheets()),
    "a table as a guide log": lambda: Sample("table.csv", TABLE, ("--axis", "--format", "phd2")),
    "a guide log without --axis": lambda: Sample("guide.txt", guide_log(99), ()),
    "camonitor without --axis": lambda: Sample("log.txt", CAMONITOR, ()),
    "an unknown format": lambda: Sample("table.csv", TABLE, ("--axis", "--format", "phd")),
    "a run of a table": lambda: Sample("table.csv", TABLE, ("--axis", "--run", "1")),
    **{
        f"a guide log with {' '.join(words)}": lambda words=words: Sample(
            "guide.txt", guide_log(99), ("--axis", *words)
        )
        for words in (("--column", "u=dx"), ("--run", "3"), ("--assume", "dec=3"), ("--assume", "declination_deg=x"))
    },
    "an angle sensor alone": lambda: Sample("log.txt", '{"q": "angle:a", "params": {"data": [[1, 2]]}}\x03'),
    "minutes beyond 60": lambda: Sample("log.txt", "steps;angle\n0;1\u00b061'00\"\n1;2\u00b000'00\"\n"),
    "two notations in a column": lambda: Sample("log.txt", "steps;angle\n0;1 mm\n1;2 deg\n"),
    "Greek letters in UTF-16": lambda: Sample(
        "dial.csv",
        # Their high byte is the end marker of a message of Klipper's logger.
        ("Position (mm);\u03bb laser (mm)\n" + "".join(f"{10 * k};{10.01 * k:.3f}\n" for k in range(9))).encode(
            "utf-16"
        ),
        ("--axis", "--column", "value=\u03bb laser (mm)"),
    ),
    "a serial log": lambda: Sample("serial.txt", serial_log()),
    "a serial log with a lost line": lambda: Sample("serial.txt", serial_log(lost=(30, 75))),
    "summer time": lambda: Sample("epics.txt", clock_log(step_back=False)),
    "the end of summer time": lambda: Sample("epics.txt", clock_log(step_back=True)),
    "klipper": lambda: Sample("klipper.json", klipper()),
    "klipper with a row of four": lambda: Sample("klipper.json", klipper([[1, 2, 3, 4]])),
    "klipper with a text for an angle": lambda: Sample("klipper.json", klipper(angles=[["a"]])),
    "klipper's configuration": lambda: Sample(
        "printer.cfg", "[stepper_x]\n#*# [angle a]\n#*# calibrate = \n#*# \t100.5,427.5,755.0,\n#*# \t1083.0\n"
    ),
    "sightings": lambda: Sample("sightings.csv", sightings(), ("--sightings", "--assume", "u_deg=0.002")),
    "sightings without a unit": lambda: Sample("sightings.csv", sightings("Az gemessen"), ("--sightings",)),
    "sightings of encoders": lambda: Sample(
        "sightings.csv", sightings().replace("Motor Az", "Encoder Az [deg]"), ("--sightings",)
    ),
    "a telescope's table": lambda: Sample(
        "night.dat",
        "".join(POINTING.format(k=k, el=30 + 4 * k, az=77 * k % 360, true=77 * k % 360 + 0.01 * k) for k in range(12)),
        ("--format", "pointing"),
    ),
    "looks": lambda: Sample("looks.csv", looks("Sheet", "near", "far", "far"), ()),
    "looks from pixel 1, of the other sign": lambda: Sample(
        "looks.csv",
        looks("B_rad", "1.5", "1.4", "0.5"),
        ("--pixels-from", "1", "--flip", "pan_steps", "--pan-approach", "left"),
    ),
    "relative steps, times, statuses": lambda: Sample("looks.csv", looks("valid", "1", "0", "1"), ("--relative",)),
    "looks with homings": lambda: Sample("looks.csv", looks("home", "1", "1", "2"), ()),
    "looks of experiments": lambda: Sample("looks.csv", looks("exp", "3", "3", "4"), ()),
    "looks without moves": lambda: Sample("looks.csv", "XL,YL,XR,YR\n1,2,3,4\n", ()),
    "angles in place of counters": lambda: Sample("looks.csv", "Pan,Tilt\n0.5,0\n", ()),
    "two columns for pan": lambda: Sample(
        "looks.csv", "pan_goal,pan_pos,tilt,XL,YL,XR,bottom\n0,1,0,640,360,500,360\n", ()
    ),
    "distances of a sheet": lambda: Sample("looks.csv", looks("distance_cm", "17.5", "27.5", "27.5"), ()),
    "a row too long": lambda: Sample("table.csv", "n;v\n" + "1;2\n" * 20 + "1;2;a;b\n"),
    "dates with spaces": lambda: Sample("table.txt", "time n v\n" + "2026-01-02 10:00 5 7\n" * 20),
    "a picture": lambda: Sample("table.csv", b"\x89PNG\r\n\x1a\n\0\0\x01"),
    "an open quote": lambda: Sample("table.csv", b'a,b\n"1,2\n'),
    "an old workbook": lambda: Sample("table.xls", b"\xd0\xcf\x11\xe0 old"),
    "a damaged workbook": lambda: Sample("table.xlsx", b"PK\x03\x04 cut"),
    "nothing": lambda: Sample("table.csv", b""),
}


def sample(key: str) -> Sample:
    """A sample by its key."""
    if key in OTHERS:
        return OTHERS[key]()
    if key in AXIS_TEXTS:
        return Sample("log.txt", AXIS_TEXTS[key])
    file = FOREIGN / key
    return Sample(file.name, file.read_bytes(), OBSERVED[key] or ("--axis",))


KEYS = (*OBSERVED, *AXIS_TEXTS, *OTHERS)
