"""The columns of a table as `import` maps them to fields: shown before anything is written, or refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any

from tvsbayes.errors import InputError, escaped, refusal

if TYPE_CHECKING:
    from tvsbayes.files.foreign_table import ForeignTable
    from tvsbayes.instrument.column_names import ColumnMapping

SAMPLES = 3
"""Number of first values of a column to show."""
NAMES_LISTED = 6
"""Largest number of unused columns in a line."""
CORRECT_HINT = ", or correct it with --column"


def first_values(cells: Sequence[str]) -> list[str]:
    """The first cells of a column that are not empty: many tables start with rows without a look."""
    return list(islice(filter(None, cells), SAMPLES))


def first_names(names: Sequence[str]) -> str:
    """The first names, escaped, and the number of the others."""
    rest = f" and {len(names) - NAMES_LISTED} more" if len(names) > NAMES_LISTED else ""
    return ", ".join(escaped(name) for name in names[:NAMES_LISTED]) + rest


def table_document(table: ForeignTable, mapping: ColumnMapping) -> dict[str, Any]:
    """The mapping of the columns, for programs."""
    columns = {
        field: {"column": name, "first": first_values(table.columns[name]), "empty": table.columns[name].count("")}
        for field, name in mapping.columns.items()
    }
    head = {"file": table.file, "kind": table.kind, "rows": len(table)}
    return {**head, "columns": columns, "unused": list(mapping.unused)}


def table_lines(
    table: ForeignTable, mapping: ColumnMapping, fields: Sequence[str], unit: Callable[[str, str], str]
) -> list[str]:
    """Fields with their columns, units and first values; `unit` of a field and its column."""
    rows = [("field", "column", "read as", "first values")]
    for field in (field for field in fields if field in mapping.columns):
        name = mapping.columns[field]
        cells, empty = table.columns[name], table.columns[name].count("")
        first = ", ".join(escaped(cell, 12) for cell in first_values(cells)) or "none"
        first += f" ({empty} of {len(cells)} empty)" * bool(empty)
        rows.append((field, escaped(name, 24), unit(field, name), first))
    widths = [max(len(row[k]) for row in rows) for k in range(3)]
    lines = [f"{table.file}: {table.kind}; {len(table)} rows"]
    lines += ["  ".join([*(cell.ljust(w) for cell, w in zip(row, widths, strict=False)), row[3]]) for row in rows]
    return [*lines, *([f"not used: {first_names(mapping.unused)}"] if mapping.unused else [])]


def column_refusal(
    table: ForeignTable,
    known: ColumnMapping,
    missing: Sequence[str],
    fields: Sequence[str],
    needed: Sequence[str],
    hint: str = "",
) -> InputError:
    """The refusal of a table with missing or ambiguous columns, with the known ones; `needed` fields are required."""
    missing = list(dict.fromkeys((*missing, *known.ambiguous)))
    ambiguous = [f"{field} ({' or '.join(map(escaped, columns))})" for field, columns in known.ambiguous.items()]
    found = f"no column that is surely {', '.join([*(f for f in missing if f not in known.ambiguous), *ambiguous])}"
    understood = ", ".join(f"{field} = {escaped(known.columns[field])}" for field in fields if field in known.columns)
    found += f"; understood so far: {understood or 'nothing'}"
    remedy = f"say which: {' '.join(f'--column {field}=NAME' for field in missing)}"
    optional = [field for field in missing if field not in needed]
    remedy += (f"; --column {optional[0]}= where there is none" if optional else "") + hint
    if not understood and not ambiguous:
        remedy += "; if that line is a title, delete it, so that the first holds the names of the columns"
    names = ", ".join(escaped(name) for name in table.columns)
    line, allowed = table.first_line, f"any of {names}"
    return refusal("missing-column", file=table.file, line=line, found=found, allowed=allowed, remedy=remedy)
