"""Probabilities under chance alone: chi-squares, residuals one by one, shares of trials and their bounds.

Numbers have no units. NumPy; functions that need SciPy import it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

LEVELS = (0.50, 0.68, 0.90, 0.95)
"""Probabilities of the intervals whose coverage is counted."""
ASSURED = (0.8, 0.95)
"""Assurances for which a plan states the number of experiments; at the first it counts as meeting its target."""
BOUND = 1e-4
"""Two-sided probability that a correct study leaves its bounds."""


def recursive_residuals(values: np.ndarray, variances: np.ndarray, *, backwards: bool) -> tuple[float | None, ...]:
    """Standardise the difference of each value from the weighted mean of those before it.

    For independent values with one mean, these residuals are independent and N(0, 1) (Brown, Durbin and Evans, J. R.
    Stat. Soc. B 37, 1975, 149). Differences from the mean of all values are not: those of a pair are opposite.

    Args:
        values: shape (n,).
        variances: variances of their noise, shape (n,).
        backwards: begin with the last value.

    Returns:
        n residuals in the order of the values, None for the first in that order; empty for fewer than two values.
    """
    if len(values) < 2:
        return ()
    order = np.arange(len(values))[::-1] if backwards else np.arange(len(values))
    residuals: list[float | None] = [None] * len(values)
    total = weight = 0.0
    for i in order:
        if weight:
            residuals[i] = float((values[i] - total / weight) / np.sqrt(variances[i] + 1 / weight))
        total += values[i] / variances[i]
        weight += 1 / variances[i]
    return tuple(residuals)


FRACTION_TERMS = 400
"""Terms of Legendre's continued fraction: where it is used, ten times as many change no digit, up to 30 000 degrees of
freedom."""


def log_chance(chi2: np.ndarray | float, dof: np.ndarray | float) -> np.ndarray:
    """Compute the log probability of a chi-square of at least this size, even where the probability itself underflows.

    In the far tail Q(a, x) = Gamma(a, x) / Gamma(a), with Gamma(a, x) by Legendre's continued fraction (DLMF 8.9.2).
    Two gross defects must not tie at minus infinity: the worse one is reported as the cause.
    """
    from scipy import special

    with np.errstate(divide="ignore"):
        plain = np.asarray(np.log(special.chdtrc(dof, chi2)))
    beyond = ~np.isfinite(plain)
    if not beyond.any():
        return plain
    a, x = (0.5 * np.broadcast_to(part, plain.shape)[beyond] for part in (dof, chi2))
    rest = np.zeros_like(x)
    for term in range(FRACTION_TERMS, 0, -1):
        rest = term * (term - a) / (x + 2 * term + 1 - a - rest)
    far = -x + np.log(x) * a - np.log(x + 1 - a - rest) - special.gammaln(a)
    result = plain.copy()
    result[beyond] = far
    return result


def student_log_density(errors: np.ndarray, dof: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Compute the log density of a scaled Student's t, normal for infinite degrees of freedom; equal shapes."""
    from scipy import special

    ratio2 = (errors / scale) ** 2
    n = np.where(np.isfinite(dof), dof, 1.0)
    tail = special.gammaln(0.5 * (n + 1)) - special.gammaln(0.5 * n) - 0.5 * np.log(n)
    student = tail - 0.5 * (n + 1) * np.log1p(ratio2 / n)
    normal = -0.5 * (ratio2 + math.log(2))
    return np.where(np.isfinite(dof), student, normal) - 0.5 * math.log(math.pi) - np.log(scale)


def one_way_chance(groups: Sequence[np.ndarray]) -> float:
    """Compute the p-value of the F test of a one-way layout: groups of one mean and variance differ at least this much.

    Args:
        groups: at least two groups of shape (n,), n > 1, whose values are not all equal.
    """
    from scipy import special

    every = np.concatenate(groups)
    between = sum(len(group) * (group.mean() - every.mean()) ** 2 for group in groups)
    within = sum(np.sum((group - group.mean()) ** 2) for group in groups)
    free, left = len(groups) - 1, len(every) - len(groups)
    return float(special.fdtrc(free, left, (between / free) / (within / left)))


def share_error(share: float, draws: int) -> float:
    """Compute the Monte Carlo standard error of a share: binomial, or of Beta(1/2, draws + 1/2) where all draws agree.

    For a share of 0 or 1, sqrt(p (1 - p) / n) would be 0, although no number of draws makes it certain. The Beta
    distribution is the posterior under Jeffreys' prior.
    """
    if 0 < share < 1:
        return math.sqrt(share * (1 - share) / draws)
    return math.sqrt(0.5 * (draws + 0.5) / (draws + 2)) / (draws + 1)


def binomial_bounds(count: int, probability: float) -> tuple[float, float]:
    """Bound the share of `count` trials in which an event of this probability occurs; it lies outside with `BOUND`."""
    # Only inverting a discrete distribution needs `scipy.stats`, which takes half a second to load.
    from scipy import stats

    low, high = stats.binom.ppf(BOUND / 2, count, probability), stats.binom.isf(BOUND / 2, count, probability)
    return float(low) / count, float(high) / count


def rms_bounds(count: int) -> tuple[float, float]:
    """Bound the RMS of `count` standard normal numbers; it lies outside with probability `BOUND`."""
    from scipy import special

    low, high = np.sqrt(2 * special.gammaincinv(0.5 * count, [BOUND / 2, 1 - BOUND / 2]) / count)
    return float(low), float(high)


def share_interval95(hits: int, count: int) -> tuple[float, float]:
    """Compute Clopper and Pearson's 95 % interval of a probability."""
    from scipy import special

    low = 0.0 if hits == 0 else float(special.betaincinv(hits, count - hits + 1, 0.025))
    high = 1.0 if hits == count else float(special.betaincinv(hits + 1, count - hits, 0.975))
    return low, high
