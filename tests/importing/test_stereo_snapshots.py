"""What `stereo --import` prints and writes for files of other programs, as snapshots: read a changed one as a diff."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from support.calibration_files import FOREIGN, changed, mistakes

from tvsbayes.cameras import imported_calibration
from tvsbayes.cameras.assumed_covariance import with_assumed_covariance
from tvsbayes.files.disk import shipped_data
from tvsbayes.instrument.stereo_pair import Stereo, read_stereo

KNOWN: dict[tuple, Stereo] = {}
OPENCV, STATED = "opencv_other_names/pair.yml", "--rms-px 0.25 --views 20 --board 9x6 --pitch-mm 25 --joint"
FILES = (
    *("opencv_other_names/pair.yml", "opencv_other_names/pair2.yml", "opencv_other_names/pair3.yml"),
    *("opencv_xml/pair.xml", "opencv_xml/pair.yml", "plain_json/pair.json", "distortion_folds/pair.yml"),
    *("T_in_cm/pair.yml", "T_in_cm/pair.yml --import-unit cm", "T_in_cm/pair.yml --import-unit 1"),
    *("transposed/c.json", "transposed/c.json --key R=R.T", "transposed/c.json --key R=K.T"),
    *("ros_message_dump/left.yaml ros_message_dump/right.yaml", "ros_message_dump/right.yaml"),
    *("ros_message_dump/right.yaml ros_message_dump/left.yaml", "pasted_messages/both.yaml"),
    *("euroc_sensor_pair/cam0.yaml euroc_sensor_pair/cam1.yaml", "kalibr_chain/camchain.yaml"),
    *("kalibr_imu/camchain-imucam.yaml", "vins_fusion/cam0.yaml vins_fusion/cam1.yaml vins_fusion/euroc_stereo.yaml"),
    *("orb_slam3/o.yaml", "caliscope/c.toml", "matlab_json/c.json", "poses_in_world/c.json"),
    *("bouguet/Calib_Results_stereo.mat", "fisheye_advice/fisheye.yaml", "fisheye_advice/followed.yaml"),
    *("depthai/calib.json", "depthai/calib.json --image-size 1280x800", "boofcv/stereo.yaml"),
    *("realsense/enumerate.txt", "realsense/enumerate.txt --image-size 640x480"),
    *("realsense/objects.txt", "realsense/intrinsics.json", "zed/SN1.conf", "zed/SN1.conf --image-size 1920x1080"),
    *("mrcal/left.cameramodel mrcal/right.cameramodel", "mrcal/left.cameramodel"),
    *("mrcal/left.cameramodel mrcal/splined.cameramodel", "basalt/calibration.json", "basalt/ds.json"),
    *("calibio/stereo.json", "kalibr_results/results-cam.txt", "kalibr_results/results-cam.txt --image-size 640x480"),
    *("ost_ini/ost.txt", "npy", "npy --image-size 640x480", "npy_txt --image-size 640x480", "npy/R.npy"),
    *("metashape/cameras.xml", "metashape/cameras.xml --import-unit m"),
    *("halcon/camparL.dat halcon/camparR.dat", "halcon/camparL.dat"),
    *(f"{OPENCV} {STATED}", f"{OPENCV} --u-focal-percent 0.2 --fixed-intrinsics", f"{OPENCV} --image-size 1280x720"),
    "direction_signs/log.csv",
)


@pytest.fixture(autouse=True)
def once(monkeypatch):
    """The covariance of equal pairs is computed once: most files hold the same one."""

    def assumed(stereo, *made):
        key = (*np.round(stereo.vector, 9), stereo.image_width, stereo.right_image_size, *made)
        if key not in KNOWN:
            KNOWN[key] = with_assumed_covariance(stereo, *made)
        found = KNOWN[key]
        fields = {name: getattr(found, name) for name in ("parameter_covariance", "rms_px", "assumed", "assumed_from")}
        return replace(stereo, **fields)

    monkeypatch.setattr(imported_calibration, "with_assumed_covariance", assumed)


def numbers(path) -> dict[str, object]:
    """What `stereo.json` says, to seven digits; of the covariance the standard deviations.

    Lenses fitted by least squares round in the ninth. Coefficients below 1e-7, a ten thousandth of a pixel, are 0.
    """
    stereo, lines = read_stereo(path), {}
    for name in ("M1", "D1", "M2", "D2", "R", "T"):
        lines[name] = " ".join(f"{0.0 if abs(x) < 1e-7 else x:.7g}" for x in getattr(stereo, name).ravel().tolist())
    lines["sd"] = " ".join(f"{x:.7g}" for x in np.sqrt(np.diag(stereo.parameter_covariance)).tolist())
    lines["size"] = (stereo.image_width, stereo.image_height, stereo.right_image_size)
    return lines | {"rms_px": f"{stereo.rms_px:.7g}", "assumed_from": stereo.assumed_from}


def imported(say, words, out) -> dict[str, object]:
    """What a command says beside its table, and the numbers it wrote."""
    code, text, error = say("stereo", *words, "-o", out)
    lines = f"{text}{error}".replace(str(out.parent), "").splitlines()
    says = [line for line in lines if ": " in line and not line.startswith("note: for a better")]
    seen = {"code": code, "says": says}
    return seen | (numbers(out) if out.is_file() else {})


@pytest.mark.parametrize("words", FILES)
def test_files_of_other_programs(say, tmp_path, monkeypatch, snapshot, words):
    monkeypatch.chdir(FOREIGN)
    names = [word for word in words.split() if (FOREIGN / word).exists()]
    options = words.split()[len(names) :]
    arguments = [part for name in names for part in ("--import", name)]
    assert imported(say, [*arguments, *options], tmp_path / "stereo.json") == snapshot


@pytest.mark.parametrize("kind", mistakes(read_stereo(shipped_data() / "rigs" / "mounted" / "stereo.json")))
def test_mistakes_in_a_plain_document(say, tmp_path, mounted, snapshot, kind):
    (tmp_path / "m.json").write_text(json.dumps(changed(mounted, mistakes(mounted)[kind])))
    assert imported(say, ["--import", tmp_path / "m.json"], tmp_path / "stereo.json") == snapshot
