"""The bundle adjustment of a stereo calibration, with the 24 x 24 covariance of its cameras.

Frames: the board's x runs along its columns, y along its rows, z away from the viewer. Poses are board to left camera
(OpenCV's axes: x right, y down, z along the view), x_right = R x_left + T. mm, rad, px with the integer at a pixel's
centre.

Board poses are nuisance parameters. At every trial of the camera parameters each board is moved to its own optimum. The
remaining derivative is (1 - P) J, P being the projector on the columns of that board's pose (variable projection: Golub
and Pereyra 1973, in Kaufman's form of 1975). Its normal matrix is the Schur complement of the whole bundle adjustment:
least squares have 24 parameters for any number of views, and their covariance is marginal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tvsbayes.cameras.boards import Board, View
from tvsbayes.errors import NotConverged, NothingToEstimate
from tvsbayes.instrument.parameters import STEREO_PARAMETER_NAMES
from tvsbayes.model.compiled import compiled, placed
from tvsbayes.model.descent import Linear, descend
from tvsbayes.model.geometry import CV_FROM_S, StereoCameras, project, rotation_matrix
from tvsbayes.statistics.least_squares import LinearResidual, least_squares_covariance, linear_residual

VIEWS_PER_BUCKET, CORNERS_PER_BUCKET = 16, 32
"""Padding: calibrations of similar size share one compilation."""
POSE_STEPS, POSE_TOLERANCE = 40, 1e-20
"""Largest number of Gauss-Newton steps of a pose, and the squared step at convergence, in rad and board sizes."""
TOLERANCE, STEPS_MAX = 1e-7, 200
"""Convergence limits in whitened coordinates: ends lie within 1e-7 standard errors of the minimum, and are checked."""
RESTART_SD = 3.0
"""The repeated adjustment starts this many standard errors away in every parameter."""
RESTART_AGREEMENT_SD = 1e-2
RESTARTS_MAX, LOWER_SHARE = 4, 1e-6
"""A repetition with a lower minimum replaces the first and is itself repeated: lenses far from the model have several
minima."""
STATIONARY_SD = 1e-3
EXACT_PX = 1e-7
"""Residuals below this are rounding errors of exact corners, whose direction is meaningless."""


class BoardArrays(eqx.Module):
    """Corners of all views, padded, and the coordinates of the adjustment: parameters = origin + root z.

    Attributes:
        points_mm: corners in the board's frame, first axis x, y, z.
        corners_px: (u_left, v_left, u_right, v_right) of every view and corner.
        weight: 1 where a corner was seen, else 0.
        poses: start value of every board's rotation vector and translation (board to left camera).
        origin: the 24 parameters at z = 0.
        root: d(parameters)/dz; a fixed parameter has a zero row and column, so that every choice of fixed parameters
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
    return (weight * (project(_cameras(parameters), jnp.asarray(CV_FROM_S.T) @ left) - corners_px)).ravel()


def _pose_gain(pose, parameters, corners_px, weight, points_mm):
    """Jacobian with respect to the pose and its pseudo-inverse; zero for padding."""
    by_pose = jax.jacfwd(_view_residuals)(pose, parameters, corners_px, weight, points_mm)
    # Rotation in rad and translation in board sizes move corners equally; the ridge only serves padding.
    size = jnp.max(jnp.abs(points_mm))
    scale = jnp.concatenate([jnp.ones(3), size * jnp.ones(3)])
    scaled = by_pose * scale
    normal = scaled.T @ scaled
    ridge = jnp.where(jnp.max(weight) > 0, 0.0, 1.0)
    return by_pose, scale[:, None] * jnp.linalg.solve(normal + ridge * jnp.eye(6), scaled.T), scale


def _converged_pose(pose, parameters, corners_px, weight, points_mm):
    """The least-squares pose for given cameras, by Gauss-Newton steps from a nearby pose."""

    def not_converged(state):
        _, step2, steps = state
        return (step2 > POSE_TOLERANCE) & (steps < POSE_STEPS)

    def step(state):
        pose, _, steps = state
        _, gain, scale = _pose_gain(pose, parameters, corners_px, weight, points_mm)
        change = gain @ _view_residuals(pose, parameters, corners_px, weight, points_mm)
        return pose - change, jnp.sum((change / scale) ** 2), steps + 1

    return jax.lax.while_loop(not_converged, step, (pose, jnp.asarray(jnp.inf), 0))[0]


def _over_views(function):
    return jax.vmap(function, in_axes=(0, None, 0, 0, None))


