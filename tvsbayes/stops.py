"""Information stop by stop: leave-one-out residuals and densities, and what the fit would lose without a stop.

All spots taken between two moves share their stop errors and form a group. With C the covariance of all residuals
(unit noise + stop errors, home offsets, unknown play), one forward and one backward pass give, for every group g,
u_g = [C^-1 r]_g, [C^-1 J]_g and the diagonal block M_g = [C^-1]_gg in time linear in the number of groups
(disturbance smoother: de Jong, Biometrika 75 (1988) 594; Durbin and Koopman, Time Series Analysis by State Space
Methods, 4.5). The densities of whole moves given all other spots come from the same two passes in JAX, for many
points of parameter space at once. Residuals in units of their noise, angles rad.
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import linalg

from tvsbayes.likelihood import (
    STATES,
    Belief,
    CampaignArrays,
    FilterRows,
    filter_input,
    look,
    no_belief,
)
from tvsbayes.model import ParameterSpace

RANK_TOLERANCE = 1e-12
"""Share of a state's precision below which what other states leave of it is rounding, not information."""


@dataclass(frozen=True)
class LinearSpots:
    """The linearised campaign, spots in time order, without padding.

    Attributes:
        residual: observed - predicted, shape (n, 4).
        load: d(predicted)/d(filter state), shape (n, 4, 6).
        renewed: states drawn anew since the previous spot, shape (n, 6).
        variance: their variances, shape (n, 6).
        jacobian: -d(residual)/d(coordinates), shape (n, 4, p).
        move: move of each spot, shape (n,).
    """

    residual: np.ndarray
    load: np.ndarray
    renewed: np.ndarray
    variance: np.ndarray
    jacobian: np.ndarray
    move: np.ndarray


@dataclass(frozen=True)
class StopGroup:
    """Consecutive spots that share all their states.

    Attributes:
        rows: slice of the spots.
        residual: [C^-1 r] of the group, shape (4 s,).
        jacobian: [C^-1 J] of the group, shape (4 s, p).
        precision: [C^-1] of the group, shape (4 s, 4 s).
    """

    rows: slice
    residual: np.ndarray
    jacobian: np.ndarray
    precision: np.ndarray


@dataclass(frozen=True)
class StopInformation:
    """All groups, and the likelihood's Fisher information J^T C^-1 J, shape (p, p)."""

    groups: tuple[StopGroup, ...]
    fisher: np.ndarray


def _group_rows(renewed: np.ndarray) -> list[slice]:
    starts = [i for i in range(len(renewed)) if i == 0 or renewed[i].any()]
    return [slice(a, b) for a, b in zip(starts, [*starts[1:], len(renewed)], strict=True)]


def stop_information(spots: LinearSpots) -> StopInformation:
    """Filter forward, smooth backward.

    Args:
        spots: the linearised campaign.

    Returns:
        Groups in time order and the Fisher information of the coordinates.
    """
    parameters = spots.jacobian.shape[-1]
    states = spots.load.shape[-1]
    targets = np.concatenate([spots.residual[..., None], spots.jacobian], axis=2)
    slices = _group_rows(spots.renewed)
    mean, covariance = np.zeros((states, 1 + parameters)), np.zeros((states, states))
    fisher = np.zeros((parameters, parameters))
    forward = []
    for rows in slices:
        keep = ~spots.renewed[rows.start]
        mean = mean * keep[:, None]
        covariance = covariance * np.outer(keep, keep) + np.diag(spots.variance[rows.start] * ~keep)
        load = spots.load[rows].reshape(-1, states)
        ahead = targets[rows].reshape(-1, 1 + parameters) - load @ mean
        covariance_ahead = load @ covariance @ load.T + np.eye(len(load))
        inverse = linalg.cho_solve(linalg.cho_factor(covariance_ahead), np.eye(len(load)))
        gain = covariance @ load.T @ inverse
        whitened = inverse @ ahead
        fisher += ahead[:, 1:].T @ whitened[:, 1:]
        forward.append((keep, load, inverse, gain, whitened))
        mean = mean + gain @ ahead
        covariance = covariance - gain @ load @ covariance
        covariance = 0.5 * (covariance + covariance.T)

    groups = []
    score, information = np.zeros((states, 1 + parameters)), np.zeros((states, states))
    for rows, (keep, load, inverse, gain, whitened) in zip(slices[::-1], forward[::-1], strict=True):
        # `score` and `information` stand after this group's update: u = F^-1 v - K^T r, M = F^-1 + K^T N K.
        disturbance = whitened - gain.T @ score
        precision = inverse + gain.T @ information @ gain
        groups.append(StopGroup(rows, disturbance[:, 0], disturbance[:, 1:], precision))
        through = np.eye(states) - gain @ load
        score = (load.T @ disturbance + score) * keep[:, None]
        information = (load.T @ inverse @ load + through.T @ information @ through) * np.outer(keep, keep)
    return StopInformation(tuple(groups[::-1]), fisher)


