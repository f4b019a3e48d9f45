"""Pictures of two cameras in a folder: the camera of each file, and the pairs.

The word nearest the end of a file's name says which camera took it (`exp01_P1_L`, `camL_3`, `izq`, `cam0`), else the
deepest folder that has one. Words that also name directions of motion (`left/`, `right_exp01`) give way to any other
word of a camera, and beside `up` and `down` they are none. A view is one moment of both cameras: the rest of the name.
The words are data, `data/words/pictures.toml`. Links are not followed. Sizes come from headers; nothing is decoded.
"""

from __future__ import annotations

import os
import re
import tomllib
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise, takewhile
from pathlib import Path
from typing import NamedTuple

from tvsbayes.errors import Candidate, InputError, Question, all_of, escaped, listed, question, refusal
from tvsbayes.files.disk import read_bytes, shipped_data
from tvsbayes.files.images import IMAGE_BYTES_MAX, image_size
from tvsbayes.importing.words import vocabulary
from tvsbayes.instrument.campaign import CAMERAS

SUFFIXES = (".png", ".jpg", ".jpeg")
OTHER_SUFFIXES = (".bmp", ".pgm", ".ppm", ".pnm", ".tif", ".tiff", ".webp")
"""Picture formats not read by `files.images`."""
SIDE_BY_SIDE_RATIO = 2.0
"""Least aspect ratio of a picture without a side in its name that counts as the images of both cameras."""
Size = tuple[int, int]
"""Width and height, px."""
NAMING = "left01.png with right01.png, 01_L.png with 01_R.png, or folders left/ and right/"
"""Names of the pictures of two cameras, for messages."""
DEPTH_MAX = 8
"""Number of levels of subfolders searched."""
NUMBERED_PAIRS_MIN = 3
"""Least number of pairs for which a bare number marks the camera: two frames may be named 0 and 1 by chance."""
DUPLICATES_SHOWN = 3


