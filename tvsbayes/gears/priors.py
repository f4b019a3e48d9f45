"""Priors of a joint's parameters and the coordinates in which each is standard normal. NumPy or JAX.

Normal priors are value + u z, half-normals u Phi^-1((1 + Phi(z)) / 2), which has no boundary and no mirrored mode,
log-normals value exp(u z) (formulation 4.1). u = 0 fixes a parameter whatever its z.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
from scipy import special

HALF_NORMAL_MEAN, HALF_NORMAL_SD = math.sqrt(2 / math.pi), math.sqrt(1 - 2 / math.pi)
"""Mean and sd of |x|, x ~ N(0, 1)."""
FARTHEST_SD = 36.0
"""Largest coordinate of a half-normal; larger ones are clipped."""


def half_normal(z: Any, functions: ModuleType = special) -> Any:
    """Compute a half-normal quantity of scale 1 from its coordinate, Phi^-1((1 + Phi(z)) / 2).

    1 - (1 + Phi(z)) / 2 = Phi(-z) / 2 is accurate where Phi(z) rounds to 1.

    Args:
        z: coordinates, any shape.
        functions: module of `ndtr` and `ndtri`, SciPy's or JAX's.
    """
    return -functions.ndtri(0.5 * functions.ndtr(-z))


def half_normal_slope(z: Any, value: Any = None, functions: ModuleType = np) -> Any:
    """Compute its derivative by the coordinate, phi(z) / (2 phi(value)), and the value where not given."""
    value = half_normal(z) if value is None else value
    return 0.5 * functions.exp(0.5 * (value**2 - z**2))


def half_normal_coordinate(value: np.ndarray) -> np.ndarray:
    """Compute the coordinate of a half-normal quantity of scale 1, from the more accurate tail; values of any sign."""
    near = special.ndtri(np.maximum(special.erf(np.maximum(value, 0.0) / np.sqrt(2)), 1e-16))
    return np.where(np.less(value, 0.5), near, -special.ndtri(2 * special.ndtr(-np.maximum(value, 0.5))))


def half_normal_sd(mean: float, sd: float) -> float:
    """Compute the sd of a half-normal of scale 1 whose coordinate is N(mean, sd^2), by Gauss-Hermite quadrature.

    Near zero the map from coordinate to quantity is flat on one side: its slope would give too small an sd.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(48)
    values = half_normal(mean + sd * nodes)
    weights = weights / weights.sum()
    centre = weights @ values
    return float(np.sqrt(weights @ (values - centre) ** 2))


def values_at(
    z: Any,
    value: Any,
    u: Any,
    half: Any,
    log: Any,
    functions: ModuleType = np,
    half_normal: Callable[[Any], Any] = half_normal,
) -> Any:
    """Compute parameters from their coordinates.

    Args:
        z: coordinates (..., parameters).
        value: centres (parameters,), of log-normals the medians.
        u: standard uncertainties; of half-normals the scales, of log-normals the sds of the logarithm.
        half: which are half-normal.
        log: which are log-normal.
        functions: numpy or jax.numpy.
        half_normal: `half_normal` for these arrays.
    """
    # Unused branches get harmless numbers, since `where` lets their infinities into the gradient. Beyond 37 sd Phi
    # underflows and its inverse is infinite; a fit that goes there must be able to return.
    w = functions.where(half, functions.minimum(z, FARTHEST_SD), 0.0)
    log_normal = value * functions.exp(functions.where(log, u, 0.0) * z)
    other = functions.where(log, log_normal, value + u * z)
    return functions.where(half, u * half_normal(w), other)
