"""Why no board of the size that was named is in the first pictures: what is seen there instead, in words.

Pictures are grey, uint8, shape (height, width). No JAX.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import cv2
import numpy as np

SMALLEST = (3, 3)
"""Inner corners from which a board is searched that may have more."""
SECTOR_PIXELS_MAX = 3_000_000
"""Larger pictures are searched by sectors in a smaller copy, then refined: 20 million pixels would take 3.8 GB and half
a minute."""
DARK_DN, BRIGHT_DN = 40.0, 225.0
"""Mean grey level below or above which a picture is too dark or overexposed to show a board."""
BLURRED_SHARE = 0.02
"""Largest second difference of neighbours over the range of grey levels: below it no edge is in focus. An edge in focus
has about 1, one that is smeared over 10 px 0.03."""
CLIPPED_SHARE = 0.3


def shrunk(grey: np.ndarray) -> np.ndarray:
    """A picture as it can be searched by sectors: the very one, or a smaller copy."""
    shrink = math.ceil(math.sqrt(grey.size / SECTOR_PIXELS_MAX))
    return grey if shrink == 1 else cv2.resize(grey, None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA)


def inner_corners(grey: np.ndarray) -> tuple[int, int] | None:
    """Inner corners of the checkerboard in a picture, the longer side first; None where none is seen."""
    detected, _, meta = cv2.findChessboardCornersSBWithMeta(shrunk(grey), SMALLEST, cv2.CALIB_CB_LARGER)
    if not detected or meta is None or np.ndim(meta) != 2:
        return None
    rows, columns = sorted(np.shape(meta))
    return int(columns), int(rows)


def why_no_board(pictures: Sequence[np.ndarray], columns: int, rows: int) -> tuple[str, str]:
    """What pictures without the board show, and what to do.

    Args:
        pictures: some of a camera.
        columns: inner corners that were looked for, along one side.
        rows: along the other.
    """
    wanted = (max(columns, rows), min(columns, rows))
    boards = Counter(size for grey in pictures if (size := inner_corners(grey)) is not None)
    if boards:
        (long, short), count = boards.most_common(1)[0]
        listed = ", ".join(f"{a}x{b}" for a, b in boards)
        if (
            len(boards) > 1
            and 2 * count <= boards.total()
            and all(a <= wanted[0] and b <= wanted[1] for a, b in boards)
        ):
            return (
                f"parts of a board are seen, {listed} inner corners of {wanted[0]}x{wanted[1]}: partly outside?",
                "hold the whole board into both pictures; or is it smaller: count where four squares meet",
            )
        remedy = f"--board {long}x{short}? count where four squares meet, not the squares"
        return f"{long}x{short} inner corners are seen in {count} of {len(pictures)} pictures", remedy
    levels = [float(grey.mean()) for grey in pictures]
    if float(np.median(levels)) < DARK_DN:
        remedy = "more light, or a longer exposure"
        return f"the pictures are dark, mean grey level {np.median(levels):.0f} of 255", remedy
    clipped = [float((grey >= 254).mean()) for grey in pictures]
    if float(np.median(levels)) > BRIGHT_DN or float(np.median(clipped)) > CLIPPED_SHARE:
        remedy = "less light, or a shorter exposure"
        return f"the pictures are overexposed, {100 * np.median(clipped):.0f} % of the pixels are white", remedy
    if float(np.median([_sharpness(grey) for grey in pictures])) < BLURRED_SHARE:
        return "the pictures are blurred: no edge is in focus", "focus, and hold the board still"
    remedy = (
        "check --board (inner corners, one less than squares), sharpness and light; a ruled or printed white margin "
    )
    return "no checkerboard of any size is seen", remedy + "around the board helps"


def _sharpness(grey: np.ndarray) -> float:
    """Of the sharpest edges: second differences over the range of grey levels."""
    low, high = np.percentile(grey, (1, 99))
    second = np.abs(cv2.Laplacian(grey, cv2.CV_32F))
    return float(np.percentile(second, 99.5)) / max(float(high - low), 8.0)
