"""Command acquire: runs a plan at the bench or on its twin, optionally with a page in a browser."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from tvsbayes.cli.app import (
    INTERRUPTED,
    TARGET_MISSED,
    Ended,
    Json,
    check_order,
    finish,
    finite,
    refuse_options,
    report_line,
)
from tvsbayes.errors import InputError, escaped
from tvsbayes.pipeline import compile_for, no_output, unusable

if TYPE_CHECKING:
    from tvsbayes.acquisition.live_run import LiveRun
    from tvsbayes.acquisition.replanning import Ahead
    from tvsbayes.acquisition.run_log import Outcome
    from tvsbayes.acquisition.running_estimate import Estimate
    from tvsbayes.instrument.plan import PlanStep
    from tvsbayes.instrument.rig import Rig
    from tvsbayes.planning.next_looks import NextLooks

LaserClass = Annotated[
    str | None, Option("--laser-class", help="Class on the laser's label: states the hazard is known.")
]
TargetU = Annotated[
    float | None,
    Option("--target-u", min=0.0, help="Stop when every effective ratio is known to this u, deg/step."),
]
Estimated = Annotated[
    bool | None,
    Option(
        "--estimate/--no-estimate",
        help="Fit the looks so far beside the run (default: on hardware only; a simulation waits for each fit).",
    ),
]


def acquire(
    rig: Annotated[Path, Argument(metavar="RIG", help="Rig file.")],
    plan: Annotated[Path, Argument(metavar="PLAN", help="plan.csv.")],
    out: Annotated[Path, Argument(metavar="OUT", help="Campaign folder to write.")],
    simulate: Annotated[bool, Option("--simulate", help="The digital twin instead of hardware.")] = False,
    centroids: Annotated[
        bool, Option("--centroids", help="With --simulate: the twin states centroids, no pictures are made.")
    ] = False,
    resume: Annotated[bool, Option("--resume", help="Go on with an interrupted run.")] = False,
    dry_run: Annotated[bool, Option("--dry-run", help="List what would happen; nothing moves.")] = False,
    laser_class: LaserClass = None,
    target_u: TargetU = None,
    estimate: Estimated = None,
    adapt: Annotated[bool, Option("--adapt", help="With --target-u: looks chosen from the fits.")] = False,
    minutes: Annotated[float | None, Option(min=0.1, help="With --adapt: longest run.")] = None,
    seed: Annotated[int | None, Option(min=0, help="Of a simulation (default 0).")] = None,
    place_command: Annotated[
        str | None, Option(metavar="CMD", help="Program that places the sheet: CMD TARGET X_MM NUMBER.")
    ] = None,
    place_seconds: Annotated[
        float | None, Option(min=1.0, help="With --place-command: longest time (default 600).")
    ] = None,
    live: Annotated[bool, Option("--live", help="A page on this machine to watch the run.")] = False,
    port: Annotated[int | None, Option(min=0, max=65535, help="With --live: to listen on; 0 takes a free one.")] = None,
    no_browser: Annotated[bool, Option("--no-browser", help="With --live: only print the link.")] = False,
    as_json: Json = False,
) -> None:
    """Drive positioner and cameras through a plan into a campaign. An interrupted run loses nothing.

    LASER: 808 nm is invisible and likely class 3B. Goggles on, beam path shut in.
    """
    from tvsbayes.instrument.plan import read_plan
    from tvsbayes.instrument.rig import read_rig

    finite(target_u=target_u, minutes=minutes, place_seconds=place_seconds)
    if place_command is None:
        refuse_options("for --place-command", "add it, or leave it out", place_seconds=place_seconds)
    if simulate:
        refuse_options("for a laser, and --simulate has none", "leave out one of them", laser_class=laser_class)
    else:
        twin = {"centroids": centroids, "seed": seed}
        refuse_options("for the twin", "add --simulate, or leave it out", **twin)
    if target_u is not None and estimate is False:
        remedy = "leave out one of them"
        raise InputError("usage", "--target-u needs the fits that --no-estimate forbids", remedy=remedy)
    if adapt and target_u is None:
        raise InputError("usage", "--adapt needs a target to go for", remedy="add --target-u")
    if not adapt:
        refuse_options("for --adapt", "add --adapt, or leave it out", minutes=minutes)
    if not live:
        refuse_options("for --live", "add --live, or leave it out", port=port, no_browser=no_browser)
    check_order(rig, plan)
    instrument = read_rig(rig)
    _refuse_sightings(instrument.table.mechanism.sightings)
    steps = read_plan(plan)
    if dry_run:
        run_options = {"live": live, "place_command": place_command}
        refuse_options("for a run, and --dry-run makes none", "leave out one of them", **run_options)
        _rehearse(instrument, steps, as_json)
        return
    from tvsbayes.acquisition.observation import live_detector
    from tvsbayes.acquisition.operator import LiveLine, Terminal
    from tvsbayes.acquisition.place_command import PlaceCommand
    from tvsbayes.acquisition.replanning import AdaptOptions
    from tvsbayes.acquisition.running_estimate import EstimateOptions
    from tvsbayes.acquisition.session import acquire as run_plan
    from tvsbayes.instrument.plan import counters_planned

    placement = None if place_command is None else PlaceCommand.parsed(place_command, place_seconds)
    with LiveLine() as line, _live_page(port or 0 if live else None, no_browser) as live_run:
        outcome = run_plan(
            instrument,
            steps,
            out,
            simulate=simulate,
            resume=resume,
            laser_class=laser_class,
            seed=seed or 0,
            estimate=EstimateOptions(laplace_estimate, target_u, estimate),
            adapt=AdaptOptions(partial(propose_looks, rig, planned=counters_planned(steps)), minutes)
            if adapt
            else None,
            detector=None if centroids else live_detector(instrument.stereo_pair),
            terminal=Terminal(report_line, line.show, line.ask),
            live=live_run,
            place_command=placement,
        )
    _finish_run(outcome, out, target_u, as_json)


def laplace_estimate(folder: Path, looks: int) -> Estimate:
    """The Laplace estimate of a campaign; called in a process parallel to the run.

    Raises:
        TvsError: no campaign, or a fit that must not be used.
    """
    from tvsbayes.acquisition.running_estimate import Estimate
    from tvsbayes.assessment.summary import summarise
    from tvsbayes.estimators.joint_fit import fit
    from tvsbayes.instrument.campaign import read_campaign

    compile_for(no_output)
    summary = summarise(fit(read_campaign(folder)))
    error = unusable(summary)
    if error is not None:
        raise error
    return Estimate.of(looks, {direction: e for direction, e in summary.effective.items() if e is not None})


def propose_looks(
    rig: Path,
    folder: Path,
    looks: int,
    target_u: float,
    count: int,
    confirm_below: float,
    planned: dict[str, tuple[int, int]] | None = None,
) -> Ahead:
    """The best next looks of a campaign; called in a process parallel to the run, which may make counters as planned.

    Raises:
        TvsError: no campaign, or a fit that must not be used.
    """
    from tvsbayes.estimators.joint_fit import fit
    from tvsbayes.instrument.campaign import read_campaign
    from tvsbayes.instrument.rig import read_rig
    from tvsbayes.planning.next_looks import next_looks
    from tvsbayes.planning.target import parse_target

    compile_for(no_output)
    target = parse_target(f"u(worst) <= {target_u:g} deg/step")
    known = fit(read_campaign(folder))
    looks_ahead = next_looks(known, read_rig(rig), target, count, confirm_below=confirm_below, planned=planned)
    return proposal_of(looks_ahead, looks)


def proposal_of(chosen: NextLooks, looks: int) -> Ahead:
    """Estimates and proposal of next looks for a run, after a number of looks."""
    from tvsbayes.acquisition.replanning import Ahead, Proposal
    from tvsbayes.acquisition.running_estimate import Estimate
    from tvsbayes.results.plan_record import steps_of

    proposal = Proposal(steps_of(chosen.steps), chosen.after_each, chosen.now, looks, chosen.why)
    laplace, confirmed = Estimate.of(looks, chosen.effective_deg_per_step), chosen.confirmed
    if confirmed is None:
        return Ahead(laplace, proposal)
    sampled = Estimate.of(looks, confirmed.effective_deg_per_step, confirmed.tier)
    return Ahead(laplace, proposal, sampled, confirmed.accepted)


def _refuse_sightings(sightings: bool) -> None:
    """Refuse the rig file of a head with sightings for `acquire`, since it has no stereo pair.

    Raises:
        InputError: `sightings`.
    """
    if sightings:
        message = "acquire looks at spots through a stereo pair, and this head says where it points"
        remedy = "check RIG PLAN, drive the plan yourself, then `tvsbayes import LOG --sightings --to FOLDER`"
        raise InputError("usage", message, remedy=f"{remedy}; the twin of the head: simulate RIG PLAN FOLDER")


@contextmanager
def _live_page(port: int | None, no_browser: bool) -> Iterator[LiveRun | None]:
    """A run whose page is served on a port; None for no page."""
    if port is None:
        yield None
        return
    from tvsbayes.acquisition.live_run import LiveRun
    from tvsbayes.view.live_server import LivePage

    def begun() -> None:
        report_line(f"open {page.link}")
        if not no_browser:
            import webbrowser

            # In a separate thread: browsers of a terminal do not return before they are closed.
            threading.Thread(target=webbrowser.open, args=(page.link,), daemon=True).start()

    run = LiveRun(begun)
    with LivePage(run, port) as page:
        yield run


def _rehearse(rig: Rig, plan: Sequence[PlanStep], as_json: bool) -> None:
    """Print the steps of a run and its duration."""
    from tvsbayes.acquisition.replanning import check_plan
    from tvsbayes.instrument.plan import outline, plan_minutes

    check_plan(rig, plan)
    lines, minutes = outline(rig, plan), plan_minutes(rig, plan)
    text = "\n".join([*lines, f"{len(lines)} steps, about {minutes:.0f} min"])
    finish({"steps": lines, "minutes": minutes}, text, as_json)


def _finish_run(outcome: Outcome, out: Path, target_u: float | None, as_json: bool) -> None:
    """Print the outcome of a run; ends with its exit code."""
    text = f"{escaped(str(out), 200)}: {outcome.reason}, {outcome.ok} of {outcome.looks} looks count"
    if outcome.references:
        planned = outcome.looks - outcome.references
        text += f" ({planned} of the plan, {outcome.references} reference looks of resumed runs)"
    lines = [text]
    if outcome.estimate is not None:
        method = {"importance": "the sampled posterior", "laplace": "the Laplace approximation"}[outcome.estimate.tier]
        lines.append(f"deg/step by {method} of {outcome.estimate.looks} looks: {outcome.estimate.text}")
    lines += [f"warning: {warning}" for warning in outcome.warnings]
    finish({"campaign": str(out), **outcome.as_json()}, "\n".join(lines), as_json)
    if outcome.reason in ("interrupted", "declined"):
        report_line(f"{outcome.reason}; go on with --resume")
        raise Ended(INTERRUPTED)
    if target_u is not None and outcome.reason != "target met":
        cause = "the time is over" if outcome.reason == "time over" else "the plan is done"
        report_line(f"{cause} and the target is not met: plan more with tvsbayes plan --given")
        raise Ended(TARGET_MISSED)
