"""Posterior predictions of looks: their density given all others, and their pixels if taken again.

The unit of the log likelihood is a move: the spots between two moves share their stop errors. Pixels px; angles rad.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tvsbayes.estimators.campaign_arrays import CampaignArrays, bucket, spot_constants
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.kalman_filter import STATES, Belief, FilterRows, kalman_update, no_belief
from tvsbayes.estimators.likelihood import filter_input
from tvsbayes.estimators.looks import WINDOW, observe_with_stop_errors
from tvsbayes.instrument.campaign import PIXELS, ordered_spots
from tvsbayes.model.compiled import compiled, in_batches
from tvsbayes.model.parameter_space import (
    ParameterSpace,
)
from tvsbayes.posterior.draws import Posterior
from tvsbayes.statistics.streams import Stream, random_stream

if TYPE_CHECKING:
    import xarray as xr

PREDICTED_DRAWS = 8
"""Draws of each chain for which looks are predicted again."""
RANK_TOLERANCE = 1e-12
"""Share of a state's precision below which its conditional precision given other states is rounding."""


class LaterSpots(eqx.Module):
    """Likelihood of the present state x by later spots: log density -x.precision.x/2 + score.x + constant."""

    precision: Float[Array, "6 6"]
    score: Float[Array, "6"]

    def with_spot(self, row: FilterRows) -> LaterSpots:
        """Add a spot that observes this state with unit noise."""
        precision = jnp.sum(row.load[:, :, None] * row.load[:, None, :], axis=0)
        return LaterSpots(self.precision + precision, self.score + jnp.sum(row.load * row.residual[:, None], axis=0))

    def before(self, row: FilterRows) -> LaterSpots:
        """Go back to the state of the previous spot, integrating out the changes in between one by one."""
        precision, score = self.precision, self.score
        for state in range(STATES):
            variance = row.variance[state]
            column = precision[:, state]
            share = column * (variance / (1 + variance * column[state]))
            score = score - share * score[state]
            precision = precision - share[:, None] * column
        return LaterSpots(precision * (row.keep[:, None] * row.keep), score * row.keep)

    def joined(self, belief: Belief) -> Belief:
        """Combine earlier and later spots for the state's mean and covariance.

        The later spots' precision is decomposed column by column (Cholesky without roots), and each column is used as a
        scalar observation. Calls of a matrix library would cost more than the filter.
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


@compiled(jax.Array)
def _by_move(
    z: Float[Array, "batch parameters"],
    turned_rad: Float[Array, "batch spots 2"],
    space: ParameterSpace,
    arrays: CampaignArrays,
) -> Float[Array, "batch spots"]:
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
        updated = kalman_update(cavity, row)
        log_density = log_scale - 0.5 * updated.log_variance - 0.5 * jnp.sum(updated.standardised**2)
        return (kalman_update(belief, row).belief, updated.belief), log_density

    def one(z, turned_rad):
        given = filter_input(space.model(z), arrays)
        left = given.rows.residual - jnp.einsum("sij,sj->si", given.slope, turned_rad)
        given = eqx.tree_at(lambda x: x.rows.residual, given, left)
        nothing = LaterSpots(jnp.zeros((STATES, STATES)), jnp.zeros(STATES))
        _, beyond = jax.lax.scan(backward, (nothing, nothing), (given.rows, last), reverse=True)
        rows = (given.rows, first, beyond, given.log_scale)
        return jax.lax.scan(forward, (no_belief(), no_belief()), rows)[1]

    return jax.vmap(one)(z, turned_rad)


def move_log_density(
    z: np.ndarray, place_errors_rad: np.ndarray, space: ParameterSpace, arrays: CampaignArrays
) -> np.ndarray:
    """Compute the log density of each move's spots given ALL other spots, parameters and gear errors (formulation 4.3).

    Stop errors persist while their axis stands still, so spots are not independent given the parameters; only whole
    moves can be left out. Backward and forward passes meet at each move (two-filter smoother: Fraser and Potter, IEEE
    Trans. Automat. Control 14 (1969) 387). It is compiled for `WINDOW` spots or a power of two times as many.

    Args:
        z: coordinates of many points, shape (n, p).
        place_errors_rad: transmission errors, then plays, at the filled places, shape (n, e); a draw for each point.
        space: priors.
        arrays: the campaign.

    Returns:
        Contribution of each spot given the earlier spots of its own move and all spots of the other moves, shape (n,
        spots): the sum over a move's spots is the move's log density, without `campaign_arrays.spot_constants`.
    """
    count = int(arrays.count)
    window = arrays.of_spots(0, min(bucket(count, WINDOW), len(arrays.spots.valid)))
    turned_rad = np.zeros((len(z), len(window.spots.valid), 2))
    turned_rad[:, :count] = turned_by(arrays, place_errors_rad)
    return np.asarray(_by_move(z, turned_rad, space, window))[:, :count]


@dataclass(frozen=True)
class OneWay:
    """A homing hypothesis: the fit under it, and the rows of its draws, shape (n,)."""

    fit: JointFit
    rows: np.ndarray


def ways_of(posterior: Posterior, places: np.ndarray) -> tuple[OneWay, ...]:
    """Group draws at indices (n,) of a posterior by their homing hypothesis."""
    if posterior.way is None:
        return (OneWay(posterior.fit, np.arange(len(places))),)
    own = posterior.way.ravel()[places]
    fits = [way.fit for way in posterior.fit.mixture if way.fit is not None]
    ways = (OneWay(fit, np.flatnonzero(own == k)) for k, fit in enumerate(fits))
    return tuple(way for way in ways if len(way.rows))


def by_way(ways: Sequence[OneWay], function: Callable[[JointFit, np.ndarray], np.ndarray]) -> np.ndarray:
    """Evaluate a function of draws, each by the fit under its homing hypothesis.

    Args:
        ways: homing hypotheses of the draws.
        function: function of a fit and the rows of its draws, which returns a row for each.
    """
    values = np.concatenate([function(way.fit, way.rows) for way in ways])
    return values[np.argsort(np.concatenate([way.rows for way in ways]))]


PIXEL_LABELS = tuple(name.removesuffix("_px") for name in PIXELS)


def move_log_likelihood(posterior: Posterior) -> xr.DataArray:
    """Compute log p(spots of a move | all other spots, parameters), dimensions (chain, draw, move), with constants."""
    import xarray as xr

    fit = posterior.fit
    spots = ordered_spots(fit.campaign)
    used = fit.arrays.used
    z, errors_rad = posterior.joined_z, np.asarray(posterior.joined.place_errors_rad)

    def of_way(fit: JointFit, rows: np.ndarray) -> np.ndarray:
        given = z[rows], errors_rad[rows]
        return in_batches(lambda z, e: move_log_density(z, e, fit.space, fit.arrays), *given)

    by_spot = by_way(ways_of(posterior, np.arange(len(z))), of_way) + spot_constants(fit.campaign)
    index = np.array([spot.move for spot in spots])
    moves_seen = np.unique(index[used])
    values = np.stack([by_spot[:, used & (index == move)].sum(axis=1) for move in moves_seen], axis=1)
    chains, draws = posterior.z.shape[:2]
    coords = {"chain": np.arange(chains), "draw": np.arange(draws), "move": moves_seen}
    return xr.DataArray(values.reshape(chains, draws, -1), coords, ("chain", "draw", "move"))


def looks(fit: JointFit, z: np.ndarray, stop_error_rad: np.ndarray) -> np.ndarray:
    """Compute noiseless pixels of all ordered spots, shape (draws, spots, 4), for coordinates (draws, p)."""
    observed = in_batches(lambda z, e: observe_with_stop_errors(z, e, fit.space, fit.arrays), z, stop_error_rad)
    return observed[..., :4]


def turned_by(arrays: CampaignArrays, place_errors_rad: np.ndarray) -> np.ndarray:
    """Compute the change of spots' angles (pan, tilt) by repeating errors (draws, e), shape (draws, spots, 2)."""
    gears = arrays.gears.without_padding()
    errors_rad, share = place_errors_rad[:, gears.rows], np.asarray(gears.share)[: int(arrays.count)]
    on_tilt = np.asarray(gears.on_tilt)
    axes = [errors_rad[:, of] @ share[:, of].T for of in (~on_tilt, on_tilt)]
    return np.stack(axes, axis=2)


