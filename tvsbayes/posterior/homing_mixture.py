"""The posterior over unrecorded homing hypotheses: weighted draws under each, mixed by evidence and prior probability.

The draws of the most probable way usually serve the others, weighed anew under each: their posteriors overlap. A way
for which they do not serve has draws of its own. Rounds go where the error of the mixture comes from.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import jax
import numpy as np

from tvsbayes.inference.density import Points
from tvsbayes.inference.importance import K_MAX, ROUND, Acceptance, ImportanceRun, Pool, Weighing
from tvsbayes.inference.summaries import monte_carlo_errors
from tvsbayes.instrument.homing import prior_chance
from tvsbayes.posterior.draws import Posterior
from tvsbayes.posterior.target import Target
from tvsbayes.posterior.transport import Mapped, transport_beside
from tvsbayes.results.convergence import END_ERROR_MAX, MEAN_ERROR_MAX, MonteCarloError, Reweighted
from tvsbayes.statistics.streams import Stream, random_stream
from tvsbayes.statistics.weighted_draws import TAILS, WeightedSummary, weighted_summary

ALONE_ROUNDS = 2
"""Rounds with which draws of a way's own begin."""
FURTHER_ROUNDS_MAX = 32
"""Largest number of rounds drawn beyond those of the most probable way."""
WORTH_RELIABLE_WEIGHTS = 0.1
"""Least probability of a way whose weights must be reliable: one below shifts a mean by at most 1/10 of its difference.
"""
SHARED_COST = 0.4
"""Cost of weighing a shared draw anew, over that of drawing."""
WORTH_DRAWING = 0.01
"""Least share in the squared error of a way that is given more draws."""
MARGIN = 1.1
"""Factor on the predicted number of rounds, which a few draws predict poorly."""


@dataclass(frozen=True)
class WayDraws:
    """Weighted draws under one homing hypothesis.

    Attributes:
        target: its density.
        pool: its draws.
        seed: seed of all random numbers; `part`: number of the way, and of fits of its proposal, which draw others.
        shared: whether these are the first draws of the most probable way, weighed anew.
    """

    target: Target
    pool: Pool
    seed: int
    part: tuple[int, int] = (0, 0)
    shared: bool = False

    @cached_property
    def weighed(self) -> Weighing:
        """Return the draws with their weights."""
        return Weighing(self.target, self.pool)

    @property
    def rounds(self) -> int:
        """Return the number of rounds."""
        return sum(self.pool.counts) // ROUND

    @property
    def reliable(self) -> bool:
        """Whether the tail of the weights determines means."""
        return self.weighed.smoothed.pareto_k < K_MAX

    @property
    def log_evidence(self) -> float:
        """Compute the log evidence with the prior probability of the way."""
        return self.weighed.log_evidence + float(np.log(prior_chance(self.target.fit.sides)))

    @property
    def refitted(self) -> WayDraws:
        """Draw as many rounds from a proposal fitted to these draws, which are left out."""
        part = self.part[0], self.part[1] + 1
        empty = replace(self, pool=Pool.empty(self.pool.refitted, self.pool.invalid), part=part)
        return empty.extended(self.rounds, self.pool)

    def extended(self, rounds: int, first: Pool) -> WayDraws:
        """Extend to so many rounds; shared draws by those of `first`, which has as many."""
        pool, generator = self.pool, np.random.RandomState([self.seed, *self.part, sum(self.pool.counts)])
        while sum(pool.counts) < rounds * ROUND:
            if self.shared:
                pool = _weighed_anew(self.target, pool, first, self.seed, self.part[0])
            else:
                pool = pool.extended(self.target, generator, fitted=False)
        return replace(self, pool=pool)


