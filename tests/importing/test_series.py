"""Series of separate logs are joined by time; a value is logged only when it changes."""

from __future__ import annotations

import datetime
import gzip
import json

import numpy as np
import pytest

from tvsbayes.errors import InputError, Question
from tvsbayes.importing.series import KLIPPER_TURN, epics_table, is_camonitor, is_klipper, klipper_table

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
    table = epics_table(text, "log", {})
    assert list(table.columns) == ["time_s", *names] and len(table) == 21
    rows = np.array([[float(cell) for cell in table.columns[name]] for name in table.columns])
    assert rows[1][1:] == pytest.approx(100 + (rows[2][1:] - 5000) / 100, abs=1e-9)
    assert "20 commands interpolated in time, 1 readings outside left out" in table.kind


def test_an_ambiguous_pair_is_asked_for():
    text = "\n".join(drive()).replace(COMMAND, "A").replace(READ, "B")
    with pytest.raises(Question, match=r"A \(201 values\), B \(22 values\)") as asked:
        epics_table(text, "log", {})
    ways = [candidate.options for candidate in asked.value.candidates]
    assert ways == [("--column", f"command={c}", "--column", f"value={v}") for c, v in ("AB", "BA")]
    assert list(epics_table(text, "log", {"command": "A", "value": "B"}).columns) == ["time_s", "A", "B"]
    assert list(epics_table(text, "log", {"value": "B"}).columns) == ["time_s", "A", "B"]
    with pytest.raises(InputError, match="no such series"):
        epics_table(text, "log", {"command": "C"})


def test_series_of_two_times_are_refused():
    lines = [line("m:VAL", k, k) for k in range(9)] + [line("m:RBV", 20 + k, k) for k in range(9)]
    with pytest.raises(InputError, match="no value of m:RBV between"):
        epics_table("\n".join(lines), "log", {})


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
        (json.dumps({"q": "stepq:x", "params": {"data": 3}}).encode(), "a message of another form"),
    ],
)
def test_broken_logs_of_klipper_are_refused(data, message):
    with pytest.raises(InputError, match=message):
        klipper_table(data, "log")


@pytest.mark.parametrize(("back_s", "added_s"), [(3580.0, 3600.0), (1.0, 21.0)])
def test_a_clock_that_steps_back_goes_on(back_s, added_s):
    """By an hour less the time between two lines at the end of summer time, else by what was lost; both are said."""
    start = datetime.datetime(2026, 10, 25, 2, 50)
    lines, shift_s = [], 0.0
    for k in range(60):
        shift_s = 20.0 + back_s if k >= 30 else 0.0
        for name, later_s, value in (("m:VAL", 0.0, k % 7), ("m:encoder", 5.0, k % 7 + 0.25)):
            at = start + datetime.timedelta(seconds=20.0 * k + later_s - shift_s)
            lines.append(f"{name} {at.isoformat(' ')}.000000 {value}")
    table = epics_table("\n".join(lines), "log", {})
    times, steps, values = ([float(cell) for cell in column] for column in table.columns.values())
    assert values == pytest.approx([step + 0.25 for step in steps]) and np.all(np.diff(times) > 0)
    assert f"the clock steps back by {back_s:g} s in line 61" in table.kind and f"{added_s:g} s added" in table.kind


def test_a_value_on_the_way_is_no_reading_at_the_command():
    """A motor record logs its readback while it moves, and once more where it stops."""
    lines = []
    for k, command in enumerate([0, 1, 2, 3, 2, 1, 0, 1, 2]):
        lines.append(line("m1.VAL", 10 * k, command))
        lines += [line("m1.RBV", 10 * k + 0.5, command - 0.4), line("m1.RBV", 10 * k + 2, command)]
    table = epics_table("\n".join([*lines, line("m1.VAL", 90, 5)]), "log", {})
    commands, values = ([*map(float, table.columns[name])] for name in ("m1.VAL", "m1.RBV"))
    assert commands == values
    assert len(table) == 9 and "9 readings under way left out" in table.kind


def test_all_parts_of_a_packed_log_are_read():
    """Files of gzip that are joined are one; one that unpacks to more than the limit is refused, not cut."""
    messages = [json.dumps(message).encode() + b"\x03" for message in klipper()]
    whole = klipper_table(b"".join(messages), "log")
    parts = klipper_table(b"".join(map(gzip.compress, messages)), "log")
    assert parts.columns == whole.columns
    with pytest.raises(InputError, match="at most 64 MiB when unpacked"):
        klipper_table(gzip.compress(b"\n" * (65 * 2**20), 1), "log")


def test_messages_that_would_expand_are_small():
    """Four messages of 20 million steps: the counter at an angle's time is computed, no step is stored."""
    bomb = {"first_clock": 0, "last_clock": 2 * 10**7 - 1, "first_step_time": 0.0, "last_step_time": 20.0}
    messages = [{"q": "stepq:s", "params": {**bomb, "data": [[1, 19_999_999, 0]]}} for _ in range(4)]
    messages.append({"q": "angle:a", "params": {"data": [[10.0, 5], [20.0, 7]]}})
    table = klipper_table(b"\x03".join(json.dumps(message).encode() for message in messages), "log")
    assert [float(cell) for cell in table.columns["steps"]] == pytest.approx([10_000_000, 19_999_999], abs=2)
