"""Moves with readings as arrays: averages, sides, the play operator, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from support.axes import campaign, random_moves, runs

from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.single_axis import axis_rows
from tvsbayes.single_axis.axis_campaign import DEGREES, AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.axis_rows import legs_are_long, play_places, reversal_of, rows_of, turn_jumps


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


def test_long_legs_have_one_place_whatever_the_play_and_a_negative_play_none():
    moves = runs(1)
    rows = rows_of(campaign(moves, line([m.command for m in moves])))
    assert play_places(rows, np.array([0.5, 1.0, 2.0])).anchor.shape == (1, len(moves))
    short = [AxisMove(k, 0, 0.0, c, "" if k else "forward") for k, c in enumerate((0.0, 1.0, 2.0, 1.0, 0.0))]
    places = play_places(rows_of(campaign(short, line([m.command for m in short]))), np.array([-3.0]))
    assert places.anchor[0].tolist() == [m.command for m in short] and not places.spread.any()
    assert places.share[0].tolist() == [-1.0, -1.0, -1.0, 1.0, 1.0]


def test_an_unknown_side_is_known_after_a_long_leg():
    moves = [AxisMove(k, 0, 0.0, c, "" if k else "unknown") for k, c in enumerate((0.0, 50.0, 1000.0, 0.0))]
    rows = rows_of(campaign(moves, line([m.command for m in moves])))
    places = play_places(rows, np.array([2.0]))
    np.testing.assert_allclose(places.spread[0], [1.0, 0.75, 0.0, 0.0], atol=1e-12)
    # Also for plays that every known leg would clear.
    np.testing.assert_allclose(play_places(rows, np.array([0.1, 0.2])).spread[:, 0], [0.05, 0.1], atol=1e-12)


def test_readings_of_a_move_are_averaged_by_their_u():
    moves = runs(1)
    values = line([m.command for m in moves])
    readings = [Reading(k, m.move, v, 0.2) for k, (m, v) in enumerate(zip(moves, values, strict=True))]
    readings += [Reading(100, 5, values[5] + 1.0, 0.1), Reading(101, 6, 99.0, 0.1, "lost")]
    rows = rows_of(AxisCampaign("deg", moves, tuple(readings)))
    assert rows.value[5] == pytest.approx(values[5] + 0.8)
    assert rows.variance[5] == pytest.approx(1 / (1 / 0.04 + 1 / 0.01))
    assert (rows.count[5], rows.count[6]) == (2, 1)


def test_repeated_readings_at_a_stop_estimate_their_scatter():
    """Squares 0.02 and 0.08 with 1 + 2 degrees of freedom, pooled; a row of n readings has an n-th of it."""
    moves = runs(1)
    values = line([m.command for m in moves])
    readings = [Reading(k, m.move, v) for k, (m, v) in enumerate(zip(moves, values, strict=True)) if k not in (2, 4)]
    offsets = [(2, 0.1), (2, -0.1), (4, 0.2), (4, 0.0), (4, -0.2)]
    readings += [Reading(100 + k, move, values[move] + off) for k, (move, off) in enumerate(offsets)]
    rows = rows_of(AxisCampaign("deg", moves, tuple(readings)))
    pooled = 0.1 / 3
    np.testing.assert_allclose(rows.variance[[0, 2, 4]], [pooled, pooled / 2, pooled / 3], rtol=1e-9)
    np.testing.assert_allclose(rows.within[[0, 2, 4]], [0.0, 0.02 / pooled, 0.08 / pooled], atol=1e-9)


def test_jumps_by_turns_are_counted_where_they_are_rare():
    command = np.arange(5.0)
    once = 200 * command - np.where(command > 2, 360.0, 0.0)
    assert turn_jumps(command, once, 360.0) == {3: pytest.approx(-1.0)}
    assert turn_jumps(command[1:], once[1:], 360.0) == {2: pytest.approx(-1.0)}, "three steps are enough"
    assert turn_jumps(command[2:], once[2:], 360.0) == {}, "two are not"
    there_and_back = 200 * command - np.where((command > 1) & (command < 4), 360.0, 0.0)
    assert turn_jumps(command, there_and_back, 360.0) == {}, "half of the steps"


def test_angles_that_wrap_are_refused():
    moves = [AxisMove(k, 0, 0.0, 20.0 * k, "" if k else "forward") for k in range(30)]
    with pytest.raises(InputError) as caught:
        rows_of(campaign(moves, [(m.command + 100) % 360 for m in moves]))
    assert caught.value.code == "wrapped" and "unwrap" in caught.value.remedy
    assert (caught.value.file, caught.value.column) == ("readings.csv", "value")
    # 100 deg and thirteen times 20 are the first turn.
    assert "jumps by whole turns at move 13" in caught.value.message
    assert len(rows_of(campaign(moves, [m.command + 100 for m in moves])).value) == 30


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


def test_without_two_sides_there_is_no_reversal_and_every_leg_is_long():
    moves = [AxisMove(k, 0, 0.0, c, "" if k else "forward") for k, c in enumerate((0.0, 1.0, 2.0, 4.0))]
    rows = rows_of(campaign(moves, [0.0, 1.1, 1.9, 4.0]))
    assert reversal_of(rows) == (0.0, np.inf) and legs_are_long(rows)
    with_unknown = [AxisMove(0, 0, 0.0, 0.0, "unknown"), *moves[1:]]
    assert legs_are_long(rows_of(campaign(with_unknown, [0.0, 1.1, 1.9, 4.0])))


@pytest.mark.parametrize(("shortest", "noise", "long"), [(2.5, 0.0, True), (1.5, 0.0, False), (2.5, 0.1, False)])
def test_legs_are_long_by_the_reversal_and_its_uncertainty(shortest, noise, long):
    """A long leg exceeds twice the reversal of 1 plus ten of its standard errors."""
    commands = [0.0, *([20.0, 20.0 - shortest, 0.0] * 6)]
    side = np.sign(np.diff(commands, prepend=-1))
    moves = [AxisMove(k, 0, 0.0, c, "" if k else "forward") for k, c in enumerate(commands)]
    value = 0.5 * np.array(commands) - 0.25 * side + noise * (-1.0) ** np.arange(len(commands))
    assert legs_are_long(rows_of(campaign(moves, value))) == long


def test_rows_left_out_keep_times_and_stops():
    moves = random_moves(5, 40)
    rows = rows_of(campaign(moves, line([m.command for m in moves]), 0.1))
    out = np.zeros(40, dtype=bool)
    out[[0, 7, 8, 20, 21]] = True
    kept = tuple(r for k, r in enumerate(campaign(moves, line([m.command for m in moves]), 0.1).readings) if not out[k])
    wanted = rows_of(AxisCampaign("deg", moves, kept))
    remaining = rows.without(out)
    for name in ("hours", "redrawn", "path", "side", "command", "value"):
        np.testing.assert_allclose(getattr(remaining, name), getattr(wanted, name), atol=1e-12, err_msg=name)


def test_repeats_at_one_stop_share_its_error():
    moves = [AxisMove(k, 0, 10.0 * k, c, "" if k else "forward") for k, c in enumerate((0.0, 0.0, 9.0, 9.0, 0.0))]
    values = [0.1, 0.1, 1.0, 1.0, 0.1]
    assert rows_of(campaign(moves, values, 0.01)).redrawn.tolist() == [True, False, True, False, True]
    # Without a known scatter of readings, the scatter of stops includes it.
    assert rows_of(campaign(moves, values)).redrawn.all()
