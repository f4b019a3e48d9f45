"""The stereo pair: rotations, its file, its covariance."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.small_campaign import small_stereo

from tvsbayes.errors import InputError
from tvsbayes.instrument.parameters import (
    STEREO_PARAMETER_NAMES,
)
from tvsbayes.instrument.stereo_pair import read_stereo, rotation_matrix, rotation_vector, write_stereo

ROUNDING = 16 * np.finfo(float).eps  # a dozen roundings in a product of three matrices of order 1


def test_rotation_matrix_against_opencv():
    rng = np.random.default_rng(1)
    for length in (0.0, 1e-12, 1e-5, 0.3, 2.0, np.pi - 1e-9, np.pi):
        axis = rng.normal(size=3)
        vector = length * axis / np.linalg.norm(axis)
        assert np.abs(rotation_matrix(vector) - cv2.Rodrigues(vector)[0]).max() < ROUNDING


@pytest.mark.parametrize("length", [0.0, 1e-15, 1e-9, 1e-4, 0.5, 3.0, np.pi - 1e-9, np.pi - 1e-13])
def test_rotation_vector_inverts_rotation_matrix(length):
    for axis in [*np.eye(3), *-np.eye(3), *np.random.default_rng(2).normal(size=(20, 3))]:
        vector = length * axis / np.linalg.norm(axis)
        matrix = rotation_matrix(vector)
        assert np.abs(rotation_matrix(rotation_vector(matrix)) - matrix).max() < ROUNDING
        # Near pi rounding of the matrix may negate the axis: there only the matrix is compared.
        if length < 3.1:
            assert np.abs(rotation_vector(matrix) - vector).max() < ROUNDING


def test_stereo_vector_has_the_names_order_and_inverts():
    stereo = small_stereo()
    named = dict(zip(STEREO_PARAMETER_NAMES, stereo.vector, strict=True))
    assert stereo.vector.shape == (24,)
    assert (named["stereo.left.fx"], named["stereo.left.fy"]) == (802.0, 801.0)
    assert (named["stereo.right.cx"], named["stereo.right.cy"]) == (633.0, 362.0)
    assert (named["stereo.left.p2"], named["stereo.right.k3"]) == (-6e-4, -0.012)
    assert named["stereo.translation_mm.x"] == -85.2
    moved = stereo.with_vector(stereo.vector + np.arange(24) * 1e-3)
    assert np.abs(moved.vector - stereo.vector - np.arange(24) * 1e-3).max() < 802 * ROUNDING
    assert moved.image_width == 1280 and moved.M1[0, 1] == 0.0 and moved.M1[2, 2] == 1.0


def stereo_document(tmp_path: Path) -> dict:
    write_stereo(small_stereo(), tmp_path / "stereo.json")
    return json.loads((tmp_path / "stereo.json").read_text())


def test_stereo_shapes_of_opencv_are_accepted(tmp_path):
    document = stereo_document(tmp_path)
    row, column = [document["D1"]], [[value] for value in document["D1"]]
    for distortion in (row, column):
        document |= {"D1": distortion, "T": [[value] for value in (-85.2, 0.3, -0.4)]}
        (tmp_path / "stereo.json").write_text(json.dumps(document))
        assert np.array_equal(read_stereo(tmp_path / "stereo.json").vector, small_stereo().vector)


def changed(matrix: list, row: int, column: int, value: object) -> list:
    rows = [list(r) for r in matrix]
    rows[row][column] = value
    return rows


STEREO_REFUSED = {
    "format": ("format", lambda d: {"format": "tvsbayes-stereo/9"}, "word"),
    "no format": ("format", lambda d: {"format": None}, "word"),
    "unknown key": ("Q", lambda d: {"Q": 1}, "unknown-key"),
    "width text": ("image_width", lambda d: {"image_width": "1280"}, "integer"),
    "width float": ("image_width", lambda d: {"image_width": 1280.0}, "integer"),
    "width huge": ("image_width", lambda d: {"image_width": 10**9}, "integer"),
    "flat M": ("M1", lambda d: {"M1": [1.0] * 9}, "shape"),
    "ragged M": ("M1", lambda d: {"M1": [[1.0], [1.0, 2.0], [3.0]]}, "shape"),
    "M of text": ("M2", lambda d: {"M2": changed(d["M2"], 0, 0, "802")}, "matrix"),
    "M of true": ("M2", lambda d: {"M2": changed(d["M2"], 0, 0, True)}, "matrix"),
    "M huge": ("M2", lambda d: {"M2": changed(d["M2"], 0, 0, 1e300)}, "matrix"),
    "negative fx": ("M1", lambda d: {"M1": changed(d["M1"], 0, 0, -802.0)}, "camera-matrix"),
    "skew": ("M1", lambda d: {"M1": changed(d["M1"], 0, 1, 0.1)}, "camera-matrix"),
    "last row": ("M1", lambda d: {"M1": changed(d["M1"], 2, 2, 2.0)}, "camera-matrix"),
    "four distortions": ("D1", lambda d: {"D1": d["D1"][:4]}, "shape"),
    "D deep": ("D1", lambda d: {"D1": [[d["D1"]]]}, "matrix"),
    "D absent": ("D2", lambda d: {"D2": None}, "matrix"),
    "T row": ("T", lambda d: {"T": [d["T"]]}, "shape"),
    "T zero": ("T", lambda d: {"T": [0.0, 0.0, 0.0]}, "translation"),
    "R scaled": ("R", lambda d: {"R": (np.array(d["R"]) * 1.00001).tolist()}, "rotation"),
    "R mirrored": ("R", lambda d: {"R": (-np.array(d["R"])).tolist()}, "rotation"),
    "R two by two": ("R", lambda d: {"R": [[1.0, 0.0], [0.0, 1.0]]}, "shape"),
    "covariance shape": (
        "parameter_covariance",
        lambda d: {"parameter_covariance": [[1.0] * 23] * 24},
        "shape",
    ),
    "covariance absent": ("parameter_covariance", lambda d: {"parameter_covariance": None}, "matrix"),
    "covariance empty": ("parameter_covariance", lambda d: {"parameter_covariance": []}, "shape"),
    "rms negative": ("rms_px", lambda d: {"rms_px": -0.1}, "number"),
    "assumed": ("assumed", lambda d: {"assumed": 1}, "boolean"),
}


@pytest.mark.parametrize("name", STEREO_REFUSED)
def test_stereo_refusals_name_line_and_key(tmp_path, name):
    key, change, code = STEREO_REFUSED[name]
    document = stereo_document(tmp_path)
    document |= change(document)
    path = tmp_path / "stereo.json"
    path.write_text("{\n" + ",\n".join(f'"{k}": {json.dumps(v)}' for k, v in document.items()) + "\n}")
    with pytest.raises(InputError) as caught:
        read_stereo(path)
    error = caught.value
    assert (error.code, error.file, error.column) == (code, "stereo.json", key)
    assert error.line == 2 + list(document).index(key)


def test_covariance_must_be_symmetric_and_positive(tmp_path):
    good = small_stereo().parameter_covariance

    def refused(covariance: np.ndarray) -> str:
        with pytest.raises(InputError) as caught:
            write_stereo(dataclasses.replace(small_stereo(), parameter_covariance=covariance), tmp_path / "s")
        assert caught.value.column == "parameter_covariance"
        return caught.value.message

    correlated = np.zeros((24, 24))
    correlated[:3, :3] = [[1, 0.9, -0.9], [0.9, 1, 0.9], [-0.9, 0.9, 1]]
    assert "eigenvalue" in refused(correlated)
    # The same matrix in the units of the distortion coefficients: scaling must not hide it.
    tiny = np.zeros((24, 24))
    tiny[4:7, 4:7] = 1e-14 * correlated[:3, :3]
    assert "eigenvalue" in refused(tiny)
    asymmetric = good.copy()
    asymmetric[0, 1] += 1e-6
    assert "symmetric" in refused(asymmetric)
    fixed = good.copy()
    fixed[8, 0] = fixed[0, 8] = 1e-9
    assert "variance 0" in refused(fixed)
    negative = np.diag([-1.0, *[1.0] * 23])
    assert "negative variance" in refused(negative) and "stereo.left.fx" in refused(negative)
    overflowing = np.ones((24, 24))
    overflowing[0, 0] = 5e-324
    assert "correlation of" in refused(overflowing)
    with pytest.raises(InputError, match="finite numbers"):
        write_stereo(dataclasses.replace(small_stereo(), parameter_covariance=good * np.nan), tmp_path / "s")
    write_stereo(dataclasses.replace(small_stereo(), parameter_covariance=np.zeros((24, 24))), tmp_path / "s")
