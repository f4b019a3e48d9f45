"""Checkerboards in pictures, plain or with markers: the inner corners, in the same order for both cameras.

Corners are px with the integer at a pixel's centre, shape (corners, 2), row by row. The board's frame: origin in the
middle, x along the columns, y along the rows, z away from the viewer, mm. Pictures pass the checks of `files` before
they are decoded. OpenCV's corner arrays have another rank in 5.x than in 4.x: each is reshaped as it arrives. No JAX.
"""

from __future__ import annotations

import math
import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from tvsbayes.cameras.marker_boards import (
    MARKERS_MIN,
    Markers,
    fitted_markers,
    marker_board_corners,
    marker_counts,
    min_distance,
    refined_corners,
    spread,
)
from tvsbayes.cameras.picture_pairs import (
    AS_NAMED,
    NAMING,
    Pairing,
    Picture,
    PictureFolder,
    Size,
    natural_order,
    read_folder,
)
from tvsbayes.errors import InputError, NothingToEstimate, Reason, all_of, escaped, refusal
from tvsbayes.files.images import in_grey_levels, read_image
from tvsbayes.instrument.campaign import CAMERAS
from tvsbayes.instrument.stereo_pair import same_shape, scaled_px
from tvsbayes.progress import Advance, unshown

Finder = Literal["classic", "sector"]
REFINING_SHARE = 0.25
"""Half the window of cornerSubPix over the smallest distance of two corners: the window must hold a single corner, and
a wide one averages more noise. On OpenCV's pairs (22 to 37 px) fixed halves of 3, 5, 7, 9, 11 px leave 0.23, 0.20,
0.18, 0.20, 0.41 px: the best is a quarter of the distance; from half of it on, neighbours bias the corner."""
WIDEST_SHARE = 0.5
"""Largest such share, used where a narrower window loses a corner: a wider one would contain neighbours."""
REFINING_HALF_MIN, REFINING_HALF_MAX = 2, 11
WORKERS_MAX = 8
PICTURES_MAX = 2000
PIXELS_MAX = 20_000_000
"""Limit for one picture, and for all that are searched in parallel: 20 million pixels take 0.8 GB."""
SAMPLE_MAX, SAMPLE_BATCH = 12, 4
"""Number of pictures searched first, in batches; all are searched once one shows the board."""
SMALLEST = (3, 3)
"""Least numbers of inner corners in the search for a board of unknown size."""
SECTOR_PIXELS_MAX = 3_000_000
"""Larger pictures are searched by sectors in a smaller copy, then refined: 20 million pixels would take 3.8 GB and half
a minute."""
DARK_DN, BRIGHT_DN = 40.0, 225.0
"""Mean grey level below or above which a picture is too dark or overexposed to show a board."""
BLURRED_SHARE = 0.02
"""Largest second difference of neighbours over the range of grey levels: that counts as blurred. An edge in focus
has about 1, an edge blurred over 10 px 0.03."""
CLIPPED_SHARE = 0.3
_BOARD_SIZE = re.compile(r"([0-9]{1,3})\s*[xX*]\s*([0-9]{1,3})")


