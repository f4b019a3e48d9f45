"""Noise scales of a fit with geometry and cameras integrated out: their marginal mode, and weighted draws.

At the joint mode they are too small, since geometry and cameras are fitted to the noise of the same looks: as a
variance divided by n instead of n - p (restricted likelihood: Patterson and Thompson, Biometrika 58 (1971) 545). A
prediction of new looks needs the marginal scales.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tvsbayes.estimators.annealed_stage import linearised_at
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.likelihood import evaluate, no_draw
from tvsbayes.estimators.linear_spots import linear_spots, stop_information
from tvsbayes.instrument.parameters import GEAR_ERROR_NAMES, NOISE_NAMES

STEP = 0.05
"""Step of central differences, in sds of the Laplace approximation; the weights correct for larger curvature."""
STEPS_TO_MODE = 2
LONGEST_STEP = 2.0
"""Longest step towards the mode, in the same sds."""
WIDER = 1.15
"""Factor on the sds of the Laplace approximation for the proposal, as the approximation is at the joint mode."""


@dataclass(frozen=True)
class NoiseDraws:
    """Points with drawn noise scales and all other coordinates at the mode of the fit.

    Attributes:
        centre: the most probable scales, shape (p,).
        z: drawn, shape (n, p).
        weights: weights of the draws, their sum 1, shape (n,).
    """

    centre: np.ndarray
    z: np.ndarray
    weights: np.ndarray


class MarginalScales:
    """Marginal log density of the noise scales of a fit, geometry and cameras integrated out, up to a constant.

    These are normal at given scales, as the campaign is linearised there.
    """

    def __init__(self, fit: JointFit):
        self.fit = fit
        self.columns = np.flatnonzero(np.isin(fit.names, NOISE_NAMES) & fit.free)

    def __call__(self, z: np.ndarray) -> np.ndarray:
        """Evaluate at points (n, p) that differ in their noise scales, shape (n,)."""
        arrays = self.fit.arrays
        joint = evaluate(z, no_draw(len(z), arrays), self.fit.space, arrays).log_density
        log_density = joint + np.array([self._log_integral(point) for point in z])
        return np.where(np.isfinite(log_density), log_density, -np.inf)

    def _log_integral(self, z: np.ndarray) -> float:
        """Compute the log density's increase at z by integrating out geometry and cameras."""
        arrays, held = self.fit.arrays, self.fit.held
        lin = linearised_at(z, self.fit.space, arrays)
        jacobian = lin.by_coordinates(held)
        information = stop_information(linear_spots(lin, arrays, jacobian))
        slope = information.score(jacobian) - np.where(held, 0.0, z)
        precision = information.fisher + np.eye(len(z))
        return float(0.5 * slope @ np.linalg.solve(precision, slope) - 0.5 * np.linalg.slogdet(precision)[1])


def noise_draws(fit: JointFit, count: int, seed: int) -> NoiseDraws:
    """Draw noise scales from their marginal, with weights.

    Args:
        fit: a converged fit.
        count: number of draws, even.
        seed: seed of the draws.
    """
    marginal = MarginalScales(fit)
    columns, centre = marginal.columns, fit.z.copy()
    if not columns.size:
        return NoiseDraws(centre, centre[None], np.ones(1))
    # Scales of repeating errors are at their marginal mode already, by the search for the mode.
    taken = columns[~np.isin(np.array(fit.names)[columns], GEAR_ERROR_NAMES)]
    root = np.linalg.cholesky(fit.covariance[np.ix_(taken, taken)])
    for _ in range(STEPS_TO_MODE if taken.size else 0):
        points = np.repeat(centre[None], 2 * taken.size, axis=0)
        points[:, taken] += STEP * np.concatenate([root.T, -root.T])
        ahead, behind = np.split(marginal(points), 2)
        step = (ahead - behind) / (2 * STEP)
        length = float(np.linalg.norm(step))
        centre[taken] += root @ step * min(1.0, LONGEST_STEP / max(length, 1e-300))
    root = np.linalg.cholesky(fit.covariance[np.ix_(columns, columns)])
    half = np.random.default_rng(seed).standard_normal((count // 2, columns.size))
    normal = np.concatenate([half, -half])
    z = np.repeat(centre[None], len(normal), axis=0)
    z[:, columns] += WIDER * normal @ root.T
    log_weights = marginal(z) + 0.5 * np.sum(normal**2, axis=1)
    weights = np.exp(log_weights - np.max(log_weights))
    return NoiseDraws(centre, z, weights / weights.sum())
