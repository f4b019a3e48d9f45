"""Calibrations of other tools: round trips, units, the assumed covariance, hostile YAML."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from support.calibration_files import plain, written

from tvsbayes.cameras.assumed_covariance import Provenance, with_assumed_covariance
from tvsbayes.cameras.calibration_export import exported
from tvsbayes.cameras.imported_calibration import read_calibration
from tvsbayes.errors import InputError
from tvsbayes.importing.stereo_trees import read_trees
from tvsbayes.instrument.stereo_pair import Stereo, stereo_bytes


def close(pair: Stereo, stereo: Stereo, rotation_atol: float = 1e-12) -> None:
    np.testing.assert_allclose(pair.vector[:18], stereo.vector[:18], rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(pair.R, stereo.R, atol=rotation_atol)
    np.testing.assert_allclose(pair.T, stereo.T, atol=rotation_atol * 1e3)
    assert (pair.image_width, pair.image_height) == (stereo.image_width, stereo.image_height)
    assert pair.assumed


@pytest.mark.parametrize("form", ("opencv", "ros"))
@pytest.mark.parametrize("backwards", (False, True))
def test_exported_files_are_imported_again(mounted, tmp_path, form, backwards):
    """Every digit of matrices and distortion; R and T of ROS through rectification to rounding."""
    paths = written(tmp_path, exported(mounted, form))
    result = read_calibration(paths[::-1] if backwards else paths)
    assert result.source == form
    close(result.stereo, mounted)
    way = Provenance(fixed_intrinsics={"opencv": None, "ros": True}[form])
    assert result.stereo.assumed_from == with_assumed_covariance(result.stereo, Provenance(), way).assumed_from
    assert any(result.stereo.assumed_from in note for note in result.notes)
    assert result.stereo.assumed and b'"assumed": true' in stereo_bytes(result.stereo)


def test_opencv_reads_exported_files(mounted, tmp_path):
    values = {"M1": mounted.M1, "D2": mounted.D2[None], "R": mounted.R, "T": mounted.T[:, None]}
    read = []
    for path in written(tmp_path, exported(mounted, "opencv")):
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        for name, value in values.items():
            node = storage.getNode(name)
            if not node.empty():
                np.testing.assert_array_equal(node.mat(), value)
                read.append(name)
        storage.release()
    assert sorted(read) == sorted(values), "each once, in one of the two files"


@pytest.mark.parametrize("header", (b"%YAML:1.0\n---\n", b"%YAML 1.2\n---\n", b""))
def test_files_written_by_opencv_are_read(mounted, tmp_path, header):
    """Its own writer, one file, with the headers of 4.x and 5.x."""
    path = tmp_path / "pair.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in plain(mounted).items():
        storage.write(name, value)
    storage.release()
    body = path.read_bytes().split(b"---\n", 1)[1]
    path.write_bytes(header + body)
    with pytest.raises(InputError, match="--image-size"):
        read_calibration([path])
    close(read_calibration([path], (1280, 720)).stereo, mounted)


def test_native_calibration_keeps_its_covariance(mounted, tmp_path):
    (path,) = written(tmp_path, {"stereo.json": stereo_bytes(mounted)})
    result = read_calibration([path])
    assert result.source == "tvsbayes" and not result.stereo.assumed and result.notes == ()
    np.testing.assert_array_equal(result.stereo.parameter_covariance, mounted.parameter_covariance)


HOSTILE = {
    "tag": "M1: !!python/object/apply:os.system [ 'true' ]",
    "alias": "b: *x",
    "merge": "<<: {a: 1}",
    "twice": "a: 1\na: 2",
    "open list": "a: [1, 2",
    "open list inside": "a: [[1, 2], 3\nb: 1",
    "closing first": "a: 1]\nb: ]",
    "two lists": "a: [1] [2]",
    "deep": "a: " + 20 * "[" + 20 * "]",
    "deep beyond any stack": 100_000 * "[",
    "two commas": "a: [1,,2]",
    "not a number": "a: [1, .nan, .inf] junk",
    "indent": "a:\n    b: 1\n  c: 2",
    "tab": "a:\n\tb: 1",
    "bare word": "just text",
    "empty key": ": 1",
    "second document": "a: 1\n%YAML:1.0\nb: 2",
    "nothing": "# only a comment",
    "control": "a: \x1b[31m",
    "long": "a: [" + ", ".join(["1"] * 200_001) + "]",
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_other_yaml_is_refused_with_its_place(kind):
    with pytest.raises(InputError) as caught:
        read_trees(HOSTILE[kind].encode(), "file.yml")
    assert caught.value.file == "file.yml" and caught.value.remedy
    assert "\x1b" not in str(caught.value)


def test_large_files_are_refused_before_parsing():
    with pytest.raises(InputError, match="at most"):
        read_trees(b"a: 1\n" * 1_000_000, "file.yml")


CHANGES = {
    "model": ("ros", "left.yaml", b"plumb_bob", b"equidistant", "of a fisheye"),
    "no translation": ("opencv", "extrinsics.yml", b"T: !!opencv-matrix", b"P1: !!opencv-matrix", '"P1" twice'),
    "short data": ("opencv", "intrinsics.yml", b"rows: 3", b"rows: 2", "rows times cols"),
    "huge matrix": ("opencv", "intrinsics.yml", b"rows: 3", b"rows: 100000", "rows times cols"),
    "skewed": ("ros", "right.yaml", b"rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [0.9", b"", ""),
    "sizes": ("ros", "left.yaml", b"image_width: 1280", b"image_width: 1380", "two sizes"),
    "text size": ("ros", "left.yaml", b"image_width: 1280", b"image_width: wide", "whole number of px"),
}


@pytest.mark.parametrize("kind", CHANGES)
def test_contradictory_files_are_refused(mounted, tmp_path, kind):
    form, name, old, new, word = CHANGES[kind]
    files = exported(mounted, form)
    if kind == "skewed":
        old = b"rectification_matrix:\n  rows: 3\n  cols: 3\n  data: ["
        new, word = old + b"2", "misses it by"
    assert old in files[name]
    files[name] = files[name].replace(old, new, 1)
    with pytest.raises(InputError, match=word):
        read_calibration(written(tmp_path, files))


def test_one_ros_file_is_not_a_pair(mounted, tmp_path):
    paths = written(tmp_path, exported(mounted, "ros"))
    for some in (paths[:1], [paths[0], paths[0]]):
        with pytest.raises(InputError, match=r"calibration of one camera|no stereo pair"):
            read_calibration(some)
