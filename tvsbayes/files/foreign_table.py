"""Tables of other programs, as text cells: CSV of any usual kind, lines of "name: value", sheets of XLSX files.

The reader detects and describes encoding, separator, decimal commas and lines above the column names.
Numbers get decimal points; cells are otherwise unchanged. Rows count from 1 as in the file; sizes are limited
before anything is unpacked.
"""

from __future__ import annotations

import csv
import datetime
import io
import re
import warnings
import zipfile
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

from tvsbayes.errors import CONTROL, InputError, escaped, refusal
from tvsbayes.files.csv_table import CSV_BYTES_MAX, CSV_ROWS_MAX, NUMBER
from tvsbayes.files.disk import read_bytes

COLUMNS_MAX = 200
UNPACKED_BYTES_MAX = 512 * 1024 * 1024
"""Largest sum of the sizes that the parts of an XLSX file state."""
CELL_CHARS_MAX = 1000
CELLS_MAX = 10_000_000
"""Largest number of cells of a sheet, with empty ones before the last of each row."""
SEPARATORS = {"\t": "tabs", ";": "semicolons", "|": "bars", ",": "commas", " ": "spaces"}
"""Separators in the order in which they are tried: a decimal comma must not be taken for one."""
ROWS_TRIED = 50
ABOVE_MAX = 50
"""Largest number of lines above the names of columns: serial number, date, operator."""
PAIRED_SHARE = 0.6
"""Least share of "name: value" lines in a file of pairs; the others are messages at a program's start."""
_WIDE = {
    SEPARATORS[","]: "decimal commas beside commas between cells? export with semicolons, or with decimal points",
    SEPARATORS[" "]: "dates or texts with spaces? export with semicolons or tabs between cells",
}
"""Why rows may have more cells than names, with the remedy, by separator."""
_MARKS = (
    (b"\xff\xfe\x00\x00", "utf-32", "UTF-32"),
    (b"\x00\x00\xfe\xff", "utf-32", "UTF-32"),
    (b"\xff\xfe", "utf-16", "UTF-16"),
    (b"\xfe\xff", "utf-16", "UTF-16"),
    (b"\xef\xbb\xbf", "utf-8-sig", "UTF-8"),
)
_COMMA = re.compile(r"[+-]?[0-9]*,[0-9]+(?:[eE][+-]?[0-9]+)?")
_GROUPED_POINT = re.compile(r"[+-]?[0-9]{1,3}(?:,[0-9]{3})+\.[0-9]+")
_PAIR = re.compile(
    r"(?P<name>[^\W\d][^:=,;|\t]*?)\s*[:=]\s*(?P<value>[+-]?(?:\d+[.,]\d+|\d+\.?|\.\d+)(?:[eE][+-]?\d+)?)"
    r"(?:\s*(?P<unit>\u00b0|mm|um|\u00b5m|deg|rad|counts|steps|ms|us|s)(?![\w:]))?\s*(?:[,;|\t]\s*|\s+|$)"
)
"""One pair of "Step: 200, Angle: 12.5 deg"."""
_CLOCK = re.compile(r"\[?(\d{1,2}):(\d{2}):(\d{2}(?:\.\d+)?)\]?\s*(?:->|>)?\s*")
"""Time of day that a serial monitor puts before a line."""
DAY_S = 86400.0
_GROUPED_COMMA = re.compile(r"[+-]?[0-9]{1,3}(?:\.[0-9]{3})+,[0-9]+")


@dataclass(frozen=True)
class ForeignTable:
    """A table of text cells.

    Attributes:
        file: its name, for messages.
        kind: the detected format, in words.
        lines: row in the file of each row.
        columns: cells by name of column; "column 1" ... where the file has no names.
        first_line: row of the file with the names, or the first row where there are none.
    """

    file: str
    kind: str
    lines: tuple[int, ...]
    columns: dict[str, tuple[str, ...]]
    first_line: int = 1

    def __len__(self) -> int:
        return len(self.lines)

    def require_rows(self) -> None:
        """Refuse a table without rows.

        Raises:
            InputError: the table has no row.
        """
        if not self.lines:
            found, remedy = "no rows below the names of the columns", "name the sheet or file with the data"
            raise refusal("empty", file=self.file, found=found, allowed="at least one row", remedy=remedy)

    def refuse(self, row: int, column: str, allowed: str, remedy: str) -> InputError:
        """The error of one cell."""
        cell = self.columns[column][row]
        found = f'"{escaped(cell)}"' if cell else "an empty cell"
        line = self.lines[row]
        return refusal("cell", file=self.file, line=line, column=column, found=found, allowed=allowed, remedy=remedy)


