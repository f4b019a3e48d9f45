"""Do the intervals hold the truth, by Laplace, by importance sampling (tier 1), by the chain (tier 2), by classic?

    python -m experiments.intervals.posterior_coverage run --tier laplace --n 300 --cores 0 1    # 2 to 3 s a rig
    python -m experiments.intervals.posterior_coverage run --n 1000 --cores 0 1     # 2 to 6 CPU s a rig, resumable
    python -m experiments.intervals.posterior_coverage run --tier emcee --n 100 --cores 0 1
    python -m experiments.intervals.posterior_coverage laplace > experiments/intervals/laplace_coverage.md
    python -m experiments.intervals.posterior_coverage table > experiments/intervals/posterior_coverage.md

Rig i of the paper's, the mixed and the grid protocol is drawn from `data/rigs/mounted` with seed i, every prior
quantity; the protocol is simulated and fitted. Judged are the rigs whose answer a user would get; beside them all that
have draws.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from experiments.common.against_truth import NOTE, USABLE, answers, failures, table, tried
from experiments.common.command_line import by_seed, study
from experiments.common.page import heading, line
from experiments.common.rigs import drawn_rig, shipped_plan
from experiments.common.rows import commit, read_rows
from tvsbayes.estimators.four_point import classic
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.results.tiers import CHAIN
from tvsbayes.twin.simulated_campaign import simulate

KEYS, PROTOCOLS, LAPLACE = ("tier", "protocol", "seed"), ("paper", "mixed", "grid"), "laplace"
TIERS = {"importance": "Tier 1, importance sampling", CHAIN: "Tier 2, the chain"}
MEAN_RATIOS = ("degrees_per_step.pan", "degrees_per_step.tilt")


def one_rig(task: tuple[str, str, int]) -> dict[str, object]:
    tier, protocol, seed = task
    run = simulate(drawn_rig(), shipped_plan(protocol), seed, aperture=protocol == "grid")
    row = {**dict(zip(KEYS, task, strict=True)), "commit": commit()}
    row |= tried(run.campaign, run.truth, None if tier == LAPLACE else tier, names=MEAN_RATIOS, seed=seed)
    if tier == LAPLACE and protocol != "grid":
        true, found = run.truth.effective_deg_per_step(run.campaign), classic(run.campaign).directions
        row["classic"] = {
            d: [true[d], r.mean_deg_per_step, r.interval95_type_a, r.interval95_gum] for d, r in found.items() if r
        }
    return row


def classic_table(campaigns: Sequence[dict]) -> None:
    """How often both classic intervals hold the truth, and the median error."""
    print(heading("classic, 95 % interval | type A holds truth | GUM holds truth | median error, %"))
    for direction in DIRECTIONS:
        of = [each[direction] for each in campaigns if direction in each]
        held = [[low <= true <= high for low, high in ends] for true, _, *ends in of]
        error = np.median([mean / true - 1 for true, mean, *_ in of])
        print(line(direction, *(f"{100 * share:.1f} %" for share in np.mean(held, axis=0)), f"{100 * error:+.2f}"))
    print()


def laplace_page(arguments: argparse.Namespace) -> None:
    print("# Coverage of the joint and the classic estimator\n")
    print(f"Written by `python -m experiments.intervals.posterior_coverage laplace`; {NOTE}.\n")
    rows = [row for row in read_rows(arguments.rows) if row["tier"] == LAPLACE]
    for protocol in PROTOCOLS:
        if chosen := [row for row in rows if row["protocol"] == protocol]:
            good = [row["laplace"] for row in chosen if row["answer"] == "fitted"]
            print(f"## {protocol}: {len(chosen)} rigs, {len(good)} converged\n")
            table({"joint": good})
            if with_classic := [row["classic"] for row in chosen if row.get("classic")]:
                classic_table(with_classic)
    failures(rows, KEYS, ("fitted",))


def spread(values: Sequence[float], form: str) -> str:
    """Median with the tenth and ninetieth percentile."""
    low, middle, high = np.quantile(values, [0.1, 0.5, 0.9])
    return f"{middle:{form}} ({low:{form}} to {high:{form}})"


def workings(of: dict[str, list[dict]]) -> None:
    """Diagnostics and cost of a tier, by protocol."""
    print("Medians with 10 % and 90 % quantiles; k, draws and weights are of importance sampling.\n")
    print(
        heading("protocol | Pareto k | worst k of a headline | draws | effective share | heaviest weight, %", "CPU s")
    )
    for protocol, rows in of.items():
        if done := [row for row in rows if "posterior" in row]:
            runs = [row["sampling"]["importance"] for row in done]
            k, worst = [t["pareto_k"] for t in runs], [t["worst_pareto_k"]["value"] for t in runs]
            cells = [spread(k, ".2f"), spread(worst, ".2f"), spread([t["draws"] for t in runs], ".0f")]
            cells += [spread([t["effective_share"] for t in runs], ".2f")]
            cells += [spread([100 * t["heaviest_share"] for t in runs], ".2f")]
            print(line(protocol, *cells, spread([row["cpu_s"] for row in done], ".1f")))
    print()


def page(rows: list[dict]) -> None:
    print("# Coverage of the sampled posterior\n")
    print(f"Written by `python -m experiments.intervals.posterior_coverage table`; {NOTE}.\nRig i has seed i. What")
    print("importance sampling refuses goes on to the chain in `fit`, `calibrate` and `study`.\n")
    for tier, title in TIERS.items():
        of = {p: [row for row in rows if (row["tier"], row["protocol"]) == (tier, p)] for p in PROTOCOLS}
        if any(of.values()):
            print(f"## {title}\n")
            workings(of)
        for protocol, chosen in of.items():
            if chosen:
                print(f"### {protocol}\n\n{answers(chosen, 'rig')}")
                good = [row for row in chosen if row["answer"] in USABLE]
                by = {way: [row[way] for row in good] for way in ("laplace", "posterior")}
                table({**by, "posterior, all": [row["posterior"] for row in chosen if "posterior" in row]})
                failures(chosen, KEYS)


def tasks(of: argparse.Namespace) -> list[tuple]:
    return [(of.tier, *task) for task in by_seed(PROTOCOLS, of.n)]


if __name__ == "__main__":
    tier = {"--tier": {"default": "importance", "choices": (LAPLACE, *TIERS)}}
    study(__file__, __doc__, one_rig, KEYS, tasks, page, 1000, tier, laplace=laplace_page)
