"""Tables whose numbers contradict what their names say are asked about, and every answer reads them rightly."""

from __future__ import annotations

import numpy as np
import pytest

from tvsbayes.errors import InputError, Question
from tvsbayes.importing.axis import axis_rows
from tvsbayes.importing.cells import Wishes
from tvsbayes.importing.looks import look_columns, look_rows
from tvsbayes.importing.reader import read_foreign
from tvsbayes.importing.sightings import sighting_rows

PLACES = np.array([0.0, 10, 20, 30, 40, 50, 40, 30, 20, 10, 0])
SIDES = np.r_[np.ones(6), -np.ones(5)]
READ = PLACES * 1.0002 - 0.02 * SIDES
TEMPERATURES = 21.5 + 0.02 * np.arange(11)


def table(tmp_path, names: str, *columns: np.ndarray):
    rows = (",".join(f"{x:.10g}" for x in row) for row in zip(*columns, strict=True))
    path = tmp_path / "t.csv"
    path.write_text("\n".join([names, *rows, ""]))
    return read_foreign(path)


def answers(foreign) -> list[tuple[str, ...]]:
    with pytest.raises(Question) as asked:
        axis_rows(foreign, Wishes())
    return [candidate.options for candidate in asked.value.candidates]


@pytest.mark.parametrize("name", ["dial (div 0.01mm)", "dial (1 div = 0.01 mm)", "dial (mm)"])
def test_a_gauge_that_counts_parts_of_its_unit(name, tmp_path):
    foreign = table(tmp_path, f"command (mm),{name}", PLACES, 100 * READ)
    first = answers(foreign)[0]
    assert first[0] == "--unit" and first[1].replace(" ", "") == "value=0.01mm"
    rows = axis_rows(foreign, Wishes(units={"value": first[1].partition("=")[2]}))
    np.testing.assert_allclose([r["value"] for r in rows.readings], READ, atol=1e-9)
    stated = axis_rows(foreign, Wishes(units={"value": "mm"}))
    assert stated.readings[3]["value"] == pytest.approx(100 * READ[3])


def test_a_gauge_that_counts_parts_of_its_unit_beside_steps(tmp_path):
    foreign = table(tmp_path, "steps,dial (div 0.01mm)", 80 * PLACES, 100 * READ)
    assert answers(foreign)[0] == ("--unit", "value=0.01mm")


@pytest.mark.parametrize("factor", [1.0, 1.5, 25.4, 0.0125])
def test_other_ratios_are_read_as_they_stand(factor, tmp_path):
    rows = axis_rows(table(tmp_path, "command (mm),reading (mm)", PLACES, factor * READ), Wishes())
    assert rows.unit == "mm" and rows.readings[3]["value"] == pytest.approx(factor * READ[3])


@pytest.mark.parametrize("homed", [False, True])
def test_lengths_of_moves_are_no_positions(homed, tmp_path):
    # It ends away from where it began, so that a second run without a homing would go on from there.
    places, moves, read = PLACES[1:-1], np.diff(PLACES)[:-1], READ[1:-1]
    columns, names = [moves, read], "command (mm),reading (mm)"
    if homed:
        columns, names = [np.tile(moves, 2), np.tile(read, 2), np.repeat([0, 1], 9)], f"{names},segment"
    foreign = table(tmp_path, names, *columns)
    assert answers(foreign) == [("--relative",), ("--column", "command=command (mm)")]
    rows = axis_rows(foreign, Wishes(relative=True))
    assert [m["command"] for m in rows.moves] == [*places] * (1 + homed)
    stated = axis_rows(foreign, Wishes(columns={"command": "command (mm)"}))
    assert {m["command"] for m in stated.moves} == {10.0, -10.0}


def test_positions_that_are_read_once_or_again_are_no_moves(tmp_path):
    for places in (PLACES, np.tile([0.0, 10.0], 6), np.arange(1.0, 9.0)):
        assert axis_rows(table(tmp_path, "command (mm),reading (mm)", places, places * 1.0002), Wishes()).moves


def test_a_column_t_is_a_clock_or_a_thermometer(tmp_path):
    foreign = table(tmp_path, "command (mm),reading (mm),T", PLACES, READ, TEMPERATURES)
    assert answers(foreign) == [("--column", f"{a}") for a in ("time_s=T", "temperature_degC=T", "time_s=")]
    rows = axis_rows(foreign, Wishes(columns={"temperature_degC": "T"}))
    assert [m["temperature_degC"] for m in rows.moves] == pytest.approx(list(TEMPERATURES))
    clock = axis_rows(table(tmp_path, "command (mm),reading (mm),T", PLACES, READ, 30.0 * np.arange(11)), Wishes())
    assert clock.moves[2]["time_s"] == 60.0


