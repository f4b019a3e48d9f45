"""Do importance sampling (tier 1), the chain (tier 2) and NUTS give the same posterior?

    python -m experiments.sampler.agreement run --cores 0     # minutes a case; resumable
    python -m experiments.sampler.agreement table > experiments/sampler/agreement.md

`run` fits both twins, 60 spots of the mounted rig with both axes moved between any two (`rigs.dense_plan`), and 48
spots with twelve stops in every direction (`rigs.small_plan`), and samples each by both tiers as `tvsbayes fit` does.
Eight runs of tier 1 on the twins are averaged; NUTS by NumPyro (the extra `bench`) samples these four too, in some
ten CPU minutes. `table` compares all of them: every free parameter and headline; means in posterior sds, sds in per
cent, both also in joint Monte Carlo errors. Wanted are means within 0.1 sd and sds within 6 %; beyond them "undecided"
says that no such gap is more than four errors. Of a hundred quantities one in a hundred lies beyond 2.6 errors by
chance, the worst near 3. CPU seconds are the process' own, from the fit on, after a first call that compiles, with
campaigns padded to 384, 192 and 64 rows instead of 512.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence

import jax
import numpy as np

from experiments.common.command_line import study
from experiments.common.page import heading, line
from experiments.common.reference_samplers import Setting
from experiments.common.rigs import TWINS, dense_plan, mounted_rig, small_plan, twin_campaign
from experiments.sampler.nuts_reference import hamiltonian
from tvsbayes.estimators.joint_fit import JointFit, fit
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.parameters import NAMES
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.posterior.draws import Posterior, headline_names
from tvsbayes.posterior.sampling import TIERS, sample
from tvsbayes.results.records import plain
from tvsbayes.twin.simulated_campaign import simulate

DENSE, FEW = "60 spots", "12 stops"
CASES = (*TWINS, DENSE, FEW)
SEED = 1
SEEDS, POOLED = 8, "tier 1, 8 seeds"
"""Runs of importance sampling that are averaged where there is a reference: their error is a third of one's."""
SHEETS = {DENSE: ("d1", "d3"), FEW: ("d1", "d2")}
MEAN_WANTED, SD_WANTED = 0.1, 6.0
"""In posterior sds, and in per cent."""
CHANCE = 4.0
"""Monte Carlo errors up to which a gap decides nothing, as in `fit`: a thousand effective draws fix an sd to 2 %."""
MAX_MINUTES = 15.0
NUTS = "NUTS"
SETTINGS = {
    DENSE: Setting(4, 500, 2500, SEED),
    FEW: Setting(4, 500, 2500, SEED),
    TWINS[1]: Setting(4, 400, 1500, SEED),
    TWINS[0]: Setting(4, 400, 1200, SEED),
}
"""Chains, warm-up and draws: two to four thousand effective draws of the worst quantity, on the paper twin 600."""
CHAIN = "chain: steps | effective | R-hat | errors from tier 1 | converged | CPU s"
RHAT_LIMIT = 1.01
"""Of four chains (Vehtari et al., doi 10.1214/20-BA1221)."""


def campaign_of(case: str) -> Campaign:
    """A twin, or of a drawn rig."""
    if case in TWINS:
        return twin_campaign(case)
    plan = dense_plan(SHEETS[case]) if case == DENSE else small_plan(SHEETS[case])
    return simulate(mounted_rig(), plan, SEED).campaign


def one_case(task: tuple[str, str]) -> dict[str, object]:
    """One posterior by one tier."""
    tier, case = task
    campaign = campaign_of(case)
    use_compilation_cache()
    joint = fit(campaign)
    if tier == NUTS:
        return {"tier": tier, "case": case, **by_nuts(joint, SETTINGS[case])}
    # What the clock must not see: compilation.
    sample(joint, tier=TIERS[0], seed=SEED + 1)
    cpu, wall = time.process_time(), time.perf_counter()
    joint = fit(campaign)
    fit_cpu_s = time.process_time() - cpu
    if tier == POOLED:
        each = [summary(sample(joint, tier=TIERS[0], seed=SEED + k)) for k in range(SEEDS)]
        return {"tier": tier, "case": case, "accepted": True, "quantities": average(each)}
    posterior = sample(joint, tier=tier, seed=SEED, max_minutes=MAX_MINUTES)
    row: dict[str, object] = {"tier": tier, "case": case, "cpu_s": time.process_time() - cpu, "fit_cpu_s": fit_cpu_s}
    row |= {"wall_s": time.perf_counter() - wall, "spots": len(campaign.spots)}
    row |= {"accepted": bool(posterior.converged), "missing": list(posterior.convergence.missing)}
    return row | {"sampling": plain(posterior.convergence.sampling), "quantities": summary(posterior)}


