"""The commands report, and calibrate, which also runs all steps before the report.

Reads options, calls the library, prints a table or JSON; heavy imports are inside the commands.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tvsbayes.cli.app import (
    TARGET_MISSED,
    Anyway,
    CampaignFolder,
    Ended,
    Force,
    Json,
    Seed,
    check_output,
    command_line,
    finish,
    finite,
    refuse_options,
    report_line,
)
from tvsbayes.cli.campaign_commands import campaign_contents
from tvsbayes.cli.estimate_commands import OVERRIDE_HINT
from tvsbayes.cli.instruments import serve
from tvsbayes.cli.progress_bar import chain_progress
from tvsbayes.cli.report_options import certification_of, parties_of, tolerance_of
from tvsbayes.cli.report_page import DRAWING, Part, WrittenPage, print_parts, written_page
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.files.disk import output_place
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.pipeline import FITTING, StoredOrFitted, compile_for
from tvsbayes.pipeline import calibrate as calibrate_campaign
from tvsbayes.progress import Job
from tvsbayes.results.tiers import CHAIN, IMPORTANCE

if TYPE_CHECKING:
    from tvsbayes.instrument.campaign import Campaign
    from tvsbayes.metrology.conformity import Tolerance
    from tvsbayes.metrology.dcc import Embedded
    from tvsbayes.report.document import Document, Issue
    from tvsbayes.report.evidence import Evidence
    from tvsbayes.results.fit_record import FitRecord

RANGE_MM = 1e3
LIMITED = {**{direction: (direction, "deg/step") for direction in DIRECTIONS}, "xyz": ("xyz", "mm")}
"""Name and unit of what a tolerance of a scanner may limit."""
GATHERING = "gathering evidence"

LimitRatio = Annotated[
    float | None, typer.Option("--limit-deg-per-step", min=0, help="Largest error allowed of any ratio: for a verdict.")
]
LimitMm = Annotated[float | None, typer.Option("--limit-mm", min=0, help="Largest 3D error allowed.")]
Range = Annotated[float, typer.Option("--range-mm", min=1, help="Range at which millimetres are stated.")]
Pdf = Annotated[bool, typer.Option("--pdf", help="Also print to PDF with an installed Chromium.")]
Laboratory = Annotated[str | None, typer.Option("--laboratory", help="Who measured: on the first page.")]
Customer = Annotated[str | None, typer.Option("--customer", help="For whom: on the first page.")]
Quick = Annotated[bool, typer.Option("--quick", help="Weighted draws alone, never a chain: seconds.")]
Schema = Annotated[
    Path | None, typer.Option("--dcc-schema", help="PTB's dcc.xsd on this machine: validate the XML against it.")
]


def report(
    campaign: CampaignFolder,
    quick: Quick = False,
    limit_deg_per_step: LimitRatio = None,
    limit_mm: LimitMm = None,
    range_mm: Range = RANGE_MM,
    pdf: Pdf = False,
    dcc: Annotated[bool, typer.Option("--dcc", help="Also write DCC-schema XML (unsigned, not accredited).")] = False,
    laboratory: Laboratory = None,
    customer: Customer = None,
    country: Annotated[
        str | None, typer.Option("--country", help="Two letters of the place (ISO 3166-1), for --dcc.")
    ] = None,
    customer_country: Annotated[
        str | None, typer.Option("--customer-country", help="Two letters of the customer's country, for --dcc.")
    ] = None,
    dcc_schema: Schema = None,
    sign: Annotated[Path | None, typer.Option("--sign", help="Private key, PEM: sign the certificate (--dcc).")] = None,
    certificate: Annotated[
        Path | None, typer.Option("--certificate", help="Certificate of that key, PEM, for --sign.")
    ] = None,
    tolerance: Annotated[
        str | None,
        typer.Option("--tolerance", help="Largest value allowed, such as 15um: conformity."),
    ] = None,
    of: Annotated[
        str | None,
        typer.Option("--of", help="Axis: A, E, R, B, M, 'A forward' ...; else left, right, up, down, xyz."),
    ] = None,
    rule: Annotated[
        str | None, typer.Option("--rule", help="Decision rule: guarded (default), simple or probability.")
    ] = None,
    guard: Annotated[
        float | None, typer.Option("--guard", min=0, help="Guard band in standard uncertainties (2; one-sided 1.65).")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="HTML file (default CAMPAIGN/results/report.html).")
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """The calibration report as one HTML page. Verdict and results first, then the evidence."""
    from tvsbayes.instrument.campaign import read_campaign

    finite(limit_deg_per_step=limit_deg_per_step, limit_mm=limit_mm, range_mm=range_mm, guard=guard)
    check_output(out, kind="report", force=force)
    if out is not None and out.suffix.lower() == ".pdf":
        message, remedy = "-o names the HTML page, and its PDF lies beside it", "write -o NAME.html --pdf"
        raise InputError("usage", message, column="--out", allowed="NAME.html", remedy=remedy)
    if out is not None:
        from tvsbayes.report.page import certificate_place

        beside = {"printed report": out.with_suffix(".pdf") if pdf else None}
        beside["certificate"] = certificate_place(out, out) if dcc or dcc_schema else None
        for kind, place in beside.items():
            check_output(place, kind=kind, force=force and place is not None)
    issue = _issue(laboratory, customer)
    certification = certification_of(dcc, dcc_schema, _countries(country, customer_country), sign, certificate)
    limits: dict[str, object] = {"limit_deg_per_step": limit_deg_per_step, "limit_mm": limit_mm}
    limits |= {"range_mm": range_mm if range_mm != RANGE_MM else None, "dcc": dcc, "dcc_schema": dcc_schema}
    judged = {"tolerance": tolerance, "of": of, "rule": rule, "guard": guard}
    asked = {"certification": certification if certification.wanted else None}
    limits |= {"quick": quick, "pdf": pdf, "out": out, "as_json": as_json}
    if serve("report", campaign, issue=issue, **limits, **judged, **asked):
        return
    wish = tolerance_of(tolerance, of, rule, guard, LIMITED)
    data = read_campaign(campaign)
    content = PageContent(campaign, data, issue, limit_deg_per_step, limit_mm, range_mm, quick, wish)
    page = content.written(pdf, out)
    missed, lines, result = content.missed, content.lines(page), page.as_json(content.evidence.criteria)
    if certification.wanted:
        done = certification.written(page, out, partial(content.certificate, certification.countries))
        missed, lines, result = missed or done.missed, [*lines, *done.lines], result | done.result
    page.report_removed(certificates=True)
    finish(result, "\n".join([*lines, f"written: {', '.join(page.files.values())}"]), as_json)
    if missed:
        raise Ended(TARGET_MISSED)


def _issue(laboratory: str | None, customer: str | None) -> Issue:
    from tvsbayes.report.document import Issue

    return replace(Issue.today(), laboratory=_text("laboratory", laboratory), customer=_text("customer", customer))


def _text(option: str, text: str | None) -> str:
    """The text of an option, "" if not given; an empty text is refused as a mistake."""
    if text is not None and not text.strip():
        remedy = "write the name, or leave the option out: the report says `not stated` then"
        raise InputError("usage", f"--{option} is empty", column=f"--{option}", allowed="a name", remedy=remedy)
    return " ".join((text or "").split())


def _countries(place: str | None, customer: str | None) -> dict[str, str]:
    """Stated countries by their field of `Parties`."""
    stated = {"country": _text("country", place), "customer_country": _text("customer-country", customer)}
    return {name: text for name, text in stated.items() if text}


@dataclass
class PageContent:
    """What the page of a scanner shows; `record` and `evidence` are there once it is written.

    Attributes:
        campaign, data: folder and content of the campaign.
        issue, limit_deg_per_step, limit_mm, range_mm, quick: as the options of `report`.
        tolerance: with its decision rule; None where none is stated.
        record, evidence: sources of the page.
    """

    campaign: Path
    data: Campaign
    issue: Issue
    limit_deg_per_step: float | None
    limit_mm: float | None
    range_mm: float
    quick: bool = False
    tolerance: Tolerance | None = None
    record: FitRecord = field(init=False)
    evidence: Evidence = field(init=False)

    def written(self, pdf: bool, out: Path | None = None) -> WrittenPage:
        """Write the page; options as of `report`."""
        stages = {FITTING: 3.0, GATHERING: 1.5, DRAWING: 1.5}
        return written_page(self.campaign, out, pdf, stages, self._document)

    def _document(self, job: Job) -> Document:
        """Gather evidence for a document; fits first where results are missing."""
        from tvsbayes.report.evidence import gather
        from tvsbayes.report.scanner_document import report_document

        tier = IMPORTANCE if self.quick else CHAIN
        self.record, calibration, ratios = StoredOrFitted(self.data, report_line, job.part(FITTING), tier).reported
        job.begin(GATHERING)
        warnings = campaign_contents(self.campaign, self.data)["warnings"]
        self.evidence = gather(
            self.data,
            self.record,
            calibration,
            range_mm=self.range_mm,
            ratios_deg_per_step=ratios,
            limit_deg_per_step=self.limit_deg_per_step,
            limit_mm=self.limit_mm,
            tolerance=self.tolerance,
            doubts=warnings,
        )
        job.begin(DRAWING)
        return report_document(self.evidence, self.issue)

    @property
    def missed(self) -> bool:
        """Whether a limit that the user gave is not met."""
        from tvsbayes.report.evidence import SATISFIED

        return any(c.verdict not in SATISFIED for c in self.evidence.criteria)

    def lines(self, page: WrittenPage) -> list[str]:
        """Verdicts on the limits and the page's number, for a terminal."""
        from tvsbayes.report.evidence import criterion_text
        from tvsbayes.report.fit_text import validation_lines

        lines = [criterion_text(c) for c in self.evidence.criteria]
        validation = self.record.summary.validation
        failed = validation is not None and not validation.passed
        tests = validation_lines(validation)[:1] if validation is not None and failed else []
        return [*tests, *lines, f"report {page.number}"]

    def certificate(self, countries: Mapping[str, str], report: Embedded, signed: bool) -> bytes:
        """DCC-schema XML with the page inside, issued on its day (UTC)."""
        from tvsbayes.metrology.scanner_certificate import dcc_bytes

        parties, issued = parties_of(self.issue, countries), self.issue.day
        return dcc_bytes(self.data, self.record, issued=issued, parties=parties, report=report, signed=signed)


