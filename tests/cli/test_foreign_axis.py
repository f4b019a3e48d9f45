"""Foreign files of an axis: each is read by one command with the correct result, or refused with a remedy.

Files in tests/data/foreign have observed layouts and invented numbers; the test writes the others.
"""

from __future__ import annotations

import math

import numpy as np
import openpyxl
import pytest
from importing.samples import FOREIGN, PLAY, RATIO, lines, readings
from support.commands import assert_error

from tvsbayes.single_axis.axis_campaign import read_axis
from tvsbayes.single_axis.axis_rows import rows_of
from tvsbayes.single_axis.classic_line import classic_axis

WRITTEN = {
    "heading": "Serial no. 117\nOperator: A. B.\n\nsteps;reading (mm);direction\n" + lines("{c};{v:.4f};{s}\n"),
    "words": "steps,reading_mm,Richtung\n" + lines("{c},{v:.4f},{word}\n"),
    "serial": "ready\n" + lines("Step: {c}, Angle: {v:.4f} deg\n"),
    "clock": lines("10:00:{k:02d}.000 -> step={c} angle={v:.4f}\n"),
    "dms": "step\tangle\tdir\n" + lines("{c}\t{d}\t{word}\n"),
    "inch": "step;reading;dir\n" + lines('{c};{v:.4f}";{word}\n'),
    "units in cells": "step;reading;dir\n" + lines("{c};{v:.4f} mm;{word}\n"),
    "decimal commas": "Schritte;Messwert (mm);Richtung\n" + lines("{c};{v:.4f};{s}\n").replace(".", ","),
    "units below the names": "steps,reading,direction\n[counts],[mm],\n" + lines("{c},{v:.4f},{s}\n"),
    "words that the order tells": "steps,reading mm,direction\n"
    + lines("{c},{v:.4f},{word}\n").replace("up", "CW").replace("down", "CCW"),
    "actual": "Setpoint;Actual (mm);Dir\n" + lines("{c};{v:.4f};{s}\n"),
    "no number": "steps;mm;dir\n" + lines("{c};{v:.4f};{s}\n") + "0;NaN;-\n",
    "commas in a serial monitor": lines("Step: {c}; Angle: {v:.4f} deg\n").replace(".", ","),
    "minutes with decimals": "step\tangle\tdir\n" + lines("{c}\t{m}\t{word}\n"),
    "milliseconds since 1970": "timestamp,steps,mm,dir\n" + lines("17000000{k:02d}000,{c},{v:.4f},{s}\n"),
    "time of day": "time,steps,mm,dir\n" + lines("{h},{c},{v:.4f},{s}\n"),
    "camonitor": lines(
        "T:Axis1-PosAct 2021-07-09 10:29:{k:02d}.000000 {c}\nT:Enc1 2021-07-09 10:29:{k:02d}.000000 {v:.4f}\n"
    ),
}


@pytest.mark.parametrize("name", WRITTEN)
def test_every_notation_gives_the_same_axis(ask, tmp_path, name):
    """Ratio and play of the classic line; a wrong side would halve the play, a wrong order lose it."""
    file, out = tmp_path / "log.txt", tmp_path / "out"
    file.write_text(WRITTEN[name], encoding="utf-8")
    code, document = ask("import", file, "--axis", "--to", out, "--yes")
    assert code == 0 and document["ok"] == len(readings()) and document["next"] == f"tvsbayes calibrate {out}"
    line = classic_axis(rows_of(read_axis(out)))
    # A second of arc or 1e-4 is the last digit written; the side of the first stop is unknown where it is not stated.
    without = ("serial", "clock", "camonitor", "commas in a serial monitor")
    loose = PLAY / 3200 if name in without else 1e-4 / 3200
    assert line.per_command == pytest.approx(RATIO, abs=loose)
    assert abs(line.backlash) == pytest.approx(PLAY, abs=2e-3)
    unit = {**dict.fromkeys(("dms", "minutes with decimals", *without), "deg"), "inch": "inch"}
    assert read_axis(out).unit == unit.get(name, "mm")
    times = [move.time_s for move in read_axis(out).moves if move.command == 3200]
    assert times == sorted(times) and times[-1] - times[0] < 3600


