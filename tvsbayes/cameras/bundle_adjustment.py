"""The bundle adjustment of a stereo calibration, with the 24 x 24 covariance of its cameras.

Frames: the board's x runs along its columns, y along its rows, z away from the viewer. Poses are board to left camera
(OpenCV's axes: x right, y down, z along the view), x_right = R x_left + T. mm, rad, px with the integer at a pixel's
centre; pixels of a corner are in the order u_left, v_left, u_right, v_right.

Board poses are nuisance parameters. At every trial of the camera parameters each board is moved to its own optimum. The
remaining derivative is (1 - P) J, P being the projector on the columns of that board's pose (variable projection: Golub
and Pereyra 1973, in Kaufman's form of 1975). Its normal matrix is the Schur complement of the whole bundle adjustment:
least squares have 24 parameters for any number of views, and their covariance is marginal. The corners of all boards
are one cloud of points, which OpenCV projects with its derivatives; scipy's Levenberg-Marquardt descends. No JAX.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from scipy import optimize

from tvsbayes.cameras.boards import Board, View
from tvsbayes.errors import NotConverged, NothingToEstimate
from tvsbayes.instrument.parameters import STEREO_PARAMETER_NAMES
from tvsbayes.instrument.stereo_pair import Stereo

POSE_STEPS, POSE_TOLERANCE = 40, 1e-20
"""Largest number of Gauss-Newton steps of a pose, and the squared step at convergence, in rad and board sizes."""
TOLERANCE, STEPS_MAX = 1e-14, 200
"""Convergence limits of the descent; ends lie within 1e-7 standard errors of the minimum, and are checked."""
RESTART_SD = 3.0
"""The repeated adjustment starts this many standard errors away in every parameter."""
RESTART_AGREEMENT_SD = 1e-2
RESTARTS_MAX, LOWER_SHARE = 4, 1e-6
"""A repetition with a lower minimum replaces the first and is itself repeated: lenses far from the model have several
minima."""
STATIONARY_SD = 1e-3
EXACT_PX = 1e-7
"""Residuals below this are rounding errors of exact corners, whose direction is meaningless."""


@dataclass(frozen=True)
class Projection:
    """Corners of boards in both pictures, (views, 4, corners), and their derivatives, by a further last axis.

    Attributes:
        pixels: px.
        by_cameras: by the 24 parameters in the order of `STEREO_PARAMETER_NAMES`.
        by_pose: by the six numbers of the board's pose.
        by_corner: by the corner's place on the board, px/mm.
    """

    pixels: np.ndarray
    by_cameras: np.ndarray
    by_pose: np.ndarray
    by_corner: np.ndarray


def projected(points_mm: np.ndarray, poses: np.ndarray, stereo: Stereo) -> Projection:
    """Project points of a board (corners, 3) at poses (views, 6) into both pictures."""
    rodrigues = [cv2.Rodrigues(pose[:3]) for pose in np.asarray(poses, float)]
    turns = np.array([turn for turn, _ in rodrigues])
    by_turn = np.array([slopes.reshape(3, 3, 3) for _, slopes in rodrigues])
    places = np.einsum("vxy,ny->vnx", turns, points_mm) + poses[:, None, 3:]
    shape, zero = (len(poses), len(points_mm), 2), np.zeros(3)
    # Two calls for all views. Columns of the derivatives: rotation, translation, fx, fy, cx, cy, five coefficients.
    left, right = (
        [np.reshape(part, (*shape, -1)).transpose(0, 2, 1, 3) for part in cv2.projectPoints(places.reshape(-1, 3), *by)]
        for by in ((zero, zero, stereo.M1, stereo.D1), (stereo.vector[18:21], stereo.T, stereo.M2, stereo.D2))
    )
    by_cameras = np.zeros((len(poses), 4, len(points_mm), 24))
    by_cameras[:, :2, :, :9], by_cameras[:, 2:, :, 9:18] = left[1][..., 6:15], right[1][..., 6:15]
    by_cameras[:, 2:, :, 18:] = right[1][..., :6]
    by_place = np.concatenate([left[1][..., 3:6], right[1][..., 3:6] @ stereo.R], axis=1)
    place_by_turn = np.einsum("vixy,ny->vnxi", by_turn, points_mm)
    return Projection(
        pixels=np.concatenate([left[0], right[0]], axis=1)[..., 0],
        by_cameras=by_cameras,
        by_pose=np.concatenate([np.einsum("vqnx,vnxi->vqni", by_place, place_by_turn), by_place], axis=-1),
        by_corner=np.einsum("vqnx,vxy->vqny", by_place, turns),
    )


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


class End(NamedTuple):
    """A point of a descent: coordinates, residuals with every board at its optimum, and their Jacobian."""

    z: np.ndarray
    residuals: np.ndarray
    jacobian: np.ndarray

    def noise_sd(self, dof: int) -> float:
        """Standard deviation of one residual, px."""
        return math.sqrt(float(self.residuals @ self.residuals) / dof)


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
    unseen = np.full((board.corners, 2), np.nan)
    sides = [[unseen if corners is None else corners for corners in (view.left, view.right)] for view in views]
    corners_px = np.array(sides, float).transpose(0, 1, 3, 2).reshape(len(views), 4, -1)
    seen = np.isfinite(corners_px)
    dof = int(seen.sum()) - int(free.sum()) - 6 * len(views)
    if dof < 1:
        raise undetermined("fewer corner coordinates than unknowns")

    def reduced(vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return reduced_residuals(vector, board.points_mm, corners_px, poses)

    # Whitened at the start: a unit of z is one standard error for corners of 1 px. In their own units a focal length
    # and a k3 would share one damping.
    names = np.array(STEREO_PARAMETER_NAMES)[free]
    root = np.zeros((24, len(names)))
    root[free] = _whitening(reduced(start)[1][seen][:, free], names)

    def at(z: np.ndarray) -> End:
        residuals, by_cameras = reduced(start + root @ z)
        return End(z, residuals[seen], by_cameras[seen] @ root)

    end, again = _ends(_descended(at, np.zeros(root.shape[1])), at, dof)
    noise_sd = end.noise_sd(dof)
    _check_minimum(end, again.z - end.z, noise_sd)
    by_end = root @ _whitening(end.jacobian, names)
    residuals_px, jacobian = np.full(seen.shape, np.nan), np.zeros((*seen.shape, root.shape[1]))
    residuals_px[seen], jacobian[seen] = end.residuals, end.jacobian
    return Adjustment(
        vector=start + root @ end.z,
        covariance=noise_sd**2 * by_end @ by_end.T,
        residuals_px=residuals_px,
        noise_sd_px=noise_sd,
        dof=dof,
        jacobian=jacobian,
        root=root,
    )


def reduced_residuals(
    vector: np.ndarray, points_mm: np.ndarray, corners_px: np.ndarray, poses: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (views, 4, corners) with every board at its optimum, px, and their derivatives (..., 24).

    The derivative is (1 - P) J of the full problem: the effect of a change of the cameras with boards readjusted.

    Args:
        vector: the 24 parameters.
        points_mm: corners in the board's frame, (corners, 3).
        corners_px: found corners, (views, 4, corners), NaN where unseen: there the results are 0.
        poses: poses near the optimum, (views, 6).

    Returns:
        NaN where cameras are so far off that a board has no pose.
    """
    stereo, seen = Stereo.of_vector(vector, (0, 0)), np.isfinite(corners_px)
    # Rotation in rad and translation in board sizes move corners equally.
    scale = np.repeat([1.0, np.abs(points_mm).max()], 3)
    for _ in range(POSE_STEPS):
        now = projected(points_mm, poses, stereo)
        residuals = np.where(seen, now.pixels - corners_px, 0.0).reshape(len(poses), -1)
        by_pose = (now.by_pose * seen[..., None] * scale).reshape(len(poses), -1, 6)
        transposed = by_pose.transpose(0, 2, 1)
        try:
            gain = np.linalg.solve(transposed @ by_pose, transposed)
        except np.linalg.LinAlgError:
            # A board without a pose: residuals that are not finite make the descent take a shorter step.
            gain = np.full_like(transposed, np.nan)
        steps = np.einsum("vpr,vr->vp", gain, residuals)
        if not (steps**2).sum(axis=1).max() > POSE_TOLERANCE:
            break
        poses = poses - steps * scale
    by_cameras = (now.by_cameras * seen[..., None]).reshape(len(poses), -1, 24)
    residuals -= np.einsum("vrp,vp->vr", by_pose, steps)
    by_cameras -= by_pose @ (gain @ by_cameras)
    return residuals.reshape(seen.shape), by_cameras.reshape(*seen.shape, 24)


