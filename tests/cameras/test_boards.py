"""Pairs of pictures, positions of corners, and an order common to both cameras."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.drawn_boards import BOARD, FOUND_PX, POSES, SIZE, pictures, true_corners, write_pair
from support.hostile_folders import png

from tvsbayes.cameras import boards
from tvsbayes.cameras.boards import Board, View, find_corners, find_views, inner_corners, why_no_board
from tvsbayes.cameras.picture_pairs import Pairing
from tvsbayes.errors import InputError, NothingToEstimate


def missed_px(corners: np.ndarray, pose: np.ndarray) -> float:
    """Largest distance from the true corners (n, 4), or from those of the left picture (n, 2).

    In the order of the board or turned by half a turn, which pictures of one board do not determine.
    """
    true = true_corners(pose)[:, : corners.shape[1]]
    return min(np.abs(order - true).max() for order in (corners, corners[::-1]))


def of_pair(view: View) -> np.ndarray:
    return np.hstack([view.left, view.right])


@pytest.fixture(scope="module")
def six(tmp_path_factory) -> Path:
    """Six pairs, half of them JPEG."""
    folder = tmp_path_factory.mktemp("six")
    for k, pose in enumerate(POSES):
        write_pair(folder, f"_{k + 8}", pictures(pose), ".jpg" if k % 2 else ".png")
    return folder


@pytest.fixture(scope="module")
def six_views(six):
    return find_views(six, BOARD)


def test_pairs_of_png_and_jpeg_are_found_where_they_are(six_views):
    """Natural order: 8, 9, 10."""
    assert [view.name for view in six_views.views] == [f"_{k}" for k in range(8, 14)]
    assert (six_views.image_width, six_views.image_height) == SIZE
    assert six_views.unpaired == six_views.without_board == six_views.other_size == six_views.reordered == ()
    for view, pose in zip(six_views.views, POSES, strict=True):
        assert missed_px(of_pair(view), pose) < FOUND_PX


def test_pictures_of_one_camera_alone_are_named(tmp_path):
    for k, pose in enumerate(POSES[:3]):
        cv2.imwrite(str(tmp_path / f"left{k}.png"), pictures(pose)[0])
    with pytest.raises(NothingToEstimate, match="no picture of the right camera"):
        find_views(tmp_path, BOARD)


@pytest.mark.parametrize("proportion", ("the same", "another"))
def test_cameras_of_two_picture_sizes(tmp_path, proportion):
    """Corners of right pictures of half the size are scaled to the left one's; those of another proportion named."""
    for k, pose in enumerate(POSES[:3]):
        left, right = pictures(pose)
        small = cv2.resize(right, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(tmp_path / f"left{k}.png"), left)
        cv2.imwrite(str(tmp_path / f"right{k}.png"), small if proportion == "the same" else small[:-40])
    width, height = SIZE
    if proportion == "another":
        with pytest.raises(InputError, match=f"two sizes: {width} x {height} and {width // 2} x {height // 2 - 40}"):
            find_views(tmp_path, BOARD)
        return
    views = find_views(tmp_path, BOARD)
    assert views.right_image_size == (width // 2, height // 2) and not views.other_size
    for view, pose in zip(views.views, POSES[:3], strict=True):
        # A corner of a picture of half the size is found with twice the error.
        assert missed_px(of_pair(view), pose) < 2 * FOUND_PX


@pytest.mark.parametrize("swap", (False, True))
def test_wide_frames_are_split(tmp_path, six, six_views, swap):
    for view in six_views.views[:2]:
        halves = [cv2.imread(str(next(six.glob(f"{side}{view.name}.*"))), 0) for side in ("left", "right")]
        cv2.imwrite(str(tmp_path / f"frame{view.name}.png"), np.hstack(halves[::-1] if swap else halves))
    cv2.imwrite(str(tmp_path / "portrait.png"), np.zeros((400, 300), np.uint8))
    views = find_views(tmp_path, BOARD, pairing=Pairing(swap=swap))
    assert (views.image_width, views.image_height) == SIZE
    for split, view in zip(views.views, six_views.views[:2], strict=True):
        assert split.name == f"frame{view.name}"
        np.testing.assert_array_equal(split.left, view.left)
        np.testing.assert_array_equal(split.right, view.right)


@pytest.mark.parametrize("columns, rows, quarters", ((7, 6, 2), (7, 5, 2), (6, 6, 1), (6, 6, 2), (6, 6, 3)))
def test_turned_corner_orders_are_corrected(tmp_path, monkeypatch, columns, rows, quarters):
    """By colour (7 x 6), by direction (7 x 5), by both (6 x 6): a finder that starts at another corner."""
    board = Board(columns, rows, 25.0)
    write_pair(tmp_path, "1", pictures(POSES[0], board))
    straight = find_views(tmp_path, board)
    calls = iter((False, True))
    original = boards.find_corners

    def turned(grey, board, finder="classic"):
        corners, fallback = original(grey, board, finder)
        if next(calls):
            grid = np.rot90(corners.reshape(board.rows, board.columns, 2), quarters)
            corners = grid.reshape(-1, 2)
        return corners, fallback

    monkeypatch.setattr(boards, "find_corners", turned)
    monkeypatch.setattr(boards.os, "cpu_count", lambda: 1)
    ordered = find_views(tmp_path, board)
    assert ordered.reordered == ("1",)
    for side in ("left", "right"):
        np.testing.assert_array_equal(getattr(ordered.views[0], side), getattr(straight.views[0], side))


def test_mirrored_corner_orders_are_corrected(monkeypatch):
    """A finder that counts rows from right to left: x would turn into y the wrong way round."""
    grey = pictures(POSES[0])[0]
    straight, _ = boards.find_corners(grey, BOARD)
    original = boards._find_classic

    def mirrored(grey, board):
        return original(grey, board).reshape(board.rows, board.columns, 2)[:, ::-1].reshape(-1, 2)

    monkeypatch.setattr(boards, "_find_classic", mirrored)
    np.testing.assert_array_equal(boards.find_corners(grey, BOARD)[0], straight)


@pytest.mark.parametrize("share", [0.5, 0.2])
def test_large_pictures_are_searched_in_a_smaller_copy(monkeypatch, share):
    """The size of the copy is no whole part of the picture's; corners are refined in the picture itself."""
    monkeypatch.setattr(boards, "SECTOR_PIXELS_MAX", int(share * SIZE[0] * SIZE[1]))
    picture = pictures(POSES[0])[0][:-3, :-1]
    corners, fallback = find_corners(np.ascontiguousarray(picture), BOARD, "sector")
    assert not fallback and missed_px(corners, POSES[0]) < FOUND_PX


def bomb() -> bytes:
    """A PNG header that announces 30000 x 30000 pixels."""
    data = cv2.imencode(".png", np.zeros((4, 4), np.uint8))[1].tobytes()
    return data[:16] + (30000).to_bytes(4) * 2 + data[24:]


def damaged(data: bytes) -> bytes:
    """One byte in the middle is another."""
    return data[: len(data) // 2] + bytes([data[len(data) // 2] ^ 255]) + data[len(data) // 2 + 1 :]


HOSTILE = {
    "bomb": lambda place, good: place.write_bytes(bomb()),
    "garbage": lambda place, good: place.write_bytes(b"GIF89a" + bytes(100)),
    "damaged": lambda place, good: place.write_bytes(damaged(good.read_bytes())),
    "link": lambda place, good: place.symlink_to(shutil.copy(good, place.parents[1] / "outside.png")),
    "pipe": lambda place, good: os.mkfifo(place),
    "twice": lambda place, good: shutil.copy(good, good.with_suffix(".jpg")),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_pictures_are_refused_by_name(tmp_path, kind):
    folder = tmp_path / "pictures"
    folder.mkdir()
    write_pair(folder, "1", pictures(POSES[0]))
    HOSTILE[kind](folder / "left2.png", folder / "left1.png")
    with pytest.raises(InputError, match="left1" if kind == "twice" else "left2.png"):
        find_views(folder, BOARD)


def test_a_folder_without_pictures_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(NothingToEstimate, match="no checkerboard picture"):
        find_views(tmp_path, BOARD)
    with pytest.raises(InputError, match="nowhere"):
        find_views(tmp_path / "nowhere", BOARD)


def test_board_is_parsed_and_has_its_measures():
    board = Board.named("9 X 6", 25.0, 0.01)
    assert (board.columns, board.rows, board.corners) == (9, 6, 54)
    np.testing.assert_allclose(board.points_mm.mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(board.points_mm[1] - board.points_mm[0], [25, 0, 0])
    np.testing.assert_allclose(board.points_mm[9] - board.points_mm[0], [0, 25, 0])
    for bad in ({"pitch_mm": 0.0}, {"pitch_mm": np.nan}, {"pitch_u_mm": 3.0}, {"pitch_u_mm": -1.0}):
        with pytest.raises(InputError, match="--pitch"):
            replace(board, **bad)


def test_corners_left_unrefined_get_a_wider_window():
    """A board at 65 degrees: with the narrow window cornerSubPix returns a corner unchanged, 2.5 px off."""
    pose = np.array([-0.387, 1.073, 0.189, -11.453, 19.857, 477.414])
    right = true_corners(pose)[:, 2:]
    corners, by_fallback = find_corners(pictures(pose)[1], BOARD)
    # The drawn board's warp leaves 0.4 px on squares of 10 px.
    assert not by_fallback
    assert min(np.abs(corners - right).max(), np.abs(corners[::-1] - right).max()) < 1.0


@pytest.fixture(scope="module")
def greys() -> list[np.ndarray]:
    return [pictures(pose)[0] for pose in POSES[:2]]


def test_the_size_of_a_board_is_detected(greys):
    size = max(BOARD.columns, BOARD.rows), min(BOARD.columns, BOARD.rows)
    assert [inner_corners(grey) for grey in greys] == [size] * 2
    reason, remedy = why_no_board(greys, BOARD.columns + 1, BOARD.rows)
    assert (
        f"{size[0]}x{size[1]} inner corners are seen in 2 of 2" in reason and f"--board {size[0]}x{size[1]}?" in remedy
    )


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
    assert reason in why_no_board([picture], 9, 6).reason


def test_boards_of_too_many_pixels_are_refused_before_they_are_decoded(tmp_path, monkeypatch):
    def decoded(path, folder):
        raise AssertionError("decoded")

    monkeypatch.setattr(boards, "read_image", decoded)
    (tmp_path / "left01.png").write_bytes(png(5001, 4000, raw=b""))
    with pytest.raises(InputError) as caught:
        boards.find_views(tmp_path, boards.Board.named("9x6", 20.0))
    assert caught.value.code == "image-size" and "20 million" in caught.value.message
    for name in ("left01.png", "right01.png"):
        (tmp_path / name).write_bytes(png(5000, 4000, raw=b""))
    with pytest.raises(AssertionError, match="decoded"):
        boards.find_views(tmp_path, boards.Board.named("9x6", 20.0))
