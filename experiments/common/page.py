"""Lines of a page: Markdown tables, shares with their bounds."""

from __future__ import annotations

from collections.abc import Iterable


def line(*cells: object) -> str:
    """A row of a table."""
    return f"| {' | '.join(map(str, cells))} |"


def heading(*titles: str) -> str:
    """The first two rows of a table; a title may be several with bars between them."""
    first = line(*titles)
    return f"{first}\n|{'---|' * (first.count(' | ') + 1)}"


def table(titles: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """A table."""
    return "\n".join([heading(*titles), *(line(*row) for row in rows)])
