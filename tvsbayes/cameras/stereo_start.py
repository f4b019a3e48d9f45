"""Start values of a stereo calibration: each camera alone (Zhang 2000), the median relative pose, a pose per board.

Poses are board to camera, (6,): Rodrigues vector, then mm; OpenCV's axes (x right, y down, z along the view);
x_right = R x_left + T. px with the integer at a pixel's centre.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from tvsbayes.cameras.boards import Board, View, corner_orders
from tvsbayes.cameras.bundle_adjustment import undetermined
from tvsbayes.errors import NothingToEstimate, escaped
from tvsbayes.instrument.campaign import CAMERAS
from tvsbayes.instrument.stereo_pair import Stereo, rotation_matrix, rotation_vector

VIEWS_MIN = 3
"""Least views per camera: Zhang's method (2000) cannot find focal length and principal point from fewer."""
START_VIEWS = 30
"""Largest number of views for the start; further views enter the bundle adjustment only."""
MISMATCH_RATIO, MISMATCH_SHARE = 5.0, 0.01
"""Limits of the distance of right corners from those predicted by the left ones and the relative pose of most pairs. A
view beyond both (medians over views, share of the image width) is not a pair."""
POSE_CORNERS_MIN = 6
"""Least number of corners seen by both cameras in a pair for OpenCV's start."""
DOUBTFUL_START_PX = 0.6
"""Rms of one camera above which it may be in a local minimum: corners are accurate to 0.05 to 0.3 px."""
DISAGREE_SHARE = 0.05
"""Median deviation of pairs, over the image width, above which they contradict one pose of the cameras: real pairs have
0.1 to 1 % with narrow or wide lenses, pairs of different moments 5 to 50 %."""


@dataclass(frozen=True)
class CameraStart:
    """Zhang's solution for one camera: matrix, distortion, a pose (6,) for each of its views, rms over corners."""

    matrix: np.ndarray
    distortion: np.ndarray
    poses: dict[int, np.ndarray]
    rms_px: float

    @property
    def vector(self) -> np.ndarray:
        """The nine intrinsic parameters in the order of `Stereo.vector`."""
        return np.array([*self.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *self.distortion])


@dataclass(frozen=True)
class Start:
    """Start values of the adjustment.

    Attributes:
        vector: the 24 parameters.
        poses: poses of the boards, (views, 6).
        views: the given views, right corners in the order in which most pairs agree.
        turned: names of views with reordered right corners.
        mismatched: mask of views that are not a pair, (views,).
        alone_rms_px: rms over the corners of both cameras, each calibrated alone.
    """

    vector: np.ndarray
    poses: np.ndarray
    views: tuple[View, ...]
    turned: tuple[str, ...]
    mismatched: np.ndarray
    alone_rms_px: float


def start_of(views: Sequence[View], board: Board, size: tuple[int, int], fix_k3: bool) -> Start:
    """Find start values of both cameras and of all boards.

    Raises:
        NothingToEstimate: too few views of a camera, no pair, pairs that disagree, or no start that OpenCV can find.
    """
    cameras = []
    for side in CAMERAS:
        corners = {k: getattr(v, side) for k, v in enumerate(views) if getattr(v, side) is not None}
        cameras.append(camera_start(corners, board, size, side, fix_k3))
    left, right = cameras
    relative = _relation(views, board, left, right, MISMATCH_SHARE * size[0])
    limit = max(MISMATCH_RATIO * relative.usual_px, MISMATCH_SHARE * size[0])
    mismatched = [k for k, miss in relative.misses.items() if miss > limit]
    if relative.usual_px > DISAGREE_SHARE * size[0]:
        agreeing = [
            escaped(views[k].name, 40) for k, miss in relative.misses.items() if miss <= MISMATCH_SHARE * size[0]
        ]
        reason = f"most of the {len(relative.misses)} pairs miss by {relative.usual_px:.0f} px and more"
        raise pairs_disagree(reason + (f"; only {', '.join(agreeing)} agree" if len(agreeing) > 1 else ""))
    rotation, shift = rotation_matrix(relative.pose[:3]), relative.pose[3:]
    poses, agreed, turned = [], list(views), []
    for k, view in enumerate(views):
        poses.append(left.poses[k] if k in left.poses else left_pose(right.poses[k], rotation, shift))
        if relative.orders.get(k, 0) and k not in mismatched:
            assert view.right is not None
            agreed[k] = replace(view, right=view.right[corner_orders(board)[relative.orders[k]]])
            turned.append(view.name)
    return Start(
        vector=np.concatenate([left.vector, right.vector, relative.pose]),
        poses=np.array(poses),
        views=tuple(agreed),
        turned=tuple(turned),
        mismatched=np.isin(np.arange(len(views)), mismatched),
        alone_rms_px=math.sqrt((left.rms_px**2 + right.rms_px**2) / 2),
    )


