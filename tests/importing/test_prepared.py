"""Tables as people keep them: marks of rows, rows out of order, notations, angles in parts, lost readings."""

from __future__ import annotations

import numpy as np
import pytest

from tvsbayes.errors import InputError, Question
from tvsbayes.importing import columns
from tvsbayes.importing.axis import axis_rows
from tvsbayes.importing.cells import Wishes
from tvsbayes.importing.columns import line_through
from tvsbayes.importing.looks import look_columns, look_rows
from tvsbayes.importing.reader import read_foreign
from tvsbayes.importing.sightings import sighting_rows

PLACES = np.array([0.0, 10, 20, 30, 40, 50, 40, 30, 20, 10, 0])
READ = np.round(PLACES * 1.0002 - 0.02 * np.r_[np.ones(6), -np.ones(5)] + 0.003 * (np.arange(11) % 3), 4)
BAD = (3, 7)
"""Rows that are not to be used."""


def table(tmp_path, *rows, name: str = "t.csv"):
    path = tmp_path / name
    path.write_text("\n".join([*rows, ""]), encoding="utf-8")
    return read_foreign(path)


def sheet(tmp_path, names: str, *columns):
    return table(tmp_path, names, *(",".join(map(str, row)) for row in zip(*columns, strict=True)))


def marked(good: object, bad: object) -> list[object]:
    return [bad if row in BAD else good for row in range(len(PLACES))]


MARKS = {
    **dict.fromkeys(("Outlier?", "exclude", "Verworfen", "saturated", "failed"), ("no", "yes")),
    **dict.fromkeys(("rejected", "skip", "err", "Alarm"), ("", "x")),
    **{"fault_code": (0, 17), "Error code": ("", "E03"), "err flag": (0, 1), "errors": (0, 4)},
    **{"use": ("y", "n"), "OK?": ("\u2713", "\u2717"), "Valid": ("WAHR", "FALSCH"), "beam": ("ok", "lost")},
    **{"solved": ("True", "False"), "Bewertung": ("i.O.", "n.i.O.")},
}


@pytest.mark.parametrize("name", MARKS)
def test_rows_that_a_column_marks_are_left_out(name, tmp_path):
    rows = axis_rows(sheet(tmp_path, f"command (mm),reading (mm),{name}", PLACES, READ, marked(*MARKS[name])), Wishes())
    assert [k for k, r in enumerate(rows.readings) if r["status"] != "ok"] == [*BAD]
    assert any("2 readings left out" in text for text in rows.assumed)


def test_out_of_tolerance_is_no_fault_of_a_reading(tmp_path):
    columns = PLACES, READ, [25] * 11, marked("PASS", "FAIL")
    rows = axis_rows(sheet(tmp_path, "command (mm),reading (mm),Tolerance (um),Result", *columns), Wishes())
    assert {r["status"] for r in rows.readings} == {"ok"}


def test_a_look_is_good_where_both_cameras_are(tmp_path):
    pixels = [np.linspace(300, 500, 11) + 7 * k for k in range(4)]
    left, right = (["0" if row == bad else "1" for row in range(11)] for bad in BAD)
    names = "pan_steps,tilt_steps,xl,yl,xr,yr,valid_l,valid_r"
    foreign = sheet(tmp_path, names, 100 * np.arange(11), [0] * 11, *pixels, left, right)
    rows = look_rows(look_columns(foreign, {}), Wishes())
    assert [k for k, look in enumerate(rows.looks) if look["status"] != "ok"] == [*BAD]


@pytest.mark.parametrize("fill", ["-9999", "9.9E+37", "999.999", "0.000", "-1"])
def test_numbers_that_stand_for_no_reading(fill, tmp_path):
    read = marked("", fill)
    foreign = sheet(tmp_path, "command (mm),reading (mm)", PLACES, [a or b for a, b in zip(read, READ, strict=True)])
    with pytest.raises(Question) as asked:
        axis_rows(foreign, Wishes())
    first, second = (candidate.options for candidate in asked.value.candidates)
    number = float(first[1].partition("=")[2])
    assert first[0] == "--assume" and number == float(fill)
    rows = axis_rows(foreign, Wishes(no_reading=number))
    assert [r["value"] for r in rows.readings] == [v for k, v in enumerate(READ) if k not in BAD]
    if abs(number) < 1e12:
        assert len(axis_rows(foreign, Wishes(columns={"value": second[1].partition("=")[2]})).readings) == 11


