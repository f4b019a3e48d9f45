"""Worst effective draws per CPU second of one posterior: `tvsbayes.sample`, NumPyro's NUTS, emcee's stretch move."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence

import numpy as np

from tvsbayes.estimators.likelihood import log_density

from .measure import Bench, Case, Column, timed

TITLE = "Sampling the posterior"
NAME = "60 spots of the mounted rig, both axes moved between any two"
REPEATS = 3
CHAINS, WARMUP, DRAWS = 4, 250, 500
OURS, NUTS, STRETCH = "tvsbayes", "NumPyro NUTS, sheared", "emcee stretch move"
BUCKET = 64
"""Padded length of the campaign: ordinary fits pad to 512, for all contenders alike; here nothing is gained by it."""


def measure(bench: Bench) -> None:
    """Every sampler once per repeat, with the repeat's number as its seed."""
    if not bench.missing(NAME, (OURS, NUTS, STRETCH), min(bench.repeats, REPEATS)):
        return
    import jax
    import jax.numpy as jnp

    from tvsbayes.estimators import campaign_arrays

    campaign_arrays.SMALLEST_BUCKET = BUCKET
    jax.config.update("jax_enable_x64", True)
    from agreement import AXES, array_stats, stretch
    from nuts_reference import build_transport, nuts
    from studies import dense_plan, mounted_rig

    from tvsbayes.estimators.campaign_arrays import use_compilation_cache
    from tvsbayes.estimators.joint_fit import fit
    from tvsbayes.posterior.proposal import Target, pilot
    from tvsbayes.posterior.sampling import sample
    from tvsbayes.posterior.transport import transport
    from tvsbayes.twin.simulated_campaign import simulate

    use_compilation_cache()
    joint = fit(simulate(mounted_rig(), dense_plan(("d1", "d3")), seed=1).campaign)
    columns = np.flatnonzero(joint.free)

    def worst(z: np.ndarray) -> dict[str, float]:
        free = z[..., columns]
        rhat = array_stats.rhat(free, **AXES)
        return {"ess": float(np.min(array_stats.ess(free, method="bulk", **AXES))), "rhat": float(np.max(rhat))}

    path = transport(joint)
    # Compiles everything that `sample` calls, and gives the stretch move walkers that are draws already.
    walkers = pilot(Target(joint, path), 0).start

    def ours(seed: int) -> dict[str, object]:
        posterior, cost = timed(lambda: sample(joint, seed=seed, max_minutes=30.0))
        told = worst(posterior.z)
        return {**cost, **told, "converged": posterior.converged, "rate": told["ess"] / cost["cpu_s"]}

    def stretched(_: int) -> dict[str, object]:
        ess, cpu, wall = stretch(joint, walkers, path)
        return {"ess": ess, "cpu_s": cpu, "wall_s": wall, "rate": ess / cpu}

    def hamiltonian(seed: int) -> dict[str, object]:
        route, built = timed(lambda: build_transport(joint))

        def z_of(w):
            return route.z_of_y(route.y_of_w(w))

        def potential(w):
            return joint.log_density - log_density(z_of(w), joint.space, joint.arrays)

        setting = argparse.Namespace(chains=CHAINS, warmup=WARMUP, draws=DRAWS, limit=np.inf, seed=seed)
        run = nuts(potential, route.index.size, setting)
        shape = run.draws.shape
        z = np.asarray(jax.jit(jax.vmap(z_of))(jnp.asarray(run.draws.reshape(-1, shape[-1]))))
        told = worst(z.reshape(*shape[:2], -1))
        cpu = built["cpu_s"] + run.warmup_s + run.sampling_s
        return {
            **told,
            "cpu_s": cpu,
            "rate": told["ess"] / cpu,
            "sampling_rate": told["ess"] / run.sampling_s,
            "compile_s": run.compile_s,
            "leapfrogs": run.leapfrogs,
            "divergences": run.divergences,
        }

    works = {OURS: ours, NUTS: hamiltonian, STRETCH: stretched}
    bench.interleaved(NAME, works, min(bench.repeats, REPEATS))


def cases(rows: Sequence[Mapping]) -> list[Case]:
    """Tables of the part."""
    about = (
        "Worst bulk effective draws of all free parameters over the process' CPU seconds, compilation apart. "
        "`tvsbayes` is `sample` from the fit until its own limits are met, transport, pilot and diagnosis included. "
        f"NUTS ({CHAINS} chains in step, {WARMUP} + {DRAWS} draws each) samples Laplace-whitened coordinates, "
        "sheared by `experiments/nuts_reference.py`; its seconds hold transport and warm-up, the last rate only "
        "the draws; without the shear it did not finish its warm-up on a larger campaign (`experiments/nuts.md`). "
        "The stretch move makes 400 steps in Laplace-whitened coordinates from draws of our pilot; a quarter of its "
        "steps is left out, none of its seconds."
    )
    columns = (
        Column("ess", "worst bulk ESS", "{:.0f}"),
        Column("rhat", "worst R-hat", "{:.4f}"),
        Column("cpu_s", "CPU s"),
        Column("rate", "ESS per CPU s"),
        Column("sampling_rate", "of the draws alone"),
        Column("leapfrogs", "leapfrogs a draw"),
        Column("divergences", "divergences", "{:.0f}"),
        Column("compile_s", "compilation, CPU s"),
    )
    return [Case(NAME, about, columns, "rate")]


def remarks(rows: Sequence[Mapping]) -> list[str]:
    """Did ours converge?"""
    seen = [r["values"]["converged"] for r in rows if r["contender"] == OURS]
    return [f"`tvsbayes` met its own limits of convergence in {sum(seen)} of {len(seen)} runs."]
