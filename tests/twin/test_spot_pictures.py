"""The virtual cameras: true centres, area sampling, order of the sensor's steps, determinism, files."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from tvsbayes.cli.main import run
from tvsbayes.errors import InputError
from tvsbayes.files.disk import shipped_data
from tvsbayes.files.images import read_image
from tvsbayes.instrument.campaign import read_campaign
from tvsbayes.instrument.plan import read_plan
from tvsbayes.instrument.stereo_pair import rotation_matrix
from tvsbayes.twin.board_pictures import Board, BoardPose, board_irradiance, board_poses, render_board
from tvsbayes.twin.physics import Camera, cameras_of, project
from tvsbayes.twin.simulated_campaign import simulate
from tvsbayes.twin.spot_pictures import (
    Footprint,
    Scene,
    Sensor,
    expose,
    footprint,
    render_spot,
    speckle,
    spot_irradiance,
)
from tvsbayes.twin.true_rig import read_truth

WIDTH, HEIGHT = 1280, 720
MOUNTED = shipped_data() / "rigs" / "mounted"


def centroid(window, light):
    rows, columns = window
    u, v = np.arange(columns.start, columns.stop), np.arange(rows.start, rows.stop)
    return np.array([light.sum(axis=0) @ u, light.sum(axis=1) @ v]) / light.sum()


@pytest.fixture(scope="module")
def paper_plan():
    return read_plan(MOUNTED / "paper.csv")


@pytest.fixture(scope="module")
def twin(mounted_rig, paper_plan):
    return simulate(mounted_rig, paper_plan, 1)


def test_true_centre_is_the_projection_of_the_beam_on_the_sheet(twin):
    """The noiseless intensity centroid lies within 0.005 px of what the optics of the twin project."""
    scale = twin.truth.parameters["focal_scale"]
    cameras = cameras_of(twin.truth.stereo, scale)
    projected = project(twin.light.points_mm, twin.truth.stereo, scale)
    for row in range(0, 384, 16):
        at = twin.light.points_mm[row], twin.light.directions[row], twin.light.normals[row]
        for camera, true in ((cameras.left, projected[row, :2]), (cameras.right, projected[row, 2:])):
            spot = footprint(camera, *at, Scene(), 0.7)
            np.testing.assert_allclose(spot.centre_px, true, atol=1e-9)
            assert np.abs(centroid(*spot_irradiance(spot, WIDTH, HEIGHT)) - true).max() < 0.005


def test_footprint_is_the_push_forward_of_the_beam(twin):
    """Points drawn from the beam, traced to the sheet and projected, have the footprint's covariance."""
    cameras = cameras_of(twin.truth.stereo)
    point, beam = twin.light.points_mm[2], twin.light.directions[2]
    normal = np.array([1.0, 0.5, -0.3])
    spot = footprint(cameras.right, point, beam, normal, Scene(beam_sd_mm=0.05), 0.0)
    rng = np.random.default_rng(4)
    draws = 20_000
    starts = point - 50 * beam + 0.05 * rng.standard_normal((draws, 3))
    hits = starts + ((point - starts) @ normal / (beam @ normal))[:, None] * beam
    pixels = cameras.right.project(np.column_stack((-hits[:, 1], -hits[:, 2], hits[:, 0])))
    # Sampling error of a variance is sqrt(2 / n) of it: 1 %; five of them.
    scale = np.sqrt(np.outer(np.diag(spot.covariance_px2), np.diag(spot.covariance_px2)))
    assert np.abs((np.cov(pixels.T) - spot.covariance_px2) / scale).max() < 0.05
    assert spot.peak_dn == pytest.approx(Scene().peak_dn * abs(beam @ normal) / np.linalg.norm(normal))


def test_a_beam_off_the_sheet_or_behind_the_camera_has_no_footprint(twin):
    camera = cameras_of(twin.truth.stereo).left
    forward = np.array([1.0, 0.0, 0.0])
    assert footprint(camera, np.full(3, np.nan), forward, forward, Scene(), 0.5) is None
    assert footprint(camera, np.array([-200.0, 0, 0]), forward, forward, Scene(), 0.5) is None


