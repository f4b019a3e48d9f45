"""How the posterior's ridges lie at a fit's mode: order and scale of coordinates, bends, widths; the map made of them.

Frames, coordinates z, y, w: `posterior.transport`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import numpy as np
from scipy import linalg

from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.likelihood import evaluate, no_draw
from tvsbayes.estimators.linear_spots import LinearSpots, linear_spots, stop_information
from tvsbayes.instrument.parameters import INDEX, KINDS, NAMES, NOISE_NAMES, names_of
from tvsbayes.model.compiled import in_batches
from tvsbayes.model.parameter_space import STOP_COLUMNS
from tvsbayes.posterior.transport import GEAR_SCALES, STRETCH_NODES, Transport

NARROW = 0.15
"""Conditional posterior sd, in prior sds, below which a coordinate is moved by the shear. Wider ones would be moved
far enough for cubic terms to matter."""
SHEAR_STEP = 0.5
"""Step of the second differences in posterior sds: the shear should hold over +-2 sd, not only at the mode."""
STATES_MAX = 64
"""Most stop errors for which the whole covariance follows the noise scales of every walker. With more stops its
matrices cost several times the density, the scales are known better, and widths from a table do."""
STRETCH_LIMITS = 1e-2, 1e2
"""Of the information of a coordinate, 1 at the mode."""


def by_width(covariance: np.ndarray) -> np.ndarray:
    """Order of the coordinates in which each has the largest variance left by those before it."""
    rest = covariance.copy()
    order: list[int] = []
    for _ in range(len(covariance)):
        variances = np.diag(rest).copy()
        variances[order] = -np.inf
        widest = int(np.argmax(variances))
        order.append(widest)
        rest = rest - np.outer(rest[:, widest], rest[widest]) / rest[widest, widest]
    return np.array(order, dtype=int)


@dataclass(frozen=True)
class StopStates:
    """Every stop error, home offset and place in the play that a campaign drew, one column each.

    Attributes:
        load: d(predicted)/d(state) of the spots' components, shape (4 n, m).
        variance: at the fit's noise scales, by direction (right, left, down, up), shape (m, 4).
        constant: of states of another kind, shape (m,).
    """

    load: np.ndarray
    variance: np.ndarray
    constant: np.ndarray


def stop_states(fit: JointFit, linear: LinearSpots) -> StopStates:
    """Unroll the filter's six states: a column for each time that one is drawn anew; none beyond `STATES_MAX`."""
    spots, states = linear.load.shape[0], linear.load.shape[2]
    mix = np.asarray(fit.arrays.spots.redraw_mix)[:spots]
    variance_of = np.radians(np.asarray(fit.mode.physical)[STOP_COLUMNS]) ** 2
    places, variance, constant = [], [], []
    for state in range(states):
        drawn = np.flatnonzero(linear.renewed[:, state])
        for begin, end in zip(drawn, [*drawn[1:], spots], strict=True):
            by_direction = np.zeros((2, 2))
            if state < 2:
                by_direction[state] = mix[begin, state] * variance_of[state]
            rest = 0.0 if state < 2 else linear.variance[begin, state]
            if linear.load[begin:end, :, state].any() and by_direction.sum() + rest > 0:
                places.append((slice(begin, end), state))
                variance.append(by_direction.ravel())
                constant.append(rest)
    # Columns of every state of a long campaign would fill the memory.
    count = len(places) if len(places) <= STATES_MAX else 0
    load = np.zeros((spots, 4, count))
    for column, (rows, state) in enumerate(places[:count]):
        load[rows, :, column] = linear.load[rows, :, state]
    variances = np.array(variance[:count]).reshape(count, 4)
    return StopStates(load.reshape(4 * spots, count), variances, np.array(constant[:count]))


@dataclass(frozen=True)
class Whitening:
    """Order and scale of the sampled coordinates; fields as in `Transport`, and the places that are no noise scales."""

    free: np.ndarray
    root: np.ndarray
    noise: np.ndarray
    geometry: np.ndarray


