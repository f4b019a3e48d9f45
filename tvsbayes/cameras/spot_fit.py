"""The centre of one camera's spot with its covariance, or the reason for a refusal; and the noise of its pixels.

An elliptic Gaussian on a sloping background is fitted to the pixels around the spot by iterated weighted least squares.
Pixels next to a clipped one are left out: a clipped core is normal, but reduces the information and so widens the
standard uncertainty. Grey is (B + 2 G + R) / 4, with equal weights for all photosites of a Bayer sensor; 808 nm passes
all three dyes, so hue has no information. The variance of a pixel with signal S is background + gain * S
+ (contrast * S)^2: noise outside the spot, shot noise, speckle. To first order centre, skewness and the difference of
alternate lines are linear in the pixels (`SpotFit.gains`); the noise of the pixels gives their uncertainties.

Interlaced and two-tap readouts take even and odd lines at another moment or with another gain. A constant gain moves no
centre: it changes only the height of each half. A beam that moved in between, or a gain that changes along the spot,
moves a centre; on a Gaussian both look the same. For white pixel noise the difference of the halves' centres has four
times the covariance C of the whole's (each half has 2 C). Where a difference d is significant, all positions between
both are equally probable: d d'/12 is added to C (JCGM 100:2008, 4.3.7: limits d apart, uniform). Demosaicing mixes
lines: colour pictures show about a quarter of d, and less noise, so that a larger d is needed.

Raw image px with the integer at the centre of a pixel; DN = grey levels of 8 bits; pictures (height, width, 3), blue,
green, red, uint8, or float32 DN for deeper pictures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import log, pi, sqrt

import numpy as np

from tvsbayes.cameras.spot_noise import SpotNoise, pixel_noise, through_demosaicing
from tvsbayes.cameras.spot_window import CLIPPED_DN, CLIPPED_SHARE_MAX, SHRINK, Patch, block_means, patch_around
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
LINES = ("rows", "columns")
LINES_SIGNIFICANCE = 1e-5
"""Significance level of a difference of alternate lines, for one spot or for all spots of a camera together. A campaign
of 1000 looks makes 4000 such tests."""
LINES_EXCESS_MIN = 4.0
"""Least mean of chi-square per coordinate over a camera's spots: stated noise may be wrong by some tens of per cent."""
_HIGH_PASS = np.array([-0.25, 0.5, -0.25], np.float32)
"""Gain 1 for values that alternate from line to line, 0 for values that are linear over three lines."""


@dataclass(frozen=True)
class AlternateLines:
    """A difference between even and odd lines in the centres of a camera's spots.

    Attributes:
        lines: "rows" or "columns".
        spots: number of spots with an increased covariance.
        apart_px: median distance of the two centres over these spots.
    """

    lines: str
    spots: int
    apart_px: float


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
        lines_px: (2, 2) centre of the odd minus that of the even rows, then of columns (`fit`).
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
    def located(self) -> tuple[np.ndarray, np.ndarray]:
        """Centre and covariance of an accepted spot."""
        assert self.centre_px is not None and self.covariance_px2 is not None, self.status
        return self.centre_px, self.covariance_px2

    def scaled(self, size: tuple[int, int], to: tuple[int, int]) -> Centre:
        """The same centre in pixels of pictures of another size."""
        if size == to or self.centre_px is None:
            return self
        centre, covariance = self.located
        return replace(self, centre_px=scaled_px(centre, size, to), covariance_px2=covariance * (to[0] / size[0]) ** 2)

    def under(self, noise: SpotNoise) -> Centre:
        """The same centre with its covariance under this noise; refused as misshapen where its skew exceeds noise."""
        if self.parts_px2 is None or self.skews is None:
            return self
        units = np.array([1.0, noise.gain_dn, noise.speckle_contrast**2])
        skewed = float(np.sum((self.skews[:, 0] - noise.skew) ** 2 / (self.skews[:, 1:] @ units))) > SKEW_LIMIT
        status = self.status
        if status in ("ok", "misshapen"):
            status = "misshapen" if skewed else "ok"
        return replace(self, covariance_px2=np.einsum("k,kij->ij", units, self.parts_px2), status=status)


