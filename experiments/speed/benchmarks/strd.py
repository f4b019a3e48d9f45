"""NIST's StRD problems (22, both starts): digits and time of our solver and of scipy's, with the same Jacobian."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize

from experiments.common.clock import timed
from experiments.common.of_tests import module_of_tests
from experiments.speed.benchmarks.measure import Bench, Case, Column, Work
from tvsbayes.statistics.least_squares import least_squares_covariance, residuals_and_jacobian

TITLE = "Certified least-squares problems (NIST StRD)"
NAME = "44 fits: 22 problems from both starts"
TIGHT = 1e-15
"""Tolerances of scipy, near the least it takes; ours are the shipped ones."""
DIGITS = 6.0
SCIPY = {"xtol": TIGHT, "ftol": TIGHT, "gtol": TIGHT, "x_scale": "jac"}


Solve = Callable[[str, np.ndarray], np.ndarray]
"""From a problem's name and a start to where a solver ends."""


class Problems:
    """The certified problems of `tests/support/certified_problems.py` and their solvers; float64 has to be on."""

    def __init__(self, strd: ModuleType):
        self.strd = strd
        self.of = {name: strd.read_problem(name) for name in strd.MODELS}
        self.data = {name: (jnp.asarray(p.x), jnp.asarray(p.y)) for name, p in self.of.items()}
        self.plain = {name: jax.jit(residual) for name, residual in strd.RESIDUALS.items()}

    def residuals(self, name: str, value: np.ndarray) -> np.ndarray:
        """Compiled."""
        return np.asarray(self.plain[name](jnp.asarray(value), self.data[name]))

    def jacobian(self, name: str, value: np.ndarray) -> np.ndarray:
        """By JAX."""
        residual = self.strd.RESIDUALS[name]
        return np.asarray(residuals_and_jacobian(residual, jnp.asarray(value), self.data[name]).jacobian)

    def ours(self, name: str, start: np.ndarray) -> np.ndarray:
        """The descent of `stereo` and of the fit, with residuals and Jacobian at its end."""
        return self.strd.descended(self.strd.RESIDUALS[name], start, self.data[name]).value

    def peer(self, method: str) -> Solve:
        """Scipy with the same residuals and Jacobian."""

        def solve(name: str, start: np.ndarray) -> np.ndarray:
            options = {**SCIPY, "method": method, "max_nfev": 10_000}
            return optimize.least_squares(
                lambda b: self.residuals(name, b), start, jac=lambda b: self.jacobian(name, b), **options
            ).x

        return solve

    def usual(self, name: str, start: np.ndarray) -> np.ndarray:
        """Scipy as without JAX: the models in NumPy, slopes by differences."""
        problem, options = self.of[name], {**SCIPY, "method": "lm", "max_nfev": 100_000}
        with mock.patch.object(self.strd, "jnp", np):
            residual = self.strd.RESIDUALS[name]
            return optimize.least_squares(residual, start, args=((problem.x, problem.y),), **options).x

    def digits(self, name: str, value: np.ndarray) -> tuple[float, float]:
        """Of the worst parameter and of the worst standard error."""
        problem = self.of[name]
        residual, jacobian = self.residuals(name, value), self.jacobian(name, value)
        try:
            covariance = least_squares_covariance(jacobian) * (residual @ residual)
            sd = np.sqrt(np.diag(covariance) / (problem.x.size - value.size))
            errors = self.strd.digits(sd, problem.sd)
        except (np.linalg.LinAlgError, ValueError):
            errors = 0.0
        return max(self.strd.digits(value, problem.certified), 0.0), max(errors, 0.0)

    def solved(self, solve: Solve) -> dict[tuple[str, int], np.ndarray]:
        """Every problem from both starts, NaN where a solver gave up."""
        solutions = {}
        for name, problem in self.of.items():
            for start in (0, 1):
                try:
                    solutions[name, start] = solve(name, problem.starts[start])
                except (ValueError, np.linalg.LinAlgError):
                    solutions[name, start] = np.full(problem.certified.size, np.nan)
        return solutions

    def row_of(self, solve: Solve) -> Work:
        """All problems, timed and compared with the certified values."""

        def row(_: int) -> dict[str, object]:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)
                solutions, cost = timed(lambda: self.solved(solve))
                digits = {key: self.digits(key[0], value) for key, value in solutions.items()}
            parameters, errors = np.array(list(digits.values())).T
            return {
                **cost,
                "good": int(np.sum(parameters >= DIGITS)),
                "least": float(parameters.min()),
                "median": float(np.median(parameters)),
                "least_error": float(errors.min()),
                "failed": [f"{name} start {start + 1}" for (name, start), d in digits.items() if d[0] < DIGITS],
            }

        return row


def measure(bench: Bench) -> None:
    """Fit every problem from both starts, all solvers in turn."""
    strd = module_of_tests("support.certified_problems")
    if not strd.FOLDER.is_dir():
        print(f"strd: skipped, NIST's files are not at {strd.FOLDER.name} beside the repository", flush=True)
        return
    with jax.enable_x64(True):
        problems = Problems(strd)
        solvers = {
            "tvsbayes": problems.ours,
            "scipy lm": problems.peer("lm"),
            "scipy trf": problems.peer("trf"),
            "scipy lm, NumPy and finite differences": problems.usual,
        }
        if not bench.missing(NAME, list(solvers)):
            return
        for solve in (problems.ours, problems.peer("lm")):
            problems.row_of(solve)(0)
        bench.interleaved(NAME, {name: problems.row_of(solve) for name, solve in solvers.items()})


def cases() -> list[Case]:
    """Tables of the part."""
    about = (
        "Digits agree with the certified values (at most 11 are printed by NIST): of the worst parameter of a fit, and "
        f"of the worst standard error. `tvsbayes` is the descent of `stereo` and of the fit; "
        f"scipy has tolerances {TIGHT:g}, `x_scale='jac'` and the same compiled residuals and Jacobian, each call of "
        "which costs it 0.1 ms or more from Python; or, as most use it, NumPy and finite differences. Seconds are of "
        "all 44, without compilation."
    )
    columns = (
        Column("good", f"fits with {DIGITS:g} digits", "{:.0f}"),
        Column("least", "digits, least", "{:.1f}"),
        Column("median", "median", "{:.1f}"),
        Column("least_error", "standard errors, least", "{:.1f}"),
        Column("cpu_s", "CPU s"),
    )
    return [Case(NAME, about, columns, "cpu_s")]


def remarks(rows: Sequence[Mapping]) -> list[str]:
    """Which fits each solver missed."""
    missed = {r["contender"]: r["values"]["failed"] for r in rows}
    return [f"Below {DIGITS:g} digits, {name}: {', '.join(f)}." for name, f in missed.items() if f]
