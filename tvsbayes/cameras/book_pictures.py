"""Pictures that a lab book names: both files of every look, found below a folder by what the book writes.

A book names a file with or without its folder and ending, or what both names share (`exp01_P1`); the picture of the
other camera has the same name but for the word of its camera. Where several folders hold the name, that of the look's
direction counts. Sizes come from headers.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tvsbayes.cameras.look_pictures import View, views_of
from tvsbayes.cameras.picture_pairs import OTHER_SUFFIXES, SUFFIXES, Picture, Size, direction_of, file_names
from tvsbayes.errors import escaped, listed, refusal
from tvsbayes.files.disk import read_bytes
from tvsbayes.files.images import IMAGE_BYTES_MAX, image_size
from tvsbayes.instrument.campaign import CAMERAS

SHOWN = 4


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
    images = [name for name in file_names(folder) if name.lower().endswith(SUFFIXES)]
    two_columns = any(len(row.names) > 1 for row in rows)
    viewed = None if two_columns else views_of(folder, globs=globs)
    views = () if viewed is None else viewed.views
    of_file = {p.path.relative_to(folder).as_posix(): view for view in views for p in view.pictures}
    of_name = {view.name: view for view in views}
    files, shared = _index(images if two_columns else of_file), _index(of_name)
    pictures: dict[int, View] = {}
    missing: list[str] = []
    for row in (row for row in rows if any(row.names)):
        view: View | None = None
        if two_columns:
            found = [_meant(files, name, row, file) for name in row.names]
            if all(found):
                left, right = (
                    Picture(_stem(own[0]), folder / own[0], (side,)) for own, side in zip(found, CAMERAS, strict=True)
                )
                view = View(left.view, (left, right))
        else:
            # The left and the right picture of a view are one.
            meant = _meant(files, row.names[0], row, file, of_file)
            name = meant or _meant(shared, row.names[0], row, file)
            view = (of_file if meant else of_name)[name[0]] if name else None
        if view is None:
            missing.append(f"line {row.line} {escaped(' and '.join(filter(None, row.names)), 80)}")
        else:
            pictures[row.spot] = view
    if not pictures:
        raise refusal(
            "no-pictures",
            file=file,
            found=f"no name of a picture among {len(images)} in {escaped(str(folder), 200)}: {listed(missing, SHOWN)}",
            allowed="names of files below the folder, with or without folder and ending",
            remedy="name the folder with --pictures, the column with --column picture=NAME",
        )
    _refuse_shared(pictures, rows, folder, file)
    used = {picture.path for view in pictures.values() for picture in view.pictures}
    rest = tuple(name for name in images if folder / name not in used)
    unread = tuple(name for name in file_names(folder) if name.lower().endswith(OTHER_SUFFIXES))
    sizes = _sizes(pictures, folder) if viewed is None else viewed.image_sizes
    shared_names = [row for row in rows if row.spot in pictures and _needs_direction(row, files, of_file, shared)]
    turned = Counter(
        row.moved
        for row in rows
        if row.spot in pictures and row.moved and _written(row, pictures[row.spot]) == {_OPPOSITE[row.moved]}
    )
    return BookedPictures(pictures, sizes, tuple(missing), rest, unread, len(shared_names), turned)


_OPPOSITE = {"left": "right", "right": "left", "up": "down", "down": "up"}


def _directions(name: str) -> set[str]:
    """Directions among the words of a name."""
    return {way for word in re.findall("[a-z]+", name.lower()) if (way := direction_of(word))}


def _written(row: BookRow, view: View) -> set[str]:
    """Directions that the book and the name of a pair state."""
    return {row.direction} if row.direction else _directions(view.name)


def _needs_direction(
    row: BookRow, files: Mapping[str, list[str]], of_file: Mapping[str, View], shared: Mapping[str, list[str]]
) -> bool:
    """Whether a name stands in several folders, and the move alone says which is meant."""
    text = _text(row.names[0])
    found = {id(of_file[name]) if of_file else name for name in files.get(text, [])} or {*shared.get(text, [])}
    return not row.direction and len(found) > 1


def _stem(name: str) -> str:
    return name[: name.rindex(".")]


def _plain(name: str) -> str:
    """A name in small letters without the separators at the ends of its parts: both names share `exp01_P1_`, `_3`."""
    return "/".join(part.strip(" _.-") for part in name.lower().split("/"))


def _text(wanted: str) -> str:
    """What a book writes, as names are indexed."""
    return _plain(wanted.replace("\\", "/").strip().strip("/").removeprefix("./"))


def _index(names: Iterable[str]) -> dict[str, list[str]]:
    """Names by all that may be written for them: with or without folders and ending."""
    index: dict[str, list[str]] = {}
    for name in names:
        whole = _plain(name)
        for text in dict.fromkeys((whole, re.sub(r"\.[a-z]+$", "", whole))):
            parts = text.split("/")
            for k in range(len(parts)):
                index.setdefault("/".join(parts[k:]), []).append(name)
    return index


def _meant(
    index: Mapping[str, list[str]], wanted: str, row: BookRow, file: str, views: Mapping[str, View] | None = None
) -> list[str]:
    """The names that a book means: one, or two of a view; none where there is none.

    Raises:
        InputError: several are meant.
    """
    text = _text(wanted)
    found = index.get(text, []) if text else []
    direction = row.direction or row.moved
    if direction and len(found) > 1:
        # The folder first: a name may have the word for its camera.
        shown = {name: name if views is None else views[name].name for name in found}
        in_folder = [name for name in found if direction in _directions(shown[name].rpartition("/")[0])]
        found = in_folder or [name for name in found if direction in _directions(shown[name])] or found
    found = [name for name in found if _plain(name) == text] or found
    if len(found if views is None else {id(views[name]) for name in found}) > 1:
        raise refusal(
            "ambiguous",
            file=file,
            line=row.line,
            found=f"{escaped(wanted, 80)}, which stands for {listed([escaped(name, 80) for name in found], SHOWN)}",
            allowed="the name of one picture, or of one pair",
            remedy="write the folder into the name: left/exp01_P1_L.png",
        )
    return found


def _refuse_shared(pictures: Mapping[int, View], rows: Sequence[BookRow], folder: Path, file: str) -> None:
    """Refuse a picture of two looks, by name."""
    line_of = {row.spot: row.line for row in rows}
    first: dict[Path, int] = {}
    for spot, view in pictures.items():
        for picture in dict.fromkeys(view.pictures):
            other = first.setdefault(picture.path, spot)
            if other != spot:
                name = escaped(picture.path.relative_to(folder).as_posix(), 80)
                raise refusal(
                    "duplicate",
                    file=file,
                    line=line_of[spot],
                    found=f"{name} again (first on line {line_of[other]})",
                    allowed="a picture of one look",
                    remedy="correct the name; of files with one name in several folders write the folder too",
                )


def _sizes(pictures: Mapping[int, View], folder: Path) -> dict[str, Size]:
    """Size of the pictures of either camera, px; one for all.

    Raises:
        InputError: a picture of another size than most.
    """
    sizes: dict[str, Size] = {}
    headers: dict[Path, Size] = {}
    for camera, side in enumerate(CAMERAS):
        own: dict[Path, Size] = {}
        for view in pictures.values():
            picture = view.pictures[camera]
            if picture.path not in headers:
                data = read_bytes(picture.path, IMAGE_BYTES_MAX, folder)
                headers[picture.path] = image_size(data, escaped(picture.path.name))
            width, height = headers[picture.path]
            own[picture.path] = width // len(picture.sides), height
        sizes[side] = Counter(own.values()).most_common(1)[0][0]
        others = [path.relative_to(folder).as_posix() for path, size in own.items() if size != sizes[side]]
        if others:
            found = f"{len(others)} of another size: {listed([escaped(name, 80) for name in others], SHOWN)}"
            allowed = "{} x {} px as most".format(*sizes[side])
            remedy = "empty the cells of these pictures, or record them at the size of the others"
            raise refusal("image-size", file=escaped(str(folder), 200), found=found, allowed=allowed, remedy=remedy)
    return sizes
