"""Rows of workbooks: XLSX, ODS, XLS; values, not formulas."""

from __future__ import annotations

import datetime
import io
import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Sequence
from functools import reduce

from tvsbayes.errors import InputError, escaped
from tvsbayes.files.csv_table import CSV_ROWS_MAX
from tvsbayes.importing.asking import asked, refused
from tvsbayes.importing.table import Number, Row, Rows, cleaned, is_value

UNPACKED_BYTES_MAX = 64 * 2**20
"""Largest sum of the sizes that the parts of a workbook state."""
CELLS_MAX = 4_000_000
"""Largest area of a sheet, from its first cell to its last in both directions."""
_ODS_CELL = rb"<table:table-cell[^>]*office:value[^>]*>"


def sheet_rows(data: bytes, file: str, sheet: str | None) -> Rows:
    """Read the rows of one sheet: values, not formulas."""
    kind = "XLS" if data.startswith(b"\xd0") else _checked_archive(data, file)
    import python_calamine

    try:
        book = python_calamine.load_workbook(io.BytesIO(data))
        # Charts have sheets of their own, without cells.
        names = [s.name for s in book.sheets_metadata if str(s.typ).endswith("WorkSheet")]
        if sheet is not None and sheet not in names:
            raise refused("no-sheet", file, sheet=sheet, sheets=names)
        pages = {}
        for name in names if sheet is None else [sheet]:
            page = book.get_sheet_by_name(name)
            if page.total_height * page.total_width > CELLS_MAX or page.total_height > CSV_ROWS_MAX + 1:
                raise refused("large-sheet", file, rows=CSV_ROWS_MAX, cells=CELLS_MAX)
            cells = enumerate(page.to_python(skip_empty_area=False), start=1)
            pages[name] = [Row(k, list(map(_cell, row))) for k, row in cells]
    except (InputError, KeyboardInterrupt, SystemExit, MemoryError):
        raise
    except BaseException as error:
        # A damaged file can make the library raise any exception, a panic of its core included.
        raise refused("damaged-book", file, error=f" ({escaped(str(error), 100)})", remedy="save it as CSV") from error
    pages = {name: rows for name, rows in pages.items() if any(any(row.cells) for row in rows)}
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
            packed = {part.compress_type for part in parts} - {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}
            if packed or sum(part.file_size for part in parts) > UNPACKED_BYTES_MAX:
                raise refused("large-book", file, most=UNPACKED_BYTES_MAX // 2**20)
            pages = [p for p in parts if re.fullmatch(r"content\.xml|xl/worksheets/[^/]*\.xml", p.filename)]
            area = max((_area(archive.read(page)) for page in pages), default=0)
    except (zipfile.BadZipFile, EOFError, OSError, ValueError, NotImplementedError, RuntimeError, zlib.error) as error:
        raise refused("damaged-book", file, error="", remedy="save it again") from error
    if area > CELLS_MAX:
        raise refused("large-sheet", file, rows=CSV_ROWS_MAX, cells=CELLS_MAX)
    return "ODS" if any(page.filename == "content.xml" for page in pages) else "XLSX"


def _area(xml: bytes) -> int:
    """Largest area that a reader of a sheet would fill: its last row times its last column."""
    # Of ODS: an empty cell or row at the end is repeated to the sheet's edge and costs nothing; one with content does.
    repeated = re.findall(rb'number-columns-repeated="(\d{1,9})', b"".join(re.findall(_ODS_CELL, xml)))
    again = re.findall(rb'number-rows-repeated="(\d{1,9})\d*"[^>]*>\s*' + _ODS_CELL, xml)
    rows, columns = xml.count(b"<table:table-row") + sum(map(int, again)), 1 + max(map(int, repeated), default=0)
    for letters, number in re.findall(rb'\br="([A-Z]{1,9})([0-9]{1,9})"', xml):
        columns = max(columns, reduce(lambda at, letter: 26 * at + letter - 64, letters, 0))
        rows = max(rows, int(number))
    return rows * columns


def _cell(value: object) -> str:
    match value:
        case bool():
            return str(value).lower()
        case int() | float():
            return Number(int(value) if abs(value) < 1e15 and value == int(value) else value)
        case datetime.timedelta():
            return Number(value.total_seconds())
        case datetime.date() | datetime.time():
            return value.isoformat()
    return cleaned(str(value or ""))
