"""The state of an ensemble chain, from which it continues bit for bit. Arrays are ordered (step, walker, ...)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


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
