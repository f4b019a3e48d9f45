"""Habits of people and programs, a case each: what is read of a file, or what is said of it."""

from __future__ import annotations

import pytest

from tvsbayes.errors import InputError, Question
from tvsbayes.importing.axis import axis_rows
from tvsbayes.importing.cells import Wishes
from tvsbayes.importing.looks import look_columns, look_rows
from tvsbayes.importing.reader import read_foreign
from tvsbayes.importing.sightings import sighting_rows

PLACES = [0, 10, 20, 30, 40, 50]
UP, DOWN = ([round(1.0002 * p - side, 4) for p in PLACES] for side in (0.02, -0.02))
COMMANDS, READ = PLACES + PLACES[::-1], UP + DOWN[::-1]
ROWS = list(zip(COMMANDS, READ, strict=True))


def sheet(names: str, *columns) -> str:
    return "\n".join([names, *(",".join(map(str, row)) for row in zip(*columns, strict=True)), ""])


def lines(form: str) -> str:
    return "".join(form.format(c=c, v=v, k=k) for k, (c, v) in enumerate(ROWS))


def marked(*words: str, of: int = 6) -> list[str]:
    return [word for word in words for _ in range(of)]


def plc(below: str) -> str:
    return f"t;Axis.SetPos;Axis.ActPos\n{below}\n" + lines("{k};{c};{v}\n")


READ_AS_THEY_ARE = {
    "the uncertainty of last digits": sheet("Pos (mm),Ist (mm)", COMMANDS, [f"{v:.4f}(20)" for v in READ]),
    "month/day/year": sheet(
        "time,Pos (mm),Ist (mm)", [f"3/14/2026 1:{k:02d}:00 PM" for k in range(12)], COMMANDS, READ
    ),
    "day/month/year": sheet("time,Pos (mm),Ist (mm)", [f"14/3/2026 13:{k:02d}" for k in range(12)], COMMANDS, READ),
    "one day": sheet("time,Pos (mm),Ist (mm)", [f"3/4/2026 13:{k:02d}" for k in range(12)], COMMANDS, READ),
    "words and numbers": lines("TARGET {c} / ANGLE {v}\n"),
    "words and numbers in turn": lines("SETPOINT {c}\nANGLE {v}\n"),
    "levels": lines("INFO target={c} actual={v}\n"),
    "a logger's lines": lines("2026-01-02 10:{k:02d}:00,123 - stage - INFO - target: {c}, actual: {v}\n"),
    "a logger's names": lines("INFO:stage:target: {c} actual: {v}\n"),
    "units of a controller": plc("s;mm;mm"),
    "types of a controller": plc("TIME;LREAL;LREAL"),
    "types and units of a controller": plc("LREAL;LREAL;LREAL\nUnit;mm;mm"),
    "a monitor": lines("M.VAL 2026-10-25 10:{k:02d}:00.0 {c}\nM.RBV 2026-10-25 10:{k:02d}:10.0 {v}\n"),
}


def rows_of(text: str, tmp_path, wishes: Wishes | None = None):
    (tmp_path / "t.csv").write_text(text, encoding="utf-8")
    return axis_rows(read_foreign(tmp_path / "t.csv"), wishes or Wishes())


@pytest.mark.parametrize("habit", READ_AS_THEY_ARE)
def test_readings_are_read_as_they_are(habit, say, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "t.csv").write_text(READ_AS_THEY_ARE[habit], encoding="utf-8")
    code, *texts = say("import", "t.csv", "--axis", "--to", "out", "--yes")
    assert code == 0, texts
    moves, readings = (
        [line.split(",") for line in (tmp_path / "out" / name).read_text().splitlines()[1:]]
        for name in ("moves.csv", "readings.csv")
    )
    commands = {row[0]: float(row[3]) for row in moves}
    assert [(commands[row[1]], float(row[2])) for row in readings] == ROWS
    if habit.startswith("the uncertainty"):
        assert {float(row[3]) for row in readings} == {0.002}
    if habit in ("month/day/year", "day/month/year", "one day", "a monitor", "a logger's lines"):
        assert [float(row[2]) for row in moves] == [60.0 * k for k in range(12) if k != 6]


