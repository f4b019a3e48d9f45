"""Propagation of uncertainty: the law (GUM 5), distributions (JCGM 101, 102), and the validation of one by the other.

Quantities may be vectors; units are the caller's. The law is written for JAX so that thousands of points share one
compiled function; distributions are arrays of draws, from any generator or from a posterior.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tvsbayes.calibration import NORMAL_95

BLOCKS = 10
"""Parts of the draws whose scatter gives the Monte Carlo error of an interval's end."""
BELIEVED = 4.0
"""Monte Carlo errors from which on a departure of the inputs from normality counts. Ten blocks give the error, and two
ends are looked at: at 2 errors, one exactly linear model in five would be called not validated, at 4 one in sixty."""


class Linear(eqx.Module):
    """The law of propagation of uncertainty: y = f(x), J = df/dx, U_y = J U_x J^T (GUM 5.2.2, JCGM 102 6.2)."""

    value: Float[Array, "*batch outputs"]
    jacobian: Float[Array, "*batch outputs inputs"]
    covariance: Float[Array, "*batch outputs outputs"]


def linear(
    function: Callable[[Float[Array, " inputs"]], Float[Array, "*batch outputs"]],
    estimates: Float[Array, " inputs"],
    covariance: Float[Array, "inputs inputs"],
) -> Linear:
    """Propagate estimates and their covariance to first order; differentiable, to be jitted or mapped by the caller.

    Args:
        function: the measurement model, written for JAX; it may return many quantities of the same inputs at once.
        estimates: of the input quantities.
        covariance: of the input quantities.

    Returns:
        Estimate, sensitivities and covariance of the output quantities.
    """
    # One trace of the function for value and derivatives; `linearize` takes twice the time to compile.
    values, columns = jax.vmap(lambda e: jax.jvp(function, (estimates,), (e,)), out_axes=(None, -1))(
        jnp.eye(estimates.size)
    )
    return Linear(values, columns, columns @ covariance @ jnp.swapaxes(columns, -1, -2))


def effective_dof(contributions: np.ndarray, dof: np.ndarray) -> float:
    """Effective degrees of freedom of independent contributions u_i (GUM G.4.1, Welch and Satterthwaite).

    Args:
        contributions: standard uncertainties u_i(y), shape (n,).
        dof: their degrees of freedom, infinite where exactly known, shape (n,).
    """
    u, dof = np.asarray(contributions, dtype=float), np.asarray(dof, dtype=float)
    denominator = np.sum(u**4 / dof)
    return math.inf if denominator == 0 else float(np.sum(u**2) ** 2 / denominator)


def coverage_factor(probability: float, dof: float = math.inf) -> float:
    """Two-sided coverage factor of Student's t (GUM G.3), truncating the degrees of freedom is the caller's (G.4.1)."""
    # Loading it takes a twentieth of the time of a `locate`, which does not need it.
    from scipy import special

    high = 0.5 * (1 + probability)
    return float(special.stdtrit(dof, high) if math.isfinite(dof) else special.ndtri(high))


def symmetric_interval(draws: np.ndarray, probability: float = 0.95) -> np.ndarray:
    """Probabilistically symmetric coverage interval over the first axis (JCGM 101 7.7): first axis (low, high)."""
    tail = 0.5 * (1 - probability)
    return np.quantile(draws, (tail, 1 - tail), axis=0)


def shortest_interval(draws: np.ndarray, probability: float = 0.95) -> np.ndarray:
    """Shortest coverage interval of scalar draws (n,), shape (2,) (JCGM 101 5.3.4 and 7.7.4)."""
    ordered = np.sort(np.asarray(draws, dtype=float))
    inside = min(len(ordered) - 1, max(1, round(probability * len(ordered))))
    width = ordered[inside:] - ordered[: len(ordered) - inside]
    first = int(np.argmin(width))
    return ordered[[first, first + inside]]


def numerical_tolerance(u: np.ndarray, digits: int) -> np.ndarray:
    """Half a unit of the last of `digits` significant digits of a standard uncertainty (JCGM 101 7.9.2)."""
    u = np.asarray(u, dtype=float)
    safe = np.where(u > 0, u, 1.0)
    # Of the rounded u: 0.0996 has the two digits 10, whose last unit is 0.01.
    exponent = np.floor(np.log10(safe)) - (digits - 1)
    exponent += np.round(safe / 10.0**exponent) >= 10**digits
    return np.where(u > 0, 0.5 * 10.0**exponent, 0.0)


@dataclass(frozen=True)
class Validation:
    """Does the law of propagation give the interval that the distribution has (JCGM 101 clause 8)?

    Fields have the shape of the quantity.

    Attributes:
        digits: significant digits of u that are compared.
        tolerance: delta of JCGM 101 8.1.
        deviation: larger distance of the two interval ends, d_low and d_high.
        error: its Monte Carlo standard error; that of a departure of the inputs too small to be seen is not in it.
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
        """Significant digits of u, `digits` at most, to which the law holds; 0 where not even one."""
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

    A thousand draws know an interval's end to a twentieth of u, far coarser than the tolerance. Therefore the same
    inputs are sent through the linearised model: the difference of the two intervals shows what linearisation does,
    with little noise. What remains, the inputs' departure from the distribution behind `factor`, is the difference
    of the linearised draws from value +- factor u; it counts where it exceeds `BELIEVED` Monte Carlo errors.

    Args:
        draws: of the quantity, shape (n, ...).
        linearised: value + J (input draws - estimates) for the same input draws, shape (n, ...).
        value: estimate by the law of propagation, shape (...).
        u: its standard uncertainty, shape (...).
        digits: significant digits of u to validate.
        probability: of the interval.
        factor: coverage factor that belongs to the probability.

    Returns:
        The verdict for every element of the quantity.
    """
    ends = np.stack([value - factor * u, value + factor * u])
    curved = _with_error(
        lambda a, b: symmetric_interval(a, probability) - symmetric_interval(b, probability), draws, linearised
    )
    other = _with_error(lambda b: symmetric_interval(b, probability) - ends, linearised)
    counts = np.abs(other[0]) > BELIEVED * other[1]
    deviations = np.abs(curved[0] + np.where(counts, other[0], 0.0))
    errors = np.where(counts, np.hypot(curved[1], other[1]), curved[1])
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


def _with_error(statistic: Callable[..., np.ndarray], *draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A statistic of draws and its Monte Carlo standard error from interleaved blocks."""
    blocks = [statistic(*(d[k::BLOCKS] for d in draws)) for k in range(BLOCKS)]
    return statistic(*draws), np.std(blocks, axis=0, ddof=1) / math.sqrt(BLOCKS)
