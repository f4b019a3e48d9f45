"""Progress of a job: never decreasing, reaching 1, stopped by a listener's exception."""

from __future__ import annotations

import sys
import threading
from functools import partial

import pytest
from support.waits import check_forward

from tvsbayes import progress
from tvsbayes.progress import EXPECTED_SECONDS, EXPECTED_SHARE, DelayedDisplay, Job, OpenEnded, Progress

ROUNDING = 2.0**-50
"""Of a sum of a few shares near 1, four units of float64's last place."""


class Clock:
    """A clock set by the test."""

    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def followed(stages, steps):
    """States reported by a job whose steps are (seconds that pass, stage to begin or share of the present one)."""
    clock, states = Clock(), []
    with Job(stages, states.append, clock) as job:
        for seconds, step in steps:
            clock.now_s += seconds
            if isinstance(step, str):
                job.begin(step)
            else:
                job.at(step)
    return states


def test_stages_add_up_to_the_whole():
    states = followed({"one": 1.0, "nothing": 0.0, "two": 2.0, "three": 5.0}, [(1, n) for n in ("one", "two", "three")])
    assert [state.share for state in states] == pytest.approx([0, 1 / 8, 3 / 8, 1], abs=ROUNDING)
    assert [state.doing for state in states] == ["one", "two", "three", "three"]
    check_forward(states)
    again = followed({"one": 3.0, "two": 1.0}, [(1, 0.5), (1, 1.0), (1, "two"), (1, 0.25), (0, 9.0)])
    assert [state.share for state in again] == pytest.approx([3 / 8, 3 / 4, 3 / 4, 13 / 16, 1, 1], abs=ROUNDING)


def test_stages_without_time_are_not_reported():
    states = followed({"nothing": 0.0, "all": 2.0}, [(1, "nothing"), (1, 0.5), (1, "all")])
    assert [state.doing for state in states] == ["all", "all"]
    for stages in ({}, {"nothing": 0.0}, {"back": -1.0, "forth": 3.0}):
        with pytest.raises(ValueError, match="shares of the time"):
            Job(stages)


def test_the_reported_share_never_decreases():
    states = followed({"one": 1.0, "two": 1.0}, [(1, 0.9), (1, 0.2), (1, "two"), (1, -3.0), (-9, 0.5), (1, "one")])
    check_forward(states)
    assert [state.share for state in states] == pytest.approx([0.45, 0.45, 0.5, 0.5, 0.75, 0.75, 1], abs=ROUNDING)


def test_time_left_of_an_even_job_is_right_from_the_beginning():
    """A hundred steps of half a second: 50 s less what has passed, once there is something to predict by."""
    states = followed({"all": 1.0}, [(0.5, (k + 1) / 100) for k in range(100)])
    known = [state for state in states if state.seconds_left is not None]
    assert known[0].share >= EXPECTED_SHARE and known[0].seconds >= EXPECTED_SECONDS and len(known) >= 99
    for state in known:
        assert state.seconds_left == pytest.approx(50 - state.seconds, abs=1e-9), "50 s, shares rounded to 1e-16"
    check_forward(states)


def test_time_left_of_an_uneven_job_rises_with_the_clock_at_most():
    """A stage that takes fifty times what was expected, and one that takes nothing."""
    steps = [(0.1, k / 10) for k in range(10)] + [(0.0, "slow")] + [(5, k / 10) for k in range(10)] + [(0, "none")]
    states = followed({"fast": 1.0, "slow": 1.0, "none": 8.0}, steps)
    check_forward(states)
    assert max(state.seconds_left for state in states if state.seconds_left is not None) > 20, "or nothing could rise"


@pytest.mark.parametrize("needed", [True, False])
def test_a_skipped_stage_predicts_no_time(needed):
    """Ten steps of a second each, after a stage of nine tenths whose result is stored."""
    clock, states = Clock(), []
    with Job({"fit": 9.0, "work": 1.0, "more": 0.0}, states.append, clock) as job:
        if needed:
            job.part("fit")
        job.begin("work")
        for k in range(1, 11):
            clock.now_s += 1
            job.at(k / 10)
    check_forward(states)
    known = [state for state in states if state.seconds_left is not None]
    # A step is a hundredth of the whole: two of them are enough to predict by.
    assert len(known) == 10
    for state in known:
        assert state.seconds_left == pytest.approx(10 - state.seconds, abs=1e-9), "shares rounded to 1e-16"