def ideal_pixels(posterior: Posterior, draws: int) -> np.ndarray:
    """Compute pixels without noise and stop errors for draws of equal weight, shape (draws, spots, 4)."""
    z = posterior.coordinates(draws)
    errors_rad = np.asarray(posterior.thinned(draws).place_errors_rad)

    def of_way(fit: JointFit, rows: np.ndarray) -> np.ndarray:
        return looks(fit, z[rows], turned_by(fit.arrays, errors_rad[rows]))

    return by_way(ways_of(posterior, posterior.chosen(draws)), of_way)


def predictive_pixels(posterior: Posterior) -> xr.DataArray:
    """Predict the same looks taken again: new stop errors, home offsets, play and noise, ranges as observed.

    Returns:
        Dimensions (chain, draw, spot, pixel); the draws are a subset of the posterior's, with its coordinate.
    """
    import xarray as xr

    fit = posterior.fit
    generator = random_stream(posterior.seed, Stream.PREDICTED_MOVES)
    chains, draws = posterior.z.shape[:2]
    chosen = np.unique(np.linspace(0, draws - 1, min(PREDICTED_DRAWS, draws)).astype(int))
    z, drawn = posterior.joined_z, posterior.joined
    places = np.arange(chains * draws).reshape(chains, draws)[:, chosen].ravel()

    def of_way(fit: JointFit, rows: np.ndarray) -> np.ndarray:
        at = places[rows]
        physical, errors_rad = np.asarray(drawn.physical)[at], np.asarray(drawn.place_errors_rad)[at]
        return looks_again(fit, z[at], physical, errors_rad, generator)

    values = by_way(ways_of(posterior, places), of_way).reshape(chains, len(chosen), -1, 4)
    spots = [spot.spot for spot in ordered_spots(fit.campaign)]
    coords = {"chain": np.arange(chains), "draw": chosen, "spot": spots, "pixel": list(PIXEL_LABELS)}
    return xr.DataArray(values.astype(np.float32), coords, ("chain", "draw", "spot", "pixel"))


