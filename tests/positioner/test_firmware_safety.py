"""What the firmware does when something is wrong at the bench: wires, switches, stalls, hosts that lost their number.

Every session runs on the Python model and on the C++ core, which must say the same.
"""

from __future__ import annotations

import itertools
import re

import pytest
from support.firmware_sessions import FIRMWARE, Bench, frame, replay

from tvsbayes.positioner.protocol import SEQUENCE_MAX, TRIGGER_US, DeviceState, Reply, parse_answer, request


class Twin(Bench):
    """A bench that also writes down the script it followed."""

    def __init__(self, **board):
        self.script: list[str] = []
        super().__init__(**board)

    def order(self, *orders: str) -> None:
        self.script += orders
        self.run(list(orders))

    def ask(self, sequence: int, *words: object) -> Reply:
        self.order(f"x {request(sequence, *words).hex()}")
        answer = parse_answer(self.sent[-1][:-1])
        assert isinstance(answer, Reply)
        return answer

    def pass_time(self, seconds: float) -> None:
        self.order(f"a {self.now_us + round(seconds * 1e6)}")

    def stall(self, seconds: float) -> None:
        """The main loop hangs, and comes round once."""
        self.order(f"j {self.now_us + round(seconds * 1e6)}")

    def state(self, sequence: int) -> DeviceState:
        return self.ask(sequence, "?").state

    def homed(self) -> Twin:
        super().homed()
        return self


@pytest.fixture
def fresh(native):
    """A bench; in the end its transcript is that of the C++ core on the same script."""
    twin = Twin()
    yield twin
    assert replay(native, twin.script) == twin.transcript


@pytest.fixture
def bench(fresh) -> Twin:
    """The same after homing."""
    return fresh.homed()


def test_orders_that_make_safe_need_no_number(bench):
    bench.ask(SEQUENCE_MAX, "L", 1)
    assert bench.ask(0, "L", 1).error == "seq" and bench.board.laser_on, "light needs a number"
    reply = bench.ask(0, "L", 0)
    assert (reply.error, reply.state.laser_on, bench.board.laser_on) == (None, False, False)
    assert [bench.ask(0, *words).error for words in (("MA", 1, 1), ("HOME",), ("?",), ("L", 0, 0), ("STOP", 1))] == [
        "seq"
    ] * 5


@pytest.mark.parametrize(("word", "ends"), [("STOP", ("idle", "stop")), ("ABORT", ("alarm", "abort"))])
def test_unnumbered_stop_and_abort_end_a_motion(bench, word, ends):
    bench.ask(SEQUENCE_MAX, "MA", 800, 0)
    bench.pass_time(0.5)
    assert bench.ask(0, word).error is None
    bench.pass_time(3)
    state = bench.ask(0, "ID").state
    assert (state.status, state.last_error) == ends and state.pan_steps < 800


@pytest.mark.parametrize(
    "line",
    [request(3, "?"), request(0, "ID"), request(0, "STOP"), frame(">99999999999 ?"), request(6, "MA", 10**6, 0)],
    ids=["stale", "ID", "STOP", "parse", "refused and repeated"],
)
def test_only_a_host_that_is_obeyed_keeps_the_light_on(bench, line):
    bench.ask(5, "L", 1)
    for _ in range(5):
        bench.pass_time(0.45)
        bench.order(f"x {line.hex()}")
    assert not bench.board.laser_on


def test_a_repeated_request_is_a_sign_of_life(bench):
    bench.ask(5, "L", 1)
    for _ in range(5):
        bench.pass_time(1.5)
        bench.ask(5, "L", 1)
    assert bench.board.laser_on


def test_overdue_steps_never_come_in_a_burst(bench):
    """After a stall of 100 ms one step, then a ramp from the starting speed: gaps that a motor at rest can follow."""
    bench.ask(5, "MA", 0, 0)
    bench.pass_time(5)
    bench.ask(6, "MA", 800, 0)
    bench.pass_time(0.6)
    before = bench.board.true_steps[0]
    bench.stall(0.1)
    assert bench.board.true_steps[0] == before + 1
    # The core's steps are not on record, its counter is.
    assert bench.state(7).pan_steps == before + 1
    times_us, step = [bench.now_us], bench.board.step
    bench.board.step = lambda axis, sense: (times_us.append(bench.now_us), step(axis, sense))
    bench.pass_time(5)
    gaps = [after - earlier for earlier, after in itertools.pairwise(times_us)]
    assert gaps[0] == 1_000_000 // 200 and min(gaps) == 1_000_000 // 800
    assert bench.board.true_steps[0] == 800 and bench.state(8).done_sequence == 6


