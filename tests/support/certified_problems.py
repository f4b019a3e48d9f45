"""NIST's certified least-squares problems (StRD): 22 models, data, certified values, and the digits of a fit of ours.

Score: LRE = -log10(|x - certified| / |certified|), the number of digits. Certified values carry 11 digits. Standard
errors follow n - p degrees of freedom throughout (Rat43.dat states another number, but its errors use n - p).
Run as a script, this file prints the table.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from tvsbayes.model.descent import descend
from tvsbayes.statistics.least_squares import residuals_and_jacobian

FOLDER = Path(__file__).resolve().parents[3] / "shared" / "strd"
PRINTED_DIGITS = 11.0
TOLERANCE, STEPS = 1e-12, 10_000
"""Relative and absolute tolerance in the problems' own units; 1e-8 still accepts one wrong answer."""


def least_squares_covariance(jacobian: np.ndarray) -> np.ndarray:
    """Compute (J^T J)^-1 by a singular value decomposition of the column-scaled Jacobian.

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


def _rational(b, x, degree):
    top = sum(b[k] * x**k for k in range(degree + 1))
    return top / (1 + sum(b[degree + k] * x**k for k in range(1, degree + 1)))


def _gauss(b, x):
    peaks = b[2] * jnp.exp(-((x - b[3]) ** 2) / b[4] ** 2) + b[5] * jnp.exp(-((x - b[6]) ** 2) / b[7] ** 2)
    return b[0] * jnp.exp(-b[1] * x) + peaks


def _enso(b, x):
    def wave(first, second, period):
        return first * jnp.cos(2 * jnp.pi * x / period) + second * jnp.sin(2 * jnp.pi * x / period)

    return b[0] + wave(b[1], b[2], 12.0) + wave(b[4], b[5], b[3]) + wave(b[7], b[8], b[6])


MODELS = {
    "Bennett5": lambda b, x: b[0] * (b[1] + x) ** (-1 / b[2]),
    "BoxBOD": lambda b, x: b[0] * (1 - jnp.exp(-b[1] * x)),
    "Chwirut1": lambda b, x: jnp.exp(-b[0] * x) / (b[1] + b[2] * x),
    "Chwirut2": lambda b, x: jnp.exp(-b[0] * x) / (b[1] + b[2] * x),
    "DanWood": lambda b, x: b[0] * x ** b[1],
    "ENSO": _enso,
    "Eckerle4": lambda b, x: b[0] / b[1] * jnp.exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "Gauss1": _gauss,
    "Hahn1": lambda b, x: _rational(b, x, 3),
    "Kirby2": lambda b, x: _rational(b, x, 2),
    "Lanczos3": lambda b, x: sum(b[2 * k] * jnp.exp(-b[2 * k + 1] * x) for k in range(3)),
    "MGH09": lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "MGH10": lambda b, x: b[0] * jnp.exp(b[1] / (x + b[2])),
    "MGH17": lambda b, x: b[0] + b[1] * jnp.exp(-x * b[3]) + b[2] * jnp.exp(-x * b[4]),
    "Misra1a": lambda b, x: b[0] * (1 - jnp.exp(-b[1] * x)),
    "Misra1b": lambda b, x: b[0] * (1 - (1 + b[1] * x / 2) ** -2),
    "Misra1c": lambda b, x: b[0] * (1 - (1 + 2 * b[1] * x) ** -0.5),
    "Misra1d": lambda b, x: b[0] * b[1] * x / (1 + b[1] * x),
    "Rat42": lambda b, x: b[0] / (1 + jnp.exp(b[1] - b[2] * x)),
    "Rat43": lambda b, x: b[0] / (1 + jnp.exp(b[1] - b[2] * x)) ** (1 / b[3]),
    "Roszman1": lambda b, x: b[0] - b[1] * x - jnp.arctan(b[2] / (x - b[3])) / jnp.pi,
    "Thurber": lambda b, x: _rational(b, x, 3),
}


def _residual(model):
    def residual(b, data):
        x, y = data
        return y - model(b, x)

    return residual


# One function object per problem: both starts and their restarts share its compilation.
RESIDUALS = {name: _residual(model) for name, model in MODELS.items()}


@dataclass(frozen=True)
class Problem:
    """One StRD file: starts (2, p), certified values and standard deviations (p,), data (n,)."""

    starts: np.ndarray
    certified: np.ndarray
    sd: np.ndarray
    x: np.ndarray
    y: np.ndarray


def read_problem(name: str) -> Problem:
    path = FOLDER / f"{name}.dat"
    if not path.is_file():
        pytest.skip(f"NIST's {path.name} is not at {FOLDER}: the StRD files are not part of the project")
    lines = path.read_text().splitlines()
    rows = [re.findall(r"[-+.\dE]+", line.split("=")[1]) for line in lines if re.match(r"\s*b\d+ =", line)]
    table = np.array(rows, dtype=float)
    begin = max(i for i, line in enumerate(lines) if line.startswith("Data:"))
    y, x = np.array([line.split() for line in lines[begin + 1 :] if line.strip()], dtype=float).T
    return Problem(table[:, :2].T, table[:, 2], table[:, 3], x, y)


@dataclass(frozen=True)
class Score:
    """Digits of the worst parameter and the worst standard error of one fit."""

    parameters: float
    errors: float


def digits(value: np.ndarray, certified: np.ndarray) -> float:
    """LRE of the worst entry, at most the digits printed."""
    relative = np.abs(value - certified) / np.abs(certified)
    return float(min(PRINTED_DIGITS, -np.log10(max(relative.max(), 1e-300)))) if np.isfinite(relative).all() else 0.0


@dataclass(frozen=True)
class End:
    """Where a descent ended."""

    value: np.ndarray
    residuals: np.ndarray
    jacobian: np.ndarray


def descended(residual, start: np.ndarray, args) -> End:
    value = descend(
        lambda at: residuals_and_jacobian(residual, jnp.asarray(at), args), np.asarray(start), TOLERANCE, STEPS
    ).value
    linear = residuals_and_jacobian(residual, value, args)
    return End(np.asarray(value), np.asarray(linear.value), np.asarray(linear.jacobian))


def score(name: str, start: int) -> Score:
    problem = read_problem(name)
    end = descended(RESIDUALS[name], problem.starts[start], (jnp.asarray(problem.x), jnp.asarray(problem.y)))
    dof = problem.x.size - problem.certified.size
    try:
        covariance = least_squares_covariance(end.jacobian) * (end.residuals @ end.residuals) / dof
        errors = digits(np.sqrt(np.diag(covariance)), problem.sd)
    except np.linalg.LinAlgError:
        errors = 0.0
    return Score(digits(end.value, problem.certified), errors)


if __name__ == "__main__":
    import time

    import jax

    for name in MODELS:
        for start in (0, 1):
            begun = time.perf_counter()
            with jax.enable_x64(True):
                result = score(name, start)
            took = time.perf_counter() - begun
            print(f"{name:10s} start {start + 1}  {result.parameters:5.1f} {result.errors:5.1f}  {took:5.1f} s")
