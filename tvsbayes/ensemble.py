"""Sampling a posterior with emcee in coordinates in which it is nearly standard normal (DESIGN 4.3).

Three layers of coordinates: z, the prior-normal coordinates of `tvsbayes.model`; y, whitened by the Laplace
covariance; w, in which walkers live. Wide directions (laser tilt, mirror errors) bend the ridges on which the narrow
ones (extrinsics, ratios) lie: a shear moves each narrow coordinate by a quadratic form of the wider ones. Noise
scales widen what they limit (stop sd the ratios): a stretch scales those by an exponential of the noise coordinates.
NumPy outside the compiled density.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import emcee
import jax
import jax.numpy as jnp
import numpy as np
from scipy import special

from tvsbayes.joint import JointFit
from tvsbayes.likelihood import evaluate
from tvsbayes.model import NAMES, NOISE_NAMES

BATCH = 32
"""Points per call of the compiled density: half an ensemble of 64, the calls of a differential-evolution step."""
WALKERS = 64
NARROW = 0.05
"""Conditional posterior sd, in prior sds, below which a coordinate is moved by the shear. Wider ones would be moved
far enough for cubic terms to matter."""
SHEAR_STEP = 0.5
"""Step of the second differences in posterior sds: the shear should hold over +-2 sd, not only at the mode."""
PILOT_DRAWS = 2048
HEAVY_DOF = 5.0
HEAVY_SHARE = 0.1
"""Share of the proposals from a multivariate t: it bounds the ratio target / proposal in the tails. In fifty
dimensions a t alone puts most draws off the shell where the target lives: effective draws fell threefold."""
HEAVY_NAMES = (*NOISE_NAMES, "backlash_deg.pan", "backlash_deg.tilt")
"""Coordinates that few stops tell: their tails are heavier than normal (a walker stood still for 155 steps at 3.7 sd
of a stop sd), so each of them is always proposed from a t of its own."""
INFLATION = 1.03
"""Factor on the proposal's sds: a proposal lighter than the target lets walkers freeze in its tails."""
SHARES = (0.85, 0.1, 0.05)
"""Independence proposal, differential evolution, differential evolution with full steps."""


@dataclass(frozen=True)
class Transport:
    """The map w -> z; its Jacobian is |det root| exp(`log_jacobian`).

    Attributes:
        mode: z at w = 0, shape (p,).
        free: columns of z that are sampled, widest conditional sd first, shape (d,).
        root: lower-triangular Cholesky factor of their covariance in that order, shape (d, d).
        narrow: places in `free` that the shear moves, ascending, shape (k,).
        bend: its quadratic forms, nonzero only among places before the narrow one, shape (k, d, d).
        stretch: log of the factor on a place per unit of an earlier noise coordinate, shape (d, d).
    """

    mode: np.ndarray
    free: np.ndarray
    root: np.ndarray
    narrow: np.ndarray
    bend: np.ndarray
    stretch: np.ndarray

    @property
    def dimension(self) -> int:
        """Number of sampled coordinates."""
        return len(self.free)

    @property
    def heavy(self) -> np.ndarray:
        """Coordinates of `HEAVY_NAMES`, shape (d,)."""
        return np.isin(np.array(NAMES)[self.free], HEAVY_NAMES)

    def from_whitened(self, y: np.ndarray) -> np.ndarray:
        """From y (n, d) to z (n, p)."""
        z = np.repeat(self.mode[None], len(y), axis=0)
        z[:, self.free] += y @ self.root.T
        return z

    def log_jacobian(self, w: np.ndarray) -> np.ndarray:
        """The log of |dy/dw| at w (n, d): noise coordinates are the same in w and y, the shear keeps volumes."""
        return w @ self.stretch.sum(axis=0)

    def to_z(self, w: np.ndarray) -> np.ndarray:
        """From w (n, d) to z (n, p)."""
        y = w * np.exp(w @ self.stretch.T)
        for place, form in zip(self.narrow, self.bend, strict=True):
            before = y[:, :place]
            y[:, place] -= 0.5 * np.sum((before @ form[:place, :place]) * before, axis=1)
        return self.from_whitened(y)

    def to_w(self, z: np.ndarray) -> np.ndarray:
        """From z (n, p) to w (n, d); the inverse of `to_z` on the sampled columns."""
        y = np.linalg.solve(self.root, (z - self.mode)[:, self.free].T).T
        straight = y.copy()
        for place, form in zip(self.narrow, self.bend, strict=True):
            before = y[:, :place]
            straight[:, place] += 0.5 * np.sum((before @ form[:place, :place]) * before, axis=1)
        # Noise coordinates are neither bent nor stretched: they are known before anything is undone.
        return straight * np.exp(-straight @ self.stretch.T)


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
    return np.array(order)