@dataclass(frozen=True)
class Board:
    """A checkerboard by its inner corners.

    Attributes:
        columns: inner corners along the board's x.
        rows: inner corners along y.
        pitch_mm: side of a square.
        pitch_u_mm: standard uncertainty of the mean pitch (GUM type B: certificate, ruler, printer).
        markers: markers of a ChArUco board, which may be partly visible; None for a plain checkerboard.
    """

    columns: int
    rows: int
    pitch_mm: float
    pitch_u_mm: float = 0.0
    markers: Markers | None = None

    def __post_init__(self) -> None:
        if not (3 <= self.columns <= 100 and 3 <= self.rows <= 100):
            option = "--board" if self.markers is None else "--charuco"
            found = f"{self.columns} x {self.rows} inner corners"
            raise _bad_option(option, found, "3 to 100 inner corners each way", "count where four squares meet")
        if not 0.01 <= self.pitch_mm <= 1e4:
            raise _bad_option("--pitch-mm", f"{self.pitch_mm:g} mm", "0.01 to 10000 mm", "give the side of a square")
        if not 0 <= self.pitch_u_mm < 0.1 * self.pitch_mm:
            found = f"{self.pitch_u_mm:g} mm"
            raise _bad_option("--pitch-u-mm", found, "0 to a tenth of the pitch", "give it for one square, not all")

    @classmethod
    def named(cls, size: str, pitch_mm: float, pitch_u_mm: float = 0.0) -> Board:
        """Build from a text such as "9x6".

        Raises:
            InputError: another text, or impossible values.
        """
        return cls(*_counts("--board", size, "inner corners", "9x6"), pitch_mm, pitch_u_mm)

    @classmethod
    def with_markers(
        cls, squares: str, dictionary: str, pitch_mm: float, marker_mm: float | None = None, pitch_u_mm: float = 0.0
    ) -> Board:
        """Build a ChArUco board from its squares, such as "15x10", and its dictionary, such as "5X5_100".

        Raises:
            InputError: another text, no such dictionary, or impossible values.
        """
        columns, rows = _counts("--charuco", squares, "squares", "15x10")
        # A board refuses such a pitch below.
        share = None if marker_mm is None or not pitch_mm > 0 else marker_mm / pitch_mm
        name = dictionary.strip().removeprefix("DICT_")
        return cls(columns - 1, rows - 1, pitch_mm, pitch_u_mm, Markers((columns, rows), name, share))

    @property
    def corners(self) -> int:
        """Number of inner corners."""
        return self.columns * self.rows

    @property
    def points_mm(self) -> np.ndarray:
        """Inner corners in the board's frame, shape (corners, 3), row by row, z = 0, origin in the middle."""
        grid = np.mgrid[: self.columns, : self.rows].T.reshape(-1, 2) - [(self.columns - 1) / 2, (self.rows - 1) / 2]
        return np.column_stack([self.pitch_mm * grid, np.zeros(self.corners)])


def _counts(option: str, text: str, counted: str, example: str) -> tuple[int, int]:
    """Columns and rows of a text such as "9x6"."""
    match = _BOARD_SIZE.fullmatch(text.strip())
    if match is None:
        raise _bad_option(option, escaped(text), f"COLUMNSxROWS of {counted}", f"write for example {example}")
    return int(match[1]), int(match[2])


def _bad_option(option: str, found: str, allowed: str, remedy: str) -> InputError:
    message = f"{option}: found {found}; allowed: {allowed}"
    return InputError("usage", message, column=option, found=found, allowed=allowed, remedy=remedy)


@dataclass(frozen=True)
class View:
    """Corners of the board at one pose: `left` and `right` of shape (corners, 2), px, row by row; None where unseen.

    Single corners of a board with markers may be unseen: NaN.
    """

    name: str
    left: np.ndarray | None
    right: np.ndarray | None


@dataclass(frozen=True)
class Views:
    """The board in a folder of pictures.

    Attributes:
        views: views with the board in at least one picture, in the order of their names.
        image_width: width of one camera's picture, px.
        image_height: its height, px.
        unpaired: pictures of one camera without a picture of the other; where they show the board, they are in `views`.
        unnamed: pictures without a camera in their names that are not two pictures side by side; not used.
        without_board: pictures in which no board was found.
        other_size: pictures of another size than most; not used.
        by_fallback: pictures whose board only the fallback finder found.
        reordered: views whose right corners were reordered to match the left ones.
        right_image_size: size of the right camera's pictures where it differs; corners are scaled to the left size.
    """

    views: tuple[View, ...]
    image_width: int
    image_height: int
    unpaired: tuple[str, ...] = ()
    unnamed: tuple[str, ...] = ()
    without_board: tuple[str, ...] = ()
    other_size: tuple[str, ...] = ()
    by_fallback: tuple[str, ...] = ()
    reordered: tuple[str, ...] = ()
    right_image_size: Size | None = None


