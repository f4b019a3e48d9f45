"""From board pictures to a stereo calibration with its covariance, and plausibility checks.

Type A: all corners of all views in one bundle adjustment, widened for errors common to the corners of a picture and for
an imperfect board. Type B: the pitch of the board, to which all lengths are proportional. mm, px with the integer at a
pixel's centre, parameters in the order of `STEREO_PARAMETER_NAMES`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from tvsbayes.cameras.board_errors import board_errors
from tvsbayes.cameras.boards import Board, Finder, View, Views, find_views
from tvsbayes.cameras.bundle_adjustment import Adjustment, bundle_adjustment
from tvsbayes.cameras.picture_pairs import AS_NAMED, Pairing
from tvsbayes.cameras.stereo_start import (
    DOUBTFUL_START_PX,
    Start,
    opencv_start,
    pairs_disagree,
    pixels_of,
    pose_of,
    start_of,
    visible_corners,
)
from tvsbayes.errors import TvsError, escaped
from tvsbayes.instrument.campaign import CAMERAS
from tvsbayes.instrument.parameters import STEREO_PARAMETER_NAMES
from tvsbayes.instrument.stereo_pair import Stereo, pair_doubts, rotation_matrix
from tvsbayes.progress import Job, Show
from tvsbayes.statistics.intervals import WithSd

OUTLIER_Z, OUTLIER_SPREAD_MIN = 4.0, 0.2
"""A view is an outlier if the logarithm of its residual rms lies more than 4 robust standard deviations (1.4826 MAD,
at least 0.2) above the median: never below 2.2 times the median rms. On clean views the logarithm scatters by 0.05."""
FINDING, ADJUSTING = "finding corners", "adjusting all corners"
STAGES = {FINDING: 2.0, ADJUSTING: 3.0}
"""Stages of a calibration with their usual seconds, for the progress."""
VIEWS_ADVISED = 10
"""Advised number of views: by Zhang (2000), figure 3, errors no longer fall beyond about ten views."""
TILT_ADVISED_DEG = 15.0
COVERAGE_ADVISED = 0.6
CORNER_SD_ADVISED_PX = 0.5
PAIR_RMS_RATIO = 1.5
"""Ratio of the pair's rms to that of single cameras above which a warning is given: correct pairs stay below 1.15."""
PAIR_RMS_MIN_PX = 0.05
CONTRADICTION_RATIO, CONTRADICTION_PX = 4.0, 1.0
"""Limits above which (both) the pictures are not of one pair of cameras, and no covariance would be valid."""


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
    """A stereo calibration with its uncertainties, views and warnings.

    Attributes:
        stereo: parameters and their full covariance (type A with `correlation_factor`, plus board and pitch).
        board: the board.
        views: every view used, with its residuals.
        left_rms_px, right_rms_px: rms over corners as OpenCV defines it; `stereo.rms_px` is that of both cameras.
        noise_sd_px: standard deviation of one corner coordinate.
        dof: degrees of freedom of `noise_sd_px`.
        correlation_factor: factor on the covariance for errors that the corners of a picture share.
        covariance_independent: (24, 24), type A for independent corners, as OpenCV and most tools report it.
        board_error_mm: deviation of the board's corners from a grid, sd of one coordinate, from the residuals.
        covariance_board: (24, 24), from these deviations.
        covariance_pitch: (24, 24), type B, from the pitch: scales T.
        coverage: share of the image inside the boards, by camera.
        triangulated_pitch_mm: mean and standard deviation of all sides of squares, triangulated.
        pictures: the folder of pictures; None where corners were given.
        excluded: names of outlying views that were left out: not a pair, or excluded by `robust`.
        reordered: names of views whose right corners were reordered to match the left ones.
        alone_rms_px: rms over corners, as in `stereo.rms_px`, with each camera calibrated alone.
        warnings: implausible results, in words.
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
    board_error_mm: float
    covariance_board: np.ndarray
    covariance_pitch: np.ndarray
    coverage: dict[str, float]
    triangulated_pitch_mm: WithSd[float]
    pictures: Views | None
    excluded: tuple[str, ...]
    reordered: tuple[str, ...]
    alone_rms_px: float
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
        """The document of `tvsbayes stereo --json`, without the paths of written files."""
        covariances = {
            "sd": self.stereo.parameter_covariance,
            "sd_independent_corners": self.covariance_independent,
            "sd_board": self.covariance_board,
            "sd_pitch": self.covariance_pitch,
        }
        sds = {key: np.sqrt(np.diag(covariance)).tolist() for key, covariance in covariances.items()}
        values = zip(STEREO_PARAMETER_NAMES, self.stereo.vector.tolist(), strict=True)
        lists = ("unpaired", "without_board", "other_size", "by_fallback")
        return {
            "image_width": self.stereo.image_width,
            "image_height": self.stereo.image_height,
            "board": {key: getattr(self.board, key) for key in ("columns", "rows", "pitch_mm", "pitch_u_mm")},
            "pairs": self.pairs,
            "single_views": len(self.views) - self.pairs,
            "rms_px": self.stereo.rms_px,
            **{key: getattr(self, key) for key in ("left_rms_px", "right_rms_px", "alone_rms_px")},
            "noise": {"sd_px": self.noise_sd_px, "dof": self.dof, "correlation_factor": self.correlation_factor},
            "parameters": {
                name: {"value": value, **{key: own[k] for key, own in sds.items()}}
                for k, (name, value) in enumerate(values)
            },
            "board_error_mm": self.board_error_mm,
            "baseline_mm": {"value": float(np.linalg.norm(self.stereo.T)), "sd": self.baseline_sd_mm},
            "triangulated_pitch_mm": {"mean": self.triangulated_pitch_mm.value, "sd": self.triangulated_pitch_mm.sd},
            "coverage": self.coverage,
            "views": [vars(view) for view in self.views],
            **{key: list(getattr(self, key)) for key in ("outliers", "excluded", "reordered")},
            **{key: [] if self.pictures is None else list(getattr(self.pictures, key)) for key in lists},
            "warnings": list(self.warnings),
            "assumed": self.stereo.assumed,
            "seconds": self.seconds,
        }

    @property
    def baseline_sd_mm(self) -> float:
        """Standard uncertainty of |T|."""
        along = self.stereo.T / np.linalg.norm(self.stereo.T)
        return float(np.sqrt(along @ self.stereo.parameter_covariance[21:, 21:] @ along))


def calibrate_stereo(
    views: Sequence[View],
    board: Board,
    size: tuple[int, int],
    *,
    fix_k3: bool = False,
    robust: bool = False,
    pictures: Views | None = None,
) -> StereoCalibration:
    """Calibrates a stereo pair from corners.

    Args:
        views: corners by view; views of one camera alone inform that camera.
        board: the board in the views.
        size: image width and height, px.
        fix_k3: keep both k3 at 0.
        robust: leave out outlying views and adjust again, once. Views whose two pictures cannot show one board (of
            different moments, for example) are always left out.
        pictures: the folder of pictures, for the report.

    Raises:
        NothingToEstimate: fewer than `VIEWS_MIN` views of a camera, no pair, or undetermined parameters.
        NotConverged: no minimum was found.
    """
    start_s = time.perf_counter()
    start, adjustment, outliers, excluded = _adjust_views(views, board, size, fix_k3, robust)
    pitch = np.zeros((24, 24))
    # Pixels determine only angles: all lengths, including T, are proportional to the pitch.
    shift = adjustment.vector[21:] * (board.pitch_u_mm / board.pitch_mm)
    pitch[21:, 21:] = np.outer(shift, shift)
    stereo = Stereo.of_vector(adjustment.vector, size, _rms(adjustment.residuals_px))
    poses = np.array([pose_of(view, board, stereo) for view in start.views])
    errors = board_errors(adjustment, poses, board, stereo)
    covariance = errors.correlation_factor * adjustment.covariance + errors.covariance + pitch
    stereo = replace(
        stereo,
        parameter_covariance=0.5 * (covariance + covariance.T),
        right_image_size=None if pictures is None else pictures.right_image_size,
    )
    result = StereoCalibration(
        stereo=stereo,
        board=board,
        views=tuple(map(_view_report, start.views, adjustment.residuals_px, poses, outliers)),
        left_rms_px=_rms(adjustment.residuals_px[:, :2]),
        right_rms_px=_rms(adjustment.residuals_px[:, 2:]),
        noise_sd_px=adjustment.noise_sd_px,
        dof=adjustment.dof,
        correlation_factor=errors.correlation_factor,
        covariance_independent=adjustment.covariance,
        board_error_mm=errors.sd_mm,
        covariance_board=errors.covariance,
        covariance_pitch=pitch,
        coverage={side: _coverage([getattr(view, side) for view in start.views], size) for side in CAMERAS},
        triangulated_pitch_mm=_triangulated_pitch(start.views, board, stereo),
        pictures=pictures,
        excluded=excluded,
        reordered=_reordered(pictures, start.turned),
        alone_rms_px=start.alone_rms_px,
        warnings=(),
        seconds={"adjustment": time.perf_counter() - start_s},
    )
    return replace(result, warnings=tuple(_plausibility(result, poses)))


def _adjust_views(
    views: Sequence[View], board: Board, size: tuple[int, int], fix_k3: bool, robust: bool
) -> tuple[Start, Adjustment, np.ndarray, tuple[str, ...]]:
    """The adjustment of all consistent views, its start, its outlying views, and the names of those left out.

    With `robust` it is repeated once without outliers.
    """
    free = np.ones(24, bool)
    free[[8, 17]] = not fix_k3
    start = start_of([v for v in views if v.left is not None or v.right is not None], board, size, fix_k3)
    leave_out, turned, excluded = start.mismatched, start.turned, []
    while True:
        if leave_out.any():
            marked = list(zip(start.views, leave_out, strict=True))
            excluded += [view.name for view, left_out in marked if left_out]
            start = start_of([view for view, left_out in marked if not left_out], board, size, fix_k3)
        adjustment = _lowest_adjustment(start, board, size, free)
        pair_rms = _rms(adjustment.residuals_px)
        if pair_rms > max(CONTRADICTION_RATIO * start.alone_rms_px, CONTRADICTION_PX):
            alone = f"each camera by itself by {start.alone_rms_px:.2f}"
            raise pairs_disagree(f"together they miss by {pair_rms:.2f} px, {alone}")
        outliers = _outliers(adjustment)
        if not (robust and outliers.any()):
            return replace(start, turned=turned), adjustment, outliers, tuple(excluded)
        leave_out, robust = outliers, False


def _lowest_adjustment(start: Start, board: Board, size: tuple[int, int], free: np.ndarray) -> Adjustment:
    """The adjustment from a start; for large residuals also from OpenCV's result, and the lower of the two."""
    failed = None
    try:
        first = bundle_adjustment(start.views, board, start.vector, start.poses, free)
        if _rms(first.residuals_px) <= DOUBTFUL_START_PX:
            return first
    except TvsError as error:
        failed = error
    try:
        other = opencv_start(start, board, size, not free[8])
        second = bundle_adjustment(other.views, board, other.vector, other.poses, free)
    except TvsError:
        if failed is not None:
            raise failed from None
        return first
    return second if failed is not None else min(first, second, key=lambda adjustment: adjustment.noise_sd_px)


