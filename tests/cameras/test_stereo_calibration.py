"""The bundle adjustment: true covariances, OpenCV's own pairs, its laws, outliers, plausibility."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy import stats
from support.drawn_boards import PAIR, POSES, pictures, write_pair

from experiments.cameras.stereo_coverage import calibrate, chi2
from experiments.common.board_views import CORNER_SD_PX, corners_of, scenes, true_corners
from tvsbayes.cameras.board_errors import correlation_factor
from tvsbayes.cameras.boards import Board, View, Views, corner_orders, find_views
from tvsbayes.cameras.bundle_adjustment import (
    RESTARTS_MAX,
    End,
    _ends,
    bundle_adjustment,
    projected,
    reduced_residuals,
)
from tvsbayes.cameras.stereo_calibration import StereoCalibration, calibrate_stereo
from tvsbayes.cameras.stereo_start import camera_start
from tvsbayes.cli.main import run
from tvsbayes.errors import NothingToEstimate
from tvsbayes.files.disk import read_bytes, shipped_data
from tvsbayes.instrument.parameters import STEREO_PARAMETER_NAMES
from tvsbayes.instrument.stereo_pair import parse_stereo, read_stereo, stereo_bytes

MOUNTED = shipped_data() / "rigs" / "mounted"
OPENCV_PAIRS = Path("/usr/share/doc/opencv-doc/examples/data")
BOARD = Board(9, 6, 25.0)
SIZE = (1280, 720)
PAIRS_SIZE = (640, 480)
VIEWS = 14
"""Fits the same padding as OpenCV's 13 pairs: one compilation serves this file."""


@pytest.fixture(scope="module")
def drawn():
    """Scenes of one rig."""
    return scenes(3, "white", VIEWS)


@pytest.fixture(scope="module")
def views(drawn) -> list[View]:
    rng = np.random.default_rng(3)
    return [corners_of(scene, f"{k:02d}", rng) for k, scene in enumerate(drawn)]


@pytest.fixture(scope="module")
def calibration(views) -> StereoCalibration:
    return calibrate_stereo(views, BOARD, SIZE)


@pytest.fixture(scope="module")
def without_the_sixth(views) -> StereoCalibration:
    return calibrate_stereo([*views[:5], *views[6:]], BOARD, SIZE)


@pytest.fixture(scope="module")
def pairs() -> Views:
    if not (OPENCV_PAIRS / "left01.jpg").is_file():
        pytest.skip("Debian's package opencv-doc (OpenCV's own stereo pairs) is not installed")
    return find_views(OPENCV_PAIRS, BOARD)


@pytest.fixture(scope="module")
def pairs_calibration(pairs) -> StereoCalibration:
    return calibrate_stereo(pairs.views, BOARD, PAIRS_SIZE, pictures=pairs)


def sds(covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.diag(covariance))


def test_thinned_study_confirms_the_covariance():
    """Four rigs, 96 degrees of freedom, bounds at 1e-4 from their number; sds 0.7 times as large would fail."""
    rows = [calibrate(("white", seed), VIEWS) for seed in range(4)]
    total = sum(row["chi2"] for row in rows)
    low, high = stats.chi2(24 * len(rows)).ppf([5e-5, 1 - 5e-5])
    assert low < total < high
    assert total / 0.7**2 > high
    noise = np.mean([row["noise_sd_px"] for row in rows])
    dof = len(rows) * (4 * 54 * VIEWS - 24 - 6 * VIEWS)
    assert abs(noise / CORNER_SD_PX - 1) < 4 / np.sqrt(2 * dof)


@pytest.mark.thorough
@pytest.mark.parametrize("off_mm", (0.0, 0.2))
def test_a_board_that_is_no_grid_is_in_the_covariance(off_mm):
    """Corners displaced alike in all pictures: the residuals give the size, and parameters err by the stated sds."""
    total, alone = 0.0, 0.0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        drawn = scenes(seed, "white", VIEWS)
        away = rng.normal(0, off_mm, (BOARD.corners, 3))
        views = []
        for k, scene in enumerate(drawn):
            view = corners_of(scene, f"{k:02d}", rng)
            slopes = projected(BOARD.points_mm, scene.pose[None], scene.stereo).by_corner[0]
            moved = np.einsum("qca,ca->cq", slopes, away)
            views.append(replace(view, left=view.left + moved[:, :2], right=view.right + moved[:, 2:]))
        result = calibrate_stereo(views, BOARD, SIZE)
        # 155 displacements determine their sd to 6 %; three of them, and the noise of the corners.
        assert abs(result.board_error_mm - off_mm) < 0.02 + 3 * 0.06 * off_mm
        missed = result.stereo.vector - drawn[0].stereo.vector
        total += chi2(missed, result.stereo.parameter_covariance)
        alone += chi2(missed, result.covariance_independent)
    low, high = stats.chi2(24 * 3).ppf([5e-5, 1 - 5e-5])
    assert low / 1.3**2 < total < high
    assert (alone > high) == (off_mm > 0)


