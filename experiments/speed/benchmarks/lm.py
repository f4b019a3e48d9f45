"""The fit's last Levenberg-Marquardt stage against `scipy.optimize.least_squares`: same residuals, same start.

Annealing reaches the basin; from there every solver converges, and solvers are compared.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize

from experiments.common.clock import timed
from experiments.common.jax_density import innovations as exact_innovations
from experiments.common.jax_density import root_at_places, without_padding
from experiments.common.rigs import twin_campaign
from experiments.speed.benchmarks.measure import Bench, Case, Column, Work
from tvsbayes.estimators.annealed_stage import STAGE_TOLERANCE, Fixed, innovations, stage
from tvsbayes.estimators.kalman_filter import no_belief
from tvsbayes.estimators.linear_spots import linearise
from tvsbayes.estimators.mode_search import Problem
from tvsbayes.instrument.campaign import Campaign, ordered_spots
from tvsbayes.instrument.parameters import NAMES
from tvsbayes.model.descent import descend
from tvsbayes.statistics.least_squares import LinearResidual, linear_residual, residuals_and_jacobian

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
PEER_TOLERANCE = 1e-6
ANNEALING = (60.0, 10.0, 2.0)
"""Inflations of the stages before."""


def exact_values(z, args):
    """Standardised innovations, errors at places and prior residuals."""
    space, arrays, fixed = args
    full = jnp.where(fixed.held, fixed.value, z)
    return jnp.append(exact_innovations(full, space, arrays).residual, jnp.where(fixed.held, z - fixed.value, z))


def exact_residuals(z, args) -> LinearResidual:
    """With the Jacobian that holds nothing fixed."""
    return linear_residual(exact_values, z, args)


def stage_residuals(z, args) -> LinearResidual:
    """With the Jacobian of the fit's stage, which holds slopes and projections."""
    space, arrays, fixed = args
    full = jnp.where(fixed.held, fixed.value, z)
    lin, root = linearise(space.point(full), space, arrays), root_at_places(space.model(full), arrays.gears)
    places = len(root)
    columns = innovations(lin, arrays, no_belief(1 + z.size + places)).standardised.reshape(-1, 1 + z.size + places)
    prior = jnp.where(fixed.held, z - fixed.value, z)
    # The errors at places are least squares in every step.
    whole = jnp.concatenate([columns[:, : 1 + z.size], jnp.zeros((places, 1 + z.size))])
    repeated = columns[:, 1 + z.size :] @ root
    across = jnp.linalg.qr(jnp.concatenate([repeated, jnp.eye(places)]))[0]
    whole = whole - across @ (across.T @ whole)
    jacobian = jnp.where(fixed.held, 0.0, whole[:, 1:])
    return LinearResidual(jnp.append(whole[:, 0], prior), jnp.concatenate([jacobian, jnp.eye(z.size)]))


class LastStage:
    """What every solver is given after the annealing of a fit; float64 has to be on. Calls by solvers are counted."""

    def __init__(self, campaign: Campaign):
        problem = Problem(campaign, campaign.rig, np.ones(len(ordered_spots(campaign)), dtype=bool))
        begun = time.process_time()
        self.start = problem.least_squares(np.zeros(len(NAMES)), ANNEALING[0])
        self.compiling_s = time.process_time() - begun
        for inflation in ANNEALING[1:]:
            self.start = problem.least_squares(self.start, inflation)
        arrays = without_padding(problem.arrays, len(campaign.moves))
        args = self.args = problem.space, arrays, Fixed(problem.held, self.start, np.array(1.0))
        self.padded, self.calls = problem.arrays, {"residuals": 0, "Jacobians": 0}
        kinds = {STAGE: stage_residuals, EXACT: exact_residuals}
        self._linear = {name: jax.jit(lambda z, kind=kind: kind(z, args)) for name, kind in kinds.items()}
        self._values = jax.jit(lambda z: exact_values(z, args))

    def residuals(self, z: np.ndarray) -> np.ndarray:
        """Values, the same of both kinds."""
        self.calls["residuals"] += 1
        return np.asarray(self._values(jnp.asarray(z)))

    def jacobian(self, z: np.ndarray, kind: str) -> np.ndarray:
        """Derivative, with slopes and projection held fixed or not."""
        self.calls["Jacobians"] += 1
        return np.asarray(self._linear[kind](jnp.asarray(z)).jacobian)

    def ours(self, kind: str) -> np.ndarray:
        """Where our solver ends: the compiled stage, or Levenberg-Marquardt with the exact Jacobian."""
        if kind == STAGE:
            space, _, fixed = self.args
            return stage(self.start, space, self.padded, fixed, STAGE_TOLERANCE).z
        return descend(
            lambda at: residuals_and_jacobian(exact_values, jnp.asarray(at), self.args), self.start, PEER_TOLERANCE, 200
        ).value

    def peer(self, method: str, slopes: str, kind: str) -> np.ndarray:
        """Where `scipy.optimize.least_squares` ends, with the same Jacobian or with finite differences."""
        options = {"method": method, "xtol": PEER_TOLERANCE, "ftol": PEER_TOLERANCE, "gtol": PEER_TOLERANCE}
        jac = slopes if slopes != "same" else lambda z: self.jacobian(z, kind)
        return optimize.least_squares(self.residuals, self.start, jac=jac, **options).x

    def turn(self, work: Callable[[], np.ndarray]) -> Work:
        """A timed run of a solver, with the cost that it reached and its calls."""

        def row(_: int) -> dict[str, object]:
            self.calls.update(residuals=0, Jacobians=0)
            best, cost = timed(work)
            calls = dict(self.calls) if self.calls["residuals"] else {}
            return {**cost, "chi2": float(np.sum(self.residuals(best) ** 2)), **calls}

        return row

    def solvers(self, kind: str) -> dict[str, Callable[[], np.ndarray]]:
        """Every contender of a kind from the common start."""
        peers = {name: lambda how=how: self.peer(*how, kind) for name, how in PEERS[kind].items()}
        return {OURS: lambda: self.ours(kind), **peers}


def measure(bench: Bench) -> None:
    """Time every solver from one start to its own end, without compilation; compilation apart."""
    kinds = [
        kind
        for kind in (STAGE, EXACT)
        if bench.missing(kind, (OURS, *PEERS[kind])) or bench.missing(COMPILATION, (compiled(kind),), 1)
    ]
    if not kinds:
        return
    with jax.enable_x64(True):
        last = LastStage(twin_campaign(TWIN))
        for kind in kinds:
            # The stage was compiled when the annealing began.
            contenders, first_s = last.solvers(kind), last.compiling_s
            for name, work in contenders.items():
                begun = time.process_time()
                work()
                if name == OURS and kind == EXACT:
                    first_s = time.process_time() - begun
            bench.interleaved(kind, {name: last.turn(work) for name, work in contenders.items()})
            seconds = [r["values"]["cpu_s"] for r in bench.rows if (r["case"], r["contender"]) == (kind, OURS)]
            if bench.missing(COMPILATION, (compiled(kind),), 1):
                bench.keep(COMPILATION, compiled(kind), 0, {"cpu_s": first_s - float(np.median(seconds))})


def compiled(kind: str) -> str:
    """The contender whose compilation is reported."""
    return f"{OURS}, {kind.lower()}"


def cases() -> list[Case]:
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
