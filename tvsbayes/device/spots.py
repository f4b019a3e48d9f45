"""Laser spots in pictures: centres with covariances from the frames of a campaign, or the reason why there is none.

Raw image px with the integer at the centre of a pixel; DN = grey levels of 8 bits; pictures (height, width, 3) uint8,
blue, green, red. Two methods:

- `fit` (default): an elliptic Gaussian on a sloping background, fitted to the pixels around the spot by iterated
  weighted least squares. Pixels next to a clipped one are left out: a clipped core is normal, costs information and so
  widens the standard uncertainty. Grey is (B + 2 G + R) / 4, in which every photosite of a Bayer sensor weighs alike;
  808 nm passes all three dyes, so hue tells nothing. Variance of a pixel with signal S:
  background + gain * S + (contrast * S)^2: what the frame shows without spot, shot noise, speckle.
- `contour`: the paper's (section 2.4): rectify, region of interest, HSV, threshold, contour, centroid of the binary
  region, here taken back to the raw pixels of the format.

Gain and contrast are learned from the campaign itself, per camera, from what a symmetric fit cannot follow: third-order
(skew) residuals have the scale of the spot, are noise alone for any symmetric spot, and average demosaicing and the
grain of speckle as the centre does. A skewed beam counts as noise and widens the sd. Sd of an intensity centroid under
speckle alone: contrast / sqrt(8 pi) = 0.2 contrast px, whatever the size of the spot (Gaussian spot, independent
pixels). No JAX.

Refusals (status in spots.csv: reason, then the camera): see `REASONS`.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from math import log, pi, sqrt
from pathlib import Path

import numpy as np

from tvsbayes.campaign import Campaign, Spot
from tvsbayes.classic import distort, undistort
from tvsbayes.files import (
    IMAGE_BYTES_MAX,
    InputError,
    NothingToEstimate,
    decode_image,
    escaped,
    image_size,
    make_folder,
    png_bytes,
    read_bytes,
    refusal,
    write_atomically,
)
from tvsbayes.rigs import Stereo

METHODS = ("fit", "contour")
SIDES = ("left", "right")
REASONS = {
    "no-spot": "nothing stands out of the background",
    "two-spots": "a second spot holds over a quarter of the light of the first",
    "too-small": "the bright area is that of a hot pixel",
    "too-large": "the bright area is no laser spot: a lamp or an overexposed frame",
    "border": "the spot reaches the border of the picture",
    "clipped": "the clipped area is over half the bright area",
    "elongated": "the spot is over four times as long as wide",
    "misshapen": "skewed far beyond noise: a reflection, dust or an edge in the spot",
    "unfitted": "the fit did not settle",
    "epipolar": "left and right are not images of one point",
}
CLIPPED_DN = 250
"""A channel at or above this counts as clipped: white balance and JPEG leave full wells a little below 255."""
CLIPPED_SHARE_MAX = 0.5
"""Half the bright area: about three times overexposed."""
BRIGHT_SHARE = 0.3
"""Level of the bright area and of the paper's contour between background and highest value."""
SECOND_SHARE = 0.25
AREA_MIN_PX = 4.0
"""Least area at half height, px^2: a hot pixel after demosaicing has 2."""
AREA_MAX_SHARE = 0.03
"""Of the picture; at 1280 x 720 px a spot of 50 px sd."""
AXES_RATIO_MAX = 4.0
"""A sheet at 70 degrees to the beam gives 2.9."""
BORDER_SDS = 3.0
"""A spot cut off nearer than this has lost what tells its place."""
DETECTION_SIGMAS, DETECTION_MIN_DN = 8.0, 2.0
"""Least height of a spot over the background, of means of 4 x 4 px: in sds of them and in DN."""
EPIPOLAR_SIGMAS, EPIPOLAR_FLOOR_PX = 6.0, 0.5
"""A pair is refused beyond six combined sds (spot and calibration), and never below half a pixel."""
GAIN_MEDIAN_DN, GAIN_SD_OF_LOG = 0.05, 1.0
"""Prior of the shot-noise gain, log-normal, DN per DN of signal: 255 DN at 5000 electrons, within a factor of e."""
CONTRAST_DEFAULT = 0.4
"""Speckle contrast where no campaign tells it: the middle of what averaging leaves, 0.3 to 0.63 (research note on
vision, section 4)."""
CONTRAST_SCALE, CONTRAST_MAX = 0.5, 2.0
"""Prior of the learned contrast: half-normal of this scale, up to here. Speckle may be absent; fully developed it has
1, and its grain in px multiplies that."""
PILOTS_MAX = 24
"""Looks from which the weights of the fits are learned; uncertainties are stated from all."""
LEARNING_ROUNDS = 3
SKEWS_MAX = 4000
SKEW_OUTLIER = 30.0
"""A squared skew residual this many times its expectation teaches nothing about noise (normal: one in 10^7)."""
SKEW_LIMIT = 80.0
"""Largest sum of a spot's four standardised squared skew residuals (normal: one in 10^15; speckle has longer tails)."""
_SHRINK = 4
_CELL = 8


def _autocorrelation(kernel: np.ndarray) -> np.ndarray:
    padded = np.pad(kernel, 2)
    return np.array([[np.sum(kernel * padded[i : i + 3, j : j + 3]) for j in range(5)] for i in range(5)])