def read_foreign(path: Path, sheet: str | None = None) -> ForeignTable:
    """Read the table in a file.

    Args:
        path: a CSV or XLSX file of at most 64 MiB and 200 000 rows.
        sheet: sheet of an XLSX file; by default the first with content.

    Raises:
        InputError: unreadable, no table, too large, or another kind of file.
    """
    path = Path(path)
    data, file = read_bytes(path, CSV_BYTES_MAX), escaped(path.name)
    refuse = partial(refusal, file=file, allowed="a table as CSV (text) or XLSX")
    if data.startswith(b"\xd0\xcf\x11\xe0"):
        raise refuse("kind", found="a workbook of an old Excel", remedy="save it as XLSX or CSV")
    if data.startswith(b"PK\x03\x04"):
        rows, description = _sheet_rows(data, file, sheet)
        rows, notes = _without_heading(rows)
        description += notes
    elif sheet is not None:
        raise refuse("usage", found="text, which has no sheets", remedy="leave out --sheet")
    else:
        text, encoding = text_of(data, file)
        if paired := _paired_rows(text):
            return _table(file, *paired)
        rows, separator = _csv_rows(text, file)
        rows, notes = _without_heading(rows)
        _refuse_wide(rows, separator, file)
        description = [f"CSV with {separator} between cells", encoding, *notes]
    rows = [row for row in rows if any(row.cells)]
    if not rows:
        raise refuse("empty", found="no cells", remedy="name the file, or with --sheet the sheet, that holds the table")
    return _table(file, rows, description)


def table_of(file: str, kind: str, columns: Mapping[str, Sequence[object]], lines: Sequence[int]) -> ForeignTable:
    """Make a table from the values of another kind of log, as `read_foreign` does.

    Args:
        file: name of the log, for messages.
        kind: kind of log, in words.
        columns: values by name; None is an empty cell.
        lines: the line of the log for each row.
    """
    cells = {name: tuple("" if v is None else str(v) for v in values) for name, values in columns.items()}
    return ForeignTable(file, kind, tuple(lines), cells, lines[0] if lines else 1)


def is_foreign(head: bytes) -> bool:
    """Whether the first bytes show a foreign table: a workbook, UTF-16, other separators."""
    marks = (b"PK\x03\x04", *(mark for mark, codec, _ in _MARKS if codec != "utf-8-sig"))
    return head.startswith(marks) or re.search(rb"[;\t|]", head.partition(b"\n")[0]) is not None


class Decoded(NamedTuple):
    """A text and the name of its encoding."""

    text: str
    encoding: str


def text_of(
    data: bytes, file: str, allowed: str = "a table as CSV (text) or XLSX", remedy: str = "export the table as CSV"
) -> Decoded:
    """Decode a text; `allowed` and `remedy` are used in the refusal of binary data."""
    marked = [(codec, name) for mark, codec, name in _MARKS if data.startswith(mark)]
    codec, name = marked[0] if marked else ("utf-8", "UTF-8")
    if not marked and b"\0" in data[:200]:
        codec, name = ("utf-16-le" if data[1:2] == b"\0" else "utf-16-be"), "UTF-16"
    try:
        text = data.decode(codec)
    except UnicodeDecodeError:
        # In this encoding every byte is a character: only column names can be decoded wrongly.
        text, name = data.decode("cp1252", errors="replace"), "Windows-1252"
    if control := CONTROL.search(text):
        line = text.count("\n", 0, control.start()) + 1
        raise refusal("kind", file=file, line=line, found="binary data", allowed=allowed, remedy=remedy)
    return Decoded(text, name)


class _Row(NamedTuple):
    """A row and the line of the file on which it begins."""

    line: int
    cells: list[str]


