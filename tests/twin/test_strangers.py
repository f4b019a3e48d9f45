"""Benches of strangers: their optics agree with the published vector, their truths with what they are made of."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from support.printed_vector import LAST_6, LAST_7, LAST_9, LAST_12, VECTOR

from experiments.intervals import strangers
from experiments.intervals.strange_bench import Bench, bench, true_values
from experiments.intervals.strange_optics import Gear, Head, turn
from tvsbayes.instrument.stereo_pair import parse_stereo

SEED, BENCHES = 7, 6
ROUNDING = 1e-9
"""mm, of some hundred operations on numbers up to 1e4, and deg."""
ENDS = (cv2.TERM_CRITERIA_MAX_ITER + cv2.TERM_CRITERIA_EPS, 500, 1e-12)
LINE_MM = LAST_9 * np.sqrt(3)
"""Half a unit of the last digit in each coordinate of a printed point."""


@pytest.fixture(scope="module")
def drawn() -> list[Bench]:
    return [bench(SEED, number) for number in range(BENCHES)]


@pytest.fixture
def printed() -> Head:
    """The head of the published vector."""
    v = VECTOR
    return Head(
        v["mirror_offset_mm"],
        (v["mirror1_error_deg"], v["mirror2_error_deg"]),
        (v["laser_tilt_deg.x"], v["laser_tilt_deg.y"]),
        (v["laser_offset_mm.x"], v["laser_offset_mm.y"]),
        v["tilt_axis_skew_deg"],
        (v["tilt_axis_offset_mm.x"], v["tilt_axis_offset_mm.z"]),
    )


def test_the_beam_of_the_published_vector(printed):
    on, ahead = (part[0] for part in printed.beams(np.array([10.0]), np.array([5.0])))
    # The design rounded from these digits: half a unit of the last one and no more.
    assert np.abs(ahead - [0.981182562588, 0.177188586189, 0.076713648059]).max() <= LAST_12 * 1.01
    origin = np.array([5.371658918, -29.176887333, -0.940368833])
    assert np.linalg.norm(np.cross(origin - on, ahead)) <= LINE_MM
    steps = 1e-3 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    azimuth, elevation = printed.azimuth_elevation_deg(*np.add(steps, [10.0, 5.0]).T)
    jacobian = [[a[0] - a[1], a[2] - a[3]] for a in (azimuth, elevation)]
    # Central differences of 1e-3 deg are off by 1e-11; the digits by half a unit.
    assert np.abs(np.array(jacobian) / 2e-3 - [[1.0070677, 0.0038895], [-0.0025873, 0.9977070]]).max() <= LAST_7 * 1.01
    point = origin + 250.0 * ahead
    assert np.abs(turn("z", 1.0) @ point + [0, 100, 0] - [250.365237, 119.492704, 18.238043]).max() <= LAST_6 * 1.01


def test_cameras_project_as_opencv_does(drawn):
    for one in drawn:
        for camera in (one.rig.left, one.rig.right):
            points = np.add([point for point, _ in one.rig.sheets], [20.0, -15.0, 5.0])
            matrix = np.diag([*camera.focal_px, 1.0])
            matrix[:2, 2] = camera.centre_px
            vector = cv2.Rodrigues(camera.rotation)[0]
            expected = cv2.projectPoints(points, vector, camera.shift_mm, matrix, np.array(camera.lens))[0][:, 0]
            # OpenCV goes to the rotation vector and back: 1e-13 of 1e3 px.
            np.testing.assert_allclose(camera.project(points), expected, atol=ROUNDING)


def test_noiseless_spots_triangulate_onto_their_beams(drawn):
    """By OpenCV, from the true cameras: points on the beam within its undistortion's tolerance."""
    for one in drawn:
        rig = one.rig
        stage = np.array([5.0, -3.0, 1.0]), np.array([2.0, 4.0, -1.0])
        spots = rig.spots(*stage, np.zeros(3, int))
        point, normal = rig.sheets[0]
        assert np.abs((spots - point) @ normal).max() < ROUNDING
        rays = []
        for camera in (rig.left, rig.right):
            matrix = np.diag([*camera.focal_px, 1.0])
            matrix[:2, 2] = camera.centre_px
            pixels = camera.project(spots)[:, None]
            rays.append(cv2.undistortPoints(pixels, matrix, np.array(camera.lens), criteria=ENDS))
        sides = [np.column_stack((camera.rotation, camera.shift_mm)) for camera in (rig.left, rig.right)]
        flat = cv2.triangulatePoints(*sides, *(ray[:, 0].T for ray in rays))
        points = (flat[:3] / flat[3]).T
        on, ahead = rig.head.beams(*stage)
        local = (points - rig.shift_mm) @ rig.rotation
        inside = rig.project(spots)[1]
        # 1e-10 of the focal length at a parallax of 0.1 and 1 m.
        assert np.linalg.norm(np.cross(local - on, ahead), axis=1)[inside].max(initial=0.0) < 1e-5


def perfect(ratio: float, play: float = 0.0) -> Gear:
    return Gear(ratio, lambda place: np.full_like(place, play), np.zeros_like, np.zeros_like, 0.0)


def test_slopes_of_a_perfect_rig_are_its_ratios():
    counters = np.random.default_rng(3).integers(-150, 150, (50, 2))
    values = true_values(Head(25.0), [perfect(0.06, 0.2), perfect(0.07, 0.1)], counters)
    assert values["effective_deg_per_step"] == pytest.approx({"pan": 0.06, "tilt": 0.07}, abs=1e-12)
    assert values["backlash_deg"] == pytest.approx({"pan": 0.2, "tilt": 0.1})
    assert values["mirror_offset_mm"] == pytest.approx(25.0, abs=ROUNDING)


def test_play_of_the_published_sequence():
    """B 0.3, y = -0.15 after a move to higher counters, one ratio: the wheel waits until the play is used up."""
    counters = np.cumsum([0, 200, -200, 3, -2, 100])
    first = np.arange(6) == 0
    angles = perfect(0.06, 0.3).driven(counters, first, np.zeros(6), 1, np.random.default_rng(0))
    np.testing.assert_allclose(angles, [-0.15, 11.85, 0.15, 0.15, 0.15, 5.91], atol=1e-12)


def test_commands_take_a_bench_as_its_owner_has_it(drawn, tmp_path):
    one = next(b for b in drawn if not b.traits.covariance)
    one.write(tmp_path / "bench")
    strangers.campaign_of(tmp_path / "bench", one, one.truth["approach"], tmp_path / "campaign")
    spots = (tmp_path / "campaign" / "spots.csv").read_text().splitlines()
    assert sum(",ok" in line for line in spots) == one.both.sum() == strangers.looks_seen(tmp_path / "bench/looks.csv")
    pair = parse_stereo((tmp_path / "campaign" / "stereo.json").read_bytes(), "stereo.json")
    assert pair.assumed and np.allclose(pair.T, one.calibration.matrices["T"].ravel())
