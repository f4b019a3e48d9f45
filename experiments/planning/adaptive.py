"""`acquire --adapt` against fixed plans: minutes to a target, and whether the final intervals hold the truth.

    python -m experiments.planning.adaptive run --n 50 --cores 0     # 30 s of processor a run, resumable
    python -m experiments.planning.adaptive table > experiments/planning/adaptive.md

Rig i is drawn from `data/rigs/mounted` with seed i. `--adapt` begins with the shipped grid and goes on from the twelfth
look as the fits propose, until the effective ratios of all four directions are known to 3e-4 deg/step, by Laplace and
then by the sampled posterior (importance sampling); the fits run in the same process, everything else is the run of the
command. The fixed plans (the shipped plan that `plan` wrote before any look, and the shipped grid) are run whole; of
their looks the smallest number of the running estimate is taken that meets the target by the same rule: sought by
bisection where Laplace meets it, then upwards until the sampled posterior does. Minutes are by `[costs]`. Intervals,
95 %, are those in which a run ended: of the posterior that stopped it, and of the Laplace fit before that.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.against_truth import rms
from experiments.common.command_line import study
from experiments.common.page import heading, line
from experiments.common.rigs import mounted_rig, shipped_plan
from tvsbayes.acquisition import session
from tvsbayes.acquisition.journal import read_journal
from tvsbayes.acquisition.replanning import AdaptOptions, Replanning, adapted_plan, looks_next
from tvsbayes.acquisition.running_estimate import FIRST_LOOKS, GROWTH, EstimateOptions
from tvsbayes.acquisition.simulated_instrument import Instrument
from tvsbayes.cli.acquire_command import laplace_estimate, proposal_of, propose_looks
from tvsbayes.errors import NotConverged
from tvsbayes.estimators.joint_fit import JointFit, fit
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import Campaign, ordered_spots, read_campaign
from tvsbayes.instrument.plan import PlanStep, counters_planned, plan_minutes
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.planning.next_looks import Confirmation, confirmation, next_looks
from tvsbayes.planning.target import parse_target
from tvsbayes.statistics.chances import share_interval95
from tvsbayes.statistics.intervals import NORMAL_95
from tvsbayes.twin.true_rig import Truth

TARGET = 3e-4
MINUTES = 40.0
ADAPTIVE, FIXED = "adapt", ("planned", "grid")


@dataclass
class Last:
    """The newest fit of a run and the sampled posterior's confirmation, if there was one."""

    fit: JointFit | None = None
    sampled: Confirmation | None = None


class Beside(Replanning):
    """Fits in this process: the same fit and the same proposal, without starting Python for each; `last` has them."""

    def __init__(self, *arguments: Any, last: Last, **more: Any):
        super().__init__(*arguments, **more)
        self._last = last

    def _begin(self, looks: int) -> None:
        self._looks = looks
        target = parse_target(f"u(worst) <= {self.target:g} deg/step")
        try:
            joint = fit(read_campaign(self.folder))
            options = {"confirm_below": self.confirm_below, "planned": counters_planned(shipped_plan("grid"))}
            proposed = next_looks(joint, mounted_rig(), target, looks_next(looks), **options)
        except NotConverged:
            return
        self._last.fit, self._last.sampled = joint, proposed.confirmed
        self.latest = self._read(proposal_of(proposed, looks))


def laplace_sds(joint: JointFit) -> np.ndarray:
    """Laplace sds of the four effective ratios."""
    return np.asarray(joint.draws.effective_deg_per_step).std(axis=0)


