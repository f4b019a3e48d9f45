"""Classic, fit, report, compare."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tvsbayes.cli.app import (
    TARGET_MISSED,
    CampaignFolder,
    Ended,
    Json,
    Seed,
    finish,
    keep,
    report_line,
    unusable,
)
from tvsbayes.errors import InputError, NothingToEstimate, escaped
from tvsbayes.files.disk import make_folder, output_place, write_atomically
from tvsbayes.pipeline import compile_for, document_for, evidence_of, fit_for

if TYPE_CHECKING:
    from tvsbayes.instrument.campaign import Campaign
    from tvsbayes.posterior.sampling import Progress


DCC_MESSAGES = 20
"""Of a schema validator, shown at most."""


def _warn_of(campaign: Campaign) -> None:
    """What `check` says of data that no rig can have measured, for whoever did not ask it first."""
    from tvsbayes.estimators.plausibility import implausible

    for sentence in implausible(campaign):
        report_line(f"warning: {sentence}")


def classic(campaign: CampaignFolder, as_json: Json = False) -> None:
    """The paper's four-point estimator. Mean, sd, type A and GUM uncertainty per direction."""
    from tvsbayes.estimators.four_point import classic as estimate
    from tvsbayes.instrument.campaign import read_campaign
    from tvsbayes.report.fit_text import classic_text

    data = read_campaign(campaign)
    _warn_of(data)
    result = estimate(data)
    skipped = [f"experiment {s.experiment} skipped: {s.reason}" for s in result.skipped]
    finish(result.as_json(), "\n".join([classic_text(result), *skipped]), as_json)


