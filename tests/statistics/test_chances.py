"""Residuals one by one and shares of trials: what chance alone does."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special, stats

from tvsbayes.statistics.chances import (
    log_chance,
    one_way_chance,
    recursive_residuals,
    rms_bounds,
    share_error,
    share_interval95,
    student_log_density,
)


@pytest.mark.parametrize("backwards", [False, True])
def test_recursive_residuals_are_independent_and_standard(backwards):
    """Any common value, unlike variances: the n - 1 numbers have the unit matrix for covariance, by linear algebra."""
    variances = np.array([0.5, 2.0, 1.0, 4.0])
    rows = np.array([[w or 0.0 for w in recursive_residuals(e, variances, backwards=backwards)] for e in np.eye(4)]).T
    first = -1 if backwards else 0
    assert not rows[first].any()
    kept = np.delete(rows, first, axis=0)
    np.testing.assert_allclose(kept @ np.diag(variances) @ kept.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(kept.sum(axis=1), 0.0, atol=1e-12)
    assert recursive_residuals(np.ones(1), np.ones(1), backwards=backwards) == ()


def test_the_log_density_of_student_is_scipys():
    """Few, many and infinitely many degrees of freedom, near and far; gammaln(5e5) is 6e6, rounded at 1e-9."""
    errors, scale = np.array([0.0, 0.3, -40.0, 2.0, 7.0]), np.array([1.0, 0.1, 2.0, 3.0, 0.5])
    dof = np.array([1.0, 2.5, 30.0, 1e6, np.inf])
    expected = np.append(stats.t.logpdf(errors, dof, scale=scale)[:4], stats.norm.logpdf(7.0, scale=0.5))
    assert student_log_density(errors, dof, scale) == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_no_number_of_draws_makes_an_assurance_certain():
    """At 0 and 1 the standard deviation of Beta(1/2, n + 1/2); between them the binomial's."""
    for draws in (20, 200):
        assert share_error(1.0, draws) == share_error(0.0, draws)
        assert share_error(0.0, draws) == pytest.approx(stats.beta(0.5, draws + 0.5).std(), rel=1e-12)
        assert share_error(0.8, draws) == pytest.approx(stats.binom(draws, 0.8).std() / draws, rel=1e-12)


def test_distributions_are_those_of_scipy_stats():
    """Which takes half a second to load; 1e-12 relative is a few thousand roundings of its iterations.

    The log of a probability near 1 has that probability's rounding, 1e-16.
    """
    chi2, dof = np.meshgrid([0.1, 1.0, 10.0, 300.0], [1, 2, 5, 40])
    np.testing.assert_allclose(log_chance(chi2, dof), stats.chi2.logsf(chi2, dof), rtol=1e-12, atol=1e-15)
    for count in (1, 20, 1000):
        expected = np.sqrt(stats.chi2.ppf([0.5e-4, 1 - 0.5e-4], count) / count)
        np.testing.assert_allclose(rms_bounds(count), expected, rtol=1e-12)
    for hits, count in ((0, 10), (3, 10), (10, 10), (940, 1000)):
        interval = stats.binomtest(hits, count).proportion_ci(0.95, "exact")
        np.testing.assert_allclose(share_interval95(hits, count), interval, rtol=1e-12)


@pytest.mark.parametrize("dof", [2, 60, 180, 600, 6000])
def test_gross_defects_of_many_looks_are_improbable(dof):
    """Of an even number of degrees of freedom Q is a finite sum; three a look are soon hundreds."""
    chi2 = dof + np.array([3e3, 1e4, 1e5, 1e8])
    x, k = 0.5 * chi2[:, None], np.arange(dof // 2)
    expected = special.logsumexp(k * np.log(x) - special.gammaln(k + 1) - x, axis=1)
    np.testing.assert_allclose(log_chance(chi2, dof), expected, rtol=1e-12)


def test_one_way_chance_is_that_of_the_f_test():
    generator = np.random.default_rng(3)
    for shift in (0.0, 0.5, 5.0):
        groups = [generator.standard_normal(n) + shift * k for k, n in enumerate((2, 7, 30))]
        # 1e-10 relative: far out the probability is steep in F, whose sums differ by rounding.
        assert one_way_chance(groups) == pytest.approx(stats.f_oneway(*groups).pvalue, rel=1e-10)
