"""Tables of other programs, as text cells: text of any usual kind, Markdown, "name: value" lines, workbooks, lab files.

The reader finds and describes encoding, separator, decimal commas, lines above the names and names in a remark. Numbers
get decimal points; cells are otherwise unchanged. Rows count from 1 as in the file; sizes are limited before anything
is unpacked.
"""

from __future__ import annotations

import csv
import datetime
import io
import re
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

from tvsbayes.errors import CONTROL, InputError, escaped, refusal
from tvsbayes.files.csv_table import CSV_BYTES_MAX, CSV_ROWS_MAX, NUMBER
from tvsbayes.files.disk import read_bytes
from tvsbayes.importing.words import means, parse_unit, place_of, words_of

COLUMNS_MAX = 200
UNPACKED_BYTES_MAX = 64 * 2**20
"""Largest sum of the sizes that the parts of a workbook state."""
CELL_CHARS_MAX = 1000
CELLS_MAX = 4_000_000
"""Largest area of a sheet, from its first cell to its last in both directions."""
SEPARATORS = {"\t": "tabs", ";": "semicolons", "|": "bars", ",": "commas", " ": "spaces"}
"""Separators in the order in which they are tried: a decimal comma must not be taken for one."""
ROWS_TRIED = 50
NUMERIC_SHARE = 0.6
"""Least share of numbers in a column of numbers."""
ABOVE_MAX = 50
"""Largest number of lines above the names of columns: serial number, date, operator."""
KINDS = "a table as text (CSV and its like), XLSX, XLS or ODS"
REMARKS = ("#", "%", "!", "//")
_MARKS = (
    (b"\xff\xfe\x00\x00", "utf-32", "UTF-32"),
    (b"\x00\x00\xfe\xff", "utf-32", "UTF-32"),
    (b"\xff\xfe", "utf-16", "UTF-16"),
    (b"\xfe\xff", "utf-16", "UTF-16"),
    (b"\xef\xbb\xbf", "utf-8-sig", "UTF-8"),
)
_WIDE = {
    SEPARATORS[","]: "decimal commas beside commas between cells? export with semicolons, or with decimal points",
    SEPARATORS[" "]: "dates or texts with spaces? export with semicolons or tabs between cells",
}
"""Why rows may have more cells than names, with the remedy, by separator."""
_COMMA = re.compile(r"[+-]?[0-9]*,[0-9]+(?:[eE][+-]?[0-9]+)?")
_GROUPED_POINT = re.compile(r"[+-]?[0-9]{1,3}(?:,[0-9]{3})+\.[0-9]+")
_GROUPED_COMMA = re.compile(r"[+-]?[0-9]{1,3}(?:\.[0-9]{3})+,[0-9]+")
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
    """

    file: str
    kind: str
    lines: tuple[int, ...]
    columns: dict[str, tuple[str, ...]]
    first_line: int = 1

    def __len__(self) -> int:
        return len(self.lines)

    def require_rows(self) -> None:
        """Refuse a table without rows."""
        if not self.lines:
            found, remedy = "no rows below the names of the columns", "name the sheet or file with the data"
            raise refusal("empty", file=self.file, found=found, allowed="at least one row", remedy=remedy)

    def refuse(self, row: int, column: str, allowed: str, remedy: str) -> InputError:
        """The error of one cell."""
        cell = self.columns[column][row]
        found = f'"{escaped(cell)}"' if cell else "an empty cell"
        line = self.lines[row]
        return refusal("cell", file=self.file, line=line, column=column, found=found, allowed=allowed, remedy=remedy)


class Row(NamedTuple):
    """A row and the line of the file on which it begins."""

    line: int
    cells: list[str]


class Rows(NamedTuple):
    """Rows of a file, the first with the names where it has some, and what was found, in words."""

    rows: list[Row]
    notes: list[str]


class Decoded(NamedTuple):
    """A text and the name of its encoding."""

    text: str
    encoding: str


def read_foreign(path: Path, sheet: str | None = None) -> ForeignTable:
    """Read the table in a file.

    Args:
        path: a file of at most 64 MiB and 200 000 rows.
        sheet: sheet of a workbook; by default the first with content.

    Raises:
        InputError: unreadable, no table, too large, or another kind of file.
    """
    data, file = read_bytes(Path(path), CSV_BYTES_MAX), escaped(Path(path).name)
    if is_workbook(data):
        return table_of_rows(file, *_headed(_sheet_rows(data, file, sheet)))
    if sheet is not None:
        found, remedy = "text, which has no sheets", "leave out --sheet"
        raise refusal("usage", file=file, found=found, allowed=KINDS, remedy=remedy)
    return table_of_text(text_of(data, file), file)


def table_of_text(decoded: Decoded, file: str) -> ForeignTable:
    """Read the table in a text."""
    from tvsbayes.importing import lab_files, serial

    text, encoding = decoded
    for read in (lab_files.renishaw_rows, lab_files.labview_rows, serial.paired_rows):
        if (rows := read(text, file)) is not None:
            return table_of_rows(file, *rows)
    rows, separator, remarks = _text_rows(text, file)
    headed, notes = _headed(Rows(rows, []))
    names = _names_in_remark(remarks, headed, separator)
    if names is not None:
        headed, notes = [names, *rows], [*notes, "names in the remark above the first row"]
    _refuse_wide(headed, separator, file)
    return table_of_rows(file, headed, [f"CSV with {SEPARATORS.get(separator, separator)} between cells", encoding, *notes])


def table_of(file: str, kind: str, columns: Mapping[str, Sequence[object]], lines: Sequence[int]) -> ForeignTable:
    """Make a table from the values of a log; None is an empty cell, `lines` the line of the log for each row."""
    cells = {name: tuple("" if v is None else str(v) for v in values) for name, values in columns.items()}
    return ForeignTable(file, kind, tuple(lines), cells, lines[0] if lines else 1)


def is_workbook(data: bytes) -> bool:
    """Whether bytes are a workbook: XLSX, ODS (zip), XLS."""
    return data.startswith((b"PK\x03\x04", b"\xd0\xcf\x11\xe0"))


def is_foreign(head: bytes) -> bool:
    """Whether the first bytes show a foreign table: a workbook, UTF-16, other separators."""
    marks = tuple(mark for mark, codec, _ in _MARKS if codec != "utf-8-sig")
    return is_workbook(head) or head.startswith(marks) or re.search(rb"[;\t|]", head.partition(b"\n")[0]) is not None


def text_of(data: bytes, file: str, allowed: str = KINDS, remedy: str = "export the table as CSV") -> Decoded:
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


def is_number(cell: str) -> bool:
    """Whether a cell is a number, with a decimal point or comma."""
    return bool(NUMBER.fullmatch(cell) or _COMMA.fullmatch(cell))


def _cleaned(cell: str) -> str:
    """A cell without marks that spreadsheets put into numbers: a long minus, thin spaces between thousands."""
    return _THIN.sub("", cell.strip().replace("\u2212", "-")) if not cell.isascii() else cell.strip()


# --- rows of a text --------------------------------------------------------------------------------------------------
def _text_rows(text: str, file: str) -> tuple[list[Row], str, list[tuple[int, str]]]:
    """Rows with their line numbers, the separator, and the remarks above the first row."""
    lines = [(number, line) for number, line in enumerate(text.splitlines(), start=1) if line.strip()]
    declared = next((line[4:5] for _, line in lines[:1] if line.lower().startswith("sep=")), None)
    remarks = [(n, line.strip()) for n, line in lines if _is_remark(line)]
    body = [(n, line) for n, line in lines if not _is_remark(line)][declared is not None :]
    remarks = [(n, line) for n, line in remarks if body and n < body[0][0]]
    if _is_markdown([line for _, line in body]):
        body, declared = _markdown_rows(lines), "|"
    if len(body) > CSV_ROWS_MAX + 1:
        allowed, remedy = f"at most {CSV_ROWS_MAX} rows", "split it"
        raise refusal("size", file=file, found=f"{len(body)} rows", allowed=allowed, remedy=remedy)
    if declared == '"':
        found, allowed = 'the quote " between cells', ", ".join(SEPARATORS.values())
        raise refusal("csv", file=file, line=1, found=found, allowed=allowed, remedy="correct or remove the line sep=")
    separator = declared or _separator([line for _, line in body])
    return _divided(body, separator, file), separator, remarks


def _is_remark(line: str) -> bool:
    """Whether a line is a remark; "#;Position" begins with a name for the number of the row."""
    return line.lstrip().startswith(REMARKS) and not re.match(r'\s*"?#"?\s*[;,|\t]', line)


def _divided(body: Sequence[tuple[int, str]], separator: str, file: str) -> list[Row]:
    """Cells of the lines."""
    if separator == " ":
        return [Row(number, line.split()) for number, line in body]
    reader = csv.reader((line for _, line in body), delimiter=separator, skipinitialspace=True, strict=True)
    rows: list[Row] = []
    try:
        for row in reader:
            if reader.line_num > len(rows) + 1:
                raise csv.Error("a line break inside a cell")
            rows.append(Row(body[len(rows)][0], [_cleaned(cell) for cell in row]))
    except csv.Error as error:
        line, found, remedy = body[len(rows)][0], escaped(str(error), 120), 'close every quote " in its own line'
        allowed = "one row per line"
        raise refusal("csv", file=file, line=line, found=found, allowed=allowed, remedy=remedy) from error
    return rows


def _is_markdown(lines: Sequence[str]) -> bool:
    return any(re.fullmatch(r"\s*\|?[\s:|-]*-{3,}[\s:|-]*\|[\s:|-]*", line) for line in lines[:ABOVE_MAX])


def _markdown_rows(lines: Sequence[tuple[int, str]]) -> list[tuple[int, str]]:
    """Rows of the Markdown tables of a text; of several with one head, under headings that name directions, a column."""
    rows, heading, sides = list[tuple[int, str]](), "", list[str]()
    for number, line in lines:
        content = line.strip().strip("|")
        if "|" not in content:
            heading = line
        elif not re.fullmatch(r"[\s|:-]+", content):
            rows.append((number, content))
            sides.append(next((side for side in ("forward", "backward") if place_of(words_of(heading), side) is not None), ""))
    heads = [k for k, (_, content) in enumerate(rows) if content == rows[0][1]]
    if len(heads) > 1 and all(sides):
        return [(n, f"{line} | {side if k not in heads else 'direction'}") for k, ((n, line), side) in enumerate(zip(rows, sides, strict=True))]
    return rows


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


def _names_in_remark(remarks: Sequence[tuple[int, str]], rows: Sequence[Row], separator: str) -> Row | None:
    """Names of the columns in the last remark with as many words as the rows have cells, where no row holds names."""
    if not rows or _names_first(rows):
        return None
    width = _filled_width(rows[0].cells)
    for line, remark in reversed(remarks):
        # "#L" begins the names of SPEC files.
        content = re.sub(r"^(?:[#%!]|//)+(?:L(?=\s))?\s*", "", remark)
        for divide in (separator, "\t", ",", ";", "  ", None):
            cells = [cell.strip() for cell in (content.split(divide) if divide != "  " else re.split(r"\s{2,}", content))]
            if len(cells) == width > 1 and all(cells) and not any(map(is_number, cells)):
                return Row(line, cells)
    return None


def _refuse_wide(rows: Sequence[Row], separator: str, file: str) -> None:
    """Refuse rows with more cells than the first row: all cells after a divided one are under wrong names."""
    filled = [row for row in rows if any(row.cells)]
    width = len(filled[0].cells) if filled else 0
    for line, cells in filled:
        if (count := _filled_width(cells)) <= width:
            continue
        found = f"{count} cells under the {width} {'name' if width == 1 else 'names'} of line {filled[0].line}"
        remedy = _WIDE.get(SEPARATORS.get(separator, ""), "a separator inside a cell? put such cells in quotes; or a name is missing")
        remedy = "put # before lines that stand above the names of the columns" if width == 1 else remedy
        allowed = "as many cells in a row as there are names"
        raise refusal("csv", file=file, line=line, found=found, allowed=allowed, remedy=remedy)


def _filled_width(cells: Sequence[str]) -> int:
    """Number of cells up to the last that is not empty."""
    return max((k for k, cell in enumerate(cells, start=1) if cell), default=0)


# --- workbooks -------------------------------------------------------------------------------------------------------
class _Number(str):
    """A cell stored as a number in a workbook: it has a decimal point for any notation of texts."""


def _sheet_rows(data: bytes, file: str, sheet: str | None) -> Rows:
    """Read the rows of one sheet: values, not formulas."""
    refuse = partial(refusal, file=file)
    kind = "XLS" if data.startswith(b"\xd0") else "XLSX"
    if kind == "XLSX":
        kind = _checked_archive(data, file)
    import python_calamine

    try:
        book = python_calamine.load_workbook(io.BytesIO(data))
        # Charts have sheets of their own, without cells.
        names = [s.name for s in book.sheets_metadata if str(s.typ).endswith("WorkSheet")]
        if sheet is not None and sheet not in names:
            listed = ", ".join(escaped(name) for name in names)
            raise refuse("sheet", found=f"no sheet {escaped(sheet)}", allowed=listed, remedy="name one of them")
        rows: list[Row] = []
        for name in [sheet] if sheet is not None else names:
            page = book.get_sheet_by_name(name)
            if page.total_height * page.total_width > CELLS_MAX or page.total_height > CSV_ROWS_MAX + 1:
                allowed, remedy = f"at most {CSV_ROWS_MAX} rows, {CELLS_MAX} cells", "save the table alone in a file"
                raise refuse("size", found="more", allowed=allowed, remedy=remedy)
            cells = page.to_python(skip_empty_area=False)
            rows = [Row(k, [_cell(value) for value in row]) for k, row in enumerate(cells, start=1)]
            if any(any(row.cells) for row in rows):
                break
    except InputError:
        raise
    except BaseException as error:  # noqa: BLE001
        # A damaged file can make the library raise any exception, a panic of its core included.
        if isinstance(error, KeyboardInterrupt | SystemExit | MemoryError):
            raise
        found = f"a damaged workbook ({escaped(str(error), 100)})"
        raise refuse("kind", found=found, allowed=KINDS, remedy="save it as CSV") from error
    if not any(any(row.cells) for row in rows):
        raise refuse("empty", found="no cells", allowed=KINDS, remedy="name the sheet that holds the table with --sheet")
    return Rows(rows, [f"{kind}, sheet {escaped(str(name))}"])


def _checked_archive(data: bytes, file: str) -> str:
    """The kind of a zipped workbook, whose sizes and area are checked before anything is unpacked whole."""
    refuse = partial(refusal, file=file)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            parts = archive.infolist()
            known = {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}
            large = sum(part.file_size for part in parts) > UNPACKED_BYTES_MAX
            if large or any(part.compress_type not in known for part in parts):
                allowed = f"at most {UNPACKED_BYTES_MAX // 2**20} MiB when unpacked"
                raise refuse("size", found="more", allowed=allowed, remedy="save the one sheet that is needed")
            is_ods = any(part.filename == "content.xml" for part in parts)
            pages = [p for p in parts if re.fullmatch(r"content\.xml|xl/worksheets/[^/]*\.xml", p.filename)]
            area = max((_area(archive.read(page), is_ods) for page in pages), default=0)
    except (zipfile.BadZipFile, EOFError, OSError, ValueError, NotImplementedError, RuntimeError) as error:
        raise refuse("kind", found="a damaged workbook", allowed=KINDS, remedy="save it again") from error
    if area > CELLS_MAX:
        allowed, remedy = f"at most {CSV_ROWS_MAX} rows, {CELLS_MAX} cells", "save the table alone in a file"
        raise refuse("size", found="more", allowed=allowed, remedy=remedy)
    return "ODS" if is_ods else "XLSX"


def _area(xml: bytes, is_ods: bool) -> int:
    """Largest area that a reader of a sheet would fill: its last row times its last column."""
    if is_ods:
        # An empty cell or row at the end is repeated to the sheet's edge and costs nothing; one with content does.
        filled = re.findall(rb"<table:table-cell[^>]*office:value[^>]*>", xml)
        repeats = [int(n[:9]) for cell in filled for n in re.findall(rb'number-columns-repeated="(\d+)"', cell)]
        rows = xml.count(b"<table:table-row") + sum(
            int(n[:9]) for n in re.findall(rb'number-rows-repeated="(\d+)"[^>]*>\s*<table:table-cell[^>]*office:value', xml)
        )
        return (max(repeats, default=1) + 1) * rows if repeats else rows
    last_row = last_column = 0
    for letters, number in re.findall(rb'\br="([A-Z]{1,9})([0-9]{1,9})"', xml):
        column = 0
        for letter in letters:
            column = 26 * column + letter - 64
        last_row, last_column = max(last_row, int(number)), max(last_column, column)
    return last_row * last_column


def _cell(value: object) -> str:
    if value is None or value == "":
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
        return _Number(int(value))
    if isinstance(value, int | float):
        return _Number(value)
    if isinstance(value, datetime.datetime | datetime.date | datetime.time):
        return value.isoformat()
    if isinstance(value, datetime.timedelta):
        return _Number(value.total_seconds())
    return _cleaned(str(value))


# --- names -----------------------------------------------------------------------------------------------------------
def _names_first(rows: Sequence[Row]) -> bool:
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


def _headed(found: Rows) -> Rows:
    """The rows from the column names on, and a note on the lines above them.

    The names stand in the row above the first one with numbers in the columns of numbers; units may stand between,
    groups of columns above. A row with numbers holds no names.
    """
    rows, notes = [row for row in found.rows if any(row.cells)], found.notes
    data = _first_data(rows)
    if not data:
        return Rows(rows, notes)
    first = data
    above = data - 2 if data > 1 and _all_units(rows[data - 1].cells) else data - 1
    if _may_be_names(rows[above].cells, rows[data].cells):
        first = above
        if first and _is_group_row(rows[first - 1].cells, rows[first].cells):
            first -= 1
    if not first:
        return Rows(rows, notes)
    text = " ".join(cell for cell in rows[0].cells if cell)
    amount = f"{first} lines" if first > 1 else "a line"
    return Rows(rows[first:], [*notes, f'{amount} above the names left out ("{escaped(text, 40)}")'])


def _first_data(rows: Sequence[Row]) -> int:
    """The first row with numbers in all columns of numbers; 0 where no column holds any, or the lines above are many."""
    width = max((len(row.cells) for row in rows), default=0)
    tail = rows[len(rows) // 2 :]
    numeric = []
    for k in range(width):
        cells = [row.cells[k] for row in tail if k < len(row.cells) and row.cells[k]]
        if sum(map(is_number, cells)) > NUMERIC_SHARE * max(len(cells), 1) and len(cells) > NUMERIC_SHARE * len(tail):
            numeric.append(k)
    for first, row in enumerate(rows[: ABOVE_MAX + 1]):
        cells = [row.cells[k] if k < len(row.cells) else "" for k in numeric]
        if any(map(is_number, cells)) and all(is_number(c) or not c or means(c, "empty") for c in cells):
            return first
    return 0


def _may_be_names(cells: Sequence[str], data: Sequence[str]) -> bool:
    """Whether a row can hold the names of the columns: no number, but as many texts as most of the data."""
    filled = [cell for cell in cells if cell]
    numbers = sum(map(is_number, data))
    return len(filled) >= max(2, numbers) and not any(is_number(c) and not c.lstrip("+-").isdigit() for c in filled) and not is_number(filled[0])


def _all_units(cells: Sequence[str]) -> bool:
    """Whether a row below the names holds units and nothing else."""
    texts = [cell.strip("()[] ") for cell in cells if cell]
    return bool(texts) and all(parse_unit(t) is not None or not words_of(t) or means(t, "empty") for t in texts)


def _is_group_row(above: Sequence[str], names: Sequence[str]) -> bool:
    """Whether a row above the names groups them, as "Run 1,,Run 2,": fewer cells, with gaps, at the columns of names."""
    filled = [k for k, cell in enumerate(above) if cell]
    is_gapped = filled != list(range(len(filled)))
    return is_gapped and not any(map(is_number, above)) and filled[-1] < len(names)


def table_of_rows(file: str, rows: Sequence[Row], description: Sequence[str]) -> ForeignTable:
    """Make a table of rows under their names, with decimal points.

    Raises:
        InputError: no row, or too many columns.
    """
    rows, description = [row for row in rows if any(row.cells)], list(description)
    if not rows:
        remedy = "name the file, or with --sheet the sheet, that holds the table"
        raise refusal("empty", file=file, found="no cells", allowed=KINDS, remedy=remedy)
    width = max(len(row.cells) for row in rows)
    if width > COLUMNS_MAX:
        allowed, remedy = f"at most {COLUMNS_MAX} columns", "save the table alone in a file"
        raise refusal("size", file=file, found=f"{width} columns", allowed=allowed, remedy=remedy)
    filled = [Row(line, cells + [""] * (width - len(cells))) for line, cells in rows]
    has_names = _names_first(filled)
    names, body, below = _names(filled, width) if has_names else ([f"column {k}" for k in range(1, width + 1)], filled, "")
    description += [below] * bool(below)
    repeated = [row for row in body if has_names and row.cells == filled[0].cells]
    if repeated:
        body = [row for row in body if row.cells != filled[0].cells]
        description.append(f"the names again in line {repeated[0].line}{' ...' * (len(repeated) > 1)}, left out")
    cells = [cell for _, row in body for cell in row if not isinstance(cell, _Number)]
    commas = any(_COMMA.fullmatch(cell) or _GROUPED_COMMA.fullmatch(cell) for cell in cells)
    # No notation has both "1.5" and "1,5": such cells are unchanged and refused where a number is needed.
    mixed = commas and any("." in cell and NUMBER.fullmatch(cell) for cell in cells)
    description += ["decimal commas"] * (commas and not mixed)
    columns = {}
    for k, name in enumerate(names):
        if name is not None:
            texts = (row[k] if isinstance(row[k], _Number) else row[k][:CELL_CHARS_MAX] for _, row in body)
            columns[name] = tuple(str(cell) if mixed else _with_point(cell, commas) for cell in texts)
    return ForeignTable(file, ", ".join(description), tuple(line for line, _ in body), columns, rows[0].line)


def _names(rows: Sequence[Row], width: int) -> tuple[list[str | None], Sequence[Row], str]:
    """Names of the columns, from one header line or two, the rows below, and a note on the second line."""
    head, body, note = list(rows[0].cells), rows[1:], ""
    if len(body) > 1 and _is_second_header(body[0].cells, body[1].cells):
        below = body[0].cells
        units = [parse_unit(cell.strip("()[] ")) is not None or not words_of(cell) or means(cell, "empty") for cell in below]
        if all(units) or not any(head[k] == "" and below[k] for k in range(width)):
            marks = ["" if not cell or means(cell, "empty") else f" ({cell.strip('()[] ')})" for cell in below]
            note = "units in the row below the names" if all(units) else "names in two rows"
            if not all(units):
                marks = [f" {cell}" if cell else "" for cell in below]
            head = [name and f"{name}{mark}" for name, mark in zip(head, marks, strict=True)]
        else:
            group = ""
            for k in range(width):
                group = head[k] or group
                head[k] = f"{group} {below[k]}".strip()
            note = "names in two rows"
        body = body[1:]
        if len(body) > 1 and _is_second_header(body[0].cells, body[1].cells):
            inner, body, _ = _names([Row(rows[0].line, head), *body], width)
            return inner, body, "names in three rows"
    return _unique(head), body, note


def _is_second_header(cells: Sequence[str], next_cells: Sequence[str]) -> bool:
    """Whether a row below the names holds units or further names: no number in it, most of the next row numbers."""
    numbers = sum(map(is_number, next_cells))
    return not any(map(is_number, cells)) and any(cells) and numbers > 1 and 2 * numbers > sum(map(bool, next_cells)) - 1


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
