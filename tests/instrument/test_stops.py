"""Stops of moves, and the quantities that a sequence of moves determines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.written_rows import move_row

from tvsbayes.instrument.campaign import Move
from tvsbayes.instrument.stops import Stop, few_stops, observed_stops, redraws, separation


def pan_moves(*counters: int, approach: str = "left") -> tuple[Move, ...]:
    """One segment that visits these pan counters; the tilt axis rests."""
    return tuple(move_row(i, 0, float(i), n, 0, *((approach, "up") if i == 0 else ())) for i, n in enumerate(counters))


def pan_separation(*counters: int) -> str | None:
    """Verdict where every move is followed by a look."""
    moves = pan_moves(*counters)
    return separation(observed_stops(moves, range(len(moves)), "pan"), "pan")


def test_a_homing_begins_a_new_stop_at_the_same_counter():
    moves = (*pan_moves(0, 200), move_row(2, 1, 2.0, 200, 0, "right", "unknown"), move_row(3, 1, 3.0, 0, 0))
    assert observed_stops(moves, range(4), "pan") == (
        Stop(0, 0, 1),
        Stop(0, 200, 1),
        Stop(1, 200, -1),
        Stop(1, 0, -1),
    )
    assert observed_stops(moves, range(4), "tilt") == (Stop(0, 0, 1), Stop(1, 0, 0))


def test_return_moves_of_one_step_count_are_named_with_a_remedy():
    text = pan_separation(*[0, 200] * 12)
    assert "only one |N| = 200" in text
    assert "add N = 100 or a cleared approach" in text


def test_two_step_counts_separate():
    assert pan_separation(*[0, 200, 0, 100] * 6) is None


def test_homing_is_no_leg():
    """A second segment homed at counter 40 adds no leg of another length."""
    one = pan_moves(*[0, 200] * 12)
    homed = move_row(len(one), 1, 100.0, 40, 0, "left", "up")
    both = (*one, homed)
    assert "only one |N| = 200" in separation(observed_stops(both, range(len(both)), "pan"), "pan")
    # Two homings from either side, and nothing driven.
    alone = (move_row(0, 0, 0.0, 0, 0, "left", "up"), move_row(1, 1, 1.0, 40, 0, "right", "up"))
    assert "no leg of the pan axis" in separation(observed_stops(alone, range(2), "pan"), "pan")


@pytest.mark.parametrize("counters", [(0, 50, 100, 200), (0, 0, 0, 200)])
def test_one_side_only_is_named(counters):
    assert "reached from one side" in pan_separation(*counters)


def test_one_counter_only_is_named():
    assert "one counter only" in pan_separation(100, 100, 100)
    assert "one counter only" in separation((), "pan")


def test_every_segment_has_its_own_zero():
    """Two segments, each seen from one side only, cannot tell backlash from home offset; one segment can."""
    stops = [Stop(segment, n, sign) for segment, sign in ((0, 1), (1, -1)) for n in (0, 100, 200)]
    assert separation(stops, "tilt") is not None
    assert separation([replace(stop, segment=0) for stop in stops], "tilt") is None


def test_a_stop_error_is_redrawn_when_its_counter_changes_or_is_set():
    moves = (*pan_moves(0, 200, 0), move_row(3, 0, 3.0, 0, 50), move_row(4, 1, 4.0, 0, 50, "unknown", "down"))
    # The pan axis moved away and back between the second and the third look.
    new = redraws(moves, (0, 0, 2, 3, 4))
    assert new.redraw.tolist() == [[True, True], [False, False], [True, False], [False, True], [True, True]]
    assert new.redraw_mix[[0, 2, 4], 0].tolist() == [[0, 1], [1, 0], [0.5, 0.5]]
    assert new.redraw_mix[[1, 3], 0].tolist() == [[0, 0], [0, 0]]
    assert new.new_segment.tolist() == [True, False, False, False, True]
    assert new.homed.tolist() == [[False, False]] * 4 + [[True, True]]
    assert redraws(moves, (0, 4), homed_from=0).homed.tolist() == [[True, True]] * 2


def test_a_homing_does_not_set_an_absolute_zero():
    """The tilt walks on from the look before; its play and its stop are new."""
    moves = (*pan_moves(0, 200, 0), move_row(3, 1, 3600.0, 0, 50, "left", "up"), move_row(4, 1, 7200.0, 9, 50))
    new = redraws(moves, (1, 4), absolute=("tilt",))
    assert new.new_segment.tolist() == [True, True] and new.redraw.tolist() == [[True, True]] * 2
    assert new.new_zero.tolist() == [[True, True], [True, False]]
    assert new.homed.tolist() == [[False, False], [True, False]]
    since = (7200.0 - moves[1].time_s) / 3600.0
    np.testing.assert_allclose(new.hours[1], [1.0, since], rtol=1e-12)


def test_few_stops_are_counted_by_direction():
    """Pan: 12 stops left, the homing among them, and 11 right; the tilt axis never moved."""
    moves = pan_moves(*[0, 200] * 11, 0, 100)
    assert few_stops(moves, range(len(moves))) == {"right": 11}
    assert few_stops(moves, range(4)) == {"left": 3, "right": 1}