# What one photosite's noise becomes in grey by bilinear demosaicing: red and blue sites, green sites; half of each.
_CORRELATION = (
    _autocorrelation(np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 16)
    + _autocorrelation(np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]]) / 8)
) / 2
_LAGS = np.maximum(_CELL - np.abs(np.arange(-2, 3)), 0)
_CELL_VARIANCE = float(np.sum(_CORRELATION * np.outer(_LAGS, _LAGS))) / _CELL**4
"""Variance of the mean of a cell for unit noise per photosite."""


@dataclass(frozen=True)
class SpotNoise:
    """Variance of a grey pixel with signal S beyond the background's: gain_dn * S + (speckle_contrast * S)^2, DN^2.

    The contrast is that per independent pixel: contrast times the root of the grain's area in px.
    """

    gain_dn: float = GAIN_MEDIAN_DN
    speckle_contrast: float = CONTRAST_DEFAULT


@dataclass(frozen=True)
class Centre:
    """One camera's spot, or why there is none.

    Attributes:
        status: "ok" or a key of `REASONS`.
        centre_px: (2,) u, v; None where there is none.
        covariance_px2: (2, 2) of the centre; None where there is none.
        axes_px: sds of the spot's image along its long and short axis.
        clipped_share: clipped area over bright area.
        outline_px: (n, 2) outline of the bright area, for pictures; may be empty.
        parts_px2: (3, 2, 2) covariance from the background's noise, per gain and per contrast^2 (`fit`).
        skews: (4, 4) as `learn_noise` takes them (`fit`).
    """

    status: str
    centre_px: np.ndarray | None = None
    covariance_px2: np.ndarray | None = None
    axes_px: tuple[float, float] = (0.0, 0.0)
    clipped_share: float = 0.0
    outline_px: np.ndarray | None = None
    parts_px2: np.ndarray | None = None
    skews: np.ndarray | None = None

    def under(self, noise: SpotNoise) -> Centre:
        """The same centre with the covariance that this noise gives it; misshapen where its skew is no noise."""
        if self.parts_px2 is None or self.skews is None:
            return self
        units = np.array([1.0, noise.gain_dn, noise.speckle_contrast**2])
        covariance = np.einsum("k,kij->ij", units, self.parts_px2)
        skewed = float(np.sum(self.skews[:, 0] / (self.skews[:, 1:] @ units))) > SKEW_LIMIT
        status = self.status
        if status in ("ok", "misshapen"):
            status = "misshapen" if skewed else "ok"
        return replace(self, covariance_px2=covariance, status=status)


@dataclass(frozen=True)
class _Patch:
    """The pixels around a spot: grey (h, w) DN, usable (h, w), where its corner lies, and first guesses."""

    grey: np.ndarray
    usable: np.ndarray
    corner: tuple[int, int]
    start_px: np.ndarray
    start_sd_px: float
    background_variance: float
    clipped_share: float
    outline_px: np.ndarray
    size: tuple[int, int]


@dataclass(frozen=True)
class _Fitted:
    """A converged fit: centre (2,), precision (2, 2), and what its covariance is made of.

    Over the n pixels of the patch: signal, its derivatives (9, n), weights (0 where not usable), residuals and the
    coordinates in sds of the spot.
    """

    centre_px: np.ndarray
    precision: np.ndarray
    signal: np.ndarray
    jacobian: np.ndarray
    weights: np.ndarray
    residual: np.ndarray
    z1: np.ndarray
    z2: np.ndarray


def _grey(picture: np.ndarray) -> np.ndarray:
    return picture.astype(np.float32) @ np.array([0.25, 0.5, 0.25], np.float32)