def ended(
    campaign: Campaign, joint: JointFit, sampled: Confirmation | None, truth: Truth, minutes: float
) -> dict[str, object]:
    """What a run arrived at: the ratios beside their truth over the same looks, by Laplace and by the posterior."""
    true = truth.effective_deg_per_step(campaign) or {}
    row: dict[str, object] = {"minutes": minutes, "looks": len(campaign.spots)}
    value, sd = np.asarray(joint.mode.effective_deg_per_step), laplace_sds(joint)
    sampled = sampled or confirmation(joint)
    moved = [d for d in DIRECTIONS if d in true]
    places = [DIRECTIONS.index(d) for d in moved]
    errors = np.array([value[k] - true[d] for k, d in zip(places, moved, strict=True)])
    row["laplace"] = {"u": float(sd.max()), "z": (errors / sd[places]).tolist()}
    ratios = sampled.effective_deg_per_step
    held = [ratios[d].interval95[0] <= true[d] <= ratios[d].interval95[1] for d in moved]
    z = [(ratios[d].value - true[d]) / ratios[d].sd for d in moved]
    u = max(ratio.sd for ratio in ratios.values())
    row["importance"] = {"u": u, "z": z, "held": held, "accepted": sampled.accepted}
    return row


def adapted(seed: int, folder: Path) -> dict[str, object]:
    """A run that chooses its looks."""
    rig, plan, last = mounted_rig(), shipped_plan("grid"), Last()
    truth = Instrument(rig, seed).truth
    session.Replanning = partial(Beside, last=last)
    wish, minutes = EstimateOptions(laplace_estimate, TARGET), AdaptOptions(partial(propose_looks, Path()), MINUTES)
    outcome = session.acquire(rig, plan, folder, simulate=True, seed=seed, estimate=wish, adapt=minutes)
    campaign, journal = read_campaign(folder), read_journal(folder)
    steps = adapted_plan(plan, journal.records)
    row = max(int(str(r.data["step"])) for r in journal.records if r.event == "looked")
    events = [record.event for record in journal.records]
    if last.fit is None or len(last.fit.campaign.spots) < len(campaign.spots):
        last = Last(fit(campaign))
    end = ended(campaign, last.fit, last.sampled, truth, plan_minutes(rig, steps[: row + 1]))
    tests = [dict(record.data) for record in journal.records if record.event == "confirmed"]
    return {**end, "met": outcome.reason == "target met", "changes": events.count("adapted"), "confirmed": tests}


def first_looks(campaign: Campaign, count: int) -> Campaign:
    """A campaign that ended after so many looks."""
    spots = tuple(ordered_spots(campaign)[:count])
    return replace(campaign, spots=spots, moves=campaign.moves[: spots[-1].move + 1])


def fixed(seed: int, folder: Path, plan: tuple[PlanStep, ...]) -> dict[str, object]:
    """A fixed plan, ended by the same rule."""
    rig = mounted_rig()
    truth = Instrument(rig, seed).truth
    session.acquire(rig, plan, folder, simulate=True, seed=seed)
    whole = read_campaign(folder)
    sizes = [FIRST_LOOKS]
    while sizes[-1] < len(whole.spots):
        sizes.append(min(len(whole.spots), int(np.ceil(GROWTH * sizes[-1]))))
    fits: dict[int, JointFit] = {}

    def worst(number: int) -> float:
        """Largest Laplace sd of the ratios with so many looks."""
        joint = fits[number] = fits.get(number) or fit(first_looks(whole, sizes[number]))
        return float(laplace_sds(joint).max()) if joint.converged else float("inf")

    low, end = -1, len(sizes) - 1
    while end - low > 1:
        middle = (low + end) // 2
        low, end = (low, middle) if worst(middle) <= TARGET else (middle, end)
    met, ratio, sampled = False, 1.0, None
    for number in range(end, len(sizes)):
        end, before, sampled = number, worst(number), None
        if before > TARGET / ratio:
            continue
        try:
            sampled = confirmation(fits[number])
        except NotConverged:
            # So few looks that their posterior has no finite density about its mode: as good as no fit.
            continue
        after = max(ratio.sd for ratio in sampled.effective_deg_per_step.values())
        ratio = max(1.0, after / before) if sampled.accepted else ratio
        met = sampled.accepted and after <= TARGET
        if met:
            break
    rows = [step.step for step in plan if step.action == "look"]
    minutes = plan_minutes(rig, plan[: rows[sizes[end] - 1] + 1])
    return {**ended(first_looks(whole, sizes[end]), fits[end], sampled, truth, minutes), "met": met}


