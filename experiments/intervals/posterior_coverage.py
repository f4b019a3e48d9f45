"""Do the sampled intervals hold the truth, and what do both estimators do with data that break the model?

    python -m experiments.intervals.posterior_coverage run --n 24 --cores 0 1     # 1 to 6 min a rig, resumable
    python -m experiments.intervals.posterior_coverage broken --n 60 --cores 0 1     # 7 s a rig and core, resumable
    python -m experiments.intervals.posterior_coverage table > experiments/intervals/posterior_coverage.md

`run` draws rig i of the paper's and the grid protocol with seed i, every prior quantity anew, fits it and samples its
posterior: Laplace beside posterior on the same rigs. `broken` fits campaigns of 96 spots (`rigs.small_plan`) with
the Laplace approximation, plain and robust, after breaking the model: a share of the spots off by 10 stated sds in
one camera, Student-t(4) pixel noise of the same variance, and a pinion error of 0.1 deg that the fit does not know.
`table` begins with the small rigs of `sbc.py`, whose ranks hold the coverage of the posterior where stops are few. It
prints RMS z and the coverage of central intervals; **!** marks a figure outside its two-sided bounds at 1e-4
for that number of rigs. Nothing is left out for looking bad; rigs whose fit or sampler did not converge are counted
in the headings and listed.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

from experiments.common.command_line import act, study_parser
from experiments.common.fits import compile_for
from experiments.common.headlines import HEADLINES, judged, level_limits, level_titles, rms_limits, verdict
from experiments.common.rigs import (
    PIXELS,
    drawn_truth,
    mounted_rig,
    pixels_of,
    shipped_plan,
    small_plan,
    unseen,
    with_pixels,
)
from experiments.common.rows import output, read_rows, run_rows
from experiments.common.uniformity import DRAWS
from experiments.intervals.sbc import CLEAN, FEW
from experiments.intervals.sbc import ROWS as SBC_ROWS
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.model_choice import ModelChoice
from tvsbayes.posterior.sampling import sample
from tvsbayes.statistics.chances import LEVELS, binomial_bounds
from tvsbayes.twin.simulated_campaign import simulate

CLEAN_ROWS = output(__file__, "posterior_coverage.jsonl")
BROKEN_ROWS = output(__file__, "broken.jsonl")
PROTOCOLS = ("paper", "grid")
BROKEN = {
    "clean": "nothing broken",
    "outliers 2 %": "2 % of the spots off by 10 stated sds in one camera, any direction",
    "outliers 5 %": "5 % of the spots off by 10 stated sds in one camera, any direction",
    "student t(4)": "pixel noise Student-t(4) with the variance of the normal noise it replaces",
    "pinion error": "0.1 deg of pinion error (period 36 deg, any phase) on both axes, unknown to the fit",
}
OUTLIER_SDS = 10.0
PINION_DEG, PINION_PERIOD_DEG = 0.1, 36.0
SHEETS = ("d1", "d2", "d3", "d2")
MAX_MINUTES = 10.0
SMALL = {CLEAN: "60 spots, about 30 stops in every direction", FEW: "48 spots, twelve stops in every direction"}
SMALL_HEADLINES = (
    *(f"effective_deg_per_step.{d}" for d in DIRECTIONS),
    *("ratio_contrast_deg_per_step.pan", "ratio_contrast_deg_per_step.tilt", "backlash_deg.pan", "backlash_deg.tilt"),
    "effective_mirror_offset_mm",
)


def clean_rig(task: tuple[str, int]) -> dict[str, object]:
    """One rig of a shipped protocol, by Laplace and by sampling."""
    protocol, seed = task
    compile_for(96)
    simulated = simulate(mounted_rig(), shipped_plan(protocol), seed, aperture=protocol == "grid")
    truth = simulated.truth.parameters
    row: dict[str, object] = {"protocol": protocol, "seed": seed, "converged": False, "sampled": False}
    start = time.perf_counter()
    try:
        result = fit(simulated.campaign)
        row |= {"converged": result.converged, "problems": list(result.problems)}
        row["laplace"] = judged(result.draws, result.mode, result.prior_draws, truth, result.reference_pose_rad)
        row["fit_s"] = time.perf_counter() - start
        posterior = sample(result, seed=seed, max_minutes=MAX_MINUTES)
        row["sampled"] = bool(posterior.converged)
        row["problems"] = [*result.problems, *posterior.convergence.missing]
        row["posterior"] = judged(posterior.draws, None, result.prior_draws, truth, result.reference_pose_rad)
    except Exception as error:
        row["problems"] = [*row.get("problems", []), repr(error)]
    return {**row, "seconds": time.perf_counter() - start}


def broken_campaign(condition: str, seed: int):
    """A simulated campaign of 96 spots that breaks the model in one way; clean and broken share rig and stop errors."""
    rig = mounted_rig()
    generator = np.random.default_rng([seed, 0x6272])
    if condition == "pinion error":
        rig = replace(
            rig, table=replace(rig.table, harmonic_period_deg=dict.fromkeys(("pan", "tilt"), PINION_PERIOD_DEG))
        )
    truth = drawn_truth(rig, seed)
    scale = truth.parameters["pixel_scale"]
    if condition == "pinion error":
        for axis in ("pan", "tilt"):
            phase = generator.uniform(0, 2 * np.pi)
            truth.parameters[f"harmonic_deg.{axis}.1.cos"] = PINION_DEG * np.cos(phase)
            truth.parameters[f"harmonic_deg.{axis}.1.sin"] = PINION_DEG * np.sin(phase)
    elif condition == "student t(4)":
        truth.parameters["pixel_scale"] = 0.0
    simulated = simulate(rig, small_plan(SHEETS), seed, truth)
    simulated.truth.parameters["pixel_scale"] = scale
    share = float(condition.split()[1]) / 100 if condition.startswith("outliers") else 0.0
    spots = []
    for spot, pixels in zip(simulated.campaign.spots, pixels_of(simulated.campaign), strict=True):
        if spot.status == "ok":
            sd = spot.su_left_px
            if condition == "student t(4)":
                pixels = pixels + scale * sd * generator.standard_t(4, len(PIXELS)) / np.sqrt(2)
            bad, camera, angle = generator.uniform() < share, generator.integers(2), generator.uniform(0, 2 * np.pi)
            if bad:
                pixels[2 * camera : 2 * camera + 2] += OUTLIER_SDS * sd * np.array([np.cos(angle), np.sin(angle)])
            spot = with_pixels(spot, pixels)
        spots.append(spot)
    return replace(simulated.campaign, spots=tuple(spots)), simulated.truth


def broken_rig(task: tuple[str, int]) -> dict[str, object]:
    """One broken campaign, fitted plain and robust."""
    condition, seed = task
    compile_for(128)
    campaign, truth = broken_campaign(condition, seed)
    row: dict[str, object] = {"condition": condition, "seed": seed, "unseen": unseen(campaign)}
    for name, robust in (("plain", False), ("robust", True)):
        start = time.perf_counter()
        try:
            result = fit(campaign, model=ModelChoice(robust=robust))
            entry: dict[str, object] = {"converged": result.converged, "problems": list(result.problems)}
            entry["excluded"] = len(result.excluded_spots)
            entry["suspect"] = len(result.suspect_spots)
            entry["values"] = judged(
                result.draws, result.mode, result.prior_draws, truth.parameters, result.reference_pose_rad
            )
        except Exception as error:
            entry = {"converged": False, "problems": [repr(error)]}
        row[name] = {**entry, "seconds": time.perf_counter() - start}
    return row


def _widths(rows: list[dict]) -> dict[tuple[int, str], float]:
    """Posterior sd over prior sd of the plain fit of every clean rig, by seed and quantity."""
    return {
        (r["seed"], name): np.sqrt(1 - entry["contraction"])
        for r in rows
        if r["condition"] == "clean" and r["plain"]["converged"]
        for name, entry in r["plain"]["values"].items()
    }


def _header(names: str) -> None:
    print(f"| {names} | RMS z | {level_titles()} | verdict |")
    print("|" + "---|" * (names.count("|") + len(LEVELS) + 3))


def _limits(n: int, blank: str = "") -> None:
    print(f"| bounds at 1e-4, N = {n} | {blank}{rms_limits(n)} | {level_limits(n)} | |")


def table_clean(rows: list[dict]) -> None:
    """Laplace beside posterior on the rigs where both converged."""
    print("## Clean data: Laplace and posterior on the same rigs\n")
    if not rows:
        print("Not run yet.\n")
        return
    for protocol in PROTOCOLS:
        chosen = [r for r in rows if r["protocol"] == protocol]
        good = [r for r in chosen if r["converged"] and r["sampled"]]
        print(f"### {protocol}: {len(chosen)} rigs, {len(good)} with fit and sampler converged\n")
        if good:
            seconds = np.median([r["seconds"] for r in good])
            print(f"Median {seconds:.0f} s for fit and sampling on one core.\n")
            _header("quantity | by")
            _limits(len(good), "| ")
            for name in HEADLINES:
                for by in ("laplace", "posterior"):
                    found = verdict([r[by][name] for r in good])
                    print(f"| {name} | {by} | {' | '.join(found.cells)} | {found.word} |")
            print()
        for r in chosen:
            if r not in good:
                print(f"- not converged: {protocol} seed {r['seed']}: {'; '.join(r['problems']) or 'sampler'}")
        print()


def table_small(rows: list[dict]) -> None:
    """The posterior's intervals on the small rigs of the simulation-based calibration, from the ranks of the truths."""
    print("## Clean data, small campaigns: the posterior\n")
    print(f"Drawn rigs of `python -m experiments.intervals.sbc run`; intervals are those of the {DRAWS} draws kept of")
    print("each. Rigs that did not converge stand in [its table](sbc.md).\n")
    for variant, words in SMALL.items():
        good = [r for r in rows if r["variant"] == variant and r["converged"]]
        if not good:
            continue
        limits = [binomial_bounds(len(good), level) for level in LEVELS]
        print(f"### {words}: {len(good)} rigs\n")
        print(f"| quantity | {level_titles()} | verdict |")
        print("|---|" + "---|" * (len(LEVELS) + 1))
        print(f"| bounds at 1e-4, N = {len(good)} | {level_limits(len(good))} | |")
        for name in SMALL_HEADLINES:
            pit = np.array([(r["ranks"][name] + 0.5) / (DRAWS + 1) for r in good])
            held = [float(np.mean(np.abs(pit - 0.5) <= level / 2)) for level in LEVELS]
            within = all(a <= h <= b for h, (a, b) in zip(held, limits, strict=True))
            print(f"| {name} | {' | '.join(f'{100 * h:.1f}' for h in held)} | {'within' if within else 'OUTSIDE'} |")
        print()


