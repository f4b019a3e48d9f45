"""Even and odd rows of a beam: a gain has no effect, a shift is detected and reported; good pictures are unchanged."""

from __future__ import annotations

import numpy as np
import pytest
from support.drawn_spots import small_pair
from support.written_rows import move_row, spot_row

from tvsbayes.cameras.detection import detect
from tvsbayes.cameras.spot_fit import LINES_EXCESS_MIN, Centre, find_spot, widened
from tvsbayes.cameras.spot_noise import SpotNoise
from tvsbayes.files.images import png_bytes
from tvsbayes.instrument.campaign import Campaign, read_campaign, write_campaign
from tvsbayes.report.command_text import detection_text

PLACE = np.array([150.3, 110.8])
GAIN_DN = 0.04
KNOWN = SpotNoise(GAIN_DN, 0.0)


def fields(
    sd: float, shift_px: float, odd_gain: float, seed: int, *, columns: bool = False, place: np.ndarray = PLACE
) -> np.ndarray:
    """A monochrome picture (240, 320, 3) of a beam of 150 DN; on odd lines it has moved down and to the right."""
    rng = np.random.default_rng(seed)
    v, u = np.indices((240, 320))
    odd = (u if columns else v) % 2
    x, y = u - place[0] - odd * shift_px / 2, v - place[1] - odd * shift_px
    light = 150 * np.exp(-(x * x + y * y) / 2 / sd**2) * (1 + odd * odd_gain)
    grey = 10 + light + rng.normal(0, np.sqrt(1 + GAIN_DN * light))
    return np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize("sd", [3.0, 14.0])
@pytest.mark.parametrize("columns", [False, True])
def test_a_shift_is_measured_with_its_uncertainty(sd, columns):
    """Full resolution (3 px) and blocks of three (14 px): 0.5 px along v and half of it along u."""
    spot = find_spot(fields(sd, 0.5, 0.06, 1, columns=columns), KNOWN)
    true = np.array([0.25, 0.5])
    shift = spot.lines_px[int(columns)]
    # The uncertainty of the centre without the shift is some 0.01 sd; twice that for the difference, four of it.
    noise = np.sqrt(np.diag(spot.covariance_px2 - np.outer(shift, shift) / 12))
    assert (np.abs(shift - true) < 8 * noise).all() and (noise < 0.03).all()
    sds = np.sqrt(np.diag(spot.covariance_px2))
    assert (sds >= np.abs(shift) / np.sqrt(12)).all()
    # The centre lies between both.
    assert (np.abs(spot.centre_px - PLACE - true / 2) < 5 * noise + 0.03 * true).all()


@pytest.mark.parametrize("sd", [3.0, 14.0])
def test_a_gain_of_the_odd_rows_causes_no_shift(sd):
    """6 %, as in a real camera: no finding, and chi-square of the difference is that of noise."""
    chi2 = []
    for seed in range(30):
        spot = find_spot(fields(sd, 0.0, 0.06, seed), KNOWN)
        shift = spot.lines_px[0]
        chi2.append(shift @ np.linalg.solve(4 * spot.covariance_px2, shift))
    # 60 degrees of freedom: mean 2, its standard uncertainty 0.37; four of them.
    assert 0.5 < np.mean(chi2) < 3.5


def spots_of(shifts: np.ndarray, covariance: np.ndarray) -> list[Centre]:
    return [Centre("ok", PLACE, covariance, lines_px=shift) for shift in shifts]


def test_small_common_differences_are_detected_over_all_looks():
    """One alone is insignificant; 40 of mean square 9 are significant, 40 of 2.25 are within the noise's error."""
    covariance = np.diag([0.01, 0.04])
    signs = np.random.default_rng(7).choice([-1.0, 1.0], (40, 2, 2))
    for size, expected in ((3.0, 40), (1.5, 0)):
        shifts = signs * size * 2 * np.array([0.1, 0.2])
        shifts[:, 1] = 0.0
        centres, lines = widened(spots_of(shifts, covariance))
        assert [(one.lines, one.spots) for one in lines] == ([("rows", 40)] if expected else [])
        added = np.array([one.covariance_px2 for one in centres]) - covariance
        if expected:
            np.testing.assert_allclose(added[3], np.outer(shifts[3, 0], shifts[3, 0]) / 12, rtol=1e-12, atol=1e-15)
        else:
            assert not added.any()
    assert 2.25 < LINES_EXCESS_MIN < 9
    assert widened([Centre("no-spot")]) == ([Centre("no-spot")], ())


def test_a_shift_in_one_look_widens_that_look():
    shifts = np.zeros((30, 2, 2))
    shifts[4] = [[0.0, 0.0], [2.0, 0.0]]
    centres, lines = widened(spots_of(shifts, 0.01 * np.eye(2)))
    assert [(one.lines, one.spots, one.apart_px) for one in lines] == [("columns", 1, 2.0)]
    assert [k for k, one in enumerate(centres) if (one.covariance_px2 != 0.01 * np.eye(2)).any()] == [4]


def test_detect_names_the_camera_that_reads_in_fields(tmp_path):
    """Six looks; the left camera's odd rows come later, the beam has moved by 0.4 px."""
    rng = np.random.default_rng(11)
    spots = [spot_row(k, 0, "d1", k // 4, k % 4 + 1, *[None] * 8, 50.0 + k, "undetected") for k in range(6)]
    moves = (move_row(0, 0, 0.0, 0, 0, "left", "up"),)
    write_campaign(Campaign(moves, tuple(spots), small_pair(), header={"name": "fields"}), tmp_path / "c")
    (tmp_path / "c" / "frames").mkdir()
    places = PLACE + rng.uniform(-1, 1, (6, 2))
    for look, place in enumerate(places):
        for side, shift in (("left", 0.4), ("right", 0.0)):
            frame = fields(4.0, shift, 0.02, look + 100 * (side == "right"), place=place)
            (tmp_path / "c" / "frames" / f"{look:06d}_{side}.png").write_bytes(png_bytes(frame))
    detection = detect(read_campaign(tmp_path / "c"), workers=1)
    (left,), right = detection.lines["left"], detection.lines["right"]
    assert (left.lines, left.spots, right) == ("rows", 6, ())
    # 0.4 down, 0.2 to the right.
    assert left.apart_px == pytest.approx(0.447, abs=0.05)
    text = detection_text(detection)
    assert "left camera: odd and even rows of 6 spots" in text and "right camera" not in text
    assert detection.as_json()["alternate_lines"] == {
        "left": [{"lines": "rows", "spots": 6, "apart_px": left.apart_px}],
        "right": [],
    }
