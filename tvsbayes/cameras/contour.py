"""The paper's centre from the spot's outline in the rectified picture (section 2.4), and the epipolar check of a pair.

Raw image px with the integer at the centre of a pixel; grey levels of 8 bits; pictures (height, width, 3) uint8, blue,
green, red.
"""

from __future__ import annotations

from collections.abc import Callable
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
PIXEL_STEP_PX, CAMERA_STEP_SDS = 1e-2, 0.1
"""Steps of central differences: truncation 1e-9 of a pixel's slope, rounding and undistortion 1e-7."""


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

    size, T = (stereo.image_width, stereo.image_height), np.asarray(stereo.T, float).reshape(3, 1)
    cameras = (stereo.M1, stereo.D1.ravel()), (stereo.M2, stereo.D2.ravel())
    R1, R2, P1, P2, *_ = cv2.stereoRectify(*cameras[0], *cameras[1], size, np.asarray(stereo.R, float), T)
    left, right = (
        Rectified(cv2.initUndistortRectifyMap(*camera, R, P, size, cv2.CV_32FC1), R, P, *camera)
        for camera, R, P in zip(cameras, (R1, R2), (P1, P2), strict=True)
    )
    return left, right


def contour_of(picture: np.ndarray, camera: Rectified, noise: SpotNoise) -> Centre:
    """Apply the paper's method: centroid of the region above a threshold on V of HSV, in the rectified picture.

    The threshold applies to V alone: at 808 nm hue is undefined and saturation low. The stated variance is that of the
    region's outline, displaced by noise over slope and rounded to whole pixels, for a round Gaussian spot: its 2 pi r
    pixels are independent.
    """
    import cv2

    # The paper's method uses 8 bits.
    picture = picture if picture.dtype == np.uint8 else np.clip(np.rint(picture), 0, 255).astype(np.uint8)
    rectified = cv2.remap(picture, *camera.maps, cv2.INTER_LINEAR)
    value = cv2.cvtColor(rectified, cv2.COLOR_BGR2HSV)[..., 2]
    height, width = value.shape
    smooth = cv2.blur(value, (5, 5))
    top = np.array(np.unravel_index(int(smooth.argmax()), smooth.shape))[::-1]
    low, high = np.maximum(top - REGION_HALF_PX, 0), np.minimum(top + REGION_HALF_PX + 1, (width, height))
    window = np.s_[low[1] : high[1], low[0] : high[0]]
    region = value[window]
    floor, peak = float(np.median(region)), float(region.max())
    noise_dn = 1.4826 * float(np.median(np.abs(region - floor))) + 1.0
    if smooth[top[1], top[0]] - floor < 3 * noise_dn:
        return Centre("no-spot")
    signal = BRIGHT_SHARE * (peak - floor)
    mask = (region > floor + signal).astype(np.uint8)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    largest, *others = sorted(outlines, key=cv2.contourArea, reverse=True)
    moments = cv2.moments(largest)
    area = moments["m00"]
    if area < AREA_MIN_PX:
        return Centre("too-small")
    outline = camera.raw(largest.reshape(-1, 2) + low)
    clipped = (rectified[window] >= CLIPPED_DN).any(axis=2) & (mask > 0)
    radius, clipped_share = sqrt(area / pi), float(clipped.sum() / mask.sum())
    sd = radius / sqrt(-2 * log(BRIGHT_SHARE))
    refusals = {
        "two-spots": bool(others) and cv2.contourArea(others[0]) > SECOND_SHARE * area,
        "clipped": clipped_share > CLIPPED_SHARE_MAX,
        "too-large": area > AREA_MAX_SHARE * width * height,
        "border": ((outline < 1) | (outline > np.array([width, height]) - 2)).any(),
    }
    result = partial(Centre, axes_px=(sd, sd), clipped_share=clipped_share, outline_px=outline)
    if reason := next((reason for reason, applies in refusals.items() if applies), None):
        return result(reason)
    centre = camera.raw(np.array([[moments["m10"], moments["m01"]]]) / area + low)[0]
    background = background_variance(picture, centre, int(3 * sd + 3))
    pixel_variance = background + noise.gain_dn * signal + (noise.speckle_contrast * signal) ** 2
    variance = (pixel_variance / (signal * radius / sd**2) ** 2 + 1 / 12) / (pi * radius)
    return result("ok", centre, variance * np.eye(2))


def epipolar_refused(pixels: np.ndarray, covariances: np.ndarray, stereo: Stereo) -> np.ndarray:
    """Mask of pairs (n,) that cannot be images of one point within the uncertainties of spots and calibration.

    Args:
        pixels: (n, 4) u_left, v_left, u_right, v_right.
        covariances: (n, 4, 4), px^2.
        stereo: the calibration; its covariance enters by central differences.
    """

    def residual(px: np.ndarray, pair: Stereo) -> np.ndarray:
        """x_right^T [T]x R x_left (n,): 0 for two images of one point; mm."""
        ones = np.ones((len(px), 1))
        left = np.hstack((undistort(px[:, :2], pair.M1, pair.D1), ones))
        right = np.hstack((undistort(px[:, 2:], pair.M2, pair.D2), ones))
        return np.sum(right * np.cross(np.asarray(pair.T, float).ravel(), left @ np.asarray(pair.R, float).T), axis=1)

    def slopes(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray, steps: np.ndarray) -> np.ndarray:
        changes = [(function(at + step) - function(at - step)) / (2 * step.max()) for step in steps]
        return np.reshape(changes, (len(steps), len(pixels)))

    if not len(pixels):
        return np.zeros(0, bool)
    by_pixel = slopes(lambda px: residual(px, stereo), pixels, PIXEL_STEP_PX * np.eye(4))
    variance = np.einsum("in,nij,jn->n", by_pixel, covariances, by_pixel)
    covariance = np.asarray(stereo.parameter_covariance, float)
    sds = np.sqrt(np.diag(covariance))
    free = np.flatnonzero(sds > 0)
    steps = CAMERA_STEP_SDS * np.diag(sds)[free]
    by_camera = slopes(lambda vector: residual(pixels, stereo.with_vector(vector)), stereo.vector, steps)
    variance += np.einsum("in,ij,jn->n", by_camera, covariance[np.ix_(free, free)], by_camera)
    scale = np.linalg.norm(by_pixel, axis=0)
    # Pixels outside the range of the lens model cannot be undistorted: NaN is refused too.
    allowed_px = np.maximum(EPIPOLAR_SIGMAS * np.sqrt(variance) / scale, EPIPOLAR_FLOOR_PX)
    return ~(np.abs(residual(pixels, stereo)) / scale <= allowed_px)
