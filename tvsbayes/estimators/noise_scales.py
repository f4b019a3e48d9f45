"""Noise scales of a fit with geometry and cameras integrated out: their most probable values, and weighted draws.

At the mode of everything together they are too small: geometry and cameras have followed the noise of the same looks,
and what they took is missing there, as n is for n - p in a variance (restricted likelihood: Patterson and Thompson,
Biometrika 58 (1971) 545). Anyone who predicts new looks needs the scales without that loss.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tvsbayes.estimators.annealed_stage import NO_STEP, Fixed, stage
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.likelihood import evaluate, no_draw
from tvsbayes.estimators.linear_spots import linear_spots, stop_information
from tvsbayes.instrument.parameters import GEAR_ERROR_NAMES, INDEX, NAMES, NOISE_NAMES
from tvsbayes.model.parameter_space import ParameterSpace

STEP = 0.05
"""Of central differences, in sds of the Laplace approximation: what bends beyond is the weights' business."""
STEPS_TO_MODE = 2
LONGEST_STEP = 2.0
"""In the same sds, of one step towards the mode."""
WIDER = 1.15
"""The proposal's sds over those of the Laplace approximation, which has no room for what geometry took."""


@dataclass(frozen=True)
class NoiseDraws:
    """Points whose noise scales differ, everything else at the mode of the fit.

    Attributes:
        centre: the most probable scales, shape (p,).
        z: drawn, shape (n, p).
        weights: of the draws, their sum 1, shape (n,).
    """

    centre: np.ndarray
    z: np.ndarray
    weights: np.ndarray


class ScalesAlone:
    """Log density of the noise scales of a fit, geometry and cameras integrated out, up to a constant.

    These are normal at given scales as the campaign is linearised at the mode.
    """

    def __init__(self, fit: JointFit):
        self.fit = fit
        self.columns = np.flatnonzero(np.isin(NAMES, NOISE_NAMES) & fit.free)
        self._space: ParameterSpace = fit.space

    def __call__(self, z: np.ndarray) -> np.ndarray:
        """At points (n, p) that differ in their noise scales, shape (n,)."""
        arrays, still = self.fit.arrays, no_draw(len(z), self.fit.arrays)
        joint = evaluate(z, still, self._space, arrays).log_density
        log_density = joint + np.array([self._room(point) for point in z])
        return np.where(np.isfinite(log_density), log_density, -np.inf)

    def _room(self, z: np.ndarray) -> float:
        """What integrating geometry and cameras out adds to the density at z."""
        arrays = self.fit.arrays
        lin = stage(z, self._space, arrays, Fixed(self.fit.held, z, np.array(1.0)), NO_STEP)
        jacobian = np.where(self.fit.held, 0.0, -np.asarray(lin.residual_jacobian))
        spots = linear_spots(lin, arrays, jacobian)
        information = stop_information(spots)
        errors = np.concatenate([group.residual for group in information.groups])
        slope = jacobian.reshape(len(errors), -1).T @ errors - np.where(self.fit.held, 0.0, z)
        precision = information.fisher + np.eye(len(z))
        return float(0.5 * slope @ np.linalg.solve(precision, slope) - 0.5 * np.linalg.slogdet(precision)[1])


def noise_draws(fit: JointFit, count: int, seed: int) -> NoiseDraws:
    """Weighted draws of the noise scales alone.

    Args:
        fit: converged.
        count: draws, an even number.
        seed: of the draws.
    """
    alone = ScalesAlone(fit)
    columns, centre = alone.columns, fit.z.copy()
    if not columns.size:
        return NoiseDraws(centre, centre[None], np.ones(1))
    # What the gears repeat has given its room back already, in the search for the mode.
    taken = np.setdiff1d(columns, [INDEX[name] for name in GEAR_ERROR_NAMES])
    root = np.linalg.cholesky(fit.covariance[np.ix_(taken, taken)])
    for _ in range(STEPS_TO_MODE if taken.size else 0):
        points = np.repeat(centre[None], 2 * taken.size, axis=0)
        points[:, taken] += STEP * np.concatenate([root.T, -root.T])
        ahead, behind = np.split(alone(points), 2)
        step = (ahead - behind) / (2 * STEP)
        length = float(np.linalg.norm(step))
        centre[taken] += root @ step * min(1.0, LONGEST_STEP / max(length, 1e-300))
    root = np.linalg.cholesky(fit.covariance[np.ix_(columns, columns)])
    half = np.random.default_rng(seed).standard_normal((count // 2, columns.size))
    normal = np.concatenate([half, -half])
    z = np.repeat(centre[None], len(normal), axis=0)
    z[:, columns] += WIDER * normal @ root.T
    log_weights = alone(z) + 0.5 * np.sum(normal**2, axis=1)
    weights = np.exp(log_weights - np.max(log_weights))
    return NoiseDraws(centre, z, weights / weights.sum())
