"""What a prior of another width would do, against posteriors that are known exactly; a refit is in test_summary."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from tvsbayes.assessment.prior_sensitivity import FACTORS, SampledHeadlines

COUNT = 40_000
SIGMAS = 5.0
DATA, SPREAD = np.array([0.6, -0.4]), 0.5
"""What the data say of two coordinates, with that standard deviation each."""
LOAD = np.array([2.0, -1.0])
"""Of the coordinates on the headline."""


def conjugate(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances of the coordinates under normal priors of sds u (normal data, normal prior)."""
    variance = 1 / (1 / u**2 + 1 / SPREAD**2)
    return variance * DATA / SPREAD**2, variance


def sampled(half: bool = False) -> SampledHeadlines:
    """Exact draws of the posterior under unit priors, doubled in number where one in two has no weight."""
    generator = np.random.default_rng(1)
    mean, variance = conjugate(np.ones(2))
    z = mean + np.sqrt(variance) * generator.standard_normal((COUNT, 2))
    weights = np.tile([0.0, 2.0], COUNT // 2) / COUNT
    return SampledHeadlines(z, (z @ LOAD)[:, None], weights, np.array([half, False]))


@pytest.mark.parametrize("factor", FACTORS)
def test_a_normal_prior_of_another_width_gives_the_conjugate_posterior(factor):
    before, after = conjugate(np.ones(2)), conjugate(np.array([factor, 1.0]))
    sd = np.sqrt(before[1] @ LOAD**2)
    shift = (after[0] - before[0]) @ LOAD / sd
    ratio = np.sqrt(after[1] @ LOAD**2) / sd
    draws = sampled()
    assert abs(shift) > 0.1, "nothing would be seen"
    for change in (draws.changed(np.array([0]), factor), draws.normal.changed(np.array([0]), factor)):
        # Means and sds of 20 000 draws, of which the new prior leaves a third at least.
        assert change.shift_sd[0] == pytest.approx(shift, abs=SIGMAS / np.sqrt(COUNT / 6))
        assert change.sd_ratio[0] == pytest.approx(ratio, abs=SIGMAS / np.sqrt(COUNT / 3))


@pytest.mark.parametrize("factor", FACTORS)
def test_a_half_normal_prior_is_weighed_by_its_quantity(factor):
    """B = halfnorm(u) with a coordinate that data fix: the mean of z under twice or half the u, by quadrature."""
    z = np.linspace(-9.0, 9.0, 200_001)
    b = stats.halfnorm.isf(stats.norm.sf(z))
    density = stats.norm.pdf(z, DATA[0], SPREAD) * stats.norm.pdf(z)
    wanted = density * np.exp(-0.5 * b**2 * (factor**-2 - 1))
    means = [np.sum(z * p) / np.sum(p) for p in (density, wanted)]
    change = sampled(half=True).changed(np.array([0]), factor)
    sd = np.sqrt(conjugate(np.ones(2))[1] @ LOAD**2)
    assert change.shift_sd[0] == pytest.approx(LOAD[0] * (means[1] - means[0]) / sd, abs=SIGMAS / np.sqrt(COUNT / 6))
    as_normal = sampled().changed(np.array([0]), factor)
    assert abs(as_normal.shift_sd[0] - change.shift_sd[0]) > 0.08, "the kind of the prior makes no difference"


def test_a_prior_that_too_few_draws_bear_is_left_to_the_moments():
    """Twenty coordinates that the data do not touch: halving their u leaves one draw in six thousand of its weight."""
    z = np.random.default_rng(2).standard_normal((5000, 20))
    draws = SampledHeadlines(z, z[:, :1], np.full(5000, 1 / 5000), np.zeros(20, bool))
    assert draws.changed(np.arange(20), 0.5) is None
    change = draws.normal.changed(np.arange(20), 0.5)
    # With the prior alone the headline, one of the coordinates, is half as wide.
    assert change.sd_ratio[0] == pytest.approx(0.5, abs=SIGMAS * 0.5 / np.sqrt(2 * 5000))
    assert abs(change.shift_sd[0]) < SIGMAS / np.sqrt(5000)
