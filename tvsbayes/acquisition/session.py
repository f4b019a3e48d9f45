"""From a rig file and a plan to a finished run: check the plan, begin or continue the journal, run the bench.

`acquire` implements the command of that name, on the bench or on its twin.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

from tvsbayes.acquisition.drivers import hardware
from tvsbayes.acquisition.engine import Acquisition, Outcome
from tvsbayes.acquisition.journal import EMPTY_REMEDY, LOG, Journal, read_journal, require_journal
from tvsbayes.acquisition.live_run import LiveRun
from tvsbayes.acquisition.observation import Detector, wait_for_detection
from tvsbayes.acquisition.operator import StopKey, Terminal, TerminalOperator, check_hazard
from tvsbayes.acquisition.place_command import PlaceCommand
from tvsbayes.acquisition.recorder import Recorded, recorded
from tvsbayes.acquisition.replanning import AdaptOptions, Replanning, adapted_plan, check_plan
from tvsbayes.acquisition.run_identity import check_same, identity, setup_changes
from tvsbayes.acquisition.running_estimate import EstimateOptions, RunningEstimate
from tvsbayes.acquisition.simulated_bench import SIMULATED_START, simulated
from tvsbayes.errors import escaped, refusal
from tvsbayes.instrument.campaign import NAME_ACQUIRED
from tvsbayes.instrument.plan import PlanStep, plan_minutes, run_plan
from tvsbayes.instrument.rig import Rig
from tvsbayes.instrument.stops import legs_of


def acquire(
    rig: Rig,
    plan: Sequence[PlanStep],
    folder: Path,
    *,
    simulate: bool = False,
    resume: bool = False,
    laser_class: str | None = None,
    seed: int = 0,
    estimate: EstimateOptions | None = None,
    adapt: AdaptOptions | None = None,
    detector: Detector | None = None,
    terminal: Terminal | None = None,
    live: LiveRun | None = None,
    place_command: PlaceCommand | None = None,
) -> Outcome:
    """Runs a plan on the instrument of a rig file, or on its twin, into a campaign folder.

    Args:
        rig: the rig.
        plan: its steps.
        folder: new or empty; with `resume` the folder of the interrupted run.
        simulate: the twin instead of hardware; `truth.json` is written beside the campaign.
        resume: continue an interrupted run.
        laser_class: states that the hazard is known; without it the operator must confirm.
        seed: seed of a simulation.
        estimate: whether the looks so far are fitted while it runs. A simulation waits for every fit.
        adapt: chooses the remaining looks from that fit; `estimate` must have a target.
        detector: finds spots in pictures; by default that is left to `detect`, and a simulation gives centroids.
        terminal: output of messages and questions; by default nothing is shown.
        live: publishes the run.
        place_command: a program that places the sheet instead of a person.

    Raises:
        InputError: a plan that this rig cannot run, another plan than before, no operator.
        DeviceFault: device, camera or disk failed.
    """
    folder, terminal = Path(folder), terminal or Terminal()
    check_plan(rig, plan)
    check_hazard(laser_class, simulate)
    record = _earlier_runs(folder) if resume else Recorded()
    header: dict[str, object] = {"name": str(rig.header.get("name", NAME_ACQUIRED))}
    if simulate:
        header |= {"created": SIMULATED_START.isoformat(), "synthetic": True, "seed": int(seed)}
    stop = StopKey(terminal.say)
    with ExitStack() as stack:
        # Device and cameras first: a failure to open them leaves no folder behind.
        if simulate:
            bench = stack.enter_context(simulated(rig, seed, record, detector))
        else:
            operator = TerminalOperator(stop, terminal, laser_class, place_command is None)
            bench = stack.enter_context(hardware(rig, detector or wait_for_detection, operator))
        for warning in bench.warnings:
            terminal.say(f"warning: {warning}")
        journal = begin(folder, rig, plan, resume, header)
        stack.callback(journal.close)
        if journal.torn:
            terminal.say(f"{len(journal.torn)} bytes of an unfinished line were cut off and kept in log.torn-*")
        for change in setup_changes(journal.records, rig, simulate):
            terminal.say(change)
        running = _running(rig, plan, folder, estimate, adapt, simulate)
        if running is not None:
            stack.enter_context(running)
        stack.callback(bench.conclude, folder)
        run = Acquisition(
            rig,
            adapted_plan(plan, journal.records),
            journal,
            bench,
            stop=stop,
            show=terminal.show,
            estimate=running,
            live=live,
            place_command=place_command,
        )
        return run.run()


def _running(
    rig: Rig,
    plan: Sequence[PlanStep],
    folder: Path,
    estimate: EstimateOptions | None,
    adapt: AdaptOptions | None,
    simulate: bool,
) -> RunningEstimate | None:
    """The running estimate of a run, None without one."""
    if estimate is None:
        return None
    target = estimate.target_u_deg_per_step
    if adapt is not None and target is not None:
        minutes = plan_minutes(rig, plan) if adapt.minutes is None else adapt.minutes
        return Replanning(folder, adapt.ahead, target, minutes, wait=simulate)
    if target is None and (simulate if estimate.enabled is None else not estimate.enabled):
        return None
    return RunningEstimate(folder, estimate.fit, target, legs_of(run_plan(plan, rig).moves), wait=simulate)


def _earlier_runs(folder: Path) -> Recorded:
    """The record of an interrupted run."""
    remedy = "leave --resume out to begin, or name the folder of the interrupted run"
    if folder.is_dir() and any(folder.iterdir()):
        remedy = (
            f"bring {LOG} back from a backup, or begin in another folder without --resume; what this folder holds can "
            "still be calibrated"
        )
    require_journal(folder, remedy)
    return recorded(read_journal(folder).records)


def begin(folder: Path, rig: Rig, plan: Sequence[PlanStep], resume: bool, header: Mapping[str, object]) -> Journal:
    """Open the journal to write: a new one, or the one to continue.

    Raises:
        InputError: no journal to continue, another plan or rig than before, or a folder that has a journal.
    """
    if resume:
        journal = Journal.open(folder)
        try:
            check_same(journal.records[0].data, rig, plan, header)
        except BaseException:
            journal.close()
            raise
        return journal
    if folder.is_dir() and any(folder.iterdir()):
        emptied = (folder / LOG).is_file() and not (folder / LOG).stat().st_size
        raise refusal(
            "occupied",
            file=escaped(str(folder), 200),
            found="a folder with files",
            allowed="a new or empty folder",
            remedy=EMPTY_REMEDY if emptied else "name another folder, or go on with --resume",
        )
    created = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    entries = {"created": created, **header, **identity(rig, plan, bool(header.get("synthetic")))}
    return Journal.create(folder, **entries)