def test_numbers_for_no_reading_are_sought_among_few(monkeypatch):
    """A log of many different readings costs no line for each of them."""
    fits = []
    monkeypatch.setattr(columns, "line_through", lambda *xy: fits.append(1) or line_through(*xy))
    x = np.arange(5000.0)
    y = x + 0.01 * np.sin(x)
    y[1234] = -9999.0
    assert columns.fill_values(x, y) == [-9999.0] and len(fits) <= columns.FILLS_TRIED + 1


def test_a_spot_of_two_equal_numbers_is_none(tmp_path):
    for fill in (-1, 0, 65535):
        pixels = [np.where(np.isin(np.arange(11), BAD), fill, np.linspace(300, 500, 11) + 7 * k) for k in range(4)]
        foreign = sheet(tmp_path, "pan,tilt,xl,yl,xr,yr", 100 * np.arange(11), [0] * 11, *pixels)
        rows = look_rows(look_columns(foreign, {}), Wishes())
        assert {look["move"] for look in rows.looks if look["status"] == "ok"} == {*range(11)} - {*BAD}


def test_rows_are_in_the_order_that_a_column_states(tmp_path):
    order = np.argsort(PLACES, kind="stable")
    foreign = sheet(tmp_path, "Order,command (mm),reading (mm)", 1 + order, PLACES[order], READ[order])
    assert [r["value"] for r in axis_rows(foreign, Wishes()).readings] == list(READ)
    newest = sheet(tmp_path, "time (s),command (mm),reading (mm)", range(10, -1, -1), PLACES[::-1], READ[::-1])
    rows = axis_rows(newest, Wishes())
    assert [r["value"] for r in rows.readings] == list(READ) and "newest first" in rows.lines[0]


def test_numbers_of_positions_keep_the_order_of_the_file(tmp_path):
    order = np.array([2, 0, 4, 1, 5, 3])
    foreign = sheet(tmp_path, "No.,command (mm),reading (mm)", 1 + order, 10.0 * order, 10.002 * order)
    assert [m["command"] for m in axis_rows(foreign, Wishes()).moves] == list(10.0 * order)


@pytest.mark.parametrize(
    ("separator", "numbers"),
    [(";", ("{:,.2f}", ",.", ".,")), (",", ('"{:,.2f}"', "", "")), (";", ("{:,.2f}", ",", "'"))],
)
def test_marks_between_thousands(separator, numbers, tmp_path):
    form, old, new = numbers
    places = np.array([0.0, 250, 1000, 2000, 3000])

    def written(x: float, whole: bool = False) -> str:
        text = form.replace(".2f", ".0f" if whole else ".2f").format(x)
        return text.translate(str.maketrans(old, new))

    rows = [separator.join((written(x, whole=True), written(x - 0.06))) for x in places]
    rows = axis_rows(table(tmp_path, f"Soll (mm){separator}Ist (mm)", *rows), Wishes())
    assert [m["command"] for m in rows.moves] == list(places)
    np.testing.assert_allclose([r["value"] for r in rows.readings], places - 0.06, atol=1e-9)


def test_units_stand_in_a_column_or_change_with_the_row(tmp_path):
    rows = axis_rows(sheet(tmp_path, "Target,Reading,Unit", PLACES, READ, ["mm"] * 11), Wishes())
    assert rows.unit == "mm" and rows.axis == {"command_unit": "mm"}
    both = sheet(tmp_path, "Target,Unit,Reading,Unit", PLACES, ["mm"] * 11, np.round(1000 * READ), ["um"] * 11)
    assert axis_rows(both, Wishes()).unit == "um"
    log = [
        f"cmd: {c:g} mm reading: " + (f"{v} mm" if c > 20 else f"{1000 * v:g} um")
        for c, v in zip(PLACES, READ, strict=True)
    ]
    np.testing.assert_allclose([r["value"] for r in axis_rows(table(tmp_path, *log), Wishes()).readings], 1000 * READ)


