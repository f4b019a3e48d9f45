"""The noise of a camera's pixels around a laser spot: the effect of demosaicing, and the estimation from a campaign.

DN = grey levels of 8 bits; pictures (height, width, 3), blue, green, red, uint8, deeper ones float32 DN; grey is
(B + 2 G + R) / 4, with equal weights for all photosites of a Bayer sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

GAIN_MEDIAN_DN, GAIN_SD_OF_LOG = 0.05, 1.0
"""Prior of the shot-noise gain, log-normal, DN per DN of signal: 255 DN at 5000 electrons, within a factor of e."""
CONTRAST_DEFAULT = 0.4
"""Speckle contrast assumed without a campaign: the middle of the contrasts after averaging, 0.3 to 0.63."""
CONTRAST_SCALE, CONTRAST_MAX = 0.5, 2.0
"""Prior of the estimated contrast: half-normal of this scale, up to this limit. Speckle may be absent; fully developed
it has contrast 1, multiplied by its grain in px."""
SKEW_OUTLIER = 30.0
"""Limit of a squared skew residual over its expectation, above which it is left out (normal: one in 10^7)."""
DEEP_VARIANCE_MIN = 1e-5
"""Least variance of a pixel of more than 8 bits, DN^2: rounding of 14 bits."""
SHAPE_SPOTS_MIN = 4
OWN_PIXELS_MIN, OWN_BINS, OWN_SHARE, OWN_DARK_SHARE, OWN_GAIN_MIN_DN = 200, 8, 0.05, 0.005, 1e-4
"""For `pixel_noise`: least number of pixels, number of bins, shares of the peak above which a pixel counts as lit and
below which as dark, smallest gain."""
_CELL = 8


# Correlation of grey pixels after bilinear demosaicing: mean over red and blue sites, whose kernel is
# (1 2 1; 2 4 2; 1 2 1) / 16, and green ones, (0 1 0; 1 4 1; 0 1 0) / 8.
_GREEN = [[0, 0, 1, 0, 0], [0, 2, 8, 2, 0], [1, 8, 20, 8, 1], [0, 2, 8, 2, 0], [0, 0, 1, 0, 0]]
_CORRELATION = (np.outer([1, 4, 6, 4, 1], [1, 4, 6, 4, 1]) / 256 + np.array(_GREEN) / 64) / 2
_LAGS = np.maximum(_CELL - np.abs(np.arange(-2, 3)), 0)
_CELL_VARIANCE = float(np.sum(_CORRELATION * np.outer(_LAGS, _LAGS))) / _CELL**4
"""Variance of the mean of a cell for unit noise per photosite."""


@dataclass(frozen=True)
class SpotNoise:
    """Variance of a grey pixel with signal S beyond the background's: gain_dn * S + (speckle_contrast * S)^2, DN^2.

    The contrast is that per independent pixel: contrast times the root of the grain's area in px. `skew` is the shape
    common to all spots of the camera, as the amplitudes of four functions (`spot_fit.skewness`); it is not noise.
    """

    gain_dn: float = GAIN_MEDIAN_DN
    speckle_contrast: float = CONTRAST_DEFAULT
    skew: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)


def learn_noise(skews: np.ndarray, speckle_contrast: float | None = None) -> SpotNoise:
    """Estimate gain and contrast of one camera: posterior means of contrast and log gain on a grid.

    Means of their squares would be too large without speckle, since the contrast's posterior begins at 0.

    Args:
        skews: (spots, 4, 4) as returned by `skewness`. With `SHAPE_SPOTS_MIN` spots or more, their median is the beam's
            own shape and not noise: speckle differs from look to look, a beam does not.
        speckle_contrast: known contrast; by default it is estimated.
    """
    count, shape = len(skews), np.zeros(4)
    if count >= SHAPE_SPOTS_MIN:
        shape = np.median(skews[:, :, 0], axis=0)
    squared = np.array(skews, dtype=float)
    squared[:, :, 0] = (skews[:, :, 0] - shape) ** 2 * (count / (count - 1) if shape.any() else 1.0)
    skews = squared.reshape(-1, 4)
    deviations = np.linspace(-3, 3, 41)[:, None]
    gains = GAIN_MEDIAN_DN * np.exp(deviations * GAIN_SD_OF_LOG)
    # Equal steps of the root make the grid fine near 0; the weight of a point is the width of its cell.
    contrasts = np.linspace(0, 1, 121) ** 2 * CONTRAST_MAX
    widths = np.gradient(contrasts)
    if speckle_contrast is not None:
        contrasts, widths = np.array([speckle_contrast]), np.ones(1)
    squares = contrasts**2
    # A reflection in one spot must not widen all others.
    measured, background, per_gain, per_contrast = skews.T
    ratio = measured / (background + per_gain * GAIN_MEDIAN_DN + per_contrast * np.median(squares))
    skews = skews[ratio <= SKEW_OUTLIER * np.median(ratio) / 0.455]  # 0.455: median of a squared normal value
    logs = np.log(widths) - squares / CONTRAST_SCALE**2 / 2 - deviations**2 / 2
    for measured, background, per_gain, per_contrast in skews:
        variance = background + per_gain * gains + per_contrast * squares
        logs -= (np.log(variance) + measured / variance) / 2
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    gain_dn = GAIN_MEDIAN_DN * float(np.exp(GAIN_SD_OF_LOG * (weights.sum(axis=1) @ deviations.ravel())))
    return SpotNoise(gain_dn, float(weights.sum(axis=0) @ contrasts), tuple(shape.tolist()))


def pixel_noise(
    residual: np.ndarray, signal: np.ndarray, usable: np.ndarray, background: float, mono: bool
) -> tuple[SpotNoise, float]:
    """The noise of one picture from second differences of a fit's residuals, and its variance without light, DN^2.

    Differences over 1 px (3 px in demosaiced pictures) contain the noise of pixels and the finest grain of speckle, and
    little of a beam's rings and fringes. Only the scatter between looks shows a coarser grain.

    Args:
        residual: grey minus fitted (h, w), DN.
        signal: fitted light of the spot (h, w), DN.
        usable: mask of the pixels used (h, w).
        background: variance of one photosite without light, DN^2, where too few pixels around the spot are dark.
        mono: whether the pixels are single photosites, not demosaiced.
    """
    from scipy.optimize import nnls

    lag, single = (1, 1.0) if mono else (3, float(_CORRELATION[2, 2]))
    rows = []
    for axis, length in enumerate(residual.shape):
        parts = [np.arange(k * lag, length - (2 - k) * lag) for k in range(3)]
        earlier, middle, later = (np.take(residual, part, axis) for part in parts)
        inside = np.logical_and.reduce([np.take(usable, part, axis) for part in parts])
        # Variance of one value minus half of two others: 1 + 1/4 + 1/4.
        squares = (middle - (earlier + later) / 2)[inside] ** 2 / 1.5 / single
        rows.append(np.stack((squares, np.take(signal, parts[1], axis)[inside])))
    squares, light = np.hstack(rows)
    if len(light) < OWN_PIXELS_MIN:
        return SpotNoise(), background
    dark = squares[light < OWN_DARK_SHARE * light.max()]
    if len(dark) >= OWN_PIXELS_MIN:
        background = max(float(dark.mean()), DEEP_VARIANCE_MIN)
    order = np.argsort(light)
    bins = np.array_split(order[light[order] > OWN_SHARE * light.max()], OWN_BINS)
    level, mean = (np.array([values[part].mean() for part in bins]) for values in (light, squares))
    # The means have equal relative errors, so relative residuals are minimised.
    weight = 1 / np.maximum(mean, 1e-12)
    excess = np.maximum(mean - background, 0.0)
    gain, contrast2 = nnls(np.column_stack((level, level**2)) * weight[:, None], excess * weight)[0]
    return SpotNoise(max(float(gain), OWN_GAIN_MIN_DN), float(np.sqrt(contrast2))), background


def mean_noise(noises: Sequence[SpotNoise]) -> SpotNoise:
    """Average the noise of a few pictures of one camera: means of variances, median shape."""
    gain = float(np.mean([noise.gain_dn for noise in noises]))
    contrast = float(np.sqrt(np.mean([noise.speckle_contrast**2 for noise in noises])))
    return SpotNoise(gain, contrast, tuple(np.median([noise.skew for noise in noises], axis=0).tolist()))


def background_variance(picture: np.ndarray, centre: np.ndarray, half: int) -> float:
    """Variance of one photosite around the spot, DN^2.

    It uses means of 8 x 8 px, in second differences that slopes do not affect: single demosaiced pixels are smoothed
    and show too small a variance.
    """
    import cv2

    corner = np.floor(centre).astype(int) - half - 96
    low = np.clip(corner, 0, picture.shape[1::-1])
    high = np.clip(corner + 2 * half + 192, 0, picture.shape[1::-1])
    cells = (high - low) // _CELL
    region = grey_of(picture[low[1] : low[1] + _CELL * cells[1], low[0] : low[0] + _CELL * cells[0]])
    if min(cells) < 3:
        return 1.0
    means = cv2.resize(region, (int(cells[0]), int(cells[1])), interpolation=cv2.INTER_AREA)
    v, u = np.indices(means.shape)
    middle = (_CELL - 1) / 2
    away_u, away_v = np.abs(_CELL * u + middle + low[0] - centre[0]), np.abs(_CELL * v + middle + low[1] - centre[1])
    outside = np.maximum(away_u, away_v) > half + 2 * _CELL
    values = (means[:, 1:-1] - (means[:, :-2] + means[:, 2:]) / 2)[outside[:, 1:-1]]
    if values.size < 8:
        return 1.0
    # MAD, since edges of other objects in the picture are few. 1.5: variance of the difference of independent means.
    variance = (1.4826 * float(np.median(np.abs(values)))) ** 2 / 1.5 / _CELL_VARIANCE
    return max(variance, 1 / 12 if picture.dtype == np.uint8 else DEEP_VARIANCE_MIN)  # rounding to whole grey levels


def through_demosaicing(filters: np.ndarray, shape: tuple[int, int], block: int = 1) -> np.ndarray:
    """Variance (k,) of filters (k, n) on a grey patch (h, w) with unit noise per photosite."""
    import cv2

    if block > 1:
        # Demosaicing keeps the sum of its correlations at 1, so wide blocks of pixels are independent.
        return np.einsum("kn,kn->k", filters, filters) / block**2
    pictures = filters.reshape(len(filters), *shape)
    smooth = [cv2.filter2D(picture, cv2.CV_64F, _CORRELATION, borderType=cv2.BORDER_CONSTANT) for picture in pictures]
    return np.einsum("kij,kij->k", pictures, np.array(smooth))


def grey_of(picture: np.ndarray) -> np.ndarray:
    """Grey (h, w) of a picture or a part of it, DN."""
    return picture.astype(np.float32) @ np.array([0.25, 0.5, 0.25], np.float32)
