"""The centre of one camera's spot with its covariance, or the reason for a refusal; and the noise of its pixels.

An elliptic Gaussian on a sloping background is fitted to the pixels around the spot by iterated weighted least squares.
Pixels next to a clipped one are left out: a clipped core is normal, but reduces the information and so widens the
standard uncertainty. Grey is (B + 2 G + R) / 4, with equal weights for all photosites of a Bayer sensor; 808 nm passes
all three dyes, so hue has no information. The variance of a pixel with signal S is background + gain * S
+ (contrast * S)^2: noise outside the spot, shot noise, speckle.

Raw image px with the integer at the centre of a pixel; DN = grey levels of 8 bits; pictures (height, width, 3), blue,
green, red, uint8, or float32 DN for deeper pictures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import log, pi, sqrt

import numpy as np

from tvsbayes.cameras.alternate_lines import AlternateLines, shift_of_lines, widening
from tvsbayes.cameras.spot_noise import PixelNoise, SpotNoise, pixel_noise, through_demosaicing
from tvsbayes.cameras.spot_window import CLIPPED_DN, CLIPPED_SHARE_MAX, SHRINK, Patch, patch_around
from tvsbayes.files.images import in_grey_levels
from tvsbayes.instrument.stereo_pair import scaled_px

AREA_MIN_PX = 4.0
"""Least area at half height, px^2: a hot pixel after demosaicing has 2."""
AXES_RATIO_MAX = 4.0
"""Largest ratio of the spot's axes; a sheet at 70 degrees to the beam gives 2.9."""
BORDER_SDS = 3.0
"""Least distance of a centre from the border, in sds of the spot: a spot cut off there is biased."""
SKEW_LIMIT = 80.0
"""Largest sum of a spot's four standardised squared skew residuals (normal: one in 10^15; speckle has longer tails)."""
NOISE_REACH = 3.5
"""Half width of the area that determines the noise of a wide spot, in sds of the spot."""
SKEW_SHAPE_MAX = 0.15
"""Largest skew amplitude of a spot without others to compare with: half a Gaussian has 0.17, the worst of nine real
beams 0.13."""
SPECKLE_CONTRAST_MIN = 0.1
"""Contrast from which speckle exceeds shot noise, so that weights by the noise model are better than equal weights."""
WIDE_FLOOR_SHARE = 0.02
"""Share of the height that replaces the background in the weights of wide spots, whose noise is mostly shot noise."""
REACH, REACH_PX = 4.0, 9.0
"""Distance at which the weights of pixels fade to 0, in sds of the spot plus px. No real beam is Gaussian in its wings,
and with a sharp edge the centre would depend on the pixels that happen to be inside."""


@dataclass(frozen=True)
class Located:
    """Centre (2,) u, v of a spot, px, and its covariance (2, 2), px^2."""

    centre_px: np.ndarray
    covariance_px2: np.ndarray


@dataclass(frozen=True)
class Centre:
    """One camera's spot, or the reason for a refusal.

    Attributes:
        status: "ok" or a key of `REASONS`.
        centre_px: (2,) u, v, also where it was refused after the fit; None without a fit.
        covariance_px2: (2, 2) of the centre, likewise.
        axes_px: sds of the spot's image along its long and short axis.
        clipped_share: clipped area over bright area.
        outline_px: (n, 2) outline of the bright area, for pictures; may be empty.
        parts_px2: (3, 2, 2) covariance from the background's noise, per gain and per contrast^2 (`fit`).
        skews: (4, 4) as returned by `skewness` (`fit`).
        lines_px: (2, 2) as returned by `shift_of_lines` (`fit`).
    """

    status: str
    centre_px: np.ndarray | None = None
    covariance_px2: np.ndarray | None = None
    axes_px: tuple[float, float] = (0.0, 0.0)
    clipped_share: float = 0.0
    outline_px: np.ndarray | None = None
    parts_px2: np.ndarray | None = None
    skews: np.ndarray | None = None
    lines_px: np.ndarray | None = None

    @property
    def located(self) -> Located:
        """Centre and covariance of an accepted spot."""
        assert self.centre_px is not None and self.covariance_px2 is not None, self.status
        return Located(self.centre_px, self.covariance_px2)

    def scaled(self, size: tuple[int, int], to: tuple[int, int]) -> Centre:
        """The same centre in pixels of pictures of another size."""
        if size == to or self.centre_px is None or self.covariance_px2 is None:
            return self
        covariance = self.covariance_px2 * (to[0] / size[0]) ** 2
        return replace(self, centre_px=scaled_px(self.centre_px, size, to), covariance_px2=covariance)

    def under(self, noise: SpotNoise) -> Centre:
        """The same centre with its covariance under this noise; refused as misshapen where its skew exceeds noise."""
        if self.parts_px2 is None or self.skews is None:
            return self
        units = np.array([1.0, noise.gain_dn, noise.speckle_contrast**2])
        covariance = np.einsum("k,kij->ij", units, self.parts_px2)
        skewed = float(np.sum((self.skews[:, 0] - noise.skew) ** 2 / (self.skews[:, 1:] @ units))) > SKEW_LIMIT
        status = self.status
        if status in ("ok", "misshapen"):
            status = "misshapen" if skewed else "ok"
        return replace(self, covariance_px2=covariance, status=status)


