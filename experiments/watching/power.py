"""How often does `watch` raise a false alarm, and how often does it notice what has moved?

    python -m experiments.watching.power run --n 50 --cores 0 1     # 20 s of processor a rig, resumable
    python -m experiments.watching.power table > experiments/watching/power.md

`run` draws rig i from `data/rigs/mounted` with seed i, fits 24 experiments of the first day (100 and 200 steps), and
simulates second days of 64 looks at the same counters on the same true rig: six on which nothing has moved, and for
each of the eight changes one with the stated size and one with four times as much, in a random direction. `table`
counts MOVED against what `watch` states (a lower bound: the change's own test), and beside it the classic's way: both
days' means of each direction compared by Welch's t test, 1 % for the four together.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from experiments.common.command_line import act, study_parser
from experiments.common.fits import compile_for
from experiments.common.rigs import mounted_rig
from experiments.common.rows import output, read_rows, run_rows
from tvsbayes.comparison.watched_looks import (
    CHANGES,
    FALSE_ALARM_RATE,
    StatedChange,
    WatchedLooks,
    null_distribution,
    powers,
    watch,
)
from tvsbayes.estimators.four_point import classic
from tvsbayes.estimators.joint_fit import JointFit, fit
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import Campaign
from tvsbayes.instrument.parameters import STEREO_PARAMETER_NAMES
from tvsbayes.instrument.protocols import four_point_protocol
from tvsbayes.statistics.chances import share_interval95
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.true_rig import Truth

ROWS = output(__file__, "power.jsonl")
FIRST_DAY, SECOND_DAY = (four_point_protocol(repeats=n, steps=(100, 200)) for n in (6, 4))
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


def classic_alarm(first: Campaign, second: Campaign) -> bool:
    """Whether the means of any direction differ, by Welch's t test, 1 % for all four."""
    from scipy import stats

    days = [classic(campaign).experiments for campaign in (first, second)]
    chances = []
    for direction in DIRECTIONS:
        ratios = [[e.deg_per_step for e in day if e.direction == direction] for day in days]
        if min(map(len, ratios)) > 1:
            chances.append(float(stats.ttest_ind(*ratios, equal_var=False).pvalue))
    return bool(chances) and min(chances) <= FALSE_ALARM_RATE / len(chances)


def one_rig(seed: int) -> dict[str, object]:
    """All second days of a rig."""
    compile_for(96)
    rig = mounted_rig()
    first = simulate(rig, FIRST_DAY, seed)
    found = fit(first.campaign)
    row: dict[str, object] = {"seed": seed, "converged": found.converged}
    if not found.converged:
        return row
    rng = np.random.default_rng([seed, 24])
    days = [
        day(found, first.campaign, first.truth, NOTHING, 0.0, 1000 * (seed + 1) + number) for number in range(SAME_DAYS)
    ]
    for number, change in enumerate(CHANGES):
        for times in SIZES:
            truth = changed(first.truth, change, times, rng)
            own = 1000 * (seed + 1) + 100 + 10 * number + int(times)
            days.append(day(found, first.campaign, truth, change.what, times, own))
    watched = WatchedLooks(found, simulate(rig, SECOND_DAY, 1000 * (seed + 1), truth=first.truth).campaign)
    departure = watched.departure(found.z)
    limit = null_distribution(departure, 0).limit
    row["stated"] = {f"{times:g}": powers(departure, limit, 0, times) for times in SIZES}
    return {**row, "days": days}


def day(found: JointFit, first: Campaign, truth: Truth, what: str, times: float, seed: int) -> dict[str, object]:
    """One second day, watched and looked at the classic way."""
    second = simulate(mounted_rig(), SECOND_DAY, seed, truth=truth).campaign
    seen = watch(found, second)
    named = seen.moved[0].what if seen.moved else ""
    told = {
        "verdict": seen.verdict,
        "p": seen.p,
        "p_all": seen.p_all,
        "named": named,
        "classic": classic_alarm(first, second),
    }
    return {"what": what, "times": times, **told}


def one_task(task: tuple[int]) -> dict[str, object]:
    """As `run_rows` asks for it."""
    return one_rig(*task)


def run(arguments: argparse.Namespace) -> None:
    """Append rows until every rig is there."""
    run_rows(one_task, [(seed,) for seed in range(arguments.n)], arguments.rows, ("seed",), arguments.cores)


def share(hits: int, count: int) -> str:
    """With its 95 % interval."""
    low, high = share_interval95(hits, count)
    return f"{100 * hits / count:.1f} % ({100 * low:.1f} to {100 * high:.1f})"


def table(arguments: argparse.Namespace) -> None:
    """Markdown table of alarms and powers."""
    rows = [r for r in read_rows(arguments.rows) if r["converged"]]
    days = [day for row in rows for day in row["days"]]
    print("# False alarms and power of a watched calibration\n")
    print("Written by `python -m experiments.watching.power table`.\n")
    print(
        f"{len(rows)} drawn rigs, {len(days)} second days of 64 looks. In brackets 95 % intervals of the counts; days"
    )
    print("of one rig share its first day, so that they are somewhat wider in truth.\n")
    print("| moved | size | MOVED, counted | stated at least | named right, of MOVED | classic |")
    print("|---|---|---|---|---|---|")
    groups = [
        (NOTHING, 0.0, "", None),
        *((c.what, t, f"{t * c.size:g} {c.unit}", n) for n, c in enumerate(CHANGES) for t in SIZES),
    ]
    for what, times, size, number in groups:
        own = [d for d in days if d["what"] == what and d["times"] == times]
        moved = [d for d in own if d["named"]]
        stated = FALSE_ALARM_RATE if number is None else np.mean([r["stated"][f"{times:g}"][number] for r in rows])
        right = sum(d["named"].split(":")[0] == what.split(":")[0] for d in moved)
        named = f"{right} of {len(moved)}" if number is not None else ""
        alarms = share(sum(d["classic"] for d in own), len(own))
        print(f"| {what} | {size} | {share(len(moved), len(own))} | {100 * stated:.1f} % | {named} | {alarms} |")


def main() -> None:
    """Command line."""
    act(study_parser(__doc__, ROWS, n=50), run=run, table=table)


if __name__ == "__main__":
    main()
