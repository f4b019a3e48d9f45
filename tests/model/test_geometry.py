"""Rotations against scipy and the laws they obey; projection against OpenCV's own."""

from __future__ import annotations

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tvsbayes.model.geometry import (
    NEAREST_MM,
    StereoCameras,
    project,
    rotation_matrix,
)

pytestmark = pytest.mark.usefixtures("x64")

ROUNDING = 1e-15
"""Half a dozen operations on numbers of order one."""
BATCH = 64
"""One batch size for all tests: one compilation."""
SERIES_ANGLE_RAD = 0.01
"""Where `rotation_matrix` changes from series to closed form."""
PIXEL_ROUNDING = 1e-9
"""px; twenty operations on 1e3 px leave 1e-12."""
CAMERA_MATRICES = (
    np.array([[802.0, 0.0, 645.0], [0.0, 795.0, 355.0], [0.0, 0.0, 1.0]]),
    np.array([[790.0, 0.0, 630.0], [0.0, 805.0, 362.0], [0.0, 0.0, 1.0]]),
)
DISTORTIONS = (np.array([-0.35, 0.18, 4e-3, -6e-3, -0.05]), np.array([-0.31, 0.12, -5e-3, 3e-3, 0.04]))
"""k1 k2 p1 p2 k3, several times as strong as a webcam's."""
POINTS = 200
"""One batch size for all tests: one compilation."""
ROTATION_RAD = np.array([0.02, -0.06, 0.03])
TRANSLATION_MM = np.array([-85.2, 1.3, -2.4])


@pytest.fixture(scope="module")
def compiled():
    """(rotation matrices, their first and second derivatives) of many vectors."""
    first = jax.jacfwd(rotation_matrix)
    functions = jax.jit(jax.vmap(lambda r: (rotation_matrix(r), first(r), jax.jacfwd(first)(r))))

    def run(vectors):
        padded = np.zeros((BATCH, 3))
        padded[: len(vectors)] = vectors
        with jax.enable_x64(True):
            return [np.asarray(x)[: len(vectors)] for x in functions(padded)]

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


def cameras(focal_scale: float = 1.0) -> StereoCameras:
    matrices, distortions = np.stack(CAMERA_MATRICES), np.stack(DISTORTIONS)
    return jax.tree.map(
        jnp.asarray,
        StereoCameras(
            focal_px=jnp.asarray(matrices[:, [0, 1], [0, 1]]),
            centre_px=jnp.asarray(matrices[:, :2, 2]),
            radial=jnp.asarray(distortions[:, [0, 1, 4]]),
            tangential=jnp.asarray(distortions[:, 2:4]),
            rotation_rad=jnp.asarray(ROTATION_RAD),
            translation_mm=jnp.asarray(TRANSLATION_MM),
            focal_scale=jnp.asarray(focal_scale),
        ),
    )


@pytest.fixture(scope="module")
def projected():
    """(points (n, 3) in S, focal scale) -> pixels (n, 4) and d(pixels)/d(point) (n, 4, 3)."""

    def one(pair, point):
        return project(pair, point[:, None])[:, 0]

    compiled = jax.jit(jax.vmap(lambda pair, p: (one(pair, p), jax.jacfwd(one, 1)(pair, p)), in_axes=(None, 0)))

    def run(points, focal_scale=1.0):
        padded = np.full((POINTS, 3), 300.0)
        padded[: len(points)] = points
        with jax.enable_x64(True):
            return [np.asarray(x)[: len(points)] for x in compiled(cameras(focal_scale), jnp.asarray(padded))]

    return run


def points_in_view() -> np.ndarray:
    """Frame S, mm: over the whole of both images from 150 mm to 1 m."""
    rng = np.random.default_rng(1)
    depth = rng.uniform(150.0, 1000.0, POINTS)
    across, up = rng.uniform(-0.6, 0.6, POINTS), rng.uniform(-0.4, 0.4, POINTS)
    return np.column_stack([depth, depth * across, depth * up])


@pytest.mark.parametrize("focal_scale", [1.0, 1.004])
def test_projection_is_opencvs(projected, focal_scale):
    """Both cameras, strong distortion; the focal scale multiplies fx and fy and nothing else."""
    points = points_in_view()
    pixels, _ = projected(points, focal_scale)
    in_cv = np.column_stack([-points[:, 1], -points[:, 2], points[:, 0]])
    placements = ((np.zeros(3), np.zeros(3)), (ROTATION_RAD, TRANSLATION_MM))
    for camera, (rotation, translation) in enumerate(placements):
        matrix = CAMERA_MATRICES[camera].copy()
        matrix[[0, 1], [0, 1]] *= focal_scale
        expected, _ = cv2.projectPoints(in_cv, rotation, translation, matrix, DISTORTIONS[camera])
        of_camera = pixels[:, 2 * camera : 2 * camera + 2]
        assert np.abs(of_camera - expected[:, 0]).max() < PIXEL_ROUNDING, f"camera {camera}"


def test_points_no_camera_sees_are_finite(projected):
    """Behind, beside and in the plane of the cameras, in their centres, and far off the axis."""
    points = [
        *(
            [x, y, z]
            for x in (-300.0, -0.5, 0.0, 0.5, NEAREST_MM, 200.0)
            for y in (-1e4, -85.2, 0.0, 1e4)
            for z in (0.0, 1e4)
        ),
        [0.0, 0.0, 0.0],
    ]
    pixels, jacobian = projected(points)
    assert np.isfinite(pixels).all() and np.isfinite(jacobian).all()
