"""Pictures of two cameras whose names tell the camera in less usual ways than those of `picture_pairs`.

Recorders number their cameras, `cam0_3` and `cam1_3`, say it in the middle of a name or twice, keep a folder for each
view, or name pictures by the time. Each way is tried in turn, the most explicit first, and counts if its names pair up.
Links are not followed. No picture is opened here.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from tvsbayes.cameras.picture_pairs import SUFFIXES, Picture, natural_order, pictures_of
from tvsbayes.errors import escaped, refusal
from tvsbayes.instrument.campaign import CAMERAS

OTHER_SUFFIXES = (".bmp", ".pgm", ".ppm", ".pnm", ".tif", ".tiff", ".webp")
"""Pictures too, but none that `files.images` reads."""
DEPTH_MAX = 3
"""Folders below the one that was named: set/left/, set/01/cam0/."""
NUMBERED_PAIRS_MIN = 3
"""A number tells cameras apart only where it does so this often: two frames may be called 0 and 1 by chance."""
_WORDS = re.compile("left|right", re.IGNORECASE)
_LETTERS = re.compile(r"(?<![A-Za-z])[lLrR](?![A-Za-z])|(?<=[a-z0-9])[LR](?![A-Za-z])")
_NUMBERS = (
    *(
        re.compile(rf"(?<![a-z]){word}[_ -]?0*([0-9]{{1,9}})(?![0-9])", re.IGNORECASE)
        for word in ("camera", "cam", "c", "sensor", "image", "img")
    ),
    re.compile(r"[_-]0*([0-9]{1,9})$"),
)


def paired_pictures(
    folder: Path, *, swap: bool = False, most: int, globs: tuple[str, str] | None = None, in_order: bool = False
) -> list[Picture]:
    """The pictures of a folder as `pictures_of` has them; where its names give no pair, by other marks in them.

    Args:
        folder: with pictures in it or in folders below.
        swap: the left camera is the right half of wide pictures, or has the larger number or the later folder.
        most: how many pictures there may be.
        globs: patterns of the pictures of the left and of the right camera, below the folder.
        in_order: whether the first of the left belongs to the first of the right camera, whatever their names.

    Raises:
        InputError: no readable folder, too many pictures, two of one camera and view, or none of a format that is read.
    """
    if globs is not None or in_order:
        return _stated_pairs(Path(folder), globs, CAMERAS[::-1] if swap else CAMERAS, most)
    usual = pictures_of(folder, swap=swap, most=most)
    if any(count > 1 for count in Counter(picture.view for picture in usual if len(picture.sides) == 1).values()):
        return usual
    names = sorted(_names(Path(folder)), key=natural_order)
    images = [name for name in names if name.lower().endswith(SUFFIXES)]
    others = [name for name in names if name.lower().endswith(OTHER_SUFFIXES)]
    place = escaped(str(folder), 200)
    if not images and others:
        found = f"{len(others)} pictures such as {escaped(others[0], 100)}"
        remedy = "convert them without loss, for example: mogrify -format png *" + Path(others[0]).suffix
        raise refusal("image", file=place, found=found, allowed="PNG or JPEG", remedy=remedy)
    if len(images) > most:
        found, remedy = f"{len(images)} pictures", "move those that are not needed elsewhere"
        raise refusal("size", file=place, found=found, allowed=f"at most {most}", remedy=remedy)
    return _paired_otherwise(Path(folder), images, CAMERAS[::-1] if swap else CAMERAS) or usual


def _stated_pairs(folder: Path, globs: tuple[str, str] | None, sides: tuple[str, str], most: int) -> list[Picture]:
    """Pictures in the order of their names, the first of one camera with the first of the other.

    The cameras are those of two patterns, else of two folders, else of the names.

    Raises:
        InputError: no two cameras, unlike numbers of pictures, or too many.
    """
    place = escaped(str(folder), 200)
    if globs is not None:
        # Of a pattern that leaves the folder nothing is taken.
        inside = [pattern for pattern in globs if not Path(pattern).is_absolute() and ".." not in Path(pattern).parts]
        groups = [
            sorted((str(p) for p in folder.glob(pattern) if p.is_file()), key=natural_order) for pattern in inside
        ]
    else:
        names = sorted((n for n in _names(folder) if n.lower().endswith(SUFFIXES)), key=natural_order)
        stems = [name[: name.rindex(".")] for name in names]
        marked = next(
            (keys for keys in ([_by_words(s) for s in stems], [_by_letter(s) for s in stems]) if any(keys)),
            _by_folder(stems, sides),
        )
        groups = [
            [str(folder / n) for n, key in zip(names, marked, strict=True) if key and key[1] == side]
            for side in CAMERAS
        ]
    counts = [len(group) for group in groups]
    if len(groups) < 2 or not all(counts):
        found = f"{' and '.join(str(count) for count in counts) or 'no'} pictures of the left and the right camera"
        remedy = 'name them: --left "cam_a/*.png" --right "cam_b/*.png"'
        raise refusal("no-pictures", file=place, found=found, allowed="pictures of two cameras", remedy=remedy)
    if counts[0] != counts[1] or sum(counts) > most:
        found, allowed = f"{counts[0]} left and {counts[1]} right pictures", f"as many of both, together {most} at most"
        remedy = "take out those without their counterpart: pictures are paired by their order"
        raise refusal("size", file=place, found=found, allowed=allowed, remedy=remedy)
    views = [_plain(Path(path).stem) for path in groups[0]]
    views = views if len(set(views)) == len(views) else [f"pair {k}" for k in range(1, len(views) + 1)]
    return [
        Picture(view, Path(path), (side,))
        for side, group in zip(CAMERAS, groups, strict=True)
        for view, path in zip(views, group, strict=True)
    ]


def unnamed_pictures(folder: Path, used: Iterable[Picture]) -> tuple[str, ...]:
    """Pictures that lie in a folder or beside those of its pairs and are no part of them.

    Args:
        folder: as `paired_pictures` was given it.
        used: the pictures that tell their camera, or hold both.

    Returns:
        Their paths from the folder, in natural order.
    """
    known = {picture.path for picture in used}
    places = {Path(folder), *(path.parent for path in known)}
    paths = (Path(folder) / name for name in _names(Path(folder)) if name.lower().endswith(SUFFIXES))
    left = [path.relative_to(folder).as_posix() for path in paths if path.parent in places and path not in known]
    return tuple(sorted(left, key=natural_order))


def _names(folder: Path, below: str = "", depth: int = 0) -> Iterator[str]:
    """Files of a folder and of those in it, as paths from the outermost; hidden ones and links to folders left out."""
    try:
        entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
    except OSError:
        # What cannot be read holds no pictures for us; the outermost was read before.
        return
    for entry in entries:
        if entry.name.startswith("."):
            continue
        if not entry.is_dir(follow_symlinks=False):
            yield below + entry.name
        elif depth < DEPTH_MAX:
            yield from _names(Path(entry.path), f"{below}{entry.name}/", depth + 1)


def _paired_otherwise(folder: Path, images: Sequence[str], numbered: tuple[str, str]) -> list[Picture]:
    """The pictures with a side, by the first way in which names pair up; `numbered` are the sides of 0 and 1."""
    stems = [name[: name.rindex(".")] for name in images]
    ways: list[tuple[list[tuple[str, str] | None], int]] = [
        ([_by_words(stem) for stem in stems], 1),
        ([_by_letter(stem) for stem in stems], 1),
        *((_by_number(stems, pattern, numbered), NUMBERED_PAIRS_MIN) for pattern in _NUMBERS),
        (_by_folder(stems, numbered), NUMBERED_PAIRS_MIN),
    ]
    for found, least in ways:
        places = [(key, name) for key, name in zip(found, images, strict=True) if key is not None]
        sides = Counter(view for view, _ in {key for key, _ in places})
        if sum(count == 2 for count in sides.values()) >= least:
            return [Picture(_plain(view), folder / name, (side,)) for (view, side), name in places]
    for found, _ in ways[:2]:
        if ordered := _in_order(folder, images, found):
            return ordered
    return []


def _in_order(folder: Path, images: Sequence[str], found: Sequence[tuple[str, str] | None]) -> list[Picture]:
    """Pictures whose sides are known and whose names are not alike (times, say): the first with the first."""
    by_side = {
        side: [name for key, name in zip(found, images, strict=True) if key is not None and key[1] == side]
        for side in CAMERAS
    }
    left, right = by_side.values()
    if len(left) != len(right) or len(left) < NUMBERED_PAIRS_MIN:
        return []
    views = [_plain(Path(name).stem) for name in left]
    return [
        Picture(view, folder / name, (side,))
        for side, names in by_side.items()
        for view, name in zip(views, names, strict=True)
    ]


def _plain(key: str) -> str:
    """A view's name: what the names of its pictures have in common."""
    return re.sub(r"\*+", "", key).strip("/_- ") or key


