"""Studies: the twin runs a plan many times, every campaign is fitted, and coverage, power and assurance are counted.

Stored rows are not computed again, so that an interrupted study continues. Its numbers do not depend on the engine.
Headlines in deg/step, deg and mm.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import closing

import numpy as np

from tvsbayes.display import Shown, View
from tvsbayes.errors import NotConverged
from tvsbayes.instrument.parameters import TARGETS
from tvsbayes.planning.target import Target
from tvsbayes.progress import Job, Show
from tvsbayes.results.records import Record
from tvsbayes.statistics.chances import LEVELS, binomial_bounds, rms_bounds, share_interval95
from tvsbayes.statistics.intervals import NORMAL_95
from tvsbayes.studies.executors import made_rows, require_engine
from tvsbayes.studies.rows import StudyRow, StudyRows
from tvsbayes.studies.study_job import StudyJob

CAMPAIGNS = "campaigns"


class HeadlineStudy(Record, frozen=True, kw_only=True):
    """Results of one headline over the campaigns of a study.

    Attributes:
        coverage: share of intervals that hold the truth, by level; `bounds`: bounds of a correct share.
        rms_z: RMS of (estimate - truth) / reported sd; `rms_bounds`: its bounds.
        rms_predicted: the same with the sd that the planner predicted at each truth.
        predicted_over_rms: root mean square of the predicted sd over RMS of (estimate - truth).
        power: share of campaigns whose estimate differs from its null (0, or the stated ratio) by 1.96 sd.
        sd: median reported sd.
        within: whether coverage and z are within their bounds.
    """

    coverage: dict[str, float]
    bounds: dict[str, tuple[float, float]]
    rms_z: float
    rms_predicted: float
    rms_bounds: tuple[float, float]
    predicted_over_rms: float
    power: float
    sd: float
    within: bool


class StudyResult(Shown, Record, frozen=True, kw_only=True):
    """Measured coverage, power and assurance of a plan.

    Attributes:
        design: hash of the design.
        estimator: estimator of the rows, "importance" or "laplace".
        asked, campaigns, converged: number of campaigns asked for, of those that ran, and of converged fits.
        assurance, assurance_interval95: share of ALL campaigns whose fit reports the target as met (Clopper-Pearson).
        reported: 5, 50 and 95 % quantiles of the reported value.
        seconds: median time of a row.
        headlines: results by name; one fixed by the priors is not estimated and left out.
        target: target of the plan.
        problems: failures, in words.
    """

    design: str
    estimator: str
    asked: int
    campaigns: int
    converged: int
    assurance: float
    assurance_interval95: tuple[float, float]
    reported: tuple[float, float, float] | None
    seconds: float
    headlines: dict[str, HeadlineStudy]
    target: Target
    problems: tuple[str, ...]

    def shown(self) -> View:
        """Show coverage and power by quantity."""
        rows = [
            (name, h.sd, h.rms_z, h.rms_predicted, 100 * h.coverage["95"], h.power)
            for name, h in self.headlines.items()
        ]
        columns = ("quantity", "median sd", "RMS z", "predicted", "inside 95 %, %", "power")
        title = f"StudyResult of {self.campaigns} campaigns: {100 * self.assurance:.1f} % meet {self.target.text}"
        return View(title, columns, rows)


def study_result(job: StudyJob, rows: Sequence[StudyRow], asked: int | None = None) -> StudyResult:
    """Evaluate the rows of a study, all that were asked for by default.

    Raises:
        NotConverged: not one fit ended well.
    """
    good = [row for row in rows if row.converged]
    problems = tuple(f"campaign {row.index}: {'; '.join(row.problems)}" for row in rows if not row.converged)
    if not good:
        message = "no fit of the study converged" + (f"; {problems[0]}" if problems else "")
        raise NotConverged("not-converged", message, remedy="check the plan with `tvsbayes check RIG PLAN`")
    n = len(good)
    least_rms, most_rms = rms_bounds(n)
    bounds = {f"{100 * level:g}": binomial_bounds(n, level) for level in LEVELS}
    headlines = {}
    for name, quantity in TARGETS.items():
        entries = [row.headlines[name] for row in good]
        if all(e.interval95[0] == e.interval95[1] for e in entries):
            continue
        truth, value, sd, pit, predicted = np.array(
            [(e.truth, e.value, e.sd, e.pit, e.predicted_sd) for e in entries]
        ).T
        error = value - truth
        null = job.rig.table.priors[quantity.stated].value if quantity.stated else 0.0
        coverage = {f"{100 * level:g}": float(np.mean(np.abs(pit - 0.5) < level / 2)) for level in LEVELS}
        covered = all(low <= coverage[level] <= high for level, (low, high) in bounds.items())
        rms_z = float(np.sqrt(np.mean((error / sd) ** 2)))
        headlines[name] = HeadlineStudy(
            coverage=coverage,
            bounds=bounds,
            rms_z=rms_z,
            rms_predicted=float(np.sqrt(np.mean((error / predicted) ** 2))),
            rms_bounds=(least_rms, most_rms),
            predicted_over_rms=float(np.sqrt(np.mean(predicted**2) / np.mean(error**2))),
            power=float(np.mean(np.abs(value - null) > NORMAL_95 * sd)),
            sd=float(np.median(sd)),
            within=covered and least_rms <= rms_z <= most_rms,
        )
    reported = np.array([row.target for row in good if row.target is not None])
    hits = int(np.sum(reported <= job.target.limit))
    low, middle, high = np.quantile(reported, [0.05, 0.5, 0.95]) if len(reported) else (math.nan,) * 3
    return StudyResult(
        design=job.key,
        estimator=job.estimator,
        asked=len(rows) if asked is None else asked,
        campaigns=len(rows),
        converged=n,
        headlines=headlines,
        target=job.target,
        # A failed fit does not meet the target.
        assurance=hits / len(rows),
        assurance_interval95=share_interval95(hits, len(rows)),
        reported=(float(low), float(middle), float(high)) if len(reported) else None,
        seconds=float(np.median([row.seconds for row in rows])),
        problems=problems,
    )


def study(
    job: StudyJob,
    count: int,
    rows: StudyRows,
    *,
    engine: str = "serial",
    workers: int = 2,
    address: str | None = None,
    max_minutes: float | None = None,
    progress: Show | None = None,
) -> StudyResult:
    """Compute the missing rows among 0 ... count - 1 of a study, and evaluate those that there are.

    Args:
        job: what is studied.
        count: number of campaigns.
        rows: stored rows, which are not computed again.
        engine: where rows are computed; the numbers are the same on each.
        workers: number of processes.
        address: address of a Dask scheduler.
        max_minutes: no row is begun after so long; at least one is made.
        progress: called with the share that is done after every row.

    Raises:
        InputError: no such engine, or Dask is not installed.
        NotConverged: not one fit ended well.
    """
    require_engine(engine)
    done = rows.of(job.key)
    missing = [index for index in range(count) if index not in done]
    end_s = math.inf if max_minutes is None else time.monotonic() + 60 * max_minutes
    with Job({CAMPAIGNS: 1.0}, progress) as work:
        if missing:
            work.at(0.0, f"{count - len(missing)} of {count}")
            with closing(made_rows(job, missing, engine, min(workers, len(missing)), address)) as running:
                for made, row in enumerate(running, 1):
                    rows.append(row)
                    work.at(made / len(missing), f"{count - len(missing) + made} of {count}")
                    if time.monotonic() >= end_s:
                        break
        every = rows.of(job.key)
        return study_result(job, [every[index] for index in range(count) if index in every], count)