def test_speckle_has_its_contrast_with_and_without_grain():
    for grain in (0.0, 1.5):
        field = speckle((600, 600), 0.4, grain, np.random.default_rng(2))
        # Independent values: 360 000 / (4 pi grain^2); five standard errors of mean and sd.
        independent = field.size / max(1.0, 4 * np.pi * grain**2)
        assert abs(field.mean() - 1) < 5 * 0.4 / np.sqrt(independent)
        assert abs(field.std() / 0.4 - 1) < 5 * 1.2 / np.sqrt(2 * independent)
        neighbours = np.corrcoef(field[:, 1:].ravel(), field[:, :-1].ravel())[0, 1]
        assert neighbours == pytest.approx(np.exp(-1 / (4 * grain**2)) if grain else 0.0, abs=0.02)


def test_sensor_noise_mosaic_and_clipping():
    """Raw values have the stated variance, colours the stated responses, nothing leaves 0 to 255."""
    sensor = Sensor(response=(0.5, 0.8, 1.0))
    flat = np.full((400, 400), 150.0)
    picture = expose(flat, sensor, None)[50:-50, 50:-50].reshape(-1, 3)
    assert np.abs(picture - (4 + 150 * np.array([0.5, 0.8, 1.0]))).max() <= 0.5
    noisy = expose(flat, Sensor(response=(1.0, 1.0, 1.0)), np.random.default_rng(1))
    red_sites = noisy[50:-50:2, 50:-50:2, 2].astype(float)  # demosaicing keeps what was measured
    variance = 0.04 * 150 + 0.8**2 + 1 / 12
    assert abs(red_sites.var() / variance - 1) < 5 * np.sqrt(2 / red_sites.size)
    assert abs(red_sites.mean() - 154) < 5 * np.sqrt(variance / red_sites.size)
    assert (expose(np.full((20, 20), 1e4), Sensor(), np.random.default_rng(1)) == 255).all()


def test_the_board_is_area_sampled():
    """Direct rendering equals the mean of sixteen-fold finer pixels."""
    matrix = np.array([[100.0, 0, 79.5], [0, 100.0, 44.5], [0, 0, 1.0]])
    distortion = np.array([-0.3, 0.1, 3e-4, -5e-4, -0.01])
    coarse = Camera(matrix, distortion, np.eye(3), np.zeros(3), 160, 90)
    fine_matrix = 4 * matrix
    fine_matrix[:2, 2] = 4 * (matrix[:2, 2] + 0.5) - 0.5
    fine_matrix[2, 2] = 1.0
    fine = Camera(fine_matrix, distortion, np.eye(3), np.zeros(3), 640, 360)
    pose = BoardPose(rotation_matrix(np.array([0.4, -0.3, 0.2])), np.array([-110.0, -60.0, 300.0]))
    direct = board_irradiance(coarse, pose, Board())
    averaged = cv2.resize(board_irradiance(fine, pose, Board()), (160, 90), interpolation=cv2.INTER_AREA)
    # Steps of 165 DN; 8 x 8 samples place an edge across a pixel to 1/16 of it, and 4 x 8 finer ones as well.
    assert np.abs(direct - averaged).max() < 165 / 16 + 165 / 64
    assert np.sqrt(np.mean((direct - averaged) ** 2)) < 1.0


def test_opencv_finds_the_corners_where_the_optics_put_them(mounted_rig):
    cameras, board = cameras_of(mounted_rig.stereo), Board()
    pose = board_poses(cameras, board, 2, 5)[1]
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-5)
    for number, camera in enumerate((cameras.left, cameras.right)):
        grey = cv2.cvtColor(render_board(camera, pose, board, Sensor(), (5, 1, number)), cv2.COLOR_BGR2GRAY)
        complete, corners = cv2.findChessboardCorners(grey, (board.columns, board.rows))
        assert complete
        true = camera.project(board.corners_mm() @ pose.rotation.T + pose.translation_mm)
        corners = cv2.cornerSubPix(grey, corners.reshape(-1, 1, 2), (5, 5), (-1, -1), stop).reshape(-1, 2)
        order = np.argmin(np.linalg.norm(corners[None] - true[:, None], axis=2), axis=1)
        assert sorted(order) == list(range(54))
        error = corners[order] - true
        # cornerSubPix scatters by 0.05 px on these pictures; its mean over 54 corners is 0.01 px.
        assert np.abs(error).max() < 0.3
        assert np.abs(error.mean(axis=0)).max() < 0.04