def test_an_uncertainty_beside_its_number(tmp_path):
    cells = [f"{v} \u00b1 0.004" for v in READ]
    rows = axis_rows(sheet(tmp_path, "command (mm),reading (mm)", PLACES, cells), Wishes())
    assert [r["value"] for r in rows.readings] == list(READ) and rows.readings[0]["u"] == 0.004
    for name in ("2s (\u00b5m)", "95% CI (\u00b1\u00b5m)"):
        rows = axis_rows(sheet(tmp_path, f"command (mm),reading (mm),{name}", PLACES, READ, [3] * 11), Wishes())
        assert rows.readings[0]["u"] == pytest.approx(0.0015)


def test_hours_of_right_ascension(tmp_path):
    hours = [f"{int(c // 15):02d}:{int(c % 15 * 4):02d}:{1.3 * (k % 3):04.1f}" for k, c in enumerate(PLACES)]
    foreign = sheet(tmp_path, "Target (deg),Read RA", PLACES, hours)
    rows = axis_rows(foreign, Wishes())
    np.testing.assert_allclose([r["value"] for r in rows.readings], PLACES + 1.3 / 240 * (np.arange(11) % 3), atol=1e-9)
    # Round numbers are commands: which they are is asked where no word says it.
    with pytest.raises(Question, match="come again"):
        axis_rows(sheet(tmp_path, "Encoder (deg),RA", PLACES, hours), Wishes())


def test_commands_through_the_seam_of_a_circle(tmp_path):
    places = np.array([330.0, 340, 350, 0, 10, 20, 10, 0, 350, 340, 330])
    foreign = sheet(tmp_path, "Command (deg),Encoder (deg)", places, np.round((places - 0.04) % 360, 2))
    with pytest.raises(Question) as asked:
        axis_rows(foreign, Wishes())
    assert [c.options for c in asked.value.candidates] == [("--assume", f"command_turn={t}") for t in ("360", "0")]
    rows = axis_rows(foreign, Wishes(command_turn=360.0))
    assert [m["command"] for m in rows.moves] == [330, 340, 350, 360, 370, 380, 370, 360, 350, 340, 330]
    circle = sheet(
        tmp_path,
        "Command (deg),Encoder (deg)",
        np.tile(np.arange(0.0, 360, 30), 2),
        np.tile(np.arange(0.0, 360, 30), 2),
    )
    assert len(axis_rows(circle, Wishes()).moves) == 24


def test_a_dial_that_goes_round(tmp_path):
    places = np.round(0.2 * PLACES / 5, 3)
    foreign = sheet(tmp_path, "command (mm),dial (mm)", places, np.round((places + 0.285) % 1.0, 4))
    with pytest.raises(Question) as asked:
        axis_rows(foreign, Wishes())
    assert asked.value.candidates[0].options == ("--counts-per-turn", "1")
    read = [r["value"] for r in axis_rows(foreign, Wishes(counts_per_turn=1.0)).readings]
    np.testing.assert_allclose(np.diff(read), np.diff(places), atol=1e-9)


def test_ramps_and_repeated_readings_are_no_stops(tmp_path):
    stops = [0.0, 10.0, 20.0, 30.0]
    ways = [[*([a] * 8), *np.linspace(a, a + 10, 6)[1:-1]] for a in stops]
    ramp = np.concatenate(ways)[:-4]
    rows = axis_rows(sheet(tmp_path, "setpoint (deg),encoder (deg)", ramp, ramp - 0.1), Wishes())
    assert [m["command"] for m in rows.moves] == stops
    command = np.repeat(PLACES, 2)
    read = np.r_[0.01, np.repeat(READ, 2)[:-1]]
    rows = axis_rows(sheet(tmp_path, "target (mm),read (mm)", command, read), Wishes())
    assert [r["value"] for r in rows.readings] == [0.01, *READ] and len(rows.moves) == 11


