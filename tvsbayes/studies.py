"""Studies: the twin runs a plan many times, every campaign is fitted, coverage, power and assurance are counted.

Rows are made by an executor (this process, spawned processes, a Dask cluster) and kept in a file of JSON lines, keyed
by the hash of everything that decides them and the campaign's number: a study goes on where it was interrupted, and
its numbers do not depend on the engine. Units are those of DESIGN 8.
"""

from __future__ import annotations

import hashlib
import json
import math
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent import futures
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import BinaryIO, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from tvsbayes.calibration import NORMAL_95
from tvsbayes.campaign import (
    PlanStep,
)
from tvsbayes.classic import DIRECTIONS
from tvsbayes.design import (
    QUANTITIES,
    Knowledge,
    Target,
    covariance_of,
    headlines,
    information_of,
    prior_knowledge,
    sensitivity,
)
from tvsbayes.files import InputError, NotConverged, TvsError, escaped, read_bytes, refusal
from tvsbayes.joint import JointFit, fit
from tvsbayes.model import (
    INDEX,
    half_normal,
    half_normal_slope,
    use_compilation_cache,
)
from tvsbayes.planning import truth_in
from tvsbayes.rigs import Rig, rig_table_toml, stereo_bytes
from tvsbayes.simulation import (
    effective_deg_per_step,
    effective_mirror_offset_mm,
    simulate,
)

STUDY_FORMAT = "tvsbayes-study/1"
ROWS_BYTES_MAX = 128 * 1024 * 1024
ENGINES = ("serial", "processes", "dask")
ITERATIONS = 6
"""Of slope and width of a backlash: the width's error falls at least threefold each."""
LEVELS = (0.50, 0.68, 0.90, 0.95)
BOUND = 1e-4
"""Two-sided probability with which an honest study leaves its bounds."""
SINGLE_THREADED = {
    "NPROC": "1",
    "PJRT_NPROC": "1",
    "JAX_CPU_ENABLE_ASYNC_DISPATCH": "false",
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
}
"""Read by XLA and OpenBLAS when a process starts: one thread per worker, and the same sums on every engine."""


@dataclass(frozen=True)
class StudyJob:
    """What a worker needs to make any row of a study."""

    rig: Rig
    steps: tuple[PlanStep, ...]
    target: Target
    seed: int = 0
    aperture: bool = False

    @cached_property
    def key(self) -> str:
        """SHA-256 of everything that decides the rows: program, rig, truth, cameras, plan, target, seed, reading."""
        rig = self.rig
        parts = [
            STUDY_FORMAT,
            version("tvsbayes"),
            rig_table_toml(rig.table),
            json.dumps({name: [p.value, p.u, p.distribution] for name, p in sorted(rig.truth.items())}),
            stereo_bytes(rig.stereo).decode(),
            json.dumps([sorted(rig.sheets_mm.items()), rig.cameras["spot_sd_px"], sorted(rig.costs_s.items())]),
            json.dumps([[s.action, s.pan_steps, s.tilt_steps, s.target, s.experiment, s.point] for s in self.steps]),
            json.dumps([self.target.text, self.seed, self.aperture]),
        ]
        return hashlib.sha256("\0".join(parts).encode()).hexdigest()

    def campaign_seed(self, index: int) -> int:
        """Seed of campaign `index`: independent of order, engine and number of campaigns."""
        high, low = np.random.SeedSequence([self.seed, index]).generate_state(2)
        return (int(high) >> 10) << 32 | int(low)


def true_headlines(parameters: Mapping[str, float], pose_rad: np.ndarray) -> np.ndarray:
    """`QUANTITIES` of a true rig by the twin's formulas, at a pose."""
    pose = tuple(np.degrees(pose_rad))
    ratio = effective_deg_per_step(parameters, pose)
    return np.array(
        [
            *(ratio[d] for d in DIRECTIONS),
            ratio["left"] - ratio["right"],
            ratio["up"] - ratio["down"],
            parameters["backlash_deg.pan"],
            parameters["backlash_deg.tilt"],
            effective_mirror_offset_mm(parameters, pose),
        ]
    )