def _paired_rows(text: str) -> tuple[list[_Row], list[str]] | None:
    """Rows of a file whose lines are "name: value" pairs, as in a serial monitor; None for any other file.

    A repeated name begins a new row; a time of day before the lines becomes seconds since the first row.
    """
    names: dict[str, None] = {}
    rows, begins = list[dict[str, str]](), list[int]()
    lines = [(n, line.strip()) for n, line in enumerate(text.splitlines(), start=1) if line.strip()]
    paired, day_s, previous_s = 0, 0.0, -1.0
    for number, line in lines:
        clock = _CLOCK.match(line)
        content = line[clock.end() if clock else 0 :]
        pairs = list(_PAIR.finditer(content))
        if not pairs or pairs[0].start() or "".join(match.group() for match in pairs) != content:
            continue
        paired += 1
        values = {
            m["name"].strip() + (f" ({m['unit']})" if m["unit"] else ""): m["value"].replace(",", ".") for m in pairs
        }
        if len(values) < len(pairs):
            return None
        names.update(dict.fromkeys(values))
        if not rows or rows[-1].keys() & values.keys():
            rows.append({})
            begins.append(number)
            if clock:
                time_s = int(clock[1]) * 3600 + int(clock[2]) * 60 + float(clock[3]) + day_s
                day_s, time_s = (day_s + DAY_S, time_s + DAY_S) if time_s < previous_s else (day_s, time_s)
                rows[-1]["time (s)"], previous_s = f"{time_s:.6f}", time_s
        rows[-1].update(values)
    if len(names) < 2 or len(rows) < 2 or paired < PAIRED_SHARE * len(lines):
        return None
    if timed := all("time (s)" in cells for cells in rows) and "time (s)" not in names:
        start_s = float(rows[0]["time (s)"])
        for cells in rows:
            cells["time (s)"] = f"{float(cells['time (s)']) - start_s:.6f}"
    columns = ["time (s)"] * timed + list(names)
    description = ['lines of "name: value"']
    if unpaired := len(lines) - paired:
        description.append(f"{unpaired} other line{'s' * (unpaired > 1)} left out")
    body = [_Row(n, [cells.get(name, "") for name in columns]) for n, cells in zip(begins, rows, strict=True)]
    return [_Row(begins[0], columns), *body], description


def _without_heading(rows: list[_Row]) -> tuple[list[_Row], list[str]]:
    """The rows from the column names on, and a note on the lines above them.

    The names are in the first row that is at least as wide as most rows, and are not numbers. It may be wider: a last
    column of remarks is empty in most rows.
    """
    widths = {k: _filled_width(row.cells) for k, row in enumerate(rows) if any(row.cells)}
    usual_width, times = next(iter(Counter(widths.values()).most_common(1)), (0, 0))
    if usual_width < 2 or 2 * times <= len(widths):
        return rows, []
    first = next(k for k, width in widths.items() if width >= usual_width)
    heading = [k for k in widths if k < first]
    names = [cell for cell in rows[first].cells if cell]
    if not heading or len(heading) > ABOVE_MAX or any(map(_is_number, names)):
        return rows, []
    text = " ".join(cell for cell in rows[heading[0]].cells if cell)
    amount = f"{len(heading)} lines" if len(heading) > 1 else "a line"
    return rows[first:], [f'{amount} above the names left out ("{escaped(text, 40)}")']


def _filled_width(cells: Sequence[str]) -> int:
    """Number of cells up to the last that is not empty."""
    return max((k for k, cell in enumerate(cells, start=1) if cell), default=0)


def _is_number(cell: str) -> bool:
    return bool(NUMBER.fullmatch(cell) or _COMMA.fullmatch(cell))


def _csv_rows(text: str, file: str) -> tuple[list[_Row], str]:
    """Rows with their line numbers, and the name of the separator; lines that begin with # or % are remarks."""
    lines = [(number, line) for number, line in enumerate(text.splitlines(), start=1)]
    declared = next((line[4:5] for _, line in lines[:1] if line.lower().startswith("sep=")), None)
    body = [(n, line) for n, line in lines if line.strip() and not line.startswith(("#", "%"))][declared is not None :]
    if len(body) > CSV_ROWS_MAX + 1:
        allowed, remedy = f"at most {CSV_ROWS_MAX} rows", "split it"
        raise refusal("size", file=file, found=f"{len(body)} rows", allowed=allowed, remedy=remedy)
    if declared == '"':
        found, allowed = 'the quote " between cells', ", ".join(SEPARATORS.values())
        raise refusal("csv", file=file, line=1, found=found, allowed=allowed, remedy="correct or remove the line sep=")
    separator = declared or _separator([line for _, line in body])
    if separator == " ":
        rows = [_Row(number, line.split()) for number, line in body]
    else:
        reader = csv.reader((line for _, line in body), delimiter=separator, skipinitialspace=True, strict=True)
        rows = []
        try:
            for row in reader:
                if reader.line_num > len(rows) + 1:
                    raise csv.Error("a line break inside a cell")
                rows.append(_Row(body[len(rows)][0], [cell.strip() for cell in row]))
        except csv.Error as error:
            line, found, remedy = body[len(rows)][0], escaped(str(error), 120), 'close every quote " in its own line'
            raise refusal(
                "csv", file=file, line=line, found=found, allowed="one row per line", remedy=remedy
            ) from error
    return rows, SEPARATORS.get(separator, f"'{escaped(separator)}'")


