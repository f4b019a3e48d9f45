"""Do importance sampling (tier 1), the chain (tier 2) and NUTS give the same posterior?

    python -m experiments.sampler.agreement run --cores 0     # minutes a case; resumable
    python -m experiments.sampler.agreement table > experiments/sampler/agreement.md

`run` fits both twins, 60 spots of the mounted rig with both axes moved between any two (`rigs.dense_plan`), and 48
spots with twelve stops in every direction (`rigs.small_plan`), and samples each by both tiers as `tvsbayes fit` does.
Eight runs of tier 1 on the twins are averaged; NUTS by NumPyro (the extra `bench`) samples these four too, in some
ten CPU minutes. `table` compares all of them: every free parameter and headline; means in posterior sds, sds in per
cent, both also in joint Monte Carlo errors. Wanted are means within 0.1 sd and sds within 6 %; beyond them "undecided"
says that no such gap is more than four errors. Of a hundred quantities one in a hundred lies beyond 2.6 errors by
chance, the worst near 3.
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
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.posterior.draws import Posterior, headline_names
from tvsbayes.posterior.sampling import TIERS, sample
from tvsbayes.results.records import plain
from tvsbayes.twin.simulated_campaign import simulate

Quantities = Mapping[str, Mapping[str, float]]
DENSE, FEW, SEED = "60 spots", "12 stops", 1
CASES = (*TWINS, DENSE, FEW)
SEEDS, POOLED, NUTS = 8, "tier 1, 8 seeds", "NUTS"
"""Runs of importance sampling that are averaged where there is a reference: their error is a third of one's."""
SHEETS = {DENSE: ("d1", "d3"), FEW: ("d1", "d2")}
WANTED = {"mean": 0.1, "sd": 0.06}
"""In posterior sds, and relative."""
CHANCE = 4.0
"""Monte Carlo errors up to which a gap decides nothing, as in `fit`: a thousand effective draws fix an sd to 2 %."""
MAX_MINUTES, RHAT_LIMIT = 15.0, 1.01
"""R-hat of four chains (Vehtari et al., doi 10.1214/20-BA1221)."""
SETTINGS = {
    DENSE: Setting(4, 500, 2500, SEED),
    FEW: Setting(4, 500, 2500, SEED),
    TWINS[1]: Setting(4, 400, 1500, SEED),
    TWINS[0]: Setting(4, 400, 1200, SEED),
}
"""Chains, warm-up and draws: two to four thousand effective draws of the worst quantity, on the paper twin 600."""


def campaign_of(case: str) -> Campaign:
    """A twin, or of a drawn rig."""
    if case in TWINS:
        return twin_campaign(case)
    plan = dense_plan(SHEETS[case]) if case == DENSE else small_plan(SHEETS[case])
    return simulate(mounted_rig(), plan, SEED).campaign


def one_case(task: tuple[str, str]) -> dict[str, object]:
    """One posterior by one tier."""
    tier, case = task
    use_compilation_cache()
    joint = fit(campaign_of(case))
    row: dict[str, object] = {"tier": tier, "case": case, "accepted": True, "missing": []}
    if tier == NUTS:
        return row | by_nuts(joint, SETTINGS[case])
    # What the clock must not see: compilation.
    sample(joint, tier=TIERS[0], seed=SEED + 1)
    if tier == POOLED:
        each = [summary(sample(joint, tier=TIERS[0], seed=SEED + k)) for k in range(SEEDS)]
        return row | {"quantities": average(each)}
    began = time.process_time()
    posterior = sample(joint, tier=tier, seed=SEED, max_minutes=MAX_MINUTES)
    row |= {"cpu_s": time.process_time() - began, "accepted": bool(posterior.converged)}
    row |= {"missing": list(posterior.convergence.missing), "sampling": plain(posterior.convergence.sampling)}
    return row | {"quantities": summary(posterior)}


def by_nuts(joint: JointFit, setting: Setting) -> dict[str, object]:
    """NUTS of a posterior: its diagnostics and every quantity."""
    with jax.enable_x64(True):
        run, rows = hamiltonian(joint, setting)
    rhat = max(row["rhat"] for row in rows.values())
    missing = [f"R-hat {rhat:.4f}"] if rhat > RHAT_LIMIT else []
    row = {"rhat": rhat, "ess": min(row["ess_bulk"] for row in rows.values()), "quantities": rows}
    row |= {"cpu_s": run.warmup_s + run.sampling_s, "leapfrogs": run.leapfrogs, "divergences": run.divergences}
    return row | {"accepted": not missing, "missing": missing}


def summary(posterior: Posterior) -> dict[str, dict[str, float]]:
    """Mean and sd with their Monte Carlo errors, of every free parameter and headline."""
    free = [TWO_MIRROR.names[i] for i in np.flatnonzero(posterior.fit.free)]
    names = list(dict.fromkeys((*free, *headline_names(posterior.fit))))
    table = posterior.propagate(lambda p: np.stack([p[name] for name in names], axis=1))
    fields = zip(names, table.mean, table.sd, table.mcse_mean, table.mcse_sd, strict=True)
    keys = ("mean", "sd", "mean_mcse", "sd_mcse")
    return {name: dict(zip(keys, map(float, values), strict=True)) for name, *values in fields}


