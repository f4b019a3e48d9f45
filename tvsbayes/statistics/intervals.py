"""Intervals and coverage factors of the GUM and its supplements, and the validation of the law of propagation.

Numbers in the unit of their quantity. JCGM 100 (GUM), 101 (Monte Carlo) and 102 (several outputs). NumPy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

NORMAL_95 = 1.959963984540054
"""Two-sided 95 % quantile of the normal distribution."""


class WithSd[T](NamedTuple):
    """A value, a number or an array, and its standard deviation or uncertainty, of the same unit and shape."""

    value: T
    sd: T


def coverage_factor(dof: float, probability: float = 0.95) -> float:
    """Compute Student's t_p for two-sided coverage (GUM G.3, G.4.1), for fractional degrees of freedom too."""
    # Imported here: loading SciPy takes a twentieth of the time of a `locate`, which does not need it.
    from scipy.special import ndtri, stdtrit

    upper = 0.5 * (1 + probability)
    return float(stdtrit(dof, upper) if dof < 1e9 else ndtri(upper))


def effective_dof(u: float, contributions: Sequence[float], dof: Sequence[float]) -> float:
    """Compute the effective degrees of freedom of a combined uncertainty, Welch-Satterthwaite (GUM G.4.1, eq. G.2b).

    Args:
        u: combined standard uncertainty of the result.
        contributions: standard uncertainties of the result due to each input.
        dof: degrees of freedom of each contribution, infinite where exactly known.
    """
    total = sum(c**4 / nu for c, nu in zip(contributions, dof, strict=True))
    return float(u**4 / total) if total > 0 else math.inf


def grubbs_p(values: np.ndarray) -> float:
    """Compute the p value of the value farthest from the mean (n,), two-sided, Bonferroni's bound (Grubbs 1950, 1969).

    1 for fewer than three values and for equal ones.
    """
    from scipy.special import stdtr

    n = len(values)
    if n < 3 or not (sd := float(np.std(values, ddof=1))):
        return 1.0
    g_squared = float(np.max(np.abs(values - np.mean(values))) / sd) ** 2
    # The largest g there is, of values that are equal but for one, leaves no scatter: t is infinite.
    rest = (n - 1) ** 2 - n * g_squared
    t = math.sqrt(n * (n - 2) * g_squared / rest) if rest > 0 else math.inf
    return min(1.0, 2 * n * float(stdtr(n - 2, -t)))


BLOCKS = 10
"""Blocks of draws whose scatter gives the Monte Carlo error of an interval's end."""
BELIEVED = 4.0
"""Monte Carlo errors above which a departure of the inputs from normality counts. The error is from ten blocks and two
ends are compared: at 2 errors one exactly linear model in five would fail validation, at 4 one in sixty."""


def symmetric_interval(draws: np.ndarray, probability: float = 0.95) -> np.ndarray:
    """Compute the probabilistically symmetric coverage interval over the first axis (JCGM 101 7.7), as (low, high)."""
    tail = 0.5 * (1 - probability)
    return np.quantile(draws, (tail, 1 - tail), axis=0)


def interval95(draws: np.ndarray) -> tuple[float, float]:
    """Compute the equal-tailed 95 % interval of scalar draws (n,), as floats."""
    low, high = symmetric_interval(draws)
    return float(low), float(high)


def band95(draws: np.ndarray) -> np.ndarray:
    """Compute low, mean and high of 95 % of draws (draws, n) of a curve, shape (3, n)."""
    low, high = np.quantile(draws, (0.025, 0.975), axis=0)
    return np.stack([low, draws.mean(axis=0), high])


def absolute_bound95(mean: np.ndarray, sd: np.ndarray) -> float:
    """Compute the absolute value that 95 % of errors do not exceed, in a mixture of normals (n,) of equal weight."""
    from scipy.optimize import brentq
    from scipy.special import ndtr

    sd = np.maximum(sd, 1e-300)

    def beyond(limit: float) -> float:
        return float(np.mean(ndtr((-limit - mean) / sd) + ndtr((mean - limit) / sd))) - 0.05

    top = float(np.max(np.abs(mean) + 6 * sd))
    return 0.0 if top < 1e-200 else float(brentq(beyond, 0.0, top, xtol=1e-6 * top))


