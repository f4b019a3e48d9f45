"""The Kalman filter of a campaign over spots in time order, and further columns through its gains.

Its state: stop error (pan, tilt), home offset (pan, tilt), position in the unknown play band (pan, tilt), in units of
its standard deviation. Angles rad; residuals in units of their noise (formulation 4.1).
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tvsbayes.estimators.campaign_arrays import SpotArrays
from tvsbayes.gears.kalman import state_predicted, state_updated
from tvsbayes.model.geometry import materialise

STATES = 6


class FilterRows(eqx.Module):
    """Input of the filter at each spot, in time order: residual, loads of the states, and which states are new.

    `residual` has the shape (spots, components), or (spots, components, columns) where several are filtered at once.
    `load` is d(predicted)/d(state). `keep` is 0 for a state drawn again since the previous spot, else 1. `variance` is
    added to the state's variance since then: that of the draw, or of a random walk.
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
    zero_variance: Float[Array | np.ndarray, "spots 2"],
    spots: SpotArrays,
    functions: ModuleType = jnp,
) -> FilterRows:
    """Build the filter's input at every spot: stop errors, home offsets with drift, positions in an unknown play.

    Args:
        residual: observed - predicted, or other columns to filter.
        slope: d(predicted)/d(pan, tilt).
        play_sd_rad: sd of the position in the play, zero where it is known.
        stop_variance: from `stop_variances`.
        zero_variance: from `zero_variances`.
        spots: which of them follow a homing or have new stop errors.
        functions: jax.numpy or numpy.
    """
    xp, pairs = functions, (len(spots.valid), 2)
    segment = xp.broadcast_to(spots.new_segment[:, None], pairs)
    drawn = xp.where(spots.redraw, stop_variance, 0.0)
    return FilterRows(
        residual=xp.asarray(residual),
        load=xp.concatenate([slope, slope, slope * play_sd_rad[:, None]], axis=2),
        keep=xp.where(xp.concatenate([spots.redraw, spots.new_zero, segment], axis=1), 0.0, 1.0),
        variance=xp.concatenate([drawn, zero_variance, xp.where(segment, 1.0, 0.0)], axis=1),
    )


class Belief(eqx.Module):
    """Mean (for every column of residuals) and covariance of the filter's state."""

    mean: Float[Array | np.ndarray, "6 *columns"]
    covariance: Float[Array | np.ndarray, "6 6"]

    def renewed(self, row: FilterRows) -> Belief:
        """Predict the state at the spot, before the update with it."""
        return Belief(*state_predicted(self.mean, self.covariance, row.keep, row.variance, jnp))


class Gains(eqx.Module):
    """Gains of a spot's successive components: the means change by `gain` times the error standardised by `sd`."""

    gain: Float[Array, "*spots components 6"]
    sd: Float[Array, "*spots components"]


class Seen(eqx.Module):
    """Filtered spots, or one: standardised errors (spots, components, ...), logs of their variances' products.

    `belief` is the state after the last of them; `gains` are those of all.
    """

    standardised: Float[Array, "..."]
    log_variance: Float[Array, "*spots"]
    belief: Belief
    gains: Gains


def kalman_update(belief: Belief, row: FilterRows) -> Seen:
    """Update with one spot, by a scalar update for each component, as their noise is independent, of unit variance."""
    mean, covariance = belief.mean, belief.covariance
    errors, variances, gains = [], [], []
    for component in range(len(row.load)):
        observed = row.residual[component], row.load[component]
        mean, covariance, error, ahead, gain = state_updated(mean, covariance, *observed, 1.0, jnp)
        errors.append(error / jnp.sqrt(ahead))
        variances.append(ahead)
        gains.append(gain / jnp.sqrt(ahead))
    variance = jnp.stack(variances)
    update = Gains(jnp.stack(gains), jnp.sqrt(variance))
    return Seen(jnp.stack(errors), jnp.sum(jnp.log(variance)), Belief(mean, covariance), update)


def no_belief(*columns: int) -> Belief:
    """Return the state before the first spot, at which all states are new."""
    return Belief(jnp.zeros((STATES, *columns)), jnp.zeros((STATES, STATES)))


def filtered(rows: FilterRows, before: Belief) -> Seen:
    """Run the filter over spots in time order, from the state before them."""

    def step(belief, row):
        updated = kalman_update(belief.renewed(row), row)
        return updated.belief, (updated.standardised, updated.log_variance, updated.gains)

    after, (standardised, log_variance, gains) = jax.lax.scan(step, before, rows)
    return Seen(standardised, log_variance, after, gains)


def columns_filtered(
    columns: Float[Array, "spots components columns"],
    rows: FilterRows,
    gains: Gains,
    before: Float[Array, "6 columns"],
) -> tuple[Float[Array, "spots components columns"], Float[Array, "6 columns"]]:
    """Filter further columns with known gains: products of few numbers before and after the scan.

    Returns:
        The columns standardised, and the means of the state for them after the last spot.
    """
    load, whitened = rows.load / gains.sd[..., None], columns / gains.sd[..., None]
    loads: list[Any] = []
    residuals: list[Any] = []
    # The load of later components includes the updates by earlier ones.
    for component in range(whitened.shape[1]):
        slope, residual = load[:, component], whitened[:, component]
        for earlier in range(component):
            share = jnp.sum(load[:, component] * gains.gain[:, earlier], axis=1)[:, None]
            slope, residual = slope - share * loads[earlier], residual - share * residuals[earlier]
        loads.append(slope)
        residuals.append(residual)
    whole = jnp.stack(loads, axis=1) * rows.keep[:, None], jnp.stack(residuals, axis=1)

    def step(mean, row):
        load, residual, keep, gain = row
        # Explicit sums compile to loops over whole rows of columns.
        moved = sum(load[:, state, None] * mean[state] for state in range(STATES))
        standardised = materialise(residual - moved)
        followed = sum(gain[component, :, None] * standardised[component] for component in range(len(gain)))
        return keep[:, None] * mean + followed, standardised

    mean, standardised = jax.lax.scan(step, before, materialise((*whole, rows.keep, gains.gain)))
    return standardised, mean