@dataclass(frozen=True)
class SpotFit:
    """A converged fit of the n pixels of a patch.

    Attributes:
        patch: the pixels.
        centre_px: (2,) u, v.
        precision: (2, 2) inverse of the spot's covariance, 1/px^2.
        height_dn: height above the background.
        z: (2, n) coordinates of the pixels in sds of the spot.
        signal: (n,) light of the spot, DN.
        jacobian: (9, n) its derivatives, and those of the background; rows 1 and 2 belong to the centre.
        weights: (n,), 0 for unusable pixels.
        residual: (n,) grey minus fitted, DN.
    """

    patch: Patch
    centre_px: np.ndarray
    precision: np.ndarray
    height_dn: float
    z: np.ndarray
    signal: np.ndarray
    jacobian: np.ndarray
    weights: np.ndarray
    residual: np.ndarray

    @cached_property
    def gains(self) -> np.ndarray:
        """Derivatives (9, n) of the parameters by the pixels."""
        weighted = self.jacobian * self.weights
        # Less work than a solution for every pixel.
        return np.linalg.inv(weighted @ self.jacobian.T) @ weighted

    def noise_parts(self, filters: np.ndarray) -> np.ndarray:
        """Variance (3, k) of filters (k, n): from the background's noise, per gain and per contrast^2."""
        by_source = (filters, filters * np.sqrt(self.signal), filters * self.signal)
        shape, block = self.patch.grey.shape, self.patch.block
        background, *scaled = (through_demosaicing(part, shape, block) for part in by_source)
        return np.array([self.patch.background_variance * background, *scaled])

    def covariance_parts(self) -> np.ndarray:
        """Covariance (3, 2, 2) of the centre from the background's noise, per gain and per contrast^2, px^2."""
        by_u, by_v = self.gains[1:3]
        # The variance of u + v gives the covariance.
        u, v, sums = self.noise_parts(np.array([by_u, by_v, by_u + by_v])).T
        covariance = (sums - u - v) / 2
        return np.array([[u, covariance], [covariance, v]]).transpose(2, 0, 1)

    def shift_of_lines(self) -> np.ndarray:
        """Centre of the odd minus that of the even rows, then of columns: (2, 2) of u and v, px.

        The centres of both halves have the weights of the whole, to first order.
        """
        import cv2

        patch, one = self.patch, np.ones(1, np.float32)
        alternating = np.empty((2, self.residual.size))
        for axis, kernels in enumerate(((one, _HIGH_PASS), (_HIGH_PASS, one))):
            # Lines are counted from the picture's border.
            numbers = np.arange(patch.raw.shape[axis]) + patch.corner[1 - axis]
            # Odd minus even light is twice the part that alternates about the mean of both.
            signs = np.expand_dims(np.where(numbers % 2, np.float32(2), np.float32(-2)), 1 - axis)
            if patch.block == 1:
                alternating[axis] = (self.residual.reshape(patch.raw.shape) * signs).ravel()
            else:
                high = cv2.sepFilter2D(patch.raw, cv2.CV_32F, *kernels)
                alternating[axis] = block_means(high * signs, patch.block).ravel()
        return alternating @ self.gains[1:3].T


def fit_spot(patch: Patch, noise: SpotNoise) -> SpotFit | None:
    """Fit an elliptic Gaussian on a plane by weighted Gauss-Newton steps; None where they do not converge.

    Parameters: log height, centre, lower triangle of the precision's Cholesky factor with logs on its diagonal,
    level and slopes of the background. A library's general solver would take longer than decoding the picture.
    """
    if patch.usable.sum() < 25:
        return None
    data, usable = patch.grey.ravel().astype(float), patch.usable.ravel()
    v, u = (axis.ravel() * patch.block + (patch.block - 1) / 2 for axis in np.indices(patch.grey.shape))
    middle_u, middle_v = (patch.block * np.array(patch.grey.shape[::-1]) - 1) / 2
    jacobian = np.empty((9, data.size))
    jacobian[6], jacobian[7], jacobian[8] = 1.0, (u - middle_u) / (middle_u + 1), (v - middle_v) / (middle_v + 1)
    edge = float(np.median(np.concatenate((patch.grey[0], patch.grey[-1]))))
    start, tight = patch.start_px - np.array(patch.corner), -log(patch.start_sd_px)
    p = np.array([log(max(float(patch.grey.max()) - edge, 1.0)), *start, tight, 0.0, tight, edge, 0.0, 0.0])
    limits = np.array([0.7, 0, 0, 0.4, 0.4, 0.4, np.inf, np.inf, np.inf])
    settled = 0
    for iteration in range(60):
        a, b, c = np.exp(p[3]), p[4], np.exp(p[5])
        z, signal = _model(p[0], a, b, c, u - p[1], v - p[2], jacobian)
        residual = data - signal - p[6:] @ jacobian[6:]
        weights = usable / _variance(patch, noise, signal, np.exp(p[0]), bool(settled))
        if settled:
            reach = REACH + REACH_PX * sqrt(a * c)
            weights /= 1 + np.exp(np.minimum((z[0] ** 2 + z[1] ** 2) / reach - reach, 50.0))
        weighted = jacobian * weights
        normal = weighted @ jacobian.T
        scale = np.sqrt(normal.diagonal()) + 1e-30
        normal /= scale[:, None] * scale
        normal.flat[::10] += 1e-12 if settled else 1e-3
        try:
            step = np.linalg.solve(normal, weighted @ residual / scale) / scale
        except np.linalg.LinAlgError:
            return None
        limits[1:3], limits[4] = 1 / min(a, c), 0.4 * c
        step *= min(1.0, float((limits / np.maximum(np.abs(step), 1e-300)).min()))
        move, change = np.abs(step[1:3]).max() * max(a, c), np.abs(step[[0, 3, 5]]).max()
        # Limits in sds of the spot; the error after the last step is ten times smaller.
        if settled > 1 and move < 5e-4 / patch.block and change < 5e-3 / patch.block:
            factor = np.array([[a, 0.0], [b, c]])
            centre = p[1:3] + step[1:3] + np.array(patch.corner)
            height = float(np.exp(p[0]))
            return SpotFit(patch, centre, factor @ factor.T, height, z, signal, jacobian, weights, residual)
        settled += bool(settled or (move < 0.05 and change < 0.1) or iteration > 12)
        p = p + step
        if not np.isfinite(p).all() or max(abs(p[3]), abs(p[5])) > 6 or p[0] > 12:
            return None
    return None