@dataclass(frozen=True)
class _Fit:
    """A converged fit: centre (2,), precision (2, 2), height, and the terms of its covariance.

    For the n pixels of the patch: signal, its derivatives (9, n), weights (0 for unusable ones), residuals and the
    coordinates in sds of the spot.
    """

    centre_px: np.ndarray
    precision: np.ndarray
    height_dn: float
    signal: np.ndarray
    jacobian: np.ndarray
    weights: np.ndarray
    residual: np.ndarray
    z1: np.ndarray
    z2: np.ndarray


@dataclass(frozen=True)
class _Model:
    """The model of a spot at trial parameters: factor (a, b; 0, c) of its precision, and the signal of the pixels."""

    a: float
    b: float
    c: float
    z1: np.ndarray
    z2: np.ndarray
    signal: np.ndarray


@dataclass(frozen=True)
class _Pixels:
    """A patch for the fit: coordinates, data (n,), mask of usable pixels, and the derivatives (9, n) to be filled.

    The last three derivatives, by the background's level and slopes, are constant.
    """

    u: np.ndarray
    v: np.ndarray
    data: np.ndarray
    usable: np.ndarray
    jacobian: np.ndarray

    @classmethod
    def of(cls, patch: Patch) -> _Pixels:
        v, u = (axis.ravel() * patch.block + (patch.block - 1) / 2 for axis in np.indices(patch.grey.shape))
        middle_u, middle_v = (patch.block * np.array(patch.grey.shape[::-1]) - 1) / 2
        jacobian = np.empty((9, patch.grey.size))
        jacobian[6], jacobian[7], jacobian[8] = 1.0, (u - middle_u) / (middle_u + 1), (v - middle_v) / (middle_v + 1)
        return cls(u, v, patch.grey.ravel().astype(float), patch.usable.ravel(), jacobian)

    def model(self, p: np.ndarray) -> _Model:
        """The model at parameters p (9,); stores its derivatives in `jacobian`."""
        a, b, c = np.exp(p[3]), p[4], np.exp(p[5])
        x, y, jacobian = self.u - p[1], self.v - p[2], self.jacobian
        z1, z2 = a * x + b * y, c * y
        signal = np.exp(p[0] - (z1 * z1 + z2 * z2) / 2)
        along = signal * z1
        down = signal * z2
        np.multiply(along, a, out=jacobian[1])
        np.multiply(along, b, out=jacobian[2])
        jacobian[2] += down * c
        jacobian[0] = signal
        np.multiply(along, -a * x, out=jacobian[3])
        np.multiply(along, -y, out=jacobian[4])
        np.multiply(down, -c * y, out=jacobian[5])
        return _Model(a, b, c, z1, z2, signal)


