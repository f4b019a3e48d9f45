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


def test_thousands_separators_are_removed_and_mixed_points_kept(tmp_path):
    assert written(tmp_path / "a.csv", b"x;y\n1.024,50;a\n2,25;b\n").columns["x"] == ("1024.50", "2.25")
    assert written(tmp_path / "b.csv", b"x;y\n1,024.50;a\n").columns["x"] == ("1024.50",)
    assert written(tmp_path / "c.csv", b"x;y\n1,5;a\n1.5;b\n").columns["x"] == ("1,5", "1.5")


def test_remarks_empty_lines_and_missing_names(tmp_path):
    """Lines are those of the file; columns without names get numbers; a stated separator is used."""
    table = written(tmp_path / "a.csv", b"sep=;\n# bench 3\n\n1;2,5\n3;4,5\n;\n")
    assert table.columns == {"column 1": ("1", "3"), "column 2": ("2.5", "4.5")}
    assert table.lines == (4, 5) and table.first_line == 4
    assert written(tmp_path / "b.txt", b" x  y\n 1  2\n").columns == {"x": ("1",), "y": ("2",)}
    assert list(written(tmp_path / "c.csv", b"x,x,\n1,2,3\n").columns) == ["x", "x (2)"]


@pytest.mark.parametrize(
    ("lines", "line", "counts", "cause"),
    [
        ("t,day,n,v\n" + "0,d1,5,7\n" * 3 + "# later\n0,5,d1,5,7,25\n", 6, "6 cells under the 4 names", "commas"),
        ("time n v\n" + "2026-01-02 10:00 5 7\n" * 20, 2, "4 cells under the 3 names", "spaces"),
        ("n;v\n" + "1;2\n" * 20 + "1;2;a;b\n", 22, "4 cells under the 2 names of line 1", "quotes"),
        ("# unit deg\nn;v\n0;0,1\n1;0,7;5\n2;1,3\n", 4, "3 cells under the 2 names of line 2", "quotes"),
    ],
)
def test_rows_with_more_cells_than_names_are_refused(tmp_path, lines, line, counts, cause):
    """Every cell after a split one would be under a wrong name."""
    with pytest.raises(InputError) as refused:
        written(tmp_path / "t.csv", lines.encode())
    assert refused.value.line == line and counts in refused.value.message and cause in refused.value.remedy


@pytest.mark.parametrize("above", ["bench 3\n", "Serial;117\n\nOperator: A. B.\n", "a\n" * 30])
def test_lines_above_the_names_are_left_out(tmp_path, above):
    """They are reported; a short table below them is read."""
    for rows in (20, 4):
        table = written(tmp_path / "t.csv", (above + "n;v;w\n" + "1;2,5;3\n" * (rows + above.count("\n"))).encode())
        assert list(table.columns) == ["n", "v", "w"] and set(table.columns["v"]) == {"2.5"}
        assert table.first_line == above.count("\n") + 1 and "above the names left out" in table.kind


def test_lines_above_the_names_of_a_sheet(tmp_path):
    table = saved(tmp_path / "t.xlsx", ("Protocol 7",), (), ("Pan", "XL"), (200, 640.25), (400, 641.5))
    assert table.columns == {"Pan": ("200", "400"), "XL": ("640.25", "641.5")}


def test_remarks_in_few_rows_hide_no_names_below_other_lines(tmp_path):
    """The row of names is then wider than most."""
    rows = "1;2;\n" * 9 + "3;;not seen\n"
    table = written(tmp_path / "t.csv", ("bench 3\n\nn;v;remark\n" + rows).encode())
    assert list(table.columns) == ["n", "v", "remark"] and table.first_line == 3 and len(table) == 10


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ("boot\nStep: 0, Angle: 1.5\nStep: 200, Angle: 2.5\n", {"Step": ("0", "200"), "Angle": ("1.5", "2.5")}),
        ("Step=0\tAngle=1.5\nStep=9\tAngle=-2\n", {"Step": ("0", "9"), "Angle": ("1.5", "-2")}),
        ("Target: 0\nRead: 1.5 deg\nTarget: 5\nTarget: 9\nRead: 2 deg\n", None),
        (
            "23:59:59.500 -> n: 1 v: 2\n00:00:01.000 -> n: 3 v: 4\n",
            {"time (s)": ("0.000000", "1.500000"), "n": ("1", "3"), "v": ("2", "4")},
        ),
    ],
)
def test_lines_of_a_serial_monitor(tmp_path, text, columns):
    """A repeated name begins a row; a clock becomes seconds, also past midnight."""
    table = written(tmp_path / "t.txt", text.encode())
    assert table.columns == (columns or {"Target": ("0", "5", "9"), "Read (deg)": ("1.5", "", "2")})
    assert ("1 line before the first row left out" in table.kind) == text.startswith("boot")


def test_separators_at_the_end_of_rows_are_no_cells(tmp_path):
    assert written(tmp_path / "a.csv", b"n;v\n" + b"1;2;;\n" * 20).columns == {"n": ("1",) * 20, "v": ("2",) * 20}


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


def test_a_stated_size_of_a_sheet_is_not_trusted(tmp_path):
    cell = '<sheetData><row r="1"><c r="A1"><v>1</v></c></row></sheetData>'
    table = written(tmp_path / "t.xlsx", workbook(f'<dimension ref="A1:XFD1048576"/>{cell}'))
    assert table.columns == {"column 1": ("1",)}


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


@pytest.mark.parametrize(
    ("text", "columns", "note"),
    [
        # The experiment of a lab book stands alone above its rows: no title to leave out.
        ("exp;point;pan\nE1;1;0\n;2;5\nE2;;\n;1;0\n", {"exp": ("E1", "", "E2", "")}, ""),
        ("n;mm\n0;1\n5;2\nChecked by: A. B.;\n", {"n": ("0", "5"), "mm": ("1", "2")}, "line of text left out"),
        ("n;mm\n0;1\nafter lunch;\n5;2\n9;3\n", {"n": ("0", "5", "9")}, 'left out ("after lunch")'),
        (
            "Run up\nn;mm\n0;1\n5;2\nRun down\nn;mm\n5;2\n0;1\n",
            {"direction": ("forward",) * 2 + ("backward",) * 2},
            "runs one",
        ),
        # A second heading without a direction: which side its rows have is open.
        ("Run up\nn;mm\n0;1\n5;2\nRun 2\nn;mm\n5;2\n0;1\n", {"n": ("0", "5", "5", "0")}, 'left out ("Run 2")'),
        ("target;0;5;9;12\nup 1;0,1;5,1;9,1;12,1\n", {"target": ("0", "5", "9", "12")}, "positions across"),
        # Labels of rows, not names of columns.
        ("point A;0;5;9\npoint A;1;5;9\n", {"column 1": ("point A",) * 2}, ""),
        ('[{"a": 1, "b": {"c": "x"}}, {"a": null, "b": {"c": true}}]', {"a": ("1", ""), "b.c": ("x", "true")}, "JSON"),
    ],
)
def test_titles_and_turned_tables(tmp_path, text, columns, note):
    table = written(tmp_path / "t.txt", text.encode())
    assert columns.items() <= table.columns.items() and note in table.kind
    assert note or "left out" not in table.kind