def find_corners(grey: np.ndarray, board: Board, finder: Finder = "classic") -> tuple[np.ndarray, bool] | None:
    """Inner corners (corners, 2) of a board in one picture, px, and whether only the other finder found them.

    `classic` is findChessboardCorners refined by cornerSubPix, `sector` findChessboardCornersSB (Duda and Frese
    2018, sector based; slower). Where one fails, the other is tried. The order of the corners is right-handed, in the
    sense of the image's x and y.

    Args:
        grey: (height, width) uint8.
        board: the board; its markers, if any, replace the finder.
        finder: the finder tried first.

    Returns:
        None where neither finds them.
    """
    if board.markers is not None:
        marker_corners = marker_board_corners(grey, board.markers)
        return None if marker_corners is None else (marker_corners, False)
    for method in (finder, "sector" if finder == "classic" else "classic"):
        corners = _find_classic(grey, board) if method == "classic" else _find_sector(grey, board)
        if corners is None or not np.isfinite(corners).all():
            continue
        grid = corners.reshape(board.rows, board.columns, 2)
        along, across = (grid[:, -1] - grid[:, 0]).mean(0), (grid[-1] - grid[0]).mean(0)
        # Every picture shows the front of the board, so the order has the same sense in all pictures.
        if along[0] * across[1] - along[1] * across[0] < 0:
            grid = grid[:, ::-1]
        return grid.reshape(-1, 2), method != finder
    return None


def _find_classic(grey: np.ndarray, board: Board) -> np.ndarray | None:
    corners = _all_corners(board, *cv2.findChessboardCorners(grey, (board.columns, board.rows)))
    return None if corners is None else _refined(grey, corners, board)


def _find_sector(grey: np.ndarray, board: Board) -> np.ndarray | None:
    flags, small = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY, shrunk(grey)
    corners = _all_corners(board, *cv2.findChessboardCornersSB(small, (board.columns, board.rows), flags=flags))
    if corners is None or small is grey:
        return corners
    scale = np.array(grey.shape[::-1]) / small.shape[::-1]
    return _refined(grey, (corners + 0.5) * scale - 0.5, board)


def _all_corners(board: Board, detected: bool, corners: np.ndarray | None) -> np.ndarray | None:
    """Corners (corners, 2) of a complete detection; else None."""
    complete = detected and corners is not None and np.size(corners) == 2 * board.corners
    return np.asarray(corners, float).reshape(-1, 2) if complete else None


def _refined(grey: np.ndarray, corners: np.ndarray, board: Board) -> np.ndarray:
    """Corners (n, 2) by cornerSubPix, with a window that depends on their distances."""
    corners = corners.astype(np.float32)
    nearest = min_distance(corners.reshape(board.rows, board.columns, 2))
    half = int(np.clip(round(REFINING_SHARE * nearest), REFINING_HALF_MIN, REFINING_HALF_MAX))
    # cornerSubPix returns a corner unchanged, wrong by pixels, where its search leaves the window (boards at a steep
    # angle). The window is then widened, up to the neighbours, whose distance is itself known to pixels only.
    for size in range(half, max(half + 1, int(WIDEST_SHARE * nearest)) + 1):
        found = refined_corners(grey, corners, size)
        if (found != corners).any(axis=1).all():
            break
    return found.astype(float)


def quarter_turns(board: Board) -> tuple[int, ...]:
    """Turns of the board in its plane, in quarters, after which it may look the same."""
    if board.markers is not None:
        return (0,)
    return (0, 1, 2, 3) if board.rows == board.columns else (0, 2)


def corner_orders(board: Board) -> list[np.ndarray]:
    """Possible orders of corners, by `quarter_turns`."""
    index = np.arange(board.corners).reshape(board.rows, board.columns)
    return [np.rot90(index, quarter).ravel() for quarter in quarter_turns(board)]


def _first_is_bright(grey: np.ndarray, corners: np.ndarray, board: Board) -> bool:
    """Whether the square behind the first corner is bright, judged by all squares."""
    grid = corners.reshape(board.rows, board.columns, 2)
    middles = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    u, v = np.clip(np.rint(middles).astype(int), 0, np.array(grey.shape[::-1]) - 1).transpose(2, 0, 1)
    signs = 1 - 2 * (np.indices(u.shape).sum(axis=0) % 2)
    values = grey[v, u].astype(float)
    return bool(np.sum(signs * (values - values.mean())) > 0)


