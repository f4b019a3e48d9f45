"""Likelihood of all spots of a campaign: flat ranges, marginal errors of stops, homings and gears (formulation 4.1).

Stop errors (persistent while their axis stands still), drifting home offsets and unknown play at the start of a segment
are Gaussian states of a Kalman filter in time order. Errors that repeat by position stay for the whole campaign: their
columns go through the filter like the residuals, and normal equations take them out. Angles rad, lengths mm; residuals
are in units of their noise, stated standard deviations times the pixel scale.

State of the filter: stop error (pan, tilt), home offset (pan, tilt), position in the unknown play band (pan, tilt)
in units of its standard deviation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from types import ModuleType

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from tvsbayes.estimators.campaign_arrays import CampaignArrays, GearArrays, SpotArrays, sizes_of
from tvsbayes.estimators.looks import WINDOW, Looks, looks_at, spot_angles
from tvsbayes.estimators.spot_residuals import NoiseScales, SpotResiduals, ToStates, noise_scales, spot_residuals
from tvsbayes.instrument.axes import HOME_SD_DEG
from tvsbayes.model.compiled import compiled
from tvsbayes.model.gear_processes import errors_at, place_root
from tvsbayes.model.geometry import Scalar
from tvsbayes.model.laser_path import MirrorAngles, Stretch, angles_at, mirror_angles, no_moves
from tvsbayes.model.parameter_space import Model, ParameterSpace

STATES = 6
BLOCK = 64
"""Spots that go through the filter together: their numbers stay in the processor's cache, and a campaign costs what its
own spots need, not what it was padded to."""


def stop_variances(stop_sd_rad: Float[Array, "2 2"], spots: SpotArrays) -> Float[Array, "spots 2"]:
    """Variance of the stop errors (pan, tilt) that are new at each spot, by the direction of their move."""
    return jnp.sum(spots.redraw_mix * stop_sd_rad**2, axis=2)


def drift_variances(drift_rad_per_root_hour: Float[Array, "2"], spots: SpotArrays) -> Float[Array, "spots 2"]:
    """Variance of what the zeros (pan, tilt) walked since the spot before, or since the homing after it."""
    return spots.hours[:, None] * drift_rad_per_root_hour**2


def scatter_variances(scatter_rad: Float[Array, "2"], spots: SpotArrays) -> Float[Array, "spots 2"]:
    """Variance of the beam's angles (pan, tilt) at each look about where the axes stand; robust weights enlarge it."""
    return scatter_rad**2 / spots.weight[:, None]


class FilterRows(eqx.Module):
    """What the filter meets at each spot, in time order: its residual, how its states move it, which are new.

    `residual` has the shape (spots, components), or (spots, components, columns) where several are filtered at once;
    `load` is d(predicted)/d(state), `keep` is 0 for a state drawn anew since the previous spot and 1 otherwise,
    `variance` what is added to its variance since then: that of the draw, or of a random walk.
    """

    residual: Float[Array | np.ndarray, "..."]
    load: Float[Array | np.ndarray, "*spots components 6"]
    keep: Float[Array | np.ndarray, "*spots 6"]
    variance: Float[Array | np.ndarray, "*spots 6"]


