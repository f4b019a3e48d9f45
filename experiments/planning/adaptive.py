"""`acquire --adapt` against fixed plans: minutes to a target, and whether the final intervals hold the truth.

    python -m experiments.planning.adaptive run --n 50 --cores 0 1     # 40 s of processor a rig, resumable
    python -m experiments.planning.adaptive table > experiments/planning/adaptive.md

Rig i is drawn from `data/rigs/mounted` with seed i. `--adapt` begins with the shipped grid and goes on from the twelfth
look as the fits propose, until the effective ratios of all four directions are known to 3e-4 deg/step; the fits run in
the same process, everything else is the run of the command. The fixed plans (the shipped grid, and the shipped plan
that `plan` wrote before any look) are run whole; of their looks the smallest number of the running estimate is sought
(by bisection) whose fit meets the target. Minutes are by `[costs]`. Intervals are Laplace's, 95 %, at the end of each.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.common.command_line import act, study_parser
from experiments.common.fits import compile_for
from experiments.common.rigs import mounted_rig, shipped_plan
from experiments.common.rows import output, read_rows, run_rows
from tvsbayes.acquisition import session
from tvsbayes.acquisition.journal import read_journal
from tvsbayes.acquisition.replanning import NEXT_LEAST, NEXT_SHARE, AdaptWish, Replanning, adapted_plan
from tvsbayes.acquisition.running_estimate import FIRST_LOOKS, GROWTH, EstimateWish
from tvsbayes.errors import NotConverged
from tvsbayes.estimators.joint_fit import JointFit, fit
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.instrument.campaign import Campaign, ordered_spots, read_campaign
from tvsbayes.instrument.plan import PlanStep, plan_seconds
from tvsbayes.planning.next_looks import next_looks
from tvsbayes.planning.target import parse_target
from tvsbayes.statistics.chances import share_interval95
from tvsbayes.statistics.intervals import NORMAL_95

ROWS = output(__file__, "adaptive.jsonl")
TARGET = 3e-4
MINUTES = 40.0
FIXED = "grid", "planned"


class Beside(Replanning):
    """Fits in this process: the same fit and the same proposal, without starting Python for each."""

    def _begin(self, looks: int) -> None:
        self._looks = looks
        count = max(NEXT_LEAST, int(np.ceil(NEXT_SHARE * looks)))
        try:
            target = parse_target(f"u(worst) <= {self.target:g} deg/step")
            found = next_looks(fit(read_campaign(self.folder)), mounted_rig(), target, count)
        except NotConverged:
            return
        self.latest = self._read(json.loads(json.dumps(found.as_json())))


def effective(found: JointFit) -> tuple[np.ndarray, np.ndarray]:
    """Values and Laplace sds of the four effective ratios."""
    return np.asarray(found.mode.effective_deg_per_step), np.asarray(found.draws.effective_deg_per_step).std(axis=0)


def ended(campaign: Campaign, found: JointFit, folder: Path, minutes: float) -> dict[str, object]:
    """What a run arrived at: standardised errors of the ratios beside their truth over the same looks."""
    from tvsbayes.twin.true_rig import read_truth

    value, sd = effective(found)
    true = read_truth(folder / "truth.json", campaign.stereo).effective_deg_per_step(campaign) or {}
    z = [float((value[k] - true[d]) / sd[k]) if d in true else None for k, d in enumerate(DIRECTIONS)]
    return {
        "minutes": minutes,
        "looks": len(campaign.spots),
        "z": z,
        "u": float(sd.max()),
        "met": bool(sd.max() <= TARGET),
    }


def adapted(seed: int, folder: Path) -> dict[str, object]:
    """A run that chooses its looks."""
    rig, plan = mounted_rig(), shipped_plan("grid")
    session.Replanning = Beside
    wish = EstimateWish((), TARGET)
    session.acquire(rig, plan, folder, simulate=True, seed=seed, estimate=wish, adapt=AdaptWish((), MINUTES))
    campaign, journal = read_campaign(folder), read_journal(folder)
    steps = adapted_plan(plan, journal.records)
    last = max(int(str(r.data["step"])) for r in journal.records if r.event == "looked")
    changes = sum(r.event == "adapted" for r in journal.records)
    told = ended(campaign, fit(campaign), folder, plan_seconds(rig, steps[: last + 1]) / 60)
    return {**told, "changes": changes}


def first_looks(campaign: Campaign, count: int) -> Campaign:
    """A campaign that ended after so many looks."""
    spots = tuple(ordered_spots(campaign)[:count])
    return replace(campaign, spots=spots, moves=campaign.moves[: spots[-1].move + 1])


def fixed(seed: int, folder: Path, plan: tuple[PlanStep, ...]) -> dict[str, object]:
    """A fixed plan, ended by the same rule."""
    rig = mounted_rig()
    session.acquire(rig, plan, folder, simulate=True, seed=seed)
    whole = read_campaign(folder)
    sizes = [FIRST_LOOKS]
    while sizes[-1] < len(whole.spots):
        sizes.append(min(len(whole.spots), int(np.ceil(GROWTH * sizes[-1]))))
    fits: dict[int, JointFit] = {}

    def meets(number: int) -> bool:
        fits[number] = fit(first_looks(whole, sizes[number]))
        return fits[number].converged and bool(effective(fits[number])[1].max() <= TARGET)

    low, high = -1, len(sizes) - 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if meets(middle) else (middle, high)
    found = fits.get(high) or fit(first_looks(whole, sizes[high]))
    rows = [step.step for step in plan if step.action == "look"]
    return ended(
        first_looks(whole, sizes[high]), found, folder, plan_seconds(rig, plan[: rows[sizes[high] - 1] + 1]) / 60
    )


def one_rig(seed: int) -> dict[str, object]:
    """All three on one drawn rig."""
    compile_for(96)
    row: dict[str, object] = {"seed": seed}
    with tempfile.TemporaryDirectory() as scratch:
        row["adapt"] = adapted(seed, Path(scratch) / "adapt")
        for name in FIXED:
            row[name] = fixed(seed, Path(scratch) / name, shipped_plan(name))
    return row


def one_task(task: tuple[int]) -> dict[str, object]:
    """As `run_rows` asks for it."""
    return one_rig(*task)


def run(arguments: argparse.Namespace) -> None:
    """Append rows until every rig is there."""
    run_rows(one_task, [(seed,) for seed in range(arguments.n)], arguments.rows, ("seed",), arguments.cores)


def table(arguments: argparse.Namespace) -> None:
    """Markdown tables."""
    rows = read_rows(arguments.rows)
    print("# Looks chosen while measuring, against fixed plans\n")
    print("Written by `python -m experiments.planning.adaptive table`.\n")
    print(
        f"{len(rows)} drawn rigs, target u(worst) <= {TARGET:g} deg/step. Intervals are those of the final Laplace fit;"
    )
    print("in brackets 95 % of the count, in which the four directions of a rig are taken for independent.\n")
    print(
        "| plan | target met | minutes, median (10 to 90 %) | looks, median | 95 % intervals with the truth | rms z |"
    )
    print("|---|---|---|---|---|---|")
    for name in ("adapt", *FIXED):
        own = [row[name] for row in rows if name in row]
        met = sum(o["met"] for o in own)
        minutes = np.quantile([o["minutes"] for o in own], [0.5, 0.1, 0.9])
        z = np.array([v for o in own for v in o["z"] if v is not None])
        inside = int(np.sum(np.abs(z) <= NORMAL_95))
        low, high = share_interval95(inside, len(z))
        share = f"{100 * inside / len(z):.1f} % ({100 * low:.0f} to {100 * high:.0f})"
        looks, rms = np.median([o["looks"] for o in own]), np.sqrt(np.mean(z**2))
        spread = f"{minutes[0]:.1f} ({minutes[1]:.1f} to {minutes[2]:.1f})"
        label = "`--adapt`" if name == "adapt" else f"{name}.csv"
        print(f"| {label} | {met} of {len(own)} | {spread} | {looks:.0f} | {share} | {rms:.2f} |")


def main() -> None:
    """Command line."""
    act(study_parser(__doc__, ROWS, n=50), run=run, table=table)


if __name__ == "__main__":
    main()
