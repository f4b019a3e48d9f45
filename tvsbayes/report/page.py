"""A document as one page: verdict, numbers and warnings at its top, the sections below; HTML and PDF.

The page has no script and no network access. Text of a campaign enters it only through jinja2's autoescape; pictures
are SVG in `data:` images, which browsers open without scripts and network. Its policy (CSP) allows only its own style
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
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from tvsbayes.errors import InputError
from tvsbayes.files.disk import make_folder, read_bytes, shipped_data, write_atomically
from tvsbayes.files.own_outputs import PDF_MARK
from tvsbayes.report.document import Document

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge")
NO_BROWSER = "leave --pdf out and print report.html from any browser (A4), or install Chromium"
PDF_SECONDS = 120
NUMBER_DIGITS = 12
PAGE_BYTES_MAX = 64 * 1024 * 1024
GENERATOR = b'<meta name="generator" content="tvsbayes '
"""Marker in the head of every page of this program."""


def find_browser() -> str:
    """The browser that prints pages.

    Raises:
        InputError: no browser is installed.
    """
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        message = f"--pdf needs one of {', '.join(BROWSERS)} on the path"
        raise InputError("no-browser", message, remedy=NO_BROWSER)
    return browser


def print_to_pdf(page: Path) -> Path:
    """Print a report to a PDF beside it, with an installed Chromium or Chrome.

    Raises:
        InputError: no browser is installed, or printing failed.
    """
    browser = find_browser()
    target = page.with_suffix(".pdf")
    remedy = f"open {page} in any browser and print it to PDF (A4)"
    with tempfile.TemporaryDirectory(prefix="tvsbayes-") as folder:
        pdf = Path(folder) / "report.pdf"
        flags = ["--headless", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-sync"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            # Chromium's sandbox does not work as root; the page is this program's and has no script.
            flags.append("--no-sandbox")
        flags += ["--no-pdf-header-footer", "--generate-pdf-document-outline", f"--user-data-dir={folder}/profile"]
        command = [browser, *flags, f"--print-to-pdf={pdf}", page.resolve().as_uri()]
        try:
            process = subprocess.run(command, capture_output=True, timeout=PDF_SECONDS, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise InputError("pdf", f"{Path(browser).name} did not print the report", remedy=remedy) from error
        if process.returncode or not pdf.exists():
            raise InputError("pdf", f"{Path(browser).name} ended with code {process.returncode}", remedy=remedy)
        write_atomically(target, pdf.read_bytes() + PDF_MARK)
    return target


def certificate_place(page: Path, out: Path | None) -> Path:
    """Path of a page's certificate: `dcc.xml` in `results/`; for a page elsewhere, beside it with its name."""
    return page.with_name("dcc.xml" if out is None else f"{page.stem}.dcc.xml")


def replace_page(page: Path, html: bytes, out: Path | None) -> list[str]:
    """Write a page, and remove PDF and certificate of a different previous page.

    Args:
        page: its path; `results/` is created where it is missing.
        html: its bytes; nothing is removed where they equal the previous page.
        out: path stated by the user; files beside it are removed only if this program wrote the previous page.

    Returns:
        Names of removed files.

    Raises:
        InputError: the folder cannot be written.
    """
    try:
        previous = read_bytes(page, PAGE_BYTES_MAX)
    except InputError:
        previous = b""
    removed = []
    if previous != html and (out is None or GENERATOR in previous):
        for follower in (page.with_suffix(".pdf"), certificate_place(page, out)):
            if follower.is_file():
                follower.unlink()
                removed.append(follower.name)
    if out is None:
        make_folder(page.parent)
    write_atomically(page, html)
    return removed


def numbered(document: Document) -> Document:
    """The document with its number: digits of a digest of its page, unique to its content."""
    return replace(document, number=digest_number(page_html(replace(document, number=""))))


def digest_number(content: bytes) -> str:
    """Number of results or of a report: hexadecimal digits of a SHA-256."""
    return hashlib.sha256(content).hexdigest()[:NUMBER_DIGITS].upper()


MINUS, MINUS_ZERO = re.compile(r"(?<![\w.)/-])-(?=\d)"), re.compile(r"(?<![\w.])[-\u2212](0(?:\.0+)?)(?![\d.(])")
SIGNS = (("+-", "\u00b1"), ("<=", "\u2264"), (">=", "\u2265"))


def typeset(text: str) -> str:
    """Text with typographic signs: minus before numbers, plus-minus, less or equal, and no minus before zero."""
    for plain, sign in SIGNS:
        text = text.replace(plain, sign)
    return MINUS.sub("\u2212", MINUS_ZERO.sub(r"\1", text))


def prose(text: str) -> Markup:
    """A sentence as `typeset`, escaped; commands between backticks unchanged, as code."""
    parts = str(text).split("`")
    if len(parts) % 2 == 0:
        return escape(typeset(text))
    pieces = (
        Markup("<code>{}</code>").format(part) if k % 2 else escape(typeset(part)) for k, part in enumerate(parts)
    )
    return Markup("").join(pieces)


def page_html(document: Document) -> bytes:
    """A document by the template, UTF-8; its policy allows only its own style sheet and pictures."""
    return rendered("report", "report.html", "report.css", document.number, r=document)


def rendered(
    folder: str, template: str, style: str, number: str = "", scripts: Sequence[str] = (), **content: object
) -> bytes:
    """A shipped template with its style and scripts in it, UTF-8; its policy (CSP) allows only those, by hash.

    Args:
        folder: folder in the shipped data.
        template: a file in it.
        style: its style sheet.
        scripts: scripts in the order of execution.
        number: number of the report, for the foot of its printed pages.
        content: values for the template.
    """
    directory = shipped_data() / folder
    css = (directory / style).read_text(encoding="utf-8").replace("@ID@", number)
    script = "\n".join((directory / name).read_text(encoding="utf-8") for name in scripts)
    policy = f"default-src 'none'; img-src data:; style-src {_source(css)}; base-uri 'none'; form-action 'none'"
    policy += f"; script-src {_source(script)}" if scripts else ""
    environment = Environment(
        loader=FileSystemLoader(str(directory)), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    environment.filters |= {"typeset": typeset, "prose": prose}
    # Style sheet and scripts are shipped files; escaped quotes would change their hashes.
    page = environment.get_template(template).render(css=Markup(css), script=Markup(script), policy=policy, **content)
    return page.encode()


def _source(text: str) -> str:
    """The hash of a text in a policy (Content Security Policy 3, 2.3.1)."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