@pytest.mark.thorough
def test_errors_that_corners_share_are_in_the_covariance():
    """Half of the variance shared over 2.5 squares: independent corners would claim a third of the true sds."""
    rows = [calibrate(("shared", seed), VIEWS) for seed in range(2)]
    low, high = stats.chi2(24 * len(rows)).ppf([5e-5, 1 - 5e-5])
    # The factor is itself an estimate from 14 views: its square root scatters by about 15 %.
    assert low / 1.3**2 < sum(row["chi2"] for row in rows) < high * 1.3**2
    assert sum(row["chi2_independent"] for row in rows) > 2 * high


def test_pitch_is_a_separable_type_b_term():
    """T errs by the pitch's error, which the stated uncertainty covers."""
    row = calibrate(("pitch", 0), VIEWS)
    low, high = stats.chi2(24).ppf([5e-5, 1 - 5e-5])
    assert low < row["chi2"] < high


def test_opencv_pairs(pairs, pairs_calibration):
    """13 of 13 pairs, stereo RMS at most 0.22 px; |T| and the square."""
    c = pairs_calibration
    assert [view.name for view in c.views] == [f"{k:02d}" for k in (*range(1, 10), *range(11, 15))]
    assert c.pairs == 13
    assert c.stereo.rms_px <= 0.22
    assert 82.5 < np.linalg.norm(c.stereo.T) < 84.0
    assert abs(c.triangulated_pitch_mm[0] - 25.0) < 0.1
    assert c.outliers == () == c.excluded == pairs.without_board == pairs.by_fallback
    # The folder also holds pictures of other sizes and subjects whose names say a camera.
    assert pairs.other_size == ("aloeL.jpg", "aloeR.jpg", "imageTextR.png", "left.jpg", "right.jpg")
    assert sum("poor coverage" in warning for warning in c.warnings) == 2


@pytest.mark.parametrize("side", ("left", "right"))
def test_single_camera_agrees_with_opencv(pairs, side):
    """Standard deviations within 5 % of cv2.calibrateCameraExtended, from the same corners with the same model.

    The adjustment of a pair of which the left camera alone has views and free parameters.
    """
    corners = [getattr(view, side) for view in pairs.views]
    start = camera_start(dict(enumerate(corners)), BOARD, PAIRS_SIZE, side, False)
    alone = [View(str(k), pixels, None) for k, pixels in enumerate(corners)]
    vector, poses = np.concatenate([start.vector, start.vector, np.zeros(6)]), list(start.poses.values())
    ours = bundle_adjustment(alone, BOARD, vector, np.array(poses), np.arange(24) < 9)
    estimate, ours_sds = ours.vector[:9], sds(ours.covariance[:9, :9])
    # OpenCV's rms is over corners, of which each has two coordinates.
    rms_px = np.sqrt(np.nansum(ours.residuals_px**2) / (len(corners) * BOARD.corners))
    points = [BOARD.points_mm.astype(np.float32)] * len(corners)
    rms, matrix, distortion, _, _, deviations, *_ = cv2.calibrateCameraExtended(
        points, [c.astype(np.float32) for c in corners], PAIRS_SIZE, None, None
    )
    theirs = np.array([*matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *np.ravel(distortion)])
    # OpenCV before 5.0 may divide by the number of corners less the parameters instead of twice that number.
    n, p = 54 * len(corners), 9 + 6 * len(corners)
    ratio = ours_sds / np.ravel(deviations)[:9]
    # Without the degrees of freedom the sds would be 3 % too small.
    assert (np.abs(ratio - 1) < 0.01).all() or (np.abs(ratio / np.sqrt((n - p) / (2 * n - p)) - 1) < 0.01).all()
    assert (np.abs(estimate - theirs) < 0.01 * ours_sds).all()
    assert abs(rms_px - rms) < 1e-4


