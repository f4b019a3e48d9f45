"""Tables of other programs: encodings, separators, decimal commas, XLSX, refusals."""

from __future__ import annotations

import datetime
import io
import zipfile

import openpyxl
import pytest

from tvsbayes.errors import InputError
from tvsbayes.importing import workbook as workbook_rows
from tvsbayes.importing.reader import read_foreign

ROWS = (("Pan", "XL", "Größe"), ("0", "640.25", "a"), ("-200", "1024.5", "b c"))
"""The table of every file below, numbers with points."""


def written(path, data: bytes):
    path.write_bytes(data)
    return read_foreign(path)


def saved(path, *rows):
    """A table of cells in the sheet of a workbook."""
    book = openpyxl.Workbook()
    for row in rows:
        book.active.append(row)
    book.save(path)
    return read_foreign(path)


def as_text(separator: str, point: str = ".") -> str:
    lines = [list(ROWS[0]), *([a, b.replace(".", point), c] for a, b, c in ROWS[1:])]
    return "".join(separator.join(line) + "\r\n" for line in lines)


@pytest.mark.parametrize("encoding", ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-32", "cp1252"))
@pytest.mark.parametrize(("separator", "point"), [(",", "."), (";", ","), (";", "."), ("\t", ","), ("|", ".")])
def test_every_notation_gives_the_same_table(tmp_path, encoding, separator, point):
    table = written(tmp_path / "t.csv", as_text(separator, point).encode(encoding))
    assert list(zip(*([name, *cells] for name, cells in table.columns.items()), strict=True)) == list(ROWS)
    assert table.lines == (2, 3)
    assert ("decimal commas" in table.kind) == (point == ",")


def test_sheets_of_a_workbook(tmp_path):
    book = openpyxl.Workbook()
    book.active.title = "empty"
    book.create_sheet("data")
    for row in (("Pan", "time", "XL"), (200.0, datetime.datetime(2026, 1, 2, 3, 4, 5), 640.25), (None, "", True)):
        book["data"].append(row)
    book.save(tmp_path / "t.xlsx")
    table = read_foreign(tmp_path / "t.xlsx")
    assert table.kind == "XLSX, sheet data"
    assert table.columns == {
        "Pan": ("200", ""),
        "time": ("2026-01-02T03:04:05", ""),
        "XL": ("640.25", "true"),
    }
    for sheet, match in (("empty", "no cells"), ("other", "empty, data")):
        with pytest.raises(InputError, match=match):
            read_foreign(tmp_path / "t.xlsx", sheet)


def test_numbers_of_a_workbook_beside_texts_with_decimal_commas(tmp_path):
    """Numeric cells have no notation; texts beside them are read by theirs."""
    rows = ("t", "XL", "n"), (61.5, "885,203", 7), (62.25, "1.024,5", "8")
    table = saved(tmp_path / "t.xlsx", *rows)
    assert table.columns == {"t": ("61.5", "62.25"), "XL": ("885.203", "1024.5"), "n": ("7", "8")}
    assert {type(cell) for cells in table.columns.values() for cell in cells} == {str}
    assert saved(tmp_path / "t.xlsx", *rows, (63.0, "9.5", 9)).columns["XL"] == ("885,203", "1.024,5", "9.5")


def bomb() -> bytes:
    """A workbook with a stated unpacked size of a megabyte."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/workbook.xml", bytes(1_000_000))
    return stream.getvalue()


def workbook(sheet: str) -> bytes:
    """A workbook whose one sheet has this XML inside."""
    stream, output = io.BytesIO(), io.BytesIO()
    openpyxl.Workbook().save(stream)
    name = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
    with zipfile.ZipFile(stream) as old, zipfile.ZipFile(output, "w", zipfile.ZIP_DEFLATED) as new:
        for part in old.namelist():
            content = f'<worksheet xmlns="{name}">{sheet}</worksheet>'
            new.writestr(part, content if part == "xl/worksheets/sheet1.xml" else old.read(part))
    return output.getvalue()


LAST = '<sheetData><row r="1048576"><c r="A1048576"><v>1</v></c></row></sheetData>'
"""One cell in the last row that there can be."""


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (b"", "no cells"),
        (b"\xd0\xcf\x11\xe0 old", "damaged workbook"),
        (b"PK\x03\x04 cut", "damaged workbook"),
        (bomb(), "when unpacked"),
        (workbook(LAST), "at most 200000 rows"),
        (workbook("<sheetData><row>&x;</row></sheetData>"), "no cells"),
        (b"\x89PNG\r\n\x1a\n\0\0\x01", "binary data"),
        (b'a,b\n"1,2\n', "line 2: .*close every quote"),
        (b'# a remark\na,b\n1,2\n"x\n\ny",2\n', "line 4: found a line break inside a cell; .*close every quote"),
        (b'sep="\na,b\n1,2\n', "line 1: found the quote .* semicolons"),
        (b",".join(b"1" for _ in range(300)), "at most 200 columns"),
        (b"a,b\n" + b"1,2\n" * 200_001, "at most 200000 rows"),
    ],
    ids=["empty", "xls", "zip", "bomb", "last row", "entity", "png", "quote", "break", "sep", "wide", "long"],
)
def test_files_that_are_no_table_are_refused(tmp_path, monkeypatch, data, match):
    monkeypatch.setattr(workbook_rows, "UNPACKED_BYTES_MAX", 999_999)
    with pytest.raises(InputError, match=match):
        written(tmp_path / "t.csv", data)
    (tmp_path / "text.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="no sheets"):
        read_foreign(tmp_path / "text.csv", "one")
