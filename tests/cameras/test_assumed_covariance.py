"""The assumed covariance of a calibration without one: against a bundle adjustment and OpenCV's actual errors."""

from __future__ import annotations

from dataclasses import replace
from itertools import chain

import cv2
import numpy as np
import pytest
from msgspec import structs
from support.calibration_files import written

from tvsbayes.cameras.assumed_covariance import (
    CORRELATION_FACTOR,
    GROUPS,
    USUAL_PITCH_SHARE,
    Provenance,
    calibration_covariance,
    placed_boards,
    view_information,
    with_assumed_covariance,
    with_marginal,
)
from tvsbayes.cameras.boards import Board, View
from tvsbayes.cameras.bundle_adjustment import bundle_adjustment
from tvsbayes.cameras.calibration_export import exported
from tvsbayes.cameras.imported_calibration import read_calibration
from tvsbayes.errors import InputError
from tvsbayes.instrument.stereo_pair import Stereo, rotation_matrix, rotation_vector, stereo_bytes
from tvsbayes.report.fit_text import assumed_stereo
from tvsbayes.results.metrology_tables import BudgetRow, BudgetTable

pytestmark = pytest.mark.thorough

BOARD = Board(9, 6, 25.0)
BENCHES, NOISE_PX, VIEWS = 12, 0.15, 18


def corners(stereo: Stereo, pose: np.ndarray, board: Board = BOARD) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of the corners in both cameras, by OpenCV."""
    left = board.points_mm @ rotation_matrix(pose[:3]).T + pose[3:]
    still = np.zeros(3)
    cameras = (left, stereo.M1, stereo.D1), (left @ stereo.R.T + stereo.T, stereo.M2, stereo.D2)
    one, two = (cv2.projectPoints(points, still, still, m, d)[0].reshape(-1, 2) for points, m, d in cameras)
    return one, two


def test_information_is_that_of_the_bundle_adjustment(mounted):
    """From the same views, up to the curvature of the adjustment at noise of 1e-3 px."""
    poses = placed_boards(mounted, BOARD)["opencv"]
    rng = np.random.default_rng(3)
    views = []
    for k, pose in enumerate(poses):
        left, right = (pixels + 1e-3 * rng.standard_normal(pixels.shape) for pixels in corners(mounted, pose))
        views.append(View(f"{k}", left, right))
    done = bundle_adjustment(views, BOARD, mounted.vector, np.array(poses), np.ones(24, bool))
    whole = view_information(mounted, BOARD, poses)[0].sum(axis=0)
    covariance, expected = np.linalg.inv(whole), done.covariance / done.noise_sd_px**2
    sds = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(covariance / np.outer(sds, sds), expected / np.outer(sds, sds), atol=1e-4)


def test_boards_are_completely_in_both_pictures(mounted):
    boards = placed_boards(mounted, BOARD)
    assert {name: len(poses) for name, poses in boards.items()} == {"bumblebee2": 11, "opencv": 13}
    size = np.array([mounted.image_width, mounted.image_height])
    for pose in chain(*boards.values()):
        for pixels in corners(mounted, pose):
            assert (pixels > -0.5).all() and (pixels < size - 0.5).all()


def test_covariance_scales_as_a_calibration(mounted):
    """With the RMS, with one over the root of the views (degrees of freedom aside), T with the pitch."""
    covariance = calibration_covariance(mounted, BOARD, 20, 0.2)
    np.testing.assert_allclose(calibration_covariance(mounted, BOARD, 20, 0.4), 4 * covariance, rtol=1e-12)
    coordinates = 4 * BOARD.corners
    share = [1 - (24 / views + 6) / coordinates for views in (20, 80)]
    fewer = calibration_covariance(mounted, BOARD, 80, 0.2) * 4 * share[1] / share[0]
    np.testing.assert_allclose(fewer, covariance, rtol=1e-9)
    sd = np.sqrt(np.diag(calibration_covariance(mounted, replace(BOARD, pitch_u_mm=0.25), 20, 0.2) - covariance))[21:]
    # Differences of variances have the rounding of the larger one.
    np.testing.assert_allclose(sd, 0.01 * np.abs(mounted.T), rtol=1e-6, atol=1e-6)
    joint, fixed, either = (calibration_covariance(mounted, BOARD, 20, 0.2, way) for way in (False, True, None))
    np.testing.assert_allclose(either, (joint + fixed) / 2, rtol=1e-9)
    assert (np.diag(fixed) > np.diag(joint)).all(), "each camera by itself knows less"


def drawn(seed: int) -> tuple[Stereo, list[np.ndarray]]:
    """A pair, and poses of boards by depth and tilt anywhere in both pictures: not those of the table."""
    rng = np.random.default_rng([seed, 45])
    size, focal, baseline = np.array([1280, 960]), rng.uniform(700, 1600), rng.uniform(80, 300)
    inner = []
    for _ in range(2):
        middle = size / 2 - 0.5 + 15 * rng.standard_normal(2)
        inner += [focal, focal, *middle, rng.uniform(-0.3, 0.1), 0.03, *rng.normal(0, 5e-4, 2), 0.0]
    turn = rotation_matrix(np.array([0, rng.uniform(0, 0.5) * baseline / 700, 0]))
    vector = np.array([*inner, *rotation_vector(turn), *(turn @ [-baseline, 0, 0])])
    true = Stereo.of_vector(vector, tuple(size.tolist()))
    poses: list[np.ndarray] = []
    while len(poses) < VIEWS:
        depth = focal * 8 * BOARD.pitch_mm / (size[0] * rng.uniform(0.25, 0.55))
        across = rng.uniform(-0.45, 0.45, 2) * size / focal
        shift = depth * np.append(across, 1.0) + [baseline / 2, 0, 0]
        pose = np.array([*rng.uniform(-0.5, 0.5, 2), rng.normal(0, 0.3), *shift])
        if all(((pixels > 0) & (pixels < size - 1)).all() for pixels in corners(true, pose)):
            poses.append(pose)
    return true, poses


def by_opencv(true: Stereo, poses: list[np.ndarray], seed: int, fixed: bool) -> tuple[Stereo, float]:
    """cv2.stereoCalibrate of noisy corners, all parameters free after each camera's own calibration, or only R, T."""
    rng = np.random.default_rng([seed, 46])
    views = [corners(true, pose) for pose in poses]
    sides = [
        [(view[k] + NOISE_PX * rng.standard_normal(view[k].shape)).astype(np.float32) for view in views] for k in (0, 1)
    ]
    points, size = [BOARD.points_mm.astype(np.float32)] * len(poses), (true.image_width, true.image_height)
    alone = [cv2.calibrateCamera(points, side, size, None, None)[1:3] for side in sides]
    flags = cv2.CALIB_FIX_INTRINSIC if fixed else cv2.CALIB_USE_INTRINSIC_GUESS
    ends = cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 200, 1e-9
    rms, m1, d1, m2, d2, r, t, *_ = cv2.stereoCalibrate(
        points, *sides, *alone[0], *alone[1], size, flags=flags, criteria=ends
    )
    inner = [np.r_[m[[0, 1, 0, 1], [0, 1, 2, 2]], np.ravel(d)[:5]] for m, d in ((m1, d1), (m2, d2))]
    return true.with_vector(np.concatenate([*inner, rotation_vector(r), np.ravel(t)])), float(rms)


