"""Do the intervals hold the truth of drawn pan-tilt heads, seen by a stereo pair or by their own camera?

    python -m experiments.intervals.heads run --n 30 --cores 0        # of each kind, 10 to 40 CPU s a head, resumable
    python -m experiments.intervals.heads table > experiments/intervals/heads.md

Head i is drawn with seed i, every prior quantity anew: gears with errors by position, play, drift and scatter, all
terms of the geometry. One with sightings turns to 24 directions twice, in an order of its own; one that carries the
laser runs the shipped grid before a stereo pair. Each is simulated by the twin's own optics, fitted and sampled by
importance.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from experiments.common.command_line import act, study_parser
from experiments.common.rigs import mounted_rig, shipped_plan
from experiments.common.rows import commit, output, read_rows, run_rows
from tvsbayes.errors import TvsError
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.instrument.mechanisms import HEAD, SIGHTING_HEAD
from tvsbayes.instrument.parameters import HEAD_TERMS, Prior, names_of
from tvsbayes.instrument.plan import PlanBuilder, PlanStep
from tvsbayes.instrument.rig import Rig, RigTable
from tvsbayes.instrument.stereo_pair import NO_STEREO
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.posterior.sampling import sample
from tvsbayes.statistics.chances import binomial_bounds, rms_bounds
from tvsbayes.twin.simulated_campaign import SimulatedCampaign, simulate

ROWS = output(__file__, "heads.jsonl")
KINDS = ("sightings", "spots")
PAN_STEPS, TILT_STEPS = (-1500, -800, -200, 400, 900, 1500), (100, 400, 800, 1200)
LEVEL = 0.95
FAR = 4.0
"""Standard uncertainties beyond which a head is named."""
SETTLED = 0.1
"""Share of a prior's variance that the data must take away for a quantity to be judged."""


def head_of(kind: str) -> Rig:
    """What is believed of a head, and drawn from: sightings of 0.005 deg, or the stereo pair of the mounted rig."""
    if kind == "sightings":
        ratios = dict.fromkeys(names_of("degrees_per_step"), Prior(0.05, 0.002))
        table = RigTable(ratios, mechanism=SIGHTING_HEAD)
        return Rig(
            table, NO_STEREO, dict(table.priors), {}, {}, {"sighting_sd_deg": 0.005}, {"move_s": 20.0, "look_s": 5.0}
        )
    mounted = mounted_rig()
    stated = {n: p for n, p in mounted.table.priors.items() if n in HEAD.documented}
    table = RigTable(stated, mechanism=HEAD)
    small = {"elevation_zero_deg": Prior(0.0, 2.0)}
    table = replace(table, priors={**table.priors, **small})
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
    """One head."""
    kind, seed = task
    names = (*(term.name for term in HEAD_TERMS.values()), *names_of("backlash_deg"))
    return scored(task, simulate(head_of(kind), plan_of(kind, seed), seed), names)


def scored(task: tuple[str, int], simulated: SimulatedCampaign, names: Sequence[str]) -> dict[str, object]:
    """Headlines and parameters of a simulated campaign against their truth; a fit that fails is a row without them."""
    kind, seed = task
    use_compilation_cache()
    campaign, began = simulated.campaign, time.process_time()
    row: dict[str, object] = {"kind": kind, "seed": seed, "commit": commit(), "answer": "none", "problems": []}
    try:
        estimate = fit(campaign)
        row["problems"] = list(estimate.problems)
        if estimate.converged:
            posterior = sample(estimate, "importance")
            quantities = _quantities(estimate, posterior, simulated, names)
            row |= {"answer": posterior.convergence.answer, "quantities": quantities}
    except TvsError as error:
        row["problems"] = [error.message]
    return {**row, "cpu_s": time.process_time() - began}


