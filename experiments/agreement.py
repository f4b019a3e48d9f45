"""Does the sampler give the posterior that NUTS gives, and how fast beside emcee's stretch move?

For each twin: sample as `tvsbayes fit` does, compare every parameter and headline with the NUTS reference in
`data/reference/` (means in sds, sds in per cent, 5, 50 and 95 % quantiles in Monte Carlo errors of both), then run
emcee's default stretch move on the same density, started from the same walkers in Laplace-whitened coordinates.

    python experiments/agreement.py > experiments/agreement.md        (4 minutes on two quiet cores)

CPU seconds are the process' own; compilation happens before the clocks start.
"""

from __future__ import annotations

import json
import os
import time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import emcee
import jax
import numpy as np
from arviz_stats.base import array_stats

from tvsbayes.estimators.campaign_arrays import use_compilation_cache
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.campaign import input_hashes, read_campaign
from tvsbayes.instrument.parameters import NAMES
from tvsbayes.posterior.proposal import Target, pilot
from tvsbayes.posterior.sampling import sample
from tvsbayes.posterior.transport import transport

AXES = {"chain_axis": 0, "draw_axis": 1}
QUANTILES = {"q05": 0.05, "q50": 0.5, "q95": 0.95}
STRETCH_STEPS = 400


def compare(posterior, reference: dict[str, dict[str, float]]) -> list[str]:
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


def stretch(joint, start: np.ndarray, path) -> tuple[float, float, float]:
    """Worst bulk effective draws, CPU and wall seconds of emcee's default move, Laplace-whitened coordinates."""
    straight = path.straight()
    whitened = straight.to_w(path.mapped(start).z)
    walkers = 2 * len(whitened)
    generator = np.random.default_rng(3)
    whitened = np.concatenate([whitened, whitened + 0.1 * generator.standard_normal(whitened.shape)])
    sampler = emcee.EnsembleSampler(walkers, whitened.shape[1], Target(joint, straight), vectorize=True)
    state = emcee.State(whitened, random_state=np.random.RandomState(1).get_state())
    wall, cpu = time.perf_counter(), time.process_time()
    sampler.run_mcmc(state, STRETCH_STEPS, skip_initial_state_check=True)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    kept = straight.mapped(sampler.get_chain()[STRETCH_STEPS // 4 :].reshape(-1, whitened.shape[1])).z
    kept = kept.reshape(-1, walkers, kept.shape[1])[..., np.flatnonzero(joint.free)].transpose(1, 0, 2)
    return float(np.min(array_stats.ess(kept, method="bulk", **AXES))), cpu, wall


def main() -> None:
    """Print the tables."""
    use_compilation_cache()
    print("# The posterior against NUTS\n\nBy `experiments/agreement.py`; references by `nuts_reference.py`.")
    for name in ("paper", "grid"):
        campaign = read_campaign(shipped_data() / "twins" / f"{name}_twin")
        reference = json.loads((shipped_data() / "reference" / f"posterior_{name}.json").read_text())
        if reference["input_sha256"] != input_hashes(campaign):
            raise SystemExit(f"the reference of the {name} twin was made from other data: run nuts_reference.py")
        joint = fit(campaign)
        with jax.enable_x64(True):
            path = transport(joint)
            start = pilot(Target(joint, path), 0).start
        wall, cpu = time.perf_counter(), time.process_time()
        posterior = sample(joint, seed=0, max_minutes=10.0)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        found = posterior.convergence.as_json()
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
            ess, stretch_cpu, stretch_wall = stretch(joint, start, path)
        print("\n| sampler | worst bulk ESS | CPU s | wall s | ESS per CPU s | ESS per wall s |")
        print("|---|---|---|---|---|---|")
        print(f"| tvsbayes | {least:.0f} | {cpu:.0f} | {wall:.0f} | {least / cpu:.1f} | {least / wall:.1f} |")
        print(
            f"| emcee stretch, {STRETCH_STEPS} steps | {ess:.0f} | {stretch_cpu:.0f} | {stretch_wall:.0f} | "
            f"{ess / stretch_cpu:.2f} | {ess / stretch_wall:.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
