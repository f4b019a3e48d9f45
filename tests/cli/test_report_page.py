"""Writing the page of a report: stages of the work, files."""

from __future__ import annotations

from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from tvsbayes.cli.report_page import DRAWING, PRINTING, written_page


@pytest.fixture
def shown(monkeypatch):
    """States of the progress bar for a page that is drawn and printed at once."""
    states = []

    @contextmanager
    def waiting():
        yield states.append

    monkeypatch.setattr("tvsbayes.cli.report_page.waiting", waiting)
    monkeypatch.setattr("tvsbayes.report.page.find_browser", lambda: "chromium")
    monkeypatch.setattr("tvsbayes.report.page.page_html", lambda document: document.number.encode())
    monkeypatch.setattr("tvsbayes.report.page.print_to_pdf", lambda page: page.with_suffix(".pdf"))
    return states


@pytest.mark.parametrize("pdf", [False, True])
def test_printing_is_a_stage_of_the_work(shown, tmp_path, pdf):
    """The bar does not stay at 100 % while the browser prints."""

    def make(job):
        job.begin(DRAWING)
        return SimpleNamespace(number="N1")

    page = written_page(tmp_path, None, pdf, {"fit": 3.0, DRAWING: 1.0}, make)
    share = {state.doing: state.share for state in shown[:-1]}
    assert share == {DRAWING: pytest.approx(3 / 7), PRINTING: pytest.approx(4 / 7)} if pdf else {DRAWING: 0.75}
    assert shown[-1].share == 1.0
    path = tmp_path / "results" / "report.html"
    assert path.read_bytes() == page.html == b"N1" and page.path == path
    assert page.files == {"report": str(path), **({"pdf": str(path.with_suffix(".pdf"))} if pdf else {})}
    assert page.as_json() == {"criteria": [], "number": "N1", "files": page.files}