def opencv_start(start: Start, board: Board, size: tuple[int, int], fix_k3: bool) -> Start:
    """Run cv2.stereoCalibrate on up to `START_VIEWS` pairs, for views with more than one minimum.

    Raises:
        NothingToEstimate: OpenCV finds no pair.
    """
    pairs = [k for k, view in enumerate(start.views) if view.left is not None and view.right is not None]
    both = {k: visible_corners(start.views[k].left, start.views[k].right) for k in _spread(pairs)}
    both = {k: visible for k, visible in both.items() if visible.sum() >= POSE_CORNERS_MIN}
    left, right = (
        [np.asarray(getattr(start.views[k], side)[visible], np.float32) for k, visible in both.items()]
        for side in CAMERAS
    )
    pair = Stereo.of_vector(start.vector, size)
    points = [board.points_mm[visible].astype(np.float32) for visible in both.values()]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | (cv2.CALIB_FIX_K3 if fix_k3 else 0)
    try:
        _, M1, D1, M2, D2, R, T, _, _, turns, shifts, _ = cv2.stereoCalibrateExtended(
            points, left, right, pair.M1, pair.D1, pair.M2, pair.D2, size, np.eye(3), np.zeros((3, 1)), flags=flags
        )
    except cv2.error as error:
        raise undetermined(f"OpenCV found no pair ({escaped(str(error.err), 100)})") from error
    vector = replace(pair, M1=M1, D1=np.ravel(D1)[:5], M2=M2, D2=np.ravel(D2)[:5], R=R, T=np.ravel(T)).vector
    if not np.isfinite(vector).all():
        raise undetermined("OpenCV found no finite pair")
    calibrated = pair.with_vector(vector)
    board_poses = {k: np.concatenate([np.ravel(t), np.ravel(s)]) for k, t, s in zip(both, turns, shifts, strict=True)}
    poses = [
        board_poses[k] if k in board_poses else pose_of(view, board, calibrated) for k, view in enumerate(start.views)
    ]
    return replace(start, vector=vector, poses=np.array(poses))


def _spread(views: Sequence[int]) -> list[int]:
    """At most `START_VIEWS` numbers of views, spread evenly over all."""
    return [views[k] for k in np.unique(np.linspace(0, len(views) - 1, START_VIEWS).astype(int))]


def pairs_disagree(reason: str) -> NothingToEstimate:
    """The refusal of pairs that contradict one pose of the cameras."""
    return NothingToEstimate(
        "pairs-disagree",
        f"the pairs contradict each other: {reason}",
        allowed="pictures of one moment, by cameras that are fixed to each other",
        remedy="check that the pictures named alike were taken together (none left out on one side, both cameras "
        "triggered or the board held still) and that no camera moved; leave out the others",
    )


