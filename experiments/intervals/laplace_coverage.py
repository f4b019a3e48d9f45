"""Do the intervals hold the truth? Simulated rigs, every prior quantity drawn, refitted by both estimators.

    python -m experiments.intervals.laplace_coverage run --n 300 --cores 0 1     # 2 to 3 s per rig and core, resumable
    python -m experiments.intervals.laplace_coverage table > experiments/intervals/laplace_coverage.md

`run` draws rig i of each protocol (paper, mixed, grid) from `data/rigs/mounted` with seed i, simulates the protocol,
fits, and appends one JSON line per rig. `table` compares coverage of 50/68/90/95 % intervals with binomial bounds
and the RMS of z = (estimate - truth) / sd with chi-square bounds, both two-sided at 1e-4 for that number of rigs, and
shows that the same table with every sd times 0.8 fails. A quantity whose median contraction is below 0.1 is printed
as "prior" and not judged: its interval is the prior's own.
"""

from __future__ import annotations

import time

import numpy as np

from experiments.common.command_line import study
from experiments.common.headlines import HEADLINES, JUDGED, MEAN_RATIOS, NOTE, SHRINK, judged, limits, verdict
from experiments.common.page import heading, line
from experiments.common.rigs import drawn_rig, shipped_plan, unseen
from tvsbayes.estimators.four_point import classic
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.twin.simulated_campaign import simulate

PROTOCOLS = ("paper", "mixed", "grid")


def one_rig(task: tuple[str, int]) -> dict[str, object]:
    """Simulate and refit one rig; whatever fails is recorded as a failure, never dropped."""
    protocol, seed = task
    use_compilation_cache()
    simulated = simulate(drawn_rig(), shipped_plan(protocol), seed, aperture=protocol == "grid")
    campaign, truth = simulated.campaign, simulated.truth
    row: dict[str, object] = {"protocol": protocol, "seed": seed, "unseen": unseen(campaign)}
    start = time.perf_counter()
    try:
        result = fit(campaign)
    except Exception as error:
        return {**row, "converged": False, "problems": [repr(error)]}
    row["seconds"] = time.perf_counter() - start
    row["converged"], row["problems"] = result.converged, list(result.problems)
    row["joint"], true = judged(result, truth, campaign), truth.effective_deg_per_step(campaign)
    if protocol != "grid":
        row["classic"] = {
            direction: {
                "true": true[direction],
                "mean": r.mean_deg_per_step,
                "type_a": r.interval95_type_a,
                "gum": r.interval95_gum,
            }
            for direction, r in classic(campaign).directions.items()
            if r is not None
        }
    return row


def joint_table(good: list[dict]) -> None:
    """Coverage and RMS z of the headlines of one protocol, and of the mean ratios (`degrees_per_step`) behind them."""
    print(heading("quantity | contraction", JUDGED, f"with sd x {SHRINK}"))
    print(f"| bounds at 1e-4 | | {limits(len(good))} | | |")
    for name in HEADLINES + MEAN_RATIOS:
        entries = [r["joint"][name] for r in good]
        contraction = float(np.median([e["contraction"] for e in entries]))
        found, shrunk = verdict(entries), verdict(entries, shrunk=True)
        failed = "prior" if found.prior else ("passes" if shrunk.within else "fails")
        print(line(name, f"{contraction:.4f}", found.cells, failed))
    print()


def classic_table(campaigns: list[dict]) -> None:
    """How often both classic intervals hold the truth, and the median error."""
    print("| classic, 95 % interval | type A holds truth | GUM holds truth | median error, % |\n|---|---|---|---|")
    for direction in DIRECTIONS:
        e = [c[direction] for c in campaigns if direction in c]
        type_a = np.mean([x["type_a"][0] <= x["true"] <= x["type_a"][1] for x in e])
        gum = np.mean([x["gum"][0] <= x["true"] <= x["gum"][1] for x in e])
        error = np.median([x["mean"] / x["true"] - 1 for x in e])
        print(f"| {direction} | {100 * type_a:.1f} % | {100 * gum:.1f} % | {100 * error:+.2f} |")
    print()


def table(rows: list[dict]) -> None:
    """Markdown tables of everything that came out."""
    print("# Coverage of the joint and the classic estimator\n")
    print(f"Written by `python -m experiments.intervals.laplace_coverage table`; {NOTE}.\n")
    for protocol in PROTOCOLS:
        chosen = [r for r in rows if r["protocol"] == protocol]
        if not chosen:
            continue
        good = [r for r in chosen if r["converged"]]
        seconds = np.median([r["seconds"] for r in good])
        print(f"## {protocol}: {len(chosen)} rigs, {len(good)} converged ({100 * len(good) / len(chosen):.1f} %)\n")
        print(f"{sum(r['unseen'] > 0 for r in chosen)} rigs lost a spot out of view; median fit {seconds:.1f} s.\n")
        joint_table(good)
        with_classic = [r["classic"] for r in chosen if "classic" in r]
        if with_classic:
            classic_table(with_classic)
    failures = [r for r in rows if not r["converged"]]
    if failures:
        print("## Not converged\n")
        for r in failures:
            print(f"- {r['protocol']} seed {r['seed']}: {'; '.join(r['problems'])}")


if __name__ == "__main__":
    study(__file__, __doc__, one_rig, ("protocol", "seed"), PROTOCOLS, table, 300)