def filter_rows(
    residual: Float[Array | np.ndarray, "spots components *columns"],
    slope: Float[Array | np.ndarray, "spots components 2"],
    play_sd_rad: Float[Array | np.ndarray, "spots 2"],
    stop_variance: Float[Array | np.ndarray, "spots 2"],
    drift_variance: Float[Array | np.ndarray, "spots 2"],
    spots: SpotArrays,
    functions: ModuleType = jnp,
) -> FilterRows:
    """States of the filter at every spot: stop errors, home offsets with their drift, places in an unknown play.

    Args:
        residual: observed - predicted, or whatever else goes through the filter.
        slope: d(predicted)/d(pan, tilt).
        play_sd_rad: of the place in the play, zero where it is known.
        stop_variance: from `stop_variances`.
        drift_variance: from `drift_variances`.
        spots: which of them re-home and draw stop errors anew.
        functions: jax.numpy or numpy.
    """
    xp, pairs = functions, (len(spots.valid), 2)
    home = xp.where(spots.homed, (HOME_SD_DEG * np.pi / 180) ** 2, 0.0)[:, None]
    segment = xp.broadcast_to(spots.new_segment[:, None], pairs)
    drawn = xp.where(spots.redraw, stop_variance, 0.0)
    return FilterRows(
        residual=xp.asarray(residual),
        load=xp.concatenate([slope, slope, slope * play_sd_rad[:, None]], axis=2),
        keep=xp.where(xp.concatenate([spots.redraw, segment, segment], axis=1), 0.0, 1.0),
        variance=xp.concatenate([drawn, home + drift_variance, xp.where(segment, 1.0, 0.0)], axis=1),
    )


def place_columns(
    slope: Float[Array | np.ndarray, "spots components 2"], gears: GearArrays
) -> Float[Array, "spots components errors"]:
    """d(predicted)/d(transmission errors, then plays, at the places), rad^-1."""
    by_place = jnp.where(gears.places.on_tilt, slope[..., 1:], slope[..., :1])
    return jnp.concatenate([by_place * gears.error_share[:, None], by_place * gears.play_share[:, None]], axis=2)


def _along(states: Float[Array | np.ndarray, "6"], like: Array | np.ndarray) -> Float[Array, "6 ..."]:
    """Numbers of the six states for every column of `like`."""
    return jnp.reshape(states, (STATES,) + (1,) * (like.ndim - 1))


class Belief(eqx.Module):
    """Mean, one for every column of residuals, and covariance of the filter's state."""

    mean: Float[Array | np.ndarray, "6 *columns"]
    covariance: Float[Array | np.ndarray, "6 6"]

    def renewed(self, row: FilterRows) -> Belief:
        """The state as the spot finds it, before the spot is looked at."""
        new = jnp.diag(row.variance)
        return Belief(self.mean * _along(row.keep, self.mean), self.covariance * (row.keep[:, None] * row.keep) + new)


class KalmanUpdate(eqx.Module):
    """A spot seen by the filter: the state after it, standardised errors and the log of their variances' product."""

    belief: Belief
    standardised: Float[Array, "components *columns"]
    log_variance: Scalar


def kalman_update(belief: Belief, row: FilterRows) -> KalmanUpdate:
    """Update with one spot: its components have independent unit noise, so a scalar update each and no inverse."""
    mean, covariance = belief.mean, belief.covariance
    errors, variances = [], []
    for component in range(len(row.load)):
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


class Standing(eqx.Module):
    """A campaign at a point of parameter space, before its filter: looks, their residuals, the mirrors' places."""

    looks: Looks
    noise: NoiseScales
    terms: SpotResiduals
    play_sd_rad: Float[Array, "spots 2"]
    stop_variance: Float[Array, "spots 2"]
    drift_variance: Float[Array, "spots 2"]
    scatter_variance: Float[Array, "spots 2"]
    to_states: ToStates


def standing(
    model: Model,
    arrays: CampaignArrays,
    inflation: Float[Array | np.ndarray, ""] | float = 1.0,
    angles: MirrorAngles | None = None,
) -> Standing:
    """Linearise all spots; `inflation` is a factor on pixel and aperture noise (annealing), `angles` are the spots'."""
    spots = arrays.spots
    angles = spot_angles(model, arrays) if angles is None else angles
    pan, tilt = angles.angle_rad.T
    looks = looks_at(model, pan, tilt, arrays)
    noise, scattered = noise_scales(model, spots, inflation), scatter_variances(model.noise.look_scatter_rad, spots)
    terms = spot_residuals(looks, noise, model, spots)
    return Standing(
        looks,
        noise,
        terms,
        angles.play_sd_rad,
        stop_variances(model.noise.stop_sd_rad, spots),
        drift_variances(jnp.asarray(model.gears.drift_rad_per_root_hour), spots),
        scattered,
        ToStates.of(terms.by_pan, terms.by_tilt, scattered),
    )


