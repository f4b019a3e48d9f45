"""Assignment of files to cameras by their names."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.drawn_pictures import drawn

from tvsbayes.cameras.picture_pairs import Pairing, paired_pictures, read_folder
from tvsbayes.errors import InputError, Question

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


DIRECTIONS = ("left", "right", "up", "down")
LAB = {
    "folders, letters": "{way}/exp{n:02d}_P{p}_{LR}.png",
    "folders, words": "{way}/exp{n:02d}_P{p}_{side}.png",
    "folders of directions and of cameras": "{way}/{side}/exp{n:02d}_P{p}.png",
    "folders of cameras and of directions": "cam{LR}/{way}/exp{n:02d}_P{p}.png",
    "prefix, camL": "{way}_exp{n:02d}_P{p}_cam{LR}.png",
    "prefix, cam l": "{way}_exp{n:02d}_P{p}_cam_{lr}.png",
    "prefix, Spanish": "{way}_{n:02d}_{p}_{izq}.png",
    "prefix, numbers": "{way}_{n:02d}_{p}_cam{k}.png",
    "prefix, words": "{way}_exp{n:02d}_P{p}_{side}.png",
    "prefix below folders of cameras": "{side}_camera/{way}_exp{n:02d}_P{p}.png",
    "prefix of one letter": "{W}_exp{n:02d}_P{p}_{side}.png",
    "camera first": "cam{LR}_exp{n:02d}_P{p}_{way}.png",
    "German": "{way}/Versuch{n}_{p}_{links}.png",
    "a repeat R1": "{LR}_{way}_exp{n:02d}_R{p}.png",
}
CAMERA_WORDS = {
    "left": {"LR": "L", "lr": "l", "side": "left", "izq": "izq", "k": 0, "links": "links"},
    "right": {"LR": "R", "lr": "r", "side": "right", "izq": "der", "k": 1, "links": "rechts"},
}


def lab_name(form: str, side: str, way: str, n: int, p: int) -> str:
    return form.format(way=way, W=way[0].upper(), n=n, p=p, **CAMERA_WORDS[side])


@pytest.mark.parametrize("ways", (DIRECTIONS, ("left", "right")))
@pytest.mark.parametrize("layout", LAB)
def test_a_direction_is_no_camera(tmp_path, layout, ways):
    """The paper's lab: four points of two experiments in every direction, or in those of pan alone."""
    looks = [(way, n, p) for way in ways for n in (1, 2) for p in (1, 2, 3, 4)]
    expected = [tuple(lab_name(LAB[layout], side, *look) for side in SIDES) for look in looks]
    write(tmp_path, [name for pair in expected for name in pair])
    assert pairs_of(tmp_path, Pairing(asks=True)) == sorted(expected)


@pytest.mark.parametrize(
    ("left", "right"),
    [
        *(("gauche", "droite"), ("Gauche", "DROITE"), ("izquierda", "derecha"), ("linke", "rechte")),
        *(("kamera_l", "kamera_r"), ("c\u00e1mara 1", "c\u00e1mara 2"), ("camera-3", "camera-4")),
        *(("leftcam", "rightcam"), ("camL", "camR")),
    ],
)
def test_words_of_cameras(tmp_path, left, right):
    for number, form in enumerate(("{}/{}.png", "{}_{}.png", "{1}_{0}.png")):
        folder = tmp_path / str(number)
        expected = [tuple(form.format(side, f"{k:03d}") for side in (left, right)) for k in range(3)]
        write(folder, [name for pair in expected for name in pair])
        assert pairs_of(folder, Pairing(asks=True)) == sorted(expected)


def test_one_direction_is_a_camera_only_without_up_and_down(tmp_path):
    """Folders left and right alone are cameras; beside up and down each picture may hold both."""
    write(tmp_path, [f"{way}/{k}.png" for way in ("left", "right") for k in range(3)])
    assert pairs_of(tmp_path, Pairing(asks=True)) == [(f"left/{k}.png", f"right/{k}.png") for k in range(3)]
    write(tmp_path, [f"up/{k}.png" for k in range(3)])
    assert {picture.sides for picture in paired_pictures(tmp_path, 100)} == {SIDES}


@pytest.mark.parametrize("way", ("numbered folders", "one letter", "number at the end", "two folders", "times"))
def test_names_that_do_not_decide_are_asked(tmp_path, way):
    """Each answer's patterns pair the files; one of them as the guess without a question."""
    write(tmp_path, [name for pair in NAMES[way] for name in pair])
    with pytest.raises(Question) as caught:
        paired_pictures(tmp_path, 100, Pairing(asks=True))
    first, second, both = caught.value.candidates
    for candidate, pairs in ((first, NAMES[way]), (second, [pair[::-1] for pair in NAMES[way]])):
        (left, right) = candidate.options[1::2]
        assert pairs_of(tmp_path, Pairing(globs=(left, right))) == sorted(pairs)
    wide = paired_pictures(tmp_path, 100, Pairing(globs=(both.options[1], both.options[3])))
    assert {picture.sides for picture in wide} == {SIDES} and len(wide) == 2 * len(NAMES[way])


def test_wide_pictures_named_by_directions_are_asked(tmp_path):
    """Folders left and right of frames side by side: one pattern for both cameras says so."""
    for way in ("left", "right"):
        drawn(tmp_path / way, "1.png", "2.png", size=(6, 16))
    with pytest.raises(Question) as caught:
        read_folder(tmp_path, 100, 1000, Pairing(asks=True))
    patterns = caught.value.candidates[1].options[1::2]
    found = read_folder(tmp_path, 100, 1000, Pairing(globs=patterns, asks=True))
    assert {picture.sides for picture in found.used} == {SIDES} and found.usual == dict.fromkeys(SIDES, (8, 6))
    assert {picture.view for picture in found.used} == {"left/1", "left/2", "right/1", "right/2"}


def test_links_and_hidden_folders_are_not_followed(tmp_path):
    write(tmp_path / "set", ["left1.png"])
    write(tmp_path / "elsewhere", ["left2.png", "right2.png"])
    (tmp_path / "set" / "link").symlink_to(tmp_path / "elsewhere")
    write(tmp_path / "set", [".cache/left3.png", ".cache/right3.png"])
    assert [picture.path.name for picture in paired_pictures(tmp_path / "set", most=100)] == ["left1.png"]


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
        ({"globs": ("A/*.png", "")}, "pictures of two cameras"),
        ({"globs": ("A/*.png", "**.png")}, "pictures of two cameras"),
        ({"in_order": True}, "3 at most"),
    ],
)
def test_impossible_stated_pairs_are_refused(tmp_path, options, message):
    """A pattern outside of the folder matches nothing."""
    write(tmp_path, CLOCKS)
    with pytest.raises(InputError, match=message):
        paired_pictures(tmp_path, 3, Pairing(**options))
