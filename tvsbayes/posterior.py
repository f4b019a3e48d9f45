"""The posterior: sampled until it has converged, diagnosed, carried into any quantity, kept for ArviZ (DESIGN 4.3).

emcee samples in coordinates in which the posterior is nearly standard normal. Three layers: z, the prior-normal
coordinates of `tvsbayes.model`; y, whitened by the Laplace covariance; w, in which walkers live. Wide directions (laser
tilt, mirror errors) bend the ridges on which the narrow ones (extrinsics, ratios) lie: a shear moves each narrow
coordinate by a quadratic form of the wider ones. Noise scales widen and turn what they limit (a stop sd its ratio, the
backlash and their sums): in w everything else is measured from the mean and by the covariance that the linearised
campaign has at the noise scales of the walker. NumPy outside the compiled density.

Arrays of draws are ordered (chain, draw, ...); a chain is a walker. Units are those of DESIGN 8 (deg, mm, px).
Convergence is judged on the stored draws, so that what ArviZ computes from `posterior.nc` is what was judged.
"""

from __future__ import annotations

import hashlib
import io
import json
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path

import emcee
import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from arviz_stats.base import array_stats
from scipy import linalg, special

from tvsbayes.calibration import SIDES
from tvsbayes.campaign import input_hashes
from tvsbayes.classic import DIRECTIONS
from tvsbayes.files import InputError, NotConverged, escaped, read_arrays, write_atomically
from tvsbayes.joint import BACKLASHES, Derived, JointFit, derived_quantities, linear_spots
from tvsbayes.likelihood import (
    LinearSpots,
    evaluate,
    move_log_density,
    observe_with_stop_errors,
    ordered_spots,
    spot_constants,
)
from tvsbayes.model import INDEX, NAMES, NOISE_NAMES, half_normal, half_normal_slope
from tvsbayes.rigs import HARMONIC_PRIORS, HOME_SD_DEG, STEREO_PARAMETER_NAMES

BATCH = 32
"""Points per call of the compiled density: half an ensemble of 64, the calls of a differential-evolution step."""
BLOCK_ROWS = 256
"""Points that are mapped at a time: their matrices take 64 MB at most."""
WALKERS = 64
NARROW = 0.05
"""Conditional posterior sd, in prior sds, below which a coordinate is moved by the shear. Wider ones would be moved
far enough for cubic terms to matter."""
SHEAR_STEP = 0.5
"""Step of the second differences in posterior sds: the shear should hold over +-2 sd, not only at the mode."""
STATES_MAX = 64
"""Most stop errors for which the whole covariance follows the noise scales of every walker. With more stops its
matrices cost several times the density, the scales are known better, and widths from a table do."""
STRETCH_NODES = (-2.0, 0.0, 2.0, 4.0, 6.0)
"""Of that table, evenly spaced, in w of a noise coordinate. Below the first nothing gets narrower: other stops limit it
then."""
STRETCH_LIMITS = 1e-2, 1e2
"""Of the information of a coordinate, 1 at the mode."""
PILOT_DRAWS = 2048
PILOT_ROUNDS = 3
"""The first is drawn about the mode, each further one from the proposal that the last one gave."""
VARIANCE_RANGE, HEAVY_VARIANCE_RANGE = (0.8, 1.7), (0.8, 4.0)
"""Of the proposal, relative to the Laplace approximation's."""
HEAVY_DOF = 5.0
HEAVY_SHARE = 0.1
"""Share of the proposals from a multivariate t: it bounds the ratio target / proposal in the tails. In fifty
dimensions a t alone puts most draws off the shell where the target lives: effective draws fell threefold."""
HEAVY_NAMES = (*NOISE_NAMES, *BACKLASHES, "extrinsics.rotation_rad.y", "mirror_offset_mm")
"""Coordinates whose tails are heavier than normal: those that few stops tell (a walker stood still for 155 steps at 3.7
sd of a stop sd), and the tilt of the frames with the mirrors' offset, along whose ridge a quadratic shear falls short
(one stood at 7.7 sd). Each of them is always proposed from a t of its own."""
INFLATION = 1.03
"""Factor on the proposal's sds: a proposal lighter than the target lets walkers freeze in its tails."""
SHARES = (0.85, 0.1, 0.05)
"""Independence proposal, differential evolution, differential evolution with full steps."""


@dataclass(frozen=True)
class Conditional:
    """Geometry and cameras at given noise scales: w = factor' y - shift is standard normal.

    The factor (n, g, g) of the precision of y is lower triangular; shift (n, g) = factor' x the mean of y.
    """

    factor: np.ndarray
    shift: np.ndarray


@dataclass(frozen=True)
class Quadratic:
    """A normal density by its precision (n, g, g) and its slope at nought (n, g)."""

    precision: np.ndarray
    score: np.ndarray


@dataclass(frozen=True)
class Mapped:
    """Points z (n, p) and ln |dy/dw| there (n,)."""

    z: np.ndarray
    log_jacobian: np.ndarray