def _check_minimum(end: End, difference: np.ndarray, noise_sd: float) -> None:
    """Refuse an end that is not a minimum.

    Checks the next step of the linear model and `difference`, the deviation of the repetition, both as distances in
    standard errors for any conditioning: |J dz| / s.
    """
    next_step = float(np.linalg.norm(np.linalg.qr(end.jacobian)[0].T @ end.residuals))
    problems = []
    if not next_step <= STATIONARY_SD * noise_sd + EXACT_PX:
        problems.append(f"the next step would be {next_step / noise_sd:.2g} standard errors")
    if not float(np.linalg.norm(end.jacobian @ difference)) <= RESTART_AGREEMENT_SD * noise_sd + EXACT_PX:
        problems.append("a second adjustment from a start nearby ended elsewhere")
    if problems:
        raise NotConverged(
            "not-converged",
            "the bundle adjustment did not converge: " + "; ".join(problems),
            remedy="look at the pictures for wrong boards, a wrong --board, or add tilted views; five coefficients do "
            "not describe lenses that see far more than 120 deg",
        )


def _ends(end: End, at: Callable[[np.ndarray], End], dof: int) -> tuple[End, End]:
    """The lowest end of repeated descents, and the end of a repetition from a start near it."""

    def repeated(end: End) -> End:
        # Alternating signs, so that the shift of one parameter does not cancel that of another.
        signs = np.where(np.arange(len(end.z)) % 2, -1.0, 1.0)
        return _descended(at, end.z + RESTART_SD * end.noise_sd(dof) * signs)

    again = repeated(end)
    for _ in range(RESTARTS_MAX):
        if not again.noise_sd(dof) < (1 - LOWER_SHARE) * end.noise_sd(dof):
            break
        # A lower end is repeated too: compared with itself it would seem confirmed.
        end, again = again, repeated(again)
    return end, again


