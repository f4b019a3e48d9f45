"""One pair in every kind of file, written by the libraries of the formats: the same numbers are read.

Files of many digits are read to 1e-9, the rounding of a few products.
"""

from __future__ import annotations

import json
import tomllib

import cv2
import numpy as np
import pytest
import scipy.io
from support.calibration_files import listed, plain, read_json, written

from tvsbayes.cameras.calibration_export import exported
from tvsbayes.cameras.imported_calibration import read_calibration
from tvsbayes.errors import InputError
from tvsbayes.importing.stereo import fitted_to_five
from tvsbayes.importing.stereo_trees import read_trees
from tvsbayes.instrument.stereo_pair import (
    Stereo,
    project_pair,
    triangulate,
)


def same(pair: Stereo, stereo: Stereo) -> None:
    np.testing.assert_allclose(pair.vector, stereo.vector, rtol=1e-9, atol=1e-9)
    assert (pair.image_width, pair.image_height) == (stereo.image_width, stereo.image_height)
    assert pair.assumed and pair.assumed_from


@pytest.mark.parametrize(
    "names",
    (
        "M1 D1 M2 D2 R T",
        "K1 D1 K2 D2 R T",
        "mtxL distL mtxR distR R T",
        "cameraMatrixL distCoeffsL cameraMatrixR distCoeffsR Rot Trans",
        "left_camera_matrix left_distortion right_camera_matrix right_distortion rotation translation",
        "camera_matrix_0 dist_coeffs_0 camera_matrix_1 dist_coeffs_1 rotation_matrix translation_vector",
        "K_l d_l K_r d_r stereo_R stereo_T",
    ),
)
def test_names_used_by_programs(mounted, tmp_path, names):
    same(read_json(tmp_path, listed(mounted, names)).stereo, mounted)


def test_every_container(mounted, tmp_path):
    """JSON, YAML of nested lists, .npz, .mat and TOML by their own writers, OpenCV's XML and JSON by its own."""
    names = "cameraMatrixL distCoeffsL cameraMatrixR distCoeffsR Rot Trans"
    values, lists = plain(mounted, names), listed(mounted, names)
    size = lists["image_size"]
    (tmp_path / "a.json").write_text(json.dumps(lists))
    (tmp_path / "a.yaml").write_text("\n".join(f"{name}: {value}" for name, value in lists.items()))
    (tmp_path / "a.toml").write_text("\n".join(f"{name} = {value}" for name, value in lists.items()))
    assert tomllib.loads((tmp_path / "a.toml").read_text()) == lists
    np.savez_compressed(tmp_path / "a.npz", image_size=size, **values)
    scipy.io.savemat(tmp_path / "a.mat", {**values, "image_size": size}, do_compression=True)
    for suffix in ("xml", "yml", "json"):
        path = tmp_path / f"cv.{suffix}"
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        for name, value in values.items():
            storage.write(name, value)
        storage.write("image_width", size[0])
        storage.write("image_height", size[1])
        storage.release()
    for file in ("a.json", "a.yaml", "a.toml", "a.npz", "a.mat", "cv.xml", "cv.yml", "cv.json"):
        same(read_calibration([tmp_path / file]).stereo, mounted)


def test_one_file_per_camera_and_a_common_one(mounted, tmp_path):
    """In any order: file names give the cameras; R and T are in the third file or in the right camera's."""
    size = {"image_width": mounted.image_width, "image_height": mounted.image_height}
    between = {"R": mounted.R.tolist(), "T": mounted.T.tolist()}
    cameras = (("left", mounted.M1, mounted.D1), ("right", mounted.M2, mounted.D2))
    for name, m, d in cameras:
        document = {"camera_matrix": m.tolist(), "distortion_coefficients": d.tolist(), **size}
        (tmp_path / f"{name}.json").write_text(json.dumps(document))
    (tmp_path / "between.json").write_text(json.dumps(between))
    for order in (("left", "right", "between"), ("between", "right", "left")):
        same(read_calibration([tmp_path / f"{name}.json" for name in order]).stereo, mounted)
    right = json.loads((tmp_path / "right.json").read_text())
    (tmp_path / "right.json").write_text(json.dumps(right | between))
    same(read_calibration([tmp_path / "right.json", tmp_path / "left.json"]).stereo, mounted)


