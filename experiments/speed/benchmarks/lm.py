"""The fit's last Levenberg-Marquardt stage against `scipy.optimize.least_squares`: same residuals, same start."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

import jax
import numpy as np

from experiments.common.clock import timed
from experiments.common.rigs import twin_campaign
from experiments.speed.benchmarks.measure import Bench, Case, Column, Work
from experiments.speed.last_stage import PEER_TOLERANCE, LastStage, exact_residuals, last_stage, stage_residuals
from tvsbayes.estimators.annealed_stage import STAGE_STEPS, STAGE_TOLERANCE

TITLE = "Least squares"
TWIN = "paper_twin"
COST = 1.0
"""In chi-square units: half of it in the log density of 53 parameters. Ends that differ by less are the same."""
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
    kinds = [kind for kind in kinds if bench.missing(kind, (OURS, *PEERS[kind])) or missing_compilation(bench, kind)]
    if not kinds:
        return
    with jax.enable_x64(True):
        stage = last_stage(twin_campaign(TWIN))

        def once(work: Callable[[], np.ndarray]) -> Work:
            def row(_: int) -> dict[str, object]:
                stage.calls.update(residuals=0, Jacobians=0)
                best, cost = timed(work)
                calls = dict(stage.calls) if stage.calls["residuals"] else {}
                return {**cost, "chi2": float(np.sum(stage.residuals(best) ** 2)), **calls}

            return row

        for kind in kinds:
            contenders = solvers(stage, kind)
            # The stage was compiled when the annealing began.
            first_s = stage.compiling_s
            for name, work in contenders.items():
                begun = time.process_time()
                work()
                if name == OURS and kind == EXACT:
                    first_s = time.process_time() - begun
            bench.interleaved(kind, {name: once(work) for name, work in contenders.items()})
            seconds = [r["values"]["cpu_s"] for r in bench.rows if (r["case"], r["contender"]) == (kind, OURS)]
            if missing_compilation(bench, kind):
                bench.keep(COMPILATION, compiled(kind), 0, {"cpu_s": first_s - float(np.median(seconds))})


def compiled(kind: str) -> str:
    """The contender whose compilation is reported."""
    return f"{OURS}, {kind.lower()}"


def missing_compilation(bench: Bench, kind: str) -> bool:
    """Is the compilation of a kind to be measured?"""
    return bench.missing(COMPILATION, (compiled(kind),), 1)


def solvers(stage: LastStage, kind: str) -> dict[str, Callable[[], np.ndarray]]:
    """Every contender of a kind from the common start."""
    residual = stage_residuals if kind == STAGE else exact_residuals
    tolerance, steps = (STAGE_TOLERANCE, STAGE_STEPS) if kind == STAGE else (PEER_TOLERANCE, 200)
    peers = {
        name: lambda method=method, slopes=slopes: stage.peer(method, slopes != "same", residual)
        for name, (method, slopes) in PEERS[kind].items()
    }
    return {OURS: lambda: stage.ours(tolerance, steps, residual), **peers}


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
        f"finish. scipy is given that Jacobian and {PEER_TOLERANCE:g}."
    )
    exact = f"The same residuals and start with their exact Jacobian, everyone to {PEER_TOLERANCE:g}."
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
            verdict = f"above it, and no fair comparison of speed: {'; '.join(above)}" if above else "all reached it"
            lines.append(f"{kind}: least chi-square {least:.2f}, to be reached within {COST:g}: {verdict}.")
    return lines