def test_moves_by_their_word_may_be_lengths(tmp_path):
    with pytest.raises(Question, match="lengths of moves") as asked:
        rows_of(lines("MOVE {c} / ANGLE {v}\n"), tmp_path)
    assert [c.options for c in asked.value.candidates] == [("--relative",), ("--column", "command=MOVE")]


SIDES = {
    "0 and 1": marked("0", "1"),
    "1 and 0": marked("1", "0"),
    "out and in": marked("out", "in"),
    "hin and her": marked("hin", "her"),
    "in the first row of a block": ["up", *[""] * 5, "down", *[""] * 5],
}


@pytest.mark.parametrize("words", SIDES)
def test_sides_by_words_and_commands(words, tmp_path):
    rows = rows_of(sheet("Pos (mm),dir,Ist (mm)", COMMANDS, SIDES[words], READ), tmp_path)
    moves = {move["move"]: move for move in rows.moves}
    assert [r["value"] for r in rows.readings] == READ and rows.moves[0]["approach"] == "forward"
    steps = [moves[r["move"]]["command"] - moves[r["move"] - 1]["command"] for r in rows.readings[1:]]
    assert [step > 0 for step in steps] == [True] * 5 + [False] * 6


def test_the_side_of_a_block_that_is_sorted_upwards(tmp_path):
    """Each of its readings is approached from above."""
    sides = ["vor", *[""] * 5, "zur\u00fcck", *[""] * 5]
    rows = rows_of(sheet("Pos (mm),Richtung,Ist (mm)", PLACES * 2, sides, UP + DOWN), tmp_path)
    commands = [move["command"] for move in rows.moves]
    falls = [commands[r["move"]] < commands[r["move"] - 1] for r in rows.readings[1:]]
    assert falls == [False] * 5 + [True] * 6
    homed = sheet("Pos (mm),approach,Ist (mm),segment", PLACES * 2, sides, UP + DOWN, marked("0", "1"))
    assert not any("assumed" in move for move in rows_of(homed, tmp_path).moves)


def test_one_way_runs_out_and_back_in_groups(tmp_path):
    rows = rows_of(sheet("Pos (mm),Hin 1,Hin 2,Hin 3,Her 1,Her 2", PLACES, UP, UP, UP, DOWN, DOWN), tmp_path)
    assert [r["value"] for r in rows.readings] == [*(UP + DOWN[::-1]) * 2, *UP]


def test_a_doubted_reading_is_left_out_and_named(tmp_path):
    read = [f"{v}?" if k == 3 else v for k, v in enumerate(READ)]
    rows = rows_of(sheet("Pos (mm),Ist (mm)", COMMANDS, read), tmp_path)
    assert [r["value"] for r in rows.readings] == READ[:3] + READ[4:] and "29.986? in line 5" in rows.lines[0]


def test_a_multiple_of_a_standard_deviation_is_said(tmp_path):
    rows = rows_of(sheet("Pos (mm),Ist (mm),2 sd (um)", COMMANDS, READ, marked("3", of=12)), tmp_path)
    assert rows.readings[0]["u"] == 0.0015
    assert any("2 standard deviations, taken as an expanded uncertainty, over 2" in text for text in rows.assumed)


def test_the_title_of_a_column_stays_its_name(tmp_path):
    seconds = [round(3600 * v, 1) for v in READ]
    text = sheet('cmd (deg),read ("),check (")', COMMANDS, seconds, [0.9 * s for s in seconds])
    rows = rows_of(text, tmp_path, Wishes(columns={"value": 'read (")'}))
    assert [r["value"] for r in rows.readings] == seconds and rows.unit == "arcsec"
    assert 'read (") taken as read (arcsec)' in rows.lines[0]


def test_homings_in_remarks_between_rows(tmp_path):
    run = lines("{c} {v}\n")
    rows = rows_of(
        f"# cmd(mm) read(mm)\n# --- home ---\n{run}# lamp off\n# --- home again ---\n{run}# 5 5.1\n", tmp_path
    )
    assert [m["segment"] for m in rows.moves] == [0] * 11 + [1] * 11
    assert [r["value"] for r in rows.readings] == READ * 2


