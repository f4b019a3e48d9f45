"""What is the exact posterior of the two twins with perfect gears? NUTS references, and what a draw costs.

    taskset -c 1 python -m experiments.sampler.nuts_reference paper      # 11 CPU minutes
    taskset -c 1 python -m experiments.sampler.nuts_reference grid --warmup 300 --draws 720     # 5

They write `data/reference/posterior_{paper,grid}.json`: mean, sd and quantiles of every free parameter and
headline under the density of `tvsbayes.estimators.likelihood`, each with its Monte Carlo standard error. NumPyro's NUTS
(the extra `bench`; four chains in step, diagonal mass) samples the sheared coordinates of
`common/reference_samplers.py`: a reference shares no sampling code with `tvsbayes.posterior`, which it judges.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from importlib.metadata import version

import jax
import numpy as np
from arviz_stats.base import array_stats

from experiments.common.clock import timed
from experiments.common.command_line import parser
from experiments.common.reference_samplers import AXES, Run, Setting, build_transport, nuts, potential_of
from experiments.common.rigs import twin_campaign
from experiments.common.rows import ROOT
from tvsbayes.estimators.joint_fit import JointFit, fit
from tvsbayes.estimators.likelihood import evaluate, no_draw
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import Campaign, input_hashes
from tvsbayes.instrument.mechanisms import TWO_MIRROR
from tvsbayes.instrument.model_choice import ModelChoice
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.model.compiled import in_batches
from tvsbayes.model.headlines import derived_quantities

RATIOS = ("effective_deg_per_step", "local_deg_per_step")
OFFSET = "effective_mirror_offset_mm"
ERRORS_SEED = 8
"""Of the errors at places, drawn for every draw of the coordinates."""
CHAINS = 4
QUANTILES = {"q05": 0.05, "q50": 0.50, "q95": 0.95}


def quantities(joint: JointFit, z_of: Callable[[jax.Array], jax.Array], draws: np.ndarray) -> dict[str, np.ndarray]:
    """Free parameters and headlines by contract name, each (chain, draw)."""
    z = jax.jit(jax.vmap(z_of))(draws.reshape(-1, draws.shape[-1]))
    normal = np.random.default_rng(ERRORS_SEED).standard_normal(no_draw(len(z), joint.arrays).shape)
    errors_rad = in_batches(
        lambda *block: evaluate(*block, joint.space, joint.arrays).place_errors_rad, np.asarray(z), normal
    )
    derived = derived_quantities(z, errors_rad, joint.space, joint.seen_line)
    shape = draws.shape[:2]
    physical = np.asarray(derived.physical)
    named = {TWO_MIRROR.names[k]: physical[:, k].reshape(shape) for k in np.flatnonzero(joint.free)}
    for kind in RATIOS:
        ratio = np.asarray(getattr(derived, kind)).reshape(*shape, len(DIRECTIONS))
        named |= {f"{kind}.{direction}": ratio[..., k] for k, direction in enumerate(DIRECTIONS)}
    return named | {OFFSET: derived["effective_mirror_offset_mm"].reshape(shape)}


def summary(values: np.ndarray) -> dict[str, float]:
    """Moments and quantiles of one quantity (chain, draw), each with its Monte Carlo standard error."""
    row = {"mean": values.mean(), "mean_mcse": array_stats.mcse(values, method="mean", **AXES)}
    row |= {"sd": values.std(ddof=1), "sd_mcse": array_stats.mcse(values, method="sd", **AXES)}
    for name, level in QUANTILES.items():
        row[name] = np.quantile(values, level)
        row[f"{name}_mcse"] = array_stats.mcse(values, method="quantile", prob=level, **AXES)
    row["ess_bulk"] = array_stats.ess(values, method="bulk", **AXES)
    row["rhat"] = array_stats.rhat(values, **AXES)
    digits = {"ess_bulk": 5, "rhat": 5}
    return {
        name: float(f"{float(x):.{3 if name.endswith('mcse') else digits.get(name, 8)}g}") for name, x in row.items()
    }


def hamiltonian(joint: JointFit, setting: Setting) -> tuple[Run, dict[str, dict[str, float]]]:
    """NUTS of a fit's posterior in sheared coordinates, and the `summary` of every quantity; x64 has to be on."""
    transport, cost = timed(lambda: build_transport(joint))
    size = transport.index.size
    print(f"{size} free coordinates, {len(transport.stiff)} sheared, transport {cost['wall_s']:.1f} s")
    z_of, potential = potential_of(joint, transport)
    run = nuts(potential, size, setting)
    return run, {name: summary(values) for name, values in quantities(joint, z_of, run.draws).items()}


