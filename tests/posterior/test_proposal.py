"""The target's Jacobian, and the proposal: its density is that of its draws, and it comes nearer to a target."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from support.small_posterior import SIGMAS
from support.tabulated import tabulated
from support.two_parameters import AT_MODE, BACKLASH, RATIO, STRETCH, fit, route

from tvsbayes.posterior.target import Target


def test_the_density_of_walkers_is_the_models_times_the_jacobian(x64, monkeypatch):
    def evaluate(z, normal, space, arrays):
        value = AT_MODE - 0.5 * (z[:, RATIO] ** 2 + z[:, BACKLASH] ** 2)
        return SimpleNamespace(log_density=value, place_errors_rad=normal)

    monkeypatch.setattr("tvsbayes.posterior.target.evaluate", evaluate)
    w = np.random.default_rng(4).standard_normal((50, 2))
    value = Target(fit(), route())(w)
    log_factor = STRETCH * w[:, 0]
    y = w[:, 1] * np.exp(log_factor)
    np.testing.assert_allclose(value, -0.5 * (y**2 + w[:, 0] ** 2) + log_factor, rtol=1e-12, atol=1e-12)
    # As a density of w it has the mass of the density of z: 2 pi, on a grid that reaches 6 sds of the first.
    one, two = np.meshgrid(np.linspace(-6, 6, 25), np.linspace(-40, 40, 161), indexing="ij")
    value = Target(fit(), route())(np.column_stack([one.ravel(), two.ravel()]))
    assert np.exp(value).sum() * 0.5 * 0.5 == pytest.approx(2 * np.pi, rel=1e-3)


@pytest.mark.parametrize("heavy", [False, True])
def test_the_proposal_density_is_normalised_and_has_the_moments_of_its_draws(heavy):
    proposal = tabulated(np.array([0.7]), np.array([1.3]), np.arange(int(heavy)))
    # A t with 5 degrees of freedom has 1e-12 of its mass beyond 400 sds.
    x = np.linspace(-600.0, 600.0, 600_001)
    density = np.exp(proposal.log_density(x[:, None]))
    step = x[1] - x[0]
    # The broken line of a table costs the rule step^2 / 12 times the jumps of its slope, together below 1.
    tail = 1e-6 if heavy else 1e-9
    assert step * density.sum() == pytest.approx(1.0, abs=tail)
    draws = proposal.draw(200_000, np.random.RandomState(3))[:, 0]
    for moment in (lambda v: v, lambda v: np.abs(v - 0.7), lambda v: (v - 0.7) ** 2, lambda v: np.abs(v - 0.7) > 4):
        expected = step * np.sum(density * moment(x))
        scatter = np.sqrt(step * np.sum(density * (moment(x) - expected) ** 2) / len(draws))
        # A step of 0.002 blurs the edge of the last indicator by less than 1e-6.
        assert abs(moment(draws).mean() - expected) < SIGMAS * scatter + 1e-6


@pytest.mark.parametrize("turned", [0.0, 0.4])
def test_the_proposal_density_and_draws_agree_in_many_dimensions(turned):
    """Of coordinates that depend on each other too, by products turned to and back halfway."""
    dimension = 8
    lower = np.tril(np.random.default_rng(8).uniform(-turned, turned, (dimension, dimension)), -1)
    proposal = tabulated(np.linspace(-1, 1, dimension), np.linspace(0.5, 2.0, dimension), np.arange(1, dimension, 2))
    proposal = proposal.turned(lower + lower.T).turned(-0.5 * (lower + lower.T))
    w = proposal.draw(100_000, np.random.RandomState(4))
    # Any normal density that is narrower has the mass 1 under the weights.
    mean, covariance = w.mean(axis=0), np.cov(w.T)
    for shrink in (0.5, 0.8):
        other = stats.multivariate_normal(mean, shrink**2 * covariance).logpdf(w)
        weights = np.exp(other - proposal.log_density(w))
        assert abs(weights.mean() - 1) < SIGMAS * weights.std() / np.sqrt(len(w))
    old = w[:5]
    proposed, factor = proposal(old, np.random.RandomState(5))
    np.testing.assert_array_equal(proposed, proposal.draw(5, np.random.RandomState(5)))
    np.testing.assert_array_equal(factor, proposal.log_density(old) - proposal.log_density(proposed))
