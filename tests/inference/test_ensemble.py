"""The ensemble leaves its target invariant, and a chain is extended until its diagnosis passes.

emcee 3.1.6 ships moves that narrow the posterior by up to a quarter without any sign of it, so every move that is
used is tried on a target whose moments are known, from exact draws of it: whatever moves away then is a bias.
"""

from __future__ import annotations

import emcee
import numpy as np
import pytest
from support.small_posterior import SIGMAS
from support.tabulated import tabulated

from tvsbayes.inference import ensemble
from tvsbayes.inference.chain import GROUPS, Chain
from tvsbayes.inference.diagnosis import TAU_LIMIT
from tvsbayes.inference.ensemble import GroupEvolution, moves
from tvsbayes.inference.proposal import Independence
from tvsbayes.posterior.target import WALKERS, walkers_for

RESOLVED = 0.05
"""Five standard errors of E[x.x]/d have to be below this, or the run could not see a bias of sd x0.97."""
INDEPENDENT_STEPS = {1: 1500, 5: 600, 20: 600, 40: 900}
DIMENSIONS = [1, 5, pytest.param(20, marks=pytest.mark.slow), 40]
"""What five and forty see twenty sees too."""
RENEWAL_STEPS = {**INDEPENDENT_STEPS, 1: 4500}
EVOLUTION_STEPS = {1: 1500, 5: 1600, 20: 1000, 40: 900}
"""Steps by dimension: autocorrelation times (quoted from runs of 2000 steps) are 1.3 to 27 steps with independence
proposals and 5, 18, 59, 87 with differential evolution alone."""


def run(moves: object, dimension: int, steps: int, walkers: int, seed: int = 1) -> np.ndarray:
    """Chain (steps, walkers, d) on N(0, I), from exact draws of it."""
    generator = np.random.RandomState(seed)
    start = generator.standard_normal((walkers, dimension))
    target = lambda x: -0.5 * np.sum(x * x, axis=1)  # noqa: E731
    sampler = emcee.EnsembleSampler(walkers, dimension, target, moves=moves, vectorize=True)
    state = emcee.State(start, random_state=generator.get_state())
    sampler.run_mcmc(state, steps, skip_initial_state_check=True)
    return sampler.get_chain()


def bias(chain: np.ndarray) -> str:
    """What is wrong with a chain on N(0, I), or nothing."""
    steps, walkers, dimension = chain.shape
    square = np.sum(chain**2, axis=2) / dimension
    # A walker that never moves has no autocorrelation time: the bound is nan and nothing passes.
    with np.errstate(invalid="ignore"):
        tau = float(emcee.autocorr.integrated_time(square[:, :, None], tol=0, quiet=True)[0])
    # x.x/d has variance 2/d under the target.
    bound = SIGMAS * np.sqrt(2 / dimension * tau / (steps * walkers))
    # Walkers are independent of each other under the product target. The d T/tau means per run number 200 or more,
    # so the scatter of this variance is below 0.1, a fifth of the way to the nearer limit.
    together = walkers * float(np.mean(chain.mean(axis=1) ** 2))
    wrong = [] if bound < RESOLVED else [f"unresolved: {bound:.3f}"]
    wrong += [] if abs(square.mean() - 1) < bound else [f"E[x.x]/d = {square.mean():.4f}, bound {bound:.4f}"]
    wrong += [] if 0.5 < together < 1.6 else [f"n Var(mean of ensemble) = {together:.2f}"]
    return "; ".join(wrong)


def off_target(dimension: int) -> Independence:
    """A proposal whose mean, sds and shapes are not the target's."""
    # More of them would let some walker stand still in forty dimensions.
    places = np.arange(1, dimension, 3)[:3]
    return tabulated(np.full(dimension, 0.3), np.linspace(1.0, 1.2, dimension), places)


@pytest.mark.thorough
@pytest.mark.parametrize("dimension", DIMENSIONS)
@pytest.mark.parametrize("which", ["independence", "renewal", "mixture"])
def test_independence_and_the_mixture_keep_the_target(which, dimension):
    mixture = moves(off_target(dimension))
    tried = {"independence": mixture[0][0], "renewal": mixture[1][0], "mixture": mixture}[which]
    # A single coordinate is renewed in one step of three only.
    steps = (RENEWAL_STEPS if which == "renewal" else INDEPENDENT_STEPS)[dimension]
    assert bias(run(tried, dimension, steps, walkers_for(dimension))) == ""


@pytest.mark.parametrize("dimension", DIMENSIONS)
def test_differential_evolution_keeps_the_target(dimension):
    move, _ = moves(off_target(dimension))[2]
    assert isinstance(move, GroupEvolution)
    assert bias(run(move, dimension, EVOLUTION_STEPS[dimension], max(64, 2 * dimension))) == ""


def test_groups_never_use_one_another():
    """Other walkers in one group move none in the others: same random numbers, same steps, bit for bit."""
    generator = np.random.default_rng(9)
    start = generator.standard_normal((WALKERS, 3))
    other = start.copy()
    size = WALKERS // GROUPS
    other[size : 2 * size] += generator.standard_normal((size, 3))
    target = lambda x: -0.5 * np.sum(x * x, axis=1)  # noqa: E731
    for move, _ in moves(off_target(3)):
        chains = []
        for positions in (start, other):
            sampler = emcee.EnsembleSampler(WALKERS, 3, target, moves=move, vectorize=True)
            state = emcee.State(positions, random_state=np.random.RandomState(2).get_state())
            sampler.run_mcmc(state, 20, skip_initial_state_check=True)
            chains.append(sampler.get_chain())
        rest = np.delete(np.arange(WALKERS), np.arange(size, 2 * size))
        np.testing.assert_array_equal(chains[0][:, rest], chains[1][:, rest])
        assert np.any(chains[0][:, size : 2 * size] != chains[1][:, size : 2 * size])


def test_a_chain_is_lengthened_as_its_autocorrelation_asks():
    """Of a chain whose autocorrelation time is known: (1 + rho) / (1 - rho) steps."""
    generator, rho, walkers = np.random.default_rng(11), 0.6, 256
    w = generator.standard_normal((1000, walkers, 1))
    for step in range(1, len(w)):
        w[step] = rho * w[step - 1] + np.sqrt(1 - rho**2) * w[step]
    tau = (1 + rho) / (1 - rho)
    for steps, short in ((100, True), (140, True), (1000, False)):
        chain = Chain(w[:steps], w[:steps, :, 0], np.ones(walkers), (), 0, 0.0, steps)
        run = ensemble.Run.__new__(ensemble.Run)
        run.chain, run.goal = lambda chain=chain: chain, steps
        assert run.too_short() is short
        # The mean taken off a chain of n steps takes tau / n off each of the two windows of five tau that are summed;
        # a tenth is for chance.
        kept = 0.9 * steps
        wanted = TAU_LIMIT * tau / 0.9 * np.array([(1 - 10 * tau / kept) * 0.9, 1.1])
        least, most = np.clip(wanted, *(steps * np.array(ensemble.LENGTHENING_RANGE))) if short else (steps, steps)
        assert least <= run.goal <= most + 1