def test_rows_of_two_axes_are_no_axis(tmp_path):
    rows = "".join(f"X,{c:g},{v:.4f}\nY,{c / 2:g},{v / 2:.4f}\n" for c, v in zip(PLACES, READ, strict=True))
    (tmp_path / "t.csv").write_text(f"axis,target (mm),actual (mm)\n{rows}")
    with pytest.raises(InputError, match="rows of X, Y in column axis"):
        axis_rows(read_foreign(tmp_path / "t.csv"), Wishes())
    (tmp_path / "one.csv").write_text(f"axis,target (mm),actual (mm)\n{rows}".replace("Y", "X"))
    assert axis_rows(read_foreign(tmp_path / "one.csv"), Wishes()).moves


def test_errors_of_directions_are_no_directions(tmp_path):
    rows = "".join(f"{p},{p},{0.001 * p},0.01\n" for p in range(0, 900, 100))
    (tmp_path / "t.csv").write_text(f"pan_steps,tilt_steps,az_err_deg,el_err_deg\n{rows}")
    with pytest.raises(InputError, match="no column that is surely azimuth_deg, elevation_deg"):
        sighting_rows(read_foreign(tmp_path / "t.csv"), Wishes())


@pytest.mark.parametrize("names", ["pan,tilt,camera,u,v", "pan,tilt,cam,x_px,y_px", "pan,tilt,Kamera,Spalte,Zeile"])
@pytest.mark.parametrize("order", [("left", "right"), ("R", "L")])
def test_a_row_for_each_camera_of_a_look(names, order, tmp_path):
    def pixels(pan: int, camera: str) -> str:
        return f"{600 + 2 * pan + 30 * (camera in ('left', 'L'))},{400 + pan}"

    rows = [f"{pan},0,{camera},{pixels(pan, camera)}" for pan in (0, 100, 200) for camera in order]
    (tmp_path / "t.csv").write_text("\n".join([names, *rows, ""]))
    looks = look_rows(look_columns(read_foreign(tmp_path / "t.csv"), {}), Wishes()).looks
    assert [(k["u_left_px"], k["v_left_px"], k["u_right_px"]) for k in looks] == [
        (630 + 2 * pan, 400 + pan, 600 + 2 * pan) for pan in (0, 100, 200)
    ]
    (tmp_path / "t.csv").write_text("\n".join([names, *rows[1:], ""]))
    with pytest.raises(InputError, match="a look without a row of either camera"):
        look_columns(read_foreign(tmp_path / "t.csv"), {})


def test_pixels_of_no_camera_are_refused(tmp_path):
    (tmp_path / "t.csv").write_text("pan,tilt,u,v\n0,0,600,400\n100,0,800,400\n")
    with pytest.raises(InputError, match="no column gives to a camera"):
        look_columns(read_foreign(tmp_path / "t.csv"), {})
    (tmp_path / "t.csv").write_text("pan,tilt,x,y\n0,0,600,400\n100,0,800,400\n")
    assert look_columns(read_foreign(tmp_path / "t.csv"), {}).taken


@pytest.mark.parametrize(("unit", "scale"), [("mil", 1.0), ("0.001 in", 1.0), ("in", 1e-3)])
def test_lengths_that_hardly_change_with_the_commands_are_deviations_or_positions(unit, scale, tmp_path):
    deviation = scale * (-2.8 * PLACES - 0.3 * SIDES)
    foreign = table(tmp_path, f"command (in),reading [{unit}]", PLACES, deviation)
    assert answers(foreign) == [("--deviations",), ("--positions",)]
    read = [r["value"] for r in axis_rows(foreign, Wishes(deviations=True)).readings]
    np.testing.assert_allclose(read, PLACES + 1e-3 * (-2.8 * PLACES - 0.3 * SIDES), atol=1e-9)


def test_readings_that_go_their_own_way_are_asked_about(tmp_path):
    """The sign of the command stands in a column of its own."""
    steps = np.array([-400.0, -300, -200, -100, 0, 100, 200, 300, 400])
    foreign = table(tmp_path, "steps,angle_deg", np.abs(steps), 0.018 * steps)
    columns = ("--column", "command=steps", "--column", "value=angle_deg")
    assert answers(foreign) == [columns, (*columns, "--deviations")]
    stated = axis_rows(foreign, Wishes(columns={"command": "steps", "value": "angle_deg"}))
    assert len(stated.readings) == len(steps)
