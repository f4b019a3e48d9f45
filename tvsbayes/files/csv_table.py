"""Strict CSV: cells by column name, each error with its line and column; and tables that grow by one line at a time.

Numbers match the ASCII pattern `NUMBER`: `float` alone would accept "9_4.7", "infinity" and Arabic digits. Size,
rows and the length of a line are capped; lines count from 1.
"""

from __future__ import annotations

import csv
import io
import math
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from itertools import islice
from pathlib import Path

from tvsbayes.errors import INTEGER, InputError, closest, escaped, refusal, shown
from tvsbayes.files.disk import OTHER_PLACE, decode, flush_folder, line_in_file, opened, unwritable
from tvsbayes.progress import Advance, unshown

CSV_BYTES_MAX = 64 * 1024 * 1024
CSV_ROWS_MAX = 200_000
"""With this limit a table of spots takes 0.6 GB and 6 s of CPU time to read."""
CSV_LINE_CHARS_MAX = 16_384
NUMBER = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_DATE = re.compile(
    r"\b(?:jan|feb|mar|apr|may|mai|jun|jul|aug|sep|oct|okt|nov|dec|dez)[a-z]*\b|[0-9]{1,4}[/-][0-9]{1,2}[/-][0-9]{1,4}",
    re.IGNORECASE,
)
_CSV_LINE = re.compile(r"[^\r\n]*(?:\r\n?|\n)|[^\r\n]+")


FOREIGN = "`tvsbayes import FILE --to NEW` reads it"
"""Remedy for a table in another program's format."""


def number_remedy(cell: str, *, whole: bool = False) -> str:
    """The remedy for a cell that is no plain number, or no plain whole number."""
    if cell.startswith(("=", "@")):
        return "save the value, not the formula"
    if cell.strip().lower().lstrip("+-") in ("nan", "inf", "infinity"):
        return "write a finite number; the pixels of a spot that was not seen are empty, its status says why"
    if _DATE.search(cell):
        return "a spreadsheet made a date of it: format the column as text, then write the number again"
    if "," in cell and "." in cell:
        return "write the number without marks between thousands: 1024.50"
    if "," in cell:
        return "write a decimal point, not a comma"
    if "_" in cell or any(c.isspace() for c in cell):
        return "write the digits without underscores or spaces"
    if not cell.isascii():
        return "write it in the digits 0 to 9"
    return "write a whole number such as 200" if whole else "write a decimal number such as 9.47"


def _plain_numbers[N: (int, float)](cells: Sequence[str], kind: type[N], low: float, high: float) -> list[N] | None:
    """Convert a column of valid cells to numbers, fast; None where any cell needs a closer check."""
    # Of all strings of these characters, float() and int() accept exactly NUMBER and INTEGER.
    if not cells or not set().union(*cells) <= set("0123456789+-" if kind is int else "0123456789+-.eE"):
        return None
    try:
        values = list(map(kind, cells))
    except ValueError:
        return None
    return values if low <= min(values) and max(values) <= high else None


class Table:
    """A checked CSV table: cells by column name, each with its line for the errors.

    Attributes:
        file: name of the file.
        lines: line number of every row.
        columns: cells of every column present, as text.
    """

    def __init__(self, file: str, lines: list[int], columns: dict[str, Sequence[str]]):
        self.file, self.lines, self.columns = file, lines, columns

    def __len__(self) -> int:
        return len(self.lines)

    def refuse(
        self, row: int, column: str, code: str, allowed: str, remedy: str, found: str | None = None
    ) -> InputError:
        """The error of one cell; `found` defaults to its content."""
        if not any(cells[row] for cells in self.columns.values()):
            # Spreadsheets append rows that hold separators alone.
            found, remedy = "a line without any value", "delete the line"
        if found is None:
            found = shown(self.columns[column][row]) if self.columns[column][row] else "an empty cell"
        line = self.lines[row]
        return refusal(code, file=self.file, line=line, column=column, found=found, allowed=allowed, remedy=remedy)

    def numbers[N: (int, float)](
        self, column: str, kind: type[N], low: float, high: float, empty: bool = False
    ) -> Sequence[N | None]:
        """Finite numbers in [low, high], integers for the kind int; None for an empty cell where `empty` allows it."""
        if (plain := _plain_numbers(self.columns[column], kind, low, high)) is not None:
            return plain
        values: list[N | None] = []
        match = (INTEGER if kind is int else NUMBER).fullmatch
        for row, cell in enumerate(self.columns[column]):
            if not cell and empty:
                values.append(None)
                continue
            value = kind(cell) if match(cell) else math.nan
            if not (math.isfinite(value) and low <= value <= high):
                raise self._number_refusal(row, column, kind, low, high, empty)
            values.append(kind(value))
        return values

    def _number_refusal(
        self, row: int, column: str, kind: type[int] | type[float], low: float, high: float, empty: bool
    ) -> InputError:
        """The error of a cell that is no number of this kind and range."""
        cell = self.columns[column][row]
        is_decimal = NUMBER.fullmatch(cell) is not None
        if kind is int:
            code, allowed = "integer", f"a whole number from {low} to {high}"
            remedy = "write a whole number, no point" if is_decimal else number_remedy(cell, whole=True)
        else:
            code, allowed = "number", f"a finite decimal number from {low:g} to {high:g}"
            remedy = (
                "check the unit of the column" if is_decimal and math.isfinite(float(cell)) else number_remedy(cell)
            )
        return self.refuse(row, column, code, allowed + ", or an empty cell" * empty, remedy)

    def texts(self, column: str, chars_max: int = 100, empty: bool = True) -> list[str]:
        """Printable texts that a spreadsheet does not take for a formula."""
        allowed = f"printable text of at most {chars_max} characters that does not begin with = + - @"
        for row, cell in enumerate(self.columns[column]):
            if len(cell) > chars_max or not cell.isprintable() or cell.startswith(("=", "+", "-", "@")):
                raise self.refuse(row, column, "text", allowed, "shorten or reword it")
            if not cell and not empty:
                raise self.refuse(row, column, "missing", allowed, "fill the cell in")
        return list(self.columns[column])


