"""Low-level readers and the atomic writer: text, TOML, JSON, CSV, regular files."""

from __future__ import annotations

import datetime
import tomllib

import pytest

from tvsbayes.errors import InputError
from tvsbayes.files.documents import (
    JSON_BYTES_MAX,
    LINES_CHARS_MAX,
    TOML_BYTES_MAX,
    Keys,
    parse_json,
    parse_toml,
    toml_line,
)

TOML_REFUSED = {
    "syntax": (b"a = 1\nb = \n", 2, "toml"),
    "duplicate key": (b"a = 1\na = 2\n", 2, "toml"),
    "no date": (b"a = 2026-13-45\n", 1, "toml"),
    "huge integer": (b"a = " + b"1" * 5000 + b"\n", None, "toml"),
    "brackets": (b"a = " + b"[" * 10_000, 1, "nesting"),
    "dotted parts": (b"x = 1\n" + b".".join([b"a"] * 30_000) + b" = 1\n", 2, "nesting"),
    "spaced dotted parts": (b" . ".join([b"a"] * 9) + b" = 1\n", 1, "nesting"),
    "quoted dotted parts": (b".".join([b'"a"'] * 9) + b" = 1\n", 1, "nesting"),
    "dotted header": (b"[" + b".".join([b"a"] * 9) + b"]\n", 1, "nesting"),
    "size": (b"#" * (TOML_BYTES_MAX + 1), None, "size"),
    "latin-1": (b"# \n# caf\xe9\n", 2, "encoding"),
    "nul": (b"a = '\x00'\n", 1, "control-character"),
    "unclosed text": (b'a = """' + b'\\"""' * 15_000, None, "toml"),
    "bare carriage return": (b"a = 1\rb = 2\n", 1, "toml"),
}


@pytest.mark.parametrize("name", TOML_REFUSED)
def test_hostile_toml(name):
    data, line, code = TOML_REFUSED[name]
    with pytest.raises(InputError) as caught:
        parse_toml(data, "t.toml")
    assert caught.value.code == code
    if line is not None:
        assert caught.value.line == line


def test_a_duplicate_table_is_named_with_both_lines():
    """A template has [rig.prior]; users add a second one below it."""
    text = b"[rig]\nname = 'a'\n[rig.prior]\nx = 1\n[motion]\n[rig.prior]\ny = 1\n"
    with pytest.raises(
        InputError, match=r"line 6: found the table \[rig\.prior\] a second time, first in line 3"
    ) as caught:
        parse_toml(text, "campaign.toml")
    assert "below the first header" in caught.value.remedy


def test_toml_dots_in_text_and_comments_are_no_keys():
    keys = parse_toml(b'\xef\xbb\xbfa = "1.2.3.4.5.6.7.8.9.10" # 1.2.3.4.5.6.7.8.9.10\r\nb = [0.1, 0.2, 0.3]\n', "t")
    assert keys.values == {"a": "1.2.3.4.5.6.7.8.9.10", "b": [0.1, 0.2, 0.3]}


@pytest.mark.parametrize("literal", ["nan", "inf", "-inf", "1e999", "true", '"1"', "[1]", "11", "0xffff"])
def test_toml_numbers_are_finite_and_in_range(literal):
    keys = parse_toml(f"# a\n[table]\nother = 1\na = {literal}\n".encode(), "t.toml").table("table")
    with pytest.raises(InputError) as caught:
        keys.number("a", 0.0, 10.0)
    assert (caught.value.line, caught.value.column) == (4, "table.a")


JSON_REFUSED = {
    "nan": (b'{\n"a": NaN}', 2, "number"),
    "infinity": (b'{"a": -Infinity}', 1, "number"),
    "1e999": (b'{"a": 1,\n "b":\n 1e999}', 3, "number"),
    "long integer": (b'{"a": ' + b"1" * 19 + b"}", 1, "number"),
    "huge integer": (b'{"a": ' + b"1" * 5000 + b"}", 1, "number"),
    "duplicate": (b'{"a": 1,\n"a": 2}', 2, "duplicate-key"),
    "nested duplicate": (b'{"b": {"a": 1,\n"a": 2}}', 2, "duplicate-key"),
    "brackets": (b'{"a":\n' + b"[" * 100_000, 2, "nesting"),
    "braces": (b'{"a":' * 100_000, 1, "nesting"),
    "syntax": (b'{"a": 1\n "b": 2}', 2, "json"),
    "array": (b"[1, 2]", 1, "json"),
    "empty": (b"", 1, "json"),
    "latin-1": (b'{"a":\n "\xe9"}', 2, "encoding"),
    "size": (b" " * (JSON_BYTES_MAX + 1), None, "size"),
    "trailing": (b'{"a": 1} {"a": 2}', 1, "json"),
}


