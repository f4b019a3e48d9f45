"""How long does a fit take, cold and warm, and how does it grow?

    python experiments/speed.py > experiments/speed.md      # about 12 minutes on 2 cores

Medians of several runs in one process after another on the machine at hand: `fit --no-sample` from process start
without and with the compilation cache; a warm fit of the paper twin; Levenberg-Marquardt stages beside
`scipy.optimize.least_squares(method="lm")` on the same residuals from the same start with the same Jacobian and with
finite differences; compilations that a second campaign of another size causes; time and memory for 400, 4 000 and
40 000 spots.
"""

from __future__ import annotations

import os

# As the command line does; see `tvsbayes.cli.main`.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import json
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize

from tvsbayes.estimators.joint_fit import Fixed, Problem, fit, stage_residuals
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.campaign import ordered_spots, read_campaign, write_campaign
from tvsbayes.instrument.parameters import NAMES
from tvsbayes.instrument.protocols import mixed_protocol
from tvsbayes.instrument.rig import read_rig
from tvsbayes.statistics.least_squares import levenberg_marquardt, residuals_and_jacobian
from tvsbayes.twin.simulated_campaign import simulate

TWIN = shipped_data() / "twins" / "paper_twin"
REPEATS = 5


def seconds(work) -> float:
    """Wall clock of one call."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


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
        problem = Problem(campaign, campaign.rig, np.ones(len(ordered_spots(campaign)), dtype=bool))
        start = np.zeros(len(NAMES))
        # The basin is reached by annealing; peers are compared on the last stage, where all of them converge.
        for inflation in (60.0, 10.0, 2.0):
            start = problem.least_squares(start, inflation)
        fixed = Fixed(jnp.asarray(problem.held), jnp.asarray(start), jnp.asarray(1.0))
        args = (problem.space, problem.arrays, fixed)

        def ours():
            z, tolerance = jnp.asarray(start), jnp.asarray(1e-3)
            return np.asarray(levenberg_marquardt(stage_residuals, z, args, tolerance, 12))

        jitted = jax.jit(lambda z: stage_residuals(z, args))

        def only_residuals(z):
            return np.asarray(jitted(jnp.asarray(z)))

        def jacobian(z):
            return np.asarray(residuals_and_jacobian(stage_residuals, jnp.asarray(z), args)[1])

        def peer(jac):
            options = {"method": "lm", "xtol": 1e-6, "ftol": 1e-6, "gtol": 1e-6}
            return optimize.least_squares(only_residuals, start, jac=jac, **options).x

        cases = {
            "optimistix Levenberg-Marquardt": ours,
            "scipy lm, same Jacobian": lambda: peer(jacobian),
            "scipy lm, finite differences": lambda: peer("2-point"),
        }
        print("| warm, 384 spots | s, median (range) | cost reached |\n|---|---|---|")
        print(f"| whole fit | {spread(warm)} | |")
        for name, work in cases.items():
            best = work()
            cost = float(np.sum(only_residuals(best) ** 2))
            print(f"| last stage: {name} | {spread([seconds(work) for _ in range(REPEATS)])} | {cost:.3f} |")
        print()


def second_campaign() -> None:
    """Compilations of the heavy functions that a campaign of another size causes."""
    import logging

    class Count(logging.Handler):
        messages: tuple[str, ...] = ()

        def emit(self, record):
            Count.messages += (record.getMessage(),)

    campaign = read_campaign(TWIN)
    fit(campaign)
    handler = Count()
    logger = logging.getLogger("jax")
    logger.addHandler(handler)
    # Not `jax.log_compiles`: that holds for one thread, and half of a fit compiles aside.
    jax.config.update("jax_log_compiles", True)
    fit(read_campaign(shipped_data() / "twins" / "grid_twin"))
    jax.config.update("jax_log_compiles", False)
    logger.removeHandler(handler)
    heavy = [m for m in Count.messages if any(n in m for n in ("marquardt", "density", "linearise", "derived"))]
    print(f"Compilations caused by a second campaign (384 spots, then 144): {len(heavy)}\n")


def one_size(spots: int) -> dict[str, float]:
    """Fit a mixed campaign of about this many spots; run in a process of its own for its memory."""
    rig = read_rig(shipped_data() / "rigs" / "mounted" / "rig.toml")
    # Four spots an experiment, four directions.
    simulated = simulate(rig, mixed_protocol(repeats=max(1, spots // 16)), seed=1)
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
        command = [sys.executable, __file__, "one", str(spots)]
        row = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        each = 1000 * row["warm_s"] / row["spots"]
        print(
            f"| {row['spots']} | {row['reading_s']:.2f} | {row['first_s']:.1f} | {row['warm_s']:.1f} "
            f"| {each:.2f} | {row['memory_mib']:.0f} |",
            flush=True,
        )


def main() -> None:
    """Print the tables as Markdown."""
    if sys.argv[1:2] == ["one"]:
        print(json.dumps(one_size(int(sys.argv[2]))))
        return
    print("# Speed\n")
    print(f"Python {platform.python_version()}, jax {jax.__version__}, {os.cpu_count()} cores, {platform.machine()}.\n")
    process_start()
    warm_and_peers()
    second_campaign()
    scaling()


if __name__ == "__main__":
    main()
