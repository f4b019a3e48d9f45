"""The fit's last Levenberg-Marquardt stage against `scipy.optimize.least_squares`: same residuals, same start."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import numpy as np

from .measure import Bench, Case, Column, timed

TITLE = "Least squares"
TWIN = "paper_twin"
COST = 1.0
"""In chi-square units: half of it in the log density of 53 parameters. Ends that differ by less are the same."""
TOLERANCE = 1e-6
"""Of every run but the fit's own stage."""
STAGE, EXACT, COMPILATION = "As in the fit", "To the minimum", "Compilation"
OURS = "tvsbayes"
PEERS = {
    STAGE: {"scipy lm, same Jacobian": ("lm", "same"), "scipy trf, same Jacobian": ("trf", "same")},
    EXACT: {
        "scipy lm, same Jacobian": ("lm", "same"),
        "scipy trf, same Jacobian": ("trf", "same"),
        "scipy lm, finite differences": ("lm", "2-point"),
    },
}


def measure(bench: Bench, kinds: Sequence[str] = (STAGE, EXACT)) -> None:
    """Time every solver from one start to its own end, without compilation; compilation apart."""
    kinds = [
        kind
        for kind in kinds
        if bench.missing(kind, (OURS, *PEERS[kind])) or bench.missing(COMPILATION, (f"{OURS}, {kind.lower()}",), 1)
    ]
    if not kinds:
        return
    import jax
    import jax.numpy as jnp
    from scipy import optimize

    from tvsbayes.estimators.joint_fit import STAGE_STEPS, STAGE_TOLERANCE, Fixed, Problem, stage_residuals
    from tvsbayes.estimators.likelihood import innovations
    from tvsbayes.files.disk import shipped_data
    from tvsbayes.instrument.campaign import ordered_spots, read_campaign
    from tvsbayes.instrument.parameters import NAMES
    from tvsbayes.statistics.least_squares import levenberg_marquardt, residuals_and_jacobian

    def exact_residuals(z, args):
        """`stage_residuals` whose derivative holds nothing fixed."""
        space, arrays, fixed = args
        full = jnp.where(fixed.held, fixed.value, z)
        errors = innovations(space.model(full), arrays, fixed.inflation, frozen=False).standardised
        return jnp.concatenate([errors.ravel(), jnp.where(fixed.held, z - fixed.value, z)])

    campaign = read_campaign(shipped_data() / "twins" / TWIN)
    with jax.enable_x64(True):
        problem = Problem(campaign, campaign.rig, np.ones(len(ordered_spots(campaign)), dtype=bool))
        # Annealing reaches the basin; peers are compared on the last stage, where all of them converge.
        first: dict[str, float] = {}
        begun = time.process_time()
        start = problem.least_squares(np.zeros(len(NAMES)), 60.0)
        first[STAGE] = time.process_time() - begun
        for inflation in (10.0, 2.0):
            start = problem.least_squares(start, inflation)
        args = problem.space, problem.arrays, Fixed(jnp.asarray(problem.held), jnp.asarray(start), jnp.asarray(1.0))
        # The residuals' values are the same in both kinds.
        plain = jax.jit(lambda z: stage_residuals(z, args))
        calls = {"residuals": 0, "Jacobians": 0}

        def residuals(z):
            calls["residuals"] += 1
            return np.asarray(plain(jnp.asarray(z)))

        def works(kind: str):
            residual = stage_residuals if kind == STAGE else exact_residuals
            tolerance, steps = (STAGE_TOLERANCE, STAGE_STEPS) if kind == STAGE else (TOLERANCE, 200)

            def ours():
                limit = jnp.asarray(tolerance)
                return np.asarray(levenberg_marquardt(residual, jnp.asarray(start), args, limit, steps))

            def jacobian(z):
                calls["Jacobians"] += 1
                return np.asarray(residuals_and_jacobian(residual, jnp.asarray(z), args)[1])

            def peer(method, slopes):
                options = {"method": method, "xtol": TOLERANCE, "ftol": TOLERANCE, "gtol": TOLERANCE}
                jac = jacobian if slopes == "same" else slopes
                return lambda: optimize.least_squares(residuals, start, jac=jac, **options).x

            return {OURS: ours, **{name: peer(*how) for name, how in PEERS[kind].items()}}

        def once(work):
            def row(_):
                calls.update(residuals=0, Jacobians=0)
                best, cost = timed(work)
                seen = dict(calls) if calls["residuals"] else {}
                return {**cost, "chi2": float(np.sum(residuals(best) ** 2)), **seen}

            return row

        for kind in kinds:
            contenders = works(kind)
            for name, work in contenders.items():
                begun = time.process_time()
                work()
                if name == OURS:
                    # The stage was compiled when the annealing began.
                    first.setdefault(kind, time.process_time() - begun)
            bench.interleaved(kind, {name: once(work) for name, work in contenders.items()})
            told = [r["values"]["cpu_s"] for r in bench.rows if (r["case"], r["contender"]) == (kind, OURS)]
            name = f"{OURS}, {kind.lower()}"
            if bench.missing(COMPILATION, (name,), 1):
                bench.keep(COMPILATION, name, 0, {"cpu_s": first[kind] - float(np.median(told))})


def cases(rows: Sequence[Mapping]) -> list[Case]:
    """Tables of the part."""
    columns = (
        Column("cpu_s", "CPU s"),
        Column("wall_s", "wall s"),
        Column("chi2", "chi-square reached", "{:.3f}"),
        Column("residuals", "residual calls", "{:.0f}"),
        Column("Jacobians", "Jacobian calls", "{:.0f}"),
    )
    stage = (
        "Last stage of the paper twin, 384 spots, the same residuals from the same start (after annealing), without "
        "compilation. The fit's stage holds slopes and projection fixed under differentiation (Kaufman's variable "
        "projection) and only has to reach the basin (tolerance 1e-2, 12 steps): Newton steps on the full density "
        f"finish. scipy is given that Jacobian and {TOLERANCE:g}."
    )
    exact = f"The same residuals and start with their exact Jacobian, everyone to {TOLERANCE:g}."
    compiled = "CPU seconds of the first call less those of a warm one, without the compilation cache."
    return [
        Case(STAGE, stage, columns, "cpu_s"),
        Case(EXACT, exact, columns, "cpu_s"),
        Case(COMPILATION, compiled, (Column("cpu_s", "CPU s"),), ours=""),
    ]


def remarks(rows: Sequence[Mapping]) -> list[str]:
    """Did all reach the same cost?"""
    lines = []
    for kind in (STAGE, EXACT):
        reached = {r["contender"]: r["values"]["chi2"] for r in rows if r["case"] == kind}
        if reached:
            least = min(reached.values())
            above = [f"{name} (+{cost - least:.1f})" for name, cost in reached.items() if cost > least + COST]
            said = f"above it, and no fair comparison of speed: {'; '.join(above)}" if above else "all reached it"
            lines.append(f"{kind}: least chi-square {least:.2f}, to be reached within {COST:g}: {said}.")
    return lines
