"""Vectors, rotations, reflections and cameras in JAX: what the laser's path and the pixels are made of.

A vector is an array whose first axis is x, y, z; any batch axes follow. mm, rad. Frame S: origin in the left camera's
centre, X depth, Y left, Z up; OpenCV's camera axes are x = -Y, y = -Z, z = X. Pinhole with Brown-Conrady distortion;
the right camera sees x_right = R x_left + T. Image px with the integer at the centre of a pixel, ordered (u_left,
v_left, u_right, v_right).
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Scalar = Float[Array, ""]
Vector = Float[Array, "3"]
CROSS = np.zeros((3, 3, 3))
"""CROSS[i, j] . r = the matrix of the cross product r x."""
CROSS[0, 1, 2], CROSS[1, 2, 0], CROSS[2, 0, 1] = -1.0, -1.0, -1.0
CROSS[1, 0, 2], CROSS[2, 1, 0], CROSS[0, 2, 1] = 1.0, 1.0, 1.0
HORIZONTAL = np.array([1.0, 1.0, 0.0])
CV_FROM_S = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""OpenCV's camera axes from frame S: x = -Y, y = -Z, z = X."""
NEAREST_MM = 1.0
"""Points nearer than this, or behind a camera, are projected as if they stood here: a solver that strays
there gets a finite gradient back, and no spot is ever seen there."""
WIDEST_TAN2 = 4.0
"""Squared tangent (63 degrees) beyond which the distortion polynomial is held: it is fitted inside the image
and folds outside it."""


def materialise(tree):
    """Have XLA compute these arrays once.

    Its CPU backend otherwise fuses the whole optical chain into each of the many consumers of a derivative and
    computes it again in every one.
    """
    return jax.lax.optimization_barrier(tree)


def rotation_matrix(rotation_rad: Vector) -> Float[Array, "3 3"]:
    """Rodrigues' formula, with finite derivatives of every order at the zero rotation.

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
    return jnp.eye(3) + sinc * cross + versine * (cross @ cross)


def along_batch(vector: Vector, like: Array) -> Float[Array, "3 ..."]:
    """Give one vector as many batch axes of length 1 as `like` has axes."""
    return jnp.reshape(vector, (3,) + (1,) * like.ndim)


def dot(first: Float[Array, "3 ..."], second: Float[Array, "3 ..."]) -> Float[Array, "..."]:
    """Scalar product over the first axis."""
    product = first * second
    return product[0] + product[1] + product[2]


def transform(matrix: Float[Array | np.ndarray, "3 3"], vectors: Float[Array, "3 *batch"]) -> Float[Array, "3 *batch"]:
    """Matrix times vectors, written out: XLA's small matrix products and reductions run far slower."""
    wide = jnp.reshape(matrix, (3, 3) + (1,) * (vectors.ndim - 1))
    return wide[:, 0] * vectors[0] + wide[:, 1] * vectors[1] + wide[:, 2] * vectors[2]


def rotate_about_z(angle_rad: Float[Array, "..."], vector: Float[Array, "3 ..."]) -> Float[Array, "3 ..."]:
    """Turn vectors about z, counter-clockwise seen from +z; batch axes of both broadcast."""
    turned = transform(CROSS[:, :, 2], vector)
    level = vector * HORIZONTAL.reshape((3,) + (1,) * (vector.ndim - 1))
    return vector + jnp.sin(angle_rad) * turned + (jnp.cos(angle_rad) - 1) * level


def reflect(direction: Float[Array, "3 ..."], normal: Float[Array, "3 ..."]) -> Float[Array, "3 ..."]:
    """Mirror directions at a plane with unit normal: d - 2 (d.n) n (formulation 3.2)."""
    return direction - 2 * dot(direction, normal) * normal


def intersect_plane(
    origin: Float[Array, "3 ..."],
    direction: Float[Array, "3 ..."],
    point: Float[Array, "3 ..."],
    normal: Float[Array, "3 ..."],
) -> Float[Array, "3 ..."]:
    """Points where lines meet the plane through `point`; not finite where they are parallel."""
    return origin + dot(point - origin, normal) / dot(direction, normal) * direction


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
