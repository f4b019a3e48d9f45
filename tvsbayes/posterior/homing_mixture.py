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
from tvsbayes.inference.importance import K_MAX, ROUND, Acceptance, Pool, worst
from tvsbayes.inference.summaries import monte_carlo_errors
from tvsbayes.instrument.homing import prior_chance
from tvsbayes.posterior.draws import Posterior
from tvsbayes.posterior.target import Target
from tvsbayes.posterior.transport import Mapped, transport_beside
from tvsbayes.results.convergence import END_ERROR_MAX, MEAN_ERROR_MAX, MonteCarloError
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
class Way:
    """Weighted draws under one homing hypothesis.

    Attributes:
        pool: the draws.
        part: number of the way, and of fits of its proposal, which draw other random numbers.
        shared: whether these are the first draws of the most probable way, weighed anew.
    """

    pool: Pool[Target]
    part: tuple[int, int] = (0, 0)
    shared: bool = False

    @property
    def reliable(self) -> bool:
        """Whether the tail of the weights determines means."""
        return self.pool.smoothed.pareto_k < K_MAX

    @property
    def log_evidence(self) -> float:
        """Compute the log evidence with the prior probability of the way."""
        return self.pool.log_evidence + float(np.log(prior_chance(self.pool.density.fit.sides)))

    def extended(self, rounds: int, first: Pool[Target]) -> Way:
        """Extend to so many rounds; shared draws by those of `first`, which has as many."""
        pool, generator = self.pool, np.random.RandomState([self.pool.seed, *self.part, sum(self.pool.counts)])
        while pool.rounds < rounds:
            pool = _weighed_anew(pool, first, self.part[0]) if self.shared else pool.extended(generator)
        return replace(self, pool=pool)

    def refitted(self) -> Way:
        """Draw as many rounds from a proposal fitted to these draws, which are left out."""
        empty = Way(self.pool.refitted, (self.part[0], self.part[1] + 1))
        return empty.extended(self.pool.rounds, self.pool)

    def alone(self, first: Pool[Target]) -> Way:
        """Draw by a map of its own, from the proposal fitted for the most probable way."""
        target = Target(self.pool.density.fit, transport_beside(self.pool.density.fit, first.density.path))
        # Numbers of its own: the same ones in the proposal of the first way would tie the draws of both.
        empty = Pool(target, first.seed, first.proposals[-1], first.began)
        return Way(empty, (self.part[0], 0)).extended(ALONE_ROUNDS, first)