@pytest.mark.parametrize(
    ("file", "ratio", "play", "unit", "remark"),
    [
        # Truths and the scatter of stops of each file: its README in the layouts' collection.
        ("counts_wrap/log.csv", 1.024, 5.7, "counts", "whole turns 8 times, which are added: 4096 counts each"),
        ("direction_signs/log.csv", None, None, "mm", "u: none"),
        ("error_column_as_u/log.csv", 1.010, 0.08, "deg", "Error (deg) is Actual (deg) - Target (deg) in every row"),
        ("error_column_as_u/signed.csv", 1.010, 0.08, "deg", "a deviation, no uncertainty; set aside"),
        ("wide_forward_backward/dial.csv", 1.0012, 0.035, "mm", "runs: 4 columns"),
    ],
)
def test_observed_file_layouts(ask, tmp_path, file, ratio, play, unit, remark):
    out = tmp_path / "out"
    code, document = ask("import", FOREIGN / file, "--axis", "--to", out, "--yes")
    campaign = read_axis(out)
    rows = rows_of(campaign)
    line = classic_axis(rows)
    assert code == 0 and campaign.unit == unit and any(remark in text for text in document["assumed"])
    if ratio is not None:
        assert abs(line.per_command - ratio) < 4 * line.u_per_command
        assert abs(abs(line.backlash) - play) < 4 * line.u_backlash
    assert rows.both_sides and {reading.u for reading in campaign.readings} == {0.0}


SILENT = {
    # header and rows, the remark, and the last reading with its u
    "gon": ("steps,angle (gon)\n0,300\n100,350\n200,0\n300,50\n400,100\n", "400 gon each", (500.0, 0.0)),
    "expanded": ("steps,mm,U (k=2.5)\n0,0,0.5\n1,1,0.5\n2,2.1,0.5\n", "an expanded uncertainty, over 2.5", (2.1, 0.2)),
    "the command again": ("target,actual\n0,0\n1,1\n2,2\n", "equals the command in every row", (2.0, 0.0)),
    "a share of 100": ("target,actual,error %\n1,1.1,10\n2,2.1,5\n4,4.1,2.5\n", "u: none", (4.1, 0.0)),
}


@pytest.mark.parametrize("name", SILENT)
def test_assumptions_that_change_the_answer_are_reported(ask, tmp_path, name):
    content, remark, last = SILENT[name]
    file, out = tmp_path / "log.csv", tmp_path / "out"
    file.write_text(content)
    code, document = ask("import", file, "--axis", "--to", out, "--yes")
    reading = read_axis(out).readings[-1]
    assert code == 0 and any(remark in text for text in document["assumed"]) and (reading.value, reading.u) == last


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("by", ["position", "run", "column"])
def test_sides_of_a_compensated_axis_are_those_of_the_sheet(ask, tmp_path, by, seed):
    """Readings that barely differ from the targets, some of them alike, say nothing of sides; the sheet does."""
    rng, targets = np.random.default_rng(seed), [0, 20, 40, 60, 80]
    ways = [(t, side) for side in ("forward", "backward") for t in targets[:: 1 if side == "forward" else -1]]
    read = {way: f"{way[0] + rng.normal(0, 0.001):.3f}" for way in ways}
    order = sorted(ways, key=lambda way: way[0]) if by == "position" else ways
    rows = ["target (mm),direction,measured (mm)", *(f"{t},{side},{read[t, side]}" for t, side in order)]
    if by == "column":
        rows = [
            "target (mm),forward (mm),backward (mm)",
            *(f"{t},{read[t, ways[0][1]]},{read[t, ways[-1][1]]}" for t in targets),
        ]
    (tmp_path / "sheet.csv").write_text("\n".join(rows))
    assert ask("import", tmp_path / "sheet.csv", "--axis", "--to", tmp_path / "out", "--yes")[0] == 0
    campaign = read_axis(tmp_path / "out")
    arrived, before = {}, None
    for move in campaign.moves:
        rises = move.approach or ("forward" if before is None or move.command > before else "backward")
        arrived[move.move], before = (move.command, rises), move.command
    found = sorted((*arrived[reading.move], reading.value) for reading in campaign.readings)
    assert found == sorted((t, side, float(value)) for (t, side), value in read.items())


