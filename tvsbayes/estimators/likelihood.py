"""Likelihood of all spots of a campaign: flat ranges, marginal stop errors and home offsets (formulation 4.1).

Each spot gives four pixels and perhaps an aperture angle. Its range along the beam is unknown and flat in image
displacement: the part of the residual along d(pixels)/d(range) is projected out. Stop errors (persistent while
their axis stands still), home offsets and unknown play at the start of a segment are Gaussian states of a Kalman
filter in time order. Angles rad, lengths mm; residuals are in units of their stated standard deviations.

State of the filter: stop error (pan, tilt), home offset (pan, tilt), position in the unknown play band (pan, tilt)
in units of its standard deviation.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from tvsbayes.estimators.campaign_arrays import CampaignArrays, SpotArrays
from tvsbayes.instrument.axes import HOME_SD_DEG
from tvsbayes.model.compiled import compiled
from tvsbayes.model.geometry import (
    Scalar,
    along_batch,
    dot,
    materialise,
    project,
    rotate_about_z,
    rotation_matrix,
    transform,
)
from tvsbayes.model.laser_path import MirrorAngles, beam, mirror_angles
from tvsbayes.model.parameter_space import Model, ParameterSpace, Receiver

COMPONENTS = 4
"""Residuals that remain of a spot's five observations after its range is projected out; the last is zero
without an aperture reading."""
STATES = 6


def aperture_angle(
    receiver: Receiver, points_p_mm: Float[Array, "3 *batch"], azimuth_convention: Bool[Array, ""]
) -> Float[Array, "*batch"]:
    """Angle B at the aperture between +y of frame T and the spot, or its projection on x-y (formulation 5)."""
    turned = rotate_about_z(receiver.pan_zero_emission_rad - jnp.pi / 2, points_p_mm)
    lateral2 = turned[0] ** 2 + jnp.where(azimuth_convention, 0.0, 1.0) * turned[2] ** 2
    # A spot on the baseline itself has no direction; the floor keeps the derivative finite there.
    return jnp.arctan2(jnp.sqrt(jnp.maximum(lateral2, 1e-12)), turned[1] + receiver.baseline_mm)


def observe(
    model: Model, pose: Float[Array, "3 *batch"], azimuth_convention: Bool[Array, ""]
) -> Float[Array, "5 *batch"]:
    """What ideal looks return.

    Args:
        model: parameters.
        pose: first axis pan (rad), tilt (rad), range along the beam (mm).
        azimuth_convention: convention of the aperture's reading.

    Returns:
        First axis u_left, v_left, u_right, v_right (px), aperture reading (rad).
    """
    pan, tilt, range_mm = pose
    ray = beam(model.optics, pan, tilt)
    points_p = materialise(ray.origin_mm + range_mm * ray.direction)
    extrinsics = model.extrinsics
    points_s = transform(rotation_matrix(extrinsics.rotation_rad), points_p)
    points_s = materialise(points_s + along_batch(extrinsics.translation_mm, pan))
    angle = aperture_angle(model.receiver, points_p, azimuth_convention) + model.receiver.aperture_zero_rad
    return jnp.concatenate([project(model.cameras, points_s), angle[None]])


def nearest_range(
    model: Model,
    pan: Float[Array, "*batch"],
    tilt: Float[Array, "*batch"],
    points_s_mm: Float[Array, "3 *batch"],
) -> Float[Array, "*batch"]:
    """Ranges at which the beams pass closest to points of frame S, mm."""
    ray = beam(model.optics, pan, tilt)
    extrinsics = model.extrinsics
    from_origin = points_s_mm - along_batch(extrinsics.translation_mm, pan)
    points_p = transform(rotation_matrix(extrinsics.rotation_rad).T, from_origin)
    return dot(points_p - ray.origin_mm, ray.direction)


class SpotResiduals(eqx.Module):
    """All spots after their ranges are projected out, in units of their noise (stated sd x pixel scale).

    `residual` = observed - predicted; `slope` = d(predicted)/d(pan, tilt); `log_scale` holds each spot's
    -3 log(pixel_scale) and, with an aperture reading, what the fifth observation adds: zero for padding.
    `predicted` is the ideal observation (px, rad) at the triangulated point's range.
    """

    residual: Float[Array, "spots 4"]
    slope: Float[Array, "spots 4 2"]
    log_scale: Float[Array, " spots"]
    predicted: Float[Array, "spots 5"]


def whitened(
    vectors: Float[Array, "n 5 spots"],
    spots: SpotArrays,
    pixel_noise: Scalar,
    aperture_noise: Scalar,
    root_weight: Float[Array, " spots"],
) -> Float[Array, "n 5 spots"]:
    """Differences of observations in units of their noise; the noise is the inverse factor on the stated sds."""
    pixels = jnp.sum(spots.whitening.transpose(1, 2, 0) * vectors[:, None, :4], axis=2) * (pixel_noise * root_weight)
    return jnp.concatenate([pixels, vectors[:, 4:] * (aperture_noise * root_weight * spots.has_aperture)], 1)


def spot_residuals(
    model: Model, angles: MirrorAngles, arrays: CampaignArrays, inflation: Scalar, frozen: bool
) -> SpotResiduals:
    """Linearise every spot about the triangulated point's range (formulation 4.1).

    Args:
        model: parameters.
        angles: mirror angles of all moves.
        arrays: the campaign.
        inflation: factor on the noise while the fit is annealed.
        frozen: hold slopes and projection fixed under differentiation. The optimum of a least-squares
            residual is unchanged to first order in the residual (Kaufman's variant of variable projection)
            and its Jacobian needs no second derivative.

    Returns:
        Residuals, slopes and log scales.
    """
    spots, azimuth = arrays.spots, arrays.azimuth_convention
    hold = jax.lax.stop_gradient if frozen else (lambda tree: tree)
    pan, tilt = angles.angle_rad[spots.move_index].T
    at_model, at_pan, at_tilt = hold((model, pan, tilt))
    ranges_mm = nearest_range(at_model, at_pan, at_tilt, spots.triangulated_mm.T)

    predicted, slope_of = jax.linearize(
        lambda pose: observe(at_model, pose, azimuth), jnp.stack([at_pan, at_tilt, ranges_mm])
    )
    basis = jnp.broadcast_to(jnp.eye(3)[:, :, None], (3, 3, pan.size))
    slopes = jax.vmap(slope_of)(basis)
    if frozen:
        predicted = observe(model, jnp.stack([pan, tilt, ranges_mm]), azimuth)
    misfit = jnp.concatenate([spots.pixels.T, spots.aperture_rad[None]]) - predicted
    # Angles are compared on the circle.
    turns = jnp.round(misfit[4] / (2 * jnp.pi)) * (2 * jnp.pi)
    misfit = misfit - jnp.concatenate([jnp.zeros((4, pan.size)), turns[None]])

    pixel_noise = 1 / (model.noise.pixel_scale * inflation)
    aperture_noise = 1 / (model.receiver.aperture_sd_rad * inflation)
    root_weight = jnp.sqrt(spots.weight) * spots.valid

    noise = pixel_noise, aperture_noise, root_weight
    misfit, slopes = materialise((whitened(misfit[None], spots, *noise), hold(whitened(slopes, spots, *noise))))
    # Padding has no slope; any fixed direction keeps the projection finite there.
    along = slopes[2] + (1 - spots.valid) * np.eye(5)[0][:, None]
    pixel_part = jnp.sum(along[:4] ** 2, axis=0)
    aperture_part = along[4] ** 2
    along = along / jnp.sqrt(pixel_part + aperture_part)
    # A Householder reflection takes the range direction to the first axis; the other four coordinates are an
    # orthonormal basis of its complement. The sign avoids cancellation.
    along = materialise(along)
    mirror = along + jnp.where(along[0] < 0, -1.0, 1.0) * np.eye(5)[0][:, None]
    vectors = jnp.concatenate([misfit, slopes[:2]])
    share = jnp.sum(mirror * vectors, axis=1) / (0.5 * jnp.sum(mirror**2, axis=0))
    remaining = (vectors - share[:, None] * mirror)[:, 1:]

    # Four pixels give s^-4, their range integral s; the aperture's noise takes part in that integral.
    log_scale = 3 * jnp.log(pixel_noise) - 0.5 * jnp.log1p(aperture_part / pixel_part)
    log_scale += spots.has_aperture * jnp.log(aperture_noise)
    return SpotResiduals(remaining[0].T, remaining[1:].transpose(2, 1, 0), log_scale * spots.valid, predicted.T)


def stop_variances(stop_sd_rad: Float[Array, "2 2"], spots: SpotArrays) -> Float[Array, "spots 2"]:
    """Variance of the stop errors (pan, tilt) that are new at each spot, by the direction of their move."""
    return jnp.sum(spots.redraw_mix * stop_sd_rad**2, axis=2)


class FilterRows(eqx.Module):
    """What the filter meets at each spot, in time order: its residual, how its states move it, which are new.

    `residual` has the shape (spots, 4), or (spots, 4, columns) where several are filtered at once; `load` is
    d(predicted)/d(state), `keep` is 0 for a state drawn anew since the previous spot and 1 otherwise, `variance` the
    variance it is then drawn with.
    """

    residual: Float[Array, "..."]
    load: Float[Array, "*spots 4 6"]
    keep: Float[Array, "*spots 6"]
    variance: Float[Array, "*spots 6"]


def filter_rows(
    residual: Float[Array, "spots 4 *columns"],
    slope: Float[Array, "spots 4 2"],
    play_sd_rad: Float[Array, "spots 2"],
    stop_variance: Float[Array, "spots 2"],
    spots: SpotArrays,
) -> FilterRows:
    """States of the filter at every spot: stop errors, home offsets, places in an unknown play.

    Args:
        residual: observed - predicted, or whatever else goes through the filter.
        slope: d(predicted)/d(pan, tilt).
        play_sd_rad: of the place in the play, zero where it is known.
        stop_variance: from `stop_variances`.
        spots: which of them re-home and draw stop errors anew.
    """
    pairs = (len(spots.valid), 2)
    home = jnp.where(spots.homed, (HOME_SD_DEG * jnp.pi / 180) ** 2, 0.0)[:, None]
    segment = jnp.broadcast_to(spots.new_segment[:, None], pairs)
    return FilterRows(
        residual=residual,
        load=jnp.concatenate([slope, slope, slope * play_sd_rad[:, None]], axis=2),
        keep=jnp.where(jnp.concatenate([spots.redraw, segment, segment], axis=1), 0.0, 1.0),
        variance=jnp.concatenate([stop_variance, jnp.broadcast_to(home, pairs), jnp.ones(pairs)], axis=1),
    )


def _along(states: Float[Array, "6"], like: Array) -> Float[Array, "6 ..."]:
    """Numbers of the six states for every column of `like`."""
    return jnp.reshape(states, (STATES,) + (1,) * (like.ndim - 1))


class Belief(eqx.Module):
    """Mean, one for every column of residuals, and covariance of the filter's state."""

    mean: Float[Array, "6 *columns"]
    covariance: Float[Array, "6 6"]

    def renewed(self, row: FilterRows) -> Belief:
        """The state as the spot finds it, before the spot is looked at."""
        new = jnp.diag(row.variance * (1 - row.keep))
        return Belief(self.mean * _along(row.keep, self.mean), self.covariance * (row.keep[:, None] * row.keep) + new)


class KalmanUpdate(eqx.Module):
    """A spot seen by the filter: the state after it, standardised errors and the log of their variances' product."""

    belief: Belief
    standardised: Float[Array, "4 *columns"]
    log_variance: Scalar


def kalman_update(belief: Belief, row: FilterRows) -> KalmanUpdate:
    """Update with one spot: its components have independent unit noise, so four scalar updates and no inverse."""
    mean, covariance = belief.mean, belief.covariance
    errors, variances = [], []
    for component in range(COMPONENTS):
        # Sums instead of products: a call into a matrix library costs more than six numbers.
        gain = jnp.sum(covariance * row.load[component], axis=1)
        variance_ahead = 1 + jnp.sum(row.load[component] * gain)
        error = row.residual[component] - jnp.sum(_along(row.load[component], mean) * mean, axis=0)
        mean = mean + _along(gain, mean) * (error / variance_ahead)
        covariance = covariance - gain[:, None] * (gain / variance_ahead)
        errors.append(error / jnp.sqrt(variance_ahead))
        variances.append(variance_ahead)
    return KalmanUpdate(Belief(mean, covariance), jnp.stack(errors), jnp.sum(jnp.log(jnp.stack(variances))))


def no_belief(*columns: int) -> Belief:
    """Before the first spot, whose states are all new."""
    return Belief(jnp.zeros((STATES, *columns)), jnp.zeros((STATES, STATES)))


class FilterInput(eqx.Module):
    """Rows of the filter and what each spot adds to the log density whatever its state."""

    rows: FilterRows
    log_scale: Float[Array, " spots"]


def filter_input(
    model: Model, arrays: CampaignArrays, inflation: Scalar | float = 1.0, frozen: bool = False
) -> FilterInput:
    """Linearise all spots for the filter; arguments as for `innovations`."""
    spots = arrays.spots
    angles = mirror_angles(model.transmission, model.tilt_zero_rad, arrays.moves)
    terms = spot_residuals(model, angles, arrays, jnp.asarray(inflation, dtype=float), frozen)
    play_sd = angles.play_sd_rad[spots.move_index]
    if frozen:
        play_sd = jax.lax.stop_gradient(play_sd)
    variance = stop_variances(model.noise.stop_sd_rad, spots)
    return FilterInput(filter_rows(terms.residual, terms.slope, play_sd, variance, spots), terms.log_scale)


class Innovations(eqx.Module):
    """Standardised one-step prediction errors, N(0, 1) and independent under the model.

    `log_density` is the campaign's log likelihood without the terms of `log_constant`.
    """

    standardised: Float[Array, "spots 4"]
    log_density: Scalar


def innovations(
    model: Model, arrays: CampaignArrays, inflation: Scalar | float = 1.0, frozen: bool = False
) -> Innovations:
    """Run the filter over all spots in time order.

    Args:
        model: parameters.
        arrays: the campaign.
        inflation: factor on pixel and aperture noise (annealing).
        frozen: see `spot_residuals`.

    Returns:
        Standardised innovations and log likelihood; cost linear in the number of spots.
    """
    given = filter_input(model, arrays, inflation, frozen)

    def step(belief, row):
        seen = kalman_update(belief.renewed(row), row)
        return seen.belief, (seen.standardised, seen.log_variance)

    _, (standardised, log_variance) = jax.lax.scan(step, no_belief(), given.rows)
    log_density = jnp.sum(given.log_scale) - 0.5 * jnp.sum(log_variance) - 0.5 * jnp.sum(standardised**2)
    return Innovations(standardised, log_density)


def log_density(z: Float[Array, " parameters"], space: ParameterSpace, arrays: CampaignArrays) -> Scalar:
    """Log posterior density of the coordinates, up to a constant: likelihood and standard-normal priors."""
    return innovations(space.model(z), arrays).log_density - 0.5 * jnp.dot(z, z)


class SlopedDensity(eqx.Module):
    """Log posterior density at a point, and its gradient."""

    log_density: Scalar
    gradient: Float[Array, " parameters"]


@compiled(SlopedDensity)
def density_and_gradient(
    z: Float[Array, " parameters"], space: ParameterSpace, arrays: CampaignArrays
) -> SlopedDensity:
    """`log_density` and its gradient; the one compiled function that the Newton steps and Hessians share."""
    return SlopedDensity(*jax.value_and_grad(log_density)(z, space, arrays))


class Evaluation(eqx.Module):
    """Log posterior density and standardised innovations; many points give every field a leading axis."""

    log_density: Float[Array, "*batch"]
    standardised: Float[Array, "*batch spots 4"]


@compiled(Evaluation)
def evaluate(z: Float[Array, "batch parameters"], space: ParameterSpace, arrays: CampaignArrays) -> Evaluation:
    """`log_density` of many points in one call; call it with one batch size, each compiles anew."""

    def one(z):
        seen = innovations(space.model(z), arrays)
        return Evaluation(seen.log_density - 0.5 * jnp.dot(z, z), seen.standardised)

    return jax.vmap(one)(z)


@compiled(jax.Array)
def observe_with_stop_errors(
    z: Float[Array, "batch parameters"],
    stop_error_rad: Float[Array, "batch spots 2"],
    space: ParameterSpace,
    arrays: CampaignArrays,
) -> Float[Array, "batch spots 5"]:
    """Noiseless looks at the ranges of the observed spots, the mirrors off by given angles (pan, tilt).

    Args:
        z: coordinates.
        stop_error_rad: added to the mirror angles, rad; stop error, home offset and position in the play.
        space: priors.
        arrays: the campaign.

    Returns:
        u_left, v_left, u_right, v_right (px), aperture reading (rad).
    """

    def one(z, error):
        model = space.model(z)
        angles = mirror_angles(model.transmission, model.tilt_zero_rad, arrays.moves)
        pan, tilt = angles.angle_rad[arrays.spots.move_index].T + error.T
        ranges_mm = nearest_range(model, pan, tilt, arrays.spots.triangulated_mm.T)
        return observe(model, jnp.stack([pan, tilt, ranges_mm]), arrays.azimuth_convention).T

    return jax.vmap(one)(z, stop_error_rad)