def study_row(job: StudyJob, index: int) -> dict[str, object]:
    """Simulate one campaign, fit it (Laplace), compare with the truth and with what the planner predicted there.

    Whatever fails is a row as well: failures are counted, never dropped.
    """
    start = time.perf_counter()
    seed = job.campaign_seed(index)
    run = simulate(job.rig, job.steps, seed, aperture=job.aperture)
    row: dict[str, object] = {"design": job.key, "index": index, "seed": seed, "converged": False}
    row["unseen"] = sum(spot.status != "ok" for spot in run.campaign.spots)
    try:
        result = fit(run.campaign)
    except TvsError as error:
        return {**row, "problems": [error.message], "seconds": time.perf_counter() - start}
    row |= {"converged": result.converged, "problems": list(result.problems)}
    knowledge = prior_knowledge(job.rig)
    truth = truth_in(knowledge, run.truth.parameters, run.truth.stereo.vector)
    pose = result.reference_pose_rad
    information = information_of(job.steps, knowledge, aperture=job.aperture, z=truth.z, space=truth.space)
    with jax.enable_x64(True):
        at_truth = headlines(jnp.asarray(truth.z), truth.space, jnp.asarray(pose))
        at_mode = headlines(jnp.asarray(result.z), result.space, jnp.asarray(pose))
    gradient = np.asarray(at_truth.gradient)
    predicted_sd = predicted_sds(knowledge, information.fisher, gradient, truth.z)
    true = true_headlines(run.truth.parameters, pose)
    draws = _headline_draws(result)
    value, sd = np.asarray(at_mode.value), draws.std(axis=0)
    low, high = np.quantile(draws, [0.025, 0.975], axis=0)
    row["headlines"] = {
        name: {
            "truth": float(true[k]),
            "value": float(value[k]),
            "sd": float(sd[k]),
            "interval95": [float(low[k]), float(high[k])],
            "pit": float(np.mean(draws[:, k] < true[k])),
            "predicted_sd": float(predicted_sd[k]),
        }
        for k, name in enumerate(QUANTITIES)
    }
    try:
        at = sensitivity(job.target, result.z, result.space, job.rig.table, pose)
        row["target"] = at.value(result.covariance, job.target.factor)
    except InputError:
        row["target"] = None
    return {**row, "seconds": time.perf_counter() - start}


def half_normal_sd(mean: float, sd: float) -> float:
    """Sd of a half-normal of scale 1 whose coordinate is N(mean, sd^2), by Gauss-Hermite quadrature.

    Near no backlash the map from coordinate to backlash is flat on one side: a slope there would promise a certainty
    that no fit has.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(48)
    values = half_normal(mean + sd * nodes)
    weights = weights / weights.sum()
    centre = weights @ values
    return float(np.sqrt(weights @ (values - centre) ** 2))


def predicted_sds(knowledge: Knowledge, fisher: np.ndarray, gradient: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Sd of quantities at a truth, the backlashes linearised over the width of their posteriors, not at a point.

    Near no backlash its slope against its coordinate vanishes: linearised there, a ratio would seem free of the
    exchange with it. The slope is taken as sd(backlash) / sd(coordinate), the posterior's width found by iteration.

    Args:
        knowledge: before the plan.
        fisher: information of the plan at the truth, shape (p, p).
        gradient: d(quantity)/d(coordinates) there, shape (q, p).
        z: coordinates of the truth, shape (p,).

    Returns:
        Shape (q,).
    """
    columns = [INDEX[f"backlash_deg.{axis}"] for axis in ("pan", "tilt")]
    slope = half_normal_slope(z[columns])
    scale, covariance = np.ones(len(z)), np.eye(len(z))
    for _ in range(ITERATIONS):
        for column, at in zip(columns, slope, strict=True):
            width = math.sqrt(covariance[column, column])
            scale[column] = half_normal_sd(z[column], width) / width / at
        covariance = covariance_of(knowledge.precision + fisher * np.outer(scale, scale))
    return np.sqrt(np.einsum("qi,ij,qj->q", gradient * scale, covariance, gradient * scale))