def test_a_little_lateness_keeps_speed_and_never_shortens_a_gap(bench):
    bench.ask(5, "MA", 0, 0)
    bench.pass_time(5)
    bench.ask(6, "MA", 800, 0)
    times_us, step = [], bench.board.step
    bench.board.step = lambda axis, sense: (times_us.append(bench.now_us), step(axis, sense))
    for _ in range(1000):
        bench.stall(0.0015)
    gaps = [after - earlier for earlier, after in itertools.pairwise(times_us)]
    # 1500 us a loop, steps due every 1250 us at the top: one step a loop, none made up.
    assert min(gaps) == 1500 and bench.board.true_steps[0] == 800


@pytest.mark.parametrize("dead_switch", [False, True])
@pytest.mark.parametrize("axis", [0, 1])
def test_homing_with_a_cut_limit_wire_is_short_and_ends_in_alarm(native, axis, dead_switch):
    """Neither a good end, again and again, nor 20 000 steps into the stop."""
    bench = Twin(home=(-600, -500))
    bench.order(f"c {axis} 1", f"e {axis} {int(dead_switch)}")
    for sequence in (1, 3):
        before = list(bench.board.true_steps)
        bench.ask(sequence, "HOME")
        bench.pass_time(40)
        state = bench.state(sequence + 1)
        assert (state.status, state.last_error, state.limit_open[axis]) == ("alarm", "limit", True)
        # 200 steps, and the one that is too many.
        assert abs(bench.board.true_steps[axis] - before[axis]) <= 201
    assert replay(native, bench.script, home=(-600, -500)) == bench.transcript


def test_homing_does_not_end_behind_an_open_limit(fresh):
    """A home switch that is found within the way that an open limit allows is no home."""
    fresh.order("c 0 1")
    fresh.ask(1, "HOME")
    fresh.pass_time(20)
    state = fresh.state(2)
    assert (state.status, state.last_error, state.pan_switches) == ("alarm", "limit", 3)
    fresh.order("c 0 0")
    fresh.ask(3, "HOME")
    fresh.pass_time(20)
    assert fresh.state(4).status == "idle"


def test_a_limit_of_pan_that_opens_while_tilt_homes_is_seen(fresh):
    fresh.ask(1, "HOME")
    fresh.pass_time(1.2)
    fresh.order("c 0 1")
    fresh.pass_time(20)
    state = fresh.state(2)
    assert (state.status, state.last_error) == ("alarm", "limit")


def test_a_limit_that_opens_at_rest_darkens_and_alarms(bench):
    bench.ask(5, "L", 1)
    bench.order("c 1 1")
    bench.pass_time(0.004)
    bench.order("c 1 0")
    bench.pass_time(0.02)
    assert bench.state(6).status == "idle", "4 ms are a spike"
    bench.order("c 1 1")
    bench.pass_time(0.0)
    bench.pass_time(0.005)
    state = bench.state(7)
    assert (state.status, state.last_error, state.laser_on) == ("alarm", "limit", False)
    assert not bench.board.laser_on


def test_the_limit_of_the_axis_at_rest_ends_a_motion_too(bench):
    bench.ask(5, "MA", 500, -40)
    bench.pass_time(0.3)
    before = bench.board.true_steps[0]
    bench.order("c 1 1")
    bench.pass_time(0.1)
    assert bench.state(6).status == "alarm" and bench.board.true_steps[0] == before + 1


@pytest.mark.parametrize("after", [0.0, 0.2, 0.45, 0.7, 0.9, 1.1, 1.3, 1.5, 1.7, 1.9])
@pytest.mark.parametrize("readings", [1, 4])
def test_bounce_of_the_home_switch_makes_no_wrong_zero(fresh, after, readings):
    """Up to four wrong readings in a row, in every phase of the first homing of either axis."""
    fresh.ask(1, "SET", "hp", -60)
    fresh.ask(2, "SET", "ht", -40)
    fresh.ask(3, "HOME")
    fresh.pass_time(after)
    fresh.order(f"b 0 {readings}")
    fresh.pass_time(15)
    state = fresh.state(4)
    assert (state.status, state.pan_steps, state.tilt_steps) == ("idle", -60, -40)
    assert fresh.board.true_steps == [-60, -40]
    # What the core took for home is not on record; another homing determines it.
    fresh.ask(5, "HOME")
    fresh.pass_time(15)
    state = fresh.state(6)
    assert (state.pan_home_deviation_steps, state.tilt_home_deviation_steps) == (0, 0)


