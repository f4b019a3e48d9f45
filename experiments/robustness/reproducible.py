"""Same seed, same numbers? Across processes, compilation caches, study engines, orders of spots and Python versions.

    python -m experiments.robustness.reproducible run NAME [--cold] [--short]     # a process's numbers, hexadecimal
    python -m experiments.robustness.reproducible table > experiments/robustness/reproducible.md

Run it under NAMEs of your choice: twice with the compilation cache, once `--cold` (an empty one), and with another
Python's interpreter. `--short` leaves the study out. Numbers go to `experiments/output/robustness/`.

Campaign: 60 spots of a rig drawn from the shipped mounted one. The chain is what `fit` stores; runs that had
different amounts of time are compared over the steps that both made.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from experiments.common.command_line import act, parser
from experiments.common.headlines import headlines
from experiments.common.rigs import dense_plan, mounted_rig
from experiments.common.rows import commit, output
from tvsbayes.estimators.joint_fit import JointFit, fit
from tvsbayes.estimators.plausibility import check_campaign
from tvsbayes.instrument.campaign import campaign_toml, moves_bytes, spots_bytes
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.instrument.rig import Rig
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.planning.target import DEFAULT_TARGET, parse_target
from tvsbayes.posterior.sampling import sample
from tvsbayes.results.tiers import CHAIN
from tvsbayes.studies.rows import StudyRows
from tvsbayes.studies.study import study
from tvsbayes.studies.study_job import StudyJob
from tvsbayes.twin.simulated_campaign import simulate

CACHE = output(__file__, "reproducible-cache")
SEED = 20261121
CAMPAIGNS = 2
SAMPLE_MINUTES = 0.1
STEPS_COMPARED = 20
TOLERANCE_SD = 1e-3
"""Of a posterior sd: a thousandth of the uncertainty changes no digit that a report prints (two digits of u)."""
TOLERANCE_TEXT = f"""
Tolerance: {TOLERANCE_SD:g} of a posterior sd. Levenberg-Marquardt stops at a step far below it, sums of some \
thousand float64 terms round at 1e-13 of their size, and a report prints two digits of u."""
PACKAGES = ("numpy", "scipy", "jax", "jaxlib", "emcee")


def digest(*parts: bytes) -> str:
    """One hash over all parts."""
    return hashlib.sha256(b"\0".join(parts)).hexdigest()


def exact(values) -> list[str]:
    """Numbers without a lost bit."""
    return [float(value).hex() for value in np.ravel(values)]


def numbers_of(found_fit: JointFit) -> dict[str, list[str]]:
    """What a fit hands out."""
    numbers = {"z": exact(found_fit.z)}
    for name, values in headlines(found_fit.draws).items():
        numbers[f"{name}, mean"] = exact(np.mean(values))
        numbers[f"{name}, sd"] = exact(np.std(values))
    return numbers


def file_of(name: str) -> Path:
    """Numbers of a run; * stands for all of them."""
    return output(__file__, f"reproducible-{name}.json")


def run(arguments: argparse.Namespace) -> None:
    """All numbers of one process."""
    name, cold = arguments.name, arguments.cold
    began = time.process_time()
    with tempfile.TemporaryDirectory() as scratch:
        os.environ["TVSBAYES_CACHE"] = str(Path(scratch) / "cache" if cold else CACHE)
        use_compilation_cache()
        rig, plan = mounted_rig(), dense_plan(("d1", "d3"))
        simulated = simulate(rig, plan, seed=SEED)
        campaign = simulated.campaign
        tables = (moves_bytes(campaign.moves), spots_bytes(campaign.spots), campaign_toml(campaign))
        document: dict[str, object] = {
            "python": platform.python_version(),
            "versions": {package: version(package) for package in PACKAGES},
            "cold": cold,
            "campaign": digest(*tables),
            "check": digest(json.dumps(check_campaign(campaign).as_json(), sort_keys=True).encode()),
        }
        fitted = fit(campaign, seed=SEED)
        document["fit"] = numbers_of(fitted)
        order = np.random.default_rng(SEED).permutation(len(campaign.spots))
        shuffled = replace(campaign, spots=tuple(campaign.spots[k] for k in order))
        document["shuffled"] = numbers_of(fit(shuffled, seed=SEED))
        chain = Path(scratch) / "chain.npz"
        sample(fitted, CHAIN, max_minutes=SAMPLE_MINUTES, seed=SEED, checkpoint=chain)
        with np.load(chain) as file:
            document["steps"] = len(file["w"])
            document["chain"] = exact(file["w"][:STEPS_COMPARED])
        if not arguments.short:
            document["study"] = studied(rig, plan, Path(scratch))
        document["cpu_s"] = time.process_time() - began
    file_of(name).parent.mkdir(parents=True, exist_ok=True)
    file_of(name).write_text(json.dumps(document))


def studied(rig: Rig, plan: Sequence[PlanStep], scratch: Path) -> dict[str, object]:
    """Rows of a study by engine, without their seconds."""
    job = StudyJob(rig, plan, parse_target(DEFAULT_TARGET), SEED)
    results: dict[str, object] = {}
    for engine in ("serial", "processes", "dask"):
        rows = StudyRows(scratch / f"{engine}.jsonl")
        try:
            study(job, CAMPAIGNS, rows, engine=engine, workers=1)
        except Exception as error:
            results[engine] = f"not run: {str(error)[:100]}"
            continue
        results[engine] = {
            i: {k: v for k, v in row.as_json().items() if k != "seconds"} for i, row in sorted(rows.of(job.key).items())
        }
    return results


def values_of(texts: list[str]) -> np.ndarray:
    """The numbers again."""
    return np.array([float.fromhex(text) for text in texts])


def compared(one: dict[str, list[str]], other: dict[str, list[str]]) -> str:
    """Of two fits: identical, or the largest difference in posterior sds."""
    if one == other:
        return "the same to the last bit"
    worst = 0.0
    for name in one:
        if name.endswith(", mean"):
            sd = values_of(one[name.replace(", mean", ", sd")])
            worst = max(worst, float(np.max(np.abs(values_of(one[name]) - values_of(other[name])) / sd)))
    z = float(np.max(np.abs(values_of(one["z"]) - values_of(other["z"]))))
    verdict = "within" if worst <= TOLERANCE_SD else "BEYOND"
    return f"means differ by {worst:.1e} posterior sd ({verdict} {TOLERANCE_SD:g}), coordinates by {z:.1e} prior sd"


def chains(one: dict, other: dict) -> str:
    """Of two chains: identical over the common steps, or the first that differs."""
    a, b = values_of(one["chain"]), values_of(other["chain"])
    n = min(len(a), len(b))
    if n and np.array_equal(a[:n], b[:n]):
        return f"the same to the last bit over {min(one['steps'], other['steps'], STEPS_COMPARED)} steps"
    return (
        f"differs by up to {np.max(np.abs(a[:n] - b[:n])):.1e} of a transported sd in the first {STEPS_COMPARED} steps"
    )


def table(_: argparse.Namespace) -> None:
    """Markdown."""
    runs = {
        path.stem.removeprefix("reproducible-"): json.loads(path.read_text())
        for path in sorted(file_of("*").parent.glob(file_of("*").name))
    }
    first, base = next(iter(runs.items()))
    print("# Same seed, same numbers\n")
    print(f"{time.strftime('%Y-%m-%d')}, commit {commit()},", end=" ")
    print(f"{platform.machine()}. Every run is compared with `{first}`.\n")
    print("| run | Python | cache | campaign and `check` | fit | chain | CPU s |\n|---|---|---|---|---|---|---|")
    for name, one in runs.items():
        same = all(one[k] == base[k] for k in ("campaign", "check"))
        verdicts = (compared(base["fit"], one["fit"]), chains(base, one)) if name != first else ("-", "-")
        cells = (name, one["python"], "empty" if one["cold"] else "kept", "same bytes" if same else "OTHER BYTES")
        print(f"| {' | '.join((*cells, *verdicts))} | {one['cpu_s']:.0f} |")
    print("\nSpots in another order, in the same process: ", end="")
    print("; ".join(f"`{name}`: {compared(one['fit'], one['shuffled'])}" for name, one in runs.items()) + ".\n")
    for name, one in runs.items():
        for engine, rows in one.get("study", {}).items():
            serial = one["study"]["serial"]
            same = f"{len(rows)} rows, {'the same' if rows == serial else 'OTHER'}"
            print(f"- study, run `{name}`, engine {engine}: {rows if isinstance(rows, str) else same}")
    versions = {json.dumps(one["versions"], sort_keys=True) for one in runs.values()}
    print(f"\nPackages: {'; '.join(sorted(versions))}.")
    print(TOLERANCE_TEXT)


if __name__ == "__main__":
    cli = parser(__doc__, run=run, table=table)
    cli.add_argument("name", nargs="?", help="of a run")
    cli.add_argument("--cold", action="store_true", help="with an empty compilation cache")
    cli.add_argument("--short", action="store_true", help="without the study")
    act(cli)