def _descended(at: Callable[[np.ndarray], End], z: np.ndarray) -> End:
    """The end of Levenberg-Marquardt steps; the start itself where residuals are not finite."""
    last = at(z)
    if not np.isfinite(last.residuals).all():
        return last

    def point(z: np.ndarray) -> End:
        nonlocal last
        if not np.array_equal(z, last.z):
            last = at(z.copy())
        return last

    found = optimize.least_squares(
        lambda z: point(z).residuals,
        z,
        lambda z: point(z).jacobian,
        **{"method": "lm", "max_nfev": STEPS_MAX, "ftol": TOLERANCE, "xtol": TOLERANCE, "gtol": TOLERANCE},
    )
    # The sum of squares stops to fall 1e-6 standard errors from its minimum: one Gauss-Newton step more.
    end = point(found.x)
    if not np.isfinite(end.jacobian).all():
        return end
    further = at(end.z - np.linalg.lstsq(end.jacobian, end.residuals)[0])
    # From an end that is no minimum a whole step may lead anywhere.
    return further if further.noise_sd(1) <= (1 + LOWER_SHARE) * end.noise_sd(1) + EXACT_PX else end


def undetermined(reason: str) -> NothingToEstimate:
    """The refusal of views that do not determine all parameters."""
    return NothingToEstimate(
        "undetermined",
        f"the views do not determine the cameras: {reason}",
        remedy="add views: the board tilted by 30 to 45 deg about both axes, near and far, all over the image; "
        "see that the pitch is in millimetres",
    )


def _whitening(jacobian: np.ndarray, names: np.ndarray) -> np.ndarray:
    """W with (J W)^T (J W) = 1, so that W W^T = (J^T J)^-1; `names` of the columns are for the refusal."""
    scale = np.linalg.norm(jacobian, axis=0)
    if not np.isfinite(jacobian).all() or not (scale > 0).all():
        raise undetermined(f"nothing depends on {names[np.argmin(scale)]}")
    _, singular, vt = np.linalg.svd(jacobian / scale, full_matrices=False)
    if singular[-1] < 1e-9 * singular[0]:
        together = names[np.argsort(-np.abs(vt[-1]))[:3]]
        raise undetermined(f"{', '.join(together)} can change together without moving a corner")
    return (vt.T / singular) / scale[:, None]
