"""A folder of board pictures to stereo.json."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from tvsbayes.cameras.boards import SIDES, Board, Finder, View, Views, find_views
from tvsbayes.cameras.bundle_adjustment import Adjustment, bundle_adjustment, undetermined
from tvsbayes.errors import NothingToEstimate, escaped
from tvsbayes.instrument.parameters import STEREO_PARAMETER_NAMES
from tvsbayes.instrument.stereo_pair import Stereo, pair_doubts, rotation_vector
from tvsbayes.instrument.stereo_pair import rotation_matrix as rotation_of

VIEWS_MIN = 3
"""Views per camera below which Zhang's method (2000) cannot find a focal length with both principal coordinates."""
START_VIEWS = 30
"""The start needs no more; every further view enters the bundle adjustment alone."""
OUTLIER_Z, OUTLIER_SPREAD_MIN = 4.0, 0.2
"""A view is an outlier if the logarithm of its residual rms lies more than 4 robust standard deviations (1.4826 MAD,
at least 0.2) above the median: never below 2.2 times the median rms. On clean views the logarithm scatters by 0.05."""
MISMATCH_TIMES, MISMATCH_SHARE = 5.0, 0.01
"""A view is no pair if its right corners miss the place that the left ones and the median of all relative poses
predict by more than five times the median view and by more than 1 % of the image width."""
VIEWS_ADVISED = 10
"""Zhang (2000), figure 3: the errors have fallen to a floor by about ten views."""
TILT_ADVISED_DEG = 15.0
COVERAGE_ADVISED = 0.6
CORNER_SD_ADVISED_PX = 0.5


@dataclass(frozen=True)
class ViewReport:
    """One view: residual rms per camera as OpenCV defines it (over corners, px; None where unseen), pose in words."""

    name: str
    left_rms_px: float | None
    right_rms_px: float | None
    distance_mm: float
    tilt_deg: float
    outlier: bool


@dataclass(frozen=True)
class StereoCalibration:
    """A stereo calibration with everything behind it.

    Attributes:
        stereo: parameters and their full covariance (type A with `correlation_factor`, plus the pitch).
        board: as given.
        views: every view used, with its residuals.
        left_rms_px, right_rms_px: rms over corners as OpenCV defines it; of both cameras in `stereo.rms_px`.
        noise_sd_px: standard deviation of one corner coordinate.
        dof: degrees of freedom behind it.
        correlation_factor: factor on the covariance for errors that the corners of a picture share.
        covariance_independent: (24, 24), type A for independent corners: what OpenCV and most tools report.
        covariance_pitch: (24, 24), type B, from the pitch: scales T.
        coverage: share of the image inside the boards, by camera.
        triangulated_pitch_mm: mean and standard deviation of all sides of squares, triangulated.
        found: what the folder held; None where corners were given.
        excluded: names of outlying views that were left out: no pairs at all, or by `robust`.
        warnings: plausibility in words.
        seconds: wall time by stage.
    """

    stereo: Stereo
    board: Board
    views: tuple[ViewReport, ...]
    left_rms_px: float
    right_rms_px: float
    noise_sd_px: float
    dof: int
    correlation_factor: float
    covariance_independent: np.ndarray
    covariance_pitch: np.ndarray
    coverage: dict[str, float]
    triangulated_pitch_mm: tuple[float, float]
    found: Views | None
    excluded: tuple[str, ...]
    warnings: tuple[str, ...]
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def outliers(self) -> tuple[str, ...]:
        """Names of all outlying views, left out or not."""
        return (*(view.name for view in self.views if view.outlier), *self.excluded)

    @property
    def pairs(self) -> int:
        """Views that both cameras saw."""
        return sum(view.left_rms_px is not None and view.right_rms_px is not None for view in self.views)

    def as_json(self) -> dict[str, object]:
        """The document of `tvsbayes stereo --json`, without the paths of what was written."""
        total = np.sqrt(np.diag(self.stereo.parameter_covariance))
        parts = {
            "sd": total,
            "sd_independent_corners": np.sqrt(np.diag(self.covariance_independent)),
            "sd_pitch": np.sqrt(np.diag(self.covariance_pitch)),
        }
        vector = self.stereo.vector
        found = self.found
        lists = ("unpaired", "without_board", "other_size", "by_fallback", "reordered")
        return {
            "image_width": self.stereo.image_width,
            "image_height": self.stereo.image_height,
            "board": {
                "columns": self.board.columns,
                "rows": self.board.rows,
                "pitch_mm": self.board.pitch_mm,
                "pitch_u_mm": self.board.pitch_u_mm,
            },
            "pairs": self.pairs,
            "single_views": len(self.views) - self.pairs,
            "rms_px": self.stereo.rms_px,
            "left_rms_px": self.left_rms_px,
            "right_rms_px": self.right_rms_px,
            "noise": {"sd_px": self.noise_sd_px, "dof": self.dof, "correlation_factor": self.correlation_factor},
            "parameters": {
                name: {"value": float(vector[k]), **{key: float(sds[k]) for key, sds in parts.items()}}
                for k, name in enumerate(STEREO_PARAMETER_NAMES)
            },
            "baseline_mm": {"value": float(np.linalg.norm(self.stereo.T)), "sd": self.baseline_sd_mm},
            "triangulated_pitch_mm": {"mean": self.triangulated_pitch_mm[0], "sd": self.triangulated_pitch_mm[1]},
            "coverage": self.coverage,
            "views": [vars(view) for view in self.views],
            "outliers": list(self.outliers),
            "excluded": list(self.excluded),
            **{key: list(getattr(found, key)) if found is not None else [] for key in lists},
            "warnings": list(self.warnings),
            "assumed": self.stereo.assumed,
            "seconds": self.seconds,
        }

    @property
    def baseline_sd_mm(self) -> float:
        """Standard uncertainty of |T|."""
        along = self.stereo.T / np.linalg.norm(self.stereo.T)
        return float(np.sqrt(along @ self.stereo.parameter_covariance[21:, 21:] @ along))