@pytest.mark.slow
def test_halves_of_the_real_pairs_agree_within_their_sds(pairs):
    """Without truth: two independent halves differ within both sds; independent corners would understate them."""
    rng = np.random.default_rng(0)
    stored, independent = [], []
    for _ in range(2):
        order = rng.permutation(13)
        one, two = (
            calibrate_stereo([pairs.views[k] for k in order[part]], BOARD, PAIRS_SIZE)
            for part in (slice(0, 6), slice(6, None))
        )
        difference = one.stereo.vector - two.stereo.vector
        for results, covariance in (
            (stored, one.stereo.parameter_covariance + two.stereo.parameter_covariance),
            (independent, one.covariance_independent + two.covariance_independent),
        ):
            scale = sds(covariance)
            results.append(
                difference / scale @ np.linalg.solve(covariance / np.outer(scale, scale), difference / scale)
            )
    low, high = stats.chi2(24 * 2).ppf([5e-5, 1 - 5e-5])
    assert low / 1.3**2 < sum(stored) < high * 1.3**2
    assert sum(independent) > 2 * high


@pytest.fixture(scope="module")
def exact(drawn) -> StereoCalibration:
    """From corners without errors."""
    corners = [true_corners(scene) for scene in drawn]
    return calibrate_stereo([View(str(k), c[:, :2], c[:, 2:]) for k, c in enumerate(corners)], BOARD, SIZE)


def test_covariance_is_the_schur_complement_of_the_whole_adjustment(drawn, exact):
    """Against differences through the twin's optics, which share no code, with board poses as explicit unknowns."""
    information = np.zeros((24, 24))

    def slopes(function, at):
        steps = np.diag(1e-6 * np.maximum(np.abs(at), 1.0))
        return np.stack([(function(at + s) - function(at - s)) / (2 * s.sum()) for s in steps], axis=1)

    for scene in drawn:
        true = scene.stereo
        by_stereo = slopes(
            lambda v, s=scene: true_corners(replace(s, stereo=s.stereo.with_vector(v))).ravel(), true.vector
        )
        by_pose = slopes(lambda p, s=scene: true_corners(replace(s, pose=p)).ravel(), scene.pose)
        coupling = by_stereo.T @ by_pose
        information += by_stereo.T @ by_stereo - coupling @ np.linalg.solve(by_pose.T @ by_pose, coupling.T)
    scale = sds(exact.covariance_independent)
    product = information * np.outer(scale, scale) / exact.noise_sd_px**2
    product = product @ (exact.covariance_independent / np.outer(scale, scale))
    # Central differences are good to 1e-8 of a slope; correlations near 1 amplify them a thousandfold.
    np.testing.assert_allclose(product, np.eye(24), atol=1e-4)


def test_cameras_for_which_a_board_has_no_pose_have_no_residuals():
    """The descent then takes a shorter step; at a distance of 1e200 mm the pose's normal matrix is exactly 0."""
    points_mm = Board(4, 3, 10.0).points_mm
    residuals, by_cameras = reduced_residuals(
        PAIR.vector, points_mm, np.zeros((1, 4, len(points_mm))), np.array([[0, 0, 0, 0, 0, 1e200]])
    )
    assert np.isnan(residuals).all() and np.isnan(by_cameras).all()


def test_degrees_of_freedom_are_coordinates_less_unknowns(views, calibration):
    """Four coordinates a corner and pair, less 24 parameters (k3 among them) and six per pose."""
    coordinates = 4 * BOARD.corners * len(views)
    assert calibration.dof == coordinates - 24 - 6 * len(views)
    squares = calibration.left_rms_px**2 + calibration.right_rms_px**2
    # OpenCV's rms is over corners, of which each has two coordinates.
    assert calibration.noise_sd_px**2 * calibration.dof == pytest.approx(0.25 * coordinates * squares, rel=1e-9)


def test_lengths_follow_the_pitch_and_nothing_else_does(views, calibration):
    doubled = calibrate_stereo(views, Board(9, 6, 50.0, 0.1), SIZE)
    np.testing.assert_allclose(doubled.stereo.T, 2 * calibration.stereo.T, rtol=1e-7)
    np.testing.assert_allclose(doubled.stereo.vector[:21], calibration.stereo.vector[:21], rtol=1e-6, atol=1e-9)
    expected = np.zeros((24, 24))
    expected[21:, 21:] = (0.1 / 50) ** 2 * np.outer(doubled.stereo.T, doubled.stereo.T)
    np.testing.assert_allclose(doubled.covariance_pitch, expected, rtol=1e-12)
    stored = doubled.correlation_factor * doubled.covariance_independent + doubled.covariance_board + expected
    np.testing.assert_allclose(doubled.stereo.parameter_covariance, stored, rtol=1e-9, atol=1e-30)