@dataclass(frozen=True)
class _Detected:
    """Corners of one picture; `colours[k]` states whether the first square is bright in the k-th of `corner_orders`."""

    corners: np.ndarray
    by_fallback: bool
    colours: tuple[bool, ...]


def _turn_of_right(left: _Detected, right: _Detected, board: Board) -> int:
    """Number in `corner_orders` of the order in which right corners are those of the left ones; 0 is unchanged.

    The colours decide where a turned board looks different (one of columns and rows odd, one even). Otherwise the
    relative rotation of the cameras is assumed to be less than half of the board's symmetry angle.
    """

    def along(corners: np.ndarray) -> np.ndarray:
        grid = corners.reshape(board.rows, board.columns, 2)
        row = (grid[:, -1] - grid[:, 0]).mean(0)
        return row / max(float(np.linalg.norm(row)), 1e-12)

    rows = [along(right.corners[order]) for order in corner_orders(board)]
    alike = [k for k, colour in enumerate(right.colours) if colour == left.colours[0]]
    return max(alike or range(len(rows)), key=lambda k: float(along(left.corners) @ rows[k]))


def find_views(
    folder: Path,
    board: Board,
    *,
    finder: Finder = "classic",
    pairing: Pairing = AS_NAMED,
    advance: Advance = unshown,
) -> Views:
    """Find the board in all pictures of a folder.

    Pictures (PNG, JPEG) are paired as in `paired_pictures`. Where no file is named after a camera, pictures at least
    twice as wide as high are split in the middle. Other files are ignored; other pictures are listed.

    Args:
        folder: folder of the pictures.
        board: the board.
        finder: see `find_corners`.
        pairing: the camera of each picture.
        advance: called with the share of pictures searched.

    Raises:
        InputError: no folder, an unreadable picture, or two pictures for one camera and view.
        NothingToEstimate: no picture of a camera, or no board in any picture.
    """
    pictures = read_folder(folder, PICTURES_MAX, PIXELS_MAX, pairing)
    usual, used = pictures.usual, pictures.used
    _check_sizes(pictures)
    sample = spread(used, SAMPLE_MAX)
    if board.markers is not None:
        greys = [part for picture in sample for part in _greys(picture, pictures).values()]
        board = replace(board, markers=fitted_markers(greys, board.markers))
    # A search of all pictures would take minutes.
    batches = (sample[k : k + SAMPLE_BATCH] for k in range(0, len(sample), SAMPLE_BATCH))
    if len(used) > len(sample) and not any(
        detection for batch in batches for found in _detections(batch, pictures, board, finder) for detection in found
    ):
        raise _no_board_error(sample, pictures, board)
    shown: dict[tuple[str, str], _Detected] = {}
    names: dict[tuple[str, str], str] = {}
    without_board, by_fallback = [], []
    for count, (picture, found) in enumerate(
        zip(used, _detections(used, pictures, board, finder), strict=True), start=1
    ):
        advance(count / len(used))
        for side, detection in zip(picture.sides, found, strict=True):
            name = picture.name + (f" ({side})" if len(picture.sides) > 1 else "")
            names[picture.view, side] = name
            if detection is None:
                without_board.append(name)
            else:
                shown[picture.view, side] = detection
                by_fallback += [name] * detection.by_fallback
    if not shown:
        raise _no_board_error(sample, pictures, board)
    views, reordered = [], []
    for name in sorted({view for view, _ in shown}, key=natural_order):
        left, right = (shown.get((name, side)) for side in CAMERAS)
        turn = 0 if left is None or right is None else _turn_of_right(left, right, board)
        reordered += [name] * (turn != 0)
        right_px = None if right is None else right.corners[corner_orders(board)[turn]]
        right_px = None if right_px is None else scaled_px(right_px, usual["right"], usual["left"])
        views.append(View(name, None if left is None else left.corners, right_px))
    unpaired = [name for (view, side), name in names.items() if (view, CAMERAS[side == "left"]) not in names]
    return Views(
        views=tuple(views),
        image_width=usual["left"][0],
        image_height=usual["left"][1],
        unpaired=tuple(sorted(unpaired, key=natural_order)),
        unnamed=pictures.left_out(),
        without_board=tuple(without_board),
        other_size=pictures.other_size,
        right_image_size=None if usual["right"] == usual["left"] else usual["right"],
        by_fallback=tuple(by_fallback),
        reordered=tuple(reordered),
    )


