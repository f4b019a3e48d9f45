"""The fit beside a run."""

from __future__ import annotations

import errno
import multiprocessing
import os

import pytest
from msgspec import structs
from support.bench_runs import Run, small_plan
from support.fits_beside import killed, two_directions, waiting
from support.small_results import small_summary

from tvsbayes.acquisition import running_estimate
from tvsbayes.acquisition.journal import read_journal
from tvsbayes.acquisition.operator import Terminal
from tvsbayes.acquisition.recorder import recorded
from tvsbayes.acquisition.running_estimate import EstimateOptions, RunningEstimate
from tvsbayes.acquisition.session import acquire
from tvsbayes.cli import acquire_command
from tvsbayes.errors import NotConverged
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.plan import run_plan
from tvsbayes.instrument.stops import legs_of


def test_run_ends_when_the_running_estimate_meets_its_target(mounted_rig, tmp_path):
    """A stand-in whose u falls as 0.012 / looks: 5e-4 is met at 24 looks; fits at 12, 15 (fails), 18, 22, 27."""
    plan, texts = small_plan(20), []
    directions = set(legs_of(run_plan(plan, mounted_rig).moves))
    assert directions == {"left", "right"}
    with RunningEstimate(tmp_path / "c", two_directions, 5e-4, directions, wait=True) as estimate:
        run_ = Run(mounted_rig, tmp_path / "c", plan, estimate=estimate, show=lambda p: texts.append(p.estimate))
        outcome = run_.engine.run()
    assert (outcome.reason, outcome.looks, estimate.latest.looks) == ("target met", 27, 27) and run_.dark()
    assert texts[0] == "" and texts[-1].startswith("left 0.06000(5")
    assert recorded(read_journal(tmp_path / "c").records).unverified == (), "the closing homing took place"
    for needed in ({"left", "up"}, set()):
        with RunningEstimate(tmp_path / "c", two_directions, 1.0, needed, wait=True) as estimate:
            assert not estimate.update(27) and estimate.latest is not None, "a direction without a figure is not met"


@pytest.mark.parametrize(("enabled", "shown"), [(None, False), (True, True), (False, False)])
def test_estimate_is_shown_without_a_target(mounted_rig, tmp_path, enabled, shown):
    """What is known so far belongs into the live line whether or not it ends the run; simulations must ask for it."""
    wish, texts = EstimateOptions(two_directions, enabled=enabled), []
    terminal = Terminal(show=lambda progress: texts.append(progress.estimate))
    outcome = acquire(
        mounted_rig, small_plan(4), tmp_path / "c", simulate=True, seed=4, estimate=wish, terminal=terminal
    )
    assert (outcome.reason, outcome.looks) == ("done", 16)
    assert texts[-1] == ("left 0.0600(10), right 0.0600(10)" if shown else "")


def test_fits_share_a_process_and_another_takes_over_from_one_that_was_killed(tmp_path):
    """Libraries are imported and functions compiled once a run; a fit that the kernel kills is one without a result."""
    with RunningEstimate(tmp_path, killed, None, (), wait=True) as estimate:
        estimate.update(12)
        assert estimate.latest is None
        numbers = []
        for looks in (15, 18):
            estimate.update(looks)
            numbers.append((estimate.latest.looks, estimate.latest.u_deg_per_step["left"]))
    assert [looks for looks, _ in numbers] == [15, 18] and numbers[0][1] == numbers[1][1]


@pytest.mark.usefixtures("ctrl_c_works")
def test_a_stop_ends_the_fit_that_is_waited_for(mounted_rig, tmp_path, monkeypatch):
    monkeypatch.setattr(running_estimate, "FIT_MAX_S", 60.0)
    os.mkfifo(tmp_path / "go")

    class Stopping(RunningEstimate):
        def _arguments(self, looks):
            run.stop.requested = True
            return super()._arguments(looks)

    with Stopping(tmp_path / "c", waiting, None, {"left"}, wait=True) as estimate:
        run = Run(mounted_rig, tmp_path / "c", small_plan(4), estimate=estimate)
        outcome = run.engine.run()
        assert not multiprocessing.active_children()
    assert (outcome.reason, outcome.looks) == ("interrupted", 12)


def test_estimate_that_cannot_start_does_not_end_the_run(tmp_path, monkeypatch):
    def full(self):
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr(multiprocessing.context.SpawnProcess, "start", full)
    for wait in (True, False):
        with RunningEstimate(tmp_path, two_directions, 1.0, {"left"}, wait=wait) as estimate:
            assert not estimate.update(12) and estimate.latest is None


def test_estimate_of_the_command_is_the_laplace_fit(monkeypatch):
    """The numbers of `fit --no-sample`, in a record; a direction that was never moved has none."""
    campaign, summary = shipped_data() / "twins" / "paper_twin", small_summary()
    fits = {"paper twin": summary}
    monkeypatch.setattr("tvsbayes.estimators.joint_fit.fit", lambda campaign: campaign.title)
    monkeypatch.setattr("tvsbayes.assessment.summary.summarise", lambda fit: fits[fit])
    estimate = acquire_command.laplace_estimate(campaign, 384)
    assert (estimate.looks, estimate.tier) == (384, "laplace")
    assert estimate.deg_per_step == {"left": summary.effective["left"].value}
    assert estimate.u_deg_per_step == {"left": summary.effective["left"].sd}
    astray = structs.replace(summary, problems=("astray",), answer=None, converged=False)
    monkeypatch.setattr("tvsbayes.assessment.summary.summarise", lambda fit: astray)
    with pytest.raises(NotConverged):
        acquire_command.laplace_estimate(campaign, 384)