def test_a_job_within_a_job_fills_its_stage():
    clock, states = Clock(), []
    with Job({"first": 1.0, "second": 3.0}, states.append, clock) as job:
        with Job({"a": 1.0, "b": 1.0}, job.part("first"), clock) as inner:
            inner.begin("b")
        with Job({"c": 1.0}, job.part("second"), clock) as inner:
            inner.at(0.5, "2 of 4")
    assert [(state.doing, state.share) for state in states] == [
        *(("first", 0), ("first: b", 1 / 8), ("first: b", 1 / 4)),
        *(("second", 1 / 4), ("second: c: 2 of 4", 5 / 8), ("second: c: 2 of 4", 1)),
        ("second: c: 2 of 4", 1),
    ]
    check_forward(states)


def test_without_a_listener_no_clock_is_read():
    def clock():
        calls.append(1)
        return 0.0

    calls: list[int] = []
    with Job({"all": 1.0}, None, clock) as job:
        job.at(0.5)
        assert job.part("all") is None
    assert len(calls) == 1


def test_a_listener_can_stop_the_job():
    """The listener's exception passes through; a stopped job does not report its end."""
    states = []

    def stop(state):
        states.append(state)
        if state.share > 0.3:
            raise LookupError("enough")

    with pytest.raises(LookupError, match="enough"), Job({"all": 1.0}, stop) as job:
        for k in range(10):
            job.at(k / 10)
    assert [state.share for state in states] == [0, 0.1, 0.2, 0.3, 0.4]


def test_a_stage_of_unknown_length_goes_on_when_more_is_expected():
    stage = OpenEnded()
    shares = [stage.share(done, 200) for done in (0, 100, 200)] + [stage.share(done, 300) for done in (200, 250, 300)]
    # Four fifths by the first expectation, then four fifths of what is left.
    assert shares == pytest.approx([0, 0.4, 0.8, 0.8, 0.88, 0.96], abs=ROUNDING)
    assert stage.share(400, 300) == pytest.approx(0.96, abs=ROUNDING), "never at its end before it is"
    assert OpenEnded().share(0, 0) == 0


PATIENCE_SECONDS = 20.0
"""For a timer without delay on a busy machine."""


@pytest.fixture
def session(monkeypatch):
    """An interactive session without delay: its lines, and an event of the first one."""
    lines, appeared = [], threading.Event()

    def write(state: Progress | None) -> None:
        lines.append("" if state is None else f"{100 * state.share:.0f} %, {state.doing}")
        appeared.set()

    monkeypatch.setattr(sys, "ps1", ">>> ", raising=False)
    monkeypatch.setattr(progress, "SHOWN_AFTER_SECONDS", 0.0)
    monkeypatch.setattr(progress, "DelayedDisplay", partial(DelayedDisplay, writer=lambda: write))
    return lines, appeared


def test_a_session_shows_one_line_and_clears_it(session):
    """Also of a job inside the job, and after an exception."""
    lines, appeared = session
    with Job({"fit": 1.0, "sampling": 1.0}) as job:
        assert appeared.wait(PATIENCE_SECONDS)
        with Job({"inner": 1.0}) as inner:
            inner.at(0.5)
        job.begin("sampling")
    assert lines[0] == "0 %, fit" and "50 %, sampling" in [line.rpartition(",")[0] or line for line in lines] + lines
    assert lines[-1] == "" and not any("inner" in line for line in lines)
    appeared.clear()
    with pytest.raises(KeyboardInterrupt), Job({"fit": 1.0}):
        assert appeared.wait(PATIENCE_SECONDS)
        raise KeyboardInterrupt
    assert lines[-1] == ""


def test_scripts_and_listeners_see_no_line(session, monkeypatch):
    lines, _ = session
    states = []
    with Job({"fit": 1.0}, states.append):
        pass
    monkeypatch.delattr(sys, "ps1")
    with Job({"fit": 1.0}):
        pass
    assert states and lines == []
