"""What a campaign is worth: u of the effective ratios against spots, and the part that no repeat lowers.

    python experiments/campaign_worth.py run --core 0            # refits, 4 minutes, resumable
    python experiments/campaign_worth.py table > experiments/campaign_worth.md      # 3 minutes, writes the figure

On the paper's rig (`data/rigs/mounted`), expected information at the most probable instrument: paper's protocol and
mixed steps with 1 to 96 repeats, the grid taken 1 to 8 times, the planner's looks, and a full turn: the same eight
poses from both sides, on two sheets, once near and once 6000 counters later (the ratio is known by then, or the spot
would not be found). Minutes and the planner's comparison stand in planning_design.md. Two parts of the variance are
told apart: its cause (looks; cameras = stereo and focal scale; priors of gears and optics), and what remains when the
same looks are taken a hundred times: repeats lower some of the priors' part, since spots calibrate the instrument.

`run` draws rigs, simulates and refits three of the points (`tvsbayes.studies`), and compares the error of the estimate
with the sd predicted at that truth; planning_prediction.md does the same for 384 spots of the paper and the grid. The
rigs of the full turn have pan ratios of 0.06 +- 1e-4 deg/step, which an earlier session told; the fit is not told.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from coverage import read_rows
from studies import mounted_rig, run_rows

OUTPUT = Path(__file__).parent / "output"
ROWS, PLANNED, FIGURE = (
    OUTPUT / "campaign_worth.jsonl",
    OUTPUT / "campaign_worth_planned.npz",
    Path(__file__).with_suffix(".png"),
)
REPEATS = {"paper": (1, 2, 4, 8, 16, 24, 48, 96), "mixed": (2, 4, 8, 12, 24, 48, 96)}
TURN_STEPS = 6000
"""A full turn of pan at 0.06 deg/step."""
TURN_LOOKS = (4, 8, 16, 32, 64)
"""Looks per sheet and turn; above 16 the poses are taken again."""
CHECKED = ("mixed, 6 repeats", "planned, 16", "full turn, 16")
RIGS = 12
SEED = 58
CAUSES = ("looks", "cameras", "priors")


def full_turn_plan(looks: int, turn_steps: int = TURN_STEPS):
    """`looks` poses near and a turn later on each of two sheets, from either side of both axes."""
    from tvsbayes.instrument.plan import PlanStep
    from tvsbayes.instrument.protocols import OVERSHOOT_STEPS

    # Neighbours differ in tilt, and in eight looks each axis is reached from either side at either end.
    poses = ((0, -90), (200, 90), (70, 90), (140, -90), (200, -90), (0, 90), (140, 90), (70, -90))
    orders: list[tuple] = [("home", 0, 0)]
    for number, sheet in enumerate(("d1", "d3")):
        orders.append(("place", None, None, sheet))
        for at in (0, turn_steps)[:: 1 if number == 0 else -1]:
            for look in range(looks):
                pan, tilt = poses[look % len(poses)]
                pan_run_up = OVERSHOOT_STEPS * (1 if look % 2 == 0 else -1)
                tilt_run_up = OVERSHOOT_STEPS * (1 if look // 2 % 2 == 0 else -1)
                orders += [("move", at + pan - pan_run_up, tilt - tilt_run_up), ("move", at + pan, tilt), ("look",)]
    return tuple(PlanStep(k, *order) for k, order in enumerate(orders))


@dataclass(frozen=True)
class Worth:
    """What a plan tells of left, right, up, down.

    Attributes:
        spots: looks seen.
        u: standard uncertainties of the four effective ratios, deg/step.
        shares: of the worst one's variance, by `CAUSES`.
        floor: u of the worst after a hundred times the same looks.
    """

    spots: int
    u: np.ndarray
    shares: Mapping[str, float]
    floor: float


def worth_of(knowledge, fisher: np.ndarray, pose_rad: np.ndarray, spots: int, quantity: str = "worst") -> Worth:
    """Uncertainty and its causes from the information of the looks (p, p)."""
    from tvsbayes.planning.candidates import covariance_of
    from tvsbayes.planning.limits import MANY, split_of
    from tvsbayes.planning.target import parse_target, sensitivity

    target = parse_target(f"u({quantity}) <= 2e-4 deg/step")
    at = sensitivity(target, knowledge.z, knowledge.space, knowledge.rig.table, pose_rad)
    covariance = covariance_of(knowledge.precision + fisher)
    u = np.sqrt(np.einsum("qi,ij,qj->q", at.gradient, covariance, at.gradient))
    parts = split_of(knowledge, fisher, None, at)
    cameras = parts.get("stereo calibration", 0.0) + parts.get("focal scale", 0.0)
    looks = parts.get("looks", 0.0)
    floor = at.value(covariance_of(knowledge.precision + MANY * fisher))
    return Worth(spots, u, dict(zip(CAUSES, (looks, cameras, 1 - looks - cameras), strict=True)), floor)


def worth_of_plan(knowledge, steps, times: float = 1.0, quantity: str = "worst") -> Worth:
    """The same of a plan, taken `times` times over."""
    from tvsbayes.planning.expectation import information_of

    found = information_of(steps, knowledge)
    seen = found.expectation.seen
    # A turn later is the same beam: the mean of the counters would be a pose half a turn away that nobody looked at.
    angles = found.expectation.mirror_angles_rad[seen]
    pose = np.array([np.mean((angles[:, 0] + np.pi) % (2 * np.pi) - np.pi), angles[:, 1].mean()])
    return worth_of(knowledge, times * found.fisher, pose, round(times * seen.sum()), quantity)


def planned_family(knowledge):
    """The planner's order of looks for the worst effective ratio; searched once, then kept."""
    from tvsbayes.planning.candidates import LookArrays, candidates
    from tvsbayes.planning.forecast import Family
    from tvsbayes.planning.search import design_family
    from tvsbayes.planning.target import DEFAULT_TARGET, parse_target, sensitivity

    found = candidates(knowledge)
    if not PLANNED.exists():
        seen = LookArrays(found.looks, knowledge, False).at(knowledge.z, knowledge.space)
        target = replace(parse_target(DEFAULT_TARGET), limit=1e-9)
        pose = seen.mirror_angles_rad.mean(axis=0)
        centre = sensitivity(target, knowledge.z, knowledge.space, knowledge.rig.table, pose)
        OUTPUT.mkdir(parents=True, exist_ok=True)
        np.savez(PLANNED, picks=design_family(knowledge, found, seen, target, centre).picks)
    with np.load(PLANNED) as kept:
        return Family(knowledge, found, kept["picks"], False)