@pytest.mark.parametrize(
    "columns", ["target,direction,measured (mm)", "target,cycle,measured (mm)", "target,measured (mm)"]
)
def test_two_levels_of_one_position_are_two_stops_and_no_motion(ask, tmp_path, columns):
    """Four readings from either side, sorted by position: the first four do not move, whatever is stated of them."""
    rng, rows = np.random.default_rng(3), [columns]
    for target in range(6):
        for word, n, off in (("forward", 1, -0.03), ("backward", 2, 0.03)):
            values = {"direction": word, "cycle": f"{n}"}.get(columns.split(",")[1])
            middle = [] if values is None else [values]
            rows += [",".join([f"{target}", *middle, f"{target + off + rng.normal(0, 0.001):.4f}"]) for _ in range(4)]
    (tmp_path / "sheet.csv").write_text("\n".join(rows))
    code, document = ask(
        "import", tmp_path / "sheet.csv", "--axis", "--to", tmp_path / "out", "--unit", "value=mm", "--yes"
    )
    assert code == 0 and document["ok"] == 48 and not any("rest:" in text for text in document["assumed"])


def test_titles_of_direction_above_columns_of_dimensions(ask, tmp_path):
    """A "Cote" of numbers is a dimension: only "C\u00f4t\u00e9" of words is a column of sides."""
    blocks = [
        [title, "Cote (mm);Lecture (mm)", *(f"{t};{t + off}" for t in targets)]
        for title, targets, off in (("Avant 1", range(5), 0.25), ("Arri\u00e8re 1", range(4, -1, -1), 0.5))
    ]
    (tmp_path / "log.txt").write_text("\n".join(line for block in blocks for line in block), encoding="utf-8")
    code, document = ask("import", tmp_path / "log.txt", "--axis", "--to", tmp_path / "out", "--yes")
    assert code == 0 and document["columns"]["approach"]["column"] == "direction"


ROWS = [(c, f"{c + off:.3f}") for off, run in ((0.01, range(6)), (0.04, range(5, -1, -1))) for c in run]
"""Of an axis read to and fro."""


def markdown() -> str:
    """Two runs in thousandths of an inch."""
    rows = [f"{k} | {1000 * k + 1} | {1000 * k + 2}|" for k in range(5)]
    return "\n".join(['Position [inch] | Run 1 [0.001"] | Run 2 [0.001"]|', ":---: | :---: | :---:|", *rows])


def telemetry() -> str:
    """Ten rows a command: the first comes to rest two counts late, those of another flicker by two."""
    rows = [(1000, 994), *[(1000, 996)] * 9]
    for k in range(1, 5):
        at = 1000 + 200 * k
        rows += [(at, at - 170 + 40 * n) for n in range(4)] + [(at, at - 4 + (k == 3) * (n % 3)) for n in range(9)]
    return "\n".join(["target pos,pos", *(f"{c},{v}" for c, v in rows)])


@pytest.mark.parametrize(
    ("text", "unit", "readings"),
    [
        (markdown(), "inch", [1e-3 * (1000 * k + n) for n in (1, 2) for k in range(5)]),
        (
            telemetry(),
            "counts",
            [*[996] * 9, *(v - 4 + (v == 1600) * (n % 3) for v in range(1200, 2000, 200) for n in range(9))],
        ),
        (
            "Ist (mm);Soll (mm)\n" + "".join(f"{v};{c}\n" for c, v in [(-1, "#N/A"), *ROWS]),
            "mm",
            [float(v) for _, v in ROWS],
        ),
    ],
    ids=["an inch in Markdown", "a row that still moves", "a row that begins with no value"],
)
def test_small_marks_that_change_what_is_read(ask, tmp_path, text, unit, readings):
    (tmp_path / "log.txt").write_text(text, encoding="utf-8")
    code, _ = ask("import", tmp_path / "log.txt", "--axis", "--to", tmp_path / "out", "--yes", "--runs", "forward")
    campaign = read_axis(tmp_path / "out")
    assert code == 0 and campaign.unit == unit
    assert [reading.value for reading in campaign.readings] == pytest.approx(readings)
    # A command that was not read is a move.
    assert campaign.moves[0].command == (-1 if "#N/A" in text else campaign.moves[0].command)


