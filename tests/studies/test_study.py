"""Studies: rows that survive a kill, the same numbers on every engine, counts with their bounds."""

from __future__ import annotations

import json
import math
import sys
from concurrent.futures import CancelledError, Future
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tvsbayes.errors import InputError, NotConverged, TvsError
from tvsbayes.instrument.plan import PlanStep
from tvsbayes.model.headlines import QUANTITIES
from tvsbayes.planning.target import parse_target
from tvsbayes.report.command_text import study_text
from tvsbayes.studies.executors import DaskExecutor, ProcessExecutor, executor
from tvsbayes.studies.study import StudyRows, study, study_result
from tvsbayes.studies.study_job import StudyJob

TARGET = parse_target("u(worst) <= 1e-3 deg/step")


def sweep(sheets: tuple[str, ...] = ("d1", "d3")) -> tuple[PlanStep, ...]:
    """24 looks from both sides of both axes."""
    orders = [("home", 0, 0)]
    for sheet in sheets:
        orders.append(("place", None, None, sheet))
        for k in range(12):
            orders += [("move", (0, 100, 200, 100)[k % 4], (-60, 0, 60, 30, -30, -45)[k % 6]), ("look",)]
    return tuple(PlanStep(number, *order) for number, order in enumerate(orders))


@pytest.fixture
def job(mounted_rig) -> StudyJob:
    return StudyJob(mounted_rig, sweep(), TARGET, seed=7)


def invented(job: StudyJob, index: int) -> dict:
    """A row as `study_row` makes it, of a perfect estimator: errors and sds are known."""
    error = float(np.random.default_rng([3, index]).standard_normal())
    one = {"truth": 0.06, "value": 0.06 + 1e-4 * error, "sd": 1e-4, "interval95": [0.0, 1.0], "predicted_sd": 1e-4}
    row = {"design": job.key, "index": index, "seed": job.campaign_seed(index), "converged": True, "problems": []}
    pit = 0.5 * math.erfc(error / math.sqrt(2))
    return {
        **row,
        "headlines": {name: {**one, "pit": pit} for name in QUANTITIES},
        "target": 5e-4 if index % 4 else 2e-3,
        "seconds": 1.0,
    }


@pytest.fixture
def quick(monkeypatch):
    """Rows without simulation and fit; the list of those made."""
    made = []

    def row(job, index):
        made.append(index)
        return invented(job, index)

    monkeypatch.setattr("tvsbayes.studies.study_job.study_row", row)
    monkeypatch.setattr("tvsbayes.studies.executors.study_row", row)
    return made


def test_a_study_goes_on_where_it_was_killed(job, quick, tmp_path):
    """The last row is torn, as a kill in the middle of a write leaves it: it is made again, the others are not."""
    path = tmp_path / "rows.jsonl"
    whole = study(job, 9, StudyRows(path))
    data = path.read_bytes()
    assert data.count(b"\n") == 9
    cut = data[: data.rfind(b"\n", 0, -1) + 40]
    path.write_bytes(cut)
    quick.clear()
    again = StudyRows(path)
    assert again.torn == 39
    assert study(job, 9, again) == whole
    assert quick == [8]
    assert path.read_bytes() == data
    quick.clear()
    assert study(job, 9, StudyRows(path)) == whole and quick == []


def test_one_file_keeps_designs_apart(job, quick, tmp_path, mounted_rig, monkeypatch):
    path = tmp_path / "rows.jsonl"
    study(job, 3, StudyRows(path))
    others = (
        replace(job, seed=8),
        replace(job, aperture=True),
        replace(job, steps=sweep(("d1",))),
        replace(job, target=parse_target("u(left) <= 1e-3 deg/step")),
        replace(job, rig=replace(mounted_rig, sheets_mm={**mounted_rig.sheets_mm, "d1": 176.0})),
        replace(job, rig=replace(mounted_rig, cameras={**mounted_rig.cameras, "spot_sd_px": 0.1})),
        replace(
            job, rig=replace(mounted_rig, truth={**mounted_rig.truth, "pixel_scale": mounted_rig.truth["focal_scale"]})
        ),
    )
    assert len({job.key, *(other.key for other in others)}) == 1 + len(others)
    for other in others:
        assert StudyRows(path).of(other) == {}
    # Rows of another release answer another question.
    monkeypatch.setattr("tvsbayes.studies.study_job.version", lambda _package: "0.0.1")
    assert StudyRows(path).of(replace(job)) == {}
    assert sorted(StudyRows(path).of(job)) == [0, 1, 2]


