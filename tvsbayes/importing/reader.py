"""The table in a file of another program, of any kind that is known."""

from __future__ import annotations

from pathlib import Path

from tvsbayes.errors import escaped, refusal
from tvsbayes.files.csv_table import CSV_BYTES_MAX
from tvsbayes.files.disk import read_bytes
from tvsbayes.importing import lab_files, serial
from tvsbayes.importing.table import KINDS, WORKBOOKS, ForeignTable, headed, table_of_rows
from tvsbayes.importing.text import text_of, text_table_rows
from tvsbayes.importing.workbook import sheet_rows


def read_foreign(path: Path, sheet: str | None = None) -> ForeignTable:
    """Read the table in a file.

    Args:
        path: a file of at most 64 MiB and 200 000 rows.
        sheet: sheet of a workbook; by default the first with content.

    Raises:
        InputError: unreadable, no table, too large, or another kind of file.
    """
    data, file = read_bytes(Path(path), CSV_BYTES_MAX), escaped(Path(path).name)
    if data.startswith(WORKBOOKS):
        return table_of_rows(file, *headed(sheet_rows(data, file, sheet)))
    if sheet is not None:
        found, remedy = "text, which has no sheets", "leave out --sheet"
        raise refusal("usage", file=file, found=found, allowed=KINDS, remedy=remedy)
    decoded = text_of(data, file)
    readers = (lab_files.renishaw_rows, lab_files.labview_rows, serial.paired_rows)
    rows = next((rows for read in readers if (rows := read(decoded.text, file)) is not None), None)
    return table_of_rows(file, *(rows or text_table_rows(decoded, file)))
