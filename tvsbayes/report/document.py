"""A document: results as sentences, tables and figures in reading order.

`terminal` prints it as text, `page` as HTML and PDF.
"""

from __future__ import annotations

import base64
import datetime
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

from tvsbayes.metrology.traceability import NOT_STATED
from tvsbayes.report.drawing import svg
from tvsbayes.report.tables import TableView

if TYPE_CHECKING:
    from matplotlib.figure import Figure


NOT_RECORDED = "not recorded"
"""Text of an optional key that `campaign.toml` lacks."""
RECORDED = (("instrument", "instrument"), ("serial", "serial number"), ("operator", "operator"))
"""Keys of `campaign.toml` on the first page, with their labels."""


@dataclass(frozen=True)
class FigureView:
    """A figure with its texts."""

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
    """A part of a document; `opened` sections are not folded on a screen, `None` among the tables is omitted."""

    title: str
    text: Sequence[str] = ()
    items: Sequence[str] = ()
    tables: Sequence[TableView | None] = ()
    figures: Sequence[FigureView] = ()
    opened: bool = False


@dataclass(frozen=True)
class Number:
    """A number at the top of the page."""

    label: str
    value: str
    note: str


@dataclass(frozen=True)
class Verdict:
    """One line, and its class for the colour: "met", "not-met" or "cannot-tell"."""

    text: str
    kind: str


@dataclass(frozen=True)
class Issue:
    """Laboratory, customer and day (UTC) of a report; "" where unstated."""

    day: datetime.date
    laboratory: str = ""
    customer: str = ""

    @classmethod
    def today(cls) -> Issue:
        """An issue of today without laboratory and customer."""
        return cls(datetime.datetime.now(datetime.UTC).date())


@dataclass(frozen=True)
class Document:
    """A report of any instrument.

    Attributes:
        results: number of its results; `number` is the document's own number.
        name: name of the measured object.
        about: object, dates and operator of the measurement.
        verdict: whether the numbers may be used.
        answer: the first table, beside `picture`; `numbers` and `why` follow below it.
        steps: next steps.
        criteria: limits with their verdicts.
        traceable: statement on traceability.
        warnings: warnings for the user of the numbers.
        versions: versions of the programs that computed it.
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
    """Object, dates, operator and customer of a measurement; `measured` is a date or "" where not recorded."""
    recorded = [(label, str(header.get(key) or "")) for key, label in RECORDED]
    rows = [[label, text or NOT_RECORDED] for label, text in (("measured", measured), *recorded)]
    rows += [["laboratory", issue.laboratory or NOT_STATED], ["customer", issue.customer or NOT_STATED]]
    return TableView("What was measured", [], rows)


def sentence(text: str) -> str:
    """A remark as a sentence: capital first, full stop last."""
    return f"{text[0].upper()}{text[1:]}."


def labelled(label: str, texts: Iterable[str]) -> list[str]:
    """Remarks of one kind, each after the name of the kind."""
    return [f"{label}: {text}" for text in texts]


type Part = str | TableView | None
"""A part of a terminal's text; None is omitted."""


def terminal(*parts: Part) -> str:
    """Sentences and tables one below the other, as text for a terminal."""
    return "\n".join(part.text() if isinstance(part, TableView) else part for part in parts if part is not None)
