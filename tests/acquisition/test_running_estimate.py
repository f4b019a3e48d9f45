"""The fit beside a run."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from support.bench_runs import Run, small_plan
from support.live_runs import scripted_run

from tvsbayes.acquisition import running_estimate
from tvsbayes.acquisition.journal import read_journal
from tvsbayes.acquisition.operator import Terminal
from tvsbayes.acquisition.recorder import recorded
from tvsbayes.acquisition.running_estimate import EstimateWish, RunningEstimate
from tvsbayes.acquisition.session import acquire
from tvsbayes.cli.acquire_command import FIT_COMMAND
from tvsbayes.instrument.plan import run_plan
from tvsbayes.instrument.stops import legs_of

FIT = """
import json, sys
from pathlib import Path
looks = len((Path(sys.argv[1]) / "spots.csv").read_text().splitlines()) - 1
entry = {"value": 0.06, "sd": 0.012 / looks}
print(json.dumps({"converged": looks != 15, "effective_deg_per_step": {"left": entry, "right": entry, "up": None}}))
"""


def test_run_ends_when_the_running_estimate_meets_its_target(mounted_rig, tmp_path):
    """A stand-in whose u falls as 0.012 / looks: 5e-4 is met at 24 looks; fits at 12, 15 (fails), 18, 22, 27."""
    plan, texts = small_plan(20), []
    directions = set(legs_of(run_plan(plan, mounted_rig).moves))
    assert directions == {"left", "right"}
    command = [sys.executable, "-c", FIT]
    with RunningEstimate(tmp_path / "c", command, 5e-4, directions, wait=True) as estimate:
        run_ = Run(mounted_rig, tmp_path / "c", plan, estimate=estimate, show=lambda p: texts.append(p.estimate))
        outcome = run_.engine.run()
    assert (outcome.reason, outcome.looks, estimate.latest.looks) == ("target met", 27, 27) and run_.dark()
    assert texts[0] == "" and texts[-1].startswith("left 0.060000 u 5.")
    assert recorded(read_journal(tmp_path / "c").records).unverified == (), "the closing homing took place"
    for needed in ({"left", "up"}, set()):
        with RunningEstimate(tmp_path / "c", command, 1.0, needed, wait=True) as estimate:
            assert not estimate.update(27) and estimate.latest is not None, "a direction without a figure is not met"


@pytest.mark.parametrize(("asked", "shown"), [(None, False), (True, True), (False, False)])
def test_estimate_is_shown_without_a_target(mounted_rig, tmp_path, asked, shown):
    """What is known so far belongs into the live line whether or not it ends the run; simulations must ask for it."""
    wish = EstimateWish((sys.executable, "-c", FIT), asked=asked)
    texts = []

    def show(progress):
        texts.append(progress.estimate)

    outcome = acquire(
        mounted_rig, small_plan(4), tmp_path / "c", simulate=True, seed=4, estimate=wish, terminal=Terminal(show=show)
    )
    assert (outcome.reason, outcome.looks) == ("done", 16)
    assert texts[-1] == ("left 0.060000 u 1.0e-03, right 0.060000 u 1.0e-03" if shown else "")


def test_running_estimate_does_not_hold_up_the_run_and_dies_with_it(mounted_rig, tmp_path):
    command = [sys.executable, "-c", "import threading; threading.Event().wait()"]
    with RunningEstimate(tmp_path / "c", command, 1.0, {"left"}) as estimate:
        assert Run(mounted_rig, tmp_path / "c", small_plan(5), estimate=estimate).engine.run().reason == "done"
        child = estimate._process
        assert child.poll() is None and estimate.latest is None
    assert child.poll() is not None


FIT_THAT_WAITS = "import sys; open(sys.argv[1] + '/../go').read()"
"""Ends once somebody opens the other end of a pipe."""


@pytest.mark.usefixtures("ctrl_c_works")
@pytest.mark.parametrize("asked", ["laser off", "stop"])
def test_requests_are_heeded_while_a_fit_is_waited_for(mounted_rig, tmp_path, monkeypatch, asked):
    """Laser off is acknowledged while the fit still works: only then is the fit let go. A stop ends the fit."""
    monkeypatch.setattr(running_estimate, "FIT_MAX_S", 60.0)
    os.mkfifo(tmp_path / "go")
    live, states = scripted_run("resume"), []
    settle = live.requests.settle

    class Asking(RunningEstimate):
        def _begin(self, looks):
            super()._begin(looks)
            if not states:
                live.ask(asked)

    def settled(request, state, answer):
        states.append((request.what, state, estimate._process.poll() if estimate._process else None))
        if request.what == "laser off":
            (tmp_path / "go").write_text("go")
            (tmp_path / "go").unlink()
            (tmp_path / "go").write_text("later fits need not wait")
        return settle(request, state, answer)

    monkeypatch.setattr(live.requests, "settle", settled)
    with Asking(tmp_path / "c", [sys.executable, "-c", FIT_THAT_WAITS], None, {"left"}, wait=True) as estimate:
        outcome = Run(mounted_rig, tmp_path / "c", small_plan(4), estimate=estimate, live=live).engine.run()
        assert estimate._process is None
    assert states[0] == (asked, "acknowledged", None)
    assert (outcome.reason, outcome.looks) == (("interrupted", 12) if asked == "stop" else ("done", 16))


def test_estimate_that_cannot_start_does_not_end_the_run(tmp_path):
    for wait in (True, False):
        with RunningEstimate(tmp_path, [str(tmp_path / "nothing")], 1.0, {"left"}, wait=wait) as estimate:
            assert not estimate.update(12) and estimate.latest is None


def test_the_command_of_acquire_is_a_fit():
    done = subprocess.run([*FIT_COMMAND, "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "--no-sample" in done.stdout, done.stderr
