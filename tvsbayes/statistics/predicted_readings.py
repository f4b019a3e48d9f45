"""Predicted readings: a mixture of normal distributions, one for each draw of the scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


class Pooled(NamedTuple):
    """Mean (r,) and covariance (r, r) of readings."""

    mean: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class PredictedReadings:
    """Readings (r,) that are normal given each of n draws: means (n, r) and covariances (n, r, r)."""

    mean: np.ndarray
    covariance: np.ndarray

    def pooled(self, weights: np.ndarray | None = None) -> Pooled:
        """Moments of the mixture with weights (n,) of sum 1; None: equal weights."""
        weights = np.full(len(self.mean), 1 / len(self.mean)) if weights is None else weights
        mean = weights @ self.mean
        deviations = self.mean - mean
        covariance = np.tensordot(weights, self.covariance, 1) + (weights[:, None] * deviations).T @ deviations
        return Pooled(mean, covariance)

    def drawn(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Readings (count, r) drawn from the mixture, the same number from each draw."""
        draw = np.arange(count) % len(self.mean)
        values, vectors = np.linalg.eigh(self.covariance)
        normal = rng.standard_normal((count, self.mean.shape[1])) * np.sqrt(np.maximum(values, 0.0))[draw]
        return self.mean[draw] + np.einsum("nij,nj->ni", vectors[draw], normal)

    def log_densities(self, value: np.ndarray, additional: np.ndarray | None = None) -> np.ndarray:
        """Log density of readings (r,) by draw, shape (n,); `additional` is a covariance (r, r) to be added."""
        covariance = self.covariance if additional is None else self.covariance + additional
        _, log_det = np.linalg.slogdet(covariance)
        deviations = value - self.mean
        square = np.einsum("ni,ni->n", deviations, np.linalg.solve(covariance, deviations[..., None])[..., 0])
        return -0.5 * (log_det + square + len(value) * np.log(2 * np.pi))

    def log_density(self, value: np.ndarray, additional: np.ndarray | None = None) -> float:
        """Log density of readings (r,) under the mixture of equal draws; `additional` as in `log_densities`."""
        return log_mean(self.log_densities(value, additional))


def log_mean(logs: Sequence[float] | np.ndarray) -> float:
    """Logarithm of the mean of densities, from their logarithms."""
    return float(np.logaddexp.reduce(logs) - np.log(len(logs)))
