"""Pictures that a lab book names."""

from __future__ import annotations

import pytest
from support.drawn_pictures import SIZE, drawn

from tvsbayes.cameras.book_pictures import BookRow, pictures_of_book
from tvsbayes.errors import InputError

WAYS = ("left", "up")
FORM = "{way}/exp{n:02d}_P{p}_{LR}.png"


def lab(folder, form: str = FORM, size=SIZE, sides: str = "LR") -> None:
    """Two experiments of two points in two directions."""
    for way in WAYS:
        for n in (1, 2):
            for p in (1, 2):
                for side in sides:
                    name = form.format(way=way, n=n, p=p, LR=side)
                    drawn((folder / name).parent, name.rpartition("/")[2], size=size)


def rows(*cells: str, directed: bool = True) -> list[BookRow]:
    """Looks in the order of the folders; a cell is filled in as the names are."""
    looks = [(way, n, p) for way in WAYS for n in (1, 2) for p in (1, 2)]
    named = [tuple(cell.format(way=way, n=n, p=p) for cell in cells) for way, n, p in looks]
    return [BookRow(k, k + 2, own, "", looks[k][0] if directed else "") for k, own in enumerate(named)]


def names_of(booked, folder) -> dict[int, list[str]]:
    return {
        spot: [picture.path.relative_to(folder).as_posix() for picture in view.pictures]
        for spot, view in booked.pictures.items()
    }


@pytest.mark.parametrize(
    "cells",
    [
        ("{way}/exp{n:02d}_P{p}_L.png",),
        ("{way}\\exp{n:02d}_P{p}_R",),
        ("./{way}/EXP{n:02d}_p{p}",),
        ("exp{n:02d}_P{p}_L.png",),
        ("exp{n:02d}_P{p}",),
        ("{way}/exp{n:02d}_P{p}_L.png", "{way}/exp{n:02d}_P{p}_R.png"),
        ("exp{n:02d}_P{p}_L", "exp{n:02d}_P{p}_R"),
    ],
)
def test_a_book_names_either_picture_or_what_both_share(tmp_path, cells):
    """With or without folder and ending; of one name in several folders that of the look's direction."""
    lab(tmp_path)
    (tmp_path / "raw.tif").write_bytes(b"")
    drawn(tmp_path / "up", "dark_L.png", "dark_R.png")
    booked = pictures_of_book(rows(*cells), tmp_path, "book.csv")
    looks = [(way, n, p) for way in WAYS for n in (1, 2) for p in (1, 2)]
    assert names_of(booked, tmp_path) == {
        k: [FORM.format(way=way, n=n, p=p, LR=side) for side in "LR"] for k, (way, n, p) in enumerate(looks)
    }
    assert (booked.missing, sorted(booked.left_over)) == ((), ["up/dark_L.png", "up/dark_R.png"])
    assert booked.by_direction == 8 * ("{way}" not in cells[0]) and not booked.turned
    assert booked.unread == ("raw.tif",) and booked.image_sizes == dict.fromkeys(("left", "right"), SIZE[::-1])


def test_a_name_in_several_folders_is_refused_without_a_direction(tmp_path):
    lab(tmp_path)
    with pytest.raises(InputError, match=r"line 2: found exp01_P1, which stands for left/exp01_P1, up/exp01_P1"):
        pictures_of_book(rows("exp{n:02d}_P{p}", directed=False), tmp_path, "book.csv")


def test_a_picture_of_two_looks_is_refused_by_name(tmp_path):
    lab(tmp_path)
    with pytest.raises(InputError, match=r"book.csv line 3: found left/exp01_P1_L.png again \(first on line 2\)"):
        pictures_of_book(rows("{way}/exp{n:02d}_P1_L.png"), tmp_path, "book.csv")


def test_names_without_pictures_are_listed_and_a_wrong_folder_refused(tmp_path):
    lab(tmp_path)
    (tmp_path / "up" / "exp02_P2_R.png").unlink()
    (tmp_path / "left" / "exp01_P1_L.png").unlink()
    booked = pictures_of_book(rows("{way}/exp{n:02d}_P{p}_L.png"), tmp_path, "book.csv")
    assert booked.missing == ("line 2 left/exp01_P1_L.png", "line 9 up/exp02_P2_L.png")
    assert sorted(booked.left_over) == ["left/exp01_P1_R.png", "up/exp02_P2_L.png"]
    with pytest.raises(InputError, match="no name of a picture among 14"):
        pictures_of_book(rows("{way}/E{n}_{p}.png"), tmp_path, "book.csv")


def test_pictures_of_two_sizes_are_refused_by_name(tmp_path):
    lab(tmp_path)
    drawn(tmp_path / "up", "exp02_P1_R.png", size=(3, 4))
    with pytest.raises(InputError, match=r"1 of another size: up/exp02_P1_R\.png"):
        pictures_of_book(rows("{way}/exp{n:02d}_P{p}_L", "{way}/exp{n:02d}_P{p}_R"), tmp_path, "book.csv")