@dataclass(frozen=True)
class _CameraStart:
    """Zhang's solution for one camera: matrix, distortion, and a pose (6,) for every view that it saw."""

    matrix: np.ndarray
    distortion: np.ndarray
    poses: dict[int, np.ndarray]

    @property
    def vector(self) -> np.ndarray:
        return np.array([*self.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *self.distortion])


def _camera_start(
    corners: dict[int, np.ndarray], board: Board, size: tuple[int, int], side: str, fix_k3: bool
) -> _CameraStart:
    """Zhang's method (cv2.calibrateCamera) on some views, then a pose for each."""
    if len(corners) < VIEWS_MIN:
        raise NothingToEstimate(
            "few-views",
            f"the board was found in {len(corners)} pictures of the {side} camera; {VIEWS_MIN} are the least",
            remedy="check --board (inner corners: where four squares meet), sharpness and light; take 15 to 25 views",
        )
    keys = sorted(corners)
    chosen = [keys[k] for k in np.unique(np.linspace(0, len(keys) - 1, START_VIEWS).astype(int))]
    points = board.points_mm.astype(np.float32)
    flags = cv2.CALIB_FIX_K3 if fix_k3 else 0
    found = [np.ascontiguousarray(corners[k], np.float32) for k in chosen]
    try:
        _, matrix, distortion, *_ = cv2.calibrateCamera([points] * len(found), found, size, None, None, flags=flags)
    except cv2.error as error:
        raise undetermined(f"OpenCV found no start for the {side} camera ({escaped(str(error.err), 100)})") from error
    matrix, distortion = np.asarray(matrix, float), np.asarray(distortion, float).ravel()[:5]
    if not (np.isfinite(matrix).all() and np.isfinite(distortion).all()):
        raise undetermined(f"OpenCV found no finite start for the {side} camera")
    return _CameraStart(matrix, distortion, {k: _board_pose(corners[k], board, matrix, distortion) for k in keys})


