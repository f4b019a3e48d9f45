"""How long does a plan take, and how many designs are scored per second, up to 10 000 candidates?

    python -m experiments.speed.planning_speed > experiments/speed/planning_speed.md       # two minutes

Whole commands: `plan RIG`, and `plan RIG --given` a fitted campaign, from process start with everything in the
compilation cache, as multiples of the import of JAX, optimistix and scipy.stats in the same run. Exact: a whole plan
through the filter, `information_of`. Search: one step of the greedy choice scores every candidate beside what is chosen
already. CPU seconds, the least of several runs.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from experiments.common.clock import timed
from experiments.common.command_line import print_only
from experiments.common.commands import IMPORTS, PROGRAM, measured
from experiments.common.page import heading, line
from experiments.common.rigs import mounted_rig
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.protocols import grid_protocol, paper_protocol
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.planning.expectation import PARAMETERS, information_of, prior_knowledge
from tvsbayes.planning.looks import LookArrays, Looks
from tvsbayes.planning.search import Search

SIZES, REPEATS = (100, 1000, 10_000), 3


def least(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """CPU seconds of the fastest of several runs, after one that compiles."""
    work()
    return min(timed(work)[1]["cpu_s"] for _ in range(repeats))


def commands() -> None:
    """`plan` before and after a campaign, from process start."""
    rig = shipped_data() / "rigs" / "mounted" / "rig.toml"
    with tempfile.TemporaryDirectory() as folder:
        twin = shutil.copytree(shipped_data() / "twins" / "paper_twin", Path(folder) / "twin")
        measured([*PROGRAM, "fit", twin, "--no-sample"])
        jobs = {
            "import of jax, optimistix, scipy.stats": IMPORTS,
            "plan RIG": (*PROGRAM, "plan", rig, "--json"),
            "plan RIG --given CAMPAIGN (fitted)": (*PROGRAM, "plan", rig, "--given", twin, "--json"),
        }
        # The first turn may compile.
        turns = [{name: measured(job)[1]["cpu_s"] for name, job in jobs.items()} for _ in range(REPEATS + 1)][1:]
    medians = [float(np.median([turn[name] for turn in turns])) for name in jobs]
    print(heading("from process start, caches warm | CPU s, median | times the import"))
    for name, cpu_s in zip(jobs, medians, strict=True):
        print(line(name, f"{cpu_s:.1f}", f"{cpu_s / medians[0]:.1f}"), flush=True)


def main() -> None:
    print_only(__doc__)
    use_compilation_cache()
    knowledge, generator = prior_knowledge(mounted_rig()), np.random.default_rng(1)
    print("# Speed of planning\n\nWritten by `python -m experiments.speed.planning_speed`; CPU seconds of a machine")
    print("shared with others.\n")
    commands()
    print("\n" + heading("exact evaluation | looks | CPU ms | designs/s"))
    for name, steps in (("grid, one sheet", grid_protocol(("d1",))), ("paper", paper_protocol())):
        one = least(lambda steps=steps: information_of(steps, knowledge))
        print(line(name, sum(step.action == "look" for step in steps), f"{1e3 * one:.1f}", f"{1 / one:.0f}"))
    titles = "candidates | looks linearised, s | one greedy step, ms | designs scored per second | 40 looks chosen, s"
    print("\n" + heading(titles))
    for count in SIZES:
        steps = np.stack([generator.integers(-60, 240, count), generator.integers(-100, 100, count)], axis=1)
        looks = Looks(steps, generator.choice([-1, 1], (count, 2)), generator.integers(0, 3, count))
        arrays = LookArrays(looks, knowledge, False)
        linearised = least(lambda arrays=arrays: arrays.at(knowledge.z, knowledge.space), 2)
        rows = arrays.at(knowledge.z, knowledge.space).rows[..., :PARAMETERS]
        among = Search(rows, knowledge.precision, generator.standard_normal((4, PARAMETERS)), np.zeros(4))
        chosen = least(lambda among=among: among.greedy(40))
        cells = f"{linearised:.2f}", f"{25 * chosen:.1f}", f"{40 * count / chosen:.0f}", f"{chosen:.2f}"
        print(line(count, *cells))


if __name__ == "__main__":
    main()
