"""Assignment of files to cameras by their names."""

from __future__ import annotations

from pathlib import Path

import pytest

from tvsbayes.cameras.picture_pairs import Pairing, natural_order, paired_pictures
from tvsbayes.errors import InputError


def named(folder, *names: str) -> list[tuple[str, tuple[str, ...]]]:
    """View and cameras of every picture of a folder with these (empty) files."""
    for name in names:
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"")
    return sorted((picture.view, picture.sides) for picture in paired_pictures(folder, most=10))


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
def test_the_camera_is_in_the_name(tmp_path, names):
    assert named(tmp_path, *names) == [("01", ("left",)), ("01", ("right",))]


def test_a_letter_inside_a_word_is_no_camera(tmp_path):
    """Wide pictures: `rail_3.png` begins with r, `spot_l.png` ends with l, and neither names a camera."""
    both = ("left", "right")
    assert named(tmp_path, "rail_3.png", "spot_l.png", ".left1.png", "notes.txt") == [
        ("rail_3", both),
        ("spot_l", both),
    ]
    assert [picture.sides for picture in paired_pictures(tmp_path, 10, Pairing(swap=True))] == [both[::-1]] * 2


def test_two_pictures_of_one_view_and_too_many_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"left1\.jpg and left1\.png"):
        named(tmp_path, "left1.png", "left1.jpg")
    with pytest.raises(InputError, match="at most 1"):
        paired_pictures(tmp_path, most=1)
    with pytest.raises(InputError, match="readable folder"):
        paired_pictures(tmp_path / "absent", most=1)


def test_natural_order_is_numeric():
    assert sorted(["a10", "a9", "b1", "a2b"], key=natural_order) == ["a2b", "a9", "a10", "b1"]


SIDES = ("left", "right")
NAMES = {
    "documented": [(f"left{k:02d}.jpg", f"right{k:02d}.JPG") for k in (1, 2, 10)],
    "inside": [(f"ZED_{k}_left.png", f"ZED_{k}_right.png") for k in range(3)],
    "letters before": [(f"L{k:02d}.png", f"R{k:02d}.png") for k in range(3)],
    "letters after": [(f"IMG_{k:04d}_l.png", f"IMG_{k:04d}_r.png") for k in range(3)],
    "folders by side": [(f"LEFT/a{k}.jpeg", f"RIGHT/a{k}.png") for k in range(3)],
    "said twice": [(f"stereoLeft/imageL{k}.png", f"stereoright/imageR{k}.png") for k in range(3)],
    "folder per view": [(f"{k}/left{k}.png", f"{k}/right{k}.png") for k in range(3)],
    "times": [(f"left/{1000 + 33 * k}.png", f"right/{1001 + 33 * k}.png") for k in range(3)],
    "numbered": [(f"cam0_{k}.png", f"cam1_{k}.png") for k in range(3)],
    "numbered folders": [(f"image_00/data/{k:010d}.png", f"image_01/data/{k:010d}.png") for k in range(3)],
    "one letter": [(f"c1_{k:02d}.png", f"c2_{k:02d}.png") for k in range(3)],
    "number at the end": [(f"{k:04d}_0.png", f"{k:04d}_1.png") for k in range(3)],
    "two folders": [(f"A/{k}.png", f"B/{k}.png") for k in range(3)],
}
UNSURE = ("numbered", "numbered folders", "one letter", "number at the end", "two folders")


def write(folder: Path, names) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"never opened")


@pytest.mark.parametrize("swap", (False, True))
@pytest.mark.parametrize("way", NAMES)
def test_names_pair_up(tmp_path, way, swap):
    write(tmp_path, [name for pair in NAMES[way] for name in pair])
    (tmp_path / "notes.txt").write_text("ignored")
    pictures = paired_pictures(tmp_path, 100, Pairing(swap=swap))
    by_view: dict[str, dict[str, str]] = {}
    for picture in pictures:
        by_view.setdefault(picture.view, {})[picture.sides[0]] = picture.path.relative_to(tmp_path).as_posix()
    # Left and right in names decide; a number or a folder does not.
    sides = SIDES[::-1] if swap and way in UNSURE else SIDES
    assert sorted(tuple(pair[side] for side in sides) for pair in by_view.values()) == sorted(NAMES[way])