def test_a_reading_of_a_later_command_is_left_out(tmp_path):
    lines = [line for c, v in zip(PLACES, READ, strict=True) for line in (f"target: {c}", f"pos: {v}")]
    rows = axis_rows(table(tmp_path, *lines[:5], *lines[7:]), Wishes())
    assert [r["value"] for r in rows.readings] == [*READ[:2], *READ[4:]] and any("line 5" in t for t in rows.assumed)


@pytest.mark.parametrize(("name", "step"), [("JD", 120 / 86400), ("Time", 60 / 86400)])
def test_days_are_no_seconds(name, step, tmp_path):
    start = 2461100.5 if name == "JD" else 46085.5
    times = [f"{start + step * k:.8f}" for k in range(11)]
    rows = axis_rows(sheet(tmp_path, f"{name},command (mm),reading (mm)", times, PLACES, READ), Wishes())
    np.testing.assert_allclose([m["time_s"] for m in rows.moves], 86400 * step * np.arange(11), atol=0.01)


def test_a_homing_stands_in_a_line_or_a_column(tmp_path):
    rows = [f"{c},{v}" for c, v in zip(PLACES, READ, strict=True)]
    foreign = table(tmp_path, "command (mm),reading (mm)", *rows, "HOME,", *rows)
    assert [m["segment"] for m in axis_rows(foreign, Wishes()).moves] == [0] * 11 + [1] * 11
    events = ["homed again" if k == 4 else "" for k in range(11)]
    rows = axis_rows(sheet(tmp_path, "command (mm),reading (mm),note", PLACES, READ, events), Wishes())
    assert [m["segment"] for m in rows.moves] == [0] * 4 + [1] * 7


def test_blocks_of_two_machines_are_refused(tmp_path):
    rows = ["Target (mm),Reading (mm)", *(f"{c},{v}" for c, v in zip(PLACES, READ, strict=True))]
    with pytest.raises(InputError, match="X axis, Y axis"):
        axis_rows(table(tmp_path, "X axis", *rows, "Y axis", *rows), Wishes())


def test_columns_without_words_are_runs_where_the_user_says_so(tmp_path):
    up, down = READ[:6], READ[5:][::-1] + 0.01
    foreign = sheet(tmp_path, "Pos (mm),Wyjazd (mm),Powrot (mm)", PLACES[:6], up, down)
    with pytest.raises(Question) as asked:
        axis_rows(foreign, Wishes())
    assert ("--runs", "alternate") in [c.options for c in asked.value.candidates]
    rows = axis_rows(foreign, Wishes(order="alternate"))
    assert [r["value"] for r in rows.readings] == [*up, *down[::-1]]


@pytest.mark.parametrize("word", ["lost", "#REF!", "nan", "n/a", "---", "19.99*", "(19.99)"])
def test_a_word_in_a_run_costs_one_reading(word, tmp_path):
    columns = [[f"{v:.3f}" for v in READ[:6] + 0.001 * k] for k in range(4)]
    columns[2][2] = word
    names = "Pos (mm),Forward 1,Backward 1,Forward 2,Backward 2"
    rows = axis_rows(sheet(tmp_path, names, PLACES[:6], *columns), Wishes())
    assert sum(r["status"] == "ok" for r in rows.readings) == 23


def test_states_of_a_machine_and_scales_of_a_gantry_are_asked_about(tmp_path):
    # Written to 0.01 mm, the first follows the commands to the last digit.
    for names in (
        "vor Justage (mm),nach Justage (mm)",
        "As found (mm),As left (mm)",
        "left scale (mm),right scale (mm)",
    ):
        foreign = sheet(tmp_path, f"Pos (mm),{names}", PLACES, np.round(1.002 * PLACES, 3), READ)
        with pytest.raises(Question):
            axis_rows(foreign, Wishes())


