"""The posterior by importance sampling: weighted independent draws from a proposal close to it (formulation 4.3).

Where the draws of a proposal would take too long to be accepted, the next proposal is fitted to them, and they are left
out of the posterior. A proposal fitted to a draw is high at that draw, whose weight would then be too small (Marin,
Pudlo and Sedki, Bernoulli 25 (2019) 1977). For densities that the first proposal fits badly, pilot rounds adapt it
before. Their draws are pooled, each weighted by the target over the mixture of all proposals, the balance heuristic
(Veach and Guibas, SIGGRAPH 95, 419; Owen and Zhou, J. Am. Stat. Assoc. 95 (2000) 135), so that a poor first round costs
little.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from tvsbayes.errors import NotConverged
from tvsbayes.inference.density import NO_POINTS, Density, Points, Proposal, columns_of
from tvsbayes.inference.summaries import monte_carlo_errors
from tvsbayes.progress import Advance, OpenEnded, unshown
from tvsbayes.results.convergence import (
    END_ERROR_MAX,
    MEAN_ERROR_MAX,
    Convergence,
    Importance,
    MonteCarloError,
    Reweighted,
    extreme,
)
from tvsbayes.results.records import AnswerKind, Tier
from tvsbayes.statistics.streams import Stream, random_stream
from tvsbayes.statistics.weighted_draws import (
    SmoothedWeights,
    WeightedSummary,
    effective_draws,
    pareto_k,
    smoothed_weights,
    systematic,
    weighted_summary,
)

ROUND = 1024
"""Draws of a round."""
PILOT_ROUNDS = 2
"""Least number of pilot rounds, where there are any; after each the proposal is fitted to all draws so far."""
PILOT_EFFECTIVE = 200.0
"""Effective sample size that the pilot draws must reach."""
ROUNDS_MAX = 64
"""Largest number of rounds of all proposals."""
ROUNDS_LEAST = 3
"""Least number of rounds: fewer do not determine their effective sample size."""
PATIENCE = 3
"""A new proposal is fitted if the present one would need more than this many times its rounds so far."""
K_MAX = 0.7
"""Tail index from which weighted means are unreliable for any number of draws (Vehtari et al. 2024, as below)."""
ROUGH_K_MAX = 1.0
"""Tail index from which weighted means do not exist (Vehtari et al., J. Mach. Learn. Res. 25 (2024) 72)."""
HEAVIEST_MAX, ROUGH_HEAVIEST_MAX = 0.05, 0.2
"""Share of the weight that one draw may have."""


@dataclass(frozen=True)
class Sample:
    """A sampled posterior.

    Attributes:
        points: draws, chains joined.
        quantities: quantities of all draws by name, shapes (n,).
        weights: weights of the draws, sum 1, shape (chain, draw).
        convergence: the diagnosis.
        seconds: time spent on it.
    """

    points: Points
    quantities: Mapping[str, np.ndarray]
    weights: np.ndarray
    convergence: Convergence | Reweighted
    seconds: float

    @property
    def tier(self) -> Tier:
        """Return the tier of the draws: weighted independent draws, or equally weighted ones of a chain."""
        return self.convergence.tier

    def equal(self, count: int, generator: np.random.Generator) -> np.ndarray:
        """Resample coordinates (count, d) with equal weights, in random order."""
        return self.points.w[generator.permutation(systematic(self.weights.ravel(), count, generator.random()))]


def k_max(draws: int) -> float:
    """Compute the largest tail index at which this many smoothed weights are reliable (Vehtari et al. 2024, 3.2)."""
    return min(1 - 1 / np.log10(draws), K_MAX)


@dataclass(frozen=True)
class Acceptance:
    """What weighted draws are judged by, and the answer that they allow.

    Attributes:
        pareto_k: tail index of the weights.
        heaviest: share of the weight in one draw.
        draws: their number.
        errors: Monte Carlo errors of every headline.
    """

    pareto_k: float
    heaviest: float
    draws: int
    errors: Mapping[str, MonteCarloError]

    @cached_property
    def missing(self) -> tuple[str, ...]:
        """Say in sentences which limits of an accepted answer are not met."""
        missing, limit = [], k_max(self.draws)
        if not self.pareto_k < limit:
            found = f"Pareto k {self.pareto_k:.2f}, wanted below {limit:.2f}"
            missing.append(f"the weights of importance sampling have {found}")
        if not self.heaviest <= HEAVIEST_MAX:
            wanted = f"wanted at most {100 * HEAVIEST_MAX:.0f} %"
            missing.append(f"one draw holds {100 * self.heaviest:.1f} % of the weight, {wanted}")
        return (*missing, *uncertain(self.errors))

    @property
    def answer(self) -> AnswerKind:
        """Return the answer."""
        if not self.missing:
            return "accepted"
        known = all(error.roughly_known for error in self.errors.values())
        return "rough" if self.pareto_k < ROUGH_K_MAX and self.heaviest <= ROUGH_HEAVIEST_MAX and known else "laplace"


def worst(errors: Mapping[str, MonteCarloError]) -> str:
    """Return the headline of the largest Monte Carlo error, by the draws that it needs."""
    return max(errors, key=lambda name: errors[name].rounds_factor)


def uncertain(errors: Mapping[str, MonteCarloError]) -> tuple[str, ...]:
    """Name in a sentence the headline of the largest Monte Carlo error; none where all errors are within limits."""
    bad = {name: e for name, e in errors.items() if not e.within(MEAN_ERROR_MAX, END_ERROR_MAX)}
    if not bad:
        return ()
    name = worst(bad)
    mean, ends = bad[name].mean, max(bad[name].interval95)
    wanted = f"wanted at most {MEAN_ERROR_MAX:g} and {END_ERROR_MAX:g}"
    return (f"Monte Carlo error of {name}: {mean:.2f} sd of its mean, {ends:.2f} sd of its interval's ends, {wanted}",)


@dataclass(frozen=True)
class Pool[D: Density]:
    """Rounds of weighted draws of a density, from which a chain may start.

    Attributes:
        density: density of the posterior.
        seed: seed of all random numbers.
        next_proposal: proposal of the next round.
        drawn: draws, round by round.
        proposals: proposals of the draws; counts: draws of each, in order.
        began: moment at which the work on them began, by `time.monotonic`.
        invalid: draws whose density has no value.
    """

    density: D
    seed: int
    next_proposal: Proposal
    began: float
    drawn: Points = NO_POINTS
    proposals: tuple[Proposal, ...] = ()
    counts: tuple[int, ...] = ()
    invalid: int = 0

    @property
    def refitted(self) -> Self:
        """Return a pool before its first round, with the proposal fitted to the draws of this one."""
        return replace(self, next_proposal=self.proposal, drawn=NO_POINTS, proposals=(), counts=())

    def extended(self, generator: np.random.RandomState) -> Self:
        """Add another round."""
        proposal, before = self.next_proposal, self.density.invalid
        # A separate stream, since drawing the quantities integrated out must not change the draws of w; its seed is
        # the state of the generator, which no other round of this or of another seed has.
        _, key, place, *_ = generator.get_state()
        integrated_out = random_stream(int(place), Stream.POOLED_ROUNDS, *key.tolist())
        drawn = Points.joined([self.drawn, self.density.valued(proposal.draw(ROUND, generator), integrated_out)])
        if not np.isfinite(drawn.log_target).sum() > 8 * drawn.w.shape[1]:
            raise FloatingPointError("the posterior density is not finite around the mode")
        proposals, counts = self.proposals, self.counts
        if proposals and proposals[-1] is proposal:
            proposals, counts, last = proposals[:-1], counts[:-1], counts[-1]
        else:
            last = 0
        return replace(
            self,
            drawn=drawn,
            proposals=(*proposals, proposal),
            counts=(*counts, last + ROUND),
            invalid=self.invalid + self.density.invalid - before,
        )

    @property
    def rounds(self) -> int:
        """Return the number of rounds."""
        return sum(self.counts) // ROUND

    @cached_property
    def log_weights(self) -> np.ndarray:
        """Compute log (target / mixture of the proposals) of all draws, shape (n,)."""
        each = np.stack([proposal.log_density(self.drawn.w) for proposal in self.proposals])
        share = np.log(np.array(self.counts) / len(self.drawn))
        return self.drawn.log_target - np.logaddexp.reduce(each + share[:, None], axis=0)

    @cached_property
    def proposal(self) -> Proposal:
        """Fit the proposal to all draws; a chain is valid for any proposal."""
        return self.next_proposal.fitted(self.drawn.w, self.drawn.log_target, self.log_weights)

    @cached_property
    def finite(self) -> np.ndarray:
        """Mark draws whose density has a value, shape (n,); only these have weights."""
        return np.isfinite(self.log_weights)

    @cached_property
    def smoothed(self) -> SmoothedWeights:
        """Compute smoothed weights and their tail index."""
        return smoothed_weights(self.log_weights[self.finite])

    @cached_property
    def points(self) -> Points:
        """Return the draws that have weights."""
        return self.drawn.taken(self.finite)

    @cached_property
    def columns(self) -> dict[str, np.ndarray]:
        """Return draws of every quantity that varies."""
        return columns_of(self.density, self.points)

    @cached_property
    def headlines(self) -> tuple[str, ...]:
        """Return the headlines by which the draws are judged; all quantities where no headline varies."""
        return tuple(name for name in self.density.headlines if name in self.columns) or tuple(self.columns)

    @cached_property
    def summary(self) -> WeightedSummary:
        """Summarise the headlines."""
        return self._summary(self.headlines)

    def _summary(self, names: Sequence[str]) -> WeightedSummary:
        return weighted_summary(np.stack([self.columns[name] for name in names], axis=1), self.smoothed.weights)

    @cached_property
    def errors(self) -> dict[str, MonteCarloError]:
        """Compute the Monte Carlo error of every headline."""
        return monte_carlo_errors(self.headlines, self.summary)

    @property
    def log_evidence(self) -> float:
        """Compute the log of the integral of likelihood times prior, by the mean weight and the density's constants."""
        highest = np.max(self.log_weights)
        return float(highest + np.log(np.mean(np.exp(self.log_weights - highest))) + self.density.log_constant)

    @cached_property
    def importance(self) -> Importance:
        """Judge the weights by the headlines."""
        raw, headlines = np.exp(self.log_weights - np.max(self.log_weights)), self.headlines
        kish, count, heaviest = effective_draws(raw), len(raw), float(np.max(self.smoothed.weights))
        acceptance = Acceptance(self.smoothed.pareto_k, heaviest, count, self.errors)
        off = {name: self.columns[name] - mean for name, mean in zip(headlines, self.summary.mean, strict=True)}
        return Importance(
            accepted=not acceptance.missing,
            missing=acceptance.missing,
            rounds=self.rounds,
            draws=count,
            effective_share=kish / count,
            least_ess=extreme(dict(zip(headlines, self.summary.ess_least.tolist(), strict=True)), min),
            pareto_k=acceptance.pareto_k,
            worst_pareto_k=extreme({name: pareto_k(raw[self.finite] * x**2) for name, x in off.items()}, max),
            heaviest_share=heaviest,
            log_evidence=self.log_evidence,
            log_evidence_mcse=float(np.sqrt(max(1 / kish - 1 / count, 0.0))),
            invalid_evaluations=self.invalid,
            answer=acceptance.answer,
        )

    @property
    def rounds_wanted(self) -> float:
        """Estimate from the draws how many rounds of the same proposal an accepted answer needs."""
        factor = self.errors[worst(self.errors)].rounds_factor
        return self.rounds * max(factor, self.importance.heaviest_share / HEAVIEST_MAX)

    @cached_property
    def sample(self) -> Sample:
        """Return the draws that have weights as a sample, with the effective draws of every quantity."""
        every = self._summary(list(self.columns))
        ess = (every.ess_mean, every.ess_interval95.min(axis=0))
        bulk, tail = (dict(zip(self.columns, each.tolist(), strict=True)) for each in ess)
        convergence = Reweighted(self.importance, bulk, tail, self.errors)
        weights, quantities = self.smoothed.weights[None], self.density.quantities(self.points)
        return Sample(self.points, quantities, weights, convergence, time.monotonic() - self.began)

    def starts(self, count: int) -> np.ndarray:
        """Draw starts w of a chain by weight without replacement, shape (count, d)."""
        generator = np.random.RandomState(self.seed)
        # Gumbel's trick: the largest perturbed weights are a weighted sample without replacement.
        keys = np.where(self.finite, self.log_weights, -np.inf) + generator.gumbel(size=len(self.log_weights))
        return self.drawn.w[np.argsort(-keys)[:count]]


