"""The last least-squares stage of a fit, where every solver converges: its start, residuals and Jacobian.

Annealing reaches the basin; solvers are compared from there.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize

from experiments.common.jax_density import innovations as exact_innovations
from experiments.common.jax_density import root_at_places, without_padding
from tvsbayes.estimators.annealed_stage import Fixed, innovations, stage
from tvsbayes.estimators.campaign_arrays import CampaignArrays
from tvsbayes.estimators.kalman_filter import no_belief
from tvsbayes.estimators.linear_spots import linearise
from tvsbayes.estimators.mode_search import Problem
from tvsbayes.instrument.campaign import Campaign, ordered_spots
from tvsbayes.instrument.parameters import NAMES
from tvsbayes.model.descent import descend
from tvsbayes.statistics.least_squares import LinearResidual, linear_residual, residuals_and_jacobian

PEER_TOLERANCE = 1e-6
ANNEALING = (60.0, 10.0, 2.0)
"""Inflations of the stages before."""
Linear = Callable[..., LinearResidual]


def exact_values(z, args):
    """Standardised innovations, errors at places and prior residuals."""
    space, arrays, fixed = args
    full = jnp.where(fixed.held, fixed.value, z)
    return jnp.append(exact_innovations(full, space, arrays).residual, jnp.where(fixed.held, z - fixed.value, z))


def exact_residuals(z, args) -> LinearResidual:
    """With the Jacobian that holds nothing fixed."""
    return linear_residual(exact_values, z, args)


def stage_residuals(z, args) -> LinearResidual:
    """With the Jacobian of the fit's stage, which holds slopes and projections."""
    space, arrays, fixed = args
    full = jnp.where(fixed.held, fixed.value, z)
    lin, root = linearise(space.point(full), space, arrays), root_at_places(space.model(full), arrays.gears)
    places = len(root)
    columns = innovations(lin, arrays, no_belief(1 + z.size + places)).standardised.reshape(-1, 1 + z.size + places)
    prior = jnp.where(fixed.held, z - fixed.value, z)
    # The errors at places are least squares in every step.
    whole = jnp.concatenate([columns[:, : 1 + z.size], jnp.zeros((places, 1 + z.size))])
    repeated = columns[:, 1 + z.size :] @ root
    across = jnp.linalg.qr(jnp.concatenate([repeated, jnp.eye(places)]))[0]
    whole = whole - across @ (across.T @ whole)
    jacobian = jnp.where(fixed.held, 0.0, whole[:, 1:])
    return LinearResidual(jnp.append(whole[:, 0], prior), jnp.concatenate([jacobian, jnp.eye(z.size)]))


@dataclass
class LastStage:
    """What a solver is given; float64 has to be on.

    Attributes:
        start: coordinates (p,).
        args: of the residual functions, whose campaign has no padding.
        arrays: the campaign as the fit's stage takes it.
        compiling_s: CPU seconds of the first stage of the annealing, compilation included.
        calls: of `residuals` and `jacobian`, counted.
    """

    start: np.ndarray
    args: tuple
    arrays: CampaignArrays
    compiling_s: float
    calls: dict[str, int]

    def __post_init__(self) -> None:
        """Both kinds of residuals have the same values."""
        self._linear = {
            kind: jax.jit(lambda z, kind=kind: kind(z, self.args)) for kind in (stage_residuals, exact_residuals)
        }
        self._values = jax.jit(lambda z: exact_values(z, self.args))

    def residuals(self, z: np.ndarray) -> np.ndarray:
        """Values."""
        self.calls["residuals"] += 1
        return np.asarray(self._values(jnp.asarray(z)))

    def jacobian(self, z: np.ndarray, kind: Linear = stage_residuals) -> np.ndarray:
        """Derivative, with slopes and projection held fixed or not."""
        self.calls["Jacobians"] += 1
        return np.asarray(self._linear[kind](jnp.asarray(z)).jacobian)

    def ours(self, tolerance: float, steps: int, kind: Linear = stage_residuals) -> np.ndarray:
        """Where our solver ends: the compiled stage, or Levenberg-Marquardt with the exact Jacobian."""
        if kind is stage_residuals:
            space, _, fixed = self.args
            return stage(self.start, space, self.arrays, fixed, tolerance).z
        return descend(
            lambda at: residuals_and_jacobian(exact_values, jnp.asarray(at), self.args), self.start, tolerance, steps
        ).value

    def peer(self, method: str, differences: bool = False, kind: Linear = stage_residuals) -> np.ndarray:
        """Where `scipy.optimize.least_squares` ends, with the same Jacobian or with finite differences."""
        options = {"method": method, "xtol": PEER_TOLERANCE, "ftol": PEER_TOLERANCE, "gtol": PEER_TOLERANCE}
        jac = "2-point" if differences else lambda z: self.jacobian(z, kind)
        return optimize.least_squares(self.residuals, self.start, jac=jac, **options).x


def last_stage(campaign: Campaign) -> LastStage:
    """Anneal as a fit does; float64 has to be on."""
    problem = Problem(campaign, campaign.rig, np.ones(len(ordered_spots(campaign)), dtype=bool))
    begun = time.process_time()
    start = problem.least_squares(np.zeros(len(NAMES)), ANNEALING[0])
    compiling_s = time.process_time() - begun
    for inflation in ANNEALING[1:]:
        start = problem.least_squares(start, inflation)
    arrays = without_padding(problem.arrays, len(campaign.moves))
    args = problem.space, arrays, Fixed(problem.held, start, np.array(1.0))
    return LastStage(start, args, problem.arrays, compiling_s, {"residuals": 0, "Jacobians": 0})
