"""Effective draws of one posterior per CPU second: both tiers of ours, NUTS by NumPyro and BlackJAX, stretch move."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from arviz_stats.base import array_stats

from experiments.common.clock import timed
from experiments.common.reference_samplers import (
    AXES,
    Run,
    Setting,
    blackjax_nuts,
    build_transport,
    nuts,
    potential_of,
    stretch,
    worst_ess,
)
from experiments.common.rigs import dense_plan, mounted_rig
from experiments.speed.benchmarks.measure import Bench, Case, Column
from tvsbayes.estimators.joint_fit import JointFit, fit
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.posterior.importance import importance_run
from tvsbayes.posterior.sampling import sample
from tvsbayes.posterior.target import WALKERS
from tvsbayes.posterior.transport import Transport
from tvsbayes.results.tiers import CHAIN
from tvsbayes.statistics.weighted_draws import weighted_summary
from tvsbayes.twin.simulated_campaign import simulate

TITLE = "Sampling the posterior"
NAME = "60 spots of the mounted rig, both axes moved between any two"
REPEATS = 3
CHAINS, WARMUP, DRAWS = 4, 250, 500
OURS, FIRST_TIER = "tvsbayes", "tvsbayes, tier 1 alone"
NUTS, BLACKJAX, STRETCH = "NumPyro NUTS, sheared", "BlackJAX NUTS, sheared", "emcee stretch move"
TRUSTED = 400
"""Effective draws that four chains need before an interval is trusted (Vehtari et al., doi 10.1214/20-BA1221)."""


@dataclass(frozen=True)
class Contenders:
    """The samplers of one posterior; each turn has a seed and returns its row.

    Attributes:
        joint: the fit.
        path: our map to nearly normal coordinates.
        walkers: our weighted draws, from which the stretch move starts.
    """

    joint: JointFit
    path: Transport
    walkers: np.ndarray

    def worst(self, z: np.ndarray) -> dict[str, float]:
        """Of the free parameters of draws (chain, draw, parameter)."""
        free = z[..., np.flatnonzero(self.joint.free)]
        return {"ess": worst_ess(free), "rhat": float(np.max(array_stats.rhat(free, **AXES)))}

    def ours(self, seed: int) -> dict[str, object]:
        """Both tiers, until their own limits are met."""
        posterior, cost = timed(lambda: sample(self.joint, CHAIN, seed=seed, max_minutes=30.0))
        figures = self.worst(posterior.z)
        rate = figures["ess"] / cost["cpu_s"]
        return {**cost, **figures, "converged": posterior.converged, "rate": rate, "trusted_s": cost["cpu_s"]}

    def weighted(self, seed: int) -> dict[str, object]:
        """Importance sampling, until its own limits are met."""
        posterior, cost = timed(lambda: sample(self.joint, "importance", seed=seed))
        free = posterior.z[0][:, np.flatnonzero(self.joint.free)]
        ess = float(np.min(weighted_summary(free, posterior.weights[0]).ess_mean))
        figures = {"ess": ess, "converged": posterior.converged, "rate": ess / cost["cpu_s"]}
        return {**cost, **figures, "trusted_s": cost["cpu_s"]}

    def stretched(self, _: int) -> dict[str, object]:
        """Emcee's default move."""
        run = stretch(self.joint, self.walkers, self.path)
        return {**run, "rate": run["ess"] / run["cpu_s"], "trusted_s": TRUSTED / run["ess"] * run["cpu_s"]}

    def hamiltonian(self, sampler: Callable[..., Run]) -> Callable[[int], dict[str, object]]:
        """NUTS in sheared coordinates."""

        def turn(seed: int) -> dict[str, object]:
            route, built = timed(lambda: build_transport(self.joint))
            z_of, potential = potential_of(self.joint, route)
            run = sampler(potential, route.index.size, Setting(CHAINS, WARMUP, DRAWS, seed))
            shape = run.draws.shape
            z = np.asarray(jax.jit(jax.vmap(z_of))(jnp.asarray(run.draws.reshape(-1, shape[-1]))))
            figures = self.worst(z.reshape(*shape[:2], -1))
            before_s = built["cpu_s"] + run.warmup_s
            cpu_s = before_s + run.sampling_s
            row = {**figures, "cpu_s": cpu_s, "rate": figures["ess"] / cpu_s, "compile_s": run.compile_s}
            row |= {"trusted_s": before_s + run.sampling_s * TRUSTED / figures["ess"], "leapfrogs": run.leapfrogs}
            return row | {"sampling_rate": figures["ess"] / run.sampling_s, "divergences": run.divergences}

        return turn


def measure(bench: Bench) -> None:
    """Every sampler once per repeat, with the repeat's number as its seed."""
    repeats = min(bench.repeats, REPEATS)
    if not bench.missing(NAME, (OURS, FIRST_TIER, NUTS, BLACKJAX, STRETCH), repeats):
        return
    use_compilation_cache()
    jax.config.update("jax_enable_x64", True)
    joint = fit(simulate(mounted_rig(), dense_plan(("d1", "d3")), seed=1).campaign)
    # Compiles everything that `sample` calls, and gives the stretch move walkers that are draws already.
    run = importance_run(joint, 0)
    samplers = Contenders(joint, run.density.path, run.starts(WALKERS))
    works = {OURS: samplers.ours, FIRST_TIER: samplers.weighted, STRETCH: samplers.stretched}
    works |= {NUTS: samplers.hamiltonian(nuts), BLACKJAX: samplers.hamiltonian(blackjax_nuts)}
    bench.interleaved(NAME, works, repeats)


def cases() -> list[Case]:
    """Tables of the part."""
    about = (
        "Worst bulk effective draws of all free parameters over the process' CPU seconds, compilation apart. "
        "`tvsbayes` is `sample` from the fit until its own limits are met, transport, importance sampling and "
        "diagnosis included; tier 1 alone ends before the chain, its effective draws are those of the means. "
        f"NUTS ({CHAINS} chains in step, {WARMUP} + {DRAWS} draws each) samples Laplace-whitened coordinates, "
        "sheared as in `sampler/nuts_reference.py`; its seconds hold transport and warm-up, the last rate only the "
        "draws; without the shear it did not finish its warm-up on a larger campaign (`sampler/nuts_reference.md`). "
        "BlackJAX does the same with its own window adaptation. "
        "The stretch move makes 400 steps in Laplace-whitened coordinates from our weighted draws; a quarter of its "
        "steps is left out, none of its seconds. To an interval: until the worst parameter has "
        f"{TRUSTED} effective draws, or ours has met its limits, which ask for more."
    )
    columns = (
        Column("ess", "worst bulk ESS", "{:.0f}"),
        Column("rhat", "worst R-hat", "{:.4f}"),
        Column("cpu_s", "CPU s"),
        Column("rate", "ESS per CPU s"),
        Column("trusted_s", "to an interval, CPU s"),
        Column("sampling_rate", "of the draws alone"),
        Column("leapfrogs", "leapfrogs a draw"),
        Column("divergences", "divergences", "{:.0f}"),
        Column("compile_s", "compilation, CPU s"),
    )
    return [Case(NAME, about, columns, "rate")]


def remarks(rows: Sequence[Mapping]) -> list[str]:
    """Did ours converge?"""
    lines = []
    for name in (OURS, FIRST_TIER):
        converged = [r["values"]["converged"] for r in rows if r["contender"] == name]
        lines.append(f"`{name}` met its own limits of convergence in {sum(converged)} of {len(converged)} runs.")
    return lines
