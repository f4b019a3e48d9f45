"""Levenberg-Marquardt by optimistix, a compiled step at a time, on residuals that the caller linearises.

A loop that JAX compiles around the residuals would compile them once more, and anew for every number of them: here
optimistix sees p + 1 numbers of the same length, slope and normal equations, whatever they were made of. Coordinates
(p,) and residuals have no unit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from tvsbayes.model.compiled import compiled
from tvsbayes.statistics.least_squares import LinearResidual

if TYPE_CHECKING:
    import optimistix as optx


class Linear(eqx.Module):
    """A linear model: residuals at a point, and their Jacobian there."""

    point: Float[Array | np.ndarray, " parameters"]
    value: Float[Array | np.ndarray, " residuals"]
    jacobian: Float[Array | np.ndarray, "residuals parameters"]

    def __call__(self, at: Float[Array, " parameters"]) -> Float[Array, " residuals"]:
        """Residuals as it has them elsewhere."""
        return jnp.asarray(self.value + self.jacobian @ (at - self.point))


class Search(eqx.Module):
    """The best point so far, the next one to try, whether the search has ended, and what optimistix keeps besides."""

    value: Float[Array, " parameters"]
    trial: Float[Array, " parameters"]
    settled: Bool[Array, ""]
    state: Float[Array, " state"]


@dataclass(frozen=True)
class Descent:
    """Where a descent ended, shape (p,), and what else came of the residuals there."""

    value: np.ndarray
    also: Any


def _solver(tolerance: Float[Array, ""]) -> optx.LevenbergMarquardt:
    """Levenberg-Marquardt whose damping falls tenfold after every step that the linear model predicted well.

    By default optimistix asks for 99 % agreement and divides by 3.5: in directions that only a prior holds, where the
    damping is as large as the curvature, it then creeps. Normal equations by Cholesky: a stored trace may hold them.
    """
    # Here: a process that takes the step from its stored trace needs neither.
    import lineax as lx
    import optimistix as optx

    # A traced tolerance, so that every stage shares the compilation, is a float to all of optimistix.
    limit = cast(float, tolerance)
    solver: optx.LevenbergMarquardt = optx.LevenbergMarquardt(limit, limit, linear_solver=lx.Normal(lx.Cholesky()))
    trust: optx.ClassicalTrustRegion = optx.ClassicalTrustRegion(
        high_cutoff=0.75, low_cutoff=0.1, high_constant=10.0, low_constant=0.2
    )
    return eqx.tree_at(lambda s: s.search, solver, trust)


def _residuals(at: Float[Array, " parameters"], linear: Linear) -> tuple[Float[Array, " residuals"], None]:
    return linear(at), None


def _initial(linear: Linear, tolerance: Float[Array, ""]) -> Any:
    """State of the solver before its first step."""
    shape = jax.ShapeDtypeStruct(linear.value.shape, linear.value.dtype)
    return _solver(tolerance).init(_residuals, linear.point, linear, {}, shape, None, frozenset())


@compiled(Search)
def begun(linear: Linear, tolerance: Float[Array, ""]) -> Search:
    """The search before its first step, which is to the point itself."""
    state = _initial(linear, tolerance)
    packed = ravel_pytree(eqx.filter(state, eqx.is_array))[0]
    return Search(jnp.asarray(linear.point), state.y_eval, jnp.zeros((), bool), packed)


@compiled(Search)
def advanced(search: Search, linear: Linear, tolerance: Float[Array, ""]) -> Search:
    """One step: the residuals at the point that was to be tried, linearised, decide about it and about the next."""
    arrays, rest = eqx.partition(_initial(linear, tolerance), eqx.is_array)
    state = eqx.combine(ravel_pytree(arrays)[1](search.state), rest)
    solver = _solver(tolerance)
    value, state, _ = solver.step(_residuals, search.value, linear, {}, state, frozenset())
    settled, _ = solver.terminate(_residuals, value, linear, {}, state, frozenset())
    return Search(value, state.y_eval, settled, ravel_pytree(eqx.filter(state, eqx.is_array))[0])


def _reduced(point: np.ndarray, at: LinearResidual) -> Linear:
    """As few residuals as have the same sum of squares, slope and normal equations: p + 1."""
    value, jacobian = np.asarray(at.value), np.asarray(at.jacobian)
    root = np.linalg.qr(np.column_stack([jacobian, value]), mode="r")
    filled = np.zeros((point.size + 1, point.size + 1))
    filled[: len(root)] = root
    return Linear(point, filled[:, -1], filled[:, :-1])


def descend(
    linearised: Callable[[np.ndarray], LinearResidual], start: np.ndarray, tolerance: float, max_steps: int
) -> Descent:
    """Where optimistix' Levenberg-Marquardt ends.

    Args:
        linearised: residuals and their Jacobian at a point (p,); called once a step.
        start: shape (p,).
        tolerance: relative and absolute, of the last step and of what it changed in the sum of squares.
        max_steps: points at most.
    """
    best = at = linearised(start)
    search = begun(linear := _reduced(start, at), tolerance)
    for step in range(max_steps):
        trial = np.asarray(search.trial)
        if step:
            linear = _reduced(trial, at := linearised(trial))
        search = advanced(search, linear, tolerance)
        if np.array_equal(search.value, trial):
            best = at
        if search.settled:
            break
    return Descent(np.asarray(search.value), best.also)
