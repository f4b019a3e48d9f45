"""The Kalman filter of a joint's errors in time: states that are held, walk or are drawn anew. NumPy or JAX.

Arrays have the axis of the states first, then any axes of points: means (states, ..., columns), for several columns at
once, covariances (states, states, ...), loads (states, ...). Anderson and Moore, Optimal Filtering, Prentice-Hall 1979,
3.1, with a scalar observation; formulation 4.1, 8.2.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np


def _along(values: Any, ndim: int) -> Any:
    """Add axes at the end up to `ndim`."""
    return values.reshape(values.shape + (1,) * (ndim - values.ndim))


def state_predicted(mean: Any, covariance: Any, keep: Any, variance: Any, xp: ModuleType = np) -> tuple[Any, Any]:
    """Mean and covariance of the states before an observation.

    Args:
        mean: means after the last one.
        covariance: covariance after it.
        keep: what is left of each state: 0 where it is drawn anew, 1 where it is held.
        variance: what is added to its variance: of the draw, or of a random walk.
        xp: numpy or jax.numpy.
    """
    added = _along(xp.eye(len(keep)), keep.ndim + 1) * variance
    return mean * _along(keep, mean.ndim), covariance * (keep[:, None] * keep) + added


def state_updated(
    mean: Any, covariance: Any, observed: Any, load: Any, noise: Any, xp: ModuleType = np
) -> tuple[Any, Any, Any, Any, Any]:
    """Update the states with an observation `load @ states` + noise.

    Args:
        mean: means of the states.
        covariance: their covariance.
        observed: what was observed, or other columns to filter.
        load: d(observed)/d(state).
        noise: variance of the observation's own noise.
        xp: numpy or jax.numpy.

    Returns:
        Means and covariance, the innovation, its variance, and the states' covariance with it.
    """
    # Sums instead of matrix products: a library call costs more than a few numbers.
    gain = xp.sum(covariance * load, axis=1)
    variance = noise + xp.sum(load * gain, axis=0)
    innovation = observed - xp.sum(_along(load, mean.ndim) * mean, axis=0)
    relative = innovation / _along(variance, innovation.ndim)
    mean = mean + _along(gain, mean.ndim) * relative
    return mean, covariance - gain[:, None] * (gain / variance), innovation, variance, gain


def whitened(
    columns: np.ndarray, keep: np.ndarray, variance: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Columns as innovations over their sd (rows, n, c), and the log-determinant of the scatter (n,).

    Args:
        columns: observations of the sum of all states, shape (rows, n or 1, c), in time order.
        keep: as of `state_predicted`, by row, shape (rows, states, n).
        variance: likewise.
        noise: variance of each row, (rows, n).
    """
    states, n = keep.shape[1:]
    shape = n, columns.shape[2]
    mean, covariance, load = np.zeros((states, *shape)), np.zeros((states, states, n)), np.ones((states, n))
    white, scatter = np.empty((len(columns), *shape)), np.empty(noise.shape)
    for row in range(len(columns)):
        mean, covariance = state_predicted(mean, covariance, keep[row], variance[row])
        mean, covariance, white[row], scatter[row], _ = state_updated(mean, covariance, columns[row], load, noise[row])
    return white / np.sqrt(scatter)[..., None], np.log(scatter).sum(axis=0)
