"""The paper's Table 1 and worked example by the classic estimator, on the shipped paper twin.

    python -m experiments.paper.table1 > experiments/paper/table1.md        # a minute

The twin was SOLVED so that this realisation gives the Table (data/twins/README.md): agreement here shows that the
classic chain computes what the paper describes and that lost motion suffices for its asymmetry, not that the paper's
machine was so. What was luck is shown by the same true rig run again under other seeds, and what is arithmetic by the
worked example. The same numbers come from `tvsbayes classic data/twins/paper_twin`.
"""

from __future__ import annotations

import tomllib

import numpy as np
from scipy import stats

from experiments.common.command_line import print_only
from experiments.common.page import heading
from experiments.common.rigs import mounted_rig, paper_values, shipped_plan, shipped_twin
from tvsbayes.estimators.four_point import classic, four_point_angle_deg, ratio_deg_per_step
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.stereo_pair import triangulate
from tvsbayes.twin.physics import project
from tvsbayes.twin.simulated_campaign import simulate

AGAIN = 100
"""Campaigns of the same true rig: their sd is known to 7 %."""
SPOT_SD_PX = 0.05
"""The twin's, see make_twins.py."""


def table(paper: dict[str, tuple[int, float, float]]) -> None:
    """Table 1 beside the twin's, and the twin again."""
    twin = shipped_twin("paper_twin")
    campaign, truth = twin.campaign, twin.truth
    directions = classic(campaign).directions
    print(heading("direction | n, paper | mean | sd | n, twin | mean | sd | (mean - paper's) / u | sd / paper's"))
    for name in DIRECTIONS:
        n, mean, sd = paper[name]
        r = directions[name]
        # Both means scatter: u^2 = s^2/24 of either.
        apart = (r.mean_deg_per_step - mean) / np.hypot(sd / np.sqrt(n), r.u_type_a_deg_per_step)
        twin = f"{r.n} | {r.mean_deg_per_step:.6f} | {r.sd_deg_per_step:.6f}"
        print(f"| {name} | {n} | {mean:.6f} | {sd:.6f} | {twin} | {apart:+.2f} | {r.sd_deg_per_step / sd:.2f} |")
    rig, plan = mounted_rig(), shipped_plan("paper_twin")
    means, sds = [], []
    for seed in range(AGAIN):
        again = classic(simulate(rig, plan, 1000 + seed, truth, spot_sd_px=SPOT_SD_PX).campaign).directions
        means.append([again[d].mean_deg_per_step for d in DIRECTIONS])
        sds.append([again[d].sd_deg_per_step for d in DIRECTIONS])
    means, sds = np.array(means), np.array(sds)
    print(f"\n## The same true rig, {AGAIN} campaigns under other seeds\n")
    print(
        "| direction | mean of the means | sd of the means | median u of type A | paper's mean, in these sds ", end=""
    )
    print("| sd: median (2.5 to 97.5 %) |\n|---|---|---|---|---|---|")
    for k, name in enumerate(DIRECTIONS):
        spread = means[:, k].std(ddof=1)
        low, middle, high = np.quantile(sds[:, k], (0.025, 0.5, 0.975))
        apart = (paper[name][1] - means[:, k].mean()) / spread
        scatter = f"{middle:.6f} ({low:.6f} to {high:.6f})"
        type_a = middle / np.sqrt(directions[name].n)
        print(f"| {name} | {means[:, k].mean():.6f} | {spread:.6f} | {type_a:.6f} | {apart:+.1f} | {scatter} |")
    print("\nUp and down scatter more than their u of type A says: pan stands still for all 48 of them,", end=" ")
    print(f"so that one stop\nerror of pan ({truth.parameters['stop_sd_deg.left']:.2f} deg)", end=" ")
    print("is common to all and turns the azimuth.")
    true = truth.effective_deg_per_step(campaign)
    shown = ", ".join(f"{name} {true[name]:.5f}" for name in DIRECTIONS)
    interval = {name: directions[name].interval95_type_a for name in DIRECTIONS}
    held = [name for name in DIRECTIONS if interval[name][0] <= true[name] <= interval[name][1]]
    print(f"\nTrue effective ratios over the looks, deg/step: {shown}. The twin's own 95 % intervals of type A")
    print(f"hold {len(held)} of these 4{': ' + ', '.join(held) if held else ''}.")


def worked_example(paper: dict[str, tuple[int, float, float]]) -> None:
    """Equation (5) of the printed angles, and the whole chain on four points that have them."""
    with (shipped_data() / "reference" / "worked_example.toml").open("rb") as file:
        example = tomllib.load(file)
    first, last, steps = example["theta_i_deg"], example["theta_f_deg"], example["steps"]
    printed = example["deg_per_step_printed"]
    quotient = ratio_deg_per_step(first, last, steps)
    stereo = mounted_rig().stereo
    # Points 1 to 4: before the move on the near and the far sheet, after it on the far and the near one.
    slope = np.tan(np.radians([first, first, last, last]))
    depth = np.array([175.0, 275.0, 275.0, 175.0])
    points = np.column_stack((depth, -100.0 + slope * depth, np.zeros(4)))
    pixels = project(points, stereo)
    angles = four_point_angle_deg(triangulate(stereo, pixels)[None], "pan")
    read = [float(a[0]) for a in (angles.theta_i_deg, angles.theta_f_deg)]
    chain = ratio_deg_per_step(read[0], read[1], steps)
    print("\n## Worked example\n")
    print("| | theta_i, deg | theta_f, deg | steps | deg/step |\n|---|---|---|---|---|")
    print(f"| paper, printed | {first} | {last} | {steps} | {printed} |")
    print(f"| equation (5) of the printed angles | {first} | {last} | {steps} | {quotient:.6f} |")
    print(f"| four points with these slopes, through cameras and chain | {read[0]:.6f} | {read[1]:.6f} ", end="")
    print(f"| {steps} | {chain:.8f} |")
    _, mean, sd = paper["left"]
    low, high = (chain - mean) / sd - 0.01 / steps / sd, (chain - mean) / sd + 0.01 / steps / sd
    print(f"\nOne experiment against the Table's left: {low:+.2f} to {high:+.2f} of its sd", end=" ")
    print("(angles printed to 0.01 deg);\ntwo-sided p of a single", end=" ")
    print(f"value {2 * stats.t.sf(abs(low + high) / 2, 23):.2f}.")


TEXT = """# Table 1 by the classic estimator

Written by `python -m experiments.paper.table1`; deg/step. The twin was solved to give it: see the script.
"""


def main() -> None:
    print_only(__doc__)
    paper = paper_values()
    print(TEXT)
    table(paper)
    worked_example(paper)


if __name__ == "__main__":
    main()