@dataclass(frozen=True)
class Transport:
    """The map w -> z; its Jacobian is |det root| exp(`Mapped.log_jacobian`).

    With stop errors e of variance S and pixels in units of their noise, the linearised residuals are r - J y - G e:
    the precision of y is then prior + J'J - J'G (S^-1 + G'G)^-1 G'J (Woodbury), at any noise scales from the same
    products. Beyond `STATES_MAX` stop errors (m = 0 here) only the widths follow, from a table for every scale.

    Attributes:
        mode: z at w = 0, shape (p,).
        free: columns of z that are sampled, (d,): widest conditional sd first; if m > 0, noise coordinates before all.
        root: lower-triangular factor of their covariance in that order, shape (d, d); if m > 0, of noise coordinates
            and others apart, whose mean at other scales follows from r.
        noise: places in `free` of the noise coordinates, shape (q,).
        narrow: places in `free` that the shear moves, ascending, shape (k,).
        bend: its quadratic forms, nonzero only among places before the narrow one, shape (k, d, d).
        stretch: if m is 0, log of the factor on every place at `STRETCH_NODES` of each noise coordinate, (q, nodes, d).
        slope: ln of the noise scales over those at the mode, by w of the noise coordinates, shape (q, q).
        pixels: 1 at the noise coordinate that scales all pixels, shape (q,).
        variance: of every stop error at the mode, by the noise coordinate that scales it, shape (m, q).
        constant: what scales with none, shape (m,).
        prior: precision of y of the g other coordinates without data, shape (g, g).
        known: J'J, what the data add if no stop errs, shape (g, g).
        load: J'G, shape (g, m).
        states: G'G, shape (m, m).
        score, state_score: J'r, shape (g,), and G'r, shape (m,).
    """

    mode: np.ndarray
    free: np.ndarray
    root: np.ndarray
    noise: np.ndarray
    narrow: np.ndarray
    bend: np.ndarray
    stretch: np.ndarray
    slope: np.ndarray
    pixels: np.ndarray
    variance: np.ndarray
    constant: np.ndarray
    prior: np.ndarray
    known: np.ndarray
    load: np.ndarray
    states: np.ndarray
    score: np.ndarray
    state_score: np.ndarray

    @property
    def dimension(self) -> int:
        """Number of sampled coordinates."""
        return len(self.free)

    @property
    def heavy(self) -> np.ndarray:
        """Coordinates of `HEAVY_NAMES`, shape (d,)."""
        return np.isin(np.array(NAMES)[self.free], HEAVY_NAMES)

    def straight(self) -> Transport:
        """The same without shear, and with the covariance of the mode everywhere: the Laplace approximation."""
        return replace(
            self,
            narrow=self.narrow[:0],
            bend=self.bend[:0],
            stretch=np.zeros_like(self.stretch),
            variance=self.variance[:0],
            constant=self.constant[:0],
            load=self.load[:, :0],
            states=self.states[:0, :0],
            state_score=self.state_score[:0],
        )

    @cached_property
    def curved(self) -> np.ndarray:
        """Places in `free` of coordinates whose physical value is no linear function of z over a posterior's width."""
        return np.flatnonzero(np.isin(np.array(NAMES)[self.free], BACKLASHES))

    def _beyond_linear(self, place: int, step: np.ndarray) -> np.ndarray:
        """What steps of the z at a place (n,) move its physical value beyond the line at the mode, in units of z."""
        at = self.mode[self.free[place]]
        return (half_normal(at + step) - half_normal(at)) / half_normal_slope(at) - step

    def _follow(self, place: int) -> np.ndarray:
        """How far the places behind one follow a unit step of its z, shape (d - place - 1,)."""
        return self.root[place + 1 :, place] / self.root[place, place]

    def from_whitened(self, y: np.ndarray) -> np.ndarray:
        """From y (n, d) to z (n, p).

        What follows a backlash follows its degrees, not its z: along a ridge as wide as the prior the line in z is
        wrong by more than a ratio's width. Each place moves later ones only: no volume changes.
        """
        step = y @ self.root.T
        for place in self.curved:
            step[:, place + 1 :] += self._beyond_linear(place, step[:, place])[:, None] * self._follow(place)
        z = np.repeat(self.mode[None], len(y), axis=0)
        z[:, self.free] += step
        return z

    def _quadratic(self, noise: np.ndarray) -> Quadratic:
        """What the linearised campaign and the prior say of y at noise coordinates (n, q)."""
        log_scale = noise @ self.slope.T
        weight = np.exp(-2 * log_scale @ self.pixels)[:, None, None]
        inner = weight * self.states
        own = np.arange(len(self.states))
        inner[:, own, own] += 1 / (np.exp(2 * log_scale) @ self.variance.T + self.constant)
        right = np.column_stack([self.load.T, self.state_score])
        solved = weight * np.linalg.solve(inner, np.broadcast_to(right, (len(noise), *right.shape)))
        explained = weight * (self.load @ solved)
        precision = self.prior + weight * self.known - explained[..., :-1]
        return Quadratic(precision, weight[..., 0] * self.score - explained[..., -1])

    def _log_width(self, noise: np.ndarray) -> np.ndarray:
        """From the table, at noise coordinates (n, q), shape (n, d): lines between the nodes and above the last."""
        first, second = STRETCH_NODES[:2]
        at = (np.maximum(noise, first) - first) / (second - first)
        node = np.minimum(at.astype(int), len(STRETCH_NODES) - 2)
        which = np.arange(len(self.noise))
        low, high = self.stretch[which, node], self.stretch[which, node + 1]
        return np.sum(low + (at - node)[..., None] * (high - low), axis=-2)

    @cached_property
    def _score_at_mode(self) -> np.ndarray:
        return self._quadratic(np.zeros((1, len(self.noise)))).score

    def conditional(self, noise: np.ndarray) -> Conditional:
        """The normal density of y at noise coordinates (n, q), its mean at the mode where the scales are those.

        Without stop errors there is none: see `stretch`.
        """
        found = self._quadratic(noise)
        factor = np.linalg.cholesky(found.precision)
        shift = np.linalg.solve(factor, (found.score - self._score_at_mode)[..., None])[..., 0]
        return Conditional(factor, shift)

    def mapped(self, w: np.ndarray) -> Mapped:
        """From w (n, d) to z with the Jacobian; noise coordinates are the same in w and y, the shear keeps volumes."""
        blocks = [self._mapped(block) for block in np.split(w, range(BLOCK_ROWS, len(w), BLOCK_ROWS))]
        return Mapped(*(np.concatenate([getattr(b, f.name) for b in blocks]) for f in fields(Mapped)))

    def _mapped(self, w: np.ndarray) -> Mapped:
        count = len(self.noise)
        noise, y = w[:, self.noise], w.copy()
        if len(self.states):
            found = self.conditional(noise)
            straight = (w[:, count:] + found.shift)[..., None]
            y[:, count:] = np.linalg.solve(np.swapaxes(found.factor, 1, 2), straight)[..., 0]
            log_jacobian = -np.log(np.diagonal(found.factor, axis1=1, axis2=2)).sum(axis=1)
        else:
            log_width = self._log_width(noise)
            y *= np.exp(log_width)
            log_jacobian = log_width.sum(axis=1)
        for place, form in zip(self.narrow, self.bend, strict=True):
            before = y[:, :place]
            y[:, place] -= 0.5 * np.sum((before @ form[:place, :place]) * before, axis=1)
        return Mapped(self.from_whitened(y), log_jacobian)

    def to_w(self, z: np.ndarray) -> np.ndarray:
        """From z (n, p) to w (n, d); the inverse of `mapped` on the sampled columns."""
        step = (z - self.mode)[:, self.free]
        linear = step.copy()
        for place in self.curved:
            linear[:, place + 1 :] -= self._beyond_linear(place, step[:, place])[:, None] * self._follow(place)
        y = np.linalg.solve(self.root, linear.T).T
        straight = y.copy()
        for place, form in zip(self.narrow, self.bend, strict=True):
            before = y[:, :place]
            straight[:, place] += 0.5 * np.sum((before @ form[:place, :place]) * before, axis=1)
        # Noise coordinates are neither bent nor turned nor stretched: they are known before anything is undone.
        count = len(self.noise)
        noise = straight[:, self.noise]
        if len(self.states):
            found = self.conditional(noise)
            turned = np.swapaxes(found.factor, 1, 2) @ straight[:, count:, None]
            straight[:, count:] = turned[..., 0] - found.shift
        else:
            straight *= np.exp(-self._log_width(noise))
        return straight


def in_batches(function: Callable[[np.ndarray], object], points: np.ndarray, size: int = BATCH) -> object:
    """Call a compiled function on blocks of one size and join the results along the first axis.

    The last block is filled up with its last row, so that nothing is compiled for a rest.
    """
    blocks = []
    for start in range(0, len(points), size):
        block = points[start : start + size]
        count = len(block)
        if count < size:
            block = np.concatenate([block, np.repeat(block[-1:], size - count, axis=0)])
        result = function(jnp.asarray(block))
        blocks.append(jax.tree.map(lambda x, n=count: np.asarray(x)[:n], result))
    return jax.tree.map(lambda *parts: np.concatenate(parts), *blocks)


