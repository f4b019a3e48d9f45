"""The pages of a campaign: report, calibrate, which also runs all steps before it, and view."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from typer import Option

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
from tvsbayes.cli.progress_bar import chain_progress, waiting
from tvsbayes.cli.report_page import DRAWING, CertifiedPage, Part, certification_of, print_parts, tolerance_of
from tvsbayes.errors import InputError, NothingToEstimate
from tvsbayes.files.disk import make_folder, output_place, write_atomically
from tvsbayes.instrument.axes import DIRECTIONS
from tvsbayes.pipeline import FITTING, StoredOrFitted, compile_for
from tvsbayes.pipeline import calibrate as calibrate_campaign
from tvsbayes.progress import Job
from tvsbayes.results.tiers import CHAIN, IMPORTANCE

if TYPE_CHECKING:
    from tvsbayes.instrument.campaign import Campaign
    from tvsbayes.metrology.conformity import Tolerance
    from tvsbayes.metrology.dcc import Embedded, Parties
    from tvsbayes.report.document import Document, Issue
    from tvsbayes.results.fit_record import FitRecord

RANGE_MM = 1e3
LIMITED = {**{direction: (direction, "deg/step") for direction in DIRECTIONS}, "xyz": ("xyz", "mm")}
"""Name and unit of what a tolerance of a scanner may limit."""
GATHERING = "gathering evidence"

LimitRatio = Annotated[
    float | None, Option("--limit-deg-per-step", min=0, help="Largest error allowed of any ratio: for a verdict.")
]
LimitMm = Annotated[float | None, Option("--limit-mm", min=0, help="Largest 3D error allowed.")]
Range = Annotated[float, Option("--range-mm", min=1, help="Range at which millimetres are stated.")]
Pdf = Annotated[bool, Option("--pdf", help="Also print to PDF with an installed Chromium.")]
Laboratory = Annotated[str | None, Option("--laboratory", help="Who measured: on the first page.")]
Customer = Annotated[str | None, Option("--customer", help="For whom: on the first page.")]
Quick = Annotated[bool, Option("--quick", help="Weighted draws alone, never a chain: seconds.")]
Schema = Annotated[
    Path | None, Option("--dcc-schema", help="PTB's dcc.xsd on this machine: validate the XML against it.")
]


def report(
    campaign: CampaignFolder,
    quick: Quick = False,
    limit_deg_per_step: LimitRatio = None,
    limit_mm: LimitMm = None,
    range_mm: Range = RANGE_MM,
    pdf: Pdf = False,
    dcc: Annotated[bool, Option("--dcc", help="Also write DCC-schema XML (unsigned, not accredited).")] = False,
    laboratory: Laboratory = None,
    customer: Customer = None,
    country: Annotated[str | None, Option(help="Two letters of the place (ISO 3166-1), for --dcc.")] = None,
    customer_country: Annotated[str | None, Option(help="Two letters of the customer's country, for --dcc.")] = None,
    dcc_schema: Schema = None,
    sign: Annotated[Path | None, Option(help="Private key, PEM: sign the certificate (--dcc).")] = None,
    certificate: Annotated[Path | None, Option(help="Certificate of that key, PEM, for --sign.")] = None,
    tolerance: Annotated[str | None, Option(help="Largest value allowed, such as 15um: conformity.")] = None,
    of: Annotated[
        str | None, Option(help="Axis: A, E, R, B, M, 'A forward' ...; else left, right, up, down, xyz.")
    ] = None,
    rule: Annotated[str | None, Option(help="Decision rule: guarded (default), simple or probability.")] = None,
    guard: Annotated[
        float | None, Option(min=0, help="Guard band in standard uncertainties (2; one-sided 1.65).")
    ] = None,
    out: Annotated[Path | None, Option("-o", "--out", help="HTML file (default CAMPAIGN/results/report.html).")] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """The calibration report as one HTML page. Verdict and results first, then the evidence."""
    finite(limit_deg_per_step=limit_deg_per_step, limit_mm=limit_mm, range_mm=range_mm, guard=guard)
    _check_places(out, pdf, dcc or dcc_schema is not None, force)
    issue = _issue(laboratory, customer)
    countries = {"country": _text("country", country), "customer_country": _text("customer-country", customer_country)}
    stated = {name: text for name, text in countries.items() if text}
    certification = certification_of(dcc, dcc_schema, stated, sign, certificate)
    limits: dict[str, object] = {"limit_deg_per_step": limit_deg_per_step, "limit_mm": limit_mm}
    limits |= {"range_mm": range_mm if range_mm != RANGE_MM else None, "dcc": dcc, "dcc_schema": dcc_schema}
    judged = {"tolerance": tolerance, "of": of, "rule": rule, "guard": guard}
    asked = {"certification": certification if certification.wanted else None}
    limits |= {"quick": quick, "pdf": pdf, "out": out, "as_json": as_json}
    if serve("report", campaign, issue=issue, **limits, **judged, **asked):
        return
    from tvsbayes.instrument.campaign import read_campaign

    wish = tolerance_of(tolerance, of, rule, guard, LIMITED)
    page = ScannerPage(campaign, issue, quick, read_campaign(campaign), limit_deg_per_step, limit_mm, range_mm, wish)
    page.finish(pdf, out, as_json, certification)


def _check_places(out: Path | None, pdf: bool, certified: bool, force: bool) -> None:
    """Refuse a page, its PDF or its certificate in the place of another file."""
    check_output(out, kind="report", force=force)
    if out is None:
        return
    if out.suffix.lower() == ".pdf":
        message, remedy = "-o names the HTML page, and its PDF lies beside it", "write -o NAME.html --pdf"
        raise InputError("usage", message, column="--out", allowed="NAME.html", remedy=remedy)
    from tvsbayes.report.page import certificate_place

    for kind, place, is_made in (
        ("printed report", out.with_suffix(".pdf"), pdf),
        ("certificate", certificate_place(out, out), certified),
    ):
        if is_made:
            check_output(place, kind=kind, force=force)


def _issue(laboratory: str | None, customer: str | None) -> Issue:
    from tvsbayes.report.document import Issue

    return replace(Issue.today(), laboratory=_text("laboratory", laboratory), customer=_text("customer", customer))


def _text(option: str, text: str | None) -> str:
    """The text of an option, "" if not given; an empty text is refused as a mistake."""
    if text is not None and not text.strip():
        remedy = "write the name, or leave the option out: the report says `not stated` then"
        raise InputError("usage", f"--{option} is empty", column=f"--{option}", allowed="a name", remedy=remedy)
    return " ".join((text or "").split())


@dataclass
class ScannerPage(CertifiedPage):
    """The page of a scanner.

    Attributes:
        data: content of the campaign.
        limit_deg_per_step, limit_mm, range_mm: as the options of `report`.
        tolerance: with its decision rule; None where none is stated.
        record: `fit.json`, once the document is made.
    """

    data: Campaign
    limit_deg_per_step: float | None
    limit_mm: float | None
    range_mm: float
    tolerance: Tolerance | None = None
    record: FitRecord = field(init=False)
    stages: ClassVar = {FITTING: 3.0, GATHERING: 1.5, DRAWING: 1.5}

    def document(self, job: Job) -> Document:
        """Gather evidence for a document; fits first where results are missing."""
        from tvsbayes.report.evidence import gather
        from tvsbayes.report.scanner_document import report_document

        fit = StoredOrFitted(self.data, report_line, job.part(FITTING), self.tier)
        self.record, calibration, ratios = fit.reported
        job.begin(GATHERING)
        evidence = gather(
            self.data,
            self.record,
            calibration,
            range_mm=self.range_mm,
            ratios_deg_per_step=ratios,
            limit_deg_per_step=self.limit_deg_per_step,
            limit_mm=self.limit_mm,
            tolerance=self.tolerance,
            doubts=campaign_contents(self.folder, self.data)["warnings"],
        )
        self.criteria = evidence.criteria
        job.begin(DRAWING)
        return report_document(evidence, self.issue)

    def lines(self, number: str, certified: Sequence[str] = ()) -> list[str]:
        """A failed validation, verdicts on the limits, the page's number, its certificate."""
        from tvsbayes.report.evidence import criterion_text
        from tvsbayes.report.fit_text import failed, validation_lines

        validation = failed(self.record.summary)
        tests = [] if validation is None else validation_lines(validation)[:1]
        return [*tests, *map(criterion_text, self.criteria), f"report {number}", *certified]

    def certificate(self, parties: Parties, report: Embedded, signed: bool) -> bytes:
        """DCC-schema XML with the page inside, issued on its day (UTC)."""
        from tvsbayes.metrology.scanner_certificate import dcc_bytes

        issued = self.issue.day
        return dcc_bytes(self.data, self.record, issued=issued, parties=parties, report=report, signed=signed)


