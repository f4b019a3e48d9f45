"""Device model and firmware core: both on the same bytes, ramps, homing, watchdog, laser.

The differential test builds the C++ core with g++ in a temporary folder (conftest), sanitizers on where they link.
"""

from __future__ import annotations

import re

import pytest
from support.firmware_sessions import Bench, random_orders, replay

from tvsbayes.positioner import firmware_folder
from tvsbayes.positioner.protocol import SETTINGS, parse_answer, request

FIRMWARE = firmware_folder()


def test_moves_need_homing_stay_inside_the_limits_and_never_overlap():
    bench = Bench()
    assert bench.ask(1, "MA", 1, 1).error == "unhomed"
    assert bench.ask(2, "L", 1).error == "unhomed"
    bench = Bench().homed()
    assert bench.ask(5, "MA", 1001, 0).error == "limit"
    assert bench.ask(6, "MA", 0, -501).error == "limit"
    assert bench.ask(7, "MA", 200, 0).error is None
    assert bench.ask(8, "MA", 0, 0).error == "busy"
    assert bench.ask(9, "SET", "pmax", 5).error == "busy"
    assert bench.ask(10, "HOME").error == "busy"
    assert bench.ask(11, "HOME", 1).error == "argument"
    assert bench.ask(12, "MOVE", 1).error == "command"
    assert bench.ask(13, "SET", "pmax", 10**9).error == "argument"
    assert bench.ask(14, "GET", "pmax").extra == {"v": "1000"}


def test_ramp_obeys_speed_and_acceleration_and_ends_slowly():
    """Intervals between steps against the trapezoid: v^2 = 200^2 + 2 a n, up to vmax, down again."""
    bench = Bench().homed()
    bench.ask(5, "MA", 0, 0)
    bench.pass_time(5)
    times_us: list[int] = []
    step, start = bench.board.step, bench.now_us
    bench.board.step = lambda axis, sense: (times_us.append(bench.device._axes[0].due_us), step(axis, sense))
    bench.ask(6, "MA", 400, 0)
    bench.pass_time(5)
    gaps = [b - a for a, b in zip([start, *times_us], times_us, strict=False)]
    assert len(gaps) == 400
    vmax, amax = SETTINGS["vmax"][2], SETTINGS["amax"][2]
    # One step of ramp and the rounding to a microsecond: 1e6 / 800 = 1250 us, exactly.
    assert min(gaps) == 1_000_000 // vmax
    assert gaps[0] == gaps[-1] == 5000
    for n, gap in enumerate(gaps[:50]):
        speed = min((200**2 + 2 * amax * n) ** 0.5, vmax)
        assert gap == pytest.approx(1e6 / speed, rel=1 / 200, abs=1)
    assert gaps == gaps[::-1]


def test_abort_and_limit_switch_end_in_alarm_with_the_laser_off():
    for word in ("ABORT", "limit"):
        bench = Bench(limit=300).homed()
        bench.ask(5, "L", 1)
        assert bench.board.laser_on
        bench.ask(6, "MA", 600, 0)
        bench.pass_time(0.3)
        if word == "ABORT":
            bench.ask(7, "ABORT")
        bench.pass_time(1.5)
        state = bench.ask(8, "?").state
        assert (state.status, state.last_error) == ("alarm", word.lower())
        assert not bench.board.laser_on
        assert bench.ask(9, "L", 1).error == "alarm"
        assert bench.ask(10, "MA", 0, 0).error == "alarm"
        bench.ask(11, "HOME")
        bench.pass_time(20)
        assert bench.ask(12, "MA", 0, 0).error is None


def test_watchdog_switches_the_laser_off_and_valid_frames_keep_it_on():
    bench = Bench().homed()
    bench.ask(5, "L", 1)
    for k in range(10):
        bench.pass_time(1.9)
        assert bench.ask(6 + k, "?").state.laser_on
    bench.pass_time(1.9)
    bench.device.receive(b">99 ?*0000\n", bench.now_us)
    bench.pass_time(0.11)
    assert not bench.board.laser_on, "a damaged frame is no sign of life"
    assert bench.ask(40, "?").state.last_error == "watchdog"


def test_homing_that_opens_a_limit_ends_there_and_one_from_an_open_limit_leads_back(native):
    """A home switch that never comes is not searched for against the stop."""
    orders = [f"x {request(1, 'HOME').hex()}", "a 2000000", "q", f"x {request(2, '?').hex()}"]
    bench = Bench(home=(-60_000, -40), limit=300)
    assert replay(native, orders, home=(-60_000, -40), limit=300) == bench.run(orders)
    state = parse_answer(bench.sent[-1][:-1]).state
    assert (state.status, state.last_error, bench.board.true_steps) == ("alarm", "limit", [-301, 0])
    bench.board.home_steps, bench.board.true_steps[:] = (-60, -40), [400, -400]
    bench.ask(3, "HOME")
    bench.pass_time(20)
    assert (bench.ask(4, "?").state.status, bench.board.true_steps) == ("idle", [-60, -40])


@pytest.mark.parametrize("seed", range(12))
def test_firmware_core_and_model_do_the_same_with_the_same_bytes(native, seed):
    orders = random_orders(seed)
    ours, theirs = Bench().run(orders), replay(native, orders)
    assert theirs == ours


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 400))
def test_firmware_core_and_model_do_the_same_in_300_sessions(native, seed):
    orders = random_orders(seed)
    assert replay(native, orders) == Bench().run(orders)


def test_random_sessions_reach_every_branch():
    """The differential test covers what its sessions exercise."""
    lines = "\n".join(line for seed in range(12) for line in Bench().run(random_orders(seed)))
    text = "\n".join(bytes.fromhex(line.split()[2]).decode() for line in lines.splitlines() if line.startswith("w"))
    wanted = [f"err {word} " for word in ("command", "argument", "seq", "unhomed", "alarm", "busy", "limit")]
    wanted += [f"!nak {kind}" for kind in ("frame", "crc", "parse", "long")]
    wanted += ["e=watchdog", "e=stop", "e=abort", "e=limit", "st=moving", "st=alarm", "st=unhomed", "l=1"]
    assert [word for word in wanted if word not in text] == []


def test_firmware_travels_with_the_package():
    """Everything that a user needs to flash the board lies in the installed package."""
    names = ["README.md", "tvs_positioner/tvs_positioner.ino", "tvs_positioner/tvs_core.h"]
    names += ["tvs_positioner/tvs_core.cpp", "tvs_positioner/tvs_motion.cpp", "native/replay.cpp", "platformio.ini"]
    names += [f"emulated/{name}" for name in ("Arduino.h", "EEPROM.h", "IntervalTimer.h", "an500.ld", "board.cpp")]
    assert [name for name in names if not (FIRMWARE / name).is_file()] == []
    core = "".join(path.read_text() for path in (FIRMWARE / "tvs_positioner").glob("tvs_*.[hc]*"))
    code = re.sub(r"//.*", "", core)
    line = request(0, "ID").decode().strip()
    assert f"`{line}`" in (FIRMWARE / "README.md").read_text(), "what the user types to see the board answer"
    assert re.findall(r"Arduino\.h|\bmalloc\b|\bnew\b|\bstd::", code) == []
