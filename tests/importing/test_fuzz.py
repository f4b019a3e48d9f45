"""Damaged tables and logs of every kind: rows, a question or a refusal; nothing else, and little memory."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from importing.samples import KEYS, MAXIM_NUMBERS, guide_log, maxim_log, sample
from support.damaged_files import damaged, few

from tvsbayes.cli.axis_import import FileOptions, import_readings
from tvsbayes.errors import InputError
from tvsbayes.importing.cells import Wishes
from tvsbayes.importing.reader import read_foreign
from tvsbayes.importing.sightings import sighting_rows
from tvsbayes.importing.workbook import CELLS_MAX
from tvsbayes.single_axis.axis_campaign import read_axis

MEMORY_BYTES = 300 * 2**20
"""For a file below 10 MB."""
FILES = {
    key: content.encode() if isinstance(content, str) else content
    for key, (_, content, words) in ((key, sample(key)) for key in KEYS)
    if "--urdf" not in words
}


def imported(path, folder):
    """Import a file as an axis and as sightings; whether it was refused."""
    refused = 0
    try:
        import_readings(path, folder / "out", None, FileOptions(), yes=True, as_json=True)
    except InputError as error:
        assert error.remedy or error.message
        refused += 1
    try:
        sighting_rows(read_foreign(path), Wishes())
    except InputError:
        refused += 1
    return refused


@few(80)
@given(damaged(FILES))
def test_damaged_files_are_read_or_refused(tmp_path_factory, case):
    _, data = case
    folder = tmp_path_factory.mktemp("damaged")
    path = folder / "file"
    path.write_bytes(data)
    imported(path, folder)


def test_a_number_whose_square_is_no_float_is_no_warning(tmp_path):
    """Warnings are errors in tests."""
    whole = FILES["counts_wrap/log.csv"].decode()
    path = tmp_path / "log.csv"
    path.write_text(re.sub(r"(?m)^\d+,", "1e308,", whole, count=1))
    imported(path, tmp_path)


BEYOND = "9" * 400
"""A whole number beyond all floats."""


@pytest.mark.parametrize(
    ("column", "cell"),
    [("time", BEYOND), ("reading (deg)", f"{BEYOND} 10 5"), ("reading", f"{BEYOND}/3")],
)
def test_whole_numbers_beyond_all_floats_are_refused(tmp_path, column, cell):
    head = ["steps", "reading (mm)" if column == "time" else column, "time"]
    written = {"reading (deg)": "12 30 1", "reading": "2 1/2"}.get(column, "2.5")
    rows = [[f"{k}", written, f"{1_700_000_000_000 + 10_000 * k}"] for k in range(5)]
    rows[3][head.index(column)] = cell
    (tmp_path / "log.csv").write_text("\n".join(map(",".join, [head, *rows])))
    assert imported(tmp_path / "log.csv", tmp_path) == 2
    assert not (tmp_path / "out").exists()


def test_a_workbook_whose_packed_sheet_is_damaged_is_refused(tmp_path):
    """Its directory and sizes are whole; the bytes between them are no deflated stream."""
    (content,) = [data for data in FILES.values() if b"xl/worksheets/sheet1.xml" in data][:1]
    begin = content.index(b"xl/worksheets/sheet1.xml") + len(b"xl/worksheets/sheet1.xml")
    for damage in (b"\xff" * 30, b"\x00" * 30, b"\x06" + b"\xa5" * 29):
        (tmp_path / "log.xlsx").write_bytes(content[:begin] + damage + content[begin + 30 :])
        assert imported(tmp_path / "log.xlsx", tmp_path) == 2


GUIDES = {
    "PHD2": guide_log(12),
    "PHD2, two runs": guide_log(12) + guide_log(12, "-20.5 deg"),
    "KStars": "KStars version 3.7\n" + guide_log(12),
    "calibrated": "Calibration Begins at 2026-01-02 20:00:00\nWest,1,2,3,4,5\n"
    "Calibration guide speeds: RA = 7.5 a-s/s, Dec = 7.5 a-s/s\n" + guide_log(12),
    "normal rates": guide_log(12).replace("RA Guide Speed", "Norm rates RA = 6.2a-s/s @ dec 0\nRA Guide Speed"),
    "events": guide_log(12)
    .replace("\n5,", "\nINFO: DITHER by 1.0, 2.0\nINFO: Settling started\n5,")
    .replace("\n8,", "\nINFO: Settling complete\n8,"),
    "MaxIm": maxim_log(12),
}
MAXIM = {name: float(number) for name, _, number in (text.partition("=") for text in MAXIM_NUMBERS)}
"""Short logs of guiders: most edits fall into their headers."""


@few(120)
@given(damaged({name: text.encode() for name, text in GUIDES.items()}))
def test_damaged_guide_logs_are_read_or_refused(tmp_path_factory, case):
    """What is written can be read."""
    folder = tmp_path_factory.mktemp("damaged")
    path, out = folder / "guide.txt", folder / "out"
    path.write_bytes(case[1])
    try:
        stated = FileOptions(assume=MAXIM if case[0] == "MaxIm" else {})
        found = import_readings(path, out, None, stated, yes=True, as_json=True)
    except InputError as error:
        assert error.remedy or error.message
        return
    if found is not None:
        found.write()
        read_axis(out)


FLOODS = {
    "many columns": ("a," * 3_000_000).encode(),
    "one long line": b"1" * 9_000_000,
    "many rows": b"steps,reading\n" + b"1,2\n" * 50_000,
    "brackets": b"[" * 5_000_000,
    "pairs": b"x: 1\n" * 60_000,
    "names": b"(" * 1_000_000 + b",b\n1,2\n3,4\n",
    "messages": b'{"q": "stepq:s", "params": {"data": [' + b"[1,1,1]," * 500_000 + b"[1,1,1]]}}\x03",
    "objects": b'[{"a":1}' + b',{"a":1}' * 1_000_000 + b"]",
    "lists in an object": b'[{"a":[[]' + b",[]" * 3_000_000 + b"]}]",
    "camonitor": b"M:axis 2026-03-01 10:00:00.000000 1\n" * 50_000,
}


MEASURED = """
import resource, sys, runpy
from pathlib import Path
tests = runpy.run_path(sys.argv[2])
folder = Path(sys.argv[1])
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for name, data in tests["FLOODS"].items():
    (folder / "flood").write_bytes(data)
    tests["imported"](folder / "flood", folder)
    print(name, 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before))
"""


@pytest.mark.thorough
def test_floods_take_little_memory(tmp_path):
    """In a process of its own, whose largest size counts."""
    tests = Path(__file__).parents[1]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(tests.parent), str(tests)))}
    command = [sys.executable, "-c", MEASURED, str(tmp_path), __file__]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    rows = [line.rsplit(" ", 1) for line in done.stdout.splitlines()]
    assert done.returncode == 0 and len(rows) == len(FLOODS), done.stderr
    assert all(int(used) < MEMORY_BYTES for _, used in rows), rows


@pytest.mark.parametrize("corner", ["XFD1048576", "A1048576"])
def test_a_sheet_with_a_far_corner_is_refused(tmp_path, corner):
    """A reader would fill the rectangle to the last cell: more than the largest area or number of rows."""
    import openpyxl

    book = openpyxl.Workbook()
    book.active["A1"], book.active[corner] = "steps", 1
    book.save(tmp_path / "far.xlsx")
    with pytest.raises(InputError, match=f"{CELLS_MAX} cells"):
        read_foreign(tmp_path / "far.xlsx")