@pytest.mark.parametrize("fixed", (False, True))
def test_opencvs_errors_are_as_large_as_assumed(fixed):
    """RMS of whitened errors by group: 0.5 to 1.5 where all is stated, 0.2 to 1.5 where nothing is.

    Of 12 benches with 3 or 4 parameters a group the RMS itself scatters by a tenth: the bounds are widened by two of
    that; a wrong sign in a slope or a wrong power of the noise is off by more than a factor of 2.
    """
    squares: dict[tuple[str, str], list[float]] = {}
    for seed in range(BENCHES):
        true, poses = drawn(seed)
        stereo, rms = by_opencv(true, poses, seed, fixed)
        difference = stereo.vector - true.vector
        stated = Provenance(rms, VIEWS, (9, 6), 25.0, fixed_intrinsics=fixed)
        for kind, known in (("all", stated), ("nothing", Provenance())):
            covariance = with_assumed_covariance(stereo, known, Provenance()).parameter_covariance
            for name in ("focal length", "principal point", "rotation", "translation"):
                block = covariance[np.ix_(GROUPS[name], GROUPS[name])]
                error = difference[GROUPS[name]]
                squares.setdefault((kind, name), []).append(float(error @ np.linalg.solve(block, error)) / len(error))
    for (kind, name), values in squares.items():
        low = {"all": 0.5, "nothing": 0.2}[kind]
        assert 0.8 * low < np.sqrt(np.mean(values)) < 1.2 * 1.5, (kind, name)