def natural_order(name: str) -> list[tuple[int, str]]:
    """A key that sorts 2 before 10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]{1,18})", name.lower())]


@dataclass(frozen=True)
class Picture:
    """A file, by its name below a folder, and the cameras of its equal-width parts from left to right."""

    view: str
    folder: Path
    name: str
    sides: tuple[str, ...]

    @property
    def path(self) -> Path:
        """The file."""
        return self.folder / self.name


@dataclass(frozen=True)
class Pairing:
    """The camera of each picture, as the user states it.

    Attributes:
        swap: the left camera's image is the right half of a wide frame, or has the larger number or later folder.
        globs: patterns of the pictures of the left and of the right camera, below the folder.
        in_order: the first picture of the left camera belongs to the first of the right, for any names.
        asks: pairs that names do not decide are asked about, not guessed.
    """

    swap: bool = False
    globs: tuple[str, str] | None = None
    in_order: bool = False
    asks: bool = False

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
    def other_size(self) -> tuple[str, ...]:
        """Files of another size than most, relative to the folder."""
        used = set(self.used)
        return tuple(picture.name for picture in self.sizes if picture not in used)

    def left_out(self, suffixes: tuple[str, ...] = SUFFIXES) -> tuple[str, ...]:
        """Files of these kinds without a camera, or in folders below a folder with pairs, relative to the folder."""
        known = {picture.name for picture in self.sizes}
        return tuple(name for name in picture_names(self.folder, suffixes) if name not in known)


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
    if pairing.asks and pairing.globs is None and sizes:
        wide = all(width >= SIDE_BY_SIDE_RATIO * height for width, height in sizes.values())
        if wide and all(len(picture.sides) == 1 for picture in sizes):
            raise _question(folder, {p.name: Key(p.view, p.sides[0]) for p in sizes}, wide=True)
    usual: dict[str, Size] = {}
    for side in CAMERAS:
        counts = Counter(size for picture, size in sizes.items() if side in picture.sides)
        usual[side] = max(counts, key=lambda size_px: (counts[size_px], size_px), default=(0, 0))
    return PictureFolder(folder, len(pictures), sizes, usual)


def paired_pictures(folder: Path, most: int, pairing: Pairing = AS_NAMED) -> list[Picture]:
    """The pictures of a folder with their cameras: those in it if they form a pair, else with those in folders below.

    Where no words form pairs, numbers beside a word or at the end, two folders, or the order of the names are guesses.
    Without any, every picture may hold the images of both cameras.

    Args:
        folder: folder with pictures in it or in its subfolders.
        most: largest number of pictures.
        pairing: the camera of each picture.

    Raises:
        InputError: no readable folder, too many pictures, two of one camera and view, or none in a readable format;
            where pairs are stated, no two cameras or different numbers of pictures.
        Question: `pairing.asks`, and pairs would be guessed.
    """
    folder = Path(folder)
    place = escaped(str(folder), 200)
    if pairing.globs is not None or pairing.in_order:
        return _stated_pairs(folder, pairing, most, place)
    images = picture_names(folder)
    if not images and (others := picture_names(folder, OTHER_SUFFIXES)):
        found = f"{len(others)} pictures such as {escaped(others[0], 100)}"
        remedy = "convert them without loss, for example: mogrify -format png *" + Path(others[0]).suffix
        raise refusal("image", file=place, found=found, allowed="PNG or JPEG", remedy=remedy)
    direct = [name for name in images if "/" not in name]
    named = named_cameras(direct, pairing.sides)
    if not _complete(named) and len(direct) < len(images):
        named = named_cameras(images, pairing.sides)
    if len(named or images) > most:
        found, remedy = f"{len(named or images)} pictures", "move those that are not needed elsewhere"
        raise refusal("size", file=place, found=found, allowed=f"at most {most}", remedy=remedy)
    by_key: dict[tuple[str, str], list[str]] = defaultdict(list)
    for name, key in named.items():
        by_key[key[:2]].append(name)
    twice = [" and ".join(escaped(name, 80) for name in own) for own in by_key.values() if len(own) > 1]
    if twice:
        found = f"{listed(twice, DUPLICATES_SHOWN)}: two pictures of one camera and view"
        remedy = "keep one file per camera and view"
        raise refusal("duplicate", file=place, found=found, allowed="one", remedy=remedy)
    if _complete(named):
        return _pictures(folder, named)
    guessed = _guessed(images, named, pairing)
    if guessed and pairing.asks:
        raise _question(folder, guessed)
    # Without a guess of one camera alone, or each of both: the size decides.
    if guessed or (named and len(named) == len(images)):
        return _pictures(folder, guessed or named)
    return [Picture(_stem(name), folder, name, pairing.sides) for name in images]


def picture_names(folder: Path, suffixes: tuple[str, ...] = SUFFIXES) -> list[str]:
    """Files of these kinds in a folder and its subfolders, relative to it, in natural order.

    Hidden ones and links to folders are left out.

    Raises:
        InputError: the folder cannot be read.
    """

    def found_in(folder: Path, below: str, depth: int) -> Iterator[str]:
        try:
            entries = [entry for entry in os.scandir(folder) if not entry.name.startswith(".")]
        except OSError as error:
            if below:
                return
            found, allowed = escaped(error.strerror or str(error)), "a readable folder"
            remedy, place = "name the folder of the pictures", escaped(str(folder), 200)
            raise refusal("unreadable", file=place, found=found, allowed=allowed, remedy=remedy) from error
        for entry in entries:
            if entry.is_dir(follow_symlinks=False):
                if depth < DEPTH_MAX:
                    yield from found_in(Path(entry.path), f"{below}{entry.name}/", depth + 1)
            elif entry.name.lower().endswith(suffixes):
                yield below + entry.name

    return sorted(found_in(folder, "", 0), key=natural_order)


# --- words of cameras in a name --------------------------------------------------------------------------------------
class Key(NamedTuple):
    """A name without its camera, by which pictures pair; the camera; the name as it is shown."""

    view: str
    side: str
    name: str = ""


Named = Mapping[str, Key]
"""Key of every file with a camera."""


class _Mark(NamedTuple):
    """A word of a camera in a path.

    Attributes:
        slot: where it stands: number of the part from the end, place in the part, whether it is a number.
        side: "left", "right", "" for a direction that is no camera; digits of a number that stands for one.
        rank: the higher is taken before the lower.
        start, end: its place in the path.
    """

    slot: tuple[int, str, bool]
    side: str
    rank: int
    start: int
    end: int


CAMERA, INSIDE, LETTER, DIRECTION, BESIDE_LETTERS = 5, 4, 3, 2, 1
"""Ranks: beside a word of a camera; in a name, before no experiment; a letter; a direction; beside `u`, `d`."""
_TOKENS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+|[^\W\dA-Za-z_]+")


@cache
def picture_words() -> dict[str, frozenset[str]]:
    """Words in names of pictures by what they say, in all languages."""
    content = tomllib.loads((shipped_data() / "words" / "pictures.toml").read_text("utf-8"))
    return {name: frozenset(" ".join(languages.values()).split()) for name, languages in content.items()}


def _stem(name: str) -> str:
    return name[: name.rindex(".")]


def _side_of(word: str) -> str:
    """The side that a word names, alone or joined to another word: leftcam, camL; "" for none."""
    words = picture_words()
    for side in CAMERAS:
        for own in words[side]:
            rest = word.removeprefix(own) if word.startswith(own) else word.removesuffix(own)
            joined = words["camera"] if len(own) == 1 else words["camera"] | words["picture"]
            if word == own or (rest != word and rest in joined):
                return side
    return ""


def is_experiment(word: str) -> bool:
    """Whether a number behind a word counts experiments: exp01."""
    return (word,) in vocabulary("experiment", "looks.toml")


def direction_of(word: str) -> str:
    """The direction of motion that a word names: left, right, up, down; "" for none."""
    if len(word) == 1:
        return ""
    return next((name for name in (*CAMERAS, "up", "down") if word in picture_words()[name]), "")


def directions_in(text: str) -> list[str]:
    """Directions of motion among the words of a text."""
    return [way for word in re.findall("[a-z]+", text.lower()) if (way := direction_of(word))]


def _marks(path: str, numbered: frozenset[str]) -> Iterator[_Mark]:
    """The words of cameras in a path without suffix; `numbered` words make a camera of the number behind them."""
    words, start = picture_words(), 0
    parts = path.split("/")
    for depth, part in zip(range(len(parts), 0, -1), parts, strict=True):
        tokens = list(_TOKENS.finditer(part))
        plain = [token.group().lower() for token in tokens]
        # The word behind each, where only separators stand between.
        gaps = (part[before.end() : after.start()].strip(" _.-") for before, after in pairwise(tokens))
        behind = ["" if gap else word for gap, word in zip(gaps, plain[1:], strict=True)] + [""]
        k, inner = 0, 0
        while k < len(tokens):
            word, after, size, rank, number = plain[k], behind[k], 1, 0, False
            side = _side_of(word)
            if word in numbered and after.isdigit():
                side, size, rank, number = after, 2, CAMERA, True
            elif word in words["camera"] and _side_of(after):
                side, size, rank = _side_of(after), 2, CAMERA
            elif side and after in words["camera"]:
                size, rank = 2, CAMERA
            elif side and word not in words[side] and len(word) < 8 and any(c in word for c in words["camera"]):
                rank = CAMERA
            elif side:
                is_prefix = depth > 1 or k == 0 or is_experiment(after)
                rank = INSIDE if not is_prefix else LETTER if len(word) == 1 else DIRECTION
            elif direction_of(word):
                rank = DIRECTION
            elif k == 0 and word in words["direction_letter"]:
                rank = BESIDE_LETTERS
            if rank:
                inside = k > 0 and k + size < len(tokens)
                place = f"{inner}" if inside else "last" if k else "first"
                inner += inside
                span = start + tokens[k].start(), start + tokens[k + size - 1].end()
                yield _Mark((depth, place, number), side, rank, *span)
            k += size
        start += len(part) + 1


def named_cameras(
    names: Sequence[str], sides: tuple[str, str] = CAMERAS, numbered: frozenset[str] | None = None
) -> dict[str, Key]:
    """View and camera of every file whose name or folder has a word of a camera that tells these files apart.

    Args:
        names: of files, relative to their folder.
        sides: cameras of the smaller and the larger number.
        numbered: words that make a camera of the number behind them; None: camera and its translations.
    """
    numbered = picture_words()["camera"] if numbered is None else numbered
    # Without accents.
    letters = {name: unicodedata.normalize("NFKD", _stem(name)) for name in names}
    paths = {name: "".join(c for c in path if not unicodedata.combining(c)) for name, path in letters.items()}
    marks = {name: list(_marks(path, numbered)) for name, path in paths.items()}
    by_slot: dict[tuple[int, str, bool], list[_Mark]] = defaultdict(list)
    for mark in (mark for own in marks.values() for mark in own):
        by_slot[mark.slot].append(mark)
    side_of: dict[tuple[int, str, bool], dict[str, str]] = {}
    for slot, own in by_slot.items():
        values = {mark.side for mark in own if mark.side}
        directions = any(not mark.side and mark.rank == DIRECTION for mark in own)
        side_of[slot] = {} if directions else {side: side for side in values}
        if slot[2]:
            two = sorted({*map(int, values)})
            side_of[slot] = {value: sides[two.index(int(value))] for value in values} if len(two) == 2 else {}
    telling = {slot for slot, of in side_of.items() if len({*of.values()}) == 2}
    weak = {mark.slot for own in by_slot.values() for mark in own if mark.rank == BESIDE_LETTERS}

    def worth(mark: _Mark) -> tuple[bool, int, int, int]:
        return mark.slot in telling, BESIDE_LETTERS if mark.slot in weak else mark.rank, -mark.slot[0], mark.start

    usable = {name: [mark for mark in own if mark.side and side_of[mark.slot]] for name, own in marks.items()}
    chosen = {name: max(own, key=worth) for name, own in usable.items() if own}
    camera = {name: side_of[mark.slot][mark.side] for name, mark in chosen.items()}
    # Another word that agrees in every file says the camera once more: stereoLeft/imageL0.
    agreeing = telling - {
        mark.slot
        for name, own in marks.items()
        for mark in own
        if mark.slot in telling and mark.side and camera.get(name) != side_of[mark.slot][mark.side]
    }
    keys = {}
    for name, mark in chosen.items():
        path = paths[name]
        # * for the marks and the separators before them.
        for m in sorted({mark, *(m for m in marks[name] if m.side and m.slot in agreeing)}, key=lambda m: -m.start):
            path = path[: m.start].rstrip(" _.-") + "*" + path[m.end :]
        keys[name] = Key(re.sub(r"\*[ _.-]+", "*", path), camera[name], path.replace("*", "").strip("/"))
    return keys


def _by_camera(named: Named) -> list[list[str]]:
    """Names of the pictures of the left and of the right camera."""
    return [[name for name, key in named.items() if key.side == side] for side in CAMERAS]


def _complete(named: Named) -> set[str]:
    """Views with pictures of both cameras."""
    left, right = ({named[name].view for name in names} for names in _by_camera(named))
    return left & right


def _pictures(folder: Path, named: Named) -> list[Picture]:
    """The pictures of views, each view under the name of its last picture where that is no other's."""
    names = {key.view: key.name or key.view for key in named.values()}
    shared = len({*names.values()}) < len(names)
    return [Picture(key.view if shared else names[key.view], folder, name, (key.side,)) for name, key in named.items()]