def by_width(covariance: np.ndarray) -> np.ndarray:
    """Order of the coordinates in which each has the largest variance left by those before it."""
    rest, order = covariance.copy(), []
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
    sd_deg = fit.mode.physical[[INDEX[f"stop_sd_deg.{name}"] for axis in SIDES for name in SIDES[axis]]]
    variance_of = np.radians(sd_deg).reshape(2, 2) ** 2
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
    names = np.array(NAMES)
    linear = linear_spots(fit.linearised, fit.arrays, -fit.linearised.residual_jacobian)
    stops = stop_states(fit, linear)
    whole = len(stops.constant) > 0
    free = np.flatnonzero(fit.free)
    scales = np.isin(names[free], NOISE_NAMES)
    if whole:
        others = free[~scales]
        covariance = np.linalg.inv(np.eye(len(others)) + fit.information.fisher[np.ix_(others, others)])
        order = by_width(covariance)
        free = np.concatenate([free[scales], others[order]])
        root = linalg.block_diag(
            np.linalg.cholesky(fit.covariance[np.ix_(free[: scales.sum()], free[: scales.sum()])]),
            np.linalg.cholesky(covariance[np.ix_(order, order)]),
        )
    else:
        free = free[by_width(fit.covariance[np.ix_(free, free)])]
        root = np.linalg.cholesky(fit.covariance[np.ix_(free, free)])
    scales = np.isin(names[free], NOISE_NAMES)
    noise, geometry = np.flatnonzero(scales), np.flatnonzero(~scales)
    narrow = np.flatnonzero((np.diag(root) < NARROW) & ~scales)
    wide = root[np.ix_(geometry, geometry)]
    jacobian = linear.jacobian.reshape(-1, len(names))[:, free[geometry]] @ wide
    residual = linear.residual.ravel()
    directions = [f"stop_sd_deg.{name}" for axis in SIDES for name in SIDES[axis]]
    of_noise = np.array([[name == names[free[place]] for place in noise] for name in directions]).reshape(4, -1)
    count = len(free)
    route = Transport(
        mode=fit.z,
        free=free,
        root=root,
        noise=noise,
        narrow=narrow,
        bend=np.zeros((len(narrow), count, count)),
        stretch=np.zeros((len(noise), len(STRETCH_NODES), count)),
        slope=np.asarray(fit.space.u)[free[noise]][:, None] * root[np.ix_(noise, noise)],
        pixels=(names[free[noise]] == "pixel_scale").astype(float),
        variance=stops.variance @ of_noise,
        # Stop errors whose sd is not estimated keep their variance.
        constant=stops.constant + stops.variance @ ~of_noise.any(axis=1),
        prior=wide.T @ wide,
        known=jacobian.T @ jacobian,
        load=jacobian.T @ stops.load,
        states=stops.load.T @ stops.load,
        score=jacobian.T @ residual,
        state_score=stops.load.T @ residual,
    )
    plain = route.straight()

    def residuals(y: np.ndarray) -> np.ndarray:
        seen = in_batches(lambda z: evaluate(z, fit.space, fit.arrays).standardised, plain.from_whitened(y))
        return np.nan_to_num(seen.reshape(len(y), -1))

    bend, stretch = route.bend, route.stretch
    with jax.enable_x64(True):
        steps = SHEAR_STEP * np.eye(count)
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
        # The data's share of the information 1 of each coordinate, as a noise coordinate goes up or down.
        for which, place in enumerate(noise if not whole else ()):
            later = geometry[geometry > place]
            shares = []
            for node in STRETCH_NODES:
                at = np.zeros((1 + len(later), count))
                at[:, place] = node
                at[1:, later] += SHEAR_STEP * np.eye(len(later))
                seen = residuals(at)
                shares.append(np.sum(((seen[1:] - seen[0]) / SHEAR_STEP) ** 2, axis=1))
            change = np.array(shares) - shares[STRETCH_NODES.index(0.0)]
            stretch[which][:, later] = -0.5 * np.log(np.clip(1 + change, *STRETCH_LIMITS))
    for place, form in zip(narrow, bend, strict=True):
        form[place:], form[:, place:] = 0.0, 0.0
    return route


class Target:
    """The log posterior density of walkers, as emcee calls it: NumPy in, NumPy out, NaN refused and counted."""

    def __init__(self, fit: JointFit, path: Transport):
        self.fit, self.path = fit, path
        self.invalid = 0

    def __call__(self, w: np.ndarray) -> np.ndarray:
        """Log density of w (n, d), relative to z's at the mode; -inf where the model has no value."""
        found = self.path.mapped(w)
        value = in_batches(lambda block: evaluate(block, self.fit.space, self.fit.arrays).log_density, found.z)
        invalid = np.isnan(value)
        self.invalid += int(invalid.sum())
        return np.where(invalid, -np.inf, value - self.fit.log_density + found.log_jacobian)


def _t_constant(dimension: int) -> float:
    """Log of the normalisation of a multivariate t with `HEAVY_DOF` degrees of freedom and unit scale."""
    value = special.gammaln(0.5 * (HEAVY_DOF + dimension)) - special.gammaln(0.5 * HEAVY_DOF)
    return float(value - 0.5 * dimension * np.log(HEAVY_DOF * np.pi))


