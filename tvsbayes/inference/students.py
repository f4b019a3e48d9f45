"""A mixture of Student distributions as proposal, for few coordinates: curved, bimodal or long-tailed posteriors.

Means and covariances are fitted to weighted draws; one part covers the tail.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tvsbayes.inference.density import Proposal, Step
from tvsbayes.inference.proposal import log_t
from tvsbayes.statistics.weighted_draws import effective_draws, smoothed_weights

DEGREES, INFLATION, WIDE = 5.0, 1.25, 6.0
"""Degrees of freedom of the Student distributions, and factors on the variances of the draws."""
FLOOR = 1e-6
"""Variance added to that of weighted draws along each axis, as a share: it keeps the covariance positive definite."""
FAR_SHARE, FAR_DRAWS, FAR_EFFECTIVE = 0.3, 50, 20.0
"""Share of the weight in the tail part, and the least numbers of draws and of effective draws in it."""
SHARE = 0.6
"""Share of a chain's steps drawn from the mixture; the others are a random walk. Both evaluate all walkers at once."""
STRIDE = 2.38
"""Step of a random walk times the dimension's root (Gelman, Roberts and Gilks, Bayesian Statistics 5 (1996) 599)."""


@dataclass(frozen=True)
class StudentMixture(Proposal):
    """A mixture of Student distributions.

    Attributes:
        means: shape (k, d); roots: Cholesky factors of their covariances, shape (k, d, d); shares: sum 1, shape (k,).
        width: covariance used about a point where draws give none, shape (d, d).
    """

    means: np.ndarray
    roots: np.ndarray
    shares: np.ndarray
    width: np.ndarray

    @classmethod
    def about(cls, mode: np.ndarray, covariance: np.ndarray) -> StudentMixture:
        """Build a mixture about a mode (d,) from its Laplace covariance (d, d)."""
        return cls.of(covariance, (mode, INFLATION * covariance, 0.7), (mode, 4.0 * covariance, 0.3))

    @classmethod
    def of(cls, width: np.ndarray, *parts: tuple[np.ndarray, np.ndarray, float]) -> StudentMixture:
        """Build a mixture from means, covariances and shares."""
        means, covariances, shares = (np.array(each) for each in zip(*parts, strict=True))
        return cls(means, np.linalg.cholesky(covariances), shares, width)

    def draw(self, count: int, generator: np.random.RandomState) -> np.ndarray:
        """Draw independent points, shape (count, d)."""
        which = generator.choice(len(self.shares), size=count, p=self.shares)
        normal = generator.standard_normal((count, self.means.shape[1]))
        normal /= np.sqrt(generator.chisquare(DEGREES, (count, 1)) / DEGREES)
        return self.means[which] + np.einsum("nij,nj->ni", self.roots[which], normal)

    def log_density(self, w: np.ndarray) -> np.ndarray:
        """Compute the log density, shape (n,)."""
        parts = []
        for mean, root, share in zip(self.means, self.roots, self.shares, strict=True):
            square = np.sum(np.linalg.solve(root, (w - mean).T) ** 2, axis=0)
            volume = np.sum(np.log(np.diag(root)))
            parts.append(np.log(share) - volume + log_t(square, w.shape[1], DEGREES))
        return np.logaddexp.reduce(parts, axis=0)

    @property
    def steps(self) -> tuple[tuple[Step, float], ...]:
        """Return the moves of a chain with their shares."""
        return (self, SHARE), (self.walked, 1 - SHARE)

    def walked(self, w: np.ndarray, generator: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """Propose a random walk with the covariance of the last part, as a `density.Step`."""
        root = self.roots[-1] * STRIDE / np.sqrt(INFLATION * w.shape[1])
        return w + generator.standard_normal(w.shape) @ root.T, np.zeros(len(w))

    def fitted(self, w: np.ndarray, log_target: np.ndarray, log_weights: np.ndarray) -> StudentMixture:
        """Fit the moments of weighted draws; where too few have weight, centre on the best draw."""
        smooth = np.zeros(len(w))
        some = np.isfinite(log_weights)
        smooth[some] = smoothed_weights(log_weights[some]).weights
        if effective_draws(smooth) <= w.shape[1] + 1:
            return self.of(self.width, (w[np.argmax(smooth)], WIDE * self.width, 1.0))
        mean, covariance = _moments(w, smooth)
        far, far_covariance = _tail(w, smooth, mean, covariance)
        parts = (mean, WIDE * covariance, 0.1), (far, far_covariance, 0.35), (mean, INFLATION * covariance, 0.55)
        return self.of(self.width, *parts)


def _moments(w: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute weighted mean (d,) and covariance (d, d)."""
    mean = weights @ w
    off = w - mean
    covariance = (weights[:, None] * off).T @ off
    return mean, covariance + FLOOR * np.diag(np.maximum(np.diag(covariance), 1e-24))


def _tail(
    w: np.ndarray, weights: np.ndarray, mean: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute mean and covariance of the posterior's tail along its direction of largest skewness."""
    off = (w - mean) / np.sqrt(np.diag(covariance))
    along = off @ (weights @ off**3)
    order = np.argsort(-along)
    far = order[np.cumsum(weights[order]) <= FAR_SHARE]
    if len(far) < FAR_DRAWS or effective_draws(weights[far]) < FAR_EFFECTIVE:
        return mean, 3.0 * covariance
    mean_far, covariance_far = _moments(w[far], weights[far] / weights[far].sum())
    return mean_far, 1.5 * covariance_far + 0.1 * np.diag(np.diag(covariance))
