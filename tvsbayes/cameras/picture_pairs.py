"""Pictures of two cameras in a folder: the camera of each file, and the pairs.

A view is one moment of both cameras; its name is the file name without the mark of the camera. The documented names
(`NAMING`) are tried first. Recorders also number their cameras, `cam0_3` and `cam1_3`, put the mark in the middle of a
name or twice, keep a folder for each view, or name pictures by the time. Each naming is tried in turn, the most
explicit first, and used if the names form pairs. Links are not followed. Sizes come from headers; nothing is decoded.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from tvsbayes.errors import InputError, all_of, escaped, refusal
from tvsbayes.files.disk import read_bytes
from tvsbayes.files.images import IMAGE_BYTES_MAX, image_size
from tvsbayes.instrument.campaign import CAMERAS

SUFFIXES = (".png", ".jpg", ".jpeg")
OTHER_SUFFIXES = (".bmp", ".pgm", ".ppm", ".pnm", ".tif", ".tiff", ".webp")
"""Picture formats not read by `files.images`."""
SIDE_BY_SIDE_RATIO = 2.0
"""Least aspect ratio of a picture without a side in its name that counts as the images of both cameras."""
Size = tuple[int, int]
"""Width and height, px."""
NAMING = "left01.png with right01.png, 01_left.png with 01_right.png, or folders left/ and right/"
"""Names of the pictures of two cameras, for messages."""
DEPTH_MAX = 3
"""Number of levels of subfolders searched: set/left/, set/01/cam0/."""
NUMBERED_PAIRS_MIN = 3
"""Least number of pairs for which a number marks the camera: two frames may be named 0 and 1 by chance."""
_SIDES = {"l": "left", "r": "right", "left": "left", "right": "right"}
_DOCUMENTED = (
    # left01, then 01_left, L01 or l_01, 01L or 01_l: a single letter counts only beside a digit or a separator.
    re.compile(r"(?P<side>left|right)(?P<view>.*)", re.IGNORECASE | re.DOTALL),
    re.compile(r"(?P<view>.*?)[ _.-]*(?P<side>left|right)", re.IGNORECASE | re.DOTALL),
    re.compile(r"(?P<side>[lr])(?P<view>[ _.-]*[0-9].*)", re.IGNORECASE | re.DOTALL),
    re.compile(r"(?P<view>.*[0-9])[ _.-]*(?P<side>[lr])", re.IGNORECASE | re.DOTALL),
)
_WORDS = re.compile("left|right", re.IGNORECASE)
_LETTERS = re.compile(r"(?<![A-Za-z])[lLrR](?![A-Za-z])|(?<=[a-z0-9])[LR](?![A-Za-z])")
_NUMBERS = (
    *(
        re.compile(rf"(?<![a-z]){word}[_ -]?0*([0-9]{{1,9}})(?![0-9])", re.IGNORECASE)
        for word in ("camera", "cam", "c", "sensor", "image", "img")
    ),
    re.compile(r"[_-]0*([0-9]{1,9})$"),
)
_Key = tuple[str, str]
"""A name without the marks of the camera, and their side of the pair."""


def natural_order(name: str) -> list[tuple[int, str]]:
    """A key that sorts 2 before 10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]{1,18})", name.lower())]


@dataclass(frozen=True)
class Picture:
    """A file, and the cameras of its equal-width parts from left to right."""

    view: str
    path: Path
    sides: tuple[str, ...]


@dataclass(frozen=True)
class Pairing:
    """The camera of each picture, as the user states it.

    Attributes:
        swap: the left camera's image is the right half of a wide frame, or has the larger number or later folder.
        globs: patterns of the pictures of the left and of the right camera, below the folder.
        in_order: the first picture of the left camera belongs to the first of the right, for any names.
    """

    swap: bool = False
    globs: tuple[str, str] | None = None
    in_order: bool = False

    @property
    def sides(self) -> tuple[str, str]:
        """The cameras of the left and the right half, or of the smaller and the larger number."""
        return CAMERAS[::-1] if self.swap else CAMERAS


AS_NAMED = Pairing()