def looks_again(
    fit: JointFit,
    z: np.ndarray,
    physical: np.ndarray,
    place_errors_rad: np.ndarray,
    generator: np.random.Generator,
) -> np.ndarray:
    """Predict pixels (draws, spots, 4) of the same looks taken again at z (draws, p) with values `physical`.

    Gears repeat their errors at places (draws, e). Stop errors, home offsets, drifts, positions in the play, scatter of
    looks and pixel noise are drawn again; ranges are as observed.
    """
    count, mechanism = len(ordered_spots(fit.campaign)), fit.space.mechanism
    spots = jax.tree.map(lambda of_spot: np.asarray(of_spot)[:count], fit.arrays.spots)
    shape, rows = (len(z), count, 2), np.arange(count)[:, None]

    def held(values: np.ndarray, drawn: np.ndarray) -> np.ndarray:
        """Take values (draws, spots, 2) of the spot at which they were drawn last, (spots, 2) or (spots, 1)."""
        return np.take_along_axis(values, np.maximum.accumulate(np.where(drawn, rows, 0), axis=0)[None], axis=1)

    variance = np.sum(spots.redraw_mix[None] * np.radians(physical[:, mechanism.stop_columns])[:, None] ** 2, axis=3)
    error = held(np.sqrt(variance) * generator.standard_normal(shape), spots.redraw)
    home_rad, drift_rad, scatter_rad = (
        np.radians(physical[:, None, mechanism.columns(block)])
        for block in ("home_sd_deg", "drift_deg_per_root_hour", "look_scatter_deg")
    )
    home = np.sqrt(spots.homed) * home_rad * generator.standard_normal(shape)
    walked = drift_rad * np.sqrt(spots.hours) * generator.standard_normal(shape)
    total = np.cumsum(walked, axis=1)
    # The zero of an axis is set by a homing, and drifts as a random walk from there on.
    error = error + held(home - (total - walked), spots.new_zero) + total
    error = error + turned_by(fit.arrays, place_errors_rad)
    # The position in the play is Gaussian after an unknown approach, as in the filter.
    place = held(generator.standard_normal(shape), spots.new_segment[:, None])
    error = error + fit.linearised.play_sd_rad * place
    pixel_scale = physical[:, mechanism.index["pixel_scale"]].reshape(-1, 1, 1)
    noise = np.einsum("sij,nsj->nsi", np.linalg.inv(spots.whitening), generator.standard_normal((len(z), count, 4)))
    error = error + scatter_rad * generator.standard_normal(shape)
    return looks(fit, z, error) + pixel_scale * noise