def rms(values: Sequence[float]) -> float:
    """Compute the root mean square; 0 without values."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0


def phases_deg(cosine: np.ndarray, sine: np.ndarray) -> np.ndarray:
    """Compute phases of waves with these parts (n,), deg, each within half a turn of their circular mean."""
    phase = np.arctan2(sine, cosine)
    middle = np.angle(np.mean(np.exp(1j * phase)))
    return np.degrees(middle + np.angle(np.exp(1j * (phase - middle))))


def numerical_tolerance(u: np.ndarray, digits: int) -> np.ndarray:
    """Compute half a unit of the last of `digits` significant digits of a standard uncertainty (JCGM 101 7.9.2)."""
    u = np.asarray(u, dtype=float)
    safe = np.where(u > 0, u, 1.0)
    # Of the rounded u: 0.0996 has the two digits 10, whose last unit is 0.01.
    exponent = np.floor(np.log10(safe)) - (digits - 1)
    exponent += np.round(safe / 10.0**exponent) >= 10**digits
    return np.where(u > 0, 0.5 * 10.0**exponent, 0.0)


@dataclass(frozen=True)
class Validation:
    """Validation of the law of propagation by comparing its interval with that of the draws (JCGM 101 clause 8).

    Fields have the shape of the quantity.

    Attributes:
        digits: significant digits of u that are compared.
        tolerance: delta of JCGM 101 8.1.
        deviation: larger distance of the two interval ends, d_low and d_high.
        error: its Monte Carlo standard error, without that of a departure of the inputs that did not count.
        validated: the deviation is not larger than the tolerance.
        decided: the deviation differs from the tolerance by more than twice its Monte Carlo error.
    """

    digits: int
    tolerance: np.ndarray
    deviation: np.ndarray
    error: np.ndarray
    validated: np.ndarray
    decided: np.ndarray

    def digits_held(self, u: np.ndarray) -> np.ndarray:
        """Count the significant digits of u, at most `digits`, to which the law holds; 0 where it holds to none."""
        held = np.zeros(np.shape(u), dtype=int)
        for digits in range(1, self.digits + 1):
            held = np.where(self.deviation <= numerical_tolerance(u, digits), digits, held)
        return held


def validate(
    draws: np.ndarray,
    linearised: np.ndarray,
    value: np.ndarray,
    u: np.ndarray,
    *,
    digits: int = 2,
    probability: float = 0.95,
    factor: float = NORMAL_95,
) -> Validation:
    """Compare value +- factor u with the interval of the draws.

    A thousand draws determine an interval's end to a twentieth of u, far coarser than the tolerance. Therefore the same
    inputs are propagated through the linearised model: the difference of the two intervals is the effect of
    linearisation, with little noise. The difference of the linearised draws from value +- factor u is the inputs'
    departure from the distribution behind `factor`; it counts where it exceeds `BELIEVED` Monte Carlo errors.

    Args:
        draws: draws of the quantity, shape (n, ...).
        linearised: value + J (input draws - estimates) for the same input draws, shape (n, ...).
        value: estimate by the law of propagation, shape (...).
        u: its standard uncertainty, shape (...).
        digits: significant digits of u to validate.
        probability: coverage probability of the interval.
        factor: coverage factor that belongs to the probability.

    Returns:
        The verdict for every element of the quantity.
    """
    ends = np.stack([value - factor * u, value + factor * u])
    curved = _with_error(
        lambda a, b: symmetric_interval(a, probability) - symmetric_interval(b, probability), draws, linearised
    )
    other = _with_error(lambda b: symmetric_interval(b, probability) - ends, linearised)
    counts = np.abs(other.value) > BELIEVED * other.sd
    deviations = np.abs(curved.value + np.where(counts, other.value, 0.0))
    errors = np.where(counts, np.hypot(curved.sd, other.sd), curved.sd)
    worse = np.argmax(deviations, axis=0)[None]
    deviation, error = (np.take_along_axis(x, worse, axis=0)[0] for x in (deviations, errors))
    tolerance = numerical_tolerance(u, digits)
    return Validation(
        digits=digits,
        tolerance=tolerance,
        deviation=deviation,
        error=error,
        validated=deviation <= tolerance,
        decided=np.abs(deviation - tolerance) > 2 * error,
    )


def _with_error(statistic: Callable[..., np.ndarray], *draws: np.ndarray) -> WithSd[np.ndarray]:
    """Compute a statistic of draws with its Monte Carlo standard error from interleaved blocks."""
    blocks = [statistic(*(d[k::BLOCKS] for d in draws)) for k in range(BLOCKS)]
    return WithSd(statistic(*draws), np.std(blocks, axis=0, ddof=1) / math.sqrt(BLOCKS))
