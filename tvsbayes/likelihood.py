"""Likelihood of all spots of a campaign: flat ranges, marginal stop errors and home offsets (DESIGN 4.1).

Each spot gives four pixels and perhaps an aperture angle. Its range along the beam is unknown and flat in image
displacement: the part of the residual along d(pixels)/d(range) is projected out. Stop errors (persistent while
their axis stands still), home offsets and unknown play at the start of a segment are Gaussian states of a Kalman
filter in time order. Angles rad, lengths mm; residuals are in units of their stated standard deviations.

State of the filter: stop error (pan, tilt), home offset (pan, tilt), position in the unknown play band (pan, tilt)
in units of its standard deviation.

All spots taken between two moves share their stop errors and form a group. With C the covariance of all residuals
(unit noise + stop errors, home offsets, unknown play), one forward and one backward pass give, for every group g,
u_g = [C^-1 r]_g, [C^-1 J]_g and the diagonal block M_g = [C^-1]_gg in time linear in the number of groups
(disturbance smoother: de Jong, Biometrika 75 (1988) 594; Durbin and Koopman, Time Series Analysis by State Space
Methods, 4.5): leave-one-out residuals, and what a fit would lose without a stop. The densities of whole moves given
all other spots come from the same two passes in JAX, for many points of parameter space at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import linalg

from tvsbayes.campaign import APPROACH_SIGN, Campaign, Move, Spot
from tvsbayes.classic import triangulate
from tvsbayes.model import (
    MirrorAngles,
    Model,
    MoveArrays,
    ParameterSpace,
    Receiver,
    Scalar,
    along_batch,
    beam,
    dot,
    materialise,
    mirror_angles,
    project,
    rotate_about_z,
    rotation_matrix,
    transform,
)
from tvsbayes.rigs import HOME_SD_DEG

SMALLEST_BUCKET = 512
"""Spots and moves are padded to this size or the next power of two above it: campaigns of ordinary size
share one compiled function."""
COMPONENTS = 4
"""Residuals that remain of a spot's five observations after its range is projected out; the last is zero
without an aperture reading."""
STATES = 6


class SpotArrays(eqx.Module):
    """Spots with status ok in time order, padded.

    `whitening` maps a pixel residual to stated standard deviations. `weight` scales a spot's information
    (1, or below for the robust option), `valid` is 0 for padding and excluded spots. `redraw[axis]` says that the
    stop error of the axis was drawn anew since the previous spot, with variance
    `redraw_mix[axis] @ (sd_right^2, sd_left^2)` (or down, up).
    """

    move_index: Int[Array, " spots"]
    pixels: Float[Array, "spots 4"]
    whitening: Float[Array, "spots 4 4"]
    aperture_rad: Float[Array, " spots"]
    has_aperture: Float[Array, " spots"]
    triangulated_mm: Float[Array, "spots 3"]
    valid: Float[Array, " spots"]
    weight: Float[Array, " spots"]
    redraw: Bool[Array, "spots 2"]
    redraw_mix: Float[Array, "spots 2 2"]
    new_segment: Bool[Array, " spots"]
    homed: Bool[Array, " spots"]


class CampaignArrays(eqx.Module):
    """A campaign as arguments of jitted functions."""

    moves: MoveArrays
    spots: SpotArrays
    azimuth_convention: Bool[Array, ""]


def bucket(count: int) -> int:
    """Padded length for `count` rows."""
    size = SMALLEST_BUCKET
    while size < count:
        size *= 2
    return size


def ordered_spots(campaign: Campaign) -> list[Spot]:
    """Spots with status ok in the order in which the filter meets them."""
    return sorted((s for s in campaign.spots if s.status == "ok"), key=lambda s: (s.move, s.spot))


def move_arrays(moves: tuple[Move, ...]) -> MoveArrays:
    """Pad the moves; padding repeats the last counters and therefore changes nothing."""
    size = bucket(len(moves))
    steps = np.zeros((size, 2))
    steps[: len(moves)] = [(m.pan_steps, m.tilt_steps) for m in moves]
    steps[len(moves) :] = steps[len(moves) - 1]
    first = np.zeros(size, dtype=bool)
    first[: len(moves)] = [bool(m.pan_approach) for m in moves]
    approach = np.zeros((size, 2))
    approach[: len(moves)] = [
        (APPROACH_SIGN.get(m.pan_approach, 0), APPROACH_SIGN.get(m.tilt_approach, 0)) for m in moves
    ]
    return MoveArrays(jnp.asarray(steps), jnp.asarray(first), jnp.asarray(approach))


def _stop_mix(sign: int) -> tuple[float, float]:
    """Share of each direction's variance in a stop error: one of them, or half of both where unknown."""
    return (0.5, 0.5) if sign == 0 else (float(sign < 0), float(sign > 0))