def content_hash(reference: dict[str, object]) -> str:
    """SHA-256 of a reference without its own hash, as canonical JSON."""
    rest = {key: value for key, value in reference.items() if key != "sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def write_reference(twin: str, campaign: Campaign, setting: Setting, run: Run, rows: dict[str, dict]) -> None:
    """`data/reference/posterior_TWIN.json`, a quantity a line."""
    reference = {
        "twin": f"{twin}_twin",
        "target": "tvsbayes.estimators.likelihood.evaluate, perfect gears",
        "sampler": "NUTS in sheared coordinates, experiments/sampler/nuts_reference.py",
        "versions": {name: version(name) for name in ("numpyro", "jax", "numpy")},
        "seed": setting.seed,
        "chains": setting.chains,
        "warmup_per_chain": setting.warmup,
        "draws_per_chain": run.draws.shape[1],
        "divergences": run.divergences,
        "largest_rhat": max(row["rhat"] for row in rows.values()),
        "smallest_ess_bulk": min(row["ess_bulk"] for row in rows.values()),
        "input_sha256": input_hashes(campaign),
        "quantities": rows,
    }
    reference["sha256"] = content_hash(reference)
    lines = ",\n  ".join(f"{json.dumps(name)}: {json.dumps(row)}" for name, row in rows.items())
    text = json.dumps({**reference, "quantities": None}, indent=1)
    text = text.replace('"quantities": null', '"quantities": {\n  ' + lines + "\n }")
    (ROOT / "data" / "reference" / f"posterior_{twin}.json").write_text(text + "\n")


def main() -> None:
    """Write one reference."""
    command = parser(__doc__)
    command.add_argument("twin", choices=("paper", "grid"))
    command.add_argument("--warmup", type=int, default=500)
    command.add_argument("--draws", type=int, default=1500, help="per chain")
    command.add_argument("--seed", type=int, default=20261121)
    options = command.parse_args()

    jax.config.update("jax_enable_x64", True)
    campaign = twin_campaign(f"{options.twin}_twin")
    use_compilation_cache()
    # What the tests ask importance sampling about; gears that repeat their errors are `agreement.py`'s.
    joint = fit(campaign, model=ModelChoice(perfect_gears=True))
    setting = Setting(CHAINS, options.warmup, options.draws, options.seed)
    run, rows = hamiltonian(joint, setting)
    worst = min(rows, key=lambda name: rows[name]["ess_bulk"])
    ess = rows[worst]["ess_bulk"]
    print(
        f"| {options.twin} | {CHAINS} x ({options.warmup} + {run.draws.shape[1]}) | {run.leapfrogs:.1f} | "
        f"{run.divergences} | {run.compile_s:.0f} | {run.warmup_s:.0f} | {run.sampling_s:.0f} | "
        f"{max(row['rhat'] for row in rows.values()):.4f} | {ess:.0f} ({worst}) | "
        f"{ess / run.sampling_s:.2f} | {ess / (run.sampling_s + run.warmup_s):.2f} | acceptance {run.acceptance:.3f}",
        flush=True,
    )
    write_reference(options.twin, campaign, setting, run, rows)


if __name__ == "__main__":
    main()
