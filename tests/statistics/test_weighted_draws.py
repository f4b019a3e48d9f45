"""Weighted draws: equal weights are NumPy's, Pareto tails ArviZ's, errors those of runs repeated."""

from __future__ import annotations

import numpy as np
import pytest
from arviz_stats.base import array_stats
from scipy import stats

from tvsbayes.statistics.weighted_draws import (
    TAILS,
    ParetoTail,
    WeightedSummary,
    effective_draws,
    pareto_k,
    smoothed_weights,
    systematic,
    weighted_quantiles,
    weighted_summary,
)

ROUNDING = 2.0**-52
SIGMAS = 5.0


@pytest.mark.parametrize("count", [2, 7, 1000])
def test_equal_weights_are_none(count):
    values = np.random.default_rng(1).normal(3.0, 2.0, (count, 4))
    weights = np.full(count, 1 / count)
    summary = weighted_summary(values, weights)
    # Sums of n terms of order 10 in another order; a quantile divides by the spacing 1 / n.
    allowed = 10 * count * ROUNDING
    np.testing.assert_allclose(summary.mean, values.mean(axis=0), rtol=0, atol=allowed)
    np.testing.assert_allclose(summary.sd, values.std(axis=0), rtol=0, atol=allowed)
    probabilities = (0.0, 0.025, 0.5, 0.975, 1.0)
    expected = np.quantile(values, probabilities, axis=0)
    np.testing.assert_allclose(
        weighted_quantiles(values, weights, probabilities), expected, rtol=0, atol=count * allowed
    )
    np.testing.assert_allclose(summary.ess_mean, count, rtol=allowed)
    np.testing.assert_allclose(summary.mcse_mean, values.std(axis=0) / np.sqrt(count), rtol=allowed)


def test_quantiles_by_hand():
    """Half weights reach 0.25, 0.65 and 0.9 at the draws 1, 2 and 3: stretched to 0, 8/13 and 1."""
    quantiles = weighted_quantiles(np.array([3.0, 1.0, 2.0]), np.array([0.2, 0.5, 0.3]), (0.0, 0.5, 1.0))
    np.testing.assert_allclose(quantiles, [1.0, 1 + 0.5 * 13 / 8, 3.0], rtol=4 * ROUNDING)


def test_ends_of_intervals_have_the_effective_draws_of_their_probability():
    """Of 2000 equal draws all count; 51 of them, not 50, lie below an end at most: 2 % of t (1 - t)."""
    summary = weighted_summary(np.random.default_rng(8).standard_normal(2000), np.full(2000, 1 / 2000))
    np.testing.assert_allclose(summary.ess_interval95, 2000, rtol=0.02)


def test_a_quantity_that_moves_says_nothing_of_one_that_does_not():
    """Both keep their shape, and what is ten times as wide has ten times the errors."""
    generator = np.random.default_rng(9)
    weights, moving = generator.dirichlet(np.ones(300)), generator.standard_normal((300, 1, 2))
    summary = weighted_summary(np.concatenate([moving, 10 * moving, np.full((300, 1, 2), 3.0)], axis=1), weights)
    for name in ("mean", "sd", "mcse_mean", "mcse_sd", "ess_mean", "ess_sd"):
        value = getattr(summary, name)
        assert value.shape == (3, 2), name
        if name.startswith("ess"):
            np.testing.assert_allclose(value[2], effective_draws(weights), rtol=1e-12)
        else:
            np.testing.assert_allclose(value[1], 10 * value[0], rtol=1e-12, err_msg=name)
    assert np.all(summary.mcse_mean[2] == 0) and np.all(summary.mcse_sd[2] == 0)


def test_one_draw_of_all_weight_is_every_quantile():
    """The others' densities may lie beyond the smallest number."""
    weights = smoothed_weights(np.where(np.arange(1000) == 3, 0.0, -800.0)).weights
    summary = weighted_summary(np.arange(1000.0), weights)
    assert summary.mean == 3.0 and summary.interval95.tolist() == [3.0, 3.0] and summary.ess_least == 1.0


def reweighted(generator: np.random.Generator) -> WeightedSummary:
    """N(0.3, 1) by 3000 draws of N(0, 1.2^2)."""
    x = 1.2 * generator.standard_normal(3000)
    return weighted_summary(x, smoothed_weights(-0.5 * (x - 0.3) ** 2 + 0.5 * (x / 1.2) ** 2).weights)