def test_units_that_lines_above_state_by_column(tmp_path):
    errors = [round(1000 * (v - c), 1) for c, v in ROWS[:6]]
    names = "Einheit Position: mm,,Abweichung: \u00b5m\n,,\nPosition,1\u2191,1\u2193\n"
    text = names + sheet("", PLACES, errors, [e + 40 for e in errors]).lstrip()
    rows = rows_of(text, tmp_path, Wishes(deviations=True))
    assert rows.axis == {"command_unit": "mm"} and rows.unit == "mm"
    assert [r["value"] for r in rows.readings] == pytest.approx(UP + [v + 0.04 for v in UP[::-1]])


def test_deviations_come_first_where_readings_hardly_follow(tmp_path):
    errors = [round(0.0098 * p + 0.2 * (k % 2), 2) for k, p in enumerate(PLACES)]
    with pytest.raises(Question) as asked:
        rows_of("Units: um\n\n" + sheet("Target (mm),Run 1 +,Run 1 -", PLACES, errors, errors), tmp_path)
    assert asked.value.candidates[0].options == ("--deviations",)


def test_cameras_counted_from_0_in_names(tmp_path):
    (tmp_path / "t.csv").write_text(
        "pan,tilt,cam0_x,cam0_y,cam1_x,cam1_y\n0,0,630,400,600,401\n100,0,640,400,610,401\n"
    )
    looks = look_rows(look_columns(read_foreign(tmp_path / "t.csv"), {}), Wishes()).looks
    assert [(k["u_left_px"], k["v_right_px"]) for k in looks] == [(630, 401), (640, 401)]


RISING = [p for p in PLACES for _ in range(2)]
PAIRED = [v for pair in zip(UP, DOWN, strict=True) for v in pair]
ERRORS = [round(1000 * (v - c), 1) for c, v in zip(PLACES, UP, strict=True)]
NAMED = {
    "a step that counts rows beside a goto": (sheet("step,goto (mm),dial (mm)", range(1, 13), COMMANDS, READ), {}),
    "a current position": (sheet("SetpointPosition\tCurrentPosition", COMMANDS, READ).replace(",", "\t"), {}),
    "MOV beside POS?": (sheet("MOV 1,POS? 1,Interferometer", COMMANDS, [c + 0.0002 for c in COMMANDS], READ), {}),
    "a temperature called T": (
        sheet("target_mm,laser_mm,T_scale_C", COMMANDS, READ, [20 + 0.1 * k for k in range(12)]),
        {},
    ),
    "one unit behind all names": ("# x_cmd x_meas [mm]\n" + lines("{c} {v}\n") + "# break\n", {}),
    "runs that the user orders": (sheet("Cote (mm);A1;R1", PLACES, UP, DOWN).replace(",", ";"), {"order": "alternate"}),
    "runs called moving": (sheet("X (mm),moving left,moving right", PLACES, UP, DOWN), {"order": "alternate"}),
    "units of targets and errors": (
        "Units,mm\nTarget units,mm\nError units,\u00b5m\n\n"
        + sheet("Target,Run 1 (+),Run 1 (-)", PLACES, ERRORS, [e + 40 for e in ERRORS]),
        {"deviations": True},
    ),
    "units of readings and positions": (
        "Messwerte in \u00b5m, Position in mm\n" + sheet("Position,Messwert", COMMANDS, [1000 * v for v in READ]),
        {},
    ),
}


@pytest.mark.parametrize("habit", NAMED)
def test_columns_and_units_by_what_the_file_says(habit, tmp_path):
    text, stated = NAMED[habit]
    rows = rows_of(text, tmp_path, Wishes(**stated))
    commands = [rows.moves[r["move"]]["command"] for r in rows.readings]
    scale = 1000 if rows.unit == "um" else 1
    assert commands == COMMANDS and [r["value"] / scale for r in rows.readings] == pytest.approx(READ)


@pytest.mark.parametrize(
    ("name", "words"),
    [("Anfahrt von", ("unten", "oben")), ("approach from", ("-", "+")), ("from", ("below", "above")), ("dir", "+-")],
)
def test_a_side_is_where_the_axis_came_from(name, words, tmp_path):
    rows = rows_of(sheet(f"target (mm),{name},measured (mm)", RISING, [*words] * 6, PAIRED), tmp_path)
    commands = [move["command"] for move in rows.moves]
    assert [commands[r["move"]] > commands[r["move"] - 1] for r in rows.readings[1:]] == [False, True] * 5 + [False]


