"""Lens models of other programs, fitted to k1 k2 p1 p2 k3 over the picture; other lenses are refused.

The fit is linear: a grid of pixels gives rays by the other model, and the five coefficients are fitted that return
these rays to their pixels, with the camera matrix unchanged. Projections are OpenCV's; integers at centres of pixels.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import cv2
import numpy as np

from tvsbayes.importing.stereo_words import words

GRID = 25
"""Number of grid points along each side of the picture."""
ERROR_MAX_PX = 0.1
"""Largest accepted error of a fit, equal to that of a centroid."""
WIDEST_TAN = 4.0
"""Tangent of the angle off the axis, 76 deg, beyond which five coefficients are not tried."""
UNDISTORTION = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
"""Iterations, and the error of a distorted ray in px."""


class FittedLens(NamedTuple):
    """Five coefficients and their largest error in the picture, px; infinite where the other model has no ray."""

    distortion: np.ndarray
    error_px: float


def kind_of(model: str) -> str | None:
    """The kind of a lens model by its name: five (also of no name), rational, fisheye or inverse; else None."""
    name = re.sub(r"[ -]", "_", model.strip().lower()).removeprefix("distortion.")
    return next((kind for kind, names in words()["lens"].items() if name in names.split()), None if name else "five")


def fitted_to_five(matrix: np.ndarray, distortion: np.ndarray, size: tuple[int, int], kind: str) -> FittedLens:
    """Fit five coefficients to another model in a picture of this size, px.

    `distortion` holds OpenCV's 8, 12 or 14 coefficients, the 4 of its fisheye model, or the 5 of the inverse one.
    """
    pixels: np.ndarray = np.stack(np.meshgrid(*(np.linspace(0, n - 1, GRID) for n in size)), axis=-1).reshape(-1, 2)
    target = (pixels - matrix[:2, 2]) / matrix[[0, 1], [0, 1]]
    rays: np.ndarray = target
    reprojected = pixels
    if kind == "inverse":
        rays = projected(target, np.eye(3), distortion)
    elif kind == "fisheye":
        four = distortion.reshape(4, 1)
        rays = cv2.fisheye.undistortPoints(pixels[:, None], matrix, four).reshape(-1, 2)
        reprojected = cv2.fisheye.distortPoints(rays[:, None], matrix, four).reshape(-1, 2)
    else:
        if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4: undistortPoints takes no criteria in Python
            points = cv2.undistortPointsIter(pixels[:, None], matrix, distortion, None, None, UNDISTORTION)
        else:
            points = cv2.undistortPoints(pixels[:, None], matrix, distortion, criteria=UNDISTORTION)
        rays = points.reshape(-1, 2)
        reprojected = projected(rays, matrix, distortion)
    valid = np.isfinite(rays).all(axis=1) & (np.linalg.norm(rays, axis=1) < WIDEST_TAN)
    valid[valid] &= np.abs(reprojected[valid] - pixels[valid]).max(axis=1) < ERROR_MAX_PX
    if not valid.all():
        return FittedLens(np.zeros(5), np.inf)
    columns = [(projected(rays, np.eye(3), unit) - rays).ravel() for unit in np.eye(5)]
    five = np.linalg.lstsq(np.stack(columns, axis=1), (target - rays).ravel())[0]
    errors_px = projected(rays, matrix, five) - pixels
    return FittedLens(five, float(np.linalg.norm(errors_px, axis=1).max()))


def projected(rays: np.ndarray, matrix: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) of rays (n, 2) by any of OpenCV's pinhole models."""
    points = np.column_stack([rays, np.ones(len(rays))])
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)[0].reshape(-1, 2)
