"""Moves with readings as arrays: averages, sides, the play operator, what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from support.axes import campaign, random_moves, runs

from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.instrument.column_names import DEGREES
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.axis_rows import play_places, rows_of
from tvsbayes.single_axis.classic_line import iso230_figures


def line(commands, k=0.01):
    return [k * c + 0.3 for c in commands]


def test_play_is_the_clip_of_the_definition():
    """Y = clip(y, q - b/2, q + b/2), stop by stop; share and anchor say the same place."""
    moves = random_moves(3, 60)
    rows = rows_of(campaign(moves, line([m.command for m in moves])))
    for backlash in (0.0, 3.0, 9.0, 25.0):
        found = play_places(rows, np.array([backlash]))
        y, q = 0.0, 0.0
        for k, move in enumerate(moves):
            q = rows.line[1] * move.command
            if move.approach:
                y = q - 0.5 * backlash
            y = min(max(y, q - 0.5 * backlash), q + 0.5 * backlash)
            anchored = rows.line[1] * found.anchor[0, k] + 0.5 * backlash * found.side[0, k]
            # Sums of a few numbers of size 20.
            assert anchored == pytest.approx(y, abs=1e-12)
            assert q + 0.5 * backlash * found.share[0, k] == pytest.approx(y, abs=1e-12)


def test_an_unknown_side_is_known_after_a_long_leg():
    moves = [AxisMove(k, 0, 0.0, c, "" if k else "unknown") for k, c in enumerate((0.0, 50.0, 1000.0, 0.0))]
    rows = rows_of(campaign(moves, line([m.command for m in moves])))
    found = play_places(rows, np.array([2.0]))
    np.testing.assert_allclose(found.spread[0], [1.0, 0.75, 0.0, 0.0], atol=1e-12)


def test_readings_of_a_move_are_averaged_by_their_u():
    moves = runs(1)
    values = line([m.command for m in moves])
    readings = [Reading(k, m.move, v, 0.2) for k, (m, v) in enumerate(zip(moves, values, strict=True))]
    readings += [Reading(100, 5, values[5] + 1.0, 0.1), Reading(101, 6, 99.0, 0.1, "lost")]
    rows = rows_of(AxisCampaign("deg", moves, tuple(readings)))
    assert rows.value[5] == pytest.approx(values[5] + 0.8)
    assert rows.variance[5] == pytest.approx(1 / (1 / 0.04 + 1 / 0.01))
    assert (rows.count[5], rows.count[6]) == (2, 1)


def test_angles_that_wrap_are_refused():
    moves = [AxisMove(k, 0, 0.0, 20.0 * k, "" if k else "forward") for k in range(30)]
    with pytest.raises(InputError) as caught:
        rows_of(campaign(moves, [(m.command + 100) % 360 for m in moves]))
    assert caught.value.code == "wrapped" and "unwrap" in caught.value.remedy
    assert len(rows_of(campaign(moves, [m.command + 100 for m in moves])).value) == 30


@pytest.mark.parametrize("unit", DEGREES)
def test_in_every_unit_of_angles_that_an_import_knows_a_turn_is_a_turn(unit):
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
    assert caught.value.code == code


def test_rows_left_out_keep_times_and_stops():
    moves = random_moves(5, 40)
    rows = rows_of(campaign(moves, line([m.command for m in moves]), 0.1))
    out = np.zeros(40, dtype=bool)
    out[[0, 7, 8, 20, 21]] = True
    kept = tuple(r for k, r in enumerate(campaign(moves, line([m.command for m in moves]), 0.1).readings) if not out[k])
    wanted = rows_of(AxisCampaign("deg", moves, kept))
    found = rows.without(out)
    for name in ("hours", "redrawn", "path", "side", "command", "value"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), atol=1e-12, err_msg=name)


def test_repeats_at_one_stop_share_its_error():
    moves = [AxisMove(k, 0, 10.0 * k, c, "" if k else "forward") for k, c in enumerate((0.0, 0.0, 9.0, 9.0, 0.0))]
    values = [0.1, 0.1, 1.0, 1.0, 0.1]
    assert rows_of(campaign(moves, values, 0.01)).redrawn.tolist() == [True, False, True, False, True]
    # Where nobody knows how well a reading is read, the scatter of stops covers it.
    assert rows_of(campaign(moves, values)).redrawn.all()


def test_figures_of_the_whole_axis_have_the_words_of_the_standard():
    """Keys of `fit.json`, in order; a reversal of 0.2 everywhere without scatter is one without spread."""
    moves = runs(3)
    side = [-1.0, *np.sign(np.diff([m.command for m in moves]))]
    values = [0.01 * m.command - 0.1 * s for m, s in zip(moves, side, strict=True)]
    found = iso230_figures(rows_of(campaign(moves, values)))
    assert list(found) == [
        *("reversal", "mean_reversal", "repeatability_forward", "repeatability_backward", "repeatability"),
        *("systematic_forward", "systematic_backward", "systematic", "mean_systematic"),
        *("accuracy_forward", "accuracy_backward", "accuracy"),
    ]
    # Rounding of positions of 20.
    assert found["reversal"] == pytest.approx(0.2, abs=1e-9) and found["repeatability_forward"] < 1e-9
