"""A document: what is said of results, gathered once as sentences, tables and figures, in the order of its reader.

A terminal shows it by `terminal`, a browser and paper by `page`.
"""

from __future__ import annotations

import base64
import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

from tvsbayes.metrology.traceability import NOT_STATED
from tvsbayes.report.drawing import svg
from tvsbayes.report.tables import TableView

if TYPE_CHECKING:
    from matplotlib.figure import Figure


NOT_RECORDED = "not recorded"
"""Of what `campaign.toml` may say and does not."""
RECORDED = (("instrument", "instrument"), ("serial", "serial number"), ("operator", "operator"))
"""Keys of `campaign.toml` on the first page, and what they are called there."""


@dataclass(frozen=True)
class FigureView:
    """A figure with what it says in words."""

    figure: Figure
    alt: str
    caption: str

    @cached_property
    def source(self) -> str:
        """Its SVG as a `data:` address; the same figure gives the same bytes."""
        return f"data:image/svg+xml;base64,{base64.b64encode(svg(self.figure)).decode()}"

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height in the pixels of a style sheet."""
        width, height = self.figure.get_size_inches()
        return round(96 * width), round(96 * height)


@dataclass(frozen=True)
class Section:
    """A part of a document; `opened` ones are not folded on a screen, `None` among the tables is left out."""

    title: str
    text: Sequence[str] = ()
    items: Sequence[str] = ()
    tables: Sequence[TableView | None] = ()
    figures: Sequence[FigureView] = ()
    opened: bool = False


@dataclass(frozen=True)
class Number:
    """One of the numbers at the top."""

    label: str
    value: str
    note: str


@dataclass(frozen=True)
class Verdict:
    """One line, and the class that colours it: "met", "not-met" or "cannot-tell"."""

    text: str
    kind: str


@dataclass(frozen=True)
class Issue:
    """Who issues a report, for whom, and on which day (UTC); "" where nobody is stated."""

    day: datetime.date
    laboratory: str = ""
    customer: str = ""

    @classmethod
    def today(cls) -> Issue:
        """Of today, by nobody for nobody."""
        return cls(datetime.datetime.now(datetime.UTC).date())


@dataclass(frozen=True)
class Document:
    """A report of any instrument.

    Attributes:
        results: number of the results behind it; `number` is the document's own.
        name: of what was measured.
        about: what was measured, when and by whom.
        verdict: whether the numbers may be used.
        answer: the first table, beside `picture`; `numbers` and `why` stand below it.
        steps: what to do next.
        criteria: limits judged.
        traceable: what is said of traceability.
        warnings: what to keep in mind.
        versions: of the programs that made it.
    """

    results: str
    name: str
    about: TableView
    verdict: Verdict
    answer: TableView | None
    picture: FigureView | None
    steps: Sequence[str]
    traceable: str
    warnings: Sequence[str]
    versions: Mapping[str, str]
    sections: Sequence[Section]
    numbers: Sequence[Number] = ()
    why: Sequence[str] = ()
    criteria: TableView | None = None
    title: str = "Calibration of a laser positioner"
    issue: Issue = field(default_factory=Issue.today)
    number: str = ""


def about_table(header: Mapping[str, object], measured: str, issue: Issue) -> TableView:
    """What was measured, when, by whom and for whom; `measured` is a date or "" where nobody wrote it down."""
    recorded = [("measured", measured)]
    recorded += [(label, str(header.get(key) or "")) for key, label in RECORDED]
    stated = [("laboratory", issue.laboratory), ("customer", issue.customer)]
    rows = [[label, text or NOT_RECORDED] for label, text in recorded]
    return TableView("What was measured", [], rows + [[label, text or NOT_STATED] for label, text in stated])


def sentence(text: str) -> str:
    """A remark as a sentence: capital first, full stop last."""
    return f"{text[0].upper()}{text[1:]}."


type Part = str | TableView | None
"""Of what a terminal shows; None is left out."""


def terminal(*parts: Part) -> str:
    """Sentences and tables below each other, as a terminal shows them."""
    return "\n".join(part.text() if isinstance(part, TableView) else part for part in parts if part is not None)
