"""The posterior density of a campaign as one function of JAX: derivatives for samplers and solvers that need them.

`tvsbayes.estimators.likelihood.evaluate` has no derivatives: it passes blocks of spots in a loop of unknown length, and
eliminates the errors at places in NumPy. Here its pieces pass all spots at once. float64 has to be on; angles rad.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import block_diag, solve_triangular

from tvsbayes.estimators.campaign_arrays import CampaignArrays, GearArrays
from tvsbayes.estimators.kalman_filter import filtered, no_belief
from tvsbayes.estimators.likelihood import filter_input, look_terms, place_columns
from tvsbayes.model.gear_processes import FLOOR_RAD2
from tvsbayes.model.laser_path import mirror_angles
from tvsbayes.model.parameter_space import Model, ParameterSpace
from tvsbayes.statistics.gaussian_process import JITTER


def without_padding(arrays: CampaignArrays, moves: int) -> CampaignArrays:
    """A campaign's own moves, spots and places: derivatives in reverse mode pass through every row."""
    real = arrays.of_spots(0, int(arrays.count))
    of_moves = jax.tree.map(lambda of_move: of_move[:moves], real.moves)
    return CampaignArrays(of_moves, real.spots, real.gears.without_padding(), real.azimuth_convention, real.count)


def root_at_places(model: Model, gears: GearArrays) -> jax.Array:
    """Lower triangular factor of the covariance of the errors of the gears' columns, as `likelihood.roots_at`."""
    places, scales = gears.places, model.gears
    if not len(places.steps):
        return jnp.zeros((0, 0))
    axis = jnp.asarray(places.on_tilt, dtype=int)
    angle_rad = places.steps * model.transmission.ratio_rad_per_step[axis]
    distance = angle_rad[:, None] - angle_rad
    together = (axis[:, None] == axis) & places.valid[:, None] & places.valid
    scaled = 5**0.5 * jnp.abs(distance) / scales.length_rad[axis, None]
    near = (1 + scaled + scaled**2 / 3) * jnp.exp(-scaled)
    variance, waves = scales.error_rad[axis] ** 2, scales.amplitude_rad[axis] ** 2
    phases = 2 * jnp.pi * distance[..., None] / scales.period_rad[axis, None]
    covariance = variance[:, None] * near + jnp.sum(waves[:, None] * jnp.cos(phases), axis=2)
    floor = JITTER * (variance + jnp.sum(waves, axis=1)) + FLOOR_RAD2
    error_root = jnp.linalg.cholesky(jnp.where(together, covariance, jnp.diag(variance)) + jnp.diag(floor))
    # The play scales the factor, not the covariance: its derivative then exists at zero play too.
    one = jnp.eye(len(axis))
    play_root = scales.play_rad[axis, None] * jnp.linalg.cholesky(jnp.where(together, near, one) + JITTER * one)
    return block_diag(error_root, play_root)[gears.error][:, gears.error]


class Innovations(eqx.Module):
    """Standardised one-step prediction errors, N(0, 1) and independent under the model, and the log likelihood.

    `residual` holds of each spot two components from the filter, at the means of the errors at places, then four that
    depend on no state; behind all spots these means, divided by their factor. The squares sum to the quadratic form.
    `log_density` is without the terms of `spot_constants`.
    """

    residual: jax.Array
    log_density: jax.Array


def innovations(z: jax.Array, space: ParameterSpace, arrays: CampaignArrays) -> Innovations:
    """Of all spots in time order; `arrays` as from `without_padding`."""
    model = space.model(z)
    every = mirror_angles(model.transmission, model.tilt_zero_rad, arrays.moves)
    angles = jax.tree.map(lambda of_moves: of_moves[arrays.spots.move_index], every)
    start, stood = filter_input(model, arrays, angles), look_terms(model, arrays, angles=angles)
    free = jnp.stack(stood.to_states.of_many(stood.terms.residual)[2:], axis=1)
    root = root_at_places(model, arrays.gears)
    both = [start.rows.residual[..., None], place_columns(start.slope, arrays.gears) @ root]
    rows = eqx.tree_at(lambda r: r.residual, start.rows, jnp.concatenate(both, axis=2))
    out = filtered(rows, no_belief(1 + len(root)))
    residual, load = out.standardised[..., 0].ravel(), out.standardised[..., 1:].reshape(-1, len(root))
    # Least squares for the errors at places, which are N(0, 1) in units of the factor.
    factor = jnp.linalg.cholesky(jnp.eye(len(root)) + load.T @ load)
    explained = solve_triangular(factor, load.T @ residual, lower=True)
    mean = solve_triangular(factor, explained, lower=True, trans="T")
    squares = residual @ residual - explained @ explained + jnp.sum(out.log_variance)
    log_density = jnp.sum(start.log_scale) - 0.5 * squares - jnp.sum(jnp.log(jnp.diagonal(factor)))
    of_spots = jnp.concatenate([(residual - load @ mean).reshape(-1, 2), free], axis=1)
    return Innovations(jnp.append(of_spots, mean), log_density)


def log_density(z: jax.Array, space: ParameterSpace, arrays: CampaignArrays) -> jax.Array:
    """Log posterior density of the coordinates, as `likelihood.evaluate`; `arrays` as from `without_padding`."""
    return innovations(z, space, arrays).log_density - 0.5 * jnp.dot(z, z)
