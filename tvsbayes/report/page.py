"""A document as one page: verdict, numbers and warnings at its top, the sections below; HTML and PDF.

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
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from tvsbayes.errors import InputError
from tvsbayes.files.disk import make_folder, read_bytes, shipped_data, write_atomically
from tvsbayes.report.document import Document

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


def numbered(document: Document) -> Document:
    """The document with its number: digits of a digest of all that its page says, so that no other has it."""
    return replace(document, number=digest_number(page_html(replace(document, number=""))))


def digest_number(content: bytes) -> str:
    """What tells results or reports apart: hexadecimal digits of a SHA-256."""
    return hashlib.sha256(content).hexdigest()[:NUMBER_DIGITS].upper()


MINUS, MINUS_ZERO = re.compile(r"(?<![\w.)/-])-(?=\d)"), re.compile(r"(?<![\w.])[-\u2212](0(?:\.0+)?)(?![\d.(])")
SIGNS = (("+-", "\u00b1"), ("<=", "\u2264"), (">=", "\u2265"))


def typeset(text: str) -> str:
    """Text with true signs: minus before numbers, plus-minus, not more than, and no minus before zero."""
    for plain, sign in SIGNS:
        text = text.replace(plain, sign)
    return MINUS.sub("\u2212", MINUS_ZERO.sub(r"\1", text))


def prose(text: str) -> Markup:
    """A sentence as `typeset`, escaped; what stands between backticks, a command to be typed, as it is and as code."""
    parts = str(text).split("`")
    if len(parts) % 2 == 0:
        return escape(typeset(text))
    pieces = (
        Markup("<code>{}</code>").format(part) if k % 2 else escape(typeset(part)) for k, part in enumerate(parts)
    )
    return Markup("").join(pieces)


def page_html(document: Document) -> bytes:
    """A document by the template, UTF-8; its policy allows its own style sheet and pictures alone."""
    return rendered("report", "report.html", "report.css", document.number, r=document)


def rendered(
    folder: str, template: str, style: str, number: str = "", scripts: Sequence[str] = (), **held: object
) -> bytes:
    """A shipped template with its style and scripts in it, UTF-8; its policy (CSP) names exactly those, by hash.

    Args:
        folder: of the shipped data.
        template: a file in it.
        style: its style sheet.
        scripts: in the order in which they run.
        number: of the report, for the foot of its printed pages.
        held: what the template shows.
    """
    place = shipped_data() / folder
    css = (place / style).read_text(encoding="utf-8").replace("@ID@", number)
    script = "\n".join((place / name).read_text(encoding="utf-8") for name in scripts)
    policy = f"default-src 'none'; img-src data:; style-src {_source(css)}; base-uri 'none'; form-action 'none'"
    policy += f"; script-src {_source(script)}" if scripts else ""
    environment = Environment(
        loader=FileSystemLoader(str(place)), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    environment.filters |= {"typeset": typeset, "prose": prose}
    # Style sheet and scripts are ours; escaped quotes would change their hashes.
    shown = environment.get_template(template).render(css=Markup(css), script=Markup(script), policy=policy, **held)
    return shown.encode()


def _source(text: str) -> str:
    """How a policy names a text (Content Security Policy 3, 2.3.1)."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