def _weighed_anew(target: Target, pool: Pool, first: Pool, seed: int, way: int) -> Pool:
    """Extend a pool by the next round of `first`, under another homing hypothesis, of this number."""
    begin, before = sum(pool.counts), target.invalid
    subset = first.drawn.taken(slice(begin, begin + ROUND))
    mapped = Mapped(subset.parts["z"], subset.parts["log_jacobian"])
    normal = target.place_normals(ROUND, random_stream(seed, Stream.OTHER_HOMING, begin // ROUND, way))
    added = target.at(subset.w, mapped, normal)
    return replace(
        pool,
        points=added if pool.points is None else Points.joined([pool.points, added]),
        proposals=first.proposals,
        counts=(begin + ROUND,),
        invalid=pool.invalid + target.invalid - before,
    )


@dataclass(frozen=True)
class Mixture:
    """Weighted draws under several homing hypotheses.

    Attributes:
        ways: the draws; those of the first may be shared by others.
        left: rounds that may still be drawn.
    """

    ways: tuple[WayDraws, ...]
    left: int

    @cached_property
    def probabilities(self) -> np.ndarray:
        """Compute the posterior probability of each way, shape (ways,)."""
        log_evidence = np.array([way.log_evidence for way in self.ways])
        chance = np.exp(log_evidence - log_evidence.max())
        return chance / chance.sum()

    @property
    def names(self) -> tuple[str, ...]:
        """Return the headlines by which the draws are judged."""
        return self.ways[0].weighed.headlines

    def _columns(self, way: WayDraws) -> np.ndarray:
        return np.stack([way.weighed.columns[name] for name in self.names], axis=1)

    @cached_property
    def _weights(self) -> tuple[np.ndarray, ...]:
        """Compute the weights of the draws of each way in the mixture, shapes (n,)."""
        return tuple(p * way.weighed.smoothed.weights for p, way in zip(self.probabilities, self.ways, strict=True))

    @cached_property
    def summary(self) -> WeightedSummary:
        """Summarise the headlines; the weights of a shared draw are added."""
        first = self.ways[0]
        weights, values = [self._weights[0].copy()], [self._columns(first)]
        for way, own in zip(self.ways[1:], self._weights[1:], strict=True):
            if way.shared and np.array_equal(way.weighed.finite, first.weighed.finite[: len(way.weighed.finite)]):
                weights[0][: len(own)] += own
            else:
                weights.append(own)
                values.append(self._columns(way))
        return weighted_summary(np.concatenate(values), np.concatenate(weights))

    @cached_property
    def errors(self) -> dict[str, MonteCarloError]:
        """Compute the Monte Carlo error of every headline."""
        return monte_carlo_errors(self.names, self.summary)

    @cached_property
    def acceptance(self) -> Acceptance:
        """Judge the draws, by the largest tail index of a way that counts and the largest weight of a draw."""
        counts = zip(self.probabilities, self.ways, strict=True)
        pareto_k = max(way.weighed.smoothed.pareto_k for p, way in counts if p >= WORTH_RELIABLE_WEIGHTS)
        heaviest = float(max(weights.max() for weights in self._weights))
        return Acceptance(pareto_k, heaviest, sum(map(len, self._weights)), self.errors)

    @property
    def worst(self) -> str:
        """Return the headline with the largest error."""
        return max(self.errors, key=lambda name: self.errors[name].rounds_factor)

    @property
    def shares_of_error(self) -> np.ndarray:
        """Compute the share of each way in the squared error of the worst headline, shape (ways,)."""
        name = self.worst
        error, column = self.errors[name], self.names.index(name)
        worst = int(np.argmax([error.mean / MEAN_ERROR_MAX, *(each / END_ERROR_MAX for each in error.interval95)]))
        squares = []
        for way, weights in zip(self.ways, self._weights, strict=True):
            values = way.weighed.columns[name]
            if worst == 0:
                influence = values - self.summary.mean[column]
            else:
                influence = (values <= self.summary.interval95[worst - 1][column]) - TAILS[worst - 1]
            squares.append(float(np.sum((weights * influence) ** 2)))
        return np.array(squares) / np.sum(squares)

    def improved(self) -> Mixture | None:
        """Draw more where it helps most; None where the draws suffice or no rounds are left."""
        return self._with_reliable_weights() or (self._with_smaller_error() if self.acceptance.missing else None)

    def _with_reliable_weights(self) -> Mixture | None:
        """Draw otherwise under the first way whose weights are unreliable."""
        first = self.ways[0]
        for place, way in enumerate(self.ways[1:], 1):
            if way.reliable:
                continue
            if way.shared and way.rounds < first.rounds:
                return self._with(place, way.extended(first.rounds, first.pool))
            if way.shared and self.left >= ALONE_ROUNDS:
                return self._with(place, self._alone(way, place), ALONE_ROUNDS)
            if not way.shared and self.probabilities[place] >= WORTH_RELIABLE_WEIGHTS and self.left >= way.rounds:
                return self._with(place, way.refitted, way.rounds)
        return None

    def _with_smaller_error(self) -> Mixture | None:
        """Draw more under the way that lowers the largest error most for its cost."""
        first = self.ways[0]
        factor, shares = self.errors[self.worst].rounds_factor, self.shares_of_error
        cost = np.array([SHARED_COST if way.shared and way.rounds < first.rounds else 1.0 for way in self.ways])
        for place in np.argsort(-shares / cost).tolist():
            if shares[place] < WORTH_DRAWING:
                continue
            way = self.ways[place]
            # Of the squared error, 1 - 1 / factor must go, which this way's share may not hold.
            kept = max(1 - (1 - 1 / factor) / shares[place], 0.5) if factor > 1 else 0.5
            rounds = max(way.rounds + 1, int(np.ceil(min(MARGIN / kept, 2.0) * way.rounds)))
            if way.shared and way.rounds < first.rounds:
                return self._with(place, way.extended(min(rounds, first.rounds), first.pool))
            if self.left > 0:
                # A way that shares all draws of the first has more when that has.
                drawn = 0 if way.shared else place
                further = min(rounds - way.rounds, self.left)
                return self._with(drawn, self.ways[drawn].extended(way.rounds + further, first.pool), further)
        return None

    def _with(self, place: int, way: WayDraws, drawn: int = 0) -> Mixture:
        """Put other draws of a way, of which so many rounds were drawn."""
        return Mixture((*self.ways[:place], way, *self.ways[place + 1 :]), self.left - drawn)

    def _alone(self, way: WayDraws, place: int) -> WayDraws:
        """Draw from another homing hypothesis, by its own map and the proposal fitted for the most probable one."""
        first = self.ways[0]
        target = Target(way.target.fit, transport_beside(way.target.fit, first.target.path))
        # Numbers of its own: the same ones in the proposal of the first way would tie the draws of both.
        empty = WayDraws(target, Pool.empty(first.pool.proposals[-1]), way.seed, (place, 0))
        return empty.extended(ALONE_ROUNDS, first.pool)

    def posterior(self, seconds: float) -> Posterior:
        """Build the posterior of all ways, on whose draws `seconds` were spent."""
        parts = [way.target.posterior(way.weighed.sample(0.0), self.ways[0].seed) for way in self.ways]
        diagnosis = parts[0].convergence
        assert isinstance(diagnosis, Reweighted)
        importance = replace(
            diagnosis.importance,
            accepted=not self.acceptance.missing,
            missing=self.acceptance.missing,
            pareto_k=self.acceptance.pareto_k,
            heaviest_share=self.acceptance.heaviest,
            answer=self.acceptance.answer,
        )
        convergence = replace(diagnosis, importance=importance, monte_carlo_error=self.errors)
        return replace(mixed(parts, self.probabilities), convergence=convergence, seconds=seconds)


def homing_mixture(run: ImportanceRun[Target]) -> Posterior:
    """Compute the posterior over all homing hypotheses of a fit, from the draws of the most probable one."""
    began = time.monotonic()
    shared = [
        WayDraws(
            Target(way.fit, run.density.path), Pool.empty(run.pool.next_proposal), run.seed, (place, 0), shared=True
        )
        for place, way in enumerate(run.density.fit.mixture[1:], 1)
        if way.fit
    ]
    if not shared:
        return run.density.posterior(run.sample, run.seed)
    ways = (WayDraws(run.density, run.pool, run.seed), *(way.extended(1, run.pool) for way in shared))
    mixture = Mixture(ways, FURTHER_ROUNDS_MAX if run.sample.convergence.importance.accepted else 0)
    while (better := mixture.improved()) is not None:
        mixture = better
    return mixture.posterior(run.sample.seconds + time.monotonic() - began)


def mixed(parts: Sequence[Posterior], probabilities: np.ndarray) -> Posterior:
    """Mix the posteriors under several homing hypotheses; the diagnosis stays that of the first.

    Args:
        parts: posteriors by importance sampling, in the order of `JointFit.mixture`.
        probabilities: of the ways, shape (parts,).
    """
    first = parts[0]
    fitted = [way for way in first.fit.mixture if way.fit is not None]
    ways = tuple(replace(way, probability=float(p)) for way, p in zip(fitted, probabilities, strict=True))
    return replace(
        first,
        fit=replace(first.fit, alternatives=ways),
        z=np.concatenate([part.z for part in parts], axis=1),
        log_density=np.concatenate([part.log_density for part in parts], axis=1),
        draws=jax.tree.map(lambda *each: np.concatenate(each, axis=1), *(part.draws for part in parts)),
        weights=np.concatenate([p * part.weights for p, part in zip(probabilities, parts, strict=True)], axis=1),
        way=np.concatenate([np.full(part.weights.shape, k) for k, part in enumerate(parts)], axis=1),
    )