def _key(stem: str, pattern: re.Pattern[str], side_of: Callable[[str], str]) -> tuple[str, str] | None:
    """The stem without its marks and the side that they name; None where they name none or both."""
    sides = {side_of(match.group()) for match in pattern.finditer(stem)}
    return (pattern.sub("*", stem), sides.pop()) if len(sides) == 1 else None


def _by_words(stem: str) -> tuple[str, str] | None:
    key = _key(stem, _WORDS, str.lower)
    # stereoLeft/imageL0 says it twice.
    return None if key is None else (_LETTERS.sub("*", key[0]), key[1])


def _by_letter(stem: str) -> tuple[str, str] | None:
    return _key(stem, _LETTERS, lambda mark: CAMERAS[mark.lower() == "r"])


def _by_number(stems: Sequence[str], pattern: re.Pattern[str], sides: tuple[str, str]) -> list[tuple[str, str] | None]:
    """Sides by the last number of a kind, where there are exactly two such numbers."""
    matches = [list(pattern.finditer(stem))[-1:] for stem in stems]
    numbers = sorted({int(match[1]) for found in matches for match in found})
    if len(numbers) != 2:
        return [None] * len(stems)
    return [
        (f"{stem[: found[0].start()]}*{stem[found[0].end() :]}", sides[numbers.index(int(found[0][1]))])
        if found
        else None
        for stem, found in zip(stems, matches, strict=True)
    ]


def _by_folder(stems: Sequence[str], sides: tuple[str, str]) -> list[tuple[str, str] | None]:
    """Sides by the folder, where there are exactly two; equal names in both are a pair."""
    folders = sorted({stem.rpartition("/")[0] for stem in stems}, key=natural_order)
    if len(folders) != 2:
        return [None] * len(stems)
    parts = [stem.rpartition("/") for stem in stems]
    return [(name, sides[folders.index(place)]) for place, _, name in parts]
