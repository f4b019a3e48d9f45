"""Columns of a foreign table: what they hold, which field each is, what is asked where several could be one.

A table of an axis, of sightings and of looks has its fields and a role for each column; `Chooser` gives every field
the column that the user states, that has its name, or that alone has its role.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice, pairwise
from typing import Any

import numpy as np

from tvsbayes.errors import Candidate, InputError, Question, closest, escaped
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.asking import asked, listed, refused
from tvsbayes.importing.cells import FLAGS, mark_of, plain_column
from tvsbayes.importing.clock import is_clock
from tvsbayes.importing.table import ForeignTable
from tvsbayes.importing.words import Name, Unit, name_of

SEGMENT_MAX, SEGMENT_SHARE = 1000, 0.5
"""A segment is a whole number up to the first, that changes in at most this share of the rows."""
SAMPLES = 3
"""Number of first values of a column to show."""
NUMERIC_SHARE = 0.5


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
    def unit(self) -> Unit | None:
        """The unit in its cells, else in its name."""
        return plain_column(self.name.text, self.cells).unit or self.name.unit

    @property
    def _finite(self) -> np.ndarray:
        return self.values[np.isfinite(self.values)]

    @cached_property
    def numeric(self) -> bool:
        """Whether it holds numbers, of which some differ."""
        filled = sum(map(bool, self.cells))
        return len(self._finite) > NUMERIC_SHARE * filled and len(np.unique(self._finite)) > 1

    @cached_property
    def has_digits(self) -> bool:
        """Whether most of its cells, of which some differ, are written with digits, though not as times."""
        filled = [cell for cell in self.cells if cell]
        written = sum(cell[:1].isdigit() or cell[:1] in "+-.,\u2212" for cell in filled)
        return written > NUMERIC_SHARE * len(filled) and len(set(filled)) > 1 and not is_clock(filled)

    @property
    def whole(self) -> bool:
        """Whether all its numbers are whole."""
        return len(self._finite) > 0 and bool(np.all(self._finite == np.round(self._finite)))

    @property
    def first(self) -> list[str]:
        """Its first values."""
        return first_values(self.cells)

    @property
    def counts_homings(self) -> bool:
        """Whether its cells count homings or mark them: few small whole numbers or marks that seldom change."""
        words = list(map(mark_of, self.cells))
        changes = sum(a != b for a, b in pairwise(words))
        if all(word in FLAGS or (word.isdigit() and int(word) <= SEGMENT_MAX) for word in words):
            return changes <= SEGMENT_SHARE * max(len(words), 4)
        return not any(map(NUMBER.fullmatch, words)) and changes <= SEGMENT_SHARE * len(words)


def columns_of(table: ForeignTable) -> dict[str, Column]:
    """The columns of a table by name."""
    return {text: Column(name_of(text), cells) for text, cells in table.columns.items()}


def first_values(cells: Iterable[str]) -> list[str]:
    """The first cells of a column that are not empty: many tables start with rows without a look."""
    return list(islice(filter(None, cells), SAMPLES))


def factor_between(unit: Unit | None, other: Unit | None) -> float | None:
    """Numbers of another unit in one of a unit: 1 where one states none; None where they are of two kinds."""
    return 1.0 if unit is None or other is None else unit.in_units_of(other)


def line_through(x: np.ndarray, y: np.ndarray) -> tuple[float, np.ndarray]:
    """Slope of the least-squares line, and the residuals; nan where all x are one number or numbers are too large."""
    with np.errstate(all="ignore"):
        dx, dy = x - x.mean(), y - y.mean()
        slope = float(np.divide(dx @ dy, dx @ dx))
        return slope, dy - slope * dx


FILL_HUGE, FILLS_TRIED = 1e15, 8
"""Least number that no machine reads, and how many different numbers are tried as fills."""
FILLED_MIN, FILL_SHARE, FILL_SDS = 4, 0.2, 20.0
"""Fewest other readings, and least distance from their line, as a share of their range and in standard deviations about
it, of a number that may stand for no reading."""


def fill_values(x: np.ndarray, y: np.ndarray) -> list[float]:
    """Numbers in y, far from the line of the others over x, that an instrument writes where it read nothing.

    Such a number comes again at different x, or has nines alone.
    """
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    fills = []
    # They lie farthest from the line of all, or are too large for one.
    plain = np.abs(y) < FILL_HUGE
    off = np.full(len(y), np.inf)
    if plain.sum() > 1:
        off[plain] = np.abs(line_through(x[plain], y[plain])[1])
    farthest = y[np.argsort(-off, kind="stable")]
    _, first = np.unique(farthest, return_index=True)
    for fill in np.sort(farthest[np.sort(first)[:FILLS_TRIED]]):
        at = y == fill
        rest = ~at & plain
        if 4 * at.sum() > len(y) or rest.sum() < FILLED_MIN or not np.ptp(x[rest]) or not np.ptp(y[rest]):
            continue
        slope, off = line_through(x[rest], y[rest])
        if not np.isfinite(off).all():
            continue
        away = np.abs(fill - y[rest].mean() - slope * (x[at] - x[rest].mean()))
        far = away > max(FILL_SHARE * np.ptp(y[rest]), FILL_SDS * float(np.std(off)))
        usual = abs(fill) >= FILL_HUGE or fill in (0, -1) or (abs(fill) >= 99 and {*str(abs(int(fill)))} == {"9"})
        if far.all() and (usual or len(np.unique(x[at])) > 1):
            fills.append(float(fill))
    return fills


ROOM_DEGC = (10.0, 40.0)
"""Temperatures of a room."""
JUMP_SHARE = 0.1
"""Largest difference of the jumps of a dial, and of other steps from their line, as a share of a jump."""


def restarts(command: np.ndarray, value: np.ndarray, least: int = 2) -> np.ndarray:
    """Sizes of the jumps of readings that follow the commands but for jumps of one size, as of a dial; else none.

    Args:
        command: commands, shape (rows,).
        value: readings.
        least: fewest jumps.
    """
    dc, dv = np.diff(command), np.diff(value)
    moved = dc != 0
    if moved.sum() < 2 or np.ptp(value) == 0 or fill_values(command, value):
        return np.zeros(0)
    off = np.abs(dv - np.median(dv[moved] / dc[moved]) * dc)
    far = off > 0.5 * np.ptp(value)
    alike = far.sum() >= least and np.ptp(off[far]) < JUMP_SHARE * off[far].min()
    return off[far] if alike and (far.all() or off[~far].max() < JUMP_SHARE * off[far].min()) else np.zeros(0)


def asked_of_dial(jumps: np.ndarray, unit: Unit | None) -> Question:
    """The question after which reading a dial begins again."""
    size = float(jumps.mean())
    turns = dict.fromkeys((10.0 ** round(np.log10(size)), float(f"{size:.2g}")))
    return asked("dial", "value", each=turns, jump=size, times=len(jumps), unit=unit.name if unit else "")


# --- choosing --------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Understood:
    """Columns of a table by the field to which they belong, those that are not used, and remarks in words."""

    columns: dict[str, str]
    unused: tuple[str, ...]
    remarks: tuple[str, ...] = ()


@dataclass
class Chooser:
    """The columns of a table by field.

    Attributes:
        table: the table.
        stated: column by field, as the user states it; "" where the table has no such column.
        fields: all fields that it can have.
        known: columns by name.
        taken: columns by field so far: those stated, those by the names of our files, and what is taken after that.
        roles: the other columns by what each may be, in their order.
        remarks: what is said of the choice.
    """

    table: ForeignTable
    stated: Mapping[str, str]
    fields: Sequence[str]
    known: dict[str, Column]
    taken: dict[str, str]
    roles: dict[str, list[str]] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)

    @classmethod
    def of(
        cls,
        table: ForeignTable,
        stated: Mapping[str, str],
        fields: Sequence[str],
        role_of: Callable[[Column], str | None],
    ) -> Chooser:
        """The columns as stated and as our files name them, the others by their role.

        Raises:
            InputError: a field or a column that does not exist.
        """
        known = columns_of(table)
        for name, text in stated.items():
            for what, word, allowed in (("field", name, fields), ("column", text, list(known))):
                if word and word not in allowed:
                    names = ", ".join(map(escaped, allowed))
                    message = f"--column {escaped(name)}={escaped(text)}: no such {what}; allowed: {names}"
                    raise InputError("usage", message, allowed=names, remedy=closest(word, allowed))
        taken = {name: text for name, text in stated.items() if text}
        taken |= {f: f for f in known if f in fields and f not in stated and f not in taken.values()}
        chooser = cls(table, stated, fields, known, taken)
        for text, column in known.items():
            role = None if text in taken.values() else role_of(column)
            if role is not None:
                chooser.roles.setdefault(role, []).append(text)
        return chooser

    def of_role(self, *roles: str) -> list[str]:
        """Columns of some roles that no field has yet."""
        return [name for role in roles for name in self.roles.get(role, ()) if name not in self.taken.values()]

    def is_open(self, name: str) -> bool:
        """Whether neither the user nor a name of our files says which column a field is."""
        return name not in self.stated and name not in self.taken

    def take(self, name: str, texts: Sequence[str] | None = None, *, optional: bool = True, what: str = "") -> None:
        """Give a field the only column that could be it, by its role or of these.

        Raises:
            Question: several could be it.
        """
        texts = self.roles.get(name, []) if texts is None else texts
        if not self.is_open(name) or not texts:
            return
        if len(texts) > 1:
            found = f"{len(texts)} columns {what or f'that could be {name}'} ({listed(texts)})"
            raise self.ask(found, [self.answer({name: text}) for text in (*texts, *([""] if optional else ()))])
        self.taken[name] = texts[0]

    def answer(self, columns: Mapping[str, str], *options: str) -> Candidate:
        """The answer that names columns by field."""
        first = {text: self.known[text].first for text in columns.values() if text}
        words = ", ".join(
            f"{name} = {escaped(text)} ({', '.join(first[text])})" if text else f"no {name}"
            for name, text in columns.items()
        )
        named = [word for name, text in columns.items() for word in ("--column", f"{name}={text}")]
        return Candidate(words, (*named, *options), first)

    def ask(self, found: str, answers: Sequence[Candidate], what: str = "column") -> Question:
        """The question which column is meant, or what it holds."""
        return self.table.ask(what, answers=answers, found=found)

    def missing(self, fields: Sequence[str], hint: str = "") -> InputError:
        """The refusal of a table in which no column can be a field."""
        return missing_columns(self.table, self.taken, fields, fields, hint)

    def understood(self) -> Understood:
        """What was chosen."""
        unused = tuple(text for text in self.known if text not in self.taken.values())
        return Understood(self.taken, unused, tuple(self.remarks))


def missing_columns(
    table: ForeignTable, known: Mapping[str, str], fields: Sequence[str], options: Sequence[str], hint: str
) -> InputError:
    """The refusal of a table without columns for some fields, with the options that name them."""
    if not known and fields == options:
        hint += "; if that line is a title, delete it, so that the first holds the names of the columns"
    said = {"fields": ", ".join(fields), "options": " ".join(f"--column {name}=NAME" for name in options), "hint": hint}
    said["known"] = ", ".join(f"{name} = {escaped(text)}" for name, text in known.items()) or "nothing"
    names = listed(table.columns, len(table.columns))
    return refused("missing-column", table.file, line=table.first_line, names=names, **said)


def ask_of_t(chooser: Chooser) -> None:
    """Ask whether a column T, which rises as times do, is a clock or a thermometer.

    Raises:
        Question: it is the only clock, and its numbers are temperatures of a room as well.
    """
    clocks = chooser.roles.get("time_s", []) if chooser.is_open("time_s") else []
    if len(clocks) == 1 and _may_be_degC(chooser.known[clocks[0]]):
        found = f"column {escaped(clocks[0])}, which could be a clock or a thermometer"
        columns = ({"time_s": clocks[0]}, {"temperature_degC": clocks[0]}, {"time_s": ""})
        raise chooser.ask(found, list(map(chooser.answer, columns)))


def _may_be_degC(column: Column) -> bool:
    """Whether a column T holds temperatures of a room as well as times."""
    values, (low, high) = column.values, ROOM_DEGC
    is_room = np.isfinite(values).all() and values[0] and np.all((low <= values) & (values <= high))
    return column.name.text.strip() == "T" and bool(is_room) and float(np.ptp(values)) < 0.5 * (high - low)


# --- showing ---------------------------------------------------------------------------------------------------------
def table_document(table: ForeignTable, mapping: Understood) -> dict[str, Any]:
    """The columns of a table by field, for programs."""
    columns = {
        name: {"column": text, "first": first_values(table.columns[text]), "empty": table.columns[text].count("")}
        for name, text in mapping.columns.items()
    }
    head = {"file": table.file, "kind": table.kind, "rows": len(table)}
    return {**head, "columns": columns, "unused": list(mapping.unused)}


def table_lines(table: ForeignTable, mapping: Understood, fields: Sequence[str], units: Mapping[str, str]) -> list[str]:
    """Fields with their columns, units and first values."""
    rows = [("field", "column", "read as", "first values")]
    for name in (name for name in fields if name in mapping.columns):
        text = mapping.columns[name]
        cells, empty = table.columns[text], table.columns[text].count("")
        first = ", ".join(escaped(cell, 12) for cell in first_values(cells)) or "none"
        first += f" ({empty} of {len(cells)} empty)" * bool(empty)
        rows.append((name, escaped(text, 24), units.get(name, ""), first))
    widths = [max(len(row[k]) for row in rows) for k in range(3)]
    lines = [f"{table.file}: {table.kind}; {len(table)} rows"]
    lines += ["  ".join([*(cell.ljust(w) for cell, w in zip(row, widths, strict=False)), row[3]]) for row in rows]
    return [*lines, *([f"not used: {listed(mapping.unused, len(mapping.unused))}"] if mapping.unused else [])]
