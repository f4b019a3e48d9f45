"""Kinds of CSV files: a dataclass whose fields declare the columns.

One declaration gives reader, writer, the table in the documentation and the comment in a template. Name, type and
default are those of the field; its `Column` holds the rest: `x_deg: Annotated[float | None, Column(...)] = None`.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from itertools import groupby
from typing import Any, get_args, get_type_hints

from tvsbayes.errors import refusal, shown
from tvsbayes.files.csv_table import Table, csv_bytes, parse_table
from tvsbayes.files.disk import shipped_data

ID_MAX = 10**9
"""Largest number of a row."""
UNITS = frozenset(("s", "ms", "min", "steps", "px", "mm", "m", "deg", "rad", "K", "degC", "hPa"))
"""Units that end the name of a column."""
COMMENT_CHARS = 120
"""Length of a comment line in a template."""
Values = Mapping[str, Sequence[Any]]
"""Cells of a table by column, converted to the column's type."""


@dataclass(frozen=True)
class Column:
    """A column of a table, as the field of a row declares it.

    Attributes:
        meaning: description of its content, in Markdown; "" where it shares the words of the column before.
        low, high: limits of a number; both of the type of the column.
        chars_max: largest length of a text.
        filled: an empty text is refused. An empty number is refused where the field has no default.
        group: columns of one group may be missing; they are written together where one of them is not at its default.
        rule: check of the column after all cells of the table are read; raises its error.
        name, kind, words, default: taken from the field; `words` are those of a `Literal`, which its rule must check;
            the default is MISSING where there is none.
    """

    meaning: str
    low: float = 0
    high: float = ID_MAX
    chars_max: int = 100
    filled: bool = False
    group: str = ""
    rule: Callable[[Table, Column, Values], None] | None = None
    name: str = field(default="", kw_only=True)
    kind: type = field(default=str, kw_only=True)
    words: tuple[str, ...] = field(default=(), kw_only=True)
    default: Any = field(default=None, kw_only=True)

    @property
    def unit(self) -> str:
        """Unit that ends the name; "" where there is none."""
        unit = self.name.rpartition("_")[2]
        return unit if unit in UNITS else ""

    @property
    def may_be_empty(self) -> bool:
        """Whether an empty cell of a number stands for the default."""
        return self.default is not MISSING

    def values(self, table: Table) -> Sequence[Any]:
        """The checked cells of a table; defaults where the column is missing."""
        if self.name not in table.columns:
            return [self.default] * len(table)
        if self.words:
            return table.columns[self.name]
        if self.kind is str:
            return table.texts(self.name, self.chars_max, not self.filled)
        values = table.numbers(self.name, self.kind, self.low, self.high, self.may_be_empty)
        filled = self.default is MISSING or self.default is None
        return values if filled else [self.default if value is None else value for value in values]


def _leaves(hint: object) -> list[object]:
    """The types and the words of literals in a type."""
    return [leaf for argument in get_args(hint) for leaf in _leaves(argument)] or [hint]


class CsvKind[Row]:
    """A kind of CSV file.

    Attributes:
        row: dataclass of a row.
        file: name of the file.
        about: what a row stands for, in the words of a template's comment.
        no_rows: allowed content and remedy for a table without rows; None where a table without rows is allowed.
        template: rows of the file that `new` writes.
        columns: by name, in the order in which they are written.
    """

    def __init__(
        self,
        row: type[Row],
        file: str,
        about: str = "",
        no_rows: tuple[str, str] | None = None,
        template: Sequence[Row] = (),
    ) -> None:
        self.row, self.file, self.about, self.no_rows, self.template = row, file, about, no_rows, template
        self.columns: dict[str, Column] = {}
        hints, meaning = get_type_hints(row, include_extras=True), ""
        for entry in fields(row):  # type: ignore[arg-type]
            hint, column = get_args(hints[entry.name])
            leaves = _leaves(hint)
            words = tuple(leaf for leaf in leaves if isinstance(leaf, str))
            kind = next((candidate for candidate in (int, float) if candidate in leaves), str)
            meaning = column.meaning or meaning
            self.columns[entry.name] = replace(
                column, name=entry.name, kind=kind, words=words, default=entry.default, meaning=meaning
            )

    def __getitem__(self, name: str) -> Column:
        return self.columns[name]

    @property
    def required(self) -> tuple[str, ...]:
        """Columns that a file must have."""
        return tuple(name for name, column in self.columns.items() if not column.group)

    @property
    def optional(self) -> tuple[str, ...]:
        """Columns that it may have."""
        return tuple(name for name, column in self.columns.items() if column.group)

    def values(self, table: Table) -> dict[str, Sequence[Any]]:
        """The checked cells of a table by column.

        Raises:
            InputError: a cell is not a value of its column, or its rule refuses it.
        """
        values = {name: column.values(table) for name, column in self.columns.items()}
        for column in self.columns.values():
            if column.rule is not None and column.name in table.columns:
                column.rule(table, column, values)
        return values

    def parse(self, data: bytes, file: str, *checks: Callable[[Table, Values], None]) -> tuple[Row, ...]:
        """The checked rows of a file.

        Args:
            data: its bytes.
            file: its name, for errors.
            checks: further checks, on more than one column.

        Raises:
            InputError: from `parse_table`, `values` and `checks`, or a required row is missing.
        """
        table = parse_table(data, file, self.required, self.optional)
        if self.no_rows and not len(table):
            allowed, remedy = self.no_rows
            raise refusal("empty", file=file, line=1, found="no rows", allowed=allowed, remedy=remedy)
        values = self.values(table)
        for check in checks:
            check(table, values)
        row = self.row
        return tuple(row(**dict(zip(values, cells, strict=True))) for cells in zip(*values.values(), strict=True))

    def content(self, rows: Iterable[Row]) -> bytes:
        """The content of a file; columns of a group are written only where one of them is not at its default."""
        rows = list(rows)
        groups = {
            c.group for c in self.columns.values() if c.group and any(getattr(r, c.name) != c.default for r in rows)
        }
        names = [name for name, column in self.columns.items() if not column.group or column.group in groups]
        return csv_bytes(names, ([getattr(row, name) for name in names] for row in rows))

    def _meanings(self) -> list[tuple[list[str], str]]:
        """Columns that share a meaning, with the meaning."""
        groups = groupby(self.columns.values(), key=lambda column: column.meaning)
        return [([column.name for column in columns], meaning) for meaning, columns in groups]

    def markdown(self) -> str:
        """The columns as a table for the page on campaign files."""
        lines = [f"| column of `{self.file}` | content |", "|---|---|"]
        lines += [f"| {', '.join(f'`{name}`' for name in names)} | {meaning} |" for names, meaning in self._meanings()]
        return "\n".join(lines) + "\n"

    def comment(self) -> str:
        """The columns as a comment in a template."""
        lines = [f"# {self.file}: {self.about}."]
        for names, meaning in self._meanings():
            text = f"{', '.join(names)}: {meaning}"
            lines += textwrap.wrap(text, COMMENT_CHARS, initial_indent="#   ", subsequent_indent="#     ")
        return "\n".join(lines)


