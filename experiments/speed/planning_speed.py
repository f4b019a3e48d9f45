"""How long does a plan take, and how many designs are scored per second, up to 10 000 candidates?

    python -m experiments.speed.planning_speed > experiments/speed/planning_speed.md       # two minutes

Whole commands: `plan RIG`, and `plan RIG --given` a fitted campaign, from process start with everything in the
compilation cache, as multiples of the import of JAX, optimistix and scipy.stats in the same run. Exact: a whole plan
through the filter, `information_of`. Drawn instruments: looks at many of them, one by one and together, and what fits
of designs of five sizes will report. Search: one step of the greedy choice scores every candidate beside what is chosen
already. CPU seconds, the least of several runs.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from experiments.common.clock import timed
from experiments.common.command_line import print_only
from experiments.common.rigs import mounted_rig
from experiments.speed.benchmarks.measure import command_cost
from tvsbayes.estimators.campaign_arrays import bucket
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.protocols import grid_protocol, paper_protocol
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.planning.assurance import Assurance, Family
from tvsbayes.planning.candidates import candidates
from tvsbayes.planning.drawn_rigs import draw_instruments
from tvsbayes.planning.expectation import (
    DESIGN_GROWTH,
    PARAMETERS,
    SMALLEST_DESIGN,
    Knowledge,
    information_of,
    prior_knowledge,
)
from tvsbayes.planning.looks import LookArrays, Looks
from tvsbayes.planning.search import Search
from tvsbayes.planning.target import DEFAULT_TARGET, parse_target

SIZES = (100, 1000, 10_000)
REPEATS = 3
INSTRUMENTS, DISTINCT, DESIGNS = 200, 24, (4, 8, 16, 32, 64)
IMPORT = (sys.executable, "-c", "import jax, optimistix, scipy.stats")
COMMAND = (sys.executable, "-m", "tvsbayes")


def least(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """CPU seconds of the fastest of several runs, after one that compiles."""
    work()
    return min(timed(work)[1]["cpu_s"] for _ in range(repeats))


def child_cpu(*command: str) -> float:
    """CPU seconds of a process from its start to its end."""
    return command_cost(command)[1]["cpu_s"]


def commands() -> None:
    """`plan` before and after a campaign, from process start."""
    rig = str(shipped_data() / "rigs" / "mounted" / "rig.toml")
    with tempfile.TemporaryDirectory() as folder:
        twin = shutil.copytree(shipped_data() / "twins" / "paper_twin", Path(folder) / "twin")
        child_cpu(*COMMAND, "fit", str(twin), "--no-sample")
        jobs = {
            "import of jax, optimistix, scipy.stats": IMPORT,
            "plan RIG": (*COMMAND, "plan", rig, "--json"),
            "plan RIG --given CAMPAIGN (fitted)": (*COMMAND, "plan", rig, "--given", str(twin), "--json"),
        }
        seconds: dict[str, list[float]] = {name: [] for name in jobs}
        for turn in range(REPEATS + 1):
            for name, job in jobs.items():
                cpu = child_cpu(*job)
                # The first turn may compile.
                seconds[name] += [cpu] if turn else []
    medians = {name: float(np.median(values)) for name, values in seconds.items()}
    print("| from process start, caches warm | CPU s, median | times the import |\n|---|---|---|")
    for name, cpu in medians.items():
        print(f"| {name} | {cpu:.1f} | {cpu / medians['import of jax, optimistix, scipy.stats']:.1f} |", flush=True)
    print()


def exact(knowledge: Knowledge) -> None:
    """Whole plans through the filter."""
    print("| exact evaluation | looks | padded to | CPU ms | designs/s |\n|---|---|---|---|---|")
    for name, steps in (("grid, one sheet", grid_protocol(("d1",))), ("paper", paper_protocol())):
        one = least(lambda steps=steps: information_of(steps, knowledge))
        looks = sum(step.action == "look" for step in steps)
        padded = bucket(looks, SMALLEST_DESIGN, DESIGN_GROWTH)
        print(f"| {name} | {looks} | {padded} | {1e3 * one:.1f} | {1 / one:.0f} |")
    print()


def many_instruments(knowledge: Knowledge, generator: np.random.Generator) -> None:
    """Looks at drawn instruments, and what fits of designs of them report."""
    pool = candidates(knowledge)
    picks = generator.choice(generator.permutation(len(pool.looks))[:DISTINCT], 4 * DESIGNS[-1])
    family = Family(knowledge, pool, picks, False)
    instruments = draw_instruments(knowledge, INSTRUMENTS, 0)
    assurance = Assurance(family, parse_target(DEFAULT_TARGET), instruments, 0)
    arrays, looks = assurance.arrays, len(assurance.looks)

    def one_by_one() -> None:
        for row, z in enumerate(instruments.z):
            arrays.at(z, instruments.space_of(row))

    single, together = least(one_by_one, 2), least(lambda: arrays.at_all(instruments.z, instruments.value))
    reports = least(lambda: assurance.of(family).values(DESIGNS), 3)
    print(
        f"{looks} looks at {INSTRUMENTS} instruments: {1e3 * single / INSTRUMENTS:.1f} CPU ms each one by one, "
        f"{1e3 * together / INSTRUMENTS:.2f} together. What fits of {len(DESIGNS)} designs of them (up to "
        f"{DESIGNS[-1]} experiments, {4 * DESIGNS[-1]} looks) report of all {INSTRUMENTS}: {reports:.2f} CPU s.\n"
    )


def search(knowledge: Knowledge, generator: np.random.Generator) -> None:
    """Greedy choice among many candidates."""
    print("| candidates | looks linearised, s | one greedy step, ms | designs scored per second | 40 looks chosen, s |")
    print("|---|---|---|---|---|")
    for count in SIZES:
        steps = np.stack([generator.integers(-60, 240, count), generator.integers(-100, 100, count)], axis=1)
        looks = Looks(steps, generator.choice([-1, 1], (count, 2)), generator.integers(0, 3, count))
        arrays = LookArrays(looks, knowledge, False)
        linearised = least(lambda arrays=arrays: arrays.at(knowledge.z, knowledge.space), 2)
        rows = arrays.at(knowledge.z, knowledge.space).rows[..., :PARAMETERS]
        among = Search(rows, knowledge.precision, generator.standard_normal((4, PARAMETERS)), np.zeros(4))
        chosen = least(lambda among=among: among.greedy(40), 3)
        step = chosen / 40
        print(f"| {count} | {linearised:.2f} | {1e3 * step:.1f} | {count / step:.0f} | {chosen:.2f} |")


def main() -> None:
    """Print the tables."""
    print_only(__doc__)
    use_compilation_cache()
    knowledge, generator = prior_knowledge(mounted_rig()), np.random.default_rng(1)
    print("# Speed of planning\n")
    print("Written by `python -m experiments.speed.planning_speed`; CPU seconds of a machine shared with others.\n")
    commands()
    exact(knowledge)
    many_instruments(knowledge, generator)
    search(knowledge, generator)


if __name__ == "__main__":
    main()
