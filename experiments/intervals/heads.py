"""Do the intervals hold the truth of drawn pan-tilt heads, seen by a stereo pair or by their own camera?

    python -m experiments.intervals.heads run --n 30 --cores 0        # of each kind, 10 to 40 CPU s a head, resumable
    python -m experiments.intervals.heads table > experiments/intervals/heads.md

Head i is drawn with seed i, every prior quantity: gears with errors by position, play, drift and scatter, all
terms of the geometry. One with sightings turns to 24 directions twice, in an order of its own; one that carries the
laser runs the shipped grid before a stereo pair. Each is simulated by the twin's own optics, fitted and sampled by
importance.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from experiments.common.against_truth import NOTE, USABLE, answers, failures, table, tried
from experiments.common.command_line import study
from experiments.common.rigs import mounted_rig, shipped_plan
from experiments.common.rows import commit
from tvsbayes.instrument.mechanisms import HEAD, SIGHTING_HEAD
from tvsbayes.instrument.parameters import TERMS, Prior, names_of
from tvsbayes.instrument.plan import PlanBuilder, PlanStep
from tvsbayes.instrument.rig import Rig, RigTable
from tvsbayes.twin.simulated_campaign import simulate

KEYS, KINDS = ("kind", "seed"), ("sightings", "spots")
PAN_STEPS, TILT_STEPS = (-1500, -800, -200, 400, 900, 1500), (100, 400, 800, 1200)


def head_of(kind: str) -> Rig:
    """The prior of a head, from which it is drawn: sightings of 0.005 deg, or the stereo pair of the mounted rig."""
    if kind == "sightings":
        ratios = dict.fromkeys(names_of("degrees_per_step"), Prior(0.05, 0.002))
        table = RigTable(ratios, mechanism=SIGHTING_HEAD)
        return Rig(table, None, dict(table.priors), {}, {}, {"sighting_sd_deg": 0.005}, {"move_s": 20.0, "look_s": 5.0})
    mounted = mounted_rig()
    stated = {n: p for n, p in mounted.table.priors.items() if n in HEAD.parameters}
    table = RigTable(stated, mechanism=HEAD)
    table = replace(table, priors={**table.priors, "elevation_zero_deg": Prior(0.0, 2.0)})
    return replace(mounted, table=table, truth=dict(table.priors))


def plan_of(kind: str, seed: int) -> tuple[PlanStep, ...]:
    """The grid of the mounted rig, or directions in an order of their own, every one twice."""
    if kind == "spots":
        return shipped_plan("grid")
    rng, plan = np.random.default_rng([seed, 12]), PlanBuilder()
    plan.home()
    places = [(pan, tilt) for pan in PAN_STEPS for tilt in TILT_STEPS]
    for _ in range(2):
        for place in rng.permutation(len(places)).tolist():
            plan.move(*places[place])
            plan.look()
    return tuple(plan.steps)


def one_head(task: tuple[str, int]) -> dict[str, object]:
    kind, seed = task
    run, names = simulate(head_of(kind), plan_of(kind, seed), seed), [term.name for term in TERMS]
    row = {"kind": kind, "seed": seed, "commit": commit()}
    return row | tried(run.campaign, run.truth, "importance", names=names)


def page(rows: list[dict]) -> None:
    print(
        "# Coverage over drawn pan-tilt heads\n\nMade by `python -m experiments.intervals.heads`. Heads drawn from the"
    )
    print("default priors of their kind (ratios 0.05(2) deg/step of heads with sightings), simulated with the twin's")
    print(f"optics, fitted and sampled by importance; judged are those accepted or rough. {NOTE}.\n")
    for kind in KINDS:
        if mine := [row for row in rows if row["kind"] == kind]:
            print(f"## Heads with {kind}\n\n{answers(mine, 'head')}")
            table({kind: [row["posterior"] for row in mine if row["answer"] in USABLE]})
            failures(mine, KEYS)


if __name__ == "__main__":
    study(__file__, __doc__, one_head, KEYS, KINDS, page, 30)
