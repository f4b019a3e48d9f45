"""One least-squares stage of the joint fit: geometry and stereo for held noise scales (formulation 4.2).

Levenberg-Marquardt on [standardised innovations; prior residuals] in the coordinates of `model.parameter_space`. Slopes
and projections are held in the Jacobian (Kaufman's variant of variable projection: the optimum is unchanged to first
order in the residual), so that it is the linearisation that all diagnoses use, sent through the filter.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from tvsbayes.estimators.campaign_arrays import CampaignArrays
from tvsbayes.estimators.likelihood import filter_rows, filtered
from tvsbayes.estimators.linear_spots import Linearised, linearise
from tvsbayes.estimators.spot_residuals import ToStates
from tvsbayes.model.compiled import compiled
from tvsbayes.model.parameter_space import ParameterSpace
from tvsbayes.statistics.least_squares import LinearResidual, damped_solver, descend

STAGE_TOLERANCE = 1e-2
STAGE_STEPS = 12
"""Levenberg-Marquardt only has to reach the basin: its frozen Jacobian is not exact at the level of the noise, where it
would stall; the Newton steps on the full density finish the work."""
NO_STEP = 1e300
"""The tolerance that the start meets: the stage is then the linearisation there."""


class Fixed(eqx.Module):
    """What a least-squares stage holds: coordinates kept at a value, and the factor on the noise."""

    held: Bool[Array | np.ndarray, " parameters"]
    value: Float[Array | np.ndarray, " parameters"]
    inflation: Float[Array | np.ndarray, ""]


def innovations(lin: Linearised, arrays: CampaignArrays) -> Float[Array, "innovations columns"]:
    """Standardised innovations of the linearised campaign; in the further columns how coordinates move them.

    The errors at places stand last among them, as coordinates with standard normal priors.
    """
    by_pan, by_tilt = (tuple(lin.slope[:, :, axis].T) for axis in range(2))
    turned = ToStates.of(by_pan, by_tilt)
    both = jnp.concatenate([lin.residual[..., None], lin.residual_jacobian, -lin.place_load], axis=2)
    columns = turned.of_many(tuple(both.transpose(1, 2, 0)))
    seen, free = (jnp.stack(part).transpose(2, 0, 1) for part in (columns[:2], columns[2:]))
    rows = filter_rows(seen, turned.slope, lin.play_sd_rad, lin.stop_variance, lin.drift_variance, arrays.spots)
    return jnp.concatenate([filtered(rows).standardised, free], axis=1).reshape(-1, both.shape[2])


def reduced_residuals(
    z: Float[Array, " parameters"], args: tuple[ParameterSpace, CampaignArrays, Fixed]
) -> LinearResidual:
    """As few residuals as have the sum of squares, slope and normal equations of innovations and prior.

    With N = J'J + 1 = L L' and the slope g they are [L^-1 g; what is left of the length], their Jacobian [L'; 0]: prior
    coordinates keep N's condition harmless, and every later product is a thirtieth of the size. The errors at places
    are least squares in every step: they stand before the coordinates in N, and what L has of them is left out.
    """
    space, arrays, fixed = args
    lin = linearise(jnp.where(fixed.held, fixed.value, z), space, arrays, fixed.inflation)
    columns = innovations(lin, arrays)
    places = lin.place_load.shape[2]
    residual, jacobian = columns[:, 0], jnp.where(fixed.held, 0.0, columns[:, 1 : 1 + z.size])
    jacobian = jnp.concatenate([columns[:, 1 + z.size :], jacobian], axis=1)
    prior = jnp.concatenate([jnp.zeros(places), jnp.where(fixed.held, z - fixed.value, z)])
    root = jnp.linalg.cholesky(jacobian.T @ jacobian + jnp.eye(prior.size))
    explained = jax.scipy.linalg.solve_triangular(root, jacobian.T @ residual + prior, lower=True)
    left = jnp.dot(residual, residual) + jnp.dot(prior, prior) - jnp.dot(explained, explained)
    reduced = jnp.append(explained[places:], jnp.sqrt(jnp.maximum(left, 0.0)))
    slope = jnp.concatenate([root[places:, places:].T, jnp.zeros((1, z.size))])
    return LinearResidual(reduced, slope, lin)


@compiled(Linearised)
def stage(
    z: Float[Array, " parameters"],
    space: ParameterSpace,
    arrays: CampaignArrays,
    fixed: Fixed,
    tolerance: Float[Array, ""],
) -> Linearised:
    """Geometry and stereo for given noise scales, from z: where Levenberg-Marquardt ended, and the campaign there.

    With the tolerance `NO_STEP` the campaign linearised at z: one compiled function serves both.
    """
    solver = damped_solver(tolerance, normal_equations=True)
    return descend(reduced_residuals, solver, z, (space, arrays, fixed), STAGE_STEPS).also