@dataclass(frozen=True)
class Redraws:
    """Which states are new at each spot, arrays over spots; fields as in `SpotArrays`."""

    redraw: np.ndarray
    redraw_mix: np.ndarray
    new_segment: np.ndarray
    homed: np.ndarray


def redraws(moves: tuple[Move, ...], spots: list[Spot]) -> Redraws:
    """Follow the moves between spots: an axis' stop error is new once its own counter has changed (DESIGN 3.1)."""
    count = len(spots)
    new = Redraws(
        redraw=np.zeros((count, 2), dtype=bool),
        redraw_mix=np.zeros((count, 2, 2)),
        new_segment=np.zeros(count, dtype=bool),
        homed=np.zeros(count, dtype=bool),
    )
    seen = -1
    for row, spot in enumerate(spots):
        for index in range(seen + 1, spot.move + 1):
            move = moves[index]
            if move.pan_approach:
                signs = (APPROACH_SIGN[move.pan_approach], APPROACH_SIGN[move.tilt_approach])
                new.redraw[row], new.redraw_mix[row] = True, [_stop_mix(s) for s in signs]
                new.new_segment[row], new.homed[row] = True, move.segment > 0
                continue
            previous = moves[index - 1]
            deltas = (move.pan_steps - previous.pan_steps, move.tilt_steps - previous.tilt_steps)
            for axis, delta in enumerate(deltas):
                if delta:
                    new.redraw[row, axis], new.redraw_mix[row, axis] = True, _stop_mix(delta)
        seen = spot.move
    return new


def pixel_covariance(spot: Spot) -> np.ndarray:
    """Stated covariance of (u_left, v_left, u_right, v_right), px^2."""
    su_l, sv_l, su_r, sv_r = spot.su_left_px, spot.sv_left_px, spot.su_right_px, spot.sv_right_px
    covariance = np.diag(np.square([su_l, sv_l, su_r, sv_r]))
    covariance[0, 1] = covariance[1, 0] = spot.ruv_left * su_l * sv_l
    covariance[2, 3] = covariance[3, 2] = spot.ruv_right * su_r * sv_r
    return covariance


def campaign_arrays(campaign: Campaign) -> CampaignArrays:
    """Pack a campaign for the jitted functions.

    Args:
        campaign: a checked campaign with at least one spot of status ok.

    Returns:
        Arrays padded to `bucket` sizes.
    """
    spots = ordered_spots(campaign)
    count, size = len(spots), bucket(len(spots))

    def padded(rows, shape, fill=0.0, dtype=np.float64):
        array = np.full((size, *shape), fill, dtype=dtype)
        array[:count] = rows
        return jnp.asarray(array)

    pixels = np.array([(s.u_left_px, s.v_left_px, s.u_right_px, s.v_right_px) for s in spots])
    covariance = np.stack([pixel_covariance(s) for s in spots])
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    new = redraws(campaign.moves, spots)
    aperture = [np.nan if s.aperture_deg is None else s.aperture_deg for s in spots]
    points_mm = triangulate(campaign.stereo, pixels)
    seen = np.isfinite(points_mm).all(axis=1)
    points_mm[~seen] = NOWHERE_MM
    with jax.enable_x64(True):
        spot_arrays = SpotArrays(
            move_index=padded([s.move for s in spots], (), spots[-1].move, np.int32),
            pixels=padded(pixels, (4,), 0.0),
            whitening=padded(whitening, (4, 4), np.eye(4)),
            aperture_rad=padded(np.nan_to_num(np.radians(aperture)), ()),
            has_aperture=padded(np.isfinite(aperture), ()),
            triangulated_mm=padded(points_mm, (3,), NOWHERE_MM),
            valid=padded(seen, ()),
            weight=padded(1.0, (), 1.0),
            redraw=padded(new.redraw, (2,), False, bool),
            redraw_mix=padded(new.redraw_mix, (2, 2)),
            new_segment=padded(new.new_segment, (), False, bool),
            homed=padded(new.homed, (), False, bool),
        )
        return CampaignArrays(
            move_arrays(campaign.moves), spot_arrays, jnp.asarray(campaign.rig.aperture_convention == "azimuth")
        )