def test_runs_of_which_one_word_is_known(tmp_path):
    up, down = READ[:6], READ[5:][::-1] + 0.01
    foreign = sheet(
        tmp_path, "Pos (mm),Wyj 1 (mm),Backward 1 (mm),Wyj 2 (mm),Backward 2 (mm)", PLACES[:6], up, down, up, down
    )
    with pytest.raises(Question) as asked:
        axis_rows(foreign, Wishes())
    assert asked.value.candidates[0].options == ("--runs", "alternate")
    assert [r["value"] for r in axis_rows(foreign, Wishes(order="alternate")).readings] == [*up, *down[::-1]] * 2


def test_units_that_are_another_beside_degrees(tmp_path):
    rows = axis_rows(sheet(tmp_path, "Command (grad),Read (deg)", PLACES, 0.9 * PLACES + 0.01), Wishes())
    assert rows.axis == {"command_unit": "gon"}
    with pytest.raises(Question, match="angular mil"):
        axis_rows(sheet(tmp_path, "Command (deg),Read (mil)", PLACES, READ / 0.05625), Wishes())
    rows = axis_rows(sheet(tmp_path, "pulses,read (mm)", [f"{c:g}k" for c in PLACES], READ), Wishes())
    assert [m["command"] for m in rows.moves] == [1000 * c for c in PLACES]


def test_deviations_of_the_other_sign(tmp_path):
    foreign = sheet(tmp_path, "Soll (mm),Soll-Ist (um)", PLACES, np.round(1000 * (PLACES - READ), 1))
    with pytest.raises(Question) as asked:
        axis_rows(foreign, Wishes())
    assert asked.value.candidates[-1].options == ("--deviations", "--assume", "deviation_sign=-1")
    rows = axis_rows(foreign, Wishes(deviations=True, deviation_sign=-1.0))
    np.testing.assert_allclose([r["value"] for r in rows.readings], READ, atol=1e-9)


def test_moves_are_summed_before_rows_are_joined(tmp_path):
    moves = np.r_[0.0, np.diff(PLACES)]
    rows = axis_rows(sheet(tmp_path, "Move (mm),Reading (mm)", moves, READ), Wishes(relative=True))
    assert [m["command"] for m in rows.moves] == list(PLACES) and len(rows.readings) == 11


# --- heads and looks -------------------------------------------------------------------------------------------------
PAN = np.array([-900, -400, 100, 600, 1100, 600, 100, -400])
AZIMUTH = np.round(10 + 0.06 * PAN, 3)
FLAT = np.full(8, 5.5)


def head(tmp_path, names: str, *columns):
    return sighting_rows(sheet(tmp_path, names, *columns), Wishes())