def _reordered(pictures: Views | None, turned: tuple[str, ...]) -> tuple[str, ...]:
    """Names of views reordered by direction or by agreement, but not by both: two half turns cancel."""
    first = () if pictures is None else pictures.reordered
    return (*(name for name in first if name not in turned), *(name for name in turned if name not in first))


def calibrate_folder(
    folder: Path,
    board: Board,
    *,
    finder: Finder = "classic",
    pairing: Pairing = AS_NAMED,
    fix_k3: bool = False,
    robust: bool = False,
    progress: Show | None = None,
) -> StereoCalibration:
    """`find_views`, then `calibrate_stereo`; their arguments and errors. `progress` shows the progress."""
    start_s = time.perf_counter()
    with Job(STAGES, progress) as job:
        job.begin(FINDING)
        pictures = find_views(folder, board, finder=finder, pairing=pairing, advance=job.at)
        seconds = {"corners": time.perf_counter() - start_s}
        size = (pictures.image_width, pictures.image_height)
        job.begin(ADJUSTING)
        result = calibrate_stereo(pictures.views, board, size, fix_k3=fix_k3, robust=robust, pictures=pictures)
        return replace(result, seconds=seconds | result.seconds)


def _rms(residuals_px: np.ndarray) -> float:
    """Root of the mean squared distance of a corner, as OpenCV defines it; residuals (views, 2 or 4, corners)."""
    return math.sqrt(2 * float(np.nanmean(residuals_px**2)))


