"""Start values of a stereo calibration: each camera alone (Zhang 2000), the median relative pose, a pose per board.

Poses are board to camera, (6,): Rodrigues vector, then mm; OpenCV's axes (x right, y down, z along the view);
x_right = R x_left + T. px with the integer at a pixel's centre.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import cv2
import numpy as np

from tvsbayes.cameras.boards import Board, View, corner_orders, quarter_turns
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
    left, right = (
        camera_start(
            {k: corners for k, view in enumerate(views) if (corners := getattr(view, side)) is not None},
            *(board, size, side, fix_k3),
        )
        for side in CAMERAS
    )
    near_px = MISMATCH_SHARE * size[0]
    relation = _relation(views, board, left, right, near_px)
    if relation.usual_px > DISAGREE_SHARE * size[0]:
        agreeing = [escaped(views[k].name, 40) for k, miss in relation.misses.items() if miss <= near_px]
        reason = f"most of the {len(relation.misses)} pairs miss by {relation.usual_px:.0f} px and more"
        raise pairs_disagree(reason + (f"; only {', '.join(agreeing)} agree" if len(agreeing) > 1 else ""))
    limit_px = max(MISMATCH_RATIO * relation.usual_px, near_px)
    mismatched = [relation.misses.get(k, 0.0) > limit_px for k in range(len(views))]
    to_left, orders = inverse(relation.pose), corner_orders(board)
    agreed, turned = list(views), []
    for k, order in relation.orders.items():
        if order and not mismatched[k]:
            agreed[k] = replace(views[k], right=_seen(views[k].right)[orders[order]])
            turned.append(views[k].name)
    return Start(
        vector=np.concatenate([left.vector, right.vector, relation.pose]),
        poses=np.array(
            [left.poses[k] if k in left.poses else composed(right.poses[k], to_left) for k in range(len(views))]
        ),
        views=tuple(agreed),
        turned=tuple(turned),
        mismatched=np.array(mismatched),
        alone_rms_px=math.hypot(left.rms_px, right.rms_px) / math.sqrt(2),
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
    found = {k: np.concatenate([np.ravel(t), np.ravel(s)]) for k, t, s in zip(both, turns, shifts, strict=True)}
    calibrated = pair.with_vector(vector)
    poses = [found[k] if k in found else pose_of(view, board, calibrated) for k, view in enumerate(start.views)]
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
    """Zhang's method (cv2.calibrateCamera) on some views, then a pose for each.

    Raises:
        NothingToEstimate: too few views, or OpenCV finds no solution.
    """
    if len(corners) < VIEWS_MIN:
        raise NothingToEstimate(
            "few-views",
            f"the board was found in {len(corners)} pictures of the {side} camera; {VIEWS_MIN} are the least",
            remedy="check --board (inner corners: where four squares meet), that the whole board is in the picture, "
            "sharpness and light; take 15 to 25 views",
        )
    chosen = [corners[k] for k in _spread(sorted(corners))]
    points = [board.points_mm[visible_corners(pixels)].astype(np.float32) for pixels in chosen]
    pixels_px = [np.ascontiguousarray(pixels[visible_corners(pixels)], np.float32) for pixels in chosen]

    def zhang(flags: int, first: CameraStart | None = None) -> CameraStart:
        matrix, distortion = (None, None) if first is None else (first.matrix.copy(), first.distortion.copy())
        try:
            rms, matrix, distortion, *_ = cv2.calibrateCamera(points, pixels_px, size, matrix, distortion, flags=flags)
        except cv2.error as error:
            found = f"OpenCV found no start for the {side} camera ({escaped(str(error.err), 100)})"
            raise undetermined(found) from error
        matrix, distortion = np.asarray(matrix, float), np.asarray(distortion, float).ravel()[:5]
        if not (np.isfinite(matrix).all() and np.isfinite(distortion).all()):
            raise undetermined(f"OpenCV found no finite start for the {side} camera")
        return CameraStart(matrix, distortion, {}, float(rms))

    k3 = cv2.CALIB_FIX_K3 if fix_k3 else 0
    start = zhang(k3)
    if start.rms_px > DOUBTFUL_START_PX:
        # Wide lenses have local minima: fit k1 alone first, then all coefficients from there.
        simple = cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_PRINCIPAL_POINT
        again = zhang(cv2.CALIB_USE_INTRINSIC_GUESS | k3, zhang(simple))
        start = min(start, again, key=lambda candidate: candidate.rms_px)
    poses = {k: board_pose(corners[k], board, start.matrix, start.distortion) for k in sorted(corners)}
    return replace(start, poses=poses)


@dataclass(frozen=True)
class _Relation:
    """The relative pose of the cameras, (6,), and what it leaves of each pair.

    Attributes:
        pose: left to right camera: R and T.
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
    # In another order, corner i is another corner of the board, i.e. the board is turned in its plane.
    turns = [np.array([0, 0, quarter * math.pi / 2, 0, 0, 0]) for quarter in quarter_turns(board)]
    ordered = {k: np.stack([_seen(views[k].right)[order] for order in corner_orders(board)]) for k in pairs}

    def relative(k: int, order: int = 0) -> np.ndarray:
        return composed(inverse(left.poses[k]), turns[order], right.poses[k])

    def judged(pose: np.ndarray) -> _Relation:
        misses, orders = {}, {}
        for k in pairs:
            predicted = composed(left.poses[k], pose)
            pixels = cv2.projectPoints(board.points_mm, predicted[:3], predicted[3:], right.matrix, right.distortion)[0]
            squares = np.sum((ordered[k] - np.reshape(pixels, (-1, 2))) ** 2, axis=2)
            by_order = np.sqrt(np.nanmean(squares, axis=1))
            orders[k] = int(np.argmin(by_order))
            misses[k] = float(by_order[orders[k]])
        return _Relation(pose, misses, orders)

    def median(poses: Sequence[np.ndarray]) -> np.ndarray:
        rotation = np.median([rotation_matrix(pose[:3]) for pose in poses], axis=0)
        return np.concatenate([rotation_vector(rotation), np.median([pose[3:] for pose in poses], axis=0)])

    agreed = judged(median([relative(k) for k in pairs]))
    if agreed.usual_px > limit_px and len(pairs) > 2:
        tried = (judged(relative(k, order)) for k in _spread(pairs) for order in range(len(turns)))
        best = min(tried, key=lambda relation: relation.usual_px)
        near = [relative(k, best.orders[k]) for k in pairs if best.misses[k] <= best.usual_px]
        agreed = min(best, judged(median(near)), key=lambda relation: relation.usual_px)
    return agreed


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
    return composed(board_pose(_seen(view.right), board, stereo.M2, stereo.D2), inverse(relative_pose(stereo)))