def _patch(picture: np.ndarray) -> _Patch | str:
    """Find the spot of a picture; the reason for refusal where there is not exactly one."""
    import cv2

    height, width = picture.shape[:2]
    # To find the spot OpenCV's own weights of the colours will do; they are several times faster.
    small = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    small = cv2.resize(small, (width // _SHRINK, height // _SHRINK), interpolation=cv2.INTER_AREA)
    # Lamps and gradients are wide, a spot is not: 11 cells of 8 px hold it several times.
    wide = cv2.resize(small, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    wide = cv2.resize(cv2.medianBlur(wide, 11), small.shape[::-1], interpolation=cv2.INTER_LINEAR)
    above = cv2.blur(cv2.subtract(small, wide, dtype=cv2.CV_32F), (2, 2))
    noise = 1.4826 * float(np.median(np.abs(above[::3, ::3])))
    peak = float(above.max())
    if peak < max(DETECTION_SIGMAS * noise, DETECTION_MIN_DN):
        return "no-spot"
    bright = (above > max(SECOND_SHARE * peak, DETECTION_SIGMAS / 2 * noise)).astype(np.uint8)
    count, labels, stats, centroids = cv2.connectedComponentsWithStats(bright, connectivity=8)
    flux = np.bincount(labels.ravel(), weights=above.ravel(), minlength=count)
    flux[0] = 0.0
    main = int(flux.argmax())
    if np.sort(flux)[-2] > SECOND_SHARE * flux[main]:
        return "two-spots"
    area = float(stats[main, cv2.CC_STAT_AREA])
    if area > AREA_MAX_SHARE * bright.size:
        return "too-large"
    # A Gaussian is above a quarter of its peak within a radius of sqrt(2 ln 4) = 1.67 sds.
    sd = _SHRINK * sqrt(area / pi) / 1.67
    # The cell's centre, and the half cell that the 2 x 2 blur moved it by.
    start = (centroids[main] + 0.5) * _SHRINK - 0.5 - _SHRINK / 2
    half = int(min(max(4 * sd + 5, 14), max(height, width)))
    left, top = np.maximum(np.round(start).astype(int) - half, 0)
    right, bottom = np.minimum(np.round(start).astype(int) + half + 1, (width, height))
    window = picture[top:bottom, left:right]
    grey = _grey(window)
    clipped = (window >= CLIPPED_DN).any(axis=2).astype(np.uint8)
    floor = float(np.median(np.concatenate((grey[0], grey[-1], grey[:, 0], grey[:, -1]))))
    level = floor + BRIGHT_SHARE * (float(grey.max()) - floor)
    bright = (grey > level).astype(np.uint8)
    outlines, _ = cv2.findContours(bright, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outline = max(outlines, key=cv2.contourArea, default=np.empty((0, 1, 2), int)).reshape(-1, 2)
    # Demosaicing spreads a clipped photosite over its neighbours.
    usable = cv2.dilate(clipped, np.ones((3, 3), np.uint8)) == 0
    return _Patch(
        grey=grey,
        usable=usable,
        corner=(int(left), int(top)),
        start_px=start,
        start_sd_px=max(sd, 1.0),
        background_variance=_background_variance(picture, start, half),
        clipped_share=float(clipped.sum()) / max(1.0, float(bright.sum())),
        outline_px=outline + np.array([left, top]),
        size=(width, height),
    )


def _background_variance(picture: np.ndarray, centre: np.ndarray, half: int) -> float:
    """Variance of one photosite around the spot, DN^2.

    From means of 8 x 8 px, in second differences that slopes do not enter: single demosaiced pixels are smoothed and
    show too little.
    """
    import cv2

    corner = np.floor(centre).astype(int) - half - 96
    low = np.clip(corner, 0, picture.shape[1::-1])
    high = np.clip(corner + 2 * half + 192, 0, picture.shape[1::-1])
    cells = (high - low) // _CELL
    region = _grey(picture[low[1] : low[1] + _CELL * cells[1], low[0] : low[0] + _CELL * cells[0]])
    if min(cells) < 3:
        return 1.0
    means = cv2.resize(region, (int(cells[0]), int(cells[1])), interpolation=cv2.INTER_AREA)
    v, u = np.indices(means.shape)
    middle = (_CELL - 1) / 2
    off_u, off_v = np.abs(_CELL * u + middle + low[0] - centre[0]), np.abs(_CELL * v + middle + low[1] - centre[1])
    far = np.maximum(off_u, off_v) > half + 2 * _CELL
    values = (means[:, 1:-1] - (means[:, :-2] + means[:, 2:]) / 2)[far[:, 1:-1]]
    if values.size < 8:
        return 1.0
    # MAD: edges of other things in the picture are few. 1.5: variance of the difference of independent means.
    variance = (1.4826 * float(np.median(np.abs(values)))) ** 2 / 1.5 / _CELL_VARIANCE
    return max(variance, 1 / 12)  # rounding to whole grey levels


def _fit(patch: _Patch, noise: SpotNoise) -> _Fitted | None:
    """Elliptic Gaussian on a plane by weighted Gauss-Newton steps; None where they do not settle.

    Parameters: log height, centre, lower triangle of the precision's Cholesky factor with logs on its diagonal,
    level and slopes of the background. Own steps and no library's: a general solver takes longer than the decoding
    of the picture.
    """
    v, u = (axis.ravel().astype(float) for axis in np.indices(patch.grey.shape))
    usable = patch.usable.ravel()
    if usable.sum() < 25:
        return None
    data = patch.grey.ravel().astype(float)
    edge = float(np.median(np.concatenate((patch.grey[0], patch.grey[-1]))))
    centre = patch.start_px - np.array(patch.corner)
    tight = -log(patch.start_sd_px)
    p = np.array([log(max(float(patch.grey.max()) - edge, 1.0)), *centre, tight, 0.0, tight, edge, 0.0, 0.0])
    middle_u, middle_v = (np.array(patch.grey.shape[::-1]) - 1) / 2
    jacobian = np.empty((9, data.size))
    jacobian[6], jacobian[7], jacobian[8] = 1.0, (u - middle_u) / (middle_u + 1), (v - middle_v) / (middle_v + 1)
    limits = np.array([0.7, 0, 0, 0.4, 0.4, 0.4, np.inf, np.inf, np.inf])
    settled = 0
    for iteration in range(60):
        a, b, c = np.exp(p[3]), p[4], np.exp(p[5])
        x, y = u - p[1], v - p[2]
        z1, z2 = a * x + b * y, c * y
        signal = np.exp(p[0] - (z1 * z1 + z2 * z2) / 2)
        residual = data - signal - p[6:] @ jacobian[6:]
        along = signal * z1
        down = signal * z2
        np.multiply(along, a, out=jacobian[1])
        np.multiply(along, b, out=jacobian[2])
        jacobian[2] += down * c
        jacobian[0] = signal
        np.multiply(along, -a * x, out=jacobian[3])
        np.multiply(along, -y, out=jacobian[4])
        np.multiply(down, -c * y, out=jacobian[5])
        # Far from the solution the weights of a wrong model mislead: equal ones first.
        if settled:
            weights = usable / (
                patch.background_variance + signal * (noise.gain_dn + noise.speckle_contrast**2 * signal)
            )
        else:
            weights = usable / patch.background_variance
        weighted = jacobian * weights
        normal = weighted @ jacobian.T
        scale = np.sqrt(np.diag(normal)) + 1e-30
        damping = 1e-12 if settled else 1e-3
        try:
            step = np.linalg.solve(normal / np.outer(scale, scale) + damping * np.eye(9), weighted @ residual / scale)
        except np.linalg.LinAlgError:
            return None
        step /= scale
        limits[1] = limits[2] = 1 / min(a, c)
        limits[4] = 0.4 * c
        step *= min(1.0, float(np.min(limits / np.maximum(np.abs(step), 1e-300))))
        move, change = np.abs(step[1:3]).max() * max(a, c), np.abs(step[[0, 3, 5]]).max()
        # In sds of the spot; what is left after the last step is ten times less.
        if settled > 1 and move < 5e-4 and change < 5e-3:
            factor = np.array([[a, 0.0], [b, c]])
            centre = p[1:3] + step[1:3] + np.array(patch.corner)
            return _Fitted(centre, factor @ factor.T, signal, jacobian, weights, residual, z1, z2)
        settled += bool(settled or (move < 0.05 and change < 0.1) or iteration > 12)
        p = p + step
        if not np.isfinite(p).all() or max(abs(p[3]), abs(p[5])) > 6 or p[0] > 12:
            return None
    return None


def _through_demosaicing(filters: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Variance (k,) of filters (k, n) on a patch (h, w) of unit noise per photosite, as grey shows it."""
    import cv2

    pictures = filters.reshape(len(filters), *shape)
    smooth = [cv2.filter2D(one, cv2.CV_64F, _CORRELATION, borderType=cv2.BORDER_CONSTANT) for one in pictures]
    return np.einsum("kij,kij->k", pictures, np.array(smooth))


def _covariance_parts(fitted: _Fitted, patch: _Patch) -> np.ndarray:
    """Covariance (3, 2, 2) of the centre from the background's noise, per gain and per contrast^2, px^2."""
    weighted = fitted.jacobian * fitted.weights
    # Two rows of the inverse; the inverse times every pixel would take longer than all the rest here.
    gains = np.linalg.solve(weighted @ fitted.jacobian.T, np.eye(9)[:, 1:3]).T @ weighted
    gains = np.vstack((gains, gains.sum(axis=0)))  # var(u + v) gives the covariance
    signal = fitted.signal
    parts = []
    for filters, size in ((gains, patch.background_variance), (gains * np.sqrt(signal), 1.0), (gains * signal, 1.0)):
        u, v, both = size * _through_demosaicing(filters, patch.grey.shape)
        mixed = (both - u - v) / 2
        parts.append([[u, mixed], [mixed, v]])
    return np.array(parts)


def _skew(fitted: _Fitted, patch: _Patch) -> np.ndarray:
    """Rows (4, 4) of squared skew residual and its expectation from background, per gain and per contrast^2.

    The four third-order Hermite functions of the spot, less what the fit's own parameters take up.
    """
    z1, z2, signal = fitted.z1, fitted.z2, fitted.signal
    one, two = z1 * z1, z2 * z2
    shapes = np.stack(((one - 3) * z1, (one - 1) * z2, (two - 1) * z1, (two - 3) * z2)) * signal
    weighted = fitted.jacobian * fitted.weights
    taken = np.linalg.solve(weighted @ fitted.jacobian.T, weighted @ shapes.T)
    filters = (shapes - taken.T @ fitted.jacobian) * fitted.weights
    parts = [
        patch.background_variance * _through_demosaicing(filters, patch.grey.shape),
        _through_demosaicing(filters * np.sqrt(signal), patch.grey.shape),
        _through_demosaicing(filters * signal, patch.grey.shape),
    ]
    return np.column_stack(((filters @ fitted.residual) ** 2, *parts))


def learn_noise(skews: np.ndarray, speckle_contrast: float | None = None) -> SpotNoise:
    """Gain and contrast of one camera: posterior means of contrast and log gain on a grid.

    Means of their squares would state too much where there is no speckle: the contrast's posterior begins at 0.

    Args:
        skews: (n, 4) as `_skew` makes them, of any number of spots.
        speckle_contrast: taken as known where given.
    """
    away = np.linspace(-3, 3, 41)[:, None]
    gains = GAIN_MEDIAN_DN * np.exp(away * GAIN_SD_OF_LOG)
    # Equal steps of the root: fine near 0; each point weighs what lies around it.
    contrasts = np.linspace(0, 1, 121) ** 2 * CONTRAST_MAX
    widths = np.gradient(contrasts)
    if speckle_contrast is not None:
        contrasts, widths = np.array([speckle_contrast]), np.ones(1)
    squares = contrasts**2
    # A reflection in one spot must not widen all others.
    expected = skews[:, 1] + skews[:, 2] * GAIN_MEDIAN_DN + skews[:, 3] * np.median(squares)
    ratio = skews[:, 0] / expected
    skews = skews[ratio <= SKEW_OUTLIER * np.median(ratio) / 0.455]  # 0.455: median of a squared normal value
    logs = np.log(widths) - squares / CONTRAST_SCALE**2 / 2 - away**2 / 2
    for measured, background, per_gain, per_contrast in skews:
        variance = background + per_gain * gains + per_contrast * squares
        logs -= (np.log(variance) + measured / variance) / 2
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    gain_dn = GAIN_MEDIAN_DN * float(np.exp(GAIN_SD_OF_LOG * (weights.sum(axis=1) @ away.ravel())))
    return SpotNoise(gain_dn, float(weights.sum(axis=0) @ contrasts))


def _centre(patch: _Patch | str, noise: SpotNoise) -> Centre:
    """The fit's answer for a patch, checked."""
    if isinstance(patch, str):
        return Centre(patch)
    known = {"clipped_share": patch.clipped_share, "outline_px": patch.outline_px}
    if patch.clipped_share > CLIPPED_SHARE_MAX:
        return Centre("clipped", **known)
    fitted = _fit(patch, noise)
    if fitted is None:
        return Centre(_at_border(patch.start_px, 2 * patch.start_sd_px, patch.size) or "unfitted", **known)
    spread = np.linalg.inv(fitted.precision)
    short, long = np.sqrt(np.linalg.eigvalsh(spread))
    known["axes_px"] = (float(long), float(short))
    status = "ok"
    if 2 * pi * log(2) * long * short < AREA_MIN_PX:
        status = "too-small"
    elif (reason := _at_border(fitted.centre_px, BORDER_SDS * np.sqrt(np.diag(spread)), patch.size)) is not None:
        status = reason
    elif long > AXES_RATIO_MAX * short:
        status = "elongated"
    elif np.abs(fitted.centre_px - patch.start_px).max() > 3 * patch.start_sd_px + 2 * _SHRINK:
        status = "unfitted"
    parts, skews = _covariance_parts(fitted, patch), _skew(fitted, patch)
    return Centre(status, fitted.centre_px, None, **known, parts_px2=parts, skews=skews).under(noise)


def _at_border(centre: np.ndarray, reach: np.ndarray | float, size: tuple[int, int]) -> str | None:
    outside = (centre - reach < 0) | (centre + reach > np.array(size) - 1)
    return "border" if outside.any() else None


def find_spot(picture: np.ndarray, noise: SpotNoise | None = None) -> Centre:
    """The spot of one picture by the method `fit`.

    Args:
        picture: (height, width, 3) uint8, blue, green, red.
        noise: of the camera, as `detect` learns it; default the priors' medians.
    """
    return _centre(_patch(picture), noise or SpotNoise())


@dataclass(frozen=True)
class _Rectified:
    """One camera of the paper's pipeline: maps of the rectified picture and the way back."""

    maps: tuple[np.ndarray, np.ndarray]
    rotation: np.ndarray
    projection: np.ndarray
    matrix: np.ndarray
    distortion: np.ndarray

    def raw(self, points_px: np.ndarray) -> np.ndarray:
        """Raw pixels (n, 2) of rectified ones."""
        focal, middle = self.projection[[0, 1], [0, 1]], self.projection[:2, 2]
        rays = np.column_stack(((points_px - middle) / focal, np.ones(len(points_px)))) @ self.rotation
        return distort(rays[:, :2] / rays[:, 2:], self.distortion) @ self.matrix[:2, :2].T + self.matrix[:2, 2]


def _rectified(stereo: Stereo) -> tuple[_Rectified, _Rectified]:
    import cv2

    size = stereo.image_width, stereo.image_height
    first, second = (stereo.M1, stereo.D1.reshape(1, 5)), (stereo.M2, stereo.D2.reshape(1, 5))
    turns = cv2.stereoRectify(
        *first, *second, size, np.asarray(stereo.R, float), np.asarray(stereo.T, float).reshape(3, 1)
    )
    cameras = []
    for (matrix, distortion), rotation, projection in ((first, turns[0], turns[2]), (second, turns[1], turns[3])):
        maps = cv2.initUndistortRectifyMap(matrix, distortion, rotation, projection, size, cv2.CV_32FC1)
        cameras.append(_Rectified(maps, rotation, projection, matrix, distortion.ravel()))
    return cameras[0], cameras[1]


REGION_HALF_PX = 60
"""Half side of the paper's region of interest, around the brightest place of the rectified picture."""


def _contour(picture: np.ndarray, camera: _Rectified, noise: SpotNoise) -> Centre:
    """The paper's way: centroid of the region above a threshold on V of HSV, in the rectified picture.

    The threshold is on V alone: at 808 nm hue is undefined and saturation low. The stated variance is that of the
    region's outline, moved by noise over slope and rounded to whole pixels, for a round Gaussian spot: each of its
    2 pi r pixels on its own.
    """
    import cv2

    flat = cv2.remap(picture, *camera.maps, cv2.INTER_LINEAR)
    value = cv2.cvtColor(flat, cv2.COLOR_BGR2HSV)[..., 2]
    height, width = value.shape
    smooth = cv2.blur(value, (5, 5))
    top = np.array(np.unravel_index(int(smooth.argmax()), smooth.shape))[::-1]
    low, high = np.maximum(top - REGION_HALF_PX, 0), np.minimum(top + REGION_HALF_PX + 1, (width, height))
    region = value[low[1] : high[1], low[0] : high[0]]
    floor, peak = float(np.median(region)), float(region.max())
    spread = 1.4826 * float(np.median(np.abs(region - floor))) + 1.0
    if smooth[top[1], top[0]] - floor < 3 * spread:
        return Centre("no-spot")
    mask = (region > floor + BRIGHT_SHARE * (peak - floor)).astype(np.uint8)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outlines = sorted(outlines, key=cv2.contourArea, reverse=True)
    moments = cv2.moments(outlines[0])
    area = moments["m00"]
    if area < AREA_MIN_PX:
        return Centre("too-small")
    outline = camera.raw(outlines[0].reshape(-1, 2) + low)
    clipped = (flat[low[1] : high[1], low[0] : high[0]] >= CLIPPED_DN).any(axis=2) & (mask > 0)
    radius = sqrt(area / pi)
    sd = radius / sqrt(-2 * log(BRIGHT_SHARE))
    known = {"axes_px": (sd, sd), "clipped_share": float(clipped.sum() / mask.sum()), "outline_px": outline}
    if len(outlines) > 1 and cv2.contourArea(outlines[1]) > SECOND_SHARE * area:
        return Centre("two-spots", **known)
    if known["clipped_share"] > CLIPPED_SHARE_MAX:
        return Centre("clipped", **known)
    if area > AREA_MAX_SHARE * width * height:
        return Centre("too-large", **known)
    centre = camera.raw(np.array([[moments["m10"], moments["m01"]]]) / area + low)[0]
    if (outline < 1).any() or (outline > np.array([width, height]) - 2).any():
        return Centre("border", **known)
    signal = BRIGHT_SHARE * (peak - floor)
    background = _background_variance(picture, centre, int(3 * sd + 3))
    moved = background + noise.gain_dn * signal + (noise.speckle_contrast * signal) ** 2
    variance = (moved / (signal * radius / sd**2) ** 2 + 1 / 12) / (pi * radius)
    return Centre("ok", centre, variance * np.eye(2), **known)


def epipolar_residual(pixels: np.ndarray, stereo: Stereo) -> np.ndarray:
    """x_right^T [T]x R x_left (n,) of raw pixels (n, 4): 0 for two images of one point; mm."""
    ones = np.ones((len(pixels), 1))
    left = np.hstack((undistort(pixels[:, :2], stereo.M1, stereo.D1), ones))
    right = np.hstack((undistort(pixels[:, 2:], stereo.M2, stereo.D2), ones))
    return np.sum(right * np.cross(np.asarray(stereo.T, float).ravel(), left @ np.asarray(stereo.R, float).T), axis=1)


def epipolar_refused(pixels: np.ndarray, covariances: np.ndarray, stereo: Stereo) -> np.ndarray:
    """Which pairs (n,) cannot be images of one point, for all that spots and calibration leave open.

    Args:
        pixels: (n, 4) u_left, v_left, u_right, v_right.
        covariances: (n, 4, 4) of them, px^2.
        stereo: the calibration; its covariance enters by central differences.
    """
    if not len(pixels):
        return np.zeros(0, bool)
    residual = epipolar_residual(pixels, stereo)
    step_px = 1e-2  # truncation 1e-9 of the slope, rounding and undistortion 1e-7
    steps = step_px * np.eye(4)
    slope = [epipolar_residual(pixels + h, stereo) - epipolar_residual(pixels - h, stereo) for h in steps]
    slope = np.stack(slope, axis=1) / (2 * step_px)
    variance = np.einsum("ni,nij,nj->n", slope, covariances, slope)
    vector, covariance = stereo.vector, np.asarray(stereo.parameter_covariance, float)
    sds = np.sqrt(np.diag(covariance))
    free = np.flatnonzero(sds > 0)
    if len(free):
        moved = []
        for row in free:
            step = np.zeros(24)
            step[row] = 0.1 * sds[row]
            ends = (epipolar_residual(pixels, stereo.with_vector(vector + sign * step)) for sign in (1, -1))
            moved.append((next(ends) - next(ends)) / (2 * step[row]))
        moved = np.array(moved)
        variance = variance + np.einsum("in,ij,jn->n", moved, covariance[np.ix_(free, free)], moved)
    distance = np.abs(residual) / np.linalg.norm(slope, axis=1)
    allowed = EPIPOLAR_SIGMAS * np.sqrt(variance) / np.linalg.norm(slope, axis=1)
    # Beyond where the lens model turns back nothing can be undistorted: NaN is refused too.
    return ~(distance <= np.maximum(allowed, EPIPOLAR_FLOOR_PX))


@dataclass(frozen=True)
class Detection:
    """What `detect` found.

    Attributes:
        campaign: the campaign with its new spots, rows as before.
        method: "fit" or "contour".
        processed: rows whose two frames were read.
        missing: rows without frames; they stay as they were.
        kept: rows refused by somebody else (a status that is none of `REASONS`); they stay as well.
        statuses: number of processed rows by status.
        noise: what spots of the left and of the right camera were weighted with.
        median_sd_px: median stated sd of the ok coordinates; None without any.
    """

    campaign: Campaign
    method: str
    processed: int
    missing: int
    kept: int
    statuses: dict[str, int]
    noise: dict[str, SpotNoise]
    median_sd_px: float | None

    def as_json(self) -> dict[str, object]:
        """The document of `tvsbayes detect --json`."""
        refused = {status: count for status, count in self.statuses.items() if status != "ok"}
        noise = {
            side: {"gain_dn": one.gain_dn, "speckle_contrast": one.speckle_contrast} for side, one in self.noise.items()
        }
        return {
            "method": self.method,
            "spots": len(self.campaign.spots),
            "ok": self.statuses.get("ok", 0),
            "refused": refused,
            "missing": self.missing,
            "kept": self.kept,
            "median_sd_px": self.median_sd_px,
            "noise": noise,
        }


def pair_status(left: Centre, right: Centre) -> str:
    """The word "ok", or the reasons of both cameras with their sides, as `spots.csv` holds them."""
    bad = [(c.status, side) for c, side in zip((left, right), SIDES, strict=True) if c.status != "ok"]
    if len(bad) == 2 and bad[0][0] == bad[1][0]:
        return f"{bad[0][0]} both"
    return ", ".join(f"{reason} {side}" for reason, side in bad) or "ok"


def _row(spot: Spot, left: Centre, right: Centre) -> Spot:
    """A row with what was found; pixels stay empty where a camera refused."""
    values: dict[str, float | None] = {}
    status = pair_status(left, right)
    for side, one in zip(SIDES, (left, right), strict=True):
        good = status == "ok"
        sds = np.sqrt(np.diag(one.covariance_px2)) if good else (None, None)
        for number, coordinate in enumerate("uv"):
            values[f"{coordinate}_{side}_px"] = round(float(one.centre_px[number]), 6) if good else None
            # The format's smallest sd; no spot is known that well.
            values[f"s{coordinate}_{side}_px"] = max(round(float(sds[number]), 7), 1e-4) if good else None
        values[f"ruv_{side}"] = round(float(one.covariance_px2[0, 1] / sds[0] / sds[1]), 6) if good else 0.0
    return replace(spot, **values, status=status)


@dataclass(frozen=True)
class _Frames:
    """Reads the frames of a campaign: names are fixed by the format, links out of the folder are refused."""

    folder: Path
    size: tuple[int, int]

    def path(self, spot: Spot, side: str) -> Path:
        return self.folder / "frames" / f"{spot.spot:06d}_{side}.png"

    def there(self, spot: Spot) -> bool:
        return all(os.path.lexists(self.path(spot, side)) for side in SIDES)

    def read(self, spot: Spot, side: str) -> np.ndarray:
        path = self.path(spot, side)
        # Its size before it is decoded: a small file can hold 50 million pixels, on every thread.
        data = read_bytes(path, IMAGE_BYTES_MAX, self.folder)
        size = image_size(data, escaped(path.name))
        if size != self.size:
            raise refusal(
                "image-size",
                file=path.name,
                found=f"{size[0]} x {size[1]} pixels",
                allowed=f"{self.size[0]} x {self.size[1]} as in stereo.json",
                remedy="calibrate and observe at one image size",
            )
        return decode_image(data, escaped(path.name))


def _parallel(job: Callable, items: Sequence, workers: int) -> Iterator:
    """Results in order. Decoding and OpenCV leave Python's lock, so threads do; Ctrl-C drops what has not begun."""
    pool = ThreadPoolExecutor(workers)
    try:
        yield from pool.map(job, items)
    finally:
        pool.shutdown(cancel_futures=True)


def detect(
    campaign: Campaign,
    method: str = "fit",
    *,
    speckle_contrast: float | None = None,
    workers: int | None = None,
    overlay: Path | None = None,
    done: Callable[[int, int], None] | None = None,
) -> Detection:
    """Find the spots in the frames of a campaign folder; nothing is written but overlay pictures.

    Args:
        campaign: read from a folder.
        method: "fit" or "contour".
        speckle_contrast: contrast per independent pixel, taken as known; by default `fit` learns it from the
            looks of each camera and `contour` takes 0.4.
        workers: threads; default one per core.
        overlay: folder for one picture per look: outline of the bright area and centre.
        done: called with the number of looks finished and their total.

    Raises:
        InputError: a frame that cannot be read safely, has another size, or a campaign without folder.
        NothingToEstimate: no row has both frames.
    """
    if method not in METHODS:
        remedy = "choose one of them"
        raise InputError("method", f"no method {method!r}", found=method, allowed=", ".join(METHODS), remedy=remedy)
    if campaign.path is None:
        raise InputError("path", "a campaign that was not read from a folder has no frames")
    stereo = campaign.stereo
    frames = _Frames(Path(campaign.path), (stereo.image_width, stereo.image_height))
    rows = [row for row, spot in enumerate(campaign.spots) if _ours(spot.status)]
    present = [row for row in rows if frames.there(campaign.spots[row])]
    if not present:
        raise NothingToEstimate(
            "no-frames",
            f"frames/ holds pictures of none of the {len(campaign.spots)} rows of spots.csv",
            allowed="frames/000012_left.png and frames/000012_right.png for spot 12",
            remedy="put the pictures there, or write centroids into spots.csv yourself",
        )
    workers = workers or os.cpu_count() or 1
    noise = {side: SpotNoise(speckle_contrast=_contrast(speckle_contrast)) for side in SIDES}
    kept: dict[int, tuple[_Patch | str, _Patch | str]] = {}
    if method == "fit":
        kept = _pilots(campaign.spots, present, frames, workers)
        for number, side in enumerate(SIDES):
            found = [pair[number] for pair in kept.values() if not isinstance(pair[number], str)]
            noise[side] = _learned([one for one in found if one.clipped_share <= CLIPPED_SHARE_MAX], speckle_contrast)
    maps = _rectified(stereo) if method == "contour" else (None, None)
    if overlay is not None:
        make_folder(overlay)

    def look(row: int) -> tuple[Centre, Centre]:
        spot = campaign.spots[row]
        if row in kept and overlay is None:
            first, second = (_centre(patch, noise[side]) for side, patch in zip(SIDES, kept[row], strict=True))
            return first, second
        found, pictures = [], []
        for side, camera in zip(SIDES, maps, strict=True):
            picture = frames.read(spot, side)
            found.append(
                _centre(_patch(picture), noise[side]) if camera is None else _contour(picture, camera, noise[side])
            )
            if overlay is not None:
                pictures.append(_overlay(picture, found[-1]))
        if overlay is not None:
            write_atomically(overlay / f"{spot.spot:06d}.png", png_bytes(np.hstack(pictures)))
        return found[0], found[1]

    pairs = []
    for pair in _parallel(look, present, workers):
        pairs.append(pair)
        if done is not None:
            done(len(pairs), len(present))
    if method == "fit":
        for number, side in enumerate(SIDES):
            skews = [pair[number].skews for pair in pairs if pair[number].status in ("ok", "misshapen")]
            if skews:
                table = np.vstack(skews)
                noise[side] = learn_noise(table[:: -(-len(table) // SKEWS_MAX)], speckle_contrast)
    seen = [(left.under(noise["left"]), right.under(noise["right"])) for left, right in pairs]
    spots = _rows(campaign.spots, present, seen, stereo)
    after = [spots[row] for row in present]
    stated = [s.su_left_px for s in after if s.status == "ok"] + [s.su_right_px for s in after if s.status == "ok"]
    return Detection(
        campaign=replace(campaign, spots=tuple(spots)),
        method=method,
        processed=len(present),
        missing=len(rows) - len(present),
        kept=len(campaign.spots) - len(rows),
        statuses=dict(Counter(spot.status for spot in after).most_common()),
        noise=noise,
        median_sd_px=float(np.median(stated)) if stated else None,
    )


def _pilots(
    spots: Sequence[Spot], present: Sequence[int], frames: _Frames, workers: int
) -> dict[int, tuple[_Patch | str, _Patch | str]]:
    """Left and right patch, or why there is none, of looks spread evenly over the campaign, by row of spots.csv."""
    rows = [present[k] for k in np.unique(np.linspace(0, len(present) - 1, PILOTS_MAX).astype(int))]

    def patches(row: int) -> tuple[_Patch | str, _Patch | str]:
        return _patch(frames.read(spots[row], "left")), _patch(frames.read(spots[row], "right"))

    return dict(zip(rows, _parallel(patches, rows, workers), strict=True))


def _rows(
    spots: Sequence[Spot], present: Sequence[int], seen: Sequence[tuple[Centre, Centre]], stereo: Stereo
) -> list[Spot]:
    """All rows of spots.csv, those in `present` with what was seen (left, right); off their epipolar line: refused."""
    spots, good = list(spots), []
    for row, (left, right) in zip(present, seen, strict=True):
        spots[row] = _row(spots[row], left, right)
        if spots[row].status == "ok":
            good.append((row, left, right))
    pixels, covariances = np.zeros((len(good), 4)), np.zeros((len(good), 4, 4))
    for place, (_, left, right) in enumerate(good):
        pixels[place] = *left.centre_px, *right.centre_px
        covariances[place, :2, :2], covariances[place, 2:, 2:] = left.covariance_px2, right.covariance_px2
    for place in np.flatnonzero(epipolar_refused(pixels, covariances, stereo)):
        row = good[place][0]
        spots[row] = replace(spots[row], status="epipolar")
    return spots


def _ours(status: str) -> bool:
    """Whether a row may be detected (again): a refusal by a person stands."""
    return status in ("ok", "undetected") or status.split(" ")[0] in REASONS


def _contrast(given: float | None) -> float:
    return CONTRAST_DEFAULT if given is None else given


def _learned(patches: Sequence[_Patch], speckle_contrast: float | None) -> SpotNoise:
    """The noise of one camera from some of its spots: weights follow what is learned, so a few rounds."""
    noise = SpotNoise(speckle_contrast=_contrast(speckle_contrast))
    for _ in range(LEARNING_ROUNDS):
        fits = [(fitted, patch) for patch in patches if (fitted := _fit(patch, noise)) is not None]
        if not fits:
            return noise
        noise = learn_noise(np.vstack([_skew(*pair) for pair in fits]), speckle_contrast)
    return noise


OVERLAY_HALF_PX, OVERLAY_ZOOM = 32, 8
"""Half the side of the square that an overlay shows, and how many of its pixels show one."""


def _overlay(picture: np.ndarray, centre: Centre) -> np.ndarray:
    """The surroundings of a spot enlarged: outline green, centre red, the reason of a refusal in words (Figure 9)."""
    import cv2

    half, zoom = OVERLAY_HALF_PX, OVERLAY_ZOOM
    height, width = picture.shape[:2]
    middle = centre.centre_px
    if middle is None:
        known = centre.outline_px is not None and len(centre.outline_px)
        middle = centre.outline_px.mean(axis=0) if known else np.array([width, height]) / 2
    low = np.clip(np.round(middle).astype(int) - half, 0, np.maximum((width, height) - np.array(2 * half), 0))
    crop = picture[low[1] : low[1] + 2 * half, low[0] : low[0] + 2 * half]
    crop = cv2.copyMakeBorder(crop, 0, 2 * half - crop.shape[0], 0, 2 * half - crop.shape[1], cv2.BORDER_CONSTANT)
    large = cv2.resize(crop, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST)
    if centre.outline_px is not None and len(centre.outline_px):
        outline = np.round((centre.outline_px - low + 0.5) * zoom).astype(np.int32)
        cv2.polylines(large, [outline.reshape(-1, 1, 2)], True, (0, 255, 0), 1, cv2.LINE_AA)
    if centre.centre_px is not None:
        dot = np.round((centre.centre_px - low + 0.5) * zoom).astype(int)
        cv2.circle(large, tuple(map(int, dot)), zoom // 2, (0, 0, 255), -1, cv2.LINE_AA)
    if centre.status != "ok":
        cv2.putText(
            large, centre.status, (zoom, 3 * zoom), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (0, 255, 255), 1, cv2.LINE_AA
        )
    return large
