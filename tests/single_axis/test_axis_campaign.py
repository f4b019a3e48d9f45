"""Axis folders: round trip and refusals."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.axes import campaign, runs
from support.refusals import refusal

from tvsbayes.errors import InputError
from tvsbayes.instrument.campaign_header import mechanism_key
from tvsbayes.single_axis.axis_campaign import (
    AXIS_MOVES,
    axis_hashes,
    read_axis,
    refuse_same_readings,
    write_axis,
)
from tvsbayes.single_axis.axis_parameters import AxisPrior

TOML = 'format = "tvsbayes-axis/1"\nunit = "deg"\n'
MOVES = "move,segment,time_s,command,approach\n0,0,0,0,forward\n1,0,1,10.5,\n"
READINGS = "reading,move,value,u,status\n0,0,0.1,0.01,ok\n1,1,,,lost\n"


def folder(path, toml=TOML, moves=MOVES, readings=READINGS):
    path.mkdir(exist_ok=True)
    for name, text in (("campaign.toml", toml), ("moves.csv", moves), ("readings.csv", readings)):
        (path / name).write_bytes(text.encode())
    return path


def test_an_axis_folder_round_trips(tmp_path):
    moves = runs(1)
    axis = campaign(moves, [0.01 * m.command + 0.1 for m in moves], 0.002, per_command=AxisPrior(0.01, 0.001))
    write_axis(axis, tmp_path / "a")
    copy = read_axis(tmp_path / "a")
    assert (copy.moves, copy.readings, copy.stated, copy.unit) == (axis.moves, axis.readings, axis.stated, "deg")
    assert axis_hashes(copy) == axis_hashes(axis)
    assert mechanism_key(tmp_path / "a") == "axis"


def test_limits_and_assumed_moves_are_kept_and_no_estimate_depends_on_the_limits(tmp_path):
    moves = runs(1)
    axis = campaign(moves, [0.01 * m.command for m in moves])
    marked = replace(axis, limits=(-2500.0, 2400.5), moves=(replace(moves[0], assumed=1), *moves[1:]))
    write_axis(marked, tmp_path / "a")
    copy = read_axis(tmp_path / "a")
    assert (copy.limits, copy.moves, copy.range_allowed) == ((-2500.0, 2400.5), marked.moves, (-2500.0, 2400.5))
    assert axis_hashes(replace(axis, limits=copy.limits)) == axis_hashes(axis)
    # Results of folders without the column stay valid.
    assert axis_hashes(marked)["moves"] != axis_hashes(axis)["moves"] and b"assumed" not in AXIS_MOVES.content(
        axis.moves
    )
    assert replace(copy, limits=None).range_allowed == (-2300.0, 2300.0), "the last move went there as well"
    write_axis(replace(axis, moves=tuple(replace(m, assumed=int(m.command == 2300)) for m in moves)), tmp_path / "b")
    assert read_axis(tmp_path / "b").range_allowed == (-2300.0, 2000.0)


@pytest.mark.parametrize(
    ("change", "file", "line", "column", "code"),
    [
        ({"toml": TOML.replace("axis/1", "axis/2")}, "campaign.toml", 1, "format", "word"),
        ({"toml": TOML.replace('unit = "deg"', "")}, "campaign.toml", None, "unit", "missing-key"),
        ({"toml": TOML + "colour = 1\n"}, "campaign.toml", 3, "colour", "unknown-key"),
        ({"toml": TOML + "[axis]\nlimits = [1, -1]\n"}, "campaign.toml", 4, "axis.limits", "range"),
        ({"toml": TOML + "[axis]\nlimits = [1]\n"}, "campaign.toml", 4, "axis.limits", "range"),
        ({"toml": TOML + "[axis]\nlimits = [0, 1e13]\n"}, "campaign.toml", 4, "axis.limits", "numbers"),
        ({"toml": TOML + "[axis]\nlimits = true\n"}, "campaign.toml", 4, "axis.limits", "numbers"),
        (
            {
                "moves": MOVES.replace("approach", "approach,assumed")
                .replace("forward", "forward,2")
                .replace(".5,", ".5,,")
            },
            *("moves.csv", 2, "assumed", "integer"),
        ),
        ({"toml": TOML + "[axis]\nspeed = 1\n"}, "campaign.toml", 4, "axis.speed", "unknown-key"),
        ({"toml": TOML + "[axis]\nbacklash = 1\n"}, "campaign.toml", 4, "axis.backlash", "quantity"),
        (
            {"toml": TOML + "[axis]\ntransmission_error = { value = 1.0, u = 1.0 }\n"},
            *("campaign.toml", 4, "axis.transmission_error.value", "half-normal"),
        ),
        (
            {"toml": TOML + "[axis]\nstop_sd = { value = 0.0, u = 1.0 }\n"},
            *("campaign.toml", 4, "axis.stop_sd.value", "log-normal"),
        ),
        *(
            (
                {"toml": TOML + f"[axis]\n{name} = {{ value = 0.0, u = 0.0 }}\n"},
                *("campaign.toml", 4, f"axis.{name}.value", "log-normal"),
            )
            for name in ("transmission_error_length", "reading_scale")
        ),
        ({"moves": MOVES.replace("0,0,0,0,forward", "0,0,0,0,left")}, "moves.csv", 2, "approach", "approach"),
        ({"moves": MOVES.replace("10.5,", "10.5,forward")}, "moves.csv", 3, "approach", "approach"),
        ({"moves": MOVES.replace("10.5", "10;5")}, "moves.csv", 3, "command", "number"),
        ({"moves": MOVES.replace("1,0,1", "1,0,-1")}, "moves.csv", 3, "time_s", "order"),
        ({"moves": MOVES.replace("1,0,1", "1,2,1")}, "moves.csv", 3, "segment", "order"),
        ({"moves": MOVES.replace("1,0,1", "2,0,1")}, "moves.csv", 3, "move", "order"),
        ({"moves": MOVES.replace("command", "steps")}, "moves.csv", 1, "steps", "unknown-column"),
        ({"moves": MOVES.split("\n")[0] + "\n"}, "moves.csv", 1, None, "empty"),
        ({"readings": READINGS.replace("1,1,,", "1,7,,")}, "readings.csv", 3, "move", "missing-move"),
        ({"readings": READINGS.replace("1,1,,", "0,1,,")}, "readings.csv", 3, "reading", "duplicate"),
        ({"readings": READINGS.replace("0.1,0.01,ok", ",0.01,ok")}, "readings.csv", 2, "value", "missing"),
        ({"readings": READINGS.replace("0.1,0.01,ok", "0.1,-1,ok")}, "readings.csv", 2, "u", "number"),
        ({"readings": READINGS.replace("0.1,0.01,ok", "nan,0.01,ok")}, "readings.csv", 2, "value", "number"),
    ],
)
def test_refusals_state_place_and_remedy(tmp_path, change, file, line, column, code):
    with pytest.raises(InputError) as caught:
        read_axis(folder(tmp_path / "a", **change))
    error = caught.value
    assert (error.file, error.line, error.column, error.code) == (file, line, column, code)
    assert error.found and error.allowed and error.remedy


def test_the_hash_covers_the_data_alone(tmp_path):
    one = read_axis(folder(tmp_path / "a"))
    other = read_axis(folder(tmp_path / "b", TOML + 'name = "x"\n', MOVES, READINGS.replace("0.01,ok", "0.010,ok")))
    assert axis_hashes(one) == axis_hashes(other)
    third = read_axis(folder(tmp_path / "c", TOML + "[axis]\nbacklash = { value = 0.0, u = 0.2 }\n"))
    assert axis_hashes(one)["axis"] != axis_hashes(third)["axis"]


def test_readings_that_were_taken_before_are_refused():
    """Coarse readings may repeat in value: then their times are others."""
    moves = runs(1)
    known = campaign(moves, [round(0.01 * m.command, 1) for m in moves], 0.002)
    refuse = refusal(lambda: refuse_same_readings(known, replace(known, readings=known.readings[3:])))
    assert refuse.code == "same-looks" and refuse.file == "readings.csv"
    later = replace(known, moves=tuple(replace(m, time_s=m.time_s + 3600.0) for m in known.moves))
    refuse_same_readings(known, later)


def test_temperatures_start_at_absolute_zero(tmp_path):
    moves = MOVES.replace("approach", "approach,temperature_degC").replace("forward", "forward,{}").replace("5,", "5,,")
    assert read_axis(folder(tmp_path / "a", moves=moves.format(-273.15))).moves[0].temperature_degC == -273.15
    with pytest.raises(InputError, match=r"temperature_degC.*-273\.15"):
        read_axis(folder(tmp_path / "b", moves=moves.format(-300)))


@pytest.mark.parametrize(
    ("line", "column"),
    [("absolute = 1", "axis.absolute"), ("absolute = true\nhome_sd = { value = 0.1, u = 1.0 }", "axis.home_sd")],
)
def test_an_absolute_encoder_has_no_scatter_of_homings(tmp_path, line, column):
    error = refusal(lambda: read_axis(folder(tmp_path / "a", TOML + f"[axis]\n{line}\n")))
    assert error.column == column
