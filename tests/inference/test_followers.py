"""Coordinates whose density depends on another's: draws follow it, it is a density, and it comes from the target."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.small_posterior import SIGMAS
from support.tabulated import tabulated

from tvsbayes.inference.proposal import Independence, first_proposal
from tvsbayes.inference.tables import CUT_NODES, LEADER_NODES, NODES, Followers, Tables, between_cuts

GRID = np.linspace(-12.0, 16.0, 561)


def of_a_leader(leader: np.ndarray) -> np.ndarray:
    """Where the follower's density lies, by its leader: the larger the one the smaller the other."""
    return 1.5 - 0.8 * leader


def followed() -> Independence:
    """Two tabulated coordinates, the second of which follows the first; both are Gumbel's, all shares are the real."""
    alone = tabulated(np.array([0.5, 0.0]), np.array([1.0, 0.8]), np.arange(2))
    at = (NODES - of_a_leader(LEADER_NODES)[:, None]) / 0.8
    followers = Followers(np.array([0]), np.array([1]), Tables.normalised((-at - np.exp(-at))[None]))
    return replace(alone, coupled=np.zeros(0, int), followers=followers)


def densities(proposal: Independence) -> np.ndarray:
    """On the grid of both coordinates, leader first."""
    one, two = np.meshgrid(GRID, GRID, indexing="ij")
    return np.exp(proposal.log_density(np.column_stack([one.ravel(), two.ravel()]))).reshape(one.shape)


def test_the_density_of_a_pair_is_one_and_its_draws_follow_it():
    proposal = followed()
    density = densities(proposal)
    cell = (GRID[1] - GRID[0]) ** 2
    # The tables' broken lines cost the rule step^2 / 12 times the jumps of their slopes, 5e-4; of the twentieth that is
    # a t of 5 degrees of freedom less than 4e-3 lies beyond the grid.
    assert density.sum() * cell == pytest.approx(1.0, abs=1e-3)
    draws = proposal.draw(200_000, np.random.RandomState(3))
    # Cells of 20 x 20 grid points inside, by chi-square.
    edges = GRID[80:401:20]
    counts = np.histogram2d(*draws.T, bins=[edges, edges])[0].ravel()
    weights = np.full(21, 1.0)
    weights[[0, -1]] = 0.5
    expected = [
        len(draws) * cell * weights @ density[i : i + 21, j : j + 21] @ weights
        for i in range(80, 400, 20)
        for j in range(80, 400, 20)
    ]
    expected = np.array(expected)
    many = expected > 25
    assert many.sum() > 20
    chi2 = np.sum((counts[many] - expected[many]) ** 2 / expected[many])
    assert abs(chi2 - many.sum()) < SIGMAS * np.sqrt(2 * many.sum())


def test_new_values_of_some_coordinates_leave_a_pair_as_it_is():
    """Walkers that begin as draws of a density are draws of it after any number of Metropolis steps."""
    proposal, generator = followed().turned(np.array([[0.0, 0.3], [0.3, 0.0]])), np.random.RandomState(6)
    begun = w = proposal.draw(20_000, generator)
    for _ in range(12):
        proposed, factor = proposal.renewed(w, generator)
        with np.errstate(over="ignore"):
            ratio = np.exp(proposal.log_density(proposed) - proposal.log_density(w) + factor)
        w = np.where((generator.uniform(size=len(w)) < ratio)[:, None], proposed, w)
    assert np.mean(w == begun) < 0.1
    for moment in (lambda v: v, lambda v: v**2, lambda v: np.prod(v, axis=1), lambda v: np.abs(v) > 2):
        first, last = moment(np.clip(begun, -6, 6)), moment(np.clip(w, -6, 6))
        scatter = np.sqrt((first.var(axis=0) + last.var(axis=0)) / len(w))
        assert np.all(np.abs(first.mean(axis=0) - last.mean(axis=0)) < SIGMAS * scatter)


def effective_share(target, dimension: int) -> float:
    """Of draws from the first proposal, all coordinates tabulated."""
    proposal = first_proposal(target, dimension, np.ones(dimension, bool), np.zeros(dimension, bool))
    w = proposal.draw(20_000, np.random.RandomState(5))
    log_weights = target(w) - proposal.log_density(w)
    weights = np.exp(log_weights - log_weights.max())
    return float(weights.sum() ** 2 / np.sum(weights**2) / len(w))


def test_a_pair_that_explains_the_same_scatter_is_proposed_as_the_target_has_it(monkeypatch):
    """Two scales of which one suffices: weights of independent draws have a long tail, of followed ones hardly."""

    def target(w: np.ndarray) -> np.ndarray:
        both = np.logaddexp(1.5 * w[:, 0], 1.5 * w[:, 1])
        return -0.5 * np.sum(w**2, axis=1) / 4 - 0.5 * (both - 3.0) ** 2 / 0.15

    followed = effective_share(target, 2)
    monkeypatch.setattr("tvsbayes.inference.proposal.forest", lambda *_: [])
    # Between the leader's nodes tables are mixed: that costs a part.
    assert followed > 0.2 > 20 * effective_share(target, 2)


def test_a_hole_between_cuts_swings_nothing_above_its_neighbours():
    """The target may fall by 1e5 where the map's steps diverge: a cubic through it would rise as far beside."""
    cuts = -0.5 * CUT_NODES**2
    inner, outer = np.flatnonzero(np.isin(CUT_NODES, (2.0, 8.0)))
    for hole in (inner, outer):
        cuts[hole] = -2e5
    values = between_cuts(cuts)
    assert values.max() == pytest.approx(0.0, abs=1e-9)
    # The inner one, at 2, is filled to the lower of its neighbours, at 3.
    at = np.argmin(np.abs(NODES - CUT_NODES[inner]))
    assert values[at] == pytest.approx(-0.5 * CUT_NODES[inner + 1] ** 2)


def test_a_cliff_far_from_the_mode_leaves_the_density_beside_it_as_it_is():
    """Where the map's steps diverge a target falls by 1e15: Akima's weights must not take all other slopes as equal."""
    cuts = -0.5 * CUT_NODES**2
    cuts[CUT_NODES >= 5] = [-7e2, -3e4, -5e15]
    values = between_cuts(cuts[None])[0]
    # Akima weighs the slope before a node by how far the two after it differ: those of the cliff by 700 against 1.
    np.testing.assert_allclose(values[NODES < 3], -0.5 * NODES[NODES < 3] ** 2, atol=0.2)
    assert np.all(values[NODES >= 3] <= cuts[CUT_NODES == 3])
