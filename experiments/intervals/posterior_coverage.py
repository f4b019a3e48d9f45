"""Do the sampled intervals hold the truth, by importance sampling (tier 1) and by the chain (tier 2)?

    python -m experiments.intervals.posterior_coverage run --n 1000 --cores 0 1     # 2 to 6 CPU s a rig, resumable
    python -m experiments.intervals.posterior_coverage run --tier emcee --n 100 --cores 0 1
    python -m experiments.intervals.posterior_coverage table > experiments/intervals/posterior_coverage.md

`run` draws rig i of the paper's, the mixed and the grid protocol from `data/rigs/mounted` with seed i, every prior
quantity, simulates the protocol, fits it and samples its posterior by one tier. `table` prints RMS z and the
coverage of central intervals for every headline; **!** marks a figure outside its two-sided bounds at 1e-4 for that
number of rigs. Judged are the rigs whose tier was accepted, as a user would get them; the last column has all rigs. A
quantity whose median contraction is below 0.1 is printed as "prior" and not judged. The same table of draws shrunk
about their mean by 0.8 has to fail. What fit or tier refused is counted and listed. The small rigs of `sbc.py`, whose
ranks hold the coverage where stops are few, come last.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import numpy as np

from experiments.common.command_line import by_seed, study
from experiments.common.headlines import HEADLINES, JUDGED, MEAN_RATIOS, NOTE, SHRINK, judged, limits, marked, verdict
from experiments.common.page import heading, line
from experiments.common.rigs import drawn_rig, shipped_plan, unseen
from experiments.common.rows import read_rows
from experiments.intervals.sbc import CLEAN, DRAWS, FEW
from experiments.intervals.sbc import ROWS as SBC_ROWS
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.posterior.sampling import TIERS, sample
from tvsbayes.results.records import plain
from tvsbayes.statistics.chances import LEVELS, binomial_bounds
from tvsbayes.twin.simulated_campaign import simulate

PROTOCOLS = ("paper", "mixed", "grid")
TITLES = {TIERS[0]: "Tier 1, importance sampling", TIERS[1]: "Tier 2, emcee"}
ALL = HEADLINES + MEAN_RATIOS
MAX_MINUTES = 10.0
LAST = "effective share | least effective draws of a quantity | heaviest weight, % | fit, CPU s | sampling, CPU s"
SMALL = {CLEAN: "60 spots, about 30 stops in every direction", FEW: "48 spots, twelve stops in every direction"}
SMALL_HEADLINES = (
    *(f"effective_deg_per_step.{d}" for d in DIRECTIONS),
    *("ratio_contrast_deg_per_step.pan", "ratio_contrast_deg_per_step.tilt", "backlash_deg.pan", "backlash_deg.tilt"),
    "effective_mirror_offset_mm",
)


def one_rig(task: tuple[str, str, int]) -> dict[str, object]:
    """One rig of a shipped protocol, by Laplace and by a tier; whatever fails is recorded as a failure."""
    tier, protocol, seed = task
    use_compilation_cache()
    simulated = simulate(drawn_rig(), shipped_plan(protocol), seed, aperture=protocol == "grid")
    row: dict[str, object] = {"tier": tier, "protocol": protocol, "seed": seed, "converged": False, "sampled": False}
    row["unseen"] = unseen(simulated.campaign)
    start = time.process_time()
    try:
        result = fit(simulated.campaign)
        row |= {"converged": result.converged, "problems": list(result.problems)}
        row["laplace"] = judged(result, simulated.truth, simulated.campaign)
        row["fit_cpu_s"] = time.process_time() - start
        start = time.process_time()
        posterior = sample(result, tier=tier, seed=seed, max_minutes=MAX_MINUTES)
        row["sample_cpu_s"] = time.process_time() - start
        row["sampled"] = bool(posterior.converged)
        row["problems"] = [*result.problems, *posterior.convergence.missing]
        row["sampling"] = plain(posterior.convergence.sampling)
        row["posterior"] = judged(posterior, simulated.truth, simulated.campaign)
    except Exception as error:
        row["problems"] = [*row.get("problems", []), repr(error)]
    return row


def _share_held(entries: Sequence[dict], level: float) -> float:
    """Share of the central intervals of a level that hold the truth."""
    return float(np.mean([abs(e["pit"] - 0.5) < level / 2 for e in entries]))


def coverage(good: list[dict], every: list[dict]) -> None:
    """Laplace beside posterior on the rigs `good`; 95 % also on `every` rig that has draws."""
    print(heading("quantity | by", JUDGED, f"95 %, all {len(every)}"))
    print(f"| bounds at 1e-4, N = {len(good)} | | {limits(len(good))} | | |")
    low, high = binomial_bounds(len(every), LEVELS[-1])
    failing = 0
    for name in ALL:
        for by in ("laplace", "posterior"):
            entries = [r[by][name] for r in good]
            found = verdict(entries)
            share = _share_held([r[by][name] for r in every], LEVELS[-1])
            whole = marked(f"{100 * share:.1f}", low <= share <= high)
            print(line(name, by, found.cells, whole))
        failing += not verdict(entries, shrunk=True).within
    print(f"\nWith draws shrunk about their mean by {SHRINK}: {failing} of {len(ALL)} quantities OUTSIDE.\n")


def _spread(values: Sequence[float], form: str) -> str:
    """Median with the tenth and ninetieth percentile."""
    low, middle, high = np.quantile(values, [0.1, 0.5, 0.9])
    return f"{middle:{form}} ({low:{form}} to {high:{form}})"


WORKINGS = f"""Medians with 10 % and 90 % quantiles; k, draws and weights are of importance sampling.

