"""The paper's equations as printed: its table, and the discontinuous branch.

`calibration/test_optics.py` holds the package's rays that meet against them.
"""

from __future__ import annotations

import numpy as np
import pytest
from support.published_equations import published_point

A_MM = 200.0


@pytest.mark.parametrize(("B", "C", "y_mm"), [(90, 70, -100.0), (95, 70, -163.3), (110, 50, -253.2)])
def test_published_y_is_the_table(B, C, y_mm):
    """Published points by paper eq. (1) to (3), printed to 0.1 mm."""
    assert published_point(float(B), float(C), 0.0, A_MM)[1] == pytest.approx(y_mm, abs=0.05)


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
