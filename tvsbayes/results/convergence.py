"""Whether a sampled posterior may be used: its diagnosis by quantity, and the part `sampling` of `fit.json`.

Lengths in steps of the sampler; effective draws and R-hat by quantity name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from tvsbayes.results.records import AnswerKind, Count, FromOne, NotNegative, Tier
from tvsbayes.results.tiers import CHAIN, IMPORTANCE

MEAN_ERROR_MAX, END_ERROR_MAX = 0.1, 0.2
"""Largest accepted Monte Carlo standard errors of a headline's mean and of the ends of its 95 % interval, in its sd:
the first widens the interval by 0.5 %, the second moves an end by a digit that is not printed."""
ROUGH_MEAN_ERROR_MAX, ROUGH_END_ERROR_MAX = 0.3, 0.6
"""Largest errors of a rough answer: the first widens an interval by 4 %, the second moves an end by a third of its
distance from the mean, but rarely."""


@dataclass(frozen=True)
class NamedValue:
    """Extreme value of a diagnosis, with its quantity."""

    quantity: str
    value: float


@dataclass(frozen=True)
class MonteCarloError:
    """Monte Carlo standard errors of a quantity's summary, in its posterior sd.

    Attributes:
        mean: error of its mean.
        interval95: errors of the ends of its 95 % interval, low and high.
    """

    mean: NotNegative
    interval95: tuple[NotNegative, NotNegative]

    def within(self, mean: float, end: float) -> bool:
        """Whether neither the mean nor an end has a larger error; NaN counts as too large."""
        return self.mean <= mean and all(each <= end for each in self.interval95)

    @property
    def roughly_known(self) -> bool:
        """Whether the errors allow a rough answer."""
        return self.within(ROUGH_MEAN_ERROR_MAX, ROUGH_END_ERROR_MAX)

    @property
    def rounds_factor(self) -> float:
        """Factor on the number of draws that an accepted answer needs."""
        return max(self.mean / MEAN_ERROR_MAX, *(each / END_ERROR_MAX for each in self.interval95)) ** 2


@dataclass(frozen=True)
class Importance:
    """Diagnosis of importance sampling: its draws and their weights.

    Where homings are not recorded, the limits are those of the mixture of all homing hypotheses, with the largest tail
    index of the ways that count; numbers of draws and evidence are those of the way that is most probable by Laplace.

    Attributes:
        accepted: whether its intervals may be used.
        missing: sentences on why not.
        rounds, draws: number of each.
        effective_share: number of equally weighted draws equivalent to the weighted ones, over the draws.
        least_ess: least effective number of draws of a headline's mean, sd or interval ends.
        pareto_k: tail index of the weights.
        worst_pareto_k: largest tail index of a headline's squared deviations times weights.
        heaviest_share: largest share of the weight in one draw.
        log_evidence: log of the integral of likelihood and prior; likelihoods include the constants of
            `estimators.campaign_arrays.spot_constants`, and ranges are flat in image displacement.
        log_evidence_mcse: its Monte Carlo standard error.
        invalid_evaluations: draws whose density is not finite.
        answer: use that the draws allow.
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
    """Whether a chain and importance sampling agree on every headline.

    Attributes:
        agrees: `worst` lies below `limit`.
        limit: largest allowed difference, in Monte Carlo standard errors of both.
        worst: largest difference of a headline's mean or interval end, in the same unit.
    """

    agrees: bool
    limit: float
    worst: NamedValue


@dataclass(frozen=True)
class Sampling:
    """Summary of a posterior's diagnosis; fields of a chain as in `Convergence`, None without a chain.

    Attributes:
        missing: sentences on the criteria that are not met.
        acceptance: mean over walkers.
        least_acceptance: acceptance of the worst walker.
        agreement: None where importance sampling was not accepted, or no chain ran.
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


def _sampling(diagnosis: Reweighted | Convergence, **run: Any) -> Sampling:
    """Summary of a diagnosis; `run` are the fields that describe walkers."""
    return Sampling(
        converged=diagnosis.converged,
        missing=diagnosis.missing,
        least_ess_bulk=extreme(diagnosis.ess_bulk, min),
        least_ess_tail=extreme(diagnosis.ess_tail, min),
        proposal_pareto_k=diagnosis.importance.pareto_k,
        importance=diagnosis.importance,
        agreement=diagnosis.agreement,
        **run,
    )


@dataclass(frozen=True)
class Reweighted:
    """Diagnosis of weighted draws without a chain.

    Attributes:
        importance: their diagnosis.
        ess_bulk, ess_tail: effective draws of the mean and of the worse end of the interval, by quantity name.
        monte_carlo_error: errors of every headline.
        agreement: of a chain that ran beside them.
    """

    tier: ClassVar[Tier] = IMPORTANCE
    importance: Importance
    ess_bulk: dict[str, float]
    ess_tail: dict[str, float]
    monte_carlo_error: dict[str, MonteCarloError]
    agreement: Agreement | None = None

    @property
    def answer(self) -> AnswerKind:
        """Use that the draws allow: intervals, rough intervals, or none."""
        return self.importance.answer or "laplace"

    @property
    def rhat(self) -> dict[str, float]:
        """Empty: independent draws have no R-hat."""
        return {}

    @property
    def missing(self) -> tuple[str, ...]:
        """Sentences on the criteria that are not met; empty when accepted."""
        return self.importance.missing

    @property
    def converged(self) -> bool:
        """Whether there is a sampled answer, accepted or rough."""
        return self.answer != "laplace"

    @property
    def sampling(self) -> Sampling:
        """Summary of the draws' diagnosis."""
        walked = ("walkers", "steps", "discarded", "thin", "tau_steps", "worst_rhat", "acceptance", "least_acceptance")
        invalid = self.importance.invalid_evaluations
        return _sampling(self, **dict.fromkeys(walked), stuck_walkers=(), invalid_evaluations=invalid)


@dataclass(frozen=True)
class Convergence:
    """Diagnosis of a chain: whether it may be used, or why not.

    Attributes:
        steps: length of the chain; discarded: first steps left out; thin: interval of the stored steps.
        tau_steps: longest integrated autocorrelation time.
        rhat: R-hat over groups of walkers, of every sampled or derived quantity by name.
        ess_bulk, ess_tail: effective draws, likewise.
        acceptance: share of accepted moves by walker.
        stuck_walkers: walkers that hardly moved or stay at another density.
        invalid: evaluations that returned no number.
        missing: sentences on the criteria that are not met; empty when accepted.
        importance: diagnosis of the draws from which the chain started.
        agreement: agreement with these draws; None where they were not accepted.
        monte_carlo_error: errors of every headline.
        rough: whether the unmet criteria allow a rough answer.
        tier: sampler of the chain.
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
        """Use that the draws allow: intervals, rough intervals, or none."""
        return "accepted" if not self.missing else "rough" if self.rough else "laplace"

    @property
    def converged(self) -> bool:
        """Whether there is a sampled answer, accepted or rough."""
        return self.answer != "laplace"

    @property
    def sampling(self) -> Sampling:
        """Summary of the chain's diagnosis."""
        return _sampling(
            self,
            **{name: getattr(self, name) for name in ("steps", "discarded", "thin", "tau_steps", "stuck_walkers")},
            walkers=len(self.acceptance),
            worst_rhat=extreme(self.rhat, max),
            acceptance=float(self.acceptance.mean()),
            least_acceptance=float(self.acceptance.min()),
            invalid_evaluations=self.invalid,
        )