def _refuse_wide(rows: Sequence[_Row], separator: str, file: str) -> None:
    """Refuse rows with more cells than the first row: all cells after a divided one are under wrong names.

    Raises:
        InputError: there is such a row; empty cells at its end do not count.
    """
    filled = [row for row in rows if any(row.cells)]
    width = len(filled[0].cells) if filled else 0
    for line, cells in filled:
        if (count := _filled_width(cells)) <= width:
            continue
        found = f"{count} cells under the {width} {'name' if width == 1 else 'names'} of line {filled[0].line}"
        remedy = _WIDE.get(separator, "a separator inside a cell? put such cells in quotes; or a name is missing")
        remedy = "put # before lines that stand above the names of the columns" if width == 1 else remedy
        allowed = "as many cells in a row as there are names"
        raise refusal("csv", file=file, line=line, found=found, allowed=allowed, remedy=remedy)


def _separator(lines: Sequence[str]) -> str:
    """The first separator that gives nine of ten lines the same number of cells, two or more.

    The first lines are tried, then the last. If none fits, some row is damaged; the result is then the first separator
    that divides most lines and the names, else commas.
    """
    for sample in (lines[:ROWS_TRIED], lines[-ROWS_TRIED:]):
        widths = {s: [len(line.split(None if s == " " else s)) for line in sample] for s in SEPARATORS}
        modes = {s: max(Counter(w).items(), key=lambda item: item[1], default=(1, 0)) for s, w in widths.items()}
        regular = (s for s, (cells, count) in modes.items() if cells > 1 and count >= 0.9 * len(sample))
        frequent = (s for s, (cells, count) in modes.items() if 1 < cells == widths[s][0] and 2 * count > len(sample))
        if separator := next(regular, None) or next(frequent, None):
            return separator
    # In a short table below a heading only names and rows are divided.
    totals = {s: Counter(len(line.split(None if s == " " else s)) for line in lines) for s in SEPARATORS}
    divided = {s: max(((n, c) for c, n in w.items() if c > 1), default=(0, 0)) for s, w in totals.items() if s != " "}
    return next((s for s, (count, _) in divided.items() if 2 * count > len(lines)), ",")


def _sheet_rows(data: bytes, file: str, sheet: str | None) -> tuple[list[_Row], list[str]]:
    """Read the rows of one sheet of an XLSX file: values, not formulas."""
    refuse = partial(refusal, file=file)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            parts = archive.infolist()
    except zipfile.BadZipFile as error:
        raise refuse("kind", found="a damaged XLSX file", allowed="CSV or XLSX", remedy="save it again") from error
    known = {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}
    if sum(part.file_size for part in parts) > UNPACKED_BYTES_MAX or any(p.compress_type not in known for p in parts):
        allowed = f"at most {UNPACKED_BYTES_MAX // 2**20} MiB when unpacked"
        raise refuse("size", found="more", allowed=allowed, remedy="save the one sheet that is needed")
    import openpyxl

    with warnings.catch_warnings():
        # The warnings concern unknown styles and validation rules.
        warnings.simplefilter("ignore")
        try:
            book = openpyxl.load_workbook(io.BytesIO(data), read_only=True, data_only=True)
            # Charts have sheets of their own, without cells.
            names = [table.title for table in book.worksheets]
            if sheet is not None and sheet not in names:
                listed = ", ".join(escaped(name) for name in names)
                raise refuse("sheet", found=f"no sheet {escaped(sheet)}", allowed=listed, remedy="name one of them")
            for name in [sheet] if sheet is not None else names:
                # Otherwise rows would be filled up to the size that the sheet states.
                book[name].reset_dimensions()
                rows = _cells(book[name].iter_rows(values_only=True), file)
                if any(any(row.cells) for row in rows):
                    break
        except InputError:
            raise
        except Exception as error:
            # A damaged file can make the library raise any exception.
            found = escaped(str(error), 120)
            raise refuse("kind", found=found, allowed="CSV or XLSX", remedy="save it as CSV") from error
    return rows, [f"XLSX, sheet {escaped(str(name))}"]


