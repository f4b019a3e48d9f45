"""Where do the classic and the joint estimator go wrong? One imperfection of the rig at a time, five levels each.

    python -m experiments.paper.bias run --n 200 --fits 20 --cores 0     # 0.03 s a campaign, 1 s a fit, resumable
    python -m experiments.paper.bias table > experiments/paper/bias.md       # also writes bias.png

`run` draws rig i of `data/rigs/mounted` with seed i, every prior quantity, sets one factor to a level, simulates
four-point experiments (4 per direction, |N| 100 and 200 in turn, 64 spots) and estimates the effective
ratios at the campaign's mean pose by both estimators. The classic estimator sees every seed, the joint one (Laplace, by
`fits.fit_from_truth`) the first `--fits`. Rigs, stop errors and noise of a seed are the same at every level. `table`
prints the mean error over the true ratio with its standard error, the RMS error, and how often 95 % intervals held
the truth, left and right together, up and down together.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from experiments.common.command_line import study
from experiments.common.figures import page_figure, title_and_figure
from experiments.common.fits import fit_from_truth
from experiments.common.headlines import true_headlines
from experiments.common.page import heading, line
from experiments.common.rigs import drawn_truth, mounted_rig
from tvsbayes.estimators.four_point import classic
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.report.drawing import ESTIMATOR_STYLE
from tvsbayes.twin.simulated_campaign import simulate

FIGURE = Path(__file__).with_suffix(".png")
LEVELS = {
    "misalignment": (0.0, 0.25, 0.5, 1.0, 2.0),
    "backlash": (0.0, 0.1, 0.25, 0.5, 1.0),
    "focal scale": (-1.0, -0.5, 0.0, 0.5, 1.0),
    "spot noise": (0.02, 0.04, 0.08, 0.16, 0.32),
}
UNITS = {
    "misalignment": "deg, of both mirrors and both laser angles, signs at random (prior u 0.5 deg)",
    "backlash": "deg, both axes (prior: half-normal of scale 0.5 deg)",
    "focal scale": "%, true over stated focal length, both cameras (prior u 0.2 %)",
    "spot noise": "px, true sd of a centre; 0.08 px is stated",
}
ANGLES = ("mirror1_error_deg", "mirror2_error_deg", "laser_tilt_deg.x", "laser_tilt_deg.y")
AXES = {"pan": ("left", "right"), "tilt": ("up", "down")}
STATED_PX = 0.08


def drawn_campaign(factor: str, level: float, seed: int):
    """A campaign of a drawn rig with one factor set, and its truth."""
    rig = mounted_rig()
    truth = drawn_truth(rig, seed)
    p = truth.parameters
    if factor == "misalignment":
        signs = np.random.default_rng([seed, 0x6269]).choice([-1.0, 1.0], size=len(ANGLES))
        p |= {name: float(level * sign) for name, sign in zip(ANGLES, signs, strict=True)}
    elif factor == "backlash":
        p |= {f"backlash_deg.{axis}": level for axis in AXES}
    elif factor == "focal scale":
        p["focal_scale"] = 1 + level / 100
    else:
        p["pixel_scale"] = level / STATED_PX
    protocol = four_point_protocol(repeats=4, steps=(100, 200))
    simulated = simulate(rig, protocol, seed, truth, spot_sd_px=STATED_PX)
    return simulated.campaign, simulated.truth


def one_campaign(task: tuple[str, float, int, bool]) -> dict[str, object]:
    """Both estimators, or the classic one alone."""
    factor, level, seed, joint = task
    campaign, truth = drawn_campaign(factor, level, seed)
    row: dict[str, object] = {"factor": factor, "level": level, "seed": seed, "joint": joint}
    if not joint:
        true = truth.effective_deg_per_step(campaign)
        row["classic"] = {
            d: {
                "error": r.mean_deg_per_step / true[d] - 1,
                "type_a": r.interval95_type_a[0] <= true[d] <= r.interval95_type_a[1],
                "gum": r.interval95_gum[0] <= true[d] <= r.interval95_gum[1],
            }
            for d, r in classic(campaign).directions.items()
            if r is not None
        }
        return row
    use_compilation_cache()
    try:
        fit = fit_from_truth(campaign, truth)
        true = true_headlines(truth, campaign, fit.reference_pose_rad)
        row |= {"converged": fit.converged, "problems": list(fit.problems), "values": {}}
        for k, d in enumerate(DIRECTIONS):
            draws, at = fit.draws.effective_deg_per_step[:, k], fit.mode.effective_deg_per_step[k]
            low, high = np.quantile(draws, [0.025, 0.975])
            t = true[f"effective {d}"]
            z = float((at - t) / draws.std())
            row["values"][d] = {"error": float(at / t - 1), "inside": bool(low <= t <= high), "z": z}
    except Exception as error:
        row |= {"converged": False, "problems": [repr(error)]}
    return row


def tasks(of: argparse.Namespace) -> list[tuple[str, float, int, bool]]:
    """First the classic ones, then fits, seed by seed."""
    cells = [(factor, level) for factor, levels in LEVELS.items() for level in levels]
    every = [(*cell, seed, False) for seed in range(of.n) for cell in cells]
    return every + [(*cell, seed, True) for seed in range(of.fits) for cell in cells]


def cell(rows: list[dict], axis: str, estimator: str) -> dict[str, float]:
    """Mean error with its standard error over rigs, RMS error (all in %), and coverage."""
    key, insides = ("classic", ("type_a", "gum")) if estimator == "classic" else ("values", ("inside",))
    entries = [[r[key][d] for d in AXES[axis] if d in r[key]] for r in rows]
    # The two directions of an axis share a rig: the rig is the unit.
    means = np.array([np.mean([e["error"] for e in pair]) for pair in entries])
    every = [e for pair in entries for e in pair]
    figures = {
        "n": len(entries),
        "mean": 100 * means.mean(),
        "se": 100 * means.std(ddof=1) / np.sqrt(len(means)) if len(means) > 1 else np.nan,
        "rms": 100 * np.sqrt(np.mean([e["error"] ** 2 for e in every])),
    }
    figures |= {name: 100 * np.mean([e[name] for e in every]) for name in insides}
    if estimator == "joint":
        figures["rms_z"] = float(np.sqrt(np.mean([e["z"] ** 2 for e in every])))
    return figures


HEADING = heading(
    "level | axis | classic n | mean error, % | RMS, % | type A holds | GUM holds",
    "joint n | mean error, % | RMS, % | 95 % holds | RMS z",
)


def table(rows: list[dict]) -> None:
    """Markdown and figure of everything that came out."""
    title = "Bias and coverage, one imperfection at a time"
    print(title_and_figure(__file__, title, FIGURE, "Bias, error and coverage against imperfections"))
    print("Written by `python -m experiments.paper.bias table`; see the script for the campaigns.\n")
    shown: dict[tuple[str, str, str], list[tuple[float, dict[str, float]]]] = {}
    for factor, levels in LEVELS.items():
        print(f"## {factor}: {UNITS[factor]}\n")
        print(HEADING)
        for level in levels:
            mine = [r for r in rows if r["factor"] == factor and r["level"] == level]
            plain = [r for r in mine if "classic" in r]
            fitted = [r for r in mine if r.get("converged")]
            for axis in AXES:
                texts = [f"{level:g}", axis]
                for name, chosen, insides in (("classic", plain, ("type_a", "gum")), ("joint", fitted, ("inside",))):
                    if not chosen:
                        texts += ["0", *("-" for _ in range(2 + len(insides) + (name == "joint")))]
                        continue
                    c = cell(chosen, axis, name)
                    shown.setdefault((factor, axis, name), []).append((level, c))
                    digits = 2 if name == "classic" else 3
                    texts += [str(c["n"]), f"{c['mean']:+.{digits}f} ({c['se']:.{digits}f})", f"{c['rms']:.{digits}f}"]
                    texts += [f"{c[inside]:.0f} %" for inside in insides]
                    if name == "joint":
                        texts.append(f"{c['rms_z']:.2f}")
                print(line(*texts))
        print()
    bad = [r for r in rows if r["joint"] and not r["converged"]]
    print(f"{sum(r['joint'] for r in rows)} fits, {len(bad)} not converged" + (":" if bad else "."))
    for r in bad:
        print(f"- {r['factor']} {r['level']:g}, seed {r['seed']}: {'; '.join(r['problems'])}")
    figure(shown)


def figure(shown: dict[tuple[str, str, str], list[tuple[float, dict[str, float]]]]) -> None:
    """Mean error above, coverage below, one column per factor."""
    styles = {"classic": ("gum", "classic, GUM interval"), "joint": ("inside", "joint")}
    with page_figure(FIGURE, 6.0, width_in=13.0) as fig:
        axes = fig.subplots(2, len(LEVELS), sharey="row")
        for column, factor in enumerate(LEVELS):
            for name, (inside, label) in styles.items():
                colour = ESTIMATOR_STYLE[name][0]
                for axis, mark in (("pan", "o-"), ("tilt", "s--")):
                    cells = shown.get((factor, axis, name), [])
                    if not cells:
                        continue
                    place = [level for level, _ in cells]
                    mean, rms = (np.array([c[k] for _, c in cells]) for k in ("mean", "rms"))
                    top, bottom = axes[:, column]
                    top.plot(place, mean, mark, color=colour, label=f"{name}, {axis}")
                    spread = np.sqrt(np.maximum(rms**2 - mean**2, 0))
                    top.fill_between(place, mean - spread, mean + spread, color=colour, alpha=0.12, linewidth=0)
                    bottom.plot(place, [c[inside] for _, c in cells], mark, color=colour, label=f"{label}, {axis}")
            top, bottom = axes[:, column]
            top.axhline(0, color="black", linewidth=0.6)
            bottom.axhline(95, color="black", linewidth=0.6)
            bottom.set_xlabel(f"{factor}, {UNITS[factor].split(',')[0]}")
            if factor == "spot noise":
                for part in (top, bottom):
                    part.set_xscale("log")
                    part.set_xticks(LEVELS[factor], [f"{x:g}" for x in LEVELS[factor]])
                    part.minorticks_off()
            bottom.set_ylim(-3, 103)
        axes[0, 0].set_ylabel("error of the ratio, %\n(band: 1 sd over rigs)")
        axes[1, 0].set_ylabel("95 % intervals that held\nthe true ratio, %")
        axes[0, 0].legend()
        axes[1, 0].legend()


if __name__ == "__main__":
    options = {"--fits": {"type": int, "default": 20, "help": "of these many are fitted (%(default)s)"}}
    study(__file__, __doc__, one_campaign, ("factor", "level", "seed", "joint"), tasks, table, 200, options)