NOWHERE_MM = (500.0, 0.0, 0.0)
"""Stands for the point of a look that counts for nothing: finite, and in front of the cameras."""


def in_sight(campaign: Campaign) -> np.ndarray:
    """Whether each ordered spot has a triangulated point: one beyond the reach of the lens model has none."""
    pixels = np.array([(s.u_left_px, s.v_left_px, s.u_right_px, s.v_right_px) for s in ordered_spots(campaign)])
    return np.isfinite(triangulate(campaign.stereo, pixels.reshape(-1, 4))).all(axis=1)


def spot_constants(campaign: Campaign) -> np.ndarray:
    """Terms of each ordered spot's log likelihood that no parameter changes: 2 pi and its stated covariance."""
    return np.array(
        [
            -0.5 * ((3 + (s.aperture_deg is not None)) * np.log(2 * np.pi) + np.linalg.slogdet(pixel_covariance(s))[1])
            for s in ordered_spots(campaign)
        ]
    )


def log_constant(campaign: Campaign) -> float:
    """Terms of the log likelihood that no parameter changes: 2 pi and the stated pixel covariances."""
    return float(np.sum(spot_constants(campaign)))


def aperture_angle(
    receiver: Receiver, points_p_mm: Float[Array, "3 *batch"], azimuth_convention: Bool[Array, ""]
) -> Float[Array, "*batch"]:
    """Angle B at the aperture between +y of frame T and the spot, or its projection on x-y (DESIGN 5)."""
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


def spot_residuals(
    model: Model, angles: MirrorAngles, arrays: CampaignArrays, inflation: Scalar, frozen: bool
) -> SpotResiduals:
    """Linearise every spot about the triangulated point's range (DESIGN 4.1).

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

    def whitened(vectors: Float[Array, "n 5 spots"]) -> Float[Array, "n 5 spots"]:
        pixels = jnp.sum(spots.whitening.transpose(1, 2, 0) * vectors[:, None, :4], axis=2) * (
            pixel_noise * root_weight
        )
        return jnp.concatenate([pixels, vectors[:, 4:] * (aperture_noise * root_weight * spots.has_aperture)], 1)

    misfit, slopes = materialise((whitened(misfit[None]), hold(whitened(slopes))))
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

    `load` = d(predicted)/d(state), `keep` is 0 for a state drawn anew since the previous spot and 1 otherwise,
    `variance` the variance it is then drawn with.
    """

    residual: Float[Array, "*spots 4"]
    load: Float[Array, "*spots 4 6"]
    keep: Float[Array, "*spots 6"]
    variance: Float[Array, "*spots 6"]


class Belief(eqx.Module):
    """Mean and covariance of the filter's state."""

    mean: Float[Array, "6"]
    covariance: Float[Array, "6 6"]

    def renewed(self, row: FilterRows) -> Belief:
        """The state as the spot finds it, before the spot is looked at."""
        new = jnp.diag(row.variance * (1 - row.keep))
        return Belief(self.mean * row.keep, self.covariance * (row.keep[:, None] * row.keep) + new)


class Look(eqx.Module):
    """A spot seen by the filter: the state after it, standardised errors and the log of their variances' product."""

    belief: Belief
    standardised: Float[Array, "4"]
    log_variance: Scalar


def look(belief: Belief, row: FilterRows) -> Look:
    """Update with one spot: its components have independent unit noise, so four scalar updates and no inverse."""
    mean, covariance = belief.mean, belief.covariance
    errors, variances = [], []
    for component in range(COMPONENTS):
        # Sums instead of products: a call into a matrix library costs more than six numbers.
        gain = jnp.sum(covariance * row.load[component], axis=1)
        variance_ahead = 1 + jnp.sum(row.load[component] * gain)
        error = row.residual[component] - jnp.sum(row.load[component] * mean)
        mean = mean + gain * (error / variance_ahead)
        covariance = covariance - gain[:, None] * (gain / variance_ahead)
        errors.append(error / jnp.sqrt(variance_ahead))
        variances.append(variance_ahead)
    return Look(Belief(mean, covariance), jnp.stack(errors), jnp.sum(jnp.log(jnp.stack(variances))))


