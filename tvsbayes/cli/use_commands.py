"""Commands that use a calibration or plan looks: locate, steps-for, plan, study."""

from __future__ import annotations

import math
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from tvsbayes.cli.app import (
    TARGET_MISSED,
    CampaignFolder,
    Ended,
    Force,
    Json,
    OldOut,
    Seed,
    check_order,
    check_output,
    finish,
    finite,
    keep,
    missing_options,
    option_of,
    refuse_options,
    report_line,
)
from tvsbayes.cli.compensation_commands import EXPORTS, export_calibration, plan_verify
from tvsbayes.cli.instruments import serve
from tvsbayes.cli.progress_bar import waiting
from tvsbayes.cli.watch_command import plan_watch
from tvsbayes.errors import InputError, escaped, refusal
from tvsbayes.files.disk import output_place
from tvsbayes.instrument.axes import AXES, sides_of
from tvsbayes.pipeline import FITTING, StoredOrFitted, compile_for
from tvsbayes.progress import Job

if TYPE_CHECKING:
    from tvsbayes.calibration.pointing import Calibration
    from tvsbayes.instrument.campaign import Campaign
    from tvsbayes.instrument.rig import Rig
    from tvsbayes.planning.target import Target

WORKERS = 2
PLAN_DRAWS = 200
"""Default equal to that of `planning.planner`, whose import would load JAX."""
NEAREST_POINT_MM = 10.0
"""Least distance of a point from the middle of the baseline: smaller numbers are probably metres."""
PLANNING, LOCATING = "plan", "points"


