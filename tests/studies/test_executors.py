"""Engines: unknown ones refused, dead workers reported with a remedy."""

from __future__ import annotations

import json
import os
import sys
from concurrent.futures import CancelledError, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from tvsbayes.cli.main import run
from tvsbayes.errors import InputError, TvsError
from tvsbayes.files.disk import shipped_data
from tvsbayes.studies.executors import LOOKED_AFTER_S, SINGLE_THREADED, made_rows


class KilledWorker(Exception):
    """Dask's name for a row whose workers died again and again."""


class CommClosedError(OSError):
    """Dask's name for a connection to the scheduler that ended."""


class Pool:
    """Makes row 5 and loses every other; records its requests."""

    def __init__(self, lost: BaseException):
        self.lost, self.threads, self.ended = lost, "", False
        self.workers: dict[str, object] = {}

    def submit(self, function, job, index):
        self.threads = os.environ["NPROC"]
        future: Future = Future()
        if index == 7:
            # Its worker has died, and no other takes it.
            return future
        if index == 5:
            future.set_result({"index": index})
        else:
            future.set_exception(self.lost)
        return future

    def shutdown(self, **_):
        self.ended = True


def pool_of(engine: str, lost: BaseException, monkeypatch) -> Pool:
    """What stands in for an engine; `distributed` is an extra."""
    pool = Pool(lost)
    if engine == "processes":
        monkeypatch.setattr("concurrent.futures.ProcessPoolExecutor", lambda *_, **options: pool)
        return pool

    class Client:
        def __init__(self, place):
            assert place == "tcp://scheduler:8786"

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pool.shutdown()

        def submit(self, *order, **options):
            return pool.submit(*order)

        def scheduler_info(self):
            return {"workers": pool.workers}

    def wait(pending, *, timeout, return_when):
        assert timeout == LOOKED_AFTER_S and return_when == "FIRST_COMPLETED"
        done = {future for future in pending if future.done()}
        if not done:
            raise TimeoutError
        return SimpleNamespace(done=done)

    members = {"Client": Client, "LocalCluster": nullcontext, "KilledWorker": KilledWorker, "wait": wait}
    monkeypatch.setitem(sys.modules, "distributed", SimpleNamespace(**members))
    monkeypatch.setitem(sys.modules, "distributed.comm", SimpleNamespace(CommClosedError=CommClosedError))
    return pool


def test_unknown_engines_are_refused(job):
    with pytest.raises(InputError, match="no engine threads"):
        next(made_rows(job, [0], "threads"))


@pytest.mark.parametrize(
    ("engine", "lost", "what"),
    [
        ("processes", BrokenProcessPool(), "a worker process"),
        ("dask", KilledWorker("row 3"), "every Dask worker"),
        ("dask", CancelledError("row 3"), "scheduler is gone"),
        ("dask", CommClosedError("row 3"), "scheduler is gone"),
    ],
)
def test_dead_workers_are_reported_with_a_remedy(job, monkeypatch, engine, lost, what):
    """Rows before are given out, workers have one thread, and what was started is ended."""
    pool = pool_of(engine, lost, monkeypatch)
    before = {name: os.environ.get(name) for name in SINGLE_THREADED}
    assert next(made_rows(job, [5], engine, 1, "tcp://scheduler:8786")) == {"index": 5}
    assert pool.threads == "1"
    with pytest.raises(TvsError, match=f"{what}.*finished rows are kept") as error:
        list(made_rows(job, [5, 3], engine, 1, "tcp://scheduler:8786"))
    assert error.value.code == "worker-died" and "run the same command again" in error.value.remedy
    assert pool.ended and {name: os.environ.get(name) for name in SINGLE_THREADED} == before


def test_a_cluster_without_workers_is_said(job, monkeypatch):
    """Dask itself would wait forever; rows made before are given out."""
    pool = pool_of("dask", KilledWorker("none"), monkeypatch)
    monkeypatch.setattr("tvsbayes.studies.executors.NO_WORKER_S", 0.0)
    rows = made_rows(job, [5, 7], "dask", 1, "tcp://scheduler:8786")
    assert next(rows) == {"index": 5}
    with pytest.raises(TvsError, match=r"had no worker.*finished rows are kept"):
        next(rows)
    assert pool.ended


@pytest.mark.parametrize("engine", ["processes", "dask"])
def test_rows_left_early_end_the_workers(job, monkeypatch, engine):
    """As Ctrl-C does, and an error where the row is kept."""
    pool = pool_of(engine, BrokenProcessPool(), monkeypatch)
    rows = made_rows(job, [5, 5], engine, 1, "tcp://scheduler:8786")
    next(rows)
    assert not pool.ended
    rows.close()
    assert pool.ended


def test_dask_without_its_extra_is_refused(job, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match="needs the extra dask"):
        next(made_rows(job, [0], "dask"))


@pytest.mark.parametrize(("engine", "code"), [("dask", "no-dask"), ("threads", "engine")])
def test_a_missing_engine_is_said_before_the_command_begins(tmp_path, monkeypatch, capsys, engine, code):
    monkeypatch.setitem(sys.modules, "distributed", None)
    rigs, rows = shipped_data() / "rigs" / "mounted", tmp_path / "rows.jsonl"
    plan = next(rigs.glob("*.csv"))
    arguments = [str(rigs / "rig.toml"), str(plan), "--engine", engine, "--rows", str(rows), "--json"]
    assert run(["study", *arguments]) == 2
    out, err = capsys.readouterr()
    assert json.loads(out)["error"]["code"] == code and "campaigns" not in err and not rows.exists()
