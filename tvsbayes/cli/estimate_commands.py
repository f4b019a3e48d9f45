"""Commands that estimate and compare: classic, fit, compare."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from tvsbayes.cli.app import (
    Anyway,
    CampaignFolder,
    Json,
    Seed,
    command_line,
    finish,
    finish_kept,
    finite,
    refuse_options,
    report_line,
)
from tvsbayes.cli.instruments import refuse_mixed, serve
from tvsbayes.cli.progress_bar import chain_progress, waiting
from tvsbayes.errors import InputError, NothingToEstimate, escaped
from tvsbayes.files.disk import output_place
from tvsbayes.instrument.model_choice import ModelChoice
from tvsbayes.pipeline import FITTING, MAX_MINUTES, StoredOrFitted, calibrate, compile_for
from tvsbayes.progress import Job, Show
from tvsbayes.results.tiers import CHAIN, IMPORTANCE

if TYPE_CHECKING:
    from tvsbayes.estimators.joint_fit import JointFit
    from tvsbayes.instrument.campaign import Campaign
    from tvsbayes.results.comparison_record import ComparisonRecord
    from tvsbayes.results.estimates import FitSummary
HOLDING_OUT = "hold-out"
OVERRIDE_HINT = "--anyway fits it regardless"
"""Hint at a finding of which `check` is certain."""


def _warn_implausible(campaign: Campaign, *, stops: bool = False) -> None:
    """Print findings of `check` on implausible data, for a user who did not run it.

    Raises:
        InputError: `stops`, and a finding is certain.
    """
    from tvsbayes.acquisition.journal_check import behind_journal
    from tvsbayes.estimators.findings import stop_at
    from tvsbayes.estimators.plausibility import implausible

    unwritten = "" if campaign.path is None else behind_journal(campaign.path, campaign)
    if unwritten:
        report_line(f"warning: {unwritten}")
    findings = implausible(campaign)
    for finding in findings:
        if not (stops and finding.certain):
            report_line(f"warning: {finding.sentence}")
    if stops:
        stop_at(findings, OVERRIDE_HINT)


def classic(campaign: CampaignFolder, as_json: Json = False) -> None:
    """The paper's four-point estimator; of a head, least squares."""
    if serve("classic", **locals()):
        return
    from tvsbayes.estimators.four_point import classic as estimate
    from tvsbayes.instrument.campaign import read_campaign
    from tvsbayes.report.fit_text import classic_text

    data = read_campaign(campaign)
    _warn_implausible(data)
    result = estimate(data)
    finish(result.as_json(), classic_text(result), as_json)


