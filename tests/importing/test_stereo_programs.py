"""Files of camera makers and of BoofCV: the same pair as every file of `tests/data/foreign`, and mistakes.

Numbers of twelve digits and more are read to 1e-9: rounding of a few products of three matrices.
"""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from support.calibration_files import FOREIGN, check_pair

from tvsbayes.cameras.imported_calibration import read_calibration
from tvsbayes.errors import InputError
from tvsbayes.importing.stereo import fitted_to_five, foreign_pair, kind_of
from tvsbayes.importing.stereo_trees import read_files
from tvsbayes.instrument.stereo_pair import Stereo

SMALL = (640, 480)


def changed(name: str, **new: object) -> str:
    """The OAK's file with other values in the camera at socket 1."""
    document = json.loads((FOREIGN / name).read_text())
    camera = next(one[1] for one in document["cameraData"] if one[0] == 1)
    for key, value in new.items():
        (camera["extrinsics"] if key in camera["extrinsics"] else camera)[key] = value
    return json.dumps(document)


def edited(name: str, old: str, new: str) -> str:
    text = (FOREIGN / name).read_text()
    assert old in text
    return text.replace(old, new, 1)


OAK, ZED, PRINTED = "depthai/calib.json", "zed/SN1.conf", "realsense/enumerate.txt"
BROKEN = {
    "a chain that ends elsewhere": (lambda: changed(OAK, toCameraSocket=7), None, "chain of toCameraSocket"),
    "a chain without end": (lambda: changed(OAK, toCameraSocket=1), None, "chain of toCameraSocket"),
    "no pose in the EEPROM": (lambda: changed(OAK, rotationMatrix=[]), None, "take it again from there"),
    "R of the EEPROM no rotation": (lambda: changed(OAK, rotationMatrix=[[2, 0, 0], [0, 1, 0], [0, 0, 1]]), None, "R"),
    "another lens": (lambda: changed(OAK, cameraType=2), None, "the model cameratype 2"),
    "translation stated in mm": (
        lambda: changed(OAK, translation={"x": -1190.0, "y": 0.0, "z": 0.0}),
        None,
        "--import-unit",
    ),
    "a ZED without R": (lambda: edited(ZED, "RX_HD=0.01", ""), (1280, 720), "stereo.rx"),
    "a ZED with words": (lambda: edited(ZED, "fx=812.4", "fx=wide"), (1920, 1080), "left_cam_fhd.fx"),
    "a ZED's baseline in m": (
        lambda: edited(ZED, "Baseline=118.6", "Baseline=0.1186"),
        (1280, 720),
        "--import-unit m ",
    ),
    "a key of a ZED twice": (lambda: edited(ZED, "Baseline=118.6", "Baseline=118.6\nbaseline=120"), None, "baseline"),
    "an OAK's sockets in a list": (lambda: changed(OAK, toCameraSocket=[0]), None, "take it again from there"),
    "no pose between the streams": (
        lambda: edited(PRINTED, 'from "Infrared 1"\t  To\t  "Infrared 2"', 'from "Infrared 1"\t  To\t  "Gyro"'),
        SMALL,
        "no pose between",
    ),
    "a pose without its shift, before another pose": (
        lambda: edited(PRINTED, "Translation Vector: -0.1186", "Vector: -0.1186"),
        SMALL,
        "no pose between",
    ),
    "half of MATLAB's coefficients": (
        lambda: (FOREIGN / "matlab_json/c.json").read_text().replace("RadialDistortion", "Radial"),
        None,
        "no D1 under",
    ),
    "a focal length of Basalt that is none": (
        lambda: edited("basalt/calibration.json", '"fy": 811.9', '"fy": true'),
        None,
        "no M1 under",
    ),
    "BoofCV without a shift": (lambda: edited("boofcv/stereo.yaml", "  z:", "  depth:"), None, "no T under"),
    "BoofCV's other lens": (
        lambda: edited("boofcv/stereo.yaml", "pinhole_radial_tangential", "universal_omni"),
        None,
        "the model universal_omni",
    ),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_broken_files_of_makers_are_refused_with_a_remedy(tmp_path, kind):
    text, size, word = BROKEN[kind]
    (tmp_path / "m.txt").write_text(text())
    with pytest.raises(InputError) as caught:
        read_calibration([tmp_path / "m.txt"], size)
    assert word in str(caught.value) and caught.value.remedy and "m.txt" in str(caught.value)


def test_a_lens_described_from_pixels_to_rays_is_fitted():
    """Inverse Brown-Conrady is not plumb bob: read as that, a corner is off by many times the stated error of the fit.

    The rays follow the formula in librealsense's rsutil.h.
    """
    text = edited("realsense/intrinsics.json", "distortion.brown_conrady", "Inverse Brown Conrady")
    coefficients, pixel = np.array([-0.21, 0.08, 0.001, -0.0005, 0.0]), np.array([20.0, 30.0])
    matrix = np.array([[812.4, 0, 318.2], [0, 811.9, 243.7], [0, 0, 1]])
    x, y = (pixel - matrix[:2, 2]) / matrix[[0, 1], [0, 1]]
    r2 = x * x + y * y
    k1, k2, p1, p2, _ = coefficients
    f = 1 + k1 * r2 + k2 * r2**2
    ray = np.array([x * f + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * f + 2 * p2 * x * y + p1 * (r2 + 2 * y * y), 1])
    lens = fitted_to_five(matrix, coefficients, SMALL, "inverse")
    still = np.zeros(3)
    ours = cv2.projectPoints(ray[None], still, still, matrix, lens.distortion)[0].ravel()
    renamed = cv2.projectPoints(ray[None], still, still, matrix, coefficients)[0].ravel()
    # The fit's largest error is over a grid; between its points the error is slightly larger.
    assert np.abs(ours - pixel).max() < 1.1 * lens.error_px < 0.1
    assert np.abs(renamed - pixel).max() > 5
    assert json.loads(text)["left"]["model"] == "Inverse Brown Conrady"


@pytest.mark.parametrize(
    "name, kind",
    (
        ("Inverse Brown Conrady", "inverse"),
        ("distortion.inverse_brown_conrady", "inverse"),
        ("radial-tangential", "five"),
        ("Plumb Bob", "five"),
        ("", "five"),
        ("KannalaBrandt8", "fisheye"),
        ("rational polynomial", "rational"),
        ("omni", None),
    ),
)
def test_names_of_lens_models(name, kind):
    assert kind_of(name) == kind


SAME = {
    "opencv_other_names/pair.yml": "opencv",
    "opencv_other_names/pair2.yml": "opencv",
    "opencv_other_names/pair3.yml": "opencv",
    "opencv_xml/pair.xml": "opencv",
    "plain_json/pair.json": "opencv",
    "ros_message_dump/left.yaml ros_message_dump/right.yaml": "ros",
    "ros_message_dump/right.yaml ros_message_dump/left.yaml": "ros",
    "euroc_sensor_pair/cam0.yaml euroc_sensor_pair/cam1.yaml": "euroc",
    "kalibr_chain/camchain.yaml": "kalibr",
    "kalibr_imu/camchain-imucam.yaml": "kalibr",
    "vins_fusion/cam0.yaml vins_fusion/cam1.yaml vins_fusion/euroc_stereo.yaml": "euroc",
    "orb_slam3/o.yaml": "orb-slam",
    "caliscope/c.toml": "opencv",
    "matlab_json/c.json": "matlab",
    "poses_in_world/c.json": "opencv",
    "pasted_messages/both.yaml": "ros",
    "bouguet/Calib_Results_stereo.mat": "opencv",
    "depthai/calib.json": "depthai",
    "realsense/enumerate.txt": "realsense",
    "realsense/objects.txt": "realsense",
    "realsense/intrinsics.json": "realsense",
    "boofcv/stereo.yaml": "boofcv",
    "mrcal/left.cameramodel mrcal/right.cameramodel": "mrcal",
    "mrcal/right.cameramodel mrcal/left.cameramodel": "mrcal",
    "basalt/calibration.json": "basalt",
    "metashape/cameras.xml": "metashape",
    "npy": "opencv",
    "npy_txt": "opencv",
}
FIFTH = ("orb_slam3", "caliscope", "matlab_json", "poses_in_world", "pasted_messages", "bouguet", "mrcal")


@pytest.mark.parametrize("names", SAME)
def test_the_same_pair_in_the_files_of_every_program(names):
    """Chains of sockets, quaternions, poses in a body or a world, R by rows or columns; lengths in m, cm and mm."""
    files = read_files([FOREIGN / name for name in names.split()])
    sizes = SMALL if names.startswith(("npy", "realsense/enum")) else None
    pair = foreign_pair(files, sizes, 1000.0 if "metashape" in names else None, {})
    assert pair.source == SAME[names]
    stereo = Stereo(**pair.values, parameter_covariance=np.zeros((24, 24)), rms_px=0.0)
    check_pair(stereo, *((0.01, -0.02) if names.startswith(FIFTH) else ()))
    assert {"M1", "M2", "R", "T"} <= set(pair.places)


NEW = {
    "a camera of Metashape without a pose": ("metashape/cameras.xml", "transform>", "reference>", "two cameras"),
    "skew of Metashape": ("metashape/cameras.xml", "<b1>", "<b2>1</b2><b1>", "b2, k4"),
    "another lens of calib.io": ("calibio/stereo.json", "CameraModelOpenCV", "CameraModelKB", "CameraModelKB"),
    "a tail of mrcal": ("mrcal/left.cameramodel", "0.01, 0, 0, 0,", "0.01, 0.5, 0.3, 0.2,", "five coefficients miss"),
    "other poses of mrcal": ("mrcal/left.cameramodel", "'extrinsics'", "'extrinsic'", "take it again from there"),
    "another quaternion": ("basalt/calibration.json", '"qw"', '"w"', "take it again from there"),
    "Kalibr's omni": ("kalibr_results/results-cam.txt", "DistortedPinhole", "Omni", "the model omni"),
    "no pose of Kalibr": ("kalibr_results/results-cam.txt", "baseline T_1_0", "T_0_1", "no R T"),
    "ost without a size": ("ost_ini/ost.txt", "width\n640", "width\n", "--image-size"),
}


@pytest.mark.parametrize("kind", NEW)
def test_broken_files_of_other_programs_name_what_is_wrong(tmp_path, kind):
    name, old, new, word = NEW[kind]
    text = (FOREIGN / name).read_text()
    assert old in text
    path = tmp_path / name.split("/")[1]
    path.write_text(text.replace(old, new) if "mrcal" not in name else text.replace(old, new, 1))
    files = [path, FOREIGN / "mrcal" / "right.cameramodel"] if "mrcal" in name else [path]
    size = SMALL if "kalibr" in name else None
    with pytest.raises(InputError, match=word):
        foreign_pair(read_files(files), size, 1000.0, {})
