"""Waves of stated period in a scanner's gears: do amplitude and phase hold, and is a wave seen where there is none?

    python -m experiments.gears.stated_periods run --n 60 --cores 0        # some 13 CPU s a rig, resumable
    python -m experiments.gears.stated_periods table > experiments/gears/stated_periods.md

Rig s is drawn from `data/rigs/mounted` with seed s and follows the plan "grid". Both axes state a period of
`PERIOD_DEG`; pan has a wave drawn from the prior of its amplitude, tilt has none. Fits are those of `fit --quick`; what
is not accepted is left out and counted. Bounds are binomial at 1e-4, two-sided.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

from experiments.common.command_line import act, study_parser
from experiments.common.rigs import mounted_rig, shipped_plan
from experiments.common.rows import git, output, read_rows, run_rows
from tvsbayes.assessment.gear_waves import gear_periods
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.instrument.axes import AXES
from tvsbayes.instrument.parameters import RIG_PRIORS
from tvsbayes.instrument.rig import PERIODIC_NAMES, Rig
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.posterior.sampling import sample
from tvsbayes.statistics.chances import binomial_bounds
from tvsbayes.twin.simulated_campaign import simulate

ROWS = output(__file__, "stated_periods.jsonl")
PERIOD_DEG = 12.0
SURE = 0.95
"""Probability from which on a wave counts as seen."""


def periodic_rig() -> Rig:
    """The mounted rig with periods; true rigs have a wave of the pan axis alone."""
    rig = mounted_rig()
    priors = {name: prior for name, prior in rig.table.priors.items() if name not in PERIODIC_NAMES}
    table = replace(rig.table, priors=priors, harmonic_period_deg={axis: (PERIOD_DEG,) for axis in AXES})
    wave = "harmonic_amplitude_deg.pan.1"
    return replace(rig, table=table, truth={**rig.truth, wave: RIG_PRIORS[wave]})


def one_rig(task: tuple[int]) -> dict[str, object]:
    """Simulate, fit, compare the waves with the true ones."""
    (seed,) = task
    use_compilation_cache()
    start, rig = time.process_time(), periodic_rig()
    simulated = simulate(rig, shipped_plan("grid"), seed)
    result = fit(simulated.campaign)
    posterior = sample(result, "importance", seed=seed)
    row: dict[str, object] = {"seed": seed, "answer": posterior.convergence.answer}
    errors = simulated.truth.gear_errors["pan"].error_deg
    # The wave stands behind those of the aperiodic part.
    true = complex(errors.cosine_deg[-1], errors.sine_deg[-1])
    row["true_amplitude_deg"], row["true_phase_deg"] = abs(true), float(np.degrees(np.angle(true)))
    for wave in gear_periods(posterior):
        low, high = wave.phase_deg.interval95
        off = (np.degrees(np.angle(true)) - (low + high) / 2 + 180) % 360 - 180
        row[wave.axis] = {
            "amplitude_deg": wave.amplitude.value,
            "u_deg": wave.amplitude.sd,
            "amplitude_held": wave.amplitude.interval95[0] <= abs(true) <= wave.amplitude.interval95[1],
            "phase_held": bool(abs(off) <= (high - low) / 2),
            "probability": wave.probability,
        }
    row["cpu_s"] = time.process_time() - start
    return row


def run(arguments: argparse.Namespace) -> None:
    """Rows of the first n rigs."""
    tasks = [(seed,) for seed in range(arguments.n)]
    run_rows(one_rig, tasks, arguments.rows, ("seed",), arguments.cores)


def table(arguments: argparse.Namespace) -> None:
    """The page."""
    rows = read_rows(arguments.rows)
    good = [row for row in rows if row["answer"] == "accepted"]
    count = len(good)
    print("# Waves of stated period in a scanner's gears\n")
    print(f"`python -m experiments.gears.stated_periods`, commit {git('rev-parse', '--short', 'HEAD')}, {count} of")
    print(f"{len(rows)} rigs accepted. Period {PERIOD_DEG:g} deg; pan has a wave, tilt has none.\n")
    print("| | share | bounds at 1e-4 |\n|---|---|---|")
    low, high = binomial_bounds(count, 0.95)
    for what in ("amplitude", "phase"):
        held = sum(row["pan"][f"{what}_held"] for row in good)
        bounds = f"{100 * low:.1f} to {100 * high:.1f}"
        print(f"| 95 % interval of the {what} holds | {100 * held / count:.1f} % | {bounds} |")
    false = sum(row["tilt"]["probability"] >= SURE for row in good)
    print(f"| no wave, yet probability of one at least {SURE:g} | {100 * false / count:.1f} % | |")
    clear = [row for row in good if row["true_amplitude_deg"] > 4 * row["pan"]["u_deg"]]
    found = sum(row["pan"]["probability"] >= SURE for row in clear)
    print(f"| wave of more than 4 u, probability at least {SURE:g} | {found} of {len(clear)} | |")
    u = np.median([row["pan"]["u_deg"] for row in good])
    cpu_s = np.median([row["cpu_s"] for row in good])
    print(f"\nMedian u of the amplitude {u:.4f} deg; median {cpu_s:.1f} CPU s a rig.")


if __name__ == "__main__":
    act(study_parser(__doc__, ROWS, 60), run=run, table=table)
