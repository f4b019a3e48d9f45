"""Locate the spot in a picture and select the pixels around it for the fit; or state why there is not exactly one.

Raw image px with the integer at the centre of a pixel; DN = grey levels of 8 bits; pictures (height, width, 3), blue,
green, red, uint8, or float32 DN for deeper pictures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, sqrt

import numpy as np

from tvsbayes.cameras.spot_noise import background_variance, grey_of

CLIPPED_DN = 250
"""A channel at or above this counts as clipped: white balance and JPEG leave full wells slightly below 255."""
CLIPPED_SHARE_MAX = 0.5
"""Largest clipped share of the bright area: half of it means about three times overexposed."""
BRIGHT_SHARE = 0.3
"""Level of the bright area and of the paper's contour between background and highest value."""
SECOND_SHARE = 0.25
AREA_MAX_SHARE = 0.05
"""Largest bright area over the picture; at 1280 x 720 px a spot of 70 px sd."""
DETECTION_SIGMAS, DETECTION_MIN_DN = 8.0, 2.0
"""Least height of a spot over the background, for means of 4 x 4 px: in their sds and in DN."""
BLOCKS_PER_SD = 4
"""Wide spots are fitted to means of blocks of pixels, a quarter of their sd wide: as accurate, and faster."""
WIDE_SD_PX = 5.0
"""Least sd of a spot whose pixels determine the noise; those of a narrower spot also show its shape."""
SHRINK = 4
LAMP_SHARE = 0.01
"""Least area, over the picture, of a bright area at the border that counts as a lamp or a window."""
LAMP_AREA_RATIO, LAMP_HEIGHT_SHARE = 4.0, 0.8
"""A bright area at the border, or larger than any spot, is a lamp or a window if the picture has a spot and the area is
this many times larger or has at most this share of its height. A laser spot at the border would be brighter than its
own reflections, and not larger."""


@dataclass(frozen=True)
class Patch:
    """The pixels around a spot: grey (h, w) DN, usable (h, w), position of its corner, and first estimates.

    Where `block` is over 1, grey has means of block x block pixels of `raw`.
    """

    grey: np.ndarray
    raw: np.ndarray
    usable: np.ndarray
    block: int
    mono: bool
    corner: tuple[int, int]
    start_px: np.ndarray
    start_sd_px: float
    background_variance: float
    clipped_share: float
    outline_px: np.ndarray
    size: tuple[int, int]

    @property
    def wide(self) -> bool:
        """Whether its pixels separate noise and shape."""
        return self.start_sd_px >= WIDE_SD_PX