def test_a_position_beside_a_deviation_and_a_column_of_nobodys_words_is_asked(ask, tmp_path):
    rows = [f"{c};{v};{float(v) - c:.3f}" for c, v in ROWS]
    (tmp_path / "log.csv").write_text("\n".join(["Fahrwunsch (mm);Winkel (mm);Abw (mm)", *rows]), encoding="utf-8")
    assert_error(ask("import", tmp_path / "log.csv", "--axis", "--to", tmp_path / "out", "--yes")[1], "missing-column")


@pytest.mark.parametrize("unit", ["", " mm"])
def test_the_commands_of_another_axis_name_no_machine(ask, tmp_path, unit):
    rows = [f"{c}{unit}\t{v}{unit}\t{c}{unit}\t{v}{unit}" for c, v in ROWS]
    head = "Joint 1 DEMAND\tJoint 1 FEEDBACK\tJoint 2 DEMAND\tJoint 2 FEEDBACK"
    (tmp_path / "log.dat").write_text("\n".join([head, *rows]))
    answer = ("--column", "command=Joint 1 DEMAND", "--column", "value=Joint 1 FEEDBACK")
    code, document = ask("import", tmp_path / "log.dat", "--axis", "--to", tmp_path / "out", "--yes", *answer)
    assert code == 0 and document["ok"] == len(ROWS)


def test_numbers_of_homings_may_have_a_sign(ask, tmp_path):
    rows = [f"+{1 + k // len(ROWS)},{c},{v}" for k, (c, v) in enumerate([*ROWS, *ROWS])]
    (tmp_path / "log.csv").write_text("\n".join(["homing,target (mm),measured (mm)", *rows]))
    assert ask("import", tmp_path / "log.csv", "--axis", "--to", tmp_path / "out", "--yes")[0] == 0
    assert {move.segment for move in read_axis(tmp_path / "out").moves} == {0, 1}


def test_a_sheet_of_words_before_a_table_with_units_in_its_cells(ask, tmp_path):
    book = openpyxl.Workbook()
    book.active.append(["Operator: A. B."])
    page = book.create_sheet("Data")
    for row in (("Motor (rev)", "Reading"), *((c, f"{v} mm") for c, v in ROWS)):
        page.append(row)
    book.save(tmp_path / "log.xlsx")
    code, document = ask("import", tmp_path / "log.xlsx", "--axis", "--to", tmp_path / "out", "--yes")
    assert code == 0 and document["ok"] == len(ROWS)


@pytest.mark.parametrize(("unit", "turned"), [("", False), (" (deg)", True)])
def test_play_of_an_unknown_unit_is_no_turn(ask, tmp_path, unit, turned):
    """Where the commands turn back and nowhere else degrees jump by a turn, readings of no unit by their play."""
    values = [(c, 10 * c) for c in range(8)] + [(c, 10 * c + 360) for c in range(6, -1, -1)]
    (tmp_path / "log.csv").write_text("\n".join([f"steps,reading{unit}", *(f"{c},{v}.5" for c, v in values)]))
    code, _ = ask("import", tmp_path / "log.csv", "--axis", "--to", tmp_path / "out", "--yes")
    read = [reading.value for reading in read_axis(tmp_path / "out").readings]
    assert code == 0 and read == [v + 0.5 - 360 * (turned and k > 7) for k, (_, v) in enumerate(values)]


def test_a_reading_at_standstill_is_one_where_readings_show_it(ask, tmp_path):
    """The direction of a log may be that of the next move: the end of a run is then read twice from one side."""
    values = [(c, 1, c + 0.1) for c in range(6)] + [(5, -1, 5.1)] + [(c, -1, c - 0.1) for c in range(4, -1, -1)]
    rows = [f"{c},{'forward' if side > 0 else 'backward'},{v:.3f}" for c, side, v in values]
    (tmp_path / "log.csv").write_text("\n".join(["target (mm),direction,measured (mm)", *rows]))
    code, document = ask("import", tmp_path / "log.csv", "--axis", "--to", tmp_path / "out", "--yes")
    assert code == 0 and document["moves"] == 11
    assert any("1 row at the command before" in text for text in document["assumed"])


