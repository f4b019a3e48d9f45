"""Weighted draws: moments and intervals with their Monte Carlo errors, the tail of the weights, resampling.

Weights sum to one; the first axis of values is over the draws. NumPy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

TAILS = (0.025, 0.975)
"""Probabilities of the ends of an equal-tailed 95 % interval."""
TAIL_SHARE_MAX = 0.2
"""Largest share of the draws to which a generalised Pareto distribution is fitted."""
PRIOR_DRAWS, PRIOR_K = 10, 0.5
"""Weight and centre of the prior of k (Vehtari et al., J. Mach. Learn. Res. 25 (2024) 72, appendix G)."""


@dataclass(frozen=True, repr=False)
class Moments:
    """Quantities by draws; every field has the shape of the quantities.

    Attributes:
        mean, sd: moments of the draws.
        interval95: equal-tailed, first axis (low, high).
        mcse_mean, mcse_sd, mcse_interval95: Monte Carlo standard errors of the above.
    """

    mean: np.ndarray
    sd: np.ndarray
    interval95: np.ndarray
    mcse_mean: np.ndarray
    mcse_sd: np.ndarray
    mcse_interval95: np.ndarray


@dataclass(frozen=True)
class WeightedSummary(Moments):
    """Moments of weighted draws, and in `ess_mean`, `ess_sd`, `ess_interval95` the effective draws behind each of them.

    Errors are those of self-normalised importance sampling (Owen, Monte Carlo theory, methods and examples, 9.2). The
    effective draws of a statistic are the number of equally weighted, independent draws with the same error.
    """

    ess_mean: np.ndarray
    ess_sd: np.ndarray
    ess_interval95: np.ndarray

    @property
    def ess_least(self) -> np.ndarray:
        """Return the smallest effective number of draws of the four statistics."""
        return np.min([self.ess_mean, self.ess_sd, *self.ess_interval95], axis=0)


def effective_draws(weights: np.ndarray) -> float:
    """Compute the effective sample size of weights (n,), for any quantity (Kish)."""
    return float(np.sum(weights) ** 2 / np.sum(weights**2))


WEIGHTLESS = 1e-16
"""Share of the largest weight below which a draw changes no digit of any sum."""


def weighted_mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Compute the mean over the first axis; it is exact for equal numbers."""
    return values[0] + np.tensordot(weights, values - values[0], axes=1)


def weighted_quantiles(values: np.ndarray, weights: np.ndarray, probabilities: Sequence[float]) -> np.ndarray:
    """Compute quantiles over the first axis, shape (probabilities, ...); NumPy's (type 7) where weights are equal.

    The cumulative weight at each draw includes half of its own. It is scaled so that the smallest draw has probability
    0 and the largest 1, and interpolated linearly.
    """
    flat = values.reshape(len(values), -1)
    quantiles = np.empty((len(probabilities), flat.shape[1]))
    for column, each in enumerate(flat.T):
        order = np.argsort(each, kind="stable")
        ordered = weights[order]
        middle = np.cumsum(ordered) - 0.5 * ordered
        # A single draw needs no scaling and is every quantile.
        reach = middle[-1] - middle[0] or 1.0
        quantiles[:, column] = np.interp(probabilities, (middle - middle[0]) / reach, each[order])
    return quantiles.reshape(len(probabilities), *values.shape[1:])


def weighted_summary(values: np.ndarray, weights: np.ndarray) -> WeightedSummary:
    """Compute moments, interval, errors and effective draws of values (n, ...) with weights (n,)."""
    shape = values.shape[1:]
    # A draw far out in the proposal may have a value that is infinite, and zero times infinity is not a number.
    counts = weights > WEIGHTLESS * weights.max()
    values, weights = values[counts], weights[counts]
    flat, square = values.reshape(len(values), -1), weights**2
    centre = weighted_mean(flat, weights)
    deviation2 = (flat - centre) ** 2
    variance = weights @ deviation2
    sd = np.sqrt(variance)
    spread2 = (deviation2 - variance) ** 2
    # A quantity that is equal in all draws has no error.
    moving = np.ptp(flat, axis=0) > 0
    safe = np.where(moving, variance, 1.0)
    error2, spread_error2 = square @ deviation2, square @ spread2
    kish = effective_draws(weights)

    def ess(whole: np.ndarray, error: np.ndarray) -> np.ndarray:
        return np.where(moving, whole / np.where(error > 0, error, np.inf), kish)

    ends = weighted_quantiles(flat, weights, TAILS)
    errors, ess_ends = np.zeros_like(ends), np.empty_like(ends)
    for k, tail in enumerate(TAILS):
        chance2 = square @ ((flat <= ends[k]) - tail) ** 2
        ess_ends[k] = ess(np.full(flat.shape[1], tail * (1 - tail)), chance2)
        for column in np.flatnonzero(moving):
            # One standard error of the probability, propagated to the quantity, as ArviZ does for equal weights.
            about = np.clip(tail + np.sqrt(chance2[column]) * np.array([-1.0, 1.0]), 0.0, 1.0)
            low, high = weighted_quantiles(flat[:, column], weights, about.tolist())
            errors[k, column] = 0.5 * (high - low)
    return WeightedSummary(
        mean=centre.reshape(shape),
        sd=sd.reshape(shape),
        interval95=ends.reshape(2, *shape),
        mcse_mean=np.sqrt(np.where(moving, error2, 0.0)).reshape(shape),
        mcse_sd=np.where(moving, 0.5 * np.sqrt(spread_error2 / safe), 0.0).reshape(shape),
        mcse_interval95=errors.reshape(2, *shape),
        ess_mean=ess(variance, error2).reshape(shape),
        ess_sd=ess(weights @ spread2, spread_error2).reshape(shape),
        ess_interval95=ess_ends.reshape(2, *shape),
    )