def test_exact_corners_give_the_true_parameters(drawn, exact):
    # Rounding of 1e3 px and condition numbers of 1e3 leave ten digits of the largest entries.
    np.testing.assert_allclose(exact.stereo.vector, drawn[0].stereo.vector, rtol=1e-6, atol=1e-7)
    assert exact.stereo.rms_px < 1e-8


def test_pictures_of_two_moments_are_left_out_by_name(views, calibration, without_the_sixth):
    wrong = [*views[:5], replace(views[5], right=views[6].right), *views[6:]]
    result = calibrate_stereo(wrong, BOARD, SIZE)
    assert result.outliers == result.excluded == ("05",)
    assert any("05" in warning for warning in result.warnings)
    np.testing.assert_allclose(result.stereo.vector, without_the_sixth.stereo.vector, rtol=1e-6, atol=1e-9)
    assert calibration.outliers == ()


def test_pictures_all_of_two_moments_are_refused(views):
    """Left k with right k + 1, of all views or of more than half: no covariance would be true."""
    shifted = [replace(view, right=after.right) for view, after in zip(views, [*views[1:], views[0]], strict=True)]
    with pytest.raises(NothingToEstimate, match="most of the 14 pairs miss") as caught:
        calibrate_stereo(shifted, BOARD, SIZE)
    assert caught.value.code == "pairs-disagree" and "taken together" in caught.value.remedy
    with pytest.raises(NothingToEstimate, match="only 08, 09, 10, 11, 12, 13 agree"):
        calibrate_stereo([*shifted[:8], *views[8:]], BOARD, SIZE)


@pytest.mark.parametrize("moved_px, doubt", ((0.0, "none"), (0.5, "warned"), (3.0, "refused")))
def test_a_board_that_moved_between_the_two_pictures(views, moved_px, doubt):
    """Each camera alone does not show it; the pair does."""
    rng = np.random.default_rng(4)
    moved = [replace(view, right=view.right + rng.normal(0, moved_px, 2)) for view in views]
    if doubt == "refused":
        with pytest.raises(NothingToEstimate, match="together they miss by"):
            calibrate_stereo(moved, BOARD, SIZE)
        return
    result = calibrate_stereo(moved, BOARD, SIZE)
    assert any("each camera by itself" in warning for warning in result.warnings) == (doubt == "warned")
    assert result.alone_rms_px < 1.1 * np.sqrt(2) * CORNER_SD_PX


@pytest.mark.parametrize("which", (slice(5, 6), slice(0, None), slice(0, None, 2)))
def test_corners_in_another_order_are_reordered_and_named(views, calibration, which):
    """One view, every view (a camera upside down), every second one: of two half turns the fewer, or the named."""
    turn = corner_orders(BOARD)[1]
    names = {view.name for view in views[which]}
    turned = [replace(view, right=view.right[turn]) if view.name in names else view for view in views]
    result = calibrate_stereo(turned, BOARD, SIZE)
    assert result.excluded == () and set(result.reordered) == names and result.as_json()["reordered"]
    np.testing.assert_allclose(result.stereo.vector, calibration.stereo.vector, rtol=1e-6, atol=1e-7)


def test_doubtful_view_is_named_and_left_out_on_request(views, without_the_sixth):
    """One picture with corners off by 1 px: named and kept; left out with `robust`."""
    rng = np.random.default_rng(9)
    doubtful = replace(views[5], left=views[5].left + rng.normal(0, 1.0, (54, 2)))
    wrong = [*views[:5], doubtful, *views[6:]]
    named = calibrate_stereo(wrong, BOARD, SIZE)
    assert named.outliers == ("05",) and named.excluded == () and len(named.views) == VIEWS
    robust = calibrate_stereo(wrong, BOARD, SIZE, robust=True)
    assert robust.outliers == robust.excluded == ("05",)
    np.testing.assert_allclose(robust.stereo.vector, without_the_sixth.stereo.vector, rtol=1e-6, atol=1e-9)