def relative_pose(stereo: Stereo) -> np.ndarray:
    """Left to right camera, (6,)."""
    return stereo.vector[18:]


def composed(*poses: np.ndarray) -> np.ndarray:
    """The pose (6,) of one frame in another through those between, the first first."""

    def after(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        turn, shift, *_ = cv2.composeRT(first[:3], first[3:], second[:3], second[3:])
        return np.concatenate([np.ravel(turn), np.ravel(shift)])

    return reduce(after, poses)


def inverse(pose: np.ndarray) -> np.ndarray:
    """The way back of a pose (6,)."""
    return np.concatenate([-pose[:3], -rotation_matrix(pose[:3]).T @ pose[3:]])


def visible_corners(*corners: np.ndarray | None) -> np.ndarray:
    """Mask of the corners (corners,) that all given pictures show."""
    return np.logical_and.reduce([np.isfinite(points).all(axis=1) for points in corners if points is not None])


def pixels_of(corners: np.ndarray) -> np.ndarray:
    """Corners (corners, 2) in the form that all versions of OpenCV accept: contiguous, of rank 3."""
    return np.ascontiguousarray(corners, float).reshape(-1, 1, 2)


def _seen(corners: np.ndarray | None) -> np.ndarray:
    assert corners is not None
    return corners