def fit_spot(patch: Patch, noise: SpotNoise) -> _Fit | None:
    """Fit an elliptic Gaussian on a plane by weighted Gauss-Newton steps; None where they do not converge.

    Parameters: log height, centre, lower triangle of the precision's Cholesky factor with logs on its diagonal,
    level and slopes of the background. A library's general solver would take longer than decoding the picture.
    """
    if patch.usable.sum() < 25:
        return None
    pixels = _Pixels.of(patch)
    jacobian, usable = pixels.jacobian, pixels.usable
    edge = float(np.median(np.concatenate((patch.grey[0], patch.grey[-1]))))
    centre = patch.start_px - np.array(patch.corner)
    tight = -log(patch.start_sd_px)
    p = np.array([log(max(float(patch.grey.max()) - edge, 1.0)), *centre, tight, 0.0, tight, edge, 0.0, 0.0])
    limits = np.array([0.7, 0, 0, 0.4, 0.4, 0.4, np.inf, np.inf, np.inf])
    settled = 0
    for iteration in range(60):
        model = pixels.model(p)
        signal = model.signal
        residual = pixels.data - signal - p[6:] @ jacobian[6:]
        # Far from the solution the model's weights are wrong: equal weights come first.
        if patch.wide and noise.speckle_contrast < SPECKLE_CONTRAST_MIN:
            # Real beams are not exactly Gaussian; for a wide spot the centre must therefore not depend on the noise.
            variance = signal + WIDE_FLOOR_SHARE * np.exp(p[0]) if settled else 1.0
        else:
            variance = patch.background_variance + (
                signal * (noise.gain_dn + noise.speckle_contrast**2 * signal) if settled else 0.0
            )
        weights = usable / variance
        if settled:
            reach = REACH + REACH_PX * sqrt(model.a * model.c)
            ratio = (model.z1**2 + model.z2**2) / reach
            weights /= 1 + np.exp(np.minimum(ratio - reach, 50.0))
        weighted = jacobian * weights
        normal = weighted @ jacobian.T
        scale = np.sqrt(normal.diagonal()) + 1e-30
        normal /= scale[:, None] * scale
        normal.flat[::10] += 1e-12 if settled else 1e-3
        try:
            step = np.linalg.solve(normal, weighted @ residual / scale)
        except np.linalg.LinAlgError:
            return None
        step /= scale
        limits[1] = limits[2] = 1 / min(model.a, model.c)
        limits[4] = 0.4 * model.c
        step *= min(1.0, float((limits / np.maximum(np.abs(step), 1e-300)).min()))
        move, change = np.abs(step[1:3]).max() * max(model.a, model.c), np.abs(step[[0, 3, 5]]).max()
        # Limits in sds of the spot; the error after the last step is ten times smaller.
        if settled > 1 and move < 5e-4 / patch.block and change < 5e-3 / patch.block:
            factor = np.array([[model.a, 0.0], [model.b, model.c]])
            centre = p[1:3] + step[1:3] + np.array(patch.corner)
            height = float(np.exp(p[0]))
            return _Fit(centre, factor @ factor.T, height, signal, jacobian, weights, residual, model.z1, model.z2)
        settled += bool(settled or (move < 0.05 and change < 0.1) or iteration > 12)
        p = p + step
        if not np.isfinite(p).all() or max(abs(p[3]), abs(p[5])) > 6 or p[0] > 12:
            return None
    return None


def _covariance_parts(fitted: _Fit, patch: Patch) -> np.ndarray:
    """Covariance (3, 2, 2) of the centre from the background's noise, per gain and per contrast^2, px^2."""
    weighted = fitted.jacobian * fitted.weights
    # Only two rows of the inverse: the full inverse times all pixels would take longer than the rest of this function.
    gains = np.linalg.solve(weighted @ fitted.jacobian.T, np.eye(9)[:, 1:3]).T @ weighted
    # The variance of u + v gives the covariance.
    u, v, sums = _noise_parts(np.vstack((gains, gains.sum(axis=0))), fitted.signal, patch).T
    covariance = (sums - u - v) / 2
    return np.array([[u, covariance], [covariance, v]]).transpose(2, 0, 1)


def _noise_parts(filters: np.ndarray, signal: np.ndarray, patch: Patch) -> np.ndarray:
    """Variance (3, k) of filters (k, n) on a patch: from the background's noise, per gain and per contrast^2."""
    by_source = (filters, filters * np.sqrt(signal), filters * signal)
    background, *scaled = (through_demosaicing(part, patch.grey.shape, patch.block) for part in by_source)
    return np.array([patch.background_variance * background, *scaled])


def skewness(fitted: _Fit, patch: Patch) -> np.ndarray:
    """Rows (4, 4): amplitude of a skew shape in the spot, and its variance from background, per gain, per contrast^2.

    The shapes are the four third-order Hermite functions of the spot, minus their projection on the fit's parameters;
    the unit is the height of the spot.
    """
    z1, z2, signal = fitted.z1, fitted.z2, fitted.signal
    z11, z22 = z1 * z1, z2 * z2
    shapes = np.stack(((z11 - 3) * z1, (z11 - 1) * z2, (z22 - 1) * z1, (z22 - 3) * z2)) * signal
    weighted = fitted.jacobian * fitted.weights
    absorbed = np.linalg.solve(weighted @ fitted.jacobian.T, weighted @ shapes.T)
    filters = (shapes - absorbed.T @ fitted.jacobian) * fitted.weights
    filters /= np.maximum(np.einsum("kn,kn->k", filters, shapes), 1e-300)[:, None]
    return np.column_stack((filters @ fitted.residual, *_noise_parts(filters, signal, patch)))


