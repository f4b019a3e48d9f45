"""Whitened residuals drawn from the linear model of a campaign."""

from __future__ import annotations

import numpy as np

from tvsbayes.estimators.linear_spots import LinearSpots


def drawn_residual(spots: LinearSpots, seed: int) -> np.ndarray:
    """Unit noise of three components, stop errors that persist, zeros that walk; gears without errors. Shape (n, 4)."""
    generator = np.random.default_rng([seed, 0x76])
    state, residual = np.zeros(spots.load.shape[2]), np.zeros((len(spots.residual), 4))
    for row in range(len(residual)):
        fresh = generator.standard_normal(len(state)) * np.sqrt(spots.variance[row])
        state = np.where(spots.renewed[row], fresh, state + fresh)
        residual[row] = spots.load[row] @ state
        residual[row, :3] += generator.standard_normal(3)
    return residual
