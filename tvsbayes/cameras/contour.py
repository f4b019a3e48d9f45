"""The paper's centre from the spot's outline in the rectified picture (section 2.4), and the epipolar check of a pair.

Raw image px with the integer at the centre of a pixel; grey levels of 8 bits; pictures (height, width, 3) uint8, blue,
green, red.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from math import log, pi, sqrt

import numpy as np

from tvsbayes.cameras.spot_fit import AREA_MIN_PX, Centre
from tvsbayes.cameras.spot_noise import SpotNoise, background_variance
from tvsbayes.cameras.spot_window import AREA_MAX_SHARE, BRIGHT_SHARE, CLIPPED_DN, CLIPPED_SHARE_MAX, SECOND_SHARE
from tvsbayes.instrument.stereo_pair import Stereo, distort, undistort

EPIPOLAR_SIGMAS, EPIPOLAR_FLOOR_PX = 6.0, 0.5
"""A pair is refused beyond six combined sds (spot and calibration), but never below half a pixel."""
REGION_HALF_PX = 60
"""Half side of the paper's region of interest, around the brightest point of the rectified picture."""


@dataclass(frozen=True)
class Rectified:
    """One camera of the paper's pipeline: maps of the rectified picture and the parameters of the inverse."""

    maps: tuple[np.ndarray, np.ndarray]
    rotation: np.ndarray
    projection: np.ndarray
    matrix: np.ndarray
    distortion: np.ndarray

    def raw(self, points_px: np.ndarray) -> np.ndarray:
        """Raw pixels (n, 2) from rectified ones."""
        focal, middle = self.projection[[0, 1], [0, 1]], self.projection[:2, 2]
        rays = np.column_stack(((points_px - middle) / focal, np.ones(len(points_px)))) @ self.rotation
        return distort(rays[:, :2] / rays[:, 2:], self.distortion) @ self.matrix[:2, :2].T + self.matrix[:2, 2]


def rectified_pair(stereo: Stereo) -> tuple[Rectified, Rectified]:
    """Both cameras of a pair, rectified by OpenCV."""
    import cv2

    size = stereo.image_width, stereo.image_height
    first, second = (stereo.M1, stereo.D1.reshape(1, 5)), (stereo.M2, stereo.D2.reshape(1, 5))
    parts = cv2.stereoRectify(
        *first, *second, size, np.asarray(stereo.R, float), np.asarray(stereo.T, float).reshape(3, 1)
    )
    cameras = []
    for (matrix, distortion), rotation, projection in ((first, parts[0], parts[2]), (second, parts[1], parts[3])):
        maps = cv2.initUndistortRectifyMap(matrix, distortion, rotation, projection, size, cv2.CV_32FC1)
        cameras.append(Rectified(maps, rotation, projection, matrix, distortion.ravel()))
    return cameras[0], cameras[1]