def test_the_two_cameras_see_independent_speckle(mounted_rig):
    spot = Footprint(np.array([60.0, 50.0]), 100.0 * np.eye(2), 120.0)
    scene = Scene(speckle_contrast=0.5)
    ratio = []
    for camera in (0, 1):
        picture = render_spot(spot, 120, 100, scene, Sensor(), (1, 2, camera)).astype(float).sum(axis=2)
        plain = render_spot(spot, 120, 100, replace(scene, speckle_contrast=0.0), Sensor(), (1, 2, camera))
        ratio.append((picture / plain.astype(float).sum(axis=2))[40:60, 50:70].ravel())
    assert abs(np.corrcoef(*ratio)[0, 1]) < 5 / np.sqrt(100)  # 400 pixels, about 100 independent after demosaicing


def test_simulate_writes_frames_that_detect_reads(mounted_rig, tmp_path, capsys, monkeypatch):
    """Through the command line, at full size: names, sizes, statuses, and the true centres found again."""
    monkeypatch.setattr("tvsbayes.twin.frames.BOARD_VIEWS", 1)
    lines = (MOUNTED / "paper.csv").read_text().splitlines()[:6]
    (tmp_path / "plan.csv").write_text("\n".join(lines) + "\n")
    orders = ["simulate", str(MOUNTED / "rig.toml"), str(tmp_path / "plan.csv"), str(tmp_path / "c")]
    assert run([*orders, "--frames", "--seed", "3", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["pictures"], document["in_view"], document["ok"]) == (6, 2, 0)
    campaign = read_campaign(tmp_path / "c")
    assert {spot.status for spot in campaign.spots} == {"undetected"}
    assert all(spot.u_left_px is None and spot.su_right_px is None for spot in campaign.spots)
    names = sorted(path.name for path in (tmp_path / "c" / "frames").iterdir())
    assert names == ["000000_left.png", "000000_right.png", "000001_left.png", "000001_right.png"]
    assert sorted(path.name for path in (tmp_path / "c" / "boards").iterdir()) == ["left01.png", "right01.png"]
    assert read_image(tmp_path / "c" / "boards" / "right01.png", tmp_path / "c").shape == (HEIGHT, WIDTH, 3)
    twin = simulate(mounted_rig, read_plan(tmp_path / "plan.csv"), 3)
    assert twin.truth.parameters == read_truth(tmp_path / "c" / "truth.json", campaign.stereo).parameters
    true = project(twin.light.points_mm, twin.truth.stereo, twin.truth.parameters["focal_scale"])
    assert run(["detect", str(tmp_path / "c"), "--speckle-contrast", "0.4"]) == 0
    for spot, where in zip(read_campaign(tmp_path / "c").spots, true, strict=True):
        pixels = [spot.u_left_px, spot.v_left_px, spot.u_right_px, spot.v_right_px]
        stated = [spot.su_left_px, spot.sv_left_px, spot.su_right_px, spot.sv_right_px]
        assert np.abs((pixels - where) / stated).max() < 5
        assert 0.02 < min(stated) < max(stated) < 0.12


def test_boards_are_wholly_inside_both_images(mounted_rig):
    cameras, board = cameras_of(mounted_rig.stereo), Board()
    for pose in board_poses(cameras, board, 20, 1):
        for camera in (cameras.left, cameras.right):
            pixels = camera.project(board.corners_mm() @ pose.rotation.T + pose.translation_mm)
            assert ((pixels > 0) & (pixels < [WIDTH - 1, HEIGHT - 1])).all()
    with pytest.raises(InputError, match="fits into both images 0 of 2 times"):
        board_poses(cameras, Board(pitch_mm=100.0), 2, 1)


def test_boards_stand_further_off_for_longer_lenses(mounted_rig):
    """Up to ten times the focal length of the shipped rigs; theirs changes no pose that was drawn before."""
    board = Board()
    for longer in (2.0, 10.0):
        assert len(board_poses(cameras_of(mounted_rig.stereo, longer), board, 20, 1)) == 20
    # Where the corners of three boards stood, mm, before depths followed the lens; 1e-12: sums of other machines.
    depths = [p.translation_mm[2] for p in board_poses(cameras_of(mounted_rig.stereo), board, 3, 1)]
    assert depths == pytest.approx([345.2773895689372, 375.7078497165911, 427.5062850295981], rel=1e-12)
