"""Is the promise of a period's table kept by drives at constant rate?

    python -m experiments.compensation.periodic_drives run --n 100 --cores 0 1     # 6 CPU s a drive
    python -m experiments.compensation.periodic_drives table > experiments/compensation/periodic_drives.md

Drives are drawn from their priors, half of them with a wave, whose period is not known beforehand. Where the fit is
accepted and knows a wave, its table is applied to the true wave and creep at 40 times of one span of the promise, drawn
somewhere in the record, with a walk of the zero, new seeing and noise; errors are off the true line of the
drive, but for their mean.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from experiments.common.command_line import study
from experiments.common.drawn_axes import drive
from experiments.common.rows import commit, commits_of
from tvsbayes.compensation.correction import Correction
from tvsbayes.compensation.formats import Wish
from tvsbayes.compensation.promise import compensation_of
from tvsbayes.errors import TvsError
from tvsbayes.results.compensation_record import Compensation
from tvsbayes.single_axis.axis_record import results_for
from tvsbayes.statistics.chances import binomial_bounds
from tvsbayes.twin.simulated_axis import SimulatedAxis, drive_of, simulate_axis

READINGS = 40


def errors_of(axis: SimulatedAxis, table: Compensation | None, span: float, seed: int) -> np.ndarray:
    """Errors (40,) within one span of commands, under a table or without one."""
    rng, campaign = np.random.default_rng([seed, 6]), axis.campaign
    rate, move = float(campaign.rate or 1.0), campaign.moves[0]
    first, last = (float(f([r.time_s for r in campaign.readings])) for f in (np.min, np.max))
    begins = rng.uniform(first, max(first, last - span / rate))
    time_s = np.sort(rng.uniform(begins, begins + span / rate, READINGS))
    command = rate * time_s
    true = axis.truth.parameters
    # The walk up to the span is a shift: it begins with the span, creep and waves keep their own clocks.
    still = replace(axis.truth, parameters={**true, "drift_per_root_hour": 0.0, "seeing_scale": 0.0})
    stands = drive_of(still, move, rate, time_s, rng) - true["per_command"] * command
    walk = np.cumsum(
        true["drift_per_root_hour"] * np.sqrt(np.diff(time_s, prepend=begins) / 3600.0) * rng.standard_normal(READINGS)
    )
    noise = true["reading_u"] * np.hypot(true["reading_scale"], true["seeing_scale"]) * rng.standard_normal(READINGS)
    errors = stands + walk + noise
    if table is not None:
        start = table.table[0].command
        phase = start + (command - start) % table.settings["period_command"]
        errors = errors + table.per_command * (Correction.of(table).sent(phase, np.zeros(READINGS)) - phase)
    return errors - errors.mean()


def one_drive(task: tuple[int]) -> dict[str, object]:
    """Draw, read, fit and compensate one drive."""
    (seed,) = task
    axis = simulate_axis(drive(seed), seed=seed)
    row: dict[str, object] = {"seed": seed, "commit": commit(), "there": any(w.amplitude > 0 for w in axis.truth.waves)}
    try:
        table = compensation_of(results_for(axis.campaign, seed=seed), Wish("pec"), seed=seed)
    except TvsError as error:
        return {**row, "refused": error.message}
    promise, span = table.promise["forward"], table.travel_command
    after, before = (errors_of(axis, by, span, seed) for by in (table, None))
    row |= {"promised": promise.error95, "inside": int(np.sum(np.abs(after) <= promise.error95))}
    row |= {"without_promised": promise.without95, "without": int(np.sum(np.abs(before) <= promise.without95))}
    return {**row, "rms": [float(np.sqrt(np.mean(e**2))) for e in (before, after)]}


def table(rows: list[dict]) -> None:
    done = [row for row in rows if "promised" in row]
    there = [row for row in rows if row["there"]]
    print("# Tables of one period, of drives at constant rate\n")
    made_by = "python -m experiments.compensation.periodic_drives"
    print(f"Made by `{made_by}`, commit {commits_of(rows)}. Errors in arcsec.\n")
    kept = sum(row["there"] for row in done)
    print(f"{len(rows)} drives, {len(there)} with a wave:", end=" ")
    print(f"{kept} of these got a table, {len(done) - kept} of the others.")
    low, high = (100 * bound for bound in binomial_bounds(len(done), 0.95))
    print(f"Bounds of a share over {len(done)} independent readings: {low:.0f} to {high:.0f} %; the {READINGS}")
    print("readings of a drive share its wave and walk.\n")
    print("| | without | with the table |\n|---|---|---|")
    cells = [f"{100 * sum(row[k] for row in done) / (READINGS * len(done)):.1f} %" for k in ("without", "inside")]
    print(f"| within the promise | {' | '.join(cells)} |")
    rms = np.array([row["rms"] for row in done])
    print(f"| median RMS | {np.median(rms[:, 0]):.2f} | {np.median(rms[:, 1]):.2f} |")
    print(f"| drives with less error | | {int(np.sum(rms[:, 1] < rms[:, 0]))} of {len(done)} |")


if __name__ == "__main__":
    study(__file__, __doc__, one_drive, ("seed",), [()], table, 100)