def _cells(rows: Iterable[tuple[object, ...]], file: str) -> list[_Row]:
    """Cells of a sheet as text."""
    values, cells = [], 0
    for number, row in enumerate(rows, start=1):
        cells += len(row)
        if number > CSV_ROWS_MAX + 1 or cells > CELLS_MAX:
            allowed, remedy = f"at most {CSV_ROWS_MAX} rows, {CELLS_MAX} cells", "save the table alone in a file"
            raise refusal("size", file=file, found="more", allowed=allowed, remedy=remedy)
        values.append(_Row(number, [_cell(value) for value in row]))
    return values


class _Number(str):
    """A cell stored as a number in a workbook: it has a decimal point for any notation of texts."""


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
        return _Number(int(value))
    if isinstance(value, int | float):
        return _Number(value)
    if isinstance(value, datetime.datetime | datetime.date | datetime.time):
        return value.isoformat()
    return str(value).strip()


def _table(file: str, rows: Sequence[_Row], description: list[str]) -> ForeignTable:
    """Make a table of rows of equal length under their names, with decimal points."""
    width = max(len(row.cells) for row in rows)
    if width > COLUMNS_MAX:
        allowed, remedy = f"at most {COLUMNS_MAX} columns", "save the table alone in a file"
        raise refusal("size", file=file, found=f"{width} columns", allowed=allowed, remedy=remedy)
    filled = [_Row(line, cells + [""] * (width - len(cells))) for line, cells in rows]
    has_header = not all(_is_number(cell) for cell in filled[0].cells if cell)
    names = _unique(filled[0].cells) if has_header else [f"column {k}" for k in range(1, width + 1)]
    body = filled[1:] if has_header else filled
    if has_header and len(body) > 1 and _units_below(body[0].cells, body[1].cells):
        names = [name and f"{name} {unit}".strip() for name, unit in zip(names, body[0].cells, strict=True)]
        description, body = [*description, "units in the row below the names"], body[1:]
    cells = [cell for _, row in body for cell in row if not isinstance(cell, _Number)]
    commas = any(_COMMA.fullmatch(cell) or _GROUPED_COMMA.fullmatch(cell) for cell in cells)
    # No notation has both "1.5" and "1,5": such cells are unchanged and refused where a number is needed.
    mixed = commas and any("." in cell and NUMBER.fullmatch(cell) for cell in cells)
    if commas and not mixed:
        description = [*description, "decimal commas"]
    columns = {}
    for k, name in enumerate(names):
        if name is not None:
            body_cells = (row[k] if isinstance(row[k], _Number) else row[k][:CELL_CHARS_MAX] for _, row in body)
            columns[name] = tuple(str(cell) if mixed else _with_point(cell, commas) for cell in body_cells)
    return ForeignTable(file, ", ".join(description), tuple(line for line, _ in body), columns, rows[0].line)


def _units_below(cells: Sequence[str], next_cells: Sequence[str]) -> bool:
    """Whether a row below the names holds units: no number in it, most of the next row numbers."""
    numbers = sum(map(_is_number, next_cells))
    return not any(map(_is_number, cells)) and any(cells) and numbers > 1 and 2 * numbers > len(next_cells)


def _unique(names: Sequence[str]) -> list[str | None]:
    """Names of columns: numbered where they repeat, None without a name."""
    counts: Counter[str] = Counter()
    names_once: list[str | None] = []
    for name in names:
        counts[name] += 1
        names_once.append(None if not name else name if counts[name] == 1 else f"{name} ({counts[name]})")
    return names_once


def _with_point(cell: str, commas: bool) -> str:
    """A number with a decimal point and no marks between thousands; other cells are unchanged."""
    if isinstance(cell, _Number):
        return str(cell)
    if commas and (_COMMA.fullmatch(cell) or _GROUPED_COMMA.fullmatch(cell)):
        return cell.replace(".", "").replace(",", ".")
    return cell.replace(",", "") if not commas and _GROUPED_POINT.fullmatch(cell) else cell
