"""Which file is of which camera, whatever people call them."""

from __future__ import annotations

import pytest

from tvsbayes.cameras.picture_pairs import natural_order, pictures_of
from tvsbayes.errors import InputError


def named(folder, *names: str) -> list[tuple[str, tuple[str, ...]]]:
    """View and cameras of every picture of a folder with these (empty) files."""
    for name in names:
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"")
    return sorted((picture.view, picture.sides) for picture in pictures_of(folder, most=10))


@pytest.mark.parametrize(
    "names",
    [
        ("left01.png", "right01.png"),
        ("01_left.png", "01_right.PNG"),
        ("01-Left.jpg", "01-RIGHT.jpeg"),
        ("L01.png", "R01.png"),
        ("01L.png", "01_r.png"),
        ("left/01.png", "right/01.png"),
        ("L/01.png", "R/01.png"),
        ("cam_left/01_left.png", "cam_right/01_right.png"),
    ],
)
def test_the_camera_stands_in_the_name(tmp_path, names):
    assert named(tmp_path, *names) == [("01", ("left",)), ("01", ("right",))]


def test_a_letter_inside_a_word_is_no_camera(tmp_path):
    """Wide pictures: `rail_3.png` begins with r, `spot_l.png` ends with l, and neither names a camera."""
    both = ("left", "right")
    assert named(tmp_path, "rail_3.png", "spot_l.png", ".left1.png", "notes.txt") == [
        ("rail_3", both),
        ("spot_l", both),
    ]
    assert [picture.sides for picture in pictures_of(tmp_path, swap=True, most=10)] == [both[::-1]] * 2


def test_two_pictures_of_one_view_and_too_many_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"left1\.jpg and left1\.png"):
        named(tmp_path, "left1.png", "left1.jpg")
    with pytest.raises(InputError, match="at most 1"):
        pictures_of(tmp_path, most=1)
    with pytest.raises(InputError, match="readable folder"):
        pictures_of(tmp_path / "absent", most=1)


def test_natural_order_counts():
    assert sorted(["a10", "a9", "b1", "a2b"], key=natural_order) == ["a2b", "a9", "a10", "b1"]
