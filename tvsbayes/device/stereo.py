"""Stereo calibration from checkerboard corners: Zhang's start, bundle adjustment with its 24 x 24 covariance.

Frames: the board's x runs along its columns, y along its rows, z away from the viewer; poses are board to left camera
(OpenCV's axes: x right, y down, z along the view), x_right = R x_left + T. mm, rad, px with the integer at a pixel's
centre.

Board poses are nuisances. At every trial of the camera parameters each board is moved to its own optimum, and the
derivative of what remains is (1 - P) J, P the projector on the columns of that board's pose (variable projection:
Golub and Pereyra 1973, in Kaufman's form of 1975). Its normal matrix is the Schur complement of the whole bundle
adjustment: the least squares see 24 parameters whatever the number of views, and their covariance is marginal.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tvsbayes.device.boards import SIDES, Board, Finder, View, Views, find_views
from tvsbayes.files import NotConverged, NothingToEstimate, escaped
from tvsbayes.joint import least_squares_covariance, levenberg_marquardt, residuals_and_jacobian
from tvsbayes.model import CV_FROM_S, StereoCameras, project, rotation_matrix
from tvsbayes.rigs import STEREO_PARAMETER_NAMES, Stereo, pair_doubts, rotation_vector
from tvsbayes.rigs import rotation_matrix as rotation_of

VIEWS_MIN = 3
"""Views per camera below which Zhang's method (2000) cannot find a focal length with both principal coordinates."""
START_VIEWS = 30
"""The start needs no more; every further view enters the bundle adjustment alone."""
VIEWS_PER_BUCKET, CORNERS_PER_BUCKET = 16, 32
"""Padding: calibrations of like size share one compilation."""
POSE_STEPS, POSE_TOLERANCE = 40, 1e-20
"""Gauss-Newton steps of a pose, and the squared step, in units of rad and board sizes, at which it is settled."""
TOLERANCE, STEPS_MAX = 1e-7, 200
"""In whitened coordinates this ended within 1e-7 standard errors of the minimum; the end is checked all the same."""
RESTART_SD = 3.0
"""The repeated adjustment starts this many standard errors away in every parameter."""
RESTART_AGREEMENT_SD = 1e-2
STATIONARY_SD = 1e-3
EXACT_PX = 1e-7
"""Exact corners leave rounding errors, whose direction means nothing."""

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


class BoardArrays(eqx.Module):
    """Corners of all views, padded, and the coordinates of the adjustment: parameters = origin + root z.

    Attributes:
        points_mm: corners in the board's frame, first axis x, y, z.
        corners_px: (u_left, v_left, u_right, v_right) of every view and corner.
        weight: 1 where a corner was seen, else 0.
        poses: start of every board's rotation vector and translation (board to left camera).
        origin: the 24 parameters at z = 0.
        root: d(parameters)/dz; a fixed parameter has a zero row and column, so that every choice of fixed ones
            shares one compilation.
    """

    points_mm: Float[Array, "3 corners"]
    corners_px: Float[Array, "views 4 corners"]
    weight: Float[Array, "views 4 corners"]
    poses: Float[Array, "views 6"]
    origin: Float[Array, "24"]
    root: Float[Array, "24 24"]


def _cameras(parameters: Float[Array, "24"]) -> StereoCameras:
    intrinsics = parameters[:18].reshape(2, 9)
    return StereoCameras(
        focal_px=intrinsics[:, 0:2],
        centre_px=intrinsics[:, 2:4],
        radial=intrinsics[:, jnp.array([4, 5, 8])],
        tangential=intrinsics[:, 6:8],
        rotation_rad=parameters[18:21],
        translation_mm=parameters[21:24],
        focal_scale=jnp.ones(()),
    )


def _view_residuals(
    pose: Float[Array, "6"],
    parameters: Float[Array, "24"],
    corners_px: Float[Array, "4 corners"],
    weight: Float[Array, "4 corners"],
    points_mm: Float[Array, "3 corners"],
) -> Float[Array, " residuals"]:
    """Projected minus found corners of one view, px; 0 where none was seen."""
    left = rotation_matrix(pose[:3]) @ points_mm + pose[3:, None]
    return (weight * (project(_cameras(parameters), CV_FROM_S.T @ left) - corners_px)).ravel()


def _pose_gain(pose, parameters, corners_px, weight, points_mm):
    """Jacobian by the pose and its pseudo-inverse; zero for padding."""
    by_pose = jax.jacfwd(_view_residuals)(pose, parameters, corners_px, weight, points_mm)
    # Rotation in rad and translation in board sizes change corners alike; the ridge only serves padding.
    size = jnp.max(jnp.abs(points_mm))
    scale = jnp.concatenate([jnp.ones(3), size * jnp.ones(3)])
    scaled = by_pose * scale
    normal = scaled.T @ scaled
    ridge = jnp.where(jnp.max(weight) > 0, 0.0, 1.0)
    return by_pose, scale[:, None] * jnp.linalg.solve(normal + ridge * jnp.eye(6), scaled.T), scale


