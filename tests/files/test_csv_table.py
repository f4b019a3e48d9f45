"""Strict CSV: numbers, headers, lines."""

from __future__ import annotations

import os

import pytest

from tvsbayes.errors import InputError
from tvsbayes.files.csv_table import CSV_LINE_CHARS_MAX, CSV_ROWS_MAX, append_line, csv_bytes, parse_table, table_blocks


@pytest.mark.parametrize("cell", ["0", "-0", "+1.5", ".5", "5.", "1e3", "1E-3", "-9.25e+2", "000012"])
def test_plain_numbers_are_accepted(cell):
    # The second table has an empty cell, which leaves the fast path: both paths must agree.
    fast = parse_table(f"x\n{cell}\n".encode(), "t.csv", ("x",)).numbers("x", float, -1e4, 1e4)
    slow = parse_table(f"x,y\n{cell},\n,\n".encode(), "t.csv", ("x", "y")).numbers("x", float, -1e4, 1e4, empty=True)
    assert fast == [float(cell)] and slow == [float(cell), None]


@pytest.mark.parametrize(
    "cell",
    [
        *("9_4.7", "infinity", "-inf", "nan", "NaN", "1e999", "0x10", "1e", "e5", ".", "--1", "1-2", "1 2"),
        *(
            " 1",
            "1 ",
            "=1+1",
            "@A1",
            "\u0661\u0662",
            "\uff11",
            '"9,4"',
            "1.2.3",
            "true",
            "\u22121",
            "1" * 5000,
        ),
    ],
)
@pytest.mark.parametrize("empty_elsewhere", [False, True])
def test_other_numbers_are_refused(cell, empty_elsewhere):
    table = parse_table(f"x,y\n1,\n{cell},\n".encode() + b",\n" * empty_elsewhere, "t.csv", ("x", "y"))
    for kind in (float, int):
        with pytest.raises(InputError) as caught:
            table.numbers("x", kind, -1000, 1000, empty=empty_elsewhere)
        assert (caught.value.line, caught.value.column) == (3, "x")
        assert len(caught.value.message) < 400


def test_decimal_comma_is_refused_with_a_remedy():
    with pytest.raises(InputError, match="decimal point, not a comma"):
        parse_table(b'x\n"9,4"\n', "t.csv", ("x",)).numbers("x", float, 0.0, 10.0)
    with pytest.raises(InputError, match="a decimal comma splits a number in two"):
        parse_table(b"x,y\n9,4,1\n", "t.csv", ("x", "y"))
    with pytest.raises(InputError, match="commas between cells"):
        parse_table(b"x;y\n9,4;1\n", "t.csv", ("x", "y"))


@pytest.mark.parametrize("cell", ["1.0", "1e3", "9" * 19, "1_0", "", "+", "1001"])
def test_integers_are_strict(cell):
    with pytest.raises(InputError) as caught:
        parse_table(f"x,y\n{cell},\n".encode(), "t.csv", ("x", "y")).numbers("x", int, 0, 1000)
    assert caught.value.line == 2


def test_bom_crlf_and_column_order_are_accepted():
    plain = parse_table(b"a,b\n1,2\n3,4\n", "t.csv", ("a", "b"))
    for data in (b"\xef\xbb\xbfb,a\r\n2,1\r\n4,3\r\n\r\n", b'"b","a"\n"2","1"\n4,3'):
        table = parse_table(data, "t.csv", ("a", "b"))
        assert table.columns["a"] == plain.columns["a"] == ("1", "3")
        assert table.lines == plain.lines == [2, 3]