@dataclass(frozen=True)
class PictureFolder:
    """The pictures of two cameras in a folder, by their headers.

    Attributes:
        folder: folder of the pictures.
        count: number of pictures read.
        sizes: size of one camera's image, px, in every picture of a known camera or of both.
        usual: the most frequent picture size of each camera, the larger of equal counts; (0, 0) without any.
    """

    folder: Path
    count: int
    sizes: Mapping[Picture, Size]
    usual: Mapping[str, Size]

    @property
    def used(self) -> list[Picture]:
        """Pictures of the usual size."""
        return [p for p, size in self.sizes.items() if all(size == self.usual[side] for side in p.sides)]

    @property
    def other_size(self) -> list[Path]:
        """Files of another size than most, relative to the folder."""
        used = set(self.used)
        return [picture.path.relative_to(self.folder) for picture in self.sizes if picture not in used]

    @property
    def unnamed(self) -> tuple[str, ...]:
        """Pictures in the folder or beside its pairs that belong to no pair, relative to the folder, in order."""
        known = {picture.path for picture in self.sizes}
        folders = {self.folder, *(path.parent for path in known)}
        names = [name for name in _names(self.folder) if name.lower().endswith(SUFFIXES)]
        rest = [name for name in names if (path := self.folder / name).parent in folders and path not in known]
        return tuple(sorted(rest, key=natural_order))


def read_folder(folder: Path, most: int, pixels_max: int, pairing: Pairing = AS_NAMED) -> PictureFolder:
    """List the pictures of a folder with their sizes; one without a side counts if it is wide enough for both cameras.

    Args:
        folder: folder of the pictures.
        most: largest number of pictures.
        pixels_max: largest number of pixels of one picture.
        pairing: the camera of each picture.

    Raises:
        InputError: as `paired_pictures`; lists all pictures that cannot be read or are too large.
    """
    folder, sizes, refused = Path(folder), {}, []
    pictures = paired_pictures(folder, most, pairing)
    for picture in pictures:
        try:
            name = escaped(picture.path.name)
            width, height = image_size(read_bytes(picture.path, IMAGE_BYTES_MAX, folder), name)
            if width * height > pixels_max:
                found, allowed = f"{width} x {height} pixels", f"at most {pixels_max // 1_000_000} million pixels"
                raise refusal("image-size", file=name, found=found, allowed=allowed, remedy="record smaller pictures")
        except InputError as error:
            refused.append(error)
            continue
        if len(picture.sides) == 1 or width >= SIDE_BY_SIDE_RATIO * height:
            sizes[picture] = width // len(picture.sides), height
    if refused:
        raise all_of(refused)
    usual: dict[str, Size] = {}
    for side in CAMERAS:
        counts = Counter(size for picture, size in sizes.items() if side in picture.sides)
        usual[side] = max(counts, key=lambda size_px: (counts[size_px], size_px), default=(0, 0))
    return PictureFolder(folder, len(pictures), sizes, usual)


def paired_pictures(folder: Path, most: int, pairing: Pairing = AS_NAMED) -> list[Picture]:
    """The pictures of a folder, paired by the documented names if these form a pair, else by other marks, else wide.

    Args:
        folder: folder with pictures in it or in its subfolders.
        most: largest number of pictures.
        pairing: the camera of each picture.

    Raises:
        InputError: no readable folder, too many pictures, two of one camera and view, or none in a readable format;
            where pairs are stated, no two cameras or different numbers of pictures.
    """
    folder = Path(folder)
    refuse = partial(refusal, file=escaped(str(folder), 200))
    if pairing.globs is not None or pairing.in_order:
        return _stated_pairs(folder, pairing, most, refuse)

    def check_count(images: Sequence[object]) -> None:
        if len(images) > most:
            found, remedy = f"{len(images)} pictures", "move those that are not needed elsewhere"
            raise refuse("size", found=found, allowed=f"at most {most}", remedy=remedy)

    direct = [folder / entry.name for entry in _entries(folder) if _is_picture(entry)]
    documented = [Picture(key[0], path, (key[1],)) for path in direct if (key := _documented(path.stem))]
    documented = documented or _from_side_folders(folder)
    check_count(documented or direct)
    first_paths: dict[tuple[str, tuple[str, ...]], Path] = {}
    for picture in documented:
        first = first_paths.setdefault((picture.view, picture.sides), picture.path)
        if first != picture.path:
            found = f"{escaped(first.name)} and {escaped(picture.path.name)}, two pictures of one camera and view"
            raise refuse("duplicate", found=found, allowed="one", remedy="keep one file per camera and view")
    if any(count > 1 for count in Counter(picture.view for picture in documented).values()):
        return documented
    names = sorted(_names(folder), key=natural_order)
    images = [name for name in names if name.lower().endswith(SUFFIXES)]
    others = [name for name in names if name.lower().endswith(OTHER_SUFFIXES)]
    if not images and others:
        found = f"{len(others)} pictures such as {escaped(others[0], 100)}"
        remedy = "convert them without loss, for example: mogrify -format png *" + Path(others[0]).suffix
        raise refuse("image", found=found, allowed="PNG or JPEG", remedy=remedy)
    check_count(images)
    by_marks = _paired_by_marks(folder, images, pairing.sides)
    return by_marks or documented or [Picture(path.stem, path, pairing.sides) for path in direct]


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    """The entries of a folder, in natural order, without hidden ones."""
    try:
        entries = [entry for entry in os.scandir(folder) if not entry.name.startswith(".")]
    except OSError as error:
        found, allowed = escaped(error.strerror or str(error)), "a readable folder"
        remedy, place = "name the folder of the pictures", escaped(str(folder), 200)
        raise refusal("unreadable", file=place, found=found, allowed=allowed, remedy=remedy) from error
    return sorted(entries, key=lambda entry: natural_order(entry.name))