def _no_board_error(sample: Sequence[Picture], pictures: PictureFolder, board: Board) -> NothingToEstimate:
    """The refusal of pictures without the board, with the reason."""
    count, sizes = len(pictures.used), dict.fromkeys(pictures.sizes[p] for p in sample)
    greys = [part for picture in sample for part in _greys(picture, pictures).values()]
    sizes_text = " and ".join(f"{width} x {height}" for width, height in sizes)
    reason, remedy = why_no_board(greys, board.columns, board.rows)
    if board.markers is None:
        shown = spread(greys)
        name, markers = marker_counts(shown).most_common(1)[0]
        if markers >= MARKERS_MIN * len(shown):
            reason += f"; {markers} markers of {name.partition('_')[0]} are seen, as on a ChArUco board"
            remedy = f"--charuco COLUMNSxROWS --dictionary {name} in place of --board, counting squares"
    else:
        reason = "of no view enough markers are seen"
        remedy = "hold the board nearer, with at least three rows and columns of corners in the picture"
    where = f"{len(sample)} of {count} pictures" if len(sample) < count else f"{count} pictures"
    return NothingToEstimate(
        "no-board",
        f"no board of {board.columns}x{board.rows} inner corners in {where} of {sizes_text} px: {reason}",
        allowed="pictures that show the whole board",
        remedy=remedy,
    )


def _greys(picture: Picture, pictures: PictureFolder) -> dict[str, np.ndarray]:
    """The grey images in a picture by camera, uint8."""
    pixels, width = in_grey_levels(read_image(picture.path, pictures.folder)), pictures.sizes[picture][0]
    # The finders need 8 bits; a corner averages over hundreds of pixels.
    if pixels.dtype != np.uint8:
        pixels = np.rint(pixels).astype(np.uint8)
    grey = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    return {side: np.ascontiguousarray(grey[:, k * width : (k + 1) * width]) for k, side in enumerate(picture.sides)}


def _check_sizes(pictures: PictureFolder) -> None:
    """Refuse pictures of one camera alone, and sizes of different aspect ratios, which are not scaled copies."""
    if not pictures.sizes:
        raise NothingToEstimate(
            "no-pictures",
            f"{escaped(str(pictures.folder), 200)}: no checkerboard picture",
            allowed=f"{NAMING} (PNG or JPEG); or frames of both cameras side by side",
            remedy="name the pictures left01.png, right01.png, left02.png ...; or --pair order with a folder a camera, "
            'or --left "cam_a/*.png" --right "cam_b/*.png"',
        )
    usual, place = pictures.usual, escaped(pictures.folder.resolve().name)
    for side, size in usual.items():
        if size == (0, 0):
            raise NothingToEstimate(
                "no-pictures",
                f"{place}: no picture of the {side} camera",
                allowed=f"{NAMING} (PNG or JPEG)",
                remedy="put those of both cameras there; names without the camera need --left GLOB --right GLOB",
            )
    if not same_shape(usual["left"], usual["right"]):
        left, right = (f"{width} x {height}" for width, height in usual.values())
        raise refusal(
            "image-size",
            file=place,
            found=f"left and right have two sizes: {left} and {right}",
            allowed="pictures of one size, or of one proportion of width to height",
            remedy="take the pictures of both cameras at such sizes, for the board and for the spots",
        )


