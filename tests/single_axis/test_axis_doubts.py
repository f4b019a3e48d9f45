"""Doubts about an axis' data: counts in other steps, a stated ratio that is wrong, single outliers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.axes import drawn, random_moves, runs

from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.axis_doubts import axis_warnings, data_doubts
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_rows import rows_of

RATIO, PLAY, U = 0.0125, 0.085, 0.003


def logged(**stated: AxisPrior) -> AxisCampaign:
    """A log of three segments with play and homings, two readings at every stop."""
    rng = np.random.default_rng(5)
    moves, readings = [], []
    for segment in range(3):
        home = 0.004 * rng.standard_normal()
        for k, move in enumerate(runs(1)):
            moves.append(AxisMove(len(moves), segment, 60.0 * len(moves), move.command, "" if k else "backward"))
            step = 0.0 if not k else move.command - moves[-2].command
            stands = RATIO * move.command - 0.5 * PLAY * (np.sign(step) or -1) + home + 0.004 * rng.standard_normal()
            readings += [
                Reading(len(readings) + i, len(moves) - 1, float(stands + U * rng.standard_normal()), U)
                for i in range(2)
            ]
    return AxisCampaign("mm", tuple(moves), tuple(readings), stated)


def doubts(campaign: AxisCampaign) -> list[str]:
    return axis_warnings(campaign, rows_of(campaign))


def test_moves_beyond_the_stated_limits_are_doubted_unless_an_import_added_them():
    axis = replace(logged(), limits=(-2300.0, 2200.0))
    beyond = [m.move for m in axis.moves if m.command > 2200]
    (doubt,) = [doubt for doubt in doubts(axis) if "limits" in doubt]
    assert f"moves {beyond[0]}" in doubt
    added = tuple(replace(m, assumed=int(m.move in beyond)) for m in axis.moves)
    assert not [doubt for doubt in doubts(replace(axis, moves=added)) if "limits" in doubt]


@pytest.mark.parametrize("value", [16 * RATIO, -RATIO])
def test_a_wrong_stated_ratio_is_named(value):
    [doubt] = doubts(logged(per_command=AxisPrior(value, 0.001)))
    assert f"per_command = {value:g}" in doubt and "0.012499" in doubt and "campaign.toml" in doubt
    assert doubts(logged(per_command=AxisPrior(RATIO, 1e-5))) == []


@pytest.mark.parametrize("stated", [True, False], ids=["u stated", "u unknown"])
def test_outliers_are_named_and_their_neighbours_not(stated):
    whole = logged()
    readings = [r if stated else replace(r, u=0.0) for r in whole.readings]
    for at in (31, 60):
        readings[at] = replace(readings[at], value=readings[at].value + 1.5)
    remarks = doubts(replace(whole, readings=tuple(readings)))
    remarks = [text for text in remarks if "stated u" not in text]
    assert len(remarks) == 2
    for at, text in zip((31, 60), remarks, strict=True):
        move = whole.readings[at].move
        assert text.startswith(f"reading {at} (move {move}, command {whole.moves[move].command:g}) ")
        assert "readings.csv" in text and "1.5" in text and "status" in text


@pytest.mark.parametrize("seed", range(8))
def test_simulated_axes_raise_no_doubt(seed):
    moves = random_moves(seed, 40, 4) if seed % 2 else runs(2)
    axis = drawn(seed, moves, per_command=AxisPrior(0.01, 1e-6), backlash=AxisPrior(0.0, 1.0)).campaign
    assert data_doubts(axis, rows_of(axis)) == []


def test_a_command_with_a_digit_too_many_is_doubted():
    """Read or not; a homing far from the work is none, nor is a place that the axis returns to."""
    whole = logged()
    at = len(whole.moves) // 2 + 3
    far = 10 * max(m.command for m in whole.moves)
    typed = replace(whole, moves=tuple(replace(m, command=far) if m.move == at else m for m in whole.moves))
    [doubt] = [text for text in doubts(typed) if text.startswith("command of move")]
    assert f"move {at} is {far:g}" in doubt and "a digit too many?" in doubt
    first = replace(whole, moves=tuple(replace(m, command=far) if m.approach else m for m in whole.moves))
    parked = replace(whole, moves=tuple(replace(m, command=far) if m.move in (at, at + 4) else m for m in whole.moves))
    for sound in (whole, first, parked):
        assert not any(text.startswith("command of move") for text in doubts(sound))


def test_codes_of_a_thermometer_are_doubted():
    whole = logged()
    cold = replace(
        whole, moves=tuple(replace(m, temperature_degC=-127.0 if m.move == 4 else 21.0) for m in whole.moves)
    )
    assert [text for text in doubts(cold) if text.startswith("temperature_degC of moves 4 is -127")]