# --- guesses, questions, and pairs that the user states --------------------------------------------------------------
def _of_two_folders(names: Sequence[str], sides: tuple[str, str]) -> dict[str, str]:
    """The camera of each file where they lie in two folders; else empty."""
    folders = sorted({name.rpartition("/")[0] for name in names}, key=natural_order)
    if len(folders) != 2:
        return {}
    return {name: sides[folders.index(name.rpartition("/")[0])] for name in names}


def _guessed(images: Sequence[str], named: Named, pairing: Pairing) -> dict[str, Key]:
    """Pairs by a number, by two folders, or in the order of the names of known cameras; empty without any."""
    stems = {name: _stem(name) for name in images}
    last = {name: match for name, stem in stems.items() if (match := re.search(r"[_-]0*([0-9]{1,9})$", stem))}
    numbers = sorted({int(match[1]) for match in last.values()})
    of_folder = _of_two_folders(images, pairing.sides)
    guesses = [named_cameras(images, pairing.sides, picture_words()["perhaps"] | picture_words()["camera"])]
    if len(numbers) == 2:
        guesses.append(
            {n: Key(stems[n][: m.start()], pairing.sides[numbers.index(int(m[1]))]) for n, m in last.items()}
        )
    if not any(directions_in(name.rpartition("/")[0]) for name in of_folder):
        guesses.append({name: Key(stems[name].rpartition("/")[2], side) for name, side in of_folder.items()})
    for guess in guesses:
        if len(_complete(guess)) >= NUMBERED_PAIRS_MIN:
            return guess
    left, right = _by_camera(named)
    return _in_order((left, right)) if len(left) == len(right) >= NUMBERED_PAIRS_MIN else {}


