"""Levenberg-Marquardt, Newton mode, Laplace draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, PyTree

TIGHT = 1e-12
"""Relative and absolute tolerance that solved 44 of 44 StRD fits; 1e-8 still accepted one wrong answer."""
SCALED_GRADIENT_LIMIT = 1e-8
"""Largest |J_j . r| / (|J_j| |r|) of a stationary point."""
POLISHING_STEPS = 5
POLISHABLE_GRADIENT = 1e-6
"""Scaled gradients that Gauss-Newton steps may still reduce; above it the run has not arrived."""
RESTART_PERTURBATION = 1e-3
"""Relative perturbation of the restart."""
RESTART_AGREEMENT_SD = 1e-2
"""A restart that ends within this many standard errors of the first solution has returned to it."""
NEWTON_STEP = 1e-4
"""Finite-difference step of the Hessian in posterior standard deviations: third derivatives are of order one
there, so the error is 1e-4; the gradient's rounding (1e-9) is amplified to 1e-5."""
NEWTON_SETTLED = 1e-8
"""Squared Newton step, in posterior sds, at which the mode is reached."""
HESSIAN_KEPT = 0.1
"""The Hessian is taken anew if the mode moved farther than this many sds since it was computed."""
LAPLACE_DRAWS = 2048
Objective = Callable[[np.ndarray], tuple[float, np.ndarray]]
Residual = Callable[[Float[Array, " parameters"], PyTree], Float[Array, " residuals"]]


@dataclass(frozen=True)
class LeastSquares:
    """Outcome of a least-squares fit.

    Attributes:
        value: parameters at the solution, shape (p,).
        residuals: residuals there, shape (n,).
        jacobian: d(residuals)/d(parameters) there, shape (n, p).
        scaled_gradient: largest cosine between a column of the Jacobian and the residuals.
        converged: gradient small and, if asked for, the restart returned.
        problems: sentences on what failed; empty when converged.
    """

    value: np.ndarray
    residuals: np.ndarray
    jacobian: np.ndarray
    scaled_gradient: float
    converged: bool
    problems: tuple[str, ...]


def damped_solver(tolerance: Float[Array, ""]) -> optx.LevenbergMarquardt:
    """Levenberg-Marquardt whose damping falls tenfold after every step that the linear model predicted well.

    By default optimistix asks for 99 % agreement and divides by 3.5: in directions that only a prior holds, where
    the damping is as large as the curvature, it then creeps.
    """
    solver = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance, linear_solver=lx.QR())
    search = optx.ClassicalTrustRegion(high_cutoff=0.75, low_cutoff=0.1, high_constant=10.0, low_constant=0.2)
    return eqx.tree_at(lambda s: s.search, solver, search)


def with_dense_jacobian(residual: Residual) -> Residual:
    """The same residual, whose derivative is one matrix.

    A Levenberg-Marquardt step asks its linear model for columns, for products and for transposed products. Left to
    itself JAX compiles (and runs) the residual's tangent code once for each; here it is compiled once, to fill the
    matrix, and everything else is a product with it.
    """

    @eqx.filter_custom_jvp
    def dense(value, *, args):
        return residual(value, args)

    @dense.def_jvp
    def dense_jvp(primals, tangents, *, args):
        (value,), (direction,) = primals, tangents
        residuals, jacobian = jacobian_of(residual, value, args)
        return residuals, jacobian @ direction

    return lambda value, args: dense(value, args=args)


def jacobian_of(
    residual: Residual, value: Float[Array, " parameters"], args: PyTree
) -> tuple[Float[Array, " residuals"], Float[Array, "residuals parameters"]]:
    """Residuals and their Jacobian, the tangents of all parameters pushed forward side by side."""
    residuals, push = jax.linearize(lambda x: residual(x, args), value)
    return residuals, jax.vmap(push, out_axes=1)(jnp.eye(value.size))


residuals_and_jacobian = eqx.filter_jit(jacobian_of)


@eqx.filter_jit
def levenberg_marquardt(
    residual: Residual,
    start: Float[Array, " parameters"],
    args: PyTree,
    tolerance: Float[Array, ""],
    max_steps: int,
) -> Float[Array, " parameters"]:
    """One Levenberg-Marquardt run; tolerances are traced so that every stage of a fit shares the compilation."""
    solver = damped_solver(tolerance)
    solution = optx.least_squares(with_dense_jacobian(residual), solver, start, args, max_steps=max_steps, throw=False)
    return solution.value