@pytest.mark.parametrize("name", JSON_REFUSED)
def test_hostile_json(name):
    data, line, code = JSON_REFUSED[name]
    with pytest.raises(InputError) as caught:
        parse_json(data, "t.json")
    assert (caught.value.code, caught.value.line) == (code, line)


def test_json_brackets_in_text_do_not_nest():
    text = "[" * 1000 + '\\"' + "{" * 1000
    assert parse_json(b'{"a": "' + text.encode() + b'"}', "t").values == {"a": "[" * 1000 + '"' + "{" * 1000}


def test_toml_writer_round_trips():
    values = {
        "text": 'quotes " \\ and \u00e9 \U0001d517\nline',
        "number": 1e-05,
        "big": 1e16,
        "integer": 7,
        "flag": True,
        "when": datetime.datetime(2026, 1, 15, 10, 0, tzinfo=datetime.UTC),
        "day": datetime.date(2026, 1, 15),
        "dotted.name": {"value": 0.06, "u": 0.0},
    }
    assert tomllib.loads("\n".join(toml_line(k, v) for k, v in values.items())) == values


TOML_PLACES = {
    "a comment above": ("# seed = 3\nname = 1\nseed = 4\n", ("seed",), 3),
    "a comment with an apostrophe": ("# it's the seed = 3\r\nname = 1\r\nseed = 4\r\n", ("seed",), 3),
    "a comment behind a value": ("name = 1 # seed = 3\nseed = 4\n", ("seed",), 2),
    "a comment in a list": ("a = [1, # seed = 3\n2]\nseed = 4\n", ("seed",), 3),
    "a text of several lines": ('notes = """\nseed = 3\n"""\nseed = 4\n', ("seed",), 4),
    "a literal text": ("notes = '''\nseed = 3\n'''\nseed = 4\n", ("seed",), 4),
    "a text": ('notes = "home, seed = 3"\nseed = 4\n', ("seed",), 2),
    "an entry": ("[t]\na = { value = 1, u = 2 }\nb = { value = 3,  u = 4 }\n", ("t", "b", "u"), 3),
    "quoted dots": ('[t]\n"a.b" = 1\n[t.c]\n"a.b" = { u = 2 }\n', ("t", "c", "a.b", "u"), 4),
    "bare dots": ("[t]\na.b = 1\na.c = 2\n", ("t", "a", "c"), 3),
    "spaced header": ("x = 1\n[ t . u ]\na = 1\n", ("t", "u", "a"), 3),
    "header after its part": ("[t.u]\na = 1\n[t]\nb = 1\na = 2\n", ("t", "a"), 5),
    "an escape": ('x = 1\n"\\u0061" = 1\n', ("a",), 2),
    "an escape that only TOML has": ('"\\U00000061" = 1\nb = 1\n', ("b",), 2),
    "not there, but in a later table": ("[t]\na = 1\n[u]\nb = 2\n", ("t", "b"), 1),
    "nowhere": ("[t]\na = 1\n", ("b",), None),
}


@pytest.mark.parametrize("name", TOML_PLACES)
def test_toml_messages_name_the_line_of_the_key_itself(name):
    text, path, line = TOML_PLACES[name]
    keys = Keys({}, "t.toml", parse_toml(text.encode(), "t.toml").content, path[:-1])
    assert keys.refuse(path[-1], "code", "allowed", "remedy").line == line


def test_lines_are_searched_at_the_beginning_of_a_file_alone():
    text = '{"a": {"c": 1},\n"b": "' + " " * LINES_CHARS_MAX + '",\n"c": {"a": 1}}'
    values = parse_json(text.encode(), "t.json")
    assert [values.refuse(key, "code", "allowed", "remedy").line for key in ("a", "b", "c")] == [1, 2, None]


def test_json_messages_name_the_line_of_the_key_itself():
    text = '\n{"b": "x, \\"a\\": 1",\n "c": [{"a": 1}, [2, {"a": 3}]],\n "d": {"a": {}},\n "a": 1}'
    values = parse_json(text.encode(), "t.json")
    assert values.refuse("a", "code", "allowed", "remedy").line == 5
    assert values.table("d").refuse("a", "code", "allowed", "remedy").line == 4
