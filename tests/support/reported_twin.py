"""The paper twin with the results that the report command makes, and what a page is made of."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from tvsbayes.cli.main import run
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.campaign import read_campaign
from tvsbayes.pipeline import StoredOrFitted
from tvsbayes.report import figures
from tvsbayes.report.document import Issue
from tvsbayes.report.evidence import Evidence, gather
from tvsbayes.report.page import page_html
from tvsbayes.report.scanner_document import report_document
from tvsbayes.results.plan_record import PLAN_FORMAT

TWIN = shipped_data() / "twins" / "paper_twin"


VOID = {"meta", "img", "br", "link", "input", "hr"}
BATCH = {"text": "sheet d9, <b>four</b> looks", "minutes": 2.5, "gain": 1.2e-5, "gain_per_minute": 4.8e-6}
BATCH["actions"] = [{"action": "place", "target": "d9"}, {"action": "look"}]


PLANNED = {
    "format": PLAN_FORMAT,
    "target": {"text": "u(left) <= 2e-4 deg/step", "unit": "deg/step"},
    "now": 3.1e-4,
    "stop": {"now": False, "reason": "the target is not met", "rule": "a rule"},
    "limited_by": {"needed": "focal scale to 0.1 %"},
    "next": [BATCH],
}
"""What `plan --given` writes, as far as reports show it."""


class Nodes(HTMLParser):
    """Every element with its attributes, and the text outside of the style sheet."""

    def __init__(self, page: bytes):
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.text: list[str] = []
        self.feed(page.decode())

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.text.append(data)

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


def words(page: bytes) -> str:
    """What a reader sees of a page, in one line."""
    return " ".join(" ".join(Nodes(page).text).split())


def first_words(page: bytes) -> str:
    """The same of what stands before the contents."""
    return words(page.split(b"<nav")[0] + b"</header></body></html>")


@contextmanager
def stored(place: Path, documents: Mapping[str, object]) -> Iterator[None]:
    """Documents in the results of a campaign, as long as the block lasts."""
    for name, document in documents.items():
        (place / "results" / name).write_text(json.dumps(document))
    try:
        yield
    finally:
        for name in documents:
            (place / "results" / name).unlink()


def evidence_of(place: Path) -> Evidence:
    campaign = read_campaign(place)
    record, calibration, ratios = StoredOrFitted(campaign).reported
    limits = {"range_mm": 1000.0, "limit_deg_per_step": 1e-3, "limit_mm": 1.0}
    return gather(campaign, record, calibration, ratios_deg_per_step=ratios, **limits)


def report_html(evidence: Evidence, issue: Issue | None = None) -> bytes:
    return page_html(report_document(evidence, issue))


@pytest.fixture(scope="session")
def reported(tmp_path_factory, paper_fit) -> Path:
    """The paper twin with the page of its Laplace approximation."""
    place = tmp_path_factory.mktemp("report") / "twin"
    shutil.copytree(TWIN, place)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tvsbayes.estimators.joint_fit.fit", lambda read, **_: replace(paper_fit, campaign=read))
        assert run(["fit", str(place), "--no-sample"]) == 0
    assert run(["report", str(place), "--limit-deg-per-step", "1e-3", "--limit-mm", "1", "--json"]) == 1
    return place


@pytest.fixture(scope="session")
def evidence(reported) -> Evidence:
    return evidence_of(reported)


@pytest.fixture(scope="session")
def page(evidence) -> bytes:
    return report_html(evidence)


@pytest.fixture
def no_pictures(monkeypatch):
    """All figures are an empty one: they are not what is looked at, and take seconds."""
    empty = Figure()
    for name in dir(figures):
        monkeypatch.setattr(figures, name, lambda *_, **__: empty)
    monkeypatch.setattr("tvsbayes.report.document.svg", lambda figure: b"")
