"""Where do the classic and the joint estimator go wrong? One imperfection of the rig at a time, five levels each.

    python -m experiments.paper.bias run --n 200 --fits 20 --cores 0     # 0.03 s a campaign, 1 s a fit, resumable
    python -m experiments.paper.bias table > experiments/paper/bias.md

`run` draws rig i of `data/rigs/mounted` with seed i, every prior quantity, sets one factor to a level, simulates
four-point experiments (4 per direction, |N| 100 and 200 in turn, 64 spots) and estimates the effective
ratios at the campaign's mean pose by both estimators. The classic estimator sees every seed, the joint one (Laplace, by
`fits.fit_from_truth`) the first `--fits`. Rigs, stop errors and noise of a seed are the same at every level. `table`
prints the mean error over the true ratio with its standard error, the RMS error, and how often 95 % intervals held
the truth, left and right together, up and down together.
"""

from __future__ import annotations

import argparse

import numpy as np

from experiments.common.against_truth import rms
from experiments.common.command_line import study
from experiments.common.fits import fit_from_truth
from experiments.common.page import heading, line
from experiments.common.rigs import drawn_truth, mounted_rig
from tvsbayes.estimators.four_point import classic
from tvsbayes.instrument.axes import DIRECTIONS, SENSES
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.twin.simulated_campaign import simulate

KEYS = ("factor", "level", "seed", "estimator")
FACTORS = {
    "misalignment": (
        (0.0, 0.25, 0.5, 1.0, 2.0),
        "deg, of both mirrors and both laser angles, signs at random (prior u 0.5 deg)",
    ),
    "backlash": ((0.0, 0.1, 0.25, 0.5, 1.0), "deg, both axes (prior: half-normal of scale 0.5 deg)"),
    "focal scale": ((-1.0, -0.5, 0.0, 0.5, 1.0), "%, true over stated focal length, both cameras (prior u 0.2 %)"),
    "spot noise": ((0.02, 0.04, 0.08, 0.16, 0.32), "px, true sd of a centre; 0.08 px is stated"),
}
ANGLES = ("mirror1_error_deg", "mirror2_error_deg", "laser_tilt_deg.x", "laser_tilt_deg.y")
STATED_PX = 0.08


def drawn_campaign(factor: str, level: float, seed: int):
    """A campaign of a drawn rig with one factor set, and its truth."""
    rig = mounted_rig()
    truth = drawn_truth(rig, seed)
    signs = np.random.default_rng([seed, 0x6269]).choice([-1.0, 1.0], size=len(ANGLES))
    factors = {
        "misalignment": {name: float(level * sign) for name, sign in zip(ANGLES, signs, strict=True)},
        "backlash": {f"backlash_deg.{axis}": level for axis in SENSES},
        "focal scale": {"focal_scale": 1 + level / 100},
        "spot noise": {"pixel_scale": level / STATED_PX},
    }
    truth.parameters.update(factors[factor])
    protocol = four_point_protocol(repeats=4, steps=(100, 200))
    simulated = simulate(rig, protocol, seed, truth, spot_sd_px=STATED_PX)
    return simulated.campaign, simulated.truth


def one_campaign(task: tuple[str, float, int, str]) -> dict[str, object]:
    """One estimator: error over the true ratio, and whether its intervals hold the truth, by direction."""
    *about, estimator = task
    campaign, truth = drawn_campaign(*about)
    true, row = truth.effective_deg_per_step(campaign), {**dict(zip(KEYS, task, strict=True)), "problems": [], "by": {}}
    if estimator == "classic":
        for d, r in classic(campaign).directions.items():
            if r is not None:
                held = [low <= true[d] <= high for low, high in (r.interval95_type_a, r.interval95_gum)]
                row["by"][d] = {"error": r.mean_deg_per_step / true[d] - 1, "held": held}
        return row
    use_compilation_cache()
    try:
        fit = fit_from_truth(campaign, truth)
        row["problems"] = list(fit.problems)
        for k, d in enumerate(DIRECTIONS):
            draws, at = fit.draws.effective_deg_per_step[:, k], fit.mode.effective_deg_per_step[k]
            low, high = np.quantile(draws, [0.025, 0.975])
            z = float((at - true[d]) / draws.std())
            row["by"][d] = {"error": float(at / true[d] - 1), "held": [bool(low <= true[d] <= high)], "z": z}
    except Exception as error:
        row["problems"] = [repr(error)]
    return row


def tasks(of: argparse.Namespace) -> list[tuple[str, float, int, str]]:
    """First the classic ones, then fits, seed by seed."""
    cells = [(factor, level) for factor, (levels, _) in FACTORS.items() for level in levels]
    counts = (("classic", of.n), ("joint", of.fits))
    return [(*cell, seed, estimator) for estimator, n in counts for seed in range(n) for cell in cells]


def cells_of(rows: list[dict], axis: str, digits: int) -> list[str]:
    """Number, mean error with its standard error over rigs, RMS error (all in %), and coverage."""
    pairs = [[row["by"][d] for d in SENSES[axis] if d in row["by"]] for row in rows]
    # The two directions of an axis share a rig: the rig is the unit.
    means = [np.mean([each["error"] for each in pair]) for pair in pairs]
    every = [each for pair in pairs for each in pair]
    error = np.std(means, ddof=1) / np.sqrt(len(means)) if len(means) > 1 else np.nan
    spread = 100 * rms([each["error"] for each in every])
    cells = [str(len(means)), f"{100 * np.mean(means):+.{digits}f} ({100 * error:.{digits}f})", f"{spread:.{digits}f}"]
    cells += [f"{100 * share:.0f} %" for share in np.mean([each["held"] for each in every], axis=0)]
    z = [each["z"] for each in every if "z" in each]
    return [*cells, f"{rms(z):.2f}"] if z else cells


def table(rows: list[dict]) -> None:
    print("# Bias and coverage, one imperfection at a time\n")
    print("Written by `python -m experiments.paper.bias table`; see the script for the campaigns.\n")
    for factor, (levels, unit) in FACTORS.items():
        print(f"## {factor}: {unit}\n")
        classic_titles = "level | axis | classic n | mean error, % | RMS, % | type A holds | GUM holds"
        print(heading(classic_titles, "joint n | mean error, % | RMS, % | 95 % holds | RMS z"))
        for level in levels:
            mine = [row for row in rows if row["factor"] == factor and row["level"] == level and not row["problems"]]
            for axis in SENSES:
                cells = [f"{level:g}", axis]
                for estimator, digits in (("classic", 2), ("joint", 3)):
                    of = [row for row in mine if row["estimator"] == estimator]
                    cells += cells_of(of, axis, digits) if of else ["0", *"----"]
                print(line(*cells))
        print()
    bad = [row for row in rows if row["problems"]]
    print(f"{sum(row['estimator'] == 'joint' for row in rows)} fits, {len(bad)} not converged.")
    for row in bad:
        print(f"- {row['factor']} {row['level']:g}, seed {row['seed']}: {'; '.join(row['problems'])}")


if __name__ == "__main__":
    options = {"--fits": {"type": int, "default": 20, "help": "of these many are fitted (%(default)s)"}}
    study(__file__, __doc__, one_campaign, KEYS, tasks, table, 200, options)
