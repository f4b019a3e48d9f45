"""Summaries of draws whose distribution is known."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from support.drawn_quantities import drawn_quantities
from support.two_parameters import autoregressive

from tvsbayes.inference.summaries import propagated
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.posterior.draws import Posterior
from tvsbayes.results.tiers import CHAIN

SIGMAS = 5.0


def test_monte_carlo_errors_are_those_of_draws_with_memory():
    """AR(1) of memory 0.6: a mean of n draws is as good as one of n / 4; ends of the interval are +-1.96."""
    memory, draws, chains = 0.6, 1000, 32
    value = propagated(autoregressive(draws, chains, memory)[..., 0].T)
    expected = np.sqrt((1 + memory) / (1 - memory) / (draws * chains))
    assert value.mcse_mean == pytest.approx(expected, rel=0.15)
    assert abs(value.mean) < SIGMAS * expected and value.sd == pytest.approx(1.0, abs=SIGMAS * float(value.mcse_sd))
    np.testing.assert_allclose(value.interval95, [-1.959964, 1.959964], atol=SIGMAS * value.mcse_interval95.max())
    assert value.mcse_interval95.max() < 0.05, "no error would be seen"


def test_the_longer_tail_is_the_worse_known():
    """Independent exponentials: a quantile q of n draws has the sd sqrt(p (1 - p) / n) e^q."""
    draws = np.random.default_rng(6).exponential(size=(20, 1000))
    value = propagated(draws)
    p = np.array([0.025, 0.975])
    exact = -np.log1p(-p)
    expected = np.sqrt(p * (1 - p) / draws.size) * np.exp(exact)
    np.testing.assert_allclose(value.mcse_interval95, expected, rtol=0.4)
    np.testing.assert_array_less(np.abs(value.interval95 - exact), SIGMAS * expected)


def test_lost_motion_takes_ratio_and_backlash_of_its_own_axis():
    """200 steps of 0.06 deg take up 0.3 deg of play, two take 0.12 deg of it; every direction, by hand."""
    physical = np.zeros((2, 3, len(TWO_MIRROR.names)))
    values = {"degrees_per_step.pan": 0.06, "ratio_contrast_deg_per_step.pan": 0.002, "backlash_deg.pan": 0.3}
    values |= {"degrees_per_step.tilt": 0.07, "ratio_contrast_deg_per_step.tilt": 0.004, "backlash_deg.tilt": 0.5}
    for name, value in values.items():
        physical[..., TWO_MIRROR.index[name]] = value
    shape = physical.shape[:2]
    draws = drawn_quantities(*shape, physical=physical)
    fit = SimpleNamespace(space=SimpleNamespace(mechanism=TWO_MIRROR))
    known = Posterior(fit, physical, np.zeros(shape), draws, np.full(shape, 1 / 6), SimpleNamespace(tier=CHAIN), 0, 0.0)
    expected = {"left": (0.122, 0.3), "right": (0.118, 0.3), "up": (0.144, 0.5), "down": (0.136, 0.5)}
    for direction, lost in expected.items():
        motion = known.lost_motion_deg(direction, np.array([0, 2, 200]))
        np.testing.assert_allclose(motion.mean, (0.0, *lost), rtol=1e-12)
        np.testing.assert_allclose(motion.interval95, [(0.0, *lost)] * 2, rtol=1e-12)
    with pytest.raises(ValueError, match="allowed: left"):
        known.lost_motion_deg("west", np.array([2]))
