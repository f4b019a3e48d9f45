"""The fit's last Levenberg-Marquardt stage against `scipy.optimize.least_squares`: same residuals, same start."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import numpy as np

from .measure import Bench, Case, Column, timed

TITLE = "Least squares"
TWIN = "paper_twin"
COST = 2.0
"""In chi-square units: solutions whose costs differ by less are the same here, where 53 parameters are fitted; the
log density differs by half of it."""
TOLERANCE = 1e-6
COMPILATION = "Compilation"
STAGE, EXACT = "tvsbayes, as in the fit", "tvsbayes, exact Jacobian"
SOLVERS = {
    "scipy lm, the fit's Jacobian": ("lm", "fit"),
    "scipy lm, exact Jacobian": ("lm", "exact"),
    "scipy trf, exact Jacobian": ("trf", "exact"),
    "scipy lm, finite differences": ("lm", "2-point"),
}
NAME = "Last stage of the paper twin, 384 spots"


def measure(bench: Bench) -> None:
    """Time every solver from one start to its own end, without compilation; compilation apart."""
    own = (STAGE, EXACT)
    if not (bench.missing(NAME, (*own, *SOLVERS)) or bench.missing(COMPILATION, own, 1)):
        return
    import jax
    import jax.numpy as jnp
    from scipy import optimize

    from tvsbayes.campaign import read_campaign
    from tvsbayes.files import shipped_data
    from tvsbayes.joint import (
        STAGE_STEPS,
        STAGE_TOLERANCE,
        Fixed,
        Problem,
        levenberg_marquardt,
        residuals_and_jacobian,
        stage_residuals,
    )
    from tvsbayes.likelihood import innovations, ordered_spots
    from tvsbayes.model import NAMES

    campaign = read_campaign(shipped_data() / "twins" / TWIN)

    def exact_residuals(z, args):
        """`stage_residuals` whose derivative holds nothing fixed."""
        space, arrays, fixed = args
        full = jnp.where(fixed.held, fixed.value, z)
        errors = innovations(space.model(full), arrays, fixed.inflation, frozen=False).standardised
        return jnp.concatenate([errors.ravel(), jnp.where(fixed.held, z - fixed.value, z)])

    with jax.enable_x64(True):
        problem = Problem(campaign, campaign.rig, np.ones(len(ordered_spots(campaign)), dtype=bool))
        # Annealing reaches the basin; peers are compared on the last stage, where all of them converge.
        begun = time.process_time()
        start = problem.least_squares(np.zeros(len(NAMES)), 60.0)
        first = {STAGE: time.process_time() - begun}
        for inflation in (10.0, 2.0):
            start = problem.least_squares(start, inflation)
        fixed = Fixed(jnp.asarray(problem.held), jnp.asarray(start), jnp.asarray(1.0))
        args = (problem.space, problem.arrays, fixed)
        plain = jax.jit(lambda z: stage_residuals(z, args))
        calls = {"residuals": 0, "Jacobians": 0}

        def residuals(z):
            calls["residuals"] += 1
            return np.asarray(plain(jnp.asarray(z)))

        def jacobian_of(residual):
            def jacobian(z):
                calls["Jacobians"] += 1
                return np.asarray(residuals_and_jacobian(residual, jnp.asarray(z), args)[1])

            return jacobian

        def ours(residual, tolerance, steps):
            z, limit = jnp.asarray(start), jnp.asarray(tolerance)
            return lambda: np.asarray(levenberg_marquardt(residual, z, args, limit, steps))

        def peer(method, jac):
            options = {"method": method, "xtol": TOLERANCE, "ftol": TOLERANCE, "gtol": TOLERANCE}
            return lambda: optimize.least_squares(residuals, start, jac=jac, **options).x

        slopes = {"fit": jacobian_of(stage_residuals), "exact": jacobian_of(exact_residuals), "2-point": "2-point"}
        works = {
            STAGE: ours(stage_residuals, STAGE_TOLERANCE, STAGE_STEPS),
            EXACT: ours(exact_residuals, TOLERANCE, 200),
            **{name: peer(method, slopes[jac]) for name, (method, jac) in SOLVERS.items()},
        }
        for name, work in works.items():
            begun = time.process_time()
            work()
            first.setdefault(name, time.process_time() - begun)

        def once(work):
            def row(_):
                calls.update(residuals=0, Jacobians=0)
                best, cost = timed(work)
                seen = dict(calls) if calls["residuals"] else {}
                return {**cost, "chi2": float(np.sum(residuals(best) ** 2)), **seen}

            return row

        bench.interleaved(NAME, {name: once(work) for name, work in works.items()})
        for name in own:
            if bench.missing(COMPILATION, (name,), 1):
                warm = np.median([r["values"]["cpu_s"] for r in bench.rows if r["contender"] == name])
                bench.keep(COMPILATION, name, 0, {"cpu_s": first[name] - float(warm)})


def cases(rows: Sequence[Mapping]) -> list[Case]:
    """Tables of the part."""
    about = (
        "One start (after annealing), the same residuals for all; seconds without compilation. The fit's stage has "
        "the Jacobian of variable projection in Kaufman's form and stops in the basin (tolerance 1e-2, 12 steps): "
        "Newton steps on the full density finish. All others run to 1e-6."
    )
    columns = (
        Column("cpu_s", "CPU s"),
        Column("wall_s", "wall s"),
        Column("chi2", "chi-square reached", "{:.3f}"),
        Column("residuals", "residual calls", "{:.0f}"),
        Column("Jacobians", "Jacobian calls", "{:.0f}"),
    )
    compiled = "CPU seconds of the first call less those of a warm one, without the compilation cache."
    return [
        Case(NAME, about, columns, "cpu_s", EXACT),
        Case(COMPILATION, compiled, (Column("cpu_s", "CPU s"),), ours=""),
    ]


def remarks(rows: Sequence[Mapping]) -> list[str]:
    """Which reached the same cost."""
    reached = {r["contender"]: r["values"]["chi2"] for r in rows if r["case"] == NAME}
    if not reached:
        return []
    least = min(reached.values())
    same = [name for name, cost in reached.items() if cost < least + COST]
    others = [f"{name} (+{cost - least:.1f})" for name, cost in reached.items() if name not in same]
    text = f"Same final cost, within {COST:g} of the least chi-square {least:.2f}: {'; '.join(same)}."
    return [text + (f" Above it, and no fair comparison of speed: {'; '.join(others)}." if others else "")]