def test_seeds_do_not_depend_on_the_number_of_campaigns(job):
    seeds = [job.campaign_seed(i) for i in range(200)]
    assert len(set(seeds)) == 200 and all(0 <= s < 2**63 for s in seeds)
    assert replace(job, seed=8).campaign_seed(0) != seeds[0]


@pytest.mark.parametrize("line", ["{", "[]", "1", '{"format": "tvsbayes-study/1"}', '{"a": 1}'])
def test_a_foreign_file_is_refused_with_its_line(job, quick, tmp_path, line):
    path = tmp_path / "rows.jsonl"
    study(job, 2, StudyRows(path))
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(InputError, match="line 3 is no row"):
        StudyRows(path)


def test_counts_of_a_perfect_estimator_are_within_bounds_and_of_a_boastful_one_outside(job):
    rows = [invented(job, i) for i in range(400)]
    result = study_result(job, rows)
    left = result.headlines["left"]
    assert left.within and all(h.within for h in result.headlines.values())
    assert left.rms_z == pytest.approx(left.rms_predicted)
    assert left.predicted_over_rms == pytest.approx(1 / left.rms_z)
    assert result.assurance == 0.75
    low, high = result.assurance_interval95
    assert low < 0.75 < high and high - low == pytest.approx(4 * math.sqrt(0.75 * 0.25 / 400), rel=0.1)
    boastful = [json.loads(json.dumps(row)) for row in rows]
    for row in boastful:
        for h in row["headlines"].values():
            h["sd"] *= 0.8
    assert not study_result(job, boastful).headlines["left"].within
    assert "reported as met by 75.0 %" in study_text(result)
    json.dumps(result.as_json(), allow_nan=False)


def test_what_the_priors_hold_fixed_is_not_counted(job):
    """One ratio per axis: the contrasts are 0 with sd 0, and 0 / 0 is no RMS."""
    rows = [invented(job, i) for i in range(40)]
    for row in rows:
        for name in ("contrast.pan", "contrast.tilt"):
            fixed = {"truth": 0.0, "value": 0.0, "sd": 0.0, "interval95": [0.0, 0.0], "pit": 0.0, "predicted_sd": 0.0}
            row["headlines"][name] = fixed
    result = study_result(job, rows)
    assert set(QUANTITIES) - set(result.headlines) == {"contrast.pan", "contrast.tilt"}
    json.dumps(result.as_json(), allow_nan=False)
    assert "contrast" not in study_text(result)


def test_failures_count_against_the_assurance(job):
    rows = [invented(job, i) for i in (1, 2, 3)]
    failed = {"design": job.key, "index": 4, "converged": False, "problems": ["did not settle"], "seconds": 1.0}
    result = study_result(job, [*rows, failed])
    assert (result.campaigns, result.converged, result.assurance) == (4, 3, 0.75)
    assert result.problems == ("campaign 4: did not settle",)
    with pytest.raises(NotConverged, match="did not settle"):
        study_result(job, [failed])


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


def test_rows_that_cannot_be_written_are_refused_before_the_first_fit(tmp_path):
    with pytest.raises(InputError) as error:
        StudyRows(tmp_path / "no such folder" / "rows.jsonl")
    StudyRows(tmp_path / "rows.jsonl")
    assert list(tmp_path.iterdir()) == [], "nothing is written before there is a row"
    assert error.value.code == "write" and "--rows" in error.value.remedy


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


@pytest.mark.slow
def test_numbers_are_the_same_on_every_engine(job, tmp_path):
    """Serial in this process with all its threads, two spawned single-threaded processes; resumed in between."""
    serial = StudyRows(tmp_path / "serial.jsonl")
    study(job, 4, serial, engine="serial")
    processes = StudyRows(tmp_path / "processes.jsonl")
    study(job, 2, processes, engine="serial")
    study(job, 4, StudyRows(tmp_path / "processes.jsonl"), engine="processes", workers=2)

    def numbers(path):
        return {i: {k: v for k, v in r.items() if k != "seconds"} for i, r in StudyRows(path).of(job).items()}

    one, other = numbers(tmp_path / "serial.jsonl"), numbers(tmp_path / "processes.jsonl")
    assert one == other and sorted(one) == [0, 1, 2, 3]
    assert all(row["converged"] for row in one.values())
