"""Rotations, mirrors and rays that know no laboratory.

A vector is an array whose first axis is x, y, z; any batch axes follow. Lengths in mm, angles in rad. All functions
are differentiable and written for JAX with few, wide operations: compile time grows with their number. Frames are
named in DESIGN section 2: S (stereo), P (positioner), T (TVS).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Scalar = Float[Array, ""]
Vector = Float[Array, "3"]
Vectors = Float[Array, "3 *batch"]

CROSS = np.zeros((3, 3, 3))
"""CROSS[i, j] . r = the matrix of the cross product r x."""
CROSS[0, 1, 2], CROSS[1, 2, 0], CROSS[2, 0, 1] = -1.0, -1.0, -1.0
CROSS[1, 0, 2], CROSS[2, 1, 0], CROSS[0, 2, 1] = 1.0, 1.0, 1.0
HORIZONTAL = np.array([1.0, 1.0, 0.0])


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
    """Mirror directions at a plane with unit normal: d - 2 (d.n) n (DESIGN 3.2)."""
    return direction - 2 * dot(direction, normal) * normal


def intersect_plane(
    origin: Float[Array, "3 ..."],
    direction: Float[Array, "3 ..."],
    point: Float[Array, "3 ..."],
    normal: Float[Array, "3 ..."],
) -> Float[Array, "3 ..."]:
    """Points where lines meet the plane through `point`; not finite where they are parallel."""
    return origin + dot(point - origin, normal) / dot(direction, normal) * direction