def _model(
    log_height: float, a: float, b: float, c: float, x: np.ndarray, y: np.ndarray, jacobian: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates (2, n) in sds and signal (n,) under the factor (a, b; 0, c); fills in its six derivatives."""
    z = np.array([a * x + b * y, c * y])
    signal = np.exp(log_height - (z[0] * z[0] + z[1] * z[1]) / 2)
    along, down = signal * z[0], signal * z[1]
    jacobian[0] = signal
    np.multiply(along, a, out=jacobian[1])
    np.multiply(along, b, out=jacobian[2])
    jacobian[2] += down * c
    np.multiply(along, -a * x, out=jacobian[3])
    np.multiply(along, -y, out=jacobian[4])
    np.multiply(down, -c * y, out=jacobian[5])
    return z, signal


def _variance(patch: Patch, noise: SpotNoise, signal: np.ndarray, height: float, settled: bool) -> np.ndarray | float:
    """Variance of the pixels for their weights. Far from the solution the model is wrong: equal weights come first."""
    if patch.wide and noise.speckle_contrast < SPECKLE_CONTRAST_MIN:
        # Real beams are not exactly Gaussian; for a wide spot the centre must therefore not depend on the noise.
        return signal + WIDE_FLOOR_SHARE * height if settled else 1.0
    excess = signal * (noise.gain_dn + noise.speckle_contrast**2 * signal) if settled else 0.0
    return patch.background_variance + excess


def skewness(fitted: SpotFit) -> np.ndarray:
    """Rows (4, 4): amplitude of a skew shape in the spot, and its variance from background, per gain, per contrast^2.

    The shapes are the four third-order Hermite functions of the spot, minus their projection on the fit's parameters;
    the unit is the height of the spot.
    """
    z1, z2 = fitted.z
    z11, z22 = z1 * z1, z2 * z2
    shapes = np.stack(((z11 - 3) * z1, (z11 - 1) * z2, (z22 - 1) * z1, (z22 - 3) * z2)) * fitted.signal
    filters = (shapes - shapes @ fitted.gains.T @ fitted.jacobian) * fitted.weights
    filters /= np.maximum(np.einsum("kn,kn->k", filters, shapes), 1e-300)[:, None]
    return np.column_stack((filters @ fitted.residual, *fitted.noise_parts(filters)))


def measured_noise(patch: Patch) -> tuple[SpotNoise, float]:
    """The noise of a wide patch's own pixels, and the variance of a photosite without light, DN^2.

    Its skew up to `SKEW_SHAPE_MAX` counts as the beam's shape.
    """
    # The weights of a wide spot without speckle do not depend on the noise.
    fitted = fit_spot(patch, SpotNoise(speckle_contrast=0.0))
    if fitted is None:
        return SpotNoise(), patch.background_variance
    height, width = patch.raw.shape
    low = np.maximum(np.floor(fitted.centre_px - patch.corner - NOISE_REACH * patch.start_sd_px), 0).astype(int)
    high = np.minimum(low + int(2 * NOISE_REACH * patch.start_sd_px) + 1, (width, height))
    raw = patch.raw[low[1] : high[1], low[0] : high[0]]
    x = np.arange(low[0], high[0], dtype=np.float32) - np.float32(fitted.centre_px[0] - patch.corner[0])
    y = np.arange(low[1], high[1], dtype=np.float32)[:, None] - np.float32(fitted.centre_px[1] - patch.corner[1])
    (p, q), (_, r) = fitted.precision.astype(np.float32)
    signal = np.float32(fitted.height_dn) * np.exp(-(p * x * x + 2 * q * x * y + r * y * y) / 2)
    noise, background = pixel_noise(raw - signal, signal, raw < CLIPPED_DN, patch.background_variance, patch.mono)
    shape = np.clip(skewness(fitted)[:, 0], -SKEW_SHAPE_MAX, SKEW_SHAPE_MAX)
    return replace(noise, skew=tuple(shape.tolist())), background


def centre_of(patch: Patch | str, noise: SpotNoise) -> Centre:
    """Fit a patch and check the result."""
    if isinstance(patch, str):
        return Centre(patch)
    result = partial(Centre, clipped_share=patch.clipped_share, outline_px=patch.outline_px)
    if patch.clipped_share > CLIPPED_SHARE_MAX:
        return result("clipped")

    def at_border(centre: np.ndarray, margin: np.ndarray | float) -> bool:
        return bool(((centre - margin < 0) | (centre + margin > np.array(patch.size) - 1)).any())

    fitted = fit_spot(patch, noise)
    if fitted is None:
        return result("border" if at_border(patch.start_px, 2 * patch.start_sd_px) else "unfitted")
    centre, shape = fitted.centre_px, np.linalg.inv(fitted.precision)
    short, long = np.sqrt(np.linalg.eigvalsh(shape)).tolist()
    refusals = {
        "too-small": 2 * pi * log(2) * long * short < AREA_MIN_PX,
        "border": at_border(centre, BORDER_SDS * np.sqrt(np.diag(shape))),
        "elongated": long > AXES_RATIO_MAX * short,
        "unfitted": np.abs(centre - patch.start_px).max() > 3 * patch.start_sd_px + 2 * SHRINK,
    }
    return result(
        next((reason for reason, applies in refusals.items() if applies), "ok"),
        centre,
        axes_px=(long, short),
        parts_px2=fitted.covariance_parts(),
        skews=skewness(fitted),
        lines_px=fitted.shift_of_lines(),
    ).under(noise)


def widened(centres: Sequence[Centre]) -> tuple[list[Centre], tuple[AlternateLines, ...]]:
    """Centres of one camera, with larger covariance where alternate lines disagree, and these lines.

    A significant difference increases the covariance of its spot. Where the other differences are significant together,
    and `LINES_EXCESS_MIN` times as large in mean square as stated, the covariances of all spots increase.

    Args:
        centres: under the noise of the camera.
    """
    from scipy.special import chdtri

    result, disagreeing = list(centres), []
    usable = [k for k, centre in enumerate(centres) if centre.status == "ok" and centre.lines_px is not None]
    if not usable:
        return result, ()
    shifts = np.array([centres[k].lines_px for k in usable])
    covariances = np.array([centres[k].covariance_px2 for k in usable])
    chi2 = np.einsum("nki,nij,nkj->nk", shifts, np.linalg.inv(4 * covariances), shifts)
    added = np.zeros_like(covariances)
    for number, lines in enumerate(LINES):
        significant = chi2[:, number] > chdtri(2, LINES_SIGNIFICANCE)
        rest = chi2[~significant, number]
        common = max(chdtri(2 * rest.size, LINES_SIGNIFICANCE), 2 * LINES_EXCESS_MIN * rest.size)
        if rest.size and rest.sum() > common:
            significant[:] = True
        if significant.any():
            gaps = shifts[significant, number]
            added[significant] += np.einsum("ni,nj->nij", gaps, gaps) / 12
            disagreeing.append(AlternateLines(lines, int(significant.sum()), float(np.median(np.hypot(*gaps.T)))))
    for k, covariance in zip(usable, covariances + added, strict=True):
        result[k] = replace(result[k], covariance_px2=covariance)
    return result, tuple(disagreeing)


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
        noise, background = measured_noise(patch)
        patch = replace(patch, background_variance=background)
    return widened([centre_of(patch, noise or SpotNoise())])[0][0]
