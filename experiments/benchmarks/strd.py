"""NIST's StRD problems (22, both starts): digits and time of our solver and of scipy's, with the same Jacobian."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping, Sequence
from unittest import mock

import numpy as np

from .measure import ROOT, Bench, Case, Column, timed

TITLE = "Certified least-squares problems (NIST StRD)"
NAME = "44 fits: 22 problems from both starts"
TIGHT = 1e-15
"""Tolerances of scipy, near the least it takes; ours are the shipped ones."""
DIGITS = 6.0


def measure(bench: Bench) -> None:
    """Fit every problem from both starts, all solvers in turn."""
    sys.path.insert(0, str(ROOT / "tests"))
    import jax
    import jax.numpy as jnp
    import test_solver as strd
    from scipy import optimize

    from tvsbayes.statistics.least_squares import (
        least_squares_covariance,
        levenberg_marquardt,
        residuals_and_jacobian,
        solve_least_squares,
    )

    if not strd.FOLDER.is_dir():
        print(f"strd: skipped, NIST's files are not at {strd.FOLDER.name} beside the repository", flush=True)
        return
    with jax.enable_x64(True):
        problems = {name: strd.read_problem(name) for name in strd.MODELS}
        data = {name: (jnp.asarray(p.x), jnp.asarray(p.y)) for name, p in problems.items()}
        plain = {name: jax.jit(residual) for name, residual in strd.RESIDUALS.items()}

        def ours(name, start):
            return solve_least_squares(strd.RESIDUALS[name], start, data[name]).value

        def bare(name, start):
            tolerance = jnp.asarray(1e-12)
            residual = strd.RESIDUALS[name]
            return np.asarray(levenberg_marquardt(residual, jnp.asarray(start), data[name], tolerance, 10_000))

        def peer(method):
            def solve(name, start):
                def residual(b):
                    return np.asarray(plain[name](jnp.asarray(b), data[name]))

                def jacobian(b):
                    return np.asarray(residuals_and_jacobian(strd.RESIDUALS[name], jnp.asarray(b), data[name])[1])

                options = {"xtol": TIGHT, "ftol": TIGHT, "gtol": TIGHT, "max_nfev": 10_000, "x_scale": "jac"}
                return optimize.least_squares(residual, start, jac=jacobian, method=method, **options).x

            return solve

        def usual(name, start):
            """As without JAX: the models in NumPy, slopes by differences."""
            problem = problems[name]
            with mock.patch.object(strd, "jnp", np):
                return optimize.least_squares(
                    strd.RESIDUALS[name],
                    start,
                    args=((problem.x, problem.y),),
                    method="lm",
                    x_scale="jac",
                    xtol=TIGHT,
                    ftol=TIGHT,
                    gtol=TIGHT,
                    max_nfev=100_000,
                ).x

        def digits(name, value):
            problem = problems[name]
            residual, jacobian = residuals_and_jacobian(strd.RESIDUALS[name], jnp.asarray(value), data[name])
            residual, jacobian = np.asarray(residual), np.asarray(jacobian)
            try:
                covariance = least_squares_covariance(jacobian) * (residual @ residual)
                sd = np.sqrt(np.diag(covariance) / (problem.x.size - value.size))
                errors = strd.digits(sd, problem.sd)
            except (np.linalg.LinAlgError, ValueError):
                errors = 0.0
            return max(strd.digits(value, problem.certified), 0.0), max(errors, 0.0)

        def all_of(solve):
            def row(_):
                found, failed = {}, []

                def work():
                    for name, problem in problems.items():
                        for start in (0, 1):
                            try:
                                found[name, start] = solve(name, problem.starts[start])
                            except (ValueError, np.linalg.LinAlgError):
                                found[name, start] = np.full(problem.certified.size, np.nan)

                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", RuntimeWarning)
                    _, cost = timed(work)
                    told = {key: digits(key[0], value) for key, value in found.items()}
                failed = [f"{name} start {start + 1}" for (name, start), d in told.items() if d[0] < DIGITS]
                parameters, errors = np.array(list(told.values())).T
                return {
                    **cost,
                    "good": int(np.sum(parameters >= DIGITS)),
                    "least": float(parameters.min()),
                    "median": float(np.median(parameters)),
                    "least_error": float(errors.min()),
                    "failed": failed,
                }

            return row

        works = {
            "tvsbayes": ours,
            "tvsbayes, one run without restart and checks": bare,
            "scipy lm": peer("lm"),
            "scipy trf": peer("trf"),
            "scipy lm, NumPy and finite differences": usual,
        }
        if not bench.missing(NAME, list(works)):
            return
        for solve in (ours, peer("lm")):
            all_of(solve)(0)
        bench.interleaved(NAME, {name: all_of(solve) for name, solve in works.items()})


def cases(rows: Sequence[Mapping]) -> list[Case]:
    """Tables of the part."""
    about = (
        "Digits agree with the certified values (at most 11 are printed by NIST): of the worst parameter of a fit, and "
        f"of the worst standard error. `tvsbayes` is `solve_least_squares` as shipped, two runs and the checks; "
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