def reduced_residuals(z: Float[Array, "24"], arrays: BoardArrays) -> Float[Array, " residuals"]:
    """All residuals with every board at its optimum, px, as a function of the cameras alone.

    Its derivative is (1 - P) J of the full problem: the effect of a change of the cameras with the boards readjusted.
    """
    parameters = arrays.origin + arrays.root @ z
    views = (arrays.corners_px, arrays.weight, arrays.points_mm)
    fixed = jax.lax.stop_gradient(parameters)
    poses = jax.lax.stop_gradient(_over_views(_converged_pose)(arrays.poses, fixed, *views))
    by_pose, gain, _ = jax.lax.stop_gradient(_over_views(_pose_gain)(poses, fixed, *views))
    residuals = _over_views(_view_residuals)(poses, parameters, *views)
    return (residuals - jnp.einsum("vrp,vps,vs->vr", by_pose, gain, residuals)).ravel()


@compiled(Linear)
def _linearised(z: Float[Array, "24"], arrays: BoardArrays) -> Linear:
    linear = linear_residual(reduced_residuals, z, arrays)
    return Linear(z, jnp.asarray(linear.value), jnp.asarray(linear.jacobian))


@dataclass(frozen=True)
class Adjustment:
    """Least squares over all views, with poses eliminated.

    Attributes:
        vector: the 24 parameters in the order of `STEREO_PARAMETER_NAMES`.
        covariance: (24, 24), type A, under `noise_sd_px` alone: independent corners.
        residuals_px: projected minus found, shape (views, 4, corners), NaN where no corner was seen.
        noise_sd_px: standard deviation of one corner coordinate, from the residuals.
        dof: degrees of freedom of `noise_sd_px`: coordinates - camera parameters - 6 per view.
        jacobian: of the residuals by the free parameters' whitened coordinates, with readjusted boards, shape (views,
            4, corners, free); 0 where no corner was seen.
        root: d(parameters)/d(whitened coordinates), (24, free).
    """

    vector: np.ndarray
    covariance: np.ndarray
    residuals_px: np.ndarray
    noise_sd_px: float
    dof: int
    jacobian: np.ndarray
    root: np.ndarray


def bundle_adjustment(
    views: Sequence[View], board: Board, start: np.ndarray, poses: np.ndarray, free: np.ndarray
) -> Adjustment:
    """Fit cameras and board poses to all corners by least squares, check the end, and repeat from another start.

    Args:
        views: at least one.
        board: the board in the views.
        start: the 24 parameters.
        poses: (views, 6), board to left camera.
        free: (24,) of bool; the other parameters keep their start.

    Raises:
        NothingToEstimate: the views do not determine all parameters.
        NotConverged: no minimum was found.
    """
    arrays = _padded(views, board, start, poses, free)
    visible = np.asarray(arrays.weight) > 0
    kept = visible.ravel()
    dof = int(kept.sum()) - int(free.sum()) - 6 * len(views)
    if dof < 1:
        raise undetermined("fewer corner coordinates than unknowns")
    zero = np.zeros(24)
    jacobian = np.asarray(_linearised(zero, arrays).jacobian)
    # Whitened at the start: a unit of z is one standard error for corners of 1 px. In their own units a focal length
    # and a k3 would share one damping.
    root = np.zeros((24, 24))
    root[np.ix_(free, free)] = _whitening(jacobian[:, free], np.flatnonzero(free))
    arrays = replace(arrays, root=placed(root))
    end, again = _ends(_descended(zero, arrays), arrays, free, dof)
    noise_sd = _noise_sd(end, dof)
    all_slopes = np.where(kept[:, None], end.jacobian, 0.0)[:, free]
    jacobian, residuals = all_slopes[kept], np.asarray(end.value)[kept]
    _check_minimum(jacobian, residuals, np.asarray(again.point - end.point)[free], noise_sd)
    try:
        z_covariance = least_squares_covariance(jacobian)
    except np.linalg.LinAlgError as error:
        raise undetermined(str(error)) from error
    residuals_px = np.full(visible.shape, np.nan)
    residuals_px[visible] = residuals
    return Adjustment(
        vector=start + root @ end.point,
        covariance=noise_sd**2 * root[:, free] @ z_covariance @ root[:, free].T,
        residuals_px=residuals_px[: len(views), :, : board.corners],
        noise_sd_px=noise_sd,
        dof=dof,
        jacobian=all_slopes.reshape(*visible.shape, -1)[: len(views), :, : board.corners],
        root=root[:, free],
    )


