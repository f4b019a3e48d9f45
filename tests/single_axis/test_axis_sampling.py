"""Sampling of an axis where a search or a proposal is lost: an answer or a refusal in words, never a NaN."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.axes import campaign

from tvsbayes.single_axis.axis_campaign import AxisMove
from tvsbayes.single_axis.axis_fit import fit_axis, model_of
from tvsbayes.single_axis.axis_mode import AxisMode, find_mode
from tvsbayes.single_axis.axis_sampling import EXTENSION, run_chain, weighted_sample

RATIO, WILD = 2.5, 400.0


def belt():
    """Eleven counts of an encoder on a belt, a reading every 500; one of them belongs to no stop."""
    commands = [0, 200, 400, 600, 1000, 800, 600, 400, 200, 0, 300]
    moves = [AxisMove(k, 0, float(k), float(c), "" if k else "unknown") for k, c in enumerate(commands)]
    values = np.round(RATIO * np.array(commands) + np.random.default_rng(3).standard_normal(len(commands)))
    values[5:10] += 6.0
    values[7] += WILD
    return replace(campaign(moves, values), unit="mm")


def test_one_wild_reading_does_not_lose_the_mode():
    """The search from the scatter of repeats ends far away, in a density lower by hundreds.

    The answer is narrower than the reading could turn the line, its distance over the travel.
    """
    mode = find_mode(model_of(belt()))
    assert mode.missing == () and mode.log_density > -100
    fit = fit_axis(belt(), tier="importance")
    low, high = np.quantile(fit.draws["per_command"], [0.025, 0.975])
    assert not fit.missing and low < RATIO < high
    assert high - low < WILD / 1000


@pytest.mark.parametrize("density", ["nowhere", "needle"])
def test_draws_that_miss_the_density_are_refused_in_words(density):
    """None that counts, or all weight in one corner far from where the mode was said to be."""
    far = np.array([40.0, -35.0])

    def log_density(w):
        needle = -0.5 * np.sum(((w - far) / 1e-4) ** 2, axis=1)
        return np.full(len(w), -np.inf) if density == "nowhere" else needle

    found = weighted_sample(log_density, AxisMode(np.zeros(2), 1e-6 * np.eye(2), 0.0), np.random.default_rng(1))
    assert found.missing and np.isfinite(found.w).all()
    assert found.weights.sum() == pytest.approx(1) and np.isfinite(found.proposal.log_density(found.w)).all()


def test_a_chain_that_is_long_enough_but_disagrees_goes_on():
    """Until it agrees, or four times as long as it had to be; where it agrees at once nothing is added."""

    def normal(w):
        return -0.5 * np.sum(w**2, axis=1)

    first = weighted_sample(normal, AxisMode(np.zeros(2), np.eye(2), 0.0), np.random.default_rng(1))
    assert not first.missing
    asked = []

    def steps(agrees_at):
        asked.clear()

        def agrees(w):
            asked.append(w.shape[1])
            return len(asked) == agrees_at

        return run_chain(normal, first, 3, 60.0, agrees=agrees).steps

    once = steps(1)
    assert len(asked) == 1 and run_chain(normal, first, 3, 60.0).steps == once
    assert once < steps(2) < EXTENSION * once and len(asked) == 2
    assert steps(-1) == EXTENSION * once