def leave_one_out_chi2(information: StopInformation) -> np.ndarray:
    """Squared distance of each spot from what all OTHER spots predict for it, shape (n,).

    It equals twice the gain in log density from leaving the spot out, up to the determinant: of two spots of a
    stop that disagree, the one without which the rest fits better has the larger value. That is the spot to blame.
    """
    values = []
    for group in information.groups:
        for k in range(len(group.residual) // 4):
            part = slice(4 * k, 4 * k + 4)
            u, m = group.residual[part], group.precision[part, part]
            values.append(u @ np.linalg.solve(m, u))
    return np.array(values)


def standard_deviations_without(group: StopGroup, covariance: np.ndarray, gradients: np.ndarray) -> np.ndarray:
    """Standard deviations of quantities if a group's spots had not been taken.

    Removing a block from a Gaussian changes the information by -[C^-1 J]^T M^-1 [C^-1 J]; the covariance follows
    by Woodbury's identity.

    Args:
        group: the stop.
        covariance: posterior covariance of the coordinates, shape (p, p).
        gradients: d(quantity)/d(coordinates), shape (q, p).

    Returns:
        Shape (q,); inf where the rest of the campaign and the priors hold no information.
    """
    spread = group.jacobian @ covariance
    inner = group.precision - spread @ group.jacobian.T
    lost = spread @ gradients.T
    values, vectors = np.linalg.eigh(0.5 * (inner + inner.T))
    projected = vectors.T @ lost
    with np.errstate(divide="ignore", invalid="ignore"):
        extra = np.where(np.abs(projected) > 0, projected**2 / np.maximum(values, 0.0)[:, None], 0.0)
    return np.sqrt(np.einsum("qi,ij,qj->q", gradients, covariance, gradients) + extra.sum(axis=0))


class LaterSpots(eqx.Module):
    """What later spots say about the present state x: log density -x.precision.x/2 + score.x + constant."""

    precision: Float[Array, "6 6"]
    score: Float[Array, "6"]

    def with_spot(self, row: FilterRows) -> LaterSpots:
        """Add a spot that sees this state with unit noise."""
        precision = jnp.sum(row.load[:, :, None] * row.load[:, None, :], axis=0)
        return LaterSpots(self.precision + precision, self.score + jnp.sum(row.load * row.residual[:, None], axis=0))

    def before(self, row: FilterRows) -> LaterSpots:
        """Pass to the state of the previous spot: states drawn anew in between are integrated out, one by one."""
        precision, score = self.precision, self.score
        for state in range(STATES):
            variance = row.variance[state] * (1 - row.keep[state])
            column = precision[:, state]
            share = column * (variance / (1 + variance * column[state]))
            score = score - share * score[state]
            precision = precision - share[:, None] * column
        return LaterSpots(precision * (row.keep[:, None] * row.keep), score * row.keep)

    def joined(self, belief: Belief) -> Belief:
        """Belief of the state from earlier and later spots together.

        The later spots' precision is taken apart column by column (Cholesky without roots), each column acting
        like one more scalar look: no matrix library, whose calls would cost more than the filter.
        """
        mean, covariance = belief.mean, belief.covariance
        precision, score = self.precision, self.score
        floor = RANK_TOLERANCE * jnp.diagonal(precision)
        for state in range(STATES):
            pivot, column, moment = precision[state, state], precision[:, state], score[state]
            inverse = jnp.where(pivot > floor[state], 1 / jnp.where(pivot > floor[state], pivot, 1.0), 0.0)
            column = jnp.where(inverse > 0, column, 0.0)
            moment = jnp.where(inverse > 0, moment, 0.0)
            gain = jnp.sum(covariance * column, axis=1)
            weight = inverse / (1 + inverse * jnp.sum(column * gain))
            mean = mean + gain * (weight * (moment - jnp.sum(column * mean)))
            covariance = covariance - gain[:, None] * (gain * weight)
            precision = precision - column[:, None] * (column * inverse)
            score = score - column * (inverse * moment)
        return Belief(mean, covariance)


@eqx.filter_jit
def move_log_density(
    z: Float[Array, "batch parameters"], space: ParameterSpace, arrays: CampaignArrays
) -> Float[Array, "batch spots"]:
    """Log density of the spots of each move given ALL other spots and the parameters (DESIGN 4.3).

    Stop errors persist while their axis stands, so spots are not independent given the parameters; whole moves
    are the unit that can be left out. Backward and forward passes meet at each move (two-filter smoother: Fraser
    and Potter, IEEE Trans. Automat. Control 14 (1969) 387).

    Args:
        z: coordinates of many points.
        space: priors.
        arrays: the campaign.

    Returns:
        Contribution of each spot given the earlier spots of its own move and all spots of the other moves: the sum
        over a move's spots is the move's log density, without `likelihood.spot_constants`.
    """
    index = arrays.spots.move_index
    other = index[1:] != index[:-1]
    first, last = jnp.append(True, other), jnp.append(other, True)

    def backward(carry, row_and_last):
        later, beyond = carry
        row, last = row_and_last
        beyond = jax.tree.map(lambda a, b: jnp.where(last, a, b), later, beyond)
        return (later.with_spot(row).before(row), beyond), beyond

    def forward(carry, row_and_first):
        belief, cavity = carry
        row, first, beyond, log_scale = row_and_first
        belief = belief.renewed(row)
        cavity = jax.tree.map(lambda a, b: jnp.where(first, a, b), beyond.joined(belief), cavity)
        seen = look(cavity, row)
        log_density = log_scale - 0.5 * seen.log_variance - 0.5 * jnp.sum(seen.standardised**2)
        return (look(belief, row).belief, seen.belief), log_density

    def one(z):
        given = filter_input(space.model(z), arrays)
        nothing = LaterSpots(jnp.zeros((STATES, STATES)), jnp.zeros(STATES))
        _, beyond = jax.lax.scan(backward, (nothing, nothing), (given.rows, last), reverse=True)
        rows = (given.rows, first, beyond, given.log_scale)
        return jax.lax.scan(forward, (no_belief(), no_belief()), rows)[1]

    return jax.vmap(one)(z)
