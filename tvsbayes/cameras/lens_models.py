"""Lens models of other programs, fitted to k1 k2 p1 p2 k3 over the picture; other lenses are refused.

Normalised coordinates and pixels as in `stereo_pair`. The fit is linear: a grid of pixels gives rays by the other
model, and the five coefficients are fitted that return these rays to their pixels, with the camera matrix unchanged.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from tvsbayes.instrument.stereo_pair import distort, undistort_unchecked

Kind = Literal["five", "rational", "fisheye", "inverse"]
FIVE: tuple[str, ...] = (
    *(
        "plumb_bob",
        "radtan",
        "pinhole_radial_tangential",
        "radial_tangential",
        "radialtangential",
        "standard",
        "brown",
        "brown_conrady",
    ),
    *("opencv", "none", "modified_brown_conrady", "pinhole", "perspective", "rectified"),
)
RATIONAL = ("rational_polynomial", "rational", "thin_prism", "tilted")
INVERSE = ("inverse_brown_conrady",)
"""librealsense's model: five coefficients map pixels to rays, not rays to pixels (rs2_deproject_pixel_to_point)."""
FISHEYE = ("equidistant", "fisheye", "kannala_brandt", "kannala_brandt4", "kannalabrandt8", "kannala_brandt8", "equi")
GRID = 25
"""Number of grid points along each side of the picture."""
ERROR_MAX_PX = 0.1
"""Largest accepted error of a fit, equal to that of a centroid."""
WIDEST_TAN = 4.0
"""Tangent of the angle off the axis, 76 deg, beyond which five coefficients are not tried."""


@dataclass(frozen=True)
class FittedLens:
    """Five coefficients and their largest error in the picture, px; infinite where the other model has no ray."""

    distortion: np.ndarray
    error_px: float


def kind_of(model: str) -> Kind | None:
    """The kind of a lens model by its name; "five" where none is stated, None for an unknown one."""
    name = re.sub(r"[ -]", "_", model.strip().lower()).removeprefix("distortion.")
    names: dict[Kind, tuple[str, ...]] = {"five": (*FIVE, ""), "rational": RATIONAL, "fisheye": FISHEYE}
    names["inverse"] = INVERSE
    return next((kind for kind, models in names.items() if name in models), None)


def fitted_to_five(matrix: np.ndarray, distortion: np.ndarray, size: tuple[int, int], kind: Kind) -> FittedLens:
    """Fit five coefficients to another model.

    Args:
        matrix: camera matrix.
        distortion: OpenCV's 8, 12 or 14, the 4 of its fisheye model, or the 5 of the inverse one.
        size: width and height of the picture, px.
        kind: kind of the other model.
    """
    pixels = np.stack(np.meshgrid(*(np.linspace(0, n - 1, GRID) for n in size)), axis=-1).reshape(-1, 2)
    target = (pixels - matrix[:2, 2]) / matrix[[0, 1], [0, 1]]
    if kind == "inverse":
        rays: np.ndarray = distort(target, distortion)
        reprojected: np.ndarray = pixels
    elif kind == "fisheye":
        rays = cv2.fisheye.undistortPoints(pixels[:, None], matrix, distortion.reshape(4, 1)).reshape(-1, 2)
        reprojected = cv2.fisheye.distortPoints(rays.reshape(-1, 1, 2), matrix, distortion.reshape(4, 1)).reshape(-1, 2)
    else:
        rays = undistort_unchecked(pixels, matrix, distortion)
        points = np.column_stack([rays, np.ones(len(rays))])
        reprojected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)[0].reshape(-1, 2)
    valid = np.isfinite(rays).all(axis=1) & (np.linalg.norm(rays, axis=1) < WIDEST_TAN)
    valid[valid] &= np.abs(reprojected[valid] - pixels[valid]).max(axis=1) < ERROR_MAX_PX
    if not valid.all():
        return FittedLens(np.zeros(5), np.inf)
    columns = [(distort(rays, unit) - rays).ravel() for unit in np.eye(5)]
    distortion5 = np.linalg.lstsq(np.stack(columns, axis=1), (target - rays).ravel())[0]
    errors_px = (distort(rays, distortion5) - target) * matrix[[0, 1], [0, 1]]
    return FittedLens(distortion5, float(np.linalg.norm(errors_px, axis=1).max()))
