"""The calibration report as one page: verdict, numbers and warnings at its top, the sections below; HTML and PDF.

No script, nothing fetched. Text of a campaign reaches it through jinja2's autoescape only; pictures are SVG inside
`data:` images, which browsers open without scripts and without network. Its policy (CSP) allows exactly its own style
sheet, by hash, and such images.
"""

from __future__ import annotations

import base64
import hashlib
import os
import re
import shutil
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from tvsbayes.errors import InputError, typed
from tvsbayes.estimators.plausibility import misfit_causes
from tvsbayes.files.disk import make_folder, read_bytes, shipped_data, write_atomically
from tvsbayes.metrology.traceability import traceability
from tvsbayes.report.advice import steps_ahead
from tvsbayes.report.evidence import MET, Evidence
from tvsbayes.report.first_page import (
    about_table,
    answer_table,
    both_estimators,
    criteria_table,
    distances,
    measured_days,
    verdict_of,
    warnings_of,
    why_far,
)
from tvsbayes.report.fit_sections import (
    identifiability_section,
    residuals_section,
    results_section,
    setup_section,
    validation_section,
)
from tvsbayes.report.gear_section import gear_section
from tvsbayes.report.tables import Issue, Page
from tvsbayes.report.uncertainty_sections import (
    axes_section,
    budgets_section,
    limits_section,
    maps_section,
    method_section,
    plan_section,
)

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge")
NO_BROWSER = "leave --pdf out and print report.html from any browser (A4), or install Chromium"
PDF_SECONDS = 120
NUMBER_DIGITS = 12
PAGE_BYTES_MAX = 64 * 1024 * 1024
GENERATOR = b'<meta name="generator" content="tvsbayes '
"""In the head of every page of ours."""


def find_browser() -> str:
    """The program that prints pages.

    Raises:
        InputError: none is installed.
    """
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        message = f"--pdf needs one of {', '.join(BROWSERS)} on the path"
        raise InputError("no-browser", message, remedy=NO_BROWSER)
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


def report_page(evidence: Evidence, issue: Issue | None = None) -> Page:
    """The report with its number.

    Args:
        evidence: computed beforehand; nothing is computed here.
        issue: who issues it, for whom and when; None is today, by nobody.
    """
    return numbered(_page(evidence, issue or Issue.today()))


def report_html(evidence: Evidence, issue: Issue | None = None) -> bytes:
    """The report, UTF-8; arguments as of `report_page`."""
    return page_html(report_page(evidence, issue))


def certificate_place(page: Path, out: Path | None) -> Path:
    """Where the certificate of a page lies: `dcc.xml` in `results/`, beside a page elsewhere by its name."""
    return page.with_name("dcc.xml" if out is None else f"{page.stem}.dcc.xml")


def replace_page(page: Path, html: bytes, out: Path | None) -> list[str]:
    """Write a page, and remove what was made of another one that stood there: its PDF and its certificate.

    Args:
        page: where to; `results/` is made where it is missing.
        html: its bytes; of the very page that stands there already nothing is removed.
        out: as the user named it; there only what lies beside a page of ours is ours.

    Returns:
        Names of what was removed.

    Raises:
        InputError: the folder cannot be written.
    """
    try:
        before = read_bytes(page, PAGE_BYTES_MAX)
    except InputError:
        before = b""
    removed = []
    if before != html and (out is None or GENERATOR in before):
        for follower in (page.with_suffix(".pdf"), certificate_place(page, out)):
            if follower.is_file():
                follower.unlink()
                removed.append(follower.name)
    if out is None:
        make_folder(page.parent)
    write_atomically(page, html)
    return removed


def numbered(page: Page) -> Page:
    """The page with its number: hexadecimal digits of a digest of all that it says, so that no other page has it."""
    digest = hashlib.sha256(page_html(replace(page, number=""))).hexdigest()
    return replace(page, number=digest[:NUMBER_DIGITS].upper())