def measured_noise(patch: Patch) -> PixelNoise:
    """The noise of a wide patch's own pixels; its skew up to `SKEW_SHAPE_MAX` counts as the beam's shape."""
    # The weights of a wide spot without speckle do not depend on the noise.
    fitted = fit_spot(patch, SpotNoise(speckle_contrast=0.0))
    if fitted is None:
        return PixelNoise(SpotNoise(), patch.background_variance)
    height, width = patch.raw.shape
    low = np.maximum(np.floor(fitted.centre_px - patch.corner - NOISE_REACH * patch.start_sd_px), 0).astype(int)
    high = np.minimum(low + int(2 * NOISE_REACH * patch.start_sd_px) + 1, (width, height))
    raw = patch.raw[low[1] : high[1], low[0] : high[0]]
    x = np.arange(low[0], high[0], dtype=np.float32) - np.float32(fitted.centre_px[0] - patch.corner[0])
    y = np.arange(low[1], high[1], dtype=np.float32)[:, None] - np.float32(fitted.centre_px[1] - patch.corner[1])
    (p, q), (_, r) = fitted.precision.astype(np.float32)
    signal = np.float32(fitted.height_dn) * np.exp(-(p * x * x + 2 * q * x * y + r * y * y) / 2)
    pixels = pixel_noise(raw - signal, signal, raw < CLIPPED_DN, patch.background_variance, patch.mono)
    skew = skewness(fitted, replace(patch, background_variance=pixels.background_dn2))[:, 0]
    shape = tuple(np.clip(skew, -SKEW_SHAPE_MAX, SKEW_SHAPE_MAX).tolist())
    return replace(pixels, noise=replace(pixels.noise, skew=shape))


def centre_of(patch: Patch | str, noise: SpotNoise) -> Centre:
    """Fit a patch and check the result."""
    if isinstance(patch, str):
        return Centre(patch)
    result = partial(Centre, clipped_share=patch.clipped_share, outline_px=patch.outline_px)
    if patch.clipped_share > CLIPPED_SHARE_MAX:
        return result("clipped")
    fitted = fit_spot(patch, noise)
    if fitted is None:
        return result(_at_border(patch.start_px, 2 * patch.start_sd_px, patch.size) or "unfitted")
    shape = np.linalg.inv(fitted.precision)
    short, long = np.sqrt(np.linalg.eigvalsh(shape))
    status = "ok"
    if 2 * pi * log(2) * long * short < AREA_MIN_PX:
        status = "too-small"
    elif (reason := _at_border(fitted.centre_px, BORDER_SDS * np.sqrt(np.diag(shape)), patch.size)) is not None:
        status = reason
    elif long > AXES_RATIO_MAX * short:
        status = "elongated"
    elif np.abs(fitted.centre_px - patch.start_px).max() > 3 * patch.start_sd_px + 2 * SHRINK:
        status = "unfitted"
    parts, skews = _covariance_parts(fitted, patch), skewness(fitted, patch)
    lines = shift_of_lines(patch, fitted.jacobian, fitted.weights, fitted.residual)
    axes = float(long), float(short)
    return result(status, fitted.centre_px, axes_px=axes, parts_px2=parts, skews=skews, lines_px=lines).under(noise)


@dataclass(frozen=True)
class WidenedCentres:
    """The centres of one camera, with larger covariance where alternate lines disagree, and these lines."""

    centres: tuple[Centre, ...]
    lines: tuple[AlternateLines, ...]


def widened(centres: Sequence[Centre]) -> WidenedCentres:
    """Centres of one camera under its noise, with the variance from the disagreement of alternate lines."""
    usable = [k for k, centre in enumerate(centres) if centre.status == "ok" and centre.lines_px is not None]
    shifts = [lines for k in usable if (lines := centres[k].lines_px) is not None]
    added_noise = widening(shifts, [centres[k].located.covariance_px2 for k in usable])
    result = list(centres)
    for k, added in zip(usable, added_noise.added_px2, strict=True):
        result[k] = replace(result[k], covariance_px2=result[k].located.covariance_px2 + added)
    return WidenedCentres(tuple(result), added_noise.lines)


def _at_border(centre: np.ndarray, margin: np.ndarray | float, size: tuple[int, int]) -> str | None:
    outside = (centre - margin < 0) | (centre + margin > np.array(size) - 1)
    return "border" if outside.any() else None


def find_spot(picture: np.ndarray, noise: SpotNoise | None = None, white: int | None = None) -> Centre:
    """Find the spot of one picture by the method `fit`.

    Args:
        picture: (height, width, 3), blue, green, red, uint8 or uint16.
        noise: noise of the camera, as `detect` estimates it from many looks; by default from the pixels of a wide spot,
            without speckle whose grain exceeds a few pixels, or for a narrow spot the medians of the priors.
        white: full scale of a camera with more than 8 bits; by default from the picture.
    """
    patch = patch_around(in_grey_levels(picture, white))
    if noise is None and not isinstance(patch, str) and patch.wide and patch.clipped_share <= CLIPPED_SHARE_MAX:
        measured = measured_noise(patch)
        patch, noise = replace(patch, background_variance=measured.background_dn2), measured.noise
    return widened([centre_of(patch, noise or SpotNoise())]).centres[0]