def _padded(views: Sequence[View], board: Board, start: np.ndarray, poses: np.ndarray, free: np.ndarray) -> BoardArrays:
    """The arrays of an adjustment padded to buckets, with coordinates in the parameters' own units."""
    count = -(-len(views) // VIEWS_PER_BUCKET) * VIEWS_PER_BUCKET
    corners = -(-board.corners // CORNERS_PER_BUCKET) * CORNERS_PER_BUCKET
    pixels, weight = np.zeros((count, 4, corners)), np.zeros((count, 4, corners))
    start_poses, points = np.zeros((count, 6)), np.zeros((3, corners))
    start_poses[:, 5] = 1.0
    start_poses[: len(views)] = poses
    points[:, : board.corners] = board.points_mm.T
    for k, view in enumerate(views):
        for side, corners_px in enumerate((view.left, view.right)):
            if corners_px is not None:
                finite = np.isfinite(corners_px.T)
                pixels[k, 2 * side : 2 * side + 2, : board.corners] = np.where(finite, corners_px.T, 0.0)
                weight[k, 2 * side : 2 * side + 2, : board.corners] = finite
    unit = np.diag(free.astype(float))
    return BoardArrays(*map(placed, (points, pixels, weight, start_poses, np.asarray(start, float), unit)))


def _check_minimum(jacobian: np.ndarray, residuals: np.ndarray, difference: np.ndarray, noise_sd: float) -> None:
    """Refuse an end that is not a minimum.

    Checks the next step of the linear model and `difference`, the deviation of the repetition, both as distances in
    standard errors for any conditioning: |J dz| / s.
    """
    next_step = float(np.linalg.norm(np.linalg.qr(jacobian)[0].T @ residuals))
    problems = []
    if not next_step <= STATIONARY_SD * noise_sd + EXACT_PX:
        problems.append(f"the next step would be {next_step / noise_sd:.2g} standard errors")
    if not float(np.linalg.norm(jacobian @ difference)) <= RESTART_AGREEMENT_SD * noise_sd + EXACT_PX:
        problems.append("a second adjustment from a start nearby ended elsewhere")
    if problems:
        raise NotConverged(
            "not-converged",
            "the bundle adjustment did not converge: " + "; ".join(problems),
            remedy="look at the pictures for wrong boards, a wrong --board, or add tilted views; five coefficients do "
            "not describe lenses that see far more than 120 deg",
        )


def _ends(end: Linear, arrays: BoardArrays, free: np.ndarray, dof: int) -> tuple[Linear, Linear]:
    """The lowest end of repeated descents, and the end of a repetition from a start near it."""
    # Alternating signs, so that the shift of one parameter does not cancel that of another.
    direction = RESTART_SD * np.where(np.arange(24) % 2, -1.0, 1.0) * free

    def repeated(end: Linear) -> Linear:
        return _descended(end.point + _noise_sd(end, dof) * direction, arrays)

    again = repeated(end)
    for _ in range(RESTARTS_MAX):
        if not _noise_sd(again, dof) < (1 - LOWER_SHARE) * _noise_sd(end, dof):
            break
        # A lower end is repeated too: compared with itself it would seem confirmed.
        end, again = again, repeated(again)
    return end, again


def _noise_sd(end: Linear, dof: int) -> float:
    """Standard deviation of one residual, px."""
    return math.sqrt(float(end.value @ end.value) / dof)


def _descended(z: np.ndarray, arrays: BoardArrays) -> Linear:
    """The end of Levenberg-Marquardt steps."""

    def linearised(at: np.ndarray) -> LinearResidual:
        linear = _linearised(at, arrays)
        residuals, jacobian = np.asarray(linear.value), np.asarray(linear.jacobian)
        return LinearResidual(residuals, jacobian, Linear(at, residuals, jacobian))

    end: Linear = descend(linearised, z, TOLERANCE, STEPS_MAX).also
    return end


def undetermined(reason: str) -> NothingToEstimate:
    """The refusal of views that do not determine all parameters."""
    return NothingToEstimate(
        "undetermined",
        f"the views do not determine the cameras: {reason}",
        remedy="add views: the board tilted by 30 to 45 deg about both axes, near and far, all over the image; "
        "see that the pitch is in millimetres",
    )


def _whitening(jacobian: np.ndarray, free: np.ndarray) -> np.ndarray:
    """W with (J W)^T (J W) = 1."""
    scale = np.linalg.norm(jacobian, axis=0)
    if not np.isfinite(jacobian).all() or not (scale > 0).all():
        raise undetermined(f"nothing depends on {STEREO_PARAMETER_NAMES[free[int(np.argmin(scale))]]}")
    _, singular, vt = np.linalg.svd(jacobian / scale, full_matrices=False)
    if singular[-1] < 1e-9 * singular[0]:
        names = [STEREO_PARAMETER_NAMES[free[k]] for k in np.argsort(-np.abs(vt[-1]))[:3]]
        raise undetermined(f"{', '.join(names)} can change together without moving a corner")
    return (vt.T / singular) / scale[:, None]