@pytest.mark.thorough
def test_views_of_one_camera_are_used_for_that_camera(views, calibration):
    half = [view if k % 2 else replace(view, right=None) for k, view in enumerate(views)]
    result = calibrate_stereo(half, BOARD, SIZE)
    only = calibrate_stereo([view for view in half if view.right is not None], BOARD, SIZE)
    assert result.pairs == VIEWS // 2 and len(result.views) == VIEWS
    ratio = sds(result.covariance_independent / result.noise_sd_px**2) / sds(
        only.covariance_independent / only.noise_sd_px**2
    )
    assert ratio[0] < 0.9 and (ratio < 1 + 1e-6).all()
    right_only = [view if k % 2 else replace(view, left=None) for k, view in enumerate(views)]
    mirrored = calibrate_stereo(right_only, BOARD, SIZE)
    z = (mirrored.stereo.vector - calibration.stereo.vector) / sds(mirrored.stereo.parameter_covariance)
    assert np.abs(z).max() < 4


def test_fixed_k3_has_no_variance(drawn, views):
    result = calibrate_stereo(views, BOARD, SIZE, fix_k3=True)
    fixed = [STEREO_PARAMETER_NAMES.index(f"stereo.{side}.k3") for side in ("left", "right")]
    assert not result.stereo.vector[fixed].any()
    assert not result.stereo.parameter_covariance[fixed].any()
    assert (sds(result.stereo.parameter_covariance)[:8] > 0).all()
    parse_stereo(stereo_bytes(result.stereo), "stereo.json")


def test_too_few_views_are_refused_in_words(views):
    with pytest.raises(NothingToEstimate, match="2 pictures of the left camera"):
        calibrate_stereo(views[:2], BOARD, SIZE)
    apart = [replace(v, **{("left", "right")[k % 2]: None}) for k, v in enumerate(views)]
    with pytest.raises(NothingToEstimate, match="no view shows the board to both"):
        calibrate_stereo(apart, BOARD, SIZE)


def test_plausibility_names_what_is_missing(drawn):
    """Four boards, all but parallel, in the middle of the image."""
    flat = []
    rng = np.random.default_rng(5)
    for k, depth in enumerate((500.0, 520.0, 540.0, 560.0)):
        pose = np.array([0.04 * k, 0.05 * (-1) ** k, 0.0, 42.5, 0.0, depth])
        flat.append(corners_of(replace(drawn[0], pose=pose), str(k), rng))
    words = " ".join(calibrate_stereo(flat, BOARD, SIZE).warnings)
    for expected in ("few views: 4 pairs", "nearly parallel", "poor coverage", "--pitch-u-mm"):
        assert expected in words


def test_swapped_cameras_are_suspected(views):
    swapped = [View(view.name, view.right, view.left) for view in views]
    assert any("swapped" in warning for warning in calibrate_stereo(swapped, BOARD, SIZE).warnings)


def test_document_holds_every_parameter_and_view(calibration):
    document = calibration.as_json()
    assert list(document["parameters"]) == list(STEREO_PARAMETER_NAMES)
    total = sds(calibration.stereo.parameter_covariance)
    assert [p["sd"] for p in document["parameters"].values()] == total.tolist()
    assert len(document["views"]) == document["pairs"] == VIEWS
    assert document["noise"]["dof"] == 4 * 54 * VIEWS - 24 - 6 * VIEWS
    assert 0.3 < document["coverage"]["left"] <= 1


@pytest.mark.parametrize("shared", (0.0, 0.5))
def test_correlation_factor_is_the_design_effect(shared):
    """A common mean, 200 views of 20 residuals: the variance of the mean is 1 + 19 rho times the independent one."""
    rng = np.random.default_rng(8)
    count, each = 200, 20
    noise = np.sqrt(shared) * np.repeat(rng.standard_normal(count), each)
    noise += np.sqrt(1 - shared) * rng.standard_normal(count * each)
    residuals = noise - noise.mean()
    basis = np.full((count, each, 1), (count * each) ** -0.5)
    factor = correlation_factor(basis, residuals.reshape(count, each), float(residuals.std()))
    # A sum of 200 squares scatters by sqrt(2 / 200) = 10 %.
    assert abs(factor / (1 + (each - 1) * shared) - 1) < 0.4


@pytest.fixture
def ask(capsys):
    """Run `stereo` with --json."""

    def run_json(*arguments: object) -> tuple[int, dict]:
        code = run(["stereo", *map(str, arguments), "--json"])
        return code, json.loads(capsys.readouterr().out)

    return run_json


