"""Where the rows of a study are made: in this process, in spawned processes, or on a Dask cluster.

Workers started here have one thread each, so that the sums of a row are the same in all of them; this process and the
workers of a cluster that runs already have what their owner gave them.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator, Mapping
from concurrent import futures
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager
from typing import Protocol

from tvsbayes.errors import InputError, escaped
from tvsbayes.model.compilation_cache import use_compilation_cache
from tvsbayes.studies.rows import StudyRow
from tvsbayes.studies.study_job import StudyJob, study_row

ENGINES = ("serial", "processes", "dask")
SINGLE_THREADED = {
    "NPROC": "1",
    "PJRT_NPROC": "1",
    "JAX_CPU_ENABLE_ASYNC_DISPATCH": "false",
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
}
"""Read by XLA and OpenBLAS when a process starts: one thread per worker, and the same sums on every engine."""


def _in_worker(job: StudyJob, index: int) -> StudyRow:
    """`study_row` in a process of its own, which may keep compiled functions."""
    use_compilation_cache()
    return study_row(job, index)


class Executor(Protocol):
    """Where the rows of a study are made."""

    def submit(self, job: StudyJob, index: int) -> None:
        """Order one row."""

    def as_completed(self) -> Iterator[StudyRow]:
        """Rows in the order in which they are finished."""


class SerialExecutor:
    """This process, one row after the other."""

    def __init__(self) -> None:
        self._ordered: list[tuple[StudyJob, int]] = []

    def submit(self, job: StudyJob, index: int) -> None:
        """Order one row."""
        self._ordered.append((job, index))

    def as_completed(self) -> Iterator[StudyRow]:
        """Rows in order."""
        for job, index in self._ordered:
            yield study_row(job, index)


def _worker_died(what: str) -> InputError:
    remedy = "run the same command again: it goes on"
    return InputError("worker-died", f"{what}; finished rows are kept", remedy=remedy)


class ProcessExecutor:
    """Spawned processes of this machine, one thread each; JAX must not be forked."""

    def __init__(self, workers: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.pool = futures.ProcessPoolExecutor(workers, mp_context=context)
        self._ordered: list[futures.Future] = []

    def submit(self, job: StudyJob, index: int) -> None:
        """Order one row."""
        self._ordered.append(self.pool.submit(_in_worker, job, index))

    def as_completed(self) -> Iterator[StudyRow]:
        """Rows as they come.

        Raises:
            TvsError: a worker died; the rows so far are kept.
        """
        try:
            for future in futures.as_completed(self._ordered):
                yield future.result()
        except BrokenExecutor as error:
            raise _worker_died("a worker process of the study died (out of memory, or killed)") from error


class DaskExecutor:
    """A Dask cluster; the rows of a worker that dies are made again by another."""

    def __init__(self, client) -> None:
        self.client = client
        self._ordered: list = []

    def submit(self, job: StudyJob, index: int) -> None:
        """Order one row."""
        self._ordered.append(self.client.submit(_in_worker, job, index, pure=False, retries=3))

    def as_completed(self) -> Iterator[StudyRow]:
        """Rows as they come.

        Raises:
            TvsError: every worker that took a row died, or the scheduler is gone; the rows so far are kept.
        """
        from distributed import KilledWorker, as_completed

        try:
            for future in as_completed(self._ordered):
                yield future.result()
        except KilledWorker as error:
            raise _worker_died("every Dask worker that took a certain row died (out of memory, or killed)") from error
        except futures.CancelledError as error:
            raise _worker_died("the Dask scheduler is gone") from error


@contextmanager
def executor(engine: str, workers: int = 2, address: str | None = None) -> Iterator[Executor]:
    """An executor by its name.

    Args:
        engine: one of `ENGINES`.
        workers: processes; of a Dask cluster only where it is started here.
        address: scheduler of a Dask cluster that runs already.

    Raises:
        InputError: an engine that does not exist, or Dask without its extra.
    """
    if engine not in ENGINES:
        allowed = ", ".join(ENGINES)
        raise InputError(
            "engine", f"no engine {escaped(engine)}", column="--engine", allowed=allowed, remedy="name one"
        )
    if engine == "serial":
        yield SerialExecutor()
        return
    with _environment(SINGLE_THREADED):
        if engine == "processes":
            made = ProcessExecutor(workers)
            try:
                yield made
            finally:
                made.pool.shutdown(wait=True, cancel_futures=True)
            return
        try:
            from distributed import Client, LocalCluster
        except ImportError as error:
            remedy = "pip install 'tvsbayes[dask]', or use --engine processes"
            raise InputError(
                "no-dask", "the engine dask needs the extra dask", column="--engine", remedy=remedy
            ) from error
        if address is not None:
            with Client(address) as client:
                yield DaskExecutor(client)
            return
        local = {"n_workers": workers, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
        with LocalCluster(**local) as cluster, Client(cluster) as client:
            yield DaskExecutor(client)


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Environment variables for processes started inside."""
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
