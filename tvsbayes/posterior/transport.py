"""The map that makes the posterior nearly normal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from scipy import linalg

from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.estimators.likelihood import evaluate
from tvsbayes.estimators.linear_spots import LinearSpots, linear_spots
from tvsbayes.instrument.parameters import BLOCKS, NAMES, NOISE_NAMES
from tvsbayes.model.parameter_space import STOP_COLUMNS, half_normal, half_normal_slope

BATCH = 32
"""Points per call of the compiled density: half an ensemble of 64, the calls of a differential-evolution step."""
BLOCK_ROWS = 256
"""Points that are mapped at a time: their matrices take 64 MB at most."""
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
HEAVY_NAMES = (*NOISE_NAMES, *BLOCKS["backlash_deg"], "extrinsics.rotation_rad.y", "mirror_offset_mm")
"""Coordinates whose tails are heavier than normal: those that few stops tell (a walker stood still for 155 steps at 3.7
sd of a stop sd), and the tilt of the frames with the mirrors' offset, along whose ridge a quadratic shear falls short
(one stood at 7.7 sd). Each of them is always proposed from a t of its own."""


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
        return np.flatnonzero(np.isin(np.array(NAMES)[self.free], BLOCKS["backlash_deg"]))

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


def in_batches[Result](function: Callable[[jax.Array], Result], points: np.ndarray, size: int = BATCH) -> Result:
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
    linear = linear_spots(fit.linearised, fit.arrays, -np.asarray(fit.linearised.residual_jacobian))
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
    of_noise = STOP_COLUMNS.reshape(4, 1) == free[noise]
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
