"""The posterior of quantities in which the observations are linear: normal, at every draw of the scales. NumPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class LinearPosterior:
    """Posterior of linear quantities (columns) given n draws of the scales.

    Attributes:
        mean: shape (n, columns).
        covariance: shape (n, columns, columns).
    """

    mean: np.ndarray
    covariance: np.ndarray

    def mean_of(self, functionals: np.ndarray) -> np.ndarray:
        """Means (n, t) of functionals (t, columns), or of (n, t, columns), one for each draw."""
        return np.einsum("ni,nti->nt", self.mean, functionals) if functionals.ndim == 3 else self.mean @ functionals.T

    def sd_of(self, functionals: np.ndarray) -> np.ndarray:
        """Standard deviations (n, t) of functionals as in `mean_of`."""
        if functionals.ndim == 3:
            variance = np.einsum("nti,nti->nt", functionals @ self.covariance, functionals)
        else:
            variance = np.einsum("ti,nij,tj->nt", functionals, self.covariance, functionals, optimize=True)
        return np.sqrt(np.maximum(variance, 0.0))

    def moments(self, functionals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Means and standard deviations (t,) of functionals as in `mean_of`, over all n."""
        mean, sd = self.mean_of(functionals), self.sd_of(functionals)
        return mean.mean(axis=0), np.sqrt((sd**2).mean(axis=0) + mean.var(axis=0))

    def drawn(self, functionals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draw functionals (t, columns) or (n, t, columns) once for each of the n, shape (n, t)."""
        covariance = functionals @ self.covariance @ np.swapaxes(functionals, -1, -2)
        values, vectors = np.linalg.eigh(covariance)
        normal = rng.standard_normal(values.shape) * np.sqrt(np.maximum(values, 0.0))
        return self.mean_of(functionals) + np.einsum("nij,nj->ni", vectors, normal)
