"""Tables of other programs, as text cells: text of any usual kind, Markdown, "name: value" lines, workbooks, lab files.

The reader finds and describes encoding, separator, decimal commas, lines above the names and names in a remark. Numbers
get decimal points; cells are otherwise unchanged. Rows count from 1 as in the file; sizes are limited before anything
is unpacked.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

from tvsbayes.errors import InputError, Question, escaped, refusal
from tvsbayes.files.csv_table import NUMBER
from tvsbayes.importing.asking import asked, refused
from tvsbayes.importing.words import means, parse_unit, place_of, words_of

COLUMNS_MAX = 200
CELL_CHARS_MAX = 1000
NUMERIC_SHARE = 0.6
"""Least share of numbers in a column of numbers."""
ACROSS_MIN = 3
"""Least number of positions across a table, and one."""
SHORT_MAX = 3
"""Largest number of rows that are named because they have fewer cells than the others: cut off, perhaps."""
ABOVE_MAX = 50
"""Largest number of lines above the names of columns: serial number, date, operator."""
KINDS = "a table as text (CSV and its like), XLSX, XLS or ODS"
WORKBOOKS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")
"""First bytes of XLSX and ODS (zip), of XLS."""
_COMMA = re.compile(r"[+-]?[0-9]*,[0-9]+(?:[eE][+-]?[0-9]+)?")
_GROUPED_POINT = re.compile(r"[+-]?[0-9]{1,3}(?:,[0-9]{3})+\.[0-9]+")
_GROUPED_COMMA = re.compile(r"[+-]?[0-9]{1,3}(?:\.[0-9]{3})+,[0-9]+")
_GROUPS_OF = {mark: re.compile(rf"[+-]?[1-9][0-9]{{0,2}}(?:[{mark}][0-9]{{3}})+") for mark in ",."}
"""Whole numbers with a mark between thousands, by the mark."""
_APOSTROPHES = re.compile("(?<=[0-9])['\u2019](?=[0-9]{3}(?![0-9]))")
_WITH_UNIT = re.compile(r"([+-]?[0-9][0-9.,]{0,20}) ?([^\W\d]{1,6}|\u00b0)")
STATED = re.compile(r"(?P<name>[^\W\d][^:=]*?)\s*[:=]\s*(?P<text>\S+)")
"""What a cell or a line above the names states: "Unit: mm"."""
_THIN = re.compile("(?<=[0-9])[\u00a0\u2007\u2009\u202f](?=[0-9])")


@dataclass(frozen=True)
class ForeignTable:
    """A table of text cells.

    Attributes:
        file: its name, for messages.
        kind: the detected format, in words.
        lines: row in the file of each row.
        columns: cells by name of column; "column 1" ... where the file has no names.
        first_line: row of the file with the names, or the first row where there are none.
        above: texts of the lines above.
        titles: names of columns by the titles that the file has for them, where they differ.
    """

    file: str
    kind: str
    lines: tuple[int, ...]
    columns: dict[str, tuple[str, ...]]
    first_line: int = 1
    above: tuple[str, ...] = ()
    titles: Mapping[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.lines)

    def named(self, stated: Mapping[str, str]) -> dict[str, str]:
        """Columns by field as a user states them, by their titles in the file, under their names here."""
        return {field: text if text in self.columns else self.titles.get(text, text) for field, text in stated.items()}

    def require_rows(self) -> None:
        """Refuse a table without rows."""
        if not self.lines:
            raise refused("no-rows", self.file)

    def ask(self, what: str, **values: Any) -> Question:
        """A question about its columns."""
        return asked(what, self.file, **{"line": self.first_line, **values})

    def refuse(self, row: int, column: str, allowed: str, remedy: str) -> InputError:
        """The error of one cell."""
        cell = self.columns[column][row]
        found = f'"{escaped(cell)}"' if cell else "an empty cell"
        line = self.lines[row]
        return refusal("cell", file=self.file, line=line, column=column, found=found, allowed=allowed, remedy=remedy)


class Number(str):
    """A cell stored as a number in a workbook: it has a decimal point for any notation of texts."""


class Row(NamedTuple):
    """A row and the line of the file on which it begins."""

    line: int
    cells: list[str]


class Rows(NamedTuple):
    """Rows of a file, the first with the names where it has some, what was found in words, and the lines above."""

    rows: list[Row]
    notes: list[str]
    above: tuple[str, ...] = ()


def table_of(file: str, kind: str, columns: Mapping[str, Sequence[object]], lines: Sequence[int]) -> ForeignTable:
    """Make a table from the values of a log; None is an empty cell, `lines` the line of the log for each row."""
    cells = {name: tuple("" if v is None else str(v) for v in values) for name, values in columns.items()}
    return ForeignTable(file, kind, tuple(lines), cells, lines[0] if lines else 1)


def is_number(cell: str) -> bool:
    """Whether a cell is a number, with a decimal point or comma."""
    return any(form.fullmatch(cell) for form in (NUMBER, _COMMA, _GROUPED_POINT, _GROUPED_COMMA))


def is_value(cell: str) -> bool:
    """Whether a cell is a number, or one with its unit."""
    match = None if is_number(cell) else _WITH_UNIT.fullmatch(cell)
    return (match is not None and parse_unit(match[2]) is not None and is_number(match[1])) or is_number(cell)


def cleaned(cell: str) -> str:
    """A cell without marks that spreadsheets put into numbers: a long minus, thin spaces between thousands."""
    cell = _THIN.sub("", cell.strip().replace("\u2212", "-")) if not cell.isascii() else cell.strip()
    plain = _APOSTROPHES.sub("", cell)
    # 1'000.02 is a number, 12'345 with another mark a text.
    return plain if plain != cell and is_number(plain) else cell


def filled_width(cells: Sequence[str]) -> int:
    """Number of cells up to the last that is not empty."""
    return max((k for k, cell in enumerate(cells, start=1) if cell), default=0)


# --- names -----------------------------------------------------------------------------------------------------------
def names_first(rows: Sequence[Row]) -> bool:
    """Whether the first row holds names: a column of numbers below it has a text there."""
    head, body = rows[0].cells, [row.cells for row in rows[1:]]
    if not body:
        return not all(is_number(cell) or means(cell, "empty") for cell in head if cell)
    for k, cell in enumerate(head):
        cells = [row[k] for row in body if k < len(row) and row[k] and not means(row[k], "empty")]
        numbers = sum(map(is_number, cells))
        if cell and numbers > 0.5 * len(cells) and numbers and not is_number(cell) and not means(cell, "empty"):
            return True
    # Numbers in other notations, as 12:30:05 or 1 3/8, are texts everywhere.
    return not any(map(is_number, head)) and not any(any(map(is_number, row)) for row in body[:3]) and _alpha(head)


def _alpha(cells: Sequence[str]) -> bool:
    return all(re.search(r"[^\W\d]", cell) is not None for cell in cells if cell)


def headed(found: Rows) -> Rows:
    """The rows from the column names on, and a note on the lines above them.

    The names stand in the row above the first one with numbers in the columns of numbers; units may stand between,
    groups of columns above. A row with numbers holds no names.
    """
    rows, notes = [row for row in found.rows if any(row.cells)], found.notes
    # A sheet may begin at its second column.
    empty = min((next(k for k, cell in enumerate(row.cells) if cell) for row in rows), default=0)
    rows = [Row(line, cells[empty:]) for line, cells in rows]
    data = _first_data(rows)
    if not data:
        return Rows(rows, notes)
    first = data
    # "n", "v" and "w" are units too, where names stand above them.
    head = data - 1
    while head > 0 and _all_units(rows[head].cells) and _may_be_names(rows[head - 1].cells, rows[data].cells):
        head -= 1
    # "up" and "HOME" may stand between names and rows.
    while head > 0 and sum(map(bool, rows[head].cells)) == 1 and not _may_be_names(rows[head].cells, rows[data].cells):
        head -= 1
    if _may_be_names(rows[head].cells, rows[data].cells):
        first = head
        if first and _is_group_row(rows[first - 1].cells, rows[first].cells):
            first -= 1
    if not first:
        return Rows(rows, notes)
    text = " ".join(cell for cell in rows[0].cells if cell)
    amount = f"{first} lines" if first > 1 else "a line"
    above = tuple(" ".join(cell for cell in row.cells if cell) for row in rows[:first])
    return Rows(rows[first:], [*notes, f'{amount} above the names left out ("{escaped(text, 40)}")'], above)


def _first_data(rows: Sequence[Row]) -> int:
    """The first row with numbers in all columns of numbers; 0 where no column holds any."""
    width = max((len(row.cells) for row in rows), default=0)
    tail = rows[len(rows) // 2 :]
    numeric = []
    for k in range(width):
        cells = [row.cells[k] for row in tail if k < len(row.cells) and row.cells[k]]
        if sum(map(is_value, cells)) > NUMERIC_SHARE * max(len(cells), 1) and len(cells) > NUMERIC_SHARE * len(tail):
            numeric.append(k)
    counts = Counter(len(row.cells) for row in tail)
    usual = min(counts, key=lambda n: (-counts[n], n), default=0)
    # "Serial no.; 7" is shorter than the rows.
    for least in (usual, 0):
        for first, row in enumerate(rows[: ABOVE_MAX + 1]):
            cells = [row.cells[k] if k < len(row.cells) else "" for k in numeric]
            is_data = all(is_value(c) or not c or means(c, "empty") for c in cells)
            if is_data and any(map(is_value, cells)) and len(row.cells) >= least:
                return first
    return 0


def _may_be_names(cells: Sequence[str], data: Sequence[str]) -> bool:
    """Whether a row can hold the names of the columns: texts, for half of the numbers of the data or more."""
    filled = [cell for cell in cells if cell]
    numbers = sum(map(is_value, data))
    # A whole number can be the name of a run.
    decimals = any(is_value(cell) and not cell.lstrip("+-").isdigit() for cell in filled)
    return 2 * len(filled) >= max(4, numbers) and not decimals and not is_value(filled[0])


def _all_units(cells: Sequence[str]) -> bool:
    """Whether a row below the names holds units and nothing else."""
    texts = [cell.strip("()[] ") for cell in cells if cell]
    return bool(texts) and all(parse_unit(t) is not None or not words_of(t) or _no_unit(t) for t in texts)


def _no_unit(text: str) -> bool:
    """Whether a cell among units states none: it is empty, the type of a column, or what the row holds."""
    return not text or any(means(text, concept) for concept in ("empty", "type", "unit"))


def _is_group_row(above: Sequence[str], names: Sequence[str]) -> bool:
    """Whether a row above the names groups them, as "Run 1,,Run 2,": cells with gaps between them."""
    filled = [k for k, cell in enumerate(above) if cell and not STATED.search(cell)]
    if len(filled) < sum(map(bool, above)):
        return False
    is_gapped = filled != list(range(len(filled)))
    return is_gapped and not any(map(is_number, above)) and filled[-1] < len(names)


def table_of_rows(
    file: str, rows: Sequence[Row], description: Sequence[str], above: Sequence[str] = ()
) -> ForeignTable:
    """Make a table of rows under their names, with decimal points.

    Raises:
        InputError: no row, or too many columns.
    """
    rows, description = [row for row in rows if any(row.cells)], list(description)
    if not rows:
        raise refused("empty-table", file)
    width = max(len(row.cells) for row in rows)
    if width > COLUMNS_MAX:
        raise refused("wide-table", file, count=width, most=COLUMNS_MAX)
    short = [row.line for row in rows[1:] if len(row.cells) < width and is_number(row.cells[0])]
    if 0 < len(short) <= SHORT_MAX and 10 * len(short) < len(rows):
        description.append(f"fewer cells than elsewhere in line {', '.join(map(str, short))}")
    filled = [Row(line, cells + [""] * (width - len(cells))) for line, cells in rows]
    if _is_across(filled):
        filled = [Row(filled[0].line, list(cells)) for cells in zip(*(row.cells for row in filled), strict=True)]
        width, description = len(filled[0].cells), [*description, "positions across: rows and columns exchanged"]
    has_names = names_first(filled)
    names: list[str | None] = [f"column {k}" for k in range(1, width + 1)]
    names, body, below = _names(filled, width) if has_names else (names, filled, "")
    description += [below] * bool(below)
    body, sums = _without_sums(body)
    description += [sums] * bool(sums)
    again = [" ".join(" ".join(row.cells).split()) == " ".join(" ".join(filled[0].cells).split()) for row in body]
    if has_names and any(again):
        line = body[again.index(True)].line
        body = [row for row, is_head in zip(body, again, strict=True) if not is_head]
        description.append(f"the names again in line {line}{' ...' * (sum(again) > 1)}, left out")
    names, body, titles = _without_titles(file, names, body, above)
    description += [titles] * bool(titles)
    texts_of = [[row[k] for _, row in body if row[k] and not isinstance(row[k], Number)] for k in range(width)]
    commas, mixed = _notation([cell for texts in texts_of for cell in texts])
    if not mixed and (unsure := _unsure_number(texts_of)):
        raise refused("thousands", file, line=next(row.line for row in body if unsure in row.cells), number=unsure)
    description += ["decimal commas"] * (commas and not mixed)
    columns = {}
    for k, name in enumerate(names):
        if name is not None:
            texts = (row[k] if isinstance(row[k], Number) else row[k][:CELL_CHARS_MAX] for _, row in body)
            columns[name] = tuple(str(cell) if mixed else _with_point(cell, commas) for cell in texts)
    return ForeignTable(
        file, ", ".join(description), tuple(line for line, _ in body), columns, rows[0].line, tuple(above)
    )


def _notation(cells: Sequence[str]) -> tuple[bool, bool]:
    """Whether numbers have decimal commas, and whether their notations contradict each other.

    Such cells, as "1.5" beside "1,5", are unchanged and refused where a number is needed.
    """
    commas = [cell for cell in cells if _COMMA.fullmatch(cell) or _GROUPED_COMMA.fullmatch(cell)]
    points = [cell for cell in cells if "." in cell and NUMBER.fullmatch(cell)]
    sure_commas, sure_points = (
        any(not _GROUPS_OF[mark].fullmatch(cell) for cell in own) for mark, own in ((",", commas), (".", points))
    )
    if commas and points and sure_points and not sure_commas:
        return False, False
    return bool(commas), bool(commas) and sure_points


def _unsure_number(columns: Sequence[Sequence[str]]) -> str:
    """A number whose mark may stand between thousands or before decimals; "" where there is none.

    As in 0, 10.000, 20.000 where nothing else has decimals, and in a column of 0.002 and 10,004.
    """
    forms = _GROUPS_OF.values()
    groups = [[cell for cell in cells if any(form.fullmatch(cell) for form in forms)] for cells in columns]
    decimals = [[c for c in cells if is_number(c) and not c.lstrip("+-").isdigit()] for cells in columns]
    sure = any(len(own) > len(grouped) for own, grouped in zip(decimals, groups, strict=True))
    for cells, own, grouped in zip(columns, decimals, groups, strict=True):
        points = [cell for cell in own if cell not in grouped and NUMBER.fullmatch(cell)]
        whole = any(cell.lstrip("+-").isdigit() and abs(int(cell)) < 1000 for cell in cells)
        unsure = [cell for cell in grouped if "," in cell] if points else []
        unsure += [cell for cell in grouped if cell.endswith("0")] if whole and not sure else []
        if unsure and not any(_COMMA.fullmatch(cell) and cell not in grouped for cell in own):
            return unsure[0]
    return ""


def _is_across(rows: Sequence[Row]) -> bool:
    """Whether each row is a name and its numbers, the first the commands of all others."""
    heads, width = [row.cells[0] for row in rows], filled_width(rows[0].cells)
    if not (len(rows) > 1 and width > ACROSS_MIN and len(set(heads)) == len(heads) and _alpha(heads) and all(heads)):
        return False
    rest = [cell for row in rows for cell in row.cells[1:width] if cell]
    concept = [place_of(words_of(heads[0]), name) is not None for name in ("command", "position")]
    return any(concept) and all(map(is_number, rest)) and not any(filled_width(row.cells) > width for row in rows)


def _without_sums(rows: Sequence[Row]) -> tuple[Sequence[Row], str]:
    """The rows without those that begin with a word of a summary, as "Mean", and a note on these."""
    sums = []
    width = min((len(row.cells) for row in rows), default=0)
    numbered = [k for k in range(width) if 2 * sum(is_number(row.cells[k]) for row in rows) > len(rows)]
    for row in rows:
        first = next((k for k, cell in enumerate(row.cells) if cell), 0)
        labels = [c for k, c in enumerate(row.cells) if c and (k == first or k in numbered) and not is_number(c)]
        words = [words_of(label) for label in labels]
        is_sum = any(len(of) <= 2 and place_of(of[:1], "summary") is not None for of in words)
        if is_sum and any(map(is_number, row.cells)):
            sums.append(row)
    if not sums or 2 * len(sums) > len(rows):
        return rows, ""
    named = ", ".join(str(row.line) for row in sums[:4]) + " ..." * (len(sums) > 4)
    return [row for row in rows if row not in sums], f"rows that sum up, left out (line {named})"


def _without_titles(
    file: str, names: list[str | None], rows: Sequence[Row], above: Sequence[str]
) -> tuple[list[str | None], Sequence[Row], str]:
    """The rows without lines of text between and below them, and a note on these.

    Under titles that all name a direction the rows are runs, and get a column of it.
    """
    filled = [[row.cells[k] for row in rows if row.cells[k]] for k in range(len(names))]
    numeric = [k for k, cells in enumerate(filled) if 2 * sum(map(is_number, cells)) > len(cells)]
    # "E2" alone, below "E1" beside numbers, is an experiment of a lab book; so is each of a column of such.
    of_rows = {re.sub(r"\d+", "0", row.cells[0]) for row in rows if sum(map(bool, row.cells)) > 1} - {""}
    places = {*numeric, *([0] if of_rows else [])}
    alone = [(row, [k for k, cell in enumerate(row.cells) if cell]) for row in rows if numeric]
    titles = {
        row.line: row.cells[at[0]]
        for row, at in alone
        if len(at) == 1 and at[0] in places and not is_number(row.cells[at[0]])
        if at[0] in numeric or re.sub(r"\d+", "0", row.cells[0]) not in of_rows
    }
    if not titles or 2 * len(titles) > len(rows):
        return names, rows, ""
    homed = [int(place_of(words_of(titles.get(row.line, "")), "homing") == 0) for row in rows]
    if any(homed):
        counts = accumulate(homed)
        counted = [Row(row.line, [*row.cells, str(k)]) for row, k in zip(rows, counts, strict=True)]
        kept = [row for row in counted if row.line not in titles]
        return [*names, "segment"], kept, f"homings where lines say so ({escaped(next(iter(titles.values())), 30)})"
    side, sides = next((found for line in reversed(above) if (found := side_named(line))), ""), list[str]()
    for row in rows:
        side = side_named(titles[row.line]) if row.line in titles else side
        sides.append(side)
    body = [(row, of) for row, of in zip(rows, sides, strict=True) if row.line not in titles]
    are_runs = all(of for _, of in body) and len({of for _, of in body}) > 1
    if not are_runs and (blocks := _blocks(above, [*titles.values()])):
        raise refused("several-machines", file, line=min(titles), where="under titles", machines=blocks)
    named = ", ".join(f'"{escaped(text, 30)}"' for text in list(titles.values())[:3]) + " ..." * (len(titles) > 3)
    # "Cote" of numbers is a dimension, "C\u00f4t\u00e9" of words a side.
    of_words = [name or "" for k, name in enumerate(names) if k not in numeric]
    if not are_runs or any(place_of(words_of(name), "approach") is not None for name in of_words):
        one = len(titles) == 1
        return names, [row for row, _ in body], f"line{'s' * (not one)} of text left out ({named})"
    note = f"runs one below the other, with the directions of their titles ({named})"
    return [*names, "direction"], [Row(row.line, [*row.cells, of]) for row, of in body], note


def _blocks(above: Sequence[str], titles: Sequence[str]) -> list[str]:
    """Titles of rows of several axes, or in several conditions: alike but for a word or number, and none of a run."""
    lines = [line.strip("#%!/ -=*") for line in above]
    first = [line for line in lines[:-1] if place_of(words_of(line), "machine") is not None] + lines[-1:]
    for one, other in (*((line, titles[0]) for line in first), *pairwise(titles)):
        a, b = words_of(one), words_of(other)
        alike = len(a) == len(b) > 1 and sum(x != y for x, y in zip(a, b, strict=True)) == 1
        conditions = all(place_of(own, "condition") is not None for own in (a, b)) and a != b
        if (alike and place_of(a, "run") is None and place_of(a, "repeat") is None) or conditions:
            return [*([one] if one not in titles else []), *titles]
    return []


def side_named(text: str) -> str:
    """The only direction that a text names, "forward" or "backward", else ""."""
    words = words_of(text)
    sides = [side for side in ("forward", "backward") if place_of(words, side) is not None]
    return sides[0] if len(sides) == 1 else ""


def _names(rows: Sequence[Row], width: int) -> tuple[list[str | None], Sequence[Row], str]:
    """Names of the columns, from one header line or more, the rows below, and a note on the other lines."""
    head, body, notes = list(rows[0].cells), rows[1:], list[str]()
    while len(body) > 1 and _is_second_header(body[0].cells, _below_units(body[1:])):
        below, are_units = body[0].cells, _all_units(body[0].cells)
        if are_units:
            marks = ["" if _no_unit(cell) else f" ({cell.strip('()[] ')})" for cell in below]
            head = [name and f"{name}{mark}" for name, mark in zip(head, marks, strict=True)]
        else:
            # Below a group of columns its name is that of the first.
            group, grouped = "", any(below[k] and not head[k] for k in range(width))
            for k in range(width):
                group = head[k] or group if grouped else head[k]
                head[k] = f"{group} {below[k]}".strip() if grouped or head[k] else ""
        notes.append("units in the row below the names" if are_units else "names in two rows")
        body = body[1:]
    return _unique(head), body, "names in three rows" if len(notes) > 1 else "".join(notes)


def _below_units(rows: Sequence[Row]) -> list[str]:
    return next((row.cells for row in rows if not _all_units(row.cells)), [])


def _is_second_header(cells: Sequence[str], next_cells: Sequence[str]) -> bool:
    """Whether a row below the names holds units or further names: no number in it, most of the next row numbers."""
    numbers = sum(map(is_number, next_cells))
    return (
        not any(map(is_number, cells))
        and (sum(map(bool, cells)) > 1 or (any(cells) and _all_units(cells)))
        and numbers > 1
        and 2 * numbers > sum(map(bool, next_cells)) - 1
    )


def _unique(names: Sequence[str]) -> list[str | None]:
    """Names of columns: numbered where they repeat, None without a name."""
    counts: Counter[str] = Counter()
    names_once: list[str | None] = []
    for text in names:
        # Names may stand in two lines of a cell.
        name = " ".join(text.split())
        counts[name] += 1
        names_once.append(None if not name else name if counts[name] == 1 else f"{name} ({counts[name]})")
    return names_once


def _with_point(cell: str, commas: bool) -> str:
    """A number with a decimal point and no marks between thousands; other cells are unchanged."""
    if isinstance(cell, Number):
        return str(cell)
    if commas and (_COMMA.fullmatch(cell) or _GROUPED_COMMA.fullmatch(cell) or _GROUPS_OF["."].fullmatch(cell)):
        return cell.replace(".", "").replace(",", ".")
    grouped = _GROUPED_POINT.fullmatch(cell) or _GROUPS_OF[","].fullmatch(cell)
    return cell.replace(",", "") if not commas and grouped else cell