def _relative(start: Sequence[_CameraStart]) -> tuple[np.ndarray, np.ndarray]:
    """R and T as the median over pairs: one wrong pair does not move them."""
    rotations, translations = [], []
    for k in sorted(set(start[0].poses) & set(start[1].poses)):
        left, right = (s.poses[k] for s in start)
        turn = rotation_of(right[:3]) @ rotation_of(left[:3]).T
        rotations.append(turn)
        translations.append(right[3:] - turn @ left[3:])
    if not rotations:
        raise NothingToEstimate(
            "no-pairs",
            "no view shows the board to both cameras",
            remedy="name the pictures of one moment alike: left01.png and right01.png",
        )
    return rotation_vector(np.median(rotations, axis=0)), np.median(translations, axis=0)


def calibrate_stereo(
    views: Sequence[View],
    board: Board,
    size: tuple[int, int],
    *,
    fix_k3: bool = False,
    robust: bool = False,
    found: Views | None = None,
) -> StereoCalibration:
    """Calibrates a stereo pair from corners.

    Args:
        views: corners by view; those of one camera alone inform that camera.
        board: whose corners they are.
        size: image width and height, px.
        fix_k3: keep both k3 at 0.
        robust: leave out outlying views and adjust again, once. Views whose two pictures cannot show one board (of
            two moments, say) are left out in any case: nothing fits them.
        found: what the folder held, for the report.

    Raises:
        NothingToEstimate: fewer than `VIEWS_MIN` views of a camera, no pair, or views that leave parameters open.
        NotConverged: no minimum was found.
    """
    began = time.perf_counter()
    views = [view for view in views if view.left is not None or view.right is not None]
    free = np.ones(24, bool)
    free[[8, 17]] = not fix_k3
    excluded: list[str] = []
    start = _start(views, board, size, fix_k3)
    leave_out = start.mismatched
    while True:
        if leave_out.any():
            excluded += [view.name for view, out in zip(views, leave_out, strict=True) if out]
            views = [view for view, out in zip(views, leave_out, strict=True) if not out]
            start = _start(views, board, size, fix_k3)
        done = bundle_adjustment(views, board, start.vector, start.poses, free)
        outliers = _outliers(done)
        if not (robust and outliers.any()):
            break
        leave_out, robust = outliers, False
    pitch = np.zeros((24, 24))
    # The pixels know angles only: all lengths, T among them, are proportional to the pitch.
    shift = done.vector[21:] * (board.pitch_u_mm / board.pitch_mm)
    pitch[21:, 21:] = np.outer(shift, shift)
    covariance = done.correlation_factor * done.covariance + pitch
    empty = Stereo(*size, *(np.zeros(1) for _ in range(6)), 0.5 * (covariance + covariance.T), _rms(done.residuals_px))
    stereo = empty.with_vector(done.vector)
    poses = [
        _board_pose(view.left, board, stereo.M1, stereo.D1)
        if view.left is not None
        else _left_pose(_board_pose(view.right, board, stereo.M2, stereo.D2), stereo.R, stereo.T)
        for view in views
    ]
    reports = tuple(_view_reports(views, done, poses, outliers))
    result = StereoCalibration(
        stereo=stereo,
        board=board,
        views=reports,
        left_rms_px=_rms(done.residuals_px[:, :2]),
        right_rms_px=_rms(done.residuals_px[:, 2:]),
        noise_sd_px=done.noise_sd_px,
        dof=done.dof,
        correlation_factor=done.correlation_factor,
        covariance_independent=done.covariance,
        covariance_pitch=pitch,
        coverage={side: _coverage([getattr(v, side) for v in views], size) for side in SIDES},
        triangulated_pitch_mm=_triangulated_pitch(views, board, stereo),
        found=found,
        excluded=tuple(excluded),
        warnings=(),
        seconds={"adjustment": time.perf_counter() - began},
    )
    return replace(result, warnings=tuple(_plausibility(result, poses)))


def calibrate_folder(
    folder: Path,
    board: Board,
    *,
    finder: Finder = "classic",
    swap: bool = False,
    fix_k3: bool = False,
    robust: bool = False,
) -> StereoCalibration:
    """`find_views`, then `calibrate_stereo`; their arguments and errors."""
    began = time.perf_counter()
    found = find_views(folder, board, finder=finder, swap=swap)
    seconds = {"corners": time.perf_counter() - began}
    size = (found.image_width, found.image_height)
    result = calibrate_stereo(found.views, board, size, fix_k3=fix_k3, robust=robust, found=found)
    return replace(result, seconds=seconds | result.seconds)


