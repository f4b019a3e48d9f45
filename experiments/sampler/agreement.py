"""Does the sampler give the posterior that NUTS gives, and how fast beside emcee's stretch move?

For each twin: sample as `tvsbayes fit` does, compare every parameter and headline with the NUTS reference in
`data/reference/` (means in sds, sds in per cent, 5, 50 and 95 % quantiles in Monte Carlo errors of both), then run
emcee's default stretch move on the same density, started from the same walkers in Laplace-whitened coordinates.

    python -m experiments.sampler.agreement > experiments/sampler/agreement.md        (4 minutes on two quiet cores)

CPU seconds are the process' own; compilation happens before the clocks start.
"""

from __future__ import annotations

import json
import time

import jax
import numpy as np
from arviz_stats.base import array_stats

from experiments.common.command_line import print_only
from experiments.common.reference_samplers import AXES, STRETCH_STEPS, stretch
from experiments.common.rigs import twin_campaign
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.campaign import input_hashes
from tvsbayes.instrument.parameters import NAMES
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.posterior.draws import Posterior
from tvsbayes.posterior.ensemble import WALKERS
from tvsbayes.posterior.importance import importance_run
from tvsbayes.posterior.sampling import sample
from tvsbayes.results.records import plain

QUANTILES = {"q05": 0.05, "q50": 0.5, "q95": 0.95}


def compare(posterior: Posterior, reference: dict[str, dict[str, float]]) -> list[str]:
    """Table lines: the worst quantity of each kind."""
    columns, shape = posterior.by_name, posterior.z.shape[:2]
    kinds = ("mean, sds", "sd, %", "sd, Monte Carlo errors", *(f"{q}, Monte Carlo errors" for q in QUANTILES))
    differences = {kind: {} for kind in kinds}
    for name, there in reference.items():
        draws = columns[name].reshape(shape)
        differences["mean, sds"][name] = abs(draws.mean() - there["mean"]) / there["sd"]
        differences["sd, %"][name] = 100 * abs(draws.std() / there["sd"] - 1)
        error = np.hypot(float(array_stats.mcse(draws, method="sd", **AXES)), there["sd_mcse"])
        differences["sd, Monte Carlo errors"][name] = abs(draws.std() - there["sd"]) / error
        for key, probability in QUANTILES.items():
            own = float(array_stats.mcse(draws, method="quantile", prob=probability, **AXES))
            error = np.hypot(own, there[f"{key}_mcse"])
            gap = abs(np.quantile(draws, probability) - there[key]) / error
            differences[f"{key}, Monte Carlo errors"][name] = gap
    lines = []
    for kind, values in differences.items():
        worst = max(values, key=values.get)
        lines.append(f"| {kind} | {values[worst]:.2f} | `{worst}` | {np.median(list(values.values())):.2f} |")
    return lines


def main() -> None:
    """Print the tables."""
    print_only(__doc__)
    use_compilation_cache()
    print("# The posterior against NUTS\n")
    print("Written by `python -m experiments.sampler.agreement`; references by `nuts_reference.py`.")
    for name in ("paper", "grid"):
        campaign = twin_campaign(f"{name}_twin")
        reference = json.loads((shipped_data() / "reference" / f"posterior_{name}.json").read_text())
        if reference["input_sha256"] != input_hashes(campaign):
            raise SystemExit(f"the reference of the {name} twin was made from other data: run nuts_reference.py")
        joint = fit(campaign)
        with jax.enable_x64(True):
            run = importance_run(joint, 0)
            path, start = run.path, run.starts(WALKERS)
        wall, cpu = time.perf_counter(), time.process_time()
        posterior = sample(joint, seed=0, max_minutes=10.0)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        found = plain(posterior.convergence.sampling)
        names = [NAMES[i] for i in np.flatnonzero(joint.free)]
        least = min(posterior.convergence.ess_bulk[n] for n in names)
        print(f"\n## {name} twin\n")
        print(
            f"Converged: {posterior.converged}; {found['steps']} steps of {found['walkers']} walkers, acceptance "
            f"{found['acceptance']:.2f} (least {found['least_acceptance']:.2f}), worst R-hat "
            f"{found['worst_rhat']['value']:.4f}, Pareto k of the proposal {found['proposal_pareto_k']:.2f}.\n"
        )
        print("| difference | worst | of | median |\n|---|---|---|---|")
        print("\n".join(compare(posterior, reference["quantities"])))
        with jax.enable_x64(True):
            moved = stretch(joint, start, path)
        print("\n| sampler | worst bulk ESS | CPU s | wall s | ESS per CPU s | ESS per wall s |")
        print("|---|---|---|---|---|---|")
        print(f"| tvsbayes | {least:.0f} | {cpu:.0f} | {wall:.0f} | {least / cpu:.1f} | {least / wall:.1f} |")
        print(
            f"| emcee stretch, {STRETCH_STEPS} steps | {moved.ess:.0f} | {moved.cpu_s:.0f} | {moved.wall_s:.0f} | "
            f"{moved.ess / moved.cpu_s:.2f} | {moved.ess / moved.wall_s:.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
