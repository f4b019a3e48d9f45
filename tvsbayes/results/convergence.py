"""Whether a sampled posterior may be used: its diagnosis by quantity, and what `fit.json` says of it under `sampling`.

Lengths in steps of the sampler; effective draws and R-hat by contract name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tvsbayes.results.records import AnswerKind, Count, FromOne, NotNegative, Tier
from tvsbayes.results.tiers import CHAIN, IMPORTANCE

MEAN_ERROR_MAX, END_ERROR_MAX = 0.1, 0.2
"""Monte Carlo standard error of a headline's mean and of the ends of its 95 % interval, in its sd, with which an answer
is accepted: the first widens the interval by 0.5 %, the second moves an end by a digit that is not printed."""
ROUGH_MEAN_ERROR_MAX, ROUGH_END_ERROR_MAX = 0.3, 0.6
"""The same of a rough answer: the first widens an interval by 4 %, the second misses an end by a third of its distance
from the mean, but seldom."""


@dataclass(frozen=True)
class NamedValue:
    """The extreme of a diagnosis, and the quantity that has it."""

    quantity: str
    value: float


@dataclass(frozen=True)
class MonteCarloError:
    """How far sampling alone may have moved what is said of a quantity, standard errors in its posterior sd.

    Attributes:
        mean: of its mean.
        interval95: of the ends of its 95 % interval, low and high.
    """

    mean: NotNegative
    interval95: tuple[NotNegative, NotNegative]

    def within(self, mean: float, end: float) -> bool:
        """Whether neither the mean nor an end has a larger error; an error that is no number is too large."""
        return self.mean <= mean and all(each <= end for each in self.interval95)

    @property
    def roughly_known(self) -> bool:
        """Whether the errors leave a rough answer."""
        return self.within(ROUGH_MEAN_ERROR_MAX, ROUGH_END_ERROR_MAX)

    @property
    def rounds_factor(self) -> float:
        """How many times as many draws an accepted answer takes."""
        return max(self.mean / MEAN_ERROR_MAX, *(each / END_ERROR_MAX for each in self.interval95)) ** 2


@dataclass(frozen=True)
class Importance:
    """Importance sampling: draws and what their weights are worth.

    Attributes:
        accepted: its intervals may be used.
        missing: sentences on why not.
        rounds, draws: how many were made.
        effective_share: equal draws that the weights are worth, over the draws.
        least_ess: least effective draws of a headline's mean, sd or interval ends.
        pareto_k: tail index of the weights.
        worst_pareto_k: largest tail index of a headline's squared deviations times weights.
        heaviest_share: of the weight, in one draw.
        log_evidence: log of the integral of likelihood and prior; likelihoods have the constants of
            `estimators.campaign_arrays.spot_constants`, and ranges are flat in image displacement.
        log_evidence_mcse: its Monte Carlo standard error.
        invalid_evaluations: draws whose density has no value.
        answer: what the draws are good for.
    """

    accepted: bool
    missing: tuple[str, ...]
    rounds: FromOne
    draws: FromOne
    effective_share: NotNegative
    least_ess: NamedValue
    pareto_k: float
    worst_pareto_k: NamedValue
    heaviest_share: NotNegative
    log_evidence: float
    log_evidence_mcse: NotNegative
    invalid_evaluations: Count
    answer: AnswerKind | None = None


@dataclass(frozen=True)
class Agreement:
    """Whether a chain and importance sampling say the same of every headline.

    Attributes:
        agrees: `worst` lies below `limit`.
        limit: in Monte Carlo standard errors of both.
        worst: largest difference of a headline's mean or interval end, in the same unit.
    """

    agrees: bool
    limit: float
    worst: NamedValue


@dataclass(frozen=True)
class Sampling:
    """The diagnosis of a posterior in brief; fields of a chain as in `Convergence`, None where there is no chain.

    Attributes:
        missing: sentences on what is not reached.
        acceptance: mean over walkers.
        least_acceptance: of the worst walker.
        agreement: None where importance sampling was not accepted, or alone.
    """

    converged: bool
    missing: tuple[str, ...]
    walkers: FromOne | None
    steps: Count | None
    discarded: Count | None
    thin: FromOne | None
    tau_steps: float | None
    worst_rhat: NamedValue | None
    least_ess_bulk: NamedValue
    least_ess_tail: NamedValue
    acceptance: NotNegative | None
    least_acceptance: NotNegative | None
    stuck_walkers: tuple[Count, ...]
    invalid_evaluations: Count
    proposal_pareto_k: float
    importance: Importance | None = None
    agreement: Agreement | None = None


def extreme(of: dict[str, float], chosen: Callable[..., str]) -> NamedValue:
    """The largest (`max`) or least (`min`) entry with its name."""
    name = chosen(of, key=lambda each: of[each])
    return NamedValue(name, of[name])


@dataclass(frozen=True)
class Reweighted:
    """Whether weighted draws may be used alone.

    Attributes:
        importance: their diagnosis.
        ess_bulk, ess_tail: effective draws of the mean and of the worse end of the interval, by contract name.
        monte_carlo_error: of every headline.
    """

    tier: ClassVar[Tier] = IMPORTANCE
    importance: Importance
    ess_bulk: dict[str, float]
    ess_tail: dict[str, float]
    monte_carlo_error: dict[str, MonteCarloError]

    @property
    def answer(self) -> AnswerKind:
        """What the draws are good for: their intervals, these roughly, or nothing."""
        return self.importance.answer or "laplace"

    @property
    def rhat(self) -> dict[str, float]:
        """Independent draws have none."""
        return {}

    @property
    def missing(self) -> tuple[str, ...]:
        """Sentences on what is not reached; empty when accepted."""
        return self.importance.missing

    @property
    def converged(self) -> bool:
        """There is a sampled answer, accepted or rough."""
        return self.answer != "laplace"

    @property
    def sampling(self) -> Sampling:
        """What is said of the draws."""
        return Sampling(
            converged=self.converged,
            missing=self.missing,
            walkers=None,
            steps=None,
            discarded=None,
            thin=None,
            tau_steps=None,
            worst_rhat=None,
            least_ess_bulk=extreme(self.ess_bulk, min),
            least_ess_tail=extreme(self.ess_tail, min),
            acceptance=None,
            least_acceptance=None,
            stuck_walkers=(),
            invalid_evaluations=self.importance.invalid_evaluations,
            proposal_pareto_k=self.importance.pareto_k,
            importance=self.importance,
        )


@dataclass(frozen=True)
class Convergence:
    """Whether a chain may be used, and why not.

    Attributes:
        steps: length of the chain; discarded: first steps left out; thin: one in so many is stored.
        tau_steps: longest integrated autocorrelation time.
        rhat: over groups of walkers, by contract name, of every sampled or derived quantity.
        ess_bulk, ess_tail: effective draws, likewise.
        acceptance: share of accepted moves by walker.
        stuck_walkers: walkers that hardly moved or live at another density.
        invalid: evaluations that gave no number.
        missing: sentences on what is not reached; empty when accepted.
        importance: diagnosis of the draws that the chain started from.
        agreement: with them; None where they were not accepted.
        monte_carlo_error: of every headline.
        rough: what is missing leaves a rough answer.
        tier: what ran the chain.
    """

    steps: int
    discarded: int
    thin: int
    tau_steps: float
    rhat: dict[str, float]
    ess_bulk: dict[str, float]
    ess_tail: dict[str, float]
    acceptance: np.ndarray
    stuck_walkers: tuple[int, ...]
    invalid: int
    missing: tuple[str, ...]
    importance: Importance
    agreement: Agreement | None
    monte_carlo_error: dict[str, MonteCarloError]
    rough: bool
    tier: Tier = CHAIN

    @property
    def answer(self) -> AnswerKind:
        """What the draws are good for: their intervals, these roughly, or nothing."""
        return "accepted" if not self.missing else "rough" if self.rough else "laplace"

    @property
    def converged(self) -> bool:
        """There is a sampled answer, accepted or rough."""
        return self.answer != "laplace"

    @property
    def sampling(self) -> Sampling:
        """What is said of the chain."""
        return Sampling(
            converged=self.converged,
            missing=self.missing,
            walkers=len(self.acceptance),
            steps=self.steps,
            discarded=self.discarded,
            thin=self.thin,
            tau_steps=self.tau_steps,
            worst_rhat=extreme(self.rhat, max),
            least_ess_bulk=extreme(self.ess_bulk, min),
            least_ess_tail=extreme(self.ess_tail, min),
            acceptance=float(self.acceptance.mean()),
            least_acceptance=float(self.acceptance.min()),
            stuck_walkers=self.stuck_walkers,
            invalid_evaluations=self.invalid,
            proposal_pareto_k=self.importance.pareto_k,
            importance=self.importance,
            agreement=self.agreement,
        )
