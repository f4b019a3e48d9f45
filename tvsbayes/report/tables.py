"""Numbers with their uncertainty, names of parameters in words, and tables of text for terminal and page."""

from __future__ import annotations

import io
import math
import re
import shutil
import sys
import textwrap
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import cache
from typing import Any

from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

from tvsbayes.display import concise
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.parameters import QUANTITIES
from tvsbayes.results.tiers import CHAIN, IMPORTANCE

COLUMNS, GAP = 80, 2
"""Width of a text; gap between two columns of a table."""
MADE_BY = {
    "laplace": "Laplace approximation at the mode",
    IMPORTANCE: "posterior by importance sampling",
    "posterior": f"posterior sampled by {CHAIN}",
}
IN_WORDS = {**QUANTITIES.words, "extrinsics": "the positioner's pose"}
"""Words by block of quantities; also of the positioner's pose as a whole."""
_NAMES = re.compile(r"\b(?:" + "|".join(sorted(map(re.escape, IN_WORDS), key=len, reverse=True)) + r")\b(?:\.\w+)*")


@cache
def sentences(subject: str) -> dict[str, Any]:
    """The sentences of a subject: a table of `data/report/sentences.toml`."""
    table: dict[str, Any] = tomllib.loads((shipped_data() / "report" / "sentences.toml").read_text(encoding="utf-8"))
    return table[subject]


def two_digits(value: float) -> str:
    """An uncertainty to two significant digits, including a 0, without an exponent (GUM 7.2.6)."""
    return f"{Decimal(f'{value:.1e}'):f}" if math.isfinite(value) and value else f"{value:g}"


def three_digits(value: float) -> str:
    """Three digits, without an exponent where the number is large."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def three_digits_fixed(value: float) -> str:
    """Exactly three significant digits, without an exponent."""
    return f"{Decimal(f'{value:.2e}'):f}" if math.isfinite(value) and value else f"{value:g}"


def optional(number: Callable[[float], str], value: float | None, missing: str = "") -> str:
    """A number as `number` prints it; `missing` for None."""
    return missing if value is None else number(value)


def to_digits(value: float, sd: float) -> str:
    """A number to the digits of a standard uncertainty, which is not printed."""
    return concise(value, sd).partition("(")[0]


def signed(value: float, sd: float) -> str:
    """A difference as `concise`, always with its sign."""
    text = concise(value, sd)
    return text if text.startswith("-") else f"+{text}"


def percent(probability: float) -> str:
    """A probability from draws, never printed as 0 or 100 %."""
    return "> 99.9 %" if probability > 0.999 else "< 0.1 %" if probability < 0.001 else f"{100 * probability:.1f} %"


def degrees_of_freedom(dof: float | None) -> str:
    """Effective degrees of freedom; None are infinitely many."""
    return "infinite" if dof is None else f"{dof:.0f}"


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


def made_by(tier: str) -> str:
    """The method of the numbers in words, by tier, or by estimator where results have no tier."""
    return MADE_BY.get(tier, f"posterior sampled by {tier}")


def name_in_words(name: str) -> str:
    """A quantity in words, with its part and unit: "laser's direction, x, deg"; other names are unchanged."""
    quantity = QUANTITIES.get(name)
    return name if quantity is None or not quantity.words else quantity.in_words


def source_in_words(source: str) -> str:
    """A row of a budget in words, with part and unit: a parameter or its prior; others are unchanged."""
    for prefix, article in (("prior of ln ", ""), ("prior of ", "the ")):
        if source.startswith(prefix):
            name = source.removeprefix(prefix)
            words = name_in_words(name)
            return prefix + article * (words != name) + words
    return name_in_words(source)


def share_in_words(cause: str) -> str:
    """A cause of uncertainty in a table of shares: the priors of a group are one cause; others are unchanged."""
    name = cause.removeprefix("prior of ")
    return f"prior of {IN_WORDS[name]}" if cause != name and name in IN_WORDS else cause


def cause_in_words(cause: str) -> str:
    """A cause of uncertainty in a sentence."""
    name = cause.removeprefix("prior of ")
    return f"{IN_WORDS[name]} as stated beforehand" if name in IN_WORDS else cause


def sentence_in_words(text: str) -> str:
    """A sentence with words in place of names of parameters; commands between backticks are unchanged."""

    def words(match: re.Match[str]) -> str:
        name = match.group()
        quantity = QUANTITIES.get(name)
        if quantity is None or not quantity.words:
            return IN_WORDS.get(name, name)
        return f"{quantity.words} ({' '.join(quantity.parts)})" if quantity.parts else quantity.words

    return "`".join(part if k % 2 else _NAMES.sub(words, part) for k, part in enumerate(text.split("`")))


def text_width() -> int:
    """Columns of the terminal behind stdout, at most `COLUMNS`; `COLUMNS` for files and pipes."""
    is_terminal = sys.stdout is not None and sys.stdout.isatty()
    return min(COLUMNS, shutil.get_terminal_size().columns) if is_terminal else COLUMNS


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
        room, cells = text_width(), [self.columns, *self.rows]
        count = max(1, *map(len, cells))
        widths = [max((cell_len(row[k]) for row in cells if k < len(row)), default=0) + GAP for k in range(count)]
        title = textwrap.wrap(self.caption, room, break_long_words=False, break_on_hyphens=False)
        parts = _parts(widths, room)
        is_uneven = len(parts) > 1 and (len(parts[0]) == 2 or len(parts[0]) != len(parts[-1]))
        if is_uneven and sum(widths[1:]) <= room:
            firsts = [row[0] for row in (cells[1:] if self.pairs else cells)]
            others = self._part(range(1, count)).split("\n")
            pairs = zip(firsts, others, strict=True)
            rows = [line for first, rest in pairs for line in (first, " " * GAP + rest) if line.strip()]
            return "\n".join([*title, *rows])
        return "\n".join([*title, *(self._part(columns) for columns in parts)])

    def _part(self, columns: Iterable[int]) -> str:
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


def _parts(widths: Sequence[int], room: int) -> list[list[int]]:
    """Columns of every part: the first column and as many others as fit, about equally many in each part."""
    others = len(widths) - 1

    def parts(size: int) -> list[list[int]]:
        return [[0, *range(k, min(k + size, others + 1))] for k in range(1, others + 1, size)] or [[0]]

    def fits(size: int) -> bool:
        return all(sum(widths[k] for k in part) - GAP <= room for part in parts(size))

    widest = next((size for size in range(others, 1, -1) if fits(size)), 1)
    balanced = math.ceil(others / len(parts(widest))) or 1
    return parts(balanced if fits(balanced) else widest)


def table[Row](caption: str, rows: Iterable[Row], columns: Mapping[str, Callable[[Row], str]]) -> TableView:
    """A table of rows by columns: a heading, and how the column prints a row."""
    return TableView(caption, [*columns], [[cell(row) for cell in columns.values()] for row in rows])


def present(table: TableView) -> TableView | None:
    """A table; None where it has no rows."""
    return table if table.rows else None
