"""The page of a campaign: one HTML file with its style, scripts and document, which asks nobody for anything."""

from __future__ import annotations

from importlib.metadata import version

from markupsafe import Markup

from tvsbayes.report.page import rendered

SCRIPTS = ("drawing.js", "columns.js", "plots.js", "rig.js", "page.js")
"""In `data/view`, in the order in which they run; the page of a run draws with the first of them too."""


def page_html(document: bytes) -> bytes:
    """The page of a document of scenes, UTF-8; its policy lets nothing but its own script run.

    Args:
        document: JSON, from `document`.
    """
    # No text of a campaign can end the element that holds the document (HTML standard 4.12.1.3).
    held = Markup(document.decode().replace("<", "\\u003c"))
    return rendered("view", "page.html", "page.css", scripts=SCRIPTS, version=version("tvsbayes"), document=held)