def _outliers(adjustment: Adjustment) -> np.ndarray:
    """Mask of the views that are outliers by `OUTLIER_Z`, shape (views,)."""
    logs = np.log([max(_rms(r), 1e-12) for r in adjustment.residuals_px])
    middle = np.median(logs)
    spread = max(1.4826 * float(np.median(np.abs(logs - middle))), OUTLIER_SPREAD_MIN)
    return logs > middle + OUTLIER_Z * spread


def _view_report(view: View, residuals_px: np.ndarray, pose: np.ndarray, outlier: bool) -> ViewReport:
    return ViewReport(
        view.name,
        None if view.left is None else _rms(residuals_px[:2]),
        None if view.right is None else _rms(residuals_px[2:]),
        float(np.linalg.norm(pose[3:])),
        math.degrees(math.acos(min(1.0, abs(float(rotation_matrix(pose[:3])[2, 2]))))),
        bool(outlier),
    )


def _coverage(corners: Sequence[np.ndarray | None], size: tuple[int, int]) -> float:
    """Share of the image inside the outline of a board in at least one view."""
    scale = 256 / max(size)
    mask = np.zeros([max(1, round(s * scale)) for s in size[::-1]], np.uint8)
    for pixels in corners:
        if pixels is not None:
            visible = pixels[np.isfinite(pixels).all(axis=1)]
            outline = cv2.convexHull(np.rint(visible * scale).astype(np.int32).reshape(-1, 1, 2))
            cv2.fillConvexPoly(mask, outline, 1)
    return float(mask.mean())