def _is_picture(entry: os.DirEntry[str]) -> bool:
    return entry.name.lower().endswith(SUFFIXES)


def _names(folder: Path, below: str = "", depth: int = 0) -> Iterator[str]:
    """Files of a folder and its subfolders, relative to the outermost; links to folders are left out."""
    try:
        entries = _entries(folder)
    except InputError:
        # Subfolders that cannot be read are left out; the outermost folder was read before.
        return
    for entry in entries:
        if not entry.is_dir(follow_symlinks=False):
            yield below + entry.name
        elif depth < DEPTH_MAX:
            yield from _names(Path(entry.path), f"{below}{entry.name}/", depth + 1)


def _documented(stem: str) -> _Key | None:
    """View and camera of a name without suffix that follows `NAMING`; None without a camera."""
    matches = (match for pattern in _DOCUMENTED if (match := pattern.fullmatch(stem)))
    return next(((match["view"], _SIDES[match["side"].lower()]) for match in matches), None)


def _from_side_folders(folder: Path) -> list[Picture]:
    """Pictures in folders that are named after their camera; views by file name."""
    pictures = []
    for entry in _entries(folder):
        name = entry.name.lower()
        matches = [side for side in CAMERAS if name.startswith(side) or name.endswith(side)]
        side = _SIDES.get(name) or (matches[0] if len(matches) == 1 else None)
        if side is None or not entry.is_dir(follow_symlinks=False):
            continue
        for path in (Path(picture.path) for picture in _entries(Path(entry.path)) if _is_picture(picture)):
            key = _documented(path.stem)
            pictures.append(Picture(key[0] if key and key[1] == side else path.stem, path, (side,)))
    return pictures


def _stated_pairs(folder: Path, pairing: Pairing, most: int, refuse: Callable[..., InputError]) -> list[Picture]:
    """Pair pictures in the order of their names, the first of one camera with the first of the other.

    The cameras are those of two patterns, else of two folders, else of the names.
    """
    if pairing.globs is not None:
        # A pattern that leaves the folder matches nothing.
        inside = [glob for glob in pairing.globs if not Path(glob).is_absolute() and ".." not in Path(glob).parts]
        matches = [[p.relative_to(folder).as_posix() for p in folder.glob(glob) if p.is_file()] for glob in inside]
        groups = [sorted(names, key=natural_order) for names in matches]
    else:
        names = sorted((n for n in _names(folder) if n.lower().endswith(SUFFIXES)), key=natural_order)
        stems = [name[: name.rindex(".")] for name in names]
        by_name = ([_by_words(stem) for stem in stems], [_by_letter(stem) for stem in stems])
        keys = next((keys for keys in by_name if any(keys)), _by_folder(stems, pairing.sides))
        groups = list(_by_side(names, keys).values())
    counts = [len(group) for group in groups]
    if len(groups) < 2 or not all(counts):
        found = f"{' and '.join(str(count) for count in counts) or 'no'} pictures of the left and the right camera"
        remedy = 'name them: --left "cam_a/*.png" --right "cam_b/*.png"'
        raise refuse("no-pictures", found=found, allowed="pictures of two cameras", remedy=remedy)
    if counts[0] != counts[1] or sum(counts) > most:
        found, allowed = f"{counts[0]} left and {counts[1]} right pictures", f"as many of both, together {most} at most"
        remedy = "take out those without their counterpart: pictures are paired by their order"
        raise refuse("size", found=found, allowed=allowed, remedy=remedy)
    return _in_order(folder, groups)


