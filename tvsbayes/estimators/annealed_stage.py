"""One least-squares stage of the joint fit: geometry and stereo at fixed noise scales (formulation 4.2).

Levenberg-Marquardt on [standardised innovations; prior residuals] in the coordinates of `model.parameter_space`. Slopes
and projections are held constant in the Jacobian (Kaufman's variant of variable projection: the optimum is unchanged to
first order in the residual). The filter can then process the same linearisation that all diagnoses use.
"""

from __future__ import annotations

from dataclasses import fields

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import linalg

from tvsbayes.estimators.campaign_arrays import CampaignArrays
from tvsbayes.estimators.kalman_filter import STATES, Belief, Seen, filter_rows, filtered
from tvsbayes.estimators.linear_spots import Linearised, LinearLooks, linearise
from tvsbayes.estimators.spot_residuals import ToStates
from tvsbayes.model.compiled import compiled
from tvsbayes.model.descent import descend
from tvsbayes.model.parameter_space import ParameterSpace, Point
from tvsbayes.statistics.least_squares import LinearResidual

STAGE_TOLERANCE = 1e-2
STAGE_STEPS = 12
"""Levenberg-Marquardt only has to reach the basin of the mode: with its approximate Jacobian it would stall at the
level of the noise. Newton steps on the full density find the mode."""
PART = 128
"""Spots linearised in one call; a larger campaign takes more calls."""


class Fixed(eqx.Module):
    """Constants of a least-squares stage: coordinates held at a value, and the factor on the noise."""

    held: Bool[Array | np.ndarray, " parameters"]
    value: Float[Array | np.ndarray, " parameters"]
    inflation: Float[Array | np.ndarray, ""]


def innovations(lin: LinearLooks, arrays: CampaignArrays, before: Belief) -> Seen:
    """Compute standardised innovations of linearised spots and, in further columns, their derivatives.

    Derivatives are by the coordinates, then by the errors at places, in rad. The first two components pass the filter;
    the other four depend on no state.
    """
    by_pan, by_tilt = (tuple(lin.slope[:, :, axis].T) for axis in range(2))
    turned = ToStates.of(by_pan, by_tilt)
    both = jnp.concatenate([lin.residual[..., None], lin.residual_jacobian, -lin.place_columns], axis=2)
    columns = turned.of_many(tuple(both.transpose(1, 2, 0)))
    observed, free = (jnp.stack(part).transpose(2, 0, 1) for part in (columns[:2], columns[2:]))
    rows = filter_rows(observed, turned.slope, lin.play_sd_rad, lin.stop_variance, lin.zero_variance, arrays.spots)
    result = filtered(rows, before)
    return eqx.tree_at(lambda f: f.standardised, result, jnp.concatenate([result.standardised, free], axis=1))


class Part(LinearLooks):
    """Some spots linearised, products of the columns of their innovations, and the filter's state after them."""

    gram: Float[Array, "columns columns"]
    mean: Float[Array, "6 columns"]
    covariance: Float[Array, "6 6"]


@compiled(Part)
def linear_part(
    at: Point,
    space: ParameterSpace,
    arrays: CampaignArrays,
    inflation: Float[Array, ""],
    first: Int[Array, ""],
    before: Belief,
) -> Part:
    """Linearise `PART` spots from the first on; `inflation` is a factor on their noise."""
    part = arrays.of_spots(first, min(PART, len(arrays.spots.valid)))
    lin = linearise(at, space, part, inflation)
    result = innovations(lin, part, before)
    columns = result.standardised.reshape(-1, result.standardised.shape[2])
    given = {field.name: getattr(lin, field.name) for field in fields(lin)}
    mean, covariance = jnp.asarray(result.belief.mean), jnp.asarray(result.belief.covariance)
    return Part(**given, gram=columns.T @ columns, mean=mean, covariance=covariance)


def linear_campaign(z: np.ndarray, space: ParameterSpace, arrays: CampaignArrays, fixed: Fixed) -> LinearResidual:
    """Reduce innovations and prior to the fewest residuals of equal sum of squares, gradient and normal equations.

    With N = J'J + 1 = L L' and the gradient g they are [L^-1 g; the remaining length], with Jacobian [L'; 0]. In prior
    coordinates N is well conditioned, and later products are a thirtieth of the size. The errors at places are
    eliminated in every step: they precede the coordinates in N, and their rows of L are dropped. `also` is the campaign
    linearised there, as NumPy arrays, without padding.
    """
    errors = arrays.gears.share.shape[1]
    point = space.known_point(np.where(fixed.held, fixed.value, z))
    before = Belief(np.zeros((STATES, 1 + z.size + errors)), np.zeros((STATES, STATES)))
    parts = []
    for first in range(0, int(arrays.count), PART):
        parts.append(linear_part(point, space, arrays, fixed.inflation, np.int32(first), before))
        before = Belief(parts[-1].mean, parts[-1].covariance)
    gram = np.sum([np.asarray(part.gram) for part in parts], axis=0)
    lin = Linearised.joined(parts, point, space, arrays)
    mixed = linalg.block_diag(lin.place_root, np.diag(np.where(fixed.held, 0.0, 1.0)))
    coordinates = np.concatenate([1 + z.size + np.arange(arrays.gears.columns), np.arange(1, 1 + z.size)])
    prior = np.concatenate([np.zeros(len(lin.place_root)), np.where(fixed.held, z - fixed.value, z)])
    root = np.linalg.cholesky(mixed.T @ gram[np.ix_(coordinates, coordinates)] @ mixed + np.eye(prior.size))
    slope = mixed.T @ gram[coordinates, 0] + prior
    explained = linalg.solve_triangular(root, slope, lower=True, check_finite=False)
    left = gram[0, 0] + prior @ prior - explained @ explained
    free = len(lin.place_root)
    value = np.append(explained[free:], np.sqrt(np.maximum(left, 0.0)))
    return LinearResidual(value, np.concatenate([root[free:, free:].T, np.zeros((1, z.size))]), lin)


def linearised_at(z: np.ndarray, space: ParameterSpace, arrays: CampaignArrays) -> Linearised:
    """Linearise a campaign at coordinates z (p,), as NumPy arrays, without padding."""
    return linear_campaign(z, space, arrays, Fixed(np.zeros(z.size, dtype=bool), z, np.array(1.0))).also


def stage(
    z: np.ndarray, space: ParameterSpace, arrays: CampaignArrays, fixed: Fixed, tolerance: float = STAGE_TOLERANCE
) -> Linearised:
    """Fit geometry and stereo for given noise scales from z; return the campaign linearised there."""
    return descend(lambda at: linear_campaign(at, space, arrays, fixed), z, tolerance, STAGE_STEPS).also
