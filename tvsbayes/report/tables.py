"""Numbers with their uncertainty, and tables of formatted text for terminal and page."""

from __future__ import annotations

import io
import math
import shutil
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal

from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from tvsbayes.display import concise

COLUMNS, GAP = 80, 2
"""Width of a text; gap between two columns of a table."""


def text_width() -> int:
    """Columns of the terminal behind stdout, at most `COLUMNS`; `COLUMNS` for files and pipes."""
    is_terminal = sys.stdout is not None and sys.stdout.isatty()
    return min(COLUMNS, shutil.get_terminal_size().columns) if is_terminal else COLUMNS


def two_digits(value: float) -> str:
    """An uncertainty to two significant digits, including a 0, without an exponent (GUM 7.2.6)."""
    return f"{Decimal(f'{value:.1e}'):f}" if math.isfinite(value) and value else f"{value:g}"


def three_digits(value: float) -> str:
    """Three digits, without an exponent where the number is large."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def three_digits_fixed(value: float) -> str:
    """Exactly three significant digits, without an exponent."""
    return f"{Decimal(f'{value:.2e}'):f}" if math.isfinite(value) and value else f"{value:g}"


def signed(value: float, sd: float) -> str:
    """A difference as `concise`, always with its sign."""
    text = concise(value, sd)
    return text if text.startswith("-") else f"+{text}"


def interval_text(low: float, high: float, sd: float) -> str:
    """Interval ends to the digits of the standard uncertainty, as `concise` (GUM 7.2.6).

    Empty where both ends are the same: a fixed quantity has no interval.
    """
    if low == high:
        return ""
    decimals = max(0, 1 - int(f"{sd:.1e}".split("e")[1])) if 0 < sd < math.inf else 6
    return f"[{low:.{decimals}f}, {high:.{decimals}f}]"


def chance_text(probability: float, bound: str = "") -> str:
    """A probability from draws to three decimals, after the words of a bound; never as 0 or 1.

    Args:
        probability: share of draws.
        bound: "at least " or "at most " where the number is a bound; "" where it is the probability.
    """
    text = f"{probability:.3f}"
    return {"1.000": "above 0.999", "0.000": "below 0.001"}.get(text, bound + text)


@dataclass(frozen=True)
class TableView:
    """A table of formatted text; the first cell of a row is its header; `pairs` have no header of columns."""

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    @property
    def pairs(self) -> bool:
        """Whether rows are names with their values."""
        return not self.columns

    def text(self) -> str:
        """The table without lines, for terminals and files.

        A table wider than `text_width` is split into parts of equally many columns below each other. Where columns do
        not split evenly, each row takes two lines, the first for its header.
        """
        room, widths = text_width(), self._widths()
        title = textwrap.wrap(self.caption, room, break_long_words=False, break_on_hyphens=False)
        parts = self._parts(widths, room)
        is_uneven = len(parts) > 1 and (len(parts[0]) == 2 or len(parts[0]) != len(parts[-1]))
        if is_uneven and sum(widths[1:]) <= room:
            return "\n".join([*title, *self._two_line_rows()])
        return "\n".join([*title, *(self._part(columns) for columns in parts)])

    def _widths(self) -> list[int]:
        """Widths of all columns, each with a gap."""
        cells = [self.columns, *self.rows]
        columns = range(max(1, *map(len, cells)))
        return [max((cell_len(row[k]) for row in cells if k < len(row)), default=0) + GAP for k in columns]

    def _two_line_rows(self) -> list[str]:
        """Lines: the first cell of each row, and its other cells, indented, below it."""
        firsts = [*([] if self.pairs else [self.columns[0]]), *(row[0] for row in self.rows)]
        others = self._part(range(1, len(self._widths()))).split("\n")
        pairs = zip(firsts, others, strict=True)
        return [line for first, rest in pairs for line in (first, " " * GAP + rest) if line.strip()]

    @staticmethod
    def _parts(width: Sequence[int], room: int) -> list[list[int]]:
        """Columns of every part: the first column and as many others as fit, about equally many in each part."""
        others = len(width) - 1

        def parts(size: int) -> list[list[int]]:
            return [[0, *range(k, min(k + size, others + 1))] for k in range(1, others + 1, size)] or [[0]]

        def fits(size: int) -> bool:
            return all(sum(width[k] for k in part) - GAP <= room for part in parts(size))

        widest = next((size for size in range(others, 1, -1) if fits(size)), 1)
        balanced = math.ceil(others / len(parts(widest))) or 1
        return parts(balanced if fits(balanced) else widest)

    def _part(self, columns: Sequence[int]) -> str:
        """Some columns as text."""
        table = Table(box=None, pad_edge=False, show_header=not self.pairs)
        for number in columns:
            header = "" if self.pairs else self.columns[number]
            table.add_column(header, justify="left" if number == 0 else "right", no_wrap=True)
        for row in self.rows:
            table.add_row(*(Text(row[number] if number < len(row) else "") for number in columns))
        stream = io.StringIO()
        # Plain text regardless of FORCE_COLOR, since it also goes into files; lines are not folded.
        Console(file=stream, width=1000, highlight=False, color_system=None, force_terminal=False).print(table)
        return "\n".join(line.rstrip() for line in stream.getvalue().splitlines())