def contour_of(picture: np.ndarray, camera: Rectified, noise: SpotNoise) -> Centre:
    """Apply the paper's method: centroid of the region above a threshold on V of HSV, in the rectified picture.

    The threshold applies to V alone: at 808 nm hue is undefined and saturation low. The stated variance is that of the
    region's outline, displaced by noise over slope and rounded to whole pixels, for a round Gaussian spot: its 2 pi r
    pixels are independent.
    """
    import cv2

    if picture.dtype != np.uint8:
        # The paper's method uses 8 bits.
        picture = np.clip(np.rint(picture), 0, 255).astype(np.uint8)
    rectified = cv2.remap(picture, *camera.maps, cv2.INTER_LINEAR)
    value = cv2.cvtColor(rectified, cv2.COLOR_BGR2HSV)[..., 2]
    height, width = value.shape
    smooth = cv2.blur(value, (5, 5))
    top = np.array(np.unravel_index(int(smooth.argmax()), smooth.shape))[::-1]
    low, high = np.maximum(top - REGION_HALF_PX, 0), np.minimum(top + REGION_HALF_PX + 1, (width, height))
    region = value[low[1] : high[1], low[0] : high[0]]
    floor, peak = float(np.median(region)), float(region.max())
    noise_dn = 1.4826 * float(np.median(np.abs(region - floor))) + 1.0
    if smooth[top[1], top[0]] - floor < 3 * noise_dn:
        return Centre("no-spot")
    mask = (region > floor + BRIGHT_SHARE * (peak - floor)).astype(np.uint8)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outlines = sorted(outlines, key=cv2.contourArea, reverse=True)
    moments = cv2.moments(outlines[0])
    area = moments["m00"]
    if area < AREA_MIN_PX:
        return Centre("too-small")
    outline = camera.raw(outlines[0].reshape(-1, 2) + low)
    clipped = (rectified[low[1] : high[1], low[0] : high[0]] >= CLIPPED_DN).any(axis=2) & (mask > 0)
    radius = sqrt(area / pi)
    sd = radius / sqrt(-2 * log(BRIGHT_SHARE))
    clipped_share = float(clipped.sum() / mask.sum())
    result = partial(Centre, axes_px=(sd, sd), clipped_share=clipped_share, outline_px=outline)
    if len(outlines) > 1 and cv2.contourArea(outlines[1]) > SECOND_SHARE * area:
        return result("two-spots")
    if clipped_share > CLIPPED_SHARE_MAX:
        return result("clipped")
    if area > AREA_MAX_SHARE * width * height:
        return result("too-large")
    centre = camera.raw(np.array([[moments["m10"], moments["m01"]]]) / area + low)[0]
    if (outline < 1).any() or (outline > np.array([width, height]) - 2).any():
        return result("border")
    signal = BRIGHT_SHARE * (peak - floor)
    background = background_variance(picture, centre, int(3 * sd + 3))
    pixel_variance = background + noise.gain_dn * signal + (noise.speckle_contrast * signal) ** 2
    variance = (pixel_variance / (signal * radius / sd**2) ** 2 + 1 / 12) / (pi * radius)
    return result("ok", centre, variance * np.eye(2))


def epipolar_residual(pixels: np.ndarray, stereo: Stereo) -> np.ndarray:
    """x_right^T [T]x R x_left (n,) of raw pixels (n, 4): 0 for two images of one point; mm."""
    ones = np.ones((len(pixels), 1))
    left = np.hstack((undistort(pixels[:, :2], stereo.M1, stereo.D1), ones))
    right = np.hstack((undistort(pixels[:, 2:], stereo.M2, stereo.D2), ones))
    return np.sum(right * np.cross(np.asarray(stereo.T, float).ravel(), left @ np.asarray(stereo.R, float).T), axis=1)


def epipolar_refused(pixels: np.ndarray, covariances: np.ndarray, stereo: Stereo) -> np.ndarray:
    """Mask of pairs (n,) that cannot be images of one point within the uncertainties of spots and calibration.

    Args:
        pixels: (n, 4) u_left, v_left, u_right, v_right.
        covariances: (n, 4, 4), px^2.
        stereo: the calibration; its covariance enters by central differences.
    """
    if not len(pixels):
        return np.zeros(0, bool)
    residual = epipolar_residual(pixels, stereo)
    step_px = 1e-2  # truncation 1e-9 of the slope, rounding and undistortion 1e-7
    steps = step_px * np.eye(4)
    changes = [epipolar_residual(pixels + h, stereo) - epipolar_residual(pixels - h, stereo) for h in steps]
    slope = np.stack(changes, axis=1) / (2 * step_px)
    variance = np.einsum("ni,nij,nj->n", slope, covariances, slope)
    vector, covariance = stereo.vector, np.asarray(stereo.parameter_covariance, float)
    sds = np.sqrt(np.diag(covariance))
    free = np.flatnonzero(sds > 0)
    if len(free):
        slopes = []
        for row in free:
            step = np.zeros(24)
            step[row] = 0.1 * sds[row]
            residuals = (epipolar_residual(pixels, stereo.with_vector(vector + sign * step)) for sign in (1, -1))
            slopes.append((next(residuals) - next(residuals)) / (2 * step[row]))
        camera_slope = np.array(slopes)
        variance = variance + np.einsum("in,ij,jn->n", camera_slope, covariance[np.ix_(free, free)], camera_slope)
    distance = np.abs(residual) / np.linalg.norm(slope, axis=1)
    allowed = EPIPOLAR_SIGMAS * np.sqrt(variance) / np.linalg.norm(slope, axis=1)
    # Pixels outside the range of the lens model cannot be undistorted: NaN is refused too.
    return ~(distance <= np.maximum(allowed, EPIPOLAR_FLOOR_PX))