def test_command_writes_its_files(ask, tmp_path):
    """Six perfect pictures of a known pair: baseline within its interval, files readable, exit 0."""
    for k, pose in enumerate(POSES):
        write_pair(tmp_path, str(k), pictures(pose))
    out = tmp_path / "stereo.json"
    code, document = ask(tmp_path, "--board", "7x6", "--pitch-mm", "25", "-o", out, "--export", "ros", "--fix-k3")
    assert code == 0 and document["pairs"] == 6 and document["source"] == "pictures"
    assert set(document["files"]) == {"stereo", "left.yaml", "right.yaml"}
    assert all(Path(path).is_file() for path in document["files"].values())
    assert any("few views" in warning for warning in document["warnings"])
    stereo = read_stereo(out)
    baseline = document["baseline_mm"]
    assert abs(baseline["value"] - np.linalg.norm(PAIR.T)) < 4 * baseline["sd"]
    assert document["parameters"]["stereo.left.fx"]["value"] == stereo.M1[0, 0]
    code, again = ask("--import", out, "--export", "opencv", "-o", tmp_path / "copy.json")
    assert code == 0 and again["source"] == "tvsbayes" and not again["assumed"]
    assert read_bytes(tmp_path / "copy.json", 1 << 20) == read_bytes(out, 1 << 20)
    code, third = ask(
        *("--import", tmp_path / "intrinsics.yml", "--import", tmp_path / "extrinsics.yml"),
        *("-o", tmp_path / "third.json"),
    )
    assert code == 0 and third["assumed"] and read_stereo(tmp_path / "third.json").assumed


@pytest.mark.parametrize(
    "arguments, code, word",
    (
        ([], 2, "usage"),
        (["FOLDER", "--board", "7x6", "--pitch-mm", "nan"], 2, "number"),
        (["FOLDER", "--board", "7x6", "--pitch-mm", "25", "--export", "kalibr"], 2, "usage"),
        (["FOLDER", "--board", "7x6", "--pitch-mm", "25", "--import", "x.yml"], 2, "usage"),
        (["FOLDER", "--board", "7x6", "--pitch-mm", "25"], 3, "few-views"),
        (["NOWHERE", "--board", "7x6", "--pitch-mm", "25"], 2, "unreadable"),
        (["--import", "NOWHERE"], 2, "missing-file"),
    ),
)
def test_command_refuses_with_the_right_code(ask, tmp_path, arguments, code, word):
    folder = tmp_path / "one"
    folder.mkdir()
    write_pair(folder, "1", pictures(POSES[0]))
    places = {"FOLDER": folder, "NOWHERE": tmp_path / "nowhere"}
    exit_code, document = ask(*(places.get(argument, argument) for argument in arguments))
    assert (exit_code, document["error"]["code"]) == (code, word)
    assert document["error"]["remedy"]


@pytest.mark.parametrize(
    "options, missing",
    (
        (("--board", "7x6"), "--pitch-mm"),
        (("--pitch-mm", "25"), "--board"),
        ((), "--board and --pitch-mm"),
    ),
)
def test_command_names_the_missing_option(ask, tmp_path, options, missing):
    code, document = ask(tmp_path, *options)
    assert code == 2 and document["error"]["message"] == f"stereo FOLDER needs {missing}"
    assert f"give {missing}:" in document["error"]["remedy"]


@pytest.mark.parametrize("there", ("stereo.json", "intrinsics.yml"))
def test_command_does_not_replace_files(ask, tmp_path, there):
    """It is refused before the work: the folder has no pictures, which would be refused later."""
    (tmp_path / there).write_text("kept")
    pictures_or_file = (tmp_path, "--board", "7x6", "--pitch-mm", "25"), ("--import", MOUNTED / "stereo.json")
    for source in pictures_or_file:
        code, document = ask(*source, "-o", tmp_path / "stereo.json", "--export", "opencv")
        error = document["error"]
        assert (code, error["code"]) == (2, "occupied") and there in error["file"] and error["remedy"]
    assert [path.name for path in tmp_path.iterdir()] == [there] and (tmp_path / there).read_text() == "kept"


@pytest.mark.parametrize("falls", [0, 1, RESTARTS_MAX, RESTARTS_MAX + 1])
def test_the_accepted_end_was_repeated(monkeypatch, falls):
    """Every descent ends lower than the one before: the last end is compared with another one."""
    ends = [End(np.full(24, float(k)), np.full(8, 0.5 ** min(k, falls)), np.zeros((8, 24))) for k in range(9)]
    following = iter(ends[1:])
    monkeypatch.setattr("tvsbayes.cameras.bundle_adjustment._descended", lambda at, z: next(following))
    end, again = _ends(ends[0], lambda z: ends[0], dof=4)
    reached = min(falls, RESTARTS_MAX)
    assert (end.z[0], again.z[0]) == (reached, reached + 1)