@dataclass(frozen=True)
class Mode:
    """Outcome of the Newton steps: `covariance` is the inverse Hessian over all coordinates."""

    z: np.ndarray
    covariance: np.ndarray
    negative_log_density: float
    problems: tuple[str, ...]


def newton_mode(objective: Objective, start: np.ndarray, free: np.ndarray, curvature: np.ndarray) -> Mode:
    """Newton steps to the minimum of a negative log density, with its Hessian by differences of the gradient.

    The differences are taken in coordinates whitened by `curvature`: the Hessian is near the identity there, and
    directions that differ by eight orders of magnitude in stiffness are equally well resolved.

    Args:
        objective: negative log density and its gradient.
        start: near the mode, shape (p,).
        free: coordinates that move; the others keep their place and unit variance.
        curvature: positive definite guess of the Hessian, shape (p, p).

    Returns:
        The mode and its covariance.
    """
    rows = np.flatnonzero(free)
    z = start
    value, slope = objective(z)
    root = np.linalg.inv(np.linalg.cholesky(curvature[np.ix_(rows, rows)])).T
    problems: list[str] = []
    for _ in range(6):
        begin = z
        columns = []
        for column in root.T:
            nudged = z.copy()
            nudged[rows] += NEWTON_STEP * column
            columns.append((objective(nudged)[1] - slope)[rows] / NEWTON_STEP)
        hessian = root.T @ np.stack(columns, axis=1)
        eigenvalues, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
        # Far from the mode the density may be flat or convex along a direction: step by the expected scale.
        inverse = (vectors / np.maximum(np.abs(eigenvalues), 0.1)) @ vectors.T
        settled = False
        for _ in range(12):
            step = -inverse @ (root.T @ slope[rows])
            if step @ step < NEWTON_SETTLED:
                settled = True
                break
            for halving in range(12):
                trial = z.copy()
                trial[rows] += root @ step / 2**halving
                trial_value, trial_slope = objective(trial)
                if np.isfinite(trial_value) and trial_value < value + 1e-9 * abs(value):
                    break
            else:
                break
            z, value, slope = trial, trial_value, trial_slope
        root_inverse_move = np.linalg.solve(root, (z - begin)[rows])
        if settled and np.linalg.norm(root_inverse_move) < HESSIAN_KEPT:
            break
        root = root @ (vectors / np.sqrt(np.maximum(np.abs(eigenvalues), 0.1))) @ vectors.T
    else:
        problems.append("the Newton steps on the full density did not settle")
    if eigenvalues[0] <= 0:
        problems.append("the density has no maximum here: its Hessian is not negative definite")
    whitened = (vectors / np.maximum(eigenvalues, 1e-3)) @ vectors.T
    covariance = np.eye(z.size)
    covariance[np.ix_(rows, rows)] = root @ whitened @ root.T
    return Mode(z, covariance, value, tuple(problems))