MINUS, NOUGHT = re.compile(r"(?<![\w.)/-])-(?=\d)"), re.compile(r"(?<![\w.])[-\u2212](0(?:\.0+)?)(?![\d.(])")
SIGNS = (("+-", "\u00b1"), ("<=", "\u2264"), (">=", "\u2265"))


def typeset(text: str) -> str:
    """Text with true signs: minus before numbers, plus-minus, not more than, and no minus before nought."""
    for plain, sign in SIGNS:
        text = text.replace(plain, sign)
    return MINUS.sub("\u2212", NOUGHT.sub(r"\1", text))


def prose(text: str) -> Markup:
    """A sentence as `typeset`, escaped; what stands between backticks, a command to be typed, as it is and as code."""
    parts = str(text).split("`")
    if len(parts) % 2 == 0:
        return escape(typeset(text))
    told = (Markup("<code>{}</code>").format(part) if k % 2 else escape(typeset(part)) for k, part in enumerate(parts))
    return Markup("").join(told)


def page_html(page: Page) -> bytes:
    """A page by the template, UTF-8."""
    folder = shipped_data() / "report"
    environment = Environment(
        loader=FileSystemLoader(str(folder)), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    css = (folder / "report.css").read_text(encoding="utf-8").replace("@ID@", page.number)
    digest = base64.b64encode(hashlib.sha256(css.encode()).digest()).decode()
    policy = f"default-src 'none'; img-src data:; style-src 'sha256-{digest}'; base-uri 'none'; form-action 'none'"
    environment.filters |= {"typeset": typeset, "prose": prose}
    # The style sheet is ours; escaped quotes would change its hash.
    html = environment.get_template("report.html").render(r=page, css=Markup(css), policy=policy)
    return html.encode()


def _page(e: Evidence, issue: Issue) -> Page:
    verdict = verdict_of(e.fit.summary, e.criteria, e.doubts)
    sections = [
        results_section(e),
        setup_section(e),
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
    return Page(
        results=e.fit.results_id,
        name=e.campaign.title,
        about=about_table(e.campaign.header, measured_days(e.campaign, issue), issue),
        verdict=verdict.text,
        verdict_class=verdict.kind,
        numbers=distances(e),
        why=why_far(e),
        answer=answer_table(e),
        picture=both_estimators(e),
        steps=_steps(e),
        criteria=criteria_table(e.criteria),
        traceable=traceability(e.campaign).statement,
        warnings=warnings_of(e),
        versions=e.fit.provenance.versions,
        sections=sections,
        issue=issue,
    )


def _steps(e: Evidence) -> list[str]:
    """What to do next: what the fit asks for, then the best of a plan; the plan's own section has all of it."""
    folder = "CAMPAIGN" if e.campaign.path is None else typed(e.campaign.path.resolve().name)
    summary = e.fit.summary
    failed = not summary.explained
    causes = misfit_causes(e.campaign, summary.parameters["pixel_scale"].value) if failed else ()
    found = steps_ahead(summary, folder, causes)
    if e.planned is not None and not e.planned.stop.now and e.planned.next:
        best = e.planned.next[0]
        found.append(f"Look at {best.text} ({best.minutes:.1f} min): the best next four looks of the plan.")
    unmet = next((c for c in e.criteria if c.verdict != MET), None)
    if unmet is not None and e.planned is None and summary.explained:
        limit = f"{unmet.limit:g} {unmet.unit}"
        aim = f"u(worst) <= {limit}" if unmet.unit != "mm" else f"U95(x) at {e.range_mm:g},0,0 mm <= {limit}"
        given = f"`tvsbayes plan {folder}/rig.toml --given {folder} --target '{aim}'`"
        found.append(f"Add looks until the limit is met; the fewest: {given}.")
    if not found:
        found.append("Nothing: use the calibration, and repeat it when the instrument was moved, opened or dropped.")
    if not e.criteria and e.fit.summary.converged:
        limit = f"`tvsbayes report {folder} --limit-mm 5`, or `--limit-deg-per-step 0.0005`"
        found.append(f"State the largest error that you can bear, and the page says whether it is kept: {limit}.")
    return found