def test_a_rectified_pair_alone(mounted, tmp_path):
    """P of both cameras alone: the rectified pair triangulates to the points of the raw one."""
    size = mounted.image_width, mounted.image_height
    r1, _, p1, p2, *_ = cv2.stereoRectify(
        mounted.M1, mounted.D1, mounted.M2, mounted.D2, size, mounted.R, mounted.T[:, None], alpha=0
    )
    document = {"P1": np.array(p1).tolist(), "P2": np.array(p2).tolist(), "image_size": size}
    stereo = read_json(tmp_path, document).stereo
    points = np.array([[250.0, 40.0, 10.0], [400.0, -20.0, -30.0], [600.0, 5.0, 60.0]])
    left = np.column_stack((-points[:, 1], -points[:, 2], points[:, 0])) @ np.array(r1).T
    pixels = [
        (left + np.array([b, 0, 0]))[:, :2] / left[:, 2:] * p[0, 0] + p[:2, 2]
        for p, b in ((p1, 0), (p2, p2[0, 3] / p2[0, 0]))
    ]
    again = triangulate(stereo, np.hstack(pixels))
    np.testing.assert_allclose(np.column_stack((-again[:, 1], -again[:, 2], again[:, 0])), left, atol=1e-6)
    # R1, R2, P1, P2 beside M and D, without R and T, give R and T.
    files = exported(mounted, "opencv")
    files["extrinsics.yml"] = files["extrinsics.yml"].replace(b"\nR:", b"\nx:").replace(b"\nT:", b"\ny:")
    stereo = read_calibration(written(tmp_path, files)).stereo
    np.testing.assert_allclose(triangulate(stereo, project_pair(mounted, points)), points, atol=1e-6)


def test_a_fisheye_of_orb_slam_and_a_rectified_pair_by_its_baseline(tmp_path):
    """k1 k2 k3 k4 of single keys; one camera and `Stereo.b`, m."""
    lens = [
        f"Camera{n}.{key}: {v}"
        for n in (1, 2)
        for key, v in zip(
            ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
            (812.4, 811.9, 318.2, 243.7, 0.03, -0.02, 0.03, -0.01),
            strict=True,
        )
    ]
    pose = "Stereo.T_c1_c2: {rows: 4, cols: 4, data: [1,0,0,0.1, 0,1,0,0, 0,0,1,0, 0,0,0,1]}"
    size = ["Camera.width: 640", "Camera.height: 480"]
    path = tmp_path / "orb.yaml"
    path.write_text("\n".join(["%YAML:1.0", "Camera.type: KannalaBrandt8", *lens, *size, pose]))
    result = read_calibration([path])
    assert result.source == "orb-slam" and result.stereo.T.tolist() == [-100.0, 0, 0]
    fitted = fitted_to_five(result.stereo.M1, np.array([0.03, -0.02, 0.03, -0.01]), (640, 480), "fisheye")
    np.testing.assert_array_equal(result.stereo.D2, fitted.distortion)
    path.write_text("\n".join(["%YAML:1.0", "Camera.type: Rectified", *lens[:4], *size, "Stereo.b: 0.11"]))
    result = read_calibration([path])
    assert result.stereo.T.tolist() == [-110.0, 0, 0] and np.array_equal(result.stereo.M1, result.stereo.M2)
    assert not result.stereo.D1.any() and np.array_equal(result.stereo.R, np.eye(3))


def test_two_picture_sizes_of_one_proportion(mounted, tmp_path):
    """The right camera's matrix for pictures of 3/2 of the size is scaled to the left one's size."""
    good = listed(mounted)
    K2 = np.diag([1.5, 1.5, 1]) @ mounted.M2
    K2[:2, 2] += 0.25
    document = {"left": {"K": good["M1"], "D": good["D1"], "size": [1280, 720]}, "R": good["R"], "T": good["T"]}
    document["right"] = {"K": K2.tolist(), "D": good["D2"], "size": [1920, 1080]}
    result = read_json(tmp_path, document)
    same(result.stereo, mounted)
    assert result.stereo.right_image_size == (1920, 1080) and any("two sizes" in note for note in result.notes)
    document["right"]["size"] = [1920, 1200]
    with pytest.raises(InputError, match="two sizes: 1280 x 720 and 1920 x 1200"):
        read_json(tmp_path, document)


