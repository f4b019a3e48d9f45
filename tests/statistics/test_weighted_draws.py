"""Weighted draws: NumPy's answers for equal weights, exact moments of weighted ones, errors that are seen to hold."""

from __future__ import annotations

import numpy as np
import pytest

from tvsbayes.statistics.weighted_draws import systematic, weighted_quantiles, weighted_summary

ROUNDING = 1e-12
"""Of sums of a few thousand numbers of order one."""


def test_equal_weights_are_plain_draws():
    values = np.random.default_rng(1).standard_normal((501, 2, 3))
    found = weighted_summary(values, np.full(501, 1 / 501))
    np.testing.assert_allclose(found.mean, values.mean(axis=0), atol=ROUNDING)
    np.testing.assert_allclose(found.sd, values.std(axis=0), atol=ROUNDING)
    np.testing.assert_allclose(found.interval95, np.quantile(values, (0.025, 0.975), axis=0), atol=ROUNDING)
    np.testing.assert_allclose(found.ess_mean, 501.0, rtol=ROUNDING)


def test_a_draw_of_double_weight_is_two_draws():
    """Moments exactly; quantiles up to the spacing of draws, which the interpolation shares out differently."""
    rng = np.random.default_rng(2)
    values, twice = rng.standard_normal(2000), rng.uniform(size=2000) < 0.4
    weights = np.where(twice, 2.0, 1.0)
    found = weighted_summary(values, weights / weights.sum())
    repeated = np.repeat(values, weights.astype(int))
    assert found.mean == pytest.approx(repeated.mean(), abs=ROUNDING)
    assert found.sd == pytest.approx(repeated.std(), abs=ROUNDING)
    # Two thousand draws stand 0.01 sd apart at the 2.5 % quantile of a normal.
    expected = np.quantile(repeated, (0.1, 0.5, 0.9))
    found_quantiles = weighted_quantiles(values, weights / weights.sum(), (0.1, 0.5, 0.9))
    np.testing.assert_allclose(found_quantiles, expected, atol=0.01)


def test_the_stated_errors_are_the_scatter_of_repetitions():
    """Importance draws of N(0, 1) from N(0.3, 1.3^2), 200 times: each error within a factor of 1.25 of what is seen.

    The sd of 200 repetitions is known to 5 %, the errors themselves scatter by as much: five of their joint sds.
    """
    rng = np.random.default_rng(3)
    seen = []
    for _ in range(200):
        x = 0.3 + 1.3 * rng.standard_normal(2000)
        log_weights = -0.5 * x**2 + 0.5 * ((x - 0.3) / 1.3) ** 2
        weights = np.exp(log_weights - log_weights.max())
        seen.append(weighted_summary(x, weights / weights.sum()))
    for value, error in (("mean", "mcse_mean"), ("sd", "mcse_sd")):
        scatter = np.std([float(getattr(s, value)) for s in seen])
        stated = np.mean([float(getattr(s, error)) for s in seen])
        assert 1 / 1.25 < stated / scatter < 1.25
    scatter = np.std([s.interval95 for s in seen], axis=0)
    stated = np.mean([s.mcse_interval95 for s in seen], axis=0)
    assert np.all((stated / scatter > 1 / 1.25) & (stated / scatter < 1.25))


def test_a_weightless_draw_beyond_all_numbers_spoils_nothing():
    values = np.random.default_rng(4).standard_normal(300)
    weights = np.full(300, 1 / 300)
    expected = weighted_summary(values, weights)
    with_one = weighted_summary(np.append(values, 1e200), np.append(weights, 1e-60))
    for name in expected.__dataclass_fields__:
        assert np.array_equal(getattr(with_one, name), getattr(expected, name))


def test_systematic_draws_take_each_as_often_as_its_weight_says():
    weights = np.random.default_rng(5).exponential(size=400)
    weights /= weights.sum()
    counts = np.bincount(systematic(weights, 1000, 0.5), minlength=400)
    assert np.all(np.abs(counts - 1000 * weights) < 1.0)
    np.testing.assert_array_equal(systematic(np.full(10, 0.1), 5, 0.25), [0, 2, 4, 6, 8])
