"""Sampling of an axis: the quantities integrated out agree with the dense solution; a bad start reaches the mode."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.axes import campaign, drawn, random_moves

from tvsbayes.single_axis.axis_campaign import AxisMove
from tvsbayes.single_axis.axis_density import AxisDensity, find_mode, headline_functionals
from tvsbayes.single_axis.axis_fit import fit_axis, model_of

RATIO, WILD = 2.5, 400.0


def belt():
    """Eleven counts of an encoder on a belt, a reading every 500; one of them belongs to no stop."""
    commands = [0, 200, 400, 600, 1000, 800, 600, 400, 200, 0, 300]
    moves = [AxisMove(k, 0, float(k), float(c), "" if k else "unknown") for k, c in enumerate(commands)]
    values = np.round(RATIO * np.array(commands) + np.random.default_rng(3).standard_normal(len(commands)))
    values[5:10] += 6.0
    values[7] += WILD
    return replace(campaign(moves, values), unit="mm")


def test_one_outlier_does_not_lose_the_mode():
    """A search started at the scatter of repeats ends at a log density lower by hundreds.

    The interval is narrower than the slope that the reading could cause, its distance over the travel.
    """
    mode = find_mode(model_of(belt()))
    assert mode.missing == () and mode.log_density > -100
    fit = fit_axis(belt(), tier="importance")
    low, high = np.quantile(fit.draws["per_command"], [0.025, 0.975])
    assert not fit.missing and low < RATIO < high
    assert high - low < WILD / 1000


def test_draws_of_the_line_have_its_moments_given_the_scales():
    """Solved without the places that no row informs it is the same; points outside the bounds have no density."""
    model = model_of(drawn(5, random_moves(5)).campaign)
    w = np.random.default_rng(2).standard_normal((6, len(model.coordinates.names)))
    functionals = headline_functionals(model, w)
    linear = model.linear(w)
    mean, sd = linear.mean_of(functionals), linear.sd_of(functionals)
    posterior = model.posterior(w, functionals)
    # Other right-hand sides in the same solution change the order of sums.
    np.testing.assert_allclose(posterior.log_density, model.log_density(w), atol=1e-8)
    # Of numbers of some 1e3 the differences of the two ways round in the seventh digit of an sd.
    np.testing.assert_allclose(posterior.linear.mean, mean, atol=1e-6 * float(sd.max()))
    np.testing.assert_allclose(np.sqrt(np.diagonal(posterior.linear.covariance, axis1=1, axis2=2)), sd, rtol=1e-6)
    far = AxisDensity(model, find_mode(model)).valued(np.full_like(w, 20.0), np.random.default_rng(1))
    assert np.all(far.log_target == -np.inf) and np.isfinite(far.parts["linear"]).all()


@pytest.mark.thorough
def test_a_short_time_gives_weighted_draws_and_says_so():
    """A chain without time gives no answer; the weighted draws before it do, rough after a single round."""
    axis = drawn(1).campaign
    fit = fit_axis(axis, max_minutes=1e-9)
    assert fit.error is None and fit.tier == "importance" and fit.answer in ("accepted", "rough")
    assert set(fit.sample.convergence.monte_carlo_error) >= {"backlash", "per_command.forward"}
