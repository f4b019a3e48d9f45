"""How often does a fit of a clean axis raise a doubt, and how often does one of an axis with a planted fault?

    python -m experiments.intervals.fit_doubts run --n 200 --cores 0 1     # 2 s of processor an axis, resumable
    python -m experiments.intervals.fit_doubts table > experiments/intervals/fit_doubts.md

Axes are drawn from the priors (`twin/simulated_axis`), with a play that is negative nowhere, read at nine places to and
fro twice, and fitted by Laplace. Planted: a stated u that is ten times all scatter; a reader that turns with the axis
and errs once and twice a turn, by five plays each.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from experiments.common.command_line import study
from experiments.common.page import heading, line
from experiments.common.rows import commit, commits_of
from tvsbayes.single_axis.axis_campaign import AxisCampaign, AxisMove
from tvsbayes.single_axis.axis_fit import fit_axis
from tvsbayes.single_axis.axis_parameters import AxisPrior
from tvsbayes.single_axis.axis_record import summarise_axis
from tvsbayes.single_axis.fit_doubts import RULES
from tvsbayes.single_axis.waves import WavePeriods
from tvsbayes.statistics.chances import binomial_bounds
from tvsbayes.twin.simulated_axis import simulate_axis

CLEAN, WAVE, WIDE_U, POSE = "clean", "clean, a wave of 60 deg stated", "u is ten times the scatter", "reader errs"
KINDS = (CLEAN, WAVE, WIDE_U, POSE)
PLACES = np.linspace(-180.0, 180.0, 9)


def drawn_axis(kind: str, seed: int) -> AxisCampaign:
    """An axis read in two cycles beyond both ends, a move a minute; the play is stated to the simulation alone."""
    rng, ratio = np.random.default_rng([seed, 7]), AxisPrior(1.0, 0.01)
    commands = [-200.0, *[*PLACES, 200.0, *PLACES[::-1], -200.0] * 2]
    moves = tuple(AxisMove(k, 0, 60.0 * k, float(c), "" if k else "backward") for k, c in enumerate(commands))
    periods = WavePeriods((60.0,)) if kind == WAVE else WavePeriods()
    while True:
        play = abs(rng.normal(0.0, 0.01 * 360.0))
        stated = {"per_command": ratio, "backlash": AxisPrior(play, 0.0)}
        axis = simulate_axis(AxisCampaign("deg", moves, (), stated, periods=periods), seed=int(rng.integers(2**31)))
        if play + axis.truth.play_variation.min() > 0:
            break
    readings = axis.campaign.readings
    if kind == WIDE_U:
        sides = [axis.truth.parameters[f"stop_sd.{side}"] for side in ("forward", "backward")]
        readings = tuple(replace(each, u=10.0 * max(each.u, *sides)) for each in readings)
    elif kind == POSE:
        phases, turn = rng.uniform(0.0, 2 * np.pi, 2), np.array([1.0, 2.0])
        values = np.array([float(each.value or 0.0) for each in readings])
        values += 5.0 * play * np.sin(np.radians(np.outer(values, turn)) + phases).sum(axis=1)
        readings = tuple(replace(each, value=float(value)) for each, value in zip(readings, values, strict=True))
    return replace(axis.campaign, readings=readings, stated={"per_command": ratio})


def one_axis(task: tuple[str, int]) -> dict[str, object]:
    kind, seed = task
    doubts = summarise_axis(fit_axis(drawn_axis(kind, seed), sampled=False, seed=seed)).doubts
    row = {"kind": kind, "seed": seed, "commit": commit(), "doubts": [doubt.name for doubt in doubts]}
    return {**row, "usable": all(doubt.usable for doubt in doubts)}


TEXT = """# Doubts about fits of axes

Made by `python -m experiments.intervals.fit_doubts`: drawn axes, read at nine places to and fro twice, fitted by
Laplace. How many fits raise each doubt, and how many are called DOUBTFUL; other doubts leave them usable. Right are
idle processes where they are drawn so small, the stated u, and the error by position of a reader.
"""


def table(rows: list[dict]) -> None:
    print(f"{TEXT}\n{len(rows)} axes, commit {commits_of(rows)}.\n")
    print(heading("axes", "n", *(rule.name for rule in RULES), "DOUBTFUL", "bounds of 1 %"))
    for kind in KINDS:
        if mine := [row for row in rows if row["kind"] == kind]:
            counts = Counter(name for row in mine for name in row["doubts"])
            doubtful, (low, high) = sum(not row["usable"] for row in mine), binomial_bounds(len(mine), 0.01)
            bounds = f"{low * len(mine):.0f} to {high * len(mine):.0f}"
            print(line(kind, len(mine), *(counts[rule.name] for rule in RULES), doubtful, bounds))


if __name__ == "__main__":
    study(__file__, __doc__, one_axis, ("kind", "seed"), KINDS, table, 200)
