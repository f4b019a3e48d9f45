"""A chain of an ensemble: all that continues it bit for bit. Arrays are ordered (step, walker, ...)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Chain:
    """Everything a run has done: enough to continue it bit for bit.

    Attributes:
        w: positions, shape (steps, walkers, d); log_density: relative to the mode, shape (steps, walkers).
        accepted: accepted moves by walker.
        random_state: NumPy's legacy generator after the last step.
        invalid: evaluations that gave no number.
        seconds: spent so far, importance sampling included.
        goal: steps at which convergence is looked at next.
    """

    w: np.ndarray
    log_density: np.ndarray
    accepted: np.ndarray
    random_state: tuple
    invalid: int
    seconds: float
    goal: int
