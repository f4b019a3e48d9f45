"""Shapes of the rig: where cameras look, where sheets stand, how large errors of spots are."""

from __future__ import annotations

import numpy as np
from scipy import stats
from support.small_campaign import small_stereo

from tvsbayes.instrument.stereo_pair import project_pair, triangulate
from tvsbayes.view.shapes import ellipsoid_axes_mm, point_covariance_mm2, pyramids, sheets

POINTS_MM = np.array([[400.0, 30.0, -20.0], [900.0, -150.0, 60.0]])


def test_pyramids_end_in_the_corners_of_the_images():
    stereo = small_stereo()
    left, right = pyramids(stereo, 150.0)
    assert (left.camera, right.camera) == ("left", "right")
    edges = np.array([(-0.5, -0.5), (1279.5, -0.5), (1279.5, 719.5), (-0.5, 719.5)])
    # Undistortion is checked to 1e-9 px; the pinhole stands in where it does not reach.
    for pyramid, columns in ((left, slice(0, 2)), (right, slice(2, 4))):
        pixels_px = project_pair(stereo, pyramid.corners_mm[1:])[:, columns]
        np.testing.assert_allclose(pixels_px, edges, atol=1e-6)
    assert np.linalg.norm(right.corners_mm[0]) == np.linalg.norm(small_stereo().T)
    # To the right of the left one: negative Y.
    assert right.corners_mm[0, 1] < -80


def test_sheet_is_the_plane_of_its_spots():
    generator = np.random.default_rng(2)
    flat = generator.uniform(-1, 1, (50, 2)) * (100, 60)
    along = np.array([(0.0, 1.0, 0.0), (0.6, 0.0, 0.8)])
    points = np.array([500.0, 0.0, 0.0]) + flat @ along
    targets = ["d1"] * 48 + ["few", "few"]
    points[3] = np.nan
    (sheet,) = sheets(targets, points)
    assert sheet.target == "d1"
    normal = np.cross(*along)
    np.testing.assert_allclose((sheet.corners_mm - points[0]) @ normal, 0.0, atol=1e-9)
    # Around all spots: beyond the outermost along either side.
    sides = (sheet.corners_mm - [500.0, 0.0, 0.0]) @ along.T
    assert np.all(sides.max(axis=0) > np.nanmax(flat[:48], axis=0))
    assert np.all(sides.min(axis=0) < np.nanmin(flat[:48], axis=0))


def test_ellipsoid_holds_95_percent_of_triangulated_points():
    stereo, generator = small_stereo(), np.random.default_rng(3)
    covariance = np.diag([0.1, 0.2, 0.1, 0.15]) ** 2
    covariance[0, 1] = covariance[1, 0] = 0.3 * 0.1 * 0.2
    pixels = project_pair(stereo, POINTS_MM)
    covariances = point_covariance_mm2(stereo, POINTS_MM, np.broadcast_to(covariance, (2, 4, 4)))
    axes = ellipsoid_axes_mm(covariances)
    for k, pixel in enumerate(pixels):
        noisy = triangulate(stereo, pixel + generator.multivariate_normal(np.zeros(4), covariance, 4000))
        inside = np.linalg.norm((noisy - POINTS_MM[k]) @ np.linalg.inv(axes[k]), axis=1) < 1
        # 4000 draws: standard error 0.0034; linear triangulation weighs the pixels a little otherwise.
        assert abs(inside.mean() - 0.95) < 5 * 0.0034
        np.testing.assert_allclose(axes[k] @ axes[k].T, np.diag(np.sum(axes[k] ** 2, axis=1)), atol=1e-9)
    assert stats.chi2.cdf(np.trace(axes[0] @ np.linalg.inv(covariances[0]) @ axes[0].T) / 3, 3) > 0.9499