def _by_side(names: Sequence[str], keys: Sequence[_Key | None]) -> dict[str, list[str]]:
    """Names of each camera."""
    sided = [(name, key[1]) for name, key in zip(names, keys, strict=True) if key is not None]
    return {side: [name for name, camera in sided if camera == side] for side in CAMERAS}


def _in_order(folder: Path, groups: Sequence[Sequence[str]]) -> list[Picture]:
    """Pair the first picture of the left camera with the first of the right one."""
    views = [_view_name(Path(name).stem) for name in groups[0]]
    views = views if len(set(views)) == len(views) else [f"pair {k}" for k in range(1, len(views) + 1)]
    return [
        Picture(view, folder / name, (side,))
        for side, names in zip(CAMERAS, groups, strict=True)
        for view, name in zip(views, names, strict=True)
    ]


def _paired_by_marks(folder: Path, images: Sequence[str], numbered: tuple[str, str]) -> list[Picture]:
    """The pictures with a side, by the first method whose names form pairs; `numbered` are the sides of 0 and 1.

    Where sides are known but no names match (times, for example), pictures are paired in order.
    """
    stems = [name[: name.rindex(".")] for name in images]
    by_name = [[_by_words(stem) for stem in stems], [_by_letter(stem) for stem in stems]]
    methods = [
        *((keys, 1) for keys in by_name),
        *((_by_number(stems, pattern, numbered), NUMBERED_PAIRS_MIN) for pattern in _NUMBERS),
        (_by_folder(stems, numbered), NUMBERED_PAIRS_MIN),
    ]
    for keys, pairs_min in methods:
        sided = [(key, name) for key, name in zip(keys, images, strict=True) if key is not None]
        pictures_of_view = Counter(view for view, _ in {key for key, _ in sided})
        if sum(count == 2 for count in pictures_of_view.values()) >= pairs_min:
            return [Picture(_view_name(view), folder / name, (side,)) for (view, side), name in sided]
    for keys in by_name:
        left, right = _by_side(images, keys).values()
        if len(left) == len(right) >= NUMBERED_PAIRS_MIN:
            return _in_order(folder, (left, right))
    return []


def _view_name(key: str) -> str:
    """The name of a view: the common part of the names of its pictures."""
    return re.sub(r"\*+", "", key).strip("/_- ") or key


def _key(stem: str, pattern: re.Pattern[str]) -> _Key | None:
    """The stem without its marks, and their side; None for no side or both."""
    sides = {_SIDES[match.group().lower()] for match in pattern.finditer(stem)}
    return (pattern.sub("*", stem), sides.pop()) if len(sides) == 1 else None


def _by_words(stem: str) -> _Key | None:
    key = _key(stem, _WORDS)
    # Names such as stereoLeft/imageL0 have two marks.
    return None if key is None else (_LETTERS.sub("*", key[0]), key[1])


def _by_letter(stem: str) -> _Key | None:
    return _key(stem, _LETTERS)


def _by_number(stems: Sequence[str], pattern: re.Pattern[str], sides: tuple[str, str]) -> list[_Key | None]:
    """Sides by the last number that matches a pattern, where exactly two such numbers exist."""
    last = [next(reversed(list(pattern.finditer(stem))), None) for stem in stems]
    numbers = sorted({int(match[1]) for match in last if match is not None})
    if len(numbers) != 2:
        return [None] * len(stems)
    return [
        None if m is None else (f"{stem[: m.start()]}*{stem[m.end() :]}", sides[numbers.index(int(m[1]))])
        for stem, m in zip(stems, last, strict=True)
    ]


def _by_folder(stems: Sequence[str], sides: tuple[str, str]) -> list[_Key | None]:
    """Sides by the folder, where exactly two exist; equal names in both form a pair."""
    parts = [stem.rpartition("/") for stem in stems]
    folders = sorted({folder for folder, _, _ in parts}, key=natural_order)
    if len(folders) != 2:
        return [None] * len(stems)
    return [(name, sides[folders.index(folder)]) for folder, _, name in parts]