def _pixels(corners: np.ndarray) -> np.ndarray:
    """Corners (corners, 2) as every OpenCV takes them: contiguous, of rank 3."""
    return np.ascontiguousarray(corners, float).reshape(-1, 1, 2)


def _board_pose(corners: np.ndarray, board: Board, matrix: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Board to camera, shape (6,), from one picture by IPPE (Collins and Bartoli 2014)."""
    done, turn, shift = cv2.solvePnP(board.points_mm, _pixels(corners), matrix, distortion, flags=cv2.SOLVEPNP_IPPE)
    if not done or not (np.isfinite(turn).all() and np.isfinite(shift).all()):
        raise undetermined("a board has no pose that OpenCV can find")
    return np.concatenate([np.ravel(turn), np.ravel(shift)])


def _left_pose(right_pose: np.ndarray, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Board to left camera from board to right camera; `turn` is R, `shift` T."""
    rotation = rotation_vector(turn.T @ rotation_of(right_pose[:3]))
    return np.concatenate([rotation, turn.T @ (right_pose[3:] - shift)])


@dataclass(frozen=True)
class _Start:
    """Where the adjustment starts: the 24 parameters, board poses (views, 6), and which views are no pair at all."""

    vector: np.ndarray
    poses: np.ndarray
    mismatched: np.ndarray


def _start(views: Sequence[View], board: Board, size: tuple[int, int], fix_k3: bool) -> _Start:
    cameras = []
    for side in SIDES:
        corners = {k: getattr(v, side) for k, v in enumerate(views) if getattr(v, side) is not None}
        cameras.append(_camera_start(corners, board, size, side, fix_k3))
    left, right = cameras
    turn, shift = _relative(cameras)
    rotation = rotation_of(turn)
    poses, misses = [], np.zeros(len(views))
    for k, view in enumerate(views):
        poses.append(left.poses[k] if k in left.poses else _left_pose(right.poses[k], rotation, shift))
        if k in left.poses and k in right.poses:
            pose = poses[k]
            seen_from_right = rotation_vector(rotation @ rotation_of(pose[:3])), rotation @ pose[3:] + shift
            pixels, _ = cv2.projectPoints(board.points_mm, *seen_from_right, right.matrix, right.distortion)
            misses[k] = math.sqrt(np.mean(np.sum((np.reshape(pixels, (-1, 2)) - view.right) ** 2, axis=1)))
    usual = float(np.median(misses[misses > 0])) if misses.any() else 0.0
    mismatched = misses > max(MISMATCH_TIMES * usual, MISMATCH_SHARE * size[0])
    vector = np.concatenate([left.vector, right.vector, turn, shift])
    return _Start(vector, np.array(poses), mismatched)


def _rms(residuals_px: np.ndarray) -> float:
    """Root of the mean squared distance of a corner, as OpenCV defines it; residuals (views, 2 or 4, corners)."""
    return math.sqrt(2 * float(np.nanmean(residuals_px**2)))


def _outliers(done: Adjustment) -> np.ndarray:
    """Which views lie above the rule of `OUTLIER_Z`, shape (views,)."""
    logs = np.log([max(_rms(r), 1e-12) for r in done.residuals_px])
    middle = np.median(logs)
    spread = max(1.4826 * float(np.median(np.abs(logs - middle))), OUTLIER_SPREAD_MIN)
    return logs > middle + OUTLIER_Z * spread


def _normal(pose: np.ndarray) -> np.ndarray:
    return rotation_of(pose[:3])[:, 2]


def _view_reports(
    views: Sequence[View], done: Adjustment, poses: Sequence[np.ndarray], outliers: np.ndarray
) -> Iterator[ViewReport]:
    for view, residuals, pose, outlier in zip(views, done.residuals_px, poses, outliers, strict=True):
        rms = [
            None if seen is None else _rms(residuals[rows])
            for seen, rows in ((view.left, slice(0, 2)), (view.right, slice(2, 4)))
        ]
        tilt = math.degrees(math.acos(min(1.0, abs(float(_normal(pose)[2])))))
        yield ViewReport(view.name, *rms, float(np.linalg.norm(pose[3:])), tilt, bool(outlier))


def _coverage(corners: Sequence[np.ndarray | None], size: tuple[int, int]) -> float:
    """Share of the image inside the outline of a board in at least one view."""
    scale = 256 / max(size)
    mask = np.zeros([max(1, round(s * scale)) for s in size[::-1]], np.uint8)
    for seen in corners:
        if seen is not None:
            outline = cv2.convexHull(np.rint(seen * scale).astype(np.int32).reshape(-1, 1, 2))
            cv2.fillConvexPoly(mask, outline, 1)
    return float(mask.mean())


def _triangulated_pitch(views: Sequence[View], board: Board, stereo: Stereo) -> tuple[float, float]:
    """Mean and standard deviation of the sides of all squares, triangulated from both images, mm."""
    sides = []
    right = np.hstack([stereo.R, stereo.T[:, None]])
    for view in views:
        if view.left is None or view.right is None:
            continue
        rays = [
            cv2.undistortPoints(_pixels(seen), M, D).reshape(-1, 2).T
            for seen, M, D in ((view.left, stereo.M1, stereo.D1), (view.right, stereo.M2, stereo.D2))
        ]
        points = np.asarray(cv2.triangulatePoints(np.eye(3, 4), right, *rays))
        grid = (points[:3] / points[3]).T.reshape(board.rows, board.columns, 3)
        sides += [np.linalg.norm(np.diff(grid, axis=axis), axis=2).ravel() for axis in (0, 1)]
    lengths = np.concatenate(sides)
    return float(lengths.mean()), float(lengths.std(ddof=1))


def _plausibility(result: StereoCalibration, poses: Sequence[np.ndarray]) -> list[str]:
    """What a careful reader would ask about the views, in words."""
    warnings = []
    if result.pairs < VIEWS_ADVISED:
        warnings.append(f"few views: {result.pairs} pairs; errors fall until about {VIEWS_ADVISED}, take 15 to 25")
    normals = np.array([_normal(pose) for pose in poses])
    spread = math.degrees(math.acos(min(1.0, float(np.abs(normals @ normals.T).min()))))
    if spread < TILT_ADVISED_DEG:
        warnings.append(
            f"all boards are nearly parallel (within {spread:.0f} deg): focal length and distance cannot be told "
            "apart; tilt the board by 30 to 45 deg about both axes"
        )
    elif max(view.tilt_deg for view in result.views) < TILT_ADVISED_DEG:
        warnings.append("no tilt: no board leans more than 15 deg; tilt it by 30 to 45 deg about both axes")
    for side, share in result.coverage.items():
        if share < COVERAGE_ADVISED:
            warnings.append(
                f"poor coverage: boards fill {100 * share:.0f} % of the {side} image; outside, the distortion is "
                "extrapolated: hold the board into every corner of the image"
            )
    if result.noise_sd_px > CORNER_SD_ADVISED_PX:
        warnings.append(
            f"corners miss by {result.noise_sd_px:.2f} px (one coordinate); 0.1 to 0.2 is usual: look for blur, "
            "pictures not of one moment, a bent board, or a lens that five coefficients do not describe"
        )
    warnings += pair_doubts(result.stereo)
    mean, sd = result.triangulated_pitch_mm
    if abs(mean / result.board.pitch_mm - 1) > 0.01:
        warnings.append(f"triangulated squares measure {mean:.3f} mm (sd {sd:.3f}), not {result.board.pitch_mm:g}")
    if result.board.pitch_u_mm == 0:
        warnings.append("the pitch is taken as exact: state its standard uncertainty with --pitch-u-mm")
    if result.excluded:
        warnings.append(
            f"left out, since the two pictures contradict the rest: {escaped(', '.join(result.excluded), 400)}"
        )
    kept = [view.name for view in result.views if view.outlier]
    if kept:
        names = escaped(", ".join(kept), 400)
        warnings.append(f"outlying views: {names}; look at their pictures, or leave them out with --robust")
    return warnings
