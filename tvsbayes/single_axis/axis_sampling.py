"""The posterior of an axis' scales in two tiers that must agree: weighted draws, then a chain of emcee.

Coordinates have standard normal priors. Limits as for the scanner (formulation 4.3, 8.2).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from tvsbayes.progress import Advance, OpenEnded, unshown
from tvsbayes.single_axis.axis_mode import AxisMode
from tvsbayes.statistics.weighted_draws import TAILS, effective_draws, smoothed_weights, systematic

Density = Callable[[np.ndarray], np.ndarray]
ROUND_DRAWS, ROUNDS_MAX = 1500, 14
EFFECTIVE_WANTED = 2000.0
PARETO_K_MAX, HEAVIEST_MAX = 0.7, 0.02
DEGREES, INFLATION, WIDE = 5.0, 1.25, 6.0
"""Of the Student proposals: freedom, and variances over what was found."""
EQUAL_DRAWS = 2000
"""Kept of a sample, of equal weight."""
WALKERS, BLOCK_STEPS, BURN_STEPS = 48, 150, 30
GROUPS = 4
RHAT_MAX, ESS_MIN, TAUS_MIN = 1.01, 1000.0, 50.0
EXTENSION = 4
"""Lengths of a chain that may be used but differs from the weighted draws, after which it is left as it is."""
WALK_SHARE = 0.4
"""Of a chain's moves that go by a random step; the others ask the proposal."""


@dataclass
class Proposal:
    """A mixture of Student distributions: means (d,), Cholesky factors (d, d), shares."""

    means: list[np.ndarray] = field(default_factory=list)
    roots: list[np.ndarray] = field(default_factory=list)
    shares: list[float] = field(default_factory=list)

    def add(self, mean: np.ndarray, covariance: np.ndarray, share: float) -> None:
        """One more; shares need not sum to one."""
        self.means.append(mean)
        self.roots.append(np.linalg.cholesky(covariance))
        self.shares.append(share)

    def draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Draws (count, d)."""
        d = len(self.means[0])
        share = np.array(self.shares) / np.sum(self.shares)
        which = rng.choice(len(share), size=count, p=share)
        normal = rng.standard_normal((count, d)) / np.sqrt(rng.chisquare(DEGREES, count) / DEGREES)[:, None]
        means, roots = np.array(self.means), np.array(self.roots)
        return means[which] + np.einsum("nij,nj->ni", roots[which], normal)

    def log_density(self, w: np.ndarray) -> np.ndarray:
        """Log density (n,) up to a constant that depends on d alone."""
        d = w.shape[1]
        share = np.array(self.shares) / np.sum(self.shares)
        parts = []
        for mean, root, part in zip(self.means, self.roots, share, strict=True):
            z = np.linalg.solve(root, (w - mean).T)
            square = np.sum(z**2, axis=0)
            log_det = np.sum(np.log(np.diag(root)))
            parts.append(np.log(part) - log_det - 0.5 * (DEGREES + d) * np.log1p(square / DEGREES))
        return np.logaddexp.reduce(parts, axis=0)


@dataclass(frozen=True)
class WeightedSample:
    """Importance sampling of the scales.

    Attributes:
        w: draws (n, d).
        weights: shape (n,), sum 1.
        pareto_k: tail index of the weights.
        effective: equal draws that they are worth.
        rounds: made.
        missing: sentences on why it may not be used; empty where it may.
        proposal: what it was drawn from.
    """

    w: np.ndarray
    weights: np.ndarray
    pareto_k: float
    effective: float
    rounds: int
    missing: tuple[str, ...]
    proposal: Proposal

    def equal(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Draws of equal weight (count, d), in random order."""
        return self.w[rng.permutation(systematic(self.weights, count, rng.random()))]


