"""Damaged pictures and descriptions of ChArUco boards: views or a refusal, nothing else."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.damaged_files import WORDS, few
from support.drawn_boards import CHARUCO, DRAWN_CHARUCO, POSES, pictures, write_pair

from tvsbayes.cameras.boards import Board, find_views
from tvsbayes.errors import InputError, NothingToEstimate

EDITS = {
    "covered": lambda grey, x, y, n: grey.__setitem__((slice(y, y + 20 * n), slice(x, None)), 25 * n) or grey,
    "mirrored": lambda grey, x, y, n: grey[:, ::-1],
    "upside down": lambda grey, x, y, n: grey[::-1, ::-1],
    "inverted": lambda grey, x, y, n: 255 - grey,
    "noisy": lambda grey, x, y, n: np.random.default_rng(n).normal(grey, 12 * n).clip(0, 255),
    "blurred": lambda grey, x, y, n: cv2.GaussianBlur(np.ascontiguousarray(grey), (0, 0), n),
    "rolled": lambda grey, x, y, n: np.roll(grey, (y, x), (0, 1)),
    "half twice": lambda grey, x, y, n: np.hstack([grey[:, : grey.shape[1] // 2]] * 2),
    "coarse": lambda grey, x, y, n: np.kron(grey[::8, ::8], np.ones((8, 8))),
    "blank": lambda grey, x, y, n: np.full_like(grey, 25 * n),
}
"""Of a picture, at x, y, as strong as n."""


@pytest.fixture(scope="module")
def good():
    return [pictures(pose, DRAWN_CHARUCO) for pose in POSES[:2]]


EDIT = st.tuples(st.sampled_from(sorted(EDITS)), st.integers(0, 639), st.integers(0, 479), st.integers(1, 10))


@few(12)
@given(st.lists(st.tuples(st.integers(0, 3), EDIT), min_size=1, max_size=4), st.integers(0, 3), st.integers(-1, 10**5))
def test_damaged_pictures_are_views_or_refused(tmp_path_factory, good, edits, file, byte):
    """Up to four edits of four pictures, then a byte of a file; views have corners where the board has them."""
    folder = tmp_path_factory.mktemp("charuco")
    greys = [grey.copy() for pair in good for grey in pair]
    for which, (name, x, y, n) in edits:
        greys[which] = np.ascontiguousarray(EDITS[name](greys[which].copy(), x, y, n)).astype(np.uint8)
    for k in range(2):
        write_pair(folder, f"_{k}", greys[2 * k : 2 * k + 2])
    if byte >= 0:
        path = sorted(folder.iterdir())[file]
        data = bytearray(path.read_bytes())
        data[byte % len(data)] ^= 0x55
        path.write_bytes(data)
    try:
        found = find_views(folder, CHARUCO)
    except (InputError, NothingToEstimate) as error:
        assert error.remedy
    else:
        corners = [side for view in found.views for side in (view.left, view.right) if side is not None]
        assert all(side.shape == (CHARUCO.corners, 2) for side in corners)


SIZES = (*["9x8"] * 9, "9 x 8", "60x60", "61x4", "1x1")
NUMBERS = st.sampled_from((0.0, -1.0, 1e-300, 1e308, float("nan"), float("inf"), 40.0, 28.0))


@few(80)
@given(st.sampled_from((*WORDS, *SIZES)), st.sampled_from((*WORDS, *["5X5_100"] * 9)), NUMBERS, NUMBERS)
def test_descriptions_of_boards_are_taken_or_refused(squares, dictionary, pitch_mm, marker_mm):
    try:
        board = Board.with_markers(squares, dictionary, pitch_mm, marker_mm)
    except InputError as error:
        assert error.remedy
    else:
        assert np.isfinite(board.points_mm).all() and board.markers.board() is not None
