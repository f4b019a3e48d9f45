"""The paper's equations as printed: where they hold, and the discontinuous branch."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.published_equations import published_point

ROUNDING_MM = 1e-9
"""Of a hundred operations on lengths up to 1000 mm, magnified tenfold by a grazing line of sight."""


A_MM = 200.0


def rays_meet(B_deg: float, C_deg: float, beta_deg: float) -> np.ndarray:
    """Intersection of both rays in the plane tilted by beta, as a linear system."""
    B, C, beta = np.radians([B_deg, C_deg, beta_deg])
    beam, sight = np.array([math.sin(C), -math.cos(C)]), np.array([math.sin(B), math.cos(B)])
    reach, _ = np.linalg.solve(np.stack([beam, -sight], axis=1), [0.0, -A_MM])
    distance, y = reach * beam + [0.0, A_MM / 2]
    return np.array([distance * math.cos(beta), y, distance * math.sin(beta)])


@pytest.mark.parametrize("beta_deg", [0.0, 17.0, -30.0])
def test_published_point_is_where_the_rays_meet(beta_deg):
    pairs = [(B, C) for B in (5.0, 45.0, 80.0, 90.0, 95.0, 140.0) for C in (10.0, 60.0, 90.0, 100.0) if B + C < 175]
    assert any(B > 90 for B, _ in pairs) and any(C > 90 for _, C in pairs)
    B, C = np.array(pairs).T
    points = published_point(B, C, beta_deg, A_MM)
    assert points.shape == (3, len(pairs))
    for i, pair in enumerate(pairs):
        # Points up to 2 m away where both rays meet under 5 deg.
        np.testing.assert_allclose(points[:, i], rays_meet(*pair, beta_deg), atol=10 * ROUNDING_MM)
        np.testing.assert_array_equal(published_point(*pair, beta_deg, A_MM), points[:, i])
    distance = np.hypot(points[0], points[2])
    np.testing.assert_allclose(points[1], A_MM / 2 - distance / np.tan(np.radians(C)), atol=10 * ROUNDING_MM)
    np.testing.assert_allclose(points[1], -A_MM / 2 + distance / np.tan(np.radians(B)), atol=10 * ROUNDING_MM)


@pytest.mark.parametrize(("B", "C", "y_mm"), [(90, 70, -100.0), (95, 70, -163.3), (110, 50, -253.2)])
def test_published_y_is_the_table(B, C, y_mm):
    """Published points by paper eq. (1) to (3), printed to 0.1 mm."""
    assert published_point(float(B), float(C), 0.0, A_MM)[1] == pytest.approx(y_mm, abs=0.05)


def test_published_point_diverges_without_a_warning():
    points = published_point(np.array([100.0, 90.0]), np.array([80.0, 120.0]), 0.0, A_MM)
    assert abs(points[0, 0]) > 1e15 and points[0, 1] < 0


def test_the_printed_branch_jumps_at_90_degrees():
    """By -a at B = 90 deg for every C: -a/2 before, -a (1/2 + 1) behind, whatever tan C."""
    C = np.array([20.0, 50.0, 70.0, 89.0])
    below, above = (published_point(90.0 + d, C, 8.0, A_MM, as_printed=True) for d in (-1e-7, 1e-7))
    # sin B cos C / sin(B + C) = 1 at B = 90 deg: 1/2 - 1 against -(1/2 + 1).
    np.testing.assert_allclose(above[1] - below[1], -A_MM, atol=1e-3)
    np.testing.assert_allclose(above[[0, 2]], below[[0, 2]], atol=1e-2)
    smooth = published_point(90.0 + 1e-7, C, 8.0, A_MM) - published_point(90.0 - 1e-7, C, 8.0, A_MM)
    # 2e-7 deg times at most 1 m per degree at C = 89.
    assert np.abs(smooth).max() < 1e-2
    B = np.array([30.0, 60.0, 90.0])
    np.testing.assert_array_equal(
        published_point(B, 70.0, 8.0, A_MM, as_printed=True), published_point(B, 70.0, 8.0, A_MM)
    )
    # The table's last column, at B and C whose share is 253.2 / 200 + 1/2.
    share = 0.5 + 253.2 / 200
    assert published_point(110.0, 50.0, 0.0, A_MM, as_printed=True)[1] == pytest.approx(-A_MM * (0.5 + share), abs=0.05)
