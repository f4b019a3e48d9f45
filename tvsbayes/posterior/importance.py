"""The posterior by importance sampling: independent draws from a proposal that follows it, weighted (formulation 4.3).

Pilot rounds of draws in the coordinates w of `posterior.transport` teach the proposal: pooled, each draw weighted by
the target over the mixture of all proposals that made them, the balance heuristic (Veach and Guibas, SIGGRAPH 95, 419;
Owen and Zhou, J. Am. Stat. Assoc. 95 (2000) 135), so that a poor first round costs little. They take no part in the
posterior: a proposal fitted to a draw is high where that draw is, whose weight would come out too small (Marin, Pudlo
and Sedki, Bernoulli 25 (2019) 1977). Where the draws of a proposal would take too long to be accepted, they in turn are
the pilot of the next one.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import jax
import numpy as np

from tvsbayes.errors import NotConverged
from tvsbayes.estimators.campaign_arrays import spot_constants
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.likelihood import no_draw
from tvsbayes.instrument.campaign import ordered_spots
from tvsbayes.instrument.homing import prior_chance
from tvsbayes.instrument.parameters import NAMES
from tvsbayes.model.headlines import Derived
from tvsbayes.posterior.draws import Draws, Posterior, derived_of, headline_names, monte_carlo_errors
from tvsbayes.posterior.proposal import Independence, Target, first_proposal, place_normals
from tvsbayes.posterior.transport import Mapped, Transport, transport
from tvsbayes.progress import Advance, OpenEnded, unshown
from tvsbayes.results.convergence import (
    END_ERROR_MAX,
    MEAN_ERROR_MAX,
    Importance,
    MonteCarloError,
    Reweighted,
    extreme,
)
from tvsbayes.statistics.weighted_draws import (
    SmoothedWeights,
    WeightedSummary,
    effective_draws,
    pareto_k,
    smoothed_weights,
    weighted_summary,
)

ROUND = 1024
PILOT_ROUNDS = 2
"""Rounds after each of which the proposal is fitted to all draws so far."""
ROUNDS_MAX = 64
"""All rounds of all proposals: the budget."""
ROUNDS_LEAST = 4
"""Of fewer rounds nobody knows how many effective draws they have."""
PATIENCE = 3
"""A proposal is fitted anew if it would take more than this many times the rounds that it has had."""
K_MAX = 0.7
"""Tail index from which weighted means cannot be trusted, however many the draws ..."""
ROUGH_K_MAX = 1.0
"""... and from which they do not exist (Vehtari et al., J. Mach. Learn. Res. 25 (2024) 72)."""
MAPPED_SHARE = 0.25
"""Of the time, for the map to nearly normal coordinates: what progress predicts with."""
HEAVIEST_MAX, ROUGH_HEAVIEST_MAX = 0.05, 0.2
"""Share of the weight that one draw may have."""


@dataclass(frozen=True)
class Pool:
    """Weighted draws and what they were drawn from.

    Attributes:
        w: draws, shape (n, d), round by round.
        log_target: their log densities as `Target` gives them, shape (n,).
        place_errors_rad: a draw of the errors at places for each, shape (n, e).
        mapped: where they lie in z.
        proposals: that made them; counts: how many each, in order.
        next_proposal: fitted to all of them.
        invalid: draws whose density has no value.
    """

    w: np.ndarray
    log_target: np.ndarray
    place_errors_rad: np.ndarray
    mapped: Mapped
    proposals: tuple[Independence, ...]
    counts: tuple[int, ...]
    next_proposal: Independence
    invalid: int = 0

    @property
    def log_weights(self) -> np.ndarray:
        """Log (target / mixture of the proposals), shape (n,)."""
        each = np.stack([proposal.log_density(self.w) for proposal in self.proposals])
        share = np.log(np.array(self.counts) / len(self.w))
        return self.log_target - np.logaddexp.reduce(each + share[:, None], axis=0)

    @property
    def refitted(self) -> Independence:
        """The next proposal fitted to all draws."""
        return self.next_proposal.fitted(self.w, self.log_target, self.log_weights)

    def extended(self, target: Target, generator: np.random.RandomState, fitted: bool) -> Pool:
        """With another round; the proposal is fitted again if `fitted`."""
        proposal, before = self.next_proposal, target.invalid
        w = proposal.draw(ROUND, generator)
        # A stream of its own: gears without repeating errors leave the draws of w as they are.
        errors = np.random.default_rng([len(self.w), 4])
        valued = target.valued(w, place_normals(ROUND, target.fit, errors))
        proposals, counts = self.proposals, self.counts
        if proposals and proposals[-1] is proposal:
            counts = (*counts[:-1], counts[-1] + ROUND)
        else:
            proposals, counts = (*proposals, proposal), (*counts, ROUND)
        found = Pool(
            np.concatenate([self.w, w]),
            np.concatenate([self.log_target, valued.log_target]),
            np.concatenate([self.place_errors_rad, valued.place_errors_rad]),
            Mapped.joined([self.mapped, valued.mapped]),
            proposals,
            counts,
            proposal,
            self.invalid + target.invalid - before,
        )
        if not np.isfinite(found.log_target).sum() > 8 * w.shape[1]:
            raise FloatingPointError("the posterior density is not finite around the mode")
        if fitted:
            found = replace(found, next_proposal=found.refitted)
        return found


def empty_pool(target: Target, proposal: Independence | None = None) -> Pool:
    """Before the first round: from a proposal, or from the first."""
    path = target.path
    dimension = path.dimension
    first = proposal or first_proposal(target, dimension, path.heavy, path.coupled)
    errors, nowhere = no_draw(0, target.fit.arrays), Mapped(np.zeros((0, len(path.mode))), np.zeros(0))
    return Pool(np.zeros((0, dimension)), np.zeros(0), errors, nowhere, (), (), first)


def piloted(target: Target, generator: np.random.RandomState) -> Pool:
    """Without draws, from the proposal that the pilot rounds arrive at."""
    pilot = empty_pool(target)
    for _ in range(PILOT_ROUNDS):
        pilot = pilot.extended(target, generator, fitted=True)
    return replace(empty_pool(target, pilot.next_proposal), invalid=pilot.invalid)


def log_evidence(fit: JointFit, path: Transport, log_weights: np.ndarray) -> float:
    """Log of the integral of likelihood times prior over the free parameters.

    The mean weight is the integral of exp(log density - that at the mode) over w; |det root| takes it to the
    coordinates z, whose normal priors `likelihood.log_density` has without their constants.
    """
    highest = np.max(log_weights)
    integral = highest + np.log(np.mean(np.exp(log_weights - highest)))
    used = np.asarray(fit.arrays.spots.valid)[: len(ordered_spots(fit.campaign))] > 0
    constants = float(spot_constants(fit.campaign)[used].sum()) - 0.5 * path.dimension * np.log(2 * np.pi)
    # What is held fixed has no prior to be integrated over.
    held = 0.5 * float(np.sum(fit.z[~fit.free] ** 2))
    volume = float(np.sum(np.log(np.diag(path.root))))
    return float(integral + volume + fit.log_density + constants + held)


@dataclass(frozen=True)
class Weighing:
    """A pool by the weights of its draws: whether they may be used, which a look at the headlines says, and for what.

    Attributes:
        fit: whose posterior it is.
        path: in whose coordinates w was drawn.
        pool: the draws.
    """

    fit: JointFit
    path: Transport
    pool: Pool

    @cached_property
    def log_weights(self) -> np.ndarray:
        """Of all draws, shape (n,)."""
        return self.pool.log_weights

    @cached_property
    def finite(self) -> np.ndarray:
        """Draws whose density has a value, shape (n,); only these have weights."""
        return np.isfinite(self.log_weights)

    @cached_property
    def smoothed(self) -> SmoothedWeights:
        """Weights, and their tail index."""
        return smoothed_weights(self.log_weights[self.finite])

    @cached_property
    def derived(self) -> Derived:
        """Parameters and headlines, with the axes of one chain."""
        drawn = self.pool.mapped.z[self.finite], self.pool.place_errors_rad[self.finite]
        return derived_of(self.fit, *(each[None] for each in drawn))

    @cached_property
    def log_density(self) -> np.ndarray:
        """In z."""
        density = self.pool.log_target + self.fit.log_density - self.pool.mapped.log_jacobian
        return density[self.finite]

    @cached_property
    def columns(self) -> dict[str, np.ndarray]:
        """Draws of every quantity that is not the same in all of them."""
        every = {**Draws(self.derived), "log_density": self.log_density}
        fixed = {NAMES[i] for i in np.flatnonzero(~self.fit.free)}
        return {name: column for name, column in every.items() if name not in fixed and np.ptp(column) > 0}

    def summary(self, names: Sequence[str]) -> WeightedSummary:
        """Of the columns of those names."""
        return weighted_summary(np.stack([self.columns[name] for name in names], axis=1), self.smoothed.weights)

    @cached_property
    def headlines(self) -> tuple[str, ...]:
        """What the draws are judged by; all quantities where no headline is left open."""
        return tuple(name for name in headline_names(self.fit) if name in self.columns) or tuple(self.columns)

    @cached_property
    def monte_carlo_error(self) -> dict[str, MonteCarloError]:
        """Of every headline."""
        return monte_carlo_errors(self.headlines, self.summary(self.headlines))

    @cached_property
    def importance(self) -> Importance:
        """The weights judged by the headlines."""
        summary = self.summary(self.headlines)
        raw = np.exp(self.log_weights - np.max(self.log_weights))
        kish, count = effective_draws(raw), len(self.log_weights)
        deviations = {n: self.columns[n] - mean for n, mean in zip(self.headlines, summary.mean, strict=True)}
        pareto, heaviest = self.smoothed.pareto_k, float(np.max(self.smoothed.weights))
        missing = lacking(pareto, heaviest, count, self.monte_carlo_error)
        rough = (
            pareto < ROUGH_K_MAX
            and heaviest <= ROUGH_HEAVIEST_MAX
            and all(e.roughly_known for e in self.monte_carlo_error.values())
        )
        return Importance(
            accepted=not missing,
            missing=missing,
            rounds=count // ROUND,
            draws=count,
            effective_share=kish / count,
            least_ess=extreme(dict(zip(self.headlines, summary.ess_least.tolist(), strict=True)), min),
            pareto_k=pareto,
            worst_pareto_k=extreme({name: pareto_k(raw[self.finite] * x**2) for name, x in deviations.items()}, max),
            heaviest_share=heaviest,
            log_evidence=log_evidence(self.fit, self.path, self.log_weights),
            log_evidence_mcse=float(np.sqrt(max(1 / kish - 1 / count, 0.0))),
            invalid_evaluations=self.pool.invalid,
            answer="accepted" if not missing else "rough" if rough else "laplace",
        )

    @property
    def rounds_wanted(self) -> float:
        """How many rounds of the same proposal an accepted answer takes, as far as the draws say."""
        found = self.importance
        factor = max(e.rounds_factor for e in self.monte_carlo_error.values())
        return found.rounds * max(factor, found.heaviest_share / HEAVIEST_MAX)

    def posterior(self, seed: int, seconds: float) -> Posterior:
        """All of them; `seed` of their generator, `seconds` spent on them."""
        every = self.summary(list(self.columns))
        convergence = Reweighted(
            self.importance,
            dict(zip(self.columns, every.ess_mean.tolist(), strict=True)),
            dict(zip(self.columns, every.ess_interval95.min(axis=0).tolist(), strict=True)),
            self.monte_carlo_error,
        )
        z, weights = self.pool.mapped.z[self.finite][None], self.smoothed.weights[None]
        return Posterior(self.fit, z, self.log_density[None], self.derived, weights, convergence, seed, seconds)


def k_max(draws: int) -> float:
    """Largest tail index with which the smoothed weights of so many draws can be trusted (Vehtari et al. 2024, 3.2)."""
    return min(1 - 1 / np.log10(draws), K_MAX)


def lacking(pareto: float, heaviest: float, draws: int, errors: Mapping[str, MonteCarloError]) -> tuple[str, ...]:
    """What an accepted answer lacks, in sentences.

    Args:
        pareto: tail index of the weights.
        heaviest: share of the weight in one draw.
        draws: their number.
        errors: Monte Carlo errors of every headline.
    """
    missing, limit = [], k_max(draws)
    if not pareto < limit:
        missing.append(f"the weights of importance sampling have Pareto k {pareto:.2f}, wanted below {limit:.2f}")
    if not heaviest <= HEAVIEST_MAX:
        wanted = f"wanted at most {100 * HEAVIEST_MAX:.0f} %"
        missing.append(f"one draw holds {100 * heaviest:.1f} % of the weight, {wanted}")
    return (*missing, *uncertain(errors))


def uncertain(errors: Mapping[str, MonteCarloError]) -> tuple[str, ...]:
    """The headline that sampling knows worst, in a sentence; none where all are known well enough."""
    bad = {name: e for name, e in errors.items() if not e.within(MEAN_ERROR_MAX, END_ERROR_MAX)}
    if not bad:
        return ()
    name = max(bad, key=lambda each: bad[each].rounds_factor)
    mean, ends = bad[name].mean, max(bad[name].interval95)
    wanted = f"wanted at most {MEAN_ERROR_MAX:g} and {END_ERROR_MAX:g}"
    return (f"sampling knows the mean of {name} to {mean:.2f} sd and its interval's ends to {ends:.2f} sd, {wanted}",)


@dataclass(frozen=True)
class ImportanceRun:
    """What importance sampling leaves for a chain: the map, the pool of draws, and the posterior by them."""

    path: Transport
    pool: Pool
    posterior: Posterior

    @cached_property
    def proposal(self) -> Independence:
        """Fitted to all draws: a chain that starts from them is right whatever it is proposed."""
        return self.pool.refitted

    def starts(self, count: int) -> np.ndarray:
        """Weighted draws of w without replacement, shape (count, d)."""
        log_weights = self.pool.log_weights
        generator = np.random.RandomState(self.posterior.seed)
        # Gumbel's trick: the largest perturbed weights are a weighted sample without replacement.
        keys = np.where(np.isfinite(log_weights), log_weights, -np.inf) + generator.gumbel(size=len(log_weights))
        return self.pool.w[np.argsort(-keys)[:count]]


def importance_run(
    fit: JointFit,
    seed: int,
    advance: Advance = unshown,
    rounds_max: int = ROUNDS_MAX,
    rounds_least: int | None = None,
) -> ImportanceRun:
    """Draw rounds until the answer is accepted; where that would take too long, from a proposal fitted anew.

    Args:
        fit: a converged fit.
        seed: of the draws.
        advance: told how far it is.
        rounds_max: of all proposals together.
        rounds_least: of the proposal that gives the answer, by default `ROUNDS_LEAST`.

    Raises:
        NotConverged: the density is not finite around the mode.
    """
    began = time.monotonic()
    generator = np.random.RandomState(seed)
    drawn = OpenEnded()
    path = transport(fit)
    advance(MAPPED_SHARE)
    target = Target(fit, path)
    try:
        pool = piloted(target, generator)
        wanted = ROUNDS_LEAST if rounds_least is None else rounds_least
        total, rounds, patience = PILOT_ROUNDS, 0, PATIENCE * wanted
        while True:
            while rounds < wanted:
                rounds, total = rounds + 1, total + 1
                pool = pool.extended(target, generator, fitted=False)
                advance(MAPPED_SHARE + (1 - MAPPED_SHARE) * drawn.share(total, total + wanted - rounds))
            weighed = Weighing(fit, path, pool)
            left = rounds_max - total
            if weighed.importance.accepted or left <= 0:
                return ImportanceRun(path, pool, weighed.posterior(seed, time.monotonic() - began))
            needed = weighed.rounds_wanted
            if needed > patience and left >= 2 * rounds:
                # These draws teach the next proposal, which is allowed twice as many.
                pool = replace(empty_pool(target, pool.refitted), invalid=pool.invalid)
                rounds, wanted, patience = 0, min(2 * rounds, left), 2 * patience
            else:
                # Few draws do not say well how many more it takes.
                wanted = min(rounds + left, max(rounds + 1, int(min(np.ceil(1.1 * needed), 2 * rounds))))
    except FloatingPointError as error:
        raise NotConverged("no-density", str(error), remedy="see the weak directions of --no-sample") from error


SHARED_DRAWS_LEAST = 2 * ROUND
"""Draws of one way of homing, at least, by which another one is known."""
SHARED_MARGIN = 2.0
"""A way of homing takes so many times the draws that its share of the posterior asks for."""
BESIDE_ROUNDS_MAX = 12
"""Of a way of homing that is sampled by itself."""


def run_beside(fit: JointFit, run: ImportanceRun, seed: int) -> Posterior:
    """The posterior under another way of homing, from the draws of the most probable one weighted anew.

    Both posteriors mostly lie over each other. Where they do not, the other one is sampled by itself.

    Args:
        fit: under the other way.
        run: of the most probable way.
        seed: of draws of the errors at places.
    """
    began, first = time.monotonic(), run.posterior.fit.mixture[0].probability
    share = next(way.probability for way in run.posterior.fit.mixture if way.sides == fit.sides) / first
    count, every = int(max(SHARED_MARGIN * share * len(run.pool.w), SHARED_DRAWS_LEAST)), len(run.pool.w)
    for some in dict.fromkeys((min(count, every), every)):
        weighed = _weighed_anew(fit, run, some, seed)
        error = max(e.rounds_factor for e in weighed.monte_carlo_error.values())
        # An error of a part is as large in the whole as the part.
        if weighed.importance.pareto_k < K_MAX and error * share**2 <= 1:
            return weighed.posterior(seed, time.monotonic() - began)
    return importance_run(fit, seed, rounds_max=BESIDE_ROUNDS_MAX).posterior


def _weighed_anew(fit: JointFit, run: ImportanceRun, count: int, seed: int) -> Weighing:
    """The first draws of a run, weighted by the density under another way of homing."""
    target, pool = Target(fit, run.path), run.pool
    mapped = Mapped(pool.mapped.z[:count], pool.mapped.log_jacobian[:count])
    valued = target.at(mapped, place_normals(count, fit, np.random.default_rng([seed, 6])))
    own = replace(
        pool,
        w=pool.w[:count],
        log_target=valued.log_target,
        place_errors_rad=valued.place_errors_rad,
        mapped=mapped,
        counts=(count,),
        invalid=target.invalid,
    )
    return Weighing(fit, run.path, own)


def mixed(parts: Sequence[Posterior]) -> Posterior:
    """One posterior of the fits under several ways of homing, by their evidence and prior probabilities.

    Args:
        parts: by importance sampling, of `JointFit.mixture` in its order.
    """
    first = parts[0]
    evidence = np.array([part.convergence.importance.log_evidence for part in parts])
    evidence += np.log([prior_chance(part.fit.sides) for part in parts])
    chance = np.exp(evidence - evidence.max())
    chance /= chance.sum()
    ways = tuple(
        replace(way, probability=float(p))
        for way, p in zip([way for way in first.fit.mixture if way.fit is not None], chance, strict=True)
    )
    return replace(
        first,
        fit=replace(first.fit, alternatives=ways),
        z=np.concatenate([part.z for part in parts], axis=1),
        log_density=np.concatenate([part.log_density for part in parts], axis=1),
        draws=jax.tree.map(lambda *each: np.concatenate(each, axis=1), *(part.draws for part in parts)),
        weights=np.concatenate([p * part.weights for p, part in zip(chance, parts, strict=True)], axis=1),
        convergence=_joined(parts, chance),
        way=np.concatenate([np.full(part.weights.shape, k) for k, part in enumerate(parts)], axis=1),
        seconds=sum(part.seconds for part in parts),
    )


def _joined(parts: Sequence[Posterior], chance: np.ndarray) -> Reweighted:
    """The diagnosis of a mixture: that of its first part, with the Monte Carlo errors of all.

    Parts share draws; one that several have weighs what all of them give it.
    """
    first = parts[0]
    diagnosis = first.convergence
    assert isinstance(diagnosis, Reweighted)
    names = list(diagnosis.monte_carlo_error)
    if not names:
        return diagnosis
    weights, rows = [chance[0] * first.weights[0]], [np.stack([first.by_name[name] for name in names], axis=1)]
    for p, part in zip(chance[1:], parts[1:], strict=True):
        count = part.weights.size
        if np.array_equal(part.z[0], first.z[0, :count]):
            weights[0][:count] += p * part.weights[0]
        else:
            weights.append(p * part.weights[0])
            rows.append(np.stack([part.by_name[name] for name in names], axis=1))
    errors = monte_carlo_errors(names, weighted_summary(np.concatenate(rows), np.concatenate(weights)))
    unknown, known = uncertain(errors), diagnosis.importance
    if unknown and known.accepted:
        rough = all(error.roughly_known for error in errors.values())
        known = replace(known, accepted=False, missing=unknown, answer="rough" if rough else "laplace")
    return replace(diagnosis, importance=known, monte_carlo_error=errors)
