"""Same seed, same numbers? Across processes, compilation caches, study engines, orders of spots and Python versions.

    python -m experiments.robustness.reproducible run NAME [--cold]     # a process's numbers, hexadecimal
    python -m experiments.robustness.reproducible table > experiments/robustness/reproducible.md

Run it under NAMEs of your choice: twice with the compilation cache, once `--cold` (an empty one), and with another
Python's interpreter. Numbers go to `experiments/output/robustness/`. Campaign: 60 spots of a rig drawn from the shipped
mounted one. Of the chain the steps that runs of different lengths share are compared.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from experiments.common.command_line import act, parser
from experiments.common.page import heading, line
from experiments.common.rigs import dense_plan, mounted_rig
from experiments.common.rows import append_row, commit, commits_of, output, read_rows, rows_of

SEED, CAMPAIGNS, SAMPLE_MINUTES, STEPS_COMPARED = 20261121, 2, 0.1, 20
TOLERANCE_SD = 1e-3
"""Of a posterior sd: a thousandth of the uncertainty changes no digit that a report prints (two digits of u)."""
PACKAGES = ("numpy", "scipy", "jax", "jaxlib", "emcee")
ENGINES = ("serial", "processes", "dask")


def exact(values: object) -> list[str]:
    """Numbers without a lost bit."""
    return [float(value).hex() for value in np.ravel(values)]


def numbers_of(fit) -> dict[str, list[str]]:
    """What a fit hands out: coordinates, means and sds of its headlines."""
    from tvsbayes.posterior.draws import headline_names

    draws = {name: fit.draws[name] for name in headline_names(fit)}
    numbers = {"z": exact(fit.z)} | {f"{name}, mean": exact(np.mean(values)) for name, values in draws.items()}
    return numbers | {f"{name}, sd": exact(np.std(values)) for name, values in draws.items()}


def run(arguments: argparse.Namespace) -> None:
    """All numbers of one process."""
    began = time.process_time()
    with tempfile.TemporaryDirectory() as place:
        scratch = Path(place)
        kept = output(__file__, "reproducible-cache")
        os.environ["TVSBAYES_CACHE"] = str(scratch / "cache" if arguments.cold else kept)
        from tvsbayes.estimators.joint_fit import fit
        from tvsbayes.estimators.plausibility import check_campaign
        from tvsbayes.instrument.campaign import campaign_toml, moves_bytes, spots_bytes
        from tvsbayes.model.compilation_cache import use_compilation_cache
        from tvsbayes.posterior.sampling import sample
        from tvsbayes.results.tiers import CHAIN
        from tvsbayes.twin.simulated_campaign import simulate

        use_compilation_cache()
        rig, plan = mounted_rig(), dense_plan(("d1", "d3"))
        campaign = simulate(rig, plan, seed=SEED).campaign
        bytes_of = [moves_bytes(campaign.moves), spots_bytes(campaign.spots), campaign_toml(campaign)]
        bytes_of.append(json.dumps(check_campaign(campaign).as_json(), sort_keys=True).encode())
        fitted = fit(campaign, seed=SEED)
        order = np.random.default_rng(SEED).permutation(len(campaign.spots))
        shuffled = replace(campaign, spots=tuple(campaign.spots[k] for k in order))
        sample(fitted, CHAIN, max_minutes=SAMPLE_MINUTES, seed=SEED, checkpoint=scratch / "chain.npz")
        with np.load(scratch / "chain.npz") as file:
            chain = [exact(step) for step in file["w"][:STEPS_COMPARED]]
        row = {"name": arguments.name, "python": platform.python_version(), "cold": arguments.cold, "commit": commit()}
        row |= {"versions": {package: version(package) for package in PACKAGES}, "fit": numbers_of(fitted)}
        row |= {"campaign": hashlib.sha256(b"\0".join(bytes_of)).hexdigest(), "chain": chain}
        row |= {"shuffled": numbers_of(fit(shuffled, seed=SEED)), "study": studied(rig, plan, scratch)}
    append_row(arguments.rows, {**row, "cpu_s": time.process_time() - began})


def studied(rig, plan: Sequence, scratch: Path) -> dict[str, object]:
    """Rows of a study by engine, without their seconds."""
    from tvsbayes.planning.target import DEFAULT_TARGET, parse_target
    from tvsbayes.studies.rows import StudyRows
    from tvsbayes.studies.study import study
    from tvsbayes.studies.study_job import StudyJob

    job, results = StudyJob(rig, plan, parse_target(DEFAULT_TARGET), SEED), {}
    for engine in ENGINES:
        rows = StudyRows(scratch / f"{engine}.jsonl")
        try:
            study(job, CAMPAIGNS, rows, engine=engine, workers=1)
            results[engine] = [replace(row, seconds=0.0).as_json() for _, row in sorted(rows.of(job.key).items())]
        except Exception as error:
            results[engine] = f"not run: {str(error)[:100]}"
    return results


def compared(one: Mapping[str, list[str]], other: Mapping[str, list[str]]) -> str:
    """Of two fits: identical, or the largest difference in posterior sds."""
    if one == other:
        return "the same to the last bit"
    a, b = ({name: np.array(list(map(float.fromhex, texts))) for name, texts in of.items()} for of in (one, other))
    means = [name for name in a if name.endswith(", mean")]
    worst = max(float(np.max(np.abs(a[n] - b[n]) / a[n.replace(", mean", ", sd")])) for n in means)
    verdict = "within" if worst <= TOLERANCE_SD else "BEYOND"
    return f"means differ by {worst:.1e} posterior sd ({verdict} {TOLERANCE_SD:g})"


def table(arguments: argparse.Namespace) -> None:
    rows = read_rows(arguments.rows)
    base = rows[0]
    print(f"# Same seed, same numbers\n\nCommit {commits_of(rows)}, {platform.machine()}. Every run is compared with")
    print(f"`{base['name']}`; wanted are means within {TOLERANCE_SD:g} of a posterior sd.\n")
    titles = "run | Python | cache | campaign and `check` | fit | spots in another order | chain | studies | CPU s"
    print(heading(titles))
    for row in rows:
        same = "same bytes" if row["campaign"] == base["campaign"] else "OTHER BYTES"
        steps = min(len(row["chain"]), len(base["chain"]))
        equal = row["chain"][:steps] == base["chain"][:steps]
        chain = f"the same over {steps} steps" if equal else "DIFFERS"
        engines = row["study"]
        studies = ", ".join(
            f"{name} {rows if isinstance(rows, str) else 'same' if rows == engines['serial'] else 'OTHER'}"
            for name, rows in engines.items()
        )
        cells = (row["python"], "empty" if row["cold"] else "kept", same, compared(base["fit"], row["fit"]))
        print(line(row["name"], *cells, compared(row["fit"], row["shuffled"]), chain, studies, f"{row['cpu_s']:.0f}"))
    versions = {json.dumps(row["versions"], sort_keys=True) for row in rows}
    print(f"\nPackages: {'; '.join(sorted(versions))}.")


if __name__ == "__main__":
    cli = parser(__doc__, run=run, table=table)
    cli.add_argument("name", nargs="?", help="of a run")
    cli.add_argument("--cold", action="store_true", help="with an empty compilation cache")
    cli.add_argument("--rows", type=Path, default=rows_of(__file__))
    act(cli)
