"""Moves with readings as arrays: averages, sides, the play operator, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from support.axes import campaign, random_moves, runs

from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.single_axis import axis_rows
from tvsbayes.single_axis.axis_campaign import DEGREES, AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.axis_rows import play_places, reversal_of, rows_of


def line(commands, k=0.01):
    return [k * c + 0.3 for c in commands]


def test_play_is_the_clip_of_the_definition():
    """Y = clip(y, q - b/2, q + b/2), stop by stop; share and anchor give the same place."""
    moves = random_moves(3, 60)
    rows = rows_of(campaign(moves, line([m.command for m in moves])))
    for backlash in (0.0, 3.0, 9.0, 25.0):
        places = play_places(rows, np.array([backlash]))
        y, q = 0.0, 0.0
        for k, move in enumerate(moves):
            q = rows.line.slope * move.command
            if move.approach:
                y = q - 0.5 * backlash
            y = min(max(y, q - 0.5 * backlash), q + 0.5 * backlash)
            anchored = rows.line.slope * places.anchor[0, k] + 0.5 * backlash * places.side[0, k]
            # Sums of a few numbers of size 20.
            assert anchored == pytest.approx(y, abs=1e-12)
            assert q + 0.5 * backlash * places.share[0, k] == pytest.approx(y, abs=1e-12)


@pytest.mark.parametrize("k", [0.01, -4.0])
def test_play_of_many_backlashes_is_that_of_each_with_its_anchor(k):
    moves = random_moves(4, 40)
    rows = rows_of(campaign(moves, line([m.command for m in moves], k)))
    backlashes = np.array([0.0, 0.3, 12.0, 26.0]) * abs(k) * 100
    places = play_places(rows, backlashes)
    travelled = np.cumsum(np.abs(rows.legs.step))
    travelled -= np.where(np.arange(40) < 20, 0.0, travelled[20])
    for row, backlash in enumerate(backlashes):
        alone, last, y = play_places(rows, backlash[None]), 0, 0.0
        for name in ("anchor", "path", "side", "share", "spread"):
            np.testing.assert_array_equal(getattr(places, name)[row], getattr(alone, name)[0], err_msg=name)
        for at, move in enumerate(moves):
            stood, q = y, rows.line.slope * move.command
            sign = 0.5 * np.sign(k) * backlash
            y = q - sign if move.approach else min(max(y, q - 0.5 * backlash), q + 0.5 * backlash)
            last = at if move.approach or y != stood else last
            assert (alone.anchor[0, at], alone.path[0, at]) == (moves[last].command, travelled[last])


@pytest.mark.parametrize("unit", DEGREES)
def test_a_turn_is_recognised_in_every_unit_of_angles(unit):
    moves = tuple(AxisMove(k, 0, 0.0, 20.0 * k, "" if k else "forward") for k in range(30))
    values = [(m.command + 100) % 360 / DEGREES[unit] for m in moves]
    readings = tuple(Reading(k, k, value) for k, value in enumerate(values))
    with pytest.raises(InputError) as caught:
        rows_of(AxisCampaign(unit, moves, readings))
    assert caught.value.code == "wrapped" and unit in caught.value.remedy


@pytest.mark.parametrize(
    ("commands", "values", "code"),
    [
        ([5.0, 5.0, 5.0], [1.0, 1.1, 1.0], "too-few-positions"),
        ([5.0, 6.0], [1.0, 1.1], "too-few-positions"),
        ([0.0, 1.0, 2.0, 1.0], [3.0, 3.0, 3.0, 3.0], "no-motion"),
    ],
)
def test_nothing_to_estimate(commands, values, code):
    moves = [AxisMove(k, 0, 0.0, c, "" if k else "forward") for k, c in enumerate(commands)]
    with pytest.raises(NothingToEstimate) as caught:
        rows_of(campaign(moves, values))
    assert (caught.value.code, caught.value.file) == (code, "readings.csv") and caught.value.remedy
    assert "nothing to estimate" in caught.value.message


def test_as_many_moves_as_a_fit_takes(monkeypatch):
    """Three at least."""
    moves = [AxisMove(k, 0, 0.0, c, "" if k else "forward") for k, c in enumerate((0.0, 1.0, 0.0, 2.0))]
    assert len(rows_of(campaign(moves[:3], [0.0, 1.0, 0.0])).value) == 3
    monkeypatch.setattr(axis_rows, "ROWS_MAX", 3)
    assert len(rows_of(campaign(moves[:3], [0.0, 1.0, 0.0])).value) == 3
    with pytest.raises(InputError, match="readings of 4 moves; allowed: at most 3") as caught:
        rows_of(campaign(moves, [0.0, 1.0, 0.0, 2.0]))
    assert (caught.value.code, caught.value.file) == ("too-many", "readings.csv") and "thin" in caught.value.remedy


@pytest.mark.parametrize("k", [0.01, -4.0])
def test_the_reversal_is_that_of_least_squares(k):
    """Forward stops lag by half a reversal: by differences of the sides' means at the same commands."""
    moves = runs(3)[1:]
    command = np.array([m.command for m in moves])
    side = np.sign(np.diff(command, prepend=command[0] - 1))
    first = AxisMove(0, 0, 0.0, command[0], "forward")
    moves = (first, *(AxisMove(j, 0, 0.0, c) for j, c in enumerate(command[1:], 1)))
    noise = np.random.default_rng(1).normal(0.0, 0.02, len(command))
    value = k * command - 0.5 * np.sign(k) * 0.7 * side + 3.0 + noise
    rows = rows_of(campaign(moves, value))
    design = np.column_stack([np.ones(len(command)), command, -0.5 * np.sign(k) * side])
    solved, square, _, _ = np.linalg.lstsq(design, value, rcond=None)
    covariance = np.linalg.inv(design.T @ design) * square / (len(command) - 3)
    backlash, u = reversal_of(rows)
    assert backlash == pytest.approx(solved[2], rel=1e-9) and u == pytest.approx(np.sqrt(covariance[2, 2]), rel=1e-6)
    assert backlash == pytest.approx(0.7, abs=5 * u)


def test_repeats_at_one_stop_share_its_error():
    moves = [AxisMove(k, 0, 10.0 * k, c, "" if k else "forward") for k, c in enumerate((0.0, 0.0, 9.0, 9.0, 0.0))]
    values = [0.1, 0.1, 1.0, 1.0, 0.1]
    assert rows_of(campaign(moves, values, 0.01)).redrawn.tolist() == [True, False, True, False, True]
    # Without a known scatter of readings, the scatter of stops includes it.
    assert rows_of(campaign(moves, values)).redrawn.all()
