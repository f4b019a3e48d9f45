"""The stereo pair: points in frame S -> four pixels (DESIGN 3.3).

Frame S: origin in the left camera's centre, X depth, Y left, Z up; OpenCV's camera axes are x = -Y, y = -Z,
z = X. Pinhole with Brown-Conrady distortion; the right camera sees x_right = R x_left + T. Lengths in mm,
image px with the integer at the centre of a pixel. Pixels are ordered (u_left, v_left, u_right, v_right).
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tvsbayes.geometry import Scalar, Vector, materialise, rotation_matrix, transform

CV_FROM_S = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""OpenCV's camera axes from frame S: x = -Y, y = -Z, z = X."""
NEAREST_MM = 1.0
"""Points nearer than this, or behind a camera, are projected as if they stood here: a solver that strays
there gets a finite gradient back, and no spot is ever seen there."""
WIDEST_TAN2 = 4.0
"""Squared tangent (63 degrees) beyond which the distortion polynomial is held: it is fitted inside the image
and folds outside it."""


class StereoCameras(eqx.Module):
    """Both cameras, arrays ordered (left, right), coefficients named as OpenCV names them.

    Attributes:
        focal_px: (fx, fy) of each camera.
        centre_px: (cx, cy) of each camera.
        radial: (k1, k2, k3) of each camera.
        tangential: (p1, p2) of each camera.
        rotation_rad: Rodrigues vector of R, x_right = R x_left + T.
        translation_mm: T.
        focal_scale: factor on every focal length (the laser's wavelength, DESIGN 3.3).
    """

    focal_px: Float[Array, "2 2"]
    centre_px: Float[Array, "2 2"]
    radial: Float[Array, "2 3"]
    tangential: Float[Array, "2 2"]
    rotation_rad: Vector
    translation_mm: Vector
    focal_scale: Scalar


def project(cameras: StereoCameras, points_s_mm: Float[Array, "3 *batch"]) -> Float[Array, "4 *batch"]:
    """Pixels of points of frame S in both images.

    Args:
        cameras: the stereo pair.
        points_s_mm: points in frame S, mm, first axis X, Y, Z.

    Returns:
        First axis (u_left, v_left, u_right, v_right), px.
    """
    batch = points_s_mm.shape[1:]
    ones = (1,) * len(batch)

    def per_camera(values):
        return jnp.reshape(values, values.shape + ones)

    left = transform(CV_FROM_S, points_s_mm)
    translation = jnp.reshape(cameras.translation_mm, (3, *ones))
    right = transform(rotation_matrix(cameras.rotation_rad), left) + translation
    points = materialise(jnp.stack([left, right]))
    depth = jnp.maximum(points[:, 2:], NEAREST_MM)
    xy = materialise(points[:, :2] / depth)
    r2 = materialise(jnp.minimum(xy[:, 0] ** 2 + xy[:, 1] ** 2, WIDEST_TAN2))
    k1, k2, k3 = (per_camera(cameras.radial[:, i]) for i in range(3))
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    # With q = (p2, p1) OpenCV's tangential terms are q r^2 + 2 (q . xy) xy.
    q = per_camera(cameras.tangential[:, ::-1])
    distorted = materialise(
        xy * materialise(radial + 2 * (q[:, 0] * xy[:, 0] + q[:, 1] * xy[:, 1]))[:, None] + q * r2[:, None]
    )
    pixels = per_camera(cameras.focal_px * cameras.focal_scale) * distorted + per_camera(cameras.centre_px)
    return jnp.reshape(pixels, (4, *batch))