def test_replies_say_that_the_guard_has_darkened_the_laser(bench):
    bench.ask(5, "L", 1)
    bench.stall(0.3)
    bench.order("d")
    state = bench.state(6)
    assert (state.laser_on, state.last_error, bench.board.laser_on) == (False, "stall", False)
    assert bench.ask(7, "L", 1).state.laser_on
    bench.order("d", "d")


def test_switches_stand_in_every_reply(fresh):
    assert (fresh.state(1).home_pressed, fresh.state(2).limit_open) == ((False, False), (False, False))
    fresh.order("c 1 1", "b 0 1")
    state = fresh.state(3)
    assert (state.home_pressed, state.limit_open) == ((True, False), (False, True))
    assert (state.pan_switches, state.tilt_switches) == (1, 2)


def test_trigger_line_is_high_for_as_long_as_ordered(fresh):
    start_us, shortest = fresh.now_us, TRIGGER_US[0]
    assert fresh.ask(1, "TRIG", 5000).error is None
    fresh.pass_time(1)
    assert [line for line in fresh.transcript if line.startswith("t")][-2:] == [
        f"t {start_us} 1",
        f"t {start_us + 5000} 0",
    ]
    assert [fresh.ask(2 + k, "TRIG", us).error for k, us in enumerate((shortest - 1, 10**6 + 1, "1e3"))] == [
        "argument"
    ] * 3
    fresh.ask(9, "TRIG", 10**6)
    fresh.pass_time(0.5)
    fresh.ask(9, "TRIG", 10**6)
    fresh.pass_time(0.6)
    assert not fresh.board.trigger_on, "a repeated request is not executed again"


def test_sketch_resets_itself_and_darkens_in_a_fault():
    """What no test without the board can run is at least there, and in one order: pin low, then wait for the reset."""
    sketch = (FIRMWARE / "tvs_positioner" / "tvs_positioner.ino").read_text()
    fault = re.search(r"void dark_in_fault\(\) \{(.*?)\n\}", sketch, re.DOTALL)[1]
    assert fault.index("digitalWriteFast(kLaserPin, LOW)") < fault.index("for (;;)")
    half_seconds = int(re.search(r"kWatchdogHalfSeconds = (\d+);", sketch)[1])
    assert half_seconds * 0.5 <= 1.0, "well within the promised 2 s"
    assert sketch.index("feed_watchdog();", sketch.index("void loop()")) > 0
    started = re.search(r"void start_watchdog\(\) \{(.*?)\n\}", sketch, re.DOTALL)[1]
    assert "vector = 3; vector <= 6; ++vector) _VectorsRam[vector] = dark_in_fault;" in started
    assert started.index("WDOG_WCR_WDE") < started.index("feed_watchdog();")
    assert "  start_watchdog();\n}" in sketch[sketch.index("void setup()") : sketch.index("void loop()")]


def test_direction_stands_before_the_step():
    """5 us, what drives of the DM542's kind ask for, between the direction and the rising edge."""
    sketch = (FIRMWARE / "tvs_positioner" / "tvs_positioner.ino").read_text()
    step = re.search(r"void step\(int axis, bool positive\) override \{(.*?)\n  \}", sketch, re.DOTALL)[1]
    orders = [
        "digitalWriteFast(kDirectionPin",
        "delayMicroseconds(kDirectionSetupUs)",
        "digitalWriteFast(kStepPin[axis], HIGH)",
    ]
    places = [step.index(order) for order in orders]
    assert places == sorted(places)
    assert int(re.search(r"kDirectionSetupUs = (\d+);", sketch)[1]) >= 5


def test_a_switch_that_bounces_while_it_is_left_is_left_by_the_whole_way(bench):
    """Twenty steps without a contact, counted again after one."""
    bench.ask(5, "HOME")
    bench.pass_time(0.05)
    left, step = [bench.board.true_steps[0]], bench.board.step
    bench.board.step = lambda axis, sense: (step(axis, sense), left.append(bench.board.true_steps[0]))
    bench.order("b 0 1")
    bench.pass_time(20)
    assert -60 < left[0] < -45 and max(left) == left[0] + 1 + 20
    assert bench.board.true_steps == [-60, -40]
