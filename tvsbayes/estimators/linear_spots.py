"""Spots linearised at a point of parameter space, and leave-one-out quantities of each spot and stop.

NumPy after one compiled linearisation. All spots taken between two moves share their stop errors and form a group. With
C the covariance of all residuals (unit noise + stop errors, home offsets, unknown play), one forward and one backward
pass give, for every group g, u_g = [C^-1 r]_g, [C^-1 J]_g and the diagonal block M_g = [C^-1]_gg in time linear in the
number of groups (disturbance smoother: de Jong, Biometrika 75 (1988) 594; Durbin and Koopman, Time Series Analysis by
State Space Methods, 4.5). These give leave-one-out residuals and standard deviations. Residuals are whitened.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import linalg

from tvsbayes.estimators.campaign_arrays import CampaignArrays
from tvsbayes.estimators.kalman_filter import filter_rows
from tvsbayes.estimators.likelihood import look_terms, place_columns, roots_at
from tvsbayes.estimators.look_jacobian import look_jacobian
from tvsbayes.model.parameter_space import ParameterSpace, Point


class LinearLooks(eqx.Module):
    """Spots linearised at a point; the first axis of all arrays is over spots.

    Residuals, slopes and derived arrays are in units of the noise of a look, its scatter included. `place_columns` is
    d(predicted)/d(errors of the gears' columns, rad).
    """

    residual: Float[Array | np.ndarray, "spots 4"]
    slope: Float[Array | np.ndarray, "spots 4 2"]
    play_sd_rad: Float[Array | np.ndarray, "spots 2"]
    mirror_angles_rad: Float[Array | np.ndarray, "spots 2"]
    predicted: Float[Array | np.ndarray, "spots 5"]
    stop_variance: Float[Array | np.ndarray, "spots 2"]
    zero_variance: Float[Array | np.ndarray, "spots 2"]
    scatter_variance: Float[Array | np.ndarray, "spots 2"]
    place_columns: Float[Array | np.ndarray, "spots 4 errors"]
    residual_jacobian: Float[Array | np.ndarray, "spots 4 parameters"]
    predicted_jacobian: Float[Array | np.ndarray, "spots 5 parameters"]


class Linearised(LinearLooks):
    """A campaign linearised at coordinates `z`, without padding.

    `place_root` is the factor of the prior covariance of the errors of the gears' columns, rad.
    """

    z: Float[Array | np.ndarray, " parameters"]
    place_root: Float[Array | np.ndarray, "errors errors"]

    @classmethod
    def joined(
        cls, parts: Sequence[LinearLooks], point: Point, space: ParameterSpace, arrays: CampaignArrays
    ) -> Linearised:
        """Concatenate parts, without padding of columns, as NumPy arrays."""
        count, gears = int(arrays.count), arrays.gears.without_padding()
        given = {
            field.name: np.concatenate([np.asarray(getattr(part, field.name)) for part in parts])[:count]
            for field in fields(LinearLooks)
        }
        given["place_columns"] = given["place_columns"][..., : gears.columns]
        blocks = roots_at(np.asarray(point.values)[None], space, gears).blocks
        root = linalg.block_diag(*(block[0] for block in blocks))
        return cls(**given, z=np.asarray(point.z), place_root=root)

    @property
    def place_load(self) -> Float[Array | np.ndarray, "spots 4 errors"]:
        """Compute d(predicted)/d(errors at places), these in units in which they are N(0, 1) a priori."""
        return self.place_columns @ self.place_root

    def by_coordinates(self, held: np.ndarray) -> np.ndarray:
        """Return d(predicted)/d(coordinates), 0 for those held (p,), shape (spots, 4, p)."""
        return np.where(held, 0.0, -np.asarray(self.residual_jacobian))

    def by_angles(self, rows: np.ndarray) -> np.ndarray:
        """Return d(predicted)/d(mirror angles) of some spots (k,), pan and tilt in turn, shape (spots, 4, 2 k)."""
        slope = np.asarray(self.slope)
        columns = np.zeros((*slope.shape[:2], 2 * len(rows)))
        for k, row in enumerate(rows.tolist()):
            columns[row, :, 2 * k : 2 * k + 2] = slope[row]
        return columns

    def spot_deviations(self) -> SpotDeviations:
        """Fit both angles to the whitened residuals of each spot; covariance 0 where a spot determines neither."""
        slope = np.asarray(self.slope)
        with np.errstate(all="ignore"):
            covariance = np.linalg.pinv(np.einsum("nia,nib->nab", slope, slope))
        return SpotDeviations(np.einsum("nab,nib,ni->na", covariance, slope, np.asarray(self.residual)), covariance)


@dataclass(frozen=True)
class SpotDeviations:
    """Mirror angles (pan, tilt), observed minus predicted, of every spot by itself, its range projected out.

    Attributes:
        deviation_rad: shape (spots, 2).
        covariance_rad2: covariance due to pixel noise and scatter of looks, shape (spots, 2, 2).
    """

    deviation_rad: np.ndarray
    covariance_rad2: np.ndarray


def linearise(
    at: Point,
    space: ParameterSpace,
    arrays: CampaignArrays,
    inflation: Float[Array | np.ndarray, ""] | float = 1.0,
) -> LinearLooks:
    """Linearise residuals and ideal observations at the observed ranges in the coordinates, at fixed noise scales.

    Args:
        at: coordinates and their values.
        space: priors.
        arrays: the campaign.
        inflation: factor on pixel and aperture noise.
    """
    model = space.model_at(jnp.asarray(at.values))
    given = look_terms(model, arrays, inflation)
    looks, terms = given.looks, given.terms
    by_coordinates = look_jacobian(at, space, looks, arrays)
    unit_noise = given.to_states.in_place
    residuals = unit_noise(terms.range_out.of_many(given.noise.whitened(by_coordinates, arrays.spots))[1:])
    slope = jnp.stack([jnp.stack(unit_noise(own), axis=1) for own in (terms.by_pan, terms.by_tilt)], axis=2)
    return LinearLooks(
        residual=jnp.stack(unit_noise(terms.residual), axis=1),
        slope=slope,
        play_sd_rad=given.play_sd_rad,
        mirror_angles_rad=jnp.stack([looks.pan_rad, looks.tilt_rad], axis=1),
        predicted=jnp.stack(looks.predicted, axis=1),
        stop_variance=given.stop_variance,
        zero_variance=given.zero_variance,
        scatter_variance=given.scatter_variance,
        place_columns=place_columns(slope, arrays.gears),
        residual_jacobian=-jnp.stack(residuals).transpose(2, 0, 1),
        predicted_jacobian=jnp.stack(by_coordinates).transpose(2, 0, 1),
    )


@dataclass(frozen=True)
class LinearSpots:
    """The linearised campaign, spots in time order, without padding.

    Attributes:
        residual: observed - predicted, shape (n, 4).
        load: d(predicted)/d(filter state), shape (n, 4, 6).
        renewed: states drawn again since the previous spot, shape (n, 6).
        variance: variance added to the states since the previous spot, shape (n, 6).
        jacobian: -d(residual)/d(coordinates), shape (n, 4, p).
        places: d(predicted)/d(errors at places, N(0, 1) a priori), shape (n, 4, e).
    """

    residual: np.ndarray
    load: np.ndarray
    renewed: np.ndarray
    variance: np.ndarray
    jacobian: np.ndarray
    places: np.ndarray

    def spelled_out(self, columns: np.ndarray) -> LinearSpots:
        """Append the errors at places to the coordinates; `columns` (n, 4, e) are their derivatives, in any unit."""
        return replace(self, jacobian=np.concatenate([self.jacobian, columns], axis=2), places=self.places[..., :0])


def linear_spots(lin: Linearised, arrays: CampaignArrays, jacobian: np.ndarray) -> LinearSpots:
    """Prepare a linearised campaign for the smoother.

    Args:
        lin: linearised campaign, without padding.
        arrays: the campaign.
        jacobian: d(prediction)/d(quantities of interest), shape (spots, 4, columns).
    """
    spots = jax.tree.map(lambda x: np.asarray(x)[: len(lin.residual)], arrays.spots)
    variances = np.asarray(lin.stop_variance), np.asarray(lin.zero_variance)
    residual, slope, play_sd_rad = (np.asarray(part) for part in (lin.residual, lin.slope, lin.play_sd_rad))
    rows = filter_rows(residual, slope, play_sd_rad, *variances, spots, functions=np)
    load, keep, variance = np.asarray(rows.load), np.asarray(rows.keep), np.asarray(rows.variance)
    return LinearSpots(residual, load, keep == 0, variance, jacobian, np.asarray(lin.place_load))


@dataclass(frozen=True)
class StopGroup:
    """Consecutive spots that share all their states.

    Attributes:
        rows: slice of the spots.
        residual: [C^-1 r] of the group of s spots, shape (4 s,).
        jacobian: [C^-1 J] of the group, shape (4 s, p).
        precision: [C^-1] of the group, shape (4 s, 4 s).
    """

    rows: slice
    residual: np.ndarray
    jacobian: np.ndarray
    precision: np.ndarray


@dataclass(frozen=True)
class StopInformation:
    """All groups, the information on the coordinates, and the conditional errors at places.

    Attributes:
        groups: in time order.
        fisher: the likelihood's information J^T C^-1 J, shape (p, p).
        place_mean: mean of the errors at places given the coordinates, in units of N(0, 1) a priori, shape (e,).
        place_slope: derivative of that mean by the coordinates, shape (e, p).
        place_covariance: covariance of those errors given the coordinates, shape (e, e).
    """

    groups: tuple[StopGroup, ...]
    fisher: np.ndarray
    place_mean: np.ndarray
    place_slope: np.ndarray
    place_covariance: np.ndarray

    @cached_property
    def residual(self) -> np.ndarray:
        """Return C^-1 r of all spots, shape (4 n,)."""
        return np.concatenate([group.residual for group in self.groups])

    def score(self, jacobian: np.ndarray) -> np.ndarray:
        """Compute J^T C^-1 r, shape (q,), by d(prediction)/d(quantities) of all spots, shape (n, 4, q)."""
        return jacobian.reshape(len(self.residual), -1).T @ self.residual


def _group_rows(spots: LinearSpots) -> list[slice]:
    fresh = spots.renewed.any(axis=1) | (spots.variance > 0).any(axis=1)
    starts = [i for i in range(len(fresh)) if i == 0 or fresh[i]]
    return [slice(a, b) for a, b in zip(starts, [*starts[1:], len(fresh)], strict=True)]


def stop_information(spots: LinearSpots) -> StopInformation:
    """Filter forward, smooth backward, and eliminate errors that repeat (Woodbury's identity).

    Args:
        spots: the linearised campaign.

    Returns:
        Groups in time order and the Fisher information of the coordinates.
    """
    places = spots.places.shape[-1]
    parameters = spots.jacobian.shape[-1] + places
    states = spots.load.shape[-1]
    targets = np.concatenate([spots.residual[..., None], spots.jacobian, spots.places], axis=2)
    slices = _group_rows(spots)
    mean, covariance = np.zeros((states, 1 + parameters)), np.zeros((states, states))
    forward, aheads = [], []
    for rows in slices:
        keep = ~spots.renewed[rows.start]
        mean = mean * keep[:, None]
        covariance = covariance * np.outer(keep, keep) + np.diag(spots.variance[rows.start])
        load = spots.load[rows].reshape(-1, states)
        ahead = targets[rows].reshape(-1, 1 + parameters) - load @ mean
        covariance_ahead = load @ covariance @ load.T + np.eye(len(load))
        inverse = linalg.cho_solve(linalg.cho_factor(covariance_ahead), np.eye(len(load)))
        gain = covariance @ load.T @ inverse
        whitened = inverse @ ahead
        aheads.append(ahead)
        forward.append((keep, load, inverse, gain, whitened))
        mean = mean + gain @ ahead
        covariance = covariance - gain @ load @ covariance
        covariance = 0.5 * (covariance + covariance.T)

    groups = []
    score, information = np.zeros((states, 1 + parameters)), np.zeros((states, states))
    for rows, (keep, load, inverse, gain, whitened) in zip(slices[::-1], forward[::-1], strict=True):
        # `score` and `information` are those after this group's update: u = F^-1 v - K^T r, M = F^-1 + K^T N K.
        disturbance = whitened - gain.T @ score
        precision = inverse + gain.T @ information @ gain
        groups.append(StopGroup(rows, disturbance[:, 0], disturbance[:, 1:], precision))
        through = np.eye(states) - gain @ load
        score = (load.T @ disturbance + score) * keep[:, None]
        information = (load.T @ inverse @ load + through.T @ information @ through) * np.outer(keep, keep)
    # One product of all rows: with many columns a sum over groups would dominate the cost.
    nothing = np.zeros((0, 1 + parameters))
    whole = np.concatenate([nothing, *aheads]).T @ np.concatenate([nothing, *(entry[-1] for entry in forward)])
    return _without_places(groups[::-1], whole, parameters - places)


def _without_places(groups: list[StopGroup], whole: np.ndarray, parameters: int) -> StopInformation:
    """Integrate out the errors at places.

    Args:
        groups: groups with those errors as further coordinates.
        whole: products of the columns residual, coordinates and errors by the inverse covariance without the latter.
        parameters: number of coordinates.
    """
    places = slice(1 + parameters, None)
    count = len(whole) - 1 - parameters
    covariance = np.linalg.inv(np.eye(count) + whole[places, places])
    explained = covariance @ whole[places, : 1 + parameters]
    fisher = whole[1 : 1 + parameters, 1 : 1 + parameters] - whole[1 : 1 + parameters, places] @ explained[:, 1:]
    if count:
        groups = [
            StopGroup(
                g.rows,
                g.residual - g.jacobian[:, parameters:] @ explained[:, 0],
                g.jacobian[:, :parameters] - g.jacobian[:, parameters:] @ explained[:, 1:],
                g.precision - g.jacobian[:, parameters:] @ covariance @ g.jacobian[:, parameters:].T,
            )
            for g in groups
        ]
    return StopInformation(tuple(groups), fisher, explained[:, 0], -explained[:, 1:], covariance)


def leave_one_out_chi2(information: StopInformation, weight: np.ndarray) -> np.ndarray:
    """Compute the squared distance of each spot from its prediction by all OTHER spots, shape (n,).

    It equals twice the gain in log density from leaving the spot out, up to the determinant: of two spots of a stop
    that disagree, the one without which the others fit better has the larger value.

    Args:
        information: information of the linearised campaign.
        weight: robust weights w that are in its residuals, shape (n,). Distances are those at full weight: in the
            covariance I + w P of a weighted innovation, with P predicted, only the noise is scaled back.
    """
    values: list[float] = []
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
    """Compute standard deviations of quantities without a group's spots.

    Removing a block from a Gaussian changes the information by -[C^-1 J]^T M^-1 [C^-1 J]; the covariance follows
    by Woodbury's identity.

    Args:
        group: the stop.
        covariance: posterior covariance of the coordinates, shape (p, p).
        gradients: d(quantity)/d(coordinates), shape (q, p).

    Returns:
        Shape (q,); inf where the other spots and the priors have no information.
    """
    spread = group.jacobian @ covariance
    inner = group.precision - spread @ group.jacobian.T
    lost = spread @ gradients.T
    values, vectors = np.linalg.eigh(0.5 * (inner + inner.T))
    projected = vectors.T @ lost
    with np.errstate(divide="ignore", invalid="ignore"):
        extra = np.where(np.abs(projected) > 0, projected**2 / np.maximum(values, 0.0)[:, None], 0.0)
    return np.sqrt(np.einsum("qi,ij,qj->q", gradients, covariance, gradients) + extra.sum(axis=0))
