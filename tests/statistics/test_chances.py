"""Residuals one by one and shares of trials: what chance alone does."""

from __future__ import annotations

import numpy as np
import pytest

from tvsbayes.statistics.chances import recursive_residuals, share_error


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


def test_no_number_of_draws_makes_an_assurance_certain():
    """At 0 and 1 the standard deviation of Beta(1/2, n + 1/2); between them the binomial's."""
    from scipy import stats

    for draws in (20, 200):
        assert share_error(1.0, draws) == share_error(0.0, draws)
        assert share_error(0.0, draws) == pytest.approx(stats.beta(0.5, draws + 0.5).std(), rel=1e-12)
        assert share_error(0.8, draws) == pytest.approx(stats.binom(draws, 0.8).std() / draws, rel=1e-12)
