"""How often does `watch` raise a false alarm, and how often does it notice what has moved?

    python -m experiments.watching.power run --n 20 --cores 0 1     # 25 s of processor a rig, resumable
    python -m experiments.watching.power table > experiments/watching/power.md

`run` draws rig i from `data/rigs/mounted` with seed i, fits 24 experiments of the first day (100 and 200 steps), lets
`plan --watch` choose the looks of 10 minutes, and simulates second days of these looks on the same true rig: six on
which nothing has moved, and for each of the eight changes one with the stated size and one with four times as much, in
a random direction. `table` counts MOVED against what the plan states (a lower bound: the change's own test), and beside
it the classic's way: as many looks spent on experiments of one direction that the change is seen in, and both days'
means of it compared by Welch's t test at 1 %.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import stats

from experiments.common.command_line import study
from experiments.common.page import heading, share
from experiments.common.rigs import mounted_rig
from tvsbayes.comparison import watched_looks
from tvsbayes.comparison.departures import FALSE_ALARM_RATE, StatedChange, null_distribution, powers
from tvsbayes.comparison.watched_looks import CHANGES, NOISE_DRAWS
from tvsbayes.estimators.four_point import classic
from tvsbayes.estimators.joint_fit import JointFit, fit
from tvsbayes.estimators.noise_scales import noise_draws
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.parameters import STEREO_PARAMETER_NAMES
from tvsbayes.instrument.plan import LOOKS_PER_EXPERIMENT, PlanStep
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.planning.watch_plan import watch_plan
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.true_rig import Truth

FIRST_DAY = four_point_protocol(repeats=6, steps=(100, 200))
SAME_DAYS, SIZES = 6, (1.0, 4.0)
NOTHING = "nothing"


def changed(truth: Truth, change: StatedChange, times: float, rng: np.random.Generator) -> Truth:
    """The true rig after a change in a random direction."""
    shift = rng.standard_normal(len(change.names))
    shift *= times * change.size / np.linalg.norm(shift)
    parameters, vector = dict(truth.parameters), truth.stereo.vector.copy()
    for name, by in zip(change.names, shift, strict=True):
        if change.unit == "%":
            by *= 0.01 * parameters[name]
        elif "rotation_rad" in name:
            by = np.radians(by)
        if name in STEREO_PARAMETER_NAMES:
            vector[STEREO_PARAMETER_NAMES.index(name)] += by
        else:
            # A play is never negative: where it would be, it grows instead.
            smaller = name.startswith("backlash_deg") and parameters[name] + by < 0
            parameters[name] += -by if smaller else by
    return replace(truth, parameters=parameters, stereo=truth.stereo.with_vector(vector))


def classic_alarm(first: Campaign, second: Campaign, direction: str) -> bool:
    """Whether the means of a direction differ, by Welch's t test."""
    days = [classic(campaign).experiments for campaign in (first, second)]
    ratios = [[e.deg_per_step for e in day if e.direction == direction] for day in days]
    return min(map(len, ratios)) > 1 and float(stats.ttest_ind(*ratios, equal_var=False).pvalue) <= FALSE_ALARM_RATE


def one_rig(task: tuple[int]) -> dict[str, object]:
    """All second days of a rig."""
    (seed,) = task
    use_compilation_cache()
    rig = mounted_rig()
    first = simulate(rig, FIRST_DAY, seed)
    result = fit(first.campaign)
    row: dict[str, object] = {"seed": seed, "converged": result.converged}
    if not result.converged:
        return row
    planned = watch_plan(result)
    noise = noise_draws(result, NOISE_DRAWS, 0)
    # The same for all days of a rig, and the dearest part of each.
    watched_looks.noise_draws = lambda *_: noise
    rng, days = np.random.default_rng([seed, 24]), []
    changes = [(NOTHING, 0.0, first.truth)] * SAME_DAYS
    changes += [(c.what, t, changed(first.truth, c, t, rng)) for c in CHANGES for t in SIZES]
    for number, (what, times, truth) in enumerate(changes):
        days.append(day(result, first.campaign, truth, what, times, 1000 * (seed + 1) + number, planned.steps))
    taken = simulate(rig, planned.steps, 1000 * (seed + 1), truth=first.truth).campaign
    departure = watched_looks.WatchedLooks(result, taken).departure(noise.centre)
    limit = null_distribution(departure, 0).limit
    row["stated"] = {"1": [c.power for c in planned.changes], "4": powers(departure, limit, 0, 4.0)}
    row["looks"], row["needed"] = planned.looks, [c.looks_needed for c in planned.changes]
    return {**row, "homings": planned.homings, "minutes": planned.minutes, "days": days}