def _triangulated_pitch(views: Sequence[View], board: Board, stereo: Stereo) -> WithSd[float]:
    """Mean and standard deviation of the sides of all squares, triangulated from both images, mm."""
    sides = []
    right = np.hstack([stereo.R, stereo.T[:, None]])
    for view in views:
        if view.left is None or view.right is None:
            continue
        common = visible_corners(view.left, view.right)
        if not common.any():
            continue
        rays = [
            cv2.undistortPoints(pixels_of(pixels[common]), M, D).reshape(-1, 2).T
            for pixels, M, D in ((view.left, stereo.M1, stereo.D1), (view.right, stereo.M2, stereo.D2))
        ]
        points = np.asarray(cv2.triangulatePoints(np.eye(3, 4), right, *rays))
        grid = np.full((board.corners, 3), np.nan)
        grid[common] = (points[:3] / points[3]).T
        by_row = grid.reshape(board.rows, board.columns, 3)
        sides += [np.linalg.norm(np.diff(by_row, axis=axis), axis=2).ravel() for axis in (0, 1)]
    lengths = np.concatenate(sides)
    lengths = lengths[np.isfinite(lengths)]
    return WithSd(float(lengths.mean()), float(lengths.std(ddof=1)))


def _plausibility(result: StereoCalibration, poses: np.ndarray) -> list[str]:
    """Warnings about views and result, in words."""
    warnings = []
    if result.pairs < VIEWS_ADVISED:
        warnings.append(f"few views: {result.pairs} pairs; errors fall until about {VIEWS_ADVISED}, take 15 to 25")
    normals = np.array([rotation_matrix(pose[:3])[:, 2] for pose in poses])
    spread = math.degrees(math.acos(min(1.0, float(np.abs(normals @ normals.T).min()))))
    if spread < TILT_ADVISED_DEG:
        warnings.append(
            f"all boards are nearly parallel (within {spread:.0f} deg): focal length and distance are not "
            "separated; tilt the board by 30 to 45 deg about both axes"
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
    if result.stereo.rms_px > PAIR_RMS_RATIO * result.alone_rms_px and result.noise_sd_px > PAIR_RMS_MIN_PX:
        warnings.append(
            f"the pair misses by {result.stereo.rms_px:.2f} px, each camera by itself by {result.alone_rms_px:.2f}: "
            "look for pictures not of one moment, or cameras that moved against each other"
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
    outlying = [view.name for view in result.views if view.outlier]
    if outlying:
        names = escaped(", ".join(outlying), 400)
        warnings.append(f"outlying views: {names}; look at their pictures, or leave them out with --robust")
    return warnings
