"""States that a campaign drew, eliminated in time order, against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
from support.dense_spots import dense_covariance
from support.small_posterior import ROUNDING, small_fit

from tvsbayes.estimators.linear_spots import linear_spots
from tvsbayes.posterior.stop_states import Elimination, StopStates, stop_states

SPOTS, STATES, POINTS = 30, 16, 5
SEEN_BY = 3


def drawn_states(seed: int) -> StopStates:
    """States that few spots see, here and there: eliminating one couples others that no spot sees together."""
    generator = np.random.default_rng(seed)
    load = np.zeros((SPOTS, 4, STATES))
    for state in range(STATES):
        load[generator.choice(SPOTS, SEEN_BY, replace=False), :, state] = generator.normal(size=(SEEN_BY, 4))
    none = np.zeros((STATES, 4)), np.zeros(STATES)
    return StopStates(load.reshape(4 * SPOTS, STATES), *none)


@pytest.mark.parametrize("seed", range(3))
def test_the_elimination_is_the_dense_cholesky_factor(seed):
    """At points of many scales, decades apart, fill included."""
    states = drawn_states(seed)
    count = len(states.constant)
    generator = np.random.default_rng([seed, 1])
    sd = np.exp(generator.normal(size=(POINTS, count), scale=2.0))
    filled = sum(states.gram[i, j] == 0 for i, later in enumerate(states.later) for j in later)
    assert filled > 0, "nothing is filled in"
    assert sum(map(len, states.later)) < count * (count - 1) / 2, "nothing is left out"
    products = states.load.T @ generator.normal(size=(4 * SPOTS, 3))
    elimination = Elimination.of(states, sd, states.gram[None, *states.overlapping])
    for point in range(POINTS):
        scaled = states.load * sd[point]
        dense = np.linalg.cholesky(np.eye(count) + scaled.T @ scaled)
        rounding = 4 * SPOTS * count * ROUNDING * np.linalg.cond(dense)
        mine = np.diag(elimination.pivot[point])
        for i, later in enumerate(states.later):
            mine[list(later), i] = elimination.below[i][point]
        np.testing.assert_allclose(mine, dense, rtol=0, atol=rounding * np.abs(dense).max())
        whitened = np.linalg.solve(dense, sd[point][:, None] * products)
        atol = rounding * np.abs(whitened).max()
        np.testing.assert_allclose(elimination.whitened(products)[point], whitened, rtol=0, atol=atol)
        of_point = elimination.whitened(np.repeat(products[None], POINTS, axis=0))[point]
        np.testing.assert_allclose(of_point, whitened, rtol=0, atol=atol)


def test_states_of_a_campaign_give_the_covariance_of_its_filter():
    """Columns times their variances at the mode, against the filter's six states, which make the dense covariance."""
    fitted = small_fit()[0]
    linear = linear_spots(fitted.linearised, fitted.arrays, -fitted.linearised.residual_jacobian)
    states = stop_states(fitted, linear)
    total = (states.load * (states.variance.sum(axis=1) + states.constant)) @ states.load.T
    expected = dense_covariance(linear) - np.eye(len(total))
    assert not linear.variance[:, 2:4][~linear.renewed[:, 2:4]].any(), "a drift has no column"
    np.testing.assert_allclose(total, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    assert np.all(np.diff([np.flatnonzero(column)[-1] // 4 for column in states.load.T]) >= 0), "in order of their ends"