def camera_start(
    corners: dict[int, np.ndarray], board: Board, size: tuple[int, int], side: str, fix_k3: bool
) -> CameraStart:
    """Zhang's method (cv2.calibrateCamera) on some views, then a pose for each."""
    if len(corners) < VIEWS_MIN:
        raise NothingToEstimate(
            "few-views",
            f"the board was found in {len(corners)} pictures of the {side} camera; {VIEWS_MIN} are the least",
            remedy="check --board (inner corners: where four squares meet), that the whole board is in the picture, "
            "sharpness and light; take 15 to 25 views",
        )
    keys = sorted(corners)
    chosen = _spread(keys)
    points = [board.points_mm[visible_corners(corners[k])].astype(np.float32) for k in chosen]
    pixels = [np.ascontiguousarray(corners[k][visible_corners(corners[k])], np.float32) for k in chosen]
    start = _zhang(points, pixels, size, side, cv2.CALIB_FIX_K3 if fix_k3 else 0)
    if start.rms_px > DOUBTFUL_START_PX:
        # Wide lenses have local minima: fit k1 alone first, then all coefficients from there.
        simple = cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_PRINCIPAL_POINT
        first = _zhang(points, pixels, size, side, simple)
        flags = cv2.CALIB_USE_INTRINSIC_GUESS | (cv2.CALIB_FIX_K3 if fix_k3 else 0)
        start = min(start, _zhang(points, pixels, size, side, flags, first), key=lambda candidate: candidate.rms_px)
    matrix, distortion = start.matrix, start.distortion
    poses = {k: board_pose(corners[k], board, matrix, distortion) for k in keys}
    return replace(start, poses=poses)


def _zhang(
    points: Sequence[np.ndarray],
    pixels: Sequence[np.ndarray],
    size: tuple[int, int],
    side: str,
    flags: int,
    first: CameraStart | None = None,
) -> CameraStart:
    """cv2.calibrateCamera under `flags`, from `first` where given; no poses.

    Raises:
        NothingToEstimate: OpenCV finds no solution.
    """
    matrix, distortion = (None, None) if first is None else (first.matrix.copy(), first.distortion.copy())
    try:
        rms, matrix, distortion, *_ = cv2.calibrateCamera(points, pixels, size, matrix, distortion, flags=flags)
    except cv2.error as error:
        raise undetermined(f"OpenCV found no start for the {side} camera ({escaped(str(error.err), 100)})") from error
    matrix, distortion = np.asarray(matrix, float), np.asarray(distortion, float).ravel()[:5]
    if not (np.isfinite(matrix).all() and np.isfinite(distortion).all()):
        raise undetermined(f"OpenCV found no finite start for the {side} camera")
    return CameraStart(matrix, distortion, {}, float(rms))


