"""Assignment of files to cameras by their names."""

from __future__ import annotations

from pathlib import Path

import pytest

from tvsbayes.cameras.picture_pairs import Pairing, natural_order, paired_pictures
from tvsbayes.errors import InputError

SIDES = ("left", "right")
NAMES = {
    "documented": [(f"left{k:02d}.jpg", f"right{k:02d}.JPG") for k in (1, 2, 10)],
    "inside": [(f"ZED_{k}_left.png", f"ZED_{k}_right.png") for k in range(3)],
    "behind a dash": [(f"{k:02d}-Left.jpg", f"{k:02d}-RIGHT.jpeg") for k in range(3)],
    "letters before": [(f"L{k:02d}.png", f"R{k:02d}.png") for k in range(3)],
    "letters after": [(f"IMG_{k:04d}_l.png", f"IMG_{k:04d}_r.png") for k in range(3)],
    "letters of two kinds": [(f"{k:02d}L.png", f"{k:02d}_r.png") for k in range(3)],
    "folders of one letter": [(f"L/{k:02d}.png", f"R/{k:02d}.png") for k in range(3)],
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


def pairs_of(folder: Path, pairing: Pairing, most: int = 100) -> list[tuple[str, str]]:
    """Left and right file of every view."""
    by_view: dict[str, dict[str, str]] = {}
    for picture in paired_pictures(folder, most, pairing):
        (side,) = picture.sides
        by_view.setdefault(picture.view, {})[side] = picture.path.relative_to(folder).as_posix()
    return sorted(tuple(pair[side] for side in SIDES) for pair in by_view.values())


@pytest.mark.parametrize("swap", (False, True))
@pytest.mark.parametrize("way", NAMES)
def test_names_pair_up(tmp_path, way, swap):
    write(tmp_path, [name for pair in NAMES[way] for name in pair])
    (tmp_path / "notes.txt").write_text("ignored")
    # Left and right in names decide; a number or a folder does not.
    turned = swap and way in UNSURE
    assert pairs_of(tmp_path, Pairing(swap=swap)) == sorted(pair[::-1] if turned else pair for pair in NAMES[way])


def test_a_letter_inside_a_word_is_no_camera(tmp_path):
    """Wide pictures: `rail_3.png` begins with r, `spot_l.png` ends with l, and neither names a camera."""
    write(tmp_path, ["rail_3.png", "spot_l.png", ".left1.png", "notes.txt"])
    for swap, sides in ((False, SIDES), (True, SIDES[::-1])):
        pictures = paired_pictures(tmp_path, 10, Pairing(swap=swap))
        assert sorted((one.view, one.sides) for one in pictures) == [("rail_3", sides), ("spot_l", sides)]


def test_two_pictures_of_one_view_and_no_folder_are_refused(tmp_path):
    write(tmp_path, ["left1.png", "left1.jpg"])
    with pytest.raises(InputError, match=r"left1\.jpg and left1\.png"):
        paired_pictures(tmp_path, most=10)
    with pytest.raises(InputError, match="readable folder"):
        paired_pictures(tmp_path / "absent", most=1)


def test_natural_order_is_numeric():
    assert sorted(["a10", "a9", "b1", "a2b"], key=natural_order) == ["a2b", "a9", "a10", "b1"]


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
    ("options", "turned"),
    [
        ({"in_order": True}, False),
        ({"in_order": True, "swap": True}, True),
        ({"globs": ("A/*.png", "B/*.png")}, False),
        ({"globs": ("B/*.png", "A/*.png")}, True),
    ],
)
def test_pairs_as_stated_go_by_their_order(tmp_path, options, turned):
    """Times of 9 and 10 s belong to 8 and 11 s; files pair by order because no names match."""
    write(tmp_path, CLOCKS)
    pairs = ("A/t10.png", "B/t11.png"), ("A/t9.png", "B/t8.png")
    assert pairs_of(tmp_path, Pairing(**options), 4) == sorted(pair[::-1] if turned else pair for pair in pairs)


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
