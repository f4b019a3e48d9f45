"""The solver wrapper and its covariance on NIST's StRD problems: 22 problems, both starts.

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

from tvsbayes.statistics.least_squares import least_squares_covariance, scaled_gradient, solve_least_squares

FOLDER = Path(__file__).resolve().parents[3] / "shared" / "strd"
PARAMETER_DIGITS, ERROR_DIGITS = 6.0, 5.0
"""The issue's bounds: digits in every parameter and in every standard error."""
PRINTED_DIGITS = 11.0


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
    converged: bool
    problems: tuple[str, ...]


def digits(value: np.ndarray, certified: np.ndarray) -> float:
    """LRE of the worst entry, at most the digits printed."""
    relative = np.abs(value - certified) / np.abs(certified)
    return float(min(PRINTED_DIGITS, -np.log10(max(relative.max(), 1e-300)))) if np.isfinite(relative).all() else 0.0


def score(name: str, start: int) -> Score:
    problem = read_problem(name)
    fit = solve_least_squares(RESIDUALS[name], problem.starts[start], (jnp.asarray(problem.x), jnp.asarray(problem.y)))
    dof = problem.x.size - problem.certified.size
    try:
        covariance = least_squares_covariance(fit.jacobian) * (fit.residuals @ fit.residuals) / dof
        errors = digits(np.sqrt(np.diag(covariance)), problem.sd)
    except np.linalg.LinAlgError:
        errors = 0.0
    return Score(digits(fit.value, problem.certified), errors, fit.converged, fit.problems)


CASES = [pytest.param(name, start, id=f"{name}-start{start + 1}") for name in MODELS for start in (0, 1)]


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(("name", "start"), CASES)
def test_strd(name, start):
    result = score(name, start)
    print(f"{name:10s} start {start + 1}: {result.parameters:5.1f} {result.errors:5.1f} digits {result.problems}")
    assert result.converged, result.problems
    assert result.parameters >= PARAMETER_DIGITS
    assert result.errors >= ERROR_DIGITS


@pytest.mark.usefixtures("x64")
def test_unfinished_run_is_not_converged():
    """Three steps do not reach the minimum, whatever the solver says: the gradient does."""
    b, x = np.array([2.0, 0.5]), np.linspace(0.0, 4.0, 20)
    y = b[0] * np.exp(-b[1] * x) + 0.01 * np.random.default_rng(1).standard_normal(20)

    def residual(value, data):
        return data[1] - value[0] * jnp.exp(-value[1] * data[0])

    args = (jnp.asarray(x), jnp.asarray(y))
    start = np.array([20.0, 5.0])
    short, full = (solve_least_squares(residual, start, args, max_steps=steps) for steps in (3, 2000))
    assert not short.converged and any("gradient" in text for text in short.problems)
    assert full.converged and full.problems == () and full.scaled_gradient < 1e-8
    # Ten standard errors (0.01 each) of 20 observations with sd 0.01.
    assert np.abs(full.value - b).max() < 0.1


@pytest.mark.usefixtures("x64")
def test_perfect_fit_is_converged():
    """No residual is left whose direction could mean anything."""

    def residual(value, data):
        return data @ value - data @ jnp.asarray([1.0, -2.0, 3.0])

    design = np.random.default_rng(2).standard_normal((6, 3))
    fit = solve_least_squares(residual, np.array([5.0, 5.0, 5.0]), jnp.asarray(design))
    assert fit.converged, fit.problems
    np.testing.assert_allclose(fit.value, [1.0, -2.0, 3.0], rtol=1e-10)  # the solver's 1e-12, times the condition


def test_covariance_is_the_inverse_of_the_normal_matrix():
    """For columns of very different size; in units of the resulting standard deviations."""
    jacobian = np.random.default_rng(3).standard_normal((30, 4)) * np.array([1e-6, 1.0, 1e4, 1e9])
    found = least_squares_covariance(jacobian)
    scale = np.linalg.norm(jacobian, axis=0)
    exact = np.linalg.inv((jacobian / scale).T @ (jacobian / scale)) / np.outer(scale, scale)
    sd = np.sqrt(np.diag(exact))
    assert np.abs((found - exact) / np.outer(sd, sd)).max() < 1e-13  # a condition number of order one


def test_no_covariance_without_full_rank():
    jacobian = np.random.default_rng(4).standard_normal((30, 3))
    with pytest.raises(np.linalg.LinAlgError, match="no influence"):
        least_squares_covariance(jacobian * np.array([1.0, 0.0, 1.0]))
    jacobian[:, 2] = jacobian[:, 0] + jacobian[:, 1]
    with pytest.raises(np.linalg.LinAlgError, match="condition number"):
        least_squares_covariance(jacobian)


def test_scaled_gradient_is_the_largest_cosine():
    jacobian = np.array([[1e6, 0.0, 0.0], [0.0, 1e-6, 0.0], [0.0, 0.0, 0.0]])
    assert scaled_gradient(jacobian, np.array([0.6, 0.8, 0.0])) == pytest.approx(0.8, abs=1e-15)
    assert scaled_gradient(jacobian, np.array([0.0, 0.0, 5.0])) == 0.0


if __name__ == "__main__":
    import time

    import jax

    for name in MODELS:
        for start in (0, 1):
            begun = time.perf_counter()
            with jax.enable_x64(True):
                result = score(name, start)
            took = time.perf_counter() - begun
            flags = "converged" if result.converged else "; ".join(result.problems)
            print(
                f"{name:10s} start {start + 1}  {result.parameters:5.1f} {result.errors:5.1f}  {took:5.1f} s  {flags}"
            )