def _in_order(groups: Sequence[Sequence[str]]) -> dict[str, Key]:
    """Pair the first picture of the left camera with the first of the right one."""
    views = [Path(name).stem for name in groups[0]]
    views = views if len(set(views)) == len(views) else [f"pair {k}" for k in range(1, len(views) + 1)]
    return {
        name: Key(view, side)
        for side, names in zip(CAMERAS, groups, strict=True)
        for view, name in zip(views, names, strict=True)
    }


def _question(folder: Path, guessed: Named, wide: bool = False) -> Question:
    """The question which pictures are the left camera's, with the patterns that answer it."""
    complete = _complete(guessed)
    groups = _by_camera({name: key for name, key in guessed.items() if wide or key.view in complete})
    globs = [_glob(folder, own) for own in groups]
    first = [escaped(own[0], 80) if own else "none" for own in groups]
    pattern = f"**/*{Path(first[0]).suffix}"
    answers = [
        Candidate(f"{first[0]} is the left camera's", ("--left", globs[0], "--right", globs[1])),
        Candidate(f"{first[1]} is the left camera's", ("--left", globs[1], "--right", globs[0])),
        Candidate("each holds the images of both", ("--left", pattern, "--right", pattern)),
    ]
    found = f"names that do not say which camera took {first[0]} and which {first[1]}, or which belong together"
    if wide:
        found = f"{first[0]} and {first[1]}, twice as wide as high: of two cameras each, or of one"
        del answers[1]
    allowed = f"{NAMING}; or patterns of both cameras, whose pictures then pair in the order of their names"
    return question(file=escaped(str(folder), 200), found=found, allowed=allowed, candidates=answers)