def templates(folder: str, *kinds: CsvKind[Any]) -> dict[str, bytes]:
    """The commented files that `new` writes: shipped files, with a line `# {moves.csv}` replaced by its comment."""
    files = {path.name: path.read_bytes() for path in (shipped_data() / folder).iterdir()}
    for kind in kinds:
        line = f"# {{{kind.file}}}".encode()
        files = {name: data.replace(line, kind.comment().encode()) for name, data in files.items()}
    return dict(sorted({**files, **{kind.file: kind.content(kind.template) for kind in kinds}}.items()))


def counted(table: Table, column: Column, values: Values) -> None:
    """Refuse a column that does not count 0, 1, 2 ..."""
    for row, value in enumerate(values[column.name]):
        if value != row:
            raise table.refuse(row, column.name, "order", f"{row}", "number the rows 0, 1, 2 ... in time order")


def unique(table: Table, column: Column, values: Values) -> None:
    """Refuse a repeated number."""
    refuse_repeated(table, column.name, values[column.name], "unique ids")


def refuse_repeated(table: Table, column: str, values: Iterable[object], allowed: str) -> None:
    """Refuse a repeated value; None is ignored."""
    first_rows: dict[object, int] = {}
    for row, value in enumerate(values):
        if value is not None and first_rows.setdefault(value, row) != row:
            found = f"{shown(table.columns[column][row])} again (first on line {table.lines[first_rows[value]]})"
            raise table.refuse(row, column, "duplicate", allowed, "renumber one of them", found)


def segments_in_time(table: Table, column: Column, values: Values) -> None:
    """Refuse segments that do not begin at 0 or grow by more than one, and a `time_s` that decreases."""
    segments, times_s = values[column.name], values["time_s"]
    for row, (segment, time_s) in enumerate(zip(segments, times_s, strict=True)):
        previous = segments[row - 1] if row else -1
        if segment not in ((previous, previous + 1) if row else (0,)):
            allowed = f"{previous} or {previous + 1}" if row else "0"
            raise table.refuse(row, column.name, "order", allowed, "count segments 0, 1, 2 ... without gaps")
        if row and time_s < times_s[row - 1]:
            allowed = f"at least {times_s[row - 1]!r}, the time of the row before"
            raise table.refuse(row, "time_s", "order", allowed, "list the moves in order of time")


def first_of_segment(table: Table, column: Column, values: Values) -> None:
    """Refuse anything but one of the column's words in the first row of a segment, and nothing in the others."""
    segments = values["segment"]
    for row, word in enumerate(values[column.name]):
        begins = row == 0 or segments[row] != segments[row - 1]
        words = tuple(filter(None, column.words)) if begins else ("",)
        if word not in words:
            allowed = ", ".join(words) if begins else "an empty cell inside a segment"
            remedy = "state how the axis arrived there" if begins else "leave it empty, or begin a segment"
            raise table.refuse(row, column.name, "approach", allowed, remedy)


def filled_where_ok(
    remedy: str,
    allowed: str = "a finite decimal number, or an empty cell with a status other than ok",
    code: str = "missing",
) -> Callable[[Table, Column, Values], None]:
    """The rule that a column has no empty cell where `status` is ok."""

    def rule(table: Table, column: Column, values: Values) -> None:
        for row, cell in enumerate(table.columns[column.name]):
            if not cell and values["status"][row] == "ok":
                raise table.refuse(row, column.name, code, allowed, remedy)

    return rule


def follows_a_move(moves: int, what: str) -> Callable[[Table, Values], None]:
    """The check that `move` names one of the `moves` rows of moves.csv: the last move before `what`."""

    def check(table: Table, values: Values) -> None:
        for row, move in enumerate(values["move"]):
            if move >= moves:
                allowed = f"a row of moves.csv: 0 to {moves - 1}"
                raise table.refuse(row, "move", "missing-move", allowed, f"name the last move before the {what}")

    return check