def _headline_draws(result: JointFit) -> np.ndarray:
    """`QUANTITIES` of the Laplace draws, shape (draws, 9)."""
    ratio, physical = np.asarray(result.draws.effective_deg_per_step), np.asarray(result.draws.physical)
    return np.column_stack(
        [
            ratio,
            ratio[:, 0] - ratio[:, 1],
            ratio[:, 2] - ratio[:, 3],
            physical[:, INDEX["backlash_deg.pan"]],
            physical[:, INDEX["backlash_deg.tilt"]],
            result.draws.effective_mirror_offset_mm,
        ]
    )


def _in_worker(job: StudyJob, index: int) -> dict[str, object]:
    """`study_row` in a process of its own, which may keep compiled functions."""
    use_compilation_cache()
    return study_row(job, index)


class Executor(Protocol):
    """Where the rows of a study are made."""

    def submit(self, job: StudyJob, index: int) -> None:
        """Order one row."""

    def as_completed(self) -> Iterator[dict[str, object]]:
        """Rows in the order in which they are finished."""


class SerialExecutor:
    """This process, one row after the other."""

    def __init__(self) -> None:
        self._ordered: list[tuple[StudyJob, int]] = []

    def submit(self, job: StudyJob, index: int) -> None:
        """Order one row."""
        self._ordered.append((job, index))

    def as_completed(self) -> Iterator[dict[str, object]]:
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

    def as_completed(self) -> Iterator[dict[str, object]]:
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

    def as_completed(self) -> Iterator[dict[str, object]]:
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


