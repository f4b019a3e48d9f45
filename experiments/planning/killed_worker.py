"""Does a study lose anything when a worker of a Dask cluster dies? Two worker processes, one killed in mid-run.

    python -m experiments.planning.killed_worker        # five minutes; needs the extra dask

The same study is made serially in this process, and on a local cluster of two worker processes of which one is killed
(SIGKILL) after the second row. Printed: rows, whether every number is the same, and what the cluster did.
"""

from __future__ import annotations

import os
import signal
import tempfile
from dataclasses import replace
from pathlib import Path

from experiments.common.command_line import print_only
from experiments.common.rigs import mounted_rig, small_plan
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.planning.target import DEFAULT_TARGET, parse_target
from tvsbayes.progress import Progress
from tvsbayes.studies.executors import SINGLE_THREADED
from tvsbayes.studies.rows import StudyRow, StudyRows
from tvsbayes.studies.study import study
from tvsbayes.studies.study_job import StudyJob

CAMPAIGNS = 10
KILL_AFTER = 2


def main() -> None:
    """Run both, compare."""
    print_only(__doc__)
    from distributed import Client, LocalCluster

    os.environ.update(SINGLE_THREADED)
    use_compilation_cache()
    job = StudyJob(mounted_rig(), small_plan(("d1", "d3")), parse_target(DEFAULT_TARGET), 3)

    def numbers(path: Path) -> dict[int, StudyRow]:
        return {i: replace(row, seconds=0.0) for i, row in StudyRows(path).of(job.key).items()}

    with tempfile.TemporaryDirectory() as folder:
        on_cluster, serial = Path(folder) / "dask.jsonl", Path(folder) / "serial.jsonl"
        options = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
        with LocalCluster(**options) as cluster, Client(cluster) as client:
            workers = client.run(os.getpid)
            print("worker processes:", sorted(workers.values()), flush=True)

            def progress(state: Progress) -> None:
                done = len(rows.of(job.key))
                if done == KILL_AFTER:
                    victim = min(client.run(os.getpid).values())
                    os.kill(victim, signal.SIGKILL)
                    print(f"killed worker {victim} after {done} of {CAMPAIGNS} rows", flush=True)

            rows = StudyRows(on_cluster)
            study(job, CAMPAIGNS, rows, engine="dask", address=cluster.scheduler_address, progress=progress)
            print("worker processes at the end:", sorted(client.run(os.getpid).values()), flush=True)
        study(job, CAMPAIGNS, StudyRows(serial), engine="serial")
        one, other = numbers(on_cluster), numbers(serial)
        lines = on_cluster.read_bytes().count(b"\n")
    print(f"rows on the cluster: {sorted(one)}, lines in the file: {lines}; serial: {sorted(other)}")
    print(f"every number the same: {one == other}; converged: {sum(r.converged for r in one.values())}")


if __name__ == "__main__":
    main()
