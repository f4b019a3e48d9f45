"""A posterior of gears that repeat errors, sampled by both methods (minutes)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.small_posterior import SIGMAS
from support.varying_gears import varying_gears

from tvsbayes.estimators.joint_fit import fit
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.posterior.draws import headline_names
from tvsbayes.posterior.sampling import sample
from tvsbayes.posterior.target import importance_run
from tvsbayes.twin.simulated_campaign import simulate

TRUE = {
    **{"transmission_error_deg.pan": 0.05, "transmission_error_deg.tilt": 0.03},
    **{"play_variation_deg.pan": 0.03, "play_variation_deg.tilt": 0.02},
    **{"drift_deg_per_root_hour.pan": 0.02, "drift_deg_per_root_hour.tilt": 0.02},
}


@pytest.fixture(scope="module")
def gear_fit(mounted_rig):
    """64 spots seen by cameras that are known exactly."""
    truth = {**mounted_rig.truth, **{name: Prior(value, 0.0, "half-normal") for name, value in TRUE.items()}}
    truth |= {f"transmission_error_length_deg.{axis}": Prior(8.0, 0.0, "log-normal") for axis in ("pan", "tilt")}
    stereo = replace(mounted_rig.stereo, parameter_covariance=np.zeros((24, 24)))
    table = varying_gears(mounted_rig.table, periods=False)
    rig = replace(mounted_rig, table=table, truth=truth, stereo=stereo)
    simulated = simulate(rig, four_point_protocol(repeats=4, steps=(100, 200)), seed=21)
    fitted = fit(simulated.campaign)
    assert fitted.converged, fitted.problems
    return simulated, fitted


@pytest.mark.slow
def test_the_line_through_the_looks_is_found_and_the_local_slope_knows_less(gear_fit):
    simulated, fitted = gear_fit
    true = np.array(list(simulated.truth.effective_deg_per_step(simulated.campaign).values()))
    sd = fitted.draws.effective_deg_per_step.std(axis=0)
    assert np.all(np.abs(fitted.mode.effective_deg_per_step - true) < 5 * sd)
    # The gear's mean ratio is known by no more than the error's place-to-place change allows.
    assert np.all(fitted.draws.local_deg_per_step.std(axis=0) > 1.05 * sd)
    places = fitted.arrays.gears.filled
    assert fitted.draws_places.shape == (len(fitted.draws_z), 2 * places)
    assert fitted.draws.place_errors_rad.shape == fitted.draws_places.shape


@pytest.mark.slow
def test_both_samplers_say_the_same(gear_fit):
    """Both are accepted, and agree within their Monte Carlo errors."""
    fitted = gear_fit[1]
    chain, run = sample(fitted, "emcee", seed=5, max_minutes=20.0), importance_run(fitted, 5)
    weighted = run.density.posterior(run.sample, run.seed)
    assert chain.convergence.stuck_walkers == ()
    assert chain.convergence.answer == weighted.convergence.answer == "accepted", weighted.convergence.importance
    for name in headline_names(fitted):
        one, other = (posterior.propagate(lambda p, name=name: p[name]) for posterior in (chain, weighted))
        mean_error, sd_error = (np.hypot(getattr(one, e), getattr(other, e)) for e in ("mcse_mean", "mcse_sd"))
        # Of some fifteen headlines none lies five of its errors out; these are below a tenth of an sd.
        assert mean_error < 0.1 * other.sd, name
        assert abs(one.mean - other.mean) < SIGMAS * mean_error, name
        assert abs(one.sd - other.sd) < SIGMAS * sd_error, name
