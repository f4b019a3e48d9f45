"""Counters left out and predicted: with errors of gears that repeat, and without."""

from __future__ import annotations

import json
from dataclasses import replace

import equinox as eqx
import numpy as np
import pytest
from scipy import stats
from support.coarse_planning import with_priors
from support.waits import check_forward, doings

from tvsbayes.comparison.held_positions import LeftOut, hold_out_positions, predicted_positions
from tvsbayes.errors import NothingToEstimate
from tvsbayes.estimators.annealed_stage import linearised_at
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.instrument.parameters import Prior, names_of
from tvsbayes.instrument.protocols import grid_protocol
from tvsbayes.instrument.stops import rests_of
from tvsbayes.results.comparison_record import hold_out_document
from tvsbayes.twin.simulated_campaign import simulate

PAN, TILT = (0, 80, 160, 240), (-60, 60)


AXES = ("pan", "tilt")


@pytest.fixture(scope="module")
def worn(mounted_rig):
    """A campaign of gears with a transmission error of 0.15 deg over 4 deg, and the rig that expects such gears."""
    scales = {f"transmission_error_deg__{axis}": Prior(0.0, 0.15, "half-normal") for axis in AXES}
    stops = {f"stop_sd_deg__{d}": Prior(0.02, 0.3, "log-normal") for d in DIRECTIONS}
    rig = with_priors(mounted_rig, **scales, **stops)
    true = {f"transmission_error_deg.{axis}": Prior(0.15, 0.0, "half-normal") for axis in AXES}
    true |= {f"transmission_error_length_deg.{axis}": Prior(4.0, 0.0, "log-normal") for axis in AXES}
    plan = grid_protocol(targets=("d1", "d2"), pan_steps=PAN, tilt_steps=TILT)
    return rig, simulate(replace(rig, truth={**rig.truth, **true}), plan, seed=11).campaign


@pytest.fixture(scope="module")
def whole(worn):
    """Its fit."""
    return fit(worn[1])


@pytest.fixture
def unfitted(monkeypatch):
    """The linear model about the mode of all looks leaves out as much, at the noise scales that all looks taught."""
    monkeypatch.setattr("tvsbayes.comparison.held_positions.refit", lambda fit_of_all, *_: fit_of_all)


@pytest.mark.thorough
@pytest.mark.usefixtures("unfitted")
def test_counters_are_predicted_within_their_u_where_the_model_knows_that_gears_err(worn, whole):
    """Four counters, two sides of which say the same: rms of z below the 99.9 % quantile of four; else beyond it."""
    rig, campaign = worn
    waits = []
    held = hold_out_positions(whole, progress=waits.append)
    check_forward(waits)
    assert doings(waits) == [f"pan {counter}" for counter in PAN]
    assert {(p.axis, p.position, p.direction) for p in held.positions} == {
        ("pan", counter, side) for counter in PAN for side in ("left", "right")
    }
    assert sum(p.n for p in held.positions) == len(ordered_spots(campaign))
    assert held.warnings == ("tilt is seen at 2 counters: with one left out no line is determined",)
    limit = np.sqrt(stats.chi2.ppf(0.999, len(PAN)) / len(PAN))
    assert held.rms_z < limit
    document = json.loads(json.dumps(hold_out_document(held, "deg"), allow_nan=False))
    assert document["hold_out"]["by"] == "positions" and document["unit"] == "deg"
    assert set(document["hold_out"]["positions"][0]) == {
        *("axis", "position", "direction", "n", "mean", "predicted", "u"),
    }
    names = names_of("transmission_error_deg", "play_variation_deg", "stop_sd_deg")
    perfect = {name: replace(rig.table.priors[name], u=0.0) for name in names}
    blind = replace(campaign, rig=replace(campaign.rig, priors={**campaign.rig.priors, **perfect}))
    assert hold_out_positions(fit(blind)).rms_z > 1.5 * limit


def test_looks_left_out_teach_nothing_of_themselves(worn, whole):
    """One counter's looks moved by a degree move what is seen of it by as much, and what is predicted by nothing."""
    campaign = worn[1]
    spots = ordered_spots(campaign)
    rests = rests_of(campaign.moves, "pan")
    out = np.array([rests[spot.move].steps == PAN[2] for spot in spots])
    sign = np.array([rests[spot.move].sign for spot in spots])
    left_out = LeftOut("pan", PAN[2], out, sign)
    plain = predicted_positions(whole, whole, left_out)
    slope = np.asarray(whole.linearised.slope)[..., 0]
    moved = eqx.tree_at(
        lambda lin: lin.residual,
        linearised_at(whole.z, whole.space, whole.arrays),
        np.asarray(whole.linearised.residual) + np.where(out[:, None], slope * np.radians(1.0), 0.0),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tvsbayes.comparison.held_positions.linearised_at", lambda *_: moved)
        other = predicted_positions(whole, whole, left_out)
    for before, after in zip(plain, other, strict=True):
        assert after.mean - before.mean == pytest.approx(1.0, rel=1e-6)
        assert after.predicted == pytest.approx(before.predicted, abs=1e-6) and after.u == pytest.approx(before.u)


def test_axes_seen_at_few_counters_are_refused(whole, monkeypatch):
    monkeypatch.setattr("tvsbayes.comparison.held_positions.POSITIONS_MIN", 6)
    with pytest.raises(NothingToEstimate, match="three counters"):
        hold_out_positions(whole)
