"""The state of a chain, from which it continues bit for bit; its run by tier; the choice of the better answer.

Arrays of a chain are ordered (step, walker, ...).
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from tvsbayes.results.convergence import Convergence, Reweighted
from tvsbayes.results.records import Tier
from tvsbayes.results.tiers import RUNS

GROUPS = 4
"""Number of groups of walkers that share no partners: independent chains for R-hat."""


@dataclass(frozen=True)
class Chain:
    """A chain so far, with all that is needed to continue it bit for bit.

    Attributes:
        w: positions, shape (steps, walkers, d); log_density: relative to the mode, shape (steps, walkers).
        accepted: accepted moves by walker.
        random_state: state of NumPy's legacy generator after the last step.
        invalid: number of evaluations without a finite value.
        seconds: time spent so far, importance sampling included.
        goal: number of steps at which convergence is tested next.
    """

    w: np.ndarray
    log_density: np.ndarray
    accepted: np.ndarray
    random_state: tuple
    invalid: int
    seconds: float
    goal: int


def run_of(tier: Tier) -> Callable[..., Any]:
    """Load the class that runs a chain of a tier, made as `ensemble.Run` is."""
    module, _, name = RUNS[tier].partition(":")
    return getattr(importlib.import_module(f"tvsbayes.inference.{module}"), name)


class Judged(Protocol):
    """A result with a convergence record."""

    @property
    def convergence(self) -> Convergence | Reweighted: ...  # noqa: D102


def better[J: Judged](early: J, walked: J) -> J:
    """Choose weighted draws or a chain by the better answer, the chain where both are equally good.

    A chain that contradicts the weighted draws leaves neither accepted.
    """
    chain, order = walked.convergence, ("accepted", "rough", "laplace")
    assert isinstance(chain, Convergence)
    if chain.agreement is not None and not chain.agreement.agrees:
        return walked
    return early if order.index(early.convergence.answer) < order.index(chain.answer) else walked
