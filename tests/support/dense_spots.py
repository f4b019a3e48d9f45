"""The covariance of all residuals of a linearised campaign, spelled out: what filters and smoothers must agree with."""

from __future__ import annotations

import numpy as np

from tvsbayes.estimators.linear_spots import LinearSpots


def dense_covariance(spots: LinearSpots) -> np.ndarray:
    """Noise, stops, homings, unknown play and errors at places; not the coordinates. Shape (4 n, 4 n)."""
    size = len(spots.residual)
    covariance, states = np.zeros((size, 6, size, 6)), np.zeros((6, 6))
    for row in range(size):
        keep = ~spots.renewed[row]
        states = states * np.outer(keep, keep) + np.diag(spots.variance[row])
        covariance[row, :, row] = states
        if row:
            covariance[row, :, :row] = keep[:, None, None] * covariance[row - 1, :, :row]
            covariance[:row, :, row] = np.moveaxis(covariance[row, :, :row], 0, -1)
    load = np.zeros((size, 4, size, 6))
    load[np.arange(size), :, np.arange(size)] = spots.load
    load = load.reshape(4 * size, -1)
    places = spots.places.reshape(4 * size, -1)
    return np.eye(4 * size) + load @ covariance.reshape(6 * size, -1) @ load.T + places @ places.T