def table_broken(rows: list[dict]) -> None:
    """Plain beside robust under every broken condition."""
    print("## Data that break the model: Laplace, plain and robust\n")
    print("96 spots per rig: both axes swept there and back twice at four placements (d1, d2, d3, d2).\n")
    print("`sd` is the median width of the interval over that of the plain fit of the same rig, clean.\n")
    widths = _widths(rows)
    for condition, words in BROKEN.items():
        chosen = [r for r in rows if r["condition"] == condition]
        if not chosen:
            continue
        print(f"### {condition}: {words}\n")
        good = {by: [r[by] for r in chosen if r[by]["converged"]] for by in ("plain", "robust")}
        for by, entries in good.items():
            excluded = np.mean([e["excluded"] for e in entries])
            suspect = np.mean([e["suspect"] for e in entries])
            seconds = np.median([e["seconds"] for e in entries])
            print(
                f"- {by}: {len(entries)} of {len(chosen)} rigs converged, {excluded:.2f} spots excluded and "
                f"{suspect:.2f} suspect per rig, median {seconds:.1f} s"
            )
        print()
        _header("quantity | fit | sd")
        _limits(min(map(len, good.values())), "| | ")
        for name in HEADLINES:
            for by, entries in good.items():
                found = verdict([e["values"][name] for e in entries])
                width = np.median(
                    [
                        np.sqrt(1 - r[by]["values"][name]["contraction"]) / widths[r["seed"], name]
                        for r in chosen
                        if r[by]["converged"] and (r["seed"], name) in widths
                    ]
                )
                print(f"| {name} | {by} | {width:.2f} | {' | '.join(found.cells)} | {found.word} |")
        print()
        for r in chosen:
            for by in good:
                if not r[by]["converged"]:
                    print(f"- not converged: {by} seed {r['seed']}: {'; '.join(r[by]['problems'])}")
        print()