class FilterInput(eqx.Module):
    """Rows of the filter, and what no state can change.

    `slope` is d(rows' residual)/d(pan, tilt). `free` is what is left of the standardised components, which no state
    changes; `log_scale` is what each spot adds to the log density besides the rows: theirs in it.
    """

    rows: FilterRows
    slope: Float[Array, "spots 2 2"]
    free: Float[Array, "spots 4"]
    log_scale: Float[Array, " spots"]


def root_at_places(model: Model, gears: GearArrays) -> Float[Array, "errors errors"]:
    """Factor of the covariance of transmission errors, then plays, at the places, rad."""
    places = gears.places
    if not len(places.steps):
        return jnp.zeros((0, 0))
    angle_rad = places.steps * places.by_axis(model.transmission.ratio_rad_per_step)
    return jnp.asarray(place_root(model.gears, angle_rad, places.on_tilt, places.valid))


def filter_input(model: Model, arrays: CampaignArrays, angles: MirrorAngles | None = None) -> FilterInput:
    """Linearise all spots for the filter; `angles` are the spots', if they are known."""
    found = standing(model, arrays, angles=angles)
    terms, turned = found.terms, found.to_states
    first, second, *free = turned.of_many(terms.residual)
    seen, slope = jnp.stack([first, second], axis=1), turned.slope
    rows = filter_rows(seen, slope, found.play_sd_rad, found.stop_variance, found.drift_variance, arrays.spots)
    log_scale = terms.log_scale + turned.log_scale - 0.5 * sum(number**2 for number in free)
    return FilterInput(rows, slope, jnp.stack(free, axis=1), log_scale)


class Seen(eqx.Module):
    """Spots seen by the filter: standardised errors (spots, components, ...), and logs of their variances' products.

    `belief` is that after the last of them.
    """

    standardised: Float[Array, "..."]
    log_variance: Float[Array, "*spots"]
    belief: Belief


def filtered(rows: FilterRows, before: Belief | None = None) -> Seen:
    """Run the filter over spots in time order, from the belief before them."""

    def step(belief, row):
        seen = kalman_update(belief.renewed(row), row)
        return seen.belief, (seen.standardised, seen.log_variance)

    start = no_belief(*rows.residual.shape[2:]) if before is None else before
    after, (standardised, log_variance) = jax.lax.scan(step, start, rows)
    return Seen(standardised, log_variance, after)


class Passed(eqx.Module):
    """A campaign on its way through the filter, block by block; rows of spots ahead are zero.

    Columns are the residual, then how the errors at places move it: those at the places that are filled come first,
    behind them nothing. `gram` holds the products of the standardised columns with each other, summed over the spots
    passed; `log_density` is that of the spots passed without squares of what the filter standardised. A caller that
    needs the gram alone does not pay for the columns: the compiler drops what nobody reads.
    """

    belief: Belief
    standardised: Float[Array, "spots 2 columns"]
    free: Float[Array, "spots 4"]
    gram: Float[Array, "columns columns"]
    log_density: Scalar
    stretch: Stretch


def block_size(spots: SpotArrays) -> int:
    """Spots of a block: `BLOCK`, or what divides the padded number evenly."""
    count = len(spots.valid)
    return count if count <= BLOCK else math.gcd(count, BLOCK)