def fit(
    campaign: CampaignFolder,
    quick: Annotated[bool, Option("--quick", help="Weighted draws alone, never a chain.")] = False,
    no_sample: Annotated[bool, Option("--no-sample", help="Laplace approximation only.")] = False,
    chain: Annotated[
        bool, Option("--chain", help="Also run a chain of emcee, and say how it agrees with the weighted draws.")
    ] = False,
    max_minutes: Annotated[float | None, Option(min=0.01, help="Time for sampling with a chain (default 10).")] = None,
    resume: Annotated[bool, Option("--resume", help="Continue an earlier chain; implies --chain.")] = False,
    robust: Annotated[bool, Option("--robust", help="Downweight and exclude outlying spots, by name.")] = False,
    per_axis: Annotated[bool, Option("--per-axis", help="One ratio per axis: contrasts fixed at 0.")] = False,
    harmonics: Annotated[bool, Option("--harmonics", help="Free transmission errors of known period.")] = False,
    no_backlash: Annotated[bool, Option("--no-backlash", help="No play: backlash fixed at 0.")] = False,
    perfect_gears: Annotated[
        bool, Option("--perfect-gears", help="No errors by position but stated or freed harmonics; no drift.")
    ] = False,
    anyway: Anyway = False,
    details: Annotated[bool, Option("--details", help="Also print gears, priors and weak directions.")] = False,
    out: Annotated[Path | None, Option("-o", "--out", help="Folder for results (default CAMPAIGN/results).")] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Fit the joint model to every spot and sample its posterior. The table of results ends it."""
    finite(max_minutes=max_minutes)
    if resume and no_sample:
        raise InputError("usage", "--resume continues a chain and --no-sample makes none", remedy="give one of them")
    if no_sample:
        given = {"max_minutes": max_minutes, "quick": quick, "chain": chain}
        refuse_options("for a sampler, and --no-sample runs none", "give one of them", **given)
    if quick:
        refuse_options(
            "for a chain, and --quick makes none",
            "give one of them",
            max_minutes=max_minutes,
            resume=resume,
            chain=chain,
        )
    minutes = MAX_MINUTES if max_minutes is None else max_minutes
    model = {"robust": robust, "per_axis": per_axis, "harmonics": harmonics, "no_backlash": no_backlash}
    model["perfect_gears"] = perfect_gears
    tier = IMPORTANCE if quick else CHAIN if chain or resume else None
    sampling = {"tier": tier, "no_sample": no_sample, "max_minutes": minutes, "resume": resume, "anyway": anyway}
    if serve("fit", campaign, **model, **sampling, details=details, out=out, seed=seed, as_json=as_json):
        return
    from tvsbayes.instrument.campaign import read_campaign

    data = read_campaign(campaign)
    _warn_implausible(data, stops=not anyway)
    from tvsbayes.report.fit_text import assumed_stereo, fit_text

    compile_for(report_line)
    with chain_progress("go on with --resume") as progress:
        results = calibrate(
            data,
            out or output_place(campaign, "results"),
            model=ModelChoice(**model),
            sampled=not no_sample,
            tier=tier,
            max_minutes=minutes,
            resume=resume,
            seed=seed,
            tell=report_line,
            progress=progress,
            first=_print_first,
        )
    summary, files = results.record.summary, results.files
    document = {**summary.as_json(), "seed": seed, "files": files}
    text = fit_text(summary, details, list(files.values()), results.causes)
    budgets = () if results.record.evidence is None else results.record.evidence.budgets
    if budgets and (note := assumed_stereo(data.stereo, budgets)) is not None:
        text = f"{note}\n{text}"
    if results.error is None and out is None:
        text += f"\nnext: {command_line('report', campaign)}"
    finish(document, text, as_json, results.error)


def _print_first(summary: FitSummary) -> None:
    """Print the result of importance sampling on stderr, before the chain that must agree with it."""
    from tvsbayes.report.fit_text import first_text

    for line in first_text(summary, CHAIN).splitlines():
        report_line(line)


def compare(
    campaign: CampaignFolder,
    other: Annotated[Path | None, Argument(metavar="B", help="Later campaign of the same instrument.")] = None,
    by: Annotated[str | None, Option(help="Left out together: steps (default), regions; positions.")] = None,
    seed: Annotated[int | None, Option(min=0, help="Seed of everything random (default 0).")] = None,
    as_json: Json = False,
) -> None:
    """Classic against joint on experiments that were left out.

    The gap between the two estimators term by term; with a later campaign B, what has changed since.
    """
    from tvsbayes.estimators.four_point import select_experiments
    from tvsbayes.instrument.campaign import read_campaign
    from tvsbayes.instrument.copies import refuse_same_looks

    if other is not None:
        refuse_options("for one campaign: with B nothing is left out", "leave it out, or leave out B", by=by, seed=seed)
        refuse_mixed(campaign, other)
    if serve("compare", campaign, other=other, by=by, seed=seed or 0, as_json=as_json):
        return
    if by not in (None, "steps", "regions", "positions"):
        allowed = "steps, regions and positions"
        raise InputError("usage", f"--by {escaped(by)}: allowed are {allowed}", remedy="choose one of them")
    if by == "positions":
        refuse_options("for steps and regions: positions are predicted without draws", "leave it out", seed=seed)
        _compare_positions(campaign, as_json)
        return
    folders = [campaign] if other is None else [campaign, other]
    data = [read_campaign(folder) for folder in folders]
    if other is not None:
        refuse_same_looks(*data)
    if other is None and data[0].rig.mechanism.sightings:
        refuse_options("for spots; of sightings positions are left out", "write --by positions", by=by, seed=seed)
        _compare_pointing(data[0], as_json)
        return
    if other is None and not len(select_experiments(data[0]).experiments):
        raise _no_experiments()
    results = output_place(campaign, "results")
    fit_stages = [f"{FITTING} of {escaped(str(folder), 60)}" for folder in folders]
    stages = dict.fromkeys(fit_stages, 1.0) | {HOLDING_OUT: 0.0 if other else 6.0}
    with waiting() as progress, Job(stages, progress) as job:
        parts = map(job.part, fit_stages)
        fits = [StoredOrFitted(d, report_line, part).fit for d, part in zip(data, parts, strict=True)]
        record = None if other else _classic_against_joint(fits[0], by or "steps", seed or 0, job.part(HOLDING_OUT))
    if record is None:
        from tvsbayes.comparison.changes import compare as compare_fits
        from tvsbayes.report.command_text import changes_text

        changes = compare_fits(*fits)
        finish(changes.as_json(), changes_text(changes), as_json)
        return
    from tvsbayes.report.command_text import gap_text, hold_out_text

    text = f"{gap_text(record.directions)}\n\n{hold_out_text(record.held_out)}"
    finish_kept(record.as_json(), text, results / "compare.json", as_json)


def _compare_positions(campaign: Path, as_json: bool) -> None:
    """Hold out each counter and predict it from the looks at all others."""
    from tvsbayes.comparison.held_positions import hold_out_positions
    from tvsbayes.instrument.campaign import read_campaign
    from tvsbayes.report.command_text import positions_text
    from tvsbayes.results.comparison_record import hold_out_document

    data = read_campaign(campaign)
    with waiting() as progress, Job({FITTING: 1.0, HOLDING_OUT: 6.0}, progress) as job:
        fitted = StoredOrFitted(data, report_line, job.part(FITTING)).fit
        holdout = hold_out_positions(fitted, progress=job.part(HOLDING_OUT))
    finish({**hold_out_document(holdout, "deg"), "files": {}}, positions_text(holdout), as_json)


def _compare_pointing(data: Campaign, as_json: bool) -> None:
    """Print the terms of a head by least squares without gears, and those of the fit."""
    import numpy as np

    from tvsbayes.head.pointing_model import pointing_model
    from tvsbayes.report.head_document import pointing_table

    model = pointing_model(data)
    with waiting() as progress:
        fitted = StoredOrFitted(data, report_line, progress).fit
    centre, sd = np.asarray(fitted.mode.physical), np.asarray(fitted.draws.physical).std(axis=0)
    joint = {n: (float(centre[k]), float(sd[k])) for k, n in enumerate(fitted.names) if n in model.names}
    document = {**model.as_json(), "joint": {name: {"value": v, "sd": u} for name, (v, u) in joint.items()}}
    text = f"{pointing_table(model, joint).text()}\nhow well sightings are predicted: --by positions"
    finish({**document, "files": {}}, text, as_json)


def _no_experiments() -> NothingToEstimate:
    return NothingToEstimate(
        "no-experiments",
        "the campaign has no complete four-point experiment: there is no classic estimate to compare with",
        file="spots.csv",
        remedy="number the looks in the columns experiment and point; without them `tvsbayes fit --details` says what "
        "ratio, backlash and mirrors are, and `compare CAMPAIGN --by positions` how well they predict looks",
    )


def _classic_against_joint(joint: JointFit, by: str, seed: int, progress: Show | None) -> ComparisonRecord:
    """Compute the difference of both estimators term by term, and their predictions of held-out looks.

    Raises:
        NothingToEstimate: no complete experiment gives an angle.
    """
    from tvsbayes.comparison.gap import explain_gap
    from tvsbayes.comparison.held_out import hold_out
    from tvsbayes.instrument.campaign import input_hashes
    from tvsbayes.results.comparison_record import ComparisonRecord

    gaps = explain_gap(joint)
    if not any(gaps.values()):
        raise _no_experiments()
    held_out = hold_out(joint, by, seed, progress=progress)
    return ComparisonRecord(directions=gaps, held_out=held_out, inputs=input_hashes(joint.campaign), seed=seed)
