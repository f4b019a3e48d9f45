"""Engines: unknown ones refused, dead workers told with what to do."""

from __future__ import annotations

import sys
from concurrent.futures import CancelledError, Future
from types import SimpleNamespace

import pytest

from tvsbayes.errors import InputError, TvsError
from tvsbayes.studies.executors import DaskExecutor, ProcessExecutor, executor


def test_unknown_engines_are_refused(job):
    with pytest.raises(InputError, match="no engine threads"), executor("threads"):
        pass


class KilledWorker(Exception):
    """Dask's name for a row whose workers died again and again."""


@pytest.mark.parametrize(
    ("raised", "what"), [(KilledWorker("row 3"), "worker"), (CancelledError("row 3"), "scheduler is gone")]
)
def test_what_dask_lost_is_said_without_a_traceback(job, monkeypatch, raised, what):
    """`distributed` is an extra: a module of its names stands in."""

    class Client:
        def submit(self, function, job, index, **options):
            return index

    def as_completed(ordered):
        done = Future()
        done.set_result({"index": ordered[0]})
        yield done
        lost = Future()
        lost.set_exception(raised)
        yield lost

    stand_in = SimpleNamespace(KilledWorker=KilledWorker, as_completed=as_completed)
    monkeypatch.setitem(sys.modules, "distributed", stand_in)
    made = DaskExecutor(Client())
    made.submit(job, 5)
    rows = made.as_completed()
    assert next(rows) == {"index": 5}
    with pytest.raises(TvsError, match=f"{what}.*finished rows are kept") as error:
        next(rows)
    assert error.value.code == "worker-died" and "goes on" in error.value.remedy


def test_a_dead_worker_is_told_with_what_to_do(job):
    """A pool whose process has died says so in our words."""
    from concurrent.futures.process import BrokenProcessPool

    class Broken:
        def submit(self, *_):
            future = Future()
            future.set_exception(BrokenProcessPool())
            return future

        def shutdown(self, **_):
            pass

    made = ProcessExecutor(1)
    made.pool.shutdown()
    made.pool = Broken()
    made.submit(job, 0)
    with pytest.raises(TvsError, match="finished rows are kept") as told:
        list(made.as_completed())
    assert "run the same command again" in told.value.remedy
