"""ChArUco boards in rendered pictures, partly outside: positions of corners, boards of other markers named."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.drawn_boards import CHARUCO as NAMED
from support.drawn_boards import DRAWN_CHARUCO as DRAWN
from support.drawn_boards import PAIR, POSES, SIZE, pictures, true_corners, write_pair

from tvsbayes.cameras.boards import Board, find_views
from tvsbayes.cameras.marker_boards import CORNERS_MIN, fitted_markers, marker_board_corners
from tvsbayes.cameras.stereo_calibration import calibrate_stereo
from tvsbayes.errors import InputError, NothingToEstimate

FOUND_PX = 0.6
"""The warp interpolates, and the window beside markers is narrow: 0.11 px rms, the worst of 500 coordinates 0.43; a
corner that is taken for its neighbour is off by 20 px."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Six pairs; of some boards a third lies outside the picture."""
    place = tmp_path_factory.mktemp("charuco")
    for k, pose in enumerate(POSES):
        write_pair(place, f"_{k}", pictures(pose, DRAWN))
    return place


@pytest.fixture(scope="module")
def few(folder, tmp_path_factory) -> Path:
    """Two of the pairs: before a refusal some pictures are searched for every dictionary."""
    place = tmp_path_factory.mktemp("few")
    for name in ("left_0", "right_0", "left_4", "right_4"):
        shutil.copy(folder / f"{name}.png", place)
    return place


@pytest.fixture(scope="module")
def part_views(folder):
    return find_views(folder, NAMED)


def test_corners_of_parts_are_found_at_their_true_places(part_views):
    """The size of the markers and the older first square (an even number of rows) come from the pictures."""
    assert [view.name for view in part_views.views] == [f"_{k}" for k in range(6)]
    counts = []
    for view, pose in zip(part_views.views, POSES, strict=True):
        corners = np.hstack([view.left, view.right])
        counts.append(np.isfinite(corners[:, 0]).sum())
        assert np.nanmax(np.abs(corners - true_corners(pose, DRAWN))) < FOUND_PX
    assert min(counts) < NAMED.corners and min(counts) >= CORNERS_MIN


@pytest.mark.thorough
def test_a_pair_is_calibrated_from_parts(part_views):
    """Within four of its own sds, the largest of 24; the sds correspond to tenths of a pixel."""
    result = calibrate_stereo(part_views.views, NAMED, SIZE, fix_k3=True, pictures=part_views)
    sds = np.sqrt(np.diag(result.stereo.parameter_covariance))
    free = sds > 0
    assert np.abs((result.stereo.vector - PAIR.vector)[free] / sds[free]).max() < 4
    assert sds[21] < 0.3 and result.pairs == 6
    assert abs(result.triangulated_pitch_mm[0] / 40.0 - 1) < 5e-3


@pytest.mark.thorough
@pytest.mark.parametrize(
    "squares, dictionary, word",
    (
        ("9x8", "4X4_50", "markers of 5X5 are seen"),
        ("8x9", "5X5_100", "do not stand as on a board of 8x9 squares"),
        ("12x8", "5X5_100", "do not stand as on a board of 12x8 squares"),
    ),
)
def test_another_board_is_named(few, squares, dictionary, word):
    with pytest.raises(NothingToEstimate, match=word) as caught:
        find_views(few, Board.with_markers(squares, dictionary, 40.0))
    assert ("--dictionary 5X5_1000?" if dictionary == "4X4_50" else "--charuco 9xROWS") in caught.value.remedy


@pytest.mark.thorough
def test_markers_where_a_plain_board_is_named(few):
    with pytest.raises(NothingToEstimate, match="markers of 5X5 are seen") as caught:
        find_views(few, Board(9, 8, 40.0))
    assert "--charuco COLUMNSxROWS --dictionary 5X5_1000" in caught.value.remedy


def test_too_few_corners_are_no_view(folder):
    """Two columns in the picture leave the tilt open."""
    grey = cv2.imread(str(folder / "left_0.png"), 0)
    markers = fitted_markers([grey], NAMED.markers)
    corners = true_corners(POSES[0], DRAWN)[:, :2].reshape(NAMED.rows, NAMED.columns, 2)
    cut = grey.copy()
    cut[:, int(corners[:, 2, 0].min()) - 4 :] = 128
    assert marker_board_corners(grey, markers) is not None
    assert marker_board_corners(cut, markers) is None
    assert marker_board_corners(np.full_like(grey, 128), markers) is None


@pytest.mark.parametrize(
    "squares, dictionary, marker_mm, word",
    (
        ("9by8", "5X5_100", None, "--charuco"),
        ("3x8", "5X5_100", None, "--charuco"),
        ("9x8", "5x5_100", None, "--dictionary"),
        ("9x8", "5X5_100", 40.0, "--marker-mm"),
        ("9x8", "5X5_100", 4.0, "--marker-mm"),
    ),
)
def test_impossible_boards_are_refused(squares, dictionary, marker_mm, word):
    with pytest.raises(InputError, match=word) as caught:
        Board.with_markers(squares, dictionary, 40.0, marker_mm)
    assert caught.value.remedy
