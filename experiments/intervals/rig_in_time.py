"""Do the intervals hold the truth of scanners that creep and follow the temperature?

    python -m experiments.intervals.rig_in_time run --n 100 --cores 0 1    # of each protocol, 10 to 40 CPU s a rig
    python -m experiments.intervals.rig_in_time table > experiments/intervals/rig_in_time.md

Rig i of a shipped protocol is drawn with seed i, every prior quantity anew: the mounted rig, whose zeros creep from the
first move on and shift with a recorded temperature. It is simulated by the twin, fitted and sampled by importance. The
paper's protocol measures one direction after the other, which a creep resembles.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from experiments.common.command_line import act, study_parser
from experiments.common.rigs import drawn_rig, shipped_plan
from experiments.common.rows import output, run_rows
from experiments.intervals.heads import scored, tables
from tvsbayes.instrument.parameters import CREEP_NAMES, names_of
from tvsbayes.instrument.rig import Rig
from tvsbayes.twin.simulated_campaign import simulate

ROWS = output(__file__, "rig_in_time.jsonl")
PROTOCOLS = {"paper": "The paper's, one direction after the other", "mixed": "Mixed directions", "grid": "Grid"}
NAMES = names_of("backlash_deg", "creep_deg", "thermal_deg_per_K")


def moving_rig() -> Rig:
    """What is believed of a rig, and drawn from: the mounted one, whose zeros move in time."""
    rig = drawn_rig()
    return replace(rig, truth={name: p for name, p in rig.truth.items() if name not in CREEP_NAMES})


def temperature_degC(time_s: np.ndarray) -> np.ndarray:
    """Of a room that swings by 2 K to either side in ten minutes."""
    return 20.0 + 2.0 * np.sin(2 * np.pi * time_s / 600.0)


def one_rig(task: tuple[str, int]) -> dict[str, object]:
    """One rig of a protocol."""
    protocol, seed = task
    simulated = simulate(
        moving_rig(), shipped_plan(protocol), seed, aperture=protocol == "grid", temperature_degC=temperature_degC
    )
    return scored(task, simulated, NAMES)


def run(arguments: argparse.Namespace) -> None:
    """So many rigs of each protocol."""
    tasks = [(protocol, seed) for seed in range(arguments.n) for protocol in PROTOCOLS]
    run_rows(one_rig, tasks, arguments.rows, ("kind", "seed"), arguments.cores)


TEXT = """# Coverage over scanners that creep and follow the temperature

Made by `python -m experiments.intervals.rig_in_time`. Mounted rigs drawn from their priors, whose zeros creep (sd 0.05
deg of 20 min) and shift by 0.01 deg/K (sd) with a recorded temperature; fitted and sampled by importance. Coverage of
the 95 % interval and RMS z of the truth, of rigs whose answer was accepted or rough; *prior*: the data take away less
than a tenth of the prior's variance in the median rig, which is not judged. Rigs of one seed are one rig, measured by
other protocols. Bounds are two-sided at 1e-4."""


def table(arguments: argparse.Namespace) -> None:
    """A table for each protocol."""
    tables(arguments, TEXT, PROTOCOLS, "rig")


if __name__ == "__main__":
    made = study_parser(__doc__, ROWS, 100)
    act(made, run=run, table=table)
