"""Assignment of pairs of pictures to looks, and their copies in `frames/`."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from support.drawn_pictures import SIZE, drawn, pairs
from support.written_rows import spot_row

from tvsbayes.cameras.look_pictures import copy_frames, pair_looks, views_of
from tvsbayes.errors import InputError, Question
from tvsbayes.files.images import png_bytes, read_image


def test_names_without_a_fitting_number_count_in_order(tmp_path):
    """1, 2 ... 10 for moves 0 to 9: names sort by number."""
    drawn(tmp_path, *pairs(*map(str, range(1, 11))))
    views = views_of(tmp_path).views
    matched = pair_looks(views, range(10))
    assert (matched.matching, [s.move for s in matched.spots]) == ("order", list(range(10)))
    assert [matched.pictures[k].name for k in (0, 1, 9)] == ["1", "2", "10"]
    assert pair_looks(views, range(11)).matching == "number"
    assert pair_looks(views, range(10), matching="order").spots == matched.spots
    for moves, matching in ((9, None), (10, "number"), (12, "order")):
        with pytest.raises(InputError, match="number of its row"):
            pair_looks(views, range(moves), matching=matching)


def test_numbers_too_sparse_for_moves_are_renumbered_and_reported(tmp_path):
    drawn(tmp_path, *pairs("_0930", "_0931", "_1015"))
    matched = pair_looks(views_of(tmp_path).views, None)
    assert [s.move for s in matched.spots] == [0, 1, 2] and matched.renumbered == (930, 1015)


@pytest.mark.parametrize(
    "form", ["{way}_exp{n:02d}_P{p}_{LR}.png", "{way}_{n:02d}_{p}_{LR}.png", "exp{n}_{p}_{LR}.png"]
)
def test_numbers_of_experiments_are_no_moves(tmp_path, form):
    """A book says at which move a picture was taken, or the user that its number is a move's all the same."""
    looks = [(way, n, p) for way in (("left", "up") if "{way}" in form else ("",)) for n in (1, 2, 3) for p in (1, 2)]
    drawn(tmp_path, *(form.format(way=way, n=n, p=p, LR=side) for way, n, p in looks for side in "LR"))
    views = views_of(tmp_path).views
    assert len(views) == len(looks)
    with pytest.raises(Question, match=r"import BOOK\.csv --to CAMPAIGN --relative --pictures FOLDER") as caught:
        pair_looks(views, None)
    assert [c.options for c in caught.value.candidates] == [("--pair", "order"), ("--pair", "number")]
    assert len({spot.move for spot in pair_looks(views, None, matching="order").spots}) == len(looks)
    assert {spot.move for spot in pair_looks(views, None, matching="number").spots} == {1, 2, 3}


@pytest.mark.parametrize(
    ("names", "counted"),
    [
        (("pan+000_tilt+000", "pan+000_tilt+040", "pan+060_tilt+000"), "counters"),
        (("az5.0_el0.0", "az5.0_el5.0", "az10.0_el0.0"), "counters"),
        (("pan0", "pan100", "pan200"), "counters"),
        (("exp01_P1", "exp01_P2", "exp01_P3"), "points of experiments"),
    ],
)
def test_numbers_of_something_else_are_no_moves(tmp_path, names, counted):
    """Counters stand in names as often as numbers of moves do."""
    drawn(tmp_path, *pairs(*(f"_{name}" for name in names)))
    views = views_of(tmp_path).views
    for moves in (None, range(201)):
        with pytest.raises(Question, match=f"numbers of {counted} in the names"):
            pair_looks(views, moves)
    assert [spot.move for spot in pair_looks(views, None, matching="order").spots] == [0, 1, 2]


def test_rows_without_pictures_take_their_own(tmp_path):
    drawn(tmp_path, *pairs("3", "5"))
    numbers = (0.1,) * 4
    rows = [
        spot_row(3, 0, "near", 1, 1, *(None,) * 8, status="undetected"),
        spot_row(4, 0, "far", 1, 2, *(9.0,) * 4, *numbers),
        spot_row(5, 1, "far", 1, 3, *(None,) * 8, status="undetected"),
        spot_row(6, 1, "near", 1, 4, *(None,) * 8, status="undetected"),
    ]
    matched = pair_looks(views_of(tmp_path).views, range(2), rows)
    assert matched.spots == tuple(rows)
    assert ({spot: view.name for spot, view in matched.pictures.items()}, matched.without) == ({3: "3", 5: "5"}, (6,))
    with pytest.raises(InputError, match="none waits"):
        pair_looks(views_of(tmp_path).views, range(2), rows[1:2])


def test_files_that_are_no_pair_are_reported(tmp_path):
    drawn(tmp_path, *pairs("1", "2"), "left3.png")
    drawn(tmp_path, *pairs("4"), size=(3, 4))
    (tmp_path / "left5.tif").write_bytes(b"")
    drawn(tmp_path, "IMG_0007.png", "IMG_0008.png")
    views = views_of(tmp_path)
    assert [view.name for view in views.views] == ["1", "2"]
    assert (views.unpaired, views.unnamed, views.other_size, views.unread) == (
        ("left3.png",),
        ("IMG_0007.png", "IMG_0008.png"),
        ("left4.png", "right4.png"),
        ("left5.tif",),
    )
    assert views.image_sizes == dict.fromkeys(("left", "right"), SIZE[::-1])
    drawn(tmp_path / "lonely", "left1.png")
    with pytest.raises(InputError, match="no pair among 1"):
        views_of(tmp_path / "lonely")
    (tmp_path / "tiff").mkdir()
    (tmp_path / "tiff" / "a.tif").write_bytes(b"")
    with pytest.raises(InputError, match=r"such as a\.tif"):
        views_of(tmp_path / "tiff")


@pytest.mark.parametrize("swap", (False, True))
def test_wide_pictures_are_split_and_nothing_is_overwritten(tmp_path, swap):
    drawn(tmp_path / "wide", "look_0.png", size=(6, 16))
    views = views_of(tmp_path / "wide", swap=swap)
    out = tmp_path / "mine"
    out.mkdir()
    pictures = pair_looks(views.views, range(1)).pictures
    assert copy_frames(pictures, out) == copy_frames(pictures, out) == 2
    whole = cv2.imread(str(tmp_path / "wide" / "look_0.png"))
    names = ("right", "left") if swap else ("left", "right")
    halves = [read_image(out / "frames" / f"000000_{name}.png") for name in names]
    np.testing.assert_array_equal(np.hstack(halves), whole)
    (out / "frames" / "000000_left.png").write_bytes(png_bytes(whole))
    with pytest.raises(InputError, match="another picture"):
        copy_frames(pictures, out)


def test_a_png_is_copied_as_it_is_and_a_jpeg_decoded(tmp_path):
    drawn(tmp_path / "mixed", "left1.png", "right1.jpg")
    pictures = pair_looks(views_of(tmp_path / "mixed").views, range(1)).pictures
    copy_frames(pictures, tmp_path)
    frames = tmp_path / "frames"
    assert (frames / "000000_left.png").read_bytes() == (tmp_path / "mixed" / "left1.png").read_bytes()
    right = read_image(tmp_path / "mixed" / "right1.jpg")
    np.testing.assert_array_equal(read_image(frames / "000000_right.png"), right)