def by_nuts(joint: JointFit, setting: Setting) -> dict[str, object]:
    """NUTS of a posterior: its diagnostics and every quantity."""
    with jax.enable_x64(True):
        run, rows = hamiltonian(joint, setting)
    rhat = max(row["rhat"] for row in rows.values())
    missing = [f"R-hat {rhat:.4f}"] if rhat > RHAT_LIMIT else []
    row = {"rhat": rhat, "ess": min(row["ess_bulk"] for row in rows.values()), "quantities": rows}
    row |= {"warmup_s": run.warmup_s, "sampling_s": run.sampling_s, "leapfrogs": run.leapfrogs}
    return row | {"divergences": run.divergences, "accepted": not missing, "missing": missing}


def summary(posterior: Posterior) -> dict[str, dict[str, float]]:
    """Mean and sd with their Monte Carlo errors, of every free parameter and headline."""
    names = [NAMES[i] for i in np.flatnonzero(posterior.fit.free)]
    names += [name for name in headline_names(posterior.fit) if name not in names]
    table = posterior.propagate(lambda p: np.stack([p[name] for name in names], axis=1))
    fields = zip(names, table.mean, table.sd, table.mcse_mean, table.mcse_sd, strict=True)
    keys = ("mean", "sd", "mean_mcse", "sd_mcse")
    return {name: dict(zip(keys, map(float, values), strict=True)) for name, *values in fields}


def average(each: Sequence[Mapping[str, Mapping[str, float]]]) -> dict[str, dict[str, float]]:
    """Of independent runs: means, variances and squared errors averaged."""
    means = {}
    for name in each[0]:
        of = {key: np.array([run[name][key] for run in each]) for key in each[0][name]}
        errors = {key: np.sqrt(np.mean(of[key] ** 2) / len(each)) for key in ("mean_mcse", "sd_mcse")}
        means[name] = {
            k: float(v) for k, v in {"mean": of["mean"].mean(), "sd": np.sqrt(np.mean(of["sd"] ** 2)), **errors}.items()
        }
    return means


def compare(one: Mapping[str, Mapping[str, float]], other: Mapping[str, Mapping[str, float]]) -> str:
    """Cells of a table: the worst quantity of each difference."""
    shared = [name for name in one if name in other]
    mean = {n: abs(one[n]["mean"] - other[n]["mean"]) / other[n]["sd"] for n in shared}
    sd = {n: 100 * abs(one[n]["sd"] / other[n]["sd"] - 1) for n in shared}
    errors = {}
    for key in ("mean", "sd"):
        for n in shared:
            error = np.hypot(one[n][f"{key}_mcse"], other[n][f"{key}_mcse"])
            errors[f"{key} of {n}"] = abs(one[n][key] - other[n][key]) / error
    cells = [str(len(shared))]
    cells += [f"{gaps[worst]:.2f} `{worst}`" for gaps in (mean, sd) for worst in [max(gaps, key=gaps.get)]]
    worst = max(errors, key=errors.get)
    cells += [f"{np.median(list(errors.values())):.2f}, {errors[worst]:.2f} {worst}"]
    limits = (("mean", mean, MEAN_WANTED), ("sd", sd, SD_WANTED))
    beyond = [errors[f"{key} of {n}"] for key, gaps, wanted in limits for n in shared if gaps[n] > wanted]
    verdict = "OUTSIDE" if max(beyond, default=0.0) > CHANCE else "undecided" if beyond else "within"
    return " | ".join([*cells, verdict])