@pytest.mark.parametrize(
    ("data", "line", "code"),
    [
        (b"", 1, "empty"),
        (b"\n1,2\n", 1, "empty"),
        (b"a\n1\n", 1, "missing-column"),
        (b"a,b,c\n", 1, "unknown-column"),
        (b"a,b,a\n", 1, "duplicate-column"),
        (b"a,b\n1,2\n3\n", 3, "row-length"),
        (b"a,b\n1,2,3\n", 2, "row-length"),
        (b"a,b\n1,2\n\n3,4\n", 3, "row-length"),
        (b'a,b\n1,"2\n', 2, "csv"),
        (b'a,b\n1,2\n"x\ny",2\n', 3, "csv"),
        (b'a,b\n"1"x,2\n', 2, "csv"),
        (b"a,b\n1,\x00\n", 2, "control-character"),
        (b"a,b\n1,\x1b[2J\n", 2, "control-character"),
        (b"a,b\n1,2\n1,\xe9\n", 3, "encoding"),
        ("a,b\n1,2\n".encode("utf-16"), None, "encoding"),
        (b"a,b\n1," + b"2" * CSV_LINE_CHARS_MAX + b"\n", 2, "size"),
        (b"a,b\n" + b"1,2\n" * (CSV_ROWS_MAX + 1), CSV_ROWS_MAX + 2, "size"),
    ],
)
def test_broken_tables_name_their_line(data, line, code):
    with pytest.raises(InputError) as caught:
        parse_table(data, "t.csv", ("a", "b"))
    assert (caught.value.code, caught.value.line, caught.value.file) == (code, line, "t.csv")


@pytest.mark.parametrize(
    ("row", "code"),
    [(b"1,\xe9", "encoding"), (b"1,\x07", "control-character"), (b"1", "row-length"), (b'1,"2', "csv")],
)
def test_a_block_of_a_long_table_names_the_line_of_its_file(tmp_path, row, code):
    path = tmp_path / "t.csv"
    path.write_bytes(b"a,b\n" + b"1,2\n" * 7 + row + b"\n")
    with pytest.raises(InputError) as caught:
        list(table_blocks(path, ("a", "b"), 3))
    assert (caught.value.code, caught.value.line) == (code, 9)


@pytest.mark.parametrize("cell", ["=1+1", "+x", "-x", "@x", "x" * 101, "a\u202eb", "a\x85b", "a\u2028b"])
def test_text_cells_refuse_formulas_and_invisible_characters(cell):
    with pytest.raises(InputError) as caught:
        parse_table(f"x\n{cell}\n".encode(), "t.csv", ("x",)).texts("x")
    assert caught.value.line == 2 and caught.value.message.isprintable()


def test_csv_round_trip_keeps_every_digit():
    values = [0.1 + 0.2, 1e-300, -1.7976931348623157e308, 5e-324]
    data = csv_bytes(("x", "t"), [(v, 'a "quoted", cell') for v in values])
    table = parse_table(data, "t.csv", ("x", "t"))
    assert table.numbers("x", float, -1.8e308, 1.8e308) == values
    assert table.texts("t") == ['a "quoted", cell'] * 4


def test_lines_are_appended_under_one_header(tmp_path):
    path = tmp_path / "t.csv"
    append_line(path, ("a", "b"), (1, "x, y"))
    append_line(path, ("a", "b"), (2, None))
    assert path.read_bytes() == b'a,b\n1,"x, y"\n2,\n'
    # An editor removed the last newline.
    path.write_bytes(b"a,b\r\n1,2")
    append_line(path, ("a", "b"), (3, 4))
    assert path.read_bytes() == b"a,b\r\n1,2\n3,4\n"


def test_another_table_is_unchanged(tmp_path):
    path = tmp_path / "t.csv"
    path.write_bytes(b"other\n1\n")
    with pytest.raises(InputError) as refused:
        append_line(path, ("a", "b"), (1, 2))
    assert (refused.value.found, refused.value.allowed, refused.value.line) == ("other", "a,b", 1)
    assert path.read_bytes() == b"other\n1\n"


def test_a_full_disk_leaves_no_partial_line(tmp_path, monkeypatch):
    path = tmp_path / "t.csv"
    append_line(path, ("a",), ("kept",))
    write = os.write
    monkeypatch.setattr(os, "write", lambda descriptor, data: write(descriptor, data[:2]))
    with pytest.raises(InputError):
        append_line(path, ("a",), ("lost",))
    assert path.read_bytes() == b"a\nkept\n"