def no_belief() -> Belief:
    """Before the first spot, whose states are all new."""
    return Belief(jnp.zeros(STATES), jnp.zeros((STATES, STATES)))


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
    load = jnp.concatenate([terms.slope, terms.slope, terms.slope * play_sd[:, None]], axis=2)
    home_variance = jnp.where(spots.homed, (HOME_SD_DEG * jnp.pi / 180) ** 2, 0.0)[:, None]
    segment = jnp.broadcast_to(spots.new_segment[:, None], (spots.valid.size, 2))
    renewed = jnp.concatenate([spots.redraw, segment, segment], axis=1)
    variance = jnp.concatenate(
        [
            stop_variances(model.noise.stop_sd_rad, spots),
            jnp.broadcast_to(home_variance, segment.shape),
            jnp.ones(segment.shape),
        ],
        axis=1,
    )
    return FilterInput(FilterRows(terms.residual, load, jnp.where(renewed, 0.0, 1.0), variance), terms.log_scale)


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
        seen = look(belief.renewed(row), row)
        return seen.belief, (seen.standardised, seen.log_variance)

    _, (standardised, log_variance) = jax.lax.scan(step, no_belief(), given.rows)
    log_density = jnp.sum(given.log_scale) - 0.5 * jnp.sum(log_variance) - 0.5 * jnp.sum(standardised**2)
    return Innovations(standardised, log_density)


def log_density(z: Float[Array, " parameters"], space: ParameterSpace, arrays: CampaignArrays) -> Scalar:
    """Log posterior density of the coordinates, up to a constant: likelihood and standard-normal priors."""
    return innovations(space.model(z), arrays).log_density - 0.5 * jnp.dot(z, z)


@eqx.filter_jit
def density_and_gradient(
    z: Float[Array, " parameters"], space: ParameterSpace, arrays: CampaignArrays
) -> tuple[Scalar, Float[Array, " parameters"]]:
    """`log_density` and its gradient; the one compiled function that the Newton steps and Hessians share."""
    return jax.value_and_grad(log_density)(z, space, arrays)


class Evaluation(eqx.Module):
    """Log posterior density and standardised innovations; many points give every field a leading axis."""

    log_density: Float[Array, "*batch"]
    standardised: Float[Array, "*batch spots 4"]


@eqx.filter_jit
def evaluate(z: Float[Array, "batch parameters"], space: ParameterSpace, arrays: CampaignArrays) -> Evaluation:
    """`log_density` of many points in one call; call it with one batch size, each compiles anew."""

    def one(z):
        seen = innovations(space.model(z), arrays)
        return Evaluation(seen.log_density - 0.5 * jnp.dot(z, z), seen.standardised)

    return jax.vmap(one)(z)


@eqx.filter_jit
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
    """

    residual: np.ndarray
    load: np.ndarray
    renewed: np.ndarray
    variance: np.ndarray
    jacobian: np.ndarray


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
    forward, aheads = [], []
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
        aheads.append(ahead[:, 1:])
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
    # One product of all rows: with many columns the sum over the groups would cost more than everything else.
    whitened = np.concatenate([np.zeros((0, parameters)), *(entry[-1][:, 1:] for entry in forward)])
    fisher = np.concatenate([np.zeros((0, parameters)), *aheads]).T @ whitened
    return StopInformation(tuple(groups[::-1]), fisher)


def leave_one_out_chi2(information: StopInformation, weight: np.ndarray | None = None) -> np.ndarray:
    """Squared distance of each spot from what all OTHER spots predict for it, shape (n,).

    It equals twice the gain in log density from leaving the spot out, up to the determinant: of two spots of a
    stop that disagree, the one without which the rest fits better has the larger value. That is the spot to blame.

    Args:
        information: of the linearised campaign.
        weight: robust weights w that are in its residuals, shape (n,). Distances are those of spots of full weight:
            of the covariance I + w P of a weighted innovation, P predicted, the noise alone is scaled back.
    """
    weight = np.ones(sum(len(g.residual) // 4 for g in information.groups)) if weight is None else weight
    values = []
    for group in information.groups:
        for k in range(len(group.residual) // 4):
            part = slice(4 * k, 4 * k + 4)
            u, m = group.residual[part], group.precision[part, part]
            covariance = np.linalg.inv(m)
            # e = sqrt(w) (spot - prediction); (I + P) w = covariance + (w - 1) I.
            e = covariance @ u
            values.append(e @ np.linalg.solve(covariance + (weight[len(values)] - 1) * np.eye(4), e))
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
