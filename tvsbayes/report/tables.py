"""What texts and pages are made of: numbers with their uncertainty, tables, figures, sections.

A table is made once and printed by either: `text()` on a terminal, the template of the page in HTML.
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from tvsbayes.report import figures

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def two_digits(value: float) -> str:
    """An uncertainty to two significant digits, without an exponent (GUM 7.2.6)."""
    return np.format_float_positional(value, precision=2, fractional=False, trim="-")


def concise(value: float, sd: float) -> str:
    """`0.059394(81)`: the standard uncertainty's two digits in units of the last place (GUM 7.2.2).

    From 1 on the uncertainty keeps its decimal point, as in `21.3(1.5)`.
    """
    if not 0 < sd < math.inf:
        return f"{value:.6g}"
    # Of the rounded sd: 0.0996 has the digits 10, not 100.
    mantissa, exponent = f"{sd:.1e}".split("e")
    decimals = max(0, 1 - int(exponent))
    digits = mantissa.replace(".", "") if int(exponent) < 0 else f"{float(f'{sd:.1e}'):.{decimals}f}"
    return f"{value:.{decimals}f}({digits})"


def signed(value: float, sd: float) -> str:
    """A difference with its sign, as `concise`."""
    text = concise(value, sd)
    return text if text.startswith("-") else f"+{text}"


def interval_text(low: float, high: float, sd: float) -> str:
    """Interval ends to one digit more than the standard uncertainty's second."""
    decimals = max(0, 2 - math.floor(math.log10(sd))) if sd > 0 else 6
    return f"[{low:.{decimals}f}, {high:.{decimals}f}]"


@dataclass(frozen=True)
class TableView:
    """A table of ready text; the first cell of a row is its header, and `pairs` have no other."""

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    @property
    def pairs(self) -> bool:
        """Names with their values."""
        return not self.columns

    def text(self) -> str:
        """The table without lines, for terminals and files alike."""
        table = Table(title=self.caption, title_justify="left", title_style="", box=None, pad_edge=False)
        for number, column in enumerate(self.columns):
            table.add_column(column, justify="left" if number == 0 else "right", no_wrap=True)
        for row in self.rows:
            table.add_row(*map(Text, row))
        stream = io.StringIO()
        # Plain text whatever FORCE_COLOR and the like say: it also goes into files.
        Console(file=stream, width=120, highlight=False, color_system=None, force_terminal=False).print(table)
        return "\n".join(line.rstrip() for line in stream.getvalue().splitlines())


@dataclass(frozen=True)
class FigureView:
    """A picture with what it says in words."""

    source: str
    alt: str
    caption: str
    width: int
    height: int


@dataclass(frozen=True)
class Section:
    """A part of the report."""

    title: str
    text: Sequence[str] = ()
    items: Sequence[str] = ()
    tables: Sequence[TableView | None] = ()
    figures: Sequence[FigureView] = ()


@dataclass(frozen=True)
class Number:
    """One of the three numbers at the top."""

    label: str
    value: str
    note: str


@dataclass(frozen=True)
class Page:
    """What the template is filled with."""

    report_id: str
    name: str
    verdict: str
    verdict_class: str
    numbers: Sequence[Number]
    criteria: TableView | None
    traceable: str
    warnings: Sequence[str]
    versions: Mapping[str, str]
    sections: Sequence[Section] = field(default_factory=tuple)
    title: str = "Calibration of a laser positioner"


def figure_view(figure: Figure, alt: str, caption: str) -> FigureView:
    """A figure as SVG in a `data:` address; the same figure gives the same bytes."""
    width, height = (round(96 * inch) for inch in figure.get_size_inches())
    picture = base64.b64encode(figures.svg(figure)).decode()
    return FigureView(f"data:image/svg+xml;base64,{picture}", alt, caption, width, height)
