"""What do the plain and the robust fit do with data that break the model?

    python -m experiments.intervals.broken_data run --n 60 --cores 0 1     # 7 s a rig and core, resumable
    python -m experiments.intervals.broken_data table > experiments/intervals/broken_data.md

`run` fits campaigns of 96 spots (`rigs.small_plan`), rig i drawn with seed i, every prior quantity, with the
Laplace approximation, plain and robust, after breaking the model: a share of the spots off by 10 stated sds in one
camera, Student-t(4) pixel noise of the same variance, and a pinion error of 0.1 deg that the fit does not model.
`table` prints RMS z and the coverage of central intervals; **!** marks a figure outside its two-sided bounds at 1e-4
for that number of rigs. Nothing is left out for looking bad; rigs that did not converge are counted and listed.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from experiments.common.command_line import study
from experiments.common.headlines import HEADLINES, JUDGED, judged, limits, verdict
from experiments.common.page import heading, line
from experiments.common.rigs import PIXELS, drawn_truth, mounted_rig, pixels_of, small_plan, unseen, with_pixels
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.instrument.model_choice import ModelChoice
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.twin.simulated_campaign import simulate

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


def broken_campaign(condition: str, seed: int):
    """A simulated campaign of 96 spots that breaks the model in one way; clean and broken share rig and stop errors."""
    rig = mounted_rig()
    generator = np.random.default_rng([seed, 0x6272])
    if condition == "pinion error":
        rig = replace(
            rig, table=replace(rig.table, harmonic_period_deg=dict.fromkeys(("pan", "tilt"), (PINION_PERIOD_DEG,)))
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
    use_compilation_cache()
    campaign, truth = broken_campaign(condition, seed)
    row: dict[str, object] = {"condition": condition, "seed": seed, "unseen": unseen(campaign)}
    for name, robust in (("plain", False), ("robust", True)):
        start = time.perf_counter()
        try:
            result = fit(campaign, model=ModelChoice(robust=robust))
            entry: dict[str, object] = {"converged": result.converged, "problems": list(result.problems)}
            entry["excluded"] = len(result.excluded_spots)
            entry["suspect"] = len(result.suspect_spots)
            entry["values"] = judged(result, truth, result.campaign)
        except Exception as error:
            entry = {"converged": False, "problems": [repr(error)]}
        row[name] = {**entry, "seconds": time.perf_counter() - start}
    return row


def _width(rows: list[dict], by: str, name: str, clean: dict[int, dict]) -> float:
    """Median width of an interval over that of the plain fit of the same rig, clean."""
    pairs = [(r[by]["values"][name], clean[r["seed"]][name]) for r in rows if r[by]["converged"] and r["seed"] in clean]
    return float(np.median([np.sqrt(1 - one["contraction"]) / np.sqrt(1 - of["contraction"]) for one, of in pairs]))


TEXT = """# Data that break the model: Laplace, plain and robust

Written by `python -m experiments.intervals.broken_data table` after `run`. **!** marks a figure outside its
bounds at 1e-4; rig i has seed i. Two shared cores.

96 spots per rig: both axes swept there and back twice at four placements (d1, d2, d3, d2).

`sd` is the median width of the interval over that of the plain fit of the same rig, clean.
"""


def table(rows: list[dict]) -> None:
    """Plain beside robust under every broken condition."""
    print(TEXT)
    plain = {r["seed"]: r["plain"] for r in rows if r["condition"] == "clean"}
    clean = {seed: fit["values"] for seed, fit in plain.items() if fit["converged"]}
    for condition, words in BROKEN.items():
        chosen = [r for r in rows if r["condition"] == condition]
        if not chosen:
            continue
        print(f"## {condition}: {words}\n")
        good = {by: [r[by] for r in chosen if r[by]["converged"]] for by in ("plain", "robust")}
        for by, entries in good.items():
            excluded, suspect = (np.mean([e[key] for e in entries]) for key in ("excluded", "suspect"))
            print(f"- {by}: {len(entries)} of {len(chosen)} rigs converged, {excluded:.2f} spots excluded and ", end="")
            print(f"{suspect:.2f} suspect per rig, median {np.median([e['seconds'] for e in entries]):.1f} s")
        print("\n" + heading("quantity | fit | sd", JUDGED))
        least = min(map(len, good.values()))
        print(f"| bounds at 1e-4, N = {least} | | | {limits(least)} | |")
        for name in HEADLINES:
            for by, entries in good.items():
                width = _width(chosen, by, name, clean)
                print(line(name, by, f"{width:.2f}", verdict([e["values"][name] for e in entries]).cells))
        print()
        for r in chosen:
            for by in good:
                if not r[by]["converged"]:
                    print(f"- not converged: {by} seed {r['seed']}: {'; '.join(r[by]['problems'])}")
        print()


if __name__ == "__main__":
    study(__file__, __doc__, broken_rig, ("condition", "seed"), BROKEN, table, 60)