def _quantities(estimate, posterior, simulated, names: Sequence[str]) -> dict[str, dict[str, float]]:
    """Of each: z of the truth, share of the draws below it, share of the prior's variance that the data take away."""
    draws, weights = posterior.by_name, posterior.weights.ravel()
    true = dict(simulated.truth.parameters)
    headline = simulated.truth.effective_deg_per_step(simulated.campaign) or {}
    true |= {f"effective_deg_per_step.{direction}": value for direction, value in headline.items()}
    for axis, (one, other) in {"pan": ("left", "right"), "tilt": ("up", "down")}.items():
        true[f"effective_contrast_deg_per_step.{axis}"] = headline[one] - headline[other]
    prior = {name: np.asarray(estimate.prior_draws.physical)[:, k].var() for k, name in enumerate(estimate.names)}
    result = {}
    for name in draws:
        if name not in true or not (name in names or name.startswith("effective_")) or prior.get(name) == 0:
            continue
        values = draws[name]
        mean = weights @ values
        variance = weights @ (values - mean) ** 2
        result[name] = {
            "z": float((mean - true[name]) / np.sqrt(variance)),
            "pit": float(weights @ (values < true[name])),
            "taken": float(1 - variance / prior[name]) if name in prior else 1.0,
        }
    return result


def run(arguments: argparse.Namespace) -> None:
    """So many heads of each kind."""
    tasks = [(kind, seed) for seed in range(arguments.n) for kind in KINDS]
    run_rows(one_head, tasks, arguments.rows, ("kind", "seed"), arguments.cores)


TEXT = """# Coverage over drawn pan-tilt heads

Made by `python -m experiments.intervals.heads`. Heads drawn from the default priors of their kind (ratios 0.05(2)
deg/step of heads with sightings), simulated with the twin's optics, fitted and sampled by importance. Coverage of the
95 % interval and RMS z of the truth, of heads whose answer was accepted or rough; *prior*: the data take away less than
a tenth of the prior's variance in the median head, which is not judged. Bounds are two-sided at 1e-4."""


def table(arguments: argparse.Namespace) -> None:
    """A table for each kind."""
    tables(arguments, TEXT, {kind: f"Heads with {kind}" for kind in KINDS}, "head")


def tables(arguments: argparse.Namespace, text: str, titles: Mapping[str, str], what: str) -> None:
    """Text, and a table for each kind that has rows; `what`: a word for what is drawn."""
    print(text)
    for kind, title in titles.items():
        rows = [row for row in read_rows(arguments.rows) if row["kind"] == kind]
        good = [row for row in rows if row["answer"] in ("accepted", "rough")]
        if not good:
            continue
        answers = Counter(row["answer"] for row in rows)
        counts = ", ".join(f"{count} {word}" for word, count in answers.most_common())
        cpu = np.median([row["cpu_s"] for row in rows])
        commits = ", ".join(dict.fromkeys(str(row.get("commit", "?")) for row in rows))
        low, high = (100 * share for share in binomial_bounds(len(good), LEVEL))
        least, most = rms_bounds(len(good))
        print(f"\n## {title}\n\n{len(rows)} {what}s: {counts}; median {cpu:.0f} CPU s. ", end="")
        print(f"Commit {commits}. Bounds {low:.0f} to {high:.0f} % and {least:.2f} to {most:.2f}.\n")
        print("| quantity | 95 % interval holds | RMS z | prior's variance taken away |\n|---|---|---|---|")
        every = []
        for name in good[0]["quantities"]:
            scores = [row["quantities"][name] for row in good]
            taken = float(np.median([score["taken"] for score in scores]))
            inside = np.array([abs(score["pit"] - 0.5) < LEVEL / 2 for score in scores])
            rms = float(np.sqrt(np.mean([score["z"] ** 2 for score in scores])))
            share = f"{100 * inside.mean():.1f} %" + ("" if low <= 100 * inside.mean() <= high else " **!**")
            spread = f"{rms:.2f}" + ("" if least <= rms <= most else " **!**")
            every += inside.tolist() if taken >= SETTLED else []
            cells = (share, spread) if taken >= SETTLED else ("*prior*", "")
            print(f"| `{name}` | {cells[0]} | {cells[1]} | {100 * taken:.0f} % |")
        print(f"| all judged | {100 * np.mean(every):.1f} % of {len(every)} | | |")
        for row in good:
            if far := [f"`{name}` {q['z']:+.1f}" for name, q in row["quantities"].items() if abs(q["z"]) > FAR]:
                print(f"\n{what.capitalize()} {row['seed']} lies beyond {FAR:g} u: {', '.join(far)}.")


if __name__ == "__main__":
    made = study_parser(__doc__, ROWS, 30)
    act(made, run=run, table=table)
