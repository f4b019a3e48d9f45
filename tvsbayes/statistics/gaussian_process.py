"""Stationary Gaussian processes of one variable: the correlations that repeat errors of position are described by.

Rasmussen and Williams, Gaussian Processes for Machine Learning, MIT Press 2006, 4.2. Distances, lengths and periods of
a call share one unit. Written for NumPy's and JAX's functions alike.
"""

from __future__ import annotations

from collections.abc import Iterable
from types import ModuleType
from typing import Any

import numpy as np

JITTER = 1e-10
"""Share of a process' variance added to every place, so that neighbours a step apart leave its covariance a Cholesky
factor: a hundred readings that are known to a tenth of the process' sd see it as 1e-6 in a log density."""


def matern52[Numbers: Any](distance: Numbers, length: Numbers, functions: ModuleType = np) -> Numbers:
    """Correlation of a Matern process of smoothness 5/2, twice differentiable, at distances of either sign (4.17)."""
    scaled = np.sqrt(5.0) * functions.abs(distance) / length
    return (1 + scaled + scaled**2 / 3) * functions.exp(-scaled)


def periodic[Numbers: Any](distance: Numbers, period: Numbers, functions: ModuleType = np) -> Numbers:
    """Correlation of a cosine of random phase and normal amplitude at distances of either sign."""
    return functions.cos(2 * np.pi * distance / period)


def repeated[Numbers: Any](
    distance: Numbers,
    sd: Numbers,
    length: Numbers,
    waves: Iterable[tuple[Numbers, Numbers | float]],
    functions: ModuleType = np,
) -> Numbers:
    """Covariance of what repeats by position: a Matern process of this sd and cosines of stated periods.

    Args:
        distance: of either sign, any shape; all others broadcast with it.
        sd: of the process.
        length: of its correlation.
        waves: sd and period of each cosine.
        functions: numpy or jax.numpy.
    """
    return with_waves(sd**2 * matern52(distance, length, functions), distance, waves, functions)


def with_waves[Numbers: Any](
    covariance: Numbers,
    distance: Numbers,
    waves: Iterable[tuple[Numbers, Numbers | float]],
    functions: ModuleType = np,
) -> Numbers:
    """A covariance and that of cosines of these sds and periods."""
    for amplitude, period in waves:
        covariance = covariance + amplitude**2 * periodic(distance, period, functions)
    return covariance
