"""Public pictures of stereo pairs and laser beams without known truth: agreement with OpenCV and among parts."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest

from experiments.real.beams import beam_of
from experiments.real.stereo_pairs import SHIPPED_BASELINE_MM, opencv_joint
from tvsbayes.cameras.boards import Board, find_views
from tvsbayes.cameras.stereo_calibration import calibrate_stereo
from tvsbayes.cli.main import run
from tvsbayes.files.disk import shipped_data
from tvsbayes.files.images import read_image

REAL = shipped_data() / "real"
PAIRS, BEAMS = REAL / "stereo" / "bumblebee2", REAL / "spots"
BOARD, SIZE = Board(4, 6, 30.0), (640, 480)

if not REAL.is_dir():
    pytest.skip("data/real is in the repository only", allow_module_level=True)


@pytest.fixture(scope="module")
def views():
    return find_views(PAIRS, BOARD).views


@pytest.fixture(scope="module")
def calibration(views):
    return calibrate_stereo(views, BOARD, SIZE)


def test_pairs_are_calibrated_as_opencv_does(views, calibration):
    """The minimum of one sum of squares: equal far within a standard error, 0.09 mm."""
    theirs = opencv_joint(views, BOARD, SIZE)
    assert len(views) == calibration.pairs == 11 and calibration.excluded == calibration.reordered == ()
    assert calibration.stereo.rms_px == pytest.approx(theirs.rms_px, rel=1e-4)
    baseline = np.linalg.norm(calibration.stereo.T)
    assert abs(baseline - theirs.baseline_mm) < 0.01 * calibration.baseline_sd_mm
    # Another program's result, with two coefficients fewer: 1.8 standard uncertainties; three would be significant.
    assert abs(baseline - SHIPPED_BASELINE_MM) < 3 * calibration.baseline_sd_mm


def test_pictures_without_the_board_are_named_and_left_out(tmp_path, capsys):
    for path in PAIRS.glob("*.jpg"):
        shutil.copy(path, tmp_path)
    cv2.imwrite(str(tmp_path / "right03.jpg"), np.full((480, 640), 90, np.uint8))
    (tmp_path / "left07.jpg").unlink()
    deep = read_image(tmp_path / "left01.jpg").astype(np.uint16) * 16
    cv2.imwrite(str(tmp_path / "left01.png"), deep)
    (tmp_path / "left01.jpg").unlink()
    code = run(["stereo", str(tmp_path), "--board", "4x6", "--pitch-mm", "30", "--json"])
    document = json.loads(capsys.readouterr().out)
    assert code == 0 and document["pairs"] == 9 and document["without_board"] == ["right03.jpg"]
    assert document["unpaired"] == ["right07.jpg"] and document["rms_px"] < 0.1


@pytest.mark.parametrize("name", ("t-348mm", "t-770mm", "TEM00_140mm"))
def test_parts_of_a_beam_agree_within_their_sds(name):
    """8 and 16 bits; 30 degrees of freedom: 1 / sqrt(60) of the root, of which three are 0.4."""
    beam = beam_of(BEAMS / f"{name}.png")
    assert beam.statuses == {"ok": 16} and beam.whole.status == "ok"
    assert 0.6 < beam.rms < 1.4


@pytest.mark.parametrize("name, reason", (("FBWR_151", "clipped"), ("sb_259mm_10", "two-spots")))
def test_beams_without_a_centre_are_refused(name, reason):
    assert beam_of(BEAMS / f"{name}.png").whole.status == reason
