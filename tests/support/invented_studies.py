"""A study without simulation and fit: its job, and rows of a perfect estimator.

A plugin of tests/conftest.py, so that what needs JAX is imported where it is used: fixtures by name.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.commands import steps

from tvsbayes.instrument.plan import PlanStep
from tvsbayes.studies.rows import HeadlineRow, StudyRow

if TYPE_CHECKING:
    from tvsbayes.studies.study_job import StudyJob


def sweep(sheets: tuple[str, ...] = ("d1", "d3")) -> tuple[PlanStep, ...]:
    """24 looks from both sides of both axes."""
    orders = [("home", 0, 0)]
    for sheet in sheets:
        orders.append(("place", sheet))
        for k in range(12):
            orders += [("move", (0, 100, 200, 100)[k % 4], (-60, 0, 60, 30, -30, -45)[k % 6]), ("look",)]
    return steps(*orders)


def invented(job: StudyJob, index: int) -> StudyRow:
    """A row as `study_row` makes it, of a perfect estimator: errors and sds are known."""
    from tvsbayes.instrument.parameters import TARGETS

    error = float(np.random.default_rng([3, index]).standard_normal())
    pit = 0.5 * math.erfc(error / math.sqrt(2))
    one = HeadlineRow(0.06, 0.06 + 1e-4 * error, 1e-4, (0.0, 1.0), pit, 1e-4)
    target = 5e-4 if index % 4 else 2e-3
    headlines = dict.fromkeys(TARGETS, one)
    return StudyRow(job.key, index, job.campaign_seed(index), True, 0, (), 1.0, headlines, target, job.estimator)


@pytest.fixture
def job(mounted_rig) -> StudyJob:
    """A short plan on the mounted rig."""
    from tvsbayes.planning.target import parse_target
    from tvsbayes.studies.study_job import StudyJob

    return StudyJob(mounted_rig, sweep(), parse_target("u(worst) <= 1e-3 deg/step"), seed=7)


@pytest.fixture
def quick(monkeypatch):
    """Rows without simulation and fit; the list of those made."""
    simulated = []

    def row(job, index):
        simulated.append(index)
        return invented(job, index)

    monkeypatch.setattr("tvsbayes.studies.study_job.study_row", row)
    monkeypatch.setattr("tvsbayes.studies.executors.study_row", row)
    return simulated
