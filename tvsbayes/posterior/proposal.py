"""What is sampled and how a step is proposed: the target in the map's coordinates, its pilot, the moves of emcee.

Coordinates w of `posterior.transport`, nearly standard normal; log densities are exact, the map's Jacobian in them.
"""

from __future__ import annotations

from dataclasses import dataclass

import emcee
import numpy as np
from scipy import special

from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.likelihood import evaluate
from tvsbayes.posterior.transport import BATCH, Transport, in_batches

WALKERS = 64
PILOT_DRAWS = 2048
PILOT_ROUNDS = 3
"""The first is drawn about the mode, each further one from the proposal that the last one gave."""
VARIANCE_RANGE, HEAVY_VARIANCE_RANGE = (0.8, 1.7), (0.8, 4.0)
"""Of the proposal, relative to the Laplace approximation's."""
HEAVY_DOF = 5.0
HEAVY_SHARE = 0.1
"""Share of the proposals from a multivariate t: it bounds the ratio target / proposal in the tails. In fifty
dimensions a t alone puts most draws off the shell where the target lives: effective draws fell threefold."""
INFLATION = 1.03
"""Factor on the proposal's sds: a proposal lighter than the target lets walkers freeze in its tails."""
SHARES = (0.85, 0.1, 0.05)
"""Independence proposal, differential evolution, differential evolution with full steps."""


class Target:
    """The log posterior density of walkers, as emcee calls it: NumPy in, NumPy out, NaN refused and counted."""

    def __init__(self, fit: JointFit, path: Transport):
        self.fit, self.path = fit, path
        self.invalid = 0

    def __call__(self, w: np.ndarray) -> np.ndarray:
        """Log density of w (n, d), relative to z's at the mode; -inf where the model has no value."""
        found = self.path.mapped(w)
        value = in_batches(lambda block: evaluate(block, self.fit.space, self.fit.arrays).log_density, found.z)
        invalid = np.isnan(value)
        self.invalid += int(invalid.sum())
        return np.where(invalid, -np.inf, value - self.fit.log_density + found.log_jacobian)


def _t_constant(dimension: int) -> float:
    """Log of the normalisation of a multivariate t with `HEAVY_DOF` degrees of freedom and unit scale."""
    value = special.gammaln(0.5 * (HEAVY_DOF + dimension)) - special.gammaln(0.5 * HEAVY_DOF)
    return float(value - 0.5 * dimension * np.log(HEAVY_DOF * np.pi))


