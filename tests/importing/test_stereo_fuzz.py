"""Damaged calibrations of every format: a pair, or a refusal with a remedy; nothing else, and little memory."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import pytest
from hypothesis import given
from support.calibration_files import FOREIGN, listed
from support.damaged_files import damaged, few

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


def refused_or_read(paths: list[Path]) -> bool:
    try:
        read_calibration(paths, (640, 480), unit_mm=1000.0)
    except InputError as error:
        assert error.remedy and len(str(error)) < 2000
        return True
    return False


@few(60)
@given(damaged({name: (FOREIGN / name).read_bytes() for name in SAMPLES}))
def test_damaged_files_are_read_or_refused(tmp_path_factory, case):
    name, data = case
    path = tmp_path_factory.mktemp("damaged") / Path(name).name
    path.write_bytes(data)
    refused_or_read([path])


@pytest.mark.parametrize("field", ("D1", "D2", "M1", "T", "R", "image_size"))
def test_extreme_numbers_of_a_plain_file(tmp_path, mounted, field):
    """Of a lens, a matrix or a pose: also those whose products overflow."""
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
    "blank.txt": b"\n" * (TREE_BYTES_MAX - 1),
    "spaces.txt": b" " * (TREE_BYTES_MAX - 2) + b"x",
    "words.txt": b"a: b\n " * (TREE_BYTES_MAX // 6),
    "brackets.txt": b"[ 1x1 p[" * (TREE_BYTES_MAX // 8),
    "kalibr.txt": b"Calibration results\n===\ncam0 (a):\n" + b"  a: b\n" * 100_000,
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
