"""Score and information of unknowns in a linear normal model: g = A^T C^-1 r and F = A^T C^-1 A, C the covariance of r.

Some unknowns are fitted (eliminated), the others tested: g ~ N(0, F) if they are zero (Rao, Proc. Cambridge Phil. Soc.
44 (1948) 50).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from tvsbayes.statistics.chances import log_chance


@dataclass(frozen=True)
class Directions:
    """Directions on which there is information: `values` (k,) of it, `vectors` (q, k); orthogonal in their scale."""

    values: np.ndarray
    vectors: np.ndarray

    @classmethod
    def of(cls, information: np.ndarray, floor: float, scale: np.ndarray | float = 1.0) -> Self:
        """Find those with more than `floor` of the information (q, q), in units of `scale`, one or (q,), squared."""
        scale = np.broadcast_to(scale, len(information))
        values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
        kept = values > floor
        return cls(values[kept], vectors[:, kept] / scale[:, None])

    @property
    def inverse(self) -> np.ndarray:
        """The pseudo-inverse of the information."""
        return (self.vectors / self.values) @ self.vectors.T

    def chi2(self, score: np.ndarray) -> np.ndarray:
        """Squared length of scores (..., q) in their standard deviations; k degrees of freedom."""
        return np.asarray(np.sum((score @ self.vectors) ** 2 / self.values, axis=-1))

    def log_chances(self, score: np.ndarray) -> np.ndarray:
        """Log p of scores (..., q); 0 where there is no direction."""
        return log_chance(self.chi2(score), len(self.values)) if len(self.values) else np.zeros(score.shape[:-1])


@dataclass(frozen=True)
class Score:
    """Score `value` (q,) of unknowns, and their information (q, q)."""

    value: np.ndarray
    information: np.ndarray

    def given(self, rows: np.ndarray | slice, inverse: np.ndarray) -> Score:
        """What is left where some unknowns are fitted, of which the inverse information is given, priors included."""
        cross = self.information[rows]
        followed = inverse @ cross
        return Score(self.value - followed.T @ self.value[rows], self.information - cross.T @ followed)

    def at(self, rows: np.ndarray | slice) -> Score:
        """That of some unknowns."""
        return Score(self.value[rows], self.information[rows][:, rows])
