"""Prediction of the readings of further moves, against simulated axes and with the posterior of the fit."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtri
from support.axes import drawn, runs
from support.compensated import driven, results, to_and_fro, true_axis

from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.predicted_stops import DRAWS, predicted_stops


def test_further_readings_agree_with_their_prediction():
    fit = results().fit
    commands, read = to_and_fro(np.linspace(-17.3, 17.3, 6))
    prediction = predicted_stops(fit, commands, read, np.full(len(read), 0.002))
    mean, covariance = prediction.pooled()
    squares = []
    for seed in range(20):
        value = np.array([r.value for r in driven(true_axis(), commands, read, seed).readings])
        off = value - mean
        squares.append(off @ np.linalg.solve(covariance, off) / len(off))
    # Twenty runs share the errors of one table: about 1, within a factor of two.
    assert 0.5 < np.mean(squares) < 2.0
    assert np.all(np.sqrt(np.diag(covariance)) < 0.04)


def test_draws_have_the_moments_of_the_mixture_and_its_density():
    fit = results().fit
    commands, read = to_and_fro(np.array([-5.0, 5.0]))
    prediction = predicted_stops(fit, commands, read, np.full(4, 0.002))
    mean, covariance = prediction.pooled()
    drawn = prediction.drawn(16000, np.random.default_rng(0))
    sd = np.sqrt(np.diag(covariance))
    # Means of 16000 to a few hundredths of their sd, standard deviations to a few per cent.
    np.testing.assert_allclose(drawn.mean(axis=0), mean, atol=0.04 * sd.min())
    np.testing.assert_allclose(drawn.std(axis=0), sd, rtol=0.05)
    assert prediction.log_density(mean) > prediction.log_density(mean + 3 * sd)
    flat = 1e4 * np.ones((4, 4))
    shifts = prediction.log_density(mean, flat) - prediction.log_density(mean + 1.0, flat)
    assert shifts == pytest.approx(0.0, abs=1e-3)


def test_the_scatter_of_homings_is_spread_evenly():
    """Its draws are those of the fit at even ranks; those of the prior where one homing was read."""
    known, once = results().fit, fit_axis(drawn(1, runs(2)).campaign, tier="importance")
    prior, at = once.model.priors["home_sd"], (np.arange(DRAWS) + 0.5) / DRAWS
    of_prior = prior.value * np.exp(prior.u * ndtri(at))
    of_fit = np.sort(known.draws["home_sd"])[(at * len(known.w)).astype(int)]
    commands, read = to_and_fro(np.array([-5.0, 5.0]))
    for fit, even in ((known, of_fit), (once, of_prior)):
        scales = predicted_stops(fit, commands, read, np.full(4, 0.002)).scales
        np.testing.assert_allclose(np.sort(scales["home_sd"]), even, rtol=1e-9)