def calibrate(
    campaign: CampaignFolder,
    quick: Quick = False,
    no_sample: Annotated[bool, typer.Option("--no-sample", help="Laplace approximation only.")] = False,
    limit_deg_per_step: LimitRatio = None,
    limit_mm: LimitMm = None,
    range_mm: Range = RANGE_MM,
    pdf: Pdf = False,
    laboratory: Laboratory = None,
    customer: Customer = None,
    anyway: Anyway = False,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Check, classic, fit and report in one go. From a campaign folder to the report."""
    finite(limit_deg_per_step=limit_deg_per_step, limit_mm=limit_mm, range_mm=range_mm)
    if no_sample:
        refuse_options("for a sampler, and --no-sample runs none", "give one of them", quick=quick)
    issue = _issue(laboratory, customer)
    if pdf:
        from tvsbayes.report.page import find_browser

        # A missing browser is found before the fit, which takes minutes.
        find_browser()
    limits = {"limit_deg_per_step": limit_deg_per_step, "limit_mm": limit_mm, "anyway": anyway}
    limits["range_mm"] = range_mm if range_mm != RANGE_MM else None
    sampling = {"quick": quick, "no_sample": no_sample, "seed": seed}
    if serve("calibrate", campaign, issue=issue, **sampling, pdf=pdf, as_json=as_json, **limits):
        return
    from tvsbayes.instrument.campaign import read_campaign

    content = PageContent(campaign, read_campaign(campaign), issue, limit_deg_per_step, limit_mm, range_mm)
    print_parts(_parts(content, quick, no_sample, seed, pdf, anyway), as_json)
    if content.missed:
        raise Ended(TARGET_MISSED)


def _parts(content: PageContent, quick: bool, no_sample: bool, seed: int, pdf: bool, anyway: bool) -> Iterator[Part]:
    """The parts of `calibrate`; options as of it."""
    from tvsbayes.estimators.findings import stop_at
    from tvsbayes.estimators.plausibility import implausible
    from tvsbayes.report.command_text import check_text
    from tvsbayes.report.fit_text import fit_text

    campaign, data = content.campaign, content.data
    check = campaign_contents(campaign, data)
    yield Part("check", check, check_text(check))
    if not anyway:
        stop_at(implausible(data), OVERRIDE_HINT)
    yield _classic(data)
    compile_for(report_line)
    with chain_progress(f"go on with `{command_line('fit', campaign)} --resume`") as progress:
        results = calibrate_campaign(
            data,
            output_place(campaign, "results"),
            sampled=not no_sample,
            tier=IMPORTANCE if quick else CHAIN,
            seed=seed,
            tell=report_line,
            progress=progress,
        )
    summary = results.record.summary
    text = fit_text(summary, written=list(results.files.values()), causes=results.causes)
    yield Part("fit", {**summary.as_json(), "seed": seed, "files": results.files}, text, results.error)
    page = content.written(pdf)
    page.report_removed(certificates=True)
    yield page.part(content.lines(page), content.evidence.criteria)


def _classic(data: Campaign) -> Part:
    """The part of the four-point estimator; without a complete experiment the reason in place of a document."""
    from tvsbayes.estimators.four_point import classic
    from tvsbayes.report.fit_text import classic_text

    try:
        result = classic(data)
    except NothingToEstimate as error:
        return Part("classic", None, f"classic four-point estimator: {error.message}")
    return Part("classic", result.as_json(), classic_text(result))
