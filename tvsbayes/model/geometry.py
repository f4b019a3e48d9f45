"""Rotations and cameras in JAX: from points to pixels.

Vectors in any number are three arrays (`instrument.mirrors.Vectors`). In a single array the first axis is x, y, z. mm,
rad. Frame S: origin in the left camera's centre, X depth, Y left, Z up; OpenCV's camera axes are x = -Y, y = -Z, z = X.
Pinhole with Brown-Conrady distortion; the right camera sees x_right = R x_left + T. Image px with the integer at the
centre of a pixel, ordered (u_left, v_left, u_right, v_right).
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tvsbayes.instrument.mirrors import Vectors

Scalar = Float[Array, ""]
Vector = Float[Array, "3"]
CROSS = np.zeros((3, 3, 3))
"""CROSS[i, j] . r = the matrix of the cross product r x."""
CROSS[0, 1, 2], CROSS[1, 2, 0], CROSS[2, 0, 1] = -1.0, -1.0, -1.0
CROSS[1, 0, 2], CROSS[2, 1, 0], CROSS[0, 2, 1] = 1.0, 1.0, 1.0
CV_FROM_S = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""OpenCV's camera axes from frame S: x = -Y, y = -Z, z = X."""
NEAREST_MM = 1.0
"""Points nearer than this, or behind a camera, are projected as if at this depth: a solver gets a finite gradient
there, and no spot is ever seen there."""
WIDEST_TAN2 = 4.0
"""Squared tangent (63 degrees) beyond which the distortion polynomial is constant: it is fitted inside the image and
not monotone outside."""


def materialise(tree):
    """Make XLA compute these arrays once.

    Otherwise its CPU backend fuses the whole optical chain into each of the many terms of a derivative and computes it
    again in each.
    """
    return jax.lax.optimization_barrier(tree)


def rotation_matrix(rotation_rad: Vector) -> Float[Array, "3 3"]:
    """Compute Rodrigues' formula, with finite derivatives of every order at zero rotation.

    Args:
        rotation_rad: rotation vector, rad.

    Returns:
        R such that `p_A = R p_B`.
    """
    angle2 = jnp.dot(rotation_rad, rotation_rad)
    # The series of sin(a)/a and (1 - cos a)/a^2 are exact to 1e-17 below a = 0.01 and have no 0/0.
    small = angle2 < 1e-4
    safe2 = jnp.where(small, 1.0, angle2)
    angle = jnp.sqrt(safe2)
    sinc = jnp.where(small, 1 - angle2 / 6 * (1 - angle2 / 20 * (1 - angle2 / 42)), jnp.sin(angle) / angle)
    versine = jnp.where(small, 0.5 - angle2 / 24 * (1 - angle2 / 30 * (1 - angle2 / 56)), (1 - jnp.cos(angle)) / safe2)
    cross = CROSS @ rotation_rad
    sinc, versine = materialise((sinc, versine))
    return jnp.eye(3) + sinc * cross + versine * (cross @ cross)


def transform(matrix: Float[Array | np.ndarray, "3 3"], vectors: Vectors) -> Vectors:
    """Multiply a matrix and vectors."""
    return Vectors(*(row[0] * vectors.x + row[1] * vectors.y + row[2] * vectors.z for row in matrix))


class StereoCameras(eqx.Module):
    """Both cameras, arrays ordered (left, right), coefficients named as OpenCV names them.

    Attributes:
        focal_px: (fx, fy) of each camera.
        centre_px: (cx, cy) of each camera.
        radial: (k1, k2, k3) of each camera.
        tangential: (p1, p2) of each camera.
        rotation_rad: Rodrigues vector of R, x_right = R x_left + T.
        translation_mm: T.
        focal_scale: factor on every focal length (the laser's wavelength, formulation 3.3).
    """

    focal_px: Float[Array, "2 2"]
    centre_px: Float[Array, "2 2"]
    radial: Float[Array, "2 3"]
    tangential: Float[Array, "2 2"]
    rotation_rad: Vector
    translation_mm: Vector
    focal_scale: Scalar


def image(cameras: StereoCameras, points_s_mm: Vectors) -> tuple[Float[Array, "..."], ...]:
    """Project points of frame S into both images: arrays u_left, v_left, u_right, v_right, px."""
    left = transform(CV_FROM_S, points_s_mm)
    right = transform(rotation_matrix(cameras.rotation_rad), left) + Vectors.of(cameras.translation_mm)
    pixels = []
    for camera, point in enumerate((left, right)):
        nearness = 1 / jnp.maximum(point.z, NEAREST_MM)
        x, y = materialise((point.x * nearness, point.y * nearness))
        r2 = jnp.minimum(x**2 + y**2, WIDEST_TAN2)
        k1, k2, k3 = cameras.radial[camera]
        p1, p2 = cameras.tangential[camera]
        # OpenCV's tangential terms are (p2, p1) r^2 + 2 (p2 x + p1 y) (x, y).
        r2, factor = materialise((r2, 1 + r2 * (k1 + r2 * (k2 + r2 * k3)) + 2 * (p2 * x + p1 * y)))
        focal_px, centre_px = cameras.focal_px[camera] * cameras.focal_scale, cameras.centre_px[camera]
        pixels.append(focal_px[0] * (x * factor + p2 * r2) + centre_px[0])
        pixels.append(focal_px[1] * (y * factor + p1 * r2) + centre_px[1])
    return tuple(pixels)


def project(cameras: StereoCameras, points_s_mm: Float[Array, "3 *batch"]) -> Float[Array, "4 *batch"]:
    """Project points of frame S into both images.

    Args:
        cameras: the stereo pair.
        points_s_mm: points in frame S, mm, first axis X, Y, Z.

    Returns:
        First axis (u_left, v_left, u_right, v_right), px.
    """
    return jnp.stack(image(cameras, Vectors.of(points_s_mm)))