def whitening(fit: JointFit, whole: bool) -> Whitening:
    """Widest coordinate first, by the Laplace covariance.

    Args:
        fit: a converged fit.
        whole: noise coordinates come before all others, whose covariance is the linearised campaign's at known scales.
    """
    free = np.flatnonzero(fit.free)
    if whole:
        scales = np.isin(np.array(NAMES)[free], NOISE_NAMES)
        own, others = free[scales], free[~scales]
        covariance = np.linalg.inv(np.eye(len(others)) + fit.information.fisher[np.ix_(others, others)])
        order = by_width(covariance)
        free = np.concatenate([own, others[order]])
        parts = fit.covariance[np.ix_(own, own)], covariance[np.ix_(order, order)]
        root = linalg.block_diag(*map(np.linalg.cholesky, parts))
    else:
        free = free[by_width(fit.covariance[np.ix_(free, free)])]
        root = np.linalg.cholesky(fit.covariance[np.ix_(free, free)])
    scales = np.isin(np.array(NAMES)[free], NOISE_NAMES)
    return Whitening(free, root, np.flatnonzero(scales), np.flatnonzero(~scales))


@dataclass(frozen=True)
class Products:
    """Of coordinates y (J), states with errors at places in rad (G) and the residual r; fields as in `Transport`.

    By the inverse covariance of everything else.
    """

    known: np.ndarray
    load: np.ndarray
    states: np.ndarray
    score: np.ndarray
    state_score: np.ndarray

    @classmethod
    def of(cls, gram: np.ndarray, moment: np.ndarray, coordinates: int) -> Products:
        """From the products of all columns and of them with r."""
        own, rest = slice(coordinates), slice(coordinates, None)
        return cls(gram[own, own], gram[own, rest], gram[rest, rest], moment[own], moment[rest])


def _products(fit: JointFit, linear: LinearSpots, stops: StopStates, ways: np.ndarray) -> Products:
    """With few stops their errors are states; with many they stay in the covariance as the mode has it."""
    along = linear.jacobian @ ways
    places = np.asarray(fit.linearised.place_columns)
    count = along.shape[2]
    if stops.load.shape[1]:
        rows = along.reshape(-1, count), stops.load, places.reshape(len(stops.load), -1)
        columns = np.concatenate(rows, axis=1)
        return Products.of(columns.T @ columns, columns.T @ linear.residual.ravel(), count)
    columns = np.concatenate([along, places], axis=2)
    found = stop_information(replace(linear, jacobian=along).spelled_out(places))
    seen = np.concatenate([group.residual for group in found.groups])
    return Products.of(found.fisher, columns.reshape(-1, columns.shape[2]).T @ seen, count)


def unbent(fit: JointFit) -> Transport:
    """The map whose ridges are straight and whose widths do not follow the noise scales by a table."""
    linear = linear_spots(fit.linearised, fit.arrays, -np.asarray(fit.linearised.residual_jacobian))
    stops = stop_states(fit, linear)
    few, places = len(stops.constant) > 0, jax.tree.map(np.asarray, fit.arrays.gears.places)
    found = whitening(fit, few or len(places.steps) > 0)
    free, root, noise = found.free, found.root, found.noise
    narrow = np.flatnonzero(np.diag(root) < NARROW)
    narrow = narrow[np.isin(narrow, found.geometry)]
    wide = root[np.ix_(found.geometry, found.geometry)]
    ways = np.zeros((len(NAMES), len(found.geometry)))
    ways[free[found.geometry]] = wide
    of_noise = STOP_COLUMNS.reshape(4, 1) == free[noise]
    half = np.asarray(fit.space.kind)[free[noise]] == KINDS.index("half-normal")
    ratio = np.radians([fit.mode.physical[INDEX[name]] for name in names_of("degrees_per_step")])
    return Transport(
        mode=fit.z,
        free=free,
        root=root,
        noise=noise,
        narrow=narrow,
        bend=np.zeros((len(narrow), len(free), len(free))),
        stretch=np.zeros((len(noise), len(STRETCH_NODES), len(free))),
        slope=np.where(half, 1.0, np.asarray(fit.space.u)[free[noise]])[:, None] * root[np.ix_(noise, noise)],
        half=half,
        pixels=(free[noise] == INDEX["pixel_scale"]) * float(few),
        variance=stops.variance @ of_noise,
        # Stop errors whose sd is not estimated keep their variance.
        constant=stops.constant + stops.variance @ ~of_noise.any(axis=1),
        prior=wide.T @ wide,
        **vars(_products(fit, linear, stops, ways)),
        place_angle_rad=places.steps * ratio[places.on_tilt.astype(int)],
        place_on_tilt=places.on_tilt,
        place_valid=places.valid,
        gear_scale=np.asarray(fit.mode.physical)[GEAR_SCALES],
        gear_noise=(GEAR_SCALES[:, None] == free[noise]).astype(float),
        period_deg=np.asarray(fit.space.harmonic_period_deg),
    )


