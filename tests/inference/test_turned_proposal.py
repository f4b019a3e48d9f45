"""A proposal of coupled coordinates: its density is that of its draws, and the coupling is fitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import stats
from support.small_posterior import SIGMAS
from support.tabulated import tabulated

from tvsbayes.inference.proposal import PAIR_T, Independence, regression

DIMENSION = 8
TABULATED = np.arange(1, DIMENSION, 3)


def straight() -> Independence:
    return tabulated(np.linspace(-1, 1, DIMENSION), np.linspace(0.5, 2.0, DIMENSION), TABULATED)


def products(size: float) -> np.ndarray:
    """Coefficients of products, symmetric."""
    lower = np.tril(np.random.default_rng(8).uniform(-size, size, (DIMENSION, DIMENSION)), -1)
    return lower + lower.T


def test_turning_keeps_means_and_leaves_tabulated_coordinates_without_products_as_they_are():
    before = straight()
    cross = products(0.4)
    cross[np.ix_(TABULATED, TABULATED)] = 0.0
    after = before.turned(cross)
    v = before.draw(4, np.random.RandomState(5))
    np.testing.assert_array_equal(after.to_w(v)[:, TABULATED], v[:, TABULATED])
    # 20 roundings of numbers below 10.
    np.testing.assert_allclose(after.to_w(after.mean), before.mean, atol=20 * 10 * np.finfo(float).eps)
    np.testing.assert_allclose(after.to_v(after.to_w(v)), v, atol=20 * 10 * np.finfo(float).eps)


def test_a_fit_learns_how_coordinates_lean_on_each_other():
    """A normal target with correlations up to 0.6: most draws count after one fit, few before."""
    generator = np.random.default_rng(9)
    directions = generator.normal(size=(3, DIMENSION))
    covariance = np.eye(DIMENSION) + 0.3 * directions.T @ directions
    covariance /= np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    target = stats.multivariate_normal(np.zeros(DIMENSION), covariance)
    assert np.abs(covariance - np.eye(DIMENSION)).max() > 0.5
    nothing = np.zeros(0, int)
    proposal = replace(tabulated(np.zeros(DIMENSION), np.ones(DIMENSION), nothing), coupled=nothing)

    def effective(some: Independence) -> float:
        w = some.draw(20_000, np.random.RandomState(11))
        weights = np.exp(target.logpdf(w) - some.log_density(w))
        return weights.sum() ** 2 / np.sum(weights**2) / len(w)

    first = effective(proposal)
    for seed in range(3):
        w = proposal.draw(4000, np.random.RandomState(seed))
        log_target = target.logpdf(w)
        proposal = proposal.fitted(w, log_target, log_target - proposal.log_density(w))
    # Sds 3 % too large and the heavy share of 5 % cost most of the rest.
    assert effective(proposal) > 0.8 > 2 * first


def test_only_products_that_tell_something_are_taken():
    generator = np.random.default_rng(12)
    x, dimension = generator.normal(size=(4000, 30)), 30
    log_ratio = 0.3 * x[:, 0] * x[:, 1] + 2.0 * x[:, 4] + 0.1 * x[:, 5] ** 2 + generator.normal(size=4000)
    slopes = regression(x, log_ratio)
    # The standard error of every coefficient is 1 / sqrt(4000).
    scatter = 1 / np.sqrt(4000)
    assert abs(slopes.cross[0, 1] - 0.3) < SIGMAS * scatter and slopes.cross[0, 1] == slopes.cross[1, 0]
    assert abs(slopes.slope[4] - 2.0) < SIGMAS * scatter and abs(slopes.square[5] - 0.1) < SIGMAS * scatter
    # Of the other 434 products 0.6 are expected beyond the limit by chance at each of at most four searches.
    taken = np.count_nonzero(np.triu(slopes.cross)) - 1
    chance = 2 * stats.norm.sf(PAIR_T) * dimension * (dimension - 1) / 2
    assert taken <= stats.poisson.ppf(1 - 1e-6, 4 * chance)