def calibrate(
    campaign: CampaignFolder,
    quick: Quick = False,
    no_sample: Annotated[bool, Option("--no-sample", help="Laplace approximation only.")] = False,
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

    page = ScannerPage(campaign, issue, False, read_campaign(campaign), limit_deg_per_step, limit_mm, range_mm)
    print_parts(_parts(page, quick, no_sample, seed, pdf, anyway), as_json)
    if page.missed:
        raise Ended(TARGET_MISSED)


def _parts(content: ScannerPage, quick: bool, no_sample: bool, seed: int, pdf: bool, anyway: bool) -> Iterator[Part]:
    """The parts of `calibrate`; options as of it."""
    from tvsbayes.estimators.findings import stop_at
    from tvsbayes.estimators.four_point import classic
    from tvsbayes.estimators.plausibility import implausible
    from tvsbayes.report.command_text import check_text
    from tvsbayes.report.fit_text import classic_text, fit_text

    campaign, data = content.folder, content.data
    check = campaign_contents(campaign, data)
    yield Part("check", check, check_text(check))
    if not anyway:
        stop_at(implausible(data), OVERRIDE_HINT)
    try:
        four_point = classic(data)
        yield Part("classic", four_point.as_json(), classic_text(four_point))
    except NothingToEstimate as error:
        yield Part("classic", None, f"classic four-point estimator: {error.message}")
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
    yield page.part(content.lines(page.number), content.criteria)


def view(
    campaign: CampaignFolder,
    beside: Annotated[Path | None, Option(metavar="CAMPAIGN", help="A later campaign of the same instrument.")] = None,
    out: Annotated[Path | None, Option("-o", "--out", help="HTML file (default CAMPAIGN/results/view.html).")] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """One HTML file to look at a campaign: rig in 3D, all looks.

    Every look has its pictures and residuals. A double click opens the file in a browser, without a network.
    """
    if serve("view", **locals()) or serve("view", beside):
        return
    folders = [folder for folder in (campaign, beside) if folder is not None]
    check_output(out, kind="page of view", force=force)
    from tvsbayes.view.scene import look_at

    result_scenes = look_at(campaign, beside, report_line)
    from tvsbayes.view.page import document, page_html
    from tvsbayes.view.pictures import PICTURES_BYTES_MAX, look_pictures

    pictures, share = [], PICTURES_BYTES_MAX // len(folders)
    stages = ("pictures", "pictures of the second campaign")[: len(folders)]
    with waiting() as progress, Job(dict.fromkeys(stages, 1.0), progress) as job:
        for folder, scene, stage in zip(folders, result_scenes.scenes, stages, strict=True):
            job.begin(stage)
            pictures.append(look_pictures(folder, scene.looks, share, job.at))
    html = page_html(document(result_scenes, pictures))
    path = out or output_place(campaign, "results") / "view.html"
    if out is None:
        make_folder(path.parent)
    write_atomically(path, html)
    counts = [len(scene.looks.spot) for scene in result_scenes.scenes]
    picture_counts, fitted = [len(chosen) for chosen in pictures], [scene.fitted for scene in result_scenes.scenes]
    result = {"view": str(path), "bytes": len(html), "looks": counts, "pictures": picture_counts, "fitted": fitted}
    notes = "".join(f"note: {note}\n" for scene in result_scenes.scenes for note in scene.notes)
    finish(result, f"{notes}written: {path} ({len(html) / 1e6:.1f} MB); open it in a browser", as_json)
