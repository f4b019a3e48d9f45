"""`calibrate`: check, classic, fit and report in one go, of a scanner and of an axis."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
from support.axes import drawn, runs

from tvsbayes.instrument.campaign import write_campaign

pytestmark = pytest.mark.usefixtures("own_compilation_cache", "each_fitted_once")


@pytest.fixture
def no_page(monkeypatch):
    """The page takes seconds and is not tested here."""
    monkeypatch.setattr("tvsbayes.report.evidence.gather", lambda *_, **__: SimpleNamespace(criteria=()))
    page = SimpleNamespace(number="N1")

    def document(evidence, issue):
        page.text = f"by {issue.laboratory}"
        return page

    monkeypatch.setattr("tvsbayes.report.scanner_document.report_document", document)
    monkeypatch.setattr("tvsbayes.report.page.page_html", lambda page: page.text.encode())


def test_a_campaign_becomes_a_report_in_one_go(ask, say, grid_folder, no_page):
    code, document = ask("calibrate", grid_folder, "--no-sample", "--laboratory", "Optics Lab")
    assert code == 0
    assert list(document) == ["check", "classic", "fit", "report"]
    assert document["check"]["kind"] == "campaign" and document["classic"] is None
    assert document["fit"]["converged"] and set(document["fit"]["files"]) == {"draws", "fit"}
    assert (grid_folder / "results" / "report.html").read_text() == "by Optics Lab"
    files = {"report": str(grid_folder / "results" / "report.html")}
    assert document["report"] == {"criteria": [], "number": "N1", "files": files}
    stale = [grid_folder / "results" / name for name in ("report.pdf", "dcc.xml")]
    for each in stale:
        each.write_bytes(b"of an earlier page")
    code, _, log = say("report", grid_folder, "--laboratory", "Another")
    assert code == 0 and "removed: report.pdf, dcc.xml" in log and not any(each.exists() for each in stale)


@pytest.mark.parametrize("command", [("calibrate", "--no-sample"), ("report",)])
def test_without_a_browser_nothing_is_fitted(ask, grid_folder, tmp_path, monkeypatch, command):
    """Scanner and axis; the remedy gives a page."""
    monkeypatch.setattr("tvsbayes.report.page.BROWSERS", ())
    drawn(7, runs(2)).write(tmp_path / "axis")
    for folder in (grid_folder, tmp_path / "axis"):
        before = sorted(folder.rglob("*"))
        code, document = ask(*command, folder, "--pdf")
        assert (code, document["error"]["code"]) == (2, "no-browser")
        assert "leave --pdf out" in document["error"]["remedy"] and "report.html" in document["error"]["remedy"]
        assert set(document) == {"error"} and sorted(folder.rglob("*")) == before


@pytest.mark.thorough
def test_it_stops_at_an_unusable_fit(ask, grid_campaign, tmp_path, no_page):
    """Relative counters contradict the model everywhere."""
    moves = tuple(
        replace(m, pan_steps=m.pan_steps - before.pan_steps)
        for before, m in zip((grid_campaign.moves[0], *grid_campaign.moves), grid_campaign.moves, strict=False)
    )
    write_campaign(replace(grid_campaign, moves=moves), tmp_path / "relative")
    code, document = ask("calibrate", tmp_path / "relative", "--no-sample", "--anyway")
    assert code == 4 and document["report"] is None and document["error"]["code"]
    assert not (tmp_path / "relative" / "results" / "report.html").exists()


def test_an_axis_becomes_a_report_in_one_go(ask, say, tmp_path, no_pictures):
    drawn(7, runs(2)).write(tmp_path / "axis")
    code, document = ask("calibrate", tmp_path / "axis", "--no-sample")
    assert code == 0 and list(document) == ["check", "classic", "fit", "report"]
    assert (tmp_path / "axis" / "results" / "report.html").stat().st_size > 10_000
    code, text, _ = say("calibrate", tmp_path / "axis", "--no-sample")
    parts = [text.index(word) for word in ("axis\n", "scatter about the line", "verdict: usable", "next: open ")]
    assert code == 0 and parts == sorted(parts)
