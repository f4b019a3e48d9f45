"""Rows of workbooks: XLSX, ODS, XLS; values, not formulas."""

from __future__ import annotations

import datetime
import io
import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Sequence

from tvsbayes.errors import InputError, escaped
from tvsbayes.files.csv_table import CSV_ROWS_MAX
from tvsbayes.importing.asking import asked, refused
from tvsbayes.importing.table import Number, Row, Rows, cleaned, is_value

UNPACKED_BYTES_MAX = 64 * 2**20
"""Largest sum of the sizes that the parts of a workbook state."""
CELLS_MAX = 4_000_000
"""Largest area of a sheet, from its first cell to its last in both directions."""


def sheet_rows(data: bytes, file: str, sheet: str | None) -> Rows:
    """Read the rows of one sheet: values, not formulas."""
    kind = "XLS" if data.startswith(b"\xd0") else "XLSX"
    if kind == "XLSX":
        kind = _checked_archive(data, file)
    import python_calamine

    try:
        book = python_calamine.load_workbook(io.BytesIO(data))
        # Charts have sheets of their own, without cells.
        names = [s.name for s in book.sheets_metadata if str(s.typ).endswith("WorkSheet")]
        if sheet is not None and sheet not in names:
            raise refused("no-sheet", file, sheet=sheet, sheets=names)
        pages: dict[str, list[Row]] = {}
        for name in [sheet] if sheet is not None else names:
            page = book.get_sheet_by_name(name)
            if page.total_height * page.total_width > CELLS_MAX or page.total_height > CSV_ROWS_MAX + 1:
                raise refused("large-sheet", file, rows=CSV_ROWS_MAX, cells=CELLS_MAX)
            cells = page.to_python(skip_empty_area=False)
            rows = [Row(k, [_cell(value) for value in row]) for k, row in enumerate(cells, start=1)]
            if any(any(row.cells) for row in rows):
                pages[name] = rows
    except InputError:
        raise
    except BaseException as error:
        # A damaged file can make the library raise any exception, a panic of its core included.
        if isinstance(error, KeyboardInterrupt | SystemExit | MemoryError):
            raise
        raise refused("damaged-book", file, error=f" ({escaped(str(error), 100)})", remedy="save it as CSV") from error
    if not pages:
        raise refused("empty-book", file)
    tables = [name for name, rows in pages.items() if _holds_table(rows)]
    if len(tables) > 1:
        raise asked("sheets", file, each=tables, count=len(tables))
    name = next(iter(tables or pages))
    return Rows(pages[name], [f"{kind}, sheet {escaped(str(name))}"])


def _holds_table(rows: Sequence[Row]) -> bool:
    """Whether rows hold two columns of numbers."""
    counts = Counter(k for row in rows for k, cell in enumerate(row.cells) if is_value(cell))
    return sum(count > 2 for count in counts.values()) > 1


def _checked_archive(data: bytes, file: str) -> str:
    """The kind of a zipped workbook, whose sizes and area are checked before anything is unpacked whole."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            parts = archive.infolist()
            known = {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}
            large = sum(part.file_size for part in parts) > UNPACKED_BYTES_MAX
            if large or any(part.compress_type not in known for part in parts):
                raise refused("large-book", file, most=UNPACKED_BYTES_MAX // 2**20)
            is_ods = any(part.filename == "content.xml" for part in parts)
            pages = [p for p in parts if re.fullmatch(r"content\.xml|xl/worksheets/[^/]*\.xml", p.filename)]
            area = max((_area(archive.read(page), is_ods) for page in pages), default=0)
    except (zipfile.BadZipFile, EOFError, OSError, ValueError, NotImplementedError, RuntimeError, zlib.error) as error:
        raise refused("damaged-book", file, error="", remedy="save it again") from error
    if area > CELLS_MAX:
        raise refused("large-sheet", file, rows=CSV_ROWS_MAX, cells=CELLS_MAX)
    return "ODS" if is_ods else "XLSX"


def _area(xml: bytes, is_ods: bool) -> int:
    """Largest area that a reader of a sheet would fill: its last row times its last column."""
    if is_ods:
        # An empty cell or row at the end is repeated to the sheet's edge and costs nothing; one with content does.
        filled = re.findall(rb"<table:table-cell[^>]*office:value[^>]*>", xml)
        repeats = [int(n[:9]) for cell in filled for n in re.findall(rb'number-columns-repeated="(\d+)"', cell)]
        rows = xml.count(b"<table:table-row") + sum(
            int(n[:9])
            for n in re.findall(rb'number-rows-repeated="(\d+)"[^>]*>\s*<table:table-cell[^>]*office:value', xml)
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
        return Number(int(value))
    if isinstance(value, int | float):
        return Number(value)
    if isinstance(value, datetime.datetime | datetime.date | datetime.time):
        return value.isoformat()
    if isinstance(value, datetime.timedelta):
        return Number(value.total_seconds())
    return cleaned(str(value))
