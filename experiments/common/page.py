"""Lines of a page: Markdown tables, shares with their bounds."""

from __future__ import annotations

from collections.abc import Iterable

from tvsbayes.statistics.chances import share_interval95


def line(*cells: object) -> str:
    """A row of a table."""
    return f"| {' | '.join(map(str, cells))} |"


def heading(*titles: str) -> str:
    """The first two rows of a table; a title may be several with bars between them."""
    first = line(*titles)
    return f"{first}\n|{'---|' * (first.count(' | ') + 1)}"


def share(hits: int, count: int) -> str:
    """A share in percent, with its 95 % interval (Clopper and Pearson)."""
    low, high = share_interval95(hits, count)
    return f"{100 * hits / count:.1f} % ({100 * low:.1f} to {100 * high:.1f})"


def table(titles: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """A table."""
    return "\n".join([heading(*titles), *(line(*row) for row in rows)])