Residuals = Callable[[np.ndarray], np.ndarray]
"""Standardised innovations (n, r) at places y (n, d) of the straight map."""


def bends(route: Transport, residuals: Residuals) -> np.ndarray:
    """Quadratic forms of the shear, shape (k, d, d): second differences of the residuals along the narrow places."""
    count, narrow, geometry = route.dimension, route.narrow, route.geometry
    bend, steps = np.zeros_like(route.bend), SHEAR_STEP * np.eye(count)
    centre = residuals(np.zeros((1, count)))[0]
    ahead, behind = residuals(steps), residuals(-steps)
    slopes = (ahead - behind)[narrow] / (2 * SHEAR_STEP)
    own = (ahead + behind - 2 * centre) @ slopes.T / SHEAR_STEP**2
    bend[:, geometry, geometry] = own[geometry].T
    pairs = np.array([(i, j) for i in geometry for j in geometry if j < i]).reshape(-1, 2)
    for some in np.array_split(pairs, max(1, len(pairs) // 256)) if len(pairs) else ():
        y = np.zeros((len(some), count))
        np.put_along_axis(y, some, SHEAR_STEP, axis=1)
        both = residuals(np.concatenate([y, -y]))
        curvature = (both[: len(some)] + both[len(some) :] - 2 * centre) @ slopes.T / SHEAR_STEP**2
        mixed = 0.5 * (curvature - own[some[:, 0]] - own[some[:, 1]])
        bend[:, some[:, 0], some[:, 1]] = bend[:, some[:, 1], some[:, 0]] = mixed.T
    for place, form in zip(narrow, bend, strict=True):
        form[place:], form[:, place:] = 0.0, 0.0
    return bend


def stretches(route: Transport, residuals: Residuals) -> np.ndarray:
    """Table of widths, shape (q, nodes, d): the data's share of each place's information as a noise scale goes."""
    stretch = np.zeros_like(route.stretch)
    followed = np.isin(route.free[route.noise], GEAR_SCALES, invert=True)
    for which, place in zip(np.flatnonzero(followed), route.noise[followed], strict=True):
        later = route.geometry[route.geometry > place]
        # All nodes in one call: a batch is as long whether it is full or not.
        at = np.zeros((len(STRETCH_NODES), 1 + len(later), route.dimension))
        at[:, :, place] = np.reshape(STRETCH_NODES, (-1, 1))
        at[:, 1:, later] += SHEAR_STEP * np.eye(len(later))
        seen = residuals(at.reshape(-1, route.dimension)).reshape(*at.shape[:2], -1)
        shares = np.sum(((seen[:, 1:] - seen[:, :1]) / SHEAR_STEP) ** 2, axis=2)
        change = shares - shares[STRETCH_NODES.index(0.0)]
        stretch[which][:, later] = -0.5 * np.log(np.clip(1 + change, *STRETCH_LIMITS))
    return stretch


def transport(fit: JointFit) -> Transport:
    """Measure the bend of the ridges at a fit's mode, and how the noise scales set the covariance.

    With r the standardised innovations and J their Jacobian in y, the narrow coordinate k has its optimum shifted by
    -y (J_k . d2r/dy2) y / 2: in y the Gauss-Newton Hessian is the identity. Second differences of r, all pairs in
    batches of the one compiled density.

    Args:
        fit: a converged fit.

    Returns:
        The map; the noise scales take no part in the shear.
    """
    route = unbent(fit)
    plain = route.straight()

    def residuals(y: np.ndarray) -> np.ndarray:
        def both(z: np.ndarray, still: np.ndarray) -> np.ndarray:
            found = evaluate(z, still, fit.space, fit.arrays)
            return np.concatenate([np.asarray(found.standardised).reshape(len(z), -1), found.places], axis=1)

        seen = in_batches(both, plain.from_whitened(y), no_draw(len(y), fit.arrays))
        return np.nan_to_num(np.asarray(seen))

    bend = bends(route, residuals)
    # Where the whole covariance follows the noise scales there is no table.
    return replace(route, bend=bend, stretch=route.stretch if len(route.constant) else stretches(route, residuals))