def _settled_pose(pose, parameters, corners_px, weight, points_mm):
    """The pose of least squares for given cameras, by Gauss-Newton steps from a pose nearby."""

    def unsettled(state):
        _, step2, steps = state
        return (step2 > POSE_TOLERANCE) & (steps < POSE_STEPS)

    def step(state):
        pose, _, steps = state
        _, gain, scale = _pose_gain(pose, parameters, corners_px, weight, points_mm)
        change = gain @ _view_residuals(pose, parameters, corners_px, weight, points_mm)
        return pose - change, jnp.sum((change / scale) ** 2), steps + 1

    return jax.lax.while_loop(unsettled, step, (pose, jnp.asarray(jnp.inf), 0))[0]


def _over_views(function):
    return jax.vmap(function, in_axes=(0, None, 0, 0, None))


def reduced_residuals(z: Float[Array, "24"], arrays: BoardArrays) -> Float[Array, " residuals"]:
    """All residuals with every board at its optimum, px, as a function of the cameras alone.

    Its derivative is (1 - P) J of the full problem: what a change of the cameras leaves after the boards have
    followed.
    """
    parameters = arrays.origin + arrays.root @ z
    seen = (arrays.corners_px, arrays.weight, arrays.points_mm)
    fixed = jax.lax.stop_gradient(parameters)
    poses = jax.lax.stop_gradient(_over_views(_settled_pose)(arrays.poses, fixed, *seen))
    by_pose, gain, _ = jax.lax.stop_gradient(_over_views(_pose_gain)(poses, fixed, *seen))
    residuals = _over_views(_view_residuals)(poses, parameters, *seen)
    return (residuals - jnp.einsum("vrp,vps,vs->vr", by_pose, gain, residuals)).ravel()


@dataclass(frozen=True)
class Adjustment:
    """Least squares over all views, poses eliminated.

    Attributes:
        vector: the 24 parameters in the order of `STEREO_PARAMETER_NAMES`.
        covariance: (24, 24), type A, under `noise_sd_px` alone: independent corners.
        residuals_px: projected minus found, shape (views, 4, corners), NaN where no corner was seen.
        noise_sd_px: standard deviation of one corner coordinate, from the residuals.
        dof: degrees of freedom behind it: coordinates - camera parameters - 6 per view.
        correlation_factor: see `correlation_factor`.
    """

    vector: np.ndarray
    covariance: np.ndarray
    residuals_px: np.ndarray
    noise_sd_px: float
    dof: int
    correlation_factor: float


def correlation_factor(jacobian: np.ndarray, residuals: np.ndarray, views: np.ndarray, noise_sd: float) -> float:
    """How much larger the scores of whole views are than independent corners would make them; at least 1.

    Corner errors of one picture have common causes (light, defocus, a lens that is not quite the model, a bent
    board): they are not independent, and (J^T J)^-1 s^2 is then too small. The score of view i, J_i^T r_i, shows
    it: independent errors give the sum of |J_i^T r_i|^2 in coordinates where J^T J = 1 the expectation
    s^2 (p - sum_i tr (J_i^T J_i)^2), the second term for the residuals having been fitted. The ratio scales the
    covariance: the cluster-robust variance of Liang and Zeger (1986) reduced to one number, since a dozen views
    cannot support a 24 x 24 matrix of them. Errors common to ALL views stay unseen.

    Args:
        jacobian: (residuals, p), of full rank.
        residuals: (residuals,).
        views: (residuals,), which view each belongs to, numbered from 0.
        noise_sd: s.
    """
    q, _ = np.linalg.qr(jacobian / np.linalg.norm(jacobian, axis=0))
    count = int(views.max()) + 1
    score, lost = 0.0, 0.0
    for view in range(count):
        rows = q[views == view]
        score += float(np.sum((rows.T @ residuals[views == view]) ** 2))
        lost += float(np.sum((rows.T @ rows) ** 2))
    expected = noise_sd**2 * (q.shape[1] - lost)
    return max(1.0, score / expected) if expected > 1e-3 * noise_sd**2 else 1.0