def _moments(w: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance, the latter never flatter than rounding."""
    mean = weights @ w
    off = w - mean
    covariance = (weights[:, None] * off).T @ off
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-24))
    return mean, covariance + 1e-6 * np.diag(scale**2)


def weighted_sample(
    density: Density,
    start: AxisMode,
    rng: np.random.Generator,
    effective: float = EFFECTIVE_WANTED,
    advance: Advance = unshown,
) -> WeightedSample:
    """Pooled rounds of draws from a proposal that follows what was found, weighted against their mixture.

    Args:
        density: log posterior density up to a constant.
        start: mode with its curvature.
        rng: source of draws.
        effective: equal draws wanted.
        advance: told how far it is.
    """
    proposal = Proposal()
    d = len(start.w)
    if not d:
        return WeightedSample(np.zeros((1, 0)), np.ones(1), 0.0, np.inf, 0, (), proposal)
    proposal.add(start.w, INFLATION * start.covariance, 0.7)
    proposal.add(start.w, 4.0 * start.covariance, 0.3)
    made, drawn, target, used = [], [], [], []
    k, worth, weights, w = np.inf, 0.0, np.ones(1), np.zeros((0, d))
    for number in range(1, ROUNDS_MAX + 1):
        fresh = proposal.draw(ROUND_DRAWS, rng)
        drawn.append(fresh)
        target.append(density(fresh))
        used.append(proposal)
        made.append(len(fresh))
        w, log_target = np.concatenate(drawn), np.concatenate(target)
        # Drawn evenly from all proposals: the mixture is the density of the pool.
        log_pool = np.logaddexp.reduce([each.log_density(w) for each in used], axis=0)
        there = np.isfinite(log_target)
        if there.any():
            smooth = smoothed_weights(np.where(there, log_target - log_pool, -np.inf))
            weights, k, worth = smooth.weights, smooth.pareto_k, effective_draws(smooth.weights)
        else:
            weights = np.full(len(w), 1 / len(w))
        advance(min(worth / effective, number / ROUNDS_MAX + 0.2, 1.0))
        if worth >= effective and k < PARETO_K_MAX and weights.max() <= HEAVIEST_MAX:
            break
        proposal = Proposal()
        if worth <= d + 1:
            # So few have no covariance: on from the best, as widely as the mode is curved.
            proposal.add(w[np.argmax(weights)], WIDE * start.covariance, 1.0)
            continue
        mean, covariance = _moments(w, weights)
        proposal.add(mean, WIDE * covariance, 0.1)
        proposal.add(*_tail_component(w, weights, mean, covariance), 0.35)
        proposal.add(mean, INFLATION * covariance, 0.55)
    missing = []
    if not worth >= effective:
        missing.append(f"{worth:.0f} effective draws, wanted {effective:.0f}")
    if not k < PARETO_K_MAX:
        missing.append(f"Pareto k of the weights is {k:.2f}, wanted below {PARETO_K_MAX}")
    if not weights.max() <= HEAVIEST_MAX:
        missing.append(f"one draw holds {100 * weights.max():.1f} % of the weight")
    return WeightedSample(w, weights, float(k), worth, len(made), tuple(missing), proposal)


def _tail_component(
    w: np.ndarray, weights: np.ndarray, mean: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the farther half of the posterior, along the direction in which it is most skewed."""
    scale = np.sqrt(np.diag(covariance))
    off = (w - mean) / scale
    skew = weights @ off**3
    along = off @ skew
    order = np.argsort(-along)
    far = order[np.cumsum(weights[order]) <= 0.3]
    if len(far) < 50 or effective_draws(weights[far]) < 20:
        return mean, 3.0 * covariance
    mean_far, covariance_far = _moments(w[far], weights[far] / weights[far].sum())
    return mean_far, 1.5 * covariance_far + 0.1 * np.diag(np.diag(covariance))


@dataclass(frozen=True)
class AxisChain:
    """A chain of emcee.

    Attributes:
        w: kept positions (walkers, steps, d).
        steps: made; acceptance: mean share.
        rhat, ess_bulk, ess_tail: of every coordinate, (d,).
        taus: kept steps over the longest autocorrelation time.
        missing: sentences on what is not reached.
    """

    w: np.ndarray
    steps: int
    acceptance: float
    rhat: np.ndarray
    ess_bulk: np.ndarray
    ess_tail: np.ndarray
    taus: float
    missing: tuple[str, ...]


def grouped(values: np.ndarray) -> np.ndarray:
    """Draws (walkers, steps, ...) as those of `GROUPS` chains (groups, draws, ...), in order of time."""
    walkers, steps, *rest = values.shape
    parts = values.reshape(GROUPS, walkers // GROUPS, steps, *rest)
    return np.swapaxes(parts, 1, 2).reshape(GROUPS, -1, *rest)


def chain_quality(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rank R-hat, bulk and tail effective draws, each (d,), of values (walkers, steps, d)."""
    from arviz_stats.base import array_stats

    parts = np.moveaxis(grouped(values), -1, 0)
    rhat = np.array([float(array_stats.rhat(each, chain_axis=0, draw_axis=1)) for each in parts])
    bulk = [float(array_stats.ess(each, chain_axis=0, draw_axis=1, method="bulk")) for each in parts]
    tail = [float(array_stats.ess(each, chain_axis=0, draw_axis=1, method="tail", prob=TAILS)) for each in parts]
    return rhat, np.array(bulk), np.array(tail)


def _autocorrelation_steps(kept: np.ndarray) -> float:
    """Longest integrated autocorrelation time of positions (walkers, steps, d); infinite where a walker never moved."""
    import emcee

    if not np.all(np.ptp(kept, axis=1) > 0):
        return np.inf
    return float(np.max(emcee.autocorr.integrated_time(np.swapaxes(kept, 0, 1), tol=0, quiet=True)))


def run_chain(
    density: Density,
    first: WeightedSample,
    seed: int,
    max_seconds: float,
    advance: Advance = unshown,
    agrees: Callable[[np.ndarray], bool] = lambda _: True,
) -> AxisChain:
    """Independent walkers from the weighted draws, by random steps and by the proposal, until they may be used.

    Args:
        density: log posterior density up to a constant.
        first: weighted draws.
        seed: of everything random.
        max_seconds: time for it.
        advance: told how far it is.
        agrees: whether the kept positions (walkers, steps, d) say what else is known. A chain that is long enough and
            does not goes on to `EXTENSION` times its length: one walker in a far tail may stand for a while.
    """
    import emcee

    rng = np.random.default_rng([seed, 7])
    d = first.w.shape[1]
    _, covariance = _moments(first.w, first.weights)
    root = np.linalg.cholesky(covariance) * 2.38 / np.sqrt(d)
    proposal = first.proposal

    def step(positions: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        moved = positions + random.standard_normal(positions.shape) @ root.T
        return moved, np.zeros(len(positions))

    def ask(positions: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        moved = proposal.draw(len(positions), rng)
        return moved, proposal.log_density(positions) - proposal.log_density(moved)

    moves = [(emcee.moves.MHMove(step), WALK_SHARE), (emcee.moves.MHMove(ask), 1 - WALK_SHARE)]
    sampler = emcee.EnsembleSampler(WALKERS, d, density, vectorize=True, moves=moves)
    random = np.random.RandomState(seed % 2**32)
    sampler.random_state = random.get_state()
    state = emcee.State(first.equal(WALKERS, rng), random_state=random.get_state())
    began, share = time.monotonic(), OpenEnded()
    expected, enough = 2.0, 0
    while True:
        state = sampler.run_mcmc(state, BLOCK_STEPS, skip_initial_state_check=True)
        kept = np.swapaxes(sampler.get_chain(discard=BURN_STEPS), 0, 1)
        rhat, bulk, tail = chain_quality(kept)
        taus = kept.shape[1] / _autocorrelation_steps(kept)
        missing = []
        if not np.max(rhat) <= RHAT_MAX:
            missing.append(f"R-hat is {np.max(rhat):.4f}, wanted {RHAT_MAX}")
        if not min(bulk.min(), tail.min()) >= ESS_MIN:
            missing.append(f"{min(bulk.min(), tail.min()):.0f} effective draws, wanted {ESS_MIN:.0f}")
        if not taus >= TAUS_MIN:
            missing.append(f"{taus:.0f} autocorrelation times, wanted {TAUS_MIN:.0f}")
        blocks = sampler.iteration / BLOCK_STEPS
        expected = max(expected, blocks * TAUS_MIN / max(taus, 1.0))
        advance(share.share(blocks, expected))
        if time.monotonic() - began > max_seconds:
            break
        if not missing:
            enough = enough or sampler.iteration
            if agrees(kept) or sampler.iteration >= EXTENSION * enough:
                break
    acceptance = float(np.mean(sampler.acceptance_fraction))
    return AxisChain(kept, sampler.iteration, acceptance, rhat, bulk, tail, taus, tuple(missing))
