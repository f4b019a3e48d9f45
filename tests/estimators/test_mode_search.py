"""The search's noise scales on densities that are known, without a campaign."""

from __future__ import annotations

import numpy as np
import pytest

from tvsbayes.estimators.mode_search import Problem

CENTRE = np.array([0.4, -1.2, 0.03])
CURVATURE = np.array([1.0, 40.0, 4000.0])
"""Of negative log densities along noise scales, prior sds^-2: from the prior's alone to those of many looks."""
SETTLED_SDS = 0.02
"""Twice the slope at which the search ends, in sds."""
CALLS_MAX = 6
"""Of a density without bends: its curvature is measured once, and quasi-Newton steps begin in its units; else 12."""


class Known(Problem):
    """Three noise scales with a normal density, which has no value beyond a wall."""

    def __init__(self, wall: float):
        self.noise, self.wall, self.calls = np.arange(3), wall, 0

    def log_volume(self, z):
        """None."""
        return lambda points: np.zeros(len(points))

    def negative_log_density(self, z):
        """Normal up to the wall across the first scale."""
        self.calls += 1
        value = 0.5 * np.sum(CURVATURE * (z - CENTRE) ** 2, axis=1)
        return np.where(z[:, 0] > self.wall, np.inf, value)


def test_noise_scales_of_any_width_are_found_in_a_few_steps():
    problem = Known(np.inf)
    scales = problem.noise_scales(np.array([2.0, 1.0, -1.0]))
    assert np.max(np.abs(scales - CENTRE) * np.sqrt(CURVATURE)) < SETTLED_SDS
    assert problem.calls <= CALLS_MAX


@pytest.mark.parametrize("start", [2.0, 0.9])
def test_a_start_at_the_end_of_a_density_has_finite_scales(start):
    """The curvature there is no number: its own unit must do."""
    scales = Known(start).noise_scales(np.array([start, 1.0, -1.0]))
    assert np.all(np.isfinite(scales))