def systematic(weights: np.ndarray, count: int, offset: float) -> np.ndarray:
    """Resample `count` draws systematically: ascending indices (Kitagawa, J. Comput. Graph. Stat. 5 (1996) 1).

    With equal weights it takes evenly spaced draws.

    Args:
        weights: shape (n,), sum 1.
        count: number of draws.
        offset: in [0, 1), the only random number.
    """
    reached = np.cumsum(weights)
    places = np.searchsorted(reached / reached[-1], (np.arange(count) + offset) / count, side="right")
    return np.minimum(places, len(weights) - 1)


@dataclass(frozen=True)
class ParetoTail:
    """A generalised Pareto distribution of exceedances over a threshold: shape k and scale."""

    k: float
    scale: float

    def quantiles(self, probabilities: np.ndarray) -> np.ndarray:
        """Compute the exceedances at probabilities (n,)."""
        if abs(self.k) < 1e-30:
            return -self.scale * np.log1p(-probabilities)
        return self.scale * np.expm1(-self.k * np.log1p(-probabilities)) / self.k


def pareto_tail(exceedances: np.ndarray) -> ParetoTail:
    """Fit ascending exceedances (n,) by Zhang and Stephens, Technometrics 51 (2009) 316, with k shrunk to 1/2."""
    n = len(exceedances)
    grid = 30 + int(np.sqrt(n))
    b = 1 - np.sqrt(grid / (np.arange(1, grid + 1) - 0.5))
    b = b / (3 * exceedances[int(n / 4 + 0.5) - 1]) + 1 / exceedances[-1]
    k = np.mean(np.log1p(-b[:, None] * exceedances), axis=1)
    log_likelihood = n * (np.log(-b / k) - k - 1)
    share = np.exp(log_likelihood - np.max(log_likelihood))
    share = np.where(share >= 10 * np.finfo(float).eps * share.sum(), share, 0.0)
    centre = float(b @ share / share.sum())
    mean_log = float(np.mean(np.log1p(-centre * exceedances)))
    return ParetoTail((n * mean_log + PRIOR_DRAWS * PRIOR_K) / (n + PRIOR_DRAWS), -mean_log / centre)


def _tail_count(count: int) -> int:
    """Return the number of largest draws that form the tail (Vehtari et al. 2024, 3)."""
    return int(3 * np.sqrt(count)) if count > 225 else int(TAIL_SHARE_MAX * count)


def pareto_k(values: np.ndarray) -> float:
    """Estimate the tail index of positive numbers (n,), n >= 25; from 0.7 on n numbers do not determine their mean."""
    ordered = np.sort(values)
    count = _tail_count(len(values))
    exceedances = ordered[-count:] - ordered[-count - 1]
    # Equal numbers have no tail.
    return pareto_tail(exceedances).k if exceedances[int(count / 4 + 0.5) - 1] > 0 else 0.0


@dataclass(frozen=True)
class SmoothedWeights:
    """Weights (n,) of sum 1, the largest replaced by quantiles of the fitted tail, and the tail index."""

    weights: np.ndarray
    pareto_k: float


def smoothed_weights(log_ratios: np.ndarray) -> SmoothedWeights:
    """Smooth weights by Pareto smoothed importance sampling (Vehtari et al., J. Mach. Learn. Res. 25 (2024) 72).

    Args:
        log_ratios: log (target / proposal) of n >= 25 draws up to a constant; -inf where the target is zero.
    """
    ratios = np.exp(log_ratios - np.max(log_ratios))
    count = _tail_count(len(ratios))
    order = np.argsort(ratios, kind="stable")
    tail, cutoff = order[-count:], ratios[order[-count - 1]]
    exceedances = ratios[tail] - cutoff
    if exceedances[int(count / 4 + 0.5) - 1] <= 0:
        return SmoothedWeights(ratios / ratios.sum(), 0.0)
    pareto = pareto_tail(exceedances)
    raised = cutoff + pareto.quantiles((np.arange(count) + 0.5) / count)
    smooth = ratios.copy()
    smooth[tail] = np.minimum(raised, ratios[order[-1]])
    return SmoothedWeights(smooth / smooth.sum(), pareto.k)