def bundle_adjustment(
    views: Sequence[View], board: Board, start: np.ndarray, poses: np.ndarray, free: np.ndarray
) -> Adjustment:
    """Least squares of all corners over cameras and board poses, checked at its end and repeated from another start.

    Args:
        views: at least one.
        board: whose corners they hold.
        start: the 24 parameters.
        poses: (views, 6), board to left camera.
        free: (24,) of bool; the others keep their start.

    Raises:
        NothingToEstimate: the views leave a combination of parameters open.
        NotConverged: no minimum was found.
    """
    count = -(-len(views) // VIEWS_PER_BUCKET) * VIEWS_PER_BUCKET
    corners = -(-board.corners // CORNERS_PER_BUCKET) * CORNERS_PER_BUCKET
    seen, weight = np.zeros((count, 4, corners)), np.zeros((count, 4, corners))
    start_poses, points = np.zeros((count, 6)), np.zeros((3, corners))
    start_poses[:, 5] = 1.0
    start_poses[: len(views)] = poses
    points[:, : board.corners] = board.points_mm.T
    for k, view in enumerate(views):
        for side, found in enumerate((view.left, view.right)):
            if found is not None:
                seen[k, 2 * side : 2 * side + 2, : board.corners] = found.T
                weight[k, 2 * side : 2 * side + 2, : board.corners] = 1.0
    kept = (weight > 0).ravel()
    view_of = np.repeat(np.arange(count), 4 * corners)[kept]
    dof = int(kept.sum()) - int(free.sum()) - 6 * len(views)
    if dof < 1:
        raise _undetermined("fewer corner coordinates than unknowns")
    with jax.enable_x64(True):
        unit = np.diag(free.astype(float))
        arrays = BoardArrays(*map(jnp.asarray, (points, seen, weight, start_poses, np.asarray(start, float), unit)))
        zero = np.zeros(24)
        jacobian = np.asarray(residuals_and_jacobian(reduced_residuals, jnp.asarray(zero), arrays)[1])
        # Whitened at the start: a unit of z is one standard error for corners of 1 px. In their own units a focal
        # length and a k3 would share one damping.
        root = np.zeros((24, 24))
        root[np.ix_(free, free)] = _whitening(jacobian[:, free], np.flatnonzero(free))
        arrays = replace(arrays, root=jnp.asarray(root))
        value, residuals, jacobian = _descended(zero, arrays)
        noise_sd = math.sqrt(float(residuals @ residuals) / dof)
        # Alternating signs, so that no parameter's shift can be taken up by another's.
        shift = RESTART_SD * noise_sd * np.where(np.arange(24) % 2, -1.0, 1.0) * free
        again = _descended(value + shift, arrays)[0]
        jacobian, residuals = jacobian[kept][:, free], residuals[kept]
        # What the linear model would still move, and where the repetition ended, both as distances in standard errors
        # whatever the conditioning: |J dz| / s.
        left = float(np.linalg.norm(np.linalg.qr(jacobian)[0].T @ residuals))
        apart = float(np.linalg.norm(jacobian @ (again - value)[free]))
        problems = []
        if not left <= STATIONARY_SD * noise_sd + EXACT_PX:
            problems.append(f"the next step would be {left / noise_sd:.2g} standard errors")
        if not apart <= RESTART_AGREEMENT_SD * noise_sd + EXACT_PX:
            problems.append("a second adjustment from a start nearby ended elsewhere")
        if problems:
            raise NotConverged(
                "not-converged",
                "the bundle adjustment did not converge: " + "; ".join(problems),
                remedy="look at the pictures for wrong boards, a wrong --board, or add tilted views",
            )
        try:
            z_covariance = least_squares_covariance(jacobian)
        except np.linalg.LinAlgError as error:
            raise _undetermined(str(error)) from error
    placed = np.full(weight.shape, np.nan)
    placed[weight > 0] = residuals
    factor = correlation_factor(jacobian, residuals, view_of, noise_sd)
    return Adjustment(
        vector=start + root @ value,
        covariance=noise_sd**2 * root[:, free] @ z_covariance @ root[:, free].T,
        residuals_px=placed[: len(views), :, : board.corners],
        noise_sd_px=noise_sd,
        dof=dof,
        correlation_factor=factor,
    )


def _descended(z: np.ndarray, arrays: BoardArrays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where Levenberg-Marquardt ends, with residuals and Jacobian there."""
    tolerance = jnp.asarray(TOLERANCE)
    end = levenberg_marquardt(reduced_residuals, jnp.asarray(z), arrays, tolerance, STEPS_MAX)
    residuals, jacobian = residuals_and_jacobian(reduced_residuals, end, arrays)
    return np.asarray(end), np.asarray(residuals), np.asarray(jacobian)


def _undetermined(reason: str) -> NothingToEstimate:
    return NothingToEstimate(
        "undetermined",
        f"the views do not determine the cameras: {reason}",
        remedy="add views: the board tilted by 30 to 45 deg about both axes, near and far, all over the image",
    )


def _whitening(jacobian: np.ndarray, free: np.ndarray) -> np.ndarray:
    """W with (J W)^T (J W) = 1."""
    scale = np.linalg.norm(jacobian, axis=0)
    if not np.isfinite(jacobian).all() or not (scale > 0).all():
        raise _undetermined(f"nothing depends on {STEREO_PARAMETER_NAMES[free[int(np.argmin(scale))]]}")
    _, singular, vt = np.linalg.svd(jacobian / scale, full_matrices=False)
    if singular[-1] < 1e-9 * singular[0]:
        names = [STEREO_PARAMETER_NAMES[free[k]] for k in np.argsort(-np.abs(vt[-1]))[:3]]
        raise _undetermined(f"{', '.join(names)} can change together without moving a corner")
    return (vt.T / singular) / scale[:, None]


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
        raise _undetermined(f"OpenCV found no start for the {side} camera ({escaped(str(error.err), 100)})") from error
    matrix, distortion = np.asarray(matrix, float), np.asarray(distortion, float).ravel()[:5]
    if not (np.isfinite(matrix).all() and np.isfinite(distortion).all()):
        raise _undetermined(f"OpenCV found no finite start for the {side} camera")
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
        raise _undetermined("a board has no pose that OpenCV can find")
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
