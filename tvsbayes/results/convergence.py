"""Whether a chain may be used: its diagnosis by quantity, and what `fit.json` says of it under `sampling`.

Lengths in steps of the sampler; effective draws and R-hat as ArviZ computes them, by contract name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class NamedValue:
    """The extreme of a diagnosis, and the quantity that has it."""

    quantity: str
    value: float


@dataclass(frozen=True)
class Sampling:
    """A chain's diagnosis in brief; fields as in `Convergence`.

    `missing` says what is not reached; `acceptance` is the mean over walkers, `least_acceptance` that of the worst.
    """

    converged: bool
    missing: tuple[str, ...]
    walkers: int
    steps: int
    discarded: int
    thin: int
    tau_steps: float
    worst_rhat: NamedValue
    least_ess_bulk: NamedValue
    least_ess_tail: NamedValue
    acceptance: float
    least_acceptance: float
    stuck_walkers: tuple[int, ...]
    invalid_evaluations: int
    proposal_pareto_k: float


@dataclass(frozen=True)
class Convergence:
    """Whether a chain may be used, and why not.

    Attributes:
        steps: length of the chain; discarded: first steps left out; thin: one in so many is stored.
        tau_steps: longest integrated autocorrelation time.
        rhat, ess_bulk, ess_tail: by contract name, of every sampled or derived quantity.
        acceptance: share of accepted moves by walker.
        stuck_walkers: walkers that hardly moved or live at another density.
        invalid: evaluations that gave no number.
        pareto_k: tail index of target / proposal in the last pilot draws; above 0.7 the proposal is a poor guide.
        missing: sentences on what is not reached; empty when converged.
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
    pareto_k: float
    missing: tuple[str, ...]

    @property
    def converged(self) -> bool:
        """All limits of formulation 4.3 are met."""
        return not self.missing

    @property
    def sampling(self) -> Sampling:
        """What is said of the chain."""

        def worst(of: dict[str, float], extreme: Callable[..., str]) -> NamedValue:
            name = extreme(of, key=lambda each: of[each])
            return NamedValue(name, of[name])

        return Sampling(
            converged=self.converged,
            missing=self.missing,
            walkers=len(self.acceptance),
            steps=self.steps,
            discarded=self.discarded,
            thin=self.thin,
            tau_steps=self.tau_steps,
            worst_rhat=worst(self.rhat, max),
            least_ess_bulk=worst(self.ess_bulk, min),
            least_ess_tail=worst(self.ess_tail, min),
            acceptance=float(self.acceptance.mean()),
            least_acceptance=float(self.acceptance.min()),
            stuck_walkers=self.stuck_walkers,
            invalid_evaluations=self.invalid,
            proposal_pareto_k=self.pareto_k,
        )