def day(
    result: JointFit, first: Campaign, truth: Truth, what: str, times: float, seed: int, steps: tuple[PlanStep, ...]
) -> dict[str, object]:
    """One second day, watched, and looked at the classic way with as many looks."""
    rig = mounted_rig()
    test = watched_looks.watch(result, simulate(rig, steps, seed, truth=truth).campaign)
    named = test.moved[0].what if test.moved else ""
    direction = "up" if what.endswith("tilt") else "left"
    # Of all four directions; only this one is compared.
    repeats = max(2, test.looks // LOOKS_PER_EXPERIMENT)
    other = simulate(rig, four_point_protocol(repeats=repeats, steps=(100, 200)), seed + 500, truth=truth).campaign
    entries = {"verdict": test.verdict, "p": test.p, "p_all": test.p_all, "named": named}
    return {"what": what, "times": times, **entries, "classic": classic_alarm(first, other, direction)}


def table(every: list[dict]) -> None:
    rows = [r for r in every if r["converged"]]
    days = [day for row in rows for day in row["days"]]
    print("# False alarms and power of a watched calibration\n")
    print("Written by `python -m experiments.watching.power table`.\n")
    looks, homings, minutes = (np.median([r[key] for r in rows]) for key in ("looks", "homings", "minutes"))
    print(f"{len(rows)} drawn rigs, {len(days)} second days. Plans of 10 minutes, in the median {looks:.0f} looks")
    print(f"after {homings:.0f} homings in {minutes:.1f} minutes.", end=" ")
    print("In brackets 95 % intervals of the counts; days of one")
    print("rig share its first day, so that they are somewhat wider in truth.\n")
    print(heading("moved | size | MOVED, counted | stated at least | named right, of MOVED | classic"))
    groups = [(NOTHING, 0.0, "", None)]
    groups += [(c.what, t, f"{t * c.size:g} {c.unit}", n) for n, c in enumerate(CHANGES) for t in SIZES]
    for what, times, size, number in groups:
        chosen = [d for d in days if d["what"] == what and d["times"] == times]
        moved = [d for d in chosen if d["named"]]
        stated = FALSE_ALARM_RATE if number is None else np.mean([r["stated"][f"{times:g}"][number] for r in rows])
        right = sum(d["named"].split(":")[0] == what.split(":")[0] for d in moved)
        named = f"{right} of {len(moved)}" if number is not None else ""
        alarms = share(sum(d["classic"] for d in chosen), len(chosen))
        print(f"| {what} | {size} | {share(len(moved), len(chosen))} | {100 * stated:.1f} % | {named} | {alarms} |")
    same = [d for d in days if d["what"] == NOTHING]
    low = sum(d["p_all"] < FALSE_ALARM_RATE for d in same)
    print("\nAll residuals together (`p_all`, a warning) fell below 1 % on", end=" ")
    print(f"{share(low, len(same))} of the unchanged days.")
    print("\n| change | rigs on which some number of looks is enough | median of these numbers |")
    print("|---|---|---|")
    for number, change in enumerate(CHANGES):
        needed = [r["needed"][number] for r in rows if r["needed"][number] is not None]
        middle = f"{np.median(needed):.0f}" if needed else ""
        print(f"| {change.what}, {change.size:g} {change.unit} | {len(needed)} of {len(rows)} | {middle} |")


if __name__ == "__main__":
    study(__file__, __doc__, one_rig, ("seed",), [()], table, 20)