def run(arguments: argparse.Namespace) -> None:
    """Shipped protocols, fitted and sampled; seeds in the outer loop: an interrupted run leaves balanced designs."""
    tasks = [(p, s) for s in range(arguments.n) for p in arguments.protocols]
    run_rows(clean_rig, tasks, arguments.rows, ("protocol", "seed"), arguments.cores)


def broken(arguments: argparse.Namespace) -> None:
    """Campaigns that break the model."""
    tasks = [(c, s) for s in range(arguments.n) for c in BROKEN]
    run_rows(broken_rig, tasks, BROKEN_ROWS, ("condition", "seed"), arguments.cores)


def table(arguments: argparse.Namespace) -> None:
    """The page."""
    print("# Coverage of the sampled posterior, and of the Laplace approximation on bad data\n")
    print("Written by `python -m experiments.intervals.posterior_coverage table`; what is in it and how it was made")
    print(
        "stands in the script. **!** marks a figure outside its bounds at 1e-4; rig i has seed i. Two shared cores.\n"
    )
    table_small(read_rows(SBC_ROWS))
    table_clean(read_rows(arguments.rows))
    table_broken(read_rows(BROKEN_ROWS))


def main() -> None:
    """Command line."""
    command = study_parser(__doc__, CLEAN_ROWS, n=24, actions=("run", "broken", "table"))
    command.add_argument("--protocols", nargs="+", choices=PROTOCOLS, default=PROTOCOLS)
    act(command, run=run, broken=broken, table=table)


if __name__ == "__main__":
    main()