def plan_and_rig(name: str):
    """Plan and rig of a point that is checked by refits."""
    from tvsbayes.instrument.parameters import Prior
    from tvsbayes.instrument.protocols import mixed_protocol
    from tvsbayes.planning.expectation import prior_knowledge

    rig = mounted_rig()
    if name.startswith("mixed"):
        return mixed_protocol(6), rig
    if name.startswith("planned"):
        return planned_family(prior_knowledge(rig)).arranged(16).steps, rig
    known = {**rig.truth, "degrees_per_step.pan": Prior(0.06, 1e-4)}
    return full_turn_plan(16), replace(rig, truth=known)


def one_row(task: tuple[str, int]) -> dict[str, object]:
    """A row of `tvsbayes study` with the point's name."""
    from tvsbayes.estimators import campaign_arrays

    # As in coverage.py: ordinary fits pad to 512 spots.
    campaign_arrays.SMALLEST_BUCKET = 96
    from tvsbayes.estimators.campaign_arrays import use_compilation_cache
    from tvsbayes.planning.target import DEFAULT_TARGET, parse_target
    from tvsbayes.studies.study_job import StudyJob, study_row

    use_compilation_cache()
    name, index = task
    steps, rig = plan_and_rig(name)
    return {"name": name, **study_row(StudyJob(rig, tuple(steps), parse_target(DEFAULT_TARGET), SEED), index)}