def test_documented_names_come_first(tmp_path):
    write(tmp_path, ["left1.png", "right1.png", "cam0_1.png", "cam1_1.png", "old/left1.png"])
    assert [picture.path.name for picture in paired_pictures(tmp_path, most=100)] == ["left1.png", "right1.png"]


@pytest.mark.parametrize("names", (("image0.png", "image1.png"), ("wall.png", "floor.png", "sky.png"), ("a_1.png",)))
def test_frames_of_both_cameras_are_refused_as_pairs(tmp_path, names):
    write(tmp_path, names)
    assert {picture.sides for picture in paired_pictures(tmp_path, most=100)} == {SIDES}


def test_links_and_hidden_folders_are_not_followed(tmp_path):
    write(tmp_path / "set", ["left1.png"])
    write(tmp_path / "elsewhere", ["left2.png", "right2.png"])
    (tmp_path / "set" / "link").symlink_to(tmp_path / "elsewhere")
    write(tmp_path / "set", [".cache/left3.png", ".cache/right3.png"])
    assert [picture.path.name for picture in paired_pictures(tmp_path / "set", most=100)] == ["left1.png"]


def test_other_formats_are_refused_with_a_remedy(tmp_path):
    write(tmp_path, ["left1.pgm", "right1.pgm"])
    with pytest.raises(InputError, match=r"2 pictures such as left1.pgm; allowed: PNG or JPEG; convert .*\*.pgm"):
        paired_pictures(tmp_path, most=100)


def test_too_many_pictures_are_refused_before_they_are_opened(tmp_path):
    for k in range(101):
        (tmp_path / f"shot{k}.png").touch()
    with pytest.raises(InputError, match="101 pictures"):
        paired_pictures(tmp_path, most=100)


CLOCKS = ("A/t9.png", "A/t10.png", "B/t11.png", "B/t8.png")
"""Two cameras whose pictures bear the times of their own clocks."""


@pytest.mark.parametrize(
    ("options", "first", "second"),
    [
        ({"in_order": True}, "left", "right"),
        ({"in_order": True, "swap": True}, "right", "left"),
        ({"globs": ("A/*.png", "B/*.png")}, "left", "right"),
        ({"globs": ("B/*.png", "A/*.png")}, "right", "left"),
    ],
)
def test_pairs_as_stated_go_by_their_order(tmp_path, options, first, second):
    """Times of 9 and 10 s belong to 8 and 11 s; files pair by order because no names match."""
    write(tmp_path, CLOCKS)
    pictures = paired_pictures(tmp_path, 4, Pairing(**options))
    by_view: dict[str, dict[str, str]] = {}
    for picture in pictures:
        (side,) = picture.sides
        by_view.setdefault(picture.view, {})[side] = picture.path.relative_to(tmp_path).as_posix()
    assert sorted((pair[first], pair[second]) for pair in by_view.values()) == [
        ("A/t10.png", "B/t11.png"),
        ("A/t9.png", "B/t8.png"),
    ]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"globs": ("A/*.png", "B/t8.png")}, "2 left and 1 right pictures"),
        ({"globs": ("A/*.png", "C/*.png")}, "2 and 0 pictures"),
        ({"globs": ("A/*.png", "../B/*.png")}, "pictures of two cameras"),
        ({"in_order": True}, "3 at most"),
    ],
)
def test_impossible_stated_pairs_are_refused(tmp_path, options, message):
    """A pattern outside of the folder matches nothing."""
    write(tmp_path, CLOCKS)
    with pytest.raises(InputError, match=message):
        paired_pictures(tmp_path, 3, Pairing(**options))
