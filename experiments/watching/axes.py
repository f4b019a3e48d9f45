"""How often do `watch` and `compare A B` raise a false alarm for one axis, and how often do they notice a change?

    python -m experiments.watching.axes run --n 100 --cores 0 1     # 5 s of processor an axis, resumable
    python -m experiments.watching.axes table > experiments/watching/axes.md

Axes are drawn from the priors (`twin/simulated_axis`), read to and fro after each of three homings, and fitted by
Laplace. Second days of one cycle: eight on which nothing has changed, and one for each change that `watch` tests, of
the size that it must notice. A longer second day of two homings is fitted and compared.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from experiments.common.command_line import study
from experiments.common.drawn_axes import stands
from experiments.common.page import heading, share
from experiments.common.rows import commit, commits_of
from tvsbayes.comparison.axis_sessions import compare_axes, shared_positions, watch_axis
from tvsbayes.comparison.departures import FALSE_ALARM_RATE
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove, Reading
from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_rows import rows_of
from tvsbayes.twin.simulated_axis import AxisTruth, simulate_axis

PLACES = np.linspace(-2000.0, 2000.0, 9)
SAME_DAYS = 8
NOTHING = "nothing"
CHANGES = ("ratio", "play", "zero")


def _moves(homings: int) -> tuple[AxisMove, ...]:
    """A cycle beyond both ends after every homing, a move a minute."""
    cycle = [-2300.0, *PLACES, 2300.0, *PLACES[::-1], -2300.0]
    return tuple(
        AxisMove(k, k // len(cycle), 60.0 * k, float(command), "" if k % len(cycle) else "backward")
        for k, command in enumerate(cycle * homings)
    )


def _day(
    axis: AxisCampaign,
    truth: AxisTruth,
    rng: np.random.Generator,
    what: str = NOTHING,
    by: float = 0.0,
    homings: int = 1,
) -> AxisCampaign:
    """Readings of a true axis after further homings, and after a change by so much."""
    moves, u = _moves(homings), axis.readings[0].u
    ratio, play = (truth.parameters[name] for name in ("per_command", "backlash"))
    changed = {"per_command": ratio * (1 + 0.01 * by * (what == "ratio")), "backlash": play + by * (what == "play")}
    value = stands(replace(truth, parameters=truth.parameters | changed), moves, rng) + by * (what == "zero")
    value += u * rng.standard_normal(len(moves))
    return replace(axis, moves=moves, readings=tuple(Reading(k, k, float(v), u) for k, v in enumerate(value)))


def one_axis(task: tuple[int]) -> dict[str, object]:
    """All second days of an axis."""
    (seed,) = task
    rng = np.random.default_rng([seed, 31])
    axis = simulate_axis(AxisCampaign("deg", _moves(3), (), {"per_command": AxisPrior(0.01, 0.002)}), seed=seed)
    first = fit_axis(axis.campaign, sampled=False, seed=seed)
    row: dict[str, object] = {"seed": seed, "commit": commit(), "converged": not first.missing}
    if first.missing:
        return row
    days = []
    watched = [watch_axis(first, _day(axis.campaign, axis.truth, rng)) for _ in range(SAME_DAYS)]
    days += [{"what": NOTHING, "verdict": test.verdict, "named": "", "p_all": test.p_all} for test in watched]
    for change in watched[0].changes:
        by = change.size * rng.choice((-1.0, 1.0))
        test = watch_axis(first, _day(axis.campaign, axis.truth, rng, change.what, by))
        named = test.moved[0].what if test.moved else ""
        days.append({"what": change.what, "verdict": test.verdict, "named": named, "stated": change.power})
    later = _day(axis.campaign, axis.truth, rng, homings=2)
    second = fit_axis(later, sampled=False, seed=seed, more=shared_positions(first.rows, rows_of(later)))
    if not second.missing:
        row["changes"] = [change.significant for change in compare_axes(first, second).changes]
    return {**row, "days": days}


def table(every: list[dict]) -> None:
    """Counted alarms beside the stated ones."""
    rows = [row for row in every if row["converged"]]
    days = [day for row in rows for day in row["days"]]
    print("# False alarms and power of a watched axis\n")
    print("Written by `python -m experiments.watching.axes table`.\n")
    print(f"{len(rows)} drawn axes, {len(days)} second days of 18 stops after a homing, commit {commits_of(every)}.")
    print("In brackets 95 % intervals of the counts; days of one axis share its first day.\n")
    print(heading("changed | days | MOVED, counted | stated at least | named first, of MOVED"))
    for what in (NOTHING, *CHANGES):
        chosen = [day for day in days if day["what"] == what]
        moved = [day for day in chosen if day["verdict"] == "MOVED"]
        stated = FALSE_ALARM_RATE if what == NOTHING else np.mean([day["stated"] for day in chosen])
        named = "" if what == NOTHING else f"{sum(day['named'] == what for day in moved)} of {len(moved)}"
        print(f"| {what} | {len(chosen)} | {share(len(moved), len(chosen))} | {100 * stated:.1f} % | {named} |")
    same = [day for day in days if day["what"] == NOTHING]
    low = share(sum(day["p_all"] < FALSE_ALARM_RATE for day in same), len(same))
    print(f"\nAll residuals together (`p_all`, a warning) fell below 1 % on {low} of the unchanged days.")
    compared = [row["changes"] for row in rows if "changes" in row]
    alarms = share(sum(any(each) for each in compared), len(compared))
    print(f"`compare A B` found a change, of which chance makes at most 5 %, on {alarms} of {len(compared)} axes.")


if __name__ == "__main__":
    study(__file__, __doc__, one_axis, ("seed",), [()], table, 100)