def table() -> None:
    """Curves, split and refits."""
    from tvsbayes.estimators.campaign_arrays import use_compilation_cache
    from tvsbayes.instrument.protocols import grid_protocol, mixed_protocol, paper_protocol
    from tvsbayes.planning.expectation import prior_knowledge
    from tvsbayes.planning.search import LADDER

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
    print("# What a campaign is worth\n")
    print("Written by `python experiments/campaign_worth.py table`; u in 1e-4 deg/step, of effective ratios.\n")
    print("| campaign | spots | left | right | up | down | worst: looks | cameras | priors ", end="")
    print("| floor of the worst | share that no repeat lowers |\n|" + "---|" * 11)
    for name, points in curves.items():
        for w in points:
            u = " | ".join(f"{1e4 * x:.2f}" for x in w.u)
            shares = " | ".join(f"{100 * w.shares[c]:.0f} %" for c in CAUSES)
            left = 100 * (w.floor / w.u.max()) ** 2
            print(f"| {name} | {w.spots} | {u} | {shares} | {1e4 * w.floor:.2f} | {left:.0f} % |")
    refits()
    draw(curves)


def refits() -> None:
    """RMS error over predicted sd of the points that were refitted."""
    from tvsbayes.statistics.intervals import rms_bounds

    print("\n## Refits\n")
    if not read_rows(ROWS):
        print("Not run yet; planning_prediction.md holds about 90 of the paper's protocol and of the grid.")
        return
    print("Error of the estimate over the sd predicted at the truth, RMS over the rigs; bounds at 1e-4.\n")
    print("| campaign | rigs | converged | spots unseen | left | right | up | down | bounds |\n|" + "---|" * 9)
    for name in CHECKED:
        rows = [r for r in read_rows(ROWS) if r["name"] == name]
        good = [r for r in rows if r["converged"]]
        if not good:
            continue
        cells = []
        for direction in ("left", "right", "up", "down"):
            e = [r["headlines"][direction] for r in good]
            cells.append(np.sqrt(np.mean([((x["value"] - x["truth"]) / x["predicted_sd"]) ** 2 for x in e])))
        low, high = rms_bounds(len(good))
        shown = " | ".join(f"{c:.2f}{'' if low <= c <= high else ' **!**'}" for c in cells)
        unseen = sum(r["unseen"] for r in rows)
        print(f"| {name} | {len(rows)} | {len(good)} | {unseen} | {shown} | {low:.2f}-{high:.2f} |")


def draw(curves: Mapping[str, list[Worth]]) -> None:
    """U of the worst ratio and the part that stays, against spots."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    from tvsbayes.report.figures import BLUE, GREEN, ORANGE, PURPLE, RED, STYLE, WIDTH_IN

    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 5.6), layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True)
        looks = zip((RED, ORANGE, GREEN, BLUE, PURPLE), "^vsoD", strict=True)
        for (name, points), (colour, marker) in zip(curves.items(), looks, strict=True):
            spots, u, floor = np.array([(w.spots, w.u.max(), w.floor) for w in points]).T
            above.loglog(spots, u, color=colour, marker=marker, markersize=4, label=name)
            below.semilogx(spots, 100 * (floor / u) ** 2, color=colour, marker=marker, markersize=4)
        above.set(ylabel="u of the worst ratio, deg/step")
        below.set(xlabel="spots", ylabel="variance that no repeat lowers, %", ylim=(0, None))
        figure.legend(loc="outside lower center", ncols=3)
        figure.savefig(FIGURE, dpi=130)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("run", "table"))
    parser.add_argument("--core", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.action == "table":
        return table()
    from tvsbayes.estimators.campaign_arrays import use_compilation_cache
    from tvsbayes.planning.expectation import prior_knowledge

    use_compilation_cache()
    planned_family(prior_knowledge(mounted_rig()))
    tasks = [(name, index) for index in range(RIGS) for name in CHECKED]
    return run_rows(one_row, tasks, ROWS, ("name", "index"), [arguments.core])


if __name__ == "__main__":
    main()