def _weighed_anew(pool: Pool[Target], first: Pool[Target], way: int) -> Pool[Target]:
    """Extend a pool by the next round of `first`, under another homing hypothesis, of this number."""
    begin, target = sum(pool.counts), pool.density
    before, round_ = target.invalid, first.drawn.taken(slice(begin, begin + ROUND))
    mapped = Mapped(round_.parts["z"], round_.parts["log_jacobian"])
    normal = target.place_normals(ROUND, random_stream(first.seed, Stream.OTHER_HOMING, begin // ROUND, way))
    drawn = Points.joined([pool.drawn, target.at(round_.w, mapped, normal)])
    invalid = pool.invalid + target.invalid - before
    return replace(pool, drawn=drawn, proposals=first.proposals, counts=(begin + ROUND,), invalid=invalid)


@dataclass(frozen=True)
class Mixture:
    """Weighted draws under several homing hypotheses.

    Attributes:
        ways: the draws; those of the first may be shared by others.
        left: rounds that may still be drawn.
    """

    ways: tuple[Way, ...]
    left: int

    @cached_property
    def probabilities(self) -> np.ndarray:
        """Compute the posterior probability of each way, shape (ways,)."""
        log_evidence = np.array([way.log_evidence for way in self.ways])
        chance = np.exp(log_evidence - log_evidence.max())
        return chance / chance.sum()

    @cached_property
    def _weights(self) -> tuple[np.ndarray, ...]:
        """Compute the weights of the draws of each way in the mixture, shapes (n,)."""
        return tuple(p * way.pool.smoothed.weights for p, way in zip(self.probabilities, self.ways, strict=True))

    @property
    def headlines(self) -> tuple[str, ...]:
        """Return the headlines by which the draws are judged."""
        return self.ways[0].pool.headlines

    @cached_property
    def summary(self) -> WeightedSummary:
        """Summarise the headlines; the weights of a shared draw are added."""
        first, pools = self.ways[0].pool, [self.ways[0].pool]
        weights = [self._weights[0].copy()]
        for way, own in zip(self.ways[1:], self._weights[1:], strict=True):
            if way.shared and np.array_equal(way.pool.finite, first.finite[: len(way.pool.finite)]):
                weights[0][: len(own)] += own
            else:
                weights.append(own)
                pools.append(way.pool)
        columns = [np.concatenate([pool.columns[name] for pool in pools]) for name in self.headlines]
        return weighted_summary(np.stack(columns, axis=1), np.concatenate(weights))

    @cached_property
    def errors(self) -> dict[str, MonteCarloError]:
        """Compute the Monte Carlo error of every headline."""
        return monte_carlo_errors(self.headlines, self.summary)

    @cached_property
    def acceptance(self) -> Acceptance:
        """Judge the draws, by the largest tail index of a way that counts and the largest weight of a draw."""
        counts = zip(self.probabilities, self.ways, strict=True)
        pareto_k = max(way.pool.smoothed.pareto_k for p, way in counts if p >= WORTH_RELIABLE_WEIGHTS)
        heaviest = float(max(weights.max() for weights in self._weights))
        return Acceptance(pareto_k, heaviest, sum(map(len, self._weights)), self.errors)

    @property
    def shares_of_error(self) -> np.ndarray:
        """Compute the share of each way in the squared error of the worst headline, shape (ways,)."""
        name = worst(self.errors)
        error, column = self.errors[name], self.headlines.index(name)
        which = int(np.argmax([error.mean / MEAN_ERROR_MAX, *(each / END_ERROR_MAX for each in error.interval95)]))
        squares = []
        for way, weights in zip(self.ways, self._weights, strict=True):
            values = way.pool.columns[name]
            if which == 0:
                influence = values - self.summary.mean[column]
            else:
                influence = (values <= self.summary.interval95[which - 1][column]) - TAILS[which - 1]
            squares.append(float(np.sum((weights * influence) ** 2)))
        return np.array(squares) / np.sum(squares)

    def improved(self) -> Mixture | None:
        """Draw more where it helps most; None where the draws suffice or no rounds are left."""
        return self._with_reliable_weights() or (self._with_smaller_error() if self.acceptance.missing else None)

    def _with_reliable_weights(self) -> Mixture | None:
        """Draw otherwise under the first way whose weights are unreliable."""
        first = self.ways[0].pool
        for place, way in enumerate(self.ways[1:], 1):
            rounds = way.pool.rounds
            if way.reliable:
                continue
            if way.shared and rounds < first.rounds:
                return self._with(place, way.extended(first.rounds, first))
            if way.shared and self.left >= ALONE_ROUNDS:
                return self._with(place, way.alone(first), ALONE_ROUNDS)
            if not way.shared and self.probabilities[place] >= WORTH_RELIABLE_WEIGHTS and self.left >= rounds:
                return self._with(place, way.refitted(), rounds)
        return None

    def _with_smaller_error(self) -> Mixture | None:
        """Draw more under the way that lowers the largest error most for its cost."""
        first = self.ways[0].pool
        factor, shares = self.errors[worst(self.errors)].rounds_factor, self.shares_of_error
        cheap = np.array([way.shared and way.pool.rounds < first.rounds for way in self.ways])
        for place in np.argsort(-shares / np.where(cheap, SHARED_COST, 1.0)).tolist():
            if shares[place] < WORTH_DRAWING:
                continue
            way, rounds = self.ways[place], self.ways[place].pool.rounds
            # Of the squared error, 1 - 1 / factor must go, which this way's share may not hold.
            kept = max(1 - (1 - 1 / factor) / shares[place], 0.5) if factor > 1 else 0.5
            wanted = max(rounds + 1, int(np.ceil(min(MARGIN / kept, 2.0) * rounds)))
            if cheap[place]:
                return self._with(place, way.extended(min(wanted, first.rounds), first))
            if self.left > 0:
                # A way that shares all draws of the first has more when that has.
                drawn, further = 0 if way.shared else place, min(wanted - rounds, self.left)
                return self._with(drawn, self.ways[drawn].extended(rounds + further, first), further)
        return None

    def _with(self, place: int, way: Way, drawn: int = 0) -> Mixture:
        """Put other draws of a way, of which so many rounds were drawn."""
        return Mixture((*self.ways[:place], way, *self.ways[place + 1 :]), self.left - drawn)

    def posterior(self) -> Posterior:
        """Build the posterior of all ways."""
        first, verdict = self.ways[0].pool, self.acceptance
        importance = replace(
            first.importance,
            accepted=not verdict.missing,
            missing=verdict.missing,
            pareto_k=verdict.pareto_k,
            heaviest_share=verdict.heaviest,
            answer=verdict.answer,
        )
        parts = [way.pool.density.posterior(way.pool.sample, first.seed) for way in self.ways]
        convergence = replace(parts[0].convergence, importance=importance, monte_carlo_error=self.errors)
        whole, seconds = mixed(parts, self.probabilities), time.monotonic() - first.began
        return replace(whole, convergence=convergence, seconds=seconds)


def homing_mixture(first: Pool[Target]) -> Posterior:
    """Compute the posterior over all homing hypotheses of a fit, from the draws of the most probable one."""
    target, proposal = first.density, first.next_proposal
    shared = [
        Way(Pool(Target(way.fit, target.path), first.seed, proposal, first.began), (place, 0), shared=True)
        for place, way in enumerate(target.fit.mixture[1:], 1)
        if way.fit
    ]
    if not shared:
        return target.posterior(first.sample, first.seed)
    ways = (Way(first), *(way.extended(1, first) for way in shared))
    mixture = Mixture(ways, FURTHER_ROUNDS_MAX if first.importance.accepted else 0)
    while (better := mixture.improved()) is not None:
        mixture = better
    return mixture.posterior()


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