def test_a_stated_uncertainty_replaces_that_of_its_group(mounted):
    """Exactly, with the group's correlations; the others follow as they depend on it."""
    plain = with_assumed_covariance(mounted, Provenance(), Provenance())
    stated = Provenance(u_focal_percent=0.5, u_principal_px=3.0, u_rotation_mrad=0.7, u_baseline_mm=0.2)
    for name, values in (
        ("u_focal_percent", 0.005 * mounted.vector[GROUPS["focal length"]]),
        ("u_principal_px", np.full(4, 3.0)),
        ("u_rotation_mrad", np.full(3, 0.7e-3)),
        ("u_baseline_mm", np.full(3, 0.2)),
    ):
        group = GROUPS[
            {"focal": "focal length", "princ": "principal point", "rotat": "rotation"}.get(name[2:7], "translation")
        ]
        stereo = with_assumed_covariance(mounted, Provenance(**{name: getattr(stated, name)}), Provenance())
        np.testing.assert_allclose(np.sqrt(np.diag(stereo.parameter_covariance))[group], values, rtol=1e-9)
        assert "(stated)" in stereo.assumed_from and stereo.assumed
        stereo_bytes(stereo)
    matrix = plain.parameter_covariance
    sds = np.sqrt(np.diag(matrix))[GROUPS["rotation"]]
    # Its own sds change nothing; units span ten powers of ten.
    scale = np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))
    np.testing.assert_allclose(with_marginal(matrix, GROUPS["rotation"], sds) / scale, matrix / scale, atol=1e-9)
    # A group that is known exactly leaves the conditional covariance of the others.
    tiny = with_marginal(matrix, GROUPS["rotation"], 1e-6 * sds)
    rest = [k for k in range(24) if k not in GROUPS["rotation"]]
    expected = np.linalg.inv(np.linalg.inv(matrix / scale)[np.ix_(rest, rest)])
    np.testing.assert_allclose(tiny[np.ix_(rest, rest)] / scale[np.ix_(rest, rest)], expected, atol=1e-6)


def test_stated_values_precede_the_file_and_the_file_precedes_defaults(mounted, tmp_path):
    files = exported(mounted, "opencv")
    files["intrinsics.yml"] += b"avg_reprojection_error: 0.41\nnr_of_frames: 17\nboard_width: 8\nboard_height: 5\n"
    paths = written(tmp_path, files)
    of_file = read_calibration(paths).stereo
    expected = Provenance(0.41, 17, (8, 5))
    assert of_file.assumed_from == with_assumed_covariance(of_file, Provenance(), expected).assumed_from
    assert (
        "RMS 0.41 px (of the file), 17 views (of the file), a board of 8x5 corners (of the file)"
        in of_file.assumed_from
    )
    assert of_file.rms_px == 0.41 and "squares of 25 mm (usual)" in of_file.assumed_from
    stated = read_calibration(paths, stated=Provenance(0.21, 20, pitch_mm=30.0)).stereo
    assert "RMS 0.21 px (stated), 20 views (stated), a board of 8x5 corners (of the file)" in stated.assumed_from
    board = Board(8, 5, 30.0)
    np.testing.assert_allclose(stated.parameter_covariance, calibration_covariance(stated, board, 20, 0.21), rtol=1e-12)
    board = Board(8, 5, 25.0, 25.0 * USUAL_PITCH_SHARE)
    np.testing.assert_allclose(
        of_file.parameter_covariance, calibration_covariance(of_file, board, 17, 0.41), rtol=1e-12
    )
    assert CORRELATION_FACTOR >= 1


def test_cameras_without_a_common_field_are_refused(mounted):
    away = replace(mounted, R=rotation_matrix(np.array([0, 2.8, 0])))
    with pytest.raises(InputError, match="do not see one board together"):
        with_assumed_covariance(away, Provenance(), Provenance())
    with pytest.raises(InputError, match="calibrate no pair"):
        calibration_covariance(mounted, Board(3, 3, 25.0), 0, 0.2)


def test_a_fit_states_its_share_of_the_variance(mounted):
    row = BudgetRow("stereo calibration", "deg", None, 0.1, "B", "normal", None, 1.0, 0.1, 0.62)
    other = structs.replace(row, share=0.01)
    tables = [
        BudgetTable(name, "deg", 1.0, (entry,), 0.1, None, 2.0, 0.95, 0.2, ())
        for name, entry in (
            ("effective_deg_per_step.left", row),
            ("effective_deg_per_step.right", row),
            ("backlash_deg.pan", other),
        )
    ]
    assert assumed_stereo(mounted, tables) is None
    assumed = replace(mounted, assumed=True, assumed_from="RMS 0.21 px (stated)")
    sentence = assumed_stereo(assumed, tables)
    assert sentence is not None and "(from RMS 0.21 px (stated))" in sentence and "backlash" not in sentence
    assert "62 % of the variance of the effective ratio (left, right);" in sentence and "--rms-px" in sentence
    sentence = assumed_stereo(assumed, tables[2:])
    assert sentence is not None and "less than 5 %" in sentence and "--rms-px" not in sentence
