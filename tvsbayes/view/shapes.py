"""Shapes of the parts of a rig: cameras as pyramids, sheets as rectangles, errors of spots as ellipsoids. NumPy.

Frame S: X depth, Y left, Z up, origin in the left camera's centre; mm, px.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from tvsbayes.instrument.stereo_pair import Stereo, project_pair, undistort
from tvsbayes.model.geometry import CV_FROM_S

STEP_MM = 0.1
"""Step of differences by a point's coordinates: its squared ratio to the range is far below the rounding of a pixel."""
PYRAMID_SHARE, PYRAMID_MM = 0.1, 100.0
"""Depth of a camera's pyramid: as a share of the spots' median range, and without spots."""
SHEET_SPOTS = 3
"""Least number of spots for a plane."""
SHEET_MARGIN = 0.08
"""Margin of a sheet beyond its outermost spots, as a share of its longer side."""
PROBABILITY = 0.95


@dataclass(frozen=True)
class Pyramid:
    """The field of view of a camera.

    Attributes:
        camera: left or right.
        corners_mm: its centre, then the corners of the image in turn, shape (5, 3).
    """

    camera: str
    corners_mm: np.ndarray


def pyramids(stereo: Stereo, depth_mm: float) -> tuple[Pyramid, Pyramid]:
    """Pyramids of both cameras with the given depth."""
    width, height = stereo.image_width - 0.5, stereo.image_height - 0.5
    corners_px = np.array([(-0.5, -0.5), (width, -0.5), (width, height), (-0.5, height)])
    rays = []
    for matrix, distortion in ((stereo.M1, stereo.D1), (stereo.M2, stereo.D2)):
        rays_cv = undistort(corners_px, matrix, distortion)
        # A lens model may be invalid at the corners of its image.
        pinhole = (corners_px - matrix[:2, 2]) / matrix[[0, 1], [0, 1]]
        rays.append(np.column_stack([np.where(np.isfinite(rays_cv), rays_cv, pinhole), np.ones(4)]))
    left, right = (np.vstack([np.zeros(3), depth_mm * ray]) for ray in rays)
    right = (right - stereo.T) @ stereo.R
    return Pyramid("left", left @ CV_FROM_S), Pyramid("right", right @ CV_FROM_S)


@dataclass(frozen=True)
class Sheet:
    """A sheet estimated from its spots.

    Attributes:
        target: its name.
        corners_mm: corners of a rectangle around its spots, in turn, shape (4, 3).
    """

    target: str
    corners_mm: np.ndarray


def sheets(targets: Sequence[str], points_mm: np.ndarray) -> tuple[Sheet, ...]:
    """Fit planes to the spots of each name (total least squares); none for fewer than three spots.

    Args:
        targets: targets of the spots.
        points_mm: their positions, shape (n, 3); NaN where unknown.
    """
    names, known = np.array(targets, dtype=str), np.isfinite(points_mm).all(axis=1)
    planes = []
    for target in dict.fromkeys(targets):
        spots = points_mm[known & (names == target)]
        if len(spots) < SHEET_SPOTS:
            continue
        middle = spots.mean(axis=0)
        # Rows: along the longer side, along the shorter side, normal to the sheet.
        along = np.linalg.svd(spots - middle, full_matrices=False)[2][:2]
        flat = (spots - middle) @ along.T
        low, high = flat.min(axis=0), flat.max(axis=0)
        margin = SHEET_MARGIN * (high - low).max()
        (a, c), (b, d) = low - margin, high + margin
        planes.append(Sheet(target, middle + np.array([(a, c), (b, c), (b, d), (a, d)]) @ along))
    return tuple(planes)


def point_covariance_mm2(stereo: Stereo, points_mm: np.ndarray, covariance_px2: np.ndarray) -> np.ndarray:
    """Covariance of triangulated points from the noise of their pixels, with known cameras.

    Args:
        stereo: the cameras.
        points_mm: shape (n, 3).
        covariance_px2: covariance of u_left, v_left, u_right, v_right, shape (n, 4, 4).

    Returns:
        Shape (n, 3, 3); NaN where a point is NaN.
    """
    steps = STEP_MM * np.eye(3)
    ahead, behind = (np.stack([project_pair(stereo, points_mm + s * step) for step in steps], axis=2) for s in (1, -1))
    slope = (ahead - behind) / (2 * STEP_MM)
    information = np.einsum("nia,nij,njb->nab", slope, np.linalg.inv(covariance_px2), slope)
    covariance = np.full(information.shape, np.nan)
    known = np.isfinite(information).all(axis=(1, 2))
    covariance[known] = np.linalg.inv(information[known])
    return covariance


def ellipsoid_axes_mm(covariance_mm2: np.ndarray) -> np.ndarray:
    """Half axes of the 95 % ellipsoids of points, shape (n, 3, 3): axis, then x, y, z.

    `covariance_mm2` has shape (n, 3, 3); NaN gives axes of NaN.
    """
    axes = np.full(covariance_mm2.shape, np.nan)
    known = np.isfinite(covariance_mm2).all(axis=(1, 2))
    values, vectors = np.linalg.eigh(covariance_mm2[known])
    # (p - x)' C^-1 (p - x) is chi-square with three degrees of freedom.
    reach = np.sqrt(special.chdtri(3, 1 - PROBABILITY) * np.maximum(values, 0.0))
    axes[known] = reach[:, :, None] * np.swapaxes(vectors, 1, 2)
    return axes
