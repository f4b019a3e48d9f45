"""What do the plain and the robust fit do with data that break the model?

    python -m experiments.intervals.broken_data run --n 60 --cores 0 1     # 7 s a rig and core, resumable
    python -m experiments.intervals.broken_data table > experiments/intervals/broken_data.md

`run` fits campaigns of 96 spots (`rigs.small_plan`), rig i drawn with seed i, every prior quantity, with the
Laplace approximation, plain and robust, after breaking the model: a share of the spots off by 10 stated sds in one
camera, Student-t(4) pixel noise of the same variance, and a pinion error of 0.1 deg that the fit does not model.
Nothing is left out for looking bad; rigs that did not converge are counted and listed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from experiments.common.against_truth import NOTE, failures, table, tried
from experiments.common.command_line import study
from experiments.common.rigs import PIXELS, drawn_truth, mounted_rig, pixels_of, small_plan, with_pixels
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.model_choice import ModelChoice
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
MODELS = {"plain": ModelChoice(), "robust": ModelChoice(robust=True)}


def broken_campaign(condition: str, seed: int):
    """A simulated campaign of 96 spots that breaks the model in one way; clean and broken share rig and stop errors."""
    rig, generator = mounted_rig(), np.random.default_rng([seed, 0x6272])
    if condition == "pinion error":
        periods = dict.fromkeys(AXES, (PINION_PERIOD_DEG,))
        rig = replace(rig, table=replace(rig.table, harmonic_period_deg=periods))
    truth = drawn_truth(rig, seed)
    scale = truth.parameters["pixel_scale"]
    if condition == "pinion error":
        for axis in AXES:
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


def one_fit(task: tuple[str, str, int]) -> dict[str, object]:
    condition, model, seed = task
    campaign, truth = broken_campaign(condition, seed)

    def spots(fit) -> dict[str, object]:
        return {"excluded": len(fit.excluded_spots), "suspect": len(fit.suspect_spots)}

    row = {"condition": condition, "model": model, "seed": seed}
    return row | tried(campaign, truth, more=spots, model=MODELS[model])


def page(rows: list[dict]) -> None:
    print("# Data that break the model: Laplace, plain and robust\n\nWritten by `python -m")
    print(f"experiments.intervals.broken_data table` after `run`. {NOTE}.\n\n96 spots per rig: both axes swept there")
    print("and back twice at four placements (d1, d2, d3, d2).\n")
    for condition, words in BROKEN.items():
        chosen = [row for row in rows if row["condition"] == condition]
        by = {name: [row for row in chosen if row["model"] == name and row["answer"] == "fitted"] for name in MODELS}
        if not all(by.values()):
            continue
        print(f"## {condition}: {words}\n")
        for name, of in by.items():
            excluded, suspect = (np.mean([row[key] for row in of]) for key in ("excluded", "suspect"))
            print(
                f"- {name}: {len(of)} rigs converged, {excluded:.2f} spots excluded and {suspect:.2f} suspect per rig"
            )
        print()
        table({name: [row["laplace"] for row in of] for name, of in by.items()})
        failures(chosen, ("condition", "model", "seed"), ("fitted",))


if __name__ == "__main__":
    kinds = [(condition, model) for condition in BROKEN for model in MODELS]
    study(__file__, __doc__, one_fit, ("condition", "model", "seed"), kinds, page, 60)