def blocks_filled(arrays: CampaignArrays) -> Int[Array, ""]:
    """Blocks that hold a spot: padding comes last."""
    return -(-arrays.count // block_size(arrays.spots))


def with_filled[Result](gears: GearArrays, of: Callable[[int], Result]) -> Result:
    """What a function gives of the number of places that are filled: one of `sizes_of`.

    It is traced for each of them, and run for one: columns cost what a campaign's own places need.
    """
    sizes = sizes_of(len(gears.places.steps))
    if len(sizes) == 1:
        return of(sizes[0])
    number = jnp.searchsorted(np.array(sizes), jnp.sum(gears.places.valid))
    return jax.lax.switch(number, [partial(of, size) for size in sizes])


def passed(model: Model, arrays: CampaignArrays, blocks: Int[Array, ""] | int) -> Passed:
    """Send the first blocks of spots through the filter; nothing depends on how they are cut.

    Moves are followed as far as the spots go; all of them where the number of blocks is a constant.
    """
    count, size = len(arrays.spots.valid), block_size(arrays.spots)
    gears, zero = model.transmission, model.tilt_zero_rad
    every = mirror_angles(gears, zero, arrays.moves) if isinstance(blocks, int) else None

    def through(number, so_far):
        start = jnp.asarray(number) * size
        part = arrays.of_spots(start, size)
        index, stretch = part.spots.move_index, so_far.stretch
        if every is None:
            found = angles_at(gears, zero, arrays.moves, index, stretch)
            angles, stretch = found.angles, found.stretch
        else:
            angles = jax.tree.map(lambda of_moves: of_moves[index], every)
        given = filter_input(model, part, angles)

        def seen(places):
            columns = 1 + 2 * places
            own = jnp.concatenate(
                [given.rows.residual[..., None], place_columns(given.slope, part.gears.first(places))], axis=2
            )
            rows = eqx.tree_at(lambda r: r.residual, given.rows, own)
            before = Belief(so_far.belief.mean[:, :columns], so_far.belief.covariance)
            found = filtered(rows, before)
            flat = found.standardised.reshape(-1, columns)
            standardised = jnp.zeros((size, 2, so_far.standardised.shape[2])).at[..., :columns].set(found.standardised)
            return Passed(
                Belief(so_far.belief.mean.at[:, :columns].set(found.belief.mean), found.belief.covariance),
                jax.lax.dynamic_update_slice_in_dim(so_far.standardised, standardised, start, 0),
                jax.lax.dynamic_update_slice_in_dim(so_far.free, given.free, start, 0),
                so_far.gram.at[:columns, :columns].add(flat.T @ flat),
                so_far.log_density + jnp.sum(given.log_scale) - 0.5 * jnp.sum(found.log_variance),
                stretch,
            )

        return with_filled(arrays.gears, seen)

    columns = 1 + 2 * len(arrays.gears.places.steps)
    empty = jnp.zeros((count, 2, columns)), jnp.zeros((count, 4)), jnp.zeros((columns, columns)), jnp.zeros(())
    begin = Passed(no_belief(columns), *empty, no_moves(arrays.moves))
    return jax.lax.fori_loop(0, blocks, through, begin)


class RepeatedErrors(eqx.Module):
    """What all looks say of the errors at places: those divided by `root` are N(mean, (factor factor')^-1).

    A priori they are N(0, 1). `log_determinant` is that of the variance which they add to all looks.
    """

    root: Float[Array, "errors errors"]
    mean: Float[Array, " errors"]
    factor: Float[Array, "errors errors"]
    log_determinant: Scalar

    @property
    def errors_rad(self) -> Float[Array, " errors"]:
        """Their mean, rad."""
        return self.root @ self.mean

    def drawn_rad(self, normal: Float[Array, " errors"]) -> Float[Array, " errors"]:
        """One draw of them, rad, from standard normal numbers."""
        return self.root @ (self.mean + jax.scipy.linalg.solve_triangular(self.factor, normal, lower=True, trans=1))


def repeated_errors(gram: Float[Array, "columns columns"], root: Float[Array, "errors errors"]) -> RepeatedErrors:
    """Normal equations of the errors at places.

    Args:
        gram: products of the standardised residual and of the columns of those errors, as in `Passed`.
        root: of their prior covariance.
    """
    precision = jnp.eye(len(root)) + root.T @ gram[1:, 1:] @ root
    factor = jnp.linalg.cholesky(precision)
    mean = jax.scipy.linalg.cho_solve((factor, True), root.T @ gram[1:, 0])
    return RepeatedErrors(root, mean, factor, 2 * jnp.sum(jnp.log(jnp.diagonal(factor))))


class Innovations(eqx.Module):
    """Standardised one-step prediction errors, N(0, 1) and independent under the model at given errors of places.

    Of each spot two by the filter, then what no stop error changes: four components with the freedom of two at most.
    They hold at the means of the errors at places, whose standardised values are in `places`; squares of both together
    are the quadratic form of the campaign. `log_density` is its log likelihood without the terms of `spot_constants`;
    `place_errors_rad` a draw of the errors at places, or their means.
    """

    standardised: Float[Array, "spots 6"]
    places: Float[Array, " errors"]
    place_errors_rad: Float[Array, " errors"]
    log_density: Scalar


def innovations(
    model: Model, arrays: CampaignArrays, normal: Float[Array, " errors"], blocks: Int[Array, ""] | int | None = None
) -> Innovations:
    """Run the filter over all spots in time order, and take out what repeats.

    Args:
        model: parameters.
        arrays: the campaign.
        normal: what moves the errors at places from their means, in units of their sds: zero, or a draw's numbers.
        blocks: of spots to look at, by default all of them. A number that is no constant of the compiled function
            (`blocks_filled`) saves what padding costs, and has no derivative in reverse mode.

    Returns:
        Standardised innovations and log likelihood; cost linear in the number of spots.
    """
    every = len(arrays.spots.valid) // block_size(arrays.spots)
    seen = passed(model, arrays, every if blocks is None else blocks)
    log_density = seen.log_density - 0.5 * seen.gram[0, 0]
    size = len(arrays.gears.places.steps)

    def without_places(places):
        if not places:
            return Innovations(whole(seen.standardised[..., 0]), jnp.zeros(2 * size), jnp.zeros(2 * size), log_density)
        columns = 1 + 2 * places
        root = root_at_places(model, arrays.gears.first(places))
        found = repeated_errors(seen.gram[:columns, :columns], root)
        own = seen.standardised[..., 0] - seen.standardised[..., 1:columns] @ found.errors_rad
        # The errors at places explain this much of the squares (least squares: r'r - b' P^-1 b).
        explained = jnp.dot(seen.gram[1:columns, 0], found.errors_rad) - found.log_determinant
        drawn = found.drawn_rad(cut(normal, places))
        return Innovations(whole(own), filled_up(found.mean), filled_up(drawn), log_density + 0.5 * explained)

    def whole(own):
        return jnp.concatenate([own, seen.free], axis=1)

    def filled_up(errors):
        return jnp.pad(errors.reshape(2, -1), ((0, 0), (0, size - len(errors) // 2))).ravel()

    def cut(errors, places):
        return errors.reshape(2, -1)[:, :places].ravel()

    return with_filled(arrays.gears, without_places)


@compiled(jax.Array)
def _prior_errors(
    z: Float[Array, "batch parameters"], normal: Float[Array, "batch errors"], space: ParameterSpace, gears: GearArrays
) -> Float[Array, "batch errors"]:
    return jax.vmap(lambda z, normal: root_at_places(space.model(z), gears) @ normal)(z, normal)


def prior_errors_at_places(
    z: np.ndarray, normal: np.ndarray, space: ParameterSpace, arrays: CampaignArrays
) -> np.ndarray:
    """Transmission errors, then plays, at the filled places before any look, rad: a draw each.

    Args:
        z: coordinates of many points (n, p), which have the scales.
        normal: standard normal numbers, shape (n, e).
        space: priors.
        arrays: the campaign.
    """
    given = errors_at(normal, len(arrays.gears.places.steps))
    return np.asarray(_prior_errors(z, given, space, arrays.gears))[:, arrays.gears.errors_filled]


def log_density(z: Float[Array, " parameters"], space: ParameterSpace, arrays: CampaignArrays) -> Scalar:
    """Log posterior density of the coordinates, up to a constant: likelihood and standard-normal priors."""
    still = jnp.zeros(2 * len(arrays.gears.places.steps))
    return innovations(space.model(z), arrays, still).log_density - 0.5 * jnp.dot(z, z)


class Evaluation(eqx.Module):
    """Log posterior density and errors at places as in `Innovations`; many points give every field a leading axis."""

    log_density: Float[Array | np.ndarray, "*batch"]
    place_errors_rad: Float[Array | np.ndarray, "*batch errors"]


@compiled(Evaluation)
def _evaluate(
    z: Float[Array, "batch parameters"],
    normal: Float[Array, "batch errors"],
    space: ParameterSpace,
    arrays: CampaignArrays,
) -> Evaluation:
    blocks = blocks_filled(arrays)

    def one(z, normal):
        seen = innovations(space.model(z), arrays, normal, blocks)
        return Evaluation(seen.log_density - 0.5 * jnp.dot(z, z), seen.place_errors_rad)

    return jax.vmap(one)(z, normal)


def evaluate(
    z: Float[Array | np.ndarray, "batch parameters"],
    normal: Float[Array | np.ndarray, "batch errors"],
    space: ParameterSpace,
    arrays: CampaignArrays,
) -> Evaluation:
    """`log_density` of many points in one call; call it with one batch size, each compiles anew.

    Args:
        z: coordinates, shape (n, p).
        normal: `no_draw`, or standard normal numbers for a draw of the errors at the filled places for each point.
        space: priors.
        arrays: the campaign.
    """
    found = _evaluate(z, errors_at(np.asarray(normal), len(arrays.gears.places.steps)), space, arrays)
    errors_rad = np.asarray(found.place_errors_rad)[:, arrays.gears.errors_filled]
    return Evaluation(np.asarray(found.log_density), errors_rad)


@compiled(jax.Array)
def _residuals(
    z: Float[Array, "batch parameters"], space: ParameterSpace, arrays: CampaignArrays, first: Int[Array, ""]
) -> Float[Array, "batch spots 4"]:
    """Of `WINDOW` spots from the first on."""
    size, window = block_size(arrays.spots), min(WINDOW, len(arrays.spots.valid))
    blocks = jnp.minimum(blocks_filled(arrays) - first // size, window // size)

    def one(z):
        model = space.model(z)

        def through(number, so_far):
            seen, stretch = so_far
            part = arrays.of_spots(first + number * size, size)
            found = angles_at(model.transmission, model.tilt_zero_rad, arrays.moves, part.spots.move_index, stretch)
            stood = standing(model, part, angles=found.angles)
            own = jnp.stack(stood.to_states.in_place(stood.terms.residual), axis=1)
            return jax.lax.dynamic_update_slice_in_dim(seen, own, number * size, 0), found.stretch

        return jax.lax.fori_loop(0, blocks, through, (jnp.zeros((window, 4)), no_moves(arrays.moves)))[0]

    return jax.vmap(one)(z)


def residuals(
    z: Float[Array | np.ndarray, "batch parameters"], space: ParameterSpace, arrays: CampaignArrays
) -> np.ndarray:
    """Observed - predicted of all spots in units of their noise, ranges projected out, before any filter.

    Args:
        z: coordinates of many points, shape (n, p).
        space: priors.
        arrays: the campaign.

    Returns:
        Shape (n, spots, 4), without padding.
    """
    count = int(arrays.count)
    parts = [np.asarray(_residuals(z, space, arrays, np.int32(first))) for first in range(0, count, WINDOW)]
    return np.concatenate(parts, axis=1)[:, :count]


def no_draw(count: int, arrays: CampaignArrays) -> np.ndarray:
    """For `evaluate`: the errors at places of this many points are their means."""
    return np.zeros((count, 2 * arrays.gears.filled))
