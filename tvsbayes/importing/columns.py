"""Columns of a foreign table by field, and the questions about them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np

from tvsbayes.errors import Candidate, InputError, Question, closest, escaped, question, refusal
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.cells import is_clock, plain_column
from tvsbayes.importing.table import ForeignTable
from tvsbayes.importing.words import Name, Unit, listed, name_of

SAMPLES = 3
"""Number of first values of a column to show."""
NUMERIC_SHARE = 0.5
CANDIDATES_MAX = 6


@dataclass(frozen=True)
class Column:
    """A column: its name and cells."""

    name: Name
    cells: tuple[str, ...]

    @cached_property
    def values(self) -> np.ndarray:
        """Its numbers, nan for other cells."""
        cells = plain_column(self.name.text, self.cells).cells
        return np.array([float(cell) if NUMBER.fullmatch(cell) else np.nan for cell in cells])

    @cached_property
    def numeric(self) -> bool:
        """Whether it holds numbers, of which some differ."""
        finite = self.values[np.isfinite(self.values)]
        filled = sum(map(bool, self.cells))
        return len(finite) > NUMERIC_SHARE * filled and len(np.unique(finite)) > 1

    @cached_property
    def has_digits(self) -> bool:
        """Whether most of its cells, of which some differ, are written with digits, though not as times."""
        filled = [cell for cell in self.cells if cell]
        written = sum(cell[:1].isdigit() or cell[:1] in "+-.,\u2212" for cell in filled)
        return written > NUMERIC_SHARE * len(filled) and len(set(filled)) > 1 and not is_clock(filled)

    @property
    def whole(self) -> bool:
        """Whether all its numbers are whole."""
        finite = self.values[np.isfinite(self.values)]
        return bool(len(finite)) and bool(np.all(finite == np.round(finite)))

    @property
    def first(self) -> list[str]:
        """Its first values."""
        return first_values(self.cells)


@dataclass(frozen=True)
class Understood:
    """Columns of a table by the field to which they belong, those that are not used, and remarks in words."""

    columns: dict[str, str]
    unused: tuple[str, ...]
    remarks: tuple[str, ...] = ()


def columns_of(table: ForeignTable) -> dict[str, Column]:
    """The columns of a table by name."""
    return {text: Column(name_of(text), cells) for text, cells in table.columns.items()}


def check_stated(names: Sequence[str], stated: Mapping[str, str], fields: Sequence[str]) -> None:
    """Refuse a field or a column that does not exist."""
    for field, name in stated.items():
        option = f"--column {escaped(field)}={escaped(name)}"
        if field not in fields:
            allowed, remedy = ", ".join(fields), closest(field, fields)
            raise InputError("usage", f"{option}: no such field; allowed: {allowed}", allowed=allowed, remedy=remedy)
        if name and name not in names:
            allowed, remedy = ", ".join(map(escaped, names)), closest(name, names)
            raise InputError("usage", f"{option}: no such column; allowed: {allowed}", allowed=allowed, remedy=remedy)


def choice(columns: Mapping[str, str], known: Mapping[str, Column], *options: str) -> Candidate:
    """The answer that names columns by field."""
    words = ", ".join(
        f"{field} = {escaped(name)} ({', '.join(known[name].first)})" if name else f"no {field}"
        for field, name in columns.items()
    )
    named = [word for field, name in columns.items() for word in ("--column", f"{field}={name}")]
    return Candidate(words, (*named, *options), {name: known[name].first for name in columns.values() if name})


def ask_column(
    table: ForeignTable,
    found: str,
    candidates: Sequence[Candidate],
    allowed: str = "columns that are named",
    code: str = "missing-column",
) -> Question:
    """The question which column is meant, or what it holds."""
    few = candidates[:CANDIDATES_MAX]
    return question(file=table.file, line=table.first_line, found=found, allowed=allowed, candidates=few, code=code)


def missing_column(
    table: ForeignTable, understood: Mapping[str, str], missing: Sequence[str], hint: str = ""
) -> InputError:
    """The refusal of a table in which no column can be a field."""
    known = ", ".join(f"{field} = {escaped(name)}" for field, name in understood.items()) or "nothing"
    found = f"no column that is surely {', '.join(missing)}; understood so far: {known}"
    remedy = f"say which: {' '.join(f'--column {field}=NAME' for field in missing)}{hint}"
    if not understood:
        remedy += "; if that line is a title, delete it, so that the first holds the names of the columns"
    names = ", ".join(map(escaped, table.columns))
    return refusal(
        "missing-column", file=table.file, line=table.first_line, found=found, allowed=f"any of {names}", remedy=remedy
    )


def first_values(cells: Iterable[str]) -> list[str]:
    """The first cells of a column that are not empty: many tables start with rows without a look."""
    return list(islice(filter(None, cells), SAMPLES))


def table_document(table: ForeignTable, mapping: Understood) -> dict[str, Any]:
    """The columns of a table by field, for programs."""
    columns = {
        field: {"column": name, "first": first_values(table.columns[name]), "empty": table.columns[name].count("")}
        for field, name in mapping.columns.items()
    }
    head = {"file": table.file, "kind": table.kind, "rows": len(table)}
    return {**head, "columns": columns, "unused": list(mapping.unused)}


def table_lines(table: ForeignTable, mapping: Understood, fields: Sequence[str], units: Mapping[str, str]) -> list[str]:
    """Fields with their columns, units and first values."""
    rows = [("field", "column", "read as", "first values")]
    for field in (field for field in fields if field in mapping.columns):
        name = mapping.columns[field]
        cells, empty = table.columns[name], table.columns[name].count("")
        first = ", ".join(escaped(cell, 12) for cell in first_values(cells)) or "none"
        first += f" ({empty} of {len(cells)} empty)" * bool(empty)
        rows.append((field, escaped(name, 24), units.get(field, ""), first))
    widths = [max(len(row[k]) for row in rows) for k in range(3)]
    lines = [f"{table.file}: {table.kind}; {len(table)} rows"]
    lines += ["  ".join([*(cell.ljust(w) for cell, w in zip(row, widths, strict=False)), row[3]]) for row in rows]
    return [*lines, *([f"not used: {listed(mapping.unused, len(mapping.unused))}"] if mapping.unused else [])]


def factor_between(unit: Unit | None, other: Unit | None) -> float | None:
    """Numbers of another unit in one of a unit: 1 where one states none; None where they are of two kinds."""
    return 1.0 if unit is None or other is None else unit.in_units_of(other)
