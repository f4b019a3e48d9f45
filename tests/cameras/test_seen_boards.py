"""What is seen where no board of the size that was named is: another size, too little light, no focus."""

from __future__ import annotations

import numpy as np
import pytest
from support.drawn_boards import BOARD, POSES, pictures

from tvsbayes.cameras import seen_boards
from tvsbayes.cameras.seen_boards import inner_corners, why_no_board


@pytest.fixture(scope="module")
def greys() -> list[np.ndarray]:
    return [
        np.ascontiguousarray(pictures(pose)[0][..., :3].mean(axis=2).astype(np.uint8))
        if pictures(pose)[0].ndim == 3
        else pictures(pose)[0]
        for pose in POSES[:2]
    ]


def test_the_size_of_a_board_is_seen(greys):
    size = max(BOARD.columns, BOARD.rows), min(BOARD.columns, BOARD.rows)
    assert [inner_corners(grey) for grey in greys] == [size] * 2
    reason, remedy = why_no_board(greys, BOARD.columns + 1, BOARD.rows)
    assert (
        f"{size[0]}x{size[1]} inner corners are seen in 2 of 2" in reason and f"--board {size[0]}x{size[1]}?" in remedy
    )


def test_large_pictures_are_searched_in_a_smaller_copy(greys, monkeypatch):
    """Of 20 million pixels a search by sectors takes gigabytes."""
    sizes, search = [], seen_boards.cv2.findChessboardCornersSBWithMeta
    monkeypatch.setattr(
        seen_boards.cv2,
        "findChessboardCornersSBWithMeta",
        lambda grey, *more: sizes.append(grey.size) or search(grey, *more),
    )
    monkeypatch.setattr(seen_boards, "SECTOR_PIXELS_MAX", greys[0].size // 2)
    assert inner_corners(greys[0]) is not None and sizes[0] <= greys[0].size // 2


@pytest.mark.parametrize(
    ("picture", "reason"),
    [
        (np.full((240, 320), 8, np.uint8), "dark, mean grey level 8"),
        (np.full((240, 320), 255, np.uint8), "overexposed, 100 %"),
        (np.tile(np.linspace(50, 200, 320).astype(np.uint8), (240, 1)), "blurred"),
        (np.random.default_rng(1).integers(60, 200, (240, 320)).astype(np.uint8), "no checkerboard of any size"),
    ],
)
def test_pictures_without_a_board(picture, reason):
    assert reason in why_no_board([picture], 9, 6)[0]
