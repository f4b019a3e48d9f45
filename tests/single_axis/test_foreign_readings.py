"""A table of an axis as a logger writes it becomes moves and readings."""

from __future__ import annotations

import pytest

from tvsbayes.errors import InputError
from tvsbayes.files.foreign_table import read_foreign
from tvsbayes.instrument.column_names import understand_axis
from tvsbayes.single_axis.foreign_readings import readings_of

NAMES = [
    ("steps", "encoder_deg"),
    ("commanded position", "measured position"),
    ("Sollwert", "Istwert"),
    ("pasos", "lectura (mm)"),
    ("consigne", "mesure"),
    *((("Mikroschritte", "Messwert [\u00b5m]"), ("microsteps", "position_um"), ("step", "position [um]"))),
    *((("steps", "mm"), ("command", "deg"), ("microsteps", "counts"), ("position_mm", "reading_mm"))),
    *((("counts", "deg"), ("usteps", "pos"))),
]


@pytest.mark.parametrize("names", NAMES, ids=[names[0] for names in NAMES])
def test_commands_and_readings_by_any_name(names):
    found = understand_axis(names[::-1])
    assert (found.columns["command"], found.columns["value"]) == names and not found.claimed


@pytest.mark.parametrize("names", [("step", "target", "mm"), ("steps", "position", "x"), ("steps", "mm", "deg")])
def test_what_could_be_either_is_left_open(names):
    assert "value" not in understand_axis(names).columns
    assert understand_axis(names, {"value": names[1]}).columns["value"] == names[1]


def table(tmp_path, *lines):
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines) + "\n")
    read = read_foreign(path)
    return read, understand_axis(read.columns).columns


def test_stops_are_read_again_passed_and_homed(tmp_path):
    """A repeated command is the same stop, a row without a value a move, another home number another segment."""
    found = readings_of(
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
    assert [(m.move, m.segment, m.time_s, m.command, m.approach) for m in found.moves] == [
        *((0, 0, 0.0, 0.0, "forward"), (1, 0, 60.0, 100.0, ""), (2, 0, 180.0, 200.0, "")),
        *((3, 0, 240.0, 100.0, ""), (4, 1, 300.0, 100.0, "backward")),
    ]
    assert [(r.move, r.value, r.u, r.status) for r in found.readings] == [
        *((0, 0.5, 0.1, "ok"), (1, 1.5, 0.1, "ok"), (1, 1.6, 0.1, "ok")),
        *((3, 1.4, 0.0, "refused: no"), (4, 1.7, 0.2, "ok")),
    ]
    assert any("1 row at the command before" in text for text in found.assumed)


def test_a_mark_of_homings_is_no_number_of_a_segment(tmp_path):
    found = readings_of(*table(tmp_path, "home,steps,encoder", "1,0,0.1", "0,10,1.1", "0,20,2.1", "1,0,0.2"))
    assert [m.segment for m in found.moves] == [0, 0, 0, 1]
    assert any("1 homing after the first row, by column home at each 1" in text for text in found.assumed)


def test_a_german_date_beside_german_names(tmp_path):
    """The day comes first: the second row is a day later, not a month."""
    rows = ("04.03.2026 23:59:50;0;0,5", "5.3.2026 00:00:12,5;10;1,5")
    assert [m.time_s for m in readings_of(*table(tmp_path, "Zeit;Sollwert;Istwert", *rows)).moves] == [0.0, 22.5]


@pytest.mark.parametrize("name", ["homed", "Homed?", "run", "run_id", "Referenziert", "homing no"])
def test_homings_are_not_dropped(tmp_path, name):
    """Readings before and after a homing would pass for one segment."""
    marks = ("0", "0", "1", "0") if "ed" in name.lower() else ("1", "1", "2", "2")
    rows = [f"{mark},{10 * k},{k}.5" for k, mark in enumerate(marks)]
    assert [m.segment for m in readings_of(*table(tmp_path, f"{name},steps,encoder", *rows)).moves] == [0, 0, 1, 1]


@pytest.mark.parametrize(
    ("row", "column"), [("x,1,ok,forward", "steps"), ("0,,ok,forward", "angle"), ("0,1,ok,cw", "side")]
)
def test_cells_that_say_nothing_are_refused_with_their_column(tmp_path, row, column):
    with pytest.raises(InputError) as refused:
        readings_of(*table(tmp_path, "steps,angle,status,side,sd", f"{row},"))
    assert (refused.value.line, refused.value.column) == (2, column)


def test_a_negative_uncertainty_is_refused_as_check_does(tmp_path):
    with pytest.raises(InputError, match=r"line 2, sd: .*from 0 to"):
        readings_of(*table(tmp_path, "steps,angle,sd", "0,1,-0.1"))
