"""Counters left out and foretold: with errors of gears that repeat, and without."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from support.coarse_planning import with_priors
from support.waits import check_forward, doings

from tvsbayes.comparison.held_positions import hold_out_positions
from tvsbayes.errors import NothingToEstimate
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.protocols import grid_protocol
from tvsbayes.twin.simulated_campaign import simulate

PAN, TILT = (0, 60, 120, 180, 240), (-60, 60)


@pytest.fixture(scope="module")
def worn(mounted_rig):
    """A campaign of gears with a transmission error of 0.15 deg, and the rig that expects such gears."""
    scales = {f"transmission_error_deg__{axis}": Prior(0.0, 0.15, "half-normal") for axis in ("pan", "tilt")}
    stops = {f"stop_sd_deg__{d}": Prior(0.02, 0.3, "log-normal") for d in ("left", "right", "up", "down")}
    rig = with_priors(mounted_rig, **scales, **stops)
    plan = grid_protocol(targets=("d1", "d2"), pan_steps=PAN, tilt_steps=TILT)
    return rig, simulate(rig, plan, seed=11).campaign


def test_counters_are_foretold_within_their_u_where_the_model_knows_that_gears_err(worn):
    """Five counters from two sides: rms of z below the 99.9 % quantile of ten; without the errors it is beyond."""
    rig, campaign = worn
    told = []
    found = hold_out_positions(fit(campaign), progress=told.append)
    check_forward(told)
    assert doings(told) == [f"pan {counter}" for counter in PAN]
    assert {(p.axis, p.position, p.direction) for p in found.positions} == {
        ("pan", counter, side) for counter in PAN for side in ("left", "right")
    }
    assert sum(p.n for p in found.positions) == len(ordered_spots(campaign))
    assert found.warnings == ("tilt is seen at 2 counters: with one left out no line is left",)
    limit = np.sqrt(stats.chi2.ppf(0.999, len(found.positions)) / len(found.positions))
    assert found.rms_z < limit
    document = json.loads(json.dumps(found.as_json(), allow_nan=False))
    assert document["hold_out"]["by"] == "positions" and document["unit"] == "deg"
    assert set(document["hold_out"]["positions"][0]) == {
        *("axis", "position", "direction", "n", "mean", "predicted", "u"),
    }
    perfect = {name: replace(p, u=0.0) for name, p in rig.table.priors.items() if name.startswith("transmission")}
    blind = replace(campaign, rig=replace(campaign.rig, priors={**campaign.rig.priors, **perfect}))
    assert hold_out_positions(fit(blind)).rms_z > found.rms_z


def test_two_counters_an_axis_are_refused(worn):
    rig, _ = worn
    few = simulate(rig, grid_protocol(targets=("d1", "d2"), pan_steps=(0, 200), tilt_steps=TILT), seed=2).campaign
    with pytest.raises(NothingToEstimate, match="three counters"):
        hold_out_positions(fit(few))
