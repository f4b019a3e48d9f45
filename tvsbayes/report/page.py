"""The calibration report as one page: verdict, numbers and warnings at its top, the sections below; HTML and PDF.

No script, nothing fetched. Text of a campaign reaches it through jinja2's autoescape only; pictures are SVG inside
`data:` images, which browsers open without scripts and without network. Its policy (CSP) allows exactly its own style
sheet, by hash, and such images.
"""

from __future__ import annotations

import base64
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from tvsbayes.errors import InputError
from tvsbayes.files.disk import shipped_data, write_atomically
from tvsbayes.metrology.traceability import traceability
from tvsbayes.report.evidence import MET, NOT_MET, Criterion, Evidence
from tvsbayes.report.fit_sections import (
    identifiability_section,
    residuals_section,
    results_section,
    setup_section,
    validation_section,
)
from tvsbayes.report.fit_text import few_stops_line, suspect_line, validation_lines
from tvsbayes.report.gear_section import gear_section
from tvsbayes.report.tables import Issue, Number, Page, TableView, concise, two_digits
from tvsbayes.report.uncertainty_sections import (
    axes_section,
    budgets_section,
    limits_section,
    maps_section,
    method_section,
    plan_section,
)
from tvsbayes.results.comparison_record import CANNOT_TELL
from tvsbayes.results.estimates import FitSummary

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge")
PDF_SECONDS = 120


def find_browser() -> str:
    """The program that prints pages.

    Raises:
        InputError: none is installed.
    """
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        message = f"--pdf needs one of {', '.join(BROWSERS)} on the path"
        raise InputError("no-browser", message, remedy="print the page from any browser (A4)")
    return browser