def locate(
    campaign: CampaignFolder,
    pan_steps: Annotated[float | None, Option(help="Absolute counter.")] = None,
    tilt_steps: Annotated[float | None, Option(help="Absolute counter.")] = None,
    pan_approach: Annotated[str | None, Option(help="left (default), right or unknown.")] = None,
    tilt_approach: Annotated[str | None, Option(help="up (default), down or unknown.")] = None,
    aperture_deg: Annotated[float | None, Option(help="Reading B of the aperture.")] = None,
    points: Annotated[
        Path | None, Option(help="CSV with columns pan_steps, tilt_steps, pan_approach, tilt_approach, aperture_deg.")
    ] = None,
    cloud: Annotated[
        Path | None, Option(help="Write the points of --points here, in the format of the ending: OUT.ply.")
    ] = None,
    draws: Annotated[int, Option(min=500, max=100_000, help="Draws per point.")] = 1000,
    budget: Annotated[bool, Option("--budget", help="Also print the uncertainty budget of the point.")] = False,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Where the scanner points, in millimetres. Frame T, with covariance and 95 % half widths."""
    if serve("locate", **locals()):
        return
    counters = {"pan_steps": pan_steps, "tilt_steps": tilt_steps, "aperture_deg": aperture_deg}
    if points is not None:
        options = {"pan_approach": pan_approach, "tilt_approach": tilt_approach, "budget": budget}
        refuse_options("for one point", "leave out --points, or give the columns of its file", **options, **counters)
        if cloud is None:
            _locate_all(campaign, points, draws, seed, as_json)
        else:
            _write_cloud(campaign, points, cloud, draws, seed, as_json)
        return
    refuse_options("for files of points", "give --points FILE.csv with it", cloud=cloud)
    if pan_steps is None or tilt_steps is None or aperture_deg is None:
        missing = missing_options(**counters)
        message = f"locate needs one point or a file of points; missing: {', '.join(missing)}"
        remedy = f"give {' and '.join(missing)} too, or --points FILE.csv"
        raise InputError("usage", message, allowed=", ".join(map(option_of, counters)), remedy=remedy)
    finite(**counters)
    from tvsbayes.instrument.campaign import read_campaign

    look = (pan_steps, tilt_steps, aperture_deg, (pan_approach or "left", tilt_approach or "up"))
    sides_of(look[-1])
    measured = read_campaign(campaign)
    with waiting() as progress:
        calibration = StoredOrFitted(measured, report_line, progress).calibration
    from tvsbayes.coordinates.location import locate as locate_points
    from tvsbayes.report.command_text import budget_text, locations_text

    _refuse_head(calibration)
    located = locate_points(calibration, *look, draws=draws, seed=seed)
    if located.refused[0] is not None:
        raise located.refused[0]
    document = {"estimator": located.estimator, "draws": located.draws, **located.as_json(0)}
    text = locations_text(located, measured.aperture_read)
    if budget:
        from tvsbayes.metrology.look_budget import budget as point_budget

        point_parts = point_budget(calibration, *look)
        document["budget"] = point_parts.as_json()
        text += f"\n\n{budget_text(point_parts)}"
    finish(document, text, as_json)


def _locate_all(campaign: Path, file: Path, draws: int, seed: int, as_json: bool) -> None:
    """Locate all points of a file; each may be refused."""
    from tvsbayes.coordinates.looks_file import read_looks
    from tvsbayes.instrument.campaign import read_campaign

    looks = read_looks(file)
    measured = read_campaign(campaign)
    with waiting() as progress, Job({FITTING: 1.0, LOCATING: 1.0}, progress) as job:
        calibration = StoredOrFitted(measured, report_line, job.part(FITTING)).calibration
        from tvsbayes.coordinates.location import locate_settings
        from tvsbayes.report.command_text import locations_text

        _refuse_head(calibration)
        located = locate_settings(calibration, looks, draws=draws, seed=seed, progress=job.part(LOCATING))
    entries = [located.as_json(k) for k in range(len(located.refused))]
    document = {"estimator": located.estimator, "draws": located.draws, "points": entries}
    finish(document, locations_text(located, measured.aperture_read), as_json)


def _write_cloud(campaign: Path, file: Path, out: Path, draws: int, seed: int, as_json: bool) -> None:
    """Write the points of a file of any length as a cloud."""
    from tvsbayes.coordinates.cloud import EvenSample, checked
    from tvsbayes.coordinates.cloud import cloud as points_of
    from tvsbayes.coordinates.cloud_files import cloud_place, write_cloud
    from tvsbayes.coordinates.looks_file import look_blocks
    from tvsbayes.coordinates.simple_calibration import simple_calibrations
    from tvsbayes.estimators.four_point import classic_of
    from tvsbayes.instrument.campaign import read_campaign
    from tvsbayes.report.command_text import cloud_text

    cloud_place(out, file)
    with waiting() as progress, Job({FITTING: 1.0, LOCATING: 1.0}, progress) as job:
        measured = read_campaign(campaign)
        calibration = StoredOrFitted(measured, report_line, job.part(FITTING)).calibration
        _refuse_head(calibration)
        simple = simple_calibrations(measured.rig.priors, classic_of(measured))
        job.begin(LOCATING)
        sample = EvenSample()
        blocks = points_of(calibration, sample.of(look_blocks(file, job.at)), simple)
        written = write_cloud(blocks, out, tuple(simple))
        # The file has looks: an empty one is refused.
        assert sample.looks is not None
        check = checked(calibration, sample.looks, draws, seed)
    document = {"estimator": calibration.estimator, **written.as_json(), "checked": asdict(check)}
    finish(document, cloud_text(written, check, calibration), as_json)


def _refuse_head(calibration: Calibration) -> None:
    """Refuse a head for `locate`, which needs the scanner's aperture.

    Raises:
        InputError: the calibration belongs to a head.
    """
    from tvsbayes.calibration.pointing import INPUT_NAMES

    if calibration.names != INPUT_NAMES:
        message = "locate meets the beam with the scanner's aperture, and a pan-tilt head has none"
        raise InputError("usage", message, remedy="steps-for says which counters point along a direction")


def steps_for(
    campaign: CampaignFolder,
    x_mm: Annotated[float | None, Option(help="Wanted point, frame T: depth.")] = None,
    y_mm: Annotated[float | None, Option(help="Along the baseline, towards the positioner.")] = None,
    z_mm: Annotated[float | None, Option(help="Up.")] = None,
    azimuth_deg: Annotated[float | None, Option(help="Wanted direction: C - 90 deg.")] = None,
    elevation_deg: Annotated[float | None, Option(help="Above the horizontal.")] = None,
    pan_approach: Annotated[str | None, Option(help="left or right (default: left).")] = None,
    tilt_approach: Annotated[str | None, Option(help="up or down (default: up).")] = None,
    rig: Annotated[Path | None, Option(help="Rig file whose [positioner] limits are kept.")] = None,
    export: Annotated[str | None, Option(help="header or json: the calibration itself.")] = None,
    out: Annotated[Path | None, Option("-o", "--out", help="File for --export (default: printed).")] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Counters that send the beam to a point or along a direction. With the approach that removes backlash."""
    if serve("steps-for", **locals()):
        return
    target = {"x_mm": x_mm, "y_mm": y_mm, "z_mm": z_mm, "azimuth_deg": azimuth_deg, "elevation_deg": elevation_deg}
    finite(**target)
    point = None if x_mm is None or y_mm is None or z_mm is None else (x_mm, y_mm, z_mm)
    direction = None if None in (azimuth_deg, elevation_deg) else (azimuth_deg, elevation_deg)
    given = sum(value is not None for value in target.values())
    if export is not None and export not in EXPORTS:
        message, remedy = f"--export {escaped(export)}: allowed are header and json", "write --export header for C"
        raise InputError("usage", message, allowed="header, json", remedy=remedy)
    if export:
        options = {"pan_approach": pan_approach, "tilt_approach": tilt_approach, "rig": rig}
        check_output(out, kind=EXPORTS[export], force=force)
        remedy = "leave it out, --export writes the calibration itself; or leave out --export"
        refuse_options("for one target", remedy, **target, **options)
        export_calibration(campaign, export, out, as_json)
        return
    refuse_options("for the exported calibration", "add --export header or --export json", out=out, force=force)
    if given != (3 if point else 2 if direction else -1):
        remedy = "give --x-mm --y-mm --z-mm, or --azimuth-deg --elevation-deg, or --export alone"
        raise InputError("usage", "steps-for needs one target", remedy=remedy)
    if point is not None and math.dist(point, (0.0, 0.0, 0.0)) < NEAREST_POINT_MM:
        numbers = ", ".join(f"{value:g}" for value in point)
        message = f"the point ({numbers}) mm lies inside the scanner: are these metres?"
        metres = " ".join(f"--{axis}-mm {1000 * v:g}" for axis, v in zip("xyz", point, strict=True))
        allowed = f"a point at least {NEAREST_POINT_MM:g} mm from the middle of the baseline"
        raise InputError("range", message, allowed=allowed, remedy=f"lengths are mm: {metres}")
    from tvsbayes.instrument.campaign import read_campaign

    limits = None if rig is None else _limits(rig)
    measured = read_campaign(campaign)
    with waiting() as progress:
        calibration = StoredOrFitted(measured, report_line, progress).calibration
    from tvsbayes.instrument.stops import counters_made
    from tvsbayes.report.command_text import steps_text

    azimuth, elevation = direction or (None, None)
    sides = None if pan_approach is tilt_approach is None else (pan_approach or "left", tilt_approach or "up")
    counters = partial(calibration.steps_for, point, azimuth_deg=azimuth, elevation_deg=elevation, approach=sides)
    try:
        steps = counters(limits=limits or counters_made(measured.moves))
    except InputError as error:
        if limits is not None or error.code != "outside-limits":
            raise
        steps = counters()
        report_line(f"warning: {error.message}; the campaign made {error.allowed}: --rig RIG.toml keeps its limits")
    document = {"estimator": calibration.estimator, **steps.as_json()}
    finish(document, steps_text(steps), as_json)


TargetText = Annotated[
    str | None, Option("--target", help="As 'u(worst) <= 2e-4 deg/step' or 'U95(x) at 1000,0,0 mm <= 60 mm'.")
]


def plan(
    rig: Annotated[
        Path | None, Argument(metavar="RIG", help="Rig file; none with an axis folder; CAMPAIGN with --watch.")
    ] = None,
    given: Annotated[Path | None, Option(help="Existing campaign: plan what to measure next.")] = None,
    like: Annotated[Path | None, Option(help="Campaign of a rig of the same build: plan for the next one.")] = None,
    target: TargetText = None,
    minutes: Annotated[float | None, Option(min=0.1, help="Longest plan.")] = None,
    out: Annotated[Path | None, Option("-o", "--out", help="Write the plan here (plan.csv).")] = None,
    output: OldOut = None,
    criterion: Annotated[str, Option(help="c (the target), D or A (all results).")] = "c",
    aperture: Annotated[bool, Option("--aperture/--no-aperture", help="Looks also read the aperture.")] = False,
    draws: Annotated[int, Option(min=20, max=10_000, help="Instruments for the chances.")] = PLAN_DRAWS,
    count: Annotated[
        int | None, Option("--next", min=1, max=200, help="With --given: only the next so many looks, no homing.")
    ] = None,
    confirm: Annotated[
        float | None, Option(min=0, help="With --next: sample the posterior where u is at most this, deg/step.")
    ] = None,
    watch: Annotated[bool, Option("--watch", help="Fewest looks for `watch`: plan CAMPAIGN --watch.")] = False,
    verify: Annotated[
        bool, Option("--verify", help="Fewest readings or looks for `verify`: plan FOLDER --verify.")
    ] = False,
    force: Force = False,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """How many looks, which ones, and when to stop. With --given: what next."""
    out = out or output
    check_output(out, rig, kind="plan", force=force)
    finite(minutes=minutes, confirm=confirm)
    # Further options of a plan for a target.
    extra: dict[str, object] = {"criterion": criterion != "c", "draws": draws != PLAN_DRAWS, "aperture": aperture}
    extra["like"] = like
    onward = {"next": count, "confirm": confirm}
    if verify:
        refused: dict[str, object] = {"target": target, "minutes": minutes, "watch": watch, **extra, **onward}
        refuse_options("not for --verify", "leave it out", **refused)
        plan_verify(given or rig, out=out, seed=seed, as_json=as_json)
        return
    if watch:
        refuse_options("for targets, not for --watch", "leave it out", target=target, **extra, **onward)
        plan_watch(rig, given, minutes=minutes, out=out, seed=seed, as_json=as_json)
        return
    common = {"target": target, "minutes": minutes, "out": out, "seed": seed, "as_json": as_json}
    folder_alone = given is not None and rig is None
    if serve("plan", given or rig, **common, alone=folder_alone, **extra, **onward):
        return
    if rig is None:
        raise InputError("usage", "Missing argument 'RIG'.", remedy="see tvsbayes --help")
    from tvsbayes.instrument.campaign import input_hashes, read_campaign
    from tvsbayes.instrument.plan import write_plan
    from tvsbayes.instrument.rig import read_rig

    if given is not None:
        refuse_options("for a rig without data, not for --given", "leave one of them out", like=like)
    instrument, data = read_rig(rig), None if (known := given or like) is None else read_campaign(known)
    if data is not None and data.rig.mechanism != instrument.table.mechanism:
        message = f"{escaped(str(known), 200)} is the campaign of another mechanism than {escaped(str(rig), 200)}"
        raise InputError("usage", message, remedy="name a campaign of the same mechanism")
    from tvsbayes.planning.planner import plan as find_plan
    from tvsbayes.planning.target import DEFAULT_TARGET, parse_target
    from tvsbayes.report.command_text import plan_text
    from tvsbayes.results.plan_record import plan_document
    from tvsbayes.statistics.optimal_design import CRITERIA

    parsed_target = parse_target(target or DEFAULT_TARGET)
    if count is not None:
        refuse_options("for whole plans, not for --next", "leave it out", **extra, minutes=minutes, out=out)
        _next_looks(instrument, data if given else None, parsed_target, count, confirm, as_json)
        return
    refuse_options("for --next", "add --next, or leave it out", confirm=confirm)
    if criterion not in CRITERIA:
        message, allowed = f"--criterion {escaped(criterion)}", ", ".join(CRITERIA)
        raise InputError("criterion", message, column="--criterion", allowed=allowed, remedy="name one of them")
    compile_for(report_line)
    with waiting() as progress, Job({FITTING: 0.0 if data is None else 1.0, PLANNING: 3.0}, progress) as job:
        fitted = None if data is None else StoredOrFitted(data, report_line, job.part(FITTING)).fit
        result = find_plan(
            instrument,
            parsed_target,
            given=fitted if given else None,
            like=None if given else fitted,
            minutes=minutes,
            criterion=criterion,
            aperture=aperture,
            draws=draws,
            seed=seed,
            progress=job.part(PLANNING),
        )
    text, document = plan_text(result), result.as_json()
    if out is not None and result.steps:
        write_plan(result.steps, out, instrument.table.mechanism)
        document["plan"] = str(out)
        text += f"\nwritten: {escaped(str(out), 200)}"
    elif out is not None:
        text += f"\nnothing written to {escaped(str(out), 200)}: there is nothing more to measure"
    if like is not None:
        document["like"] = str(like)
        text = f"instruments like that of {escaped(str(like), 200)}: its play, scatter, drift and place\n{text}"
    if data is not None and given is not None:
        # The report reads the next looks from this file.
        keep(plan_document(document, input_hashes(data)), output_place(given, "results") / "plan.json")
    finish(document, text, as_json)
    if target is not None and not result.met:
        raise Ended(TARGET_MISSED)


def _next_looks(
    rig: Rig, data: Campaign | None, target: Target, count: int, confirm: float | None, as_json: bool
) -> None:
    """`plan --given --next`: a few looks that continue the campaign."""
    if data is None:
        raise InputError("usage", "--next goes on from a campaign", remedy="add --given CAMPAIGN")
    compile_for(report_line)
    with waiting() as progress, Job({FITTING: 1.0, PLANNING: 1.0}, progress) as job:
        fitted = StoredOrFitted(data, report_line, job.part(FITTING)).fit
        job.begin(PLANNING)
        from tvsbayes.planning.next_looks import next_looks

        looks = next_looks(fitted, rig, target, count, confirm_below=confirm)
    from tvsbayes.instrument.plan import outline
    from tvsbayes.results.plan_record import steps_of

    lines = [looks.why, *outline(rig, steps_of(looks.steps))]
    if looks.confirmed is not None:
        state = "" if looks.confirmed.accepted else ", whose weights must not be used"
        values = ", ".join(f"{d} {ratio.sd:.2e}" for d, ratio in looks.confirmed.effective_deg_per_step.items())
        lines.append(f"u by importance sampling{state}, deg/step: {values}")
    finish(looks.as_json(), "\n".join(lines), as_json)


def study(
    rig: Annotated[Path, Argument(metavar="RIG", help="Rig file.")],
    plan_file: Annotated[Path, Argument(metavar="PLAN", help="plan.csv.")],
    n: Annotated[int, Option(min=1, max=1_000_000, help="Simulated campaigns.")] = 100,
    engine: Annotated[str, Option(help="serial, processes or dask.")] = "serial",
    workers: Annotated[int | None, Option(min=1, max=1024, help="Worker processes (default 2).")] = None,
    scheduler: Annotated[str | None, Option(help="Address of a Dask scheduler.")] = None,
    rows: Annotated[Path | None, Option(help="File of rows (default: PLAN with .study.jsonl).")] = None,
    target: TargetText = None,
    estimator: Annotated[str, Option(help="importance (the posterior), or laplace, in half the time.")] = "importance",
    aperture: Annotated[bool, Option("--aperture/--no-aperture", help="Looks also read the aperture.")] = False,
    max_minutes: Annotated[float | None, Option(min=0.01, help="Stop after so long; the same command goes on.")] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Simulate a plan many times and fit every campaign. Coverage, power, assurance; run again to go on."""
    from tvsbayes.instrument.plan import read_plan
    from tvsbayes.instrument.rig import read_rig

    finite(max_minutes=max_minutes)
    if engine == "serial":
        refuse_options(
            "for engines with workers", "add --engine processes or dask", workers=workers, scheduler=scheduler
        )
    if engine == "processes":
        refuse_options("for the engine dask", "add --engine dask", scheduler=scheduler)
    if scheduler is not None:
        refuse_options("for a cluster that is started here", "leave it out, or leave out --scheduler", workers=workers)
    check_order(rig, plan_file)
    instrument = read_rig(rig)
    steps = read_plan(plan_file, instrument.table.mechanism)
    from tvsbayes.report.command_text import study_text
    from tvsbayes.statistics.chances import ASSURED
    from tvsbayes.studies.executors import require_engine
    from tvsbayes.studies.rows import StudyRows
    from tvsbayes.studies.study import study as run_study
    from tvsbayes.studies.study_job import ESTIMATORS, StudyJob

    require_engine(engine)
    if estimator not in ESTIMATORS:
        allowed = " and ".join(ESTIMATORS)
        raise InputError("usage", f"--estimator {escaped(estimator)}: allowed are {allowed}", remedy="choose one")
    compile_for(report_line)
    job = StudyJob(instrument, steps, _target_of_study(target, steps[0].made_for, plan_file), seed, aperture, estimator)
    stored = StudyRows(rows or plan_file.with_suffix(".study.jsonl"))
    if damaged := stored.damaged(job.key):
        lines = ", ".join(map(str, damaged))
        report_line(f"warning: {escaped(str(stored.path), 200)}: not as study wrote it, made again: line {lines}")
    missing = n - sum(index < n for index in stored.of(job.key))
    report_line(f"{n} campaigns, {missing} to go on engine {escaped(engine)}; rows in {escaped(str(stored.path), 200)}")
    study_of = partial(run_study, job, n, stored, engine=engine, workers=workers or WORKERS, address=scheduler)
    try:
        with waiting() as progress:
            result = study_of(max_minutes=max_minutes, progress=progress)
    except (KeyboardInterrupt, InputError):
        ran = sum(index < n for index in stored.of(job.key))
        report_line(f"{ran} of {n} campaigns ran and are kept; the same command goes on from there")
        raise
    document = {**result.as_json(), "rows": str(stored.path), "engine": engine, "seed": seed}
    finish(document, study_text(result), as_json)
    if target is not None and result.assurance < ASSURED[0]:
        raise Ended(TARGET_MISSED)


def _target_of_study(target: str | None, made_for: str, plan_file: Path) -> Target:
    """The stated target, that which the plan was made for, or the default."""
    from tvsbayes.planning.target import DEFAULT_TARGET, TARGET_FORMS, parse_target

    if target is not None or not made_for:
        return parse_target(target or DEFAULT_TARGET)
    report_line(f"target, from {escaped(plan_file.name, 200)}: {escaped(made_for, 200)}")
    try:
        return parse_target(made_for)
    except InputError as error:
        file, found = escaped(plan_file.name, 200), escaped(made_for, 120)
        remedy = "state another with --target, or empty the cell"
        refused = refusal("target", file=file, column="made_for", found=found, allowed=TARGET_FORMS, remedy=remedy)
        raise refused from error


def _limits(path: Path) -> dict[str, tuple[float, float]]:
    """Counter limits by axis from [positioner] of a rig file."""
    from tvsbayes.instrument.rig import read_rig

    return read_rig(path).limits.within(dict.fromkeys(AXES, (-math.inf, math.inf)))