def _csv_rows(text: str, file: str, skipped: int) -> Iterator[tuple[int, list[str]]]:
    """Rows of a CSV text with the line on which each begins; `skipped` lines were left out after the first."""
    line_of = partial(line_in_file, skipped=skipped)
    refuse = partial(refusal, file=file)

    def capped_lines() -> Iterator[str]:
        # A StringIO would copy the text, with four bytes per character.
        for number, match in enumerate(_CSV_LINE.finditer(text), start=1):
            line = match.group()
            if len(line) > CSV_LINE_CHARS_MAX:
                found, allowed = f"{len(line)} characters in one line", f"at most {CSV_LINE_CHARS_MAX}"
                raise refuse("size", line=line_of(number), found=found, allowed=allowed, remedy="one row per line")
            yield line

    reader = csv.reader(capped_lines(), strict=True)
    start = 1
    try:
        for row in reader:
            if reader.line_num > start:
                raise csv.Error("a line break inside a cell")
            yield line_of(start), row
            start = reader.line_num + 1
    except csv.Error as error:
        allowed, remedy = "comma-separated cells, one row per line", 'close every quote " in its own line'
        found = escaped(str(error), 120)
        raise refuse("csv", line=line_of(start), found=found, allowed=allowed, remedy=remedy) from error


def table_blocks(path: Path, columns: Sequence[str], rows: int, advance: Advance = unshown) -> Iterator[Table]:
    """A CSV table with exactly `columns`, of any length, in blocks of `rows` lines.

    Args:
        path: the file.
        columns: found by name in any order.
        rows: at most `CSV_ROWS_MAX`.
        advance: called with the share of the file that is read.

    Raises:
        InputError: as `parse_table`, when the block is read.
    """
    file, skipped = escaped(path.name), 0
    with opened(path, "a readable file") as stream:
        size = max(os.fstat(stream.fileno()).st_size, 1)
        header = stream.readline(CSV_LINE_CHARS_MAX)
        while lines := list(islice(iter(partial(stream.readline, CSV_LINE_CHARS_MAX + 1), b""), rows)):
            yield parse_table(header + b"".join(lines), file, columns, skipped=skipped)
            skipped += len(lines)
            advance(stream.tell() / size)
        if not skipped:
            yield parse_table(header, file, columns)


