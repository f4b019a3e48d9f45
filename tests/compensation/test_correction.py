"""Corrections of commands: by side, between lines, beyond the ends, rounded."""

from __future__ import annotations

import numpy as np

from tvsbayes.compensation.correction import Correction
from tvsbayes.single_axis.axis_campaign import AxisMove

COARSE = Correction(np.array([0.0, 10.0]), np.array([0.2, 0.4]), np.array([-0.2, 0.0]))


def test_both_sides_are_linear_between_lines_and_constant_beyond():
    command, side = np.array([5.0, 5.0, 5.0, -3.0, 12.0]), np.array([1, -1, 0, 1, -1])
    # Exact in binary up to rounding of a few sums.
    np.testing.assert_allclose(COARSE.sent(command, side), [5.3, 4.9, 5.1, -2.8, 12.0], atol=1e-12)


def test_factors_of_the_common_part_and_of_the_play():
    command, side = np.array([5.0, 5.0]), np.array([1, -1])
    np.testing.assert_allclose(COARSE.sent(command, side, 0.0, 0.0), [5.0, 5.0], atol=1e-12)
    np.testing.assert_allclose(COARSE.sent(command, side, 2.0, 2.0), [5.6, 4.8], atol=1e-12)
    np.testing.assert_allclose(COARSE.sent(command, side, 1.0, -1.0), [4.9, 5.3], atol=1e-12)


def test_commands_are_rounded_to_the_resolution():
    rounded = Correction(COARSE.command, COARSE.forward, COARSE.backward, 0.25)
    np.testing.assert_allclose(rounded.sent(np.array([5.0]), np.array([1])), [5.25], atol=1e-12)


def test_moves_get_the_correction_of_their_direction():
    moves = [AxisMove(0, 0, 0.0, 0.0, "forward"), AxisMove(1, 0, 1.0, 10.0), AxisMove(2, 0, 2.0, 0.0)]
    assert np.allclose([m.command for m in COARSE.moved(moves)], [0.2, 10.4, -0.2], atol=1e-12)