def one_run(task: tuple[str, int]) -> dict[str, object]:
    """One plan on one drawn rig."""
    name, seed = task
    use_compilation_cache()
    start = time.process_time()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "run"
        row = adapted(seed, folder) if name == ADAPTIVE else fixed(seed, folder, shipped_plan(name))
    return {"plan": name, "seed": seed, **row, "cpu_s": time.process_time() - start}


def share(hits: int, count: int) -> str:
    """With its 95 % interval."""
    low, high = share_interval95(hits, count)
    return f"{hits} of {count}, {100 * hits / count:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def table(rows: list[dict]) -> None:
    runs = {name: [row for row in rows if row["plan"] == name] for name in (ADAPTIVE, *FIXED)}
    label = {ADAPTIVE: "`--adapt`", **{name: f"{name}.csv" for name in FIXED}}
    print("# Looks chosen while measuring, against fixed plans\n")
    print("Written by `python -m experiments.planning.adaptive table`; what was done stands in the script.\n")
    print(f"Rigs drawn anew, target u(worst) <= {TARGET:g} deg/step by the sampled posterior (importance sampling).\n")
    print(heading("plan | rigs | target met | minutes, median (10 to 90 %) | looks, median"))
    for name, of in runs.items():
        middle, low, high = np.quantile([row["minutes"] for row in of], [0.5, 0.1, 0.9])
        spread, looks = f"{middle:.1f} ({low:.1f} to {high:.1f})", np.median([row["looks"] for row in of])
        print(line(label[name], len(of), sum(row["met"] for row in of), spread, f"{looks:.0f}"))
    print("\nFinal 95 % intervals with the truth in them; in brackets 95 % of the counts. The four directions of a rig")
    print("are no independent trials, left and right least of all: beside them rigs on which all four hold (81 % if")
    print("they were independent, 95 % if they were one).\n")
    print(heading("plan | intervals | of directions | of rigs, all four | rms z"))
    for name, of in runs.items():
        for tier, word in (("importance", "posterior"), ("laplace", "Laplace")):
            print(line(label[name], word, *coverage([row[tier] for row in of])))
    confirmed_part(runs[ADAPTIVE])


def coverage(rows: list[dict]) -> list[str]:
    """How many directions and how many rigs have the truth in their intervals, and the rms of z."""
    z = [np.array(each["z"]) for each in rows]
    held = [np.array(each.get("held", np.abs(err) <= NORMAL_95)) for each, err in zip(rows, z, strict=True)]
    directions = np.concatenate(held)
    whole = sum(bool(err.all()) for err in held)
    return [share(int(directions.sum()), len(directions)), share(whole, len(held)), f"{rms(np.concatenate(z)):.2f}"]


def confirmed_part(rows: list[dict]) -> None:
    """How often the posterior was sampled, its verdicts, its ratio to Laplace."""
    tests = [event for row in rows for event in row["confirmed"]]
    if not tests:
        return
    ratios = [e["importance_u_deg_per_step"] / e["laplace_u_deg_per_step"] for e in tests if e["accepted"]]
    low, middle, high = np.quantile(ratios, [0.1, 0.5, 0.9])
    refused = sum(not e["reached"] for e in tests)
    unusable = sum(not e["accepted"] for e in tests)
    early = sum(not row["confirmed"][0]["reached"] for row in rows if row["confirmed"])
    print(f"\n`--adapt` sampled the posterior {len(tests)} times on {len(rows)} rigs; {refused} times it said that the")
    print(f"target is not reached ({unusable} of them because its weights could not be used), on {early} rigs at the")
    print(f"first time. Its worst u over Laplace's: {middle:.2f} in the median ({low:.2f} to {high:.2f}).")


if __name__ == "__main__":
    study(__file__, __doc__, one_run, ("plan", "seed"), (ADAPTIVE, *FIXED), table, 50)