def parse_table(
    data: bytes, file: str, columns: Sequence[str], optional: Sequence[str] = (), skipped: int = 0
) -> Table:
    """A CSV table with exactly `columns` and any of `optional`, found by name in any order.

    Args:
        data: the header's line and rows.
        file: name of the file.
        columns: required columns.
        optional: columns that may be missing.
        skipped: number of lines of the file between the header and these rows.

    Raises:
        InputError: not UTF-8, control characters, a missing or wrong header, rows of another length than the header.
    """
    refuse = partial(refusal, file=file)
    for marks, found in (((b"PK\x03\x04",), "a workbook (XLSX)"), ((b"\xff\xfe", b"\xfe\xff"), "UTF-16")):
        if data.startswith(marks):
            raise refuse("encoding", found=found, allowed="CSV as UTF-8 text", remedy=f"{FOREIGN}; or save it as UTF-8")
    rows = _csv_rows(decode(data, file, skipped), file, skipped)
    # Lines that say who wrote the table.
    line_of_names, header = next(((line, row) for line, row in rows if not (row and row[0].startswith("#"))), (1, []))
    allowed = "the columns " + ",".join(columns) + (f" and optionally {','.join(optional)}" * bool(optional))
    refuse_header = partial(refuse, line=line_of_names, allowed=allowed)
    if not header:
        raise refuse_header("empty", found="no header", remedy="write the column names into the first line")
    if len(header) == 1 and re.search(r"[;\t]", header[0]):
        raise refuse_header(
            "csv", found=shown(header[0]), remedy=f"{FOREIGN}; or use commas between cells, decimal points"
        )
    names = (*columns, *optional)
    for name in header:
        if name not in names:
            found, otherwise = f"an unknown column {shown(name)}", "remove it; remarks go into notes of campaign.toml"
            remedy = closest(name, names, otherwise)
            raise refuse_header("unknown-column", column=name, found=found, remedy=remedy)
        if header.count(name) > 1:
            raise refuse_header("duplicate-column", column=name, found="the column twice", remedy="remove one")
    for name in columns:
        if name not in header:
            raise refuse_header("missing-column", column=name, found="no such column", remedy=f"add {name}")

    line_numbers: list[int] = []
    cells: list[list[str]] = []
    blank = None
    for line, row in rows:
        if not row:
            blank = blank or line
            continue
        if blank is not None or len(row) != len(header):
            found, cells_allowed = "an empty line" if blank else f"{len(row)} cells", f"{len(header)} cells"
            remedy = "one cell per column; a decimal comma splits a number in two: write a point"
            if blank:
                remedy = "remove it; only the end of the file may be empty"
            raise refuse("row-length", line=blank or line, found=found, allowed=cells_allowed, remedy=remedy)
        if len(line_numbers) >= CSV_ROWS_MAX:
            found, rows_allowed = "a row more", f"at most {CSV_ROWS_MAX} rows"
            raise refuse("size", line=line, found=found, allowed=rows_allowed, remedy="split the campaign")
        line_numbers.append(line)
        cells.append(row)
    by_column = list(zip(*cells, strict=True)) or [()] * len(header)
    return Table(file, line_numbers, dict(zip(header, by_column, strict=True)))


def csv_bytes(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> bytes:
    """A CSV file: None is an empty cell, floats keep every digit."""
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return stream.getvalue().encode()


HEAD_MAX = 1 << 16
"""Largest length of the first line of such a table, bytes."""


def append_line(path: Path, columns: Sequence[str], row: Sequence[object]) -> None:
    """Append a line to a table, durably, or leave the table unchanged; a new table begins with its columns.

    The line is one write at the end, so that jobs that run side by side keep each other's lines. A table without a
    newline at its end gets one first.

    Args:
        path: file of the table.
        columns: names in its first line.
        row: one cell per column; None is empty.

    Raises:
        InputError: the table has other columns, or the disk is full or not writable.
    """
    file, data = escaped(str(path), 200), csv_bytes(columns, [row])
    header = data[: len(csv_bytes(columns, []))]
    try:
        is_new = not path.exists()
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
        try:
            size = os.lseek(descriptor, 0, os.SEEK_END)
            if size:
                os.lseek(descriptor, 0, os.SEEK_SET)
                first_line = os.read(descriptor, HEAD_MAX).splitlines()[0]
                if first_line != header.rstrip():
                    columns_found = escaped(first_line.decode(errors="replace"), 80)
                    remedy = "name another file: this one is kept as it is"
                    allowed = header.decode().rstrip()
                    raise refusal("header", file=file, line=1, found=columns_found, allowed=allowed, remedy=remedy)
                os.lseek(descriptor, size - 1, os.SEEK_SET)
                data = (b"" if os.read(descriptor, 1) == b"\n" else b"\n") + data[len(header) :]
            _write_all(descriptor, data, size)
        finally:
            os.close(descriptor)
        if is_new:
            flush_folder(path.parent)
    except OSError as error:
        raise unwritable(path, error, "a writable file on a disk with free space", OTHER_PLACE) from error


def _write_all(descriptor: int, data: bytes, size: int) -> None:
    """Write all bytes or, on a full disk, none of them."""
    try:
        written = os.write(descriptor, data)
        if written < len(data):
            raise OSError(f"{written} of {len(data)} bytes written")
        os.fsync(descriptor)
    except OSError:
        os.ftruncate(descriptor, size)
        raise
