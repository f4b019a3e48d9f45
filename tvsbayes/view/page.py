"""The page of a campaign: one HTML file with its style, scripts and document, which asks nobody for anything."""

from __future__ import annotations

import base64
import hashlib
from importlib.metadata import version

from tvsbayes.files.disk import shipped_data

SCRIPTS = ("drawing.js", "columns.js", "plots.js", "rig.js", "page.js")
"""In `data/view`, in the order in which they run; the page of a run draws with the first of them too."""


def page_html(document: bytes) -> bytes:
    """The page of a document of scenes, UTF-8; its policy lets nothing but its own script run.

    Args:
        document: JSON, from `document`.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    folder = shipped_data() / "view"
    css = (folder / "page.css").read_text(encoding="utf-8")
    script = "\n".join((folder / name).read_text(encoding="utf-8") for name in SCRIPTS)
    style_source, script_source = (_source(text) for text in (css, script))
    policy = (
        f"default-src 'none'; script-src {script_source}; style-src {style_source}; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )
    environment = Environment(loader=FileSystemLoader(str(folder)), autoescape=True, undefined=StrictUndefined)
    # No text of a campaign can end the element that holds the document (HTML standard 4.12.1.3).
    held = document.decode().replace("<", "\\u003c")
    html = environment.get_template("page.html").render(
        policy=policy, version=version("tvsbayes"), css=Markup(css), script=Markup(script), document=Markup(held)
    )
    return html.encode()


def _source(text: str) -> str:
    """How a policy names a text (Content Security Policy 3, 2.3.1)."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
