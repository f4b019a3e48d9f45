"""Covariances of stationary Gaussian processes of one variable, which describe errors that repeat by position.

Rasmussen and Williams, Gaussian Processes for Machine Learning, MIT Press 2006, 4.2. Distances, lengths and periods of
a call share one unit.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

JITTER = 1e-10
"""Share of a process' variance added at every place, so that the covariance of places one step apart has a Cholesky
factor. A hundred readings known to a tenth of the process' sd change by 1e-6 in a log density."""


def matern52[Numbers: Any](distance: Numbers, length: Numbers) -> Numbers:
    """Correlate a Matern process of smoothness 5/2 (twice differentiable) at signed distances (4.17)."""
    scaled = np.sqrt(5.0) * np.abs(distance) / length
    return (1 + scaled + scaled**2 / 3) * np.exp(-scaled)


def repeated[Numbers: Any](
    distance: Numbers, sd: Numbers, length: Numbers, waves: Iterable[tuple[Numbers, Numbers | float]]
) -> Numbers:
    """Compute the covariance of errors that repeat by position: a Matern process and cosines of stated periods.

    Args:
        distance: signed, of any shape; the other arguments broadcast with it.
        sd: standard deviation of the process.
        length: its correlation length.
        waves: sd and period of each cosine.
    """
    return with_waves(sd**2 * matern52(distance, length), distance, waves)


def with_waves[Numbers: Any](
    covariance: Numbers, distance: Numbers, waves: Iterable[tuple[Numbers, Numbers | float]]
) -> Numbers:
    """Add the covariance of cosines of random phase and normal amplitude, of these sds and periods."""
    for amplitude, period in waves:
        covariance = covariance + amplitude**2 * np.cos(2 * np.pi * distance / period)
    return covariance