def transport(fit: JointFit) -> Transport:
    """Measure the bend of the ridges at a fit's mode.

    With r the standardised innovations and J their Jacobian in y, the narrow coordinate k has its optimum shifted by
    -y (J_k . d2r/dy2) y / 2: in y the Gauss-Newton Hessian is the identity. Second differences of r, all pairs in
    batches of the one compiled density.

    Args:
        fit: a converged fit.

    Returns:
        The map; the noise scales take no part in the shear.
    """
    free = np.flatnonzero(fit.free)
    free = free[by_width(fit.covariance[np.ix_(free, free)])]
    root = np.linalg.cholesky(fit.covariance[np.ix_(free, free)])
    count = len(free)
    is_noise = np.isin(np.array(NAMES)[free], NOISE_NAMES)
    geometry = np.flatnonzero(~is_noise)
    narrow = np.flatnonzero((np.diag(root) < NARROW) & ~is_noise)
    straight = Transport(fit.z, free, root, narrow[:0], np.zeros((0, count, count)), np.zeros((count, count)))

    def residuals(y: np.ndarray) -> np.ndarray:
        seen = in_batches(lambda z: evaluate(z, fit.space, fit.arrays).standardised, straight.from_whitened(y))
        return np.nan_to_num(seen.reshape(len(y), -1))

    with jax.enable_x64(True):
        steps = SHEAR_STEP * np.eye(count)
        centre = residuals(np.zeros((1, count)))[0]
        ahead, behind = residuals(steps), residuals(-steps)
        jacobian = (ahead - behind)[narrow] / (2 * SHEAR_STEP)
        own = (ahead + behind - 2 * centre) @ jacobian.T / SHEAR_STEP**2
        bend = np.zeros((len(narrow), count, count))
        bend[:, geometry, geometry] = own[geometry].T
        pairs = np.array([(i, j) for i in geometry for j in geometry if j < i]).reshape(-1, 2)
        for some in np.array_split(pairs, max(1, len(pairs) // 256)):
            y = np.zeros((len(some), count))
            np.put_along_axis(y, some, SHEAR_STEP, axis=1)
            both = residuals(np.concatenate([y, -y]))
            curvature = (both[: len(some)] + both[len(some) :] - 2 * centre) @ jacobian.T / SHEAR_STEP**2
            mixed = 0.5 * (curvature - own[some[:, 0]] - own[some[:, 1]])
            bend[:, some[:, 0], some[:, 1]] = bend[:, some[:, 1], some[:, 0]] = mixed.T
        # The data's share of the information 1 of each coordinate, when a noise coordinate goes up or down.
        stretch = np.zeros((count, count))
        for noise in np.flatnonzero(is_noise):
            later, share = geometry[geometry > noise], []
            for shifted in (steps[noise], -steps[noise]):
                slope = residuals(steps[later] + shifted) - residuals(-steps[later] + shifted)
                share.append(np.sum((slope / (2 * SHEAR_STEP)) ** 2, axis=1))
            stretch[later, noise] = -0.5 * (share[0] - share[1]) / (2 * SHEAR_STEP)
    for place, form in zip(narrow, bend, strict=True):
        form[place:], form[:, place:] = 0.0, 0.0
    return Transport(fit.z, free, root, narrow, bend, np.clip(stretch, -0.5, 0.5))


class Target:
    """The log posterior density of walkers, as emcee calls it: NumPy in, NumPy out, NaN refused and counted."""

    def __init__(self, fit: JointFit, path: Transport):
        self.fit, self.path = fit, path
        self.invalid = 0

    def __call__(self, w: np.ndarray) -> np.ndarray:
        """Log density of w (n, d), relative to z's at the mode; -inf where the model has no value."""
        z = self.path.to_z(w)
        value = in_batches(lambda block: evaluate(block, self.fit.space, self.fit.arrays).log_density, z)
        invalid = np.isnan(value)
        self.invalid += int(invalid.sum())
        return np.where(invalid, -np.inf, value - self.fit.log_density + self.path.log_jacobian(w))


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
        log_weights: log (target / proposal about the mode) of the pilot draws.
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
    about_mode = Independence(np.zeros(dimension), np.ones(dimension), heavy)
    w = about_mode.draw(PILOT_DRAWS, generator)
    log_target = target(w)
    log_weights = log_target - about_mode.log_density(w)
    finite = np.isfinite(log_weights)
    if finite.sum() < walkers_for(dimension):
        raise FloatingPointError("the posterior density is not finite around the mode")
    # Where the target is normal, log(target / standard normal) is linear in w and w^2: the coefficients give its mean
    # and sds. A regression on the draws that matter is far steadier than weighted moments.
    matters = finite & (log_weights > np.max(log_weights[finite]) - 12)
    mean, sd = np.zeros(dimension), np.ones(dimension)
    if matters.sum() > 8 * dimension:
        near = w[matters]
        design = np.column_stack([np.ones(len(near)), near, near**2])
        ratio = log_target[matters] + 0.5 * np.sum(near**2, axis=1)
        slope, square = np.split(np.linalg.lstsq(design, ratio, rcond=None)[0][1:], 2)
        variance = 1 / np.clip(1 - 2 * square, 0.6, 1.2)
        mean, sd = np.clip(slope * variance, -1.0, 1.0), INFLATION * np.sqrt(variance)
    # Gumbel's trick: the largest perturbed weights are a weighted sample without replacement.
    keys = np.where(finite, log_weights, -np.inf) + generator.gumbel(size=len(w))
    start = w[np.argsort(-keys)[: walkers_for(dimension)]]
    return Pilot(Independence(mean, sd, heavy), start, log_weights)