@pytest.mark.parametrize("words", [("andata", "ritorno"), ("edestakaisin", "takaisin")])
def test_two_words_that_follow_the_commands_are_sides(words, tmp_path):
    rows = rows_of(sheet("vaihe,target (mm),measured (mm)", marked(*words), COMMANDS, READ), tmp_path)
    assert len(rows.readings) == 12 == len(rows.moves) - 1 and rows.moves[0]["approach"] == "forward"


def test_minutes_beside_degrees_are_minutes_of_arc(tmp_path):
    rows = rows_of("steps,deg,min\n0,0,2.5\n500,1,1.0\n1000,2,3.5\n1500,3,2.0\n", tmp_path)
    assert [r["value"] for r in rows.readings] == pytest.approx([2.5 / 60, 1 + 1 / 60, 2 + 3.5 / 60, 3 + 2 / 60])


def test_a_deviation_beside_other_readings_is_offered(tmp_path):
    pitch, yaw = [0.002 * c for c in COMMANDS], [0.004 * c + 0.01 for c in COMMANDS]
    text = sheet("Position,Linear Error (um),Pitch (arcsec),Yaw (arcsec)", COMMANDS, ERRORS + ERRORS[::-1], pitch, yaw)
    with pytest.raises(Question) as asked:
        rows_of(text, tmp_path)
    options = ("--column", "value=Linear Error (um)", "--deviations")
    assert options in [candidate.options for candidate in asked.value.candidates]


def test_a_block_for_each_camera_is_refused(tmp_path):
    block = lines("{c} 0 6{c} 400\n")
    (tmp_path / "t.csv").write_text(f"# left camera\n# pan tilt x y\n{block}# right camera\n{block}")
    with pytest.raises(InputError, match="left camera, right camera under titles"):
        read_foreign(tmp_path / "t.csv")


@pytest.mark.parametrize("read", ["0.002 10,004 20,001 30.003", "0 10.000 20.010 30.000", "3 10,004 20,000 7"])
def test_marks_that_may_be_of_thousands_are_refused(read, tmp_path):
    with pytest.raises(InputError, match="between thousands or before decimals"):
        rows_of("\n".join(["target;read", *(f"{10 * k};{v}" for k, v in enumerate(read.split()))]), tmp_path)


def test_tenths_beside_inches_are_a_machinists(tmp_path):
    rows = rows_of(sheet("X (in),dial (tenths)", [0, 1, 2, 1, 0], [0, 1, 3, 4, 2]), tmp_path, Wishes(deviations=True))
    assert [r["value"] for r in rows.readings] == pytest.approx([0, 1.0001, 2.0003, 1.0004, 0.0002])


def test_units_in_brackets_above_the_names(tmp_path):
    text = "Position [mm] vs error [um], axis Z\n" + sheet("Pos,Err", PLACES, ERRORS)
    assert [r["value"] for r in rows_of(text, tmp_path, Wishes(deviations=True)).readings] == pytest.approx(UP)


def test_directions_in_remarks_between_rows(tmp_path):
    up, down = (lines("{c} {v}\n").splitlines(keepends=True)[part] for part in (slice(6), slice(6, None)))
    rows = rows_of("".join(["# run 1 up\n# pos_mm read_mm\n", *up, "# run 1 down\n", *down]), tmp_path)
    assert len(rows.readings) == 12 and rows.moves[0]["approach"] == "forward"


def test_a_column_that_counts_rows_is_no_command_beside_positions(tmp_path):
    rows = rows_of(sheet("Step,Position (mm),Measured (mm)", range(1, 13), COMMANDS, READ), tmp_path)
    assert [m["command"] for m in rows.moves] == PLACES + PLACES[-2::-1]


def test_turns_that_are_counted_beside_angles_are_asked_about(tmp_path):
    angles = [0, 90, 180, 270] * 3
    text = sheet("rev,angle,encoder_deg", marked("0", "1", "2", of=4), angles, [a + 0.01 for a in angles])
    with pytest.raises(Question) as asked:
        rows_of(text, tmp_path)
    assert asked.value.candidates[0].options == ("--assume", "command_turn=360")