def _glob(folder: Path, names: Sequence[str]) -> str:
    """A pattern of some pictures below a folder; a word to fill in where none fits."""

    def common(texts: Sequence[str]) -> str:
        return "".join(letters[0] for letters in takewhile(lambda own: len({*own}) == 1, zip(*texts, strict=False)))

    files = [name.rpartition("/")[2] for name in names]
    before, after = common(files), common([name[::-1] for name in files])[::-1]
    folders = {name.rpartition("/")[0] for name in names}
    pattern = "/".join([*folders, f"{before}*{after}"]).removeprefix("/") if len(folders) == 1 else "PATTERN"
    matched = {path.relative_to(folder).as_posix() for path in folder.glob(pattern)}
    return pattern if matched == {*names} else "PATTERN"


def _matched(folder: Path, glob: str) -> list[str]:
    """Files below a folder that a pattern names; one that leaves the folder, or is none, matches nothing."""
    if Path(glob).is_absolute() or ".." in Path(glob).parts:
        return []
    try:
        names = [path.relative_to(folder).as_posix() for path in folder.glob(glob) if path.is_file()]
    except ValueError:
        # An empty pattern, or ** beside other letters.
        return []
    return sorted(names, key=natural_order)


def _stated_pairs(folder: Path, pairing: Pairing, most: int, place: str) -> list[Picture]:
    """Pair pictures in the order of their names, the first of one camera with the first of the other.

    The cameras are those of two patterns, else of the names, else of two folders. One pattern for both says that each
    picture holds both.
    """
    if pairing.globs is not None:
        groups = [_matched(folder, glob) for glob in pairing.globs]
        if pairing.globs[0] == pairing.globs[1] and groups[0]:
            return [Picture(_stem(name), folder, name, pairing.sides) for name in groups[0]]
    else:
        names = picture_names(folder)
        of_folder = _of_two_folders(names, pairing.sides)
        named = named_cameras(names, pairing.sides)
        groups = _by_camera(named or {name: Key(name, side) for name, side in of_folder.items()})
    left, right = map(len, groups)
    if not (left and right):
        found = f"{left} and {right} pictures of the left and the right camera"
        remedy = 'name them: --left "cam_a/*.png" --right "cam_b/*.png"'
        raise refusal("no-pictures", file=place, found=found, allowed="pictures of two cameras", remedy=remedy)
    if left != right or left + right > most:
        found, allowed = f"{left} left and {right} right pictures", f"as many of both, together {most} at most"
        remedy = "take out those without their counterpart: pictures are paired by their order"
        raise refusal("size", file=place, found=found, allowed=allowed, remedy=remedy)
    return _pictures(folder, _in_order(groups))
