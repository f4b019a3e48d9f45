"""Centre of a spot with covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import log, pi, sqrt

import numpy as np

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
GAIN_MEDIAN_DN, GAIN_SD_OF_LOG = 0.05, 1.0
"""Prior of the shot-noise gain, log-normal, DN per DN of signal: 255 DN at 5000 electrons, within a factor of e."""
CONTRAST_DEFAULT = 0.4
"""Speckle contrast where no campaign tells it: the middle of what averaging leaves, 0.3 to 0.63 (research note on
vision, section 4)."""
CONTRAST_SCALE, CONTRAST_MAX = 0.5, 2.0
"""Prior of the learned contrast: half-normal of this scale, up to here. Speckle may be absent; fully developed it has
1, and its grain in px multiplies that."""
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
class Patch:
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


def patch_around(picture: np.ndarray) -> Patch | str:
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
    return Patch(
        grey=grey,
        usable=usable,
        corner=(int(left), int(top)),
        start_px=start,
        start_sd_px=max(sd, 1.0),
        background_variance=background_variance(picture, start, half),
        clipped_share=float(clipped.sum()) / max(1.0, float(bright.sum())),
        outline_px=outline + np.array([left, top]),
        size=(width, height),
    )


def background_variance(picture: np.ndarray, centre: np.ndarray, half: int) -> float:
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


def fit_spot(patch: Patch, noise: SpotNoise) -> _Fitted | None:
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


def _covariance_parts(fitted: _Fitted, patch: Patch) -> np.ndarray:
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


def skewness(fitted: _Fitted, patch: Patch) -> np.ndarray:
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
        skews: (n, 4) as `skewness` makes them, of any number of spots.
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


def centre_of(patch: Patch | str, noise: SpotNoise) -> Centre:
    """The fit's answer for a patch, checked."""
    if isinstance(patch, str):
        return Centre(patch)
    known = {"clipped_share": patch.clipped_share, "outline_px": patch.outline_px}
    if patch.clipped_share > CLIPPED_SHARE_MAX:
        return Centre("clipped", **known)
    fitted = fit_spot(patch, noise)
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
    parts, skews = _covariance_parts(fitted, patch), skewness(fitted, patch)
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
    return centre_of(patch_around(picture), noise or SpotNoise())
