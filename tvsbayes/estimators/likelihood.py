"""Likelihood of all spots of a campaign: flat ranges, marginal stop errors and home offsets (formulation 4.1).

Stop errors (persistent while
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
from jaxtyping import Array, Float

from tvsbayes.estimators.campaign_arrays import CampaignArrays, SpotArrays
from tvsbayes.estimators.looks import Looks, looks_at
from tvsbayes.estimators.spot_residuals import NoiseScales, SpotResiduals, ToStates, noise_scales, spot_residuals
from tvsbayes.instrument.axes import HOME_SD_DEG
from tvsbayes.model.compiled import compiled
from tvsbayes.model.geometry import Scalar
from tvsbayes.model.laser_path import mirror_angles
from tvsbayes.model.parameter_space import Model, ParameterSpace

STATES = 6


def stop_variances(stop_sd_rad: Float[Array, "2 2"], spots: SpotArrays) -> Float[Array, "spots 2"]:
    """Variance of the stop errors (pan, tilt) that are new at each spot, by the direction of their move."""
    return jnp.sum(spots.redraw_mix * stop_sd_rad**2, axis=2)


class FilterRows(eqx.Module):
    """What the filter meets at each spot, in time order: its residual, how its states move it, which are new.

    `residual` has the shape (spots, components), or (spots, components, columns) where several are filtered at once;
    `load` is d(predicted)/d(state), `keep` is 0 for a state drawn anew since the previous spot and 1 otherwise,
    `variance` the variance it is then drawn with.
    """

    residual: Float[Array, "..."]
    load: Float[Array, "*spots components 6"]
    keep: Float[Array, "*spots 6"]
    variance: Float[Array, "*spots 6"]


def filter_rows(
    residual: Float[Array | np.ndarray, "spots components *columns"],
    slope: Float[Array | np.ndarray, "spots components 2"],
    play_sd_rad: Float[Array | np.ndarray, "spots 2"],
    stop_variance: Float[Array | np.ndarray, "spots 2"],
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
        residual=jnp.asarray(residual),
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
    standardised: Float[Array, "components *columns"]
    log_variance: Scalar


def kalman_update(belief: Belief, row: FilterRows) -> KalmanUpdate:
    """Update with one spot: its components have independent unit noise, so four scalar updates and no inverse."""
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


def standing(model: Model, arrays: CampaignArrays, inflation: Float[Array | np.ndarray, ""] | float = 1.0) -> Standing:
    """Linearise all spots; `inflation` is a factor on pixel and aperture noise (annealing)."""
    spots = arrays.spots
    angles = mirror_angles(model.transmission, model.tilt_zero_rad, arrays.moves)
    pan, tilt = (angles.angle_rad[:, axis][spots.move_index] for axis in range(2))
    looks = looks_at(model, pan, tilt, arrays)
    noise = noise_scales(model, spots, inflation)
    return Standing(
        looks,
        noise,
        spot_residuals(looks, noise, model, spots),
        angles.play_sd_rad[spots.move_index],
        stop_variances(model.noise.stop_sd_rad, spots),
    )


class FilterInput(eqx.Module):
    """Rows of the filter, and what no state can change.

    `free` is what is left of the standardised components, which no state changes; `log_scale` is what each spot adds to
    the log density besides the rows: theirs in it.
    """

    rows: FilterRows
    free: Float[Array, "spots 4"]
    log_scale: Float[Array, " spots"]


def filter_input(model: Model, arrays: CampaignArrays) -> FilterInput:
    """Linearise all spots for the filter."""
    found = standing(model, arrays)
    terms = found.terms
    turned = ToStates.of(terms.by_pan, terms.by_tilt)
    first, second, *free = turned.of_many(terms.residual)
    seen = jnp.stack([first, second], axis=1)
    rows = filter_rows(seen, turned.slope, found.play_sd_rad, found.stop_variance, arrays.spots)
    log_scale = terms.log_scale - 0.5 * sum(number**2 for number in free)
    return FilterInput(rows, jnp.stack(free, axis=1), log_scale)


class Innovations(eqx.Module):
    """Standardised one-step prediction errors, N(0, 1) and independent under the model.

    Of each spot two by the filter, then what no stop error changes: four components with the freedom of two at most.
    `log_density` is the campaign's log likelihood without the terms of `log_constant`.
    """

    standardised: Float[Array, "spots 6"]
    log_density: Scalar


class Seen(eqx.Module):
    """Spots seen by the filter: standardised errors (spots, components, ...), and logs of their variances' products."""

    standardised: Float[Array, "..."]
    log_variance: Float[Array, "*spots"]


def filtered(rows: FilterRows) -> Seen:
    """Run the filter over all spots in time order."""

    def step(belief, row):
        seen = kalman_update(belief.renewed(row), row)
        return seen.belief, Seen(seen.standardised, seen.log_variance)

    columns = rows.residual.shape[2:]
    return jax.lax.scan(step, no_belief(*columns), rows)[1]


def innovations(model: Model, arrays: CampaignArrays) -> Innovations:
    """Run the filter over all spots in time order.

    Args:
        model: parameters.
        arrays: the campaign.

    Returns:
        Standardised innovations and log likelihood; cost linear in the number of spots.
    """
    given = filter_input(model, arrays)
    seen = filtered(given.rows)
    explained = jnp.sum(seen.log_variance) + jnp.sum(seen.standardised**2)
    standardised = jnp.concatenate([seen.standardised, given.free], axis=1)
    return Innovations(standardised, jnp.sum(given.log_scale) - 0.5 * explained)


def log_density(z: Float[Array, " parameters"], space: ParameterSpace, arrays: CampaignArrays) -> Scalar:
    """Log posterior density of the coordinates, up to a constant: likelihood and standard-normal priors."""
    return innovations(space.model(z), arrays).log_density - 0.5 * jnp.dot(z, z)


class Evaluation(eqx.Module):
    """Log posterior density and standardised innovations; many points give every field a leading axis."""

    log_density: Float[Array, "*batch"]
    standardised: Float[Array, "*batch spots 6"]


@compiled(Evaluation)
def evaluate(z: Float[Array, "batch parameters"], space: ParameterSpace, arrays: CampaignArrays) -> Evaluation:
    """`log_density` of many points in one call; call it with one batch size, each compiles anew."""

    def one(z):
        seen = innovations(space.model(z), arrays)
        return Evaluation(seen.log_density - 0.5 * jnp.dot(z, z), seen.standardised)

    return jax.vmap(one)(z)
