"""A mixture of Student distributions as proposal: for few coordinates, whose posterior may bend, split and reach far.

Means and covariances follow the weighted draws; a part of its own stands in the tail.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tvsbayes.inference.density import Step
from tvsbayes.inference.proposal import log_t
from tvsbayes.statistics.weighted_draws import effective_draws, smoothed_weights

DEGREES, INFLATION, WIDE = 5.0, 1.25, 6.0
"""Of the Student distributions: freedom, and variances over those of the draws."""
FLOOR = 1e-6
"""Least variance of weighted draws, of that along the axes: never flatter than rounding."""
FAR_SHARE, FAR_DRAWS, FAR_EFFECTIVE = 0.3, 50, 20.0
"""Of the weight in the tail that has a part of its own, and draws that it takes."""
SHARE = 0.6
"""Of a chain's steps that draw from it; the others walk. Both ask the density of all walkers at once."""
STRIDE = 2.38
"""Of a random walk, over the root of the dimension (Gelman, Roberts and Gilks, Bayesian Statistics 5 (1996) 599)."""


@dataclass(frozen=True)
class StudentMixture:
    """Shares of Student distributions.

    Attributes:
        means: shape (k, d); roots: Cholesky factors of their covariances, shape (k, d, d); shares: sum 1, shape (k,).
        width: covariance about a point where nothing is known, shape (d, d).
    """

    means: np.ndarray
    roots: np.ndarray
    shares: np.ndarray
    width: np.ndarray

    @classmethod
    def about(cls, mode: np.ndarray, covariance: np.ndarray) -> StudentMixture:
        """About a mode (d,) with its Laplace covariance (d, d)."""
        return cls.of(covariance, (mode, INFLATION * covariance, 0.7), (mode, 4.0 * covariance, 0.3))

    @classmethod
    def of(cls, width: np.ndarray, *parts: tuple[np.ndarray, np.ndarray, float]) -> StudentMixture:
        """Of means, covariances and shares."""
        means, covariances, shares = (np.array(each) for each in zip(*parts, strict=True))
        return cls(means, np.linalg.cholesky(covariances), shares, width)

    def draw(self, count: int, generator: np.random.RandomState) -> np.ndarray:
        """Independent draws, shape (count, d)."""
        which = generator.choice(len(self.shares), size=count, p=self.shares)
        normal = generator.standard_normal((count, self.means.shape[1]))
        normal /= np.sqrt(generator.chisquare(DEGREES, (count, 1)) / DEGREES)
        return self.means[which] + np.einsum("nij,nj->ni", self.roots[which], normal)

    def log_density(self, w: np.ndarray) -> np.ndarray:
        """Log density, shape (n,)."""
        parts = []
        for mean, root, share in zip(self.means, self.roots, self.shares, strict=True):
            square = np.sum(np.linalg.solve(root, (w - mean).T) ** 2, axis=0)
            volume = np.sum(np.log(np.diag(root)))
            parts.append(np.log(share) - volume + log_t(square, w.shape[1], DEGREES))
        return np.logaddexp.reduce(parts, axis=0)

    def __call__(self, w: np.ndarray, generator: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """See `density.Step`."""
        proposed = self.draw(len(w), generator)
        return proposed, self.log_density(w) - self.log_density(proposed)

    @property
    def steps(self) -> tuple[tuple[Step, float], ...]:
        """Of a chain, with their shares."""
        return (self, SHARE), (self.walked, 1 - SHARE)

    def walked(self, w: np.ndarray, generator: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """The same protocol: a random walk with the covariance of the last part."""
        root = self.roots[-1] * STRIDE / np.sqrt(INFLATION * w.shape[1])
        return w + generator.standard_normal(w.shape) @ root.T, np.zeros(len(w))

    def fitted(self, w: np.ndarray, log_target: np.ndarray, log_weights: np.ndarray) -> StudentMixture:
        """By the moments of weighted draws; where so few count that they have none, about the best of them."""
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
    """Mean (d,) and covariance (d, d)."""
    mean = weights @ w
    off = w - mean
    covariance = (weights[:, None] * off).T @ off
    return mean, covariance + FLOOR * np.diag(np.maximum(np.diag(covariance), 1e-24))


def _tail(
    w: np.ndarray, weights: np.ndarray, mean: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the farther part of the posterior, along the direction in which it is most skewed."""
    off = (w - mean) / np.sqrt(np.diag(covariance))
    along = off @ (weights @ off**3)
    order = np.argsort(-along)
    far = order[np.cumsum(weights[order]) <= FAR_SHARE]
    if len(far) < FAR_DRAWS or effective_draws(weights[far]) < FAR_EFFECTIVE:
        return mean, 3.0 * covariance
    mean_far, covariance_far = _moments(w[far], weights[far] / weights[far].sum())
    return mean_far, 1.5 * covariance_far + 0.1 * np.diag(np.diag(covariance))