{heading("protocol | rigs | fit converged | accepted | Pareto k | worst k of a headline | draws", LAST)}"""


def workings(of: dict[str, list[dict]]) -> None:
    """Diagnostics and cost of the tier, by protocol."""
    print(WORKINGS)
    for protocol, rows in of.items():
        done = [r for r in rows if "posterior" in r]
        if not done:
            continue
        runs = [r["sampling"]["importance"] for r in done]
        accepted = sum(r["converged"] and r["sampled"] for r in rows)
        cells = [protocol, len(rows), sum(r["converged"] for r in rows)]
        cells += [f"{accepted} ({100 * accepted / len(rows):.1f} %)", _spread([t["pareto_k"] for t in runs], ".2f")]
        cells += [_spread([t["worst_pareto_k"]["value"] for t in runs], ".2f")]
        cells += [_spread([t["draws"] for t in runs], ".0f"), _spread([t["effective_share"] for t in runs], ".2f")]
        ends = [[r["sampling"][f"least_ess_{end}"]["value"] for r in done] for end in ("bulk", "tail")]
        cells += [_spread(np.min(ends, axis=0), ".0f"), _spread([100 * t["heaviest_share"] for t in runs], ".2f")]
        print(line(*cells, *(_spread([r[f"{w}_cpu_s"] for r in done], ".1f") for w in ("fit", "sample"))))
    print()


def table_tier(tier: str, rows: list[dict]) -> None:
    """Coverage and workings of one tier over all protocols; nothing of a tier that was not run."""
    of = {p: [r for r in rows if r["tier"] == tier and r["protocol"] == p] for p in PROTOCOLS}
    if not any(of.values()):
        return
    print(f"## {TITLES[tier]}\n")
    workings(of)
    for protocol, chosen in of.items():
        good = [r for r in chosen if r["converged"] and r["sampled"]]
        print(f"### {protocol}: {len(chosen)} rigs, {len(good)} with a converged fit and accepted draws\n")
        if good:
            coverage(good, [r for r in chosen if "posterior" in r])
        refused = [r for r in chosen if r not in good]
        for r in refused:
            print(f"- not accepted: {protocol} seed {r['seed']}: {'; '.join(r['problems'])}")
        if refused:
            print()


def table_small(rows: list[dict]) -> None:
    """The posterior's intervals on the small rigs of the simulation-based calibration, from the ranks of the truths."""
    print("## Small campaigns, tier 1\n")
    print(f"Drawn rigs of `python -m experiments.intervals.sbc run`; intervals are those of the {DRAWS} draws kept of")
    print("each. Rigs that were not accepted stand in [its table](sbc.md).\n")
    for variant, words in SMALL.items():
        good = [r for r in rows if r["variant"] == variant and r["converged"]]
        if not good:
            continue
        print(f"### {words}: {len(good)} rigs\n")
        print(heading("quantity", JUDGED.removeprefix("RMS z | ")))
        print(f"| bounds at 1e-4, N = {len(good)} | {limits(len(good)).partition(' | ')[2]} | |")
        for name in SMALL_HEADLINES:
            pit = np.array([(r["ranks"][name] + 0.5) / (DRAWS + 1) for r in good])
            held = [float(np.mean(np.abs(pit - 0.5) <= level / 2)) for level in LEVELS]
            bounds = [binomial_bounds(len(good), level) for level in LEVELS]
            within = all(low <= share <= high for share, (low, high) in zip(held, bounds, strict=True))
            print(f"| {name} | {' | '.join(f'{100 * h:.1f}' for h in held)} | {'within' if within else 'OUTSIDE'} |")
        print()


TEXT = f"""# Coverage of the sampled posterior

Written by `python -m experiments.intervals.posterior_coverage table`; what is in it and how it was made
stands in the script. {NOTE}; rig i has seed i. Gears repeat their
errors, as the priors of the mounted rig draw them. What importance sampling refuses goes on to the chain
in `fit`, `calibrate` and `study`. CPU seconds on two cores shared with other work; their medians are free
of compilation.
"""


def table(rows: list[dict]) -> None:
    """The page."""
    print(TEXT)
    for tier in TIERS:
        table_tier(tier, rows)
    table_small(read_rows(SBC_ROWS))


def tasks(of: argparse.Namespace) -> list[tuple]:
    """Of one tier."""
    return [(of.tier, *task) for task in by_seed(PROTOCOLS, of.n)]


if __name__ == "__main__":
    tier = {"--tier": {"default": TIERS[0], "choices": TIERS}}
    study(__file__, __doc__, one_rig, ("tier", "protocol", "seed"), tasks, table, 1000, tier)
