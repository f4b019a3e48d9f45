"""Minima of sums of squares and of negative log densities, with the covariance at them; float64 throughout.

optimistix' `LevenbergMarquardt` reports success on wrong answers at loose tolerances, so its flag is ignored. The joint
fit continues with Newton steps on the density and tests the size of the last step. Residuals are dimensionless
(divided by their standard deviations) or in the data's unit; the covariance follows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree
from scipy import optimize

DIFFERENCE_STEP = 2e-3
"""Step of central differences, in posterior standard deviations. Along a curved ridge third derivatives reach 10 and
fourth 300: they make slopes wrong by 1e-5, rounding of a density of 1e4 (1e-11) by 1e-8."""
PAIR_STEP = 3e-4
"""Step of second differences, one-sided for pairs of directions. A mixed third derivative of a few units changes the
curvature by 1e-3, rounding of a density of 1e4 (1e-11) by 2e-4; both change a reported sd by less than 0.1 %."""
KINK_STEP = 0.25
"""Largest Newton step, in posterior sds, that may remain where the density does not decrease along it. That is so on a
kink, where a move is as long as the play that it takes up, or where rounding over a thousand looks is larger."""
KINK_FALL = 1e-4
"""Largest decrease of the negative log density by all steps that alternate about a kink; it corresponds to 0.014 sd."""
KINK_CURVATURE = 4.0
"""Largest ratio of second differences to the expected curvature at a kink; above it they straddle the kink."""
NEWTON_SETTLED = 1e-8
"""Squared Newton step, in posterior sds, at which the mode is reached."""
HESSIAN_KEPT = 2e-3
"""The Hessian is computed again if the mode has moved by more than this many sds; along a curved ridge it has changed
by 1 % then."""
QUASI_STEPS, LAPLACE_DRAWS = 40, 2048
"""Largest number of quasi-Newton steps; number of draws of a Laplace approximation."""
Objective = Callable[[np.ndarray], np.ndarray]
"""Negative log density of points (n, p), shape (n,); not finite where it is undefined."""
Residual = Callable[[Float[Array, " parameters"], PyTree], Float[Array, " residuals"]]


class LinearResidual(eqx.Module):
    """Residuals at a point, their Jacobian, exact or approximate, and in `also` further results of the evaluation."""

    value: Float[Array | np.ndarray, " residuals"]
    jacobian: Float[Array | np.ndarray, "residuals parameters"]
    also: Any = None


def linear_residual(residual: Residual, value: Float[Array, " parameters"], args: PyTree) -> LinearResidual:
    """Compute residuals and their Jacobian, by forward derivatives of all parameters at once."""
    residuals, push = jax.linearize(lambda x: residual(x, args), value)
    return LinearResidual(residuals, jax.vmap(push, out_axes=1)(jnp.eye(value.size)))


residuals_and_jacobian = eqx.filter_jit(linear_residual)


NEIGHBOUR_STEPS, NEIGHBOUR_SETTLED = 20, 0.01
"""Largest number of Newton steps to a mode near a known one, and the gain in log density below which they end: steps
shorten slowly where a scale is poorly determined."""


@dataclass(frozen=True)
class Mode:
    """Result of the Newton steps; `covariance` is the inverse Hessian over all coordinates."""

    z: np.ndarray
    covariance: np.ndarray
    negative_log_density: float
    problems: tuple[str, ...]


@dataclass(frozen=True)
class _Surroundings:
    """A negative log density about a point, along the columns of `ways`, a matrix of directions."""

    objective: Objective
    z: np.ndarray
    ways: np.ndarray

    def at(self, steps: np.ndarray) -> np.ndarray:
        """Compute values (n,) after steps (n, d) along the directions."""
        return self.objective(self.z + steps @ self.ways.T)

    def slope(self) -> np.ndarray:
        """Compute the gradient by central differences (d,)."""
        steps = DIFFERENCE_STEP * np.eye(self.ways.shape[1])
        ahead, behind = np.split(self.at(np.concatenate([steps, -steps])), 2)
        return (ahead - behind) / (2 * DIFFERENCE_STEP)

    def curvature(self) -> np.ndarray:
        """Compute the Hessian (d, d) by differences: central along each direction, one step along both for a pair.

        This takes half the evaluations that central differences would need.
        """
        steps = PAIR_STEP * np.eye(self.ways.shape[1])
        first, second = np.triu_indices(len(steps), 1)
        values = self.at(np.concatenate([0 * steps[:1], steps, -steps, steps[first] + steps[second]]))
        centre, ahead, behind, both = np.split(values, np.cumsum([1, len(steps), len(steps)]))
        hessian = np.diag((ahead + behind - 2 * centre) / PAIR_STEP**2)
        shared = (both - ahead[first] - ahead[second] + centre) / PAIR_STEP**2
        hessian[first, second] = hessian[second, first] = shared
        return hessian


def _nearly_there(begin: _Surroundings) -> _Surroundings:
    """Descend by quasi-Newton steps (BFGS), which need gradients only; a Hessian costs two dozen gradients."""
    count = begin.ways.shape[1]
    around = DIFFERENCE_STEP * np.concatenate([np.zeros((1, count)), np.eye(count), -np.eye(count)])

    def value_and_slope(step: np.ndarray) -> tuple[float, np.ndarray]:
        centre, ahead, behind = np.split(begin.at(step + around), [1, 1 + count])
        return float(centre[0]), (ahead - behind) / (2 * DIFFERENCE_STEP)

    before = value_and_slope(np.zeros(count))[0]
    options = {"gtol": HESSIAN_KEPT, "norm": 2, "maxiter": QUASI_STEPS}
    optimum = optimize.minimize(value_and_slope, np.zeros(count), jac=True, method="BFGS", options=options)
    return replace(begin, z=begin.z + begin.ways @ optimum.x) if optimum.fun < before else begin


@dataclass(frozen=True)
class _Descended:
    """End of Newton steps: where, whether the next step is negligible, whether steps alternated at a kink."""

    end: _Surroundings
    settled: bool
    kinked: bool = False


def _descended(begin: _Surroundings, inverse: np.ndarray) -> _Descended:
    """Take Newton steps with one inverse Hessian; steps that only alternate about a kink return the start."""
    point, first = begin, begin.at(np.zeros((1, len(inverse))))[0]
    value = first
    shortened = 0.5 ** np.arange(12)[:, None]
    for _ in range(12):
        step = -inverse @ point.slope()
        if step @ step < NEWTON_SETTLED:
            return _Descended(point, True)
        trials = point.at(shortened * step)
        lower = np.isfinite(trials) & (trials < value + 1e-9 * abs(value))
        if not lower.any():
            return _Descended(point, bool(step @ step < KINK_STEP**2), kinked=True)
        chosen = int(np.argmax(lower))
        value = trials[chosen]
        point = replace(point, z=point.z + point.ways @ (shortened[chosen] * step))
    if step @ step < KINK_STEP**2 and first - value < KINK_FALL:
        return _Descended(begin, True, kinked=True)
    return _Descended(point, False)


def newton_mode(objective: Objective, start: np.ndarray, free: np.ndarray, curvature: np.ndarray) -> Mode:
    """Minimise a negative log density by Newton steps, with derivatives by differences of many values at once.

    The differences are taken in coordinates whitened by `curvature`: the Hessian is near the identity there, and
    directions whose curvatures differ by eight orders of magnitude are equally well resolved.

    Args:
        objective: negative log density of many points.
        start: near the mode, shape (p,).
        free: coordinates that move; the others keep their values and unit variance.
        curvature: positive definite guess of the Hessian, shape (p, p).

    Returns:
        The mode and its covariance.

    Raises:
        np.linalg.LinAlgError: the density is not finite about the mode.
    """
    rows = np.flatnonzero(free)
    ways = np.zeros((start.size, len(rows)))
    ways[rows] = np.linalg.inv(np.linalg.cholesky(curvature[np.ix_(rows, rows)])).T
    surroundings, expected = _nearly_there(_Surroundings(objective, start, ways)), ways
    problems: list[str] = []
    for _ in range(6):
        begin = surroundings.z
        hessian = surroundings.curvature()
        if not np.all(np.isfinite(hessian)):
            raise np.linalg.LinAlgError("the density is not finite about the mode")
        eigenvalues, vectors = np.linalg.eigh(hessian)
        # Far from the mode the density may be flat or convex along a direction: the step has the expected scale then.
        descent = _descended(surroundings, (vectors / np.maximum(np.abs(eigenvalues), 0.1)) @ vectors.T)
        surroundings = descent.end
        if (
            descent.settled
            and np.linalg.norm(np.linalg.solve(surroundings.ways[rows], (surroundings.z - begin)[rows])) < HESSIAN_KEPT
        ):
            break
        surroundings = replace(
            surroundings, ways=surroundings.ways @ (vectors / np.sqrt(np.maximum(np.abs(eigenvalues), 0.1))) @ vectors.T
        )
    else:
        problems.append("the Newton steps on the full density did not settle")
    if descent.kinked and descent.settled and not 0 < eigenvalues[0] <= eigenvalues[-1] < KINK_CURVATURE:
        surroundings, eigenvalues, vectors = replace(surroundings, ways=expected), np.ones(len(rows)), np.eye(len(rows))
    if eigenvalues[0] <= 0:
        problems.append("the density has no maximum here: its Hessian is not negative definite")
    covariance = np.eye(start.size)
    whitened = (vectors / np.maximum(eigenvalues, 1e-3)) @ vectors.T
    covariance[np.ix_(rows, rows)] = (surroundings.ways @ whitened @ surroundings.ways.T)[np.ix_(rows, rows)]
    return Mode(surroundings.z, covariance, float(objective(surroundings.z[None])[0]), tuple(problems))


def neighbouring_mode(objective: Objective, known: Mode, free: np.ndarray) -> Mode | None:
    """Find the mode of a density near one of known mode, by Newton steps with the known covariance.

    Args:
        objective: negative log density of many points.
        known: mode and covariance of the other density.
        free: coordinates that move.

    Returns:
        The mode with the known covariance; None where the steps did not settle.
    """
    rows = np.flatnonzero(free)
    ways = np.zeros((len(free), len(rows)))
    ways[rows] = np.linalg.cholesky(known.covariance[np.ix_(rows, rows)])
    surroundings = _Surroundings(objective, known.z, ways)
    value, shortened = float(objective(known.z[None])[0]), 0.5 ** np.arange(6)[:, None]
    for _ in range(NEIGHBOUR_STEPS):
        with np.errstate(invalid="ignore"):
            step = -surroundings.slope()
        if not np.all(np.isfinite(step)):
            return None
        trials = surroundings.at(shortened * step)
        chosen = int(np.argmin(trials))
        gain = value - float(trials[chosen])
        if gain > 0:
            surroundings, value = (
                replace(surroundings, z=surroundings.z + ways @ (shortened[chosen] * step)),
                float(trials[chosen]),
            )
        if gain < NEIGHBOUR_SETTLED:
            return Mode(surroundings.z, known.covariance, value, ())
    return None


def laplace_draws(z: np.ndarray, covariance: np.ndarray, seed: int) -> np.ndarray:
    """Draw normal numbers whose sample mean and covariance are exactly those given.

    Antithetic pairs fix the mean, a Cholesky factor of the sample covariance fixes the rest: standard deviations of
    linear quantities then carry no Monte Carlo error.
    """
    half = np.random.default_rng(seed).standard_normal((LAPLACE_DRAWS // 2, z.size))
    normal = np.concatenate([half, -half])
    normal = normal @ np.linalg.inv(np.linalg.cholesky(normal.T @ normal / len(normal))).T
    return z + normal @ np.linalg.cholesky(covariance).T
