"""What a campaign is worth: u of the effective ratios against spots, and the part that no repeat lowers.

    python -m experiments.planning.campaign_worth run --cores 0     # refits, 4 minutes, resumable
    python -m experiments.planning.campaign_worth table > experiments/planning/campaign_worth.md

On the paper's rig (`data/rigs/mounted`), expected information at the most probable instrument: paper's protocol and
mixed steps with 1 to 96 repeats, the grid taken 1 to 8 times, the planner's looks, and a full turn: the same eight
poses from both sides, on two sheets, once near and once 6000 counters later (the ratio is known by then, or the spot
would not be found). Minutes and the planner's comparison stand in planned_looks.md. Two parts of the variance are
separated: its cause (looks; cameras = stereo and focal scale; priors of gears and optics), and what remains when the
same looks are taken a hundred times: repeats lower some of the priors' part, since spots calibrate the instrument.

`run` draws rigs, simulates and refits three of the points (`tvsbayes.studies`), and compares the error of the estimate
with the sd predicted at that truth; prediction.md does the same for 384 spots of the paper and the grid. The
rigs of the full turn have pan ratios of 0.06 +- 1e-4 deg/step, known from an earlier session; the fit does not use it.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.common.command_line import study
from experiments.common.figures import page_figure, title_and_figure
from experiments.common.headlines import marked
from experiments.common.rigs import mounted_rig
from experiments.common.rows import output
from experiments.common.worth import CAUSES, Worth, full_turn_plan, searched_family, worth_of_plan
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.parameters import Prior
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.instrument.protocols import grid_protocol, mixed_protocol, paper_protocol
from tvsbayes.instrument.rig import Rig
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.planning.assurance import Family
from tvsbayes.planning.candidates import candidates
from tvsbayes.planning.expectation import Knowledge, prior_knowledge
from tvsbayes.planning.search import LADDER
from tvsbayes.planning.target import DEFAULT_TARGET, parse_target
from tvsbayes.report.drawing import BLUE, GREEN, ORANGE, PURPLE, RED
from tvsbayes.statistics.chances import rms_bounds
from tvsbayes.studies.study_job import StudyJob, study_row

ROWS, PLANNED = output(__file__, "campaign_worth.jsonl"), output(__file__, "campaign_worth_planned.npz")
FIGURE = Path(__file__).with_suffix(".png")
REPEATS = {"paper": (1, 2, 4, 8, 16, 24, 48, 96), "mixed": (2, 4, 8, 12, 24, 48, 96)}
TURN_LOOKS = (4, 8, 16, 32, 64)
"""Looks per sheet and turn; above 16 the poses are taken again."""
CHECKED = ("mixed, 6 repeats", "planned, 16", "full turn, 16")
RIGS = 12
SEED = 58


def planned_family(knowledge: Knowledge) -> Family:
    """The planner's order of looks for the worst effective ratio; searched once, then kept."""
    pool = candidates(knowledge)
    if not PLANNED.exists():
        PLANNED.parent.mkdir(parents=True, exist_ok=True)
        np.savez(PLANNED, picks=searched_family(knowledge, pool).picks)
    with np.load(PLANNED) as kept:
        return Family(knowledge, pool, kept["picks"], False)


def plan_and_rig(name: str) -> tuple[tuple[PlanStep, ...], Rig]:
    """Plan and rig of a point that is checked by refits."""
    rig = mounted_rig()
    if name.startswith("mixed"):
        return mixed_protocol(6), rig
    if name.startswith("planned"):
        return planned_family(prior_knowledge(rig)).arranged(16).steps, rig
    known = {**rig.truth, "degrees_per_step.pan": Prior(0.06, 1e-4)}
    return full_turn_plan(16), replace(rig, truth=known)


def one_row(task: tuple[str, int]) -> dict[str, object]:
    """A row of `tvsbayes study` with the point's name."""
    use_compilation_cache()

    name, index = task
    steps, rig = plan_and_rig(name)
    return {"name": name, **study_row(StudyJob(rig, tuple(steps), parse_target(DEFAULT_TARGET), SEED), index).as_json()}


