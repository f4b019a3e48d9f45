"""What `import` understood of a table's columns: shown before anything is written, and where it must be asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any

from tvsbayes.errors import InputError, escaped, refusal

if TYPE_CHECKING:
    from tvsbayes.files.foreign_table import ForeignTable
    from tvsbayes.instrument.column_names import ColumnMapping

SAMPLES = 3
"""First values of a column that are shown."""
NAMES_LISTED = 6
"""Of columns that are not used, in a line."""
CORRECT_IT = ", or correct it with --column"


def first_values(cells: Sequence[str]) -> list[str]:
    """The first cells of a column that hold anything: rows without a look begin many tables."""
    return list(islice(filter(None, cells), SAMPLES))


def few(names: Sequence[str]) -> str:
    """The first of them, fit to print, and how many more there are."""
    more = f" and {len(names) - NAMES_LISTED} more" if len(names) > NAMES_LISTED else ""
    return ", ".join(escaped(name) for name in names[:NAMES_LISTED]) + more


def table_document(table: ForeignTable, known: ColumnMapping) -> dict[str, Any]:
    """What was understood, for programs."""
    columns = {
        field: {"column": name, "first": first_values(table.columns[name]), "empty": table.columns[name].count("")}
        for field, name in known.columns.items()
    }
    head = {"file": table.file, "kind": table.kind, "rows": len(table)}
    return {**head, "columns": columns, "unused": list(known.unused)}


def table_lines(
    table: ForeignTable, known: ColumnMapping, fields: Sequence[str], unit: Callable[[str, str], str]
) -> list[str]:
    """The columns that were found beside their fields, units and first values; `unit` of a field and its column."""
    rows = [("field", "column", "read as", "first values")]
    for field in (field for field in fields if field in known.columns):
        name = known.columns[field]
        cells, empty = table.columns[name], table.columns[name].count("")
        first = ", ".join(escaped(cell, 12) for cell in first_values(cells)) or "none"
        first += f" ({empty} of {len(cells)} empty)" * bool(empty)
        rows.append((field, escaped(name, 24), unit(field, name), first))
    widths = [max(len(row[k]) for row in rows) for k in range(3)]
    lines = [f"{table.file}: {table.kind}; {len(table)} rows"]
    lines += ["  ".join([*(cell.ljust(w) for cell, w in zip(row, widths, strict=False)), row[3]]) for row in rows]
    return [*lines, *([f"not used: {few(known.unused)}"] if known.unused else [])]


def not_sure(
    table: ForeignTable,
    known: ColumnMapping,
    missing: Sequence[str],
    fields: Sequence[str],
    needed: Sequence[str],
    besides: str = "",
) -> InputError:
    """The refusal of a table whose columns do not say enough, with what they say; `needed` ones must be there."""
    claims = [f"{field} ({' or '.join(map(escaped, columns))})" for field, columns in known.ambiguous.items()]
    found = f"no column that is surely {', '.join([*(f for f in missing if f not in known.ambiguous), *claims])}"
    understood = ", ".join(f"{field} = {escaped(known.columns[field])}" for field in fields if field in known.columns)
    found += f"; understood so far: {understood or 'nothing'}"
    remedy = f"say which: {' '.join(f'--column {field}=NAME' for field in missing)}"
    spare = [field for field in missing if field not in needed]
    remedy += (f"; --column {spare[0]}= where there is none" if spare else "") + besides
    if not understood and not claims:
        remedy += "; if that line is a title, delete it, so that the first holds the names of the columns"
    names = ", ".join(escaped(name) for name in table.columns)
    line, allowed = table.first_line, f"any of {names}"
    return refusal("missing-column", file=table.file, line=line, found=found, allowed=allowed, remedy=remedy)


def import_end(written: Sequence[str], following: str, otherwise: str = "") -> str:
    """The last lines of an import: what was written and what is next, or how to write it."""
    if not written:
        return f"nothing written: add --yes{otherwise}"
    return f"written: {', '.join(written)}\nnext: {following}"
