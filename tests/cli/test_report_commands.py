"""`calibrate`: check, classic, fit and report in one go, of a scanner and of an axis."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
from support.axes import drawn, runs

from tvsbayes.instrument.campaign import write_campaign

pytestmark = pytest.mark.usefixtures("own_compilation_cache")


@pytest.fixture
def no_page(monkeypatch):
    """What the page shows is not what is looked at, and takes seconds."""
    monkeypatch.setattr("tvsbayes.report.evidence.gather", lambda *_, **__: SimpleNamespace(criteria=()))
    monkeypatch.setattr("tvsbayes.report.page.report_html", lambda evidence, issue: f"by {issue.laboratory}".encode())


def test_a_campaign_becomes_a_report_in_one_go(ask, grid_folder, no_page):
    code, document = ask("calibrate", grid_folder, "--no-sample", "--laboratory", "Optics Lab")
    assert code == 0
    assert list(document) == ["check", "classic", "fit", "report"]
    assert document["check"]["kind"] == "campaign" and document["classic"] is None
    assert document["fit"]["converged"] and set(document["fit"]["files"]) == {"draws", "fit"}
    assert (grid_folder / "results" / "report.html").read_text() == "by Optics Lab"
    assert document["report"] == {"criteria": [], "files": {"report": str(grid_folder / "results" / "report.html")}}


def test_it_stops_where_a_fit_must_not_be_used(ask, say, grid_campaign, tmp_path, no_page):
    """Relative counters: nothing agrees with anything."""
    moves = tuple(
        replace(m, pan_steps=m.pan_steps - before.pan_steps)
        for before, m in zip((grid_campaign.moves[0], *grid_campaign.moves), grid_campaign.moves, strict=False)
    )
    write_campaign(replace(grid_campaign, moves=moves), tmp_path / "relative")
    code, document = ask("calibrate", tmp_path / "relative", "--no-sample")
    assert code == 4 and document["report"] is None and document["error"]["code"]
    assert not (tmp_path / "relative" / "results" / "report.html").exists()


def test_an_axis_becomes_a_report_in_one_go(ask, say, tmp_path):
    drawn(7, runs(2)).write(tmp_path / "axis")
    code, document = ask("calibrate", tmp_path / "axis", "--no-sample")
    assert code == 0 and list(document) == ["check", "classic", "fit", "report"]
    assert (tmp_path / "axis" / "results" / "report.html").stat().st_size > 10_000
    code, text, _ = say("calibrate", tmp_path / "axis", "--no-sample")
    parts = [text.index(word) for word in ("axis\n", "scatter about the line", "verdict: usable", "next: open ")]
    assert code == 0 and parts == sorted(parts)
