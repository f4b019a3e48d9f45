"""The table of a logger becomes moves and readings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tvsbayes.errors import InputError
from tvsbayes.files.foreign_table import read_foreign
from tvsbayes.single_axis.axis_campaign import AxisMove, Reading, parse_readings, readings_bytes
from tvsbayes.single_axis.foreign_readings import ForeignReadings, map_axis_columns, readings_of, unwrapped

NAMES = [
    ("steps", "encoder_deg"),
    ("commanded position", "measured position"),
    ("Sollwert", "Istwert"),
    ("pasos", "lectura (mm)"),
    ("consigne", "mesure"),
    *((("Mikroschritte", "Messwert [\u00b5m]"), ("microsteps", "position_um"), ("step", "position [um]"))),
    *((("steps", "mm"), ("command", "deg"), ("microsteps", "counts"), ("position_mm", "reading_mm"))),
    *((("counts", "deg"), ("usteps", "pos"))),
    *((("steps", "dial gauge mm"), ("step", "ra_offset_arcsec"))),
]


@pytest.mark.parametrize("names", NAMES, ids=[names[0] for names in NAMES])
def test_commands_and_readings_by_any_name(names):
    mapping = map_axis_columns(names[::-1])
    assert (mapping.columns["command"], mapping.columns["value"]) == names and not mapping.ambiguous


def test_dates_in_utc_are_times():
    assert map_axis_columns(("UTC", "steps", "RA offset arcsec")).columns["time_s"] == "UTC"


@pytest.mark.parametrize("names", [("step", "target", "mm"), ("steps", "position", "x"), ("steps", "mm", "deg")])
def test_ambiguous_columns_are_left_open(names):
    assert "value" not in map_axis_columns(names).columns
    assert map_axis_columns(names, {"value": names[1]}).columns["value"] == names[1]


def test_degrees_of_a_thermometer_are_no_reading():
    assert "value" not in map_axis_columns(("steps", "temp deg", "foo")).columns
    assert map_axis_columns(("steps", "temp deg", "dial gauge mm")).columns["value"] == "dial gauge mm"


@pytest.mark.parametrize(("unit", "turn"), [("deg", 360.0), ("rad", 2 * np.pi), ("turn", 1.0)])
def test_whole_turns_that_an_encoder_leaves_out_are_added(unit, turn):
    """Forward over three turns and back, past a refused reading; other units and readings without jumps stay."""
    commands = [*range(0, 1200, 50), *range(1150, -1, -50)]
    angles = [turn * (0.9 + command / 360) for command in commands]
    moves = tuple(AxisMove(k, 0, float(k), float(c), "" if k else "forward") for k, c in enumerate(commands))
    read = tuple(Reading(k, k, angle % turn) for k, angle in enumerate(angles))
    read = (*read[:9], replace(read[9], status="wild"), *read[10:])
    series = unwrapped(ForeignReadings(moves, read, ("before",)), unit)
    kept = [(r.value, angle) for r, angle in zip(series.readings, angles, strict=True) if r.status == "ok"]
    assert [value for value, _ in kept] == pytest.approx([angle for _, angle in kept], rel=1e-12)
    assert series.readings[9] == read[9] and series.assumed[0] == "before"
    assert (
        series.assumed[1].startswith("value: jumps by whole turns 8 times")
        and "each; --counts-per-turn" in series.assumed[1]
    )
    wild = replace(
        series, readings=tuple(replace(r, value=r.value + 1.2 * turn * (k == 30)) for k, r in enumerate(read))
    )
    assert unwrapped(wild, unit) is wild
    for same in (ForeignReadings(moves, read, ()), ForeignReadings(moves[:3], read[:3], ())):
        assert unwrapped(same, "mm") is same
    assert unwrapped(replace(series, assumed=()), unit) == replace(series, assumed=())


def table(tmp_path, *lines):
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines) + "\n")
    read = read_foreign(path)
    return read, map_axis_columns(read.columns).columns


def test_stops_are_read_again_passed_and_homed(tmp_path):
    """A repeated command is the same stop, a row without a value a move, another home number another segment."""
    series = readings_of(
        *table(
            tmp_path,
            "t (min);home;steps;encoder;from;sd;ok",
            "0;1;0;0,5;forward;0,1;1",
            "1;1;100;1,5;;0,1;1",
            "2;1;100;1,6;;0,1;1",
            "3;1;200;;;;",
            "4;1;100;1,4;;;no",
            "5;2;100;1,7;backward;0,2;ja",
        )
    )
    assert [(m.move, m.segment, m.time_s, m.command, m.approach) for m in series.moves] == [
        *((0, 0, 0.0, 0.0, "forward"), (1, 0, 60.0, 100.0, ""), (2, 0, 180.0, 200.0, "")),
        *((3, 0, 240.0, 100.0, ""), (4, 1, 300.0, 100.0, "backward")),
    ]
    assert [(r.move, r.value, r.u, r.status) for r in series.readings] == [
        *((0, 0.5, 0.1, "ok"), (1, 1.5, 0.1, "ok"), (1, 1.6, 0.1, "ok")),
        *((3, 1.4, 0.0, "refused: no"), (4, 1.7, 0.2, "ok")),
    ]
    assert any("1 row at the command before" in text for text in series.assumed)


def test_a_mark_of_homings_is_no_number_of_a_segment(tmp_path):
    series = readings_of(*table(tmp_path, "home,steps,encoder", "1,0,0.1", "0,10,1.1", "0,20,2.1", "1,0,0.2"))
    assert [m.segment for m in series.moves] == [0, 0, 0, 1]
    assert any("1 homing after the first row, by column home at each 1" in text for text in series.assumed)


def test_a_german_date_beside_german_names(tmp_path):
    """The day comes first: the second row is a day later, not a month."""
    rows = ("04.03.2026 23:59:50;0;0,5", "5.3.2026 00:00:12,5;10;1,5")
    assert [m.time_s for m in readings_of(*table(tmp_path, "Zeit;Sollwert;Istwert", *rows)).moves] == [0.0, 22.5]


@pytest.mark.parametrize("name", ["homed", "Homed?", "run", "run_id", "Referenziert", "homing no"])
def test_homings_are_not_dropped(tmp_path, name):
    """Readings before and after a homing would be taken for one segment."""
    marks = ("0", "0", "1", "0") if "ed" in name.lower() else ("1", "1", "2", "2")
    rows = [f"{mark},{10 * k},{k}.5" for k, mark in enumerate(marks)]
    assert [m.segment for m in readings_of(*table(tmp_path, f"{name},steps,encoder", *rows)).moves] == [0, 0, 1, 1]


@pytest.mark.parametrize(
    ("row", "column"), [("x,1,ok,forward", "steps"), ("0,,ok,forward", "angle"), ("0,1,ok,cw", "side")]
)
def test_cells_without_meaning_are_refused_with_their_column(tmp_path, row, column):
    with pytest.raises(InputError) as refused:
        readings_of(*table(tmp_path, "steps,angle,status,side,sd", f"{row},"))
    assert (refused.value.line, refused.value.column) == (2, column)


def test_a_negative_uncertainty_is_refused_as_check_does(tmp_path):
    with pytest.raises(InputError, match=r"line 2, sd: .*from 0 to"):
        readings_of(*table(tmp_path, "steps,angle,sd", "0,1,-0.1"))


def test_statuses_are_accepted_by_the_campaign_reader(tmp_path):
    series = readings_of(*table(tmp_path, "steps;encoder;ok", "0;0,5;1", "100;1,5;-", "200;;+ slipped"))
    assert [reading.status for reading in series.readings] == ["ok", "refused: -", "refused: + slipped"]
    assert "status: 2 readings left out by column ok: - 1, + slipped 1" in series.assumed
    assert parse_readings(readings_bytes(series.readings), 3) == series.readings


@pytest.mark.parametrize(
    "name, cells", (("Temperature", (20.0, 21.5)), ("Temp (°F)", (68.0, 70.7)), ("temp_K", (293.15, 294.65)))
)
def test_temperatures_are_those_of_the_moves(tmp_path, name, cells):
    """From the row that ends a move; none for an empty cell or an inserted move; deg C whatever the column's unit."""
    rows = (f"0,0.1,{cells[0]},below", "10,1.1,,below", f"10,1.0,{cells[1]},above")
    series = readings_of(*table(tmp_path, f"command,value,{name},direction", *rows))
    assert [move.command for move in series.moves] == [0.0, 10.0, 10.5, 10.0]
    warm = [move.temperature_degC for move in series.moves]
    assert warm[1] is warm[2] is None
    # Rounding of a difference of numbers of some hundreds.
    np.testing.assert_allclose([warm[0], warm[3]], [20.0, 21.5], atol=1e-12 * 300)
    assert any("turned into deg C" in text for text in series.assumed) == (name != "Temperature")
