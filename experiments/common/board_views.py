"""Views of a calibration board by drawn stereo pairs whose truth is known: corners, and rendered pictures.

By the twin's optics, which share no code with the adjustment under test. px and mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from experiments.common.rigs import mounted_rig
from tvsbayes.cameras.boards import Board, View, find_views
from tvsbayes.instrument.stereo_pair import Stereo, rotation_matrix, rotation_vector
from tvsbayes.twin import board_pictures
from tvsbayes.twin.board_pictures import BoardPose, board_poses, render_board
from tvsbayes.twin.physics import cameras_of, project
from tvsbayes.twin.spot_pictures import Sensor

CONDITIONS = ("white", "pitch", "shared", "rendered")
BOARD = Board(9, 6, 25.0)
PITCH_U = 1e-3
VIEWS, RENDERED_VIEWS = 20, 12
CORNER_SD_PX = 0.15
SHARED_SQUARES = 2.5
TRUTH_SD = np.array([*2 * [8.0, 8.0, 8.0, 8.0, 0.02, 0.02, 5e-4, 5e-4, 0.01], 0.01, 0.01, 0.01, 1.0, 1.0, 1.0])
"""How far true rigs lie from the shipped one: each is another rig."""


@dataclass(frozen=True)
class Scene:
    """One view to be: the true cameras, the board as it is, where it stands, what disturbs the corners."""

    stereo: Stereo
    board: Board
    pose: np.ndarray
    condition: str


def true_corners(scene: Scene) -> np.ndarray:
    """Corners (corners, 4), see `seen_by_both`."""
    return seen_by_both(scene.board.points_mm, scene.pose, scene.stereo)


def seen_by_both(points_mm: np.ndarray, pose: np.ndarray, stereo: Stereo) -> np.ndarray:
    """Pixels (points, 4: u_left, v_left, u_right, v_right) of a board at a pose; NaN where not seen by both."""
    x, y, z = (points_mm @ rotation_matrix(pose[:3]).T + pose[3:]).T
    return project(np.column_stack((z, -x, -y)), stereo)


def poses_in_view(points_mm: np.ndarray, stereo: Stereo, count: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Random poses (rotation vector, translation; board to left camera) wholly seen by both cameras."""
    poses: list[np.ndarray] = []
    while len(poses) < count:
        rotation = rng.uniform(-0.6, 0.6, 3) * np.array([1.0, 1.0, 0.5])
        depth = rng.uniform(240.0, 600.0)
        middle = depth * np.array([rng.uniform(-0.6, 0.6), rng.uniform(-0.35, 0.35), 1.0]) + [42.5, 0.0, 0.0]
        pose = np.concatenate((rotation, middle))
        if np.isfinite(seen_by_both(points_mm, pose, stereo)).all():
            poses.append(pose)
    return poses


def chi2(difference: np.ndarray, covariance: np.ndarray) -> float:
    """d^T C^-1 d, scaled first: px, rad and mm differ by ten powers of ten."""
    sds = np.sqrt(np.diag(covariance))
    return float(difference / sds @ np.linalg.solve(covariance / np.outer(sds, sds), difference / sds))


def corners_of(scene: Scene, name: str, rng: np.random.Generator) -> View:
    """What a corner finder would report of a scene."""
    corners = true_corners(scene)
    noise = rng.standard_normal(corners.shape)
    if scene.condition == "shared":
        grid = scene.board.points_mm[:, :2] / scene.board.pitch_mm
        distance2 = ((grid[:, None] - grid[None]) ** 2).sum(-1)
        correlation = np.exp(-0.5 * distance2 / SHARED_SQUARES**2)
        # Half of the variance is shared.
        root = np.linalg.cholesky(0.5 * correlation + 0.5 * np.eye(len(grid)))
        noise = root @ noise
    pixels = corners + CORNER_SD_PX * noise
    return View(name, pixels[:, :2], pixels[:, 2:])


def scenes(seed: int, condition: str, count: int = VIEWS) -> list[Scene]:
    """The views of one drawn rig; every board is wholly seen by both cameras."""
    rng = np.random.default_rng([seed, CONDITIONS.index(condition)])
    nominal = mounted_rig().stereo
    stereo = nominal.with_vector(nominal.vector + TRUTH_SD * rng.standard_normal(24))
    if condition == "rendered":
        # Finders need the outer squares too: the renderer's own poses leave room for them.
        first = BOARD.points_mm[0]
        drawn = board_poses(cameras_of(stereo), board_pictures.Board(), RENDERED_VIEWS, seed)
        poses = [np.concatenate((rotation_vector(p.rotation), p.translation_mm - p.rotation @ first)) for p in drawn]
        return [Scene(stereo, BOARD, pose, condition) for pose in poses]
    pitch_mm = BOARD.pitch_mm * (1 + PITCH_U * rng.standard_normal() * (condition == "pitch"))
    board = replace(BOARD, pitch_mm=pitch_mm)
    return [Scene(stereo, board, pose, condition) for pose in poses_in_view(board.points_mm, stereo, count, rng)]


def rendered_views(drawn: Sequence[Scene], seed: int) -> list[View]:
    """Pictures of every scene in a folder, and the corners that `find_views` finds there."""
    cameras = cameras_of(drawn[0].stereo)
    with TemporaryDirectory() as folder:
        for k, scene in enumerate(drawn):
            rotation = rotation_matrix(scene.pose[:3])
            pose = BoardPose(rotation, scene.pose[3:] + rotation @ scene.board.points_mm[0])
            for side, camera in (("left", cameras.left), ("right", cameras.right)):
                picture = render_board(camera, pose, board_pictures.Board(), Sensor(), (seed, k, side == "right"))
                place = str(Path(folder) / f"{side}{k:02d}.png")
                # Level 1: the files live for seconds.
                assert cv2.imwrite(place, picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        return list(find_views(Path(folder), BOARD).views)
