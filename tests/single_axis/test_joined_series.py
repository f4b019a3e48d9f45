"""Series of separate logs are joined by time; a value is logged only when it changes."""

from __future__ import annotations

import gzip
import json

import numpy as np
import pytest

from tvsbayes.errors import InputError
from tvsbayes.single_axis.joined_series import (
    KLIPPER_TURN,
    Series,
    camonitor_table,
    command_at,
    is_camonitor,
    is_klipper,
    klipper_table,
)

COMMAND, READ = "T:Axis1-PosAct", "T:ec0-s3-EL5002-CH1-PosAct"


def line(name: str, second: float, value: object, rest: str = "") -> str:
    minutes, seconds = divmod(second, 60)
    return f"{name:<30} 2021-07-09 10:{29 + int(minutes):02d}:{seconds:09.6f} {value} {rest} "


def drive() -> list[str]:
    """The counter at 100 Hz while it moves, 1 s after the log begins and again at 60 s; the encoder at other times."""
    lines = [line("T:Limit", 0, "One"), line(COMMAND, 0, 100.0), line(READ, 0.0, 5000)]
    for begin, at in ((1.0, 100.0), (60.0, 110.0)):
        for k in range(100):
            lines.append(line(COMMAND, begin + 0.01 * k, round(at + 0.1 * k, 4)))
            if k % 10 == 5:
                lines.append(line(READ, begin + 0.01 * k + 0.005, 5000 + round(100 * (at + 0.1 * k + 0.05 - 100))))
    return [*lines, line(READ, 63.0, 5200), line(READ, 1.123, 7, "READ INVALID"), f"{READ} *** Disconnected"]


@pytest.mark.parametrize("names", [(COMMAND, READ), ("m1.VAL", "m1.RBV"), ("bench:counter", "bench:ssi")])
def test_readings_get_the_command_of_their_time(names):
    """Interpolated in motion; one from outside of the commands' times is left out."""
    text = "\n".join(drive()).replace(COMMAND, names[0]).replace(READ, names[1])
    assert is_camonitor(text) and not is_camonitor("time_s,steps,angle\n0,1,2\n")
    table = camonitor_table(text, "log", {})
    assert list(table.columns) == ["time_s", *names] and len(table) == 21
    rows = np.array([[float(cell) for cell in table.columns[name]] for name in table.columns])
    assert rows[1][1:] == pytest.approx(100 + (rows[2][1:] - 5000) / 100, abs=1e-9)
    assert "20 commands interpolated in time, 1 readings outside left out" in table.kind


def test_a_constant_command_is_held():
    """Between two motions, 59 s apart, the command is constant and not interpolated."""
    times = np.array([0.0, 0.1, 0.2, 0.3, 60.0, 60.1])
    commands = Series(times, np.array([0.0, 1.0, 2.0, 3.0, 3.0, 9.0]))
    values, interpolated = command_at(commands, np.array([0.15, 30.0, 60.05, 60.1, 0.1]))
    assert values == pytest.approx([1.5, 3.0, 6.0, 9.0, 1.0], abs=1e-12) and interpolated == 2
    jump = Series(np.array([0.0, 0.1, 0.2, 60.0]), np.array([0.0, 1.0, 2.0, 50.0]))
    assert command_at(jump, np.array([30.0]))[0] == pytest.approx([2.0])


def test_an_ambiguous_pair_is_asked_for():
    text = "\n".join(drive()).replace(COMMAND, "A").replace(READ, "B")
    with pytest.raises(InputError, match=r"A \(201 values\), B \(22 values\)") as refused:
        camonitor_table(text, "log", {})
    assert "--column command=NAME --column value=NAME" in refused.value.remedy
    assert list(camonitor_table(text, "log", {"command": "A", "value": "B"}).columns) == ["time_s", "A", "B"]
    assert list(camonitor_table(text, "log", {"value": "B"}).columns) == ["time_s", "A", "B"]
    with pytest.raises(InputError, match="no such series"):
        camonitor_table(text, "log", {"command": "C"})