def test_errors_are_the_scatter_of_runs_repeated():
    generator = np.random.default_rng(3)
    runs = [reweighted(generator) for _ in range(300)]
    exact = {"mean": 0.3, "sd": 1.0, "interval95": 0.3 + stats.norm.ppf(TAILS)}
    for name, truth in exact.items():
        values = np.array([getattr(run, name) for run in runs])
        errors = np.array([getattr(run, f"mcse_{name}") for run in runs])
        scatter = values.std(axis=0)
        # 300 runs determine a scatter to 4 %, 5 sds of which are 20 %; an end's error is itself known to some 10 %.
        np.testing.assert_allclose(errors.mean(axis=0), scatter, rtol=0.25, err_msg=name)
        np.testing.assert_array_less(np.abs(values.mean(axis=0) - truth), SIGMAS * scatter / np.sqrt(300), name)
        if name != "interval95":
            ess = np.mean([getattr(run, f"ess_{name}") for run in runs])
            alone = 1.0 if name == "mean" else 0.5
            assert ess == pytest.approx(alone / np.mean(scatter) ** 2, rel=0.25), name


@pytest.mark.parametrize(("count", "sd"), [(60, 1.0), (500, 0.3), (4000, 1.5), (4000, 3.0)])
def test_pareto_smoothing_is_that_of_arviz(count, sd):
    log_ratios = sd * np.random.default_rng(5).standard_normal(count)
    # ArviZ takes the negative of the log weights, as `loo` hands them over.
    log_weights, k = array_stats.psislw(-log_ratios)
    smoothed = smoothed_weights(log_ratios)
    assert smoothed.pareto_k == pytest.approx(float(k), abs=1e-9)
    np.testing.assert_allclose(smoothed.weights, np.exp(log_weights), rtol=1e-9)
    expected = array_stats.pareto_khat(np.exp(log_ratios)[None], r_eff=1, tail="right")
    assert pareto_k(np.exp(log_ratios)) == pytest.approx(float(expected), abs=1e-9)


@pytest.mark.parametrize("k", [-0.3, 0.0, 0.4])
def test_quantiles_of_a_tail_are_the_generalised_paretos(k):
    probabilities = np.linspace(0.05, 0.95, 7)
    # SciPy's shape has the same sign: positive is heavy.
    expected = stats.genpareto.ppf(probabilities, k, scale=2.0)
    np.testing.assert_allclose(ParetoTail(k, 2.0).quantiles(probabilities), expected, rtol=1e-12)


def test_a_tail_is_fitted_where_its_first_quarter_exceeds_the_rest():
    """Of 100 draws 20 are the tail, and its fifth decides: 85 equal draws leave it nothing, 84 something."""
    larger = 1 + np.random.default_rng(10).pareto(2.0, 16)
    for equal, fitted in ((85, False), (84, True)):
        values = np.append(np.ones(equal), larger[: 100 - equal])
        assert (pareto_k(values) != 0, smoothed_weights(np.log(values)).pareto_k != 0) == (fitted, fitted)


def test_a_constant_factor_of_the_weights_changes_nothing():
    """Also one beyond the largest number."""
    log_ratios = np.random.default_rng(11).standard_normal(500)
    smoothed, moved = smoothed_weights(log_ratios), smoothed_weights(log_ratios + 800.0)
    np.testing.assert_allclose(moved.weights, smoothed.weights, rtol=1e-11)


def test_weights_without_a_tail_are_left_alone():
    smoothed = smoothed_weights(np.append(np.zeros(99), -np.inf))
    np.testing.assert_allclose(smoothed.weights, np.append(np.full(99, 1 / 99), 0.0), rtol=1e-12)
    assert smoothed.pareto_k == 0 and pareto_k(np.ones(99)) == 0


def test_systematic_resampling_takes_every_draw_by_its_weight():
    """At most one draw off n w, whatever the offset; on average exactly n w; of equal weights evenly spaced draws."""
    weights = np.random.default_rng(7).dirichlet(np.full(40, 0.5))
    offsets = (np.arange(500) + 0.5) / 500
    counts = np.stack([np.bincount(systematic(weights, 200, offset), minlength=40) for offset in offsets])
    assert np.abs(counts - 200 * weights).max() < 1 + 1e-9
    # An average over 500 even offsets counts every share to 1 / 500.
    np.testing.assert_allclose(counts.mean(axis=0), 200 * weights, atol=0.0021)
    np.testing.assert_array_equal(systematic(np.full(12, 1 / 12), 4, 0.5), [1, 4, 7, 10])
    np.testing.assert_array_equal(systematic(np.full(12, 1 / 12), 12, 0.3), np.arange(12))
    # A place at the border of two draws is the second's; one that rounds to the sum of all is the last's.
    np.testing.assert_array_equal(systematic(np.array([0.5, 0.5]), 2, 0.0), [0, 1])
    np.testing.assert_array_equal(systematic(np.array([0.5, 0.5]), 3, np.nextafter(1.0, 0.0)), [0, 1, 1])