TEXT = f"""# Importance sampling, the chain and NUTS

Written by `python -m experiments.sampler.agreement table` after `run`.

## What the tiers say of themselves

`share`: effective draws by weights over draws; `effective`: of the worst statistic of the worst headline.
Of the chain: steps of its walkers, worst bulk effective draws, worst R-hat, gap to tier 1 in errors.

{heading("case | spots | Pareto k | worst of a headline | draws | share | effective | accepted | CPU s", CHAIN)}"""
DIFFERENCES = f"""
## Differences

NUTS: four chains in step in sheared coordinates (`nuts_reference.py`), of the same model and data. Where it
diverges it may miss a tail (Betancourt, arXiv:1701.02434, section 6.2); tier 1 and chain stand beside.
Within: means within 0.1 sd and sds within 6 %. Undecided: beyond, but by no more than four Monte Carlo errors
of both, so that more draws would have to tell. OUTSIDE: by more.

{heading("case | chains x (warm-up + draws) | leapfrogs | divergences | largest R-hat | worst bulk ESS | CPU s")}"""


def table(rows: list[dict]) -> None:
    print(TEXT)
    of = {(r["case"], r["tier"]): r for r in rows}
    cases = list(dict.fromkeys(r["case"] for r in rows))
    for case in cases:
        cells = [*first_cells(of.get((case, TIERS[0]))), *chain_cells(of.get((case, TIERS[1])))]
        print(line(case, *cells))
    print(DIFFERENCES)
    for case in cases:
        if row := of.get((case, NUTS)):
            how, cpu_s = SETTINGS[case], row["warmup_s"] + row["sampling_s"]
            sizes = f"{how.chains} x ({how.warmup} + {how.draws})"
            cells = (f"{row['leapfrogs']:.1f}", row["divergences"], f"{row['rhat']:.4f}", f"{row['ess']:.0f}")
            print(line(case, sizes, *cells, f"{cpu_s:.0f}"))
    print()
    print(heading("case | of | from | quantities | mean, sds | sd, % | in errors: median, worst | verdict"))
    for case in cases:
        one, two, pooled, nuts = (of.get((case, tier)) for tier in (*TIERS, POOLED, NUTS))
        pairs = (("tier 1", one, "chain", two), ("tier 1", one, "NUTS", nuts), ("chain", two, "NUTS", nuts))
        pairs += ((POOLED, pooled, "NUTS", nuts), ("tier 1", one, POOLED, pooled), ("chain", two, POOLED, pooled))
        for name, these, other, those in pairs:
            if these and those:
                print(line(case, name, other, compare(these["quantities"], those["quantities"])))
    for r in rows:
        if not r["accepted"]:
            print(f"\n- not accepted: {r['case']}, {r['tier']}: {'; '.join(r['missing'])}")


def first_cells(row: dict | None) -> list[str]:
    """Of tier 1."""
    if row is None:
        return [""] * 8
    run = row["sampling"]["importance"]
    worst, least = run["worst_pareto_k"], run["least_ess"]
    cells = [str(row["spots"]), f"{run['pareto_k']:.2f}", f"{worst['value']:.2f} `{worst['quantity']}`"]
    cells += [str(run["draws"]), f"{run['effective_share']:.2f}", f"{least['value']:.0f} `{least['quantity']}`"]
    return [*cells, "yes" if row["accepted"] else "NO", f"{row['cpu_s']:.1f}"]


def chain_cells(row: dict | None) -> list[str]:
    """Of tier 2, which ends after tier 1."""
    if row is None:
        return [""] * 6
    run = row["sampling"]
    cells = [f"{run['steps']} of {run['walkers']}", f"{run['least_ess_bulk']['value']:.0f}"]
    cells += [f"{run['worst_rhat']['value']:.4f}"]
    cells += [f"{run['agreement']['worst']['value']:.2f}" if run["agreement"] else ""]
    return [*cells, "yes" if row["accepted"] else "NO", f"{row['cpu_s']:.1f}"]


def tasks(_: argparse.Namespace) -> list[tuple[str, str]]:
    """Tier 1 of every case first."""
    every = [(tier, case) for tier in TIERS for case in CASES]
    return every + [(POOLED, case) for case in TWINS] + [(NUTS, case) for case in SETTINGS]


if __name__ == "__main__":
    study(__file__, __doc__, one_case, ("tier", "case"), tasks, table)