class StudyRows:
    """Rows of studies in a file of JSON lines: appended one by one, each on disk before the next.

    A process that is killed while it writes leaves a torn last line; it is cut off when the file is opened again.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        data = read_bytes(self.path, ROWS_BYTES_MAX) if self.path.exists() else b""
        whole = data[: data.rfind(b"\n") + 1]
        self.rows: dict[tuple[str, int], dict[str, object]] = {}
        for number, line in enumerate(whole.splitlines(), 1):
            row = self._row(line, number)
            self.rows[row["design"], row["index"]] = row
        self.torn = len(data) - len(whole)
        # Before the first campaign is fitted, not after.
        if not os.access(self.path if self.path.exists() else self.path.parent, os.W_OK):
            raise self._unwritable("no right to write, or no such folder")

    def _unwritable(self, found: str) -> InputError:
        allowed, remedy = "a file that can be written", "name another with --rows"
        return refusal("write", file=escaped(str(self.path), 200), found=found, allowed=allowed, remedy=remedy)

    @contextmanager
    def _open(self) -> Iterator[BinaryIO]:
        """The file, for reading and writing; made where there is none."""
        try:
            with self.path.open("r+b" if self.path.exists() else "w+b") as file:
                yield file
        except OSError as error:
            raise self._unwritable(escaped(error.strerror or str(error))) from error

    def _row(self, line: bytes, number: int) -> dict[str, object]:
        try:
            row = json.loads(line)
            if row["format"] == STUDY_FORMAT and isinstance(row["design"], str) and isinstance(row["index"], int):
                return row
        except (ValueError, KeyError, TypeError, RecursionError):
            pass
        raise InputError(
            "study-row",
            f"{escaped(self.path.name)} line {number} is no row of a study",
            file=escaped(self.path.name),
            line=number,
            allowed=f"lines written by `tvsbayes study` ({STUDY_FORMAT})",
            remedy="name another file with --rows",
        )

    def of(self, job: StudyJob) -> dict[int, dict[str, object]]:
        """Rows of one design by index."""
        return {index: row for (design, index), row in self.rows.items() if design == job.key}

    def append(self, row: dict[str, object]) -> None:
        """Add a row and wait until the disk has it."""
        row = {"format": STUDY_FORMAT, **row}
        line = json.dumps(row, allow_nan=False).encode() + b"\n"
        with self._open() as file:
            if self.torn:
                file.truncate(self.path.stat().st_size - self.torn)
                self.torn = 0
            file.seek(0, os.SEEK_END)
            file.write(line)
            file.flush()
            os.fsync(file.fileno())
        self.rows[row["design"], row["index"]] = row


@dataclass(frozen=True)
class HeadlineStudy:
    """How one headline fared over the campaigns of a study.

    Attributes:
        coverage: share of intervals that hold the truth, by level; `bounds`: what an honest share stays within.
        rms_z: RMS of (estimate - truth) / reported sd; `rms_bounds` likewise.
        rms_predicted: the same over the sd that the planner predicted at each truth.
        predicted_over_rms: root mean square of the predicted sd over RMS of (estimate - truth).
        power: share of campaigns whose estimate differs from its null (0, or the stated ratio) by 1.96 sd.
        sd: median reported sd.
    """

    coverage: dict[str, float]
    bounds: dict[str, tuple[float, float]]
    rms_z: float
    rms_predicted: float
    rms_bounds: tuple[float, float]
    predicted_over_rms: float
    power: float
    sd: float

    @property
    def within(self) -> bool:
        """All of coverage and z inside their bounds."""
        low, high = self.rms_bounds
        covered = all(a <= self.coverage[level] <= b for level, (a, b) in self.bounds.items())
        return covered and low <= self.rms_z <= high


@dataclass(frozen=True)
class StudyResult:
    """Coverage, power and assurance of a plan, measured.

    Attributes:
        design: its hash.
        campaigns, converged: how many were simulated, and how many fits ended well.
        headlines: by name; one that the priors hold fixed is not estimated and left out.
        target: what was wanted.
        assurance, assurance_interval95: share of ALL campaigns whose fit reports the target as met (Clopper-Pearson).
        reported: 5, 50 and 95 % quantiles of the reported value.
        seconds: median time of a row.
        problems: failures, in words.
    """

    design: str
    campaigns: int
    converged: int
    headlines: dict[str, HeadlineStudy]
    target: Target
    assurance: float
    assurance_interval95: tuple[float, float]
    reported: tuple[float, float, float] | None
    seconds: float
    problems: tuple[str, ...]

    def as_json(self) -> dict[str, object]:
        """The document of `study --json`."""
        document = {key: value for key, value in vars(self).items() if key not in ("headlines", "target", "problems")}
        document["headlines"] = {
            name: {**vars(h), "bounds": {k: list(v) for k, v in h.bounds.items()}, "within": h.within}
            for name, h in self.headlines.items()
        }
        return {**document, "target": self.target.as_json(), "problems": list(self.problems)}


def binomial_bounds(count: int, probability: float) -> tuple[float, float]:
    """Share that an event of this probability keeps within in `count` trials, but for `BOUND`."""
    low, high = stats.binom.ppf(BOUND / 2, count, probability), stats.binom.isf(BOUND / 2, count, probability)
    return float(low) / count, float(high) / count


def rms_bounds(count: int) -> tuple[float, float]:
    """RMS that `count` standard normal numbers keep within, but for `BOUND`."""
    low, high = np.sqrt(stats.chi2.ppf([BOUND / 2, 1 - BOUND / 2], count) / count)
    return float(low), float(high)


def share_interval95(hits: int, count: int) -> tuple[float, float]:
    """Clopper and Pearson's interval of a probability."""
    low = 0.0 if hits == 0 else float(stats.beta.ppf(0.025, hits, count - hits + 1))
    high = 1.0 if hits == count else float(stats.beta.ppf(0.975, hits + 1, count - hits))
    return low, high


