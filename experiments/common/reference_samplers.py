"""A sampler that shares no code with the one it judges: NUTS by NumPyro.

A triangular quadratic shear w -> y of volume 1 takes the curvature out of the stiff directions, and z = mode + C y with
C the Cholesky factor of the Laplace covariance. Coordinates change the cost of a draw, not the posterior.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from experiments.common.jax_density import innovations, log_density, without_padding
from tvsbayes.estimators.joint_fit import JointFit
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.parameters import NOISE_NAMES

AXES = {"chain_axis": 0, "draw_axis": 1}
"""Of draws (chain, draw)."""
STEP = 0.5
"""Posterior sds (of what the coordinates before leave open) over which second differences are taken."""
STIFF_SD = 0.05
"""Prior sds: a coordinate that the data determine better than this, given those before it, is sheared."""
BATCH = 64


@dataclass(frozen=True)
class Transport:
    """w -> y -> z: y_k = w_k - y^T shear_k y / 2 over earlier coordinates, z[index] = mode[index] + root y."""

    mode: np.ndarray
    index: np.ndarray
    root: np.ndarray
    stiff: tuple[int, ...]
    shear: np.ndarray

    def z_of_y(self, y: jax.Array) -> jax.Array:
        """Laplace-whitened coordinates to prior coordinates."""
        return jnp.asarray(self.mode).at[self.index].add(jnp.asarray(self.root) @ y)

    def y_of_w(self, w: jax.Array) -> jax.Array:
        """The shear; its Jacobian is lower triangular with ones on the diagonal."""
        y = w
        for k in self.stiff:
            y = y.at[k].add(-0.5 * y[:k] @ (jnp.asarray(self.shear[k, :k, :k]) @ y[:k]))
        return y


def pivoted(covariance: np.ndarray) -> np.ndarray:
    """Order of the coordinates by what the earlier ones leave open, widest first."""
    rest, order = covariance.copy(), []
    for _ in range(len(rest)):
        open_variance = np.diag(rest).copy()
        open_variance[order] = -1
        k = int(np.argmax(open_variance))
        order.append(k)
        rest = rest - np.outer(rest[:, k], rest[k]) / rest[k, k]
    return np.array(order)


@jax.jit
def whitened(z, space, arrays):
    """Standardised innovations and errors at places of many points, shape (n, residuals)."""
    return jax.vmap(lambda z: innovations(z, space, arrays).residual)(z)


def build_transport(joint: JointFit) -> Transport:
    """Second differences of the standardised innovations give the shear that keeps them fixed to second order."""
    rows = np.flatnonzero(joint.free)
    index = rows[pivoted(joint.covariance[np.ix_(rows, rows)])]
    root = np.linalg.cholesky(joint.covariance[np.ix_(index, index)])
    size, arrays = index.size, without_padding(joint.arrays, len(joint.campaign.moves))

    def residuals(y: np.ndarray) -> np.ndarray:
        out = []
        for first in range(0, len(y), BATCH):
            part = y[first : first + BATCH]
            z = np.repeat(joint.z[None], BATCH, axis=0)
            z[: len(part), index] += part @ root.T
            out.append(np.asarray(whitened(jnp.asarray(z), joint.space, arrays))[: len(part)])
        return np.concatenate(out)

    geometry = [k for k in range(size) if TWO_MIRROR.names[index[k]] not in NOISE_NAMES]
    stiff = [k for k in geometry if root[k, k] < STIFF_SD]
    centre = residuals(np.zeros((1, size)))[0]
    plus, minus = residuals(STEP * np.eye(size)), residuals(-STEP * np.eye(size))
    slope = ((plus - minus) / (2 * STEP))[stiff]
    second = (plus + minus - 2 * centre) / STEP**2
    shear = np.zeros((size, size, size))
    for i in geometry:
        shear[stiff, i, i] = slope @ second[i]
    pairs = [(i, j) for a, i in enumerate(geometry) for j in geometry[:a]]
    for first in range(0, len(pairs), 2 * BATCH):
        some = pairs[first : first + 2 * BATCH]
        y = np.zeros((2, len(some), size))
        for n, pair in enumerate(some):
            y[0, n, list(pair)], y[1, n, list(pair)] = STEP, -STEP
        both = residuals(y.reshape(-1, size)).reshape(2, len(some), -1).sum(axis=0)
        mixed = (both - 2 * centre) / STEP**2
        for n, (i, j) in enumerate(some):
            value = 0.5 * slope @ (mixed[n] - second[i] - second[j])
            shear[stiff, i, j] = shear[stiff, j, i] = value
    k = np.arange(size)
    earlier = (k[:, None, None] > k[None, :, None]) & (k[:, None, None] > k[None, None, :])
    return Transport(joint.z, index, root, tuple(stiff), np.where(earlier, shear, 0.0))


def potential_of(joint: JointFit, path: Transport) -> tuple[Callable, Callable]:
    """Coordinates z of sheared ones w, and minus the log density there, 0 at the mode."""
    arrays = without_padding(joint.arrays, len(joint.campaign.moves))

    def z_of(w: jax.Array) -> jax.Array:
        return path.z_of_y(path.y_of_w(w))

    def potential(w: jax.Array) -> jax.Array:
        return joint.log_density - log_density(z_of(w), joint.space, arrays)

    return z_of, potential


@dataclass(frozen=True)
class Run:
    """Draws (chain, draw, coordinate) and what they took; seconds are the process' CPU time: cores may be shared."""

    draws: np.ndarray
    divergences: int
    leapfrogs: float
    acceptance: float
    compile_s: float
    warmup_s: float
    sampling_s: float


@dataclass(frozen=True)
class Setting:
    """Of a run: chains, draws of each before and after the warm-up ends, seed."""

    chains: int
    warmup: int
    draws: int
    seed: int


def nuts(potential: Callable[[jax.Array], jax.Array], size: int, setting: Setting) -> Run:
    """Sample exp(-potential) by NumPyro (the extra `bench`), all chains in step."""
    from numpyro.infer import NUTS

    kernel = NUTS(potential_fn=potential, dense_mass=False, target_accept_prob=0.8)
    key, start = jax.random.split(jax.random.PRNGKey(setting.seed))
    started = time.process_time()
    state = kernel.init(
        jax.random.split(key, setting.chains),
        setting.warmup,
        0.1**0.5 * jax.random.normal(start, (setting.chains, size)),
        model_args=(),
        model_kwargs={},
    )
    advance = jax.jit(lambda state: kernel.sample(state, (), {})).lower(state).compile()
    compile_s = time.process_time() - started

    def several(state, count: int):
        began, steps = time.process_time(), []
        for _ in range(count):
            state = advance(state)
            steps.append([np.asarray(x) for x in (state.z, state.diverging, state.num_steps, state.accept_prob)])
        return state, [np.stack(x) for x in zip(*steps, strict=True)], time.process_time() - began

    state, _, warmup_s = several(state, setting.warmup)
    _, (z, diverging, leapfrogs, acceptance), sampling_s = several(state, setting.draws)
    figures = int(diverging.sum()), float(leapfrogs.mean()), float(acceptance.mean())
    return Run(np.swapaxes(z, 0, 1), *figures, compile_s, warmup_s, sampling_s)
