"""Rotations, mirrors and rays against scipy and the laws they obey."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tvsbayes.model.geometry import dot, intersect_plane, reflect, rotate_about_z, rotation_matrix, transform

pytestmark = pytest.mark.usefixtures("x64")

ROUNDING = 1e-15
"""Half a dozen operations on numbers of order one."""
BATCH = 64
"""One batch size for all tests: one compilation."""
SERIES_ANGLE_RAD = 0.01
"""Where `rotation_matrix` changes from series to closed form."""


@pytest.fixture(scope="module")
def compiled():
    """(rotation matrices, their first and second derivatives) of many vectors."""
    first = jax.jacfwd(rotation_matrix)
    functions = [jax.jit(jax.vmap(f)) for f in (rotation_matrix, first, jax.jacfwd(first))]

    def run(vectors):
        padded = np.zeros((BATCH, 3))
        padded[: len(vectors)] = vectors
        with jax.enable_x64(True):
            return [np.asarray(f(jnp.asarray(padded)))[: len(vectors)] for f in functions]

    return run


def vectors_rad() -> np.ndarray:
    """Seeded directions at angles 0, 1e-9 ... pi, and on both sides of the change of formula."""
    rng = np.random.default_rng(1)
    near = SERIES_ANGLE_RAD * np.array([1 - 1e-9, 1 + 1e-9])
    angles = np.concatenate([[0.0], np.logspace(-9, np.log10(np.pi), 40), near])
    directions = rng.standard_normal((angles.size, 3))
    return angles[:, None] * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_rotation_matrix_is_scipys(compiled):
    vectors = vectors_rad()
    expected = Rotation.from_rotvec(vectors).as_matrix()
    assert np.abs(compiled(vectors)[0] - expected).max() < 4 * ROUNDING


def test_derivatives_are_finite_and_right(compiled):
    """Against fourth-order central differences of scipy's matrices, at the zero rotation above all."""
    vectors = vectors_rad()
    _, first, second = compiled(vectors)
    assert np.isfinite(first).all() and np.isfinite(second).all()
    step = 1e-3  # rad: truncation step^4 / 30 = 3e-14, rounding 1e-16 / step = 1e-13
    for axis in range(3):
        near, far = (
            Rotation.from_rotvec(vectors + m * step * np.eye(3)[axis]).as_matrix()
            - Rotation.from_rotvec(vectors - m * step * np.eye(3)[axis]).as_matrix()
            for m in (1, 2)
        )
        assert np.abs(first[..., axis] - (8 * near - far) / (12 * step)).max() < 1e-11


def test_second_derivative_at_zero_is_the_known_one(compiled):
    """R = 1 + [r] + [r]^2/2 + ...: d2R/dr_i dr_j = (e_i e_j^T + e_j e_i^T)/2 - delta_ij 1 at r = 0."""
    second = compiled(np.zeros((1, 3)))[2][0]
    unit = np.eye(3)
    for i in range(3):
        for j in range(3):
            expected = (np.outer(unit[i], unit[j]) + np.outer(unit[j], unit[i])) / 2 - (i == j) * unit
            np.testing.assert_allclose(second[:, :, i, j], expected, atol=ROUNDING)


def test_rotate_about_z_is_the_rotation_about_z():
    vectors = np.random.default_rng(2).standard_normal((3, 20))
    angles = np.linspace(-np.pi, np.pi, 20)
    turned = np.asarray(rotate_about_z(jnp.asarray(angles), jnp.asarray(vectors)))
    expected = Rotation.from_rotvec(angles[:, None] * [0.0, 0.0, 1.0]).apply(vectors.T).T
    np.testing.assert_allclose(turned, expected, atol=4 * ROUNDING)


def test_transform_and_dot_are_the_products():
    rng = np.random.default_rng(3)
    matrix, vectors, others = rng.standard_normal((3, 3)), *rng.standard_normal((2, 3, 5, 7))
    product = transform(jnp.asarray(matrix), jnp.asarray(vectors))
    np.testing.assert_allclose(product, np.einsum("ij,jab->iab", matrix, vectors), atol=10 * ROUNDING)
    scalar = dot(jnp.asarray(vectors), jnp.asarray(others))
    np.testing.assert_allclose(scalar, np.sum(vectors * others, axis=0), atol=10 * ROUNDING)


def rays_and_planes():
    rng = np.random.default_rng(4)
    origin, direction, point, normal = rng.standard_normal((4, 3, 50))
    return tuple(
        map(
            jnp.asarray,
            (origin, direction / np.linalg.norm(direction, axis=0), point, normal / np.linalg.norm(normal, axis=0)),
        )
    )


def test_reflection_keeps_what_lies_in_the_mirror_and_turns_the_rest():
    _, direction, _, normal = rays_and_planes()
    out = reflect(direction, normal)
    incoming, outgoing = (np.asarray(dot(v, normal)) for v in (direction, out))
    np.testing.assert_allclose(outgoing, -incoming, atol=4 * ROUNDING)
    tangential = np.asarray(direction) - incoming * np.asarray(normal)
    np.testing.assert_allclose(np.asarray(out) - outgoing * np.asarray(normal), tangential, atol=4 * ROUNDING)
    np.testing.assert_allclose(reflect(out, normal), direction, atol=4 * ROUNDING)


def test_intersection_lies_on_line_and_plane():
    origin, direction, point, normal = rays_and_planes()
    hit = intersect_plane(origin, direction, point, normal)
    size = np.maximum(1.0, np.linalg.norm(hit, axis=0))
    assert np.max(np.abs(dot(hit - point, normal)) / size) < 10 * ROUNDING
    across = np.cross(np.asarray(hit - origin), np.asarray(direction), axis=0)
    assert np.max(np.linalg.norm(across, axis=0) / size) < 10 * ROUNDING
