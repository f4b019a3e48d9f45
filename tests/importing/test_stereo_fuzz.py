"""Damaged calibrations of every format: a pair, or a refusal with a remedy; nothing else, and little memory."""

from __future__ import annotations

import re
import tracemalloc
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.calibration_files import FOREIGN

from tvsbayes.cameras.imported_calibration import read_calibration
from tvsbayes.errors import InputError
from tvsbayes.importing.stereo_trees import TREE_BYTES_MAX

SAMPLES = (
    *("opencv_xml/pair.xml", "opencv_xml/pair.yml", "plain_json/pair.json", "matlab_json/c.json", "caliscope/c.toml"),
    *("kalibr_chain/camchain.yaml", "orb_slam3/o.yaml", "pasted_messages/both.yaml", "poses_in_world/c.json"),
    *("depthai/calib.json", "boofcv/stereo.yaml", "realsense/enumerate.txt", "realsense/objects.txt"),
    *("realsense/intrinsics.json", "zed/SN1.conf", "basalt/calibration.json", "calibio/stereo.json"),
    *("kalibr_results/results-cam.txt", "ost_ini/ost.txt", "metashape/cameras.xml", "mrcal/right.cameramodel"),
    *("npy/R.npy", "npy_txt/R.txt", "halcon/camparL.dat", "fisheye_advice/fisheye.yaml"),
)
WORDS = (
    *("nan", "inf", "-inf", "1e308", "-1e308", "5e-324", "0", "-1", "1e400", "99999999999999999999", '""', "null"),
    *("true", "[]", "{}", '"a"', "\u0665", "\x00", "0x10", "1_0", "-", "", "1e", "1:2:3", "9" * 400, "[[[", "<a>"),
)
NUMBER, WORD = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?"), re.compile(rb"[A-Za-z_]{2,}")


def refused_or_read(paths: list[Path]) -> bool:
    try:
        read_calibration(paths, (640, 480), unit_mm=1000.0)
    except InputError as error:
        assert error.remedy and len(str(error)) < 2000
        return True
    return False


@st.composite
def damaged(draw: st.DrawFn) -> tuple[str, bytes]:
    """A sample with one to three edits: a number, a byte, a line, the end, or a word."""
    name = draw(st.sampled_from(SAMPLES))
    data = (FOREIGN / name).read_bytes()
    for _ in range(draw(st.integers(1, 3))):
        numbers, words = list(NUMBER.finditer(data)), list(WORD.finditer(data))
        kind = draw(st.sampled_from(("number", "number", "number", "byte", "line", "end", "word")))
        at = draw(st.integers(0, max(len(data) - 1, 0)))
        if kind == "number" and numbers:
            old = numbers[at % len(numbers)]
            data = data[: old.start()] + draw(st.sampled_from(WORDS)).encode() + data[old.end() :]
        elif kind == "word" and words:
            old, new = words[at % len(words)], words[draw(st.integers(0, len(words) - 1))]
            data = data[: old.start()] + new.group() + data[old.end() :]
        elif kind == "line":
            lines = data.split(b"\n")
            lines.insert(at % len(lines), lines.pop(draw(st.integers(0, len(lines) - 1))))
            data = b"\n".join(lines[draw(st.integers(0, 1)) :])
        else:
            data = data[:at] + (bytes([draw(st.integers(0, 255))]) + data[at + 1 :] if kind == "byte" else b"")
    return Path(name).name, data


@settings(max_examples=250, derandomize=True, deadline=None, database=None, suppress_health_check=list(HealthCheck))
@given(damaged())
def test_damaged_files_are_read_or_refused(tmp_path_factory, case):
    name, data = case
    path = tmp_path_factory.mktemp("damaged") / name
    path.write_bytes(data)
    refused_or_read([path])


@pytest.mark.parametrize("field", ("D1", "D2", "M1", "T", "R", "image_size"))
def test_extreme_numbers_of_a_plain_file(tmp_path, mounted, field):
    """Of a lens, a matrix or a pose: also those whose products overflow."""
    import json

    from support.calibration_files import listed

    for number in (0.0, 5e-324, 1e-300, 1e12, -1e12, 1e308, 10**400, True, "1"):
        document = listed(mounted)
        document[field] = [[number] * len(row) if isinstance(row, list) else number for row in document[field]]
        (tmp_path / "m.json").write_text(json.dumps(document))
        refused_or_read([tmp_path / "m.json"])
        document = listed(mounted)
        document[field][-1] = [number] * 3 if isinstance(document[field][-1], list) else number
        (tmp_path / "m.json").write_text(json.dumps(document))
        refused_or_read([tmp_path / "m.json"])


FLOODS = {
    "rows.txt": b"1 " * (TREE_BYTES_MAX // 2 - 1),
    "empty.xml": b"<a>" + b"<b/>" * (TREE_BYTES_MAX // 4 - 2) + b"</a>",
    "deep.xml": b"<a>" * 600_000,
    "lists.json": b'{"a": [' + b"[]," * 1_200_000 + b"[]]}",
    "flow.yaml": b"a: [" + b"1," * 2_000_000 + b"1]",
    "keys.toml": b"".join(b"a%d = 1\n" % k for k in range(300_000)),
    "quotes.cameramodel": b"{ 'a': [" + b"'b'," * 900_000 + b"] }",
    "sections.txt": b"[image]\n" * 400_000,
    "streams.txt": b'Intrinsic of "a" / 640x480\n' * 150_000,
}


@pytest.mark.parametrize("name", FLOODS)
def test_large_files_take_little_memory(tmp_path, name):
    (tmp_path / name).write_bytes(FLOODS[name])
    tracemalloc.start()
    try:
        assert refused_or_read([tmp_path / name])
        assert tracemalloc.get_traced_memory()[1] < 200_000_000
    finally:
        tracemalloc.stop()