@dataclass(frozen=True)
class Independence:
    """Independence proposal: normal, in heavy coordinates t, and a share of a multivariate t of the same scale.

    Called by `emcee.moves.MHMove` with (points, generator); returns new points and ln q(old) - ln q(new).

    Attributes:
        mean, sd: of every coordinate, shape (d,).
        heavy: coordinates proposed from a t of their own, shape (d,), boolean.
    """

    mean: np.ndarray
    sd: np.ndarray
    heavy: np.ndarray

    def log_density(self, w: np.ndarray) -> np.ndarray:
        """Log density, shape (n,)."""
        dimension = len(self.mean)
        distance2 = ((w - self.mean) / self.sd) ** 2
        normal = -0.5 * np.log(2 * np.pi) - 0.5 * distance2
        single = _t_constant(1) - 0.5 * (HEAVY_DOF + 1) * np.log1p(distance2 / HEAVY_DOF)
        each = np.sum(np.where(self.heavy, single, normal), axis=1)
        total2 = np.sum(distance2, axis=1)
        joint = _t_constant(dimension) - 0.5 * (HEAVY_DOF + dimension) * np.log1p(total2 / HEAVY_DOF)
        mixture = np.logaddexp(np.log(1 - HEAVY_SHARE) + each, np.log(HEAVY_SHARE) + joint)
        return mixture - np.sum(np.log(self.sd))

    def draw(self, count: int, generator: np.random.RandomState) -> np.ndarray:
        """Independent draws, shape (count, d)."""
        dimension = len(self.mean)
        normal = generator.standard_normal((count, dimension))
        single = np.sqrt(generator.chisquare(HEAVY_DOF, (count, dimension)) / HEAVY_DOF)
        joint = np.sqrt(generator.chisquare(HEAVY_DOF, (count, 1)) / HEAVY_DOF)
        together = generator.uniform(size=(count, 1)) < HEAVY_SHARE
        return self.mean + self.sd * normal / np.where(together, joint, np.where(self.heavy, single, 1.0))

    def __call__(self, w: np.ndarray, generator: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """The protocol of `emcee.moves.MHMove`."""
        proposed = self.draw(len(w), generator)
        return proposed, self.log_density(w) - self.log_density(proposed)


def moves(proposal: Independence) -> list[tuple[emcee.moves.Move, float]]:
    """The moves and their shares; never emcee 3.1.6's snooker or full-covariance Gaussian (both are biased)."""
    # Fewer walkers than twice the dimension let differential evolution explore a subspace only; the
    # independence proposal leaves it at six steps of seven.
    evolution = emcee.moves.DEMove(live_dangerously=True), emcee.moves.DEMove(gamma0=1.0, live_dangerously=True)
    return list(zip((emcee.moves.MHMove(proposal), *evolution), SHARES, strict=True))


def walkers_for(dimension: int) -> int:
    """Ensemble size: more walkers than dimensions, whole batches in each half."""
    return max(WALKERS, 2 * BATCH * -(-(dimension + 1) // (2 * BATCH)))


@dataclass(frozen=True)
class Pilot:
    """What importance sampling from the transported Laplace approximation tells before the chain starts.

    Attributes:
        proposal: centred where the posterior's mean is, which is not its mode.
        start: first positions, importance-resampled, shape (walkers, d).
        log_weights: log (target / proposal) of the last round's draws.
    """

    proposal: Independence
    start: np.ndarray
    log_weights: np.ndarray


def pilot(target: Target, seed: int) -> Pilot:
    """Shift the proposal to the posterior mean and choose starting points.

    Args:
        target: the log density.
        seed: of the pilot draws.

    Raises:
        FloatingPointError: no draw has a finite density.
    """
    generator = np.random.RandomState(seed)
    dimension = target.path.dimension
    heavy = target.path.heavy
    proposal = Independence(np.zeros(dimension), np.ones(dimension), heavy)
    limits = np.where(heavy, np.array(HEAVY_VARIANCE_RANGE)[:, None], np.array(VARIANCE_RANGE)[:, None])
    for _ in range(PILOT_ROUNDS):
        w = proposal.draw(PILOT_DRAWS, generator)
        log_target = target(w)
        log_weights = log_target - proposal.log_density(w)
        finite = np.isfinite(log_weights)
        if finite.sum() < walkers_for(dimension):
            raise FloatingPointError("the posterior density is not finite around the mode")
        # Where the target is normal, log(target / normal of the proposal) is linear in w and w^2: the coefficients give
        # its mean and sds. A regression on the draws that matter is far steadier than weighted moments.
        matters = finite & (log_weights > np.max(log_weights[finite]) - 12)
        if matters.sum() <= 8 * dimension:
            break
        near = (w[matters] - proposal.mean) / proposal.sd
        design = np.column_stack([np.ones(len(near)), near, near**2])
        ratio = log_target[matters] + 0.5 * np.sum(near**2, axis=1)
        slope, square = np.split(np.linalg.lstsq(design, ratio, rcond=None)[0][1:], 2)
        variance = 1 / np.clip(1 - 2 * square, 0.6, 1.6)
        mean = proposal.mean + proposal.sd * np.clip(slope * variance, -1.0, 1.0)
        variance = np.clip(proposal.sd**2 * variance, *limits)
        proposal = Independence(mean, INFLATION * np.sqrt(variance), heavy)
    # Gumbel's trick: the largest perturbed weights are a weighted sample without replacement.
    keys = np.where(finite, log_weights, -np.inf) + generator.gumbel(size=len(w))
    start = w[np.argsort(-keys)[: walkers_for(dimension)]]
    return Pilot(proposal, start, log_weights)
