"""Pictures of spots from a folder with any names: find the look of each pair and copy the pictures to `frames/`.

The number in a pair's name gives its row of `spots.csv` (where there are rows), else its move; without such a number,
pairs and rows are matched one by one in the order of the names. Nothing is overwritten.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from tvsbayes.cameras.picture_pairs import (
    NAMING,
    OTHER_SUFFIXES,
    Pairing,
    Picture,
    Size,
    directions_in,
    is_experiment,
    natural_order,
    picture_words,
    read_folder,
)
from tvsbayes.errors import Candidate, InputError, escaped, question, refusal
from tvsbayes.files.disk import make_folder, read_bytes, write_atomically
from tvsbayes.files.images import IMAGE_BYTES_MAX, IMAGE_PIXELS_MAX, PNG_SIGNATURE, decode_image, png_bytes
from tvsbayes.instrument.campaign import CAMERAS, UNDETECTED, Spot, frame_name
from tvsbayes.progress import Advance, unshown

Matching = Literal["number", "order"]
LOOKS_MAX = 100_000
SPARSE_MARGIN = 10
"""The numbers in names are times or a counter, not moves, where the largest exceeds twice their count plus this."""
_NUMBER = re.compile(r"[0-9]{1,18}")
STAMP_NUMBERS = 5
"""Least count of numbers in a name, as 2026-06-01_23-59-50, that are one time together."""


@dataclass(frozen=True)
class View:
    """Both pictures of one moment.

    Attributes:
        name: the common part of their names.
        pictures: left and right; the same picture twice where one file holds both.
    """

    name: str
    pictures: tuple[Picture, Picture]

    @property
    def numbers(self) -> list[int]:
        """Numbers in the name, in order."""
        return [int(number) for number in _NUMBER.findall(self.name)]

    def word_before(self, position: int) -> str:
        """The word before one of its numbers; "" for none."""
        number = list(_NUMBER.finditer(self.name))[position]
        word = re.search(r"([a-z]+)[ _.#=+-]*$", self.name[: number.start()].lower())
        return "" if word is None else word[1]

    @property
    def without_spot(self) -> bool:
        """Whether a word of its name says that no spot is looked for: dark, background, calib."""
        return bool({*re.findall(r"[^\W\d_]+", self.name.lower())} & picture_words()["no_look"])

    def without_number(self, position: int) -> str:
        """The name without one of its numbers: the rest may name the sheet."""
        number = list(_NUMBER.finditer(self.name))[position]
        rest = f"{self.name[: number.start()]} {self.name[number.end() :]}"
        return re.sub(r"[\s_.-]+", " ", rest).strip(" =+-@")


@dataclass(frozen=True)
class ViewedFolder:
    """The pairs of a folder.

    Attributes:
        views: pairs, in the natural order of their names.
        image_sizes: size of most pictures of the left and the right camera, px.
        unpaired: files without a picture of the other camera.
        unnamed: files without a camera in their names, or in folders below the pairs.
        other_size: files of another size than most.
        unread: files in formats that are not read.
        without_spot: files of pairs that show no spot, by a word in their name.
    """

    views: tuple[View, ...]
    image_sizes: dict[str, Size]
    unpaired: tuple[str, ...]
    unnamed: tuple[str, ...]
    other_size: tuple[str, ...]
    unread: tuple[str, ...]
    without_spot: tuple[str, ...]


@dataclass(frozen=True)
class PairedLooks:
    """Rows of `spots.csv` with their pictures.

    Attributes:
        spots: all rows to be written.
        pictures: pictures of each row that has any, by its `spot`.
        matching: by number or in order.
        left_over: views whose row already has a pair.
        without: numbers of the rows, or moves, without pictures.
        renumbered: lowest and highest number in the names, where moves get new numbers; else None.
    """

    spots: tuple[Spot, ...]
    pictures: dict[int, View]
    matching: Matching
    left_over: tuple[str, ...]
    without: tuple[int, ...]
    renumbered: tuple[int, int] | None = None


def views_of(folder: Path, *, swap: bool = False, globs: tuple[str, str] | None = None) -> ViewedFolder:
    """Find the pairs of pictures in a folder.

    Args:
        folder: folder of the pictures; see `picture_pairs` for names.
        swap: the left camera's image is the right half of a wide picture.
        globs: patterns of the pictures of the left and of the right camera.

    Raises:
        InputError: no folder, no pair, an unreadable picture.
        Question: names do not say which camera took a picture.
    """
    pictures = read_folder(folder, 2 * LOOKS_MAX, IMAGE_PIXELS_MAX, Pairing(swap, globs, asks=True))
    by_view: dict[str, dict[str, Picture]] = {}
    for picture in pictures.used:
        by_view.setdefault(picture.view, {}).update(dict.fromkeys(picture.sides, picture))
    complete = {name: pair for name, pair in by_view.items() if len(pair) == 2}
    if not complete:
        found = f"no pair among {pictures.count} PNG and JPEG pictures"
        remedy = "rename them so that one word names the camera and the rest of both names is the same; "
        remedy += 'or name them by patterns: --left "cam_a/*.png" --right "cam_b/*.png"'
        allowed = f"{NAMING} (PNG or JPEG); or pictures of both cameras side by side"
        place = escaped(str(folder), 200)
        raise refusal("no-pictures", file=place, found=found, allowed=allowed, remedy=remedy)
    views = tuple(View(n, (complete[n]["left"], complete[n]["right"])) for n in sorted(complete, key=natural_order))
    # Where all are called so, the word is none of these.
    looks = tuple(view for view in views if not view.without_spot) or views
    return ViewedFolder(
        views=looks,
        image_sizes=dict(pictures.usual),
        unpaired=tuple(p.name for pair in by_view.values() if len(pair) == 1 for p in pair.values()),
        unnamed=pictures.left_out(),
        other_size=pictures.other_size,
        unread=pictures.left_out(OTHER_SUFFIXES),
        without_spot=tuple(p.name for view in views if view not in looks for p in dict.fromkeys(view.pictures)),
    )


def _number_position(views: Sequence[View], ids: Sequence[int] | None) -> int | None:
    """Position of the number that gives the look: the number with most values, all among `ids`; None if none."""
    positions = range(min(len(view.numbers) for view in views))
    known = None if ids is None else set(ids)
    numbers = {position: {view.numbers[position] for view in views} for position in positions}
    fitting = [position for position in positions if known is None or numbers[position] <= known]
    best = max(fitting, key=lambda position: (len(numbers[position]), position), default=None)
    if best is not None and len(positions) >= STAMP_NUMBERS and len(numbers[best]) < len(views) and known is None:
        return None
    return best if best is not None and (len(numbers[best]) > 1 or len(views) == 1) else None


def pair_looks(
    views: Sequence[View], moves: Sequence[int] | None, rows: Sequence[Spot] = (), matching: Matching | None = None
) -> PairedLooks:
    """Find the look of every view.

    Args:
        views: views of a folder.
        moves: numbers of the moves; None where none are listed: the numbers in the names are then moves, and get
            new numbers where they are too sparse; without numbers every view is a move.
        rows: rows of `spots.csv`; pictures then belong to the rows without detection ("undetected").
        matching: "number" or "order"; None takes the number where every name has one that matches, else the order.

    Raises:
        InputError: neither numbers nor counts match.
        Question: the numbers are those of experiments or counters, and nothing says at which moves they were seen.
    """
    waiting = [spot.spot for spot in rows if spot.status == UNDETECTED and spot.u_left_px is None]
    if rows and not waiting:
        found, allowed = f"{len(rows)} looks, none waits for pictures", "rows with the status undetected"
        raise refusal("occupied", file="spots.csv", found=found, allowed=allowed, remedy="name a new folder")
    ids, file = (waiting, "spots.csv") if rows else (moves, "moves.csv")
    slot = None if matching == "order" else _number_position(views, ids)
    names, renumbered = [""] * len(views), None
    if slot is not None:
        numbers, names = [view.numbers[slot] for view in views], [view.without_number(slot) for view in views]
        if matching is None and (counted := _counted(views, slot, names)):
            raise _question(views[0], numbers[0], counted)
        if ids is None and max(numbers) >= 2 * len(set(numbers)) + SPARSE_MARGIN:
            renumbered = min(numbers), max(numbers)
            # A day before a time of day counts too.
            times = [tuple(view.numbers[: slot + 1]) for view in views]
            ranks = {time: rank for rank, time in enumerate(sorted(set(times)))}
            numbers = [ranks[time] for time in times]
    elif matching == "number" or (ids is not None and len(views) != len(ids)):
        raise _unmatched(views, ids or (), file)
    else:
        numbers = list(range(len(views)) if ids is None else ids)
    method: Matching = "order" if slot is None else "number"
    pictures: dict[int, View] = {}
    if rows:
        # The first view of a number is its row's.
        left_over = [
            view.name for n, view in zip(numbers, views, strict=True) if pictures.setdefault(n, view) is not view
        ]
        without = tuple(spot for spot in waiting if spot not in pictures)
        return PairedLooks(tuple(rows), pictures, method, tuple(left_over), without)
    words = [name.split() for name in names]
    common = set.intersection(*map(set, words))
    spots = []
    for spot, k in enumerate(sorted(range(len(views)), key=lambda k: (numbers[k], natural_order(views[k].name)))):
        # Words that not all names share, cut to the length of a target.
        target = " ".join(word for word in words[k] if word not in common)[:100]
        spots.append(Spot(spot=spot, move=numbers[k], target=target, status=UNDETECTED))
        pictures[spot] = views[k]
    without = tuple(sorted({*(range(1 + max(numbers)) if moves is None else moves)} - {*numbers}))
    return PairedLooks(tuple(spots), pictures, method, (), without, renumbered)


def _counted(views: Sequence[View], slot: int, names: Sequence[str]) -> str:
    """What the numbers at a place count where they are none of moves, by the words beside them; else ""."""
    words = {view.word_before(slot) for view in views}
    if words & picture_words()["counter"]:
        return "counters"
    numbered = any(is_experiment(view.word_before(k)) for view in views for k in range(len(view.numbers)))
    if numbered and words <= picture_words()["point"]:
        return "points of experiments"
    repeated = len({view.numbers[slot] for view in views}) < len(views)
    if repeated and (any(map(directions_in, names)) or any(map(is_experiment, words))):
        return "experiments"
    return ""


def _question(view: View, number: int, counted: str) -> InputError:
    """The question at which moves pictures were seen whose names have numbers of something else."""
    return question(
        file=escaped(str(view.pictures[0].path), 200),
        found=f"numbers of {counted} in the names ({number} in {escaped(view.name, 80)})",
        allowed="the number of the move, or a lab book that says at which move each picture was taken: `tvsbayes "
        "import BOOK.csv --to CAMPAIGN --relative --pictures FOLDER`",
        candidates=(
            Candidate("a pair for every move, in the order of the names", ("--pair", "order")),
            Candidate(f"{number} is the number of the move all the same", ("--pair", "number")),
        ),
    )


def _unmatched(views: Sequence[View], ids: Sequence[int], file: str) -> InputError:
    noun, one = ("moves", "move") if file == "moves.csv" else ("rows with the status undetected", "row")
    span = f" ({min(ids)} to {max(ids)})" if ids else ""
    found = f"{len(views)} pairs of pictures for {len(ids)} {noun}{span}, and not in every name a number of one of them"
    allowed = "as many pairs as rows, or in every name the number of its row"
    remedy = f"name them after their row (left_0012.png, right_0012.png for {one} 12)"
    if file == "moves.csv":
        remedy += ", or list the looks in spots.csv with the status undetected and call it again"
    return refusal("pictures", file=file, found=found, allowed=allowed, remedy=remedy)


def _camera_png(view: View, camera: int) -> bytes:
    """The PNG of one camera: the file itself where it is a PNG of this camera, else its encoded pixels."""
    picture = view.pictures[camera]
    data = read_bytes(picture.path, IMAGE_BYTES_MAX)
    if len(picture.sides) == 1 and data.startswith(PNG_SIGNATURE):
        return data
    pixels = decode_image(data, escaped(picture.path.name))
    width, part = pixels.shape[1] // len(picture.sides), picture.sides.index(CAMERAS[camera])
    return png_bytes(np.ascontiguousarray(pixels[:, part * width : (part + 1) * width]))


def copy_frames(pictures: dict[int, View], campaign: Path, advance: Advance = unshown) -> int:
    """Copy pictures into `frames/` under the names that `detect` reads.

    Args:
        pictures: both pictures of each look, by its `spot`.
        campaign: the folder that will hold `frames/`; identical pictures there are kept.
        advance: called with the share that is complete.

    Returns:
        Number of pictures in `frames/`.

    Raises:
        InputError: another picture has the name, a picture cannot be read, or the folder cannot be written.
    """
    make_folder(campaign / "frames")
    for count, (spot, view) in enumerate(pictures.items(), start=1):
        for camera, side in enumerate(CAMERAS):
            path, data = campaign / frame_name(spot, side), _camera_png(view, camera)
            if not path.exists():
                write_atomically(path, data)
            elif read_bytes(path, IMAGE_BYTES_MAX, campaign) != data:
                remedy = "move the frames folder away, or name a new folder; nothing is overwritten"
                place, allowed = frame_name(spot, side), "no picture there, or the same"
                raise refusal("occupied", file=place, found="another picture", allowed=allowed, remedy=remedy)
        advance(count / len(pictures))
    return 2 * len(pictures)