def test_missing_names_are_given_by_the_user(mounted, tmp_path):
    odd = listed(mounted, "alpha beta gamma delta epsilon zeta")
    document = {"image_size": odd.pop("image_size"), "cal": odd}
    keys = dict(zip(("M1", "D1", "M2", "D2", "R", "T"), odd, strict=True))
    with pytest.raises(InputError, match=r"no M1 M2.*cal\.alpha.*--key M1=NAME"):
        read_json(tmp_path, document)
    same(read_json(tmp_path, document, keys=keys).stereo, mounted)
    for changed in ({"M1": "nothing"}, {"M1": "zeta"}):
        with pytest.raises(InputError, match="--key M1="):
            read_json(tmp_path, document, keys={**keys, **changed})


HOSTILE = {
    "entity.xml": b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "c">]><opencv_storage><M1>&b;</M1></opencv_storage>',
    "open.xml": b"<opencv_storage><M1>",
    "twice.xml": b"<opencv_storage><M1>1 2</M1><M1>1 3</M1></opencv_storage>",
    "deep.xml": b"<opencv_storage>" + 2000 * b"<a>" + 2000 * b"</a>" + b"</opencv_storage>",
    "laughs.yml": b"".join(
        b"a%d: &a%d [%s]\n" % (k, k, b",".join(10 * [b"*a%d" % (k - 1) if k else b"1"])) for k in range(9)
    ),
    "itself.yml": b"a: &a [*a, 1]\n",
    "h5.mat": b"\x89HDF\r\n\x1a\n" + 50 * b"\0",
    "short.npz": b"PK\x03\x04 nothing",
    "short.mat": b"MATLAB 5.0 MAT-file" + 150 * b"\0",
    "picture.png": b"\x89PNG\r\n\x1a\n" + 50 * b"\0",
    "pickle.pkl": b"\x80\x04\x95" + 50 * b"\0",
    "text.txt": b"fx = 800\nfy",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_and_damaged_containers_are_refused(name):
    with pytest.raises(InputError) as caught:
        read_trees(HOSTILE[name], name)
    assert caught.value.remedy and name in str(caught.value) and "UTF-8" not in caught.value.remedy


def test_pickles_and_bombs_are_refused(tmp_path):
    np.savez(tmp_path / "p.npz", a=np.array([{}], object))
    with pytest.raises(InputError, match=r"p\.npz"):
        read_calibration([tmp_path / "p.npz"])
    np.savez_compressed(tmp_path / "b.npz", a=np.zeros(1_000_000))
    scipy.io.savemat(tmp_path / "b.mat", {"a": np.zeros(1_000_000)}, do_compression=True)
    for name in ("b.npz", "b.mat"):
        with pytest.raises(InputError, match="4194304 bytes"):
            read_calibration([tmp_path / name])


@pytest.mark.parametrize("seed", (31, 5))
def test_damaged_mat_files_end_in_a_refusal(seed, tmp_path):
    """The first of these seeds ends scipy.io.loadmat 1.17 in a segmentation fault."""
    structure = {"s": {"M1": np.eye(3), "D1": np.zeros(5), "T": np.arange(3.0)}}
    scipy.io.savemat(tmp_path / "m.mat", structure)
    data, rng = bytearray((tmp_path / "m.mat").read_bytes()), np.random.default_rng(seed)
    for _ in range(3):
        at = int(rng.integers(128, len(data)))
        if rng.random() < 0.3:
            del data[at : at + int(rng.integers(1, 40))]
        else:
            data[at] = int(rng.integers(256))
    with pytest.raises(InputError, match=r"m\.mat"):
        read_trees(bytes(data), "m.mat")