def test_series_of_two_times_are_refused():
    lines = [line("m:VAL", k, k) for k in range(9)] + [line("m:RBV", 20 + k, k) for k in range(9)]
    with pytest.raises(InputError, match="no value of m:RBV between"):
        camonitor_table("\n".join(lines), "log", {})


def klipper(steps: int = 4000) -> list[dict]:
    """A stepper of 3200 steps a turn at constant rate, and its angle sensor: what data_logger.py writes."""
    clocks = {"first_clock": 1000, "last_clock": 1000 + (steps - 1) * 500, "first_step_time": 10.0}
    params = clocks | {
        "last_step_time": 10.0 + (steps - 1) * 500 / 1e6,
        "start_mcu_position": 16,
        "step_distance": 0.01,
    }
    data = [[500, steps // 2, 0], [500, steps // 2, 0]]
    angles = [
        [10.0 + 0.05 * k - 1e-4, KLIPPER_TURN * (16 + int((0.05 * k - 1e-4) / 5e-4) + 1) / 3200] for k in range(40)
    ]
    return [
        {"q": "status", "toolhead": {}},
        {"q": "stepq:stepper_x", "params": {**params, "data": data}},
        {"q": "angle:my_sensor", "params": {"data": angles, "errors": 0}},
    ]


@pytest.mark.parametrize("packed", [False, True])
def test_a_log_of_klipper(packed):
    """Steps are counted at their times; angles are parts of a turn of 65 536."""
    data = b"\x03".join(json.dumps(message).encode() for message in klipper()) + b'\x03{"q": "sta'
    table = klipper_table(gzip.compress(data) if packed else data, "log.json.gz")
    assert is_klipper(gzip.compress(data)) and is_klipper(data) and not is_klipper(b"[angle\nsteps,angle\n0,1\n")
    steps, angles = ([float(c) for c in table.columns[name]] for name in ("steps", "angle (deg)"))
    assert len(steps) == 39 and "1 angles before the first step left out" in table.kind
    assert angles == pytest.approx([step * 360 / 3200 for step in steps], abs=1e-6)


def test_what_angle_calibrate_saves():
    text = b"[stepper_x]\nmicrosteps: 16\n#*# [angle my_sensor]\n#*# calibrate = \n"
    text += b"#*# \t100.5,427.5,755.0,\n#*# \t1083.0\n"
    assert is_klipper(text)
    table = klipper_table(text, "printer.cfg")
    assert table.columns["full steps"] == ("0", "1", "2", "3") and "holds no play" in table.kind
    assert float(table.columns["angle (deg)"][1]) == pytest.approx(427.5 * 360 / 65536, rel=1e-12)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        # Without a time: both processes of pytest must collect the same tests.
        (gzip.compress(b"x" * 1000, mtime=0)[:40], "series none"),
        (b"\x1f\x8bxx", "a damaged gzip file"),
        (json.dumps(klipper()[2]).encode() + b"\x03", "series angle:my_sensor"),
        (b"[angle a]\ncalibrate = 1.0\n", "a calibration of 1 angles"),
        # Long, so that a search over every division of it would not end.
        (b"[angle a]\nsensor_type: a1333\n" + 60 * b"#*# nothing more\n", "a calibration of 0 angles"),
        (
            b"\x03".join(
                json.dumps(m).encode() for m in [*klipper()[:2], {"q": "angle:s", "params": {"data": [[0, 1]]}}]
            ),
            "no angle after a step",
        ),
        (json.dumps({"q": "stepq:x", "params": {"data": 3}}).encode(), "a queue of steps of another form"),
    ],
)
def test_broken_logs_of_klipper_are_refused(data, message):
    with pytest.raises(InputError, match=message):
        klipper_table(data, "log")


def test_a_command_logged_once_a_move_is_held_until_the_next():
    """A setpoint every 10 s, the axis read 5 s later: no motion in between."""
    times = np.arange(0.0, 50.0, 10.0)
    commands = Series(times, np.array([0.0, 10.0, 20.0, 10.0, 0.0]))
    values, interpolated = command_at(commands, times + 5.0)
    np.testing.assert_array_equal(values, commands.values)
    assert interpolated == 0