def test_a_mil_of_an_angle_is_none_of_an_inch(tmp_path):
    with pytest.raises(Question, match="angular mil"):
        rows_of(sheet("steps,angle (mil)", COMMANDS, READ), tmp_path)


@pytest.mark.parametrize(("name", "factor"), [("azimuth (h)", 15.0), ("azimuth (mil)", None), ("azimuth (mm)", None)])
def test_units_of_directions_that_are_no_angles(name, factor, tmp_path):
    angles = [round(0.5 + 0.05 * k, 3) for k in range(8)]
    (tmp_path / "t.csv").write_text(sheet(f"pan,tilt,{name},el (deg)", range(0, 80, 10), [0] * 8, angles, [5.5] * 8))
    if factor is None:
        with pytest.raises(Question, match="not known"):
            sighting_rows(read_foreign(tmp_path / "t.csv"), Wishes())
    else:
        found = sighting_rows(read_foreign(tmp_path / "t.csv"), Wishes()).sightings
        assert [s["azimuth_deg"] for s in found] == pytest.approx([factor * a for a in angles])


STATES = {
    "state": ("as found", "as left"),
    "Zustand": ("vorher", "nachher"),
    "condition": ("before adj.", "after adj."),
    "note": ("before repair", "after repair"),
    "machine": ("A", "B"),
}


@pytest.mark.parametrize("name", STATES)
def test_rows_in_two_states_are_two_campaigns(name, tmp_path):
    text = sheet(f"target (mm),reading (mm),{name}", COMMANDS * 2, READ + UP + UP[::-1], marked(*STATES[name], of=12))
    with pytest.raises(InputError, match=f"rows of {', '.join(STATES[name])} in column {name}"):
        rows_of(text, tmp_path)
    with pytest.raises(InputError, match="rows of As found, As left under titles"):
        table = sheet("target (mm),reading (mm)", COMMANDS, READ)
        rows_of(f"As found\n{table}As left\n{table}", tmp_path)


@pytest.mark.parametrize("cameras", [("left", "right"), ("L", "R"), ("0", "1"), ("1", "2"), ("cam0", "cam1")])
@pytest.mark.parametrize("targets", [("T1", "T2"), ("left wall", "right wall"), ("R Leo", "L Pup"), ("near", "far")])
def test_a_target_beside_the_camera_of_a_row(cameras, targets, tmp_path):
    rows = [
        f"{100 * k},0,{targets[k % 2]},{camera},{600 + 30 * (camera == cameras[0])},{400 + k}"
        for k in range(4)
        for camera in cameras
    ]
    (tmp_path / "t.csv").write_text("\n".join(["pan,tilt,target,camera,u,v", *rows, ""]))
    looks = look_rows(look_columns(read_foreign(tmp_path / "t.csv"), {}), Wishes()).looks
    assert [(k["target"], k["u_left_px"], k["u_right_px"]) for k in looks] == [(t, 630, 600) for t in targets * 2]


@pytest.mark.parametrize(
    "said",
    [
        *("Units: um deviations, positions in mm", "Deviations in um, positions in mm"),
        *("Positions [mm], mm deviations in um", "Position : mm, deviation : um"),
    ],
)
def test_a_unit_before_what_is_in_it(said, tmp_path):
    text = f"{said}\n" + sheet("Target,Deviation", COMMANDS, [round(1e3 * (v - c), 1) for c, v in ROWS])
    rows = rows_of(text, tmp_path, Wishes(deviations=True))
    assert [r["value"] for r in rows.readings] == pytest.approx(READ, abs=1e-9)


def test_a_status_of_no_word_that_is_known_is_none(tmp_path):
    columns = (range(0, 800, 200), range(0, 400, 100), range(10, 50, 10), range(20, 60, 10))
    for word, used in (("converged", True), ("failed", False)):
        text = sheet("pan_steps,tilt_steps,azimuth_deg,elevation_deg,status", *columns, [word] * 4)
        (tmp_path / f"{word}.csv").write_text(text)
        found = sighting_rows(read_foreign(tmp_path / f"{word}.csv"), Wishes())
        assert [s["status"] == "ok" for s in found.sightings] == [used] * 4
        assert used == any("would leave out every sighting, so it is none" in line for line in found.assumed)