def patch_around(picture: np.ndarray) -> Patch | str:
    """Find the spot of a picture, or return the reason for refusal where there is not exactly one."""
    import cv2

    height, width = picture.shape[:2]
    if min(height, width) < 2 * SHRINK:
        return "no-spot"
    # OpenCV's weights of the colours suffice to find the spot, and are several times faster.
    small = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    small = cv2.resize(small, (width // SHRINK, height // SHRINK), interpolation=cv2.INTER_AREA)
    # Lamps and gradients are wide; a spot is several times smaller than 11 cells of 8 px.
    background = cv2.resize(small, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    background = cv2.resize(_wide_median(background), small.shape[::-1], interpolation=cv2.INTER_LINEAR)
    above = cv2.blur(cv2.subtract(small, background, dtype=cv2.CV_32F), (2, 2))
    noise = 1.4826 * float(np.median(np.abs(above[::3, ::3])))
    peak = float(above.max())
    if peak < max(DETECTION_SIGMAS * noise, DETECTION_MIN_DN):
        return "no-spot"
    bright = (above > max(SECOND_SHARE * peak, DETECTION_SIGMAS / 2 * noise)).astype(np.uint8)
    # The next steps need only a few cells; the whole picture would take much longer.
    column, row, columns, rows = cv2.boundingRect(bright)
    box = np.s_[row : row + rows, column : column + columns]
    count, labels, stats, centroids = cv2.connectedComponentsWithStats(bright[box], connectivity=8)
    lit = labels > 0
    flux = np.bincount(labels[lit].astype(np.intp), weights=above[box][lit], minlength=count)
    heights = np.zeros(count)
    np.maximum.at(heights, labels[lit].astype(np.intp), above[box][lit])
    if count > 2 or stats[1, cv2.CC_STAT_AREA] > 0.2 * LAMP_SHARE * bright.size:
        surroundings = cv2.subtract(small, above, dtype=cv2.CV_32F)[box]
        levels = [float((surroundings[labels == k] + 0.5 * heights[k]).mean()) for k in range(1, count)]
        inside = [np.argwhere(labels == k)[0] + (row, column) for k in range(1, count)]
        lamps, alone = _lamps(small, levels, inside, heights, flux)
        if alone:
            return "lamp"
        flux[lamps] = 0.0
    main = int(flux.argmax())
    if np.sort(flux)[-2] > SECOND_SHARE * flux[main]:
        return "two-spots"
    area = float(stats[main, cv2.CC_STAT_AREA])
    if area > AREA_MAX_SHARE * bright.size:
        return "too-large"
    # A Gaussian is above a quarter of its peak within a radius of sqrt(2 ln 4) = 1.67 sds.
    sd = SHRINK * sqrt(area / pi) / 1.67
    # The cell's centre, minus the half cell by which the 2 x 2 blur moved it.
    start = (centroids[main] + (column, row) + 0.5) * SHRINK - 0.5 - SHRINK / 2
    block = max(1, int(sd / BLOCKS_PER_SD))
    half = int(min(max((4 if sd < WIDE_SD_PX else 6) * sd + 5, 14), max(height, width)))
    left, top = np.maximum(np.round(start).astype(int) - half, 0)
    right, bottom = np.minimum(np.round(start).astype(int) + half + 1, (width, height))
    window = picture[top:bottom, left:right]
    grey = grey_of(window)
    clipped = (window >= CLIPPED_DN).any(axis=2).astype(np.uint8)
    floor = float(np.median(np.concatenate((grey[0], grey[-1], grey[:, 0], grey[:, -1]))))
    level = floor + BRIGHT_SHARE * (float(grey.max()) - floor)
    bright = (grey > level).astype(np.uint8)
    outlines, _ = cv2.findContours(bright, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outline = max(outlines, key=cv2.contourArea, default=np.empty((0, 1, 2), int)).reshape(-1, 2)
    # Demosaicing spreads a clipped photosite over its neighbours.
    usable = cv2.dilate(clipped, np.ones((3, 3), np.uint8)) == 0
    return Patch(
        grey=block_means(grey, block),
        raw=grey,
        usable=block_means(usable.astype(np.float32), block) == 1,
        block=block,
        mono=bool((window == window[..., :1]).all()),
        corner=(int(left), int(top)),
        start_px=start,
        start_sd_px=max(sd, 1.0),
        background_variance=background_variance(picture, start, half),
        clipped_share=float(clipped.sum()) / max(1.0, float(bright.sum())),
        outline_px=outline + np.array([left, top]),
        size=(width, height),
    )


def _lamps(
    small: np.ndarray, levels: Sequence[float], inside: Sequence[np.ndarray], heights: np.ndarray, flux: np.ndarray
) -> tuple[list[int], bool]:
    """Find bright areas that are lamps or windows beside a spot, and whether there is a lamp but no spot.

    Beside a spot, lamps are areas at the border or too large, and large or dim compared with the spot.

    Args:
        small: the picture in cells, (h, w).
        levels: half way between the surroundings of each area and its peak, DN: all connected pixels above it belong to
            the area, also those that the median of the surroundings removed.
        inside: row and column of a cell of each area.
        heights: height over the background, DN, of the areas from the second on; (n + 1,).
        flux: sum over the area, likewise; (n + 1,).
    """
    import cv2

    count = len(levels)
    area, suspect, at_border = np.zeros(count + 1), np.ones(count + 1, dtype=bool), np.zeros(count + 1, dtype=bool)
    for k, (level, (row, column)) in enumerate(zip(levels, inside, strict=True), start=1):
        _, labels, stats, _ = cv2.connectedComponentsWithStats((small > level).astype(np.uint8), connectivity=8)
        area_mask = labels == labels[row, column]
        area[k] = stats[labels[row, column], cv2.CC_STAT_AREA] if labels[row, column] else 1
        at_border[k] = area_mask[0].any() or area_mask[-1].any() or area_mask[:, 0].any() or area_mask[:, -1].any()
        at_border[k] &= bool(labels[row, column])
        suspect[k] = at_border[k] or area[k] > AREA_MAX_SHARE * small.size
    if suspect.all():
        return [], bool(at_border[int(flux.argmax())] and area[int(flux.argmax())] > LAMP_SHARE * small.size)
    best = int(np.argmax(np.where(suspect, -1.0, flux)))
    large, dim = area >= LAMP_AREA_RATIO * area[best], heights <= LAMP_HEIGHT_SHARE * heights[best]
    return [k for k in range(1, count + 1) if suspect[k] and (large[k] or dim[k])], False


def _wide_median(picture: np.ndarray) -> np.ndarray:
    """Median over 11 x 11; OpenCV has it for 8 bits only."""
    import cv2

    if picture.dtype == np.uint8:
        return cv2.medianBlur(picture, 11)
    step = max(float(picture.max()), 1e-9) / 255
    return cv2.medianBlur((picture / step).astype(np.uint8), 11).astype(np.float32) * np.float32(step)


def block_means(values: np.ndarray, block: int) -> np.ndarray:
    """Means of block x block pixels; incomplete blocks at the far sides are dropped."""
    import cv2

    if block == 1:
        return values
    height, width = (length // block for length in values.shape)
    cropped = np.ascontiguousarray(values[: height * block, : width * block])
    return cv2.resize(cropped, (width, height), interpolation=cv2.INTER_AREA)