def test_a_workbook_needs_no_format(ask, tmp_path):
    """Its bytes contain the end marker of a message of Klipper's logger."""
    file, out, book = tmp_path / "dial.xlsx", tmp_path / "out", openpyxl.Workbook()
    book.active.append(["Position (mm)", "Forward (mm)", "Backward (mm)"])
    for position in range(0, 50, 10):
        book.active.append([position, 1.001 * position, 1.001 * position + PLAY])
    book.save(file)
    code, document = ask("import", file, "--axis", "--to", out, "--yes")
    assert (code, document["readings"]) == (0, 10)
    line = classic_axis(rows_of(read_axis(out)))
    assert line.per_command == pytest.approx(1.001, abs=1e-6) and abs(line.backlash) == pytest.approx(PLAY, abs=1e-6)


def test_greek_letters_in_utf_16_are_no_log(ask, tmp_path):
    """Their high byte is the end marker of a message of Klipper's logger."""
    file, out = tmp_path / "dial.csv", tmp_path / "out"
    rows = "".join(f"{10 * k};{10.01 * k:.3f}\n" for k in range(9))
    file.write_text(f"Position (mm);\u03bb laser (mm)\n{rows}", encoding="utf-16")
    code, document = ask("import", file, "--axis", "--to", out, "--yes", "--column", "value=\u03bb laser (mm)")
    assert (code, document["readings"]) == (0, 9)


def test_deviations_by_option(ask, tmp_path):
    """A sheet of target and error alone: positions are target plus error, in their own unit."""
    file, out = tmp_path / "log.csv", tmp_path / "out"
    rows = [(10.0 * k, 0.002 * k + 0.05 * (side < 0), side) for side in (1, -1) for k in range(0, 10)[::side]]
    file.write_text("Target (mm),Dir,Deviation (um)\n" + "".join(f"{c},{s},{1000 * d:.1f}\n" for c, d, s in rows))
    stated = ("--column", "value=Deviation (um)")
    code, document = ask("import", file, "--axis", "--to", out, "--yes")
    assert code == 2 and "--deviations" in assert_error(document, "deviations")["remedy"]
    code, document = ask("import", file, "--axis", "--to", out, "--yes", *stated, "--deviations")
    line = classic_axis(rows_of(read_axis(out)))
    assert code == 0 and read_axis(out).unit == "mm"
    assert line.per_command == pytest.approx(1.0002, abs=1e-6) and abs(line.backlash) == pytest.approx(0.05, abs=2e-4)


GUIDE = """Guiding Begins at 2026-01-02 21:00:00
Pixel scale = 2.0 arc-sec/px, Binning = 1, Focal length = 500 mm
Mount = A Mount,  connected, guiding enabled, xAngle = 1.0, xRate = 3.0, yAngle = 2.0, yRate = 3.0, parity = +/-
Dec = 20.0 deg, Hour angle = -1.90 hr, Pier side = West, Rotator pos = N/A
Frame,Time,mount,dx,dy,RARawDistance,DECRawDistance,RAGuideDistance,DECGuideDistance,RADuration,RADirection,ErrorCode
"""


def night(frames: int) -> str:
    rows = "".join(f'{k},{3 * k},"Mount",0,0,{math.sin(k / 40):.3f},0,0,0,0,,0\n' for k in range(1, frames))
    return GUIDE + rows + "Guiding Ends at 2026-01-02 22:00:00\n"


def test_a_guide_log_is_listed_and_one_run_taken(ask, say, tmp_path):
    """`--yes` without a run does not select the first of several."""
    file, out = tmp_path / "PHD2_GuideLog.txt", tmp_path / "out"
    file.write_text(night(20) + "\n" + night(300))
    code, document = ask("import", file, "--axis", "--to", out)
    assert code == 0 and [run["frames"] for run in document["runs"]] == [19, 299] and document["files"] == []
    assert (
        f"next: `tvsbayes import {file} --axis --run 2 --to {out} --yes`"
        in say("import", file, "--axis", "--to", out)[1]
    )
    code, document = ask("import", file, "--axis", "--to", out, "--yes")
    assert code == 2 and "--run 2" in assert_error(document, "usage")["remedy"] and not out.exists()
    code, document = ask("import", file, "--axis", "--to", out, "--yes", "--run", 2)
    assert (code, document["readings"], document["moves"]) == (0, 299, 1)
    toml = (out / "campaign.toml").read_text()
    assert "period_between = [60.0, 298.0]" in toml and 'periods_in = "seconds"' in toml and "rate = 15.04" in toml
    assert "campaign.toml: period_between = [60.0, 298.0]" in document["assumed"]


