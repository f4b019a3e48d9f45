"""Execution of a study's rows: in this process, in spawned processes, or on a Dask cluster.

Workers started here have one thread each, so that a row has the same sums in all of them. This process and workers of a
running cluster keep their settings.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent import futures
from contextlib import contextmanager, nullcontext

from tvsbayes.errors import InputError, escaped
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.studies.rows import StudyRow
from tvsbayes.studies.study_job import StudyJob, study_row

SINGLE_THREADED = {
    "NPROC": "1",
    "PJRT_NPROC": "1",
    "JAX_CPU_ENABLE_ASYNC_DISPATCH": "false",
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
}
"""Variables for XLA and OpenBLAS at the start of a process: one thread per worker, and equal sums on every engine."""


def _in_worker(job: StudyJob, index: int) -> StudyRow:
    """Compute `study_row` in a process of its own, which may use the compilation cache."""
    use_compilation_cache()
    return study_row(job, index)


def require_engine(engine: str) -> None:
    """Refuse an engine that cannot compute rows, before the first row.

    Raises:
        InputError: there is no such engine, or Dask is not installed.
    """
    if engine not in ENGINES:
        found, allowed = f"no engine {escaped(engine)}", ", ".join(ENGINES)
        raise InputError("engine", found, column="--engine", allowed=allowed, remedy="name one")
    try:
        if engine == "dask":
            import distributed  # noqa: F401
    except ImportError as error:
        remedy = "pip install 'tvsbayes[dask]', or use --engine processes"
        raise InputError("no-dask", "the engine dask needs the extra dask", column="--engine", remedy=remedy) from error


def made_rows(
    job: StudyJob, indices: Sequence[int], engine: str = "serial", workers: int = 2, address: str | None = None
) -> Generator[StudyRow]:
    """Compute rows of a study, in the order in which they are finished.

    Close the iterator if it is left early, which ends the workers that it started.

    Args:
        job: what is studied.
        indices: indices of the rows.
        engine: one of `ENGINES`.
        workers: number of processes; for Dask only where the cluster is started here.
        address: scheduler of a running Dask cluster.

    Raises:
        InputError: there is no such engine, Dask is not installed, or a worker died.
    """
    require_engine(engine)
    if engine == "serial":
        for index in indices:
            yield study_row(job, index)
        return
    with _environment(SINGLE_THREADED):
        yield from _WORKERS[engine](job, indices, workers, address)


def _worker_died(what: str) -> InputError:
    remedy = "run the same command again: it goes on"
    return InputError("worker-died", f"{what}; finished rows are kept", remedy=remedy)


def _by_processes(job: StudyJob, indices: Sequence[int], workers: int, address: str | None) -> Iterator[StudyRow]:
    """Compute rows in spawned processes, one thread each; JAX must not be forked."""
    pool = futures.ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
    try:
        for future in futures.as_completed([pool.submit(_in_worker, job, index) for index in indices]):
            yield future.result()
    except futures.BrokenExecutor as error:
        raise _worker_died("a worker process of the study died (out of memory, or killed)") from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


LOOKED_AFTER_S, NO_WORKER_S = 10.0, 300.0
"""Time between two looks at the workers of a cluster, and for how long it may have none."""


def _by_dask(job: StudyJob, indices: Sequence[int], workers: int, address: str | None) -> Iterator[StudyRow]:
    """Compute rows on a Dask cluster; another worker repeats the rows of one that dies.

    Dask gives a row up (`KilledWorker`) after more deaths of its workers than `scheduler.allowed-failures`, 3. It would
    wait forever where no worker is left: none is started without a nanny, nor by that of a local cluster once a worker
    died between the end of its row and its fetching (distributed 2026.8).
    """
    from distributed import Client, KilledWorker, LocalCluster, wait
    from distributed.comm import CommClosedError

    local = {"n_workers": workers, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    try:
        with LocalCluster(**local) if address is None else nullcontext(address) as place, Client(place) as client:
            # Not `Client.get_executor`: it waits forever for a row that is fetched while the scheduler dies.
            pending = {client.submit(_in_worker, job, i, pure=False, retries=3) for i in indices}
            seen_s = time.monotonic()
            while pending:
                try:
                    for future in wait(pending, timeout=LOOKED_AFTER_S, return_when="FIRST_COMPLETED").done:
                        row = future.result(timeout=LOOKED_AFTER_S)
                        pending.discard(future)
                        seen_s = time.monotonic()
                        yield row
                except TimeoutError:
                    if client.scheduler_info()["workers"]:
                        seen_s = time.monotonic()
                    elif time.monotonic() - seen_s >= NO_WORKER_S:
                        words = f"the Dask cluster has had no worker for {NO_WORKER_S / 60:g} minutes"
                        raise _worker_died(words) from None
    except KilledWorker as error:
        raise _worker_died("every Dask worker that took a certain row died (out of memory, or killed)") from error
    except (futures.CancelledError, CommClosedError) as error:
        raise _worker_died("the Dask scheduler is gone") from error


_WORKERS = {"processes": _by_processes, "dask": _by_dask}
ENGINES = ("serial", *_WORKERS)


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables for processes started inside."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
