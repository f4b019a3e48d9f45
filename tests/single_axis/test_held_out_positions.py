"""Hold-out of positions: predicted within their u on simulated axes, beside the classic line where errors repeat."""

from __future__ import annotations

import numpy as np
import pytest
from support.axes import PLACES, campaign, drawn, runs

from tvsbayes.errors import NothingToEstimate
from tvsbayes.single_axis import held_out_positions
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.held_out_positions import hold_out_positions

pytestmark = pytest.mark.thorough


def test_positions_are_predicted_and_independent_stops_underestimate_u():
    """Errors by position are ten times the scatter: independent stops understate u, processes do not."""
    stated = {
        "backlash": AxisPrior(0.0, 0.1),
        "stop_sd": AxisPrior(0.003, 0.0),
        "transmission_error": AxisPrior(0.05, 0.0),
        "transmission_error_length": AxisPrior(6.0, 0.0),
    }
    z, classic = [], []
    for seed in range(2):
        axis = drawn(seed, runs(3), **stated).campaign
        blind = campaign(axis.moves, [float(r.value or 0.0) for r in axis.readings], axis.readings[0].u)
        kept = [r for r in blind.readings if abs(blind.moves[r.move].command) <= 2000]
        hold_out = hold_out_positions(type(blind)("deg", blind.moves, tuple(kept)))
        assert {p.position for p in hold_out.positions} == set(PLACES)
        assert {p.direction for p in hold_out.positions} == {"forward", "backward"}
        assert all(p.n == 3 and p.u > 0 for p in hold_out.positions)
        z.append(hold_out.rms_z)
        classic.append(hold_out.classic_rms_z)
    # Of 28 means in correlated pairs.
    assert 0.4 < np.sqrt(np.mean(np.square(z))) < 1.5
    assert np.sqrt(np.mean(np.square(classic))) > 1.7


def test_two_positions_are_too_few():
    moves = runs(3, (0.0, 1000.0), 0.0)
    with pytest.raises(NothingToEstimate):
        hold_out_positions(campaign(moves, [0.01 * m.command for m in moves]))


def test_weighted_draws_of_one_fit_agree_with_fits_without_a_position(monkeypatch):
    axis = drawn(11, runs(3), backlash=AxisPrior(0.0, 0.1)).campaign
    refitted = hold_out_positions(axis).positions
    monkeypatch.setattr(held_out_positions, "REFITTED_MAX", 0)
    weighted = hold_out_positions(axis).positions
    for one, other in zip(refitted, weighted, strict=True):
        # A hundred effective draws where an end is weighted out: means to a tenth of u, four of them, u to a quarter.
        assert one.predicted == pytest.approx(other.predicted, abs=0.4 * one.u)
        assert one.u == pytest.approx(other.u, rel=0.25)


def test_many_positions_are_thinned_with_a_warning(monkeypatch):
    monkeypatch.setattr(held_out_positions, "POSITIONS_MAX", 4)
    hold_out = hold_out_positions(drawn(11, runs(2), backlash=AxisPrior(0.0, 0.1)).campaign)
    assert len({p.position for p in hold_out.positions}) == 4 and "evenly" in hold_out.warnings[0]