def test_elevations_from_the_zenith_and_angles_in_parts(tmp_path):
    zenith = head(tmp_path, "pan_steps,tilt_steps,az (deg),zenith distance (deg)", PAN, FLAT * 0, AZIMUTH, 90 - FLAT)
    assert {s["elevation_deg"] for s in zenith.sightings} == {5.5}
    parts = [np.floor(AZIMUTH % 360), np.round(AZIMUTH % 360 % 1 * 60, 4), FLAT // 1, FLAT % 1 * 60]
    joined = head(tmp_path, "pan_steps,tilt_steps,az_d,az_m,el_d,el_m", PAN, FLAT * 0, *parts)
    np.testing.assert_allclose([s["azimuth_deg"] for s in joined.sightings], AZIMUTH % 360, atol=1e-4)
    assert {s["elevation_deg"] for s in joined.sightings} == {5.5}


def test_directions_of_nothing_and_errors_are_no_directions(tmp_path):
    lost = [AZIMUTH.copy(), FLAT.copy()]
    for column in lost:
        column[[2, 4]] = 0.0
    rows = head(tmp_path, "pan_steps,tilt_steps,az (deg),el (deg)", PAN, FLAT * 0, *lost)
    assert [s["sighting"] for s in rows.sightings] == [0, 1, 3, 5, 6, 7]
    with pytest.raises(InputError, match="errors"):
        head(tmp_path, 'az cmd (deg),el cmd (deg),dAz ("),dEl (")', PAN / 10, FLAT, AZIMUTH, FLAT)
    with pytest.raises(InputError, match="hardly change"):
        columns = {"azimuth_deg": "a", "elevation_deg": "b"}
        foreign = sheet(tmp_path, "az cmd (deg),el cmd (deg),a,b", PAN / 10 + 0.001, FLAT, AZIMUTH / 1000, FLAT / 1000)
        sighting_rows(foreign, Wishes(columns, angle_unit="deg"))


def test_counters_of_a_head_that_restart_are_refused(tmp_path):
    counters = np.arange(0, 1200, 100)
    with pytest.raises(InputError, match="jump by about 4096"):
        ticks = np.arange(3600, 5400, 120)
        head(
            tmp_path,
            "pan_steps,tilt_steps,az (deg),el (deg)",
            ticks % 4096,
            0 * ticks,
            ticks * 360 / 4096 % 360,
            0 * ticks + 5,
        )
    with pytest.raises(InputError, match="jump by about"):
        head(
            tmp_path,
            "pan_steps,tilt_steps,az (deg),el (deg)",
            counters % 512,
            0 * counters,
            0.06 * counters,
            0 * counters + 5.5,
        )


def test_large_moves_of_a_head_are_no_restarts(tmp_path):
    counters = np.array([2150, -1100, 2350, -2400, 2900, -600, 550, 2050])
    rows = head(tmp_path, "pan_steps,tilt_steps,az (deg),el (deg)", counters, FLAT * 0, 0.05 * counters % 360, FLAT)
    assert [m["pan_steps"] for m in rows.moves] == list(counters)


def test_moves_of_two_axes_are_seen(tmp_path):
    moved = np.r_[PAN[0], np.diff(PAN)]
    with pytest.raises(Question) as asked:
        head(tmp_path, "pan_steps,tilt_steps,az (deg),el (deg)", moved, FLAT * 0, AZIMUTH, FLAT)
    assert asked.value.candidates[0].options == ("--relative",)
    pixels = [640 - 0.7 * PAN, 400 + FLAT, 320 - 0.7 * PAN, 400 + FLAT]
    foreign = sheet(tmp_path, "pan,tilt,xl,yl,xr,yr", moved, [0] * 8, *pixels)
    with pytest.raises(Question):
        look_rows(look_columns(foreign, {}), Wishes())
    assert look_rows(look_columns(foreign, {}), Wishes(relative=True)).moves[-1]["pan_steps"] == PAN[-1]


def test_a_book_with_points_apart(tmp_path):
    rows = [f"{e},P{p},{(0, 0, 200, 0)[p - 1]},0" for e in (1, 2, 3) for p in (1, 2, 3, 4)]
    foreign = table(tmp_path, "Experiment,Point,Pan,Tilt", *rows)
    with pytest.raises(Question, match="lengths of moves"):
        look_rows(look_columns(foreign, {}), Wishes())


@pytest.mark.parametrize(
    ("names", "scale", "match"),
    [
        ("xL_mm,yL_mm,xR_mm,yR_mm", 0.01, "mm"),
        ("xL,yL,xR,yR", 0.001, "shares"),
        ("xL_rect,yL_rect,xR_rect,yR_rect", 1, "rectified"),
        ("x left,y left (from bottom),x right,y right", 1, "bottom"),
    ],
)
def test_other_than_pixels_are_refused(names, scale, match, tmp_path):
    pixels = [scale * (300.5 + 10 * np.arange(9) + 7 * k) for k in range(4)]
    foreign = sheet(tmp_path, f"pan,tilt,{names}", 100 * np.arange(9), [0] * 9, *pixels)
    with pytest.raises(InputError, match=match):
        look_rows(look_columns(foreign, {}), Wishes())


def test_pairs_and_unnamed_pixels(tmp_path):
    cells = [f"({300 + k}.5 {200 + k}.25)" for k in range(9)]
    foreign = sheet(tmp_path, "pan,tilt,left,right", 100 * np.arange(9), [0] * 9, cells, cells)
    assert look_rows(look_columns(foreign, {}), Wishes()).looks[2]["v_right_px"] == 202.25
    numbers = [300.5 + np.arange(9) + k for k in range(4)]
    unnamed = sheet(tmp_path, "pan,tilt,cx0,cy0,cx1,cy1", 100 * np.arange(9), [0] * 9, *numbers)
    with pytest.raises(Question, match="may be pixels"):
        look_rows(look_columns(unnamed, {}), Wishes())
    degrees = sheet(tmp_path, "pan_deg,tilt_deg,xl,yl,xr,yr", 6 * np.arange(9), [0] * 9, *numbers)
    with pytest.raises(Question, match="angles"):
        look_rows(look_columns(degrees, {}), Wishes())


def test_a_sheet_of_merged_cells(tmp_path):
    numbers = [300.5 + np.arange(9) + k for k in range(4)]
    sheets = ["near", "", "", "", "", "far", "", "", ""]
    foreign = sheet(tmp_path, "pan,tilt,sheet,xl,yl,xr,yr", 100 * np.arange(9), [0] * 9, sheets, *numbers)
    rows = look_rows(look_columns(foreign, {}), Wishes())
    assert [look["target"] for look in rows.looks] == ["near"] * 5 + ["far"] * 4


@pytest.mark.parametrize("name", ["T degC", "T_K", "T cam", "t_amb_C"])
def test_a_letter_t_beside_words_is_no_clock(name, tmp_path):
    warming = [f"{20 + 0.1 * k:.1f}" for k in range(8)]
    rows = head(tmp_path, f"pan_steps,tilt_steps,az (deg),el (deg),{name}", PAN, FLAT * 0, AZIMUTH, FLAT, warming)
    assert [m["time_s"] for m in rows.moves] == list(range(8))
    with pytest.raises(Question, match="thermometer"):
        head(tmp_path, "pan_steps,tilt_steps,az (deg),el (deg),T", PAN, FLAT * 0, AZIMUTH, FLAT, warming)


def test_half_steps_are_no_angles(tmp_path):
    with pytest.raises(InputError, match="whole number"):
        head(tmp_path, "pan_steps,tilt_steps,az (deg),el (deg)", PAN / 8, FLAT * 0, AZIMUTH, FLAT)


@pytest.mark.parametrize(
    "remark", ["wrong - see next row", "bad reading", "nicht verwenden", "\u00e0 ignorer", "discard"]
)
def test_remarks_that_discard_a_row(remark, tmp_path):
    remarks = ["lamp off" if row == 1 else remark if row in BAD else "" for row in range(11)]
    rows = axis_rows(sheet(tmp_path, "command (mm),reading (mm),remark", PLACES, READ, remarks), Wishes())
    assert [k for k, r in enumerate(rows.readings) if r["status"] != "ok"] == [*BAD]


@pytest.mark.parametrize("name", ["S/N", "Spindel", "Machine", "Pr\u00fcfling"])
def test_rows_of_two_machines_in_a_column_are_refused(name, tmp_path):
    machines = [20714] * 6 + [20715] * 5
    with pytest.raises(InputError, match="20714, 20715"):
        axis_rows(sheet(tmp_path, f"{name},command (mm),reading (mm)", machines, PLACES, READ), Wishes())


def test_minutes_of_arc_are_no_clock(tmp_path):
    parts = [np.floor(PLACES), np.round(PLACES % 1 * 60 + 3 + 0.3 * (np.arange(11) % 3), 1)]
    for names in ("Ist Grad,Ist Min", "Lecture degr\u00e9s,Lecture minutes"):
        rows = axis_rows(sheet(tmp_path, f"Soll (deg),{names}", PLACES, *parts), Wishes())
        np.testing.assert_allclose([r["value"] for r in rows.readings], PLACES + parts[1] / 60, atol=1e-9)