@dataclass(frozen=True)
class _Relation:
    """The relative pose of the cameras: R and T, (6,), and its residuals.

    Attributes:
        pose: rotation vector and translation.
        misses: rms distance of the right corners from those predicted from the left ones, px, by pair.
        orders: the best of `corner_orders` for the right corners, by pair.
    """

    pose: np.ndarray
    misses: dict[int, float]
    orders: dict[int, int]

    @property
    def usual_px(self) -> float:
        """The median of the misses (the upper one of two)."""
        return sorted(self.misses.values())[len(self.misses) // 2]


def _relation(views: Sequence[View], board: Board, left: CameraStart, right: CameraStart, limit_px: float) -> _Relation:
    """Find the relation in which most pairs agree.

    First the corners keep their order: the median over pairs is robust against one wrong pair. Where most misses exceed
    `limit_px`, every pair in every order is tried, and the one with the least median miss is used (least median of
    squares: Rousseeuw 1984), which is robust against half turns of a symmetric board and many wrong pairs.
    """
    pairs = sorted(set(left.poses) & set(right.poses))
    if not pairs:
        raise NothingToEstimate(
            "no-pairs",
            "no view shows the board to both cameras",
            remedy="name the pictures of one moment alike: left01.png and right01.png",
        )
    orders = corner_orders(board)
    turns = np.linalg.lstsq(board.points_mm[:, :2], np.hstack([board.points_mm[order, :2] for order in orders]))[0]

    def relative(k: int, order: int) -> np.ndarray:
        # In another order, corner i is another corner of the board, i.e. the board is turned in its plane.
        turn = np.eye(3)
        turn[:2, :2] = turns[:, 2 * order : 2 * order + 2].T
        rotation = rotation_matrix(right.poses[k][:3]) @ turn @ rotation_matrix(left.poses[k][:3]).T
        return np.concatenate([rotation_vector(rotation), right.poses[k][3:] - rotation @ left.poses[k][3:]])

    def judge(pose: np.ndarray) -> _Relation:
        misses, nearest = {}, {}
        for k in pairs:
            by_order = _misses(views[k], board, left.poses[k], pose, right)
            nearest[k] = int(np.argmin(by_order))
            misses[k] = float(by_order[nearest[k]])
        return _Relation(pose, misses, nearest)

    agreed = judge(_median_pose([relative(k, 0) for k in pairs]))
    if agreed.usual_px > limit_px and len(pairs) > 2:
        tried = (judge(relative(k, order)) for k in _spread(pairs) for order in range(len(orders)))
        best = min(tried, key=lambda r: r.usual_px)
        near = [k for k in pairs if best.misses[k] <= best.usual_px]
        agreed = min(best, judge(_median_pose([relative(k, best.orders[k]) for k in near])), key=lambda r: r.usual_px)
    return agreed


def _median_pose(poses: Sequence[np.ndarray]) -> np.ndarray:
    rotation = np.median([rotation_matrix(pose[:3]) for pose in poses], axis=0)
    return np.concatenate([rotation_vector(rotation), np.median([pose[3:] for pose in poses], axis=0)])


def _misses(view: View, board: Board, pose: np.ndarray, relation: np.ndarray, right: CameraStart) -> np.ndarray:
    """Rms distance of the right corners from those predicted from a board's left pose, px, by corner order."""
    rotation, shift = rotation_matrix(relation[:3]), relation[3:]
    predicted = rotation_vector(rotation @ rotation_matrix(pose[:3])), rotation @ pose[3:] + shift
    pixels, _ = cv2.projectPoints(board.points_mm, *predicted, right.matrix, right.distortion)
    assert view.right is not None
    ordered = np.stack([view.right[order] for order in corner_orders(board)])
    return np.sqrt(np.nanmean(np.sum((ordered - np.reshape(pixels, (-1, 2))) ** 2, axis=2), axis=1))


def board_pose(corners: np.ndarray, board: Board, matrix: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Board to camera, shape (6,), from one picture: IPPE (Collins and Bartoli 2014), then least squares in px."""
    visible = visible_corners(corners)
    points, pixels = board.points_mm[visible], pixels_of(corners[visible])
    solved, turn, shift = cv2.solvePnP(points, pixels, matrix, distortion, flags=cv2.SOLVEPNP_IPPE)
    if not solved or not (np.isfinite(turn).all() and np.isfinite(shift).all()):
        raise undetermined("a board has no pose that OpenCV can find")
    # IPPE undistorts by a few iterations, which is not enough at the edge of a wide lens.
    turn, shift = cv2.solvePnPRefineLM(points, pixels, matrix, distortion, turn, shift)
    return np.concatenate([np.ravel(turn), np.ravel(shift)])


def pose_of(view: View, board: Board, stereo: Stereo) -> np.ndarray:
    """Board to left camera, from the left camera's picture where it shows the board."""
    if view.left is not None:
        return board_pose(view.left, board, stereo.M1, stereo.D1)
    assert view.right is not None
    return left_pose(board_pose(view.right, board, stereo.M2, stereo.D2), stereo.R, stereo.T)


def left_pose(right_pose: np.ndarray, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Board to left camera from board to right camera; `turn` is R, `shift` T."""
    rotation = rotation_vector(turn.T @ rotation_matrix(right_pose[:3]))
    return np.concatenate([rotation, turn.T @ (right_pose[3:] - shift)])


def visible_corners(*corners: np.ndarray | None) -> np.ndarray:
    """Mask of the corners (corners,) that all given pictures show."""
    return np.logical_and.reduce([np.isfinite(points).all(axis=1) for points in corners if points is not None])


def pixels_of(corners: np.ndarray) -> np.ndarray:
    """Corners (corners, 2) in the form that all versions of OpenCV accept: contiguous, of rank 3."""
    return np.ascontiguousarray(corners, float).reshape(-1, 1, 2)