TABLE = "steps;reading (mm);direction\n" + lines("{c};{v:.4f};{s}\n")
MISTAKES = {
    # content, options, part of the message, part of the remedy
    "directions the other way": (
        TABLE.replace(";+\n", ";~\n").replace(";-\n", ";+\n").replace(";~\n", ";-\n"),
        (),
        "forward where commands rise",
        "--column approach=",
    ),
    "directions of nobody": (
        TABLE.replace(";+", ";cw").replace(";cw", ";x", 1),
        (),
        "forward or backward, + or -",
        "--column approach=",
    ),
    "a word among readings": (TABLE.replace("5.0000", "abc", 1), (), 'found "abc"', "correct the cell"),
    "two readings": ("steps,mm,deg\n0,1,2\n1,2,3\n", (), "value", "--column value=mm"),
    "no names": ("0,1\n5,2\n10,3\n", (), "no column that is surely", "--column 'command=column 1'"),
    "counts that wrap at another number": (
        "steps,encoder counts\n" + "".join(f"{100 * k},{97 * k % 1000}\n" for k in range(60)),
        (),
        "jump by about 1000 counts",
        "--counts-per-turn 1000",
    ),
    "times that run back": ("t,steps,angle\n0,0,1\n2,1,2\n1,2,3\n", (), "times that do not decrease", "time_s="),
    "names alone": ("steps,mm\n", (), "no rows below the names", "with the data"),
    "an unknown format": (TABLE, ("--format", "phd"), "--format phd", "phd2"),
    "a table as a guide log": (TABLE, ("--format", "phd2"), "no run with frames", "holds guiding"),
    "a run of a table": (TABLE, ("--run", 1), "--run is of another kind of file", "--format"),
    "a column of a guide log": (night(99), ("--column", "u=dx"), "--column is of another kind", "leave it out"),
    "a run that is not there": (night(99), ("--run", 3), "holds 1 runs", "list"),
    "an assumption of nobody": (night(99), ("--assume", "dec=3"), "--assume dec=3", "declination_deg=45.9"),
    "an assumption that is no number": (night(99), ("--assume", "declination_deg=x"), "allowed:", "declination_deg"),
    "a declination unknown": (night(99).replace("Dec = 20.0 deg", "Dec = Unknown"), (), "declination", "--assume"),
    "series of nobody": (
        WRITTEN["camonitor"].replace("Axis1", "A").replace("Enc1", "B"),
        (),
        "series that change",
        "--column command=T:A-PosAct",
    ),
    "an angle sensor alone": ('{"q": "angle:a", "params": {"data": [[1, 2]]}}\x03', (), "angle:a", "data_logger.py"),
    "minutes beyond 60": ("steps;angle\n0;1\u00b061'00\"\n1;2\u00b000'00\"\n", (), 'found "1', "correct the cell"),
    "two notations in a column": ("steps;angle\n0;1 mm\n1;2 deg\n", (), 'found "1 mm"', "correct the cell"),
    "a guide log without --axis": (night(99), None, "PHD2, KStars or MaxIm, which is of one axis", "with --axis"),
    "camonitor without --axis": (WRITTEN["camonitor"], None, "a log of EPICS", "with --axis"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_refused_in_one_sentence_with_a_remedy(ask, tmp_path, name):
    """Nothing is written, and the message is one line; what each reader refuses is in its own tests."""
    content, options, message, remedy = MISTAKES[name]
    file, out = tmp_path / "log.txt", tmp_path / "out"
    file.write_text(content, encoding="utf-8")
    code, document = ask("import", file, "--to", out, "--yes", *(("--axis", *options) if options is not None else ()))
    error = document["error"]
    assert code == 2 and not out.exists()
    assert message in error["message"] and remedy in error["remedy"]
    # A question goes on with the command line of each answer.
    said = error["message"].partition("; say which")[0]
    assert "\n" not in error["message"] and len(said) < 600
