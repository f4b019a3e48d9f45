"""Pictures of two cameras in a folder: which file is of which camera, and which belong together.

A view is one moment of both cameras; its name is what is left of a file's name without the word for the camera. Headers
tell sizes; nothing is decoded here.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from tvsbayes.errors import InputError, all_of, escaped, refusal
from tvsbayes.files.disk import read_bytes
from tvsbayes.files.images import IMAGE_BYTES_MAX, image_size
from tvsbayes.instrument.campaign import CAMERAS

SUFFIXES = (".png", ".jpg", ".jpeg")
SIDE_BY_SIDE_RATIO = 2.0
"""Width over height from which a picture that is named neither left nor right holds both cameras' images."""
Size = tuple[int, int]
"""Width and height, px."""
NAMING = "left01.png with right01.png, 01_left.png with 01_right.png, or folders left/ and right/"
"""How pictures of two cameras are named, for messages."""
_LETTERS = {"l": "left", "r": "right", "left": "left", "right": "right"}
_WORDS = (
    # left01, then 01_left, L01 or l_01, 01L or 01_l: a letter alone counts beside a digit or a separator only.
    re.compile(r"(?P<side>left|right)(?P<view>.*)", re.IGNORECASE | re.DOTALL),
    re.compile(r"(?P<view>.*?)[ _.-]*(?P<side>left|right)", re.IGNORECASE | re.DOTALL),
    re.compile(r"(?P<side>[lr])(?P<view>[ _.-]*[0-9].*)", re.IGNORECASE | re.DOTALL),
    re.compile(r"(?P<view>.*[0-9])[ _.-]*(?P<side>[lr])", re.IGNORECASE | re.DOTALL),
)


def natural_order(name: str) -> list[tuple[int, str]]:
    """A key that sorts 2 before 10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]{1,18})", name.lower())]


@dataclass(frozen=True)
class Picture:
    """A file and whose images its equal parts, from left to right, are."""

    view: str
    path: Path
    sides: tuple[str, ...]


def sizes_of(pictures: Iterable[Picture], folder: Path, most: int) -> dict[Picture, Size]:
    """The size of one camera's image in every picture, by its header.

    Args:
        pictures: those that are named after no camera count where they are wide enough for both.
        folder: where they lie.
        most: pixels that a picture may have.

    Raises:
        InputError: pictures that cannot be read or are too large, all of them.
    """
    sizes: dict[Picture, Size] = {}
    refused = []
    for picture in pictures:
        try:
            name = escaped(picture.path.name)
            width, height = image_size(read_bytes(picture.path, IMAGE_BYTES_MAX, folder), name)
            if width * height > most:
                found, allowed = f"{width} x {height} pixels", f"at most {most // 1_000_000} million pixels"
                raise refusal("image-size", file=name, found=found, allowed=allowed, remedy="record smaller pictures")
        except InputError as error:
            refused.append(error)
            continue
        if len(picture.sides) == 1 or width >= SIDE_BY_SIDE_RATIO * height:
            sizes[picture] = width // len(picture.sides), height
    if refused:
        raise all_of(refused)
    return sizes


def usual_sizes(sizes: Mapping[Picture, Size]) -> dict[str, Size]:
    """The size, px, that most pictures of each camera have; of equally many the larger."""
    found: dict[str, Size] = {}
    for side in CAMERAS:
        counted = Counter(size for picture, size in sizes.items() if side in picture.sides)
        found[side] = max(counted, key=lambda one: (counted[one], one), default=(0, 0))
    return found


def _sided(stem: str) -> tuple[str, str] | None:
    """Camera and view of a name without suffix; None where it tells no camera."""
    for pattern in _WORDS:
        if found := pattern.fullmatch(stem):
            return _LETTERS[found["side"].lower()], found["view"]
    return None


def _camera_of(folder: str) -> str | None:
    """The camera whose pictures a folder of this name holds."""
    name = folder.lower()
    sides = [side for side in CAMERAS if name.startswith(side) or name.endswith(side)]
    return _LETTERS.get(name) or (sides[0] if len(sides) == 1 else None)


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    try:
        return sorted(os.scandir(folder), key=lambda entry: natural_order(entry.name))
    except OSError as error:
        place, remedy = escaped(str(folder), 200), "name the folder of the pictures"
        found, allowed = escaped(error.strerror or str(error)), "a readable folder"
        raise refusal("unreadable", file=place, found=found, allowed=allowed, remedy=remedy) from error


def _images(entries: list[os.DirEntry[str]]) -> list[Path]:
    """Pictures by their suffix; a name that begins with a dot is hidden."""
    return [Path(e.path) for e in entries if e.name.lower().endswith(SUFFIXES) and not e.name.startswith(".")]


def _in_folders(entries: list[os.DirEntry[str]]) -> list[Picture]:
    """Pictures in folders that are named after their camera, by their own names."""
    found = []
    for entry in entries:
        side = _camera_of(entry.name) if entry.is_dir(follow_symlinks=False) else None
        for path in _images(_entries(Path(entry.path))) if side else ():
            own = _sided(path.stem)
            found.append(Picture(own[1] if own and own[0] == side else path.stem, path, (str(side),)))
    return found


def pictures_of(folder: Path, *, swap: bool = False, most: int) -> list[Picture]:
    """The pictures of a folder: those named left or right, else those in folders so named, else wide ones of both.

    Args:
        folder: where they lie.
        swap: the left camera's image is the right half of a wide picture.
        most: how many there may be.

    Raises:
        InputError: no readable folder, too many pictures, or two of one camera and view.
    """
    entries = _entries(Path(folder))
    images = _images(entries)
    sided = [Picture(own[1], path, (own[0],)) for path in images if (own := _sided(path.stem))] or _in_folders(entries)
    place = escaped(str(folder), 200)
    if len(sided or images) > most:
        found, remedy = f"{len(sided or images)} pictures", "move those that are not needed elsewhere"
        raise refusal("size", file=place, found=found, allowed=f"at most {most}", remedy=remedy)
    seen: dict[tuple[str, tuple[str, ...]], Path] = {}
    for picture in sided:
        first = seen.setdefault((picture.view, picture.sides), picture.path)
        if first != picture.path:
            found = f"{escaped(first.name)} and {escaped(picture.path.name)}, two pictures of one camera and view"
            remedy = "keep one file per camera and view"
            raise refusal("duplicate", file=place, found=found, allowed="one", remedy=remedy)
    return sided or [Picture(path.stem, path, CAMERAS[::-1] if swap else CAMERAS) for path in images]
