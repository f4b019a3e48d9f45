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
from tvsbayes.cameras.lens_models import fitted_to_five, kind_of
from tvsbayes.errors import InputError

SMALL = (640, 480)


@pytest.mark.parametrize(
    "name, source, size",
    (
        ("depthai/calib.json", "depthai", None),
        ("realsense/enumerate.txt", "realsense", SMALL),
        ("realsense/objects.txt", "realsense", None),
        ("realsense/intrinsics.json", "realsense", None),
        ("boofcv/stereo.yaml", "boofcv", None),
        ("zed/SN1.conf", "zed", (1920, 1080)),
    ),
)
def test_the_pair_of_every_maker(name, source, size):
    """Chains of sockets in cm, R by rows or by columns in m, the pose from right to left, components in mm."""
    calibration = read_calibration([FOREIGN / name], size)
    assert calibration.source == source
    # Of a ZED the same pixels in the middle of larger pictures.
    check_pair(calibration.stereo, size=size or SMALL, shift_px=(640.0, 300.0) if source == "zed" else (0.0, 0.0))


@pytest.mark.parametrize(
    "name, sizes",
    (("zed/SN1.conf", "1920x1080, 1280x720, 672x376"), ("realsense/enumerate.txt", "640x480, 320x240")),
)
@pytest.mark.parametrize("stated", (None, (800, 600)))
def test_the_size_of_the_pictures_is_asked_for(name, sizes, stated):
    with pytest.raises(InputError, match=rf"pictures of {sizes} px.*--image-size"):
        read_calibration([FOREIGN / name], stated)


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
