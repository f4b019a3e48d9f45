"""Tables that grow: one head, whole lines, nothing lost."""

from __future__ import annotations

import os

import pytest

from tvsbayes.errors import InputError
from tvsbayes.files.growing_table import append_line


def test_lines_are_added_under_one_head(tmp_path):
    path = tmp_path / "t.csv"
    append_line(path, ("a", "b"), (1, "x, y"))
    append_line(path, ("a", "b"), (2, None))
    assert path.read_bytes() == b'a,b\n1,"x, y"\n2,\n'
    # Somebody's editor took the last newline.
    path.write_bytes(b"a,b\r\n1,2")
    append_line(path, ("a", "b"), (3, 4))
    assert path.read_bytes() == b"a,b\r\n1,2\n3,4\n"


def test_another_table_is_kept_as_it_is(tmp_path):
    path = tmp_path / "t.csv"
    path.write_bytes(b"other\n1\n")
    with pytest.raises(InputError) as refused:
        append_line(path, ("a", "b"), (1, 2))
    assert (refused.value.found, refused.value.allowed, refused.value.line) == ("other", "a,b", 1)
    assert path.read_bytes() == b"other\n1\n"


def test_a_full_disk_leaves_no_part_of_a_line(tmp_path, monkeypatch):
    path = tmp_path / "t.csv"
    append_line(path, ("a",), ("kept",))
    write = os.write
    monkeypatch.setattr(os, "write", lambda descriptor, data: write(descriptor, data[:2]))
    with pytest.raises(InputError):
        append_line(path, ("a",), ("lost",))
    assert path.read_bytes() == b"a\nkept\n"
