"""How long does a fit take, cold and warm, and how does it grow?

    python -m experiments.speed.fit_speed > experiments/speed/fit_speed.md      # about 12 minutes on 2 cores

Medians of several runs in one process after another on the machine at hand: `fit --no-sample` from process start
without and with the compilation cache; a warm fit of the paper twin; Levenberg-Marquardt stages beside
`scipy.optimize.least_squares(method="lm")` on the same residuals from the same start with the same Jacobian and with
finite differences; compilations that a second campaign causes; time and memory for 400, 4 000 and
40 000 spots.
"""

from __future__ import annotations

import json
import logging
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from experiments.common.clock import seconds
from experiments.common.command_line import parser
from experiments.common.rigs import mounted_rig, twin_campaign
from experiments.common.rows import ROOT
from experiments.speed.last_stage import last_stage
from tvsbayes.estimators.annealed_stage import STAGE_STEPS
from tvsbayes.estimators.joint_fit import fit
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.campaign import Campaign, read_campaign, write_campaign
from tvsbayes.instrument.protocols import mixed_protocol
from tvsbayes.twin.simulated_campaign import simulate

TWIN = shipped_data() / "twins" / "paper_twin"
REPEATS = 5
ONE_SIZE = (sys.executable, "-m", "experiments.speed.fit_speed", "--spots")
"""Time and memory of one size; run from the root."""


def spread(values: list[float]) -> str:
    """Median and range."""
    return f"{statistics.median(values):.2f} ({min(values):.2f} to {max(values):.2f})"


def process_start() -> None:
    """`tvsbayes fit --no-sample` as a user runs it."""
    cold, cached = [], []
    for _ in range(2):
        with tempfile.TemporaryDirectory() as cache, tempfile.TemporaryDirectory() as out:
            environment = {**os.environ, "TVSBAYES_CACHE": cache}
            command = [sys.executable, "-c", "from tvsbayes.cli.main import main; main()", "fit", str(TWIN)]
            command += ["--no-sample", "--json", "--out", out]

            def run(command=command, environment=environment):
                subprocess.run(command, env=environment, check=True, capture_output=True)

            cold.append(seconds(run))
            cached += [seconds(run), seconds(run)]
    print("| from process start, 384 spots | s, median (range) |\n|---|---|")
    print(f"| first time, empty cache | {spread(cold)} |")
    print(f"| later, with the compilation cache | {spread(cached)} |\n")


def warm_and_peers() -> None:
    """A warm fit, and its least-squares stages beside scipy on the same residuals from the same start."""
    campaign = read_campaign(TWIN)
    fit(campaign)
    warm = [seconds(lambda: fit(campaign)) for _ in range(REPEATS)]
    with jax.enable_x64(True):
        stage = last_stage(campaign)
        cases = {
            "Levenberg-Marquardt": lambda: stage.ours(1e-3, STAGE_STEPS),
            "scipy lm, same Jacobian": lambda: stage.peer("lm"),
            "scipy lm, finite differences": lambda: stage.peer("lm", differences=True),
        }
        print("| warm, 384 spots | s, median (range) | cost reached |\n|---|---|---|")
        print(f"| whole fit | {spread(warm)} | |")
        for name, work in cases.items():
            cost = float(np.sum(stage.residuals(work()) ** 2))
            print(f"| last stage: {name} | {spread([seconds(work) for _ in range(REPEATS)])} | {cost:.3f} |")
        print()


def compilations(campaign: Campaign) -> int:
    """Functions that XLA compiles during a fit."""

    class Count(logging.Handler):
        finished = 0

        def emit(self, record):
            self.finished += record.getMessage().startswith("Finished XLA compilation")

    handler, logger = Count(), logging.getLogger("jax")
    logger.addHandler(handler)
    # Not `jax.log_compiles`: that holds for one thread, and half of a fit compiles aside.
    jax.config.update("jax_log_compiles", True)
    fit(campaign)
    jax.config.update("jax_log_compiles", False)
    logger.removeHandler(handler)
    return handler.finished


def second_campaign() -> None:
    """What campaigns after the first compile: of another number of spots, and of gears seen at more places."""
    first = read_campaign(TWIN)
    fit(first)
    fewer = compilations(replace(first, spots=first.spots[:200]))
    more_places = compilations(twin_campaign("grid_twin"))
    print(f"Compilations caused by a second campaign: {fewer} by 200 of the 384 spots, {more_places} by the grid twin,")
    print("whose gears are seen at more places.\n")


def one_size(spots: int) -> dict[str, float]:
    """Fit a mixed campaign of about this many spots; run in a process of its own for its memory."""
    # Four spots an experiment, four directions.
    simulated = simulate(mounted_rig(), mixed_protocol(repeats=max(1, spots // 16)), seed=1)
    with tempfile.TemporaryDirectory() as folder:
        write_campaign(simulated.campaign, Path(folder) / "c")
        reading = seconds(lambda: read_campaign(Path(folder) / "c"))
    # The largest is fitted once: its compilation, which the smaller rows show, is small beside its run time.
    first = seconds(lambda: fit(simulated.campaign))
    warm = seconds(lambda: fit(simulated.campaign)) if spots < 10_000 else first
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    count = len(simulated.campaign.spots)
    return {"spots": count, "reading_s": reading, "first_s": first, "warm_s": warm, "memory_mib": memory}


def scaling() -> None:
    """Time and peak memory against the number of spots."""
    print("| spots | read, s | first fit, s | warm fit, s | warm, ms per spot | peak memory, MiB |")
    print("|---|---|---|---|---|---|")
    for spots in (400, 4_000, 40_000):
        command = [*ONE_SIZE, str(spots)]
        row = json.loads(subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout)
        each = 1000 * row["warm_s"] / row["spots"]
        print(
            f"| {row['spots']} | {row['reading_s']:.2f} | {row['first_s']:.1f} | {row['warm_s']:.1f} "
            f"| {each:.2f} | {row['memory_mib']:.0f} |",
            flush=True,
        )


def main() -> None:
    """Print the tables as Markdown."""
    command = parser(__doc__)
    command.add_argument("--spots", type=int, help="only fit this many spots and print the row")
    if (spots := command.parse_args().spots) is not None:
        print(json.dumps(one_size(spots)))
        return
    print("# Speed\n")
    print(f"Python {platform.python_version()}, jax {jax.__version__}, {os.cpu_count()} cores, {platform.machine()}.\n")
    process_start()
    warm_and_peers()
    second_campaign()
    scaling()


if __name__ == "__main__":
    main()
