"""Campaigns per minute of `tvsbayes study`: in this process against two worker processes, on all cores."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

from experiments.speed.benchmarks.measure import Bench, Case, Column
from tvsbayes.progress import Progress

TITLE = "Throughput of a study"
NAME = "48 spots a campaign, mounted rig"
CAMPAIGNS, REPEATS = 12, 3
WORKERS = {"serial": 1, "processes, 2 workers": 2}


def measure(bench: Bench) -> None:
    """The same campaigns by each engine; the affinity is widened to every core, as the workers need."""
    if not bench.missing(NAME, list(WORKERS), min(bench.repeats, REPEATS)):
        return
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    from experiments.common.rigs import mounted_rig, small_plan
    from tvsbayes.model.compilation_cache import use_compilation_cache
    from tvsbayes.planning.target import DEFAULT_TARGET, parse_target
    from tvsbayes.studies.rows import StudyRows
    from tvsbayes.studies.study import study
    from tvsbayes.studies.study_job import StudyJob

    use_compilation_cache()

    def engine(name: str, campaigns: int = CAMPAIGNS):
        workers = WORKERS[name]

        def row(repeat: int) -> dict[str, object]:
            job = StudyJob(mounted_rig(), small_plan(("d1", "d3")), parse_target(DEFAULT_TARGET), repeat)
            times: list[float] = []

            def report(state: Progress) -> None:
                # Beginning and end of the wait are reported as well, and no campaign twice.
                if round(state.share * campaigns) > len(times):
                    times.append(time.perf_counter())

            with tempfile.TemporaryDirectory() as folder:
                begun = time.perf_counter()
                options = {"engine": name.split(",")[0], "workers": workers, "progress": report}
                study(job, campaigns, StudyRows(Path(folder) / "rows.jsonl"), **options)
                whole = time.perf_counter() - begun
            # Every worker's first campaign carries its start and the reading of compiled functions.
            steady = (campaigns - workers) / max(times[-1] - times[workers - 1], 1e-9)
            return {"rate": 60 * campaigns / whole, "steady": 60 * steady, "first_s": times[0] - begun}

        return row

    # Fills the compilation cache, so that no engine pays for it.
    engine("processes, 2 workers", 2)(0)
    bench.interleaved(NAME, {name: engine(name) for name in WORKERS}, min(bench.repeats, REPEATS))


def cases() -> list[Case]:
    """Tables of the part."""
    about = (
        f"{CAMPAIGNS} campaigns: simulated, fitted, compared with the planner's prediction; wall clock, compilation "
        "cache filled. `serial` is this process with as many threads as JAX wants, workers have one each. Steady: "
        "without every worker's first campaign."
    )
    columns = (
        Column("rate", "campaigns per minute, all in"),
        Column("steady", "steady"),
        Column("first_s", "s to the first"),
    )
    return [Case(NAME, about, columns, "steady", "serial")]
