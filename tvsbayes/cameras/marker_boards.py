"""ChArUco boards: a checkerboard with a marker in each white square, so that a picture of part of it suffices.

Squares are counted, as OpenCV's CharucoBoard does; inner corners are one fewer each way. Corners are px with the
integer at a pixel's centre, row by row, NaN where unseen. No JAX.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from tvsbayes.errors import InputError, NothingToEstimate, closest, escaped

DICTIONARIES = sorted(name.removeprefix("DICT_") for name in dir(cv2.aruco) if name.startswith("DICT_"))
WIDEST_DICTIONARIES = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "ARUCO_ORIGINAL", "APRILTAG_36h11")
"""Each contains the smaller dictionaries of the same bits as its first markers."""
CORNERS_MIN, LINES_MIN = 8, 3
"""Least numbers of corners in a view, and of different rows and columns: fewer do not determine the board's tilt."""
MISFIT_SQUARES = 0.2
"""Largest deviation of centres of markers from a plane, in squares: distortion of a lens is smaller."""
MARKERS_MIN = 6
"""Least number of markers: a homography has eight parameters, so four markers fit any arrangement."""
SAMPLE_PICTURES = 4
"""Number of pictures searched for markers of other dictionaries: a thousand markers take 0.2 s per picture."""
SQUARES_MAX = 60
GAP_SHARE = 0.9
"""Half the window of cornerSubPix over the gap between a corner and the next markers, which must stay outside."""
SHARE_DEFAULT = 0.75
"""Side of a marker over that of a square, used where no picture shows enough markers."""


@dataclass(frozen=True)
class Markers:
    """The markers of a ChArUco board.

    Attributes:
        squares: columns and rows of squares.
        dictionary: name in OpenCV without DICT_.
        share: side of a marker over that of a square; None before it is estimated from pictures.
        legacy: whether the first square is white, for boards with an even number of rows (OpenCV before 4.6, calib.io).
    """

    squares: tuple[int, int]
    dictionary: str
    share: float | None = None
    legacy: bool = False

    def __post_init__(self) -> None:
        if self.dictionary not in DICTIONARIES:
            raise InputError(
                "usage",
                f"--dictionary {escaped(self.dictionary)}: no such dictionary of markers",
                allowed=", ".join(DICTIONARIES),
                remedy=closest(self.dictionary, DICTIONARIES) or "name one of OpenCV's: 5X5_100",
            )
        if self.share is not None and not 0.2 <= self.share < 1:
            found = f"--marker-mm: {self.share:.3g} of the side of a square"
            remedy = "give the side of the black square with the marker, without white; it is smaller than --pitch-mm"
            raise InputError("usage", found, allowed="0.2 to 1", remedy=remedy)

    def board(self, squares: tuple[int, int] | None = None) -> cv2.aruco.CharucoBoard:
        """OpenCV's board, in units of a square."""
        share, dictionary = self.share or SHARE_DEFAULT, _dictionary(self.dictionary)
        board = cv2.aruco.CharucoBoard(squares or self.squares, 1.0, share, dictionary)
        board.setLegacyPattern(self.legacy)
        return board


def _markers(grey: np.ndarray, dictionary: str) -> tuple[np.ndarray, np.ndarray]:
    """Markers of a picture: corners (n, 4, 2) px and numbers (n,)."""
    corners, numbers, _ = cv2.aruco.ArucoDetector(_dictionary(dictionary)).detectMarkers(grey)
    return np.reshape(np.array(corners, float), (-1, 4, 2)), np.zeros(0, int) if numbers is None else np.ravel(numbers)


def _dictionary(name: str) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))


def _plane_fits(
    detected: Sequence[tuple[np.ndarray, np.ndarray]], board: cv2.aruco.CharucoBoard
) -> tuple[float, float] | None:
    """Rms deviation of markers' centres from those of a board, and the markers' side, in squares: medians of pictures.

    None where no picture has enough markers.
    """
    places = np.array([np.asarray(four, float)[:, :2] for four in board.getObjPoints()])
    fits = []
    for corners, numbers in detected:
        on_board = numbers < len(places)
        if on_board.sum() < MARKERS_MIN:
            continue
        corners, centres = corners[on_board], places[numbers[on_board]].mean(axis=1)
        # The map from pixels to squares uses the centres alone.
        plane, _ = cv2.findHomography(corners.mean(axis=1), centres)
        if plane is None or not np.isfinite(plane).all():
            continue
        back, flat = (
            np.reshape(cv2.perspectiveTransform(part.reshape(-1, 1, 2), plane), part.shape)
            for part in (corners.mean(axis=1), corners)
        )
        sides = np.linalg.norm(flat - np.roll(flat, 1, axis=1), axis=2)
        fits.append((np.sqrt(np.mean(np.sum((back - centres) ** 2, axis=1))), np.median(sides)))
    return tuple(np.median(fits, axis=0).tolist()) if fits else None


def fitted_markers(pictures: Sequence[np.ndarray], markers: Markers) -> Markers:
    """Estimate the size of the markers, and the first square, from pictures.

    Args:
        pictures: a sample of one camera's pictures, grey, uint8.
        markers: the stated markers.

    Raises:
        NothingToEstimate: the markers are arranged otherwise than on that board, or are of another dictionary.
    """
    detected = [_markers(grey, markers.dictionary) for grey in pictures]
    candidates = [replace(markers, legacy=legacy) for legacy in (markers.legacy, not markers.legacy)]
    fits = [(fit, own) for own in candidates if (fit := _plane_fits(detected, own.board())) is not None]
    if not fits:
        _refuse_other_markers(spread(pictures), markers)
        return replace(markers, share=markers.share or SHARE_DEFAULT)
    (misfit, side), best = min(fits, key=lambda fit: fit[0][0])
    if misfit > MISFIT_SQUARES:
        raise _other_board(detected, markers)
    return replace(best, share=markers.share or float(np.clip(side, 0.2, 0.98)))


