"""Where a stereo calibration starts: each camera by itself (Zhang 2000), the median relative pose, a pose per board.

Poses are board to camera, (6,): Rodrigues vector, then mm; OpenCV's axes (x right, y down, z along the view);
x_right = R x_left + T. px with the integer at a pixel's centre.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from tvsbayes.cameras.boards import Board, View
from tvsbayes.cameras.bundle_adjustment import undetermined
from tvsbayes.errors import NothingToEstimate, escaped
from tvsbayes.instrument.campaign import CAMERAS
from tvsbayes.instrument.stereo_pair import Stereo, rotation_matrix, rotation_vector

VIEWS_MIN = 3
"""Views per camera below which Zhang's method (2000) cannot find a focal length with both principal coordinates."""
START_VIEWS = 30
"""The start needs no more; every further view enters the bundle adjustment alone."""
MISMATCH_TIMES, MISMATCH_SHARE = 5.0, 0.01
"""A view is no pair if its right corners miss the place that the left ones and the median of all relative poses
predict by more than five times the median view and by more than 1 % of the image width."""


@dataclass(frozen=True)
class CameraStart:
    """Zhang's solution for one camera: matrix, distortion, and a pose (6,) for every view that it saw."""

    matrix: np.ndarray
    distortion: np.ndarray
    poses: dict[int, np.ndarray]

    @property
    def vector(self) -> np.ndarray:
        """The nine inner parameters, as `Stereo.vector` orders them."""
        return np.array([*self.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *self.distortion])


@dataclass(frozen=True)
class Start:
    """Where the adjustment starts: the 24 parameters, board poses (views, 6), and which views are no pair at all."""

    vector: np.ndarray
    poses: np.ndarray
    mismatched: np.ndarray


def start_of(views: Sequence[View], board: Board, size: tuple[int, int], fix_k3: bool) -> Start:
    """The start of both cameras and of all boards.

    Raises:
        NothingToEstimate: too few views of a camera, no pair, or no start that OpenCV can find.
    """
    cameras = []
    for side in CAMERAS:
        corners = {k: getattr(v, side) for k, v in enumerate(views) if getattr(v, side) is not None}
        cameras.append(camera_start(corners, board, size, side, fix_k3))
    left, right = cameras
    relative = _relative(left, right)
    rotation, shift = rotation_matrix(relative[:3]), relative[3:]
    poses, misses = [], np.zeros(len(views))
    for k, view in enumerate(views):
        poses.append(left.poses[k] if k in left.poses else left_pose(right.poses[k], rotation, shift))
        if k in left.poses and view.right is not None:
            pose = poses[k]
            seen_from_right = rotation_vector(rotation @ rotation_matrix(pose[:3])), rotation @ pose[3:] + shift
            pixels, _ = cv2.projectPoints(board.points_mm, *seen_from_right, right.matrix, right.distortion)
            misses[k] = math.sqrt(np.mean(np.sum((np.reshape(pixels, (-1, 2)) - view.right) ** 2, axis=1)))
    usual = float(np.median(misses[misses > 0])) if misses.any() else 0.0
    mismatched = misses > max(MISMATCH_TIMES * usual, MISMATCH_SHARE * size[0])
    vector = np.concatenate([left.vector, right.vector, relative])
    return Start(vector, np.array(poses), mismatched)


def camera_start(
    corners: dict[int, np.ndarray], board: Board, size: tuple[int, int], side: str, fix_k3: bool
) -> CameraStart:
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
    return CameraStart(matrix, distortion, {k: board_pose(corners[k], board, matrix, distortion) for k in keys})


def _relative(left: CameraStart, right: CameraStart) -> np.ndarray:
    """R and T, (6,), as the median over pairs: one wrong pair does not move them."""
    rotations, translations = [], []
    for k in sorted(set(left.poses) & set(right.poses)):
        turn = rotation_matrix(right.poses[k][:3]) @ rotation_matrix(left.poses[k][:3]).T
        rotations.append(turn)
        translations.append(right.poses[k][3:] - turn @ left.poses[k][3:])
    if not rotations:
        raise NothingToEstimate(
            "no-pairs",
            "no view shows the board to both cameras",
            remedy="name the pictures of one moment alike: left01.png and right01.png",
        )
    return np.concatenate([rotation_vector(np.median(rotations, axis=0)), np.median(translations, axis=0)])


def board_pose(corners: np.ndarray, board: Board, matrix: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Board to camera, shape (6,), from one picture by IPPE (Collins and Bartoli 2014)."""
    done, turn, shift = cv2.solvePnP(board.points_mm, pixels_of(corners), matrix, distortion, flags=cv2.SOLVEPNP_IPPE)
    if not done or not (np.isfinite(turn).all() and np.isfinite(shift).all()):
        raise undetermined("a board has no pose that OpenCV can find")
    return np.concatenate([np.ravel(turn), np.ravel(shift)])


def pose_of(view: View, board: Board, stereo: Stereo) -> np.ndarray:
    """Board to left camera, from the picture of the left one where it saw the board."""
    if view.left is not None:
        return board_pose(view.left, board, stereo.M1, stereo.D1)
    assert view.right is not None
    return left_pose(board_pose(view.right, board, stereo.M2, stereo.D2), stereo.R, stereo.T)


def left_pose(right_pose: np.ndarray, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Board to left camera from board to right camera; `turn` is R, `shift` T."""
    rotation = rotation_vector(turn.T @ rotation_matrix(right_pose[:3]))
    return np.concatenate([rotation, turn.T @ (right_pose[3:] - shift)])


def pixels_of(corners: np.ndarray) -> np.ndarray:
    """Corners (corners, 2) as every OpenCV takes them: contiguous, of rank 3."""
    return np.ascontiguousarray(corners, float).reshape(-1, 1, 2)