def fit(
    campaign: CampaignFolder,
    no_sample: Annotated[bool, typer.Option("--no-sample", help="Laplace approximation only.")] = False,
    max_minutes: Annotated[
        float, typer.Option("--max-minutes", min=0.01, help="Time for sampling; unconverged by then: exit 4.")
    ] = 10.0,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the chain of an earlier run.")] = False,
    robust: Annotated[bool, typer.Option("--robust", help="Downweight and exclude outlying spots, by name.")] = False,
    per_axis: Annotated[bool, typer.Option("--per-axis", help="One ratio per axis: contrasts fixed at 0.")] = False,
    harmonics: Annotated[bool, typer.Option("--harmonics", help="Free transmission errors of known period.")] = False,
    no_backlash: Annotated[bool, typer.Option("--no-backlash", help="No play: backlash fixed at 0.")] = False,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for results (default CAMPAIGN/results).")] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Fit the joint model to every spot and sample its posterior. Ratios, backlash, mirror offset, extrinsics."""
    from tvsbayes.instrument.campaign import read_campaign

    if resume and no_sample:
        raise InputError("usage", "--resume continues a chain and --no-sample makes none", remedy="give one of them")
    data = read_campaign(campaign)
    _warn_of(data)
    from tvsbayes.assessment.fitted_calibration import DRAWS_KEPT, calibration_of
    from tvsbayes.assessment.summary import summarise
    from tvsbayes.estimators.joint_fit import fit as fit_joint
    from tvsbayes.instrument.model_choice import ModelChoice
    from tvsbayes.report.fit_text import fit_text
    from tvsbayes.results.fit_record import write_results

    compile_for(report_line)
    folder = out or output_place(campaign, "results")
    model = ModelChoice(robust=robust, per_axis=per_axis, harmonics=harmonics, no_backlash=no_backlash)
    result = fit_joint(data, model=model, seed=seed)
    summary, posterior, more = summarise(result), None, {}
    # A sample of what must not be used anyway would only take the user's time.
    if not no_sample and unusable(summary) is None:
        from tvsbayes.posterior.arviz_tree import write_posterior
        from tvsbayes.posterior.sampling import sample

        make_folder(folder)
        with _sampling_progress() as progress:
            posterior = sample(
                result,
                max_minutes=max_minutes,
                seed=seed,
                checkpoint=folder / "chain.npz",
                resume=resume,
                progress=progress,
            )
        summary = summarise(result, posterior)
        if posterior.converged:
            report_line("computing log likelihoods and predictions for posterior.nc ...")
            write_posterior(posterior, folder / "posterior.nc")
            more = {"posterior": str(folder / "posterior.nc")}
        more["chain"] = str(folder / "chain.npz")
    stale = folder / "posterior.nc"
    if "posterior" not in more and stale.exists():
        stale.unlink()
        report_line("posterior.nc of an earlier fit is removed: it would not be that of fit.json")
    calibration = calibration_of(result, posterior, seed=seed) if result.converged else None
    draws = posterior.thinned(DRAWS_KEPT) if summary.estimator == "posterior" else None
    usable = posterior if summary.estimator == "posterior" else None
    physical = (result.draws if draws is None else draws).physical
    files = {
        **write_results(
            result,
            summary,
            folder,
            seed,
            calibration,
            draws,
            evidence_of(result, summary, usable, calibration, physical),
        ),
        **more,
    }
    document = {**summary.as_json(), "seed": seed, "files": files}
    finish(document, f"{fit_text(summary)}\nwritten: {', '.join(files.values())}", as_json, unusable(summary))


def report(
    campaign: CampaignFolder,
    limit_deg_per_step: Annotated[
        float | None,
        typer.Option("--limit-deg-per-step", min=0, help="Largest error allowed of any ratio: for a verdict."),
    ] = None,
    limit_mm: Annotated[float | None, typer.Option("--limit-mm", min=0, help="Largest 3D error allowed.")] = None,
    range_mm: Annotated[float, typer.Option("--range-mm", min=1, help="Range at which millimetres are stated.")] = 1e3,
    pdf: Annotated[bool, typer.Option("--pdf", help="Also print to PDF with an installed Chromium.")] = False,
    dcc: Annotated[bool, typer.Option("--dcc", help="Also write DCC-schema XML (unsigned, not accredited).")] = False,
    laboratory: Annotated[str, typer.Option("--laboratory", help="Who measured, for --dcc.")] = "not stated",
    customer: Annotated[str, typer.Option("--customer", help="For whom, for --dcc.")] = "not stated",
    country: Annotated[str, typer.Option("--country", help="ISO 3166-1 code of the place, for --dcc.")] = "ZZ",
    dcc_schema: Annotated[
        Path | None, typer.Option("--dcc-schema", help="PTB's dcc.xsd on this machine: validate the XML against it.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="File (default CAMPAIGN/results/report.html).")] = None,
    as_json: Json = False,
) -> None:
    """The calibration report as one HTML page. Verdict, results, residuals, error maps, budgets, provenance."""
    from tvsbayes.calibration.calibration_file import load_calibration
    from tvsbayes.instrument.campaign import read_campaign

    data = read_campaign(campaign)
    results = output_place(campaign, "results")
    from tvsbayes.report.fit_text import validation_lines
    from tvsbayes.report.page import find_browser, print_to_pdf, report_html

    if pdf:
        find_browser()
    document = document_for(data, campaign, report_line)
    from tvsbayes.metrology.dcc import check_dcc, dcc_bytes
    from tvsbayes.report.evidence import gather

    limits = {"limit_deg_per_step": limit_deg_per_step, "limit_mm": limit_mm}
    evidence = gather(data, document, load_calibration(campaign), range_mm=range_mm, **limits)
    path = out or results / "report.html"
    write_atomically(path, report_html(evidence))
    files = {"report": str(path)}
    if pdf:
        files["pdf"] = str(print_to_pdf(path))
    if dcc or dcc_schema:
        certificate = results / "dcc.xml"
        places = {"laboratory": laboratory, "customer": customer, "country": country}
        today = datetime.datetime.now(datetime.UTC).date()
        content = dcc_bytes(data, document, issued=today, report=path.read_bytes(), **places)
        write_atomically(certificate, content)
        files["dcc"] = str(certificate)
    checked = check_dcc(content, dcc_schema) if dcc_schema else None
    lines = [
        f"{c.quantity} within {c.limit:g} {c.unit}: {c.verdict} (P = {c.probability:.3f})" for c in evidence.criteria
    ]
    result: dict[str, Any] = {"criteria": [asdict(c) for c in evidence.criteria], "files": files}
    if checked is not None:
        verdict = {True: "valid", False: "NOT VALID", None: "could not be checked"}[checked.valid]
        lines += [f"DCC by {checked.tool} against {dcc_schema}: {verdict}", *checked.messages[:DCC_MESSAGES]]
        result["dcc_schema"] = asdict(checked)
    validation = document.get("validation")
    if validation is not None and not validation["passed"]:
        lines.insert(0, validation_lines(validation)[0])
    text = "\n".join([*lines, f"written: {', '.join(files.values())}"])
    finish(result, text, as_json)
    if any(c.verdict != "met" for c in evidence.criteria) or (checked is not None and not checked.valid):
        raise Ended(TARGET_MISSED)


def compare(
    campaign: CampaignFolder,
    other: Annotated[Path | None, typer.Argument(metavar="B", help="Later campaign of the same instrument.")] = None,
    by: Annotated[str, typer.Option("--by", help="Left out together: steps or regions.")] = "steps",
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Classic against joint on experiments that were left out.

    The gap between the two estimators term by term; with a later campaign B, what has changed since.
    """
    from tvsbayes.instrument.campaign import input_hashes, read_campaign

    if by not in ("steps", "regions"):
        raise InputError("usage", f"--by {escaped(by)}: allowed are steps and regions", remedy="choose one of them")
    data = [read_campaign(folder) for folder in (campaign, *([other] if other is not None else ()))]
    results = output_place(campaign, "results")
    from tvsbayes.report.command_text import changes_text, gap_text, hold_out_text

    fits = [fit_for(each, report_line) for each in data]
    from tvsbayes.comparison.changes import compare as compare_fits
    from tvsbayes.comparison.gap import explain_gap
    from tvsbayes.comparison.held_out import hold_out

    if other is not None:
        changes = compare_fits(*fits)
        finish(changes.as_json(), changes_text(changes), as_json)
        return
    gaps = explain_gap(fits[0])
    if not any(gaps.values()):
        raise NothingToEstimate(
            "no-experiments",
            "the campaign has no complete four-point experiment: there is no classic estimate to compare with",
            file="spots.csv",
            remedy="number the looks in the columns experiment and point, or use `tvsbayes fit`",
        )
    held = hold_out(fits[0], by, seed)
    document = {
        "kind": "classic against joint",
        "format": "tvsbayes-compare/1",
        "estimator": "laplace",
        "directions": {name: None if gap is None else asdict(gap) for name, gap in gaps.items()},
        "held_out": held.as_json(),
        "inputs": input_hashes(data[0]),
        "seed": seed,
    }
    files, text = {}, f"{gap_text(gaps)}\n\n{hold_out_text(held)}"
    if keep(document, path := results / "compare.json"):
        files, text = {"compare": str(path)}, f"{text}\nwritten: {path}"
    finish({**document, "files": files}, text, as_json)


@contextmanager
def _sampling_progress() -> Iterator[Callable[[Progress], None]]:
    """A bar on a terminal, nothing elsewhere; Ctrl-C says how to go on."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    console, kept = Console(stderr=True), False
    columns = TextColumn("sampling"), BarColumn(), TextColumn("{task.fields[note]}"), TimeElapsedColumn()
    try:
        with Bar(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
            task = bar.add_task("sampling", total=None, note="preparing")

            def show(state: Progress) -> None:
                nonlocal kept
                kept = True
                ess = "" if state.worst_ess is None else f", least effective draws {state.worst_ess:.0f}"
                note = f"step {state.steps}{ess}, next look in {max(state.seconds_left, 0):.0f} s"
                bar.update(task, completed=state.steps, total=state.expected_steps, note=note)

            yield show
    except KeyboardInterrupt:
        # Before the first block of steps there is no chain to keep.
        if kept:
            report_line("the chain so far is kept in chain.npz; go on with --resume")
        raise
