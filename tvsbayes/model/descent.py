"""Levenberg-Marquardt by optimistix, one compiled step at a time, on residuals that the caller linearises.

A loop compiled around the residuals would compile them again for every number of residuals. Here optimistix gets p + 1
residuals with the same sum of squares, gradient and normal equations. Coordinates (p,) and residuals have no unit.
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
    """A linear model: residuals at a point and their Jacobian."""

    point: Float[Array | np.ndarray, " parameters"]
    value: Float[Array | np.ndarray, " residuals"]
    jacobian: Float[Array | np.ndarray, "residuals parameters"]

    def __call__(self, at: Float[Array, " parameters"]) -> Float[Array, " residuals"]:
        """Compute the residuals of the linear model at another point."""
        return jnp.asarray(self.value + self.jacobian @ (at - self.point))


class Search(eqx.Module):
    """State of a search: the best point, the next one to try, whether the search has ended, optimistix' own state."""

    value: Float[Array, " parameters"]
    trial: Float[Array, " parameters"]
    settled: Bool[Array, ""]
    state: Float[Array, " state"]


@dataclass(frozen=True)
class Descent:
    """End of a descent, shape (p,), and further results of the residuals there."""

    value: np.ndarray
    also: Any


def _solver(tolerance: Float[Array, ""]) -> optx.LevenbergMarquardt:
    """Build a Levenberg-Marquardt solver whose damping falls tenfold after every well predicted step.

    By default optimistix requires 99 % agreement and divides by 3.5. That is slow in directions constrained by a prior
    only, where the damping is as large as the curvature. Normal equations by Cholesky can be stored in a trace.
    """
    # Imported here: a process with a stored trace of the step needs neither.
    import lineax as lx
    import optimistix as optx

    # The tolerance is traced, so that all stages share one compilation; optimistix' types expect a float.
    limit = cast(float, tolerance)
    solver: optx.LevenbergMarquardt = optx.LevenbergMarquardt(limit, limit, linear_solver=lx.Normal(lx.Cholesky()))
    trust: optx.ClassicalTrustRegion = optx.ClassicalTrustRegion(
        high_cutoff=0.75, low_cutoff=0.1, high_constant=10.0, low_constant=0.2
    )
    return eqx.tree_at(lambda s: s.search, solver, trust)


def _residuals(at: Float[Array, " parameters"], linear: Linear) -> tuple[Float[Array, " residuals"], None]:
    return linear(at), None


def _initial(linear: Linear, tolerance: Float[Array, ""]) -> Any:
    """Return the state of the solver before its first step."""
    shape = jax.ShapeDtypeStruct(linear.value.shape, linear.value.dtype)
    return _solver(tolerance).init(_residuals, linear.point, linear, {}, shape, None, frozenset())


@compiled(Search)
def begun(linear: Linear, tolerance: Float[Array, ""]) -> Search:
    """Start a search; its first step is to the point itself."""
    state = _initial(linear, tolerance)
    packed = ravel_pytree(eqx.filter(state, eqx.is_array))[0]
    return Search(jnp.asarray(linear.point), state.y_eval, jnp.zeros((), bool), packed)


@compiled(Search)
def advanced(search: Search, linear: Linear, tolerance: Float[Array, ""]) -> Search:
    """Take one step: accept or reject the trial point by its linearised residuals, and propose the next."""
    arrays, rest = eqx.partition(_initial(linear, tolerance), eqx.is_array)
    state = eqx.combine(ravel_pytree(arrays)[1](search.state), rest)
    solver = _solver(tolerance)
    value, state, _ = solver.step(_residuals, search.value, linear, {}, state, frozenset())
    settled, _ = solver.terminate(_residuals, value, linear, {}, state, frozenset())
    return Search(value, state.y_eval, settled, ravel_pytree(eqx.filter(state, eqx.is_array))[0])


def _reduced(point: np.ndarray, at: LinearResidual) -> Linear:
    """Reduce to p + 1 residuals of the same sum of squares, gradient and normal equations."""
    value, jacobian = np.asarray(at.value), np.asarray(at.jacobian)
    root = np.linalg.qr(np.column_stack([jacobian, value]), mode="r")
    filled = np.zeros((point.size + 1, point.size + 1))
    filled[: len(root)] = root
    return Linear(point, filled[:, -1], filled[:, :-1])


def descend(
    linearised: Callable[[np.ndarray], LinearResidual], start: np.ndarray, tolerance: float, max_steps: int
) -> Descent:
    """Descend by optimistix' Levenberg-Marquardt.

    Args:
        linearised: residuals and their Jacobian at a point (p,); called once a step.
        start: shape (p,).
        tolerance: relative and absolute tolerance of the last step and of its change in the sum of squares.
        max_steps: largest number of points.
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
