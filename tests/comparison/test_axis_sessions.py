"""Later readings of an axis: nothing changes from itself, a changed ratio, play or zero is named; a dense Gaussian."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.axes import runs

from tvsbayes.comparison.axis_sessions import (
    compare_axes,
    plan_watch_axis,
    refuse_other_axis,
    shared_positions,
    watch_axis,
)
from tvsbayes.comparison.departures import FALSE_ALARM_RATE, LOOKS_MIN
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.report.command_text import changes_text, watch_plan_text, watch_text
from tvsbayes.report.tables import sentences
from tvsbayes.results.watch_record import MOVED, OK
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.axis_fit import AxisFit, fit_axis
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_rows import rows_of

PLAY, U = 0.4, 0.004


def cycles(homings: int) -> tuple[AxisMove, ...]:
    """A cycle after every homing."""
    once = runs(1)
    return tuple(
        replace(move, move=k * len(once) + move.move, segment=k, time_s=60.0 * (k * len(once) + move.move))
        for k in range(homings)
        for move in once
    )


def session(
    homings: int, seed: int, *, ratio: float = 0.01, play: float = PLAY, zero: float = 0.0, homing: float = 0.003
) -> AxisCampaign:
    """Readings of an axis without errors by position: play, homings of a small scatter, stops of 0.004 deg."""
    rng, moves = np.random.default_rng(seed), cycles(homings)
    command = np.array([move.command for move in moves])
    first = np.r_[True, np.diff([move.segment for move in moves]) > 0]
    side = np.where(first, -1.0, np.sign(np.r_[0.0, np.diff(command)]))
    homes = homing * rng.standard_normal(homings)[[move.segment for move in moves]]
    value = ratio * command - 0.5 * play * side + zero + homes + 0.004 * rng.standard_normal(len(moves))
    readings = tuple(Reading(k, k, float(v + U * rng.standard_normal()), U) for k, v in enumerate(value))
    return AxisCampaign("deg", moves, readings, {"per_command": AxisPrior(0.01, 0.002)})


@pytest.fixture(scope="module")
def known() -> AxisFit:
    return fit_axis(session(3, 1), sampled=False)


def test_an_axis_that_has_not_changed_is_ok(known):
    test = watch_axis(known, session(1, 50))
    assert test.verdict == OK and test.p > FALSE_ALARM_RATE and not test.moved and test.looks == 17
    assert [change.what for change in test.changes] == ["ratio", "play", "zero"]
    text = watch_text(test, 0.8, "stops")
    assert "17 new stops against the calibration" in text and "look" not in text


@pytest.mark.parametrize(
    ("what", "size", "change"),
    [("ratio", 0.4, {"ratio": 0.01 * 1.004}), ("play", -0.1, {"play": PLAY - 0.1}), ("zero", 0.1, {"zero": 0.1})],
)
def test_what_moved_is_named_with_its_size(known, what, size, change):
    """The ratio moves the zero not at all: both are of command 0, in the middle."""
    test = watch_axis(known, session(1, 51, **change))
    assert test.verdict == MOVED
    [part] = test.moved
    assert part.what == what and abs(part.value - size) < 4 * part.u < abs(size)
    assert f"moved: {what} " in watch_text(test, 0.8, "stops") and "inaccurate" not in watch_text(test, 0.8, "stops")


def test_every_change_has_its_help_and_remedy(known):
    for change in watch_axis(known, session(1, 52)).changes:
        assert change.what in sentences("watch_better") and change.what in sentences("moved")


def test_a_plan_watches_with_the_power_that_it_states(known):
    """The fewest stops for each change; a session at its stops has these powers."""
    plan, stops = plan_watch_axis(known)
    assert plan.met and plan.looks == len(stops.stops) and plan.minutes <= plan.minutes_allowed
    assert [change.what for change in plan.changes] == ["ratio", "play", "zero"]
    assert all(change.looks_needed <= plan.looks for change in plan.changes)
    path = [command for arrival in stops.arrivals for command in (arrival.via, arrival.command) if command is not None]
    moves = tuple(AxisMove(k, 0, 60.0 * k, c, "" if k else "backward") for k, c in enumerate(path))
    read = [k for k in range(len(path)) if path[k] in {c for c, _ in stops.stops}]
    looks = AxisCampaign("deg", moves, tuple(Reading(n, k, 0.01 * path[k], U) for n, k in enumerate(read)), {})
    watched = {change.what: change.power for change in watch_axis(known, looks).changes}
    for change in plan.changes:
        assert change.power == pytest.approx(watched[change.what], abs=0.15) and change.power >= 0.8
    few, shorter = plan_watch_axis(known, minutes=0.6 * plan.minutes)
    assert few.looks < plan.looks and few.looks == len(shorter.stops) and not few.met
    text = watch_plan_text(plan, "stops")
    assert f"{plan.looks} stops after 1 homing," in text and "look" not in text


def test_the_zero_of_a_campaign_with_one_homing_is_not_watched():
    """Its scatter is the prior's."""
    one = fit_axis(session(1, 2), sampled=False)
    assert [change.what for change in watch_axis(one, session(1, 53)).changes] == ["ratio", "play"]
    absolute = replace(session(2, 3, homing=0.0), absolute=True)
    test = watch_axis(fit_axis(absolute, sampled=False), replace(session(1, 54, homing=0.0, zero=0.1), absolute=True))
    assert test.verdict == MOVED and test.moved[0].what == "zero"


def test_readings_that_cannot_be_watched_are_refused(known):
    fresh = session(1, 55)
    with pytest.raises(InputError, match="of the first folder"):
        watch_axis(known, known.campaign)
    with pytest.raises(InputError, match="'mm'"):
        refuse_other_axis(known.campaign, replace(fresh, unit="mm"))
    with pytest.raises(NothingToEstimate, match=f"at least {LOOKS_MIN}"):
        watch_axis(known, replace(fresh, readings=fresh.readings[:3]))


def fitted_beside(known: AxisFit, later: AxisCampaign) -> AxisFit:
    return fit_axis(later, sampled=False, more=shared_positions(known.rows, rows_of(later)))


def test_line_and_play_are_compared_at_the_positions_that_both_reach(known):
    same = compare_axes(known, fitted_beside(known, session(2, 60)))
    assert same.verdict == "no significant change" and same.range_command == (-2300.0, 2300.0)
    assert [change.quantity for change in same.changes] == ["effective_per_command", "effective_backlash"]
    assert {change.unit for change in same.changes} == {"deg per command", "deg"}
    document = same.as_json()
    assert "reference_pose_deg" not in document and "shared_cameras" not in document
    worn = compare_axes(known, fitted_beside(known, session(2, 61, play=PLAY + 0.05)))
    assert [change.significant for change in worn.changes] == [False, True]
    assert worn.changes[1].difference == pytest.approx(0.05, abs=4 * worn.changes[1].u)
    text = changes_text(worn)
    assert "from command -2300 to 2300" in text and "effective_backlash by +" in text and "camera" not in text


def test_axes_without_common_positions_are_not_compared(known):
    narrow = session(1, 62)
    readings = tuple(reading for reading in narrow.readings if narrow.moves[reading.move].command > 2000.0)
    with pytest.raises(NothingToEstimate):
        shared_positions(known.rows, rows_of(replace(narrow, readings=readings)))