def study_result(job: StudyJob, rows: Sequence[Mapping[str, object]]) -> StudyResult:
    """Count rows of a study.

    Raises:
        NotConverged: not one fit ended well.
    """
    good = [row for row in rows if row["converged"]]
    problems = tuple(f"campaign {r['index']}: {'; '.join(r['problems'])}" for r in rows if not r["converged"])
    if not good:
        message = "no fit of the study converged" + (f"; {problems[0]}" if problems else "")
        raise NotConverged("not-converged", message, remedy="check the plan with `tvsbayes check RIG PLAN`")
    n = len(good)
    stated = {d: job.rig.table.priors[f"degrees_per_step.{a}"].value for a, d in _axes_of_directions()}
    found = {}
    for name in QUANTITIES:
        entries = [row["headlines"][name] for row in good]
        if all(e["interval95"][0] == e["interval95"][1] for e in entries):
            continue
        truth, value, sd, pit, predicted = (
            np.array([e[key] for e in entries]) for key in ("truth", "value", "sd", "pit", "predicted_sd")
        )
        error = value - truth
        null = stated.get(name, job.rig.table.priors["mirror_offset_mm"].value if name == "mirror_offset" else 0.0)
        found[name] = HeadlineStudy(
            coverage={f"{100 * level:g}": float(np.mean(np.abs(pit - 0.5) < level / 2)) for level in LEVELS},
            bounds={f"{100 * level:g}": binomial_bounds(n, level) for level in LEVELS},
            rms_z=float(np.sqrt(np.mean((error / sd) ** 2))),
            rms_predicted=float(np.sqrt(np.mean((error / predicted) ** 2))),
            rms_bounds=rms_bounds(n),
            predicted_over_rms=float(np.sqrt(np.mean(predicted**2) / np.mean(error**2))),
            power=float(np.mean(np.abs(value - null) > NORMAL_95 * sd)),
            sd=float(np.median(sd)),
        )
    reported = np.array([row["target"] for row in good if row["target"] is not None])
    hits = int(np.sum(reported <= job.target.limit))
    low, middle, high = np.quantile(reported, [0.05, 0.5, 0.95]) if len(reported) else (math.nan,) * 3
    return StudyResult(
        design=job.key,
        campaigns=len(rows),
        converged=n,
        headlines=found,
        target=job.target,
        # A fit that failed met nothing.
        assurance=hits / len(rows),
        assurance_interval95=share_interval95(hits, len(rows)),
        reported=(float(low), float(middle), float(high)) if len(reported) else None,
        seconds=float(np.median([row["seconds"] for row in rows])),
        problems=problems,
    )


def _axes_of_directions() -> Iterator[tuple[str, str]]:
    return ((("pan", "tilt")[k // 2], d) for k, d in enumerate(DIRECTIONS))


def study(
    job: StudyJob,
    count: int,
    rows: StudyRows,
    *,
    engine: str = "serial",
    workers: int = 2,
    address: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> StudyResult:
    """Make the rows 0 ... count - 1 of a study that are not there yet, and count them all.

    Args:
        job: what is studied.
        count: number of campaigns.
        rows: where rows are kept; what is there is not made again.
        engine: where they are made; the numbers are the same on each.
        workers: processes.
        address: of a Dask scheduler.
        progress: called with rows done and rows wanted.

    Raises:
        InputError: no such engine.
        NotConverged: not one fit ended well.
    """
    done = rows.of(job)
    missing = [index for index in range(count) if index not in done]
    if missing:
        with executor(engine, min(workers, len(missing)), address) as running:
            for index in missing:
                running.submit(job, index)
            for finished, row in enumerate(running.as_completed(), count - len(missing) + 1):
                rows.append(row)
                if progress is not None:
                    progress(finished, count)
    made = rows.of(job)
    return study_result(job, [made[index] for index in range(count)])


def study_text(result: StudyResult) -> str:
    """A study for people."""
    n, t = result.converged, result.target
    low, high = rms_bounds(n)
    lines = [
        f"{result.campaigns} simulated campaigns, {n} fits converged; {result.seconds:.1f} s each",
        "headline        median sd  RMS z  predicted  " + "  ".join(f"{100 * x:3.0f} %" for x in LEVELS) + "  power",
        f"bounds at {BOUND:g}        {low:.2f}-{high:.2f}".ljust(48)
        + "  ".join("{:.0f}-{:.0f}".format(*(100 * b for b in binomial_bounds(n, x))) for x in LEVELS),
    ]
    for name, h in result.headlines.items():
        shares = "  ".join(f"{100 * h.coverage[f'{100 * x:g}']:5.1f}" for x in LEVELS)
        numbers = f"{h.sd:9.3g}  {h.rms_z:5.2f}  {h.rms_predicted:9.2f}  {shares}  {h.power:5.2f}"
        lines.append(f"{name:14}  {numbers}  {'within' if h.within else 'OUTSIDE'}")
    a, b = result.assurance_interval95
    share = f"{100 * result.assurance:.1f} % of fits ({100 * a:.1f} to {100 * b:.1f} %)"
    lines.append(f"{t.text}: reported as met by {share}")
    if result.reported is not None:
        lines.append("reported: {:.3g}, {:.3g}, {:.3g}".format(*result.reported) + f" {t.unit} (5, 50, 95 % of fits)")
    lines += [f"failed: {p}" for p in result.problems[:5]]
    return "\n".join(lines)