def laplace_draws(z: np.ndarray, covariance: np.ndarray, seed: int) -> np.ndarray:
    """Normal draws whose sample mean and covariance are exactly the given ones.

    Antithetic pairs fix the mean, a Cholesky factor of the sample covariance fixes the rest: standard deviations of
    linear quantities then carry no Monte Carlo error.
    """
    half = np.random.default_rng(seed).standard_normal((LAPLACE_DRAWS // 2, z.size))
    normal = np.concatenate([half, -half])
    normal = normal @ np.linalg.inv(np.linalg.cholesky(normal.T @ normal / len(normal))).T
    return z + normal @ np.linalg.cholesky(covariance).T


def scaled_gradient(jacobian: np.ndarray, residuals: np.ndarray) -> float:
    """Largest |J_j . r| / (|J_j| |r|); 0 where residuals or a column vanish."""
    norms = np.linalg.norm(jacobian, axis=0) * np.linalg.norm(residuals)
    products = np.abs(jacobian.T @ residuals)
    return float(np.max(np.divide(products, norms, out=np.zeros_like(products), where=norms > 0)))


def least_squares_covariance(jacobian: np.ndarray) -> np.ndarray:
    """(J^T J)^-1 by a singular value decomposition of the column-scaled Jacobian.

    Args:
        jacobian: shape (n, p), of full column rank.

    Returns:
        Covariance for residuals of unit variance, shape (p, p).

    Raises:
        np.linalg.LinAlgError: if the scaled condition number exceeds 1e13; no covariance exists then.
    """
    scale = np.linalg.norm(jacobian, axis=0)
    if not np.all(scale > 0):
        raise np.linalg.LinAlgError("a parameter has no influence on any residual")
    _, singular, vt = np.linalg.svd(jacobian / scale, full_matrices=False)
    if singular[-1] < 1e-13 * singular[0]:
        raise np.linalg.LinAlgError(f"scaled condition number {singular[0] / max(singular[-1], 1e-300):.1e}")
    root = vt.T / singular / scale[:, None]
    return root @ root.T


def solve_least_squares(
    residual: Residual, start: np.ndarray, args: PyTree = None, *, max_steps: int = 10_000, restart: bool = True
) -> LeastSquares:
    """Fit and check (research/statistics.md section 1).

    Args:
        residual: function (parameters, args) -> residuals; pass the same function object to reuse its compilation.
        start: starting parameters, shape (p,).
        args: whatever the residual needs, as arrays.
        max_steps: budget of Levenberg-Marquardt steps.
        restart: repeat from a point perturbed by `RESTART_PERTURBATION` and demand that it returns.

    Returns:
        The better of both solutions with its checks.
    """
    with jax.enable_x64(True):
        tolerance = jnp.asarray(TIGHT)
        value = np.asarray(levenberg_marquardt(residual, jnp.asarray(start, float), args, tolerance, max_steps))
        residuals, jacobian = (np.asarray(x) for x in residuals_and_jacobian(residual, jnp.asarray(value), args))
        problems = []
        if restart:
            signs = np.where(np.arange(value.size) % 2 == 0, 1.0, -1.0)
            moved = value * (1 + RESTART_PERTURBATION * signs)
            again = np.asarray(levenberg_marquardt(residual, jnp.asarray(moved), args, tolerance, max_steps))
            residuals2, jacobian2 = (np.asarray(x) for x in residuals_and_jacobian(residual, jnp.asarray(again), args))
            try:
                dof = max(residuals.size - value.size, 1)
                sd = np.sqrt(np.diag(least_squares_covariance(jacobian)) * (residuals @ residuals) / dof)
                if np.any(np.abs(again - value) > RESTART_AGREEMENT_SD * sd + 1e-9 * np.abs(value)):
                    problems.append("a restart from a slightly perturbed point ended elsewhere")
            except np.linalg.LinAlgError as error:
                problems.append(f"the Jacobian is singular: {error}")
            if residuals2 @ residuals2 < residuals @ residuals:
                value, residuals, jacobian = again, residuals2, jacobian2
        gradient = scaled_gradient(jacobian, residuals)
        # The sum of squares is flat to rounding within 1e-8 of its minimum; Gauss-Newton steps see the gradient.
        for _ in range(POLISHING_STEPS):
            if not SCALED_GRADIENT_LIMIT < gradient < POLISHABLE_GRADIENT:
                break
            trial = value - np.linalg.lstsq(jacobian, residuals, rcond=None)[0]
            residuals2, jacobian2 = (np.asarray(x) for x in residuals_and_jacobian(residual, jnp.asarray(trial), args))
            if not scaled_gradient(jacobian2, residuals2) < gradient:
                break
            value, residuals, jacobian = trial, residuals2, jacobian2
            gradient = scaled_gradient(jacobian, residuals)
        if not np.all(np.isfinite(residuals)):
            problems.append("residuals are not finite")
        # At a perfect fit the residuals are rounding errors and their direction means nothing.
        elif gradient > SCALED_GRADIENT_LIMIT and np.linalg.norm(residuals) > 1e-12 * np.linalg.norm(jacobian @ value):
            problems.append(f"scaled gradient {gradient:.1e} above {SCALED_GRADIENT_LIMIT:.0e}")
    return LeastSquares(value, residuals, jacobian, gradient, not problems, tuple(problems))
