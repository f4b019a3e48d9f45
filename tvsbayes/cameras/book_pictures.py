"""Pictures that a lab book names: both files of every look, found below a folder by what the book writes.

A book names a file with or without its folder and ending, or what both names share (`exp01_P1`); the picture of the
other camera has the same name but for the word of its camera. Where several folders hold the name, that of the look's
direction counts. Sizes come from headers.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tvsbayes.cameras.look_pictures import View, views_of
from tvsbayes.cameras.picture_pairs import OTHER_SUFFIXES, Picture, Size, directions_in, picture_names
from tvsbayes.errors import escaped, listed, refusal
from tvsbayes.files.disk import read_bytes
from tvsbayes.files.images import IMAGE_BYTES_MAX, image_size
from tvsbayes.instrument.campaign import CAMERAS

SHOWN = 4
_OPPOSITE = {"left": "right", "right": "left", "up": "down", "down": "up"}
_Index = Mapping[str, Sequence[tuple[str, str]]]
"""By what a book may write for it: names, each with that of its view (of itself where a book names both pictures)."""


@dataclass(frozen=True)
class BookedPictures:
    """Pictures of the looks of a book.

    Attributes:
        pictures: both pictures of each look that has any, by its `spot`.
        image_sizes: size of the pictures of the left and the right camera, px.
        missing: what the book names and the folder lacks, with the line.
        left_over: pictures below the folder that the book does not name, or of another size than most.
        unread: files of other formats.
        by_direction: number of names that stand in several folders, of which that of the direction was taken.
        turned: looks whose picture's name has the opposite direction of their experiment's move, by that direction.
    """

    pictures: dict[int, View]
    image_sizes: dict[str, Size]
    missing: tuple[str, ...]
    left_over: tuple[str, ...]
    unread: tuple[str, ...]
    by_direction: int
    turned: Mapping[str, int]


@dataclass(frozen=True)
class BookRow:
    """A look of a book.

    Attributes:
        spot, line: its number, and its line in the book.
        names: names of its files, one or left and right.
        direction: of its experiment as the book writes it, "" for none.
        moved: of its experiment by its moves, "" for none.
    """

    spot: int
    line: int
    names: tuple[str, ...]
    direction: str
    moved: str


def pictures_of_book(
    rows: Sequence[BookRow], folder: Path, file: str, globs: tuple[str, str] | None = None
) -> BookedPictures:
    """Find both pictures of every look.

    Args:
        rows: looks of the book.
        folder: folder of the pictures.
        file: name of the book, for messages.
        globs: patterns of the pictures of the left and of the right camera.

    Raises:
        InputError: a name stands for several pictures, a picture for several looks, none is found, sizes differ.
        Question: names do not say which camera took a picture.
    """
    images = picture_names(folder)
    viewed = None if any(len(row.names) > 1 for row in rows) else views_of(folder, globs=globs)
    views = () if viewed is None else viewed.views
    view_of = {view.name: view for view in views}
    of_files = {picture.name: view.name for view in views for picture in view.pictures}
    files = _index(dict(zip(images, images, strict=True)) if viewed is None else of_files)
    shared = _index({name: name for name in view_of})
    pictures: dict[int, View] = {}
    missing: list[str] = []
    for row in (row for row in rows if any(row.names)):
        # The left and the right picture of a view are one.
        meant = [_meant(files, name, row, file) or _meant(shared, name, row, file) for name in row.names]
        if not all(meant):
            missing.append(f"line {row.line} {escaped(' and '.join(filter(None, row.names)), 80)}")
        elif viewed is not None:
            pictures[row.spot] = view_of[meant[0]]
        else:
            stem = meant[0].rpartition(".")[0]
            left, right = (Picture(stem, folder, *named) for named in zip(meant, [("left",), ("right",)], strict=True))
            pictures[row.spot] = View(stem, (left, right))
    if not pictures:
        raise refusal(
            "no-pictures",
            file=file,
            found=f"no name of a picture among {len(images)} in {escaped(str(folder), 200)}: {listed(missing, SHOWN)}",
            allowed="names of files below the folder, with or without folder and ending",
            remedy="name the folder with --pictures, the column with --column picture=NAME",
        )
    _refuse_shared(pictures, rows, file)
    used = {picture.name for view in pictures.values() for picture in view.pictures}
    by_direction, turned = 0, Counter[str]()
    for row in (row for row in rows if row.spot in pictures):
        text = _text(row.names[0])
        # Of a name in several folders the move alone says which is meant.
        by_direction += not row.direction and len({view for _, view in files.get(text) or shared.get(text, ())}) > 1
        stated = {row.direction} if row.direction else {*directions_in(pictures[row.spot].name)}
        turned[row.moved] += bool(row.moved) and stated == {_OPPOSITE[row.moved]}
    return BookedPictures(
        pictures,
        image_sizes=_sizes(pictures, folder) if viewed is None else viewed.image_sizes,
        missing=tuple(missing),
        left_over=tuple(name for name in images if name not in used),
        unread=tuple(picture_names(folder, OTHER_SUFFIXES)),
        by_direction=by_direction,
        turned=+turned,
    )


def _plain(name: str) -> str:
    """A name in small letters without the separators at the ends of its parts: both names share `exp01_P1_`, `_3`."""
    return "/".join(part.strip(" _.-") for part in name.lower().split("/"))


def _text(wanted: str) -> str:
    """What a book writes, as names are indexed."""
    return _plain(wanted.replace("\\", "/").strip().strip("/").removeprefix("./"))


def _index(view_names: Mapping[str, str]) -> _Index:
    """Names by all that may be written for them: with or without folders and ending."""
    index: dict[str, list[tuple[str, str]]] = defaultdict(list)
    for name, view in view_names.items():
        whole = _plain(name)
        for text in dict.fromkeys((whole, re.sub(r"\.[a-z]+$", "", whole))):
            parts = text.split("/")
            for k in range(len(parts)):
                index["/".join(parts[k:])].append((name, view))
    return dict(index)


def _meant(index: _Index, wanted: str, row: BookRow, file: str) -> str:
    """The view, or picture, that a book means; "" where there is none.

    Raises:
        InputError: several are meant.
    """
    text = _text(wanted)
    found = index.get(text, []) if text else []
    direction = row.direction or row.moved
    if direction and len(found) > 1:
        # The folder first: a name may have the word for its camera.
        in_folder = [own for own in found if direction in directions_in(own[1].rpartition("/")[0])]
        found = in_folder or [own for own in found if direction in directions_in(own[1])] or found
    found = [own for own in found if _plain(own[0]) == text] or found
    if len({view for _, view in found}) > 1:
        names = listed([escaped(name, 80) for name, _ in found], SHOWN)
        raise refusal(
            "ambiguous",
            file=file,
            line=row.line,
            found=f"{escaped(wanted, 80)}, which stands for {names}",
            allowed="the name of one picture, or of one pair",
            remedy="write the folder into the name: left/exp01_P1_L.png",
        )
    return found[0][1] if found else ""


def _refuse_shared(pictures: Mapping[int, View], rows: Sequence[BookRow], file: str) -> None:
    """Refuse a picture of two looks, by name."""
    line_of = {row.spot: row.line for row in rows}
    first: dict[str, int] = {}
    for spot, view in pictures.items():
        for picture in view.pictures:
            other = first.setdefault(picture.name, spot)
            if other != spot:
                raise refusal(
                    "duplicate",
                    file=file,
                    line=line_of[spot],
                    found=f"{escaped(picture.name, 80)} again (first on line {line_of[other]})",
                    allowed="a picture of one look",
                    remedy="correct the name; of files with one name in several folders write the folder too",
                )


def _sizes(pictures: Mapping[int, View], folder: Path) -> dict[str, Size]:
    """Size of the pictures of either camera, px; one for all.

    Raises:
        InputError: a picture of another size than most.
    """
    sizes: dict[str, Size] = {}
    for camera, side in enumerate(CAMERAS):
        paths = {view.pictures[camera].name: view.pictures[camera].path for view in pictures.values()}
        own = {
            name: image_size(read_bytes(path, IMAGE_BYTES_MAX, folder), escaped(path.name))
            for name, path in paths.items()
        }
        sizes[side] = Counter(own.values()).most_common(1)[0][0]
        others = [escaped(name, 80) for name, size in own.items() if size != sizes[side]]
        if others:
            found = f"{len(others)} of another size: {listed(others, SHOWN)}"
            allowed = "{} x {} px as most".format(*sizes[side])
            remedy = "empty the cells of these pictures, or record them at the size of the others"
            raise refusal("image-size", file=escaped(str(folder), 200), found=found, allowed=allowed, remedy=remedy)
    return sizes
