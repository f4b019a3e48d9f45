"""A CSV table that grows by one line at a time, as a job that runs every night writes it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from tvsbayes.errors import escaped, refusal
from tvsbayes.files.csv_table import csv_bytes
from tvsbayes.files.disk import flush_folder

HEAD_MAX = 1 << 16
"""Bytes that the first line of such a table may have."""


def append_line(path: Path, columns: Sequence[str], row: Sequence[object]) -> None:
    """Add a line to a table, durably, or leave the table as it was; a new table begins with its columns.

    One write to the end: jobs that run side by side keep each other's lines. A table without a newline at its end gets
    one first.

    Args:
        path: of the table.
        columns: that its first line must hold.
        row: a cell for each; None is empty.

    Raises:
        InputError: a table with other columns, or a disk that is full or not writable.
    """
    file, whole = escaped(str(path), 200), csv_bytes(columns, [row])
    head = whole[: len(csv_bytes(columns, []))]
    try:
        fresh = not path.exists()
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
        try:
            size = os.lseek(descriptor, 0, os.SEEK_END)
            if size:
                os.lseek(descriptor, 0, os.SEEK_SET)
                first = os.read(descriptor, HEAD_MAX).splitlines()[0]
                if first != head.rstrip():
                    named = escaped(first.decode(errors="replace"), 80)
                    remedy = "name another file: this one is kept as it is"
                    allowed = head.decode().rstrip()
                    raise refusal("header", file=file, line=1, found=named, allowed=allowed, remedy=remedy)
                os.lseek(descriptor, size - 1, os.SEEK_SET)
                whole = (b"" if os.read(descriptor, 1) == b"\n" else b"\n") + whole[len(head) :]
            _write_all(descriptor, whole, size)
        finally:
            os.close(descriptor)
        if fresh:
            flush_folder(path.parent)
    except OSError as error:
        found, allowed = escaped(error.strerror or str(error)), "a writable file on a disk with free space"
        remedy = "name another place or free this one"
        raise refusal("write", file=file, found=found, allowed=allowed, remedy=remedy) from error


def _write_all(descriptor: int, data: bytes, size: int) -> None:
    """All of the bytes or, on a full disk, none of them."""
    try:
        written = os.write(descriptor, data)
        if written < len(data):
            raise OSError(f"{written} of {len(data)} bytes written")
        os.fsync(descriptor)
    except OSError:
        os.ftruncate(descriptor, size)
        raise