def piloted[D: Density](pool: Pool[D], generator: np.random.RandomState, rounds_max: int) -> Pool[D]:
    """Fit the proposal of an empty pool in pilot rounds.

    The proposal of a round is fitted to all rounds before it. Rounds continue until their effective sample size is
    `PILOT_EFFECTIVE`, at most `rounds_max`: a density far from the first proposal needs many.
    """
    for number in range(1, rounds_max + 1):
        pool = pool.extended(generator)
        pool = replace(pool, next_proposal=pool.proposal)
        if PILOT_ROUNDS <= number < rounds_max:
            smooth = pool.smoothed
            if smooth.pareto_k < K_MAX and effective_draws(smooth.weights) >= PILOT_EFFECTIVE:
                break
    return replace(pool, drawn=NO_POINTS, proposals=(), counts=())


def weighted_run[D: Density](
    density: D,
    seed: int,
    advance: Advance = unshown,
    rounds_max: int = ROUNDS_MAX,
    rounds_least: int | None = None,
    pilots_max: int = 0,
    began: float | None = None,
) -> Pool[D]:
    """Draw rounds until the answer is accepted; where that would take too long, from a newly fitted proposal.

    Args:
        density: density about a mode.
        seed: seed of the draws.
        advance: called with the share that is done.
        rounds_max: rounds of all proposals together.
        rounds_least: rounds of the proposal that gives the answer, by default `ROUNDS_LEAST`.
        pilots_max: pilot rounds at most, as in `piloted`.
        began: moment at which work began, by default now.

    Raises:
        NotConverged: the density is not finite around the mode.
    """
    began, generator, drawn = began or time.monotonic(), np.random.RandomState(seed), OpenEnded()
    try:
        pool = piloted(Pool(density, seed, density.first_proposal(), began), generator, pilots_max)
        begun = wanted = ROUNDS_LEAST if rounds_least is None else rounds_least
        left, patience = rounds_max, PATIENCE * wanted
        while True:
            while pool.rounds < wanted:
                pool, left = pool.extended(generator), left - 1
                advance(drawn.share(rounds_max - left, rounds_max - left + wanted - pool.rounds))
            if pool.importance.accepted or left <= 0:
                return pool
            rounds, needed, heavy = pool.rounds, pool.rounds_wanted, not pool.importance.pareto_k < K_MAX
            if (needed > patience or (heavy and rounds >= 2 * begun)) and left >= 2 * rounds:
                # The next proposal is fitted to these draws and may use twice as many.
                pool, begun, wanted, patience = pool.refitted, rounds, rounds, 2 * patience
            elif heavy and rounds < 2 * begun <= rounds + left:
                # More draws hardly change the tail index, but a proposal fitted to them may.
                wanted = 2 * begun
            else:
                # Few draws predict the rounds needed poorly: draw about half of them, then judge again.
                more = max(rounds + 1, rounds * 9 // 8, int(min(np.ceil(0.5 * (rounds + 1.1 * needed)), 2 * rounds)))
                wanted = min(rounds + left, more)
    except FloatingPointError as error:
        raise NotConverged("no-density", str(error), remedy="see the weak directions of --no-sample") from error