def _other_board(detected: Sequence[tuple[np.ndarray, np.ndarray]], markers: Markers) -> NothingToEstimate:
    """The refusal of a board with another arrangement of markers, with the number of squares that matches."""
    count = 1 + max(int(numbers.max(initial=0)) for _, numbers in detected)
    misfits: dict[int, float] = {}
    for columns in range(3, SQUARES_MAX + 1):
        rows = -(-2 * count // columns)
        for legacy in (False, True):
            board = replace(markers, legacy=legacy).board((columns, max(3, rows + rows % 2)))
            misfit, _ = _plane_fits(detected, board) or (np.inf, 0.0)
            misfits[columns] = min(misfits.get(columns, np.inf), misfit)
    best = min(misfits, key=lambda columns: misfits[columns])
    remedy = "count squares, columns x rows, with the first marker at the upper left"
    if misfits[best] <= MISFIT_SQUARES:
        remedy = f"markers stand as on a board of {best} squares across: --charuco {best}xROWS; {remedy}"
    return NothingToEstimate(
        "no-board",
        f"the markers do not stand as on a board of {markers.squares[0]}x{markers.squares[1]} squares",
        allowed="the board in the pictures",
        remedy=remedy,
    )


def spread[T](pictures: Sequence[T], count: int = SAMPLE_PICTURES) -> list[T]:
    """A sample of `count` pictures, spread evenly over all."""
    places = np.linspace(0, len(pictures) - 1, min(count, len(pictures)))
    return [pictures[round(place)] for place in places]


def marker_counts(pictures: Sequence[np.ndarray]) -> Counter[str]:
    """Numbers of markers in the pictures by dictionary, up to the first dictionary with enough in all."""
    counted: Counter[str] = Counter()
    for name in WIDEST_DICTIONARIES:
        counted[name] = sum(len(_markers(grey, name)[1]) for grey in pictures)
        if counted[name] >= MARKERS_MIN * len(pictures):
            break
    return counted


def _refuse_other_markers(pictures: Sequence[np.ndarray], markers: Markers) -> None:
    """Refuse pictures that show no markers of the dictionary, or more of another one.

    False detections are common for dictionaries with few bits.
    """
    matching = sum(len(_markers(grey, markers.dictionary)[1]) for grey in pictures)
    name, count = marker_counts(pictures).most_common(1)[0]
    if matching >= max(1, count):
        return
    remedy = "see that light is even and the pictures sharp; is it a checkerboard without markers: --board?"
    found = f"no board of markers of {markers.dictionary} in {len(pictures)} pictures"
    if count > matching + len(pictures):
        found += f"; {count} markers of {name.partition('_')[0]} are seen"
        remedy = f"--dictionary {name}?"
    raise NothingToEstimate("no-board", found, allowed="pictures of the board that is named", remedy=remedy)


def marker_board_corners(grey: np.ndarray, markers: Markers) -> np.ndarray | None:
    """Inner corners of a board in a picture, ((columns - 1) (rows - 1), 2), NaN where unseen; None with too few.

    Args:
        grey: (height, width) uint8.
        markers: markers with their size, from `fitted_markers`.
    """
    columns, rows = markers.squares[0] - 1, markers.squares[1] - 1
    detected, numbers, *_ = cv2.aruco.CharucoDetector(markers.board()).detectBoard(grey)
    if numbers is None or len(numbers) < CORNERS_MIN:
        return None
    corners = np.full((rows * columns, 2), np.nan)
    corners[np.ravel(numbers)] = np.asarray(detected, float).reshape(-1, 2)
    nearest = min_distance(corners.reshape(rows, columns, 2))
    if not np.isfinite(nearest):
        return None
    gap = nearest * (1 - (markers.share or SHARE_DEFAULT)) / 2
    seen = np.isfinite(corners[:, 0])
    half = int(np.clip(round(GAP_SHARE * gap), 2, 11))
    corners[seen] = refined_corners(grey, corners[seen].astype(np.float32), half)
    seen_rows, seen_columns = np.nonzero(np.isfinite(corners[:, 0]).reshape(rows, columns))
    enough = len(seen_rows) >= CORNERS_MIN and min(len(set(seen_rows)), len(set(seen_columns))) >= LINES_MIN
    return corners if enough else None


def min_distance(grid: np.ndarray) -> float:
    """Smallest distance of neighbours in a grid of corners (rows, columns, 2); infinite where none are known."""
    steps = np.concatenate([np.linalg.norm(np.diff(grid, axis=axis), axis=2).ravel() for axis in (0, 1)])
    return float(steps[np.isfinite(steps)].min(initial=np.inf))


def refined_corners(grey: np.ndarray, corners: np.ndarray, half: int) -> np.ndarray:
    """Corners (n, 2) of float32 by cornerSubPix in a window of 2 half + 1 pixels."""
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    found = cv2.cornerSubPix(grey, corners.reshape(-1, 1, 2).copy(), (half, half), (-1, -1), criteria)
    return np.asarray(found).reshape(-1, 2)