def print_to_pdf(page: Path) -> Path:
    """Print a report with an installed Chromium or Chrome; the PDF lies beside it.

    Raises:
        InputError: none is installed, or it failed.
    """
    browser = find_browser()
    target = page.with_suffix(".pdf")
    remedy = f"open {page} in any browser and print it to PDF (A4)"
    with tempfile.TemporaryDirectory(prefix="tvsbayes-") as scratch:
        printed = Path(scratch) / "report.pdf"
        flags = ["--headless", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-sync"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            # Chromium's own walls cannot be built by root; the page is ours and holds no script.
            flags.append("--no-sandbox")
        flags += ["--no-pdf-header-footer", "--generate-pdf-document-outline", f"--user-data-dir={scratch}/profile"]
        command = [browser, *flags, f"--print-to-pdf={printed}", page.resolve().as_uri()]
        try:
            done = subprocess.run(command, capture_output=True, timeout=PDF_SECONDS, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise InputError("pdf", f"{Path(browser).name} did not print the report", remedy=remedy) from error
        if done.returncode or not printed.exists():
            raise InputError("pdf", f"{Path(browser).name} ended with code {done.returncode}", remedy=remedy)
        write_atomically(target, printed.read_bytes())
    return target


def report_html(evidence: Evidence, issue: Issue | None = None) -> bytes:
    """The report, UTF-8.

    Args:
        evidence: computed beforehand; nothing is computed here.
        issue: who issues it, for whom and when; None is today, by nobody.
    """
    return page_html(_page(evidence, issue or Issue.today()))


def page_html(page: Page) -> bytes:
    """A page by the template, UTF-8."""
    folder = shipped_data() / "report"
    environment = Environment(
        loader=FileSystemLoader(str(folder)), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    css = (folder / "report.css").read_text(encoding="utf-8").replace("@ID@", page.report_id)
    digest = base64.b64encode(hashlib.sha256(css.encode()).digest()).decode()
    policy = f"default-src 'none'; img-src data:; style-src 'sha256-{digest}'; base-uri 'none'; form-action 'none'"
    # The style sheet is ours; escaped quotes would change its hash.
    html = environment.get_template("report.html").render(r=page, css=Markup(css), policy=policy)
    return html.encode()


def _page(e: Evidence, issue: Issue) -> Page:
    verdict = verdict_of(e.fit.summary, e.criteria)
    sections = [
        setup_section(e),
        results_section(e),
        *gear_section(e),
        identifiability_section(e),
        residuals_section(e),
        validation_section(e),
        maps_section(e),
        budgets_section(e),
        axes_section(e),
        plan_section(e),
        method_section(e),
        limits_section(e),
    ]
    rows = [[c.quantity, f"{c.limit:.3g} {c.unit}", f"{c.probability:.3f}", c.verdict] for c in e.criteria]
    criteria = None
    if rows:
        caption = "Decision rule: met if P(|error| <= limit) >= 0.95, not met if <= 0.05, else cannot tell"
        criteria = TableView(caption, ["error of", "limit", "probability", "verdict"], rows)
    return Page(
        report_id=e.fit.report_id,
        name=str(e.campaign.header.get("name") or "campaign without a name"),
        verdict=verdict.text,
        verdict_class=verdict.kind,
        numbers=_numbers(e),
        criteria=criteria,
        traceable=traceability(e.campaign).statement,
        warnings=_warnings(e),
        versions=e.fit.provenance.versions,
        sections=sections,
        issue=issue,
    )


@dataclass(frozen=True)
class Verdict:
    """One line, and the class that colours it: "met", "not-met" or "cannot-tell"."""

    text: str
    kind: str


def verdict_of(summary: FitSummary, criteria: Sequence[Criterion]) -> Verdict:
    """What the page says first: whether its numbers may be used, and whether the limits are met."""
    if not summary.converged:
        return Verdict("NOT CONVERGED: the numbers below must not be used", "not-met")
    validation = summary.validation
    failed = "" if validation is None or validation.passed else validation_lines(validation)[0] + ". "
    if failed and not criteria:
        return Verdict(f"{failed}No limit was stated", "cannot-tell")
    if not criteria:
        text = "No limit was stated: the results below are without a verdict (state one with --limit-deg-per-step or "
        return Verdict(f"{text}--limit-mm)", "cannot-tell")
    told = []
    for verdict in (NOT_MET, CANNOT_TELL, MET):
        mine = [c for c in criteria if c.verdict == verdict]
        limits = dict.fromkeys((c.limit, c.unit) for c in mine)
        for limit, unit in limits:
            part = [c for c in mine if (c.limit, c.unit) == (limit, unit)]
            least = min(c.probability for c in part)
            names = ", ".join(c.quantity for c in part)
            told.append((verdict, f"{verdict}: {names} within {limit:.3g} {unit} (P at least {least:.3f})"))
    text = "; ".join(sentence for _, sentence in told)
    judged = "With that factor: " if failed else ""
    return Verdict(failed + judged + text[0].upper() + text[1:], told[0][0].replace(" ", "-"))


def _numbers(e: Evidence) -> list[Number]:
    """Worst ratio, how far off the classic is, millimetres at the stated range."""
    ratios = {d: x for d, x in e.fit.summary.effective.items() if x is not None}
    numbers = []
    if ratios:
        half = {d: 0.5 * (x.interval95[1] - x.interval95[0]) for d, x in ratios.items()}
        worst = max(half, key=lambda d: half[d])
        x, u = ratios[worst], half[worst]
        note = f"effective deg/step; 95 % interval +- {two_digits(u)}" if x.sd > 0 else "fixed"
        validation = e.fit.summary.validation
        if validation is not None and validation.inflation > 1:
            factor = validation.inflation
            note += f"; validation failed: use {factor:.2f} times that, {two_digits(factor * u)}"
        numbers.append(Number(f"least certain ratio: {worst}", concise(x.value, x.sd), note))
    if e.classic is not None and ratios:
        off = {
            d: 100 * (r.mean_deg_per_step / ratios[d].value - 1)
            for d, r in e.classic.directions.items()
            if r is not None and d in ratios
        }
        if off:
            worst = max(off, key=lambda d: abs(off[d]))
            numbers.append(Number(f"classic mean, {worst}", f"{off[worst]:+.1f} %", "away from the joint estimate"))
    if len(numbers) < 2:
        numbers.append(Number("classic mean", "not applicable", "no complete four-point experiment"))
    below = {name: float(np.quantile(v, 0.95)) for name, v in e.distances_mm.items()}
    others = ", ".join(f"{name} {_mm(value)}" for name, value in below.items() if name != "joint")
    note = f"95 % of 3D errors stay below this; {others}"
    numbers.append(Number(f"joint, {e.range_mm:g} mm away", _mm(below["joint"]), note))
    return numbers


def _mm(value: float) -> str:
    return f"{two_digits(value)} mm" if value < 100 else f"{value:.0f} mm"


def _warnings(e: Evidence) -> list[str]:
    summary = e.fit.summary
    found = list(summary.problems)
    if summary.validation is not None and not summary.validation.passed:
        found += validation_lines(summary.validation)
    if summary.estimator == "laplace":
        found.append(
            "Intervals are those of the Laplace approximation at the mode; with few stops of a direction that of the "
            "backlash is too short. The command fit without --no-sample samples the posterior."
        )
    if e.campaign.header.get("synthetic"):
        found.append("The campaign is synthetic: made by the digital twin, not measured.")
    if e.campaign.stereo.assumed:
        found.append("The stereo calibration's covariance is assumed, not estimated.")
    found += [f"Prior conflict: {text}" for text in summary.prior_conflicts]
    lines = []
    if summary.few_stops:
        lines.append(few_stops_line(summary.few_stops, summary.estimator))
    if summary.suspect_spots:
        lines.append(suspect_line(summary.suspect_spots))
    return found + [f"{line[0].upper()}{line[1:]}." for line in lines]