def _detections(
    sample: Sequence[Picture], pictures: PictureFolder, board: Board, finder: Finder
) -> Iterator[list[_Detected | None]]:
    """The board in each picture, by its cameras."""

    def detected(grey: np.ndarray) -> _Detected | None:
        found = find_corners(grey, board, finder)
        if found is None:
            return None
        if board.markers is not None:
            return _Detected(*found, (True,))
        return _Detected(
            *found, tuple(_first_is_bright(grey, found[0][order], board) for order in corner_orders(board))
        )

    def detect(picture: Picture) -> list[_Detected | None] | InputError:
        try:
            return [detected(grey) for grey in _greys(picture, pictures).values()]
        except InputError as error:
            return error

    parallel = PIXELS_MAX // max(len(p.sides) * math.prod(pictures.sizes[p]) for p in sample)
    with ThreadPoolExecutor(max(1, min(WORKERS_MAX, os.cpu_count() or 1, parallel))) as pool:
        refused = []
        for found in pool.map(detect, sample):
            if isinstance(found, InputError):
                refused.append(found)
            else:
                yield found
    if refused:
        raise all_of(refused)


def shrunk(grey: np.ndarray) -> np.ndarray:
    """A picture for the search by sectors: unchanged, or a smaller copy."""
    shrink = math.ceil(math.sqrt(grey.size / SECTOR_PIXELS_MAX))
    return grey if shrink == 1 else cv2.resize(grey, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA)


def inner_corners(grey: np.ndarray) -> tuple[int, int] | None:
    """Inner corners of the checkerboard in a picture, the longer side first; None where none is seen."""
    detected, _, meta = cv2.findChessboardCornersSBWithMeta(shrunk(grey), SMALLEST, cv2.CALIB_CB_LARGER)
    if not detected or meta is None or np.ndim(meta) != 2:
        return None
    rows, columns = sorted(np.shape(meta))
    return int(columns), int(rows)


def why_no_board(pictures: Sequence[np.ndarray], columns: int, rows: int) -> Reason:
    """Why pictures do not show the board.

    Args:
        pictures: a sample of one camera's pictures.
        columns: inner corners of the board along one side.
        rows: inner corners along the other side.
    """
    long, short = max(columns, rows), min(columns, rows)
    boards = Counter(size for grey in pictures if (size := inner_corners(grey)) is not None)
    if boards:
        (columns, rows), count = boards.most_common(1)[0]
        inside = all(a <= long and b <= short for a, b in boards)
        if len(boards) > 1 and 2 * count <= boards.total() and inside:
            listed = ", ".join(f"{a}x{b}" for a, b in boards)
            return Reason(
                f"parts of a board are seen, {listed} inner corners of {long}x{short}: partly outside?",
                "hold the whole board into both pictures; or is it smaller: count where four squares meet",
            )
        return Reason(
            f"{columns}x{rows} inner corners are seen in {count} of {len(pictures)} pictures",
            f"--board {columns}x{rows}? count where four squares meet, not the squares",
        )
    level, white, sharpness = (
        float(np.median([measure(grey) for grey in pictures]))
        for measure in (np.mean, lambda grey: (grey >= 254).mean(), _sharpness)
    )
    if level < DARK_DN:
        return Reason(f"the pictures are dark, mean grey level {level:.0f} of 255", "more light, or a longer exposure")
    if level > BRIGHT_DN or white > CLIPPED_SHARE:
        found = f"the pictures are overexposed, {100 * white:.0f} % of the pixels are white"
        return Reason(found, "less light, or a shorter exposure")
    if sharpness < BLURRED_SHARE:
        return Reason("the pictures are blurred: no edge is in focus", "focus, and hold the board still")
    return Reason(
        "no checkerboard of any size is seen",
        "check --board (inner corners, one less than squares), sharpness and light; a ruled or printed white margin "
        "around the board helps",
    )


def _sharpness(grey: np.ndarray) -> float:
    """Sharpness of the best edges: second differences over the range of grey levels."""
    low, high = np.percentile(grey, (1, 99))
    second = np.abs(cv2.Laplacian(grey, cv2.CV_32F))
    return float(np.percentile(second, 99.5)) / max(float(high - low), 8.0)
