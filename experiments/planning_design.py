"""Planned looks against the paper's 96 experiments: minutes and spots to the same u, and what a full turn does.

    python experiments/planning_design.py > experiments/planning_design.md      # two minutes; writes the figure too

On the paper's rig (`data/rigs/mounted`: sheets at 175, 275, 375 mm, costs 1.5 s a move, 1 s a look, 60 s a placement),
expected information at the most probable instrument, no simulation. Two numbers are followed: u of the worst effective
ratio, which falls with n, and its floor, what is left where the same looks are taken a hundred times (stereo, focal
scale, priors of the optics). Protocols are repeated; the planned looks are those of the greedy search without exchange.
The full turn is taken after the planned looks, when the ratio is known: its spot must be found.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from studies import mounted_rig

from tvsbayes.estimators.campaign_arrays import use_compilation_cache
from tvsbayes.instrument.protocols import grid_protocol, mixed_protocol, paper_protocol
from tvsbayes.planning.candidates import LookArrays, candidates, covariance_of
from tvsbayes.planning.expectation import information_of, prior_knowledge
from tvsbayes.planning.limits import MANY, limit_of, split_of
from tvsbayes.planning.search import LADDER, design_family
from tvsbayes.planning.target import DEFAULT_TARGET, parse_target, sensitivity

FIGURE = Path(__file__).with_name("planning_design.png")
REPEATS = (2, 4, 8, 16, 24)
TARGET = parse_target(DEFAULT_TARGET)
TURN = {"pan_min_steps": -100, "pan_max_steps": 7000, "tilt_min_steps": -130, "tilt_max_steps": 130}
"""Limits that allow a full turn of pan: 6000 steps at 0.06 deg/step."""


def judged(knowledge, steps, before=0.0):
    """Information, worst u, floor and their sensitivities after a plan."""
    found = information_of(steps, knowledge)
    at = sensitivity(TARGET, knowledge.z, knowledge.space, knowledge.rig.table, found.pose_rad)
    fisher = found.fisher + before
    value = at.value(covariance_of(knowledge.precision + fisher))
    return found, fisher, at, value


def row(name, spots, minutes, fisher, at, value, knowledge) -> str:
    """A line of the table."""
    limit = limit_of(knowledge, fisher, at, TARGET)
    shares = split_of(knowledge, fisher, None, at)
    first = ", ".join(f"{cause} {100 * share:.0f} %" for cause, share in list(shares.items())[:3])
    floor = ", ".join(f"{cause} {100 * share:.0f} %" for cause, share in list(limit.shares.items())[:2])
    return f"| {name} | {spots} | {minutes:.1f} | {1e4 * value:.2f} | {first} | {1e4 * limit.floor:.2f} | {floor} |"


def main() -> None:
    """Print the tables, write the figure."""
    use_compilation_cache()
    rig = mounted_rig()
    knowledge = prior_knowledge(rig)
    found = candidates(knowledge)
    seen = LookArrays(found.looks, knowledge, False).at(knowledge.z, knowledge.space)
    pose = seen.mirror_angles_rad.mean(axis=0)
    centre = sensitivity(TARGET, knowledge.z, knowledge.space, rig.table, pose)
    family = design_family(knowledge, found, seen, replace(TARGET, limit=1e-9), centre)

    curves: dict[str, list[tuple[float, float, int]]] = {"paper": [], "mixed": [], "grid": [], "planned": []}
    rows = {}
    for repeats in REPEATS:
        for name, protocol in (("paper", paper_protocol), ("mixed", mixed_protocol)):
            information, fisher, at, value = judged(knowledge, protocol(repeats))
            curves[name].append((information.minutes, value, len(information.look_moves)))
            rows[name] = row(name, len(information.look_moves), information.minutes, fisher, at, value, knowledge)
    information, fisher, at, value = judged(knowledge, grid_protocol())
    rows["grid"] = row("grid", len(information.look_moves), information.minutes, fisher, at, value, knowledge)
    for times in (1, 2, 4):
        repeated = at.value(covariance_of(knowledge.precision + times * fisher))
        curves["grid"].append((times * information.minutes, repeated, times * len(information.look_moves)))
    planned = {}
    for n in LADDER:
        information, fisher, at, value = judged(knowledge, family.arranged(n).steps)
        curves["planned"].append((information.minutes, value, len(information.look_moves)))
        planned[n] = (information, fisher, at, value)
    for n in (8, 16, 32, 96):
        information, fisher, at, value = planned[n]
        text = row(f"planned, {n}", len(information.look_moves), information.minutes, fisher, at, value, knowledge)
        rows[f"planned {n}"] = text

    # A second session, when the ratio is known: near looks against a full turn, four to thirty-two looks each.
    information, fisher, at, value = planned[16]
    sharp = replace(
        knowledge, rig=replace(rig, positioner=TURN), precision=knowledge.precision + fisher, after_data=True
    )
    wide = candidates(sharp)
    shown = LookArrays(wide.looks, sharp, False).at(sharp.z, sharp.space)
    away = wide.looks.steps[:, 0] > 3000
    turned = []
    for label, allowed in (("more of the same range", ~away), ("with the beams a full turn away", np.ones_like(away))):
        part = replace(shown, rows=np.where(allowed[:, None, None], shown.rows, 0.0))
        more = design_family(sharp, wide, part, replace(TARGET, limit=1e-9), at, Scope(largest=16))
        for n in (2, 4, 8, 16):
            arranged = more.arranged(n)
            after = information_of(arranged.steps, sharp)
            final = at.value(covariance_of(sharp.precision + after.fisher))
            floor = at.value(covariance_of(sharp.precision + MANY * after.fisher))
            picked = int(away[more.picks[: 4 * n]].sum())
            minutes = information.minutes + after.minutes
            variance = covariance_of(sharp.precision + after.fisher)[0, 0]
            ratio = variance**0.5 * rig.table.priors["degrees_per_step.pan"].u
            turned.append((label, n, 64 + 4 * n, picked, minutes, final, floor, ratio))

    print("# Planned looks against the paper's 96 experiments\n")
    print("Written by `python experiments/planning_design.py`; u of the worst effective ratio in 1e-4 deg/step.\n")
    print("| plan | spots | minutes | u | what it consists of | floor | what sets it |\n|---|---|---|---|---|---|---|")
    for text in rows.values():
        print(text)
    print("\n## To the uncertainty of a protocol\n")
    print("| as good as | u | spots | minutes | planned: spots | planned: minutes | times faster |")
    print("|---|---|---|---|---|---|---|")
    for name in ("paper", "mixed", "grid"):
        minutes, value, spots = curves[name][-1 if name != "grid" else 0]
        enough = next((c for c in curves["planned"] if c[1] <= value), None)
        cells = "- | - | -" if enough is None else f"{enough[2]} | {enough[0]:.1f} | {minutes / enough[0]:.0f}"
        print(f"| {name} | {1e4 * value:.2f} | {spots} | {minutes:.1f} | {cells} |")
    print("\n## A second session after 16 planned experiments\n")
    print("| looks added | experiments | spots in all | a turn away | minutes in all | u worst | floor | u of k pan |")
    print("|---|---|---|---|---|---|---|---|")
    for label, n, spots, picked, minutes, final, floor, ratio in turned:
        numbers = f"{1e4 * final:.2f} | {1e4 * floor:.2f} | {1e4 * ratio:.2f}"
        print(f"| {label} | {n} | {spots} | {picked} | {minutes:.1f} | {numbers} |")
    draw(curves)


def draw(curves) -> None:
    """U against minutes, both logarithmic."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6.4, 4.0), layout="constrained")
    for name, points in curves.items():
        minutes, value, spots = map(np.array, zip(*points, strict=True))
        axes.loglog(minutes, value, marker="o", markersize=3, label=name)
        axes.annotate(
            f"{spots[-1]} spots", (minutes[-1], value[-1]), fontsize=7, xytext=(3, 3), textcoords="offset points"
        )
    axes.axhline(TARGET.limit, color="grey", linewidth=0.8, linestyle=":")
    axes.set_xlabel("minutes")
    axes.set_ylabel("u of the worst effective ratio, deg/step")
    axes.legend(frameon=False)
    figure.savefig(FIGURE, dpi=110)


if __name__ == "__main__":
    main()