def average(each: Sequence[Quantities]) -> dict[str, dict[str, float]]:
    """Of independent runs: means, variances and squared errors averaged."""
    means = {}
    for name in each[0]:
        of = {key: np.array([run[name][key] for run in each]) for key in each[0][name]}
        row = {key: float(np.sqrt(np.mean(of[key] ** 2) / len(each))) for key in ("mean_mcse", "sd_mcse")}
        means[name] = {"mean": float(of["mean"].mean()), "sd": float(np.sqrt(np.mean(of["sd"] ** 2))), **row}
    return means


def compare(one: Quantities, other: Quantities) -> list[object]:
    """Cells of a table: the worst quantity of each difference."""
    shared = [name for name in one if name in other]
    gaps = {"mean": {n: abs(one[n]["mean"] - other[n]["mean"]) / other[n]["sd"] for n in shared}}
    gaps["sd"] = {n: abs(one[n]["sd"] / other[n]["sd"] - 1) for n in shared}
    errors = {
        (key, n): abs(one[n][key] - other[n][key]) / np.hypot(one[n][f"{key}_mcse"], other[n][f"{key}_mcse"])
        for key in gaps
        for n in shared
    }
    worst = {key: max(of, key=of.__getitem__) for key, of in gaps.items()}
    far = max(errors, key=errors.__getitem__)
    beyond = [errors[key, n] for key, of in gaps.items() for n in shared if of[n] > WANTED[key]]
    verdict = "OUTSIDE" if max(beyond, default=0.0) > CHANCE else "undecided" if beyond else "within"
    cells = [
        f"{gaps['mean'][worst['mean']]:.2f} `{worst['mean']}`",
        f"{100 * gaps['sd'][worst['sd']]:.2f} `{worst['sd']}`",
    ]
    return [
        len(shared),
        *cells,
        f"{np.median(list(errors.values())):.2f}, {errors[far]:.2f} {' of '.join(far)}",
        verdict,
    ]


COSTS = (
    "case | by | accepted | CPU s",
    "draws, steps or leapfrogs",
    "least effective | worst k or R-hat | divergences",
)
TEXT = f"""# Importance sampling, the chain and NUTS

Written by `python -m experiments.sampler.agreement table` after `run`. NUTS: four chains in step in sheared coordinates
(`nuts_reference.py`), of the same model and data. Where it diverges it may miss a tail (Betancourt, arXiv:1701.02434,
section 6.2); tier 1 and chain stand beside.

{heading(*COSTS)}"""
DIFFERENCES = f"""
## Differences

Within: means within 0.1 sd and sds within 6 %. Undecided: beyond, but by no more than four Monte Carlo errors
of both, so that more draws would have to tell. OUTSIDE: by more.

{heading("case | of | from | quantities | mean, sds | sd, % | in errors: median, worst | verdict")}"""


def workings(row: Mapping) -> list[object]:
    """What a run says of itself."""
    if row["tier"] == NUTS:
        return [f"{row['leapfrogs']:.1f}", f"{row['ess']:.0f}", f"{row['rhat']:.4f}", row["divergences"]]
    run = row["sampling"]
    if row["tier"] == TIERS[0]:
        of = run["importance"]
        return [of["draws"], f"{of['least_ess']['value']:.0f}", f"{of['worst_pareto_k']['value']:.2f}", ""]
    return [run["steps"], f"{run['least_ess_bulk']['value']:.0f}", f"{run['worst_rhat']['value']:.4f}", ""]


def table(rows: list[dict]) -> None:
    print(TEXT)
    of = {(row["case"], row["tier"]): row for row in rows}
    for (case, tier), row in of.items():
        if tier != POOLED:
            print(line(case, tier, "yes" if row["accepted"] else "NO", f"{row['cpu_s']:.1f}", *workings(row)))
    print(DIFFERENCES)
    one, two = TIERS
    pairs = ((one, two), (one, NUTS), (two, NUTS), (POOLED, NUTS), (one, POOLED), (two, POOLED))
    for case in dict.fromkeys(row["case"] for row in rows):
        for these, those in pairs:
            if (case, these) in of and (case, those) in of:
                both = (of[case, tier]["quantities"] for tier in (these, those))
                print(line(case, these, those, *compare(*both)))
    for row in rows:
        if not row["accepted"]:
            print(f"\n- not accepted: {row['case']}, {row['tier']}: {'; '.join(row['missing'])}")


def tasks(_: argparse.Namespace) -> list[tuple[str, str]]:
    """Tier 1 of every case first."""
    every = [(tier, case) for tier in TIERS for case in CASES]
    return every + [(POOLED, case) for case in TWINS] + [(NUTS, case) for case in SETTINGS]


if __name__ == "__main__":
    study(__file__, __doc__, one_case, ("tier", "case"), tasks, table)
