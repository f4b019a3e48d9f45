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
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Columns as innovations over their sd (rows, n, c), and the log-determinant of the scatter (n,).

    Also the states after the last row: means (states, n, c) by columns, covariance (states, states, n).

    Args:
        columns: observations of the sum of all states, shape (rows, n or 1, c), in time order.
        keep: as of `state_predicted`, by row, shape (rows, states, n).
        variance: likewise.
        noise: variance of each row, (rows, n).
    """
    (rows, states, n), nothing = keep.shape, np.zeros((keep.shape[2], 0))
    mean, covariance, load = np.zeros((states, n, 0)), np.zeros((states, states, n)), np.ones((states, n))
    scatter, gains = np.empty(noise.shape), np.empty(keep.shape)
    for row in range(rows):
        _, covariance = state_predicted(mean, covariance, keep[row], variance[row])
        _, covariance, _, scatter[row], gains[row] = state_updated(mean, covariance, nothing, load, noise[row])
    # The gains depend on no column, and most states are held or drawn anew.
    held, gains = np.all(keep == 1, axis=2), (gains / scatter[:, None])[..., None]
    white, means = np.empty((rows, n, columns.shape[2])), np.zeros((states, n, columns.shape[2]))
    for row, innovation in enumerate(white):
        innovation[:] = columns[row]
        for state, own in enumerate(means):
            if not held[row, state]:
                own *= keep[row, state][:, None]
            innovation -= own
        for own, gain in zip(means, gains[row], strict=True):
            own += gain * innovation
    return white / np.sqrt(scatter)[..., None], np.log(scatter).sum(axis=0), means, covariance
