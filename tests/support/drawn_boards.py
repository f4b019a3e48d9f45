"""Pictures of checkerboards drawn by homographies, for a pair without distortion, and the folder command on them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from tvsbayes.cameras.boards import Board
from tvsbayes.cameras.marker_boards import Markers
from tvsbayes.instrument.stereo_pair import Stereo, rotation_matrix
from tvsbayes.twin.physics import project

BOARD = Board(7, 6, 25.0)
CHARUCO = Board.with_markers("9x8", "5X5_100", 40.0)
DRAWN_CHARUCO = replace(CHARUCO, markers=Markers((9, 8), "5X5_100", share=0.7, legacy=True))
"""What a user states, and what is drawn."""
SIZE = (640, 480)
SQUARE_PX = 40
"""Pixels of a square in the drawn board, which is then warped into the image."""
MATRIX = np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]])
PAIR = Stereo(
    *SIZE,
    *(MATRIX, np.zeros(5)),
    *(MATRIX, np.zeros(5)),
    rotation_matrix(np.array([0.01, -0.02, 0.005])),
    np.array([-60.0, 0.5, -0.4]),
    np.zeros((24, 24)),
    0.0,
)
POSES = tuple(
    np.array([*turn, *middle])
    for turn, middle in zip(
        [(0.5, 0, 0.1), (-0.5, 0.1, 0), (0.1, 0.5, 0), (0, -0.5, 0.1), (0.4, 0.4, 0), (-0.4, 0.3, -0.1)],
        [(20, 0, 420), (0, 40, 450), (60, -30, 480), (10, -40, 430), (60, 30, 440), (-10, 10, 500)],
        strict=True,
    )
)
FOUND_PX = 0.3
"""The warp interpolates and JPEG ripples: 0.06 px rms, the worst of 84 coordinates below 0.3; a wrong order is off
by more than a square, 20 px."""


def true_corners(pose: np.ndarray, board: Board = BOARD) -> np.ndarray:
    """(corners, 4), px."""
    x, y, z = (board.points_mm @ rotation_matrix(pose[:3]).T + pose[3:]).T
    return project(np.column_stack((z, -x, -y)), PAIR)


def pictures(pose: np.ndarray, board: Board = BOARD) -> list[np.ndarray]:
    """Left and right picture of a board on a grey wall; no distortion."""
    margin = SQUARE_PX
    if board.markers is None:
        squares = np.add.outer(np.arange(board.rows + 1), np.arange(board.columns + 1)) % 2
        drawn = np.kron(40 + 180 * squares, np.ones((SQUARE_PX, SQUARE_PX))).astype(np.uint8)
    else:
        size = SQUARE_PX * np.array(board.markers.squares)
        drawn = (40 + 180 * (board.markers.board().generateImage(size.tolist()) > 127)).astype(np.uint8)
    drawn = cv2.copyMakeBorder(drawn, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=230)
    # Pixel centres are integers: the first inner corner lies half a pixel before the second square's first pixel.
    first = margin + SQUARE_PX - 0.5
    scale = board.pitch_mm / SQUARE_PX
    from_drawn = np.array([[scale, 0, -scale * first], [0, scale, -scale * first], [0, 0, 1.0]])
    from_drawn[:2, 2] += board.points_mm[0, :2]
    images = []
    for turn, shift in ((np.eye(3), np.zeros(3)), (PAIR.R, PAIR.T)):
        rotation = turn @ rotation_matrix(pose[:3])
        to_image = MATRIX @ np.column_stack([rotation[:, :2], turn @ pose[3:] + shift]) @ from_drawn
        wall = cv2.GaussianBlur(cv2.warpPerspective(drawn, to_image, SIZE, borderValue=128), (3, 3), 0.7)
        images.append(wall)
    return images


def write_pair(folder: Path, rest: str, images: list[np.ndarray], suffix: str = ".png") -> None:
    for side, image in zip(("left", "right"), images, strict=True):
        assert cv2.imwrite(str(folder / f"{side}{rest}{suffix}"), image)