@dataclass(frozen=True)
class Independence:
    """Independence proposal: normal, in heavy coordinates t, and a share of a multivariate t of the same scale.

    Called by `emcee.moves.MHMove` with (points, generator); returns new points and ln q(old) - ln q(new).

    Attributes:
        mean, sd: of every coordinate, shape (d,).
        heavy: coordinates proposed from a t of their own, shape (d,), boolean.
    """

    mean: np.ndarray
    sd: np.ndarray
    heavy: np.ndarray

    def log_density(self, w: np.ndarray) -> np.ndarray:
        """Log density, shape (n,)."""
        dimension = len(self.mean)
        distance2 = ((w - self.mean) / self.sd) ** 2
        normal = -0.5 * np.log(2 * np.pi) - 0.5 * distance2
        single = _t_constant(1) - 0.5 * (HEAVY_DOF + 1) * np.log1p(distance2 / HEAVY_DOF)
        each = np.sum(np.where(self.heavy, single, normal), axis=1)
        total2 = np.sum(distance2, axis=1)
        joint = _t_constant(dimension) - 0.5 * (HEAVY_DOF + dimension) * np.log1p(total2 / HEAVY_DOF)
        mixture = np.logaddexp(np.log(1 - HEAVY_SHARE) + each, np.log(HEAVY_SHARE) + joint)
        return mixture - np.sum(np.log(self.sd))

    def draw(self, count: int, generator: np.random.RandomState) -> np.ndarray:
        """Independent draws, shape (count, d)."""
        dimension = len(self.mean)
        normal = generator.standard_normal((count, dimension))
        single = np.sqrt(generator.chisquare(HEAVY_DOF, (count, dimension)) / HEAVY_DOF)
        joint = np.sqrt(generator.chisquare(HEAVY_DOF, (count, 1)) / HEAVY_DOF)
        together = generator.uniform(size=(count, 1)) < HEAVY_SHARE
        return self.mean + self.sd * normal / np.where(together, joint, np.where(self.heavy, single, 1.0))

    def __call__(self, w: np.ndarray, generator: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """The protocol of `emcee.moves.MHMove`."""
        proposed = self.draw(len(w), generator)
        return proposed, self.log_density(w) - self.log_density(proposed)


def moves(proposal: Independence) -> list[tuple[emcee.moves.Move, float]]:
    """The moves and their shares; never emcee 3.1.6's snooker or full-covariance Gaussian (both are biased)."""
    # Fewer walkers than twice the dimension let differential evolution explore a subspace only; the
    # independence proposal leaves it at six steps of seven.
    evolution = emcee.moves.DEMove(live_dangerously=True), emcee.moves.DEMove(gamma0=1.0, live_dangerously=True)
    return list(zip((emcee.moves.MHMove(proposal), *evolution), SHARES, strict=True))


def walkers_for(dimension: int) -> int:
    """Ensemble size: more walkers than dimensions, whole batches in each half."""
    return max(WALKERS, 2 * BATCH * -(-(dimension + 1) // (2 * BATCH)))


@dataclass(frozen=True)
class Pilot:
    """What importance sampling from the transported Laplace approximation tells before the chain starts.

    Attributes:
        proposal: centred where the posterior's mean is, which is not its mode.
        start: first positions, importance-resampled, shape (walkers, d).
        log_weights: log (target / proposal) of the last round's draws.
    """

    proposal: Independence
    start: np.ndarray
    log_weights: np.ndarray


def pilot(target: Target, seed: int) -> Pilot:
    """Shift the proposal to the posterior mean and choose starting points.

    Args:
        target: the log density.
        seed: of the pilot draws.

    Raises:
        FloatingPointError: no draw has a finite density.
    """
    generator = np.random.RandomState(seed)
    dimension = target.path.dimension
    heavy = target.path.heavy
    proposal = Independence(np.zeros(dimension), np.ones(dimension), heavy)
    limits = np.where(heavy, np.array(HEAVY_VARIANCE_RANGE)[:, None], np.array(VARIANCE_RANGE)[:, None])
    for _ in range(PILOT_ROUNDS):
        w = proposal.draw(PILOT_DRAWS, generator)
        log_target = target(w)
        log_weights = log_target - proposal.log_density(w)
        finite = np.isfinite(log_weights)
        if finite.sum() < walkers_for(dimension):
            raise FloatingPointError("the posterior density is not finite around the mode")
        # Where the target is normal, log(target / normal of the proposal) is linear in w and w^2: the coefficients give
        # its mean and sds. A regression on the draws that matter is far steadier than weighted moments.
        matters = finite & (log_weights > np.max(log_weights[finite]) - 12)
        if matters.sum() <= 8 * dimension:
            break
        near = (w[matters] - proposal.mean) / proposal.sd
        design = np.column_stack([np.ones(len(near)), near, near**2])
        ratio = log_target[matters] + 0.5 * np.sum(near**2, axis=1)
        slope, square = np.split(np.linalg.lstsq(design, ratio, rcond=None)[0][1:], 2)
        variance = 1 / np.clip(1 - 2 * square, 0.6, 1.6)
        mean = proposal.mean + proposal.sd * np.clip(slope * variance, -1.0, 1.0)
        variance = np.clip(proposal.sd**2 * variance, *limits)
        proposal = Independence(mean, INFLATION * np.sqrt(variance), heavy)
    # Gumbel's trick: the largest perturbed weights are a weighted sample without replacement.
    keys = np.where(finite, log_weights, -np.inf) + generator.gumbel(size=len(w))
    start = w[np.argsort(-keys)[: walkers_for(dimension)]]
    return Pilot(proposal, start, log_weights)


CHAIN_FORMAT = "tvsbayes-chain/4"
CHAIN_BYTES_MAX = 2**32
"""A chain is the user's own file: what was in memory when it was written fits there again."""
POSTERIOR_FORMAT = "tvsbayes-posterior/1"
PIXELS = ("u_left", "v_left", "u_right", "v_right")
RHAT_LIMIT = 1.01
ESS_LIMIT = 1000
TAU_LIMIT = 50
"""Limits of DESIGN 4.3: rank R-hat by walker, bulk and tail effective draws, steps in autocorrelation times."""
STUCK_ACCEPTANCE = 0.25
"""A walker is stuck that accepts less than this share of what the median walker accepts ..."""
STUCK_DEVIATION = 8.0
"""... or whose mean log density lies this many median absolute deviations, and a standard deviation of a single draw,
off the others': the means of long chains spread so little that one rare excursion would fail the first alone."""
FIRST_CHECK = 300
GROWTH = 1.3
"""Steps at the first look at convergence, and growth of the chain from one look to the next."""
BLOCK = 50
CHECKPOINT_SECONDS = 20.0
STORED_DRAWS = 256
"""Draws stored per walker: from this many to twice as many. R-hat by walker needs about 150 effective draws of each."""
DERIVED_BATCH = 2049
"""The batch in which the fit computes its headlines: the compilation is shared."""


@dataclass(frozen=True)
class Convergence:
    """Whether a chain may be used, and why not.

    Attributes:
        steps: length of the chain; discarded: first steps left out; thin: one in so many is stored.
        tau_steps: longest integrated autocorrelation time.
        rhat, ess_bulk, ess_tail: by contract name, of every sampled or derived quantity.
        acceptance: share of accepted moves by walker.
        stuck_walkers: walkers that hardly moved or live at another density.
        invalid: evaluations that gave no number.
        pareto_k: tail index of target / proposal in the last pilot draws; above 0.7 the proposal is a poor guide.
        missing: sentences on what is not reached; empty when converged.
    """

    steps: int
    discarded: int
    thin: int
    tau_steps: float
    rhat: dict[str, float]
    ess_bulk: dict[str, float]
    ess_tail: dict[str, float]
    acceptance: np.ndarray
    stuck_walkers: tuple[int, ...]
    invalid: int
    pareto_k: float
    missing: tuple[str, ...]

    @property
    def converged(self) -> bool:
        """All limits of DESIGN 4.3 are met."""
        return not self.missing

    def as_json(self) -> dict[str, object]:
        """For fit.json, key `sampling`."""
        worst = max(self.rhat, key=self.rhat.get)
        fewest = min(self.ess_bulk, key=self.ess_bulk.get)
        tail = min(self.ess_tail, key=self.ess_tail.get)
        return {
            "converged": self.converged,
            "missing": list(self.missing),
            "walkers": len(self.acceptance),
            "steps": self.steps,
            "discarded": self.discarded,
            "thin": self.thin,
            "tau_steps": self.tau_steps,
            "worst_rhat": {"quantity": worst, "value": self.rhat[worst]},
            "least_ess_bulk": {"quantity": fewest, "value": self.ess_bulk[fewest]},
            "least_ess_tail": {"quantity": tail, "value": self.ess_tail[tail]},
            "acceptance": float(self.acceptance.mean()),
            "least_acceptance": float(self.acceptance.min()),
            "stuck_walkers": list(self.stuck_walkers),
            "invalid_evaluations": self.invalid,
            "proposal_pareto_k": self.pareto_k,
        }


@dataclass(frozen=True)
class Progress:
    """What a progress display shows.

    `worst_ess` is None before the first check; seconds since the start, and left until the next check.
    """

    steps: int
    expected_steps: int
    worst_ess: float | None
    seconds: float
    seconds_left: float


class Draws(Mapping[str, np.ndarray]):
    """Posterior draws by name: every parameter of DESIGN 8, and derived quantities, each of shape (n,).

    Derived: `degrees_per_step.left|right|up|down`, `effective_deg_per_step.left|right|up|down`,
    `effective_contrast_deg_per_step.pan|tilt` (left - right, up - down), `effective_mirror_offset_mm`.
    """

    def __init__(self, draws: Derived):
        physical = draws.physical.reshape(-1, draws.physical.shape[-1])
        self._columns = dict(zip(NAMES, physical.T, strict=True))
        for axis, positive, negative in (("pan", "left", "right"), ("tilt", "up", "down")):
            ratio, half = (
                self._columns[f"degrees_per_step.{axis}"],
                self._columns[f"ratio_contrast_deg_per_step.{axis}"] / 2,
            )
            self._columns[f"degrees_per_step.{positive}"] = ratio + half
            self._columns[f"degrees_per_step.{negative}"] = ratio - half
        effective = draws.effective_deg_per_step.reshape(-1, len(DIRECTIONS))
        self._columns |= {f"effective_deg_per_step.{d}": effective[:, k] for k, d in enumerate(DIRECTIONS)}
        for axis, first in (("pan", 0), ("tilt", 2)):
            self._columns[f"effective_contrast_deg_per_step.{axis}"] = effective[:, first] - effective[:, first + 1]
        self._columns["effective_mirror_offset_mm"] = draws.effective_mirror_offset_mm.ravel()

    def __getitem__(self, name: str) -> np.ndarray:
        """Draws of one quantity."""
        if name not in self._columns:
            raise KeyError(f"no quantity {name!r}; there are: {', '.join(self._columns)}")
        return self._columns[name]

    def __iter__(self) -> Iterator[str]:
        """Names."""
        return iter(self._columns)

    def __len__(self) -> int:
        """Number of quantities."""
        return len(self._columns)


@dataclass(frozen=True)
class Propagated:
    """A quantity under the posterior; every field has the quantity's own shape.

    Attributes:
        mean, sd: of the posterior.
        interval95: equal-tailed, first axis (low, high).
        mcse_mean, mcse_sd, mcse_interval95: Monte Carlo standard errors of the above.
        ess: bulk effective draws behind them.
        draws: the values, shape (chain, draw, ...).
    """

    mean: np.ndarray
    sd: np.ndarray
    interval95: np.ndarray
    mcse_mean: np.ndarray
    mcse_sd: np.ndarray
    mcse_interval95: np.ndarray
    ess: np.ndarray
    draws: np.ndarray


@dataclass(frozen=True)
class Posterior:
    """A sampled posterior; look at `converged` before using it.

    Attributes:
        fit: the fit whose posterior it is.
        z: stored draws of the prior-normal coordinates, shape (chain, draw, p).
        log_density: their log posterior density, without `likelihood.log_constant`, shape (chain, draw).
        draws: parameters and headlines in the units of DESIGN 8, fields with leading axes (chain, draw).
        convergence: the diagnosis.
        seed: of the chain.
        seconds: spent sampling, earlier runs of a resumed chain included.
    """

    fit: JointFit
    z: np.ndarray
    log_density: np.ndarray
    draws: Derived
    convergence: Convergence
    seed: int
    seconds: float

    @property
    def converged(self) -> bool:
        """All limits of DESIGN 4.3 are met."""
        return self.convergence.converged

    @property
    def by_name(self) -> Draws:
        """All draws by contract name, chains joined."""
        return Draws(self.draws)

    def thinned(self, count: int) -> Derived:
        """At most `count` evenly chosen draws, chains joined: every field with one leading axis."""
        total = self.z.shape[0] * self.z.shape[1]
        chosen = np.linspace(0, total - 1, min(count, total)).astype(int)
        return jax.tree.map(lambda x: x.reshape(total, *x.shape[2:])[chosen], self.draws)

    def propagate(self, function: Callable[[Draws], np.ndarray]) -> Propagated:
        """Carry the posterior into a quantity of your own.

        Args:
            function: is called once with all draws, a mapping from name to an array (n,) in the unit that the name
                says, and returns one value per draw: an array (n,) or (n, ...). For instance what 200 steps to the
                left turn after a reversal, deg: `lambda p: 200 * p["degrees_per_step.left"] - p["backlash_deg.pan"]`.
                The names are those of `fit.json` and of `list(posterior.by_name)`.

        Returns:
            Mean, sd, interval and their Monte Carlo errors (JCGM 101 clause 7, with correlated draws), each of the
            shape (...) of one value.

        Raises:
            ValueError: the function returned another number of rows, or values that are not finite.
        """
        values = np.asarray(function(self.by_name), dtype=float)
        chains, draws = self.z.shape[:2]
        if values.ndim == 0 or len(values) != chains * draws:
            raise ValueError(
                f"the function returned shape {values.shape}; its first axis must be the {chains * draws} draws it was "
                "given: compute with whole arrays, not with their means"
            )
        if not np.all(np.isfinite(values)):
            share = np.mean(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))
            raise ValueError(f"the function has no finite value for {100 * share:.2g} % of the draws")
        return propagated(values.reshape(chains, draws, *values.shape[1:]))

    def effective_deg_per_step(self, pan_deg: float, tilt_deg: float) -> Propagated:
        """Effective degrees per step (left, right, up, down) at any pose of the mirrors (DESIGN 3.2)."""
        with jax.enable_x64(True):
            return propagated(derived_at(self.fit, self.z, np.radians([pan_deg, tilt_deg])).effective_deg_per_step)

    def lost_motion_deg(self, direction: str, steps: np.ndarray) -> Propagated:
        """Mirror angle that a move of `steps` loses after a reversal: min(k N, b) (play operator, DESIGN 3.1).

        Args:
            direction: left, right, up or down.
            steps: numbers of steps N >= 0, shape (n,).

        Returns:
            Fields of shape (n,), deg; divided by N it is what a four-point estimate is short by.
        """
        if direction not in DIRECTIONS:
            raise ValueError(f"direction {direction!r}; allowed: {', '.join(DIRECTIONS)}")
        axis = "pan" if direction in ("left", "right") else "tilt"
        count = np.atleast_1d(np.asarray(steps, dtype=float))
        return self.propagate(
            lambda p: np.minimum(
                np.multiply.outer(p[f"degrees_per_step.{direction}"], count), p[f"backlash_deg.{axis}"][:, None]
            )
        )


@dataclass(frozen=True)
class Variable:
    """A variable of posterior.nc: its dimensions beyond (chain, draw) and the contract names behind it."""

    dims: tuple[str, ...]
    names: np.ndarray


def _variable(dims: tuple[str, ...], pattern: str) -> Variable:
    """Fill `{}` in a pattern with the coordinates of the dimensions."""
    shape = tuple(len(COORDS[dim]) for dim in dims)
    names = [pattern.format(*(COORDS[d][i] for d, i in zip(dims, index, strict=True))) for index in np.ndindex(shape)]
    return Variable(dims, np.array(names).reshape(shape))


COORDS: dict[str, tuple[str, ...]] = {
    "direction": DIRECTIONS,
    "axis": ("pan", "tilt"),
    "laser_axis": ("x", "y"),
    "tilt_axis_component": ("x", "z"),
    "component": ("x", "y", "z"),
    "harmonic": tuple(name.removeprefix("harmonic_deg.") for name in HARMONIC_PRIORS),
    "stereo_parameter": tuple(name.removeprefix("stereo.") for name in STEREO_PARAMETER_NAMES),
}
VARIABLES: dict[str, Variable] = {
    "effective_deg_per_step": _variable(("direction",), "effective_deg_per_step.{}"),
    "degrees_per_step": _variable(("direction",), "degrees_per_step.{}"),
    "mean_degrees_per_step": _variable(("axis",), "degrees_per_step.{}"),
    "ratio_contrast_deg_per_step": _variable(("axis",), "ratio_contrast_deg_per_step.{}"),
    "backlash_deg": _variable(("axis",), "backlash_deg.{}"),
    "effective_mirror_offset_mm": _variable((), "effective_mirror_offset_mm"),
    **{
        name: _variable((), name)
        for name in (
            *("mirror_offset_mm", "tilt_zero_deg", "mirror1_error_deg", "mirror2_error_deg", "tilt_axis_skew_deg"),
            *("pixel_scale", "focal_scale", "baseline_mm", "pan_zero_emission_deg"),
            *("aperture_zero_deg", "aperture_sd_deg"),
        )
    },
    "laser_tilt_deg": _variable(("laser_axis",), "laser_tilt_deg.{}"),
    "laser_offset_mm": _variable(("laser_axis",), "laser_offset_mm.{}"),
    "tilt_axis_offset_mm": _variable(("tilt_axis_component",), "tilt_axis_offset_mm.{}"),
    "extrinsics_rotation_rad": _variable(("component",), "extrinsics.rotation_rad.{}"),
    "extrinsics_translation_mm": _variable(("component",), "extrinsics.translation_mm.{}"),
    "stop_sd_deg": _variable(("direction",), "stop_sd_deg.{}"),
    "harmonic_deg": _variable(("harmonic",), "harmonic_deg.{}"),
    "stereo": _variable(("stereo_parameter",), "stereo.{}"),
}
"""Variables of posterior.nc. `degrees_per_step` by direction; the mean ratio of an axis is `mean_degrees_per_step`."""


def _variables(draws: Derived, varying: set[str], shape: tuple[int, int]) -> dict[str, xr.DataArray]:
    """All variables that vary, with named dimensions; fixed entries of a dimension are left out."""
    columns = Draws(draws)
    result = {}
    for variable, spec in VARIABLES.items():
        chosen = np.array([name in varying for name in spec.names.ravel()])
        if not chosen.any():
            continue
        values = np.stack([columns[name] for name in spec.names.ravel()[chosen]], axis=-1)
        if spec.dims:
            labels = [label for label, yes in zip(COORDS[spec.dims[0]], chosen, strict=True) if yes]
            coords = {"chain": np.arange(shape[0]), "draw": np.arange(shape[1]), spec.dims[0]: labels}
            result[variable] = xr.DataArray(values.reshape(*shape, -1), coords, ("chain", "draw", *spec.dims))
        else:
            coords = {"chain": np.arange(shape[0]), "draw": np.arange(shape[1])}
            result[variable] = xr.DataArray(values.reshape(shape), coords, ("chain", "draw"))
    return result


def _dataset(variables: Mapping[str, xr.DataArray]) -> xr.Dataset:
    """Join variables; a coordinate of which some have fewer entries is kept apart under the variable's name."""
    full = {}
    for name, array in variables.items():
        for dim in array.dims[2:]:
            if array.sizes[dim] < len(COORDS.get(dim, ())):
                array = array.rename({dim: f"{name}_{dim}"})
        full[name] = array
    return xr.Dataset(full)


def move_log_likelihood(posterior: Posterior) -> xr.DataArray:
    """Log p(spots of a move | all other spots, parameters), dimensions (chain, draw, move); constants included."""
    fit = posterior.fit
    spots = ordered_spots(fit.campaign)
    used = np.asarray(fit.arrays.spots.valid)[: len(spots)] > 0
    z = posterior.z.reshape(-1, posterior.z.shape[-1])
    with jax.enable_x64(True):
        by_spot = in_batches(lambda block: move_log_density(block, fit.space, fit.arrays), z)[:, : len(spots)]
    by_spot = by_spot + spot_constants(fit.campaign)
    index = np.array([spot.move for spot in spots])
    moves_seen = np.unique(index[used])
    values = np.stack([by_spot[:, used & (index == move)].sum(axis=1) for move in moves_seen], axis=1)
    chains, draws = posterior.z.shape[:2]
    coords = {"chain": np.arange(chains), "draw": np.arange(draws), "move": moves_seen}
    return xr.DataArray(values.reshape(chains, draws, -1), coords, ("chain", "draw", "move"))


def looks(fit: JointFit, z: np.ndarray, stop_error_rad: np.ndarray) -> np.ndarray:
    """Noiseless pixels of all ordered spots, shape (draws, spots, 4), for coordinates (draws, p)."""
    count, blocks = len(ordered_spots(fit.campaign)), []
    with jax.enable_x64(True):
        for start in range(0, len(z), BATCH):
            rows = np.arange(len(z))[start : start + BATCH]
            filled = np.resize(rows, BATCH)
            seen = observe_with_stop_errors(
                jnp.asarray(z[filled]), jnp.asarray(stop_error_rad[filled]), fit.space, fit.arrays
            )
            blocks.append(np.asarray(seen)[: len(rows), :count, :4])
    return np.concatenate(blocks)


def ideal_pixels(posterior: Posterior, draws: int) -> np.ndarray:
    """Pixels without noise and stop errors for evenly chosen draws, shape (draws, spots, 4)."""
    z = posterior.z.reshape(-1, posterior.z.shape[-1])
    chosen = z[np.linspace(0, len(z) - 1, draws).astype(int)]
    return looks(posterior.fit, chosen, np.zeros((draws, len(posterior.fit.arrays.spots.valid), 2)))


def predictive_pixels(posterior: Posterior, draws_per_chain: int = 8) -> xr.DataArray:
    """The same looks taken again: stop errors, home offsets, play and pixel noise drawn anew, ranges as observed.

    Returns:
        Dimensions (chain, draw, spot, pixel); the draws are a subset of the posterior's, by its own coordinate.
    """
    fit = posterior.fit
    generator = np.random.default_rng([posterior.seed, 1])
    chains, draws = posterior.z.shape[:2]
    chosen = np.unique(np.linspace(0, draws - 1, min(draws_per_chain, draws)).astype(int))
    z = posterior.z[:, chosen].reshape(-1, posterior.z.shape[-1])
    physical = posterior.draws.physical[:, chosen].reshape(len(z), -1)
    values = looks_again(fit, z, physical, generator).reshape(chains, len(chosen), -1, 4)
    spots = [spot.spot for spot in ordered_spots(fit.campaign)]
    coords = {"chain": np.arange(chains), "draw": chosen, "spot": spots, "pixel": list(PIXELS)}
    return xr.DataArray(values.astype(np.float32), coords, ("chain", "draw", "spot", "pixel"))


def looks_again(fit: JointFit, z: np.ndarray, physical: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Pixels (draws, spots, 4) of the same looks taken again at coordinates z (draws, p) with values `physical`.

    Stop errors, home offsets, place in the play and pixel noise are drawn anew; ranges are those observed.
    """
    count = len(ordered_spots(fit.campaign))
    arrays = jax.tree.map(np.asarray, fit.arrays.spots)
    sd_deg = physical[:, [INDEX[f"stop_sd_deg.{d}"] for d in DIRECTIONS]]
    # Per axis (right, left) and (down, up), as `redraw_mix` orders them.
    sd_rad = np.radians(sd_deg.reshape(len(z), 2, 2)[..., ::-1])
    variance = np.sum(arrays.redraw_mix[None] * sd_rad[:, None] ** 2, axis=3)
    fresh = np.sqrt(variance) * generator.standard_normal(variance.shape)
    size = len(arrays.valid)
    rows = np.arange(size)[:, None]
    error = np.take_along_axis(fresh, np.maximum.accumulate(np.where(arrays.redraw, rows, 0), axis=0)[None], axis=1)
    home = np.radians(HOME_SD_DEG) * generator.standard_normal((len(z), size, 2)) * arrays.homed[:, None]
    segment = np.maximum.accumulate(np.where(arrays.new_segment, np.arange(size), 0))
    error = error + home[:, segment]
    # Where the play stands is unknown after an unknown approach: Gaussian, as in the filter.
    place = generator.standard_normal(home.shape)[:, segment]
    error[:, :count] += fit.linearised.play_sd_rad * place[:, :count]
    pixel_scale = physical[:, INDEX["pixel_scale"]].reshape(-1, 1, 1)
    ideal = looks(fit, z, error)
    root = np.linalg.inv(arrays.whitening[:count])
    noise = np.einsum("sij,nsj->nsi", root, generator.standard_normal(ideal.shape))
    return ideal + pixel_scale * noise


def data_tree(posterior: Posterior) -> xr.DataTree:
    """Everything ArviZ works on, in its groups.

    Posterior, prior, posterior_predictive, log_likelihood, observed_data and sample_stats.

    Args:
        posterior: a sampled posterior.

    Returns:
        A tree for `az.summary`, `az.loo`, `az.compare` and ArviZ's plots. The unit of the log likelihood is a move.
    """
    fit = posterior.fit
    shape = posterior.z.shape[:2]
    varying = {NAMES[i] for i in np.flatnonzero(fit.free)} | {"effective_mirror_offset_mm"}
    for axis, pair in (("pan", ("left", "right")), ("tilt", ("up", "down"))):
        if varying & {f"degrees_per_step.{axis}", f"ratio_contrast_deg_per_step.{axis}"}:
            varying |= {f"degrees_per_step.{d}" for d in pair} | {f"effective_deg_per_step.{d}" for d in pair}
    prior_draws = jax.tree.map(lambda x: np.asarray(x)[None], fit.prior_draws)
    spots = ordered_spots(fit.campaign)
    pixels = np.array([(s.u_left_px, s.v_left_px, s.u_right_px, s.v_right_px) for s in spots])
    coords = {"chain": np.arange(shape[0]), "draw": np.arange(shape[1])}
    stats = {
        "lp": xr.DataArray(posterior.log_density, coords, ("chain", "draw")),
        "acceptance_rate": xr.DataArray(posterior.convergence.acceptance, {"chain": coords["chain"]}, ("chain",)),
    }
    observed = xr.DataArray(
        pixels, {"spot": [s.spot for s in spots], "pixel": list(PIXELS)}, ("spot", "pixel"), name="pixels"
    )
    tree = xr.DataTree.from_dict(
        {
            "posterior": _dataset(_variables(posterior.draws, varying, shape)),
            "prior": _dataset(_variables(prior_draws, varying, prior_draws.physical.shape[:2])),
            "posterior_predictive": predictive_pixels(posterior).to_dataset(name="pixels"),
            "log_likelihood": move_log_likelihood(posterior).to_dataset(name="pixels"),
            "observed_data": observed.to_dataset(),
            "sample_stats": xr.Dataset(stats),
        }
    )
    convergence = posterior.convergence
    tree.attrs = {
        "format": POSTERIOR_FORMAT,
        "sampling_library": "emcee",
        "sampling_time": posterior.seconds,
        "seed": posterior.seed,
        "converged": int(convergence.converged),
        "steps": convergence.steps,
        "discarded": convergence.discarded,
        "thin": convergence.thin,
        "versions": json.dumps({name: version(name) for name in ("tvsbayes", "emcee", "arviz", "jax", "numpy")}),
        "inputs": json.dumps(input_hashes(fit.campaign)),
        "fingerprint": fingerprint(fit),
        "reference_pose_deg": np.degrees(fit.reference_pose_rad),
        "log_likelihood_unit": "spots of a move given all other spots",
    }
    return tree


def write_posterior(posterior: Posterior, path: Path) -> None:
    """Write `posterior.nc` (netCDF-4), whole or not at all.

    Raises:
        InputError: the folder cannot be written.
    """
    tree = data_tree(posterior)
    packed = {"zlib": True, "complevel": 4, "shuffle": True}
    encoding = {f"/{name}": dict.fromkeys(group.data_vars, packed) for name, group in tree.children.items()}
    with tempfile.TemporaryDirectory(prefix="tvsbayes-") as scratch:
        file = Path(scratch) / "posterior.nc"
        tree.to_netcdf(file, engine="h5netcdf", encoding=encoding)
        write_atomically(path, file.read_bytes())


def propagated(values: np.ndarray) -> Propagated:
    """Summary of draws (chain, draw, ...)."""
    tails = (0.025, 0.975)
    quantiles = np.quantile(values, tails, axis=(0, 1))
    flat = values.reshape(*values.shape[:2], -1)
    # A quantity that no draw changes has no effective number of draws and no Monte Carlo error.
    moving = np.ptp(flat, axis=(0, 1)) > 0

    def each(statistic: Callable[..., np.ndarray], otherwise: float, **options) -> np.ndarray:
        result = np.full(flat.shape[2], otherwise)
        if moving.any():
            result[moving] = statistic(flat[..., moving], chain_axis=0, draw_axis=1, **options)
        return result.reshape(values.shape[2:])

    errors = [each(array_stats.mcse, 0.0, method="quantile", prob=prob) for prob in tails]
    return Propagated(
        mean=values.mean(axis=(0, 1)),
        sd=values.std(axis=(0, 1)),
        interval95=quantiles,
        mcse_mean=each(array_stats.mcse, 0.0, method="mean"),
        mcse_sd=each(array_stats.mcse, 0.0, method="sd"),
        mcse_interval95=np.stack(errors),
        ess=each(array_stats.ess, float(values.shape[0] * values.shape[1]), method="bulk"),
        draws=values,
    )


def derived_at(fit: JointFit, z: np.ndarray, pose_rad: np.ndarray) -> Derived:
    """Parameters and headlines of draws (chain, draw, p) at a pose (pan, tilt)."""
    shape = z.shape[:2]
    pose = jnp.asarray(pose_rad)
    flat = in_batches(
        lambda block: derived_quantities(block, fit.space, pose), z.reshape(-1, z.shape[-1]), DERIVED_BATCH
    )
    return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), flat)


@dataclass(frozen=True)
class Chain:
    """Everything a run has done, in w: enough to continue it bit for bit.

    Attributes:
        w: positions, shape (steps, walkers, d); log_density: relative to the mode, shape (steps, walkers).
        accepted: accepted moves by walker.
        random_state: NumPy's legacy generator after the last step.
        invalid: evaluations that gave no number.
        seconds: spent so far.
    """

    w: np.ndarray
    log_density: np.ndarray
    accepted: np.ndarray
    random_state: tuple
    invalid: int
    seconds: float


def fingerprint(fit: JointFit) -> str:
    """Hash of what a chain depends on: data, weights, model options and priors, versions of what computes it."""
    digest = hashlib.sha256(json.dumps(input_hashes(fit.campaign), sort_keys=True).encode())
    for array in (*jax.tree.leaves(fit.space), *jax.tree.leaves(fit.arrays), fit.free):
        array = np.asarray(array)
        digest.update(f"{array.dtype} {array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    for package in ("tvsbayes", "emcee", "jax", "numpy"):
        digest.update(f"{package} {version(package)}".encode())
    return digest.hexdigest()


def _checkpoint(path: Path, fit: JointFit, route: Transport, start: Pilot, chain: Chain, seed: int) -> None:
    buffer = io.BytesIO()
    kind, keys, position, has_gauss, gauss = chain.random_state
    np.savez(
        buffer,
        format=CHAIN_FORMAT,
        fingerprint=fingerprint(fit),
        seed=seed,
        **{f"transport_{f.name}": getattr(route, f.name) for f in fields(Transport)},
        proposal_mean=start.proposal.mean,
        proposal_sd=start.proposal.sd,
        start=start.start,
        log_weights=start.log_weights,
        w=chain.w,
        log_density=chain.log_density,
        accepted=chain.accepted,
        invalid=chain.invalid,
        seconds=chain.seconds,
        random_kind=kind,
        random_keys=keys,
        random_rest=np.array([position, has_gauss, gauss]),
    )
    write_atomically(path, buffer.getvalue())


def _stored(path: Path, fit: JointFit, seed: int) -> tuple[Transport, Pilot, Chain]:
    """Read a checkpoint; refuse one of other data, model, priors, versions or seed."""
    name = escaped(path.name)
    if not path.exists():
        raise InputError("no-chain", f"{name}: there is no chain to resume", file=name, remedy="run without --resume")
    try:
        stored = read_arrays(path, CHAIN_BYTES_MAX, CHAIN_BYTES_MAX)
        if str(stored["format"]) != CHAIN_FORMAT:
            raise ValueError(f"format {str(stored['format'])[:60]!r}")
        same = str(stored["fingerprint"]) == fingerprint(fit) and int(stored["seed"]) == seed
        position, has_gauss, gauss = stored["random_rest"]
        random_state = (str(stored["random_kind"]), stored["random_keys"], int(position), int(has_gauss), float(gauss))
        route = Transport(**{f.name: stored[f"transport_{f.name}"] for f in fields(Transport)})
        proposal = Independence(stored["proposal_mean"], stored["proposal_sd"], route.heavy)
        chain = Chain(
            stored["w"],
            stored["log_density"],
            stored["accepted"],
            random_state,
            int(stored["invalid"]),
            float(stored["seconds"]),
        )
        pilot = Pilot(proposal, stored["start"], stored["log_weights"])
        steps, walkers, width = chain.w.shape
        if chain.log_density.shape != (steps, walkers) or pilot.start.shape[1:] != (width,):
            raise ValueError(f"{steps} steps of {walkers} walkers with parts of other lengths")
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise InputError(
            "damaged-chain",
            f"{name} is not a chain that tvsbayes wrote: {escaped(str(error), 200)}",
            file=name,
            allowed=f"format {CHAIN_FORMAT}",
            remedy="run without --resume; the chain starts anew",
        ) from error
    if not same:
        raise InputError(
            "other-chain",
            f"{name} was sampled from other data, another model, other priors, another seed or other versions",
            file=name,
            allowed="the chain of the same campaign, options and versions",
            remedy="run without --resume, or restore the inputs and options it was started with",
        )
    return route, pilot, chain


def _tau(w: np.ndarray) -> float:
    """Longest integrated autocorrelation time of positions (steps, walkers, d), steps; infinite if none moved.

    A walker that never moved has no autocorrelation; it is found by its acceptance.
    """
    moved = np.ptp(w[:, :, 0], axis=0) > 0
    if not moved.any():
        return float("inf")
    return float(np.max(emcee.autocorr.integrated_time(w[:, moved], tol=0, quiet=True)))


def diagnose(fit: JointFit, route: Transport, start: Pilot, chain: Chain, seed: int) -> Posterior:
    """Leave out the warm-up, thin, and judge what is left."""
    steps = len(chain.w)
    discarded = int(min(steps // 4, max(20.0, 5 * _tau(chain.w))))
    kept = chain.w[discarded:]
    thin = max(1, len(kept) // STORED_DRAWS)
    stored = kept[::thin].transpose(1, 0, 2)
    walkers, draws, dimension = stored.shape
    found = route.mapped(stored.reshape(-1, dimension))
    z = found.z.reshape(walkers, draws, -1)
    log_density = chain.log_density[discarded:][::thin].T + fit.log_density - found.log_jacobian.reshape(walkers, draws)
    derived = derived_at(fit, z, fit.reference_pose_rad)
    columns = {**Draws(derived), "log_density": log_density.ravel()}
    fixed = {NAMES[i] for i in np.flatnonzero(~fit.free)}
    names = [name for name, column in columns.items() if name not in fixed and np.ptp(column) > 0]
    values = np.stack([columns[name].reshape(walkers, draws) for name in names], axis=2)
    axes = {"chain_axis": 0, "draw_axis": 1}
    rhat = array_stats.rhat(values, method="rank", **axes)
    ess_bulk = array_stats.ess(values, method="bulk", **axes)
    ess_tail = array_stats.ess(values, method="tail", prob=(0.05, 0.95), **axes)
    tau = _tau(kept)
    acceptance = chain.accepted / steps
    means = chain.log_density[discarded:].mean(axis=0)
    deviation = np.abs(means - np.median(means))
    stuck = acceptance < STUCK_ACCEPTANCE * np.median(acceptance)
    single_draw = float(np.median(chain.log_density[discarded:].std(axis=0)))
    stuck |= deviation > max(STUCK_DEVIATION * float(np.median(deviation)), single_draw)
    missing = []
    if not np.max(rhat) <= RHAT_LIMIT:
        missing.append(f"R-hat of {names[int(np.nanargmax(rhat))]} is {np.max(rhat):.4f}, wanted {RHAT_LIMIT}")
    for kind, ess in (("bulk", ess_bulk), ("tail", ess_tail)):
        if not np.min(ess) >= ESS_LIMIT:
            least = int(np.nanargmin(ess))
            missing.append(f"{names[least]} has {ess[least]:.0f} {kind} effective draws, wanted {ESS_LIMIT}")
    if not len(kept) >= TAU_LIMIT * tau:
        missing.append(f"{len(kept)} steps are {len(kept) / tau:.0f} autocorrelation times, wanted {TAU_LIMIT}")
    if stuck.any():
        missing.append(f"stuck walkers: {', '.join(map(str, np.flatnonzero(stuck)))}")
    # ArviZ takes the negative of the log weights, as `loo` hands them over.
    finite = start.log_weights[np.isfinite(start.log_weights)]
    convergence = Convergence(
        steps=steps,
        discarded=discarded,
        thin=thin,
        tau_steps=tau,
        rhat=dict(zip(names, map(float, rhat), strict=True)),
        ess_bulk=dict(zip(names, map(float, ess_bulk), strict=True)),
        ess_tail=dict(zip(names, map(float, ess_tail), strict=True)),
        acceptance=acceptance,
        stuck_walkers=tuple(int(i) for i in np.flatnonzero(stuck)),
        invalid=chain.invalid,
        pareto_k=float(array_stats.psislw(-finite)[1]),
        missing=tuple(missing),
    )
    return Posterior(fit, z, log_density, derived, convergence, seed, chain.seconds)


def sample(
    fit: JointFit,
    *,
    max_minutes: float = 10.0,
    seed: int = 0,
    checkpoint: Path | None = None,
    resume: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> Posterior:
    """Sample the posterior of a fit until it has converged or the time is over (DESIGN 4.3).

    Args:
        fit: a converged fit.
        max_minutes: time for this call; the chain is extended until all limits are met.
        seed: of everything random. The same fit, seed and versions give the same chain bit for bit.
        checkpoint: file in which the chain is kept as it grows (written whole or not at all), also on Ctrl-C.
        resume: continue the chain of `checkpoint`.
        progress: called after every block of steps.

    Returns:
        The posterior: `.propagate` for any quantity, `.by_name` for the draws; with `converged` False its intervals
        must not be used. `write_posterior` makes a file for ArviZ of it.

    Raises:
        NotConverged: the fit has not converged, or its density is not finite around the mode.
        InputError: `resume` without a usable chain.
        ValueError: max_minutes is not positive.
    """
    if not fit.converged:
        raise NotConverged(
            "not-converged",
            "NOT CONVERGED: " + "; ".join(fit.problems),
            remedy="a posterior needs a mode to start from",
        )
    if not max_minutes > 0:
        raise ValueError(f"max_minutes is {max_minutes}; it must be positive")
    began = time.monotonic()
    with jax.enable_x64(True):
        if resume:
            if checkpoint is None:
                raise ValueError("resume needs the checkpoint to continue")
            route, start, chain = _stored(checkpoint, fit, seed)
        else:
            route = transport(fit)
            try:
                start = pilot(Target(fit, route), seed)
            except FloatingPointError as error:
                raise NotConverged("no-density", str(error), remedy="see the weak directions of --no-sample") from error
            walkers = len(start.start)
            state = np.random.RandomState(seed).get_state()
            empty = np.zeros((0, walkers, route.dimension))
            chain = Chain(empty, np.zeros((0, walkers)), np.zeros(walkers), state, 0, 0.0)
        run = _Run(fit, route, start, chain, seed, checkpoint, progress, began)
        return run.until_converged(60 * max_minutes)


class _Run:
    """One call of `sample`: emcee in blocks, checks on a schedule that depends on the chain alone."""

    def __init__(self, fit, route, start, chain, seed, checkpoint, progress, began):
        self.fit, self.route, self.start, self.seed = fit, route, start, seed
        self.checkpoint, self.progress, self.began = checkpoint, progress, began
        self.before, self.saved_at = chain, began
        self.target = Target(fit, route)
        walkers, dimension = start.start.shape
        self.sampler = emcee.EnsembleSampler(
            walkers, dimension, self.target, moves=moves(start.proposal), vectorize=True
        )
        # emcee's wrapper prints the walkers and a traceback for every exception, Ctrl-C among them.
        self.sampler.log_prob_fn = self.target

    def chain(self) -> Chain:
        """All steps so far, earlier runs included."""
        done = self.sampler.iteration
        seconds = self.before.seconds + time.monotonic() - self.began
        if done == 0:
            return self.before
        backend = self.sampler.backend
        return Chain(
            np.concatenate([self.before.w, backend.get_chain()]),
            np.concatenate([self.before.log_density, backend.get_log_prob()]),
            self.before.accepted + backend.accepted,
            backend.random_state,
            self.before.invalid + self.target.invalid,
            seconds,
        )

    def save(self) -> None:
        """Write the checkpoint, if one is kept."""
        if self.checkpoint is not None:
            _checkpoint(self.checkpoint, self.fit, self.route, self.start, self.chain(), self.seed)
        self.saved_at = time.monotonic()

    def advance(self, steps: int) -> None:
        """Continue from the last whole step; the generator goes on where it stood."""
        if self.sampler.iteration:
            state = self.sampler.get_last_sample()
        elif len(self.before.w):
            state = emcee.State(
                self.before.w[-1], log_prob=self.before.log_density[-1], random_state=self.before.random_state
            )
        else:
            state = emcee.State(self.start.start, random_state=self.before.random_state)
        for _ in self.sampler.sample(state, iterations=steps, skip_initial_state_check=True):
            pass

    def until_converged(self, seconds: float) -> Posterior:
        """Extend, look, extend."""
        goal, worst_ess = FIRST_CHECK, None
        done = len(self.before.w)
        while goal < done:
            goal = int(goal * GROWTH)
        # A chain interrupted between two looks is first brought to the next: it ends where an unbroken run ends.
        if goal == done:
            goal = int(goal * GROWTH)
            posterior = diagnose(self.fit, self.route, self.start, self.before, self.seed)
            if posterior.converged:
                return posterior
        try:
            while True:
                steps = min(BLOCK, goal - done)
                self.advance(steps)
                done += steps
                elapsed = time.monotonic() - self.began
                over = elapsed > seconds
                if done >= goal or over:
                    posterior = diagnose(self.fit, self.route, self.start, self.chain(), self.seed)
                    worst_ess = min(posterior.convergence.ess_bulk.values())
                    if posterior.converged or over:
                        self.save()
                        return posterior
                    goal = int(goal * GROWTH)
                elif time.monotonic() - self.saved_at > CHECKPOINT_SECONDS:
                    self.save()
                if self.progress is not None:
                    left = (goal - done) * elapsed / max(done - len(self.before.w), 1)
                    self.progress(Progress(done, goal, worst_ess, elapsed, min(left, seconds - elapsed)))
        except KeyboardInterrupt:
            self.save()
            raise