def table(rows: list[dict]) -> None:
    """Curves, split and refits."""
    use_compilation_cache()
    knowledge = prior_knowledge(mounted_rig())
    curves = {
        "paper's protocol": [worth_of_plan(knowledge, paper_protocol(n)) for n in REPEATS["paper"]],
        "mixed steps": [worth_of_plan(knowledge, mixed_protocol(n)) for n in REPEATS["mixed"]],
        "grid": [worth_of_plan(knowledge, grid_protocol(), times) for times in (1, 2, 4, 8)],
    }
    family = planned_family(knowledge)
    curves["planned"] = [worth_of_plan(knowledge, family.arranged(n).steps) for n in LADDER if n <= family.largest]
    curves["full turn"] = [worth_of_plan(knowledge, full_turn_plan(n)) for n in TURN_LOOKS]
    print(
        title_and_figure(
            __file__, "What a campaign is worth", FIGURE, "Worst u, and its part that stays, against spots"
        )
    )
    print(
        "Written by `python -m experiments.planning.campaign_worth table`; u in 1e-4 deg/step, of effective ratios.\n"
    )
    print("| campaign | spots | left | right | up | down | worst: looks | cameras | priors ", end="")
    print("| floor of the worst | share that no repeat lowers |\n|" + "---|" * 11)
    for name, points in curves.items():
        for w in points:
            u = " | ".join(f"{1e4 * x:.2f}" for x in w.u)
            shares = " | ".join(f"{100 * w.shares[c]:.0f} %" for c in CAUSES)
            left = 100 * (w.floor / w.u.max()) ** 2
            print(f"| {name} | {w.spots} | {u} | {shares} | {1e4 * w.floor:.2f} | {left:.0f} % |")
    refits(rows)
    draw(curves)


def refits(every: list[dict]) -> None:
    """RMS error over predicted sd of the points that were refitted."""
    print("\n## Refits\n")
    if not every:
        print("Not run yet; prediction.md holds about 90 of the paper's protocol and of the grid.")
        return
    print("Error of the estimate over the sd predicted at the truth, RMS over the rigs; bounds at 1e-4.\n")
    print("| campaign | rigs | converged | spots unseen | left | right | up | down | bounds |\n|" + "---|" * 9)
    for name in CHECKED:
        rows = [r for r in every if r["name"] == name]
        good = [r for r in rows if r["converged"]]
        if not good:
            continue
        cells = []
        for direction in DIRECTIONS:
            e = [r["headlines"][direction] for r in good]
            cells.append(np.sqrt(np.mean([((x["value"] - x["truth"]) / x["predicted_sd"]) ** 2 for x in e])))
        low, high = rms_bounds(len(good))
        shown = " | ".join(marked(f"{c:.2f}", low <= c <= high) for c in cells)
        unseen = sum(r["unseen"] for r in rows)
        print(f"| {name} | {len(rows)} | {len(good)} | {unseen} | {shown} | {low:.2f}-{high:.2f} |")


def draw(curves: Mapping[str, list[Worth]]) -> None:
    """U of the worst ratio and the part that stays, against spots."""
    with page_figure(FIGURE, 5.6) as figure:
        above, below = figure.subplots(2, 1, sharex=True)
        looks = zip((RED, ORANGE, GREEN, BLUE, PURPLE), "^vsoD", strict=True)
        for (name, points), (colour, marker) in zip(curves.items(), looks, strict=True):
            spots, u, floor = np.array([(w.spots, w.u.max(), w.floor) for w in points]).T
            above.loglog(spots, u, color=colour, marker=marker, markersize=4, label=name)
            below.semilogx(spots, 100 * (floor / u) ** 2, color=colour, marker=marker, markersize=4)
        above.set(ylabel="u of the worst ratio, deg/step")
        below.set(xlabel="spots", ylabel="variance that no repeat lowers, %", ylim=(0, None))
        figure.legend(loc="outside lower center", ncols=3)


def tasks(_: argparse.Namespace) -> list[tuple[str, int]]:
    """Every point on every rig; the planner's looks are there before workers ask for them."""
    use_compilation_cache()
    planned_family(prior_knowledge(mounted_rig()))
    return [(name, index) for index in range(RIGS) for name in CHECKED]


if __name__ == "__main__":
    study(__file__, __doc__, one_row, ("name", "index"), tasks, table)
