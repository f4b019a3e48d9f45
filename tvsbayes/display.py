"""Show results in a Python session and in a notebook: a short table instead of all arrays.

A result describes itself in `shown()`; `repr`, the notebook's HTML and `to_dataframe` use this description. Only
`to_dataframe` loads pandas.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

type Cell = str | float | int | bool | None
"""One entry of a view: a number, a text or nothing."""
ROWS = 24
"""Largest number of rows shown of a table; `to_dataframe` returns all."""


ROUNDING = 1e-13
"""Largest relative rounding error of a computed value."""


def concise(value: float, sd: float) -> str:
    """Format `0.059394(81)`: two digits of the standard uncertainty in units of the last place (GUM 7.2.2).

    From 1 on the uncertainty keeps its decimal point, as in `21.3(1.5)`. An sd below the rounding of values is none.
    """
    if not ROUNDING * abs(value) < sd < math.inf:
        return f"{value:.6g}"
    # Digits are those of the rounded sd: 0.0996 has the digits 10, not 100.
    mantissa, exponent = f"{sd:.1e}".split("e")
    decimals = max(0, 1 - int(exponent))
    digits = mantissa.replace(".", "") if int(exponent) < 0 else f"{float(f'{sd:.1e}'):.{decimals}f}"
    return f"{value:.{decimals}f}({digits})"


@dataclass(frozen=True)
class View:
    """The description of a result that is shown.

    Attributes:
        title: description of the result, in one line.
        columns: headings, with units.
        rows: cells by column.
        most: largest number of rows shown.
    """

    title: str
    columns: Sequence[str] = ()
    rows: Sequence[Sequence[Cell]] = ()
    most: int = ROWS

    def text(self) -> str:
        """Format a few lines for a terminal."""
        if not self.rows:
            return self.title
        cells = [list(self.columns), *([_told(cell) for cell in row] for row in self.rows[: self.most])]
        width = [max(len(row[k]) for row in cells) for k in range(len(self.columns))]
        lines = [self.title]
        for first, *others in cells:
            beside = (cell.rjust(wide) for cell, wide in zip(others, width[1:], strict=True))
            lines.append("  ".join([first.ljust(width[0]), *beside]).rstrip())
        return "\n".join([*lines, *self._rest()])

    def html(self) -> str:
        """Format a table for a notebook; text from files is escaped."""
        if not self.rows:
            return f"<p>{escape(self.title)}</p>"
        head = "".join(f"<th>{escape(column)}</th>" for column in self.columns)
        body = "".join(
            f"<tr>{''.join(f'<td>{escape(_told(cell))}</td>' for cell in row)}</tr>" for row in self.rows[: self.most]
        )
        rest = "".join(f"<p>{line}</p>" for line in self._rest())
        table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
        return f"<p>{escape(self.title)}</p>{table}{rest}"

    def _rest(self) -> list[str]:
        more = len(self.rows) - self.most
        return [f"... {more} more rows; to_dataframe() has all"] if more > 0 else []


class Shown(ABC):
    """Base of results: Python displays `shown()` in place of the value.

    A dataclass with this base is declared with `repr=False`; else its own `repr` would list every array.
    """

    __slots__ = ()

    @abstractmethod
    def shown(self) -> View:
        """Return the description that is shown."""

    def __repr__(self) -> str:
        """The view as text."""
        return self.shown().text()

    def _repr_html_(self) -> str:
        return self.shown().html()

    def to_dataframe(self) -> pd.DataFrame:
        """Return all rows of the view as a pandas table.

        Raises:
            ImportError: pandas is not installed.
        """
        import pandas as pd

        view = self.shown()
        return pd.DataFrame([list(row) for row in view.rows], columns=list(view.columns))


def _told(cell: Cell) -> str:
    """Format a cell: numbers with six digits, nothing as a dash, control characters from files as question marks."""
    if cell is None:
        return "-"
    if isinstance(cell, str):
        return "".join(c if c.isprintable() else "?" for c in cell)
    return str(cell) if isinstance(cell, bool) else f"{cell:.6g}"
